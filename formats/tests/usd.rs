//! Meshes written as .usda and .usdc: exact to the last bit.

#![allow(clippy::cast_possible_truncation, reason = "test numbers are small")]

use std::io::{self, Cursor, Read, Seek, SeekFrom};

use meniscus_formats::{
    Limits, MeshOptions, OutputFormat, Values, VertexAttribute, VertexValues, gltf, is_complete, read_mesh,
    to_glb, usda, usdc,
};

use crate::mesh_formats::{FAR, fans, nothing, provenance, torus, usda_text, usdc_bytes};

/// The text of an array property between its brackets.
fn array<'a>(text: &'a str, name: &str) -> &'a str {
    let start =
        text.find(&format!(" {name} = [")).unwrap_or_else(|| panic!("{name} is missing")) + name.len() + 5;
    &text[start..start + text[start..].find(']').expect("an end")]
}

fn numbers<T: std::str::FromStr>(text: &str) -> Vec<T> {
    let words = text.split([',', ' ', '(', ')']).filter(|word| !word.is_empty());
    words.map(|word| word.parse().ok().unwrap_or_else(|| panic!("{word} is not a number"))).collect()
}

#[test]
fn usda_contains_the_mesh() {
    for mesh in [torus(20, 12, [0.0; 3]), torus(20, 12, FAR), torus(130, 70, [0.0; 3]), nothing()] {
        for has_quads in [false, true] {
            let text = usda_text(&mesh, has_quads, gltf::UpAxis::Z);
            assert!(text.starts_with("#usda 1.0\n(\n") && text.contains("    upAxis = \"Z\"\n"));
            assert_eq!(numbers::<f32>(array(&text, "points")), mesh.positions.as_flattened());
            assert_eq!(numbers::<f32>(array(&text, "normals")), mesh.normals.as_flattened());
            assert_eq!(numbers::<f32>(array(&text, "velocities")), mesh.velocity);
            assert_eq!(numbers::<f32>(array(&text, "primvars:heat__2")), mesh.heat);
            assert_eq!(numbers::<i64>(array(&text, "primvars:id")), mesh.ids);
            let [mut colors, mut opacities] = [Vec::new(), Vec::new()];
            for [rgb @ .., alpha] in mesh.color.as_chunks::<4>().0 {
                colors.extend(rgb);
                opacities.push(*alpha);
            }
            assert_eq!(numbers::<f32>(array(&text, "primvars:displayColor")), colors);
            assert_eq!(numbers::<f32>(array(&text, "primvars:displayOpacity")), opacities);
            assert_eq!(array(&text, "primvars:_2nd"), "\"a \\\"b\\\" <c>\", \"d\", \"\"");
            let indices =
                mesh.names.iter().map(|&index| if index < 0 { 2 } else { index }).collect::<Vec<_>>();
            assert_eq!(numbers::<i32>(array(&text, "primvars:_2nd:indices")), indices);

            let counts = numbers::<usize>(array(&text, "faceVertexCounts"));
            let mut corners = numbers::<u32>(array(&text, "faceVertexIndices")).into_iter();
            let mut found = Vec::new();
            for &count in &counts {
                let face: Vec<u32> = corners.by_ref().take(count).collect();
                found.extend((2..count).map(|last| [face[0], face[last - 1], face[last]]));
            }
            assert_eq!(found, if has_quads { fans(&mesh) } else { mesh.triangles.clone() });
            assert!(
                corners.next().is_none() && counts.iter().all(|&count| count == 3 || has_quads && count == 4)
            );
            let far = format!("double3 xformOp:translate = ({}, {}, {})", FAR[0], FAR[1], FAR[2]);
            assert_eq!(text.contains(&far), mesh.origin == FAR);
            let info = usda::read_layer_info(text.as_bytes()).expect("our own file").expect("figures");
            assert_eq!((info.vertices, info.faces), (mesh.positions.len() as u64, counts.len() as u64));
            if !mesh.positions.is_empty() {
                let extent = numbers::<f32>(array(&text, "extent"));
                assert!((0..3).all(|axis| {
                    mesh.positions.iter().all(|p| (extent[axis]..=extent[axis + 3]).contains(&p[axis]))
                }));
            }
        }
    }
}

