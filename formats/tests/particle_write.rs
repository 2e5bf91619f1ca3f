//! Particles of all formats, written in the formats of points and read back.

use crate::fixtures;

use std::io::{Cursor, Write};
use std::path::Path;

use meniscus_formats::{
    AttributeRole, FileAttribute, FilePositions, Limits, MeshOptions, OutputFormat, ParticleFrame,
    PointFormat, Provenance, Result, UpAxis, Values, is_complete, looks_like_mesh, looks_like_particles, ply,
    read_particles, read_provenance, vtk,
};

type Writer = fn(&ParticleFrame, &Provenance, &mut dyn Write) -> Result<()>;

const WRITERS: [(&str, OutputFormat, Writer); 2] =
    [("a.ply", OutputFormat::Ply, ply::write_particles), ("a.vtp", OutputFormat::Vtp, vtk::write_particles)];

fn read(bytes: &[u8], name: &str) -> ParticleFrame {
    read_particles(bytes, name, &Limits::default()).unwrap_or_else(|error| panic!("{name}: {error}"))
}

/// All valid frames of the corpus and of the other tests.
fn frames() -> Vec<(String, ParticleFrame)> {
    let corpus = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/corpus");
    let mut files: Vec<(String, Vec<u8>)> = fixtures::all();
    for folder in ["valid", "delimited/valid"] {
        for entry in std::fs::read_dir(corpus.join(folder)).unwrap() {
            let path = entry.unwrap().path();
            let name = path.file_name().unwrap().to_string_lossy().into_owned();
            files.push((name, std::fs::read(path).unwrap()));
        }
    }
    files.sort();
    let frames = files.into_iter().filter_map(|(name, bytes)| {
        let frame = read_particles(&bytes, &name, &Limits::default()).ok()?;
        Some((name, frame))
    });
    frames.collect()
}

/// The values that are expected when a file is read back: strings become indices, and wide integers become
/// floats if the format lacks their type.
fn narrowed(attribute: &FileAttribute, is_ply: bool) -> Values {
    match &attribute.values {
        Values::Strings { table, indices } => Values::I32(
            indices
                .iter()
                .map(|&index| if usize::try_from(index).is_ok_and(|i| i < table.len()) { index } else { -1 })
                .collect(),
        ),
        Values::I64(values) if is_ply && values.iter().all(|&value| u32::try_from(value).is_ok()) => {
            Values::I64(values.clone())
        }
        Values::I64(values) if is_ply && values.iter().all(|&value| i32::try_from(value).is_ok()) => {
            Values::I32(values.iter().map(|&value| value.try_into().unwrap()).collect())
        }
        Values::I64(values) if is_ply => Values::F64(values.iter().map(|&value| value as f64).collect()),
        values => values.clone(),
    }
}

/// The values as bits, so that NaN equals itself.
fn bits(values: &Values) -> Vec<u64> {
    match values {
        Values::F32(values) => values.iter().map(|value| u64::from(value.to_bits())).collect(),
        Values::F64(values) => values.iter().map(|value| value.to_bits()).collect(),
        Values::U8(values) => values.iter().map(|&value| u64::from(value)).collect(),
        Values::I32(values) => values.iter().map(|&value| value as u64).collect(),
        Values::I64(values) => values.iter().map(|&value| value as u64).collect(),
        Values::Strings { indices, .. } => indices.iter().map(|&index| index as u64).collect(),
    }
}

fn position_bits(positions: &FilePositions) -> Vec<u64> {
    match positions {
        FilePositions::F32(all) => all.as_flattened().iter().map(|x| u64::from(x.to_bits())).collect(),
        FilePositions::F64(all) => all.as_flattened().iter().map(|x| x.to_bits()).collect(),
    }
}

#[test]
fn written_particles_are_read_back_exactly() {
    let frames = frames();
    assert!(frames.len() > 40, "{}", frames.len());
    let provenance = [("generator".to_string(), "meniscus x".to_string()), ("a".into(), "b: c".into())];
    for (name, frame) in &frames {
        for (written_name, kind, write) in WRITERS {
            let mut bytes = Vec::new();
            write(frame, &provenance, &mut bytes).unwrap_or_else(|error| panic!("{name}: {error}"));
            assert_eq!(read_provenance(kind, &*bytes).unwrap(), provenance, "{name} as {written_name}");
            assert!(is_complete(kind, &mut Cursor::new(&bytes)).unwrap(), "{name} as {written_name}");
            let cut = &bytes[..bytes.len() - 1];
            assert!(!is_complete(kind, &mut Cursor::new(cut)).unwrap(), "{name} as {written_name}");
            let found = read(&bytes, written_name);
            let shown = format!("{name} as {written_name}");
            let is_wide = |positions: &FilePositions| matches!(positions, FilePositions::F64(_));
            assert_eq!(position_bits(&found.positions), position_bits(&frame.positions), "{shown}");
            if !frame.positions.is_empty() {
                assert_eq!(is_wide(&found.positions), is_wide(&frame.positions), "{shown}");
                check_attributes(frame, &found, kind == OutputFormat::Ply, &shown);
            }
        }
    }
}

