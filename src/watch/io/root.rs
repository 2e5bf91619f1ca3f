//! A watched folder: checks whether it exists, lists and inspects its files, and schedules the next scan. Each
//! root has its own thread.
//!
//! Events are hints; only scans are authoritative. A root is scanned at the start, after events were lost,
//! when it becomes available again, and at regular intervals. On a network file system, which sends no
//! events, the interval is short. A folder that vanishes, or had files and is suddenly empty, is
//! *unavailable*: its state is kept, because its disk may only be unmounted.

use std::collections::HashSet;
use std::hash::{BuildHasher, RandomState};
use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};

use crossbeam::channel::Receiver;
use meniscus_formats::{Completeness, Neighbor, completeness};

use crate::pipeline::{
    ChangedOutput, Conflict, FileId, FileStamp, ObstacleFiles, ObstacleStamps, SniffedContent, content,
    content_with, is_level_set, may_hold_several, open_regular,
};
use crate::watch::config::{Poll, StabilityTimeouts, Watch, WatchConfig, names_lists};
use crate::watch::core::completeness::{
    Candidate, FileHint, Readiness, Sentinel, may_be_sentinel, path_of_sentinel, sentinel_counts,
};
use crate::watch::core::events::{
    Complete, Event, FileContents, FoundObstacleStamps, Inspect, Inspected, InspectionExtent,
    InspectionResult, RecordCheck, RootRequest, Scan,
};
use crate::watch::core::frames::FrameId;
use crate::watch::core::sequences::obstacle_stamp;

use super::file_system::network_file_system;
use super::fs_events::{FsEvent, WatchError, Watcher};
use super::output_folder::OutputGuard;
use super::scan::{file_state, scan};
use super::selection::FileFilter;
use super::worker::Work;
#[cfg(target_os = "linux")]
use super::writers::is_open_for_writing;

/// A watched folder.
pub(super) struct Root {
    index: usize,
    once: bool,
    settle: Duration,
    watch: Watch,
    /// The absolute path.
    path: PathBuf,
    selection: FileFilter,
    obstacles: Vec<Arc<ObstacleFiles>>,
    output: Arc<OutputGuard>,
    watcher: Option<Watcher>,
    /// Whether the next scan is due to lost events.
    is_after_loss: bool,
    /// The type of its file system, if it is a network file system.
    network: Option<&'static str>,
    /// The interval of scans that replace events; `None` if the system reports events.
    poll: Option<Duration>,
    /// Folders whose events are received.
    watched_folders: HashSet<PathBuf>,
    next_scan: Instant,
    /// When the last scan ended.
    scanned_at: Instant,
    /// The time that the last scan took.
    scan_cost: Duration,
    /// The time spent on inspections since the last scan.
    inspected_for: Duration,
    /// When its identity was last checked.
    compared_at: Instant,
    /// Whether the last scan found frames.
    had_frames: bool,
    /// The identity of the folder at the last scan: its path may be a link that now leads elsewhere, or
    /// another disk may be mounted there.
    identity: Option<FileId>,
}

/// The default polling interval on network file systems.
const POLL_DEFAULT: Duration = Duration::from_secs(2);

/// Attributes of a file on a network file system may be a few seconds old: an NFS client caches them for
/// three seconds.
const NETWORK_SETTLE_MIN: Duration = Duration::from_secs(4);

/// How often the identity of a root is checked.
const COMPARE_EVERY: Duration = Duration::from_secs(1);

/// How soon an unavailable folder is checked again.
const UNAVAILABLE_RETRY: Duration = Duration::from_secs(1);

/// The approximate interval between regular scans, which find changes whose event was lost.
const RESCAN_EVERY: Duration = Duration::from_secs(60);

/// The shortest pause between scans after lost events.
const LOSS_PAUSE_MIN: Duration = Duration::from_millis(100);

/// Regular scans take at most 1/200 of the time of a core.
const SCAN_SHARE: u32 = 200;

/// Scans that replace events, or follow their loss, take at most 1/10 of the time of a core: more than
/// regular scans, because users wait for their results.
const POLL_SHARE: u32 = 10;

/// Longer than any run. A run with `once` scans only at the start, so its next scan is this far away.
const NEVER: Duration = Duration::from_secs(1 << 32);

