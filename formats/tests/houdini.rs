//! Houdini geometry: the same document in both byte orders and in the container, and errors.

use crate::fixtures;

use fixtures::{PAGES, TUPLES, binary, container};
use meniscus_formats::{
    AttributeRole, Error, FileAttribute, FilePositions, Limits, ParticleFrame, Values, houdini,
    read_particles,
};

fn read(bytes: &[u8], name: &str) -> ParticleFrame {
    read_particles(bytes, name, &Limits::default()).unwrap_or_else(|error| panic!("{name}: {error}"))
}

/// The document in both byte orders, and in the container.
fn forms(text: &str) -> Vec<(&'static str, Vec<u8>)> {
    vec![
        ("a.bgeo", binary(text, false)),
        ("big-endian.bgeo", binary(text, true)),
        ("a.bgeo.sc", container(&binary(text, false), 100)),
        ("large.bgeo.sc", container(&binary(text, false), 1 << 20)),
        ("big-endian.bgeo.sc", container(&binary(text, true), 100)),
    ]
}

#[test]
fn all_forms_give_the_same_frame() {
    let attribute =
        |name: &str, arity, role, values| FileAttribute { name: name.into(), arity, role, values };
    let table = ["a", "bé"].map(String::from).to_vec();
    for (name, bytes) in forms(TUPLES) {
        let frame = read(&bytes, name);
        let positions = vec![[0.5, 1.0, 2.0], [0.25, -1.0, 0.2], [3.0, 4.0, 5.0]];
        assert_eq!(frame.positions, FilePositions::F32(positions), "{name}");
        let velocities = [1.0, 4.0, 7.0, 2.0, 5.0, 8.0, 3.0, 6.0, 9.0];
        let expected = [
            attribute("v", 3, Some(AttributeRole::Velocity), Values::F64(velocities.to_vec())),
            attribute("id", 1, Some(AttributeRole::Id), Values::I64(vec![7, 8, 5_000_000_000])),
            attribute("pscale", 1, Some(AttributeRole::Radius), Values::F32(vec![0.125; 3])),
            attribute("part", 1, None, Values::Strings { table: table.clone(), indices: vec![1, 0, -1] }),
            attribute("fluid", 1, None, Values::U8(vec![1, 0, 1])),
            attribute("flags", 1, None, Values::U8(vec![0, 1, 1])),
            attribute("walls", 1, None, Values::U8(vec![0, 1, 1])),
            attribute("group_id", 1, None, Values::U8(vec![1, 0, 1])),
        ];
        assert_eq!(frame.attributes, expected, "{name}");
        assert_eq!(
            frame.notes,
            [
                "skipped the point attribute \"neighbours\": its type \"arraydata\" is not supported",
                "skipped the point group \"later\": its encoding is not supported"
            ]
        );
    }
}

#[test]
fn paged_values_are_decoded() {
    for (name, bytes) in forms(PAGES) {
        let page = [7.0, 8.0, 9.0];
        let positions = vec![[1.0, 2.0, 3.0], [2.0, 2.5, 3.0], page, page, [10.0, 11.0, 12.0]];
        assert_eq!(read(&bytes, name).positions, FilePositions::F32(positions), "{name}");
    }
}

#[test]
fn points_of_other_primitives_are_an_error() {
    let table = [
        ("PackedGeometry", "packed primitives (PackedGeometry): its 3 points are their pivots"),
        ("VDB", "volumes (VDB): its 3 points are their locations"),
        ("Volume", "volumes (Volume)"),
        ("PolySoup", "surfaces or curves (PolySoup): its 3 points belong to them"),
        ("p_r", "surfaces or curves (Poly)"),
        ("run\",\"runtype\",\"NURBCurve", "surfaces or curves (NURBCurve)"),
    ];
    for (kind, words) in table {
        for (name, bytes) in forms(&TUPLES.replace("Part", kind)) {
            let error = read_particles(&bytes, name, &Limits::default()).expect_err(name);
            assert!(
                matches!(error, Error::Unsupported { .. }) && error.to_string().contains(words),
                "{error}"
            );
        }
    }
}

