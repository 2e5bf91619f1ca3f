//! Takes a file from its discovery to a queued frame, or to the reason why it is not queued.
//!
//! ```text
//!   on_file_seen ──▶ inspect ··▶ on_inspected ──▶ on_complete ──▶ accept ──▶ queue_if_ready ──▶ enqueue
//!        │                            │                │                         │
//!        │                            │                │                         └ no settings yet: held
//!        │                            │                ├ it may have several steps: search for these first
//!        │                            │                └ no particles, or another frame owns its outputs
//!        │                            └ known from its record, or incomplete
//!        └ seen before, and unchanged; unless a writer closed it: then it is read again
//! ```

use std::collections::{BTreeMap, BTreeSet};
use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Instant;

use meniscus_formats::Neighbor;

use crate::pipeline::{
    ChangedOutput, DoneRecord, FileStamp, Frame, FrameError, ObstacleStamps, OutputOptions, Reason,
    RecordedFrame, Stage, UnfinishedState, entry_key, step_in,
};
use crate::surface::options::Settings;

use super::completeness::{Candidate, FileHint, Seen, path_of_sentinel};
use super::decision::reason_by_record;
use super::events::{
    Complete, FileContents, FoundObstacleStamps, Inspect, Inspected, InspectionExtent, InspectionResult,
    RecordCheck, RootRequest, Scan,
};
use super::frames::{FrameId, FramePhase, FrameState};
use super::sequences::{SequenceSettings, obstacle_stamp};
use super::state::{Core, Failure, OutputFolder};

impl Core {
    /// A file of a root was seen.
    pub(super) fn on_file_seen(&mut self, id: &FrameId, seen: &Seen, at: Instant, hint: FileHint) {
        if let Some(file) = id.file() {
            return self.on_step_seen(&file, id, seen, at);
        }
        let candidate = Candidate::new(at, seen, hint);
        let was_closed = hint == FileHint::Closed;
        let Some(frame) = self.frames.get_mut(id) else {
            return self.add_frame(id, candidate);
        };
        frame.scan_count = self.scan_count;
        if frame.phase == FramePhase::InProgress {
            // The file is inspected when the conversion ends.
            frame.was_closed |= was_closed;
            return;
        }
        if let FramePhase::Settling(candidate) = &mut frame.phase {
            candidate.see(at, seen, hint);
            frame.stamp = seen.stamp;
        } else if frame.stamp == seen.stamp {
            return self.on_unchanged(id, was_closed);
        } else {
            if frame.phase == FramePhase::Steps {
                self.unqueue_steps(id, seen, at);
            }
            self.start_settling(id, candidate);
        }
        self.inspect_settling(id, InspectionExtent::AllOfJustSeen);
    }

    /// A file was seen with the stamp that it had before. `was_closed`: its writer has closed it since, perhaps
    /// after a change through a memory map.
    fn on_unchanged(&mut self, id: &FrameId, was_closed: bool) {
        match self.frames.phase(id) {
            Some(FramePhase::Done | FramePhase::Failed | FramePhase::Ignored) if was_closed => {
                self.read_again(id);
            }
            Some(FramePhase::Steps) if was_closed => self.read_steps_again(id),
            Some(FramePhase::Done) => self.check_outputs(id),
            Some(FramePhase::Steps) => self.check_steps(id),
            Some(FramePhase::Failed) => self.check_failed(id),
            _ => {}
        }
    }

    /// Reads a file again although its stamp is the same: a writer has closed it. A memory map changes the
    /// content after the times of the file, and no event reports that.
    pub(super) fn read_again(&mut self, id: &FrameId) {
        if let Some(frame) = self.frames.get_mut(id) {
            frame.was_closed = true;
        }
        if self.failed.get(id).is_some_and(|failure| failure.is_refusal) {
            self.check_refusal(id);
        } else {
            self.inspect(id, None);
        }
    }

    /// Adds a file, or a step of one, that was seen for the first time.
    pub(super) fn add_frame(&mut self, id: &FrameId, candidate: Candidate) {
        let sequence = self.sequence_of(id);
        self.frames.insert(id, sequence, candidate, self.scan_count);
        self.number_frame(id, sequence);
        // Clients see the frame after its first inspection, because at the start most frames turn out to be
        // done.
        let extent = if id.is_step() { InspectionExtent::All } else { InspectionExtent::AllOfJustSeen };
        self.inspect_settling(id, extent);
    }

