//! `meniscus convert`: frames of particles into meshes and level sets.

use std::collections::HashSet;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::thread::available_parallelism;
use std::time::Instant;

use anyhow::{Context, Result, bail};
use rayon::{ThreadPool, ThreadPoolBuilder};

use crate::pipeline::{
    self, AutomaticVoxelSize, Conduct, Frame, FrameError, FrameFile, LevelSetSkinning, NOTHING,
    ObstacleFiles, OnError, Outcome, OutputOptions, RunRecord, Sequence, SequenceRecord,
    automatic_voxel_size, check_outputs, default_in_flight, gist, is_own_output, sequence_bounds,
};
use crate::settings::Settings;
use crate::simd::level_warning;

use super::Verdict;
use super::args::{ConvertArgs, OnErrorChoice};
use super::choices::{choices, ignored, output_options, refuse_stray_rounds, written_formats};
use super::console::Console;
use super::frame_selection::FrameSelection;
use super::inputs::find_inputs;
use super::interrupt::clean_up_when_interrupted;
use super::out_folder::OutFolder;
use super::print_settings::print_settings;
use super::quantities::memory_bytes;
use super::wording::{FRAMES_IN_VIEW, counted, counted_are, described, notes, significant, standing_notes};

/// Converts what the arguments ask for.
///
/// # Errors
/// When nothing can be done at all. A frame that fails is no error here: it is told, and counted.
pub(super) fn convert(args: &ConvertArgs, console: &mut Console) -> Result<Verdict> {
    let start = Instant::now();
    clean_up_when_interrupted();
    if args.print_settings && args.inputs.is_empty() {
        return print_settings(&[], args, &thread_pool(args.threads)?, console);
    }
    let Selection { sequences, found } = select_frames(args, console)?;
    // An option may be wrong and without effect: that it is wrong is told, and later.
    if is_sound(args) {
        for warning in
            ignored(&args.method, &written_formats(args.format.as_deref(), &args.formats), &args.formats)
        {
            console.warn(format_args!("warning: {warning}"));
        }
    }
    if let Some(warning) = level_warning() {
        console.warn(format_args!("warning: {warning}"));
    }
    if args.print_settings {
        let sequences: Vec<&Sequence> = sequences.iter().map(|selected| &selected.sequence).collect();
        return print_settings(&sequences, args, &thread_pool(args.threads)?, console);
    }
    let obstacles = Arc::new(ObstacleFiles::new(args.method.obstacles.obstacle.clone()));
    if let Some(missing) = obstacles.missing() {
        let missing_name = missing.display();
        match missing.is_dir() {
            true => bail!(
                "{missing_name}: a folder is no obstacle: give a file, or a pattern such as body.####.obj"
            ),
            false => bail!("{missing_name}: there is no such obstacle"),
        }
    }
    let folder = args.out.clone().context("--out is missing: the folder for the results")?;
    let outputs = Arc::new(output_options(folder, args.format.as_deref(), &args.formats));
    let out_folder = OutFolder::make(&outputs.folder)
        .with_context(|| format!("cannot make the folder {}", outputs.folder.display()))?;
    refuse_conflicts(&sequences, &found, &obstacles, &outputs, args.report.as_deref())?;
    let pool = thread_pool(args.threads)?;
    let memory_bytes = memory_bytes(args.memory)?;

    let on_error = match args.on_error {
        OnErrorChoice::Stop => OnError::Stop,
        OnErrorChoice::Continue => OnError::Continue,
    };
    let mut run = Run::new(pool.current_num_threads(), on_error);
    for sequence in &sequences {
        let settings = resolve_settings(sequence, args, (&outputs, &obstacles), &pool, console)?;
        run.add(sequence, settings, &obstacles);
    }
    out_folder.keep();
    run.convert(args.skip_done, memory_bytes, &pool, console);
    run.finish(args.report.as_deref(), start.elapsed().as_secs_f64(), console)
}

/// Whether the settings make sense, as far as can be told before frames are looked at.
fn is_sound(args: &ConvertArgs) -> bool {
    let choices = choices(&args.method);
    match args.method.first.voxel_size {
        Some(voxel_size) => Settings::resolve(voxel_size, &choices).is_ok(),
        None => Settings::check(&choices).is_ok(),
    }
}

/// What to convert.
struct Selection {
    /// At least one.
    sequences: Vec<SelectedSequence>,
    /// Every file that the inputs stand for, selected or not.
    found: Vec<PathBuf>,
}

