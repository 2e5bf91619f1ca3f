//! Meshes written as .vtp, .stl and USD, read by our own and other readers: exact to the
//! last bit where the format allows it.

#![allow(clippy::cast_possible_truncation, reason = "test numbers are small")]

use std::io::Cursor;

use meniscus_formats::{
    AttributeRole, Error, Limits, MeshData, MeshOptions, MeshView, OutputFormat, Values, VertexAttribute,
    VertexValues, gltf, is_complete, read_particles, read_provenance, stl, vtk,
};

pub(crate) const FAR: [f64; 3] = [1e6 + 0.1, -2e6, 0.3];

pub(crate) fn provenance() -> Vec<(String, String)> {
    [
        ("generator", "meniscus 0.1.0"),
        ("radius", "0.025"),
        ("input", "größe: \"a\\b\" <x>\nend_header\n"),
        ("a", ""),
    ]
    .map(|(key, value)| (key.to_string(), value.to_string()))
    .to_vec()
}

/// A torus of quads, followed by a single triangle. Each quad is two triangles, where the first vertex of one
/// is the last vertex of the other.
pub(crate) struct Mesh {
    pub(crate) positions: Vec<[f32; 3]>,
    pub(crate) normals: Vec<[f32; 3]>,
    pub(crate) triangles: Vec<[u32; 3]>,
    pub(crate) quads: Vec<bool>,
    pub(crate) origin: [f64; 3],
    pub(crate) heat: Vec<f32>,
    pub(crate) velocity: Vec<f32>,
    pub(crate) color: Vec<f32>,
    pub(crate) ids: Vec<i64>,
    pub(crate) table: Vec<String>,
    pub(crate) names: Vec<i32>,
}

pub(crate) fn torus(around: u32, across: u32, origin: [f64; 3]) -> Mesh {
    let (mut positions, mut normals, mut triangles) = (Vec::new(), Vec::new(), Vec::new());
    for i in 0..around {
        for j in 0..across {
            let angle = |index, count| f64::from(index) / f64::from(count) * std::f64::consts::TAU;
            let ((sin_u, cos_u), (sin_v, cos_v)) = (angle(i, around).sin_cos(), angle(j, across).sin_cos());
            normals.push([cos_v * cos_u, cos_v * sin_u, sin_v].map(|c| c as f32));
            let reach = 1.0 + 0.3 * cos_v;
            positions.push([reach * cos_u, reach * sin_u, 0.3 * sin_v].map(|c| c as f32));
            let at = |i: u32, j: u32| (i % around) * across + j % across;
            let [a, b, c, d] = [at(i, j), at(i + 1, j), at(i + 1, j + 1), at(i, j + 1)];
            triangles.extend([[a, b, d], [b, c, d]]);
        }
    }
    let mut quads: Vec<bool> = (0..triangles.len()).map(|index| index % 2 == 0).collect();
    triangles.push([0, across, 1]);
    quads.push(false);
    let count = positions.len();
    let color = (0..count).flat_map(|i| [i as f32 / count as f32, 0.5, 1.0, 0.25]).collect();
    Mesh {
        heat: (0..count).map(|i| 0.1 * i as f32 - 3.0).collect(),
        velocity: positions.iter().flat_map(|[x, y, z]| [-y, *x, 1e-9 * z]).collect(),
        color,
        ids: (0..count as i64).map(|i| (1 << 40) + i).collect(),
        table: vec!["a \"b\" <c>".into(), "d".into()],
        names: (0..count as i32).map(|i| i % 3 - 1).collect(),
        positions,
        normals,
        triangles,
        quads,
        origin,
    }
}

pub(crate) fn nothing() -> Mesh {
    let mesh = torus(3, 3, FAR);
    let (positions, normals, triangles, quads) = Default::default();
    let [heat, velocity, color] = Default::default();
    let (ids, names) = Default::default();
    Mesh { positions, normals, triangles, quads, heat, velocity, color, ids, names, ..mesh }
}

/// An attribute with these numbers.
pub(crate) fn of_numbers<'a>(
    name: &'a str,
    role: Option<AttributeRole>,
    arity: usize,
    values: &'a [f32],
) -> VertexAttribute<'a> {
    VertexAttribute { name, role, arity, values: VertexValues::Numbers(values) }
}

