//! Stages of several layers, and samples over time. The files are texts in memory.

use std::io;

use super::mesh;
use super::points::READER;
use crate::core::batches::ReadAt;
use crate::core::container::{ContainerFile, Sample};
use crate::core::data::{FilePositions, ParticleFrame, Values};
use crate::core::error::{Error, Result};
use crate::core::limits::Limits;
use crate::core::row::ReadParticles;

/// A file in memory that can be opened.
struct TextInMemory(String);

impl ReadAt for TextInMemory {
    fn size_bytes(&self) -> io::Result<u64> {
        self.0.as_bytes().size_bytes()
    }

    fn read_exact_at(&self, out: &mut [u8], offset: u64) -> io::Result<()> {
        self.0.as_bytes().read_exact_at(out, offset)
    }
}

/// Calls a function with a stage, of which the first file is the stage itself. A name without a file is an error.
fn with_stage<T>(files: &[(&str, &str)], of: impl FnOnce(&ContainerFile) -> T) -> T {
    let text = |body: &str| TextInMemory(format!("#usda 1.0\n{body}"));
    let open = |path: &str| -> io::Result<Box<dyn ReadAt>> {
        let (_, body) = files.iter().find(|(name, _)| *name == path).ok_or(io::ErrorKind::NotFound)?;
        Ok(Box::new(text(body)))
    };
    of(&ContainerFile { file: &text(files[0].1), name: files[0].0, open: &open })
}

/// The frames of a stage, or the first error.
fn frames(files: &[(&str, &str)]) -> Result<Vec<(Sample, ParticleFrame)>> {
    let ReadParticles::Sample(reader) = &READER.read else { panic!("the reader reads samples") };
    let limits = Limits::default();
    with_stage(files, |file| {
        let frames = (reader.open)(file, &limits)?;
        let samples = frames.samples.iter().enumerate();
        samples.map(|(index, sample)| Ok((*sample, frames.read(file, index, &limits)?))).collect()
    })
}

/// The x coordinates of the only frame, and its notes.
fn line(files: &[(&str, &str)]) -> (Vec<f64>, String) {
    let mut found = frames(files).unwrap_or_else(|error| panic!("{files:?}: {error}"));
    assert_eq!(found.len(), 1, "{files:?}");
    let frame = found.remove(0).1;
    (xs(&frame), frame.notes.join("\n"))
}

fn xs(frame: &ParticleFrame) -> Vec<f64> {
    match &frame.positions {
        FilePositions::F32(positions) => positions.iter().map(|[x, ..]| f64::from(*x)).collect(),
        FilePositions::F64(positions) => positions.iter().map(|[x, ..]| *x).collect(),
    }
}

fn points(name: &str, x: f64) -> String {
    format!("def Points \"{name}\" {{ point3f[] points = [({x}, 0, 0)] }}\n")
}

const MOVED: &str = "double3 xformOp:translate = (10, 0, 0) token[] xformOpOrder = [\"xformOp:translate\"]";

