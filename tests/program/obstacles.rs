//! Fluid at obstacles: the contact is sharp, without gaps (paper, §3.6, Fig. 15 and 16).

use std::f64::consts::{PI, TAU};
use std::fmt::Write;
use std::fs;
use std::path::Path;
use std::sync::Arc;

use glam::{DQuat, DVec3, EulerRot};
use meniscus::surface::grid::{offset_in_leaf, voxel_in_leaf};
use meniscus::surface::obstacle::{MeshSdf, Obstacle, ObstacleSdf, Obstacles};
use meniscus::surface::options::{MethodOptions, Preset, Settings};
use meniscus::surface::particles::{OwnedPositions, ParticleCloud, Shapes};
use meniscus::surface::reconstruction::{FrameSurface, reconstruct_cloud};
use serde_json::Value;
use tempfile::tempdir;

use crate::program::scene::{RunResult, block, meniscus, write_ply};

/// The mesh of an obstacle, and the signed distance to it.
struct Body {
    positions: Vec<[f64; 3]>,
    triangles: Vec<[u32; 3]>,
    distance: Box<dyn Fn(DVec3) -> f64>,
}

impl Body {
    fn obstacles(&self) -> Obstacles {
        let solid = MeshSdf::new(&self.positions, &self.triangles);
        assert_eq!(solid.findings().open_edge_count, 0);
        Obstacles { members: vec![Arc::new(Obstacle::new(ObstacleSdf::Mesh(solid), 1 << 28))] }
    }

    fn corners(&self, triangle: [u32; 3]) -> [DVec3; 3] {
        triangle.map(|corner| DVec3::from(self.positions[corner as usize]))
    }

    fn obj(&self) -> String {
        let mut text = String::new();
        for [x, y, z] in &self.positions {
            writeln!(text, "v {x} {y} {z}").expect("strings take everything");
        }
        for [a, b, c] in &self.triangles {
            writeln!(text, "f {} {} {}", a + 1, b + 1, c + 1).expect("strings take everything");
        }
        text
    }
}

/// A rotated tetrahedron. The distance is exact inside and next to its faces: that to the planes of the
/// faces.
fn tetrahedron(size: f64) -> Body {
    let rotation = DQuat::from_euler(EulerRot::XYZ, 0.3, 0.2, 0.5);
    let corners = [[1.0, 1.0, 1.0], [1.0, -1.0, -1.0], [-1.0, 1.0, -1.0], [-1.0, -1.0, 1.0]];
    let transformed =
        |corner: &[f64; 3]| (rotation * DVec3::from(*corner) * size + DVec3::new(0.3, 0.1, 0.2)).to_array();
    let positions: Vec<[f64; 3]> = corners.iter().map(transformed).collect();
    let triangles = vec![[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]];
    let body = Body { positions, triangles, distance: Box::new(|_| 0.0) };
    let planes: Vec<(DVec3, f64)> = body
        .triangles
        .iter()
        .map(|&triangle| {
            let [a, b, c] = body.corners(triangle);
            let normal = (b - a).cross(c - a).normalize();
            (normal, normal.dot(a))
        })
        .collect();
    let distance = move |point: DVec3| {
        let beyond = planes.iter().map(|(normal, plane_offset)| normal.dot(point) - plane_offset);
        beyond.fold(f64::NEG_INFINITY, f64::max)
    };
    Body { distance: Box::new(distance), ..body }
}

fn cuboid(min: DVec3, max: DVec3) -> Body {
    let corner =
        |index: usize| [0, 1, 2].map(|axis| if index >> axis & 1 == 1 { max[axis] } else { min[axis] });
    let quads: [[u32; 4]; 6] =
        [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]];
    let triangles = quads.iter().flat_map(|&[a, b, c, d]| [[a, b, c], [a, c, d]]).collect();
    let distance = move |point: DVec3| {
        let apart = (min - point).max(point - max);
        apart.max(DVec3::ZERO).length() + apart.max_element().min(0.0)
    };
    Body { positions: (0..8).map(corner).collect(), triangles, distance: Box::new(distance) }
}

fn ball(center: DVec3, radius: f64) -> Body {
    const COUNT: u32 = 40;
    let at = |u: u32, v: u32| {
        let (angle, height) =
            (TAU * f64::from(u) / f64::from(2 * COUNT), PI * f64::from(v) / f64::from(COUNT));
        let across = if v == 0 || v == COUNT { 0.0 } else { height.sin() };
        center - radius * DVec3::new(across * angle.cos(), across * angle.sin(), height.cos())
    };
    let positions = (0..=COUNT).flat_map(|v| (0..2 * COUNT).map(move |u| at(u, v).to_array())).collect();
    let mut triangles = Vec::new();
    for v in 0..COUNT {
        for u in 0..2 * COUNT {
            let corner = |du, dv| (v + dv) * 2 * COUNT + (u + du) % (2 * COUNT);
            triangles.push([corner(0, 0), corner(1, 0), corner(1, 1)]);
            triangles.push([corner(0, 0), corner(1, 1), corner(0, 1)]);
        }
    }
    Body { positions, triangles, distance: Box::new(move |point| point.distance(center) - radius) }
}

/// A pseudo-random number from 0 to 1.
fn random(seed: usize) -> f64 {
    (seed as f64 * 12.9898).sin().mul_add(43758.5453, 0.0).rem_euclid(1.0)
}

/// The particles of an irregular block, about 2 apart, for which `is_kept` holds.
fn fluid(counts: [i32; 3], center: DVec3, is_kept: impl Fn(DVec3) -> bool) -> Vec<[f64; 3]> {
    let mut particles = Vec::new();
    for x in 0..counts[0] {
        for y in 0..counts[1] {
            for z in 0..counts[2] {
                let seed = ((x * counts[1] + y) * counts[2] + z) as usize;
                let jitter = DVec3::new(random(3 * seed), random(3 * seed + 1), random(3 * seed + 2)) - 0.5;
                let index = [x, y, z].map(f64::from);
                let middle = counts.map(|count| 0.5 * f64::from(count - 1));
                let position = (DVec3::from(index) - DVec3::from(middle)) * 2.0 + 0.8 * jitter + center;
                if is_kept(position) {
                    particles.push(position.to_array());
                }
            }
        }
    }
    particles
}

