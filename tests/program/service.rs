//! The daemon as a service: notifications to systemd, and signals.

#![cfg(target_os = "linux")]

use std::fs;
use std::os::unix::net::UnixDatagram;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use tempfile::{TempDir, tempdir};

use crate::program::scene::{command, meniscus, names_in, write_sequence};

/// A time limit far longer than any step of these tests.
const TIMEOUT: Duration = Duration::from_secs(300);

/// A daemon, and a socket that plays the part of its service manager.
struct Service {
    folder: TempDir,
    manager: UnixDatagram,
    child: Child,
}

impl Service {
    /// Starts a daemon that watches `in`, with these keys.
    fn start(keys: &str) -> Service {
        let folder = tempdir().expect("a folder");
        fs::create_dir(folder.path().join("in")).expect("made");
        let socket = folder.path().join("notify");
        let manager = UnixDatagram::bind(&socket).expect("a socket");
        manager.set_read_timeout(Some(TIMEOUT)).expect("a socket");
        let config =
            format!("[daemon]\nsettle = \"0s\"\n[[watch]]\ninput = \"in\"\noutput = \"out\"\n{keys}\n");
        fs::write(folder.path().join("meniscus.toml"), config).expect("written");
        let child = command(folder.path(), &["watch", "--config", "meniscus.toml"])
            .env("NOTIFY_SOCKET", &socket)
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn()
            .expect("it starts");
        Service { folder, manager, child }
    }

    fn path(&self) -> &Path {
        self.folder.path()
    }

    /// Waits for a message that begins with this text.
    fn receives(&self, start: &str) -> String {
        let mut bytes = [0; 4096];
        loop {
            let count = match self.manager.recv(&mut bytes) {
                // A child of another test has ended.
                Err(error) if error.kind() == std::io::ErrorKind::Interrupted => continue,
                count => count.unwrap_or_else(|error| panic!("no {start}: {error}")),
            };
            let message = String::from_utf8_lossy(&bytes[..count]).into_owned();
            if message.starts_with(start) {
                return message;
            }
        }
    }

    fn send(&self, signal: &str) {
        let sent = Command::new("kill").args(["-s", signal, &self.child.id().to_string()]).status();
        assert!(sent.expect("the signal is sent").success());
    }
}

impl Drop for Service {
    fn drop(&mut self) {
        // The daemon has ended already, unless the test has failed.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

#[test]
fn systemd_is_notified_of_every_state_of_the_daemon() {
    let mut service = Service::start("formats = [\"ply\"]");
    service.receives("READY=1");
    write_sequence(&service.path().join("in"), 1, 2);
    service.receives("STATUS=2 done, 0 queued");
    assert_eq!(names_in(&service.path().join("out")), ["dam.1.ply", "dam.2.ply"]);

    service.send("TERM");
    service.receives("STOPPING=1");
    assert_eq!(service.child.wait().expect("it ends").code(), Some(0));
    let status = meniscus(service.path(), &["status", "--out", "out"]);
    assert!(status.out.contains("the daemon has ended"), "{}", status.out);
    assert!(status.out.contains("2 done, 0 queued"), "{}", status.out);
}

#[test]
fn status_describes_a_busy_daemon() {
    let service = Service::start("formats = [\"ply\"]");
    service.receives("READY=1");
    write_sequence(&service.path().join("in"), 1, 1);
    service.receives("STATUS=1 done, 0 queued");
    let status = meniscus(service.path(), &["status", "--out", "out"]);
    assert!(status.out.contains("out: running (pid "), "{} {}", status.out, status.err);
    let frame = meniscus(service.path(), &["status", "in/dam.1.ply", "--config", "meniscus.toml"]);
    assert!(frame.out.contains("state     done"), "{} {}", frame.out, frame.err);
    let second = meniscus(service.path(), &["watch", "--config", "meniscus.toml"]);
    assert_eq!(second.status, 2);
    assert!(second.err.contains(&format!("pid {}", service.child.id())), "{}", second.err);
}

#[test]
fn second_signal_ends_the_daemon_at_once() {
    // This number of steps takes minutes.
    let mut service = Service::start("integrator = \"explicit\"\nsteps = 100000");
    service.receives("READY=1");
    write_sequence(&service.path().join("in"), 1, 1);
    service.receives("STATUS=0 done, 1 queued");
    service.send("INT");
    service.receives("STOPPING=1");
    service.send("INT");
    assert_eq!(service.child.wait().expect("it ends").code(), Some(130));
    assert!(names_in(&service.path().join("out")).is_empty());
}

#[test]
fn once_exits_with_the_status_of_convert() {
    let folder = tempdir().expect("a folder");
    let path = folder.path();
    fs::create_dir(path.join("in")).expect("made");
    let once = |more: &[&str]| meniscus(path, &[&["watch", "in", "--out", "out", "--once"], more].concat());
    assert_eq!(once(&[]).status, 2);
    write_sequence(&path.join("in"), 1, 2);
    assert_eq!(once(&["--settle", "0"]).status, 0);
    fs::write(path.join("in/dam.3.ply"), "ply\nnothing\n").expect("written");
    let failed = once(&["--settle", "0", "--log", "json"]);
    assert_eq!(failed.status, 1, "{}", failed.err);
    assert_eq!(failed.err.matches("PLY, at line 2").count(), 1, "{}", failed.err);
    let line: serde_json::Value =
        serde_json::from_str(failed.err.lines().next_back().expect("a log")).expect("JSON");
    assert_eq!((&line["done"], &line["failed"], &line["level"]), (&2.into(), &1.into(), &"INFO".into()));
}
