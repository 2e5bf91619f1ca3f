//! Obstacles in all supported formats.

use std::cell::RefCell;
use std::io;

use base64::Engine;
use meniscus_formats::{
    Error, LevelSetView, Limits, MeshData, ObstacleData, Result, check_obstacle, gltf, read_obstacle, vdb,
};

fn no_external(_: &str) -> io::Result<Vec<u8>> {
    Err(io::ErrorKind::NotFound.into())
}

fn read(bytes: &[u8], name: &str) -> Result<ObstacleData> {
    let read = read_obstacle(bytes, name, &Limits::default(), &no_external);
    // What the first bytes rule out is refused.
    let refused = check_obstacle(&bytes[..bytes.len().min(64 << 10)], name).is_err();
    assert!(!refused || read.is_err(), "{name}");
    read
}

fn mesh(bytes: &[u8], name: &str) -> MeshData {
    match read(bytes, name).expect(name) {
        ObstacleData::Mesh(mesh) => mesh,
        ObstacleData::LevelSet(_) => panic!("{name} is not a mesh"),
    }
}

/// The corners of each triangle.
fn corners(mesh: &MeshData) -> Vec<[[f64; 3]; 3]> {
    mesh.triangles.iter().map(|triangle| triangle.map(|corner| mesh.positions[corner as usize])).collect()
}

#[test]
fn obj_files_of_all_dialects_are_read() {
    let square = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0]];
    let fan = [[square[0], square[1], square[2]], [square[0], square[2], square[3]]];
    let vertices = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n";
    for (name, text) in [
        ("quad", format!("{vertices}f 1 2 3 4\n")),
        ("relative", format!("{vertices}f -4 -3 -2 -1\n")),
        ("continued", format!("{vertices}f 1 2 \\\n  3 4\n")),
        ("textures that are not there", format!("{vertices}f 1/7 2/8 3/9 4/9\n")),
        ("windows", format!("{vertices}f 1 2 3 4").replace('\n', "\r\n")),
        ("objects", format!("o one\n{vertices}usemtl a\nf 1 2 3\ng two\nusemtl b\nf 1 3 4\n")),
        ("colours of some", format!("{}f 1 2 3 4\n", vertices.replacen("0 0 0", "0 0 0 0.5 0.5 1", 1))),
        ("weights", format!("{}f 1 2 3 4\n", vertices.replacen("0 0 0", "0 0 0 1.0", 1))),
        ("points and lines", format!("{vertices}p 1\nl 1 2\nf 1 2 3 4\nf 1 2\n")),
        ("a comment that ends with a folder", format!("# from C:\\models\\\n{vertices}f 1 2 3 4\n")),
        (
            "comments behind values",
            format!("{}f 1 2 3 # of C:\\models\\\nf 1 3 4\n", vertices.replacen("0 0 0", "0 0 0 # first", 1)),
        ),
        ("vertices later", format!("f 1 2 3 4\n{vertices}")),
    ] {
        assert_eq!(corners(&mesh(text.as_bytes(), "a.obj")), fan, "{name}");
    }
    let latin = [b"o gr\xfc\xdfe\n".as_slice(), vertices.as_bytes(), b"# \xff\nf 1 2 3 4\n"].concat();
    assert_eq!(corners(&mesh(&latin, "a.obj")), fan);
    let normals = mesh(format!("{vertices}vn 0 0 1\nf 1//1 2//1 3//-1\n").as_bytes(), "a.obj");
    assert_eq!(normals.normals, [[0.0, 0.0, 1.0]; 3]);
}

