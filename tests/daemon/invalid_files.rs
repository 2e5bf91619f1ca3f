//! Files that are not frames, and frames that cannot be read.

use std::fs::{self, Permissions};
use std::os::unix::fs::{PermissionsExt, symlink};

use rustix::fs::{CWD, FileType, Mode, mknodat};
use rustix::process::geteuid;
use serde_json::Value;

use crate::daemon::scene::{Line, Scene, log_text, moving, names_in, ply};

const FORMATS: [&str; 2] = ["--format", "obj,vdb"];
const QUICK: [&str; 2] = ["--settle", "50ms"];

/// The output of `status --json`.
fn status(scene: &Scene) -> Value {
    let result = scene.run(&["status", "--out", "out", "--json"]);
    serde_json::from_str(&result.out).unwrap_or_else(|error| panic!("{error}: {}{}", result.out, result.err))
}

fn is_failure_of<'a>(name: &'a str) -> impl Fn(&Line) -> bool + 'a {
    move |line| line.level == "ERROR" && line.is_about(name)
}

#[test]
fn corrupt_frame_fails_once_and_the_others_are_converted() {
    let scene = Scene::new();
    let arguments = [&QUICK[..], &FORMATS].concat();
    scene.put_moving([1, 3]);
    let mut corrupt = ply(&moving(2));
    corrupt[20..30].copy_from_slice(b"nonsense..");
    scene.put("in/dam.2.ply", &corrupt);
    let daemon = scene.watch(&arguments);
    let failure = daemon.await_line("the failure is logged", is_failure_of("dam.2.ply"));
    assert!(failure.message.contains("PLY"), "{}", failure.message);
    for name in ["dam.1.ply", "dam.3.ply"] {
        daemon.await_converted(name);
    }
    scene.put_moving([4]);
    daemon.await_converted("dam.4.ply");
    assert_eq!(daemon.lines(|line| line.is_complaint() && line.is_about("dam.2.ply")).len(), 1);
    let failed = status(&scene)["failed"].clone();
    assert_eq!(failed.as_array().map(Vec::len), Some(1), "{failed}");
    assert!(failed[0]["input"].as_str().is_some_and(|input| input.ends_with("in/dam.2.ply")), "{failed}");
    assert!(failed[0]["reason"].as_str().is_some_and(|reason| reason.contains("PLY")), "{failed}");
    daemon.finish();

    // The daemon does not even read the frame again, and still counts it.
    let once = scene.once(&[&QUICK[..], &FORMATS].concat());
    once.assert_status(1);
    assert!(once.converted().is_empty() && once.found_done().is_empty());
    assert_eq!(status(&scene)["failed"][0]["at_ms"], failed[0]["at_ms"]);
    assert!(scene.bytes("in/dam.2.ply") == corrupt);

    let daemon = scene.watch(&arguments);
    scene.put_moving([2]);
    daemon.await_converted("dam.2.ply");
    assert_eq!(status(&scene)["failed"], Value::Array(Vec::new()));
    daemon.finish();
    scene.assert_as_converted(&FORMATS);
}

/// Creates a named pipe. A process that opens it waits until another one opens the other end.
fn make_pipe(scene: &Scene, within: &str) {
    mknodat(CWD, scene.path(within), FileType::Fifo, Mode::from_raw_mode(0o644), 0).expect("a pipe");
}

/// Puts files of all kinds that have the name of a frame, but are not frames, into the folder: before the
/// daemon starts, and while it runs.
#[test]
fn files_that_are_not_frames_are_ignored() {
    let scene = Scene::new();
    let litter = |number: usize| {
        let name = |what: &str| format!("in/{what}.{number}.ply");
        fs::create_dir(scene.path(&name("folder"))).expect("a folder");
        make_pipe(&scene, &name("pipe"));
        symlink(scene.path(&name("pipe")), scene.path(&name("linked_pipe"))).expect("a link");
        make_pipe(&scene, &format!("in/dam.{number}.done"));
        symlink("/dev/zero", scene.path(&name("endless"))).expect("a link");
        scene.write(&format!("in/notes.{number}.txt"), "the voxel size is too large, I think\n");
        scene.write(&format!("in/.dam.{number}.ply"), "hidden");
        scene.write(&format!("in/dam.{number}.mov"), "no particles");
    };
    litter(1);
    scene.put_moving([1]);
    let once = scene.once(&[&QUICK[..], &FORMATS].concat());
    once.assert_status(0);
    assert_eq!(once.converted(), ["dam.1.ply"]);
    let daemon = scene.watch(&[&QUICK[..], &FORMATS].concat());
    litter(2);
    scene.put_moving([2]);
    daemon.await_converted("dam.2.ply");
    assert!(daemon.lines(|line| line.level == "ERROR").is_empty(), "{}", daemon.log_text());
    assert_eq!(daemon.finish().iter().filter(|line| line.is_converted()).count(), 1);
    let names = ["dam.1.obj", "dam.1.vdb", "dam.2.obj", "dam.2.vdb"];
    assert_eq!(names_in(&scene.path("out"))[1..], names);
}

