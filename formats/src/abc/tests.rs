//! Points in archives that are built here, with the parts of our own writer.

use super::archive::Archive;
use super::document::{AbcObject, AbcProperty, DATA, Ogawa, Pod, StoredSample, Times, write_archive};
use super::mesh::names;
use super::points::{READER, frame_numbers};
use super::read::MESHES;
use super::scene::operation_matrix;
use super::*;
use crate::core::container::{ContainerFile, OpenFurther};
use crate::core::data::{FilePositions, ParticleFrame};
use crate::core::matrix::{IDENTITY, transformed};

/// The seed of the fuzz target, which the tests with damaged files also use.
const SEED: &[u8] = include_bytes!("../../../tests/fuzz/corpus/abc/points.abc");

/// The frames of the samples, at 24 frames per second.
const FRAMES: [f64; 3] = [1.0, 2.0, 4.0];

/// Two objects under an animated transform, and one that is hidden.
///
/// ```text
///   turned   Xform: translation 10, 20, 30 │ rotation by 90° about z │ scale 2
///     a      Points: 2, 1, 2 particles, all attributes
///     b      Points: 1 particle, some of the attributes
///   hidden   Points
/// ```
fn points_archive() -> Vec<u8> {
    let mut bytes = Vec::new();
    let times = Times::Frames { times: FRAMES.into(), fps: 24.0 };
    write_archive(&[], &times, |ogawa| Ok(vec![root(ogawa)?]), &mut bytes).expect("written");
    bytes
}

fn root(ogawa: &mut Ogawa) -> Result<AbcObject> {
    let operations = ogawa.small_sample(1, &[0x10, 0x60, 0x00])?;
    let values = [10.0, 20.0, 30.0].map(|x: f64| {
        let values = [x, 0.0, 0.0, 90.0, 2.0, 2.0, 2.0];
        ogawa.small_sample(1, &values.map(f64::to_le_bytes).concat())
    });
    let values = values.into_iter().collect::<Result<_>>()?;
    let transform = vec![
        AbcProperty::scalar(names::OPERATIONS, "", (Pod::U8, 3), vec![operations]),
        AbcProperty::scalar(names::MATRIX, "", (Pod::F64, 7), values),
    ];
    let visible = ogawa.small_sample(1, &[0])?;
    let mut hidden = points("hidden", &[&[[9.0; 3]]], Vec::new(), ogawa)?;
    hidden.properties.push(AbcProperty::scalar(names::VISIBLE, "", (Pod::U8, 1), vec![visible]));
    let (two, one): (&[_], &[_]) = (&[[1.0, 0.0, 0.0], [0.0, 1.0, 0.5]], &[[0.0; 3]]);
    let full = attributes(ogawa)?;
    let some = vec![real(names::WIDTHS, "geoScope=con", &[0.5], 1, ogawa)?];
    let a = points("a", &[two, one, two], full, ogawa)?;
    let b = points("b", &[&[[0.0, 0.0, 3.0]]], some, ogawa)?;
    Ok(AbcObject {
        name: "turned".to_owned(),
        metadata: "schema=AbcGeom_Xform_v3".to_owned(),
        properties: vec![AbcProperty::compound(names::TRANSFORM, "", transform)],
        children: vec![a, b, hidden],
    })
}

fn attributes(ogawa: &mut Ogawa) -> Result<Vec<AbcProperty>> {
    let ids = ogawa.small_sample(2, &[7u64, 8].map(u64::to_le_bytes).concat())?;
    let table = ogawa.small_sample(2, b"oil\0water\0")?;
    let indices = ogawa.small_sample(2, &[1u32, 0].map(u32::to_le_bytes).concat())?;
    let texts = vec![
        AbcProperty::array(".vals", "", (Pod::String, 1), vec![table]),
        AbcProperty::array(".indices", "", (Pod::U32, 1), vec![indices]),
    ];
    let params = vec![
        real("heat", "geoScope=var", &[0.5, 1.5], 1, ogawa)?,
        real("gain", "geoScope=con", &[1.0], 1, ogawa)?,
        real("spin", "geoScope=vtx;interpretation=normal", &[1.0, 0.0, 0.0, 0.0, 0.0, 1.0], 3, ogawa)?,
        AbcProperty::compound("phase", "geoScope=var", texts),
    ];
    Ok(vec![
        AbcProperty::array(names::IDS, "", (Pod::I64, 1), vec![ids]),
        real(names::VELOCITIES, "interpretation=vector", &[1.0, 0.0, 0.0, 0.0, 0.0, 3.0], 3, ogawa)?,
        real(names::WIDTHS, "geoScope=var", &[0.25, 0.5], 1, ogawa)?,
        AbcProperty::compound(names::PARAMS, "", params),
    ])
}

