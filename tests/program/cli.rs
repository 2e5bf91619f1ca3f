//! The command: exit statuses, messages, names, and refused arguments. These tests do not compute surfaces.

use std::fs;
use std::path::Path;

use tempfile::{TempDir, tempdir};

use crate::program::scene::{assert_refused, block, meniscus, names_in, write_ply, write_sequence};

fn folder() -> TempDir {
    tempdir().expect("a folder")
}

#[test]
fn contradictory_arguments_are_refused() {
    let folder = folder();
    let path = folder.path();
    write_sequence(path, 1, 2);
    fs::create_dir(path.join("empty")).expect("made");
    fs::write(path.join("empty/README.txt"), "Nothing to see here.\n").expect("written");
    fs::create_dir(path.join("nothing")).expect("made");
    fs::create_dir(path.join("level_sets")).expect("made");
    fs::write(path.join("level_sets/dam.1.vdb"), "").expect("written");
    fs::write(path.join("level_sets/dam.1.glb"), "").expect("written");
    assert_refused(path, &[], &["Usage"]);
    assert_refused(path, &["convert", "dam.1.ply"], &["--out"]);
    assert_refused(path, &["convert", "--out", "o"], &["INPUT"]);
    for (arguments, words) in [
        (&["missing.ply"][..], &["missing.ply", "no such file"][..]),
        (&["dam.$F4.bgeo"], &["dam.$F4.bgeo: no such file", "as in dam.####.bgeo"]),
        (&["a*.ply"], &["a*.ply", "no file matches"]),
        (&["a.####.ply"], &["a.####.ply", "no file matches"]),
        (&["empty"], &["empty", "no frames"]),
        (&["dam.1.ply", "--frames", "5-1"], &["`5-1` ends before it starts: use 1-5"]),
        (&["dam.1.ply", "--frames", "7"], &["--frames selects none of the 1"]),
        (&["dam.1.ply", "--threads", "0"], &["--threads"]),
        (&["dam.1.ply", "--format", "fbx"], &["fbx"]),
        (&["dam.1.ply", "--voxel-size", "-1"], &["voxel size", "positive"]),
        (&["dam.1.ply", "--blend", "-0.1"], &["-0.1", "blend", "positive"]),
        (&["dam.1.ply", "--blend", "65h"], &["65h", "to 64 voxels"]),
        (&["dam.1.ply", "--preset", "paper", "--radius-min", "-0.1"], &["-0.1", "radius"]),
        (&["dam.1.ply", "--preset", "paper", "--radius-ratio", "-2"], &["ratio", "at least 1"]),
        (&["dam.1.ply", "--step-size", "-1"], &["--step-size", "1e-6 to 10000"]),
        (&["dam.1.ply", "--steps", "-1"], &["invalid value '-1' for '--steps"]),
        (&["dam.1.ply", "--frames", "1-2x"], &["`1-2x` is not a selection of frames"]),
        (&["dam.1.ply", "--voxel-size=-1"], &["voxel size", "positive"]),
        (&["dam.1.ply", "--voxel-size", "nan"], &["voxel size"]),
        (&["dam.1.ply", "--preset", "paper", "--radius-ratio", "0.5"], &["ratio", "at least 1"]),
        (&["dam.1.ply", "--report", "missing/report.json"], &["missing"]),
        (&["dam.1.ply", "--clip", "nan,0,0,1,1,1"], &["the box NaN,0,0,1,1,1", "six finite numbers"]),
        (&["dam.1.ply", "--clip", "0,0,0,1,inf,1"], &["not finite", "x0,y0,z0,x1,y1,z1"]),
        (&["dam.1.ply", "--clip", "0,2,0,1,1,1"], &["y0 = 2 must be below y1 = 1"]),
        (&["dam.1.ply", "--clip", "0,0,0,1,1"], &["0,0,0,1,1", "six numbers x0,y0,z0,x1,y1,z1"]),
        (&["dam.1.ply", "--attributes", "all,age"], &["`all,age`", "or only names"]),
        (
            &["dam.1.ply", "--print-settings", "--format", "abc", "--sequence", "x.glb"],
            &["--sequence: a sequence file is made from the .glb files", "add glb to --format"],
        ),
        (&["--print-settings", "--sequence", "x.mov"], &["must end in .glb"]),
        (&["nothing"], &["nothing: the folder is empty"]),
        (
            &["level_sets"],
            &[
                "the folder has meshes: `render` and",
                "the folder has level sets: `convert` takes them by name, or by a pattern such as 'level_sets/*.vdb', and",
            ],
        ),
    ] {
        assert_refused(path, &[&["convert", "--out", "o/deep"], arguments].concat(), words);
        assert!(!path.join("o").exists(), "{arguments:?} left the folder that it made");
    }
}

