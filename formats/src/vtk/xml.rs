//! VTK's XML files with points: `.vtp` (PolyData) and `.vtu` (UnstructuredGrid).
//!
//! ```text
//!   <VTKFile type="PolyData" byte_order="LittleEndian" header_type="UInt64" compressor="vtkZLibDataCompressor">
//!    <PolyData>
//!     <Piece NumberOfPoints="64" ..>                                 repeated
//!      <PointData> <DataArray type="Float32" Name="velocity" NumberOfComponents="3" format="appended" offset="0"/>
//!      <Points>    <DataArray type="Float32" NumberOfComponents="3" format="ascii"> 0.5 0.25 1 .. </DataArray>
//!      <Verts> ..                                                    cells: skipped; if a mesh is read, only
//!                                                                     Polys, Strips and Cells are used
//!    <AppendedData encoding="raw"> _.............................    bytes that are not XML
//!   </VTKFile>
//! ```
//!
//! The parser gets only the text before the appended data. A file is complete if it ends with the last tag.

use quick_xml::Reader;
use quick_xml::events::{BytesStart, Event};

use super::blocks::{ArrayDecoder, ArrayEncoding, ArrayForm, BlockCompression, DataArray, EncodedArray};
use super::{
    POLYGON, POLYGONS_NOTE, Points, TRIANGLE_STRIP, XML, add_cells, checked_count, integers, is_face,
    positions_of,
};
use crate::core::bytes::Endian;
use crate::core::data::{FileAttribute, FilePositions, MeshData, ParticleFrame};
use crate::core::error::{Error, Position, Result};
use crate::core::limits::Limits;
use crate::core::named_arrays::ParticlePart;
use crate::core::named_arrays::frame_of_pieces;
use crate::core::neighbor::Neighbor;
use crate::core::number::NumberType;
use crate::core::text::excerpt;
use crate::core::xml::{self, XmlEvent};

/// Reads the points of all pieces.
///
/// # Errors
///
/// [`Error::Truncated`] if the last tag is missing, [`Error::Invalid`] for malformed XML and for arrays of
/// the wrong size, [`Error::Unsupported`] for data sets that are not point sets, [`Error::TooLarge`] beyond
/// `limits`.
pub fn read(bytes: &[u8], limits: &Limits) -> Result<ParticleFrame> {
    let (pieces, notes) = read_pieces(bytes, limits)?;
    Ok(frame_of_pieces(pieces, notes))
}

/// Reads the points of each piece, and notes.
///
/// # Errors
/// Those of [`read`].
pub(crate) fn read_pieces(bytes: &[u8], limits: &Limits) -> Result<(Vec<ParticlePart>, Vec<String>)> {
    let (mut decoder, pieces, mut notes) = open(bytes, limits)?;
    let mut has_faces = pieces.iter().any(|piece| piece.poly_count > 0 || piece.strip_count > 0);
    for piece in &pieces {
        // Particles have no cells, or one for each.
        if ![0, piece.point_count].contains(&piece.cell_count) {
            // Points do not need the types of cells.
            let types = integers_of(piece, PieceSection::Cells, "types", piece.cell_count, &mut decoder);
            has_faces |= types.is_ok_and(|types| types.into_iter().any(is_face));
        }
    }
    if has_faces {
        notes.push(POLYGONS_NOTE.into());
    }
    let pieces: Vec<ParticlePart> =
        pieces.iter().map(|described| piece(described, &mut decoder, &mut notes)).collect::<Result<_>>()?;
    // A limit for each piece does not limit their total.
    checked_count(XML, pieces.iter().map(|piece| piece.positions.len() as u64).sum(), limits)?;
    Ok((pieces, notes))
}

/// The pieces of a file, the decoder of their arrays, and notes.
fn open<'a>(
    bytes: &'a [u8],
    limits: &'a Limits,
) -> Result<(ArrayDecoder<'a>, Vec<Described<'a>>, Vec<String>)> {
    xml::check_end(XML, bytes, "</VTKFile>")?;
    let (text, appended) = split_appended(bytes)?;
    let text = utf8(XML, text)?;
    let document = document(text, limits)?;
    let decoder = ArrayDecoder::new(document.encoding, appended, bytes.len() as u64, limits);
    Ok((decoder, document.pieces, document.notes))
}

