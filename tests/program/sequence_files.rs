//! Meshes for other programs, and a whole sequence in one file: the bytes do not depend on the command that
//! made the frames, and no command writes a file that the user did not request.

use std::fs;
use std::path::Path;

use meniscus_formats::{Limits, abc};
use serde_json::Value;
use tempfile::{TempDir, tempdir};

use crate::program::scene::{RunResult, block, meniscus, names_in, write_ply, write_sequence};

fn succeeded(result: &RunResult) {
    assert_eq!(result.status, 0, "{}{}", result.out, result.err);
}

fn refused(folder: &Path, arguments: &[&str], words: &[&str]) {
    let result = meniscus(folder, arguments);
    assert_eq!(result.status, 2, "{arguments:?}: {}{}", result.out, result.err);
    for word in words {
        assert!(result.err.contains(word), "{word} is not in {}", result.err);
    }
}

/// A folder with frames `in/dam.1.ply` to `in/dam.N.ply`.
fn frames(count: usize) -> TempDir {
    let folder = tempdir().expect("a folder");
    fs::create_dir(folder.path().join("in")).expect("made");
    write_sequence(&folder.path().join("in"), 1, count);
    folder
}

/// The JSON of a .glb.
fn document(path: &Path) -> Value {
    let bytes = fs::read(path).expect("readable");
    let length = u32::from_le_bytes(bytes[12..16].try_into().expect("four bytes")) as usize;
    assert_eq!(u32::from_le_bytes(bytes[8..12].try_into().expect("four bytes")) as usize, bytes.len());
    serde_json::from_slice(&bytes[20..20 + length]).expect("JSON")
}

const EVERY_MESH: [&str; 8] =
    ["convert", "in", "--out", "out", "--voxel-size", "0.05", "--format", "glb,vtp,stl,usda,usdc,abc"];

#[test]
fn outputs_for_other_programs_record_the_generator() {
    let folder = frames(1);
    let path = folder.path();
    let tetrahedron = "v 0 0 0\nv 0.3 0 0\nv 0 0.3 0\nv 0 0 0.3\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n";
    fs::write(path.join("rock.obj"), tetrahedron).expect("written");
    // With obstacles, the title of an .stl has its maximum length.
    let all = [&EVERY_MESH[..], &["--quads", "--obstacle", "rock.obj", "--skip-done"]].concat();
    succeeded(&meniscus(path, &all));
    let again = meniscus(path, &all);
    assert!(again.out.contains("done already"), "{}{}", again.out, again.err);
    fs::write(path.join("rock.obj"), tetrahedron.replace("0.3", "0.2")).expect("written");
    assert!(!meniscus(path, &all).out.contains("done already"));
    let with = |option: &'static str| [&all[..], &[option]].concat();
    for option in ["--blend=2.5d", "--up=z"] {
        let result = meniscus(path, &with(option));
        assert!(
            result.status == 0 && !result.out.contains("done already"),
            "{option}: {}{}",
            result.out,
            result.err
        );
        assert!(meniscus(path, &with(option)).out.contains("done already"), "{option}");
    }
    let names = ["dam.1.abc", "dam.1.glb", "dam.1.stl", "dam.1.usda", "dam.1.usdc", "dam.1.vtp"];
    assert_eq!(names_in(&path.join("out")), names);
    for name in names.iter().filter(|name| **name != "dam.1.glb") {
        let info: Value =
            serde_json::from_str(&meniscus(&path.join("out"), &["info", "--json", name]).out).expect("JSON");
        assert_eq!(
            info[0]["made_by"]["generator"],
            concat!("meniscus ", env!("CARGO_PKG_VERSION")),
            "{info}"
        );
        let counted =
            if *name == "dam.1.usda" { &info[0]["layer"]["faces"] } else { &info[0]["mesh"]["triangles"] };
        assert!(counted.as_u64().is_some_and(|count| count > 100), "{info}");
        if *name != "dam.1.usda" {
            assert_eq!(info[0]["mesh"]["boundary_edges"], 0, "{info}");
        }
    }
}

const SHOTS: [&str; 6] = ["--sequence", "shot.glb", "--sequence", "shot.abc", "--fps", "25"];

const CONVERT_TO_FRAMES: [&str; 8] =
    ["convert", "in", "--out", "out", "--voxel-size=0.05", "--format=glb,abc,usdc", "--up", "z"];

