//! The certificate describes the written mesh, also if the mesh has fewer triangles or rounded positions, or
//! if particles have escaped far away.

use std::fs;
use std::io::{BufRead, BufReader};
use std::process::{Command, Stdio};

use glam::{DVec3, Vec3};
use meniscus::surface::mesh::{Mesh, PositionRounding};
use meniscus::surface::obstacle::Obstacles;
use meniscus::surface::options::{MethodOptions, Settings};
use meniscus::surface::particles::OwnedPositions;
use meniscus::surface::reconstruction::{FrameSurface, StagedFrame, reconstruct_frame};
use meniscus::surface::report::ShapeStats;
use serde_json::Value;
use tempfile::tempdir;

use crate::program::scene::{block, meniscus, write_ply};

fn skinned(positions: &[[f64; 3]], settings: &Settings, rounding: PositionRounding) -> FrameSurface {
    let particles = OwnedPositions::F64(positions.to_vec());
    let frame =
        StagedFrame::rasterize(&particles, ShapeStats::default(), Obstacles::default(), settings, None);
    let frame = frame.expect("in memory").smooth(settings, &mut |_| {}).expect("in memory");
    frame.contour(settings, rounding).expect("in memory").0
}

fn world(mesh: &Mesh, position: Vec3) -> DVec3 {
    mesh.origin + position.as_dvec3()
}

/// The winding number of a mesh around a point: the sum of the solid angles of its triangles.
fn winding(mesh: &Mesh, point: DVec3) -> f64 {
    let solid_angle = |triangle: &[u32; 3]| {
        let [a, b, c] = triangle.map(|vertex| world(mesh, mesh.positions[vertex as usize]) - point);
        let [la, lb, lc] = [a, b, c].map(DVec3::length);
        let below = la * lb * lc + a.dot(b) * lc + b.dot(c) * la + c.dot(a) * lb;
        2.0 * a.dot(b.cross(c)).atan2(below)
    };
    mesh.triangles.iter().map(solid_angle).sum::<f64>() / (4.0 * std::f64::consts::PI)
}

/// Numbers below one that look random.
fn random(seed: u64) -> f64 {
    let mixed = seed.wrapping_add(1).wrapping_mul(0x9e37_79b9_7f4a_7c15);
    let mixed = (mixed ^ mixed >> 31).wrapping_mul(0xd6e8_feb8_6659_fd93);
    ((mixed ^ mixed >> 29) >> 11) as f64 / (1u64 << 53) as f64
}

/// `from` is the lower corner along each axis.
fn cloud(seed: u64, count: u64, width: f64, from: f64) -> Vec<[f64; 3]> {
    let position = |index| [0, 1, 2].map(|axis| from + width * random(3000 * seed + 3 * index + axis));
    (0..count).map(position).collect()
}

/// From here on, adjacent 32-bit numbers differ by a quarter.
const QUARTERS: f64 = (1 << 21) as f64;

/// From here on, adjacent 32-bit numbers differ by an eighth.
const EIGHTHS: f64 = (1 << 20) as f64;

/// With radii this small, some particles are outside both the mesh and the zero set of φ, and some are
/// outside only one of them.
#[test]
fn every_particle_outside_the_written_mesh_is_counted() {
    let mut outside_in_all = 0;
    for (decimate, radius_min) in [(0.0, 0.4), (0.0, 0.9), (0.8, 0.7), (0.5, 1.2)] {
        let choices = MethodOptions {
            decimate: Some(decimate),
            radius_min: Some(radius_min.into()),
            ..MethodOptions::default()
        };
        let settings = Settings::paper(1.0, &choices).expect("sound");
        for (seed, from, rounding) in [
            (1, 0.0, PositionRounding::Local),
            (2, QUARTERS, PositionRounding::World),
            (3, 0.0, PositionRounding::Local),
        ] {
            let positions = cloud(seed, 300, 16.0, from);
            let surface = skinned(&positions, &settings, rounding);
            assert!(surface.mesh.is_rounded(rounding));
            let is_outside = |position: &&[f64; 3]| winding(&surface.mesh, DVec3::from(**position)) < 0.5;
            let outside_count = positions.iter().filter(is_outside).count();
            let certificate = &surface.report.certificate;
            // Some drops are so small that they have no volume when rounded to quarters.
            let measures = &surface.report.mesh;
            assert_eq!((measures.boundary_edge_count, measures.non_manifold_edge_count), (0, 0));
            assert_eq!(
                certificate.particles_outside.count, outside_count,
                "decimated by {decimate}, r_min {radius_min}, {rounding:?}"
            );
            outside_in_all += outside_count;
        }
    }
    assert!(outside_in_all > 0, "the scenes have no particle outside");
}