pub(crate) fn utf8<'a>(format: &'static str, text: &'a [u8]) -> Result<&'a str> {
    std::str::from_utf8(text).map_err(|error| {
        Error::invalid(format, Position::Offset(error.valid_up_to() as u64), "expected UTF-8 text")
    })
}

/// Splits the file into text and appended data.
fn split_appended(bytes: &[u8]) -> Result<(&[u8], Option<EncodedArray<'_>>)> {
    const TAG: &[u8] = b"<AppendedData";
    let Some(at) = bytes.windows(TAG.len()).position(|window| window == TAG) else {
        return Ok((bytes, None));
    };
    let invalid = |what: &str| Error::invalid(XML, Position::Offset(at as u64), what);
    let tag_end = bytes[at..].iter().position(|&byte| byte == b'>').map(|length| at + length);
    let tag_end = tag_end.ok_or_else(|| invalid("expected `>` at the end of <AppendedData"))?;
    let tag = &bytes[at..tag_end];
    let mut start = tag_end + 1;
    start += bytes[start..].iter().take_while(|byte| byte.is_ascii_whitespace()).count();
    if bytes.get(start) != Some(&b'_') {
        return Err(invalid("expected `_` before the appended data"));
    }
    let is_base64 = tag.windows(6).any(|window| window == b"base64");
    let data = EncodedArray { bytes: &bytes[start + 1..], is_base64, offset: start as u64 + 1 };
    Ok((&bytes[..at], Some(data)))
}

/// Limit on the number of pieces of a file, and on the number of arrays in all pieces: each takes more memory
/// than the few bytes of text that describe it.
const PART_COUNT_MAX: usize = 1 << 16;

/// The parsed elements.
struct XmlDocument<'a> {
    encoding: ArrayEncoding,
    pieces: Vec<Described<'a>>,
    /// The number of arrays in all pieces.
    array_count: usize,
    notes: Vec<String>,
}

/// A piece whose data is not decoded yet.
struct Described<'a> {
    point_count: usize,
    /// Numbers of polygons and triangle strips of a PolyData, and of cells of an UnstructuredGrid.
    poly_count: usize,
    strip_count: usize,
    cell_count: usize,
    arrays: Vec<(PieceSection, DataArray<'a>)>,
}

impl<'a> Described<'a> {
    fn arrays_of(&self, section: PieceSection) -> impl Iterator<Item = &DataArray<'a>> {
        self.arrays.iter().filter(move |(found, _)| *found == section).map(|(_, array)| array)
    }
}

/// The part of a piece that contains an array.
#[derive(Clone, Copy, PartialEq, Eq)]
enum PieceSection {
    Points,
    PointData,
    Polys,
    Strips,
    Cells,
}

impl PieceSection {
    fn of(tag: &str) -> Option<PieceSection> {
        Some(match tag {
            "Points" => PieceSection::Points,
            "PointData" => PieceSection::PointData,
            "Polys" => PieceSection::Polys,
            "Strips" => PieceSection::Strips,
            "Cells" => PieceSection::Cells,
            _ => return None,
        })
    }
}

fn document<'a>(text: &'a str, limits: &Limits) -> Result<XmlDocument<'a>> {
    let mut document: Option<XmlDocument<'a>> = None;
    let mut section = None;
    let mut is_in_array = false;
    xml::parse(XML, text, |event, range| {
        let at = range.start;
        match event {
            XmlEvent::Start(name, tag) => match (name, &mut document, section) {
                ("VTKFile", ..) => document = Some(opened(tag, at)?),
                (_, None, _) => return Err(malformed(at, "expected <VTKFile>")),
                ("Piece", Some(document), _) if document.pieces.len() >= PART_COUNT_MAX => {
                    let what = format!("the file has more than {PART_COUNT_MAX} pieces, the limit");
                    return Err(Error::too_large(XML, what));
                }
                ("Piece", Some(document), _) => document.pieces.push(described(tag, at, limits)?),
                ("DataArray", Some(document), Some(section)) => {
                    take_array(tag, at, section, document, limits)?;
                    is_in_array = true;
                }
                (name, ..) => section = PieceSection::of(name).or(section),
            },
            XmlEvent::Text(text) if is_in_array && section.is_some() => {
                let pieces = document.iter_mut().flat_map(|document| document.pieces.last_mut());
                if let Some((_, array)) = pieces.flat_map(|piece| piece.arrays.last_mut()).next()
                    && array.content.is_empty()
                    && !text.trim_ascii().is_empty()
                {
                    (array.content, array.offset) = (text.as_bytes(), at);
                }
            }
            XmlEvent::End("DataArray") => is_in_array = false,
            XmlEvent::End(name) if PieceSection::of(name).is_some() => section = None,
            XmlEvent::End(_) | XmlEvent::Text(_) => {}
        }
        Ok(())
    })?;
    let document = document.ok_or_else(|| malformed(0, "expected <VTKFile>"))?;
    if document.pieces.is_empty() {
        Err(Error::invalid(XML, Position::File, "the file has no <Piece>"))
    } else {
        Ok(document)
    }
}