#[test]
fn layers_are_composed_by_strength() {
    let asset = format!(
        "( defaultPrim = \"A\" ) def \"A\" {{ {} }} def \"B\" {{ {} }}
        class \"C\" ( variants = {{ string v = \"b\" }} ) {{ {} }}",
        points("p", 1.0),
        points("p", 2.0),
        points("p", 5.0)
    );
    let asset = asset.as_str();
    for (root, expected) in [
        ("def \"R\" ( references = @a.usda@ ) {}", vec![1.0]),
        ("def \"R\" ( payload = @./a.usda@</B> ) {}", vec![2.0]),
        ("def \"R\" ( prepend references = [@a.usda@</B>, @a.usda@] ) {}", vec![2.0]),
        ("def \"R\" ( references = @a.usda@ ) { over \"p\" { point3f[] points = [(5, 0, 0)] } }", vec![5.0]),
        (
            "def \"R\" ( references = @a.usda@ ) { over \"p\" ( active = false ) {} def Points \"q\" { point3f[] points = [] } }",
            vec![],
        ),
        (&format!("def Xform \"R\" ( references = @a.usda@ ) {{ {MOVED} }}"), vec![11.0]),
        (
            "( subLayers = [@a.usda@] ) over \"B\" { over \"p\" { point3f[] points = [(7, 0, 0)] } }",
            vec![1.0, 7.0],
        ),
        ("( subLayers = [@a.usda@] ) over \"B\" ( active = false ) {}", vec![1.0]),
        ("def \"R\" ( references = @a.usda@ ) {} def \"S\" ( references = </R> ) {}", vec![1.0, 1.0]),
        (
            "class \"C\" { def Points \"p\" { point3f[] points = [(4, 0, 0)] } } def \"R\" ( inherits = </C> ) {}",
            vec![4.0],
        ),
        (
            "def \"R\" ( variants = { string v = \"b\" } prepend variantSets = \"v\" ) { variantSet \"v\" = {
            \"a\" { def Points \"p\" { point3f[] points = [(1, 0, 0)] } }
            \"b\" ( references = @a.usda@</B> ) { } } }",
            vec![2.0],
        ),
        ("def \"R\" ( references = @dir/b.usda@ ) {}", vec![1.0]),
        // The prim that refers to it selects the variant, against its own selection.
        (
            "def \"R\" ( references = </V> variants = { string v = \"b\" } ) {}
            class \"V\" ( variants = { string v = \"a\" } prepend variantSets = \"v\" ) { variantSet \"v\" = {
            \"a\" { def Points \"p\" { point3f[] points = [(3, 0, 0)] } }
            \"b\" { def Points \"p\" { point3f[] points = [(4, 0, 0)] } } } }",
            vec![4.0],
        ),
        // The reference selects the variant, and is weaker than it.
        (
            "def \"R\" ( prepend variantSets = \"v\" references = @a.usda@</C> ) { variantSet \"v\" = {
            \"a\" { over \"p\" { point3f[] points = [(3, 0, 0)] } }
            \"b\" { over \"p\" { point3f[] points = [(4, 0, 0)] } } } }",
            vec![4.0],
        ),
    ] {
        let further = "( defaultPrim = \"X\" ) def \"X\" ( references = @../a.usda@ ) {}";
        assert_eq!(
            line(&[("r.usda", root), ("a.usda", asset), ("dir/b.usda", further)]).0,
            expected,
            "{root}"
        );
    }
    let (_, notes) = line(&[("r.usda", "( subLayers = [@a.usda@] )"), ("a.usda", asset)]);
    assert!(notes.contains("joined the particles of 2 prims"), "{notes}");
}

#[test]
fn layers_that_refer_to_each_other_are_refused() {
    for (root, other) in [
        ("( subLayers = [@a.usda@] )", "( subLayers = [@r.usda@] )"),
        ("def \"R\" ( references = @a.usda@</R> ) {}", "def \"R\" ( references = @r.usda@</R> ) {}"),
        ("def \"R\" ( references = @missing.usda@ ) {}", "def \"R\" {}"),
        ("def \"R\" ( references = @a.usda@ ) {}", "def \"R\" {}"),
    ] {
        let error = frames(&[("r.usda", root), ("a.usda", other)]).expect_err(root);
        assert!(matches!(error, Error::Unsupported { .. } | Error::TooLarge { .. }), "{root}: {error}");
    }
}

#[test]
fn layers_that_are_not_usd_are_left_out() {
    let others =
        "( subLayers = [@sub/set.abc@] ) def \"M\" ( references = @../looks/wood.MTLX@</MaterialX> ) {} ";
    let root = format!("{others}{}", points("p", 1.0));
    let (found, notes) = line(&[("r.usda", &root)]);
    assert_eq!(found, [1.0]);
    assert_eq!(notes, "left out layers that are not USD: ../looks/wood.MTLX, sub/set.abc");
    for (files, words) in [
        (
            &[("r.usda", others)][..],
            "no prims of the type Points or PointInstancer; it has no others; left out",
        ),
        (
            &[("r.usda", "def \"R\" ( references = @a.usda@</R> ) {}"), ("a.usda", "def \"R\" {")],
            "at line 2: a.usda: the text ends too early",
        ),
        (
            &[("r.usda", "def \"R\" ( references = @../a.usda@ ) {}")],
            "/R: it names the file \"../a.usda\", which is outside of its own folder: move the files into one folder",
        ),
        (
            &[("r.usda", "def \"R\" ( references = @b.usdz[a.usda]@ ) {}")],
            "/R refers to the layer b.usdz[a.usda]: it is within a package: unpack the package",
        ),
    ] {
        let error = frames(files).expect_err(words).to_string();
        assert!(error.contains(words), "expected `{words}` in: {error}");
    }
}