    /// A root was scanned, or could not be.
    pub(super) fn on_root_scanned(&mut self, root: usize, found: Result<Scan, String>, at: Instant) {
        self.scan_count += 1;
        self.counters.scans += 1;
        let is_first = !std::mem::replace(&mut self.roots[root].was_scanned, true);
        let Scan { files, problems, dangling, after_loss, .. } = match found {
            Ok(found) => found,
            Err(why) => return self.on_root_unavailable(root, why),
        };
        if after_loss && !is_first {
            self.counters.rescans += 1;
        }
        if self.roots[root].unavailable.take().is_some() {
            let path = self.root_path(root).to_owned();
            self.log_about(path, |folder| tracing::info!(%folder, "folder is available again"));
        }
        self.note_unreadable(root, &problems, dangling);
        self.on_files_scanned(root, files, at);
        self.warn_of_single_frames();
        self.stamp_obstacles(root);
        let count = self.scan_count;
        // Files that the scan could not reach are unknown, not gone.
        let is_hidden = |id: &FrameId| problems.iter().any(|(path, _)| id.path.starts_with(path));
        let is_gone = |id: &FrameId, frame: &FrameState| {
            // A step is removed together with its file.
            id.root == root && !id.is_step() && frame.scan_count != count && !is_hidden(id)
        };
        for id in self.frames.ids_of(is_gone) {
            self.remove(&id);
        }
        self.release_claims_of_missing(root);
    }

    /// Processes the files that a scan found.
    pub(super) fn on_files_scanned(&mut self, root: usize, mut files: Vec<(PathBuf, Seen)>, at: Instant) {
        files.sort_unstable_by(|(a, _), (b, _)| a.cmp(b));
        for (path, seen) in &files {
            self.on_file_seen(&FrameId::new(root, path), seen, at, FileHint::Changed);
        }
    }

    /// Records the paths that a scan could not examine. Each is logged once, and fails the run if it is still
    /// unreadable at the end. Without `once`, the daemon waits for the target of a dangling link; with
    /// `once`, such a link counts as unreadable.
    fn note_unreadable(&mut self, root: usize, problems: &[(PathBuf, String)], dangling: Vec<PathBuf>) {
        let mut unreadable: BTreeMap<PathBuf, String> = problems.iter().cloned().collect();
        if self.config.once {
            let reason = "the target of this link is missing";
            unreadable.extend(dangling.into_iter().map(|path| (path, reason.to_owned())));
        }
        let known = std::mem::replace(&mut self.roots[root].unreadable, unreadable.clone());
        for (path, why) in unreadable {
            if known.get(&path) != Some(&why) {
                self.log_about(path, move |path| tracing::error!(%path, "path cannot be read: {why}"));
            }
        }
    }

    /// A root is missing or suddenly empty: its state is kept, and the daemon waits for it.
    fn on_root_unavailable(&mut self, root: usize, why: String) {
        let known = self.roots[root].unavailable.replace(why.clone());
        if known.as_ref() != Some(&why) && !self.config.once {
            let path = self.root_path(root).to_owned();
            self.log_about(
                path,
                move |folder| tracing::warn!(%folder, "folder is unavailable: {why}; waiting until this changes"),
            );
        }
    }

    /// A file may be the sentinel of waiting frames.
    pub(super) fn on_sentinel_seen(&mut self, root: usize, path: &Path) {
        let watch = &self.config.watches[root];
        let is_waiting = |id: &FrameId, frame: &FrameState| {
            matches!(frame.phase, FramePhase::Settling(_))
                && id.root == root
                && id.path.parent() == path.parent()
                && path_of_sentinel(watch, &id.path) == path
        };
        for id in self.frames.ids_of(is_waiting) {
            self.inspect_settling(&id, InspectionExtent::All);
        }
    }

