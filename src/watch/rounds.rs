//! The loop: waits for whatever comes first, does what it calls for, and tells how things stand.

use std::collections::{HashMap, HashSet};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};

use crossbeam::channel::{Receiver, Sender, never, select};

use crate::pipeline::{
    Frame, ObstacleFiles, Outcome, OutputOptions, OutputStates, breaks_guarantee, natural_order,
    remove_left_behind,
};
use crate::watch::board::Board;

use super::config::{Config, Watch};
use super::evidence::path_of_sentinel;
use super::frames::{FrameId, FrameState, Frames, Phase, Tally};
use super::journal::{DaemonRecord, DaemonState, Journal, now_ms};
use super::lock::host_name;
use super::queue::Queue;
use super::rescans::RescanPace;
use super::room::Room;
use super::root::Root;
use super::scan::look;
use super::sequences::{MeasureOrder, Measured, Sequences, obstacle_files};
use super::showing::count;
use super::steps::{FileSteps, FoundSteps, StepsOrder};
use super::stores::{Listings, Presence, Stores};
use super::watcher::{Hint, Watcher};
use super::{Command, DaemonError, Ended, FailedFrame, Notice, Summary};

/// Everything that the loop knows.
pub(super) struct Daemon<'a> {
    pub(super) config: &'a Config,
    /// Where it shows what there is to see.
    pub(super) board: Option<&'a Board>,
    pub(super) queue: &'a Queue,
    /// The recorded states of the outputs of queued frames, shared with the pipeline.
    pub(super) output_states: &'a OutputStates,
    pub(super) to_measure: Sender<MeasureOrder>,
    pub(super) to_find_steps: Sender<StepsOrder>,
    pub(super) roots: Vec<Root<'a>>,
    pub(super) stores: Stores,
    pub(super) frames: Frames,
    /// The steps of each file that has several.
    pub(super) steps_of: HashMap<FrameId, FileSteps>,
    pub(super) sequences: Sequences,
    /// Sequences that may have become measurable.
    pub(super) dirty_sequences: HashSet<usize>,
    pub(super) measuring_count: usize,
    /// Which input the outputs of this stem belong to.
    pub(super) claims: HashMap<PathBuf, FrameId>,
    /// The options of each mirrored sub-folder.
    pub(super) outputs_of: HashMap<(usize, PathBuf), Arc<OutputOptions>>,
    /// What stands in the way of the frames of each root.
    pub(super) obstacles: Vec<Arc<ObstacleFiles>>,
    pub(super) listings: Listings,
    pub(super) room: Room,
    /// No folder of outputs is unmounted: what is not in them is missing.
    pub(super) outputs_are_there: bool,
    pub(super) scan_count: u64,
    /// Frames that failed.
    pub(super) failed: HashMap<FrameId, Failure>,
    /// How many frames the pipeline has finished with.
    pub(super) finished_count: usize,
    /// Of these, those that other files kept from being converted.
    pub(super) refused: HashSet<FrameId>,
    pub(super) watcher: Option<Watcher>,
    pub(super) hints: Receiver<Hint>,
    pub(super) rescans: RescanPace,
    notices: &'a mut dyn FnMut(Notice),
    told: Told,
    started_ms: u64,
}

/// Why a frame failed.
#[derive(Debug)]
pub(super) struct Failure {
    pub(super) reason: String,
    /// How many frames were finished when it was told; `None` if it was not, in this run.
    pub(super) told_at: Option<usize>,
}

/// What was told last.
#[derive(Debug)]
struct Told {
    status: String,
    state: DaemonState,
    at: Option<Instant>,
    pulse_at: Option<Instant>,
}

/// The loop turns at least so often: whoever watches it knows that it is not stuck.
const TURN_MAX: Duration = Duration::from_secs(1);

