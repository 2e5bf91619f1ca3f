//! Large frames through little memory: as many at once as there is room for, and one in any case.

use std::fs;
use std::path::Path;
use std::time::{Duration, SystemTime};

use serde_json::Value;
use tempfile::tempdir;

use crate::scene::{
    Daemon, block_ply, frame_names, is_long, land, memory_bytes, message, names_in, stage_seconds, tell,
};

/// The edge of a block of 250 047 particles.
const EDGE_COUNT: usize = 63;

/// Frames `1..=last` of a block that moves.
fn write_frames(folder: &Path, last: usize) {
    let inside = folder.join("in");
    fs::create_dir(&inside).expect("made");
    let frame = block_ply(EDGE_COUNT, 0.0);
    let moved = block_ply(EDGE_COUNT, 0.03);
    for (index, name) in frame_names(1, last).iter().enumerate() {
        land(&inside, name, if index % 2 == 0 { &frame } else { &moved });
    }
}

/// Converts frames `1..=last` within so much memory: how much it took at most, and the lines of the log
/// about the frames.
fn converted_within(memory: &str, last: usize) -> (u64, Vec<Value>) {
    let folder = tempdir().expect("a folder");
    write_frames(folder.path(), last);
    let arguments = ["in", "--out", "out", "--format", "vdb,glb", "--memory", memory, "--disk-floor", "0"];
    let mut daemon = Daemon::start(folder.path(), &arguments);
    daemon.until_converted(&frame_names(1, last));
    let peak_bytes = memory_bytes(daemon.pid(), "VmHWM");
    assert_eq!(names_in(&folder.path().join("out")).len(), 2 * last);
    let lines = daemon.log.iter().filter(|line| message(line) == "converted").cloned().collect();
    daemon.stop();
    (peak_bytes, lines)
}

#[test]
fn frames_share_the_memory_that_they_may_have() {
    let (peak_bytes, lines) = converted_within("1GiB", if is_long() { 200 } else { 8 });
    let allowed_bytes = (1 << 30) + (1 << 30) / 10;
    assert!(peak_bytes <= allowed_bytes, "{} MiB", peak_bytes >> 20);
    let overlap_count = overlap_count(&lines);
    assert!(overlap_count > 0, "{lines:#?}");
    tell(&format!(
        "{} frames of 250 047 particles within 1 GiB took {} MiB; {overlap_count} began before another ended",
        lines.len(),
        peak_bytes >> 20
    ));
}

#[test]
fn a_frame_that_is_larger_than_the_memory_runs_alone() {
    let (peak_bytes, lines) = converted_within("50MiB", if is_long() { 20 } else { 2 });
    assert_eq!(overlap_count(&lines), 0, "{lines:#?}");
    // More than it may have, for less is not enough; and less than two at once take.
    assert!((50 << 20..256 << 20).contains(&peak_bytes), "{} MiB", peak_bytes >> 20);
}

/// How many frames were begun before the one before them had ended. Waiting between stages is not in
/// their seconds: so they began at the latest so long before they ended.
fn overlap_count(lines: &[Value]) -> usize {
    let overlaps = |pair: &&[Value]| {
        let computing_seconds = stage_seconds(&pair[1]) - pair[1]["read_s"].as_f64().expect("seconds");
        let began = ended_at(&pair[1]) - Duration::from_secs_f64(computing_seconds);
        // The log is written a moment after the frame.
        began + LOG_DELAY < ended_at(&pair[0])
    };
    lines.windows(2).filter(overlaps).count()
}

const LOG_DELAY: Duration = Duration::from_millis(100);

/// When a line of the log was written.
fn ended_at(line: &Value) -> SystemTime {
    let time = line["timestamp"].as_str().expect("a time");
    humantime::parse_rfc3339(time).expect("a time")
}
