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
use std::io::Write;
use std::{iter, mem};

use crate::error::{Error, Result};
use crate::le_bytes::write_f32s;
use crate::quads::{faces, quad_count};
use crate::usd::{Elements, FORMAT};
use crate::vertex_attributes::string_index;

use super::floats::{AS_INTEGERS, AS_TABLE, as_integers, as_table};
use super::integers::{Integer, encode};
use super::lz4;
use super::value::{ValueRep, ValueType};

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

/// Memory for encoded integers, which a sequence reuses for the arrays of its frames.
#[derive(Default)]
pub(super) struct IntegerBuffers {
    body: Vec<u8>,
    /// The integers before their compression.
    encoded: Vec<u8>,
}

impl<'a> CrateArray<'a> {
    /// Encodes the elements of a property.
    ///
    /// # Errors
    ///
    /// [`Error::TooLarge`] if a mesh has more than 2³¹ vertices, or the array exceeds the format's limits.
    pub(super) fn of(elements: Elements<'a>) -> Result<CrateArray<'a>> {
        let buffers = &mut IntegerBuffers::default();
        match elements {
            Elements::Reals { values, stride, first, arity } => {
                Self::reals(Cow::Borrowed(values), stride, first, arity)
            }
            Elements::Integers { values, arity: 1, is_narrow: false } => {
                Self::integers(ValueType::Int64, values.iter().copied(), buffers)
            }
            Elements::Integers { values, arity, .. } => Self::narrow(values, arity),
            Elements::Strings { table, indices } => {
                let missing = index(table.len())?;
                let fixed_index = |&index: &i32| if string_index(index, table) < 0 { missing } else { index };
                Self::integers(ValueType::Int, indices.iter().map(fixed_index), buffers)
            }
            Elements::FaceCounts { triangles, quads } if quad_count(quads) == 0 => {
                Self::triangle_sizes(triangles.len(), buffers)
            }
            Elements::FaceCounts { triangles, quads } => {
                let counts = faces(triangles, quads, 0..triangles.len());
                let counts: Result<Vec<i32>> = counts.map(|face| index(face.corners().len())).collect();
                Self::integers(ValueType::Int, counts?.into_iter(), buffers)
            }
            Elements::FaceCorners { triangles, quads } => {
                if quad_count(quads) == 0 {
                    return Self::triangle_corners(triangles, buffers);
                }
                check_corners(triangles)?;
                let faces: Vec<_> = faces(triangles, quads, 0..triangles.len()).collect();
                let corners = faces.iter().flat_map(|face| face.corners());
                let corners: Vec<i32> = corners.map(|corner| corner.cast_signed()).collect();
                Self::integers(ValueType::Int, corners.into_iter(), buffers)
            }
        }
    }

    /// Encodes `arity` values of each element, from the value `first` on. An element has `stride` values.
    ///
    /// # Errors
    ///
    /// [`Error::TooLarge`] if the array exceeds the format's limits.
    pub(super) fn reals(
        values: Cow<'a, [f32]>,
        stride: usize,
        first: usize,
        arity: usize,
    ) -> Result<CrateArray<'a>> {
        let values = if (first, arity) == (0, stride) {
            values
        } else {
            let elements = values.chunks_exact(stride);
            Cow::Owned(elements.flat_map(|element| &element[first..first + arity]).copied().collect())
        };
        if arity == 1 { Self::floats(values) } else { Ok(Self::vectors(values, arity)) }
    }

    /// Encodes the numbers of corners of triangles.
    ///
    /// # Errors
    ///
    /// [`Error::TooLarge`] if the array exceeds the format's limits.
    pub(super) fn triangle_sizes(
        triangle_count: usize,
        buffers: &mut IntegerBuffers,
    ) -> Result<CrateArray<'a>> {
        Self::integers(ValueType::Int, iter::repeat_n(3, triangle_count), buffers)
    }

    /// Encodes the vertices of triangles.
    ///
    /// # Errors
    ///
    /// [`Error::TooLarge`] if the mesh has more than 2³¹ vertices, or the array exceeds the format's limits.
    pub(super) fn triangle_corners(
        triangles: &[[u32; 3]],
        buffers: &mut IntegerBuffers,
    ) -> Result<CrateArray<'a>> {
        check_corners(triangles)?;
        let corners = triangles.as_flattened().iter();
        Self::integers(ValueType::Int, corners.map(|corner| corner.cast_signed()), buffers)
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
        IntegerBuffers { body, encoded }: &mut IntegerBuffers,
    ) -> Result<CrateArray<'a>> {
        let (mut bytes, count) = (mem::take(body), values.len());
        bytes.clear();
        let is_compressed = count >= COMPRESSED_MIN;
        if is_compressed {
            encode(values, encoded);
            append_lz4(encoded, &mut bytes)?;
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
                return Self::integers(ValueType::Int, values, &mut IntegerBuffers::default());
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

    /// Gives the memory of the array to the next one.
    pub(super) fn recycle(self, buffers: &mut IntegerBuffers, values: &mut Vec<f32>) {
        match self.body {
            Body::Bytes(bytes) => buffers.body = bytes,
            Body::Floats(floats) => *values = floats.into_owned(),
        }
    }

    /// Writes its bytes.
    pub(super) fn write(&self, out: &mut impl Write) -> Result<()> {
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
    lz4::append_compressed(bytes, out).ok_or_else(too_large)?;
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
