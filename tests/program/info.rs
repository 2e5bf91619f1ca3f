//! The command `info`, which describes files.

use std::fs;
use std::io::Write;
use std::path::Path;
use std::process::Stdio;

use flate2::Compression;
use flate2::write::GzEncoder;
use meniscus::surface::Preset;
use serde_json::Value;
use tempfile::tempdir;

use crate::program::scene::{block, command, irregular, meniscus, write_ply};

#[test]
fn particles_are_described() {
    let folder = tempdir().expect("a folder");
    write_ply(&folder.path().join("block.ply"), &block(10, 0.5));
    let result = meniscus(folder.path(), &["info", "block.ply"]);
    assert_eq!(result.status, 0, "{}", result.err);
    for word in
        ["block.ply: PLY", "particles", "1000", "(0.5, 0, 0) to (1.4, 0.9, 0.9)", "suggested voxel size"]
    {
        assert!(result.out.contains(word), "{word} not in {}", result.out);
    }
    let json: Value = serde_json::from_str(&meniscus(folder.path(), &["info", "--json", "block.ply"]).out)
        .expect("the output is JSON");
    let particles = &json[0]["particles"];
    assert_eq!(particles["count"], 1000);
    let spacing = particles["spacing"].as_f64().expect("a number");
    assert!((spacing / 0.1 - 1.0).abs() < 1e-6, "{spacing}");
    assert!(
        particles["spacing_confidence"].as_f64().is_some_and(|confidence| confidence > 0.95),
        "{particles}"
    );
    assert_eq!(particles["suggested_voxel_size"], 0.032);
    assert_eq!((&particles["irregularity"], &particles["suggested_preset"]), (&0.0.into(), &"fluid".into()));
    assert!(result.out.contains("0 %: evenly spaced, preset fluid suits\n"), "{}", result.out);
}

#[test]
fn suitable_preset_is_named() {
    let folder = tempdir().expect("a folder");
    write_ply(&folder.path().join("wild.ply"), &irregular(7));
    write_ply(&folder.path().join("few.ply"), &block(4, 0.0));
    let json: Value =
        serde_json::from_str(&meniscus(folder.path(), &["info", "--json", "wild.ply", "few.ply"]).out)
            .expect("the output is JSON");
    let [wild, few] = [0, 1].map(|index| &json[index]["particles"]);
    assert!(wild["irregularity"].as_f64().is_some_and(|share| share > 0.3), "{wild}");
    assert_eq!(wild["suggested_preset"], "noisy");
    // The voxel size is that of the suggested preset.
    let voxel_size = wild["spacing"].as_f64().map(|spacing| Preset::Noisy.voxel_size(spacing));
    assert_eq!(wild["suggested_voxel_size"].as_f64(), voxel_size);
    assert_eq!((&few["irregularity"], &few["suggested_preset"]), (&Value::Null, &Value::Null));
    let out = meniscus(folder.path(), &["info", "wild.ply", "few.ply"]).out;
    assert_eq!(out.matches("irregularly spaced, preset noisy suits (splashes: fluid)\n").count(), 1, "{out}");
    assert_eq!(out.matches("irregularity").count(), 1, "{out}");
}

#[test]
fn missing_file_is_reported_as_by_other_commands() {
    let folder = tempdir().expect("a folder");
    let result = meniscus(folder.path(), &["info", "nowhere.ply"]);
    assert_eq!((result.status, &*result.err), (2, "error: nowhere.ply: no such file or folder\n"));
    #[cfg(unix)]
    {
        std::os::unix::fs::symlink("nowhere.ply", folder.path().join("link.ply")).expect("linked");
        let result = meniscus(folder.path(), &["info", "link.ply"]);
        assert!(
            result.err.contains("link.ply: this link leads to a file that does not exist"),
            "{}",
            result.err
        );
    }
}

#[test]
fn attributes_are_described() {
    let folder = tempdir().expect("a folder");
    fs::write(folder.path().join("t.csv"), "x,y,z,density,id\n0,0,0,1.5,7\n1,0,0,-2.5,9007199254740993\n")
        .expect("written");
    let json: Value = serde_json::from_str(&meniscus(folder.path(), &["info", "--json", "t.csv"]).out)
        .expect("the output is JSON");
    let attributes = json[0]["particles"]["attributes"].as_array().expect("a list");
    let find = |name: &str| attributes.iter().find(|a| a["name"] == name).unwrap_or_else(|| panic!("{json}"));
    assert_eq!(find("density")["role"], "density");
    assert_eq!(find("density")["min"][0], -2.5);
    assert_eq!(find("id")["max"][0], 9_007_199_254_740_993_i64);
    assert_eq!(json[0]["particles"]["spacing"], 1.0);
}

