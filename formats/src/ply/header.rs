//! The text header of a PLY file: the encoding of the body and the layout of its records.
//!
//! Lines can end in LF, CR LF or CR, even if the body is binary: on Windows, a program that writes the header
//! in text mode and then appends the body writes CR LF. The body starts exactly one line end after
//! `end_header`, of the same kind as that of the first line.

use super::FORMAT;
use crate::core::bytes::Endian;
use crate::core::columns::{Columns, group_columns};
use crate::core::error::{Error, Position, Result};
use crate::core::limits::Limits;
use crate::core::number::NumberType;
use crate::core::text::{Lines, excerpt};

/// The encoding of the records after the header.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Encoding {
    /// One record per line.
    Ascii,
    /// Packed records, least significant byte first.
    BinaryLittleEndian,
    /// Packed records, most significant byte first.
    BinaryBigEndian,
}

impl Encoding {
    /// The byte order of a binary body, `None` for text.
    pub fn endian(self) -> Option<Endian> {
        match self {
            Encoding::Ascii => None,
            Encoding::BinaryLittleEndian => Some(Endian::Little),
            Encoding::BinaryBigEndian => Some(Endian::Big),
        }
    }
}

/// The type of a property.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PropertyType {
    /// One number.
    Scalar(NumberType),
    /// A count, then that many numbers.
    List {
        /// Type of the count, an integer.
        count: NumberType,
        /// Type of the numbers.
        item: NumberType,
    },
}

impl PropertyType {
    /// The minimum number of bytes of the property in a binary record.
    fn size_min(self) -> usize {
        match self {
            PropertyType::Scalar(scalar) => scalar.size(),
            PropertyType::List { count, .. } => count.size(),
        }
    }
}

/// A named property of each record of an element.
#[derive(Clone, Debug, PartialEq)]
pub struct Property {
    /// The name in the file.
    pub name: String,
    /// Its type.
    pub kind: PropertyType,
}

/// An element: a table of records, such as the vertices.
#[derive(Clone, Debug, PartialEq)]
pub struct Element {
    /// The name in the file.
    pub name: String,
    /// Number of records declared by the header.
    pub count: u64,
    /// The properties of each record.
    pub properties: Vec<Property>,
}

impl Element {
    /// Whether any property is a list, so that the length of records varies.
    pub fn has_list(&self) -> bool {
        self.properties.iter().any(|property| matches!(property.kind, PropertyType::List { .. }))
    }

    /// Bytes per binary record: exact without lists, else the minimum.
    pub fn record_size_min(&self) -> usize {
        self.properties.iter().map(|property| property.kind.size_min()).sum()
    }

    /// Groups the scalar properties into position and attributes. Columns are indices into `properties`.
    pub fn columns(&self) -> Columns {
        let mut indices = Vec::new();
        let mut columns = Vec::new();
        for (index, property) in self.properties.iter().enumerate() {
            if let PropertyType::Scalar(scalar) = property.kind {
                indices.push(index);
                columns.push((property.name.as_str(), scalar));
            }
        }
        let mut grouped = group_columns(&columns);
        grouped.position = grouped.position.map(|position| position.map(|column| indices[column]));
        for column in grouped.groups.iter_mut().flat_map(|group| &mut group.columns) {
            *column = indices[*column];
        }
        grouped
    }
}

/// The content of a PLY header.
#[derive(Clone, Debug, PartialEq)]
pub struct PlyHeader {
    /// The encoding of the body.
    pub encoding: Encoding,
    /// The elements, in the order of the body.
    pub elements: Vec<Element>,
    /// The texts of the `comment` and `obj_info` lines.
    pub comments: Vec<String>,
    /// Offset of the body, in bytes from the start of the file.
    pub body_offset: usize,
}

impl PlyHeader {
    /// The element with the particles: the one named `vertex`, else the first with a position.
    pub fn vertex_element(&self) -> Option<&Element> {
        let named = self.elements.iter().find(|element| element.name.eq_ignore_ascii_case("vertex"));
        named.or_else(|| self.elements.iter().find(|element| element.columns().position.is_some()))
    }

