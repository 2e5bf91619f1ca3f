//! `meniscus convert`: frames of particles into meshes and level sets.

use std::path::{Path, PathBuf, absolute};
use std::sync::Arc;
use std::thread::available_parallelism;
use std::time::Instant;

use anyhow::{Context, Result, bail};
use meniscus_formats::listed;
use rayon::{ThreadPool, ThreadPoolBuilder};

use crate::farm::{Plan, PlannedFrame};
use crate::pipeline::{
    Frame, FrameState, Job, ObstacleFiles, OnError, OutputFormat, OutputOptions, Sequence, SequenceRecord,
    check_out_folder, check_outputs, file_of, inspect, size_bytes,
};
use crate::surface::simd::level_warning;

use super::Verdict;
use super::args::{ConvertArgs, Format, FormatArgs, MethodArgs, OnErrorChoice, ShardChoice, ShotArgs, typed};
use super::choices::{obstacle_files, output_options, refuse_idle_quantize, warn_of_ignored};
use super::console::Console;
use super::destination::Destination;
use super::interrupt::clean_up_when_interrupted;
use super::out_folder::{self, OutFolder};
use super::print_settings::print_settings;
use super::quantities::memory_bytes;
use super::resolving::Resolved;
use super::resurfacing::{refuse, refuse_of_particles, resolve_job, surface_job};
use super::run::{Batch, RunOptions};
use super::selecting::{
    SelectedSequence, Selection, refuse_conflicts, refuse_level_sets, refuse_report_of_plan, select_frames,
};
use super::sequence::Shots;
use super::standard_input::StandardInput;
use super::wording::counted;

/// Converts what the arguments ask for.
///
/// # Errors
/// When nothing can be done at all. A frame that fails is no error here: it is told, and counted.
pub(super) fn convert(args: &ConvertArgs, console: &mut Console) -> Result<Verdict> {
    let start = Instant::now();
    clean_up_when_interrupted();
    if let Some(plan) = &args.plan {
        return convert_shard(args, plan, start, console);
    }
    let (destination, mut args) = Destination::of(args, console)?;
    let _input = StandardInput::take(&mut args)?;
    let verdict = convert_to(&args, &destination, start, console)?;
    destination.send(verdict)
}

fn convert_to(
    args: &ConvertArgs,
    destination: &Destination,
    start: Instant,
    console: &mut Console,
) -> Result<Verdict> {
    refuse_idle_quantize(args.format.as_deref(), &args.formats)?;
    if args.particles_only {
        refuse_beside_particles(args)?;
    }
    if args.print_settings && args.inputs.is_empty() {
        return print_settings(&[], args, &thread_pool(args.threads)?, console);
    }
    let selection = select(args, destination, console)?;
    let job = job_of(&selection, args)?;
    let Selection { sequences, found, .. } = selection;
    if job != Job::Particles {
        // A .usda of the whole sequence says what a unit is, too.
        let meters_per_unit = args.formats.meters_per_unit.filter(|_| args.shot.sequence_usda.is_none());
        let judged = FormatArgs { meters_per_unit, ..args.formats.clone() };
        warn_of_ignored(&args.method, args.format.as_deref(), &judged, console);
        if let Some(warning) = level_warning() {
            console.warn(format_args!("warning: {warning}"));
        }
    }
    if args.print_settings {
        let sequences: Vec<&Sequence> = sequences.iter().map(|selected| &selected.sequence).collect();
        return print_settings(&sequences, args, &thread_pool(args.threads)?, console);
    }
    let obstacles = Arc::new(obstacle_files(&args.method)?);
    let outputs = Arc::new(outputs_of(args, job)?);
    let out_folder = OutFolder::make(&outputs.folder)?;
    let shots = Shots::asked_for(&args.shot, &outputs, sequences.len(), args.frames.is_some())?;
    let report = args.report.as_deref();
    refuse_conflicts(&sequences, &found, &obstacles, &outputs, report.map(|path| ("the report", path)))?;
    refuse_shots(&shots, &sequences, &found, (&obstacles, &outputs), report)?;
    let pool = thread_pool(args.threads)?;
    let memory_bytes = memory_bytes(args.memory)?;

    let mut batch = Batch::new(pool.current_num_threads(), on_error(args), args.allow_violations);
    for sequence in &sequences {
        let resolved = resolve_job(sequence, job, &args.method, &outputs, &pool, console)?;
        add(&mut batch, sequence, job, resolved, &obstacles);
    }
    out_folder.keep();
    let options = RunOptions { skip_done: args.skip_done, certificates: false, memory_bytes, pool: &pool };
    batch.convert(&options, console);
    let (frames, frame_count) = (batch.shot_frames().to_vec(), batch.frame_count());
    let verdict = batch.finish(args.report.as_deref(), start.elapsed().as_secs_f64(), console);
    Ok(pool.install(|| shots.write((&frames, frame_count), verdict, console)))
}