#[test]
fn numbers_of_any_magnitude_are_readable() {
    let folder = tempdir().expect("a folder");
    let row = "3,-1.23456789,2.5e-12,1e30";
    fs::write(
        folder.path().join("t.csv"),
        format!("x,y,z,vx,vy,vz,mass\n0,0,0,0,0,0,1\n1e20,0,1e-7,{row}\n"),
    )
    .expect("written");
    let out = meniscus(folder.path(), &["info", "t.csv"]).out;
    for words in [
        "(0, 0, 0) to (1e20, 0, 1e-7)",
        "v: f64 × 3, velocity, (0, -1.23457, 0) to (3, 0, 2.5e-12)",
        "mass: f64 × 1, mass, 1 to 1e30",
    ] {
        assert!(out.contains(words), "{words} is not in {out}");
    }
}

/// A truncated step is marked as such, and the others are described.
#[test]
fn each_step_is_described() {
    let folder = tempdir().expect("a folder");
    let step = |number: usize, count: usize| {
        format!("ITEM: TIMESTEP\n{number}\nITEM: NUMBER OF ATOMS\n{count}\nITEM: ATOMS id x y z\n1 0 0 0.5\n")
    };
    let text = [step(0, 1), step(100, 2), step(200, 1)].concat();
    fs::write(folder.path().join("d.dump"), text).expect("written");
    let result = meniscus(folder.path(), &["info", "--json", "d.dump"]);
    assert_eq!(result.status, 1);
    assert!(
        result.err.contains("error: d.dump/step=100: LAMMPS dump, at line 12: expected 2 atoms"),
        "{}",
        result.err
    );
    let json: Value = serde_json::from_str(&result.out).expect("the output is JSON");
    let files: Vec<_> = json.as_array().expect("a list").iter().map(|file| &file["file"]).collect();
    assert_eq!(files, ["d.dump/step=0", "d.dump/step=100", "d.dump/step=200"]);
    assert_eq!((&json[0]["kind"], &json[0]["particles"]["count"]), (&"LAMMPS dump".into(), &1.into()));
    assert_eq!(meniscus(folder.path(), &["info", "d.dump/step=200"]).status, 0);
}

/// Particles of other programs in files that may also be meshes of this one.
#[test]
fn points_of_scenes_are_described() {
    let folder = tempdir().expect("a folder");
    let path = folder.path();
    let points = |values: &str| format!("def Points \"p\" {{ {values} float[] widths = [0.5, 0.5] }}\n");
    let still = points("point3f[] points = [(0, 0, 0), (1, 2, 3)]");
    let moving =
        points("point3f[] points.timeSamples = { 1: [(0, 0, 0), (1, 2, 3)], 2: [(0, 0, 0), (2, 2, 3)] }");
    let mesh = "def Mesh \"m\" { point3f[] points = [(0, 0, 0), (9, 0, 0), (0, 9, 0)] }\n";
    fs::write(path.join("still.usda"), format!("#usda 1.0\n{still}{mesh}")).expect("written");
    fs::write(path.join("moving.usda"), format!("#usda 1.0\n{moving}")).expect("written");
    let archive = include_bytes!("../fuzz/corpus/abc/points.abc");
    fs::write(path.join("points.abc"), archive).expect("written");
    let info = |name: &str| -> Value {
        let result = meniscus(path, &["info", "--json", name]);
        assert_eq!(result.status, 0, "{}", result.err);
        serde_json::from_str(&result.out).expect("JSON")
    };
    let json = info("still.usda");
    let particles = &json[0]["particles"];
    assert_eq!((&particles["count"], json.as_array().map(Vec::len)), (&2.into(), Some(1)), "{json}");
    assert_eq!(particles["bounds"]["max"], serde_json::json!([1.0, 2.0, 3.0]), "{json}");
    assert!(particles["attributes"][0]["name"] == "widths" && json[0]["mesh"].is_null(), "{json}");
    for (name, steps) in [("moving.usda", 2), ("points.abc", 3)] {
        let json = info(name);
        assert_eq!(json.as_array().map(Vec::len), Some(steps), "{json}");
        assert!(!json[steps - 1]["particles"]["attributes"][0]["name"].is_null(), "{json}");
    }
}

