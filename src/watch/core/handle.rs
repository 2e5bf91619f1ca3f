//! Handles events one at a time: updates the state, and collects the effects.

use std::collections::HashSet;
use std::path::Path;
use std::time::Instant;

use crate::pipeline::natural_order;
use crate::watch::api::{EndReason, FailedFrame, WatchSummary};

use super::completeness::path_of_sentinel;
use super::events::{Effect, Event, FrameToConvert, Now, OutputFolderState, OutputRequest};
use super::frames::{FrameCounts, FrameId, FramePhase, FrameState};
use super::state::{Core, RootState};

impl Core {
    /// Handles an event. Its effects are returned by [`Core::take_effects`].
    pub(crate) fn handle(&mut self, event: Event, now: Now) {
        self.now = now;
        match event {
            Event::FileSeen { id, seen, at, hint } => self.on_file_seen(&id, &seen, at, hint),
            Event::FileRemoved(id) => self.remove(&id),
            Event::FileUnreadable(id, error) => self.on_file_unreadable(&id, error),
            Event::SentinelSeen(root, path) => self.on_sentinel_seen(root, &path),
            Event::FolderScanned { root, files, at } => self.on_files_scanned(root, files, at),
            Event::RootScanned { root, found, at } => self.on_root_scanned(root, found, at),
            Event::Inspected(inspected) => self.on_inspected(*inspected),
            Event::ObstaclesStamped { root, stamps } => self.on_obstacles_stamped(root, &stamps),
            Event::Measured(measured) => self.on_measured(*measured),
            Event::StepsFound(found) => self.on_steps_found(found),
            Event::FrameRequested => self.requested_count += 1,
            Event::FrameFinished(finished) => self.on_finished(*finished),
            Event::OutputFolderChecked(found) => self.on_output_folder_checked(found),
            // The event loop handles these.
            Event::PipelineEnded | Event::OutputSynced(_) => {}
        }
    }

    /// Carries out actions that are due, and decisions that depend on several events together. Must be called
    /// after each batch of events, and when [`Core::next_deadline`] is reached.
    pub(crate) fn follow_up(&mut self, now: Now) {
        self.now = now;
        while let Some(id) = self.frames.next_alarm(now.at) {
            self.on_alarm(&id);
        }
        self.check_space();
        self.resolve_sequences();
        self.resolve_frames_around();
        self.start_frames();
    }

    /// When the next action is due.
    pub(crate) fn next_deadline(&self) -> Option<Instant> {
        self.frames.alarm_at()
    }

    /// Takes the effects, in the order in which they must be carried out.
    pub(crate) fn take_effects(&mut self) -> Vec<Effect> {
        std::mem::take(&mut self.effects)
    }

    /// Gives frames to the pipeline, if it has asked for some.
    fn start_frames(&mut self) {
        while self.requested_count > 0 && !self.is_stopping && self.guard.reason().is_none() {
            let Some((id, mut frame)) = self.queue.pop() else { return };
            // More frames around it may have come since it was queued.
            frame.around = self.frames_around(&id, &frame.settings);
            self.requested_count -= 1;
            // A frame around it is being written again: it is left out now, and after this conversion the
            // frames around are compared again.
            if let Some(state) = self.frames.get_mut(&id)
                && state.tried_around.as_ref().is_some_and(|tried| frame.around.len() < tried.len())
            {
                state.tried_around = None;
            }
            self.set_phase(&id, FramePhase::InProgress);
            self.effects.push(Effect::Convert(FrameToConvert { id, frame }));
        }
    }

    fn on_output_folder_checked(&mut self, found: OutputFolderState) {
        let OutputFolderState { output, was_removed, lost, free_bytes } = found;
        let output = &mut self.output_folders[output];
        (output.lost, output.free_bytes) = (lost, free_bytes);
        if was_removed {
            let folder = output.folder.clone();
            self.log_about(
                folder,
                |folder| tracing::warn!(%folder, "output folder was replaced or created again"),
            );
            // Its outputs may be gone as well.
            self.scan_all();
        }
        self.check_space();
    }

    /// Whether every folder was scanned once, and the files were inspected.
    pub(crate) fn is_ready(&self) -> bool {
        self.roots.iter().all(|root| root.was_scanned) && !self.frames.is_inspecting(None)
    }

    /// The first root that cannot be scanned, and why.
    pub(crate) fn unavailable_root(&self) -> Option<(usize, String)> {
        let why = |(index, root): (usize, &RootState)| Some((index, root.unavailable.clone()?));
        self.roots.iter().enumerate().find_map(why)
    }