#[test]
fn obj_errors_have_the_line_number() {
    let vertices = "v 0 0 0\nv 1 0 0\n# comment\nv 1 1 0\n";
    for (text, line, word) in [
        ("f 1 2 4\n", 5, "vertex 4, but the file has only 3"),
        ("f 1 2 -4\n", 5, "`-4`"),
        ("f 0 1 2\n", 5, "`0`"),
        ("f 1 2 x\n", 5, "`x`"),
        ("f 1 2 99999999999\n", 5, "`99999999999`"),
        ("\nv 1 2\n", 6, "position"),
        ("v 1 2 three\n", 5, "position"),
        ("vn 0 0 1\nf 1//1 2//1 3//2\n", 6, "normal"),
    ] {
        let error = read(format!("{vertices}{text}").as_bytes(), "a.obj").expect_err(text).to_string();
        assert!(
            error.starts_with(&format!("OBJ, at line {line}: ")) && error.contains(word),
            "{text}: {error}"
        );
    }
    // Absolute indices can refer to later vertices, so the reader checks them at the end of the file.
    for (text, line, what) in [
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9", 4, "vertex 9, but the file has only 3"),
        ("f 1 2 3\nf 1 2 4\nf 1 2 9\nv 0 0 0\nv 1 0 0\nv 0 1 0\n", 2, "vertex 4, but the file has only 3"),
        (
            "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1//2 2//1 3//1\nf 1 2 8\nvn 0 0 1\n",
            4,
            "normal 2, but the file has only 1",
        ),
    ] {
        let error = read(text.as_bytes(), "a.obj").expect_err(text).to_string();
        assert!(error.contains(&format!("at line {line}: ")) && error.contains(what), "{error}");
    }
    let nothing = read(vertices.as_bytes(), "a.obj").expect_err("no faces").to_string();
    assert!(nothing.contains("no triangles"), "{nothing}");
}

