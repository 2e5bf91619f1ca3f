//! Classic BGEO: files built by hand, our own output, and files of other programs.

use meniscus_formats::bgeo::{self, AttributeKind};
use meniscus_formats::{AttributeRole, Error, FileAttribute, FilePositions, Limits, ParticleFrame, Values};
use std::io::Read;
use std::path::PathBuf;

/// Builds a file word by word.
struct Layout(Vec<u8>);

impl Layout {
    fn new(point_count: i32, attribute_count: i32) -> Layout {
        let mut layout = Layout(b"BgeoV".to_vec());
        for count in [5, point_count, 0, 0, 0, attribute_count, 0, 0, 0] {
            layout = layout.int(count);
        }
        layout
    }

    fn int(mut self, value: i32) -> Layout {
        self.0.extend(value.to_be_bytes());
        self
    }

    fn short(mut self, value: u16) -> Layout {
        self.0.extend(value.to_be_bytes());
        self
    }

    fn text(mut self, text: &str) -> Layout {
        self = self.short(text.len().try_into().unwrap());
        self.0.extend(text.as_bytes());
        self
    }

    fn reals(mut self, values: &[f32]) -> Layout {
        self.0.extend(values.iter().flat_map(|value| value.to_be_bytes()));
        self
    }

    fn entry(self, name: &str, size: u16, kind: i32) -> Layout {
        let mut layout = self.text(name).short(size).int(kind);
        for _ in 0..size {
            layout = layout.int(0);
        }
        layout
    }

    fn end(mut self) -> Vec<u8> {
        self.0.extend([0x00, 0xff]);
        self.0
    }
}

fn read(bytes: &[u8]) -> meniscus_formats::Result<ParticleFrame> {
    bgeo::read(bytes, &Limits::default())
}

fn positions(frame: &ParticleFrame) -> &[[f32; 3]] {
    match &frame.positions {
        FilePositions::F32(positions) => positions,
        FilePositions::F64(_) => panic!("the format has 32-bit positions"),
    }
}

fn every_attribute_type() -> Vec<u8> {
    let strings = Layout::new(2, 6).entry("life", 2, 0).entry("Cd", 3, 0).entry("v", 3, 5).entry("id", 1, 1);
    let strings =
        strings.entry("cell", 5, 1).text("material").short(1).int(4).int(2).text("oil").text("water");
    strings
        .reals(&[1.0, 2.0, 3.0, 1.0, 0.5, 10.0, 0.1, 0.2, 0.3, 7.0, 8.0, 9.0])
        .int(41)
        .int(1)
        .int(2)
        .int(3)
        .int(4)
        .int(5)
        .int(1)
        .reals(&[2.0, 4.0, 6.0, 2.0, -1.0, 20.0, 0.4, 0.5, 0.6, -7.0, -8.0, -9.0])
        .int(-42)
        .int(6)
        .int(7)
        .int(8)
        .int(9)
        .int(10)
        .int(-1)
        .end()
}

#[test]
fn all_attribute_types_are_read() {
    let bytes = every_attribute_type();
    let frame = read(&bytes).unwrap();
    assert_eq!(frame.notes, Vec::<String>::new());
    assert_eq!(positions(&frame), [[1.0, 2.0, 3.0], [1.0, 2.0, 3.0]], "the second one has w = 2");
    let attribute =
        |name: &str, arity, role, values| FileAttribute { name: name.into(), arity, role, values };
    let expected = [
        attribute("life", 2, None, Values::F32(vec![0.5, 10.0, -1.0, 20.0])),
        attribute("Cd", 3, Some(AttributeRole::Color), Values::F32(vec![0.1, 0.2, 0.3, 0.4, 0.5, 0.6])),
        attribute("v", 3, Some(AttributeRole::Velocity), Values::F32(vec![7.0, 8.0, 9.0, -7.0, -8.0, -9.0])),
        attribute("id", 1, Some(AttributeRole::Id), Values::I32(vec![41, -42])),
        attribute("cell", 5, None, Values::I32((1..=10).collect())),
        attribute(
            "material",
            1,
            Some(AttributeRole::Kind),
            Values::Strings { table: vec!["oil".into(), "water".into()], indices: vec![1, -1] },
        ),
    ];
    assert_eq!(frame.attributes, expected);

    let header = bgeo::header(&bytes).unwrap();
    assert_eq!(header.point_count, 2);
    assert_eq!(header.expected_bytes(), bytes.len() as u64);
    assert!(header.expected_bytes_is_exact);
    assert_eq!(header.attributes[2].kind, AttributeKind::Vector);
    assert_eq!(bgeo::header(&bytes[..header.points_offset]).unwrap(), header, "the points are not needed");
}

#[test]
fn positions_are_divided_by_nonzero_weights() {
    let table = [(0.0, [4.0, 6.0, 8.0]), (1.0, [4.0, 6.0, 8.0]), (2.0, [2.0, 3.0, 4.0])];
    for (weight, expected) in table {
        let bytes = Layout::new(1, 0).reals(&[4.0, 6.0, 8.0, weight]).end();
        assert_eq!(positions(&read(&bytes).unwrap()), [expected], "w = {weight}");
    }
}