    /// A file changed: resets the state of its frame, which is out of date.
    pub(super) fn start_settling(&mut self, id: &FrameId, candidate: Candidate) {
        self.unqueue(id);
        self.set_phase(id, FramePhase::Settling(candidate));
        self.failed.remove(id);
        if let Some(frame) = self.frames.get_mut(id) {
            (frame.stamp, frame.attempt_count, frame.is_sparse) = (*candidate.stamp(), 0, false);
            (frame.was_closed, frame.waits_since) = (false, None);
        }
    }

    /// Waits again until a file is complete, and discards what is known about it.
    pub(super) fn start_over(&mut self, id: &FrameId) {
        let Some(stamp) = self.frames.get(id).map(|frame| frame.stamp) else { return };
        self.start_settling(id, Candidate::new(self.now.at, &Seen { stamp, age: None }, FileHint::Changed));
        self.inspect_settling(id, InspectionExtent::All);
    }

    fn unqueue(&mut self, id: &FrameId) {
        if let Some(FrameState { phase: FramePhase::Queued, stamp, .. }) = self.frames.get(id) {
            self.queue.remove(id, stamp.modified_ns);
        }
    }

    /// A file was removed. If its frame is in progress, the conversion ends first, and its result decides
    /// what happens to the frame.
    pub(super) fn remove(&mut self, id: &FrameId) {
        let Some(frame) = self.frames.get(id) else { return };
        if frame.phase == FramePhase::InProgress {
            return;
        }
        // Frames that waited for this one to measure the settings need not wait any longer.
        let sequence = frame.sequence;
        self.dirty_sequences.insert(sequence);
        self.unnumber_frame(id, sequence);
        self.unqueue(id);
        self.frames.remove(id);
        self.failed.remove(id);
        self.mark_changed(id);
        self.release_claim(id);
        self.forget_steps(id);
    }

    /// Releases the output names of a frame that will not write outputs. A frame that was refused because of
    /// these names may then claim them.
    pub(super) fn release_claim(&mut self, id: &FrameId) {
        let claimed = self.claim(id);
        if self.claims.get(&claimed) != Some(id) {
            return;
        }
        self.claims.remove(&claimed);
        let is_competitor =
            |(id, failure): &(&FrameId, &Failure)| failure.is_refusal && self.claim(id) == claimed;
        for competitor in
            self.failed.iter().filter(is_competitor).map(|(id, _)| id.clone()).collect::<Vec<_>>()
        {
            self.check_refusal(&competitor);
        }
    }

    /// Claims the outputs that frames had at the end of the last run, before any folder is scanned: which
    /// folder is scanned first must not decide which of two frames with the same outputs keeps them.
    /// `is_taken` says whether a file is a frame of a root.
    pub(crate) fn claim_recorded(&mut self, is_taken: impl Fn(usize, &Path) -> bool) {
        let mut owners = Vec::new();
        for (output, OutputFolder { records, .. }) in self.output_folders.iter().enumerate() {
            // Other frames have no outputs yet, or no longer.
            let is_owner = |record: &RecordedFrame| match record.unfinished_state() {
                Some(UnfinishedState::Refused | UnfinishedState::Failed | UnfinishedState::Ignored) => false,
                Some(UnfinishedState::Waiting) => record.done.is_some(),
                _ => true,
            };
            for (input, record) in records.frames.iter().filter(|(_, record)| is_owner(record)) {
                let file = step_in(input, true).map(|(file, _)| file);
                let mut roots = (0..self.roots.len()).filter(|&root| self.output_folder_of[root] == output);
                let id = roots.find_map(|root| match file {
                    Some(file) if is_taken(root, file) => Some(FrameId::step(root, input)),
                    _ => is_taken(root, input).then(|| FrameId::new(root, input)),
                });
                owners.extend(id.map(|id| (record.if_done().is_some(), record.at_ms(), id)));
            }
        }
        // If several frames had the same outputs, the last one that was finished has them.
        owners.sort();
        self.claims = owners.into_iter().map(|(.., id)| (self.claim(&id), id)).collect();
    }

    /// Whether a frame that has claimed outputs exists, or may still be found.
    fn may_exist(&self, id: &FrameId) -> bool {
        let root = &self.roots[id.root];
        let is_searched = |file: FrameId| {
            let phase = self.frames.phase(&file);
            matches!(
                phase,
                Some(FramePhase::Settling(_) | FramePhase::FindingSteps | FramePhase::Retrying(_))
            )
        };
        self.frames.get(id).is_some()
            || !root.was_scanned
            || root.unavailable.is_some()
            || root.unreadable.keys().any(|folder| id.path.starts_with(folder))
            || id.file().is_some_and(is_searched)
    }

