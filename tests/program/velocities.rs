//! Velocities that are computed from the frames before and after, and frame rates that contradict the motion.

use std::fs;
use std::path::Path;

use tempfile::tempdir;

use super::rest::{numbers, vertices};
use crate::program::scene::{RunResult, block, meniscus};

/// Where four frames of a block are along x: the last one moves twice as far as the others.
const MOVED: [f64; 4] = [0.0, 0.25, 0.5, 1.0];

/// Writes frames of a block that moves along x, with these columns after the positions.
fn write(folder: &Path, moved: &[f64], columns: &str, values: impl Fn(usize) -> String) {
    fs::create_dir_all(folder.join("in")).expect("made");
    for (frame, moved) in moved.iter().enumerate() {
        let mut text = format!("x,y,z{columns}\n");
        let particles = block(6, 0.0);
        for index in 0..particles.len() {
            // With ids, each frame has the particles in another order.
            let particle = if columns.is_empty() { index } else { (index + 5 * frame) % particles.len() };
            let [x, y, z] = particles[particle];
            text += &format!("{},{y},{z}{}\n", x + moved, values(particle));
        }
        fs::write(folder.join(format!("in/block.{}.csv", frame + 1)), text).expect("written");
    }
}

fn convert(folder: &Path, more: &[&str]) -> RunResult {
    let fixed = ["convert", "in", "--out", "out", "--format", "ply", "--spacing", "0.1"];
    let result = meniscus(folder, &[&fixed[..], more].concat());
    assert_eq!(result.status, 0, "{}{}", result.out, result.err);
    result
}

/// The mean velocity of the vertices along x, which all have the same.
fn along_x(folder: &Path, number: i64) -> f64 {
    let values = numbers(&vertices(&folder.join("out"), number), "v");
    let along: Vec<f64> = values.iter().step_by(3).copied().collect();
    let mean = along.iter().sum::<f64>() / along.len() as f64;
    assert!(along.iter().all(|value| (value - mean).abs() < 1e-3), "{number}: {along:?}");
    mean
}

const COMPUTED: [&str; 4] = ["--attributes", "velocity", "--time-step", "0.5"];

#[test]
fn velocities_are_computed_from_the_frames_around() {
    let folder = tempdir().expect("a folder");
    let folder = folder.path();
    write(folder, &MOVED, ",id", |particle| format!(",{particle}"));
    let asked = convert(folder, &["--attributes", "velocity"]);
    assert!(
        asked.err.contains("no attribute `velocity`") && asked.err.contains("--time-step"),
        "{}",
        asked.err
    );
    let result = convert(folder, &COMPUTED);
    assert!(!result.err.contains("warning"), "{}", result.err);
    // One-sided at the ends, central between them.
    for (number, expected) in [(1, 0.5), (2, 0.5), (3, 0.75), (4, 1.0)] {
        assert!((along_x(folder, number) - expected).abs() < 1e-3, "{number}");
    }
    // The results depend on the frames around.
    let done = convert(folder, &[&COMPUTED[..], &["--skip-done"]].concat());
    assert!(done.out.contains("in/block.4.csv: done already"), "{}", done.out);
    let verify = |status: i32| {
        let result = meniscus(folder, &["verify", "out", "--input", "in"]);
        assert_eq!(result.status, status, "{}{}", result.out, result.err);
        result.err
    };
    verify(0);
    fs::remove_file(folder.join("in/block.4.csv")).expect("removed");
    assert!(verify(1).contains("block.3"));
    convert(folder, &["--attributes", "speed", "--time-step", "0.5"]);
    let speeds = numbers(&vertices(&folder.join("out"), 2), "speed");
    assert!(speeds.iter().all(|speed| (speed - 0.5).abs() < 1e-3), "{speeds:?}");
    for number in [2, 3] {
        fs::remove_file(folder.join(format!("in/block.{number}.csv"))).expect("removed");
    }
    let alone = convert(folder, &[&COMPUTED[..], &["--frames", "1"]].concat());
    assert!(alone.err.contains("there is no frame with the number before or after"), "{}", alone.err);
}

#[test]
fn particles_without_ids_are_followed_by_their_order() {
    let folder = tempdir().expect("a folder");
    let folder = folder.path();
    write(folder, &MOVED, "", |_| String::new());
    let result = convert(folder, &COMPUTED);
    assert!(result.err.contains("all frames had them in the same order"), "{}", result.err);
    assert!((along_x(folder, 2) - 0.5).abs() < 1e-3);
    // A frame with another number of particles is in no such order.
    fs::write(folder.join("in/block.1.csv"), "x,y,z\n0,0,0\n0.1,0,0\n").expect("written");
    let result = convert(folder, &[&COMPUTED[..], &["--frames", "1"]].concat());
    assert!(result.err.contains("velocities are not computed"), "{}", result.err);
}

