//! `meniscus status`: prints which frames a daemon has finished, queued and failed, with reasons.
//!
//! It reads the records, and checks the lock to see whether a daemon is running: the last record of a killed
//! daemon still says "running".
//!
//! The structs here define the JSON; the text shows the same values.

mod frame;
mod lines;

use std::collections::HashSet;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use serde::{Serialize, Serializer};

use crate::pipeline::{
    DaemonState, FileStamp, FrameRecords, LatestRecords, MeasuredSpacing, RecordedFrame, STATE_FOLDER,
    UnfinishedRecord, UnfinishedState, file_of, is_absent, is_missing_step, natural_order, now_ms,
};
use crate::watch::Watch;
use crate::watch::lock::{LockError, OutputLock};

use super::CommandOutcome;
use super::args::{StatusArgs, WatchArgs};
use super::console::Console;
use super::watch::make_plan;
use super::wording::with_causes;

/// The status of a folder of outputs.
#[derive(Debug, PartialEq, Serialize)]
struct StatusRecord {
    output: String,
    /// Null if no daemon is known.
    daemon: Option<DaemonStatus>,
    counts: StatusCounts,
    /// The particle spacings that were measured, by the names of their sequences.
    spacings: Vec<SpacingStatus>,
    /// In natural order.
    failed: Vec<FrameStatus>,
    /// In natural order.
    retrying: Vec<FrameStatus>,
    /// Files that were not yet complete when the daemon inspected them last, in natural order.
    waiting: Vec<FrameStatus>,
    /// The most recently finished frames, the newest first.
    last_done: Vec<FrameStatus>,
    /// Finished frames with defects, in natural order.
    flawed: Vec<FrameStatus>,
}

#[derive(Debug, PartialEq, Serialize)]
struct SpacingStatus {
    sequence: String,
    /// World units.
    spacing: f64,
    /// The number of measured frames.
    measured_on: usize,
}

#[derive(Debug, PartialEq, Serialize)]
struct DaemonStatus {
    /// Null if the file system has no locks.
    running: Option<bool>,
    /// A description of the process that holds the lock.
    held_by: Option<String>,
    state: &'static str,
    paused_because: Option<String>,
    /// This field and the following ones are recorded, and describe the daemon that wrote last.
    pid: Option<u32>,
    host: Option<String>,
    started_ms: Option<u64>,
    /// When it entered this state.
    at_ms: Option<u64>,
}

#[derive(Debug, Default, PartialEq, Serialize)]
struct StatusCounts {
    done: usize,
    queued: usize,
    retrying: usize,
    waiting: usize,
    failed: usize,
}

#[derive(Clone, Debug, PartialEq, Serialize)]
struct FrameStatus {
    input: String,
    /// `None` if it is done.
    #[serde(serialize_with = "write_state")]
    state: Option<UnfinishedState>,
    outputs: Vec<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    reason: Option<String>,
    attempts: u32,
    #[serde(skip_serializing_if = "Option::is_none")]
    particles: Option<usize>,
    #[serde(skip_serializing_if = "Option::is_none")]
    seconds: Option<f64>,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    flaws: Vec<String>,
    /// The id of its settings.
    settings: String,
    at_ms: u64,
    /// When the daemon tries the failed frame again; `None` if that is not stated.
    #[serde(skip)]
    next_try: Option<&'static str>,
}

fn write_state<S: Serializer>(state: &Option<UnfinishedState>, to: S) -> Result<S::Ok, S::Error> {
    match state {
        Some(state) => state.serialize(to),
        None => to.serialize_str("done"),
    }
}

/// A path as text for JSON, which needs Unicode.
fn shown(path: &Path) -> String {
    path.to_string_lossy().into_owned()
}

/// Maximum number of finished frames listed: enough to show progress and speed.
const LAST_DONE_COUNT: usize = 5;

