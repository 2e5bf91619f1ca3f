//! The header of a `.npy` file.

use super::FORMAT;
use crate::core::bytes::{Cursor, Endian};
use crate::core::error::{Error, Position, Result};
use crate::core::limits::Limits;
use crate::core::number::NumberType;
use crate::core::text::excerpt;

/// The signature.
const MAGIC: &[u8; 6] = b"\x93NUMPY";

/// Maximum size of the header, in bytes. NumPy itself allows 10 000 by default.
const HEADER_BYTES_MAX: u64 = 256 << 10;

/// An array with more columns is a matrix or an image, not a list of particles.
pub(super) const COLUMNS_MAX: u64 = 32;

/// The header of an array.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct ArrayHeader {
    pub(super) layout: ElementLayout,
    /// Whether the first index varies fastest.
    pub(super) is_fortran: bool,
    pub(super) shape: Vec<u64>,
    /// Offset of the data.
    pub(super) data_offset: usize,
}

/// The type of the elements.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum ElementLayout {
    Plain {
        number: NumberType,
        endian: Endian,
    },
    Fields {
        fields: Vec<StructField>,
        /// Bytes per element.
        stride: usize,
    },
    /// An unsupported type, described in words.
    Unread(String),
}

/// A field of a structured type.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct StructField {
    pub(super) name: String,
    /// Offset in bytes from the start of an element.
    pub(super) offset: usize,
    /// Number of values.
    pub(super) arity: usize,
    /// Their type; `None` if not numeric.
    pub(super) number: Option<(NumberType, Endian)>,
}

impl ArrayHeader {
    /// The bytes of all elements.
    pub(super) fn data<'a>(&self, bytes: &'a [u8]) -> Result<&'a [u8]> {
        let length = self.data_bytes()?;
        let rest = &bytes[self.data_offset..];
        let data = usize::try_from(length).ok().and_then(|length| rest.get(..length));
        data.ok_or_else(|| {
            let what = format!("expected {length} bytes for {}, {} remain", self.shown(), rest.len());
            Error::truncated(FORMAT, Position::Offset(self.data_offset as u64), what)
        })
    }

    fn data_bytes(&self) -> Result<u64> {
        let element_bytes = match &self.layout {
            ElementLayout::Plain { number, .. } => number.size(),
            ElementLayout::Fields { stride, .. } => *stride,
            ElementLayout::Unread(_) => 0,
        };
        let bytes = self.element_count()?.checked_mul(element_bytes as u64);
        bytes.filter(|bytes| *bytes <= i64::MAX as u64).ok_or_else(|| self.too_many())
    }

    /// The number of elements. In a structured array, an element is a row.
    pub(super) fn element_count(&self) -> Result<u64> {
        let count = self.shape.iter().try_fold(1u64, |count, &length| count.checked_mul(length));
        count.ok_or_else(|| self.too_many())
    }

    fn too_many(&self) -> Error {
        Error::invalid(
            FORMAT,
            Position::Offset(0),
            format!("the array has too many elements: {}", self.shown()),
        )
    }

    /// Values per row: the last dimension, or 1.
    pub(super) fn column_count(&self) -> usize {
        match self.shape[..] {
            [] | [_] => 1,
            [.., last] => usize::try_from(last).unwrap_or(usize::MAX),
        }
    }

    /// The number of rows: the product of all dimensions but the last, or the only dimension. The product
    /// does not overflow, because `element_count` was checked before.
    pub(super) fn row_count(&self) -> u64 {
        let rows = if self.shape.len() < 2 { &self.shape[..] } else { &self.shape[..self.shape.len() - 1] };
        rows.iter().fold(1, |count: u64, &length| count.saturating_mul(length))
    }

    /// The number of frames, if there are several: T in the shape (T, N, 3), and in the shape (T, N) of
    /// records.
    pub(super) fn frame_count(&self) -> Option<u64> {
        match (&self.layout, &self.shape[..]) {
            (ElementLayout::Plain { number: NumberType::Bool | NumberType::U8, .. }, _) => None,
            (ElementLayout::Plain { .. }, &[count, _, 3..=COLUMNS_MAX])
            | (ElementLayout::Fields { .. }, &[count, _]) => Some(count).filter(|&count| count > 1),
            _ => None,
        }
    }

    /// The header of a single frame of this array, in whose file the data begins at the same offset, and the
    /// bytes of a frame. `bytes` is the file up to its data. `None` if the data of frames are not contiguous.
    pub(super) fn of_frame(&self, bytes: &[u8]) -> Option<(Vec<u8>, u64)> {
        let count = self.frame_count().filter(|_| !self.is_fortran)?;
        let mut head = bytes.get(..self.data_offset)?.to_vec();
        let is_key = |at: &usize| {
            let (before, key) = head[..*at].split_last().zip(head[*at..].strip_prefix(b"shape"))?;
            let rest = key.strip_prefix(&[*before.0])?.trim_ascii_start();
            Some(rest.strip_prefix(b":")?.trim_ascii_start().starts_with(b"("))
        };
        let key = (1..head.len()).find(|at| is_key(at) == Some(true))?;
        let start = key + head[key..].iter().position(|&byte| byte == b'(')? + 1;
        let end = start + head[start..].iter().position(|&byte| byte == b')')?;
        let (_, rest) = std::str::from_utf8(&head[start..end]).ok()?.split_once(',')?;
        let rest = rest.trim();
        let shape = if rest.contains(',') { format!("{rest})") } else { format!("{rest},)") };
        // The frame has one number less, so its shape is shorter, and blanks may fill the place that it
        // leaves.
        let tail = head[end + 1..].to_vec();
        let blank_count = (end + 1 - start).checked_sub(shape.len())?;
        head.truncate(start);
        head.extend(shape.bytes().chain(std::iter::repeat_n(b' ', blank_count)));
        head.extend(tail);
        Some((head, self.data_bytes().ok()? / count))
    }

    /// The shape in Python notation.
    pub(super) fn shown(&self) -> String {
        let lengths: Vec<String> = self.shape.iter().take(8).map(u64::to_string).collect();
        match &lengths[..] {
            [single] => format!("the shape ({single},)"),
            _ => format!("the shape ({})", lengths.join(", ")),
        }
    }
}

