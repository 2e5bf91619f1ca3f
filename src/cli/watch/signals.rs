//! Stops the daemon on a signal, or on an event of a Windows console.
//!
//! SIGTERM ends the process even if the loop hangs. The loop has some time to finish the in-flight frames.
//! Then another thread exits the process; the only files that this thread touches are those of unfinished
//! outputs. The threads that end the process log through yet another thread, because the standard error may
//! be a full pipe, which blocks its writers.

use std::io;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, channel};
use std::time::Duration;

use crossbeam::channel::Sender;

use crate::cli::stop_requests::on_stop_requests;
use crate::watch::STOP_DEADLINE;

/// How long after the deadline the process exits. The loop itself ends at the deadline unless it hangs.
const GRACE: Duration = Duration::from_secs(5);

/// How the daemon is stopped.
pub(super) struct Shutdown {
    /// The channel on which the loop receives the request to finish.
    finish: Sender<()>,
    is_finishing: AtomicBool,
    /// How long after the request the process ends although the loop has not ended.
    timeout: Duration,
    /// The exit status in that case.
    status: i32,
}

impl Shutdown {
    pub(super) fn new(finish: Sender<()>, once: bool) -> Shutdown {
        // A daemon exits with status 0, because a signal has requested its end. With `--once`, an early exit
        // is a failure.
        Shutdown {
            finish,
            is_finishing: AtomicBool::new(false),
            timeout: STOP_DEADLINE + GRACE,
            status: i32::from(once),
        }
    }

    /// Asks the loop to finish, and returns whether that was done already. Logs nothing: writing to a
    /// standard error whose pipe is full would block the caller.
    fn request(&self) -> bool {
        let again = self.is_finishing.swap(true, Ordering::SeqCst);
        if !again {
            // Sending fails only if the loop has ended.
            let _ = self.finish.send(());
        }
        again
    }
}

/// From now on, a request to stop ends the daemon gracefully, and a second one ends it immediately.
///
/// # Errors
/// If the system refuses the handlers.
pub(super) fn listen(shutdown: Arc<Shutdown>) -> io::Result<()> {
    on_stop_requests(move |request| {
        let is_second = shutdown.request();
        if is_second || request.is_urgent {
            let why = if is_second { "second signal" } else { "the system ends this process" };
            end_at_once(request.status, move || {
                tracing::warn!("{why}: ending without finishing the frames in flight");
            });
        }
        let is_deadline_kept = end_when_overdue(&shutdown);
        log_detached(move || {
            tracing::info!("stopping on request; a second signal exits at once");
            if let Err(error) = is_deadline_kept {
                tracing::warn!(
                    "if a file system hangs, the daemon will not exit by itself: send a second signal \
                     then (cannot start a thread: {error})"
                );
            }
        });
    })
}

/// Exits the process if the loop has not ended by the deadline.
fn end_when_overdue(shutdown: &Arc<Shutdown>) -> io::Result<()> {
    let (timeout, status) = (shutdown.timeout, shutdown.status);
    let waiting = std::thread::Builder::new().name("deadline".into()).spawn(move || {
        std::thread::sleep(timeout);
        end_at_once(status, || {
            tracing::error!("the daemon hangs: ending without finishing the frames in flight");
        });
    });
    waiting.map(|_| ())
}

/// Logs from another thread. The returned receiver gets a message when the line is written, and is
/// disconnected if the thread cannot be started. If the standard error is a full pipe, which blocks its
/// writer, neither happens.
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
const LOG_TIMEOUT: Duration = Duration::from_secs(1);

/// Exits the process with this status, after it has waited for the log line for at most `LOG_TIMEOUT`. For a
/// signal, callers pass the status that a shell reports: 128 + signal, such as 130 for Ctrl-C.
fn end_at_once(status: i32, log: impl FnOnce() + Send + 'static) -> ! {
    crate::pipeline::stop_writing();
    let _ = log_detached(log).recv_timeout(LOG_TIMEOUT);
    std::process::exit(status)
}

#[cfg(test)]
#[cfg(target_os = "linux")]
mod tests {
    use super::*;
    use std::time::Instant;

    use rustix::process::{Signal, getpid, kill_process};

    use crate::cli::args::LogChoice;

    /// Set in the child process of the test below: the number of signals that it gets.
    const CHILD: &str = "MENISCUS_TEST_SIGNALS";

    #[test]
    fn blocked_standard_error_does_not_keep_the_process_alive() {
        let name = "blocked_standard_error_does_not_keep_the_process_alive";
        if let Ok(signal_count) = std::env::var(CHILD) {
            let (sender, _requests) = crossbeam::channel::bounded(2);
            let shutdown = Arc::new(Shutdown { timeout: GRACE, ..Shutdown::new(sender, true) });
            super::super::log::start(LogChoice::Text).expect("the first log");
            listen(Arc::clone(&shutdown)).expect("it listens");
            // Blocks the log as a full pipe would.
            let _blocked = io::stderr().lock();
            let terminate = || kill_process(getpid(), Signal::TERM).expect("sent");
            terminate();
            while !shutdown.is_finishing.load(Ordering::SeqCst) {
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

    #[test]
    fn first_signal_finishes_frames_and_second_exits() {
        let (sender, requests) = crossbeam::channel::bounded(2);
        let shutdown = Shutdown::new(sender, false);
        assert!(!shutdown.request());
        assert!(shutdown.request());
        assert_eq!(requests.try_iter().count(), 1);
    }

    /// The loop never receives the request, as if it waited for a file system that does not respond.
    #[test]
    fn sigterm_ends_a_daemon_that_hangs() {
        use std::io::{BufRead, BufReader, Write};
        use std::process::Stdio;

        use rustix::process::Pid;

        if std::env::var_os(CHILD).is_some() {
            let (sender, _requests) = crossbeam::channel::bounded(2);
            let shutdown = Shutdown { timeout: GRACE, ..Shutdown::new(sender, false) };
            listen(Arc::new(shutdown)).expect("listens");
            writeln!(io::stdout(), "ready").expect("a parent who listens");
            loop {
                std::thread::park();
            }
        }
        let mut child = std::process::Command::new(std::env::current_exe().expect("this test"))
            .args(["sigterm_ends_a_daemon_that_hangs", "--nocapture"])
            .env(CHILD, "1")
            .stdout(Stdio::piped())
            .spawn()
            .expect("a child");
        let mut lines = BufReader::new(child.stdout.take().expect("piped")).lines();
        assert!(lines.any(|line| line.is_ok_and(|line| line.contains("ready"))), "the child is ready");
        kill_process(Pid::from_child(&child), Signal::TERM).expect("sent");
        let start = Instant::now();
        while child.try_wait().expect("a child").is_none() && start.elapsed() < Duration::from_secs(60) {
            std::thread::sleep(Duration::from_millis(10));
        }
        // Killing a child that has already ended is harmless.
        let _ = child.kill();
        assert_eq!(child.wait().expect("ended").code(), Some(0));
    }
}