/// Converts frames to files in every format, and to the [sequence files](SHOTS). Returns the bytes of these.
fn convert_to_shots(path: &Path) -> [Vec<u8>; 2] {
    succeeded(&meniscus(path, &[&CONVERT_TO_FRAMES[..], &SHOTS].concat()));
    ["shot.glb", "shot.abc"].map(|name| fs::read(path.join(name)).expect("readable"))
}

#[test]
fn sequence_file_is_the_same_from_every_command() {
    let folder = frames(4);
    let path = folder.path();
    let [glb, abc] = convert_to_shots(path);
    let read = |name: &str| fs::read(path.join(name)).expect("readable");

    fs::create_dir(path.join("farm")).expect("made");
    let on_farm = CONVERT_TO_FRAMES.map(|word| if word == "out" { "farm" } else { word });
    for shard in ["3/3", "1/3", "2/3"] {
        succeeded(&meniscus(path, &[&on_farm[..], &["--shard", shard, "--threads", "1"]].concat()));
    }
    for (name, expected) in [("again.glb", &glb), ("again.abc", &abc)] {
        succeeded(&meniscus(path, &["sequence", "farm", "-o", name, "--fps", "25"]));
        assert!(read(name) == *expected, "{name}");
        succeeded(&meniscus(path, &["sequence", "farm/dam.#.glb", "-o", name, "--fps", "25"]));
        assert!(read(name) == *expected, "{name}");
    }
    // If the sequence file is in the folder of the frames, the command does not mistake it for a frame.
    for _ in 0..2 {
        succeeded(&meniscus(path, &["sequence", "farm", "-o", "farm/shot.glb", "--fps", "25"]));
        assert!(read("farm/shot.glb") == glb);
    }
    // A command that selects some frames does not warn about the others.
    for frames in ["1,4", "1-4x2"] {
        let frames = ["--frames", frames];
        succeeded(&meniscus(path, &[&CONVERT_TO_FRAMES[..], &["--sequence", "some.glb"], &frames].concat()));
    }
    // A restart with nothing to convert still writes the sequence file.
    fs::remove_file(path.join("shot.glb")).expect("removed");
    let result = meniscus(path, &[&CONVERT_TO_FRAMES[..], &SHOTS, &["--skip-done"]].concat());
    assert!(result.out.contains("done already") && read("shot.glb") == glb, "{}{}", result.out, result.err);
}

#[test]
fn sequence_file_is_the_same_from_frames_in_every_format() {
    let folder = frames(4);
    let path = folder.path();
    let [glb, abc] = convert_to_shots(path);
    let read = |name: &str| fs::read(path.join(name)).expect("readable");
    // In a .glb, each mesh has the provenance of its frame, which depends on the format of the frame; so only
    // the data are the same.
    let data = |glb: &[u8]| {
        let json_bytes = u32::from_le_bytes(glb[12..16].try_into().expect("four bytes"));
        glb[20 + json_bytes as usize..].to_vec()
    };
    for extension in ["abc", "usdc"] {
        let only = path.join(extension);
        fs::create_dir(&only).expect("made");
        for number in 1..=4 {
            let name = format!("dam.{number}.{extension}");
            fs::rename(path.join("out").join(&name), only.join(&name)).expect("renamed");
        }
        for (name, expected) in [("shot.glb", &glb), ("shot.abc", &abc)] {
            let output = format!("{extension}/{name}");
            let pattern = format!("{extension}/dam.#.{extension}");
            // A sequence file in the folder is not a frame.
            for input in [extension, &*pattern, extension] {
                succeeded(&meniscus(path, &["sequence", input, "-o", &output, "--fps", "25"]));
                let found = read(&output);
                let is_same =
                    if name == "shot.glb" { data(&found) == data(expected) } else { found == *expected };
                assert!(is_same, "{output} of {input}");
            }
        }
    }
}

