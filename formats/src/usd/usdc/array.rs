//! Encodes arrays.
//!
//! ```text
//!   u64 count │ elements                                              vectors, and fewer than 16 numbers
//!   u64 count │ u64 size, compressed integers                         integers
//!   u64 count │ i │ u64 size, compressed integers                     single floats that are integers
//!   u64 count │ t │ i32 length, table │ u64 size, compressed indices  single floats with few distinct values
//!   u64 count │ elements                                              other single floats
//! ```

use std::borrow::Cow;
use std::collections::HashMap;
use std::io::Write;
use std::iter;
use std::ops::Range;

use lz4_flex::block::{compress_into, decompress_into, get_maximum_output_size};

use super::tables::{ValueRep, ValueType};
use crate::core::error::{Error, Result};
use crate::core::number::write_f32s;
use crate::core::vertex_attributes::{faces, quad_count, string_index};
use crate::usd::{Elements, FORMAT};

/// Arrays with fewer numbers are not compressed.
pub(super) const COMPRESSED_MIN: usize = 16;

/// The offset of every array is a multiple of this, so that programs can map arrays into memory.
pub(super) const ALIGNMENT: u64 = 8;

/// An encoded array.
pub(super) struct CrateArray<'a> {
    kind: ValueType,
    is_compressed: bool,
    count: u64,
    body: Body<'a>,
}

/// What follows the number of elements.
enum Body<'a> {
    Bytes(Vec<u8>),
    /// Floats, which are converted to bytes when the file is written.
    Floats(Cow<'a, [f32]>),
}

