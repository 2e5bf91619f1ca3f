//! The text form of classic geometry, `.geo`: the same content as words.
//!
//! ```text
//!   PGEOMETRY V5
//!   NPoints 5 NPrims 1
//!   NPointGroups 0 NPrimGroups 0
//!   NPointAttrib 2 NVertexAttrib 0 NPrimAttrib 1 NAttrib 0
//!   PointAttrib
//!   life 2 float 0 0                          name, size, type, defaults; or, for `index`, count and strings
//!   id 1 int 0
//!   0 0.1 0.2 1 (-1.2 10    0)                x y z w, then the values of all attributes in brackets
//!   ..                                        primitives and everything else: not read
//! ```

use crate::named_arrays::{NamedArray, frame_of};
use crate::number::divided;
use crate::text::{excerpt, line_number};
use crate::{Error, FilePositions, Limits, ParticleFrame, Position, Result, Values};

/// The format's name in errors.
const FORMAT: &str = "classic Houdini GEO (text)";

/// Reads the points of classic geometry in text form.
///
/// # Errors
///
/// [`Error::Invalid`] with the line for an unexpected word, [`Error::Truncated`] if points are missing,
/// [`Error::Unsupported`] for another version, [`Error::TooLarge`] beyond `limits`.
pub fn read_text(bytes: &[u8], limits: &Limits) -> Result<ParticleFrame> {
    let mut words = WordReader { bytes, at: 0 };
    let head = (words.next("PGEOMETRY")?, words.next("the version")?);
    if head != (b"PGEOMETRY", b"V5") {
        let found = [head.0, b" ", head.1].concat();
        return Err(Error::unsupported(
            FORMAT,
            format!("found `{}`; only PGEOMETRY V5 is supported", excerpt(found)),
        ));
    }
    let (mut point_count, mut attribute_count) = (0, 0);
    for name in COUNTS {
        let found = words.next(name)?;
        if found != name.as_bytes() {
            return Err(words.expected(name, found));
        }
        let count: u32 = words.number(&format!("the number after {name}"))?;
        match *name {
            "NPoints" => point_count = count as usize,
            "NPointAttrib" => attribute_count = count as usize,
            _ => {}
        }
    }
    limits.check_particles(FORMAT, point_count as u64)?;
    limits.check_attributes(FORMAT, attribute_count, "point attributes")?;
    let mut columns = dictionary(&mut words, attribute_count, limits)?;
    let positions = points(&mut words, point_count, &mut columns)?;
    let arrays = columns.into_iter().map(TextColumn::into_array).collect();
    // With positions given, a frame is always returned.
    Ok(frame_of(Some(FilePositions::F32(positions)), arrays).unwrap_or_default())
}

/// The counts, in file order.
const COUNTS: &[&str] = &[
    "NPoints",
    "NPrims",
    "NPointGroups",
    "NPrimGroups",
    "NPointAttrib",
    "NVertexAttrib",
    "NPrimAttrib",
    "NAttrib",
];

/// An attribute under construction.
struct TextColumn {
    name: String,
    arity: usize,
    table: Vec<String>,
    values: TextValues,
}

enum TextValues {
    Reals(Vec<f32>),
    Integers(Vec<i32>),
    Indices(Vec<i32>),
}

impl TextColumn {
    fn into_array(self) -> NamedArray {
        let values = match self.values {
            TextValues::Reals(values) => Values::F32(values),
            TextValues::Integers(values) => Values::I32(values),
            TextValues::Indices(indices) => Values::Strings { table: self.table, indices },
        };
        NamedArray { name: self.name, arity: self.arity, values }
    }
}

fn dictionary(words: &mut WordReader, count: usize, limits: &Limits) -> Result<Vec<TextColumn>> {
    if count == 0 {
        return Ok(Vec::new());
    }
    let title = words.next("PointAttrib")?;
    if title != b"PointAttrib" {
        return Err(words.expected("PointAttrib", title));
    }
    let mut string_count = 0;
    (0..count).map(|_| column(words, &mut string_count, limits)).collect()
}

