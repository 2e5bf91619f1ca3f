//! Compares the measured spacing of particles with known values: the constant of a lattice, the cube root of
//! the volume per random particle, and twice the radius of the particles of a simulation.

use std::f64::consts::PI;
use std::fs;
use std::path::{Path, PathBuf};

use glam::DVec3;
use meniscus::pipeline::particles;
use meniscus::surface::particles::OwnedPositions;
use meniscus::surface::spacing::{SpacingEstimate, combine_estimates, estimate_spacing};
use meniscus_formats::{Limits, read_particles};
use serde_json::Value;
use tempfile::tempdir;

use crate::program::scene::{RunResult, block, irregular, meniscus, write_ply, write_sequence};

/// A generator of pseudo-random numbers from 0 to 1, the same on every machine.
struct Random(u64);

impl Random {
    fn next(&mut self) -> f64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mixed = (self.0 ^ self.0 >> 30).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        let mixed = (mixed ^ mixed >> 27).wrapping_mul(0x94d0_49bb_1331_11eb);
        ((mixed ^ mixed >> 31) >> 11) as f64 / (1u64 << 53) as f64
    }

    fn point(&mut self) -> DVec3 {
        DVec3::new(self.next(), self.next(), self.next())
    }

    fn points(&mut self, count: usize) -> Vec<DVec3> {
        (0..count).map(|_| self.point()).collect()
    }
}

fn lattice([x, y, z]: [usize; 3]) -> Vec<DVec3> {
    let position =
        |index: usize| DVec3::new((index % x) as f64, (index / x % y) as f64, (index / x / y) as f64);
    (0..x * y * z).map(position).collect()
}

/// Moves each point by up to this much on each axis.
fn jittered(mut points: Vec<DVec3>, by: f64) -> Vec<DVec3> {
    let mut random = Random(7);
    points.iter_mut().for_each(|point| *point += by * (2.0 * random.point() - 1.0));
    points
}

fn ball(radius: f64) -> Vec<DVec3> {
    let edge_count = 2 * (radius.ceil() as usize + 1);
    let middle = DVec3::splat(0.5 * (edge_count as f64 - 1.0));
    let mut points = lattice([edge_count; 3]);
    points.retain(|point| point.distance(middle) < radius);
    points
}

/// A disc with this number of layers.
fn tap(radius: f64, layer_count: usize) -> Vec<DVec3> {
    let edge_count = 2 * radius.ceil() as usize + 1;
    let middle = DVec3::new(radius.ceil(), radius.ceil(), 0.0);
    let mut points = lattice([edge_count, edge_count, layer_count]);
    points.retain(|point| (point - middle).truncate().length() <= radius);
    points
}

/// The points, and additional random points around them, in a cube with this edge length.
fn with_spray(mut points: Vec<DVec3>, count: usize, edge: f64) -> Vec<DVec3> {
    let greatest = points.iter().copied().fold(DVec3::ZERO, DVec3::max);
    let mut random = Random(11);
    let aside = (0..).map(|_| (random.point() - 0.5) * edge + 0.5 * greatest);
    let aside =
        aside.filter(|point| point.cmplt(DVec3::splat(-1.0)).any() || point.cmpgt(greatest + 1.0).any());
    points.extend(aside.take(count));
    points
}

/// Close-packed spheres of diameter 1.
fn close_packed(edge_count: usize) -> Vec<DVec3> {
    let position = |point: DVec3| {
        let (odd_row, odd_layer) = (point.y % 2.0, point.z % 2.0);
        DVec3::new(
            point.x + 0.5 * (odd_row - odd_layer).abs(),
            0.75f64.sqrt() * (point.y + odd_layer / 3.0),
            (2.0f64 / 3.0).sqrt() * point.z,
        )
    };
    lattice([edge_count; 3]).into_iter().map(position).collect()
}

fn cube_root_of_share(volume: f64, count: usize) -> f64 {
    (volume / count as f64).cbrt()
}

/// One test: its name, the true spacing, and the particles.
type Set = (String, f64, Vec<DVec3>);

/// Sets whose estimated spacing is within 5 % of the true one.
fn near() -> Vec<Set> {
    [lattices(), at_random(), bodies(), mixed()].concat()
}

