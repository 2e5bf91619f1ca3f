//! Particles with different shapes and sizes, and an obstacle around them (paper, Fig. 11, 13, 15 and 16).

use std::f64::consts::TAU;
use std::path::Path;
use std::sync::Arc;

use glam::{DMat3, DQuat, DVec3, EulerRot};
use meniscus::render::{CameraPlacement, Layers, Picture, View, render, render_particles};
use meniscus::surface::obstacle::{MeshSdf, Obstacle, ObstacleSdf, Obstacles};
use meniscus::surface::options::{AnisotropyKind, MethodOptions, Settings};
use meniscus::surface::particles::{Attribute, AttributeValues, OwnedPositions, ParticleCloud, Role};
use meniscus::surface::reconstruction::{FrameSurface, reconstruct_cloud};
use meniscus::surface::space::Lattice;

use crate::Outcome;
use crate::output::Files;
use crate::samples::Random;
use crate::submerged;

/// Renders each shape, and measures its surfaces.
pub(crate) fn run(folder: &Path) -> Outcome<()> {
    let files = Files::new(folder, "shapes");
    crown(&files)?;
    sizes(&files)?;
    tetrahedron(&files)?;
    submerged::publish(&files)
}

/// A thin sheet that opens and ends in ligaments, with one layer of particles that move along it.
fn crown(files: &Files) -> Outcome<()> {
    let mut random = Random::new(11);
    let (mut positions, mut velocities) = (Vec::new(), Vec::new());
    for row in 0..26 {
        let height = f64::from(row);
        let radius = 16.0 + 0.012 * height.powi(2) + 0.18 * height;
        let slope = 0.024 * height + 0.18;
        let count = (TAU * radius).round() as usize;
        for index in 0..count {
            let angle = TAU * index as f64 / count as f64;
            // Above the rim of the crown, only threads of particles exist.
            if height > 13.0 + 12.0 * (12.0 * angle).cos() {
                continue;
            }
            let outward = DVec3::new(angle.cos(), 0.0, angle.sin());
            let position = radius * outward + height * DVec3::Y + random.in_ball(0.3);
            positions.push(position.to_array());
            velocities.push((slope * outward + DVec3::Y).normalize() * 45.0);
        }
    }
    let numbers = velocities.iter().flat_map(|velocity| velocity.as_vec3().to_array()).collect();
    let cloud = with(OwnedPositions::F64(positions), "v", Role::Velocity, 3, numbers);
    let voxel_size = 0.5;
    let view = around([DVec3::new(-28.0, -1.0, -28.0), DVec3::new(28.0, 26.0, 28.0)], [300, 230]);
    let mut pictures = vec![(render_particles(&cloud.positions, 0.45, &view), "particles".to_owned())];
    let mut rows = Vec::new();
    for (name, kind) in [
        ("balls", AnisotropyKind::None),
        ("by neighbours", AnisotropyKind::Neighbors),
        ("by velocity", AnisotropyKind::Velocity),
    ] {
        let choices = MethodOptions { anisotropy: Some(kind), ..MethodOptions::default() };
        let surface = reconstructed(&cloud, voxel_size, &choices, &Obstacles::default())?;
        let measures = &surface.report.mesh;
        rows.push(vec![
            name.into(),
            format!("{:.0}", measures.bending_energy),
            format!("{:.0}", measures.volume),
            measures.component_count.to_string(),
            holds(&surface),
        ]);
        pictures.push((picture(&surface, voxel_size, &view), name.to_owned()));
    }
    files.table("crown", &["particles", "∫H²", "volume", "pieces", "certificate"], &rows)?;
    files.pictures("crown", vec![pictures])
}

