//! A watched folder: whether it is there, what is in it, and when to scan it again. Runs on a thread of its own, so a
//! file system that hangs holds up its own folder only.
//!
//! Events are hints, scans are truth. A root is scanned at the start, when events were lost, when it
//! comes back, and every so often whatever the system says; on a network file system, which tells nothing,
//! often. A folder that vanishes, or was full and comes up empty, is *unavailable*: a disk that is not
//! mounted is no reason to forget anything.

use std::collections::HashSet;
use std::hash::{BuildHasher, RandomState};
use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};

use crate::pipeline::ObstacleFiles;
use crate::watch::config::{Patience, Poll, Watch, WatchConfig};
use crate::watch::core::completeness::may_be_sentinel;
use crate::watch::core::events::{Event, FoundObstacleStamps, RootRequest, Scan};
use crate::watch::core::frames::FrameId;

use super::fs_events::{FsEvent, WatchError, Watcher};
use super::mounts::network_file_system;
use super::output_dir::OutputGuard;
use super::rescan_backoff::RescanBackoff;
use super::scan::{FolderIdentity, look, scan_with};
use super::selection::FileFilter;
use super::worker::{Pulse, Work};

/// A watched folder.
pub(super) struct Root {
    pub(super) index: usize,
    once: bool,
    patience: Patience,
    pub(super) watch: Watch,
    /// Absolute.
    path: PathBuf,
    selection: FileFilter,
    pub(super) obstacles: Vec<Arc<ObstacleFiles>>,
    pub(super) output: Arc<OutputGuard>,
    watcher: Option<Watcher>,
    rescans: RescanBackoff,
    /// Whether the next scan is made because events were lost.
    is_after_loss: bool,
    /// The network file system that it is on.
    network: Option<&'static str>,
    /// The time between scans that replace events; `None` if events come.
    poll: Option<Duration>,
    rescan_every: Duration,
    /// Folders whose events are heard.
    heard: HashSet<PathBuf>,
    next_scan: Instant,
    /// The time that inspections have taken since the last scan.
    inspected_for: Duration,
    /// When its identity was compared last.
    compared_at: Instant,
    /// It had frames when it was last scanned.
    had_frames: bool,
    /// Which folder it was then: its path may be a link that is pointed elsewhere, or another disk may be mounted there.
    identity: Option<FolderIdentity>,
    pulse: Pulse,
}

/// On network file systems, unless somebody says how often.
const POLL_DEFAULT: Duration = Duration::from_secs(2);

/// What is known of a file on a network may be a few seconds old: NFS asks its server again after three.
const NETWORK_SETTLE_MIN: Duration = Duration::from_secs(4);

/// How often the identity of a root is compared.
const COMPARE_EVERY: Duration = Duration::from_secs(1);

/// How soon a folder that is not there is looked for again.
const UNAVAILABLE_RETRY: Duration = Duration::from_secs(1);

/// Regular scans take at most one part in so many of a core.
const SCAN_SHARE: u32 = 200;

/// The same of scans in place of events, which somebody waits for.
const POLL_SHARE: u32 = 10;

impl Root {
    /// A folder that was not scanned yet. It need not be there. Without a watcher it is scanned every so often.
    pub(super) fn new(
        index: usize,
        (path, selection): (PathBuf, FileFilter),
        config: &WatchConfig,
        obstacles: Vec<Arc<ObstacleFiles>>,
        output: Arc<OutputGuard>,
        watcher: Result<Option<Watcher>, WatchError>,
        pulse: Pulse,
    ) -> Root {
        let poll = match config.poll {
            Poll::Every(interval) => Some(interval),
            Poll::Auto => None,
        };
        let mut root = Root {
            index,
            once: config.once,
            patience: config.patience,
            watch: config.watches[index].clone(),
            path,
            selection,
            obstacles,
            output,
            watcher: None,
            rescans: RescanBackoff::default(),
            is_after_loss: false,
            network: None,
            poll,
            rescan_every: config.rescan_every,
            heard: HashSet::new(),
            // The core asks for the first one.
            next_scan: Instant::now() + NEVER,
            inspected_for: Duration::ZERO,
            compared_at: Instant::now(),
            had_frames: false,
            identity: None,
            pulse,
        };
        match watcher {
            Ok(watcher) => root.watcher = watcher,
            Err(error) => root.poll_instead(&error),
        }
        root
    }

    /// Whether the times of its files can be compared with the clock here.
    pub(super) fn trust_clock(&self) -> bool {
        self.network.is_none()
    }

