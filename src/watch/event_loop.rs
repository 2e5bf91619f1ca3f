//! The event loop: passes events to the core, carries out its effects, and sends heartbeats. It never waits
//! for a file system; other threads do.

use std::collections::HashMap;
use std::sync::{Arc, Weak};
use std::time::{Duration, Instant};

use crossbeam::channel::{Receiver, Sender, never, select, unbounded};

use crate::pipeline::resident_memory_bytes;

use super::api::{DaemonRequest, EndReason, Notice, WatchSummary};
use super::config::WatchConfig;
use super::core::events::{Effect, Event, Start};
use super::core::state::Core;
use super::io::error::DaemonError;
use super::io::pipeline::{PipelineContext, start as start_pipeline};
use super::io::start::{Workers, now, start};
use super::journal::DaemonState;
use super::status_store::StatusStore;

/// Watches and converts until a command stops it or, with `once`, until all frames are converted. Publishes
/// its state to the `store`, if given.
///
/// # Errors
/// When it cannot start. Failures of single frames are not errors: they are logged, recorded in the journal,
/// and counted.
pub fn run(
    config: &WatchConfig,
    store: Option<&Arc<StatusStore>>,
    commands: &Receiver<DaemonRequest>,
    notices: &mut dyn FnMut(Notice),
) -> Result<WatchSummary, DaemonError> {
    let config = Arc::new(config.clone());
    let (to_loop, events) = unbounded();
    let (core, workers, context) = start(&config, store.cloned(), &to_loop)?;
    EventLoop::new(core, workers, context, events, notices).run(commands)
}

/// The state of the loop.
struct EventLoop<'a> {
    core: Core,
    workers: Workers,
    context: PipelineContext,
    /// The channel through which each pipeline gets its frames; `None` once the pipeline was asked to end.
    pipelines: HashMap<usize, Option<Sender<Start>>>,
    events: Receiver<Event>,
    notices: &'a mut dyn FnMut(Notice),
    last_status: String,
    last_tick: Option<Instant>,
    /// The number of folders of outputs whose journal and stages are being written for the last time.
    unsynced_count: usize,
    /// Whether that failed for one of them.
    has_unwritten: bool,
}

/// The interval of heartbeats.
const TICK: Duration = Duration::from_secs(1);

/// Maximum number of events in a batch. After each batch, the core decides what follows from it.
const BATCH: usize = 4096;

/// How long shutdown waits for a worker that hangs.
const GRACE: Duration = Duration::from_millis(100);

