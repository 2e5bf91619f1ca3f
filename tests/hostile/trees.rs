//! Cycles of links, and files that the command may not read or write.

use std::fs::{self, Permissions};
use std::os::unix::fs::{PermissionsExt, symlink};
use std::process::Command;

use crate::hostile::scene::{RunResult, Scene, print_line};
use crate::program::scene::names_in;

fn add_loops(scene: &Scene) {
    fs::create_dir_all(scene.path("in/a/b")).expect("made");
    for (target, link) in [
        ("self.1.ply", "in/self.1.ply"),
        ("pong.1.ply", "in/ping.1.ply"),
        ("ping.1.ply", "in/pong.1.ply"),
        (".", "in/here"),
        ("..", "in/up"),
        ("../..", "in/a/b/top"),
        ("nowhere.ply", "in/broken.1.ply"),
    ] {
        symlink(target, scene.path(link)).expect("linked");
    }
}

#[test]
fn link_cycles_do_not_stop_conversion() {
    let scene = Scene::new();
    add_loops(&scene);
    let result = scene.convert();
    assert!(matches!(result.status, Some(0 | 1)), "{}", result.err);
    scene.assert_good_frames_are_there();
    // A glob through all folders must end, too.
    let arguments = ["convert", "in/**/*.ply", "--out", "globbed", "--voxel-size", "0.1", "--format", "obj"];
    let result = scene.run(&arguments);
    assert!(matches!(result.status, Some(0 | 1)), "{}", result.err);
    assert_eq!(names_in(&scene.path("globbed")), ["dam.1.obj", "dam.2.obj"], "{}", result.err);
}

#[test]
fn link_cycles_do_not_stop_the_daemon() {
    let scene = Scene::new();
    add_loops(&scene);
    let arguments = [
        "watch",
        "in",
        "--pattern",
        "**",
        "--once",
        "--out",
        "out",
        "--voxel-size",
        "0.1",
        "--format",
        "obj",
    ];
    let result = scene.run(&[&arguments[..], &["--settle", "50ms"]].concat());
    assert!(matches!(result.status, Some(0 | 1)), "{}", result.err);
    scene.assert_good_frames_are_there();
    assert_eq!(
        result.err.matches("dam.1.ply").count(),
        result.err.matches("dam.2.ply").count(),
        "{}",
        result.err
    );
}

/// Runs the command as a user without root's rights; `None` if that is impossible.
fn run_without_privileges(scene: &Scene, arguments: &[&str]) -> Option<RunResult> {
    let program = scene.path("meniscus");
    // A separate process copies the program. If this process copied it, a test that starts a child at this
    // moment would pass on the open descriptor, and a file that is open for writing cannot be executed.
    let copied = Command::new("cp").arg(env!("CARGO_BIN_EXE_meniscus")).arg(&program).status();
    assert!(copied.is_ok_and(|status| status.success()));
    fs::set_permissions(scene.path(""), Permissions::from_mode(0o777)).expect("changed");
    fs::set_permissions(&program, Permissions::from_mode(0o755)).expect("changed");
    let mut command = Command::new("setpriv");
    command.args(["--reuid=65534", "--regid=65534", "--clear-groups"]);
    let has_setpriv = Command::new("setpriv").args(["--reuid=65534", "true"]).status();
    if !has_setpriv.is_ok_and(|status| status.success()) {
        print_line("not tested: cannot change the user here");
        return None;
    }
    command.arg(program).args(arguments);
    Some(scene.run_command(command))
}

fn forbid(scene: &Scene, within: &str) {
    fs::set_permissions(scene.path(within), Permissions::from_mode(0o000)).expect("changed");
}

#[test]
fn unreadable_frame_does_not_stop_others() {
    let scene = Scene::new();
    fs::create_dir(scene.path("in/closed")).expect("made");
    for name in ["in/closed/dam.1.ply", "in/closed.1.ply", "in/closed.1.txt"] {
        fs::copy(scene.path("in/dam.1.ply"), scene.path(name)).expect("copied");
    }
    ["in/closed", "in/closed.1.ply", "in/closed.1.txt"].iter().for_each(|within| forbid(&scene, within));
    let arguments = ["convert", "in", "--out", "out", "--voxel-size", "0.1", "--format", "obj"];
    let Some(result) = run_without_privileges(&scene, &arguments) else { return };
    assert_eq!(result.status, Some(1), "{}", result.err);
    assert!(result.err.contains("closed.1.ply") && result.err.contains("ermission denied"), "{}", result.err);
    scene.assert_good_frames_are_there();
    // A glob reads folders, and reports those that it cannot read.
    let globbed = ["convert", "in/**/dam.*.ply", "--out", "out2", "--voxel-size", "0.1", "--format", "obj"];
    let Some(result) = run_without_privileges(&scene, &globbed) else { return };
    assert_eq!(result.status, Some(1), "{}", result.err);
    assert!(scene.path("out2/dam.2.obj").is_file(), "{}", result.err);
    let watched = [
        "watch",
        "in",
        "--pattern",
        "**",
        "--once",
        "--out",
        "out3",
        "--voxel-size",
        "0.1",
        "--format",
        "obj",
    ];
    let watched = [&watched[..], &["--settle", "50ms"]].concat();
    let Some(result) = run_without_privileges(&scene, &watched) else { return };
    assert_eq!(result.status, Some(1), "{}", result.err);
    assert!(scene.path("out3/dam.2.obj").is_file(), "{}", result.err);
}

