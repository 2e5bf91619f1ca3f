//! `meniscus convert`: converts frames of particles into meshes and level sets.
//!
//! ```text
//!   ConvertArgs ──▶ ConvertPlan ──▶ Batch ──▶ pipeline
//!   as given        resolved       frames and their outcomes
//! ```

use std::collections::{BTreeSet, HashSet};
use std::io;
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Instant;

use anyhow::{Context, Result, anyhow, bail};
use meniscus_formats::listed;

use crate::pipeline::{
    Frame, FrameFile, FrameRecords, Job, NumberedFrames, ObstacleFiles, OnError, OutputFormat, OutputOptions,
    STATE_FOLDER, Sequence, SequenceRecord, UsdStageFrame, UsdStageSequence, check_outputs, frame_rate,
    is_same_time, output_sequence, seconds_by_motion, stage_frame_count, step_of,
};
use crate::surface::attributes::names_velocity;
use crate::surface::options::{AttributeSelection, MethodOptions, Settings};
use crate::surface::simd::level_warning;
use crate::surface::words::significant;

use super::CommandOutcome;
use super::args::{ConvertArgs, FrameShard, OptionSet, ShardChoice};
use super::batch::{Batch, UsdStageWriter};
use super::console::Console;
use super::destination::{Destination, OutFolder, StandardInput};
use super::inputs::{
    InputSelection, SelectedSequence, check_output_path, is_pattern, refuse_level_sets, select_frames,
    selected_files,
};
use super::sequence::SequenceOutputs;
use super::settings::{
    measure_if_needed, obstacle_files, outputs_of, print_settings, print_settings_of_any, report_settings,
    settings_of, surface_job, warn_of, warn_of_ignored, warn_of_siblings,
};
use super::wording::{option_names, pluralize};

/// Converts the selected frames.
///
/// # Errors
/// If the conversion cannot start, for example because an option is invalid. A failed frame is not an error
/// here: it is reported and counted.
pub(super) fn convert(args: &ConvertArgs, console: &mut Console) -> Result<CommandOutcome> {
    if args.quiet {
        console.be_quiet();
    }
    let start = Instant::now();
    if args.particles_only {
        refuse_options_for_surfaces(args)?;
    }
    let (destination, folder, formats) = Destination::of(args, console)?;
    let mut outputs = formats.outputs(folder)?;
    outputs.spray = formats.spray(&args.method, &outputs);
    if outputs.stage.is_some() && !destination.is_folder() {
        bail!("--stage plays the files of a folder: name a folder with --out");
    }
    if args.particles_only {
        refuse_surface_formats(&outputs)?;
    }
    if args.print_settings && args.inputs.is_empty() {
        // This refuses the sequence files that a conversion would refuse.
        SequenceOutputs::new(args, &outputs, 1, None)?;
        print_settings_of_any(&args.method, &outputs, console)?;
        return Ok(CommandOutcome::Done);
    }
    let pipe = StandardInput::take(args)?;
    let inputs = pipe.as_ref().map_or(&*args.inputs, |pipe| std::slice::from_ref(&pipe.path));
    if args.shard.is_some() {
        check_mounted(inputs)?;
    }
    // Files that are looked at from here on keep to the memory limit, too.
    let batch = Batch::new(args, start)?;
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
        warn_of_ignored(&args.method, &formats, console);
        if let Some(warning) = level_warning() {
            console.warning(warning);
        }
        job
    };
    let fps = args.formats.fps.or_else(|| frame_rate_of(&selection));
    if let (Some(stage), Some(fps)) = (&mut outputs.stage, fps) {
        stage.fps = fps;
    }
    if args.print_settings {
        // As above, this refuses the sequence files that a conversion would refuse.
        SequenceOutputs::new(args, &outputs, selection.sequences.len(), fps)?;
        print_settings(&selection.sequences, job, &args.method, &outputs, &batch.pool, console)?;
        return Ok(CommandOutcome::Done);
    }
    if let Some(shard) = shard_of(args, &destination, &outputs)? {
        shard.keep_only(&mut selection, console)?;
    }
    let obstacles = Arc::new(obstacle_files(&args.method)?);
    let out_folder = OutFolder::make(&outputs.folder)?;
    // Only a folder of results has records.
    let records = destination.is_folder().then(|| open_records(&outputs.folder, console)).transpose()?;
    let plan = ConvertPlan {
        sequence_files: SequenceOutputs::new(args, &outputs, selection.sequences.len(), fps)?,
        selection,
        job,
        options: args.method.to_options(),
        obstacles,
        outputs,
        records: records.map(Arc::new),
    };
    plan.refuse_conflicts(args.report.as_deref())?;
    let outcome = plan.run(batch, out_folder, console)?;
    destination.copy_to_stdout(outcome)
}

