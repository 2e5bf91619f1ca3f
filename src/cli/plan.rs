//! `meniscus plan`: determines settings and shards once, for all machines that convert a sequence.

use std::iter;
use std::path::{Path, PathBuf, absolute};

use anyhow::{Context, Result, anyhow, bail};

use crate::farm::{PlannedFrame, PlannedSequence, ShardPlan, partition};
use crate::pipeline::{FrameFile, are_same_file, file_of, size_bytes};

use super::CommandOutcome;
use super::args::PlanArgs;
use super::console::Console;
use super::conversion::{Conversion, Resolved, warn_before};
use super::destination::refuse_file_name;
use super::frame_selection::gaps;
use super::level_sets::surface_job;
use super::machine::thread_pool;
use super::select::select_frames;
use super::wording::{counted_are, pluralize};

/// Writes the plan.
///
/// # Errors
/// If the settings of a sequence cannot be determined, results would replace inputs, or the file cannot be
/// written.
pub(super) fn plan(args: &PlanArgs, console: &mut Console) -> Result<CommandOutcome> {
    refuse_file_name(&args.out)?;
    let mut outputs = args.formats.outputs(absolute_path(&args.out)?)?;
    args.formats.refuse_idle_fps()?;
    if let Some(stage) = &mut outputs.stage {
        stage.path = stage_among(&outputs.folder, &stage.path)?;
    }
    let selection = select_frames(&args.inputs, args.frames.as_ref(), &args.method, console)?;
    let job = surface_job(&selection, args.max_deviation, &args.method)?;
    if !selection.is_complete {
        bail!(
            "no plan is written, because it would lack frames: make the paths above readable, then plan again"
        );
    }
    warn_before(&args.method, &args.formats, console);
    let conversion = Conversion::new(selection, job, &args.method, outputs)?;
    let stage = conversion.outputs.stage.iter().map(|stage| ("the stage", &*stage.path));
    let written: Vec<(&'static str, &Path)> = iter::once(("the plan", &*args.output)).chain(stage).collect();
    conversion.refuse_conflicts(&written)?;

    let pool = thread_pool(None)?;
    let mut plan = ShardPlan {
        sequences: Vec::new(),
        frames: Vec::new(),
        shards: Vec::new(),
        obstacles: args.method.obstacle.iter().map(|path| absolute_path(path)).collect::<Result<_>>()?,
    };
    for selected in &conversion.sequences {
        let name = &selected.sequence.name;
        let resolved = conversion.resolve(selected, &pool, console)?;
        let Resolved { settings, measured, outputs } = resolved.map_err(|why| anyhow!("{name}: {why}"))?;
        let measured = measured.map(|mut measured| {
            measured.measured_on = absolute_path(&measured.measured_on)?;
            Ok::<_, anyhow::Error>(measured)
        });
        let sequence = plan.sequences.len();
        // Report missing frame numbers, unless the user selected numbers.
        if let Some((gaps, count)) = gaps(selected.selected.iter().filter_map(FrameFile::number))
            && args.frames.is_none()
        {
            console.warning(format_args!("{name}: {gaps}: {} missing", counted_are(count)));
        }
        for file in &selected.selected {
            plan.frames.push(planned(file, sequence)?);
        }
        plan.sequences.push(PlannedSequence {
            name: name.clone(),
            job,
            settings,
            measured: measured.transpose()?,
            outputs,
        });
    }
    plan.shards = partition(plan.frames.len(), args.shards);
    plan.write(&args.output).with_context(|| args.output.display().to_string())?;
    // The folder is kept, and shards do not create it: a shard that does not find it runs on a machine where
    // the file system is not mounted.
    conversion.folder.keep();
    print_summary(&plan, args, console);
    Ok(CommandOutcome::Done)
}

/// The path of a stage in the folder of the results. A plan can name no file elsewhere.
fn stage_among(folder: &Path, stage: &Path) -> Result<PathBuf> {
    let path = absolute_path(stage)?;
    match (path.parent(), path.file_name()) {
        (Some(parent), Some(name)) if parent == folder || are_same_file(parent, folder) => {
            Ok(folder.join(name))
        }
        _ => bail!(
            "--stage {}: shards write the stage beside their results: name it {}",
            stage.display(),
            folder.join(stage.file_name().unwrap_or_default()).display()
        ),
    }
}

fn planned(file: &FrameFile, sequence: usize) -> Result<PlannedFrame> {
    let name = || file.path.display().to_string();
    // A pipe can be read only once, and a shard may run again.
    if !file_of(&file.path).metadata().with_context(name)?.is_file() {
        bail!("{}: not a regular file, so it cannot be part of a plan", name());
    }
    let stem = file.stem();
    if stem.len() > STEM_BYTES {
        bail!(
            "{}: the name has {} bytes without its extension, more than the limit of {STEM_BYTES} bytes, \
             because the names of the results are longer: rename the file",
            name(),
            stem.len()
        );
    }
    Ok(PlannedFrame {
        input: absolute_path(&file.path)?,
        stem,
        number: file.number(),
        size_bytes: size_bytes(&file.path).with_context(name)?,
        sequence,
    })
}

/// The maximum length of a stem, in bytes. Common file systems limit names to 255 bytes, and
/// `.certificate.json` and the additions of a temporary name must fit as well.
const STEM_BYTES: usize = 200;

/// The absolute path.
fn absolute_path(path: &Path) -> Result<PathBuf> {
    absolute(path).with_context(|| format!("`{}` is not a valid path", path.display()))
}

fn print_summary(plan: &ShardPlan, args: &PlanArgs, console: &mut Console) {
    let (frames, shards) = (pluralize(plan.frames.len(), "frame"), pluralize(plan.shards.len(), "shard"));
    let most = plan.shards.iter().map(ExactSizeIterator::len).max().unwrap_or(0);
    let empty_count = plan.shards.iter().filter(|shard| shard.is_empty()).count();
    console
        .print_line(format_args!("{}: {frames} in {shards}, {most} at most in each", args.output.display()));
    if empty_count > 0 {
        let empty = pluralize(empty_count, "shard");
        console.warning(format_args!("{empty} without frames: there are more shards than frames"));
    }
}
