//! Sequences that are assembled from the .glb files of frames, read by other readers; and errors.

#![allow(clippy::cast_possible_truncation, reason = "test numbers are small")]

use std::io::{self, Cursor, Read, Seek, SeekFrom};

use meniscus_formats::gltf::{self, GlbFrame, SequenceFrame, UpAxis};
use meniscus_formats::{
    AttributeRole, ContainerFile, Error, FileAttribute, FilePositions, Format, Limits, MeshData, MeshOptions,
    MeshView, OpenFurther, OutputFormat, ParticleFrame, PointFormat, PointsSummary, ProbedKind,
    SequencePoints, Values, VertexAttribute, VertexValues, abc, container, read_particles, usda, usdc,
};

use crate::mesh_formats::of_numbers;

/// A pyramid over a polygon, and the options for writing it.
struct Frame {
    code: i64,
    sides: u32,
    origin: [f64; 3],
}

const FAR: [f64; 3] = [1e6, -2e6, 0.25];

/// The origin of later frames.
const MOVED: [f64; 3] = [1e6 + 64.5, -2e6 - 32.0, 0.25];

/// The rounding of a position relative to the origin of the first frame, at most 128 units away.
const MOVED_ROUNDING: f64 = 1e-5;

fn frames() -> Vec<Frame> {
    let frame = |code, sides, origin| Frame { code, sides, origin };
    vec![frame(5, 3, FAR), frame(6, 5, MOVED), frame(9, 0, MOVED), frame(10, 70_000, MOVED)]
}

type Triangles = Vec<[u32; 3]>;

impl Frame {
    /// Positions, normals, triangles.
    fn mesh(&self) -> (Vec<[f32; 3]>, Vec<[f32; 3]>, Triangles) {
        let base_corner = |i: u32| {
            let (sin, cos) = (f64::from(i) / f64::from(self.sides) * std::f64::consts::TAU).sin_cos();
            [cos as f32, sin as f32, 0.0]
        };
        let positions: Vec<[f32; 3]> =
            (0..self.sides).map(base_corner).chain((self.sides > 0).then_some([0.0, 0.0, 2.0])).collect();
        let triangles = (0..self.sides).map(|i| [i, (i + 1) % self.sides, self.sides]).collect();
        let normals = positions.iter().map(|p| if p[2] > 0.0 { [0.0, 0.0, 1.0] } else { *p }).collect();
        (positions, normals, triangles)
    }

    fn glb(&self, up: UpAxis) -> Vec<u8> {
        let (positions, normals, triangles) = self.mesh();
        let velocity: Vec<f32> = positions.iter().flat_map(|p| [p[0], 2.0, 0.0]).collect();
        let heat: Vec<f32> = positions.iter().map(|p| p[2]).collect();
        let attributes = [
            of_numbers("v", Some(AttributeRole::Velocity), 3, &velocity),
            of_numbers("Heat", None, 1, &heat),
        ];
        // One frame has fewer attributes.
        let attributes = &attributes[..if self.code == 6 { 1 } else { 2 }];
        let mesh = MeshView {
            positions: &positions,
            normals: &normals,
            triangles: &triangles,
            origin: self.origin,
            attributes,
        };
        let options = MeshOptions { up, ..MeshOptions::default() };
        let mut bytes = Vec::new();
        gltf::write_glb(&mesh, &options, &[("input".into(), format!("{}", self.code))], &mut bytes)
            .expect("written");
        bytes
    }
}

/// The frames of a sequence, and their files.
fn gathered(up: UpAxis) -> (Vec<SequenceFrame>, Vec<Vec<u8>>) {
    let files: Vec<Vec<u8>> = frames().iter().map(|frame| frame.glb(up)).collect();
    let shot = |(frame, bytes): (&Frame, &Vec<u8>)| SequenceFrame {
        name: format!("dam.{}", frame.code),
        code: frame.code,
        file: GlbFrame::read(&mut Cursor::new(bytes)).expect("our own file"),
    };
    (frames().iter().zip(&files).map(shot).collect(), files)
}

fn provenance() -> Vec<(String, String)> {
    vec![("generator".into(), "meniscus 0.1.0".into()), ("frames".into(), "4".into())]
}

fn glb_shot(up: UpAxis) -> Vec<u8> {
    let (shot, files) = gathered(up);
    let mut bytes = Vec::new();
    let open = |index: usize| Ok(Cursor::new(&files[index]));
    gltf::write_sequence(&shot, 25.0, &provenance(), open, &mut bytes).expect("written");
    bytes
}

fn usda_shot(up: UpAxis) -> (String, Vec<String>) {
    let (shot, files) = gathered(up);
    let mut bytes = Vec::new();
    let open = |index: usize| Ok(Cursor::new(&files[index]));
    let notes =
        usda::write_sequence(&shot, None, (25.0, 0.01), &provenance(), open, &mut bytes).expect("written");
    (String::from_utf8(bytes).expect("UTF-8"), notes)
}

fn usdc_shot(up: UpAxis) -> (Vec<u8>, Vec<String>) {
    let (shot, files) = gathered(up);
    let mut bytes = Cursor::new(Vec::new());
    let open = |index: usize| Ok(Cursor::new(&files[index]));
    let notes =
        usdc::write_sequence(&shot, None, (25.0, 0.01), &provenance(), open, &mut bytes).expect("written");
    (bytes.into_inner(), notes)
}

