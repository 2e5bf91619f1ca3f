//! Particles in USD: the text form, all versions of the binary form, and packages give the same.

#![allow(clippy::cast_possible_truncation, reason = "test numbers are small")]

use meniscus_formats::{
    AttributeRole, Error, FilePositions, Format, Limits, ParticleFrame, ProbedKind, Result, Values,
    looks_like_mesh, looks_like_particles, probe, read_mesh, read_particles,
};

use crate::fixtures::archive;
use crate::fixtures::usd::{CrateBuilder, all, heat, ids, inlined, points, usda_points, wet};

fn read(bytes: &[u8]) -> Result<ParticleFrame> {
    read_particles(bytes, "f", &Limits::default())
}

fn values<'a>(frame: &'a ParticleFrame, name: &str) -> &'a Values {
    &frame.attributes.iter().find(|attribute| attribute.name == name).expect(name).values
}

#[test]
fn all_forms_give_the_same_particles() {
    for (name, bytes) in all() {
        let frame = read(&bytes).unwrap_or_else(|error| panic!("{name}: {error}"));
        let moved = points().iter().map(|[x, y, z]| [x + 10.0, y + 20.0, z + 30.0].map(f64::from)).collect();
        assert_eq!(frame.positions, FilePositions::F64(moved), "{name}");
        let count = points().len();
        assert_eq!(*values(&frame, "velocities"), Values::F32([0.5, -2.0, 65504.0].repeat(count)), "{name}");
        assert_eq!(*values(&frame, "widths"), Values::F32(vec![0.125; count]), "{name}");
        assert_eq!(*values(&frame, "ids"), Values::I64(ids()), "{name}");
        assert_eq!(*values(&frame, "heat"), Values::F32(heat()), "{name}");
        assert_eq!(*values(&frame, "wet"), Values::F32(wet()), "{name}");
        let indices = (0..count as i32).map(|i| i % 2).collect();
        let expected = Values::Strings { table: vec!["oil".into(), "water".into()], indices };
        assert_eq!(*values(&frame, "kind"), expected, "{name}");
        assert_eq!(frame.attributes.len(), 6);
        let role =
            |role| frame.attributes.iter().find(|attribute| attribute.role == Some(role)).map(|a| &*a.name);
        assert_eq!(role(AttributeRole::Radius), Some("widths"));
        assert_eq!(role(AttributeRole::Id), Some("ids"));
        assert_eq!(role(AttributeRole::Velocity), Some("velocities"));
        let notes = frame.notes.join("\n");
        for note in ["without a value per point: once", "metersPerUnit 0.01, upAxis Z", "the radius is half"]
        {
            assert!(notes.contains(note), "{name}: {notes}");
        }
    }
}

#[test]
fn layers_are_recognised_by_content() {
    for (name, bytes) in all() {
        let kind = match name.rsplit('.').next() {
            Some("usda") => Format::Usda,
            Some("usdc") => Format::Usdc,
            _ => Format::Usdz,
        };
        assert_eq!(probe(&bytes, "a").kind, ProbedKind::Format(kind), "{name}");
        assert!(looks_like_particles(&bytes, "a") && !looks_like_mesh(&bytes, "a"), "{name}");
    }
    let mesh = b"#usda 1.0\ndef Mesh \"a\" { point3f[] points = [] int[] faceVertexCounts = [] }\n";
    assert!(looks_like_mesh(mesh, "a") && !looks_like_particles(mesh, "a"));
    let error = read(mesh).expect_err("a mesh").to_string();
    assert!(error.contains("this is a mesh, not particles"), "{error}");
}

#[test]
fn truncated_layers_are_truncated() {
    for (name, bytes) in all() {
        for length in 1..bytes.len() {
            let has_prims = bytes[..length].windows(4).any(|word| word == b"def ");
            match read_particles(&bytes[..length], &name, &Limits::default()) {
                // A text of nothing but metadata is a layer.
                Err(error) if name.ends_with(".usda") && !has_prims && !error.is_truncated() => {
                    assert!(error.to_string().contains("no prims of the type Points"), "{error}");
                }
                Err(error) => assert!(error.is_truncated(), "{name} at {length}: {error}"),
                // What follows the last brace is white space.
                Ok(_) => assert!(bytes[length..].iter().all(u8::is_ascii_whitespace), "{name} at {length}"),
            }
        }
    }
}

