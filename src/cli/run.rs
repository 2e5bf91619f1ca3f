//! Frames through the pipeline: what is told of each, in the order of the inputs, and what came of all.

use std::collections::HashSet;
use std::path::{Path, PathBuf};

use anyhow::Result;
use rayon::ThreadPool;

use crate::pipeline::{
    self, Conduct, Frame, LevelSetSkinning, OnError, Outcome, OutputFormat, RunRecord, SequenceRecord,
    ShotSource, gist, keeps_guarantees, notes, output_path, shown, standing_notes, velocity_hint,
};

use super::Verdict;
use super::console::Console;
use super::output_records::OutputRecords;
use super::progress::Progress;
use super::tally::say_violations;
use super::wording::{FRAMES_IN_VIEW, counted, described};

/// A frame that was asked for.
struct AskedFrame {
    input: PathBuf,
    /// Its sequence's index in the record.
    sequence_index: usize,
    work: Work,
}

/// What to do with a frame.
enum Work {
    Convert(Frame),
    /// Nothing: it is done, and cannot be compared with what it was made from; and what its certificate says does not hold.
    IsDone(Frame, Option<String>),
    /// Nothing, for its sequence has no settings, and why.
    Impossible(String),
}

/// How frames are converted.
pub(super) struct Way<'a> {
    /// Leave alone what is done.
    pub(super) skip_done: bool,
    /// Write certificates beside the outputs.
    pub(super) certificates: bool,
    /// What frames under way may take together.
    pub(super) memory_bytes: u64,
    /// Where all computing happens.
    pub(super) pool: &'a ThreadPool,
}

/// The frames on their way, and what became of them.
pub(super) struct Run {
    /// In the order of the inputs.
    planned: Vec<AskedFrame>,
    /// As many of them, from the first, have an outcome.
    noted_count: usize,
    sequence_names: Vec<String>,
    on_error: OnError,
    record: RunRecord,
    done_count: usize,
    /// Those among them whose results break a guarantee, and whether that is no failure.
    broken_count: usize,
    allow_violations: bool,
    not_started_count: usize,
    failures: Vec<String>,
    /// The gist of what was told of frames, each with its sequence, and how often it was not told again.
    told: HashSet<(usize, String)>,
    untold_count: usize,
    /// The .glb of each frame that is done, where there is one.
    shot_frames: Vec<ShotSource>,
    /// Whether the hint at velocities that are not asked for was printed.
    is_velocity_told: bool,
    /// How many frames were noted before the first of these.
    failed_first: Option<usize>,
}

impl Run {
    /// A run that has not begun.
    pub(super) fn new(thread_count: usize, on_error: OnError, allow_violations: bool) -> Run {
        Run {
            planned: Vec::new(),
            noted_count: 0,
            sequence_names: Vec::new(),
            on_error,
            record: RunRecord::new(thread_count),
            done_count: 0,
            broken_count: 0,
            allow_violations,
            not_started_count: 0,
            failures: Vec::new(),
            told: HashSet::new(),
            untold_count: 0,
            shot_frames: Vec::new(),
            is_velocity_told: false,
            failed_first: None,
        }
    }

    /// Adds a sequence; its index is what frames refer to.
    pub(super) fn add_sequence(&mut self, name: &str, record: SequenceRecord) -> usize {
        self.sequence_names.push(name.to_owned());
        self.record.add_sequence(record)
    }

    /// Adds a frame of a sequence, or why it cannot be converted.
    pub(super) fn add_frame(&mut self, input: &Path, sequence_index: usize, work: Result<Frame, String>) {
        let work = work.map_or_else(Work::Impossible, Work::Convert);
        self.planned.push(AskedFrame { input: input.to_owned(), sequence_index, work });
    }

    /// Adds a frame that is done, and cannot be compared with what it was made from. `fault` is what its certificate says
    /// does not hold.
    pub(super) fn add_done(&mut self, frame: Frame, sequence_index: usize, fault: Option<String>) {
        self.planned.push(AskedFrame {
            input: frame.input.clone(),
            sequence_index,
            work: Work::IsDone(frame, fault),
        });
    }

