//! One voxel size for a sequence, whatever the order in which its frames arrive or are converted.

use std::fs::{FileTimes, OpenOptions};
use std::time::{Duration, SystemTime};

use crate::daemon::scene::{Line, Once, Scene, block, contents, ply};

const FORMATS: [&str; 2] = ["--format", "obj,vdb"];
const QUICK: [&str; 2] = ["--settle", "50ms"];

fn once(scene: &Scene, more: &[&str]) -> Once {
    let once = scene.once(&[&QUICK[..], &FORMATS, more].concat());
    once.assert_status(0);
    once
}

/// Writes a sequence whose first two frames have a spacing that rounds to 0.11, and the later ones a spacing
/// of 0.1.
fn put_shrinking(scene: &Scene, numbers: impl IntoIterator<Item = usize>) {
    for number in numbers {
        let spacing = if number <= 2 { 0.108 } else { 0.1 };
        scene.put(&format!("in/dam.{number}.ply"), ply(&block(6, spacing, 0.025 * number as f32)));
    }
}

/// The first frames have a different spacing. One of them is removed before the daemon restarts, and the
/// voxel size stays the same.
#[test]
fn voxel_size_stays_after_a_restart_without_its_frame() {
    let scene = Scene::new();
    put_shrinking(&scene, 1..=4);
    let result = scene.run(&[&["convert", "in", "--out", "all"], &FORMATS[..]].concat());
    assert_eq!(result.status, Some(0), "{}", result.err);
    let expected = contents(&scene.path("all"));
    for number in 3..=4 {
        scene.remove(&format!("in/dam.{number}.ply"));
    }
    once(&scene, &[]);
    scene.remove("in/dam.1.ply");
    // Frames arrive while no daemon runs, and while a daemon runs.
    put_shrinking(&scene, [3]);
    let daemon = scene.watch(&[&QUICK[..], &FORMATS].concat());
    daemon.await_converted("dam.3.ply");
    put_shrinking(&scene, [4]);
    daemon.await_converted("dam.4.ply");
    assert_eq!(daemon.finish().iter().filter(|line| line.is_converted()).count(), 2);
    assert!(contents(&scene.path("out")) == expected);
}

/// A frame that sorts before all others, but is still being written, decides the voxel size: the others wait.
#[test]
fn frames_wait_for_the_first_one() {
    let scene = Scene::new();
    let daemon = scene.watch(&[&QUICK[..], &FORMATS].concat());
    // If the first frame is measured, the spacing rounds to 0.11; without it, to 0.1.
    let frame = |spacing: f32, number: usize| ply(&block(6, spacing, 0.025 * number as f32));
    let first = frame(0.108, 1);
    scene.write("in/dam.1.ply", &first[..1000]);
    scene.put("in/dam.2.ply", frame(0.1, 2));
    scene.put("in/dam.3.ply", frame(0.108, 3));
    // Another sequence does not wait. When it is done, a daemon that did not wait would have converted the
    // frames of the first sequence, too.
    scene.put("in/drop.1.ply", ply(&block(5, 0.1, 0.0)));
    daemon.await_converted("drop.1.ply");
    assert_eq!(daemon.lines(Line::is_converted).len(), 1, "{}", daemon.log_text());
    scene.write("in/dam.1.ply", &first);
    daemon.await_lines(4, "all are converted", Line::is_converted);
    daemon.assert_no_complaints();
    daemon.finish();
    scene.assert_as_converted(&FORMATS);
}

/// A frame of one particle has no spacing, and no preset can be chosen by it; eight particles say little of others.
/// They wait for a frame with more particles.
#[test]
fn frames_of_few_particles_wait_for_one_that_can_be_measured() {
    for (options, report, remedy) in [
        (&[][..], "cannot measure the particle spacing yet", "--spacing"),
        (
            &["--spacing", "0.12", "--preset", "auto"],
            "cannot choose the preset by the particles yet",
            "--preset",
        ),
    ] {
        let options = [&FORMATS[..], options].concat();
        let scene = Scene::new();
        let daemon = scene.watch(&[&QUICK[..], &options].concat());
        for number in 1..=2 {
            scene.put(&format!("in/dam.{number}.ply"), ply(&block(number, 0.3, 0.0)));
        }
        scene.put("in/dam.3.ply", ply(&block(10, 0.12, 0.0)));
        daemon.await_lines(3, "all are converted", Line::is_converted);
        let is_report = |line: &Line| line.message.contains(report);
        let complaints = daemon.lines(Line::is_complaint);
        assert!(complaints.len() <= 1 && complaints.iter().all(is_report), "{}", daemon.log_text());
        daemon.finish();
        scene.assert_as_converted(&options);
        // If no frame can be measured, all fail, and each failure is logged once.
        let scene = Scene::new();
        scene.put("in/dam.1.ply", ply(&block(1, 0.1, 0.0)));
        let none = scene.once(&[&QUICK[..], &options].concat());
        none.assert_status(2);
        assert!(none.log.iter().any(|line| line.message.contains(remedy)));
    }
}

/// The outputs do not depend on which frame is converted first.
#[test]
fn newest_first_gives_the_same_outputs() {
    let scene = Scene::new();
    scene.put_moving(1..=12);
    for number in 1..=12 {
        let path = scene.path(&format!("in/dam.{number}.ply"));
        let written = SystemTime::now() - Duration::from_secs(100 - number);
        let file = OpenOptions::new().write(true).open(path).expect("opened");
        file.set_times(FileTimes::new().set_modified(written)).expect("changed");
    }
    // All frames are old enough not to wait when the daemon starts.
    let once =
        scene.once(&[&["--settle", "1ms", "--order", "latest", "--threads", "1"], &FORMATS[..]].concat());
    once.assert_status(0);
    let converted = once.converted_in_order();
    scene.assert_as_converted(&FORMATS);
    // One or two frames may have been started before the others arrived.
    let rank = |number: usize| {
        let name = format!("dam.{number}.ply");
        converted.iter().position(|other| *other == name).expect("converted")
    };
    let latest_first_count = (2..=12).filter(|&number| rank(number) < rank(number - 1)).count();
    assert!(latest_first_count >= 7, "{converted:?}");
}

/// With other settings, the sequence is converted again. With the first settings again, the outputs are the
/// same as at first.
#[test]
fn other_settings_convert_all_frames_again() {
    let scene = Scene::new();
    scene.put_moving(1..=2);
    once(&scene, &[]);
    let before = contents(&scene.path("out"));
    assert_eq!(once(&scene, &["--laplacian-steps", "3"]).converted().len(), 2);
    assert!(contents(&scene.path("out")) != before);
    scene.assert_as_converted(&[&FORMATS[..], &["--laplacian-steps", "3"]].concat());
    assert_eq!(once(&scene, &[]).converted().len(), 2);
    assert!(contents(&scene.path("out")) == before);
    // These options do not affect the outputs: nothing to do.
    assert!(once(&scene, &["--threads", "1", "--order", "latest"]).converted().is_empty());
}