/// A stage with one prim of two points, in which `{}` is replaced.
fn stage(rest: &str) -> String {
    format!("#usda 1.0\ndef Points \"p\" {{ point3f[] points = [(1, 2, 3), (4, 5, 6)]\n{rest} }}\n")
}

#[test]
fn syntax_of_the_text_form_is_accepted() {
    let two = FilePositions::F32(vec![[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]);
    for rest in [
        "",
        "custom string a = \"x } ] \\\" y\"",
        "string a = '''it's \"\" '' long\nand } more''' ( doc = \"\"\"a ) b\"\"\" )",
        "asset a = @a]b@\nasset b = @@@a@b@@@; rel r = </p.points>; rel s\nprepend rel t = [</a>, </b>]",
        "float a.connect = </q.b>\nuniform token b ( allowedTokens = [\"a\", \"b\"] )",
        "# a comment } with [ all\n/* and } another */ // and } more\n",
        "dictionary a = { string b = \"}\" dictionary c = { int[] d = [1, 2] double e = 1e-3 } }",
        "double x.timeSamples = { 1: 2.5, 3: None, }\nfloat[] y.timeSamples = { 1: [1, 2], 2: [3] }",
        "def \"child\" ( prepend apiSchemas = [\"A\"] variants = { string v = \"w\" } ) { over \"grandchild\" {} }",
        "variantSet \"v\" = { \"w\" ( doc = \"x\" ) { float a = 1 } \"x y\" { } }",
        "reorder nameChildren = [\"a\", \"b\"]\nreorder properties = [\"a\"]",
        "matrix4d[] m = [((1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1))]\nquatf q = (1, 0, 0, 0)",
        "float a.spline = { bezier, 1: 2; pre (1, 2) }",
        "float[] \u{f6}l = [nan, inf]\nfloat n = -inf",
    ] {
        let frame = read(stage(rest).as_bytes()).unwrap_or_else(|error| panic!("{rest}: {error}"));
        assert_eq!(frame.positions, two, "{rest}");
    }
    let frame = read(stage("float[] \u{f6}l = [nan, inf]").as_bytes()).expect("a stage");
    assert!(
        matches!(values(&frame, "\u{f6}l"), Values::F32(values) if values[0].is_nan() && values[1] == f32::INFINITY)
    );
}

#[test]
fn faults_of_the_text_form_have_their_line() {
    for (rest, line, word) in [
        ("float = 1", 3, "expected a word"),
        ("float[] a = [1, x]", 3, "expected a number, found `x`"),
        ("float3[] a = [(1, 2), (3, 4, 5)]", 3, "expected 3 numbers"),
        ("float3[] a = [1, 2]", 3, "expected `(`"),
        ("\nint[] a = [1.5, 2]", 4, "`1.5`"),
        ("int[] a = [99999999999, 2]", 3, "`99999999999`"),
        ("float a = \u{1}", 3, "expected a word"),
        ("string a = \"\\xzz\"", 3, "two hexadecimal digits"),
    ] {
        let error = read(stage(rest).as_bytes()).expect_err(rest).to_string();
        assert!(
            error.starts_with(&format!("USD, at line {line}: ")) && error.contains(word),
            "{rest}: {error}"
        );
    }
    let deep =
        |open: &str, close: &str| format!("float a = {}{}", open.repeat(100_000), close.repeat(100_000));
    for rest in [deep("[", "]"), deep("(", ")"), "def \"a\" {".repeat(100_000)] {
        assert!(matches!(read(stage(&rest).as_bytes()), Err(Error::TooLarge { .. })));
    }
}

#[test]
fn contradictions_are_errors_or_notes() {
    let indices =
        "float[] primvars:a = [1] ( interpolation = \"vertex\" )\nint[] primvars:a:indices = [0, 1]";
    let error = read(stage(indices).as_bytes()).expect_err("an index").to_string();
    assert!(error.contains("the indices of /p.primvars:a are outside its table"), "{error}");
    for (rest, note) in [
        (
            "float[] primvars:a = [1, 2, 3] ( interpolation = \"vertex\" )",
            "have other lengths than its points: a",
        ),
        ("color3f[] primvars:displayColor = [(1, 0, 0)]", "without a value per point: displayColor"),
        ("token visibility = \"invisible\"", "skipped invisible prims: /p"),
    ] {
        let frame = read(stage(rest).as_bytes()).expect(rest);
        assert!(frame.notes.iter().any(|found| found.contains(note)), "{rest}: {:?}", frame.notes);
        assert_eq!(frame.attributes, [], "{rest}");
    }
    for (rest, word) in [
        ("def Points \"q\" ( references = @./q.usda@ ) {}", "/p/q refers to the layer q.usda"),
        ("def Points \"q\" ( payload = @/etc/q.usda@ ) {}", "save it with relative paths"),
        ("def Points \"q\" ( references = @../q.usda@ ) {}", "move the files into one folder"),
        ("def Points \"q\" ( references = </r> ) {}", "/p/q refers to the prim `/r`, which does not exist"),
        ("def Points \"q\" ( references = </p> ) {}", "nested more than 64 deep"),
        ("def Points \"q\" ( clips = { } ) {}", "/p/q has clips"),
        (
            "token[] xformOpOrder = [\"xformOp:shear\"] double3 xformOp:shear = (1, 2, 3)",
            "of an unknown type",
        ),
    ] {
        let error = read(stage(rest).as_bytes()).expect_err(rest).to_string();
        assert!(error.contains(word), "{rest}: {error}");
    }
}

/// Each prim has ten references to the next one: 10¹² prims.
#[test]
fn references_that_multiply_are_refused() {
    let mut text = "#usda 1.0\n".to_owned();
    for level in 0..12 {
        let child = |index: usize| format!("def \"c{index}\" ( references = </l{}> ) {{}}\n", level + 1);
        text += &format!("def \"l{level}\" {{ {} }}\n", (0..10).map(child).collect::<String>());
    }
    text += "def \"l12\" {}\n";
    assert!(matches!(read(text.as_bytes()), Err(Error::TooLarge { .. })));
}

/// Each prim has a point and two references to the next one. Few levels are read; a few kilobytes cannot become
/// a hundred thousand prims.
#[test]
fn references_that_double_prims_are_read_within_limits() {
    let stage = |levels: usize| {
        let mut text = "#usda 1.0\n".to_owned();
        for level in 0..levels {
            let child = |name: &str| format!("def \"{name}\" ( references = </l{}> ) {{}}\n", level + 1);
            text += &format!("def \"l{level}\" {{ {ONE_POINT} {} {} }}\n", child("a"), child("b"));
        }
        format!("{text} def \"l{levels}\" {{}}")
    };
    assert_eq!(read(stage(5).as_bytes()).expect("few prims").positions.len(), 31 + 15 + 7 + 3 + 1);
    assert!(matches!(read(stage(15).as_bytes()), Err(Error::TooLarge { .. })));
}

const ONE_POINT: &str = "def Points \"p\" { point3f[] points = [(1, 2, 3)] }";

#[test]
fn packages_with_compressed_files_are_refused() {
    let text = usda_points().into_bytes();
    let error = read(&archive(&[("a.usda", text)], true)).expect_err("compressed").to_string();
    assert!(error.contains("`a.usda` of the package is compressed"), "{error}");
}

#[test]
fn binary_tables_that_are_no_tree_are_refused() {
    for (jumps, word) in [([-1, 1, -2], None), ([0, -2, -2], None), ([-1, 9, -2], Some("form a tree"))] {
        let mut layer = CrateBuilder::new([0, 8, 0]);
        for (index, jump) in jumps.into_iter().enumerate() {
            let kind = if index == 0 { 7 } else { 6 };
            layer.spec(["", "a", "b"][index], kind, jump, &[("specifier", inlined(42, 0))]);
        }
        let error = read(&layer.finish()).expect_err("no points").to_string();
        let expected = word.unwrap_or("no prims of the type Points");
        assert!(error.contains(expected) || error.contains("form a tree"), "{jumps:?}: {error}");
    }
}

#[test]
fn meshes_of_other_programs_are_read() {
    let text = b"#usda 1.0\ndef Xform \"x\" { double3 xformOp:scale = (-2, 2, 2) token[] xformOpOrder = [\"xformOp:scale\"]
        def Mesh \"m\" { point3f[] points = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)]
        int[] faceVertexCounts = [4, 3] int[] faceVertexIndices = [0, 1, 2, 3, 0, 2, 1] int[] holeIndices = [1] } }
        def Mesh \"n\" { uniform token orientation = \"leftHanded\" point3f[] points = [(5, 0, 0), (6, 0, 0), (6, 1, 0)]
        int[] faceVertexCounts = [3] int[] faceVertexIndices = [0, 1, 2] }";
    let mesh = read_mesh(text, "a", &Limits::default(), &|_| Ok(Vec::new())).expect("two meshes");
    assert_eq!(mesh.positions[..3], [[0.0; 3], [-2.0, 0.0, 0.0], [-2.0, 2.0, 0.0]]);
    assert_eq!(mesh.triangles, [[0, 2, 1], [0, 3, 2], [4, 6, 5]]);
}