#[test]
fn shot_that_lacks_frames_does_not_replace_a_whole_one() {
    let folder = frames(3);
    let path = folder.path();
    let convert = ["convert", "in", "--out", "out", "--voxel-size", "0.05", "--format", "glb"];
    succeeded(&meniscus(path, &[&convert[..], &SHOTS].concat()));
    let read = || ["shot.glb", "shot.abc"].map(|name| fs::read(path.join(name)).expect("readable"));
    let whole = read();
    fs::write(path.join("in/dam.2.ply"), "ply\nformat ascii 1.0\n").expect("written");
    let result = meniscus(path, &[&convert[..], &SHOTS].concat());
    assert_eq!(result.status, 1, "{}{}", result.out, result.err);
    assert!(
        result.err.contains("warning: shot.glb: not replaced, because only 2 of 3 frames are done"),
        "{}",
        result.err
    );
    assert!(read() == whole);
    fs::remove_file(path.join("shot.glb")).expect("removed");
    let result = meniscus(path, &[&convert[..], &SHOTS].concat());
    assert!(
        result.status == 1 && result.out.contains("shot.glb: a sequence file of 2 frames"),
        "{}{}",
        result.out,
        result.err
    );
}

#[test]
fn sequence_file_shows_each_frame_at_its_time() {
    let folder = frames(4);
    let path = folder.path();
    // At the time of a frame without particles, the surface is empty. If a frame cannot be read, the one
    // before it stays visible.
    write_ply(&path.join("in/dam.2.ply"), &[]);
    fs::write(path.join("in/dam.3.ply"), "ply\nformat ascii 1.0\n").expect("written");
    let convert = ["convert", "in", "--out", "out", "--voxel-size", "0.05", "--format", "glb"];
    let result = meniscus(path, &[&convert[..], &SHOTS].concat());
    assert_eq!(result.status, 1, "{}{}", result.out, result.err);
    assert!(result.out.contains("shot.glb: a sequence file of 3 frames"), "{}", result.out);
    assert!(result.err.contains("warning: shot.glb: 3: 1 frame is missing"), "{}", result.err);

    let shot = document(&path.join("shot.glb"));
    let names: Vec<&str> =
        shot["nodes"].as_array().expect("nodes").iter().filter_map(|node| node["name"].as_str()).collect();
    assert_eq!(names, ["dam.1", "dam.4"]);
    assert_eq!(shot["scenes"][0]["nodes"], serde_json::json!([0, 1]));
    let at_rest = |node: usize| shot["nodes"][node]["scale"][0].as_f64().expect("a number");
    assert!(at_rest(0) > 0.5 && at_rest(1) == 0.0, "{}", shot["nodes"]);
    let bytes = fs::read(path.join("shot.glb")).expect("readable");
    let data = 28 + u32::from_le_bytes(bytes[12..16].try_into().expect("four bytes")) as usize;
    let numbers = |accessor: usize, arity: usize| -> Vec<f32> {
        let accessor = &shot["accessors"][accessor];
        let view = &shot["bufferViews"][accessor["bufferView"].as_u64().expect("a view") as usize];
        let number = |value: &Value| value.as_u64().unwrap_or_default() as usize;
        let start = data + number(&view["byteOffset"]) + number(&accessor["byteOffset"]);
        let end = start + 4 * arity * number(&accessor["count"]);
        bytes[start..end].as_chunks().0.iter().map(|bytes| f32::from_le_bytes(*bytes)).collect()
    };
    let animation = &shot["animations"][0];
    for (node, times, shown) in
        [(0, &[0.0, 0.06][..], &[true, false][..]), (1, &[0.0, 0.14, 0.18], &[false, true, true])]
    {
        assert_eq!(animation["channels"][node]["target"], serde_json::json!({"node": node, "path": "scale"}));
        let sampler = &animation["samplers"][node];
        assert_eq!(sampler["interpolation"], "STEP");
        let [input, output] =
            ["input", "output"].map(|name| sampler[name].as_u64().expect("an accessor") as usize);
        assert_eq!(numbers(input, 1), times);
        let scales = numbers(output, 3);
        let found: Vec<bool> =
            scales.as_chunks::<3>().0.iter().map(|[x, y, z]| *x > 0.0 && x == y && y == z).collect();
        assert_eq!(found, shown, "{scales:?}");
    }

    // Frame 2 has no particles, so its sample is empty. Frame 3 is missing, so frame 2 has a second sample
    // just before frame 4.
    let archive = fs::read(path.join("shot.abc")).expect("readable");
    let times = abc::read_times(&archive).expect("times");
    assert_eq!(times, [1.0, 2.0, 4.0 - 1.0 / 64.0, 4.0].map(|time| time / 25.0));
    let count =
        |index| abc::read_sample(&archive, index, &Limits::default()).expect("a mesh").positions.len();
    assert!([1, 2].map(count) == [0, 0] && [0, 3].map(count).iter().all(|count| *count > 0));
}

