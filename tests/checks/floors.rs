//! Checks the floors of the formats: `core` imports nothing above it, and a family of formats only `core`.

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};

/// The floor that knows no format, and the one that knows all.
const GROUND: &str = "core";
const TOP: &str = "table";

/// The most files and folders at the top.
const ENTRIES_MAX: usize = 14;

fn sources(folder: &Path) -> Vec<PathBuf> {
    let entries = fs::read_dir(folder).expect("a folder").map(|entry| entry.expect("an entry").path());
    entries.flat_map(|path| if path.is_dir() { sources(&path) } else { vec![path] }).collect()
}

/// The parts of the crate that a source names, without those of its tests and comments.
fn imported(source: &str) -> BTreeSet<&str> {
    let product = source.split("#[cfg(test)]\nmod tests {").next().unwrap_or_default();
    let lines = product.lines().filter(|line| !line.trim_start().starts_with("//"));
    let after = lines.flat_map(|line| line.split("crate::").skip(1));
    after
        .map(|rest| {
            rest.split(|letter: char| !letter.is_alphanumeric() && letter != '_').next().unwrap_or("")
        })
        .collect()
}

#[test]
fn families_of_formats_know_only_the_ground_floor() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("formats/src");
    let entries = fs::read_dir(&root).expect("a folder").map(|entry| entry.expect("an entry").path());
    let entries: Vec<PathBuf> = entries.collect();
    assert!(entries.len() <= ENTRIES_MAX, "{} entries", entries.len());
    let (mut checked, mut wrong) = (0, Vec::new());
    for family in entries.iter().filter(|path| path.is_dir()) {
        let name = family.file_name().and_then(|name| name.to_str()).expect("a name");
        let is_test = |path: &PathBuf| path.file_name().is_some_and(|file| file == "tests.rs");
        for path in sources(family).into_iter().filter(|path| name != TOP && !is_test(path)) {
            let source = fs::read_to_string(&path).expect("a source");
            let above = imported(&source).into_iter().filter(|part| ![name, GROUND].contains(part));
            wrong.extend(above.map(|part| format!("{}: {part}", path.display())));
            checked += 1;
        }
    }
    assert!(checked > 80, "{checked} files");
    assert!(wrong.is_empty(), "imports of other floors: {wrong:#?}");
}
