//! Runs a batch of frames through the pipeline: prints their outcomes in input order, and a summary.

use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Instant;

use anyhow::Result;
use rayon::ThreadPool;

use crate::pipeline::{
    self, Frame, FrameFile, FrameReport, Job, OnError, Outcome, OutputFormat, OutputOptions, PipelineOptions,
    ReportedWarnings, RunRecord, SequenceRecord, SequenceSource, UsdStageReport, UsdStageSequence,
    next_stage_update, output_path, shown, stage_frame_count, write_stage,
};

use super::CommandOutcome;
use super::args::ConvertArgs;
use super::console::{Console, ProgressDisplay};
use super::machine::{memory_bytes, thread_pool};
use super::wording::{FRAMES_IN_VIEW, described, failed_validation, pluralize, velocity_hint};

/// A frame of a batch.
struct BatchItem {
    input: PathBuf,
    /// The index of the frame's sequence in the record.
    sequence_index: usize,
    /// The frame to convert, or why its sequence has no settings.
    frame: Result<Frame, String>,
}

/// The frames to convert, and their outcomes.
pub(super) struct Batch<'a> {
    args: &'a ConvertArgs,
    start: Instant,
    on_error: OnError,
    /// Memory limit for all frames in flight together.
    memory_bytes: u64,
    /// The threads for all computations.
    pub(super) pool: Arc<ThreadPool>,
    /// In the order of the inputs.
    items: Vec<BatchItem>,
    sequence_names: Vec<String>,
    record: RunRecord,
    outcomes: Outcomes,
}

/// The outcomes of frames.
#[derive(Default)]
struct Outcomes {
    /// The number of frames that were counted so far, with those that never entered the pipeline. These are the
    /// first frames of the batch.
    noted_count: usize,
    done_count: usize,
    /// Frames that were converted but failed validation.
    broken_count: usize,
    not_started_count: usize,
    failures: Vec<String>,
    /// Whether the machine failed, in one of them.
    has_machine_failed: bool,
    /// The value of `noted_count` at the first failure.
    noted_at_first_failure: Option<usize>,
    /// The warnings that were printed, by the index of their sequence.
    printed: HashMap<usize, ReportedWarnings>,
    /// The number of warnings, of all sequences, that were not printed because a similar one of the same
    /// sequence was.
    suppressed_count: usize,
    /// Whether the hint about unused velocities was printed.
    is_velocity_hinted: bool,
    /// The .glb files of the frames that were converted, by this run or an earlier one.
    sequence_frames: Vec<SequenceSource>,
}

