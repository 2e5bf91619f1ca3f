//! Names of frames and of results: frame numbers, single files, pipes, name clashes.

use std::fs::{self, File};
use std::io::{Read, Write};
use std::path::Path;
use std::process::Stdio;

use tempfile::{TempDir, tempdir};

use crate::program::scene::{RunResult, block, command, meniscus, names_in, write_ply, write_sequence};

const QUICK: [&str; 2] = ["--voxel-size", "0.1"];

fn folder_with(names: &[&str]) -> TempDir {
    let folder = tempdir().expect("a folder");
    fs::create_dir(folder.path().join("in")).expect("made");
    for (index, name) in names.iter().enumerate() {
        // The frames have different spacings, and that of the third rounds to another voxel size. So a test
        // would notice if each frame had its own settings.
        let points: Vec<[f64; 3]> =
            block(6, 0.0).iter().map(|point| point.map(|x| x * (1.0 + 0.04 * index as f64))).collect();
        write_ply(&folder.path().join("in").join(name), &points);
    }
    folder
}

fn convert(folder: &Path, arguments: &[&str]) -> RunResult {
    meniscus(folder, &[&["convert"], arguments, &QUICK].concat())
}

/// Runs `convert` with these bytes on its standard input. Returns the status, the bytes of the standard
/// output, and the messages.
fn pipe(folder: &Path, arguments: &[&str], input: &[u8]) -> (i32, Vec<u8>, String) {
    let mut command = command(folder, &[&["convert"], arguments].concat());
    command.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped());
    let mut child = command.spawn().expect("it starts");
    let mut stdin = child.stdin.take().expect("piped");
    let input = input.to_vec();
    // Writing fails if the command refuses its arguments, and does not read its input.
    let writer = std::thread::spawn(move || drop(stdin.write_all(&input)));
    let output = child.wait_with_output().expect("it ends");
    writer.join().expect("written");
    (output.status.code().expect("a status"), output.stdout, String::from_utf8(output.stderr).expect("text"))
}

#[test]
fn versions_and_subframes_are_one_sequence_everywhere() {
    let is_measured_once = |out: &str, sequence: &str| {
        let line = out.lines().find(|line| line.starts_with(&format!("{sequence}: 3 frames, spacing ")));
        line.is_some_and(|line| line.contains("measured on 3 frames)"))
    };
    for (names, sequence) in [
        (["dam_0001_v003.ply", "dam_0002_v003.ply", "dam_0003_v003.ply"], "dam_{}_v003.ply"),
        (["dam.0001.ply", "dam.0001.50.ply", "dam.0002.ply"], "dam.{}.ply"),
    ] {
        let folder = folder_with(&names);
        let path = folder.path();
        let result = meniscus(path, &["convert", "in", "--out", "out", "--format", "obj"]);
        assert_eq!((result.status, &*result.err), (0, ""), "{}", result.out);
        assert!(is_measured_once(&result.out, sequence), "{}", result.out);
        assert_eq!(names_in(&path.join("out")).len(), 3);
        let arguments = ["plan", "in", "--out", "out", "--output", "plan.json", "--shards", "2"];
        let result = meniscus(path, &arguments);
        assert_eq!((result.status, &*result.err), (0, ""), "{}", result.out);
        assert!(is_measured_once(&result.out, sequence), "{}", result.out);
        let watch = ["watch", "in", "--once", "--out", "watched", "--format", "obj", "--settle", "10ms"];
        let result = meniscus(path, &watch);
        assert_eq!(result.status, 0, "{}", result.err);
        for name in names_in(&path.join("out")) {
            let [one, other] =
                ["out", "watched"].map(|out| fs::read(path.join(out).join(&name)).expect("there"));
            assert!(one == other, "{name}: {}", result.err);
        }
    }
}

#[test]
fn folder_of_single_frames_is_warned_about() {
    let folder = folder_with(&["dam_1_2.ply", "dam_2_3.ply"]);
    let path = folder.path();
    let note = "2 files form 2 sequences of one frame each, so each gets its own particle spacing";
    for arguments in [
        &["convert", "in", "--out", "out", "--format", "obj"][..],
        &["plan", "in", "--out", "out", "--output", "plan.json", "--shards", "2"],
        &["watch", "in", "--once", "--out", "watched", "--format", "obj", "--settle", "10ms"],
    ] {
        let result = meniscus(path, arguments);
        assert_eq!(result.status, 0, "{}", result.err);
        assert_eq!(result.err.matches(note).count(), 1, "{arguments:?}: {}", result.err);
        let result = meniscus(path, &[arguments, &["--spacing", "0.1"]].concat());
        assert!(!result.err.contains(note), "{arguments:?}: {}", result.err);
    }
    let result = meniscus(path, &["convert", "in/dam_#_2.ply", "--out", "out", "--format", "obj"]);
    assert!(!result.err.contains(note), "{}", result.err);
}