impl<'a> CrateArray<'a> {
    /// Encodes the elements of a property.
    ///
    /// # Errors
    ///
    /// [`Error::TooLarge`] if a mesh has more than 2³¹ vertices, or the array exceeds the format's limits.
    pub(super) fn of(elements: Elements<'a>) -> Result<CrateArray<'a>> {
        match elements {
            Elements::Reals { values, stride, first, arity } => Self::reals(values, stride, first, arity),
            Elements::Integers { values, arity: 1, is_narrow: false } => {
                Self::integers(ValueType::Int64, values.iter().copied())
            }
            Elements::Integers { values, arity, .. } => Self::narrow(values, arity),
            Elements::StringIndices { table, indices } => {
                let missing = index(table.len())?;
                let fixed_index = |&index: &i32| if string_index(index, table) < 0 { missing } else { index };
                Self::integers(ValueType::Int, indices.iter().map(fixed_index))
            }
            Elements::FaceCounts { triangles, quads } if quad_count(quads) == 0 => {
                Self::integers(ValueType::Int, iter::repeat_n(3, triangles.len()))
            }
            Elements::FaceCounts { triangles, quads } => {
                let counts = faces(triangles, quads, 0..triangles.len());
                let counts: Result<Vec<i32>> = counts.map(|face| index(face.corners().len())).collect();
                Self::integers(ValueType::Int, counts?.into_iter())
            }
            Elements::FaceCorners { triangles, quads } => {
                check_corners(triangles)?;
                if quad_count(quads) == 0 {
                    let corners = triangles.as_flattened().iter();
                    return Self::integers(ValueType::Int, corners.map(|corner| corner.cast_signed()));
                }
                let faces: Vec<_> = faces(triangles, quads, 0..triangles.len()).collect();
                let corners = faces.iter().flat_map(|face| face.corners());
                let corners: Vec<i32> = corners.map(|corner| corner.cast_signed()).collect();
                Self::integers(ValueType::Int, corners.into_iter())
            }
        }
    }

    /// Encodes `arity` values of each element, from the value `first` on. An element has `stride` values.
    ///
    /// # Errors
    ///
    /// [`Error::TooLarge`] if the array exceeds the format's limits.
    fn reals(values: &'a [f32], stride: usize, first: usize, arity: usize) -> Result<CrateArray<'a>> {
        let values = if (first, arity) == (0, stride) {
            Cow::Borrowed(values)
        } else {
            let elements = values.chunks_exact(stride);
            Cow::Owned(elements.flat_map(|element| &element[first..first + arity]).copied().collect())
        };
        if arity == 1 { Self::floats(values) } else { Ok(Self::vectors(values, arity)) }
    }

    /// Vectors of two to four floats.
    fn vectors(values: Cow<'a, [f32]>, arity: usize) -> CrateArray<'a> {
        let kind = match arity {
            2 => ValueType::Vec2f,
            3 => ValueType::Vec3f,
            _ => ValueType::Vec4f,
        };
        let count = (values.len() / arity) as u64;
        CrateArray { kind, is_compressed: false, count, body: Body::Floats(values) }
    }

    fn floats(values: Cow<'a, [f32]>) -> Result<CrateArray<'a>> {
        let (kind, count) = (ValueType::Float, values.len() as u64);
        let bytes = |bytes| CrateArray { kind, is_compressed: true, count, body: Body::Bytes(bytes) };
        if values.len() >= COMPRESSED_MIN {
            if let Some(integers) = as_integers(&values) {
                let mut body = vec![AS_INTEGERS];
                append_compressed(integers.into_iter(), &mut body)?;
                return Ok(bytes(body));
            }
            if let Some((table, indices)) = as_table(&values) {
                let mut body = vec![AS_TABLE];
                body.extend_from_slice(&index(table.len())?.to_le_bytes());
                table.iter().for_each(|value| body.extend_from_slice(&value.to_le_bytes()));
                append_compressed(indices.into_iter(), &mut body)?;
                return Ok(bytes(body));
            }
        }
        Ok(CrateArray { kind, is_compressed: false, count, body: Body::Floats(values) })
    }

    fn integers<T: Integer>(
        kind: ValueType,
        values: impl ExactSizeIterator<Item = T> + Clone,
    ) -> Result<CrateArray<'a>> {
        let (mut bytes, count) = (Vec::new(), values.len());
        let is_compressed = count >= COMPRESSED_MIN;
        if is_compressed {
            append_compressed(values, &mut bytes)?;
        } else {
            let width = T::CODE_BYTES[2];
            values.for_each(|value| bytes.extend_from_slice(&value.widened().to_le_bytes()[..width]));
        }
        Ok(CrateArray { kind, is_compressed, count: count as u64, body: Body::Bytes(bytes) })
    }

    /// Integers that all fit into 32 bits, or vectors of them.
    fn narrow(values: &[i64], arity: usize) -> Result<CrateArray<'a>> {
        let kind = match arity {
            1 => {
                let values = values.iter().map(|&value| i32::lowest(value));
                return Self::integers(ValueType::Int, values);
            }
            2 => ValueType::Vec2i,
            3 => ValueType::Vec3i,
            _ => ValueType::Vec4i,
        };
        let bytes = values.iter().flat_map(|&value| i32::lowest(value).to_le_bytes()).collect();
        let count = (values.len() / arity) as u64;
        Ok(CrateArray { kind, is_compressed: false, count, body: Body::Bytes(bytes) })
    }

    /// Vectors of three floats.
    pub(super) fn of_vectors(values: &'a [f32]) -> CrateArray<'a> {
        Self::vectors(Cow::Borrowed(values), 3)
    }

    /// Indices into the table of strings or tokens.
    pub(super) fn of_indices(kind: ValueType, indices: &[u32]) -> CrateArray<'a> {
        let bytes = indices.iter().flat_map(|index| index.to_le_bytes()).collect();
        CrateArray { kind, is_compressed: false, count: indices.len() as u64, body: Body::Bytes(bytes) }
    }

    /// The number of bytes in the file; an empty array has none.
    pub(super) fn byte_count(&self) -> u64 {
        let body = match &self.body {
            Body::Bytes(bytes) => bytes.len(),
            Body::Floats(values) => size_of_val::<[f32]>(values),
        };
        if self.count == 0 { 0 } else { 8 + body as u64 }
    }

    /// The value representation of the array, if it is written at this offset.
    pub(super) fn rep(&self, offset: u64) -> ValueRep {
        match self.count {
            0 => ValueRep::array(self.kind, 0, false),
            _ => ValueRep::array(self.kind, offset, self.is_compressed),
        }
    }

    /// Writes its bytes.
    pub(super) fn write(&self, out: &mut (impl Write + ?Sized)) -> Result<()> {
        if self.count == 0 {
            return Ok(());
        }
        out.write_all(&self.count.to_le_bytes())?;
        match &self.body {
            Body::Bytes(bytes) => Ok(out.write_all(bytes)?),
            Body::Floats(values) => write_f32s(values, out),
        }
    }
}

/// Compresses integers, and appends the compressed size and the compressed bytes.
pub(super) fn append_compressed<T: Integer>(
    values: impl ExactSizeIterator<Item = T> + Clone,
    out: &mut Vec<u8>,
) -> Result<()> {
    let mut encoded = Vec::new();
    encode(values, &mut encoded);
    append_lz4(&encoded, out)
}

/// Compresses bytes, and appends the compressed size and the compressed bytes.
pub(super) fn append_lz4(bytes: &[u8], out: &mut Vec<u8>) -> Result<()> {
    let size_at = out.len();
    out.extend_from_slice(&[0; 8]);
    append_chunks(bytes, out).ok_or_else(too_large)?;
    let size = (out.len() - size_at - 8) as u64;
    out[size_at..size_at + 8].copy_from_slice(&size.to_le_bytes());
    Ok(())
}

/// Fails if vertex indices do not fit into 31 bits.
fn check_corners(triangles: &[[u32; 3]]) -> Result<()> {
    let most = triangles.as_flattened().iter().copied().max().unwrap_or_default();
    index(most as usize).map(drop)
}

/// Converts an index; fails if it does not fit into 31 bits.
pub(super) fn index(index: usize) -> Result<i32> {
    i32::try_from(index).map_err(|_| too_large())
}

fn too_large() -> Error {
    Error::too_large(FORMAT, "the mesh exceeds the limit of 2147483647 vertices, faces or strings")
}

// Arrays of single floats that take fewer bytes as integers, or as indices into a table.

/// The code of an array of floats that is stored as integers.
pub(super) const AS_INTEGERS: u8 = b'i';

/// The code of an array of floats that is stored as a table and indices into it.
pub(super) const AS_TABLE: u8 = b't';

/// The most entries of a table.
const TABLE_MAX: usize = 1024;

/// The floats as integers; `None` unless all floats are integers.
#[expect(clippy::cast_possible_truncation, reason = "compared with the value afterwards")]
fn as_integers(values: &[f32]) -> Option<Vec<i32>> {
    // The comparison of bits excludes −0. The limit excludes 2³¹, which the cast saturates to `i32::MAX`.
    let integer = |&value: &f32| {
        let integer = value as i32;
        (integer < i32::MAX && (integer as f32).to_bits() == value.to_bits()).then_some(integer)
    };
    values.iter().map(integer).collect()
}

/// The distinct floats in the order of their first occurrence, and the index of each value among them; `None`
/// if a table would not save enough.
fn as_table(values: &[f32]) -> Option<(Vec<f32>, Vec<i32>)> {
    let most = (values.len() / 4).min(TABLE_MAX);
    let (mut table, mut index_of) = (Vec::new(), HashMap::new());
    let mut indices = Vec::new();
    for value in values {
        let index = *index_of.entry(value.to_bits()).or_insert(table.len());
        if index == table.len() {
            if index == most {
                return None;
            }
            table.push(*value);
        }
        indices.push(i32::try_from(index).ok()?);
    }
    Some((table, indices))
}

// Encodes integers before LZ4 compresses them: as differences, of which the most common one takes two bits.
//
//   values        123, 124, 125, 100125, 100125
//   differences   123, 1, 1, 100000, 0                         the first one is relative to 0
//   encoded       1 │ 01 00 00 11 01 │ 123, 100000, 0          most common │ 2-bit codes │ other differences
//
//   code          0 common    1 narrow     2 medium     3 wide
//   32 bits                   8 bits       16 bits      32 bits
//   64 bits                   16 bits      32 bits      64 bits
//
// Four codes share a byte, the first one in its lowest bits.

/// An integer type that can be encoded. All arithmetic wraps around at the size of the type.
pub(super) trait Integer: Copy {
    /// The sizes of a narrow, a medium and a wide difference, in bytes.
    const CODE_BYTES: [usize; 3];
    fn widened(self) -> i64;
    /// The lowest bits of `value`.
    fn lowest(value: i64) -> Self;
}

impl Integer for i32 {
    const CODE_BYTES: [usize; 3] = [1, 2, 4];
    fn widened(self) -> i64 {
        i64::from(self)
    }
    #[expect(clippy::cast_possible_truncation, reason = "the coding wraps")]
    fn lowest(value: i64) -> i32 {
        value as i32
    }
}

impl Integer for i64 {
    const CODE_BYTES: [usize; 3] = [2, 4, 8];
    fn widened(self) -> i64 {
        self
    }
    fn lowest(value: i64) -> i64 {
        value
    }
}

/// The maximum size of `count` encoded integers, in bytes; `None` if it exceeds `usize`.
pub(super) fn encoded_bytes_max<T: Integer>(count: usize) -> Option<usize> {
    let wide = T::CODE_BYTES[2];
    count.checked_mul(wide)?.checked_add(wide)?.checked_add(count.div_ceil(4))
}

/// The size of a difference in memory, in bytes.
const WHOLE_BYTES: usize = size_of::<i64>();

/// The differences that are counted to find the most common one: those of 16 bits.
const COUNTED: Range<i64> = -(1 << 15)..1 << 15;

/// Encodes integers, which replace the bytes of `out`; no integers take no bytes.
pub(super) fn encode<T: Integer>(values: impl ExactSizeIterator<Item = T> + Clone, out: &mut Vec<u8>) {
    let [narrow, medium, wide] = T::CODE_BYTES;
    let count = values.len();
    out.clear();
    if count == 0 {
        return;
    }
    let mut last = T::lowest(0);
    let differences = values.map(move |value| {
        let difference = T::lowest(value.widened().wrapping_sub(last.widened())).widened();
        last = value;
        difference
    });
    let common = most_common(differences.clone());
    out.resize(wide + count.div_ceil(4), 0);
    out[..wide].copy_from_slice(&common.to_le_bytes()[..wide]);
    let (mut differences, mut at) = (differences, wide);
    // The differences of a piece. They are collected here, because a vector of the largest possible size
    // would have to be cleared.
    let mut others = [0; PIECE * WHOLE_BYTES];
    for piece in 0..count.div_ceil(PIECE) {
        let piece_count = PIECE.min(count - piece * PIECE);
        let codes = &mut out[at..at + piece_count.div_ceil(4)];
        let mut end = 0;
        for codes in &mut *codes {
            for (shift, difference) in [0, 2, 4, 6].into_iter().zip(&mut differences) {
                // Without branches, because the sizes of differences are hard to predict.
                let code = u8::from(difference != common)
                    * (1 + u8::from(!fits(difference, narrow)) + u8::from(!fits(difference, medium)));
                *codes |= code << shift;
                // Copies eight bytes, because copying a constant number is faster. The next difference
                // overwrites the excess.
                others[end..end + WHOLE_BYTES].copy_from_slice(&difference.to_le_bytes());
                end += [0, narrow, medium, wide][usize::from(code)];
            }
        }
        at += codes.len();
        out.extend_from_slice(&others[..end]);
    }
}

/// The number of integers that are encoded at a time, a multiple of four.
const PIECE: usize = 1024;

/// Whether a number fits into a signed integer of this many bytes.
fn fits(value: i64, bytes: usize) -> bool {
    let unused = 64 - 8 * bytes;
    (value << unused) >> unused == value
}

/// The most common difference. If several are equally common, the largest of them, which saves most.
fn most_common(differences: impl Iterator<Item = i64>) -> i64 {
    let mut counts = vec![0_u32; 1 << 16];
    for difference in differences.filter(|difference| COUNTED.contains(difference)) {
        let count = &mut counts[code_index(difference)];
        *count = count.saturating_add(1);
    }
    COUNTED.max_by_key(|&difference| counts[code_index(difference)]).unwrap_or_default()
}

#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "counted differences have 16 bits"
)]
fn code_index(difference: i64) -> usize {
    (difference - COUNTED.start) as usize
}

