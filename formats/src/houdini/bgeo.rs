//! Classic BGEO, version 5: the geometry format of Houdini before 12, which SPlisHSPlasH, partio and
//! splashsurf still write.
//!
//! Big-endian throughout, without padding:
//!
//! ```text
//!   0   "Bgeo" 'V' i32 5
//!   9   i32 × 8: points, primitives, point groups, primitive groups,
//!                point, vertex, primitive and detail attributes
//!   41  point attribute dictionary, for each: name, size, type, defaults or strings
//!       point records, for each: x y z w (f32), then `size` words for each attribute
//!       (primitives, detail attributes, groups: not read)
//!       00 ff
//! ```
//!
//! All particle data comes before the first primitive, so reading stops after the points. Houdini 12 and
//! later write another format with the same extension, which starts with `7f 4e 53 4a 62` or `[`. Files are
//! often gzip-compressed as a whole, even if their name does not show it; the caller must decompress them
//! first.
//!
//! The layout was derived from files of the named programs and from partio's own reader.

use std::io::Write;
use std::sync::Arc;

use crate::core::batches::{self, ReadAt, Records};
use crate::core::bytes::{Cursor, Endian};
use crate::core::columns::{roles_of, with_role};
use crate::core::data::{AttributeRole, FileAttribute, FilePositions, ParticleFrame, Values};
use crate::core::error::{Error, Position, Result};
use crate::core::limits::Limits;
use crate::core::number::{NumberType, divided};
use crate::core::records::{RecordLayout, Slots, Target, gather};
use crate::core::row::{Completeness, FormatRow, HeadCheck, ParticleReader};
use crate::core::times::may_be_time;
use crate::core::vertex_attributes;

/// The format's name in errors.
const FORMAT: &str = "classic BGEO";

/// The first five bytes.
const MAGIC: &[u8; 5] = b"BgeoV";

/// The only version of the classic format found in use.
const VERSION: i32 = 5;

/// The last two bytes of a file: no further section (00), end of the file (ff).
const TRAILER: [u8; 2] = [0x00, 0xff];

/// Words of a point record before its attributes: x, y, z, w.
const POSITION_WORDS: usize = 4;

/// The nearest 32-bit float; values beyond the range become infinite.
#[expect(clippy::cast_possible_truncation, reason = "the format has 32-bit floats")]
fn narrow(value: f64) -> f32 {
    value as f32
}

/// The row of the format in the table of formats.
pub(crate) static ROW: FormatRow = FormatRow {
    signatures: &[b"Bgeo"],
    beginnings: &[MAGIC],
    particles: Some(ParticleReader {
        completeness,
        find_records: Some(find_records),
        ..ParticleReader::new(read)
    }),
    ..FormatRow::new(FORMAT, &["bgeo", "bhclassic"])
};

/// The completeness of a file according to its header.
fn completeness(head: &[u8], file_bytes: u64) -> Result<HeadCheck> {
    let header = header(head)?;
    Ok(HeadCheck::Known(match header.point_count {
        0 => Completeness::Unknown,
        _ if header.expected_bytes_is_exact => {
            Completeness::of_exact_size(header.expected_bytes(), file_bytes)
        }
        _ => Completeness::of_minimum_size(header.expected_bytes(), file_bytes, Completeness::NeedsReading),
    }))
}

// The header of classic BGEO: counts and the dictionary of point attributes, up to the first point.

/// Everything before the first point.
#[derive(Clone, Debug, PartialEq)]
pub struct BgeoHeader {
    /// Number of points, each of which is read as a particle.
    pub point_count: usize,
    /// Number of primitives, which are not read. A particle system is a primitive.
    pub primitive_count: usize,
    /// The point attributes in file order.
    pub attributes: Vec<AttributeHeader>,
    /// Offset of the first point, in bytes from the start of the file.
    pub points_offset: usize,
    /// Bytes from one point to the next.
    pub record_bytes: usize,
    /// Whether a complete file has exactly [`expected_bytes`](Self::expected_bytes): if only points follow.
    pub expected_bytes_is_exact: bool,
}