/// A heap of particles of four sizes.
fn sizes(files: &Files) -> Outcome<()> {
    let mut random = Random::new(13);
    let (mut centers, mut radii): (Vec<DVec3>, Vec<f64>) = (Vec::new(), Vec::new());
    // The largest balls first: smaller ones fill the remaining space.
    for (radius, tries) in [(4.0, 400), (2.4, 3000), (1.5, 12_000), (0.9, 40_000)] {
        for _ in 0..tries {
            let center = random.in_ball(16.0) * DVec3::new(1.0, 0.5, 1.0);
            let touches = |(other, size): (&DVec3, &f64)| other.distance(center) < 0.92 * (radius + size);
            if center.y > -4.0 && !centers.iter().zip(&radii).any(touches) {
                centers.push(center);
                radii.push(radius);
            }
        }
    }
    let positions = OwnedPositions::F64(centers.iter().map(|center| center.to_array()).collect());
    let numbers = radii.iter().map(|radius| *radius as f32).collect();
    let cloud = with(positions, "pscale", Role::Radius, 1, numbers);
    let voxel_size = 0.45;
    let view = around([DVec3::new(-17.0, -7.0, -17.0), DVec3::new(17.0, 9.0, 17.0)], [400, 260]);
    let close = MethodOptions { radius_ratio: Some(1.25), ..MethodOptions::default() };
    let own = MethodOptions { radius_attribute: Some("pscale".to_owned()), ..close.clone() };
    let one = MethodOptions { radius_min: Some(0.9.into()), ..close };
    let mut pictures = vec![(balls(&centers, &radii, &view)?, "particles".to_owned())];
    for (name, choices) in [("one radius", one), ("their own radii", own)] {
        let surface = reconstructed(&cloud, voxel_size, &choices, &Obstacles::default())?;
        pictures
            .push((picture(&surface, voxel_size, &view), format!("{name}, certificate {}", holds(&surface))));
    }
    files.pictures("sizes", vec![pictures])
}

/// The particles as balls, with almost no smoothing.
fn balls(centers: &[DVec3], radii: &[f64], view: &View) -> Outcome<Picture> {
    let positions = OwnedPositions::F64(centers.iter().map(|center| center.to_array()).collect());
    let numbers = radii.iter().map(|radius| *radius as f32).collect();
    let cloud = with(positions, "pscale", Role::Radius, 1, numbers);
    let choices = MethodOptions {
        radius_attribute: Some("pscale".to_owned()),
        radius_ratio: Some(1.0),
        steps: Some(0),
        laplacian_steps: Some(0),
        ..MethodOptions::default()
    };
    let voxel_size = 0.25;
    Ok(picture(&reconstructed(&cloud, voxel_size, &choices, &Obstacles::default())?, voxel_size, view))
}

/// Particles on the inside of a tetrahedral mould, some slightly outside of it.
fn tetrahedron(files: &Files) -> Outcome<()> {
    let rotation = DMat3::from_quat(DQuat::from_euler(EulerRot::XYZ, 0.3, 0.2, 0.5));
    let corners = [[1.0, 1.0, 1.0], [1.0, -1.0, -1.0], [-1.0, 1.0, -1.0], [-1.0, -1.0, 1.0]]
        .map(|corner| rotation * DVec3::from(corner));
    let faces = [[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]];
    let voxel_size = 0.04;
    let particles = on_faces(&corners, &faces, 3.2 * voxel_size);
    let obstacles = mould(&corners, &faces);
    let positions = OwnedPositions::F64(particles.iter().map(|point| point.to_array()).collect());
    let cloud = ParticleCloud::from(positions);
    let view = around([DVec3::splat(-1.25), DVec3::splat(1.25)], [400, 360]);
    let mut pictures = Vec::new();
    let mut rows = Vec::new();
    let wall = MeshSdf::new(
        &corners.map(|corner| corner.to_array()),
        &faces.map(|face| face.map(|index| index as u32)),
    );
    for (name, threshold, obstacles) in [
        ("no obstacle", None, &Obstacles::default()),
        ("walls taken away", Some(0.0), &obstacles),
        ("and gaps filled", None, &obstacles),
    ] {
        let choices = MethodOptions { void_threshold: threshold, ..MethodOptions::default() };
        let surface = reconstructed(&cloud, voxel_size, &choices, obstacles)?;
        let off = Deviation::of(&surface, &wall);
        let number = |value: f64| format!("{:.3}", value / voxel_size);
        rows.push(vec![name.to_owned(), number(off.beyond), number(off.rms), holds(&surface)]);
        pictures.push((picture(&surface, voxel_size, &view), name.to_owned()));
    }
    files.table(
        "tetrahedron",
        &["surface", "largest distance beyond the walls, h", "rms distance from the walls, h", "certificate"],
        &rows,
    )?;
    files.pictures("tetrahedron", vec![pictures])
}

/// Distances of the outer surface from the walls of the mould, world units.
struct Deviation {
    beyond: f64,
    rms: f64,
}

