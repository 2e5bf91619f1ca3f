//! Frames that depend on those around them (`--temporal`, `--spray`, `--rest`, `--time-step`): when each may start, and when it is
//! converted again.
//!
//! ```text
//!   held ──▶ waits until the frames around it are complete, or for --temporal-wait ──▶ queued
//!   done ──▶ a frame around it came, failed, or was converted from another content ──▶ held
//! ```
//!
//! Every frame is compared with its record when its conversion ends. A frame is converted again once for each state
//! of the frames around it, so that an error that lasts does not convert it again and again.

use std::path::PathBuf;
use std::sync::Arc;

use crate::pipeline::{AroundFrame, Job, Reason, RecordedAround, UnfinishedState};
use crate::surface::options::{FrameReach, Settings};

use super::frames::{FrameId, FramePhase, FrameState, TriedAround};
use super::sequences::SequenceSettings;
use super::state::Core;

impl Core {
    /// Whether the frames of a root depend on others.
    pub(super) fn depends_on_others(&self, root: usize) -> bool {
        let watch = self.watch(root);
        watch.job() == Job::Surface && watch.choices.needs_frames_around()
    }

    /// The number of a frame, if it has one.
    fn number_of(&self, id: &FrameId) -> Option<i64> {
        id.frame_file(self.root_path(id.root)).number()
    }

    /// A frame was found, or a file turned out to be one.
    pub(super) fn number_frame(&mut self, id: &FrameId, sequence: usize) {
        let Some(number) = self.number_of(id).filter(|_| self.depends_on_others(id.root)) else { return };
        // A second frame with this number takes the first one from between the others.
        self.doubt_around_number(sequence, number);
        if self.sequences.get_mut(sequence).numbered.insert(number, id.clone()) {
            self.doubt_all(sequence);
        }
    }

    /// A frame is gone, or turned out not to be one.
    pub(super) fn unnumber_frame(&mut self, id: &FrameId, sequence: usize) {
        let Some(number) = self.number_of(id).filter(|_| self.depends_on_others(id.root)) else { return };
        if self.sequences.get_mut(sequence).numbered.remove(number, id) {
            self.doubt_all(sequence);
        }
        self.doubt_around_number(sequence, number);
    }

    /// If only one frame has this number, others may be around it, and it around others, until now or from now on.
    fn doubt_around_number(&mut self, sequence: usize, number: i64) {
        let Some(reach) = self.reach_in(sequence) else { return };
        let numbered = &self.sequences.get(sequence).numbered;
        let dependent = numbered.dependent(number, reach);
        let doubtful: Vec<FrameId> = dependent.into_iter().chain(numbered.only(number)).cloned().collect();
        self.doubt(sequence, doubtful);
    }

    /// Other frames than before are around the frames of a sequence.
    pub(super) fn doubt_all(&mut self, sequence: usize) {
        let is_done = |frame: &FrameState| frame.sequence == sequence && frame.phase == FramePhase::Done;
        let done = self.frames.ids_of(|_, frame| is_done(frame));
        self.doubt(sequence, done);
    }

    /// Compares a frame that is done with its record, if it depends on others.
    pub(super) fn doubt_done(&mut self, id: &FrameId) {
        if let Some(sequence) = self.frames.get(id).map(|frame| frame.sequence)
            && self.depends_on_others(id.root)
        {
            self.doubt(sequence, [id.clone()]);
        }
    }

    fn doubt(&mut self, sequence: usize, frames: impl IntoIterator<Item = FrameId>) {
        let mut frames = frames.into_iter().peekable();
        if frames.peek().is_some() {
            self.doubtful_around.entry(sequence).or_default().extend(frames);
        }
    }

    /// The known frames that a frame depends on, with the number of steps and their numbers.
    fn known_around(&self, id: &FrameId, reach: FrameReach) -> Vec<(i32, i64, FrameId)> {
        let Some(frame) = self.frames.get(id).filter(|_| !reach.is_none()) else { return Vec::new() };
        let around = self.sequences.get(frame.sequence).numbered.around(self.number_of(id), reach);
        around.into_iter().map(|(steps, number, id)| (steps, number, id.clone())).collect()
    }