impl BgeoHeader {
    /// The minimum size in bytes of a complete, uncompressed file.
    pub fn expected_bytes(&self) -> u64 {
        self.points_end().saturating_add(TRAILER.len() as u64)
    }

    /// Offset of the end of the points in a complete file, in bytes.
    fn points_end(&self) -> u64 {
        self.points_bytes().saturating_add(self.points_offset as u64)
    }

    /// Size of all points, in bytes.
    fn points_bytes(&self) -> u64 {
        (self.point_count as u64).saturating_mul(self.record_bytes as u64)
    }
}

/// A point attribute.
#[derive(Clone, Debug, PartialEq)]
pub struct AttributeHeader {
    /// The name in the file.
    pub name: String,
    /// Number of values per point.
    pub arity: usize,
    /// The type of the values.
    pub kind: AttributeKind,
}

/// The type of an attribute; every value takes four bytes.
#[derive(Clone, Debug, PartialEq)]
pub enum AttributeKind {
    /// 32-bit floats.
    Float,
    /// 32-bit integers.
    Int,
    /// 32-bit floats that rotate with the object, such as a velocity.
    Vector,
    /// Indices into these strings.
    Strings(Vec<String>),
}

/// Reads the header. The points themselves may be missing.
///
/// # Errors
///
/// [`Error::Unsupported`] for another version or an unsupported attribute type, [`Error::Truncated`] if the
/// header ends too early, [`Error::Invalid`] if it is inconsistent.
pub fn header(bytes: &[u8]) -> Result<BgeoHeader> {
    header_within(bytes, &Limits::default())
}

/// [`header`], with limits.
pub(crate) fn header_within(bytes: &[u8], limits: &Limits) -> Result<BgeoHeader> {
    let mut cursor = Cursor::new(FORMAT, Endian::Big, bytes, 0);
    if cursor.take(MAGIC.len(), "the signature")? != MAGIC {
        return Err(Error::invalid(FORMAT, Position::Offset(0), "expected the signature BgeoV"));
    }
    let version = cursor.i32("the version")?;
    if version != VERSION {
        return Err(Error::unsupported(
            FORMAT,
            format!("the file has version {version}; only version 5 is supported"),
        ));
    }
    let point_count = read_count(&mut cursor, "points")?;
    let primitive_count = read_count(&mut cursor, "primitives")?;
    let point_group_count = read_count(&mut cursor, "point groups")?;
    let primitive_group_count = read_count(&mut cursor, "primitive groups")?;
    let attribute_count = read_count(&mut cursor, "point attributes")?;
    let vertex_attribute_count = read_count(&mut cursor, "vertex attributes")?;
    let primitive_attribute_count = read_count(&mut cursor, "primitive attributes")?;
    let detail_attribute_count = read_count(&mut cursor, "detail attributes")?;
    limits.check_particles(FORMAT, point_count as u64)?;
    let attributes = read_dictionary(&mut cursor, attribute_count, limits)?;

    let words: usize = POSITION_WORDS + attributes.iter().map(|attribute| attribute.arity).sum::<usize>();
    let counts_after = [
        primitive_count,
        point_group_count,
        primitive_group_count,
        vertex_attribute_count,
        primitive_attribute_count,
        detail_attribute_count,
    ];
    Ok(BgeoHeader {
        point_count,
        primitive_count,
        attributes,
        points_offset: cursor.at(),
        record_bytes: 4 * words,
        expected_bytes_is_exact: counts_after == [0; 6],
    })
}

fn read_dictionary(cursor: &mut Cursor, count: usize, limits: &Limits) -> Result<Vec<AttributeHeader>> {
    const ENTRY_BYTES_MIN: usize = 8; // length of an empty name, size, type
    limits.check_attributes(FORMAT, count, "point attributes")?;
    require(cursor, count * ENTRY_BYTES_MIN, "the point attribute dictionary")?;
    (0..count).map(|_| read_dictionary_entry(cursor)).collect()
}

