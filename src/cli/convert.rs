//! `meniscus convert`: frames of particles into meshes and level sets.

use std::fs;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::thread::available_parallelism;
use std::time::Instant;

use anyhow::{Context, Result, bail};
use meniscus_formats::{gltf, vdb};
use rayon::{ThreadPool, ThreadPoolBuilder};

use crate::pipeline::{
    self, AutomaticVoxelSize, Conduct, Frame, FrameFile, FrameReport, LevelSetSkinning, OnError, Outcome,
    OutputFormat, OutputOptions, RunRecord, Sequence, SequenceRecord, automatic_voxel_size, check_outputs,
};
use crate::settings::{Choices, Contouring, Integrator, Settings};

use super::Verdict;
use super::args::{
    CompressionChoice, ContourChoice, ConvertArgs, Format, IntegratorChoice, OnErrorChoice, UpChoice,
};
use super::console::Console;
use super::frame_selection::FrameSelection;
use super::inputs::find_inputs;

/// Converts what the arguments ask for.
///
/// # Errors
/// When nothing can be done at all. A frame that fails is no error here: it is told, and counted.
pub(super) fn convert(args: &ConvertArgs, console: &mut Console) -> Result<Verdict> {
    let start = Instant::now();
    let sequences = find_sequences(args, console)?;
    let outputs = output_options(args);
    refuse_conflicts(&sequences, &outputs, args.report.as_deref())?;
    let pool = thread_pool(args.threads)?;

    let mut run = Run::new(pool.current_num_threads());
    for sequence in &sequences {
        match resolve_settings(sequence, args, &pool, console)? {
            Ok((settings, record)) => run.add_frames(sequence, &Arc::new(settings), record),
            Err(why) => run.add_failures(sequence, &why, console),
        }
    }
    run.convert(args, &pool, &outputs, console);
    run.finish(args.report.as_deref(), start.elapsed().as_secs_f64(), console)
}

/// A sequence, and which of its frames to convert.
struct SelectedSequence {
    sequence: Sequence,
    /// At least one.
    selected: Vec<FrameFile>,
}

fn find_sequences(args: &ConvertArgs, console: &mut Console) -> Result<Vec<SelectedSequence>> {
    let found = find_inputs(&args.inputs)?;
    if found.passed_over_count > 0 {
        let passed_over = counted(found.passed_over_count, "other file");
        console.say(format_args!("passed over {passed_over}: no frames of particles"));
    }
    let found_count = found.files.len();
    let sequences: Vec<SelectedSequence> = pipeline::sequences(found.files)
        .into_iter()
        .map(|sequence| {
            let is_selected = |file: &&FrameFile| is_selected(file, args.frames.as_ref());
            let selected = sequence.frames.iter().filter(is_selected).cloned().collect();
            SelectedSequence { sequence, selected }
        })
        .filter(|sequence: &SelectedSequence| !sequence.selected.is_empty())
        .collect();
    if sequences.is_empty() {
        bail!("--frames selects none of the {found_count} frames");
    }
    Ok(sequences)
}

fn is_selected(file: &FrameFile, selection: Option<&FrameSelection>) -> bool {
    selection.is_none_or(|selection| file.number().is_some_and(|number| selection.contains(number)))
}

fn output_options(args: &ConvertArgs) -> OutputOptions {
    let mut formats = Vec::new();
    for &format in &args.format {
        let format = match format {
            Format::Glb => OutputFormat::Glb,
            Format::Gltf => OutputFormat::Gltf,
            Format::Vdb => OutputFormat::Vdb,
            Format::Obj => OutputFormat::Obj,
            Format::Ply => OutputFormat::Ply,
        };
        if !formats.contains(&format) {
            formats.push(format);
        }
    }
    OutputOptions {
        folder: args.out.clone(),
        formats,
        up: match args.formats.up {
            UpChoice::Y => gltf::UpAxis::Y,
            UpChoice::Z => gltf::UpAxis::Z,
        },
        vdb_half: args.formats.vdb_half,
        vdb_compression: match args.formats.vdb_compression {
            CompressionChoice::None => vdb::Compression::None,
            CompressionChoice::Active => vdb::Compression::ActiveMask,
            CompressionChoice::Blosc => vdb::Compression::Blosc,
        },
    }
}