/// The size of a whole file with this header; `None` if it has no readable data.
pub(crate) fn bytes_declared(head: &[u8], limits: &Limits) -> Result<Option<u64>> {
    let header = read(head, limits)?;
    let data_bytes = header.data_bytes()?;
    Ok((data_bytes != 0).then_some(header.data_offset as u64 + data_bytes))
}

/// Reads the header. The data may be missing.
pub(super) fn read(bytes: &[u8], limits: &Limits) -> Result<ArrayHeader> {
    let mut cursor = Cursor::new(FORMAT, Endian::Little, bytes, 0);
    if cursor.take(MAGIC.len(), "the signature")? != MAGIC {
        return Err(Error::invalid(FORMAT, Position::Offset(0), "expected the signature \\x93NUMPY"));
    }
    let [major, minor] = [cursor.u8("the version")?, cursor.u8("the version")?];
    let length = match (major, minor) {
        (1, 0) => u32::from(cursor.u16("the header's length")?),
        (2 | 3, 0) => cursor.u32("the header's length")?,
        _ => {
            let what = format!("the format version is {major}.{minor}; only 1.0 to 3.0 are supported");
            return Err(Error::unsupported(FORMAT, what));
        }
    };
    let most = limits.header_bytes.min(HEADER_BYTES_MAX);
    if u64::from(length) > most {
        let what = format!("the header has {length} bytes, more than the limit of {most}");
        return Err(Error::too_large(FORMAT, what));
    }
    let text_offset = cursor.at();
    let literal = parse(cursor.take(length as usize, "the header")?, text_offset)?;
    header_of(&literal, text_offset, cursor.at(), limits)
}