#[test]
fn glb_sequence_contains_the_data_of_every_frame() {
    for up in [UpAxis::Y, UpAxis::Z] {
        let bytes = glb_shot(up);
        let shot = ::gltf::Gltf::from_slice_without_validation(&bytes).expect("a document");
        let blob = shot.blob.as_ref().expect("data");
        let nodes: Vec<_> = shot.nodes().collect();
        let names: Vec<&str> = nodes.iter().filter_map(|node| node.name()).collect();
        assert_eq!(names, ["dam.5", "dam.6", "dam.10"]);
        let whole: Vec<Frame> = frames().into_iter().filter(|frame| frame.sides > 0).collect();
        for (node, frame) in nodes.iter().zip(whole) {
            let own = frame.glb(up);
            let own = ::gltf::Gltf::from_slice_without_validation(&own).expect("a document");
            let own_node = own.nodes().next().expect("a node");
            let ((translation, rotated, _), (own_translation, own_rotated, _)) =
                (node.transform().decomposed(), own_node.transform().decomposed());
            assert_eq!((translation, rotated), (own_translation, own_rotated));
            let primitives = [(&shot, node.mesh()), (&own, own_node.mesh())].map(|(file, mesh)| {
                (file, mesh.and_then(|mesh| mesh.primitives().next()).expect("a primitive"))
            });
            let data = primitives.map(|(file, primitive)| -> Vec<(String, Vec<u8>)> {
                let bytes = |accessor: ::gltf::Accessor| {
                    let view = accessor.view().expect("a view");
                    file.blob.as_ref().expect("data")[view.offset()..view.offset() + view.length()].to_vec()
                };
                let attributes = primitive
                    .attributes()
                    .map(|(semantic, accessor)| (semantic.to_string(), bytes(accessor)));
                attributes
                    .chain(primitive.indices().map(|accessor| ("indices".into(), bytes(accessor))))
                    .collect()
            });
            assert!(data[0] == data[1] && data[0].len() >= 4, "{}", frame.code);
        }
        // A frame is visible from half a frame before its time (the first: from one frame before) until the
        // next frame is visible.
        let animation = shot.animations().next().expect("an animation");
        let keys: Vec<(usize, Vec<f32>, Vec<f32>)> = animation
            .channels()
            .map(|channel| {
                assert_eq!(channel.sampler().interpolation(), ::gltf::animation::Interpolation::Step);
                let reader = channel.reader(|_| Some(blob));
                let times = reader.read_inputs().expect("times").collect();
                let Some(::gltf::animation::util::ReadOutputs::Scales(scales)) = reader.read_outputs() else {
                    panic!("no scales");
                };
                (channel.target().node().index(), times, scales.map(|[x, ..]| x).collect())
            })
            .collect();
        let expected = [
            (0, vec![0.0, 0.06], vec![1.0, 0.0]),
            (1, vec![0.0, 0.06, 0.18], vec![0.0, 1.0, 0.0]),
            (2, vec![0.0, 0.22, 0.26], vec![0.0, 1.0, 1.0]),
        ];
        assert_eq!(keys, expected);
        let at_rest: Vec<f32> = nodes.iter().map(|node| node.transform().decomposed().2[0]).collect();
        assert_eq!(at_rest, [1.0, 0.0, 0.0]);
    }
}

/// The last moment before frame 9.
const BEFORE_9: f64 = 9.0 - 1.0 / 64.0;

/// The samples in a .abc: the time in frames, and the index of the frame. A frame before missing frames has
/// two samples.
const ABC_SAMPLES: [(f64, usize); 5] = [(5.0, 0), (6.0, 1), (BEFORE_9, 1), (9.0, 2), (10.0, 3)];

#[test]
fn abc_sequence_has_a_sample_per_frame() {
    for up in [UpAxis::Y, UpAxis::Z] {
        let (shot, files) = gathered(up);
        let mut bytes = Vec::new();
        let open = |index: usize| Ok(Cursor::new(&files[index]));
        let notes = abc::write_sequence(&shot, None, 25.0, &provenance(), open, &mut bytes).expect("written");
        assert!(notes.len() == 1 && notes[0].starts_with("_HEAT is missing"), "{notes:?}");
        let limits = Limits::default();
        let times = abc::read_times(&bytes).expect("times");
        assert_eq!(times, ABC_SAMPLES.map(|(time, _)| time / 25.0));
        for (index, (number, frame)) in ABC_SAMPLES.into_iter().enumerate() {
            let mesh = abc::read_sample(&bytes, index, &limits).expect("a mesh");
            let expected = if frames()[frame].sides == 0 {
                MeshData::default()
            } else {
                gltf::read_mesh(&files[frame], &limits).expect("a mesh")
            };
            assert_eq!(mesh.triangles, expected.triangles, "{number}");
            assert_eq!(mesh.positions.len(), expected.positions.len(), "{number}");
            let apart = mesh.positions.as_flattened().iter().zip(expected.positions.as_flattened());
            assert!(apart.into_iter().all(|(a, b)| (a - b).abs() < MOVED_ROUNDING), "{number}");
        }
        assert!(matches!(abc::read_sample(&bytes, 5, &limits), Err(Error::Invalid { .. })));
        let open: &OpenFurther = &|_| Err(io::ErrorKind::NotFound.into());
        let (kind, file) =
            (ProbedKind::Format(Format::Abc), ContainerFile { file: &&*bytes, name: "", open });
        for (number, index) in [(4, 0), (5, 0), (6, 1), (7, 1), (8, 1), (9, 3), (10, 4), (99, 4)] {
            let mesh = container::scene_mesh(kind, &file, Some(number), &limits).expect("a mesh");
            assert_eq!(mesh, abc::read_sample(&bytes, index, &limits).expect("a mesh"), "{number}");
        }
        let (info, _) = abc::read_sequence_info(&mut Cursor::new(&bytes)).expect("read").expect("a sequence");
        let counts = frames().iter().map(|frame| u64::from(frame.sides)).sum::<u64>();
        assert_eq!((info.frames, info.vertices, info.triangles), (4, counts + 3, counts));
        let error = abc::read_mesh(&bytes, &limits).expect_err("several frames");
        assert!(matches!(error, Error::Unsupported { .. }), "{error}");
    }
}

#[test]
fn abc_sequence_without_missing_frames_has_uniform_times() {
    let (mut shot, files) = gathered(UpAxis::Y);
    shot.iter_mut().zip(7..).for_each(|(frame, code)| frame.code = code);
    let mut bytes = Vec::new();
    let open = |index: usize| Ok(Cursor::new(&files[index]));
    abc::write_sequence(&shot, None, 24.0, &provenance(), open, &mut bytes).expect("written");
    let times = abc::read_times(&bytes).expect("times");
    assert!(times.len() == 4 && times[0] == 7.0 / 24.0 && (times[3] - 10.0 / 24.0).abs() < 1e-12);
    shot[1].code = 7;
    let error = abc::write_sequence(&shot, None, 24.0, &[], open, &mut Vec::new()).expect_err("out of order");
    assert!(matches!(error, Error::Invalid { .. }), "{error}");
    assert!(abc::write_sequence(&[], None, 24.0, &[], open, &mut Vec::new()).is_err());
}

fn samples<'a>(text: &'a str, name: &str) -> Vec<(&'a str, &'a str)> {
    let start = text.split(&format!(" {name}.timeSamples = {{\n")).nth(1).unwrap_or_else(|| panic!("{name}"));
    let lines = start.split("\n        }\n").next().expect("an end").lines();
    lines.map(|line| line.trim().trim_end_matches(',').split_once(": ").expect("a time")).collect()
}

