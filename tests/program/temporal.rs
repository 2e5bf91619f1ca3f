//! Surfaces that are averaged over time: the same bytes however the frames are divided, and records that know the
//! frames around.

use std::fs;
use std::path::Path;

use tempfile::tempdir;

use crate::program::scene::{RunResult, assert_refused, meniscus, names_in, shaken_frame};

fn write_frame(folder: &Path, number: usize, attributes: &str) {
    fs::write(folder.join(format!("dam.{number}.ply")), shaken_frame(number, attributes)).expect("written");
}

fn prepared(attributes: &str) -> tempfile::TempDir {
    let folder = tempdir().expect("a folder");
    for name in ["in", "out"] {
        fs::create_dir(folder.path().join(name)).expect("made");
    }
    for number in 1..=6 {
        write_frame(&folder.path().join("in"), number, attributes);
    }
    folder
}

const OPTIONS: [&str; 4] = ["--format", "obj,vdb", "--spacing", "0.1"];

fn convert(folder: &Path, out: &str, more: &[&str]) -> RunResult {
    convert_with(folder, out, &[&["--temporal", "2"][..], more].concat())
}

fn convert_with(folder: &Path, out: &str, more: &[&str]) -> RunResult {
    let result = meniscus(folder, &[&["convert", "in", "--out", out][..], &OPTIONS, more].concat());
    assert_eq!(result.status, 0, "{}{}", result.out, result.err);
    result
}

fn contents(folder: &Path) -> Vec<(String, Vec<u8>)> {
    let names = names_in(folder).into_iter();
    names.map(|name| (name.clone(), fs::read(folder.join(&name)).expect("readable"))).collect()
}

#[test]
fn averages_are_the_same_bytes_however_the_frames_are_divided() {
    let folder = prepared("id");
    let folder = folder.path();
    convert(folder, "one", &["--threads", "1"]);
    let one = contents(&folder.join("one"));
    convert(folder, "four", &["--threads", "4"]);
    assert!(contents(&folder.join("four")) == one);
    for shard in ["2/3", "1/3", "3/3"] {
        convert(folder, "out", &["--shard", shard]);
    }
    assert!(contents(&folder.join("out")) == one);
    convert(folder, "some", &["--frames", "3"]);
    for (name, bytes) in contents(&folder.join("some")) {
        assert!(one.contains(&(name, bytes)));
    }
    // The option changes the surface, and the report tells by how much.
    convert_with(folder, "without", &["--report", "without.json"]);
    assert!(contents(&folder.join("without")).iter().zip(&one).all(|(without, with)| without.1 != with.1));
    convert(folder, "reported", &["--report", "with.json"]);
    let report = |name: &str| -> serde_json::Value {
        serde_json::from_slice(&fs::read(folder.join(name)).expect("a report")).expect("JSON")
    };
    assert!(report("without.json")["frames"][2]["temporal"].is_null());
    let temporal = &report("with.json")["frames"][2]["temporal"];
    assert_eq!(temporal["frames"], 4, "{temporal}");
    assert!(temporal["confidence"].as_f64().is_some_and(|share| share > 0.9), "{temporal}");
}