impl Root {
    /// A folder that is not scanned yet and may not exist, and the receiver of its events. If the system
    /// sends none, the folder is polled.
    pub(super) fn new(
        index: usize,
        path: PathBuf,
        selection: FileFilter,
        config: &WatchConfig,
        obstacles: Vec<Arc<ObstacleFiles>>,
        output: Arc<OutputGuard>,
    ) -> (Root, Option<Receiver<FsEvent>>) {
        let poll = match config.poll {
            Poll::Every(interval) => Some(interval),
            Poll::Auto => None,
        };
        let mut root = Root {
            index,
            once: config.once,
            settle: config.settle,
            watch: config.watches[index].clone(),
            path,
            selection,
            obstacles,
            output,
            watcher: None,
            is_after_loss: false,
            network: None,
            poll,
            watched_folders: HashSet::new(),
            // The core requests the first scan.
            next_scan: Instant::now() + NEVER,
            scanned_at: Instant::now(),
            scan_cost: Duration::ZERO,
            inspected_for: Duration::ZERO,
            compared_at: Instant::now(),
            had_frames: false,
            identity: None,
        };
        // A run with `once` needs no events.
        let mut fs_events = None;
        match (!config.once).then(Watcher::new).transpose() {
            Ok(watching) => (root.watcher, fs_events) = watching.unzip(),
            Err(error) => root.poll_instead(&error),
        }
        (root, fs_events)
    }

    /// Whether this machine's clock sets the times of its files; not on a network file system.
    fn trust_clock(&self) -> bool {
        self.network.is_none()
    }

    /// How long its files must be unchanged before they are read.
    fn timeouts(&self) -> StabilityTimeouts {
        let settle_min = if self.network.is_some() { NETWORK_SETTLE_MIN } else { Duration::ZERO };
        StabilityTimeouts::new(self.settle.max(settle_min), self.once)
    }

    /// Scans the folder, and reports the result.
    fn scan_and_report(&mut self, report: &dyn Fn(Event)) {
        let started = Instant::now();
        let after_loss = std::mem::take(&mut self.is_after_loss);
        if after_loss {
            tracing::info!("events were lost: scanning everything");
            // The lost events may have reported that a folder was replaced, so all folders are watched again.
            self.watched_folders.clear();
        }
        let found = self.scan().map(|found| Scan { after_loss, ..found });
        if found.is_ok() {
            // Files that a scan finds are inspected; the inspections count as part of its cost.
            self.scan_cost = started.elapsed() + std::mem::take(&mut self.inspected_for);
            self.scanned_at = Instant::now();
            self.next_scan = self.scanned_at + self.interval();
        }
        report(Event::RootScanned { root: self.index, found, at: Instant::now() });
    }

