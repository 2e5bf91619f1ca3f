//! The thread of a root for slow requests: measuring sequences, and searching files for steps. The root's
//! other thread keeps scanning meanwhile.

use std::io;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;

use crossbeam::channel::{Sender, unbounded};
use rayon::ThreadPoolBuilder;

use crate::pipeline::{FileStamp, FrameError, Stage, frames_in_unless};
use crate::watch::core::events::{Event, FoundSteps, SlowRequest, StepsOrder};

use super::measure::measure;

/// Starts the thread; it ends when the returned sender is dropped and `is_over` is set.
///
/// # Errors
/// When the system refuses to start a thread.
pub(super) fn spawn(
    name: &str,
    threads: usize,
    is_over: Arc<AtomicBool>,
    events: Sender<Event>,
) -> io::Result<Sender<SlowRequest>> {
    let (sender, requests) = unbounded();
    thread::Builder::new().name(name.to_owned()).spawn(move || {
        for request in requests {
            if is_over.load(Ordering::Relaxed) {
                return;
            }
            let event = match request {
                SlowRequest::FindSteps(order) => Event::StepsFound(find_steps(order, &is_over)),
                // A separate thread pool, so that a hanging file does not block the pipeline's threads.
                SlowRequest::Measure(order) => match ThreadPoolBuilder::new().num_threads(threads).build() {
                    Ok(pool) => Event::Measured(Box::new(pool.install(|| measure(*order)))),
                    Err(_) => Event::Measured(Box::new(measure(*order))),
                },
            };
            // Fails only if the daemon has already ended.
            let _ = events.send(event);
        }
    })?;
    Ok(sender)
}

/// Searches a file for steps; stops early once the daemon is ending.
fn find_steps(order: StepsOrder, is_over: &AtomicBool) -> FoundSteps {
    let path = &order.id.path;
    let is_same = || FileStamp::of_path(path).is_ok_and(|now| now == order.stamp);
    // The request may have waited behind other files.
    if !is_same() {
        return FoundSteps { order, frames: Ok(None) };
    }
    let read = FrameError::catch(path, Stage::Read, || frames_in_unless(path, is_over));
    let read = read.and_then(|read| read.map_err(|error| FrameError::file(path, Stage::Read, error)));
    let frames = if is_same() { read.map(Some) } else { Ok(None) };
    FoundSteps { order, frames }
}