fn read_dictionary_entry(cursor: &mut Cursor) -> Result<AttributeHeader> {
    let name = read_string(cursor, "an attribute name")?;
    let arity = usize::from(cursor.u16("the size of an attribute")?);
    let type_offset = cursor.at() as u64;
    let kind = match cursor.i32("the type of an attribute")? {
        0 => AttributeKind::Float,
        1 => AttributeKind::Int,
        5 => AttributeKind::Vector,
        4 => AttributeKind::Strings(read_string_table(cursor)?),
        kind @ (2 | 3) => {
            let word = if kind == 2 { "fixed-length string" } else { "mixed" };
            let what = format!(
                "the point attribute {name:?} has the unsupported type {word}: \
                 remove it before exporting"
            );
            return Err(Error::unsupported(FORMAT, what));
        }
        kind => {
            let what = format!(
                "expected the type of the point attribute {name:?} to be 0 (float), 1 (int), \
                 4 (strings) or 5 (vector), found {kind}"
            );
            return Err(Error::invalid(FORMAT, Position::Offset(type_offset), what));
        }
    };
    if !matches!(kind, AttributeKind::Strings(_)) {
        cursor.take(4 * arity, "the defaults of an attribute")?;
    }
    Ok(AttributeHeader { name, arity, kind })
}

fn read_string_table(cursor: &mut Cursor) -> Result<Vec<String>> {
    const STRING_BYTES_MIN: usize = 2; // its length
    let count = read_count(cursor, "strings")?;
    require(cursor, count.saturating_mul(STRING_BYTES_MIN), "the strings of an attribute")?;
    (0..count).map(|_| read_string(cursor, "a string")).collect()
}

/// Fails unless at least `byte_count` bytes remain.
fn require(cursor: &Cursor, byte_count: usize, what: &str) -> Result<()> {
    if byte_count <= cursor.remaining() {
        return Ok(());
    }
    Err(cursor.truncated(format!(
        "expected at least {byte_count} bytes of {what}, but {} remain",
        cursor.remaining()
    )))
}

/// Reads a count of `items`, which must not be negative.
fn read_count(cursor: &mut Cursor, items: &str) -> Result<usize> {
    let offset = cursor.at() as u64;
    let count = cursor.i32(items)?;
    usize::try_from(count).map_err(|_| {
        let what = format!("expected the number of {items} to be at least 0, found {count}");
        Error::invalid(FORMAT, Position::Offset(offset), what)
    })
}

/// Reads a string: a 16-bit length, or 0xffff and a 32-bit length, then the bytes.
fn read_string(cursor: &mut Cursor, what: &str) -> Result<String> {
    let length = match cursor.u16(what)? {
        0xffff => read_count(cursor, "characters")?,
        short => usize::from(short),
    };
    Ok(String::from_utf8_lossy(cursor.take(length, what)?).into_owned())
}

/// Reads the points of an uncompressed classic BGEO file.
///
/// Divides positions by their weight w unless it is 0. Ignores everything after the points.
///
/// # Errors
///
/// Those of [`header`], [`Error::TooLarge`] beyond `limits`, and [`Error::Truncated`] if points are missing.
pub fn read(bytes: &[u8], limits: &Limits) -> Result<ParticleFrame> {
    let header = header_within(bytes, limits)?;
    let points_bytes = checked_points_bytes(&header, bytes.len() as u64)?;
    let (records, rest) = bytes[header.points_offset..].split_at(points_bytes);
    Ok(frame_of_records(header, records, rest))
}

