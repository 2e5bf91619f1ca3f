//! Attributes that are computed: rest coordinates, which depend on earlier frames, speeds, vorticities and curvatures.

use std::fmt::Write as _;
use std::fs;
use std::path::Path;

use meniscus_formats::{Limits, ParticleFrame, Values, read_particles};
use tempfile::{TempDir, tempdir};

use crate::program::scene::{RunResult, meniscus, names_in};

/// The distance of neighbouring particles.
const SPACING: f64 = 0.1;

/// A block of 8 × 8 × 8 particles, which moves by `STEP` in each frame and stretches along x.
fn position(id: i64, number: i64) -> [f64; 3] {
    let [x, y, z] = [id % 8, id / 8 % 8, id / 64].map(|step| SPACING * step as f64);
    [x * stretch(number), y + STEP * number as f64, z]
}

fn stretch(number: i64) -> f64 {
    1.0 + 0.02 * number as f64
}

const STEP: f64 = 0.3;

/// Writes frames 1 to 8. Those of the particles with the highest ids appear in frame 5.
fn moving(folder: &Path) {
    fs::create_dir(folder.join("in")).expect("made");
    for number in 1..=8 {
        let ids = 0..if number < 5 { 384 } else { 512 };
        let mut text = format!(
            "ply\nformat ascii 1.0\nelement vertex {}\nproperty float x\nproperty float y\nproperty float z\nproperty int id\n\
             property float vx\nproperty float vy\nproperty float vz\nend_header\n",
            ids.end
        );
        for id in ids {
            let [x, y, z] = position(id, number);
            // A rotation around z by one radian a second.
            writeln!(text, "{x} {y} {z} {id} {} {x} 0", -y).expect("text");
        }
        fs::write(folder.join(format!("in/block.{number}.ply")), text).expect("written");
    }
}

fn scene() -> TempDir {
    let folder = tempdir().expect("a folder");
    moving(folder.path());
    folder
}

fn convert(folder: &Path, out: &str, more: &[&str]) -> RunResult {
    let fixed = ["convert", "in", "--out", out, "--format", "ply", "--spacing", "0.1"];
    let result = meniscus(folder, &[&fixed[..], more].concat());
    assert_eq!(result.status, 0, "{}{}", result.out, result.err);
    result
}

