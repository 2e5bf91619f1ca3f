//! Computes without the interpreter's lock (GIL): thread pools, Ctrl-C and progress.
//!
//! ```text
//!   Python's thread   ── releases the lock ── waits ── every 50 ms: signals ── progress: callback ── takes the lock ──▶
//!   pool              ── the method, in a pool of threads that belongs to this call ──▶ done
//! ```

use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, channel};
use std::sync::{Mutex, PoisonError};
use std::time::Duration;

use meniscus::surface::{CancelToken, Phase, Progress};
use pyo3::exceptions::{PyRuntimeError, PyValueError};
use pyo3::prelude::*;
use rayon::{ThreadPool, ThreadPoolBuilder};

use crate::audited::float_mode;

/// Interval between checks for signals. Ctrl-C must take effect within 0.2 s.
const SIGNAL_INTERVAL: Duration = Duration::from_millis(50);

/// Maximum number of idle pools. Programs use few different numbers of threads, and make few calls at once.
const IDLE_POOLS_MAX: usize = 4;

/// A thread pool that computes for one call at a time, so that its token cancels only this call.
struct CallPool {
    /// The process that started the threads: they do not exist in a forked child.
    process: u32,
    /// The number of threads that the caller requested; 0 means one for each core.
    threads: usize,
    token: CancelToken,
    pool: ThreadPool,
}

static IDLE_POOLS: Mutex<Vec<CallPool>> = Mutex::new(Vec::new());

impl CallPool {
    /// An idle pool with this many threads, or a new one.
    ///
    /// # Errors
    /// `ValueError` if the number is not from 1 to 1024; `RuntimeError` if the system refuses threads.
    fn take(threads: Option<usize>) -> PyResult<CallPool> {
        if threads.is_some_and(|threads| !(1..=1024).contains(&threads)) {
            return Err(PyValueError::new_err("threads must be from 1 to 1024"));
        }
        let (threads, process) = (threads.unwrap_or(0), std::process::id());
        let mut idle = IDLE_POOLS.lock().unwrap_or_else(PoisonError::into_inner);
        let matches = |pool: &CallPool| pool.process == process && pool.threads == threads;
        if let Some(index) = idle.iter().position(matches) {
            return Ok(idle.swap_remove(index));
        }
        drop(idle);
        let token = CancelToken::new();
        let of_threads = token.clone();
        let pool = ThreadPoolBuilder::new()
            .num_threads(threads)
            .thread_name(|index| format!("meniscus-{index}"))
            .start_handler(move |_| {
                float_mode::set_default();
                of_threads.interrupt_this_thread();
            })
            .build()
            .map_err(|error| PyRuntimeError::new_err(format!("cannot start threads: {error}")))?;
        Ok(CallPool { process, threads, token, pool })
    }

    /// Keeps the pool for the next call. If its token was cancelled, the pool is dropped instead: a cancelled
    /// token stays cancelled.
    fn put_back(self) {
        if self.token.is_cancelled() {
            return;
        }
        let mut idle = IDLE_POOLS.lock().unwrap_or_else(PoisonError::into_inner);
        idle.push(self);
        if idle.len() > IDLE_POOLS_MAX {
            let oldest = idle.remove(0);
            if oldest.process != std::process::id() {
                // Its threads do not exist in this process. One of them may have held a lock that dropping
                // the pool takes.
                std::mem::forget(oldest);
            }
        }
    }
}

/// Runs `work` in a pool without the interpreter's lock. Ctrl-C interrupts it.
///
/// # Errors
/// `KeyboardInterrupt`, a Python exception of a signal handler, or `RuntimeError` for a panic.
pub(crate) fn run<T: Send>(py: Python<'_>, work: impl FnOnce() -> T + Send) -> PyResult<T> {
    run_with_progress(py, None, None, |_| work())
}

