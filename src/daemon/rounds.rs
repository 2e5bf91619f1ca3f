//! The loop: waits for whatever comes first, does what it calls for, and tells how things stand.

use std::collections::{HashMap, HashSet};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};

use crossbeam::channel::{Receiver, Sender, never, select};

use crate::pipeline::{Frame, Outcome, OutputOptions, natural_order};

use super::config::{Config, Watch};
use super::frames::{FrameId, FrameState, Frames, Phase, Tally};
use super::journal::{DaemonRecord, DaemonState, Journal, Standing};
use super::lock::host_name;
use super::outcomes::now_ms;
use super::queue::Queue;
use super::rescans::RescanPace;
use super::room::Room;
use super::root::Root;
use super::scan::{Seen, look};
use super::sequences::{MeasureOrder, Measured, Sequences};
use super::stores::{Listings, Presence, Stores};
use super::watcher::{Hint, Watcher};
use super::{Command, DaemonError, Ended, Notice, Summary};

/// Everything that the loop knows.
pub(super) struct Daemon<'a> {
    pub(super) config: &'a Config,
    pub(super) queue: &'a Queue,
    pub(super) to_measure: Sender<MeasureOrder>,
    pub(super) roots: Vec<Root<'a>>,
    pub(super) stores: Stores,
    pub(super) frames: Frames,
    pub(super) sequences: Sequences,
    /// Sequences that may have become measurable.
    pub(super) dirty_sequences: HashSet<usize>,
    pub(super) measuring_count: usize,
    /// Which input the outputs of this stem belong to.
    pub(super) claims: HashMap<PathBuf, FrameId>,
    /// The options of each mirrored sub-folder.
    pub(super) outputs_of: HashMap<(usize, PathBuf), Arc<OutputOptions>>,
    pub(super) listings: Listings,
    pub(super) room: Room,
    /// No folder of outputs is unmounted: what is not in them is missing.
    pub(super) outputs_are_there: bool,
    pub(super) scan_count: u64,
    pub(super) converted_count: usize,
    /// Why frames failed.
    pub(super) failed: HashMap<FrameId, String>,
    watcher: Option<Watcher>,
    hints: Receiver<Hint>,
    rescans: RescanPace,
    told: Told,
    started_ms: u64,
}

/// What was told last.
#[derive(Debug)]
struct Told {
    status: String,
    state: DaemonState,
    at: Option<Instant>,
}

/// The loop turns at least so often: whoever watches it knows that it is not stuck.
const TURN_MAX: Duration = Duration::from_secs(1);

/// So many hints are taken in one turn: equal ones are looked at once.
const HINTS_PER_TURN: usize = 4096;

