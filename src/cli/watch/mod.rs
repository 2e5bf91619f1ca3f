//! `meniscus watch`: the daemon, between the person or system that started it and its loop.
//!
//! ```text
//!   SIGTERM, SIGINT ──▶ Command::Finish ──▶ ┌─────────────┐ ──▶ Notice ──▶ systemd
//!   SIGHUP ──▶ plan ──▶ Command::Reload ──▶ │ daemon::run │
//!                                           └─────────────┘ ──▶ tracing ──▶ standard error
//! ```
//!
//! A file that is wrong when it is read again changes nothing: the plan is made before the loop is
//! asked to end, and it goes on with the old one where there is no new one.

mod log;
mod plan;
mod service;
mod signals;

use std::mem::replace;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use anyhow::{Context, Result, bail};
use crossbeam::channel::{Sender, bounded};
use tracing::{error, info, warn};

use crate::http::{Listen, Window};
use crate::pipeline::stop_writing;
use crate::surface::simd::level_warning;
use crate::watch::status_store::StatusStore;
use crate::watch::{self, DaemonRequest, EndReason, FailedFrame, Notice, Watch, WatchSummary};

use super::CommandOutcome;
use super::args::{LogChoice, WatchArgs};
use super::render_session::level_sets_in;
use super::wording::{FRAMES_IN_VIEW, counted, failed_validation, with_causes};

use plan::WatchPlan;
pub(super) use plan::make_plan;
use service::Service;

/// Watches until it is asked to end, or, once, until what is there is converted.
///
/// # Errors
/// When it cannot begin.
pub(super) fn watch(args: &WatchArgs) -> Result<CommandOutcome> {
    let mut plan = make_plan(args)?;
    log::start(plan.log)?;
    if let Some(warning) = level_warning() {
        warn!("{warning}");
    }
    // One of each at most is ever waiting: whoever sends never blocks.
    let (sender, commands) = bounded(2);
    let control = Arc::new(Control::new(args.clone(), (plan.log, plan.listen.clone()), sender));
    signals::listen(Arc::clone(&control))?;
    let mut service = Service::new();
    let store = plan.listen.as_ref().map(|_| Arc::new(StatusStore::new()));
    let _window = open_window(plan.listen.as_ref(), store.as_ref())?;
    let mut previous = None;
    loop {
        for warning in &plan.warnings {
            warn!("{warning}");
        }
        *lock(&control.stop_deadline) = plan.config.stop_deadline;
        let mut notices = |notice: Notice| match notice {
            // It ends to begin again: for the outside it goes on.
            Notice::Stopping | Notice::Overdue if control.is_reloading() => {}
            Notice::Overdue => give_up_what_is_under_way(args.once),
            notice => service.tell(&notice),
        };
        let summary = match watch::run(&plan.config, store.as_ref(), &commands, &mut notices) {
            Ok(summary) => summary,
            // What could be read again may still be impossible: somebody else has the new output.
            Err(error) => match previous.take() {
                Some(old) => {
                    error!("going on with the old configuration: {error}");
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
                return Ok(conclude(once, &plan.config.watches, &summary));
            }
        }
    }
}

/// Serves the status store by HTTP.
fn open_window(listen: Option<&Listen>, store: Option<&Arc<StatusStore>>) -> Result<Option<Window>> {
    let (Some(listen), Some(store)) = (listen, store) else { return Ok(None) };
    let window = Window::open(listen, Arc::clone(store));
    let window = window.with_context(|| format!("cannot listen on {}", listen.address))?;
    info!(address = %format_args!("http://{}/", window.address()), "the window is open");
    Ok(Some(window))
}

/// Ends at once: what is not whole yet is left for the next time.
fn give_up_what_is_under_way(once: bool) {
    stop_writing();
    // A daemon did what it was asked to; who wanted all that is there did not get it.
    std::process::exit(i32::from(once));
}

/// Logs how the run ended, and returns the verdict. `once` is whether violations are allowed, of a run that converts what is
/// there and ends.
fn conclude(once: Option<bool>, watches: &[Watch], summary: &WatchSummary) -> CommandOutcome {
    let WatchSummary { ended, done_count, broken_count, failed, left_count } = summary;
    if is_out_of_sight(failed) {
        for failure in failed {
            error!("failed: {}", failure.what);
        }
    }
    if *ended == EndReason::Drained && done_count + failed.len() + left_count == 0 {
        warn!("there are no frames to convert{}", level_sets_left(watches));
    }
    let why = if *ended == EndReason::Drained { "nothing is left to do" } else { "asked to end" };
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
            CommandOutcome::of(*done_count, failed.len() + left_count, *broken_count > 0 && !allow_violations)
        }
    }
}