    /// Whether the file declares faces, so that it is a mesh. Strips of triangles count, too, although the
    /// reader of meshes refuses them: its message says what to do.
    pub fn has_faces(&self) -> bool {
        let is_named = |element: &Element, name: &str| element.name.eq_ignore_ascii_case(name);
        self.elements
            .iter()
            .any(|element| element.count > 0 && (is_named(element, "face") || is_named(element, "tristrips")))
    }

    /// The minimum size in bytes of a complete file with this header; exact for a binary file without lists.
    /// `None` if it exceeds 2⁶⁴.
    pub fn file_size_min(&self) -> Option<u64> {
        let mut size = self.body_offset as u64;
        for element in &self.elements {
            let record = match self.encoding {
                Encoding::Ascii => 2 * element.properties.len(), // a digit and a separator
                _ => element.record_size_min(),
            };
            size = size.checked_add(element.count.checked_mul(record as u64)?)?;
        }
        // The last line of a text needs no line end.
        let unended = self.encoding == Encoding::Ascii && size > self.body_offset as u64;
        Some(size - u64::from(unended))
    }
}

/// Reads only the header.
///
/// # Errors
/// `Truncated` if the file ends before `end_header`; `Invalid` if the header is malformed; `TooLarge` beyond
/// the limits `header_bytes` or `attribute_count`.
pub fn read_header(bytes: &[u8], limits: &Limits) -> Result<PlyHeader> {
    let capped = usize::try_from(limits.header_bytes).map_or(bytes, |most| &bytes[..bytes.len().min(most)]);
    let mut lines = Lines::new(capped);
    if lines.next().map(<[u8]>::trim_ascii) != Some(b"ply") {
        return Err(Error::invalid(FORMAT, Position::Line(1), "expected `ply`"));
    }
    let mut parsed = PartialHeader { encoding: None, elements: Vec::new(), comments: Vec::new() };
    while let Some(line) = lines.next() {
        let line = String::from_utf8_lossy(line);
        let (keyword, rest) = first_word(&line);
        let is_last = keyword == "end_header";
        if !lines.was_ended() && (!is_last || capped.len() < bytes.len()) {
            break; // the last line may be truncated
        }
        if is_last {
            let encoding = parsed.encoding.ok_or_else(|| {
                Error::invalid(FORMAT, Position::Line(lines.number()), "the header has no `format` line")
            })?;
            let PartialHeader { elements, comments, .. } = parsed;
            return Ok(PlyHeader { encoding, elements, comments, body_offset: lines.at() });
        }
        parsed.take_line(keyword, rest, limits, lines.number())?;
    }
    if capped.len() < bytes.len() {
        return Err(Error::too_large(
            FORMAT,
            format!("no `end_header` within the {} bytes allowed for a header", limits.header_bytes),
        ));
    }
    Err(Error::truncated(FORMAT, Position::Offset(bytes.len() as u64), "the file ends before `end_header`"))
}

/// The header parsed so far.
struct PartialHeader {
    encoding: Option<Encoding>,
    elements: Vec<Element>,
    comments: Vec<String>,
}

impl PartialHeader {
    fn take_line(&mut self, keyword: &str, rest: &str, limits: &Limits, number: u64) -> Result<()> {
        let invalid = |what: String| Error::invalid(FORMAT, Position::Line(number), what);
        match keyword {
            "" => {}
            "comment" | "obj_info" => self.comments.push(rest.into()),
            "format" => self.encoding = Some(parse_format(rest).map_err(invalid)?),
            "element" => self.elements.push(parse_element(rest).map_err(invalid)?),
            "property" => {
                let element = self.elements.last_mut();
                let element =
                    element.ok_or_else(|| invalid("the header has a property before any element".into()))?;
                if element.properties.len() >= limits.attribute_count {
                    let (name, most) = (excerpt(&element.name), limits.attribute_count);
                    let what = format!("element `{name}` has more properties than the limit of {most}");
                    return Err(Error::too_large(FORMAT, what));
                }
                element.properties.push(parse_property(rest).map_err(invalid)?);
            }
            _ => return Err(invalid(format!("unknown keyword `{}`", excerpt(keyword)))),
        }
        Ok(())
    }
}

