//! The event loop: passes events to the core, and carries out its effects. It never waits for a file system; other
//! threads do.

use std::sync::{Arc, Weak};
use std::time::{Duration, Instant};

use crossbeam::channel::{Receiver, Sender, never, select, unbounded};

use crate::pipeline::{DaemonState, resident_memory_bytes};

use super::api::{EndReason, Notice, WatchSummary};
use super::config::WatchConfig;
use super::core::events::{Effect, Event, FrameToConvert};
use super::core::state::Core;
use super::io::error::DaemonError;
use super::io::pipeline::{PipelineContext, start_pipeline};
use super::io::start::{Workers, now, start_workers};
use super::status_store::StatusStore;

/// Watches and converts until the caller asks it to finish or, with `once`, until all frames are converted.
/// A message on the channel `finish` asks it to finish the frames in progress and to exit. Publishes its
/// state to the `store`, if given.
///
/// # Errors
/// When it cannot start. Failures of single frames are not errors: they are logged, recorded, and
/// counted.
pub fn run(
    config: &WatchConfig,
    store: Option<&Arc<StatusStore>>,
    finish: &Receiver<()>,
    notices: &mut dyn FnMut(Notice),
) -> Result<WatchSummary, DaemonError> {
    let config = Arc::new(config.clone());
    let (to_loop, events) = unbounded();
    let (core, workers, context) = start_workers(&config, store.cloned(), &to_loop)?;
    EventLoop::new(core, workers, context, events, notices)?.run(finish)
}

/// The state of the loop.
struct EventLoop<'a> {
    core: Core,
    workers: Workers,
    context: PipelineContext,
    /// The channel through which the pipeline gets its frames; `None` once it was asked to end.
    pipeline: Option<Sender<FrameToConvert>>,
    has_pipeline_ended: bool,
    events: Receiver<Event>,
    notices: &'a mut dyn FnMut(Notice),
    last_status: String,
    last_tick: Option<Instant>,
    /// The number of folders of outputs whose records and stages are being written for the last time.
    unsynced_count: usize,
    /// Whether that failed for one of them.
    has_unwritten: bool,
}

/// How long frames in progress may take to finish after a request to stop.
const STOP_DEADLINE: Duration = Duration::from_secs(30);

/// How often the status is reported.
const TICK: Duration = Duration::from_secs(1);

/// Maximum number of events in a batch, after the first one. After each batch, the core decides what follows from it.
const BATCH: usize = 4096;

