//! Sends the messages of sd_notify(3) over the socket that `NOTIFY_SOCKET` names. Without that variable it
//! sends nothing.
//!
//! ```text
//!   Notice::Ready      READY=1
//!   Notice::Status     STATUS=…
//!   Notice::Alive      WATCHDOG=1     if a watchdog is configured, at most twice per timeout
//!   Notice::Stopping   STOPPING=1
//! ```

use std::time::{Duration, Instant};

use meniscus_formats::escaped;
use sd_notify::NotifyState;
use tracing::warn;

use crate::watch::Notice;

/// Sends the notices of the event loop to the service manager.
pub(super) struct Service {
    /// The watchdog timeout, after which systemd kills a silent service.
    watchdog: Option<Duration>,
    last_sign: Option<Instant>,
}

impl Service {
    pub(super) fn new() -> Service {
        Service { watchdog: sd_notify::watchdog_enabled(), last_sign: None }
    }

    pub(super) fn notify(&mut self, notice: &Notice) {
        // A line break, for example in a folder's name, would start another message.
        let escaped_status = match notice {
            Notice::Status(status) => Some(Notice::Status(escaped(status).to_string())),
            _ => None,
        };
        if let Some(message) = self.message(escaped_status.as_ref().unwrap_or(notice), Instant::now()) {
            send(message);
        }
    }

    fn message<'a>(&mut self, notice: &'a Notice, now: Instant) -> Option<NotifyState<'a>> {
        match notice {
            Notice::Ready => Some(NotifyState::Ready),
            Notice::Status(status) => Some(NotifyState::Status(status)),
            Notice::Stopping => Some(NotifyState::Stopping),
            Notice::Overdue => None,
            Notice::Alive => {
                let half = self.watchdog? / 2;
                if self.last_sign.is_some_and(|last| now.saturating_duration_since(last) < half) {
                    return None;
                }
                self.last_sign = Some(now);
                Some(NotifyState::Watchdog)
            }
        }
    }
}

/// Sends a message. A failure is logged, and the daemon continues.
fn send(message: NotifyState<'_>) {
    if let Err(error) = sd_notify::notify(&[message]) {
        warn!("cannot notify the service manager: {error}");
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::os::unix::net::UnixDatagram;
    use std::process::Command;

    #[test]
    fn heartbeats_are_sent_at_most_twice_per_timeout() {
        let mut service = Service { watchdog: Some(Duration::from_secs(10)), last_sign: None };
        let start = Instant::now();
        let received = |service: &mut Service, second| {
            service.message(&Notice::Alive, start + Duration::from_secs(second)).is_some()
        };
        let times: Vec<u64> = (0..=16).step_by(2).filter(|&second| received(&mut service, second)).collect();
        assert_eq!(times, [0, 6, 12]);
        let mut unwatched = Service { watchdog: None, last_sign: None };
        assert!(!received(&mut unwatched, 0));
    }

    /// Sends every kind of message.
    fn send_all_messages() {
        let mut service = Service::new();
        service.notify(&Notice::Ready);
        service.notify(&Notice::Alive);
        service.notify(&Notice::Alive);
        service.notify(&Notice::Status("3 frames wait\nMAINPID=1".into()));
        service.notify(&Notice::Stopping);
    }

    /// Set in the child process of the test below.
    const CHILD: &str = "MENISCUS_TEST_SAY_EVERYTHING";

    #[test]
    fn every_message_reaches_the_socket() {
        // The socket's name comes from the environment, so the test needs its own process.
        if std::env::var_os(CHILD).is_some() {
            return send_all_messages();
        }
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("notify");
        let socket = UnixDatagram::bind(&path).expect("a socket");
        let name = concat!(module_path!(), "::every_message_reaches_the_socket");
        let name = name.split_once("::").expect("within the crate").1;
        let output = Command::new(std::env::current_exe().expect("this test"))
            .args(["--exact", name])
            .env(CHILD, "")
            .env("NOTIFY_SOCKET", &path)
            .env("WATCHDOG_USEC", "60000000")
            .env_remove("WATCHDOG_PID")
            .output()
            .expect("it starts");
        assert!(String::from_utf8_lossy(&output.stdout).contains("1 passed"), "{output:?}");
        socket.set_nonblocking(true).expect("a socket");
        let mut messages = Vec::new();
        let mut bytes = [0; 512];
        while let Ok(count) = socket.recv(&mut bytes) {
            messages.push(String::from_utf8_lossy(&bytes[..count]).trim_end().to_owned());
        }
        let [ready, alive, status, stopping] = &messages[..] else { panic!("{messages:?}") };
        assert_eq!((&**ready, &**alive), ("READY=1", "WATCHDOG=1"));
        assert_eq!((&**status, &**stopping), ("STATUS=3 frames wait\\nMAINPID=1", "STOPPING=1"));
    }
}