    /// Releases the outputs of frames of a root that a scan did not find.
    fn release_claims_of_missing(&mut self, root: usize) {
        let is_missing = |id: &&FrameId| id.root == root && !self.may_exist(id);
        for id in self.claims.values().filter(is_missing).cloned().collect::<Vec<_>>() {
            self.release_claim(&id);
        }
    }

    /// The alarm of a frame is due.
    pub(super) fn on_alarm(&mut self, id: &FrameId) {
        match self.frames.phase(id) {
            Some(FramePhase::Settling(_)) => self.inspect_settling(id, InspectionExtent::All),
            Some(FramePhase::Retrying(at)) if at > self.now.at => self.frames.set_alarm(id, at),
            Some(FramePhase::Retrying(_)) => self.inspect(id, None),
            _ => {}
        }
    }

    /// Inspects a file that may be incomplete.
    pub(super) fn inspect_settling(&mut self, id: &FrameId, extent: InspectionExtent) {
        if let Some(frame) = self.frames.get(id)
            && let FramePhase::Settling(candidate) = frame.phase
        {
            let (stamp, sequence) = (frame.stamp, frame.sequence);
            // The completeness of a step is that of its file.
            let candidate = (!id.is_step()).then_some(candidate);
            let outputs = self.output_paths(id);
            let record_check = self.record_check(id, &stamp, sequence, &outputs);
            self.request_inspection(id, extent, outputs, candidate, record_check);
        }
    }

    /// Checks the outputs of a done frame.
    pub(super) fn check_outputs(&mut self, id: &FrameId) {
        // This inspection may replace one that was to read the file again.
        if self.frames.get(id).is_some_and(|frame| frame.was_closed) {
            return self.inspect(id, None);
        }
        if let Some(record) = self.record_of(id).cloned() {
            // The settings are current, and obstacles are inspected separately.
            self.inspect(id, Some(RecordCheck { record, checks_obstacles: false }));
        }
    }

    /// Checks a refused frame again: the other files may be gone. If another frame owns its outputs, it is
    /// checked when that frame releases them.
    pub(super) fn check_refusal(&mut self, id: &FrameId) {
        let is_refused = self.failed.get(id).is_some_and(|failure| failure.is_refusal);
        let owner = self.claims.get(&self.claim(id));
        let is_owned = owner.is_some_and(|owner| owner != id && self.may_exist(owner));
        if is_refused && !is_owned {
            self.inspect(id, None);
        }
    }

    /// Checks a failed frame again: the files that it names may be others now, or the conflict gone.
    pub(super) fn check_failed(&mut self, id: &FrameId) {
        match self.record_of(id).filter(|record| record.named().is_some()).cloned() {
            Some(record) => self.inspect(id, Some(RecordCheck { record, checks_obstacles: false })),
            None => self.check_refusal(id),
        }
    }

    /// Checks whether a file is unchanged.
    pub(super) fn check_stamp(&mut self, id: &FrameId) {
        self.request_inspection(id, InspectionExtent::Stamp, Vec::new(), None, None);
    }

    /// Inspects a file that is known to be complete: first its outputs and its record, then its stamp, then its kind
    /// and conflicts.
    pub(super) fn inspect(&mut self, id: &FrameId, record_check: Option<RecordCheck>) {
        let outputs = self.output_paths(id);
        self.request_inspection(id, InspectionExtent::All, outputs, None, record_check);
    }

    fn request_inspection(
        &mut self,
        id: &FrameId,
        extent: InspectionExtent,
        outputs: Vec<PathBuf>,
        candidate: Option<Candidate>,
        record_check: Option<RecordCheck>,
    ) {
        let Some((number, stamp)) = self.frames.begin_inspection(id) else { return };
        let inspect = Inspect { id: id.clone(), number, stamp, extent, record_check, candidate, outputs };
        self.request(id.root, RootRequest::Inspect(Box::new(inspect)));
    }