/// The points in these records, which may be only some of the file's. `rest` is the data after all points.
fn frame_of_records(header: BgeoHeader, records: &[u8], rest: &[u8]) -> ParticleFrame {
    let mut frame = ParticleFrame { notes: notes(&header, rest), ..ParticleFrame::default() };
    gather_positions(records, header.record_bytes, &mut frame.positions);
    let values = gather_values(&header, records);
    let roles = roles_of(&names_and_arities(&header));
    for ((AttributeHeader { name, arity, kind }, values), role) in
        header.attributes.into_iter().zip(values).zip(roles)
    {
        let values = match (kind, values) {
            (AttributeKind::Strings(table), Values::I32(mut indices)) => {
                frame.notes.extend(clear_strings_outside(&mut indices, table.len(), &name));
                Values::Strings { table, indices }
            }
            (_, values) => values,
        };
        if arity > 0 {
            frame.attributes.push(with_role(name, arity, role, values));
        }
    }
    frame
}

/// The values of each attribute in these records.
fn gather_values(header: &BgeoHeader, records: &[u8]) -> Vec<Values> {
    let stride = header.record_bytes;
    let number_of = |attribute: &AttributeHeader| match attribute.kind {
        AttributeKind::Float | AttributeKind::Vector => NumberType::F32,
        AttributeKind::Int | AttributeKind::Strings(_) => NumberType::I32,
    };
    let zeros = |attribute| number_of(attribute).zeros(records.len() / stride * attribute.arity);
    let mut gathered: Vec<Values> = header.attributes.iter().map(zeros).collect();
    let (mut targets, mut word) = (Vec::new(), POSITION_WORDS);
    for (attribute, values) in header.attributes.iter().zip(&mut gathered) {
        let end = word + attribute.arity;
        if attribute.arity > 0 {
            let columns = (word..end).map(|word| (word, number_of(attribute))).collect();
            targets.push(Target { columns, slots: Slots::of_values(values) });
        }
        word = end;
    }
    let offsets: Vec<usize> = (0..stride).step_by(4).collect();
    gather(records, RecordLayout { stride, offsets: &offsets, endian: Endian::Big }, targets);
    gathered
}

/// Locates the points, so that they can be read in batches.
fn find_records(
    head: &[u8],
    file_bytes: u64,
    file: &dyn ReadAt,
    limits: &Limits,
) -> Result<Result<Option<Records>>> {
    let header = header_within(head, limits)?;
    // Times are compared when the file is read as a whole.
    if header.attributes.iter().any(|attribute| may_be_time(&attribute.name)) {
        return Ok(Ok(None));
    }
    // Only compared with the trailer, so data of another length is not read.
    let rest = if file_bytes == header.expected_bytes() {
        batches::read(file, header.points_end()..file_bytes)
    } else {
        Ok(Vec::new())
    };
    Ok(rest.and_then(|rest| locate_records(&header, file_bytes, &rest).map(Some)))
}

/// The records of a file of `file_bytes`.
///
/// # Errors
///
/// Those of [`read`] that do not concern the header.
fn locate_records(header: &BgeoHeader, file_bytes: u64, rest: &[u8]) -> Result<Records> {
    checked_points_bytes(header, file_bytes)?;
    let (of_batch, rest, stride) = (header.clone(), rest.to_vec(), header.record_bytes);
    Ok(Records {
        format: FORMAT,
        offset: header.points_offset as u64,
        stride,
        count: header.point_count,
        gather: Arc::new(move |records, positions| gather_positions(records, stride, positions)),
        notes: notes(header, &rest),
        frame: Arc::new(move |records| Ok(frame_of_records(of_batch.clone(), records, &rest))),
        velocity: velocity_name(header),
    })
}

fn velocity_name(header: &BgeoHeader) -> Option<String> {
    let roles = roles_of(&names_and_arities(header));
    let index = roles.iter().position(|role| *role == Some(AttributeRole::Velocity))?;
    Some(header.attributes[index].name.clone())
}

fn names_and_arities(header: &BgeoHeader) -> Vec<(&str, usize)> {
    header.attributes.iter().map(|attribute| (&*attribute.name, attribute.arity)).collect()
}