/// Lattices and jittered lattices of all shapes.
fn lattices() -> Vec<Set> {
    let mut sets: Vec<Set> = Vec::new();
    let mut add = |name: &str, truth: f64, points: Vec<DVec3>| sets.push((name.to_owned(), truth, points));
    for size in [
        [2, 1, 1],
        [2, 2, 1],
        [5, 2, 1],
        [2, 2, 2],
        [3, 2, 2],
        [3, 3, 3],
        [4, 4, 4],
        [8, 8, 8],
        [30, 30, 30],
        [10, 1, 1],
        [100, 1, 1],
        [10, 10, 1],
        [50, 50, 1],
        [30, 30, 2],
        [30, 30, 3],
        [30, 2, 2],
        [50, 4, 4],
    ] {
        add(&format!("lattice {size:?}"), 1.0, lattice(size));
    }
    let rotated = |points: Vec<DVec3>| {
        let rotation = glam::DQuat::from_euler(glam::EulerRot::XYZ, 0.3, 0.7, 1.1);
        points.into_iter().map(|point| rotation * point).collect::<Vec<_>>()
    };
    for size in
        [[4, 4, 4], [8, 8, 8], [20, 20, 20], [10, 10, 1], [50, 50, 1], [30, 30, 2], [30, 3, 3], [200, 1, 1]]
    {
        add(&format!("jittered {size:?}"), 1.0, rotated(jittered(lattice(size), 0.25)));
    }
    sets
}

/// Random particles in volumes and sheets.
fn at_random() -> Vec<Set> {
    let mut sets: Vec<Set> = Vec::new();
    let mut add = |name: &str, truth: f64, points: Vec<DVec3>| sets.push((name.to_owned(), truth, points));
    for count in [300, 1000, 40_000] {
        add(&format!("random {count}"), cube_root_of_share(1.0, count), Random(3).points(count));
    }
    add("stratified", 1.0, jittered(lattice([20; 3]), 0.5));
    let mut random = Random(5);
    let cells = lattice([10; 3]).into_iter().flat_map(|cell| [cell; 8]);
    add("8 at random in each cell", 0.5, cells.map(|cell| cell + random.point()).collect());
    let sheet = Random(13).points(5000).into_iter().map(|point| DVec3::new(point.x, point.y, 0.3));
    add("random sheet", (1.0f64 / 5000.0).sqrt(), sheet.collect());
    let mut jet = Random(17).points(4000);
    jet.retain(|point| (point.truncate() - 0.5).length() < 0.5);
    let volume = 0.25 * PI * 8.0;
    add(
        "random jet",
        cube_root_of_share(volume, jet.len()),
        jet.iter().map(|&p| p * DVec3::new(1.0, 1.0, 8.0)).collect(),
    );
    sets
}

/// Close-packed particles, balls and jets.
fn bodies() -> Vec<Set> {
    let mut sets: Vec<Set> = Vec::new();
    let mut add = |name: &str, truth: f64, points: Vec<DVec3>| sets.push((name.to_owned(), truth, points));
    for edge_count in [4, 8, 16] {
        add(&format!("close-packed {edge_count}³"), 0.5f64.sqrt().cbrt(), close_packed(edge_count));
    }
    let mut hexagonal = close_packed(30);
    hexagonal.retain(|point| point.z == 0.0);
    add("hexagonal sheet", 0.75f64.sqrt().sqrt(), hexagonal);
    for radius in [1.2, 1.8, 3.0, 6.0, 12.0] {
        add(&format!("ball {radius}"), 1.0, ball(radius));
    }
    for radius in [1.0, 1.5, 2.3, 4.0] {
        for layer_count in [1, 2, 5, 60] {
            add(&format!("tap {radius}, {layer_count} layers"), 1.0, tap(radius, layer_count));
        }
    }
    add("jittered tap", 1.0, jittered(tap(2.3, 60), 0.25));
    sets
}

