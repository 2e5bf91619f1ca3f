//! `meniscus status`: what a daemon has done, what waits, and what failed and why.
//!
//! It reads the journal, and asks the lock whether a daemon is there: what the journal says last of
//! a daemon that was killed is that it runs.
//!
//! What still waits for its writer is in no journal: that is looked for in the folders that are watched.
//!
//! The structs here are those of the JSON; the text shows the same.

mod lines;

use std::collections::HashSet;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::{Context, Result, bail};
use serde::Serialize;

use crate::pipeline::{FileStamp, file_of, is_absent, is_missing_step, natural_order};
use crate::watch::Watch;
use crate::watch::journal::{
    DaemonState, Journal, JournalState, JournaledFrame, STATE_FOLDER, Standing, now_ms,
};
use crate::watch::lock::{LockError, OutputLock};
use crate::watch::waiting::{Waiting, waiting};

use super::CommandOutcome;
use super::args::StatusArgs;
use super::console::Console;

/// What there is to tell of a folder of outputs.
#[derive(Debug, PartialEq, Serialize)]
struct StatusRecord {
    output: String,
    journal: String,
    /// Null where none is known.
    daemon: Option<DaemonStatus>,
    /// Null where the journal does not say.
    watches: Option<Vec<WatchStatus>>,
    counts: StatusCounts,
    /// In natural order.
    failed: Vec<FrameStatus>,
    /// In natural order.
    retrying: Vec<FrameStatus>,
    /// Files that a daemon takes for frames once their writers have finished, in natural order.
    waiting: Vec<WaitingStatus>,
    /// Whether there may be more of these: not every file was looked at.
    waiting_cut_short: bool,
    /// The newest first.
    last_done: Vec<FrameStatus>,
    /// Those that are done, and not as they should be, in natural order.
    flawed: Vec<FrameStatus>,
    damaged_lines: usize,
}

#[derive(Debug, PartialEq, Serialize)]
struct DaemonStatus {
    /// Null where the file system cannot tell.
    running: Option<bool>,
    /// Who has the folder now, in words.
    held_by: Option<String>,
    state: &'static str,
    paused_because: Option<String>,
    /// From here on, of the daemon that wrote the journal last.
    pid: Option<u32>,
    host: Option<String>,
    started_ms: Option<u64>,
    /// Since when it is in this state.
    at_ms: Option<u64>,
}

#[derive(Debug, PartialEq, Serialize)]
struct WatchStatus {
    input: String,
    pattern: Option<String>,
    recursive: bool,
    sentinel: Option<String>,
    formats: Vec<&'static str>,
}

#[derive(Debug, Default, PartialEq, Serialize)]
struct StatusCounts {
    done: usize,
    queued: usize,
    retrying: usize,
    failed: usize,
}

#[derive(Debug, PartialEq, Serialize)]
struct FrameStatus {
    input: String,
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
    at_ms: u64,
    /// Whether it failed, and the next start of the daemon tries it again though its file is the same.
    #[serde(skip)]
    is_for_next_start: bool,
}

#[derive(Debug, PartialEq, Serialize)]
struct WaitingStatus {
    input: String,
    reason: String,
}

/// A path as it is shown: in JSON, all names are text.
fn shown(path: &Path) -> String {
    path.to_string_lossy().into_owned()
}

/// So many of the frames that are done are told: enough to see that it goes on, and how fast.
const LAST_DONE_COUNT: usize = 5;

/// Tells how far the daemon of a folder is, or was.
///
/// # Errors
/// When there is nothing to tell, or it cannot be read.
pub(super) fn status(args: &StatusArgs, console: &mut Console) -> Result<CommandOutcome> {
    let journal = journal_folder(&args.out, args.journal.as_deref());
    let state = read_journal(&journal)?;
    let holder = Holder::of(&args.out)?;
    if state == JournalState::default() && !matches!(holder, Holder::Daemon(_)) {
        bail!("{}: no daemon has worked here, as far as {} says", args.out.display(), journal.display());
    }
    let record = StatusRecord::new(&args.out, &journal, &state, holder);
    if args.json {
        console.say_json(&record)?;
    } else {
        console.say_lines(record.lines(now_ms()));
    }
    Ok(if record.failed.is_empty() { CommandOutcome::Done } else { CommandOutcome::SomeFailed })
}

/// Where a daemon that writes to `output` keeps its journal.
pub(super) fn journal_folder(output: &Path, given: Option<&Path>) -> PathBuf {
    // As the daemon does.
    let asked = given.map(|given| given.canonicalize().unwrap_or_else(|_| given.to_owned()));
    asked.unwrap_or_else(|| output.join(STATE_FOLDER))
}

/// What the journal in a folder says.
///
/// # Errors
/// When it cannot be read.
pub(super) fn read_journal(folder: &Path) -> Result<JournalState> {
    Journal::read(folder).with_context(|| format!("cannot read the journal in {}", folder.display()))
}

/// Who has a folder of outputs now.
#[derive(Debug)]
pub(super) enum Holder {
    Daemon(String),
    Nobody,
    /// The file system has no locks.
    Unknown,
}

impl Holder {
    /// Who has this one.
    ///
    /// # Errors
    /// When the system refuses to tell.
    pub(super) fn of(output: &Path) -> Result<Holder> {
        match OutputLock::holder(output) {
            Ok(Some(by)) => Ok(Holder::Daemon(by)),
            Ok(None) => Ok(Holder::Nobody),
            Err(LockError::Unsupported { .. }) => Ok(Holder::Unknown),
            Err(error) => Err(error.into()),
        }
    }
}