impl<'a> EventLoop<'a> {
    fn new(
        core: Core,
        workers: Workers,
        context: PipelineContext,
        events: Receiver<Event>,
        notices: &'a mut dyn FnMut(Notice),
    ) -> EventLoop<'a> {
        EventLoop {
            core,
            workers,
            context,
            pipelines: HashMap::new(),
            events,
            notices,
            last_status: String::new(),
            last_tick: None,
            unsynced_count: 0,
            has_unwritten: false,
        }
    }

    /// Runs until a command stops it, or nothing is left to do.
    fn run(mut self, commands: &Receiver<DaemonRequest>) -> Result<WatchSummary, DaemonError> {
        if let Some(store) = &self.context.store {
            store.begin(self.core.plan());
            self.core.counters = store.counters();
        }
        let once = self.context.config.once;
        let mut commands = commands.clone();
        let mut is_ready = false;
        self.core.start();
        loop {
            self.settle_batch()?;
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
                recv(commands) -> command => match command {
                    Ok(DaemonRequest::Finish) => return self.shut_down(EndReason::Finish, &commands),
                    Ok(DaemonRequest::Reload) => return self.shut_down(EndReason::Reload, &commands),
                    Ok(DaemonRequest::ReloadRefused(why)) => self.core.record_refused_reload(why),
                    // All senders are gone: no further commands can arrive.
                    Err(_) => commands = never(),
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
            match &event {
                Event::PipelineEnded { pipeline } => {
                    let is_wanted = self.pipelines.remove(pipeline).flatten().is_some();
                    if is_wanted && !self.core.is_stopping() {
                        let what = "a pipeline ended unexpectedly, which is a bug: restart the daemon, and \
                                    report the bug with the log";
                        return Err(DaemonError::Threads(what.to_owned()));
                    }
                }
                Event::OutputSynced(is_written) => {
                    self.unsynced_count = self.unsynced_count.saturating_sub(1);
                    self.has_unwritten |= !is_written;
                }
                _ if self.core.is_stopping() && !is_of_frames(&event) => continue,
                _ => {}
            }
            self.core.handle(event, now());
        }
        Ok(())
    }

    /// Decides what follows from several events together, publishes it, and carries out the effects.
    fn settle_batch(&mut self) -> Result<(), DaemonError> {
        self.core.settle_batch(now());
        self.carry_out()
    }

    fn carry_out(&mut self) -> Result<(), DaemonError> {
        self.core.publish(self.context.store.as_deref());
        // Workers live as long as the loop, so a failed send means that the loop is ending.
        for effect in self.core.take_effects() {
            match effect {
                Effect::Root(root, request) => drop(self.workers.roots[root].send(request)),
                Effect::Slow(root, request) => drop(self.workers.slow[root].send(request)),
                Effect::Output(output, request) => drop(self.workers.outputs[output].send(request)),
                Effect::Start(pipeline, start) => {
                    if let Some(Some(sender)) = self.pipelines.get(&pipeline) {
                        let _ = sender.try_send(start);
                    }
                }
                Effect::StartPipeline(pipeline) => {
                    let sender = start_pipeline(pipeline, self.context.clone());
                    let sender = sender.map_err(|error| DaemonError::Threads(error.to_string()))?;
                    self.pipelines.insert(pipeline, Some(sender));
                }
                Effect::EndPipeline(pipeline) => {
                    if let Some(sender) = self.pipelines.get_mut(&pipeline) {
                        *sender = None;
                    }
                }
                Effect::Log(log) => log.write(),
            }
        }
        Ok(())
    }

    /// The time until the next action is due.
    fn wait(&self) -> Duration {
        let now = Instant::now();
        let until_tick = self.last_tick.map_or(Duration::ZERO, |at| TICK.saturating_sub(now - at));
        let deadline = self.core.next_deadline();
        deadline.map_or(until_tick, |at| at.saturating_duration_since(now).min(until_tick))
    }

    /// Sends a heartbeat, and reports the status once a second.
    fn tick(&mut self) {
        if self.last_tick.is_some_and(|at| at.elapsed() < TICK) {
            return;
        }
        self.last_tick = Some(Instant::now());
        (self.notices)(Notice::Alive);
        let now = now();
        for event in self.workers.monitors.iter_mut().filter_map(|monitor| monitor.check(now.at)) {
            self.core.handle(event, now);
        }
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

    /// Finishes the frames in progress. A reload may be upgraded to a stop while this runs.
    fn shut_down(
        mut self,
        mut reason: EndReason,
        commands: &Receiver<DaemonRequest>,
    ) -> Result<WatchSummary, DaemonError> {
        let stop_deadline = self.context.config.stop_deadline;
        let mut commands = commands.clone();
        (self.notices)(Notice::Stopping);
        self.core.stop();
        let mut overdue_at = Some(Instant::now() + stop_deadline);
        self.last_tick = None;
        loop {
            self.settle_batch()?;
            // A pipeline that still hangs after the deadline is abandoned.
            let is_abandoned = overdue_at.is_none() && !self.core.has_frames_in_progress(false);
            if self.pipelines.is_empty() || is_abandoned {
                break;
            }
            self.tick();
            let until_overdue = overdue_at.map(|at| at.saturating_duration_since(Instant::now()));
            select! {
                recv(self.events) -> event => self.take_batch(event.ok())?,
                recv(commands) -> another => match another {
                    Ok(DaemonRequest::Finish) if reason == EndReason::Reload => {
                        reason = EndReason::Finish;
                        (self.notices)(Notice::Stopping);
                        overdue_at = Some(Instant::now() + stop_deadline);
                    }
                    Ok(_) => {}
                    Err(_) => commands = never(),
                },
                default(until_overdue.map_or(TICK, |wait| wait.min(TICK))) => {}
            }
            if overdue_at.is_some_and(|at| at <= Instant::now()) {
                overdue_at = None;
                let next = match reason {
                    EndReason::Reload => "the reload still waits for those whose file system responds",
                    _ => "exiting without them; the next start converts them",
                };
                tracing::warn!(
                    "frames in progress did not finish within {stop_deadline:?} (--stop-deadline): {next}"
                );
                self.core.record_daemon(DaemonState::Stopped);
                self.sync_outputs()?;
                (self.notices)(Notice::Overdue);
            }
        }
        self.finish(reason)
    }

    /// Records that the daemon has stopped, waits for the journals and stages, and ends the workers.
    fn end(&mut self) -> Result<(), DaemonError> {
        // The last status that the page shows.
        self.core.stop();
        self.last_tick = None;
        self.tick();
        self.core.record_daemon(DaemonState::Stopped);
        self.sync_outputs()
    }

    /// Waits until all journals and stages are on disk, except for folders that hang.
    fn sync_outputs(&mut self) -> Result<(), DaemonError> {
        self.unsynced_count += self.core.sync_outputs();
        self.has_unwritten = false;
        self.carry_out()?;
        let until = Instant::now() + self.context.config.stop_deadline.max(TICK);
        while self.unsynced_count > 0 && Instant::now() < until && !self.core.has_stalled() {
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
        // Wait until the workers' threads end: they hold locks that the next run needs.
        let has_stalled = self.core.has_stalled();
        let wait = if has_stalled { GRACE } else { self.context.config.stop_deadline };
        let EventLoop { workers, context, pipelines, notices, .. } = self;
        let guards = workers.guards.clone();
        drop((workers, context, pipelines));
        let (began, mut alive_at) = (Instant::now(), Instant::now());
        while guards.iter().any(|guard: &Weak<_>| guard.strong_count() > 0) && began.elapsed() < wait {
            if alive_at.elapsed() >= TICK {
                alive_at = Instant::now();
                notices(Notice::Alive);
            }
            std::thread::sleep(Duration::from_millis(1));
        }
        Ok(summary)
    }
}

/// Whether an event still matters once no further frame starts.
fn is_of_frames(event: &Event) -> bool {
    matches!(
        event,
        Event::FrameRequested { .. }
            | Event::FrameReturned { .. }
            | Event::FrameFinished(_)
            | Event::PipelineEnded { .. }
            | Event::OutputDirChecked(_)
            | Event::OutputSynced(_)
            | Event::WorkerStalled(_)
            | Event::WorkerAnswered(_)
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs;
    use std::path::Path;
    use std::thread;

    use crossbeam::channel::bounded;

    use crate::pipeline::{OutputFormat, OutputOptions};
    use crate::surface::options::MethodOptions;
    use crate::watch::config::{Order, Poll, StabilityTimeouts, Watch};
    use crate::watch::core::events::{RootRequest, Worker};
    use crate::watch::io::worker::{Heartbeat, StallMonitor, Work, spawn};

    /// A file system that does not respond while the other end of the channel exists.
    struct Hanging(Receiver<()>);

    impl Work for Hanging {
        type Request = RootRequest;

        fn handle(&mut self, _request: RootRequest, _report: &dyn Fn(Event)) {
            let _ = self.0.recv();
        }

        fn on_time(&mut self, _report: &dyn Fn(Event)) {}

        fn next_time(&self) -> Instant {
            Instant::now() + Duration::from_secs(3600)
        }
    }

    fn watch(folder: &Path, name: &str) -> Watch {
        fs::create_dir(folder.join(name)).expect("made");
        Watch {
            input: folder.join(name),
            pattern: None,
            recursive: false,
            sentinel: None,
            outputs: OutputOptions::new(folder.join("out").join(name), &[OutputFormat::Obj]),
            choices: MethodOptions { spacing: Some(1.0), ..MethodOptions::default() },
            obstacles: Vec::new(),
        }
    }

    fn config(watches: Vec<Watch>) -> WatchConfig {
        WatchConfig {
            watches,
            once: false,
            order: Order::Natural,
            threads: 1,
            in_flight: 2,
            memory_bytes: 1 << 30,
            disk_floor_bytes: 0,
            timeouts: StabilityTimeouts {
                settle: Duration::ZERO,
                unverifiable: Duration::ZERO,
                stalled: Duration::from_secs(60),
            },
            poll: Poll::Every(Duration::from_millis(50)),
            rescan_every: Duration::from_secs(60),
            journal: None,
            stop_deadline: Duration::from_secs(60),
        }
    }

    #[test]
    fn hanging_folder_blocks_neither_the_loop_nor_other_folders() {
        let folder = tempfile::tempdir().expect("a folder");
        let config = Arc::new(config(["hanging", "sound"].map(|name| watch(folder.path(), name)).to_vec()));
        let block = (0..64).map(|i| format!("{},{},{}\n", i % 4, i / 4 % 4, i / 16)).collect::<String>();
        fs::write(folder.path().join("sound/a.1.csv"), format!("x,y,z\n{block}")).expect("written");

        let (to_loop, events) = unbounded();
        let (core, mut workers, context) = start(&config, None, &to_loop).expect("started");
        let (answers, hanging) = bounded(0);
        let heartbeat = Heartbeat::default();
        let started = Instant::now();
        workers.roots[0] =
            spawn("hanging", Hanging(hanging), None, heartbeat.clone(), to_loop).expect("a thread");
        workers.monitors.push(StallMonitor::new(Worker::Root(0), heartbeat, started));

        let (commands, to_obey) = bounded(1);
        let (notice_sender, notices) = unbounded();
        let mut send_notice = move |notice| drop(notice_sender.send(notice));
        let running = thread::spawn(move || {
            EventLoop::new(core, workers, context, events, &mut send_notice).run(&to_obey)
        });
        let out = folder.path().join("out/sound/a.1.obj");
        let mut alive_count = 0;
        while !out.exists() || alive_count < 3 {
            let notice = notices.recv_timeout(Duration::from_secs(60)).expect("a heartbeat");
            alive_count += usize::from(notice == Notice::Alive);
            assert!(alive_count < 60, "the other folder waits");
        }
        commands.send(DaemonRequest::Finish).expect("it listens");
        let summary = running.join().expect("no panic").expect("no error");
        assert_eq!((summary.ended, summary.done_count), (EndReason::Finish, 1));
        drop(answers);
    }
}
