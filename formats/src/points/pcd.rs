//! PCD, the point clouds of the Point Cloud Library (PCL).
//!
//! ```text
//!   # .PCD v0.7 - Point Cloud Data file format
//!   VERSION 0.7
//!   FIELDS x y z rgb _             `_` names padding
//!   SIZE 4 4 4 4 1                 bytes of each number
//!   TYPE F F F F U                 floats, signed and unsigned integers
//!   COUNT 1 1 1 1 4                numbers of each field for a point; 1 without this line
//!   WIDTH 213                      213 points in all without POINTS
//!   HEIGHT 1
//!   VIEWPOINT 0 0 0 1 0 0 0        ignored
//!   POINTS 213
//!   DATA ascii                     a line for each point; or binary: packed records; or binary_compressed:
//!                                  two sizes, then LZF, which unpacks to field after field
//! ```
//!
//! Numbers in binary data are little-endian. `rgb` and `rgba` pack a colour into 32 bits, whatever their type.

use crate::core::bytes::Endian;
use crate::core::data::{FileAttribute, ParticleFrame, Values};
use crate::core::error::{Error, Position, Result};
use crate::core::limits::Limits;
use crate::core::lzf;
use crate::core::named_arrays::frame_of;
use crate::core::number::NumberType;
use crate::core::row::{FormatRow, ParticleReader};
use crate::core::text::open_end_note;
use crate::core::text::{Lines, excerpt, excerpts, parse_number};

/// The format's name in errors.
const FORMAT: &str = "PCD";

/// The row in the table of formats.
pub(crate) static ROW: FormatRow = FormatRow {
    signatures: &[
        b"# .PCD v",
        b"VERSION .7\nFIELDS ",
        b"VERSION .7\r\nFIELDS ",
        b"VERSION 0.7\nFIELDS ",
        b"VERSION 0.7\r\nFIELDS ",
    ],
    beginnings: &[b"# .PCD v"],
    particles: Some(ParticleReader::needs_reading(read)),
    ..FormatRow::new(FORMAT, &["pcd"])
};

/// The header.
struct Header {
    fields: Vec<PcdField>,
    point_count: usize,
    encoding: PcdData,
    /// Offset and line number of the first point.
    offset: usize,
    line: u64,
}

struct PcdField {
    name: String,
    number: NumberType,
    /// Numbers of a point.
    count: usize,
}

#[derive(Clone, Copy)]
enum PcdData {
    Ascii,
    Binary,
    Compressed,
}

/// Reads a point cloud.
///
/// # Errors
/// [`Error::Truncated`] if the file ends too early; [`Error::Invalid`], with the line or the offset, if it is
/// malformed or has no position; [`Error::TooLarge`] beyond `limits`.
pub fn read(bytes: &[u8], limits: &Limits) -> Result<ParticleFrame> {
    let header = Header::read(bytes, limits)?;
    let no_position = || {
        let names = excerpts(header.fields.iter().map(|field| &field.name));
        Error::invalid(FORMAT, Position::File, format!("no fields x, y and z; found: {names}"))
    };
    let body = bytes.get(header.offset..).unwrap_or_default();
    let arrays = match header.encoding {
        PcdData::Ascii => header.arrays_of_records(&header.records_of_text(body)?),
        PcdData::Binary => header.arrays_of_records(header.records(body)?),
        PcdData::Compressed => header.arrays_of_fields(&header.unpacked(body)?),
    };
    let mut frame = frame_of(None, arrays).ok_or_else(no_position)?;
    let is_text = matches!(header.encoding, PcdData::Ascii) && header.point_count > 0;
    frame.notes.extend(open_end_note(body).filter(|_| is_text));
    Ok(frame)
}

/// What the lines of a header declare.
#[derive(Default)]
struct Declared {
    names: Vec<String>,
    sizes: Vec<usize>,
    kinds: Vec<String>,
    counts: Vec<usize>,
    width: Option<usize>,
    height: Option<usize>,
    points: Option<usize>,
}