/// Spray next to bodies, and bodies of uneven density.
fn mixed() -> Vec<Set> {
    let mut sets: Vec<Set> = Vec::new();
    let mut add = |name: &str, truth: f64, points: Vec<DVec3>| sets.push((name.to_owned(), truth, points));
    for (share, by) in [(0.1, 0.0), (0.3, 0.25), (0.8, 0.0), (1.0, 0.25)] {
        let body = jittered(lattice([12; 3]), by);
        let count = (share * body.len() as f64) as usize;
        add(&format!("spray {share} of a body"), 1.0, with_spray(body, count, 60.0));
    }
    add("spray around a sheet", 1.0, with_spray(lattice([20, 20, 1]), 80, 60.0));
    add("spray around a thread", 1.0, with_spray(lattice([100, 1, 1]), 20, 60.0));
    let moved = |points: Vec<DVec3>, scale: f64| {
        points.into_iter().map(move |p| scale * p + DVec3::new(50.0, 0.0, 0.0))
    };
    let fine_and_coarse = lattice([20; 3]).into_iter().chain(moved(lattice([10; 3]), 2.0));
    add("8000 and 1000 twice as far apart", 1.0, fine_and_coarse.collect());
    let body_sheet_thread = lattice([15; 3]).into_iter().chain(moved(lattice([60, 60, 1]), 1.0));
    add(
        "body, sheet and thread",
        1.0,
        body_sheet_thread.chain(lattice([1, 1, 300]).into_iter().map(|p| p - 20.0)).collect(),
    );
    let mut uneven = Random(19).points(20_000);
    let mut random = Random(23);
    uneven.retain(|point| random.next() < 0.5 + 0.5 * point.z);
    add("random, twice as dense above", cube_root_of_share(1.0, uneven.len()), uneven);
    let pressed = lattice([20; 3]).into_iter().map(|point| point * DVec3::new(1.0, 1.0, 0.9));
    add("pressed by a tenth", 1.0, pressed.collect());
    sets
}

/// Sets whose estimated spacing is within 10 % of the true one.
fn farther() -> Vec<Set> {
    let mut sets: Vec<Set> = Vec::new();
    // With this few points, the distances depend on chance.
    sets.push(("8 jittered".into(), 1.0, jittered(lattice([2; 3]), 0.25)));
    sets.push(("27 jittered".into(), 1.0, jittered(lattice([3; 3]), 0.25)));
    for count in [50, 100] {
        sets.push((format!("random {count}"), cube_root_of_share(1.0, count), Random(29).points(count)));
    }
    // If points are random in only one direction, a few large gaps make up most of the length.
    let line = Random(31).points(5000).into_iter().map(|point| DVec3::new(point.x, 0.1, 0.3));
    sets.push(("random line".into(), 1.0 / 5000.0, line.collect()));
    // A round shell on a cubic lattice has steps.
    let mut shell = ball(20.5);
    let middle = shell.iter().sum::<DVec3>() / shell.len() as f64;
    shell.retain(|point| point.distance(middle) > 19.5);
    sets.push(("shell".into(), 1.0, shell));
    sets
}

fn estimate(points: &[DVec3]) -> Option<SpacingEstimate> {
    estimate_spacing(OwnedPositions::F64(points.iter().map(DVec3::to_array).collect()))
}

/// The sets whose estimated spacing has a relative error above `tolerance`, with the estimates.
fn wrong(sets: Vec<Set>, tolerance: f64) -> Vec<String> {
    let ratios = sets.into_iter().map(|(name, truth, points)| {
        let found = estimate(&points).unwrap_or_else(|| panic!("{name}: nothing was measured"));
        (name, found.spacing / truth)
    });
    let is_wrong = |(_, ratio): &(String, f64)| (ratio - 1.0).abs() > tolerance;
    ratios.filter(is_wrong).map(|(name, ratio)| format!("{name}: {ratio:.3}")).collect()
}

#[test]
fn spacing_is_found_to_a_twentieth() {
    let wrong = wrong(near(), 0.05);
    assert!(wrong.is_empty(), "{wrong:#?}");
}

#[test]
fn spacing_of_difficult_sets_is_found_to_a_tenth() {
    let wrong = wrong(farther(), 0.1);
    assert!(wrong.is_empty(), "{wrong:#?}");
}