fn skinned(particles: Vec<[f64; 3]>, body: &Body, void_threshold: f64) -> FrameSurface {
    skinned_and_moved(particles, body, void_threshold, 0.0)
}

fn skinned_and_moved(
    particles: Vec<[f64; 3]>,
    body: &Body,
    void_threshold: f64,
    offset: f64,
) -> FrameSurface {
    let choices = MethodOptions {
        void_threshold: Some(void_threshold),
        offset: Some(offset.into()),
        ..MethodOptions::default()
    };
    let settings = Settings::paper(1.0, &choices).expect("sound");
    let positions = OwnedPositions::F64(particles);
    let cloud = ParticleCloud { positions, shapes: Shapes::Uniform, attributes: Vec::new() };
    reconstruct_cloud(cloud, &settings, &body.obstacles())
}

/// Checks that no vertex is deeper in the obstacle than a quarter of a voxel, that the mesh is closed, and
/// that the certificate holds. Returns the distances of the vertices from the obstacle.
fn check(name: &str, surface: &FrameSurface, body: &Body) -> Vec<f64> {
    let world = |position: &glam::Vec3| surface.mesh.origin + position.as_dvec3();
    let distances: Vec<f64> =
        surface.mesh.positions.iter().map(|position| (body.distance)(world(position))).collect();
    let deepest = distances.iter().copied().fold(f64::INFINITY, f64::min);
    assert!(deepest > -0.25, "{name}: {deepest}");
    assert!(surface.report.mesh.is_closed_manifold(), "{name}: {:?}", surface.report.mesh);
    assert!(surface.report.certificate.holds(), "{name}: {:?}", surface.report.certificate);
    distances
}

/// The number of voxels next to the obstacle for which `is_wet` holds, and the number of these that are
/// outside the fluid.
fn dry_voxels(surface: &FrameSurface, body: &Body, is_wet: impl Fn(DVec3) -> bool) -> (usize, usize) {
    let (mut count, mut dry_count) = (0, 0);
    for (leaf, &origin) in surface.band.phi.leaves.iter().zip(surface.band.topology.origins()) {
        for (offset, phi) in leaf.values.iter().enumerate() {
            let position = (origin + voxel_in_leaf(offset)).as_dvec3();
            if (0.05..1.0).contains(&(body.distance)(position)) && is_wet(position) {
                count += 1;
                dry_count += usize::from(*phi >= 0.0);
            }
        }
    }
    (count, dry_count)
}

/// Particles on the faces of a tetrahedron, or at a small distance: the fluid touches the faces without a gap
/// (Fig. 15).
#[test]
fn film_touches_all_faces_of_a_tetrahedron() {
    let body = tetrahedron(24.0);
    for off in [0.0, 1.0, 3.3] {
        let mut particles = Vec::new();
        for &triangle in &body.triangles {
            let [a, b, c] = body.corners(triangle);
            let normal = (b - a).cross(c - a);
            for seed in 0..(0.3 * normal.length()) as usize {
                let [u, v] = [random(2 * seed), random(2 * seed + 1)];
                let [u, v] = if u + v > 1.0 { [1.0 - u, 1.0 - v] } else { [u, v] };
                particles.push((a + (b - a) * u + (c - a) * v + normal.normalize() * off).to_array());
            }
        }
        let surface = skinned(particles.clone(), &body, 2.0);
        let distances = check("film", &surface, &body);
        // Vertices on the faces, without those near edges.
        let contact = distances.iter().filter(|distance| distance.abs() < 1.0).count();
        let flat = distances.iter().filter(|distance| distance.abs() < 0.25).count();
        assert!(contact > 5000 && flat * 1000 > contact * 995, "{off}: {flat} of {contact}");
        let (count, dry_count) = dry_voxels(&surface, &body, |_| true);
        assert!(dry_count * 500 < count, "{off}: {dry_count} of {count}");
        assert_eq!(surface.report.contact.particle_count > 0, off < 1.0, "{off}");
        // If voids are not filled, the gap below particles at a distance from the faces stays.
        if off > 3.0 {
            let open = skinned(particles, &body, 0.0);
            let flat = |distances: Vec<f64>| distances.iter().filter(|d| d.abs() < 0.25).count();
            let flat = flat(check("open", &open, &body));
            assert!(flat * 2 < contact, "{flat} of {contact}");
            assert_eq!(open.report.contact.void_count, 0);
            assert!(surface.report.contact.void_count > 5000);
        }
    }
}

/// The rounded edge at an oblique wall may leave small particles beside it outside the surface: the certificate
/// exempts these, and only these.
#[test]
fn small_particles_beside_a_wall_are_certified() {
    let body = tetrahedron(24.0);
    for off in [0.15, 0.3, 0.45, 0.6, 0.9, 1.2] {
        let mut particles = Vec::new();
        for &triangle in &body.triangles {
            let [a, b, c] = body.corners(triangle);
            let normal = (b - a).cross(c - a).normalize();
            for seed in 0..200 {
                let [u, v] = [random(2 * seed), random(2 * seed + 1)];
                let [u, v] = if u + v > 1.0 { [1.0 - u, 1.0 - v] } else { [u, v] };
                particles.push((a + (b - a) * u + (c - a) * v + normal * off).to_array());
            }
        }
        let options = MethodOptions {
            radius_min: Some(0.9.into()),
            void_threshold: Some(0.0),
            ..MethodOptions::default()
        };
        let settings = Settings::paper(1.0, &options).expect("sound");
        let positions = OwnedPositions::F64(particles);
        let cloud = ParticleCloud { positions, shapes: Shapes::Uniform, attributes: Vec::new() };
        let surface = reconstruct_cloud(cloud, &settings, &body.obstacles());
        let certificate = &surface.report.certificate;
        assert!(certificate.holds(), "{off}: {certificate:?}");
    }
}

