//! The counts and the dictionary of point attributes, up to the first point.

use super::{FORMAT, MAGIC, POSITION_WORDS, TRAILER, VERSION};
use crate::{Error, Limits, Place, Result};

/// What the file says before its first point.
#[derive(Clone, Debug, PartialEq)]
pub struct Header {
    /// Points, each of which is taken as a particle.
    pub point_count: usize,
    /// Primitives, which are not read. A particle system is one.
    pub primitive_count: usize,
    /// The point attributes in the order of the file.
    pub attributes: Vec<AttributeHeader>,
    /// Where the first point begins, bytes from the start of the file.
    pub points_offset: usize,
    /// Bytes from one point to the next.
    pub record_bytes: usize,
    /// Bytes that a complete file has at least, uncompressed.
    pub expected_bytes: u64,
    /// Whether a complete file has exactly `expected_bytes`: true where only points follow.
    pub expected_bytes_is_exact: bool,
}

/// One point attribute.
#[derive(Clone, Debug, PartialEq)]
pub struct AttributeHeader {
    /// The name in the file.
    pub name: String,
    /// Values per point.
    pub arity: usize,
    /// What the values are.
    pub kind: AttributeKind,
}

/// The type of an attribute; every value takes four bytes.
#[derive(Clone, Debug, PartialEq)]
pub enum AttributeKind {
    /// 32-bit reals.
    Float,
    /// 32-bit integers.
    Int,
    /// 32-bit reals that turn with the object, such as a velocity.
    Vector,
    /// Indices into these strings.
    Strings(Vec<String>),
}

/// Reads what precedes the points. The points themselves need not be there yet.
///
/// # Errors
///
/// [`Error::Unsupported`] for another version or an attribute type that this program does not
/// know, [`Error::Invalid`] where the header contradicts itself or ends too soon.
pub fn header(bytes: &[u8]) -> Result<Header> {
    header_within(bytes, &Limits::default())
}

/// [`header`], with limits on what it may ask for.
pub(super) fn header_within(bytes: &[u8], limits: &Limits) -> Result<Header> {
    let mut cursor = Cursor { bytes, at: 0 };
    if cursor.take(MAGIC.len(), "the signature")? != MAGIC {
        return Err(Error::invalid(FORMAT, Place::Offset(0), "expected the signature BgeoV"));
    }
    let version = cursor.i32("the version")?;
    if version != VERSION {
        return Err(Error::unsupported(FORMAT, format!("version {version}; only version 5 is read")));
    }
    let point_count = cursor.count("points")?;
    let primitive_count = cursor.count("primitives")?;
    let point_group_count = cursor.count("point groups")?;
    let primitive_group_count = cursor.count("primitive groups")?;
    let attribute_count = cursor.count("point attributes")?;
    let vertex_attribute_count = cursor.count("vertex attributes")?;
    let primitive_attribute_count = cursor.count("primitive attributes")?;
    let detail_attribute_count = cursor.count("detail attributes")?;
    if point_count as u64 > limits.particle_count {
        let what = format!("{point_count} points, more than the limit of {}", limits.particle_count);
        return Err(Error::too_large(FORMAT, what));
    }
    let attributes = dictionary(&mut cursor, attribute_count, limits)?;

    let words: usize = POSITION_WORDS + attributes.iter().map(|attribute| attribute.arity).sum::<usize>();
    let record_bytes = 4 * words;
    let points_bytes = point_count as u64 * record_bytes as u64; // 31 bits times 30 bits
    let counts_after = [
        primitive_count,
        point_group_count,
        primitive_group_count,
        vertex_attribute_count,
        primitive_attribute_count,
        detail_attribute_count,
    ];
    Ok(Header {
        point_count,
        primitive_count,
        attributes,
        points_offset: cursor.at,
        record_bytes,
        expected_bytes: cursor.at as u64 + points_bytes + TRAILER.len() as u64,
        expected_bytes_is_exact: counts_after == [0; 6],
    })
}