fn real(name: &str, metadata: &str, values: &[f32], extent: u8, ogawa: &mut Ogawa) -> Result<AbcProperty> {
    let count = values.len() as u64 / u64::from(extent);
    let sample = real_sample(values, (count, extent.into()), ogawa)?;
    Ok(AbcProperty::array(name, metadata, (Pod::F32, extent), vec![sample]))
}

fn points(
    name: &str,
    samples: &[&[[f32; 3]]],
    mut properties: Vec<AbcProperty>,
    ogawa: &mut Ogawa,
) -> Result<AbcObject> {
    let samples: Vec<StoredSample> = samples
        .iter()
        .map(|points| real_sample(points.as_flattened(), (points.len() as u64, 3), ogawa))
        .collect::<Result<_>>()?;
    properties.push(AbcProperty::array(names::POSITIONS, "geoScope=vtx", (Pod::F32, 3), samples));
    Ok(AbcObject {
        name: name.to_owned(),
        metadata: "schema=AbcGeom_Points_v1;schemaObjTitle=AbcGeom_Points_v1:.geom".to_owned(),
        properties: vec![AbcProperty::compound(names::GEOMETRY, "", properties)],
        children: Vec::new(),
    })
}

fn with_file<T>(bytes: &[u8], run: impl FnOnce(&ContainerFile) -> T) -> T {
    let open: &OpenFurther = &|_| Err(std::io::ErrorKind::NotFound.into());
    run(&ContainerFile { file: &bytes, name: "a.abc", open })
}

fn read(bytes: &[u8], index: usize) -> Result<ParticleFrame> {
    read_points(bytes, index, &Limits::default())
}

/// `name arity role values` of each attribute.
fn described(frame: &ParticleFrame) -> Vec<String> {
    let described = |attribute: &FileAttribute| {
        let FileAttribute { name, arity, role, values } = attribute;
        format!("{name} {arity} {role:?} {values:?}")
    };
    frame.attributes.iter().map(described).collect()
}

fn rounded(frame: &ParticleFrame) -> Vec<[f64; 3]> {
    let FilePositions::F64(positions) = &frame.positions else { panic!("they are transformed") };
    positions.iter().map(|point| point.map(|along| (along * 1e9).round() / 1e9 + 0.0)).collect()
}

#[test]
fn points_of_all_objects_are_read_in_world_space() {
    let bytes = points_archive();
    assert!(bytes == SEED, "write these bytes to tests/fuzz/corpus/abc/points.abc: {}", bytes.escape_ascii());
    let samples = with_file(&bytes, |file| (READER.open)(file, &Limits::default())).expect("samples").samples;
    let stated: Vec<_> = samples.iter().map(|sample| (sample.number, sample.time)).collect();
    assert_eq!(stated, [(1, Some(1.0 / 24.0)), (2, Some(2.0 / 24.0)), (4, Some(4.0 / 24.0))]);

    let frame = read(&bytes, 0).expect("read");
    assert_eq!(rounded(&frame), [[10.0, 2.0, 0.0], [8.0, 0.0, 1.0], [10.0, 0.0, 6.0]]);
    assert_eq!(described(&frame), ["width 1 Some(Radius) F32([0.25, 0.5, 0.5])"]);
    let notes = [
        "scaled the widths by the transforms of the points",
        "the velocities of a do not include the movement of its parents",
        "skipped `gain`: it has one value for all particles",
        "skipped 1 hidden Points",
        "joined the particles of 2 Points",
        "skipped the array `heat`: it is not the same in all Points",
        "skipped the array `id`: it is not the same in all Points",
        "skipped the array `phase`: it is not the same in all Points",
        "skipped the array `spin`: it is not the same in all Points",
        "skipped the array `velocity`: it is not the same in all Points",
        "`width` looks like a diameter: the radius is half of it",
    ];
    assert_eq!(frame.notes, notes);
    // One particle, with two values of each attribute.
    let frame = read(&bytes, 1).expect("read");
    assert_eq!(rounded(&frame), [[20.0, 0.0, 0.0], [20.0, 0.0, 6.0]]);
    assert!(described(&frame).is_empty(), "{:?}", frame.attributes);
    assert!(read(&bytes, 3).is_err_and(|error| error.to_string().contains("no frame 3: the file has 3")));
}

