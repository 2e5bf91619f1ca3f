//! Frames through the pipeline: their outcomes on the console, in the order of the inputs, and a summary of all.

use std::collections::HashMap;
use std::path::{Path, PathBuf};

use rayon::ThreadPool;

use crate::pipeline::{
    self, Frame, FrameReport, Job, LevelSetSkinning, OnError, Outcome, OutputFormat, PipelineOptions,
    ReportedWarnings, RunRecord, Scope, SequenceRecord, ShotSource, output_path, shown,
};

use super::Verdict;
use super::console::Console;
use super::output_records::OutputRecords;
use super::progress::Progress;
use super::remedies::{velocity_hint, with_remedy};
use super::wording::{FRAMES_IN_VIEW, counted, described, failed_validation};

/// A frame of a batch.
struct BatchItem {
    input: PathBuf,
    /// Its sequence's index in the record.
    sequence_index: usize,
    state: ItemState,
}

/// What to do with a frame.
enum ItemState {
    Convert(Frame),
    /// Nothing: its outputs are done, and its inputs are gone. If its certificate does not hold, why.
    Done(Frame, Option<String>),
    /// Nothing: its sequence has no settings, and why.
    Impossible(String),
}

/// How a batch is converted.
pub(super) struct RunOptions<'a> {
    /// Skip frames that are done.
    pub(super) skip_done: bool,
    /// Write certificates beside the outputs.
    pub(super) certificates: bool,
    /// Memory that the frames under way may take together.
    pub(super) memory_bytes: u64,
    /// Where all computing happens.
    pub(super) pool: &'a ThreadPool,
}

/// Frames to convert, and their outcomes.
pub(super) struct Batch {
    /// In the order of the inputs.
    items: Vec<BatchItem>,
    /// How many of them, from the first, have an outcome.
    noted_count: usize,
    sequence_names: Vec<String>,
    on_error: OnError,
    record: RunRecord,
    done_count: usize,
    /// Frames that are done and break a guarantee, and whether that is a failure.
    broken_count: usize,
    allow_violations: bool,
    not_started_count: usize,
    failures: Vec<String>,
    /// How many frames had an outcome before the first failure.
    failed_first: Option<usize>,
    /// Which warnings were printed, by sequence, and how many similar ones were not.
    printed: HashMap<usize, ReportedWarnings>,
    suppressed_count: usize,
    /// Whether the hint at velocities that are not used was printed.
    is_velocity_hinted: bool,
    /// The .glb of each frame that is done, where there is one.
    shot_frames: Vec<ShotSource>,
}

impl Batch {
    /// An empty batch.
    pub(super) fn new(thread_count: usize, on_error: OnError, allow_violations: bool) -> Batch {
        Batch {
            items: Vec::new(),
            noted_count: 0,
            sequence_names: Vec::new(),
            on_error,
            record: RunRecord::new(thread_count),
            done_count: 0,
            broken_count: 0,
            allow_violations,
            not_started_count: 0,
            failures: Vec::new(),
            failed_first: None,
            printed: HashMap::new(),
            suppressed_count: 0,
            is_velocity_hinted: false,
            shot_frames: Vec::new(),
        }
    }

    /// Adds a sequence; its index is what frames refer to.
    pub(super) fn add_sequence(&mut self, name: &str, record: SequenceRecord) -> usize {
        self.sequence_names.push(name.to_owned());
        self.record.add_sequence(record)
    }

    /// Adds a frame of a sequence, or why it cannot be converted.
    pub(super) fn add_frame(&mut self, input: &Path, sequence_index: usize, frame: Result<Frame, String>) {
        let state = frame.map_or_else(ItemState::Impossible, ItemState::Convert);
        self.items.push(BatchItem { input: input.to_owned(), sequence_index, state });
    }

    /// Adds a frame that is done and whose inputs are gone. `fault` is why its certificate does not hold.
    pub(super) fn add_done(&mut self, frame: Frame, sequence_index: usize, fault: Option<String>) {
        let input = frame.input.clone();
        self.items.push(BatchItem { input, sequence_index, state: ItemState::Done(frame, fault) });
    }

