//! What clients can see of a running daemon, as plain data: the daemon puts it here, and clients read it.
//!
//! ```text
//!   event loop ──update──▶ ┌─────────────────────────────┐ ──page, frame, file──▶ requests
//!   pipeline ────began───▶ │ frames in natural order     │
//!                          │ the last changes, by number │ ──changes_since──────▶ subscribers
//!                          └─────────────────────────────┘
//! ```
//!
//! Two things must not happen: that a client slows down a frame, and that a slow client costs memory. So the view of a
//! frame is replaced, never built anew for all. The lock is held while pointers and plain numbers are copied: those of a
//! page, of 256 changes, of the 900 samples of the chart, of the counters; they are serialized after it. The log of
//! changes has an end, and holds *names* and not states: a client that comes late gets each frame once, as it is by then.
//! A client that comes too late is told so, and reads everything again.
//!
//! The types here are those of the interface in `docs/window.md`: what they serialize to is promised there.

mod figures;
mod metrics;
mod view;

use std::collections::{BTreeMap, BTreeSet, HashMap, VecDeque};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{SystemTime, UNIX_EPOCH};

use serde_json::Value;

use crate::pipeline::{SequenceRecord, Stage, natural_order};

pub use figures::Figures;
pub use metrics::{BUCKETS_S, Counters, Histogram, STAGES};
pub use view::{
    Forecast, FrameProgress, FrameSummary, FrameView, LiveStatus, OutputView, StateCounts, StatusSample,
};

/// What clients can see of one daemon.
#[derive(Debug)]
pub struct StatusStore {
    /// Tells this daemon from the one before: numbers of changes begin anew with each.
    run: u64,
    version: AtomicU64,
    /// When the daemon last said that it is not stuck, in milliseconds since 1970.
    alive_ms: AtomicU64,
    state: Mutex<StoreState>,
}

#[derive(Debug, Default)]
struct StoreState {
    frames: BTreeMap<NameOrder, Arc<FrameView>>,
    /// The name of the frame whose outputs are called so.
    by_stem: HashMap<PathBuf, NameOrder>,
    /// Which frame an output is of, by the name of the output.
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
    /// Of a frame, or that it is gone.
    Frame(NameOrder),
    Status,
    Settings,
    /// Everything.
    All,
}

/// Some frames, in natural order.
#[derive(Clone, Debug)]
pub struct Page {
    /// Changes up to this one are in it.
    pub version: u64,
    /// How many frames there are in all.
    pub total: usize,
    /// As many as were asked for, or as there are.
    pub frames: Vec<Arc<FrameView>>,
    /// Whether there are more after these.
    pub has_more: bool,
}

/// What has changed since somebody looked.
#[derive(Clone, Debug)]
pub enum StatusChanges {
    /// So much that it is not known any more: look at everything again, and go on from this version.
    Lost(u64),
    /// This.
    Known {
        /// Go on from here.
        version: u64,
        /// Frames, as they are now.
        frames: Vec<Arc<FrameView>>,
        /// Names of frames that are gone.
        removed: Vec<Arc<str>>,
        /// How the daemon is, if that has changed.
        status: Option<Arc<LiveStatus>>,
        /// Whether settings have changed.
        settings: bool,
    },
}

/// The log of changes ends here.
const CHANGES_MAX: usize = 4096;

/// As many samples are kept: with one each second, a quarter of an hour.
const SAMPLES_MAX: usize = 900;

impl Default for StatusStore {
    fn default() -> StatusStore {
        StatusStore::new()
    }
}

impl StatusStore {
    /// An empty store.
    pub fn new() -> StatusStore {
        StatusStore {
            run: now_ms(),
            version: AtomicU64::new(0),
            alive_ms: AtomicU64::new(now_ms()),
            state: Mutex::default(),
        }
    }

    /// Tells this daemon from the one before.
    pub fn run(&self) -> u64 {
        self.run
    }

    /// The number of the last change.
    pub fn version(&self) -> u64 {
        self.version.load(Ordering::Acquire)
    }

