//! Small frames of particles, and a way to run the command.

use std::fmt::Write;
use std::fs;
use std::path::Path;
use std::process::{Command, Output, Stdio};

use meniscus::pipeline::STATE_FOLDER;

/// A block of `edge_count`³ particles, 0.1 apart, moved along x.
pub(crate) fn block(edge_count: usize, shift: f64) -> Vec<[f64; 3]> {
    let along = |index: usize| index as f64 * 0.1;
    (0..edge_count.pow(3))
        .map(|i| {
            let [x, y, z] = [i % edge_count, i / edge_count % edge_count, i / edge_count.pow(2)].map(along);
            [x + shift, y, z]
        })
        .collect()
}

/// 1000 particles at random places, on average 0.1 apart, as irregular as those of FLIP: in a cube of edge 1.
/// Another seed gives other places.
pub(crate) fn irregular(seed: u64) -> Vec<[f64; 3]> {
    let mut state = seed;
    let mut next = || {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 11) as f64 / (1u64 << 53) as f64
    };
    (0..1000).map(|_| [next(), next(), next()]).collect()
}

/// Writes particles as ascii PLY.
pub(crate) fn write_ply(path: &Path, particles: &[[f64; 3]]) {
    let mut text = format!(
        "ply\nformat ascii 1.0\nelement vertex {}\nproperty float x\nproperty float y\nproperty float z\nend_header\n",
        particles.len()
    );
    for [x, y, z] in particles {
        writeln!(text, "{} {} {}", *x as f32, *y as f32, *z as f32).expect("strings take everything");
    }
    fs::write(path, text).expect("the frame is written");
}

/// The frame of this number as PLY: a moving block of particles, shaken differently in each frame, with these
/// attributes beside the positions: `id`, or components of the velocity.
pub(crate) fn shaken_frame(number: usize, attributes: &str) -> String {
    const EDGE_COUNT: usize = 5;
    let mut text = format!(
        "ply\nformat ascii 1.0\nelement vertex {}\nproperty float x\nproperty float y\nproperty float z\n",
        EDGE_COUNT.pow(3)
    );
    for name in attributes.split_whitespace() {
        let kind = if name == "id" { "int" } else { "float" };
        writeln!(text, "property {kind} {name}").expect("strings take everything");
    }
    text += "end_header\n";
    for (id, at) in block(EDGE_COUNT, 0.03 * number as f64).into_iter().enumerate() {
        let shake = |axis: usize| 0.02 * ((7 * id + 31 * axis + 13 * number) as f64).sin();
        let [x, y, z] = [0, 1, 2].map(|axis| at[axis] + shake(axis));
        write!(text, "{x} {y} {z}").expect("strings take everything");
        for name in attributes.split_whitespace() {
            let value = match name {
                "id" => id.to_string(),
                "vx" => "0.75".to_owned(),
                _ => "0".to_owned(),
            };
            write!(text, " {value}").expect("strings take everything");
        }
        text.push('\n');
    }
    text
}

/// Writes frames `first..=last` of a moving block as `dam.N.ply`.
pub(crate) fn write_sequence(folder: &Path, first: usize, last: usize) {
    for number in first..=last {
        write_ply(&folder.join(format!("dam.{number}.ply")), &block(6, 0.025 * number as f64));
    }
}

/// The result of a run of the command.
pub(crate) struct RunResult {
    /// The exit status.
    pub(crate) status: i32,
    /// The standard output.
    pub(crate) out: String,
    /// The standard error.
    pub(crate) err: String,
}

/// Runs the command in `folder`.
pub(crate) fn meniscus(folder: &Path, arguments: &[&str]) -> RunResult {
    let output: Output =
        command(folder, arguments).stdin(Stdio::null()).output().expect("the command starts");
    RunResult {
        status: output.status.code().expect("the command ends without a signal"),
        out: String::from_utf8(output.stdout).expect("text"),
        err: String::from_utf8(output.stderr).expect("text"),
    }
}

/// The command, not yet started.
pub(crate) fn command(folder: &Path, arguments: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_meniscus"));
    command.args(arguments).current_dir(folder);
    command
}

/// The names in a folder, sorted, without the folder of records.
pub(crate) fn names_in(folder: &Path) -> Vec<String> {
    let entries = fs::read_dir(folder).expect("the folder exists");
    let mut names: Vec<String> =
        entries.map(|entry| entry.expect("an entry").file_name().to_string_lossy().into_owned()).collect();
    names.retain(|name| name != STATE_FOLDER);
    names.sort();
    names
}

/// Asserts that a command does nothing, exits with status 2, and gives this reason.
pub(crate) fn assert_refused(folder: &Path, arguments: &[&str], words: &[&str]) {
    let result = meniscus(folder, arguments);
    assert_eq!(result.status, 2, "{arguments:?}: {} {}", result.out, result.err);
    for word in words {
        assert!(result.err.contains(word), "{arguments:?} does not say {word}: {}", result.err);
    }
}
