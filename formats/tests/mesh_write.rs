//! Meshes written as .glb, .gltf, .obj and .ply, read by our own and other readers.

#![allow(clippy::cast_possible_truncation, reason = "test numbers are small")]

use meniscus_formats::{
    Error, Limits, MeshData, MeshOptions, MeshView, OutputFormat, gltf, obj, ply, read_provenance,
};

fn provenance() -> Vec<(String, String)> {
    [("version", "0.1.0"), ("radius", "0.025"), ("input", "größe: \"a\\b\"\nend_header\n"), ("a", "")]
        .map(|(key, value)| (key.to_string(), value.to_string()))
        .to_vec()
}

struct Mesh {
    positions: Vec<[f32; 3]>,
    normals: Vec<[f32; 3]>,
    triangles: Vec<[u32; 3]>,
    origin: [f64; 3],
}

impl Mesh {
    fn view(&self) -> MeshView<'_> {
        MeshView {
            positions: &self.positions,
            normals: &self.normals,
            triangles: &self.triangles,
            origin: self.origin,
            attributes: &[],
        }
    }

    fn world(&self) -> Vec<[f64; 3]> {
        let world = |p: &[f32; 3]| std::array::from_fn(|axis| self.origin[axis] + f64::from(p[axis]));
        self.positions.iter().map(world).collect()
    }
}

/// A ball of rings × sectors quads. Vertices at the poles and the seam are not shared.
fn ball(rings: u32, sectors: u32, origin: [f64; 3]) -> Mesh {
    let mut mesh = Mesh { positions: Vec::new(), normals: Vec::new(), triangles: Vec::new(), origin };
    for ring in 0..=rings {
        for sector in 0..=sectors {
            let theta = (f64::from(ring) + 0.25) / (f64::from(rings) + 0.5) * std::f64::consts::PI;
            let phi = f64::from(sector) / f64::from(sectors) * std::f64::consts::TAU;
            let normal = [theta.sin() * phi.cos(), theta.sin() * phi.sin(), theta.cos()].map(|c| c as f32);
            mesh.normals.push(normal);
            mesh.positions.push(normal.map(|c| 0.1 + 1.7 * c));
        }
    }
    let row = sectors + 1;
    for ring in 0..rings {
        for sector in 0..sectors {
            let a = ring * row + sector;
            mesh.triangles.extend([[a, a + row, a + 1], [a + 1, a + row, a + row + 1]]);
        }
    }
    mesh
}

fn nothing() -> Mesh {
    Mesh { positions: Vec::new(), normals: Vec::new(), triangles: Vec::new(), origin: [1.0, 2.0, 3.0] }
}

fn glb(mesh: &Mesh, up: gltf::UpAxis) -> Vec<u8> {
    let mut bytes = Vec::new();
    let options = MeshOptions { up, ..MeshOptions::default() };
    gltf::write_glb(&mesh.view(), &options, &provenance(), &mut bytes).expect("writing to memory");
    bytes
}

fn gltf_text(mesh: &Mesh, up: gltf::UpAxis) -> Vec<u8> {
    let mut bytes = Vec::new();
    let options = MeshOptions { up, ..MeshOptions::default() };
    gltf::write_gltf(&mesh.view(), &options, &provenance(), &mut bytes).expect("writing to memory");
    bytes
}

fn obj_text(mesh: &Mesh) -> Vec<u8> {
    let mut bytes = Vec::new();
    OutputFormat::Obj
        .write_mesh(&mesh.view(), &MeshOptions::default(), &provenance(), &mut bytes)
        .expect("writing to memory");
    bytes
}

fn ply_bytes(mesh: &Mesh) -> Vec<u8> {
    let mut bytes = Vec::new();
    ply::write::write_mesh(&mesh.view(), &provenance(), &mut bytes).expect("writing to memory");
    bytes
}

fn assert_near(found: &MeshData, mesh: &Mesh, up: gltf::UpAxis) {
    let rotated = |[x, y, z]: [f64; 3]| if up == gltf::UpAxis::Z { [x, z, -y] } else { [x, y, z] };
    assert_eq!(found.triangles, mesh.triangles);
    assert_eq!(found.positions.len(), mesh.positions.len());
    for (found, expected) in found.positions.iter().zip(mesh.world()) {
        assert!((0..3).all(|axis| (found[axis] - rotated(expected)[axis]).abs() < 1e-9));
    }
    for (found, expected) in found.normals.iter().zip(&mesh.normals) {
        assert!(
            (0..3).all(|axis| (found[axis] - rotated(expected.map(f64::from))[axis] as f32).abs() < 1e-6)
        );
    }
}

