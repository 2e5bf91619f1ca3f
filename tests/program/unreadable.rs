//! Frames whose metadata cannot be read: each such frame fails with a reason, and so does the run.
//!
//! The tests use links instead of broken disks and missing permissions, because root may read everything: a
//! link to itself (ELOOP), a link through a file (ENOTDIR), a link to a name that is too long (ENAMETOOLONG),
//! and a link to a missing file (ENOENT).

use std::ffi::OsStr;
use std::fs;
use std::os::unix::ffi::OsStrExt;
use std::os::unix::fs::symlink;
use std::path::Path;

use tempfile::{TempDir, tempdir};

use crate::program::scene::{meniscus, names_in, write_sequence};

/// A folder in which frames 1 and 2 are valid, and frames 3 to 6 are such links.
fn folder() -> TempDir {
    let folder = tempdir().expect("a folder");
    let frames = folder.path().join("in");
    fs::create_dir(&frames).expect("made");
    write_sequence(&frames, 1, 2);
    for (number, target) in
        [(3, "dam.3.ply"), (4, "dam.1.ply/dam.4.ply"), (5, &*"long".repeat(100)), (6, "nowhere.ply")]
    {
        symlink(target, frames.join(format!("dam.{number}.ply"))).expect("linked");
    }
    folder
}

const REASONS: [(&str, &str); 4] = [
    ("dam.3.ply", "symbolic links"),
    ("dam.4.ply", "Not a directory"),
    ("dam.5.ply", "too long"),
    ("dam.6.ply", "No such file"),
];

fn assert_reasons(err: &str) {
    for (name, reason) in REASONS {
        assert!(err.lines().any(|line| line.contains(name) && line.contains(reason)), "{name}: {err}");
    }
}

#[test]
fn unreadable_frames_fail_the_conversion() {
    let folder = folder();
    for input in ["in", "in/dam.#.ply", "in/dam.*.ply", "i*/dam.#.ply", "**/dam.*.ply"] {
        let arguments = ["convert", input, "--out", "out", "--format", "obj", "--voxel-size", "0.1"];
        let result = meniscus(folder.path(), &arguments);
        assert_eq!(result.status, 1, "{input}: {}", result.err);
        assert_reasons(&result.err);
        assert!(result.out.contains("6 frames: 2 done, 4 failed"), "{input}: {}", result.out);
        assert_eq!(names_in(&folder.path().join("out")), ["dam.1.obj", "dam.2.obj"]);
        fs::remove_dir_all(folder.path().join("out")).expect("removed");
    }
}

#[test]
fn unreadable_frames_fail_the_shards_that_have_them() {
    let folder = folder();
    let path = folder.path();
    fs::create_dir(path.join("out")).expect("made");
    let mut errors = String::new();
    for (shard, status) in [("1/2", 1), ("2/2", 2)] {
        let convert = ["convert", "in", "--out", "out", "--format", "obj", "--voxel-size", "0.1"];
        let result = meniscus(path, &[&convert[..], &["--shard", shard]].concat());
        assert_eq!(result.status, status, "{shard}: {}", result.err);
        errors += &result.err;
    }
    assert_reasons(&errors);
    assert_eq!(names_in(&path.join("out")), ["dam.1.obj", "dam.2.obj"]);
    let result = meniscus(path, &["verify", "out", "--input", "in"]);
    assert!(result.status == 1 && result.out.contains("2 done, 4 missing"), "{} {}", result.out, result.err);
    assert_reasons(&result.err);
}

#[test]
fn unreadable_frames_fail_watch_once() {
    let folder = folder();
    let arguments = ["watch", "in", "--once", "--out", "out", "--format", "obj", "--voxel-size", "0.1"];
    let result = meniscus(folder.path(), &[&arguments[..], &["--settle", "10ms"]].concat());
    assert_eq!(result.status, 1, "{}", result.err);
    for (name, _) in REASONS {
        assert!(result.err.contains(name), "{name}: {}", result.err);
    }
    assert!(folder.path().join("out/dam.2.obj").is_file());
}