/// A drop on a floor touches the floor in a flat disc, and nowhere else.
#[test]
fn drop_lies_flat_on_the_floor() {
    let body = cuboid(DVec3::new(-50.0, -50.0, -20.0), DVec3::new(50.0, 50.0, 0.27));
    let center = DVec3::new(0.2, -0.3, 12.0);
    for gap in [0.0, 2.0] {
        let is_kept = |position: DVec3| position.distance(center) < 18.0 && position.z > 0.27 + gap;
        let surface = skinned(fluid([20, 20, 20], center, is_kept), &body, 2.0);
        let distances = check("drop", &surface, &body);
        let from_axis = |position: DVec3| (position - center).truncate().length();
        // The disc is 27 voxels wide, so its middle part must be wet.
        let (count, dry_count) = dry_voxels(&surface, &body, |position| from_axis(position) < 11.0);
        assert!(count > 300 && dry_count == 0, "{gap}: {dry_count} of {count}");
        let (count, dry_count) = dry_voxels(&surface, &body, |position| from_axis(position) > 19.0);
        assert!(count > 0 && dry_count == count, "{gap}: {dry_count} of {count}");
        let vertices = surface.mesh.positions.iter().map(|position| position.as_dvec3());
        let below: Vec<f64> = distances
            .iter()
            .zip(vertices)
            .filter(|(distance, position)| **distance < 1.0 && from_axis(*position) < 11.0)
            .map(|(distance, _)| *distance)
            .collect();
        assert!(below.len() > 300 && below.iter().all(|distance| distance.abs() < 0.1), "{gap}: {below:?}");
    }
}

/// A ball in a block of fluid, with and without the particles inside it; and a ball entirely inside the
/// fluid.
#[test]
fn ball_in_fluid_leaves_a_hole_of_its_size() {
    for (name, center, margin) in [
        ("half in, cleared", DVec3::new(0.3, 0.2, 12.1), 0.0),
        ("half in, well cleared", DVec3::new(0.3, 0.2, 12.1), 3.0),
        ("half in, full", DVec3::new(0.3, 0.2, 12.1), -99.0),
        ("immersed, full", DVec3::new(0.3, 0.2, 0.1), -99.0),
        ("immersed, cleared", DVec3::new(0.3, 0.2, 0.1), 1.0),
    ] {
        let body = ball(center, 10.3);
        let is_kept = |position: DVec3| position.distance(center) > 10.3 + margin;
        let surface = skinned(fluid([26, 26, 20], DVec3::new(0.0, 0.0, -4.0), is_kept), &body, 2.0);
        check(name, &surface, &body);
        let (count, dry_count) = dry_voxels(&surface, &body, |position| position.z < 5.0);
        assert!(count > 150 && dry_count == 0, "{name}: {dry_count} of {count}");
        assert_eq!(surface.report.contact.particle_count > 0, margin < 0.0, "{name}");
        if name.starts_with("immersed") {
            assert_eq!(surface.report.mesh.component_count, 2, "{name}");
        }
    }
}

/// A plate that is much thinner than a particle, deep in the fluid, where no leaf would be stored without the
/// plate.
#[test]
fn thin_plate_deep_in_fluid_is_resolved() {
    let (min, max) = (DVec3::new(-12.0, -12.0, 0.4), DVec3::new(12.0, 12.0, 1.7));
    let body = cuboid(min, max);
    let surface = skinned(fluid([26, 26, 26], DVec3::ZERO, |_| true), &body, 2.0);
    check("plate", &surface, &body);
    let (count, dry_count) = dry_voxels(&surface, &body, |_| true);
    assert!(count > 500 && dry_count == 0, "{dry_count} of {count}");
    assert_eq!(surface.report.mesh.component_count, 2);
}

/// An offset moves the free surface, but not the part on a wall. A plate thinner than the offset remains in
/// the surface.
#[test]
fn moved_surface_rests_on_the_wall() {
    let floor = cuboid(DVec3::new(-50.0, -50.0, -20.0), DVec3::new(50.0, 50.0, 0.27));
    // The lowest particles are half a spacing above the floor: the gap below them after an offset is narrow
    // enough to be filled.
    let center = DVec3::new(0.2, -0.3, 8.3);
    let particles = fluid([14, 14, 8], center, |position| position.z > 0.27);
    let height = |offset: f64| {
        let surface = skinned_and_moved(particles.clone(), &floor, 2.0, offset);
        let distances = check("moved", &surface, &floor);
        let is_inner = |position: DVec3| (position - center).truncate().abs().max_element() < 8.0;
        let vertices =
            surface.mesh.positions.iter().map(|position| surface.mesh.origin + position.as_dvec3());
        let inner: Vec<(f64, DVec3)> =
            distances.into_iter().zip(vertices).filter(|(_, position)| is_inner(*position)).collect();
        let below: Vec<f64> =
            inner.iter().filter(|(_, position)| position.z < 5.0).map(|(distance, _)| *distance).collect();
        assert!(
            below.len() > 150 && below.iter().all(|distance| distance.abs() < 0.05),
            "{offset}: {below:?}"
        );
        let above: Vec<f64> =
            inner.iter().filter(|(_, position)| position.z > 5.0).map(|(_, position)| position.z).collect();
        above.iter().sum::<f64>() / above.len() as f64
    };
    let plain = height(0.0);
    for offset in [-1.7, -0.8, 1.1, 2.0] {
        assert!((height(offset) - plain - offset).abs() < 0.1, "{offset}: {} {plain}", height(offset));
    }
    let plate = cuboid(DVec3::new(-12.0, -12.0, 0.4), DVec3::new(12.0, 12.0, 1.7));
    for offset in [-1.7, 1.5] {
        let surface = skinned_and_moved(fluid([26, 26, 26], DVec3::ZERO, |_| true), &plate, 2.0, offset);
        check("plate", &surface, &plate);
        let (count, dry_count) = dry_voxels(&surface, &plate, |_| true);
        assert!(count > 500 && dry_count == 0, "{offset}: {dry_count} of {count}");
        assert_eq!(surface.report.mesh.component_count, 2);
    }
}

