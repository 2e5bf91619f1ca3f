//! Stages that play the files of the frames: which frames they list, when they are written, and when refused.

use std::fs;
use std::path::Path;

use tempfile::{TempDir, tempdir};

use crate::program::scene::{RunResult, block, meniscus, write_ply, write_sequence};
use crate::program::steps::step;

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

fn text(path: &Path) -> String {
    fs::read_to_string(path).unwrap_or_else(|error| panic!("{}: {error}", path.display()))
}

/// The names of the files that a stage plays, in the order of their times.
fn clips(stage: &str) -> Vec<&str> {
    let list =
        stage.lines().find_map(|line| line.trim().strip_prefix("asset[] assetPaths = [")).unwrap_or("]");
    let paths = list.trim_end_matches(']').split(", ").map(|path| path.trim_matches('@'));
    paths.filter_map(|path| path.rsplit('/').next()).filter(|name| !name.is_empty()).collect()
}

const CONVERT: [&str; 5] = ["convert", "in", "--out", "out", "--voxel-size=0.05"];

const STAGE: [&str; 4] = ["--stage", "shot.usda", "--fps", "25"];

#[test]
fn stage_holds_missing_frames_until_they_are_converted() {
    let folder = frames(5);
    let path = folder.path();
    for number in [3, 4] {
        fs::write(path.join(format!("in/dam.{number}.ply")), "ply\nformat ascii 1.0\n").expect("written");
    }
    let convert = [&CONVERT[..], &STAGE, &["--format", "glb,usdc,vdb", "--up", "z", "--skip-done"]].concat();
    let result = meniscus(path, &convert);
    assert_eq!(result.status, 1, "{}{}", result.out, result.err);
    assert!(
        result
            .out
            .contains("shot.usda: a stage of 3 frames; 4 files are missing so far: dam.3.usdc, dam.3.vdb, dam.4.usdc, ..\n"),
        "{}",
        result.out
    );
    let stage = text(&path.join("shot.usda"));
    assert_eq!(clips(&stage), ["dam.1.usdc", "dam.2.usdc", "dam.5.usdc"]);
    for part in [
        "double2[] active = [(1, 0), (1.984375, 0), (2, 1), (4.984375, 1), (5, 2)]",
        "double2[] times = [(1, 0), (1.984375, 0), (2, 0), (4.984375, 0), (5, 0)]",
        "timeCodesPerSecond = 25",
        "upAxis = \"Z\"",
        "def Xform \"dam\"",
        "def Volume \"volume\"",
        "token visibility = \"invisible\"",
        "5: @./out/dam.5.vdb@",
    ] {
        assert!(stage.contains(part), "{part} is not in {stage}");
    }
    assert!(!stage.contains("velocity"), "{stage}");
    // The other frames stay in the stage when only one is converted.
    write_sequence(&path.join("in"), 3, 3);
    let result = meniscus(path, &[&convert[..], &["--frames", "3"]].concat());
    succeeded(&result);
    assert!(
        result.out.contains("a stage of 4 frames; 2 files are missing so far: dam.4.usdc, dam.4.vdb\n"),
        "{}",
        result.out
    );
    let stage = text(&path.join("shot.usda"));
    assert_eq!(clips(&stage), ["dam.1.usdc", "dam.2.usdc", "dam.3.usdc", "dam.5.usdc"]);
    // Frames that are done need no conversion for a stage.
    fs::remove_file(path.join("shot.usda")).expect("removed");
    fs::remove_file(path.join("in/dam.4.ply")).expect("removed");
    let result = meniscus(path, &convert);
    succeeded(&result);
    assert!(result.out.contains("dam.5.ply: done already"), "{}", result.out);
    assert_eq!(text(&path.join("shot.usda")), stage);
}

