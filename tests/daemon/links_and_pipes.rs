//! Symbolic links and named pipes at paths that the daemon opens: it must not write through links, and must
//! not wait for pipes. If a command waits longer than `TIMEOUT`, the test fails.

use std::fs;
use std::os::unix::fs::symlink;

use rustix::fs::{CWD, FileType, Mode, mknodat};

use crate::daemon::scene::{Scene, names_in};

const FORMATS: [&str; 2] = ["--format", "obj,vdb"];
const QUICK: [&str; 2] = ["--settle", "20ms"];
const ONCE: [&str; 7] = ["watch", "in", "--out", "out", "--once", "--settle", "20ms"];
const STATUS: [&str; 3] = ["status", "--out", "out"];

fn make_pipe(scene: &Scene, within: &str) {
    mknodat(CWD, scene.path(within), FileType::Fifo, Mode::from_raw_mode(0o644), 0).expect("a pipe");
}

/// A scene with a frame and the files in which a daemon keeps its state.
fn scene_with_state() -> Scene {
    let scene = Scene::new();
    scene.put_moving([1]);
    scene.once(&[&QUICK[..], &FORMATS].concat()).assert_status(0);
    scene.write("precious", "precious");
    scene
}

/// The path of the only file of records.
fn records(scene: &Scene) -> String {
    let names = names_in(&scene.path("out/.meniscus")).into_iter();
    let name = names.filter(|name| name.starts_with("frames-")).find(|name| !name.ends_with(".lock"));
    format!("out/.meniscus/{}", name.expect("a file of records"))
}

#[test]
fn lock_that_is_a_link_or_a_pipe_is_refused() {
    let scene = scene_with_state();
    let path = "out/.meniscus/lock";
    let kept = scene.bytes(path);
    for kind in ["a symbolic link", "a pipe"] {
        scene.remove(path);
        match kind {
            "a pipe" => make_pipe(&scene, path),
            _ => symlink(scene.path("precious"), scene.path(path)).expect("a link"),
        }
        for arguments in [&ONCE[..], &STATUS] {
            let result = scene.run(arguments);
            assert_eq!(result.status, Some(2), "{arguments:?}, it is {kind}: {}", result.err);
            let expected = format!("not a regular file: {kind}");
            assert!(result.err.contains(&expected) && result.err.contains(".meniscus"), "{}", result.err);
        }
        assert_eq!(scene.bytes("precious"), b"precious");
    }
    scene.remove(path);
    scene.write(path, kept);
    scene.once(&QUICK).assert_status(0);
}

/// What is recorded there is lost, and its frames are converted again.
#[test]
fn file_of_records_that_is_a_link_or_a_pipe_is_left_out() {
    for is_pipe in [false, true] {
        let scene = scene_with_state();
        let path = records(&scene);
        scene.remove(&path);
        if is_pipe {
            make_pipe(&scene, &path)
        } else {
            symlink(scene.path("precious"), scene.path(&path)).expect("a link")
        }
        let status = scene.run(&STATUS);
        assert!(status.err.contains("not a regular file: "), "{}", status.err);
        let once = scene.once(&[&QUICK[..], &FORMATS].concat());
        once.assert_status(0);
        assert_eq!(once.converted(), ["dam.1.ply"]);
        assert!(once.log.iter().any(|line| line.message.contains("not a regular file: ")));
        assert_eq!(scene.bytes("precious"), b"precious");
    }
}

#[test]
fn output_folder_named_by_the_user_may_be_a_link() {
    let scene = Scene::new();
    scene.put_moving([1]);
    fs::create_dir(scene.path("outputs")).expect("made");
    symlink(scene.path("outputs"), scene.path("out")).expect("a link");
    scene.once(&[&QUICK[..], &FORMATS].concat()).assert_status(0);
    assert!(scene.path("outputs/dam.1.obj").is_file());
    let result = scene.run(&STATUS);
    assert_eq!(result.status, Some(0), "{}", result.err);
}

#[test]
fn file_of_records_that_becomes_a_link_or_a_pipe_is_left_alone_by_a_running_daemon() {
    for is_pipe in [false, true] {
        let scene = scene_with_state();
        let daemon = scene.watch(&[&QUICK[..], &FORMATS].concat());
        let path = records(&scene);
        scene.remove(&path);
        if is_pipe {
            make_pipe(&scene, &path)
        } else {
            symlink(scene.path("precious"), scene.path(&path)).expect("a link")
        }
        scene.put_moving([2]);
        daemon.await_converted("dam.2.ply");
        daemon.finish();
        assert_eq!(scene.bytes("precious"), b"precious");
        let again = scene.once(&[&QUICK[..], &FORMATS].concat());
        again.assert_status(0);
        assert_eq!(again.converted(), [""; 0], "all records are in a new file");
    }
}

/// Pipes at the paths of an output, a file of records, and an input.
#[test]
fn pipes_do_not_block_verify_and_convert() {
    let scene = Scene::new();
    scene.put_moving(1..=2);
    fs::create_dir(scene.path("out")).expect("made");
    let shard = ["convert", "in", "--out", "out", "--shard", "1/1", "--format", "obj"];
    let first = scene.run(&shard);
    assert_eq!(first.status, Some(0), "{}", first.err);
    let verify = || scene.run(&["verify", "out"]);
    assert_eq!(verify().status, Some(0));
    for within in [records(&scene), "out/dam.1.obj".to_owned(), "out/dam.2.obj".to_owned()] {
        let kept = scene.bytes(&within);
        scene.remove(&within);
        make_pipe(&scene, &within);
        let result = verify();
        assert_ne!(result.status, Some(0), "{within}");
        assert!(result.err.contains("not a regular file: a pipe"), "{within}: {}", result.err);
        scene.remove(&within);
        scene.write(&within, kept);
    }
    scene.remove("in/dam.1.ply");
    make_pipe(&scene, "in/dam.1.ply");
    // The outputs cannot be compared with a pipe, and nothing proves that the user removed the input on
    // purpose.
    let verified = verify();
    assert_eq!(verified.status, Some(1), "{}", verified.err);
    let convert = [
        "convert",
        "in/dam.1.ply",
        "--out",
        "again",
        "--preset",
        "paper",
        "--voxel-size",
        "0.1",
        "--skip-done",
    ];
    for arguments in [&convert[..], &convert[..8], &["info", "in"], &shard] {
        let result = scene.run(arguments);
        assert_ne!(result.status, None, "{arguments:?}");
    }
    let result = scene.run(&convert);
    assert_eq!(result.status, Some(2), "{}", result.err);
    assert!(
        result.err.contains("dam.1.ply") && result.err.contains("not a regular file: a pipe"),
        "{}",
        result.err
    );
}