/// What is made of the selected files.
///
/// # Errors
/// When they are of several kinds, or options do not apply to them.
fn job_of(selection: &Selection, args: &ConvertArgs) -> Result<Job> {
    if args.particles_only {
        refuse_level_sets(selection, "--particles-only")?;
        return Ok(Job::Particles);
    }
    let job = surface_job(selection, args.band_slack)?;
    if let Job::LevelSet { slack_voxels, .. } = job {
        let given = args.print_settings.then(|| typed("print_settings"));
        refuse("it is about particles", &Vec::from_iter(given))?;
        refuse_of_particles(&args.method, slack_voxels)?;
    }
    Ok(job)
}

/// What is written: of particles as they are, .ply by default.
fn outputs_of(args: &ConvertArgs, job: Job) -> Result<OutputOptions> {
    let folder = args.out.clone().context("--out is missing: the folder for the results")?;
    let formats = if job == Job::Particles { Some(particle_formats(args)?) } else { args.format.clone() };
    Ok(output_options(folder, formats.as_deref(), &args.formats))
}

/// The formats for particles as they are.
fn particle_formats(args: &ConvertArgs) -> Result<Vec<Format>> {
    let formats = args.format.clone().unwrap_or_else(|| vec![Format(OutputFormat::Ply)]);
    if formats.iter().any(|format| format.0.particles().is_none()) {
        let all = OutputFormat::ALL.into_iter().filter(|format| format.particles().is_some());
        let all = listed(all.map(|format| format.to_string()).collect(), "and");
        bail!("--particles-only writes {all}: the other formats are of surfaces");
    }
    Ok(formats)
}

/// Refuses what is about surfaces.
fn refuse_beside_particles(args: &ConvertArgs) -> Result<()> {
    let ConvertArgs { report, plan, band_slack, print_settings, method, formats, shot, .. } = args;
    let is_alone = report.is_none()
        && band_slack.is_none()
        && plan.is_none()
        && !print_settings
        && *method == MethodArgs::default()
        && *formats == FormatArgs::default()
        && *shot == ShotArgs::default();
    if !is_alone {
        bail!(
            "--particles-only writes particles as they are: beside it only INPUT, --out, --format, --frames, --skip-done, \
             --threads, --memory and --on-error may be given; what is about surfaces, their files and reports makes no sense \
             with it"
        );
    }
    particle_formats(args).map(|_| ())
}

/// The frames to convert.
///
/// # Errors
/// When there are none, or several for one file, or when paths could not be read and the first failure is to be the end.
fn select(args: &ConvertArgs, destination: &Destination, console: &mut Console) -> Result<Selection> {
    let mut selection = select_frames(&args.inputs, args.frames.as_ref(), &args.method, console)?;
    if console.failed_count() > 0 && args.on_error == OnErrorChoice::Stop {
        bail!("nothing is converted, because of --on-error stop: make the paths above readable");
    }
    destination.name_outputs(&mut selection)?;
    Ok(selection)
}

