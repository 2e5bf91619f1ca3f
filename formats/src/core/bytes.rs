//! A bounds-checked cursor over the bytes of a binary file.

use std::io::{Read, Seek, SeekFrom};

use crate::core::error::{Error, Position, Result};
use crate::core::number::NumberType;

/// The byte order of numbers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Endian {
    /// Least significant byte first.
    Little,
    /// Most significant byte first.
    Big,
}

/// At most `length` bytes of a file from the offset `at` on; fewer at the end of the file.
///
/// # Errors
///
/// [`Error::Io`] if the file cannot be read.
pub(crate) fn piece(file: &mut (impl Read + Seek), at: u64, length: u64) -> Result<Vec<u8>> {
    let mut bytes = Vec::new();
    file.seek(SeekFrom::Start(at))?;
    file.take(length).read_to_end(&mut bytes)?;
    Ok(bytes)
}

/// Methods of [`Cursor`] with the name of a type: each takes the next number, in the cursor's byte order.
macro_rules! number_methods {
    ($($number:ident)*) => {$(
        pub(crate) fn $number(&mut self, what: &str) -> Result<$number> {
            Ok($number::from_le_bytes(self.array(what)?))
        }
    )*};
}

/// A read position in the bytes of a file. A read that would pass the end of the file returns an error.
#[derive(Clone, Debug)]
pub(crate) struct Cursor<'a> {
    format: &'static str,
    endian: Endian,
    bytes: &'a [u8],
    at: usize,
}

impl<'a> Cursor<'a> {
    /// Starts at offset `at` of a file in the named format.
    pub(crate) fn new(format: &'static str, endian: Endian, bytes: &'a [u8], at: usize) -> Cursor<'a> {
        Cursor { format, endian, bytes, at: at.min(bytes.len()) }
    }

    /// The byte order of numbers.
    pub(crate) fn endian(&self) -> Endian {
        self.endian
    }

    /// Offset in bytes from the start of the file.
    pub(crate) fn at(&self) -> usize {
        self.at
    }

    /// Number of bytes up to the end of the file.
    pub(crate) fn remaining(&self) -> usize {
        self.bytes.len() - self.at
    }

    /// Continues at another offset; `what` names what is there in the error.
    pub(crate) fn seek(&mut self, offset: u64, what: &str) -> Result<()> {
        match usize::try_from(offset) {
            Ok(offset) if offset <= self.bytes.len() => {
                self.at = offset;
                Ok(())
            }
            _ => {
                let end = self.bytes.len();
                Err(self.invalid(format!("{what} is at byte {offset}, beyond the end of the file at {end}")))
            }
        }
    }

    /// Takes the next bytes; `what` names them in the error.
    pub(crate) fn take(&mut self, length: usize, what: &str) -> Result<&'a [u8]> {
        match self.bytes[self.at..].get(..length) {
            Some(taken) => {
                self.at += length;
                Ok(taken)
            }
            None => Err(self.truncated(format!(
                "expected {length} bytes of {what}, found {} before the end",
                self.remaining()
            ))),
        }
    }

    /// Takes the next bytes as an array in little-endian order.
    fn array<const N: usize>(&mut self, what: &str) -> Result<[u8; N]> {
        let mut array = [0; N];
        array.copy_from_slice(self.take(N, what)?);
        if self.endian == Endian::Big {
            array.reverse();
        }
        Ok(array)
    }

    /// Takes the next number, which must have an integer type.
    pub(crate) fn integer(&mut self, scalar: NumberType, what: &str) -> Result<i64> {
        Ok(match scalar {
            NumberType::I8 => self.i8(what)?.into(),
            NumberType::U8 => self.u8(what)?.into(),
            NumberType::I16 => self.i16(what)?.into(),
            NumberType::U16 => self.u16(what)?.into(),
            NumberType::I32 => self.i32(what)?.into(),
            NumberType::U32 => self.u32(what)?.into(),
            _ => {
                return Err(self.invalid(format!("{what} must have an integer type")));
            }
        })
    }

    number_methods! { u8 u16 u32 u64 i8 i16 i32 i64 f32 f64 }

    /// Creates an error at the current position: the file ends too early.
    pub(crate) fn truncated(&self, what: impl Into<String>) -> Error {
        Error::truncated(self.format, Position::Offset(self.at as u64), what)
    }

    /// Creates an error at the current position: the file is invalid.
    pub(crate) fn invalid(&self, what: impl Into<String>) -> Error {
        Error::invalid(self.format, Position::Offset(self.at as u64), what)
    }
}

/// The little-endian u32 at `position`, which must be in bounds.
pub(crate) fn u32_at(bytes: &[u8], position: usize) -> u32 {
    u32::from_le_bytes([bytes[position], bytes[position + 1], bytes[position + 2], bytes[position + 3]])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn integers_are_read_in_both_byte_orders() {
        let bytes = [0x01, 0x02, 0xff, 0xfe];
        let mut little = Cursor::new("test", Endian::Little, &bytes, 0);
        assert_eq!(little.integer(NumberType::U16, "n").unwrap(), 0x0201);
        assert_eq!(little.integer(NumberType::I16, "n").unwrap(), -257);
        let mut big = Cursor::new("test", Endian::Big, &bytes, 0);
        assert_eq!(big.integer(NumberType::U16, "n").unwrap(), 0x0102);
        assert_eq!(big.integer(NumberType::I8, "n").unwrap(), -1);
        assert_eq!(big.remaining(), 1);
    }

    #[test]
    fn reading_past_the_end_is_an_error_with_offset() {
        let mut cursor = Cursor::new("test", Endian::Little, &[1, 2, 3], 0);
        cursor.take(2, "x").unwrap();
        let error = cursor.take(usize::MAX, "the table").unwrap_err();
        assert!(error.is_truncated());
        let error = error.to_string();
        assert!(
            error.starts_with("test, at byte 2: expected 18446744073709551615 bytes of the table, found 1")
        );
        assert_eq!(Cursor::new("test", Endian::Big, &[1], 9).remaining(), 0);
    }
}