#[test]
fn usda_for_a_stage_repeats_every_value_as_a_time_sample() {
    for mesh in [torus(20, 12, [0.0; 3]), torus(130, 70, FAR), nothing()] {
        let options = MeshOptions { time_samples: true, ..MeshOptions::default() };
        let mut bytes = Vec::new();
        OutputFormat::Usda
            .write_mesh(&mesh.view(&mesh.attributes()), &options, &[], &mut bytes)
            .expect("writing to memory");
        let text = String::from_utf8(bytes).expect("UTF-8");
        let sample = |name: &str| {
            let start = format!(" {name}.timeSamples = {{\n            0: ");
            let (_, rest) = text.split_once(&start).unwrap_or_else(|| panic!("{name} has no sample"));
            rest.split_once(",\n        }\n").expect("an end").0.to_owned()
        };
        let mut names: Vec<&str> =
            ["points", "normals", "velocities", "faceVertexCounts", "faceVertexIndices"].into();
        names.extend(["primvars:heat__2", "primvars:id", "primvars:displayColor", "primvars:_2nd:indices"]);
        for name in names {
            assert_eq!(sample(name), format!("[{}]", array(&text, name)), "{name}");
        }
        assert_eq!(sample("primvars:_2nd"), "[\"a \\\"b\\\" <c>\", \"d\", \"\"]");
        // The origin is there even if it is zero, because that of other frames may not be.
        let origin = mesh.origin.map(|x| x.to_string()).join(", ");
        assert_eq!(sample("xformOp:translate"), format!("({origin})"));
        assert_eq!(text.contains("xformOpOrder"), mesh.origin == FAR);
        assert!(!text.contains("orientation.timeSamples") && !text.contains("Scheme.timeSamples"));
    }
}

#[test]
fn properties_with_time_samples_are_read_without_the_arrays() {
    let limits = Limits::default();
    for mesh in [torus(20, 12, [0.0; 3]), torus(130, 70, FAR), nothing()] {
        let options = MeshOptions { time_samples: true, ..MeshOptions::default() };
        let mut text = Vec::new();
        OutputFormat::Usda
            .write_mesh(&mesh.view(&mesh.attributes()), &options, &[], &mut text)
            .expect("writing to memory");
        let of_text = usda::read_sampled_properties(&text[..text.len().min(4096)]).expect("a head");
        let bytes = usdc_bytes(&mesh, true, gltf::UpAxis::Y);
        let read = |bytes: &[u8]| usdc::read_sampled_properties(&mut Cursor::new(bytes), &limits);
        let found = read(&bytes).expect("our own file");
        assert_eq!(found, of_text);
        for (kind, name) in [
            ("point3f[]", "points"),
            ("int[]", "faceVertexIndices"),
            ("vector3f[]", "velocities"),
            ("color3f[]", "primvars:displayColor"),
            ("string[]", "primvars:_2nd"),
            ("int[]", "primvars:_2nd:indices"),
            ("double3", "xformOp:translate"),
        ] {
            assert!(
                found.iter().any(|property| (&*property.kind, &*property.name) == (kind, name)),
                "{name}"
            );
        }
        assert!(!found.iter().any(|property| property.name == "orientation"));
        assert_eq!(found.iter().any(|property| property.name == "extent"), !mesh.positions.is_empty());
        let plain = usda_text(&mesh, true, gltf::UpAxis::Y);
        assert_eq!(usda::read_sampled_properties(plain.as_bytes()).expect("a head"), []);
        // The arrays are in the first half of a large file.
        if bytes.len() > 100_000 {
            let mut overwritten = bytes.clone();
            overwritten[1000..bytes.len() / 2].fill(0xff);
            assert_eq!(read(&overwritten).expect("the tables are intact"), found);
        }
    }
}

#[test]
fn usda_does_not_depend_on_threads() {
    let mesh = torus(300, 200, FAR);
    let on = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("threads");
        pool.install(|| usda_text(&mesh, true, gltf::UpAxis::Y))
    };
    assert!(on(1) == on(4));
}