impl<'a> Batch<'a> {
    /// An empty batch of a command that started at `start`.
    ///
    /// # Errors
    /// If the memory limit is too small, or threads cannot be started.
    pub(super) fn new(args: &'a ConvertArgs, start: Instant) -> Result<Batch<'a>> {
        let pool = Arc::new(thread_pool(args.run.threads)?);
        Ok(Batch {
            args,
            start,
            on_error: args.on_error.unwrap_or(OnError::Continue),
            memory_bytes: memory_bytes(args.run.memory)?,
            items: Vec::new(),
            sequence_names: Vec::new(),
            record: RunRecord::new(pool.current_num_threads()),
            outcomes: Outcomes::default(),
            pool,
        })
    }

    /// Adds the selected frames of a sequence.
    pub(super) fn add(&mut self, name: &str, record: SequenceRecord, frames: impl Iterator<Item = Frame>) {
        let sequence_index = self.add_sequence(name, record);
        let item = |frame: Frame| BatchItem { input: frame.input.clone(), sequence_index, frame: Ok(frame) };
        self.items.extend(frames.map(item));
    }

    /// Adds the selected frames of a sequence that has no settings, for this reason.
    pub(super) fn add_impossible(&mut self, name: &str, selected: &[FrameFile], why: &str) {
        let sequence_index = self.add_sequence(name, SequenceRecord::without_settings(name, why));
        let item = |file: &FrameFile| BatchItem {
            input: file.path.clone(),
            sequence_index,
            frame: Err(why.to_owned()),
        };
        self.items.extend(selected.iter().map(item));
    }

    /// Whether there are frames with numbers, and none has others around it.
    pub(super) fn lacks_frames_around(&self) -> bool {
        let frames = self.items.iter().filter_map(|item| item.frame.as_ref().ok());
        let mut frames = frames.filter(|frame| frame.number.is_some()).peekable();
        frames.peek().is_some() && frames.all(|frame| frame.around.is_empty())
    }

    fn add_sequence(&mut self, name: &str, record: SequenceRecord) -> usize {
        self.sequence_names.push(name.to_owned());
        self.record.add_sequence(record)
    }

    /// Converts all added frames. Meanwhile updates the USD stage of `--stage` from time to time.
    pub(super) fn run_pipeline(&mut self, mut stage: Option<&mut UsdStageWriter>, console: &mut Console) {
        let items = std::mem::take(&mut self.items);
        let first_impossible = items.iter().position(|item| item.frame.is_err());
        // With --on-error stop, the frames after the first one that is known to fail are not started.
        let start_count = first_impossible.filter(|_| self.on_error == OnError::Stop).unwrap_or(items.len());
        let (item_indices, frames): (Vec<usize>, Vec<Frame>) = items[..start_count]
            .iter()
            .enumerate()
            .filter_map(|(item_index, item)| Some((item_index, item.frame.clone().ok()?)))
            .unzip();
        let pool = Arc::clone(&self.pool);
        let has_bar = console.show_bar(frames.len());
        let progress = ProgressDisplay::new(frames.len(), pool.current_num_threads(), console.bar());
        let options = PipelineOptions {
            on_error: self.on_error,
            // A shard is repeated until its frames are done.
            skip_done: self.args.skip_done || self.args.shard.is_some(),
            memory_bytes: self.memory_bytes,
            observer: Some(&progress),
            ..PipelineOptions::new(&pool)
        };
        pipeline::run(&frames, &options, |index, outcome| {
            let report = if let Outcome::Converted(report) = &outcome { Some(&**report) } else { None };
            progress.finished(&frames[index], report);
            // The record and the console follow the order of the inputs.
            self.note_without_outcome(&items[self.outcomes.noted_count..item_indices[index]], console);
            self.note(&frames[index], items[item_indices[index]].sequence_index, &outcome, has_bar, console);
            if let Some(stage) = &mut stage {
                stage.update();
            }
        });
        console.hide_bar();
        self.note_without_outcome(&items[self.outcomes.noted_count..], console);
    }

    /// Records the frames that did not enter the pipeline.
    fn note_without_outcome(&mut self, items: &[BatchItem], console: &Console) {
        let mut printed = None;
        for BatchItem { input, sequence_index, frame } in items {
            let is_stopped = self.on_error == OnError::Stop && !self.outcomes.failures.is_empty();
            match frame {
                Err(why) if !is_stopped => {
                    // The reason is the same for all frames of a sequence.
                    if printed.replace(*sequence_index) != Some(*sequence_index) {
                        let name = &self.sequence_names[*sequence_index];
                        // An error of reading a file already contains the path.
                        let of = if why.contains(&**name) { String::new() } else { format!("{name}: ") };
                        console.error(format_args!("{of}{why}"));
                    }
                    self.record.add_failed(input, *sequence_index, why);
                    self.fail(format!("{}: {why}", shown(input)));
                }
                _ => {
                    self.record.add_not_started(input, *sequence_index);
                    self.outcomes.not_started_count += 1;
                }
            }
        }
        self.outcomes.noted_count += items.len();
    }

    fn note(
        &mut self,
        frame: &Frame,
        sequence_index: usize,
        outcome: &Outcome,
        has_bar: bool,
        console: &mut Console,
    ) {
        self.outcomes.noted_count += 1;
        self.record.add_frame(frame, sequence_index, outcome);
        let name = shown(&frame.input);
        if matches!(outcome, Outcome::Converted(_) | Outcome::AlreadyDone { .. })
            && frame.outputs.formats.contains(&OutputFormat::Glb)
        {
            let path = output_path(&frame.outputs.folder, &frame.stem, OutputFormat::Glb);
            self.outcomes.sequence_frames.push(SequenceSource { path, number: frame.number });
        }
        match outcome {
            Outcome::Converted(report) => {
                self.note_converted(frame, sequence_index, report, console);
                if !has_bar {
                    console.print_line(format_args!("{name}: {}", described(&frame.job, report)));
                }
            }
            Outcome::AlreadyDone { record, .. } => {
                self.note_done(&frame.input, record.violations.as_deref(), console);
                if !has_bar {
                    console.print_line(format_args!("{name}: done already"));
                }
            }
            Outcome::Changed => {
                let failure = format!("{name}: the file was written while it was read");
                self.fail_frame(frame, failure, console);
            }
            Outcome::Failed(error) => {
                self.outcomes.has_machine_failed |= error.is_of_machine();
                self.fail_frame(frame, error.to_string(), console);
            }
            Outcome::NotStarted => self.outcomes.not_started_count += 1,
        }
        console.advance_bar();
    }

    /// Counts a converted frame, and prints its warnings.
    fn note_converted(
        &mut self,
        frame: &Frame,
        sequence_index: usize,
        report: &FrameReport,
        console: &mut Console,
    ) {
        self.outcomes.done_count += 1;
        let has_surface = frame.job != Job::Particles;
        self.outcomes.broken_count += usize::from(has_surface && !report.keeps_guarantees());
        let printed = self.outcomes.printed.entry(sequence_index).or_default();
        for warning in report.all_warnings() {
            if printed.is_new(&warning) {
                console.warning(format_args!("{}: {warning}", shown(&frame.input)));
            } else {
                self.outcomes.suppressed_count += 1;
            }
        }
        // The hint is printed once.
        if let Some(velocity) = &report.unused_velocity
            && !std::mem::replace(&mut self.outcomes.is_velocity_hinted, true)
        {
            console.print_line(format_args!("note: {}", velocity_hint(velocity)));
        }
    }

    /// Counts a frame that an earlier run converted.
    fn note_done(&mut self, input: &Path, fault: Option<&str>, console: &Console) {
        self.outcomes.done_count += 1;
        if let Some(fault) = fault {
            self.outcomes.broken_count += 1;
            console.warning(format_args!("{}: {fault}", shown(input)));
        }
    }

    /// The number of frames that were counted.
    pub(super) fn frame_count(&self) -> usize {
        self.outcomes.noted_count
    }

    /// The .glb files of the frames that were converted, by this run or an earlier one, in the order of the
    /// inputs.
    pub(super) fn sequence_frames(&self) -> &[SequenceSource] {
        &self.outcomes.sequence_frames
    }

    /// Reports and records that a frame failed.
    fn fail_frame(&mut self, frame: &Frame, failure: String, console: &Console) {
        console.error(&failure);
        if let Err(error) = frame.record_failure(&failure) {
            console.warning(format_args!("{}: cannot record that it failed: {error}", shown(&frame.input)));
        }
        self.fail(failure);
    }

    fn fail(&mut self, failure: String) {
        self.outcomes.noted_at_first_failure.get_or_insert(self.outcomes.noted_count);
        self.outcomes.failures.push(failure);
    }

    /// Prints the summary, writes the report, and returns the exit status.
    pub(super) fn finish(self, console: &mut Console) -> CommandOutcome {
        let ConvertArgs { allow_violations, report, .. } = self.args;
        let seconds = self.start.elapsed().as_secs_f64();
        let failed_count = self.outcomes.failures.len();
        let mut summary =
            format!("{}: {} done", pluralize(self.outcomes.noted_count, "frame"), self.outcomes.done_count);
        for (count, what) in [
            (failed_count, "failed"),
            (self.outcomes.not_started_count, "not started"),
            (console.left_out_count(), "left out"),
        ] {
            if count > 0 {
                summary += &format!(", {count} {what}");
            }
        }
        console.print_line(format_args!("{summary}, in {seconds:.2} s"));
        // If the first error has scrolled out of view, all errors are printed again.
        if self
            .outcomes
            .noted_at_first_failure
            .is_some_and(|first| self.outcomes.noted_count - first > FRAMES_IN_VIEW)
        {
            for failure in &self.outcomes.failures {
                console.warn(format_args!("failed: {failure}"));
            }
        }
        if self.outcomes.suppressed_count > 0 {
            let more = pluralize(self.outcomes.suppressed_count, "more warning");
            console.warn(format_args!(
                "{more} not shown, because earlier frames had similar ones: --report FILE has all warnings"
            ));
        }
        if let Some(path) = report
            // If the path is a symbolic link, the report replaces the link's target, not the link.
            && let Err(error) =
                self.record.write(&dunce::canonicalize(path).unwrap_or_else(|_| path.to_owned()), seconds)
        {
            console.error(format_args!("{}: cannot write the report: {error}", path.display()));
            return if self.outcomes.done_count > 0 {
                CommandOutcome::SomeFailed
            } else {
                CommandOutcome::NothingDone
            };
        }
        let has_violations = self.outcomes.broken_count > 0 && !allow_violations;
        if self.outcomes.broken_count > 0 {
            let details =
                report.as_ref().map_or(String::new(), |report| format!(" (see {})", report.display()));
            let what = failed_validation(self.outcomes.broken_count, self.outcomes.noted_count, &details);
            if *allow_violations {
                console.warning(what);
            } else {
                console.error(format_args!("{what}; --allow-violations accepts them"));
            }
        }
        if self.outcomes.has_machine_failed {
            return CommandOutcome::MachineFailed;
        }
        CommandOutcome::of(self.outcomes.done_count, failed_count, has_violations)
    }
}

// The stage of `--stage`, which is updated while frames are converted.

/// Updates a stage.
pub(super) struct UsdStageWriter {
    outputs: OutputOptions,
    /// All frames that the stage will have.
    sequences: Vec<UsdStageSequence>,
    /// The number of frames in the stage that is replaced.
    former_count: usize,
    /// When the next update is due.
    due: Instant,
}

/// Maximum number of missing files that are named, and of frames that are left out.
const NAMED_MAX: usize = 3;

impl UsdStageWriter {
    /// The stage that the options name, if they name one, with these frames.
    pub(super) fn new(
        outputs: &OutputOptions,
        sequences: impl FnOnce() -> Vec<UsdStageSequence>,
    ) -> Option<UsdStageWriter> {
        let former_count = stage_frame_count(&outputs.stage.as_ref()?.path).ok().flatten().unwrap_or(0);
        let (outputs, sequences) = (outputs.clone(), sequences());
        Some(UsdStageWriter { outputs, sequences, former_count, due: Instant::now() })
    }

    /// A frame is done. An error is left to [`UsdStageWriter::finish`], because it may go away.
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
            Ok(Some(UsdStageReport { frame_count, missing, left_out, .. })) => {
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