impl<'a> Daemon<'a> {
    pub(super) fn open(
        config: &'a Config,
        queue: &'a Queue,
        to_measure: Sender<MeasureOrder>,
    ) -> Result<Daemon<'a>, DaemonError> {
        let stores = Stores::open(config)?;
        let folders: Vec<PathBuf> = stores.iter().map(|store| store.folder.clone()).collect();
        let new_root = |watch| Root::new(watch, config, folders.clone()).map_err(DaemonError::Pattern);
        let mut roots = config.watches.iter().map(new_root).collect::<Result<Vec<_>, _>>()?;
        // Who converts what is there and ends needs no events.
        let (watcher, hints) = if config.once { (None, never()) } else { start_watcher(&mut roots) };
        Ok(Daemon {
            config,
            queue,
            to_measure,
            roots,
            stores,
            frames: Frames::default(),
            sequences: Sequences::default(),
            dirty_sequences: HashSet::new(),
            measuring_count: 0,
            claims: HashMap::new(),
            outputs_of: HashMap::new(),
            listings: Listings::default(),
            room: Room::new(config.disk_floor_bytes),
            outputs_are_there: true,
            scan_count: 0,
            converted_count: 0,
            failed: HashMap::new(),
            watcher,
            hints,
            rescans: RescanPace::default(),
            told: Told { status: String::new(), state: DaemonState::Running, at: None },
            started_ms: now_ms(),
        })
    }

    /// Turns until a command ends it or nothing is left to do.
    pub(super) fn run(
        &mut self,
        commands: &Receiver<Command>,
        outcomes: &Receiver<(FrameId, Frame, Outcome)>,
        measured: &Receiver<Measured>,
        notices: &mut dyn FnMut(Notice),
    ) -> Result<Summary, DaemonError> {
        self.note_plan();
        self.note_daemon(&DaemonState::Running);
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
        notices(Notice::Ready);
        let mut commands = commands.clone();
        loop {
            self.turn(notices);
            if self.config.once && self.is_drained() {
                return Ok(self.finish(Ended::Drained));
            }
            select! {
                recv(outcomes) -> outcome => if let Ok((id, frame, outcome)) = outcome { self.finished(&id, &frame, outcome) },
                recv(measured) -> measured => if let Ok(measured) = measured { self.measured(measured) },
                recv(self.hints) -> hint => if let Ok(hint) = hint { self.take_hints(hint) },
                recv(commands) -> command => match command {
                    Ok(command) => return Ok(self.wind_up(command, outcomes, notices)),
                    // Whoever could send commands is gone: then there are none.
                    Err(_) => commands = never(),
                },
                default(self.wait()) => {}
            }
        }
    }

    /// What is due, whatever happened.
    fn turn(&mut self, notices: &mut dyn FnMut(Notice)) {
        let now = Instant::now();
        while let Some(id) = self.frames.next_alarm(now) {
            self.wake(&id, now);
        }
        if self.rescans.is_due(now) {
            tracing::info!("events were lost: everything is looked at");
            self.roots.iter_mut().for_each(|root| root.next_scan = now);
        }
        for root in 0..self.roots.len() {
            if self.roots[root].next_scan <= now && !self.config.once {
                self.scan_root(root);
            }
        }
        self.resolve_sequences();
        self.look_for_room(now);
        self.tell(now, notices);
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
    fn look_at(&mut self, id: &FrameId, renamed: bool) {
        match look(&id.path, self.roots[id.root].trust_clock()) {
            Ok(Some(seen)) => self.sight(id, &seen, renamed),
            Ok(None) => self.forget(id),
            Err(error) => tracing::warn!(frame = %id.path.display(), "cannot be looked at: {error}"),
        }
    }

    /// Takes this hint and those that wait behind it.
    fn take_hints(&mut self, first: Hint) {
        let mut seen = HashSet::new();
        let rest: Vec<Hint> = self.hints.try_iter().take(HINTS_PER_TURN).collect();
        for hint in std::iter::once(first).chain(rest) {
            if seen.insert(hint.clone()) {
                self.take_hint(&hint);
            }
        }
    }

    fn take_hint(&mut self, hint: &Hint) {
        match hint {
            Hint::Rescan => self.rescans.ask(Instant::now()),
            Hint::Changed(path) => self.take_file_hint(path, false),
            Hint::Renamed(path) => self.take_file_hint(path, true),
            Hint::Folder(path) => self.take_folder_hint(path),
        }
    }

    fn take_file_hint(&mut self, path: &Path, renamed: bool) {
        for root in 0..self.roots.len() {
            let Root { path: root_path, selection, .. } = &self.roots[root];
            if !path.starts_with(root_path) {
                continue;
            }
            if path == root_path {
                self.scan_root(root);
            } else if selection.takes(root_path, path) {
                self.look_at(&FrameId::new(root, path), renamed);
            } else {
                self.take_sentinel_hint(root, path);
            }
        }
    }

    /// A file that is no frame may be what some frame waits for.
    fn take_sentinel_hint(&mut self, root: usize, path: &Path) {
        if !self.may_be_sentinel(root, path) {
            return;
        }
        let is_waiting = |id: &FrameId, frame: &FrameState| {
            matches!(frame.phase, Phase::Settling(_))
                && id.root == root
                && id.path.parent() == path.parent()
                && self.sentinel_path(id) == path
        };
        let waiting: Vec<FrameId> = self
            .frames
            .iter()
            .filter(|(id, frame)| is_waiting(id, frame))
            .map(|(id, _)| id.clone())
            .collect();
        for id in waiting {
            self.advance(&id);
        }
    }

    fn take_folder_hint(&mut self, folder: &Path) {
        for index in 0..self.roots.len() {
            let root = &mut self.roots[index];
            if root.path.starts_with(folder) {
                root.next_scan = Instant::now();
            } else if folder.starts_with(&root.path) && root.watch.recursive {
                // What was heard before was another folder of that name.
                root.forget_folder(folder, &mut self.watcher);
                match root.hear_and_scan(folder, &mut self.watcher) {
                    Ok(found) => self.sight_all(index, found.files),
                    // Gone, or moved elsewhere: the scan finds out what is left.
                    Err(_) => self.roots[index].next_scan = Instant::now(),
                }
            }
        }
    }

    /// Looks at everything in a root, and forgets what is not there any more.
    fn scan_root(&mut self, index: usize) {
        self.scan_count += 1;
        let found = match self.roots[index].scan(&mut self.watcher) {
            Ok(found) => found,
            Err(why) => return self.lose_root(index, why),
        };
        if self.roots[index].unavailable.take().is_some() {
            tracing::info!(folder = %self.roots[index].path.display(), "is there again");
        }
        for (path, error) in &found.problems {
            tracing::warn!(path = %path.display(), "cannot be looked into: {error}");
        }
        self.sight_all(index, found.files);
        let count = self.scan_count;
        // Nothing is known of what lies where the scan could not look.
        let is_hidden = |id: &FrameId| found.problems.iter().any(|(path, _)| id.path.starts_with(path));
        let is_gone = |id: &FrameId, frame: &FrameState| {
            id.root == index && frame.scan_count != count && !is_hidden(id)
        };
        let gone: Vec<FrameId> =
            self.frames.iter().filter(|(id, frame)| is_gone(id, frame)).map(|(id, _)| id.clone()).collect();
        for id in gone {
            self.forget(&id);
        }
    }

    /// Takes in what a scan found.
    fn sight_all(&mut self, root: usize, mut files: Vec<(PathBuf, Seen)>) {
        let frames = &self.stores.of_watch(root).journal.state().frames;
        let is_done = |path: &Path| frames.get(path).is_some_and(|record| record.standing == Standing::Done);
        // What has its outputs keeps them, whatever else would like to have them.
        files.sort_by_cached_key(|(path, _)| (!is_done(path), path.clone()));
        self.listings.begin();
        for (path, seen) in &files {
            self.sight(&FrameId::new(root, path), seen, false);
        }
        self.listings.end();
    }

    /// A root that is gone, or came up empty: nothing is forgotten, and it is waited for.
    fn lose_root(&mut self, index: usize, why: String) {
        let root = &mut self.roots[index];
        if root.unavailable.as_ref() != Some(&why) {
            tracing::warn!(folder = %root.path.display(), "unavailable: {why}; waiting for it");
            root.unavailable = Some(why);
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
                Presence::There => {}
                Presence::Elsewhere => absent = Some(store.folder.clone()),
                Presence::Removed => match store.make_again() {
                    Ok(()) => {
                        tracing::warn!(folder = %store.folder.display(), "was removed, and is made again");
                    }
                    Err(error) => {
                        tracing::warn!(folder = %store.folder.display(), "was removed: {error}");
                        absent = Some(store.folder.clone());
                    }
                },
            }
        }
        absent
    }

    /// Tells how things stand, where that has changed, and that it is not stuck.
    fn tell(&mut self, now: Instant, notices: &mut dyn FnMut(Notice)) {
        if self.told.at.is_some_and(|at| now.duration_since(at) < TURN_MAX) {
            return;
        }
        self.told.at = Some(now);
        notices(Notice::Alive);
        let status = self.status();
        if status != self.told.status {
            notices(Notice::Status(status.clone()));
            self.told.status = status;
        }
        let state = self.room.shortage().map_or(DaemonState::Running, DaemonState::Paused);
        if state != self.told.state {
            self.note_daemon(&state);
            self.told.state = state;
        }
    }

    fn status(&self) -> String {
        let Tally { settling, held, queued, retrying, done, failed, .. } = self.frames.tally();
        let mut status = format!("{done} done, {queued} queued");
        for (count, what) in [
            (settling, "being written"),
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
        let Tally { settling, stuck, queued, retrying, held, .. } = self.frames.tally();
        if settling - stuck + queued + retrying + self.measuring_count > 0 || !self.dirty_sequences.is_empty()
        {
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
                let sentinel = self.sentinel_path(id);
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

    /// Finishes what is under way.
    fn wind_up(
        &mut self,
        command: Command,
        outcomes: &Receiver<(FrameId, Frame, Outcome)>,
        notices: &mut dyn FnMut(Notice),
    ) -> Summary {
        notices(Notice::Stopping);
        tracing::info!("finishing the frames under way");
        self.queue.close();
        let overdue_at = Instant::now() + self.config.stop_deadline;
        let mut is_overdue = false;
        // The channel closes when the last frame under way is finished.
        loop {
            let until_overdue = overdue_at.saturating_duration_since(Instant::now());
            let wait = if is_overdue { TURN_MAX } else { until_overdue.min(TURN_MAX) };
            match outcomes.recv_timeout(wait) {
                Ok((id, frame, outcome)) => self.finished(&id, &frame, outcome),
                Err(error) if error.is_disconnected() => break,
                Err(_) => {}
            }
            notices(Notice::Alive);
            if !is_overdue && overdue_at <= Instant::now() {
                is_overdue = true;
                tracing::warn!("frames under way are not finished within {:?}", self.config.stop_deadline);
                self.note_daemon(&DaemonState::Stopped);
                notices(Notice::Overdue);
            }
        }
        self.finish(match command {
            Command::Finish => Ended::Finish,
            Command::Reload => Ended::Reload,
        })
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
        let mut failed: Vec<(FrameId, String)> = std::mem::take(&mut self.failed).into_iter().collect();
        failed.sort_by(|(a, _), (b, _)| natural_order(&a.path.to_string_lossy(), &b.path.to_string_lossy()));
        let failed = failed.into_iter().map(|(id, reason)| told_of(&id.path, reason)).collect();
        let left_count = tally.settling + tally.held + tally.queued + tally.retrying;
        Summary { ended, done_count: tally.done, failed, left_count }
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
const TOO_SPARSE: &str = "no frame of its sequence has the 33 distinct particles that it takes to measure \
                          their spacing: give --voxel-size";
