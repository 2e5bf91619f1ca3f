//! `meniscus convert`: converts frames of particles into meshes and level sets.

use std::path::Path;
use std::sync::Arc;
use std::time::Instant;

use anyhow::{Context, Result, bail};
use meniscus_formats::listed;

use crate::farm::{PlannedFrame, ShardPlan};
use crate::pipeline::{
    self, Frame, FrameFile, InspectedState, Job, ObstacleFiles, OnError, OutputFormat, OutputOptions,
    Sequence, SequenceRecord, StageFrame, StageSequence, check_existing, check_out_folder, check_outputs,
    file_of, inspect, output_sequence, size_bytes,
};

use super::CommandOutcome;
use super::args::{ConvertArgs, FormatArgs, OptionSet, ShardChoice};
use super::console::Console;
use super::conversion::{Conversion, refuse_combination, warn_before, warn_of_level};
use super::destination::Destination;
use super::level_sets::surface_job;
use super::machine::thread_pool;
use super::out_folder;
use super::print_settings::{print_settings, print_settings_of_any};
use super::run::{Batch, RunOptions};
use super::select::{SelectedSequence, refuse_level_sets, refuse_report_of_plan, select_frames};
use super::sequence::SequenceOutputs;
use super::stage::StageWriter;
use super::standard_input::StandardInput;
use super::wording::pluralize;

/// Converts the selected frames.
///
/// # Errors
/// If the conversion cannot start, for example because an option is invalid. A failed frame is not an error
/// here: it is reported and counted.
pub(super) fn convert(args: &ConvertArgs, console: &mut Console) -> Result<CommandOutcome> {
    let start = Instant::now();
    if let Some(plan) = &args.plan {
        return convert_shard(args, plan, start, console);
    }
    if args.particles_only {
        refuse_combination(&args.given(), &ALLOWED_WITH_PARTICLES_ONLY, PARTICLES_ONLY)?;
    }
    let (destination, folder, formats) = Destination::of(args, console)?;
    let outputs = formats.outputs(folder)?;
    if outputs.stage.is_some() && !matches!(destination, Destination::Folder) {
        bail!("--stage plays the files of a folder: name a folder with --out");
    }
    if args.particles_only {
        refuse_surface_formats(&outputs)?;
    }
    // Printing settings refuses the sequence files that a conversion would refuse.
    let check_sequence_files =
        |sequence_count| SequenceOutputs::new((&args.shot, None), &outputs, sequence_count, false).map(drop);
    if args.print_settings && args.inputs.is_empty() {
        check_sequence_files(1)?;
        print_settings_of_any(&args.method, &outputs, console)?;
        return Ok(CommandOutcome::Done);
    }
    let pipe = StandardInput::take(args)?;
    let inputs = pipe.as_ref().map_or(&*args.inputs, |pipe| std::slice::from_ref(&pipe.path));
    let mut selection = select_frames(inputs, args.frames.as_ref(), &args.method, console)?;
    if console.failed_count() > 0 && args.on_error == Some(OnError::Stop) {
        bail!("nothing is converted, because of --on-error stop: make the paths above readable");
    }
    destination.name_outputs(&mut selection)?;
    let job = if args.particles_only {
        refuse_level_sets(&selection, "--particles-only")?;
        Job::Particles
    } else {
        let job = surface_job(&selection, args.max_deviation, &args.method)?;
        // --meters-per-unit also affects a USD sequence file: with such a file, the option is not reported as
        // ignored.
        let has_usd = args.shot.sequence_usda.is_some() || args.shot.sequence_usdc.is_some();
        let meters_per_unit = formats.meters_per_unit.filter(|_| !has_usd);
        warn_before(&args.method, &FormatArgs { meters_per_unit, ..formats }, console);
        job
    };
    if args.print_settings {
        check_sequence_files(selection.sequences.len())?;
        let pool = thread_pool(args.run.threads)?;
        print_settings(&selection.sequences, job, (&args.method, &outputs), &pool, console)?;
        return Ok(CommandOutcome::Done);
    }
    let conversion = Conversion::new(selection, job, &args.method, outputs)?;
    destination.send(convert_all(args, conversion, start, console)?)
}

