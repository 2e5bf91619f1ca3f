//! What became of a frame: recorded, logged, and tried again where that may help.

use std::io;
use std::path::Path;
use std::sync::Arc;
use std::time::Instant;

use crate::pipeline::{FileStamp, FrameError, FrameReport, Outcome, ReadInput, Scope, Stage, Warning};
use crate::watch::board::Figures;
use crate::watch::journal::{Entry, FrameRecord, OutputRecord, Standing};

use super::completeness::{Candidate, Seen};
use super::events::{Finished, Log};
use super::frames::{FrameId, FrameState, Phase};
use super::retry::{Recovery, backoff, recovery};
use super::state::{Core, Failure};

impl Core {
    /// A pipeline is finished with a frame.
    pub(super) fn on_finished(&mut self, finished: Finished) {
        let Finished { id, outputs, outcome, free_bytes } = finished;
        self.under_way.remove(&id);
        self.finished_count += 1;
        let Some(stamp) = self.frames.get(&id).map(|frame| frame.phase.stamp()) else { return };
        match outcome {
            Outcome::Converted(report) => self.on_converted(&id, &report, outputs),
            Outcome::AlreadyDone { input, .. } => self.on_already_done(&id, &input, outputs),
            Outcome::Changed => {
                let path = Arc::clone(&id.path);
                let what = "was written while it was read: it is read again";
                self.log(move || tracing::info!(frame = %path.display(), "{what}"));
                return self.start_over(&id);
            }
            Outcome::Failed(error) => self.failed_frame(&id, stamp, &error, free_bytes),
            // The pipeline was closed before the frame was begun.
            Outcome::NotStarted => {}
        }
        self.check_again(&id);
    }

    fn on_converted(&mut self, id: &FrameId, report: &FrameReport, outputs: Vec<OutputRecord>) {
        self.log_notes(id, report);
        if let Some(index) = self.frames.get(id).map(|frame| frame.sequence) {
            self.note_camera(index);
        }
        self.guard.on_success();
        let skin = &report.skin;
        let seconds = report.seconds.total();
        let figures = Arc::new(Figures::of(report));
        let (input_bytes, output_bytes) = (report.input.stamp.size, report.output_bytes.iter().sum());
        let counted = Arc::clone(&figures);
        self.count(move |counters| counters.add_converted(&counted, input_bytes, output_bytes));
        let record = FrameRecord {
            outputs,
            hash: Some(report.input.hash),
            particle_count: Some(skin.particle_count),
            seconds: Some(rounded(seconds)),
            flaws: report.all_warnings().iter().filter(|w| w.is_flaw()).map(Warning::to_string).collect(),
            figures: Some(Arc::clone(&figures)),
            ..self.new_record(id, Standing::Done, report.input.stamp)
        };
        let (path, queue) = (Arc::clone(&id.path), self.queue.len());
        self.note_done(
            id,
            record,
            Log::new(move || {
                let seconds = figures.seconds;
                tracing::info!(
                    frame = %path.display(),
                    particles = figures.particles,
                    read_s = rounded(seconds.read),
                    rasterize_s = rounded(seconds.rasterize),
                    smooth_s = rounded(seconds.smooth),
                    contour_s = rounded(seconds.contour),
                    write_s = rounded(seconds.write),
                    preview_s = rounded(seconds.preview),
                    queue,
                    "converted"
                );
            }),
        );
    }

    /// Logs what a user should know of a frame. What is so with one frame is so with the next, as a rule, and is logged once
    /// for the sequence.
    fn log_notes(&mut self, id: &FrameId, report: &FrameReport) {
        let Some(sequence) = self.frames.get(id).map(|frame| frame.sequence) else { return };
        let sequence = self.sequences.get_mut(sequence);
        let mut warnings = report.all_warnings();
        warnings.retain(|warning| warning.scope() == Scope::Frame || sequence.reported.is_new(warning));
        let unused = report.unused_velocity.clone();
        let unused_velocity =
            unused.filter(|_| !std::mem::replace(&mut sequence.has_reported_velocity, true));
        let path = Arc::clone(&id.path);
        self.log(move || {
            for warning in warnings {
                tracing::warn!(frame = %path.display(), "{warning}");
            }
            if let Some(name) = unused_velocity {
                tracing::info!(frame = %path.display(), "frames have the attribute \"{name}\" (velocity), which the outputs lack");
            }
        });
    }

