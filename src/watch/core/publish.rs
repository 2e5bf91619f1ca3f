//! Publishes views of frames, sequences and the daemon for clients, built from the state of the core.
//!
//! This module makes no decisions.

use std::path::Path;
use std::sync::Arc;

use serde_json::{Value, json};

use crate::pipeline::{
    DoneRecord, Job, Reason, RecordedFrame, SequenceRecord, UnfinishedRecord, UnfinishedState, text_of_name,
};
use crate::watch::config::{Order, Poll, Watch, WatchConfig};
use crate::watch::status_store::{
    FrameProgress, FrameSummary, FrameView, LiveStatus, OutputView, StatusStore,
};

use super::frames::{FrameCounts, FrameId, FramePhase, within};
use super::sequences::SequenceSettings;
use super::state::Core;

impl Core {
    /// Publishes what has changed since the last call.
    pub(crate) fn publish(&mut self, store: Option<&StatusStore>) {
        let frames = std::mem::take(&mut self.changed);
        let sequences = std::mem::take(&mut self.changed_sequences);
        let Some(store) = store else { return };
        store.set_counters(self.counters.clone());
        frames.iter().for_each(|id| self.show(id, store));
        for (name, record) in sequences.into_iter().filter_map(|index| self.shown_sequence(index)) {
            store.set_sequence(name, record);
        }
    }

    fn show(&self, id: &FrameId, store: &StatusStore) {
        let name = self.shown_name(id.root, self.root_path(id.root), &id.path);
        let frame = self.frames.get(id);
        let Some((frame, state)) = frame.and_then(|frame| Some((frame, state_of(frame.phase)?))) else {
            return store.remove(&name);
        };
        // The view has no stage, because only the pipeline knows the stage of a frame in progress.
        let record = self.record_of(id);
        let done = record.and_then(RecordedFrame::if_done).filter(|_| state == FrameProgress::Done);
        let outputs: Vec<OutputView> = done.map_or_else(Vec::new, |record| self.shown_outputs(id, record));
        let failure = self.failed.get(id).map(|failure| failure.reason.clone());
        let unfinished = record.and_then(|record| record.unfinished.as_ref());
        // A record of an earlier file or failure does not apply.
        let unfinished = unfinished.filter(|record| is_about(record, frame.phase));
        let reason = failure.or_else(|| unfinished?.reason.as_ref().map(ToString::to_string));
        let has_reason =
            matches!(state, FrameProgress::Waiting | FrameProgress::Retrying | FrameProgress::Failed);
        let named = |ending: &str| outputs.iter().find(|output| output.name.ends_with(ending));
        let [surface, picture] =
            [".glb", ".png"].map(|ending| named(ending).map(|output| output.name.clone()));
        store.update(FrameView {
            summary: FrameSummary {
                name: name.into(),
                state,
                stage: None,
                reason: reason.filter(|_| has_reason),
                since_ms: done.map_or(self.now.unix_ms, |done| done.at_ms),
                particles: done.and_then(|record| record.figures.particles),
                seconds: done.map(|record| record.figures.total_seconds()),
                surface,
                picture,
            },
            attempts: frame.attempt_count,
            input_bytes: frame.stamp.size,
            outputs,
            figures: done.map(|record| Arc::clone(&record.figures)),
            stem: self.claimed_stem(id),
        });
    }

    fn shown_outputs(&self, id: &FrameId, record: &DoneRecord) -> Vec<OutputView> {
        let folder = &self.output_folder(id.root).folder;
        let shown = record.output_paths(folder).zip(&record.outputs).map(|(path, file)| OutputView {
            name: self.shown_name(id.root, folder, &path),
            size_bytes: file.stamp.size,
            path,
        });
        shown.collect()
    }

    /// The name of a file in the status store: its path within the folder; with several watched folders,
    /// prefixed with the number of its watched folder.
    fn shown_name(&self, root: usize, folder: &Path, path: &Path) -> String {
        let name = text_of_name(within(path, folder).unwrap_or(path).as_os_str());
        match self.roots.len() {
            1 => name,
            _ => format!("{}/{name}", root + 1),
        }
    }

    /// The configuration of the daemon.
    pub(crate) fn plan(&self) -> Value {
        plan_of(&self.config)
    }

    fn shown_sequence(&self, index: usize) -> Option<(String, SequenceRecord)> {
        let sequence = self.sequences.get(index);
        let SequenceSettings::Fixed(settings, _) = &sequence.settings else { return None };
        let path = sequence.key.folder.join(&sequence.key.name);
        let name = self.shown_name(sequence.root, self.root_path(sequence.root), &path);
        let watch = self.watch(sequence.root);
        let made = (&watch.outputs, &*self.roots[sequence.root].obstacles);
        let remembered = self.output_folder(sequence.root).records.sequences.get(&sequence.key);
        let measured = remembered.filter(|_| watch.needs_measuring());
        let measured = measured.and_then(|record| record.measured.as_ref());
        let record = SequenceRecord::new(&name, &watch.job(), settings, (&watch.choices, measured), made);
        Some((name, record))
    }