fn header_of(
    literal: &Literal,
    text_offset: usize,
    data_offset: usize,
    limits: &Limits,
) -> Result<ArrayHeader> {
    let invalid = |what: &str| Error::invalid(FORMAT, Position::Offset(text_offset as u64), what);
    let Literal::Dictionary(entries) = literal else { return Err(invalid("the header is not a dictionary")) };
    let value_of = |key: &str| {
        let found = entries.iter().find(|(name, _)| *name == Literal::Text(key.into()));
        found.map(|(_, value)| value).ok_or_else(|| invalid(&format!("the header has no `{key}`")))
    };
    let Literal::List(lengths) = value_of("shape")? else { return Err(invalid("`shape` is not a tuple")) };
    let length = |literal: &Literal| match literal {
        Literal::Integer(length) => Ok(*length),
        _ => Err(invalid("a dimension in `shape` is not an integer")),
    };
    if lengths.len() > 64 {
        return Err(invalid("`shape` has more than 64 dimensions"));
    }
    let Literal::Bool(is_fortran) = *value_of("fortran_order")? else {
        return Err(invalid("`fortran_order` is neither True nor False"));
    };
    let shape = lengths.iter().map(length).collect::<Result<_>>()?;
    let layout = layout_of(value_of("descr")?, limits).map_err(|error| match error {
        Error::Invalid { what, .. } => invalid(&what),
        other => other,
    })?;
    Ok(ArrayHeader { layout, is_fortran, shape, data_offset })
}

/// An error whose position the caller adds.
fn wrong_type(what: impl Into<String>) -> Error {
    Error::invalid(FORMAT, Position::File, what)
}

fn layout_of(descr: &Literal, limits: &Limits) -> Result<ElementLayout> {
    match descr {
        Literal::Text(code) => Ok(match element(code)? {
            ElementType { number: Some((number, endian)), .. } => ElementLayout::Plain { number, endian },
            _ => ElementLayout::Unread(format!("elements of the type \"{}\"", excerpt(code))),
        }),
        Literal::List(_) => {
            let mut fields = Vec::new();
            let stride = add_fields(descr, "", 0, &mut fields, limits)?;
            Ok(ElementLayout::Fields { fields, stride })
        }
        _ => Err(wrong_type("`descr` is neither a string nor a list")),
    }
}

/// Adds the fields of a structure at `offset`, with `prefix` before their names. Returns the offset of its
/// end.
fn add_fields(
    descr: &Literal,
    prefix: &str,
    offset: usize,
    fields: &mut Vec<StructField>,
    limits: &Limits,
) -> Result<usize> {
    let Literal::List(entries) = descr else { return Err(wrong_type("a structured type is not a list")) };
    let mut at = offset;
    for entry in entries {
        let Literal::List(parts) = entry else { return Err(wrong_type("a field is not a tuple")) };
        let (name, kind, repeats) = match &parts[..] {
            [name, kind] => (name, kind, 1),
            [name, kind, shape] => (name, kind, repeats_of(shape)?),
            _ => return Err(wrong_type("a field does not have two or three parts")),
        };
        let name = match name {
            Literal::Text(name) => name.clone(),
            Literal::List(titled) => match titled.last() {
                Some(Literal::Text(name)) => name.clone(),
                _ => return Err(wrong_type("the name of a field is not a string")),
            },
            _ => return Err(wrong_type("the name of a field is not a string")),
        };
        let full = if prefix.is_empty() { name.clone() } else { format!("{prefix}.{name}") };
        let end = match kind {
            Literal::Text(code) => {
                let ElementType { bytes, number } = element(code)?;
                let is_padding = name.is_empty() || code.contains('V');
                if !is_padding && repeats != 0 && bytes != 0 {
                    fields.push(StructField { name: full, offset: at, arity: repeats, number });
                }
                repeats.checked_mul(bytes).and_then(|bytes| at.checked_add(bytes))
            }
            nested => {
                let before = fields.len();
                let end = add_fields(nested, &full, at, fields, limits)?;
                // Only the first repetition of a structure gets fields; a structure without repetitions has
                // none.
                fields.truncate(if repeats == 0 { before } else { fields.len() });
                (end - at).checked_mul(repeats).and_then(|bytes| at.checked_add(bytes))
            }
        };
        at = end
            .filter(|end| *end <= u32::MAX as usize)
            .ok_or_else(|| wrong_type("a type has too many bytes"))?;
        limits.check_attributes(FORMAT, fields.len(), "fields or more")?;
    }
    Ok(at)
}

