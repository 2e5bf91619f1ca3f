//! What is recorded survives a restart; without records, frames are converted again.

use std::fs;

use crate::daemon::scene::{Once, Scene, moving, names_in, ply};

const FORMATS: [&str; 2] = ["--format", "obj,vdb"];

fn once(scene: &Scene) -> Once {
    let once = scene.once(&[&["--settle", "10ms"], &FORMATS[..]].concat());
    once.assert_status(0);
    once
}

/// A scene of this many frames, all converted.
fn all_done(frame_count: usize) -> Scene {
    let scene = Scene::new();
    scene.put_moving(1..=frame_count);
    assert_eq!(once(&scene).converted().len(), frame_count);
    scene
}

/// The path of the only file of records.
fn records(scene: &Scene) -> String {
    let names = names_in(&scene.path("out/.meniscus")).into_iter();
    let files: Vec<String> =
        names.filter(|name| name.starts_with("frames-") && !name.contains('.')).collect();
    let [file] = &files[..] else { panic!("{files:?}") };
    format!("out/.meniscus/{file}")
}

#[test]
fn without_records_frames_are_converted_again() {
    let scene = all_done(2);
    assert!(once(&scene).converted().is_empty());
    fs::remove_dir_all(scene.path("out/.meniscus")).expect("removed");
    assert_eq!(once(&scene).converted().len(), 2);
}

/// Such as after a copy to another disk.
#[test]
fn outputs_with_other_stamps_are_compared_once() {
    let scene = all_done(2);
    for name in ["out/dam.1.obj", "out/dam.2.vdb"] {
        scene.put(name, scene.bytes(name));
    }
    let again = once(&scene);
    assert_eq!((again.converted().len(), again.found_done().len()), (0, 2));
    assert!(once(&scene).found_done().is_empty());
}

/// Any damage to the records costs at most some work, and never a frame.
#[test]
fn damaged_records_lose_no_frame() {
    let scene = all_done(3);
    let bytes = scene.bytes(&records(&scene));
    let mut flipped = bytes.clone();
    let index = flipped.len() * 2 / 3;
    flipped[index] ^= 0x20;
    let damages: [(&str, Vec<u8>); 6] = [
        ("empty", Vec::new()),
        ("torn", bytes[..bytes.len() - 10].to_vec()),
        ("half", bytes[..bytes.len() / 2].to_vec()),
        ("a bit", flipped),
        ("zeros behind", [&bytes[..], &[0; 512]].concat()),
        ("nonsense", b"\xff\xfe nonsense\n\n\n".repeat(50)),
    ];
    for (damage, bytes) in damages {
        scene.write(&records(&scene), bytes);
        once(&scene);
        // The daemon has recorded again which frames are done.
        let then = once(&scene);
        assert!(then.converted().is_empty() && then.found_done().is_empty(), "{damage}");
    }
    scene.assert_as_converted(&FORMATS);
}

/// If the records are removed while the daemon runs, it continues in a new file.
#[test]
fn records_removed_while_the_daemon_runs_are_written_again() {
    let scene = Scene::new();
    scene.put_moving(1..=3);
    let daemon = scene.watch(&[&["--settle", "10ms"], &FORMATS[..]].concat());
    daemon.await_lines(3, "all are converted", |line| line.is_converted());
    scene.remove(&records(&scene));
    scene.put_moving([4]);
    daemon.await_converted("dam.4.ply");
    daemon.finish();
    let again = once(&scene);
    assert_eq!(again.converted(), [""; 0]);
    scene.assert_as_converted(&FORMATS);
}

/// The daemon accepts outputs of `convert` as done if the settings are the same as its own, and only then.
#[test]
fn frames_converted_by_convert_are_done() {
    let scene = Scene::new();
    scene.put_moving(1..=3);
    let result = scene.run(&[&["convert", "in", "--out", "out"], &FORMATS[..]].concat());
    assert_eq!(result.status, Some(0), "{}", result.err);
    scene.put("in/dam.3.ply", ply(&moving(4)));
    let next = once(&scene);
    assert_eq!(next.converted(), ["dam.3.ply"]);
    // The daemon measures the spacing itself, so it reads them.
    assert_eq!(next.found_done(), ["dam.1.ply", "dam.2.ply"]);
    assert_eq!(once(&scene).found_done(), [""; 0]);
}

