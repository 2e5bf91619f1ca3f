//! The output of `status`, and the log, for running and stopped daemons.

use std::path::PathBuf;

use serde_json::Value;

use crate::daemon::scene::{Scene, Watching, await_that, moving, ply};

const FORMATS: [&str; 2] = ["--format", "obj"];

/// What `status` prints as JSON.
pub(crate) fn status(scene: &Scene) -> Value {
    let result = scene.run(&["status", "--out", "out", "--json"]);
    serde_json::from_str(&result.out).unwrap_or_else(|error| panic!("{error}: {}{}", result.out, result.err))
}

/// What `status` prints of a frame.
fn status_of(scene: &Scene, within: &str) -> String {
    scene.run(&["status", within, "--out", "out"]).out
}

/// A scene with two valid frames, a corrupt frame, and a frame that stays incomplete.
fn scene() -> (Scene, Watching) {
    let scene = Scene::new();
    scene.put_moving(1..=2);
    scene.put("in/dam.3.ply", "ply\nformat nonsense 1.0\n");
    scene.write("in/dam.4.ply", &ply(&moving(4))[..1000]);
    let daemon = scene.watch(&[&["--settle", "20ms"][..], &FORMATS].concat());
    daemon.await_lines(2, "both are converted", |line| line.is_converted());
    daemon.await_line("one has failed", |line| line.level == "ERROR");
    (scene, daemon)
}

#[test]
fn status_describes_running_and_stopped_daemons() {
    let (scene, daemon) = scene();
    let running = status(&scene);
    assert_eq!(running["daemon"]["running"], true, "{running}");
    assert_eq!(running["daemon"]["pid"], daemon.pid(), "{running}");
    assert_eq!(
        (&running["counts"]["done"], &running["counts"]["failed"]),
        (&2.into(), &1.into()),
        "{running}"
    );
    let reason = running["failed"][0]["reason"].as_str().expect("a reason");
    let waiting = running["waiting"].as_array().expect("a list");
    let text_of = |key: &str| waiting[0][key].as_str().expect("text");
    assert!(waiting.len() == 1 && text_of("input").ends_with("dam.4.ply"), "{running}");
    assert!(text_of("reason").starts_with("it is not complete: 1000 of at least"), "{running}");
    let text = scene.run(&["status", "--out", "out"]);
    assert_eq!(text.status, Some(1), "{}", text.err);
    for expected in
        ["2 ", "not yet complete:", "dam.4.ply: it is not", "dam.3.ply", reason, &daemon.pid().to_string()]
    {
        assert!(text.out.contains(expected), "{expected}: {}", text.out);
    }
    daemon.finish();
    let stopped = status(&scene);
    assert_eq!(stopped["daemon"]["running"], false, "{stopped}");
    assert_eq!(stopped["counts"], running["counts"]);
    assert_eq!(stopped["failed"], running["failed"]);
    assert_eq!(stopped["waiting"], running["waiting"]);
    // A killed daemon cannot record its end, but the commands must not report it as running.
    let daemon = scene.watch(&FORMATS);
    await_that("it is running", || status(&scene)["daemon"]["running"] == true);
    daemon.kill();
    assert_eq!(status(&scene)["daemon"]["running"], false);
    let nothing = scene.run(&["status", "--out", "elsewhere"]);
    assert_eq!((nothing.status, &*nothing.out), (Some(2), ""), "{}", nothing.err);
}

#[test]
fn status_describes_each_frame() {
    let (scene, daemon) = scene();
    let check = || {
        for (frame, words) in [
            ("in/dam.1.ply", &["state     done", "dam.1.obj", "216 particles"][..]),
            ("in/dam.3.ply", &["state     failed", "nonsense"]),
            ("in/dam.4.ply", &["state     not yet complete", "it is not complete: 1000 of at least"]),
        ] {
            let text = status_of(&scene, frame);
            assert!(words.iter().all(|word| text.contains(word)), "{words:?}: {text}");
        }
    };
    await_that("it is recorded", || status_of(&scene, "in/dam.4.ply").contains("it is not complete"));
    check();
    assert!(!status_of(&scene, "in/dam.4.ply").contains("no daemon"));
    daemon.finish();
    check();
    assert!(status_of(&scene, "in/dam.4.ply").contains("no daemon is running for out: start one"));
    let json = scene.run(&["status", "in/dam.3.ply", "--out", "out", "--json"]);
    let failed: Value = serde_json::from_str(&json.out).expect("JSON");
    assert_eq!((json.status, &failed["state"]), (Some(1), &"failed".into()), "{failed}");
    for (other, words) in [
        ("in/dam.9.ply", "in/dam.9.ply: nothing is recorded of it"),
        ("in", "in: it has several frames: give one of them, from "),
    ] {
        let result = scene.run(&["status", other, "--out", "out"]);
        assert_eq!((result.status, &*result.out), (Some(2), ""), "{}", result.err);
        assert!(result.err.contains(words), "{}", result.err);
    }
}

/// Other programs read the log: every line is a JSON object, and every frame has one.
#[test]
fn log_has_the_warnings_about_a_frame() {
    let scene = Scene::new();
    let mut particles = moving(1);
    particles[0] = [f32::NAN; 3];
    scene.write("in/dam.1.ply", ply(&particles));
    let daemon = scene.watch(&FORMATS);
    daemon.await_line("the omission is logged", |line| {
        line.level == "WARN" && line.is_about("dam.1.ply") && line.message.starts_with("1 particle left out")
    });
    daemon.await_converted("dam.1.ply");
    let left_out = "1 particle left out: not finite";
    await_that("it is recorded", || status(&scene)["flawed"][0]["flaws"][0].as_str().is_some());
    let text = scene.run(&["status", "--out", "out"]).out;
    assert!(
        text.contains("done, but failed validation or left out particles") && text.contains(left_out),
        "{text}"
    );
    assert!(status_of(&scene, "in/dam.1.ply").contains(left_out), "{text}");
    daemon.finish();
    assert_eq!(status(&scene)["flawed"].as_array().map(Vec::len), Some(1));
}

#[test]
fn log_has_a_line_for_every_frame() {
    let (scene, daemon) = scene();
    let line = daemon.await_converted("dam.1.ply");
    assert_eq!(line.fields["particles"], 216);
    for key in ["read_s", "rasterize_s", "smooth_s", "contour_s", "write_s", "queue"] {
        assert!(line.fields[key].is_number(), "{key}: {}", line.fields);
    }
    assert_eq!((&*line.level, &line.fields["state"]), ("INFO", &"converted".into()));
    let outputs: Vec<PathBuf> =
        serde_json::from_str(line.fields["outputs"].as_str().expect("text")).expect("paths");
    assert_eq!(outputs, [scene.path("out/dam.1.obj")]);
    assert_eq!(daemon.lines(|line| line.level == "ERROR" && line.fields["state"] == "failed").len(), 1);
    let log = daemon.finish();
    assert!(log.iter().all(|line| line.fields.is_object()), "{}", crate::daemon::scene::log_text(&log));
}
