//! Reads arrays, and limits the memory that they need.

use std::cell::Cell;

use crate::bytes::{Cursor, Endian};
use crate::error::{Error, Position, Result};
use crate::limits::Limits;
use crate::usd::FORMAT;

use super::array::COMPRESSED_MIN;
use super::floats::{AS_INTEGERS, AS_TABLE};
use super::integers::{Integer, decode, encoded_bytes_max};
use super::lz4::decompress;
use super::value::{ValueRep, ValueType};

/// The bytes of a file or of its end, and the number of bytes that were read since
/// [`Source::start_anew`]. Several values can refer to the same bytes, so all that is read counts towards the
/// limit of decompressed bytes.
pub(super) struct Source<'a> {
    pub(super) bytes: &'a [u8],
    /// The offset of the bytes in the file.
    base: u64,
    limits: Limits,
    unpacked: Cell<u64>,
}

impl<'a> Source<'a> {
    pub(super) fn new(bytes: &'a [u8], limits: &Limits) -> Source<'a> {
        Source::of_end(bytes, 0, limits)
    }

    /// The bytes of a file from the offset `base` on.
    pub(super) fn of_end(bytes: &'a [u8], base: u64, limits: &Limits) -> Source<'a> {
        Source { bytes, base, limits: *limits, unpacked: Cell::new(0) }
    }

    /// Sets the count of decompressed bytes to 0.
    pub(super) fn start_anew(&self) {
        self.unpacked.set(0);
    }

    /// A cursor at an offset of the file.
    pub(super) fn at(&self, offset: u64) -> Result<Cursor<'a>> {
        let start = offset.checked_sub(self.base).and_then(|start| usize::try_from(start).ok());
        let start = start.filter(|&start| start <= self.bytes.len()).ok_or_else(|| {
            let end = self.base + self.bytes.len() as u64;
            let what = format!(
                "a value would be at {offset}, but it can only be from {} to the end at {end}",
                self.base
            );
            Error::invalid(FORMAT, Position::Offset(offset), what)
        })?;
        Ok(Cursor::new(FORMAT, Endian::Little, self.bytes, start))
    }

    /// Counts bytes that are about to be allocated; fails if the sum exceeds the limit.
    pub(super) fn claim(&self, count: usize, bytes_each: usize) -> Result<()> {
        let bytes = (count as u64).saturating_mul(bytes_each as u64);
        self.unpacked.set(self.unpacked.get().saturating_add(bytes));
        self.limits.check_decompressed(FORMAT, self.unpacked.get(), self.bytes.len() as u64)
    }

    /// Reads a size and as many compressed bytes, and decompresses them to at most `bytes_max` bytes.
    pub(super) fn lz4(&self, cursor: &mut Cursor, bytes_max: usize, what: &str) -> Result<Vec<u8>> {
        let size = count(cursor, what)?;
        let at = cursor.clone();
        let packed = cursor.take(size, what)?;
        self.claim(bytes_max, 1)?;
        let mut out = vec![0; bytes_max];
        let length = decompress(packed, &mut out)
            .ok_or_else(|| at.invalid(format!("the compressed {what} are damaged")))?;
        out.truncate(length);
        Ok(out)
    }

    /// Reads a size and `count` compressed integers.
    pub(super) fn integers<T: Integer>(
        &self,
        cursor: &mut Cursor,
        count: usize,
        what: &str,
    ) -> Result<Vec<T>> {
        let at = cursor.clone();
        let bytes_max = encoded_bytes_max::<T>(count)
            .ok_or_else(|| at.invalid(format!("{count} {what} are more than a file can hold")))?;
        self.claim(count, T::CODE_BYTES[2])?;
        let encoded = self.lz4(cursor, bytes_max, what)?;
        decode(&encoded, count).ok_or_else(|| at.invalid(format!("expected {count} compressed {what}")))
    }

    /// The start of an array of this type, and whether it is compressed; `None` if it is empty.
    fn array(&self, rep: ValueRep, kind: ValueType, what: &str) -> Result<Option<(Cursor<'a>, bool)>> {
        match rep.array_offset(kind) {
            Some((0, _)) => Ok(None),
            Some((offset, is_compressed)) => Ok(Some((self.at(offset)?, is_compressed))),
            None => Err(unexpected(what)),
        }
    }

    /// The numbers of an array of integers, or of vectors of `arity` integers.
    pub(super) fn read_integers<T: Integer>(
        &self,
        rep: ValueRep,
        (kind, arity): (ValueType, usize),
        what: &str,
    ) -> Result<Vec<T>> {
        let Some((mut cursor, is_compressed)) = self.array(rep, kind, what)? else { return Ok(Vec::new()) };
        let count = count(&mut cursor, what)?;
        if is_compressed && arity == 1 && count >= COMPRESSED_MIN {
            return self.integers(&mut cursor, count, what);
        }
        let width = T::CODE_BYTES[2];
        let bytes = self.elements(&mut cursor, count, arity * width, what)?;
        let widened = |bytes: &[u8]| {
            let mut all = [0; 8];
            all[..width].copy_from_slice(bytes);
            T::lowest(i64::from_le_bytes(all))
        };
        Ok(bytes.chunks_exact(width).map(widened).collect())
    }

    /// The numbers of an array of vectors of `arity` floats.
    pub(super) fn read_floats(&self, rep: ValueRep, arity: usize, what: &str) -> Result<Vec<f32>> {
        let kind = match arity {
            1 => ValueType::Float,
            2 => ValueType::Vec2f,
            3 => ValueType::Vec3f,
            _ => ValueType::Vec4f,
        };
        let Some((mut cursor, is_compressed)) = self.array(rep, kind, what)? else { return Ok(Vec::new()) };
        let count = count(&mut cursor, what)?;
        if !is_compressed || arity != 1 || count < COMPRESSED_MIN {
            return Ok(floats(self.elements(&mut cursor, count, 4 * arity, what)?));
        }
        let at = cursor.clone();
        match cursor.array::<1>(what)? {
            [AS_INTEGERS] => {
                let integers: Vec<i32> = self.integers(&mut cursor, count, what)?;
                Ok(integers.into_iter().map(|value| value as f32).collect())
            }
            [AS_TABLE] => {
                let length = u32::from_le_bytes(cursor.array(what)?) as usize;
                let table = floats(self.elements(&mut cursor, length, 4, what)?);
                let indices: Vec<i32> = self.integers(&mut cursor, count, what)?;
                let value = |index: i32| table.get(usize::try_from(index).ok()?).copied();
                let values: Option<Vec<f32>> = indices.into_iter().map(value).collect();
                values.ok_or_else(|| at.invalid(format!("an index of {what} is beyond the end of its table")))
            }
            [code] => Err(at.invalid(format!("unknown compression {code} of {what}"))),
        }
    }

    /// The bytes of `count` elements.
    fn elements(
        &self,
        cursor: &mut Cursor<'a>,
        count: usize,
        bytes_each: usize,
        what: &str,
    ) -> Result<&'a [u8]> {
        let bytes = cursor.take(count.saturating_mul(bytes_each), what)?;
        self.claim(bytes.len(), 1)?;
        Ok(bytes)
    }

    /// The indices of an array of tokens or strings.
    pub(super) fn read_indices(&self, rep: ValueRep, kind: ValueType, what: &str) -> Result<Vec<u32>> {
        let indices: Vec<i32> = self.read_integers(rep, (kind, 1), what)?;
        Ok(indices.into_iter().map(i32::cast_unsigned).collect())
    }
}

/// Reads a 64-bit count.
pub(super) fn count(cursor: &mut Cursor, what: &str) -> Result<usize> {
    let at = cursor.clone();
    let count = u64::from_le_bytes(cursor.array(what)?);
    usize::try_from(count).map_err(|_| at.invalid(format!("{count} {what} are more than a file can hold")))
}

fn floats(bytes: &[u8]) -> Vec<f32> {
    bytes.as_chunks().0.iter().map(|bytes| f32::from_le_bytes(*bytes)).collect()
}

/// The error for a value that is missing or has another type.
pub(super) fn unexpected(what: &str) -> Error {
    Error::invalid(FORMAT, Position::File, format!("the value of {what} is missing, or has another type"))
}
