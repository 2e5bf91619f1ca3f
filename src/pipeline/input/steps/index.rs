//! Indexes the steps of a file with one pass over it.
//!
//! ```text
//!   before   │ step=0 │ step=1000 │ step=20..│
//!            ▲ head                    tail ▲      the same bytes at the same places
//!   now      │ step=0 │ step=1000 │ step=2000 │ step=3000 │
//!              kept     kept      ▲ the pass starts here
//! ```
//!
//! A file that grew counts as appended to if its head is unchanged and the bytes before its old end are still
//! there. Its last step may have been incomplete, so the pass reads that step again, and keeps the steps
//! before it. So indexing keeps up with a simulation that appends a step in less time than a pass over the
//! whole file takes.

use std::collections::HashMap;
use std::fs::File;
use std::io::{self, BufReader, Read, Seek, SeekFrom};
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};

use meniscus_formats::compression::{decompressed_so_far, read_head};
use meniscus_formats::container::{ContainerFrames, is_container};
use meniscus_formats::steps::{FoundStep, find_more_steps, find_steps, may_have_steps};
use meniscus_formats::{Probe, ProbedKind, Result, probe};
use twox_hash::XxHash3_128;

use crate::pipeline::files::open::open_regular;
use crate::pipeline::files::stamp::FileStamp;
use crate::pipeline::input::container::{ContainerFrame, OpenContainer};
use crate::pipeline::memory::reading_limits;

/// The index of a file.
#[derive(Debug)]
pub(super) struct StepIndex {
    /// The stamp of the indexed file.
    pub(super) stamp: FileStamp,
    /// Memory for decompression, in bytes; `None` if the file is not compressed.
    pub(super) unpacking_bytes: Option<u64>,
    /// In the order of the file.
    pub(super) steps: Vec<FileStep>,
    /// The indices of the steps, sorted by the keys of their names.
    by_name: Vec<u32>,
    pub(super) kind: ProbedKind,
    /// `None` if the file is compressed, or shrank during the pass: then a later pass cannot check whether
    /// the file was appended to.
    edges: Option<FileEnds>,
    /// The frames of a container, one for each step, and how they are read.
    container: Option<(Vec<ContainerFrame>, ContainerFrames)>,
    /// Earlier states of the file, the latest last, with the number of leading steps that are unchanged
    /// since.
    before: Vec<(FileStamp, usize)>,
}

/// A step of a file. A file may have a million steps, so the name is not stored.
#[derive(Debug)]
pub(super) struct FileStep {
    /// Its position in the uncompressed file.
    pub(super) found: FoundStep,
    /// 1 for the first step with its number, 2 for the second, ..
    count: u32,
}

impl FileStep {
    /// The unique name of the step: its number, and from the second step with that number on also the count.
    pub(super) fn name(&self) -> String {
        let number = self.found.number.map_or_else(|| UNNUMBERED.to_owned(), |number| number.to_string());
        if self.count == 1 { number } else { format!("{number}.{}", self.count) }
    }

    /// The key of the name.
    fn key(&self) -> (Option<i64>, u32) {
        (self.found.number, self.count)
    }
}

/// The key of a name; `None` for text that cannot be the name of a step.
fn key_of(name: &str) -> Option<(Option<i64>, u32)> {
    let (number, count) = match name.split_once('.') {
        Some((number, count)) => (number, count.parse().ok()?),
        None => (name, 1),
    };
    let number = if number == UNNUMBERED { None } else { Some(number.parse().ok()?) };
    Some((number, count))
}

/// The number of earlier states that are stored. A caller with an older state must read all steps again.
const BEFORE_MAX: usize = 16;

impl StepIndex {
    fn new(stamp: FileStamp, kind: ProbedKind, steps: Vec<FoundStep>) -> StepIndex {
        let steps = counted(steps);
        // Limits keep the number of steps far below 2³².
        let mut by_name: Vec<u32> = (0..steps.len() as u32).collect();
        by_name.sort_by_key(|&index| steps[index as usize].key());
        StepIndex {
            stamp,
            unpacking_bytes: None,
            steps,
            by_name,
            kind,
            edges: None,
            container: None,
            before: Vec::new(),
        }
    }

