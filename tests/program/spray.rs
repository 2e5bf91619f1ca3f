//! Spray: small pieces of fluid that are points beside the surface, in the files of every format, and over time.

use std::fmt::Write as _;
use std::fs;
use std::path::Path;

use meniscus_formats::{AttributeRole, Limits, ParticleFrame, Values, bgeo, read_particles};
use tempfile::{TempDir, tempdir};

use crate::program::scene::{RunResult, assert_refused, meniscus, names_in};

/// The distance of neighbouring particles.
const SPACING: f64 = 0.1;

/// A frame: a block of 5 × 5 × 5 particles with the ids 0 to 124, and others with these ids and heights above it.
fn frame(drops: &[(i64, f64)], has_ids: bool) -> String {
    let block = (0..125)
        .map(|index| (index, [index % 5, index / 5 % 5, index / 25].map(|step| SPACING * step as f64)));
    let drops = drops.iter().map(|(id, height)| (*id, [0.4 * (id % 2) as f64, 0.2, 0.4 + height]));
    let all: Vec<(i64, [f64; 3])> = block.chain(drops).collect();
    let id = if has_ids { "property int id\n" } else { "" };
    let mut text = format!(
        "ply\nformat ascii 1.0\nelement vertex {}\nproperty float x\nproperty float y\nproperty float z\nproperty float heat\n{id}end_header\n",
        all.len()
    );
    for (id, [x, y, z]) in all {
        let id = if has_ids { format!(" {id}") } else { String::new() };
        writeln!(text, "{x} {y} {z} {}{id}", 2.0 * z).expect("text");
    }
    text
}

/// Nine frames. Particle 1000 touches the block in frames 4 and 5, and particle 1001 in frames 4 to 7.
fn splash(has_ids: bool) -> TempDir {
    let folder = tempdir().expect("a folder");
    for name in ["in", "out"] {
        fs::create_dir(folder.path().join(name)).expect("made");
    }
    for number in 1..=9 {
        let height =
            |contact: std::ops::RangeInclusive<i32>| if contact.contains(&number) { 0.1 } else { 0.5 };
        let text = frame(&[(1000, height(4..=5)), (1001, height(4..=7))], has_ids);
        fs::write(folder.path().join(format!("in/dam.{number}.ply")), text).expect("written");
    }
    folder
}

fn convert(folder: &Path, out: &str, more: &[&str]) -> RunResult {
    let fixed = ["convert", "in", "--out", out, "--spacing", "0.1", "--spray", "20"];
    let result = meniscus(folder, &[&fixed[..], more].concat());
    assert_eq!(result.status, 0, "{}{}", result.out, result.err);
    result
}

fn read(path: &Path) -> ParticleFrame {
    let name = path.file_name().expect("a name").to_string_lossy();
    let bytes = fs::read(path).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
    read_particles(&bytes, &name, &Limits::default()).unwrap_or_else(|error| panic!("{name}: {error}"))
}

/// The ids of the points in a file.
fn ids(path: &Path) -> Vec<i64> {
    let frame = read(path);
    let ids = frame.attributes.iter().find(|attribute| attribute.role == Some(AttributeRole::Id));
    match &ids.unwrap_or_else(|| panic!("no ids in {}", path.display())).values {
        Values::I32(ids) => ids.iter().map(|&id| id.into()).collect(),
        Values::I64(ids) => ids.clone(),
        values => panic!("{values:?}"),
    }
}

fn contents(folder: &Path) -> Vec<(String, Vec<u8>)> {
    let names = names_in(folder).into_iter();
    names.map(|name| (name.clone(), fs::read(folder.join(&name)).expect("readable"))).collect()
}

