//! How much memory the frames under way may take together.
//!
//! ```text
//!   reserve_input    before reading: about what the file is large      waits for room, or until nothing else is reserved
//!   resize           after reading: the input
//!   reserve_compute  before computing: all that the frame will take    waits for room, or until no other frame computes
//!   resize           after computing: the surface
//!   drop             after writing
//! ```
//!
//! Every wait ends. A frame that computes never waits for memory again, so it ends and
//! gives back what it has; when none computes, the one that waits may. For that, one thread reserves for input and one
//! for computing: then at most two frames have memory and do not compute, of which the earlier is next.
//!
//! A plan that is larger than the whole budget so runs alone, beside at most the particles of the next. The
//! method makes none such: it skins in tiles what does not fit, or says that it cannot.

use std::collections::HashMap;
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};

/// Memory to be shared, in bytes.
pub(super) struct Budget {
    limit: u64,
    taken: Mutex<Taken>,
    given_back: Condvar,
}

#[derive(Default)]
struct Taken {
    /// Wide enough for any sum of sizes that somebody claims.
    bytes: u128,
    admitted_count: usize,
    /// What is there for all frames: by whom, and how much.
    aside: HashMap<usize, u64>,
}

/// A frame's part of the budget, given back when it is dropped.
pub(super) struct Reservation<'a> {
    budget: &'a Budget,
    bytes: u64,
    is_admitted: bool,
}

impl Budget {
    /// A budget of so many bytes.
    pub(super) fn new(limit: u64) -> Budget {
        Budget { limit, taken: Mutex::default(), given_back: Condvar::new() }
    }

    /// Waits until there is room for so much more, or nothing is taken.
    pub(super) fn reserve_input(&self, bytes: u64) -> Reservation<'_> {
        let mut taken = self.wait_while(|taken| taken.bytes > 0 && !self.fits(taken, 0, bytes));
        taken.bytes += u128::from(bytes);
        Reservation { budget: self, bytes, is_admitted: false }
    }

    /// Counts what is there for all frames, as long as there are any, in place of what `owner` had before. That there
    /// is less room then makes nobody wait for ever: who waits still waits for other frames only.
    pub(super) fn set_shared(&self, owner: usize, bytes: u64) {
        self.taken().aside.insert(owner, bytes);
        self.given_back.notify_all();
    }

    fn fits(&self, taken: &Taken, own_bytes: u128, bytes: u64) -> bool {
        let aside_bytes: u128 = taken.aside.values().map(|&bytes| u128::from(bytes)).sum();
        taken.bytes - own_bytes + aside_bytes + u128::from(bytes) <= u128::from(self.limit)
    }

    fn wait_while(&self, is_full: impl Fn(&Taken) -> bool) -> MutexGuard<'_, Taken> {
        let waited = self.given_back.wait_while(self.taken(), |taken| is_full(taken));
        waited.unwrap_or_else(PoisonError::into_inner)
    }

    /// Two numbers are in order whatever panicked beside them.
    fn taken(&self) -> MutexGuard<'_, Taken> {
        self.taken.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Reservation<'_> {
    /// Takes so much from now on, whether there is room or not: what is there cannot be argued with.
    pub(super) fn resize(&mut self, bytes: u64) {
        let mut taken = self.budget.taken();
        taken.bytes = taken.bytes - u128::from(self.bytes) + u128::from(bytes);
        self.bytes = bytes;
        self.budget.given_back.notify_all();
    }

    /// Waits until there is room for so much in place of what is taken already, or until no other
    /// frame is admitted.
    pub(super) fn reserve_compute(&mut self, bytes: u64) {
        let budget = self.budget;
        let own = u128::from(self.bytes);
        let mut taken =
            budget.wait_while(|taken| taken.admitted_count > 0 && !budget.fits(taken, own, bytes));
        taken.bytes = taken.bytes - own + u128::from(bytes);
        taken.admitted_count += 1;
        self.bytes = bytes;
        self.is_admitted = true;
    }
}

impl Drop for Reservation<'_> {
    fn drop(&mut self) {
        let mut taken = self.budget.taken();
        taken.bytes -= u128::from(self.bytes);
        taken.admitted_count -= usize::from(self.is_admitted);
        self.budget.given_back.notify_all();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_set_aside_is_room_for_nobody() {
        let budget = Budget::new(10);
        // Who is alone never waits.
        budget.set_shared(1, 20);
        drop(budget.reserve_input(30));
        for (owner, bytes) in [(1, 3), (2, 1)] {
            budget.set_shared(owner, bytes);
        }
        let mut held = budget.reserve_input(4);
        let fits = |bytes| budget.fits(&budget.taken(), 0, bytes);
        assert!(fits(2) && !fits(3));
        held.resize(1);
        assert!(fits(5) && !fits(6));
    }
}
