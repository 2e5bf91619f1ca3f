//! Cancels a reconstruction from another thread or a callback, by unwinding.
//!
//! ```text
//!   token.cancel() ──▶ flag ──▶ checkpoint on a thread of the token ──unwinds──▶ catch ──▶ Error::Cancelled
//!                               between two phases, and between two steps of smoothing: on any thread
//! ```
//!
//! [`checkpoint`] runs before every kernel and in the other long loops. On a thread that
//! [belongs to a token](CancelToken::interrupt_this_thread), it unwinds once the token is cancelled; rayon
//! unwinds the other threads of the computation, and [`catch`] ends the unwinding.
//!
//! Alternatively, every loop of every stage could return a `Result`. Unwinding keeps the stages free of
//! results, and costs one load per kernel. rust-analyzer cancels its queries in the same way.

use std::cell::{Cell, RefCell};
use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;

/// Cancels the work of a [`Reconstructor`](crate::Reconstructor) from another thread, a signal
/// handler or the progress callback. Clones of a token cancel the same work. A cancelled token stays
/// cancelled: create a new one for the next frame.
///
/// The reconstruction checks the token as each phase begins, and between steps while it smooths. The parts
/// between these checks are not interrupted, unless the threads that compute
/// [belong to the token](Self::interrupt_this_thread).
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
    /// [`Reconstructor`](crate::Reconstructor) catches that and returns `Error::Cancelled`; other
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
        TOKEN.with(|token| token.replace(Some(self.clone())));
        HAS_TOKEN.set(true);
    }

    /// Unwinds if the token is cancelled.
    pub(crate) fn checkpoint(&self) {
        // A second unwinding would abort the process. Unlike a panic, `resume_unwind` calls no panic hook.
        if self.is_cancelled() && !thread::panicking() {
            resume_unwind(Box::new(Interrupted));
        }
    }
}

thread_local! {
    /// The token that interrupts this thread; `None` on most threads.
    static TOKEN: RefCell<Option<CancelToken>> = const { RefCell::new(None) };
    /// Whether there is a token. Unlike the token, it needs no destructor, so that reading it costs one load.
    static HAS_TOKEN: Cell<bool> = const { Cell::new(false) };
}

/// The payload of the unwinding.
pub(crate) struct Interrupted;

/// Unwinds if this thread belongs to a token that is cancelled.
#[inline]
pub fn checkpoint() {
    if HAS_TOKEN.get() {
        checkpoint_of_token();
    }
}

#[cold]
fn checkpoint_of_token() {
    // A thread that ends may have dropped its token.
    let _ = TOKEN.try_with(|token| token.borrow().as_ref().map(CancelToken::checkpoint));
}

/// Runs a computation that a token may interrupt: the result is then [`Interrupted`]. Panics are passed on.
///
/// Unwind safety: the data that `work` writes to is dropped by the unwinding, or stays valid if a computation
/// ends at any kernel.
pub(crate) fn catch<T, E: From<Interrupted>>(work: impl FnOnce() -> Result<T, E>) -> Result<T, E> {
    catch_unwind(AssertUnwindSafe(work)).unwrap_or_else(|payload| match payload.downcast::<Interrupted>() {
        Ok(interrupted) => Err((*interrupted).into()),
        Err(panic) => resume_unwind(panic),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::error::Error;

    /// Runs a job on a thread that belongs to a token.
    fn with_token<T: Send>(is_cancelled: bool, job: impl FnOnce() -> T + Send) -> T {
        let token = CancelToken(Arc::new(AtomicBool::new(is_cancelled)));
        thread::scope(|scope| {
            let run = || {
                token.interrupt_this_thread();
                job()
            };
            scope.spawn(run).join().expect("no panic")
        })
    }

    #[test]
    fn checkpoint_unwinds_only_if_the_token_of_the_thread_is_cancelled() {
        let count = || Ok((0..10).inspect(|_| checkpoint()).count());
        assert!(matches!(catch(count), Ok(10)));
        assert!(matches!(with_token(false, || catch(count)), Ok(10)));
        assert!(matches!(with_token(true, || catch(count)), Err(Error::Cancelled)));
    }

    #[test]
    fn panic_is_passed_on() {
        let payload =
            catch_unwind(|| catch::<(), Error>(|| resume_unwind(Box::new(5)))).expect_err("a panic");
        assert_eq!(payload.downcast_ref(), Some(&5));
    }

    #[test]
    fn checkpoint_in_a_destructor_does_not_abort_an_unwinding() {
        struct Checks;
        impl Drop for Checks {
            fn drop(&mut self) {
                checkpoint();
            }
        }
        let work = || {
            let _checks = Checks;
            checkpoint();
            Ok(())
        };
        assert!(matches!(with_token(true, || catch(work)), Err(Error::Cancelled)));
    }
}
