//! Interrupts the computation of a cancelled frame, on the threads that compute it.
//!
//! A program that wants a frame to stop within milliseconds computes it in a rayon pool whose threads
//! [watch](watch_on_this_thread) a flag. [`checkpoint`] runs before every kernel and in the other long loops.
//! Once the flag is set, the next checkpoint unwinds its thread, rayon unwinds the other threads of the
//! computation, and [`catch`] ends the unwinding.
//!
//! Alternatively, every loop of every stage could return a `Result`. Unwinding keeps the stages free of
//! results, and costs one load per kernel. rust-analyzer cancels its queries in the same way.

use std::cell::RefCell;
use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;

thread_local! {
    /// The flag that interrupts this thread; `None` on most threads.
    static FLAG: RefCell<Option<Arc<AtomicBool>>> = const { RefCell::new(None) };
}

/// The computation was interrupted. Also the payload of the unwinding.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Interrupted;

/// Lets the flag interrupt computations on this thread, for the rest of the thread's life.
pub(super) fn watch_on_this_thread(flag: Arc<AtomicBool>) {
    FLAG.with(|watched| watched.replace(Some(flag)));
}

/// Unwinds if the flag of this thread is set.
#[inline]
pub fn checkpoint() {
    let is_set = |flag: &Arc<AtomicBool>| flag.load(Ordering::Relaxed);
    // A thread that ends may have dropped its flag.
    if FLAG.try_with(|flag| flag.borrow().as_ref().is_some_and(is_set)).unwrap_or(false) {
        interrupt();
    }
}

#[cold]
fn interrupt() {
    // A second unwinding would abort the process. Unlike a panic, `resume_unwind` calls no panic hook.
    if !thread::panicking() {
        resume_unwind(Box::new(Interrupted));
    }
}

/// Runs a computation that may be interrupted. Panics are passed on.
///
/// Unwind safety: the data that `work` writes to is dropped by the unwinding, or stays valid if a computation
/// ends at any kernel.
pub(super) fn catch<T>(work: impl FnOnce() -> T) -> Result<T, Interrupted> {
    catch_unwind(AssertUnwindSafe(work)).map_err(|payload| match payload.downcast::<Interrupted>() {
        Ok(interrupted) => *interrupted,
        Err(panic) => resume_unwind(panic),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Runs a job on a thread that watches this flag.
    fn with_flag<T: Send>(is_set: bool, job: impl FnOnce() -> T + Send) -> T {
        let flag = Arc::new(AtomicBool::new(is_set));
        thread::scope(|scope| {
            let run = || {
                watch_on_this_thread(flag);
                job()
            };
            scope.spawn(run).join().expect("no panic")
        })
    }

    #[test]
    fn checkpoint_unwinds_only_if_the_flag_is_set() {
        let count = || (0..10).inspect(|_| checkpoint()).count();
        assert_eq!(catch(count), Ok(10));
        assert_eq!(with_flag(false, || catch(count)), Ok(10));
        assert_eq!(with_flag(true, || catch(count)), Err(Interrupted));
    }

    #[test]
    fn panic_is_passed_on() {
        let payload = catch_unwind(|| catch(|| resume_unwind(Box::new(5)))).expect_err("a panic");
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
        };
        assert_eq!(with_flag(true, || catch(work)), Err(Interrupted));
    }
}
