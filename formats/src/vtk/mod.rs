//! VTK files: the legacy format, the XML formats `.vtp` and `.vtu`, and the files that list such files.
//!
//! All contain points, cells and data, in several pieces and encodings. Particles are the points, with the
//! arrays that have a value for each point. Cells are skipped when particles are read. When a mesh is read,
//! the flat cells become its triangles. Meshes are written as `.vtp`.
//!
//! The layouts were derived from files of VTK, meshio, PyVista and SPlisHSPlasH.

mod blocks;
pub(crate) mod legacy;
mod write;
pub(crate) mod xml;

use quick_xml::Reader;
use quick_xml::events::Event;

pub use legacy::{read as read_legacy, read_mesh as read_legacy_mesh};
pub use write::{attribute_notes, particle_notes, write_mesh, write_particles};
pub(crate) use xml::neighbor as xml_neighbor;
pub use xml::{holds_polys, read as read_xml, read_mesh};

use crate::core::batches::ReadAt;
use crate::core::data::{FilePositions, Values};
use crate::core::error::{Error, Position, Result};
use crate::core::limits::Limits;
use crate::core::neighbor::Neighbor;
use crate::core::number;
use crate::core::options::WriteOption;
use crate::core::provenance::from_strings;
use crate::core::row::{
    Content, FormatRow, Integrity, MeshEncoder, MeshWriter, OutputRow, ParticleReader, ParticleWriter,
};
use legacy::size_of_type;
use write::ends_as_written;

/// The formats' names in errors.
const LEGACY: &str = "legacy VTK";
const XML: &str = "VTK XML";

/// The row of the legacy format in the table of formats.
pub(crate) static LEGACY_ROW: FormatRow = FormatRow {
    signatures: &[b"# vtk DataFile"],
    beginnings: &[b"# vtk DataFile Version "],
    particles: Some(ParticleReader::new(read_legacy)),
    read_mesh: Some(|bytes, limits, _| read_legacy_mesh(bytes, limits)),
    ..FormatRow::new(LEGACY, &["vtk"])
};

/// The row of the XML formats in the table of formats.
pub(crate) static ROW: OutputRow = OutputRow {
    format: FormatRow {
        particles: Some(ParticleReader::needs_reading(read_xml)),
        read_mesh: Some(|bytes, limits, _| read_mesh(bytes, limits)),
        ..FormatRow::new(XML, &["vtp", "vtu"])
    },
    help: "VTK PolyData, for ParaView",
    content: Content::Mesh(MeshWriter {
        attribute_notes,
        ..MeshWriter::new(MeshEncoder::Stream(write_mesh))
    }),
    write_particles: Some(ParticleWriter { write: write_particles, notes: particle_notes }),
    has_attributes: true,
    options: &[WriteOption::Quads],
    read_provenance: |head| Ok(from_strings(field_strings(head)?)),
    integrity: Integrity::Tail(ends_as_written),
};

// Joins the pieces of a data set into one frame.

/// The note for files that also contain a mesh.
pub const POLYGONS_NOTE: &str = "the file also has polygons, which are ignored: only its points are read";

/// Converts the number of points to a length, within the limits.
fn checked_count(format: &'static str, count: u64, limits: &Limits) -> Result<usize> {
    limits.check_particles(format, count)?;
    usize::try_from(count)
        .map_err(|_| Error::too_large(format, format!("the file has {count} points, too many")))
}

/// Converts values to positions.
fn positions_of(format: &'static str, values: Values) -> Result<FilePositions> {
    let no_numbers =
        || Error::invalid(format, Position::File, "the coordinates of the points are not numbers");
    number::positions(values).ok_or_else(no_numbers)
}

// Converts VTK cells to triangles.
//
//   connectivity   0 1 2   2 1 3 4   ..      the corners of all cells
//   offsets            3         7   ..      the end of each cell
//   types          5       9         ..      the type of each cell; Polys and Strips have one type for all

