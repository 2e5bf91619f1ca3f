//! Whose frames compute: as many as there are seats, and the others wait.

use crossbeam::channel::{Receiver, Sender, bounded};

/// The places in which frames compute.
pub(super) struct Seats {
    taken: Sender<()>,
    given_back: Receiver<()>,
}

/// One of them, given back when it is dropped.
pub(super) struct Seat<'a>(&'a Seats);

impl Seats {
    /// So many.
    pub(super) fn new(count: usize) -> Seats {
        let (taken, given_back) = bounded(count);
        Seats { taken, given_back }
    }

    /// One of them, once there is one.
    pub(super) fn take(&self) -> Seat<'_> {
        // It fails only when there are no more seats at all, and they last as long as this does.
        let _ = self.taken.send(());
        Seat(self)
    }
}

impl Drop for Seat<'_> {
    fn drop(&mut self) {
        let _ = self.0.given_back.try_recv();
    }
}
