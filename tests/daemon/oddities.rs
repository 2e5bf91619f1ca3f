//! What is no frame, and frames that cannot be read.

use std::fs::{self, Permissions};
use std::os::unix::fs::{PermissionsExt, symlink};

use rustix::fs::{CWD, FileType, Mode, mknodat};
use rustix::process::geteuid;
use serde_json::Value;

use crate::scene::{Line, NO_SCANS, Scene, moving, names_in, ply, told};

const FORMATS: [&str; 2] = ["--format", "obj,vdb"];
const QUICK: [&str; 4] = ["--settle", "50ms", "--stalled", "300ms"];

/// What `status --json` tells.
fn status(scene: &Scene) -> Value {
    let ran = scene.run(&["status", "--out", "out", "--json"]);
    serde_json::from_str(&ran.out).unwrap_or_else(|error| panic!("{error}: {}{}", ran.out, ran.err))
}

fn is_failure_of<'a>(name: &'a str) -> impl Fn(&Line) -> bool + 'a {
    move |line| line.level == "ERROR" && line.is_about(name)
}

#[test]
fn a_corrupt_frame_costs_itself_alone_and_once() {
    let scene = Scene::new();
    let arguments = [&QUICK[..], &NO_SCANS, &FORMATS].concat();
    scene.put_moving([1, 3]);
    let mut corrupt = ply(&moving(2));
    corrupt[20..30].copy_from_slice(b"nonsense..");
    scene.put("in/dam.2.ply", &corrupt);
    let daemon = scene.watch(&arguments);
    let failure = daemon.await_line("the failure is told", is_failure_of("dam.2.ply"));
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

    // It is not even read again, and still counts.
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

/// Makes a named pipe: whoever opens it waits for somebody at its other end.
fn make_pipe(scene: &Scene, within: &str) {
    mknodat(CWD, scene.path(within), FileType::Fifo, Mode::from_raw_mode(0o644), 0).expect("a pipe");
}

/// Everything that may bear the name of a frame and is none, before the daemon starts and while it runs.
#[test]
fn what_is_no_frame_is_no_trouble() {
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
    let daemon = scene.watch(&[&QUICK[..], &NO_SCANS, &FORMATS].concat());
    litter(2);
    scene.put_moving([2]);
    daemon.await_converted("dam.2.ply");
    assert!(daemon.lines(|line| line.level == "ERROR").is_empty(), "{}", daemon.told());
    assert_eq!(daemon.finish().iter().filter(|line| line.is_converted()).count(), 1);
    let names = ["dam.1.obj", "dam.1.vdb", "dam.2.obj", "dam.2.vdb"];
    assert_eq!(names_in(&scene.path("out"))[1..], names);
}

/// The link of the frame leads to itself: nothing can be known of the frame, so it failed.
#[test]
fn frame_that_cannot_be_examined_fails_the_run() {
    let scene = Scene::new();
    symlink(scene.path("in/dam.2.ply"), scene.path("in/dam.2.ply")).expect("a link");
    scene.put_moving([1]);
    let once = scene.once(&[&QUICK[..], &FORMATS].concat());
    once.assert_status(1);
    assert_eq!(once.converted(), ["dam.1.ply"]);
    let is_error =
        |line: &&Line| line.level == "ERROR" && line.message.starts_with("cannot be read: Too many levels");
    assert_eq!(once.log.iter().filter(is_error).count(), 1, "{}", told(&once.log));
}

/// An empty file may be one that is about to be written: it is waited for, and tried again; not forever
/// where that is all there is to do.
#[test]
fn an_empty_file_fails_when_nothing_comes() {
    let scene = Scene::new();
    let daemon = scene.watch(&[&QUICK[..], &NO_SCANS, &FORMATS].concat());
    scene.write("in/dam.2.ply", "");
    scene.put_moving([3]);
    let told = daemon.await_line("it is told", |line| line.is_complaint() && line.is_about("dam.2.ply"));
    assert!(told.message.contains("is empty"), "{}", told.message);
    daemon.await_converted("dam.3.ply");
    daemon.finish();
    scene.once(&[&QUICK[..], &FORMATS].concat()).assert_status(1);
    // Then something comes.
    scene.write("in/dam.2.ply", ply(&moving(2)));
    scene.once(&[&QUICK[..], &FORMATS].concat()).assert_status(0);
    assert_eq!(names_in(&scene.path("out")).len(), 5);
}

/// Root may read everything: then there is nothing to see here.
#[test]
fn a_frame_that_may_not_be_read_is_told_and_tried_again() {
    if geteuid().is_root() {
        return;
    }
    let scene = Scene::new();
    scene.put_moving(1..=2);
    fs::set_permissions(scene.path("in/dam.2.ply"), Permissions::from_mode(0o000)).expect("changed");
    let daemon = scene.watch(&[&QUICK[..], &NO_SCANS, &FORMATS].concat());
    daemon.await_converted("dam.1.ply");
    daemon.await_line("the failure is told", |line| line.is_complaint() && line.is_about("dam.2.ply"));
    fs::set_permissions(scene.path("in/dam.2.ply"), Permissions::from_mode(0o644)).expect("changed");
    daemon.await_converted("dam.2.ply");
    daemon.finish();
    scene.assert_as_converted(&FORMATS);
}

/// In the place of an output: a folder, which cannot be replaced; a pipe, which can, but whoever looks into
/// it first waits forever.
#[test]
fn outputs_whose_place_is_taken_cost_themselves_alone() {
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
