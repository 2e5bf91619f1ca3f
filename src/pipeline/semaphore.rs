//! A counting semaphore, on a bounded channel.

use crossbeam::channel::{Receiver, Sender, bounded};

/// Permits that are acquired, and released when they are dropped.
#[derive(Clone)]
pub(super) struct Semaphore {
    acquired: Sender<()>,
    released: Receiver<()>,
}

/// One permit.
pub(super) struct Permit(Receiver<()>);

impl Semaphore {
    /// A semaphore with this many permits.
    pub(super) fn new(count: usize) -> Semaphore {
        let (acquired, released) = bounded(count);
        Semaphore { acquired, released }
    }

    /// Waits for a permit.
    pub(super) fn acquire(&self) -> Permit {
        // This fails only without a receiver, and `self` has one.
        let _ = self.acquired.send(());
        Permit(self.released.clone())
    }
}

impl Drop for Permit {
    fn drop(&mut self) {
        let _ = self.0.try_recv();
    }
}