#[test]
fn info_describes_a_sequence_file_and_convert_refuses_it() {
    let folder = frames(3);
    let path = folder.path();
    let convert = ["convert", "in", "--out", "out", "--voxel-size", "0.05", "--format", "glb"];
    succeeded(&meniscus(path, &[&convert[..], &SHOTS].concat()));
    let json = |files: &[&str]| -> Value {
        let result = meniscus(path, &[&["info", "--json"], files].concat());
        serde_json::from_str(&result.out).expect("JSON")
    };
    let meshes = json(&["out/dam.1.glb", "out/dam.2.glb", "out/dam.3.glb"]);
    let total = |name: &str| -> u64 {
        let counts = meshes.as_array().expect("a list").iter();
        counts.map(|info| info["mesh"][name].as_u64().expect("a number")).sum()
    };
    let counts = ["vertices", "triangles"].map(total);
    for name in ["shot.glb", "shot.abc"] {
        let text = meniscus(path, &["info", name]).out;
        let rows = [
            ("frames", "3".to_owned()),
            ("first frame", "1".to_owned()),
            ("last frame", "3".to_owned()),
            ("frames per second", "25".to_owned()),
            ("vertices", format!("{}, in all frames", counts[0])),
            ("triangles", format!("{}, in all frames", counts[1])),
        ];
        for (label, value) in rows {
            assert!(text.contains(&format!("\n  {label:<20} {value}\n")), "{label} {value} is not in {text}");
        }
        assert!(!text.contains("edges") && !text.contains("area"), "{text}");
        let info = &json(&[name])[0];
        assert!(info["kind"].as_str().is_some_and(|kind| kind.ends_with(", a sequence file")), "{info}");
        let expected = serde_json::json!({
            "frames": 3, "first": 1, "last": 3, "fps": 25.0, "vertices": counts[0], "triangles": counts[1],
        });
        assert_eq!(info["shot"], expected);
        assert!(info.get("mesh").is_none() && info.get("layer").is_none(), "{info}");
    }
    for number in 1..=3 {
        let mut ply = String::from("ply\nformat ascii 1.0\nelement vertex 216\n");
        ["x", "y", "z", "vx", "vy", "vz", "heat"]
            .iter()
            .for_each(|name| ply += &format!("property float {name}\n"));
        ply += "end_header\n";
        block(6, 0.0).iter().for_each(|[x, y, z]| ply += &format!("{x} {y} {z} 1 2 3 4\n"));
        fs::write(path.join(format!("in/dam.{number}.ply")), ply).expect("written");
    }
    succeeded(&meniscus(path, &[&convert[..], &SHOTS, &["--attributes", "all"]].concat()));
    for (name, attributes) in [("shot.glb", ["_HEAT", "_VELOCITY"]), ("shot.abc", ["heat", "velocity"])] {
        let text = meniscus(path, &["info", name]).out;
        let mut found: Vec<&str> =
            text.lines().filter_map(|line| line.strip_prefix("  attribute            ")).collect();
        found.sort_unstable();
        assert_eq!(found, attributes, "{text}");
        assert_eq!(json(&[name])[0]["shot"]["attributes"].as_array().map(Vec::len), Some(2), "{name}");
    }
    // A frame has the attributes of its file, too.
    let formats = ["--format", "abc,usdc", "--attributes", "all", "--stage", "stage.usda", "--fps", "30"];
    succeeded(&meniscus(path, &[&convert[..6], &formats].concat()));
    for (name, attributes) in
        [("out/dam.1.usdc", ["heat", "velocities"]), ("out/dam.1.abc", ["heat", "velocity"])]
    {
        let info = &json(&[name])[0];
        let listed = info["mesh"]["attributes"].as_array().expect("attributes");
        let mut found: Vec<&str> = listed.iter().filter_map(|attribute| attribute["name"].as_str()).collect();
        found.sort_unstable();
        assert_eq!(found, attributes, "{info}");
    }
    let text = meniscus(path, &["info", "stage.usda"]).out;
    let note = "a stage: it plays the files of 3 frames, from time code 1 to 3, at 30 frames per second";
    assert!(text.contains(note), "{text}");
    let result = meniscus(path, &[&convert[..], &["--obstacle", "shot.glb"]].concat());
    let refusal = "this file is a sequence of 3 frames";
    assert!(result.status == 2 && result.err.contains(refusal), "{}", result.err);
    fs::copy(path.join("out/dam.1.glb"), path.join("rock.glb")).expect("copied");
    succeeded(&meniscus(path, &[&convert[..], &["--obstacle", "rock.glb"]].concat()));
    // A sequence file contains no particles either; the error names it once.
    let result = meniscus(path, &["render", "shot.glb", "-o", "x.png"]);
    assert_eq!(result.err.matches("shot.glb").count(), 1, "{}", result.err);
}

