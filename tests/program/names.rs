//! Names of frames and of results: frame numbers, single files, pipes, name clashes.

use std::fs::{self, File};
use std::io::{Read, Write};
use std::path::Path;
use std::process::Stdio;

use meniscus_formats::{OutputFormat, abc};
use tempfile::{TempDir, tempdir};

use crate::program::scene::{RunResult, block, command, meniscus, names_in, write_ply, write_sequence};

const QUICK: [&str; 2] = ["--voxel-size", "0.1"];

fn folder_with(names: &[&str]) -> TempDir {
    let folder = tempdir().expect("a folder");
    fs::create_dir(folder.path().join("in")).expect("made");
    for (index, name) in names.iter().enumerate() {
        // The frames have different spacings, and that of the third rounds to another voxel size. So a test
        // would notice if each frame had its own settings. If they differed more, a warning would appear.
        let points: Vec<[f64; 3]> =
            block(6, 0.0).iter().map(|point| point.map(|x| x * (1.0 + 0.04 * index.min(2) as f64))).collect();
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

/// The paths in a stage, in their order.
fn played(stage: &Path) -> Vec<String> {
    let text = fs::read_to_string(stage).expect("a stage");
    let (_, list) = text.split_once("assetPaths = [").expect("a list");
    let (list, _) = list.split_once(']').expect("its end");
    list.split(", ").map(|path| path.trim_matches('@').to_owned()).collect()
}

#[test]
fn times_in_names_are_one_sequence_in_the_order_of_their_values() {
    let times = ["0.0", "0.05", "0.1", "0.15", "0.9500", "1.0000", "1.0500"];
    for (names, pattern) in [(&times[..4], "result_{}.ply"), (&times[4..], "p_{}.ply")] {
        let inputs: Vec<String> = names.iter().map(|time| pattern.replace("{}", time)).collect();
        let folder = folder_with(&inputs.iter().map(String::as_str).collect::<Vec<_>>());
        let path = folder.path();
        let arguments = ["--format", "glb,usdc", "--stage", "out/shot.usda", "--sequence", "all.abc"];
        let result = meniscus(path, &[&["convert", "in", "--out", "out"], &arguments[..]].concat());
        assert_eq!((result.status, &*result.err), (0, ""), "{}", result.out);
        assert!(
            result.out.contains(&format!("{pattern}: {} frames, spacing ", names.len())),
            "{}",
            result.out
        );
        let expected: Vec<String> =
            inputs.iter().map(|name| format!("./{}", name.replace(".ply", ".usdc"))).collect();
        assert_eq!(played(&path.join("out/shot.usda")), expected);
        let shot = fs::read(path.join("all.abc")).expect("a shot");
        assert_eq!(abc::read_times(&shot).expect("times")[0], 1.0 / 24.0);
        let again = meniscus(path, &["sequence", "out", "-o", "again.abc"]);
        assert_eq!((again.status, &*again.err), (0, ""));
        assert!(fs::read(path.join("again.abc")).expect("a shot") == shot);
        let by_pattern =
            meniscus(path, &["convert", &format!("in/{pattern}"), "--out", "p", "--print-settings"]);
        assert_eq!((by_pattern.status, &*by_pattern.err), (0, ""));
        let watch = ["watch", "in", "--once", "--out", "watched", "--settle", "10ms", "--format", "glb,usdc"];
        let result = meniscus(path, &[&watch[..], &["--stage", "watched/shot.usda"]].concat());
        assert_eq!(result.status, 0, "{}", result.err);
        for name in names_in(&path.join("out")).iter().filter(|name| !name.ends_with(".json")) {
            let [one, other] =
                ["out", "watched"].map(|out| fs::read(path.join(out).join(name)).expect("there"));
            assert!(one == other, "{name}: {}", result.err);
        }
        for command in [
            &["contact-sheet", "in", "-o", "s.png", "--size", "64x48"][..],
            &["tune", "in", "-o", "t.png", "--size", "64x48", "--vary", "position-smoothing=0,0.5"],
        ] {
            let result = meniscus(path, command);
            assert_eq!(result.status, 0, "{command:?}: {}", result.err);
        }
        let result = meniscus(path, &["convert", "in", "--out", "o", "--frames", "0-1"]);
        assert!(result.status == 2 && result.err.contains("have times: select"), "{}", result.err);
    }
}

/// A stage plays the files that have other names than the frames, and not those of an earlier run.
#[test]
fn stage_plays_results_with_names_of_their_own() {
    let folder = tempdir().expect("a folder");
    let path = folder.path();
    write_sequence(path, 1, 3);
    for out in ["q", "q/w.####.usdc"] {
        let stage = ["--format", "usdc", "--stage", "q/shot.usda"];
        let result = meniscus(path, &[&["convert", "dam.#.ply", "--out", out], &stage[..]].concat());
        assert_eq!((result.status, &*result.err), (0, ""), "{}", result.out);
    }
    let stage = played(&path.join("q/shot.usda"));
    assert_eq!(stage, [1, 2, 3].map(|number| format!("./w.000{number}.usdc")));
}

#[test]
fn folders_of_times_are_one_sequence() {
    let folder = tempdir().expect("a folder");
    let path = folder.path();
    let times = ["0", "0.05", "0.1", "1e-05"];
    for (index, time) in times.iter().enumerate() {
        fs::create_dir_all(path.join("case").join(time)).expect("made");
        write_ply(&path.join("case").join(time).join("p.ply"), &block(6, 0.025 * index as f64));
    }
    fs::create_dir(path.join("case/constant")).expect("made");
    let arguments = ["--out", "out", "--format", "usdc", "--stage", "out/shot.usda"];
    let result = meniscus(path, &[&["convert", "case"], &arguments[..]].concat());
    assert_eq!((result.status, &*result.err), (0, ""), "{}", result.out);
    assert!(result.out.contains("{}/p.ply: 4 frames, spacing "), "{}", result.out);
    let sorted = ["0", "1e-05", "0.05", "0.1"];
    assert_eq!(played(&path.join("out/shot.usda")), sorted.map(|time| format!("./p_{time}.usdc")));
    for inputs in [&["case/0", "case/0.05"][..], &["case/*/p.ply"]] {
        let result = meniscus(path, &[&["convert"], inputs, &["--out", "other", "--format", "obj"]].concat());
        assert_eq!((result.status, &*result.err), (0, ""), "{inputs:?}: {}", result.out);
        assert!(result.out.contains("{}/p.ply: "), "{}", result.out);
    }
    // The daemon mirrors folders.
    let watch =
        ["watch", "case", "--pattern", "**", "--once", "--out", "w", "--settle", "10ms", "--format", "usdc"];
    let result = meniscus(path, &[&watch[..], &["--stage", "w/shot.usda"]].concat());
    assert_eq!(result.status, 0, "{}", result.err);
    assert_eq!(played(&path.join("w/shot.usda")), sorted.map(|time| format!("./{time}/p.usdc")));
    for time in times {
        let [one, other] = [format!("out/p_{time}.usdc"), format!("w/{time}/p.usdc")]
            .map(|name| fs::read(path.join(name)).expect("there"));
        assert!(one == other, "{time}");
    }
    // A single file keeps its name.
    let result = convert(path, &["case/0.1/p.ply", "--out", "single", "--format", "obj"]);
    assert_eq!(result.status, 0, "{}", result.err);
    assert_eq!(names_in(&path.join("single")), ["p.obj"]);
}

#[test]
fn negative_frame_numbers_precede_the_others() {
    let folder = folder_with(&["dam.-003.ply", "dam.-002.ply", "dam.-001.ply", "dam.000.ply", "dam.001.ply"]);
    let path = folder.path();
    let arguments = ["--out", "out", "--format", "glb,usdc", "--stage", "out/shot.usda"];
    let shots = ["--sequence", "shot.glb", "--sequence", "shot.abc"];
    let result = meniscus(path, &[&["convert", "in"], &arguments[..], &shots].concat());
    assert_eq!((result.status, &*result.err), (0, ""), "{}", result.out);
    assert!(result.out.contains("dam.{}.ply: 5 frames, spacing "), "{}", result.out);
    let names = ["-003", "-002", "-001", "000", "001"].map(|number| format!("./dam.{number}.usdc"));
    assert_eq!(played(&path.join("out/shot.usda")), names);
    let shot = fs::read(path.join("shot.abc")).expect("a shot");
    let times = abc::read_times(&shot).expect("times");
    assert_eq!([times[0], times[times.len() - 1]], [-3.0 / 24.0, 1.0 / 24.0]);
    let result = meniscus(path, &["info", "shot.glb"]);
    assert!(result.out.contains("-3"), "{}", result.out);
    for (inputs, frames) in [("in", "--frames=-2-1"), ("in/dam.###.ply", "--frames=-2-1")] {
        let folder = format!("{}{frames}", inputs.len());
        let result = meniscus(path, &["convert", inputs, frames, "--out", &folder, "--format", "obj"]);
        assert_eq!((result.status, &*result.err), (0, ""), "{}", result.out);
        assert_eq!(
            names_in(&path.join(&folder)),
            ["-001", "-002", "000", "001"].map(|n| format!("dam.{n}.obj"))
        );
    }
    let result = meniscus(path, &["convert", "in", "--frames", "-5--2", "--out", "few", "--format", "obj"]);
    assert!(
        result.status == 0 && result.err.contains("--frames -5--2: 2 frames are missing"),
        "{}",
        result.err
    );
    // A moving obstacle has the same numbers.
    let body = "v 9 9 9\nv 10 9 9\nv 9 10 9\nv 9 9 10\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n";
    fs::write(path.join("body.-0003.obj"), body).expect("written");
    let obstacle = ["--frames=-3", "--obstacle", "body.####.obj", "--out", "with", "--format", "obj"];
    let result = meniscus(path, &[&["convert", "in"], &obstacle[..]].concat());
    assert_eq!(result.status, 0, "{}", result.err);
}

#[test]
fn neighbors_of_frames_are_skipped_in_folders_and_named_on_request() {
    let folder = folder_with(&["dam.1.ply", "dam.2.ply"]);
    let path = folder.path();
    let vtk = |data_set: &str, rest: &str| {
        format!("# vtk DataFile Version 3.0\nt\nASCII\nDATASET {data_set}\n{rest}")
    };
    let points = "POINTS 4 float\n0 0 0 1 0 0 0 1 0 0 0 1\n";
    let faces = "4 16\n3 0 2 1\n3 0 1 3\n3 0 3 2\n3 1 2 3\n";
    let index = |kind: &str| format!("<?xml version=\"1.0\"?>\n<VTKFile type=\"{kind}\"></VTKFile>\n");
    let mesh = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n\
                element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n";
    for (name, text) in [
        ("dam.pvd", index("Collection")),
        ("dam_1.pvtu", index("PUnstructuredGrid")),
        ("dam.vtm", index("vtkMultiBlockDataSet")),
        ("run_boundingBox.vtk", vtk("RECTILINEAR_GRID", "DIMENSIONS 2 2 2\n")),
        (
            "rb_data_0_1.vtk",
            vtk("UNSTRUCTURED_GRID", &format!("{points}CELLS {faces}CELL_TYPES 4\n5 5 5 5\n")),
        ),
        ("mesh_00000.vtk", vtk("POLYDATA", &format!("{points}POLYGONS {faces}"))),
        ("wall.ply", mesh.to_owned()),
    ] {
        fs::write(path.join("in").join(name), text).expect("written");
    }
    let result = convert(path, &["in", "--out", "out", "--format", "obj"]);
    assert_eq!((result.status, &*result.err), (0, ""), "{}", result.out);
    for line in [
        "skipped dam.pvd and 2 other files: lists of other files",
        "skipped mesh_00000.vtk and 2 other files: meshes, not particles",
        "skipped run_boundingBox.vtk: a grid, not particles",
    ] {
        assert!(result.out.contains(line), "{line}: {}", result.out);
    }
    let watch = ["watch", "in", "--once", "--out", "watched", "--format", "obj", "--settle", "10ms"];
    let result = meniscus(path, &[&watch[..], &QUICK].concat());
    assert_eq!(result.status, 0, "{}", result.err);
    assert_eq!(names_in(&path.join("out")), ["dam.1.obj", "dam.2.obj"]);
    let watched = names_in(&path.join("watched"));
    assert_eq!(watched.iter().filter(|name| name.ends_with(".obj")).count(), 2, "{watched:?}");
    for (name, words) in [
        ("dam.pvd", "it lists no files yet"),
        ("dam_1.pvtu", "it lists no files yet"),
        ("dam.vtm", "it lists no files yet"),
        ("run_boundingBox.vtk", "the type RECTILINEAR_GRID, which is not supported"),
        ("rb_data_0_1.vtk", "polygons, which are ignored"),
        ("mesh_00000.vtk", "polygons, which are ignored"),
        ("wall.ply", "faces, which are ignored"),
    ] {
        let result =
            meniscus(path, &["convert", &format!("in/{name}"), "--out", "named", "--voxel-size", "0.5"]);
        assert!(result.err.contains(words), "{name}: {}", result.err);
    }
    for name in ["dam.1.ply", "dam.2.ply"] {
        fs::remove_file(path.join("in").join(name)).expect("removed");
    }
    let result = convert(path, &["in", "--out", "none"]);
    assert!(
        result.status == 2 && result.err.contains("takes their points if you give them by name"),
        "{}",
        result.err
    );
}

#[test]
fn folder_of_single_frames_is_warned_about() {
    let folder = folder_with(&["dam_1_2.ply", "dam_2_3.ply"]);
    let path = folder.path();
    let note = "2 files form 2 sequences of one frame each, so each gets its own particle spacing";
    for arguments in [
        &["convert", "in", "--out", "out", "--format", "obj"][..],
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
    for format in OutputFormat::ALL.into_iter().filter(|format| !format.is_picture()) {
        let format = format.extension();
        let file = format!("new/x.{format}");
        let short = convert(path, &["in/dam.7.ply", "-o", &file]);
        assert_eq!((short.status, &*short.err), (0, ""), "{format}: {}", short.out);
        assert_eq!(names_in(&path.join("new")), [format!("x.{format}")]);
        let result = convert(path, &["in", "--out", "whole", "--format", format]);
        assert_eq!(result.status, 0, "{}", result.err);
        let whole = fs::read(path.join(format!("whole/dam.7.{format}"))).expect("there");
        assert!(fs::read(path.join(&file)).expect("there") == whole, "{format}");
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
        (&["convert", "dam.1.ply", "-o", "-", "--skip-done"], &["--skip-done", "name a folder"]),
        (&["convert", "dam.1.ply", "-o", "x.obj", "--skip-done"], &["--skip-done", "name a folder"]),
        (&["convert", "dam.1.ply", "-o", "-", "--shard", "1/1"], &["name a folder"]),
        (&["watch", ".", "--once", "--out", "x.glb"], &["x.glb", "folder"]),
        (&["convert", "dam.1.ply", "-o", "X.PLY"], &["X.PLY", "use X.ply"]),
        (&["convert", "dam.1.ply", "-o", "x.Png"], &["x.Png", "meniscus render"]),
        (&["watch", ".", "--once", "--out", "dam.GLB"], &["dam.GLB", "folder"]),
        (
            &["convert", "dam.#.ply", "--out", "x.fbx"],
            &["x.fbx: .fbx is not an output format: use .glb,", "for a folder of this name, write x.fbx/"],
        ),
        (&["convert", "dam.1.ply", "-o", "new/x.USD"], &["new/x.USD: .USD is not", "write new/x.USD/"]),
        (&["convert", "dam.1.ply", "-o", "x.gbl"], &["x.gbl: .gbl is not", "write x.gbl/"]),
        (&["convert", "dam.#.ply", "--out", "x.dae"], &["x.dae: .dae is not an output format"]),
        (&["convert", "dam.1.ply", "--out", "x.mp4"], &["x.mp4: .mp4 is not an output format"]),
        (&["convert", "dam.1.ply", "--out", "x.v"], &["x.v: .v is not an output format"]),
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
    for out in ["old.obj", "new.obj/", "old.fbx", "new.fbx/", "run.v2", "cache.0001"] {
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
    for (input, output, format) in
        [(&["-"][..], &["-o", "-"][..], "glb"), (&["-"], &["--out", "-", "--format", "obj"], "obj")]
    {
        let (status, out, err) = pipe(path, &[input, output, &voxels].concat(), &bytes);
        assert_eq!(status, 0, "{err}");
        assert!(err.contains("1 frame: 1 done"), "{err}");
        // The output is the same as for files with these names.
        let same = tempdir().expect("a folder");
        fs::write(same.path().join("stdin"), &bytes).expect("written");
        let result = convert(same.path(), &["stdin", "--format", format, "-o", &format!("x.{format}")]);
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
    let arguments = ["-", "-o", "x.obj", "--voxel-size", "0.1", "--report", "r.json"];
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
    // The daemon gives the output name to the file that is complete first. It waits longer until it considers
    // a table complete, unless it does not wait at all.
    let watch = ["watch", "in", "--once", "--out", "watched", "--format", "obj"];
    let watched = meniscus(path, &[&watch[..], &["--settle", "0"], &QUICK].concat());
    assert_eq!(watched.status, 1, "{}", watched.err);
    for name in ["dam.1.obj", "dam.2.obj"] {
        let [one, two, three] =
            ["expected", "out", "watched"].map(|out| fs::read(path.join(out).join(name)).expect("there"));
        assert!(one == two && two == three, "{name}");
    }
}

#[test]
fn pattern_names_the_results_of_a_sequence() {
    let folder = folder_with(&["dam.7.ply", "dam.12.ply"]);
    let path = folder.path();
    for (out, more, expected) in [
        ("surf/water.####.obj", &[][..], &["water.0007.obj", "water.0012.obj"][..]),
        ("surf/w_{}.obj", &["--format", "obj,ply"], &["w_12.obj", "w_12.ply", "w_7.obj", "w_7.ply"]),
        ("surf/w{:03}.stl", &[], &["w007.stl", "w012.stl"]),
    ] {
        let result = convert(path, &[&["in", "--out", out], more].concat());
        assert_eq!((result.status, &*result.err), (0, ""), "{out}: {}", result.out);
        let mut names = names_in(&path.join("surf"));
        names.retain(|name| !name.starts_with('.'));
        assert_eq!(names, expected, "{out}");
        // The folder has records.
        let again = convert(path, &[&["in", "--out", out, "--skip-done"], more].concat());
        assert!(again.status == 0 && again.out.matches("done already").count() == 2, "{out}: {}", again.out);
        fs::remove_dir_all(path.join("surf")).expect("removed");
    }
    // Without an extension of a result, it is a folder.
    let result = convert(path, &["in", "--out", "take#2", "--format", "obj"]);
    assert_eq!((result.status, &*result.err), (0, ""), "{}", result.out);
    assert!(path.join("take#2/dam.12.obj").exists());
    fs::copy(path.join("in/dam.7.ply"), path.join("in/other.7.ply")).expect("copied");
    fs::copy(path.join("in/dam.7.ply"), path.join("still.ply")).expect("copied");
    for (inputs, out, words) in [
        (&["in"][..], "w.####.obj", "two frames have the number 7"),
        (&["still.ply"], "w.####.obj", "the frame has no number for w.####"),
        (&["in"], "w_{}_{}.obj", "expected one placeholder for the frame number, found several"),
        (&["in/dam.7.ply"], "w.####.fbx", ".fbx is not an output format"),
        (&["in/dam.7.ply"], "w.####.png", "use `meniscus render`"),
    ] {
        let result = convert(path, &[inputs, &["--out", out]].concat());
        assert!(result.status != 0 && result.err.contains(words), "{out}: {}", result.err);
    }
    let result = meniscus(path, &["convert", "in/dam.7.ply", "out.obj"]);
    assert!(result.status == 2 && result.err.contains("as in --out out.obj"), "{}", result.err);
    assert!(!path.join("out.obj").exists());
}
