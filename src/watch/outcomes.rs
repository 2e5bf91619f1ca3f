//! What became of a frame: written down, told, and tried again where that may help.

use std::io;
use std::path::Path;
use std::sync::Arc;
use std::time::Instant;

use crate::pipeline::{
    FileStamp, Frame, FrameError, FrameReport, Outcome, ReadInput, Stage, flaws, gist, notes, standing_notes,
    velocity_hint,
};
use crate::watch::board::Figures;

use super::frames::{FrameId, FrameState, Phase};
use super::journal::{FrameRecord, OutputRecord, Standing, now_ms};
use super::readiness::Candidate;
use super::retry::{Remedy, backoff, remedy};
use super::rounds::{Daemon, Failure};
use super::scan::look;
use super::showing::count;

impl Daemon<'_> {
    /// The pipeline is finished with a frame.
    pub(super) fn finished(&mut self, id: &FrameId, frame: &Frame, outcome: Outcome) {
        self.finished_count += 1;
        let Some(state) = self.frames.get(id) else { return };
        let stamp = state.phase.stamp();
        match outcome {
            Outcome::Converted(report) => self.converted(id, &report),
            Outcome::AlreadyDone { input, .. } => self.already_done(id, frame, &input),
            Outcome::Changed => {
                tracing::info!(frame = %id.path.display(), "was written while it was read: it is read again");
                return self.start_over(id);
            }
            Outcome::Failed(error) => self.failed_frame(id, stamp, &error),
            // The pipeline was closed before the frame was begun.
            Outcome::NotStarted => {}
        }
        self.look_again(id);
    }

    fn converted(&mut self, id: &FrameId, report: &FrameReport) {
        let skin = &report.skin;
        let seconds =
            report.read_seconds + skin.seconds.total() + report.write_seconds + report.preview_seconds;
        let sequence = self.frames.get(id).map(|frame| frame.sequence);
        // What is so with one frame is so with the next, as a rule.
        let is_new = |note: &String| {
            sequence.is_none_or(|index| self.sequences.get_mut(index).told.insert(gist(note)))
        };
        let standing: Vec<String> = standing_notes(report).into_iter().filter(is_new).collect();
        for note in standing.into_iter().chain(notes(report)) {
            tracing::warn!(frame = %id.path.display(), "{note}");
        }
        let hint = report.unused_velocity.as_deref().map(velocity_hint);
        if let Some(hint) = hint
            .filter(|hint| sequence.is_none_or(|index| self.sequences.get_mut(index).told.insert(gist(hint))))
        {
            tracing::info!(frame = %id.path.display(), "{hint}");
        }
        if let Some(index) = sequence {
            self.note_camera(index);
        }
        self.room.was_enough();
        let outputs = report.outputs.iter().zip(&report.output_bytes);
        let outputs = outputs.map(|(path, &size_bytes)| {
            let state = self.output_states.take(path);
            OutputRecord { path: path.clone(), size_bytes, state }
        });
        let record = FrameRecord {
            outputs: outputs.collect(),
            particle_count: Some(skin.particle_count),
            seconds: Some(rounded(seconds)),
            flaws: flaws(report),
            figures: Some(Arc::new(Figures::of(report))),
            ..self.record(id, Standing::Done, report.input.stamp)
        };
        self.note_done(id, FrameRecord { hash: Some(report.input.hash), ..record });
        self.show_converted(id, report);
        // Last: a frame that the log calls converted is in the journal, and on the board.
        tracing::info!(
            frame = %id.path.display(),
            particles = skin.particle_count,
            read_s = rounded(report.read_seconds),
            rasterize_s = rounded(skin.seconds.rasterize),
            smooth_s = rounded(skin.seconds.smooth),
            contour_s = rounded(skin.seconds.contour),
            write_s = rounded(report.write_seconds),
            preview_s = rounded(report.preview_seconds),
            queue = self.queue.len(),
            "converted"
        );
    }

    fn already_done(&mut self, id: &FrameId, frame: &Frame, input: &ReadInput) {
        let outputs = frame.output_paths().into_iter().map(|path| {
            let state = self.output_states.take(&path);
            let size_bytes = state.map_or(0, |state| state.stamp.size);
            OutputRecord { path, size_bytes, state }
        });
        let outputs: Vec<OutputRecord> = outputs.collect();
        // What was measured when these very outputs were written is still true of them.
        let known = self.stores.of_watch(id.root).journal.state().frames.get(&*id.path).cloned();
        let measured = known.filter(|known| are_the_same(&known.outputs, &outputs));
        let record = self.record(id, Standing::Done, input.stamp);
        let record = match measured {
            Some(FrameRecord { particle_count, seconds, flaws, figures, .. }) => {
                FrameRecord { particle_count, seconds, flaws, figures, ..record }
            }
            None => record,
        };
        let record = FrameRecord { outputs, hash: Some(input.hash), ..record };
        self.note_done(id, record);
        count(self.board, |counters| counters.found_done += 1);
        self.show(id);
        tracing::info!(frame = %id.path.display(), queue = self.queue.len(), "was done already");
    }

    fn note_done(&mut self, id: &FrameId, record: FrameRecord) {
        let Some(frame) = self.frames.get_mut(id) else { return };
        frame.attempt_count = 0;
        frame.phase = Phase::Done(record.stamp);
        self.failed.remove(id);
        self.stores.of_watch_mut(id.root).write_down(|journal| journal.note_frame(&id.path, record));
    }

    /// A frame failed: what now depends on why.
    pub(super) fn failed_frame(&mut self, id: &FrameId, stamp: FileStamp, error: &FrameError) {
        let now = Instant::now();
        match remedy(error) {
            Remedy::Forget => {
                tracing::info!(frame = %id.path.display(), "is gone");
                self.set_phase(id, Phase::Failed(stamp));
                self.forget(id);
            }
            Remedy::AwaitRoom => {
                let folder = error.path.parent().unwrap_or(Path::new("."));
                match error.is_disk_full() {
                    true => self.room.ran_out(folder, now),
                    false => self.room.was_refused(error.to_string(), now),
                }
                self.queue.pause(true);
                self.retry_at(id, stamp, now, &error.to_string());
                tracing::warn!(frame = %id.path.display(), "{error}: paused until that has changed");
            }
            Remedy::Retry => self.fail_for_now(id, stamp, error, now),
            Remedy::AwaitRestart => {
                self.fail_until_restart(id, stamp, error.to_string());
                tracing::error!(frame = %id.path.display(), "{error}");
            }
            Remedy::GiveUp => self.fail_for_good(id, stamp, error.to_string()),
        }
    }

    fn fail_for_now(&mut self, id: &FrameId, stamp: FileStamp, error: &FrameError, now: Instant) {
        let Some(frame) = self.frames.get_mut(id) else { return };
        frame.attempt_count += 1;
        let attempt_count = frame.attempt_count;
        match backoff(attempt_count, self.config.once) {
            Some(wait) => {
                self.retry_at(id, stamp, now + wait, &error.to_string());
                tracing::warn!(frame = %id.path.display(), attempt = attempt_count, "{error}; again in {wait:?}");
            }
            None => {
                self.fail_until_restart(id, stamp, error.to_string());
                tracing::error!(frame = %id.path.display(), attempt = attempt_count, "{error}; given up");
            }
        }
    }

    /// Not the file's fault: it is tried again when its file changes, or after a restart.
    fn fail_until_restart(&mut self, id: &FrameId, stamp: FileStamp, reason: String) {
        self.set_phase(id, Phase::Failed(stamp));
        self.note(id, Standing::GivenUp, stamp, Some(reason.clone()));
        self.note_failure(id, reason);
    }

    fn retry_at(&mut self, id: &FrameId, stamp: FileStamp, at: Instant, reason: &str) {
        count(self.board, |counters| counters.retries += 1);
        self.set_phase(id, Phase::Retrying(stamp, at));
        self.note(id, Standing::Retrying, stamp, Some(reason.to_owned()));
        self.frames.set_alarm(id, at);
    }

    /// A frame is not tried again until its file changes.
    pub(super) fn fail_for_good(&mut self, id: &FrameId, stamp: FileStamp, reason: String) {
        self.set_phase(id, Phase::Failed(stamp));
        self.note(id, Standing::Failed, stamp, Some(reason.clone()));
        self.note_failure(id, reason.clone());
        tracing::error!(frame = %id.path.display(), "{reason}");
        // It will have no outputs: whoever was refused their names may have them.
        self.give_way(id);
    }

    /// Other files keep a frame from being converted. They may change without it, so it is looked at again
    /// after a restart.
    pub(super) fn refuse(&mut self, id: &FrameId, stamp: FileStamp, reason: String) {
        self.set_phase(id, Phase::Failed(stamp));
        self.note(id, Standing::Refused, stamp, Some(reason.clone()));
        self.refused.insert(id.clone());
        self.note_failure(id, reason.clone());
        tracing::error!(frame = %id.path.display(), "{reason}");
    }

    /// A failure that is logged now.
    fn note_failure(&mut self, id: &FrameId, reason: String) {
        let told_at = Some(self.finished_count);
        self.failed.insert(id.clone(), Failure { reason, told_at });
        count(self.board, |counters| counters.failures += 1);
        self.show(id);
    }

    /// It is time to try a frame again.
    pub(super) fn retry(&mut self, id: &FrameId, now: Instant) {
        let Some(frame) = self.frames.get(id) else { return };
        let Phase::Retrying(stamp, at) = frame.phase else { return };
        if at > now {
            return self.frames.set_alarm(id, at);
        }
        self.set_phase(id, Phase::Held(stamp));
        self.look_again(id);
        if self.frames.get(id).is_some_and(|frame| matches!(frame.phase, Phase::Held(_))) {
            self.ready(id, stamp);
        }
    }

    /// A frame settles once more, whatever is known of it.
    pub(super) fn start_over(&mut self, id: &FrameId) {
        match look(&id.path, self.roots[id.root].trust_clock()) {
            Ok(Some(seen)) => {
                self.settle(id, Candidate::new(Instant::now(), &seen, false));
                match id.file() {
                    Some(file) => self.sight_step(&file, id, &seen),
                    None => self.advance(id),
                }
            }
            _ => self.look_again(id),
        }
    }

    /// What was under way may have been written again meanwhile, or be gone.
    pub(super) fn look_again(&mut self, id: &FrameId) {
        match look(&id.path, self.roots[id.root].trust_clock()) {
            Ok(Some(seen)) => self.sight(id, &seen, false),
            Ok(None) => self.forget(id),
            Err(error) => self.cannot_look(id, error),
        }
    }

    /// A file is there, and the system refuses to say more.
    pub(super) fn cannot_look(&mut self, id: &FrameId, error: io::Error) {
        let Some(stamp) = self.frames.get(id).map(|frame| frame.phase.stamp()) else { return };
        self.failed_frame(id, stamp, &FrameError::file(&id.path, Stage::Read, error));
    }

    /// Writes a frame's standing into the journal.
    pub(super) fn note(
        &mut self,
        id: &FrameId,
        standing: Standing,
        stamp: FileStamp,
        reason: Option<String>,
    ) {
        let mut record = FrameRecord { reason, ..self.record(id, standing, stamp) };
        // A frame that is looked at again may turn out to be done: its outputs, and what was measured when they were
        // written, are remembered until then.
        if matches!(standing, Standing::Queued | Standing::Retrying)
            && let Some(known) = self.stores.of_watch(id.root).journal.state().frames.get(&*id.path)
        {
            let FrameRecord { outputs, particle_count, seconds, flaws, figures, .. } = known.clone();
            record = FrameRecord { outputs, particle_count, seconds, flaws, figures, ..record };
        }
        self.stores.of_watch_mut(id.root).write_down(|journal| journal.note_frame(&id.path, record));
        self.show(id);
    }

    /// The fingerprint of what a frame is converted with. Of one that was queued it is that of then: an obstacle that
    /// is written meanwhile is another one.
    fn made_with(&self, id: &FrameId, frame: &FrameState) -> String {
        match frame.made_with.is_empty() {
            true => self.sequences.get(frame.sequence).fingerprint(&self.obstacles[id.root], &id.path),
            false => frame.made_with.clone(),
        }
    }

    fn record(&self, id: &FrameId, standing: Standing, stamp: FileStamp) -> FrameRecord {
        let frame = self.frames.get(id);
        FrameRecord {
            standing,
            stamp,
            hash: None,
            settings: frame.map_or(String::new(), |frame| self.made_with(id, frame)),
            outputs: Vec::new(),
            reason: None,
            attempt_count: frame.map_or(0, |frame| frame.attempt_count),
            at_ms: now_ms(),
            particle_count: None,
            seconds: None,
            flaws: Vec::new(),
            figures: None,
        }
    }
}

/// Whether these are the same files with the same bytes.
fn are_the_same(known: &[OutputRecord], now: &[OutputRecord]) -> bool {
    let bytes = |outputs: &[OutputRecord]| -> Vec<_> {
        outputs.iter().map(|output| (output.path.clone(), output.state.map(|state| state.hash))).collect()
    };
    let known = bytes(known);
    known == bytes(now) && known.iter().all(|(_, hash)| hash.is_some())
}

/// Seconds to the millisecond: more digits are noise in a log.
fn rounded(seconds: f64) -> f64 {
    (seconds * 1e3).round() / 1e3
}
