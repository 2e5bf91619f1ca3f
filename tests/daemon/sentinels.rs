//! Files that say that another is complete.

use crate::scene::{Line, NO_SCANS, Scene, csv, moving, ply};

const FORMATS: [&str; 2] = ["--format", "obj"];

/// Those of the usual name need not be there, but then they are believed.
#[test]
fn a_usual_sentinel_saves_the_waiting() {
    let scene = Scene::new();
    let daemon = scene.watch(&[&["--settle", "1h"], &NO_SCANS[..], &FORMATS].concat());
    scene.write("in/dam.1.ply", ply(&moving(1)));
    scene.write("in/dam.1.done", "");
    daemon.await_converted("dam.1.ply");
    // A table cannot tell by itself that it is complete.
    scene.write("in/dam.2.csv", csv(&moving(2)));
    scene.write("in/dam.2.done", "");
    daemon.await_converted("dam.2.csv");
    daemon.assert_no_complaints();
    daemon.finish();
    scene.assert_as_converted(&FORMATS);
}

/// Those that were asked for are waited for, also by a frame that was renamed into place, and also after
/// it was written again.
#[test]
fn a_sentinel_that_was_asked_for_is_waited_for() {
    let scene = Scene::new();
    let arguments = [&["--settle", "50ms", "--sentinel", "{name}.ok"], &NO_SCANS[..], &FORMATS].concat();
    let daemon = scene.watch(&arguments);
    scene.write("in/dam.1.ply", ply(&moving(1)));
    scene.put_moving([2]);
    scene.write("in/dam.1.done", "");
    scene.put_moving([3]);
    scene.write("in/dam.3.ply.ok", "");
    // Its voxel size would be that of another first frame: it waits for that one, too.
    daemon.await_line("it is ready", |line| line.message.starts_with("ready") && line.is_about("dam.3.ply"));
    for number in [1, 2] {
        daemon.await_waiting(&format!("dam.{number}.ply"), ply(&moving(number)).len(), "sentinel");
    }
    assert!(daemon.lines(|line| line.is_converted()).is_empty(), "{}", daemon.told());
    scene.write("in/dam.1.ply.ok", "");
    daemon.await_converted("dam.1.ply");
    daemon.await_converted("dam.3.ply");
    assert_eq!(daemon.converted_count("dam.2.ply"), 0);
    scene.write("in/dam.2.ply.ok", "");
    daemon.await_converted("dam.2.ply");

    // The one that is there is of an earlier version.
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

/// Frames without theirs are left, and whoever runs it once is told so.
#[test]
fn frames_without_a_sentinel_are_left() {
    let scene = Scene::new();
    scene.put_moving(1..=2);
    // Not even begun: its voxel size is that of the first frame, which is still to come.
    scene.write("in/dam.2.ply.ok", "");
    let arguments = [&["--settle", "10ms", "--sentinel", "{name}.ok"], &FORMATS[..]].concat();
    let once = scene.once(&arguments);
    once.assert_status(2);
    assert!(once.log.iter().all(|line| line.level != "ERROR"), "{}", crate::scene::told(&once.log));
    scene.remove("in/dam.2.ply.ok");
    scene.write("in/dam.1.ply.ok", "");
    let once = scene.once(&arguments);
    assert_eq!(once.converted(), ["dam.1.ply"]);
    once.assert_status(1);
    let named = |line: &Line| line.is_about("dam.2.ply") && line.message.contains("dam.2.ply.ok");
    assert!(once.log.iter().any(named), "{}", crate::scene::told(&once.log));
    scene.write("in/dam.2.ply.ok", "");
    let once = scene.once(&arguments);
    assert_eq!(once.converted(), ["dam.2.ply"]);
    once.assert_status(0);
}