fn dictionary(cursor: &mut Cursor, count: usize, limits: &Limits) -> Result<Vec<AttributeHeader>> {
    const ENTRY_BYTES_MIN: usize = 8; // length of an empty name, size, type
    if count > limits.attribute_count {
        let what = format!("{count} point attributes, more than the limit of {}", limits.attribute_count);
        return Err(Error::too_large(FORMAT, what));
    }
    cursor.require(count * ENTRY_BYTES_MIN, "the point attribute dictionary")?;
    (0..count).map(|_| dictionary_entry(cursor)).collect()
}

fn dictionary_entry(cursor: &mut Cursor) -> Result<AttributeHeader> {
    let name = cursor.string("an attribute name")?;
    let arity = usize::from(cursor.u16("the size of an attribute")?);
    let type_offset = cursor.at as u64;
    let kind = match cursor.i32("the type of an attribute")? {
        kind @ (0 | 1 | 5) => {
            cursor.take(4 * arity, "the defaults of an attribute")?;
            [AttributeKind::Float, AttributeKind::Int, AttributeKind::Vector][kind.min(2) as usize].clone()
        }
        4 => AttributeKind::Strings(string_table(cursor)?),
        kind @ (2 | 3) => {
            let word = if kind == 2 { "fixed-length string" } else { "mixed" };
            let what = format!(
                "the point attribute {name:?} has the type {word}, whose values cannot be read: \
                 remove it before exporting"
            );
            return Err(Error::unsupported(FORMAT, what));
        }
        kind => {
            let what = format!(
                "expected the type of the point attribute {name:?} to be 0 (float), 1 (int), \
                 4 (strings) or 5 (vector), found {kind}"
            );
            return Err(Error::invalid(FORMAT, Place::Offset(type_offset), what));
        }
    };
    Ok(AttributeHeader { name, arity, kind })
}

fn string_table(cursor: &mut Cursor) -> Result<Vec<String>> {
    const STRING_BYTES_MIN: usize = 2; // its length
    let count = cursor.count("strings")?;
    cursor.require(count.saturating_mul(STRING_BYTES_MIN), "the strings of an attribute")?;
    (0..count).map(|_| cursor.string("a string")).collect()
}

/// A place in the file; every step checks that the bytes are there.
struct Cursor<'a> {
    bytes: &'a [u8],
    at: usize,
}

impl<'a> Cursor<'a> {
    /// Fails unless `byte_count` more bytes are there.
    fn require(&self, byte_count: usize, what: &str) -> Result<()> {
        let remaining = self.bytes.len() - self.at;
        if byte_count <= remaining {
            return Ok(());
        }
        let what = format!("expected {byte_count} bytes of {what}, {remaining} remain");
        Err(Error::invalid(FORMAT, Place::Offset(self.at as u64), what))
    }

    fn take(&mut self, byte_count: usize, what: &str) -> Result<&'a [u8]> {
        self.require(byte_count, what)?;
        let taken = &self.bytes[self.at..self.at + byte_count];
        self.at += byte_count;
        Ok(taken)
    }

    fn u16(&mut self, what: &str) -> Result<u16> {
        let bytes = self.take(2, what)?;
        Ok(u16::from_be_bytes([bytes[0], bytes[1]]))
    }

    fn i32(&mut self, what: &str) -> Result<i32> {
        let bytes = self.take(4, what)?;
        Ok(i32::from_be_bytes([bytes[0], bytes[1], bytes[2], bytes[3]]))
    }

    /// A number of `things`, which cannot be negative.
    fn count(&mut self, things: &str) -> Result<usize> {
        let offset = self.at as u64;
        let count = self.i32("a count")?;
        usize::try_from(count).map_err(|_| {
            let what = format!("expected the number of {things}, found {count}");
            Error::invalid(FORMAT, Place::Offset(offset), what)
        })
    }

    /// A length of 16 bits, or 0xffff and one of 32 bits, then as many bytes.
    fn string(&mut self, what: &str) -> Result<String> {
        let length = match self.u16(what)? {
            0xffff => self.count("characters")?,
            short => usize::from(short),
        };
        Ok(String::from_utf8_lossy(self.take(length, what)?).into_owned())
    }
}
