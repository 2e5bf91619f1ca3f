//! A disk that fills up during a run, or is too full from the start.
//!
//! ```text
//!   in/     frames                                          on the usual disk
//!   out/    outputs, the records, and a ballast file        on a small separate disk
//!   wanted/ outputs of the one-shot command for comparison
//! ```

use std::fs::{self, File};
use std::io::{ErrorKind, Write};
use std::path::{Path, PathBuf};

use tempfile::{TempDir, tempdir};

use crate::siege::mounts::{mount_tmpfs, with_own_mounts};
use crate::siege::scene::{
    Daemon, assert_counts, assert_same_output, assert_same_outputs, assert_state, convert, frame_names,
    is_long, land_sequence, names_in, status,
};

/// A folder with frames, and a small disk for their outputs.
struct Siege {
    folder: TempDir,
    frames: Vec<String>,
}

/// Size of the small disk: space for about a hundred of the frames in these tests.
const DISK_BYTES: u64 = 8 << 20;

impl Siege {
    fn new(frame_count: usize) -> Siege {
        let folder = tempdir().expect("a folder");
        let path = folder.path();
        for name in ["in", "out"] {
            fs::create_dir(path.join(name)).expect("made");
        }
        land_sequence(&path.join("in"), 1, frame_count, 6);
        convert(path, "wanted", &[]);
        mount_tmpfs(&path.join("out"), DISK_BYTES);
        Siege { folder, frames: frame_names(1, frame_count) }
    }

    fn path(&self) -> &Path {
        self.folder.path()
    }

    fn out(&self) -> PathBuf {
        self.path().join("out")
    }

    /// Fills the disk, except for this number of bytes.
    fn fill_up_to(&self, free_bytes: u64) {
        let mut filler = File::create(self.out().join("ballast")).expect("made");
        let bytes = usize::try_from(DISK_BYTES - free_bytes).expect("small");
        filler.write_all(&vec![1; bytes]).expect("there is room for it");
    }

    /// Fills the disk to the last byte.
    fn fill_up(&self) {
        let mut filler = File::create(self.out().join("ballast")).expect("made");
        let piece = [1; 1 << 12];
        let error = (0..).find_map(|_| filler.write(&piece).err()).expect("the disk is not endless");
        assert_eq!(error.kind(), ErrorKind::StorageFull, "{error}");
    }

    fn free_space(&self) {
        fs::remove_file(self.out().join("ballast")).expect("removed");
    }

    /// The existing outputs, each of which must be complete.
    fn outputs(&self) -> Vec<String> {
        let visible = names_in(&self.out()).into_iter().filter(|name| !name.starts_with('.'));
        let outputs: Vec<String> = visible.filter(|name| name != "ballast").collect();
        for name in &outputs {
            assert_same_output(&self.out().join(name), &self.path().join("wanted").join(name));
        }
        outputs
    }

    /// Asserts that all outputs exist and are recorded, and that a restart converts nothing again.
    fn is_complete(&self) {
        let count = self.frames.len() as u64;
        assert_same_outputs(&self.out(), &self.path().join("wanted"));
        assert_counts(self.path(), [count, 0, 0, 0]);
        assert_eq!(status(self.path())["failed"].as_array().map(Vec::len), Some(0));
        let mut again = Daemon::start(self.path(), &["in", "--out", "out", "--once", "--disk-floor", "0"]);
        again.until_drained();
        assert_eq!(again.converted(), [""; 0]);
        assert_counts(self.path(), [count, 0, 0, 0]);
    }
}

/// Whether a daemon has reported that it waits for space.
fn is_paused(daemon: &Daemon) -> bool {
    daemon.count_logged("paused") > 0 && daemon.has_status("paused")
}

#[test]
fn daemon_waits_while_the_disk_is_full() {
    with_own_mounts("disk::daemon_waits_while_the_disk_is_full", || {
        let siege = Siege::new(if is_long() { 60 } else { 16 });
        siege.fill_up_to(192 << 10);
        let mut daemon = Daemon::start(siege.path(), &["in", "--out", "out", "--disk-floor", "0"]);
        daemon.until("it says that it is paused", is_paused);
        assert!(siege.outputs().len() < 2 * siege.frames.len());
        assert_eq!(status(siege.path())["counts"]["failed"], 0);
        if is_long() {
            // The daemon retries from time to time, and does not count this as a failure of the frame.
            daemon.until("it tries again", |daemon| daemon.count_logged("paused") > 8);
            siege.outputs();
        }
        siege.free_space();
        daemon.until_converted(&siege.frames);
        daemon.until("it is not paused any more", |daemon| !daemon.has_status("paused"));
        assert_eq!(daemon.converted().len(), siege.frames.len());
        daemon.stop();
        siege.is_complete();
    });
}