/// For ten random particles the estimate depends on chance. It is close on average, and its confidence is
/// low.
#[test]
fn few_random_particles_have_little_confidence() {
    let found: Vec<SpacingEstimate> =
        (0..200).filter_map(|seed| estimate(&Random(1000 * seed).points(10))).collect();
    let mean = |of: fn(&SpacingEstimate) -> f64| found.iter().map(of).sum::<f64>() / found.len() as f64;
    let ratio = mean(|estimate| estimate.spacing) / cube_root_of_share(1.0, 10);
    assert!((0.8..1.1).contains(&ratio), "{ratio}");
    assert!(mean(|estimate| estimate.confidence) < 0.5, "{}", mean(|estimate| estimate.confidence));
}

/// A folder of the data next to the sources, if it exists.
fn shared(folder: &str) -> Option<PathBuf> {
    let default_folder = || Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared");
    let data = std::env::var_os("MENISCUS_SHARED")
        .map_or_else(default_folder, PathBuf::from)
        .join("data")
        .join(folder);
    data.is_dir().then_some(data)
}

fn estimate_of(file: &Path) -> SpacingEstimate {
    let name = file.file_name().expect("a name").to_string_lossy();
    let frame = read_particles(&std::fs::read(file).expect("readable"), &name, &Limits::default())
        .expect("particles");
    estimate_spacing(particles(frame.positions)).expect("enough particles")
}

#[test]
fn fluids_of_simulators_have_twice_the_radius_of_their_particles() {
    let Some(data) = shared("third-party/splashsurf") else { return };
    for name in [
        "dam_break_frame_9_6859_particles.bgeo",
        "dam_break_frame_23_24389_particles.bgeo",
        "double_dam_break_frame_26_4732_particles.vtk",
        "hilbert_46843_particles.bgeo",
        "cube_2366_particles.vtk",
    ] {
        let ratio = estimate_of(&data.join(name)).spacing / 0.05;
        assert!((0.95..1.05).contains(&ratio), "{name}: {ratio}");
    }
}

#[test]
fn frames_of_a_dam_break_agree() {
    let Some(data) = shared("ours/sequences/dam_break_bgeo") else { return };
    let frame = |number: usize| estimate_of(&data.join(format!("ParticleData_Fluid_{number}.bgeo")));
    let sequence = combine_estimates(&[1, 31, 61].map(frame)).expect("frames");
    assert!((0.95..1.05).contains(&(sequence.spacing / 0.05)), "{sequence:?}");
    assert!(!sequence.frames_disagree() && sequence.confidence > 0.7, "{sequence:?}");
    // During the strongest splashing, single frames differ more.
    for number in (1..=61).step_by(4) {
        let ratio = frame(number).spacing / 0.05;
        assert!((0.9..1.1).contains(&ratio), "frame {number}: {ratio}");
    }
}

/// Frames with particles at this spacing, for `convert`.
fn write_frames(folder: &Path, spacings: &[f64]) {
    for (index, spacing) in spacings.iter().enumerate() {
        let points: Vec<[f64; 3]> =
            block(6, 0.0).iter().map(|point| point.map(|x| 10.0 * spacing * x)).collect();
        write_ply(&folder.join(format!("dam.{}.ply", index + 1)), &points);
    }
}

#[test]
fn sequence_is_measured_on_its_first_middle_and_last_frame() {
    let folder = tempdir().expect("a folder");
    let path = folder.path();
    // 0.0498 is rounded to two digits: 0.05.
    write_frames(path, &[0.0498, 0.2, 0.0502, 0.3, 0.0498]);
    let arguments = [
        "convert",
        "dam.#.ply",
        "--frames",
        "1",
        "--out",
        "out",
        "--format",
        "obj",
        "--report",
        "report.json",
    ];
    let result = meniscus(path, &arguments);
    assert_eq!((result.status, &*result.err), (0, ""), "{}", result.out);
    assert!(result.out.contains("spacing 0.05 (measured on 3 frames)"), "{}", result.out);
    let report: Value =
        serde_json::from_str(&std::fs::read_to_string(path.join("report.json")).expect("there"))
            .expect("JSON");
    let settings = &report["settings"][0];
    assert_eq!((&settings["spacing"], &settings["voxel_size"]), (&0.05.into(), &0.016.into()));
    assert!(settings["measured_on"].as_str().is_some_and(|path| path.ends_with("dam.1.ply")));
    assert!(settings["spacing_confidence"].as_f64().is_some_and(|confidence| confidence > 0.9), "{settings}");
}

