//! Texture coordinates with seams: values per corner where a format has them, and split vertices elsewhere.

use std::io::Cursor;

use meniscus_formats::gltf::{GlbFrame, SequenceFrame};
use meniscus_formats::{
    AttributeRole, Content, FileAttribute, Limits, MeshOptions, MeshView, OutputFormat, SeamsView, Values,
    VertexAttribute, abc, gltf, is_complete, ply, usda, usdc,
};

use crate::mesh_formats::of_numbers;

// A strip of two triangles and a third. The third is on another chart: two of its corners, at the vertices 1 and 2, have
// other coordinates than their vertices.
//
//    3 ─── 2 ─── 4
//    │   ╱ │   ╱         row 5 is at vertex 2, row 6 at vertex 1
//    │ ╱   │ ╱
//    0 ─── 1
const POSITIONS: [[f32; 3]; 5] =
    [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0], [2.0, 1.0, 0.0]];
const TRIANGLES: [[u32; 3]; 3] = [[0, 1, 2], [0, 2, 3], [1, 4, 2]];
const CORNERS: [[u32; 3]; 3] = [[0, 1, 2], [0, 2, 3], [6, 4, 5]];
const ROWS: [[f32; 2]; 7] =
    [[0.75, 0.0], [0.875, 0.0], [0.875, 0.25], [0.75, 0.25], [0.125, 0.25], [0.0, 0.25], [0.0, 0.0]];
const HEAT: [f32; 5] = [0.5, 1.5, 2.5, 3.5, 4.5];

/// Passes on the mesh, with these seams.
fn with_mesh<T>(seams: Option<SeamsView>, run: impl FnOnce(&MeshView) -> T) -> T {
    let role = Some(AttributeRole::TextureCoordinates);
    let uv = VertexAttribute { seams, ..of_numbers("uv", role, 2, ROWS[..5].as_flattened()) };
    let color = [0.5; 20];
    let color = of_numbers("Cd", Some(AttributeRole::Color), 4, &color[..]);
    // A name that texture coordinates have in USD.
    let attributes = [color, of_numbers("st", None, 1, &HEAT), uv, of_numbers("heat", None, 1, &HEAT)];
    let (origin, normals) = ([0.0; 3], [[0.0, 0.0, 1.0]; 5]);
    run(&MeshView {
        positions: &POSITIONS,
        normals: &normals,
        triangles: &TRIANGLES,
        origin,
        attributes: &attributes,
    })
}

fn written(format: OutputFormat, quads: &[bool]) -> Vec<u8> {
    let Content::Mesh(writer) = format.content() else { panic!("{format:?} has meshes") };
    let options = MeshOptions { quads: quads.into(), ..MeshOptions::default() };
    let mut bytes = Vec::new();
    with_mesh(Some(SeamsView { values: &ROWS, triangles: &CORNERS }), |mesh| {
        assert_eq!((writer.attribute_notes)(&mesh.attributes[2..3]), [""; 0]);
        writer.write(mesh, &options, &[], &mut bytes).expect("a sound mesh");
    });
    assert!(is_complete(format, &mut Cursor::new(&bytes)).expect("ours"));
    bytes
}

fn text(format: OutputFormat, quads: &[bool]) -> String {
    String::from_utf8(written(format, quads)).expect("UTF-8")
}

#[test]
fn obj_has_a_coordinate_for_each_corner() {
    let lines = |quads: &[bool]| -> Vec<String> {
        let text = text(OutputFormat::Obj, quads);
        text.lines()
            .filter(|line| line.starts_with("vt") || line.starts_with('f'))
            .map(str::to_owned)
            .collect()
    };
    let rows =
        ["vt 0.75 0", "vt 0.875 0", "vt 0.875 0.25", "vt 0.75 0.25", "vt 0.125 0.25", "vt 0 0.25", "vt 0 0"];
    let triangles = ["f 1/1/1 2/2/2 3/3/3", "f 1/1/1 3/3/3 4/4/4", "f 2/7/2 5/5/5 3/6/3"];
    assert_eq!(lines(&[]), [&rows[..], &triangles].concat());
    let faces = ["f 3/3/3 4/4/4 1/1/1 2/2/2", "f 2/7/2 5/5/5 3/6/3"];
    assert_eq!(lines(&[true, false, false]).split_off(7), faces);
}

#[test]
fn usd_has_a_coordinate_for_each_corner() {
    let text = text(OutputFormat::Usda, &[]);
    let values = "texCoord2f[] primvars:st = [(0.75, 0), (0.875, 0), (0.875, 0.25), (0.75, 0.25), (0.125, 0.25), \
                  (0, 0.25), (0, 0)] (\n            interpolation = \"faceVarying\"\n        )\n";
    assert!(text.contains(values), "{text}");
    assert!(text.contains("int[] primvars:st:indices = [0, 1, 2, 0, 2, 3, 6, 4, 5]\n"), "{text}");
    assert!(text.contains("float[] primvars:st_2 = [0.5, 1.5"), "{text}");

    let bytes = written(OutputFormat::Usdc, &[]);
    let layer = usdc::UsdcLayer::read(&bytes, &Limits::default()).expect("our own file");
    let frame = layer.frame(0).expect("a frame");
    let uv = frame.attributes.iter().find(|attribute| attribute.name == "st").expect("coordinates");
    assert_eq!(uv.values, Values::F32(ROWS[..5].as_flattened().to_vec()));
    assert_eq!(frame.mesh.triangles, TRIANGLES);
}

