//! PRT files: channels, metadata, and what is wrong with others.

use std::io::Cursor;

use meniscus_formats::{
    AttributeRole, Completeness, FilePositions, Limits, ParticleFrame, Result, Values, completeness,
    read_particles,
};

use crate::fixtures::{self, TEN_TYPES, channels, meta, prt, prt_of_types, zlib_packed};

fn read(bytes: &[u8]) -> Result<ParticleFrame> {
    read_particles(bytes, "a.prt", &Limits::default())
}

fn fixture(name: &str) -> Vec<u8> {
    fixtures::all().into_iter().find(|(found, _)| found == name).expect("a fixture").1
}

#[test]
fn channels_are_read_by_name() {
    let [first, second] = ["version_1_0.prt", "version_1_1.prt"].map(|name| read(&fixture(name)).unwrap());
    assert_eq!(first.positions, FilePositions::F32(vec![[0.5, 1.0, 2.0], [-0.25, 1.0, 2.0]]));
    let found: Vec<_> = first.attributes.iter().map(|a| (&*a.name, a.arity, a.role, &a.values)).collect();
    let velocity = Values::F32(vec![1.0, 1.0, 1.0, -2.0, -2.0, -2.0]);
    let id = Values::I64(vec![7, -8]);
    let expected =
        [("Velocity", 3, Some(AttributeRole::Velocity), &velocity), ("ID", 1, Some(AttributeRole::Id), &id)];
    assert_eq!(found, expected);
    assert!(first.notes.is_empty(), "{:?}", first.notes);
    assert_eq!((&second.positions, &second.attributes), (&first.positions, &first.attributes));
    let notes = second.notes.join("; ");
    assert!(notes.contains("right-handed, with Z up") && notes.contains("is 0.01 m"), "{notes}");
    assert_eq!(second.notes.len(), 2, "{notes}");
}

#[test]
fn every_type_is_read() {
    let frame = read(&prt_of_types()).unwrap();
    let values = |name: &str| &frame.attributes.iter().find(|a| a.name == name).expect("a channel").values;
    let f64 = f64::from_le_bytes([1; 8]);
    assert_eq!(frame.positions, FilePositions::F64(vec![[f64; 3]]));
    for (name, _) in TEN_TYPES {
        let expected = match name {
            "int8" => Values::I32(vec![1]),
            "uint8" => Values::U8(vec![1]),
            "int16" | "uint16" => Values::I32(vec![0x0101]),
            "int32" => Values::I32(vec![0x0101_0101]),
            "uint32" => Values::I64(vec![0x0101_0101]),
            "int64" | "uint64" => Values::I64(vec![0x0101_0101_0101_0101]),
            "float16" => Values::F32(vec![1.531_839_4e-5]),
            "float32" => Values::F32(vec![f32::from_le_bytes([1; 4])]),
            _ => Values::F64(vec![f64]),
        };
        assert_eq!(*values(name), expected, "{name}");
    }
}

#[test]
fn unfinished_file_is_incomplete_and_truncated() {
    let unfinished = prt(2, b"Stop\0\0\0\0", -1, &channels(), &[0; 52]);
    let error = read(&unfinished).unwrap_err();
    assert!(error.is_truncated() && error.to_string().contains("has not finished"), "{error}");
    let found = |bytes: &[u8]| completeness(&mut Cursor::new(bytes), "a.prt").unwrap();
    assert!(matches!(found(&unfinished), Completeness::Incomplete { .. }));
    let finished = fixture("version_1_1.prt");
    assert_eq!(found(&finished), Completeness::NeedsReading);
    assert!(matches!(found(&finished[..60]), Completeness::Incomplete { .. }));
    assert!(matches!(found(&finished[..5]), Completeness::Incomplete { .. }));
}

#[test]
fn file_without_particles_is_read() {
    let frame = read(&prt(1, &[], 0, &channels(), &[])).unwrap();
    assert!(frame.positions.is_empty() && frame.attributes.len() == 2);
}

#[test]
fn half_positions_have_a_note() {
    let frame = read(&prt(1, &[], 1, &[("Position", 3, 3, 0)], &[0, 0x3c, 0, 0x3c, 0, 0x3c])).unwrap();
    assert_eq!(frame.positions, FilePositions::F32(vec![[1.0; 3]]));
    assert!(frame.notes[0].contains("16 bits"), "{:?}", frame.notes);
}

#[test]
fn invalid_files_are_errors_with_a_reason() {
    let position = ("Position", 4, 3, 0);
    let mut reserved = prt(1, &[], 1, &[position], &[0; 12]);
    reserved[56] = 5;
    let mut short_header = reserved.clone();
    short_header[8] = 55;
    let mut damaged = prt(1, &[], 1, &[position], &[0; 12]);
    let end = damaged.len() - 1;
    damaged[end] ^= 1;
    let long = [&b"Meta\xff\xff\0\0"[..], &[0; 8]].concat();
    let table: &[(Vec<u8>, &str)] = &[
        (prt(3, &[], 1, &[position], &[0; 12]), "version 3 is not supported"),
        (reserved, "expected the number 4"),
        (short_header, "the length of the header is 55"),
        (damaged, "are damaged"),
        (prt(2, &long, 1, &[position], &[0; 12]), "more than the header"),
        (prt(1, &[], 1, &[("Position", 11, 3, 0)], &[0; 12]), "the channel `Position` has type 11"),
        (prt(1, &[], 1, &[("Position", 4, -3, 0)], &[0; 12]), "has type 4, -3 values"),
        (prt(1, &[], 1, &[("Position", 4, 3, -1)], &[0; 12]), "offset -1"),
        (prt(1, &[], 1, &[position, ("v", 4, 3, 4)], &[0; 16]), "the channels overlap"),
        (
            prt(1, &[], 1, &[("Speed", 4, 1, 0)], &[0; 4]),
            "a channel Position with three numbers, found: Speed",
        ),
        (prt(1, &[], 1, &[], &[]), "a channel Position"),
        (prt(1, &[], 1, &[position], &[0; 24]), "expected 12 bytes of particles, found 24"),
        (prt(1, &[], 2, &[position], &[0; 12]), "expected 24 bytes of particles, found 12"),
        (prt(1, &[], i64::MAX, &[position], &[0; 12]), "more than the limit"),
    ];
    for (bytes, words) in table {
        let error = read(bytes).expect_err(words);
        assert!(error.to_string().contains(words) && !error.is_truncated(), "expected `{words}` in: {error}");
    }
    let skipped = read(&prt(1, &[], 1, &[position, ("Empty", 4, 0, 12)], &[0; 12])).unwrap();
    assert!(skipped.notes[0].contains("`Empty`"), "{:?}", skipped.notes);
    // Metadata that does not have its usual type is left alone.
    let odd =
        [meta("", "CoordSys", 5, &[0; 8]), meta("", "CoordSys", 1, &[9, 0, 0, 0]), meta("", "", 99, b"")];
    assert!(read(&prt(2, &odd.concat(), 1, &[position], &[0; 12])).unwrap().notes.is_empty());
    assert_eq!(zlib_packed(&[]).len(), 8);
}
