//! A ball in water, cut open at the ball's centre (paper, Fig. 16).
//!
//! As after a simulation, no particle is in the ball. The distance of the water from the ball is measured at
//! the vertices within 2 h of it and below its centre, where water surrounds it.

use std::sync::Arc;

use glam::DVec3;
use meniscus::render::{CameraPlacement, Layers, View, render};
use meniscus::surface::obstacle::{MeshSdf, Obstacle, ObstacleSdf, Obstacles};
use meniscus::surface::options::MethodOptions;
use meniscus::surface::particles::{OwnedPositions, ParticleCloud};
use meniscus::surface::reconstruction::FrameSurface;
use meniscus::surface::space::Lattice;

use crate::Outcome;
use crate::frame::{self, VOXEL_SIZE};
use crate::output::Files;
use crate::shapes::{holds, reconstructed};
use crate::surfaces::{cut_open, data};

/// Centre of the ball: between the floor of the tank and the waterline. The top of the ball is above the
/// water.
const CENTER: DVec3 = DVec3::new(0.62, 0.24, 0.3);

const RADIUS: f64 = 0.15;

pub(crate) fn publish(files: &Files) -> Outcome<()> {
    let is_out = |position: &[f64; 3]| DVec3::from(*position).distance(CENTER) > RADIUS + 1.5 * VOXEL_SIZE;
    let particles = frame::particles()?;
    let positions = (0..particles.len()).map(|index| particles.position(index).to_array()).filter(is_out);
    let cloud = ParticleCloud::from(OwnedPositions::F64(positions.collect()));
    let obstacles = ball();
    // The view is from above and slightly from the left.
    let bounds = [CENTER - 0.29, CENTER + 0.29];
    let placement = CameraPlacement {
        azimuth_degrees: -14.0,
        elevation_degrees: 19.0,
        zoom: 1.45,
        ..CameraPlacement::AUTO
    };
    let size = [400, 340];
    let camera = placement.around(bounds, size[0] as f64 / size[1] as f64);
    let view = View { size, camera, up: CameraPlacement::AUTO.up, ground: None };
    let (mut rows, mut pictures) = (Vec::new(), Vec::new());
    for (name, threshold, obstacles) in [
        ("no obstacle", None, &Obstacles::default()),
        ("the ball taken away", Some(0.0), &obstacles),
        ("and gaps filled", None, &obstacles),
    ] {
        let choices = MethodOptions { void_threshold: threshold, ..MethodOptions::default() };
        let surface = reconstructed(&cloud, VOXEL_SIZE, &choices, obstacles)?;
        let [deepest, rms] =
            depth_and_deviation(&surface).map(|distance| format!("{:.3}", distance / VOXEL_SIZE));
        rows.push(vec![name.to_owned(), deepest, rms, holds(&surface)]);
        let fine = 0.5 * VOXEL_SIZE;
        let band = cut_open(&data(&surface), fine, CENTER.z);
        let layers = Layers { data: false, velocity: None };
        pictures.push((render(&band, &Lattice { voxel_size: fine }, &view, layers), name.to_owned()));
    }
    files.table(
        "submerged",
        &["surface", "largest depth in the ball, h", "rms distance from the ball, h", "certificate"],
        &rows,
    )?;
    files.pictures("submerged", vec![pictures])
}

/// A triangulated sphere, finer than the voxels.
fn ball() -> Obstacles {
    let (rows, columns) = (64u32, 128u32);
    let mut positions =
        vec![(CENTER + RADIUS * DVec3::Y).to_array(), (CENTER - RADIUS * DVec3::Y).to_array()];
    for row in 1..rows {
        let down = std::f64::consts::PI * f64::from(row) / f64::from(rows);
        for column in 0..columns {
            let around = std::f64::consts::TAU * f64::from(column) / f64::from(columns);
            let outward = DVec3::new(down.sin() * around.cos(), down.cos(), down.sin() * around.sin());
            positions.push((CENTER + RADIUS * outward).to_array());
        }
    }
    let at = |row: u32, column: u32| 2 + (row - 1) * columns + column % columns;
    let mut triangles = Vec::new();
    for column in 0..columns {
        triangles.push([0, at(1, column + 1), at(1, column)]);
        triangles.push([1, at(rows - 1, column), at(rows - 1, column + 1)]);
        for row in 1..rows - 1 {
            let [a, b] = [at(row, column), at(row, column + 1)];
            let [c, d] = [at(row + 1, column), at(row + 1, column + 1)];
            triangles.extend([[a, b, d], [a, d, c]]);
        }
    }
    let kept_bytes = 64 << 20;
    let obstacle = Obstacle::new(ObstacleSdf::Mesh(MeshSdf::new(&positions, &triangles)), kept_bytes);
    Obstacles { members: vec![Arc::new(obstacle)] }
}

/// The largest depth of a vertex inside the ball, and the root mean square distance from the ball of the
/// vertices that are near the ball and below its centre: world units.
fn depth_and_deviation(surface: &FrameSurface) -> [f64; 2] {
    let mesh = &surface.mesh;
    let points = mesh.positions.iter().map(|position| mesh.origin + position.as_dvec3());
    let under = points.filter(|point| point.y < CENTER.y);
    let distances: Vec<f64> = under.map(|point| point.distance(CENTER) - RADIUS).collect();
    let deepest = distances.iter().copied().fold(0.0, |deepest: f64, distance| deepest.max(-distance));
    let near: Vec<f64> = distances.into_iter().filter(|distance| distance.abs() < 2.0 * VOXEL_SIZE).collect();
    let squares: f64 = near.iter().map(|distance| distance * distance).sum();
    [deepest, (squares / near.len().max(1) as f64).sqrt()]
}
