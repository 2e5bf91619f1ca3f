//! Files of ParaView that list others: the files of each time, and the pieces of a frame.
//!
//! ```text
//!   run.pvd              <Collection> <DataSet timestep="0.5" part="0" file="dam_0001.pvtu"/> ..
//!   dam.vtk.series       {"file-series-version": "1.0", "files": [{"name": "dam_0001.vtk", "time": 0.5}, ..]}
//!   dam_0001.pvtu        <PUnstructuredGrid> .. <Piece Source="dam_0001_0.vtu"/> ..       and .pvtp
//!   dam.vtm              <vtkMultiBlockDataSet> <Block ..> <DataSet file="dam/dam_0.vtp"/> ..
//!                        and the same with other names: .vtpd, .vtpc
//! ```
//!
//! The files of one time are joined to a frame. They may be lists themselves, of files relative to their own
//! folder. Frames have the order in which their times appear first, and are numbered from 0.

use std::collections::{HashMap, HashSet};

use serde::Deserialize;

use crate::core::batches::read as read_bytes;
use crate::core::container::{
    ContainerFile, ContainerFrames, ContainerReader, ReadFrame, Sample, folder_of, further_path,
};
use crate::core::data::{FileAttribute, ParticleFrame, Values};
use crate::core::error::{Error, Position, Result};
use crate::core::limits::Limits;
use crate::core::named_arrays::ParticlePart;
use crate::core::named_arrays::frame_of_pieces;
use crate::core::neighbor::Neighbor;
use crate::core::row::{FormatRow, ParticleReader};
use crate::core::text::excerpt;
use crate::core::xml::{XmlEvent, attribute, check_end, parse};
use crate::read_particles;
use crate::table::Format;
use crate::table::probe::{ProbedKind, probe};
use crate::vtk::xml::{neighbor, neighbor_of_type, utf8};
use crate::vtk::{POLYGONS_NOTE, legacy, xml};

/// The format's name in errors.
const INDEX: &str = "ParaView index";

/// The row of the files that list others in the table of formats.
pub(crate) static INDEX_ROW: FormatRow = FormatRow {
    particles: Some(ParticleReader::container(READER)),
    ..FormatRow::new(INDEX, INDEX_EXTENSIONS)
};

/// The extensions of the files that list others. ParaView makes those of series from that of the files.
const INDEX_EXTENSIONS: &[&str] = &[
    "pvd",
    "pvtu",
    "pvtp",
    "vtpd",
    "vtpc",
    "vtm",
    "vtk.series",
    "vtp.series",
    "vtu.series",
    "pvtp.series",
    "pvtu.series",
    "series",
];

/// The reader of the frames.
const READER: ContainerReader = ContainerReader::new(|container, limits| {
    let listed = frames_of(&all_bytes(container)?, "", limits)?;
    let sample = |(number, frame): (i64, &ListedFrame)| Sample { number, time: frame.time };
    let samples = (0..).zip(&listed).map(sample).collect();
    let files = listed.iter().map(|frame| frame.paths.clone()).collect();
    let mut frames = ContainerFrames::new(samples, ListedFrames(listed));
    frames.files = Some(files);
    Ok(frames)
});

/// The frames that a container lists.
#[derive(Debug)]
struct ListedFrames(Vec<ListedFrame>);

/// The largest list: more than a million files.
const INDEX_BYTES_MAX: u64 = 256 << 20;

/// The largest number of files of a frame, lists among them.
const FILE_COUNT_MAX: usize = 1 << 16;

/// How deep lists may be nested: a list of times, of blocks, of pieces, and one more.
const DEPTH_MAX: usize = 4;

/// The files of one time.
#[derive(Debug, PartialEq)]
struct ListedFrame {
    time: Option<f64>,
    /// Relative to the folder of the container; at least one.
    paths: Vec<String>,
}

fn all_bytes(container: &ContainerFile) -> Result<Vec<u8>> {
    let size = container.file.size_bytes()?;
    if size > INDEX_BYTES_MAX {
        let what = format!("the file has {size} bytes, more than the limit of {INDEX_BYTES_MAX}");
        return Err(Error::too_large(INDEX, what));
    }
    read_bytes(container.file, 0..size)
}

