//! The stage of `--stage`, which is updated while frames are converted.

use std::time::Instant;

use crate::pipeline::{OutputOptions, StageReport, StageSequence, next_stage_update, write_stage};

use super::CommandOutcome;
use super::console::Console;
use super::wording::{counted_are, pluralize};

/// Updates a stage.
pub(super) struct StageWriter {
    outputs: OutputOptions,
    /// All frames that the stage will have.
    sequences: Vec<StageSequence>,
    /// When the next update is due.
    due: Instant,
}

impl StageWriter {
    /// The stage that the options name, if they name one, with these frames.
    pub(super) fn new(
        outputs: &OutputOptions,
        sequences: impl FnOnce() -> Vec<StageSequence>,
    ) -> Option<StageWriter> {
        outputs.stage.as_ref()?;
        Some(StageWriter { outputs: outputs.clone(), sequences: sequences(), due: Instant::now() })
    }

    /// A frame is done. An error is left to [`StageWriter::finish`], because it may go away.
    pub(super) fn update(&mut self) {
        let start = Instant::now();
        if start < self.due {
            return;
        }
        let _ = write_stage(&self.outputs, &self.sequences);
        self.due = next_stage_update(start);
    }

    /// Writes the stage a last time, and reports it.
    pub(super) fn finish(self, outcome: CommandOutcome, console: &mut Console) -> CommandOutcome {
        let Some(path) = self.outputs.stage.as_ref().map(|stage| stage.path.display()) else {
            return outcome;
        };
        match write_stage(&self.outputs, &self.sequences) {
            Ok(Some(StageReport { mesh_count, volume_count, missing_count })) => {
                let frames = pluralize(mesh_count.max(volume_count), "frame");
                let missing = match missing_count {
                    0 => String::new(),
                    count => format!("; {} missing so far", counted_are(count as u64)),
                };
                console.print_line(format_args!("{path}: a stage of {frames}{missing}"));
                outcome
            }
            Ok(None) => {
                console.warning(format_args!("{path}: no stage was written, because no frame is done"));
                outcome
            }
            Err(error) => {
                console.error(error);
                if outcome == CommandOutcome::Done { CommandOutcome::SomeFailed } else { outcome }
            }
        }
    }
}