pub(super) fn malformed(at: u64, what: impl Into<String>) -> Error {
    Error::invalid(XML, Position::Offset(at), what)
}

/// What a data set of this type contains instead of particles.
pub(crate) fn neighbor_of_type(kind: &str) -> Option<Neighbor> {
    match kind {
        "PolyData" | "UnstructuredGrid" => None,
        // Collections (.pvd), parallel data sets (.pvtu and .pvtp) and composite ones (.vtm and the like).
        "Collection"
        | "PPolyData"
        | "PUnstructuredGrid"
        | "vtkMultiBlockDataSet"
        | "vtkMultiPieceDataSet"
        | "vtkPartitionedDataSet"
        | "vtkPartitionedDataSetCollection" => Some(Neighbor::Index),
        _ => Some(Neighbor::Grid),
    }
}

/// What a file with these first bytes contains instead of particles.
pub(crate) fn neighbor(head: &[u8]) -> Option<Neighbor> {
    let (text, _) = split_appended(head).unwrap_or((head, None));
    let text = text.utf8_chunks().next()?.valid();
    let mut reader = Reader::from_str(text);
    reader.config_mut().check_end_names = false;
    let mut has_types = false;
    loop {
        let tag = match reader.read_event().ok()? {
            Event::Start(tag) | Event::Empty(tag) => tag,
            Event::Eof => return None,
            _ => continue,
        };
        match tag.local_name().as_ref() {
            "VTKFile" => {
                let kind = attribute(&tag, "type", 0).ok()??;
                if let Some(neighbor) = neighbor_of_type(&kind) {
                    return Some(neighbor);
                }
                has_types = kind == "UnstructuredGrid";
            }
            "Piece" => {
                let count = |name: &str| attribute(&tag, name, 0).ok()??.trim().parse::<u64>().ok();
                let cells = count("NumberOfCells");
                let has_faces = if has_types {
                    // The types come after the points. Particles have no cells, one for each, or one for all.
                    cells > Some(1) && cells != count("NumberOfPoints")
                } else {
                    ["NumberOfPolys", "NumberOfStrips"].iter().any(|name| count(name) > Some(0))
                };
                return has_faces.then_some(Neighbor::Mesh);
            }
            _ => {}
        }
    }
}

/// Parses the first element, which describes the encoding of all data.
fn opened<'a>(tag: &BytesStart, at: u64) -> Result<XmlDocument<'a>> {
    let kind = attribute(tag, "type", at)?.unwrap_or_default();
    match neighbor_of_type(&kind) {
        None => {}
        Some(Neighbor::Index) => {
            let what = "this file only lists other files: use those (.vtp or .vtu)";
            return Err(Error::unsupported(XML, what));
        }
        Some(Neighbor::Grid | Neighbor::Mesh | Neighbor::Part | Neighbor::Table) => {
            let what = format!(
                "the data set has the type \"{}\", which is not supported: save it as PolyData (.vtp)",
                excerpt(&kind)
            );
            return Err(Error::unsupported(XML, what));
        }
    }
    let endian = match attribute(tag, "byte_order", at)?.as_deref() {
        None | Some("LittleEndian") => Endian::Little,
        Some("BigEndian") => Endian::Big,
        Some(other) => return Err(malformed(at, format!("unknown byte order \"{}\"", excerpt(other)))),
    };
    let header_word_bytes = match attribute(tag, "header_type", at)?.as_deref() {
        None | Some("UInt32") => 4,
        Some("UInt64") => 8,
        Some(other) => return Err(malformed(at, format!("unknown header type \"{}\"", excerpt(other)))),
    };
    let compression = match attribute(tag, "compressor", at)?.as_deref() {
        None | Some("") => None,
        Some("vtkZLibDataCompressor") => Some(BlockCompression::Zlib),
        Some("vtkLZ4DataCompressor") => Some(BlockCompression::Lz4),
        Some("vtkLZMADataCompressor") => Some(BlockCompression::Lzma),
        Some(other) => {
            let what = format!(
                "the data is compressed with {}: save it with zlib, LZ4 or LZMA, or uncompressed",
                excerpt(other)
            );
            return Err(Error::unsupported(XML, what));
        }
    };
    let encoding = ArrayEncoding { endian, header_word_bytes, compression };
    Ok(XmlDocument { encoding, pieces: Vec::new(), array_count: 0, notes: Vec::new() })
}