/// Decodes `count` integers; `None` if the bytes are too few or too many.
pub(super) fn decode<T: Integer>(bytes: &[u8], count: usize) -> Option<Vec<T>> {
    if count == 0 {
        return bytes.is_empty().then(Vec::new);
    }
    let (common, rest) = bytes.split_at_checked(T::CODE_BYTES[2])?;
    let (codes, mut rest) = rest.split_at_checked(count.div_ceil(4))?;
    let common = signed(common);
    let mut values = Vec::with_capacity(count);
    let mut last = 0_i64;
    for index in 0..count {
        let difference = match (codes[index / 4] >> (2 * (index % 4))) & 3 {
            0 => common,
            code => {
                let number;
                (number, rest) = rest.split_at_checked(T::CODE_BYTES[usize::from(code) - 1])?;
                signed(number)
            }
        };
        let value = T::lowest(last.wrapping_add(difference));
        last = value.widened();
        values.push(value);
    }
    rest.is_empty().then_some(values)
}

/// A signed little-endian number of up to eight bytes.
fn signed(bytes: &[u8]) -> i64 {
    let mut all = [0; 8];
    all[..bytes.len()].copy_from_slice(bytes);
    let unused = 64 - 8 * bytes.len();
    (i64::from_le_bytes(all) << unused) >> unused
}