    /// The index of a file without steps.
    pub(super) fn none(stamp: FileStamp) -> StepIndex {
        StepIndex::new(stamp, ProbedKind::Unknown, Vec::new())
    }

    /// The step with this name.
    pub(super) fn step(&self, name: &str) -> io::Result<&FoundStep> {
        Ok(&self.steps[self.index_of(name)?].found)
    }

    /// The index of the step with this name.
    pub(super) fn index_of(&self, name: &str) -> io::Result<usize> {
        let step_at = |index: &u32| &self.steps[*index as usize];
        let found = key_of(name).and_then(|key| {
            let rank = self.by_name.binary_search_by_key(&key, |index| step_at(index).key()).ok()?;
            // `7` and `07` have the same key, but only `7` is the name of a step.
            Some(self.by_name[rank] as usize).filter(|index| self.steps[*index].name() == name)
        });
        found.ok_or_else(|| {
            io::Error::new(io::ErrorKind::NotFound, format!("there is no step {name} in the file"))
        })
    }

    /// The frames of a container; empty for other files.
    pub(super) fn frames_of_container(&self) -> &[ContainerFrame] {
        self.container.as_ref().map(|(frames, _)| &**frames).unwrap_or_default()
    }

    /// How the frames of a container are read; `None` for other files.
    pub(super) fn reader(&self) -> Option<&ContainerFrames> {
        self.container.as_ref().map(|(_, reader)| reader)
    }

    /// The time of a step in seconds, if the file states it.
    pub(super) fn time_of(&self, index: usize) -> Option<f64> {
        self.frames_of_container().get(index)?.sample.time
    }

    /// Notes that the first `kept_count` steps are as they were in an earlier state.
    fn keep(&mut self, before: &StepIndex, kept_count: usize) {
        let earlier = before.before.iter().map(|&(stamp, count)| (stamp, count.min(kept_count)));
        self.before = earlier.chain([(before.stamp, kept_count)]).collect();
        let surplus = self.before.len().saturating_sub(BEFORE_MAX);
        self.before.drain(..surplus);
    }

    /// The number of leading steps that are unchanged since the file had this stamp.
    pub(super) fn unchanged_since(&self, stamp: &FileStamp) -> usize {
        if *stamp == self.stamp {
            self.steps.len()
        } else {
            self.before.iter().rfind(|(before, _)| before == stamp).map_or(0, |(_, count)| *count)
        }
    }

    /// Whether the file with this stamp is the indexed file plus appended bytes.
    fn has_become(&self, file: &mut File, stamp: &FileStamp, kind: ProbedKind) -> bool {
        let is_larger = stamp.inode == self.stamp.inode && stamp.size > self.stamp.size;
        // The header of an array, not what is appended, says how many steps it has.
        let is_text = self.steps.iter().all(|step| step.found.head.is_empty());
        let mut is_as_before =
            || self.edges.as_ref().is_some_and(|edges| edges.are_in(file).unwrap_or(false));
        is_larger && is_text && kind == self.kind && !self.steps.is_empty() && is_as_before()
    }
}

/// Indexes a file. If the index from `before` still applies, the pass skips the beginning of the file.
///
/// # Errors
/// When the system reports an error, the file has too many steps, or `is_over` is set.
pub(super) fn index_steps(
    path: &Path,
    before: Option<&StepIndex>,
    is_over: &AtomicBool,
) -> Result<StepIndex> {
    let mut file = open_regular(path)?;
    let stamp = FileStamp::of(&file.metadata()?);
    let Probe { kind, codec } = probe_head(&mut file, path)?;
    if is_container(kind) {
        return index_container(path, before, stamp);
    }
    if !may_have_steps(kind) {
        return Ok(StepIndex::none(stamp));
    }
    let before = before.filter(|before| before.has_become(&mut file, &stamp, kind));
    let mut known: Vec<FoundStep> =
        before.map_or_else(Vec::new, |before| before.steps.iter().map(|step| step.found.clone()).collect());
    let start = known.last().map_or(0, |last| last.range.start);
    file.seek(SeekFrom::Start(start))?;
    // Bytes that are appended during this pass are left to the next one.
    let mut source = Watched::new((&file).take(stamp.size.saturating_sub(start)), is_over);
    if codec.is_some() {
        return index_compressed(source, stamp, kind);
    }
    find_more_steps(
        kind,
        BufReader::with_capacity(BUFFER_BYTES, &mut source),
        &mut known,
        &reading_limits(),
    )?;
    let mut contents = StepIndex::new(stamp, kind, within(known, stamp.size));
    let head = before.and_then(|before| before.edges.as_ref()).map(|edges| edges.head);
    contents.edges = source.edges(start, head).filter(|edges| edges.tail.end == stamp.size);
    if let Some(before) = before {
        contents.keep(before, before.steps.len() - 1);
    }
    Ok(contents)
}