#[test]
fn single_frame_is_written_to_the_named_file() {
    let folder = folder_with(&["dam.7.ply"]);
    let path = folder.path();
    for format in ["glb", "gltf", "obj", "ply", "vtp", "stl", "usda", "usdc", "abc", "vdb"] {
        let file = format!("new/x.{format}");
        let short = convert(path, &["in/dam.7.ply", "-o", &file]);
        assert_eq!((short.status, &*short.err), (0, ""), "{format}: {}", short.out);
        assert_eq!(names_in(&path.join("new")), [format!("x.{format}")]);
        let result = convert(path, &["in", "--out", "whole", "--format", format]);
        assert_eq!(result.status, 0, "{}", result.err);
        let whole = fs::read(path.join(format!("whole/dam.7.{format}"))).expect("there");
        assert!(fs::read(path.join(&file)).expect("there") == whole, "{format}");
        let again = convert(path, &["in/dam.7.ply", "--skip-done", "--out", &file]);
        assert!(again.status == 0 && again.out.contains("done"), "{format}: {} {}", again.out, again.err);
        fs::remove_dir_all(path.join("new")).expect("removed");
    }
    let result = meniscus(path, &["convert", "in", "-o", "x.vtp", "--particles-only"]);
    assert_eq!(result.status, 0, "{}", result.err);
    let result = convert(path, &["in", "-o", "y.vdb"]);
    assert_eq!(result.status, 0, "{}", result.err);
    let result = meniscus(path, &["convert", "y.vdb", "-o", "y.stl", "--format", "stl"]);
    assert_eq!(result.status, 0, "{}", result.err);
    assert_eq!(names_in(path), ["in", "whole", "x.vtp", "y.stl", "y.vdb"]);
}

#[test]
fn file_name_that_cannot_be_written_is_refused_with_a_remedy() {
    let folder = tempdir().expect("a folder");
    let path = folder.path();
    write_sequence(path, 1, 2);
    for (arguments, words) in [
        (&["convert", "dam.#.ply", "-o", "x.obj"][..], &["x.obj", "2 frames", "name a folder"][..]),
        (&["convert", "dam.#.ply", "-o", "-"], &["standard output", "2 frames", "name a folder"]),
        (&["convert", "dam.1.ply", "-o", "x.obj", "--format", "ply"], &["x.obj", "--format"]),
        (&["convert", "dam.1.ply", "-o", "x.png"], &["x.png", "meniscus render"]),
        (&["convert", "dam.1.ply", "-o", "dam.1.ply"], &["would replace the input"]),
        (
            &["convert", "dam.1.ply", "-o", "x.stl", "--particles-only"],
            &["--particles-only writes ply and vtp"],
        ),
        (&["convert", "dam.1.ply", "-o", "-", "--format", "ply,obj"], &["one format"]),
        (&["convert", "dam.1.ply", "-o", "-", "--skip-done"], &["--skip-done"]),
        (&["convert", "dam.1.ply", "-o", "o", "--input-format", "ply"], &["--input-format"]),
        (
            &["plan", "dam.#.ply", "--out", "x.glb", "--output", "p.json", "--shards", "1"],
            &["x.glb", "folder"],
        ),
        (&["plan", "dam.#.ply", "--out", "-", "--output", "p.json", "--shards", "1"], &["name a folder"]),
        (&["watch", ".", "--once", "--out", "x.glb"], &["x.glb", "folder"]),
        (&["convert", "dam.1.ply", "-o", "X.PLY"], &["X.PLY", "use X.ply"]),
        (&["convert", "dam.1.ply", "-o", "x.Png"], &["x.Png", "meniscus render"]),
        (&["watch", ".", "--once", "--out", "dam.GLB"], &["dam.GLB", "folder"]),
        (
            &["convert", "dam.#.ply", "--out", "x.fbx"],
            &["x.fbx: .fbx is not an output format: use .glb,", "for a folder of this name, write x.fbx/"],
        ),
        (&["convert", "dam.1.ply", "-o", "new/x.USD"], &["new/x.USD: .USD is not", "write new/x.USD/"]),
        (&["convert", "dam.1.ply", "-o", "x.gbl"], &["x.gbl: .gbl is not", "write x.glb", "write x.gbl/"]),
        (&["convert", "dam.1.ply", "-o", "x.glft"], &["write x.gltf"]),
        (&["convert", "dam.1.ply", "-o", "x.us.objj"], &["write x.us.obj"]),
        (
            &["plan", "dam.#.ply", "--out", "x.dae", "--output", "p.json", "--shards", "1"],
            &["x.dae: .dae is not an output format"],
        ),
        (&["watch", ".", "--once", "--out", "x.bgeo"], &["x.bgeo: .bgeo is not an output format"]),
    ] {
        let result = meniscus(path, arguments);
        assert_eq!(result.status, 2, "{arguments:?}: {} {}", result.out, result.err);
        for word in words {
            assert!(result.err.contains(word), "{arguments:?} does not say {word}: {}", result.err);
        }
    }
    assert_eq!(names_in(path), ["dam.1.ply", "dam.2.ply"]);
    // A folder may have any name.
    fs::create_dir(path.join("old.obj")).expect("made");
    fs::create_dir(path.join("old.fbx")).expect("made");
    for out in
        ["old.obj", "new.obj/", "old.fbx", "new.fbx/", "run.v2", "cache.0001", "all.objs", "a.old", "b.max"]
    {
        let result = convert(path, &["dam.#.ply", "--format", "obj", "--out", out]);
        assert_eq!(result.status, 0, "{}", result.err);
        assert_eq!(names_in(&path.join(out)), ["dam.1.obj", "dam.2.obj"]);
    }
}