    /// How long its files must be left alone before they are read.
    pub(super) fn patience(&self) -> Patience {
        let Patience { settle, unproven, stalled } = self.patience;
        match self.network {
            None => self.patience,
            Some(_) => Patience {
                settle: settle.max(NETWORK_SETTLE_MIN),
                unproven: unproven.max(2 * NETWORK_SETTLE_MIN),
                stalled: stalled.max(2 * NETWORK_SETTLE_MIN),
            },
        }
    }

    /// Scans everything, and reports it.
    fn scan_and_report(&mut self, report: &dyn Fn(Event)) {
        let started = Instant::now();
        let after_loss = std::mem::take(&mut self.is_after_loss);
        let found = self.scan().map(|found| Scan { after_loss, ..found });
        if found.is_ok() {
            // What a scan finds is inspected: that is a part of its cost.
            let cost = started.elapsed() + std::mem::take(&mut self.inspected_for);
            self.next_scan = Instant::now() + self.interval(cost);
        }
        report(Event::RootScanned { root: self.index, found, at: Instant::now() });
    }

    fn on_file_event(&mut self, path: &Path, renamed: bool, report: &dyn Fn(Event)) {
        if path == self.path {
            return self.scan_and_report(report);
        }
        if self.selection.takes(&self.path, path) {
            let id = FrameId::new(self.index, path);
            report(match look(path, self.trust_clock()) {
                Ok(Some(seen)) => Event::FileSeen { id, seen, at: Instant::now(), renamed },
                Ok(None) => Event::FileGone(id),
                Err(error) => Event::FileUnreadable(id, error),
            });
        }
        if may_be_sentinel(&self.watch, path) {
            report(Event::SentinelSeen(self.index, path.to_owned()));
        }
    }

    fn on_folder_event(&mut self, folder: &Path, report: &dyn Fn(Event)) {
        if self.path.starts_with(folder) {
            self.next_scan = Instant::now();
        } else if folder.starts_with(&self.path) && self.selection.enters(&self.path, folder) {
            // What was heard before was another folder of that name.
            self.forget_folder(folder);
            match self.hear_and_scan(folder) {
                Ok(Scan { files, .. }) => {
                    report(Event::FolderScanned { root: self.index, files, at: Instant::now() });
                }
                // Gone, or moved elsewhere: the scan finds out what is left.
                Err(_) => self.next_scan = Instant::now(),
            }
        }
    }

    /// Everything in the folder, and from now on its events are heard.
    ///
    /// # Errors
    /// Why the folder is unavailable.
    fn scan(&mut self) -> Result<Scan, String> {
        let identity = FolderIdentity::of(&self.path).ok();
        if self.identity != identity {
            // Events of the folder that was there do not tell of this one, and those of an unmounted one just stop.
            self.stop_hearing();
            self.identity = identity;
        }
        let found = self.hear_and_scan(&self.path.clone());
        let found = found.map_err(|error| error.to_string()).and_then(|found| {
            if self.had_frames && found.files.is_empty() {
                // An empty mount point looks like a folder from which all was deleted; either way
                // there is nothing to do until something comes.
                return Err("it is empty and was not before".to_owned());
            }
            Ok(found)
        });
        match &found {
            Ok(found) => self.had_frames |= !found.files.is_empty(),
            Err(_) => {
                // What was heard was heard of a folder that is gone.
                self.stop_hearing();
                self.next_scan = Instant::now() + UNAVAILABLE_RETRY;
            }
        }
        found
    }

    /// Everything in one folder of it, and from now on its events are heard.
    ///
    /// # Errors
    /// When the folder cannot be read.
    fn hear_and_scan(&mut self, folder: &Path) -> io::Result<Scan> {
        if self.heard.is_empty() {
            self.find_out_how_to_watch(folder)?;
        }
        if self.poll.is_some() {
            return self.scan_folder(folder);
        }
        self.listen(folder);
        loop {
            let found = self.scan_folder(folder)?;
            // What came into a folder before its events were heard is found by the next scan.
            let unheard: Vec<PathBuf> =
                found.folders.iter().filter(|f| !self.heard.contains(*f)).cloned().collect();
            if unheard.is_empty() || self.poll.is_some() || self.watcher.is_none() {
                return Ok(found);
            }
            for folder in &unheard {
                self.listen(folder);
                if self.poll.is_some() {
                    break;
                }
            }
        }
    }

    fn scan_folder(&self, folder: &Path) -> io::Result<Scan> {
        scan_with(folder, &self.path, &self.selection, self.trust_clock(), &|| self.pulse.beat())
    }

