//! Combines the `.glb`, `.abc` or `.usdc` files of all frames, and the points beside them, into one file.
//!
//! ```text
//!   out/dam.0012.glb  out/dam.0013.glb  ..  ──▶  dam.glb     plays in a browser, and in Blender
//!                                           ──▶  dam.abc     one mesh with time samples
//!   out/dam.0012.spray.usdc  ..             ──▶  dam.abc     points with time samples
//! ```
//!
//! Frames are read only from their files. So a sequence file is the same whether one process converted its
//! frames, many machines did, or they were converted on different days; and the memory for writing it does
//! not depend on the number of frames. An `.abc` or `.usdc` of a frame is converted to a `.glb` in memory. The points
//! of a frame are read first for what must be known of all frames, and again when they are written.
//!
//! The number of a frame determines when it is shown. In an `.abc`, as in the scenes of 3D programs, frame n is at
//! n / fps seconds. In a `.glb`, which has seconds and no numbers, the greatest common divisor of the differences between numbers is one frame of
//! the animation: a simulation that writes every hundredth step plays like one that writes every step. In
//! place of a missing frame, the frame before it is shown.

use std::cell::RefCell;
use std::fmt;
use std::fs::File;
use std::io::{self, BufReader, BufWriter, Cursor, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use meniscus_formats::gltf::{self, GlbFrame, SEQUENCE_FRAMES, SequenceFrame};
use meniscus_formats::{
    OutputFormat, ParticleFrame, PointFormat, PointsSummary, SequencePoints, becomes_glb, read_provenance,
    to_glb, write_abc_sequence,
};

use crate::pipeline::files::atomic_write::{sync_while, write_atomically};
use crate::pipeline::files::identity::are_same_file;
use crate::pipeline::files::open::{open_regular, read_regular};
use crate::pipeline::files::stamp::FileStamp;
use crate::pipeline::memory::reading_limits;
use crate::pipeline::records::content::{SprayOfMesh, spray_of};
use crate::pipeline::records::provenance::{GENERATOR_AND_VERSION, HEAD_BYTES};
use crate::surface::words::pluralize;

/// A format of sequence files.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SequenceFormat {
    /// Binary glTF with an animation.
    Glb,
    /// Alembic.
    Abc,
}

impl SequenceFormat {
    /// The format for the extension of a path.
    pub fn of(path: &Path) -> Option<SequenceFormat> {
        let extension = path.extension()?;
        let formats = [SequenceFormat::Glb, SequenceFormat::Abc];
        formats.into_iter().find(|format| extension.eq_ignore_ascii_case(format.output().extension()))
    }

    fn output(self) -> OutputFormat {
        match self {
            SequenceFormat::Glb => OutputFormat::Glb,
            SequenceFormat::Abc => OutputFormat::Abc,
        }
    }
}

/// The `.glb`, `.abc` or `.usdc` of a frame, and its number.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SequenceSource {
    /// Its path.
    pub path: PathBuf,
    /// The frame's number, if it has one.
    pub number: Option<i64>,
}

/// The result of writing a sequence file.
#[derive(Debug, Default)]
pub struct SequenceReport {
    /// The number of frames in the file.
    pub frame_count: usize,
    /// The number of points in all frames; `None` if the file has none.
    pub point_count: Option<usize>,
    /// The size of the file.
    pub size_bytes: u64,
    /// The files of frames that could not be read, and why. Without its points, a frame is left out.
    pub left_out: Vec<(PathBuf, String)>,
    /// Warnings about a sequence file that was written.
    pub notes: Vec<String>,
}

/// Why no sequence file or stage could be written.
#[derive(Debug)]
pub struct SequenceError {
    pub(super) path: PathBuf,
    pub(super) what: String,
}

impl fmt::Display for SequenceError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}: {}", self.path.display(), self.what)
    }
}

impl std::error::Error for SequenceError {}

