//! What the system's signals ask of the daemon.
//!
//! SIGTERM ends the process, whatever hangs: the loop has some time to finish the frames under way; after that a thread
//! that touches no file but those of unfinished outputs ends the process. For the same reason the configuration, which may lie on
//! a file system that does not answer, is read again by a thread of its own. These threads log only from yet another thread,
//! because the standard error may be a pipe that is full.

use std::sync::Arc;
#[cfg(unix)]
use std::{
    io,
    sync::mpsc::{Receiver, channel},
    time::Duration,
};

use anyhow::Result;

use super::Control;
#[cfg(unix)]
use super::lock;

/// From now on, SIGTERM and SIGINT end the daemon in good order, and at once when one comes again;
/// SIGHUP makes it read its file again.
///
/// # Errors
/// When the system refuses.
#[cfg(unix)]
pub(super) fn listen(control: Arc<Control>) -> Result<()> {
    use signal_hook::consts::{SIGHUP, SIGINT, SIGTERM};
    use signal_hook::iterator::Signals;

    let mut signals = Signals::new([SIGHUP, SIGINT, SIGTERM])?;
    std::thread::Builder::new().name("signals".into()).spawn(move || {
        for signal in signals.forever() {
            if signal == SIGHUP {
                let control = Arc::clone(&control);
                // Two at once: the later one waits for its turn.
                let reloading = std::thread::Builder::new().name("reload".into());
                if let Err(error) = reloading.spawn(move || control.reload()) {
                    tracing::error!("nothing is changed: {error}");
                }
            } else if control.finish() {
                end_at_once(128 + signal, || {
                    tracing::warn!("asked to end a second time: what is not whole is left for the next time");
                });
            } else {
                let is_deadline_kept = end_when_overdue(&control);
                log_detached(move || {
                    tracing::info!("asked to end; a second signal ends at once");
                    if let Err(error) = is_deadline_kept {
                        tracing::warn!("a daemon that hangs ends by a second signal only: {error}");
                    }
                });
            }
        }
    })?;
    Ok(())
}

/// Ends the process when the loop, which has to do that sooner, hangs.
#[cfg(unix)]
fn end_when_overdue(control: &Arc<Control>) -> io::Result<()> {
    let control = Arc::clone(control);
    let waiting = std::thread::Builder::new().name("deadline".into()).spawn(move || {
        std::thread::sleep(lock(&control.stop_deadline).saturating_add(GRACE));
        end_at_once(i32::from(control.args.once), || {
            tracing::error!("the daemon hangs: what is not whole is left for the next time");
        });
    });
    waiting.map(|_| ())
}

/// Logs in a thread of its own. The receiver gets a message, or is disconnected, when that is done, which may be never: a
/// standard error that is a full pipe blocks its writer.
#[cfg(unix)]
fn log_detached(log: impl FnOnce() + Send + 'static) -> Receiver<()> {
    let (done, is_done) = channel();
    let logging = std::thread::Builder::new().name("log".into()).spawn(move || {
        log();
        let _ = done.send(());
    });
    // Without a thread the line is lost, and the process ends all the same.
    drop(logging);
    is_done
}

/// How long the end of the process waits for its last line in the log.
#[cfg(unix)]
const LOG_PATIENCE: Duration = Duration::from_secs(1);

/// The loop ends by itself within the deadline, unless it hangs.
#[cfg(unix)]
const GRACE: Duration = Duration::from_secs(5);

/// As shells count it: 130 for Ctrl-C.
#[cfg(unix)]
fn end_at_once(status: i32, log: impl FnOnce() + Send + 'static) -> ! {
    crate::pipeline::stop_writing();
    let _ = log_detached(log).recv_timeout(LOG_PATIENCE);
    std::process::exit(status)
}

/// Elsewhere the system ends the process as it sees fit.
#[cfg(not(unix))]
pub(super) fn listen(_control: Arc<Control>) -> Result<()> {
    Ok(())
}

#[cfg(test)]
#[cfg(target_os = "linux")]
mod tests {
    use super::*;
    use std::time::Instant;

    use rustix::process::{Signal, getpid, kill_process};

    use crate::cli::args::{LogChoice, WatchArgs};

    /// Set in the child of the test below: how many signals it gets.
    const CHILD: &str = "MENISCUS_TEST_SIGNALS";

    #[test]
    fn blocked_standard_error_does_not_keep_the_process_alive() {
        let name = "blocked_standard_error_does_not_keep_the_process_alive";
        if let Ok(signal_count) = std::env::var(CHILD) {
            let (sender, _commands) = crossbeam::channel::bounded(2);
            let args = WatchArgs { once: true, ..WatchArgs::default() };
            let control = Arc::new(Control::new(args, (LogChoice::Text, None), sender));
            super::super::log::start(LogChoice::Text).expect("the first log");
            listen(Arc::clone(&control)).expect("it listens");
            // As when it is a full pipe: nothing can be logged.
            let _blocked = io::stderr().lock();
            let terminate = || kill_process(getpid(), Signal::TERM).expect("sent");
            terminate();
            while !control.is_finishing() {
                std::thread::yield_now();
            }
            if signal_count == "2" {
                terminate();
            }
            loop {
                std::thread::park();
            }
        }
        for (signal_count, status) in [("2", 143), ("1", 1)] {
            let mut child = std::process::Command::new(std::env::current_exe().expect("this test"));
            child.arg(name).env(CHILD, signal_count).stdout(std::process::Stdio::null());
            let mut child = child.spawn().expect("a child");
            let start = Instant::now();
            while child.try_wait().expect("a child").is_none() && start.elapsed() < Duration::from_secs(120) {
                std::thread::sleep(Duration::from_millis(10));
            }
            // One that has ended does not mind.
            let _ = child.kill();
            assert_eq!(child.wait().expect("ended").code(), Some(status), "{signal_count} signals");
        }
    }
}
