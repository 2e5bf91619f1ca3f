//! The header of classic BGEO: counts and the dictionary of point attributes, up to the first point.

use super::{FORMAT, MAGIC, POSITION_WORDS, TRAILER, VERSION};
use crate::bytes::{Cursor, Endian};
use crate::{Error, Limits, Position, Result};

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
    /// The minimum size in bytes of a complete, uncompressed file.
    pub expected_bytes: u64,
    /// Whether a complete file has exactly `expected_bytes`: true if only points follow the header.
    pub expected_bytes_is_exact: bool,
}

impl BgeoHeader {
    /// Offset of the end of the points in a complete file, in bytes.
    pub(crate) fn points_end(&self) -> u64 {
        self.points_offset as u64 + self.points_bytes()
    }

    /// Size of all points, in bytes.
    pub(super) fn points_bytes(&self) -> u64 {
        self.point_count as u64 * self.record_bytes as u64 // 31 bits × 30 bits cannot overflow
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
    let version = i32::from_le_bytes(cursor.array("the version")?);
    if version != VERSION {
        return Err(Error::unsupported(
            FORMAT,
            format!("the file has version {version}; only version 5 is supported"),
        ));
    }
    let point_count = count(&mut cursor, "points")?;
    let primitive_count = count(&mut cursor, "primitives")?;
    let point_group_count = count(&mut cursor, "point groups")?;
    let primitive_group_count = count(&mut cursor, "primitive groups")?;
    let attribute_count = count(&mut cursor, "point attributes")?;
    let vertex_attribute_count = count(&mut cursor, "vertex attributes")?;
    let primitive_attribute_count = count(&mut cursor, "primitive attributes")?;
    let detail_attribute_count = count(&mut cursor, "detail attributes")?;
    if point_count as u64 > limits.particle_count {
        let what =
            format!("the file has {point_count} points, more than the limit of {}", limits.particle_count);
        return Err(Error::too_large(FORMAT, what));
    }
    let attributes = dictionary(&mut cursor, attribute_count, limits)?;

    let words: usize = POSITION_WORDS + attributes.iter().map(|attribute| attribute.arity).sum::<usize>();
    let record_bytes = 4 * words;
    let points_bytes = point_count as u64 * record_bytes as u64; // 31 bits × 30 bits cannot overflow
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
        record_bytes,
        expected_bytes: cursor.at() as u64 + points_bytes + TRAILER.len() as u64,
        expected_bytes_is_exact: counts_after == [0; 6],
    })
}

fn dictionary(cursor: &mut Cursor, count: usize, limits: &Limits) -> Result<Vec<AttributeHeader>> {
    const ENTRY_BYTES_MIN: usize = 8; // length of an empty name, size, type
    if count > limits.attribute_count {
        let what = format!(
            "the file has {count} point attributes, more than the limit of {}",
            limits.attribute_count
        );
        return Err(Error::too_large(FORMAT, what));
    }
    require(cursor, count * ENTRY_BYTES_MIN, "the point attribute dictionary")?;
    (0..count).map(|_| dictionary_entry(cursor)).collect()
}

fn dictionary_entry(cursor: &mut Cursor) -> Result<AttributeHeader> {
    let name = string(cursor, "an attribute name")?;
    let arity = usize::from(u16::from_le_bytes(cursor.array("the size of an attribute")?));
    let type_offset = cursor.at() as u64;
    let kind = match i32::from_le_bytes(cursor.array("the type of an attribute")?) {
        0 => AttributeKind::Float,
        1 => AttributeKind::Int,
        5 => AttributeKind::Vector,
        4 => AttributeKind::Strings(string_table(cursor)?),
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

fn string_table(cursor: &mut Cursor) -> Result<Vec<String>> {
    const STRING_BYTES_MIN: usize = 2; // its length
    let count = count(cursor, "strings")?;
    require(cursor, count.saturating_mul(STRING_BYTES_MIN), "the strings of an attribute")?;
    (0..count).map(|_| string(cursor, "a string")).collect()
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
fn count(cursor: &mut Cursor, items: &str) -> Result<usize> {
    let offset = cursor.at() as u64;
    let count = i32::from_le_bytes(cursor.array(items)?);
    usize::try_from(count).map_err(|_| {
        let what = format!("expected the number of {items} to be at least 0, found {count}");
        Error::invalid(FORMAT, Position::Offset(offset), what)
    })
}

/// Reads a string: a 16-bit length, or 0xffff and a 32-bit length, then the bytes.
fn string(cursor: &mut Cursor, what: &str) -> Result<String> {
    let length = match u16::from_le_bytes(cursor.array(what)?) {
        0xffff => count(cursor, "characters")?,
        short => usize::from(short),
    };
    Ok(String::from_utf8_lossy(cursor.take(length, what)?).into_owned())
}
