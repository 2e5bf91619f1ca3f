//! Files with several frames.
//!
//! ```text
//!   in/dump.lammpstrj               a file with three time steps
//!   in/dump.lammpstrj/step=1000     the frame of one of these time steps ─▶ out/dump.1000.glb
//! ```
//!
//! A path identifies a frame in records, reports and on the command line. So a step has a path as
//! well, as if its file were a folder. No file can have such a path, because a file is not a folder. A file
//! named `step=1000` in a folder is an ordinary file.
//!
//! One pass over the file finds the positions of the steps, and a cache keeps them until the file changes, so
//! that each step can be read alone. In a compressed file, steps cannot be read alone: the whole file is
//! decompressed for each step.
//!
//! ```text
//!   index   indexes the steps of a file, also after the file grew       cache   the cache of these indices
//! ```

mod cache;
mod index;

use std::io;
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use meniscus_formats::container::is_container;
use meniscus_formats::steps::{FoundStep, may_have_steps, step_of_compressed};
use meniscus_formats::{Error, Loaded, ReadAt, Result};
use twox_hash::XxHash3_128;

use crate::pipeline::files::input_file::InputFile;
use crate::pipeline::files::named_files::NamedFiles;
use crate::pipeline::files::names::text_of_name;
use crate::pipeline::files::open::open_regular;
use crate::pipeline::files::stamp::FileStamp;
use crate::pipeline::memory::reading_limits;

use super::container::{OpenContainer, is_container_file};
use cache::{cached_index, index_unless, index_unless_changed};
use index::{FileStep, StepIndex, UNNUMBERED, probe_head};

/// The prefix of the last part of a step's path; the name of the step follows.
pub(crate) const STEP: &str = "step=";

/// The file that a frame is read from: the frame itself, or the file that the frame is a step of.
pub fn file_of(frame: &Path) -> &Path {
    step_of(frame).map_or(frame, |(file, _)| file)
}

/// The file and the name of a step; `None` for a frame that is a whole file.
pub fn step_of(frame: &Path) -> Option<(&Path, &str)> {
    // A folder contains files and not steps, whatever their names are.
    step_in(frame, true).filter(|(file, _)| !file.is_dir())
}

/// Like [`step_of`], but does not access the disk: the caller knows whether the path is that of a step.
pub(crate) fn step_in(frame: &Path, is_step: bool) -> Option<(&Path, &str)> {
    let step =
        frame.file_name()?.to_str()?.strip_prefix(STEP).filter(|step| is_step && may_be_named(step))?;
    let file = frame.parent().filter(|file| file.file_name().is_some())?;
    Some((file, step))
}

/// Whether the text can be the name of a step: a number or `unnumbered`. From the second step with the same
/// number on, a dot and the count among these steps follow.
fn may_be_named(step: &str) -> bool {
    let is_number = |text: &str| !text.is_empty() && text.bytes().all(|byte| byte.is_ascii_digit());
    let (number, count) = step.split_once('.').map_or((step, None), |(number, count)| (number, Some(count)));
    let is_named = number == UNNUMBERED || is_number(number.strip_prefix('-').unwrap_or(number));
    is_named && count.is_none_or(is_number)
}

/// The name of a frame: its path without the folder of its file.
pub fn frame_name(frame: &Path) -> String {
    name_of(frame, step_of(frame).is_some())
}

/// Like [`frame_name`], but does not access the disk: the caller knows whether the path is that of a step.
pub(crate) fn name_of(frame: &Path, is_step: bool) -> String {
    let name = |file: &Path| text_of_name(file.file_name().unwrap_or_default());
    match step_in(frame, is_step) {
        Some((file, step)) => format!("{}/{STEP}{step}", name(file)),
        None => name(frame),
    }
}

/// The frames of a file: its steps, or the file itself if it has only one.
///
/// # Errors
/// When the file cannot be indexed.
pub fn frames_in(file: &Path) -> Result<Vec<PathBuf>> {
    Ok(frames_in_unless(file, &AtomicBool::new(false))?.paths().collect())
}

/// The frames of a file, and its known earlier states.
#[derive(Clone, Debug)]
pub struct FileFrames {
    file: PathBuf,
    index: Arc<StepIndex>,
}

