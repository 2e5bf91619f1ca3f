//! `meniscus verify`: checks the results of a plan.

use std::path::{Path, absolute};
use std::time::Instant;

use anyhow::{Context, Result, bail};

use crate::farm::{
    FrameCheck, PlanVerification, PlannedFrame, ShardPlan, VerificationReport, verify as verify_plan,
};
use crate::pipeline::{InspectedState, StageFrame, are_same_file, stage_frame_count};

use super::CommandOutcome;
use super::args::VerifyArgs;
use super::console::Console;
use super::machine::thread_pool;
use super::select::refuse_report_of_plan;
use super::wording::pluralize;

/// Checks the outputs of a plan.
///
/// # Errors
/// If nothing can be checked.
pub(super) fn verify(args: &VerifyArgs, console: &mut Console) -> Result<CommandOutcome> {
    let start = Instant::now();
    let folder =
        absolute(&args.folder).with_context(|| format!("`{}` is not a valid path", args.folder.display()))?;
    if !folder.is_dir() {
        bail!("{}: folder not found", args.folder.display());
    }
    // `folder/.` can be resolved only with the permission to search the folder, and reading the files in it
    // requires no other permission of the folder.
    folder
        .join(".")
        .metadata()
        .with_context(|| format!("{}: cannot read this folder", args.folder.display()))?;
    let plan = ShardPlan::read(&args.plan).with_context(|| args.plan.display().to_string())?;
    let planned = plan.out().filter(|planned| !are_same_file(planned, &folder)).map(Path::to_owned);
    let plan = plan.with_out(&folder);
    refuse_report_of_plan(args.report.as_deref(), &plan, &args.plan)?;
    let verdicts = thread_pool(args.threads)?.install(|| verify_plan(&plan));
    let frames: Vec<(&PlannedFrame, &FrameCheck)> = plan.frames.iter().zip(&verdicts.frames).collect();
    for shard in frames.chunk_by(|(_, one), (_, other)| one.shard == other.shard) {
        for line in describe_shard(shard) {
            console.warn(line);
        }
    }
    summarize(&verdicts, start.elapsed().as_secs_f64(), console);
    if let Some(stage) = plan.stage() {
        let done = frames.iter().filter(|(_, verdict)| verdict.state == InspectedState::Done);
        let is_playable = |(planned, _): &&(&PlannedFrame, &FrameCheck)| {
            let outputs = &plan.sequences[planned.sequence].outputs;
            StageFrame::new(outputs, &planned.stem, planned.number).is_playable()
        };
        let playable = done.filter(is_playable).count();
        let path = stage.display();
        let left_out = verdicts.done_count() - playable;
        if left_out > 0 {
            let left_out = pluralize(left_out, "finished frame");
            console.warning(format_args!(
                "{path}: the stage cannot have {left_out}, because USD cannot write their names or numbers: rename them"
            ));
        }
        match stage_frame_count(stage) {
            Ok(listed) if listed.unwrap_or(0) < playable => console.warning(format_args!(
                "{path}: the stage has {} of {}: run any shard again, which updates it",
                listed.unwrap_or(0),
                pluralize(playable, "finished frame")
            )),
            Ok(_) => {}
            Err(why) => console.warning(format_args!("{path}: {why}")),
        }
    }
    if let Some(planned) = planned.filter(|_| !verdicts.shards_to_run().is_empty()) {
        console.warning(format_args!(
            "checked {}, but the plan writes to {planned}: shards that run again will write to {planned}",
            args.folder.display(),
            planned = planned.display()
        ));
    }
    if let Some(path) = &args.report {
        let record = VerificationReport::new(&plan, &verdicts, &args.plan, &folder);
        // If the path is a symbolic link, the report replaces the link's target, not the link.
        let path = path.canonicalize().unwrap_or_else(|_| path.clone());
        record.write(&path).with_context(|| format!("{}: cannot write the report", path.display()))?;
    }
    let done_count = verdicts.done_count();
    Ok(CommandOutcome::of(done_count, verdicts.frames.len() - done_count, false))
}

/// The problems of a shard: a line for each frame, or a single line if the shard has not run.
fn describe_shard(shard: &[(&PlannedFrame, &FrameCheck)]) -> Vec<String> {
    let is_missing = |(_, verdict): &(_, &FrameCheck)| {
        matches!(verdict.state, InspectedState::Missing { are_all: true, .. })
    };
    if let [(first, verdict), .., (last, _)] = shard
        && shard.iter().all(is_missing)
    {
        let (number, count, first, last) = (verdict.shard, shard.len(), &first.stem, &last.stem);
        return vec![format!("shard {number}: missing: all of its {count} frames, {first} to {last}")];
    }
    let line = |(planned, verdict): &(&PlannedFrame, &FrameCheck)| {
        let why = verdict.why()?;
        let state = match verdict.state {
            // This reason begins with the state.
            InspectedState::Uncertified(_) => String::new(),
            _ => format!("{}: ", verdict.status()),
        };
        Some(format!("{} (shard {}): {state}{why}", planned.stem, verdict.shard))
    };
    shard.iter().filter_map(line).collect()
}

fn summarize(verdicts: &PlanVerification, seconds: f64, console: &mut Console) {
    let [(_, done), others @ ..] = verdicts.counts();
    let mut summary = format!("{}: {done} done", pluralize(verdicts.frames.len(), "frame"));
    for (status, count) in others.into_iter().filter(|&(_, count)| count > 0) {
        // The JSON report calls this state `uncertified`.
        let state = if status == "uncertified" { "failed validation" } else { status };
        summary += &format!(", {count} {state}");
    }
    console.print_line(format_args!("{summary}, in {seconds:.2} s"));
    for (gone, what) in [
        (verdicts.input_missing_count(), "a missing input"),
        (verdicts.obstacle_missing_count(), "a missing obstacle"),
    ] {
        if gone > 0 {
            let frames = pluralize(gone, "frame");
            console.warning(format_args!("{frames} with {what}: cannot check whether they are up to date"));
        }
    }
    let shards = verdicts.shards_to_run();
    if !shards.is_empty() {
        let what = if shards.len() == 1 { "shard" } else { "shards" };
        console.print_line(format_args!("run again: {what} {}", in_ranges(&shards)));
    }
}

/// Formats ascending numbers for schedulers: `0-3,7`.
fn in_ranges(numbers: &[usize]) -> String {
    let mut ranges: Vec<(usize, usize)> = Vec::new();
    for &number in numbers {
        match ranges.last_mut() {
            Some((_, last)) if *last + 1 == number => *last = number,
            _ => ranges.push((number, number)),
        }
    }
    let text = |(first, last): (usize, usize)| match first == last {
        true => first.to_string(),
        false => format!("{first}-{last}"),
    };
    ranges.into_iter().map(text).collect::<Vec<_>>().join(",")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn consecutive_numbers_become_ranges() {
        for (numbers, text) in
            [(&[][..], ""), (&[4], "4"), (&[0, 1], "0-1"), (&[0, 1, 2, 7, 9, 10], "0-2,7,9-10")]
        {
            assert_eq!(in_ranges(numbers), text);
        }
    }
}