impl StatusRecord {
    fn new(output: &Path, journal: &Path, state: &JournalState, holder: Holder) -> StatusRecord {
        let has_daemon = matches!(holder, Holder::Daemon(_));
        let files = Files::new(state, has_daemon);
        let in_standing = |standing| {
            let mut frames: Vec<_> = state
                .frames
                .iter()
                .filter(|(input, frame)| frame.standing == standing && !files.are_without(input, frame))
                .collect();
            frames.sort_by(|(a, _), (b, _)| natural_order(&a.to_string_lossy(), &b.to_string_lossy()));
            frames
        };
        let told = |frames: &[(&Arc<Path>, &Arc<JournaledFrame>)]| {
            frames.iter().map(|(input, frame)| FrameStatus::new(input, frame)).collect()
        };
        let retrying = in_standing(Standing::Retrying);
        let mut failed = in_standing(Standing::Failed);
        failed.extend(in_standing(Standing::Refused));
        failed.extend(in_standing(Standing::GivenUp));
        let mut done = in_standing(Standing::Done);
        let counts = StatusCounts {
            done: done.len(),
            queued: in_standing(Standing::Queued).len(),
            retrying: retrying.len(),
            failed: failed.len(),
        };
        let flawed: Vec<_> = done.iter().copied().filter(|(_, frame)| !frame.flaws.is_empty()).collect();
        // Stable: of those that are equally new, the last in natural order comes first.
        done.reverse();
        done.sort_by_key(|(_, frame)| std::cmp::Reverse(frame.at_ms));
        done.truncate(LAST_DONE_COUNT);
        // Nobody waits where no daemon is.
        let waiting = if has_daemon { waiting(state) } else { Waiting::default() };
        StatusRecord {
            output: shown(output),
            journal: shown(journal),
            daemon: DaemonStatus::new(state, holder),
            watches: state.plan.as_ref().map(|plan| plan.watches.iter().map(WatchStatus::new).collect()),
            counts,
            failed: told(&failed),
            retrying: told(&retrying),
            waiting_cut_short: waiting.is_cut_short,
            waiting: WaitingStatus::all(waiting),
            last_done: told(&done),
            flawed: told(&flawed),
            damaged_lines: state.damaged_line_count,
        }
    }
}

/// The files of the frames, as the journal knows them.
struct Files<'a> {
    /// Each as a daemon took it, without its status change time.
    taken: HashSet<(&'a Path, FileStamp)>,
    has_daemon: bool,
}

impl<'a> Files<'a> {
    fn new(state: &'a JournalState, has_daemon: bool) -> Files<'a> {
        let taken = state
            .frames
            .iter()
            .map(|(input, frame)| (file_of(input), frame.stamp.without_status_change()))
            .collect();
        Files { taken, has_daemon }
    }

    /// Whether nothing will come of a frame any more: its file was removed from its folder, or written again without it.
    fn are_without(&self, input: &Path, frame: &JournaledFrame) -> bool {
        if frame.standing == Standing::Done {
            return false;
        }
        let file = file_of(input);
        match FileStamp::of_path(file) {
            Ok(stamp) if file == input || frame.stamp.still_holds(&stamp) => false,
            Ok(stamp) => !self.may_be_growing(file, stamp, frame) && is_missing_step(input).unwrap_or(false),
            // A folder that is not there may come back with all that was in it.
            Err(error) => is_absent(file, &error) && file.parent().is_some_and(Path::exists),
        }
    }

    /// Whether a file is larger, and a daemon is at work that has yet to take it as it is: a simulation may be appending
    /// to it. Then it has its steps still, and going through it would take minutes each time that somebody asks.
    fn may_be_growing(&self, file: &Path, stamp: FileStamp, frame: &JournaledFrame) -> bool {
        self.has_daemon
            && stamp.size > frame.stamp.size
            && !self.taken.contains(&(file, stamp.without_status_change()))
    }
}

impl DaemonStatus {
    fn new(state: &JournalState, holder: Holder) -> Option<DaemonStatus> {
        let record = state.daemon.as_ref();
        let (running, held_by) = match holder {
            Holder::Daemon(by) => (Some(true), Some(by)),
            Holder::Nobody => (Some(false), None),
            Holder::Unknown => (None, None),
        };
        if record.is_none() && held_by.is_none() {
            return None;
        }
        let (state, paused_because) = match (record.map(|record| &record.state), running) {
            (None | Some(DaemonState::Stopped), Some(true)) => ("starting", None),
            (Some(DaemonState::Stopped) | None, _) => ("stopped", None),
            // It cannot have said so itself.
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

impl WatchStatus {
    fn new(watch: &Watch) -> WatchStatus {
        WatchStatus {
            input: shown(&watch.input),
            pattern: watch.pattern.clone(),
            recursive: watch.recursive,
            sentinel: watch.sentinel.clone(),
            formats: watch.outputs.formats.iter().map(|format| format.extension()).collect(),
        }
    }
}

impl WaitingStatus {
    fn all(Waiting { mut files, .. }: Waiting) -> Vec<WaitingStatus> {
        files.sort_by(|(a, _), (b, _)| natural_order(&a.to_string_lossy(), &b.to_string_lossy()));
        files
            .into_iter()
            .map(|(input, why)| WaitingStatus { input: shown(&input), reason: why.to_string() })
            .collect()
    }
}

impl FrameStatus {
    fn new(input: &Path, frame: &JournaledFrame) -> FrameStatus {
        FrameStatus {
            input: shown(input),
            outputs: frame.outputs.iter().map(|output| shown(&output.path)).collect(),
            reason: frame.reason.clone(),
            attempts: frame.attempt_count,
            particles: frame.particle_count,
            seconds: frame.seconds,
            flaws: frame.flaws.clone(),
            at_ms: frame.at_ms,
            is_for_next_start: matches!(frame.standing, Standing::Refused | Standing::GivenUp),
        }
    }
}

#[cfg(test)]
mod tests;
