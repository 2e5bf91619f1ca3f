//! Many frames that are already converted: the daemon recognizes them quickly, and then is nearly idle.
//!
//! The frames have no particles, so that a real run makes the outputs and the records of 50 000 frames in a
//! minute or two. The daemon must not read the files of done frames again. The test prints the time until the
//! daemon has recognized all frames, but has no limit for this time.

use std::fs;
use std::path::Path;
use std::time::{Duration, Instant};

use tempfile::{TempDir, tempdir};

use crate::siege::scene::{
    Daemon, block_ply, frame_names, is_long, land, memory_bytes, print_line, records_bytes,
};

fn frame_count() -> usize {
    if is_long() { 50_000 } else { 2_000 }
}

/// The voxel size is given, because frames without particles have no spacing to measure.
const ARGUMENTS: [&str; 10] =
    ["in", "--out", "out", "--format", "ply", "--preset", "paper", "--voxel-size", "0.1", "--settle"];

fn arguments<'a>(more: &[&'a str]) -> Vec<&'a str> {
    [&ARGUMENTS[..], &["100ms"], more].concat()
}

/// A folder in which all frames are converted.
fn converted_folder() -> TempDir {
    let folder = tempdir().expect("a folder");
    fs::create_dir(folder.path().join("in")).expect("made");
    let empty = block_ply(0, 0.0);
    for name in frame_names(1, frame_count()) {
        fs::write(folder.path().join("in").join(name), &empty).expect("written");
    }
    let mut daemon = Daemon::start(folder.path(), &arguments(&["--once"]));
    daemon.until_drained();
    assert_eq!(daemon.converted().len(), frame_count());
    folder
}

#[test]
#[ignore = "slow: `.ci/full slow` runs it"]
fn done_frames_cost_little() {
    let folder = converted_folder();
    let path = folder.path();
    let start = Instant::now();
    let mut daemon = Daemon::start_ready(path, &arguments(&[]));
    let wall_seconds = start.elapsed().as_secs_f64();
    let start_seconds = cpu_seconds(daemon.pid());
    // The daemon must read only the records, and no output.
    let records_bytes = records_bytes(path);
    let start_bytes = bytes_read(daemon.pid());
    assert!(start_bytes < 2 * records_bytes + SMALL_FILES_BYTES, "{start_bytes} read of {records_bytes}");
    daemon.until("all are known", |daemon| daemon.has_status(&format!("{} done", frame_count())));
    assert_eq!(daemon.converted(), [""; 0]);

    // Long enough for one full scan.
    let watched = Duration::from_secs(if is_long() { 120 } else { 80 });
    let (before, before_bytes) = (cpu_seconds(daemon.pid()), bytes_read(daemon.pid()));
    daemon.listen_for(watched);
    let share = (cpu_seconds(daemon.pid()) - before) / watched.as_secs_f64();
    let watched_bytes = bytes_read(daemon.pid()) - before_bytes;
    assert!(watched_bytes < SMALL_FILES_BYTES, "{watched_bytes} bytes read while nothing changes");
    let resident_mib = memory_bytes(daemon.pid(), "VmRSS") >> 20;
    daemon.stop();
    print_line(&format!(
        "{} frames are done: ready after {wall_seconds:.3} s, of which it computed {start_seconds:.3} s; \
         then it takes {:.2} % of a core and {resident_mib} MiB",
        frame_count(),
        100.0 * share
    ));
}

/// Allowance for other files that the daemon reads: files in /proc, the lock, the configuration.
const SMALL_FILES_BYTES: u64 = 1 << 20;

/// This number of frames arrives one after the other; the daemon scans the folder a few times for each.
const LANDING_COUNT: usize = 60;

/// Limit of the growth of memory. When a thread finishes its part, the allocator returns free memory beyond
/// this amount. A leak of twenty bytes per frame and scan would reach this amount.
const KEPT_BYTES: u64 = 4 << 20;

#[test]
#[ignore = "slow: `.ci/full slow` runs it"]
fn repeated_scans_do_not_grow_the_memory() {
    let folder = converted_folder();
    let path = folder.path();
    let mut daemon = Daemon::start_ready(path, &arguments(&["--poll", "50ms"]));
    // When the daemon finds a new frame, it has scanned the folder once more.
    let mut look_again = |number: usize| {
        land_one(path, number);
        daemon.until_converted(&frame_names(number, number));
        memory_bytes(daemon.pid(), "VmRSS")
    };
    let first = frame_count() + 1;
    let sizes: Vec<u64> = (first..first + LANDING_COUNT).map(&mut look_again).collect();
    let window = LANDING_COUNT / 3;
    let most = |sizes: &[u64]| sizes.iter().max().copied().unwrap_or_default();
    let least = |sizes: &[u64]| sizes.iter().min().copied().unwrap_or_default();
    let (before, after) = (most(&sizes[..window]), least(&sizes[LANDING_COUNT - window..]));
    print_line(&format!("looking again takes {before} bytes at first, and then {after}: {sizes:?}"));
    assert!(after <= before + KEPT_BYTES, "{before} bytes have become {after}: {sizes:?}");
    assert_eq!(daemon.converted().len(), LANDING_COUNT);
    daemon.stop();
}

fn land_one(folder: &Path, number: usize) {
    land(&folder.join("in"), &frame_names(number, number)[0], &block_ply(0, 0.0));
}

/// The bytes that a process has read from files so far, without the entries of folders.
fn bytes_read(pid: u32) -> u64 {
    let io = fs::read_to_string(format!("/proc/{pid}/io")).expect("it runs");
    let count = io.lines().find_map(|line| line.strip_prefix("rchar: ")).expect("a line");
    count.parse().expect("a number")
}

/// The processor time of a process so far.
fn cpu_seconds(pid: u32) -> f64 {
    let stat = fs::read_to_string(format!("/proc/{pid}/stat")).expect("it runs");
    // The name of the program, in brackets, may have spaces.
    let (_, fields) = stat.rsplit_once(')').expect("a name");
    let ticks = |index: usize| -> f64 {
        fields.split_whitespace().nth(index).and_then(|field| field.parse().ok()).expect("a number")
    };
    (ticks(11) + ticks(12)) / TICKS_PER_SECOND
}

/// The clock ticks that Linux reports to programs, whatever its internal rate.
const TICKS_PER_SECOND: f64 = 100.0;