    /// The complete frames that a frame depends on.
    pub(super) fn frames_around(&self, id: &FrameId, settings: &Settings) -> Arc<[AroundFrame]> {
        let around = self.known_around(id, settings.frame_reach()).into_iter();
        let complete = around.filter(|(.., id)| self.is_complete(id));
        complete
            .map(|(steps, number, id)| AroundFrame { steps, path: id.path.to_path_buf(), number })
            .collect()
    }

    fn is_complete(&self, id: &FrameId) -> bool {
        let phase = self.frames.phase(id);
        !matches!(phase, None | Some(FramePhase::Settling(_) | FramePhase::FindingSteps))
    }

    /// Whether a held frame waits for others that it depends on. It waits for files that exist and, unless
    /// [`WatchConfig::once`](crate::watch::config::WatchConfig::once) is set, for frames after it that may still come.
    pub(super) fn awaits_frames_around(&mut self, id: &FrameId, settings: &Settings) -> bool {
        let reach = settings.frame_reach();
        let waits = !reach.is_none() && self.has_to_wait(id, reach);
        let (now, wait) = (self.now.at, self.config.temporal_wait);
        let Some(frame) = self.frames.get_mut(id).filter(|_| waits) else {
            self.waiting_around.remove(id);
            return false;
        };
        let is_new = frame.waits_since.is_none();
        let due = *frame.waits_since.get_or_insert(now) + wait;
        if due <= now {
            self.waiting_around.remove(id);
            return false;
        }
        self.frames.set_alarm(id, due);
        self.waiting_around.insert(id.clone());
        if is_new {
            self.record_state(id, UnfinishedState::Waiting, Some(Reason::FramesAround), None);
        }
        true
    }

    fn has_to_wait(&self, id: &FrameId, reach: FrameReach) -> bool {
        if self.config.once && !self.roots[id.root].was_scanned {
            return true;
        }
        let around = self.known_around(id, reach);
        let is_coming = |id: &FrameId| {
            let is_stuck = self.frames.get(id).is_some_and(FrameState::is_stuck);
            !self.is_complete(id) && !is_stuck
        };
        if around.iter().any(|(.., id)| is_coming(id)) {
            return true;
        }
        let Some((frame, number)) = self.frames.get(id).zip(self.number_of(id)) else { return false };
        !self.config.once && self.sequences.get(frame.sequence).numbered.may_grow_after(number, reach.beside)
    }

    /// A frame is complete or was converted: those around it may have to be converted again.
    pub(super) fn doubt_frames_around(&mut self, id: &FrameId) {
        if let Some(((reach, frame), number)) =
            self.reach_of(id).zip(self.frames.get(id)).zip(self.number_of(id))
        {
            let sequence = frame.sequence;
            let dependent = self.sequences.get(sequence).numbered.dependent(number, reach);
            let dependent: Vec<FrameId> = dependent.into_iter().cloned().collect();
            self.doubt(sequence, dependent);
        }
    }

    /// The frames that a frame depends on; `None` if its settings are unknown.
    fn reach_of(&self, id: &FrameId) -> Option<FrameReach> {
        self.reach_in(self.frames.get(id).filter(|_| self.depends_on_others(id.root))?.sequence)
    }

    fn reach_in(&self, sequence: usize) -> Option<FrameReach> {
        match &self.sequences.get(sequence).settings {
            SequenceSettings::Fixed(settings, _) => Some(settings.frame_reach()),
            _ => None,
        }
    }

    /// Queues held frames that need not wait any longer, and converts frames again whose surroundings have
    /// changed.
    pub(super) fn resolve_frames_around(&mut self) {
        for id in std::mem::take(&mut self.waiting_around) {
            if self.frames.phase(&id) == Some(FramePhase::Held) {
                self.queue_if_ready(&id);
            }
        }
        // Which frames are complete is known once all inspections have ended.
        let is_known = |sequence: usize| {
            self.roots[self.sequences.get(sequence).root].was_scanned
                && !self.frames.is_inspecting(Some(sequence))
        };
        let known: Vec<usize> = self.doubtful_around.keys().copied().filter(|at| is_known(*at)).collect();
        for id in
            known.into_iter().filter_map(|at| self.doubtful_around.remove(&at)).flatten().collect::<Vec<_>>()
        {
            if self.frames.phase(&id) == Some(FramePhase::Done) {
                self.convert_if_changed_around(&id);
            }
        }
    }