fn parse_format(rest: &str) -> std::result::Result<Encoding, String> {
    let (name, version) = first_word(rest);
    if version != "1.0" {
        return Err(format!("expected format version 1.0, found `{}`", excerpt(version)));
    }
    match name {
        "ascii" => Ok(Encoding::Ascii),
        "binary_little_endian" => Ok(Encoding::BinaryLittleEndian),
        "binary_big_endian" => Ok(Encoding::BinaryBigEndian),
        _ => Err(format!("unknown encoding `{}`", excerpt(name))),
    }
}

fn parse_element(rest: &str) -> std::result::Result<Element, String> {
    let (name, count) = first_word(rest);
    let count = count.parse().map_err(|_| {
        format!("expected the number of `{}` records, found `{}`", excerpt(name), excerpt(count))
    })?;
    Ok(Element { name: name.into(), count, properties: Vec::new() })
}

fn parse_property(rest: &str) -> std::result::Result<Property, String> {
    let (first, rest) = first_word(rest);
    let (kind, name) = if first == "list" {
        let (count, rest) = first_word(rest);
        let (item, name) = first_word(rest);
        let count = parse_scalar(count)?;
        if matches!(count, NumberType::F32 | NumberType::F64) {
            return Err("the count of a list must have an integer type".into());
        }
        (PropertyType::List { count, item: parse_scalar(item)? }, name)
    } else {
        (PropertyType::Scalar(parse_scalar(first)?), rest)
    };
    if name.is_empty() {
        return Err("the header has a property without a name".into());
    }
    Ok(Property { name: name.into(), kind })
}

fn parse_scalar(name: &str) -> std::result::Result<NumberType, String> {
    let named = SCALARS.iter().find(|(names, _)| names.contains(&name));
    named.map(|&(_, scalar)| scalar).ok_or_else(|| format!("unknown type `{}`", excerpt(name)))
}

/// Splits off the first word; trims spaces from the rest.
fn first_word(text: &str) -> (&str, &str) {
    let text = text.trim();
    text.split_once(char::is_whitespace).map_or((text, ""), |(word, rest)| (word, rest.trim_start()))
}

/// The names of the types: the original ones and those with sizes.
const SCALARS: &[([&str; 2], NumberType)] = &[
    (["char", "int8"], NumberType::I8),
    (["uchar", "uint8"], NumberType::U8),
    (["short", "int16"], NumberType::I16),
    (["ushort", "uint16"], NumberType::U16),
    (["int", "int32"], NumberType::I32),
    (["uint", "uint32"], NumberType::U32),
    (["float", "float32"], NumberType::F32),
    (["double", "float64"], NumberType::F64),
];

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn body_starts_one_line_end_after_the_header() {
        for end in ["\n", "\r\n", "\r"] {
            let lines =
                ["ply", " format binary_little_endian 1.0", "comment a", "element vertex 0", "end_header"];
            let header = lines.map(|line| format!("{line}{end}")).concat();
            // A body whose first bytes look like a line end.
            let file = format!("{header}\n\r\n");
            let read = read_header(file.as_bytes(), &Limits::default()).unwrap();
            assert_eq!(read.body_offset, header.len(), "after {end:?}");
            assert_eq!(read.comments, ["a"]);
        }
    }

    #[test]
    fn header_gives_the_size_of_a_binary_file() {
        let header = "ply\nformat binary_big_endian 1.0\nelement a 2\nproperty list uchar int v\n\
                      element Vertex 3\nproperty double x\nproperty short k\nend_header\n";
        let read = read_header(header.as_bytes(), &Limits::default()).unwrap();
        assert_eq!(read.file_size_min(), Some(header.len() as u64 + 2 + 30));
        assert_eq!(read.vertex_element().unwrap().name, "Vertex");
    }
}