#[test]
fn records_on_a_full_disk_continue_later() {
    with_own_mounts("disk::records_on_a_full_disk_continue_later", || {
        let siege = Siege::new(24);
        let [inside, later] = ["in", "later"].map(|name| siege.path().join(name));
        fs::rename(&inside, &later).expect("renamed");
        fs::create_dir(&inside).expect("made");
        let move_in = |names: &[String]| {
            for name in names {
                fs::rename(later.join(name), inside.join(name)).expect("renamed");
            }
        };
        let (first, second) = siege.frames.split_at(4);
        move_in(first);
        let mut daemon = Daemon::start(siege.path(), &["in", "--out", "out", "--disk-floor", "0"]);
        daemon.until_converted(first);
        daemon.until("all is written down", |daemon| daemon.has_status("4 done"));
        siege.fill_up();
        // More frames than fit into the last page of the records.
        move_in(second);
        daemon.until("it says that it is paused", is_paused);
        daemon.until("all frames wait", |daemon| daemon.has_status("4 done, 20 queued; paused"));
        // The message appears once, not for each line.
        assert_eq!(daemon.count_logged("cannot write records"), 1);
        assert_eq!(siege.outputs().len(), 2 * first.len());
        siege.free_space();
        daemon.until_converted(second);
        assert_eq!(daemon.converted().len(), siege.frames.len());
        assert_eq!(daemon.count_logged("records can be written again"), 1);
        daemon.until("all is written down", |daemon| daemon.has_status("24 done, 0 queued"));
        assert_counts(siege.path(), [24, 0, 0, 0]);
        assert_state(siege.path(), "running");
        daemon.stop();
        siege.is_complete();
    });
}

#[test]
fn outputs_that_fill_the_disk_stop_at_the_floor() {
    with_own_mounts("disk::outputs_that_fill_the_disk_stop_at_the_floor", || {
        let siege = Siege::new(24);
        siege.fill_up_to(3 << 20);
        let floor = ["in", "--out", "out", "--disk-floor", "2MiB", "--threads", "1"];
        let mut daemon = Daemon::start(siege.path(), &floor);
        daemon.until("it says that it is paused", is_paused);
        // There is room for records.
        assert_state(siege.path(), "paused");
        let converted = daemon.converted();
        assert!(!converted.is_empty() && converted.len() < siege.frames.len(), "{converted:?}");
        // The frames are small: no frame uses up all of the minimum free space of the disk.
        assert_eq!(daemon.count_logged("No space"), 0);
        siege.outputs();
        siege.free_space();
        daemon.until_converted(&siege.frames);
        daemon.stop();
        siege.is_complete();
    });
}

#[test]
fn no_frame_starts_below_the_minimum_of_free_space() {
    with_own_mounts("disk::no_frame_starts_below_the_minimum_of_free_space", || {
        let siege = Siege::new(4);
        siege.fill_up_to(3 << 20);
        let mut daemon = Daemon::start(siege.path(), &["in", "--out", "out", "--disk-floor", "4MiB"]);
        daemon.until("it says that it is paused", is_paused);
        daemon.until("all frames wait", |daemon| daemon.has_status("4 queued"));
        let why =
            daemon.log.iter().find(|line| line["message"].as_str().is_some_and(|m| m.contains("paused")));
        let why = why.expect("it said so")["message"].as_str().unwrap_or_default().to_owned();
        assert!(why.contains("out has 3.0 MiB free") && why.contains("waiting for 4.0 MiB"), "{why}");
        assert_state(siege.path(), "paused");
        let daemon_status = status(siege.path())["daemon"].clone();
        assert!(
            daemon_status["paused_because"].as_str().is_some_and(|why| why.contains("waiting for 4.0 MiB")),
            "{daemon_status}"
        );
        assert!(siege.outputs().is_empty() && daemon.converted().is_empty());
        siege.free_space();
        daemon.until_converted(&siege.frames);
        daemon.stop();
        siege.is_complete();
    });
}
