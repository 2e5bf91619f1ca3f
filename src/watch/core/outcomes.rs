//! Handles the result of a conversion: records and logs it, and retries if that may help.

use std::path::Path;
use std::sync::Arc;
use std::time::Instant;

use crate::pipeline::{
    DoneRecord, FrameError, FrameReport, InputState, Outcome, Reason, RecordLine, RecordedFrame,
    UnfinishedRecord, UnfinishedState,
};

use super::events::{FrameFinished, Log, UnreadableFrame};
use super::frames::{FrameId, FramePhase, within};
use super::retry::{RetryAction, backoff, recovery};
use super::state::{Core, Failure};

impl Core {
    /// The pipeline has finished with a frame.
    pub(super) fn on_finished(&mut self, finished: FrameFinished) {
        let FrameFinished { id, outcome, free_bytes, named } = finished;
        self.finished_count += 1;
        self.output_folders[self.output_folder_of[id.root]].free_bytes = free_bytes;
        let Some(frame) = self.frames.get_mut(&id) else { return };
        frame.named = named;
        // Until its outcome is handled, the frame counts as queued again; if it was not started, it stays so.
        self.set_phase(&id, FramePhase::Queued);
        match outcome {
            Outcome::Converted(report) => self.on_converted(&id, &report),
            Outcome::AlreadyDone { input, record } => self.on_already_done(&id, input, &record),
            Outcome::Changed => {
                let what = "frame was written while it was read: reading it again";
                self.log_about(&*id.path, move |frame| tracing::info!(%frame, "{what}"));
                return self.start_over(&id);
            }
            Outcome::Failed(error) => self.failed_frame(&id, &error, free_bytes),
            Outcome::NotStarted => {}
        }
        self.check_again(&id);
    }

    fn on_converted(&mut self, id: &FrameId, report: &FrameReport) {
        // The pipeline has recorded the frame: every frame of the daemon has records.
        let Some(record) = report.record.clone() else { return };
        self.log_notes(id, report);
        if let Some(index) = self.frames.get(id).map(|frame| frame.sequence) {
            self.note_camera(index);
        }
        self.guard.on_success();
        let (input_bytes, figures) = (record.stamp.size, Arc::clone(&record.figures));
        self.counters.add_converted(
            &figures,
            input_bytes,
            record.outputs.iter().map(|file| file.stamp.size).sum(),
        );
        let (path, queue, outputs) = (Arc::clone(&id.path), self.queue.len(), self.outputs_json(id, &record));
        let log = Log::new(move || {
            let seconds = figures.seconds;
            tracing::info!(
                frame = %path.display(),
                state = "converted",
                outputs,
                particles = figures.particles,
                vertices = figures.vertices,
                triangles = figures.triangles,
                read_s = rounded(seconds.read),
                rasterize_s = rounded(seconds.rasterize),
                smooth_s = rounded(seconds.smooth),
                contour_s = rounded(seconds.contour),
                write_s = rounded(seconds.write),
                preview_s = rounded(seconds.preview),
                queue,
                "converted"
            );
        });
        self.note_done(id, record, log);
    }

    /// Logs warnings about a frame. A warning that usually applies to later frames, too, is logged once per
    /// sequence.
    fn log_notes(&mut self, id: &FrameId, report: &FrameReport) {
        let Some(sequence) = self.frames.get(id).map(|frame| frame.sequence) else { return };
        let sequence = self.sequences.get_mut(sequence);
        let mut warnings = report.all_warnings();
        warnings.retain(|warning| sequence.reported.is_new(warning));
        let unused = report.unused_velocity.clone();
        let unused_velocity =
            unused.filter(|_| !std::mem::replace(&mut sequence.has_reported_velocity, true));
        let path = Arc::clone(&id.path);
        self.log(move || {
            for warning in warnings {
                tracing::warn!(frame = %path.display(), "{warning}");
            }
            if let Some(name) = unused_velocity {
                tracing::info!(frame = %path.display(), "frames have the attribute \"{name}\" (velocity); --attributes {name} adds it to the outputs for motion blur");
            }
        });
    }

