//! What others give meniscus to read, and what somebody else may have written into its own files, in its short form:
//! the bytes in `corpus`, and damage done to them.
//!
//! ```text
//!   corpus/TARGET/*                  small files of each kind, and all that was ever found
//!   ../../formats/tests/corpus/*     those that the readers' own tests have        each given to every reader
//!   damage                           cut off, bits flipped, pieces moved, numbers that are extreme
//! ```
//!
//! No target may panic, take more than ten seconds, or hold more than four bytes for each of its input's and 64 MiB;
//! what is packed counts as what the limits let out of it. `long/run` searches for bytes that break this with libFuzzer:
//! what it finds is put into `corpus`, and so becomes a test. docs/trials.md has what it has done.

mod bar;
mod damage;
mod targets;

use std::fs;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use damage::Damage;
use targets::{TARGETS, Target};

/// Inputs made from the files of each target: fewer of those that take a connection or a folder for each.
fn damaged_count(target: &Target) -> usize {
    match target.name {
        "window" | "journal" => 100,
        _ => 1000,
    }
}

/// Longer is a hang. (A machine that has other things to do may take longer than the ten seconds.)
const PATIENCE: Duration = Duration::from_secs(60);

/// Memory is counted for the whole program: one target after the other.
#[test]
fn nothing_that_is_read_breaks_anything() {
    let shared: Vec<Vec<u8>> = SHARED.iter().flat_map(|folder| files(&root().join(folder))).collect();
    for target in &TARGETS {
        let own = files(&root().join("tests/fuzz/corpus").join(target.name));
        assert!(!own.is_empty(), "no file in corpus/{}", target.name);
        own.iter().chain(&shared).for_each(|bytes| give(target, bytes));
        let mut damage = Damage::new(target.name);
        for _ in 0..damaged_count(target) {
            give(target, &damage.done_to(&own));
        }
    }
}

/// Folders with files that are given to every target.
const SHARED: [&str; 4] = [
    "formats/tests/corpus/valid",
    "formats/tests/corpus/invalid",
    "formats/tests/corpus/delimited/valid",
    "formats/tests/corpus/delimited/invalid",
];

/// A folder without a target is a name that was misspelt.
#[test]
fn every_folder_of_the_corpus_has_a_target() {
    for entry in fs::read_dir(root().join("tests/fuzz/corpus")).expect("the corpus") {
        let name = entry.expect("a folder").file_name();
        assert!(TARGETS.iter().any(|target| name == target.name), "{}", name.display());
    }
}

fn give(target: &Target, bytes: &[u8]) {
    let start = Instant::now();
    let ended = std::panic::catch_unwind(|| bar::hold(target, bytes));
    let shown = bytes[..bytes.len().min(600)].escape_ascii();
    assert!(ended.is_ok(), "{} does not survive {} bytes: {shown}", target.name, bytes.len());
    assert!(start.elapsed() < PATIENCE, "{} hangs on {} bytes: {shown}", target.name, bytes.len());
}

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).to_owned()
}

/// What is in the files of a folder, in the order of their names.
fn files(folder: &Path) -> Vec<Vec<u8>> {
    let mut paths: Vec<PathBuf> =
        fs::read_dir(folder).into_iter().flatten().map(|entry| entry.expect("a file").path()).collect();
    paths.sort();
    paths.iter().map(|path| fs::read(path).expect("its bytes")).collect()
}