#[test]
fn frames_of_different_spacing_cause_a_warning() {
    let folder = tempdir().expect("a folder");
    let path = folder.path();
    write_frames(path, &[0.05, 0.08, 0.05]);
    let result = meniscus(path, &["convert", "dam.#.ply", "--out", "out", "--format", "obj"]);
    let expected =
        "warning: dam.{}.ply: particles are 0.05 apart in dam.1.ply but 0.08 in dam.2.ply: give --spacing";
    assert!(result.err.contains(expected), "{}", result.err);
    assert_eq!(result.status, 0);
}

#[test]
fn frames_that_cannot_be_measured_are_replaced_by_their_neighbours() {
    let folder = tempdir().expect("a folder");
    let path = folder.path();
    write_frames(path, &[0.3, 0.05, 0.3, 0.05, 0.3, 0.05, 0.3]);
    write_ply(&path.join("dam.1.ply"), &[[0.0; 3]]);
    std::fs::write(path.join("dam.7.ply"), "ply\nformat nonsense 1.0\n").expect("written");
    write_ply(&path.join("dam.4.ply"), &[]);
    // The spacing is measured on frames 2, 3 and 6.
    let result =
        meniscus(path, &["convert", "dam.#.ply", "--frames", "2", "--out", "out", "--format", "obj"]);
    assert!(result.out.contains("spacing 0.05 (measured on 3 frames)"), "{}", result.out);
    assert!(result.err.contains("0.05 apart in dam.2.ply but 0.3 in dam.3.ply"), "{}", result.err);
}

#[test]
fn one_particle_alone_has_no_spacing() {
    let folder = tempdir().expect("a folder");
    let path = folder.path();
    write_ply(&path.join("one.ply"), &[[0.5; 3]]);
    let result = meniscus(path, &["convert", "one.ply", "--out", "out"]);
    assert_ne!(result.status, 0);
    assert!(result.err.contains("one.ply: cannot measure the particle spacing, because no frame has two particles in different places"), "{}", result.err);
    assert!(result.err.contains("--spacing"), "{}", result.err);
    write_ply(&path.join("none.ply"), &[]);
    let result = meniscus(path, &["convert", "none.ply", "--out", "out"]);
    assert_ne!(result.status, 0);
    let expected = "cannot measure the particle spacing, because there are no particles: give --spacing";
    assert!(result.err.contains(expected), "{}", result.err);
    // Two particles are enough, with a stated confidence.
    write_ply(&path.join("two.ply"), &[[0.5; 3], [0.5, 0.6, 0.5]]);
    let result = meniscus(path, &["convert", "two.ply", "--out", "out", "--format", "obj"]);
    assert_eq!(result.status, 0, "{}", result.err);
    assert!(result.err.contains("about 0.1 apart, which is uncertain"), "{}", result.err);
    let result = meniscus(path, &["info", "two.ply"]);
    assert!(result.out.contains("0.1, confidence 29 %"), "{}", result.out);
}

#[test]
fn unmeasurable_spacing_is_an_error_that_names_the_option() {
    let folder = tempdir().expect("a folder");
    write_ply(&folder.path().join("one.ply"), &block(1, 0.0));
    write_ply(&folder.path().join("none.ply"), &[]);
    for name in ["one.ply", "none.ply"] {
        let result = meniscus(folder.path(), &["convert", name, "--out", "o"]);
        assert_eq!(result.status, 2, "{}", result.err);
        assert!(result.err.contains(name) && result.err.contains("--spacing"), "{}", result.err);
    }
}

/// Spray: the particles are far apart, and have their own radii.
#[test]
fn spacing_follows_the_particles_own_radii() {
    let folder = tempdir().expect("a folder");
    let path = folder.path();
    let rows: String = (0..6).map(|n| format!("{n},0,0,{}\n", 0.1 + 0.04 * f64::from(n))).collect();
    fs::write(path.join("six.csv"), format!("x,y,z,pscale\n{rows}")).expect("written");
    for more in [&["--voxel-size=0.02", "--max-stretch=1.5"][..], &[]] {
        let typed = ["convert", "six.csv", "--out=o", "--format=obj", "--radius-attribute=pscale"];
        let result = meniscus(path, &[&typed, more].concat());
        assert_eq!(result.status, 0, "{}", result.err);
        assert!(!result.err.contains("outside the surface"), "{}", result.err);
        assert!(!result.err.contains("imply a spacing"), "{}", result.err);
        assert!(result.out.contains("spacing 0.36,"), "{}", result.out);
    }
    // Without the option, the positions decide, and the warning names the file once.
    let result = meniscus(path, &["convert", "six.csv", "--out=o", "--format=obj"]);
    assert!(result.err.contains("warning: six.csv: the radii in `pscale` imply a spacing"), "{}", result.err);
}