#[test]
fn contacts_shorter_than_the_limit_change_nothing() {
    let folder = splash(true);
    let folder = folder.path();
    convert(folder, "out", &["--format", "obj", "--report", "report.json"]);
    let spray = |number: usize| ids(&folder.join(format!("out/dam.{number}.spray.ply")));
    for number in 1..=9 {
        let expected = if (4..=7).contains(&number) { vec![1000] } else { vec![1000, 1001] };
        assert_eq!(spray(number), expected, "frame {number}");
    }
    let report: serde_json::Value =
        serde_json::from_slice(&fs::read(folder.join("report.json")).expect("a report")).expect("JSON");
    let of_frame = |number: usize| &report["frames"][number - 1];
    assert_eq!(of_frame(1)["particles"], 125);
    assert_eq!(of_frame(5)["particles"], 126);
    assert_eq!(
        of_frame(1)["spray"],
        serde_json::json!({"particles": 2, "drops": 2, "clusters": 0, "filaments": 0})
    );
    assert_eq!(of_frame(1)["components"], 1);
    assert_eq!(of_frame(1)["certificate"]["holds"], true);
    // Each frame alone decides with a limit of one.
    convert(folder, "alone", &["--format", "obj", "--spray-keep", "1"]);
    assert_eq!(ids(&folder.join("alone/dam.5.spray.ply")), [0; 0]);
    assert_eq!(ids(&folder.join("alone/dam.6.spray.ply")), [1000]);
}

#[test]
fn points_have_the_volume_and_the_attributes_of_their_particles() {
    let folder = splash(true);
    let folder = folder.path();
    convert(folder, "out", &["--format", "obj", "--frames", "7"]);
    let points = read(&folder.join("out/dam.7.spray.ply"));
    let numbers = |name: &str| {
        let attribute = points.attributes.iter().find(|attribute| attribute.name == name);
        match &attribute.unwrap_or_else(|| panic!("{name} of {:?}", points.attributes)).values {
            Values::F32(values) => values.iter().map(|&value| value.into()).collect(),
            Values::I32(values) => values.iter().map(|&value| value.into()).collect::<Vec<f64>>(),
            values => panic!("{name}: {values:?}"),
        }
    };
    let volume = 4.0 / 3.0 * std::f64::consts::PI * numbers("radius")[0].powi(3);
    assert!((volume / SPACING.powi(3) - 1.0).abs() < 1e-5, "{volume}");
    assert!((numbers("heat")[0] - 1.8).abs() < 1e-6);
    // Frame 6 was the first one apart.
    assert_eq!(
        (numbers("spray_class"), numbers("spray_size"), numbers("spray_age")),
        (vec![0.0], vec![1.0], vec![1.0])
    );
}

#[test]
fn spray_is_the_same_bytes_however_the_frames_are_divided() {
    let folder = splash(true);
    let folder = folder.path();
    let more = ["--format", "ply", "--temporal", "1"];
    convert(folder, "one", &[&more[..], &["--threads", "1"]].concat());
    let one = contents(&folder.join("one"));
    assert_eq!(one.len(), 18);
    convert(folder, "four", &[&more[..], &["--threads", "4"]].concat());
    assert!(contents(&folder.join("four")) == one);
    for shard in ["2/3", "1/3", "3/3"] {
        convert(folder, "out", &[&more[..], &["--shard", shard]].concat());
    }
    assert!(contents(&folder.join("out")) == one);
    convert(folder, "some", &[&more[..], &["--frames", "5"]].concat());
    assert!(contents(&folder.join("some")).iter().all(|file| one.contains(file)));
}

