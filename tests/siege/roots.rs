//! Folders that vanish, return, return empty, or appear late.
//!
//! In all tests, done frames must stay done. To check that no other frame was queued, a test adds a frame
//! whose name sorts last, so that the daemon converts it last.

use std::fs;
use std::io::ErrorKind;
use std::path::Path;

use tempfile::{TempDir, tempdir};

use crate::siege::mounts::{mount_bind, unmount, with_own_mounts};
use crate::siege::scene::{
    Daemon, assert_counts, assert_same_outputs, assert_status, convert, frame_names, land_sequence, names_in,
};

/// Writes frames `1..=last`, and waits until they are converted.
fn begun(last: usize) -> (TempDir, Daemon) {
    let folder = tempdir().expect("a folder");
    fs::create_dir(folder.path().join("in")).expect("made");
    land_sequence(&folder.path().join("in"), 1, last, 5);
    let mut daemon = Daemon::start(folder.path(), &ARGUMENTS);
    daemon.until_converted(&frame_names(1, last));
    (folder, daemon)
}

const ARGUMENTS: [&str; 5] = ["in", "--out", "out", "--settle", "50ms"];

/// Asserts that frames `1..=last` were converted once each, and that their outputs exist.
fn assert_all_once(folder: &Path, daemon: Daemon, last: usize) {
    let mut converted = daemon.converted();
    converted.sort();
    let mut wanted = frame_names(1, last);
    wanted.sort();
    assert_eq!(converted, wanted);
    daemon.stop();
    assert_counts(folder, [last as u64, 0, 0, 0]);
    convert(folder, "wanted", &[]);
    assert_same_outputs(&folder.join("out"), &folder.join("wanted"));
}

#[test]
fn daemon_waits_for_a_folder_that_was_moved_away() {
    let (folder, mut daemon) = begun(4);
    let [inside, away] = ["in", "away"].map(|name| folder.path().join(name));
    for round in 1..=2 {
        fs::rename(&inside, &away).expect("renamed");
        daemon.until("it is unavailable", |daemon| {
            daemon.count_logged("unavailable") == round && daemon.has_status("is unavailable")
        });
        assert_status(folder.path(), &Some(3 + round as u64), |status| status["counts"]["done"].as_u64());
        // One frame arrives while the folder is away.
        land_sequence(&away, 4 + round, 4 + round, 5);
        fs::rename(&away, &inside).expect("renamed");
        daemon.until_converted(&frame_names(1, 4 + round));
        daemon.until("it is back", |daemon| daemon.count_logged("available again") == round);
    }
    // The daemon receives its events again.
    land_sequence(&inside, 7, 7, 5);
    daemon.until_converted(&frame_names(1, 7));
    assert_all_once(folder.path(), daemon, 7);
}

#[test]
fn daemon_waits_for_an_unmounted_disk() {
    with_own_mounts("roots::daemon_waits_for_an_unmounted_disk", || {
        let folder = tempdir().expect("a folder");
        let [inside, disk] = ["in", "disk"].map(|name| folder.path().join(name));
        for path in [&inside, &disk] {
            fs::create_dir(path).expect("made");
        }
        land_sequence(&disk, 1, 3, 5);
        mount_bind(&disk, &inside);
        let mut daemon = Daemon::start(folder.path(), &ARGUMENTS);
        daemon.until_converted(&frame_names(1, 3));
        unmount(&inside);
        assert!(names_in(&inside).is_empty());
        daemon.until("it is unavailable", |daemon| {
            daemon.count_logged("unavailable") == 1 && daemon.has_status("is unavailable")
        });
        assert_counts(folder.path(), [3, 0, 0, 0]);
        land_sequence(&disk, 4, 4, 5);
        mount_bind(&disk, &inside);
        daemon.until_converted(&frame_names(1, 4));
        land_sequence(&inside, 5, 5, 5);
        daemon.until_converted(&frame_names(1, 5));
        assert_all_once(folder.path(), daemon, 5);
        unmount(&inside);
    });
}

#[test]
fn emptied_folder_keeps_its_outputs() {
    let (folder, mut daemon) = begun(3);
    let inside = folder.path().join("in");
    for name in frame_names(1, 3) {
        fs::remove_file(inside.join(name)).expect("removed");
    }
    land_sequence(&inside, 4, 4, 5);
    daemon.until_converted(&frame_names(1, 4));
    assert_eq!(names_in(&folder.path().join("out")).len(), 8);
    assert_eq!(daemon.converted().len(), 4);
    daemon.stop();
}

#[test]
fn folder_that_returns_empty_is_unavailable() {
    let (folder, mut daemon) = begun(3);
    let [inside, away] = ["in", "away"].map(|name| folder.path().join(name));
    fs::rename(&inside, &away).expect("renamed");
    fs::create_dir(&inside).expect("made");
    daemon.until("it is unavailable", |daemon| daemon.has_status("is unavailable"));
    assert_counts(folder.path(), [3, 0, 0, 0]);
    fs::remove_dir(&inside).expect("it is empty");
    fs::rename(&away, &inside).expect("renamed");
    land_sequence(&inside, 4, 4, 5);
    daemon.until_converted(&frame_names(1, 4));
    assert_all_once(folder.path(), daemon, 4);
}

#[test]
fn folder_may_appear_late() {
    for is_made_before_it_is_filled in [true, false] {
        let folder = tempdir().expect("a folder");
        let inside = folder.path().join("in");
        let mut daemon = Daemon::start_ready(folder.path(), &ARGUMENTS);
        daemon.until("it is unavailable", |daemon| daemon.has_status("is unavailable"));
        if is_made_before_it_is_filled {
            fs::create_dir(&inside).expect("made");
            land_sequence(&inside, 1, 3, 5);
        } else {
            let elsewhere = folder.path().join("elsewhere");
            fs::create_dir(&elsewhere).expect("made");
            land_sequence(&elsewhere, 1, 3, 5);
            fs::rename(&elsewhere, &inside).expect("renamed");
        }
        daemon.until_converted(&frame_names(1, 3));
        assert_all_once(folder.path(), daemon, 3);
    }
}

#[test]
fn removed_outputs_are_made_again() {
    let folder = tempdir().expect("a folder");
    let [inside, out] = ["in", "out"].map(|name| folder.path().join(name));
    fs::create_dir(&inside).expect("made");
    land_sequence(&inside, 1, 3, 5);
    let mut daemon = Daemon::start(folder.path(), &ARGUMENTS);
    daemon.until_converted(&frame_names(1, 3));
    // This removes the records and the lock, too; the daemon may write there at that moment.
    while fs::remove_dir_all(&out).is_err_and(|error| error.kind() == ErrorKind::DirectoryNotEmpty) {}
    land_sequence(&inside, 4, 4, 5);
    daemon.until("all are made again", |daemon| {
        daemon.converted().len() == 7 && daemon.has_status("4 done, 0 queued")
    });
    daemon.stop();
    convert(folder.path(), "wanted", &[]);
    assert_same_outputs(&out, &folder.path().join("wanted"));
    assert_counts(folder.path(), [4, 0, 0, 0]);
}