impl Deviation {
    /// Vertices far from the walls belong to the inner side of the layer of particles, and are left out.
    fn of(surface: &FrameSurface, wall: &MeshSdf) -> Deviation {
        let mesh = &surface.mesh;
        let points = mesh.positions.iter().map(|position| mesh.origin + position.as_dvec3());
        let distances = points.filter_map(|point| wall.distance(point));
        let outer: Vec<f64> = distances.filter(|distance| *distance > -OUTER).collect();
        let squares: f64 = outer.iter().map(|distance| distance * distance).sum();
        Deviation {
            beyond: outer.iter().copied().fold(0.0, f64::max),
            rms: (squares / outer.len().max(1) as f64).sqrt(),
        }
    }
}

/// About half the thickness of the layer of particles on the walls, world units. Vertices that are farther
/// from the walls belong to the inner side.
const OUTER: f64 = 0.06;

/// Points on the faces, at a distance of at least `apart` from each other, then displaced: some are a little
/// outside, and more of them inside.
fn on_faces(corners: &[DVec3; 4], faces: &[[usize; 3]; 4], apart: f64) -> Vec<DVec3> {
    let mut random = Random::new(7);
    let mut points: Vec<DVec3> = Vec::new();
    for index in 0..40_000 {
        let [a, b, c] = faces[index % 4].map(|corner| corners[corner]);
        let (mut u, mut v) = (random.unit(), random.unit());
        if u + v > 1.0 {
            (u, v) = (1.0 - u, 1.0 - v);
        }
        let point = a + u * (b - a) + v * (c - a);
        if points.iter().all(|other| other.distance(point) > apart) {
            points.push(point);
        }
    }
    points.iter().map(|point| *point * (1.05 - 0.11 * random.unit())).collect()
}

/// A block with a hole in the shape of the tetrahedron: the faces of the hole point into the hole.
fn mould(corners: &[DVec3; 4], faces: &[[usize; 3]; 4]) -> Obstacles {
    let mut positions: Vec<[f64; 3]> = corners.iter().map(|corner| corner.to_array()).collect();
    let side = |bit: u32, corner: u32| if corner >> bit & 1 == 0 { -2.0 } else { 2.0 };
    positions.extend((0..8).map(|corner| [side(2, corner), side(1, corner), side(0, corner)]));
    let mut triangles: Vec<[u32; 3]> =
        faces.iter().map(|&[a, b, c]| [c, b, a].map(|corner| corner as u32)).collect();
    let quads = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]];
    for [a, b, c, d] in quads.map(|quad: [u32; 4]| quad.map(|corner| corner + 4)) {
        triangles.extend([[a, b, c], [a, c, d]]);
    }
    let kept_bytes = 64 << 20;
    let obstacle = Obstacle::new(ObstacleSdf::Mesh(MeshSdf::new(&positions, &triangles)), kept_bytes);
    Obstacles { members: vec![Arc::new(obstacle)] }
}

fn with(positions: OwnedPositions, name: &str, role: Role, arity: usize, numbers: Vec<f32>) -> ParticleCloud {
    let values = AttributeValues::Numbers(numbers);
    let attribute = Attribute { name: name.to_owned(), role, arity, values };
    ParticleCloud { attributes: vec![attribute], ..ParticleCloud::from(positions) }
}

pub(crate) fn reconstructed(
    cloud: &ParticleCloud,
    voxel_size: f64,
    choices: &MethodOptions,
    obstacles: &Obstacles,
) -> Outcome<FrameSurface> {
    Ok(reconstruct_cloud(cloud.clone(), &Settings::paper(voxel_size, choices)?, obstacles))
}

pub(crate) fn holds(surface: &FrameSurface) -> String {
    if surface.report.certificate.holds() { "holds" } else { "does not hold" }.to_owned()
}

fn around(bounds: [DVec3; 2], size: [usize; 2]) -> View {
    let placement = CameraPlacement { zoom: 1.35, ..CameraPlacement::AUTO };
    let camera = placement.around(bounds, size[0] as f64 / size[1] as f64);
    View { size, camera, up: CameraPlacement::AUTO.up, ground: None }
}

fn picture(surface: &FrameSurface, voxel_size: f64, view: &View) -> Picture {
    render(&surface.band, &Lattice { voxel_size }, view, Layers { data: false, velocity: None })
}