#[test]
fn changed_frames_concern_those_that_depend_on_them() {
    let folder = splash(true);
    let folder = folder.path();
    convert(folder, "out", &["--format", "obj"]);
    let verify = || meniscus(folder, &["verify", "out", "--input", "in"]);
    assert_eq!(verify().status, 0, "{}", verify().err);
    // Four frames on each side depend on it.
    fs::write(folder.join("in/dam.1.ply"), frame(&[(1000, 0.6), (1001, 0.5)], true)).expect("written");
    let found = verify();
    assert!(found.out.contains("4 done, 5 stale"), "{}{}", found.out, found.err);
    let again = convert(folder, "out", &["--format", "obj", "--skip-done"]);
    assert_eq!(again.out.matches("done already").count(), 4, "{}", again.out);
    assert_eq!(verify().status, 0, "{}", verify().err);
    fs::remove_file(folder.join("out/dam.3.spray.ply")).expect("removed");
    assert!(verify().err.contains("dam.3.spray.ply"), "{}", verify().err);
    let again = convert(folder, "out", &["--format", "obj", "--skip-done", "--spray-format", "ply"]);
    assert_eq!(again.out.matches("done already").count(), 8, "{}", again.out);
    for (formats, done_count) in [("vtp,bgeo", 0), ("bgeo,vtp", 9)] {
        let other = convert(folder, "out", &["--format", "obj", "--skip-done", "--spray-format", formats]);
        assert_eq!(other.out.matches("done already").count(), done_count, "{}", other.out);
    }
}

#[test]
fn points_have_the_formats_of_the_meshes_or_others() {
    let folder = splash(true);
    let folder = folder.path();
    for (options, expected) in [
        (&["--format", "glb,vdb"][..], &["ply"][..]),
        (&["--format", "usdc,glb,abc"], &["abc", "usdc"]),
        (&["--format", "obj", "--spray-format", "bgeo,usda,vtp,bgeo"], &["bgeo", "usda", "vtp"]),
    ] {
        let out = format!("formats-{}", expected[0]);
        convert(folder, &out, &[options, &["--frames", "2"]].concat());
        let mut names = names_in(&folder.join(&out));
        names.retain(|name| name.contains(".spray."));
        let expected: Vec<String> =
            expected.iter().map(|extension| format!("dam.2.spray.{extension}")).collect();
        assert_eq!(names, expected);
        for name in names {
            assert_eq!(ids(&folder.join(&out).join(&name)), [1000, 1001], "{name}");
        }
    }
    // Points are no frames of their folder, and are replaced.
    let found = meniscus(folder, &["convert", "formats-bgeo", "--out", "none"]);
    assert!(found.status != 0 && !folder.join("none").exists(), "{}{}", found.out, found.err);
    convert(folder, "formats-bgeo", &["--format", "obj", "--spray-format", "bgeo,usda,vtp", "--frames", "2"]);
}

#[test]
fn sequence_files_have_the_points_beside_the_frames() {
    let folder = splash(true);
    let folder = folder.path();
    fs::remove_file(folder.join("in/dam.3.ply")).expect("removed");
    // Frame 9 has no spray.
    fs::write(folder.join("in/dam.9.ply"), frame(&[], true)).expect("written");
    let outputs = ["--format", "glb,usdc", "--spray-format", "ply,vtp,bgeo,usda,usdc,abc", "--up", "z"];
    let shots = ["--sequence", "shot.abc", "--sequence", "shot.glb"];
    let made = convert(folder, "out", &[&outputs[..], &["--spray-keep", "1"], &shots].concat());
    assert!(made.out.contains("shot.abc: a sequence file of 8 frames, 8 points, "), "{}", made.out);
    assert!(made.out.contains("shot.glb: a sequence file of 8 frames, "), "{}", made.out);
    let note =
        "shot.glb: the points beside the frames (--spray) are missing: a sequence in .glb has only meshes";
    assert_eq!(made.err.matches("the points beside the frames").count(), 1, "{}", made.err);
    assert!(made.err.contains(note), "{}", made.err);

    let info = meniscus(folder, &["info", "shot.abc"]).out;
    assert!(info.contains("\n  points               8, in all frames\n"), "{info}");
    // The points are the same from every format, beside a frame in any format.
    let expected = fs::read(folder.join("shot.abc")).expect("readable");
    for (format, mesh) in
        ["ply", "vtp", "bgeo", "usda", "usdc", "abc"].iter().flat_map(|f| [(f, "glb"), (f, "usdc")])
    {
        let only = tempdir().expect("a folder");
        for number in [1, 2, 4, 5, 6, 7, 8, 9] {
            for name in [format!("dam.{number}.{mesh}"), format!("dam.{number}.spray.{format}")] {
                fs::copy(folder.join("out").join(&name), only.path().join(&name)).expect("copied");
            }
        }
        let result = meniscus(only.path(), &["sequence", ".", "-o", "shot.abc"]);
        assert_eq!((result.status, &*result.err), (0, "warning: shot.abc: 3: 1 frame is missing\n"));
        assert!(fs::read(only.path().join("shot.abc")).expect("readable") == expected, "{format} {mesh}");
    }
    let refused = meniscus(folder, &["convert", "shot.abc", "--out", "none"]);
    assert!(refused.err.contains("this is a mesh, not particles"), "{}", refused.err);
}

