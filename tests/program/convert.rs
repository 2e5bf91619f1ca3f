//! The command on real frames: names, bit-identical outputs, reports, and frames that are done.

use std::fs;
use std::path::{Path, PathBuf};

use meniscus::pipeline::OutputFormat;
use serde_json::Value;
use tempfile::tempdir;

use crate::program::scene::{RunResult, block, meniscus, names_in, write_ply, write_sequence};

fn convert(folder: &Path, arguments: &[&str]) -> RunResult {
    meniscus(folder, &[&["convert"], arguments].concat())
}

/// Converts, and asserts success without warnings.
fn converted(folder: &Path, arguments: &[&str]) -> String {
    let result = convert(folder, arguments);
    assert_eq!((result.status, &*result.err), (0, ""), "{arguments:?}: {}", result.out);
    result.out
}

fn report(path: &Path) -> Value {
    serde_json::from_str(&fs::read_to_string(path).expect("readable")).expect("the report is JSON")
}

#[test]
fn outputs_have_the_names_of_their_frames() {
    let folder = tempdir().expect("a folder");
    let path = folder.path();
    write_sequence(path, 9, 11);
    let out = converted(path, &["dam.%d.ply", "dam.{}.ply", "--out", "o"]);
    let expected: Vec<String> =
        ["10", "11", "9"].iter().flat_map(|n| [format!("dam.{n}.glb"), format!("dam.{n}.vdb")]).collect();
    assert_eq!(names_in(&path.join("o")), expected);
    let frames: Vec<&str> = out.lines().filter(|line| line.contains("particles, ")).collect();
    assert_eq!(frames.len(), 3);
    assert!(frames[0].starts_with("dam.9.ply") && frames[2].starts_with("dam.11.ply"), "{out}");
    assert!(out.lines().last().expect("a summary").starts_with("3 frames: 3 done, in "), "{out}");
    let arguments = ["dam.{}.ply", "--frames", "9", "--out", "all", "--format", "glb,gltf,vdb,obj,ply,obj"];
    converted(path, &arguments);
    let expected = ["glb", "gltf", "obj", "ply", "vdb"].map(|extension| format!("dam.9.{extension}"));
    assert_eq!(names_in(&path.join("all")), expected);
}

/// So far from the origin, the 32-bit numbers of a .stl are half a unit apart. All files of a frame have the same
/// positions.
#[test]
fn stl_far_from_the_origin_fails() {
    let folder = tempdir().expect("a folder");
    let path = folder.path();
    let row = |[x, y, z]: [f64; 3]| format!("{},{},{z}\n", x + 694_386.2, y + 5_155_487.3);
    let rows: String = block(6, 0.0).into_iter().map(row).collect();
    fs::write(path.join("far.csv"), format!("x,y,z\n{rows}")).expect("written");
    converted(path, &["far.csv", "--out=alone", "--format=glb,ply"]);
    let result = convert(path, &["far.csv", "--out=both", "--format=glb,ply,stl"]);
    assert_eq!(result.status, 1, "{}", result.err);
    assert!(result.err.contains("32-bit positions of some vertices are off by up to "), "{}", result.err);
}

#[test]
fn range_of_frames_gives_the_same_bytes_as_all() {
    let folder = tempdir().expect("a folder");
    let path = folder.path();
    write_sequence(path, 1, 6);
    // The first frame has a different spacing, and determines the voxel size, whichever frames are converted.
    write_ply(&path.join("dam.1.ply"), &block(7, 0.0));
    converted(path, &["dam.#.ply", "--out", "whole", "--threads", "1"]);
    converted(path, &["dam.#.ply", "--out", "part", "--frames", "2-6x2", "--threads", "2"]);
    let names = ["dam.2.glb", "dam.2.vdb", "dam.4.glb", "dam.4.vdb", "dam.6.glb", "dam.6.vdb"];
    assert_eq!(names_in(&path.join("part")), names);
    for name in names {
        let [whole, part] =
            ["whole", "part"].map(|out| fs::read(path.join(out).join(name)).expect("readable"));
        assert!(whole == part, "{name}");
    }
}

