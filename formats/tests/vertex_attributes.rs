//! Vertex attributes in .glb, .ply and .obj: what readers find, and the notes for users.

#![allow(clippy::cast_possible_truncation, reason = "test numbers are small")]

use meniscus_formats::{
    AttributeRole, FileAttribute, Limits, MeshOptions, MeshView, OutputFormat, ParticleFrame, Values,
    VertexAttribute, VertexValues, gltf, is_complete, obj, ply, read_provenance,
};

const VERTEX_COUNT: usize = 5000; // more than one chunk of formatting or conversion

fn positions() -> Vec<[f32; 3]> {
    (0..VERTEX_COUNT).map(|v| [v as f32 * 0.125, (v % 7) as f32, -(v as f32)]).collect()
}

fn triangles() -> Vec<[u32; 3]> {
    (0..VERTEX_COUNT as u32 - 2).map(|v| [v, v + 1, v + 2]).collect()
}

/// A different number for each component of each vertex.
fn numbers(arity: usize, scale: f32) -> Vec<f32> {
    (0..VERTEX_COUNT * arity).map(|n| ((n * 37 % 101) as f32 / 100.0) * scale).collect()
}

fn attribute<'a>(
    name: &'a str,
    role: Option<AttributeRole>,
    arity: usize,
    values: VertexValues<'a>,
) -> VertexAttribute<'a> {
    VertexAttribute { name, role, arity, values }
}

/// Passes a mesh with these attributes to a writer.
fn written(attributes: &[VertexAttribute], write: impl Fn(&MeshView, &mut Vec<u8>)) -> Vec<u8> {
    let (positions, triangles) = (positions(), triangles());
    let normals = vec![[0.0, 0.0, 1.0]; VERTEX_COUNT];
    let origin = [0.0; 3];
    let mesh =
        MeshView { positions: &positions, normals: &normals, triangles: &triangles, origin, attributes };
    let mut bytes = Vec::new();
    write(&mesh, &mut bytes);
    bytes
}

fn glb(attributes: &[VertexAttribute]) -> Vec<u8> {
    written(attributes, |mesh, out| {
        gltf::write_glb(mesh, &MeshOptions::default(), &[], out).expect("writing to memory");
    })
}

fn ply_frame(attributes: &[VertexAttribute]) -> (ParticleFrame, String) {
    let provenance = [("radius".to_string(), "0.5".to_string())];
    let bytes = written(attributes, |mesh, out| {
        ply::write::write_mesh(mesh, &provenance, out).expect("writing to memory");
    });
    assert_eq!(read_provenance(OutputFormat::Ply, &bytes[..]).expect("ours"), provenance);
    let mut file = std::io::Cursor::new(&bytes);
    assert!(is_complete(OutputFormat::Ply, &mut file).expect("ours"));
    let (mesh, frame) = ply::read_mesh_and_vertices(&bytes, &Limits::default()).expect("our own file");
    assert_eq!(mesh.triangles, triangles());
    assert_eq!(mesh.positions, positions().iter().map(|p| p.map(f64::from)).collect::<Vec<_>>());
    let end = bytes.windows(11).position(|part| part == b"end_header\n").expect("an end");
    (frame, String::from_utf8(bytes[..end].to_vec()).expect("ASCII"))
}

fn named<'a>(frame: &'a ParticleFrame, name: &str) -> &'a FileAttribute {
    let names: Vec<&str> = frame.attributes.iter().map(|attribute| attribute.name.as_str()).collect();
    let found = frame.attributes.iter().find(|attribute| attribute.name == name);
    found.unwrap_or_else(|| panic!("no {name} among {names:?}"))
}