fn numbers(text: &str) -> Vec<f64> {
    let words = text.split([',', ' ', '(', ')', '[', ']']).filter(|word| !word.is_empty());
    words.map(|word| word.parse().unwrap_or_else(|_| panic!("{word} is not a number"))).collect()
}

#[test]
fn usda_sequence_has_a_sample_per_frame() {
    for up in [UpAxis::Y, UpAxis::Z] {
        let (text, notes) = usda_shot(up);
        assert!(text.contains(if up == UpAxis::Z { "upAxis = \"Z\"" } else { "upAxis = \"Y\"" }));
        assert!(text.contains("    startTimeCode = 5\n    timeCodesPerSecond = 25\n"));
        assert!(text.contains("    defaultPrim = \"root\"\n") && text.contains("    metersPerUnit = 0.01\n"));
        assert!(text.contains("\ndef Xform \"root\"\n{\n    def Mesh \"surface\"\n    {\n"));
        let [points, corners, extents] =
            ["points", "faceVertexIndices", "extent"].map(|name| samples(&text, name));
        let (_, origin) = text.split_once(" xformOp:translate = ").expect("a translation of all frames");
        let origin = numbers(origin.lines().next().expect("a value"));
        assert_eq!(origin, FAR);
        let velocities = samples(&text, "velocities");
        for (index, frame) in frames().iter().enumerate() {
            let (positions, _, triangles) = frame.mesh();
            let code = frame.code.to_string();
            assert!([&points, &corners].iter().all(|samples| samples[index].0 == code));
            let at = |samples: &[(&str, &str)], code: &str| {
                let found = samples.iter().find(|(other, _)| *other == code);
                numbers(found.unwrap_or_else(|| panic!("no sample at {code}")).1)
            };
            let found = numbers(points[index].1);
            // While frames are missing (here 7 and 8), the last value is held until the next frame.
            assert_eq!(at(&extents, &BEFORE_9.to_string()), at(&extents, "6"));
            assert_eq!(found.len(), 3 * positions.len());
            for (found, expected) in found.as_chunks::<3>().0.iter().zip(&positions) {
                for axis in 0..3 {
                    let (found, expected) =
                        (found[axis] + origin[axis], f64::from(expected[axis]) + frame.origin[axis]);
                    assert!(
                        (found - expected).abs() <= 1e-7 + 1e-9 * frame.origin[axis].abs(),
                        "{found} {expected}"
                    );
                }
            }
            assert_eq!(numbers(corners[index].1).len(), 3 * triangles.len());
            assert_eq!(numbers(velocities[index].1).len(), found.len());
            let extent = at(&extents, &code);
            if found.is_empty() {
                // The empty range, and not a box at the origin.
                let extent: Vec<f32> = extent.iter().map(|&x| x as f32).collect();
                assert_eq!(extent, [[f32::MAX; 3], [f32::MIN; 3]].concat());
            }
            for point in found.as_chunks::<3>().0 {
                assert!((0..3).all(|axis| extent[axis] <= point[axis] && point[axis] <= extent[axis + 3]));
            }
        }
        // The note names the attribute that one frame lacks.
        assert!(notes.len() == 1 && notes[0].starts_with("_HEAT is missing in the sequence"), "{notes:?}");
        let info = usda::read_layer_info(text.as_bytes()).expect("our own file").expect("figures");
        assert_eq!((info.frames, info.faces), (Some(4), 70_008));
    }
}

#[test]
fn usdc_sequence_has_a_sample_per_frame() {
    for up in [UpAxis::Y, UpAxis::Z] {
        let (bytes, notes) = usdc_shot(up);
        assert_eq!(notes, usda_shot(up).1);
        let layer = usdc::UsdcLayer::read(&bytes, &Limits::default()).expect("our own file");
        assert_eq!(layer.codes(), Some(&[5.0, 6.0, 9.0, 10.0][..]));
        assert_eq!((layer.info().frames, layer.info().faces), (Some(4), 70_008));
        for (index, frame) in frames().iter().enumerate() {
            let (positions, normals, triangles) = frame.mesh();
            let usdc::UsdcFrame { mesh, attributes } = layer.frame(index).expect("our own file");
            assert_eq!(mesh.triangles, triangles);
            assert_eq!(mesh.positions.len(), positions.len());
            for (found, position) in mesh.positions.iter().zip(&positions) {
                let is_near = |axis: usize| {
                    (found[axis] - frame.origin[axis] - f64::from(position[axis])).abs() <= MOVED_ROUNDING
                };
                assert!((0..3).all(is_near), "{found:?} is not {position:?}");
            }
            assert_eq!(mesh.normals.len(), normals.len());
            let [velocity] = &attributes[..] else { panic!("{attributes:?}") };
            let expected: Vec<f32> = positions.iter().flat_map(|p| [p[0], 2.0, 0.0]).collect();
            assert_eq!((&*velocity.name, velocity.arity), ("velocities", 3));
            assert_eq!(velocity.values, Values::F32(expected));
        }
        assert!(layer.frame(4).is_err());
        for length in (0..bytes.len()).rev().step_by(997).chain(0..3000) {
            assert!(usdc::UsdcLayer::read(&bytes[..length], &Limits::default()).is_err(), "{length}");
        }
    }
}

/// Three frames with the same mesh, from this number on: programs would interpolate between them.
fn equal_frames(first: i64) -> (Vec<SequenceFrame>, Vec<u8>) {
    let (shot, mut files) = gathered(UpAxis::Y);
    let frame = |code| SequenceFrame { code, ..shot[1].clone() };
    ((first..first + 3).map(frame).collect(), files.swap_remove(1))
}