#[test]
fn bytes_do_not_depend_on_threads() {
    let folder = tempdir().expect("a folder");
    let path = folder.path();
    write_sequence(path, 1, 4);
    for integrator in ["fast", "implicit", "explicit"] {
        for threads in ["1", "2", "4"] {
            let out = format!("{integrator}{threads}");
            let arguments = [
                "--format",
                "glb,vdb,obj,ply",
                "--threads",
                threads,
                "--integrator",
                integrator,
                "--steps",
                "3",
            ];
            converted(path, &[&["dam.#.ply", "--out", &out], &arguments[..]].concat());
            for name in names_in(&path.join(&out)) {
                let of_one = fs::read(path.join(format!("{integrator}1")).join(&name)).expect("readable");
                let of_many = fs::read(path.join(&out).join(&name)).expect("readable");
                assert!(of_one == of_many, "{integrator}, {threads} threads: {name}");
            }
        }
    }
}

#[test]
fn empty_frame_is_converted() {
    let folder = tempdir().expect("a folder");
    let path = folder.path();
    write_ply(&path.join("dam.1.ply"), &[]);
    write_ply(&path.join("dam.2.ply"), &block(6, 0.0));
    let out = converted(path, &["dam.#.ply", "--out", "o", "--format", "glb,gltf,vdb,obj,ply"]);
    assert!(out.contains("measured on dam.2.ply"), "{out}");
    assert_eq!(names_in(&path.join("o")).len(), 10);
    converted(path, &["dam.1.ply", "--out", "p", "--spacing", "0.1"]);
}

#[test]
fn failed_frame_is_named_and_the_others_are_converted() {
    let folder = tempdir().expect("a folder");
    let path = folder.path();
    write_sequence(path, 1, 4);
    fs::write(path.join("dam.2.ply"), "ply\nformat nonsense 1.0\n").expect("written");
    let result = convert(path, &[".", "--out", "o", "--report", "o/report.json"]);
    assert_eq!(result.status, 1, "{}", result.err);
    assert!(result.err.contains("dam.2.ply: PLY, at"), "{}", result.err);
    assert!(result.out.contains("4 frames: 3 done, 1 failed, in "), "{}", result.out);
    assert_eq!(names_in(&path.join("o")).len(), 7);
    let report = report(&path.join("o/report.json"));
    let statuses: Vec<&Value> =
        report["frames"].as_array().expect("frames").iter().map(|f| &f["status"]).collect();
    assert_eq!(statuses, ["converted", "failed", "converted", "converted"]);
    assert!(report["frames"][1]["error"].as_str().expect("why").contains("dam.2.ply"));

    let result = convert(path, &["dam.#.ply", "--out", "p", "--on-error", "stop"]);
    assert_eq!(result.status, 1);
    assert_eq!(names_in(&path.join("p")), ["dam.1.glb", "dam.1.vdb"]);
    assert!(result.out.contains("1 done, 1 failed, 2 not started"), "{}", result.out);
}

/// The statuses of all frames of a report, in the order of the report.
fn statuses<'a>(report: &'a Value) -> Vec<(&'a str, &'a str)> {
    let frames = report["frames"].as_array().expect("frames");
    let text = |value: &'a Value| value.as_str().expect("text");
    frames.iter().map(|frame| (text(&frame["input"]), text(&frame["status"]))).collect()
}