#[test]
fn ply_attributes_round_trip() {
    let (color, velocity) = (numbers(3, 1.0), numbers(3, -7.5));
    let (age, uv, nine) = (numbers(1, 3.0), numbers(2, 1.0), numbers(9, 2.0));
    let ids: Vec<i64> = (0..VERTEX_COUNT as i64).map(|v| v * 1_000_003 % 4096 - 2048).collect();
    let wide: Vec<i64> = ids.iter().map(|id| id << 40).collect();
    let table = ["water".to_string(), "größe: \n\\".to_string(), String::new()];
    let kinds: Vec<i32> = (0..VERTEX_COUNT as i32).map(|v| v % 5 - 1).collect();
    let attributes = [
        attribute("Cd", Some(AttributeRole::Color), 3, VertexValues::Numbers(&color)),
        attribute("v", Some(AttributeRole::Velocity), 3, VertexValues::Numbers(&velocity)),
        attribute("age", None, 1, VertexValues::Numbers(&age)),
        attribute("uv", None, 2, VertexValues::Numbers(&uv)),
        attribute("nine", None, 9, VertexValues::Numbers(&nine)),
        attribute("id", Some(AttributeRole::Id), 1, VertexValues::Integers(&ids)),
        attribute("wide", None, 1, VertexValues::Integers(&wide)),
        attribute("material", None, 1, VertexValues::Strings { table: &table, indices: &kinds }),
    ];
    let (frame, header) = ply_frame(&attributes);
    let found = named(&frame, "color");
    let bytes: Vec<u8> = color.iter().map(|value| (value * 255.0).round_ties_even() as u8).collect();
    assert_eq!((found.role, found.arity, &found.values), (Some(AttributeRole::Color), 3, &Values::U8(bytes)));
    let found = named(&frame, "v");
    assert_eq!(
        (found.role, found.arity, &found.values),
        (Some(AttributeRole::Velocity), 3, &Values::F32(velocity.clone()))
    );
    assert_eq!(named(&frame, "age").values, Values::F32(age.clone()));
    assert_eq!((named(&frame, "uv").arity, &named(&frame, "uv").values), (2, &Values::F32(uv.clone())));
    assert_eq!(named(&frame, "nine").values, Values::F32(nine.clone()));
    assert_eq!(named(&frame, "id").role, Some(AttributeRole::Id));
    assert_eq!(named(&frame, "id").values, Values::I32(ids.iter().map(|&id| id as i32).collect()));
    assert_eq!(named(&frame, "wide").values, Values::F64(wide.iter().map(|&id| id as f64).collect()));
    let indices: Vec<i32> =
        kinds.iter().map(|&kind| if (0..3).contains(&kind) { kind } else { -1 }).collect();
    assert_eq!(named(&frame, "material").values, Values::I32(indices));
    assert!(header.contains("comment string 0 of material: water\n"), "{header}");
    assert!(header.contains("comment string 1 of material: gr\\u{f6}\\u{df}e: \\u{a}\\u{5c}\n"), "{header}");
    assert_eq!(ply::attribute_notes(&attributes), [""; 0]);
}

