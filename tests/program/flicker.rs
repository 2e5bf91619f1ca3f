//! The command `flicker`, which scores the flicker of surfaces: spheres with a known motion, as meshes of
//! every format.

#![allow(clippy::cast_possible_truncation, reason = "numbers of tests are small")]

use std::fmt::Write;
use std::fs;
use std::path::Path;

use meniscus_formats::{Format, MeshOptions, MeshView, OutputFormat};
use tempfile::{TempDir, tempdir};

use crate::program::scene::{RunResult, meniscus, write_ply};

const RINGS: u32 = 24;

/// The spacing of the particles.
const SPACING: f64 = 0.1;

/// Corners and triangles of a sphere of latitudes and longitudes.
fn sphere(radius: f64, x: f64) -> (Vec<[f32; 3]>, Vec<[u32; 3]>) {
    let columns = 2 * RINGS;
    let at = |ring: u32, column: u32| {
        let (across, height) = (std::f64::consts::PI * f64::from(ring) / f64::from(RINGS)).sin_cos();
        // All corners at a pole have one position.
        let across = if ring.is_multiple_of(RINGS) { 0.0 } else { across };
        let (sin, cos) = (std::f64::consts::TAU * f64::from(column) / f64::from(columns)).sin_cos();
        [x + radius * across * cos, radius * across * sin, radius * height].map(|along| along as f32)
    };
    let positions = (0..=RINGS).flat_map(|ring| (0..columns).map(move |column| at(ring, column))).collect();
    let index = |ring: u32, column: u32| ring * columns + column % columns;
    let mut triangles = Vec::new();
    for (ring, column) in (0..RINGS).flat_map(|ring| (0..columns).map(move |column| (ring, column))) {
        let [a, b] = [index(ring, column), index(ring + 1, column)];
        let [c, d] = [index(ring + 1, column + 1), index(ring, column + 1)];
        triangles.extend([[a, b, c], [a, c, d]]);
    }
    (positions, triangles)
}

fn write_obj(path: &Path, (positions, triangles): &(Vec<[f32; 3]>, Vec<[u32; 3]>)) {
    let mut text = String::new();
    positions.iter().for_each(|[x, y, z]| writeln!(text, "v {x} {y} {z}").expect("text"));
    for triangle in triangles {
        let [a, b, c] = triangle.map(|corner| corner + 1);
        writeln!(text, "f {a} {b} {c}").expect("text");
    }
    fs::write(path, text).expect("written");
}

/// The mesh in a file of another format, by its extension.
fn write_mesh(path: &Path, mesh: &(Vec<[f32; 3]>, Vec<[u32; 3]>)) {
    let (positions, triangles) = mesh;
    let normals = vec![[0.0, 0.0, 1.0]; positions.len()];
    let view = MeshView { positions, normals: &normals, triangles, origin: [0.0; 3], attributes: &[] };
    let mut bytes = Vec::new();
    let points: String = positions.iter().map(|[x, y, z]| format!("{x} {y} {z}\n")).collect();
    let head = |kind: &str| {
        format!(
            "# vtk DataFile Version 3.0\na\nASCII\nDATASET {kind}\nPOINTS {} float\n{points}",
            positions.len()
        )
    };
    let cells: String = triangles.iter().map(|[a, b, c]| format!("3 {a} {b} {c}\n")).collect();
    let (count, size) = (triangles.len(), 4 * triangles.len());
    match path.extension().and_then(|extension| extension.to_str()).expect("an extension") {
        "obj" => return write_obj(path, mesh),
        "vtk" => bytes = format!("{}POLYGONS {count} {size}\n{cells}", head("POLYDATA")).into_bytes(),
        "vtu" => {
            let connectivity: String = triangles.iter().map(|[a, b, c]| format!("{a} {b} {c} ")).collect();
            let ends: String = (1..=count).map(|cell| format!("{} ", 3 * cell)).collect();
            bytes = format!(
                "<VTKFile type=\"UnstructuredGrid\"><UnstructuredGrid><Piece NumberOfPoints=\"{}\" NumberOfCells=\"{count}\">\
                 <Points><DataArray type=\"Float32\" NumberOfComponents=\"3\" format=\"ascii\">{points}</DataArray></Points>\
                 <Cells><DataArray type=\"Int64\" Name=\"connectivity\" format=\"ascii\">{connectivity}</DataArray>\
                 <DataArray type=\"Int64\" Name=\"offsets\" format=\"ascii\">{ends}</DataArray>\
                 <DataArray type=\"UInt8\" Name=\"types\" format=\"ascii\">{}</DataArray></Cells>\
                 </Piece></UnstructuredGrid></VTKFile>\n",
                positions.len(),
                "5 ".repeat(count)
            )
            .into_bytes();
        }
        other => OutputFormat::from_extension(other)
            .unwrap_or_else(|| panic!("{other}"))
            .write_mesh(&view, &MeshOptions::default(), &[], &mut bytes)
            .expect("in memory"),
    }
    fs::write(path, bytes).expect("written");
}

