//! Files from the past and from the future, and clocks that change while the command runs.

use std::fs::{self, File};
use std::process::Command;
use std::time::{Duration, SystemTime};

use crate::hostile::scene::{RunResult, Scene, block_ply, print_line};

const YEAR: Duration = Duration::from_secs(365 * 24 * 3600);

/// Sets the modification time of a file.
fn set(scene: &Scene, within: &str, time: SystemTime) {
    let file = File::options().write(true).open(scene.path(within)).expect("there");
    file.set_modified(time).expect("set");
}

/// Extreme modification times that a file system may return.
fn times() -> [SystemTime; 5] {
    let start = SystemTime::UNIX_EPOCH;
    [
        start,
        start - 10 * YEAR,
        start + 130 * YEAR,
        start + 400 * YEAR,
        SystemTime::now() + Duration::from_secs(30),
    ]
}

const WATCH: [&str; 11] =
    ["watch", "in", "--once", "--out", "out", "--voxel-size", "0.1", "--format", "obj", "--settle", "100ms"];

#[test]
fn frames_of_any_time_are_converted_once() {
    let convert = ["convert", "in", "--out", "out", "--voxel-size", "0.1", "--format", "obj", "--skip-done"];
    for arguments in [&WATCH[..], &convert] {
        let scene = Scene::new();
        for (number, time) in times().into_iter().enumerate() {
            let name = format!("in/odd.{number}.ply");
            scene.write(&name, block_ply(number as f32));
            set(&scene, &name, time);
        }
        let result = scene.run(arguments);
        assert_eq!(result.status, Some(0), "{}", result.err);
        scene.assert_good_frames_are_there();
        let written =
            |number| fs::metadata(scene.path(format!("out/odd.{number}.obj"))).expect("there").modified();
        let before: Vec<_> = (0..times().len()).map(|number| written(number).expect("a time")).collect();
        let again = scene.run(arguments);
        assert_eq!(again.status, Some(0), "{}", again.err);
        let after: Vec<_> = (0..times().len()).map(|number| written(number).expect("a time")).collect();
        assert_eq!(before, after, "{}", again.err);
    }
}

/// A rewritten frame with an earlier modification time still counts as changed.
#[test]
fn frame_with_an_earlier_time_is_converted_again() {
    let scene = Scene::new();
    assert_eq!(scene.run(&WATCH).status, Some(0));
    for (shift, time) in times().into_iter().enumerate() {
        let before = fs::read(scene.path("out/dam.1.obj")).expect("there");
        scene.write("in/dam.1.ply", block_ply(10.0 + shift as f32));
        set(&scene, "in/dam.1.ply", time);
        let result = scene.run(&WATCH);
        assert_eq!(result.status, Some(0), "{}", result.err);
        assert!(fs::read(scene.path("out/dam.1.obj")).expect("there") != before, "{shift}: {}", result.err);
    }
}

/// Runs the daemon with a changed system clock; `None` if the clock cannot be changed.
fn run_at(scene: &Scene, clock: &[&str]) -> Option<RunResult> {
    if !Command::new("faketime").args(["2001-01-01", "true"]).status().is_ok_and(|status| status.success()) {
        print_line("not tested: faketime is missing");
        return None;
    }
    let mut command = Command::new("faketime");
    // The program measures durations with the monotonic clock, which cannot be set.
    command
        .env("FAKETIME_DONT_FAKE_MONOTONIC", "1")
        .args(clock)
        .arg(env!("CARGO_BIN_EXE_meniscus"))
        .args(WATCH);
    Some(scene.run_command(command))
}

/// The system clock jumps between runs, or runs ten times too fast or a thousand times too slowly.
#[test]
fn daemon_continues_when_the_clock_is_set() {
    let scene = Scene::new();
    let clocks: [&[&str]; 5] = [
        &["2100-01-01"],
        &["1971-01-01"],
        &["-f", "+0 x1000"],
        &["-f", "+0 x0.01"],
        &["-f", "@2030-01-01 00:00:00 i2.0"],
    ];
    for (number, clock) in clocks.into_iter().enumerate() {
        let name = format!("in/late.{number}.ply");
        scene.write(&name, block_ply(number as f32));
        let Some(result) = run_at(&scene, clock) else { return };
        assert_eq!(result.status, Some(0), "{clock:?}: {}", result.err);
        assert!(scene.path(format!("out/late.{number}.obj")).is_file(), "{clock:?}: {}", result.err);
    }
    scene.assert_good_frames_are_there();
}