#[test]
fn stage_is_the_same_from_shards() {
    let folder = frames(4);
    let path = folder.path();
    let convert = |out: &str, more: &[&str]| {
        let options = ["--voxel-size=0.05", "--format=usdc,vdb", "--attributes=all"];
        let stage = format!("{out}/dam.usda");
        let arguments = ["convert", "in", "--out", out, "--stage", &stage];
        succeeded(&meniscus(path, &[&arguments[..], &options, more].concat()));
        text(&path.join(stage))
    };
    let expected = convert("out", &[]);
    fs::create_dir(path.join("farm")).expect("made");
    let counts = ["3/3", "1/3", "2/3"].map(|shard| clips(&convert("farm", &["--shard", shard])).len());
    assert!(counts[0] < counts[1] && counts[1] < counts[2] && counts[2] == 4, "{counts:?}");
    assert_eq!(text(&path.join("farm/dam.usda")), expected);
    // Any shard completes a stage, also one without frames to convert.
    fs::remove_file(path.join("farm/dam.usda")).expect("removed");
    assert_eq!(convert("farm", &["--shard", "2/3"]), expected);
    succeeded(&meniscus(path, &["verify", "farm"]));
}

#[test]
fn frame_that_usd_cannot_name_is_left_out_of_the_stage() {
    let folder = frames(2);
    let path = folder.path();
    write_ply(&path.join("in/we\u{1}t.1.ply"), &block(5, 0.0));
    let result = meniscus(path, &[&CONVERT[..], &STAGE, &["--format=usdc"]].concat());
    succeeded(&result);
    assert!(result.err.contains("we\\u{1}t.1.usdc is left out of the stage"), "{}", result.err);
    assert_eq!(clips(&text(&path.join("shot.usda"))), ["dam.1.usdc", "dam.2.usdc"]);
}

#[test]
fn text_frames_have_time_samples_only_for_a_stage() {
    let folder = frames(2);
    let path = folder.path();
    let convert = |format: &'static str, more: &[&'static str]| {
        let result = meniscus(path, &[&CONVERT[..], &["--skip-done", "--format", format], more].concat());
        succeeded(&result);
        result.out
    };
    convert("usda", &[]);
    let plain = text(&path.join("out/dam.1.usda"));
    assert!(!plain.contains("timeSamples") && !plain.contains("time_samples"));
    // These files have no samples yet: they are converted again, and only once.
    assert!(!convert("usda", &STAGE).contains("done already"));
    let sampled = text(&path.join("out/dam.1.usda"));
    let points = |text: &str, start: &str| {
        let (_, rest) = text.split_once(start).unwrap_or_else(|| panic!("no {start}"));
        rest.split(']').next().map(str::to_owned)
    };
    let sample = points(&sampled, "point3f[] points.timeSamples = {\n            0: [");
    assert_eq!(sample, points(&plain, "point3f[] points = ["));
    assert!(sampled.contains("string time_samples = \"true\""));
    assert!(convert("usda", &STAGE).contains("done already"));
    assert_eq!(clips(&text(&path.join("shot.usda"))), ["dam.1.usda", "dam.2.usda"]);
    // A stage prefers the binary files, which always have samples.
    convert("usdc", &[]);
    assert!(convert("usdc", &STAGE).contains("done already"));
    assert_eq!(clips(&text(&path.join("shot.usda"))), ["dam.1.usdc", "dam.2.usdc"]);
    convert("usda,usdc", &STAGE);
    assert!(text(&path.join("out/dam.1.usda")) == plain);
}

#[test]
fn sequences_are_prims_and_volumes_may_be_alone() {
    let folder = frames(2);
    let path = folder.path();
    for number in [1, 2] {
        write_ply(&path.join(format!("in/spray {number}.ply")), &block(3, 0.0));
    }
    succeeded(&meniscus(path, &[&CONVERT[..], &STAGE, &["--format", "vdb"]].concat()));
    let stage = text(&path.join("shot.usda"));
    for part in [
        "    def Xform \"dam\"\n    {\n        def Volume \"volume\"",
        "    def Xform \"spray\"\n    {\n        def Volume \"volume\"",
        "/spray/volume/surface>\n",
        "2: @./out/spray 2.vdb@",
    ] {
        assert!(stage.contains(part), "{part} is not in {stage}");
    }
    assert!(!stage.contains("clips") && !stage.contains("invisible"), "{stage}");
    let info = meniscus(path, &["info", "shot.usda"]);
    assert!(info.status == 0 && info.out.contains("stage_frames"), "{}{}", info.out, info.err);
}

