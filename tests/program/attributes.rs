//! Attributes of particles on the surface: the command, from an input file to the outputs.

use std::fs;
use std::path::Path;

use meniscus_formats::{FileAttribute, FilePositions, Limits, ParticleFrame, Values, bgeo, gltf, ply, vdb};
use serde_json::Value;
use tempfile::tempdir;

use crate::program::scene::{RunResult, block, command, meniscus, names_in, write_ply};

const FORMATS: [&str; 5] = ["glb", "gltf", "obj", "ply", "vdb"];

fn attribute(name: &str, arity: usize, values: Values) -> FileAttribute {
    FileAttribute { name: name.to_owned(), arity, role: None, values }
}

/// A block of particles with velocities, colours, numbers and names.
fn frame(edge_count: usize) -> ParticleFrame {
    let positions: Vec<[f32; 3]> =
        block(edge_count, 0.0).into_iter().map(|position| position.map(|along| along as f32)).collect();
    let each = || 0..positions.len();
    let velocity = positions.iter().flat_map(|&[x, y, _]| [3.0, x, -y]).collect();
    let color = positions.iter().flat_map(|&[x, ..]| [0.5, x / 10.0, 0.125]).collect();
    let age = each().map(|index| if index == 7 { f32::NAN } else { 2.5 }).collect();
    let table = vec!["water".to_owned(), "oil".to_owned()];
    let attributes = vec![
        attribute("v", 3, Values::F32(velocity)),
        attribute("Cd", 3, Values::F32(color)),
        attribute("id", 1, Values::I32(each().map(|index| 1000 + index as i32).collect())),
        attribute("age", 1, Values::F32(age)),
        attribute("fluid", 1, Values::Strings { table, indices: each().map(|_| 1).collect() }),
    ];
    ParticleFrame { positions: FilePositions::F32(positions), attributes, notes: Vec::new() }
}

fn write_frame(folder: &Path, edge_count: usize) {
    let mut bytes = Vec::new();
    bgeo::write(&frame(edge_count), &mut bytes).expect("written");
    fs::write(folder.join("f.bgeo"), bytes).expect("written");
}

fn convert(folder: &Path, out: &str, arguments: &[&str]) -> RunResult {
    let formats = FORMATS.join(",");
    let typed = ["convert", "f.bgeo", "--out", out, "--voxel-size", "0.05", "--format", &formats];
    let report = ["--report", "report.json"];
    meniscus(folder, &[&typed[..], &report, arguments].concat())
}

fn files(folder: &Path, out: &str) -> Vec<Vec<u8>> {
    let read = |format| fs::read(folder.join(out).join(format!("f.{format}"))).expect("written");
    FORMATS.into_iter().map(read).collect()
}

fn attribute_report(folder: &Path) -> Value {
    let report: Value =
        serde_json::from_slice(&fs::read(folder.join("report.json")).expect("written")).expect("JSON");
    report["frames"][0]["attributes"].clone()
}