#[test]
fn layers_without_prims_have_no_points() {
    for text in ["#usda 1.0\n", "#usda 1.0\n( upAxis = \"Z\" )\n"] {
        let error = read(text.as_bytes()).expect_err(text).to_string();
        assert!(error.contains("no prims of the type Points"), "{error}");
    }
    assert!(read(b"#usda 1.0").expect_err("half a line").is_truncated());
}

#[test]
fn obsolete_types_are_read() {
    let text = "#usda 1.0\ndef Points \"p\" { PointFloat[] points = [(1, 2, 3), (4, 5, 6)]
        Vec3f[] primvars:v = [(1, 2, 3), (4, 5, 6)] Vec2d[] primvars:w = [(1, 2), (3, 4)]
        Vector[] velocities = [(1, 2, 3), (4, 5, 6)] Vec3i[] primvars:c = [(1, 2, 3), (4, 5, 6)] }";
    let frame = read(text.as_bytes()).expect("points");
    assert_eq!(frame.positions, FilePositions::F32(vec![[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]));
    assert_eq!(*values(&frame, "v"), Values::F32(vec![1.0, 2.0, 3.0, 4.0, 5.0, 6.0]));
    assert_eq!(*values(&frame, "w"), Values::F64(vec![1.0, 2.0, 3.0, 4.0]));
    assert_eq!(*values(&frame, "velocities"), Values::F64(vec![1.0, 2.0, 3.0, 4.0, 5.0, 6.0]));
    assert_eq!(*values(&frame, "c"), Values::I32(vec![1, 2, 3, 4, 5, 6]));
}