#[test]
fn meshes_are_described() {
    let folder = tempdir().expect("a folder");
    let tetrahedron = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n";
    fs::write(folder.path().join("t.obj"), tetrahedron).expect("written");
    let json: Value = serde_json::from_str(&meniscus(folder.path(), &["info", "--json", "t.obj"]).out)
        .expect("the output is JSON");
    let mesh = &json[0]["mesh"];
    assert_eq!((&mesh["vertices"], &mesh["triangles"]), (&4.into(), &4.into()), "{json}");
    assert_eq!((&mesh["boundary_edges"], &mesh["non_manifold_edges"]), (&0.into(), &0.into()));
    let volume = mesh["volume"].as_f64().expect("a number");
    assert!((volume - 1.0 / 6.0).abs() < 1e-12, "{volume}");
    // A compressed mesh is described, too.
    let mut packed = GzEncoder::new(Vec::new(), Compression::default());
    packed.write_all(tetrahedron.as_bytes()).expect("packed");
    fs::write(folder.path().join("t.obj.gz"), packed.finish().expect("packed")).expect("written");
    let packed: Value = serde_json::from_str(&meniscus(folder.path(), &["info", "--json", "t.obj.gz"]).out)
        .expect("the output is JSON");
    assert_eq!((&packed[0]["mesh"], &packed[0]["gzipped"]), (mesh, &true.into()), "{packed}");
}

#[test]
fn files_that_are_neither_particles_nor_surfaces_are_named() {
    let folder = tempdir().expect("a folder");
    let path = folder.path();
    fs::write(path.join("picture.png"), b"\x89PNG\r\n\x1a\n and so on").expect("written");
    fs::write(path.join("daemon.toml"), "[[watch]]\ninput = \"in\"\n").expect("written");
    fs::write(path.join("data.json"), "[[1, 2], [3, 4]]\n").expect("written");
    fs::write(path.join("notes.md"), "# Notes\n\nFirst, read this; then:\n\n1. eat\n").expect("written");
    for (file, words) in [
        ("notes.md", "text in an unknown format: not a supported particle format"),
        ("picture.png", "PNG image: this is a picture, not particles"),
        ("daemon.toml", "text in an unknown format: not a supported particle format"),
        ("data.json", "JSON, at line 1: expected a list of 3 numbers, found 2"),
    ] {
        let result = meniscus(path, &["info", file]);
        assert!(result.status == 2 && result.err.contains(words), "{}", result.err);
    }
}

/// Meshes have 32-bit positions relative to an origin; their sums have more digits than the positions.
#[test]
fn measurements_of_meshes_have_few_digits() {
    let folder = tempdir().expect("a folder");
    write_ply(&folder.path().join("block.ply"), &block(6, 0.5));
    let convert = ["convert", "block.ply", "--out", "o", "--format", "glb,obj"];
    assert_eq!(meniscus(folder.path(), &convert).status, 0);
    let result = meniscus(folder.path(), &["info", "o/block.glb", "o/block.obj"]);
    let is_measured = |line: &&str| ["bounds", "area", "volume"].iter().any(|name| line.contains(name));
    let lines: Vec<&str> = result.out.lines().filter(is_measured).collect();
    assert_eq!(lines.len(), 6, "{}{}", result.out, result.err);
    for number in lines.iter().flat_map(|line| line.split([' ', ',', '(', ')'])) {
        let digits = number.chars().filter(char::is_ascii_digit).count();
        assert!(digits <= 12, "{}", result.out);
    }
}