/// A glTF document with one buffer that consists of these parts, each with its own buffer view.
fn gltf(parts: &[&[u8]], rest: &str, uri: impl Fn(&[u8]) -> String) -> (String, Vec<u8>) {
    let (mut buffer, mut views) = (Vec::new(), Vec::new());
    for part in parts {
        views.push(format!(r#"{{"buffer":0,"byteOffset":{},"byteLength":{}}}"#, buffer.len(), part.len()));
        buffer.extend_from_slice(part);
        buffer.resize(buffer.len().next_multiple_of(4), 0);
    }
    let (length, uri, views) = (buffer.len(), uri(&buffer), views.join(","));
    let text = format!(
        r#"{{"asset":{{"version":"2.0"}},"buffers":[{{"byteLength":{length},"uri":"{uri}"}}],"bufferViews":[{views}],{rest}}}"#
    );
    (text, buffer)
}

fn embedded(buffer: &[u8]) -> String {
    format!(
        "data:application/octet-stream;base64,{}",
        base64::engine::general_purpose::STANDARD.encode(buffer)
    )
}

fn bytes_of(numbers: &[f32]) -> Vec<u8> {
    numbers.iter().flat_map(|number| number.to_le_bytes()).collect()
}

const STRIP: [f32; 15] = [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 1.0, 1.0, 0.0, 0.0, 2.0, 0.0];

#[test]
fn strips_and_fans_become_consistently_oriented_triangles() {
    for (mode, count) in [(5, 3), (6, 3), (4, 1), (0, 0), (3, 0)] {
        let rest = format!(
            r#""scenes":[{{"nodes":[0]}}],"nodes":[{{"mesh":0}}],
            "meshes":[{{"primitives":[{{"attributes":{{"POSITION":0}},"mode":{mode}}}]}}],
            "accessors":[{{"bufferView":0,"componentType":5126,"count":{},"type":"VEC3"}}]"#,
            if mode == 4 { 3 } else { 5 }
        );
        let (text, _) = gltf(&[&bytes_of(&STRIP)], &rest, embedded);
        let found = read(text.as_bytes(), "a.gltf");
        if count == 0 {
            let words =
                if mode == 0 { "glTF points: not a supported obstacle format" } else { "no triangles" };
            assert!(found.expect_err("points and lines").to_string().contains(words));
            continue;
        }
        let Ok(ObstacleData::Mesh(mesh)) = found else { panic!("mode {mode}: {found:?}") };
        assert_eq!(mesh.triangles.len(), count, "mode {mode}");
        if mode == 5 {
            let area =
                |[a, b, c]: [[f64; 3]; 3]| (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]);
            assert!(corners(&mesh).into_iter().all(|triangle| area(triangle) > 0.0));
        }
    }
}

#[test]
fn faces_of_mirrored_nodes_stay_outward() {
    let document = |scale: &str| {
        let rest = format!(
            r#""scene":0,"scenes":[{{"nodes":[0]}}],"nodes":[{{"mesh":0,"scale":{scale}}}],
            "meshes":[{{"primitives":[{{"attributes":{{"POSITION":0}}}}]}}],
            "accessors":[{{"bufferView":0,"componentType":5126,"count":3,"type":"VEC3"}}]"#
        );
        gltf(&[&bytes_of(&STRIP)], &rest, embedded).0
    };
    for (scale, triangle) in [("[2,1,1]", [0, 1, 2]), ("[-2,1,1]", [0, 2, 1]), ("[-1,-1,1]", [0, 1, 2])] {
        assert_eq!(mesh(document(scale).as_bytes(), "a.gltf").triangles, [triangle], "{scale}");
    }
}

#[test]
fn sparse_elements_and_nested_nodes_are_placed() {
    let values = bytes_of(&[5.0, 5.0, 5.0, 7.0, 7.0, 7.0]);
    // Far from the origin, where 32-bit numbers have steps of 64.
    let rest = |indices: &str| {
        format!(
            r#""scene":0,"scenes":[{{"nodes":[1]}}],
            "nodes":[{{"mesh":0,"translation":[0.25,0,0],"scale":[2,2,2]}},{{"children":[0],"translation":[1000000000,0,0]}}],
            "meshes":[{{"primitives":[{{"attributes":{{"POSITION":0}}}}]}}],
            "accessors":[{{"bufferView":0,"componentType":5126,"count":3,"type":"VEC3",
            "sparse":{{"count":2,"indices":{{"bufferView":{indices},"componentType":5121}},"values":{{"bufferView":3}}}}}}]"#
        )
    };
    let document =
        |indices: &str| gltf(&[&bytes_of(&STRIP), &[0, 2], &[2, 0], &values], &rest(indices), embedded).0;
    let found = mesh(document("1").as_bytes(), "a.gltf");
    let far = |x: f64| 1e9 + 0.25 + 2.0 * x;
    assert_eq!(found.positions, [[far(5.0), 10.0, 10.0], [far(1.0), 0.0, 0.0], [far(7.0), 14.0, 14.0]]);
    let error = read(document("2").as_bytes(), "a.gltf").expect_err("out of order").to_string();
    assert!(error.contains("out of order"), "{error}");
}

#[test]
fn buffers_can_be_external_files() {
    let rest = r#""scenes":[{"nodes":[0]}],"nodes":[{"mesh":0}],
        "meshes":[{"primitives":[{"attributes":{"POSITION":0,"_NAME":0}}]}],
        "accessors":[{"bufferView":0,"componentType":5126,"count":3,"type":"VEC3"}]"#;
    let text = |uri: &str| gltf(&[&bytes_of(&STRIP)], rest, |_| uri.to_owned());
    let (document, buffer) = text("part%20one/a.bin");
    let read_external = |path: &str| {
        assert_eq!(path, "part one/a.bin");
        Ok(buffer.clone())
    };
    let found =
        read_obstacle(document.as_bytes(), "a.gltf", &Limits::default(), &read_external).expect("two files");
    assert!(matches!(found, ObstacleData::Mesh(mesh) if mesh.triangles.len() == 1));
    let missing = read(document.as_bytes(), "a.gltf").expect_err("no such file");
    assert!(matches!(&missing, Error::Io(error) if error.kind() == io::ErrorKind::NotFound));
    assert!(missing.to_string().contains("part one/a.bin"), "{missing}");
    let short = |_: &str| Ok(buffer[..20].to_vec());
    let error = read_obstacle(document.as_bytes(), "a.gltf", &Limits::default(), &short).expect_err("short");
    assert!(error.to_string().contains("exceeds its buffer"), "{error}");
    for (uri, word) in [
        ("https://example.org/a.bin", "not a path relative"),
        ("/etc/a.bin", "not a path relative"),
        ("%2fetc/a.bin", "not a path relative"),
        ("../a.bin", "outside of its own folder"),
        ("b/%2e%2E/../a.bin", "outside of its own folder"),
        ("b\\\\..\\\\..\\\\a.bin", "outside of its own folder"),
        ("\\\\a.bin", "not a path relative"),
        ("a%00.bin", "not the path of a file"),
        ("./", "not the path of a file"),
        ("", "not the path of a file"),
        ("a%zz", "the URI a%zz is invalid"),
    ] {
        let document = text(uri).0;
        let unasked = |path: &str| panic!("{path} was requested");
        let error = read_obstacle(document.as_bytes(), "a.gltf", &Limits::default(), &unasked);
        let errors = [error.expect_err(uri), gltf::external_files(document.as_bytes()).expect_err(uri)];
        assert!(errors.iter().all(|error| error.to_string().contains(word)), "{errors:?}");
    }
}

/// Each file is read once, up to the end of its longest buffer.
#[test]
fn external_files_are_listed_once() {
    let document = br#"{"asset":{"version":"2.0"},"scenes":[{"nodes":[0]}],"nodes":[{"mesh":0}],
        "meshes":[{"primitives":[{"attributes":{"POSITION":0}},{"attributes":{"POSITION":1}}]}],
        "accessors":[{"bufferView":0,"componentType":5126,"count":3,"type":"VEC3"},
        {"bufferView":1,"componentType":5126,"count":3,"type":"VEC3"}],
        "bufferViews":[{"buffer":1,"byteLength":36},{"buffer":3,"byteLength":36}],
        "buffers":[{"byteLength":3,"uri":"data:;base64,AAAA"},{"byteLength":36,"uri":"./b/a.bin"},
        {"byteLength":5,"uri":"a.bin"},{"byteLength":60,"uri":"b//a%2ebin"}]}"#;
    let files = gltf::external_files(document).expect("a document");
    let files: Vec<_> = files.iter().map(|file| (file.path.as_str(), file.byte_count)).collect();
    assert_eq!(files, [("b/a.bin", 60), ("a.bin", 5)]);
    let requested = RefCell::new(Vec::new());
    let read_external = |path: &str| {
        requested.borrow_mut().push(path.to_owned());
        Ok(bytes_of(&STRIP))
    };
    let found = read_obstacle(document, "a.gltf", &Limits::default(), &read_external).expect("three files");
    assert!(matches!(found, ObstacleData::Mesh(mesh) if mesh.triangles.len() == 2));
    assert_eq!(requested.into_inner(), ["b/a.bin", "a.bin"]);
    assert!(gltf::external_files(b"v 0 0 0").is_err());
}

