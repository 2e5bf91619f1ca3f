//! A truncated file is distinguished from an invalid one, because it may be the beginning of a valid file.
//!
//! While a simulation writes a frame, the file is incomplete for some time. So every valid file is truncated
//! at many lengths. The reader must read the remaining part, or report that it is short. Text is an
//! exception: the beginning of a number is a number, and the beginning of a table is a table.

use crate::fixtures;

use std::io::Write;
use std::path::Path;

use meniscus_formats::compression::decompressed_so_far;
use meniscus_formats::steps::{find_steps, step_of_compressed};
use meniscus_formats::{
    Completeness, Error, Format, Limits, ProbedKind, bgeo, completeness, csv, ply, read_particles,
};

/// Number of lengths at which each file is truncated; short files are truncated everywhere.
const CUT_COUNT: usize = 3000;

/// The valid files of the corpus whose names have this ending.
fn valid_files(ending: &str) -> Vec<(String, Vec<u8>)> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/corpus/valid");
    let mut files = Vec::new();
    for entry in std::fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        let name = path.file_name().unwrap().to_string_lossy().into_owned();
        if name.ends_with(ending) {
            files.push((name, std::fs::read(path).unwrap()));
        }
    }
    assert!(!files.is_empty(), "no file of the corpus ends in {ending}");
    files
}

/// The lengths at which a file is truncated, from the whole file down to zero.
fn cuts(length: usize) -> impl Iterator<Item = usize> {
    let step = length.div_ceil(CUT_COUNT).max(1);
    // Every length near the start, where headers are.
    (0..length).filter(move |cut| cut % step == 0 || *cut < 1000)
}

fn read(bytes: &[u8], name: &str) -> Result<usize, Error> {
    read_particles(bytes, name, &Limits::default()).map(|frame| frame.positions.len())
}

/// Checks that every truncated file is reported as short or gives all particles, and that the format's own
/// check never reports it as complete.
fn check_all_cuts(name: &str, bytes: &[u8]) {
    let count = read(bytes, name).unwrap_or_else(|error| panic!("{name}: {error}"));
    for cut in cuts(bytes.len()) {
        let start = &bytes[..cut];
        match read(start, name) {
            Ok(found) => assert_eq!(found, count, "{name}, cut at {cut} of {}", bytes.len()),
            Err(error) if error.is_truncated() => {}
            // A layer may have nothing but metadata.
            Err(error)
                if start.starts_with(b"#usda") && error.to_string().contains("no prims of the type") => {}
            Err(error) => panic!("{name}, cut at {cut} of {}: {error}", bytes.len()),
        }
        let found = completeness(&mut std::io::Cursor::new(start), name).unwrap();
        assert_ne!(found, Completeness::Complete, "{name}, cut at {cut} of {}", bytes.len());
    }
}

pub(crate) fn gzipped(bytes: &[u8]) -> Vec<u8> {
    let mut encoder = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::default());
    encoder.write_all(bytes).unwrap();
    encoder.finish().unwrap()
}

fn zstd_packed(bytes: &[u8]) -> Vec<u8> {
    ruzstd::encoding::compress_to_vec(bytes, ruzstd::encoding::CompressionLevel::Fastest)
}

#[test]
fn truncated_ply_files_are_short() {
    for (name, bytes) in valid_files(".ply") {
        check_all_cuts(&name, &bytes);
        check_all_cuts(&name, &gzipped(&bytes));
        check_all_cuts(&name, &zstd_packed(&bytes));
    }
}

#[test]
fn truncated_bgeo_files_are_short() {
    for (name, bytes) in valid_files(".bgeo") {
        check_all_cuts(&name, &bytes); // gzipped by the program that wrote it
    }
    let (_, source) = valid_files("taichi_000007.ply").remove(0);
    let frame = ply::read(&source, &Limits::default()).unwrap();
    let mut bytes = Vec::new();
    bgeo::write(&frame, &mut bytes).unwrap();
    check_all_cuts("written.bgeo", &bytes);
    let complete = completeness(&mut std::io::Cursor::new(&bytes), "written.bgeo").unwrap();
    assert_eq!(complete, Completeness::Complete);
}

#[test]
fn truncated_multi_member_archives_are_short() {
    let (name, bytes) = valid_files("open3d.ply").remove(0);
    let (first, second) = bytes.split_at(bytes.len() / 2);
    check_all_cuts(&name, &[gzipped(first), gzipped(second)].concat());
    check_all_cuts(&name, &[zstd_packed(first), zstd_packed(second)].concat());
}

/// The last number of a text may lack digits, so only binary files are truncated.
#[test]
fn truncated_vtk_files_are_short() {
    for ending in ["bin.vtk", "meshio.vtk", ".vtp", ".vtu"] {
        for (name, bytes) in valid_files(ending) {
            check_all_cuts(&name, &bytes);
        }
    }
}

#[test]
fn truncated_files_of_other_formats_are_short() {
    for (name, bytes) in fixtures::all() {
        check_all_cuts(&name, &bytes);
        check_all_cuts(&name, &gzipped(&bytes));
    }
}

/// The beginning of a table is read as a table or reported as short, never as invalid.
#[test]
fn truncated_tables_are_never_invalid() {
    let text = "x,y,z,\"a b\",n\n1.5,-2e-3,3,0.25,7\n-1,.5,nan,1e5,8\n0.125,1,2,3,9\n";
    for separated in [text.to_string(), text.replace(',', ";"), text.replace(',', "\t")] {
        // Before the end of the header line, nothing shows that the table has a header.
        for cut in separated.find('\n').unwrap()..separated.len() {
            match csv::read(&separated.as_bytes()[..cut], &Limits::default()) {
                Ok(_) => {}
                Err(error) => assert!(error.is_truncated(), "{:?}: {error}", &separated[..cut]),
            }
        }
    }
}

