//! Meshes written as .abc and read back with our own reader: exact to the last bit. `tests/clients` reads
//! .abc files with the Alembic library.

#![allow(clippy::cast_possible_truncation, reason = "test numbers are small")]

use std::io::Cursor;

use meniscus_formats::{
    AttributeRole, Error, Limits, MeshOptions, MeshView, OutputFormat, UpAxis, VertexAttribute, VertexValues,
    abc, gltf, is_complete, read_mesh, read_provenance, to_glb,
};

const FAR: [f64; 3] = [1e6 + 0.5, -2e6, 0.25];

const POSITIONS: [[f32; 3]; 5] =
    [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0], [0.5, 0.5, 2.0]];

const NORMALS: [[f32; 3]; 5] = [[0.0, 0.0, -1.0]; 5];

/// The first two triangles form a quad.
const TRIANGLES: [[u32; 3]; 6] = [[0, 3, 1], [3, 2, 1], [0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]];

const QUADS: [bool; 6] = [true, false, false, false, false, false];

fn written(origin: [f64; 3], options: &MeshOptions, attributes: &[VertexAttribute]) -> Vec<u8> {
    let (positions, normals, triangles) = (&POSITIONS, &NORMALS, &TRIANGLES);
    let mesh = MeshView { positions, normals, triangles, origin, attributes };
    let mut bytes = Vec::new();
    OutputFormat::Abc.write_mesh(&mesh, options, &provenance(), &mut bytes).expect("written");
    bytes
}

fn provenance() -> Vec<(String, String)> {
    let pair = |key: &str, value: &str| (key.to_owned(), value.to_owned());
    vec![pair("generator", "meniscus 0.1.0"), pair("a=b;c", "größe = 3; \"x\"\n"), pair("empty", "")]
}

fn pyramid() -> Vec<u8> {
    let numbers: Vec<f32> = (0..15u8).map(f32::from).collect();
    let wide: Vec<f32> = (0..25u8).map(f32::from).collect();
    let (small, large) = ([1, 2, 3, 4, -5], [1, 2, 3, 4, i64::MAX]);
    let table = ["a\0b".to_owned(), "ü".to_owned()];
    let (named, reals) = (VertexValues::Strings { table: &table, indices: &[0, 1, 2, -1, 0] }, &*numbers);
    let attribute = |name, role, arity, values| VertexAttribute { name, role, arity, values };
    let attributes = [
        attribute("v", Some(AttributeRole::Velocity), 3, VertexValues::Numbers(reals)),
        attribute("Cd", Some(AttributeRole::Color), 3, VertexValues::Numbers(reals)),
        attribute("a b", None, 5, VertexValues::Numbers(&wide)),
        attribute("small", None, 1, VertexValues::Integers(&small)),
        attribute("large", None, 1, VertexValues::Integers(&large)),
        attribute("name", None, 1, named),
    ];
    let notes = abc::attribute_notes(&attributes);
    assert_eq!(notes, ["a b is named a_b in the .abc", "name: the .abc stores null characters as spaces"]);
    written(FAR, &MeshOptions { up: UpAxis::Z, ..MeshOptions::default() }, &attributes)
}

