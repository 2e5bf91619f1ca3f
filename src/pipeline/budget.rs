//! The memory budget of the frames in flight.
//!
//! ```text
//!   call             when, and how much memory                         waits until
//!   reserve_input    before reading: about the size of the file        it fits, or nothing is reserved
//!   resize           after reading: the size of the input
//!   reserve_compute  before computing: the peak of the frame           it fits, or no other frame computes
//!   resize           after computing: the size of the surface
//!   drop             after writing: releases everything
//! ```
//!
//! Every wait ends. A frame that computes never waits for memory again, so it finishes and releases its
//! memory. When no frame computes, a waiting frame may start. This holds if only one thread reserves for
//! input and only one for computing: then at most two frames hold memory without computing, and the earlier
//! of them starts next.
//!
//! So a frame that plans to use more than the whole budget computes alone. Beside it, at most the particles
//! of the next frame are in memory. The method makes no such plan: it uses tiles for frames that do not fit,
//! or returns an error.

use std::collections::HashMap;
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};

/// A limit on shared memory, in bytes.
pub(super) struct Budget {
    limit: u64,
    reserved: Mutex<Reserved>,
    released: Condvar,
}

#[derive(Default)]
struct Reserved {
    /// 128 bits, because they hold any sum of 64-bit sizes.
    bytes: u128,
    admitted_count: usize,
    /// Memory that all frames share, by owner, in bytes.
    aside: HashMap<usize, u64>,
}

/// A frame's share of the budget, released on drop.
pub(super) struct Reservation<'a> {
    budget: &'a Budget,
    bytes: u64,
    is_admitted: bool,
}

impl Budget {
    /// A budget of `limit` bytes.
    pub(super) fn new(limit: u64) -> Budget {
        Budget { limit, reserved: Mutex::default(), released: Condvar::new() }
    }

    /// Waits until `bytes` more fit, or nothing is reserved.
    pub(super) fn reserve_input(&self, bytes: u64) -> Reservation<'_> {
        let mut reserved = self.wait_while(|reserved| reserved.bytes > 0 && !self.fits(reserved, 0, bytes));
        reserved.bytes += u128::from(bytes);
        Reservation { budget: self, bytes, is_admitted: false }
    }

    /// Sets the size of memory that belongs to `owner` and is shared by all frames, such as static obstacles.
    /// It counts against the limit until the budget is dropped. The smaller remaining budget cannot cause a
    /// deadlock: waiting frames still wait only for other frames.
    pub(super) fn set_shared(&self, owner: usize, bytes: u64) {
        self.reserved().aside.insert(owner, bytes);
        self.released.notify_all();
    }

    fn fits(&self, reserved: &Reserved, own_bytes: u128, bytes: u64) -> bool {
        let aside_bytes: u128 = reserved.aside.values().map(|&bytes| u128::from(bytes)).sum();
        reserved.bytes - own_bytes + aside_bytes + u128::from(bytes) <= u128::from(self.limit)
    }

    fn wait_while(&self, is_full: impl Fn(&Reserved) -> bool) -> MutexGuard<'_, Reserved> {
        let waited = self.released.wait_while(self.reserved(), |reserved| is_full(reserved));
        waited.unwrap_or_else(PoisonError::into_inner)
    }

    /// The fields are consistent at any time, so a poisoned lock is used like any other.
    fn reserved(&self) -> MutexGuard<'_, Reserved> {
        self.reserved.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Reservation<'_> {
    /// Records memory that is already allocated; may exceed the limit.
    pub(super) fn resize(&mut self, bytes: u64) {
        let mut reserved = self.budget.reserved();
        reserved.bytes = reserved.bytes - u128::from(self.bytes) + u128::from(bytes);
        self.bytes = bytes;
        self.budget.released.notify_all();
    }

    /// Waits until `bytes` fit in place of the current reservation, or until no other frame computes.
    pub(super) fn reserve_compute(&mut self, bytes: u64) {
        let budget = self.budget;
        let own = u128::from(self.bytes);
        let mut reserved =
            budget.wait_while(|reserved| reserved.admitted_count > 0 && !budget.fits(reserved, own, bytes));
        reserved.bytes = reserved.bytes - own + u128::from(bytes);
        reserved.admitted_count += 1;
        self.bytes = bytes;
        self.is_admitted = true;
    }
}

impl Drop for Reservation<'_> {
    fn drop(&mut self) {
        let mut reserved = self.budget.reserved();
        reserved.bytes -= u128::from(self.bytes);
        reserved.admitted_count -= usize::from(self.is_admitted);
        self.budget.released.notify_all();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shared_memory_reduces_the_budget() {
        let budget = Budget::new(10);
        // The only frame never waits, even if the shared memory exceeds the limit.
        budget.set_shared(1, 20);
        drop(budget.reserve_input(30));
        for (owner, bytes) in [(1, 3), (2, 1)] {
            budget.set_shared(owner, bytes);
        }
        let mut held = budget.reserve_input(4);
        let fits = |bytes| budget.fits(&budget.reserved(), 0, bytes);
        assert!(fits(2) && !fits(3));
        held.resize(1);
        assert!(fits(5) && !fits(6));
    }
}