impl Mesh {
    pub(crate) fn attributes(&self) -> Vec<VertexAttribute<'_>> {
        vec![
            of_numbers("heat \u{1}2", None, 1, &self.heat),
            of_numbers("v", Some(AttributeRole::Velocity), 3, &self.velocity),
            of_numbers("Cd", Some(AttributeRole::Color), 4, &self.color),
            VertexAttribute {
                name: "id",
                role: Some(AttributeRole::Id),
                arity: 1,
                values: VertexValues::Integers(&self.ids),
            },
            VertexAttribute {
                name: "2nd",
                role: None,
                arity: 1,
                values: VertexValues::Strings { table: &self.table, indices: &self.names },
            },
        ]
    }

    pub(crate) fn view<'a>(&'a self, attributes: &'a [VertexAttribute<'a>]) -> MeshView<'a> {
        MeshView {
            positions: &self.positions,
            normals: &self.normals,
            triangles: &self.triangles,
            origin: self.origin,
            attributes,
        }
    }

    pub(crate) fn world(&self) -> Vec<[f64; 3]> {
        let world = |p: &[f32; 3]| std::array::from_fn(|axis| self.origin[axis] + f64::from(p[axis]));
        self.positions.iter().map(world).collect()
    }
}

fn vtp(mesh: &Mesh, has_quads: bool) -> Vec<u8> {
    let mut bytes = Vec::new();
    let options = MeshOptions {
        quads: if has_quads { mesh.quads.clone().into() } else { [].into() },
        ..MeshOptions::default()
    };
    vtk::write_mesh(&mesh.view(&mesh.attributes()), &options, &provenance(), &mut bytes)
        .expect("writing to memory");
    bytes
}

fn stl_bytes(mesh: &Mesh) -> Vec<u8> {
    let mut bytes = Vec::new();
    stl::write(&mesh.view(&mesh.attributes()), &provenance(), &mut bytes).expect("writing to memory");
    bytes
}

pub(crate) fn usda_text(mesh: &Mesh, has_quads: bool, up: gltf::UpAxis) -> String {
    let mut bytes = Vec::new();
    let quads = if has_quads { mesh.quads.clone().into() } else { [].into() };
    let options = MeshOptions { up, quads, ..MeshOptions::default() };
    OutputFormat::Usda
        .write_mesh(&mesh.view(&mesh.attributes()), &options, &provenance(), &mut bytes)
        .expect("writing to memory");
    String::from_utf8(bytes).expect("UTF-8")
}

pub(crate) fn usdc_bytes(mesh: &Mesh, has_quads: bool, up: gltf::UpAxis) -> Vec<u8> {
    let mut bytes = Vec::new();
    let quads = if has_quads { mesh.quads.clone().into() } else { [].into() };
    let options = MeshOptions { up, quads, ..MeshOptions::default() };
    OutputFormat::Usdc
        .write_mesh(&mesh.view(&mesh.attributes()), &options, &provenance(), &mut bytes)
        .expect("writing to memory");
    bytes
}

/// The triangle fans of the faces.
pub(crate) fn fans(mesh: &Mesh) -> Vec<[u32; 3]> {
    let quads = mesh.triangles[..mesh.triangles.len().saturating_sub(1)].as_chunks::<2>().0;
    // A quad starts at the first corner of its diagonal: (a b d) (b c d) is the quad b c d a.
    let fan = |&[[a, b, d], [_, c, _]]: &[[u32; 3]; 2]| [[b, c, d], [b, d, a]];
    quads.iter().flat_map(fan).chain(mesh.triangles.last().copied()).collect()
}