/// Names the level sets in the folders, which were not converted.
fn level_sets_left(watches: &[Watch]) -> String {
    match watches.iter().map(|watch| level_sets_in(&watch.input).len()).sum() {
        0 => String::new(),
        count => format!(
            ": {} left alone; --pattern '*.vdb' takes those that meniscus did not write",
            counted(count, "level set")
        ),
    }
}

/// Whether something of this was told long ago, or never. What was just told is not told again.
fn is_out_of_sight(failed: &[FailedFrame]) -> bool {
    failed.iter().any(|failure| failure.frames_since.is_none_or(|count| count > FRAMES_IN_VIEW))
}

/// What signals ask for, and the loop is told.
struct Control {
    args: WatchArgs,
    /// A log is begun once.
    log: LogChoice,
    /// A window is opened once.
    listen: Option<Listen>,
    commands: Sender<DaemonRequest>,
    finishing: AtomicBool,
    /// One after the other.
    reloading: Mutex<()>,
    /// How long frames under way may take when it ends.
    stop_deadline: Mutex<Duration>,
    /// The plan of a reload that is under way.
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

    /// Asks the loop to finish. Whether it was asked before. Logs nothing: a standard error that takes no more text would
    /// block the caller.
    fn finish(&self) -> bool {
        let again = self.finishing.swap(true, Ordering::SeqCst);
        if !again {
            // Where nobody listens any more, it has ended.
            let _ = self.commands.send(DaemonRequest::Finish);
        }
        again
    }

    /// Makes another plan, and asks the loop to end for it.
    fn reload(&self) {
        let _alone = lock(&self.reloading);
        if self.is_finishing() {
            return;
        }
        service::tell_reloading();
        match self.plan_again() {
            Ok(plan) => {
                info!("asked to begin again with what the file says now");
                let is_first = lock(&self.next).replace(plan).is_none();
                if is_first {
                    let _ = self.commands.send(DaemonRequest::Reload);
                }
            }
            Err(error) => {
                let error = with_causes(&error);
                error!("nothing is changed: {error}");
                service::tell_not_reloaded(&format!("goes on with the old configuration: {error}"));
            }
        }
    }

    fn plan_again(&self) -> Result<WatchPlan> {
        if self.args.config.is_none() {
            bail!("there is nothing to reload without a --config file");
        }
        let plan = make_plan(&self.args)?;
        if plan.log != self.log {
            warn!("`log` changes when the daemon is started again");
        }
        if plan.listen != self.listen {
            warn!("`listen` and the token change when the daemon is started again");
        }
        Ok(plan)
    }

    fn is_finishing(&self) -> bool {
        self.finishing.load(Ordering::SeqCst)
    }

    fn is_reloading(&self) -> bool {
        !self.is_finishing() && lock(&self.next).is_some()
    }

    /// The plan to go on with, unless it is to end.
    fn next_plan(&self) -> Option<WatchPlan> {
        lock(&self.next).take().filter(|_| !self.is_finishing())
    }
}

/// What is in there, whatever panicked beside it: each value is set whole.
fn lock<T>(value: &Mutex<T>) -> MutexGuard<'_, T> {
    value.lock().unwrap_or_else(PoisonError::into_inner)
}

#[cfg(test)]
mod tests;
