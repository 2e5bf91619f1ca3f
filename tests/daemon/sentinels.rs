//! Sentinel files, which mark a frame as complete.

use crate::daemon::scene::{Line, Scene, csv, moving, ply};

const FORMATS: [&str; 2] = ["--format", "obj"];

/// Sentinels with the usual names are optional, but if a frame has one, the daemon treats it as complete.
#[test]
fn usual_sentinel_ends_the_wait() {
    let scene = Scene::new();
    let daemon = scene.watch(&[&["--settle", "1h"][..], &FORMATS].concat());
    scene.write("in/dam.1.ply", ply(&moving(1)));
    scene.write("in/dam.1.done", "");
    daemon.await_converted("dam.1.ply");
    // The format of a table does not show whether the file is complete.
    scene.write("in/dam.2.csv", csv(&moving(2)));
    scene.write("in/dam.2.done", "");
    daemon.await_converted("dam.2.csv");
    daemon.assert_no_complaints();
    daemon.finish();
    scene.assert_as_converted(&FORMATS);
}

/// With `--sentinel`, the daemon waits for the sentinel file, also if the frame was renamed into place, and
/// also after the frame is written again.
#[test]
fn frame_waits_for_its_required_sentinel() {
    let scene = Scene::new();
    let arguments = [&["--settle", "50ms", "--sentinel", "{name}.ok"][..], &FORMATS].concat();
    let daemon = scene.watch(&arguments);
    scene.write("in/dam.1.ply", ply(&moving(1)));
    scene.put_moving([2]);
    scene.write("in/dam.1.done", "");
    scene.put_moving([3]);
    scene.write("in/dam.3.ply.ok", "");
    // The voxel size is measured on the first frame, which is another one, so this frame also waits for it.
    daemon.await_line("it is ready", |line| line.message.starts_with("ready") && line.is_about("dam.3.ply"));
    for number in [1, 2] {
        daemon.await_waiting(&format!("dam.{number}.ply"), ply(&moving(number)).len(), "sentinel");
    }
    assert!(daemon.lines(|line| line.is_converted()).is_empty(), "{}", daemon.log_text());
    scene.write("in/dam.1.ply.ok", "");
    daemon.await_converted("dam.1.ply");
    daemon.await_converted("dam.3.ply");
    assert_eq!(daemon.converted_count("dam.2.ply"), 0);
    scene.write("in/dam.2.ply.ok", "");
    daemon.await_converted("dam.2.ply");

    // The existing sentinel belongs to an earlier version of the frame.
    scene.write("in/dam.2.ply", &ply(&moving(5))[..1000]);
    daemon.await_waiting("dam.2.ply", 1000, "sentinel");
    assert_eq!(daemon.converted_count("dam.2.ply"), 1);
    scene.write("in/dam.2.ply", ply(&moving(5)));
    scene.write("in/dam.2.ply.ok", "");
    daemon.await_lines(2, "converted again", |line| line.is_converted() && line.is_about("dam.2.ply"));
    daemon.assert_no_complaints();
    daemon.finish();
    scene.assert_as_converted(&FORMATS);
}

/// `--once` does not convert frames without their sentinel, and warns about them.
#[test]
fn once_skips_frames_without_their_sentinel() {
    let scene = Scene::new();
    scene.put_moving(1..=2);
    // This frame is not started: the voxel size is measured on the first frame, which is incomplete.
    scene.write("in/dam.2.ply.ok", "");
    let arguments = [&["--settle", "10ms", "--sentinel", "{name}.ok"], &FORMATS[..]].concat();
    let once = scene.once(&arguments);
    once.assert_status(2);
    assert!(
        once.log.iter().all(|line| line.level != "ERROR"),
        "{}",
        crate::daemon::scene::log_text(&once.log)
    );
    scene.remove("in/dam.2.ply.ok");
    scene.write("in/dam.1.ply.ok", "");
    let once = scene.once(&arguments);
    assert_eq!(once.converted(), ["dam.1.ply"]);
    once.assert_status(1);
    let named = |line: &Line| line.is_about("dam.2.ply") && line.message.contains("dam.2.ply.ok");
    assert!(once.log.iter().any(named), "{}", crate::daemon::scene::log_text(&once.log));
    scene.write("in/dam.2.ply.ok", "");
    let once = scene.once(&arguments);
    assert_eq!(once.converted(), ["dam.2.ply"]);
    once.assert_status(0);
}
