//! The table of all known frames, and the phase of each.
//!
//! ```text
//!   (seen) ──▶ settling ──▶ held ──▶ queued ──▶ in progress ──▶ done
//!               │   │        ▲                    │   │
//!               │   │        └─ due ─ retrying ◀──┘   └──▶ failed
//!               │   └──▶ finding steps ──▶ steps     each step is a frame, and settles at once
//!               └──▶ ignored
//! ```
//!
//! A file that was written again settles again, whatever its phase; if it is in progress, after its conversion.

use std::cmp::Reverse;
use std::collections::{BinaryHeap, HashMap};
use std::hash::{Hash, Hasher};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Instant;

use crate::pipeline::{
    FileFrames, FileStamp, FrameFile, NamedFiles, ObstacleStamps, Reason, RecordedAround, output_stem,
};

use super::completeness::Candidate;

/// A file in a watched folder, or a step of a file. A file in two watched folders is two frames, because
/// their outputs differ.
///
/// Its path is the canonical path of its root followed by names, so equal paths have equal bytes. Comparing
/// the bytes is several times faster than comparing the components, as [`Path`] does, and frames are looked
/// up many times.
#[derive(Clone, Debug, Eq, PartialOrd, Ord)]
pub(crate) struct FrameId {
    /// The index of its root.
    pub(crate) root: usize,
    /// The absolute path.
    pub(crate) path: Arc<Path>,
    /// Whether it is a step of a file. Part of the id, because the path alone does not show it without the
    /// file system.
    is_step: bool,
}

impl PartialEq for FrameId {
    fn eq(&self, other: &FrameId) -> bool {
        let is_same_path = self.path.as_os_str() == other.path.as_os_str();
        is_same_path && self.root == other.root && self.is_step == other.is_step
    }
}

impl Hash for FrameId {
    fn hash<H: Hasher>(&self, state: &mut H) {
        self.path.as_os_str().hash(state);
        self.root.hash(state);
    }
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

    /// The path of the file that it is, or to which the step belongs.
    pub(crate) fn file_path(&self) -> &Path {
        if self.is_step { self.path.parent().unwrap_or(&self.path) } else { &self.path }
    }

    /// The parts of its name; `root` is the path of its root.
    pub(crate) fn frame_file(&self, root: &Path) -> FrameFile {
        FrameFile::known(self.path.to_path_buf(), self.is_step).in_watched_folder(root)
    }

    /// The folder of its outputs: the folder of the file within `root`, mirrored below `out`.
    pub(crate) fn mirrored_folder(&self, root: &Path, out: &Path) -> PathBuf {
        let folder = self.file_path().parent();
        folder.and_then(|folder| within(folder, root)).map_or_else(|| out.to_owned(), |inner| out.join(inner))
    }

    /// The base name of its outputs.
    pub(crate) fn output_stem(&self) -> String {
        output_stem(&self.path, self.is_step)
    }
}

/// The path of a file or folder within `folder`, if it lies there. Nearly all files lie directly in `folder`;
/// the components of the paths are compared only for the others.
pub(crate) fn within<'a>(path: &'a Path, folder: &Path) -> Option<&'a Path> {
    if path.as_os_str() == folder.as_os_str() {
        return Some(Path::new(""));
    }
    match (path.parent(), path.file_name()) {
        (Some(parent), Some(name)) if parent.as_os_str() == folder.as_os_str() => Some(Path::new(name)),
        _ => path.strip_prefix(folder).ok(),
    }
}

/// All frames.
#[derive(Debug, Default)]
pub(crate) struct FrameTable {
    all: HashMap<FrameId, FrameState>,
    alarms: BinaryHeap<Reverse<(Instant, FrameId)>>,
    /// The number of frames of each sequence that are being inspected.
    inspected_in: HashMap<usize, usize>,
    inspection_count: u64,
}

