//! `meniscus why`: explains why a frame was or was not converted.
//!
//! The daemon's settings come from its configuration file, or else from its journal.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result, anyhow, bail};

use crate::pipeline::{SniffedContent, file_of, frames_in, is_missing_step, step_of};
use crate::watch::canonical_path::{below, canonical_path};
use crate::watch::explain::{
    Explanation, FileChange, FileFacts, FrameExplanation as Fate, Question, explain, remembered_fingerprint,
};
use crate::watch::journal::{DaemonState, JournalState, JournaledFrame, JournaledStatus, PlanRecord, now_ms};
use crate::watch::selection::FileFilter;
use crate::watch::{StabilityTimeouts, Watch, WatchConfig};

use super::CommandOutcome;
use super::args::{WatchArgs, WhyArgs};
use super::clock::ago;
use super::console::Console;
use super::status::{Holder, journal_folder, read_journal};
use super::watch::make_plan;

/// Prints every fact on which the decision about a frame depends, and the decision.
///
/// # Errors
/// If there is neither such a file nor a record of it, or something cannot be read.
pub(super) fn why(args: &WhyArgs, console: &mut Console) -> Result<CommandOutcome> {
    let frame = known_frame(&args.file).context("the file has no name")?;
    let requested = match &args.config {
        Some(file) => DaemonSettings::of_file(file, args)?,
        None => DaemonSettings::of_journal(args, &frame)?,
    };
    // Only a configuration file may name several output folders, among which `--out` selects. A journal
    // belongs to one output folder.
    let output = args.out.as_deref().filter(|_| args.config.is_some());
    let watch = requested.watch_of(&frame, output)?;
    let frame = below(&watch.input, &frame).unwrap_or(frame);
    let output = &watch.outputs.folder;
    let journal = journal_folder(output, requested.journal.as_deref());
    let state = match requested.state {
        Some(ref state) => state,
        None => &read_journal(&journal)?,
    };
    let record = state.frames.get(&*frame).map(|record| &**record);
    if let [first, .., last] = &frames_in(&frame).unwrap_or_default()[..] {
        let [first, last] = [first, last].map(|step| step.display());
        console.print_line(format_args!(
            "{} has several frames: give one of them, from {first} to {last}",
            frame.display()
        ));
        return Ok(CommandOutcome::Done);
    }
    let missing = match is_missing_step(&frame) {
        Ok(true) => Some("step"),
        _ => matches!(file_of(&frame).try_exists(), Ok(false)).then_some("file"),
    };
    if let (None, Some(what)) = (record, missing) {
        bail!("{}: no such {what}, and nothing is recorded of it in {}", frame.display(), journal.display());
    }
    let output_folders: Vec<PathBuf> =
        requested.watches.iter().map(|watch| watch.outputs.folder.clone()).collect();
    let is_queued = record.is_some_and(|record| record.status == JournaledStatus::Queued);
    let has_daemon = is_queued
        && match Holder::of(output)? {
            Holder::Daemon(_) => true,
            Holder::Unlocked => false,
            // On a file system without locks, only the journal says whether the daemon has stopped.
            Holder::Unknown => !matches!(
                state.daemon.as_ref().map(|daemon| &daemon.state),
                None | Some(DaemonState::Stopped)
            ),
        };
    let settings = remembered_fingerprint(watch, &frame, state).filter(|_| requested.is_known);
    let explanation = explain(&Question {
        frame: &frame,
        watch,
        output_folders: &output_folders,
        timeouts: &requested.timeouts,
        record,
        settings: settings.as_deref(),
        has_daemon,
    })
    .with_context(|| frame.display().to_string())?;
    console.print_lines(lines(&frame, record, &explanation, requested.is_known, now_ms()));
    if !requested.is_known && !matches!(explanation.verdict, Fate::Found(_)) {
        console.print_line(UNKNOWN);
    }
    let is_to_come = matches!(explanation.verdict, Fate::Waits(_) | Fate::Unblocked | Fate::Converted(_));
    if is_to_come && matches!(Holder::of(output)?, Holder::Unlocked) {
        console.print_line(format_args!(
            "No daemon is running for {}: start one to convert the frame.",
            output.display()
        ));
    }
    Ok(CommandOutcome::Done)
}

/// The path by which the daemon identifies a frame.
fn known_frame(path: &Path) -> std::io::Result<PathBuf> {
    let file = canonical_path(file_of(path))?;
    Ok(match (step_of(path), path.file_name()) {
        (Some(_), Some(step)) => file.join(step),
        _ => file,
    })
}

const UNKNOWN: &str = "The journal does not record the daemon's settings, so this answer assumes the defaults. \
                       To use the daemon's settings, give its file with --config.";

/// The daemon's settings.
struct DaemonSettings {
    watches: Vec<Watch>,
    timeouts: StabilityTimeouts,
    /// The daemon's journal folder; `None` means the default, which is in the output folder.
    journal: Option<PathBuf>,
    /// The journal, if it was read to find the settings.
    state: Option<JournalState>,
    /// Whether the settings are known, and not assumed.
    is_known: bool,
}