const FAR: [f64; 3] = [1e6 + 0.1, -2e6, 0.3];

#[test]
fn gltf_round_trips() {
    for mesh in [ball(20, 30, [0.0; 3]), ball(20, 30, FAR), ball(300, 300, [0.0; 3])] {
        for up in [gltf::UpAxis::Y, gltf::UpAxis::Z] {
            for bytes in [glb(&mesh, up), gltf_text(&mesh, up)] {
                let found = gltf::read_mesh(&bytes, &Limits::default()).expect("our own file");
                assert_near(&found, &mesh, up);
            }
        }
    }
    for bytes in [glb(&nothing(), gltf::UpAxis::Z), gltf_text(&nothing(), gltf::UpAxis::Z)] {
        assert_eq!(gltf::read_mesh(&bytes, &Limits::default()).expect("an empty scene"), MeshData::default());
    }
}

#[test]
fn the_gltf_crate_reads_glb() {
    for (mesh, narrow) in [(ball(20, 30, FAR), true), (ball(300, 300, FAR), false)] {
        let bytes = glb(&mesh, gltf::UpAxis::Z);
        let other = ::gltf::Gltf::from_slice(&bytes).expect("a document");
        let blob = other.blob.as_ref().expect("a binary chunk");
        let node = other.nodes().next().expect("a node");
        let primitive = node.mesh().and_then(|mesh| mesh.primitives().next()).expect("a primitive");
        let reader = primitive.reader(|_| Some(blob));
        let positions: Vec<_> = reader.read_positions().expect("positions").collect();
        let normals: Vec<_> = reader.read_normals().expect("normals").collect();
        let indices = reader.read_indices().expect("indices");
        assert_eq!(matches!(indices, ::gltf::mesh::util::ReadIndices::U16(_)), narrow);
        let indices: Vec<u32> = indices.into_u32().collect();
        assert!(positions == mesh.positions && normals == mesh.normals);
        assert_eq!(indices, mesh.triangles.as_flattened());
        let bounds = primitive.bounding_box();
        for axis in 0..3 {
            let on = || mesh.positions.iter().map(|position| position[axis]);
            assert_eq!(bounds.min[axis], on().fold(f32::MAX, f32::min));
            assert_eq!(bounds.max[axis], on().fold(f32::MIN, f32::max));
        }
        assert!(blob.len().is_multiple_of(4) && bytes.len().is_multiple_of(4));
    }
}

#[test]
fn obj_round_trips_exactly() {
    for mesh in [ball(150, 200, [0.0; 3]), ball(20, 30, FAR)] {
        let bytes = obj_text(&mesh);
        let found = obj::read_mesh(&bytes).expect("our own file");
        // The reader numbers vertices in order of use.
        let corners = |triangles: &[[u32; 3]], positions: &[[f64; 3]], normals: &[[f32; 3]]| -> Vec<_> {
            let corner =
                |&i: &u32| (positions[i as usize].map(f64::to_bits), normals[i as usize].map(f32::to_bits));
            triangles.as_flattened().iter().map(corner).collect()
        };
        // If the origin is zero, each number is the shortest text that parses back to the same 32-bit value.
        let narrow = mesh.origin == [0.0; 3];
        let positions =
            found.positions.iter().map(|p| if narrow { p.map(|c| f64::from(c as f32)) } else { *p });
        let positions: Vec<[f64; 3]> = positions.collect();
        assert!(
            corners(&found.triangles, &positions, &found.normals)
                == corners(&mesh.triangles, &mesh.world(), &mesh.normals)
        );
    }
    let text = String::from_utf8(obj_text(&nothing())).expect("UTF-8");
    assert!(text.lines().all(|line| line.starts_with('#') || line == "o surface"));
    assert_eq!(obj::read_mesh(text.as_bytes()).expect("an empty mesh"), MeshData::default());
}