fn check_attributes(frame: &ParticleFrame, found: &ParticleFrame, is_ply: bool, shown: &str) {
    let named = |frame: &ParticleFrame| -> Vec<(String, usize, Option<AttributeRole>)> {
        frame.attributes.iter().map(|a| (a.name.clone(), a.arity, a.role)).collect()
    };
    let mut expected = named(frame);
    if is_ply {
        // PLY names cannot contain blanks.
        expected.iter_mut().for_each(|(name, ..)| *name = name.replace(' ', "_"));
    }
    assert_eq!(named(found), expected, "{shown}");
    for (found, attribute) in found.attributes.iter().zip(&frame.attributes) {
        let expected = narrowed(attribute, is_ply);
        assert_eq!(
            std::mem::discriminant(&found.values),
            std::mem::discriminant(&expected),
            "{} of {shown}",
            attribute.name
        );
        assert_eq!(bits(&found.values), bits(&expected), "{} of {shown}", attribute.name);
    }
}

fn attribute(name: &str, arity: usize, role: Option<AttributeRole>, values: Values) -> FileAttribute {
    FileAttribute { name: name.into(), arity, role, values }
}

#[test]
fn unusual_attributes_round_trip_or_get_a_note() {
    let attributes = vec![
        attribute("Cd", 4, Some(AttributeRole::Color), Values::U8((0..8).collect())),
        attribute("width", 1, Some(AttributeRole::Radius), Values::F32(vec![0.125, 0.25])),
        attribute("id", 1, Some(AttributeRole::Id), Values::I64(vec![-5, 1 << 60])),
        attribute("a b", 1, None, Values::F64(vec![0.1, -0.0])),
        attribute("x", 1, None, Values::I32(vec![1, -1])),
        attribute(
            "part",
            1,
            None,
            Values::Strings { table: vec!["a\"<".into(), "ü".into()], indices: vec![1, 7] },
        ),
    ];
    let positions = FilePositions::F64(vec![[0.1, 2e10, -3.5], [f64::NAN, 0.0, 1.0]]);
    let frame = ParticleFrame { positions, attributes, notes: Vec::new() };
    let expected: [(&str, &[&str], Writer); 2] = [
        (
            "a.vtp",
            &["part is stored as indices in the .vtp; the strings are in its field data"],
            vtk::write_particles,
        ),
        (
            "a.ply",
            &[
                "values of id beyond ±2⁵³, which the .ply rounds: 1; .vtp stores them exactly",
                "a b is named a_b in the .ply",
                "x is named x_2 in the .ply",
                "part is stored as indices in the .ply; the strings are in its comments",
            ],
            ply::write_particles,
        ),
    ];
    for (name, notes, write) in expected {
        let found = if name == "a.vtp" { vtk::particle_notes(&frame) } else { ply::particle_notes(&frame) };
        assert_eq!(found, notes);
        let mut bytes = Vec::new();
        write(&frame, &[], &mut bytes).unwrap();
        let back = read(&bytes, name);
        assert_eq!(position_bits(&back.positions), position_bits(&frame.positions));
        assert_eq!(back.attributes[1], frame.attributes[1], "diameters are halved by readers");
        assert_eq!(back.attributes[0], frame.attributes[0]);
        let roles: Vec<_> = back.attributes.iter().map(|attribute| attribute.role).collect();
        assert_eq!(
            roles[..3],
            [Some(AttributeRole::Color), Some(AttributeRole::Radius), Some(AttributeRole::Id)]
        );
    }
    let short =
        ParticleFrame { attributes: vec![attribute("v", 3, None, Values::F32(vec![0.0; 5]))], ..frame };
    for (_, _, write) in WRITERS {
        let error = write(&short, &[], &mut Vec::new()).unwrap_err().to_string();
        assert!(error.contains("attribute v has 5 values for 2 particles with 3 values each"), "{error}");
    }
}