#[test]
fn sequence_without_settings_does_not_stop_others() {
    let folder = tempdir().expect("a folder");
    let path = folder.path();
    for name in ["a.ply", "c.ply"] {
        write_ply(&path.join(name), &block(6, 0.0));
    }
    for name in ["b.1.ply", "b.2.ply"] {
        write_ply(&path.join(name), &block(1, 0.0));
    }
    for (on_error, b, c) in
        [("continue", ["failed", "failed"], "converted"), ("stop", ["failed", "not_started"], "not_started")]
    {
        let arguments = ["a.ply", "b.1.ply", "b.2.ply", "c.ply", "--out", on_error, "--on-error", on_error];
        let result =
            convert(path, &[&arguments[..], &["--report", "report.json", "--format", "ply"]].concat());
        assert_eq!(result.status, 1, "{}", result.err);
        assert_eq!(
            result.err.matches("error: b.{}.ply: cannot measure the particle spacing").count(),
            1,
            "{}",
            result.err
        );
        let report = report(&path.join("report.json"));
        let expected = [("a.ply", "converted"), ("b.1.ply", b[0]), ("b.2.ply", b[1]), ("c.ply", c)];
        assert_eq!(statuses(&report), expected);
        let written: Vec<&str> =
            expected.iter().filter(|(_, s)| *s == "converted").map(|(n, _)| *n).collect();
        assert_eq!(names_in(&path.join(on_error)), written);
    }
    // An earlier frame fails and ends the run before that.
    fs::write(path.join("a.ply"), "ply\nformat nonsense 1.0\n").expect("written");
    let arguments = ["a.ply", "b.1.ply", "c.ply", "--out", "o", "--on-error", "stop", "--voxel-size", "0.1"];
    let result = convert(path, &[&arguments[..], &["--report", "report.json"]].concat());
    assert_eq!(result.status, 2, "{}", result.err);
    let report = report(&path.join("report.json"));
    let expected = [("a.ply", "failed"), ("b.1.ply", "not_started"), ("c.ply", "not_started")];
    assert_eq!(statuses(&report), expected);
}

#[test]
fn skip_done_converts_nothing_again() {
    let folder = tempdir().expect("a folder");
    let path = folder.path();
    write_sequence(path, 1, 2);
    let arguments = ["dam.#.ply", "--out", "o", "--skip-done"];
    assert!(!converted(path, &arguments).contains("done already"));
    assert_eq!(converted(path, &arguments).matches("done already").count(), 2);
    write_ply(&path.join("dam.2.ply"), &block(6, 0.5));
    assert_eq!(converted(path, &arguments).matches("done already").count(), 1);
    let changed = [&arguments[..], &["--laplacian-steps", "3"]].concat();
    assert_eq!(converted(path, &changed).matches("done already").count(), 0);
    // Options that do not affect an output do not cause a conversion.
    let arguments = ["dam.#.ply", "--out", "v", "--skip-done", "--format", "vdb"];
    converted(path, &arguments);
    let contoured = [&arguments[..], &["--contour", "tetrahedra"]].concat();
    assert_eq!(convert(path, &contoured).out.matches("done already").count(), 2);
    let unused = [&arguments[..], &["--void-threshold", "2"]].concat();
    assert_eq!(convert(path, &unused).out.matches("done already").count(), 2);
}

#[test]
fn lost_records_cost_a_conversion_and_give_the_same_bytes() {
    let folder = tempdir().expect("a folder");
    let path = folder.path();
    write_sequence(path, 1, 2);
    let arguments = ["dam.#.ply", "--out", "o", "--skip-done"];
    converted(path, &arguments);
    let outputs = || {
        let names = names_in(&path.join("o"));
        names.iter().map(|name| fs::read(path.join("o").join(name)).expect("readable")).collect::<Vec<_>>()
    };
    let before = outputs();
    // The last record is that of one frame; the folder has the records of all.
    let state = path.join("o/.meniscus");
    let is_records = |path: &PathBuf| path.extension().is_none();
    let mut records = fs::read_dir(&state).expect("there").map(|entry| entry.expect("an entry").path());
    let records = records.find(is_records).expect("a file of records");
    let lines = fs::read_to_string(&records).expect("text");
    let end = lines.trim_end().rfind('\n').expect("several lines");
    fs::write(&records, &lines[..end + 9]).expect("written");
    assert_eq!(converted(path, &arguments).matches("done already").count(), 1);
    assert!(outputs() == before);
    fs::remove_dir_all(&state).expect("removed");
    assert_eq!(converted(path, &arguments).matches("done already").count(), 0);
    assert!(outputs() == before);
    assert_eq!(converted(path, &arguments).matches("done already").count(), 2);
}