#[test]
fn usdc_round_trips_exactly() {
    let limits = Limits::default();
    let small = torus(2, 3, FAR); // fewer than 16 triangles: no array is compressed
    for mesh in [torus(20, 12, [0.0; 3]), torus(20, 12, FAR), torus(130, 70, [0.0; 3]), small, nothing()] {
        for has_quads in [false, true] {
            let bytes = usdc_bytes(&mesh, has_quads, gltf::UpAxis::Z);
            let layer = usdc::UsdcLayer::read(&bytes, &limits).expect("our own file");
            let faces = mesh.triangles.len() - if has_quads { mesh.triangles.len() / 2 } else { 0 };
            let info = usdc::LayerInfo { vertices: mesh.positions.len() as u64, faces: faces as u64 };
            assert_eq!(layer.info(), info);
            let usdc::UsdcFrame { mesh: found, attributes } = layer.frame().expect("our own file");
            assert_eq!((&found.positions, &found.normals), (&mesh.world(), &mesh.normals));
            assert_eq!(found.triangles, if has_quads { fans(&mesh) } else { mesh.triangles.clone() });
            let read_external = |_: &str| Err(std::io::ErrorKind::NotFound.into());
            assert_eq!(read_mesh(&bytes, "a.usdc", &limits, &read_external).expect("our own file"), found);

            let values = |name: &str, arity: usize| {
                let found = attributes.iter().find(|attribute| attribute.name == name).expect(name);
                assert_eq!(found.arity, arity, "{name}");
                found.values.clone()
            };
            assert_eq!(attributes.len(), 6);
            assert_eq!(values("heat__2", 1), Values::F32(mesh.heat.clone()));
            assert_eq!(values("velocities", 3), Values::F32(mesh.velocity.clone()));
            let [mut colors, mut opacities] = [Vec::new(), Vec::new()];
            for [rgb @ .., alpha] in mesh.color.as_chunks::<4>().0 {
                colors.extend(rgb);
                opacities.push(*alpha);
            }
            assert_eq!(values("displayColor", 3), Values::F32(colors));
            assert_eq!(values("displayOpacity", 1), Values::F32(opacities));
            // An empty array needs no 64-bit type.
            let ids =
                if mesh.ids.is_empty() { Values::I32(Vec::new()) } else { Values::I64(mesh.ids.clone()) };
            assert_eq!(values("id", 1), ids);
            let indices = mesh.names.iter().map(|&index| if index < 0 { 2 } else { index }).collect();
            let table = mesh.table.iter().cloned().chain([String::new()]).collect();
            assert_eq!(values("_2nd", 1), Values::Strings { table, indices });
        }
    }
}

#[test]
fn usdc_attributes_of_every_width_round_trip() {
    let mesh = torus(20, 12, [0.0; 3]);
    let count = mesh.positions.len();
    let numbers = |arity: usize| (0..count * arity).map(|i| (i % 1000) as f32 * 0.37).collect::<Vec<f32>>();
    let integers = |arity: usize| (0..(count * arity) as i64).map(|i| i * i - 7).collect::<Vec<i64>>();
    let (reals, whole) = ([1, 2, 3, 4, 6].map(numbers), [1, 2, 3, 4, 6].map(integers));
    let counted: Vec<f32> = (0..count).map(|i| i as f32).collect();
    let few: Vec<f32> = (0..count).map(|i| [0.5, -0.0, 1e30][i % 3]).collect();
    let attribute = |name, arity, values| VertexAttribute { name, role: None, arity, values };
    let mut attributes = vec![
        attribute("counted", 1, VertexValues::Numbers(&counted)),
        attribute("few", 1, VertexValues::Numbers(&few)),
    ];
    let names = ["a1", "a2", "a3", "a4", "a6", "b1", "b2", "b3", "b4", "b6"];
    for (index, arity) in [1, 2, 3, 4, 6].into_iter().enumerate() {
        attributes.push(attribute(names[index], arity, VertexValues::Numbers(&reals[index])));
        attributes.push(attribute(names[index + 5], arity, VertexValues::Integers(&whole[index])));
    }
    let mut bytes = Vec::new();
    let (format, options) = (OutputFormat::Usdc, MeshOptions::default());
    format.write_mesh(&mesh.view(&attributes), &options, &[], &mut bytes).expect("writing to memory");
    let layer = usdc::UsdcLayer::read(&bytes, &Limits::default()).expect("our own file");
    let found = layer.frame().expect("our own file").attributes;
    for (found, expected) in found.iter().zip(&attributes) {
        assert_eq!((&*found.name, found.arity), (expected.name, expected.arity));
        match (&found.values, expected.values) {
            (Values::F32(found), VertexValues::Numbers(expected)) => {
                assert!(found.iter().zip(expected).all(|(a, b)| a.to_bits() == b.to_bits()));
            }
            (Values::I32(found), VertexValues::Integers(expected)) => {
                assert!(found.iter().zip(expected).all(|(a, b)| i64::from(*a) == *b));
            }
            other => panic!("{}: {other:?}", expected.name),
        }
    }
    assert_eq!(found.len(), attributes.len());
}