#[test]
fn frames_with_the_same_number_of_vertices_are_repeated_just_before_the_next() {
    for (first, from) in [(1, 1.0), (-1, -1.0)] {
        let (frames, file) = equal_frames(first);
        let open = |_: usize| Ok(Cursor::new(&file));
        let times = [0.0, 1.0 - 1.0 / 64.0, 1.0, 2.0 - 1.0 / 64.0, 2.0].map(|time| from + time);
        let codes = times.map(|time| time.to_string());

        let mut text = Vec::new();
        usda::write_sequence(&frames, None, (24.0, 1.0), &[], open, &mut text).expect("written");
        let text = String::from_utf8(text).expect("UTF-8");
        assert!(text.contains(&format!("    startTimeCode = {first}\n")));
        for name in ["points", "velocities", "normals", "faceVertexIndices", "extent"] {
            let found: Vec<&str> = samples(&text, name).iter().map(|(code, _)| *code).collect();
            assert_eq!(found, codes, "{name}");
        }

        let mut bytes = Vec::new();
        abc::write_sequence(&frames, None, 24.0, &provenance(), open, &mut bytes).expect("written");
        assert_eq!(abc::read_times(&bytes).expect("times"), times.map(|time| time / 24.0));

        let mut bytes = Cursor::new(Vec::new());
        usdc::write_sequence(&frames, None, (24.0, 1.0), &[], open, &mut bytes).expect("written");
        let bytes = bytes.into_inner();
        let layer = usdc::UsdcLayer::read(&bytes, &Limits::default()).expect("our own file");
        assert_eq!(layer.codes(), Some(&[from, from + 1.0, from + 2.0][..]));
        let stored = times.map(f64::to_le_bytes);
        assert!(bytes.windows(40).any(|window| window == stored.as_flattened()));
    }
}

// Points beside the meshes.

/// The points of the frame with this number, far from the world's origin, as files of frames have them: three in frames
/// 5 and 6, and two in frame 10.
fn points(code: i64) -> ParticleFrame {
    let count = match code {
        5 | 6 => 3,
        10 => 2,
        _ => 0,
    };
    let index = |scale: f64| move |index: usize| scale * (index + 1) as f64;
    let reals = |arity: usize, scale: f64| {
        Values::F32((0..arity * count).map(index(scale)).map(|value| value as f32).collect())
    };
    // Frame 10 has integers that need 64 bits.
    let wide = if code == 10 { 1 << 40 } else { 7 };
    let ids = if code == 10 { Values::I64(vec![wide; count]) } else { Values::I32(vec![code as i32; count]) };
    let attribute =
        |name: &str, arity, role, values| FileAttribute { name: name.to_owned(), arity, role, values };
    let mut attributes = vec![
        attribute("id", 1, Some(AttributeRole::Id), ids),
        attribute("v", 3, Some(AttributeRole::Velocity), reals(3, code as f64)),
        attribute("radius", 1, Some(AttributeRole::Radius), reals(1, 0.25)),
        attribute("pair", 2, None, Values::I64(vec![wide; 2 * count])),
        attribute(
            "water",
            1,
            None,
            Values::Strings {
                table: if code == 6 { vec!["b".to_owned()] } else { vec!["a".to_owned(), "b".to_owned()] },
                indices: (0..count as i32).map(|index| if code == 6 { -index } else { index - 1 }).collect(),
            },
        ),
    ];
    if code == 6 {
        attributes.push(attribute("lost", 1, None, reals(1, 1.0)));
        attributes.rotate_left(1);
    }
    let position = |index: usize| {
        let along = |axis: usize| FAR[axis] + (code * (axis as i64 + 1)) as f64 + index as f64 / 64.0;
        [along(0), along(1), along(2)]
    };
    let positions = FilePositions::F64((0..count).map(position).collect());
    ParticleFrame { positions, attributes, notes: Vec::new() }
}

/// The sequence of the frames with their points, in USD as text and in binary, and in Alembic, with this provenance; and
/// the notes.
fn shots_with_points(up: UpAxis, provenance: &[(String, String)]) -> ([Vec<u8>; 3], Vec<String>) {
    let (shot, files) = gathered(up);
    let open = |index: usize| Ok(Cursor::new(&files[index]));
    let summary = |frame: &Frame| PointsSummary::of(&points(frame.code)).expect("points");
    let summaries = frames().iter().map(summary).collect();
    let points = SequencePoints::new(summaries, Box::new(|index| Ok(points(frames()[index].code))));
    let (units, beside) = ((25.0, 0.01), Some(&points));
    let (mut text, mut binary, mut archive) = (Vec::new(), Cursor::new(Vec::new()), Vec::new());
    let notes = [
        usda::write_sequence(&shot, beside, units, provenance, open, &mut text),
        usdc::write_sequence(&shot, beside, units, provenance, open, &mut binary),
        abc::write_sequence(&shot, beside, 25.0, provenance, open, &mut archive),
    ];
    let [first, others @ ..] = notes.map(|notes| notes.expect("written"));
    assert!(others.iter().all(|notes| *notes == first), "{first:?} {others:?}");
    ([text, binary.into_inner(), archive], first)
}

const FORMATS: [Format; 3] = [Format::Usda, Format::Usdc, Format::Abc];

/// The frames of particles in a file: their times, in frames, and the particles.
fn particles_in(format: Format, bytes: &[u8]) -> Result<Vec<(f64, ParticleFrame)>, Error> {
    let open: &OpenFurther = &|_| Err(io::ErrorKind::NotFound.into());
    let (kind, file, limits) =
        (ProbedKind::Format(format), ContainerFile { file: &bytes, name: "", open }, Limits::default());
    let frames = container::frames(kind, &file, &limits)?;
    let frame = |(index, sample): (usize, &meniscus_formats::Sample)| {
        let packed = container::packed(kind, &file, &frames, index, &limits)?;
        Ok((25.0 * sample.time.expect("a time"), read_particles(&packed, "", &limits)?))
    };
    frames.samples.iter().enumerate().map(frame).collect()
}

fn reals_of(values: &Values) -> Vec<f64> {
    match values {
        Values::F32(values) => values.iter().map(|&value| value.into()).collect(),
        Values::F64(values) => values.clone(),
        Values::I32(values) => values.iter().map(|&value| value.into()).collect(),
        Values::I64(values) => values.iter().map(|&value| value as f64).collect(),
        values => panic!("{values:?}"),
    }
}

/// The strings of an attribute; none for a missing one.
fn strings_of(values: &Values) -> Vec<&str> {
    let Values::Strings { table, indices } = values else { panic!("{values:?}") };
    indices.iter().map(|&index| table.get(index as usize).map_or("", String::as_str)).collect()
}

