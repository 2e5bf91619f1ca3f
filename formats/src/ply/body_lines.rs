//! The lines of an ASCII body, value by value.

use fast_float2::FastFloat;

use crate::error::{Error, Position, Result};
use crate::scalar::Scalar;
use crate::text::{line_number, parse_number};

use super::FORMAT;
use super::header::Element;

/// A read position in the body.
#[derive(Clone, Copy)]
pub(super) struct BodyLines<'a> {
    pub(super) bytes: &'a [u8],
    pub(super) at: usize,
    /// Whether a record takes several lines. Each record must still end with a line.
    pub(super) has_breaks: bool,
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
    pub(super) fn integer(&mut self, scalar: Scalar, what: &str) -> Result<i64> {
        self.bounded(scalar, what)
    }

    /// Parses the next value and checks the range of the declared type.
    pub(super) fn bounded<T: TryFrom<i64>>(&mut self, scalar: Scalar, what: &str) -> Result<T> {
        let start = self.at;
        let value: f64 = self.number(what)?;
        let range = match scalar {
            Scalar::I8 => -128.0..=127.0,
            Scalar::U8 => 0.0..=255.0,
            Scalar::I16 => -32_768.0..=32_767.0,
            Scalar::U16 => 0.0..=65_535.0,
            Scalar::I32 => f64::from(i32::MIN)..=f64::from(i32::MAX),
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
    pub(super) fn float<T: FastFloat>(&mut self, scalar: Scalar, what: &str) -> Result<T> {
        if !matches!(scalar, Scalar::F32 | Scalar::F64) {
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
        match self.at == self.bytes.len() {
            true => self.truncated(format!("the file ends where a value of `{what}` was expected")),
            false => self.invalid(format!("the line ends where a value of `{what}` was expected")),
        }
    }

    /// An error in the value at the current position: `Truncated` if the value ends with the file.
    fn wrong_value(&self, what: String) -> Error {
        match self.bytes[self.at..].iter().any(u8::is_ascii_whitespace) {
            true => self.invalid(what),
            false => self.truncated(what),
        }
    }

    pub(super) fn truncated(&self, what: String) -> Error {
        Error::truncated(FORMAT, Position::Line(line_number(self.bytes, self.at)), what)
    }

    pub(super) fn invalid(&self, what: String) -> Error {
        Error::invalid(FORMAT, Position::Line(line_number(self.bytes, self.at)), what)
    }
}
