//! Files with several frames: their steps come and go with them.
//!
//! ```text
//!   dump.lammpstrj   settling ──▶ gone through ──▶ steps ──── written again ────▶ settling ..
//!                                 (another thread)   │
//!   step=0                                           ├──▶ done already, by the journal
//!   step=1000                                        ├──▶ held ──▶ queued ──▶ done
//!   step=2000                                        └──▶ held ..
//! ```
//!
//! Where steps begin is known when all of the file was read, which takes minutes for a large one on a slow disk: so that
//! is not done by the loop, and whoever reads a step that was found does not wait for it.
//!
//! A file to which steps are appended is another file each time it has settled. Only what was appended is gone through then;
//! steps that are done, and of which the file is known to be as it was, are left as they are. Those of a file that was written
//! anew are looked at again: each is read, and may be found to be what its outputs were made from.

use std::collections::HashMap;
use std::sync::atomic::AtomicBool;
use std::time::Instant;

use crate::pipeline::{FileFrames, FileStamp, FrameError, Stage, frames_in_unless, may_hold_several};

use super::frames::{FrameId, Phase};
use super::readiness::Candidate;
use super::rounds::Daemon;
use super::scan::Seen;

/// The steps of a file.
#[derive(Debug)]
pub(super) struct FileSteps {
    /// The place of each among them.
    index_of: HashMap<FrameId, usize>,
    found: FileFrames,
}

impl FileSteps {
    /// Whether a step is as it was when its file had this stamp.
    fn is_kept_since(&self, id: &FrameId, stamp: &FileStamp) -> bool {
        self.index_of.get(id).is_some_and(|&index| index < self.found.kept_since(stamp))
    }
}

/// A complete file that is to be gone through.
#[derive(Debug)]
pub(super) struct StepsOrder {
    id: FrameId,
    stamp: FileStamp,
}

/// What came of it.
#[derive(Debug)]
pub(super) struct FoundSteps {
    id: FrameId,
    stamp: FileStamp,
    /// Its frames; `None` if the file was written again meanwhile.
    frames: Result<Option<FileFrames>, FrameError>,
}

/// Goes through a file; when all is over, not to its end.
pub(super) fn find_steps(order: StepsOrder, is_over: &AtomicBool) -> FoundSteps {
    let StepsOrder { id, stamp } = order;
    let is_same = || FileStamp::of_path(&id.path).is_ok_and(|now| now == stamp);
    // It may have waited for the files before it.
    if !is_same() {
        return FoundSteps { id, stamp, frames: Ok(None) };
    }
    let read = FrameError::catch(&id.path, Stage::Read, || frames_in_unless(&id.path, is_over));
    let read = read.and_then(|read| read.map_err(|error| FrameError::file(&id.path, Stage::Read, error)));
    let frames = if is_same() { read.map(Some) } else { Ok(None) };
    FoundSteps { id, stamp, frames }
}