/// A floor with its top through the origin: across the contact line, along it, and upward.
struct Floor {
    body: Body,
    axes: [DVec3; 3],
}

fn floor(rotation: DQuat) -> Floor {
    let Body { positions, triangles, .. } =
        cuboid(DVec3::new(-80.0, -80.0, -30.0), DVec3::new(80.0, 80.0, 0.0));
    let positions = positions.iter().map(|position| (rotation * DVec3::from(*position)).to_array()).collect();
    let axes = [DVec3::X, DVec3::Y, DVec3::Z].map(|axis| rotation * axis);
    let distance = Box::new(move |point: DVec3| axes[2].dot(point));
    Floor { body: Body { positions, triangles, distance }, axes }
}

/// φ at a point, in voxels; outside where it is not stored.
fn phi_at(surface: &FrameSurface, index: DVec3) -> f64 {
    let cell = index.floor();
    let part = index - cell;
    (0..8)
        .map(|corner| {
            let step = DVec3::new(f64::from(corner & 1), f64::from(corner >> 1 & 1), f64::from(corner >> 2));
            let stored = surface.band.topology.find_voxel((cell + step).as_ivec3());
            let value = stored.map_or(3.0, |(leaf, local)| {
                f64::from(surface.band.phi.leaves[leaf].values[offset_in_leaf(local)])
            });
            (step * part + (1.0 - step) * (1.0 - part)).element_product() * value
        })
        .sum()
}

/// How far the fluid reaches across a floor, at a height above it: along the contact line, at points `step`
/// apart. In world units, from the level set and from the mesh.
fn contact_lines(surface: &FrameSurface, floor: &Floor, h: f64, height: f64, along: &[f64]) -> [Vec<f64>; 2] {
    let [across_axis, along_axis, up] = floor.axes;
    let of_phi = |&along: &f64| {
        let at = |across: f64| phi_at(surface, (across_axis * across + along_axis * along + up * height) / h);
        let mut across = 10.0;
        while at(across) >= 0.0 && across > -10.0 {
            across -= 0.1 * h;
        }
        let (inner, outer) = (at(across), at(across + 0.1 * h));
        across + 0.1 * h * inner / (inner - outer)
    };
    let mut segments = Vec::new();
    for triangle in &surface.mesh.triangles {
        let corners = triangle.map(|corner| {
            let world = surface.mesh.origin + surface.mesh.positions[corner as usize].as_dvec3();
            DVec3::new(across_axis.dot(world), along_axis.dot(world), up.dot(world) - height)
        });
        let cut = |one: DVec3, other: DVec3| one.lerp(other, one.z / (one.z - other.z));
        let ends: Vec<DVec3> = (0..3)
            .map(|edge| [corners[edge], corners[(edge + 1) % 3]])
            .filter(|[one, other]| (one.z < 0.0) != (other.z < 0.0))
            .map(|[one, other]| cut(one, other))
            .collect();
        if let [one, other] = ends[..] {
            segments.push([one, other]);
        }
    }
    let of_mesh = |&along: &f64| {
        let spanning = segments.iter().filter(|[one, other]| (one.y < along) != (other.y < along));
        let crossings = spanning.map(|[one, other]| one.lerp(*other, (along - one.y) / (other.y - one.y)).x);
        crossings.fold(f64::NEG_INFINITY, f64::max)
    };
    [along.iter().map(of_phi).collect(), along.iter().map(of_mesh).collect()]
}

/// Rms of the deviation of a line from its mean over `count` points.
fn roughness(line: &[f64], count: usize) -> f64 {
    let deviations: Vec<f64> = line
        .windows(count)
        .map(|window| window[count / 2] - window.iter().sum::<f64>() / count as f64)
        .collect();
    (deviations.iter().map(|deviation| deviation.powi(2)).sum::<f64>() / deviations.len() as f64).sqrt()
}

/// Where fluid, floor and air meet, the surface has no scallops of a voxel, and does not hover above the
/// floor.
#[test]
fn contact_line_is_smooth_and_on_the_floor() {
    for (name, rotation, layers, h) in [
        ("flat", DQuat::from_rotation_z(0.35), 1, 0.4),
        ("flat and finer", DQuat::from_rotation_z(0.35), 3, 0.25),
        ("sloped", DQuat::from_euler(EulerRot::XYZ, 0.3, 0.2, 0.5), 3, 0.4),
        ("sloped and finer", DQuat::from_euler(EulerRot::XYZ, 0.3, 0.2, 0.5), 1, 0.25),
    ] {
        let floor = floor(rotation);
        // About 1 apart, beside the plane across = 0.
        let place = |index: usize| {
            let jitter = DVec3::new(random(3 * index), random(3 * index + 1), random(3 * index + 2)) - 0.5;
            let [x, y, z] = [index % 6, index / 6 % 24, index / 144].map(|step| step as f64);
            rotation * (DVec3::new(x - 5.5, y - 11.5, z + 0.5) + 0.3 * jitter)
        };
        let particles = (0..144 * layers).map(|index| place(index).to_array()).collect();
        let choices = MethodOptions {
            preset: Some(Preset::Noisy),
            spacing: Some(1.0),
            voxel_size: Some(h.into()),
            ..MethodOptions::default()
        };
        let settings = Settings::resolve(&choices, None).expect("sound");
        let positions = OwnedPositions::F64(particles);
        let cloud = ParticleCloud { positions, shapes: Shapes::Uniform, attributes: Vec::new() };
        let surface = reconstruct_cloud(cloud, &settings, &floor.body.obstacles());
        check(name, &surface, &floor.body);
        let along: Vec<f64> = (-90..=90).map(|step| 0.1 * f64::from(step)).collect();
        let lines = [0.25, 0.5, 1.0].map(|height| contact_lines(&surface, &floor, h, height * h, &along));
        let rough = lines.each_ref().map(|lines| lines.each_ref().map(|line| roughness(line, 31) / h));
        // Where a cell has an edge, contouring places vertices less exactly than interpolation.
        for [of_phi, of_mesh] in rough {
            assert!(of_phi < 0.1 && of_mesh < 0.1, "{name}: {rough:?}");
        }
        for kind in 0..2 {
            let [low, _, high] =
                lines.each_ref().map(|lines| lines[kind].iter().sum::<f64>() / lines[kind].len() as f64);
            // The edge is rounded with a radius of about a voxel.
            assert!(low > high - 1.25 * h, "{name}: hovers, {low} {high}");
        }
    }
}