fn described<'a>(tag: &BytesStart, at: u64, limits: &Limits) -> Result<Described<'a>> {
    let count = |name: &str, what: &str, missing: &str| {
        let text = attribute(tag, name, at)?.unwrap_or_else(|| missing.to_owned());
        let count = text.trim().parse().map_err(|_| {
            malformed(at, format!("{name}: expected a number of {what}, found \"{}\"", excerpt(&text)))
        })?;
        checked_count(XML, count, limits)
    };
    Ok(Described {
        point_count: count("NumberOfPoints", "points", "")?,
        // A missing count means 0: a PolyData has only polygons and strips, an UnstructuredGrid only cells.
        poly_count: count("NumberOfPolys", "polygons", "0")?,
        strip_count: count("NumberOfStrips", "strips", "0")?,
        cell_count: count("NumberOfCells", "cells", "0")?,
        arrays: Vec::new(),
    })
}

fn take_array<'a>(
    tag: &BytesStart<'a>,
    at: u64,
    section: PieceSection,
    document: &mut XmlDocument<'a>,
    limits: &Limits,
) -> Result<()> {
    let Some(piece) = document.pieces.last_mut() else {
        return Err(malformed(at, "a point array is outside all pieces"));
    };
    document.array_count += 1;
    if piece.arrays.len() >= limits.attribute_count || document.array_count > PART_COUNT_MAX {
        let most = limits.attribute_count.min(PART_COUNT_MAX);
        return Err(Error::too_large(XML, format!("the file has more arrays than the limit of {most}")));
    }
    piece.arrays.push((section, data_array(tag, at)?));
    Ok(())
}

fn data_array<'a>(tag: &BytesStart, at: u64) -> Result<DataArray<'a>> {
    let name = attribute(tag, "Name", at)?.unwrap_or_default();
    let invalid = |what: String| malformed(at, format!("the array `{}` has {what}", excerpt(&name)));
    let arity = match attribute(tag, "NumberOfComponents", at)? {
        None => 1,
        Some(text) => {
            let wrong = |_| invalid(format!("\"{}\" components, which is not a number", excerpt(&text)));
            text.trim().parse().map_err(wrong)?
        }
    };
    let form = match attribute(tag, "format", at)?.as_deref() {
        None | Some("ascii") => ArrayForm::Ascii,
        Some("binary") => ArrayForm::Binary,
        Some("appended") => {
            let offset = attribute(tag, "offset", at)?.unwrap_or_default();
            let wrong = |_| invalid(format!("the offset \"{}\", which is not a number", excerpt(&offset)));
            ArrayForm::Appended(offset.trim().parse().map_err(wrong)?)
        }
        Some(other) => return Err(invalid(format!("the unknown format \"{}\"", excerpt(other)))),
    };
    let number = NumberType::named(&attribute(tag, "type", at)?.unwrap_or_default());
    Ok(DataArray { name, number, arity, form, content: &[], offset: at })
}

fn attribute(tag: &BytesStart, name: &str, at: u64) -> Result<Option<String>> {
    xml::attribute(XML, tag, name, at)
}

fn piece(described: &Described, decoder: &mut ArrayDecoder, notes: &mut Vec<String>) -> Result<ParticlePart> {
    let count = described.point_count;
    if count == 0 {
        return Ok(ParticlePart::default());
    }
    let positions = points_of(described, decoder)?;
    let mut arrays = Vec::new();
    for array in described.arrays_of(PieceSection::PointData) {
        let (Some(number), 1..) = (array.number, array.arity) else {
            notes.push(format!("skipped the array `{}`: it is not numeric", excerpt(&array.name)));
            continue;
        };
        let values = decoder.values(array, number, count)?;
        arrays.push(FileAttribute::new(array.name.clone(), array.arity, values));
    }
    Ok(ParticlePart { positions, arrays })
}