/// A frame with the attributes that formats treat specially, and others.
fn splash() -> ParticleFrame {
    let attributes = vec![
        attribute("id", 1, Some(AttributeRole::Id), Values::I64(vec![7, 1 << 40, 3])),
        attribute(
            "velocity",
            3,
            Some(AttributeRole::Velocity),
            Values::F32((0..9u8).map(f32::from).collect()),
        ),
        attribute("radius", 1, Some(AttributeRole::Radius), Values::F32(vec![0.5, 0.25, 1.0])),
        attribute("Cd", 3, Some(AttributeRole::Color), Values::F32(vec![0.25; 9])),
        attribute("age", 1, None, Values::I32(vec![0, -3, 2])),
        attribute(
            "kind",
            1,
            None,
            Values::Strings { table: vec!["drop".into(), "sheet".into()], indices: vec![1, 0, 1] },
        ),
        attribute("uv", 2, None, Values::F64(vec![0.5, 0.25, 1.0, 0.0, 0.125, 2.0])),
    ];
    let positions = FilePositions::F64(vec![[1000.5, 2.0, -3.0], [1001.0, 2.5, -4.0], [1000.0, 3.0, -3.5]]);
    ParticleFrame { positions, attributes, notes: Vec::new() }
}

/// The values of an attribute as floats; indices for strings.
fn floats(frame: &ParticleFrame, name: &str) -> Vec<f64> {
    let attribute = frame.attributes.iter().find(|attribute| attribute.name == name);
    match &attribute.unwrap_or_else(|| panic!("{name} of {:?}", frame.attributes)).values {
        Values::F32(values) => values.iter().map(|&value| value.into()).collect(),
        Values::F64(values) => values.clone(),
        Values::U8(values) => values.iter().map(|&value| value.into()).collect(),
        Values::I32(values) => values.iter().map(|&value| value.into()).collect(),
        Values::I64(values) => values.iter().map(|&value| value as f64).collect(),
        Values::Strings { indices, .. } => indices.iter().map(|&index| index.into()).collect(),
    }
}

#[test]
fn points_beside_a_surface_are_read_back_from_all_formats() {
    let provenance =
        [("generator".to_owned(), "meniscus x".to_owned()), ("contents".to_owned(), "spray".to_owned())];
    let original = splash();
    for format in PointFormat::ALL {
        let name = format!("a.spray.{}", format.extension());
        for count in [3, 0] {
            let mut frame = original.clone();
            frame.retain(&[count > 0; 3]);
            if format == PointFormat::Bgeo {
                // Its integers have 32 bits.
                frame.attributes[0].values = Values::I64((0..count).collect());
            }
            let mut bytes = Vec::new();
            format.write(&frame, &MeshOptions::default(), &provenance, &mut bytes).unwrap();
            assert!(!looks_like_mesh(&bytes, &name), "{name}");
            let is_seen = format != PointFormat::Abc || looks_like_particles(&bytes, &name);
            assert!(is_seen, "{name}");
            let found = read(&bytes, &name);
            assert_eq!(found.positions.len() as i64, count, "{name}");
            if count == 0 {
                continue;
            }
            let FilePositions::F64(expected) = &frame.positions else { panic!("64 bits") };
            let positions: Vec<[f64; 3]> = match &found.positions {
                FilePositions::F32(positions) => {
                    positions.iter().map(|position| position.map(f64::from)).collect()
                }
                FilePositions::F64(positions) => positions.clone(),
            };
            assert_eq!(positions, *expected, "{name}");
            let [id, velocity, radius, color] = match format {
                PointFormat::Usda | PointFormat::Usdc => ["ids", "velocities", "widths", "displayColor"],
                PointFormat::Abc => ["id", "velocity", "width", "Cd"],
                PointFormat::Ply => ["id", "velocity", "radius", "Cd"],
                _ => ["id", "velocity", "radius", "Cd"],
            };
            for (written, name) in [
                ("id", id),
                ("velocity", velocity),
                ("radius", radius),
                ("Cd", color),
                ("age", "age"),
                ("uv", "uv"),
            ] {
                assert_eq!(floats(&found, name), floats(&frame, written), "{name} of {format:?}");
            }
            assert_eq!(floats(&found, "kind"), floats(&frame, "kind"), "{format:?}");
            let roles: Vec<_> = found.attributes.iter().filter_map(|attribute| attribute.role).collect();
            for role in
                [AttributeRole::Id, AttributeRole::Velocity, AttributeRole::Radius, AttributeRole::Color]
            {
                assert!(roles.contains(&role), "{role:?} of {format:?}");
            }
        }
    }
}