#[test]
fn missing_files_are_named_and_a_stage_that_shrinks_is_reported() {
    let folder = frames(6);
    let path = folder.path();
    let convert = |more: &[&'static str]| {
        let result = meniscus(path, &[&CONVERT[..], &STAGE, &["--format", "usdc,vdb"], more].concat());
        succeeded(&result);
        result
    };
    let missing = "a stage of 1 frame; 10 files are missing so far: dam.1.usdc, dam.1.vdb, dam.2.usdc, ..\n";
    let result = convert(&["--frames", "6"]);
    assert!(result.out.contains(missing), "{}", result.out);
    convert(&["--skip-done"]);
    // With its mesh, the frame is in the stage, but it is not complete.
    fs::remove_file(path.join("out/dam.2.vdb")).expect("removed");
    let result = convert(&["--frames", "1", "--skip-done"]);
    assert!(
        result.out.contains("a stage of 6 frames; 1 file is missing so far: dam.2.vdb\n"),
        "{}",
        result.out
    );
    assert!(!result.err.contains("before"), "{}", result.err);
    // Also a sequence of which no frame is selected stays in the stage.
    write_ply(&path.join("in/spray.9.ply"), &block(3, 0.0));
    let result = convert(&["--frames", "9"]);
    assert!(
        result.out.contains("a stage of 7 frames; 1 file is missing so far: dam.2.vdb\n"),
        "{}",
        result.out
    );
    let one = ["convert", "in/dam.1.ply", "--out", "out", "--voxel-size=0.05", "--format", "usdc,vdb"];
    let result = meniscus(path, &[&one[..], &STAGE].concat());
    succeeded(&result);
    assert!(result.err.contains("warning: shot.usda: it had 7 frames before"), "{}", result.err);
}

#[test]
fn sequences_have_the_same_prims_from_shards() {
    let folder = tempdir().expect("a folder");
    let path = folder.path();
    fs::create_dir(path.join("in")).expect("made");
    let dump: String = [0, 100, 200].map(step).concat();
    fs::write(path.join("in/run.0002.lammpstrj"), dump).expect("written");
    for name in ["dam_0001.ply", "spray_0001_b7.ply", "spray_0002_b7.ply"] {
        write_ply(&path.join("in").join(name), &block(5, 0.0));
    }
    let options = ["--voxel-size=0.05", "--format=usdc"];
    let convert = ["convert", "in", "--out", "out", "--stage", "out/s.usda"];
    succeeded(&meniscus(path, &[&convert[..], &options].concat()));
    fs::create_dir(path.join("farm")).expect("made");
    let shard = ["convert", "in", "--out", "farm", "--stage", "farm/s.usda", "--shard", "1/1"];
    succeeded(&meniscus(path, &[&shard[..], &options].concat()));
    let stage = text(&path.join("out/s.usda"));
    assert_eq!(text(&path.join("farm/s.usda")), stage);
    for part in [
        "def Xform \"dam\" (",
        "def Xform \"spray\" (",
        "def Xform \"run_0002\" (",
        "(99.984375, 0), (100, 1), (199.984375, 1), (200, 2)]",
        "asset manifestAssetPath = @./s.usda@",
        "    over \"surface\"\n    {\n        float3[] extent\n",
    ] {
        assert!(stage.contains(part), "{part} is not in {stage}");
    }
}