#[test]
fn points_beside_the_meshes_have_a_sample_per_frame() {
    for up in [UpAxis::Y, UpAxis::Z] {
        let (shots, notes) = shots_with_points(up, &[]);
        assert!(notes.len() == 2 && notes[1].starts_with("lost of the points is missing"), "{notes:?}");
        for (format, bytes) in FORMATS.into_iter().zip(&shots) {
            let found = particles_in(format, bytes).expect("points");
            let times: Vec<f64> = found.iter().map(|(time, _)| (64.0 * time).round() / 64.0).collect();
            // Frames 5 and 6 have as many points. In Alembic, all objects have samples at the same times.
            let is_abc = format == Format::Abc;
            let before_6 = 6.0 - 1.0 / 64.0;
            let held = is_abc.then_some(BEFORE_9);
            let expected: Vec<f64> =
                [5.0, before_6, 6.0].into_iter().chain(held).chain([9.0, 10.0]).collect();
            assert_eq!(times, expected);
            for (time, frame) in &found {
                let code = (*time + 1e-9).floor() as i64;
                let wanted = points(if code == 8 { 6 } else { code });
                let turned = |values: &[f64]| -> Vec<f64> {
                    let turn = |&[x, y, z]: &[f64; 3]| {
                        if is_abc && up == UpAxis::Z { [x, z, -y] } else { [x, y, z] }
                    };
                    values.as_chunks::<3>().0.iter().flat_map(turn).collect()
                };
                let positions = |frame: &ParticleFrame| -> Vec<f64> {
                    match &frame.positions {
                        FilePositions::F64(positions) => positions.as_flattened().to_vec(),
                        FilePositions::F32(positions) => {
                            positions.iter().flatten().map(|&x| x.into()).collect()
                        }
                    }
                };
                assert_eq!(positions(frame), turned(&positions(&wanted)), "{format:?} {time}");
                if code == 9 {
                    continue;
                }
                let of_role = |frame: &ParticleFrame, role| -> Vec<f64> {
                    let found = frame.attributes.iter().find(|attribute| attribute.role == Some(role));
                    reals_of(&found.unwrap_or_else(|| panic!("{role:?}: {:?}", frame.attributes)).values)
                };
                for role in [AttributeRole::Id, AttributeRole::Radius] {
                    assert_eq!(of_role(frame, role), of_role(&wanted, role), "{format:?} {time} {role:?}");
                }
                let velocity = of_role(&wanted, AttributeRole::Velocity);
                assert_eq!(of_role(frame, AttributeRole::Velocity), turned(&velocity), "{format:?} {time}");
                let named = |frame: &ParticleFrame, name: &str| {
                    frame.attributes.iter().find(|attribute| attribute.name == name).cloned().expect("found")
                };
                let pair = named(frame, "pair");
                assert_eq!(pair.arity, 2);
                assert!(matches!(pair.values, Values::I64(_)), "{format:?}: the type is that of all frames");
                assert_eq!(pair.values, named(&wanted, "pair").values);
                let (water, wanted) = (named(frame, "water").values, named(&wanted, "water").values);
                assert_eq!(strings_of(&water), strings_of(&wanted), "{format:?} {time}");
                assert_eq!(frame.attributes.len(), 5, "{:?}", frame.attributes);
            }
        }
        let text = String::from_utf8(shots[0].clone()).expect("UTF-8");
        assert!(text.contains(
            "\n    def Points \"surface_spray\"\n    {\n        float3[] extent.timeSamples = {\n"
        ));
        assert!(
            text.ends_with("# end: 4 frames, 70011 vertices, 70008 faces, 8 points\n"),
            "{}",
            &text[text.len() - 80..]
        );
        assert_eq!(usda::read_attribute_names(text.as_bytes()), ["velocities"]);
        // Only ids that are narrow in all frames are in the file twice.
        assert!(!text.contains("primvars:id"), "{text}");
    }
}

/// The meshes of a sequence are the same with points as without, and it has no particles.
#[test]
fn sequence_with_points_is_read_as_meshes() {
    let limits = Limits::default();
    let (shots, _) = shots_with_points(UpAxis::Z, &provenance());
    for (format, bytes) in FORMATS.into_iter().zip(&shots) {
        let error = particles_in(format, bytes).expect_err("no particles");
        assert!(error.to_string().contains("this is a mesh, not particles"), "{format:?}: {error}");
    }
    let [_, binary, archive] = &shots;
    let (plain, _) = usdc_shot(UpAxis::Z);
    let [plain, beside] = [&plain, binary].map(|bytes| usdc::UsdcLayer::read(bytes, &limits).expect("ours"));
    assert_eq!((plain.codes(), plain.info()), (beside.codes(), beside.info()));
    for index in 0..4 {
        assert!(plain.frame(index).expect("a frame") == beside.frame(index).expect("a frame"), "{index}");
    }
    let (info, attributes) =
        abc::read_sequence_info(&mut Cursor::new(archive)).expect("read").expect("a sequence");
    assert_eq!((info.frames, info.vertices, attributes), (4, 70_011, vec!["velocity".to_owned()]));
    let mesh = |time| {
        let index = abc::read_times(archive).expect("times").iter().position(|known| *known == time / 25.0);
        abc::read_sample(archive, index.expect("a sample"), &limits).expect("a mesh")
    };
    assert!(mesh(5.0) == mesh(6.0 - 1.0 / 64.0) && mesh(5.0) != mesh(6.0));
}

/// Sequences have the points of files in any format, so these must be as they were before.
#[test]
fn points_are_read_as_they_were_written() {
    let attribute =
        |name: &str, arity, role, values| FileAttribute { name: name.to_owned(), arity, role, values };
    let reals = |arity: usize| Values::F32((0..2 * arity).map(|index| 0.125 * index as f32).collect());
    let frame = ParticleFrame {
        positions: FilePositions::F32(vec![[1.0, 2.0, 3.0], [4.0, -5.0, 6.5]]),
        attributes: vec![
            attribute("id", 1, Some(AttributeRole::Id), Values::I32(vec![7, -1])),
            attribute("v", 3, Some(AttributeRole::Velocity), reals(3)),
            attribute("radius", 1, Some(AttributeRole::Radius), reals(1)),
            attribute("Cd", 4, Some(AttributeRole::Color), reals(4)),
            attribute("acceleration", 3, Some(AttributeRole::Acceleration), reals(3)),
            attribute("rest", 3, None, reals(3)),
            attribute("spray_class", 1, None, Values::I32(vec![0, 3])),
        ],
        notes: Vec::new(),
    };
    let expected = PointsSummary::of(&frame).expect("points");
    let sequence = |read: ParticleFrame| {
        let summary = PointsSummary::of(&read).expect("points");
        assert_eq!(summary.count(), expected.count());
        let (shot, files) = gathered(UpAxis::Y);
        let points = SequencePoints::new(vec![summary], Box::new(move |_| Ok(read.clone())));
        let (mut text, open) = (Vec::new(), |index: usize| Ok(Cursor::new(&files[index])));
        let notes = usda::write_sequence(&shot[..1], Some(&points), (24.0, 1.0), &[], open, &mut text);
        assert_eq!(notes.expect("written"), [""; 0]);
        let text = String::from_utf8(text).expect("UTF-8");
        text.split_once("    def Points ").expect("points").1.to_owned()
    };
    let written = sequence(frame.clone());
    assert!(written.contains("float[] primvars:displayOpacity.timeSamples"), "{written}");
    for format in PointFormat::ALL {
        for up in [UpAxis::Y, UpAxis::Z] {
            let (options, mut bytes) = (MeshOptions { up, ..MeshOptions::default() }, Vec::new());
            format.write(&frame, &options, &provenance()[..1], &mut bytes).expect("written");
            let read = format.read(&bytes, &Limits::default()).expect("our own file");
            assert_eq!(sequence(read), written, "{format:?} {up:?}");
            for length in 0..bytes.len() {
                let _ = format.read(&bytes[..length], &Limits::default());
            }
        }
    }
}