/// Blender reads the ids from a primvar of 32 bits. Readers find the ids once.
#[test]
fn stages_have_ids_of_32_bits_twice_and_are_read_as_written() {
    let ids = |name: &str, values: Vec<i64>| attribute(name, 1, Some(AttributeRole::Id), Values::I64(values));
    let narrow = ids("ids", vec![i64::from(i32::MAX), -1, i64::from(i32::MIN)]);
    let wide = ids("ids", vec![0, 1 << 31, 2]);
    let named = attribute("id", 1, None, Values::I32(vec![4, 5, 6]));
    let vectors = attribute("id", 2, None, Values::F32(vec![0.5; 6]));
    for format in [PointFormat::Usda, PointFormat::Usdc] {
        for (attributes, primvar, count) in [
            (vec![narrow.clone()], true, 1),
            (vec![wide.clone()], false, 1),
            // Another attribute has the name, and keeps it.
            (vec![narrow.clone(), named.clone()], true, 2),
            (vec![wide.clone(), named.clone()], true, 2),
            (vec![narrow.clone(), vectors.clone()], true, 2),
        ] {
            let positions = FilePositions::F32(vec![[0.0; 3], [1.0; 3], [2.0; 3]]);
            let frame = ParticleFrame { positions, attributes, notes: Vec::new() };
            let mut bytes = Vec::new();
            format.write(&frame, &MeshOptions::default(), &[], &mut bytes).unwrap();
            if format == PointFormat::Usda {
                let found = String::from_utf8_lossy(&bytes).matches("[] primvars:id = ").count();
                assert_eq!(found, usize::from(primvar), "{:?}", frame.attributes);
            }
            assert_eq!(format.notes(&frame), [""; 0]);
            let back = read(&bytes, "a");
            assert_eq!((back.attributes.len(), back.notes.as_slice()), (count, [].as_slice()));
            assert_eq!(back.positions, frame.positions);
            for (found, written) in back.attributes.iter().zip(&frame.attributes) {
                assert_eq!((&found.name, &found.values), (&written.name, &written.values));
            }
        }
    }
    // Other programs may mean something else by the name.
    let stage = "#usda 1.0\ndef Points \"p\" { point3f[] points = [(1, 2, 3), (4, 5, 6)] int64[] ids = [3, 4]
        int[] primvars:id = [3, 5] ( interpolation = \"vertex\" ) }";
    let found = read(stage.as_bytes(), "a.usda");
    assert_eq!((floats(&found, "ids"), floats(&found, "id")), (vec![3.0, 4.0], vec![3.0, 5.0]));
    let copied = read(stage.replace("[3, 5]", "[3, 4]").as_bytes(), "a.usda");
    assert_eq!((copied.attributes.len(), floats(&copied, "ids")), (1, vec![3.0, 4.0]));
}

#[test]
fn points_follow_the_up_axis_and_the_unit() {
    let options = MeshOptions { up: UpAxis::Z, meters_per_unit: 0.01, ..MeshOptions::default() };
    let written = |format: PointFormat, frame: &ParticleFrame| {
        let mut bytes = Vec::new();
        format.write(frame, &options, &[], &mut bytes).map(|()| bytes)
    };
    let frame = splash();
    let notes = read(&written(PointFormat::Usda, &frame).unwrap(), "a.usda").notes;
    assert!(notes.iter().any(|note| note.contains("metersPerUnit 0.01, upAxis Z")), "{notes:?}");
    // Alembic has Y up.
    let FilePositions::F64(positions) = read(&written(PointFormat::Abc, &frame).unwrap(), "a.abc").positions
    else {
        panic!("a transform")
    };
    assert_eq!(positions[0], [1000.5, -3.0, -2.0]);
    let nowhere = ParticleFrame {
        positions: FilePositions::F32(vec![[f32::NAN, 0.0, 0.0]]),
        ..ParticleFrame::default()
    };
    for format in [PointFormat::Usda, PointFormat::Usdc, PointFormat::Abc] {
        let error = written(format, &nowhere).unwrap_err().to_string();
        assert!(error.contains("not finite"), "{error}");
        let odd = ParticleFrame {
            positions: FilePositions::F32(vec![[0.0; 3]]),
            attributes: vec![attribute("heat", 1, None, Values::F32(vec![f32::INFINITY]))],
            notes: Vec::new(),
        };
        assert_eq!(floats(&read(&written(format, &odd).unwrap(), "a"), "heat"), [0.0]);
        let expected = format!("1 values of heat are not finite: the .{} has 0", format.extension());
        assert_eq!(format.notes(&odd), [expected]);
    }
}