    fn on_already_done(&mut self, id: &FrameId, input: InputState, record: &DoneRecord) {
        let record = DoneRecord {
            input: id.path.to_path_buf(),
            stamp: input.stamp,
            named: input.named,
            obstacle_stamp: self.frames.get(id).and_then(|frame| frame.obstacle_stamp.clone()),
            at_ms: self.now.unix_ms.max(self.record_of(id).map_or(0, RecordedFrame::at_ms)),
            ..record.clone()
        };
        self.counters.found_done += 1;
        let (path, queue, outputs) = (Arc::clone(&id.path), self.queue.len(), self.outputs_json(id, &record));
        let log = Log::new(move || {
            let frame = path.display();
            tracing::info!(%frame, state = "already_done", outputs, queue, "frame was done already");
        });
        self.note_done(id, Arc::new(record), log);
    }

    fn note_done(&mut self, id: &FrameId, record: Arc<DoneRecord>, log: Log) {
        let Some(frame) = self.frames.get_mut(id) else { return };
        (frame.stamp, frame.attempt_count) = (record.stamp, 0);
        self.failed.remove(id);
        self.set_phase(id, FramePhase::Done);
        self.doubt_done(id);
        // If the pipeline has written the record, the worker only writes the line of the log.
        self.record(self.output_folder_of[id.root], RecordLine::Done(record), Some(log));
    }

    /// The paths of a frame's outputs as a JSON array: a field of the log is text or a number.
    fn outputs_json(&self, id: &FrameId, record: &DoneRecord) -> String {
        let paths = self.recorded_outputs(id, record);
        let paths = paths.iter().map(|path| path.to_string_lossy().into_owned());
        serde_json::Value::from_iter(paths).to_string()
    }

    /// A frame cannot be read.
    pub(super) fn unreadable_frame(
        &mut self,
        id: &FrameId,
        UnreadableFrame { error, named }: UnreadableFrame,
    ) {
        if let Some(frame) = self.frames.get_mut(id) {
            frame.named = named;
        }
        self.failed_frame(id, &error, None);
    }

    /// A frame failed: the error decides what to do.
    pub(super) fn failed_frame(&mut self, id: &FrameId, error: &FrameError, free_bytes: Option<u64>) {
        let (now, reason) = (self.now.at, error.to_string());
        match recovery(error) {
            RetryAction::Forget => {
                self.log_about(&*id.path, |frame| tracing::info!(%frame, "frame was removed"));
                self.set_phase(id, FramePhase::Failed);
                self.remove(id);
            }
            RetryAction::AwaitOutputs => {
                let folder = error.path.parent().unwrap_or(Path::new("."));
                if error.is_disk_full() {
                    self.guard.on_full(folder, free_bytes, now);
                } else {
                    self.guard.on_refusal(reason.clone(), now);
                }
                self.retry_at(id, now, &reason, |path, why| {
                    tracing::warn!(frame = %path.display(), "{}; paused until writing succeeds again", without_path(path, why));
                });
            }
            RetryAction::Retry => self.fail_for_now(id, reason, now),
            RetryAction::AwaitRestart => self.fail(id, UnfinishedState::AwaitsRestart, reason),
            RetryAction::AwaitChange => self.fail_for_good(id, reason),
        }
    }

    fn fail_for_now(&mut self, id: &FrameId, reason: String, now: Instant) {
        let Some(frame) = self.frames.get_mut(id) else { return };
        frame.attempt_count += 1;
        let attempt = frame.attempt_count;
        let Some(wait) = backoff(attempt, self.config.once) else {
            return self.fail(id, UnfinishedState::AwaitsRestart, reason);
        };
        self.retry_at(id, now + wait, &reason, move |path, why| {
            tracing::warn!(frame = %path.display(), attempt, "{}; retry in {wait:?}", without_path(path, why));
        });
    }

    fn retry_at(
        &mut self,
        id: &FrameId,
        at: Instant,
        reason: &str,
        log: impl FnOnce(&Path, &str) + Send + 'static,
    ) {
        self.counters.retries += 1;
        self.failed.remove(id);
        self.set_phase(id, FramePhase::Retrying(at));
        let (path, why) = (Arc::clone(&id.path), reason.to_owned());
        let log = Log::new(move || log(&path, &why));
        let reason = Reason::Error(reason.to_owned());
        self.record_state(id, UnfinishedState::Retrying, Some(reason), Some(log));
        self.frames.set_alarm(id, at);
    }