/// If a command cannot write into its output folder, it reports this before it reads any frame, and leaves no
/// files behind.
#[test]
fn unwritable_output_folder_is_refused() {
    let folder = folder();
    let path = folder.path();
    write_sequence(path, 1, 2);
    fs::write(path.join("taken"), "a file").expect("written");
    let expected = "expected a folder for the results, but ";
    let mut cases = vec![
        ("taken", "taken: ".to_owned() + expected + "this is a file"),
        ("taken/deep", "taken/deep: ".to_owned() + expected + "it cannot be created: taken is a file"),
    ];
    #[cfg(target_os = "linux")]
    cases.extend([
        // No user may write there, not even root.
        ("/proc", "/proc: ".to_owned() + expected + "nothing can be written into it: "),
        ("/proc/a/b", "/proc/a/b: ".to_owned() + expected + "it cannot be created: "),
    ]);
    for (out, message) in cases {
        let sheet = format!("{out}/sheet.png");
        for command in [
            &["convert", "dam.#.ply", "--out", out][..],
            &["convert", "dam.#.ply", "--particles-only", "--out", out],
            &["render", "dam.#.ply", "--out", out],
            &["man", "--out", out],
            &["contact-sheet", "dam.#.ply", "-o", &sheet],
            &["tune", "dam.#.ply", "--vary", "blend=1.8d,2d", "-o", &sheet],
        ] {
            let result = meniscus(path, command);
            assert_eq!((result.status, &*result.out), (2, ""), "{command:?} {out}: {}", result.err);
            assert!(result.err.contains(&message), "{command:?} {out}: {}", result.err);
            assert_eq!(result.err.lines().count(), 1, "{}", result.err);
        }
    }
    assert_eq!(names_in(path), ["dam.1.ply", "dam.2.ply", "taken"]);
}

/// A command also reports at once if it cannot write a file in addition to the results of frames.
#[test]
#[cfg(target_os = "linux")]
fn unwritable_folder_for_a_report_or_sequence_file_is_refused() {
    let folder = folder();
    let path = folder.path();
    write_sequence(path, 1, 2);
    fs::create_dir(path.join("out")).expect("made");
    for (what, command) in [
        ("the report", &["convert", "dam.#.ply", "--out", "o", "--report", "/proc/r.json"][..]),
        ("the report", &["verify", "out", "--report", "/proc/r.json"]),
        ("the sequence file", &["convert", "dam.#.ply", "--out", "o", "--sequence", "/proc/s.glb"]),
        ("the sequence file", &["sequence", "dam.#.glb", "-o", "/proc/x.glb"]),
    ] {
        let result = meniscus(path, command);
        assert_eq!((result.status, &*result.out), (2, ""), "{command:?}: {}", result.err);
        let message = format!("/proc: cannot write {what} into this folder: ");
        assert!(
            result.err.contains(&message) && result.err.lines().count() == 1,
            "{command:?}: {}",
            result.err
        );
    }
    assert_eq!(names_in(path), ["dam.1.ply", "dam.2.ply", "out"]);
}

