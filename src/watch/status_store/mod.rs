//! The state of a running daemon for clients, as plain data: the daemon writes it, and clients read it.
//!
//! ```text
//!   event loop ──update──▶ ┌─────────────────────────────┐ ──page, frame, file──▶ requests
//!   pipeline ────began───▶ │ frames in natural order     │
//!                          │ the last changes, by number │ ──changes_since──────▶ subscribers
//!                          └─────────────────────────────┘
//! ```
//!
//! Clients must not slow down frames, and slow clients must not cost memory. So a change replaces the view of
//! one frame; the views of all frames are never rebuilt. The lock is held only while pointers and plain
//! numbers are copied: for a page, for 256 changes, for the 900 samples of the chart, or for the counters.
//! They are serialized after the lock is released. The log of changes is bounded and holds *names*, not
//! states: a client that is behind gets each frame once, in its current state. A client that falls behind the
//! end of the log must reload everything.
//!
//! The types here are those of the interface in `docs/status-page.md`, which specifies their serialized form.

mod metrics;
mod view;

use std::collections::btree_map::Entry;
use std::collections::{BTreeMap, BTreeSet, HashMap, VecDeque};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use serde_json::Value;

use crate::pipeline::{SequenceRecord, Stage, natural_order, now_ms};

pub use crate::pipeline::Figures;
pub use metrics::{BUCKETS_S, Counters, Histogram, STAGES};
pub use view::{
    Forecast, FrameProgress, FrameSummary, FrameView, LiveStatus, OutputView, StateCounts, StatusSample,
};

/// The state of one daemon for clients.
#[derive(Debug)]
pub struct StatusStore {
    /// Distinguishes this run from earlier ones: the numbers of changes restart with each run.
    run: u64,
    version: AtomicU64,
    state: Mutex<StoreState>,
}

#[derive(Debug, Default)]
struct StoreState {
    frames: BTreeMap<NameOrder, Arc<FrameView>>,
    /// The name of the frame whose outputs have this stem, without frames that are done.
    by_stem: HashMap<PathBuf, NameOrder>,
    /// The frame of each output, by the name of the output.
    by_output: HashMap<String, NameOrder>,
    counts: StateCounts,
    changes: VecDeque<StatusChange>,
    version: u64,
    status: Arc<LiveStatus>,
    is_ready: bool,
    plan: Arc<Value>,
    sequences: BTreeMap<String, Arc<SequenceRecord>>,
    samples: VecDeque<StatusSample>,
    counters: Counters,
}

/// A frame's name, in natural order.
#[derive(Clone, Debug, PartialEq, Eq)]
struct NameOrder(Arc<str>);

impl Ord for NameOrder {
    fn cmp(&self, other: &NameOrder) -> std::cmp::Ordering {
        natural_order(&self.0, &other.0).then_with(|| self.0.cmp(&other.0))
    }
}

impl PartialOrd for NameOrder {
    fn partial_cmp(&self, other: &NameOrder) -> Option<std::cmp::Ordering> {
        Some(self.cmp(other))
    }
}

#[derive(Clone, Debug)]
enum StatusChange {
    /// A frame changed or was removed.
    Frame(NameOrder),
    Status,
    Settings,
    /// Everything.
    All,
}

/// Some frames, in natural order.
#[derive(Clone, Debug)]
pub struct Page {
    /// The page contains all changes up to this one.
    pub version: u64,
    /// The total number of frames.
    pub total: usize,
    /// The requested number of frames, or as many as exist.
    pub frames: Vec<Arc<FrameView>>,
    /// Whether more frames follow.
    pub has_more: bool,
}

/// The changes since a version.
#[derive(Clone, Debug)]
pub enum StatusChanges {
    /// The log no longer holds these changes: the client must reload everything, and continue from this
    /// version.
    Lost(u64),
    /// The changes are known.
    Known {
        /// The version to continue from.
        version: u64,
        /// Changed frames, in their current state.
        frames: Vec<Arc<FrameView>>,
        /// Names of removed frames.
        removed: Vec<Arc<str>>,
        /// The status of the daemon, if it has changed.
        status: Option<Arc<LiveStatus>>,
        /// Whether settings have changed.
        settings: bool,
    },
}

/// The maximum length of the log of changes.
const CHANGES_MAX: usize = 4096;

/// The number of samples that are kept: one per second for a quarter of an hour.
const SAMPLES_MAX: usize = 900;

impl Default for StatusStore {
    fn default() -> StatusStore {
        StatusStore::new()
    }
}

