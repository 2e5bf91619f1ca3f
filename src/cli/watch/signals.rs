//! Converts signals into requests to the daemon.
//!
//! SIGTERM ends the process even if the loop hangs. The loop has some time to finish the in-flight frames.
//! Then another thread exits the process; the only files that this thread touches are those of unfinished
//! outputs. On SIGHUP, a separate thread reads the configuration file, because that may be on a file system
//! that does not respond. The threads that end the process log through yet another thread, because the
//! standard error may be a full pipe, which blocks its writers.

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

/// Installs the signal handlers: SIGTERM and SIGINT stop the daemon gracefully, and a second one stops it
/// immediately; SIGHUP reloads the configuration.
///
/// # Errors
/// If the system refuses to install the handlers.
#[cfg(unix)]
pub(super) fn listen(control: Arc<Control>) -> Result<()> {
    use signal_hook::consts::{SIGHUP, SIGINT, SIGTERM};
    use signal_hook::iterator::Signals;

    let mut signals = Signals::new([SIGHUP, SIGINT, SIGTERM])?;
    std::thread::Builder::new().name("signals".into()).spawn(move || {
        for signal in signals.forever() {
            if signal == SIGHUP {
                let control = Arc::clone(&control);
                // Concurrent reloads run one after the other.
                let reloading = std::thread::Builder::new().name("reload".into());
                if let Err(error) = reloading.spawn(move || control.reload()) {
                    tracing::error!("configuration not reloaded: {error}");
                }
            } else if control.finish() {
                end_at_once(128 + signal, || {
                    tracing::warn!("second signal: ending without finishing the frames in flight");
                });
            } else {
                let is_deadline_kept = end_when_overdue(&control);
                log_detached(move || {
                    tracing::info!("stopping on request; a second signal exits at once");
                    if let Err(error) = is_deadline_kept {
                        tracing::warn!(
                            "if a file system hangs, the daemon will not exit by itself after --stop-deadline: \
                             send a second signal then (cannot start a thread: {error})"
                        );
                    }
                });
            }
        }
    })?;
    Ok(())
}

/// Exits the process if the loop has not ended by the deadline.
#[cfg(unix)]
fn end_when_overdue(control: &Arc<Control>) -> io::Result<()> {
    let control = Arc::clone(control);
    let waiting = std::thread::Builder::new().name("deadline".into()).spawn(move || {
        std::thread::sleep(lock(&control.stop_deadline).saturating_add(GRACE));
        end_at_once(i32::from(control.args.once), || {
            tracing::error!("the daemon hangs: ending without finishing the frames in flight");
        });
    });
    waiting.map(|_| ())
}

/// Logs from another thread. The returned receiver gets a message when the line is written, and is
/// disconnected if the thread cannot be started. If the standard error is a full pipe, which blocks its
/// writer, neither happens.
#[cfg(unix)]
fn log_detached(log: impl FnOnce() + Send + 'static) -> Receiver<()> {
    let (done, is_done) = channel();
    let logging = std::thread::Builder::new().name("log".into()).spawn(move || {
        log();
        let _ = done.send(());
    });
    // If the thread cannot be started, the line is lost, and the process still ends.
    drop(logging);
    is_done
}

/// How long the process waits at its end for its last log line.
#[cfg(unix)]
const LOG_TIMEOUT: Duration = Duration::from_secs(1);

/// How long after the deadline the process exits. The loop itself ends at the deadline unless it hangs.
#[cfg(unix)]
const GRACE: Duration = Duration::from_secs(5);

/// Exits the process with this status, after it has waited for the log line for at most `LOG_TIMEOUT`. For a
/// signal, callers pass the status that a shell reports: 128 + signal, such as 130 for Ctrl-C.
#[cfg(unix)]
fn end_at_once(status: i32, log: impl FnOnce() + Send + 'static) -> ! {
    crate::pipeline::stop_writing();
    let _ = log_detached(log).recv_timeout(LOG_TIMEOUT);
    std::process::exit(status)
}

/// Other systems have no such signals, and end the process in their own way.
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

    /// Set in the child process of the test below: the number of signals that it gets.
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
            // Blocks the log as a full pipe would.
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
            // Killing a child that has already ended is harmless.
            let _ = child.kill();
            assert_eq!(child.wait().expect("ended").code(), Some(status), "{signal_count} signals");
        }
    }
}
