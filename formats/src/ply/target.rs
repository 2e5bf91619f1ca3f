//! Where the values of records go.

use crate::scalar::Scalar;

/// The destination of values.
pub(super) struct Target<'a> {
    /// Index and type of the property of each component; never empty.
    pub(super) columns: Vec<(usize, Scalar)>,
    /// All components of all particles.
    pub(super) slots: Slots<'a>,
}

/// The vector that a target fills. Its type can hold every value of the columns' scalar types.
pub(super) enum Slots<'a> {
    F32(&'a mut [f32]),
    F64(&'a mut [f64]),
    U8(&'a mut [u8]),
    I32(&'a mut [i32]),
    I64(&'a mut [i64]),
}

impl<'a> Target<'a> {
    /// Splits off the slots of the first `count` records.
    pub(super) fn take_front(&mut self, count: usize) -> Target<'a> {
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
        Target { columns: self.columns.clone(), slots }
    }
}