/// A frame of one particle has no spacing. It waits for a frame with more particles, also after restarts.
#[test]
fn single_particle_frame_waits_for_the_spacing_of_another_over_restarts() {
    let scene = Scene::new();
    scene.write("in/dam.1.ply", ply(&moving(1)[..1]));
    let once = scene.once(&["--settle", "10ms"]);
    once.assert_status(2);
    assert!(once.log.iter().any(|line| line.message.contains("--spacing")));
    scene.put_moving([2]);
    let once = scene.once(&["--settle", "10ms"]);
    once.assert_status(0);
    assert_eq!(once.converted(), ["dam.1.ply", "dam.2.ply"]);
}

/// A frame that was refused because of another file is converted when that file is removed.
#[test]
fn refused_frame_is_converted_when_the_conflict_is_gone() {
    let scene = Scene::new();
    scene.put_moving([1]);
    scene.once(&["--settle", "10ms"]).assert_status(0);
    scene.write("in/dam.1.csv", crate::daemon::scene::csv(&moving(3)));
    let arguments = ["--settle", "10ms"];
    scene.once(&arguments).assert_status(1);
    scene.remove("in/dam.1.ply");
    let once = scene.once(&arguments);
    once.assert_status(0);
    assert_eq!(once.converted(), ["dam.1.csv"]);
}

/// A frame that does not fit into the memory limit of one run may fit into that of the next run.
#[test]
fn frame_that_was_too_large_is_retried_after_a_restart() {
    let scene = Scene::new();
    scene.put_moving([1]);
    let arguments = ["--settle", "10ms", "--format", "obj,vdb", "--preset", "paper", "--voxel-size", "0.05"];
    let small = [&arguments[..], &["--memory", "1MiB"]].concat();
    for _ in 0..2 {
        let once = scene.once(&small);
        once.assert_status(2);
        let complaints = once.log.iter().filter(|line| line.message.contains("the frame needs"));
        assert!(complaints.count() > 0, "it was not tried");
    }
    for command in [&["status", "--out", "out"][..], &["status", "in/dam.1.ply", "--out", "out"]] {
        let result = scene.run(command);
        assert!(result.out.contains("dam.1.ply") && result.out.contains("the frame needs"), "{}", result.out);
    }
    let once = scene.once(&arguments);
    once.assert_status(0);
    assert_eq!(once.converted(), ["dam.1.ply"]);
}

/// With `--once`, a missing folder ends the run before anything is written.
#[test]
fn missing_folder_ends_the_run() {
    let scene = Scene::new();
    scene.put_moving(1..=2);
    let result = scene.run(&["watch", "in", "nowhere", "--out", "out", "--once"]);
    assert_eq!(result.status, Some(2), "{}", result.err);
    assert!(result.err.contains("nowhere: there is no such folder: check the path"), "{}", result.err);
    assert!(!scene.path("out").exists());
}

/// A path through other folders or through links refers to the same frames.
#[test]
fn frame_is_recognized_by_any_of_its_paths() {
    let scene = Scene::new();
    scene.put_moving([1]);
    scene.once(&["--settle", "10ms"]).assert_status(0);
    std::os::unix::fs::symlink(".", scene.path("here")).expect("linked");
    for input in ["in/../in", "here/in", "./here/here/in"] {
        let result = scene.run(&["watch", input, "--out", "out", "--once", "--log", "json"]);
        assert_eq!(result.status, Some(0), "{}", result.err);
        assert!(
            !result.err.contains("\"converted\"") && !result.err.contains("done already"),
            "{}",
            result.err
        );
        let status = scene.run(&["status", &format!("{input}/dam.1.ply"), "--out", "out"]);
        assert!(status.out.contains("state     done"), "{}{}", status.out, status.err);
    }
}