    /// The check of a frame against its record, if the record shows that the frame needs no conversion while
    /// its outputs and obstacles are unchanged.
    fn record_check(
        &self,
        id: &FrameId,
        stamp: &FileStamp,
        sequence: usize,
        wanted: &[PathBuf],
    ) -> Option<RecordCheck> {
        let record = self.record_of(id)?.clone();
        // The record may be of the same file in another root, with outputs in another folder.
        let paths: Vec<PathBuf> =
            record.done.iter().flat_map(|done| self.recorded_outputs(id, done)).collect();
        let unrecorded = wanted.iter().find(|path| !paths.contains(path)).map(PathBuf::as_path);
        let has_settings = |record: &RecordedFrame| self.has_settings_of(id, sequence, record);
        let reason = reason_by_record(Some(&record), stamp, has_settings, unrecorded);
        let checks_obstacles = !self.roots[id.root].obstacles.is_empty();
        reason.is_none().then_some(RecordCheck { record, checks_obstacles })
    }

    /// Whether a frame was recorded with the settings of its sequence, apart from its obstacles.
    fn has_settings_of(&self, id: &FrameId, sequence: usize, record: &RecordedFrame) -> bool {
        self.sequences.get(sequence).has_settings_of(record, &self.watch(id.root).outputs)
    }

    /// Handles the result of an inspection.
    pub(super) fn on_inspected(&mut self, inspected: Inspected) {
        let Inspected { id, number, found, obstacles } = inspected;
        let Some(frame) = self.frames.take_inspection(&id, number) else { return };
        let is_settling = matches!(frame.phase, FramePhase::Settling(_));
        let bytes = frame.stamp.size;
        frame.obstacles = obstacles;
        let was_inspected = std::mem::replace(&mut frame.was_inspected, true);
        // Its sequence may have waited for this inspection.
        self.dirty_sequences.insert(frame.sequence);
        if !was_inspected {
            self.mark_changed(&id);
        }
        match found {
            InspectionResult::Missing => self.remove(&id),
            InspectionResult::Unreadable(error) => self.on_file_unreadable(&id, error),
            InspectionResult::Changed(seen, at) => self.on_file_seen(&id, &seen, at, FileHint::Changed),
            InspectionResult::AsRecorded if is_settling => self.restore_record(&id),
            InspectionResult::Same | InspectionResult::AsRecorded => {}
            InspectionResult::Waiting { until, why } => {
                self.note_waiting(&id, &why);
                self.log_about(
                    &*id.path,
                    move |frame| tracing::debug!(%frame, bytes, "waiting because {why}"),
                );
                if let Some(until) = until {
                    self.frames.set_alarm(&id, until);
                }
            }
            InspectionResult::Complete(complete) => self.on_complete(&id, complete),
        }
    }

    /// A file exists, but the system refuses to inspect it.
    pub(super) fn on_file_unreadable(&mut self, id: &FrameId, error: io::Error) {
        if self.frames.get(id).is_none() {
            return;
        }
        self.failed_frame(id, &FrameError::file(&id.path, Stage::Read, error), None);
    }

    /// Records why a frame waits, unless it only has another size than before.
    fn note_waiting(&mut self, id: &FrameId, why: &Reason) {
        let unfinished = self.record_of(id).and_then(|record| record.unfinished.as_ref());
        let is_recorded = unfinished.is_some_and(|record| {
            record.state == UnfinishedState::Waiting
                && record.reason.as_ref().is_some_and(|recorded| recorded.is_like(why))
        });
        if !is_recorded {
            self.record_state(id, UnfinishedState::Waiting, Some(why.clone()), None);
        }
    }

    /// Records that a file, which was recorded as waiting, is not a frame.
    pub(super) fn note_ignored(&mut self, id: &FrameId, why: Reason) {
        let state = self.record_of(id).and_then(RecordedFrame::unfinished_state);
        if state == Some(UnfinishedState::Waiting) {
            self.record_state(id, UnfinishedState::Ignored, Some(why), None);
        }
    }