/// Prints the status of the daemon of a folder, or of all folders of a configuration file; or of one frame.
///
/// # Errors
/// If nothing is recorded in the folder, or the records or the file cannot be read.
pub(super) fn status(args: &StatusArgs, console: &mut Console) -> Result<CommandOutcome> {
    let folders = match &args.config {
        Some(config) => folders_of(config)?,
        None => args.out.iter().cloned().collect(),
    };
    if let Some(frame) = &args.frame {
        return frame::print(frame, &folders, args.json, console);
    }
    let (mut records, mut new_count) = (Vec::new(), 0);
    for folder in &folders {
        match status_of(folder, console) {
            Ok(Some(record)) => records.push(record),
            // A valid configuration need not have run yet.
            Ok(None) => match &args.config {
                Some(config) => {
                    let (config, folder) = (config.display(), folder.display());
                    console.warn(format_args!("{config}: valid; nothing is recorded yet in {folder}"));
                    new_count += 1;
                }
                None => bail!("{}: nothing is recorded here: check --out", folder.display()),
            },
            Err(error) if folders.len() > 1 => console.error(with_causes(&error)),
            Err(error) => return Err(error),
        }
    }
    match &records[..] {
        [] if new_count < folders.len() => return Ok(CommandOutcome::NothingDone),
        [record] if args.json && args.config.is_none() => console.print_json(record)?,
        records if args.json => console.print_json(&records)?,
        records => {
            for (index, record) in records.iter().enumerate() {
                if index > 0 {
                    console.print_line("");
                }
                console.print_lines(record.lines(now_ms()));
            }
        }
    }
    let is_fine =
        records.len() + new_count == folders.len() && records.iter().all(|record| record.failed.is_empty());
    Ok(if is_fine { CommandOutcome::Done } else { CommandOutcome::SomeFailed })
}

/// The output folders of a configuration file.
fn folders_of(config: &Path) -> Result<Vec<PathBuf>> {
    let watch_args = WatchArgs { config: Some(config.to_owned()), ..WatchArgs::default() };
    let mut folders: Vec<PathBuf> = Vec::new();
    for Watch { outputs, .. } in make_plan(&watch_args)?.config.watches {
        if !folders.contains(&outputs.folder) {
            folders.push(outputs.folder);
        }
    }
    Ok(folders)
}

/// The status of a folder; `None` if nothing is recorded there.
fn status_of(output: &Path, console: &mut Console) -> Result<Option<StatusRecord>> {
    let state = recorded(output, console)?;
    let holder = Holder::of(output)?;
    if state == LatestRecords::default() && !matches!(holder, Holder::Daemon(_)) {
        return Ok(None);
    }
    Ok(Some(StatusRecord::new(output, &state, holder)))
}

/// Reads the records of an output folder.
///
/// # Errors
/// If they cannot be read.
fn recorded(output: &Path, console: &mut Console) -> Result<LatestRecords> {
    let folder = output.join(STATE_FOLDER);
    let records = FrameRecords::open(output)
        .with_context(|| format!("{}: cannot read the records", folder.display()))?;
    for problem in records.problems() {
        console.warning(format_args!("{problem}: what is recorded there is left out"));
    }
    Ok(records.latest())
}

/// Which process holds the lock of an output folder.
#[derive(Debug)]
enum Holder {
    Daemon(String),
    Unlocked,
    /// The file system has no locks.
    Unknown,
}

impl Holder {
    /// Determines the holder of this folder.
    ///
    /// # Errors
    /// If the system reports an error.
    fn of(output: &Path) -> Result<Holder> {
        match OutputLock::holder(output) {
            Ok(Some(by)) => Ok(Holder::Daemon(by)),
            Ok(None) => Ok(Holder::Unlocked),
            Err(LockError::Unsupported { .. }) => Ok(Holder::Unknown),
            Err(error) => Err(error.into()),
        }
    }
}