/// Size of all points in bytes, after checking that the file has them.
fn checked_points_bytes(header: &BgeoHeader, file_bytes: u64) -> Result<usize> {
    let remaining = file_bytes.saturating_sub(header.points_offset as u64);
    let points_bytes = header.points_bytes();
    usize::try_from(points_bytes).ok().filter(|_| points_bytes <= remaining).ok_or_else(|| {
        let what = format!(
            "expected {} points of {} bytes each, {points_bytes} bytes in all, but {remaining} remain",
            header.point_count, header.record_bytes,
        );
        Error::truncated(FORMAT, Position::Offset(header.points_offset as u64), what)
    })
}

fn notes(header: &BgeoHeader, rest: &[u8]) -> Vec<String> {
    let mut notes = Vec::new();
    if header.expected_bytes_is_exact && rest != TRAILER {
        notes.push("the end of the file is invalid, but all points are complete".into());
    }
    for attribute in header.attributes.iter().filter(|attribute| attribute.arity == 0) {
        notes.push(format!("skipped the point attribute {:?}: it has no values", attribute.name));
    }
    notes
}

/// Replaces the positions by those of the records, in the same allocation.
fn gather_positions(records: &[u8], stride: usize, positions: &mut FilePositions) {
    let mut gathered = match std::mem::take(positions) {
        FilePositions::F32(gathered) => gathered,
        FilePositions::F64(_) => Vec::new(),
    };
    gathered.clear();
    gathered.extend(records.chunks_exact(stride).map(|record| {
        let (words, _) = record.as_chunks::<4>();
        divided([0, 1, 2, 3].map(|word| f32::from_be_bytes(words[word])))
    }));
    *positions = FilePositions::F32(gathered);
}

/// Replaces string indices outside the table by −1. A note says so if there are any other than −1 itself, the
/// usual mark for "no string".
fn clear_strings_outside(indices: &mut [i32], count: usize, name: &str) -> Option<String> {
    let mut outside_count = 0usize;
    for index in indices {
        let is_inside = usize::try_from(*index).is_ok_and(|index| index < count);
        if !is_inside {
            outside_count += usize::from(*index != -1);
            *index = -1;
        }
    }
    (outside_count != 0).then(|| {
        format!(
            "the point attribute {name:?} has {count} strings; {outside_count} indices are outside this range and are ignored"
        )
    })
}

// Writes particles as a classic BGEO file, uncompressed and without primitives.

/// Writes `frame`. The format has only 32-bit types: 64-bit floats become 32-bit floats, and bytes and 64-bit
/// integers become 32-bit integers.
///
/// Houdini reads `.bgeo` as its newer format; the extension `.bhclassic` selects the right reader.
///
/// # Errors
///
/// [`Error::Io`] from `out`; [`Error::Invalid`] for an attribute without `arity` values per particle;
/// [`Error::TooLarge`] for data beyond the format's limits, such as an integer beyond 32 bits.
pub fn write(frame: &ParticleFrame, out: &mut (impl Write + ?Sized)) -> Result<()> {
    let point_count = frame.positions.len();
    vertex_attributes::check(frame, FORMAT)?;
    frame.attributes.iter().try_for_each(check)?;
    out.write_all(MAGIC)?;
    out.write_all(&VERSION.to_be_bytes())?;
    let counts = [point_count, 0, 0, 0, frame.attributes.len(), 0, 0, 0];
    for count in counts {
        out.write_all(&count_i32(count, "points or attributes")?.to_be_bytes())?;
    }
    for attribute in &frame.attributes {
        write_dictionary_entry(attribute, out)?;
    }
    let mut record = Vec::new();
    for point in 0..point_count {
        record.clear();
        encode_position(&frame.positions, point, &mut record);
        for attribute in &frame.attributes {
            encode_values(attribute, point, &mut record);
        }
        out.write_all(&record)?;
    }
    out.write_all(&TRAILER)?;
    Ok(())
}