#[test]
fn vertices_that_are_not_finite_are_reported() {
    let folder = tempdir().expect("a folder");
    let text = "v 0 0 nan\nv 1 0 0\nv 0 1 0\nv 0 0 1\nv 3 0 0\nf 1 2 3\nf 2 3 4\n";
    fs::write(folder.path().join("t.obj"), text).expect("written");
    let result = meniscus(folder.path(), &["info", "t.obj"]);
    assert!(result.out.contains("vertices not finite  1, the first at (0, 0, NaN)"), "{}", result.out);
    let json: Value = serde_json::from_str(&meniscus(folder.path(), &["info", "--json", "t.obj"]).out)
        .expect("the output is JSON");
    assert_eq!(json[0]["mesh"]["not_finite"], 1);
    let area = json[0]["mesh"]["area"].as_f64().expect("a number");
    assert!((area - 0.75f64.sqrt()).abs() < 1e-12, "{area}");
}

#[test]
fn attributes_of_gltf_are_described() {
    let folder = tempdir().expect("a folder");
    let path = folder.path();
    let (mut ply, particles) = (String::from("ply\nformat ascii 1.0\nelement vertex 64\n"), block(4, 0.0));
    for name in ["x", "y", "z", "vx", "vy", "vz", "age"] {
        ply += &format!("property float {name}\n");
    }
    ply += "end_header\n";
    particles.iter().for_each(|[x, y, z]| ply += &format!("{x} {y} {z} 1 2 3 7\n"));
    fs::write(path.join("a.ply"), ply).expect("written");
    let arguments = ["convert", "a.ply", "--out", "o", "--format", "glb,gltf,vdb", "--attributes", "all"];
    assert_eq!(meniscus(path, &arguments).status, 0);
    let out = meniscus(path, &["info", "o/a.vdb"]).out;
    assert!(out.contains("  made with\n    anisotropy         neighbors\n"), "{out}");
    assert!(!out.contains("meniscus_"), "{out}");
    for name in ["o/a.glb", "o/a.gltf"] {
        let out = meniscus(path, &["info", name]).out;
        assert!(out.contains("_VELOCITY: f32 × 3, velocity, (1, 2, 3) to (1, 2, 3)"), "{out}");
        assert!(out.contains("_AGE: f32 × 1, 7 to 7") && !out.contains("confidence"), "{out}");
        let lines: Vec<&str> = out.lines().skip_while(|line| *line != "  made with").skip(1).collect();
        assert!(lines.iter().any(|line| line.trim_end() == "    input              a.ply"), "{out}");
        assert!(lines.len() > 10 && lines.iter().all(|line| line.starts_with("    ")), "{out}");
        let json: Value =
            serde_json::from_str(&meniscus(path, &["info", "--json", name]).out).expect("the output is JSON");
        let names: Vec<_> = json[0]["mesh"]["attributes"].as_array().expect("a list").iter().collect();
        assert_eq!((&names[0]["name"], &names[1]["name"]), (&"_AGE".into(), &"_VELOCITY".into()), "{json}");
        assert!(json[0].get("particles").is_none(), "vertices are not particles: {json}");
    }
}

#[test]
fn ply_file_with_faces_is_described_as_a_mesh() {
    let folder = tempdir().expect("a folder");
    let info_of = |vertices: &[&str], properties: &[&str], faces: &[&str]| {
        let mut text = format!("ply\nformat ascii 1.0\nelement vertex {}\n", vertices.len());
        for name in properties {
            text += &format!("property float {name}\n");
        }
        let lists = "property list uchar int vertex_indices\nend_header\n";
        text += &format!("element face {}\n{lists}", faces.len());
        text += &[vertices, faces].concat().iter().map(|line| format!("{line}\n")).collect::<String>();
        fs::write(folder.path().join("t.ply"), text).expect("written");
        let result = meniscus(folder.path(), &["info", "t.ply"]);
        assert_eq!(result.status, 0, "{}", result.err);
        result.out
    };
    let lines_with = |out: &str, word: &str| out.lines().filter(|line| line.contains(word)).count();

    let vertices = ["0 0 0 5", "1 0 0 6", "0 1 0 7"];
    let bare = info_of(&["0 0 0", "1 0 0", "0 1 0"], &["x", "y", "z"], &["3 0 1 2"]);
    let more = info_of(&vertices, &["x", "y", "z", "heat"], &["3 0 1 2"]);
    for out in [&bare, &more] {
        let counts =
            ["triangles", "bounds ", "note", "particles", "spacing"].map(|word| lines_with(out, word));
        assert_eq!(counts, [1, 1, 0, 0, 0], "{out}");
    }
    assert_eq!((lines_with(&bare, "attribute"), lines_with(&more, "attribute")), (0, 1), "{more}");

    let empty = info_of(&[], &["x", "y", "z"], &[]);
    assert!(lines_with(&empty, "triangles") == 1 && lines_with(&empty, "particles") == 0, "{empty}");
    let cloud = info_of(&vertices, &["x", "y", "z", "heat"], &[]);
    assert!(lines_with(&cloud, "triangles") == 0 && lines_with(&cloud, "particles") > 0, "{cloud}");
}