fn convert(folder: &Path, arguments: &[&str]) -> RunResult {
    meniscus(folder, &[&["convert"], arguments].concat())
}

fn report(path: &Path) -> Value {
    serde_json::from_str(&fs::read_to_string(path).expect("readable")).expect("the report is JSON")
}

/// A block of particles 0.6 wide, and a ball that dips into its side.
fn dipping(folder: &Path, shift: f64) {
    write_ply(&folder.join("dam.1.ply"), &block(8, 0.0));
    fs::write(folder.join("ball.obj"), ball(DVec3::new(0.9 + shift, 0.35, 0.35), 0.3).obj())
        .expect("written");
}

#[test]
fn command_clips_at_obstacles_and_reports_them() {
    let folder = tempdir().expect("a folder");
    let path = folder.path();
    dipping(path, 0.0);
    let arguments = ["dam.1.ply", "--preset", "paper", "--voxel-size", "0.05", "--obstacle", "ball.obj"];
    let arguments = [&arguments[..], &["--out", "o"]].concat();
    let run = |more: &[&str]| convert(path, &[&arguments[..], more].concat());
    let first = run(&["--report", "r.json", "--threads", "1"]);
    assert_eq!(first.status, 0, "{}", first.err);
    assert!(first.err.contains("inside obstacles"), "{}", first.err);
    let frame = &report(&path.join("r.json"))["frames"][0];
    let obstacle_report = &frame["obstacles"];
    assert!(
        obstacle_report["files"].as_str().expect("files").starts_with("ball.obj xxh3-128:"),
        "{obstacle_report}"
    );
    assert!(obstacle_report["particles_inside"].as_u64().expect("a count") > 0, "{obstacle_report}");
    assert!(obstacle_report["void_voxels_filled"].as_u64().expect("a count") > 0, "{obstacle_report}");
    assert!(obstacle_report["deepest_vertex_voxels"].as_f64().expect("a depth") < 0.25, "{obstacle_report}");
    assert_eq!(obstacle_report["open_edges"], 0);
    assert!(frame["certificate"]["holds"].as_bool().expect("a certificate"));
    assert_eq!(run(&["--report", "r.json", "--up", "z", "--vdb", "half"]).status, 0);
    let more = &report(&path.join("r.json"))["settings"][0]["more"];
    let expected = serde_json::json!({"void_threshold": "1", "up": "z", "vdb": "half,blosc"});
    assert_eq!(*more, expected);
    assert_eq!(run(&[]).status, 0);

    let glb = || fs::read(path.join("o/dam.1.glb")).expect("readable");
    let (before, again) = (glb(), run(&["--skip-done"]));
    assert!(again.out.contains("done already"), "{}", again.out);
    assert_eq!(run(&["--threads", "2"]).status, 0);
    assert!(glb() == before, "other bytes on two threads");
    // Another obstacle changes the output, and so does its removal.
    dipping(path, 0.1);
    let moved = run(&["--skip-done"]);
    assert!(!moved.out.contains("done already") && glb() != before, "{}", moved.out);
    let without = ["dam.1.ply", "--preset", "paper", "--voxel-size", "0.05", "--out", "o", "--skip-done"];
    let without = convert(path, &without);
    assert!(!without.out.contains("done already"), "{}", without.out);
}

#[test]
fn obstacle_gives_the_same_surface_in_every_format() {
    let folder = tempdir().expect("a folder");
    let path = folder.path();
    dipping(path, 0.0);
    let body = ball(DVec3::new(0.9, 0.35, 0.35), 0.3);
    // The program makes a mesh and a level set of the ball from particles on its surface.
    let shell: Vec<[f64; 3]> = body.positions.clone();
    write_ply(&path.join("shell.ply"), &shell);
    let made = convert(
        path,
        &["shell.ply", "--voxel-size", "0.03", "--format", "glb,ply,vdb,gltf", "--out", "made"],
    );
    assert_eq!(made.status, 0, "{}", made.err);
    let mut volumes = Vec::new();
    for extension in ["glb", "gltf", "ply", "vdb"] {
        let obstacle = format!("made/shell.{extension}");
        let out = format!("out_{extension}");
        // The mesh of a .glb has y up, and so have the scenes that use it as an obstacle; this scene has z
        // up.
        let report_name = format!("{extension}.json");
        let result = convert(
            path,
            &[
                "dam.1.ply",
                "--voxel-size",
                "0.05",
                "--obstacle",
                &obstacle,
                "--out",
                &out,
                "--report",
                &report_name,
            ],
        );
        assert_eq!(result.status, 0, "{extension}: {}", result.err);
        volumes.push(report(&path.join(report_name))["frames"][0]["volume"].as_f64().expect("a volume"));
    }
    assert!(volumes.iter().all(|volume| (volume / volumes[0] - 1.0).abs() < 0.01), "{volumes:?}");
}