/// A ball of particles on a lattice, as a table with ids or velocities.
fn write_particles(path: &Path, x: f64, columns: &str) {
    let along = || (-10..=10).map(|step| SPACING * f64::from(step));
    let points = along().flat_map(|x| along().flat_map(move |y| along().map(move |z| [x, y, z])));
    let mut text = format!("x,y,z{columns}\n");
    for (index, [dx, y, z]) in points.filter(|at| at.iter().map(|c| c * c).sum::<f64>() <= 1.0).enumerate() {
        write!(text, "{},{y},{z}", x + dx).expect("text");
        match columns {
            ",id" => writeln!(text, ",{}", 5 + index).expect("text"),
            ",vx,vy,vz" => writeln!(text, ",2,0,0").expect("text"),
            _ => writeln!(text).expect("text"),
        }
    }
    fs::write(path, text).expect("written");
}

/// Distance that the ball moves per frame.
const STEP: f64 = 0.5;

/// Frames of a moving ball: `dam.N.obj` with these radii, and `p.N.csv`, from 1 on.
fn scene(radii: &[f64], columns: &str) -> TempDir {
    let folder = tempdir().expect("a folder");
    for (number, &radius) in (1u32..).zip(radii) {
        let x = STEP * f64::from(number);
        write_mesh(&folder.path().join(format!("dam.{number}.obj")), &sphere(radius, x));
        write_particles(&folder.path().join(format!("p.{number}.csv")), x, columns);
    }
    folder
}

const COMMAND: [&str; 4] = ["flicker", "dam.#.obj", "--particles", "p.#.csv"];

fn run(folder: &TempDir, more: &[&str]) -> RunResult {
    meniscus(folder.path(), &[&COMMAND[..], &["--samples", "500"], more].concat())
}

fn refused(result: &RunResult, words: &[&str]) {
    assert_eq!((result.status, &*result.out), (2, ""), "{}", result.err);
    words.iter().for_each(|word| assert!(result.err.contains(word), "{word} is not in {}", result.err));
}

/// The columns of a table, by their names.
fn column(path: &Path, name: &str) -> Vec<f64> {
    let text = fs::read_to_string(path).expect("a table");
    let mut lines = text.lines();
    let column_index =
        lines.next().expect("a head").split(',').position(|column| column == name).expect(name);
    lines
        .map(|line| line.split(',').nth(column_index).expect("a column").parse().expect("a number"))
        .collect()
}