impl StatusRecord {
    fn new(output: &Path, state: &LatestRecords, holder: Holder) -> StatusRecord {
        let folder = dunce::canonicalize(output).unwrap_or_else(|_| output.to_owned());
        let has_daemon = matches!(holder, Holder::Daemon(_));
        let files = Files::new(state, has_daemon);
        let mut recorded: Vec<(&PathBuf, &RecordedFrame)> =
            state.frames.iter().filter(|(_, frame)| !files.are_without(frame)).collect();
        recorded.sort_by(|(a, _), (b, _)| natural_order(&a.to_string_lossy(), &b.to_string_lossy()));
        let daemon = DaemonStatus::new(state, holder);
        let is_running = daemon.as_ref().is_some_and(DaemonStatus::is_running);
        let mut status = StatusRecord {
            output: shown(output),
            daemon,
            counts: StatusCounts::default(),
            spacings: SpacingStatus::all(state),
            failed: Vec::new(),
            retrying: Vec::new(),
            waiting: Vec::new(),
            last_done: Vec::new(),
            flawed: Vec::new(),
        };
        let [mut refused, mut awaiting_restart, mut done] = [const { Vec::new() }; 3];
        for (input, frame) in recorded {
            let frame = FrameStatus::new(input, frame, &folder, is_running);
            match frame.state {
                None => done.push(frame),
                Some(UnfinishedState::Waiting) => status.waiting.push(frame),
                Some(UnfinishedState::Queued) => status.counts.queued += 1,
                Some(UnfinishedState::Retrying) => status.retrying.push(frame),
                Some(UnfinishedState::Failed) => status.failed.push(frame),
                Some(UnfinishedState::Refused) => refused.push(frame),
                Some(UnfinishedState::AwaitsRestart) => awaiting_restart.push(frame),
                Some(UnfinishedState::Ignored) => {}
            }
        }
        status.failed.extend(refused.into_iter().chain(awaiting_restart));
        status.counts = StatusCounts {
            done: done.len(),
            queued: status.counts.queued,
            retrying: status.retrying.len(),
            waiting: status.waiting.len(),
            failed: status.failed.len(),
        };
        status.flawed = done.iter().filter(|frame| !frame.flaws.is_empty()).cloned().collect();
        // A stable sort: of equally new frames, the last in natural order comes first.
        done.reverse();
        done.sort_by_key(|frame| std::cmp::Reverse(frame.at_ms));
        done.truncate(LAST_DONE_COUNT);
        status.last_done = done;
        status
    }
}

impl SpacingStatus {
    /// The spacings in the order of the names, each once: they do not depend on most options.
    fn all(state: &LatestRecords) -> Vec<SpacingStatus> {
        let measured = state.sequences.iter().filter_map(|(key, shared)| {
            let MeasuredSpacing { spacing, measured_count, .. } = *shared.measured.as_ref()?;
            Some(SpacingStatus { sequence: key.name.clone(), spacing, measured_on: measured_count })
        });
        let mut all: Vec<SpacingStatus> = measured.collect();
        all.sort_by(|one, other| {
            one.sequence.cmp(&other.sequence).then(one.spacing.total_cmp(&other.spacing))
        });
        all.dedup();
        all
    }
}

/// The input files of recorded frames.
struct Files<'a> {
    /// The path of each file, and its stamp when it was read, without the status change time (ctime).
    recorded: HashSet<(&'a Path, FileStamp)>,
    has_daemon: bool,
}