/// VTK's number for the cell type of filled polygons.
const POLYGON: i64 = 7;

/// VTK's number for the cell type of triangle strips.
const TRIANGLE_STRIP: i64 = 6;

/// Whether cells of this type are faces, or have faces: not points, lines or empty cells.
fn is_face(kind: i64) -> bool {
    !matches!(kind, 0..=4 | 21)
}

/// Converts integers of any width; `None` if the values are not integers.
fn integers(values: Values) -> Option<Vec<i64>> {
    match values {
        Values::U8(values) => Some(values.into_iter().map(i64::from).collect()),
        Values::I32(values) => Some(values.into_iter().map(i64::from).collect()),
        Values::I64(values) => Some(values),
        Values::F32(_) | Values::F64(_) | Values::Strings { .. } => None,
    }
}

/// The points that cells refer to: `count` points, the first of which is vertex `first` of the mesh.
#[derive(Clone, Copy)]
struct Points {
    first: u64,
    count: u64,
}

/// Adds the triangles of cells. `ends` has the end of each cell in `corners`. Polygons with more than three
/// corners become triangle fans; points and lines are skipped.
///
/// # Errors
/// [`Error::Invalid`] for cells with missing points, [`Error::Unsupported`] for volumetric cells.
fn add_cells(
    format: &'static str,
    (ends, corners): (&[i64], &[i64]),
    type_of: impl Fn(usize) -> i64,
    points: Points,
    triangles: &mut Vec<[u32; 3]>,
) -> Result<()> {
    let invalid = |what: String| Error::invalid(format, Position::File, what);
    let vertex = |corner: i64| {
        let corner = u64::try_from(corner).ok().filter(|&corner| corner < points.count);
        corner.and_then(|corner| u32::try_from(points.first + corner).ok())
    };
    let mut start = 0;
    for (index, &end) in ends.iter().enumerate() {
        let cell = usize::try_from(end).ok().and_then(|end| Some((corners.get(start..end)?, end)));
        let (cell, end) = cell.ok_or_else(|| {
            invalid(format!("a cell ends at corner {end}, but there are only {} corners", corners.len()))
        })?;
        start = end;
        let mut add = |triangle: [i64; 3]| {
            let [Some(a), Some(b), Some(c)] = triangle.map(vertex) else {
                return Err(invalid(format!("a cell refers to a point beyond the {} points", points.count)));
            };
            triangles.push([a, b, c]);
            Ok(())
        };
        match (type_of(index), cell) {
            (kind, _) if !is_face(kind) => {}
            (5 | POLYGON | 9, &[first, ref rest @ ..]) => {
                rest.windows(2).try_for_each(|pair| add([first, pair[0], pair[1]]))?;
            }
            (TRIANGLE_STRIP, strip) => {
                for (index, three) in strip.windows(3).enumerate() {
                    let [a, b] = if index % 2 == 0 { [three[0], three[1]] } else { [three[1], three[0]] };
                    add([a, b, three[2]])?;
                }
            }
            // The corners of a pixel (VTK's axis-aligned rectangle) are stored row by row.
            (8, &[a, b, c, d]) => [[a, b, d], [a, d, c]].into_iter().try_for_each(add)?,
            (5 | POLYGON | 8 | 9, _) => {
                return Err(invalid(format!("a cell of type {} has {} corners", type_of(index), cell.len())));
            }
            (other, _) => {
                let what = format!(
                    "the file has a cell of type {other}, which is not a flat polygon: save only the surface"
                );
                return Err(Error::unsupported(format, what));
            }
        }
    }
    Ok(())
}

// Reads the strings in the field data of an XML file, which contain the provenance of this crate's files.