    /// Converts all frames that were added.
    pub(super) fn convert(&mut self, options: &RunOptions<'_>, console: &mut Console) {
        let &RunOptions { skip_done, certificates, memory_bytes, pool } = options;
        let items = std::mem::take(&mut self.items);
        let begin_count = match self.on_error {
            OnError::Continue => items.len(),
            // No frame behind one that is known to fail is begun.
            OnError::Stop => {
                let is_impossible = |item: &BatchItem| matches!(item.state, ItemState::Impossible(_));
                items.iter().position(is_impossible).unwrap_or(items.len())
            }
        };
        let (places, frames): (Vec<usize>, Vec<Frame>) = items[..begin_count]
            .iter()
            .enumerate()
            .filter_map(|(place, item)| match &item.state {
                ItemState::Convert(frame) => Some((place, frame.clone())),
                ItemState::Done(..) | ItemState::Impossible(_) => None,
            })
            .unzip();
        // A certificate has the hashes of the outputs, and says what does not hold.
        let records = (!certificates)
            .then(|| OutputRecords::load(frames.iter().map(|frame| frame.outputs.folder.clone())));
        let has_bar = console.show_bar(frames.len());
        let progress = Progress::new(frames.len(), pool.current_num_threads(), console.bar());
        let options = PipelineOptions {
            on_error: self.on_error,
            skip_done,
            certificates,
            memory_bytes,
            output_states: records.as_ref().map(OutputRecords::states),
            observer: Some(&progress),
            ..PipelineOptions::new(pool)
        };
        pipeline::run(&LevelSetSkinning, &frames, &options, |index, outcome| {
            // The record and the console have the order of the inputs.
            let report = if let Outcome::Converted(report) = &outcome { Some(&**report) } else { None };
            progress.finished(&frames[index], report);
            self.note_without_outcome(&items[self.noted_count..places[index]], console);
            self.note(&frames[index], items[places[index]].sequence_index, &outcome, has_bar, console);
            if let Some(records) = &records {
                records.frame_finished();
            }
        });
        console.hide_bar();
        if let Some(records) = &records {
            records.save(console);
        }
        self.note_without_outcome(&items[self.noted_count..], console);
    }

    /// Notes frames that never went into the pipeline.
    fn note_without_outcome(&mut self, items: &[BatchItem], console: &Console) {
        let mut printed = None;
        for BatchItem { input, sequence_index, state } in items {
            let is_stopped = self.on_error == OnError::Stop && !self.failures.is_empty();
            match state {
                ItemState::Done(frame, fault) => {
                    self.record.add_done(frame, *sequence_index);
                    self.note_done(input, fault.as_deref(), console);
                }
                ItemState::Impossible(why) if !is_stopped => {
                    // It is the same for all frames of a sequence.
                    if printed.replace(*sequence_index) != Some(*sequence_index) {
                        let name = &self.sequence_names[*sequence_index];
                        // What cannot be read is named by its path already.
                        let of = if why.contains(&**name) { String::new() } else { format!("{name}: ") };
                        console.warn(format_args!("error: {of}{why}"));
                    }
                    self.record.add_failed(input, *sequence_index, why);
                    self.fail(format!("{}: {why}", shown(input)));
                }
                ItemState::Convert(_) | ItemState::Impossible(_) => {
                    self.record.add_not_started(input, *sequence_index);
                    self.not_started_count += 1;
                }
            }
        }
        self.noted_count += items.len();
    }

    fn note(
        &mut self,
        frame: &Frame,
        sequence_index: usize,
        outcome: &Outcome,
        has_bar: bool,
        console: &mut Console,
    ) {
        self.noted_count += 1;
        self.record.add_frame(frame, sequence_index, outcome);
        let name = shown(&frame.input);
        if matches!(outcome, Outcome::Converted(_) | Outcome::AlreadyDone { .. })
            && frame.outputs.formats.contains(&OutputFormat::Glb)
        {
            let path = output_path(&frame.outputs.folder, &frame.stem, OutputFormat::Glb);
            self.shot_frames.push(ShotSource { path, number: frame.number });
        }
        match outcome {
            Outcome::Converted(report) => {
                self.note_converted(frame, sequence_index, report, console);
                if !has_bar {
                    console.say(format_args!("{name}: {}", described(&frame.job, report)));
                }
            }
            Outcome::AlreadyDone { fault, .. } => {
                self.note_done(&frame.input, fault.as_deref(), console);
                if !has_bar {
                    console.say(format_args!("{name}: done already"));
                }
            }
            Outcome::Changed => {
                let failure = format!("{name}: the file was written while it was read");
                console.warn(format_args!("error: {failure}"));
                self.fail(failure);
            }
            Outcome::Failed(error) => {
                console.warn(format_args!("error: {error}"));
                self.fail(error.to_string());
            }
            Outcome::NotStarted => self.not_started_count += 1,
        }
        console.advance_bar();
    }