    fn on_already_done(&mut self, id: &FrameId, input: &ReadInput, outputs: Vec<OutputRecord>) {
        let record =
            FrameRecord { hash: Some(input.hash), ..self.new_record(id, Standing::Done, input.stamp) };
        // What was measured when these very outputs were written is still true of them.
        let known = self.record_of(id).filter(|known| are_the_same(&known.outputs, &outputs));
        let record = match known.map(|known| FrameRecord::clone(known)) {
            Some(FrameRecord { particle_count, seconds, flaws, figures, .. }) => {
                FrameRecord { particle_count, seconds, flaws, figures, ..record }
            }
            None => record,
        };
        self.count(|counters| counters.found_done += 1);
        let (path, queue) = (Arc::clone(&id.path), self.queue.len());
        let log = Log::new(move || tracing::info!(frame = %path.display(), queue, "was done already"));
        self.note_done(id, FrameRecord { outputs, ..record }, log);
    }

    fn note_done(&mut self, id: &FrameId, record: FrameRecord, log: Log) {
        let Some(frame) = self.frames.get_mut(id) else { return };
        frame.attempt_count = 0;
        self.failed.remove(id);
        self.set_phase(id, Phase::Done(record.stamp));
        let entry = Entry::Frame { input: Arc::clone(&id.path), record: Arc::new(record) };
        self.record(self.output_of[id.root], entry, Some(log));
    }

    /// A frame failed: what now depends on why.
    pub(super) fn failed_frame(
        &mut self,
        id: &FrameId,
        stamp: FileStamp,
        error: &FrameError,
        free_bytes: Option<u64>,
    ) {
        let (now, reason) = (self.now.at, error.to_string());
        match recovery(error) {
            Recovery::Forget => {
                let path = Arc::clone(&id.path);
                self.log(move || tracing::info!(frame = %path.display(), "is gone"));
                self.set_phase(id, Phase::Failed(stamp));
                self.forget(id);
            }
            Recovery::AwaitSpace => {
                let folder = error.path.parent().unwrap_or(Path::new("."));
                // What was free before says nothing any more.
                let output = &mut self.outputs[self.output_of[id.root]];
                output.free_bytes = free_bytes.or(output.free_bytes);
                match error.is_disk_full() {
                    true => self.guard.on_full(folder, free_bytes, now),
                    false => self.guard.on_refusal(reason.clone(), now),
                }
                self.retry_at(id, stamp, now, &reason, |path, why| {
                    tracing::warn!(frame = %path.display(), "{why}: paused until that has changed");
                });
            }
            Recovery::Retry => self.fail_for_now(id, stamp, reason, now),
            Recovery::AwaitRestart => self.fail(id, Standing::GivenUp, stamp, reason),
            Recovery::GiveUp => self.fail_for_good(id, stamp, reason),
        }
    }

    fn fail_for_now(&mut self, id: &FrameId, stamp: FileStamp, reason: String, now: Instant) {
        let Some(frame) = self.frames.get_mut(id) else { return };
        frame.attempt_count += 1;
        let attempt = frame.attempt_count;
        let Some(wait) = backoff(attempt, self.config.once) else {
            return self.fail(id, Standing::GivenUp, stamp, reason);
        };
        self.retry_at(id, stamp, now + wait, &reason, move |path, why| {
            tracing::warn!(frame = %path.display(), attempt, "{why}; again in {wait:?}");
        });
    }

    fn retry_at(
        &mut self,
        id: &FrameId,
        stamp: FileStamp,
        at: Instant,
        reason: &str,
        log: impl FnOnce(&Path, &str) + Send + 'static,
    ) {
        self.count(|counters| counters.retries += 1);
        self.set_phase(id, Phase::Retrying(stamp, at));
        let (path, why) = (Arc::clone(&id.path), reason.to_owned());
        let log = Log::new(move || log(&path, &why));
        self.note(id, Standing::Retrying, stamp, Some(reason.to_owned()), Some(log));
        self.frames.set_alarm(id, at);
    }

    /// A frame is not tried again until its file changes.
    pub(super) fn fail_for_good(&mut self, id: &FrameId, stamp: FileStamp, reason: String) {
        self.fail(id, Standing::Failed, stamp, reason);
        self.release_claim(id);
    }

    /// Other files keep a frame from being converted. They may change without it, so it is looked at again
    /// after a restart.
    pub(super) fn refuse(&mut self, id: &FrameId, stamp: FileStamp, reason: String) {
        self.fail(id, Standing::Refused, stamp, reason);
        self.refused.insert(id.clone());
    }