#[test]
fn times_that_contradict_the_motion_are_named() {
    let folder = tempdir().expect("a folder");
    let folder = folder.path();
    // Velocities in units per frame of 0.5 s, as if it were 1 s.
    let moved = [0.0, 0.25, 0.5, 0.75];
    write(folder, &moved, ",id,vx,vy,vz", |particle| format!(",{particle},0.25,0,0"));
    let result = convert(folder, &COMPUTED);
    assert!(result.err.contains("1 seconds apart, not 0.5"), "{}", result.err);
    assert!(result.err.contains("--velocity-scale 2 "), "{}", result.err);
    // Those of the file are kept.
    assert!((along_x(folder, 2) - 0.25).abs() < 1e-3);
    let result = convert(folder, &[&COMPUTED[..], &["--velocity-scale", "2"]].concat());
    assert!(!result.err.contains("apart"), "{}", result.err);
    let staged = |more: &[&str]| {
        let stage = ["--format", "usdc", "--stage", "block.usda", "--attributes", "velocity"];
        let fixed = ["convert", "in", "--out", "staged", "--spacing", "0.1"];
        meniscus(folder, &[&fixed[..], &stage, more].concat())
    };
    let result = staged(&[]);
    assert!(
        result.err.contains("as at 1 frames per second, and they are shown at 24: give --fps 1,"),
        "{}",
        result.err
    );
    assert!(result.err.contains("--velocity-scale 24 "), "{}", result.err);
    for agreeing in [["--fps", "1"], ["--velocity-scale", "24"]] {
        let result = staged(&agreeing);
        assert!(!result.err.contains("frames per second"), "{}", result.err);
    }
}

#[test]
fn frames_that_accelerate_or_have_wild_numbers_cause_no_warning() {
    let folder = tempdir().expect("a folder");
    let folder = folder.path();
    // Free fall along x, with exact velocities: the way after a frame is not that before it.
    let moved: Vec<f64> = (0..4).map(|frame| 0.02 * f64::from(frame * frame)).collect();
    write(folder, &moved, ",id,vx,vy,vz", |particle| format!(",{particle},FALL,0,0"));
    for frame in 0..4 {
        let path = folder.join(format!("in/block.{}.csv", frame + 1));
        let text = fs::read_to_string(&path).expect("written");
        fs::write(&path, text.replace("FALL", &format!("{}", 0.08 * f64::from(frame)))).expect("written");
    }
    let stage = ["--format", "usdc", "--stage", "block.usda", "--fps", "2"];
    let result = convert(folder, &[&COMPUTED[..], &stage].concat());
    assert!(!result.err.contains("warning"), "{}", result.err);
    for names in [["1", "2", "9223372036854775807"], ["-9223372036854775807", "5", "6"]] {
        for entry in fs::read_dir(folder.join("in")).expect("a folder") {
            fs::remove_file(entry.expect("a file").path()).expect("removed");
        }
        for name in names {
            let rows = "0,0,0,1,1,0,0\n0.1,0,0,2,1,0,0\n";
            fs::write(folder.join(format!("in/f.{name}.csv")), format!("x,y,z,id,vx,vy,vz\n{rows}"))
                .expect("written");
        }
        let result = convert(folder, &[&COMPUTED[..], &stage].concat());
        assert!(!result.err.contains("frames per second"), "{}", result.err);
    }
}

#[test]
fn averaged_frames_are_the_same_however_they_are_chosen() {
    let folder = tempdir().expect("a folder");
    let folder = folder.path();
    write(folder, &MOVED, "", |_| String::new());
    let averaged = [&COMPUTED[..], &["--temporal", "1"]].concat();
    convert(folder, &averaged);
    let read =
        || (1..=4).map(|number| fs::read(folder.join(format!("out/block.{number}.ply"))).expect("written"));
    let whole: Vec<Vec<u8>> = read().collect();
    for number in ["1", "2", "3", "4"] {
        convert(folder, &[&averaged[..], &["--frames", number]].concat());
    }
    assert!(read().eq(whole));
}

#[test]
fn watched_frames_get_the_same_velocities() {
    let folder = tempdir().expect("a folder");
    let folder = folder.path();
    write(folder, &MOVED, ",id", |particle| format!(",{particle}"));
    convert(folder, &COMPUTED);
    let options = ["--format", "ply", "--spacing", "0.1", "--once", "--settle", "10ms"];
    let watch = [&["watch", "in", "--out", "watched"], &options[..], &COMPUTED].concat();
    let result = meniscus(folder, &watch);
    assert_eq!(result.status, 0, "{}{}", result.out, result.err);
    for number in 1..=4 {
        let [converted, watched] = ["out", "watched"]
            .map(|out| fs::read(folder.join(format!("{out}/block.{number}.ply"))).expect("written"));
        assert!(converted == watched, "{number}");
    }
}