    /// The daemon begins, with this plan: what was shown before is of another one.
    pub fn begin(&self, plan: Value) {
        let mut state = self.lock();
        // What was counted goes on: it is of the process.
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

    /// Everything was looked at once.
    pub fn set_ready(&self) {
        self.lock().is_ready = true;
    }

    /// The daemon is not stuck.
    pub fn pulse(&self) {
        self.alive_ms.store(now_ms(), Ordering::Relaxed);
    }

    /// Shows a frame, in place of what was shown of it. Figures of one that is still done stay.
    pub fn update(&self, mut view: FrameView) {
        let mut state = self.lock();
        let rank = NameOrder(view.summary.name.clone());
        let old = state.frames.remove(&rank);
        if let Some(old) = &old {
            state.unlink(old);
            let is_same = old.summary.state == view.summary.state && old.outputs == view.outputs;
            if is_same && old.summary.reason == view.summary.reason {
                view.summary.since_ms = old.summary.since_ms;
            }
            if view.figures.is_none() && is_same {
                view.figures.clone_from(&old.figures);
            }
        }
        let is_news = old.is_none_or(|old| *old != view);
        state.link(&rank, &view);
        state.frames.insert(rank.clone(), Arc::new(view));
        if is_news {
            self.note(&mut state, StatusChange::Frame(rank));
        }
    }

    /// A frame is gone, or is none.
    pub fn remove(&self, name: &str) {
        let mut state = self.lock();
        let rank = NameOrder(name.into());
        if let Some(old) = state.frames.remove(&rank) {
            state.unlink(&old);
            self.note(&mut state, StatusChange::Frame(rank));
        }
    }

    /// A stage has begun of the frame whose outputs are called so.
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

    /// Shows the settings of a sequence.
    pub fn set_sequence(&self, name: String, record: SequenceRecord) {
        let mut state = self.lock();
        state.sequences.insert(name, Arc::new(record));
        self.note(&mut state, StatusChange::Settings);
    }

    /// How the daemon is. Comes about once a second, and makes a sample for the chart.
    pub fn set_status(&self, status: LiveStatus) {
        self.pulse();
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

    /// What was counted by now.
    pub fn set_counters(&self, counters: Counters) {
        self.lock().counters = counters;
    }

    /// Up to `limit` frames after that of this name; from the first one on without it.
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

    /// The frame of this name.
    pub fn frame(&self, name: &str) -> Option<Arc<FrameView>> {
        self.lock().frames.get(&NameOrder(name.into())).map(Arc::clone)
    }

    /// Where the output of this name is.
    pub fn file(&self, name: &str) -> Option<PathBuf> {
        let state = self.lock();
        let frame = state.frames.get(state.by_output.get(name)?)?;
        frame.outputs.iter().find(|output| output.name == name).map(|output| output.path.clone())
    }

    /// What the daemon was asked for, and the settings of each sequence.
    pub fn settings(&self) -> (Arc<Value>, Vec<Arc<SequenceRecord>>) {
        let state = self.lock();
        (Arc::clone(&state.plan), state.sequences.values().map(Arc::clone).collect())
    }

    /// How the daemon is.
    pub fn status(&self) -> (Arc<LiveStatus>, StateCounts) {
        let state = self.lock();
        (Arc::clone(&state.status), state.counts)
    }

    /// How many results are to be expected, and when.
    pub fn forecast(&self) -> Forecast {
        let state = self.lock();
        Forecast::new(&state.counts, state.samples.iter())
    }

    /// How it was in the last quarter of an hour.
    pub fn samples(&self) -> Vec<StatusSample> {
        self.lock().samples.iter().copied().collect()
    }

    /// What was counted since the daemon began.
    pub fn counters(&self) -> Counters {
        self.lock().counters.clone()
    }

    /// Whether everything was looked at once.
    pub fn is_ready(&self) -> bool {
        self.lock().is_ready
    }

    /// Whether the daemon has given a sign of life of late.
    pub fn is_alive(&self) -> bool {
        now_ms().saturating_sub(self.alive_ms.load(Ordering::Relaxed)) < STUCK_AFTER_MS
    }

    /// What has changed after `version`, or the first part of it: no more than `limit` changes are looked at.
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
        // What a panic left half done is replaced with the next change of the frame.
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl StoreState {
    fn link(&mut self, rank: &NameOrder, view: &FrameView) {
        *self.counts.of(view.summary.state) += 1;
        self.by_stem.insert(view.stem.clone(), rank.clone());
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

/// A daemon that has said nothing for so long is stuck.
const STUCK_AFTER_MS: u64 = 30_000;

/// Milliseconds since 1970.
pub fn now_ms() -> u64 {
    let since = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    u64::try_from(since.as_millis()).unwrap_or(u64::MAX)
}

#[cfg(test)]
mod tests;