#[test]
fn abc_round_trips_exactly() {
    let world = |origin: [f64; 3]| POSITIONS.map(|p| [0, 1, 2].map(|axis| origin[axis] + f64::from(p[axis])));
    for origin in [[0.0; 3], FAR] {
        for up in [UpAxis::Y, UpAxis::Z] {
            let options = MeshOptions { up, ..MeshOptions::default() };
            let bytes = written(origin, &options, &[]);
            let mesh =
                read_mesh(&bytes, "a.abc", &Limits::default(), &|_| unreachable!("one file")).expect("read");
            // Alembic has Y up.
            let rotated = |[x, y, z]: [f64; 3]| if up == UpAxis::Z { [x, z, -y] } else { [x, y, z] };
            assert_eq!(mesh.positions, world(origin).map(rotated));
            assert_eq!(mesh.normals, NORMALS.map(|n| rotated(n.map(f64::from)).map(|x| x as f32)));
            assert_eq!(mesh.triangles, TRIANGLES);
            assert_eq!(abc::read_times(&bytes).expect("one time"), [0.0]);
            assert_eq!(abc::read_sequence_info(&mut Cursor::new(&bytes)).expect("one frame"), None);
        }
    }
    let options = MeshOptions { quads: QUADS.into(), ..MeshOptions::default() };
    let mesh = abc::read_mesh(&written([0.0; 3], &options, &[]), &Limits::default()).expect("read");
    // The reader may split the quad along the other diagonal, or start at another corner.
    assert_eq!(mesh.triangles[2..], TRIANGLES[2..]);
    let mut corners = mesh.triangles[..2].concat();
    corners.sort_unstable();
    corners.dedup();
    assert_eq!(corners, [0, 1, 2, 3]);
}

#[test]
fn abc_becomes_the_glb_of_the_same_mesh() {
    let bytes = pyramid();
    let (glb, notes) = to_glb(&bytes, &Limits::default()).expect("converted");
    assert!(notes.iter().any(|note| note.starts_with("large ")), "{notes:?}");
    let [mesh, expected] = [
        gltf::read_mesh(&glb, &Limits::default()).expect("our own file"),
        abc::read_mesh(&bytes, &Limits::default()).expect("our own file"),
    ];
    assert_eq!(mesh.triangles, expected.triangles);
    // The .glb stores the rotation of the axes as a quaternion, which is not exact.
    let pairs = mesh.positions.as_flattened().iter().zip(expected.positions.as_flattened());
    assert!(mesh.positions.len() == 5 && pairs.into_iter().all(|(a, b)| (a - b).abs() < 1e-9));
    assert_eq!(read_provenance(OutputFormat::Glb, &glb[..]).expect("our own file"), provenance());
    let attributes = gltf::read_attributes(&glb, &Limits::default()).expect("attributes");
    let found: Vec<(&str, usize)> =
        attributes.iter().map(|attribute| (attribute.name.as_str(), attribute.arity)).collect();
    assert!(found.contains(&("_VELOCITY", 3)) && found.contains(&("COLOR_0", 3)), "{found:?}");
    assert!(found.contains(&("_SMALL", 1)) && found.contains(&("_NAME", 1)), "{found:?}");
    for at in 0..bytes.len() {
        let mut damaged = bytes.clone();
        damaged[at] ^= 0x81;
        let _ = to_glb(&damaged, &Limits::default());
    }
}

#[test]
fn abc_stores_attributes_by_name_and_type() {
    let bytes = pyramid();
    let holds = |part: &[u8]| bytes.windows(part.len()).any(|window| window == part);
    for part in [
        &b"\x0b.velocities\x15interpretation=vector"[..],
        b"\x02Cd\x5carrayExtent=1;geoScope=vtx;interpretation=rgb;isGeomParam=true;podExtent=3;podName=float32_t",
        b"\x03a_b\x49arrayExtent=5;geoScope=vtx;isGeomParam=true;podExtent=1;podName=float32_t",
        b"small\x47arrayExtent=1;geoScope=vtx;isGeomParam=true;podExtent=1;podName=int32_t",
        b"large\x47arrayExtent=1;geoScope=vtx;isGeomParam=true;podExtent=1;podName=int64_t",
        b"a b\0\xc3\xbc\0\0",
        &[[2, 0, 0, 0], [2, 0, 0, 0]].concat(),
    ] {
        assert!(holds(part), "{}", part.escape_ascii());
    }
}

#[test]
fn abc_provenance_is_read_from_the_head() {
    let bytes = pyramid();
    assert_eq!(read_provenance(OutputFormat::Abc, &bytes[..]).expect("our own file"), provenance());
    assert_eq!(read_provenance(OutputFormat::Abc, &bytes[..500]).expect("a head"), provenance());
    assert!(read_provenance(OutputFormat::Abc, &b"glTF"[..]).is_err());
}

