//! A thread that does I/O for the core: requests in, events out. If its file system hangs, this thread hangs,
//! and the event loop reports it.
//!
//! ```text
//!   core ──requests──▶ ┌────────┐ ──events──▶ core
//!   system ──changes─▶ │ worker │
//!   time ────────────▶ └────────┘ ─heartbeat▶ the event loop sees whether it is stuck
//! ```

use std::collections::HashSet;
use std::io;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use crossbeam::channel::{Receiver, Sender, never, select, unbounded};

use crate::watch::core::events::{Event, Worker};
use crate::watch::core::state::STALL_AFTER;

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

/// Shows other threads whether a worker makes progress.
#[derive(Clone, Debug, Default)]
pub(crate) struct Heartbeat(Arc<HeartbeatState>);

#[derive(Debug, Default)]
struct HeartbeatState {
    is_busy: AtomicBool,
    beat_count: AtomicU64,
}

impl Heartbeat {
    /// Records that the worker has made progress.
    pub(crate) fn beat(&self) {
        self.0.beat_count.fetch_add(1, Ordering::Relaxed);
    }

    fn set_busy(&self, is_busy: bool) {
        self.beat();
        self.0.is_busy.store(is_busy, Ordering::Relaxed);
    }
}

/// Detects whether a worker is stuck.
#[derive(Debug)]
pub(crate) struct StallMonitor {
    worker: Worker,
    heartbeat: Heartbeat,
    beat_count: u64,
    since: Instant,
    has_stalled: bool,
}

impl StallMonitor {
    pub(crate) fn new(worker: Worker, heartbeat: Heartbeat, now: Instant) -> StallMonitor {
        StallMonitor { worker, heartbeat, beat_count: 0, since: now, has_stalled: false }
    }

    /// Returns an event when the worker has just stalled, and when a stalled worker responds again; otherwise
    /// `None`.
    pub(crate) fn check(&mut self, now: Instant) -> Option<Event> {
        let HeartbeatState { is_busy, beat_count } = &*self.heartbeat.0;
        let (is_busy, beat_count) = (is_busy.load(Ordering::Relaxed), beat_count.load(Ordering::Relaxed));
        if beat_count != self.beat_count || !is_busy {
            (self.beat_count, self.since) = (beat_count, now);
        }
        let has_stalled = now.saturating_duration_since(self.since) >= STALL_AFTER;
        if std::mem::replace(&mut self.has_stalled, has_stalled) == has_stalled {
            return None;
        }
        let event = if has_stalled { Event::WorkerStalled } else { Event::WorkerAnswered };
        Some(event(self.worker))
    }
}

/// After the first file-system event, up to this many more are handled in the same turn. Of equal events only
/// the last is handled: whether a file was written after it was closed depends on their order.
const FS_EVENTS_PER_TURN: usize = 4096;

/// Starts a worker. It ends when the returned sender is dropped. If it hangs at that time, it ends as soon as
/// its file system responds.
///
/// # Errors
/// When the system refuses to start a thread.
pub(crate) fn spawn<W: Work + 'static>(
    name: &str,
    mut work: W,
    fs_events: Option<Receiver<FsEvent>>,
    heartbeat: Heartbeat,
    events: Sender<Event>,
) -> io::Result<Sender<W::Request>> {
    let (sender, requests) = unbounded::<W::Request>();
    let run = move || {
        // Fails only if the daemon has already ended.
        let report = |event| drop(events.send(event));
        let mut fs_events = fs_events.unwrap_or_else(never);
        loop {
            let wait = work.next_time().saturating_duration_since(Instant::now()).min(IDLE_MAX);
            heartbeat.set_busy(false);
            select! {
                recv(requests) -> request => match request {
                    Ok(request) => {
                        heartbeat.set_busy(true);
                        work.handle(request, &report);
                    }
                    Err(_) => return,
                },
                recv(fs_events) -> event => match event {
                    Ok(first) => {
                        heartbeat.set_busy(true);
                        let mut turn = vec![first];
                        turn.extend(fs_events.try_iter().take(FS_EVENTS_PER_TURN));
                        for event in last_of_equals(turn) {
                            heartbeat.beat();
                            work.on_fs_event(event, &report);
                        }
                    }
                    // The source of events has ended: scans find the changes without it.
                    Err(_) => fs_events = never(),
                },
                default(wait) => {}
            }
            if work.next_time() <= Instant::now() {
                heartbeat.set_busy(true);
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