    /// Restores the state of a frame from its record.
    fn restore_record(&mut self, id: &FrameId) {
        let Some(record) = self.record_of(id).cloned() else { return };
        let phase = match &record.unfinished {
            Some(failed) => {
                let reason = failed.reason.as_ref().map(Reason::to_string).unwrap_or_default();
                self.failed.insert(id.clone(), Failure { reason, logged_at: None, is_refusal: false });
                FramePhase::Failed
            }
            // The frame claims its outputs, so that another input cannot take them.
            None if self.claim_outputs(id, None) => FramePhase::Done,
            None => return,
        };
        // Later, the stamp shows whether obstacles have changed.
        if let Some(frame) = self.frames.get_mut(id) {
            frame.obstacle_stamp = record.obstacle_stamp().cloned();
        }
        // Frames around it may have come or changed while no daemon ran.
        self.set_phase(id, phase);
        self.doubt_done(id);
    }

    /// A file is complete.
    fn on_complete(&mut self, id: &FrameId, complete: Complete) {
        let Complete { proof, changed_output, has_changed_files, contents, conflict } = complete;
        let reason = self.reason_to_convert(id, changed_output.as_ref().map(|output| &*output.path));
        let reason = reason.or_else(|| has_changed_files.then_some(Reason::NamedFilesChanged));
        if let Some(frame) = self.frames.get_mut(id) {
            (frame.was_closed, frame.reason) = (false, reason);
        }
        if let Some(refusal) = self.failed.get(id).filter(|failure| failure.is_refusal) {
            // The reason is logged and recorded already.
            if conflict.as_ref() == Some(&refusal.reason) {
                return;
            }
            self.failed.remove(id);
        }
        let is_done = self.frames.phase(id) == Some(FramePhase::Done);
        self.log_about(&*id.path, move |frame| match (proof, changed_output) {
            (Some(proof), _) => tracing::debug!(%frame, "ready: {proof}"),
            (None, Some(ChangedOutput { path, is_missing })) if is_done => {
                let what = if is_missing {
                    "is missing: converting the frame again"
                } else {
                    "has changed: comparing its content"
                };
                tracing::info!(%frame, "{} {what}", path.display());
            }
            _ => {}
        });
        match contents {
            FileContents::NotParticles => {
                self.ignore(id, "not a particle file, or a result of meniscus");
            }
            FileContents::Neighbor(neighbor) => {
                self.ignore(id, neighbor.words()[0]);
                self.log_neighbor(id, neighbor);
            }
            FileContents::MaybeSteps => self.find_steps(id, conflict),
            // The error may be temporary, so the steps are kept.
            FileContents::Unreadable(error) => self.on_file_unreadable(id, error),
            FileContents::Frame => {
                if !id.is_step() {
                    self.forget_steps(id);
                }
                self.accept(id, conflict);
            }
        }
    }

    /// Why a complete frame is to be converted.
    fn reason_to_convert(&self, id: &FrameId, changed_output: Option<&Path>) -> Option<Reason> {
        let (frame, record) = (self.frames.get(id)?, self.record_of(id));
        let has_settings = |record: &RecordedFrame| {
            let is_known = self.sequences.get(frame.sequence).settings_id().is_some();
            let has_obstacles = frame
                .obstacles
                .as_deref()
                .is_none_or(|stamps| record.obstacle_stamp() == Some(&obstacle_stamp(stamps)));
            !is_known || has_obstacles && self.has_settings_of(id, frame.sequence, record)
        };
        let reason = reason_by_record(record, &frame.stamp, has_settings, changed_output);
        reason.or_else(|| frame.was_closed.then_some(Reason::Closed))
    }

    fn ignore(&mut self, id: &FrameId, kind: &str) {
        self.note_ignored(id, Reason::NotAFrame(kind.to_owned()));
        self.forget_steps(id);
        self.release_claim(id);
        self.set_phase(id, FramePhase::Ignored);
    }

    /// Logs the first file of a sequence that is not of particles.
    fn log_neighbor(&mut self, id: &FrameId, neighbor: Neighbor) {
        let Some(index) = self.frames.get(id).map(|frame| frame.sequence) else { return };
        if !std::mem::replace(&mut self.sequences.get_mut(index).is_neighbor_logged, true) {
            let [one, _] = neighbor.words();
            self.log_about(&*id.path, move |path| tracing::info!(%path, "skipped: {one}"));
        }
    }

