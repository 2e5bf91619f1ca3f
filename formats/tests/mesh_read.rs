//! Meshes written by other programs.

#![allow(clippy::print_stderr, reason = "reports missing files")]

use std::path::PathBuf;

use meniscus_formats::{Error, Limits, gltf, obj};

/// A file that is not part of the repository.
fn shared(file: &str) -> Option<Vec<u8>> {
    let default = || PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/../../shared"));
    let root = std::env::var_os("MENISCUS_SHARED").map_or_else(default, PathBuf::from);
    let bytes = std::fs::read(root.join("data/ours/gltf").join(file)).ok();
    if bytes.is_none() {
        eprintln!("not tested, file missing: data/ours/gltf/{file}");
    }
    bytes
}

#[test]
fn counts_agree_with_the_gltf_crate() {
    for file in ["blender45_sphere.glb", "hand.glb", "hand_quant.glb"] {
        let Some(bytes) = shared(file) else { continue };
        let mesh = gltf::read_mesh(&bytes, &Limits::default()).expect(file);
        let other = ::gltf::Gltf::from_slice_without_validation(&bytes).expect(file);
        let primitives = || other.meshes().flat_map(|mesh| mesh.primitives());
        let count = |semantic| -> usize {
            primitives().filter_map(|p| p.get(&semantic)).map(|accessor| accessor.count()).sum()
        };
        let indices: usize = primitives().filter_map(|p| p.indices()).map(|accessor| accessor.count()).sum();
        assert_eq!(mesh.positions.len(), count(::gltf::Semantic::Positions), "{file}");
        assert_eq!(mesh.normals.len(), count(::gltf::Semantic::Normals), "{file}");
        assert_eq!(3 * mesh.triangles.len(), indices, "{file}");
        let length = |n: &[f32; 3]| n.iter().map(|c| c * c).sum::<f32>().sqrt();
        assert!(mesh.normals.iter().all(|normal| (length(normal) - 1.0).abs() < 1e-5), "{file}");
    }
}

/// Two files have the same mesh, except for normals at seams, and the number of decimals in the text.
#[test]
fn quantized_and_plain_glb_agree() {
    let (Some(plain), Some(quantized)) = (shared("hand.glb"), shared("hand_quant.glb")) else { return };
    let [plain, quantized] =
        [plain, quantized].map(|bytes| gltf::read_mesh(&bytes, &Limits::default()).expect("a mesh"));
    assert_eq!(plain.triangles, quantized.triangles);
    for (a, b) in plain.positions.iter().zip(&quantized.positions) {
        assert!((0..3).all(|axis| (a[axis] - b[axis]).abs() < 1e-3), "{a:?} {b:?}");
    }
}

#[test]
fn obj_and_glb_of_the_same_scene_agree() {
    let (Some(text), Some(binary)) = (shared("blender45_sphere.obj"), shared("blender45_sphere.glb")) else {
        return;
    };
    let text = obj::read_mesh(&text).expect("OBJ");
    let binary = gltf::read_mesh(&binary, &Limits::default()).expect("GLB");
    assert_eq!(text.triangles.len(), binary.triangles.len());
    let bounds = |positions: &[[f64; 3]]| {
        [0, 1, 2].map(|axis| {
            let on = || positions.iter().map(|position| position[axis]);
            (on().fold(f64::MAX, f64::min), on().fold(f64::MIN, f64::max))
        })
    };
    for (a, b) in bounds(&text.positions).into_iter().zip(bounds(&binary.positions)) {
        assert!((a.0 - b.0).abs() < 1e-5 && (a.1 - b.1).abs() < 1e-5, "{a:?} {b:?}");
    }
}

#[test]
fn normalized_flag_does_not_clamp_floats() {
    use base64::Engine;
    let corners: [f32; 9] = [-7.0, -2.0, 0.5, 3.0, 0.0, 0.0, 0.0, 3.0, 0.0];
    let packed = base64::engine::general_purpose::STANDARD.encode(corners.map(f32::to_le_bytes).concat());
    let text = format!(
        r#"{{"asset":{{"version":"2.0"}},"scenes":[{{"nodes":[0]}}],"nodes":[{{"mesh":0}}],
        "meshes":[{{"primitives":[{{"attributes":{{"POSITION":0}}}}]}}],
        "accessors":[{{"bufferView":0,"componentType":5126,"normalized":true,"count":3,"type":"VEC3"}}],
        "bufferViews":[{{"buffer":0,"byteLength":36}}],
        "buffers":[{{"byteLength":36,"uri":"data:application/octet-stream;base64,{packed}"}}]}}"#
    );
    let mesh = gltf::read_mesh(text.as_bytes(), &Limits::default()).expect("a triangle");
    assert_eq!(mesh.positions[0], [-7.0, -2.0, 0.5]);
}

#[test]
fn unsupported_and_excessive_documents_are_errors() {
    let limits = Limits::default();
    let external = br#"{"asset":{"version":"2.0"},"buffers":[{"uri":"a.bin","byteLength":4}]}"#;
    assert!(matches!(gltf::read_mesh(external, &limits), Err(Error::Unsupported { .. })));
    let packed = br#"{"asset":{"version":"2.0"},"extensionsRequired":["KHR_draco_mesh_compression"]}"#;
    let error = gltf::read_mesh(packed, &limits).expect_err("Draco").to_string();
    assert!(error.contains("KHR_draco_mesh_compression"), "{error}");
    let circle = br#"{"asset":{"version":"2.0"},"scenes":[{"nodes":[0]}],"nodes":[{"children":[1]},{"children":[0]}]}"#;
    assert!(matches!(gltf::read_mesh(circle, &limits), Err(Error::Invalid { .. })));
    // A small mesh that many nodes use must not become a huge mesh.
    let nodes = vec![r#"{"mesh":0}"#; 20_000].join(",");
    let roots: Vec<String> = (0..20_000).map(|node| node.to_string()).collect();
    let triangles = "AAAA".repeat(3_000); // 9000 zero bytes: 250 triangles at one point
    let bomb = format!(
        r#"{{"asset":{{"version":"2.0"}},"scenes":[{{"nodes":[{}]}}],"nodes":[{nodes}],
        "meshes":[{{"primitives":[{{"attributes":{{"POSITION":0}}}}]}}],
        "accessors":[{{"bufferView":0,"componentType":5126,"count":750,"type":"VEC3"}}],
        "bufferViews":[{{"buffer":0,"byteLength":9000}}],
        "buffers":[{{"byteLength":9000,"uri":"data:application/octet-stream;base64,{triangles}"}}]}}"#,
        roots.join(",")
    );
    let limits = Limits { decompression_ratio: 100, ..limits };
    assert!(matches!(gltf::read_mesh(bomb.as_bytes(), &limits), Err(Error::TooLarge { .. })));
}