#[test]
fn standard_input_and_output_carry_one_frame() {
    let folder = folder_with(&["dam.7.ply"]);
    let path = folder.path();
    let bytes = fs::read(path.join("in/dam.7.ply")).expect("there");
    let voxels = QUICK;
    for (input, output, format) in [
        (&["-", "--input-format", "ply"][..], &["-o", "-"][..], "glb"),
        (&["-"], &["--out", "-", "--format", "obj"], "obj"),
    ] {
        let (status, out, err) = pipe(path, &[input, output, &voxels].concat(), &bytes);
        assert_eq!(status, 0, "{err}");
        assert!(err.contains("1 frame: 1 done"), "{err}");
        // The output is the same as for files with these names.
        let same = tempdir().expect("a folder");
        let name = if input.len() > 1 { "stdin.ply" } else { "stdin" };
        fs::write(same.path().join(name), &bytes).expect("written");
        let result = convert(same.path(), &[name, "--format", format, "-o", &format!("x.{format}")]);
        assert_eq!(result.status, 0, "{}", result.err);
        assert!(out == fs::read(same.path().join(format!("x.{format}"))).expect("there"), "{format}");
    }
    for arguments in [&["in", "-o", "-", "--print-settings"][..], &["-", "-o", "-", "--print-settings"]] {
        let (status, out, err) = pipe(path, arguments, &bytes);
        assert_eq!((status, &*err), (0, ""), "{arguments:?}");
        assert!(String::from_utf8_lossy(&out).contains("formats = [\"glb\"]"), "{arguments:?}: {out:?}");
    }
    let (status, out, err) = pipe(path, &["-", "-o", "y.obj", "--voxel-size", "0.1"], &bytes);
    assert_eq!((status, &*err), (0, ""));
    assert!(!out.is_empty() && path.join("y.obj").is_file());
    for (arguments, input, words) in [
        (&["-", "-o", "-"][..], &b""[..], "standard input is empty"),
        (&["-", "in", "-o", "x"], b"0 0 0", "only INPUT"),
        (&["-", "-o", "-", "--input-format", "doc"], b"0 0 0", "--input-format doc"),
        (&["-", "-o", "-", "--memory", "1MiB"], &[b'x'; (1 << 20) + 1], "--memory"),
    ] {
        let (status, out, err) = pipe(path, arguments, input);
        assert_eq!((status, out.len()), (2, 0), "{arguments:?}: {err}");
        assert!(err.contains(words), "{arguments:?}: {err}");
    }
}

