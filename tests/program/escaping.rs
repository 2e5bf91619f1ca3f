//! Names and contents of files can neither forge lines of output nor control the terminal.

use std::fs;
use std::path::Path;

use serde_json::Value;
use tempfile::{TempDir, tempdir};

use crate::program::scene::{RunResult, block, meniscus, write_ply};

/// A file name with a forged line, an escape sequence for the window title, an 8-bit control sequence, and a
/// character that reverses the direction of text.
const NAME: &str = "dam\nerror: forged\u{1b}]0;title\u{7}\u{9b}31m\u{202e}.1.ply";

/// The name as it is printed.
const SHOWN: &str = "dam\\nerror: forged\\u{1b}]0;title\\u{7}\\u{9b}31m\\u{202e}.1.ply";

/// A folder `in` with a good frame and a damaged one, both with such names.
fn folder() -> TempDir {
    let folder = tempdir().expect("a folder");
    fs::create_dir(folder.path().join("in")).expect("a folder");
    write_ply(&folder.path().join("in").join(NAME), &block(4, 0.0));
    fs::write(folder.path().join("in").join(NAME.replace(".1.", ".2.")), "ply\nformat \u{1b}[2J 1.0\n")
        .expect("written");
    folder
}

/// Runs a command, and asserts that it prints only lines of text, without a forged line.
#[track_caller]
fn run(folder: &Path, arguments: &[&str], status: i32) -> RunResult {
    let result = meniscus(folder, arguments);
    assert_eq!(result.status, status, "{arguments:?}: {} {}", result.out, result.err);
    for text in [&result.out, &result.err] {
        let is_unsafe = |char: char| char != '\n' && meniscus_formats::is_unsafe(char);
        assert!(!text.contains(is_unsafe), "{arguments:?}: {text:?}");
        assert!(!text.lines().any(|line| line.starts_with("error: forged")), "{arguments:?}: {text}");
    }
    result
}

#[test]
fn control_characters_in_file_names_are_escaped_in_all_output() {
    let folder = folder();
    let path = folder.path();
    let frame = &*format!("in/{NAME}");
    let result = run(path, &["convert", "in", "--out", "out", "--report", "report.json"], 1);
    assert!(result.out.contains(SHOWN), "{}", result.out);
    assert!(result.err.contains("unknown encoding `\\u{1b}[2J`"), "{}", result.err);
    run(path, &["convert", frame, "--out", "out", "--frames", "7"], 2);
    run(path, &["convert", "--no-such-option\u{1b}[2J\nerror: forged", frame, "--out", "out"], 2);
    run(path, &["convert", "missing\u{1b}[2J\nerror: forged.ply", "--out", "out"], 2);
    assert!(run(path, &["info", frame], 0).out.starts_with(&format!("in/{SHOWN}: ")));
    let json: Value = serde_json::from_str(&run(path, &["info", "--json", frame], 0).out).expect("JSON");
    assert_eq!(json[0]["file"], *frame, "the name is whole in JSON");
    run(path, &["convert", frame, "--out", "out", "--print-settings"], 0);
    let result = run(path, &["verify", "out", "--input", "in"], 1);
    assert!(result.err.contains("\\u{1b}[2J"), "the reason of a failure is in the record: {}", result.err);
    run(path, &["sequence", "out", "-o", "shot.glb"], 0);
    run(path, &["info", "missing\u{1b}[2J\nerror: forged.ply"], 2);
}

#[test]
fn control_characters_in_file_names_are_escaped_in_the_log_and_in_status() {
    let folder = folder();
    let path = folder.path();
    let text = run(path, &["watch", "in", "--out", "out", "--once", "--settle", "10ms"], 1).err;
    let is_entry = |line: &str| line.contains(" INFO ") || line.contains(" WARN ") || line.contains("ERROR ");
    assert!(text.lines().all(is_entry), "{text}");
    assert!(text.contains(SHOWN), "{text}");
    let status = run(path, &["status", "--out", "out"], 1).out;
    assert!(status.contains(SHOWN), "{status}");
    let status = run(path, &["status", "--out", "out", "--json"], 1).out;
    let status: Value = serde_json::from_str(&status).expect("JSON");
    assert!(status["last_done"][0]["input"].as_str().expect("a path").ends_with(NAME), "{status}");
    run(path, &["status", &format!("in/{NAME}"), "--out", "out"], 0);
    let log = ["watch", "in", "--out", "json", "--once", "--settle", "10ms", "--log", "json"];
    let lines = run(path, &log, 1).err;
    let entries: Vec<Value> = lines.lines().map(|line| serde_json::from_str(line).expect("JSON")).collect();
    let has_name = |entry: &Value| entry.as_object().is_some_and(|fields| fields.values().any(is_name));
    assert!(entries.iter().any(has_name), "the name is whole in JSON: {lines}");
}

fn is_name(value: &Value) -> bool {
    value.as_str().is_some_and(|text| text.ends_with(NAME))
}

#[test]
fn names_and_strings_from_files_are_escaped_by_info() {
    let folder = tempdir().expect("a folder");
    let path = folder.path();
    let header =
        "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\n";
    let header = format!("{header}property float te\u{1b}]0;title\u{7}mp\nend_header\n");
    fs::write(path.join("a.ply"), format!("{header}0 0 0 1\n")).expect("written");
    assert!(run(path, &["info", "a.ply"], 0).out.contains("te\\u{1b}]0;title\\u{7}mp: "));
    run(path, &["info", "--json", "a.ply"], 0);
}

/// A file that is in the folder by mistake may contain secrets, so messages quote little of it.
#[test]
fn messages_quote_little_of_a_file_that_is_not_what_it_should_be() {
    let folder = tempdir().expect("a folder");
    let path = folder.path();
    let secret = "hunter2hunter2hunter2hunter2hunter2";
    for (name, text) in [
        ("a.csv", format!("password={secret}\n")),
        ("b.csv", format!("password={secret},user,host\n")),
        ("c.csv", format!("password={secret}\nx,y,z\n0,0,0\n1,0,0\n0,1,0\n")),
        ("d.csv", format!("x,y,z\n0,0,password={secret}\n")),
        ("e.ply", format!("ply\npassword={secret}\n")),
        ("f.ply", format!("ply\nformat ascii 1.0\nelement vertex password={secret}\n")),
        ("g.vtk", format!("# vtk DataFile Version 3.0\n\npassword={secret}\n")),
        ("h.obj", format!("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 password={secret}\n")),
        ("i.lammpstrj", format!("ITEM: TIMESTEP\npassword={secret}\n")),
    ] {
        fs::write(path.join(name), text).expect("written");
        let result = meniscus(path, &["convert", name, "--out", "out"]);
        let printed = result.out + &result.err;
        assert!(!printed.contains("hunter2"), "{printed}");
    }
    // Messages still show the first line, so that the owner can identify the file.
    let printed = meniscus(path, &["convert", "c.csv", "--out", "out", "--voxel-size", "0.5"]).err;
    assert!(printed.contains("skipped a line above the table: \"password=…\""), "{printed}");
}