/// On a fine grid, a small lone ball keeps its radius as well as a large one.
#[test]
fn balls_of_all_sizes_keep_their_own_radii() {
    let folder = tempdir().expect("a folder");
    let path = folder.path();
    let balls = [(0.0, 0.02), (2.0, 0.1), (4.0, 0.1), (6.0, 0.1)];
    let rows: String = balls.iter().map(|(x, radius)| format!("{x},0,0,{radius}\n")).collect();
    fs::write(path.join("balls.csv"), format!("x,y,z,radius\n{rows}")).expect("written");
    let typed = ["convert", "balls.csv", "--out=o", "--format=obj", "--radius-attribute=radius"];
    let result = meniscus(path, &[&typed[..], &["--voxel-size=0.006"]].concat());
    assert_eq!(result.status, 0, "{}", result.err);
    let text = fs::read_to_string(path.join("o/balls.obj")).expect("readable");
    let numbers =
        |line: &str| line.split(' ').map(|word| word.parse().expect("a number")).collect::<Vec<f64>>();
    let vertices: Vec<DVec3> =
        text.lines().filter_map(|line| Some(DVec3::from_slice(&numbers(line.strip_prefix("v ")?)))).collect();
    for (x, radius) in balls {
        let distances = vertices.iter().map(|vertex| vertex.distance(DVec3::new(x, 0.0, 0.0)));
        let of_ball: Vec<f64> = distances.filter(|distance| *distance < 1.0).collect();
        let ratio = of_ball.iter().sum::<f64>() / of_ball.len() as f64 / radius;
        assert!((0.92..1.02).contains(&ratio), "a ball of {radius} became {ratio} of it");
    }
}

#[test]
fn positions_rounded_far_from_the_origin_and_planar_frames_cause_warnings() {
    let folder = tempdir().expect("a folder");
    let path = folder.path();
    let far =
        block(6, 0.0).into_iter().map(|[x, y, z]| [x + 694_386.5, y + 5_155_487.0, z]).collect::<Vec<_>>();
    write_ply(&path.join("far.ply"), &far);
    let rounded =
        "far.ply: positions are rounded to steps of 0.5, as 32-bit numbers so far from the origin are";
    for more in [&["--spacing=0.1"][..], &[]] {
        let result = meniscus(path, &[&["convert", "far.ply", "--out=o", "--format=obj"], more].concat());
        assert_eq!(result.status, 0, "{}", result.err);
        assert!(result.err.contains(rounded), "{}", result.err);
    }
    let flat: Vec<[f64; 3]> = block(6, 0.0).into_iter().filter(|[_, y, _]| *y == 0.0).collect();
    for (name, particles, is_planar) in [("flat.ply", &flat, true), ("block.ply", &block(6, 0.0), false)] {
        write_ply(&path.join(name), particles);
        let result = meniscus(path, &["convert", name, "--out=o", "--format=obj"]);
        assert_eq!(result.status, 0, "{}", result.err);
        assert_eq!(result.err.contains("all particles have y = 0: "), is_planar, "{}", result.err);
    }
}

