//! The short form of fuzzing: files from other programs, and the program's own files after edits or damage.
//! The inputs are the bytes in `corpus`, and damaged copies of them.
//!
//! ```text
//!   corpus/TARGET/*                  small files of each kind, and all inputs that ever caused a fault
//!   ../../formats/tests/corpus/*     files of the readers' own tests, each given to every reader
//!   damage                           truncation, flipped bits, moved pieces, extreme numbers
//! ```
//!
//! No target may panic, take more than ten seconds, or use more than 64 MiB of memory plus four bytes per
//! byte of input. Compressed data counts with the unpacked size that the limits allow. `long/run` searches
//! with libFuzzer for inputs that violate this requirement. Such inputs are added to `corpus`, and so become
//! tests. docs/stress-tests.md lists the runs so far.

mod bar;
mod damage;
mod targets;

use std::fs;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use damage::Damage;
use targets::{TARGETS, Target};

/// Number of damaged inputs for a target: fewer for targets that need a connection or a folder per input.
fn damaged_count(target: &Target) -> usize {
    match target.name {
        "http" | "records" => 100,
        _ => 1000,
    }
}

/// A longer run counts as a hang. (On a busy machine, a run may take longer than ten seconds.)
const TIMEOUT: Duration = Duration::from_secs(60);

/// Memory is measured for the whole process, so one target runs after the other.
#[test]
fn damaged_inputs_break_no_target() {
    let shared: Vec<Vec<u8>> = SHARED.iter().flat_map(|folder| files(&root().join(folder))).collect();
    for target in TARGETS {
        let own = files(&root().join("tests/fuzz/corpus").join(target.name));
        assert!(!own.is_empty(), "no file in corpus/{}", target.name);
        own.iter().chain(&shared).for_each(|bytes| give(target, bytes));
        let mut damage = Damage::new(target.name);
        for _ in 0..damaged_count(target) {
            give(target, &damage.done_to(&own));
        }
    }
}

/// Folders whose files are inputs of every target.
const SHARED: [&str; 4] = [
    "formats/tests/corpus/valid",
    "formats/tests/corpus/invalid",
    "formats/tests/corpus/delimited/valid",
    "formats/tests/corpus/delimited/invalid",
];

/// Every folder in `corpus` must have the name of a target: otherwise its name is misspelt.
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
    assert!(start.elapsed() < TIMEOUT, "{} hangs on {} bytes: {shown}", target.name, bytes.len());
}

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).to_owned()
}

/// The contents of the files in a folder, sorted by name.
fn files(folder: &Path) -> Vec<Vec<u8>> {
    let mut paths: Vec<PathBuf> =
        fs::read_dir(folder).into_iter().flatten().map(|entry| entry.expect("a file").path()).collect();
    paths.sort();
    paths.iter().map(|path| fs::read(path).expect("its bytes")).collect()
}