/// Root may write everywhere, so this test checks nothing if it runs as root. The test above covers folders
/// in which not even root can write.
#[test]
#[cfg(unix)]
#[expect(clippy::print_stderr, reason = "a test that did not run must say so")]
fn folder_without_write_permission_is_refused() {
    use std::os::unix::fs::PermissionsExt;
    let folder = folder();
    let path = folder.path();
    write_sequence(path, 1, 2);
    fs::create_dir(path.join("out")).expect("made");
    fs::set_permissions(path.join("out"), fs::Permissions::from_mode(0o500)).expect("changed");
    if fs::write(path.join("out/file"), "").is_ok() {
        eprintln!("not run: this user may write everywhere");
        return;
    }
    for out in ["out", "out/deep"] {
        let result = meniscus(path, &["convert", "dam.#.ply", "--out", out]);
        assert_eq!((result.status, &*result.out), (2, ""), "{}", result.err);
        assert!(result.err.contains(out) && result.err.contains("Permission denied"), "{}", result.err);
    }
}

#[test]
fn presets_differ_in_their_settings() {
    let folder = folder();
    write_sequence(folder.path(), 1, 1);
    let settings_line = |preset: &str| {
        let out = meniscus(folder.path(), &["convert", "dam.1.ply", "--out", "o", "--preset", preset]).out;
        out.lines().find(|line| line.contains("voxel size")).expect("the settings").to_owned()
    };
    let [granular, paper] = ["granular", "paper"].map(settings_line);
    assert!(granular.ends_with(", 1 step") && paper.ends_with(", 5 steps"), "{granular} {paper}");
}

#[test]
fn help_and_version_succeed() {
    let folder = folder();
    for arguments in [
        &["--help"][..],
        &["--version"],
        &["convert", "--help"],
        &["info", "-h"],
        &["watch", "-h"],
        &["status", "--help"],
    ] {
        assert_eq!(meniscus(folder.path(), arguments).status, 0);
    }
    let help = meniscus(folder.path(), &["convert", "--help"]).out;
    for word in ["[default: 0.32d", "√3·h", "r_max / r_min", "blend with others", "Exit status"] {
        assert!(help.contains(word), "the help does not say {word}");
    }
}

#[test]
fn error_for_unreadable_inputs_begins_with_the_reason() {
    let folder = folder();
    let path = folder.path();
    for number in 1..=2 {
        let vtk = "# vtk DataFile Version 3.0\nt\nASCII\nDATASET STRUCTURED_POINTS\n";
        fs::write(path.join(format!("f.{number}.vtk")), vtk).expect("written");
    }
    let err = |inputs: &[&str]| meniscus(path, &[&["convert", "--out", "o"], inputs].concat()).err;
    for inputs in [&["f.1.vtk"][..], &["f.1.vtk", "f.2.vtk"]] {
        let err = err(inputs);
        assert!(err.contains("f.1.vtk: legacy VTK: the data set has the type STRUCTURED_POINTS"), "{err}");
        assert!(!err.contains("--spacing") && !err.contains("different places"), "{err}");
    }
    // The frame can be read, but it is sparse: a given spacing would help.
    fs::create_dir(path.join("mixed")).expect("made");
    write_ply(&path.join("mixed/f.1.ply"), &block(1, 0.0));
    fs::write(path.join("mixed/f.2.ply"), "ply\n").expect("written");
    let err = err(&["mixed"]);
    assert!(err.contains("give --spacing; 1 frame cannot be read: ") && err.contains("f.2.ply"), "{err}");
}

#[test]
fn unreadable_file_is_named_with_the_reason() {
    let folder = folder();
    let header =
        "ply\nformat ascii 1.0\nelement vertex 9\nproperty float x\nproperty float y\nproperty float z\n";
    fs::write(folder.path().join("short.ply"), format!("{header}end_header\n0 0 0\n")).expect("written");
    fs::write(folder.path().join("noise.ply"), [1, 2, 3, 200, 255]).expect("written");
    for name in ["short.ply", "noise.ply"] {
        assert_refused(folder.path(), &["convert", name, "--out", "o"], &[name]);
        let sized = ["convert", name, "--out", "o", "--voxel-size", "0.1"];
        assert_refused(folder.path(), &sized, &[name, "error"]);
    }
    let arguments = ["convert", "short.ply", "--out", "o", "--voxel-size", "0.1"];
    assert_refused(folder.path(), &arguments, &["PLY, at"]);
    assert_eq!(names_in(&folder.path().join("o")), [""; 0]);
}