    fn on_file_event(&mut self, path: &Path, hint: FileHint, report: &dyn Fn(Event)) {
        if path == self.path {
            return self.scan_and_report(report);
        }
        if self.selection.takes(&self.path, path) {
            let id = FrameId::new(self.index, path);
            report(match file_state(path, self.trust_clock()) {
                Ok(Some(seen)) => Event::FileSeen { id, seen, at: Instant::now(), hint },
                Ok(None) => Event::FileRemoved(id),
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
            // The folders that are watched at this path may be other folders.
            self.forget_folder(folder);
            match self.watch_and_scan(folder) {
                Ok(Scan { files, .. }) => {
                    report(Event::FolderScanned { root: self.index, files, at: Instant::now() });
                }
                // The folder is gone or was moved: a scan of the root finds out which files remain.
                Err(_) => self.next_scan = Instant::now(),
            }
        }
    }

    /// Lists the whole folder, and listens to its events from now on.
    ///
    /// # Errors
    /// The reason why the folder is unavailable.
    fn scan(&mut self) -> Result<Scan, String> {
        let identity = Some(FileId::of(&self.path));
        if self.identity != identity {
            // Events of the earlier folder say nothing about the current one, and an unmounted folder sends
            // no events.
            self.stop_watching();
            self.identity = identity;
        }
        let found = self.watch_and_scan(&self.path.clone());
        let found = found.map_err(|error| error.to_string()).and_then(|found| {
            if self.had_frames && found.files.is_empty() {
                // An empty mount point looks like a folder whose files were all deleted. In both cases there
                // is nothing to do until files appear.
                return Err("it is empty but had files before (is it mounted?)".to_owned());
            }
            Ok(found)
        });
        match &found {
            Ok(found) => self.had_frames |= !found.files.is_empty(),
            Err(_) => {
                // The folder that was watched is gone.
                self.stop_watching();
                self.next_scan = Instant::now() + UNAVAILABLE_RETRY;
            }
        }
        found
    }

    /// Lists one of its folders, and listens to the folder's events from now on.
    ///
    /// # Errors
    /// When the folder cannot be read.
    fn watch_and_scan(&mut self, folder: &Path) -> io::Result<Scan> {
        if self.watched_folders.is_empty() {
            self.choose_watch_method(folder)?;
        }
        if self.poll.is_some() {
            return self.scan_folder(folder);
        }
        self.listen(folder);
        loop {
            let found = self.scan_folder(folder)?;
            // A sub-folder that was not watched yet is watched now. The next scan of this loop finds the
            // files that appeared in it before.
            let unwatched: Vec<PathBuf> =
                found.folders.iter().filter(|f| !self.watched_folders.contains(*f)).cloned().collect();
            if unwatched.is_empty() || self.poll.is_some() || self.watcher.is_none() {
                return Ok(found);
            }
            for folder in &unwatched {
                self.listen(folder);
                if self.poll.is_some() {
                    break;
                }
            }
        }
    }

    fn scan_folder(&self, folder: &Path) -> io::Result<Scan> {
        scan(folder, &self.path, &self.selection, self.trust_clock())
    }

    /// Stops listening to a folder that is gone or was replaced.
    fn forget_folder(&mut self, folder: &Path) {
        let gone: Vec<PathBuf> =
            self.watched_folders.iter().filter(|watched| watched.starts_with(folder)).cloned().collect();
        for folder in gone {
            self.watched_folders.remove(&folder);
            if let Some(watcher) = &mut self.watcher {
                watcher.unwatch(&folder);
            }
        }
    }

    fn stop_watching(&mut self) {
        self.forget_folder(&self.path.clone());
    }

    fn choose_watch_method(&mut self, folder: &Path) -> io::Result<()> {
        let network = network_file_system(folder)?;
        if let Some(name) = network
            && self.poll.is_none()
        {
            tracing::info!(
                folder = %self.path.display(),
                "folder is on {name}, which sends no file-system events; scanning it every {POLL_DEFAULT:?}"
            );
            self.poll = Some(POLL_DEFAULT);
        }
        self.network = network;
        Ok(())
    }

    fn listen(&mut self, folder: &Path) {
        let Some(watcher) = &mut self.watcher else { return };
        match watcher.watch(folder) {
            // If the folder is gone again, the next scan reports it.
            Ok(()) | Err(WatchError::Missing) => {
                self.watched_folders.insert(folder.to_owned());
            }
            Err(error) => self.poll_instead(&error),
        }
    }

    /// Switches to polling, because events are unavailable.
    fn poll_instead(&mut self, error: &WatchError) {
        let interval = *self.poll.get_or_insert(POLL_DEFAULT);
        tracing::warn!(
            folder = %self.path.display(),
            "cannot watch the folder: {error}; scanning it every {interval:?} instead"
        );
    }

    /// Events were lost. They are lost when there are too many, and a scan for each loss would block all
    /// other work, so these scans have a pause between them.
    fn scan_after_loss(&mut self) {
        self.is_after_loss = true;
        let pause = LOSS_PAUSE_MIN.max(self.scan_cost * POLL_SHARE);
        self.next_scan = self.next_scan.min(self.scanned_at + pause);
    }

    /// The time until the next regular scan: about the configured interval, or longer if scans take long.
    fn interval(&self) -> Duration {
        match self.poll {
            Some(poll) => poll.max(self.scan_cost * POLL_SHARE),
            // Between 3/4 and 5/4 of the interval, so that several daemons on one disk do not scan at the
            // same time.
            None => {
                let jitter = (RandomState::new().hash_one(()) % 1024) as f64 / 1024.0;
                RESCAN_EVERY.mul_f64(0.75 + 0.5 * jitter).max(self.scan_cost * SCAN_SHARE)
            }
        }
    }
}

impl Work for Root {
    type Request = RootRequest;

    fn handle(&mut self, request: RootRequest, report: &dyn Fn(Event)) {
        match request {
            // The worker calls `on_time` right after this.
            RootRequest::Scan => self.next_scan = Instant::now(),
            RootRequest::Inspect(request) => {
                let started = Instant::now();
                report(Event::Inspected(Box::new(self.inspect(*request))));
                self.inspected_for += started.elapsed();
            }
            RootRequest::StampObstacles(numbers) => {
                let obstacles = &self.obstacles[self.index];
                let stamps = if obstacles.are_static() {
                    FoundObstacleStamps::Same(Arc::new(obstacles.stamps(None)))
                } else {
                    let stamps = |number| (number, Arc::new(obstacles.stamps(number)));
                    FoundObstacleStamps::PerNumber(numbers.into_iter().map(stamps).collect())
                };
                report(Event::ObstaclesStamped { root: self.index, stamps });
            }
        }
    }

    fn on_fs_event(&mut self, event: FsEvent, report: &dyn Fn(Event)) {
        match event {
            FsEvent::Rescan => self.scan_after_loss(),
            FsEvent::File(path, hint) => self.on_file_event(&path, hint, report),
            FsEvent::Folder(path) => self.on_folder_event(&path, report),
        }
    }

    fn on_time(&mut self, report: &dyn Fn(Event)) {
        let now = Instant::now();
        let mut is_due = self.next_scan <= now;
        if !self.once && self.compared_at + COMPARE_EVERY <= now {
            self.compared_at = now;
            is_due |= self.identity != Some(FileId::of(&self.path));
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
        self.next_scan.min(compare_at)
    }
}

impl Root {
    /// Inspects a file, as far as the core requests.
    fn inspect(&self, request: Inspect) -> Inspected {
        let own = &self.obstacles[self.index];
        let stamps = || Arc::new(own.stamps(request.id.frame_file(&self.path).number()));
        let obstacles = (!own.is_empty()).then(stamps);
        let found = self.examine(&request, obstacles.as_deref());
        Inspected { id: request.id, number: request.number, found, obstacles }
    }

    fn examine(&self, request: &Inspect, obstacles: Option<&ObstacleStamps>) -> InspectionResult {
        let Inspect { id, stamp, outputs, extent, record_check, .. } = request;
        let changed_output = record_check.as_ref().and_then(|check| self.changed_output_of(check));
        let has_obstacles = |check: &RecordCheck| has_recorded_obstacles(check, obstacles);
        let names_changed = |check: &RecordCheck| names_changed_files(check, id.file_path());
        let has_changed_files = record_check.as_ref().is_some_and(names_changed);
        let is_as_recorded = changed_output.is_none()
            && !has_changed_files
            && record_check.as_ref().is_some_and(has_obstacles);
        if is_as_recorded && *extent == InspectionExtent::AllOfJustSeen {
            return InspectionResult::AsRecorded;
        }
        let file = id.file_path();
        let seen = match file_state(file, self.trust_clock()) {
            Ok(Some(seen)) => seen,
            Ok(None) => return InspectionResult::Missing,
            Err(error) => return InspectionResult::Unreadable(error),
        };
        let at = Instant::now();
        if seen.stamp != *stamp {
            return InspectionResult::Changed(seen, at);
        }
        if *extent == InspectionExtent::Stamp {
            return InspectionResult::Same;
        }
        if is_as_recorded {
            return InspectionResult::AsRecorded;
        }
        if !self.watch.has_level_sets && is_level_set(file) {
            // It need not be complete to be left alone.
            let contents = FileContents::NotParticles;
            return InspectionResult::Complete(Complete {
                proof: None,
                changed_output,
                has_changed_files,
                contents,
                conflict: None,
            });
        }
        let mut proof = None;
        if let Some(mut candidate) = request.candidate {
            candidate.see(at, &seen, FileHint::Changed);
            match readiness_of(file, &candidate, at, &self.watch, &self.timeouts()) {
                Readiness::Ready(found) => proof = Some(found),
                Readiness::Waiting { until, why } => return InspectionResult::Waiting { until, why },
            }
        }
        let contents = contents_of(id, &self.watch);
        let conflict = match contents {
            FileContents::Frame | FileContents::MaybeSteps => self.conflict_of(outputs),
            FileContents::NotParticles | FileContents::Neighbor(_) | FileContents::Unreadable(_) => None,
        };
        InspectionResult::Complete(Complete { proof, changed_output, has_changed_files, contents, conflict })
    }

    /// The first recorded output that has changed.
    fn changed_output_of(&self, check: &RecordCheck) -> Option<ChangedOutput> {
        check.record.if_done()?.changed_output(&self.output.folder)
    }

    /// Why these outputs must not be written: one would replace particles, a mesh or a level set of
    /// another program, or an obstacle of any watched folder. `None` if nothing is wrong.
    fn conflict_of(&self, outputs: &[PathBuf]) -> Option<String> {
        for output in outputs {
            for obstacles in &self.obstacles {
                if let Err(conflict) = obstacles.refuse_output(output) {
                    return Some(conflict.to_string());
                }
            }
            if replaces_data(output) {
                return Some(replacement(output));
            }
        }
        None
    }
}

/// Whether an output would replace particles, or a mesh or a level set of another program. An extension
/// suffices here: the file may be a frame that a simulation has only begun to write.
fn replaces_data(output: &Path) -> bool {
    content(output).is_ok_and(SniffedContent::is_data)
}

/// Why such an output is not written.
fn replacement(output: &Path) -> String {
    Conflict::ReplacesData { output: output.to_owned() }.to_string()
}

fn has_recorded_obstacles(check: &RecordCheck, obstacles: Option<&ObstacleStamps>) -> bool {
    !check.checks_obstacles || check.record.obstacle_stamp() == obstacles.map(obstacle_stamp).as_ref()
}

/// Whether files that a frame was read from besides its own, `file`, have changed since.
fn names_changed_files(check: &RecordCheck, file: &Path) -> bool {
    check.record.named().is_some_and(|named| !named.still_hold(file))
}

fn contents_of(id: &FrameId, watch: &Watch) -> FileContents {
    match content_with(id.file_path(), watch.choices.columns.as_ref()) {
        // The pattern asks for lists of files, and not for the files.
        Ok(SniffedContent::Neighbor(Neighbor::Index)) if names_lists(watch.pattern.as_deref()) => {}
        Ok(SniffedContent::OwnOutput | SniffedContent::NotParticles) => return FileContents::NotParticles,
        Ok(SniffedContent::Neighbor(neighbor)) => return FileContents::Neighbor(neighbor),
        // An unreadable file counts as a frame: reading it reports what is wrong.
        Ok(SniffedContent::Particles | SniffedContent::OwnParticles) | Err(_) => {}
    }
    if watch.has_level_sets && !is_level_set(id.file_path()) {
        let what =
            "the file has points, and level sets are watched: give a --pattern that does not end in .vdb";
        return FileContents::Unreadable(io::Error::other(what));
    }
    if id.is_step() {
        return FileContents::Frame;
    }
    match may_hold_several(&id.path) {
        Ok(true) => FileContents::MaybeSteps,
        Ok(false) => FileContents::Frame,
        Err(error) => FileContents::Unreadable(error),
    }
}

/// Whether this file may be read now.
fn readiness_of(
    file: &Path,
    candidate: &Candidate,
    now: Instant,
    watch: &Watch,
    timeouts: &StabilityTimeouts,
) -> Readiness {
    let sentinel = FileStamp::of_path(&path_of_sentinel(watch, file));
    let sentinel = Sentinel {
        is_required: watch.sentinel.is_some(),
        // A sentinel of an earlier version of the frame proves nothing.
        exists: sentinel.is_ok_and(|sentinel| sentinel_counts(&sentinel, candidate.stamp())),
    };
    candidate.readiness(
        now,
        timeouts,
        sentinel,
        || completeness_of(file),
        |unchanged_for| is_open_for_writing(file, unchanged_for),
    )
}

/// The completeness according to the file format. Errors are ignored here, because reading the frame reports
/// them.
fn completeness_of(path: &Path) -> Completeness {
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    let check = || completeness(&mut open_regular(path)?, &name);
    check().unwrap_or(Completeness::Unknown)
}

/// Other systems do not show it without unsafe code.
#[cfg(not(target_os = "linux"))]
fn is_open_for_writing(_file: &Path, _unchanged_for: std::time::Duration) -> bool {
    false
}