    /// Converts a done frame again if those around it are not those that it was made with. Frames that are gone
    /// do not count.
    fn convert_if_changed_around(&mut self, id: &FrameId) {
        let Some(reach) = self.reach_of(id) else { return };
        let done = |id: &FrameId| self.record_of(id).and_then(|record| record.done.as_ref());
        let Some(recorded) = done(id).map(|record| record.around.clone()) else { return };
        let complete = self.known_around(id, reach).into_iter().filter(|(.., id)| self.is_complete(id));
        let mut is_history_known = true;
        let current: Vec<TriedAround> = complete
            .map(|(steps, number, around)| {
                let is_beside = steps.unsigned_abs() <= reach.beside;
                let frame = AroundFrame { steps, path: around.path.to_path_buf(), number };
                let state = self.frames.get(&around);
                let in_phase = |phase: FramePhase| state.filter(|state| state.phase == phase);
                if let Some(record) = in_phase(FramePhase::Done).and(done(&around)) {
                    let obstacles = if is_beside { &*record.obstacles } else { "" };
                    let around = frame.recorded(Some(record.input_hash), obstacles);
                    return TriedAround { around, failed: None };
                }
                let unknown = frame.recorded(None, "");
                if let Some(failed) = in_phase(FramePhase::Failed) {
                    let failed = Some((failed.stamp, failed.obstacle_stamp.clone()));
                    return TriedAround { around: unknown, failed };
                }
                // Until it is done or has failed, its content counts as unchanged.
                is_history_known &= is_beside;
                let known = at_steps(&recorded, steps).filter(|recorded| recorded.name == unknown.name);
                TriedAround { around: known.cloned().unwrap_or(unknown), failed: None }
            })
            .collect();
        let current = with_history(current, reach.beside, &recorded, is_history_known);
        let is_elsewhere = |recorded: &RecordedAround| {
            let known = current.binary_search_by_key(&recorded.steps, |tried| tried.around.steps);
            !known.is_ok_and(|index| current[index].around.name == recorded.name)
                && self.exists_beside(id, &recorded.name)
        };
        // The content of a frame that failed is not known: the pipeline compares it.
        let is_new = |tried: &TriedAround| {
            tried.failed.is_some() || at_steps(&recorded, tried.around.steps) != Some(&tried.around)
        };
        let is_other = current.iter().any(is_new) || recorded.iter().any(is_elsewhere);
        let Some(frame) = self.frames.get_mut(id).filter(|_| is_other) else { return };
        if frame.tried_around.as_ref() == Some(&current) {
            return;
        }
        (frame.tried_around, frame.reason) = (Some(current), Some(Reason::FramesAroundChanged));
        self.log_about(&*id.path, |frame| {
            tracing::info!(%frame, "a frame around it has come, changed or failed: converting it again");
        });
        self.set_phase(id, FramePhase::Held);
        self.queue_if_ready(id);
    }

    /// Whether a complete frame of this name is in the folder of another one.
    fn exists_beside(&self, id: &FrameId, name: &str) -> bool {
        let folder: PathBuf = id.file_path().parent().map_or_else(PathBuf::new, PathBuf::from);
        let path = folder.join(name);
        let beside = if id.is_step() { FrameId::step(id.root, &path) } else { FrameId::new(id.root, &path) };
        beside != *id && self.is_complete(&beside)
    }
}

/// These frames, of which those farther than `beside` steps are one: that of the record, unless all of them are known.
fn with_history(
    all: Vec<TriedAround>,
    beside: u32,
    recorded: &[RecordedAround],
    is_known: bool,
) -> Vec<TriedAround> {
    let (history, beside): (Vec<_>, Vec<_>) =
        all.into_iter().partition(|tried| tried.around.steps.unsigned_abs() > beside);
    let failed = history.iter().find_map(|tried| tried.failed.clone());
    let now = RecordedAround::with_history(history.into_iter().map(|tried| tried.around).collect(), 0);
    let before = recorded.iter().find(|recorded| recorded.is_history() && !is_known).cloned();
    let history = now.into_iter().next().map(|now| TriedAround { around: before.unwrap_or(now), failed });
    history.into_iter().chain(beside).collect()
}

/// The frame by this number of steps later, among frames in order.
fn at_steps(around: &[RecordedAround], steps: i32) -> Option<&RecordedAround> {
    around.binary_search_by_key(&steps, |around| around.steps).ok().and_then(|index| around.get(index))
}
