//! Texture coordinates of vertices have a place of their own in most formats.

use std::io::Cursor;

use meniscus_formats::{
    AttributeRole, Content, FileAttribute, Limits, MeshOptions, MeshView, OutputFormat, Values, abc, gltf,
    is_complete, ply, to_glb, usdc,
};

use crate::mesh_formats::of_numbers;

// A strip of two triangles.
//
//    3 ─── 2
//    │   ╱ │
//    │ ╱   │
//    0 ─── 1
const POSITIONS: [[f32; 3]; 4] = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0]];
const TRIANGLES: [[u32; 3]; 2] = [[0, 1, 2], [0, 2, 3]];
const ROWS: [[f32; 2]; 4] = [[0.75, 0.0], [0.875, 0.0], [0.875, 0.25], [0.75, 0.25]];
const HEAT: [f32; 4] = [0.5, 1.5, 2.5, 3.5];

fn written(format: OutputFormat, quads: &[bool]) -> Vec<u8> {
    let color = [0.5; 16];
    // One of them has the name that texture coordinates have in USD.
    let attributes = [
        of_numbers("Cd", Some(AttributeRole::Color), 4, &color),
        of_numbers("st", None, 1, &HEAT),
        of_numbers("uv", Some(AttributeRole::TextureCoordinates), 2, ROWS.as_flattened()),
    ];
    let mesh = MeshView {
        positions: &POSITIONS,
        normals: &[[0.0, 0.0, 1.0]; 4],
        triangles: &TRIANGLES,
        origin: [0.0; 3],
        attributes: &attributes,
    };
    let Content::Mesh(writer) = format.content() else { panic!("{format:?} has meshes") };
    assert_eq!((writer.attribute_notes)(&attributes[2..]), [""; 0]);
    let options = MeshOptions { quads: quads.into(), ..MeshOptions::default() };
    let mut bytes = Vec::new();
    writer.write(&mesh, &options, &[], &mut bytes).expect("a sound mesh");
    assert!(is_complete(format, &mut Cursor::new(&bytes)).expect("ours"));
    bytes
}

/// The values of the attribute with this name.
fn numbers(attributes: &[FileAttribute], name: &str) -> Vec<f32> {
    match attributes.iter().find(|attribute| attribute.name == name) {
        Some(FileAttribute { values: Values::F32(values), .. }) => values.clone(),
        found => panic!("{name}: {found:?}"),
    }
}

#[test]
fn obj_has_a_coordinate_for_each_vertex() {
    let lines = |quads: &[bool]| -> Vec<String> {
        let text = String::from_utf8(written(OutputFormat::Obj, quads)).expect("UTF-8");
        text.lines()
            .filter(|line| line.starts_with("vt") || line.starts_with('f'))
            .map(str::to_owned)
            .collect()
    };
    let rows = ["vt 0.75 0", "vt 0.875 0", "vt 0.875 0.25", "vt 0.75 0.25"];
    assert_eq!(lines(&[]), [&rows[..], &["f 1/1/1 2/2/2 3/3/3", "f 1/1/1 3/3/3 4/4/4"]].concat());
    assert_eq!(lines(&[true, false])[4..], ["f 3/3/3 4/4/4 1/1/1 2/2/2"]);
}

#[test]
fn usd_has_the_primvar_st() {
    let text = String::from_utf8(written(OutputFormat::Usda, &[])).expect("UTF-8");
    let declared = "texCoord2f[] primvars:st = [(0.75, 0), (0.875, 0), (0.875, 0.25), (0.75, 0.25)] (\n            \
                    interpolation = \"vertex\"\n        )\n";
    assert!(text.contains(declared), "{text}");
    assert!(text.contains("float[] primvars:st_2 = [0.5, 1.5"), "{text}");

    let bytes = written(OutputFormat::Usdc, &[]);
    let layer = usdc::UsdcLayer::read(&bytes, &Limits::default()).expect("our own file");
    let frame = layer.frame().expect("a frame");
    assert_eq!(numbers(&frame.attributes, "st"), ROWS.as_flattened());
}

#[test]
fn glb_has_coordinates_from_the_upper_left_corner_whichever_file_it_is_made_from() {
    let limits = Limits::default();
    let of_glb = |glb: &[u8]| {
        let attributes = gltf::read_attributes(glb, &Limits::default()).expect("our own file");
        numbers(&attributes, "TEXCOORD_0")
    };
    let glb = written(OutputFormat::Glb, &[]);
    assert_eq!(of_glb(&glb), ROWS.as_flattened());
    let flipped = ROWS.map(|[u, v]| [u, 1.0 - v].map(f32::to_le_bytes));
    assert!(glb.windows(32).any(|part| part == flipped.as_flattened().as_flattened()));
    for (bytes, to_glb) in [
        (written(OutputFormat::Usdc, &[]), to_glb as fn(_, _) -> _),
        (written(OutputFormat::Abc, &[]), to_glb),
    ] {
        let (glb, _): (Vec<u8>, Vec<String>) = to_glb(bytes, &limits).expect("our own file");
        assert_eq!(of_glb(&glb), ROWS.as_flattened());
    }
    let attributes = abc::read_attributes(&written(OutputFormat::Abc, &[]), &limits).expect("our own file");
    assert_eq!(numbers(&attributes, "uv"), ROWS.as_flattened());
}

#[test]
fn ply_has_s_and_t_and_vtp_names_its_coordinates() {
    let (_, frame) = ply::read_mesh_and_vertices(&written(OutputFormat::Ply, &[]), &Limits::default())
        .expect("our own file");
    for (name, along) in [("s", 0), ("t", 1)] {
        assert_eq!(numbers(&frame.attributes, name), ROWS.map(|row| row[along]));
    }
    let vtp = written(OutputFormat::Vtp, &[]);
    let head = String::from_utf8_lossy(&vtp);
    assert!(head.contains("<PointData Normals=\"Normals\" TCoords=\"uv\">"), "{head}");
}
