//! The state of the daemon.

use std::collections::{BTreeMap, BTreeSet, HashMap, HashSet};
use std::path::{self, Path, PathBuf};
use std::sync::Arc;

use crate::pipeline::{DaemonRecord, DaemonState, LatestRecords, ObstacleFiles, OutputOptions, RecordLine};
use crate::watch::config::{Watch, WatchConfig};
use crate::watch::status_store::Counters;

use super::disk_guard::{DiskGuard, FoundSpace};
use super::events::{Effect, Log, Now, OutputRequest, RootRequest};
use super::frames::{FileSteps, FrameId, FrameTable};
use super::queue::Queue;
use super::sequences::Sequences;

/// The state of the daemon and its decisions. Pure: uses no files, clocks or threads. The time comes with
/// each event, and actions are collected as effects.
pub(crate) struct Core {
    pub(super) config: Arc<WatchConfig>,
    /// Identifies this daemon in the records, with its last recorded state.
    identity: DaemonRecord,
    pub(super) roots: Vec<RootState>,
    pub(super) output_folders: Vec<OutputFolder>,
    /// For each watch, the index of its folder of outputs.
    pub(super) output_folder_of: Vec<usize>,
    pub(super) frames: FrameTable,
    /// The steps of each file that contains several.
    pub(super) steps_of: HashMap<FrameId, FileSteps>,
    pub(super) sequences: Sequences,
    /// Sequences that may be ready to be measured.
    pub(super) dirty_sequences: HashSet<usize>,
    pub(super) measuring_count: usize,
    /// For each stem of outputs, the input that owns these outputs.
    pub(super) claims: HashMap<PathBuf, FrameId>,
    /// The options of each mirrored sub-folder.
    pub(super) mirrored_options: HashMap<(usize, PathBuf), Arc<OutputOptions>>,
    pub(super) queue: Queue,
    /// The number of frames that the pipeline has asked for.
    pub(super) requested_count: usize,
    pub(super) guard: DiskGuard,
    pub(super) scan_count: u64,
    /// Frames that failed.
    pub(super) failed: HashMap<FrameId, Failure>,
    /// The number of frames that the pipeline has finished with.
    pub(super) finished_count: usize,
    pub(super) is_stopping: bool,
    /// Counters since the start of the process.
    pub(crate) counters: Counters,
    pub(super) now: Now,
    pub(super) effects: Vec<Effect>,
    /// Held frames that wait for those around them.
    pub(super) waiting_around: BTreeSet<FrameId>,
    /// Frames that may have to be converted again, because those around them have changed; by sequence.
    pub(super) doubtful_around: BTreeMap<usize, BTreeSet<FrameId>>,
    /// Frames whose views have changed, or that are gone. May contain duplicates.
    pub(super) changed: Vec<FrameId>,
    /// Sequences whose settings were determined.
    pub(super) changed_sequences: Vec<usize>,
}

/// A watched folder.
pub(crate) struct RootState {
    /// The absolute path.
    pub(super) path: PathBuf,
    pub(super) obstacles: Arc<ObstacleFiles>,
    /// Why it cannot be scanned; `None` if it can.
    pub(super) unavailable: Option<String>,
    pub(super) was_scanned: bool,
    /// Paths that the last scan could not examine, and why.
    pub(super) unreadable: BTreeMap<PathBuf, String>,
}

/// A folder of outputs.
pub(crate) struct OutputFolder {
    /// The absolute path.
    pub(super) folder: PathBuf,
    pub(super) records: LatestRecords,
    /// Why this daemon may not write there, if it may not.
    pub(super) lost: Option<String>,
    /// Free bytes, if the file system reports them.
    pub(super) free_bytes: Option<u64>,
}

/// Why a frame failed.
#[derive(Debug)]
pub(crate) struct Failure {
    pub(super) reason: String,
    /// The number of frames that were finished when the failure was logged; `None` if it was not logged in
    /// this run.
    pub(super) logged_at: Option<usize>,
    /// Whether the frame was refused, usually because of other files.
    pub(super) is_refusal: bool,
}

