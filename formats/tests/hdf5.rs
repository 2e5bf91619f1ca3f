//! HDF5 files in the layouts of several programs. The files in `hdf5/` were written by `hdf5/write.py`.

use std::fmt::Write;

use crate::fixtures::hdf5_files;
use meniscus_formats::{
    AttributeRole, ContainerFile, Error, FilePositions, Limits, ParticleFrame, Sample, Values, hdf5, probe,
    read_particles,
};

fn file(name: &str) -> Vec<u8> {
    hdf5_files().into_iter().find(|(found, _)| found == name).unwrap().1
}

fn samples(bytes: &[u8]) -> Result<Vec<Sample>, Error> {
    Ok(hdf5::frames(&container(&bytes), &Limits::default())?.samples)
}

fn read(bytes: &[u8], index: usize) -> Result<ParticleFrame, Error> {
    let (container, limits) = (container(&bytes), Limits::default());
    hdf5::frames(&container, &limits)?.read(&container, index, &limits)
}

fn container<'a>(bytes: &'a &'a [u8]) -> ContainerFile<'a> {
    ContainerFile { file: bytes, name: "a.h5", open: &|_| Err(std::io::ErrorKind::NotFound.into()) }
}

/// `name arity role first-value..last-value` of each attribute.
fn described(frame: &ParticleFrame) -> String {
    let mut text = String::new();
    for attribute in &frame.attributes {
        let values: Vec<f64> = match &attribute.values {
            Values::F32(values) => values.iter().map(|&value| value.into()).collect(),
            Values::F64(values) => values.clone(),
            Values::U8(values) => values.iter().map(|&value| value.into()).collect(),
            Values::I32(values) => values.iter().map(|&value| value.into()).collect(),
            Values::I64(values) => values.iter().map(|&value| value as f64).collect(),
            Values::Strings { table, indices } => {
                assert!(indices.iter().all(|&index| index == 0));
                write!(text, "{} {}; ", attribute.name, table[0]).unwrap();
                continue;
            }
        };
        assert_eq!(values.len(), 6 * attribute.arity, "{}", attribute.name);
        let role = attribute.role.map_or("-".into(), |role: AttributeRole| format!("{role:?}"));
        let (first, last) = (values[0], values[values.len() - 1]);
        write!(text, "{} {} {role} {first} {last}; ", attribute.name, attribute.arity).unwrap();
    }
    text.trim_end().to_owned()
}

fn check_positions(frame: &ParticleFrame, step: f64, name: &str) {
    let positions: Vec<[f64; 3]> = match &frame.positions {
        FilePositions::F32(positions) => positions.iter().map(|position| position.map(f64::from)).collect(),
        FilePositions::F64(positions) => positions.clone(),
    };
    let expected: Vec<_> = (0..6).map(f64::from).map(|i| [i / 2.0 + step, i / 4.0 - 1.0, 3.0 - i]).collect();
    assert_eq!(positions, expected, "of {name}");
}

const VELOCITY: &str = "3 Velocity 0 -5;";

/// A column for each kind of storage and type.
const TYPES: &str = "fill 1 - 2.5 2.5; flags 1 - 0 1; single 50 - 0 5; tree 3 - 0 -5; type i1 1 - 100 105; \
    type i8 1 - 100 105; type u2 1 - 100 105; type u4 1 - 100 105; type u8 1 - 100 105;";
const TYPES_NOTES: &str =
    "skipped `scalar`: it is a single value|skipped `other`: it has 7 rows for 6 particles";