fn repeats_of(shape: &Literal) -> Result<usize> {
    let length = |literal: &Literal| match literal {
        Literal::Integer(length) => usize::try_from(*length).ok(),
        _ => None,
    };
    let repeats = match shape {
        Literal::List(lengths) => {
            lengths.iter().try_fold(1usize, |repeats, literal| repeats.checked_mul(length(literal)?))
        }
        single => length(single),
    };
    repeats.ok_or_else(|| wrong_type("the shape of a field is invalid"))
}

/// A parsed type code: the size of an element, and its number type if it is numeric.
struct ElementType {
    bytes: usize,
    number: Option<(NumberType, Endian)>,
}

/// Parses a byte order, a letter and a size: `<f4`.
fn element(code: &str) -> Result<ElementType> {
    let invalid = || wrong_type(format!("unknown type \"{}\"", excerpt(code)));
    let (endian, rest) = match code.split_at_checked(1) {
        Some((">", rest)) => (Endian::Big, rest),
        Some(("<" | "|" | "=", rest)) => (Endian::Little, rest), // `=` means native, which is little-endian in practice
        _ => (Endian::Little, code),
    };
    let (letter, size) = rest.split_at_checked(1).ok_or_else(invalid)?;
    let digits = size.split('[').next().unwrap_or_default(); // datetime64 has a unit in brackets
    let size: usize = if digits.is_empty() { 0 } else { digits.parse().map_err(|_| invalid())? };
    let number = match (letter, size) {
        ("?", 0) | ("b", 1) => Some(NumberType::Bool),
        ("i", 1 | 2 | 4 | 8) => NumberType::of_kind('i', size),
        ("u", 1 | 2 | 4 | 8) => NumberType::of_kind('u', size),
        ("f", 2 | 4 | 8) => NumberType::of_kind('f', size),
        ("S" | "a" | "U" | "V" | "O" | "c" | "M" | "m" | "f", _) => None,
        _ => return Err(invalid()),
    };
    let bytes = match letter {
        "?" => 1,
        "U" => size.checked_mul(4).ok_or_else(invalid)?,
        "O" => 8, // a reference; the pickled objects follow
        _ => size,
    };
    Ok(ElementType { bytes, number: number.map(|number| (number, endian)) })
}

// The Python literals that can occur in a header.

/// A Python literal.
#[derive(Clone, Debug, PartialEq)]
enum Literal {
    Text(String),
    Integer(u64),
    Bool(bool),
    /// A list or a tuple.
    List(Vec<Literal>),
    /// Keys and values.
    Dictionary(Vec<(Literal, Literal)>),
}

/// Nesting limit for lists: the header of a structured type has four levels, plus two per nested structure.
const DEPTH_MAX: usize = 32;

/// Parses all of `text`, which starts at offset `offset` of the file, as one literal.
fn parse(text: &[u8], offset: usize) -> Result<Literal> {
    let mut parser = Parser { text, at: 0, offset };
    let literal = parser.literal(0)?;
    match parser.peek() {
        None => Ok(literal),
        Some(_) => Err(parser.unexpected("the end of the header")),
    }
}

struct Parser<'a> {
    text: &'a [u8],
    at: usize,
    offset: usize,
}

