//! `meniscus watch`: runs the daemon's event loop and connects it to signals, the service manager and the
//! log.
//!
//! ```text
//!   SIGTERM, SIGINT ──▶ Command::Finish ──▶ ┌─────────────┐ ──▶ Notice ──▶ systemd
//!   SIGHUP ──▶ plan ──▶ Command::Reload ──▶ │ daemon::run │
//!                                           └─────────────┘ ──▶ tracing ──▶ standard error
//! ```
//!
//! A reload makes the new plan before the loop ends. If the configuration file is invalid, the loop continues
//! with the old plan.

mod log;
mod no_frames;
mod plan;
mod service;
mod signals;

use std::mem::replace;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use anyhow::{Context, Result, bail};
use crossbeam::channel::{Sender, unbounded};
use tracing::{error, info, warn};

use crate::http::{HttpServer, Listen};
use crate::pipeline::stop_writing;
use crate::surface::simd::level_warning;
use crate::watch::status_store::StatusStore;
use crate::watch::{self, DaemonRequest, EndReason, FailedFrame, Notice, Watch, WatchSummary};

use super::CommandOutcome;
use super::args::{LogChoice, WatchArgs};
use super::wording::{FRAMES_IN_VIEW, failed_validation, with_causes};

use plan::WatchPlan;
pub(super) use plan::make_plan;
use service::Service;