/// Messages never contain the name of the temporary copy of a pipe.
#[test]
fn errors_and_reports_of_a_pipe_name_the_standard_input() {
    let folder = folder_with(&["dam.7.ply"]);
    let path = folder.path();
    let bytes = fs::read(path.join("in/dam.7.ply")).expect("there");
    let arguments =
        ["-", "--input-format", "ply", "-o", "x.obj", "--voxel-size", "0.1", "--report", "r.json"];
    for (input, status) in [(&bytes[..bytes.len() - 5], 2), (&bytes, 0)] {
        let (found, out, err) = pipe(path, &arguments, input);
        assert_eq!(found, status, "{err}");
        let out = String::from_utf8(out).expect("text");
        let report = fs::read_to_string(path.join("r.json")).expect("a report");
        assert!(report.contains("\"standard input\""), "{report}");
        assert!(status == 0 || err.contains("error: standard input: "), "{err}");
        let temporary = std::env::temp_dir().display().to_string();
        for text in [&out, &err, &report] {
            assert!(!text.contains(&temporary) && !text.contains("/stdin"), "{text}");
        }
    }
}

#[test]
#[cfg(target_os = "linux")]
fn device_names_of_pipes_are_read() {
    let folder = folder_with(&["dam.7.ply"]);
    let bytes = fs::read(folder.path().join("in/dam.7.ply")).expect("there");
    let (status, _, err) = pipe(folder.path(), &["/dev/stdin", "-o", "x.obj", "--voxel-size", "0.1"], &bytes);
    assert_eq!((status, &*err), (0, ""));
    assert_eq!(names_in(folder.path()), ["in", "x.obj"]);
}

/// A reader that closes the pipe causes an error, and no frame is written partly.
#[test]
fn closed_standard_output_is_an_error() {
    let folder = folder_with(&["dam.7.ply"]);
    let arguments = ["convert", "in", "-o", "-", "--voxel-size", "0.1"];
    let mut command = command(folder.path(), &arguments);
    let mut child = command
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .expect("it starts");
    drop(child.stdout.take());
    let mut err = String::new();
    child.stderr.take().expect("piped").read_to_string(&mut err).expect("text");
    assert_eq!(child.wait().expect("it ends").code(), Some(2), "{err}");
    assert!(err.contains("cannot write to the standard output"), "{err}");
}

#[test]
fn one_of_two_files_for_one_result_is_converted() {
    let folder = folder_with(&["dam.1.ply", "dam.2.ply"]);
    let path = folder.path();
    let mut packed = flate2::write::GzEncoder::new(
        File::create(path.join("in/dam.1.ply.gz")).expect("made"),
        flate2::Compression::default(),
    );
    packed.write_all(&fs::read(path.join("in/dam.1.ply")).expect("there")).expect("packed");
    packed.finish().expect("packed");
    for number in 1..=2 {
        fs::write(path.join(format!("in/dam.{number}.csv")), "x,y,z\n0,0,0\n0.1,0,0\n").expect("written");
    }
    let expected = convert(path, &["in/dam.#.csv", "--out", "expected", "--format", "obj"]);
    assert_eq!(expected.status, 0, "{}", expected.err);
    let result = convert(path, &["in", "--out", "out", "--format", "obj"]);
    assert_eq!(result.status, 1, "{}", result.err);
    for words in [
        "in/dam.1.csv and in/dam.1.ply would both become dam.1.*",
        "in/dam.1.ply and 1 more frame of dam.{}.ply are left out: convert them",
    ] {
        assert!(result.err.contains(words), "{words}: {}", result.err);
    }
    assert!(result.err.contains("in/dam.1.csv and in/dam.1.ply.gz would both become"), "{}", result.err);
    assert!(result.out.contains("2 frames: 2 done, 3 left out"), "{}", result.out);
    // The daemon gives the output name to the file that is complete first. By default, it waits longer until
    // it considers a table complete.
    let watch = ["watch", "in", "--once", "--out", "watched", "--format", "obj"];
    let timeouts = ["--settle", "10ms", "--settle-unverifiable", "10ms"];
    let watched = meniscus(path, &[&watch[..], &timeouts, &QUICK].concat());
    assert_eq!(watched.status, 1, "{}", watched.err);
    for name in ["dam.1.obj", "dam.2.obj"] {
        let [one, two, three] =
            ["expected", "out", "watched"].map(|out| fs::read(path.join(out).join(name)).expect("there"));
        assert!(one == two && two == three, "{name}");
    }
    let plan = ["plan", "in", "--out", "planned", "--output", "plan.json", "--shards", "1"];
    let result = meniscus(path, &[&plan[..], &QUICK].concat());
    assert_eq!(result.status, 1, "{}", result.err);
    assert!(
        result.err.contains("would both become") && result.out.contains("2 frames in 1 shard"),
        "{}",
        result.out
    );
}