/// A sequence, and which of its frames to convert.
struct SelectedSequence {
    sequence: Sequence,
    /// At least one.
    selected: Vec<FrameFile>,
}

fn select_frames(args: &ConvertArgs, console: &mut Console) -> Result<Selection> {
    refuse_stray_rounds(&args.method, &args.inputs)?;
    let found = find_inputs(&args.inputs)?;
    for warning in &found.warnings {
        console.warn(format_args!("warning: {warning}"));
    }
    if found.passed_over_count > 0 {
        let passed_over = counted(found.passed_over_count, "other file");
        console.say(format_args!("passed over {passed_over}: no frames of particles"));
    }
    let paths: Vec<PathBuf> = found.files.iter().map(|file| file.path.clone()).collect();
    let sequences: Vec<SelectedSequence> = pipeline::sequences(found.files)
        .into_iter()
        .map(|sequence| {
            let is_selected = |file: &&FrameFile| FrameSelection::takes(args.frames.as_ref(), file);
            let selected = sequence.frames.iter().filter(is_selected).cloned().collect();
            SelectedSequence { sequence, selected }
        })
        .filter(|sequence: &SelectedSequence| !sequence.selected.is_empty())
        .collect();
    if sequences.is_empty() {
        bail!("--frames selects none of the {} frames", paths.len());
    }
    if let Some(selection) = &args.frames {
        let numbers = sequences.iter().flat_map(|s| &s.selected).filter_map(FrameFile::number).collect();
        for (range, count) in selection.missing(&numbers) {
            console.warn(format_args!("warning: --frames {range}: {} not there", counted_are(count)));
        }
    }
    Ok(Selection { sequences, found: paths })
}

/// Makes sure that nothing written to the folder of the outputs, which exists, or to the report is
/// lost or loses something else: also what was found but not selected must stay.
fn refuse_conflicts(
    sequences: &[SelectedSequence],
    found: &[PathBuf],
    obstacles: &ObstacleFiles,
    outputs: &OutputOptions,
    report: Option<&Path>,
) -> Result<()> {
    if let Some(report_folder) = report.and_then(Path::parent)
        && !report_folder.as_os_str().is_empty()
        && !report_folder.is_dir()
    {
        bail!("{}: there is no such folder for the report", report_folder.display());
    }
    if let Some(report) = report
        && let Ok(there) = report.metadata()
        && !there.is_file()
    {
        bail!("{}: the report would replace what is there, which is no ordinary file", report.display());
    }
    let planned: Vec<(PathBuf, String)> =
        sequences.iter().flat_map(|s| &s.selected).map(|file| (file.path.clone(), file.stem())).collect();
    Ok(check_outputs(&planned, found, obstacles, outputs, report)?)
}

/// The threads that compute: so many, or one for each core.
pub(super) fn thread_pool(threads: Option<u16>) -> Result<ThreadPool> {
    let count = match threads {
        Some(count) => usize::from(count),
        None => available_parallelism().map_or(1, usize::from),
    };
    let pool = ThreadPoolBuilder::new().num_threads(count).thread_name(|index| format!("compute {index}"));
    pool.build().context("cannot start the threads")
}

/// The settings of a sequence, or why it has none. Settings that make no sense end everything.
fn resolve_settings(
    SelectedSequence { sequence, selected }: &SelectedSequence,
    args: &ConvertArgs,
    files: (&OutputOptions, &ObstacleFiles),
    pool: &ThreadPool,
    console: &mut Console,
) -> Result<Result<Resolved, String>> {
    let choices = choices(&args.method);
    let automatic = match args.method.first.voxel_size {
        Some(_) => None,
        None => {
            let paths = || sequence.frames.iter().map(|file| &*file.path);
            let own_radii = choices.own_radii()?;
            match pool.install(|| automatic_voxel_size(paths(), own_radii.as_ref())) {
                Ok(automatic) => Some(automatic),
                Err(error) => return Ok(Err(error.to_string())),
            }
        }
    };
    let given = args.method.first.voxel_size;
    let voxel_size = given.or(automatic.as_ref().map(|automatic| automatic.voxel_size));
    let settings =
        Settings::resolve(voxel_size.unwrap_or(f64::NAN), &choices).with_context(|| sequence.name.clone())?;
    say_settings(sequence, selected.len(), &settings, automatic.as_ref(), console);
    if automatic.is_some() {
        warn_of_siblings(sequence, console);
    }
    for warning in settings.warnings() {
        console.warn(format_args!("warning: {}: {warning}", sequence.name));
    }
    let outputs = match pool.install(|| outputs_of(sequence, &settings, files.0)) {
        Ok(outputs) => Arc::new(outputs),
        Err(error) => return Ok(Err(error.to_string())),
    };
    let record = SequenceRecord::new(&sequence.name, &settings, automatic.as_ref(), (&outputs, files.1));
    Ok(Ok(Resolved { settings: Arc::new(settings), outputs, record }))
}