/// Files of other programs are reported as complete if their format allows such a check.
#[test]
fn valid_files_are_complete() {
    for (name, bytes) in valid_files("") {
        let found = completeness(&mut std::io::Cursor::new(&bytes), &name).unwrap();
        // Files in these formats could always have more rows.
        let is_table = name.ends_with(".csv") || name.ends_with(".vtk");
        let expected = if is_table { found == Completeness::Unknown } else { found != Completeness::Unknown };
        assert!(expected && !matches!(found, Completeness::Incomplete { .. }), "{name}: {found:?}");
    }
}

/// Damage must not be reported as short: the daemon would retry the file forever.
#[test]
fn invalid_files_are_not_short() {
    let header = "element vertex 2\nproperty float x\nproperty float y\nproperty float z\nend_header\n";
    let ascii = |body: &str| format!("ply\nformat ascii 1.0\n{header}{body}");
    let table = [
        ("a line too short", ascii("0.5 0.5\n1 1 1\n")),
        ("a line too long", ascii("0 0 0 0\n1 1 1\n")),
        ("a word", ascii("0 0 zero\n1 1 1\n")),
        ("a word at the end, ended", ascii("0 0 0\n1 1 one\n")),
        ("no position", "ply\nformat ascii 1.0\nelement vertex 1\nproperty float q\nend_header\n1\n".into()),
        ("an unknown type", "ply\nformat ascii 1.0\nelement vertex 1\nproperty half x\n".into()),
        ("a count beyond all files", ascii("").replace("vertex 2", "vertex 9999999999999999999")),
        ("a table with text", "x,y,z\n1,2,three\n4,5,6\n".into()),
        ("a ragged table", "x,y,z\n1,2\n4,5,6\n".into()),
    ];
    for (case, text) in table {
        let error = read(text.as_bytes(), "a.ply").expect_err(case);
        assert!(!error.is_truncated(), "{case}: {error}");
    }
    let mut damaged = gzipped(ascii("0 0 0\n1 1 1\n").as_bytes());
    let checksum = damaged.len() - 7;
    damaged[checksum] ^= 1;
    assert!(!read(&damaged, "a.ply.gz").expect_err("damaged").is_truncated());
}

/// A writer that is stopped leaves a compressed file without its end. Its whole steps are read, as those of text are.
#[test]
fn compressed_steps_without_an_end_are_read_with_a_note() {
    let kind = ProbedKind::Format(Format::LammpsDump);
    let limits = Limits::default();
    let text = [fixtures::DUMP, &fixtures::DUMP.replace("1000", "2000")].concat();
    let mut encoder = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::default());
    encoder.write_all(text.as_bytes()).unwrap();
    encoder.flush().unwrap();
    let open = encoder.get_ref().clone();
    let whole = encoder.finish().unwrap();
    for (bytes, is_open) in [(&open, true), (&whole, false)] {
        let (content, note) = decompressed_so_far(bytes, &limits).unwrap();
        assert_eq!((&*content, note.is_some()), (text.as_bytes(), is_open));
        let steps = find_steps(kind, &*content, &limits).unwrap();
        for (step, is_last) in steps.iter().zip([false, true]) {
            let bytes = step_of_compressed(kind, bytes, step, &limits).unwrap().unwrap();
            let frame = meniscus_formats::particles_of(bytes, "a.dump.gz", &[], &limits).unwrap();
            let has_note = frame.notes.iter().any(|note| note.contains("compressed data ends too early"));
            assert_eq!((frame.positions.len(), has_note), (2, is_open && is_last));
        }
    }
    // A step that is not whole fails, and the others do not.
    let mut encoder = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::default());
    // The last number is cut.
    encoder.write_all(&text.as_bytes()[..text.trim_ascii_end().len() - 1]).unwrap();
    encoder.flush().unwrap();
    let torn = &**encoder.get_ref();
    let (content, _) = decompressed_so_far(torn, &limits).unwrap();
    let steps = find_steps(kind, &*content, &limits).unwrap();
    let mut outcomes = steps.iter().map(|step| {
        let bytes = step_of_compressed(kind, torn, step, &limits).unwrap().unwrap();
        meniscus_formats::particles_of(bytes, "a", &[], &limits).map(|frame| frame.notes.len())
    });
    assert_eq!(outcomes.next().unwrap().unwrap(), 0);
    assert!(outcomes.next().unwrap().is_err_and(|error| error.is_truncated()));
    // A file of one step.
    let packed = zstd_packed(fixtures::DUMP.as_bytes());
    for (bytes, is_open) in [(gzipped(fixtures::DUMP.as_bytes()), true), (packed, false)] {
        assert!(read_particles(&bytes, "a", &limits).unwrap().notes.is_empty());
        let cut = read_particles(&bytes[..bytes.len() - 4], "a", &limits);
        assert_eq!(cut.is_ok_and(|frame| frame.notes.len() == 1), is_open);
    }
    // A table of one frame is not whole.
    let table = gzipped(b"x,y,z\n1,2,3\n4,5,6\n");
    assert!(read_particles(&table[..table.len() - 8], "a.csv", &limits).unwrap_err().is_truncated());
}