/// Fails if the format cannot store the values.
fn check(attribute: &FileAttribute) -> Result<()> {
    let (name, arity) = (&attribute.name, attribute.arity);
    if u16::try_from(arity).is_err() {
        let what =
            format!("the attribute {name:?} has {arity} values per point; the format's limit is 65535");
        return Err(Error::too_large(FORMAT, what));
    }
    if let Values::I64(values) = &attribute.values
        && let Some(value) = values.iter().find(|&&value| i32::try_from(value).is_err())
    {
        let what =
            format!("the attribute {name:?} has the value {value}, which exceeds the format's 32 bits");
        return Err(Error::too_large(FORMAT, what));
    }
    Ok(())
}

fn write_dictionary_entry(attribute: &FileAttribute, out: &mut (impl Write + ?Sized)) -> Result<()> {
    let turns_with_object = matches!(
        attribute.role,
        Some(AttributeRole::Velocity | AttributeRole::Acceleration | AttributeRole::Normal)
    );
    let kind: i32 = match attribute.values {
        Values::F32(_) | Values::F64(_) if turns_with_object => 5,
        Values::F32(_) | Values::F64(_) => 0,
        Values::U8(_) | Values::I32(_) | Values::I64(_) => 1,
        Values::Strings { .. } => 4,
    };
    write_string(&attribute.name, out)?;
    let size = u16::try_from(attribute.arity).unwrap_or(u16::MAX); // checked before
    out.write_all(&size.to_be_bytes())?;
    out.write_all(&kind.to_be_bytes())?;
    if let Values::Strings { table, .. } = &attribute.values {
        out.write_all(&count_i32(table.len(), "strings")?.to_be_bytes())?;
        for string in table {
            write_string(string, out)?;
        }
    } else {
        out.write_all(&vec![0; 4 * attribute.arity])?; // defaults
    }
    Ok(())
}

fn write_string(string: &str, out: &mut (impl Write + ?Sized)) -> Result<()> {
    // Readers may take the 16-bit length as signed.
    match i16::try_from(string.len()) {
        Ok(length) => out.write_all(&length.to_be_bytes())?,
        Err(_) => {
            out.write_all(&[0xff; 2])?;
            out.write_all(&count_i32(string.len(), "characters")?.to_be_bytes())?;
        }
    }
    out.write_all(string.as_bytes())?;
    Ok(())
}

fn count_i32(count: usize, items: &str) -> Result<i32> {
    i32::try_from(count).map_err(|_| {
        Error::too_large(FORMAT, format!("the frame has {count} {items}; the format's limit is {}", i32::MAX))
    })
}

fn encode_position(positions: &FilePositions, point: usize, record: &mut Vec<u8>) {
    let [x, y, z] = match positions {
        FilePositions::F32(positions) => positions[point],
        FilePositions::F64(positions) => positions[point].map(narrow),
    };
    for coordinate in [x, y, z, 1.0] {
        record.extend(coordinate.to_be_bytes());
    }
}

fn encode_values(attribute: &FileAttribute, point: usize, record: &mut Vec<u8>) {
    let range = point * attribute.arity..(point + 1) * attribute.arity;
    match &attribute.values {
        Values::F32(values) => record.extend(values[range].iter().flat_map(|value| value.to_be_bytes())),
        Values::F64(values) => {
            record.extend(values[range].iter().flat_map(|&value| narrow(value).to_be_bytes()));
        }
        Values::U8(values) => {
            record.extend(values[range].iter().flat_map(|&value| i32::from(value).to_be_bytes()));
        }
        Values::I32(values) | Values::Strings { indices: values, .. } => {
            record.extend(values[range].iter().flat_map(|value| value.to_be_bytes()));
        }
        Values::I64(values) => {
            // All values were checked to fit.
            let to_i32 = |&value: &i64| i32::try_from(value).unwrap_or(i32::MAX).to_be_bytes();
            record.extend(values[range].iter().flat_map(to_i32));
        }
    }
}
