//! Copies columns out of packed binary records.
//!
//! ```text
//!   records   x y z vx vy vz id | x y z vx vy vz id | ..       stride apart
//!   targets   [x y z] [x y z] ..    [vx vy vz] ..    [id] ..
//! ```
//!
//! The records are divided among the threads and processed in blocks that fit into the cache. Within a block,
//! each target is filled by a loop specialised at compile time for type, byte order and arity.

use std::sync::Arc;

use rayon::prelude::*;

use crate::core::bytes::Endian;
use crate::core::data::{FilePositions, Values};
use crate::core::number::NumberType;

/// Where the numbers of a record are.
#[derive(Clone, Copy)]
pub(crate) struct RecordLayout<'a> {
    /// Bytes from one record to the next.
    pub(crate) stride: usize,
    /// The offset of each column within a record.
    pub(crate) offsets: &'a [usize],
    pub(crate) endian: Endian,
}

/// The destination of values.
pub(crate) struct Target<'a> {
    /// Index and type of the column of each component; never empty.
    pub(crate) columns: Arc<[(usize, NumberType)]>,
    /// All components of all particles.
    pub(crate) slots: Slots<'a>,
}

/// The vector that a target fills. Its type can hold every number of the columns' types.
pub(crate) enum Slots<'a> {
    F32(&'a mut [f32]),
    F64(&'a mut [f64]),
    U8(&'a mut [u8]),
    I32(&'a mut [i32]),
    I64(&'a mut [i64]),
}

impl<'a> Slots<'a> {
    pub(crate) fn of_positions(positions: &'a mut FilePositions) -> Slots<'a> {
        match positions {
            FilePositions::F32(positions) => Slots::F32(positions.as_flattened_mut()),
            FilePositions::F64(positions) => Slots::F64(positions.as_flattened_mut()),
        }
    }

    pub(crate) fn of_values(values: &'a mut Values) -> Slots<'a> {
        match values {
            Values::F32(values) => Slots::F32(values),
            Values::F64(values) => Slots::F64(values),
            Values::U8(values) => Slots::U8(values),
            Values::I32(values) | Values::Strings { indices: values, .. } => Slots::I32(values),
            Values::I64(values) => Slots::I64(values),
        }
    }
}

impl<'a> Target<'a> {
    /// Splits off the slots of the first `count` records.
    pub(crate) fn take_front(&mut self, count: usize) -> Target<'a> {
        fn take<'a, T>(slots: &mut &'a mut [T], count: usize) -> &'a mut [T] {
            let (front, rest) = std::mem::take(slots).split_at_mut(count);
            *slots = rest;
            front
        }
        let count = count * self.columns.len();
        let slots = match &mut self.slots {
            Slots::F32(slots) => Slots::F32(take(slots, count)),
            Slots::F64(slots) => Slots::F64(take(slots, count)),
            Slots::U8(slots) => Slots::U8(take(slots, count)),
            Slots::I32(slots) => Slots::I32(take(slots, count)),
            Slots::I64(slots) => Slots::I64(take(slots, count)),
        };
        Target { columns: Arc::clone(&self.columns), slots }
    }
}

/// Bytes of records per block: a block and the values copied from it fit into the L2 cache.
const BLOCK_BYTES: usize = 128 << 10;

/// Bytes of records per task. Most of a task's time is spent on page faults, at the first access to the
/// destination memory.
const PART_BYTES: usize = 2 << 20;

/// Fills the targets, in the caller's thread pool.
pub(crate) fn gather(records: &[u8], layout: RecordLayout, mut targets: Vec<Target<'_>>) {
    let part_records = (PART_BYTES / layout.stride).max(1);
    let mut parts: Vec<(&[u8], Vec<Target>)> = Vec::new();
    for records in records.chunks(part_records * layout.stride) {
        let count = records.len() / layout.stride;
        parts.push((records, targets.iter_mut().map(|target| target.take_front(count)).collect()));
    }
    parts.into_par_iter().for_each(|(records, mut targets)| gather_part(records, layout, &mut targets));
}

/// [`gather`] on the current thread.
pub(crate) fn gather_part(records: &[u8], layout: RecordLayout, targets: &mut [Target<'_>]) {
    let block_records = (BLOCK_BYTES / layout.stride).max(1);
    for (index, records) in records.chunks(block_records * layout.stride).enumerate() {
        let block = RecordBlock { records, layout, first: index * block_records };
        for target in targets.iter_mut() {
            match layout.endian {
                Endian::Little => block.fill::<false>(target),
                Endian::Big => block.fill::<true>(target),
            }
        }
    }
}

/// A run of records.
struct RecordBlock<'a> {
    records: &'a [u8],
    layout: RecordLayout<'a>,
    /// Index of the first record.
    first: usize,
}

impl RecordBlock<'_> {
    /// Fills one target.
    fn fill<const BIG: bool>(&self, target: &mut Target<'_>) {
        let number = target.columns[0].1;
        let arity = target.columns.len();
        // Positions and vectors are copied in one pass.
        if let [x, y, z] = target.columns[..]
            && [x.1, y.1, z.1] == [number; 3]
        {
            let at = [x.0, y.0, z.0].map(|column| self.layout.offsets[column]);
            return self.convert::<BIG, 3>(at, number, &mut target.slots, 0, 3);
        }
        for (component, &(column, number)) in target.columns.iter().enumerate() {
            let at = [self.layout.offsets[column]];
            self.convert::<BIG, 1>(at, number, &mut target.slots, component, arity);
        }
    }

    /// Selects the conversion from the type in the file to the type of the slots.
    fn convert<const BIG: bool, const A: usize>(
        &self,
        offsets: [usize; A],
        number: NumberType,
        slots: &mut Slots<'_>,
        component: usize,
        arity: usize,
    ) {
        macro_rules! copy {
            ($out:ident from $($number:ident $type:ty),+) => {
                match number {
                    $(NumberType::$number => {
                        self.copy(offsets, &mut $out[self.first * arity..], component, arity, |bytes| {
                            <$type>::from_le_bytes(ordered::<BIG, _>(bytes)).into()
                        })
                    })+
                    _ => unreachable!("slots can hold every number of their columns"),
                }
            };
        }
        match slots {
            Slots::F32(out) => copy!(out from F32 f32, I8 i8, U8 u8, I16 i16, U16 u16),
            Slots::F64(out) => {
                copy!(out from F64 f64, F32 f32, I8 i8, U8 u8, I16 i16, U16 u16, I32 i32, U32 u32)
            }
            Slots::U8(out) => copy!(out from U8 u8),
            Slots::I32(out) => copy!(out from I8 i8, I16 i16, U16 u16, I32 i32),
            Slots::I64(out) => copy!(out from U32 u32),
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
        let records = self.records.chunks_exact(self.layout.stride);
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