#[test]
fn vtp_round_trips_exactly() {
    for mesh in [torus(20, 12, [0.0; 3]), torus(20, 12, FAR), torus(130, 70, [0.0; 3]), nothing()] {
        for has_quads in [false, true] {
            let bytes = vtp(&mesh, has_quads);
            let limits = Limits::default();
            let found = vtk::read_mesh(&bytes, &limits).expect("our own file");
            assert_eq!(found.positions, mesh.world());
            if has_quads {
                assert_eq!(found.triangles, fans(&mesh))
            } else {
                assert_eq!(found.triangles, mesh.triangles)
            }
            let frame = read_particles(&bytes, "a.vtp", &limits).expect("our own file");
            let values = |name: &str| {
                let found = frame.attributes.iter().find(|attribute| attribute.name == name);
                found.unwrap_or_else(|| panic!("{name} is not in {:?}", frame.attributes)).values.clone()
            };
            if mesh.positions.is_empty() {
                continue;
            }
            assert_eq!(values("Normals"), Values::F32(mesh.normals.as_flattened().to_vec()));
            assert_eq!(values("heat _2"), Values::F32(mesh.heat.clone()));
            assert_eq!(values("v"), Values::F32(mesh.velocity.clone()));
            assert_eq!(values("Cd"), Values::F32(mesh.color.clone()));
            assert_eq!(values("id"), Values::I64(mesh.ids.clone()));
            assert_eq!(values("2nd"), Values::I32(mesh.names.clone()));
        }
    }
    let attributes = torus(3, 3, FAR);
    assert_eq!(vtk::attribute_notes(&attributes.attributes()), ["heat \u{1}2 is named heat _2 in the .vtp"]);
}

#[test]
fn vtp_quads_are_polygons_with_four_corners() {
    let mesh = torus(20, 12, [0.0; 3]);
    let text = String::from_utf8_lossy(&vtp(&mesh, true)).into_owned();
    assert!(text.contains(&format!("NumberOfPolys=\"{}\"", mesh.triangles.len() / 2 + 1)), "{text:.900}");
}

#[test]
fn stl_round_trips_in_32_bits() {
    for mesh in [torus(20, 12, [0.0; 3]), torus(20, 12, FAR), nothing()] {
        let bytes = stl_bytes(&mesh);
        assert!(bytes.len() == 84 + 50 * mesh.triangles.len() && !bytes.starts_with(b"solid"));
        let found = stl::read_mesh(&bytes, &Limits::default()).expect("our own file");
        let narrow = |p: &[f64; 3]| p.map(|c| f64::from(c as f32));
        let world: Vec<[f64; 3]> = mesh.world().iter().map(narrow).collect();
        let corners: Vec<[f64; 3]> =
            mesh.triangles.as_flattened().iter().map(|&i| world[i as usize]).collect();
        assert_eq!(found.positions, corners);
        // Each normal is the outward normal of the triangle's plane.
        for (record, triangle) in bytes[84..].as_chunks::<50>().0.iter().zip(&mesh.triangles) {
            let normal =
                |at: usize| f32::from_le_bytes(record[4 * at..4 * at + 4].try_into().expect("four bytes"));
            let normal = [normal(0), normal(1), normal(2)];
            assert!((normal.iter().map(|c| c * c).sum::<f32>() - 1.0).abs() < 1e-6);
            let along: f32 = (0..3).map(|axis| normal[axis] * mesh.normals[triangle[0] as usize][axis]).sum();
            assert!(along > 0.5, "{along}");
            assert_eq!(record[48..], [0, 0]);
        }
    }
}

#[test]
fn degenerate_triangle_has_zero_normal_in_stl() {
    let view = MeshView {
        positions: &[[1.0, 2.0, 3.0]; 3],
        normals: &[[1.0, 0.0, 0.0]; 3],
        triangles: &[[0, 1, 2]],
        origin: [0.0; 3],
        attributes: &[],
    };
    let mut bytes = Vec::new();
    stl::write(&view, &[], &mut bytes).expect("written");
    assert_eq!(bytes[84..96], [0; 12]);
}

/// A mesh in each format.
fn files() -> Vec<(OutputFormat, Vec<u8>)> {
    let mesh = torus(9, 7, FAR);
    let attributes = mesh.attributes();
    let options = MeshOptions { quads: mesh.quads.clone().into(), ..MeshOptions::default() };
    let written = |format: OutputFormat| {
        let mut bytes = Vec::new();
        let view = mesh.view(&attributes);
        format.write_mesh(&view, &options, &provenance(), &mut bytes).expect("writing to memory");
        (format, bytes)
    };
    OutputFormat::ALL.into_iter().filter(|format| format.is_mesh()).map(written).collect()
}