impl FileFrames {
    /// Whether the file has several steps, and so is not itself a frame.
    pub fn has_several(&self) -> bool {
        self.index.steps.len() > 1
    }

    /// The paths of the frames: of the file, or of its steps. An iterator, because a file may have a million
    /// steps.
    pub fn paths(&self) -> impl Iterator<Item = PathBuf> + use<> {
        let FileFrames { file, index: contents } = self.clone();
        let count = contents.steps.len().max(1);
        (0..count).map(move |index| match &contents.steps[..] {
            [] | [_] => file.clone(),
            steps => file.join(format!("{STEP}{}", steps[index].name())),
        })
    }

    /// The number of frames at the start of the file that are unchanged since the file had this stamp,
    /// because data was only appended.
    pub fn unchanged_since(&self, stamp: &FileStamp) -> usize {
        self.index.unchanged_since(stamp)
    }
}

/// Finds the frames in a file, like [`frames_in`]. Setting `is_over` cancels the pass over the file, which
/// may take long for a large file.
///
/// # Errors
/// When the file cannot be indexed, or the pass was cancelled.
pub fn frames_in_unless(file: &Path, is_over: &AtomicBool) -> Result<FileFrames> {
    Ok(FileFrames { file: file.to_owned(), index: index_unless(file, is_over)? })
}

/// Whether a file has a format that can hold several frames, judged by its first bytes.
///
/// # Errors
/// When the system reports an error.
pub fn may_hold_several(file: &Path) -> io::Result<bool> {
    if !file.metadata()?.is_file() {
        return Ok(false);
    }
    let kind = probe_head(&mut open_regular(file)?, file)?.kind;
    Ok(may_have_steps(kind) || is_container(kind))
}

/// Whether a frame is a step that does not exist in its file. A file with a single step has no paths of
/// steps: the file itself is the frame.
///
/// # Errors
/// When the file cannot be indexed.
pub fn is_missing_step(frame: &Path) -> Result<bool> {
    match step_of(frame) {
        None => Ok(false),
        Some((file, step)) => {
            let contents = step_index(file)?;
            Ok(contents.steps.len() < 2 || contents.step(step).is_err())
        }
    }
}

/// The size of a frame in bytes: the size of its file on disk, or the uncompressed size of its step.
///
/// # Errors
/// When the system reports an error, or the file has no such step.
pub fn size_bytes(frame: &Path) -> Result<u64> {
    match step_of(frame) {
        None => Ok(frame.metadata()?.len()),
        Some((file, step)) => {
            let contents = step_index(file)?;
            let range = &contents.step(step)?.range;
            Ok(range.end - range.start)
        }
    }
}

/// Who indexes a file again after a change.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum IndexPolicy {
    /// The reader of a step.
    OnRead,
    /// Another thread: until then, a reader treats the steps of a changed file as changed.
    External,
}

impl IndexPolicy {
    fn index(self, file: &Path) -> Result<Option<Arc<StepIndex>>> {
        match self {
            IndexPolicy::OnRead => step_index(file).map(Some),
            IndexPolicy::External => index_unless_changed(file),
        }
    }
}

/// The memory for reading a frame, in bytes; 0 if the frame cannot be read.
pub(crate) fn reading_bytes(frame: &Path, by: IndexPolicy) -> u64 {
    let (file, step) = match step_of(frame) {
        Some((file, step)) => (file, Some(step)),
        None if is_container_file(frame) => (frame, None),
        None => return frame.metadata().map_or(0, |metadata| metadata.len()),
    };
    let Ok(Some(contents)) = by.index(file) else { return 0 };
    let found = match step {
        Some(step) => contents.step(step).ok(),
        None => contents.steps.first().map(|step| &step.found),
    };
    let Some(FoundStep { range, .. }) = found else { return 0 };
    contents.unpacking_bytes.unwrap_or(range.end - range.start)
}

/// The times of the steps of a file in seconds, with their numbers; `None` if the file does not state them.
pub(crate) fn times_of_steps(file: &Path) -> Option<Vec<(i64, f64)>> {
    let contents = step_index(file).ok()?;
    let of_step = |(index, step): (usize, &FileStep)| Some((step.found.number?, contents.time_of(index)?));
    contents.steps.iter().enumerate().map(of_step).collect()
}