/// Names and strings of all arrays with a single string, as far as the head of the file contains them.
pub(crate) fn field_strings(head: &[u8]) -> Result<Vec<(String, String)>> {
    let text = match std::str::from_utf8(head) {
        Ok(text) => text,
        // The head can end in the middle of a character, or contain the start of the appended data.
        Err(error) => std::str::from_utf8(&head[..error.valid_up_to()]).unwrap_or_default(),
    };
    let mut reader = Reader::from_str(text);
    reader.config_mut().check_end_names = false;
    let (mut found, mut name, mut is_vtk) = (Vec::new(), None, false);
    // An error means the end of the head, or of the XML text.
    while let Ok(event) = reader.read_event() {
        match event {
            Event::Start(tag) if tag.local_name().as_ref() == "VTKFile" => is_vtk = true,
            Event::Start(tag) if tag.local_name().as_ref() == "Array" => {
                let value = tag.try_get_attribute("Name").ok().flatten();
                let value = value
                    .and_then(|value| Some(quick_xml::escape::unescape(&value.value).ok()?.into_owned()));
                name = value;
            }
            Event::Text(text) => {
                let string = name.take().zip(string_of(&text));
                found.extend(string);
            }
            Event::End(tag) => match tag.local_name().as_ref() {
                "FieldData" => break,
                "Array" => name = None,
                _ => {}
            },
            Event::Eof => break,
            _ => {}
        }
    }
    if is_vtk { Ok(found) } else { Err(Error::invalid(XML, Position::File, "expected <VTKFile>")) }
}

/// Decodes a single string from its byte codes.
fn string_of(codes: &str) -> Option<String> {
    let bytes: Option<Vec<u8>> = codes.split_ascii_whitespace().map(|code| code.parse().ok()).collect();
    let mut bytes = bytes?;
    (bytes.pop()? == 0 && !bytes.contains(&0)).then_some(())?;
    String::from_utf8(bytes).ok()
}

// Recognises VTK files that have no particles, from a few of their bytes.
//
// The legacy format has its cells after the points, so the points are skipped. In a text they must be read,
// up to a limit.

/// How much of a file is read. If there are no faces in it, the file is taken for particles.
const READ_BYTES_MAX: u64 = 16 << 20;

/// The number of cells whose types are examined.
const TYPES_MAX: u64 = 1 << 10;

/// The number of bytes that are read at once.
const WINDOW_BYTES: usize = 64 << 10;

/// What a legacy file contains instead of particles.
pub(crate) fn legacy_neighbor(file: &dyn ReadAt) -> Option<Neighbor> {
    let size = file.size_bytes().ok()?;
    let mut scan =
        LegacyScan { file, size, at: 0, window: Vec::new(), window_at: 0, readable_bytes: READ_BYTES_MAX };
    scan.line()?;
    scan.line()?;
    let is_binary = scan.line()?.trim_ascii().eq_ignore_ascii_case("BINARY");
    while let Some(line) = scan.keyword_line(is_binary) {
        let words: Vec<&str> = line.split_ascii_whitespace().collect();
        let word = |index: usize| words.get(index).copied().unwrap_or_default();
        let number = |index: usize| word(index).parse::<u64>().ok();
        let mut skipped_bytes = 0;
        match &*word(0).to_ascii_uppercase() {
            "DATASET" => match &*word(1).to_ascii_uppercase() {
                "POLYDATA" | "UNSTRUCTURED_GRID" => {}
                _ => return Some(Neighbor::Grid),
            },
            "POINTS" => skipped_bytes = number(1)?.saturating_mul(3).saturating_mul(size_of_type(word(2))?),
            "METADATA" => while !scan.line()?.trim_ascii().is_empty() {},
            "POLYGONS" | "TRIANGLE_STRIPS" if number(2)? > 0 => return Some(Neighbor::Mesh),
            "VERTICES" | "LINES" | "POLYGONS" | "TRIANGLE_STRIPS" | "CELLS" if is_binary => {
                skipped_bytes = scan.cell_bytes(number(1)?, number(2)?)?;
            }
            "VERTICES" | "LINES" | "POLYGONS" | "TRIANGLE_STRIPS" | "CELLS" | "OFFSETS" | "CONNECTIVITY" => {}
            "CELL_TYPES" => {
                let has_faces = scan.types(number(1)?, is_binary)?.into_iter().any(is_face);
                return has_faces.then_some(Neighbor::Mesh);
            }
            _ => return None,
        }
        if is_binary {
            scan.at = scan.at.saturating_add(skipped_bytes);
        }
    }
    None
}

