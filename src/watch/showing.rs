//! Shows what the loop knows, for whoever looks: frame by frame, as each changes.
//!
//! Nothing here decides anything. Without a board nothing is shown, and nothing else changes.

use std::path::{Component, Path};

use serde_json::{Value, json};

use crate::pipeline::{FrameFile, FrameReport, SequenceRecord, file_of, resident_memory_bytes, text_of_name};
use crate::watch::board::{Board, Figures, FrameState, FrameSummary, FrameView, OutputView, Status, now_ms};

use super::config::{Config, Order, Poll, Watch};
use super::frames::{FrameId, Phase};
use super::journal::{FrameRecord, Standing};
use super::mounts::free_bytes;
use super::rounds::Daemon;
use super::sequences::SequenceSettings;

impl Daemon<'_> {
    /// Shows a frame that was converted, and counts it.
    pub(super) fn show_converted(&self, id: &FrameId, report: &FrameReport) {
        let Some(board) = self.board else { return };
        let (input_bytes, output_bytes) = (report.input.stamp.size, report.output_bytes.iter().sum());
        board.count(|counters| counters.add_converted(&Figures::of(report), input_bytes, output_bytes));
        self.show(id);
    }

    /// Takes a frame off the board.
    pub(super) fn unshow(&self, id: &FrameId) {
        if let Some(board) = self.board {
            board.remove(&self.shown_name(id, &self.roots[id.root].path, &id.path));
        }
    }

    /// Shows how far a frame is.
    pub(super) fn show(&self, id: &FrameId) {
        let (Some(board), Some(frame)) = (self.board, self.frames.get(id)) else { return };
        let Some(state) = state_of(&frame.phase) else { return self.unshow(id) };
        let record = self.stores.of_watch(id.root).journal.state().frames.get(&*id.path);
        // That of an earlier file, or of an earlier failure, says nothing of this one.
        let record = record.filter(|record| is_about(record, &frame.phase));
        let done = record.filter(|_| state == FrameState::Done);
        let outputs: Vec<OutputView> = done.map_or_else(Vec::new, |record| self.shown_outputs(id, record));
        let failure = self.failed.get(id).map(|failure| failure.reason.clone());
        let reason = failure.or_else(|| record.and_then(|record| record.reason.clone()));
        let named = |ending: &str| outputs.iter().find(|output| output.name.ends_with(ending));
        let [surface, picture] =
            [".glb", ".png"].map(|ending| named(ending).map(|output| output.name.clone()));
        board.show(FrameView {
            summary: FrameSummary {
                name: self.shown_name(id, &self.roots[id.root].path, &id.path).into(),
                state,
                stage: None,
                reason: reason.filter(|_| state != FrameState::Done),
                since_ms: done.map_or_else(now_ms, |done| done.at_ms),
                particles: done.and_then(|record| record.particle_count),
                seconds: done.and_then(|record| record.seconds),
                surface,
                picture,
            },
            attempts: frame.attempt_count,
            input_bytes: frame.phase.stamp().size,
            outputs,
            figures: done.and_then(|record| record.figures.clone()),
            stem: self.shown_stem(id),
        });
    }

    /// Outputs as they are shown. One that is elsewhere, which the journal may say, has no name here, and nobody is to
    /// read it through the board.
    fn shown_outputs(&self, id: &FrameId, record: &FrameRecord) -> Vec<OutputView> {
        let folder = &self.stores.of_watch(id.root).folder;
        let inside = record.outputs.iter().filter(|output| is_inside(&output.path, folder));
        let shown = inside.map(|output| OutputView {
            name: self.shown_name(id, folder, &output.path),
            size_bytes: output.size_bytes,
            path: output.path.clone(),
        });
        shown.collect()
    }

    /// What a file is called on the board: its path within the folder, and where there are several, the number of the
    /// watched one before it.
    fn shown_name(&self, id: &FrameId, folder: &Path, path: &Path) -> String {
        let within = text_of_name(path.strip_prefix(folder).unwrap_or(path).as_os_str());
        match self.roots.len() {
            1 => within,
            _ => format!("{}/{within}", id.root + 1),
        }
    }

    /// What a frame's outputs are called, but for their extensions.
    fn shown_stem(&self, id: &FrameId) -> std::path::PathBuf {
        let root = &self.roots[id.root].path;
        let folder = &self.stores.of_watch(id.root).folder;
        let within = file_of(&id.path).parent().and_then(|folder| folder.strip_prefix(root).ok());
        let folder = within.map_or_else(|| folder.clone(), |within| folder.join(within));
        folder.join(FrameFile::new(id.path.to_path_buf()).stem())
    }

    /// Shows what the daemon was asked for, in place of all that was shown.
    pub(super) fn show_plan(&self) {
        if let Some(board) = self.board {
            let watches: Vec<&Watch> = self.roots.iter().map(|root| root.watch).collect();
            board.begin(plan_of(self.config, &watches));
        }
    }

    /// Shows the settings of a sequence, if it has any.
    pub(super) fn show_sequence(&self, index: usize) {
        let sequence = self.sequences.get(index);
        let (Some(board), SequenceSettings::Fixed(settings, _)) = (self.board, &sequence.settings) else {
            return;
        };
        let place = sequence.key.folder.join(&sequence.key.name);
        let id = FrameId::new(sequence.root, &place);
        let name = self.shown_name(&id, &self.roots[sequence.root].path, &place);
        let watch = &self.config.watches[sequence.root];
        let made = (&watch.outputs, &*self.obstacles[sequence.root]);
        let remembered = self.stores.of_watch(sequence.root).journal.state().sequences.get(&sequence.key);
        let measured = remembered.filter(|_| watch.needs_spacing());
        let measured = measured.and_then(|record| record.measured.as_ref());
        board.show_sequence(name.clone(), SequenceRecord::new(&name, &watch.job(), settings, measured, made));
    }

    /// Shows how the daemon is.
    pub(super) fn show_status(&self, stopping: bool) {
        let Some(board) = self.board else { return };
        let unavailable = self.roots.iter().filter_map(|root| {
            root.unavailable.as_ref().map(|why| format!("{}: {why}", root.path.display()))
        });
        board.tell(Status {
            paused: self.room.shortage(),
            unavailable: unavailable.collect(),
            stopping,
            disk_free_bytes: self.stores.iter().filter_map(|store| free_bytes(&store.folder).ok()).min(),
            memory_bytes: resident_memory_bytes(),
        });
    }
}