#[test]
fn invalid_sequence_files_are_refused_before_conversion() {
    let folder = frames(2);
    let path = folder.path();
    let convert = |more: &[&'static str]| [&["convert", "in", "--out", "o"][..], more].concat();
    refused(path, &convert(&["--format", "ply", "--sequence", "s.glb"]), &["--sequence", "add glb"]);
    for name in ["s.usda", "s.usdc", "s.mov", "s"] {
        refused(path, &convert(&["--sequence", name]), &[name, "must end in .glb or .abc"]);
    }
    refused(path, &convert(&["--sequence", "no/s.glb"]), &["does not exist"]);
    refused(
        path,
        &convert(&["--sequence", "o/dam.1.glb"]),
        &[
            "the sequence file and the result",
            "would both become",
            "dam.1.glb: choose another name for the sequence file",
        ],
    );
    refused(path, &convert(&["--fps", "25"]), &["--fps"]);
    refused(path, &convert(&["--sequence", "s.glb", "--fps", "0"]), &["--fps"]);
    write_ply(&path.join("in/other.1.ply"), &block(3, 0.0));
    write_ply(&path.join("in/other.2.ply"), &block(3, 0.0));
    refused(path, &convert(&["--sequence", "s.glb"]), &["one sequence"]);
    assert!(!path.join("o").exists() && !path.join("s.glb").exists());
    refused(path, &["sequence", "in", "-o", "s.glb"], &["no .glb, .abc or .usdc"]);
    refused(
        path,
        &["sequence", "in/dam.1.ply", "-o", "s.glb"],
        &["in/dam.1.ply: this is not a .glb", "no frame"],
    );
    refused(
        path,
        &["sequence", "in/dam.1.ply", "in/other.1.ply", "-o", "s.glb"],
        &["2 sequences", "dam.1.ply, other.1.ply"],
    );
    refused(path, &["sequence", "in/dam.1.ply", "-o", "s.ply"], &["must end in .glb or .abc"]);
    assert!(!path.join("s.glb").exists());
}

#[test]
fn damaged_frame_is_left_out_with_a_warning() {
    let folder = frames(3);
    let path = folder.path();
    succeeded(&meniscus(
        path,
        &["convert", "in", "--out", "out", "--voxel-size", "0.05", "--format", "glb,usdc"],
    ));
    let frame = path.join("out/dam.2.glb");
    let whole = fs::read(&frame).expect("readable");
    let mut foreign = whole.clone();
    foreign[20..60].fill(b' ');
    for damaged in [&whole[..whole.len() - 4], &whole[..30], b"", &foreign] {
        fs::write(&frame, damaged).expect("written");
        for output in ["s.glb", "s.abc"] {
            let result = meniscus(path, &["sequence", "out", "-o", output]);
            assert_eq!(result.status, 1, "{}{}", result.out, result.err);
            assert!(
                result.err.contains("dam.2.glb: left out")
                    && result.out.contains("a sequence file of 2 frames"),
                "{}",
                result.err
            );
        }
    }
    // A sequence file is not a frame either.
    fs::copy(path.join("s.glb"), &frame).expect("copied");
    let frames = ["out/dam.1.glb", "out/dam.2.glb"];
    let result = meniscus(path, &[&["sequence", "-o", "t.glb"][..], &frames].concat());
    assert!(result.err.contains("already a sequence"), "{}", result.err);
    let result = meniscus(path, &["sequence", "out", "-o", "t.glb"]);
    assert!(
        result.out.contains("a sequence file of 2 frames"),
        "in a folder it is skipped: {}{}",
        result.out,
        result.err
    );
    // Frames in .usdc are checked in the same way.
    let frame = path.join("out/dam.2.usdc");
    let whole = fs::read(&frame).expect("readable");
    fs::write(&frame, &whole[..whole.len() - 4]).expect("written");
    let result = meniscus(path, &["sequence", "out/dam.#.usdc", "-o", "s.abc"]);
    assert_eq!(result.status, 1, "{}{}", result.out, result.err);
    assert!(
        result.err.contains("dam.2.usdc: left out") && result.out.contains("a sequence file of 2 frames"),
        "{}{}",
        result.out,
        result.err
    );
    refused(path, &["sequence", "s.abc", "-o", "t.abc"], &["s.abc: ", "a sequence of 2 frames"]);
}

#[test]
fn sequence_file_replaces_only_an_earlier_one() {
    let folder = frames(3);
    let path = folder.path();
    succeeded(&meniscus(path, &["convert", "in", "--out", "out", "--voxel-size", "0.05", "--format", "glb"]));
    let frame = fs::read(path.join("out/dam.2.glb")).expect("readable");
    let files = ["out/dam.1.glb", "out/dam.2.glb", "out/dam.3.glb"];
    for inputs in [&files[..], &["out"], &["out/*.glb"], &["out/dam.#.glb"], &["./out/dam.2.glb"]] {
        for output in ["out/dam.2.glb", "./out/dam.2.glb", "out/../out/dam.2.glb"] {
            let arguments = [&["sequence", "-o", output][..], inputs].concat();
            refused(path, &arguments, &["would replace the input", "dam.2.glb"]);
        }
    }
    assert!(fs::read(path.join("out/dam.2.glb")).expect("there") == frame);
    // A sequence file next to its frames may have a similar name, and the command may write it again.
    let mut made = Vec::new();
    for inputs in ["out", "out/*.glb", "out/dam.#.glb", "out"] {
        let result = meniscus(path, &["sequence", inputs, "-o", "out/dam.4.glb"]);
        succeeded(&result);
        assert!(result.out.contains("a sequence file of 3 frames"), "{inputs}: {}", result.out);
        made.push(fs::read(path.join("out/dam.4.glb")).expect("readable"));
    }
    assert!(made.iter().all(|shot| *shot == made[0]));
    // Nor does it replace a frame that is not combined, or a file of the user.
    fs::copy(path.join("out/dam.1.glb"), path.join("dam.0001.glb")).expect("copied");
    fs::write(path.join("mine.abc"), "text").expect("written");
    for output in ["dam.0001.glb", "mine.abc"] {
        let before = fs::read(path.join(output)).expect("readable");
        let convert = ["convert", "in", "--out", "again", "--voxel-size", "0.05", "--sequence", output];
        for arguments in [&["sequence", "out", "-o", output][..], &convert] {
            refused(path, arguments, &[output, "exists, and is not a sequence file of meniscus"]);
        }
        assert!(!path.join("again").exists() && fs::read(path.join(output)).expect("there") == before);
    }
    for (output, why) in [("t.glb", "already a sequence"), ("out/dam.4.glb", "this is a sequence file")] {
        refused(path, &["sequence", "out/dam.4.glb", "-o", output], &["dam.4.glb: ", why]);
    }
}

#[test]
fn sequence_files_record_frame_numbers() {
    let folder = frames(3);
    let path = folder.path();
    for (old, new) in [(3, 300), (2, 100), (1, 0)] {
        fs::rename(path.join(format!("in/dam.{old}.ply")), path.join(format!("in/dam.{new}.ply")))
            .expect("renamed");
    }
    let convert = ["convert", "in", "--out", "out", "--voxel-size", "0.05", "--format", "glb"];
    succeeded(&meniscus(path, &[&convert[..], &SHOTS].concat()));
    let shot = document(&path.join("shot.glb"));
    let recorded = &shot["asset"]["extras"]["meniscus"];
    assert_eq!((&recorded["first"], &recorded["last"]), (&"0".into(), &"300".into()));
    // At this frame rate, a frame has a hundred time codes. The fourth frame ends half a frame after its
    // time.
    let input = shot["animations"][0]["samplers"][2]["input"].as_u64().expect("an accessor") as usize;
    let last = &shot["accessors"][input]["max"][0];
    assert!((last.as_f64().expect("a number") - 4.5 / 25.0).abs() < 1e-6, "{last}");
}