/// Indexes the frames of a container. A frame that is read from other files is unchanged if these are; others must be
/// read to know.
fn index_container(path: &Path, before: Option<&StepIndex>, stamp: FileStamp) -> Result<StepIndex> {
    let Some(file) = OpenContainer::open(path)? else { return Ok(StepIndex::none(stamp)) };
    let (frames, reader) = file.frames()?;
    let found = |frame: &ContainerFrame| FoundStep {
        number: Some(frame.sample.number),
        head: [].into(),
        range: 0..frame.size_bytes,
        lines_before: 0,
    };
    let mut contents = StepIndex::new(file.stamp(), file.kind(), frames.iter().map(found).collect());
    if let Some(before) = before
        && let Some((frames_before, _)) = &before.container
    {
        let is_kept =
            |(now, before): &(&ContainerFrame, &ContainerFrame)| now.files.is_some() && now == before;
        contents.keep(before, frames.iter().zip(frames_before).take_while(is_kept).count());
    }
    contents.container = Some((frames, reader));
    Ok(contents)
}

fn index_compressed(mut source: impl Read, stamp: FileStamp, kind: ProbedKind) -> Result<StepIndex> {
    let mut bytes = Vec::new();
    source.read_to_end(&mut bytes)?;
    let (decompressed, _) = decompressed_so_far(&bytes, &reading_limits())?;
    let found = find_steps(kind, &*decompressed, &reading_limits())?;
    let unpacking_bytes = Some((bytes.len() + decompressed.len()) as u64);
    let found = within(found, decompressed.len() as u64);
    Ok(StepIndex { unpacking_bytes, ..StepIndex::new(stamp, kind, found) })
}

/// Steps of a file of this size: the header of a truncated array declares more.
fn within(mut steps: Vec<FoundStep>, size: u64) -> Vec<FoundStep> {
    for FoundStep { range, .. } in &mut steps {
        *range = range.start.min(size)..range.end.min(size);
    }
    steps
}

/// Probes the first bytes of a file.
pub(super) fn probe_head(file: &mut File, path: &Path) -> io::Result<Probe> {
    let head = read_head(file, HEAD_BYTES)?;
    Ok(probe(&head, &path.file_name().unwrap_or_default().to_string_lossy()))
}

/// Enough bytes to recognize the format.
const HEAD_BYTES: u64 = 8 << 10;

/// Large enough that the cost of system calls does not matter.
const BUFFER_BYTES: usize = 1 << 18;

/// The first bytes of a file, and the last ones that the pass read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct FileEnds {
    head: Edge,
    tail: Edge,
}

/// A range of bytes in a file, and their hash.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Edge {
    start: u64,
    end: u64,
    hash: u128,
}

/// Size of the tail that is compared: about a thousand rows, so other rows do not have the same bytes by
/// chance.
const TAIL_BYTES: usize = 64 << 10;

impl FileEnds {
    /// Whether the file still has the same bytes in this range.
    fn are_in(&self, file: &mut File) -> io::Result<bool> {
        let mut is_in = |edge: Edge| {
            file.seek(SeekFrom::Start(edge.start))?;
            let mut bytes = Vec::new();
            file.by_ref().take(edge.end - edge.start).read_to_end(&mut bytes)?;
            io::Result::Ok(Edge::of(edge.start, &bytes) == edge)
        };
        Ok(is_in(self.head)? && is_in(self.tail)?)
    }
}

impl Edge {
    fn of(start: u64, bytes: &[u8]) -> Edge {
        Edge { start, end: start + bytes.len() as u64, hash: XxHash3_128::oneshot(bytes) }
    }
}

