//! Asked to end, to hurry, or to read its file again.

use std::time::{Duration, Instant};

use rustix::process::Signal;

use crate::scene::{Line, NO_SCANS, Scene, WINDOW, Watching, block, contents, moving, names_in, ply};
use crate::window::get;

const FORMATS: [&str; 2] = ["--format", "obj,vdb"];

/// Minutes of smoothing of a small frame.
const ENDLESS: [&str; 8] =
    ["--integrator", "explicit", "--steps", "1000000", "--preset", "paper", "--voxel-size", "0.03"];

/// What is under way when it is asked to end is finished, and nothing else is begun; the rest comes next
/// time.
#[test]
fn frames_under_way_are_finished() {
    // On a busy machine all may be converted before this test hears of the first: then with more of them.
    let is_tested = [60, 240, 960].into_iter().any(finishes_frames_under_way);
    assert!(is_tested, "all frames were converted before it was asked to end");
}

/// Asks the daemon to end while it converts so many frames; false if it had converted all of them by then.
fn finishes_frames_under_way(frame_count: usize) -> bool {
    let scene = Scene::new();
    scene.put_moving(1..=frame_count);
    let arguments = [&["--settle", "10ms", "--in-flight", "2"], &FORMATS[..]].concat();
    let daemon = scene.watch(&arguments);
    daemon.await_lines(2, "some are converted", Line::is_converted);
    let log = daemon.finish();
    let mut first: Vec<String> = log.iter().filter(|line| line.is_converted()).map(name).collect();
    if first.len() == frame_count {
        return false;
    }
    assert!(first.len() >= 2, "{first:?}");
    scene.assert_no_temporaries();
    // All outputs of a frame, or none.
    assert_eq!(contents(&scene.path("out")).len(), 2 * first.len());
    let next = scene.once(&arguments);
    next.assert_status(0);
    assert!(next.found_done().is_empty());
    first.extend(next.converted());
    first.sort();
    first.dedup();
    assert_eq!(first.len(), frame_count);
    scene.assert_as_converted(&FORMATS);
    true
}

fn name(line: &Line) -> String {
    line.frame.as_ref().and_then(|path| path.file_name()).expect("a frame").to_string_lossy().into_owned()
}

/// Waits until the one frame of a daemon with a window is in the pipeline.
fn await_under_way(daemon: &Watching) {
    let address = daemon.window_address();
    crate::scene::await_that("the frame is under way", || {
        get(&address, "/api/status").json()["frames"]["working"] == 1
    });
}

#[test]
fn a_second_signal_ends_at_once() {
    let scene = Scene::new();
    for (first, second, status) in [(Signal::TERM, Signal::TERM, 143), (Signal::TERM, Signal::INT, 130)] {
        scene.put_moving([1]);
        let mut daemon = scene.watch(&[&["--settle", "10ms"], &WINDOW[..], &FORMATS, &ENDLESS].concat());
        await_under_way(&daemon);
        daemon.signal(first);
        daemon.await_line("it is winding up", |line| line.message.contains("asked to end"));
        assert!(daemon.is_alive());
        daemon.signal(second);
        // The frame would take minutes: it is not finished.
        assert_eq!(daemon.await_end().code(), Some(status), "{}", daemon.told());
        assert!(contents(&scene.path("out")).is_empty());
    }
    // What was broken off is begun again.
    scene.once(&[&["--settle", "10ms"], &FORMATS[..]].concat()).assert_status(0);
    scene.assert_no_temporaries();
    scene.assert_as_converted(&FORMATS);
}

/// A frame that takes minutes is given up when the deadline has passed. The log says so: time is measured only to see that
/// the daemon does not end sooner. [`Watching::await_end`] fails where it does not end at all.
#[test]
fn the_deadline_for_ending_holds() {
    let scene = Scene::new();
    scene.put_moving([1]);
    let arguments =
        [&["--settle", "10ms", "--stop-deadline", "300ms"], &WINDOW[..], &FORMATS, &ENDLESS].concat();
    let mut daemon = scene.watch(&arguments);
    await_under_way(&daemon);
    let start = Instant::now();
    daemon.signal(Signal::TERM);
    let status = daemon.await_end();
    let elapsed = start.elapsed();
    assert_eq!(status.code(), Some(0), "{}", daemon.told());
    assert!(elapsed >= Duration::from_millis(300), "{elapsed:?}");
    let overdue = "frames in progress are not finished within 300ms";
    assert_eq!(daemon.lines(|line| line.message == overdue).len(), 1, "{}", daemon.told());
    assert!(daemon.lines(Line::is_converted).is_empty(), "{}", daemon.told());
    assert!(contents(&scene.path("out")).is_empty());
    scene.once(&[&["--settle", "10ms"], &FORMATS[..]].concat()).assert_status(0);
    scene.assert_no_temporaries();
}

