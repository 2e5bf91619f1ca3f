//! A thread that does I/O for the core: requests in, events out.
//!
//! ```text
//!   core ──requests──▶ ┌────────┐ ──events──▶ core
//!   system ──changes─▶ │ worker │
//!   time ────────────▶ └────────┘
//! ```

use std::collections::HashSet;
use std::io;
use std::thread;
use std::time::{Duration, Instant};

use crossbeam::channel::{Receiver, Sender, never, select, unbounded};

use crate::watch::core::events::Event;

use super::fs_events::FsEvent;

/// The tasks of a worker. Each may block for as long as the file system does.
pub(crate) trait Work: Send {
    /// A request from the core.
    type Request: Send;

    /// Handles a request.
    fn handle(&mut self, request: Self::Request, report: &dyn Fn(Event));

    /// Inspects a path that the system reports as changed.
    fn on_fs_event(&mut self, _event: FsEvent, _report: &dyn Fn(Event)) {}

    /// Does what is due at this time.
    fn on_time(&mut self, report: &dyn Fn(Event));

    /// When the next action is due.
    fn next_time(&self) -> Instant;
}

/// After the first file-system event, up to this many more are handled in the same turn. Of equal events only
/// the last is handled: whether a file was written after it was closed depends on their order.
const FS_EVENTS_PER_TURN: usize = 4096;

/// Starts a worker. It ends when the returned sender is dropped.
///
/// # Errors
/// When the system refuses to start a thread.
pub(crate) fn spawn<W: Work + 'static>(
    name: &str,
    mut work: W,
    fs_events: Option<Receiver<FsEvent>>,
    events: Sender<Event>,
) -> io::Result<Sender<W::Request>> {
    let (sender, requests) = unbounded::<W::Request>();
    let run = move || {
        // Fails only if the daemon has already ended.
        let report = |event| drop(events.send(event));
        let mut fs_events = fs_events.unwrap_or_else(never);
        loop {
            let wait = work.next_time().saturating_duration_since(Instant::now()).min(IDLE_MAX);
            select! {
                recv(requests) -> request => match request {
                    Ok(request) => work.handle(request, &report),
                    Err(_) => return,
                },
                recv(fs_events) -> event => match event {
                    Ok(first) => {
                        let mut turn = vec![first];
                        turn.extend(fs_events.try_iter().take(FS_EVENTS_PER_TURN));
                        for event in last_of_equals(turn) {
                            work.on_fs_event(event, &report);
                        }
                    }
                    // The source of events has ended: scans find the changes without it.
                    Err(_) => fs_events = never(),
                },
                default(wait) => {}
            }
            if work.next_time() <= Instant::now() {
                work.on_time(&report);
            }
        }
    };
    thread::Builder::new().name(name.to_owned()).spawn(run)?;
    Ok(sender)
}

/// The events in their order, without those that are repeated later.
fn last_of_equals(mut events: Vec<FsEvent>) -> Vec<FsEvent> {
    let mut known = HashSet::new();
    events.reverse();
    events.retain(|event| known.insert(event.clone()));
    events.reverse();
    events
}

/// The longest wait at a time.
const IDLE_MAX: Duration = Duration::from_secs(3600);