impl<'a> EventLoop<'a> {
    fn new(
        core: Core,
        workers: Workers,
        context: PipelineContext,
        events: Receiver<Event>,
        notices: &'a mut dyn FnMut(Notice),
    ) -> Result<EventLoop<'a>, DaemonError> {
        let pipeline = start_pipeline(context.clone());
        Ok(EventLoop {
            core,
            workers,
            context,
            pipeline: Some(pipeline.map_err(DaemonError::Threads)?),
            has_pipeline_ended: false,
            events,
            notices,
            last_status: String::new(),
            last_tick: None,
            unsynced_count: 0,
            has_unwritten: false,
        })
    }

    /// Runs until the caller asks it to finish, or nothing is left to do.
    fn run(mut self, finish: &Receiver<()>) -> Result<WatchSummary, DaemonError> {
        if let Some(store) = &self.context.store {
            store.begin(self.core.plan());
            self.core.counters = store.counters();
        }
        let once = self.context.config.once;
        let mut finish = finish.clone();
        let mut is_ready = false;
        self.core.start();
        loop {
            self.act();
            if once && let Some((root, why)) = self.core.unavailable_root() {
                let folder = self.context.config.watches[root].input.clone();
                self.end()?;
                return Err(DaemonError::Unavailable { folder, why });
            }
            if !is_ready && self.core.is_ready() {
                is_ready = true;
                (self.notices)(Notice::Ready);
                if let Some(store) = &self.context.store {
                    store.set_ready();
                }
            }
            if once && self.core.is_drained() {
                return self.finish(EndReason::Drained);
            }
            select! {
                recv(self.events) -> event => self.take_batch(event.ok())?,
                recv(finish) -> message => match message {
                    Ok(()) => return self.shut_down(),
                    // All senders are gone: no message can arrive.
                    Err(_) => finish = never(),
                },
                default(self.wait()) => {}
            }
            self.tick();
        }
    }

    /// Handles this event and those queued behind it.
    fn take_batch(&mut self, first: Option<Event>) -> Result<(), DaemonError> {
        let rest: Vec<Event> = self.events.try_iter().take(BATCH).collect();
        for event in first.into_iter().chain(rest) {
            match event {
                Event::PipelineEnded if self.core.is_stopping() => self.has_pipeline_ended = true,
                Event::PipelineEnded => return Err(DaemonError::PipelineEnded),
                Event::OutputSynced(is_written) => {
                    self.unsynced_count = self.unsynced_count.saturating_sub(1);
                    self.has_unwritten |= !is_written;
                }
                event if self.core.is_stopping() && !matters_at_the_end(&event) => {}
                event => self.core.handle(event, now()),
            }
        }
        Ok(())
    }

    /// Lets the core follow up the events so far, publishes its state, and carries out the effects.
    fn act(&mut self) {
        self.core.follow_up(now());
        self.carry_out();
    }

    /// Publishes what has changed in the core, and passes each of its effects to the thread that it is for.
    fn carry_out(&mut self) {
        self.core.publish(self.context.store.as_deref());
        // Workers live as long as the loop, so a failed send means that the loop is ending.
        for effect in self.core.take_effects() {
            match effect {
                Effect::Root(root, request) => drop(self.workers.roots[root].send(request)),
                Effect::Slow(request) => drop(self.workers.slow.send(request)),
                Effect::Output(output, request) => drop(self.workers.outputs[output].send(request)),
                Effect::Convert(frame) => {
                    if let Some(pipeline) = &self.pipeline {
                        let _ = pipeline.try_send(frame);
                    }
                }
                Effect::Log(log) => log.write(),
            }
        }
    }

    /// The time until the next action is due.
    fn wait(&self) -> Duration {
        let now = Instant::now();
        let until_tick = self.last_tick.map_or(Duration::ZERO, |at| TICK.saturating_sub(now - at));
        let deadline = self.core.next_deadline();
        deadline.map_or(until_tick, |at| at.saturating_duration_since(now).min(until_tick))
    }

    /// Reports the status once a second.
    fn tick(&mut self) {
        if self.last_tick.is_some_and(|at| at.elapsed() < TICK) {
            return;
        }
        self.last_tick = Some(Instant::now());
        if let Some(store) = &self.context.store {
            store.set_status(self.core.status(resident_memory_bytes()));
        }
        let status = self.core.status_line();
        if status != self.last_status && !self.core.is_stopping() {
            (self.notices)(Notice::Status(status.clone()));
            self.last_status = status;
        }
        self.core.record_pause();
    }

    /// Finishes the frames in progress.
    fn shut_down(mut self) -> Result<WatchSummary, DaemonError> {
        (self.notices)(Notice::Stopping);
        self.core.stop();
        self.pipeline = None;
        self.last_tick = None;
        let mut overdue_at = Some(Instant::now() + STOP_DEADLINE);
        while !self.has_pipeline_ended {
            self.act();
            self.tick();
            let wait = overdue_at.map_or(TICK, |at| at.saturating_duration_since(Instant::now()).min(TICK));
            let event = self.events.recv_timeout(wait);
            self.take_batch(event.ok())?;
            if overdue_at.is_some_and(|at| at <= Instant::now()) {
                overdue_at = None;
                tracing::warn!(
                    "frames in progress did not finish within {STOP_DEADLINE:?}: exiting without them; the \
                     next start converts them"
                );
                self.core.record_daemon(DaemonState::Stopped);
                self.sync_outputs()?;
                (self.notices)(Notice::Overdue);
            }
        }
        self.act();
        self.finish(EndReason::Finish)
    }

    /// Records that the daemon has stopped, waits for the records and stages, and ends the workers.
    fn end(&mut self) -> Result<(), DaemonError> {
        // The last status that the page shows.
        self.core.stop();
        self.last_tick = None;
        self.tick();
        self.core.record_daemon(DaemonState::Stopped);
        self.sync_outputs()
    }

    /// Waits until all records and stages are on disk.
    fn sync_outputs(&mut self) -> Result<(), DaemonError> {
        self.unsynced_count += self.core.sync_outputs();
        self.has_unwritten = false;
        self.carry_out();
        let until = Instant::now() + STOP_DEADLINE;
        while self.unsynced_count > 0 && Instant::now() < until {
            let event = self.events.recv_timeout(self.wait().max(Duration::from_millis(1)));
            self.take_batch(event.ok())?;
            self.tick();
        }
        Ok(())
    }

    fn finish(mut self, ended: EndReason) -> Result<WatchSummary, DaemonError> {
        self.end()?;
        let has_unwritten = self.has_unwritten || self.unsynced_count > 0;
        let summary = WatchSummary { has_unwritten, ..self.core.summary(ended) };
        // Wait until the workers' threads end: they hold locks that the next run of a caller needs.
        let EventLoop { workers, context, pipeline, .. } = self;
        let guards = workers.guards.clone();
        drop((workers, context, pipeline));
        let until = Instant::now() + STOP_DEADLINE;
        while guards.iter().any(|guard: &Weak<_>| guard.strong_count() > 0) && Instant::now() < until {
            std::thread::sleep(Duration::from_millis(1));
        }
        Ok(summary)
    }
}

/// Whether an event still matters once no further frame starts.
fn matters_at_the_end(event: &Event) -> bool {
    matches!(event, Event::FrameFinished(_) | Event::OutputFolderChecked(_))
}