// LZ4 blocks as the crate format stores them: the number of chunks in one byte, and the chunks.
//
//   0   LZ4 block                                    one block
//   n   i32 size, LZ4 block; i32 size, ..            n chunks, for more than 2 GB

/// The most bytes in a block.
const BLOCK_BYTES_MAX: usize = 0x7e00_0000;

/// The most chunks.
const CHUNKS_MAX: usize = 127;

/// Appends the compressed bytes; `None` if they are more than all chunks hold, 250 GiB.
fn append_chunks(bytes: &[u8], out: &mut Vec<u8>) -> Option<()> {
    if bytes.len() <= BLOCK_BYTES_MAX {
        out.push(0);
        return append_block(bytes, out);
    }
    let chunks = bytes.chunks(BLOCK_BYTES_MAX);
    out.push(u8::try_from(chunks.len()).ok().filter(|&count| usize::from(count) <= CHUNKS_MAX)?);
    for chunk in chunks {
        let start = out.len();
        out.extend_from_slice(&[0; 4]);
        append_block(chunk, out)?;
        let size = i32::try_from(out.len() - start - 4).ok()?;
        out[start..start + 4].copy_from_slice(&size.to_le_bytes());
    }
    Some(())
}

fn append_block(bytes: &[u8], out: &mut Vec<u8>) -> Option<()> {
    let start = out.len();
    out.resize(start + get_maximum_output_size(bytes.len()), 0);
    let length = compress_into(bytes, &mut out[start..]).ok()?;
    out.truncate(start + length);
    Some(())
}