#[test]
fn changed_frames_concern_those_around_them() {
    let folder = prepared("id");
    let folder = folder.path();
    convert(folder, "out", &[]);
    let verify = || meniscus(folder, &["verify", "out", "--input", "in"]);
    assert_eq!(verify().status, 0, "{}", verify().err);
    // Frame 1 changes, so frames 1 to 3 are averaged with something else.
    fs::copy(folder.join("in/dam.6.ply"), folder.join("in/dam.1.ply")).expect("copied");
    let found = verify();
    assert!(found.out.contains("3 done, 3 stale"), "{}{}", found.out, found.err);
    assert!(found.err.contains("dam.3: stale: the frames before or after it have changed"), "{}", found.err);
    let again = convert(folder, "out", &["--skip-done"]);
    assert_eq!(again.out.matches("done already").count(), 3, "{}", again.out);
    convert(folder, "fresh", &[]);
    assert!(contents(&folder.join("out")) == contents(&folder.join("fresh")));
    // Also without the inputs, as far as they are where they were.
    fs::copy(folder.join("in/dam.5.ply"), folder.join("in/dam.1.ply")).expect("copied");
    let alone = meniscus(folder, &["verify", "out"]);
    assert!(alone.err.contains("dam.3: stale: dam.1.ply, on which it depends, has changed"), "{}", alone.err);
    // The frames of other inputs are not compared with those around them.
    fs::create_dir(folder.join("jet")).expect("made");
    for number in 1..=3 {
        fs::copy(folder.join(format!("in/dam.{number}.ply")), folder.join(format!("jet/jet.{number}.ply")))
            .expect("copied");
    }
    let jet = [&["convert", "jet", "--out", "out", "--temporal", "2"][..], &OPTIONS].concat();
    assert_eq!(meniscus(folder, &jet).status, 0);
    let of_jet = meniscus(folder, &["verify", "out", "--input", "jet"]);
    assert!(of_jet.out.contains("3 stale") && !of_jet.err.contains("jet"), "{}{}", of_jet.out, of_jet.err);
    for name in names_in(&folder.join("out")).into_iter().filter(|name| name.starts_with("jet")) {
        fs::remove_file(folder.join("out").join(name)).expect("removed");
    }
    fs::remove_dir_all(folder.join("jet")).expect("removed");
    // A frame that is gone is not missed.
    fs::remove_file(folder.join("in/dam.1.ply")).expect("removed");
    convert(folder, "out", &["--skip-done"]);
    let found = verify();
    assert!(found.out.contains("6 done"), "{}{}", found.out, found.err);
    // A frame that is gone leaves a gap, and one that cannot be read a warning.
    fs::remove_file(folder.join("in/dam.4.ply")).expect("removed");
    fs::write(folder.join("in/dam.6.ply"), "ply\nformat nonsense 1.0\n").expect("written");
    let broken =
        meniscus(folder, &[&["convert", "in", "--out", "broken", "--temporal", "2"][..], &OPTIONS].concat());
    assert_eq!(broken.status, 1);
    assert!(
        broken.err.contains("one of the frames around it, on which the surface depends, is left out"),
        "{}",
        broken.err
    );
    let names = names_in(&folder.join("broken"));
    assert_eq!(names.iter().filter(|name| name.ends_with(".obj")).count(), 3, "{names:?}");
}

/// `verify` and `convert --skip-done` judge alike, whichever line of the records is lost: that of the settings, too.
#[test]
fn losing_a_line_of_the_records_costs_time_only() {
    let folder = prepared("id");
    let folder = folder.path();
    for options in [&["--temporal", "1"][..], &["--spray", "4"], &["--rest", "1"]] {
        let out = options[0].trim_start_matches('-');
        convert_with(folder, out, options);
        let names = names_in(&folder.join(out).join(".meniscus")).into_iter();
        let name = names.filter(|name| name.starts_with("frames-")).find(|name| !name.contains('.'));
        let path = folder.join(out).join(".meniscus").join(name.expect("records"));
        let text = fs::read_to_string(&path).expect("text");
        let lines: Vec<&str> = text.lines().collect();
        assert_eq!(lines.len(), 7, "{text}");
        for lost in 0..lines.len() {
            let mut kept = lines.clone();
            let line = kept.remove(lost);
            fs::write(&path, kept.join("\n") + "\n").expect("written");
            let verify = || meniscus(folder, &["verify", out, "--input", "in"]);
            let done_count = if line.contains("\"settings\":{\"id\"") { 6 } else { 5 };
            let found = verify();
            assert!(found.out.contains(&format!("{done_count} done")), "{line}: {}{}", found.out, found.err);
            let again = convert_with(folder, out, &[options, &["--skip-done"]].concat());
            assert_eq!(again.out.matches("done already").count(), done_count, "{line}: {}", again.out);
            assert_eq!(verify().status, 0, "{line}: {}", verify().err);
        }
    }
}