/// Asked to end while it waits: for nothing, for a frame to be complete, for a folder that is not there.
#[test]
fn waiting_ends_when_asked() {
    let scene = Scene::new();
    scene.watch(&NO_SCANS).finish();
    scene.write("in/dam.1.ply", &ply(&moving(1))[..1000]);
    scene.watch(&[&NO_SCANS[..], &["--stalled", "1h"]].concat()).finish();
    let daemon = scene.start_as(&["watch", "nowhere", "--out", "out", "--log", "json"]);
    daemon.await_ready();
    daemon.finish();
}

/// Everything `watch --once` may end with is what `convert` ends with.
#[test]
fn the_exit_status_is_that_of_convert() {
    let corrupt = "ply\nformat nonsense 1.0\n";
    let scenes: [(&str, &[&str], i32); 4] = [
        ("all good", &["good", "good"], 0),
        ("one bad", &["good", "bad"], 1),
        ("all bad", &["bad", "bad"], 2),
        ("none", &[], 2),
    ];
    for (case, frames, status) in scenes {
        let scene = Scene::new();
        for (index, &frame) in frames.iter().enumerate() {
            let path = format!("in/dam.{}.ply", index + 1);
            match frame {
                "good" => scene.put(&path, ply(&moving(index + 1))),
                _ => scene.put(&path, corrupt),
            }
        }
        let ran = scene.run(&[&["convert", "in", "--out", "expected"], &FORMATS[..]].concat());
        assert_eq!(ran.status, Some(status), "{case}: {}", ran.err);
        scene.once(&[&["--settle", "10ms"], &FORMATS[..]].concat()).assert_status(status);
    }
    let scene = Scene::new();
    for arguments in [
        &["watch", "nowhere", "--out", "out", "--once"][..],
        &["watch", "in", "--out", "out", "--once", "--settel", "1s"],
        &["watch", "in", "--out", "out", "--once", "--pattern", "[a"],
        &["watch", "in", "--out", "out", "--once", "--preset", "paper", "--voxel-size", "-1"],
        &["watch", "--once"],
    ] {
        assert_eq!(scene.run(arguments).status, Some(2), "{arguments:?}");
    }
}

const CONFIG: &str = "meniscus.toml";

fn config(pattern: &str, formats: &str) -> String {
    format!(
        "[daemon]\nlog = \"json\"\nsettle = \"20ms\"\nrescan = \"1h\"\n\n\
         [[watch]]\ninput = \"in\"\noutput = \"out\"\npattern = \"{pattern}\"\nformats = [\"{formats}\"]\n"
    )
}

#[test]
fn its_file_is_read_again_when_asked() {
    let scene = Scene::new();
    scene.write(CONFIG, config("dam.*.ply", "obj"));
    let daemon = scene.start_as(&["watch", "--config", CONFIG]);
    daemon.await_ready();
    scene.put("in/drop.1.ply", ply(&block(6, 0.1, 0.0)));
    scene.put_moving([1]);
    daemon.await_converted("dam.1.ply");
    assert_eq!(names_in(&scene.path("out")), [".meniscus", "dam.1.obj"]);

    // Wrong: it says so, and goes on as before.
    for (wrong, named) in [
        (config("dam.*.ply", "obj").replace("pattern", "patern"), "pattern"),
        (config("dam.*.ply", "nothing"), "nothing"),
        ("[[watch]".to_owned(), CONFIG),
    ] {
        scene.write(CONFIG, wrong);
        let count = daemon.lines(|line| line.level == "ERROR").len();
        daemon.signal(Signal::HUP);
        let told = daemon.await_lines(count + 1, "what is wrong is told", |line| line.level == "ERROR");
        assert!(told[count].message.contains(named), "{}", told[count].message);
    }
    scene.put_moving([2]);
    daemon.await_converted("dam.2.ply");
    assert_eq!(names_in(&scene.path("out")), [".meniscus", "dam.1.obj", "dam.2.obj"]);

    scene.write(CONFIG, config("dr*.ply", "ply"));
    daemon.signal(Signal::HUP);
    daemon.await_converted("drop.1.ply");
    scene.put("in/drop.2.ply", ply(&block(6, 0.1, 0.2)));
    daemon.await_converted("drop.2.ply");
    scene.put_moving([3]);
    // What was no frame before may be one now, and one that is done may have other outputs.
    scene.write(CONFIG, config("d*.ply", "ply"));
    daemon.signal(Signal::HUP);
    daemon.await_converted("dam.3.ply");
    daemon.await_lines(2, "in the new format", |line| line.is_converted() && line.is_about("dam.2.ply"));
    daemon.finish();
    let names = ["dam.1.obj", "dam.1.ply", "dam.2.obj", "dam.2.ply", "dam.3.ply", "drop.1.ply", "drop.2.ply"];
    assert_eq!(names_in(&scene.path("out"))[1..], names);
}