#[test]
fn ply_has_the_size_declared_by_its_header() {
    for (mesh, vertex_bytes) in [(ball(90, 90, [0.0; 3]), 24), (ball(20, 30, FAR), 36), (nothing(), 36)] {
        let bytes = ply_bytes(&mesh);
        let end = bytes.windows(11).position(|part| part == b"end_header\n").expect("an end") + 11;
        let header = std::str::from_utf8(&bytes[..end]).expect("ASCII");
        assert!(header.is_ascii() && header.contains(&format!("element vertex {}\n", mesh.positions.len())));
        let (vertices, faces) = bytes[end..].split_at(mesh.positions.len() * vertex_bytes);
        assert_eq!(faces.len(), mesh.triangles.len() * 13);
        let mut words = vertices.as_chunks::<4>().0.iter();
        for (world, normal) in mesh.world().iter().zip(&mesh.normals) {
            for expected in *world {
                let mut word = || *words.next().expect("a word");
                let found = if vertex_bytes == 24 {
                    f64::from(f32::from_le_bytes(word()))
                } else {
                    f64::from_le_bytes([word(), word()].concat().try_into().expect("eight bytes"))
                };
                assert_eq!(found, expected);
            }
            for c in normal {
                assert_eq!(f32::from_le_bytes(*words.next().expect("a word")), *c);
            }
        }
        for (face, triangle) in faces.as_chunks::<13>().0.iter().zip(&mesh.triangles) {
            assert_eq!(face[0], 3);
            assert_eq!(face[1..], *triangle.map(u32::to_le_bytes).as_flattened());
        }
    }
}

