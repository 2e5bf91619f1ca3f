//! Sends the messages of sd_notify(3) over the socket that `NOTIFY_SOCKET` names. Without that variable it
//! sends nothing.
//!
//! ```text
//!   Notice::Ready      READY=1
//!   Notice::Status     STATUS=…
//!   Notice::Stopping   STOPPING=1
//! ```

use meniscus_formats::escaped;
use sd_notify::NotifyState;
use tracing::warn;

use crate::watch::Notice;

/// Sends a notice of the event loop to the service manager.
pub(super) fn notify(notice: &Notice) {
    match notice {
        Notice::Ready => send(NotifyState::Ready),
        // A line break, for example in a folder's name, would start another message.
        Notice::Status(status) => send(NotifyState::Status(&escaped(status).to_string())),
        Notice::Stopping => send(NotifyState::Stopping),
        Notice::Overdue => {}
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

    /// Sends every kind of message.
    fn send_all_messages() {
        notify(&Notice::Ready);
        notify(&Notice::Status("3 frames wait\nMAINPID=1".into()));
        notify(&Notice::Stopping);
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
            .output()
            .expect("it starts");
        assert!(String::from_utf8_lossy(&output.stdout).contains("1 passed"), "{output:?}");
        socket.set_nonblocking(true).expect("a socket");
        let mut messages = Vec::new();
        let mut bytes = [0; 512];
        while let Ok(count) = socket.recv(&mut bytes) {
            messages.push(String::from_utf8_lossy(&bytes[..count]).trim_end().to_owned());
        }
        let [ready, status, stopping] = &messages[..] else { panic!("{messages:?}") };
        assert_eq!(
            (&**ready, &**status, &**stopping),
            ("READY=1", "STATUS=3 frames wait\\nMAINPID=1", "STOPPING=1")
        );
    }
}