/// Checks the split vertices of a .glb.
fn check_split(glb: &[u8]) {
    let attributes = gltf::read_attributes(glb, &Limits::default()).expect("our own file");
    let numbers = |name: &str| match attributes.iter().find(|attribute| attribute.name == name) {
        Some(FileAttribute { values: Values::F32(values), .. }) => values.clone(),
        found => panic!("{name}: {found:?}"),
    };
    assert_eq!(numbers("TEXCOORD_0"), ROWS.as_flattened());
    assert_eq!(numbers("_HEAT"), [0.5, 1.5, 2.5, 3.5, 4.5, 2.5, 1.5]);
    let mesh = gltf::read_mesh(glb, &Limits::default()).expect("our own file");
    assert_eq!(mesh.triangles, CORNERS);
    let [two, one] = [mesh.positions[5], mesh.positions[6]];
    assert_eq!((two, one), (POSITIONS[2].map(f64::from), POSITIONS[1].map(f64::from)));
}

#[test]
fn glb_has_split_vertices_whichever_file_it_is_made_from() {
    let glb = written(OutputFormat::Glb, &[]);
    check_split(&glb);
    // The origin of pictures is their upper left corner.
    let flipped = ROWS.map(|[u, v]| [u, 1.0 - v].map(f32::to_le_bytes));
    assert!(glb.windows(56).any(|part| part == flipped.as_flattened().as_flattened()));
    let limits = Limits::default();
    for (bytes, to_glb) in [
        (written(OutputFormat::Usdc, &[]), usdc::to_glb as fn(_, _) -> _),
        (written(OutputFormat::Abc, &[]), abc::to_glb),
    ] {
        let (glb, notes): (Vec<u8>, Vec<String>) = to_glb(bytes, &limits).expect("our own file");
        check_split(&glb);
        assert!(notes.iter().all(|note| note.contains("both vector and scalar")), "{notes:?}");
        assert_eq!(GlbFrame::read(&mut Cursor::new(&glb)).expect("a frame").vertex_count(), 7);
    }
    let attributes = abc::read_attributes(&written(OutputFormat::Abc, &[]), &limits).expect("our own file");
    let uv = attributes.iter().find(|attribute| attribute.name == "uv").expect("coordinates");
    assert_eq!(uv.values, Values::F32(ROWS[..5].as_flattened().to_vec()));
}

#[test]
fn sequences_have_the_split_vertices_of_their_frames() {
    let glb = written(OutputFormat::Glb, &[]);
    let file = GlbFrame::read(&mut Cursor::new(&glb)).expect("a frame");
    let shot = [SequenceFrame { name: "a".into(), code: 1, file }];
    let mut text = Vec::new();
    usda::write_sequence(&shot, None, (24.0, 1.0), &[], |_| Ok(Cursor::new(&glb)), &mut text)
        .expect("written");
    let text = String::from_utf8(text).expect("UTF-8");
    let declared = "texCoord2f[] primvars:st (\n            interpolation = \"vertex\"\n        )\n";
    let values = "1: [(0.75, 0), (0.875, 0), (0.875, 0.25), (0.75, 0.25), (0.125, 0.25), (0, 0.25), (0, 0)]";
    assert!(text.contains(declared) && text.contains(values), "{text}");
    assert!(text.contains("1: [0, 1, 2, 0, 2, 3, 6, 4, 5]"), "{text}");
}

#[test]
fn ply_and_vtp_have_split_vertices() {
    let (mesh, frame) = ply::read_mesh_and_vertices(&written(OutputFormat::Ply, &[]), &Limits::default())
        .expect("our own file");
    assert_eq!(mesh.triangles, CORNERS);
    for (name, along) in [("s", 0), ("t", 1)] {
        let found = frame.attributes.iter().find(|attribute| attribute.name == name).expect("coordinates");
        assert_eq!(found.values, Values::F32(ROWS.map(|row| row[along]).to_vec()));
    }
    let vtp = written(OutputFormat::Vtp, &[]);
    let head = String::from_utf8_lossy(&vtp);
    assert!(head.contains("NumberOfPoints=\"7\""), "{head}");
    assert!(head.contains("<PointData Normals=\"Normals\" TCoords=\"uv\">"), "{head}");
}

#[test]
fn seams_must_match_the_mesh() {
    let fails = |values: &[[f32; 2]], triangles: &[[u32; 3]]| {
        let written = with_mesh(Some(SeamsView { values, triangles }), |mesh| {
            gltf::write_glb(mesh, &MeshOptions::default(), &[], &mut Vec::new())
        });
        assert!(written.expect_err("unsound").to_string().contains("the seams of attribute uv"));
    };
    fails(&ROWS, &CORNERS[..2]);
    fails(&ROWS[..6], &CORNERS);
    fails(&ROWS, &[[1, 0, 2], [0, 2, 3], [6, 4, 5]]);
    fails(&[[f32::NAN; 2]; 7], &CORNERS);
    fails(&ROWS, &[[0, 1, 2], [0, 2, 3], [6, 4, 6]]);
    // The halves of a quad have different charts.
    let triangles = [[0, 1, 2], [0, 5, 3], [6, 4, 5]];
    let options = MeshOptions { quads: [true, false, false].as_slice().into(), ..MeshOptions::default() };
    let Content::Mesh(obj) = OutputFormat::Obj.content() else { panic!("a mesh") };
    let written = with_mesh(Some(SeamsView { values: &ROWS, triangles: &triangles }), |mesh| {
        obj.write(mesh, &options, &[], &mut Vec::new())
    });
    assert!(written.expect_err("unsound").to_string().contains("do not form a quad"));
}