#[test]
fn level_sets_are_obstacles_and_fog_volumes_are_errors() {
    let phi = |offset: usize| ((offset >> 6) as f32 - 3.5).clamp(-3.0, 3.0);
    let leaves = [std::array::from_fn(phi)];
    let view = LevelSetView {
        origins: &[[0; 3]],
        leaves: &leaves,
        half_width_voxels: 3.0,
        voxel_size: 0.5,
        grids: &[],
    };
    let mut bytes = Vec::new();
    vdb::write(&view, &vdb::WriteOptions::default(), &[], &mut bytes).expect("in memory");
    let found = read(&bytes, "wall.vdb").expect("a level set");
    assert!(
        matches!(found, ObstacleData::LevelSet(data) if data.leaves.len() == 1 && data.background == 1.5)
    );
    let class = bytes.windows(9).position(|text| text == b"level set").expect("its class");
    bytes[class..class + 9].copy_from_slice(b"fogvolume");
    let error = read(&bytes, "smoke.vdb").expect_err("no level set").to_string();
    assert!(error.contains("fogvolume"), "{error}");
}

#[test]
fn other_files_are_not_obstacles() {
    for (bytes, name, word) in [
        (b"x,y,z\n1,2,3\n4,5,6\n".as_slice(), "points.csv", "not a supported obstacle format"),
        (b"", "empty.obj", "empty"),
        (b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\nend_header\n1 2 3\n", "points.ply", "no triangles"),
        (b"solid cube\n", "cube.stl", "not a supported obstacle format"),
        (b"# vtk DataFile Version 3.0\na\nASCII\nDATASET POLYDATA\nPOINTS 1 float\n1 2 3\n", "a.vtk", "no triangles"),
    ] {
        let error = read(bytes, name).expect_err(name).to_string();
        assert!(error.contains(word), "{name}: {error}");
        // The first bytes show it, except where only the whole file does.
        match check_obstacle(bytes, name) {
            Err(refused) => assert_eq!(refused.to_string(), error, "{name}"),
            Ok(()) => assert!(["empty.obj", "a.vtk"].contains(&name), "{name}"),
        }
    }
}
