//! Different code paths give the same bytes for a frame: with any SIMD instructions, as a whole or in tiles,
//! and from a file that is read as a whole or in batches.

use std::fs;
use std::path::Path;

use tempfile::tempdir;

use crate::program::scene::{RunResult, block, command, meniscus, names_in, write_ply};

/// The arguments that convert `rod.ply`.
fn typed(out: &str) -> [&str; 8] {
    ["convert", "rod.ply", "--out", out, "--voxel-size", "0.05", "--format", "glb,vdb"]
}

fn convert(folder: &Path, out: &str, arguments: &[&str]) -> RunResult {
    meniscus(folder, &[&typed(out)[..], arguments].concat())
}

/// Converts with the SIMD instructions of this name, and returns the output.
fn converted_by(folder: &Path, out: &str, level: &str) -> String {
    let mut command = command(folder, &typed(out));
    let output = command.env("MENISCUS_SIMD", level).output().expect("the command starts");
    let err = String::from_utf8(output.stderr).expect("text");
    assert!(output.status.success(), "{level}: {err}");
    err
}

/// Converts, and asserts success.
fn converted(folder: &Path, out: &str, arguments: &[&str]) {
    let result = convert(folder, out, arguments);
    assert_eq!((result.status, &*result.err), (0, ""), "{arguments:?}: {}", result.out);
}

/// A rod of 2 × 2 × `length` particles: longer than a tile, and thin.
fn write_rod(folder: &Path, length: usize) {
    let corners = [[0.0, 0.0], [0.1, 0.0], [0.0, 0.1], [0.1, 0.1]];
    let slice = |index: usize| corners.map(|[x, y]| [x, y, index as f64 * 0.1]);
    write_ply(&folder.join("rod.ply"), &(0..length).flat_map(slice).collect::<Vec<_>>());
}

/// Asserts that two folders contain the same files, to the last byte.
fn assert_same(folder: &Path, outs: [&str; 2]) {
    for out in outs {
        assert_eq!(names_in(&folder.join(out)), ["rod.glb", "rod.vdb"], "{out}");
    }
    for name in ["rod.glb", "rod.vdb"] {
        let [one, other] = outs.map(|out| fs::read(folder.join(out).join(name)).expect("readable"));
        assert!(one == other, "{name} differs between {outs:?}");
    }
}

/// The number of mebibytes that a frame needs at least, according to the message.
fn mebibytes_needed(result: &RunResult) -> u64 {
    let after =
        result.err.split("the frame needs at least ").nth(1).unwrap_or_else(|| panic!("{}", result.err));
    after.split(' ').next().and_then(|number| number.parse().ok()).expect("a number")
}

/// A block of displaced particles, with holes, to `rod.ply`: its surface is rough in all directions.
fn write_rubble(folder: &Path) {
    let random =
        |seed: usize| (seed as u32).wrapping_mul(0x9e37_79b9).rotate_left(9).wrapping_mul(0x85eb_ca6b);
    let particle = |index: usize| {
        let places = [index / 100, index / 10 % 10, index % 10];
        [0, 1, 2].map(|axis| {
            let moved = f64::from(random(3 * index + axis) >> 8) / f64::from(1 << 24) - 0.5;
            0.1 * (places[axis] as f64 + 0.6 * moved)
        })
    };
    let kept = (0..1000).filter(|&index| random(index + 5000) >> 30 != 0);
    write_ply(&folder.join("rod.ply"), &kept.map(particle).collect::<Vec<_>>());
}

#[test]
fn all_instruction_sets_give_the_same_bytes() {
    let folder = tempdir().expect("a folder");
    write_rubble(folder.path());
    for level in ["baseline", "avx2", "avx512"] {
        let err = converted_by(folder.path(), level, level);
        // If the processor lacks the instructions, a message says so.
        assert!(err.is_empty() || err.contains("not supported by this processor"), "{level}: {err}");
        assert_same(folder.path(), ["baseline", level]);
    }
}

#[test]
fn unknown_instruction_set_is_ignored_with_a_warning() {
    let folder = tempdir().expect("a folder");
    write_rod(folder.path(), 20);
    converted(folder.path(), "plain", &[]);
    let err = converted_by(folder.path(), "odd", "xyz");
    assert_eq!(err, "warning: MENISCUS_SIMD=xyz is ignored: expected baseline, avx2 or avx512\n");
    assert_same(folder.path(), ["plain", "odd"]);
}