/// The frame rate by the times of the frames, if they are steps of files that all have the same rate.
fn frame_rate_of(selection: &InputSelection) -> Option<f64> {
    let files = selected_files(&selection.sequences).map(|file| step_of(&file.path).map(|(file, _)| file));
    let files: BTreeSet<&Path> = files.collect::<Option<_>>()?;
    let mut rates = files.into_iter().map(frame_rate);
    let first = rates.next()??;
    rates.all(|rate| rate == Some(first)).then_some(first)
}

/// Refuses given options for surfaces, for `--particles-only`.
fn refuse_options_for_surfaces(args: &ConvertArgs) -> Result<()> {
    let mut refused = args.given();
    refused.retain(|name| !ALLOWED_WITH_PARTICLES_ONLY.contains(name));
    if !refused.is_empty() {
        bail!("{}: {PARTICLES_ONLY}", option_names(&refused));
    }
    Ok(())
}

/// The records of finished frames in the folder of the results.
///
/// # Errors
/// If records cannot be read there.
fn open_records(folder: &Path, console: &Console) -> Result<FrameRecords> {
    let records = FrameRecords::open(folder)
        .with_context(|| format!("{}: cannot read the records", folder.join(STATE_FOLDER).display()))?;
    for problem in records.problems() {
        console.warning(format_args!("{problem}: frames that are recorded there are converted again"));
    }
    Ok(records)
}

/// The options allowed with `--particles-only`.
const ALLOWED_WITH_PARTICLES_ONLY: [&str; 13] = [
    "particles_only",
    "inputs",
    "out",
    "format",
    "frames",
    "columns",
    "where",
    "skip_done",
    "quiet",
    "shard",
    "threads",
    "memory",
    "on_error",
];

const PARTICLES_ONLY: &str = "--particles-only makes no surfaces, so options for surfaces, their files and \
     reports do not apply: only INPUT, --out, --format, --frames, --columns, --where, --skip-done, --quiet, --shard, \
     --threads, --memory and --on-error may be combined with it";

/// Refuses formats that cannot store particles.
fn refuse_surface_formats(outputs: &OutputOptions) -> Result<()> {
    if outputs.formats.iter().any(|format| format.particles().is_none()) {
        let written = OutputFormat::ALL.into_iter().filter(|format| format.particles().is_some());
        let names = listed(written.map(|format| format.to_string()).collect(), "and");
        bail!("--particles-only writes {names}: the other formats store surfaces");
    }
    Ok(())
}

/// What is converted to what, and how: the arguments, resolved against the files that exist.
struct ConvertPlan {
    selection: InputSelection,
    job: Job,
    options: MethodOptions,
    obstacles: Arc<ObstacleFiles>,
    outputs: OutputOptions,
    sequence_files: SequenceOutputs,
    records: Option<Arc<FrameRecords>>,
}

