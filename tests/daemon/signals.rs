//! Signals: end, and end at once.

use std::time::{Duration, Instant};

use rustix::process::Signal;

use crate::daemon::http::get;
use crate::daemon::scene::{Line, Scene, WINDOW, Watching, contents, moving, ply};

const FORMATS: [&str; 2] = ["--format", "obj,vdb"];

/// Settings with which a small frame takes minutes of smoothing.
const ENDLESS: [&str; 8] =
    ["--integrator", "explicit", "--steps", "1000000", "--preset", "paper", "--voxel-size", "0.03"];

/// When the daemon is asked to end, it finishes the frames in flight and starts no others. The next run
/// converts the rest.
#[test]
fn frames_in_flight_are_finished_after_a_signal() {
    // On a busy machine, all frames may be converted before this test notices the first one. Then the test
    // repeats with more frames.
    let is_tested = [60, 240, 960].into_iter().any(finishes_frames_in_flight);
    assert!(is_tested, "all frames were converted before it was asked to end");
}

/// Asks the daemon to end while it converts this number of frames. Returns false if it had already converted
/// all frames.
fn finishes_frames_in_flight(frame_count: usize) -> bool {
    let scene = Scene::new();
    scene.put_moving(1..=frame_count);
    let arguments = [&["--settle", "10ms", "--threads", "1"], &FORMATS[..]].concat();
    let daemon = scene.watch(&arguments);
    daemon.await_lines(2, "some are converted", Line::is_converted);
    let log = daemon.finish();
    let mut first: Vec<String> = log.iter().filter(|line| line.is_converted()).map(name).collect();
    if first.len() == frame_count {
        return false;
    }
    assert!(first.len() >= 2, "{first:?}");
    scene.assert_no_temporaries();
    // Each frame has all of its outputs or none.
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

/// Waits until the only frame of a daemon with an HTTP server is in the pipeline.
fn await_in_flight(daemon: &Watching) {
    let address = daemon.window_address();
    crate::daemon::scene::await_that("the frame is in flight", || {
        get(&address, "/api/status").json()["frames"]["working"] == 1
    });
}

#[test]
fn second_signal_ends_the_daemon_at_once() {
    let scene = Scene::new();
    for (first, second, status) in [(Signal::TERM, Signal::TERM, 143), (Signal::TERM, Signal::INT, 130)] {
        scene.put_moving([1]);
        let mut daemon = scene.watch(&[&["--settle", "10ms"], &WINDOW[..], &FORMATS, &ENDLESS].concat());
        await_in_flight(&daemon);
        daemon.signal(first);
        daemon.await_line("it is stopping", |line| line.message.contains("stopping on request"));
        assert!(daemon.is_alive());
        daemon.signal(second);
        // The frame would take minutes, so the daemon ends before it is finished.
        assert_eq!(daemon.await_end().code(), Some(status), "{}", daemon.log_text());
        assert!(contents(&scene.path("out")).is_empty());
    }
    // The next run starts the aborted frame again.
    scene.once(&[&["--settle", "10ms"], &FORMATS[..]].concat()).assert_status(0);
    scene.assert_no_temporaries();
    scene.assert_as_converted(&FORMATS);
}

/// After the deadline, the daemon aborts a frame that takes minutes. The test reads this in the log. It
/// measures time only to check that the daemon does not end earlier. If the daemon does not end at all,
/// [`Watching::await_end`] fails.
#[test]
#[ignore = "slow: `.ci/full slow` runs it"]
fn frame_beyond_the_deadline_is_given_up() {
    let scene = Scene::new();
    scene.put_moving([1]);
    let arguments = [&["--settle", "10ms"], &WINDOW[..], &FORMATS, &ENDLESS].concat();
    let mut daemon = scene.watch(&arguments);
    await_in_flight(&daemon);
    let start = Instant::now();
    daemon.signal(Signal::TERM);
    let status = daemon.await_end();
    let elapsed = start.elapsed();
    assert_eq!(status.code(), Some(0), "{}", daemon.log_text());
    assert!(elapsed >= Duration::from_secs(30), "{elapsed:?}");
    let overdue = "frames in progress did not finish within 30s: exiting without them; the \
                   next start converts them";
    assert_eq!(daemon.lines(|line| line.message == overdue).len(), 1, "{}", daemon.log_text());
    assert!(daemon.lines(Line::is_converted).is_empty(), "{}", daemon.log_text());
    assert!(contents(&scene.path("out")).is_empty());
    scene.once(&[&["--settle", "10ms"], &FORMATS[..]].concat()).assert_status(0);
    scene.assert_no_temporaries();
}

/// Asks the daemon to end while it waits: for new files, for a frame to be complete, and for a missing
/// folder.
#[test]
fn waiting_daemon_ends_on_a_signal() {
    let scene = Scene::new();
    scene.watch(&[]).finish();
    scene.write("in/dam.1.ply", &ply(&moving(1))[..1000]);
    scene.watch(&[]).finish();
    let daemon = scene.start_as(&["watch", "nowhere", "--out", "out", "--log", "json"]);
    daemon.await_ready();
    daemon.finish();
}

/// `watch --once` ends with the exit statuses of `convert`.
#[test]
fn once_exits_with_the_status_of_convert() {
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
        let result = scene.run(&[&["convert", "in", "--out", "expected"], &FORMATS[..]].concat());
        assert_eq!(result.status, Some(status), "{case}: {}", result.err);
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