#[test]
fn frame_is_left_out_of_a_sequence_file_if_its_points_are_damaged() {
    let folder = splash(true);
    let folder = folder.path();
    convert(folder, "out", &["--format", "glb", "--spray-format", "usdc,ply", "--frames", "1-3"]);
    let sequence = |shot: &str| meniscus(folder, &["sequence", "out", "-o", shot]);
    let path = |format: &str| folder.join(format!("out/dam.2.spray.{format}"));
    let whole = fs::read(path("usdc")).expect("readable");
    let mut flipped = whole.clone();
    let last = flipped.len() - 200;
    flipped[last..].fill(0xff);
    for damaged in [&whole[..whole.len() - 4], &whole[..2500], &flipped] {
        fs::write(path("usdc"), damaged).expect("written");
        let result = sequence("shot.abc");
        assert_eq!(result.status, 1, "{}{}", result.out, result.err);
        let words = "dam.2.spray.usdc: left out of the sequence file: USD";
        assert!(result.err.contains(words), "{}", result.err);
        assert!(result.out.contains("a sequence file of 2 frames, 4 points"), "{}", result.out);
    }
    // Without that file, the points are in the other.
    fs::remove_file(path("usdc")).expect("removed");
    let result = sequence("shot.abc");
    assert!(result.status == 0 && result.out.contains("3 frames, 6 points"), "{}{}", result.out, result.err);
    // Those of another run, and files of other programs, are not those of the mesh.
    let ply = fs::read(path("ply")).expect("readable");
    for (name, bytes) in [("dam.1.spray.ply", None), ("../in/dam.2.ply", None), ("", Some(b""))] {
        let bytes = bytes.map_or_else(
            || fs::read(folder.join("out").join(name)).expect("readable"),
            |b: &[u8; 0]| b.to_vec(),
        );
        fs::write(path("ply"), bytes).expect("written");
        let result = sequence("shot.abc");
        assert_eq!(result.status, 1, "{}{}", result.out, result.err);
        let words = "dam.2.spray.ply: left out of the sequence file: these are not the points of the mesh";
        assert!(result.err.contains(words), "{}", result.err);
    }
    fs::remove_file(path("ply")).expect("removed");
    let result = sequence("shot.abc");
    assert!(result.status == 0 && result.out.contains("3 frames, 4 points"), "{}{}", result.out, result.err);
    let words = "dam.2.glb are missing: there is no file with them";
    assert!(result.err.contains("the points (--spray) of ") && result.err.contains(words), "{}", result.err);
    // A sequence in .glb needs no points.
    fs::write(path("ply"), &ply[..ply.len() - 1]).expect("written");
    let result = sequence("shot.glb");
    assert!(result.status == 0 && result.out.contains("of 3 frames, "), "{}{}", result.out, result.err);
}

