//! The stage of `--stage`, which is updated while frames are converted.

use std::time::Instant;

use crate::pipeline::{
    OutputOptions, StageReport, StageSequence, next_stage_update, stage_frame_count, write_stage,
};

use super::CommandOutcome;
use super::console::Console;
use super::wording::pluralize;

/// Updates a stage.
pub(super) struct StageWriter {
    outputs: OutputOptions,
    /// All frames that the stage will have.
    sequences: Vec<StageSequence>,
    /// The number of frames in the stage that is replaced.
    former_count: usize,
    /// When the next update is due.
    due: Instant,
}

/// Maximum number of missing files that are named, and of frames that are left out.
const NAMED_MAX: usize = 3;

impl StageWriter {
    /// The stage that the options name, if they name one, with these frames.
    pub(super) fn new(
        outputs: &OutputOptions,
        sequences: impl FnOnce() -> Vec<StageSequence>,
    ) -> Option<StageWriter> {
        let former_count = stage_frame_count(&outputs.stage.as_ref()?.path).ok().flatten().unwrap_or(0);
        let (outputs, sequences) = (outputs.clone(), sequences());
        Some(StageWriter { outputs, sequences, former_count, due: Instant::now() })
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
            Ok(Some(StageReport { frame_count, missing, left_out, .. })) => {
                left_out.iter().take(NAMED_MAX).for_each(|why| console.warning(why));
                if left_out.len() > NAMED_MAX {
                    let more = pluralize(left_out.len() - NAMED_MAX, "more file");
                    console.warning(format_args!("{path}: {more} left out for such reasons"));
                }
                if frame_count == 0 {
                    let what = format!("{path}: no stage was written, because it can have no finished frame");
                    // Other frames may come, for example from other shards.
                    if !missing.is_empty() {
                        console.warning(what);
                        return outcome;
                    }
                    console.error(what);
                    return failed(outcome);
                }
                let frames = pluralize(frame_count, "frame");
                console.print_line(format_args!("{path}: a stage of {frames}{}", named(&missing)));
                if frame_count < self.former_count {
                    console.warning(format_args!(
                        "{path}: it had {} before: a stage plays only the frames of the inputs of one command",
                        pluralize(self.former_count, "frame")
                    ));
                }
                outcome
            }
            Ok(None) => {
                console.warning(format_args!("{path}: no stage was written, because no frame is done"));
                outcome
            }
            Err(error) => {
                console.error(error);
                failed(outcome)
            }
        }
    }
}

/// The outcome of a command whose stage could not be written.
fn failed(outcome: CommandOutcome) -> CommandOutcome {
    if outcome == CommandOutcome::Done { CommandOutcome::SomeFailed } else { outcome }
}

/// The files that are missing.
fn named(missing: &[String]) -> String {
    if missing.is_empty() {
        return String::new();
    }
    let others = (missing.len() > NAMED_MAX).then_some("..");
    let names: Vec<&str> = missing.iter().take(NAMED_MAX).map(String::as_str).chain(others).collect();
    let are = if missing.len() == 1 { "is" } else { "are" };
    format!("; {} {are} missing so far: {}", pluralize(missing.len(), "file"), names.join(", "))
}
