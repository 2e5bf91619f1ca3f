//! Cancellation of a reconstruction from another thread or a callback.

use std::io;
use std::ops::ControlFlow;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use glam::DVec3;

use crate::error::Error;
use crate::interrupt;
use crate::particles::{ParticleSource, Positions, Shapes};
use crate::reconstruction::Storage;

/// Cancels the work of a [`Reconstructor`](crate::Reconstructor) from another thread, a signal
/// handler or the progress callback. Clones of a token cancel the same work. A cancelled token stays
/// cancelled: create a new one for the next frame.
///
/// The reconstruction checks the token between batches of particles while it rasterizes, between steps while
/// it smooths, and between making and checking the mesh while it contours. The parts between these checks are
/// not interrupted, unless the threads that compute [belong to the token](Self::interrupt_this_thread).
#[derive(Clone, Debug, Default)]
pub struct CancelToken(Arc<AtomicBool>);

impl CancelToken {
    /// A token that is not cancelled.
    pub fn new() -> CancelToken {
        CancelToken::default()
    }

    /// Cancels all work that holds this token or a clone of it. Returns at once; further calls have no
    /// effect.
    pub fn cancel(&self) {
        self.0.store(true, Ordering::Relaxed);
    }

    /// Whether [`cancel`](Self::cancel) was called.
    pub fn is_cancelled(&self) -> bool {
        self.0.load(Ordering::Relaxed)
    }

    /// Lets the token also interrupt what this thread computes between two checks, within milliseconds, for
    /// the rest of the thread's life. Call it in the start handler of a rayon pool that computes only for
    /// this token.
    ///
    /// Once the token is cancelled, everything that the pool computes for this crate unwinds.
    /// [`Reconstructor`](crate::Reconstructor) catches that and returns [`Error::Cancelled`]; other
    /// functions unwind into their caller, as after a panic.
    ///
    /// ```
    /// use meniscus_surface::{CancelToken, Error, Options, Reconstructor};
    ///
    /// let token = CancelToken::new();
    /// let of_pool = token.clone();
    /// let pool = rayon::ThreadPoolBuilder::new()
    ///     .start_handler(move |_| of_pool.interrupt_this_thread())
    ///     .build()?;
    /// let mut reconstructor = Reconstructor::new(Options { spacing: Some(1.0), ..Options::default() });
    /// assert!(pool.install(|| reconstructor.reconstruct(&[[0.0f32; 3]])).is_ok());
    /// token.cancel();
    /// let cancelled = pool.install(|| reconstructor.reconstruct(&[[0.0f32; 3]]));
    /// assert!(matches!(cancelled, Err(Error::Cancelled)));
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    pub fn interrupt_this_thread(&self) {
        interrupt::watch_on_this_thread(Arc::clone(&self.0));
    }

    /// [`Error::Cancelled`] if the token is cancelled.
    pub(super) fn check(&self) -> Result<(), Error> {
        if self.is_cancelled() { Err(Error::Cancelled) } else { Ok(()) }
    }

    /// Like [`check`](Self::check), for callbacks that return a [`ControlFlow`].
    pub(super) fn flow(&self) -> ControlFlow<Error> {
        self.check().map_or_else(ControlFlow::Break, ControlFlow::Continue)
    }
}

/// A particle source that returns [`Error::Cancelled`] instead of a batch once the token is cancelled.
#[derive(Clone, Debug)]
pub(super) struct CancellableParticles<'a> {
    pub(super) positions: Positions<'a>,
    pub(super) shapes: Shapes,
    pub(super) token: CancelToken,
}

impl ParticleSource for CancellableParticles<'_> {
    type Error = Error;

    fn batch_count(&self) -> usize {
        self.positions.batch_count()
    }

    fn batch(&self, batch: usize) -> Result<Positions<'_>, Error> {
        self.token.check()?;
        let Ok(positions) = self.positions.batch(batch);
        Ok(positions)
    }

    fn batch_len(&self, batch: usize) -> usize {
        self.positions.batch_len(batch)
    }

    fn has_shapes(&self) -> bool {
        !self.shapes.is_uniform()
    }

    fn batch_shapes(&self, batch: usize) -> Shapes {
        self.shapes.slice(self.positions.range_of(batch))
    }

    fn moved_pairs(&self, _batch: usize) -> Result<Vec<[DVec3; 2]>, Error> {
        Ok(Vec::new())
    }
}

/// Storage that fails once the token is cancelled.
pub(super) struct CancellableStorage {
    pub(super) storage: Box<dyn Storage>,
    pub(super) token: CancelToken,
}

impl CancellableStorage {
    fn check(&self) -> io::Result<()> {
        self.token.check().map_err(io::Error::other)
    }
}

impl Storage for CancellableStorage {
    fn read(&self, offset: u64, bytes: &mut [u8]) -> io::Result<()> {
        self.check()?;
        self.storage.read(offset, bytes)
    }

    fn write(&self, offset: u64, bytes: &[u8]) -> io::Result<()> {
        self.check()?;
        self.storage.write(offset, bytes)
    }
}
