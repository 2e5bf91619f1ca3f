//! `convert --shard`: a part of the frames, so that several machines can share the work.

use std::ops::Range;

use anyhow::{Context, Result, bail};

use crate::pipeline::OutputOptions;

use super::args::{ConvertArgs, FrameShard, ShardChoice};
use super::console::Console;
use super::destination::Destination;
use super::select::{InputSelection, selected_files};
use super::wording::pluralize;

/// The shard of `--shard`, if it is given.
///
/// # Errors
/// If the environment does not name one, or the shard does not suit the other options.
pub(super) fn shard_of(
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
    pub(super) fn keep_only(self, selection: &mut InputSelection, console: &mut Console) -> Result<()> {
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
