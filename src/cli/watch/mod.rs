//! `meniscus watch`: runs the daemon's event loop and connects it to signals, the service manager and the
//! log.
//!
//! ```text
//!   SIGTERM, SIGINT ──▶ Shutdown ──▶ ┌────────────┐ ──▶ Notice ──▶ systemd
//!   meniscus.toml, options ─▶ plan ▶ │ watch::run │
//!                                    └────────────┘ ──▶ tracing ──▶ standard error
//! ```

mod log;
mod no_frames;
mod plan;
mod service;
mod signals;

use std::sync::Arc;

use anyhow::{Context, Result};
use crossbeam::channel::unbounded;
use tracing::{error, info, warn};

use crate::http::{HttpServer, Listen};
use crate::pipeline::stop_writing;
use crate::surface::simd::level_warning;
use crate::watch::status_store::StatusStore;
use crate::watch::{self, EndReason, FailedFrame, Notice, Watch, WatchSummary};

use super::CommandOutcome;
use super::args::WatchArgs;
use super::wording::{FRAMES_IN_VIEW, failed_validation};

use plan::WatchPlan;
pub(super) use plan::make_plan;
use service::Service;
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
    signals::listen(Arc::new(Shutdown::new(sender, args.once)))?;
    let mut service = Service::new();
    let store = listen.as_ref().map(|_| Arc::new(StatusStore::new()));
    let _window = open_http_server(listen.as_ref(), store.as_ref())?;
    let mut notices = |notice: Notice| match notice {
        Notice::Overdue => exit_immediately(args.once),
        notice => service.notify(&notice),
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

/// Serves the status store by HTTP.
fn open_http_server(listen: Option<&Listen>, store: Option<&Arc<StatusStore>>) -> Result<Option<HttpServer>> {
    let (Some(listen), Some(store)) = (listen, store) else { return Ok(None) };
    let server = HttpServer::open(listen, Arc::clone(store));
    let server = server.with_context(|| format!("cannot listen on {}", listen.address))?;
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
        warn!("there are no frames to convert{}", no_frames::reasons(watches));
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

#[cfg(test)]
mod tests;