#[test]
fn moving_ball_scores_zero_in_every_format_by_ids_and_by_velocities() {
    for (columns, more) in
        [(",id", &[][..]), (",vx,vy,vz", &["--fps", "4"]), (",vx,vy,vz", &["--dt", "0.25"])]
    {
        let folder = scene(&[1.05; 3], columns);
        let result = run(&folder, &[more, &["--csv", "scores.csv"]].concat());
        assert_eq!((result.status, &*result.err), (0, ""), "{}", result.out);
        assert!(
            result.out.contains("dam.2: flicker 0.0000 (median 0.0000, 99 % 0.0000, max 0.0000)"),
            "{}",
            result.out
        );
        let table = folder.path().join("scores.csv");
        assert_eq!([column(&table, "frame"), column(&table, "points")], [[2.0], [500.0]]);
        for name in ["max", "first", "lag_2"] {
            assert!(column(&table, name)[0] < 1e-4, "{name}: {}", result.out);
        }
    }
    let folder = scene(&[1.05; 3], ",id");
    // An archive has the same layers as the other files of USD.
    let formats = Format::ALL.into_iter().filter(|format| format.has_mesh() && *format != Format::Usdz);
    for extension in formats.flat_map(Format::extensions) {
        for number in 1..=3 {
            let mesh = sphere(1.05, STEP * f64::from(number));
            write_mesh(&folder.path().join(format!("dam.{number}.{extension}")), &mesh);
        }
        let result =
            meniscus(folder.path(), &["flicker", &format!("dam.#.{extension}"), "--particles", "p.#.csv"]);
        assert_eq!((result.status, &*result.err), (0, ""), "{extension}: {}", result.out);
        assert!(
            result.out.contains("dam.2: flicker 0.0000 (") && result.out.contains("tracked by ids"),
            "{}",
            result.out
        );
    }
}

#[test]
fn breathing_ball_scores_its_change_of_radius_with_place_and_time() {
    // The radii of frames 2 to 4 differ from those of both neighbours by 0.02, that of frame 5 differs from
    // one neighbour, and that of frame 6 from none.
    let folder = scene(&[1.05, 1.07, 1.05, 1.07, 1.05, 1.05, 1.05], ",id");
    let outputs = ["--csv", "s.csv", "--points", "p.csv", "--picture", "p.png", "--spacing", "0.1"];
    let result = run(&folder, &outputs);
    assert_eq!((result.status, &*result.err), (0, ""), "{}", result.out);
    let table = folder.path().join("s.csv");
    assert_eq!(column(&table, "frame"), [2.0, 3.0, 4.0, 5.0, 6.0]);
    let expected = [0.4, 0.4, 0.4, 0.2, 0.0];
    let first = [0.2, 0.2, 0.2, 0.0, 0.0];
    let lag_2 = [0.0, 0.0, 0.0, 0.2, 0.0];
    let same = ["rms", "median", "p99", "max"].map(|name| (name, expected));
    for (name, expected) in same.into_iter().chain([("first", first), ("lag_2", lag_2)]) {
        for (found, expected) in column(&table, name).iter().zip(expected) {
            assert!((found - expected).abs() < 0.02, "{name}: {found} instead of {expected}");
        }
    }
    let all: f64 = (expected.iter().map(|value| value * value).sum::<f64>() / 5.0).sqrt();
    let line = result.out.lines().find(|line| line.starts_with("dam.{}.obj: flicker ")).expect("a summary");
    let score: f64 = line.split(' ').nth(2).expect("a score").parse().expect("a number");
    assert!((score - all).abs() < 0.02 && line.ends_with("spacings, 5 frames"), "{line}");
    // The worst points lie on the sphere of their frame.
    let points = folder.path().join("p.csv");
    let [frames, x, y, z] = ["frame", "x", "y", "z"].map(|name| column(&points, name));
    assert_eq!(frames.len(), 1000);
    for index in 0..frames.len() {
        let radius = f64::hypot(x[index] - STEP * frames[index], f64::hypot(y[index], z[index]));
        assert!((1.03..1.071).contains(&radius), "{radius}");
    }
    let sizes: Vec<f64> = column(&points, "flicker").iter().map(|value| value.abs()).collect();
    assert!(sizes.is_sorted_by(|one, other| one >= other) && sizes[999] > 0.3, "{sizes:?}");
    assert!(fs::read(folder.path().join("p.png")).expect("a picture").starts_with(b"\x89PNG"));
    // The output on one thread is the same to the last byte.
    let files =
        || ["s.csv", "p.csv", "p.png"].map(|name| fs::read(folder.path().join(name)).expect("written"));
    let before = files();
    assert_eq!(run(&folder, &[&outputs[..], &["--threads", "1"]].concat()).out, result.out);
    assert_eq!(files(), before);
    let some = run(&folder, &["--frames", "3-4"]);
    assert!(
        some.out.contains("dam.3:") && some.out.ends_with("\n") && !some.out.contains("dam.5:"),
        "{}",
        some.out
    );
}