/// One attribute of the dictionary. `string_count` counts the strings of all attributes.
fn column(words: &mut WordReader, string_count: &mut usize, limits: &Limits) -> Result<TextColumn> {
    let name = String::from_utf8_lossy(words.next("the name of an attribute")?).into_owned();
    let arity: u16 = words.number("the size of an attribute")?;
    let arity = usize::from(arity);
    if arity == 0 || arity > limits.attribute_count {
        return Err(words.invalid(format!(
            "the attribute `{}` has {arity} values per point; expected 1 to {}",
            excerpt(&name),
            limits.attribute_count
        )));
    }
    let kind = words.next("the type of an attribute")?;
    let mut table = Vec::new();
    let values = match kind {
        b"float" | b"vector" => TextValues::Reals(Vec::new()),
        b"int" => TextValues::Integers(Vec::new()),
        b"index" => {
            let count: u32 = words.number("the number of strings")?;
            // A string takes dozens of bytes of memory, but as few as two in the file: without this limit, a
            // small file could use much memory.
            let most = (1 << 16) + words.bytes.len() / 16;
            *string_count = string_count.saturating_add(count as usize);
            if *string_count > most {
                return Err(Error::too_large(
                    FORMAT,
                    format!(
                        "with the attribute `{}`, the file has {string_count} strings, more than the limit of {most}",
                        excerpt(&name)
                    ),
                ));
            }
            for _ in 0..count {
                let text = words.next("a string")?;
                table.push(String::from_utf8_lossy(text).trim_matches('"').to_owned());
            }
            TextValues::Indices(Vec::new())
        }
        other => return Err(words.expected("float, int, vector or index", other)),
    };
    if kind != b"index" {
        for _ in 0..arity {
            words.number::<f64>("a default")?;
        }
    }
    Ok(TextColumn { name, arity, table, values })
}

fn points(words: &mut WordReader, count: usize, columns: &mut [TextColumn]) -> Result<Vec<[f32; 3]>> {
    const POINT_BYTES_MIN: usize = 8; // four numbers and their separators
    let remaining = words.bytes.len() - words.at;
    // The last number needs no separator.
    if count.saturating_mul(POINT_BYTES_MIN) > remaining + 1 {
        return Err(words.truncated(format!("expected {count} points, but only {remaining} bytes remain")));
    }
    let value_of = |column: &TextColumn| format!("a value of the attribute `{}`", excerpt(&column.name));
    let descriptions: Vec<String> = columns.iter().map(value_of).collect();
    let mut positions = Vec::with_capacity(count);
    for _ in 0..count {
        let mut coordinate = || words.number::<f32>("a coordinate of a point");
        positions.push(divided([coordinate()?, coordinate()?, coordinate()?, coordinate()?]));
        for (TextColumn { arity, values, .. }, what) in columns.iter_mut().zip(&descriptions) {
            for _ in 0..*arity {
                match values {
                    TextValues::Reals(values) => values.push(words.number(what)?),
                    TextValues::Integers(values) | TextValues::Indices(values) => {
                        values.push(words.number(what)?);
                    }
                }
            }
        }
    }
    Ok(positions)
}

/// The words of the file, separated by any blanks and brackets.
struct WordReader<'a> {
    bytes: &'a [u8],
    at: usize,
}