/// The state of a frame.
#[derive(Debug)]
pub(crate) struct FrameState {
    /// The index of its sequence.
    pub(crate) sequence: usize,
    pub(crate) phase: FramePhase,
    /// The stamp of its file: while it settles as last seen, and then that of the complete file.
    pub(crate) stamp: FileStamp,
    /// If it failed, the files that it was read from besides its own, if there are any.
    pub(crate) named: Option<Arc<NamedFiles>>,
    /// Whether the frame has too few particles to measure the spacing of its sequence.
    pub(crate) is_sparse: bool,
    /// A hash of the stamps of its obstacles when the frame was queued, or that of its record.
    pub(crate) obstacle_stamp: Option<String>,
    /// Number of consecutive failures that may be temporary.
    pub(crate) attempt_count: u32,
    /// The number of the scan that last saw it.
    pub(crate) scan_count: u64,
    /// Whether it was inspected at least once.
    pub(crate) was_inspected: bool,
    /// Whether a writer closed its file, which must then be read again.
    pub(crate) was_closed: bool,
    /// Since when it is held for the frames around it.
    pub(crate) waits_since: Option<Instant>,
    /// The frames around it for which it was converted again.
    pub(crate) tried_around: Option<Vec<TriedAround>>,
    /// The stamps of its obstacles at the last inspection; `None` without obstacles.
    pub(crate) obstacles: Option<Arc<ObstacleStamps>>,
    /// Why it is to be converted.
    pub(crate) reason: Option<Reason>,
    /// When to inspect it again.
    alarm_at: Option<Instant>,
    /// The number of the inspection in progress.
    inspection: Option<u64>,
}

/// The state of a frame around another one.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct TriedAround {
    /// Its content, as far as it is known.
    pub(crate) around: RecordedAround,
    /// If it failed, the stamp of its file, and a hash of those of its obstacles.
    pub(crate) failed: Option<(FileStamp, Option<String>)>,
}

impl FramePhase {
    /// Whether the file is a frame, as far as is known, and not one without particles or with several steps.
    pub(crate) fn is_of_frame(self) -> bool {
        !matches!(self, FramePhase::Ignored | FramePhase::Steps)
    }
}

impl FrameState {
    /// Whether the frame is incomplete and waits for another file, such as a sentinel, rather than for a
    /// time.
    pub(crate) fn is_stuck(&self) -> bool {
        matches!(self.phase, FramePhase::Settling(_)) && self.alarm_at.is_none() && self.inspection.is_none()
    }
}

/// The phase of a frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum FramePhase {
    /// Its file may still be written.
    Settling(Candidate),
    /// Complete, but its sequence has no settings yet, or it waits for the frames around it.
    Held,
    /// Waiting for the pipeline.
    Queued,
    /// In the pipeline. Until it finishes, changes of its file have no effect.
    InProgress,
    /// Failed; the retry is due at this time.
    Retrying(Instant),
    /// Its outputs exist.
    Done,
    /// Failed; only a changed file can help or, depending on its recorded state, a restart. A refused frame is
    /// checked again at each scan, because the other files may have changed.
    Failed,
    /// No particles: an unrelated file, or an output of this program.
    Ignored,
    /// Complete, and of a format that may contain several steps; a search for them is in progress.
    FindingSteps,
    /// A file with several steps, each of which is a frame.
    Steps,
}

/// The steps of a file.
#[derive(Debug)]
pub(crate) struct FileSteps {
    /// The index of each step.
    pub(crate) index_of: HashMap<FrameId, usize>,
    pub(crate) found: FileFrames,
}

impl FileSteps {
    /// Whether a step is unchanged since its file had this stamp.
    pub(crate) fn is_kept_since(&self, id: &FrameId, stamp: &FileStamp) -> bool {
        self.index_of.get(id).is_some_and(|&index| index < self.found.unchanged_since(stamp))
    }
}