impl DaemonSettings {
    /// The settings in a configuration file; the settings in the journal are ignored.
    fn of_file(file: &Path, args: &WhyArgs) -> Result<DaemonSettings> {
        let watch_args = WatchArgs { config: Some(file.to_owned()), ..WatchArgs::default() };
        let WatchConfig { watches, timeouts, journal, .. } = make_plan(&watch_args)?.config;
        let journal = args.journal.clone().or(journal);
        Ok(DaemonSettings { watches, timeouts, journal, state: None, is_known: true })
    }

    /// The settings in the journal, or else the daemon's defaults for the folder of the frame.
    fn of_journal(args: &WhyArgs, frame: &Path) -> Result<DaemonSettings> {
        let output = args.out.as_deref().context("give --out, or --config")?;
        let journal = journal_folder(output, args.journal.as_deref());
        let mut state = read_journal(&journal)?;
        let plan = state.plan.take();
        let is_known = plan.is_some();
        let PlanRecord { watches, timeouts } = match plan {
            Some(plan) => plan,
            None => {
                let inputs = vec![file_of(frame).parent().unwrap_or(frame).to_owned()];
                let watch_args = WatchArgs { inputs, out: Some(output.to_owned()), ..WatchArgs::default() };
                let WatchConfig { watches, timeouts, .. } = make_plan(&watch_args)?.config;
                PlanRecord { watches, timeouts }
            }
        };
        Ok(DaemonSettings { watches, timeouts, journal: Some(journal), state: Some(state), is_known })
    }

    /// The watch that the frame belongs to. Candidates are the watches whose folder contains the frame and,
    /// if `output` is given, that write into `output`. A watch that selects the frame by its name comes
    /// before one that does not; otherwise the watch with the innermost folder comes first.
    fn watch_of(&self, frame: &Path, output: Option<&Path>) -> Result<&Watch> {
        let output = output.map(canonical_path).transpose().context("--out has no name")?;
        let is_meant = |watch: &&Watch| {
            below(&watch.input, frame).is_some()
                && output.as_ref().is_none_or(|out| *out == watch.outputs.folder)
        };
        let takes = |watch: &Watch| {
            let selection = FileFilter::new(watch.pattern.as_deref(), watch.recursive, Vec::new());
            let frame = below(&watch.input, frame).unwrap_or_else(|| frame.to_owned());
            selection.is_ok_and(|selection| selection.takes(&watch.input, file_of(&frame)))
        };
        let around = self.watches.iter().filter(is_meant);
        around
            .max_by_key(|watch| (takes(watch), watch.input.components().count()))
            .ok_or_else(|| anyhow!("{}: not in a folder that is watched for these outputs", frame.display()))
    }
}

/// The explanation as lines of text.
fn lines(
    frame: &Path,
    record: Option<&JournaledFrame>,
    explanation: &Explanation,
    is_known: bool,
    now_ms: u64,
) -> Vec<String> {
    let Explanation { is_selected, file, settings_hold, output_missing, verdict } = explanation;
    let mut lines = vec![frame.display().to_string()];
    let mut line = |name: &str, what: &str| lines.push(format!("  {name:<9} {what}"));
    line("name", if *is_selected { "selected as a frame" } else { "not selected as a frame" });
    if let Some(FileFacts { content, readiness, .. }) = file {
        line(
            "content",
            match content {
                SniffedContent::Particles | SniffedContent::OwnParticles => "a frame",
                SniffedContent::OwnOutput => "made by this program",
                SniffedContent::Neighbor(neighbor) => neighbor.words()[0],
                SniffedContent::NotParticles => "not a frame",
            },
        );
        line("complete", &readiness.to_string());
    }
    match record {
        None => line("journal", "nothing"),
        Some(record) => {
            line("journal", &recorded(record, now_ms));
            record.reason.iter().chain(&record.flaws).for_each(|text| line("", text));
            line(
                "input",
                match file.as_ref().and_then(|file| file.change) {
                    None => "gone",
                    Some(FileChange::Unchanged) => "as recorded",
                    Some(FileChange::Touched) => "touched or moved; its content is as recorded",
                    Some(FileChange::Rewritten) => "not as recorded",
                },
            );
            line(
                "settings",
                match settings_hold {
                    Some(false) if record.status == JournaledStatus::Refused => {
                        "not recorded, because it was not converted"
                    }
                    None if is_known => "not compared, because the particle spacing is not known yet",
                    None => "not compared, because the daemon's settings are unknown: give --config",
                    Some(true) => "as recorded",
                    Some(false) => "not as recorded",
                },
            );
            match output_missing {
                Some(path) => line("outputs", &format!("{} is missing", path.display())),
                None if record.outputs.is_empty() => line("outputs", "none recorded"),
                None => line("outputs", "all recorded outputs exist"),
            }
        }
    }
    lines.push(format!("It {verdict}."));
    lines
}

fn recorded(record: &JournaledFrame, now_ms: u64) -> String {
    let attempts = match record.attempt_count {
        0 | 1 => String::new(),
        count => format!(", {count} attempts"),
    };
    let status = match record.status {
        JournaledStatus::Queued => "queued or in flight",
        JournaledStatus::Done => "done",
        JournaledStatus::Failed => "failed",
        JournaledStatus::Retrying => "failed, will be retried",
        JournaledStatus::Refused => "not converted",
        JournaledStatus::RetriesExhausted => {
            "failed; will be retried when the file changes or the daemon restarts"
        }
    };
    format!("{status}, {}{attempts}", ago(record.at_ms, now_ms))
}
