//! Reads files written by other programs, and checks that invalid files are rejected with a reason.
//!
//! To add a case, add a file to `corpus/` and a line to the table next to it.

use std::fmt::Write;
use std::path::{Path, PathBuf};

use meniscus_formats::{FilePositions, Limits, ParticleFrame, Values, probe, read_particles};

fn corpus() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/corpus")
}

/// The lines of a table, split at `|`.
fn table(name: &str) -> Vec<Vec<String>> {
    let text = std::fs::read_to_string(corpus().join(name)).unwrap();
    let fields = |line: &str| line.split('|').map(|field| field.trim().to_string()).collect();
    text.lines().filter(|line| !line.trim().is_empty()).map(fields).collect()
}

/// Checks that every file in a folder of the corpus has a line in the table, and vice versa.
fn check_complete(folder: &str, table: &[Vec<String>]) {
    let mut files: Vec<String> = std::fs::read_dir(corpus().join(folder))
        .unwrap()
        .map(|entry| entry.unwrap().file_name().into_string().unwrap())
        .collect();
    let mut listed: Vec<String> = table.iter().map(|line| line[0].clone()).collect();
    files.sort();
    listed.sort();
    assert_eq!(files, listed, "files and lines of corpus/{folder}");
}

#[test]
fn valid_files_match_their_table() {
    let table = table("valid.txt");
    check_complete("valid", &table);
    for line in &table {
        let [name, kind, count, bits, first, last, attributes] = &line[..] else {
            panic!("seven fields in {line:?}");
        };
        let bytes = std::fs::read(corpus().join("valid").join(name)).unwrap();
        assert_eq!(probe(&bytes, name).to_string(), *kind, "of {name}");
        let frame =
            read_particles(&bytes, name, &Limits::default()).unwrap_or_else(|e| panic!("{name}: {e}"));
        assert_eq!(frame.positions.len().to_string(), *count, "of {name}");
        check_position(&frame, 0, first, bits, name);
        check_position(&frame, frame.positions.len() - 1, last, bits, name);
        assert_eq!(described(&frame), *attributes, "of {name}");
    }
}

fn check_position(frame: &ParticleFrame, index: usize, expected: &str, bits: &str, name: &str) {
    let expected: Vec<f64> = expected.split(' ').map(|number| number.parse().unwrap()).collect();
    match &frame.positions {
        FilePositions::F32(positions) => {
            assert_eq!(bits, "32", "of {name}");
            #[expect(clippy::cast_possible_truncation, reason = "written from 32 bits")]
            // The table has nine digits, which identify a 32-bit number uniquely.
            let expected: Vec<f32> = expected.iter().map(|&x| x as f32).collect();
            assert_eq!(positions[index][..], expected, "of {name}");
        }
        FilePositions::F64(positions) => {
            assert_eq!(bits, "64", "of {name}");
            for (found, expected) in positions[index].iter().zip(&expected) {
                assert!((found - expected).abs() < 1e-9, "{name}: {found} is not {expected}");
            }
        }
    }
}

/// `name:arity:type:role` of each attribute; also checks the lengths.
fn described(frame: &ParticleFrame) -> String {
    let mut text = String::new();
    for attribute in &frame.attributes {
        let (values, length) = match &attribute.values {
            Values::F32(values) => ("f32", values.len()),
            Values::F64(values) => ("f64", values.len()),
            Values::U8(values) => ("u8", values.len()),
            Values::I32(values) => ("i32", values.len()),
            Values::I64(values) => ("i64", values.len()),
            Values::Strings { indices, .. } => ("strings", indices.len()),
        };
        assert_eq!(length, attribute.arity * frame.positions.len(), "values of {}", attribute.name);
        let role = attribute.role.map_or("-".into(), |role| format!("{role:?}"));
        write!(text, " {}:{}:{values}:{role}", attribute.name, attribute.arity).unwrap();
    }
    text.trim_start().into()
}

#[test]
fn invalid_files_are_errors_with_a_reason() {
    let table = table("invalid.txt");
    check_complete("invalid", &table);
    let mut faults = String::new();
    for line in &table {
        let [name, words] = &line[..] else { panic!("two fields in {line:?}") };
        let bytes = std::fs::read(corpus().join("invalid").join(name)).unwrap();
        match read_particles(&bytes, name, &Limits::default()).map_err(|error| error.to_string()) {
            Ok(_) => writeln!(faults, "{name} was read").unwrap(),
            Err(error) if error.contains(words) => {}
            Err(error) => writeln!(faults, "{name}: expected `{words}` in: {error}").unwrap(),
        }
    }
    assert!(faults.is_empty(), "{faults}");
}

/// Sequences are too large for this repository; they are read if they are found next to it.
#[test]
fn shared_sequences_are_read() {
    let default_folder = || Path::new(env!("CARGO_MANIFEST_DIR")).join("../../shared");
    let shared = std::env::var_os("MENISCUS_SHARED").map_or_else(default_folder, PathBuf::from);
    let sequences = [("splash_ply", 32, 12_000..=12_000, 4), ("dam_break_bgeo", 61, 1..=4_732, 3)];
    for (name, frames, counts, arity_sum) in sequences {
        let folder = shared.join("data/ours/sequences").join(name);
        let Ok(entries) = std::fs::read_dir(&folder) else {
            use std::io::Write;
            let _ = writeln!(std::io::stderr(), "not tested, absent: {}", folder.display());
            continue;
        };
        let mut frame_count = 0;
        for entry in entries {
            let path = entry.unwrap().path();
            let name = path.file_name().unwrap().to_string_lossy().into_owned();
            let bytes = std::fs::read(&path).unwrap();
            let frame =
                read_particles(&bytes, &name, &Limits::default()).unwrap_or_else(|e| panic!("{name}: {e}"));
            assert!(counts.contains(&frame.positions.len()), "{name}: {}", frame.positions.len());
            assert!(frame.attributes.iter().map(|a| a.arity).sum::<usize>() >= arity_sum, "{name}");
            let FilePositions::F32(positions) = &frame.positions else { panic!("{name}: not 32 bits") };
            assert!(positions.iter().flatten().all(|x| x.abs() < 10.0), "{name}: beyond the scene");
            frame_count += 1;
        }
        assert_eq!(frame_count, frames, "of {name}");
    }
}