/// Combines the frames, in this order, into the file at `path`, which is written atomically and shows `fps` frames per
/// second. Frames that cannot be read are skipped and reported.
///
/// # Errors
/// When no frame can be read, the format cannot hold all frames, a frame is written meanwhile, the path is
/// that of [another file](check_sequence_path), or the file cannot be written.
pub fn write_sequence_file(
    path: &Path,
    format: SequenceFormat,
    sources: &[SequenceSource],
    fps: f64,
) -> Result<SequenceReport, SequenceError> {
    let fail = |what: String| SequenceError { path: path.to_owned(), what };
    if sources.iter().any(|source| are_same_file(&source.path, path)) {
        return Err(fail("the sequence file would replace one of its frames".to_owned()));
    }
    check_sequence_path(path)?;
    let (source_frames, left_out) = read_frames(sources, format);
    if source_frames.is_empty() {
        return Err(no_frame(&left_out, path));
    }
    let mut report = SequenceReport { left_out, ..SequenceReport::default() };
    report.notes.extend(points_notes(&source_frames));
    let numbers: Vec<Option<i64>> = source_frames.iter().map(|frame| frame.source.number).collect();
    let numbers = increasing(&numbers);
    let codes = match format {
        SequenceFormat::Glb => in_steps(&numbers),
        SequenceFormat::Abc => numbers.clone(),
    };
    let (mut frames, mut opened, mut files_of_points) = (Vec::new(), Vec::new(), Vec::new());
    for (SourceFrame { source, stamp, file, points, notes }, code) in source_frames.into_iter().zip(codes) {
        let new = notes.into_iter().filter(|note| !report.notes.contains(note)).collect::<Vec<_>>();
        report.notes.extend(new);
        let name = source.path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
        frames.push(SequenceFrame { name, code, file });
        opened.push((source.path.clone(), stamp));
        files_of_points.push(match points {
            FramePoints::Read(file) => Some(file),
            FramePoints::None | FramePoints::Missing | FramePoints::Unread => None,
        });
    }
    let mesh_files = opened.clone();
    opened.extend(files_of_points.iter().flatten().map(|file| (file.path.clone(), file.stamp)));
    let points = sequence_points(&files_of_points);
    report.point_count = points.as_ref().map(SequencePoints::total);
    let provenance = provenance(&numbers, fps, report.point_count);
    let last = RefCell::new(None);
    let open = |index: usize| FrameReader::open(&mesh_files[index].0, index, &last);
    let points = points.as_ref();
    let mut write = |out: &mut BufWriter<&File>| -> meniscus_formats::Result<()> {
        report.notes.extend(match format {
            SequenceFormat::Glb => {
                gltf::write_sequence(&frames, fps, &provenance, open, out)?;
                Vec::new()
            }
            SequenceFormat::Abc => write_abc_sequence(&frames, points, fps, &provenance, open, out)?,
        });
        Ok(refuse_written(&opened)?)
    };
    let written = write_atomically(path, |out| sync_while(out.get_ref(), || write(out)));
    written.map_err(|error| fail(error.to_string()))?;
    report.frame_count = frames.len();
    report.size_bytes = path.metadata().map_err(|error| fail(error.to_string()))?.len();
    Ok(report)
}

/// Refuses a path where a file exists that is not a sequence file of this program: it may be a frame, a stage,
/// or a file of the user.
///
/// # Errors
/// If there is such a file.
pub fn check_sequence_path(path: &Path) -> Result<(), SequenceError> {
    if !path.exists() || is_sequence_file(path) {
        return Ok(());
    }
    let what = "exists, and is not a sequence file of meniscus: choose another name".to_owned();
    Err(SequenceError { path: path.to_owned(), what })
}

/// A frame, and the stamp of its file when it was opened.
struct SourceFrame<'a> {
    source: &'a SequenceSource,
    stamp: FileStamp,
    file: GlbFrame,
    points: FramePoints,
    /// Notes on attributes that are lost.
    notes: Vec<String>,
}

/// The points beside the mesh of a frame.
enum FramePoints {
    /// It was made without them.
    None,
    /// There is no file with them.
    Missing,
    /// The format of the sequence cannot have them.
    Unread,
    Read(PointsFile),
}

/// The file with the points of a frame.
struct PointsFile {
    path: PathBuf,
    format: PointFormat,
    /// When it was opened.
    stamp: FileStamp,
    summary: PointsSummary,
}

/// The `.abc` or `.usdc` of a frame, converted to `.glb`.
struct ConvertedFrame {
    /// The index of the frame.
    index: usize,
    glb: GlbBytes,
    /// Notes on attributes that are lost.
    notes: Vec<String>,
}

/// Shares a `.glb` without a copy: as an `Arc<[u8]>`, it would be in memory twice when it is made.
#[derive(Clone)]
struct GlbBytes(Arc<Vec<u8>>);

impl AsRef<[u8]> for GlbBytes {
    fn as_ref(&self) -> &[u8] {
        &self.0
    }
}

