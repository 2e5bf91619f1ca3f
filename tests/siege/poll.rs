//! Tests that periodic scans find frames without file-system events.

use std::fs;

use tempfile::tempdir;

use crate::siege::scene::{Daemon, frame_names, land_sequence, names_in};

/// The number of folders for which the daemon has requested events.
fn watched_folder_count(daemon: &Daemon) -> usize {
    let infos = fs::read_dir(format!("/proc/{}/fdinfo", daemon.pid())).expect("it runs");
    let texts = infos.flatten().filter_map(|info| fs::read_to_string(info.path()).ok());
    texts.map(|text| text.lines().filter(|line| line.starts_with("inotify wd:")).count()).sum()
}

#[test]
fn frames_are_found_without_events() {
    let folder = tempdir().expect("a folder");
    fs::create_dir_all(folder.path().join("in/sub")).expect("made");
    let arguments = ["in", "--out", "out", "--pattern", "**", "--settle", "50ms"];
    for (poll, watched, first) in [(None, 2, 1), (Some("200ms"), 0, 3)] {
        let poll = poll.map_or(vec![], |interval| vec!["--poll", interval]);
        let mut daemon = Daemon::start_ready(folder.path(), &[&arguments[..], &poll].concat());
        assert_eq!(watched_folder_count(&daemon), watched);
        land_sequence(&folder.path().join("in"), first, first, 5);
        land_sequence(&folder.path().join("in/sub"), first + 1, first + 1, 5);
        daemon.until_converted(&frame_names(first, first + 1));
        assert_eq!(daemon.converted().len(), 2);
        daemon.stop();
    }
    assert_eq!(names_in(&folder.path().join("out/sub")).len(), 4);
}