#[test]
fn settings_are_printed_for_each_sequence() {
    let folder = folder();
    let path = folder.path();
    write_sequence(path, 9, 11);
    write_ply(&path.join("coarse.ply"), &block(6, 0.0).map_spacing(2.0));
    let out = meniscus(path, &["convert", ".", "--out", "o"]).out;
    let line = |start: &str| {
        out.lines()
            .find(|line| line.starts_with(start))
            .unwrap_or_else(|| panic!("{start} not in {out}"))
            .to_owned()
    };
    assert!(line("dam.{}.ply: 3 frames, spacing 0.").contains("measured on 3 frames"));
    let spacing = |line: String| -> f64 {
        let after = line.split("spacing ").nth(1).expect("a spacing").to_owned();
        after.split(' ').next().expect("a number").parse().expect("a number")
    };
    let ratio = spacing(line("coarse.ply: 1 frame,")) / spacing(line("dam.{}.ply"));
    assert!((ratio - 2.0).abs() < 1e-3, "{ratio}");
    let selected = meniscus(path, &["convert", "dam.%d.ply", "--frames", "10-11", "--out", "o"]).out;
    assert!(selected.contains("2 frames") && selected.contains("measured on 3 frames"), "{selected}");
}

#[test]
fn warnings_name_the_sequence() {
    let folder = folder();
    write_sequence(folder.path(), 1, 1);
    let arguments = ["convert", "dam.1.ply", "--out", "o", "--preset", "paper", "--radius-min", "0.05"];
    let result = meniscus(folder.path(), &arguments);
    assert_eq!(result.err.matches("warning: dam.1.ply: r_min is").count(), 1, "{}", result.err);
}

#[test]
fn voxel_size_that_does_not_fit_the_particles_causes_a_warning() {
    let folder = folder();
    write_ply(&folder.path().join("block.ply"), &block(5, 0.0));
    let of_size = |voxel_size: &str| {
        let arguments = ["convert", "block.ply", "--out", "o", "--format", "glb", "--report", "r.json"];
        let result = meniscus(
            folder.path(),
            &[&arguments[..], &["--preset", "paper", "--voxel-size", voxel_size]].concat(),
        );
        assert_eq!(result.status, 0, "{}", result.err);
        let report = fs::read_to_string(folder.path().join("r.json")).expect("a report");
        (result.err, report)
    };
    for (voxel_size, words) in [
        (
            "0.01",
            "125 particles became 125 pieces, most of one particle each: unless they really are spray, the voxel size 0.01 is too small",
        ),
        ("10", "all of the 125 particles are within 4 voxels: the voxel size 10 is too large"),
    ] {
        let (err, report) = of_size(voxel_size);
        assert!(err.contains(words) && report.contains(words), "{voxel_size}: {err}");
    }
    assert_eq!(of_size("0.08").0, "");
}

#[test]
fn numbers_are_short_at_any_scale() {
    let folder = folder();
    write_ply(&folder.path().join("small.ply"), &block(6, 0.0).map_spacing(1e-6));
    let result = meniscus(folder.path(), &["convert", "small.ply", "--out", "o"]);
    let line = result.out.lines().find(|line| line.contains("voxel size")).expect("the settings").to_owned();
    let numbers: Vec<&str> = line.split([' ', ',', '(', ')']).filter(|word| word.contains("e-")).collect();
    // The voxel size, the spacing and how far particles blend.
    assert_eq!(numbers.len(), 3, "{line}");
    assert!(numbers.iter().all(|n| n.len() <= 10 && n.parse().is_ok_and(|n: f64| n > 0.0)), "{line}");
}

