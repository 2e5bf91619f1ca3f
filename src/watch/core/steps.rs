//! Files with several frames: their steps are added and removed with the file.
//!
//! ```text
//!   dump.lammpstrj   settling ──▶ searched ──────▶ steps ──── written again ────▶ settling ..
//!                                 (another thread)   │
//!   step=0                                           ├──▶ done already, by its record
//!   step=1000                                        ├──▶ held ──▶ queued ──▶ done
//!   step=2000                                        └──▶ held ..
//! ```
//!
//! Finding the steps requires reading the whole file, which takes minutes for a large file on a slow disk. So
//! another thread searches, and steps that are already known are read without waiting for the search.
//!
//! A file to which steps are appended counts as a new file each time it has settled. Then only the appended
//! part is searched, and done steps stay as they are if the earlier part of the file is known to be
//! unchanged. If the file was rewritten, its steps are inspected again: each is read, and may be found to
//! match its outputs.

use std::time::Instant;

use crate::pipeline::{FileFrames, FileStamp, Reason};

use super::completeness::{Candidate, FileHint, Seen};
use super::events::{Effect, FoundSteps, InspectionExtent, SlowRequest, StepsOrder};
use super::frames::{FileSteps, FrameId, FramePhase};
use super::state::Core;

impl Core {
    /// Requests the search of a complete file for steps.
    pub(super) fn find_steps(&mut self, id: &FrameId, conflict: Option<String>) {
        let Some(stamp) = self.frames.get(id).map(|frame| frame.stamp) else { return };
        self.set_phase(id, FramePhase::FindingSteps);
        let order = StepsOrder { id: id.clone(), stamp, conflict };
        self.effects.push(Effect::Slow(SlowRequest::FindSteps(order)));
    }

    /// Handles the steps that were found in a file.
    pub(super) fn on_steps_found(&mut self, found: FoundSteps) {
        let FoundSteps { order: StepsOrder { id, stamp, conflict }, frames } = found;
        // The file has changed since: the result is out of date.
        if !self.is_still(&id, FramePhase::FindingSteps, &stamp) {
            return;
        }
        match frames {
            Ok(None) => self.start_over(&id),
            Ok(Some(found)) if found.has_several() => self.update_steps(&id, stamp, found),
            Ok(Some(_)) => {
                self.forget_steps(&id);
                self.accept(&id, conflict);
            }
            Err(error) => {
                self.forget_steps(&id);
                self.unreadable_frame(&id, error);
            }
        }
    }

    /// Adds the steps of a complete file: each is a frame.
    fn update_steps(&mut self, id: &FrameId, stamp: FileStamp, found: FileFrames) {
        let steps: Vec<FrameId> = found.paths().map(|path| FrameId::step(id.root, &path)).collect();
        let index_of = steps.iter().cloned().enumerate().map(|(index, step)| (step, index)).collect();
        let of_file = FileSteps { index_of, found };
        let before = self.steps_of.remove(id).map(|before| before.index_of).unwrap_or_default();
        let gone = before.into_keys().filter(|step| !of_file.index_of.contains_key(step));
        let gone: Vec<FrameId> = gone.collect();
        self.steps_of.insert(id.clone(), of_file);
        for step in gone {
            self.remove(&step);
        }
        self.release_claim(id);
        self.note_ignored(id, Reason::Steps(steps.len()));
        self.set_phase(id, FramePhase::Steps);
        for step in &steps {
            self.update_step(id, step, stamp);
        }
    }

    /// Handles a step of a file that has settled, and now has this stamp.
    fn update_step(&mut self, file: &FrameId, id: &FrameId, stamp: FileStamp) {
        let candidate = Candidate::new(self.now.at, &Seen { stamp, age: None }, FileHint::Changed);
        let Some(frame) = self.frames.get_mut(id) else {
            return self.add_frame(id, candidate);
        };
        let is_same = frame.stamp == stamp;
        let is_kept = || self.steps_of.get(file).is_some_and(|steps| steps.is_kept_since(id, &frame.stamp));
        match frame.phase {
            FramePhase::Done if is_same => return self.check_outputs(id),
            FramePhase::Done if is_kept() => {
                frame.stamp = stamp;
                self.set_phase(id, FramePhase::Done);
                return self.check_outputs(id);
            }
            FramePhase::Settling(_) => {}
            // It is inspected when its conversion ends.
            FramePhase::InProgress => return,
            _ if is_same => return,
            _ => {}
        }
        self.start_settling(id, candidate);
        self.inspect_settling(id, InspectionExtent::All);
    }

    /// The file of a step was seen.
    pub(super) fn on_step_seen(&mut self, file: &FrameId, id: &FrameId, seen: &Seen, at: Instant) {
        let is_step = self.steps_of.get(file).is_some_and(|steps| steps.index_of.contains_key(id));
        match self.frames.get(file) {
            Some(frame) if frame.stamp == seen.stamp => match frame.phase {
                FramePhase::Steps if is_step => self.update_step(file, id, seen.stamp),
                FramePhase::Settling(_) | FramePhase::FindingSteps => {
                    self.on_file_seen(file, seen, at, FileHint::Changed)
                }
                // The file no longer contains this step.
                _ => self.remove(id),
            },
            _ => self.on_file_seen(file, seen, at, FileHint::Changed),
        }
    }

    /// The file of these steps changed. Steps that are not in progress wait until their positions are known
    /// again.
    pub(super) fn unqueue_steps(&mut self, file: &FrameId, seen: &Seen, at: Instant) {
        for step in self.known_steps(file) {
            if self.frames.phase(&step) == Some(FramePhase::Queued) {
                self.start_settling(&step, Candidate::new(at, seen, FileHint::Changed));
            }
        }
    }

    /// Checks the outputs of done steps, and whether refused steps are still refused.
    pub(super) fn check_steps(&mut self, file: &FrameId) {
        for step in self.known_steps(file) {
            match self.frames.phase(&step) {
                Some(FramePhase::Done) => self.check_outputs(&step),
                Some(FramePhase::Failed) => self.check_failed(&step),
                _ => {}
            }
        }
    }

    /// Reads the steps of a file again: a writer has closed it.
    pub(super) fn read_steps_again(&mut self, file: &FrameId) {
        for step in self.known_steps(file) {
            let Some(frame) = self.frames.get_mut(&step) else { continue };
            match frame.phase {
                FramePhase::Done | FramePhase::Failed => self.read_again(&step),
                // It is read again when its conversion ends.
                FramePhase::InProgress => frame.was_closed = true,
                _ => {}
            }
        }
    }

    /// A file was removed, or no longer has steps.
    pub(super) fn forget_steps(&mut self, file: &FrameId) {
        let steps = self.known_steps(file);
        self.steps_of.remove(file);
        for step in steps {
            self.remove(&step);
        }
    }

    fn known_steps(&self, file: &FrameId) -> Vec<FrameId> {
        self.steps_of.get(file).into_iter().flat_map(|steps| steps.index_of.keys().cloned()).collect()
    }
}