#[test]
fn volumes_ghosts_and_lag_are_measured() {
    let folder = scene(&[1.05, 1.07, 1.05, 1.05], ",id");
    fs::create_dir(folder.path().join("own")).expect("made");
    for number in [2, 3] {
        // The surfaces are 0.3 spacings behind these.
        let mesh = sphere(1.06, STEP * f64::from(number) + 0.3 * SPACING);
        write_mesh(&folder.path().join(format!("own/dam.{number}.obj")), &mesh);
    }
    // Frame 3 and the last frame, which has no score, have a piece without particles.
    for number in [3, 4] {
        let x = STEP * f64::from(number);
        let (mut positions, mut triangles) = sphere(1.05, x);
        let (drop, of_drop) = sphere(0.07, x + 2.0);
        let first = positions.len() as u32;
        positions.extend(drop);
        triangles.extend(of_drop.iter().map(|triangle| triangle.map(|corner| corner + first)));
        write_mesh(&folder.path().join(format!("dam.{number}.obj")), &(positions, triangles));
    }
    let result = run(&folder, &["--unaveraged", "own", "--csv", "s.csv", "--spacing", "0.1"]);
    assert_eq!((result.status, &*result.err), (0, ""), "{}", result.out);
    let table = folder.path().join("s.csv");
    let volume = |radius: f64| 4.0 / 3.0 * std::f64::consts::PI * (radius / SPACING).powi(3);
    let expected = [volume(1.07), volume(1.05)];
    for (found, expected) in column(&table, "volume").iter().zip(expected) {
        assert!((found / expected - 1.0).abs() < 0.02, "{found} instead of {expected}");
    }
    let step = (1.05_f64 / 1.07).powi(3) - 1.0;
    assert!((column(&table, "volume_step")[0] - step).abs() < 0.002, "{}", result.out);
    assert_eq!([column(&table, "pieces"), column(&table, "ghosts")], [[1.0, 2.0], [0.0, 1.0]]);
    for lag in column(&table, "lag") {
        assert!((lag - 0.2).abs() < 0.02, "{lag}");
    }
    // The largest step is the first one: from 1.05³ to 1.07³.
    let words = "2 ghosts, largest volume step 5.82 %, lag 0.2";
    assert!(result.out.contains(words), "{words} is not in {}", result.out);
    // A mesh turned inside out encloses nothing.
    let (positions, triangles) = sphere(1.05, 2.0 * STEP);
    let inward: Vec<[u32; 3]> = triangles.iter().map(|[a, b, c]| [*a, *c, *b]).collect();
    write_mesh(&folder.path().join("dam.2.obj"), &(positions, inward));
    let inside_out = run(&folder, &["--csv", "t.csv", "--spacing", "0.1", "--frames", "2"]);
    assert_eq!(inside_out.status, 0, "{}", inside_out.err);
    let table = fs::read_to_string(folder.path().join("t.csv")).expect("a table");
    assert!(!["NaN", "inf"].iter().any(|word| table.contains(word)), "{table}");
    assert!(!inside_out.out.contains("volume step"), "{}", inside_out.out);
    fs::remove_file(folder.path().join("own/dam.2.obj")).expect("removed");
    let some = run(&folder, &["--unaveraged", "own", "--spacing", "0.1"]);
    assert!(some.err.contains("--unaveraged: no mesh for frame 2"), "{}", some.err);
}