#[test]
fn points_of_an_earlier_run_are_not_in_a_sequence_file() {
    let folder = splash(true);
    let folder = folder.path();
    convert(folder, "out", &["--format", "glb", "--spray-format", "usdc"]);
    let plain = |out: &str| {
        let arguments = ["convert", "in", "--out", out, "--spacing", "0.1", "--format", "glb"];
        let result = meniscus(folder, &arguments);
        assert_eq!(result.status, 0, "{}{}", result.out, result.err);
        let result = meniscus(folder, &["sequence", out, "-o", "shot.abc"]);
        assert_eq!((result.status, &*result.err), (0, ""), "{}", result.out);
        let shot = fs::read(folder.join("shot.abc")).expect("readable");
        assert!(!shot.windows(13).any(|part| part == b"surface_spray"));
        shot
    };
    let shot = plain("out");
    assert!(folder.join("out/dam.1.spray.usdc").exists() && shot == plain("none"));
}

#[test]
fn files_of_other_programs_with_such_names_are_ordinary_files() {
    let folder = splash(true);
    let folder = folder.path();
    fs::create_dir(folder.join("whitewater")).expect("made");
    fs::copy(folder.join("in/dam.1.ply"), folder.join("whitewater/dam.1.spray.ply")).expect("copied");
    let result = meniscus(
        folder,
        &["convert", "whitewater", "--out", "meshes/", "--format", "obj", "--spacing", "0.1"],
    );
    assert_eq!(result.status, 0, "{}", result.err);
    assert_eq!(names_in(&folder.join("meshes")), ["dam.1.spray.obj"]);
    let ply = fs::read(folder.join("in/dam.1.ply")).expect("read");
    let mut bgeo = Vec::new();
    bgeo::write(&read(&folder.join("in/dam.1.ply")), &mut bgeo).expect("written");
    for (format, bytes) in [("bgeo", &bgeo), ("ply", &ply)] {
        let path = folder.join(format!("out/dam.1.spray.{format}"));
        fs::write(&path, bytes).expect("written");
        let options = ["--spray", "20", "--spray-format", format, "--spacing", "0.1", "--format", "obj"];
        let result = meniscus(folder, &[&["convert", "in/dam.1.ply", "--out", "out"], &options[..]].concat());
        assert!(
            result.status != 0 && result.err.contains(&format!("dam.1.spray.{format}")),
            "{}",
            result.err
        );
        assert!(fs::read(&path).expect("read") == *bytes && !folder.join("out/dam.1.obj").exists());
    }
}

#[test]
fn particles_that_no_surface_has_are_not_spray() {
    let folder = splash(true);
    let folder = folder.path();
    let text = fs::read_to_string(folder.join("in/dam.2.ply")).expect("readable");
    let (head, last) = text.trim_end().rsplit_once('\n').expect("rows");
    let last = last.replacen(last.split(' ').next().expect("x"), "nan", 1);
    fs::write(folder.join("in/dam.2.ply"), format!("{head}\n{last}\n")).expect("written");
    convert(folder, "out", &["--format", "usdc", "--report", "report.json"]);
    assert_eq!(ids(&folder.join("out/dam.2.spray.usdc")), [1000]);
    assert_eq!(ids(&folder.join("out/dam.3.spray.usdc")), [1000, 1001]);
}

#[test]
fn frames_without_ids_are_decided_alone_with_a_warning() {
    let folder = splash(false);
    let folder = folder.path();
    let result = convert(folder, "out", &["--format", "obj"]);
    assert!(result.err.contains("the particles have no ids of their own"), "{}", result.err);
    assert_eq!(read(&folder.join("out/dam.5.spray.ply")).positions.len(), 0);
    assert_eq!(read(&folder.join("out/dam.6.spray.ply")).positions.len(), 1);
    let result = convert(folder, "alone", &["--format", "obj", "--spray-keep", "1"]);
    assert!(!result.err.contains("no ids"), "{}", result.err);
}