    /// Accepts a complete frame for conversion, or refuses it because its outputs would replace another file.
    pub(super) fn accept(&mut self, id: &FrameId, conflict: Option<String>) {
        if self.claim_outputs(id, conflict) {
            self.set_phase(id, FramePhase::Held);
            self.queue_if_ready(id);
        }
    }

    /// Queues a held frame, if its sequence has settings and it need not wait for the frames around it.
    pub(super) fn queue_if_ready(&mut self, id: &FrameId) {
        let Some(sequence) = self.frames.get(id).map(|frame| frame.sequence) else { return };
        match self.sequences.get(sequence).settings.clone() {
            SequenceSettings::Fixed(settings, _) if self.awaits_frames_around(id, &settings) => {}
            SequenceSettings::Fixed(settings, _) => self.enqueue(id, settings),
            SequenceSettings::Impossible(why) => self.fail_for_good(id, why),
            SequenceSettings::Unknown(_) | SequenceSettings::BeingMeasured => {
                self.dirty_sequences.insert(sequence);
            }
        }
    }

    fn enqueue(&mut self, id: &FrameId, settings: Arc<Settings>) {
        let Some(frame) = self.frames.get_mut(id) else { return };
        frame.waits_since = None;
        if frame.reason != Some(Reason::FramesAroundChanged) {
            frame.tried_around = None;
        }
        let modified_ns = frame.stamp.modified_ns;
        let sequence = self.sequences.get(frame.sequence);
        frame.obstacle_stamp = frame.obstacles.as_deref().map(obstacle_stamp);
        let obstacle_stamp = frame.obstacle_stamp.clone();
        let framing = sequence.framing.clone();
        let reason = frame.reason.clone();
        let file = id.frame_file(self.root_path(id.root));
        let outputs = self.output_options(id);
        // The thread of the pipeline adds the records: `io/pipeline.rs`.
        let obstacles = Arc::clone(&self.roots[id.root].obstacles);
        let frame = Frame { obstacles, framing, obstacle_stamp, ..Frame::new(&file, &settings, &outputs) };
        self.set_phase(id, FramePhase::Queued);
        self.record_state(id, UnfinishedState::Queued, reason, None);
        self.queue.push(id, Box::new(frame), modified_ns);
    }

    /// Requests the stamps of the obstacles of finished frames of a root: obstacles may have changed since.
    /// The file system sends no events for them.
    fn stamp_obstacles(&mut self, root: usize) {
        if self.roots[root].obstacles.is_empty() {
            return;
        }
        let frames = self.frames.iter().filter(|(id, frame)| id.root == root && has_ended(frame));
        let path = self.root_path(root);
        let numbers: BTreeSet<Option<i64>> = frames.map(|(id, _)| id.frame_file(path).number()).collect();
        self.request(root, RootRequest::StampObstacles(numbers));
    }

    /// Converts again the frames whose obstacles have changed.
    pub(super) fn on_obstacles_stamped(&mut self, root: usize, stamps: &FoundObstacleStamps) {
        let is_stale = |id: &FrameId, frame: &FrameState| {
            let is_refused = self.failed.get(id).is_some_and(|failure| failure.is_refusal);
            let was_begun = frame.obstacle_stamp.is_some() && !is_refused;
            if id.root != root || !has_ended(frame) || !was_begun {
                return false;
            }
            let of_frame: Option<&Arc<ObstacleStamps>> = match stamps {
                FoundObstacleStamps::Same(stamps) => Some(stamps),
                FoundObstacleStamps::PerNumber(stamps) => {
                    stamps.get(&id.frame_file(self.root_path(root)).number())
                }
            };
            // The removal of an obstacle does not count: the existing result stays.
            of_frame
                .filter(|stamps| stamps.all_exist)
                .is_some_and(|stamps| frame.obstacle_stamp != Some(obstacle_stamp(stamps)))
        };
        let mut stale = self.frames.ids_of(is_stale);
        stale.sort();
        for id in stale {
            self.log_about(&*id.path, |frame| {
                tracing::info!(%frame, "an obstacle has changed: converting the frame again");
            });
            self.failed.remove(&id);
            if let Some(frame) = self.frames.get_mut(&id) {
                frame.attempt_count = 0;
            }
            self.inspect(&id, None);
        }
    }