#[test]
fn moving_obstacle_has_a_file_for_each_frame() {
    let folder = tempdir().expect("a folder");
    let path = folder.path();
    for number in 1..=3 {
        write_ply(&path.join(format!("dam.{number}.ply")), &block(6, 0.0));
    }
    for number in 1..=2 {
        let body = ball(DVec3::new(0.6 + 0.05 * f64::from(number), 0.25, 0.25), 0.2);
        fs::write(path.join(format!("body.000{number}.obj")), body.obj()).expect("written");
    }
    let arguments =
        ["dam.#.ply", "--voxel-size", "0.05", "--format", "vdb", "--out", "o", "--on-error", "continue"];
    let all = convert(path, &[&arguments[..], &["--obstacle", "body.####.obj"]].concat());
    assert_eq!(all.status, 1, "{}", all.err);
    // The error appears once, with the frame and the expected file.
    let missing: Vec<&str> = all.err.lines().filter(|line| line.contains("frame 3")).collect();
    let expected =
        "error: dam.3.ply: obstacle body.0003.obj: no such file: body.####.obj has no file for frame 3";
    assert_eq!(missing, [expected], "{}", all.err);
    let vdb = |number: u32| fs::read(path.join(format!("o/dam.{number}.vdb"))).expect("readable");
    assert!(vdb(1) != vdb(2) && !path.join("o/dam.3.vdb").exists());
    for (number, same) in [("1", true), ("2", false)] {
        let one = format!("body.000{number}.obj");
        let again = convert(
            path,
            &["dam.1.ply", "--voxel-size", "0.05", "--format", "vdb", "--out", "p", "--obstacle", &one],
        );
        assert_eq!(again.status, 0, "{}", again.err);
        assert_eq!(fs::read(path.join("p/dam.1.vdb")).expect("readable") == vdb(1), same);
    }
    fs::write(path.join("body.0003.obj"), "v 1 2 3\nv 1 2\n").expect("written");
    let broken = convert(path, &[&arguments[..], &["--obstacle", "body.%04d.obj", "--skip-done"]].concat());
    let message = "dam.3.ply: obstacle body.0003.obj: OBJ, at line 2: ";
    assert_eq!(broken.err.matches(message).count(), 1, "{}", broken.err);
    assert_eq!(broken.out.matches("done already").count(), 2, "{}", broken.out);
}

/// A stage with bodies at time codes.
fn animated(bodies: &[(i64, Body)]) -> String {
    let samples = bodies.iter().fold(String::new(), |mut text, (code, body)| {
        let points: Vec<String> = body.positions.iter().map(|[x, y, z]| format!("({x}, {y}, {z})")).collect();
        write!(text, "{code}: [{}], ", points.join(", ")).expect("strings take everything");
        text
    });
    let triangles = &bodies[0].1.triangles;
    format!(
        "#usda 1.0\ndef Mesh \"body\" {{ point3f[] points.timeSamples = {{ {samples} }} int[] faceVertexCounts = {:?} \
         int[] faceVertexIndices = {:?} }}\n",
        vec![3; triangles.len()],
        triangles.as_flattened()
    )
}

#[test]
fn animated_obstacle_has_a_sample_for_each_frame() {
    let folder = tempdir().expect("a folder");
    let path = folder.path();
    let corner = |number: i64| DVec3::new(0.25 + 0.0625 * number as f64, 0.125, 0.125);
    let body = |number: i64| cuboid(corner(number), corner(number) + 0.25);
    for number in 1..=4 {
        write_ply(&path.join(format!("dam.{number}.ply")), &block(6, 0.0));
        fs::write(path.join(format!("body.{number:04}.obj")), body(number.clamp(2, 3)).obj())
            .expect("written");
    }
    let run = |obstacle: &str, out: &str| {
        let arguments = ["dam.#.ply", "--voxel-size", "0.05", "--format", "vdb", "--skip-done"];
        let result = convert(path, &[&arguments[..], &["--obstacle", obstacle, "--out", out]].concat());
        assert_eq!(result.status, 0, "{}", result.err);
        result.out.matches("done already").count()
    };
    let vdb = |out: &str, number: i64| {
        let bytes = fs::read(path.join(format!("{out}/dam.{number}.vdb"))).expect("readable");
        meniscus_formats::vdb::read_level_set(&bytes, None, &Default::default()).expect("a level set").leaves
    };
    // The first and the last sample hold.
    fs::write(path.join("body.usda"), animated(&[(2, body(2)), (3, body(3))])).expect("written");
    assert_eq!((run("body.usda", "o"), run("body.####.obj", "p")), (0, 0));
    assert!((1..=4).all(|number| vdb("o", number) == vdb("p", number)));
    assert!(vdb("o", 2) != vdb("o", 3));
    // A longer animation changes only the frames whose meshes it changes.
    let longer = animated(&[(2, body(2)), (3, body(3)), (4, body(1)), (5, body(2))]);
    fs::write(path.join("body.usda"), longer).expect("written");
    let before = vdb("o", 4);
    assert_eq!(run("body.usda", "o"), 3);
    assert!(vdb("o", 4) != before);
    // The layers of a stage belong to the obstacle, with and without an animation.
    for still in [false, true] {
        let root = "#usda 1.0\n( subLayers = [@./layer.usda@] )\n";
        fs::write(path.join("root.usda"), root).expect("written");
        let bodies =
            |number: i64| if still { vec![(1, body(number))] } else { vec![(1, body(1)), (2, body(number))] };
        let out = if still { "still" } else { "moving" };
        for (number, done) in [(2, 0), (2, 4), (3, if still { 0 } else { 1 })] {
            fs::write(path.join("layer.usda"), animated(&bodies(number))).expect("written");
            assert_eq!(run("root.usda", out), done, "{out} {number}");
        }
    }
    fs::remove_file(path.join("layer.usda")).expect("removed");
    let missing =
        convert(path, &["dam.1.ply", "--voxel-size", "0.05", "--out", "o", "--obstacle", "root.usda"]);
    assert!(missing.status != 0 && missing.err.contains("refers to the layer layer.usda"), "{}", missing.err);
    // A frame without a number has no sample.
    fs::write(path.join("dam.ply"), fs::read(path.join("dam.1.ply")).expect("read")).expect("written");
    let unnumbered =
        convert(path, &["dam.ply", "--voxel-size", "0.05", "--out", "o", "--obstacle", "body.usda"]);
    assert!(
        unnumbered.status != 0 && unnumbered.err.contains("the frame has no number"),
        "{}",
        unnumbered.err
    );
}