#[test]
fn a_frame_may_be_spray_only() {
    let folder = splash(true);
    let folder = folder.path();
    let drops: String = (0..8).map(|index| format!("{index},0,{}\n", 0.5 * f64::from(index))).collect();
    fs::write(folder.join("drops.csv"), format!("x,y,z\n{drops}")).expect("written");
    let drops = ["convert", "drops.csv", "--out", "out/drops.glb", "--spacing", "0.1", "--spray", "2"];
    let shots = ["y", "z"].map(|up| {
        let result = meniscus(folder, &[&drops[..], &["--up", up]].concat());
        assert_eq!(result.status, 0, "{}{}", result.out, result.err);
        assert_eq!(read(&folder.join("out/drops.spray.ply")).positions.len(), 8);
        let result = meniscus(folder, &["sequence", "out/drops.glb", "-o", "drops.abc"]);
        assert_eq!((result.status, &*result.err), (0, ""), "{}", result.out);
        assert!(result.out.contains("a sequence file of 1 frame, 8 points, "), "{}", result.out);
        fs::read(folder.join("drops.abc")).expect("readable")
    });
    // A sequence without any mesh has the axes of the points.
    assert!(shots[0] != shots[1]);
}

#[test]
fn options_that_contradict_spray_are_refused_or_ignored() {
    let folder = splash(true);
    let folder = folder.path();
    let refused = |arguments: &[&str], words: &str| {
        assert_refused(folder, &[&["convert", "in/dam.1.ply"], arguments].concat(), &[words]);
    };
    refused(&["--out", "-", "--spray", "20"], "--spray writes a second file");
    refused(&["--out", "out", "--spray", "1001"], "0 to 1000");
    refused(&["--out", "out", "--spray", "20", "--spray-keep", "0"], "1 to 5");
    refused(&["--out", "out", "--particles-only", "--spray", "20"], "--spray");
    let result = meniscus(
        folder,
        &["convert", "in/dam.1.ply", "--out", "out", "--spray-format", "ply", "--spray-keep", "2"],
    );
    assert_eq!(result.status, 0, "{}", result.err);
    for words in [
        "--spray-format is ignored: it is for --spray only",
        "--spray-keep is ignored: it is for --spray only",
    ] {
        assert!(result.err.contains(words), "{}", result.err);
    }
    let up = [
        "convert",
        "in/dam.1.ply",
        "--out",
        "up",
        "--format",
        "obj",
        "--spray-format",
        "abc",
        "--spray",
        "20",
    ];
    let result = meniscus(folder, &[&up[..], &["--up", "z", "--spacing", "0.1"]].concat());
    assert!(result.status == 0 && !result.err.contains("ignored"), "{}", result.err);
}

#[test]
fn info_has_the_size_of_a_file_of_points() {
    let folder = splash(true);
    convert(folder.path(), "out", &["--format", "ply", "--spray-format", "usdc"]);
    let path = folder.path().join("out/dam.2.spray.usdc");
    let size = fs::metadata(&path).expect("written").len();
    let result = meniscus(folder.path(), &["info", "out/dam.2.spray.usdc"]);
    assert!(result.out.contains(&format!("dam.2.spray.usdc: binary USD, {size} bytes")), "{}", result.out);
}

#[test]
fn a_pattern_of_surfaces_may_match_the_points_beside_them() {
    let folder = splash(true);
    convert(folder.path(), "out", &["--format", "ply"]);
    let result = meniscus(folder.path(), &["flicker", "out/*.ply", "--particles", "in"]);
    assert_eq!(result.status, 0, "{}", result.err);
    assert!(result.out.contains("dam.{}.ply: flicker"), "{}", result.out);
    let result = meniscus(folder.path(), &["render", "out/*.ply", "--out", "pictures", "--size", "64x48"]);
    assert_eq!(result.status, 0, "{}", result.err);
    let pictures = (1..=9).map(|number| format!("dam.{number}.png"));
    assert_eq!(names_in(&folder.path().join("pictures")), pictures.collect::<Vec<_>>());
}

#[test]
fn points_outside_the_clip_box_are_left_out() {
    let folder = splash(true);
    let folder = folder.path();
    convert(folder, "out", &["--format", "obj", "--frames", "1", "--clip", "-1,-1,-1,0.2,2,2"]);
    assert_eq!(ids(&folder.join("out/dam.1.spray.ply")), [1000]);
}