impl ConvertPlan {
    /// Refuses outputs that would replace inputs, obstacles or each other. Inputs that
    /// are not selected are protected, too.
    ///
    /// # Errors
    /// If a file would replace another one; the error names both.
    fn refuse_conflicts(&self, report: Option<&Path>) -> Result<()> {
        let mut others: Vec<(&'static str, &Path)> = Vec::new();
        others.extend(report.map(|path| ("the report", path)));
        others.extend(self.outputs.stage.iter().map(|stage| ("the stage", &*stage.path)));
        others.extend(self.sequence_files.paths().map(|path| ("the sequence file", path)));
        for (what, path) in &others {
            check_output_path(what, path)?;
        }
        if let Some(stage) = &self.outputs.stage {
            // Otherwise it would be refused after all frames are converted.
            stage_frame_count(&stage.path).map_err(|why| anyhow!("{}: {why}", stage.path.display()))?;
        }
        let files = selected_files(&self.selection.sequences);
        let planned: Vec<_> = files.map(|file| (file.path.clone(), file.stem())).collect();
        Ok(check_outputs(&planned, &self.selection.found, &self.obstacles, &self.outputs, &others)?)
    }

    /// Says that results of other particles of the same frames are replaced: they were made with another condition.
    fn warn_of_other_particles(&self, console: &Console) {
        let Some(records) = &self.records else { return };
        let names: HashSet<PathBuf> =
            selected_files(&self.selection.sequences).map(|file| file.stem().into()).collect();
        let chosen = self.options.r#where.as_ref().map(ToString::to_string);
        let other = records.of_other_particles(|record| names.contains(&record.name), chosen.as_ref());
        if let Some((name, made)) = other {
            console.warning(format_args!(
                "{} was made {made}, and its results of the same formats are replaced: to keep both, choose another \
                 folder, or names such as --out 'out/other.####.glb'",
                name.display()
            ));
        }
    }

    /// Warns if particles with velocities move as at another frame rate than that of the stage or the sequence files.
    fn warn_of_frame_rate(&self, sequence: &Sequence, settings: &Settings, console: &Console) {
        let is_played = self.outputs.stage.is_some() || self.sequence_files.paths().next().is_some();
        let middle = sequence.frames.len() / 2;
        let frames =
            sequence.frames.get(middle.saturating_sub(1)..).and_then(|frames| frames.first_chunk::<3>());
        let attributes = settings.attributes.as_ref();
        let has_velocities = attributes == Some(&AttributeSelection::All) || names_velocity(attributes);
        let Some(frames) = frames.filter(|_| is_played && has_velocities) else { return };
        let [Some(before), Some(own), Some(after)] = frames.each_ref().map(FrameFile::number) else { return };
        let Some(step) =
            own.checked_sub(before).filter(|step| *step > 0 && own.checked_add(*step) == Some(after))
        else {
            return;
        };
        // Frames that cannot be read fail later.
        let paths = frames.each_ref().map(|frame| &*frame.path);
        let measured = seconds_by_motion(paths, settings).ok().flatten().or(settings.time_step);
        let fps = self.sequence_files.fps();
        // A .glb shows frame after frame, whatever their numbers.
        let is_timed = self.outputs.stage.is_some() || !self.sequence_files.are_glb();
        let step = if is_timed { step as f64 } else { 1.0 };
        let Some(seconds) = measured.filter(|seconds| !is_same_time(*seconds, step / fps)) else {
            return;
        };
        let motion = significant(step / seconds);
        console.warning(format_args!(
            "{}: the particles move as at {motion} frames per second, and they are shown at {fps}: give --fps {motion}, or \
             --velocity-scale {} if the velocities of the files have another unit of time",
            sequence.name,
            significant(settings.velocity_scale * seconds * fps / step)
        ));
    }

    /// Converts the frames, and combines them into sequence files.
    fn run(&self, mut batch: Batch, folder: OutFolder, console: &mut Console) -> Result<CommandOutcome> {
        for selected in &self.selection.sequences {
            self.add_to_batch(&mut batch, selected, console)?;
        }
        if self.options.temporal.is_some_and(|reach| reach > 0) && batch.lacks_frames_around() {
            console.warning(format_args!(
                "--temporal has no effect: no frame has the number before or after that of another one"
            ));
        } else if !self.options.frame_reach().is_none() && batch.lacks_frames_around() {
            console.warning(format_args!(
                "{} uses each frame alone: no frame has the number before or after that of another one; name the whole \
                 sequence, and choose frames with --frames",
                match &self.options {
                    MethodOptions { rest: Some(_), .. } => "--rest",
                    MethodOptions { spray: Some(1..), .. } => "--spray",
                    _ => "--time-step",
                }
            ));
        }
        if let Some(records) = &self.records {
            records.prepare().with_context(|| {
                let folder = records.folder().join(STATE_FOLDER);
                format!("{}: finished frames are recorded in this folder: make it writable", folder.display())
            })?;
        }
        self.warn_of_other_particles(console);
        folder.keep();
        let mut stage = UsdStageWriter::new(&self.outputs, || {
            let InputSelection { sequences, unselected, .. } = &self.selection;
            let all = sequences.iter().map(|selected| &selected.sequence).chain(unselected);
            all.map(|sequence| stage_sequence(sequence, &self.outputs)).collect()
        });
        batch.run_pipeline(stage.as_mut(), console);
        let (frames, frame_count) = (batch.sequence_frames().to_vec(), batch.frame_count());
        let pool = Arc::clone(&batch.pool);
        let mut outcome = batch.finish(console);
        if let Some(stage) = stage {
            outcome = stage.finish(outcome, console);
        }
        Ok(pool.install(|| self.sequence_files.write(&frames, frame_count, outcome, console)))
    }

    /// Adds the frames of a sequence to a batch, with the settings that they share.
    ///
    /// # Errors
    /// If the options are invalid for every frame. A sequence whose spacing or camera cannot be determined is not
    /// an error: its frames are reported as failed.
    fn add_to_batch(
        &self,
        batch: &mut Batch,
        selected: &SelectedSequence,
        console: &mut Console,
    ) -> Result<()> {
        let SelectedSequence { sequence, selected } = selected;
        let mut measured = None;
        let settings = match self.job {
            Job::Surface => {
                let spacing = batch.pool.install(|| measure_if_needed(sequence, &self.options, console));
                measured = match spacing {
                    Ok(measured) => measured,
                    Err(error) => {
                        batch.add_impossible(&sequence.name, selected, &error.to_string());
                        return Ok(());
                    }
                };
                let settings = settings_of(sequence, &self.options, measured.as_ref())?;
                report_settings(
                    sequence,
                    selected.len(),
                    &self.options,
                    &settings,
                    measured.as_ref(),
                    console,
                );
                if measured.is_some() {
                    warn_of_siblings(sequence, &self.options, console);
                }
                warn_of(sequence, &settings, console);
                self.warn_of_frame_rate(sequence, &settings, console);
                settings
            }
            Job::LevelSet { .. } => Settings::for_level_sets(&self.options)?,
            Job::Particles => {
                // Of these settings only what is read is used.
                let (columns, r#where) = (self.options.columns.clone(), self.options.r#where.clone());
                Settings::for_level_sets(&MethodOptions { columns, r#where, ..MethodOptions::default() })?
            }
        };
        let outputs = match batch.pool.install(|| outputs_of(sequence, &settings, &self.outputs)) {
            Ok(outputs) => Arc::new(outputs),
            Err(error) => {
                batch.add_impossible(&sequence.name, selected, &error.to_string());
                return Ok(());
            }
        };
        let files = (&*outputs, &*self.obstacles);
        let of = (&self.options, measured.as_ref());
        let record = SequenceRecord::new(&sequence.name, &self.job, &settings, of, files);
        let settings = Arc::new(settings);
        let numbered = NumberedFrames::of_files(&sequence.frames);
        note_gaps(&sequence.name, &numbered, selected, settings.temporal, console);
        warn_of_history(&sequence.name, &numbered, selected, &settings, console);
        let frames = selected.iter().map(|file| Frame {
            job: self.job,
            around: numbered.frames_around(file.number(), settings.frame_reach()),
            obstacles: Arc::clone(&self.obstacles),
            records: self.records.clone(),
            ..Frame::new(file, &settings, &outputs)
        });
        batch.add(&sequence.name, record, frames);
        Ok(())
    }
}

/// Warns if particles cannot be followed back in a sequence.
fn warn_of_history(
    name: &str,
    numbered: &NumberedFrames<PathBuf>,
    selected: &[FrameFile],
    settings: &Settings,
    console: &Console,
) {
    if !settings.frame_reach().has_history() {
        return;
    }
    let numbers = || selected.iter().filter_map(FrameFile::number);
    let shared = numbers().filter(|number| numbered.only(*number).is_none()).count();
    if shared > 0 {
        console.warning(format_args!(
            "{name}: {} a number that others have, too, such as subframes: particles are not followed back from them; \
             convert frames with whole numbers only",
            if shared == 1 { "1 frame has".to_owned() } else { format!("{shared} frames have") }
        ));
    }
    if let Some(rest) = settings.rest
        && numbers().all(|number| number < i64::from(rest.first))
        && numbers().next().is_some()
    {
        console.warning(format_args!(
            "{name}: --rest {} has no effect: all frames have lower numbers, and the rest coordinates are their own positions",
            rest.first
        ));
    }
}

/// Says how many selected frames are averaged with fewer frames because of gaps in the numbers.
fn note_gaps(
    name: &str,
    numbered: &NumberedFrames<PathBuf>,
    selected: &[FrameFile],
    reach: u32,
    console: &mut Console,
) {
    let numbers = selected.iter().filter_map(FrameFile::number);
    let count = numbers.filter(|number| numbered.is_beside_gap(*number, reach)).count();
    if let Some(step) = numbered.step().filter(|_| reach > 0 && count > 0) {
        console.print_line(format_args!(
            "note: {name}: --temporal averages {} with fewer others, because a number is missing or occurs twice: \
             most frames are {step} apart, and so must be those that are averaged",
            pluralize(count, "frame")
        ));
    }
}

/// All frames of a sequence, selected or not.
fn stage_sequence(sequence: &Sequence, outputs: &OutputOptions) -> UsdStageSequence {
    let frame = |file: &FrameFile| UsdStageFrame::new(outputs, &file.stem(), file.number());
    let name = sequence.frames.first().map_or(String::new(), |file| output_sequence(&file.sequence().1));
    UsdStageSequence { name, frames: sequence.frames.iter().map(frame).collect() }
}

// `convert --shard`: a part of the frames, so that several machines can share the work.

/// The error of a folder that all shards see, but not this machine.
fn not_mounted(folder: &Path, what: &str) -> anyhow::Error {
    let error = format!("{}: {what}", folder.display());
    io::Error::new(io::ErrorKind::NotConnected, error).into()
}

/// Refuses inputs that are missing or empty folders, or whose folder does not exist: other shards see them.
fn check_mounted(inputs: &[PathBuf]) -> Result<()> {
    let is_empty = |folder: &PathBuf| folder.read_dir().is_ok_and(|mut entries| entries.next().is_none());
    // A missing name with an extension is that of a file, which no other run finds either.
    let is_absent = |input: &&PathBuf| {
        let file = step_of(input).map_or(input.as_path(), |(file, _)| file);
        let is_missing = !file.exists() && file.extension().is_none();
        !is_pattern(input) && (is_missing || is_empty(input))
    };
    if let Some(input) = inputs.iter().find(is_absent) {
        return Err(not_mounted(input, "it is missing or empty: is it mounted?"));
    }
    let folders = inputs.iter().filter_map(|input| input.parent());
    let is_missing =
        |folder: &&Path| !folder.as_os_str().is_empty() && !is_pattern(folder) && !folder.exists();
    match folders.into_iter().find(is_missing) {
        Some(folder) => Err(not_mounted(folder, "there is no such folder: is it mounted?")),
        None => Ok(()),
    }
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
    if !destination.is_folder() {
        bail!("--shard writes into a folder that all shards share: name a folder with --out");
    }
    if !outputs.folder.is_dir() {
        let what =
            "the folder of the results does not exist: is it mounted? Create it before the shards start";
        return Err(not_mounted(&outputs.folder, what));
    }
    if !args.sequence.is_empty() {
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
            "--shard slurm: the array {min}-{max}:{step} has gaps, so some shards would never run: submit the \
             whole array; finished frames are skipped"
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