/// The positions of the points of a piece.
fn points_of(described: &Described, decoder: &mut ArrayDecoder) -> Result<FilePositions> {
    let no_points = || Error::invalid(XML, Position::File, "a piece has no array of points");
    let points = described.arrays_of(PieceSection::Points).last().ok_or_else(no_points)?;
    let number = points
        .number
        .ok_or_else(|| malformed(points.offset, "the array of points has a type that is not numeric"))?;
    if points.arity != 3 {
        let what = format!("the array of points has {} components per point; expected 3", points.arity);
        return Err(malformed(points.offset, what));
    }
    positions_of(XML, decoder.values(points, number, described.point_count)?)
}

// Reads the polygons of a `.vtp`, and the flat cells of a `.vtu`, as a mesh.

/// Whether the first piece of a VTK XML file has polygons, by the beginning of the file.
pub fn holds_polys(bytes: &[u8]) -> bool {
    const PIECE_BYTES: usize = 1 << 20; // the description of the first piece is in here
    let head = String::from_utf8_lossy(&bytes[..bytes.len().min(PIECE_BYTES)]);
    let count = head
        .split("NumberOfPolys=")
        .nth(1)
        .and_then(|rest| rest.get(1..)?.split(['"', '\'']).next()?.parse().ok());
    count.is_some_and(|count: u64| count > 0)
}

/// Reads the points and the polygons of all pieces, without normals. Polygons with more than three corners
/// become triangle fans. A file without polygons gives a mesh without triangles.
///
/// # Errors
///
/// Those of [`super::read_xml`]; [`Error::Invalid`] for polygons with missing points, [`Error::Unsupported`]
/// for volumetric cells.
pub fn read_mesh(bytes: &[u8], limits: &Limits) -> Result<MeshData> {
    let (mut decoder, pieces, _) = open(bytes, limits)?;
    let mut mesh = MeshData::default();
    for piece in &pieces {
        let points = Points { first: mesh.positions.len() as u64, count: piece.point_count as u64 };
        if piece.point_count > 0 {
            mesh.positions.extend(points_of(piece, &mut decoder)?.into_f64());
        }
        checked_count(XML, mesh.positions.len() as u64, limits)?;
        for (section, count, kind) in [
            (PieceSection::Polys, piece.poly_count, Some(POLYGON)),
            (PieceSection::Strips, piece.strip_count, Some(TRIANGLE_STRIP)),
            (PieceSection::Cells, piece.cell_count, None),
        ] {
            if count == 0 {
                continue;
            }
            let mut integers = |name: &str, count| integers_of(piece, section, name, count, &mut decoder);
            let ends = integers("offsets", count)?;
            let corner_count = ends.last().copied().unwrap_or_default();
            let corner_count = usize::try_from(corner_count).map_err(|_| {
                let what = format!("the cells have {corner_count} corners, too many");
                Error::invalid(XML, Position::File, what)
            })?;
            let corners = integers("connectivity", corner_count)?;
            let types = if kind.is_none() { integers("types", count)? } else { Vec::new() };
            let type_of = |index: usize| kind.unwrap_or_else(|| types.get(index).copied().unwrap_or(0));
            add_cells(XML, (&ends, &corners), type_of, points, &mut mesh.triangles)?;
        }
    }
    Ok(mesh)
}

/// The `count` numbers of an array that describes cells.
fn integers_of(
    piece: &Described,
    section: PieceSection,
    name: &str,
    count: usize,
    decoder: &mut ArrayDecoder,
) -> Result<Vec<i64>> {
    let is_it = |array: &&DataArray| array.name.eq_ignore_ascii_case(name) && array.arity == 1;
    let array = piece
        .arrays_of(section)
        .find(is_it)
        .ok_or_else(|| Error::invalid(XML, Position::File, format!("the cells have no `{name}` array")))?;
    let no_integers = || malformed(array.offset, format!("the values of `{name}` are not integers"));
    let values = decoder.values(array, array.number.ok_or_else(no_integers)?, count)?;
    integers(values).ok_or_else(no_integers)
}
