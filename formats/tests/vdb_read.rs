//! .vdb files written by other programs, and damaged files.

#![allow(clippy::cast_possible_truncation, reason = "test numbers are small")]
#![allow(clippy::print_stderr, reason = "reports missing files")]

use crate::solids;

use std::path::PathBuf;

use meniscus_formats::vdb::{Compression, WriteOptions, grids, level_set_outline, read_level_set, write};
use meniscus_formats::{Error, Limits};
use solids::Dice;

/// A folder of files that are not part of the repository.
fn shared(folder: &str) -> Vec<(String, Vec<u8>)> {
    let default = || PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/../../shared"));
    let root = std::env::var_os("MENISCUS_SHARED").map_or_else(default, PathBuf::from);
    let Ok(entries) = std::fs::read_dir(root.join("data").join(folder)) else {
        eprintln!("not tested, folder missing: data/{folder}");
        return Vec::new();
    };
    let mut files: Vec<_> = entries
        .filter_map(|entry| Some(entry.ok()?.path()))
        .filter(|path| path.extension().is_some_and(|extension| extension == "vdb"))
        .map(|path| {
            (
                path.file_name().unwrap_or_default().to_string_lossy().into_owned(),
                std::fs::read(&path).expect("a file"),
            )
        })
        .collect();
    files.sort();
    files
}

#[test]
fn files_of_other_programs_match_openvdb_rs() {
    for folder in ["ours/vdb", "third-party/openvdb-rs"] {
        for (file, bytes) in shared(folder) {
            let infos = match grids(&bytes, &Limits::default()) {
                Ok(infos) => infos,
                Err(error @ Error::Unsupported { .. }) => {
                    eprintln!("{file}: {error}");
                    continue;
                }
                Err(error) => panic!("{file}: {error}"),
            };
            let (_, others) = vdb::io::read_stream(&bytes[..]).expect(&file);
            for (index, info) in infos.iter().enumerate() {
                eprintln!(
                    "{file}: \"{}\" {} half {} {:?}",
                    info.unique_name, info.type_name, info.half, info.active_voxel_count
                );
                if info.type_name != "Tree_float_5_4_3" {
                    continue;
                }
                let Some(vdb::AnyGrid::Float(other)) =
                    others.get(index).filter(|_| others.len() == infos.len())
                else {
                    panic!("{file}: grid {index} is missing");
                };
                assert_same(&format!("{file} {}", info.name), &bytes, &info.unique_name, other);
            }
        }
    }
}

fn assert_same(name: &str, bytes: &[u8], grid: &str, other: &vdb::FloatGrid) {
    let data = match read_level_set(bytes, Some(grid), &Limits::default()) {
        Ok(data) => data,
        Err(error @ Error::Unsupported { .. }) => return eprintln!("{name}: {error}"),
        Err(error) => panic!("{name}: {error}"),
    };
    assert_eq!(data.background, *other.background(), "{name}");
    assert_eq!(data.leaves.len(), other.tree().leaf_count(), "{name}");
    for ((origin, leaf), mask) in data.origins.iter().zip(&data.leaves).zip(&data.masks) {
        for (i, value) in leaf.iter().enumerate() {
            let step = i as i32;
            let at =
                vdb::Coord::new(origin[0] + (step >> 6), origin[1] + (step >> 3 & 7), origin[2] + (step & 7));
            let active = mask[i >> 6] >> (i & 63) & 1 == 1;
            assert_eq!(other.tree().probe_value(&at), (*value, active), "{name}");
        }
    }
    for tile in &data.tiles {
        let [x, y, z] = tile.origin;
        for at in [vdb::Coord::new(x, y, z), vdb::Coord::new(x + tile.size - 1, y, z + tile.size / 2)] {
            assert_eq!(other.tree().probe_value(&at), (tile.value, tile.active), "{name}");
        }
    }
    let size = other.transform().voxel_size();
    assert!(
        data.transform
            .voxel_size()
            .iter()
            .zip([size[0], size[1], size[2]])
            .all(|(a, b)| (a - b).abs() < 1e-12)
    );
}