    /// The events of a folder that is gone, or is another one now, are not heard any more.
    fn forget_folder(&mut self, folder: &Path) {
        let gone: Vec<PathBuf> =
            self.heard.iter().filter(|heard| heard.starts_with(folder)).cloned().collect();
        for folder in gone {
            self.heard.remove(&folder);
            if let Some(watcher) = &mut self.watcher {
                watcher.unwatch(&folder);
            }
        }
    }

    fn stop_hearing(&mut self) {
        self.forget_folder(&self.path.clone());
    }

    fn find_out_how_to_watch(&mut self, folder: &Path) -> io::Result<()> {
        let network = network_file_system(folder)?;
        if let Some(name) = network
            && self.poll.is_none()
        {
            tracing::info!(
                folder = %self.path.display(),
                "is on {name}, which does not tell of changes: it is looked into every {POLL_DEFAULT:?}"
            );
            self.poll = Some(POLL_DEFAULT);
        }
        self.network = network;
        Ok(())
    }

    fn listen(&mut self, folder: &Path) {
        let Some(watcher) = &mut self.watcher else { return };
        match watcher.watch(folder) {
            // A folder that went again is missed by the next scan.
            Ok(()) | Err(WatchError::Gone) => {
                self.heard.insert(folder.to_owned());
            }
            Err(error) => self.poll_instead(&error),
        }
    }

    /// Events cannot be heard: the folder is looked into by turns.
    fn poll_instead(&mut self, error: &WatchError) {
        let interval = *self.poll.get_or_insert(POLL_DEFAULT);
        tracing::warn!(
            folder = %self.path.display(),
            "cannot be watched: {error}; it is looked into every {interval:?} instead"
        );
    }

    /// Until the next regular scan: about as long as was asked for, or longer where scans take long.
    fn interval(&self, cost: Duration) -> Duration {
        match self.poll {
            Some(poll) => poll.max(cost * POLL_SHARE),
            // Between 3/4 and 5/4, so that several daemons on one disk do not scan in step.
            None => {
                let jitter = (RandomState::new().hash_one(()) % 1024) as f64 / 1024.0;
                self.rescan_every.mul_f64(0.75 + 0.5 * jitter).max(cost * SCAN_SHARE)
            }
        }
    }
}

impl Work for Root {
    type Request = RootRequest;

    fn handle(&mut self, request: RootRequest, report: &dyn Fn(Event)) {
        match request {
            RootRequest::Scan => self.next_scan = Instant::now(),
            RootRequest::Inspect(request) => {
                let started = Instant::now();
                report(Event::Inspected(Box::new(self.inspect(*request))));
                self.inspected_for += started.elapsed();
            }
            RootRequest::StampObstacles(numbers) => {
                let obstacles = &self.obstacles[self.index];
                let stamps = match obstacles.stand_still() {
                    true => FoundObstacleStamps::Same(Arc::new(obstacles.stamps(None))),
                    false => {
                        let stamps = |number| (number, Arc::new(obstacles.stamps(number)));
                        FoundObstacleStamps::PerNumber(numbers.into_iter().map(stamps).collect())
                    }
                };
                report(Event::ObstaclesStamped { root: self.index, stamps });
            }
        }
    }

    fn on_fs_event(&mut self, event: FsEvent, report: &dyn Fn(Event)) {
        match event {
            FsEvent::Rescan => self.rescans.ask(Instant::now()),
            FsEvent::Changed(path) => self.on_file_event(&path, false, report),
            FsEvent::Renamed(path) => self.on_file_event(&path, true, report),
            FsEvent::Folder(path) => self.on_folder_event(&path, report),
        }
    }

    fn on_time(&mut self, report: &dyn Fn(Event)) {
        let now = Instant::now();
        if self.rescans.is_due(now) {
            tracing::info!("events were lost: everything is looked at");
            // With the events, perhaps the word that a folder is another one now: each is asked for its events once more.
            self.heard.clear();
            self.is_after_loss = true;
            self.next_scan = now;
        }
        let mut is_due = self.next_scan <= now;
        if !self.once && self.compared_at + COMPARE_EVERY <= now {
            self.compared_at = now;
            is_due |= FolderIdentity::of(&self.path).ok() != self.identity;
        }
        if is_due {
            self.scan_and_report(report);
        }
        if self.once {
            self.next_scan = now + NEVER;
        }
    }

    fn next_time(&self) -> Instant {
        let compare_at = if self.once { self.next_scan } else { self.compared_at + COMPARE_EVERY };
        let next = self.next_scan.min(compare_at);
        self.rescans.due_at.map_or(next, |due_at| due_at.min(next))
    }
}

/// A run that ends when all is done scans at the start only.
const NEVER: Duration = Duration::from_secs(1 << 32);