#[test]
fn ignored_options_cause_a_warning() {
    let folder = folder();
    write_sequence(folder.path(), 1, 1);
    for anisotropy in ["none", "neighbors", "velocity"] {
        let arguments = ["convert", "dam.1.ply", "--anisotropy", anisotropy, "--velocity-gain", "0.5"];
        let result = meniscus(folder.path(), &[&arguments[..], &["--print-settings"]].concat());
        assert_eq!(result.status, 0, "{}", result.err);
        let is_warned = result.err.contains("--velocity-gain is ignored");
        assert_eq!(is_warned, anisotropy != "velocity", "{}", result.err);
    }
}

/// Position smoothing and anisotropy each use --neighbor-radius; without both, the option is ignored.
#[test]
fn position_smoothing_needs_no_anisotropy() {
    let folder = folder();
    write_sequence(folder.path(), 1, 1);
    for (more, is_ignored) in [
        (&["--neighbor-radius", "0.2"][..], true),
        (&["--neighbor-radius", "0.2", "--position-smoothing", "0"], true),
        (&["--neighbor-radius", "0.2", "--position-smoothing", "0.5"], false),
        (&["--neighbor-radius", "0.2", "--anisotropy", "neighbors"], false),
        (&["--position-smoothing", "0.5"], false),
    ] {
        let convert = ["convert", "dam.1.ply", "--out", "o", "--preset", "paper"];
        let result = meniscus(folder.path(), &[&convert[..], more].concat());
        assert_eq!(result.status, 0, "{}", result.err);
        assert_eq!(result.err.contains("is ignored"), is_ignored, "{more:?}: {}", result.err);
    }
}

/// An option that is invalid and without effect causes one error, and no warning.
#[test]
fn invalid_option_is_an_error_and_not_ignored() {
    let folder = folder();
    write_sequence(folder.path(), 1, 1);
    let result = meniscus(folder.path(), &["convert", "dam.1.ply", "--out", "o", "--max-stretch", "9"]);
    assert!(
        result.status == 2 && result.err.contains("from 1 to 8") && !result.err.contains("ignored"),
        "{}",
        result.err
    );
    let result = meniscus(folder.path(), &["convert", "dam.1.ply", "--out", "o", "--memory", "5"]);
    assert!(result.status == 2 && result.err.contains("memory limit of 5 bytes"), "{}", result.err);
}

/// An option for an output format that is not selected causes a warning, and none if the format is selected.
#[test]
fn options_of_formats_that_are_not_written_cause_a_warning() {
    let folder = folder();
    write_sequence(folder.path(), 1, 1);
    let mesh = ["--contour", "--decimate", "--smooth-normals", "--quads", "--up"];
    let vdb = ["--vdb"];
    for (format, idle) in [
        ("vdb", &mesh[..]),
        ("obj", &["--up", "--vdb"]),
        ("obj,gltf", &vdb),
        ("ply,vdb", &["--quads", "--up"]),
        ("glb,vdb", &["--quads"]),
    ] {
        for option in mesh.iter().chain(&vdb) {
            let value = match *option {
                "--contour" => "=dual",
                "--decimate" => "=0.1",
                "--smooth-normals" => "=5",
                "--up" => "=z",
                "--vdb" => "=half,none",
                _ => "",
            };
            let typed = format!("{option}{value}");
            let arguments = ["convert", "dam.1.ply", "--print-settings", "--format", format, &typed];
            let result = meniscus(folder.path(), &arguments);
            assert_eq!(result.status, 0, "{}", result.err);
            let line = format!("warning: {option} is ignored: it affects ");
            assert_eq!(
                result.err.contains(&line),
                idle.contains(option),
                "{format} {option}: {}",
                result.err
            );
        }
    }
}