/// A source that can be cancelled, and that keeps the first and last bytes it read. These are the bytes that
/// the pass has seen: a later read could return what another process has written over them meanwhile.
struct Watched<'a, R> {
    source: R,
    is_over: &'a AtomicBool,
    /// The number of bytes that were read.
    count: u64,
    head: Vec<u8>,
    /// The last bytes that were read, at least `TAIL_BYTES` of them if that many were read.
    tail: Vec<u8>,
}

impl<'a, R> Watched<'a, R> {
    fn new(source: R, is_over: &'a AtomicBool) -> Watched<'a, R> {
        Watched { source, is_over, count: 0, head: Vec::new(), tail: Vec::new() }
    }

    /// The edges of the file, which was read from byte `start` on. `None` if `start` is not 0 and no `head`
    /// is given.
    fn edges(&self, start: u64, head: Option<Edge>) -> Option<FileEnds> {
        let head = head.or_else(|| (start == 0).then(|| Edge::of(0, &self.head)))?;
        let kept = &self.tail[self.tail.len().saturating_sub(TAIL_BYTES)..];
        let tail_start = start + self.count - kept.len() as u64;
        Some(FileEnds { head, tail: Edge::of(tail_start, kept) })
    }

    fn keep(&mut self, bytes: &[u8]) {
        self.count += bytes.len() as u64;
        let missing = (HEAD_BYTES as usize).saturating_sub(self.head.len());
        self.head.extend(&bytes[..bytes.len().min(missing)]);
        self.tail.extend(&bytes[bytes.len().saturating_sub(TAIL_BYTES)..]);
        // Not trimmed on each read: so the total number of bytes that are moved stays proportional to that of
        // the bytes kept.
        if self.tail.len() > 2 * TAIL_BYTES {
            self.tail.drain(..self.tail.len() - TAIL_BYTES);
        }
    }
}

impl<R: Read> Read for Watched<'_, R> {
    fn read(&mut self, bytes: &mut [u8]) -> io::Result<usize> {
        if self.is_over.load(Ordering::Relaxed) {
            return Err(io::Error::other("the search for its steps was cancelled"));
        }
        let count = self.source.read(bytes)?;
        self.keep(&bytes[..count]);
        Ok(count)
    }
}

/// The steps, each with its count among the steps with the same number.
fn counted(found: Vec<FoundStep>) -> Vec<FileStep> {
    let mut counts: HashMap<Option<i64>, u32> = HashMap::new();
    let counted = found.into_iter().map(|found| {
        let count = counts.entry(found.number).or_insert(0);
        *count += 1;
        FileStep { count: *count, found }
    });
    counted.collect()
}

/// The name of a step without a number.
pub(super) const UNNUMBERED: &str = "unnumbered";