/// The vertices of a mesh, as particles.
pub(super) fn vertices(folder: &Path, number: i64) -> ParticleFrame {
    let path = folder.join(format!("block.{number}.ply"));
    let bytes = fs::read(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
    // The reader refuses meshes; without faces it is a cloud of points.
    let text = String::from_utf8_lossy(&bytes[..bytes.len().min(4096)]).into_owned();
    let faces = text.lines().find(|line| line.starts_with("element face")).expect("faces");
    let none = format!("element face {:0width$}", 0, width = faces.len() - "element face ".len());
    let at = text.find(faces).expect("found");
    let bytes = [&bytes[..at], none.as_bytes(), &bytes[at + faces.len()..]].concat();
    read_particles(&bytes, "vertices.ply", &Limits::default()).unwrap_or_else(|error| panic!("{error}"))
}

pub(super) fn numbers(frame: &ParticleFrame, name: &str) -> Vec<f64> {
    let attribute = frame.attributes.iter().find(|attribute| attribute.name == name);
    match &attribute.unwrap_or_else(|| panic!("{name}")).values {
        Values::F32(values) => values.iter().map(|&value| value.into()).collect(),
        values => panic!("{name}: {values:?}"),
    }
}

/// The largest error of rest coordinates of frame `number` whose reference is `reference`, in spacings.
fn error_of(frame: &ParticleFrame, name: &str, number: i64, reference: i64) -> f64 {
    let positions = match &frame.positions {
        meniscus_formats::FilePositions::F32(positions) => positions.clone(),
        meniscus_formats::FilePositions::F64(_) => panic!("64 bits"),
    };
    let found = numbers(frame, name);
    let error = |(index, [x, y, z]): (usize, &[f32; 3])| {
        let back = stretch(reference) / stretch(number);
        let expected =
            [f64::from(*x) * back, f64::from(*y) - STEP * (number - reference) as f64, f64::from(*z)];
        let found = &found[3 * index..];
        (0..3).map(|axis| (found[axis] - expected[axis]).powi(2)).sum::<f64>().sqrt() / SPACING
    };
    positions.iter().enumerate().map(error).fold(0.0, f64::max)
}

#[test]
fn rest_coordinates_of_moving_fluid_are_those_of_the_reference() {
    let folder = scene();
    let folder = folder.path();
    convert(folder, "out", &["--rest", "2"]);
    let of = |number: i64| vertices(&folder.join("out"), number);
    // Frames up to the reference are their own.
    for number in [1, 2] {
        assert!(error_of(&of(number), "rest", number, number) < 1e-3, "{number}");
    }
    for number in [3, 4] {
        let error = error_of(&of(number), "rest", number, 2);
        assert!(error < 0.1, "{number}: {error}");
    }
    // Particles that appeared later keep the place at which they did: the top of the block.
    let last = of(8);
    let rest = numbers(&last, "rest");
    let meniscus_formats::FilePositions::F32(positions) = &last.positions else { panic!("64 bits") };
    let (mut low, mut high) = (0, 0);
    for (index, [_, y, z]) in positions.iter().enumerate() {
        let way = f64::from(*y) - rest[3 * index + 1];
        if *z < 0.3 {
            assert!((way - 6.0 * STEP).abs() < 1e-3, "{way} at {z}");
            low += 1;
        } else if *z > 0.73 {
            assert!((way - 3.0 * STEP).abs() < 0.6 * STEP, "{way} at {z}");
            high += 1;
        }
    }
    assert!(low > 100 && high > 100);
}

#[test]
fn two_sets_begin_again_half_a_period_apart() {
    let folder = scene();
    let folder = folder.path();
    convert(folder, "out", &["--rest", "1", "--rest-period", "4", "--frames", "1-4"]);
    for (number, rest, rest2, ratio) in [(1, 1, 1, 1.0), (2, 1, 1, 0.5), (3, 1, 3, 0.0), (4, 1, 3, 0.5)] {
        let frame = vertices(&folder.join("out"), number);
        assert!(error_of(&frame, "rest", number, rest) < 0.15, "{number}");
        assert!(error_of(&frame, "rest2", number, rest2) < 0.15, "{number}");
        assert!(numbers(&frame, "rest_ratio").iter().all(|found| *found == ratio), "{number}");
    }
}

#[test]
fn frames_depend_on_those_before_and_shards_equal_one_process() {
    let folder = scene();
    let folder = folder.path();
    let options = ["--rest", "1", "--rest-period", "6", "--attributes", "id"];
    convert(folder, "whole", &options);
    fs::create_dir(folder.join("shards")).expect("made");
    for shard in ["2/3", "3/3", "1/3"] {
        convert(folder, "shards", &[&options[..], &["--shard", shard]].concat());
    }
    let meshes = |out: &str| -> Vec<Vec<u8>> {
        let names = names_in(&folder.join(out)).into_iter().filter(|name| name.ends_with(".ply"));
        names.map(|name| fs::read(folder.join(out).join(name)).expect("readable")).collect()
    };
    assert!(meshes("whole").len() == 8 && meshes("whole") == meshes("shards"));
    let verified = meniscus(folder, &["verify", "whole", "--input", "in"]);
    assert_eq!(verified.status, 0, "{}{}", verified.out, verified.err);
    // A change of frame 3 changes it and those after it until the reference frames are later ones, and no others.
    let path = folder.join("in/block.3.ply");
    let text = fs::read_to_string(&path).expect("text");
    fs::write(&path, text.replacen("0 0.9", "0 0.91", 1)).expect("written");
    for inputs in [&["verify", "whole"][..], &["verify", "whole", "--input", "in"]] {
        let stale = meniscus(folder, inputs);
        assert!(stale.out.contains("4 done, 4 stale"), "{}{}", stale.out, stale.err);
    }
    let again = convert(folder, "whole", &[&options[..], &["--skip-done"]].concat());
    assert!(
        again.out.contains("block.2.ply: done already") && !again.out.contains("block.3.ply: done already"),
        "{}{}",
        again.out,
        again.err
    );
    convert(folder, "anew", &options);
    assert!(meshes("whole") == meshes("anew"));
}

#[test]
fn speeds_vorticities_and_curvatures_are_computed() {
    let folder = scene();
    let folder = folder.path();
    let names = "speed,vorticity,normal_curvature";
    let result = convert(folder, "out", &["--attributes", names, "--velocity-scale", "2", "--frames", "1"]);
    assert!(!result.err.contains("warning"), "{}", result.err);
    let frame = vertices(&folder.join("out"), 1);
    let meniscus_formats::FilePositions::F32(positions) = &frame.positions else { panic!("64 bits") };
    for (speed, [x, y, _]) in numbers(&frame, "speed").iter().zip(positions) {
        let expected = 2.0 * f64::from(*x).hypot(f64::from(*y));
        assert!((speed - expected).abs() < 0.25, "{speed} of {expected}");
    }
    assert!(numbers(&frame, "vorticity").iter().all(|found| (found - 4.0).abs() < 0.02));
    // Flat sides, and edges with a radius of about half a spacing to one.
    let curvatures = numbers(&frame, "normal_curvature");
    let flat = curvatures.iter().filter(|curvature| curvature.abs() < 1.0).count();
    let round = curvatures.iter().filter(|curvature| **curvature > 3.0).count();
    assert!(
        flat > curvatures.len() / 5 && round > curvatures.len() / 20,
        "{flat} {round} of {}",
        curvatures.len()
    );
}

#[test]
fn what_the_particles_lack_is_said() {
    let folder = tempdir().expect("a folder");
    let folder = folder.path();
    fs::create_dir(folder.join("in")).expect("made");
    let text: String =
        (0..512).map(|id| position(id, 1).map(|along| along.to_string()).join(",") + "\n").collect();
    fs::write(folder.join("in/a.7.csv"), format!("x,y,z\n{text}")).expect("written");
    let result = convert(folder, "out", &["--attributes", "speed"]);
    let what = "`speed` is not computed: the particles have no velocities";
    assert!(result.err.contains(what), "{}", result.err);
    let refused = meniscus(folder, &["convert", "in", "--out", "out", "--rest", "7"]);
    assert!(
        refused.status != 0 && refused.err.contains("no attribute `id`, which --rest needs"),
        "{}",
        refused.err
    );
    let odd = meniscus(folder, &["convert", "in", "--out", "out", "--rest", "7", "--rest-period", "5"]);
    assert!(odd.status != 0 && odd.err.contains("rest_period is 5; it must be even"), "{}", odd.err);
    let with_ids: String = (0..512)
        .map(|id| position(id, 1).map(|along| along.to_string()).join(",") + &format!(",{id}\n"))
        .collect();
    fs::write(folder.join("in/a.7.csv"), format!("x,y,z,id\n{with_ids}")).expect("written");
    let late = convert(folder, "out", &["--rest", "8"]);
    assert!(late.err.contains("--rest 8 has no effect: all frames have lower numbers"), "{}", late.err);
    let missing = convert(folder, "out", &["--rest", "3"]);
    assert!(missing.err.contains("frame 3, which --rest names, is missing"), "{}", missing.err);
}