/// The time of a frame in seconds, if its file states it.
pub fn time_of_frame(frame: &Path) -> Option<f64> {
    let (file, step) = step_of(frame).map_or((frame, None), |(file, step)| (file, Some(step)));
    let contents = step_index(file).ok()?;
    contents.time_of(step.map_or(Ok(0), |step| contents.index_of(step)).ok()?)
}

/// What a container has.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum ContainerContent {
    /// No particles.
    NoParticles,
    /// Names of files beside it, each of which is a frame: converting both would convert each frame twice.
    List,
    /// Frames.
    Frames,
}

/// What a container has, by its structure.
///
/// # Errors
/// When the structure cannot be read.
pub(crate) fn content_of_container(file: &Path) -> Result<ContainerContent> {
    let found = step_index(file);
    Ok(match found.as_ref().map(|contents| contents.frames_of_container()) {
        Ok([]) | Err(Error::Unsupported { .. }) => ContainerContent::NoParticles,
        Ok(frames) if frames.iter().all(|frame| frame.is_file_beside) => ContainerContent::List,
        Ok(_) => ContainerContent::Frames,
        Err(_) => return found.map(|_| ContainerContent::Frames),
    })
}

/// Whether a file is a container with frames, as far as its structure can be read.
pub fn has_container_frames(file: &Path) -> bool {
    is_container_file(file)
        && content_of_container(file).is_ok_and(|content| content != ContainerContent::NoParticles)
}

/// The only frame of a container; `None` if the file, or one that
/// it names, was written, replaced or removed meanwhile.
///
/// # Errors
/// Those of [`read_step`]; [`Error::Unsupported`] if there are several frames.
pub(crate) fn read_only_frame(file: &Path, by: IndexPolicy) -> Result<Option<StampedContent>> {
    let Some(contents) = by.index(file)? else { return Ok(None) };
    if let [first, .., last] = &contents.steps[..] {
        let what = format!(
            "the file has {} frames: name one, from {STEP}{} to {STEP}{}, as if the file were their folder",
            contents.steps.len(),
            first.name(),
            last.name()
        );
        return Err(Error::unsupported("", what));
    }
    read_sample(file, 0, &contents)
}

/// The content of a frame.
#[derive(Debug, PartialEq)]
pub(crate) struct StampedContent {
    pub(crate) content: Loaded,
    /// The stamp of its file.
    pub(crate) stamp: FileStamp,
    /// The files that it was read from besides its own, if there are any.
    pub(crate) named: Option<Arc<NamedFiles>>,
}

/// The content of a frame that is not a whole file, as of [`read_step`] or [`read_only_frame`]; `None` for one that is.
pub(crate) fn read_part(frame: &Path, by: IndexPolicy) -> Option<Result<Option<StampedContent>>> {
    match step_of(frame) {
        Some((file, step)) => Some(read_step(file, step, by)),
        None => is_container_file(frame).then(|| read_only_frame(frame, by)),
    }
}

/// Like [`read_step`], of a container.
fn read_sample(file: &Path, index: usize, contents: &StepIndex) -> Result<Option<StampedContent>> {
    let open = OpenContainer::open(file)?.filter(|open| open.stamp() == contents.stamp);
    let (Some(open), Some(frames)) = (open, contents.reader()) else { return Ok(None) };
    let content = open.read(frames, index)?;
    Ok(content.map(|content| StampedContent { content, stamp: contents.stamp, named: open.named_files() }))
}

/// The files besides its own from which a frame, which cannot be read, would be read.
pub(crate) fn named_by_unreadable(frame: &Path) -> Option<Arc<NamedFiles>> {
    let (file, step) = step_of(frame).map_or((frame, None), |(file, step)| (file, Some(step)));
    let open = OpenContainer::open(file).ok()??;
    // The files that were wanted before an error are known.
    match step_index(file) {
        Ok(contents) => {
            let index = step.and_then(|step| contents.index_of(step).ok()).unwrap_or(0);
            let _ = contents.reader().map(|frames| open.read(frames, index));
        }
        Err(_) => drop(open.frames()),
    }
    open.named_files()
}

