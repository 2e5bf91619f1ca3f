//! Handles events one at a time: updates the state, and collects the effects.

use std::collections::HashSet;
use std::path::Path;
use std::time::Instant;

use crate::pipeline::natural_order;
use crate::watch::api::{EndReason, FailedFrame, WatchSummary};

use super::completeness::path_of_sentinel;
use super::events::{Effect, Event, Now, OutputDirState, OutputRequest, Presence, Start, Worker};
use super::frames::{FrameCounts, FrameId, FramePhase, FrameState};
use super::state::{Core, RootState, STALL_AFTER};

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
            Event::FrameRequested { pipeline } => self.requesting.push_back(pipeline),
            Event::FrameReturned { id, frame, found } => {
                if let Some(state) = self.frames.get_mut(&id) {
                    state.phase = FramePhase::Queued;
                    self.queue.push(&id, frame, state.stamp.modified_ns);
                }
                self.on_output_dir_checked(found);
            }
            Event::FrameFinished(finished) => self.on_finished(*finished),
            Event::PipelineEnded { pipeline } => self.requesting.retain(|requesting| *requesting != pipeline),
            Event::OutputDirChecked(found) => self.on_output_dir_checked(found),
            Event::WorkerStalled(worker) => self.set_stalled(worker, Some(now.at)),
            Event::WorkerAnswered(worker) => self.set_stalled(worker, None),
            Event::OutputSynced(_) => {}
        }
    }

    /// Carries out actions that are due, and decisions that depend on several events together. Must be called
    /// after each batch of events, and when [`Core::next_deadline`] is reached.
    pub(crate) fn settle_batch(&mut self, now: Now) {
        self.now = now;
        while let Some(id) = self.frames.next_alarm(now.at) {
            self.on_alarm(&id);
        }
        self.check_space();
        self.resolve_sequences();
        self.replace_stalled_pipeline();
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

    /// Gives frames to the pipelines that have asked for one.
    fn start_frames(&mut self) {
        while let Some(&pipeline) = self.requesting.front() {
            // A pipeline that was replaced because it hung responds again: it finishes its frames and ends.
            if self.is_stopping || pipeline != self.pipeline {
                self.requesting.pop_front();
                self.effects.push(Effect::EndPipeline(pipeline));
                continue;
            }
            if self.guard.reason().is_some() {
                return;
            }
            let may_begin: Vec<bool> = (0..self.roots.len()).map(|root| self.may_begin(root)).collect();
            let Some((id, frame)) = self.queue.pop(|root| may_begin[root]) else { return };
            self.requesting.pop_front();
            if let Some(state) = self.frames.get_mut(&id) {
                state.phase = FramePhase::InProgress(pipeline);
            }
            self.effects.push(Effect::Start(pipeline, Start { id, frame }));
        }
    }

    /// Starts another pipeline if frames of the current one wait for a file system that does not respond, so
    /// that frames of other folders are converted meanwhile.
    fn replace_stalled_pipeline(&mut self) {
        let may_others_begin = (0..self.roots.len()).any(|root| self.may_begin(root));
        if self.is_stopping || !may_others_begin || !self.has_stalled() {
            return;
        }
        let hangs = |(id, frame): (&FrameId, &FrameState)| {
            frame.phase == FramePhase::InProgress(self.pipeline) && !self.may_begin(id.root)
        };
        if !self.frames.iter().any(hangs) {
            return;
        }
        self.pipeline += 1;
        self.log(|| tracing::warn!("in-flight frames are blocked by a file system that does not respond: starting another pipeline for the other folders"));
        self.effects.push(Effect::StartPipeline(self.pipeline));
    }

    fn set_stalled(&mut self, worker: Worker, since: Option<Instant>) {
        let (path, stalled) = match worker {
            Worker::Root(root) => {
                let root = &mut self.roots[root];
                (root.path.clone(), &mut root.stalled_since)
            }
            Worker::Output(output) => {
                let output = &mut self.outputs[output];
                (output.folder.clone(), &mut output.stalled_since)
            }
        };
        *stalled = since;
        self.log_about(path, move |folder| match since {
            Some(_) => tracing::warn!(
                %folder,
                "folder is unavailable: its file system has not responded for {STALL_AFTER:?}; other folders continue"
            ),
            None => tracing::info!(%folder, "file system responds again"),
        });
    }

    fn on_output_dir_checked(&mut self, found: OutputDirState) {
        let OutputDirState { output, presence, free_bytes } = found;
        let dir = &mut self.outputs[output];
        (dir.is_mounted, dir.free_bytes) = (presence != Presence::Missing, free_bytes);
        if presence == Presence::Recreated {
            let folder = dir.folder.clone();
            self.log_about(
                folder,
                |folder| tracing::warn!(%folder, "output folder was removed and created again"),
            );
            // Its outputs may be gone as well.
            self.scan_all();
        }
        self.check_space();
    }

    /// Whether every folder was scanned once, except folders that hang. If no folder hangs, the files must
    /// have been inspected, too.
    pub(crate) fn is_ready(&self) -> bool {
        let is_waiting = self.roots.iter().any(|root| !root.was_scanned && root.stalled_since.is_none());
        let hangs = self.roots.iter().any(|root| root.stalled_since.is_some());
        !is_waiting && (hangs || !self.frames.is_inspecting(None))
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
        let is_busy = self.frames.is_inspecting(None) || !self.dirty_sequences.is_empty();
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
            self.give_up_on_held(&stuck);
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

    fn give_up_on_held(&mut self, stuck_sequences: &HashSet<usize>) {
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

    /// Whether frames are in progress; with `with_stalled`, including those that hang.
    pub(crate) fn has_frames_in_progress(&self, with_stalled: bool) -> bool {
        let is_in_progress = |(id, frame): (&FrameId, &FrameState)| {
            matches!(frame.phase, FramePhase::InProgress(_)) && (with_stalled || self.may_begin(id.root))
        };
        self.frames.iter().any(is_in_progress)
    }

    pub(crate) fn is_stopping(&self) -> bool {
        self.is_stopping
    }

    /// Whether a folder hangs.
    pub(crate) fn has_stalled(&self) -> bool {
        let roots = self.roots.iter().any(|root| root.stalled_since.is_some());
        roots || self.outputs.iter().any(|output| output.stalled_since.is_some())
    }

    /// Requests that all journals be synced to disk, and all stages written; returns the number of folders.
    pub(crate) fn sync_outputs(&mut self) -> usize {
        for output in 0..self.outputs.len() {
            self.effects.push(Effect::Output(output, OutputRequest::Sync));
        }
        self.outputs.len()
    }

    /// The summary of the run; failures in natural order.
    pub(crate) fn summary(&self, ended: EndReason) -> WatchSummary {
        let counts = self.frames.counts();
        let mut failed: Vec<_> = self.failed.iter().collect();
        failed.sort_by(|(a, _), (b, _)| natural_order(&a.path.to_string_lossy(), &b.path.to_string_lossy()));
        let failed = failed.into_iter().map(|(id, failure)| FailedFrame {
            what: about(&id.path, &failure.reason),
            frames_since: failure.logged_at.map(|logged_at| self.finished_count - logged_at),
        });
        let unreadable = self.roots.iter().flat_map(|root| &root.unreadable);
        let unreadable = unreadable.map(|(path, why)| (&**path, &**why));
        // With `once`, the run does not wait for a folder that hangs.
        let hanging = self.unavailable().filter(|_| self.config.once);
        let unreadable = unreadable.chain(hanging).map(|(path, why)| FailedFrame {
            what: about(path, why),
            frames_since: Some(self.finished_count),
        });
        WatchSummary {
            ended,
            done_count: counts.done,
            broken_count: self.broken_count(),
            failed: failed.chain(unreadable).collect(),
            left_count: counts.left(),
            has_unwritten: false,
        }
    }

    /// The number of done frames that failed validation, according to the journal.
    fn broken_count(&self) -> usize {
        let is_broken = |(id, frame): &(&FrameId, &FrameState)| {
            let figures = self.record_of(id).and_then(|record| record.figures.as_ref());
            frame.phase == FramePhase::Done && figures.is_some_and(|figures| !figures.certificate.holds)
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