/// The memory that a frame needs with those around it suffices for all ways to compute them.
#[test]
fn frames_that_need_more_memory_fail_with_a_sufficient_amount() {
    let folder = prepared("id");
    let folder = folder.path();
    let small = ["--voxel-size", "0.02", "--threads", "1"];
    let with_memory = |input: &str, out: &str, memory: u64, more: &[&str]| {
        let memory = format!("{memory}MiB");
        let arguments = ["convert", input, "--out", out, "--memory", &memory];
        meniscus(folder, &[&arguments[..], &OPTIONS, &small, more].concat())
    };
    let needed = |result: &RunResult| -> u64 {
        let amounts = result.err.split("needs at least ").skip(1);
        let amounts = amounts.filter_map(|after| after.split(' ').next()?.parse().ok());
        amounts.max().unwrap_or_else(|| panic!("no amount: {}", result.err))
    };
    let averaged = ["--temporal", "2"];
    // Shards require the folder.
    fs::create_dir(folder.join("shards")).expect("made");
    let refused = with_memory("in", "out", 1, &averaged);
    assert!(refused.err.contains("--temporal, which keeps 6 frames in memory"), "{}", refused.err);
    let amount = needed(&refused);
    assert_ne!(with_memory("in", "out", amount - 1, &averaged).status, 0);
    for (out, memory, more) in [("plenty", 2000, ""), ("little", amount, ""), ("shards", amount, "--shard")] {
        for shard in if more.is_empty() { &[""][..] } else { &["2/2", "1/2"] } {
            let more: Vec<&str> = [more, shard].into_iter().filter(|part| !part.is_empty()).collect();
            let result = with_memory("in", out, memory, &[&averaged[..], &more].concat());
            assert_eq!(result.status, 0, "{}", result.err);
            assert!(!result.err.contains("not averaged"), "{}", result.err);
        }
    }
    let plenty = contents(&folder.join("plenty"));
    assert!(contents(&folder.join("little")) == plenty);
    assert!(contents(&folder.join("shards")) == plenty);
    // A frame without others needs no more than without the option, and may be computed in tiles.
    fs::create_dir(folder.join("single")).expect("made");
    fs::copy(folder.join("in/dam.1.ply"), folder.join("single/dam.1.ply")).expect("copied");
    let amount = needed(&with_memory("single", "alone", 1, &[]));
    for (out, more) in [("alone", &[][..]), ("averaged", &averaged)] {
        let result = with_memory("single", out, amount, more);
        assert_eq!(result.status, 0, "{}", result.err);
    }
    let surface = |out: &str| fs::read_to_string(folder.join(out).join("dam.1.obj")).expect("a mesh");
    let geometry =
        |text: String| text.lines().filter(|line| !line.starts_with('#')).collect::<Vec<_>>().join("\n");
    assert_eq!(geometry(surface("alone")), geometry(surface("averaged")));
}

/// Frames are averaged with those at the most frequent distance, and only frames with numbers are.
#[test]
fn irregular_numbers_are_noted() {
    let folder = prepared("id");
    let folder = folder.path();
    let regular = convert(folder, "out", &[]);
    assert!(!regular.out.contains("with fewer others"), "{}", regular.out);
    write_frame(&folder.join("in"), 60, "id");
    let irregular = convert(folder, "out", &[]);
    let note = "--temporal averages 3 frames with fewer others";
    assert!(irregular.out.contains(note), "{}{}", irregular.out, irregular.err);
    fs::create_dir(folder.join("times")).expect("made");
    for number in 1..=3 {
        let time = folder.join(format!("times/dam_0.0{number}.ply"));
        fs::copy(folder.join(format!("in/dam.{number}.ply")), time).expect("copied");
    }
    let times = [&["convert", "times", "--out", "averaged", "--temporal", "2"][..], &OPTIONS].concat();
    let times = meniscus(folder, &times);
    assert!(times.err.contains("its name has no frame number"), "{}", times.err);
}