/// The position in a file, and a piece of the file.
struct LegacyScan<'a> {
    file: &'a dyn ReadAt,
    size: u64,
    at: u64,
    window: Vec<u8>,
    window_at: u64,
    /// The number of bytes that may still be read.
    readable_bytes: u64,
}

impl LegacyScan<'_> {
    /// The bytes from the position on, at least `length` if the file has as many; `None` beyond the end of
    /// the file or the limit.
    fn bytes(&mut self, length: usize) -> Option<&[u8]> {
        let left = self.size.checked_sub(self.at)?;
        let start = self.at.checked_sub(self.window_at).and_then(|start| usize::try_from(start).ok());
        let known = start.and_then(|start| self.window.get(start..)).map_or(0, <[u8]>::len);
        if (known as u64) < left.min(length as u64) {
            let length = left.min(WINDOW_BYTES as u64);
            self.readable_bytes = self.readable_bytes.checked_sub(length)?;
            self.window.resize(usize::try_from(length).ok()?, 0);
            self.file.read_exact_at(&mut self.window, self.at).ok()?;
            self.window_at = self.at;
        }
        self.window.get(usize::try_from(self.at - self.window_at).ok()?..)
    }

    /// The next line; `None` at the end of the file, and if it is too long.
    fn line(&mut self) -> Option<String> {
        let end = |bytes: &[u8]| bytes.iter().position(|&byte| byte == b'\n');
        let length = match end(self.bytes(1)?) {
            Some(length) => length,
            None => end(self.bytes(WINDOW_BYTES)?)?,
        };
        let line = String::from_utf8_lossy(&self.bytes(length)?[..length]).into_owned();
        self.at += length as u64 + 1;
        Some(line)
    }

    /// The next line that begins with a keyword. In a binary file it is the next that is not blank; in a
    /// text, the numbers before it are skipped.
    fn keyword_line(&mut self, is_binary: bool) -> Option<String> {
        loop {
            let line = self.line()?;
            // Not-a-number and infinity are numbers as well.
            let is_keyword = line.starts_with(|c: char| c.is_ascii_uppercase() && !matches!(c, 'N' | 'I'));
            if is_keyword {
                return Some(line);
            }
            if is_binary && !line.trim_ascii().is_empty() {
                return None;
            }
        }
    }

    /// The size of the cells of a section in a binary file: `count` cells of `size` 32-bit numbers together
    /// or, since version 5, two arrays with these numbers of integers.
    fn cell_bytes(&mut self, count: u64, size: u64) -> Option<u64> {
        if !self.bytes(b"OFFSETS".len())?.starts_with(b"OFFSETS") {
            return Some(size.saturating_mul(4));
        }
        let offsets = self.line()?;
        let size_of = |line: &str| size_of_type(line.split_ascii_whitespace().nth(1)?);
        self.at = self.at.saturating_add(count.saturating_mul(size_of(&offsets)?));
        let connectivity = self.keyword_line(true)?;
        Some(size.saturating_mul(size_of(&connectivity)?))
    }

    /// The types of the first cells.
    fn types(&mut self, count: u64, is_binary: bool) -> Option<Vec<i64>> {
        let count = usize::try_from(count.min(TYPES_MAX)).ok()?;
        let bytes = self.bytes(8 * count)?;
        if is_binary {
            let types = bytes.as_chunks().0.iter().take(count);
            return Some(types.map(|bytes| i32::from_be_bytes(*bytes).into()).collect());
        }
        let words = bytes.split(u8::is_ascii_whitespace).filter(|word| !word.is_empty());
        words.take(count).map(|word| std::str::from_utf8(word).ok()?.parse().ok()).collect()
    }
}