/// The frames that a file in `folder` lists.
fn frames_of(bytes: &[u8], folder: &str, limits: &Limits) -> Result<Vec<ListedFrame>> {
    let text = bytes.strip_prefix(b"\xef\xbb\xbf").unwrap_or(bytes).trim_ascii_start();
    let listed = if text.starts_with(b"{") { listed_in_series(text)? } else { listed_in_xml(text)? };
    let mut frames: Vec<ListedFrame> = Vec::new();
    let mut index_of = HashMap::new();
    let mut seen = HashSet::new();
    for (time, named) in listed {
        let path = further_path(INDEX, folder, &named)?;
        // Of −0 and 0, the sum with 0 is 0.
        let key = time.map(|time| (time + 0.0).to_bits());
        if !index_of.contains_key(&key) {
            limits.check_step(INDEX, frames.len())?;
        }
        let index = *index_of.entry(key).or_insert(frames.len());
        if index == frames.len() {
            frames.push(ListedFrame { time, paths: Vec::new() });
        }
        if seen.insert((index, path.clone())) {
            frames[index].paths.push(path);
        }
    }
    Ok(frames)
}

/// A time, and the path of a file as stated.
type Listed = (Option<f64>, String);

/// The list in a `.vtk.series`.
#[derive(Deserialize)]
struct Series {
    files: Vec<SeriesFile>,
}

#[derive(Deserialize)]
struct SeriesFile {
    name: String,
    time: Option<f64>,
}

fn listed_in_series(text: &[u8]) -> Result<Vec<Listed>> {
    let series: Series = serde_json::from_slice(text).map_err(|error| {
        let position = Position::Line(error.line() as u64);
        if error.is_eof() {
            Error::truncated(INDEX, position, "the file ends too early")
        } else {
            Error::invalid(INDEX, position, error.to_string())
        }
    })?;
    // Without times, each file is a frame.
    let files = series.files.into_iter().zip(0u32..);
    Ok(files.map(|(file, index)| (file.time.or(Some(index.into())), file.name)).collect())
}

fn listed_in_xml(text: &[u8]) -> Result<Vec<Listed>> {
    check_end(INDEX, text, "</VTKFile>")?;
    let malformed = |at, what: String| Error::invalid(INDEX, Position::Offset(at), what);
    let (mut has_root, mut has_times) = (false, false);
    let mut listed = Vec::new();
    parse(INDEX, utf8(INDEX, text)?, |event, range| {
        let XmlEvent::Start(name, tag) = event else { return Ok(()) };
        let at = range.start;
        let stated = |name| attribute(INDEX, tag, name, at);
        match name {
            "VTKFile" => {
                let kind = stated("type")?.unwrap_or_default();
                if neighbor_of_type(&kind) != Some(Neighbor::Index) {
                    let what = format!("expected a list of files, found \"{}\"", excerpt(&kind));
                    return Err(malformed(at, what));
                }
                (has_root, has_times) = (true, kind == "Collection");
            }
            // Blocks and pieces without files are empty.
            "DataSet" | "Piece" if has_root => {
                let file = stated(if name == "Piece" { "Source" } else { "file" })?;
                let Some(file) = file.filter(|file| !file.is_empty()) else { return Ok(()) };
                let time = if has_times { stated("timestep")? } else { None };
                let time = time.map(|text| match text.trim().parse() {
                    Ok(time) if f64::is_finite(time) => Ok(time),
                    _ => Err(malformed(at, format!("the time \"{}\" is not a number", excerpt(&text)))),
                });
                listed.push((time.transpose()?, file));
            }
            _ => {}
        }
        Ok(())
    })?;
    if has_root { Ok(listed) } else { Err(malformed(text.len() as u64, "expected <VTKFile>".to_owned())) }
}

// Reads the files of a frame.

impl ReadFrame for ListedFrames {
    fn read(&self, container: &ContainerFile, index: usize, limits: &Limits) -> Result<ParticleFrame> {
        let no_frame = || Error::unsupported(INDEX, "it lists no files yet");
        let ListedFrame { paths, .. } = self.0.get(index).ok_or_else(no_frame)?;
        let mut parts = FrameParts {
            container,
            limits,
            is_alone: paths.len() == 1,
            file_count: 0,
            point_count: 0,
            particles: Vec::new(),
            meshes: Vec::new(),
            other: None,
            notes: Vec::new(),
        };
        paths.iter().try_for_each(|path| parts.add(path, 0))?;
        Ok(parts.into_frame())
    }
}

/// The files of a frame that were read so far.
struct FrameParts<'a> {
    container: &'a ContainerFile<'a>,
    limits: &'a Limits,
    /// Whether the frame has a single file, as far as is known.
    is_alone: bool,
    file_count: usize,
    point_count: u64,
    particles: Vec<ParticlePart>,
    /// The files whose points are the corners of faces.
    meshes: Vec<(String, Vec<ParticlePart>)>,
    /// The only file, in another format.
    other: Option<ParticleFrame>,
    notes: Vec<String>,
}

