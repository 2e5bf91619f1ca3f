//! Files of real programs, which are too many and too large for this repository. If they are next to the
//! repository, every file with points must be converted, or refused with the reason listed here.

use std::io::Write;
use std::path::{Path, PathBuf};

use meniscus_formats::looks_like_particles;
use tempfile::tempdir;

use crate::program::scene::{meniscus, names_in};

/// The folder of the files. If it is missing, prints a message that the test is skipped.
pub(crate) fn data() -> Option<PathBuf> {
    let default_folder = || Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared");
    let data = std::env::var_os("MENISCUS_SHARED").map_or_else(default_folder, PathBuf::from).join("data");
    if !data.is_dir() {
        let _ = writeln!(std::io::stderr(), "not tested, absent: {}", data.display());
        return None;
    }
    Some(data)
}

fn files_below(folder: &Path, files: &mut Vec<PathBuf>) {
    for entry in std::fs::read_dir(folder).expect("readable") {
        let path = entry.expect("an entry").path();
        if path.is_dir() { files_below(&path, files) } else { files.push(path) }
    }
}

/// Files of points; of each sequence only the first and the last file, because the others are similar.
fn files(data: &Path) -> Vec<PathBuf> {
    let mut files = Vec::new();
    for folder in ["ours", "third-party"] {
        files_below(&data.join(folder), &mut files);
    }
    let is_wanted = |path: &PathBuf| {
        let name = path.file_name().expect("a name").to_string_lossy();
        let is_in_sequence = path.components().any(|part| part.as_os_str() == "sequences");
        let is_end = ["_1.", "_61.", "_000000.", "_000031."].iter().any(|end| name.contains(end));
        let bytes = std::fs::read(path).expect("readable");
        (is_end || !is_in_sequence) && looks_like_particles(&bytes, &name)
    };
    files.retain(is_wanted);
    files.sort();
    files
}

/// Converts one file; returns the error, if any.
fn converted(path: &Path) -> Result<(), String> {
    let folder = tempdir().expect("a folder");
    let typed = path.to_string_lossy();
    let convert = |more: &[&str]| {
        meniscus(folder.path(), &[&["convert", &typed, "--out=out", "--format=glb,vdb"], more].concat())
    };
    let mut result = convert(&[]);
    // A single point, or none, has no spacing, which is not a fault of the file.
    if result.err.contains("cannot measure the particle spacing, because") {
        result = convert(&["--spacing=0.1"]);
    }
    if result.status != 0 {
        return Err(result.err);
    }
    let names = names_in(&folder.path().join("out"));
    match names.len() {
        2 if !result.err.contains("certificate") => Ok(()),
        _ => Err(format!("{names:?} {}", result.err)),
    }
}

#[test]
fn every_file_of_points_is_converted_or_refused_with_the_listed_reason() {
    let Some(data) = data() else { return };
    let files = files(&data);
    let mut faults = Vec::new();
    let (mut converted_count, mut refused_count) = (0, 0);
    for path in &files {
        let shown = path.strip_prefix(&data).expect("below").to_string_lossy().replace('\\', "/");
        let refusal = REFUSED.iter().find(|(part, _)| shown.contains(part)).map(|(_, words)| words);
        match (converted(path), refusal) {
            (Ok(()), None) => converted_count += 1,
            (Err(error), Some(words)) if error.contains(words) => refused_count += 1,
            (Ok(()), Some(words)) => faults.push(format!("{shown} was converted, not refused for `{words}`")),
            (Err(error), _) => faults.push(format!("{shown}: {error}")),
        }
    }
    assert!(faults.is_empty(), "{}", faults.join("\n"));
    assert!(
        converted_count >= 50 && refused_count == REFUSED_COUNT,
        "{converted_count} converted, {refused_count} refused"
    );
}

/// Level sets of other programs are contoured; grids of other kinds are refused.
#[test]
fn level_sets_are_contoured() {
    let Some(data) = data() else { return };
    let mut files = Vec::new();
    for folder in ["ours/vdb", "third-party/openvdb-rs"] {
        files_below(&data.join(folder), &mut files);
    }
    files.retain(|path| path.extension().is_some_and(|extension| extension == "vdb"));
    let mut faults = Vec::new();
    for path in &files {
        let folder = tempdir().expect("a folder");
        let typed = path.to_string_lossy();
        let result = meniscus(folder.path(), &["convert", &typed, "--out=out", "--format=obj"]);
        let name = path.file_name().expect("a name").to_string_lossy();
        let refusal = REFUSED_VOLUMES.iter().find(|(part, _)| name.contains(part)).map(|(_, words)| words);
        match (result.status, refusal) {
            (0, None) => {}
            (2, Some(words)) if result.err.contains(words) => {}
            _ => faults.push(format!("{name}: {} {}{}", result.status, result.out, result.err)),
        }
    }
    assert!(faults.is_empty() && files.len() >= 10, "{}", faults.join("\n"));
}

/// Volumes that must be refused: parts of names, and words of the reason.
const REFUSED_VOLUMES: &[(&str, &str)] =
    &[("fog_tiles", "fog volume"), ("stream", "background 0"), ("types_", "is not \"level set\"")];

/// Files that must be refused: parts of paths, and words of the reason.
const REFUSED: &[(&str, &str)] = &[
    ("laika/packed_points_simple_16_5", "packed primitives (PackedGeometry): its 2 points are their pivots"),
    ("laika/psoup_simple_16", "surfaces or curves (PolySoup): its 8 points belong to them"),
    ("sidefxlabs/curve_sweep", "surfaces or curves (Poly): its 453 points belong to them"),
    ("sidefxlabs/delete_small_parts", "surfaces or curves (Poly): its 464 points belong to them"),
];

/// Number of files that match the list above.
const REFUSED_COUNT: usize = 4;