#[test]
fn smallest_stated_memory_gives_the_same_bytes() {
    let folder = tempdir().expect("a folder");
    let path = folder.path();
    write_rod(path, 600);
    converted(path, "whole", &[]);
    let refused = convert(path, "tiled", &["--memory", "1MiB"]);
    assert_eq!(refused.status, 2, "{}", refused.out);
    assert!(refused.err.contains("rod.ply: the frame needs at least "), "{}", refused.err);
    assert!(refused.err.contains("--memory") && !refused.err.contains("implicit"), "{}", refused.err);
    assert_eq!(names_in(&path.join("tiled")), [""; 0]);

    let least = mebibytes_needed(&refused);
    let short = convert(path, "tiled", &["--memory", &format!("{}MiB", least - 1)]);
    assert_eq!((short.status, mebibytes_needed(&short)), (2, least), "{}", short.err);
    // A frame within this limit must be in tiles: as a whole, it would take more than half of the memory that
    // the implicit integrator takes.
    let coupled = convert(path, "tiled", &["--memory", "1MiB", "--integrator", "implicit"]);
    assert_eq!(coupled.status, 2, "{}", coupled.out);
    assert!(coupled.err.contains("implicit and adaptive cannot work in tiles"), "{}", coupled.err);
    assert!(2 * least < mebibytes_needed(&coupled), "{least} MiB; {}", coupled.err);

    let tiled = convert(path, "tiled", &["--memory", &format!("{least}MiB")]);
    assert_eq!(tiled.status, 0, "{}", tiled.err);
    assert!(tiled.err.contains("rod.ply: processed in tiles"), "{}", tiled.err);
    assert_same(path, ["whole", "tiled"]);
}

/// Files of at least this size are read in batches if all their records have the same length.
const STREAMED_FROM_BYTES: u64 = 16 << 20;

/// Writes particles as binary PLY. With `has_list`, each particle also has an empty list. Records with lists
/// may differ in length, so such a file is read as a whole.
fn write_binary_ply(path: &Path, particles: &[[f64; 3]], has_list: bool) {
    let list = if has_list { "property list uchar int extra\n" } else { "" };
    let mut bytes = format!(
        "ply\nformat binary_little_endian 1.0\nelement vertex {}\n\
         property float x\nproperty float y\nproperty float z\n{list}end_header\n",
        particles.len()
    )
    .into_bytes();
    for position in particles {
        bytes.extend(position.iter().flat_map(|&along| (along as f32).to_le_bytes()));
        bytes.extend(has_list.then_some(0));
    }
    fs::write(path, bytes).expect("the frame is written");
}

/// The surface in an .obj, without the comments, which contain the provenance.
fn surface_in(obj: &Path) -> Vec<String> {
    let text = fs::read_to_string(obj).expect("readable");
    text.lines().filter(|line| !line.starts_with('#')).map(str::to_owned).collect()
}

#[test]
#[ignore = "slow: `.ci/full slow` runs it"]
fn file_read_in_batches_gives_the_same_bytes() {
    let folder = tempdir().expect("a folder");
    let path = folder.path();
    // The file has many particles, but the surface has few voxels.
    let particles: Vec<_> = block(113, 0.0).into_iter().map(|at| at.map(|along| along * 0.1)).collect();
    let files = [("batches.ply", false), ("whole.ply", true)];
    files.iter().for_each(|&(name, has_list)| write_binary_ply(&path.join(name), &particles, has_list));
    let file_bytes = path.join("batches.ply").metadata().expect("there").len();
    assert!(file_bytes >= STREAMED_FROM_BYTES, "{file_bytes} bytes are read whole");
    let smoothing = ["--position-smoothing", "0.9"];
    let mut surfaces = Vec::new();
    for more in [&[][..], &smoothing, &["--blend", "5h"], &["--preset", "paper"]] {
        for (name, has_list) in files {
            let arguments = ["convert", name, "--out", "o", "--voxel-size", "0.1", "--format", "obj"];
            let result = meniscus(path, &[&arguments[..], more].concat());
            assert_eq!(
                (result.status, result.err.contains("the list `extra`")),
                (0, has_list),
                "{}",
                result.err
            );
        }
        let [batches, whole] =
            ["batches.obj", "whole.obj"].map(|name| surface_in(&path.join("o").join(name)));
        assert!(batches.len() > 100, "{batches:?}");
        assert!(batches == whole, "the surfaces differ with {more:?}");
        assert!(!surfaces.contains(&batches), "{more:?} changes nothing");
        surfaces.push(batches);
    }
}
