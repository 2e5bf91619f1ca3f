//! Copies columns out of packed binary records.
//!
//! ```text
//!   records   x y z vx vy vz id | x y z vx vy vz id | ..       stride apart
//!   targets   [x y z] [x y z] ..    [vx vy vz] ..    [id] ..
//! ```
//!
//! The records are divided among the threads and processed in blocks that fit into the cache. Within a block,
//! each target is filled by a loop specialised at compile time for type, byte order and arity.

use rayon::prelude::*;

use crate::bytes::Endian;
use crate::error::Result;
use crate::scalar::Scalar;

use super::header::{Element, PropertyType};
use super::rows::RecordReader;
use super::target::{Slots, Target};

/// Bytes of records per block: a block and the values copied from it fit into the L2 cache.
const BLOCK_BYTES: usize = 128 << 10;

/// Bytes of records per task. Most of a task's time is spent on page faults, at the first access to the
/// destination memory.
const PART_BYTES: usize = 2 << 20;

/// Fills the targets from records of `stride` bytes, in the caller's thread pool. `offsets` has the offset of
/// each property within a record.
pub(super) fn gather(
    records: &[u8],
    stride: usize,
    offsets: &[usize],
    endian: Endian,
    mut targets: Vec<Target<'_>>,
) {
    let part_records = (PART_BYTES / stride).max(1);
    let parts = records.chunks(part_records * stride).map(|records| {
        let count = records.len() / stride;
        let targets: Vec<Target> = targets.iter_mut().map(|target| target.take_front(count)).collect();
        (records, targets)
    });
    let parts: Vec<(&[u8], Vec<Target>)> = parts.collect();
    let gather_part = |(records, mut targets): (&[u8], Vec<Target>)| {
        gather_part(records, stride, offsets, endian, &mut targets);
    };
    parts.into_par_iter().for_each(gather_part);
}

/// [`gather`] on the current thread.
pub(super) fn gather_part(
    records: &[u8],
    stride: usize,
    offsets: &[usize],
    endian: Endian,
    targets: &mut [Target<'_>],
) {
    let block_records = (BLOCK_BYTES / stride).max(1);
    for (index, records) in records.chunks(block_records * stride).enumerate() {
        let block = RecordBlock { records, stride, first: index * block_records };
        for target in targets.iter_mut() {
            match endian {
                Endian::Little => block.fill::<false>(offsets, target),
                Endian::Big => block.fill::<true>(offsets, target),
            }
        }
    }
}

/// The offset of each property in a record without its lists, and the length of this record. A list has the
/// offset of the property after it.
pub(super) fn scalar_offsets(element: &Element) -> (Vec<usize>, usize) {
    let mut at = 0;
    let mut offsets = Vec::with_capacity(element.properties.len());
    for property in &element.properties {
        offsets.push(at);
        if let PropertyType::Scalar(scalar) = property.kind {
            at += scalar.size();
        }
    }
    (offsets, at)
}

/// Copies records without their lists.
pub(super) fn without_lists(rows: &mut RecordReader<'_>, element: &Element, count: usize) -> Result<Vec<u8>> {
    let (_, stride) = scalar_offsets(element);
    // The caller has checked that the file has `count` times `stride` bytes.
    let mut packed = Vec::with_capacity(count * stride);
    for _ in 0..count {
        for property in &element.properties {
            match (property.kind, &mut *rows) {
                (PropertyType::Scalar(scalar), RecordReader::Binary(cursor)) => {
                    packed.extend_from_slice(cursor.take(scalar.size(), &property.name)?);
                }
                _ => rows.skip(property)?,
            }
        }
    }
    Ok(packed)
}

/// A range of the records.
struct RecordBlock<'a> {
    records: &'a [u8],
    stride: usize,
    /// Index of the first record.
    first: usize,
}

