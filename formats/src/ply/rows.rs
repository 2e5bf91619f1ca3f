//! Reads the records of a body value by value, in any encoding.
//!
//! This is the slow path, for faces, skipped elements and records with lists.

use super::FORMAT;
use super::ascii::BodyLines;
use super::header::{Element, PlyHeader, Property, PropertyType};
use crate::core::bytes::Cursor;
use crate::core::error::{Error, Position, Result};
use crate::core::number::NumberType;

/// A read position in the body.
pub(super) enum RecordReader<'a> {
    Binary(Cursor<'a>),
    Ascii(BodyLines<'a>),
}

impl<'a> RecordReader<'a> {
    /// Starts at offset `at` of the file.
    pub(super) fn new(bytes: &'a [u8], header: &PlyHeader, at: usize) -> RecordReader<'a> {
        match header.encoding.endian() {
            Some(endian) => RecordReader::Binary(Cursor::new(FORMAT, endian, bytes, at)),
            None => RecordReader::Ascii(BodyLines::new(bytes, at)),
        }
    }

    /// Offset in bytes from the start of the file.
    pub(super) fn at(&self) -> usize {
        match self {
            RecordReader::Binary(cursor) => cursor.at(),
            RecordReader::Ascii(lines) => lines.at(),
        }
    }

    /// Before the first record of an element.
    pub(super) fn begin(&mut self, element: &Element) {
        match self {
            RecordReader::Binary(_) => {}
            RecordReader::Ascii(lines) => lines.begin(element),
        }
    }

    /// Starts the next record.
    pub(super) fn start(&mut self) -> Result<()> {
        match self {
            RecordReader::Binary(_) => Ok(()),
            RecordReader::Ascii(lines) => lines.start(),
        }
    }

    /// Ends the record, all of whose values must have been read.
    pub(super) fn finish(&mut self) -> Result<()> {
        match self {
            RecordReader::Binary(_) => Ok(()),
            RecordReader::Ascii(lines) => lines.finish(),
        }
    }

    /// Reads the next value as an integer.
    pub(super) fn integer(&mut self, scalar: NumberType, what: &str) -> Result<i64> {
        match self {
            RecordReader::Binary(cursor) => cursor.integer(scalar, what),
            RecordReader::Ascii(lines) => lines.integer(scalar, what),
        }
    }

    /// Reads the count of a list, which must not be negative or exceed the remaining bytes.
    pub(super) fn list_length(&mut self, scalar: NumberType, property: &Property) -> Result<usize> {
        let count = self.integer(scalar, &property.name)?;
        let most = match self {
            RecordReader::Binary(cursor) => cursor.remaining(),
            RecordReader::Ascii(lines) => lines.remaining(),
        };
        usize::try_from(count).ok().filter(|&count| count <= most).ok_or_else(|| {
            let name = &property.name;
            if count < 0 {
                self.invalid(format!("list `{name}` has a negative count, {count}"))
            } else {
                self.truncated(format!("list `{name}` has a count of {count}, beyond the end of the file"))
            }
        })
    }

    /// Skips one property.
    pub(super) fn skip(&mut self, property: &Property) -> Result<()> {
        let (item, count) = match property.kind {
            PropertyType::Scalar(scalar) => (scalar, 1),
            PropertyType::List { count, item } => (item, self.list_length(count, property)?),
        };
        match self {
            RecordReader::Binary(cursor) => {
                let length = count.saturating_mul(item.size());
                cursor.take(length, &property.name).map(|_| ())
            }
            RecordReader::Ascii(lines) => (0..count).try_for_each(|_| lines.skip(&property.name)),
        }
    }

    /// Skips all records of an element.
    fn skip_element(&mut self, element: &Element) -> Result<()> {
        let count = checked_count(self, element)?;
        if let (RecordReader::Binary(cursor), false) = (&mut *self, element.has_list()) {
            // `checked_count` has compared the product with the remaining bytes.
            cursor.take(count * element.record_size_min(), &element.name)?;
            return Ok(());
        }
        self.begin(element);
        for _ in 0..count {
            self.start()?;
            for property in &element.properties {
                self.skip(property)?;
            }
            self.finish()?;
        }
        Ok(())
    }

    fn truncated(&self, what: String) -> Error {
        match self {
            RecordReader::Binary(cursor) => cursor.truncated(what),
            RecordReader::Ascii(lines) => lines.truncated(what),
        }
    }

    pub(super) fn invalid(&self, what: String) -> Error {
        match self {
            RecordReader::Binary(cursor) => cursor.invalid(what),
            RecordReader::Ascii(lines) => lines.invalid(what),
        }
    }
}

/// The number of records of the element at the current position, checked against the remaining bytes.
pub(super) fn checked_count(rows: &RecordReader<'_>, element: &Element) -> Result<usize> {
    let at = rows.at() as u64;
    match rows {
        RecordReader::Binary(cursor) => checked_binary_count(element, at, cursor.remaining() as u64),
        RecordReader::Ascii(lines) => {
            // Each value needs a digit and a separator, but the last line needs no line end.
            let (remaining, record) = (lines.remaining() as u64, 2 * element.properties.len());
            checked(element, at, remaining, remaining + 1, record, "bytes of text")
        }
    }
}

/// [`checked_count`] for a binary element at offset `at`, from which on `remaining` bytes follow.
pub(super) fn checked_binary_count(element: &Element, at: u64, remaining: u64) -> Result<usize> {
    checked(element, at, remaining, remaining, element.record_size_min(), "bytes")
}

/// The declared number of records, if they fit into `count_max` bytes with at least `record` bytes each.
fn checked(
    element: &Element,
    at: u64,
    remaining: u64,
    count_max: u64,
    record: usize,
    kind: &str,
) -> Result<usize> {
    if element.properties.is_empty() {
        return Ok(0); // records without properties need no reading
    }
    let most = count_max / record as u64;
    usize::try_from(element.count).ok().filter(|&count| count as u64 <= most).ok_or_else(|| {
        let Element { name, count, .. } = element;
        let what = format!(
            "the header declares {count} `{name}` records of at least {record} {kind}, but only {remaining} bytes follow",
        );
        let position = Position::Offset(at);
        // A size beyond 2⁶⁴ is invalid: no file that is still being written will reach it.
        match count.checked_mul(record as u64) {
            None => Error::invalid(FORMAT, position, what),
            Some(_) => Error::truncated(FORMAT, position, what),
        }
    })
}

/// Positions a reader at the records of `element`, which belongs to the header.
pub(super) fn rows_of<'a>(
    bytes: &'a [u8],
    header: &PlyHeader,
    element: &Element,
) -> Result<RecordReader<'a>> {
    let mut rows = RecordReader::new(bytes, header, header.body_offset);
    for earlier in header.elements.iter().take_while(|earlier| !std::ptr::eq(*earlier, element)) {
        rows.skip_element(earlier)?;
    }
    Ok(rows)
}

/// The offset of each property in a record without its lists, and the length of this record. A list has the
/// offset of the property after it.
pub(super) fn scalar_offsets(element: &Element) -> (Vec<usize>, usize) {
    let mut at = 0;
    let mut offsets = Vec::with_capacity(element.properties.len());
    for property in &element.properties {
        offsets.push(at);
        if let PropertyType::Scalar(scalar) = property.kind {
            at += scalar.size();
        }
    }
    (offsets, at)
}

/// Copies records without their lists.
pub(super) fn without_lists(rows: &mut RecordReader<'_>, element: &Element, count: usize) -> Result<Vec<u8>> {
    let (_, stride) = scalar_offsets(element);
    // The caller has checked that the file has `count` times `stride` bytes.
    let mut packed = Vec::with_capacity(count * stride);
    for _ in 0..count {
        for property in &element.properties {
            match (property.kind, &mut *rows) {
                (PropertyType::Scalar(scalar), RecordReader::Binary(cursor)) => {
                    packed.extend_from_slice(cursor.take(scalar.size(), &property.name)?);
                }
                _ => rows.skip(property)?,
            }
        }
    }
    Ok(packed)
}
