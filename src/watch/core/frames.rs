//! Every frame that the daemon knows of, and how far it is.
//!
//! ```text
//!                  ┌──────── written again ─────────────────────────┐
//!                  ▼                                                │
//!   (seen) ──▶ settling ──▶ held ──▶ queued ──▶ under way ──▶ done ─┤
//!                  │   no settings yet               │              │
//!                  │                                 ├──▶ retrying  │
//!                  └──▶ ignored                      └──▶ failed ───┘
//!                  └──▶ finding steps ──▶ steps     a file with several: each is a frame of its own, held at once
//! ```

use std::cmp::Reverse;
use std::collections::{BinaryHeap, HashMap};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Instant;

use crate::pipeline::{FileFrames, FileStamp, FrameFile, ObstacleStamps};

use super::completeness::Candidate;

/// A file in a watched folder, or a step of one. A file in two watched folders is two frames: their outputs differ.
#[derive(Clone, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub(crate) struct FrameId {
    /// The index of its root.
    pub(crate) root: usize,
    /// Absolute.
    pub(crate) path: Arc<Path>,
    /// Whether it is a step of a file. Part of the id, because by its path alone only the file system can tell.
    is_step: bool,
}

impl FrameId {
    /// A file.
    pub(crate) fn new(root: usize, path: &Path) -> FrameId {
        FrameId { root, path: path.into(), is_step: false }
    }

    /// A step of a file.
    pub(crate) fn step(root: usize, path: &Path) -> FrameId {
        FrameId { root, path: path.into(), is_step: true }
    }

    pub(crate) fn is_step(&self) -> bool {
        self.is_step
    }

    /// The file of a step; `None` for a file.
    pub(crate) fn file(&self) -> Option<FrameId> {
        self.is_step.then(|| FrameId::new(self.root, self.file_path()))
    }

    /// The path of the file that it is, or is a step of.
    pub(crate) fn file_path(&self) -> &Path {
        if self.is_step { self.path.parent().unwrap_or(&self.path) } else { &self.path }
    }

    /// What its name says.
    pub(crate) fn frame_file(&self) -> FrameFile {
        FrameFile::known(self.path.to_path_buf(), self.is_step)
    }

    /// The file of its outputs, as a path without extension, in this folder for outputs of files in `root`.
    pub(crate) fn mirrored_folder(&self, root: &Path, out: &Path) -> PathBuf {
        let within = self.file_path().parent().and_then(|folder| folder.strip_prefix(root).ok());
        within.map_or_else(|| out.to_owned(), |within| out.join(within))
    }
}

/// All frames.
#[derive(Debug, Default)]
pub(crate) struct FrameTable {
    all: HashMap<FrameId, FrameState>,
    alarms: BinaryHeap<Reverse<(Instant, FrameId)>>,
    /// How many frames of each sequence are being inspected.
    inspected_in: HashMap<usize, usize>,
    inspection_count: u64,
}

/// What is known of a frame.
#[derive(Debug)]
pub(crate) struct FrameState {
    /// The index of its sequence.
    pub(crate) sequence: usize,
    pub(crate) phase: FramePhase,
    /// Its file, as it was when it came into this phase.
    pub(crate) stamp: FileStamp,
    /// Whether it was found to have too few particles to measure the spacing of its sequence.
    pub(crate) is_sparse: bool,
    /// The fingerprint of what it was queued to be converted with, or of what the journal says it was made with where
    /// that may change while the daemon runs; else empty.
    pub(crate) made_with: String,
    /// Failures in a row that may pass by themselves.
    pub(crate) attempt_count: u32,
    /// The scan that saw it last.
    pub(crate) scan_count: u64,
    /// The files of its obstacles at its last inspection; `None` without obstacles.
    pub(crate) obstacles: Option<Arc<ObstacleStamps>>,
    /// When it is to be inspected again.
    alarm_at: Option<Instant>,
    /// The number of the inspection that is under way.
    inspection: Option<u64>,
}

impl FrameState {
    /// Whether it is not complete, and time alone does not help: it waits for another file.
    pub(crate) fn is_stuck(&self) -> bool {
        matches!(self.phase, FramePhase::Settling(_)) && self.alarm_at.is_none() && self.inspection.is_none()
    }
}

/// How far a frame is.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum FramePhase {
    /// Its file may still be written.
    Settling(Candidate),
    /// Complete; its sequence has no settings yet.
    Held,
    /// Waits for a pipeline.
    Queued,
    /// In the pipeline with this number. Until its outcome comes, what is seen of its file changes nothing.
    UnderWay(usize),
    /// Failed, and is tried again at this time.
    Retrying(Instant),
    /// Its outputs are there.
    Done,
    /// Failed; only another file helps.
    Failed,
    /// No particles: some other file, or one of our own outputs.
    Ignored,
    /// Complete, and of a kind that may have several steps: which it has is being found out.
    FindingSteps,
    /// A file with several steps, of which each is a frame.
    Steps,
}

/// The steps of a file.
#[derive(Debug)]
pub(crate) struct FileSteps {
    /// The position of each among them.
    pub(crate) index_of: HashMap<FrameId, usize>,
    pub(crate) found: FileFrames,
}

impl FileSteps {
    /// Whether a step is as it was when its file had this stamp.
    pub(crate) fn is_kept_since(&self, id: &FrameId, stamp: &FileStamp) -> bool {
        self.index_of.get(id).is_some_and(|&index| index < self.found.kept_since(stamp))
    }
}

