//! Outputs whose names collide with other files: the daemon's own, the user's, and those of another daemon.

use crate::daemon::scene::{Line, Scene, csv, log_text, moving, names_in, ply};

const QUICK: [&str; 2] = ["--settle", "20ms"];

/// The outputs have names that particle files may have, and are in the watched folder.
#[test]
fn outputs_in_a_subfolder_of_the_watched_folder_are_not_inputs() {
    let scene = Scene::new();
    scene.write("in/sub/dam.1.ply", ply(&moving(1)));
    scene.put_moving([2]);
    let arguments =
        ["watch", "in", "--out", "in/out", "--pattern", "**", "--format", "ply,obj", "--log", "json"];
    for _ in 0..2 {
        let result = scene.run(&[&arguments[..], &QUICK, &["--once"]].concat());
        assert_eq!(result.status, Some(0), "{}", result.err);
    }
    let daemon = scene.start_as(&[&arguments[..], &QUICK].concat());
    daemon.await_ready();
    scene.put_moving([3]);
    daemon.await_converted("dam.3.ply");
    // A daemon that mistook its outputs for inputs would have read them by the time this frame is done.
    scene.put_moving([4]);
    daemon.await_converted("dam.4.ply");
    assert_eq!(daemon.finish().iter().filter(|line| line.is_converted()).count(), 2);
    assert_eq!(names_in(&scene.path("in")), ["dam.2.ply", "dam.3.ply", "dam.4.ply", "out", "sub"]);
    assert_eq!(names_in(&scene.path("in/sub")), ["dam.1.ply"]);
    let names =
        [".meniscus", "dam.2.obj", "dam.2.ply", "dam.3.obj", "dam.3.ply", "dam.4.obj", "dam.4.ply", "sub"];
    assert_eq!(names_in(&scene.path("in/out")), names);
    assert_eq!(names_in(&scene.path("in/out/sub")), ["dam.1.obj", "dam.1.ply"]);
}

/// If outputs are next to the frames, the daemon recognizes them by their contents.
#[test]
fn outputs_next_to_the_frames_are_not_inputs() {
    let scene = Scene::new();
    scene.write("in/dam.1.csv", csv(&moving(1)));
    let arguments = ["watch", "in", "--out", "in", "--format", "ply,vdb", "--log", "json"];
    for _ in 0..2 {
        let result = scene.run(&[&arguments[..], &QUICK, &["--once"]].concat());
        assert_eq!(result.status, Some(0), "{}", result.err);
        assert_eq!(names_in(&scene.path("in")), [".meniscus", "dam.1.csv", "dam.1.ply", "dam.1.vdb"]);
    }
    let daemon = scene.start_as(&[&arguments[..], &QUICK].concat());
    daemon.await_ready();
    scene.write("in/dam.2.csv", csv(&moving(2)));
    daemon.await_converted("dam.2.csv");
    scene.write("in/dam.3.csv", csv(&moving(3)));
    daemon.await_converted("dam.3.csv");
    daemon.assert_no_complaints();
    assert_eq!(daemon.finish().iter().filter(|line| line.is_converted()).count(), 2);
    assert_eq!(names_in(&scene.path("in")).len(), 10);
}

/// The daemon prints one line, before it reads any frame.
#[test]
fn output_folder_that_is_not_writable_is_refused() {
    let scene = Scene::new();
    scene.put_moving(1..=2);
    scene.write("taken", "a file");
    let mut cases = vec![("taken", "this is a file"), ("taken/deep", "taken is a file")];
    #[cfg(target_os = "linux")]
    // No user can write there, not even root.
    cases.push(("/proc", "nothing can be written into it: "));
    for (out, why) in cases {
        let result = scene.run(&["watch", "in", "--out", out, "--once"]);
        assert_eq!(result.status, Some(2), "{out}: {}", result.err);
        assert!(
            result.err.contains(&format!("{out}: expected a folder for the results, but "))
                && result.err.contains(why),
            "{out}: {}",
            result.err
        );
        assert_eq!(result.err.lines().count(), 1, "{}", result.err);
    }
}

/// This also holds if the obstacle does not exist yet, or belongs to another frame.
#[test]
fn output_does_not_replace_an_obstacle() {
    let scene = Scene::new();
    scene.put_moving(1..=2);
    scene.write("out/dam.1.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n");
    let before = scene.bytes("out/dam.1.obj");
    for (obstacle, refused) in
        [("out/dam.1.obj", &["dam.1"][..]), ("elsewhere/../out/dam.#.obj", &["dam.1", "dam.2"])]
    {
        let with = ["--format", "obj", "--obstacle", obstacle, "--preset", "paper", "--voxel-size", "0.06"];
        let once = scene.once(&[&with[..], &QUICK].concat());
        once.assert_status(if refused.len() == 2 { 2 } else { 1 });
        for name in refused {
            let is_report = |line: &&Line| line.message.contains("would replace the obstacle");
            let reported =
                once.log.iter().filter(is_report).filter(|line| line.is_about(&format!("{name}.ply")));
            assert_eq!(reported.count(), 1, "{obstacle} {name}: {}", log_text(&once.log));
        }
        assert!(scene.bytes("out/dam.1.obj") == before);
        let result = scene.run(&[&["convert", "in", "--out", "out"], &with[..]].concat());
        assert_eq!(result.status, Some(2), "{}", result.err);
        assert!(result.err.contains("would replace the obstacle"), "{}", result.err);
    }
}