#[test]
fn attributes_have_their_usual_names_and_are_rotated() {
    let mut bytes = Vec::new();
    let object = |ogawa: &mut Ogawa| {
        let mut root = root(ogawa)?;
        root.children.truncate(1);
        Ok(vec![root])
    };
    write_archive(&[], &Times::Frames { times: FRAMES.into(), fps: 24.0 }, object, &mut bytes)
        .expect("written");
    let frame = read(&bytes, 2).expect("read");
    let found = described(&frame);
    let zeros_removed: Vec<String> = found.iter().map(|text| text.replace("-4.371139e-8", "0.0")).collect();
    assert_eq!(found[0], "id 1 Some(Id) I64([7, 8])", "{zeros_removed:?}");
    assert!(
        found[1].starts_with("velocity 3 Some(Velocity)") && found[1].contains("2.0, 0.0, 0.0, 0.0, 6.0")
    );
    assert_eq!(found[2], "width 1 Some(Radius) F32([0.25, 0.5])");
    assert_eq!(found[3], "heat 1 None F32([0.5, 1.5])");
    assert!(found[4].starts_with("spin 3 None"), "{}", found[4]);
    assert_eq!(found[5], "phase 1 Some(Kind) Strings { table: [\"oil\", \"water\"], indices: [1, 0] }");
}

#[test]
fn operations_of_transforms_are_those_of_alembic() {
    let table: [(u8, &[f64], [f64; 3]); 7] = [
        (0, &[2.0, 3.0, 4.0], [2.0, 6.0, 12.0]),
        (1, &[2.0, 3.0, 4.0], [3.0, 5.0, 7.0]),
        (2, &[0.0, 0.0, 5.0, 90.0], [-2.0, 1.0, 3.0]),
        (
            3,
            &[0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 7.0, 8.0, 9.0, 1.0],
            [10.0, 9.0, 11.0],
        ),
        (4, &[90.0], [1.0, -3.0, 2.0]),
        (5, &[90.0], [3.0, 2.0, -1.0]),
        (6, &[90.0], [-2.0, 1.0, 3.0]),
    ];
    for (operation, values, expected) in table {
        let found = transformed(&operation_matrix(operation, values), [1.0, 2.0, 3.0], 1.0);
        assert!((0..3).all(|axis| (found[axis] - expected[axis]).abs() < 1e-12), "{operation}: {found:?}");
    }
    assert_eq!(operation_matrix(2, &[0.0; 4]), IDENTITY);
}

#[test]
fn times_of_whole_frames_give_their_numbers() {
    let ntsc = [1001.0, 1002.0, 1003.0].map(|frame| frame * 1001.0 / 24000.0);
    let table: [(&[f64], Option<&[i64]>); 9] = [
        (&[], None),
        (&[0.5], None),
        (&[0.0, 1.0 / 24.0, 2.0 / 24.0], Some(&[0, 1, 2])),
        (&[-1.0 / 30.0, 1.0 / 30.0, 2.0 / 30.0], Some(&[-1, 1, 2])),
        (&[1.0, 2.0], Some(&[1, 2])),
        (&[0.0, 0.25 / 24.0, 1.0 / 24.0], Some(&[0, 1, 4])),
        (&ntsc, Some(&[1001, 1002, 1003])),
        (&[0.0, 0.1, 0.25], None),
        (&[0.0, 1e-300, f64::INFINITY], None),
    ];
    for (times, numbers) in table {
        assert_eq!(frame_numbers(times).as_deref(), numbers, "{times:?}");
    }
}