/// Files with one frame: name, time, attributes, and the notes.
#[test]
fn layouts_with_one_frame_are_read() {
    let table = [
        (
            "gadget.h5",
            Some(0.25),
            format!("Masses 1 Mass 0.5 0.5; ParticleIDs 1 Id 100 105; Velocities {VELOCITY}"),
            "only the particles of `PartType0` were read, not those of PartType1",
        ),
        (
            "swift.h5",
            Some(0.5),
            format!(
                "Densities 1 Density 1000 1005; {} ParticleIDs 1 Id 100 105; Velocities {VELOCITY}",
                (0..9).map(|index| format!("Extra{index} 1 - 0 5;")).collect::<Vec<_>>().join(" ")
            ),
            "skipped `Names`: it is not numeric|skipped `Tensors`: it has the shape [6, 3, 3]|links to the file \
             `other.h5` were not followed",
        ),
        (
            "pysph.hdf5",
            Some(1.5),
            format!("rho 1 Density 1000 1005; velocity {VELOCITY}"),
            "only the particles of `particles/fluid/arrays` were read, not those of particles/boundary/array…",
        ),
        (
            "vtk.vtkhdf",
            None,
            format!("Velocity {VELOCITY}"),
            "skipped `NumberOfPoints`: it has 1 rows for 6 particles",
        ),
        (
            "records.h5",
            None,
            format!("vel {VELOCITY} id 1 Id 100 105;"),
            "skipped fields of `particles` that are not numeric: label",
        ),
        ("old.h5", None, TYPES.into(), TYPES_NOTES),
        ("new.h5", None, TYPES.into(), TYPES_NOTES),
    ];
    for (name, time, attributes, notes) in table {
        let bytes = file(name);
        assert_eq!(probe(&bytes, "a").to_string(), "HDF5");
        let samples = samples(&bytes).unwrap_or_else(|error| panic!("{name}: {error}"));
        assert_eq!(samples, [Sample { number: 0, time }], "of {name}");
        let frame = read(&bytes, 0).unwrap_or_else(|error| panic!("{name}: {error}"));
        check_positions(&frame, 0.0, name);
        assert_eq!(described(&frame), attributes, "of {name}");
        assert_eq!(frame.notes.join("|"), notes, "of {name}");
    }
}

/// Files with several frames: name, numbers and times of the frames, attributes of each, notes.
#[test]
fn steps_and_iterations_are_frames() {
    let table = [
        (
            "steps.h5part",
            vec![(0, Some(0.0)), (2, Some(0.5)), (10, Some(2.5))],
            format!("id 1 Id 100 105; v {VELOCITY}"),
            "",
        ),
        (
            "openpmd.h5",
            vec![(20, Some(10.0)), (100, Some(50.0))],
            format!("id 1 Id 100 105; mass 1 Mass 0.125 0.125; velocity {VELOCITY} species water;"),
            "positions are in units of 0.001 m",
        ),
        (
            "frames.h5",
            vec![(0, None), (2, None), (10, None)],
            format!("id 1 Id 100 105; particle_qd {VELOCITY}"),
            "",
        ),
        ("numbered.h5", vec![(0, None), (2, None), (10, None)], format!("v {VELOCITY}"), ""),
        ("stacked_pair.h5", vec![(0, None), (1, None), (2, None)], format!("qd {VELOCITY}"), ""),
        (
            "stacked.h5",
            vec![(0, None), (1, None), (2, None)],
            format!("id 1 Id 100 105; mass 1 Mass 0.5 0.5; vel {VELOCITY}"),
            "skipped `kind`: the numbers of its steps have an unusual type: save it as float32|\
                skipped `F_x`: it has 3 rows for 6 particles|skipped `box`: it has 3 rows for 6 particles|\
                skipped `time`: it has 3 rows for 6 particles",
        ),
    ];
    for (name, expected, attributes, notes) in table {
        let bytes = file(name);
        let found = samples(&bytes).unwrap();
        let expected: Vec<_> = expected.into_iter().map(|(number, time)| Sample { number, time }).collect();
        assert_eq!(found, expected, "of {name}");
        for (index, sample) in found.iter().enumerate() {
            let frame = read(&bytes, index).unwrap_or_else(|error| panic!("{name}: {error}"));
            check_positions(&frame, sample.number as f64, name);
            assert_eq!(described(&frame), attributes, "of {name}");
            assert_eq!(frame.notes.join("|"), notes, "of {name}");
        }
        assert!(read(&bytes, found.len()).is_err());
        // What is known of the file from frame to frame changes nothing, whatever their order and wherever they are read.
        let (bytes, limits) = (&&bytes[..], Limits::default());
        let frames = hdf5::frames(&container(bytes), &limits).unwrap();
        let again = |index| frames.read(&container(bytes), index, &limits).unwrap();
        let alone: Vec<_> = (0..found.len()).map(|index| read(bytes, index).unwrap()).collect();
        std::thread::scope(|scope| {
            for index in (0..8).rev().map(|index| index % found.len()) {
                let (again, alone) = (&again, &alone);
                scope.spawn(move || assert_eq!(again(index), alone[index], "of {name}"));
            }
        });
        let error = read_particles(bytes, name, &Limits::default()).unwrap_err().to_string();
        assert!(error.contains("frames, and one was expected"), "{error}");
    }
}

