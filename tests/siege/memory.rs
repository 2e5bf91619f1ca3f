//! Large frames with little memory: as many frames run at once as fit, and a frame that does not fit is
//! reconstructed in tiles.

use std::fs;
use std::os::unix::fs::MetadataExt;
use std::path::Path;

use serde_json::Value;
use tempfile::tempdir;

use crate::siege::scene::{
    Daemon, assert_same_outputs, block_ply, box_ply, convert, frame_name, frame_names, is_long, land,
    memory_bytes, meniscus, message, names_in, print_line, stage_seconds,
};

/// Number of particles along the edge of a block, which has 250 047 particles.
const EDGE_COUNT: usize = 63;

/// Number of particles along the edges of a beam: a tile contains only a small part of it.
const BEAM_COUNTS: [usize; 3] = [1000, 6, 6];

/// Writes frames `1..=last`: they alternate between a shape and the same shape moved.
fn write_frames(folder: &Path, [frame, moved]: [Vec<u8>; 2], last: usize) {
    let inside = folder.join("in");
    fs::create_dir(&inside).expect("made");
    for (index, name) in frame_names(1, last).iter().enumerate() {
        land(&inside, name, if index % 2 == 0 { &frame } else { &moved });
    }
}

/// Converts frames `1..=last` within this memory; returns the peak memory and the lines of the log about the
/// frames.
fn converted_within(folder: &Path, memory: &str, last: usize) -> (u64, Vec<Value>) {
    let arguments = ["in", "--out", "out", "--format", "vdb,glb", "--memory", memory, "--disk-floor", "0"];
    let mut daemon = Daemon::start(folder, &arguments);
    daemon.until_converted(&frame_names(1, last));
    let peak_bytes = memory_bytes(daemon.pid(), "VmHWM");
    assert_eq!(names_in(&folder.join("out")).len(), 2 * last);
    let lines = daemon.log.iter().filter(|line| message(line) == "converted").cloned().collect();
    daemon.stop();
    (peak_bytes, lines)
}

#[test]
#[ignore = "slow: `.ci/full slow` runs it"]
fn frames_share_the_memory_limit() {
    let folder = tempdir().expect("a folder");
    let last = if is_long() { 200 } else { 8 };
    write_frames(folder.path(), [0.0, 0.03].map(|shift| block_ply(EDGE_COUNT, shift)), last);
    let (peak_bytes, lines) = converted_within(folder.path(), "1GiB", last);
    let allowed_bytes = (1 << 30) + (1 << 30) / 10;
    assert!(peak_bytes <= allowed_bytes, "{} MiB", peak_bytes >> 20);
    let overlap_count = overlap_count(folder.path(), &lines);
    assert!(overlap_count > 0, "{lines:#?}");
    print_line(&format!(
        "{} frames of 250 047 particles within 1 GiB took {} MiB; {overlap_count} began before another ended",
        lines.len(),
        peak_bytes >> 20
    ));
}

#[test]
#[ignore = "slow: `.ci/full slow` runs it"]
fn frame_larger_than_the_memory_is_converted_in_tiles() {
    let folder = tempdir().expect("a folder");
    let last = if is_long() { 20 } else { 2 };
    write_frames(folder.path(), [0.0, 0.03].map(|shift| box_ply(BEAM_COUNTS, shift)), last);
    let least = mebibytes_needed(folder.path());
    let (peak_bytes, lines) = converted_within(folder.path(), &format!("{least}MiB"), last);
    assert_eq!(overlap_count(folder.path(), &lines), 0, "{lines:#?}");
    let report = folder.path().join("report.json");
    let arguments = ["--format", "vdb,glb", "--report", "report.json"];
    convert(folder.path(), "whole", &arguments);
    assert_same_outputs(&folder.path().join("out"), &folder.path().join("whole"));
    let report: Value = serde_json::from_slice(&fs::read(report).expect("readable")).expect("JSON");
    let whole_bytes = report["frames"][0]["peak_memory_bytes"].as_u64().expect("a number");
    assert!(peak_bytes < whole_bytes, "{} MiB, {} MiB whole", peak_bytes >> 20, whole_bytes >> 20);
    print_line(&format!(
        "{last} frames that take {} MiB whole took {} MiB in tiles, of {least} MiB",
        whole_bytes >> 20,
        peak_bytes >> 20
    ));
}

/// The number of mebibytes that the largest frame in `in` needs at least, according to the message.
fn mebibytes_needed(folder: &Path) -> u64 {
    let arguments = ["convert", "in", "--out", "refused", "--memory", "1MiB"];
    let output = meniscus(folder).args(arguments).output().expect("it starts");
    let err = String::from_utf8_lossy(&output.stderr);
    assert!(!output.status.success() && err.contains("dam.1.ply"), "{err}");
    let needs = err.split("the frame needs at least ").skip(1);
    let number = |after: &str| after.split(' ').next().and_then(|number| number.parse().ok());
    needs.map(|after| number(after).expect("a number")).max().unwrap_or_else(|| panic!("{err}"))
}

/// The number of frames that had done a good part of their work before the outputs of the frame before them
/// were in place. The seconds of the stages do not include waiting. So a frame began at least this long
/// before its own outputs were in place.
fn overlap_count(folder: &Path, lines: &[Value]) -> usize {
    let overlaps = |pair: &&[Value]| {
        let computing_seconds = stage_seconds(&pair[1]) - pair[1]["read_s"].as_f64().expect("seconds");
        let [first, second] = [&pair[0], &pair[1]].map(|line| in_place_at(folder, line));
        second - 0.75 * computing_seconds < first
    };
    lines.windows(2).filter(overlaps).count()
}

/// The time at which the outputs of a frame got their names, in seconds. (On a busy machine, the log may be
/// later.)
fn in_place_at(folder: &Path, line: &Value) -> f64 {
    let name = frame_name(line);
    let stem = name.strip_suffix(".ply").expect("a .ply");
    let renamed_at = |extension: &str| {
        let output = folder.join(format!("out/{stem}.{extension}"));
        let metadata = output.metadata().expect("an output");
        metadata.ctime() as f64 + 1e-9 * metadata.ctime_nsec() as f64
    };
    renamed_at("vdb").max(renamed_at("glb"))
}