/// Reads a frame as `.glb`.
enum FrameReader {
    File(BufReader<File>),
    Converted(Cursor<GlbBytes>),
}

impl FrameReader {
    /// Opens the file of a frame. An `.abc` or `.usdc` is converted to `.glb`, and the result is kept in
    /// `last`, because the file is opened again for each of its arrays.
    fn open(path: &Path, index: usize, last: &RefCell<Option<ConvertedFrame>>) -> io::Result<FrameReader> {
        if let Some(frame) = &*last.borrow()
            && frame.index == index
        {
            return Ok(FrameReader::Converted(Cursor::new(frame.glb.clone())));
        }
        let mut file = open_regular(path)?;
        let mut bytes = Vec::new();
        Read::by_ref(&mut file).take(MAGIC_BYTES).read_to_end(&mut bytes)?;
        if !becomes_glb(&bytes) {
            file.rewind()?;
            return Ok(FrameReader::File(BufReader::new(file)));
        }
        last.take();
        file.read_to_end(&mut bytes)?;
        let (glb, notes) = to_glb(bytes, &reading_limits()).map_err(io::Error::other)?;
        let glb = GlbBytes(Arc::new(glb));
        last.replace(Some(ConvertedFrame { index, glb: glb.clone(), notes }));
        Ok(FrameReader::Converted(Cursor::new(glb)))
    }
}

/// Enough bytes to recognise an `.abc` or a `.usdc`.
const MAGIC_BYTES: u64 = 8;

impl Read for FrameReader {
    fn read(&mut self, bytes: &mut [u8]) -> io::Result<usize> {
        match self {
            FrameReader::File(file) => file.read(bytes),
            FrameReader::Converted(glb) => glb.read(bytes),
        }
    }
}

impl Seek for FrameReader {
    fn seek(&mut self, to: SeekFrom) -> io::Result<u64> {
        match self {
            FrameReader::File(file) => file.seek(to),
            FrameReader::Converted(glb) => glb.seek(to),
        }
    }
}

/// Opens the file of a frame for a sequence in `format`, and reads its points.
///
/// # Errors
/// The file that cannot be read, and why.
fn read_frame(
    source: &SequenceSource,
    format: SequenceFormat,
) -> Result<SourceFrame<'_>, (PathBuf, meniscus_formats::Error)> {
    let converted = RefCell::new(None);
    let open = || -> meniscus_formats::Result<(FileStamp, GlbFrame)> {
        let stamp = FileStamp::of(&open_regular(&source.path)?.metadata()?);
        Ok((stamp, GlbFrame::read(&mut FrameReader::open(&source.path, 0, &converted)?)?))
    };
    let (stamp, file) = open().map_err(|error| (source.path.clone(), error))?;
    let notes = converted.into_inner().map(|frame: ConvertedFrame| frame.notes).unwrap_or_default();
    let points = match spray_of(&source.path, &file.provenance()) {
        SprayOfMesh::None => FramePoints::None,
        SprayOfMesh::Missing if format == SequenceFormat::Glb => FramePoints::None,
        SprayOfMesh::Missing => FramePoints::Missing,
        _ if format == SequenceFormat::Glb => FramePoints::Unread,
        SprayOfMesh::Other(path) => {
            return Err((path, meniscus_formats::Error::unsupported("", OTHER_POINTS)));
        }
        SprayOfMesh::Found(path, format) => match PointsFile::open(path.clone(), format) {
            Ok(file) => FramePoints::Read(file),
            Err(error) => return Err((path, error)),
        },
    };
    Ok(SourceFrame { source, stamp, file, points, notes })
}

const OTHER_POINTS: &str = "these are not the points of the mesh: another run or another program wrote them, or the \
                            file is damaged; convert the frame again";

impl PointsFile {
    fn open(path: PathBuf, format: PointFormat) -> meniscus_formats::Result<PointsFile> {
        let stamp = FileStamp::of(&open_regular(&path)?.metadata()?);
        let summary = PointsSummary::of(&read_points(&path, format)?)?;
        Ok(PointsFile { path, format, stamp, summary })
    }
}

fn read_points(path: &Path, format: PointFormat) -> meniscus_formats::Result<ParticleFrame> {
    format.read(&read_regular(path)?, &reading_limits())
}