/// The content of a step; `None` if the file was written, replaced or removed
/// meanwhile.
///
/// # Errors
/// When the system reports an error, the file has no such step, or the step cannot be decompressed.
pub(crate) fn read_step(file: &Path, step: &str, by: IndexPolicy) -> Result<Option<StampedContent>> {
    let Some(contents) = by.index(file)? else { return Ok(None) };
    if contents.reader().is_some() {
        return read_sample(file, contents.index_of(step)?, &contents);
    }
    let found = contents.step(step)?;
    let input = InputFile::open(file)?;
    if input.stamp() != contents.stamp {
        return Ok(None);
    }
    let read = |range: Range<u64>| {
        let length = usize::try_from(range.end - range.start).map_err(io::Error::other)?;
        let mut bytes = vec![0; length];
        match input.read_exact_at(&mut bytes, range.start) {
            // The file shrank since it was indexed.
            Err(error) if error.kind() == io::ErrorKind::UnexpectedEof => Ok(None),
            read => read.map(|()| Some(bytes)),
        }
    };
    let is_packed = contents.unpacking_bytes.is_some();
    let stored = if is_packed { 0..contents.stamp.size } else { found.range.clone() };
    let Some(bytes) = read(stored.clone())? else { return Ok(None) };
    let hash = XxHash3_128::oneshot(&bytes);
    let content = if is_packed {
        // A step that has moved is absent, so the file has changed.
        let step = step_of_compressed(contents.kind, &bytes, found, &reading_limits())?;
        let Some(step) = step else { return Ok(None) };
        step
    } else if found.head.is_empty() {
        Loaded::Bytes(bytes)
    } else {
        Loaded::Bytes([&*found.head, &*bytes].concat())
    };
    let has_same_bytes =
        || Ok(read(stored.clone())?.is_some_and(|again| XxHash3_128::oneshot(&again) == hash));
    let read = StampedContent { content, stamp: contents.stamp, named: None };
    Ok(input.is_unchanged_or(has_same_bytes)?.then_some(read))
}

/// The error of a frame. For a step, its line number counts from the start of the whole file, because that is
/// where users look for the line.
pub(crate) fn by_lines_of_file(frame: &Path, error: Error) -> Error {
    let lines_before = |(file, step): (&Path, &str)| Some(cached_index(file)?.step(step).ok()?.lines_before);
    error.with_line_offset(step_of(frame).and_then(lines_before).unwrap_or(0))
}

/// The index of a file in its current state.
fn step_index(file: &Path) -> Result<Arc<StepIndex>> {
    index_unless(file, &AtomicBool::new(false))
}

#[cfg(test)]
mod tests {
    use super::*;
    use meniscus_formats::Limits;
    use ruzstd::encoding::{CompressionLevel, compress_to_vec};
    use std::fs;

    const BY: IndexPolicy = IndexPolicy::OnRead;

    /// Rows that hardly compress, so that the first step is longer than the head that is probed.
    fn step(number: &str, x: f64) -> String {
        let rows = (0..400).map(|row| {
            let mixed = (f64::from(row) * x * 12.9898).sin() * 43758.5453;
            format!("{x} {} {}\n", mixed.fract(), (mixed * 7.13).fract())
        });
        let head =
            "ITEM: NUMBER OF ATOMS\n400\nITEM: BOX BOUNDS pp pp pp\n0 1\n0 1\n0 1\nITEM: ATOMS x y z\n";
        format!("ITEM: TIMESTEP\n{number}\n{head}{}", rows.collect::<String>())
    }

    #[test]
    fn step_paths_name_their_file_and_step() {
        let step = Path::new("in/dump.7.lammpstrj/step=1000.2");
        assert_eq!(step_of(step), Some((Path::new("in/dump.7.lammpstrj"), "1000.2")));
        assert_eq!(file_of(step), Path::new("in/dump.7.lammpstrj"));
        assert_eq!(frame_name(step), "dump.7.lammpstrj/step=1000.2");
        for file in [
            "in/dump.7.lammpstrj",
            "step=1000",
            "/step=1000",
            "in/step",
            "in/../step=5",
            "in/step=1.ply",
            "in/step=x",
        ] {
            let file = Path::new(file);
            assert_eq!((step_of(file), file_of(file)), (None, file));
        }
        let folder = tempfile::tempdir().expect("a folder");
        let file = folder.path().join("step=1000");
        assert_eq!(step_of(&file), None);
    }

