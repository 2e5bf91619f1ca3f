//! `meniscus status`: prints which frames a daemon has finished, queued and failed, with reasons.
//!
//! It reads the journal, and checks the lock to see whether a daemon is running: the journal of a killed
//! daemon still says "running".
//!
//! The structs here define the JSON; the text shows the same values.

mod frame;
mod lines;

use std::collections::HashSet;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::{Context, Result, bail};
use serde::Serialize;

use crate::pipeline::{FileStamp, file_of, is_absent, is_missing_step, natural_order};
use crate::watch::Watch;
use crate::watch::journal::{
    DaemonState, Journal, JournalState, JournaledFrame, JournaledStatus, STATE_FOLDER, now_ms,
};
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
    damaged_lines: usize,
}

#[derive(Debug, PartialEq, Serialize)]
struct DaemonStatus {
    /// Null if the file system has no locks.
    running: Option<bool>,
    /// A description of the process that holds the lock.
    held_by: Option<String>,
    state: &'static str,
    paused_because: Option<String>,
    /// This field and the following ones are from the journal, and describe the daemon that last wrote it.
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

#[derive(Debug, PartialEq, Serialize)]
struct FrameStatus {
    input: String,
    state: JournaledStatus,
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
    /// The fingerprint of its settings.
    settings: String,
    at_ms: u64,
    /// When the daemon tries the failed frame again although its file has not changed.
    #[serde(skip)]
    retried: Option<&'static str>,
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
/// If no daemon has used the folder, or the journal or the file cannot be read.
pub(super) fn status(args: &StatusArgs, console: &mut Console) -> Result<CommandOutcome> {
    let folders = match &args.config {
        Some(config) => folders_of(config)?,
        None => args.out.iter().cloned().collect(),
    };
    if let Some(frame) = &args.frame {
        return frame::print(frame, &folders, args.json, console);
    }
    let mut records = Vec::new();
    for folder in &folders {
        match status_of(folder) {
            Ok(record) => records.push(record),
            Err(error) if folders.len() > 1 => console.error(with_causes(&error)),
            Err(error) => return Err(error),
        }
    }
    match &records[..] {
        [] => return Ok(CommandOutcome::NothingDone),
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
    let is_fine = records.len() == folders.len() && records.iter().all(|record| record.failed.is_empty());
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

/// The status of the daemon of a folder.
fn status_of(output: &Path) -> Result<StatusRecord> {
    let state = read_journal(output)?;
    let holder = Holder::of(output)?;
    if state == JournalState::default() && !matches!(holder, Holder::Daemon(_)) {
        bail!("{}: no daemon has written here: check --out", output.display());
    }
    Ok(StatusRecord::new(output, &state, holder))
}

/// Reads the journal of an output folder.
///
/// # Errors
/// If it cannot be read.
fn read_journal(output: &Path) -> Result<JournalState> {
    let folder = output.join(STATE_FOLDER);
    Journal::read(&folder).with_context(|| format!("cannot read the journal in {}", folder.display()))
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
    fn new(output: &Path, state: &JournalState, holder: Holder) -> StatusRecord {
        let has_daemon = matches!(holder, Holder::Daemon(_));
        let files = Files::new(state, has_daemon);
        let with_status = |status| {
            let mut frames: Vec<_> = state
                .frames
                .iter()
                .filter(|(input, frame)| frame.status == status && !files.are_without(input, frame))
                .collect();
            frames.sort_by(|(a, _), (b, _)| natural_order(&a.to_string_lossy(), &b.to_string_lossy()));
            frames
        };
        let daemon = DaemonStatus::new(state, holder);
        let is_running = daemon.as_ref().is_some_and(DaemonStatus::is_running);
        let statuses = |frames: &[(&Arc<Path>, &Arc<JournaledFrame>)]| {
            frames.iter().map(|(input, frame)| FrameStatus::new(input, frame, is_running)).collect()
        };
        let retrying = with_status(JournaledStatus::Retrying);
        let waiting = with_status(JournaledStatus::Waiting);
        let mut failed = with_status(JournaledStatus::Failed);
        failed.extend(with_status(JournaledStatus::Refused));
        failed.extend(with_status(JournaledStatus::RetriesExhausted));
        let mut done = with_status(JournaledStatus::Done);
        let counts = StatusCounts {
            done: done.len(),
            queued: with_status(JournaledStatus::Queued).len(),
            retrying: retrying.len(),
            waiting: waiting.len(),
            failed: failed.len(),
        };
        let flawed: Vec<_> = done.iter().copied().filter(|(_, frame)| !frame.flaws.is_empty()).collect();
        // A stable sort: of equally new frames, the last in natural order comes first.
        done.reverse();
        done.sort_by_key(|(_, frame)| std::cmp::Reverse(frame.at_ms));
        done.truncate(LAST_DONE_COUNT);
        StatusRecord {
            output: shown(output),
            daemon,
            counts,
            failed: statuses(&failed),
            retrying: statuses(&retrying),
            waiting: statuses(&waiting),
            last_done: statuses(&done),
            flawed: statuses(&flawed),
            damaged_lines: state.damaged_line_count,
        }
    }
}

/// The input files of the journaled frames.
struct Files<'a> {
    /// The path of each file, and its stamp when the daemon read it, without the status change time (ctime).
    recorded: HashSet<(&'a Path, FileStamp)>,
    has_daemon: bool,
}

impl<'a> Files<'a> {
    fn new(state: &'a JournalState, has_daemon: bool) -> Files<'a> {
        let recorded = state
            .frames
            .iter()
            .map(|(input, frame)| (file_of(input), frame.stamp.without_status_change()))
            .collect();
        Files { recorded, has_daemon }
    }

    /// Whether the frame can never be converted: its file was removed from its folder, or rewritten without
    /// the frame's step.
    fn are_without(&self, input: &Path, frame: &JournaledFrame) -> bool {
        if frame.status == JournaledStatus::Done {
            return false;
        }
        let file = file_of(input);
        match FileStamp::of_path(file) {
            Ok(stamp) if file == input || frame.stamp.still_holds(&stamp) => false,
            Ok(stamp) => !self.may_be_growing(file, stamp, frame) && is_missing_step(input).unwrap_or(false),
            // A missing folder may come back with all its files.
            Err(error) => is_absent(file, &error) && file.parent().is_some_and(Path::exists),
        }
    }

    /// Whether a file has grown since a running daemon last read it: a simulation may be appending to it. The
    /// recorded steps are then still in the file, and a check of this would take minutes at each call of
    /// `status`.
    fn may_be_growing(&self, file: &Path, stamp: FileStamp, frame: &JournaledFrame) -> bool {
        self.has_daemon
            && stamp.size > frame.stamp.size
            && !self.recorded.contains(&(file, stamp.without_status_change()))
    }
}

impl DaemonStatus {
    fn new(state: &JournalState, holder: Holder) -> Option<DaemonStatus> {
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
            // The journal says that a daemon is running or paused, but no process holds the lock: the daemon
            // was killed before it could record its end.
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
    fn new(input: &Path, frame: &JournaledFrame, is_running: bool) -> FrameStatus {
        FrameStatus {
            input: shown(input),
            outputs: frame.outputs.iter().map(|output| shown(&output.path)).collect(),
            state: frame.status,
            reason: frame.reason.as_ref().map(ToString::to_string),
            attempts: frame.attempt_count,
            particles: frame.particle_count,
            seconds: frame.seconds,
            flaws: frame.flaws.clone(),
            settings: frame.settings.clone(),
            at_ms: frame.at_ms,
            retried: match frame.status {
                JournaledStatus::Refused if is_running => Some("will be checked again at each scan"),
                JournaledStatus::Refused => Some("will be checked again when a daemon starts"),
                JournaledStatus::RetriesExhausted => {
                    Some("will be retried when the file changes or the daemon restarts")
                }
                _ => None,
            },
        }
    }
}

#[cfg(test)]
mod tests;
