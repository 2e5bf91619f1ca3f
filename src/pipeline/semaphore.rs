//! A counting semaphore, on a bounded channel.

use crossbeam::channel::{Receiver, Sender, bounded};

/// A counting semaphore: [`Semaphore::acquire`] returns a permit, and dropping the permit releases it.
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
        // Sending fails only if there is no receiver, and `self` has one.
        let _ = self.acquired.send(());
        Permit(self.released.clone())
    }
}

impl Drop for Permit {
    fn drop(&mut self) {
        let _ = self.0.try_recv();
    }
}