#[test]
fn one_width_is_that_of_all_points() {
    for (name, radius, rest) in [
        ("widths", 0.25, "float[] widths = [0.5] ( interpolation = \"constant\" )"),
        ("widths", 0.25, "float[] widths = [0.5]"),
        ("widths", 0.25, "float[] primvars:widths = [0.5]"),
        ("pscale", 0.5, "float[] primvars:pscale = [0.5] ( interpolation = \"constant\" )"),
        ("widths", 0.25, "float[] widths.timeSamples = { 1: [0.5] }"),
    ] {
        let frame = read(stage(rest).as_bytes()).unwrap_or_else(|error| panic!("{rest}: {error}"));
        assert_eq!(frame.attributes[0].role, Some(AttributeRole::Radius), "{rest}");
        assert_eq!(*values(&frame, name), Values::F32(vec![radius; 2]), "{rest}");
    }
}

#[test]
fn damaged_files_of_packages_are_named() {
    let mut package = archive(&[("first.usda", stage("").into_bytes())], false);
    read(&package).expect("a package");
    let at = package.windows(9).position(|bytes| bytes == b"(4, 5, 6)").expect("a point");
    package[at + 1] = b'7';
    let error = read(&package).expect_err("another point").to_string();
    assert!(error.contains("the file `first.usda` of the package has the checksum"), "{error}");
}