/// What all frames of a sequence are converted with.
struct Resolved {
    settings: Arc<Settings>,
    outputs: Arc<OutputOptions>,
    record: SequenceRecord,
}

/// What is written of the frames of a sequence: all its pictures have the same camera, whichever are converted.
fn outputs_of(
    sequence: &Sequence,
    settings: &Settings,
    outputs: &OutputOptions,
) -> Result<OutputOptions, FrameError> {
    if !outputs.needs_camera() {
        return Ok(outputs.clone());
    }
    let paths: Vec<&Path> = sequence.frames.iter().map(|file| &*file.path).collect();
    let bounds = sequence_bounds(&paths, settings.radius_min)?;
    Ok(outputs.with_camera_around(bounds.unwrap_or(NOTHING)))
}

/// A frame converted without the rest of its sequence is measured by itself: other frames converted
/// so get other settings, and the sequence flickers.
fn warn_of_siblings(sequence: &Sequence, console: &Console) {
    let [frame] = &sequence.frames[..] else { return };
    if frame.number().is_none() {
        return;
    }
    let folder =
        frame.path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let Ok(entries) = std::fs::read_dir(folder) else { return };
    let files = entries.flatten().map(|entry| FrameFile::new(folder.join(entry.file_name()))).collect();
    let is_ours = |s: &Sequence| s.frames.iter().any(|file| file.name() == frame.name());
    let siblings = pipeline::sequences(files).into_iter().find(is_ours).map_or(Vec::new(), |s| s.frames);
    let count = siblings.iter().filter(|file| !is_own_output(&file.path)).count();
    if count > 1 {
        console.warn(format_args!(
            "warning: {}: its sequence has {count} frames, and its voxel size was measured on this one alone; \
             name the whole sequence and pick with --frames, or give --voxel-size",
            frame.name()
        ));
    }
}

fn say_settings(
    sequence: &Sequence,
    selected_count: usize,
    settings: &Settings,
    automatic: Option<&AutomaticVoxelSize>,
    console: &mut Console,
) {
    let frames = counted(selected_count, "frame");
    let voxel_size = match automatic {
        None => settings.voxel_size.to_string(),
        Some(AutomaticVoxelSize { voxel_size, spacing, radius_median, measured_on }) => format!(
            "{} ({}, measured on {})",
            significant(*voxel_size),
            match radius_median {
                Some(radius) => format!("1/√3 of the particles' median r_min {}", significant(*radius)),
                None => format!("half the particle spacing {}", significant(*spacing)),
            },
            measured_on.file_name().unwrap_or_default().to_string_lossy()
        ),
    };
    let [radius_min, radius_init, radius_max] =
        [settings.radius_min, settings.radius_init, settings.radius_max].map(significant);
    console.say(format_args!(
        "{}: {frames}, voxel size {voxel_size}, radii {radius_min} / {radius_init} / {radius_max}",
        sequence.name
    ));
}

/// A frame that was asked for.
struct PlannedFrame {
    input: PathBuf,
    /// Its sequence's index in the record.
    sequence_index: usize,
    /// What to do with it, or why its sequence has no settings.
    work: Result<Frame, String>,
}

/// The frames on their way, and what became of them.
struct Run {
    /// In the order of the inputs.
    planned: Vec<PlannedFrame>,
    /// As many of them, from the first, have an outcome.
    noted_count: usize,
    sequence_names: Vec<String>,
    on_error: OnError,
    record: RunRecord,
    done_count: usize,
    not_started_count: usize,
    failures: Vec<String>,
    /// The gist of what was told of frames, each with its sequence, and how often it was not told again.
    told: HashSet<(usize, String)>,
    untold_count: usize,
    /// How many frames were noted before the first of these.
    failed_first: Option<usize>,
}

impl Run {
    fn new(thread_count: usize, on_error: OnError) -> Run {
        Run {
            planned: Vec::new(),
            noted_count: 0,
            sequence_names: Vec::new(),
            on_error,
            record: RunRecord::new(thread_count),
            done_count: 0,
            not_started_count: 0,
            failures: Vec::new(),
            told: HashSet::new(),
            untold_count: 0,
            failed_first: None,
        }
    }

