//! The body of an ascii PLY file: one record per line, values between spaces.
//!
//! A line that holds fewer or more values than the header declares is an error: taking values from
//! the next line instead would shift all that follow without anybody noticing. Whatever is wrong with
//! the last value of the file is told as the file being short: the value may be cut off.

use fast_float2::FastFloat;

use crate::error::{Error, Place, Result};
use crate::scalar::Scalar;
use crate::text::{line_number, parse_number};

use super::FORMAT;
use super::header::{Element, PropertyType};
use super::read::{Slots, Target};
use super::rows::Rows;

/// Reads `count` records into the targets.
pub(super) fn read(
    rows: &mut Rows<'_>,
    element: &Element,
    count: usize,
    targets: &mut [Target<'_>],
) -> Result<()> {
    debug_assert!(matches!(rows, Rows::Ascii(_)), "a binary body is gathered, not parsed");
    let places = places(element, targets);
    for record in 0..count {
        rows.start()?;
        for (property, place) in element.properties.iter().zip(&places) {
            let (&Some((target, component)), Rows::Ascii(lines)) = (place, &mut *rows) else {
                rows.skip(property)?;
                continue;
            };
            let Target { columns, slots } = &mut targets[target];
            let slot = record * columns.len() + component;
            let scalar = columns[component].1;
            match slots {
                Slots::F32(out) => out[slot] = lines.float(scalar, &property.name)?,
                // What is declared as 32 bits is no more precise for being written in digits.
                Slots::F64(out) if scalar == Scalar::F32 => {
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

/// For each property, the target and the component that it goes to.
fn places(element: &Element, targets: &[Target<'_>]) -> Vec<Option<(usize, usize)>> {
    let mut places = vec![None; element.properties.len()];
    for (target, Target { columns, .. }) in targets.iter().enumerate() {
        for (component, &(property, _)) in columns.iter().enumerate() {
            if matches!(element.properties[property].kind, PropertyType::Scalar(_)) {
                places[property] = Some((target, component));
            }
        }
    }
    places
}

/// A position in the body.
pub(super) struct Lines<'a> {
    bytes: &'a [u8],
    at: usize,
}

impl<'a> Lines<'a> {
    pub(super) fn new(bytes: &'a [u8], at: usize) -> Lines<'a> {
        Lines { bytes, at: at.min(bytes.len()) }
    }

    pub(super) fn at(&self) -> usize {
        self.at
    }

    pub(super) fn remaining(&self) -> usize {
        self.bytes.len() - self.at
    }

    /// Passes over empty lines and the spaces before the first value.
    pub(super) fn start(&mut self) -> Result<()> {
        self.skip_while(|byte| matches!(byte, b' ' | b'\t' | b'\r' | b'\n'));
        Ok(())
    }

    /// Passes over the spaces after the last value, and checks that the line ends there.
    pub(super) fn finish(&mut self) -> Result<()> {
        match self.peek() {
            None | Some(b'\n' | b'\r') => Ok(()),
            Some(_) => Err(self.invalid("the line has more values than the header declares".into())),
        }
    }

    /// Passes over one value.
    pub(super) fn skip(&mut self, what: &str) -> Result<()> {
        match self.peek() {
            None | Some(b'\n' | b'\r') => Err(self.missing(what)),
            Some(_) => {
                self.skip_while(|byte| !matches!(byte, b' ' | b'\t' | b'\r' | b'\n'));
                Ok(())
            }
        }
    }

    /// The next value, an integer of the given type.
    pub(super) fn integer(&mut self, scalar: Scalar, what: &str) -> Result<i64> {
        self.bounded(scalar, what)
    }

    /// The next value, checked against the range of the type that the header declares.
    fn bounded<T: TryFrom<i64>>(&mut self, scalar: Scalar, what: &str) -> Result<T> {
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

    /// The next value, a real; or an integer that is stored as one.
    fn float<T: FastFloat>(&mut self, scalar: Scalar, what: &str) -> Result<T> {
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

    /// The first byte after spaces.
    fn peek(&mut self) -> Option<u8> {
        self.skip_while(|byte| matches!(byte, b' ' | b'\t'));
        self.bytes.get(self.at).copied()
    }

    fn skip_while(&mut self, skipped: impl Fn(u8) -> bool) {
        while self.bytes.get(self.at).is_some_and(|&byte| skipped(byte)) {
            self.at += 1;
        }
    }

    fn missing(&self, what: &str) -> Error {
        match self.at == self.bytes.len() {
            true => self.short(format!("the file ends where a value of `{what}` was expected")),
            false => self.invalid(format!("the line ends where a value of `{what}` was expected")),
        }
    }

    /// What is wrong with the value at the present position, which may be all there is of it so far.
    fn wrong_value(&self, what: String) -> Error {
        match self.bytes[self.at..].iter().any(u8::is_ascii_whitespace) {
            true => self.invalid(what),
            false => self.short(what),
        }
    }

    pub(super) fn short(&self, what: String) -> Error {
        Error::short(FORMAT, Place::Line(line_number(self.bytes, self.at)), what)
    }

    pub(super) fn invalid(&self, what: String) -> Error {
        Error::invalid(FORMAT, Place::Line(line_number(self.bytes, self.at)), what)
    }
}