#[test]
fn truncated_or_extended_abc_is_rejected() {
    let bytes = pyramid();
    let is_whole = |bytes: &[u8]| is_complete(OutputFormat::Abc, &mut Cursor::new(bytes)).unwrap_or(false);
    assert!(is_whole(&bytes) && !is_whole(&[&bytes[..], b"\n"].concat()));
    for length in 0..bytes.len() {
        let part = &bytes[..length];
        assert!(!is_whole(part), "{length} of {}", bytes.len());
        let error = abc::read_mesh(part, &Limits::default()).expect_err("the root group is missing");
        assert!(error.is_truncated(), "{length} of {}: {error}", bytes.len());
        let _ = read_provenance(OutputFormat::Abc, part);
    }
}

#[test]
fn damaged_abc_is_read_or_rejected() {
    let bytes = pyramid();
    for at in 0..bytes.len() {
        for damage in [0x01, 0x80, 0xff] {
            let mut damaged = bytes.clone();
            damaged[at] ^= damage;
            if let Ok(mesh) = abc::read_mesh(&damaged, &Limits::default()) {
                assert!(
                    mesh.triangles
                        .as_flattened()
                        .iter()
                        .all(|&corner| (corner as usize) < mesh.positions.len())
                );
                assert!(mesh.normals.is_empty() || mesh.normals.len() == mesh.positions.len());
            }
            let _ = (abc::read_times(&damaged), abc::read_sequence_info(&mut Cursor::new(&damaged)));
        }
    }
}

#[test]
fn meshes_of_other_programs_are_read_and_not_converted() {
    let bytes = pyramid();
    let name = bytes.windows(9).position(|part| part == b"meniscus ").expect("its name");
    let mut foreign = bytes.clone();
    foreign[name..name + 8].copy_from_slice(b"someone_");
    let read = |bytes: &[u8]| abc::read_mesh(bytes, &Limits::default()).expect("a mesh");
    assert_eq!(read(&foreign), read(&bytes));
    assert_eq!(abc::read_attributes(&foreign, &Limits::default()).expect("none"), []);
    let error = to_glb(&foreign, &Limits::default()).expect_err("another program's");
    assert!(matches!(error, Error::Unsupported { .. }) && error.to_string().contains("as PLY"), "{error}");
    assert_eq!(read_provenance(OutputFormat::Abc, &foreign[..]).expect("an archive"), []);
}

#[test]
fn invalid_meshes_are_refused_as_abc() {
    let mesh = MeshView {
        positions: &POSITIONS,
        normals: &NORMALS,
        triangles: &[[0, 1, 9]],
        origin: [0.0; 3],
        attributes: &[],
    };
    let refused = abc::write(&mesh, &MeshOptions::default(), &[], &mut Vec::new());
    assert!(matches!(refused, Err(Error::Invalid { .. })), "{refused:?}");
    let quads = MeshOptions { quads: vec![true; 6].into(), ..MeshOptions::default() };
    let refused = abc::write(&MeshView { triangles: &TRIANGLES, ..mesh }, &quads, &[], &mut Vec::new());
    assert!(matches!(refused, Err(Error::Invalid { .. })), "{refused:?}");
}

#[test]
fn table_of_strings_counts_as_much_as_it_takes() {
    let table = vec![String::new(); 1 << 20];
    let values = VertexValues::Strings { table: &table, indices: &[0, 1, 2, -1, 0] };
    let bytes = written(
        [0.0; 3],
        &MeshOptions::default(),
        &[VertexAttribute { name: "name", role: None, arity: 1, values }],
    );
    assert!(to_glb(&bytes, &Limits::default()).is_ok());
    // Each string is one byte in the file.
    let limits = Limits { memory_bytes: 16 << 20, ..Limits::default() };
    assert!(bytes.len() < 2 << 20);
    assert!(matches!(to_glb(&bytes, &limits), Err(Error::MemoryLimit { .. })));
}