#[test]
fn gltf_crate_reads_all_stored_attributes() {
    let (color, velocity, age, uv) = (numbers(4, 1.0), numbers(3, -7.5), numbers(1, 3.0), numbers(2, 1.0));
    let ids: Vec<i64> = (0..VERTEX_COUNT as i64).map(|v| v * 3355).collect();
    let table = ["water".to_string(), "größe".to_string()];
    let kinds: Vec<i32> = (0..VERTEX_COUNT as i32).map(|v| v % 4 - 1).collect();
    let attributes = [
        attribute("Cd", Some(AttributeRole::Color), 4, VertexValues::Numbers(&color)),
        attribute("vel", Some(AttributeRole::Velocity), 3, VertexValues::Numbers(&velocity)),
        attribute("age", None, 1, VertexValues::Numbers(&age)),
        attribute("uv", None, 2, VertexValues::Numbers(&uv)),
        attribute("id", Some(AttributeRole::Id), 1, VertexValues::Integers(&ids)),
        attribute("material", None, 1, VertexValues::Strings { table: &table, indices: &kinds }),
    ];
    let notes = gltf::attribute_notes(&attributes);
    assert!(notes.len() == 1 && notes[0].contains("both vector and scalar attributes"), "{notes:?}");
    assert_eq!(gltf::attribute_notes(&attributes[..2]), [""; 0], "a colour does not count");
    let bytes = glb(&attributes);
    let document = ::gltf::Gltf::from_slice(&bytes).expect("a document");
    let blob = document.blob.as_ref().expect("a binary chunk");
    let mesh = document.meshes().next().expect("a mesh");
    let primitive = mesh.primitives().next().expect("a primitive");
    let read = |name: &str, arity: usize| -> Vec<f32> {
        let has_name = |semantic: &::gltf::Semantic| match semantic {
            ::gltf::Semantic::Extras(found) => found == name,
            ::gltf::Semantic::Colors(0) => name == "COLOR_0",
            _ => false,
        };
        let (_, accessor) = primitive.attributes().find(|(semantic, _)| has_name(semantic)).expect(name);
        let dimensions = ["", "SCALAR", "VEC2", "VEC3", "VEC4"][arity];
        assert_eq!(format!("{:?}", accessor.dimensions()).to_uppercase(), dimensions, "{name}");
        assert_eq!((accessor.count(), accessor.data_type()), (VERTEX_COUNT, ::gltf::accessor::DataType::F32));
        let view = accessor.view().expect("a view");
        assert_eq!(view.length(), VERTEX_COUNT * arity * 4);
        let bytes = &blob[view.offset()..view.offset() + view.length()];
        bytes.as_chunks::<4>().0.iter().map(|&bytes| f32::from_le_bytes(bytes)).collect()
    };
    assert_eq!(read("COLOR_0", 4), color);
    assert_eq!(read("VELOCITY", 3), velocity);
    assert_eq!(read("AGE", 1), age);
    assert_eq!(read("UV", 2), uv);
    assert_eq!(read("ID", 1).iter().map(|&id| id as i64).collect::<Vec<_>>(), ids);
    let found: Vec<i32> = read("MATERIAL", 1).iter().map(|&kind| kind as i32).collect();
    assert_eq!(found, kinds.iter().map(|&k| if (0..2).contains(&k) { k } else { -1 }).collect::<Vec<_>>());
    let extras = mesh.extras().as_ref().expect("extras").get();
    assert_eq!(extras, r#"{"strings":{"_MATERIAL":["water","größe"]}}"#);
    let indices: Vec<u32> =
        primitive.reader(|_| Some(blob)).read_indices().expect("indices").into_u32().collect();
    assert_eq!(indices, triangles().as_flattened());
    let ours = gltf::read_mesh(&bytes, &Limits::default()).expect("our own file");
    assert_eq!(ours.triangles, triangles());
}

#[test]
fn obj_stores_colours_after_positions() {
    let (color, velocity) = (numbers(4, 1.0), numbers(3, 1.0));
    let attributes = [
        attribute("v", Some(AttributeRole::Velocity), 3, VertexValues::Numbers(&velocity)),
        attribute("Cd", Some(AttributeRole::Color), 4, VertexValues::Numbers(&color)),
    ];
    for origin in [[0.0; 3], [1e6, 0.0, 0.5]] {
        let text = written(&attributes, |mesh, out| {
            let mesh = MeshView { origin, ..*mesh };
            OutputFormat::Obj
                .write_mesh(&mesh, &MeshOptions::default(), &[], out)
                .expect("writing to memory");
        });
        let found = tobj::load_obj_buf(&mut &text[..], &tobj::LoadOptions::default(), |_| unreachable!());
        let (models, _) = found.expect("an OBJ file");
        let mesh = &models[0].mesh;
        assert_eq!(mesh.positions.len(), 3 * VERTEX_COUNT);
        let rgb: Vec<f32> = color.as_chunks::<4>().0.iter().flat_map(|c| [c[0], c[1], c[2]]).collect();
        // The reader numbers vertices in order of use; the triangles use them in order.
        assert_eq!(mesh.vertex_color.iter().map(|&c| c as f32).collect::<Vec<_>>(), rgb);
        let own = obj::read_mesh(&text).expect("our own file");
        assert_eq!(own.triangles.len(), triangles().len());
        assert_eq!(own.positions[1][0], origin[0] + 0.125);
    }
    let notes = obj::attribute_notes(&attributes);
    assert_eq!(notes.len(), 2, "{notes:?}");
    assert!(notes[0].starts_with("v is missing in the .obj") && notes[1].contains("alpha"), "{notes:?}");
}

#[test]
fn invalid_names_are_replaced_with_a_note() {
    let values = numbers(1, 1.0);
    let vectors = numbers(3, 1.0);
    let scalar = |name| attribute(name, None, 1, VertexValues::Numbers(&values));
    let attributes = [
        scalar("x"),
        scalar("Rhop [kg/m^3]"),
        scalar("größe"),
        scalar("GR\u{f6}\u{df}E"),
        scalar(""),
        scalar("end_header\nelement face 7"),
        attribute("v", Some(AttributeRole::Velocity), 3, VertexValues::Numbers(&vectors)),
        attribute("velocity", None, 3, VertexValues::Numbers(&vectors)),
        scalar("red"),
        attribute("Cd", Some(AttributeRole::Color), 3, VertexValues::Numbers(&vectors)),
    ];
    let (frame, header) = ply_frame(&attributes);
    let properties: Vec<&str> = header.lines().filter_map(|line| line.strip_prefix("property ")).collect();
    let expected = [
        "float x_2",
        "float Rhop__kg_m_3_",
        "float gr__e",
        "float GR__E_2",
        "float attribute",
        "float end_header_element_face_7",
        "float vx",
        "float vy",
        "float vz",
        "float velocity_x",
        "float velocity_y",
        "float velocity_z",
        "float red",
        "uchar red_2",
        "uchar green_2",
        "uchar blue_2",
    ];
    assert_eq!(properties[6..6 + expected.len()], expected, "{header}");
    assert_eq!(named(&frame, "x_2").values, Values::F32(values.clone()));
    let notes = ply::attribute_notes(&attributes);
    assert_eq!(notes.len(), 7, "{notes:?}");
    assert!(notes.iter().all(|note| note.contains("is named")), "{notes:?}");

    let bytes = glb(&attributes);
    let document = ::gltf::Gltf::from_slice(&bytes).expect("a document");
    let primitive = document.meshes().next().and_then(|mesh| mesh.primitives().next()).expect("a primitive");
    let mut names: Vec<String> = primitive.attributes().map(|(semantic, _)| semantic.to_string()).collect();
    names.sort_unstable();
    let mut expected = [
        "POSITION",
        "NORMAL",
        "_X",
        "_RHOP__KG_M_3_",
        "_GR__E",
        "_GR__E_2",
        "_ATTRIBUTE",
        "_END_HEADER_ELEMENT_FACE_7",
        "_VELOCITY",
        "_VELOCITY_2",
        "_RED",
        "COLOR_0",
    ];
    expected.sort_unstable();
    assert_eq!(names, expected);
    let notes = gltf::attribute_notes(&attributes);
    assert_eq!(notes.iter().filter(|note| note.contains("is named")).count(), 6, "{notes:?}");
}

#[test]
fn attributes_that_cannot_be_stored_get_a_note() {
    let nine = numbers(9, 2.0);
    let wide: Vec<i64> = (0..VERTEX_COUNT as i64).map(|v| v + (1 << 24) - 3).collect();
    let huge: Vec<i64> = (0..VERTEX_COUNT as i64).map(|v| i64::MIN + v).collect();
    let bright = numbers(3, 2.0);
    let long = vec!["a".repeat(1000); 70];
    let none = vec![-1; VERTEX_COUNT];
    let attributes = [
        attribute("nine", None, 9, VertexValues::Numbers(&nine)),
        attribute("id", Some(AttributeRole::Id), 1, VertexValues::Integers(&wide)),
        attribute("huge", None, 1, VertexValues::Integers(&huge)),
        attribute("Cd", Some(AttributeRole::Color), 3, VertexValues::Numbers(&bright)),
        attribute("long", None, 1, VertexValues::Strings { table: &long, indices: &none }),
    ];
    let beyond = wide.iter().filter(|&&value| value > 1 << 24).count();
    assert_eq!(
        gltf::attribute_notes(&attributes),
        [
            "nine is missing in the glTF file: it has 9 values per vertex; the limit is 4".to_string(),
            format!(
                "id is missing in the glTF file: values beyond ±16777216, where 32-bit floats are not exact: {beyond}; use .ply"
            ),
            format!(
                "huge is missing in the glTF file: values beyond ±16777216, where 32-bit floats are not exact: {VERTEX_COUNT}; use .ply"
            ),
        ]
    );
    let cut = bright.iter().filter(|&&value| value > 1.0).count();
    assert!(
        obj::attribute_notes(&attributes)
            .contains(&format!("{cut} values of Cd are outside 0 to 1; they are clamped in the .obj"))
    );
    let text = written(&attributes, |mesh, out| {
        OutputFormat::Obj.write_mesh(mesh, &MeshOptions::default(), &[], out).expect("writing to memory");
    });
    let text = String::from_utf8(text).expect("text");
    let colors = text.lines().filter(|line| line.starts_with("v ")).flat_map(|line| line.split(' ').skip(4));
    let colors: Vec<f32> = colors.map(|number| number.parse().expect("a number")).collect();
    assert_eq!(colors, bright.iter().map(|value| value.clamp(0.0, 1.0)).collect::<Vec<f32>>());
    assert_eq!(
        ply::attribute_notes(&attributes),
        [
            format!(
                "values of huge beyond ±2⁵³, which the .ply rounds: {VERTEX_COUNT}; .vtp stores them exactly"
            ),
            format!("{cut} values of Cd are outside 0 to 1; they are clamped in the .ply"),
            "long is missing in the .ply: its strings are too long for the header".to_string(),
        ]
    );
    let (frame, _) = ply_frame(&attributes);
    assert!(frame.attributes.iter().all(|attribute| attribute.name != "long"));
    assert_eq!(glb(&attributes).len() % 4, 0);
}

#[test]
fn invalid_attributes_are_an_error() {
    let good = numbers(3, 1.0);
    let mut broken = good.clone();
    broken[77] = f32::NAN;
    let short = &good[1..];
    let table: &[String] = &[];
    for (arity, values) in [
        (3, VertexValues::Numbers(&broken)),
        (3, VertexValues::Numbers(short)),
        (0, VertexValues::Numbers(&[])),
        (usize::MAX, VertexValues::Numbers(&good)),
        (1, VertexValues::Integers(&[1, 2, 3])),
        (1, VertexValues::Strings { table, indices: &[0] }),
    ] {
        let attributes = [attribute("a", None, arity, values)];
        written(&attributes, |mesh, _| {
            let out = &mut Vec::new();
            for format in OutputFormat::ALL.into_iter().filter(|format| format.is_mesh()) {
                let refused = format.write_mesh(mesh, &MeshOptions::default(), &[], out);
                let error = refused.expect_err("no file can hold it").to_string();
                assert!(error.contains(" a "), "{error}");
            }
            assert!(out.is_empty());
        });
    }
}

#[test]
fn mesh_without_vertices_is_written_with_attributes() {
    let attributes = [
        attribute("v", Some(AttributeRole::Velocity), 3, VertexValues::Numbers(&[])),
        attribute("id", Some(AttributeRole::Id), 1, VertexValues::Integers(&[])),
    ];
    let mesh =
        MeshView { positions: &[], normals: &[], triangles: &[], origin: [0.0; 3], attributes: &attributes };
    let mut bytes = Vec::new();
    gltf::write_glb(&mesh, &MeshOptions::default(), &[], &mut bytes).expect("writing to memory");
    let found = gltf::read_mesh(&bytes, &Limits::default()).expect("an empty scene");
    assert!(found.positions.is_empty());
    let mut bytes = Vec::new();
    ply::write::write_mesh(&mesh, &[], &mut bytes).expect("writing to memory");
    let (_, frame) = ply::read_mesh_and_vertices(&bytes, &Limits::default()).expect("our own file");
    assert_eq!(frame.attributes.len(), 3, "normal, velocity and id");
}