#[test]
fn provenance_is_read_from_the_head() {
    for (kind, bytes) in files() {
        // The 80 bytes of an STL title only have space for the generator and abbreviated names.
        let expected = if kind == OutputFormat::Stl { provenance()[..1].to_vec() } else { provenance() };
        assert_eq!(read_provenance(kind, &bytes[..]).expect("our own file"), expected, "{kind:?}");
        assert_eq!(read_provenance(kind, &bytes[..2500]).expect("a head"), expected, "{kind:?}");
        for length in 0..2500 {
            let _ = read_provenance(kind, &bytes[..length]);
        }
    }
    let foreign: [(OutputFormat, &[u8]); 2] = [
        (
            OutputFormat::Vtp,
            b"<VTKFile type=\"PolyData\"><PolyData><FieldData><Array Name=\"TimeValue\">1 0</Array>",
        ),
        (OutputFormat::Stl, &[b'x'; 84]),
    ];
    for (kind, bytes) in foreign {
        assert_eq!(read_provenance(kind, bytes).expect("a foreign file"), [], "{kind:?}");
    }
    assert!(read_provenance(OutputFormat::Vtp, &b"<html>"[..]).is_err());
}

#[test]
fn truncated_or_extended_files_are_incomplete() {
    for (kind, bytes) in files() {
        let whole = |bytes: &[u8]| is_complete(kind, &mut Cursor::new(bytes)).unwrap_or(false);
        assert!(whole(&bytes), "{kind:?}");
        for length in (0..bytes.len()).rev().step_by(7).chain(bytes.len() - 40..bytes.len()) {
            assert!(!whole(&bytes[..length]), "{kind:?} at {length} of {}", bytes.len());
        }
        assert!(!whole(&[&bytes[..], b"\nmore\n"].concat()), "{kind:?}");
    }
}

#[test]
fn invalid_meshes_are_an_error() {
    let refused = |mesh: &Mesh| {
        let view = mesh.view(&[]);
        let quads = || mesh.quads.clone().into();
        let options = MeshOptions { quads: quads(), ..MeshOptions::default() };
        let vtp = vtk::write_mesh(&view, &options, &[], &mut Vec::new());
        assert!(matches!(vtp, Err(Error::Invalid { .. })), "{vtp:?}");
        for format in [OutputFormat::Usda, OutputFormat::Usdc] {
            let usd = format.write_mesh(&view, &options, &[], &mut Vec::new());
            assert!(matches!(usd, Err(Error::Invalid { .. })), "{format}: {usd:?}");
        }
        stl::write(&view, &[], &mut Vec::new())
    };
    let mut mesh = torus(5, 4, [0.0; 3]);
    mesh.triangles[2][1] = 99;
    assert!(refused(&mesh).is_err());
    let mut mesh = torus(5, 4, [0.0; 3]);
    mesh.positions[1][2] = f32::NAN;
    assert!(refused(&mesh).is_err());
    // Invalid quads only matter to formats that support quads.
    let mut mesh = torus(5, 4, [0.0; 3]);
    mesh.quads.fill(true);
    assert!(refused(&mesh).is_ok());
}

#[test]
fn damaged_meshes_are_errors_without_panics() {
    let mut state = 1u64;
    let mut below = |end: usize| {
        state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
        (state >> 33) as usize % end
    };
    let mesh = torus(5, 4, FAR);
    for (bytes, is_vtp) in [(vtp(&mesh, true), true), (stl_bytes(&mesh), false)] {
        let read = |bytes: &[u8]| {
            if is_vtp {
                vtk::read_mesh(bytes, &Limits::default()).is_ok()
            } else {
                stl::read_mesh(bytes, &Limits::default()).is_ok()
            }
        };
        assert!(read(&bytes));
        for length in 0..bytes.len() - 1 {
            assert!(!read(&bytes[..length]), "{length}");
        }
        for _ in 0..5_000 {
            let mut broken = bytes.clone();
            for _ in 0..1 + below(3) {
                let at = below(broken.len());
                broken[at] = if below(2) == 0 {
                    broken[at] ^ 1 << below(8)
                } else {
                    b"0123456789-e. <>\"="[below(18)]
                };
            }
            read(&broken);
        }
    }
    let text = stl::read_mesh(
        b"solid a\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\n",
        &Limits::default(),
    );
    assert!(matches!(text, Err(Error::Unsupported { .. })), "{text:?}");
}

/// The eight points of two squares, one above the other.
const VTK_POINTS: &str = "POINTS 8 float\n0 0 0 1 0 0 1 1 0 0 1 0 0 0 1 1 0 1 1 1 1 0 1 1\n";