/// Makes the folder, and makes sure that nothing written there or to the report is lost or loses
/// something else.
fn refuse_conflicts(
    sequences: &[SelectedSequence],
    outputs: &OutputOptions,
    report: Option<&Path>,
) -> Result<()> {
    let folder = &outputs.folder;
    // First, because only then is it known where the folder's path leads.
    fs::create_dir_all(folder).with_context(|| format!("cannot make the folder {}", folder.display()))?;
    if let Some(report_folder) = report.and_then(Path::parent)
        && !report_folder.as_os_str().is_empty()
        && !report_folder.is_dir()
    {
        bail!("{}: there is no such folder for the report", report_folder.display());
    }
    // Also the frames that were not selected must stay.
    let inputs: Vec<PathBuf> =
        sequences.iter().flat_map(|s| &s.sequence.frames).map(|file| file.path.clone()).collect();
    let planned: Vec<(PathBuf, String)> =
        sequences.iter().flat_map(|s| &s.selected).map(|file| (file.path.clone(), file.stem())).collect();
    Ok(check_outputs(&planned, &inputs, outputs, report)?)
}

fn thread_pool(threads: Option<u16>) -> Result<ThreadPool> {
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
    pool: &ThreadPool,
    console: &mut Console,
) -> Result<Result<(Settings, SequenceRecord), String>> {
    let automatic = match args.surface.voxel_size {
        Some(_) => None,
        None => {
            let paths = || sequence.frames.iter().map(|file| &*file.path);
            match pool.install(|| automatic_voxel_size(paths())) {
                Ok(automatic) => Some(automatic),
                Err(error) => return Ok(Err(error.to_string())),
            }
        }
    };
    let voxel_size = args.surface.voxel_size.or(automatic.as_ref().map(|automatic| automatic.voxel_size));
    let settings = Settings::resolve(voxel_size.unwrap_or(f64::NAN), &choices(args))
        .with_context(|| sequence.name.clone())?;
    say_settings(sequence, selected.len(), &settings, automatic.as_ref(), console);
    for warning in settings.warnings() {
        console.warn(format_args!("warning: {}: {warning}", sequence.name));
    }
    let record = SequenceRecord::new(&sequence.name, &settings, automatic.as_ref());
    Ok(Ok((settings, record)))
}