    /// A frame is not tried again until its file changes, or, as its standing says, after a restart.
    fn fail(&mut self, id: &FrameId, standing: Standing, stamp: FileStamp, reason: String) {
        self.set_phase(id, Phase::Failed(stamp));
        let attempts = self.frames.get(id).map_or(0, |frame| frame.attempt_count);
        let (path, why) = (Arc::clone(&id.path), reason.clone());
        let log = Log::new(move || match standing {
            Standing::GivenUp if attempts > 0 => {
                tracing::error!(frame = %path.display(), attempt = attempts, "{why}; given up");
            }
            _ => tracing::error!(frame = %path.display(), "{why}"),
        });
        self.note(id, standing, stamp, Some(reason.clone()), Some(log));
        self.failed.insert(id.clone(), Failure { reason, logged_at: Some(self.finished_count) });
        self.count(|counters| counters.failures += 1);
    }

    /// A frame asked to be inspected now.
    pub(super) fn on_alarm(&mut self, id: &FrameId) {
        match self.frames.get(id).map(|frame| &frame.phase) {
            Some(Phase::Settling(_)) => self.inspect_candidate(id),
            Some(Phase::Retrying(_, at)) if *at > self.now.at => self.frames.set_alarm(id, *at),
            Some(Phase::Retrying(..)) => self.inspect(id, None, None),
            _ => {}
        }
    }

    /// Waits once more until a file is complete, whatever is known of it.
    pub(super) fn start_over(&mut self, id: &FrameId) {
        let Some(stamp) = self.frames.get(id).map(|frame| frame.phase.stamp()) else { return };
        self.settle(id, Candidate::new(self.now.at, &Seen { stamp, age: None }, false));
        self.inspect_candidate(id);
    }

    /// A file that was under way may have been written again meanwhile, or be gone.
    pub(super) fn check_again(&mut self, id: &FrameId) {
        match self.frames.get(id).map(|frame| &frame.phase) {
            Some(Phase::Done(_)) => self.check_outputs(id),
            Some(Phase::Settling(_)) | None => {}
            Some(_) => self.check_stamp(id),
        }
    }

    /// A file is there, and the system refuses to say more.
    pub(super) fn on_file_unreadable(&mut self, id: &FrameId, error: io::Error) {
        let Some(stamp) = self.frames.get(id).map(|frame| frame.phase.stamp()) else { return };
        self.failed_frame(id, stamp, &FrameError::file(&id.path, Stage::Read, error), None);
    }

    /// Records how far a frame has come.
    pub(super) fn note(
        &mut self,
        id: &FrameId,
        standing: Standing,
        stamp: FileStamp,
        reason: Option<String>,
        log: Option<Log>,
    ) {
        let mut record = FrameRecord { reason, ..self.new_record(id, standing, stamp) };
        // A frame that is inspected again may turn out to be done: its outputs, and what was measured when they were
        // written, are remembered until then.
        if matches!(standing, Standing::Queued | Standing::Retrying)
            && let Some(known) = self.record_of(id)
        {
            let FrameRecord { outputs, particle_count, seconds, flaws, figures, .. } = (**known).clone();
            record = FrameRecord { outputs, particle_count, seconds, flaws, figures, ..record };
        }
        let entry = Entry::Frame { input: Arc::clone(&id.path), record: Arc::new(record) };
        self.record(self.output_of[id.root], entry, log);
        self.changed.insert(id.clone());
    }

    /// The fingerprint of what a frame is converted with: for one that was queued, at that time, because an obstacle may
    /// have been written since.
    fn made_with(&self, frame: &FrameState) -> String {
        match frame.made_with.is_empty() {
            true => self.sequences.get(frame.sequence).fingerprint(frame.obstacles.as_deref()),
            false => frame.made_with.clone(),
        }
    }

    fn new_record(&self, id: &FrameId, standing: Standing, stamp: FileStamp) -> FrameRecord {
        let frame = self.frames.get(id);
        FrameRecord {
            standing,
            stamp,
            hash: None,
            settings: frame.map_or(String::new(), |frame| self.made_with(frame)),
            outputs: Vec::new(),
            reason: None,
            attempt_count: frame.map_or(0, |frame| frame.attempt_count),
            at_ms: self.now.unix_ms,
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
        outputs.iter().map(|output| (output.path.clone(), output.hash)).collect()
    };
    let known = bytes(known);
    known == bytes(now) && known.iter().all(|(_, hash)| hash.is_some())
}

/// Seconds to the millisecond: more digits are noise in a log.
fn rounded(seconds: f64) -> f64 {
    (seconds * 1e3).round() / 1e3
}