impl Daemon<'_> {
    /// Has a complete file gone through that may have several steps. Returns whether it says what the file is.
    pub(super) fn ask_for_steps(&mut self, id: &FrameId, stamp: FileStamp) -> bool {
        if id.file().is_some() {
            return false;
        }
        match may_hold_several(&id.path) {
            Ok(true) => {
                self.set_phase(id, Phase::GoneThrough(stamp));
                // The thread at the other end lives as long as the loop.
                let _ = self.to_find_steps.send(StepsOrder { id: id.clone(), stamp });
                true
            }
            Ok(false) => {
                self.forget_steps(id);
                false
            }
            // It may pass: the steps are not forgotten for it.
            Err(error) => {
                self.failed_frame(id, stamp, &FrameError::file(&id.path, Stage::Read, error));
                true
            }
        }
    }

    /// A file was gone through.
    pub(super) fn found_steps(&mut self, found: FoundSteps) {
        let FoundSteps { id, stamp, frames } = found;
        // Of a file that was written again since, this says nothing.
        let phase = self.frames.get(&id).map(|frame| &frame.phase);
        if !matches!(phase, Some(Phase::GoneThrough(asked)) if *asked == stamp) {
            return;
        }
        match frames {
            Ok(None) => self.start_over(&id),
            Ok(Some(found)) if found.has_several() => self.take_steps(&id, stamp, found),
            Ok(Some(_)) => {
                self.forget_steps(&id);
                self.hold(&id, stamp);
            }
            Err(error) => {
                self.forget_steps(&id);
                self.failed_frame(&id, stamp, &error);
            }
        }
    }

    /// A complete file has several steps: each goes on by itself.
    fn take_steps(&mut self, id: &FrameId, stamp: FileStamp, found: FileFrames) {
        let steps: Vec<FrameId> = found.paths().map(|frame| FrameId::new(id.root, &frame)).collect();
        let index_of = steps.iter().cloned().enumerate().map(|(index, step)| (step, index)).collect();
        let of_file = FileSteps { index_of, found };
        let before = self.steps_of.remove(id).map(|before| before.index_of).unwrap_or_default();
        let gone = before.into_keys().filter(|step| !of_file.index_of.contains_key(step));
        let gone: Vec<FrameId> = gone.collect();
        self.steps_of.insert(id.clone(), of_file);
        for step in gone {
            self.forget(&step);
        }
        self.give_way(id);
        self.set_phase(id, Phase::Steps(stamp));
        for step in &steps {
            self.take_step(id, step, stamp);
            self.pulse();
        }
    }

    /// A step of a file that has settled, and is this one now.
    fn take_step(&mut self, file: &FrameId, id: &FrameId, stamp: FileStamp) {
        let seen = Seen { stamp, age: None };
        let candidate = Candidate::new(Instant::now(), &seen, false);
        let is_kept =
            |done: &FileStamp| self.steps_of.get(file).is_some_and(|steps| steps.is_kept_since(id, done));
        match self.frames.get(id).map(|frame| &frame.phase) {
            None => {
                let sequence = self.sequence_of(id);
                self.frames.insert(id, sequence, candidate, self.scan_count);
                self.show(id);
            }
            Some(Phase::Done(done)) if *done == stamp => return self.check_outputs(id),
            Some(Phase::Done(done)) if is_kept(done) => {
                self.set_phase(id, Phase::Done(stamp));
                return self.check_outputs(id);
            }
            Some(Phase::Settling(_)) => {}
            Some(phase) if phase.stamp() == stamp => return,
            // Under way: it is looked at again when its outcome comes.
            Some(Phase::Queued(queued)) if !self.queue.remove(id, queued.modified_ns) => return,
            Some(_) => self.settle(id, candidate),
        }
        let Some(sequence) = self.frames.get(id).map(|frame| frame.sequence) else { return };
        match self.known_phase(id, sequence, &stamp) {
            Some(phase) => self.set_phase(id, phase),
            None => self.hold(id, stamp),
        }
    }

    /// The file of a step was seen.
    pub(super) fn sight_step(&mut self, file: &FrameId, id: &FrameId, seen: &Seen) {
        match self.frames.get(file).map(|frame| &frame.phase) {
            Some(Phase::Steps(stamp)) if *stamp == seen.stamp => {
                match self.steps_of.get(file).is_some_and(|steps| steps.index_of.contains_key(id)) {
                    true => self.take_step(file, id, seen.stamp),
                    false => self.forget(id),
                }
            }
            None | Some(Phase::Settling(_) | Phase::GoneThrough(_)) => self.sight(file, seen, false),
            // It has no steps any more.
            Some(phase) if phase.stamp() == seen.stamp => self.forget(id),
            Some(_) => self.sight(file, seen, false),
        }
    }

    /// The file of these steps was written again. What is not under way yet waits until it is known where they are now.
    pub(super) fn unqueue_steps(&mut self, file: &FrameId, seen: &Seen) {
        for step in self.known_steps(file) {
            if let Some(Phase::Queued(stamp)) = self.frames.get(&step).map(|frame| &frame.phase)
                && self.queue.remove(&step, stamp.modified_ns)
            {
                self.settle(&step, Candidate::new(Instant::now(), seen, false));
            }
        }
    }

    /// Steps that are done stay so only while their outputs are there.
    pub(super) fn check_steps(&mut self, file: &FrameId) {
        for step in self.known_steps(file) {
            if matches!(self.frames.get(&step).map(|frame| &frame.phase), Some(Phase::Done(_))) {
                self.check_outputs(&step);
            }
        }
    }

    /// A file is not there any more, or has no steps any more.
    pub(super) fn forget_steps(&mut self, file: &FrameId) {
        let steps = self.known_steps(file);
        self.steps_of.remove(file);
        for step in steps {
            self.forget(&step);
        }
    }

    fn known_steps(&self, file: &FrameId) -> Vec<FrameId> {
        self.steps_of.get(file).into_iter().flat_map(|steps| steps.index_of.keys().cloned()).collect()
    }
}