#[test]
fn points_that_cannot_be_read_again_are_an_error() {
    let (shot, files) = gathered(UpAxis::Y);
    let open = |index: usize| Ok(Cursor::new(&files[index]));
    let summary = |frame: &Frame| PointsSummary::of(&points(frame.code)).expect("points");
    let changed = |_: usize| Ok(points(10));
    let points = SequencePoints::new(frames().iter().map(summary).collect(), Box::new(changed));
    let (units, points) = ((25.0, 1.0), Some(&points));
    let outcomes = [
        usda::write_sequence(&shot, points, units, &[], open, &mut Vec::new()),
        usdc::write_sequence(&shot, points, units, &[], open, &mut Cursor::new(Vec::new())),
        abc::write_sequence(&shot, points, 25.0, &[], open, &mut Vec::new()),
    ];
    for outcome in outcomes {
        assert!(matches!(outcome, Err(Error::Invalid { .. })), "{outcome:?}");
    }
}

#[test]
fn usdc_sequence_contains_equal_arrays_once() {
    let (shot, files) = gathered(UpAxis::Y);
    let sequence_of = |count: i64| {
        let frame = |code| SequenceFrame { code, ..shot[3].clone() };
        let frames: Vec<SequenceFrame> = (0..count).map(frame).collect();
        let mut bytes = Cursor::new(Vec::new());
        let open = |_: usize| Ok(Cursor::new(&files[3]));
        usdc::write_sequence(&frames, None, (24.0, 1.0), &[], open, &mut bytes).expect("written");
        bytes.into_inner()
    };
    let (one, three) = (sequence_of(1), sequence_of(3));
    assert!(three.len() < one.len() + 2000, "{} bytes, {} bytes", one.len(), three.len());
    let limits = Limits::default();
    let [one, three] =
        [&one, &three].map(|bytes| usdc::UsdcLayer::read(bytes, &limits).expect("our own file"));
    let expected = one.frame(0).expect("a frame");
    assert_eq!(three.codes(), Some(&[0.0, 1.0, 2.0][..]));
    for index in 0..3 {
        assert!(three.frame(index).expect("a frame") == expected, "{index}");
    }
    let error = usdc::to_glb(sequence_of(1), &limits).expect_err("a sequence").to_string();
    assert!(error.contains("this file is a sequence"), "{error}");
}

#[test]
fn invalid_sequences_are_errors() {
    let (mut shot, files) = gathered(UpAxis::Y);
    let open = |index: usize| -> io::Result<_> { Ok(Cursor::new(&files[index])) };
    let both = |shot: &[SequenceFrame]| {
        let glb = gltf::write_sequence(shot, 24.0, &[], open, &mut Vec::new());
        (glb, usda::write_sequence(shot, None, (24.0, 1.0), &[], open, &mut Vec::new()).map(|_| ()))
    };
    // Frames with the same time, and frames with different up axes.
    shot[1].code = 5;
    assert!(matches!(both(&shot), (Err(Error::Invalid { .. }), Err(Error::Invalid { .. }))));
    shot[1].code = 6;
    let rotated = frames()[1].glb(UpAxis::Z);
    shot[1].file = GlbFrame::read(&mut Cursor::new(&rotated)).expect("our own file");
    assert!(matches!(both(&shot), (_, Err(Error::Invalid { .. }))));
    // A file that changed after it was opened.
    let (shot, mut files) = gathered(UpAxis::Y);
    files[3].truncate(2000);
    let open = |index: usize| -> io::Result<_> { Ok(Cursor::new(&files[index])) };
    assert!(gltf::write_sequence(&shot, 24.0, &[], open, &mut Vec::new()).is_err());
    assert!(usda::write_sequence(&shot, None, (24.0, 1.0), &[], open, &mut Vec::new()).is_err());
    assert!(usdc::write_sequence(&shot, None, (24.0, 1.0), &[], open, &mut Cursor::new(Vec::new())).is_err());
    // A sequence with only empty frames is an empty scene.
    let (shot, files) = gathered(UpAxis::Y);
    let open = |_: usize| -> io::Result<_> { Ok(Cursor::new(&files[2])) };
    let mut bytes = Vec::new();
    gltf::write_sequence(&shot[2..3], 24.0, &[], open, &mut bytes).expect("written");
    assert_eq!(gltf::read_mesh(&bytes, &Default::default()).expect("a scene").positions.len(), 0);
}

