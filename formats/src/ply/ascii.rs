//! The body of an ASCII PLY file: one record per line, with values separated by spaces.
//!
//! A line with fewer or more values than the header declares is an error: taking values from the next line
//! instead would silently shift all that follow. Only if the first record takes several lines, as in files of
//! the RealSense Viewer, all records of its element may; each must end with a line. An error in the last
//! value of the file is reported as `Truncated`, because the value may be incomplete.
//!
//! If each record is a line, a long body is split at line ends. First the records before each part are
//! counted; then all parts are read in parallel, each into its own range of the vectors. If several parts
//! have errors, the error of the first of them is returned: it is the first error in the file.

use fast_float2::FastFloat;
use rayon::prelude::*;

use super::FORMAT;
use super::header::{Element, PropertyType};
use super::rows::RecordReader;
use crate::core::error::{Error, Position, Result};
use crate::core::number::NumberType;
use crate::core::records::{Slots, Target};
use crate::core::text::{line_number, parse_number};

/// Size of a part: large enough to make the cost of starting one negligible, small enough to share the work.
const PART_BYTES: usize = 1 << 20;

/// Reads the next `count` records into the targets, in the caller's thread pool.
pub(super) fn read(
    mut lines: BodyLines<'_>,
    element: &Element,
    count: usize,
    targets: Vec<Target<'_>>,
) -> Result<()> {
    lines.begin(element);
    let destinations = destinations(element, &targets);
    let read_part = |part: RecordPart<'_, '_>| part.read(element, &destinations);
    let parts = match rayon::current_num_threads() {
        1 => vec![RecordPart { lines, count, targets }],
        _ if lines.has_breaks => vec![RecordPart { lines, count, targets }],
        _ => parts(lines, count, targets, PART_BYTES),
    };
    let outcomes: Vec<Result<()>> = parts.into_par_iter().map(read_part).collect();
    outcomes.into_iter().collect()
}

/// Records read by one thread.
struct RecordPart<'a, 't> {
    lines: BodyLines<'a>,
    /// Number of records.
    count: usize,
    /// Destinations of the values.
    targets: Vec<Target<'t>>,
}

/// Splits records into parts of about `part_bytes` bytes. The last part includes the records that the header
/// declares but the file lacks, so that reading this part reports the error.
fn parts<'a, 't>(
    lines: BodyLines<'a>,
    count: usize,
    targets: Vec<Target<'t>>,
    part_bytes: usize,
) -> Vec<RecordPart<'a, 't>> {
    let BodyLines { bytes, mut at, .. } = lines;
    let mut ranges = Vec::new();
    while bytes.len() - at > 2 * part_bytes {
        let rest = &bytes[at + part_bytes..];
        let Some(length) = rest.iter().position(|&byte| byte == b'\n') else { break };
        let end = at + part_bytes + length + 1;
        ranges.push(at..end);
        at = end;
    }
    let counts: Vec<usize> = ranges.par_iter().map(|range| record_count(&bytes[range.clone()])).collect();
    let mut left = RecordPart { lines, count, targets };
    let mut parts = Vec::with_capacity(ranges.len() + 1);
    for (range, count) in ranges.into_iter().zip(counts) {
        if left.count <= count {
            break; // the rest belongs to another element
        }
        let targets = left.targets.iter_mut().map(|target| target.take_front(count)).collect();
        parts.push(RecordPart { lines: BodyLines { at: range.start, ..lines }, count, targets });
        left.lines.at = range.end;
        left.count -= count;
    }
    parts.push(left);
    parts
}

/// The number of nonblank lines.
fn record_count(text: &[u8]) -> usize {
    let lines = text.split(|byte| matches!(byte, b'\n' | b'\r'));
    lines.filter(|line| line.iter().any(|byte| !matches!(byte, b' ' | b'\t'))).count()
}

impl RecordPart<'_, '_> {
    /// Reads the records into the targets.
    fn read(mut self, element: &Element, destinations: &[Option<(usize, usize)>]) -> Result<()> {
        let mut rows = RecordReader::Ascii(self.lines);
        for record in 0..self.count {
            rows.start()?;
            for (property, destination) in element.properties.iter().zip(destinations) {
                let (&Some((target, component)), RecordReader::Ascii(lines)) = (destination, &mut rows)
                else {
                    rows.skip(property)?;
                    continue;
                };
                let Target { columns, slots } = &mut self.targets[target];
                let slot = record * columns.len() + component;
                let scalar = columns[component].1;
                match slots {
                    Slots::F32(out) => out[slot] = lines.float(scalar, &property.name)?,
                    // A value declared as a 32-bit float is rounded to 32 bits, even if its text has more
                    // digits.
                    Slots::F64(out) if scalar == NumberType::F32 => {
                        out[slot] = f64::from(lines.float::<f32>(scalar, &property.name)?);
                    }
                    Slots::F64(out) => out[slot] = lines.float(scalar, &property.name)?,
                    Slots::U8(out) => out[slot] = lines.bounded(scalar, &property.name)?,
                    Slots::I32(out) => out[slot] = lines.bounded(scalar, &property.name)?,
                    Slots::I64(out) => out[slot] = lines.bounded(scalar, &property.name)?,
                }
            }
            rows.finish()?;
        }
        Ok(())
    }
}