impl<'a> WordReader<'a> {
    /// The next word; `what` is named in the error if there is none.
    fn next(&mut self, what: &str) -> Result<&'a [u8]> {
        let is_between = |byte: &u8| byte.is_ascii_whitespace() || matches!(byte, b'(' | b')');
        let rest = &self.bytes[self.at..];
        let blanks = rest.iter().take_while(|byte| is_between(byte)).count();
        let rest = &rest[blanks..];
        let is_quoted = rest.first() == Some(&b'"');
        let end = if is_quoted {
            rest[1..].iter().position(|&byte| byte == b'"').map(|length| length + 2)
        } else {
            rest.iter().position(is_between)
        };
        let length = end.unwrap_or(rest.len());
        self.at += blanks + length;
        match length {
            0 => Err(self.truncated(format!("the file ends before {what}"))),
            _ => Ok(&rest[..length]),
        }
    }

    fn number<T: std::str::FromStr>(&mut self, what: &str) -> Result<T> {
        let word = self.next(what)?;
        let number = std::str::from_utf8(word).ok().and_then(|word| word.parse().ok());
        number.ok_or_else(|| {
            if self.at == self.bytes.len() {
                self.truncated(format!("the file ends within {what}"))
            } else {
                self.expected(what, word)
            }
        })
    }

    fn expected(&self, what: &str, found: &[u8]) -> Error {
        self.invalid(format!("expected {what}, found `{}`", excerpt(found)))
    }

    fn invalid(&self, what: String) -> Error {
        Error::invalid(FORMAT, Position::Line(line_number(self.bytes, self.at.saturating_sub(1))), what)
    }

    fn truncated(&self, what: String) -> Error {
        Error::truncated(FORMAT, Position::Line(line_number(self.bytes, self.at.saturating_sub(1))), what)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{AttributeRole, FileAttribute};

    const TEXT: &str = "PGEOMETRY V5\nNPoints 2 NPrims 1\nNPointGroups 0 NPrimGroups 0\nNPointAttrib 3 NVertexAttrib 0 \
         NPrimAttrib 1 NAttrib 0\nPointAttrib\n\nlife 2 float 0 0\nid 1 int 0\npart 1 index 2 \"a b\" c\n0 0.1 0.2 1 (-1.2 10\t0\t1)\n\
         2 4 6 2 (-0.2 10\t1\t0)\nPrimitiveAttrib\n";

    #[test]
    fn text_points_are_read() {
        let frame = read_text(TEXT.as_bytes(), &Limits::default()).unwrap();
        assert_eq!(frame.positions, FilePositions::F32(vec![[0.0, 0.1, 0.2], [1.0, 2.0, 3.0]]));
        let attribute =
            |name: &str, arity, role, values| FileAttribute { name: name.into(), arity, role, values };
        let table = vec!["a b".into(), "c".into()];
        let expected = [
            attribute("life", 2, None, Values::F32(vec![-1.2, 10.0, -0.2, 10.0])),
            attribute("id", 1, Some(AttributeRole::Id), Values::I32(vec![0, 1])),
            attribute("part", 1, None, Values::Strings { table, indices: vec![1, 0] }),
        ];
        assert_eq!(frame.attributes, expected);
    }

    #[test]
    fn invalid_text_is_an_error_with_its_line() {
        let strings = " x".repeat(40_000);
        let two_tables = format!("a 1 index 40000{strings}\nb 1 index 40000{strings}\n");
        let table = [
            (TEXT.replace("V5", "V4"), "only PGEOMETRY V5"),
            (TEXT.replace("NPoints 2", "NPoints 4000000000"), "expected 4000000000 points"),
            (
                TEXT.replace("NPoints 2", "NPoints 3"),
                "at line 12: expected a coordinate of a point, found `PrimitiveAttrib`",
            ),
            (
                TEXT.replace("life 2 float", "life 2 half"),
                "at line 7: expected float, int, vector or index, found `half`",
            ),
            (TEXT.replace("life 2", "life 0"), "has 0 values"),
            (TEXT.replace("NPoints 2", "NPoints two"), "expected the number after NPoints, found `two`"),
            (TEXT.replace("(-1.2", "(low"), "expected a value of the attribute `life`, found `low`"),
            (
                TEXT.replace("life 2 float 0 0\nid 1 int 0\n", &two_tables),
                "with the attribute `b`, the file has 80000 strings",
            ),
            (
                TEXT.replace("index 2 \"a b\" c", "index 4294967295 a"),
                "with the attribute `part`, the file has 4294967295 strings",
            ),
        ];
        for (text, words) in table {
            let error = read_text(text.as_bytes(), &Limits::default()).unwrap_err().to_string();
            assert!(error.contains(words), "{error}");
        }
    }
}