    #[test]
    fn steps_of_plain_and_compressed_files_are_read_alone() {
        let folder = tempfile::tempdir().expect("a folder");
        let steps =
            [step("1000", 1.0), step("x", 2.0), step("1000", 3.0), step("-5", 4.0), step("1000", 5.0)];
        let packed = |bytes: &[u8]| compress_to_vec(bytes, CompressionLevel::Fastest);
        assert!(packed(steps[0].as_bytes()).len() > 8 << 10, "the first block is longer than the head");
        for (name, pack) in [("d.dump", None), ("d.dump.zst", Some(packed))] {
            let file = folder.path().join(name);
            let write = |steps: &[String]| {
                let bytes = steps.concat().into_bytes();
                fs::write(&file, pack.map_or(bytes.clone(), |pack| pack(&bytes))).expect("written");
            };
            write(&steps);
            let frames = frames_in(&file).expect("steps");
            let names: Vec<String> = frames.iter().map(|frame| frame_name(frame)).collect();
            let expected = ["1000", "unnumbered", "1000.2", "-5", "1000.3"];
            assert_eq!(names, expected.map(|step| format!("{name}/step={step}")));
            for (frame, text) in frames.iter().zip(&steps) {
                let (path, name) = step_of(frame).expect("a step");
                let read = read_step(path, name, BY).expect("read").expect("unchanged");
                assert_eq!(read.content, Loaded::Bytes(text.clone().into_bytes()));
                assert_eq!(read.stamp, FileStamp::of_path(&file).expect("there"));
                assert_eq!(size_bytes(frame).expect("there"), text.len() as u64);
                assert!(reading_bytes(frame, BY) >= text.len() as u64);
            }
            // The index describes the old state of the file.
            write(&[step("1", 1.0), step("2000", 2.0)]);
            let (path, name) = step_of(&frames[0]).expect("a step");
            let gone = read_step(path, name, BY).expect_err("gone");
            assert!(matches!(&gone, Error::Io(error) if error.kind() == io::ErrorKind::NotFound));
            assert!(gone.to_string().contains("no step 1000"), "{gone}");
            write(&steps[..1]);
            assert_eq!(frames_in(&file).expect("a frame"), [&*file]);
            assert!(is_missing_step(&frames[0]).expect("gone through"), "the file is the frame");
            let [first, again] = [(); 2].map(|()| step_index(&file).expect("a step"));
            assert!(Arc::ptr_eq(&first, &again), "one pass indexes it");
        }
    }

    #[test]
    fn only_an_allowed_reader_indexes_a_changed_file() {
        let folder = tempfile::tempdir().expect("a folder");
        let file = folder.path().join("d.dump");
        fs::write(&file, step("1", 1.0) + &step("2", 1.0)).expect("written");
        let frame = file.join("step=1");
        let (path, name) = step_of(&frame).expect("a step");
        let read = |by| read_step(path, name, by).expect("read");
        assert!(read(IndexPolicy::External).is_some(), "no thread has indexed it again");
        fs::write(&file, step("1", 1.0) + &step("2", 1.0) + &step("3", 1.0)).expect("written");
        assert!(read(IndexPolicy::External).is_none());
        assert_eq!(reading_bytes(&frame, IndexPolicy::External), 0);
        assert!(read(IndexPolicy::OnRead).is_some());
        assert!(read(IndexPolicy::External).is_some(), "it is known now");
        let over = frames_in_unless(&file, &AtomicBool::new(true));
        assert_eq!(over.expect("it is known").paths().count(), 3);
    }