#[test]
fn usdc_becomes_the_glb_of_the_same_mesh() {
    let limits = Limits::default();
    for mesh in [torus(20, 12, [0.0; 3]), torus(130, 70, FAR), torus(2, 3, FAR), nothing()] {
        for up in [gltf::UpAxis::Y, gltf::UpAxis::Z] {
            let (glb, notes) = to_glb(usdc_bytes(&mesh, false, up), &limits).expect("converted");
            let (attributes, options) = (mesh.attributes(), MeshOptions { up, ..MeshOptions::default() });
            let mut expected = Vec::new();
            gltf::write_glb(&mesh.view(&attributes), &options, &provenance(), &mut expected)
                .expect("writing to memory");
            assert!(glb == expected, "{} vertices, {up:?}", mesh.positions.len());
            // Nothing else is lost, and notes on glTF programs do not apply to the sequence.
            let lost = notes.iter().filter(|note| note.starts_with("id is missing")).count();
            assert_eq!((lost, notes.len()), (usize::from(!mesh.ids.is_empty()), lost), "{notes:?}");

            let (glb, _) = to_glb(usdc_bytes(&mesh, true, up), &limits).expect("converted");
            assert_eq!(gltf::read_mesh(&glb, &limits).expect("our own file").triangles, fans(&mesh));
        }
    }
}

#[test]
fn truncated_and_damaged_usdc_is_an_error() {
    let mesh = torus(9, 7, FAR);
    let (bytes, limits) = (usdc_bytes(&mesh, true, gltf::UpAxis::Y), Limits::default());
    let read = |bytes: &[u8]| usdc::UsdcLayer::read(bytes, &limits)?.frame();
    let sampled = |bytes: &[u8]| usdc::read_sampled_properties(&mut Cursor::new(bytes), &limits);
    for length in 0..bytes.len() {
        let error = read(&bytes[..length]).expect_err("truncated");
        assert!(length < 8 || error.is_truncated(), "{length}: {error}");
        assert!(sampled(&bytes[..length]).is_err(), "{length}");
        assert!(error.to_string().starts_with("USD, at byte "), "{length}: {error}");
    }
    // Any result is valid, as long as nothing panics.
    for at in 0..bytes.len() {
        for damage in [0x01, 0x10, 0x80, 0xff] {
            let mut damaged = bytes.clone();
            damaged[at] ^= damage;
            let _ = read(&damaged);
            let _ = sampled(&damaged);
            let _ = to_glb(&damaged, &limits);
        }
    }
    let mut newer = bytes.clone();
    newer[9] = 14;
    let error = read(&newer).expect_err("another version").to_string();
    assert!(error.contains("version 0.14.0"), "{error}");
}

/// Refuses to seek beyond 2⁶³, as files do.
struct AsFile(Cursor<Vec<u8>>);

impl Read for AsFile {
    fn read(&mut self, bytes: &mut [u8]) -> io::Result<usize> {
        self.0.read(bytes)
    }
}

impl Seek for AsFile {
    fn seek(&mut self, to: SeekFrom) -> io::Result<u64> {
        match to {
            SeekFrom::Start(start) if i64::try_from(start).is_err() => {
                Err(io::ErrorKind::InvalidInput.into())
            }
            _ => self.0.seek(to),
        }
    }
}

#[test]
fn usdc_with_a_table_beyond_any_file_is_not_complete() {
    let bytes = usdc_bytes(&nothing(), false, gltf::UpAxis::Y);
    for (at, expected) in [(None, true), (Some(bytes.len() as u64), false), (Some(u64::MAX), false)] {
        let mut damaged = bytes.clone();
        if let Some(at) = at {
            damaged[16..24].copy_from_slice(&at.to_le_bytes());
        }
        let found = is_complete(OutputFormat::Usdc, &mut AsFile(Cursor::new(damaged)));
        assert_eq!(found.expect("read"), expected, "{at:?}");
    }
}

#[test]
fn usdc_notes_strings_with_null_characters() {
    let table = ["a\0b".to_owned()];
    let values = VertexValues::Strings { table: &table, indices: &[0, 0] };
    let attribute = VertexAttribute { name: "kind", role: None, arity: 1, values };
    let notes = usdc::attribute_notes(&[attribute]);
    assert_eq!(notes, ["kind: the .usdc stores null characters as \\x00"]);
    let table = ["a".to_owned()];
    let values = VertexValues::Strings { table: &table, indices: &[0, 0] };
    assert_eq!(usdc::attribute_notes(&[VertexAttribute { values, ..attribute }]), [""; 0]);
}