/// All frames that can be found are converted; a folder whose frames cannot be found makes the run fail.
#[test]
fn unreadable_subfolder_fails_the_run() {
    let scene = Scene::new();
    fs::create_dir(scene.path("in/closed")).expect("made");
    forbid(&scene, "in/closed");
    // A closed folder in a path without a wildcard is also an error with a reason.
    for (input, status) in [("in/**/dam.*.ply", 1), ("in/closed/dam.#.ply", 2)] {
        let arguments = ["convert", input, "--out", "out", "--voxel-size", "0.1", "--format", "obj"];
        let Some(result) = run_without_privileges(&scene, &arguments) else { return };
        assert_eq!(result.status, Some(status), "{input}: {}", result.err);
        assert!(
            result.err.contains("closed") && result.err.contains("ermission denied"),
            "{input}: {}",
            result.err
        );
    }
    scene.assert_good_frames_are_there();
    let shard = ["convert", "in/**/dam.*.ply", "--out", "out", "--voxel-size", "0.1", "--shard", "1/1"];
    let Some(result) = run_without_privileges(&scene, &shard) else { return };
    assert_eq!(result.status, Some(2), "{}", result.err);
    assert!(result.err.contains("closed: Permission denied"), "{}", result.err);
    let watched = ["watch", "in", "--pattern", "**/dam.?.ply", "--once", "--out", "out3"];
    let watched = [&watched[..], &["--voxel-size", "0.1", "--format", "obj", "--settle", "50ms"]].concat();
    let Some(result) = run_without_privileges(&scene, &watched) else { return };
    assert_eq!(result.status, Some(1), "{}", result.err);
    assert!(result.err.contains("in/closed") && scene.path("out3/dam.2.obj").is_file(), "{}", result.err);
}

/// A folder can be listed but not entered: only the names of its frames are known.
#[test]
fn frames_in_a_folder_without_the_right_to_enter_fail() {
    let scene = Scene::new();
    fs::set_permissions(scene.path("in"), Permissions::from_mode(0o744)).expect("changed");
    for input in ["in", "in/dam.*.ply", "in/dam.#.ply"] {
        let arguments = ["convert", input, "--out", "out", "--voxel-size", "0.1", "--format", "obj"];
        let Some(result) = run_without_privileges(&scene, &arguments) else { return };
        assert_eq!(result.status, Some(2), "{input}: {}", result.err);
        assert!(result.err.contains("dam.1.ply: Permission denied"), "{input}: {}", result.err);
    }
    let watched = ["watch", "in", "--once", "--out", "out", "--voxel-size", "0.1", "--settle", "50ms"];
    let Some(result) = run_without_privileges(&scene, &watched) else { return };
    assert_eq!(result.status, Some(2), "{}", result.err);
    assert!(result.err.contains("dam.1.ply") && result.err.contains("ermission denied"), "{}", result.err);
}

#[test]
fn unwritable_output_is_an_error() {
    let scene = Scene::new();
    for folder in ["out", "out/inner"] {
        fs::create_dir(scene.path(folder)).expect("made");
        fs::set_permissions(scene.path(folder), Permissions::from_mode(0o555)).expect("changed");
    }
    for out in ["out", "out/inner", "out/new"] {
        let arguments = ["convert", "in", "--out", out, "--voxel-size", "0.1", "--format", "obj"];
        let Some(result) = run_without_privileges(&scene, &arguments) else { return };
        assert!(matches!(result.status, Some(1 | 2)), "{}", result.err);
        assert!(result.err.contains("ermission denied"), "{}", result.err);
        let watched = ["watch", "in", "--once", "--out", out, "--voxel-size", "0.1", "--settle", "50ms"];
        let Some(result) = run_without_privileges(&scene, &watched) else { return };
        assert!(matches!(result.status, Some(1 | 2)), "{}", result.err);
        assert!(result.err.contains("ermission denied"), "{}", result.err);
    }
}