#[test]
fn other_files_in_the_folder_are_skipped() {
    let folder = folder();
    let path = folder.path();
    write_sequence(path, 1, 2);
    let others = [
        ("notes.txt", "Hello, this is a simulation of a dam, broken at 10 s.\nIt took 3 days, 2 hours.\n"),
        ("run.log", "step 10\nstep 11\nstep 12\n"),
        ("sim.py", "import os, sys\n\nprint(1, 2, 3)\n"),
        ("README.md", "# Frames\n\n1. one\n2. two\n"),
        ("Makefile", "all: 1 2 3\n\techo 1, 2, 3\n"),
        ("scene.json", "{\"gravity\": [0, -9.81, 0]}\n"),
    ];
    for (name, text) in others {
        fs::write(path.join(name), text).expect("written");
    }
    // A table counts as a frame under any name that does not imply other contents. Without a header it may be a log,
    // unless its name has a number.
    fs::write(path.join("table.txt"), "x,y,z\n0,0,0\n1,0,0\n").expect("written");
    fs::write(path.join("bare1"), "1 0 0\n0 0 0\n").expect("written");
    let result = meniscus(path, &["convert", ".", "--out", "o", "--format", "ply", "--spacing", "0.1"]);
    assert_eq!((result.status, &*result.err), (0, ""), "{}", result.out);
    assert!(result.out.contains("skipped Makefile and 5 other files: not particle files"), "{}", result.out);
    for name in others.map(|(name, _)| name).iter().filter(|name| **name != "notes.txt") {
        fs::remove_file(path.join(name)).expect("removed");
    }
    let result = meniscus(path, &["convert", ".", "--out", "o", "--format", "ply", "--spacing", "0.1"]);
    assert!(result.out.contains("skipped notes.txt: not a particle file"), "{}", result.out);
    // With several folders, the message names the folder.
    fs::create_dir(path.join("more")).expect("made");
    write_sequence(&path.join("more"), 3, 3);
    fs::write(path.join("more/README"), "Nothing to see here.\n").expect("written");
    let several = ["convert", ".", "more", "--out", "several", "--format", "ply", "--spacing", "0.1"];
    let result = meniscus(path, &several);
    let file_name = Path::new(".").join("notes.txt").display().to_string();
    assert!(
        result.out.contains(&format!("skipped {file_name} and 1 other file: not particle files")),
        "{}",
        result.out
    );
    assert_eq!(names_in(&path.join("o")), ["bare1.ply", "dam.1.ply", "dam.2.ply", "table.ply"]);
}

#[test]
fn results_among_the_frames_are_not_frames() {
    let folder = folder();
    let path = folder.path();
    write_sequence(path, 1, 2);
    let arguments = ["convert", ".", "--out", "shot", "--format", "glb,gltf,vdb,obj,ply"];
    assert_eq!(meniscus(path, &arguments).status, 0);
    // A similar file from another program is a frame.
    write_sequence(&path.join("shot"), 3, 3);
    let result = meniscus(path, &["convert", "shot", "--out", "o", "--format", "ply"]);
    assert_eq!((result.status, &*result.err), (0, ""), "{}", result.out);
    assert!(result.out.contains("skipped dam.1.glb and 9 other files"), "{}", result.out);
    assert_eq!(names_in(&path.join("o")), ["dam.3.ply"]);
}

#[test]
#[cfg(target_os = "linux")]
fn unreadable_file_in_a_folder_fails_the_run() {
    let folder = folder();
    let path = folder.path();
    write_sequence(path, 1, 1);
    // A file that not even root can read from its start.
    std::os::unix::fs::symlink("/proc/self/mem", path.join("odd")).expect("linked");
    let result = meniscus(path, &["convert", ".", "--out", "o"]);
    assert_eq!(result.status, 1, "{}", result.err);
    assert!(result.err.contains("error: ./odd: Input/output error"), "{}", result.err);
    assert!(!result.out.contains("skipped "), "{}", result.out);
}

