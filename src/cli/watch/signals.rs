//! Stops the daemon on a signal, or on an event of a Windows console.
//!
//! The first signal asks the loop to finish the in-flight frames; a second one exits at once. The thread that
//! exits logs through another thread, because the standard error may be a full pipe, which blocks its writers.

use std::io;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, channel};
use std::time::Duration;

use crossbeam::channel::Sender;

use crate::cli::stop_requests::on_stop_requests;

/// How the daemon is stopped.
pub(super) struct Shutdown {
    /// The channel on which the loop receives the request to finish.
    finish: Sender<()>,
    is_finishing: AtomicBool,
}

impl Shutdown {
    pub(super) fn new(finish: Sender<()>) -> Shutdown {
        Shutdown { finish, is_finishing: AtomicBool::new(false) }
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
        log_detached(|| tracing::info!("stopping on request; a second signal exits at once"));
    })
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

    /// Set in the child process of the test below.
    const CHILD: &str = "MENISCUS_TEST_SIGNALS";

    #[test]
    fn blocked_standard_error_does_not_keep_the_process_alive() {
        let name = "blocked_standard_error_does_not_keep_the_process_alive";
        if std::env::var_os(CHILD).is_some() {
            let (sender, _requests) = crossbeam::channel::bounded(2);
            let shutdown = Arc::new(Shutdown::new(sender));
            super::super::log::start(LogChoice::Text).expect("the first log");
            listen(Arc::clone(&shutdown)).expect("it listens");
            // Blocks the log as a full pipe would.
            let _blocked = io::stderr().lock();
            let terminate = || kill_process(getpid(), Signal::TERM).expect("sent");
            terminate();
            while !shutdown.is_finishing.load(Ordering::SeqCst) {
                std::thread::yield_now();
            }
            terminate();
            loop {
                std::thread::park();
            }
        }
        let mut child = std::process::Command::new(std::env::current_exe().expect("this test"));
        child.arg(name).env(CHILD, "1").stdout(std::process::Stdio::null());
        let mut child = child.spawn().expect("a child");
        let start = Instant::now();
        while child.try_wait().expect("a child").is_none() && start.elapsed() < Duration::from_secs(120) {
            std::thread::sleep(Duration::from_millis(10));
        }
        // Killing a child that has already ended is harmless.
        let _ = child.kill();
        assert_eq!(child.wait().expect("ended").code(), Some(143));
    }

    #[test]
    fn first_signal_finishes_frames_and_second_exits() {
        let (sender, requests) = crossbeam::channel::bounded(2);
        let shutdown = Shutdown::new(sender);
        assert!(!shutdown.request());
        assert!(shutdown.request());
        assert_eq!(requests.try_iter().count(), 1);
    }
}
