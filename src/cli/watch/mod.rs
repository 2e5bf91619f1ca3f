//! `meniscus watch`: runs the daemon's event loop and connects it to signals, the service manager and the
//! log.
//!
//! ```text
//!   SIGTERM, SIGINT ──▶ Shutdown ──▶ ┌────────────┐ ──▶ Notice ──▶ systemd
//!   meniscus.toml, options ─▶ plan ▶ │ watch::run │
//!                                    └────────────┘ ──▶ tracing ──▶ standard error
//! ```

mod log;
mod plan;
#[cfg(target_os = "linux")]
mod service;
mod signals;

use std::fs;
use std::path::Path;
use std::sync::Arc;

use anyhow::{Context, Result};
use crossbeam::channel::unbounded;
use glob::Pattern;
use tracing::{error, info, warn};

use crate::http::{HttpServer, Listen};
use crate::pipeline::{FrameFile, files_in, stop_writing};
use crate::surface::simd::level_warning;
use crate::watch::selection::FileFilter;
use crate::watch::status_store::StatusStore;
use crate::watch::{self, EndReason, FailedFrame, Notice, Watch, WatchSummary};

use super::CommandOutcome;
use super::args::WatchArgs;
use super::render_session::level_sets_in;
use super::wording::{FRAMES_IN_VIEW, failed_validation, pluralize};
use plan::WatchPlan;
pub(super) use plan::make_plan;
#[cfg(target_os = "linux")]
use service::notify;
use signals::Shutdown;

/// Watches until it receives a signal to stop or, with `--once`, until all existing frames are converted.
///
/// # Errors
/// If the daemon cannot start.
pub(super) fn watch(args: &WatchArgs) -> Result<CommandOutcome> {
    let WatchPlan { config, log, listen, warnings } = make_plan(args)?;
    log::start(log)?;
    for warning in level_warning().into_iter().chain(warnings) {
        warn!("{warning}");
    }
    let (sender, finish) = unbounded();
    signals::listen(Arc::new(Shutdown::new(sender)))?;
    let store = listen.as_ref().map(|_| Arc::new(StatusStore::new()));
    let _window = open_http_server(listen.as_ref(), store.as_ref())?;
    let mut notices = |notice: Notice| match notice {
        Notice::Overdue => exit_immediately(args.once),
        notice => notify(&notice),
    };
    match watch::run(&config, store.as_ref(), &finish, &mut notices) {
        Ok(summary) => {
            let once = args.once.then_some(args.allow_violations);
            Ok(log_summary(once, &config.watches, &summary))
        }
        Err(error) => {
            error!("{error}");
            Ok(CommandOutcome::NothingDone)
        }
    }
}

/// The service manager of other systems, which needs no notifications.
#[cfg(not(target_os = "linux"))]
fn notify(_notice: &Notice) {}

/// Serves the status store by HTTP.
fn open_http_server(listen: Option<&Listen>, store: Option<&Arc<StatusStore>>) -> Result<Option<HttpServer>> {
    let (Some(listen), Some(store)) = (listen, store) else { return Ok(None) };
    let server = HttpServer::open(listen, Arc::clone(store))
        .with_context(|| format!("cannot listen on {}", listen.address))?;
    info!(address = %format_args!("http://{}/", server.address()), "serving the status page");
    Ok(Some(server))
}

/// Exits immediately. The next run converts the unfinished frames.
fn exit_immediately(once: bool) {
    stop_writing();
    // A daemon exits with status 0, because a signal has requested its end. With `--once`, an early exit is a
    // failure.
    std::process::exit(i32::from(once));
}

/// Logs how the run ended, and returns the exit status. `once` is `None` without `--once`; with it, `once` is
/// the value of `--allow-violations`.
fn log_summary(once: Option<bool>, watches: &[Watch], summary: &WatchSummary) -> CommandOutcome {
    let WatchSummary { ended, done_count, broken_count, failed, left_count, has_unwritten } = summary;
    if has_scrolled_away(failed) {
        for failure in failed {
            error!("failed: {}", failure.message);
        }
    }
    if *ended == EndReason::Drained && done_count + failed.len() + left_count == 0 {
        warn!("there are no frames to convert{}", reasons(watches));
    }
    let why = match ended {
        EndReason::Drained if *has_unwritten => "the stage or the records are incomplete",
        EndReason::Drained if failed.len() + left_count == 0 => "no frames are left to convert",
        EndReason::Drained => "not all frames are converted",
        _ => "stopped on request",
    };
    info!(done = done_count, failed = failed.len(), left = left_count, "ended: {why}");
    let Some(allow_violations) = once else { return CommandOutcome::Done };
    if *broken_count > 0 {
        let message = failed_validation(*broken_count, *done_count, "");
        if allow_violations {
            warn!("{message}");
        } else {
            error!("{message}; --allow-violations accepts them");
        }
    }
    match done_count {
        0 => CommandOutcome::NothingDone,
        _ => {
            let is_flawed = *has_unwritten || *broken_count > 0 && !allow_violations;
            CommandOutcome::of(*done_count, failed.len() + left_count, is_flawed)
        }
    }
}