#[test]
fn missing_frames_are_skipped_and_named() {
    let folder = scene(&[1.05; 9], ",id");
    for name in ["dam.4.obj", "p.7.csv"] {
        fs::remove_file(folder.path().join(name)).expect("removed");
    }
    let result = run(&folder, &["--csv", "s.csv"]);
    assert_eq!(result.status, 0, "{}", result.err);
    assert!(
        result.err.contains("no particles for frame 7")
            && result.err.contains("frames 3, 5, 6, 8 are not scored"),
        "{}",
        result.err
    );
    assert_eq!(column(&folder.path().join("s.csv"), "frame"), [2.0]);
    // Every second frame has a mesh: the time between meshes is two frames of the particles.
    let folder = scene(&[1.05; 7], ",vx,vy,vz");
    [2, 4, 6]
        .iter()
        .for_each(|n| fs::remove_file(folder.path().join(format!("dam.{n}.obj"))).expect("removed"));
    let result = run(&folder, &["--fps", "4", "--csv", "s.csv"]);
    assert_eq!((result.status, &*result.err), (0, ""));
    assert!(result.out.contains("velocities, 0.5 s between frames"), "{}", result.out);
    assert_eq!(column(&folder.path().join("s.csv"), "frame"), [3.0, 5.0]);
    assert!(column(&folder.path().join("s.csv"), "max").iter().all(|&max| max < 1e-4), "{}", result.out);
}

#[test]
fn unreadable_frame_affects_only_its_neighbours() {
    let folder = scene(&[1.05; 7], ",id");
    fs::write(folder.path().join("dam.2.obj"), "v 0 0 0\nf 1 2 3\n").expect("written");
    let result = run(&folder, &["--csv", "s.csv"]);
    assert_eq!(result.status, 1, "{}", result.err);
    assert!(result.err.contains("error: dam.2.obj: OBJ, at line 2"), "{}", result.err);
    assert_eq!(column(&folder.path().join("s.csv"), "frame"), [4.0, 5.0, 6.0]);
    // In a frame without a surface, all points are lost.
    fs::write(folder.path().join("dam.2.obj"), "v 0 0 0\n").expect("written");
    let result = run(&folder, &["--csv", "s.csv"]);
    assert_eq!(result.status, 0, "{}", result.err);
    assert!(result.err.contains("dam.2: the mesh is empty"), "{}", result.err);
    assert_eq!(column(&folder.path().join("s.csv"), "clamped"), [500.0, 0.0, 0.0, 0.0]);
    assert!((column(&folder.path().join("s.csv"), "max")[0] - 2.0).abs() < 1e-4, "{}", result.out);
}

#[test]
fn open_meshes_and_meshes_elsewhere_are_warned_about() {
    let folder = scene(&[1.05; 3], ",id");
    for number in 1..=3 {
        let (positions, mut triangles) = sphere(1.05, STEP * f64::from(number));
        triangles.truncate(triangles.len() / 2);
        write_mesh(&folder.path().join(format!("dam.{number}.obj")), &(positions, triangles));
    }
    let result = run(&folder, &[]);
    assert_eq!(result.status, 0, "{}", result.err);
    assert!(
        result.err.contains("dam.1.obj: the mesh has 48 open edges") && result.err.lines().count() == 1,
        "{}",
        result.err
    );
    assert!(result.out.contains("dam.2: flicker 0.0000 ("), "{}", result.out);
    for number in 1..=3 {
        write_mesh(&folder.path().join(format!("dam.{number}.obj")), &sphere(1.05, 30.0));
    }
    let result = run(&folder, &[]);
    assert_eq!(result.status, 2, "{}", result.out);
    assert!(
        result.err.contains("500 of 500 points") && result.err.contains("same unit and the same axes"),
        "{}",
        result.err
    );
}