#[test]
fn every_format_has_the_attributes_that_it_supports() {
    let folder = tempdir().expect("a folder");
    let folder = folder.path();
    write_frame(folder, 8);
    // Ids are those of the nearest particle after position smoothing, which is off here.
    let result = convert(folder, "out", &["--attributes", "all", "--position-smoothing", "0"]);
    assert_eq!(result.status, 0, "{}", result.err);
    for note in [
        "1 value of particle attributes ignored: infinite or NaN",
        "id is not in the .vdb",
        "fluid is not in the .vdb",
        "v is missing in the .obj",
    ] {
        assert!(result.err.contains(note), "{note}: {}", result.err);
    }
    let [glb, gltf, obj, ply, level_set] = &files(folder, "out")[..] else { panic!("five files") };
    let (mesh, vertices) = ply::read_mesh_and_vertices(ply, &Limits::default()).expect("a mesh");
    let named = |name: &str| {
        let found = vertices.attributes.iter().find(|attribute| attribute.name == name);
        &found.unwrap_or_else(|| panic!("no {name}")).values
    };
    let Values::F32(velocity) = named("v") else { panic!("no reals") };
    for (position, velocity) in mesh.positions.iter().zip(velocity.as_chunks::<3>().0) {
        assert_eq!(velocity[0], 3.0);
        assert!((f64::from(velocity[1]) - position[0]).abs() < 0.25, "{velocity:?} at {position:?}");
        assert!((0.0..=0.7001).contains(&velocity[1]) && (-0.7001..=0.0).contains(&velocity[2]));
    }
    let Values::U8(color) = named("color") else { panic!("no bytes") };
    assert!(color.as_chunks::<3>().0.iter().all(|[r, _, b]| [*r, *b] == [128, 32]));
    assert_eq!(*named("age"), Values::F32(vec![2.5; mesh.positions.len()]));
    assert_eq!(*named("fluid"), Values::I32(vec![1; mesh.positions.len()]));
    let Values::I32(ids) = named("id") else { panic!("no integers") };
    let FilePositions::F32(particles) = frame(8).positions else { panic!("32 bits") };
    for (position, id) in mesh.positions.iter().zip(ids) {
        let distance = |particle: &[f32; 3]| -> f64 {
            (0..3).map(|axis| (f64::from(particle[axis]) - position[axis]).powi(2)).sum::<f64>().sqrt()
        };
        let least = particles.iter().map(distance).fold(f64::INFINITY, f64::min);
        assert!(distance(&particles[(id - 1000) as usize]) < least + 1e-5, "{id} at {position:?}");
    }
    for text in [&glb[..], &gltf[..]] {
        let text = String::from_utf8_lossy(text);
        for name in
            ["\"COLOR_0\"", "\"_VELOCITY\"", "\"_ID\"", "\"_AGE\"", r#""strings":{"_FLUID":["water","oil"]}"#]
        {
            assert!(text.contains(name), "{name}");
        }
    }
    let line = String::from_utf8_lossy(obj);
    let line = line.lines().find(|line| line.starts_with("v ")).expect("a vertex");
    assert_eq!(line.split(' ').count(), 7, "{line}");
    let grids = vdb::grids(level_set, &Limits::default()).expect("grids");
    let names: Vec<&str> = grids.iter().map(|grid| &*grid.name).collect();
    assert_eq!(names, ["surface", "velocity", "Cd", "age"]);
    assert!(grids.iter().all(|grid| grid.active_voxel_count == grids[0].active_voxel_count));

    let attribute_report = attribute_report(folder);
    let names: Vec<&str> =
        attribute_report["names"].as_array().expect("names").iter().filter_map(Value::as_str).collect();
    assert_eq!(names, ["v", "Cd", "id", "age", "fluid"]);
    assert_eq!(attribute_report["vertices"]["count"], mesh.positions.len());
    for (target, count) in [("vertices", "isolated"), ("vertices", "empty"), ("band", "empty")] {
        assert_eq!(attribute_report[target][count], 0, "{target} {count}");
    }
    assert_eq!(
        (&attribute_report["vertices"]["left_out"], &attribute_report["band"]["left_out"]),
        (&1.into(), &1.into())
    );
}

#[test]
fn attributes_are_selected_by_column_name_or_by_meaning() {
    let folder = tempdir().expect("a folder");
    let folder = folder.path();
    write_frame(folder, 5);
    for (typed, expected) in
        [("velocity,color", ["v", "Cd"]), ("CD,ID", ["Cd", "id"]), ("v,nothing,age", ["v", "age"])]
    {
        let result = convert(folder, "out", &["--attributes", typed]);
        assert_eq!(result.status, 0, "{}", result.err);
        assert_eq!(attribute_report(folder)["names"], Value::from(expected.to_vec()), "{typed}");
        let has_warning = result.err.contains("no attribute `nothing`")
            && result.err.contains("available: v, Cd, id, age, fluid");
        assert_eq!(has_warning, typed.contains("nothing"), "{}", result.err);
    }
}

#[test]
fn attributes_change_no_geometry_and_do_not_depend_on_threads() {
    let folder = tempdir().expect("a folder");
    let folder = folder.path();
    write_frame(folder, 9);
    let all = ["--attributes", "all"];
    for (out, arguments) in [
        ("plain", &[][..]),
        ("one", &[&all[..], &["--threads", "1"]].concat()),
        ("two", &[&all[..], &["--threads", "2"]].concat()),
    ] {
        let result = convert(folder, out, arguments);
        assert_eq!(result.status, 0, "{}", result.err);
    }
    assert!(files(folder, "one") == files(folder, "two"));
    for level in ["baseline", "avx2"] {
        let formats = FORMATS.join(",");
        let typed = ["convert", "f.bgeo", "--out", level, "--voxel-size", "0.05", "--format", &formats];
        let result = command(folder, &[&typed[..], &all].concat()).env("MENISCUS_SIMD", level).output();
        assert!(result.expect("the command starts").status.success());
        assert!(files(folder, level) == files(folder, "one"), "{level}");
    }
    let [plain, with] = ["plain", "one"].map(|out| files(folder, out));
    let mesh =
        |files: &[Vec<u8>]| ply::read_mesh_and_vertices(&files[3], &Limits::default()).expect("a mesh").0;
    assert!(mesh(&plain) == mesh(&with));
    let level_set = |files: &[Vec<u8>]| {
        let mut data = vdb::read_level_set(&files[4], None, &Limits::default()).expect("a level set");
        data.metadata.clear();
        data
    };
    assert!(level_set(&plain) == level_set(&with));
    // `--skip-done` recognizes the outputs, with their number of grids.
    let again = convert(folder, "one", &[&all[..], &["--skip-done"]].concat());
    assert!(again.status == 0 && again.out.contains("done already"), "{}{}", again.out, again.err);
}

#[test]
fn tiled_conversion_gives_the_same_attributes() {
    let folder = tempdir().expect("a folder");
    let folder = folder.path();
    let mut rod = frame(2);
    let FilePositions::F32(positions) = &mut rod.positions else { panic!("32 bits") };
    *positions = (0..12_000).map(|index| [(index % 2) as f32 * 0.1, 0.0, (index / 2) as f32 * 0.1]).collect();
    rod.attributes = vec![
        attribute("v", 3, Values::F32((0..36_000).map(|index| (index as f32 * 0.01).sin()).collect())),
        attribute("id", 1, Values::I32((0..12_000).collect())),
    ];
    let mut bytes = Vec::new();
    bgeo::write(&rod, &mut bytes).expect("written");
    fs::write(folder.join("f.bgeo"), bytes).expect("written");
    let all = ["--attributes", "all"];
    let whole = convert(folder, "whole", &all);
    assert_eq!(whole.status, 0, "{}", whole.err);
    let least = convert(folder, "tiles", &[&all[..], &["--memory", "1MiB"]].concat());
    let needed =
        least.err.split("the frame needs at least ").nth(1).and_then(|after| after.split(' ').next());
    let needed: u64 =
        needed.and_then(|number| number.parse().ok()).unwrap_or_else(|| panic!("{}", least.err));
    let memory = format!("{}MiB", needed + 1);
    let tiled = convert(folder, "tiles", &[&all[..], &["--memory", &memory]].concat());
    assert!(tiled.status == 0 && tiled.err.contains("in tiles"), "{memory}: {}", tiled.err);
    assert!(files(folder, "whole") == files(folder, "tiles"));
}

/// If the voxel size were half the spacing, all particles with that radius would be enlarged.
#[test]
fn voxel_size_is_small_enough_for_radii_from_a_column() {
    let folder = tempdir().expect("a folder");
    let folder = folder.path();
    let mut particles = frame(6);
    let radii = (0..216).map(|index| if index < 20 { 0.03 } else { 0.05 }).collect();
    particles.attributes = vec![attribute("pscale", 1, Values::F32(radii))];
    let mut bytes = Vec::new();
    bgeo::write(&particles, &mut bytes).expect("written");
    fs::write(folder.join("f.bgeo"), bytes).expect("written");
    let typed = ["convert", "f.bgeo", "--out", "o", "--report", "r.json", "--radius-attribute", "pscale"];
    let result = meniscus(folder, &typed);
    assert!(
        result.status == 0
            && result
                .out
                .contains("the median radius of the particles 0.05 (measured on f.bgeo), voxel size 0.032,"),
        "{}",
        result.out
    );
    let report: Value =
        serde_json::from_slice(&fs::read(folder.join("r.json")).expect("there")).expect("JSON");
    let settings = &report["settings"][0];
    let voxel_size = settings["voxel_size"].as_f64().expect("a number");
    assert!((voxel_size - 0.032).abs() < 1e-7, "{voxel_size}");
    assert_eq!(settings["radius_median"].as_f64(), Some(f64::from(0.05f32)));
    assert_eq!(report["frames"][0]["shapes"]["small_radii"], 20);
    assert!(result.err.contains("20 particles too small for the grid"), "{}", result.err);
    assert!(result.err.contains("--voxel-size 0.0272 or less resolves all of them"), "{}", result.err);
    // The voxel size in the warning is small enough. The daemon (below) measures the same.
    let result = meniscus(folder, &[&typed[..], &["--voxel-size", "0.0272"]].concat());
    assert_eq!(result.status, 0);
    // Position smoothing would move the particles by more than the radius of such small balls.
    assert!(result.err.lines().all(|line| line.contains("are outside the surface")), "{}", result.err);
    fs::create_dir(folder.join("in")).expect("made");
    fs::rename(folder.join("f.bgeo"), folder.join("in/f.bgeo")).expect("moved");
    let watched = ["watch", "in", "--out", "w", "--once", "--radius-attribute", "pscale", "--log", "json"];
    let result = meniscus(folder, &watched);
    assert!(result.status == 0 && result.err.contains("\"voxel_size\":0.032"), "{}", result.err);
}

#[test]
fn separate_balls_of_own_radii_are_no_misfit() {
    let folder = tempdir().expect("a folder");
    let rows: String = (0..27).map(|i| format!("{},{},{},0.1\n", i % 3, i / 3 % 3, i / 9)).collect();
    fs::write(folder.path().join("f.csv"), format!("x,y,z,radius\n{rows}")).expect("written");
    let result = meniscus(folder.path(), &["convert", "f.csv", "--out", "o", "--radius-attribute", "radius"]);
    assert!(result.status == 0 && !result.err.contains("pieces"), "{}", result.err);
}

/// If only some particles have a radius, the others get the smallest radius, with a warning. If no particle
/// has a radius, the command fails.
#[test]
fn frame_without_any_radius_fails() {
    let folder = tempdir().expect("a folder");
    let folder = folder.path();
    let write = |name: &str, radii: Vec<f32>| {
        let mut frame = frame(6);
        frame.attributes = vec![attribute("pscale", 1, Values::F32(radii))];
        let mut bytes = Vec::new();
        bgeo::write(&frame, &mut bytes).expect("written");
        fs::write(folder.join(name), bytes).expect("written");
    };
    let useless = [0.0, -0.05, f32::NAN, f32::INFINITY];
    write("f.1.bgeo", useless.repeat(54));
    write("f.2.bgeo", (0..216).map(|index| if index == 7 { 0.05 } else { useless[index % 4] }).collect());
    let typed = ["convert", ".", "--out", "o", "--format", "obj", "--radius-attribute", "pscale"];
    for more in [&[][..], &["--voxel-size", "0.05"]] {
        let result = meniscus(folder, &[&typed[..], more].concat());
        assert_eq!(result.status, 1, "{}", result.err);
        let expected = "f.1.bgeo: the particles' attribute `pscale` has no positive value, but --radius-attribute needs radii";
        assert!(result.err.contains(expected), "{}", result.err);
        assert!(
            result.err.contains("215 particles without a radius that is a positive number"),
            "{}",
            result.err
        );
        assert_eq!(names_in(&folder.join("o")), ["f.2.obj"]);
    }
}

#[test]
fn frame_without_the_attributes_causes_a_warning() {
    let folder = tempdir().expect("a folder");
    write_ply(&folder.path().join("bare.ply"), &block(5, 0.0));
    let typed = ["convert", "bare.ply", "--voxel-size", "0.05", "--attributes", "velocity", "--out", "out"];
    let result = meniscus(folder.path(), &typed);
    assert!(result.status == 0 && result.err.contains("no attribute `velocity`"), "{}", result.err);
}

/// The values of an attribute of the mesh `out/f.ply`.
fn values_in_ply(folder: &Path, out: &str, name: &str) -> Vec<f32> {
    let bytes = fs::read(folder.join(out).join("f.ply")).expect("written");
    let (_, vertices) = ply::read_mesh_and_vertices(&bytes, &Limits::default()).expect("a mesh");
    let found = vertices.attributes.into_iter().find(|attribute| attribute.name == name);
    match found.unwrap_or_else(|| panic!("no {name}")).values {
        Values::F32(values) => values,
        other => panic!("{other:?}"),
    }
}

#[test]
fn accelerations_are_a_property_of_the_mesh_in_usd() {
    let folder = tempdir().expect("a folder");
    let folder = folder.path();
    write_frame_with_accelerations(folder);
    let typed = ["convert", "f.bgeo", "--voxel-size", "0.05", "--format", "usda,glb,ply", "--out", "out"];
    let result = meniscus(folder, &[&typed[..], &["--attributes", "v,acceleration"]].concat());
    assert_eq!(result.status, 0, "{}", result.err);
    let text = fs::read_to_string(folder.join("out/f.usda")).expect("written");
    assert!(text.contains("vector3f[] accelerations = [(0, -9.5, 2), (0, -9.5, 2)"), "{text:.2000}");
    assert!(!text.contains("primvars:accel"));
    let glb = fs::read(folder.join("out/f.glb")).expect("written");
    assert!(String::from_utf8_lossy(&glb).contains("\"_ACCELERATION\""));
    assert_eq!(values_in_ply(folder, "out", "accel")[..3], [0.0, -9.5, 2.0]);
    let info = meniscus(folder, &["info", "f.bgeo"]).out;
    assert!(info.contains("accel: f32 × 3, acceleration"), "{info}");
}

/// Velocities per frame at 24 frames per second: the unit of time changes, so accelerations change by 24².
#[test]
fn velocity_scale_applies_to_velocities_and_accelerations_in_all_outputs() {
    let folder = tempdir().expect("a folder");
    let folder = folder.path();
    write_frame_with_accelerations(folder);
    let convert = |out: &str, arguments: &[&str]| {
        let typed = ["convert", "f.bgeo", "--voxel-size", "0.05", "--format", "ply,vdb,obj", "--out", out];
        let result = meniscus(folder, &[&typed[..], arguments].concat());
        assert_eq!(result.status, 0, "{}", result.err);
        result.out + &result.err
    };
    let selected = ["--attributes", "v,accel,Cd,age"];
    convert("once", &selected);
    let scaled = [&selected[..], &["--velocity-scale", "24"]].concat();
    convert("scaled", &scaled);
    for (name, factor) in [("v", 24.0), ("accel", 576.0), ("age", 1.0)] {
        let [own, found] = ["once", "scaled"].map(|out| values_in_ply(folder, out, name));
        let expected: Vec<f32> = own.iter().map(|value| value * factor).collect();
        assert!(found.len() >= 100 && found == expected, "{name}");
    }
    // The grids of a .vdb have the same scale.
    for (grid, factor) in [("velocity", 24.0), ("accel", 576.0), ("Cd", 1.0)] {
        let [own, found] = ["once", "scaled"].map(|out| {
            let bytes = fs::read(folder.join(out).join("f.vdb")).expect("written");
            let found = vdb::read_vectors(&bytes, &[grid], &Limits::default()).expect("readable");
            let leaves = found.unwrap_or_else(|| panic!("no {grid}")).leaves;
            let numbers = leaves.iter().flatten().flatten();
            numbers.fold(0.0_f32, |greatest, number| greatest.max(number.abs()))
        });
        assert!((found / (own * factor) - 1.0).abs() < 1e-6 && own > 0.0, "{grid}: {own} {found}");
    }
    // The surface is the same, and files record the factor, so --skip-done notices another one.
    let [own, found] = ["once", "scaled"].map(|out| {
        let bytes = fs::read(folder.join(out).join("f.ply")).expect("written");
        (ply::read_mesh_and_vertices(&bytes, &Limits::default()).expect("a mesh").0, bytes)
    });
    assert_eq!(own.0.positions, found.0.positions);
    let has = |bytes: &[u8]| String::from_utf8_lossy(bytes).contains("meniscus_velocity_scale: 24");
    assert!(has(&found.1) && !has(&own.1));
    let again = [&scaled[..], &["--skip-done"]].concat();
    assert!(convert("scaled", &again).contains("done already"));
    let other = [&selected[..], &["--velocity-scale", "25", "--skip-done"]].concat();
    assert!(!convert("scaled", &other).contains("done already"));
    // Without velocities the option has no effect.
    let note =
        "--velocity-scale is ignored: it is for --attributes, --anisotropy velocity and --time-step only";
    assert!(convert("none", &["--velocity-scale", "24"]).contains(note));
}

fn write_frame_with_accelerations(folder: &Path) {
    let mut frame = frame(6);
    let count = frame.positions.len();
    frame.attributes.push(attribute("accel", 3, Values::F32([0.0, -9.5, 2.0].repeat(count))));
    let mut bytes = Vec::new();
    bgeo::write(&frame, &mut bytes).expect("written");
    fs::write(folder.join("f.bgeo"), bytes).expect("written");
}

#[test]
fn velocity_is_found_by_any_of_its_names() {
    let folder = tempdir().expect("a folder");
    write_frame(folder.path(), 4);
    let bytes = |name: &str| {
        let result = meniscus(
            folder.path(),
            &[
                "convert",
                "f.bgeo",
                "--out",
                "o",
                "--voxel-size",
                "0.05",
                "--format",
                "glb",
                "--attributes",
                name,
            ],
        );
        assert_eq!(result.status, 0, "{name}: {}", result.err);
        // The record has the name that the user typed.
        let text =
            String::from_utf8_lossy(&fs::read(folder.path().join("o/f.glb")).expect("written")).into_owned();
        text.contains("_VELOCITY")
    };
    for name in ["v", "V", "vel", "velocity", "Velocities"] {
        assert!(bytes(name), "{name}");
    }
    assert!(!bytes("age"));
}

#[test]
fn column_of_the_exact_name_is_preferred() {
    let folder = tempdir().expect("a folder");
    let mut frame = frame(4);
    let count = frame.positions.len();
    frame.attributes.push(attribute("velocity", 3, Values::F32(vec![1.0; 3 * count])));
    let mut bytes = Vec::new();
    bgeo::write(&frame, &mut bytes).expect("written");
    fs::write(folder.path().join("f.bgeo"), bytes).expect("written");
    let result = convert(folder.path(), "o", &["--attributes", "v"]);
    assert_eq!(result.status, 0, "{}", result.err);
    let names = attribute_report(folder.path()).to_string();
    assert!(names.contains("\"v\"") && !names.contains("\"velocity\""), "{names}");
}

#[test]
fn unused_velocity_is_mentioned_once() {
    let folder = tempdir().expect("a folder");
    write_frame(folder.path(), 4);
    fs::copy(folder.path().join("f.bgeo"), folder.path().join("g.bgeo")).expect("copied");
    let hint = "note: frames have the attribute \"v\" (velocity); --attributes v adds it";
    let count = |more: &[&str]| {
        let arguments = ["convert", "f.bgeo", "g.bgeo", "--out", "o", "--voxel-size", "0.05"];
        let result = meniscus(folder.path(), &[&arguments[..], more].concat());
        assert_eq!(result.status, 0, "{}", result.err);
        result.out.matches(hint).count() + result.err.matches(hint).count()
    };
    assert_eq!(count(&["--format", "glb"]), 1);
    assert_eq!(count(&["--format", "glb", "--attributes", "vel"]), 0);
    assert_eq!(count(&["--format", "glb", "--attributes", "all"]), 0);
    // These formats cannot store attributes.
    assert_eq!(count(&["--format", "obj,stl"]), 0);
    let result =
        meniscus(folder.path(), &["convert", "f.bgeo", "--out", "p", "--particles-only", "--format", "ply"]);
    assert!(result.status == 0 && !result.out.contains("note:"), "{}{}", result.out, result.err);
}

#[test]
fn axis_may_be_upper_case_and_units_are_written() {
    let folder = tempdir().expect("a folder");
    write_frame(folder.path(), 4);
    let convert = |more: &[&str]| {
        let arguments = ["convert", "f.bgeo", "--out", "o", "--voxel-size", "0.05"];
        meniscus(folder.path(), &[&arguments[..], more].concat())
    };
    let result = convert(&["--format", "usda", "--up", "Z", "--meters-per-unit", "0.01"]);
    assert_eq!((result.status, &*result.err), (0, ""), "{}", result.out);
    let text = fs::read_to_string(folder.path().join("o/f.usda")).expect("written");
    for line in ["upAxis = \"Z\"", "metersPerUnit = 0.01", "defaultPrim = \"root\""] {
        assert!(text.contains(&format!("    {line}\n")), "{line}");
    }
    assert!(text.contains("def Xform \"root\"\n{\n    def Mesh \"surface\"\n"));
    let result = convert(&["--format", "obj", "--meters-per-unit", "0.01"]);
    assert!(result.status == 0 && result.err.contains("--meters-per-unit"), "{}", result.err);
    for (formats, is_warned) in [("glb,usda", true), ("obj,usda", false)] {
        let result = convert(&["--format", formats, "--meters-per-unit", "0.01"]);
        assert_eq!(result.err.contains("--meters-per-unit does not scale .glb"), is_warned, "{}", result.err);
    }
    for wrong in ["0", "-1", "1e10", "inf", "nan", "m"] {
        let result = convert(&["--format", "usda", &format!("--meters-per-unit={wrong}")]);
        assert!(
            result.status == 2 && result.err.contains("not a number from 1e-9"),
            "{wrong}: {}",
            result.err
        );
    }
}

/// Particles whose texture coordinates jump in the middle of a block.
#[test]
fn texture_coordinates_are_means_with_one_value_per_vertex() {
    let folder = tempdir().expect("a folder");
    let positions: Vec<[f32; 3]> =
        block(8, 0.0).into_iter().map(|position| position.map(|along| along as f32)).collect();
    let middle = positions.iter().map(|[x, ..]| x).sum::<f32>() / positions.len() as f32;
    let uv = positions.iter().flat_map(|&[x, ..]| [if x < middle { 0.25 } else { 0.75 }, 0.5, 1.0]);
    let attributes = vec![attribute("uv", 3, Values::F32(uv.collect()))];
    let frame = ParticleFrame { positions: FilePositions::F32(positions), attributes, notes: Vec::new() };
    let mut bytes = Vec::new();
    bgeo::write(&frame, &mut bytes).expect("written");
    fs::write(folder.path().join("f.bgeo"), bytes).expect("written");
    let typed = ["convert", "f.bgeo", "--format", "obj,glb,vdb", "--attributes", "st", "--out", "o"];
    let result = meniscus(folder.path(), &typed);
    assert_eq!(result.status, 0, "{}", result.err);
    let warnings: Vec<&str> = result.err.lines().filter(|line| line.starts_with("warning")).collect();
    assert!(matches!(warnings[..], [one] if one.contains("uv is not in the .vdb")), "{}", result.err);

    let text = fs::read_to_string(folder.path().join("o/f.obj")).expect("written");
    let rows = text.lines().filter_map(|line| line.strip_prefix("vt "));
    let rows: Vec<Vec<f32>> =
        rows.map(|row| row.split(' ').map(|number| number.parse().expect("a number")).collect()).collect();
    assert_eq!(rows.len(), text.lines().filter(|line| line.starts_with("v ")).count());
    assert!(rows.iter().all(|row| row.len() == 2 && (0.25..=0.75).contains(&row[0]) && row[1] == 0.5));
    let blended = rows.iter().filter(|row| (0.3..0.7).contains(&row[0])).count();
    assert!(0 < blended && blended < rows.len() / 2, "{blended} of {}", rows.len());

    let glb = fs::read(folder.path().join("o/f.glb")).expect("written");
    let attributes = gltf::read_attributes(&glb, &Limits::default()).expect("our own file");
    let [uv] = &attributes[..] else { panic!("{attributes:?}") };
    assert_eq!((&*uv.name, &uv.values), ("TEXCOORD_0", &Values::F32(rows.concat())));
}

#[test]
fn far_particle_does_not_move_other_vertices() {
    let folder = tempdir().expect("a folder");
    let vertices = |far: &str| {
        let mut text = String::from("x,y,z\n");
        for [x, y, z] in block(6, 0.0125) {
            text += &format!("{x},{y},{z}\n");
        }
        fs::write(folder.path().join("f.csv"), format!("{text}{far},0,0\n")).expect("written");
        let arguments = ["convert", "f.csv", "--out", "o", "--voxel-size", "0.05", "--format", "obj"];
        assert_eq!(meniscus(folder.path(), &arguments).status, 0);
        let obj = fs::read_to_string(folder.path().join("o/f.obj")).expect("written");
        let near = |line: &&str| {
            line.strip_prefix("v ").is_some_and(|rest| {
                rest.split(' ').next().and_then(|x| x.parse::<f64>().ok()).is_some_and(|x| x < 5.0)
            })
        };
        obj.lines().filter(near).map(str::to_owned).collect::<Vec<_>>()
    };
    let short = vertices("10.5");
    assert!(short.len() > 100);
    assert_eq!(vertices("10.500000123"), short);
}

/// A drop beside a large one does not stretch it, at any distance.
#[test]
fn large_drop_stays_a_ball_beside_a_small_one() {
    let folder = tempdir().expect("a folder");
    let folder = folder.path();
    for distance in [0.11, 0.125, 0.14, 0.16] {
        fs::write(folder.join("f.csv"), format!("x,y,z,r\n0,0,0,0.025\n{distance},0,0,0.1\n"))
            .expect("written");
        let typed = ["convert", "f.csv", "-o", "f.obj", "--radius-attribute", "r", "--spacing", "0.05"];
        let result = meniscus(folder, &typed);
        assert_eq!(result.status, 0, "{}", result.err);
        let text = fs::read_to_string(folder.join("f.obj")).expect("there");
        let rows = text.lines().filter_map(|line| line.strip_prefix("v "));
        let vertices =
            rows.map(|row| -> Vec<f64> { row.split(' ').map(|x| x.parse().expect("a number")).collect() });
        let far = vertices.clone().map(|vertex| vertex[0]).fold(0.0, f64::max);
        let wide = vertices.map(|vertex| vertex[1].hypot(vertex[2])).fold(0.0, f64::max);
        assert!(
            (far - distance - 0.1).abs() < 0.008 && (wide - 0.1).abs() < 0.008,
            "{distance}: {far} {wide}"
        );
    }
}