/// How far a frame is; `None` if it is no frame.
fn state_of(phase: &Phase) -> Option<FrameState> {
    Some(match phase {
        Phase::Settling(_) | Phase::Held(_) | Phase::GoneThrough(_) => FrameState::Waiting,
        Phase::Queued(_) => FrameState::Queued,
        Phase::Retrying(..) => FrameState::Retrying,
        Phase::Done(_) => FrameState::Done,
        Phase::Failed(_) => FrameState::Failed,
        Phase::Ignored(_) | Phase::Steps(_) => return None,
    })
}

/// Whether a file is in the folder, or in one below it.
fn is_inside(path: &Path, folder: &Path) -> bool {
    let within = path.strip_prefix(folder);
    within.is_ok_and(|within| within.components().all(|part| matches!(part, Component::Normal(_))))
}

/// Whether a record is about the frame as it is now.
fn is_about(record: &FrameRecord, phase: &Phase) -> bool {
    match record.standing {
        Standing::Done => matches!(phase, Phase::Done(_)),
        Standing::Queued => matches!(phase, Phase::Queued(_) | Phase::Held(_)),
        Standing::Retrying => matches!(phase, Phase::Retrying(..)),
        Standing::Failed | Standing::Refused | Standing::GivenUp => matches!(phase, Phase::Failed(_)),
    }
}

/// What the daemon was asked for. Times in seconds, sizes in bytes.
fn plan_of(config: &Config, watches: &[&Watch]) -> Value {
    let watch = |watch: &&Watch| {
        let choices: serde_json::Map<String, Value> = watch
            .choices
            .to_pairs()
            .into_iter()
            .map(|(name, value)| (name.to_owned(), value.into()))
            .collect();
        json!({
            "input": watch.input.to_string_lossy(),
            "output": watch.outputs.folder.to_string_lossy(),
            "pattern": watch.pattern,
            "recursive": watch.recursive,
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
        "in_flight": config.in_flight,
        "memory_bytes": config.memory_bytes,
        "disk_floor_bytes": config.disk_floor_bytes,
        "settle_s": config.patience.settle.as_secs_f64(),
        "unproven_s": config.patience.unproven.as_secs_f64(),
        "stalled_s": config.patience.stalled.as_secs_f64(),
        "poll_s": match config.poll {
            Poll::Auto => None,
            Poll::Every(time) => Some(time.as_secs_f64()),
        },
        "rescan_s": config.rescan_every.as_secs_f64(),
        "watches": watches.iter().map(watch).collect::<Vec<_>>(),
    })
}

/// Counts something, if there is a board.
pub(super) fn count(board: Option<&Board>, count: impl FnOnce(&mut crate::watch::board::Counters)) {
    if let Some(board) = board {
        board.count(count);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn outputs_are_inside_their_folder() {
        let is_inside = |path: &str| is_inside(Path::new(path), Path::new("/a/out"));
        for path in ["/a/out/dam.1.glb", "/a/out/sub/dam.1.glb"] {
            assert!(is_inside(path), "{path}");
        }
        for path in ["/a/out2/dam.1.glb", "/a/dam.1.glb", "/a/out/../dam.1.glb", "dam.1.glb", "/etc/passwd"] {
            assert!(!is_inside(path), "{path}");
        }
    }
}