#[test]
fn invalid_obstacle_is_an_error() {
    let folder = tempdir().expect("a folder");
    let path = folder.path();
    dipping(path, 0.0);
    let arguments = ["dam.1.ply", "--voxel-size", "0.05", "--format", "vdb", "--out", "o", "--obstacle"];
    let missing = convert(path, &[&arguments[..], &["bal.obj"]].concat());
    assert_eq!(missing.status, 2);
    assert!(
        missing.err.contains("bal.obj: obstacle not found") && !path.join("o").exists(),
        "{}",
        missing.err
    );
    let in_folder = convert(path, &[&arguments[..], &["."]].concat());
    assert!(
        in_folder.status == 2 && in_folder.err.contains("a folder, not an obstacle"),
        "{}",
        in_folder.err
    );
    #[cfg(unix)]
    {
        let device = convert(path, &[&arguments[..], &["/dev/zero"]].concat());
        assert_eq!((device.status, device.err.lines().count()), (2, 1), "{}", device.err);
        assert!(device.err.contains("obstacle /dev/zero: not a regular file: a device"), "{}", device.err);
    }
    fs::write(path.join("empty.obj"), "").expect("written");
    let empty = convert(path, &[&arguments[..], &["empty.obj"]].concat());
    assert!(empty.err.contains("obstacle empty.obj: the file is empty"), "{}", empty.err);
    // A file that is certainly no obstacle is refused once, and not for each frame.
    let err = convert(path, &[&["dam.#.ply"][..], &arguments[1..], &["dam.1.ply"]].concat()).err;
    assert!(err.contains("no triangle") && err.lines().count() == 1, "{err}");
    let mut open = ball(DVec3::new(0.9, 0.35, 0.35), 0.3);
    open.triangles.truncate(open.triangles.len() - 100);
    fs::write(path.join("open.obj"), open.obj()).expect("written");
    let open = convert(path, &[&arguments[..], &["open.obj", "--report", "r.json"]].concat());
    assert_eq!(open.status, 0, "{}", open.err);
    assert!(open.err.contains("obstacle open.obj: ") && open.err.contains("open edges"), "{}", open.err);
    assert!(report(&path.join("r.json"))["frames"][0]["obstacles"]["open_edges"].as_u64() > Some(0));
}

/// An obstacle with other units or axes is valid, but probably a mistake.
#[test]
fn obstacle_out_of_reach_causes_a_warning() {
    let folder = tempdir().expect("a folder");
    let path = folder.path();
    for number in [1, 2] {
        write_ply(&path.join(format!("dam.{number}.ply")), &block(4, 0.1));
    }
    let warning_count = |name: &str, body: &Body| {
        fs::write(path.join(name), body.obj()).expect("written");
        let arguments =
            ["dam.#.ply", "--voxel-size", "0.05", "--format", "vdb", "--out", "o", "--report", "r.json"];
        let result = convert(path, &[&arguments[..], &["--preset", "paper", "--obstacle", name]].concat());
        assert_eq!(result.status, 0, "{}", result.err);
        let notes = |frame: usize| {
            report(&path.join("r.json"))["frames"][frame]["notes"].to_string().contains("too far from")
        };
        assert_eq!(notes(0), notes(1), "each frame has it in the report");
        (result.err.matches("too far from the particles to have an effect").count(), result.err)
    };
    // Obstacles just within reach of the particles, and just beyond it: r_max is 2√3 voxels.
    let at = |x: f64| cuboid(DVec3::new(x, -1.0, -1.0), DVec3::new(x + 1.0, 1.0, 1.0));
    assert_eq!(warning_count("near.obj", &at(0.4 + 0.05 * (12f64.sqrt() + 3.9))).0, 0);
    let (count, err) = warning_count("far.obj", &at(0.4 + 0.05 * (12f64.sqrt() + 4.1)));
    assert_eq!(count, 1, "once for a sequence: {err}");
    assert!(
        err.contains("dam.1.ply: obstacle far.obj: too far")
            && err.contains("the particles span (0.1, 0, 0) to (0.4,"),
        "{err}"
    );
}