impl Parser<'_> {
    /// The next nonblank byte, without consuming it.
    fn peek(&mut self) -> Option<u8> {
        let rest = &self.text[self.at..];
        self.at += rest.iter().take_while(|byte| byte.is_ascii_whitespace()).count();
        self.text.get(self.at).copied()
    }

    fn take(&mut self, byte: u8) -> bool {
        let is_next = self.peek() == Some(byte);
        self.at += usize::from(is_next);
        is_next
    }

    fn literal(&mut self, depth: usize) -> Result<Literal> {
        if depth > DEPTH_MAX {
            return Err(self.unexpected(&format!("at most {DEPTH_MAX} nested lists")));
        }
        match self.peek() {
            Some(b'{') => self.dictionary(depth),
            Some(b'[') => self.list(b']', depth),
            Some(b'(') => self.list(b')', depth),
            Some(quote @ (b'\'' | b'"')) => self.text(quote),
            Some(b'0'..=b'9') => self.integer(),
            _ => self.word(),
        }
    }

    fn dictionary(&mut self, depth: usize) -> Result<Literal> {
        let mut entries = Vec::new();
        self.at += 1;
        while !self.take(b'}') {
            let key = self.literal(depth + 1)?;
            if !self.take(b':') {
                return Err(self.unexpected("`:`"));
            }
            entries.push((key, self.literal(depth + 1)?));
            if !self.take(b',') && self.peek() != Some(b'}') {
                return Err(self.unexpected("`,` or `}`"));
            }
        }
        Ok(Literal::Dictionary(entries))
    }

    fn list(&mut self, close: u8, depth: usize) -> Result<Literal> {
        let mut items = Vec::new();
        self.at += 1;
        while !self.take(close) {
            items.push(self.literal(depth + 1)?);
            if !self.take(b',') && self.peek() != Some(close) {
                return Err(self.unexpected("`,` or the end of the list"));
            }
        }
        Ok(Literal::List(items))
    }

    /// Parses a string. Keeps escapes as spelled, such as that of a quote.
    fn text(&mut self, quote: u8) -> Result<Literal> {
        let rest = &self.text[self.at + 1..];
        let mut is_escaped = false;
        for (length, &byte) in rest.iter().enumerate() {
            if byte == quote && !is_escaped {
                self.at += length + 2;
                return Ok(Literal::Text(String::from_utf8_lossy(&rest[..length]).into_owned()));
            }
            is_escaped = byte == b'\\' && !is_escaped;
        }
        Err(self.unexpected("the end of a string"))
    }

    fn integer(&mut self) -> Result<Literal> {
        let digits = self.text[self.at..].iter().take_while(|byte| byte.is_ascii_digit()).count();
        let text = std::str::from_utf8(&self.text[self.at..self.at + digits]).unwrap_or_default();
        let Ok(integer) = text.parse() else { return Err(self.unexpected("a 64-bit integer")) };
        self.at += digits;
        self.at += usize::from(self.text.get(self.at) == Some(&b'L')); // Python 2
        Ok(Literal::Integer(integer))
    }

    fn word(&mut self) -> Result<Literal> {
        for (word, value) in [(&b"True"[..], true), (b"False", false)] {
            if self.text[self.at..].starts_with(word) {
                self.at += word.len();
                return Ok(Literal::Bool(value));
            }
        }
        Err(self.unexpected("a literal"))
    }

    fn unexpected(&self, expected: &str) -> Error {
        let rest = &self.text[self.at.min(self.text.len())..];
        let found = match rest {
            [] => "the end".to_string(),
            _ => format!("`{}`", rest[..rest.len().min(16)].escape_ascii()),
        };
        let position = Position::Offset((self.offset + self.at) as u64);
        Error::invalid(FORMAT, position, format!("the header: expected {expected}, found {found}"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn python_dictionaries_are_parsed() {
        let text = b"{'descr': [('pos', '<f4', (3L,)), (\"it's\", '|b1')], 'fortran_order': False, }  \n";
        let found = format!("{:?}", parse(text, 10).unwrap());
        assert_eq!(
            found,
            "Dictionary([(Text(\"descr\"), List([List([Text(\"pos\"), Text(\"<f4\"), List([Integer(3)])]), \
             List([Text(\"it's\"), Text(\"|b1\")])])), (Text(\"fortran_order\"), Bool(false))])"
        );
    }

    #[test]
    fn malformed_headers_are_errors_with_offset() {
        let deep = "[".repeat(100_000);
        let table = [
            ("{'a' 1}", "at byte 15: the header: expected `:`, found `1}`"),
            ("{'a': 1", "expected `,` or `}`, found the end"),
            ("{} x", "expected the end of the header, found `x`"),
            ("'a", "expected the end of a string"),
            ("99999999999999999999", "a 64-bit integer"),
            ("None", "expected a literal, found `None`"),
            (&deep, "at most 32 nested lists"),
        ];
        for (text, expected) in table {
            let error = parse(text.as_bytes(), 10).unwrap_err().to_string();
            assert!(error.contains(expected), "{error}");
        }
    }
}