    /// The state of the daemon.
    pub(crate) fn status(&self, memory_bytes: Option<u64>) -> LiveStatus {
        LiveStatus {
            paused: self.guard.reason(),
            unavailable: self.unavailable().map(|(path, why)| format!("{}: {why}", path.display())).collect(),
            stopping: self.is_stopping,
            disk_free_bytes: self.output_folders.iter().filter_map(|output| output.free_bytes).min(),
            memory_bytes,
        }
    }

    /// Folders that are unavailable, and why.
    pub(super) fn unavailable(&self) -> impl Iterator<Item = (&Path, &str)> {
        self.roots.iter().filter_map(|root| Some((&*root.path, root.unavailable.as_deref()?)))
    }

    /// The state of the daemon in one line.
    pub(crate) fn status_line(&self) -> String {
        let FrameCounts { settling, held, queued, finding_steps, retrying, done, failed, .. } =
            self.frames.counts();
        let mut status = format!("{done} done, {queued} queued");
        for (count, what) in [
            (settling, "not yet complete"),
            (finding_steps, "being indexed"),
            (held, "waiting for the spacing or camera of the sequence, or for the frames around them"),
            (retrying, "to retry"),
            (failed, "failed"),
        ] {
            if count > 0 {
                status += &format!(", {count} {what}");
            }
        }
        for (path, _) in self.unavailable() {
            status += &format!("; {} is unavailable", path.display());
        }
        if let Some(why) = self.guard.reason() {
            status += &format!("; paused: {why}");
        }
        status
    }
}

/// The state that clients see; `None` for files that are not frames.
fn state_of(phase: FramePhase) -> Option<FrameProgress> {
    Some(match phase {
        FramePhase::Settling(_) | FramePhase::Held | FramePhase::FindingSteps => FrameProgress::Waiting,
        FramePhase::Queued | FramePhase::InProgress => FrameProgress::Queued,
        FramePhase::Retrying(_) => FrameProgress::Retrying,
        FramePhase::Done => FrameProgress::Done,
        FramePhase::Failed => FrameProgress::Failed,
        FramePhase::Ignored | FramePhase::Steps => return None,
    })
}

/// Whether a record applies to the frame in its current phase.
fn is_about(record: &UnfinishedRecord, phase: FramePhase) -> bool {
    match record.state {
        UnfinishedState::Waiting => {
            let is_held_for_others = phase == FramePhase::Held && record.reason == Some(Reason::FramesAround);
            is_held_for_others || matches!(phase, FramePhase::Settling(_))
        }
        UnfinishedState::Queued => {
            matches!(phase, FramePhase::Queued | FramePhase::InProgress | FramePhase::Held)
        }
        UnfinishedState::Retrying => matches!(phase, FramePhase::Retrying(_)),
        UnfinishedState::Failed | UnfinishedState::Refused | UnfinishedState::AwaitsRestart => {
            phase == FramePhase::Failed
        }
        UnfinishedState::Ignored => false,
    }
}

/// The configuration of the daemon as JSON. Times in seconds, sizes in bytes.
fn plan_of(config: &WatchConfig) -> Value {
    let watch = |watch: &Watch| {
        let mut choices = watch.choices.clone();
        // The preset of particles is shown also if it is the default.
        if matches!(watch.job(), Job::Surface) {
            choices.preset.get_or_insert_default();
        }
        let choices: serde_json::Map<String, Value> =
            choices.to_pairs().into_iter().map(|(name, value)| (name.to_owned(), value.into())).collect();
        json!({
            "input": watch.input.to_string_lossy(),
            "output": watch.outputs.folder.to_string_lossy(),
            "pattern": watch.pattern,
            "sentinel": watch.sentinel,
            "formats": watch.outputs.formats.iter().map(|format| format.extension()).collect::<Vec<_>>(),
            "choices": choices,
            "obstacles": watch.obstacles.iter().map(|path| path.to_string_lossy()).collect::<Vec<_>>(),
        })
    };
    json!({
        "version": env!("CARGO_PKG_VERSION"),
        "once": config.once,
        "order": match config.order {
            Order::Natural => "natural",
            Order::Latest => "latest",
        },
        "threads": config.threads,
        "memory_bytes": config.memory_bytes,
        "disk_floor_bytes": config.disk_floor_bytes,
        "settle_s": config.settle.as_secs_f64(),
        "temporal_wait_s": config.temporal_wait.as_secs_f64(),
        "poll_s": match config.poll {
            Poll::Auto => None,
            Poll::Every(time) => Some(time.as_secs_f64()),
        },
        "watches": config.watches.iter().map(watch).collect::<Vec<_>>(),
    })
}