/// How many frames are in each phase.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct FrameCounts {
    pub(crate) settling: usize,
    /// Of these, those that time does not help: they wait for another file.
    pub(crate) stuck: usize,
    pub(crate) held: usize,
    /// [`FramePhase::Queued`] or [`FramePhase::UnderWay`].
    pub(crate) queued: usize,
    /// Files whose steps are being found.
    pub(crate) finding_steps: usize,
    pub(crate) retrying: usize,
    pub(crate) done: usize,
    pub(crate) failed: usize,
}

impl FrameCounts {
    /// Frames that are neither done nor failed.
    pub(crate) fn left(&self) -> usize {
        self.settling + self.held + self.queued + self.finding_steps + self.retrying
    }
}

impl FrameTable {
    pub(crate) fn get(&self, id: &FrameId) -> Option<&FrameState> {
        self.all.get(id)
    }

    pub(crate) fn get_mut(&mut self, id: &FrameId) -> Option<&mut FrameState> {
        self.all.get_mut(id)
    }

    pub(crate) fn phase(&self, id: &FrameId) -> Option<FramePhase> {
        self.all.get(id).map(|frame| frame.phase)
    }

    /// A frame that was not known.
    pub(crate) fn insert(&mut self, id: &FrameId, sequence: usize, candidate: Candidate, scan_count: u64) {
        let state = FrameState {
            sequence,
            phase: FramePhase::Settling(candidate),
            stamp: *candidate.stamp(),
            is_sparse: false,
            made_with: String::new(),
            attempt_count: 0,
            scan_count,
            obstacles: None,
            alarm_at: None,
            inspection: None,
        };
        self.all.insert(id.clone(), state);
    }

    pub(crate) fn remove(&mut self, id: &FrameId) {
        self.end_inspection(id);
        self.all.remove(id);
    }

    /// Begins an inspection of a frame, in place of one that is under way, and returns its number and
    /// the file to inspect.
    pub(crate) fn begin_inspection(&mut self, id: &FrameId) -> Option<(u64, FileStamp)> {
        self.end_inspection(id);
        let frame = self.all.get_mut(id)?;
        self.inspection_count += 1;
        frame.inspection = Some(self.inspection_count);
        *self.inspected_in.entry(frame.sequence).or_default() += 1;
        Some((self.inspection_count, frame.stamp))
    }

    /// Ends the inspection of this number. Returns false if another was begun since, or the frame has changed.
    pub(crate) fn take_inspection(&mut self, id: &FrameId, number: u64) -> bool {
        let is_current = self.all.get(id).is_some_and(|frame| frame.inspection == Some(number));
        if is_current {
            self.end_inspection(id);
        }
        is_current
    }

    /// Disregards the inspection that is under way.
    pub(crate) fn end_inspection(&mut self, id: &FrameId) {
        if let Some(frame) = self.all.get_mut(id)
            && frame.inspection.take().is_some()
            && let Some(count) = self.inspected_in.get_mut(&frame.sequence)
        {
            *count -= 1;
            if *count == 0 {
                self.inspected_in.remove(&frame.sequence);
            }
        }
    }

    /// Whether a frame is being inspected, of this sequence or of any.
    pub(crate) fn is_inspecting(&self, sequence: Option<usize>) -> bool {
        match sequence {
            Some(sequence) => self.inspected_in.contains_key(&sequence),
            None => !self.inspected_in.is_empty(),
        }
    }

    /// The frames that a condition holds for.
    pub(crate) fn ids_of(&self, holds: impl Fn(&FrameId, &FrameState) -> bool) -> Vec<FrameId> {
        self.all.iter().filter(|(id, frame)| holds(id, frame)).map(|(id, _)| id.clone()).collect()
    }

    pub(crate) fn iter(&self) -> impl Iterator<Item = (&FrameId, &FrameState)> {
        self.all.iter()
    }

    /// Has [`FrameTable::next_alarm`] name the frame at this time, unless it will be named before.
    pub(crate) fn set_alarm(&mut self, id: &FrameId, at: Instant) {
        if let Some(frame) = self.all.get_mut(id)
            && frame.alarm_at.is_none_or(|earlier| at < earlier)
        {
            frame.alarm_at = Some(at);
            self.alarms.push(Reverse((at, id.clone())));
        }
    }

    /// When the first alarm is due.
    pub(crate) fn alarm_at(&self) -> Option<Instant> {
        self.alarms.peek().map(|Reverse((at, _))| *at)
    }

    /// A frame whose alarm is due.
    pub(crate) fn next_alarm(&mut self, now: Instant) -> Option<FrameId> {
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

    pub(crate) fn counts(&self) -> FrameCounts {
        let mut counts = FrameCounts::default();
        for frame in self.all.values() {
            match frame.phase {
                FramePhase::Settling(_) => {
                    counts.settling += 1;
                    counts.stuck += usize::from(frame.is_stuck());
                }
                FramePhase::Held => counts.held += 1,
                FramePhase::Queued | FramePhase::UnderWay(_) => counts.queued += 1,
                FramePhase::FindingSteps => counts.finding_steps += 1,
                FramePhase::Retrying(_) => counts.retrying += 1,
                FramePhase::Done => counts.done += 1,
                FramePhase::Failed => counts.failed += 1,
                FramePhase::Ignored | FramePhase::Steps => {}
            }
        }
        counts
    }
}