/// The options allowed with `--particles-only`.
const ALLOWED_WITH_PARTICLES_ONLY: [&str; 11] = [
    "particles_only",
    "inputs",
    "input_format",
    "out",
    "format",
    "frames",
    "where",
    "skip_done",
    "threads",
    "memory",
    "on_error",
];

const PARTICLES_ONLY: &str = "--particles-only makes no surfaces, so options for surfaces, their files and \
     reports do not apply: only INPUT, --out, --format, --frames, --where, --skip-done, --threads, --memory \
     and --on-error may be combined with it";

/// Refuses formats that cannot store particles.
fn refuse_surface_formats(outputs: &OutputOptions) -> Result<()> {
    if outputs.formats.iter().any(|format| format.particles().is_none()) {
        let all = OutputFormat::ALL.into_iter().filter(|format| format.particles().is_some());
        let all = listed(all.map(|format| format.to_string()).collect(), "and");
        bail!("--particles-only writes {all}: the other formats store surfaces");
    }
    Ok(())
}

/// Converts the frames, and combines them into sequence files.
fn convert_all(
    args: &ConvertArgs,
    conversion: Conversion,
    start: Instant,
    console: &mut Console,
) -> Result<CommandOutcome> {
    let (sequences, outputs) = (&conversion.sequences, &conversion.outputs);
    let shot = (&args.shot, args.formats.fps);
    let shots = SequenceOutputs::new(shot, outputs, sequences.len(), args.frames.is_some())?;
    refuse_file_conflicts(&conversion, args.report.as_deref(), &shots)?;
    let options = RunOptions::new(args, start)?;
    let mut batch = Batch::new(&options);
    batch.stage = StageWriter::new(outputs, || {
        let all = sequences.iter().map(|selected| &selected.sequence).chain(&conversion.unselected);
        all.map(|sequence| stage_sequence(sequence, outputs)).collect()
    });
    for sequence in sequences {
        add(&mut batch, sequence, &conversion, console)?;
    }
    conversion.folder.keep();
    batch.convert(console);
    let (frames, frame_count) = (batch.sequence_frames().to_vec(), batch.frame_count());
    let verdict = finish(batch, console);
    Ok(options.pool.install(|| shots.write((&frames, frame_count), verdict, console)))
}

