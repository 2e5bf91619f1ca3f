//! Every frame that the daemon knows of, and how far it is.
//!
//! ```text
//!                  ┌──────── written again ─────────────────────────┐
//!                  ▼                                                │
//!   (seen) ──▶ settling ──▶ held ──▶ queued or under way ──▶ done ──┤
//!                  │   no settings yet      │                       │
//!                  │                        ├──▶ retrying           │
//!                  └──▶ ignored             └──▶ failed ────────────┘
//!                  └──▶ gone through ──▶ steps      a file with several: each is a frame of its own, held at once
//! ```

use std::cmp::Reverse;
use std::collections::{BinaryHeap, HashMap};
use std::path::Path;
use std::sync::Arc;
use std::time::Instant;

use crate::pipeline::{FileStamp, step_of};

use super::readiness::Candidate;

/// A file in a watched folder, or a step of one. One file in two of them is two frames: what becomes of it may differ.
#[derive(Clone, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub(super) struct FrameId {
    /// The index of its root.
    pub(super) root: usize,
    /// Absolute.
    pub(super) path: Arc<Path>,
}

impl FrameId {
    pub(super) fn new(root: usize, path: &Path) -> FrameId {
        FrameId { root, path: path.into() }
    }

    /// The file of a step; `None` of what is a file.
    pub(super) fn file(&self) -> Option<FrameId> {
        step_of(&self.path).map(|(file, _)| FrameId::new(self.root, file))
    }
}

/// All frames.
#[derive(Debug, Default)]
pub(super) struct Frames {
    all: HashMap<FrameId, FrameState>,
    alarms: BinaryHeap<Reverse<(Instant, FrameId)>>,
}

/// What is known of a frame.
#[derive(Debug)]
pub(super) struct FrameState {
    /// The index of its sequence.
    pub(super) sequence: usize,
    /// How far it is.
    pub(super) phase: Phase,
    /// The fingerprint of what it was queued to be converted with, or of what the journal says it was made with where
    /// that may change while the daemon runs; else empty.
    pub(super) made_with: String,
    /// Failures in a row that may pass by themselves.
    pub(super) attempt_count: u32,
    /// The scan that saw it last.
    pub(super) scan_count: u64,
    /// When it asked to be looked at.
    alarm_at: Option<Instant>,
}

impl FrameState {
    /// Whether it is not complete, and time alone does not help: it waits for another file.
    pub(super) fn is_stuck(&self) -> bool {
        matches!(self.phase, Phase::Settling(_)) && self.alarm_at.is_none()
    }
}

/// How far a frame is.
#[derive(Debug)]
pub(super) enum Phase {
    /// Its file may still be written.
    Settling(Candidate),
    /// Complete; its sequence has no settings yet.
    Held(FileStamp),
    /// Waits for the pipeline, or is in it.
    Queued(FileStamp),
    /// Failed, and is tried again at this time.
    Retrying(FileStamp, Instant),
    /// Its outputs are there.
    Done(FileStamp),
    /// Failed; only another file helps.
    Failed(FileStamp),
    /// No particles: some other file, or one of our own outputs.
    Ignored(FileStamp),
    /// Complete, and of a kind that may have several steps: which it has is being found out.
    GoneThrough(FileStamp),
    /// A file with several steps, of which each is a frame.
    Steps(FileStamp),
}

impl Phase {
    /// The file that this phase is about.
    pub(super) fn stamp(&self) -> FileStamp {
        match self {
            Phase::Settling(candidate) => *candidate.stamp(),
            Phase::Held(stamp)
            | Phase::Queued(stamp)
            | Phase::Retrying(stamp, _)
            | Phase::Done(stamp)
            | Phase::Failed(stamp)
            | Phase::Ignored(stamp)
            | Phase::GoneThrough(stamp)
            | Phase::Steps(stamp) => *stamp,
        }
    }
}

/// How many frames are how far.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Tally {
    pub(super) settling: usize,
    /// Of these, those that time does not help: they wait for another file.
    pub(super) stuck: usize,
    pub(super) held: usize,
    /// Waiting or under way.
    pub(super) queued: usize,
    /// Files whose steps are being found.
    pub(super) gone_through: usize,
    pub(super) retrying: usize,
    pub(super) done: usize,
    pub(super) failed: usize,
}

impl Frames {
    pub(super) fn get(&self, id: &FrameId) -> Option<&FrameState> {
        self.all.get(id)
    }

    pub(super) fn get_mut(&mut self, id: &FrameId) -> Option<&mut FrameState> {
        self.all.get_mut(id)
    }

    /// A frame that was not known.
    pub(super) fn insert(&mut self, id: &FrameId, sequence: usize, candidate: Candidate, scan_count: u64) {
        let state = FrameState {
            sequence,
            phase: Phase::Settling(candidate),
            made_with: String::new(),
            attempt_count: 0,
            scan_count,
            alarm_at: None,
        };
        self.all.insert(id.clone(), state);
    }

    pub(super) fn remove(&mut self, id: &FrameId) {
        self.all.remove(id);
    }

    pub(super) fn iter(&self) -> impl Iterator<Item = (&FrameId, &FrameState)> {
        self.all.iter()
    }

    /// Has [`Frames::next_alarm`] name the frame at this time, unless it will be named before.
    pub(super) fn set_alarm(&mut self, id: &FrameId, at: Instant) {
        if let Some(frame) = self.all.get_mut(id)
            && frame.alarm_at.is_none_or(|earlier| at < earlier)
        {
            frame.alarm_at = Some(at);
            self.alarms.push(Reverse((at, id.clone())));
        }
    }

    /// When the first alarm is due.
    pub(super) fn alarm_at(&self) -> Option<Instant> {
        self.alarms.peek().map(|Reverse((at, _))| *at)
    }

    /// A frame whose alarm is due.
    pub(super) fn next_alarm(&mut self, now: Instant) -> Option<FrameId> {
        if self.alarm_at()? > now {
            return None;
        }
        let Reverse((at, id)) = self.alarms.pop()?;
        if let Some(frame) = self.all.get_mut(&id)
            && frame.alarm_at == Some(at)
        {
            frame.alarm_at = None;
        }
        Some(id)
    }

    pub(super) fn tally(&self) -> Tally {
        let mut tally = Tally::default();
        for frame in self.all.values() {
            match frame.phase {
                Phase::Settling(_) => {
                    tally.settling += 1;
                    tally.stuck += usize::from(frame.is_stuck());
                }
                Phase::Held(_) => tally.held += 1,
                Phase::Queued(_) => tally.queued += 1,
                Phase::GoneThrough(_) => tally.gone_through += 1,
                Phase::Retrying(..) => tally.retrying += 1,
                Phase::Done(_) => tally.done += 1,
                Phase::Failed(_) => tally.failed += 1,
                Phase::Ignored(_) | Phase::Steps(_) => {}
            }
        }
        tally
    }
}