impl StatusStore {
    /// An empty store.
    pub fn new() -> StatusStore {
        StatusStore { run: now_ms(), version: AtomicU64::new(0), state: Mutex::default() }
    }

    /// Distinguishes this run from earlier ones.
    pub fn run(&self) -> u64 {
        self.run
    }

    /// The number of the last change.
    pub fn version(&self) -> u64 {
        self.version.load(Ordering::Acquire)
    }

    /// A daemon starts with this plan: the state of an earlier one is cleared.
    pub fn begin(&self, plan: Value) {
        let mut state = self.lock();
        // Counters belong to the process, so they are kept.
        let old = std::mem::take(&mut *state);
        *state = StoreState {
            version: old.version,
            plan: Arc::new(plan),
            counters: old.counters,
            samples: old.samples,
            ..StoreState::default()
        };
        self.note(&mut state, StatusChange::All);
    }

    /// The first scans are complete.
    pub fn set_ready(&self) {
        self.lock().is_ready = true;
    }

    /// Replaces the view of a frame. If the new view has no figures, but the same state and outputs as the
    /// old one, the old figures are kept.
    pub fn update(&self, mut view: FrameView) {
        let mut state = self.lock();
        let rank = NameOrder(view.summary.name.clone());
        let (old, view) = match state.frames.entry(rank.clone()) {
            Entry::Vacant(vacant) => (None, Arc::clone(vacant.insert(Arc::new(view)))),
            Entry::Occupied(mut vacant) => {
                let old = vacant.get();
                let is_same = old.summary.state == view.summary.state && old.outputs == view.outputs;
                if is_same && old.summary.reason == view.summary.reason {
                    view.summary.since_ms = old.summary.since_ms;
                }
                if view.figures.is_none() && is_same {
                    view.figures.clone_from(&old.figures);
                }
                let view = Arc::new(view);
                (Some(vacant.insert(Arc::clone(&view))), view)
            }
        };
        if let Some(old) = &old {
            state.unlink(old);
        }
        state.link(&rank, &view);
        if old.is_none_or(|old| old != view) {
            self.note(&mut state, StatusChange::Frame(rank));
        }
    }

    /// A frame was removed, or is not a frame.
    pub fn remove(&self, name: &str) {
        let mut state = self.lock();
        let rank = NameOrder(name.into());
        if let Some(old) = state.frames.remove(&rank) {
            state.unlink(&old);
            self.note(&mut state, StatusChange::Frame(rank));
        }
    }

    /// The frame whose outputs have this stem has entered a stage.
    pub fn stage_began(&self, stem: &Path, stage: Stage) {
        let mut state = self.lock();
        let Some(rank) = state.by_stem.get(stem).cloned() else { return };
        let Some(mut frame) = state.frames.remove(&rank) else { return };
        state.unlink(&frame);
        let view = Arc::make_mut(&mut frame);
        view.summary.state = FrameProgress::Working;
        view.summary.stage = Some(STAGES[stage as usize]);
        view.summary.since_ms = now_ms();
        state.link(&rank, &frame);
        state.frames.insert(rank.clone(), frame);
        self.note(&mut state, StatusChange::Frame(rank));
    }

    /// Publishes the settings of a sequence.
    pub fn set_sequence(&self, name: String, record: SequenceRecord) {
        let mut state = self.lock();
        state.sequences.insert(name, Arc::new(record));
        self.note(&mut state, StatusChange::Settings);
    }

    /// Sets the status of the daemon. Called about once a second; adds a sample for the chart.
    pub fn set_status(&self, status: LiveStatus) {
        let mut state = self.lock();
        let StateCounts { waiting, queued, working, failed, .. } = state.counts;
        let sample = StatusSample {
            at_ms: now_ms(),
            waiting,
            queued,
            working,
            failed,
            converted: state.counters.converted,
            memory_bytes: status.memory_bytes,
        };
        if state.samples.len() == SAMPLES_MAX {
            state.samples.pop_front();
        }
        state.samples.push_back(sample);
        if *state.status != status {
            state.status = Arc::new(status);
            self.note(&mut state, StatusChange::Status);
        }
    }

    /// Sets the counters.
    pub fn set_counters(&self, counters: Counters) {
        self.lock().counters = counters;
    }