/// A plane as a floor has the same effect as a box: the fluid rests on it, in one piece.
#[test]
fn plane_is_a_floor_that_is_solid_behind_its_normals() {
    let folder = tempdir().expect("a folder");
    let path = folder.path();
    write_ply(&path.join("dam.1.ply"), &block(6, 0.0));
    let (min, max) = (DVec3::new(-3.0, -3.0, -4.0), DVec3::new(3.0, 3.0, 0.2));
    let floor = cuboid(min, max);
    let mut plane = cuboid(min, max);
    let is_top =
        |triangle: &[u32; 3]| triangle.iter().all(|&corner| floor.positions[corner as usize][2] == max.z);
    plane.triangles.retain(is_top);
    let below =
        Body { triangles: plane.triangles.iter().map(|&[a, b, c]| [a, c, b]).collect(), ..cuboid(min, max) };
    // An open sheet that faces all ways.
    let at = |index: u32| {
        let angle = TAU * f64::from(index / 2) / 12.0;
        [0.25 + angle.cos(), 0.25 + angle.sin(), 0.2 + 0.05 * f64::from(index % 2)]
    };
    let side = |index: u32| {
        let [a, b] = [2 * index, (2 * index + 2) % 24];
        [[a, b, b + 1], [a, b + 1, a + 1]]
    };
    let ring = Body {
        positions: (0..24).map(at).collect(),
        triangles: (0..12).flat_map(side).collect(),
        ..cuboid(min, max)
    };
    for (name, body) in [("floor", &floor), ("plane", &plane), ("below", &below), ("ring", &ring)] {
        fs::write(path.join(format!("{name}.obj")), body.obj()).expect("written");
    }
    let run = |name: &str| {
        let obstacle = format!("{name}.obj");
        let common = ["dam.1.ply", "--voxel-size", "0.03", "--format", "obj", "--out", name];
        convert(path, &[&common[..], &["--obstacle", &obstacle, "--report", "r.json"]].concat())
    };
    let frame = |name: &str| {
        let result = run(name);
        assert_eq!(result.status, 0, "{}", result.err);
        (report(&path.join("r.json"))["frames"][0].clone(), result.err)
    };
    let (on_floor, _) = frame("floor");
    let (on_plane, err) = frame("plane");
    assert_eq!(on_plane["components"], 1, "{on_plane}");
    let volume = |frame: &Value| frame["volume"].as_f64().expect("a volume");
    assert!((volume(&on_plane) / volume(&on_floor) - 1.0).abs() < 1e-3, "{on_plane} {on_floor}");
    assert!(err.contains("obstacle plane.obj: the mesh has 1 open sheet, taken as solid behind"), "{err}");
    assert_eq!(on_plane["obstacles"]["open_edges"], 0);
    assert!(volume(&frame("below").0) < volume(&on_floor), "the other side is solid");
    let refused = run("ring");
    assert_eq!(refused.status, 2, "{}", refused.err);
    assert!(
        refused.err.contains("obstacle ring.obj: the mesh has")
            && refused.err.contains("give it a thickness"),
        "{}",
        refused.err
    );
}

/// The error names the file and the vertex.
#[test]
fn obstacle_too_far_from_the_origin_is_refused() {
    let folder = tempdir().expect("a folder");
    let path = folder.path();
    write_ply(&path.join("dam.1.ply"), &block(4, 0.0));
    let mut far = cuboid(DVec3::splat(-1.0), DVec3::splat(0.1));
    far.positions[3] = [1e18, 0.0, -2.5];
    fs::write(path.join("near.obj"), cuboid(DVec3::splat(-1.0), DVec3::splat(0.1)).obj()).expect("written");
    fs::write(path.join("far.obj"), far.obj()).expect("written");
    let obstacles = ["--obstacle", "near.obj", "--obstacle", "far.obj"];
    let result =
        convert(path, &[&["dam.1.ply", "--voxel-size", "0.05", "--out", "o"], &obstacles[..]].concat());
    assert_eq!(result.status, 2, "{}", result.err);
    let message = "dam.1.ply: obstacle far.obj: the vertex (1e18, 0, -2.5) is too far from the origin";
    assert!(result.err.contains(message), "{}", result.err);
}

/// A surface can vanish in an obstacle, beyond a box, or as islands. Then the output is written, with a
/// warning that gives the reason.
#[test]
fn empty_surface_causes_a_warning_with_the_reason() {
    let folder = tempdir().expect("a folder");
    let path = folder.path();
    write_ply(&path.join("dam.1.ply"), &block(4, 0.0));
    fs::write(path.join("ball.obj"), ball(DVec3::splat(0.15), 3.0).obj()).expect("written");
    let arguments =
        ["dam.1.ply", "--voxel-size", "0.05", "--format", "obj", "--out", "o", "--report", "r.json"];
    let box_beyond = ["--clip", "5,5,5,6,6,6"];
    let ball = ["--obstacle", "ball.obj"];
    for (more, word) in [
        (&box_beyond[..], "the clip box contains no part of the surface"),
        (&["--drop-islands", "100"], "every piece of the surface was dropped"),
        (&ball, "all of the surface is inside obstacles"),
        (&[ball, box_beyond].concat(), "all of the surface is inside obstacles"),
        (&["--memory", "2MiB", "--clip", "5,5,5,6,6,6"], "the clip box contains no part"),
    ] {
        let result = convert(path, &[&arguments, more].concat());
        assert_eq!(result.status, 0, "{}", result.err);
        assert_eq!(result.err.matches(word).count(), 1, "{more:?}: {}", result.err);
        let frame = &report(&path.join("r.json"))["frames"][0];
        let notes: Vec<&str> =
            frame["notes"].as_array().expect("notes").iter().filter_map(Value::as_str).collect();
        assert!(notes.iter().any(|note| note.contains(word)), "{more:?}: {notes:?}");
        assert_eq!((&frame["vertices"], &frame["status"]), (&0.into(), &"converted".into()), "{more:?}");
        assert!(path.join("o/dam.1.obj").exists());
    }
    let all = convert(path, &[&arguments[..], &["--clip", "-5,-5,-5,0.1,5,5"]].concat());
    assert!(!all.err.contains("no part of the surface"), "{}", all.err);
}

/// A second run of `watch --once` converts nothing until the obstacle changes.
#[test]
fn daemon_records_the_obstacles_of_its_outputs() {
    let folder = tempdir().expect("a folder");
    let path = folder.path();
    fs::create_dir(path.join("in")).expect("made");
    write_ply(&path.join("in/dam.1.ply"), &block(6, 0.0));
    let write_obstacle = |x: f64| {
        fs::write(path.join("ball.obj"), ball(DVec3::new(x, 0.25, 0.25), 0.2).obj()).expect("written");
    };
    write_obstacle(0.6);
    let run = || {
        let arguments = [
            "watch",
            "in",
            "--out",
            "o",
            "--once",
            "--voxel-size",
            "0.05",
            "--obstacle",
            "ball.obj",
            "--settle",
            "1ms",
        ];
        let result = meniscus(path, &arguments);
        assert_eq!(result.status, 0, "{} {}", result.out, result.err);
        fs::metadata(path.join("o/dam.1.vdb")).expect("the output").modified().expect("a time")
    };
    let first = run();
    assert_eq!(run(), first);
    write_obstacle(0.7);
    let second = run();
    assert!(second > first);
    assert_eq!(run(), second);
}