impl<'a> Daemon<'a> {
    pub(super) fn open(
        config: &'a Config,
        board: Option<&'a Board>,
        (queue, output_states): (&'a Queue, &'a OutputStates),
        (to_measure, to_find_steps): (Sender<MeasureOrder>, Sender<StepsOrder>),
        notices: &'a mut dyn FnMut(Notice),
    ) -> Result<Daemon<'a>, DaemonError> {
        let stores = Stores::open(config)?;
        let folders: Vec<PathBuf> = stores.iter().map(|store| store.folder.clone()).collect();
        let new_root = |watch| Root::new(watch, config, folders.clone()).map_err(DaemonError::Pattern);
        let mut roots = config.watches.iter().map(new_root).collect::<Result<Vec<_>, _>>()?;
        // Who converts what is there and ends needs no events.
        let (watcher, hints) = if config.once { (None, never()) } else { start_watcher(&mut roots) };
        Ok(Daemon {
            config,
            board,
            queue,
            output_states,
            to_measure,
            to_find_steps,
            roots,
            stores,
            frames: Frames::default(),
            steps_of: HashMap::new(),
            sequences: Sequences::default(),
            dirty_sequences: HashSet::new(),
            measuring_count: 0,
            claims: HashMap::new(),
            outputs_of: HashMap::new(),
            obstacles: config.watches.iter().map(|watch| obstacle_files(watch).into()).collect(),
            listings: Listings::default(),
            room: Room::new(config.disk_floor_bytes),
            outputs_are_there: true,
            scan_count: 0,
            failed: HashMap::new(),
            finished_count: 0,
            refused: HashSet::new(),
            watcher,
            hints,
            rescans: RescanPace::default(),
            notices,
            told: Told { status: String::new(), state: DaemonState::Running, at: None, pulse_at: None },
            started_ms: now_ms(),
        })
    }

    /// Turns until a command ends it or nothing is left to do.
    pub(super) fn run(
        &mut self,
        commands: &Receiver<Command>,
        outcomes: &Receiver<(FrameId, Frame, Outcome)>,
        measured: &Receiver<Measured>,
        found_steps: &Receiver<FoundSteps>,
    ) -> Result<Summary, DaemonError> {
        self.note_plan();
        self.show_plan();
        self.note_daemon(&DaemonState::Running);
        self.tell_roots();
        // Before anything is queued: no frame begins below the floor.
        self.look_for_room(Instant::now());
        for root in 0..self.roots.len() {
            self.scan_root(root);
        }
        if self.config.once
            && let Some(root) = self.roots.iter().find(|root| root.unavailable.is_some())
        {
            let why = root.unavailable.clone().unwrap_or_default();
            let folder = root.watch.input.clone();
            self.note_daemon(&DaemonState::Stopped);
            return Err(DaemonError::Unavailable { folder, why });
        }
        (self.notices)(Notice::Ready);
        if let Some(board) = self.board {
            board.set_ready();
        }
        let mut commands = commands.clone();
        loop {
            self.turn();
            if self.config.once && self.is_drained() {
                return Ok(self.finish(Ended::Drained));
            }
            select! {
                recv(outcomes) -> outcome => match outcome {
                    Ok((id, frame, outcome)) => self.finished(&id, &frame, outcome),
                    Err(_) => return Err(DaemonError::Threads("the pipeline has ended".to_owned())),
                },
                recv(measured) -> measured => match measured {
                    Ok(measured) => self.measured(measured),
                    Err(_) => return Err(DaemonError::Threads("measuring has ended".to_owned())),
                },
                recv(found_steps) -> found => match found {
                    Ok(found) => self.found_steps(found),
                    Err(_) => return Err(DaemonError::Threads("looking for steps has ended".to_owned())),
                },
                recv(self.hints) -> hint => match hint {
                    Ok(hint) => self.take_hints(hint),
                    // Scans will do.
                    Err(_) => self.hints = never(),
                },
                recv(commands) -> command => match command {
                    Ok(command) => return Ok(self.wind_up(command, &commands, outcomes)),
                    // Whoever could send commands is gone: then there are none.
                    Err(_) => commands = never(),
                },
                default(self.wait()) => {}
            }
        }
    }

    /// What is due, whatever happened.
    fn turn(&mut self) {
        let now = Instant::now();
        // First: what is not in a folder that is not there is not missing.
        self.look_for_room(now);
        while let Some(id) = self.frames.next_alarm(now) {
            self.wake(&id, now);
        }
        if self.rescans.is_due(now) {
            tracing::info!("events were lost: everything is looked at");
            count(self.board, |counters| counters.rescans += 1);
            self.roots.iter_mut().for_each(Root::hear_again);
        }
        for root in 0..self.roots.len() {
            if !self.config.once && (self.roots[root].next_scan <= now || self.is_another_root(root, now)) {
                self.scan_root(root);
            }
        }
        self.resolve_sequences();
        self.tell(now);
    }

    /// Whether a root leads to another folder now: one call of the system, at most once a second.
    fn is_another_root(&mut self, index: usize, now: Instant) -> bool {
        let root = &mut self.roots[index];
        if root.looked_at.is_some_and(|at| now.duration_since(at) < TURN_MAX) {
            return false;
        }
        root.looked_at = Some(now);
        root.is_another()
    }

    /// How long there is nothing to do.
    fn wait(&self) -> Duration {
        let now = Instant::now();
        let scans = self.roots.iter().map(|root| root.next_scan).filter(|_| !self.config.once);
        let next = scans.chain(self.frames.alarm_at()).chain(self.rescans.due_at).min();
        next.map_or(TURN_MAX, |at| at.saturating_duration_since(now).min(TURN_MAX))
    }

    /// A frame asked to be looked at now.
    fn wake(&mut self, id: &FrameId, now: Instant) {
        match self.frames.get(id).map(|frame| &frame.phase) {
            Some(Phase::Settling(_)) => self.look_at(id, false),
            Some(Phase::Retrying(..)) => self.retry(id, now),
            _ => {}
        }
    }

    /// Looks at one file.
    pub(super) fn look_at(&mut self, id: &FrameId, renamed: bool) {
        match look(&id.path, self.roots[id.root].trust_clock()) {
            Ok(Some(seen)) => self.sight(id, &seen, renamed),
            Ok(None) => self.forget(id),
            Err(error) => self.cannot_look(id, error),
        }
    }

    /// Pauses while there is no room for outputs, and goes on when there is.
    fn look_for_room(&mut self, now: Instant) {
        let was_short = self.room.shortage().is_some();
        let absent = self.look_for_outputs();
        self.outputs_are_there = absent.is_none();
        self.room.check(self.stores.iter().map(|store| &*store.folder), absent, now);
        let shortage = self.room.shortage();
        self.queue.pause(shortage.is_some());
        match shortage {
            Some(why) if !was_short => tracing::warn!("paused: {why}"),
            None if was_short => tracing::info!("there is room again: going on"),
            _ => {}
        }
    }

    /// A folder of outputs that is not there, and is waited for. One that was removed is made again.
    fn look_for_outputs(&mut self) -> Option<PathBuf> {
        let mut absent = None;
        for store in self.stores.iter_mut() {
            match store.presence() {
                Presence::There => continue,
                Presence::Elsewhere => absent = Some(store.folder.clone()),
                Presence::Removed => match store.make_again() {
                    Ok(()) => {
                        tracing::warn!(folder = %store.folder.display(), "was gone, and is taken again");
                        // What was in it may be gone as well.
                        self.roots.iter_mut().for_each(|root| root.next_scan = Instant::now());
                    }
                    // Told once, as why nothing is begun.
                    Err(_) => absent = Some(store.folder.clone()),
                },
            }
            store.set_there(absent.is_none());
        }
        absent
    }

    /// Tells how things stand, where that has changed, and that it is not stuck.
    fn tell(&mut self, now: Instant) {
        if self.told.at.is_some_and(|at| now.duration_since(at) < TURN_MAX) {
            return;
        }
        self.told.at = Some(now);
        (self.notices)(Notice::Alive);
        remove_left_behind();
        self.show_status(false);
        let status = self.status();
        if status != self.told.status {
            (self.notices)(Notice::Status(status.clone()));
            self.told.status = status;
        }
        let state = self.room.shortage().map_or(DaemonState::Running, DaemonState::Paused);
        if state != self.told.state {
            self.note_daemon(&state);
            self.told.state = state;
        }
    }

    fn status(&self) -> String {
        let Tally { settling, held, queued, gone_through, retrying, done, failed, .. } = self.frames.tally();
        let mut status = format!("{done} done, {queued} queued");
        for (count, what) in [
            (settling, "being written"),
            (gone_through, "gone through for steps"),
            (held, "without settings yet"),
            (retrying, "to retry"),
            (failed, "failed"),
        ] {
            if count > 0 {
                status += &format!(", {count} {what}");
            }
        }
        for root in self.roots.iter().filter(|root| root.unavailable.is_some()) {
            status += &format!("; {} is unavailable", root.path.display());
        }
        if let Some(why) = self.room.shortage() {
            status += &format!("; paused: {why}");
        }
        status
    }

    /// Whether nothing is left that can be done. Frames that wait for settings nobody can measure fail for
    /// it; those that wait for a file nobody writes are left, and so is what waits for them.
    fn is_drained(&mut self) -> bool {
        if self.queue.len() > 0 {
            return false;
        }
        let Tally { settling, stuck, queued, gone_through, retrying, held, .. } = self.frames.tally();
        let left_count = settling - stuck + queued + gone_through + retrying + self.measuring_count;
        if left_count > 0 || !self.dirty_sequences.is_empty() {
            return false;
        }
        let stuck = self.tell_of_stuck();
        if held > 0 {
            self.give_up_on_held(&stuck);
        }
        true
    }

    /// Names the frames that are left because their sentinels are missing; the result is their sequences.
    fn tell_of_stuck(&self) -> HashSet<usize> {
        let stuck = self.frames.iter().filter(|(_, frame)| frame.is_stuck());
        stuck
            .map(|(id, frame)| {
                let sentinel = path_of_sentinel(&self.config.watches[id.root], &id.path);
                tracing::warn!(frame = %id.path.display(), "left: there is no newer {}", sentinel.display());
                frame.sequence
            })
            .collect()
    }

    fn give_up_on_held(&mut self, stuck_sequences: &HashSet<usize>) {
        let held = self.frames.iter().filter_map(|(id, frame)| match frame.phase {
            Phase::Held(stamp) if !stuck_sequences.contains(&frame.sequence) => Some((id.clone(), stamp)),
            _ => None,
        });
        for (id, stamp) in held.collect::<Vec<_>>() {
            self.refuse(&id, stamp, TOO_SPARSE.to_owned());
        }
    }

    /// Finishes what is under way. Who is asked to reload may be asked to end meanwhile.
    fn wind_up(
        &mut self,
        command: Command,
        commands: &Receiver<Command>,
        outcomes: &Receiver<(FrameId, Frame, Outcome)>,
    ) -> Summary {
        let (mut command, mut commands) = (command, commands.clone());
        (self.notices)(Notice::Stopping);
        self.queue.close();
        let mut overdue_at = Some(Instant::now() + self.config.stop_deadline);
        self.tell_of_stopping();
        loop {
            let until_overdue = overdue_at.map(|at| at.saturating_duration_since(Instant::now()));
            select! {
                recv(outcomes) -> outcome => match outcome {
                    Ok((id, frame, outcome)) => self.finished(&id, &frame, outcome),
                    // The last frame under way is finished.
                    Err(_) => break,
                },
                recv(commands) -> another => match another {
                    Ok(Command::Finish) if command == Command::Reload => {
                        command = Command::Finish;
                        (self.notices)(Notice::Stopping);
                        overdue_at = Some(Instant::now() + self.config.stop_deadline);
                    }
                    Ok(_) => {}
                    Err(_) => commands = never(),
                },
                default(until_overdue.map_or(TURN_MAX, |wait| wait.min(TURN_MAX))) => {}
            }
            if self.told.at.is_none_or(|at| at.elapsed() >= TURN_MAX) {
                self.tell_of_stopping();
            }
            if overdue_at.is_some_and(|at| at <= Instant::now()) {
                overdue_at = None;
                tracing::warn!("frames under way are not finished within {:?}", self.config.stop_deadline);
                self.note_daemon(&DaemonState::Stopped);
                (self.notices)(Notice::Overdue);
            }
        }
        self.finish(match command {
            Command::Finish => Ended::Finish,
            Command::Reload => Ended::Reload,
        })
    }

    /// Shows that no more is taken, and tells that it is not stuck.
    fn tell_of_stopping(&mut self) {
        self.told.at = Some(Instant::now());
        (self.notices)(Notice::Alive);
        self.show_status(true);
    }

    /// Which folders are watched, how, and into what.
    fn tell_roots(&self) {
        for root in &self.roots {
            tracing::info!(
                folder = %root.path.display(),
                outputs = %root.watch.outputs.folder.display(),
                version = env!("CARGO_PKG_VERSION"),
                "watching"
            );
        }
    }

    /// Tells that it is not stuck, for it is at something that takes long.
    pub(super) fn pulse(&mut self) {
        if self.told.pulse_at.is_none_or(|at| at.elapsed() >= TURN_MAX) {
            self.told.pulse_at = Some(Instant::now());
            (self.notices)(Notice::Alive);
            if let Some(board) = self.board {
                board.pulse();
            }
        }
    }

    /// Writes down what the daemon was asked for, for whoever asks the journal.
    fn note_plan(&mut self) {
        let of_root = |root: &Root| Watch { input: root.path.clone(), ..root.watch.clone() };
        let watches: Vec<Watch> = self.roots.iter().map(of_root).collect();
        self.stores.note_plan(&watches, self.config.patience);
    }

    /// Writes down what the daemon is doing, for whoever asks the journal.
    fn note_daemon(&mut self, state: &DaemonState) {
        let record = DaemonRecord {
            pid: std::process::id(),
            host: host_name(),
            started_ms: self.started_ms,
            state: state.clone(),
            at_ms: now_ms(),
        };
        for store in self.stores.iter_mut() {
            store.write_down(|journal| journal.note_daemon(record.clone()));
        }
    }

    fn finish(&mut self, ended: Ended) -> Summary {
        self.note_daemon(&DaemonState::Stopped);
        for store in self.stores.iter_mut() {
            store.write_down(Journal::sync);
        }
        let tally = self.frames.tally();
        let mut failed: Vec<(FrameId, Failure)> = std::mem::take(&mut self.failed).into_iter().collect();
        failed.sort_by(|(a, _), (b, _)| natural_order(&a.path.to_string_lossy(), &b.path.to_string_lossy()));
        let failed = failed.into_iter().map(|(id, Failure { reason, told_at })| FailedFrame {
            what: told_of(&id.path, reason),
            frames_since: told_at.map(|told_at| self.finished_count - told_at),
        });
        let unreadable = self.roots.iter().flat_map(|root| &root.unreadable);
        let unreadable = unreadable.map(|(path, why)| FailedFrame {
            what: told_of(path, why.clone()),
            frames_since: Some(self.finished_count),
        });
        let failed = failed.chain(unreadable).collect();
        let left_count = tally.settling + tally.held + tally.queued + tally.gone_through + tally.retrying;
        Summary { ended, done_count: tally.done, broken_count: self.broken_count(), failed, left_count }
    }

    /// How many of the frames that are done break a guarantee, as the journal has it.
    fn broken_count(&self) -> usize {
        let is_broken = |(id, frame): &(&FrameId, &FrameState)| {
            let journal = &self.stores.of_watch(id.root).journal;
            let record = journal.state().frames.get(&*id.path);
            matches!(frame.phase, Phase::Done(_))
                && record.is_some_and(|record| record.flaws.iter().any(|flaw| breaks_guarantee(flaw)))
        };
        self.frames.iter().filter(is_broken).count()
    }
}

/// A reason that names the frame it is about.
fn told_of(path: &Path, reason: String) -> String {
    let path = path.display().to_string();
    if reason.contains(&path) { reason } else { format!("{path}: {reason}") }
}

/// The watcher; where the system has none, the folders are looked into by turns.
fn start_watcher(roots: &mut [Root<'_>]) -> (Option<Watcher>, Receiver<Hint>) {
    match Watcher::new() {
        Ok((watcher, hints)) => (Some(watcher), hints),
        Err(error) => {
            roots.iter_mut().for_each(|root| root.poll_instead(&error));
            (None, never())
        }
    }
}

/// Why a frame has no settings when all is said and done; convert says the same.
const TOO_SPARSE: &str = "no frame of its sequence has two particles in different places to measure \
                          their spacing on: give --spacing";
