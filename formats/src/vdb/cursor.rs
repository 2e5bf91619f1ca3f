//! A cursor over little-endian bytes whose errors name the position.

use super::FORMAT;
use crate::error::{Error, Position, Result};

/// A read position in a file. Reading past the end is an error that names what was being read.
#[derive(Clone, Copy)]
pub(super) struct VdbCursor<'a> {
    bytes: &'a [u8],
    position: usize,
}

impl<'a> VdbCursor<'a> {
    pub(super) fn new(bytes: &'a [u8]) -> VdbCursor<'a> {
        VdbCursor { bytes, position: 0 }
    }

    pub(super) fn position(&self) -> usize {
        self.position
    }

    pub(super) fn remaining(&self) -> usize {
        self.bytes.len() - self.position
    }

    /// Moves to an absolute position.
    pub(super) fn seek(&mut self, position: u64, what: &str) -> Result<()> {
        match usize::try_from(position) {
            Ok(position) if position <= self.bytes.len() => {
                self.position = position;
                Ok(())
            }
            _ => Err(self.error(format!(
                "{what} is at byte {position}, beyond the end of the file at {}",
                self.bytes.len()
            ))),
        }
    }

    pub(super) fn take(&mut self, count: usize, what: &str) -> Result<&'a [u8]> {
        if count > self.remaining() {
            return Err(
                self.error(format!("{what} needs {count} bytes, but only {} remain", self.remaining()))
            );
        }
        let taken = &self.bytes[self.position..self.position + count];
        self.position += count;
        Ok(taken)
    }

    pub(super) fn array<const N: usize>(&mut self, what: &str) -> Result<[u8; N]> {
        let mut array = [0; N];
        array.copy_from_slice(self.take(N, what)?);
        Ok(array)
    }

    pub(super) fn u8(&mut self, what: &str) -> Result<u8> {
        Ok(self.array::<1>(what)?[0])
    }

    pub(super) fn u32(&mut self, what: &str) -> Result<u32> {
        Ok(u32::from_le_bytes(self.array(what)?))
    }

    pub(super) fn i32(&mut self, what: &str) -> Result<i32> {
        Ok(i32::from_le_bytes(self.array(what)?))
    }

    pub(super) fn i64(&mut self, what: &str) -> Result<i64> {
        Ok(i64::from_le_bytes(self.array(what)?))
    }

    pub(super) fn f32(&mut self, what: &str) -> Result<f32> {
        Ok(f32::from_le_bytes(self.array(what)?))
    }

    pub(super) fn f64(&mut self, what: &str) -> Result<f64> {
        Ok(f64::from_le_bytes(self.array(what)?))
    }

    pub(super) fn coord(&mut self, what: &str) -> Result<[i32; 3]> {
        Ok([self.i32(what)?, self.i32(what)?, self.i32(what)?])
    }

    /// Reads a u32 length and that number of bytes; replaces invalid UTF-8, because names are only displayed.
    pub(super) fn string(&mut self, what: &str) -> Result<String> {
        let length = self.u32(what)? as usize;
        Ok(String::from_utf8_lossy(self.take(length, what)?).into_owned())
    }

    /// Reads a bit mask in 64-bit words, least significant bit first.
    pub(super) fn mask(&mut self, word_count: usize, what: &str) -> Result<Vec<u64>> {
        let bytes = self.take(word_count * 8, what)?;
        Ok(bytes.as_chunks::<8>().0.iter().map(|&word| u64::from_le_bytes(word)).collect())
    }

    /// An error at the current position.
    pub(super) fn error(&self, what: impl Into<String>) -> Error {
        Error::invalid(FORMAT, Position::Offset(self.position as u64), what)
    }
}