    /// Marks a frame as failed until its file changes.
    pub(super) fn fail_for_good(&mut self, id: &FrameId, reason: String) {
        self.fail(id, UnfinishedState::Failed, reason);
        self.release_claim(id);
    }

    /// Refuses a frame, usually because of other files. They may change while the frame does not, so it is
    /// checked again at each scan, and after a restart.
    pub(super) fn refuse(&mut self, id: &FrameId, reason: String) {
        self.fail(id, UnfinishedState::Refused, reason);
    }

    /// Marks a frame as failed until its file changes or, depending on its status, until a scan or a restart.
    fn fail(&mut self, id: &FrameId, status: UnfinishedState, reason: String) {
        self.set_phase(id, FramePhase::Failed);
        let attempts = self.frames.get(id).map_or(0, |frame| frame.attempt_count);
        let (path, why) = (Arc::clone(&id.path), reason.clone());
        let next = match (self.config.once, self.config.watches[id.root].obstacles.is_empty()) {
            (true, _) => "run the command again when the cause is gone",
            (false, true) => "will retry when the file changes or the daemon restarts",
            (false, false) => "will retry when the file or an obstacle changes, or the daemon restarts",
        };
        let log = Log::new(move || {
            let why = without_path(&path, &why);
            match status {
                UnfinishedState::AwaitsRestart if attempts > 0 => {
                    tracing::error!(
                        frame = %path.display(),
                        state = "failed",
                        attempt = attempts,
                        "{why}; gave up: {next}"
                    );
                }
                _ => tracing::error!(frame = %path.display(), state = "failed", "{why}"),
            }
        });
        self.record_state(id, status, Some(Reason::Error(reason.clone())), Some(log));
        let (logged_at, is_refusal) = (Some(self.finished_count), status == UnfinishedState::Refused);
        self.failed.insert(id.clone(), Failure { reason, logged_at, is_refusal });
        self.counters.failures += 1;
    }

    /// A file may have changed, or been removed, while it was converted.
    pub(super) fn check_again(&mut self, id: &FrameId) {
        let was_closed = self.frames.get(id).is_some_and(|frame| frame.was_closed);
        match self.frames.phase(id) {
            Some(FramePhase::Done | FramePhase::Failed) if was_closed => self.read_again(id),
            Some(FramePhase::Done) => self.check_outputs(id),
            Some(FramePhase::Settling(_)) | None => {}
            Some(_) => self.check_stamp(id),
        }
    }

    /// Records why a frame is not done.
    pub(super) fn record_state(
        &mut self,
        id: &FrameId,
        state: UnfinishedState,
        reason: Option<Reason>,
        log: Option<Log>,
    ) {
        let Some(frame) = self.frames.get(id) else { return };
        let claimed = self.claimed_stem(id);
        let settings = self.sequences.get(frame.sequence).settings_id();
        // It is later than the record of the last conversion, also if the clock was set back.
        let done = self.record_of(id).and_then(|record| record.done.as_ref());
        let record = UnfinishedRecord {
            name: within(&claimed, &self.output_folder(id.root).folder).unwrap_or(&claimed).to_owned(),
            input: id.path.to_path_buf(),
            state,
            reason,
            stamp: frame.stamp,
            named: frame.named.clone().filter(|_| state.is_failure()),
            settings: settings.unwrap_or_default().to_owned(),
            obstacle_stamp: frame.obstacle_stamp.clone(),
            attempts: frame.attempt_count,
            at_ms: self.now.unix_ms.max(done.map_or(0, |done| done.at_ms.saturating_add(1))),
        };
        self.record(self.output_folder_of[id.root], RecordLine::Unfinished(Arc::new(record)), log);
        self.mark_changed(id);
    }
}

/// A reason for a line of the log, which has the path as a field: without the path at its start.
fn without_path<'a>(path: &Path, reason: &'a str) -> &'a str {
    let start = format!("{}: ", path.display());
    reason.strip_prefix(&*start).unwrap_or(reason)
}

/// Seconds rounded to the millisecond: more digits are noise in a log.
fn rounded(seconds: f64) -> f64 {
    (seconds * 1e3).round() / 1e3
}