#[test]
fn unmeasurable_spacing_of_unusable_particles_is_explained() {
    let folder = tempdir().expect("a folder");
    let path = folder.path();
    // With a given spacing, the surface would be empty.
    write_ply(&path.join("nan.ply"), &[[f64::NAN; 3]; 64]);
    fs::write(path.join("nan.csv"), "x,y,z\nnan,0,0\n0,inf,0\n").expect("written");
    for (name, words) in [
        ("nan.ply", "nan.ply: PLY: none of the 64 particles has a finite position"),
        ("nan.csv", "nan.csv: delimited text: none of the 2 rows has a finite position"),
    ] {
        for given in [&[][..], &["--spacing=0.1"]] {
            let result = meniscus(path, &[&["convert", name, "--out", "o"], given].concat());
            assert!(result.status == 2 && result.err.contains(words), "{}", result.err);
            assert!(!result.err.contains("--spacing"), "{}", result.err);
        }
    }
    // Among others, it is one failed frame.
    write_sequence(path, 1, 2);
    fs::copy(path.join("nan.ply"), path.join("dam.3.ply")).expect("copied");
    let result = meniscus(path, &["convert", "dam.#.ply", "--out", "o"]);
    assert!(result.status == 1 && result.err.contains("dam.3.ply: PLY: none of the"), "{}", result.err);
    write_sequence(path, 1, 3);
    let result = meniscus(path, &["convert", "dam.#.ply", "--out", "o", "--radius-attribute", "pscale"]);
    assert!(result.err.contains("`pscale`") && result.err.contains("; the same applies to all 3 frames"));
    assert!(!result.err.contains("can be read"), "{}", result.err);
}

// The preset that suits the particles, by their irregularity.

/// Options that make a surface quickly, but let presets differ.
const COARSE: [&str; 4] = ["--voxel-size", "0.8d", "--format", "obj"];

fn write_irregular(folder: &Path, count: u64) {
    for number in 1..=count {
        write_ply(&folder.join(format!("wild.{number}.ply")), &irregular(number));
    }
}

/// Converts with these options in addition to [`COARSE`], into `out`.
fn converted(folder: &Path, input: &str, out: &str, options: &[&str]) -> RunResult {
    let result = meniscus(folder, &[&["convert", input, "--out", out], &COARSE[..], options].concat());
    assert_eq!(result.status, 0, "{options:?}: {} {}", result.out, result.err);
    result
}

#[test]
fn auto_gives_the_bytes_of_the_suitable_preset() {
    let folder = tempdir().expect("a folder");
    let path = folder.path();
    write_irregular(path, 3);
    for number in 1..=3 {
        write_ply(&path.join(format!("dam.{number}.ply")), &block(10, 0.02 * f64::from(number)));
    }
    // The middle frame of three decides: one even frame changes nothing.
    write_ply(&path.join("wild.1.ply"), &block(10, 0.0));
    for (input, suitable, others) in [("wild.#.ply", "noisy", "fluid"), ("dam.#.ply", "fluid", "noisy")] {
        for spacing in [&[][..], &["--spacing", "0.098"]] {
            let with = |out: &str, preset: &str| {
                let options = [&["--preset", preset, "--report", "r.json"], spacing].concat();
                let result = converted(path, input, out, &options);
                let name = input.replace('#', "2").replace("ply", "obj");
                (result, fs::read(path.join(out).join(name)).expect("there"))
            };
            let (_, expected) = with("a", suitable);
            let (_, other) = with("b", others);
            let (result, bytes) = with("c", "auto");
            assert!(bytes == expected && bytes != other, "{input} {spacing:?}");
            assert!(result.out.contains(&format!(", preset {suitable}, voxel size ")), "{}", result.out);
            assert_eq!(result.err, "");
            let report: Value =
                serde_json::from_slice(&fs::read(path.join("r.json")).expect("there")).expect("JSON");
            let settings = &report["settings"][0];
            assert_eq!((&settings["preset"], &settings["preset_given"]), (&suitable.into(), &"auto".into()));
            let irregularity = settings["irregularity"].as_f64();
            assert!(irregularity.is_some_and(|share| (share > 0.3) == (suitable == "noisy")), "{settings}");
            // A given spacing has no confidence.
            assert_eq!(settings["spacing_confidence"].is_null(), !spacing.is_empty(), "{settings}");
        }
    }
}

#[test]
fn irregular_particles_cause_a_note_unless_a_preset_is_given() {
    let folder = tempdir().expect("a folder");
    let path = folder.path();
    write_irregular(path, 1);
    let note = "the preset noisy makes pools and waves calmer, but splashes thicker, than fluid; use --preset noisy, or give --preset fluid if splashes matter more";
    for (options, is_noted) in [
        (&[][..], true),
        (&["--preset", "sph"], false),
        (&["--preset", "flip"], false),
        (&["--spacing", "0.1"], false),
    ] {
        let result = converted(path, "wild.1.ply", "out", options);
        assert_eq!(result.err.contains(note), is_noted, "{options:?}: {}", result.err);
    }
    let watch = ["watch", ".", "--out", "w", "--once", "--pattern", "wild.*.ply", "--settle", "10ms"];
    let result = meniscus(path, &[&watch[..], &COARSE].concat());
    assert_eq!(result.status, 0, "{}", result.err);
    assert!(result.err.contains("the preset noisy makes pools and waves calmer"), "{}", result.err);
}