    /// The output options of a frame; sub-folders are mirrored below the folder of outputs.
    fn output_options(&mut self, id: &FrameId) -> Arc<OutputOptions> {
        let folder = id.mirrored_folder(self.root_path(id.root), &self.output_folder(id.root).folder);
        let options = &self.config.watches[id.root].outputs;
        let mirrored = self.mirrored_options.entry((id.root, folder)).or_insert_with_key(|(_, folder)| {
            Arc::new(OutputOptions { folder: folder.clone(), ..options.clone() })
        });
        Arc::clone(mirrored)
    }

    /// The output files of the frame.
    fn output_paths(&mut self, id: &FrameId) -> Vec<PathBuf> {
        let outputs = self.output_options(id);
        let stem = id.output_stem();
        outputs.files(&stem).into_iter().map(|(_, path)| path).collect()
    }

    /// Claims the names of a frame's outputs. If another frame owns them, or there is another conflict,
    /// refuses the frame and returns false.
    fn claim_outputs(&mut self, id: &FrameId, conflict: Option<String>) -> bool {
        let conflict = conflict.or_else(|| self.replaced_usd_stage(id));
        let claimed = self.claim(id);
        let owner = self.claims.get(&claimed).filter(|owner| *owner != id && self.may_exist(owner));
        let owned = owner.map(|owner| {
            format!(
                "{} and {} would both become {}.*: converting only the first; rename the second, or convert it into another folder",
                owner.path.display(),
                id.path.display(),
                self.claimed_stem(id).display(),
            )
        });
        match owned.or(conflict) {
            Some(conflict) => self.refuse(id, conflict),
            None => {
                self.claims.insert(claimed, id.clone());
                return true;
            }
        }
        false
    }

    /// The reason to refuse a frame with an output that would replace a stage; `None` if none would.
    fn replaced_usd_stage(&mut self, id: &FrameId) -> Option<String> {
        let stages = self.config.watches.iter().filter_map(|watch| watch.outputs.stage.as_ref());
        let stages: Vec<PathBuf> = stages.map(|stage| entry_key(stage.path.clone())).collect();
        if stages.is_empty() {
            return None;
        }
        let is_stage = |output: &PathBuf| stages.contains(&entry_key(output.clone()));
        let output = self.output_paths(id).into_iter().find(is_stage)?;
        Some(format!("its output {} would replace the stage: give another name to --stage", output.display()))
    }

    /// The outputs that a frame claims, as a key.
    fn claim(&self, id: &FrameId) -> PathBuf {
        entry_key(self.claimed_stem(id))
    }

    /// The path of a frame's outputs without their extensions.
    pub(super) fn claimed_stem(&self, id: &FrameId) -> PathBuf {
        let folder = id.mirrored_folder(self.root_path(id.root), &self.output_folder(id.root).folder);
        folder.join(id.output_stem())
    }

    pub(super) fn set_phase(&mut self, id: &FrameId, phase: FramePhase) {
        let was_frame = self.frames.phase(id).is_some_and(FramePhase::is_of_frame);
        let Some(sequence) = self.frames.set_phase(id, phase) else { return };
        match (was_frame, phase.is_of_frame()) {
            (false, true) => self.number_frame(id, sequence),
            (true, false) => self.unnumber_frame(id, sequence),
            _ => {}
        }
        if matches!(phase, FramePhase::Held | FramePhase::Done | FramePhase::Failed) {
            self.doubt_frames_around(id);
        }
        // The measurement of other frames in the sequence may have waited for this frame.
        if matches!(self.sequences.get(sequence).settings, SequenceSettings::Unknown(_)) {
            self.dirty_sequences.insert(sequence);
        }
        self.mark_changed(id);
    }

    /// The record of a frame, if it has one.
    pub(super) fn record_of(&self, id: &FrameId) -> Option<&RecordedFrame> {
        self.output_folder(id.root).records.frames.get(&*id.path)
    }

    /// The paths of recorded outputs.
    pub(super) fn recorded_outputs(&self, id: &FrameId, record: &DoneRecord) -> Vec<PathBuf> {
        record.output_paths(&self.output_folder(id.root).folder).collect()
    }
}

/// Whether a frame is done or has failed.
fn has_ended(frame: &FrameState) -> bool {
    matches!(frame.phase, FramePhase::Done | FramePhase::Failed)
}