/// The frame is a link to itself, so the daemon cannot examine it, and the frame fails.
#[test]
fn frame_that_cannot_be_examined_fails_the_run() {
    let scene = Scene::new();
    symlink(scene.path("in/dam.2.ply"), scene.path("in/dam.2.ply")).expect("a link");
    scene.put_moving([1]);
    let once = scene.once(&[&QUICK[..], &FORMATS].concat());
    once.assert_status(1);
    assert_eq!(once.converted(), ["dam.1.ply"]);
    let is_error = |line: &&Line| {
        line.level == "ERROR" && line.message.starts_with("path cannot be read: Too many levels")
    };
    assert_eq!(once.log.iter().filter(is_error).count(), 1, "{}", log_text(&once.log));
}

/// A writer may be about to fill an empty file. The daemon waits for it and retries, but `--once` does not
/// wait forever.
#[test]
fn empty_file_fails_after_a_while() {
    let scene = Scene::new();
    scene.write("in/dam.2.ply", "");
    scene.put_moving([3]);
    let once = scene.once(&[&QUICK[..], &FORMATS].concat());
    once.assert_status(1);
    assert_eq!(once.converted(), ["dam.3.ply"]);
    let is_complaint = |line: &Line| line.is_about("dam.2.ply") && line.message.contains("is empty");
    assert!(once.log.iter().any(is_complaint), "{}", log_text(&once.log));
    // Then the writer fills the file.
    scene.write("in/dam.2.ply", ply(&moving(2)));
    scene.once(&[&QUICK[..], &FORMATS].concat()).assert_status(0);
    assert_eq!(names_in(&scene.path("out")).len(), 5);
}

/// Root may read every file; this test then checks nothing.
#[test]
fn frame_without_read_permission_is_logged_and_retried() {
    if geteuid().is_root() {
        return;
    }
    let scene = Scene::new();
    scene.put_moving(1..=2);
    fs::set_permissions(scene.path("in/dam.2.ply"), Permissions::from_mode(0o000)).expect("changed");
    let daemon = scene.watch(&[&QUICK[..], &FORMATS].concat());
    daemon.await_converted("dam.1.ply");
    daemon.await_line("the failure is logged", |line| line.is_complaint() && line.is_about("dam.2.ply"));
    fs::set_permissions(scene.path("in/dam.2.ply"), Permissions::from_mode(0o644)).expect("changed");
    daemon.await_converted("dam.2.ply");
    daemon.finish();
    scene.assert_as_converted(&FORMATS);
}

/// The path of an output is a folder, which the daemon cannot replace, or a pipe, which it can replace. A
/// daemon that opened the pipe first would wait forever.
#[test]
fn folder_at_the_path_of_an_output_fails_that_frame_only() {
    let scene = Scene::new();
    scene.put_moving(1..=3);
    fs::create_dir_all(scene.path("out/dam.1.obj/full")).expect("a folder");
    make_pipe(&scene, "out/dam.2.obj");
    let once = scene.once(&[&QUICK[..], &FORMATS].concat());
    once.assert_status(1);
    let converted = once.converted();
    assert!(converted.contains(&"dam.3.ply".to_owned()), "{converted:?}");
    assert!(!converted.contains(&"dam.1.ply".to_owned()), "{converted:?}");
    assert!(scene.path("out/dam.1.obj/full").is_dir());
    scene.assert_no_temporaries();
}

/// The content decides which `.vdb` files are frames: those with points, unless the pattern asks for level sets.
#[test]
fn points_in_vdb_are_frames_and_level_sets_are_not() {
    let points = include_bytes!("../fuzz/corpus/vdb_points/null_none.vdb");
    let level_set = include_bytes!("../fuzz/corpus/vdb_level_set/mask_full.vdb");
    let scene = Scene::new();
    let spaced = ["--format", "obj", "--spacing", "1"];
    let arguments = [&QUICK[..], &spaced].concat();
    scene.put("in/body.vdb", level_set);
    scene.put("in/dam.1.vdb", points);
    scene.write("in/dam.2.vdb", "");
    let daemon = scene.watch(&arguments);
    daemon.await_converted("dam.1.vdb");
    // Its writer had only begun it.
    scene.write("in/dam.2.vdb", points);
    daemon.await_converted("dam.2.vdb");
    let log = daemon.finish();
    assert_eq!(log.iter().filter(|line| line.is_converted()).count(), 2);
    assert!(!log.iter().any(|line| line.is_about("body.vdb") && line.is_complaint()), "{}", log_text(&log));
    scene.remove("in/body.vdb");
    scene.assert_as_converted(&spaced);
    // The first file decides what the pattern means.
    let patterned = ["--pattern", "*.vdb", "--format", "ply"];
    let once = scene.once(&[&patterned[..], &["--spacing", "1"]].concat());
    assert_eq!(once.converted(), ["dam.1.vdb", "dam.2.vdb"]);
    scene.put("in/body.vdb", level_set);
    let once = scene.once(&patterned);
    once.assert_status(1);
    assert_eq!(once.converted(), ["body.vdb"]);
    let is_failure = |line: &Line| line.level == "ERROR" && line.message.contains("the file has points");
    assert!(once.log.iter().any(is_failure), "{}", log_text(&once.log));
}