/// The points of a sequence, whose frames have these files; `None` if no frame has one.
fn sequence_points(files: &[Option<PointsFile>]) -> Option<SequencePoints<'_>> {
    files.iter().any(Option::is_some).then(|| {
        let summary = |file: &Option<PointsFile>| file.as_ref().map(|file| file.summary.clone());
        let summaries = files.iter().map(|file| summary(file).unwrap_or_default()).collect();
        let read = |index: usize| match files.get(index).and_then(Option::as_ref) {
            Some(PointsFile { path, format, .. }) => read_points(path, *format)
                .map_err(|error| io::Error::other(format!("{}: {error}", path.display())).into()),
            None => Ok(ParticleFrame::default()),
        };
        SequencePoints::new(summaries, Box::new(read))
    })
}

/// Notes on points that the sequence does not have although its frames were made with them.
fn points_notes(frames: &[SourceFrame]) -> Option<String> {
    if frames.iter().any(|frame| matches!(frame.points, FramePoints::Unread)) {
        return Some(
            "the points beside the frames (--spray) are missing: a sequence in .glb has only meshes; for both, write \
             .abc, or a stage (--stage)"
                .to_owned(),
        );
    }
    let mut missing = frames.iter().filter(|frame| matches!(frame.points, FramePoints::Missing));
    let first = missing.next()?.source.path.display();
    let others = match missing.count() {
        0 => String::new(),
        count => format!(" and {}", pluralize(count, "other frame")),
    };
    Some(format!("the points (--spray) of {first}{others} are missing: there is no file with them"))
}

/// Opens the frames. Returns those that can be read, and the files of the others that cannot, each with the reason.
fn read_frames(
    sources: &[SequenceSource],
    format: SequenceFormat,
) -> (Vec<SourceFrame<'_>>, Vec<(PathBuf, String)>) {
    let (mut source_frames, mut left_out) = (Vec::new(), Vec::new());
    for source in sources {
        match read_frame(source, format) {
            Ok(frame) => source_frames.push(frame),
            Err((path, error)) => left_out.push((path, error.to_string())),
        }
    }
    (source_frames, left_out)
}

/// Fails if the file of a frame was written since it was opened. The data of a frame are read long after
/// their layout, so the file must not change in between.
fn refuse_written(opened: &[(PathBuf, FileStamp)]) -> io::Result<()> {
    for (path, stamp) in opened {
        if FileStamp::of_path(path)? != *stamp {
            return Err(io::Error::other(format!("{} was written while it was read", path.display())));
        }
    }
    Ok(())
}

/// The error if no frame can be read, with the reason for the first.
fn no_frame(left_out: &[(PathBuf, String)], shot: &Path) -> SequenceError {
    let nothing = "there are no frames for the sequence file";
    match left_out {
        [] => SequenceError { path: shot.to_owned(), what: nothing.to_owned() },
        [(path, why)] => SequenceError { path: path.clone(), what: format!("{why}; {nothing}") },
        [(path, why), others @ ..] => {
            let others = pluralize(others.len(), "other frame");
            let what = format!("{why}; {others} cannot be read either: {nothing}");
            SequenceError { path: path.clone(), what }
        }
    }
}

/// Whether a file is a sequence file of this program, according to its provenance.
pub fn is_sequence_file(path: &Path) -> bool {
    let format = SequenceFormat::of(path).map_or(OutputFormat::Glb, SequenceFormat::output);
    let recorded =
        open_regular(path).ok().and_then(|file| read_provenance(format, file.take(HEAD_BYTES)).ok());
    recorded.is_some_and(|pairs| pairs.iter().any(|(name, _)| name == SEQUENCE_FRAMES))
}

/// The provenance of the sequence file; the meshes have the provenance of their frames.
fn provenance(numbers: &[i64], fps: f64, point_count: Option<usize>) -> Vec<(String, String)> {
    let pair = |name: &str, value: String| (name.to_owned(), value);
    let number = |number: Option<&i64>| number.copied().unwrap_or_default().to_string();
    let mut pairs = vec![
        pair("generator", GENERATOR_AND_VERSION.to_owned()),
        pair(SEQUENCE_FRAMES, numbers.len().to_string()),
        pair("first", number(numbers.first())),
        pair("last", number(numbers.last())),
        pair("fps", fps.to_string()),
    ];
    pairs.extend(point_count.map(|count| pair(SEQUENCE_POINTS, count.to_string())));
    pairs
}

/// The name in provenance whose value is the number of points in all frames of a sequence.
pub const SEQUENCE_POINTS: &str = "points";

