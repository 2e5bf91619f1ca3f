//! Random particles in a ball: how close the surface is to a sphere (paper, Fig. 12).
//!
//! Positions are uniformly random in a ball of radius 1, so that some are close together and some leave gaps.
//! The spacing is the edge of the cube that each particle occupies on average. Three measures, weighted by
//! area: the standard deviation of the triangles' distances from the centre, relative to the radius; the root
//! mean square of the angle between a triangle and the ball; and the integral of H² relative to a ball's 4π.
//! The first two exclude inner surfaces around gaps: triangles that face inward, or that are nearer to the
//! centre than three quarters of the radius.

use std::f64::consts::PI;
use std::path::Path;

use glam::DVec3;
use meniscus::render::{CameraPlacement, Layers, View, render};
use meniscus::surface::mesh::Mesh;
use meniscus::surface::smooth::Integrator;
use meniscus::surface::space::Lattice;
use meniscus_formats::MeshData;

use crate::Outcome;
use crate::output::Files;
use crate::samples::Random;
use crate::splashsurf::{Post, Splashsurf};
use crate::surfaces::{HALF_WIDTH, Program, Scale, band_of, mesh_of};

/// Measures meniscus with 50 000 particles, and splashsurf with 50 000 and with 1 000 000.
pub(crate) fn run(folder: &Path) -> Outcome<()> {
    let peer = Splashsurf::find()?;
    let files = Files::new(folder, "random_ball");
    let (few, many) = (50_000, 1_000_000);
    let (usual, fine): (Grid, Grid) = (Scale::usual, Scale::fine);
    let ball_by = [
        (few, Program::Meniscus(Integrator::Fast), usual),
        (few, Program::Meniscus(Integrator::Implicit), usual),
        (few, Program::Meniscus(Integrator::Explicit), usual),
        (few, Program::Splashsurf(Post::Plain), usual),
        (few, Program::Splashsurf(Post::Processed), usual),
        (few, Program::Splashsurf(Post::Processed), fine),
        (few, Program::Splashsurf(Post::Wide), usual),
        (many, Program::Meniscus(Integrator::Fast), usual),
        (many, Program::Splashsurf(Post::Plain), usual),
        (many, Program::Splashsurf(Post::Processed), usual),
        (many, Program::Splashsurf(Post::Processed), fine),
        (many, Program::Splashsurf(Post::Wide), usual),
    ];
    let mut rows = Vec::new();
    let mut pictures = [Vec::new(), Vec::new()];
    for (count, program, grid) in ball_by {
        let particles = ball(count);
        let scale = grid((4.0 / 3.0 * PI / count as f64).cbrt());
        let mesh = mesh_of(program, &peer, &particles, scale)?;
        rows.push(Roughness::of(&mesh).row(count, program, scale));
        if grid as usize == usual as usize && PICTURED.contains(&program) {
            let voxel_size = 0.5 * scale.voxel_size;
            let picture =
                render(&band_of(&mesh, voxel_size, HALF_WIDTH), &Lattice { voxel_size }, &view(), LAYERS);
            let name = if program == Program::Splashsurf(Post::Wide) {
                "splashsurf, wide kernel"
            } else {
                program.name()
            };
            pictures[usize::from(count == many)].push((picture, format!("{name}, {count} particles")));
        }
    }
    files.table(
        "ball",
        &[
            "particles",
            "program",
            "h or cell, spacings",
            "mean radius",
            "standard deviation of the radius",
            "angle, degrees",
            "∫H² / 4π",
            "triangles",
        ],
        &rows,
    )?;
    files.pictures("ball", pictures.into())
}

type Grid = fn(f64) -> Scale;

const PICTURED: [Program; 3] = [
    Program::Meniscus(Integrator::Fast),
    Program::Splashsurf(Post::Processed),
    Program::Splashsurf(Post::Wide),
];

const LAYERS: Layers<'_> = Layers { data: false, velocity: None };

fn ball(count: usize) -> Vec<DVec3> {
    let mut random = Random::new(12);
    (0..count).map(|_| random.in_ball(1.0)).collect()
}

fn view() -> View {
    let camera = CameraPlacement { zoom: 1.6, ..CameraPlacement::AUTO }
        .around([DVec3::splat(-1.0), DVec3::splat(1.0)], 1.0);
    View { size: [380, 380], camera, up: CameraPlacement::AUTO.up, ground: None }
}

/// Deviation from a sphere.
struct Roughness {
    mean_radius: f64,
    deviation: f64,
    angle_degrees: f64,
    energy: f64,
    triangle_count: usize,
}

impl Roughness {
    fn of(data: &MeshData) -> Roughness {
        let vertex_position = |vertex: u32| DVec3::from(data.positions[vertex as usize]);
        // Means are weighted by area: some programs produce many small triangles at rough places.
        let (mut area, mut radius, mut square, mut angle) = (0.0, 0.0, 0.0, 0.0);
        for &[a, b, c] in &data.triangles {
            let [a, b, c] = [a, b, c].map(vertex_position);
            let normal = (b - a).cross(c - a);
            let middle = (a + b + c) / 3.0;
            let outward = normal.normalize_or_zero().dot(middle.normalize_or_zero());
            // Triangles that face inward or lie deep inside belong to a cavity.
            if outward <= 0.0 || middle.length() < 0.75 {
                continue;
            }
            let weight = 0.5 * normal.length();
            area += weight;
            radius += weight * middle.length();
            square += weight * middle.length_squared();
            angle += weight * outward.min(1.0).acos().powi(2);
        }
        let mean_radius = radius / area;
        let mesh = Mesh {
            positions: data.positions.iter().map(|&position| DVec3::from(position).as_vec3()).collect(),
            triangles: data.triangles.clone(),
            ..Mesh::default()
        };
        Roughness {
            mean_radius,
            deviation: (square / area - mean_radius * mean_radius).max(0.0).sqrt() / mean_radius,
            angle_degrees: (angle / area).sqrt().to_degrees(),
            energy: mesh.measure().bending_energy / (4.0 * PI),
            triangle_count: data.triangles.len(),
        }
    }

    fn row(&self, count: usize, program: Program, scale: Scale) -> Vec<String> {
        let Roughness { mean_radius, deviation, angle_degrees, energy, triangle_count } = self;
        vec![
            count.to_string(),
            program.name().into(),
            format!("{:.2}", scale.voxel_size / scale.spacing),
            format!("{mean_radius:.4}"),
            format!("{deviation:.5}"),
            format!("{angle_degrees:.2}"),
            // Slivers dominate so large an energy, so its value is meaningless.
            if *energy > 1000.0 { "> 1000".into() } else { format!("{energy:.2}") },
            triangle_count.to_string(),
        ]
    }
}