/// Some programs write ids as floats.
#[test]
fn ids_may_be_floats() {
    let folder = prepared("id");
    let folder = folder.path();
    convert(folder, "integers", &[]);
    for name in names_in(&folder.join("in")) {
        let path = folder.join("in").join(name);
        let text = fs::read_to_string(&path).expect("readable");
        let floats = text.replace("property int id", "property double id");
        assert_ne!(text, floats);
        fs::write(&path, floats).expect("written");
    }
    convert(folder, "floats", &[]);
    let meshes = |out: &str| -> Vec<_> {
        contents(&folder.join(out)).into_iter().filter(|(name, _)| name.ends_with(".obj")).collect()
    };
    let without_comments = |meshes: Vec<(String, Vec<u8>)>| -> Vec<String> {
        let lines = |bytes: Vec<u8>| -> String {
            let text = String::from_utf8(bytes).expect("text");
            text.lines().filter(|line| !line.starts_with('#')).collect()
        };
        meshes.into_iter().map(|(_, bytes)| lines(bytes)).collect()
    };
    assert!(without_comments(meshes("integers")) == without_comments(meshes("floats")));
}

#[test]
fn particles_are_followed_by_velocities_or_the_frame_stays_as_it_is() {
    let folder = prepared("vx vy vz");
    let folder = folder.path();
    let not_followed = convert(folder, "out", &[]);
    for words in ["the surface is not averaged with the frames around it", "--time-step"] {
        assert!(not_followed.err.contains(words), "{}", not_followed.err);
    }
    let followed = convert(folder, "followed", &["--time-step", "0.04", "--report", "report.json"]);
    assert!(!followed.err.contains("not averaged"), "{}", followed.err);
    let wrong = convert(folder, "wrong", &["--time-step", "5"]);
    assert!(wrong.err.contains("hardly averaged with the frames around it"), "{}", wrong.err);
    let report = fs::read_to_string(folder.join("report.json")).expect("a report");
    let report: serde_json::Value = serde_json::from_str(&report).expect("JSON");
    let confidence = report["frames"][2]["temporal"]["confidence"].as_f64();
    assert!(confidence.is_some_and(|share| share > 0.9), "{confidence:?}");
}

#[test]
fn option_is_refused_where_there_is_only_one_frame() {
    let folder = prepared("id");
    let folder = folder.path();
    let why = "this is a single frame";
    assert_refused(folder, &["tune", "in/dam.1.ply", "-o", "tune.png", "--temporal", "1"], &[why]);
    assert_refused(folder, &["render", "in/dam.1.ply", "-o", "dam.png", "--temporal", "1"], &[why]);
    assert_refused(folder, &["convert", "in", "--out", "out", "--temporal", "4"], &["from 0 to 3"]);
    let alone = convert(folder, "one", &["--skip-done"]);
    assert!(!alone.err.contains("no effect"), "{}", alone.err);
    fs::create_dir(folder.join("single")).expect("made");
    fs::copy(folder.join("in/dam.1.ply"), folder.join("single/dam.1.ply")).expect("copied");
    let alone = meniscus(
        folder,
        &[&["convert", "single", "--out", "alone", "--temporal", "1"][..], &OPTIONS].concat(),
    );
    assert!(alone.err.contains("--temporal has no effect"), "{}", alone.err);
    let idle = meniscus(folder, &["convert", "in", "--out", "out", "--time-step", "0.1"]);
    assert!(idle.err.contains("--time-step") && idle.err.contains("--temporal"), "{}", idle.err);
}