/// A position that cannot be read is an error, and not a file without particles.
#[test]
fn unreadable_position_is_an_error() {
    let wide = [64, 0, 52, 11, 0, 52, 255, 3, 0, 0];
    let unusual = [64, 0, 52, 11, 0, 52, 254, 3, 0, 0];
    let bytes = replaced("unnamed.h5", &wide, &unusual);
    assert_eq!(samples(&bytes).unwrap(), [], "without the name of a position");
    let bytes = replaced("frames.h5", &wide, &unusual);
    let error = samples(&bytes).unwrap_err().to_string();
    assert!(error.contains("skipped `particle_q`: its numbers"), "{error}");
}

/// The longest vector of real numbers is the position, if nothing has the name of one.
#[test]
fn position_without_a_name_is_the_longest_vector() {
    let frame = read(&file("unnamed.h5"), 0).unwrap();
    check_positions(&frame, 0.0, "unnamed.h5");
    assert_eq!(described(&frame), "kind 1 Kind 100 105;");
    assert_eq!(frame.notes, ["`points of water` is used as the position"]);
}

#[test]
fn files_without_particles_have_no_frames() {
    assert_eq!(samples(&file("picture.h5")).unwrap(), []);
    let error = samples(&file("h5md.h5")).unwrap_err().to_string();
    assert!(error.contains("H5MD is not read: save the positions"), "{error}");
    let bytes = file("none.h5");
    assert_eq!(samples(&bytes).unwrap(), []);
    let error = read(&bytes, 0).unwrap_err().to_string();
    let words = "the file has grid/, density; skipped `density`: it has the shape [4, 4, 4]; skipped `x`: it \
        is the axis of a grid";
    assert!(error.contains(words), "{error}");
}

/// A file with these bytes replaced wherever they are.
fn replaced(name: &str, from: &[u8], to: &[u8]) -> Vec<u8> {
    let mut bytes = file(name);
    let places: Vec<usize> = (0..bytes.len()).filter(|at| bytes[*at..].starts_with(from)).collect();
    assert!(!places.is_empty() && from.len() == to.len(), "{from:?} in {name}");
    for at in places {
        bytes[at..at + to.len()].copy_from_slice(to);
    }
    bytes
}