    /// A `.pvd` of files in the folder `d`, each of which is a table of the legacy format with one point.
    fn write_list(folder: &Path, xs: &[f64]) {
        fs::create_dir_all(folder.join("d")).expect("made");
        let mut entries = String::new();
        for (index, x) in xs.iter().enumerate() {
            let text =
                format!("# vtk DataFile Version 3.0\na\nASCII\nDATASET POLYDATA\nPOINTS 1 float\n{x} 0 0\n");
            let path = folder.join(format!("d/{index}.vtk"));
            if fs::read_to_string(&path).ok().as_ref() != Some(&text) {
                fs::write(path, text).expect("written");
            }
            entries += &format!("<DataSet timestep=\"{}\" file=\"d/{index}.vtk\"/>", 0.5 * index as f64);
        }
        let text = format!("<VTKFile type=\"Collection\"><Collection>{entries}</Collection></VTKFile>");
        fs::write(folder.join("run.pvd"), text).expect("written");
    }

    #[test]
    fn frames_of_a_container_are_read_alone() {
        let folder = tempfile::tempdir().expect("a folder");
        let folder = folder.path();
        let list = folder.join("run.pvd");
        write_list(folder, &[0.5, 1.5, 2.5]);
        let frames = frames_in_unless(&list, &AtomicBool::new(false)).expect("frames");
        assert!(frames.has_several() && may_hold_several(&list).expect("there"));
        let names: Vec<String> = frames.paths().map(|frame| frame_name(&frame)).collect();
        assert_eq!(names, ["run.pvd/step=0", "run.pvd/step=1", "run.pvd/step=2"]);
        assert_eq!(time_of_frame(&list.join("step=2")), Some(1.0));
        assert_eq!(content_of_container(&list).expect("a list"), ContainerContent::Frames);
        let read = |step: &str| read_step(&list, step, BY).expect("read").expect("unchanged").content;
        let before: Vec<Loaded> = ["0", "1", "2"].map(read).into();
        assert!(before[0] != before[1] && reading_bytes(&list.join("step=0"), BY) > 0);
        let frame = meniscus_formats::particles_of(before[2].clone(), "run.pvd", &[], &Limits::default());
        let frame = frame.expect("particles");
        assert_eq!(frame.positions, meniscus_formats::FilePositions::F32(vec![[2.5, 0.0, 0.0]]));
        let error = read_only_frame(&list, BY).expect_err("three frames").to_string();
        assert!(
            error.contains("the file has 3 frames") && error.contains("from step=0 to step=2"),
            "{error}"
        );
        // The list grows, and one of its files changes.
        let stamp = FileStamp::of_path(&list).expect("there");
        write_list(folder, &[0.5, 1.25, 2.5, 3.5]);
        let frames = frames_in_unless(&list, &AtomicBool::new(false)).expect("frames");
        assert_eq!((frames.paths().count(), frames.unchanged_since(&stamp)), (4, 1));
        assert!(read("0") == before[0] && read("1") != before[1] && read("2") == before[2]);
        // A list that only grows.
        let stamp = FileStamp::of_path(&list).expect("there");
        write_list(folder, &[0.5, 1.25, 2.5, 3.5, 4.5]);
        let frames = frames_in_unless(&list, &AtomicBool::new(false)).expect("frames");
        assert_eq!(frames.unchanged_since(&stamp), 4);
        // A missing file may be written later.
        fs::remove_file(folder.join("d/4.vtk")).expect("removed");
        let gone = read_step(&list, "4", BY).expect_err("gone");
        assert!(gone.is_truncated() && gone.to_string().contains("d/4.vtk"), "{gone}");
        // A single frame is the file itself.
        write_list(folder, &[0.5]);
        assert_eq!(frames_in(&list).expect("a frame"), [&*list]);
        let StampedContent { content, .. } = read_only_frame(&list, BY).expect("read").expect("unchanged");
        assert_eq!(content, before[0]);
        assert!(reading_bytes(&list, BY) > 12, "the position of a particle");
    }

    #[test]
    fn compressed_lists_are_read() {
        let folder = tempfile::tempdir().expect("a folder");
        let folder = folder.path();
        write_list(folder, &[0.5, 1.5]);
        for name in ["run.pvd", "d/1.vtk"] {
            let path = folder.join(name);
            let bytes = fs::read(&path).expect("there");
            fs::write(&path, compress_to_vec(&*bytes, CompressionLevel::Fastest)).expect("written");
        }
        let list = folder.join("run.pvd");
        for step in ["0", "1"] {
            assert!(read_step(&list, step, BY).expect("read").is_some());
        }
    }
}