/// The output of a frame would have the path of the frame itself.
#[test]
fn output_does_not_replace_a_frame() {
    let scene = Scene::new();
    scene.put_moving(1..=2);
    // This also holds for a file in the output folder, which the daemon does not watch.
    scene.write("out/dam.1.ply", ply(&moving(7)));
    let in_place = ["watch", "in", "--out", "in", "--format", "ply", "--once", "--log", "json"];
    let onto_others = ["watch", "in", "--out", "out", "--format", "obj,ply", "--once", "--log", "json"];
    let result = scene.run(&[&in_place[..], &QUICK].concat());
    assert_eq!(result.status, Some(2), "{}", result.err);
    assert!(result.err.contains("replace"), "{}", result.err);
    assert_eq!(names_in(&scene.path("in")), [".meniscus", "dam.1.ply", "dam.2.ply"]);
    let result = scene.run(&[&onto_others[..], &QUICK].concat());
    assert_eq!(result.status, Some(1), "{}", result.err);
    assert_eq!(names_in(&scene.path("out")), [".meniscus", "dam.1.ply", "dam.2.obj", "dam.2.ply"]);
    for (within, number) in [("in/dam.1.ply", 1), ("in/dam.2.ply", 2), ("out/dam.1.ply", 7)] {
        assert!(scene.bytes(within) == ply(&moving(number)), "{within}");
    }
    // No daemon runs that scans. When the other file is gone, so is the reason.
    let output = |arguments: &[&str]| scene.run(arguments).out;
    let status = output(&["status", "--out", "out"]);
    assert!(status.contains("next try when the conflict is gone and a daemon runs"), "{status}");
    let frame = output(&["status", "in/dam.1.ply", "--out", "out"]);
    for text in ["not converted", "would replace", "next try  when the conflict is gone"] {
        assert!(frame.contains(text), "{frame}");
    }
}

/// A running daemon checks a refused frame again at each scan, and complains about it once.
#[test]
fn refused_frame_is_converted_when_the_other_file_is_removed() {
    let scene = Scene::new();
    scene.write("out/dam.1.ply", ply(&moving(7)));
    let arguments = ["watch", "in", "--out", "out", "--format", "ply", "--log", "json", "--poll", "50ms"];
    let daemon = scene.start_as(&[&arguments[..], &QUICK].concat());
    let is_refusal =
        |line: &Line| line.message.contains("would replace a file that is not a surface of meniscus");
    scene.put_moving([1]);
    daemon.await_line("the refusal", is_refusal);
    let status = scene.run(&["status", "--out", "out"]).out;
    assert!(status.contains("next try when the conflict is gone: checked at each scan"), "{status}");
    scene.put_moving([2]);
    daemon.await_converted("dam.2.ply");
    scene.remove("out/dam.1.ply");
    daemon.await_converted("dam.1.ply");
    assert_eq!(daemon.finish().iter().filter(|line| is_refusal(line)).count(), 1);
}

/// The first frame keeps its outputs. The error for the second frame names both frames.
#[test]
fn error_names_both_frames_with_the_same_output() {
    let scene = Scene::new();
    scene.put_moving(1..=2);
    let arguments = [&QUICK[..], &["--format", "obj"]].concat();
    let daemon = scene.watch(&arguments);
    daemon.await_converted("dam.1.ply");
    daemon.await_converted("dam.2.ply");
    let before = scene.bytes("out/dam.1.obj");
    scene.write("in/dam.1.csv", csv(&moving(9)));
    let conflict = daemon.await_line("the conflict is logged", |line| line.level == "ERROR");
    for name in ["in/dam.1.ply", "in/dam.1.csv", "out/dam.1"] {
        assert!(conflict.message.contains(name), "{name}: {}", conflict.message);
    }
    daemon.finish();
    let once = scene.once(&arguments);
    once.assert_status(1);
    assert!(once.converted().is_empty(), "{:?}", once.converted());
    assert!(scene.bytes("out/dam.1.obj") == before);

    // When the first frame is removed, the second frame may use the outputs' names.
    scene.remove("in/dam.1.ply");
    scene.write("in/dam.1.csv", csv(&moving(8)));
    let once = scene.once(&arguments);
    once.assert_status(0);
    assert_eq!(once.converted(), ["dam.1.csv"]);
}

/// Two watched folders with one output folder.
#[test]
fn frames_with_the_same_name_in_two_folders_conflict() {
    let scene = Scene::new();
    scene.put_moving(1..=2);
    scene.write("more/dam.2.ply", ply(&moving(5)));
    scene.write("more/dam.3.ply", ply(&moving(6)));
    let arguments = ["watch", "in", "more", "--out", "out", "--format", "obj", "--once", "--log", "json"];
    let result = scene.run(&[&arguments[..], &QUICK].concat());
    assert_eq!(result.status, Some(1), "{}", result.err);
    assert!(result.err.contains("in/dam.2.ply") && result.err.contains("more/dam.2.ply"), "{}", result.err);
    assert_eq!(names_in(&scene.path("out")), [".meniscus", "dam.1.obj", "dam.2.obj", "dam.3.obj"]);
}

#[test]
fn second_daemon_with_the_same_output_folder_is_refused() {
    let scene = Scene::new();
    scene.put_moving([1]);
    let daemon = scene.watch(&QUICK);
    let second = scene.once(&QUICK);
    second.assert_status(2);
    let named = format!("pid {}", daemon.pid());
    assert!(
        second.log.iter().any(|line| line.message.contains(&named)),
        "{}",
        crate::daemon::scene::log_text(&second.log)
    );
    // The first daemon is unaffected. When it has ended, normally or not, another one may start.
    scene.put_moving([2]);
    daemon.await_converted("dam.2.ply");
    daemon.assert_no_complaints();
    daemon.kill();
    scene.once(&QUICK).assert_status(0);
}