#[test]
fn diameters_become_radii() {
    let bytes = Layout::new(1, 1).entry("diameter", 1, 0).reals(&[0.0, 0.0, 0.0, 1.0, 0.5]).end();
    let frame = read(&bytes).unwrap();
    assert_eq!(frame.attributes[0].role, Some(AttributeRole::Radius));
    assert_eq!(frame.attributes[0].values, Values::F32(vec![0.25]));
}

#[test]
fn unusual_files_are_read_with_notes() {
    let no_trailer = Layout::new(1, 0).reals(&[0.0; 4]).0;
    let no_values = Layout::new(1, 1).entry("empty", 0, 0).reals(&[0.0; 4]).end();
    let strings = Layout::new(1, 1).text("name").short(1).int(4).int(1).text("a");
    let strings = strings.reals(&[0.0; 4]).int(7).end();
    let table = [
        (no_trailer, "end of the file is invalid"),
        (no_values, "no values"),
        (strings, "1 indices are outside"),
    ];
    for (bytes, expected) in table {
        let frame = read(&bytes).unwrap();
        assert!(frame.notes.iter().any(|note| note.contains(expected)), "{expected}: {:?}", frame.notes);
    }
}

#[test]
fn file_without_points_is_read() {
    let bytes = Layout::new(0, 1).entry("v", 3, 5).end();
    let frame = read(&bytes).unwrap();
    assert!(frame.positions.is_empty());
    assert_eq!(frame.attributes[0].values, Values::F32(Vec::new()));
}

#[test]
fn invalid_files_are_errors_that_say_what_was_expected() {
    let mut version_6 = Layout::new(0, 0).end();
    version_6[8] = 6;
    let table: Vec<(&str, Vec<u8>, &str)> = vec![
        ("nothing", Vec::new(), "expected 5 bytes of the signature, found 0"),
        ("another file", b"\x7fNSJb.....".to_vec(), "expected the signature BgeoV"),
        ("version", version_6, "version 6; only version 5 is supported"),
        (
            "negative count",
            Layout::new(-1, 0).end(),
            "at byte 9: expected the number of points to be at least 0, found -1",
        ),
        (
            "points missing",
            Layout::new(1000, 0).end(),
            "expected 1000 points of 16 bytes each, 16000 bytes in all, but 2",
        ),
        ("dictionary missing", Layout::new(0, 1000).end(), "at byte 41: expected at least 8000 bytes"),
        ("attributes without end", Layout::new(0, i32::MAX).end(), "more than the limit of 4096"),
        ("fixed string", Layout::new(0, 1).entry("name", 4, 2).end(), "fixed-length string"),
        ("mixed", Layout::new(0, 1).entry("name", 4, 3).end(), "mixed"),
        ("unknown type", Layout::new(0, 1).entry("name", 4, 9).end(), "at byte 49: expected the type"),
        (
            "defaults missing",
            Layout::new(0, 1).text("a").short(60000).int(0).end(),
            "240000 bytes of the def",
        ),
        (
            "strings missing",
            Layout::new(0, 1).text("a").short(1).int(4).int(i32::MAX).end(),
            "bytes of the strings of an attribute",
        ),
        (
            "long name missing",
            Layout::new(0, 1).short(0xffff).int(i32::MAX).int(0).end(),
            "expected 2147483647 bytes of an attribute name",
        ),
    ];
    for (case, bytes, expected) in table {
        let error = read(&bytes).expect_err(case).to_string();
        assert!(error.contains(expected), "{case}: {error}");
    }
    let limits = Limits { particle_count: 9, ..Limits::default() };
    let error = bgeo::read(&Layout::new(10, 0).reals(&[0.0; 40]).end(), &limits).unwrap_err();
    assert!(matches!(error, Error::TooLarge { .. }), "{error}");
}

#[test]
fn written_files_are_read_back() {
    let read_once = read(&every_attribute_type()).unwrap();
    let mut bytes = Vec::new();
    bgeo::write(&read_once, &mut bytes).unwrap();
    assert_eq!(read(&bytes).unwrap(), read_once);
    assert_eq!(bgeo::header(&bytes).unwrap().expected_bytes(), bytes.len() as u64);

    let long_name = "n".repeat(40_000);
    let frame = ParticleFrame {
        positions: FilePositions::F64(vec![[0.1, 0.2, 0.3]; 3]),
        attributes: vec![
            FileAttribute {
                name: long_name.clone(),
                arity: 1,
                role: None,
                values: Values::F64(vec![1.5; 3]),
            },
            FileAttribute { name: "flag".into(), arity: 1, role: None, values: Values::U8(vec![1, 255, 0]) },
            FileAttribute {
                name: "id".into(),
                arity: 1,
                role: Some(AttributeRole::Id),
                values: Values::I64(vec![-1, 2, 3]),
            },
        ],
        notes: Vec::new(),
    };
    let mut bytes = Vec::new();
    bgeo::write(&frame, &mut bytes).unwrap();
    let again = read(&bytes).unwrap();
    assert_eq!(positions(&again), [[0.1f32, 0.2, 0.3]; 3]);
    assert_eq!(again.attributes[0].name, long_name);
    assert_eq!(again.attributes[1].values, Values::I32(vec![1, 255, 0]));
    assert_eq!(again.attributes[2].values, Values::I32(vec![-1, 2, 3]));
}