/// Imitates a run that was killed after it replaced some outputs of a frame, and another one whose record
/// another machine lost: the outputs decide.
#[test]
fn mixed_versions_of_outputs_are_never_done() {
    let folder = tempdir().expect("a folder");
    let path = folder.path();
    write_sequence(path, 1, 1);
    let [plain, smooth] = ["1", "3"].map(|steps| {
        ["dam.1.ply", "--out", "o", "--skip-done", "--format", "obj,vdb", "--laplacian-steps", steps]
    });
    let read = || ["obj", "vdb"].map(|e| fs::read(path.join(format!("o/dam.1.{e}"))).expect("there"));
    converted(path, &plain);
    let old = read();
    converted(path, &smooth);
    let new = read();
    for (obj, vdb, plain_is_done, smooth_is_done) in [
        (&old[0], &new[1], false, false),
        (&new[0], &old[1], false, false),
        (&old[0], &old[1], true, false),
        (&new[0], &new[1], false, true),
    ] {
        for (arguments, is_done, made) in [(&plain, plain_is_done, &old), (&smooth, smooth_is_done, &new)] {
            fs::write(path.join("o/dam.1.obj"), obj).expect("written");
            fs::write(path.join("o/dam.1.vdb"), vdb).expect("written");
            assert_eq!(converted(path, arguments).contains("done already"), is_done);
            assert!(read() == *made);
        }
    }
}

#[test]
fn skip_done_makes_an_output_with_a_flipped_byte_again() {
    let folder = tempdir().expect("a folder");
    let path = folder.path();
    write_sequence(path, 1, 3);
    let arguments = ["dam.#.ply", "--out", "o", "--skip-done"];
    converted(path, &arguments);
    let damaged = path.join("o/dam.2.glb");
    let whole = fs::read(&damaged).expect("written");
    let mut bytes = whole.clone();
    let middle = bytes.len() / 2;
    bytes[middle] ^= 1;
    // Make a new file: its stamp differs even if the clock of the file system has not advanced.
    fs::remove_file(&damaged).expect("removed");
    fs::write(&damaged, bytes).expect("written");
    // The same bytes in a new file count as undamaged.
    fs::copy(path.join("o/dam.3.glb"), path.join("copy")).expect("copied");
    fs::rename(path.join("copy"), path.join("o/dam.3.glb")).expect("renamed");
    assert_eq!(converted(path, &arguments).matches("done already").count(), 2);
    assert!(fs::read(&damaged).expect("written") == whole);
    assert_eq!(converted(path, &arguments).matches("done already").count(), 3);
}

#[test]
fn report_has_the_measurements_of_each_frame() {
    let folder = tempdir().expect("a folder");
    let path = folder.path();
    write_sequence(path, 1, 2);
    converted(path, &["dam.#.ply", "--out", "o", "--report", "report.json"]);
    let report = report(&path.join("report.json"));
    assert_eq!(report["version"], env!("CARGO_PKG_VERSION"));
    let settings = &report["settings"][0];
    assert_eq!((&settings["sequence"], &settings["integrator"]), (&"dam.{}.ply".into(), &"fast".into()));
    let [h, spacing] = ["voxel_size", "spacing"].map(|key| settings[key].as_f64().expect("a number"));
    assert!((h / spacing / 0.32 - 1.0).abs() < 1e-12, "{h} {spacing}");
    let frame = &report["frames"][1];
    assert_eq!((&frame["input"], &frame["settings"]), (&"dam.2.ply".into(), &0.into()));
    assert_eq!((&frame["particles"], &frame["dropped"]), (&216.into(), &0.into()));
    for key in [
        "leaves",
        "voxels",
        "free_voxels",
        "passes",
        "bending_energy",
        "area",
        "volume",
        "vertices",
        "triangles",
        "components",
    ] {
        assert!(frame[key].as_f64().is_some_and(|value| value > 0.0), "{key}: {}", frame[key]);
    }
    for stage in ["read", "rasterize", "smooth", "contour", "write"] {
        assert!(frame["seconds"][stage].as_f64().is_some_and(|seconds| seconds > 0.0), "{stage}");
    }
    assert_eq!((&frame["boundary_edges"], &frame["non_manifold_edges"]), (&0.into(), &0.into()));
    assert_eq!(frame["non_manifold_vertices"], 0);
    assert_eq!(frame["certificate"]["holds"], true, "{frame}");
    assert_eq!(frame["certificate"]["closed_manifold"], true, "{frame}");
    assert_eq!((&report["summary"]["converted"], &report["summary"]["failed"]), (&2.into(), &0.into()));
}