#[test]
fn invalid_documents_are_errors_with_their_location() {
    let table = [
        (
            TUPLES.replace("[1,0,1]", "[1,0]"),
            "fluid/group/selection/unordered: the group does not have 3 flags",
        ),
        (TUPLES.replace("[1,0,1]", "[1,0,1,1]"), "expected at most 3 numbers, found more"),
        (TUPLES.replace("[1,false,2,true]", "[1,false,3,true]"), "the runs of the group exceed 3 points"),
        (TUPLES.replace("[1,false,2,true]", "[1,false,-2,true]"), "the runs of the group exceed 3 points"),
        (
            TUPLES.replace("[1,false,2,true]", "[1,false,1,true]"),
            "the runs of the group do not cover 3 points",
        ),
        (TUPLES.replace("[1,false,2,true]", "[1,false,2]"), "the runs of the group do not cover 3 points"),
        (TUPLES.replace("[2,0]", "[2,3]"), "the group has the point 3 of 3"),
        (TUPLES.replace("[3,4,5]", "[3,4]"), "expected 3 values for each of 3 points, found 8"),
        (
            TUPLES.replace("[3,4,5]", "[3,4,5,6]"),
            "attributes/pointattributes/P/body/values/tuples: expected at most 9",
        ),
        (TUPLES.replace("[3,4,5]", "[3,4,\"a\"]"), "expected numbers, found \"a\""),
        (
            TUPLES.replace("\"pointcount\",3", "\"pointcount\",4000000000"),
            "for each of 4000000000 points, found 9",
        ),
        (TUPLES.replace("\"pointcount\",3", "\"pointcount\",-3"), "expected a count, found -3"),
        (TUPLES.replace("\"pointcount\"", "\"points\""), "the attributes come before the pointcount"),
        (TUPLES.replace("\"P\"", "\"Q\""), "the point attribute P is missing"),
        (TUPLES.replace("fpreal32", "fpreal8"), "unknown storage \"fpreal8\""),
        (TUPLES.replace("[0.125]", "[0.125,1]"), "the pages have the wrong number of values"),
        (PAGES.replace("[3,1]", "[3,2]"), "the packing [3, 2] does not match 4 values"),
        (PAGES.replace("[3,1]", "[3,0,1]"), "the packing [3, 0, 1] does not match 4 values"),
        (PAGES.replace("true,false]", "true,false,true]"), "more flags than the 3 pages"),
        (
            PAGES.replace("12, 1]", "12, 1],\"packing\",[1,3]"),
            "`packing` comes after the values that it describes",
        ),
        (TUPLES.replace("\"vertexcount\",0", "\"pointcount\",2"), "pointcount occurs twice"),
        (PAGES.replace("1,0,", "1,"), "the pages have the wrong number of values"),
        (PAGES.replace("\"pointcount\",5", "\"pointcount\",5000000000"), "more than the limit"),
    ];
    for (text, words) in &table {
        for (name, bytes) in forms(text) {
            let error = read_particles(&bytes, name, &Limits::default()).expect_err(words).to_string();
            assert!(error.contains(words), "{name}: expected `{words}` in: {error}");
        }
    }
    let more = [&binary(TUPLES, false)[..], b"[]"].concat();
    let error = houdini::read_binary(&more, &Limits::default()).unwrap_err().to_string();
    assert!(error.contains("expected the end of the file"), "{error}");
}

#[test]
fn geometry_as_text_is_refused_with_advice() {
    let classic: &[u8] = b"PGEOMETRY V5\nNPoints 1 NPrims 0\n";
    let packed = container(TUPLES.as_bytes(), 128);
    for (name, bytes) in [
        ("a.geo", TUPLES.as_bytes()),
        ("a.bgeo", TUPLES.as_bytes()),
        ("b.geo", classic),
        ("a.geo.sc", &packed),
    ] {
        let error = read_particles(bytes, name, &Limits::default()).expect_err(name).to_string();
        assert!(error.contains("only binary geometry is supported: save it as .bgeo"), "{name}: {error}");
    }
}

/// A constant page stores one value for all its points, so a small file could expand enormously.
#[test]
fn constant_pages_are_limited() {
    let pages = vec!["1"; 100_000].join(",");
    let text = format!(
        "[\"pointcount\",102400000,\"attributes\",[\"pointattributes\",[[[\"type\",\"numeric\",\"name\",\"P\"],\
         [\"values\",[\"size\",3,\"storage\",\"fpreal32\",\"pagesize\",1024,\"constantpageflags\",[[{pages}]],\
         \"rawpagedata\",[{pages},{pages},{pages}]]]]]]]"
    );
    let error = houdini::read_binary(&binary(&text, false), &Limits::default()).unwrap_err();
    assert!(matches!(error, Error::TooLarge { .. }), "{error}");
}

/// Deeply nested arrays must overflow neither the stack nor the memory.
#[test]
fn deeply_nested_arrays_are_skipped() {
    let deep = [&b"\x7fNSJb"[..], &b"[".repeat(4 << 20)].concat();
    let error = read_particles(&deep, "a.bgeo", &Limits::default()).unwrap_err();
    assert!(error.to_string().contains("expected a key"), "{error}");
    let document = binary(TUPLES, false);
    let at = document.windows(4).position(|bytes| bytes == b"[[]]").expect("the value of \"whatever\"");
    let deep = [b"[".repeat(1 << 20), b"]".repeat(1 << 20)].concat();
    let inside = [&document[..at], &deep, &document[at + 4..]].concat();
    assert_eq!(read(&inside, "a.bgeo").positions.len(), 3);
}