#[test]
fn numbers_of_other_bits_are_not_read() {
    let f32 = [32, 0, 23, 8, 0, 23, 127, 0, 0, 0]; // precision, exponent, mantissa, bias
    let f64 = [64, 0, 52, 11, 0, 52, 255, 3, 0, 0];
    let u32 = [0x10, 0, 0, 0, 4, 0, 0, 0, 0, 0, 32, 0];
    let table: [(&str, &[u8], &[u8], &str); 6] = [
        ("gadget.h5", &f32, &[32, 0, 24, 7, 0, 24, 63, 0, 0, 0], "Masses|Velocities"),
        ("gadget.h5", &f32, &[32, 0, 23, 8, 0, 23, 126, 0, 0, 0], "Masses|Velocities"),
        ("gadget.h5", &u32, &[0x10, 0, 0, 0, 4, 0, 0, 0, 0, 0, 24, 0], "ParticleIDs"),
        ("gadget.h5", &u32, &[0x10, 0, 0, 0, 4, 0, 0, 0, 8, 0, 24, 0], "ParticleIDs"),
        ("records.h5", &f64, &[64, 0, 52, 11, 0, 52, 254, 3, 0, 0], "vel"),
        ("records.h5", &f32, &[32, 0, 24, 7, 0, 24, 63, 0, 0, 0], ""),
    ];
    for (name, from, to, skipped) in table {
        let Ok(frame) = read(&replaced(name, from, to), 0) else {
            assert_eq!(skipped, "", "of {name}"); // the positions
            continue;
        };
        check_positions(&frame, 0.0, name);
        for skipped in skipped.split('|') {
            assert!(!frame.attributes.iter().any(|attribute| attribute.name == skipped), "{name} {skipped}");
            assert!(frame.notes.iter().any(|note| note.contains(skipped)), "{name}: {:?}", frame.notes);
        }
    }
}

#[test]
fn files_behind_a_user_block_are_read() {
    for name in ["gadget.h5", "swift.h5"] {
        for length in [512, 4096] {
            let mut bytes = b"MATLAB 7.3 MAT-file, Platform: GLNXA64\n".to_vec();
            bytes.resize(length, 0);
            bytes.extend(file(name));
            assert_eq!(probe(&bytes, "a.mat").to_string(), "HDF5");
            let frame = read(&bytes, 0).unwrap_or_else(|error| panic!("{name}: {error}"));
            check_positions(&frame, 0.0, name);
        }
    }
}

#[test]
fn species_are_joined_with_their_names() {
    let frame = read(&file("species.h5"), 0).unwrap();
    let of_type = |wanted: &str| frame.attributes.iter().find(|attribute| attribute.name == wanted).unwrap();
    assert_eq!(of_type("id").values, Values::I64(vec![104, 105, 100, 101, 102, 103]));
    assert_eq!(of_type("diameter").values, Values::F64(vec![0.25; 6]), "of the radius");
    let species = of_type("species");
    assert_eq!((species.arity, species.role), (1, Some(AttributeRole::Kind)));
    let table = ["air", "water"].map(String::from).into();
    assert_eq!(species.values, Values::Strings { table, indices: vec![0, 0, 1, 1, 1, 1] });
    let notes = [
        "`diameter` looks like a diameter: the radius is half of it",
        "joined the particles of 2 species",
        "skipped the array `only_here`: it is not the same in all species",
    ];
    assert_eq!(frame.notes, notes);
}

#[test]
fn particles_of_openpmd_are_below_their_path() {
    // The same length: only the name of the group changes.
    let elsewhere = replaced("openpmd.h5", b"particles\0", b"fields___\0");
    assert_eq!(samples(&elsewhere).unwrap(), []);
    assert!(read(&elsewhere, 0).is_err());
}

#[test]
fn truncated_files_are_reported_as_such() {
    for (name, bytes) in hdf5_files() {
        for cut in (8..200).chain((200..bytes.len()).step_by(97)) {
            let error = samples(&bytes[..cut]).unwrap_err();
            assert!(error.is_truncated(), "{name}, cut at {cut} of {}: {error}", bytes.len());
        }
    }
    let error = samples(&file("open.h5")).unwrap_err();
    assert!(error.is_truncated() && error.to_string().contains("has not closed it"), "{error}");
}

#[test]
fn data_beyond_the_limits_is_an_error() {
    let limits = Limits { particle_count: 5, ..Limits::default() };
    let bytes = file("gadget.h5");
    let bytes = &&bytes[..];
    let container = container(bytes);
    let error = hdf5::frames(&container, &limits).unwrap().read(&container, 0, &limits).unwrap_err();
    assert!(matches!(error, Error::TooLarge { .. }), "{error}");
}
