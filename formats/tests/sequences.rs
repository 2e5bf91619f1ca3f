//! Sequences that are assembled from the .glb files of frames, read by other readers; and errors.

#![allow(clippy::cast_possible_truncation, reason = "test numbers are small")]

use std::io::{self, Cursor, Read, Seek, SeekFrom};

use meniscus_formats::gltf::{self, GlbFrame, SequenceFrame, UpAxis};
use meniscus_formats::{
    AttributeRole, ContainerFile, Error, FileAttribute, FilePositions, Format, Limits, MeshData, MeshOptions,
    MeshView, OpenFurther, OutputFormat, ParticleFrame, PointFormat, PointsSummary, ProbedKind,
    SequencePoints, Values, VertexAttribute, VertexValues, abc, container, particles_of, to_glb, usdc,
    write_abc_sequence,
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
        let notes = write_abc_sequence(&shot, None, 25.0, &provenance(), open, &mut bytes).expect("written");
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
    write_abc_sequence(&shot, None, 24.0, &provenance(), open, &mut bytes).expect("written");
    let times = abc::read_times(&bytes).expect("times");
    assert!(times.len() == 4 && times[0] == 7.0 / 24.0 && (times[3] - 10.0 / 24.0).abs() < 1e-12);
    shot[1].code = 7;
    let error = write_abc_sequence(&shot, None, 24.0, &[], open, &mut Vec::new()).expect_err("out of order");
    assert!(matches!(error, Error::Invalid { .. }), "{error}");
    assert!(write_abc_sequence(&[], None, 24.0, &[], open, &mut Vec::new()).is_err());
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
        let mut bytes = Vec::new();
        write_abc_sequence(&frames, None, 24.0, &provenance(), open, &mut bytes).expect("written");
        assert_eq!(abc::read_times(&bytes).expect("times"), times.map(|time| time / 24.0));
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

/// The sequence of the frames with their points, with this provenance, and the notes.
fn shot_with_points(up: UpAxis, provenance: &[(String, String)]) -> (Vec<u8>, Vec<String>) {
    let (shot, files) = gathered(up);
    let open = |index: usize| Ok(Cursor::new(&files[index]));
    let summary = |frame: &Frame| PointsSummary::of(&points(frame.code)).expect("points");
    let summaries = frames().iter().map(summary).collect();
    let points = SequencePoints::new(summaries, Box::new(|index| Ok(points(frames()[index].code))));
    let mut archive = Vec::new();
    let notes = write_abc_sequence(&shot, Some(&points), 25.0, provenance, open, &mut archive);
    (archive, notes.expect("written"))
}

/// The frames of particles in a file: their times, in frames, and the particles.
fn particles_in(bytes: &[u8]) -> Result<Vec<(f64, ParticleFrame)>, Error> {
    let open: &OpenFurther = &|_| Err(io::ErrorKind::NotFound.into());
    let (kind, file, limits) =
        (ProbedKind::Format(Format::Abc), ContainerFile { file: &bytes, name: "", open }, Limits::default());
    let frames = container::frames(kind, &file, &limits)?;
    let frame = |(index, sample): (usize, &meniscus_formats::Sample)| {
        let loaded = container::read_sample(kind, &file, &frames, index, &limits)?;
        Ok((25.0 * sample.time.expect("a time"), particles_of(loaded, "", &[], &limits)?))
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
        let (archive, notes) = shot_with_points(up, &[]);
        assert!(notes.len() == 2 && notes[1].starts_with("lost of the points is missing"), "{notes:?}");
        let found = particles_in(&archive).expect("points");
        let times: Vec<f64> = found.iter().map(|(time, _)| (64.0 * time).round() / 64.0).collect();
        // Frames 5 and 6 have as many points. All objects have samples at the same times.
        assert_eq!(times, [5.0, 6.0 - 1.0 / 64.0, 6.0, BEFORE_9, 9.0, 10.0]);
        for (time, frame) in &found {
            let code = (*time + 1e-9).floor() as i64;
            let wanted = points(if code == 8 { 6 } else { code });
            let turned = |values: &[f64]| -> Vec<f64> {
                let turn = |&[x, y, z]: &[f64; 3]| {
                    if up == UpAxis::Z { [x, z, -y] } else { [x, y, z] }
                };
                values.as_chunks::<3>().0.iter().flat_map(turn).collect()
            };
            let positions = |frame: &ParticleFrame| -> Vec<f64> {
                match &frame.positions {
                    FilePositions::F64(positions) => positions.as_flattened().to_vec(),
                    FilePositions::F32(positions) => positions.iter().flatten().map(|&x| x.into()).collect(),
                }
            };
            assert_eq!(positions(frame), turned(&positions(&wanted)), "{time}");
            if code == 9 {
                continue;
            }
            let of_role = |frame: &ParticleFrame, role| -> Vec<f64> {
                let found = frame.attributes.iter().find(|attribute| attribute.role == Some(role));
                reals_of(&found.unwrap_or_else(|| panic!("{role:?}: {:?}", frame.attributes)).values)
            };
            for role in [AttributeRole::Id, AttributeRole::Radius] {
                assert_eq!(of_role(frame, role), of_role(&wanted, role), "{time} {role:?}");
            }
            let velocity = of_role(&wanted, AttributeRole::Velocity);
            assert_eq!(of_role(frame, AttributeRole::Velocity), turned(&velocity), "{time}");
            let named = |frame: &ParticleFrame, name: &str| {
                frame.attributes.iter().find(|attribute| attribute.name == name).cloned().expect("found")
            };
            let pair = named(frame, "pair");
            assert_eq!(pair.arity, 2);
            assert!(matches!(pair.values, Values::I64(_)), "the type is that of all frames");
            assert_eq!(pair.values, named(&wanted, "pair").values);
            let (water, wanted) = (named(frame, "water").values, named(&wanted, "water").values);
            assert_eq!(strings_of(&water), strings_of(&wanted), "{time}");
            assert_eq!(frame.attributes.len(), 5, "{:?}", frame.attributes);
        }
    }
}

/// The meshes of a sequence are the same with points as without, and it has no particles.
#[test]
fn sequence_with_points_is_read_as_meshes() {
    let limits = Limits::default();
    let (archive, _) = shot_with_points(UpAxis::Z, &provenance());
    let error = particles_in(&archive).expect_err("no particles");
    assert!(error.to_string().contains("this is a mesh, not particles"), "{error}");
    let (info, attributes) =
        abc::read_sequence_info(&mut Cursor::new(&archive)).expect("read").expect("a sequence");
    assert_eq!((info.frames, info.vertices, attributes), (4, 70_011, vec!["velocity".to_owned()]));
    let mesh = |time| {
        let index = abc::read_times(&archive).expect("times").iter().position(|known| *known == time / 25.0);
        abc::read_sample(&archive, index.expect("a sample"), &limits).expect("a mesh")
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
        let (mut archive, open) = (Vec::new(), |index: usize| Ok(Cursor::new(&files[index])));
        let notes = write_abc_sequence(&shot[..1], Some(&points), 24.0, &[], open, &mut archive);
        assert_eq!(notes.expect("written"), [""; 0]);
        archive
    };
    let written = sequence(frame.clone());
    for format in PointFormat::ALL {
        for up in [UpAxis::Y, UpAxis::Z] {
            let (options, mut bytes) = (MeshOptions { up, ..MeshOptions::default() }, Vec::new());
            format.write(&frame, &options, &provenance()[..1], &mut bytes).expect("written");
            let read = format.read(&bytes, &Limits::default()).expect("our own file");
            assert!(sequence(read) == written, "{format:?} {up:?}");
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
    let outcome = write_abc_sequence(&shot, Some(&points), 25.0, &[], open, &mut Vec::new());
    assert!(matches!(outcome, Err(Error::Invalid { .. })), "{outcome:?}");
}

#[test]
fn invalid_sequences_are_errors() {
    let (mut shot, files) = gathered(UpAxis::Y);
    let open = |index: usize| -> io::Result<_> { Ok(Cursor::new(&files[index])) };
    let both = |shot: &[SequenceFrame]| {
        let glb = gltf::write_sequence(shot, 24.0, &[], open, &mut Vec::new());
        (glb, write_abc_sequence(shot, None, 24.0, &[], open, &mut Vec::new()).map(|_| ()))
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
    assert!(write_abc_sequence(&shot, None, 24.0, &[], open, &mut Vec::new()).is_err());
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
            let _ = write_abc_sequence(&shot, None, 24.0, &[], open, &mut Vec::new());
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

/// The .abc sequence of this single frame, and its notes.
fn sequence_of(bytes: &[u8]) -> Result<(Vec<u8>, Vec<String>), Error> {
    let file = GlbFrame::read(&mut Cursor::new(bytes))?;
    let shot = [SequenceFrame { name: "a".into(), code: 1, file }];
    let mut archive = Vec::new();
    let notes = write_abc_sequence(&shot, None, 24.0, &[], |_| Ok(Cursor::new(bytes)), &mut archive)?;
    Ok((archive, notes))
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

    let (sequence, _) = sequence_of(&glb).expect("a sequence");
    let mut frame = Vec::new();
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
    assert!(layer.frame().expect("our own file").attributes.iter().any(is_acceleration));

    let mut abc_frame = Vec::new();
    OutputFormat::Abc
        .write_mesh(&mesh, &MeshOptions::default(), &[], &mut abc_frame)
        .expect("writing to memory");

    // The frames of a sequence can be .glb, .usdc or .abc. In a .usdc they have no name other than that of
    // the property.
    let (of_usdc, _) = to_glb(&usdc_frame, &limits).expect("converted");
    let (of_abc, _) = to_glb(&abc_frame, &limits).expect("converted");
    for (glb, name) in [(triangle(&attributes), "accel"), (of_usdc, "acceleration"), (of_abc, "accel")] {
        let (archive, notes) = sequence_of(&glb).expect("a sequence");
        assert!(notes.is_empty(), "{notes:?}");
        let header = [&[name.len() as u8], name.as_bytes()].concat();
        assert!(archive.windows(header.len()).any(|window| window == header), "{name}");
    }
}

#[test]
fn strings_missing_in_a_sequence_get_a_note() {
    let table = ["a".to_owned()];
    let values = VertexValues::Strings { table: &table, indices: &[0, 0, -1] };
    let (_, notes) =
        sequence_of(&triangle(&[VertexAttribute { name: "kind", role: None, arity: 1, values }]))
            .expect("a sequence");
    assert!(
        notes.len() == 1 && notes[0].starts_with("_KIND is missing in the sequence: its values are strings"),
        "{notes:?}"
    );
}

#[test]
fn vertex_indices_out_of_range_are_an_error() {
    let whole = triangle(&[]);
    assert!(sequence_of(&whole).is_ok());
    // The indices are the last data before the padding to four bytes.
    let corners = [0u16, 1, 2].map(u16::to_le_bytes).concat();
    let at = whole.windows(6).rposition(|window| window == corners).expect("the corners");
    for (corner, index) in [(3u16, 0), (u16::MAX, 4)] {
        let mut broken = whole.clone();
        broken[at + index..][..2].copy_from_slice(&corner.to_le_bytes());
        let error = sequence_of(&broken).expect_err("no such vertex");
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
    let error = sequence_of(&broken).expect_err("a value missing");
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
    write_abc_sequence(&shot, None, 25.0, &provenance(), open, &mut archive).expect("written");
    let counts = frames().iter().map(|frame| u64::from(frame.sides)).sum::<u64>();

    let mut file = Counted(Cursor::new(&archive), 0);
    let (info, names) = abc::read_sequence_info(&mut file).expect("an archive").expect("a sequence");
    assert_eq!((info.frames, info.vertices, info.triangles), (4, counts + 3, counts));
    assert_eq!(names, ["velocity"]);
    assert!(file.1 < archive.len() / 20, "{} of {} bytes", file.1, archive.len());

    // A truncated file is an error, wherever it ends.
    for end in [10, 90, archive.len() / 2, archive.len() - 1] {
        assert!(abc::read_sequence_info(&mut Cursor::new(&archive[..end])).is_err());
    }
}