#[test]
fn time_samples_are_frames() {
    let samples = "( timeCodesPerSecond = 50 ) def Xform \"x\" {
        double3 xformOp:translate.timeSamples = { 1: (0, 0, 0), 5: (40, 0, 0) }
        token[] xformOpOrder = [\"xformOp:translate\"]
        def Points \"p\" { point3f[] points.timeSamples = { 2: [(0, 0, 0)], 4: [(1, 0, 0)] }
            float[] widths.timeSamples = { 2: [1], 4: [3] } int64[] ids = [9] }
        def Points \"q\" { point3f[] points.timeSamples = { 2: [(5, 0, 0)], 3: [(6, 0, 0)], 4: [(7, 0, 0), (8, 0, 0)] } } }";
    let found = frames(&[("r.usda", samples)]).expect("three frames");
    let numbers: Vec<(i64, Option<f64>)> =
        found.iter().map(|(sample, _)| (sample.number, sample.time)).collect();
    assert_eq!(numbers, [(2, Some(0.04)), (3, Some(0.06)), (4, Some(0.08))]);
    // In frame 3, the points of p are halfway between their samples.
    let expected = [vec![10.0, 15.0], vec![20.5, 26.0], vec![31.0, 37.0, 38.0]];
    for ((_, frame), expected) in found.iter().zip(expected) {
        assert_eq!(xs(frame), expected);
    }
    assert!(found[1].1.notes.iter().any(|note| note.contains("/x/p are interpolated")));
    // Only p has them.
    assert!(found.iter().all(|(_, frame)| frame.attributes.is_empty()));

    let still = "def Xform \"x\" { double xformOp:rotateZ.timeSamples = { 0.5: 0, 1.5: 90 }
        token[] xformOpOrder = [\"xformOp:rotateZ\"] def Points \"p\" { point3f[] points = [(1, 0, 0)]
        vector3f[] velocities = [(0, 1, 0)] } }";
    let found = frames(&[("r.usda", still)]).expect("two frames");
    assert_eq!((found[0].0.number, found[1].0), (0, Sample { number: 1, time: Some(0.0625) }));
    let FilePositions::F64(positions) = &found[1].1.positions else { panic!("64 bits") };
    assert!(positions[0][0].abs() < 1e-15 && (positions[0][1] - 1.0).abs() < 1e-15);
    assert!(matches!(&found[1].1.attributes[0].values, Values::F32(velocity) if velocity[0] == -1.0));
}

#[test]
fn layers_are_retimed() {
    let asset = "( timeCodesPerSecond = 48 ) def \"A\" { def Points \"p\" { point3f[] points.timeSamples = { 0: [(0, 0, 0)], 48: [(1, 0, 0)] } } }";
    let root = "def \"R\" ( references = @a.usda@</A> (offset = 10; scale = 2) ) {}";
    let found = frames(&[("r.usda", root), ("a.usda", asset)]).expect("two frames");
    assert_eq!(found.iter().map(|(sample, _)| sample.number).collect::<Vec<_>>(), [10, 58]);
}

#[test]
fn animated_meshes_are_read_at_a_time() {
    let text = "def Xform \"x\" { double3 xformOp:translate.timeSamples = { 1: (0, 0, 0), 11: (10, 0, 0) }
        token[] xformOpOrder = [\"xformOp:translate\"]
        def Mesh \"m\" { point3f[] points = [(0, 0, 0), (1, 0, 0), (0, 1, 0)] int[] faceVertexCounts = [3]
            int[] faceVertexIndices = [0, 1, 2] } }";
    let limits = Limits::default();
    with_stage(&[("m.usda", text)], |file| {
        assert!((mesh::READER.are_animated)(file, &limits).expect("a stage"));
        for (number, x) in [(None, 0.0), (Some(1), 0.0), (Some(3), 2.0), (Some(99), 10.0), (Some(-9), 0.0)] {
            let mesh = (mesh::READER.read)(file, number, &limits).expect("a mesh");
            assert_eq!(mesh.positions[0], [x, 0.0, 0.0], "{number:?}");
        }
    });
}