/// Refuses shots that would replace an input, an obstacle, a result, the report, or each other.
fn refuse_shots(
    shots: &Shots,
    sequences: &[SelectedSequence],
    found: &[PathBuf],
    (obstacles, outputs): (&ObstacleFiles, &OutputOptions),
    report: Option<&Path>,
) -> Result<()> {
    shots.refuse_places()?;
    for path in shots.paths() {
        refuse_conflicts(sequences, found, obstacles, outputs, Some(("the shot", path)))?;
        if report.is_some_and(|report| absolute(report).ok() == absolute(path).ok()) {
            bail!("the report and the shot would both become {}", path.display());
        }
    }
    Ok(())
}

fn on_error(args: &ConvertArgs) -> OnError {
    match args.on_error {
        OnErrorChoice::Stop => OnError::Stop,
        OnErrorChoice::Continue => OnError::Continue,
    }
}

/// Adds the frames of a sequence to a batch.
fn add(
    batch: &mut Batch,
    SelectedSequence { sequence, selected }: &SelectedSequence,
    job: Job,
    resolved: Result<Resolved, String>,
    obstacles: &Arc<ObstacleFiles>,
) {
    let name = &sequence.name;
    let record = match &resolved {
        Ok(Resolved { settings, measured, outputs }) => {
            SequenceRecord::new(name, &job, settings, measured.as_ref(), (outputs, obstacles))
        }
        Err(why) => SequenceRecord::without_settings(name, why),
    };
    let sequence_index = batch.add_sequence(name, record);
    for file in selected {
        let frame = |Resolved { settings, outputs, .. }: &Resolved| Frame {
            job,
            obstacles: Arc::clone(obstacles),
            ..Frame::new(file, settings, outputs)
        };
        batch.add_frame(&file.path, sequence_index, resolved.as_ref().map(frame).map_err(String::clone));
    }
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

/// Converts the frames of a shard.
fn convert_shard(args: &ConvertArgs, path: &Path, start: Instant, console: &mut Console) -> Result<Verdict> {
    refuse_beside_plan(args)?;
    let plan = Plan::read(path).with_context(|| path.display().to_string())?;
    let shard = args.shard.context("--shard is missing: which of the plan's shards to convert")?;
    let (shard, frames) = shard_of(&plan, shard)?;
    if let Some(warning) = level_warning() {
        console.warn(format_args!("warning: {warning}"));
    }
    let obstacles = Arc::new(ObstacleFiles::new(plan.obstacles.clone()));
    let out = plan.out().context("the plan has no sequence")?;
    if !out.is_dir() {
        bail!(
            "{}: the folder of the results, which `plan` made, is not there: is it mounted?",
            out.display()
        );
    }
    check_out_folder(out)?;
    out_folder::recover(out)?;
    refuse_report_of_plan(args.report.as_deref(), &plan, path)?;
    let pool = thread_pool(args.threads)?;
    let memory_bytes = memory_bytes(args.memory)?;

    let mut batch = Batch::new(pool.current_num_threads(), on_error(args), args.allow_violations);
    for sequence in &plan.sequences {
        let files = (&*sequence.outputs, &*obstacles);
        let record = SequenceRecord::new(
            &sequence.name,
            &sequence.job,
            &sequence.settings,
            sequence.measured.as_ref(),
            files,
        );
        batch.add_sequence(&sequence.name, record);
    }
    // Whether a result would replace another shard's input the plan was asked already, by name: looking at all
    // files of a shot from each of its shards would keep a file server busy.
    let inputs: Vec<_> = frames.iter().map(|frame| frame.input.clone()).collect();
    let planned: Vec<_> = frames.iter().map(|frame| (frame.input.clone(), frame.stem.clone())).collect();
    if let Some(sequence) = plan.sequences.first() {
        check_outputs(&planned, &inputs, &obstacles, &sequence.outputs, None)?;
    }
    console.say(format_args!("shard {shard} of {}: {}", plan.shards.len(), counted(frames.len(), "frame")));
    for planned in frames {
        if let Ok(there) = size_bytes(&planned.input)
            && there != planned.size_bytes
        {
            let (name, was) = (planned.input.display(), planned.size_bytes);
            console.warn(format_args!(
                "warning: {name}: it has {there} bytes, and had {was} when the plan was made"
            ));
        }
        let frame = plan.frame(planned, &obstacles);
        if let Some(fault) = done_without_inputs(&frame) {
            console.say(format_args!(
                "{}: done already; what it was made from is not there any more",
                planned.stem
            ));
            batch.add_done(frame, planned.sequence, fault);
            continue;
        }
        batch.add_frame(&planned.input, planned.sequence, Ok(frame));
    }
    let options = RunOptions { skip_done: true, certificates: true, memory_bytes, pool: &pool };
    batch.convert(&options, console);
    Ok(batch.finish(args.report.as_deref(), start.elapsed().as_secs_f64(), console))
}

/// Of a frame that cannot be made again, its input or an obstacle being gone, and need not be, as `verify` sees it: what its
/// certificate says does not hold. `None` of any other frame.
fn done_without_inputs(frame: &Frame) -> Option<Option<String>> {
    let is_absent = matches!(file_of(&frame.input).try_exists(), Ok(false));
    let is_gone = is_absent || !frame.obstacles.are_there(frame.number);
    match is_gone.then(|| inspect(frame).state)? {
        FrameState::Done => Some(None),
        FrameState::Uncertified(why) => Some(Some(why)),
        FrameState::Missing { .. } | FrameState::Damaged(_) | FrameState::Stale(_) => None,
    }
}

/// Refuses what the plan says.
fn refuse_beside_plan(args: &ConvertArgs) -> Result<()> {
    let ConvertArgs {
        inputs,
        input_format,
        out,
        format,
        frames,
        skip_done,
        band_slack,
        print_settings,
        method,
        formats,
        shot,
        ..
    } = args;
    let is_alone = inputs.is_empty()
        && input_format.is_none()
        && out.is_none()
        && format.is_none()
        && frames.is_none()
        && !(*skip_done || *print_settings)
        && band_slack.is_none()
        && *method == MethodArgs::default()
        && *formats == FormatArgs::default()
        && *shot == ShotArgs::default();
    if !is_alone {
        bail!(
            "the plan says what is made of which frames, and where: beside --plan only --shard, --report, --threads, \
             --memory, --on-error and --allow-violations may be given; for other frames or options, plan again"
        );
    }
    Ok(())
}

/// The shard that was asked for, and its frames.
fn shard_of(plan: &Plan, choice: ShardChoice) -> Result<(usize, &[PlannedFrame])> {
    let (shard, named) = match choice {
        ShardChoice::Number(number) => (number, "--shard".to_owned()),
        ShardChoice::Slurm => (slurm_task()?, SLURM_TASK.to_owned()),
    };
    let last = plan.shards.len().saturating_sub(1);
    let frames = usize::try_from(shard).ok().and_then(|shard| Some((shard, plan.shards.get(shard)?.clone())));
    let Some((shard, frames)) = frames else {
        bail!(
            "{named} is {shard}, and the plan's shards are 0 to {last}: a job array for it is --array=0-{last}"
        );
    };
    Ok((shard, plan.frames.get(frames).unwrap_or_default()))
}

/// The number of this task of a job array.
fn slurm_task() -> Result<u64> {
    let number = std::env::var_os(SLURM_TASK).with_context(|| {
        format!("--shard slurm: {SLURM_TASK} is not set: it is in tasks of a job array, as sbatch --array makes them")
    })?;
    let number = number.to_string_lossy();
    let parsed = number.parse().ok().filter(|_| number.bytes().all(|byte| byte.is_ascii_digit()));
    parsed
        .with_context(|| format!("--shard slurm: {SLURM_TASK} is `{number}`, which is no number of a shard"))
}

/// Where Slurm tells the number of a task.
const SLURM_TASK: &str = "SLURM_ARRAY_TASK_ID";