/// A single frame of a sequence is measured alone; missing frames cause a warning.
#[test]
fn incomplete_sequence_causes_a_warning() {
    let folder = tempfile::tempdir().unwrap();
    write_sequence(folder.path(), 1, 3);
    let alone = meniscus(folder.path(), &["convert", "dam.2.ply", "--out", "out"]);
    assert_eq!(alone.status, 0, "{}", alone.err);
    assert!(alone.err.contains("its sequence has 3 frames"), "{}", alone.err);
    let picked = meniscus(folder.path(), &["convert", "dam.{}.ply", "--frames", "2,3-6,9", "--out", "out"]);
    assert_eq!(picked.status, 0, "{}", picked.err);
    assert!(!picked.err.contains("its sequence has"), "{}", picked.err);
    assert!(picked.err.contains("--frames 3-6: 3 frames are missing"), "{}", picked.err);
    assert!(picked.err.contains("--frames 9: 1 frame is missing"), "{}", picked.err);
}

/// A report replaces an earlier report, but only a regular file.
#[cfg(unix)]
#[test]
fn report_replaces_only_regular_files() {
    let folder = tempfile::tempdir().unwrap();
    write_sequence(folder.path(), 1, 1);
    std::fs::create_dir(folder.path().join("taken")).unwrap();
    let refused = meniscus(folder.path(), &["convert", "dam.1.ply", "--out", "out", "--report", "taken"]);
    assert_eq!(refused.status, 2, "{}", refused.err);
    assert!(refused.err.contains("not a regular file"), "{}", refused.err);
    assert!(!folder.path().join("out").exists());
    std::fs::write(folder.path().join("real.json"), "old").unwrap();
    std::os::unix::fs::symlink("real.json", folder.path().join("link.json")).unwrap();
    let linked = meniscus(folder.path(), &["convert", "dam.1.ply", "--out", "out", "--report", "link.json"]);
    assert_eq!(linked.status, 0, "{}", linked.err);
    assert!(folder.path().join("link.json").is_symlink());
    assert_eq!(report(&folder.path().join("real.json"))["summary"]["converted"], 1);
}

/// A result that was cut off at some byte is made again, unless nothing in it shows that it was a result: then it may be
/// the data of another program.
#[test]
fn results_that_were_cut_off_are_made_again_or_refused() {
    let folder = tempdir().expect("a folder");
    let path = folder.path();
    fs::write(path.join("drop.csv"), "x,y,z\n0,0,0\n0.1,0,0\n").expect("written");
    let formats = OutputFormat::ALL.into_iter().filter(|format| !format.is_picture());
    let mut refused = Vec::new();
    for format in formats.map(|format| format.to_string()) {
        let out = path.join(&format);
        let arguments =
            ["drop.csv", "--out", &format, "--spacing", "0.1", "--skip-done", "--format", &format];
        converted(path, &arguments);
        let names: Vec<String> =
            names_in(&out).into_iter().filter(|name| name.starts_with("drop.")).collect();
        let whole = |name: &String| fs::read(out.join(name)).expect("a result");
        let results: Vec<Vec<u8>> = names.iter().map(whole).collect();
        for length in [0, 1, 4, 10, 50, 100, 300, 700, 1000, 1500, 2500, 5000] {
            let cut = |bytes: &[u8]| bytes[..bytes.len().min(length)].to_vec();
            for (name, bytes) in names.iter().zip(&results) {
                fs::write(out.join(name), cut(bytes)).expect("written");
            }
            let result = convert(path, &arguments);
            if result.status == 2 && result.err.contains("would replace a file") {
                assert!(names.iter().map(whole).eq(results.iter().map(|bytes| cut(bytes))), "{format}");
                names.iter().for_each(|name| fs::remove_file(out.join(name)).expect("moved away"));
                refused.push(format.clone());
                converted(path, &arguments);
            } else {
                assert_eq!(result.status, 0, "{format}, {length}: {}", result.err);
            }
            assert!(names.iter().map(whole).eq(results.iter().cloned()), "{format}, {length}");
        }
    }
    refused.dedup();
    assert_eq!(refused, ["vdb", "ply", "vtp"]);
}