    /// Up to `limit` frames after the one with this name; without a name, from the first one.
    pub fn page(&self, after: Option<&str>, limit: usize) -> Page {
        let state = self.lock();
        let frames = match after {
            None => state.frames.range::<NameOrder, _>(..),
            Some(name) => {
                let after = std::ops::Bound::Excluded(NameOrder(name.into()));
                state.frames.range((after, std::ops::Bound::Unbounded))
            }
        };
        let mut frames = frames.map(|(_, frame)| Arc::clone(frame));
        let page = frames.by_ref().take(limit).collect();
        Page {
            version: state.version,
            total: state.frames.len(),
            frames: page,
            has_more: frames.next().is_some(),
        }
    }

    /// The frame with this name.
    pub fn frame(&self, name: &str) -> Option<Arc<FrameView>> {
        self.lock().frames.get(&NameOrder(name.into())).map(Arc::clone)
    }

    /// The path of the output with this name.
    pub fn file(&self, name: &str) -> Option<PathBuf> {
        let state = self.lock();
        let frame = state.frames.get(state.by_output.get(name)?)?;
        frame.outputs.iter().find(|output| output.name == name).map(|output| output.path.clone())
    }

    /// The configuration of the daemon, and the settings of each sequence.
    pub fn settings(&self) -> (Arc<Value>, Vec<Arc<SequenceRecord>>) {
        let state = self.lock();
        (Arc::clone(&state.plan), state.sequences.values().map(Arc::clone).collect())
    }

    /// The status of the daemon, and the number of frames in each state.
    pub fn status(&self) -> (Arc<LiveStatus>, StateCounts) {
        let state = self.lock();
        (Arc::clone(&state.status), state.counts)
    }

    /// The expected number of results, and the time until they are done.
    pub fn forecast(&self) -> Forecast {
        let state = self.lock();
        Forecast::new(&state.counts, state.samples.iter())
    }

    /// The samples of the last quarter of an hour.
    pub fn samples(&self) -> Vec<StatusSample> {
        self.lock().samples.iter().copied().collect()
    }

    /// Counters since the start of the daemon.
    pub fn counters(&self) -> Counters {
        self.lock().counters.clone()
    }

    /// Whether the first scans are complete.
    pub fn is_ready(&self) -> bool {
        self.lock().is_ready
    }

    /// The changes after `version`, or the first part of them: inspects at most `limit` changes.
    pub fn changes_since(&self, version: u64, limit: usize) -> StatusChanges {
        let state = self.lock();
        let first = state.version - state.changes.len() as u64;
        if version < first || state.version < version {
            return StatusChanges::Lost(state.version);
        }
        let news = state.changes.iter().skip((version - first) as usize).take(limit);
        let version = state.version.min(version + limit as u64);
        let (mut ranks, mut is_status, mut settings) = (BTreeSet::new(), false, false);
        for change in news {
            match change {
                StatusChange::All => return StatusChanges::Lost(state.version),
                StatusChange::Frame(rank) => drop(ranks.insert(rank)),
                StatusChange::Status => is_status = true,
                StatusChange::Settings => settings = true,
            }
        }
        let (mut frames, mut removed) = (Vec::new(), Vec::new());
        for rank in ranks {
            match state.frames.get(rank) {
                Some(frame) => frames.push(Arc::clone(frame)),
                None => removed.push(Arc::clone(&rank.0)),
            }
        }
        let status = is_status.then(|| Arc::clone(&state.status));
        StatusChanges::Known { version, frames, removed, status, settings }
    }

    fn note(&self, state: &mut StoreState, change: StatusChange) {
        if state.changes.len() == CHANGES_MAX {
            state.changes.pop_front();
        }
        state.changes.push_back(change);
        state.version += 1;
        self.version.store(state.version, Ordering::Release);
    }

    fn lock(&self) -> MutexGuard<'_, StoreState> {
        // If a panic left the state of a frame incomplete, the frame's next change replaces it.
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl StoreState {
    fn link(&mut self, rank: &NameOrder, view: &FrameView) {
        *self.counts.of(view.summary.state) += 1;
        // A frame that is done enters no stage before it is queued again.
        if view.summary.state != FrameProgress::Done {
            self.by_stem.insert(view.stem.clone(), rank.clone());
        }
        for output in &view.outputs {
            self.by_output.insert(output.name.clone(), rank.clone());
        }
    }

    fn unlink(&mut self, view: &FrameView) {
        *self.counts.of(view.summary.state) -= 1;
        let is_own = |owner: &NameOrder| owner.0 == view.summary.name;
        if self.by_stem.get(&view.stem).is_some_and(is_own) {
            self.by_stem.remove(&view.stem);
        }
        for output in &view.outputs {
            if self.by_output.get(&output.name).is_some_and(is_own) {
                self.by_output.remove(&output.name);
            }
        }
    }
}

#[cfg(test)]
mod tests;