fn legacy_mesh(rest: &str) -> meniscus_formats::Result<MeshData> {
    let text = format!("# vtk DataFile Version 5.1\na\nASCII\n{rest}");
    meniscus_formats::read_mesh(text.as_bytes(), "a.vtk", &Limits::default(), &|_| {
        Err(std::io::ErrorKind::NotFound.into())
    })
}

#[test]
fn legacy_vtk_meshes_in_all_layouts_are_read() {
    let quad = [[0, 1, 2], [0, 2, 3]];
    let poly = |cells: &str| legacy_mesh(&format!("DATASET POLYDATA\n{VTK_POINTS}{cells}"));
    let grid = |cells: &str| legacy_mesh(&format!("DATASET UNSTRUCTURED_GRID\n{VTK_POINTS}{cells}"));
    for (name, found, expected) in [
        ("polygons", poly("POLYGONS 2 9\n4 0 1 2 3\n3 4 5 6\n"), vec![quad[0], quad[1], [4, 5, 6]]),
        (
            "offsets",
            poly("POLYGONS 3 7\nOFFSETS vtktypeint64\n0 4 7\nCONNECTIVITY vtktypeint64\n0 1 2 3 4 5 6\n"),
            vec![quad[0], quad[1], [4, 5, 6]],
        ),
        ("strip", poly("TRIANGLE_STRIPS 1 5\n4 0 1 3 2\n"), vec![[0, 1, 3], [3, 1, 2]]),
        ("no triangles", poly("VERTICES 1 2\n1 0\nLINES 1 3\n2 0 1\n"), vec![]),
        (
            "more behind",
            poly("POLYGONS 1 4\n3 0 1 2\nCELL_DATA 1\nSCALARS a int 1\nLOOKUP_TABLE default\n7\n"),
            vec![[0, 1, 2]],
        ),
        (
            "cells",
            grid("CELLS 5 21\n3 0 1 2\n4 0 1 2 3\n4 4 5 7 6\n2 0 1\n3 4 5 6\nCELL_TYPES 5\n5\n9\n8\n3\n7\n"),
            vec![[0, 1, 2], quad[0], quad[1], [4, 5, 6], [4, 6, 7], [4, 5, 6]],
        ),
        (
            "cells with offsets",
            grid(
                "CELLS 2 4\nOFFSETS vtktypeint64\n0 4\nCONNECTIVITY vtktypeint64\n0 1 2 3\nCELL_TYPES 1\n9\n",
            ),
            quad.to_vec(),
        ),
    ] {
        let mesh = found.expect(name);
        assert_eq!((mesh.positions.len(), mesh.triangles), (8, expected), "{name}");
    }
    for (cells, word) in [
        ("CELLS 1 5\n4 0 1 2 4\nCELL_TYPES 1\n10\n", "type 10, which is not a flat polygon"),
        ("CELLS 1 4\n3 0 1 2\n", "0 CELL_TYPES for 1 CELLS"),
        ("CELLS 1 3\n2 0 1\nCELL_TYPES 1\n8\n", "type 8 has 2 corners"),
        ("POLYGONS 1 4\n3 0 1 8\n", "beyond the 8 points"),
        ("POLYGONS 1 4\n3 0 1 -1\n", "beyond the 8 points"),
        ("POLYGONS 1 4\n4 0 1 2\n", "a cell has 4 corners, but only 3 numbers remain"),
        ("POLYGONS 1 4\n-3 0 1 2\n", "a cell has -3 corners"),
        ("POLYGONS 1 99999999\n3 0 1 2\n", "but at most"),
        (
            "POLYGONS 3 6\nOFFSETS vtktypeint64\n0 6 3\nCONNECTIVITY vtktypeint64\n0 1 2 3 4 5\n",
            "ends at corner 3, but there are only 6",
        ),
        (
            "POLYGONS 2 3\nOFFSETS vtktypeint64\n0 4\nCONNECTIVITY vtktypeint64\n0 1 2\n",
            "ends at corner 4, but there are only 3",
        ),
        ("POLYGONS 2 3\nOFFSETS float\n0 3\nCONNECTIVITY vtktypeint64\n0 1 2\n", "not integers"),
    ] {
        let error = grid(cells).expect_err(cells).to_string();
        assert!(error.contains(word), "{error}");
    }
}