impl Declared {
    /// Takes a line. The error says what was expected.
    fn take(&mut self, keyword: &str, words: &[&str]) -> std::result::Result<(), &'static str> {
        let numbers = || -> Option<Vec<usize>> { words.iter().map(|word| word.parse().ok()).collect() };
        let number = || match numbers().as_deref() {
            Some(&[number]) => Ok(Some(number)),
            _ => Err("a number"),
        };
        match keyword {
            "VERSION" | "VIEWPOINT" => {}
            "FIELDS" | "COLUMNS" => self.names = words.iter().map(ToString::to_string).collect(),
            "SIZE" => self.sizes = numbers().ok_or("a size for each field")?,
            "TYPE" => self.kinds = words.iter().map(|word| word.to_ascii_lowercase()).collect(),
            "COUNT" => self.counts = numbers().ok_or("a count for each field")?,
            "WIDTH" => self.width = number()?,
            "HEIGHT" => self.height = number()?,
            "POINTS" => self.points = number()?,
            _ => return Err("a keyword of the header, such as FIELDS or DATA"),
        }
        Ok(())
    }

    /// The fields. The error says what is wrong.
    fn fields(&mut self) -> std::result::Result<Vec<PcdField>, String> {
        let count = self.names.len();
        if self.counts.is_empty() {
            self.counts = vec![1; count];
        }
        let found = [self.sizes.len(), self.kinds.len(), self.counts.len()];
        if count == 0 || found != [count; 3] {
            let [sizes, kinds, counts] = found;
            return Err(format!(
                "expected SIZE, TYPE and COUNT for each of {count} fields, found {sizes}, {kinds} and {counts}"
            ));
        }
        let field = |index: usize| {
            let (name, size, kind) = (&self.names[index], self.sizes[index], &*self.kinds[index]);
            let letter = kind.chars().next().filter(|_| kind.len() == 1).unwrap_or_default();
            let number = NumberType::of_kind(letter, size).filter(|number| *number != NumberType::F16);
            let wrong = || {
                format!(
                    "the field `{}` has the unknown type {kind} of {size} bytes",
                    excerpt(name.as_bytes())
                )
            };
            Ok(PcdField { name: name.clone(), number: number.ok_or_else(wrong)?, count: self.counts[index] })
        };
        (0..count).map(field).collect()
    }
}

impl Header {
    fn read(bytes: &[u8], limits: &Limits) -> Result<Header> {
        let head_bytes = usize::try_from(limits.header_bytes).unwrap_or(usize::MAX).min(bytes.len());
        let mut lines = Lines::new(&bytes[..head_bytes]);
        let mut declared = Declared::default();
        while let Some(line) = lines.next().filter(|_| lines.was_ended()) {
            let text = String::from_utf8_lossy(line).to_ascii_uppercase();
            let given = String::from_utf8_lossy(line);
            let (Some(keyword), words) =
                (text.split_ascii_whitespace().next(), given.split_ascii_whitespace())
            else {
                continue;
            };
            let words: Vec<&str> = words.skip(1).collect();
            if keyword == "DATA" {
                return Header::of(declared, &words, &lines, limits);
            }
            if !keyword.starts_with('#') {
                declared.take(keyword, &words).map_err(|expected| {
                    let what = format!("expected {expected}, found \"{}\"", excerpt(line));
                    Error::invalid(FORMAT, Position::Line(lines.number()), what)
                })?;
            }
        }
        if head_bytes < bytes.len() {
            let what = format!("expected DATA in the first {head_bytes} bytes");
            return Err(Error::too_large(FORMAT, what));
        }
        let what = "expected a line with DATA, found the end of the file";
        Err(Error::truncated(FORMAT, Position::Line(lines.number()), what))
    }

    /// The header that ends with a line of DATA, with these words.
    fn of(mut declared: Declared, words: &[&str], lines: &Lines, limits: &Limits) -> Result<Header> {
        let invalid = |what: String| Error::invalid(FORMAT, Position::Line(lines.number()), what);
        let encoding = match words {
            ["ascii"] => PcdData::Ascii,
            ["binary"] => PcdData::Binary,
            ["binary_compressed"] => PcdData::Compressed,
            _ => return Err(invalid("expected DATA ascii, binary or binary_compressed".into())),
        };
        let by_size = || Some(declared.width?.saturating_mul(declared.height.unwrap_or(1)));
        let point_count = declared.points.or_else(by_size);
        let point_count =
            point_count.ok_or_else(|| invalid("expected POINTS or WIDTH before DATA".into()))?;
        limits.check_particles(FORMAT, point_count as u64)?;
        let fields = declared.fields().map_err(invalid)?;
        let number_count = fields.iter().fold(0, |sum: usize, field| sum.saturating_add(field.count));
        limits.check_attributes(FORMAT, number_count, "numbers for each point")?;
        Ok(Header { fields, point_count, encoding, offset: lines.at(), line: lines.number() + 1 })
    }

    fn stride(&self) -> usize {
        self.fields.iter().map(|field| field.number.size() * field.count).sum()
    }