#[test]
#[cfg(unix)]
fn interrupted_run_leaves_no_incomplete_file() {
    use std::process::{Command, Stdio};
    let folder = folder();
    let path = folder.path();
    write_ply(&path.join("dam.1.ply"), &block(20, 0.0));
    for signal in ["INT", "TERM"] {
        // A frame with this number of voxels takes minutes.
        let arguments =
            ["convert", "dam.1.ply", "--out", "o", "--integrator", "explicit", "--steps", "100000"];
        let mut command = crate::program::scene::command(path, &arguments);
        let mut child = command.stdout(Stdio::piped()).stderr(Stdio::null()).spawn().expect("it starts");
        // The command has printed its settings, so the conversion has started.
        let mut first = [0];
        std::io::Read::read_exact(child.stdout.as_mut().expect("its output"), &mut first).expect("a line");
        let sent = Command::new("kill").args(["-s", signal, &child.id().to_string()]).status();
        assert!(sent.expect("the signal is sent").success());
        let status = child.wait().expect("it ends");
        assert_eq!(status.code(), Some(if signal == "INT" { 130 } else { 143 }));
        assert_eq!(names_in(&path.join("o")), [""; 0]);
    }
}

/// Blocks of particles at another scale.
trait MapSpacing {
    fn map_spacing(self, factor: f64) -> Self;
}

impl MapSpacing for Vec<[f64; 3]> {
    fn map_spacing(self, factor: f64) -> Self {
        self.into_iter().map(|position| position.map(|x| x * factor)).collect()
    }
}

#[test]
fn folder_to_watch_is_no_pattern_of_files() {
    let folder = folder();
    let path = folder.path();
    fs::create_dir(path.join("in")).expect("made");
    for (input, words) in
        [("in/*.ply", "use in --pattern '*.ply'"), ("dam.####.bgeo", "use . --pattern 'dam.*.bgeo'")]
    {
        let result = meniscus(path, &["watch", input, "--out", "o", "--once"]);
        assert!(result.status == 2 && result.err.contains(words), "{}", result.err);
    }
}

#[test]
fn new_configuration_is_valid_before_anything_is_recorded() {
    let folder = folder();
    let path = folder.path();
    fs::create_dir(path.join("in")).expect("made");
    fs::write(path.join("m.toml"), "[[watch]]\ninput = \"in\"\noutput = \"out\"\n").expect("written");
    let result = meniscus(path, &["status", "--config", "m.toml"]);
    assert_eq!(result.status, 0, "{}", result.err);
    assert!(result.err.contains("m.toml: valid; nothing is recorded yet in "), "{}", result.err);
    let result = meniscus(path, &["status", "--out", "out"]);
    assert!(result.status != 0 && result.err.contains("nothing is recorded here"), "{}", result.err);
}

#[test]
fn quiet_prints_warnings_and_errors_only() {
    let folder = tempdir().expect("a folder");
    write_ply(&folder.path().join("a.1.ply"), &block(4, 0.0));
    let result = meniscus(folder.path(), &["convert", "a.1.ply", "--out=out", "--format=obj", "-q"]);
    assert_eq!((result.status, &*result.out, &*result.err), (0, "", ""));
    let result = meniscus(folder.path(), &["convert", "b.1.ply", "--out=out", "-q"]);
    assert!(result.status == 2 && result.err.contains("b.1.ply"), "{}", result.err);
}

/// As splashsurf has it.
#[test]
fn radius_is_answered_with_the_spacing() {
    let folder = tempdir().expect("a folder");
    for (arguments, hint) in [
        (&["-r", "0.025"][..], "--spacing 0.05"),
        (&["-r"], "--spacing D"),
        (&["--particle-radius", "0.025"], "--spacing 0.05"),
        (&["--radius=0.025"], "--spacing 0.05"),
    ] {
        let result = meniscus(folder.path(), &[&["convert", "a.1.ply"][..], arguments].concat());
        assert!(result.status == 2 && result.err.contains(hint), "{}", result.err);
    }
}