impl RecordBlock<'_> {
    /// Fills one target.
    fn fill<const BIG: bool>(&self, offsets: &[usize], target: &mut Target<'_>) {
        let scalar = target.columns[0].1;
        let arity = target.columns.len();
        // Positions and vectors are copied in one pass.
        if let [x, y, z] = target.columns[..]
            && [x.1, y.1, z.1] == [scalar; 3]
        {
            let at = [x.0, y.0, z.0].map(|property| offsets[property]);
            return self.convert::<BIG, 3>(at, scalar, &mut target.slots, 0, 3);
        }
        for (component, &(property, scalar)) in target.columns.iter().enumerate() {
            self.convert::<BIG, 1>([offsets[property]], scalar, &mut target.slots, component, arity);
        }
    }

    /// Selects the conversion from the type in the file to the type of the slots.
    fn convert<const BIG: bool, const A: usize>(
        &self,
        offsets: [usize; A],
        scalar: Scalar,
        slots: &mut Slots<'_>,
        component: usize,
        arity: usize,
    ) {
        macro_rules! copy {
            ($out:ident, $from:ty) => {
                self.copy(offsets, &mut $out[self.first * arity..], component, arity, |bytes| {
                    <$from>::from_le_bytes(ordered::<BIG, _>(bytes)).into()
                })
            };
        }
        match (slots, scalar) {
            (Slots::F32(out), Scalar::F32) => copy!(out, f32),
            (Slots::F32(out), Scalar::I8) => copy!(out, i8),
            (Slots::F32(out), Scalar::U8) => copy!(out, u8),
            (Slots::F32(out), Scalar::I16) => copy!(out, i16),
            (Slots::F32(out), Scalar::U16) => copy!(out, u16),
            (Slots::F64(out), Scalar::F64) => copy!(out, f64),
            (Slots::F64(out), Scalar::F32) => copy!(out, f32),
            (Slots::F64(out), Scalar::I8) => copy!(out, i8),
            (Slots::F64(out), Scalar::U8) => copy!(out, u8),
            (Slots::F64(out), Scalar::I16) => copy!(out, i16),
            (Slots::F64(out), Scalar::U16) => copy!(out, u16),
            (Slots::F64(out), Scalar::I32) => copy!(out, i32),
            (Slots::F64(out), Scalar::U32) => copy!(out, u32),
            (Slots::U8(out), Scalar::U8) => copy!(out, u8),
            (Slots::I32(out), Scalar::I8) => copy!(out, i8),
            (Slots::I32(out), Scalar::I16) => copy!(out, i16),
            (Slots::I32(out), Scalar::U16) => copy!(out, u16),
            (Slots::I32(out), Scalar::I32) => copy!(out, i32),
            (Slots::I64(out), Scalar::U32) => copy!(out, u32),
            _ => unreachable!("slots can hold every value of their scalar type"),
        }
    }

    /// The copy loop. It copies all components of a record at a time (`A` is the arity, and `component` is
    /// 0), or only the given component (`A` is 1).
    fn copy<T, const N: usize, const A: usize>(
        &self,
        offsets: [usize; A],
        out: &mut [T],
        component: usize,
        arity: usize,
        decode: impl Fn([u8; N]) -> T + Copy,
    ) {
        let records = self.records.chunks_exact(self.stride);
        if A == arity {
            for (row, record) in out.as_chunks_mut::<A>().0.iter_mut().zip(records) {
                for (slot, offset) in row.iter_mut().zip(offsets) {
                    *slot = decode(array_at(record, offset));
                }
            }
        } else {
            let slots = out.iter_mut().skip(component).step_by(arity);
            for (slot, record) in slots.zip(records) {
                *slot = decode(array_at(record, offsets[0]));
            }
        }
    }
}

fn array_at<const N: usize>(record: &[u8], offset: usize) -> [u8; N] {
    let mut array = [0; N];
    array.copy_from_slice(&record[offset..offset + N]);
    array
}

/// The bytes with the least significant first.
fn ordered<const BIG: bool, const N: usize>(mut bytes: [u8; N]) -> [u8; N] {
    if BIG {
        bytes.reverse();
    }
    bytes
}
