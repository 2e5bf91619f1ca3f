//! PCD files: encodings, colours, and what is wrong with others.

use meniscus_formats::{AttributeRole, FilePositions, Limits, ParticleFrame, Result, Values, read_particles};

use crate::fixtures;

fn read(bytes: &[u8]) -> Result<ParticleFrame> {
    read_particles(bytes, "a.pcd", &Limits::default())
}

fn fixture(name: &str) -> Vec<u8> {
    fixtures::all().into_iter().find(|(found, _)| found == name).expect("a fixture").1
}

#[test]
fn all_encodings_give_the_same_points() {
    for name in ["binary.pcd", "compressed.pcd", "text.pcd"] {
        let frame = read(&fixture(name)).unwrap();
        let FilePositions::F32(positions) = &frame.positions else { panic!("{name}: 32 bits") };
        assert_eq!((positions[0], &positions[1][..2]), ([0.5, 1.0, 2.0], &[-0.25, 10.0][..]), "{name}");
        assert!(positions[1][2].is_nan(), "{name}");
        let found: Vec<_> = frame.attributes.iter().map(|a| (&*a.name, a.arity, a.role, &a.values)).collect();
        let color = Values::U8(vec![255, 128, 64, 0, 0, 0]);
        let (energy, ring) = (Values::F64(vec![0.25, -0.5, 1.0, 2.0]), Values::I32(vec![-7, 300]));
        let expected = [
            ("rgb", 3, Some(AttributeRole::Color), &color),
            ("e", 2, None, &energy),
            ("ring", 1, None, &ring),
        ];
        assert_eq!(found, expected, "{name}");
    }
}

#[test]
fn points_are_counted_without_a_line_for_them() {
    // The header of PCL before version 1.
    let old =
        "VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 1\nHEIGHT 2\nDATA ascii\n0.5 1 2\n3 4 5\n";
    let frame = read(old.as_bytes()).unwrap();
    assert_eq!(frame.positions, FilePositions::F32(vec![[0.5, 1.0, 2.0], [3.0, 4.0, 5.0]]));
}

#[test]
fn damaged_files_are_refused_with_the_place() {
    let with = |name: &str, from: &str, to: &str| {
        let bytes = fixture(name);
        let at = bytes.windows(from.len()).position(|window| window == from.as_bytes()).expect("there");
        [&bytes[..at], to.as_bytes(), &bytes[at + from.len()..]].concat()
    };
    let [text, binary, compressed] = ["text.pcd", "binary.pcd", "compressed.pcd"].map(fixture);
    for (bytes, truncated, words) in [
        (
            with("text.pcd", "COUNT 1 1 1 1 3 2 1", "COUNT 1 1"),
            false,
            "line 11: expected SIZE, TYPE and COUNT for each of 7 fields, found 7, 7 and 2",
        ),
        (
            with("text.pcd", "TYPE F F F F U F I", "TYPE F F F F U F Q"),
            false,
            "the field `ring` has the unknown type q of 2 bytes",
        ),
        (with("text.pcd", "FIELDS x y z", "FIELDS a b c"), false, "no fields x, y and z; found: a, b, c"),
        (with("text.pcd", "-7\n", "-7 8\n"), false, "line 12: expected 10 numbers, found more"),
        (with("text.pcd", "300", "3e2"), false, "line 14: expected a number, found \"3e2\""),
        (with("text.pcd", "300", "70000"), false, "expected a number, found \"70000\""),
        (
            with("text.pcd", "DATA ascii", "DATA zipped"),
            false,
            "expected DATA ascii, binary or binary_compressed",
        ),
        (
            with("text.pcd", "HEIGHT 1", "HEIGHT one"),
            false,
            "line 8: expected a number, found \"HEIGHT one\"",
        ),
        (with("text.pcd", "POINTS 2", "POINTS 3"), true, "expected 3 points, found 2"),
        (text[..40].to_vec(), true, "expected a line with DATA"),
        (binary[..binary.len() - 1].to_vec(), true, "expected 74 bytes for 2 points, found 73"),
        (compressed[..compressed.len() - 1].to_vec(), true, "bytes of compressed data, found"),
        (
            with("compressed.pcd", "POINTS 2", "POINTS 3"),
            false,
            "3 points take 111 bytes, but the data have 74",
        ),
    ] {
        let error = read(&bytes).expect_err(words);
        assert!(error.to_string().contains(words), "{error}, not {words}");
        assert_eq!(error.is_truncated(), truncated, "{error}");
    }
    let mut damaged = fixture("compressed.pcd");
    let control = damaged.len() - 38;
    damaged[control] = 0xff;
    assert!(read(&damaged).is_err());
}