    /// The records of binary data.
    fn records<'a>(&self, body: &'a [u8]) -> Result<&'a [u8]> {
        let size = self.stride().saturating_mul(self.point_count);
        body.get(..size).ok_or_else(|| {
            let what = format!("expected {size} bytes for {} points, found {}", self.point_count, body.len());
            Error::truncated(FORMAT, Position::Offset(self.offset as u64), what)
        })
    }

    /// The fields, one after the other, of compressed data.
    fn unpacked(&self, body: &[u8]) -> Result<Vec<u8>> {
        let at = Position::Offset(self.offset as u64);
        let truncated = |what: String| Error::truncated(FORMAT, at, what);
        let (sizes, packed) =
            body.split_at_checked(8).ok_or_else(|| truncated("expected the sizes of the data".into()))?;
        let [packed_size, size] = [0, 4]
            .map(|at| u32::from_le_bytes([sizes[at], sizes[at + 1], sizes[at + 2], sizes[at + 3]]) as usize);
        let found = packed.len();
        let packed = packed.get(..packed_size).ok_or_else(|| {
            truncated(format!("expected {packed_size} bytes of compressed data, found {found}"))
        })?;
        let expected = self.stride().saturating_mul(self.point_count);
        if size != expected {
            let what = format!("{} points take {expected} bytes, but the data have {size}", self.point_count);
            return Err(Error::invalid(FORMAT, at, what));
        }
        if size == 0 {
            return Ok(Vec::new());
        }
        lzf::unpacked(packed, size)
            .ok_or_else(|| Error::invalid(FORMAT, at, "the compressed data are damaged"))
    }

    /// The records that the lines of a text stand for.
    fn records_of_text(&self, body: &[u8]) -> Result<Vec<u8>> {
        let numbers: Vec<NumberType> =
            self.fields.iter().flat_map(|field| std::iter::repeat_n(field.number, field.count)).collect();
        let mut records = Vec::new();
        let mut lines = Lines::new(body);
        for found in 0..self.point_count {
            let line = lines.find(|line| !line.trim_ascii().is_empty());
            let at = Position::Line(self.line + lines.number().saturating_sub(1));
            let Some(line) = line else {
                let what = format!("expected {} points, found {found}", self.point_count);
                return Err(Error::truncated(FORMAT, at, what));
            };
            let is_whole = lines.was_ended();
            let wrong = |what: String| {
                if is_whole { Error::invalid(FORMAT, at, what) } else { Error::truncated(FORMAT, at, what) }
            };
            let mut words = line.split(u8::is_ascii_whitespace).filter(|word| !word.is_empty());
            for (index, &number) in numbers.iter().enumerate() {
                let word = words
                    .next()
                    .ok_or_else(|| wrong(format!("expected {} numbers, found {index}", numbers.len())))?;
                append_number(word, number, &mut records)
                    .ok_or_else(|| wrong(format!("expected a number, found \"{}\"", excerpt(word))))?;
            }
            if words.next().is_some() {
                return Err(wrong(format!("expected {} numbers, found more", numbers.len())));
            }
        }
        Ok(records)
    }

    fn arrays_of_records(&self, records: &[u8]) -> Vec<FileAttribute> {
        let stride = self.stride();
        let mut offset = 0;
        let array = |field: &PcdField| {
            let start = offset;
            offset += field.number.size() * field.count;
            let decode = |number: NumberType| {
                number.decode_strided(records, Endian::Little, stride, start, field.count)
            };
            field.array(decode)
        };
        self.fields.iter().filter_map(array).collect()
    }

    fn arrays_of_fields(&self, data: &[u8]) -> Vec<FileAttribute> {
        let mut rest = data;
        let array = |field: &PcdField| {
            let bytes =
                rest.split_off(..field.number.size() * field.count * self.point_count).unwrap_or_default();
            field.array(|number| number.decode(bytes, Endian::Little))
        };
        self.fields.iter().filter_map(array).collect()
    }
}

impl PcdField {
    /// The field as an array; `decode` gives its numbers in a type of the same size. `None` for padding.
    fn array(&self, decode: impl Fn(NumberType) -> Values) -> Option<FileAttribute> {
        let PcdField { name, number, count } = self;
        if name == "_" || *count == 0 {
            return None;
        }
        // The colour is 0xAARRGGBB.
        let channels: &[usize] = match (&*name.to_ascii_lowercase(), count, number.size()) {
            ("rgb", 1, 4) => &[2, 1, 0],
            ("rgba", 1, 4) => &[2, 1, 0, 3],
            _ => return Some(FileAttribute::new(name.clone(), *count, decode(*number))),
        };
        let Values::I64(packed) = decode(NumberType::U32) else { return None };
        let bytes =
            packed.iter().flat_map(|color| channels.iter().map(|&channel| color.to_le_bytes()[channel]));
        Some(FileAttribute::new(name.clone(), channels.len(), Values::U8(bytes.collect())))
    }
}

/// Appends the bytes of a number that a text states; `None` if it is none, or does not fit.
fn append_number(word: &[u8], number: NumberType, records: &mut Vec<u8>) -> Option<()> {
    let real =
        || parse_number::<f64>(word).filter(|(_, length)| *length == word.len()).map(|(value, _)| value);
    let integer = || -> Option<i128> { std::str::from_utf8(word).ok()?.parse().ok() };
    macro_rules! append {
        ($kind:ty) => {
            records.extend_from_slice(&<$kind>::try_from(integer()?).ok()?.to_le_bytes())
        };
    }
    match number {
        NumberType::F32 => {
            let value = parse_number::<f32>(word).filter(|(_, length)| *length == word.len())?.0;
            records.extend_from_slice(&value.to_le_bytes());
        }
        NumberType::F64 => records.extend_from_slice(&real()?.to_le_bytes()),
        NumberType::I8 => append!(i8),
        NumberType::U8 => append!(u8),
        NumberType::I16 => append!(i16),
        NumberType::U16 => append!(u16),
        NumberType::I32 => append!(i32),
        NumberType::U32 => append!(u32),
        NumberType::I64 => append!(i64),
        NumberType::U64 => append!(u64),
        NumberType::Bool | NumberType::F16 => return None,
    }
    Some(())
}