impl Core {
    /// The initial state. `roots` are the absolute paths of the watched folders, and `output_folders` those
    /// of the outputs with the latest records and the free bytes there.
    pub(crate) fn new(
        config: Arc<WatchConfig>,
        identity: DaemonRecord,
        roots: Vec<(PathBuf, Arc<ObstacleFiles>)>,
        output_folders: Vec<(PathBuf, LatestRecords, Option<u64>)>,
        output_folder_of: Vec<usize>,
        now: Now,
    ) -> Core {
        let new_root = |(path, obstacles)| RootState {
            path,
            obstacles,
            unavailable: None,
            was_scanned: false,
            unreadable: BTreeMap::new(),
        };
        let new_output =
            |(folder, records, free_bytes)| OutputFolder { folder, records, lost: None, free_bytes };
        Core {
            queue: Queue::new(config.order),
            guard: DiskGuard::new(config.disk_floor_bytes),
            config,
            identity,
            roots: roots.into_iter().map(new_root).collect(),
            output_folders: output_folders.into_iter().map(new_output).collect(),
            output_folder_of,
            frames: FrameTable::default(),
            steps_of: HashMap::new(),
            sequences: Sequences::default(),
            dirty_sequences: HashSet::new(),
            measuring_count: 0,
            claims: HashMap::new(),
            mirrored_options: HashMap::new(),
            requested_count: 0,
            scan_count: 0,
            failed: HashMap::new(),
            finished_count: 0,
            is_stopping: false,
            counters: Counters::default(),
            now,
            effects: Vec::new(),
            waiting_around: BTreeSet::new(),
            doubtful_around: BTreeMap::new(),
            changed: Vec::new(),
            changed_sequences: Vec::new(),
        }
    }

    /// Records that the daemon is running, logs the folders, and requests the first scans.
    pub(crate) fn start(&mut self) {
        self.record_daemon(DaemonState::Running);
        for root in 0..self.roots.len() {
            let (folder, outputs) =
                (self.root_path(root).to_owned(), self.output_folder(root).folder.clone());
            self.log(move || {
                tracing::info!(
                    folder = %folder.display(),
                    outputs = %outputs.display(),
                    version = env!("CARGO_PKG_VERSION"),
                    "watching"
                );
            });
        }
        self.scan_all();
    }

    /// The view of a frame has changed, or the frame is gone.
    pub(super) fn mark_changed(&mut self, id: &FrameId) {
        if self.changed.last() != Some(id) {
            self.changed.push(id.clone());
        }
    }

    pub(super) fn watch(&self, root: usize) -> &Watch {
        &self.config.watches[root]
    }

    /// The folder of outputs of a root.
    pub(super) fn output_folder(&self, root: usize) -> &OutputFolder {
        &self.output_folders[self.output_folder_of[root]]
    }

    pub(super) fn log(&mut self, write: impl FnOnce() + Send + 'static) {
        self.effects.push(Effect::Log(Log::new(write)));
    }

    /// Logs a message about a file or a folder.
    pub(super) fn log_about(
        &mut self,
        path: impl Into<PathBuf>,
        write: impl FnOnce(path::Display<'_>) + Send + 'static,
    ) {
        let path = path.into();
        self.log(move || write(path.display()));
    }

    pub(super) fn request(&mut self, root: usize, request: RootRequest) {
        self.effects.push(Effect::Root(root, request));
    }

    /// Keeps a record, and requests that it be written. `log` is written after the record.
    pub(super) fn record(&mut self, output: usize, line: RecordLine, log: Option<Log>) {
        self.output_folders[output].records.insert(&line);
        self.effects.push(Effect::Output(output, OutputRequest::Record(line, log)));
    }

    /// Records the state of the daemon.
    pub(crate) fn record_daemon(&mut self, state: DaemonState) {
        self.identity = DaemonRecord { state, at_ms: self.now.unix_ms, ..self.identity.clone() };
        for output in 0..self.output_folders.len() {
            self.record(output, RecordLine::Daemon(self.identity.clone()), None);
        }
    }

    /// Records whether the daemon is paused, if that has changed.
    pub(crate) fn record_pause(&mut self) {
        let state = self.guard.reason().map_or(DaemonState::Running, DaemonState::Paused);
        // The free space changes all the time, and each record takes some of it.
        let without_numbers =
            |state: &DaemonState| format!("{state:?}").replace(|c: char| c.is_ascii_digit() || c == '.', "");
        if without_numbers(&state) != without_numbers(&self.identity.state) && !self.is_stopping {
            self.record_daemon(state);
        }
    }

    /// Requests a scan of every root.
    pub(super) fn scan_all(&mut self) {
        for root in 0..self.roots.len() {
            self.request(root, RootRequest::Scan);
        }
    }

    /// Updates whether frames may start.
    pub(super) fn check_space(&mut self) {
        let was_blocked = self.guard.reason().is_some();
        let found: Vec<FoundSpace<'_>> = self
            .output_folders
            .iter()
            .map(|OutputFolder { folder, lost, free_bytes, .. }| FoundSpace {
                folder,
                lost: lost.as_deref(),
                free_bytes: *free_bytes,
            })
            .collect();
        self.guard.check(&found, self.now.at);
        match self.guard.reason() {
            Some(why) if !was_blocked => self.log(move || tracing::warn!("paused: {why}")),
            None if was_blocked => {
                self.log(|| tracing::info!("no longer paused: the outputs can be written again"))
            }
            _ => {}
        }
    }

    /// The absolute path of a root.
    pub(super) fn root_path(&self, root: usize) -> &Path {
        &self.roots[root].path
    }
}