#[test]
fn stages_without_anything_to_play_are_refused() {
    let folder = frames(2);
    let path = folder.path();
    let convert = |more: &[&'static str]| [&["convert", "in", "--out", "o"][..], more].concat();
    let watch = |more: &[&'static str]| [&["watch", "in", "--out", "o", "--once"][..], more].concat();
    for formats in [&[][..], &["--format", "glb"], &["--format", "obj,vdb"]] {
        let more = [&["--stage", "s.usda"][..], formats].concat();
        for arguments in [convert(&more), watch(&more)] {
            refused(path, &arguments, &["--stage", "add usdc to --format"]);
        }
    }
    let usdc = |more: &[&'static str]| [&["--format", "usdc"][..], more].concat();
    for arguments in [convert(&usdc(&["--stage", "s.usdc"])), watch(&usdc(&["--stage", "s.usdc"]))] {
        refused(path, &arguments, &["s.usdc: the name of this file must end in .usda"]);
    }
    refused(path, &convert(&usdc(&["--fps", "25"])), &["--fps", "--stage"]);
    refused(path, &watch(&usdc(&["--fps", "25"])), &["--fps is for a stage"]);
    for arguments in [convert(&usdc(&["--stage", "no/s.usda"])), watch(&usdc(&["--stage", "no/s.usda"]))] {
        refused(path, &arguments, &["the folder for the stage does not exist"]);
    }
    let one = ["convert", "in/dam.1.ply", "-o", "dam.usdc", "--stage", "s.usda"];
    refused(path, &one, &["--stage", "name a folder"]);
    let usda = ["--format", "usda", "--stage", "o/dam.1.usda"];
    refused(path, &convert(&usda), &["the stage and the result of", "would both become"]);
    let usda = ["--format", "usda", "--stage", "s.usda", "--report", "s.usda"];
    refused(path, &convert(&usda), &["the report and the stage would both become"]);
    assert!(!path.join("s.usda").exists());

    // A file of somebody else is not replaced.
    fs::write(path.join("s.usda"), "#usda 1.0\n(\n    defaultPrim = \"set\"\n)\n").expect("written");
    let result = meniscus(path, &convert(&["--format", "usdc", "--stage", "s.usda"]));
    assert_eq!(result.status, 2, "{}{}", result.out, result.err);
    assert!(result.err.contains("s.usda: exists, and is not a stage of meniscus"), "{}", result.err);
    assert!(!path.join("o/dam.2.usdc").exists() && text(&path.join("s.usda")).contains("\"set\""));
}

#[test]
fn stage_plays_the_points_beside_the_surfaces() {
    let folder = frames(3);
    let path = folder.path();
    let convert =
        [&CONVERT[..], &STAGE, &["--format", "usdc", "--spray", "1000", "--spray-keep", "1"]].concat();
    succeeded(&meniscus(path, &convert));
    let stage = text(&path.join("shot.usda"));
    for part in [
        "def Xform \"dam\" (",
        "def Xform \"dam_spray\" (",
        "asset[] assetPaths = [@./out/dam.1.spray.usdc@, @./out/dam.2.spray.usdc@, @./out/dam.3.spray.usdc@]",
        "    over \"spray\"\n    {\n        float3[] extent\n",
        "        float[] widths\n",
        "# end: 3 meshes, 0 volumes, 3 files of points",
    ] {
        assert!(stage.contains(part), "{part} is not in {stage}");
    }
    // As text, too, whose samples are written for the stage only.
    let texts =
        [&CONVERT[..], &["--format", "usda", "--spray", "1000", "--spray-keep", "1", "--stage", "text.usda"]]
            .concat();
    succeeded(&meniscus(path, &texts));
    assert!(text(&path.join("out/dam.1.spray.usda")).contains("points.timeSamples"));
    let (known, new) = (
        stage.replace(".usdc@", ".usda@").replace("./shot.usda", "./text.usda"),
        text(&path.join("text.usda")),
    );
    let prim = |stage: &str| stage.split("def Xform \"dam_spray\"").nth(1).expect("the prim").to_owned();
    assert_eq!(prim(&known), prim(&new));
}