/// Watches until it receives a signal to stop or, with `--once`, until all existing frames are converted.
///
/// # Errors
/// If the daemon cannot start.
pub(super) fn watch(args: &WatchArgs) -> Result<CommandOutcome> {
    let mut plan = make_plan(args)?;
    log::start(plan.log)?;
    if let Some(warning) = level_warning() {
        warn!("{warning}");
    }
    let (sender, commands) = unbounded();
    let control = Arc::new(Control::new(args.clone(), (plan.log, plan.listen.clone()), sender));
    signals::listen(Arc::clone(&control))?;
    let mut service = Service::new();
    let store = plan.listen.as_ref().map(|_| Arc::new(StatusStore::new()));
    let _window = open_http_server(plan.listen.as_ref(), store.as_ref())?;
    let mut previous = None;
    loop {
        for warning in &plan.warnings {
            warn!("{warning}");
        }
        *lock(&control.stop_deadline) = plan.config.stop_deadline;
        let mut notices = |notice: Notice| match notice {
            // During a reload the loop ends only to start again: for clients and the service manager, the run
            // continues.
            Notice::Stopping | Notice::Overdue if control.is_reloading() => {}
            Notice::Overdue => exit_immediately(args.once),
            notice => service.notify(&notice),
        };
        let summary = match watch::run(&plan.config, store.as_ref(), &commands, &mut notices) {
            Ok(summary) => summary,
            // A valid configuration may still be unusable: for example, another daemon has locked the new
            // output.
            Err(error) => match previous.take() {
                Some(old) => {
                    error!("continuing with the old configuration: {error}");
                    control.record_refused_reload(error.to_string());
                    plan = old;
                    continue;
                }
                None => {
                    error!("{error}");
                    return Ok(CommandOutcome::NothingDone);
                }
            },
        };
        match control.next_plan() {
            Some(next) if summary.ended == EndReason::Reload => previous = Some(replace(&mut plan, next)),
            _ if summary.ended == EndReason::Reload && !control.is_finishing() => {}
            _ => {
                let once = args.once.then_some(args.allow_violations);
                return Ok(log_summary(once, &plan.config.watches, &summary));
            }
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
            error!("failed: {}", failure.what);
        }
    }
    if *ended == EndReason::Drained && done_count + failed.len() + left_count == 0 {
        warn!("there are no frames to convert{}", no_frames::reasons(watches));
    }
    let why = match ended {
        EndReason::Drained if *has_unwritten => "the journal or the stage is incomplete",
        EndReason::Drained if failed.len() + left_count == 0 => "no frames are left to convert",
        EndReason::Drained => "not all frames are converted",
        _ => "stopped on request",
    };
    info!(done = done_count, failed = failed.len(), left = left_count, "ended: {why}");
    let Some(allow_violations) = once else { return CommandOutcome::Done };
    if *broken_count > 0 {
        let what = failed_validation(*broken_count, *done_count, "");
        match allow_violations {
            true => warn!("{what}"),
            false => error!("{what}; --allow-violations accepts them"),
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

/// State shared with the signal thread, which sends commands to the loop.
struct Control {
    args: WatchArgs,
    /// The log starts once per process; a reload cannot change it.
    log: LogChoice,
    /// The HTTP server starts once per process; a reload cannot change it.
    listen: Option<Listen>,
    commands: Sender<DaemonRequest>,
    finishing: AtomicBool,
    /// Serializes reloads.
    reloading: Mutex<()>,
    /// Time limit for in-flight frames at shutdown.
    stop_deadline: Mutex<Duration>,
    /// The plan of a pending reload.
    next: Mutex<Option<WatchPlan>>,
}

impl Control {
    fn new(
        args: WatchArgs,
        (log, listen): (LogChoice, Option<Listen>),
        commands: Sender<DaemonRequest>,
    ) -> Control {
        Control {
            args,
            log,
            listen,
            commands,
            finishing: AtomicBool::new(false),
            reloading: Mutex::new(()),
            stop_deadline: Mutex::new(Duration::ZERO),
            next: Mutex::new(None),
        }
    }

    /// Sends the loop the command to finish, and returns whether it was already sent. Logs nothing: writing
    /// to a standard error whose pipe is full would block the caller.
    fn finish(&self) -> bool {
        let again = self.finishing.swap(true, Ordering::SeqCst);
        if !again {
            // Sending fails only if the loop has ended.
            let _ = self.commands.send(DaemonRequest::Finish);
        }
        again
    }

    /// Makes a new plan, and sends the loop the command to restart with it.
    fn reload(&self) {
        let _alone = lock(&self.reloading);
        if self.is_finishing() {
            return;
        }
        service::notify_reloading();
        match self.plan_again() {
            Ok(plan) => {
                info!("reloading the configuration");
                let is_first = lock(&self.next).replace(plan).is_none();
                if is_first {
                    let _ = self.commands.send(DaemonRequest::Reload);
                }
            }
            Err(error) => {
                let error = with_causes(&error);
                error!("configuration not reloaded: {error}");
                self.record_refused_reload(error.clone());
                service::notify_reload_failed(&format!("continues with the old configuration: {error}"));
            }
        }
    }

    /// Sends the loop the reason why it continues with the old configuration, for the journal.
    fn record_refused_reload(&self, reason: String) {
        // Sending fails only if the loop has ended.
        let _ = self.commands.send(DaemonRequest::ReloadRefused(reason));
    }

    fn plan_again(&self) -> Result<WatchPlan> {
        if self.args.config.is_none() {
            bail!("there is nothing to reload without a --config file");
        }
        let plan = make_plan(&self.args)?;
        if plan.log != self.log {
            warn!("a change of `log` needs a restart of the daemon");
        }
        if plan.listen != self.listen {
            warn!("a change of `listen` or the token needs a restart of the daemon");
        }
        Ok(plan)
    }

    fn is_finishing(&self) -> bool {
        self.finishing.load(Ordering::SeqCst)
    }

    fn is_reloading(&self) -> bool {
        !self.is_finishing() && lock(&self.next).is_some()
    }

    /// The plan to restart with, or `None` if the daemon is shutting down.
    fn next_plan(&self) -> Option<WatchPlan> {
        lock(&self.next).take().filter(|_| !self.is_finishing())
    }
}

/// Locks a value that may be poisoned: each value is replaced as a whole, so it is consistent even after a
/// panic.
fn lock<T>(value: &Mutex<T>) -> MutexGuard<'_, T> {
    value.lock().unwrap_or_else(PoisonError::into_inner)
}

#[cfg(test)]
mod tests;
