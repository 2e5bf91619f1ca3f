//! `meniscus convert`: converts frames of particles into meshes and level sets.

use std::ops::Range;
use std::path::Path;
use std::sync::Arc;
use std::time::Instant;

use anyhow::{Context, Result, bail};
use meniscus_formats::listed;

use crate::pipeline::{
    Frame, FrameFile, FrameRecords, Job, OnError, OutputFormat, OutputOptions, STATE_FOLDER, Sequence,
    SequenceRecord, StageFrame, StageSequence, output_sequence,
};

use super::CommandOutcome;
use super::args::{ConvertArgs, FormatArgs, FrameShard, OptionSet, ShardChoice};
use super::console::Console;
use super::conversion::{Conversion, refuse_combination, warn_before};
use super::destination::Destination;
use super::level_sets::surface_job;
use super::machine::thread_pool;
use super::print_settings::{print_settings, print_settings_of_any};
use super::run::{Batch, RunOptions};
use super::select::{InputSelection, SelectedSequence, refuse_level_sets, select_frames, selected_files};
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
    if let Some(shard) = shard_of(args, &destination, &outputs)? {
        shard.keep_only(&mut selection, console)?;
    }
    let conversion = Conversion::new(selection, job, &args.method, outputs)?;
    // Only a folder of results has records.
    let records = matches!(destination, Destination::Folder)
        .then(|| open_records(&conversion.outputs.folder, console))
        .transpose()?;
    destination.send(convert_all(args, conversion, records.map(Arc::new), start, console)?)
}

/// The records of finished frames in the folder of the results.
///
/// # Errors
/// If records cannot be read or written there.
fn open_records(folder: &Path, console: &Console) -> Result<FrameRecords> {
    let opened = FrameRecords::open(folder).and_then(|records| records.prepare().map(|()| records));
    let records = opened.with_context(|| {
        let records = folder.join(STATE_FOLDER);
        format!("{}: finished frames are recorded in this folder: make it writable", records.display())
    })?;
    for problem in records.problems() {
        console.warning(format_args!("{problem}: frames that are recorded there are converted again"));
    }
    Ok(records)
}

/// The options allowed with `--particles-only`.
const ALLOWED_WITH_PARTICLES_ONLY: [&str; 12] = [
    "particles_only",
    "inputs",
    "input_format",
    "out",
    "format",
    "frames",
    "where",
    "skip_done",
    "shard",
    "threads",
    "memory",
    "on_error",
];

const PARTICLES_ONLY: &str = "--particles-only makes no surfaces, so options for surfaces, their files and \
     reports do not apply: only INPUT, --out, --format, --frames, --where, --skip-done, --shard, --threads, \
     --memory and --on-error may be combined with it";

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
    records: Option<Arc<FrameRecords>>,
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
        add(&mut batch, sequence, &conversion, records.as_ref(), console)?;
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
    records: Option<&Arc<FrameRecords>>,
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
            records: records.cloned(),
            ..Frame::new(file, &shared.settings, &shared.outputs)
        });
        batch.add_frame(&file.path, sequence_index, frame.map_err(String::clone));
    }
    Ok(())
}

/// The shard of `--shard`, if it is given.
///
/// # Errors
/// If the environment does not name one, or the shard does not suit the other options.
fn shard_of(
    args: &ConvertArgs,
    destination: &Destination,
    outputs: &OutputOptions,
) -> Result<Option<FrameShard>> {
    let Some(choice) = args.shard else { return Ok(None) };
    if !matches!(destination, Destination::Folder) {
        bail!("--shard writes into a folder that all shards share: name a folder with --out");
    }
    if !outputs.folder.is_dir() {
        bail!(
            "{}: the folder of the results does not exist: is it mounted? Create it before the shards start",
            outputs.folder.display()
        );
    }
    if args.shot.is_any() {
        bail!(
            "--shard converts a part of the frames: make sequence files afterwards, with `meniscus sequence`"
        );
    }
    match choice {
        ShardChoice::Part(shard) => Ok(Some(shard)),
        ShardChoice::Slurm => slurm_shard().map(Some),
    }
}