impl<'a> Files<'a> {
    fn new(state: &'a LatestRecords, has_daemon: bool) -> Files<'a> {
        let mut recorded = HashSet::new();
        for (input, RecordedFrame { done, unfinished }) in &state.frames {
            let stamps =
                done.iter().map(|done| done.stamp).chain(unfinished.iter().map(|record| record.stamp));
            recorded.extend(stamps.map(|stamp| (file_of(input), stamp.without_status_change())));
        }
        Files { recorded, has_daemon }
    }

    /// Whether the frame can never be converted: its file was removed from its folder, or rewritten without
    /// the frame's step.
    fn are_without(&self, frame: &RecordedFrame) -> bool {
        let Some(record) = &frame.unfinished else { return false };
        let file = file_of(&record.input);
        match FileStamp::of_path(file) {
            Ok(stamp) if file == record.input || record.stamp.still_holds(&stamp) => false,
            Ok(stamp) => {
                !self.may_be_growing(file, stamp, record) && is_missing_step(&record.input).unwrap_or(false)
            }
            // A missing folder may come back with all its files.
            Err(error) => is_absent(file, &error) && file.parent().is_some_and(Path::exists),
        }
    }

    /// Whether a file has grown since a running daemon last read it: a simulation may be appending to it. The
    /// recorded steps are then still in the file, and a check of this would take minutes at each call of
    /// `status`.
    fn may_be_growing(&self, file: &Path, stamp: FileStamp, record: &UnfinishedRecord) -> bool {
        self.has_daemon
            && stamp.size > record.stamp.size
            && !self.recorded.contains(&(file, stamp.without_status_change()))
    }
}

impl DaemonStatus {
    fn new(state: &LatestRecords, holder: Holder) -> Option<DaemonStatus> {
        let record = state.daemon.as_ref();
        let (running, held_by) = match holder {
            Holder::Daemon(by) => (Some(true), Some(by)),
            Holder::Unlocked => (Some(false), None),
            Holder::Unknown => (None, None),
        };
        if record.is_none() && held_by.is_none() {
            return None;
        }
        let (state, paused_because) = match (record.map(|record| &record.state), running) {
            (None | Some(DaemonState::Stopped), Some(true)) => ("starting", None),
            (Some(DaemonState::Stopped) | None, _) => ("stopped", None),
            // It is recorded as running or paused, but no process holds the lock: the daemon was killed before it
            // could record its end.
            (Some(_), Some(false)) => ("killed", None),
            (Some(DaemonState::Running), _) => ("running", None),
            (Some(DaemonState::Paused(why)), _) => ("paused", Some(why.clone())),
        };
        Some(DaemonStatus {
            running,
            held_by,
            state,
            paused_because,
            pid: record.map(|record| record.pid),
            host: record.map(|record| record.host.clone()),
            started_ms: record.map(|record| record.started_ms),
            at_ms: record.map(|record| record.at_ms),
        })
    }
}

impl FrameStatus {
    /// `folder`: the absolute path of the folder of the outputs.
    fn new(input: &Path, frame: &RecordedFrame, folder: &Path, is_running: bool) -> FrameStatus {
        let empty = FrameStatus {
            input: shown(input),
            state: None,
            outputs: Vec::new(),
            reason: None,
            attempts: 0,
            particles: None,
            seconds: None,
            flaws: Vec::new(),
            settings: String::new(),
            at_ms: frame.at_ms(),
            next_try: None,
        };
        if let Some(record) = &frame.unfinished {
            return FrameStatus {
                state: Some(record.state),
                reason: record.reason.as_ref().map(ToString::to_string),
                attempts: record.attempts,
                settings: record.settings.clone(),
                next_try: match record.state {
                    UnfinishedState::Refused if is_running => {
                        Some("when the conflict is gone: checked at each scan")
                    }
                    UnfinishedState::Refused => Some("when the conflict is gone and a daemon runs"),
                    UnfinishedState::AwaitsRestart => Some("when the file changes or the daemon restarts"),
                    _ => None,
                },
                ..empty
            };
        }
        let Some(record) = &frame.done else { return empty };
        FrameStatus {
            outputs: record.output_paths(folder).map(|path| shown(&path)).collect(),
            attempts: 1,
            particles: record.figures.particles,
            seconds: Some(record.figures.total_seconds()),
            flaws: record.flaws.clone(),
            settings: record.settings.clone(),
            ..empty
        }
    }
}

#[cfg(test)]
mod tests;