/// The number of frames in each phase.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct FrameCounts {
    pub(crate) settling: usize,
    /// Settling frames that wait for another file rather than for a time.
    pub(crate) stuck: usize,
    pub(crate) held: usize,
    /// [`FramePhase::Queued`] or [`FramePhase::InProgress`].
    pub(crate) queued: usize,
    /// Files whose steps are being indexed.
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

    /// Adds a new frame.
    pub(crate) fn insert(&mut self, id: &FrameId, sequence: usize, candidate: Candidate, scan_count: u64) {
        let state = FrameState {
            sequence,
            phase: FramePhase::Settling(candidate),
            stamp: *candidate.stamp(),
            named: None,
            is_sparse: false,
            obstacle_stamp: None,
            attempt_count: 0,
            scan_count,
            was_inspected: false,
            was_closed: false,
            waits_since: None,
            tried_around: None,
            obstacles: None,
            reason: None,
            alarm_at: None,
            inspection: None,
        };
        self.all.insert(id.clone(), state);
    }

    pub(crate) fn remove(&mut self, id: &FrameId) {
        if let Some(mut frame) = self.all.remove(id) {
            end_inspection(&mut frame, &mut self.inspected_in);
        }
    }

    /// Starts an inspection of a frame, which replaces any inspection in progress. Returns its number, and
    /// the stamp of the file.
    pub(crate) fn begin_inspection(&mut self, id: &FrameId) -> Option<(u64, FileStamp)> {
        let frame = self.all.get_mut(id)?;
        self.inspection_count += 1;
        if frame.inspection.replace(self.inspection_count).is_none() {
            *self.inspected_in.entry(frame.sequence).or_default() += 1;
        }
        Some((self.inspection_count, frame.stamp))
    }

    /// Ends the inspection with this number, and returns its frame. Returns `None` if another one was started
    /// since, or the frame has changed.
    pub(crate) fn take_inspection(&mut self, id: &FrameId, number: u64) -> Option<&mut FrameState> {
        let frame = self.all.get_mut(id).filter(|frame| frame.inspection == Some(number))?;
        end_inspection(frame, &mut self.inspected_in);
        Some(frame)
    }

    /// Sets the phase of a frame, which cancels the inspection in progress. Returns its sequence.
    pub(crate) fn set_phase(&mut self, id: &FrameId, phase: FramePhase) -> Option<usize> {
        let frame = self.all.get_mut(id)?;
        end_inspection(frame, &mut self.inspected_in);
        frame.phase = phase;
        Some(frame.sequence)
    }

    /// Whether any frame is being inspected, of this sequence or of all.
    pub(crate) fn is_inspecting(&self, sequence: Option<usize>) -> bool {
        match sequence {
            Some(sequence) => self.inspected_in.contains_key(&sequence),
            None => !self.inspected_in.is_empty(),
        }
    }

    /// The ids of the frames for which a condition holds.
    pub(crate) fn ids_of(&self, holds: impl Fn(&FrameId, &FrameState) -> bool) -> Vec<FrameId> {
        self.all.iter().filter(|(id, frame)| holds(id, frame)).map(|(id, _)| id.clone()).collect()
    }

    pub(crate) fn iter(&self) -> impl Iterator<Item = (&FrameId, &FrameState)> {
        self.all.iter()
    }

    /// Sets the alarm of a frame: [`FrameTable::next_alarm`] returns the frame at this time, unless an
    /// earlier alarm is set.
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

    /// The next frame whose alarm is due.
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
                FramePhase::Queued | FramePhase::InProgress => counts.queued += 1,
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

/// Ends the inspection of a frame, if one is in progress; `inspected_in` counts those of each sequence.
fn end_inspection(frame: &mut FrameState, inspected_in: &mut HashMap<usize, usize>) {
    if frame.inspection.take().is_some()
        && let Some(count) = inspected_in.get_mut(&frame.sequence)
    {
        *count -= 1;
        if *count == 0 {
            inspected_in.remove(&frame.sequence);
        }
    }
}