#[test]
fn provenance_of_level_sets_and_foreign_files_is_read() {
    let leaf = [0.25; 512];
    let levels = meniscus_formats::LevelSetView {
        origins: &[[0; 3]],
        leaves: &[leaf],
        half_width_voxels: 3.0,
        voxel_size: 0.1,
        grids: &[],
    };
    let mut vdb = Vec::new();
    let options = meniscus_formats::vdb::WriteOptions::default();
    meniscus_formats::vdb::write(&levels, &options, &provenance(), &mut vdb).expect("writing to memory");
    let kind = OutputFormat::Vdb;
    assert_eq!(read_provenance(kind, &vdb[..]).expect("our own file"), provenance());
    assert_eq!(read_provenance(kind, &vdb[..1500]).expect("a head"), provenance());
    for length in 0..1500 {
        let _ = read_provenance(kind, &vdb[..length]);
    }
    for (kind, foreign) in [
        (
            OutputFormat::Gltf,
            &br#"{"scenes":[{}],"asset":{"version":"2.0","extras":[1,{"meniscus":{"a":"b"}}]}}"#[..],
        ),
        (OutputFormat::Gltf, br#"{"asset":{"version":"2.0"}}"#),
        (OutputFormat::Gltf, br#"{"asset":{"version":"2.0","extras":{"meniscus":7}}}"#),
        (OutputFormat::Obj, b"# Blender\n# meniscus\nv 0 0 0\n# meniscus_radius: 3\n"),
        (OutputFormat::Ply, b"ply\r\nformat ascii 1.0\r\nend_header\r\ncomment meniscus_a: b\r\n"),
    ] {
        assert_eq!(read_provenance(kind, foreign).expect("a foreign file"), [], "{kind:?}");
    }
    assert!(read_provenance(OutputFormat::Glb, &b"ply\n"[..]).is_err());
    assert!(read_provenance(OutputFormat::Vdb, &b"ply\n"[..]).is_err());
}

#[test]
fn invalid_meshes_are_an_error() {
    let mut mesh = ball(3, 4, [0.0; 3]);
    mesh.triangles[2][1] = mesh.positions.len() as u32;
    let refused = |mesh: &Mesh| {
        let error = OutputFormat::Obj.write_mesh(&mesh.view(), &MeshOptions::default(), &[], &mut Vec::new());
        assert!(matches!(error, Err(Error::Invalid { .. })));
        assert!(ply::write::write_mesh(&mesh.view(), &[], &mut Vec::new()).is_err());
        assert!(gltf::write_glb(&mesh.view(), &MeshOptions::default(), &[], &mut Vec::new()).is_err());
    };
    refused(&mesh);
    let mut mesh = ball(3, 4, [0.0; 3]);
    mesh.positions[1][2] = f32::NAN;
    refused(&mesh);
    let mut mesh = ball(3, 4, [0.0; 3]);
    mesh.normals.pop();
    refused(&mesh);
}

#[test]
fn damaged_meshes_are_errors_without_panics() {
    let mesh = ball(4, 5, FAR);
    let mut state = 1u64;
    let mut below = |end: usize| {
        state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
        (state >> 33) as usize % end
    };
    let files = [glb(&mesh, gltf::UpAxis::Z), gltf_text(&mesh, gltf::UpAxis::Z), obj_text(&mesh)];
    for (index, bytes) in files.iter().enumerate() {
        let read = |bytes: &[u8]| match index {
            2 => obj::read_mesh(bytes).is_ok(),
            _ => gltf::read_mesh(bytes, &Limits::default()).is_ok(),
        };
        assert!(read(bytes));
        for length in 0..bytes.len() - 4 {
            assert!(!read(&bytes[..length]) || index == 2);
        }
        for _ in 0..20_000 {
            let mut broken = bytes.clone();
            for _ in 0..1 + below(3) {
                let at = below(broken.len());
                broken[at] =
                    if below(2) == 0 { broken[at] ^ 1 << below(8) } else { b"0123456789-e. /\n"[below(16)] };
            }
            read(&broken);
        }
    }
}

/// The corners of each face line of an OBJ file.
fn faces(text: &[u8]) -> Vec<Vec<u32>> {
    let text = std::str::from_utf8(text).expect("text");
    let corner = |word: &str| word.split('/').next().and_then(|index| index.parse().ok()).expect("an index");
    text.lines()
        .filter_map(|line| line.strip_prefix("f "))
        .map(|face| face.split(' ').map(corner).collect())
        .collect()
}

#[test]
fn obj_quads_are_written_as_quads() {
    // A single triangle, then so many quads that some of them cross the boundary between two parallel tasks.
    let mut mesh = ball(60, 150, [0.0; 3]);
    mesh.triangles.insert(0, mesh.triangles[0]);
    let count = mesh.triangles.len();
    assert!(count > 1 << 14);
    let quads: std::sync::Arc<[bool]> = (0..count).map(|index| index % 2 == 1).collect();
    let options = MeshOptions { quads: quads.clone(), ..MeshOptions::default() };
    let mut bytes = Vec::new();
    OutputFormat::Obj.write_mesh(&mesh.view(), &options, &[], &mut bytes).expect("written");
    let faces = faces(&bytes);
    assert_eq!(faces.len(), 1 + count / 2);
    assert_eq!(faces[0].len(), 3);
    for (face, halves) in faces[1..].iter().zip(mesh.triangles[1..].chunks(2)) {
        // The quad consists of both triangles: it has all their edges except the diagonal, once and in the
        // same direction.
        let edges = |corners: &[u32]| -> Vec<[u32; 2]> {
            (0..corners.len()).map(|k| [corners[k], corners[(k + 1) % corners.len()]]).collect()
        };
        let one_up = |triangle: [u32; 3]| triangle.map(|index| index + 1);
        let halves = [edges(&one_up(halves[0])), edges(&one_up(halves[1]))].concat();
        assert_eq!(face.len(), 4);
        assert!(edges(face).iter().all(|edge| halves.contains(edge)));
        assert_eq!(halves.iter().filter(|[from, to]| !halves.contains(&[*to, *from])).count(), 4);
    }
    let read = obj::read_mesh(&bytes).expect("our own file");
    assert_eq!(read.triangles.len(), count);
    assert!(std::str::from_utf8(&bytes).unwrap().ends_with(" 1 triangles, 9000 quads\n"));
    // Inconsistent quad flags are an error.
    let marked = |marks: Vec<bool>| MeshOptions { quads: marks.into(), ..MeshOptions::default() };
    let mut at_end = quads.to_vec();
    at_end[count - 2..].fill(false);
    at_end[count - 1] = true;
    for invalid in
        [vec![true; 3], vec![true; count], at_end, [vec![true, false], quads[2..].to_vec()].concat()]
    {
        let error = OutputFormat::Obj.write_mesh(&mesh.view(), &marked(invalid), &[], &mut Vec::new());
        assert!(matches!(error, Err(Error::Invalid { .. })), "{error:?}");
    }
}