fn choices(args: &ConvertArgs) -> Choices {
    Choices {
        radius_min: args.surface.radius_min,
        radius_ratio: args.surface.radius_ratio,
        radius_init: args.surface.radius_init,
        integrator: Some(match args.solver.integrator {
            IntegratorChoice::Fast => Integrator::Fast,
            IntegratorChoice::Implicit => Integrator::Implicit,
            IntegratorChoice::Explicit => Integrator::Explicit,
        }),
        laplacian_steps: args.solver.laplacian_steps,
        steps: args.solver.steps,
        step_size: args.solver.step_size,
        redistance_every: args.solver.redistance_every,
        cg_tolerance: args.solver.cg_tolerance,
        contouring: Some(match args.surface.contour {
            ContourChoice::Dual => Contouring::Dual,
            ContourChoice::Tetrahedra => Contouring::Tetrahedra,
        }),
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
    let origin = automatic.map_or(String::new(), |automatic| {
        let measured_on = automatic.measured_on.file_name().unwrap_or_default().to_string_lossy();
        format!(" (half the particle spacing {}, measured on {measured_on})", automatic.spacing)
    });
    console.say(format_args!(
        "{}: {frames}, voxel size {}{origin}, radii {:.6} / {:.6} / {:.6}",
        sequence.name, settings.voxel_size, settings.radius_min, settings.radius_init, settings.radius_max
    ));
}

/// The frames on their way, and what became of them.
struct Run {
    frames: Vec<Frame>,
    /// For each frame its sequence's index in the record.
    sequence_of: Vec<usize>,
    record: RunRecord,
    frame_count: usize,
    done_count: usize,
    not_started_count: usize,
    failures: Vec<String>,
}

impl Run {
    fn new(thread_count: usize) -> Run {
        Run {
            frames: Vec::new(),
            sequence_of: Vec::new(),
            record: RunRecord::new(thread_count),
            frame_count: 0,
            done_count: 0,
            not_started_count: 0,
            failures: Vec::new(),
        }
    }

    fn add_frames(&mut self, sequence: &SelectedSequence, settings: &Arc<Settings>, record: SequenceRecord) {
        let sequence_index = self.record.add_sequence(record);
        for file in &sequence.selected {
            let settings = Arc::clone(settings);
            self.frames.push(Frame { input: file.path.clone(), stem: file.stem(), settings });
            self.sequence_of.push(sequence_index);
        }
        self.frame_count += sequence.selected.len();
    }

    fn add_failures(&mut self, sequence: &SelectedSequence, why: &str, console: &mut Console) {
        let name = &sequence.sequence.name;
        let sequence_index = self.record.add_sequence(SequenceRecord::without_settings(name, why));
        for file in &sequence.selected {
            self.record.add_failed(&file.path, sequence_index, why);
            self.failures.push(format!("{}: {why}", file.path.display()));
        }
        self.frame_count += sequence.selected.len();
        console.warn(format_args!("error: {name}: {why}"));
    }

    fn convert(
        &mut self,
        args: &ConvertArgs,
        pool: &ThreadPool,
        outputs: &OutputOptions,
        console: &mut Console,
    ) {
        let on_error = match args.on_error {
            OnErrorChoice::Stop => OnError::Stop,
            OnErrorChoice::Continue => OnError::Continue,
        };
        let frames = std::mem::take(&mut self.frames);
        if on_error == OnError::Stop && !self.failures.is_empty() {
            for (index, frame) in frames.iter().enumerate() {
                self.note(frame, index, &Outcome::NotStarted, false, console);
            }
            return;
        }
        let conduct = Conduct { pool, outputs, on_error, skip_done: args.skip_done };
        let has_bar = console.show_bar(frames.len());
        pipeline::run(&LevelSetSkinning, &frames, &conduct, |index, outcome| {
            self.note(&frames[index], index, &outcome, has_bar, console);
        });
        console.hide_bar();
    }

    fn note(&mut self, frame: &Frame, index: usize, outcome: &Outcome, has_bar: bool, console: &mut Console) {
        self.record.add_frame(frame, self.sequence_of[index], outcome);
        let name = frame.input.display();
        match outcome {
            Outcome::Converted(report) => {
                self.done_count += 1;
                for note in notes(report) {
                    console.warn(format_args!("warning: {name}: {note}"));
                }
                if !has_bar {
                    console.say(format_args!("{name}: {}", described(report)));
                }
            }
            Outcome::AlreadyDone => {
                self.done_count += 1;
                if !has_bar {
                    console.say(format_args!("{name}: done already"));
                }
            }
            Outcome::Failed(error) => {
                console.warn(format_args!("error: {error}"));
                self.failures.push(error.to_string());
            }
            Outcome::NotStarted => self.not_started_count += 1,
        }
        console.advance_bar();
    }

    /// The summary, the report and the verdict.
    fn finish(self, report: Option<&Path>, seconds: f64, console: &mut Console) -> Result<Verdict> {
        let failed_count = self.failures.len();
        let mut summary = format!("{}: {} done", counted(self.frame_count, "frame"), self.done_count);
        if failed_count > 0 {
            summary += &format!(", {failed_count} failed");
        }
        if self.not_started_count > 0 {
            summary += &format!(", {} not started", self.not_started_count);
        }
        console.say(format_args!("{summary}, in {seconds:.2} s"));
        // One frame's error has just been told; those of many have scrolled away.
        if self.frame_count > 1 {
            for failure in &self.failures {
                console.warn(format_args!("failed: {failure}"));
            }
        }
        if let Some(path) = report
            && let Err(error) = self.record.write(path, seconds)
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

/// One line about a frame that was converted.
fn described(report: &FrameReport) -> String {
    let skin = &report.skin;
    let seconds = report.read_seconds
        + skin.seconds.rasterize
        + skin.seconds.smooth
        + skin.seconds.contour
        + report.write_seconds;
    format!(
        "{}, {}, {}, {seconds:.2} s",
        counted(skin.particle_count, "particle"),
        counted(skin.mesh.vertex_count, "vertex"),
        counted(skin.mesh.triangle_count, "triangle"),
    )
}

/// What a user should know of a frame though it was converted.
fn notes(report: &FrameReport) -> Vec<String> {
    let mut notes = report.notes.clone();
    let skin = &report.skin;
    if skin.dropped_count > 0 {
        notes.push(format!(
            "{} left out: not finite, or too far away for the grid",
            counted(skin.dropped_count, "particle")
        ));
    }
    if skin.convergence.is_some_and(|convergence| !convergence.reached) {
        notes.push("the conjugate gradients did not reach their tolerance".to_owned());
    }
    if skin.cfl_exceeded_count > 0 {
        notes.push(format!(
            "{} went beyond the CFL bound (Eq. 8): choose a smaller --step-size",
            counted(skin.cfl_exceeded_count, "explicit step")
        ));
    }
    if !skin.certificate.holds() {
        notes.push(format!("the result breaks its own guarantees: {:?}", skin.certificate));
    }
    notes
}

fn counted(count: usize, noun: &str) -> String {
    match (count, noun) {
        (1, _) => format!("1 {noun}"),
        (_, "vertex") => format!("{count} vertices"),
        _ => format!("{count} {noun}s"),
    }
}