    fn add(
        &mut self,
        sequence: &SelectedSequence,
        resolved: Result<Resolved, String>,
        obstacles: &Arc<ObstacleFiles>,
    ) {
        let name = &sequence.sequence.name;
        let (settings, record) = match resolved {
            Ok(Resolved { settings, outputs, record }) => (Ok((settings, outputs)), record),
            Err(why) => (Err(why.clone()), SequenceRecord::without_settings(name, &why)),
        };
        let sequence_index = self.record.add_sequence(record);
        self.sequence_names.push(name.clone());
        for file in &sequence.selected {
            let frame = |(settings, outputs)| Frame {
                input: file.path.clone(),
                stem: file.stem(),
                settings,
                outputs,
                number: file.number(),
                obstacles: Arc::clone(obstacles),
            };
            let work = settings.clone().map(frame);
            self.planned.push(PlannedFrame { input: file.path.clone(), sequence_index, work });
        }
    }

    fn convert(&mut self, skip_done: bool, memory_bytes: u64, pool: &ThreadPool, console: &mut Console) {
        let planned = std::mem::take(&mut self.planned);
        let begin_count = match self.on_error {
            OnError::Continue => planned.len(),
            // Nothing behind a frame that is known to fail is begun.
            OnError::Stop => planned.iter().position(|p| p.work.is_err()).unwrap_or(planned.len()),
        };
        let (places, frames): (Vec<usize>, Vec<Frame>) = planned[..begin_count]
            .iter()
            .enumerate()
            .filter_map(|(place, planned)| Some((place, planned.work.as_ref().ok()?.clone())))
            .unzip();
        let conduct = Conduct {
            pool,
            on_error: self.on_error,
            skip_done,
            in_flight: default_in_flight(pool.current_num_threads()),
            memory_bytes,
        };
        let has_bar = console.show_bar(frames.len());
        pipeline::run(&LevelSetSkinning, &frames, &conduct, |index, outcome| {
            // The record and what is told have the order of the inputs.
            self.note_without_outcome(&planned[self.noted_count..places[index]], console);
            self.note(&frames[index], planned[places[index]].sequence_index, &outcome, has_bar, console);
        });
        console.hide_bar();
        self.note_without_outcome(&planned[self.noted_count..], console);
    }

    /// Notes frames that never went into the pipeline.
    fn note_without_outcome(&mut self, planned: &[PlannedFrame], console: &Console) {
        let mut told = None;
        for PlannedFrame { input, sequence_index, work } in planned {
            let is_stopped = self.on_error == OnError::Stop && !self.failures.is_empty();
            match work {
                Err(why) if !is_stopped => {
                    // It is the same for all frames of a sequence.
                    if told.replace(*sequence_index) != Some(*sequence_index) {
                        let name = &self.sequence_names[*sequence_index];
                        // What cannot be read is named by its path already.
                        let of = if why.contains(&**name) { String::new() } else { format!("{name}: ") };
                        console.warn(format_args!("error: {of}{why}"));
                    }
                    self.record.add_failed(input, *sequence_index, why);
                    self.fail(format!("{}: {why}", input.display()));
                }
                _ => {
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
        let name = frame.input.display();
        match outcome {
            Outcome::Converted(report) => {
                self.done_count += 1;
                let standing = standing_notes(report).into_iter();
                let is_new = |note: &String| self.told.insert((sequence_index, gist(note)));
                let (new, known): (Vec<String>, Vec<String>) = standing.partition(is_new);
                self.untold_count += known.len();
                for note in new.into_iter().chain(notes(report)) {
                    console.warn(format_args!("warning: {name}: {note}"));
                }
                if !has_bar {
                    console.say(format_args!("{name}: {}", described(report)));
                }
            }
            Outcome::AlreadyDone(_) => {
                self.done_count += 1;
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

    fn fail(&mut self, failure: String) {
        self.failed_first.get_or_insert(self.noted_count);
        self.failures.push(failure);
    }

    /// The summary, the report and the verdict.
    fn finish(self, report: Option<&Path>, seconds: f64, console: &mut Console) -> Result<Verdict> {
        let failed_count = self.failures.len();
        let mut summary = format!("{}: {} done", counted(self.noted_count, "frame"), self.done_count);
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
            return Ok(if self.done_count > 0 { Verdict::SomeFailed } else { Verdict::NothingDone });
        }
        Ok(match (failed_count, self.done_count) {
            (0, _) => Verdict::Done,
            (_, 0) => Verdict::NothingDone,
            _ => Verdict::SomeFailed,
        })
    }
}