/// Whether some failures were last logged long ago or never. If all are recent, the summary does not repeat
/// them.
fn has_scrolled_away(failed: &[FailedFrame]) -> bool {
    failed.iter().any(|failure| failure.frames_since.is_none_or(|count| count > FRAMES_IN_VIEW))
}

// Why a watched folder has no frames to convert.

/// The reasons that are known, to follow "there are no frames to convert"; empty if there are none.
fn reasons(watches: &[Watch]) -> String {
    let mut reasons = Vec::new();
    for watch in watches {
        let Some(reason) = reason(watch).or_else(|| unwatched_folders(watch)) else { continue };
        reasons.push(match watches {
            [_] => reason,
            _ => format!("{}: {reason}", watch.input.display()),
        });
    }
    if reasons.is_empty() { String::new() } else { format!(": {}", reasons.join("; ")) }
}

fn reason(watch: &Watch) -> Option<String> {
    let level_sets = level_sets_in(&watch.input);
    let Some(pattern) = &watch.pattern else { return level_sets_left_alone(level_sets.len()) };
    let filter = FileFilter::new(Some(pattern), Vec::new()).ok()?;
    let is_taken = |file: &FrameFile| filter.takes(&watch.input, &file.path);
    if watch.has_level_sets {
        // Level sets of other programs would be frames.
        let own_count = level_sets.iter().filter(|file| is_taken(file)).count();
        if own_count > 0 {
            let own = pluralize(own_count, "level set");
            return Some(format!("{own} left alone: results that meniscus wrote are not inputs"));
        }
    } else {
        let is_meant = |file: &&FrameFile| {
            Pattern::new(pattern).is_ok_and(|pattern| pattern.matches(&name_of(&file.path)))
        };
        let left = level_sets_left_alone(level_sets.iter().filter(is_meant).count());
        if left.is_some() {
            return left;
        }
    }
    // Files in sub-folders are not counted here.
    let files = if pattern.contains('/') { Vec::new() } else { files_in(&watch.input).unwrap_or_default() };
    if files.is_empty() || files.iter().any(|path| filter.takes(&watch.input, path)) {
        return None;
    }
    let hint = match Pattern::new(&pattern.to_lowercase()) {
        _ if pattern.contains(['{', '}']) => {
            "; braces have no meaning in a pattern: watch each pattern separately"
        }
        _ if pattern.contains('#') => "; in a pattern, * stands for the number: dam.*.bgeo",
        Ok(lower) if files.iter().any(|path| lower.matches(&name_of(path).to_lowercase())) => {
            "; capital and small letters differ"
        }
        _ => "",
    };
    Some(format!("none of the {} in this folder matches {pattern}{hint}", pluralize(files.len(), "file")))
}

/// The sub-folders that are not watched.
fn unwatched_folders(watch: &Watch) -> Option<String> {
    let entries = fs::read_dir(&watch.input).into_iter().flatten().flatten();
    let is_hidden = |path: &Path| name_of(path).starts_with('.');
    let folders = entries.map(|entry| entry.path()).filter(|path| path.is_dir() && !is_hidden(path));
    let count = folders.filter(|path| *path != watch.outputs.folder).count();
    (count > 0).then(|| {
        format!(
            "the folder has {}, which are not watched: give --pattern '**'",
            pluralize(count, "sub-folder")
        )
    })
}

fn level_sets_left_alone(count: usize) -> Option<String> {
    let level_sets = pluralize(count, "level set");
    (count > 0).then(|| {
        format!(
            "{level_sets} left alone; --pattern '*.vdb' selects level sets, except those that meniscus wrote"
        )
    })
}

fn name_of(path: &Path) -> String {
    path.file_name().unwrap_or_default().to_string_lossy().into_owned()
}

#[cfg(test)]
mod tests;