/// If a file has no extension, only its contents show whether it is a frame.
#[test]
fn unreadable_file_of_unknown_kind_fails_the_conversion_and_the_shard() {
    let folder = tempdir().expect("a folder");
    let path = folder.path();
    write_sequence(path, 1, 1);
    symlink("odd", path.join("odd")).expect("linked");
    let common = [".", "--out", "o", "--voxel-size", "0.1"];
    let result = meniscus(path, &[&["convert", "--format", "obj"], &common[..]].concat());
    assert_eq!(result.status, 1, "{}", result.err);
    assert!(
        result.err.contains("error: ./odd: ") && result.err.contains("frames are missing from the results"),
        "{}",
        result.err
    );
    assert!(path.join("o/dam.1.obj").is_file());
    let result = meniscus(path, &[&["convert", "--shard", "1/1"], &common[..]].concat());
    assert_eq!(result.status, 2, "{}", result.err);
    assert!(result.err.contains("odd"), "{}", result.err);
    let result = meniscus(path, &[&["convert", "--on-error", "stop"], &common[..]].concat());
    assert_eq!(result.status, 2, "{}", result.err);
}

#[test]
fn obstacle_that_cannot_be_read_is_not_called_missing() {
    let folder = tempdir().expect("a folder");
    let path = folder.path();
    write_sequence(path, 1, 1);
    symlink("body.obj", path.join("body.obj")).expect("linked");
    symlink("body.1.obj", path.join("body.1.obj")).expect("linked");
    for obstacle in ["body.obj", "body.#.obj", "body.{}.obj"] {
        let arguments =
            ["convert", "dam.1.ply", "--out", "out", "--voxel-size", "0.1", "--obstacle", obstacle];
        let result = meniscus(path, &arguments);
        assert_eq!(result.status, 2, "{obstacle}: {}", result.err);
        assert!(result.err.contains("symbolic links"), "{obstacle}: {}", result.err);
    }
}

/// Globs match plain names, hidden names, nested folders, and literal parts after wildcards.
#[test]
fn globs_match_as_documented() {
    let folder = tempdir().expect("a folder");
    let path = folder.path();
    for within in ["a/x", "b/x", ".h/x", "b/y/x"] {
        fs::create_dir_all(path.join(within)).expect("made");
        write_sequence(&path.join(within), 1, 1);
        let name = within.replace('/', "");
        fs::rename(path.join(within).join("dam.1.ply"), path.join(within).join(format!("{name}.1.ply")))
            .expect("renamed");
    }
    symlink("b", path.join("c")).expect("linked");
    fs::write(path.join("a/x").join(OsStr::from_bytes(b"\xff")), "").expect("written");
    for (pattern, expected) in [
        ("*/x/*.ply", &["ax.1.obj", "bx.1.obj"][..]),
        ("[ab]/?/*.1.ply", &["ax.1.obj", "bx.1.obj"]),
        ("c/*/*.ply", &["bx.1.obj"]),
        (".*/x/*.ply", &[".hx.1.obj"]),
        ("b/**/*.ply", &["bx.1.obj", "byx.1.obj"]),
        ("./**/*.ply", &["ax.1.obj", "bx.1.obj", "byx.1.obj"]),
        ("*//x/*.ply", &["ax.1.obj", "bx.1.obj"]),
    ] {
        let arguments = ["convert", pattern, "--out", "out", "--format", "obj", "--voxel-size", "0.1"];
        let result = meniscus(path, &arguments);
        if pattern.starts_with(".*") {
            // A pattern matches a hidden file only if the pattern has the dot.
            assert_eq!(result.status, 2, "{pattern}: {}", result.err);
            continue;
        }
        assert_eq!(result.status, 0, "{pattern}: {}", result.err);
        assert_eq!(names_in(Path::new(&path.join("out"))), expected, "{pattern}");
        fs::remove_dir_all(path.join("out")).expect("removed");
    }
}

/// Only the contents of a .txt show whether it is a frame.
#[test]
fn unreadable_file_beside_level_sets_fails_render_and_contact_sheet() {
    let folder = tempdir().expect("a folder");
    let path = folder.path();
    write_sequence(path, 1, 1);
    let level_sets = ["convert", "dam.1.ply", "--out", "sets", "--format", "vdb", "--voxel-size", "0.1"];
    assert_eq!(meniscus(path, &level_sets).status, 0);
    symlink("dam.3.txt", path.join("sets/dam.3.txt")).expect("linked");
    for arguments in [
        &["render", "sets", "--out", "pictures", "--size", "64x48", "--up", "Z"][..],
        &["contact-sheet", "sets", "-o", "sheet.png"],
    ] {
        let result = meniscus(path, arguments);
        assert_eq!(result.status, 1, "{arguments:?}: {}", result.err);
        assert!(
            result.err.contains("dam.3.txt: Too many levels of symbolic links"),
            "{arguments:?}: {}",
            result.err
        );
    }
    assert!(path.join("pictures/dam.1.png").is_file() && path.join("sheet.png").is_file());
}