impl FrameParts<'_> {
    /// Reads a file, or the files that it lists.
    fn add(&mut self, path: &str, depth: usize) -> Result<()> {
        self.file_count += 1;
        if self.file_count > FILE_COUNT_MAX {
            let what = format!("a frame has more than {FILE_COUNT_MAX} files, the limit");
            return Err(Error::too_large(INDEX, what));
        }
        let bytes = self.container.read_further(INDEX, path)?;
        let bytes = &bytes[..];
        let named = |error: Error| error.in_file(path);
        let (pieces, mut notes) = match probe(bytes, path).kind {
            ProbedKind::Format(Format::VtkIndex) => {
                let paths = self.listed(bytes, path, depth).map_err(named)?;
                self.is_alone &= paths.len() == 1;
                return paths.iter().try_for_each(|path| self.add(path, depth + 1));
            }
            ProbedKind::Format(Format::Vtp) if !self.is_alone && neighbor(bytes) == Some(Neighbor::Grid) => {
                self.notes.push(format!("skipped {}: it is a grid, not particles", excerpt(path)));
                return Ok(());
            }
            ProbedKind::Format(Format::Vtp) => xml::read_pieces(bytes, self.limits).map_err(named)?,
            ProbedKind::Format(Format::VtkLegacy) => {
                let (piece, notes) = legacy::read_piece(bytes, self.limits).map_err(named)?;
                (vec![piece], notes)
            }
            _ if self.is_alone => {
                self.other = Some(read_particles(bytes, path, self.limits).map_err(named)?);
                return Ok(());
            }
            kind => {
                let what = format!("this is {kind}, and only files of VTK are joined to a frame");
                return Err(named(Error::unsupported(INDEX, what)));
            }
        };
        let count: u64 = pieces.iter().map(|piece| piece.positions.len() as u64).sum();
        self.point_count = self.point_count.saturating_add(count);
        self.limits.check_particles(INDEX, self.point_count)?;
        let has_faces = notes.iter().any(|note| note == POLYGONS_NOTE);
        notes.retain(|note| note != POLYGONS_NOTE && !self.notes.contains(note));
        self.notes.append(&mut notes);
        if has_faces {
            self.meshes.push((path.to_owned(), pieces));
        } else {
            self.particles.extend(pieces);
        }
        Ok(())
    }

    /// The paths in a file that is itself listed.
    fn listed(&self, bytes: &[u8], path: &str, depth: usize) -> Result<Vec<String>> {
        if depth >= DEPTH_MAX {
            return Err(Error::unsupported(INDEX, "the lists of files are nested too deep"));
        }
        let mut frames = frames_of(bytes, folder_of(path), self.limits)?;
        if frames.len() > 1 {
            return Err(Error::unsupported(INDEX, "it lists files of several times, within one time"));
        }
        Ok(frames.pop().map_or_else(Vec::new, |frame| frame.paths))
    }

    /// Joins all points. Meshes are left out, unless there is nothing else.
    fn into_frame(self) -> ParticleFrame {
        let FrameParts { mut particles, meshes, other, mut notes, .. } = self;
        if let Some(frame) = other {
            return frame;
        }
        let has_particles = particles.iter().any(|piece| !piece.positions.is_empty());
        if has_particles {
            let skipped =
                |(path, _): &(String, _)| format!("skipped {}: it is a mesh, not particles", excerpt(path));
            notes.extend(meshes.iter().map(skipped));
        } else if !meshes.is_empty() {
            notes.push(POLYGONS_NOTE.to_owned());
            particles.extend(meshes.into_iter().flat_map(|(_, pieces)| pieces));
        }
        without_ghosts(frame_of_pieces(particles, notes))
    }
}

/// The array of VTK that marks the points of a piece that belong to another one.
const GHOSTS: &str = "vtkGhostType";

/// The bits of duplicate and of hidden points.
const GHOST_BITS: u8 = 3;

/// Leaves out the points that are copies of those of other pieces.
fn without_ghosts(mut frame: ParticleFrame) -> ParticleFrame {
    let ghosts = frame.attributes.iter().find(|attribute| attribute.name == GHOSTS && attribute.arity == 1);
    let Some(FileAttribute { values: Values::U8(ghosts), .. }) = ghosts else { return frame };
    let mask: Vec<bool> = ghosts.iter().map(|ghost| ghost & GHOST_BITS == 0).collect();
    let count = mask.iter().filter(|is_kept| !**is_kept).count();
    if count > 0 {
        frame.retain(&mask);
        frame.notes.push(format!("left out {count} points that other pieces have, according to `{GHOSTS}`"));
    }
    frame
}