#[test]
fn other_and_damaged_files_are_not_frames() {
    let read = |bytes: &[u8]| GlbFrame::read(&mut Cursor::new(bytes));
    assert!(matches!(read(&glb_shot(UpAxis::Y)), Err(Error::Unsupported { .. })));
    assert!(read(b"").is_err() && read(b"ply\n").is_err());
    let whole = frames()[1].glb(UpAxis::Z);
    for length in 0..whole.len() {
        assert!(read(&whole[..length]).is_err(), "{length}");
    }
    let mut state = 1u64;
    let mut below = |end: usize| {
        state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
        (state >> 33) as usize % end
    };
    for _ in 0..20_000 {
        let mut broken = whole.clone();
        for _ in 0..1 + below(3) {
            let at = below(broken.len());
            broken[at] =
                if below(2) == 0 { broken[at] ^ 1 << below(8) } else { b"0123456789-e. [{\"]}"[below(19)] };
        }
        // A file that is accepted as a frame may be invalid in a sequence, but nothing may panic.
        if let Ok(file) = read(&broken) {
            let shot = [SequenceFrame { name: "a".into(), code: 1, file }];
            let open = |_: usize| -> io::Result<_> { Ok(Cursor::new(&broken)) };
            let _ = gltf::write_sequence(&shot, 24.0, &[], open, &mut Vec::new());
            let _ = usda::write_sequence(&shot, None, (24.0, 1.0), &[], open, &mut Vec::new());
            let _ = usdc::write_sequence(&shot, None, (24.0, 1.0), &[], open, &mut Cursor::new(Vec::new()));
        }
    }
}

/// A triangle with these attributes.
fn triangle(attributes: &[VertexAttribute]) -> Vec<u8> {
    let mesh = MeshView {
        positions: &[[0.0; 3], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]],
        normals: &[[0.0, 0.0, 1.0]; 3],
        triangles: &[[0, 1, 2]],
        origin: [0.0; 3],
        attributes,
    };
    let mut bytes = Vec::new();
    gltf::write_glb(&mesh, &MeshOptions::default(), &[], &mut bytes).expect("written");
    bytes
}

/// The .usda sequence of this single frame, and its notes.
fn usda_of(bytes: &[u8]) -> Result<(String, Vec<String>), Error> {
    let file = GlbFrame::read(&mut Cursor::new(bytes))?;
    let shot = [SequenceFrame { name: "a".into(), code: 1, file }];
    let mut text = Vec::new();
    let notes = usda::write_sequence(&shot, None, (24.0, 1.0), &[], |_| Ok(Cursor::new(bytes)), &mut text)?;
    Ok((String::from_utf8(text).expect("UTF-8"), notes))
}

#[test]
fn usda_properties_have_unique_names() {
    let values = [1.0, 2.0, 3.0];
    let names = ["_heat", "heat", "__heat", "2nd", "_2nd", "normals", "displayColor", "x"];
    let attributes = names.map(|name| of_numbers(name, None, 1, &values));
    let (text, notes) = usda_of(&triangle(&attributes)).expect("a sequence");
    let properties: Vec<&str> =
        text.lines().filter_map(|line| line.trim().strip_suffix(".timeSamples = {")).collect();
    let mut names: Vec<&str> = properties.iter().filter_map(|name| name.split(' ').nth(1)).collect();
    names.sort_unstable();
    let primvars: Vec<&str> = names.iter().filter_map(|name| name.strip_prefix("primvars:")).collect();
    assert_eq!(
        primvars,
        ["_2nd", "_2nd_2", "__heat", "_heat", "displayColor_2", "heat", "normals_2", "x"],
        "{notes:?}"
    );
    names.dedup();
    assert_eq!(names.len(), properties.len());
    for note_start in ["primvars:_2nd_2 ", "primvars:displayColor_2 ", "primvars:normals_2 "] {
        assert!(notes.iter().any(|note| note.contains(note_start)), "{note_start}: {notes:?}");
    }
    assert_eq!(notes.len(), 3, "{notes:?}");
}

#[test]
fn sequences_name_attributes_as_single_frames_do() {
    let values = [0.25; 9];
    let attribute = |name, role, arity| of_numbers(name, role, arity, &values[..3 * arity]);
    let attributes = [
        attribute("color", Some(AttributeRole::Color), 3),
        attribute("Temperature", None, 1),
        attribute("temperature", None, 1),
        attribute("v", Some(AttributeRole::Velocity), 3),
        attribute("age", None, 1),
    ];
    let glb = triangle(&attributes);
    let json = String::from_utf8_lossy(&glb).into_owned();
    // Files have no name that follows from the name in glTF.
    let names = r#""names":{"COLOR_0":"color","_TEMPERATURE":"Temperature","_TEMPERATURE_2":"temperature"}"#;
    assert!(json.contains(names), "{json}");

    let file = GlbFrame::read(&mut Cursor::new(&glb)).expect("our own file");
    let shot = [SequenceFrame { name: "a".into(), code: 1, file }];
    let open = |_: usize| Ok(Cursor::new(&glb));
    let (mut frame, mut sequence) = (Vec::new(), Vec::new());
    abc::write_sequence(&shot, None, 24.0, &[], open, &mut sequence).expect("written");
    let mesh = MeshView {
        positions: &[[0.0; 3], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]],
        normals: &[[0.0, 0.0, 1.0]; 3],
        triangles: &[[0, 1, 2]],
        origin: [0.0; 3],
        attributes: &attributes,
    };
    abc::write(&mesh, &MeshOptions::default(), &[], &mut frame).expect("written");
    for bytes in [&frame, &sequence] {
        let text = String::from_utf8_lossy(bytes);
        let has = |name: &str| text.contains(&format!("{}{name}", char::from(name.len() as u8)));
        assert!(["color", "Temperature", "temperature_2", "age"].into_iter().all(has));
        assert!(!has("Cd") && !has("temperature"));
    }
    let (text, notes) = usda_of(&glb).expect("a sequence");
    for name in ["displayColor", "Temperature", "temperature_2", "age"] {
        assert!(text.contains(&format!(" primvars:{name}.timeSamples")), "{name}: {notes:?}");
    }
    assert_eq!(notes.len(), 1, "{notes:?}");
}

