//! From a file that was seen to a frame that is queued, or to the reason why it is not.
//!
//! ```text
//!   sight ──▶ advance ──▶ ready ──▶ release ──▶ enqueue
//!     │          │          │          │
//!     │          │          │          └ its sequence has no settings yet: held
//!     │          │          ├ it may have several steps: gone through, and each goes on by itself
//!     │          │          └ no particles, or its outputs are another's
//!     │          └ known from the journal, or still being written
//!     └ seen before, and unchanged
//! ```

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Instant;

use crate::pipeline::{FileStamp, Frame, FrameFile, Job, OutputOptions, file_of, output_path};
use crate::surface::options::Settings;

use super::decision::{Decision, OutputsNow, SkipReason, decide};
use super::evidence::{completeness_of, sentinel_of};
use super::frames::{FrameId, FrameState, Phase};
use super::journal::{OutputCheck, OutputRecord, Standing};
use super::readiness::{Candidate, Readiness};
use super::rounds::{Daemon, Failure};
use super::scan::Seen;
use super::selection::{Content, content};
use super::sequences::SequenceSettings;

impl Daemon<'_> {
    /// A file of a root was seen.
    pub(super) fn sight(&mut self, id: &FrameId, seen: &Seen, renamed: bool) {
        if let Some(file) = id.file() {
            return self.sight_step(&file, id, seen);
        }
        let candidate = Candidate::new(Instant::now(), seen, renamed);
        let scan_count = self.scan_count;
        let Some(frame) = self.frames.get_mut(id) else {
            let sequence = self.sequence_of(id);
            self.frames.insert(id, sequence, candidate, scan_count);
            self.show(id);
            return self.advance(id);
        };
        frame.scan_count = scan_count;
        let is_same = frame.phase.stamp() == seen.stamp;
        match &mut frame.phase {
            Phase::Settling(candidate) => candidate.see(Instant::now(), seen, renamed),
            Phase::Done(_) if is_same => return self.check_outputs(id),
            Phase::Steps(_) if is_same => return self.check_steps(id),
            _ if is_same => return,
            // Under way: it is looked at again when its outcome comes.
            Phase::Queued(stamp) if !self.queue.remove(id, stamp.modified_ns) => return,
            Phase::Steps(_) => {
                self.unqueue_steps(id, seen);
                self.settle(id, candidate);
            }
            _ => self.settle(id, candidate),
        }
        self.advance(id);
    }

    /// Whatever is known of a frame, its file is another one now.
    pub(super) fn settle(&mut self, id: &FrameId, candidate: Candidate) {
        self.set_phase(id, Phase::Settling(candidate));
        self.failed.remove(id);
        self.refused.remove(id);
        if let Some(frame) = self.frames.get_mut(id) {
            frame.attempt_count = 0;
            self.sequences.get_mut(frame.sequence).sparse.remove(id);
        }
    }

    /// A file is not there any more. What is under way goes on: its outcome says what to do.
    pub(super) fn forget(&mut self, id: &FrameId) {
        let Some(frame) = self.frames.get(id) else { return };
        if let Phase::Queued(stamp) = frame.phase
            && !self.queue.remove(id, stamp.modified_ns)
        {
            return;
        }
        // What waited for its settings need not wait any longer.
        self.dirty_sequences.insert(frame.sequence);
        self.frames.remove(id);
        self.failed.remove(id);
        self.refused.remove(id);
        self.unshow(id);
        self.give_way(id);
        self.forget_steps(id);
    }

    /// The outputs of this frame are nobody's any more: whoever was refused them may have them.
    pub(super) fn give_way(&mut self, id: &FrameId) {
        let claimed = self.claimed_stem(id);
        if self.claims.get(&claimed) != Some(id) {
            return;
        }
        self.claims.remove(&claimed);
        for rival in self.refused.iter().cloned().collect::<Vec<_>>() {
            if self.claimed_stem(&rival) == claimed
                && let Some(stamp) = self.frames.get(&rival).map(|frame| frame.phase.stamp())
            {
                self.refused.remove(&rival);
                self.failed.remove(&rival);
                self.ready(&rival, stamp);
            }
        }
    }

    /// Takes a frame that settles as far as it can go now.
    pub(super) fn advance(&mut self, id: &FrameId) {
        let Some(frame) = self.frames.get(id) else { return };
        let Phase::Settling(candidate) = &frame.phase else { return };
        let (stamp, sequence) = (*candidate.stamp(), frame.sequence);
        if let Some(phase) = self.known_phase(id, sequence, &stamp) {
            return self.set_phase(id, phase);
        }
        let Some(Phase::Settling(candidate)) = self.frames.get(id).map(|frame| &frame.phase) else { return };
        let sentinel = sentinel_of(&self.config.watches[id.root], &id.path, &stamp);
        let patience = self.roots[id.root].patience(self.config);
        let looked = || completeness_of(&id.path);
        match candidate.readiness(Instant::now(), &patience, sentinel, looked) {
            Readiness::Ready(proof) => {
                tracing::debug!(frame = %id.path.display(), "ready: {proof}");
                self.ready(id, stamp);
            }
            Readiness::Waiting { until, why } => {
                tracing::debug!(frame = %id.path.display(), bytes = stamp.size, "waiting because {why}");
                if let Some(until) = until {
                    self.frames.set_alarm(id, until);
                }
            }
        }
    }

    /// What the journal knows of exactly this file: that its outputs are there, or that it cannot be
    /// converted.
    pub(super) fn known_phase(&mut self, id: &FrameId, sequence: usize, stamp: &FileStamp) -> Option<Phase> {
        let wanted = self.output_paths(id);
        let record = self.stores.of_watch(id.root).journal.state().frames.get(&*id.path)?;
        // The record may be of the same file in another root, whose outputs lie elsewhere.
        let is_recorded = |path: &&PathBuf| record.outputs.iter().any(|output| output.path == **path);
        let unrecorded = wanted.iter().find(|path| !is_recorded(path));
        let checks: Vec<OutputCheck> = record.outputs.iter().map(OutputRecord::check).collect();
        let missing = checks.iter().position(|&check| check == OutputCheck::Missing);
        let missing = unrecorded.or(missing.map(|index| &record.outputs[index].path));
        let outputs = match missing {
            Some(path) => OutputsNow::Missing(path),
            None if checks.contains(&OutputCheck::Touched) => OutputsNow::Touched,
            None => OutputsNow::AsRecorded,
        };
        let settings = self.sequences.get(sequence).fingerprint(&self.obstacles[id.root], &id.path);
        let phase = match decide(Some(record), stamp, &settings, outputs) {
            Decision::Skip(SkipReason::Done) => {
                // Its outputs are its own, also when another input comes that would have the same.
                self.claim_own(id).ok().map(|()| Phase::Done(*stamp))?
            }
            Decision::Skip(SkipReason::FailedUnchanged) => {
                let reason = record.reason.clone().unwrap_or_default();
                self.failed.insert(id.clone(), Failure { reason, told_at: None });
                Phase::Failed(*stamp)
            }
            Decision::CompareContent | Decision::Convert(_) => return None,
        };
        // Obstacles may be written again later.
        if !self.obstacles[id.root].is_empty()
            && let Some(frame) = self.frames.get_mut(id)
        {
            frame.made_with = settings;
        }
        Some(phase)
    }

    /// A frame that is done stays so only while its outputs are there, with the bytes that were written.
    pub(super) fn check_outputs(&mut self, id: &FrameId) {
        if !self.outputs_are_there {
            return;
        }
        let Some(stamp) = self.frames.get(id).map(|frame| frame.phase.stamp()) else { return };
        let missing = self.output_paths(id).into_iter().find(|path| !self.listings.has(path));
        if let Some(missing) = missing {
            tracing::info!(frame = %id.path.display(), "{} is gone: converted again", missing.display());
            return self.ready(id, stamp);
        }
        let record = self.stores.of_watch(id.root).journal.state().frames.get(&*id.path);
        let mut recorded = record.into_iter().flat_map(|record| &record.outputs);
        if let Some(changed) = recorded.find(|output| output.check() != OutputCheck::Unchanged) {
            tracing::info!(frame = %id.path.display(), "{} has changed: its content is compared", changed.path.display());
            self.ready(id, stamp);
        }
    }

    /// Frames of a root that went around obstacles, or failed for them, and of which one was written again since, are
    /// converted again. Obstacles are looked at whenever their root is, and nobody hears of them before.
    pub(super) fn look_at_obstacles(&mut self, root: usize) {
        let obstacles = Arc::clone(&self.obstacles[root]);
        if obstacles.is_empty() || !self.outputs_are_there {
            return;
        }
        // What stands still is looked at once, and not for every frame.
        let of_all = obstacles.stand_still().then(|| obstacles.stamps(None));
        let is_other = |id: &FrameId, frame: &FrameState| {
            let of_frame = || obstacles.stamps(FrameFile::new(id.path.to_path_buf()).number());
            let stamps = of_all.clone().unwrap_or_else(of_frame);
            // What was removed is no other obstacle: who takes it away does not take back what was made with it.
            stamps.are_all_there
                && self.sequences.get(frame.sequence).fingerprint_among(&stamps) != frame.made_with
        };
        let is_stale = |id: &FrameId, frame: &FrameState| {
            let is_ended = matches!(frame.phase, Phase::Done(_) | Phase::Failed(_));
            let was_begun = !frame.made_with.is_empty() && !self.refused.contains(id);
            id.root == root && is_ended && was_begun && is_other(id, frame)
        };
        let stale = self.frames.iter().filter(|(id, frame)| is_stale(id, frame));
        let mut stale: Vec<(FrameId, FileStamp)> =
            stale.map(|(id, frame)| (id.clone(), frame.phase.stamp())).collect();
        stale.sort_by(|(one, _), (other, _)| one.cmp(other));
        for (id, stamp) in stale {
            tracing::info!(frame = %id.path.display(), "an obstacle was written again: converted again");
            self.failed.remove(&id);
            if let Some(frame) = self.frames.get_mut(&id) {
                frame.attempt_count = 0;
            }
            self.ready(&id, stamp);
            self.pulse();
        }
    }

    /// A file is complete.
    pub(super) fn ready(&mut self, id: &FrameId, stamp: FileStamp) {
        match content(file_of(&id.path)) {
            Ok(Content::Particles) => {}
            Ok(Content::OwnOutput | Content::NotParticles) => {
                self.forget_steps(id);
                return self.set_phase(id, Phase::Ignored(stamp));
            }
            // Reading it will say what is wrong.
            Err(error) => tracing::debug!(frame = %id.path.display(), "cannot be looked into: {error}"),
        }
        if !self.ask_for_steps(id, stamp) {
            self.hold(id, stamp);
        }
    }

    /// A frame is there to be converted.
    pub(super) fn hold(&mut self, id: &FrameId, stamp: FileStamp) {
        if let Err(conflict) = self.claim(id) {
            return self.refuse(id, stamp, conflict);
        }
        self.set_phase(id, Phase::Held(stamp));
        self.release(id);
    }

    /// Queues a frame that is held, if its sequence has settings.
    pub(super) fn release(&mut self, id: &FrameId) {
        let Some(frame) = self.frames.get(id) else { return };
        let (sequence, stamp) = (frame.sequence, frame.phase.stamp());
        match &self.sequences.get(sequence).settings {
            SequenceSettings::Fixed(settings, _) => {
                let settings = Arc::clone(settings);
                self.enqueue(id, stamp, settings);
            }
            SequenceSettings::Impossible(why) => {
                let why = why.clone();
                self.fail_for_good(id, stamp, why);
            }
            SequenceSettings::Unknown(_) | SequenceSettings::BeingMeasured => {
                self.dirty_sequences.insert(sequence);
            }
        }
    }

    fn enqueue(&mut self, id: &FrameId, stamp: FileStamp, settings: Arc<Settings>) {
        let obstacles = Arc::clone(&self.obstacles[id.root]);
        if let Some(frame) = self.frames.get_mut(id) {
            frame.made_with = self.sequences.get(frame.sequence).fingerprint(&obstacles, &id.path);
        }
        let outputs = self.outputs(id);
        let framing =
            self.frames.get(id).and_then(|frame| self.sequences.get(frame.sequence).framing.clone());
        let frame = Frame {
            input: id.path.to_path_buf(),
            job: Job::of(&id.path),
            stem: stem(&id.path),
            settings,
            outputs,
            number: FrameFile::new(id.path.to_path_buf()).number(),
            obstacles,
            framing,
        };
        let record = self.stores.of_watch(id.root).journal.state().frames.get(&*id.path);
        for output in record.into_iter().flat_map(|record| &record.outputs) {
            if let Some(state) = output.state {
                self.output_states.put(&output.path, state);
            }
        }
        self.set_phase(id, Phase::Queued(stamp));
        self.note(id, Standing::Queued, stamp, None);
        self.queue.push(id, frame, stamp.modified_ns);
    }

    /// What is written of a frame, and where: its sub-folder is mirrored below that of the outputs.
    fn outputs(&mut self, id: &FrameId) -> Arc<OutputOptions> {
        let root = &self.roots[id.root].path;
        let out = &self.stores.of_watch(id.root).folder;
        let within = file_of(&id.path).parent().and_then(|folder| folder.strip_prefix(root).ok());
        let folder = within.map_or_else(|| out.clone(), |within| out.join(within));
        let options = &self.config.watches[id.root].outputs;
        let mirrored = self.outputs_of.entry((id.root, folder)).or_insert_with_key(|(_, folder)| {
            Arc::new(OutputOptions { folder: folder.clone(), ..options.clone() })
        });
        Arc::clone(mirrored)
    }

    /// Makes the outputs of this frame its own.
    ///
    /// # Errors
    /// When another input has them already, or when one of them would replace a file of particles or an obstacle.
    fn claim(&mut self, id: &FrameId) -> Result<(), String> {
        let claimed = self.free_stem(id)?;
        for output in self.output_paths(id) {
            if self.listings.has(&output) && matches!(content(&output), Ok(Content::Particles)) {
                return Err(format!(
                    "its output {} would replace a file of particles: choose another folder or format",
                    output.display()
                ));
            }
            // Those of the frames of other folders, too.
            for obstacles in &self.obstacles {
                obstacles.refuse_output(&output).map_err(|conflict| conflict.to_string())?;
            }
        }
        self.claims.insert(claimed, id.clone());
        Ok(())
    }

    /// The files that a frame becomes.
    fn output_paths(&mut self, id: &FrameId) -> Vec<PathBuf> {
        let outputs = self.outputs(id);
        let stem = stem(&id.path);
        outputs.formats.iter().map(|&format| output_path(&outputs.folder, &stem, format)).collect()
    }

    /// The same for outputs that are known to be the frame's own: they are not looked into, for there may
    /// be a hundred thousand of them.
    ///
    /// # Errors
    /// Who else has them.
    fn claim_own(&mut self, id: &FrameId) -> Result<(), String> {
        let claimed = self.free_stem(id)?;
        self.claims.insert(claimed, id.clone());
        Ok(())
    }

    /// What a frame's outputs are called, where no other frame's are called so.
    fn free_stem(&mut self, id: &FrameId) -> Result<PathBuf, String> {
        let claimed = self.claimed_stem(id);
        let is_another = |owner: &&FrameId| *owner != id && self.frames.get(owner).is_some();
        match self.claims.get(&claimed).filter(is_another) {
            None => Ok(claimed),
            Some(owner) => Err(format!(
                "{} and {} would both become {}.*; the first of them has it",
                owner.path.display(),
                id.path.display(),
                claimed.display(),
            )),
        }
    }

    /// What the outputs of a frame are called, but for their extensions.
    fn claimed_stem(&mut self, id: &FrameId) -> PathBuf {
        self.outputs(id).folder.join(stem(&id.path))
    }

    pub(super) fn set_phase(&mut self, id: &FrameId, phase: Phase) {
        let Some(frame) = self.frames.get_mut(id) else { return };
        frame.phase = phase;
        // Others may have waited for this one, to be measured after it.
        if matches!(self.sequences.get(frame.sequence).settings, SequenceSettings::Unknown(_)) {
            self.dirty_sequences.insert(frame.sequence);
        }
        self.show(id);
    }
}

fn stem(path: &Path) -> String {
    FrameFile::new(path.to_owned()).stem()
}