#[test]
fn unreadable_file_does_not_stop_others() {
    let folder = tempdir().expect("a folder");
    write_ply(&folder.path().join("block.ply"), &block(4, 0.0));
    fs::write(folder.path().join("noise"), [1, 2, 3, 200, 255]).expect("written");
    let both = meniscus(folder.path(), &["info", "noise", "block.ply", "missing.ply"]);
    assert_eq!(both.status, 1);
    assert!(both.err.contains("noise: ") && both.err.contains("missing.ply: "), "{}", both.err);
    assert!(both.out.contains("block.ply: PLY"));
    assert_eq!(meniscus(folder.path(), &["info", "noise"]).status, 2);
}

#[test]
fn folders_and_patterns_are_expanded() {
    let folder = tempdir().expect("a folder");
    fs::create_dir(folder.path().join("in")).expect("made");
    let names = ["a.1.ply", "a.2.ply", "a.9.ply", "a.10.ply", "a.11.ply", "a.100.ply"];
    for name in names {
        write_ply(&folder.path().join("in").join(name), &block(4, 0.0));
    }
    fs::create_dir(folder.path().join("empty")).expect("made");
    let result = meniscus(folder.path(), &["info", "empty"]);
    assert_eq!(result.status, 2);
    let why = "empty: this is a folder without particles: give the files in it, or a pattern";
    assert!(result.err.contains(why), "{}", result.err);
    for pattern in ["in", "in/*.ply", "in/a.#.ply"] {
        let result = meniscus(folder.path(), &["info", pattern]);
        let listed = result.out.lines().filter_map(|line| Some(line.split_once(": PLY, ")?.0));
        let listed: Vec<&str> = listed.filter_map(|path| path.rsplit('/').next()).collect();
        assert_eq!((result.status, &listed[..]), (0, &names[..]), "{}{}", result.out, result.err);
    }
    let result = meniscus(folder.path(), &["info", "in/*.obj"]);
    assert!(result.status == 2 && result.err.contains("*.obj: "), "{}", result.err);
}

#[test]
fn closed_output_is_not_an_error() {
    let folder = tempdir().expect("a folder");
    write_ply(&folder.path().join("block.ply"), &block(4, 0.0));
    let mut child = command(folder.path(), &["info", "block.ply"])
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .expect("the command starts");
    drop(child.stdout.take());
    let output = child.wait_with_output().expect("the command ends");
    assert_eq!(output.status.code(), Some(0));
    assert_eq!(String::from_utf8_lossy(&output.stderr), "");
}

/// `info` describes the particles of containers, also if files of their formats may have meshes.
#[test]
fn particles_in_scenes_are_described() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fuzz/corpus");
    for (file, kind) in [
        ("abc/points.abc", "Alembic"),
        ("usd/points.usda", "USD text"),
        ("usd/points.usdc", "binary USD"),
        ("usd/points.usdz", "USD"),
        ("hdf5/steps.h5part", "HDF5"),
        ("vdb_points/null_none.vdb", "OpenVDB points"),
    ] {
        let result = meniscus(&folder, &["info", "--json", file]);
        assert_eq!((result.status, &*result.err), (0, ""), "{file}");
        let json: Value = serde_json::from_str(&result.out).expect("JSON");
        for frame in json.as_array().expect("frames") {
            assert_eq!(frame["kind"], kind, "{file}");
            assert!(frame["particles"]["count"].as_u64() > Some(0), "{file}: {frame}");
        }
    }
}

#[test]
fn stage_without_prims_is_described_as_one_without_particles() {
    let folder = tempdir().expect("a folder");
    fs::write(folder.path().join("empty.usda"), "#usda 1.0\n").expect("written");
    let result = meniscus(folder.path(), &["info", "empty.usda"]);
    assert!(result.err.contains("no prims of the type Points or PointInstancer"), "{}", result.err);
}