/// The shard of this task of a job array.
fn slurm_shard() -> Result<FrameShard> {
    let [task, min, max, step, count] =
        ["ID", "MIN", "MAX", "STEP", "COUNT"].map(|name| format!("SLURM_ARRAY_TASK_{name}"));
    let [task, min, max, step, count] = [&task, &min, &max, &step, &count].map(String::as_str);
    let number = |name: &str| -> Result<usize> {
        let value = std::env::var_os(name).with_context(|| {
            format!(
                "--shard slurm: {name} is not set: Slurm sets it in the tasks of a job array (sbatch --array)"
            )
        })?;
        let value = value.to_string_lossy();
        value.parse().with_context(|| format!("--shard slurm: {name} is `{value}`, which is not a number"))
    };
    let (id, min, max) = (number(task)?, number(min)?, number(max)?);
    let step = if std::env::var_os(step).is_some() { number(step)? } else { 1 };
    if step == 0 || !(min..=max).contains(&id) || !(id - min).is_multiple_of(step) {
        bail!("--shard slurm: task {id} is not in the array {min}-{max}:{step}");
    }
    let task_count = ((max - min) / step).checked_add(1).context("--shard slurm: the array is too large")?;
    if std::env::var_os(count).is_some() && number(count)? != task_count {
        bail!(
            "--shard slurm: the array {min}-{max}:{step} has gaps, so some shards would never run: submit the whole array; finished frames are skipped"
        );
    }
    Ok(FrameShard { index: (id - min) / step, count: task_count })
}

impl FrameShard {
    /// Leaves only the frames of this shard in a selection. The settings of each sequence still follow from all
    /// its frames.
    ///
    /// # Errors
    /// If not all frames can be found: then the shards would not cover them.
    fn keep_only(self, selection: &mut InputSelection, console: &mut Console) -> Result<()> {
        if !selection.is_complete {
            bail!("nothing is converted, because shards need all frames: make the paths above readable");
        }
        let frame_count = selected_files(&selection.sequences).count();
        let frames = self.frames(frame_count);
        let (number, count) = (self.index + 1, self.count);
        let kept = pluralize(frames.len(), "frame");
        console.print_line(format_args!("shard {number}/{count}: {kept} of {frame_count}"));
        let mut first = 0;
        for selected in &mut selection.sequences {
            let all = std::mem::take(&mut selected.selected);
            let numbers = first..first + all.len();
            first = numbers.end;
            let numbered = numbers.zip(all).filter(|(number, _)| frames.contains(number));
            selected.selected = numbered.map(|(_, file)| file).collect();
        }
        let (kept, others): (Vec<_>, Vec<_>) = std::mem::take(&mut selection.sequences)
            .into_iter()
            .partition(|selected| !selected.selected.is_empty());
        selection.sequences = kept;
        selection.unselected.extend(others.into_iter().map(|selected| selected.sequence));
        Ok(())
    }

    /// The numbers of the frames of this shard, of `frame_count` frames. The sizes of shards differ by one at
    /// most. If there are more shards than frames, some have none.
    fn frames(self, frame_count: usize) -> Range<usize> {
        let (each, more) = (frame_count / self.count, frame_count % self.count);
        let first_of = |index: usize| index * each + index.min(more);
        first_of(self.index)..first_of(self.index + 1)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frames_are_divided_into_even_shards() {
        for frame_count in [0, 1, 2, 7, 8, 9, 240, 1001] {
            for count in [1, 2, 3, 8, 16, 300] {
                let shards: Vec<_> =
                    (0..count).map(|index| FrameShard { index, count }.frames(frame_count)).collect();
                let dealt: Vec<usize> = shards.iter().cloned().flatten().collect();
                assert_eq!(dealt, (0..frame_count).collect::<Vec<_>>());
                let sizes = || shards.iter().map(ExactSizeIterator::len);
                assert!(sizes().max().unwrap_or(0) - sizes().min().unwrap_or(0) <= 1, "{shards:?}");
            }
        }
    }
}