/// For each property, the target and the component that it is written to; `None` for a property that is
/// skipped.
fn destinations(element: &Element, targets: &[Target<'_>]) -> Vec<Option<(usize, usize)>> {
    let mut destinations = vec![None; element.properties.len()];
    for (target, Target { columns, .. }) in targets.iter().enumerate() {
        for (component, &(property, _)) in columns.iter().enumerate() {
            if matches!(element.properties[property].kind, PropertyType::Scalar(_)) {
                destinations[property] = Some((target, component));
            }
        }
    }
    destinations
}

// The lines of an ASCII body, value by value.

/// A read position in the body.
#[derive(Clone, Copy)]
pub(super) struct BodyLines<'a> {
    pub(super) bytes: &'a [u8],
    pub(super) at: usize,
    /// Whether a record takes several lines. Each record must still end with a line.
    has_breaks: bool,
}

impl<'a> BodyLines<'a> {
    pub(super) fn new(bytes: &'a [u8], at: usize) -> BodyLines<'a> {
        BodyLines { bytes, at: at.min(bytes.len()), has_breaks: false }
    }

    /// Before the first record of an element: finds out whether its records take several lines, as the values
    /// of the first one do.
    pub(super) fn begin(&mut self, element: &Element) {
        self.has_breaks = false;
        if element.count == 0 || element.properties.is_empty() || element.has_list() {
            return; // without a record to read, many elements would each pass the same blank lines
        }
        let value_count = element.properties.len();
        let lines = self.bytes[self.at..].split(|byte| matches!(byte, b'\n' | b'\r'));
        let counts = lines.map(|line| line.split(|byte| matches!(byte, b' ' | b'\t')));
        let mut counts =
            counts.map(|words| words.filter(|word| !word.is_empty()).take(value_count + 1).count());
        let (mut found, mut line_count) = (0, 0);
        while let Some(count) = counts.next().filter(|_| found < value_count) {
            found += count;
            line_count += usize::from(count > 0);
        }
        self.has_breaks = found == value_count && line_count > 1;
    }

    pub(super) fn at(&self) -> usize {
        self.at
    }

    pub(super) fn remaining(&self) -> usize {
        self.bytes.len() - self.at
    }

    /// Skips empty lines and the spaces before the first value.
    pub(super) fn start(&mut self) -> Result<()> {
        self.skip_while(|byte| matches!(byte, b' ' | b'\t' | b'\r' | b'\n'));
        Ok(())
    }

    /// Skips the spaces after the last value, and checks that the line ends there.
    pub(super) fn finish(&mut self) -> Result<()> {
        self.skip_while(|byte| matches!(byte, b' ' | b'\t'));
        match self.bytes.get(self.at) {
            None | Some(b'\n' | b'\r') => Ok(()),
            Some(_) if self.has_breaks => Err(self.invalid(
                "the values of a record end within the line, unlike those of the first record".into(),
            )),
            Some(_) => Err(self.invalid("the line has more values than the header declares".into())),
        }
    }

    /// Skips one value.
    pub(super) fn skip(&mut self, what: &str) -> Result<()> {
        match self.peek() {
            None | Some(b'\n' | b'\r') => Err(self.missing(what)),
            Some(_) => {
                self.skip_while(|byte| !matches!(byte, b' ' | b'\t' | b'\r' | b'\n'));
                Ok(())
            }
        }
    }

    /// Parses the next value as an integer of the given type.
    pub(super) fn integer(&mut self, scalar: NumberType, what: &str) -> Result<i64> {
        self.bounded(scalar, what)
    }

    /// Parses the next value and checks the range of the declared type.
    fn bounded<T: TryFrom<i64>>(&mut self, scalar: NumberType, what: &str) -> Result<T> {
        let start = self.at;
        let value: f64 = self.number(what)?;
        let range = match scalar {
            NumberType::I8 => -128.0..=127.0,
            NumberType::U8 => 0.0..=255.0,
            NumberType::I16 => -32_768.0..=32_767.0,
            NumberType::U16 => 0.0..=65_535.0,
            NumberType::I32 => f64::from(i32::MIN)..=f64::from(i32::MAX),
            _ => 0.0..=f64::from(u32::MAX),
        };
        if range.contains(&value) && value.fract() == 0.0 {
            #[expect(clippy::cast_possible_truncation, reason = "an integer within 32 bits")]
            if let Ok(value) = T::try_from(value as i64) {
                return Ok(value);
            }
        }
        self.at = start;
        let (least, most) = range.into_inner();
        Err(self.wrong_value(format!("`{what}` must be an integer from {least} to {most}, found {value}")))
    }

    /// Parses the next value as a float. If the declared type is an integer, checks its range first.
    pub(super) fn float<T: FastFloat>(&mut self, scalar: NumberType, what: &str) -> Result<T> {
        if !matches!(scalar, NumberType::F32 | NumberType::F64) {
            let start = self.at;
            self.bounded::<i64>(scalar, what)?;
            self.at = start;
        }
        self.number(what)
    }

    fn number<T: FastFloat>(&mut self, what: &str) -> Result<T> {
        match self.peek() {
            None | Some(b'\n' | b'\r') => Err(self.missing(what)),
            Some(_) => match parse_number(&self.bytes[self.at..]) {
                Some((value, length)) => {
                    self.at += length;
                    Ok(value)
                }
                None => Err(self.wrong_value(format!("expected a number for `{what}`"))),
            },
        }
    }

    /// The first byte of the next value of the record, or the line end before it, without consuming it.
    fn peek(&mut self) -> Option<u8> {
        let has_breaks = self.has_breaks;
        self.skip_while(|byte| matches!(byte, b' ' | b'\t') || has_breaks && matches!(byte, b'\n' | b'\r'));
        self.bytes.get(self.at).copied()
    }

    fn skip_while(&mut self, skipped: impl Fn(u8) -> bool) {
        while self.bytes.get(self.at).is_some_and(|&byte| skipped(byte)) {
            self.at += 1;
        }
    }

    fn missing(&self, what: &str) -> Error {
        if self.at == self.bytes.len() {
            self.truncated(format!("the file ends where a value of `{what}` was expected"))
        } else {
            self.invalid(format!("the line ends where a value of `{what}` was expected"))
        }
    }

    /// An error in the value at the current position: `Truncated` if the value ends with the file.
    fn wrong_value(&self, what: String) -> Error {
        if self.bytes[self.at..].iter().any(u8::is_ascii_whitespace) {
            self.invalid(what)
        } else {
            self.truncated(what)
        }
    }

    pub(super) fn truncated(&self, what: String) -> Error {
        Error::truncated(FORMAT, Position::Line(line_number(self.bytes, self.at)), what)
    }

    pub(super) fn invalid(&self, what: String) -> Error {
        Error::invalid(FORMAT, Position::Line(line_number(self.bytes, self.at)), what)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::core::number::NumberType::{F32, I32};

    const HEADER: &str = "ply\nformat ascii 1.0\nelement vertex 60\nproperty float x\nproperty int y\n\
                          property list uchar int list\nend_header\n";

    /// The numbers read from a body in parts of `part_bytes` bytes, or the error as text.
    fn outcome(body: &str, part_bytes: Option<usize>) -> std::result::Result<(Vec<f32>, Vec<i32>), String> {
        let file = format!("{HEADER}{body}");
        let header = super::super::read_header(file.as_bytes(), &crate::Limits::default()).expect("a header");
        let element = &header.elements[0];
        let (mut x, mut y) = (vec![0.0; 60], vec![0; 60]);
        let targets = vec![
            Target { columns: [(0, F32)].into(), slots: Slots::F32(&mut x) },
            Target { columns: [(1, I32)].into(), slots: Slots::I32(&mut y) },
        ];
        let lines = BodyLines::new(file.as_bytes(), header.body_offset);
        let destinations = destinations(element, &targets);
        let parts = match part_bytes {
            Some(part_bytes) => parts(lines, 60, targets, part_bytes),
            None => vec![RecordPart { lines, count: 60, targets }],
        };
        for part in parts {
            part.read(element, &destinations).map_err(|error| format!("{error:?}"))?;
        }
        Ok((x, y))
    }

    #[test]
    fn parts_give_the_same_result_as_one_pass() {
        let usual: Vec<String> = (0..60).map(|n| format!("{n}.5 {} 2 7 8", n * n)).collect();
        let changes = ["", " \t", "\r", "1 2 0\r3 4 0", "1 2", "1 2 0 9", "1 2.5 0", "x 2 0", "1 2 9999"];
        for line_end in ["\n", "\r\n"] {
            for (change, index) in changes.iter().flat_map(|change| [0, 20, 33, 59].map(|at| (change, at))) {
                for faces in [0, 30] {
                    let mut lines = usual.clone();
                    lines.insert(index, change.to_string());
                    lines.extend(vec!["3 0 1 2".into(); faces]);
                    let body = lines.join(line_end);
                    let expected = outcome(&body, None);
                    for part_bytes in [1, 17, 100, 300] {
                        assert_eq!(outcome(&body, Some(part_bytes)), expected, "{change:?} at {index}");
                    }
                }
            }
        }
        assert_eq!(outcome(&usual.join("\n"), Some(50)).expect("read").1[59], 59 * 59);
        let error = outcome(&usual[..50].join("\n"), Some(50)).expect_err("too few");
        assert!(error.starts_with("Truncated"), "{error}");
    }
}