    /// Whether nothing is left to do. If so, frames that wait for a missing sentinel, and held frames of the
    /// same sequences, are left unconverted. Other held frames fail, because their settings cannot be
    /// measured.
    pub(crate) fn is_drained(&mut self) -> bool {
        let is_busy = self.frames.is_inspecting(None)
            || !self.dirty_sequences.is_empty()
            || !self.waiting_around.is_empty()
            || !self.doubtful_around.is_empty();
        if !self.is_ready() || self.queue.len() > 0 || self.measuring_count > 0 || is_busy {
            return false;
        }
        let counts = self.frames.counts();
        let FrameCounts { stuck, held, .. } = counts;
        if counts.left() > stuck + held {
            return false;
        }
        let stuck = self.log_stuck();
        if held > 0 {
            self.refuse_held(&stuck);
        }
        true
    }

    /// Logs the frames that are left because their sentinels are missing. Returns their sequences.
    fn log_stuck(&mut self) -> HashSet<usize> {
        let stuck = self.frames.ids_of(|_, frame| frame.is_stuck());
        for id in &stuck {
            let sentinel = path_of_sentinel(self.watch(id.root), &id.path);
            self.log_about(&*id.path, move |frame| {
                tracing::warn!(%frame, "not converted: {} is missing, or older than the frame", sentinel.display());
            });
        }
        stuck.iter().filter_map(|id| self.frames.get(id)).map(|frame| frame.sequence).collect()
    }

    fn refuse_held(&mut self, stuck_sequences: &HashSet<usize>) {
        let is_meant = |frame: &FrameState| {
            frame.phase == FramePhase::Held && !stuck_sequences.contains(&frame.sequence)
        };
        for id in self.frames.ids_of(|_, frame| is_meant(frame)) {
            self.refuse(&id, TOO_SPARSE.to_owned());
        }
    }

    /// Stops starting frames.
    pub(crate) fn stop(&mut self) {
        self.is_stopping = true;
    }

    pub(crate) fn is_stopping(&self) -> bool {
        self.is_stopping
    }

    /// Requests that all records be synced to disk, and all stages written; returns the number of folders.
    pub(crate) fn sync_outputs(&mut self) -> usize {
        for output in 0..self.output_folders.len() {
            self.effects.push(Effect::Output(output, OutputRequest::Sync));
        }
        self.output_folders.len()
    }

    /// The summary of the run; failures in natural order.
    pub(crate) fn summary(&self, ended: EndReason) -> WatchSummary {
        let counts = self.frames.counts();
        let mut failures: Vec<_> = self.failed.iter().collect();
        failures
            .sort_by(|(a, _), (b, _)| natural_order(&a.path.to_string_lossy(), &b.path.to_string_lossy()));
        let mut failed = Vec::new();
        for (id, failure) in failures {
            let frames_since = failure.logged_at.map(|logged_at| self.finished_count - logged_at);
            failed.push(FailedFrame { message: about(&id.path, &failure.reason), frames_since });
        }
        let unreadable = self.roots.iter().flat_map(|root| &root.unreadable);
        let unreadable = unreadable.map(|(path, why)| (&**path, &**why));
        for (path, why) in unreadable {
            let frames_since = Some(self.finished_count);
            failed.push(FailedFrame { message: about(path, why), frames_since });
        }
        WatchSummary {
            ended,
            done_count: counts.done,
            broken_count: self.broken_count(),
            failed,
            left_count: counts.left(),
            has_unwritten: false,
        }
    }

    /// The number of done frames that failed validation.
    fn broken_count(&self) -> usize {
        let is_broken = |(id, frame): &(&FrameId, &FrameState)| {
            let done = self.record_of(id).and_then(|record| record.done.as_ref());
            frame.phase == FramePhase::Done && done.is_some_and(|record| record.violations.is_some())
        };
        self.frames.iter().filter(is_broken).count()
    }
}

/// The reason, prefixed with the path unless it already contains it.
fn about(path: &Path, reason: &str) -> String {
    let path = path.display().to_string();
    if reason.contains(&path) { reason.to_owned() } else { format!("{path}: {reason}") }
}

/// Why a frame has no settings at the end of a run; `convert` prints the same text.
const TOO_SPARSE: &str = "cannot measure the particle spacing, because no frame of the sequence has two \
                          particles in different places: give --spacing";
