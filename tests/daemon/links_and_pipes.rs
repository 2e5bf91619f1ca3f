//! Symbolic links and named pipes at paths that the daemon opens: it must not write through links, and must
//! not wait for pipes. If a command waits longer than `TIMEOUT`, the test fails.

use std::fs;
use std::os::unix::fs::symlink;

use rustix::fs::{CWD, FileType, Mode, mknodat};

use crate::daemon::scene::{Line, Scene, moving, names_in, ply};

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

#[test]
fn lock_or_journal_that_is_a_link_or_a_pipe_is_refused() {
    let scene = scene_with_state();
    for name in ["lock", "journal"] {
        let path = format!("out/.meniscus/{name}");
        let kept = scene.bytes(&path);
        for kind in ["a symbolic link", "a pipe"] {
            scene.remove(&path);
            match kind {
                "a pipe" => make_pipe(&scene, &path),
                _ => symlink(scene.path("precious"), scene.path(&path)).expect("a link"),
            }
            for arguments in [&ONCE[..], &STATUS] {
                let result = scene.run(arguments);
                assert_eq!(result.status, Some(2), "{arguments:?}, {name} is {kind}: {}", result.err);
                let expected = format!("not a regular file: {kind}");
                assert!(
                    result.err.contains(&expected) && result.err.contains(".meniscus"),
                    "{name}: {}",
                    result.err
                );
            }
            assert_eq!(scene.bytes("precious"), b"precious");
        }
        scene.remove(&path);
        scene.write(&path, kept);
    }
    scene.once(&QUICK).assert_status(0);
}

#[test]
fn state_folder_that_is_a_link_is_refused() {
    let scene = scene_with_state();
    let [state, away] = ["out/.meniscus", "away"].map(|within| scene.path(within));
    fs::rename(&state, &away).expect("renamed");
    symlink(&away, &state).expect("a link");
    let before = scene.bytes("away/journal");
    for arguments in [&ONCE[..], &STATUS] {
        let result = scene.run(arguments);
        assert_eq!(result.status, Some(2), "{}", result.err);
        assert!(result.err.contains(".meniscus is a symbolic link"), "{}", result.err);
    }
    assert_eq!(scene.bytes("away/journal"), before);
}

/// A folder that the user names may be a link: other users cannot predict its name, and so cannot put a link
/// there.
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
fn journal_that_becomes_a_link_or_a_pipe_is_replaced_under_a_running_daemon() {
    let scene = scene_with_state();
    let daemon = scene.watch(&[&QUICK[..], &FORMATS].concat());
    for (number, is_pipe) in [(2, false), (3, true)] {
        scene.remove("out/.meniscus/journal");
        if is_pipe {
            make_pipe(&scene, "out/.meniscus/journal")
        } else {
            symlink(scene.path("precious"), scene.path("out/.meniscus/journal")).expect("a link")
        }
        scene.put_moving([number]);
        daemon.await_converted(&format!("dam.{number}.ply"));
    }
    daemon.finish();
    assert_eq!(scene.bytes("precious"), b"precious");
    assert!(scene.path("out/.meniscus/journal").symlink_metadata().expect("there").is_file());
    let again = scene.once(&[&QUICK[..], &FORMATS].concat());
    again.assert_status(0);
    assert!(again.converted().is_empty() && again.found_done().is_empty(), "the journal knows all");
}

#[test]
fn output_subfolder_that_is_a_link_is_not_written_through() {
    let scene = Scene::new();
    fs::create_dir_all(scene.path("home/deep")).expect("made");
    fs::create_dir(scene.path("out")).expect("made");
    symlink(scene.path("home"), scene.path("out/shot")).expect("a link");
    scene.write("in/shot/dam.1.ply", ply(&moving(1)));
    scene.write("in/shot/deep/dam.1.ply", ply(&moving(1)));
    scene.write("in/other/dam.1.ply", ply(&moving(1)));
    let once = scene.once(&[&QUICK[..], &FORMATS, &["--pattern", "**"]].concat());
    once.assert_status(1);
    let failures = once.log.iter().filter(|line| line.level == "ERROR");
    let is_report = |line: &&Line| line.message.contains("out/shot is a symbolic link");
    assert_eq!(failures.filter(is_report).count(), 2, "{}", crate::daemon::scene::log_text(&once.log));
    assert_eq!(names_in(&scene.path("home")), ["deep"]);
    assert!(names_in(&scene.path("home/deep")).is_empty());
    assert_eq!(names_in(&scene.path("out/other")), ["dam.1.obj", "dam.1.vdb"]);
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
    let records = names_in(&scene.path("out/.meniscus")).into_iter().find(|name| !name.ends_with(".lock"));
    let records = format!(".meniscus/{}", records.expect("a file of records"));
    for name in [&*records, "dam.1.obj", "dam.2.obj"] {
        let within = format!("out/{name}");
        let kept = scene.bytes(&within);
        scene.remove(&within);
        make_pipe(&scene, &within);
        let result = verify();
        assert_ne!(result.status, Some(0), "{name}");
        assert!(result.err.contains("not a regular file: a pipe"), "{name}: {}", result.err);
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
