//! Names that are not Unicode: the names of outputs have the same bytes.

use std::ffi::OsStr;
use std::fs;
use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpStream;
use std::os::unix::ffi::OsStrExt;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use serde_json::Value;

use crate::hostile::scene::{Scene, block_ply};

/// A name in Latin 1, as on old disks. In messages, the names of the two frames look the same.
const FOLDER: &[u8] = b"caf\xe9";
const FRAMES: [&[u8]; 2] = [b"gr\xf6\xdfe.1", b"gr\xfc\xdfe.1"];
const OUT: &[u8] = b"aus\xff";

fn path(parts: &[&[u8]]) -> PathBuf {
    parts.iter().map(|part| OsStr::from_bytes(part)).collect()
}

fn scene() -> Scene {
    let scene = Scene::new();
    fs::create_dir(scene.path(path(&[FOLDER]))).expect("made");
    for (stem, shift) in FRAMES.into_iter().zip([0.0, 1.0]) {
        scene.write(path(&[FOLDER, &[stem, b".ply"].concat()]), block_ply(shift));
    }
    scene
}

#[track_caller]
fn assert_outputs(folder: &Path) {
    let mut names: Vec<Vec<u8>> = fs::read_dir(folder)
        .expect("the folder of the outputs")
        .map(|entry| entry.expect("an entry").file_name().as_bytes().to_vec())
        .filter(|name| !name.starts_with(b".") && name.ends_with(b".obj"))
        .collect();
    names.sort();
    assert_eq!(names, FRAMES.map(|stem| [stem, b".obj"].concat()), "{}", folder.display());
}

#[test]
fn frames_with_names_that_are_not_unicode_are_converted() {
    let scene = scene();
    let arguments =
        ["convert", "--voxel-size=0.1", "--format=obj", "--report=report.json"].map(PathBuf::from);
    let folders = [path(&[FOLDER]), "--out".into(), path(&[OUT])];
    let first = scene.run(&[&arguments[..], &folders].concat());
    assert_eq!(first.status, Some(0), "{}", first.err);
    assert_outputs(&scene.path(path(&[OUT])));
    let report = fs::read(scene.path("report.json")).expect("a report");
    let report: Value = serde_json::from_slice(&report).expect("JSON");
    assert_eq!(report["frames"].as_array().map(Vec::len), Some(2), "{report}");
    // A second run recognizes them.
    let folders = [path(&[FOLDER]), "--out".into(), path(&[OUT])];
    let second = scene.run(&[&arguments[..3], &folders].concat());
    assert_eq!(second.status, Some(0), "{}", second.err);
    let info = scene.run(&[PathBuf::from("info"), path(&[FOLDER, &[FRAMES[0], b".ply"].concat()])]);
    assert_eq!(info.status, Some(0), "{}", info.err);
}

#[test]
fn folders_with_names_that_are_not_unicode_are_watched() {
    let scene = scene();
    let arguments =
        ["watch", "--once", "--voxel-size=0.1", "--format=obj", "--settle=50ms"].map(PathBuf::from);
    let folders = [path(&[FOLDER]), "--out".into(), path(&[OUT])];
    let result = scene.run(&[&arguments[..], &folders].concat());
    assert_eq!(result.status, Some(0), "{}", result.err);
    assert_outputs(&scene.path(path(&[OUT])));
    let status = scene.run(&["status".into(), "--json".into(), "--out".into(), path(&[OUT])]);
    let status: Value =
        serde_json::from_str(&status.out).unwrap_or_else(|error| panic!("{error}: {status:?}"));
    assert_eq!(status["counts"]["done"], 2, "{status}");
    // The daemon recognizes them.
    let again = scene.run(&[&arguments[..], &folders].concat());
    assert_eq!(again.status, Some(0), "{}", again.err);
    assert!(!again.err.contains("converted 2"), "{}", again.err);
}

/// The records keep the bytes of such names.
#[test]
fn names_that_are_not_unicode_are_recorded() {
    let scene = scene();
    let convert = ["convert", "--skip-done", "--voxel-size=0.1", "--format=obj"].map(PathBuf::from);
    let folders = [path(&[FOLDER]), "--out".into(), path(&[OUT])];
    let run = || scene.run(&[&convert[..], &folders].concat());
    assert_eq!(run().status, Some(0));
    let again = run();
    assert_eq!(again.out.matches("done already").count(), 2, "{}", again.out);
    let verified = scene.run(&["verify".into(), path(&[OUT])]);
    assert_eq!((verified.status, &*verified.err), (Some(0), ""));
    assert!(verified.out.starts_with("2 frames: 2 done"), "{}", verified.out);
}

/// A browser can request outputs by the displayed name.
#[test]
fn page_shows_names_that_are_not_unicode() {
    let scene = scene();
    let mut child = Command::new(env!("CARGO_BIN_EXE_meniscus"))
        .args([
            "watch",
            "--voxel-size=0.1",
            "--format=obj",
            "--settle=50ms",
            "--log=json",
            "--listen=127.0.0.1:0",
        ])
        .args([path(&[FOLDER]), "--out".into(), path(&[OUT])])
        .current_dir(scene.path(""))
        .stderr(Stdio::piped())
        .spawn()
        .expect("it starts");
    let log = BufReader::new(child.stderr.take().expect("a pipe"));
    let mut address = String::new();
    let mut converted_count = 0;
    for line in log.lines().map_while(Result::ok) {
        let line: Value = serde_json::from_str(&line).unwrap_or_default();
        if let Some(found) = line["fields"]["address"].as_str().or(line["address"].as_str()) {
            address = found.trim_start_matches("http://").trim_end_matches('/').to_owned();
        }
        let message = line["fields"]["message"].as_str().or(line["message"].as_str());
        converted_count += usize::from(message == Some("converted"));
        if converted_count == FRAMES.len() && !address.is_empty() {
            break;
        }
    }
    let frames: Value = serde_json::from_str(&get(&address, "/api/frames")).expect("JSON");
    let names: Vec<&str> = frames["frames"]
        .as_array()
        .into_iter()
        .flatten()
        .filter_map(|frame| frame["name"].as_str())
        .collect();
    assert_eq!(names.len(), 2, "{frames}");
    assert_ne!(names[0], names[1]);
    for name in names {
        let frame: Value =
            serde_json::from_str(&get(&address, &format!("/api/frames/{}", encoded(name)))).expect("JSON");
        let output = frame["outputs"][0]["name"].as_str().unwrap_or_else(|| panic!("{frame}"));
        assert!(get(&address, &format!("/files/{}", encoded(output))).starts_with("# "), "{output}");
    }
    child.kill().expect("it runs");
    child.wait().expect("it ends");
}

fn encoded(name: &str) -> String {
    name.bytes().map(|byte| format!("%{byte:02x}")).collect()
}

/// The body of the response to a request.
fn get(address: &str, path: &str) -> String {
    let mut stream = TcpStream::connect(address).expect("a server");
    write!(stream, "GET {path} HTTP/1.1\r\nHost: {address}\r\nConnection: close\r\n\r\n").expect("sent");
    let mut answer = String::new();
    stream.read_to_string(&mut answer).expect("an answer");
    let (head, body) = answer.split_once("\r\n\r\n").unwrap_or_else(|| panic!("{answer}"));
    assert!(head.starts_with("HTTP/1.1 200 "), "{path}: {answer}");
    body.to_owned()
}