#[test]
fn inputs_without_a_score_are_refused_with_a_remedy() {
    let folder = scene(&[1.05; 2], ",id");
    refused(&run(&folder, &[]), &["2 frames have both a mesh and particles", "three frames are needed"]);
    let folder = scene(&[1.05; 6], "");
    refused(&run(&folder, &[]), &["neither velocities nor unique ids"]);
    [1, 3, 4]
        .iter()
        .for_each(|n| fs::remove_file(folder.path().join(format!("p.{n}.csv"))).expect("removed"));
    refused(&run(&folder, &[]), &["no three frames follow each other: frames 2, 5, 6 have both"]);
    let folder = scene(&[1.05; 3], ",vx,vy,vz");
    refused(&run(&folder, &[]), &["velocities and no ids", "--fps or --dt"]);
    for (option, value, word) in [
        ("--dt", "0", "`0` is not a positive number"),
        ("--dt", "-1", "`-1` is not a positive number"),
        ("--fps", "0", "frames per second"),
        ("--fps", "-25", "frames per second"),
        ("--spacing", "inf", "`inf` is not a positive number"),
        ("--picture", "p.jpg", "ends with .png"),
        ("--picture", "p.PNG", "must be lower case: use p.png"),
        ("--csv", "there/s.csv", "there: the folder for --csv does not exist"),
        ("--points", "p.1.csv", "would replace the input p.1.csv"),
        ("--frames", "7", "--frames selects none"),
    ] {
        refused(&run(&folder, &[option, value]), &[word]);
    }
    refused(&run(&folder, &["--fps", "4", "--dt", "0.25"]), &["cannot be used with"]);
    refused(&run(&folder, &["--fps", "4", "--csv", "a", "--points", "a"]), &["names the same file"]);
    fs::create_dir(folder.path().join("empty")).expect("made");
    refused(
        &meniscus(folder.path(), &["flicker", "empty", "--particles", "p.#.csv"]),
        &["empty: this folder contains no meshes"],
    );
    refused(
        &meniscus(folder.path(), &["flicker", "*.obj", "--particles", "q.#.csv"]),
        &["q.#.csv: no file matches"],
    );
    write_obj(&folder.path().join("other.1.obj"), &sphere(1.0, 0.0));
    refused(
        &meniscus(folder.path(), &["flicker", "*.obj", "--particles", "p.#.csv"]),
        &["the meshes must be of one sequence, and there are 2 sequences"],
    );
    let names = ["flicker", "dam.1.obj", "--particles", "lone.ply"];
    write_ply(&folder.path().join("lone.ply"), &[[0.0; 3]]);
    refused(&meniscus(folder.path(), &names), &["lone.ply: the name has no frame number"]);
    // These frames have too few particles to measure their spacing.
    (1..=3).for_each(|n| write_ply(&folder.path().join(format!("few.{n}.ply")), &[[f64::from(n); 3]]));
    let few = ["flicker", "dam.#.obj", "--particles", "few.#.ply"];
    refused(&meniscus(folder.path(), &few), &["no frame has two particles in different places", "--spacing"]);
}

#[test]
fn folder_is_scored_by_its_meshes_of_one_format() {
    let folder = scene(&[1.05, 1.07, 1.05], ",id");
    let by_name = run(&folder, &[]);
    fs::create_dir(folder.path().join("in")).expect("made");
    for number in 1..=3 {
        let name = format!("dam.{number}.obj");
        fs::rename(folder.path().join(&name), folder.path().join("in").join(&name)).expect("moved");
        // These meshes do not move.
        write_mesh(&folder.path().join(format!("in/dam.{number}.stl")), &sphere(1.05, 0.0));
    }
    fs::write(folder.path().join("in/notes.txt"), "not a mesh").expect("written");
    let by_folder = meniscus(folder.path(), &["flicker", "in", "--particles", "p.#.csv", "--samples", "500"]);
    assert_eq!((by_folder.status, &*by_folder.err), (0, ""));
    assert_eq!(by_folder.out, by_name.out);
}