#[test]
fn rounded_mesh_is_closed_and_within_its_bounds() {
    let settings = Settings::paper(1.0, &MethodOptions::default()).expect("sound");
    let mut removed_count = 0;
    for seed in 0..4 {
        let positions = cloud(40 + seed, 400, 24.0, EIGHTHS);
        let surface = skinned(&positions, &settings, PositionRounding::World);
        let certificate = &surface.report.certificate;
        let measures = &surface.report.mesh;
        assert_eq!((measures.boundary_edge_count, measures.non_manifold_edge_count), (0, 0), "{measures:?}");
        removed_count += surface.report.flat_triangles_removed;
        assert_eq!(measures.degenerate_triangle_count, 0, "seed {seed}: {measures:?}");
        assert!(certificate.holds(), "seed {seed}: {certificate:?} {measures:?}");
        // The figures about vertices describe the vertices in the file.
        let written = &surface.mesh.positions;
        let nearest = |vertex: &Vec3| {
            let vertex = world(&surface.mesh, *vertex);
            let distances = positions.iter().map(|particle| DVec3::from(*particle).distance(vertex));
            distances.fold(f64::INFINITY, f64::min)
        };
        let distances: Vec<f64> = written.iter().map(nearest).collect();
        let least = distances.iter().copied().fold(f64::INFINITY, f64::min);
        let greatest = distances.iter().copied().fold(0.0, f64::max);
        assert!((certificate.vertex_distance_min - least).abs() < 1e-4, "{least} {certificate:?}");
        assert!((certificate.vertex_distance_max - greatest).abs() < 1e-4, "{greatest} {certificate:?}");
        let is_flat = |triangle: &&[u32; 3]| {
            let [a, b, c] = triangle.map(|vertex| written[vertex as usize]);
            (b - a).cross(c - a).length() == 0.0
        };
        assert_eq!(surface.mesh.triangles.iter().filter(is_flat).count(), 0);
    }
    assert!(removed_count > 0, "rounding made no triangle flat");
}

/// The meshes of drops this far away are still closed, because triangles that are degenerate at 32-bit
/// precision are removed.
#[test]
fn drops_at_the_limit_of_precision_are_closed() {
    let settings = Settings::paper(0.1, &MethodOptions::default()).expect("sound");
    let near: Vec<[f64; 3]> = block(10, 0.0).iter().map(|position| position.map(|x| 2.0 * x)).collect();
    let mut removed_count = 0;
    for (seed, voxels) in [2e4, 7e4, 2e5, 5e5, 8e5, 1e6].into_iter().enumerate() {
        for drop in 0..4 {
            let mut positions = near.clone();
            let at = |axis: u64| 0.1 * voxels * (0.2 + 0.8 * random(100 * seed as u64 + 10 * drop + axis));
            let [x, y, z] = [at(0), -at(1), 0.1 * voxels];
            positions.extend([[x, y, z], [x + 0.25, y + 0.1, z], [x, y + 0.3, z + 0.1]]);
            let report = reconstruct_frame(&OwnedPositions::F64(positions), &settings).report;
            assert_eq!(report.dropped_count, 0);
            assert!(report.certificate.holds(), "at {voxels}: {:?} {:?}", report.certificate, report.mesh);
            removed_count += report.flat_triangles_removed;
        }
    }
    assert!(removed_count > 0, "no drop had a triangle without area");
}

#[test]
fn escaped_particle_is_left_out_and_the_others_are_certified() {
    let settings = Settings::paper(0.1, &MethodOptions::default()).expect("sound");
    let positions = block(8, 0.0);
    let alone = reconstruct_frame(&OwnedPositions::F64(positions.clone()), &settings);
    for far in [3e5, -4e6, 9e7, 1e30] {
        let mut escaped = positions.clone();
        escaped.insert(100, [0.3, far, 0.0]);
        let surface = reconstruct_frame(&OwnedPositions::F64(escaped), &settings);
        assert!(surface.mesh == alone.mesh && surface.band.phi == alone.band.phi, "at {far}");
        assert_eq!((surface.report.particle_count, surface.report.dropped_count), (512, 1));
        assert_eq!(surface.report.certificate.particles_left_out, 1);
        assert!(surface.report.certificate.holds());
        let at = surface.report.outlier_position.expect("a place");
        assert!((at.y / far - 1.0).abs() < 1e-3, "{at}");
    }
}

/// Two distant parts belong to one frame, and neither is an escaped particle.
#[test]
fn frame_of_two_distant_parts_keeps_both() {
    let settings = Settings::paper(0.1, &MethodOptions::default()).expect("sound");
    let mut positions = block(8, 0.0);
    positions.extend(block(8, 3e5));
    let report = reconstruct_frame(&OwnedPositions::F64(positions), &settings).report;
    assert_eq!((report.particle_count, report.dropped_count), (1024, 0));
    assert_eq!(report.mesh.component_count, 2);
}

#[test]
fn escaped_particle_causes_a_warning_and_exit_status_0() {
    let folder = tempdir().expect("a folder");
    let mut particles = block(8, 0.0);
    particles.push([1e6, 2.0, 3.0]);
    write_ply(&folder.path().join("a.ply"), &particles);
    let result = meniscus(
        folder.path(),
        &["convert", "a.ply", "--out", "out", "--voxel-size", "0.1", "--report", "r.json"],
    );
    assert_eq!(result.status, 0, "{}", result.err);
    assert!(
        result.err.contains(
            "1 particle left out: not finite, or too far from the origin or from the other particles; one is \
             near (1000000, "
        ),
        "{}",
        result.err
    );
    let report: Value =
        serde_json::from_slice(&fs::read(folder.path().join("r.json")).expect("there")).expect("JSON");
    let frame = &report["frames"][0];
    assert_eq!((&frame["dropped"], &frame["certificate"]["particles_left_out"]), (&1.into(), &1.into()));
    assert_eq!(frame["certificate"]["holds"], true);
}