#[test]
fn values_beyond_the_format_are_an_error() {
    let attribute = |arity, values| ParticleFrame {
        positions: FilePositions::F32(vec![[0.0; 3]]),
        attributes: vec![FileAttribute { name: "a".into(), arity, role: None, values }],
        notes: Vec::new(),
    };
    let table = [
        (attribute(1, Values::I64(vec![1 << 40])), "32 bits"),
        (attribute(3, Values::F32(vec![0.0])), "1 values for 1 particles with 3 values each"),
        (attribute(70_000, Values::F32(vec![0.0; 70_000])), "the format's limit is 65535"),
    ];
    for (frame, expected) in table {
        let error = bgeo::write(&frame, &mut Vec::new()).unwrap_err().to_string();
        assert!(error.contains(expected), "{error}");
    }
}

/// Files of other programs, which are not part of this repository.
fn shared(path: &str) -> Option<PathBuf> {
    let root = std::env::var_os("MENISCUS_SHARED")
        .map_or_else(|| PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/../../shared")), PathBuf::from);
    let path = root.join("data").join(path);
    path.exists().then_some(path)
}

/// The contents of a file, decompressed if it is gzipped: most programs write .bgeo files with gzip.
fn inflated(path: &PathBuf) -> Vec<u8> {
    let bytes = std::fs::read(path).unwrap();
    if !bytes.starts_with(&[0x1f, 0x8b]) {
        return bytes;
    }
    let mut inflated = Vec::new();
    flate2::read::MultiGzDecoder::new(&bytes[..]).read_to_end(&mut inflated).unwrap();
    inflated
}

#[test]
#[expect(clippy::print_stderr, reason = "a test that did not run must say so")]
fn files_of_other_programs_are_read() {
    let table = [
        ("third-party/splashsurf/dam_break_frame_23_24389_particles.bgeo", 24_389, ""),
        ("third-party/splashsurf/dam_break_frame_9_6859_particles.bgeo", 6_859, "id density velocity"),
        ("third-party/splashsurf/hilbert_46843_particles.bgeo", 46_843, ""),
        ("third-party/splishsplash/splish_bunny.bgeo", 7_706, "id"),
        ("third-party/splishsplash/splish_particle_grid.bgeo", 400, "velocity id"),
        ("third-party/splishsplash/splish_sphere.bgeo", 12_394, "pscale id"),
        ("third-party/partio/base.bgeo", 5, "life id"),
        ("third-party/partio/baseidsfaceid.bgeo", 8, "ids faceid_XS"),
        ("third-party/partio/delta.bgeo", 3, "life id new"),
        ("third-party/partio/deltaids.bgeo", 8, "ids"),
        ("third-party/partio/json.bgeo", 5, "life id someString"),
        ("third-party/partio/test.bgeo", 5, "life id"),
        ("third-party/partio/reindeer.bgeo", 16, "ctl_head_sss_DOT_visibility 490 more"),
        ("ours/sequences/dam_break_bgeo/ParticleData_Fluid_1.bgeo", 4_732, "id velocity density"),
        ("ours/sequences/dam_break_bgeo/ParticleData_Fluid_61.bgeo", 4_732, "id velocity density"),
    ];
    for (path, count, names) in table {
        let Some(found) = shared(path) else {
            eprintln!("not tested, file missing: {path}");
            continue;
        };
        let bytes = inflated(&found);
        let frame = read(&bytes).unwrap_or_else(|error| panic!("{path}: {error}"));
        assert_eq!(frame.positions.len(), count, "{path}");
        assert_eq!(frame.notes, Vec::<String>::new(), "{path}");
        let found_names: Vec<&str> = frame.attributes.iter().map(|a| a.name.as_str()).collect();
        let found_names = match found_names[..] {
            [first, _, _, _, ..] => format!("{first} {} more", found_names.len() - 1),
            _ => found_names.join(" "),
        };
        assert_eq!(found_names, names, "{path}");
        assert!(positions(&frame).as_flattened().iter().all(|x| x.is_finite() && x.abs() < 1e4), "{path}");
        let header = bgeo::header(&bytes).unwrap();
        assert!(header.expected_bytes() <= bytes.len() as u64, "{path}");
        if header.expected_bytes_is_exact {
            assert_eq!(header.expected_bytes(), bytes.len() as u64, "{path}");
        }
    }
}