#[test]
fn spacing_is_that_of_convert_if_some_frames_have_no_mesh() {
    let folder = scene(&[1.05; 3], ",id");
    // Frames 4 to 7 have no mesh, and their particles are twice as far apart.
    let coarse: String = (0..216u32)
        .map(|index| [index % 6, index / 6 % 6, index / 36].map(|along| 2.0 * SPACING * f64::from(along)))
        .map(|[x, y, z]| format!("{x},{y},{z}\n"))
        .collect();
    for number in 4..=7 {
        let path = folder.path().join(format!("p.{number}.csv"));
        fs::write(path, format!("x,y,z\n{coarse}")).expect("written");
    }
    let convert = ["convert", "p.#.csv", "--frames", "1", "--out", "o", "--format", "obj"];
    let converted = meniscus(folder.path(), &convert);
    assert!(converted.out.contains("spacing 0.2 (measured on 3 frames)"), "{}", converted.out);
    let scored = run(&folder, &[]);
    assert_eq!(scored.status, 0, "{}", scored.err);
    assert!(scored.out.contains("spacing 0.2; points are tracked by ids"), "{}", scored.out);
    refused(&run(&folder, &["--points", "p.7.csv"]), &["would replace the input p.7.csv"]);
}

/// Real sequences: surfaces of this program flicker by a small part of a spacing.
#[test]
fn sequences_of_simulators_have_plausible_scores() {
    let Some(shared) = crate::program::shared::data() else { return };
    for name in ["dam_break_bgeo/ParticleData_Fluid_#.bgeo", "splash_ply/*.ply"] {
        let folder = tempdir().expect("a folder");
        let particles = shared.join("ours/sequences").join(name).display().to_string();
        let convert =
            ["convert", &particles, "--out", "s", "--format", "ply", "--frames", "9-12", "--preset", "auto"];
        let made = meniscus(folder.path(), &convert);
        assert_eq!(made.status, 0, "{}", made.err);
        let result = meniscus(folder.path(), &["flicker", "s/*.ply", "--particles", &particles]);
        assert_eq!(result.status, 0, "{}{}", result.out, result.err);
        assert!(result.out.contains("tracked by ids"), "{}", result.out);
        let line = result.out.lines().find(|line| line.ends_with("spacings, 2 frames")).expect("a summary");
        let score = line.split("flicker ").nth(1).and_then(|rest| rest.split(' ').next()).expect("a score");
        let score: f64 = score.parse().expect("a number");
        assert!((0.01..0.3).contains(&score), "{line}");
    }
}

/// Particles that tremble at the surface carry its points, unless they are points beside the mesh.
#[test]
fn points_beside_a_mesh_carry_no_points() {
    let folder = scene(&[1.05; 3], ",id");
    for number in 1..=3i32 {
        let path = folder.path().join(format!("p.{number}.csv"));
        let (mut text, mut beside) =
            (fs::read_to_string(&path).expect("text"), "x,y,z,spray_class,id\n".to_owned());
        for index in 0..40 {
            let angle = f64::from(index) * 0.4;
            let x = STEP * f64::from(number) + if number == 2 { 0.3 } else { -0.3 };
            let [y, z] = [1.1 * angle.cos(), 1.1 * angle.sin()];
            writeln!(text, "{x},{y},{z},{}", 100_000 + index).expect("text");
            writeln!(beside, "{x} {y} {z} 0 {}", 100_000 + index).expect("text");
        }
        fs::write(path, text).expect("written");
        let head = "ply\nformat ascii 1.0\ncomment meniscus 0.1.0\ncomment meniscus_contents: spray\nelement vertex 40\nproperty double x\nproperty double y\nproperty double z\n\
                    property int spray_class\nproperty int id\nend_header\n";
        let rows = beside.split_once('\n').expect("rows").1;
        fs::write(folder.path().join(format!("spray.{number}")), format!("{head}{rows}")).expect("written");
    }
    let score = || {
        let result = run(&folder, &["--csv", "scores.csv"]);
        assert_eq!(result.status, 0, "{}{}", result.out, result.err);
        column(&folder.path().join("scores.csv"), "max")[0]
    };
    assert!(score() > 0.05);
    for number in 1..=3 {
        let [from, to] = [format!("spray.{number}"), format!("dam.{number}.spray.ply")];
        fs::rename(folder.path().join(from), folder.path().join(to)).expect("renamed");
    }
    assert!(score() < 1e-4);
}