/// The index of some file with `n` steps.
#[cfg(test)]
pub(super) fn of_count(stamp: FileStamp, count: usize) -> StepIndex {
    let found = |number: usize| FoundStep {
        number: i64::try_from(number).ok(),
        head: [].into(),
        range: 0..1,
        lines_before: 0,
    };
    let kind = ProbedKind::Format(meniscus_formats::Format::LammpsDump);
    StepIndex::new(stamp, kind, (0..count).map(found).collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use meniscus_formats::Format;
    use std::fs::OpenOptions;
    use std::io::Write;
    use std::path::PathBuf;
    use std::time::{Duration, SystemTime};
    use std::{fs, iter};

    static GOES_ON: AtomicBool = AtomicBool::new(false);

    /// A step of a dump or of a trajectory, with this number of rows.
    fn step(kind: ProbedKind, number: usize, rows: usize) -> String {
        let mut text = match kind {
            ProbedKind::Format(Format::LammpsDump) => {
                format!("ITEM: TIMESTEP\n{number}\nITEM: NUMBER OF ATOMS\n{rows}\nITEM: ATOMS x y z\n")
            }
            _ => format!("{rows}\nstep {number}\n"),
        };
        let row = if kind == ProbedKind::Format(Format::LammpsDump) {
            "0.5 0.25 0.125\n"
        } else {
            "O 0.5 0.25 0.125\n"
        };
        text.extend(iter::repeat_n(row, rows));
        text
    }

    struct Growing {
        path: PathBuf,
        _folder: tempfile::TempDir,
    }

    impl Growing {
        fn new(name: &str) -> Growing {
            let folder = tempfile::tempdir().expect("a folder");
            Growing { path: folder.path().join(name), _folder: folder }
        }

        fn append(&self, text: &str) {
            let file = OpenOptions::new().create(true).append(true).open(&self.path);
            file.and_then(|mut file| file.write_all(text.as_bytes())).expect("appended");
        }

        fn indexed(&self, before: Option<&StepIndex>) -> StepIndex {
            index_steps(&self.path, before, &GOES_ON).expect("steps")
        }
    }

    fn found(contents: &StepIndex) -> Vec<(String, &FoundStep)> {
        contents.steps.iter().map(|step| (step.name(), &step.found)).collect()
    }

    #[test]
    fn appended_file_is_read_from_its_last_step_on() {
        for (kind, name) in [
            (ProbedKind::Format(Format::LammpsDump), "d.dump"),
            (ProbedKind::Format(Format::XyzAtoms), "d.xyz"),
        ] {
            let file = Growing::new(name);
            let cut = step(kind, 2, 2000);
            let (start, rest) = cut.split_at(cut.len() / 3);
            file.append(&step(kind, 0, 2000));
            file.append(&step(kind, 1, 2000));
            file.append(start);
            let first = file.indexed(None);
            assert_eq!((first.steps.len(), first.unchanged_since(&first.stamp)), (3, 3));
            file.append(rest);
            file.append(&step(kind, 3, 5));
            let second = file.indexed(Some(&first));
            assert_eq!(found(&second), found(&file.indexed(None)), "{name}");
            assert_eq!((second.steps.len(), second.unchanged_since(&first.stamp)), (4, 2), "{name}");
            file.append(&step(kind, 1, 1));
            let third = file.indexed(Some(&second));
            assert_eq!(found(&third), found(&file.indexed(None)), "{name}");
            let kept = [&first, &second, &third].map(|before| third.unchanged_since(&before.stamp));
            assert_eq!(kept, [2, 3, 5], "{name}");
            // The bytes before the last step are not read again: a step that begins there now is not found.
            let mut bytes = fs::read(&file.path).expect("there");
            let at = bytes.len() / 4;
            bytes[at..at + 10].fill(b'\n');
            bytes.extend(b"0\n\n");
            fs::write(&file.path, bytes).expect("written");
            assert!(file.indexed(Some(&third)).unchanged_since(&third.stamp) > 0, "{name}");
        }
    }

    #[test]
    fn rewritten_file_is_read_from_its_beginning() {
        let file = Growing::new("d.dump");
        let dump = |numbers: &[usize]| -> String {
            numbers.iter().map(|&number| step(ProbedKind::Format(Format::LammpsDump), number, 100)).collect()
        };
        file.append(&dump(&[10, 20]));
        let first = file.indexed(None);
        for (what, text) in [
            ("another beginning", dump(&[11, 20, 30])),
            ("another end", dump(&[10, 21, 30])),
            ("shorter", dump(&[10])),
            ("as long", dump(&[20, 10])),
            ("another kind", "1\n\nO 0 0 0\n".repeat(1000)),
        ] {
            fs::write(&file.path, &text).expect("written");
            // The file system's clock may not advance in the time that this takes.
            let later = SystemTime::now() + Duration::from_secs(1);
            File::options()
                .write(true)
                .open(&file.path)
                .and_then(|file| file.set_modified(later))
                .expect("set");
            let second = file.indexed(Some(&first));
            assert_eq!(found(&second), found(&file.indexed(None)), "{what}");
            assert_eq!(second.unchanged_since(&first.stamp), 0, "{what}");
        }
    }

    /// The edges come from the bytes in which the steps were found, not from those at the end of the pass.
    #[test]
    fn file_rewritten_during_a_pass_is_read_from_its_beginning() {
        let file = Growing::new("d.dump");
        let dump = |numbers: &[usize]| -> String {
            numbers.iter().map(|&number| step(ProbedKind::Format(Format::LammpsDump), number, 6000)).collect()
        };
        let (old, new) = (dump(&[10, 20]), dump(&[11, 21, 30]));
        for cut in ["ITEM: TIMESTEP\n10".len(), HEAD_BYTES as usize, old.len() / 2, old.len() - 1] {
            file.append(&old);
            let stamp = FileStamp::of(&fs::metadata(&file.path).expect("there"));
            // The bytes that a pass sees if the file is rewritten in place when it has read `cut` bytes.
            let seen = [&old.as_bytes()[..cut], &new.as_bytes()[cut..old.len()]].concat();
            let mut source = Watched::new(&*seen, &GOES_ON);
            let mut known = Vec::new();
            find_more_steps(
                ProbedKind::Format(Format::LammpsDump),
                BufReader::new(&mut source),
                &mut known,
                &meniscus_formats::Limits::default(),
            )
            .expect("steps");
            let mut first = StepIndex::new(stamp, ProbedKind::Format(Format::LammpsDump), known);
            first.edges = source.edges(0, None);
            fs::write(&file.path, &new).expect("written");
            let second = file.indexed(Some(&first));
            assert_eq!(found(&second), found(&file.indexed(None)), "{cut}");
            assert_eq!(second.unchanged_since(&first.stamp), 0, "{cut}");
            fs::write(&file.path, "").expect("emptied");
        }
    }

    #[test]
    fn edges_of_the_read_bytes_equal_those_of_the_file() {
        let file = Growing::new("d.dump");
        let bytes: Vec<u8> = (0..3 * TAIL_BYTES).map(|index| ((index * index) >> 7) as u8).collect();
        for (size, piece) in
            [(0, 1), (1, 1), (5000, 7), (TAIL_BYTES, 4096), (3 * TAIL_BYTES, 1 << 18), (150_000, 999)]
        {
            fs::write(&file.path, &bytes[..size]).expect("written");
            let mut source = Watched::new(&bytes[..size], &GOES_ON);
            io::copy(&mut BufReader::with_capacity(piece, &mut source), &mut io::sink()).expect("read");
            let edges = source.edges(0, None).expect("from the beginning");
            assert_eq!(edges.head, Edge::of(0, &bytes[..size.min(HEAD_BYTES as usize)]), "{size}");
            let tail_start = size.saturating_sub(TAIL_BYTES);
            assert_eq!(edges.tail, Edge::of(tail_start as u64, &bytes[tail_start..size]), "{size}");
            assert!(edges.are_in(&mut File::open(&file.path).expect("there")).expect("read"), "{size}");
            // A pass from a later position needs the known head.
            assert_eq!(source.edges(5, None), None);
            assert_eq!(source.edges(5, Some(edges.head)).map(|later| later.tail.end), Some(5 + size as u64));
        }
    }

    #[test]
    fn only_the_latest_states_are_kept() {
        let file = Growing::new("d.dump");
        file.append(&step(ProbedKind::Format(Format::LammpsDump), 0, 1));
        let mut all = vec![file.indexed(None)];
        for number in 1..=BEFORE_MAX + 3 {
            file.append(&step(ProbedKind::Format(Format::LammpsDump), number, 1));
            let next = file.indexed(all.last());
            all.push(next);
        }
        let last = all.last().expect("some");
        let kept: Vec<usize> = all.iter().map(|before| last.unchanged_since(&before.stamp)).collect();
        let expected: Vec<usize> = (0..all.len())
            .map(|index| if index < 3 { 0 } else { index + usize::from(index + 1 == all.len()) })
            .collect();
        assert_eq!(kept, expected);
    }

    #[test]
    fn pass_can_be_cancelled() {
        let is_over = AtomicBool::new(false);
        let mut source = Watched::new(io::repeat(b'x'), &is_over);
        let mut piece = [0; 8];
        source.read_exact(&mut piece).expect("it goes on");
        is_over.store(true, Ordering::Relaxed);
        let over = source.read_exact(&mut piece).expect_err("over").to_string();
        assert!(over.contains("was cancelled"), "{over}");
        let file = Growing::new("d.dump");
        file.append(&step(ProbedKind::Format(Format::LammpsDump), 0, 1));
        index_steps(&file.path, None, &is_over).expect_err("over");
    }
}