/// Refuses a report, a stage and sequence files that would replace inputs, results or each other.
fn refuse_file_conflicts(
    conversion: &Conversion,
    report: Option<&Path>,
    shots: &SequenceOutputs,
) -> Result<()> {
    let stage = conversion.outputs.stage.iter().map(|stage| ("the stage", &*stage.path));
    let written = report.into_iter().map(|path| ("the report", path));
    let written = written.chain(stage).chain(shots.paths().map(|path| ("the sequence file", path)));
    let written: Vec<(&'static str, &Path)> = written.collect();
    conversion.refuse_conflicts(&written)
}

/// All frames of a sequence, selected or not.
fn stage_sequence(sequence: &Sequence, outputs: &OutputOptions) -> StageSequence {
    let frame = |file: &FrameFile| StageFrame::new(outputs, &file.stem(), file.number());
    let name = sequence.frames.first().map_or(String::new(), |file| output_sequence(&file.sequence().1));
    StageSequence { name, frames: sequence.frames.iter().map(frame).collect() }
}

/// Finishes a batch, and then its stage.
fn finish(mut batch: Batch, console: &mut Console) -> CommandOutcome {
    let stage = batch.stage.take();
    let verdict = batch.finish(console);
    match stage {
        Some(stage) => stage.finish(verdict, console),
        None => verdict,
    }
}

/// Adds the frames of a sequence to a batch.
fn add(
    batch: &mut Batch,
    selected: &SelectedSequence,
    conversion: &Conversion,
    console: &mut Console,
) -> Result<()> {
    let resolved = conversion.resolve(selected, &batch.options.pool, console)?;
    let (name, Conversion { job, obstacles, .. }) = (&selected.sequence.name, conversion);
    let record = match &resolved {
        Ok(shared) => {
            let files = (&*shared.outputs, &**obstacles);
            SequenceRecord::new(name, job, &shared.settings, shared.measured.as_ref(), files)
        }
        Err(why) => SequenceRecord::without_settings(name, why),
    };
    let sequence_index = batch.add_sequence(name, record);
    for file in &selected.selected {
        let frame = resolved.as_ref().map(|shared| Frame {
            job: *job,
            obstacles: Arc::clone(obstacles),
            ..Frame::new(file, &shared.settings, &shared.outputs)
        });
        batch.add_frame(&file.path, sequence_index, frame.map_err(String::clone));
    }
    Ok(())
}

/// The options allowed with `--plan`.
const ALLOWED_WITH_PLAN: [&str; 7] =
    ["plan", "shard", "report", "threads", "memory", "on_error", "allow_violations"];

const PLAN: &str = "the plan determines frames, settings and outputs: only --shard, --report, --threads, \
     --memory, --on-error and --allow-violations may be combined with --plan; for other frames or options, make a new plan";

/// Converts the frames of a shard.
fn convert_shard(
    args: &ConvertArgs,
    path: &Path,
    start: Instant,
    console: &mut Console,
) -> Result<CommandOutcome> {
    refuse_combination(&args.given(), &ALLOWED_WITH_PLAN, PLAN)?;
    let plan = ShardPlan::read(path).with_context(|| path.display().to_string())?;
    let shard = args.shard.context("--plan requires --shard K: the index of the shard to convert")?;
    let (shard, frames) = shard_of(&plan, shard)?;
    warn_of_level(console);
    let obstacles = Arc::new(ObstacleFiles::new(plan.obstacles.clone()));
    let out = plan.out().context("the plan has no sequence")?;
    if !out.is_dir() {
        bail!(
            "{}: the folder of the results, which `plan` made, does not exist: is it mounted?",
            out.display()
        );
    }
    check_out_folder(out)?;
    out_folder::recover(out)?;
    refuse_report_of_plan(args.report.as_deref(), &plan, path)?;
    let options = RunOptions::new(args, start)?;
    let mut batch = Batch::new(&options);
    for sequence in &plan.sequences {
        let (files, measured) = ((&*sequence.outputs, &*obstacles), sequence.measured.as_ref());
        let record = SequenceRecord::new(&sequence.name, &sequence.job, &sequence.settings, measured, files);
        batch.add_sequence(&sequence.name, record);
    }
    // Only the inputs of this shard are checked: `plan` checked already, by name, that no result replaces
    // another shard's input. If every shard checked all files of the sequence, it would overload a file
    // server.
    let inputs: Vec<_> = frames.iter().map(|frame| frame.input.clone()).collect();
    let planned: Vec<_> = frames.iter().map(|frame| (frame.input.clone(), frame.stem.clone())).collect();
    if let Some(sequence) = plan.sequences.first() {
        check_outputs(&planned, &inputs, &obstacles, &sequence.outputs, &[])?;
        check_existing(&planned, &sequence.outputs, sequence.job)?;
    }
    let numbers = match plan.shards.len() {
        1 => "the only one".to_owned(),
        count => format!("of 0 to {}", count - 1),
    };
    console.print_line(format_args!("shard {shard} ({numbers}): {}", pluralize(frames.len(), "frame")));
    for planned in frames {
        add_planned(&mut batch, planned, plan.frame(planned, &obstacles), console);
    }
    batch.stage = plan
        .sequences
        .first()
        .and_then(|sequence| StageWriter::new(&sequence.outputs, || planned_stage_sequences(&plan)));
    batch.convert(console);
    Ok(finish(batch, console))
}

/// All frames of a plan, which are those of all shards.
fn planned_stage_sequences(plan: &ShardPlan) -> Vec<StageSequence> {
    let none = || StageSequence { name: String::new(), frames: Vec::new() };
    let mut sequences: Vec<StageSequence> = plan.sequences.iter().map(|_| none()).collect();
    for PlannedFrame { input, stem, number, sequence, .. } in &plan.frames {
        let (planned, staged) = (&plan.sequences[*sequence], &mut sequences[*sequence]);
        if staged.frames.is_empty() {
            // The name of a sequence with a single frame is that of the file.
            let name = match planned.name.contains("{}") {
                true => planned.name.clone(),
                false => {
                    let found = pipeline::sequences(vec![FrameFile::of_outputs(input.clone(), stem)]);
                    found.first().map_or(String::new(), |sequence| sequence.frames[0].sequence().1)
                }
            };
            staged.name = output_sequence(&name);
        }
        staged.frames.push(StageFrame::new(&planned.outputs, stem, *number));
    }
    sequences
}

/// Adds a frame of a plan to a batch.
fn add_planned(batch: &mut Batch, planned: &PlannedFrame, frame: Frame, console: &mut Console) {
    if let Ok(input_bytes) = size_bytes(&planned.input)
        && input_bytes != planned.size_bytes
    {
        let (name, was) = (planned.input.display(), planned.size_bytes);
        console.warning(format_args!(
            "{name}: changed since the plan was made ({was} bytes then, {input_bytes} now): using the current file"
        ));
    }
    match done_without_inputs(&frame) {
        Some(fault) => {
            console.print_line(format_args!("{}: done already; its inputs no longer exist", planned.stem));
            batch.add_done(frame, planned.sequence, fault);
        }
        None => batch.add_frame(&planned.input, planned.sequence, Ok(frame)),
    }
}

/// `Some` if an input or obstacle of the frame no longer exists, and its outputs are done by the criteria of
/// `verify`. The inner value is the reason if the outputs failed validation, or else `None`.
fn done_without_inputs(frame: &Frame) -> Option<Option<String>> {
    let is_absent = matches!(file_of(&frame.input).try_exists(), Ok(false));
    let is_gone = is_absent || !frame.obstacles.exist(frame.number);
    match is_gone.then(|| inspect(frame).state)? {
        InspectedState::Done => Some(None),
        InspectedState::Uncertified(why) => Some(Some(why)),
        InspectedState::Missing { .. } | InspectedState::Damaged(_) | InspectedState::Stale(_) => None,
    }
}

/// The selected shard, and its frames.
fn shard_of(plan: &ShardPlan, choice: ShardChoice) -> Result<(usize, &[PlannedFrame])> {
    let (shard, named) = match choice {
        ShardChoice::Number(number) => (number, "--shard".to_owned()),
        ShardChoice::Slurm => (slurm_task()?, SLURM_TASK.to_owned()),
    };
    let last = plan.shards.len().saturating_sub(1);
    let frames = usize::try_from(shard).ok().and_then(|shard| Some((shard, plan.shards.get(shard)?.clone())));
    let Some((shard, frames)) = frames else {
        bail!(
            "{named} is {shard}, but the plan has shards 0 to {last} (for a job array of Slurm: --array=0-{last})"
        );
    };
    Ok((shard, plan.frames.get(frames).unwrap_or_default()))
}

/// The index of this task in a job array.
fn slurm_task() -> Result<u64> {
    let number = std::env::var_os(SLURM_TASK).with_context(|| {
        format!("--shard slurm: {SLURM_TASK} is not set: Slurm sets it in the tasks of a job array (sbatch --array)")
    })?;
    let number = number.to_string_lossy();
    let parsed = number.parse().ok().filter(|_| number.bytes().all(|byte| byte.is_ascii_digit()));
    parsed.with_context(|| format!("--shard slurm: {SLURM_TASK} is `{number}`, which is not a shard index"))
}

/// The environment variable with the index of a Slurm task.
const SLURM_TASK: &str = "SLURM_ARRAY_TASK_ID";