/// Like [`run`], with a number of threads and a progress callback. `work` gets the channel for progress. The
/// caller's thread handles signals and progress: an exception there cancels the token of the pool, and is
/// raised after `work` has ended.
///
/// # Errors
/// Those of [`run`], the exception of the callback, or `ValueError` for the number of threads.
pub(crate) fn run_with_progress<T: Send>(
    py: Python<'_>,
    threads: Option<usize>,
    progress: Option<&Py<PyAny>>,
    work: impl FnOnce(Sender<Progress>) -> T + Send,
) -> PyResult<T> {
    let call = CallPool::take(threads)?;
    let result = py.detach(|| {
        let (send, receive) = channel();
        let mut outcome = None;
        let raised = call.pool.in_place_scope(|scope| {
            let outcome = &mut outcome;
            scope.spawn(move |_| *outcome = Some(catch_unwind(AssertUnwindSafe(|| work(send)))));
            wait(&receive, &call.token, progress)
        });
        match (outcome, raised) {
            (_, Some(error)) => Err(error),
            (Some(Ok(value)), None) => Ok(value),
            (Some(Err(panic)), None) => Err(error_of_panic(panic)),
            (None, None) => Err(PyRuntimeError::new_err("internal error: the work was not done")),
        }
    });
    call.put_back();
    result
}

/// Handles signals and progress until the work drops its sender. After an exception, cancels the token and
/// returns the exception.
fn wait(receive: &Receiver<Progress>, token: &CancelToken, progress: Option<&Py<PyAny>>) -> Option<PyErr> {
    let mut raised = None;
    loop {
        let outcome = match receive.recv_timeout(SIGNAL_INTERVAL) {
            Err(RecvTimeoutError::Disconnected) => return raised,
            // Once the work is cancelled, its progress does not matter.
            _ if raised.is_some() => continue,
            Err(RecvTimeoutError::Timeout) => Python::attach(|py| py.check_signals()),
            Ok(advance) => Python::attach(|py| {
                py.check_signals()?;
                report(py, progress, advance)
            }),
        };
        if let Err(error) = outcome {
            token.cancel();
            raised = Some(error);
        }
    }
}

/// Runs `work`, which cannot be interrupted, without the interpreter's lock. Ctrl-C ends this function at
/// once; `work` then ends in the background, and its result is dropped.
///
/// # Errors
/// Those of [`run`].
pub(crate) fn run_or_abandon<T: Send + 'static>(
    py: Python<'_>,
    work: impl FnOnce() -> T + Send + 'static,
) -> PyResult<T> {
    let call = CallPool::take(None)?;
    let result = py.detach(|| {
        let (send, receive) = channel();
        call.pool.spawn(move || {
            // After Ctrl-C there is no receiver.
            let _ = send.send(catch_unwind(AssertUnwindSafe(work)));
        });
        loop {
            match receive.recv_timeout(SIGNAL_INTERVAL) {
                Ok(outcome) => return outcome.map_err(error_of_panic),
                Err(RecvTimeoutError::Disconnected) => {
                    return Err(PyRuntimeError::new_err("internal error: the work was not done"));
                }
                Err(RecvTimeoutError::Timeout) => {
                    Python::attach(|py| py.check_signals()).inspect_err(|_| call.token.cancel())?;
                }
            }
        }
    });
    call.put_back();
    result
}

/// Calls a Python progress callback, if there is one.
fn report(py: Python<'_>, progress: Option<&Py<PyAny>>, advance: Progress) -> PyResult<()> {
    let Some(progress) = progress else { return Ok(()) };
    progress.call1(py, (phase_name(advance.phase), advance.fraction))?;
    Ok(())
}

fn phase_name(phase: Phase) -> &'static str {
    match phase {
        Phase::Prepare => "prepare",
        Phase::Rasterize => "rasterize",
        Phase::Smooth => "smooth",
        Phase::Contour => "contour",
        Phase::Interpolate => "interpolate",
        _ => "other",
    }
}

/// Converts a panic to an exception: a panic is a bug of this package, not of its caller.
fn error_of_panic(panic: Box<dyn std::any::Any + Send>) -> PyErr {
    let text = panic.downcast_ref::<&str>().map(ToString::to_string);
    match text.or_else(|| panic.downcast_ref::<String>().cloned()) {
        Some(text) => PyRuntimeError::new_err(format!("internal error: {text}")),
        None => resume_unwind(panic),
    }
}