/// The numbers of the frames. If some have none, or they do not increase, frames are counted from 1.
pub(super) fn increasing(numbers: &[Option<i64>]) -> Vec<i64> {
    let known = numbers.iter().copied().collect::<Option<Vec<i64>>>();
    let increasing = known.filter(|known| known.windows(2).all(|pair| pair[0] < pair[1]));
    increasing.unwrap_or_else(|| (1..).take(numbers.len()).collect())
}

/// The positions in the animation of frames with these increasing numbers. The [common step](common_step) of
/// the numbers becomes one frame of the animation. If it is 1, the positions are the numbers themselves.
/// Otherwise they are the numbers divided by it or, if that leaves a remainder, counted from the first number
/// on.
fn in_steps(numbers: &[i64]) -> Vec<i64> {
    let step = common_step(numbers);
    let Some(&first) = numbers.first() else { return Vec::new() };
    let divided = first.unsigned_abs().is_multiple_of(step).then(|| first.unsigned_abs() / step);
    let start = divided.map_or(first, |steps| 0i64.saturating_add_unsigned(steps) * first.signum());
    numbers.iter().map(|number| start.saturating_add_unsigned(number.abs_diff(first) / step)).collect()
}

/// The greatest common divisor of the differences between these ascending numbers; 1 if there are no
/// differences.
pub fn common_step(numbers: &[i64]) -> u64 {
    fn common_divisor(a: u64, b: u64) -> u64 {
        if b == 0 { a } else { common_divisor(b, a % b) }
    }
    numbers.windows(2).map(|pair| pair[1].abs_diff(pair[0])).fold(0, common_divisor).max(1)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn step_divides_all_differences() {
        for (numbers, step) in [
            (&[][..], 1),
            (&[5], 1),
            (&[0, 100, 300], 100),
            (&[1, 3, 5], 2),
            (&[1, 3, 6], 1),
            (&[-4, 2, 8], 6),
            (&[i64::MIN, i64::MAX], u64::MAX),
        ] {
            assert_eq!(common_step(numbers), step, "{numbers:?}");
        }
    }

    #[test]
    fn greatest_common_step_becomes_one_frame() {
        assert_eq!(in_steps(&[1001, 1002, 1004]), [1001, 1002, 1004]);
        assert_eq!(in_steps(&[0, 1, 2]), [0, 1, 2]);
        assert_eq!(in_steps(&[1000, 2000, 4000]), [1, 2, 4]);
        assert_eq!(in_steps(&[1, 3, 5]), [1, 2, 3]);
        assert_eq!(in_steps(&[12]), [12]);
        assert_eq!(in_steps(&[i64::MAX - 1, i64::MAX]), [i64::MAX - 1, i64::MAX]);
        assert_eq!(in_steps(&[-3, -2, 0]), [-3, -2, 0]);
        assert_eq!(in_steps(&[-20, 0, 10]), [-2, 0, 1]);
        assert_eq!(in_steps(&[-5, 0, 10]), [-1, 0, 2]);
        assert_eq!(in_steps(&[i64::MIN, 0, i64::MAX - 1]).len(), 3);
        assert_eq!(in_steps(&[]), [0; 0]);
    }

    #[test]
    fn frames_without_increasing_numbers_are_counted_from_1() {
        let of = |numbers: &[i64]| increasing(&numbers.iter().copied().map(Some).collect::<Vec<_>>());
        assert_eq!(of(&[0, 100, 200]), [0, 100, 200]);
        assert_eq!(of(&[-2, -1, 0, 1]), [-2, -1, 0, 1]);
        assert_eq!(of(&[3, 2, 9]), [1, 2, 3]);
        assert_eq!(of(&[3, 3]), [1, 2]);
        assert_eq!(increasing(&[Some(7), None]), [1, 2]);
        assert_eq!(of(&[]), [0; 0]);
    }

    #[test]
    fn frame_written_meanwhile_is_an_error() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("dam.1.glb");
        std::fs::write(&path, b"one").expect("written");
        let opened = [(path.clone(), FileStamp::of_path(&path).expect("there"))];
        assert!(refuse_written(&opened).is_ok());
        std::fs::write(&path, b"other").expect("written");
        let error = refuse_written(&opened).expect_err("it was written");
        assert!(error.to_string().ends_with("dam.1.glb was written while it was read"), "{error}");
    }
}