/// Options with spheres so small that they fall between the voxels: the frames violate a guarantee. A shard
/// with such frames fails in every run, and prints their number.
const SMALL: [&str; 8] =
    ["--out", "out", "--voxel-size", "0.05", "--preset", "paper", "--radius-min", "0.001"];

#[test]
fn shards_with_broken_frames_exit_1_unless_violations_are_allowed() {
    let folder = tempdir().expect("a folder");
    let folder = folder.path();
    for number in 1..=2 {
        write_ply(&folder.join(format!("a.{number}.ply")), &block(4, 0.013));
    }
    fs::create_dir(folder.join("out")).expect("made");
    let shard = [&["convert", "a.1.ply", "a.2.ply", "--shard=1/1"], &SMALL[..]].concat();
    for _ in 0..2 {
        let result = meniscus(folder, &shard);
        assert_eq!(result.status, 1, "{}", result.err);
        let expected =
            "error: 2 of 2 frames failed validation; outputs were kept; --allow-violations accepts them\n";
        assert!(result.err.ends_with(expected), "{}", result.err);
    }
    assert_eq!(meniscus(folder, &[&shard[..], &["--allow-violations"]].concat()).status, 0);
    let verified = meniscus(folder, &["verify", "out"]);
    assert!(verified.status == 2 && verified.err.contains("a.1: violations: "), "{}", verified.err);
    assert!(verified.out.contains("2 frames: 0 done, 2 violations"), "{}", verified.out);
}

/// The result is the same with and without `--skip-done` in the first run.
#[test]
fn skipped_frame_that_failed_validation_fails_again() {
    let convert = [&["convert", "a.1.ply"], &SMALL[..]].concat();
    let skip = [&convert[..], &["--skip-done"]].concat();
    for first in [&convert[..], &skip] {
        let folder = tempdir().expect("a folder");
        let folder = folder.path();
        write_ply(&folder.join("a.1.ply"), &block(4, 0.013));
        let expected =
            "error: 1 of 1 frame failed validation; outputs were kept; --allow-violations accepts them\n";
        let result = meniscus(folder, first);
        assert!(result.status == 1 && result.err.ends_with(expected), "{}", result.err);
        for _ in 0..2 {
            let result = meniscus(folder, &skip);
            assert!(result.out.contains("a.1.ply: done already"), "{first:?}: {}", result.out);
            assert!(
                result.status == 1 && result.err.ends_with(expected),
                "{first:?}: {} {}",
                result.status,
                result.err
            );
            assert!(result.err.contains("warning: a.1.ply: failed validation: "), "{}", result.err);
        }
        let allowed = meniscus(folder, &[&skip[..], &["--allow-violations"]].concat());
        assert_eq!(allowed.status, 0, "{}", allowed.err);
        assert!(allowed.err.contains("a.1.ply: failed validation"), "{}", allowed.err);
        // A run with other settings replaces the outputs by valid ones.
        let good = ["convert", "a.1.ply", "--out", "out", "--preset", "paper", "--voxel-size", "0.05"];
        for more in [&[][..], &["--skip-done"]] {
            let result = meniscus(folder, &[&good[..], more].concat());
            assert_eq!(result.status, 0, "{}", result.err);
        }
    }
}

/// The killed run recorded which of its frames failed validation.
#[test]
fn frame_that_failed_validation_before_a_kill_fails_again() {
    let folder = tempdir().expect("a folder");
    let folder = folder.path();
    for number in 1..=30 {
        write_ply(&folder.join(format!("a.{number}.ply")), &block(4, 0.013));
    }
    let small = [
        "--out",
        "out",
        "--voxel-size",
        "0.05",
        "--preset",
        "paper",
        "--radius-min",
        "0.001",
        "--threads",
        "1",
    ];
    let mut child = Command::new(env!("CARGO_BIN_EXE_meniscus"))
        .args(["convert", "a.#.ply"])
        .args(small)
        .current_dir(folder)
        .stdout(Stdio::piped())
        .stderr(Stdio::null())
        .spawn()
        .expect("started");
    let mut lines = BufReader::new(child.stdout.take().expect("piped")).lines();
    let first = lines.by_ref().map(|line| line.expect("a line")).find(|line| line.starts_with("a.1.ply: "));
    child.kill().expect("killed");
    child.wait().expect("ended");
    assert!(first.is_some());
    let result = meniscus(folder, &[&["convert", "a.1.ply", "--skip-done"], &small[..]].concat());
    assert!(result.out.contains("a.1.ply: done already"), "{}", result.out);
    assert!(result.status == 1 && result.err.contains("1 of 1 frame failed validation"), "{}", result.err);
}