#[test]
fn accelerations_are_a_property_of_usd_meshes_and_an_attribute_elsewhere() {
    let values = [0.0, -9.81, 0.0, 1.0, 2.0, 3.0, -1.0, 0.5, 0.25];
    let vectors = |name, role| of_numbers(name, Some(role), 3, &values);
    let attributes = [vectors("v", AttributeRole::Velocity), vectors("accel", AttributeRole::Acceleration)];
    let mesh = MeshView {
        positions: &[[0.0; 3], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]],
        normals: &[[0.0, 0.0, 1.0]; 3],
        triangles: &[[0, 1, 2]],
        origin: [0.0; 3],
        attributes: &attributes,
    };
    let limits = Limits::default();
    let is_acceleration = |attribute: &FileAttribute| {
        (&*attribute.name, attribute.role, &attribute.values)
            == ("accelerations", Some(AttributeRole::Acceleration), &Values::F32(values.to_vec()))
    };
    let mut usdc_frame = Vec::new();
    OutputFormat::Usdc
        .write_mesh(&mesh, &MeshOptions::default(), &[], &mut usdc_frame)
        .expect("writing to memory");
    let layer = usdc::UsdcLayer::read(&usdc_frame, &limits).expect("our own file");
    assert!(layer.frame(0).expect("our own file").attributes.iter().any(is_acceleration));

    let mut abc_frame = Vec::new();
    OutputFormat::Abc
        .write_mesh(&mesh, &MeshOptions::default(), &[], &mut abc_frame)
        .expect("writing to memory");

    // The frames of a sequence can be .glb, .usdc or .abc. In a .usdc they have no name other than that of
    // the property.
    let (of_usdc, _) = usdc::to_glb(&usdc_frame, &limits).expect("converted");
    let (of_abc, _) = abc::to_glb(&abc_frame, &limits).expect("converted");
    for (glb, name) in [(triangle(&attributes), "accel"), (of_usdc, "acceleration"), (of_abc, "accel")] {
        let (text, notes) = usda_of(&glb).expect("a sequence");
        assert_eq!(numbers(samples(&text, "vector3f[] accelerations")[0].1).len(), values.len());
        assert!(!text.contains("primvars:") && notes.is_empty(), "{notes:?}");
        let file = GlbFrame::read(&mut Cursor::new(&glb)).expect("our own file");
        let shot = [SequenceFrame { name: "a".into(), code: 1, file }];
        let open = |_: usize| Ok(Cursor::new(&glb));
        let mut bytes = Cursor::new(Vec::new());
        usdc::write_sequence(&shot, None, (24.0, 1.0), &[], open, &mut bytes).expect("written");
        let bytes = bytes.into_inner();
        let layer = usdc::UsdcLayer::read(&bytes, &limits).expect("our own file");
        assert!(layer.frame(0).expect("our own file").attributes.iter().any(is_acceleration));
        let mut archive = Vec::new();
        abc::write_sequence(&shot, None, 24.0, &[], open, &mut archive).expect("written");
        let header = [&[name.len() as u8], name.as_bytes()].concat();
        assert!(archive.windows(header.len()).any(|window| window == header), "{name}");
    }
}

#[test]
fn strings_missing_in_a_usda_sequence_get_a_note() {
    let table = ["a".to_owned()];
    let values = VertexValues::Strings { table: &table, indices: &[0, 0, -1] };
    let (text, notes) = usda_of(&triangle(&[VertexAttribute { name: "kind", role: None, arity: 1, values }]))
        .expect("a sequence");
    assert!(!text.contains("primvars:"), "{text}");
    assert!(
        notes.len() == 1 && notes[0].starts_with("_KIND is missing in the sequence: its values are strings"),
        "{notes:?}"
    );
}

#[test]
fn vertex_indices_out_of_range_are_an_error() {
    let whole = triangle(&[]);
    assert!(usda_of(&whole).is_ok());
    // The indices are the last data before the padding to four bytes.
    let corners = [0u16, 1, 2].map(u16::to_le_bytes).concat();
    let at = whole.windows(6).rposition(|window| window == corners).expect("the corners");
    for (corner, index) in [(3u16, 0), (u16::MAX, 4)] {
        let mut broken = whole.clone();
        broken[at + index..][..2].copy_from_slice(&corner.to_le_bytes());
        let error = usda_of(&broken).expect_err("no such vertex");
        assert!(
            error.to_string().contains(&format!("vertex index {corner}, but the mesh has 3 vertices")),
            "{error}"
        );
    }
    // An attribute with fewer values than vertices.
    let values = VertexValues::Numbers(&[1.0, 2.0, 3.0]);
    let whole = triangle(&[VertexAttribute { name: "heat", role: None, arity: 1, values }]);
    let scalar =
        |count: u32| format!("\"componentType\":5126,\"count\":{count},\"type\":\"SCALAR\"").into_bytes();
    let at = whole.windows(scalar(3).len()).position(|window| window == scalar(3)).expect("the accessor");
    let broken = [&whole[..at], &scalar(2), &whole[at + scalar(2).len()..]].concat();
    let error = usda_of(&broken).expect_err("a value missing");
    assert!(error.to_string().contains("the positions and _HEAT do not match"), "{error}");
}

/// Counts the bytes that are read.
struct Counted<'a>(Cursor<&'a [u8]>, usize);

impl Read for Counted<'_> {
    fn read(&mut self, bytes: &mut [u8]) -> io::Result<usize> {
        let count = self.0.read(bytes)?;
        self.1 += count;
        Ok(count)
    }
}

impl Seek for Counted<'_> {
    fn seek(&mut self, to: SeekFrom) -> io::Result<u64> {
        self.0.seek(to)
    }
}

#[test]
fn summary_of_a_sequence_needs_only_the_ends_of_its_file() {
    let (shot, files) = gathered(UpAxis::Y);
    let open = |index: usize| Ok(Cursor::new(&files[index]));
    let mut archive = Vec::new();
    abc::write_sequence(&shot, None, 25.0, &provenance(), open, &mut archive).expect("written");
    let (layer, _) = usdc_shot(UpAxis::Y);
    let counts = frames().iter().map(|frame| u64::from(frame.sides)).sum::<u64>();

    let mut file = Counted(Cursor::new(&layer), 0);
    let (info, names) = usdc::read_layer_info(&mut file, &Limits::default()).expect("a sequence");
    assert_eq!((info.frames, info.vertices, info.faces), (Some(4), counts + 3, counts));
    assert_eq!(names, ["velocities"]);
    assert!(file.1 < layer.len() / 20, "{} of {} bytes", file.1, layer.len());

    let mut file = Counted(Cursor::new(&archive), 0);
    let (info, names) = abc::read_sequence_info(&mut file).expect("an archive").expect("a sequence");
    assert_eq!((info.frames, info.vertices, info.triangles), (4, counts + 3, counts));
    assert_eq!(names, ["velocity"]);
    assert!(file.1 < archive.len() / 20, "{} of {} bytes", file.1, archive.len());

    // A truncated file is an error, wherever it ends.
    for bytes in [&layer, &archive] {
        for end in [10, 90, bytes.len() / 2, bytes.len() - 1] {
            let mut file = Cursor::new(&bytes[..end]);
            assert!(usdc::read_layer_info(&mut file, &Limits::default()).is_err());
            assert!(abc::read_sequence_info(&mut file).is_err());
        }
    }
}
