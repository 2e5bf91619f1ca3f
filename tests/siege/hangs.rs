//! A file server that stops responding during a run: frames wait; signals, heartbeat and page work.

use std::fs;
use std::io::{Read, Write};
use std::net::TcpStream;
use std::time::Duration;

use tempfile::tempdir;

use crate::siege::fuse::Mount;
use crate::siege::mounts::with_own_mounts;
use crate::siege::scene::{Daemon, frame_names, land_sequence, message, print_line};

/// The folder of frames is on a file system without events, so the daemon scans it often.
const ARGUMENTS: [&str; 12] = [
    "hanging",
    "--out",
    "out",
    "--log",
    "json",
    "--listen",
    "127.0.0.1:0",
    "--settle=50ms",
    "--poll",
    "200ms",
    "--disk-floor",
    "0B",
];

/// Longer than the daemon waits for frames after a request to stop.
const SOON: Duration = Duration::from_secs(60);

#[test]
#[ignore = "slow: `.ci/full slow` runs it"]
fn unresponsive_file_system_leaves_signals_heartbeat_and_page() {
    with_own_mounts("hangs::unresponsive_file_system_leaves_signals_heartbeat_and_page", || {
        let folder = tempdir().expect("a folder");
        let [disk, hanging] = ["disk", "hanging"].map(|name| folder.path().join(name));
        for path in [&disk, &hanging] {
            fs::create_dir(path).expect("made");
        }
        // Declared before the mount, so that it is dropped after the mount: a blocked process does not end.
        let mut daemon;
        let Some(mount) = Mount::new(&disk, &hanging) else {
            return print_line("a file system that hangs: SKIPPED, /dev/fuse is missing");
        };
        land_sequence(&disk, 1, 3, 5);
        daemon = Daemon::start_watched(folder.path(), &ARGUMENTS);
        daemon.until_converted(&frame_names(1, 3));
        let address = daemon.window_address();

        // Frames arrive during the run: some of them are being read when the server stops, others wait.
        land_sequence(&disk, 4, 60, 12);
        daemon.until_converted(&frame_names(4, 4));
        mount.stop();
        daemon.until("it says which folder hangs", |daemon| daemon.has_status("hanging is unavailable"));
        daemon.until("it logs this once", |daemon| daemon.count_logged("has not responded") == 1);
        assert!(get(&address, "/api/status").contains("does not respond"));
        let signs = daemon.signs_of_life();
        daemon.listen_for(Duration::from_secs(5));
        assert!(daemon.signs_of_life() >= signs + 3, "it gives no signs of life");

        // The blocked frames continue.
        mount.go_on();
        daemon.until_converted(&frame_names(4, 60));
        daemon.until("it is available again", |daemon| !daemon.has_status("is unavailable"));
        let mut converted = daemon.converted();
        converted.sort();
        let mut wanted = frame_names(1, 60);
        wanted.sort();
        assert_eq!(converted, wanted, "each once");

        // The daemon must end on request, also while frames in flight are blocked.
        land_sequence(&disk, 61, 90, 12);
        daemon.until_converted(&frame_names(61, 61));
        mount.stop();
        daemon.listen_for(Duration::from_secs(1));
        daemon.signal("TERM");
        daemon.until_exited(SOON);
        // After the unmount, the blocked calls fail, so the kernel can remove the process.
        drop(mount);
        daemon.until_ended();
        assert!(!daemon.log.iter().any(|line| message(line).contains("panicked")));
    });
}

/// The response of the status page.
fn get(address: &str, path: &str) -> String {
    let mut stream = TcpStream::connect(address).expect("it listens");
    stream.set_read_timeout(Some(SOON)).expect("a timeout");
    write!(stream, "GET {path} HTTP/1.1\r\nHost: {address}\r\nConnection: close\r\n\r\n").expect("sent");
    let mut answer = String::new();
    stream.read_to_string(&mut answer).expect("an answer");
    assert!(answer.starts_with("HTTP/1.1 200"), "{answer}");
    answer
}