#[test]
fn auto_says_that_it_cannot_choose() {
    let folder = tempdir().expect("a folder");
    let path = folder.path();
    write_ply(&path.join("few.ply"), &block(3, 0.0));
    write_ply(&path.join("one.ply"), &block(1, 0.0));
    let warning = "too few particles are surrounded by others to measure how evenly they are spaced: the preset is fluid";
    for (name, options) in
        [("few.ply", &[][..]), ("few.ply", &["--spacing", "0.1"]), ("one.ply", &["--spacing", "0.1"])]
    {
        let result = converted(path, name, "out", &[&["--preset", "auto"], options].concat());
        assert!(result.err.contains(warning), "{options:?}: {}", result.err);
    }
    // Without an INPUT, only what does not depend on the preset is a key.
    for (options, key, spacing) in
        [(&[][..], "\n#spacing = 1\n", "unknown"), (&["--spacing", "0.1"], "\nspacing = 0.1\n", "no INPUT")]
    {
        let print = [&["convert", "--print-settings", "--preset", "auto", "--steps", "3"], options].concat();
        let printed = meniscus(path, &print).out;
        for line in
            ["\npreset = \"auto\"\n", "\nsteps = 3\n", "\n#step_size = ", "comments are those of fluid:", key]
        {
            assert!(printed.contains(line) && printed.contains(spacing), "{line} is not in {printed}");
        }
    }
    let printed = converted(path, "few.ply", "out", &["--preset", "auto", "--print-settings"]).out;
    assert!(printed.contains("\npreset = \"fluid\"\n") && printed.contains("\nspacing = 0.1\n"), "{printed}");
}

/// All frames of a sequence have the preset that its first frames had, also after a restart.
#[test]
fn daemon_remembers_the_chosen_preset() {
    let folder = tempdir().expect("a folder");
    let path = folder.path();
    let input = path.join("in");
    fs::create_dir(&input).expect("made");
    write_irregular(&input, 3);
    let watch = ["watch", "in", "--out", "out", "--once", "--settle", "10ms", "--spacing", "0.1"];
    let watch = [&watch[..], &["--preset", "auto"], &COARSE].concat();
    let result = meniscus(path, &watch);
    assert!(result.status == 0 && result.err.contains("noisy"), "{}", result.err);
    for number in 4..=9 {
        write_ply(&input.join(format!("wild.{number}.ply")), &block(10, 0.0));
    }
    assert_eq!(meniscus(path, &watch).status, 0);
    let frame = |out: &str, name: &str| fs::read(path.join(out).join(name)).expect("there");
    for (preset, is_same) in [("noisy", true), ("fluid", false)] {
        converted(path, "in/wild.#.ply", "c", &["--spacing", "0.1", "--preset", preset, "--frames", "2,9"]);
        for name in ["wild.2.obj", "wild.9.obj"] {
            assert_eq!(frame("out", name) == frame("c", name), is_same, "{preset} {name}");
        }
    }
}

/// Every shard measures the frames of the whole sequence, and not its own.
#[test]
fn shards_choose_the_same_preset() {
    let folder = tempdir().expect("a folder");
    let path = folder.path();
    for name in ["in", "out"] {
        fs::create_dir(path.join(name)).expect("made");
    }
    write_irregular(&path.join("in"), 3);
    write_ply(&path.join("in/wild.1.ply"), &block(10, 0.0));
    for shard in ["1/3", "2/3", "3/3"] {
        let result = converted(path, "in", "out", &["--preset", "auto", "--shard", shard]);
        assert!(result.out.contains("preset noisy, "), "{}", result.out);
    }
    let result = meniscus(path, &["verify", "out", "--input", "in"]);
    assert_eq!(result.status, 0, "{}{}", result.out, result.err);
}