#[test]
fn damaged_files_are_errors_without_panics() {
    let solid = solids::sphere([40.5, 30.5, 44.0], 12.0);
    for compression in [Compression::None, Compression::ActiveMask, Compression::Blosc] {
        for half in [false, true] {
            let options = WriteOptions { compression, half, ..WriteOptions::default() };
            let mut bytes = Vec::new();
            write(&solid.view(), &options, &[], &mut bytes).expect("writing to memory");
            let mut dice = Dice(1);
            for _ in 0..400 {
                let length = dice.below(bytes.len());
                assert!(read_level_set(&bytes[..length], None, &Limits::default()).is_err());
            }
            for round in 0..3000 {
                let mut broken = bytes.clone();
                // Half of the flips are near the start of the file, where the counts are.
                let range = if round % 2 == 0 { 1200 } else { broken.len() };
                for _ in 0..1 + dice.below(3) {
                    let at = dice.below(range);
                    broken[at] ^= 1 << dice.below(8);
                }
                let _ = read_level_set(&broken, None, &Limits::default());
                let _ = level_set_outline(&broken, None, &Limits::default());
            }
        }
    }
}

#[test]
fn outline_of_a_level_set_has_its_leaves_and_the_memory_for_them() {
    let solid = solids::sphere([0.0; 3], 40.0);
    let mut bytes = Vec::new();
    write(&solid.view(), &WriteOptions::default(), &[], &mut bytes).expect("writing to memory");
    let data = read_level_set(&bytes, None, &Limits::default()).expect("a level set");
    let outline = level_set_outline(&bytes, None, &Limits::default()).expect("a level set");
    let error = |using_bytes: u64, memory_bytes: u64| {
        let limits = Limits { memory_bytes, ..Limits::default() };
        let checked = outline.check_memory(bytes.len() as u64, using_bytes, &limits);
        checked.err().map_or(String::new(), |error| error.to_string())
    };
    assert_eq!(error(0, bytes.len() as u64 + data.memory_bytes()), "");
    let reading = read_level_set(&bytes, None, &Limits { memory_bytes: 1 << 20, ..Limits::default() });
    assert_eq!(error(0, 1 << 20), reading.expect_err("too large").to_string());
    assert!(error(1 << 30, 1 << 20).contains("needs 1024 MiB of memory"), "{}", error(1 << 30, 1 << 20));
    assert_eq!((outline.origins, outline.background), (data.origins, data.background));
    assert_eq!(outline.transform, data.transform);
}

#[test]
fn limits_and_missing_grids_are_errors() {
    let solid = solids::sphere([0.0; 3], 40.0);
    let mut bytes = Vec::new();
    write(&solid.view(), &WriteOptions::default(), &[], &mut bytes).expect("writing to memory");
    let limits = Limits { memory_bytes: 1 << 16, ..Limits::default() };
    assert!(matches!(read_level_set(&bytes, None, &limits), Err(Error::MemoryLimit { .. })));
    let error = read_level_set(&bytes, Some("density"), &Limits::default()).expect_err("no such grid");
    assert!(error.to_string().contains("\"surface\" of type Tree_float_5_4_3"), "{error}");
}

#[test]
fn misplaced_root_children_are_errors_with_their_origin() {
    let mut bytes = Vec::new();
    write(&solids::sphere([0.0; 3], 40.0).view(), &WriteOptions::default(), &[], &mut bytes)
        .expect("writing to memory");
    let encoded = |origin: [i32; 3]| origin.map(i32::to_le_bytes).concat();
    let third = encoded([-4096, 0, -4096]);
    let at = bytes.windows(12).position(|window| window == third).expect("a root child");
    for (origin, expected) in [
        ([-4096, 8, -4096], "the origin of a root child is [-4096, 8, -4096]; expected multiples of 4096"),
        (
            [-8192, 0, -4096],
            "the root child at [-8192, 0, -4096] follows that at [-4096, -4096, 0]; expected",
        ),
    ] {
        bytes[at..at + 12].copy_from_slice(&encoded(origin));
        let error = read_level_set(&bytes, None, &Limits::default()).expect_err("misplaced").to_string();
        assert!(error.contains(expected), "{error}");
    }
}