/// Decompresses into `out` and returns the number of bytes; `None` if the data are invalid or longer than
/// `out`.
pub(super) fn decompress(bytes: &[u8], out: &mut [u8]) -> Option<usize> {
    let (&chunk_count, mut rest) = bytes.split_first()?;
    if chunk_count == 0 {
        return decompress_into(rest, out).ok();
    }
    let mut length = 0;
    for _ in 0..chunk_count {
        let (size, chunks) = rest.split_first_chunk()?;
        let size = usize::try_from(i32::from_le_bytes(*size)).ok()?;
        length += decompress_into(chunks.get(..size)?, &mut out[length..]).ok()?;
        rest = &chunks[size..];
    }
    Some(length)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn integers_and_tables_are_exact() {
        assert_eq!(as_integers(&[0.0, -3.0, 16_777_216.0]), Some(vec![0, -3, 16_777_216]));
        for other in [-0.0, 0.5, 2_147_483_648.0, f32::INFINITY, f32::NAN] {
            assert_eq!(as_integers(&[1.0, other]), None, "{other}");
        }
        assert_eq!(as_integers(&[-2_147_483_648.0]), Some(vec![i32::MIN]));
        let repeated = [0.5, -0.0, 0.5, 0.0, 0.5, 0.5, 0.5, 0.5, 0.5, 0.5, 0.5, 0.5];
        let (table, indices) = as_table(&repeated).expect("three values");
        assert_eq!(
            table.iter().map(|x| x.to_bits()).collect::<Vec<_>>(),
            [0.5_f32, -0.0, 0.0].map(f32::to_bits)
        );
        assert_eq!(indices[..4], [0, 1, 0, 2]);
        let distinct: Vec<f32> = (0_u16..100).map(f32::from).collect();
        assert_eq!(as_table(&distinct), None);
        assert_eq!(as_table(&[1.0, 1.0, 1.0]), None);
    }

    #[test]
    fn encoding_is_the_documented_one() {
        let mut encoded = vec![7]; // of an earlier array
        encode([123_i32, 124, 125, 100_125, 100_125, 100_126, 100_126].into_iter(), &mut encoded);
        // The codes are 1 0 0 3, then 1 0 1: the most common difference is 1, which occurs three times.
        let expected =
            [&1_i32.to_le_bytes()[..], &[0b1100_0001, 0b0001_0001, 123], &100_000_i32.to_le_bytes(), &[0, 0]];
        assert_eq!(encoded, expected.concat());
    }

    #[test]
    fn integers_round_trip_and_damage_is_noticed() {
        let edges = [0, 1, -1, 127, -128, 128, 32_767, -32_768, 32_768, 65_536, i64::from(i32::MAX)];
        let more = [i64::from(i32::MIN), i64::MAX, i64::MIN, 3, 3, 3, 3];
        let mut bytes = Vec::new();
        let long: Vec<i64> = edges.iter().chain(&more).copied().cycle().take(5000).collect();
        for count in [0, 1, 2, 3, 4, 5, 17, 1000, 1023, 1024, 1025, 2048, 5000] {
            let wide = &long[..count];
            encode(wide.iter().copied(), &mut bytes);
            assert!(bytes.len() <= encoded_bytes_max::<i64>(count).expect("small"));
            assert_eq!(decode::<i64>(&bytes, count).expect("intact"), wide);
            let narrow: Vec<i32> = wide.iter().map(|&value| i32::lowest(value)).collect();
            encode(narrow.iter().copied(), &mut bytes);
            assert_eq!(decode::<i32>(&bytes, count).expect("intact"), narrow);
            if count > 0 {
                assert!(decode::<i32>(&bytes[..bytes.len() - 1], count).is_none());
                assert!(decode::<i32>(&[&bytes[..], &[0]].concat(), count).is_none());
            }
        }
        assert_eq!(encoded_bytes_max::<i32>(usize::MAX), None);
    }

    #[test]
    fn blocks_and_chunks_round_trip() {
        for bytes in [&b""[..], b"a", &[7; 5000], &[1, 2, 3].repeat(99)] {
            let mut block = Vec::new();
            append_chunks(bytes, &mut block).expect("short");
            let mut out = vec![0; bytes.len()];
            assert_eq!(decompress(&block, &mut out), Some(bytes.len()));
            assert_eq!(out, bytes);
            // The same in two chunks.
            let size = i32::try_from(block.len() - 1).expect("short").to_le_bytes();
            let chunk = [&size, &block[1..]].concat();
            let mut out = vec![0; 2 * bytes.len()];
            assert_eq!(decompress(&[&[2], &chunk[..], &chunk].concat(), &mut out), Some(2 * bytes.len()));
            assert_eq!(out, bytes.repeat(2));
        }
        for invalid in [&b""[..], &[1], &[1, 255, 255, 255, 255], &[0, 0xf0], &[3, 1, 0, 0, 0, 0]] {
            assert_eq!(decompress(invalid, &mut [0; 9]), None, "{invalid:?}");
        }
    }
}