    /// Converts all frames that were added.
    pub(super) fn convert(&mut self, way: &Way<'_>, console: &mut Console) {
        let &Way { skip_done, certificates, memory_bytes, pool } = way;
        let planned = std::mem::take(&mut self.planned);
        let begin_count = match self.on_error {
            OnError::Continue => planned.len(),
            // Nothing behind a frame that is known to fail is begun.
            OnError::Stop => {
                let is_impossible = |asked: &AskedFrame| matches!(asked.work, Work::Impossible(_));
                planned.iter().position(is_impossible).unwrap_or(planned.len())
            }
        };
        let (places, frames): (Vec<usize>, Vec<Frame>) = planned[..begin_count]
            .iter()
            .enumerate()
            .filter_map(|(place, planned)| match &planned.work {
                Work::Convert(frame) => Some((place, frame.clone())),
                Work::IsDone(..) | Work::Impossible(_) => None,
            })
            .unzip();
        // A certificate has the hashes of the outputs, and says what does not hold.
        let records = (!certificates)
            .then(|| OutputRecords::load(frames.iter().map(|frame| frame.outputs.folder.clone())));
        let has_bar = console.show_bar(frames.len());
        let progress = Progress::new(frames.len(), pool.current_num_threads(), console.bar());
        let conduct = Conduct {
            on_error: self.on_error,
            skip_done,
            certificates,
            memory_bytes,
            output_states: records.as_ref().map(OutputRecords::states),
            observer: Some(&progress),
            ..Conduct::new(pool)
        };
        pipeline::run(&LevelSetSkinning, &frames, &conduct, |index, outcome| {
            // The record and what is told have the order of the inputs.
            let report = if let Outcome::Converted(report) = &outcome { Some(&**report) } else { None };
            progress.finished(&frames[index], report);
            self.note_without_outcome(&planned[self.noted_count..places[index]], console);
            self.note(&frames[index], planned[places[index]].sequence_index, &outcome, has_bar, console);
            if let Some(records) = &records {
                records.frame_finished();
            }
        });
        console.hide_bar();
        if let Some(records) = &records {
            records.save(console);
        }
        self.note_without_outcome(&planned[self.noted_count..], console);
    }

    /// Notes frames that never went into the pipeline.
    fn note_without_outcome(&mut self, planned: &[AskedFrame], console: &Console) {
        let mut told = None;
        for AskedFrame { input, sequence_index, work } in planned {
            let is_stopped = self.on_error == OnError::Stop && !self.failures.is_empty();
            match work {
                Work::IsDone(frame, fault) => {
                    self.record.add_done(frame, *sequence_index);
                    self.note_done(input, fault.as_deref(), console);
                }
                Work::Impossible(why) if !is_stopped => {
                    // It is the same for all frames of a sequence.
                    if told.replace(*sequence_index) != Some(*sequence_index) {
                        let name = &self.sequence_names[*sequence_index];
                        // What cannot be read is named by its path already.
                        let of = if why.contains(&**name) { String::new() } else { format!("{name}: ") };
                        console.warn(format_args!("error: {of}{why}"));
                    }
                    self.record.add_failed(input, *sequence_index, why);
                    self.fail(format!("{}: {why}", shown(input)));
                }
                Work::Convert(_) | Work::Impossible(_) => {
                    self.record.add_not_started(input, *sequence_index);
                    self.not_started_count += 1;
                }
            }
        }
        self.noted_count += planned.len();
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
                self.done_count += 1;
                self.broken_count += usize::from(!keeps_guarantees(report));
                let standing = standing_notes(report).into_iter();
                let is_new = |note: &String| self.told.insert((sequence_index, gist(note)));
                let (new, known): (Vec<String>, Vec<String>) = standing.partition(is_new);
                self.untold_count += known.len();
                for note in new.into_iter().chain(notes(report)) {
                    console.warn(format_args!("warning: {name}: {note}"));
                }
                // Once is enough.
                if let Some(velocity) = &report.unused_velocity
                    && !std::mem::replace(&mut self.is_velocity_told, true)
                {
                    console.say(format_args!("note: {}", velocity_hint(velocity)));
                }
                if !has_bar {
                    console.say(format_args!("{name}: {}", described(report)));
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

    /// Notes a frame that was done before.
    fn note_done(&mut self, input: &Path, fault: Option<&str>, console: &Console) {
        self.done_count += 1;
        if let Some(fault) = fault {
            self.broken_count += 1;
            console.warn(format_args!("warning: {}: {fault}", shown(input)));
        }
    }

    /// How many frames have ended, one way or the other.
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

    /// The summary, the report and the verdict. A report that cannot be written is told.
    pub(super) fn finish(self, report: Option<&Path>, seconds: f64, console: &mut Console) -> Verdict {
        let failed_count = self.failures.len();
        let frames = counted(self.noted_count, "frame");
        let mut summary = format!("{frames}: {} done", self.done_count);
        if failed_count > 0 {
            summary += &format!(", {failed_count} failed");
        }
        if self.not_started_count > 0 {
            summary += &format!(", {} not started", self.not_started_count);
        }
        console.say(format_args!("{summary}, in {seconds:.2} s"));
        // An error that was just told is not told again; one of long ago has scrolled away.
        if self.failed_first.is_some_and(|first| self.noted_count - first > FRAMES_IN_VIEW) {
            for failure in &self.failures {
                console.warn(format_args!("failed: {failure}"));
            }
        }
        if self.untold_count > 0 {
            let more = counted(self.untold_count, "more warning");
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
        let details = report.map_or(String::new(), |report| format!(" (see {})", report.display()));
        let broken = (self.broken_count, self.noted_count);
        let has_violations = say_violations(broken, &details, self.allow_violations, console);
        Verdict::of(self.done_count, failed_count, has_violations)
    }
}