    /// Counts a frame that was converted, and prints its warnings.
    fn note_converted(
        &mut self,
        frame: &Frame,
        sequence_index: usize,
        report: &FrameReport,
        console: &mut Console,
    ) {
        self.done_count += 1;
        let has_surface = frame.job != Job::Particles;
        self.broken_count += usize::from(has_surface && !report.keeps_guarantees());
        let printed = self.printed.entry(sequence_index).or_default();
        for warning in report.all_warnings() {
            if warning.scope() == Scope::Frame || printed.is_new(&warning) {
                console.warn(format_args!("warning: {}: {}", shown(&frame.input), with_remedy(&warning)));
            } else {
                self.suppressed_count += 1;
            }
        }
        // Once is enough.
        if let Some(velocity) = &report.unused_velocity
            && !std::mem::replace(&mut self.is_velocity_hinted, true)
        {
            console.say(format_args!("note: {}", velocity_hint(velocity)));
        }
    }

    /// Counts a frame that was done before.
    fn note_done(&mut self, input: &Path, fault: Option<&str>, console: &Console) {
        self.done_count += 1;
        if let Some(fault) = fault {
            self.broken_count += 1;
            console.warn(format_args!("warning: {}: {fault}", shown(input)));
        }
    }

    /// How many frames have an outcome.
    pub(super) fn frame_count(&self) -> usize {
        self.noted_count
    }

    /// The .glb of each frame that is done, in the order of the inputs.
    pub(super) fn shot_frames(&self) -> &[ShotSource] {
        &self.shot_frames
    }

    fn fail(&mut self, failure: String) {
        self.failed_first.get_or_insert(self.noted_count);
        self.failures.push(failure);
    }

    /// Prints the summary, writes the report, and returns the verdict.
    pub(super) fn finish(self, report: Option<&Path>, seconds: f64, console: &mut Console) -> Verdict {
        let failed_count = self.failures.len();
        let mut summary = format!("{}: {} done", counted(self.noted_count, "frame"), self.done_count);
        for (count, what) in [(failed_count, "failed"), (self.not_started_count, "not started")] {
            if count > 0 {
                summary += &format!(", {count} {what}");
            }
        }
        console.say(format_args!("{summary}, in {seconds:.2} s"));
        // An error that was just printed is not repeated; one of long ago has scrolled away.
        if self.failed_first.is_some_and(|first| self.noted_count - first > FRAMES_IN_VIEW) {
            for failure in &self.failures {
                console.warn(format_args!("failed: {failure}"));
            }
        }
        if self.suppressed_count > 0 {
            let more = counted(self.suppressed_count, "more warning");
            console.warn(format_args!("{more} like those of earlier frames: --report has them all"));
        }
        if let Some(path) = report
            // Through a link, what it names is replaced and not the link.
            && let Err(error) =
                self.record.write(&path.canonicalize().unwrap_or_else(|_| path.to_owned()), seconds)
        {
            console.warn(format_args!("error: {}: cannot write the report: {error}", path.display()));
            return if self.done_count > 0 { Verdict::SomeFailed } else { Verdict::NothingDone };
        }
        let has_violations = self.broken_count > 0 && !self.allow_violations;
        if self.broken_count > 0 {
            let details = report.map_or(String::new(), |report| format!(" (see {})", report.display()));
            let what = failed_validation(self.broken_count, self.noted_count, &details);
            match self.allow_violations {
                true => console.warn(format_args!("warning: {what}")),
                false => console.warn(format_args!("error: {what}; --allow-violations accepts them")),
            }
        }
        Verdict::of(self.done_count, failed_count, has_violations)
    }
}