#[test]
fn archives_without_points_or_in_hdf5_are_named() {
    let hdf5 = [archive::HDF5, &[0; 100]].concat();
    let error = crate::read_particles(&hdf5, "a.abc", &Limits::default()).expect_err("HDF5").to_string();
    assert!(error.contains("save it again as Ogawa"), "{error}");
    let mut mesh = Vec::new();
    let triangle = MeshView {
        positions: &[[0.0; 3], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]],
        normals: &[[0.0, 0.0, 1.0]; 3],
        triangles: &[[0, 1, 2]],
        origin: [0.0; 3],
        attributes: &[],
    };
    write(&triangle, &MeshOptions::default(), &[], &mut mesh).expect("written");
    let error = read(&mesh, 0).expect_err("a mesh").to_string();
    assert!(error.contains("this is a mesh, not particles (it has 1 PolyMesh)"), "{error}");
    let points = points_archive();
    let error = read_mesh(&points, &Limits::default()).expect_err("Points").to_string();
    assert!(error.contains("the archive has no PolyMesh (it has 3 Points)"), "{error}");
    // Of another program, for which the content is not known from the first bytes.
    let at = points.windows(9).position(|part| part == b"meniscus ").expect("its name");
    let mut foreign = points;
    foreign[at..at + 8].copy_from_slice(b"someone_");
    for (bytes, is_particles) in [(&mesh, false), (&foreign, true)] {
        assert_eq!(crate::looks_like_particles(bytes, "a.abc"), is_particles);
        assert_eq!(crate::looks_like_mesh(bytes, "a.abc"), !is_particles);
    }
}

#[test]
fn meshes_are_read_at_a_time() {
    let mut bytes = Vec::new();
    let mesh = |ogawa: &mut Ogawa| {
        let mut samples = MeshSamples::at(IDENTITY);
        for x in [1.0, 2.0, 3.0] {
            let positions = [[x, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]];
            samples.push(FrameSamples {
                bounds: bounds_sample(bounds(&positions), ogawa)?,
                positions: real_sample(positions.as_flattened(), (3, 3), ogawa)?,
                faces: triangle_samples(&[[0, 1, 2]], 1, ogawa)?,
                normals: real_sample(&[1.0; 9], (3, 3), ogawa)?,
                velocities: None,
            });
        }
        Ok(vec![samples.object(None, Vec::new(), ogawa)?])
    };
    write_archive(&[], &Times::Frames { times: FRAMES.into(), fps: 24.0 }, mesh, &mut bytes)
        .expect("written");
    let limits = Limits::default();
    assert!(with_file(&bytes, |file| (MESHES.are_animated)(file, &limits)).expect("times"));
    for (frame, x) in [(None, 1.0), (Some(0), 1.0), (Some(1), 1.0), (Some(3), 2.0), (Some(9), 3.0)] {
        let mesh = with_file(&bytes, |file| (MESHES.read)(file, frame, &limits)).expect("read");
        assert_eq!((mesh.positions[0][0], &*mesh.triangles), (x, &[[0, 1, 2]][..]), "{frame:?}");
    }
    let error = read_mesh(&bytes, &limits).expect_err("several samples").to_string();
    assert!(error.contains("an animation of 3 samples"), "{error}");
}

#[test]
fn references_that_form_a_cycle_are_an_error() {
    let mut bytes = points_archive();
    let limits = Limits::default();
    let source = &*bytes;
    let top = Archive::open(&source, &limits).expect("open").top;
    // The only child of the top object becomes the top object.
    let at = usize::try_from(top).expect("small") + 16;
    bytes[at..at + 8].copy_from_slice(&top.to_le_bytes());
    let error = read(&bytes, 0).expect_err("a cycle").to_string();
    assert!(error.contains("used more than once"), "{error}");
    bytes[at..at + 8].copy_from_slice(&DATA.to_le_bytes());
    assert!(read(&bytes, 0).is_err());
}

/// Damaged files give frames or errors.
#[test]
fn damaged_points_are_read_or_rejected() {
    let bytes = points_archive();
    for length in 0..bytes.len() {
        let error = read(&bytes[..length], 0).expect_err("the root group is missing");
        assert!(error.is_truncated(), "{length} of {}: {error}", bytes.len());
    }
    for at in 0..bytes.len() {
        for damage in [0x01, 0x80, 0xff] {
            let mut damaged = bytes.clone();
            damaged[at] ^= damage;
            let samples = with_file(&damaged, |file| (READER.open)(file, &Limits::default()));
            for index in 0..samples.map_or(1, |frames| frames.samples.len()).min(4) {
                let Ok(frame) = read(&damaged, index) else { continue };
                for FileAttribute { arity, values, .. } in &frame.attributes {
                    assert_eq!(values.len(), arity * frame.positions.len());
                }
            }
        }
    }
}
