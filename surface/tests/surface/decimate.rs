//! Decimated meshes: within the error in both directions, closed and manifold, and with the same shape.

use std::collections::HashSet;

use glam::{DVec3, IVec3, Vec3};
use meniscus_surface::contour::{Contouring, contour};
use meniscus_surface::edits::{VoxelClip, clip};
use meniscus_surface::mesh::{DecimateReport, Mesh, MeshMeasures, decimate};

use super::bands::{band, block_band, sphere, torus};
use super::{BOTH, Random, UNIT, checked_contour};

/// Decimates a copy of a sound mesh, and checks every guarantee.
fn decimated(mesh: &Mesh, error: f64) -> (Mesh, MeshMeasures, DecimateReport) {
    let mut copy = mesh.clone();
    let report = decimate(&mut copy, error);
    let (before, after) = (mesh.measure(), copy.measure());
    assert!(after.is_closed_manifold(), "{after:?}");
    assert_eq!(after.component_count, before.component_count);
    assert_eq!(after.euler_characteristic, before.euler_characteristic);
    assert_eq!(report.removed_vertex_count, before.vertex_count - after.vertex_count);
    assert_eq!(report.removed_triangle_count, before.triangle_count - after.triangle_count);
    assert!(report.error_world_max <= error);
    assert!((after.volume - before.volume).abs() <= before.area * report.error_world_max * 1.5);
    // The vertices are a subset of the original ones, with their normals, in order.
    let mut old = mesh.positions.iter().zip(&mesh.normals);
    assert!(copy.positions.iter().zip(&copy.normals).all(|new| old.any(|old| old == new)));
    (copy, after, report)
}

/// The distance from a point to a triangle.
fn distance_to_triangle(p: DVec3, [a, b, c]: [DVec3; 3]) -> f64 {
    let normal = (b - a).cross(c - a);
    let inside =
        [[a, b], [b, c], [c, a]].iter().all(|[from, to]| normal.cross(to - from).dot(p - from) >= 0.0);
    if inside && normal.length() > 0.0 {
        return ((p - a).dot(normal) / normal.length()).abs();
    }
    let to_edge = |[from, to]: [DVec3; 2]| {
        let part = ((p - from).dot(to - from) / (to - from).length_squared()).clamp(0.0, 1.0);
        p.distance(from.lerp(to, part))
    };
    to_edge([a, b]).min(to_edge([b, c])).min(to_edge([c, a]))
}

fn corners(mesh: &Mesh, triangle: [u32; 3]) -> [DVec3; 3] {
    triangle.map(|vertex| mesh.positions[vertex as usize].as_dvec3())
}

/// The largest distance of one surface, sampled at many points per triangle, from another.
fn farthest(from: &Mesh, to: &Mesh) -> f64 {
    let targets: Vec<[DVec3; 3]> = to.triangles.iter().map(|&triangle| corners(to, triangle)).collect();
    let mut farthest = 0.0f64;
    for &triangle in &from.triangles {
        let [a, b, c] = corners(from, triangle);
        // With this many points, every part of the surface is within 0.2 of a point.
        let steps = (a.distance(b).max(b.distance(c)).max(c.distance(a)) / 0.4).ceil().max(2.0) as usize;
        let (middle, size) = ((a + b + c) / 3.0, a.distance(b).max(b.distance(c)).max(c.distance(a)));
        let near: Vec<&[DVec3; 3]> = targets
            .iter()
            .filter(|[d, e, f]| {
                let reach = size + d.distance(*e).max(e.distance(*f)).max(f.distance(*d)) + 1.0;
                middle.distance(*d) < reach
            })
            .collect();
        for i in 0..=steps {
            for j in 0..=steps - i {
                let point = a + ((b - a) * i as f64 + (c - a) * j as f64) / steps as f64;
                let nearest = near.iter().map(|target| distance_to_triangle(point, **target));
                farthest = farthest.max(nearest.fold(f64::INFINITY, f64::min));
            }
        }
    }
    farthest
}

#[test]
fn balls_and_tori_stay_within_the_error_both_ways() {
    let ball = band(IVec3::splat(-16), IVec3::splat(16), sphere([0.3, -0.2, 0.41], 11.3));
    let ring = band(IVec3::splat(-24), IVec3::splat(24), torus([0.3, -0.2, 0.41], 11.3, 5.2));
    for (scene, contouring, errors) in [
        (&ball, Contouring::Dual, &[(0.05, 0.7), (0.15, 0.4), (0.4, 0.2)][..]),
        (&ring, Contouring::Dual, &[(0.15, 0.4)]),
        (&ball, Contouring::Tetrahedra, &[(0.15, 0.15)]),
    ] {
        let (mesh, before) = checked_contour(scene, &UNIT, contouring);
        for &(error, left_most) in errors {
            let (thin, after, report) = decimated(&mesh, error);
            let left = after.triangle_count as f64 / before.triangle_count as f64;
            assert!(left < left_most, "{error}: {left}");
            let there = farthest(&mesh, &thin);
            let back = farthest(&thin, &mesh);
            assert!(there.max(back) <= report.error_world_max, "{error}: {there} {back} {report:?}");
            // Decimation must use a good part of the allowed error.
            assert!(there.max(back) >= 0.3 * error, "{error}: {there} {back}");
        }
    }
}

#[test]
fn flat_caps_become_few_triangles() {
    let mut ball = band(IVec3::splat(-40), IVec3::splat(40), sphere([0.3, -0.2, 0.4], 30.0));
    let clip_box = VoxelClip { min: DVec3::splat(-15.3), max: DVec3::splat(15.6) };
    clip(&mut ball, &UNIT, &clip_box);
    let (mesh, before) = checked_contour(&ball, &UNIT, Contouring::Dual);
    let (_, after, _) = decimated(&mesh, 0.15);
    assert!(
        after.triangle_count * 6 < before.triangle_count,
        "{} of {}",
        after.triangle_count,
        before.triangle_count
    );
    assert!((after.volume / before.volume - 1.0).abs() < 1e-3);
}

#[test]
fn noise_stays_sound() {
    let mut random = Random(11);
    for round in 0..40 {
        let values: Vec<f32> = (0..16 * 16 * 16).map(|_| random.next() - 0.5).collect();
        let noise = block_band(IVec3::splat(round - 20), IVec3::splat(16), &values);
        for contouring in BOTH {
            let (mesh, _) = checked_contour(&noise, &UNIT, contouring);
            for error in [0.1, 1e30] {
                decimated(&mesh, error);
            }
        }
    }
}

fn plain(positions: &[[f32; 3]], triangles: &[[u32; 3]]) -> Mesh {
    let positions: Vec<Vec3> = positions.iter().map(|&position| Vec3::from(position)).collect();
    Mesh {
        normals: vec![Vec3::Z; positions.len()],
        positions,
        triangles: triangles.to_vec(),
        ..Mesh::default()
    }
}

#[test]
fn meshes_that_cannot_be_decimated_stay() {
    const CORNERS: [[f32; 3]; 5] =
        [[0.0; 3], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [f32::NAN; 3]];
    const TETRAHEDRON: [[u32; 3]; 4] = [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]];
    let with_reversed_triangle = [[0, 1, 2], [0, 1, 3], [0, 3, 2], [1, 2, 3]];
    let doubled = [TETRAHEDRON, TETRAHEDRON].concat();
    for (positions, triangles) in [
        (&CORNERS[..0], &[][..]),
        (&CORNERS[..4], &TETRAHEDRON),
        (&CORNERS[..4], &TETRAHEDRON[1..]),
        (&CORNERS[..4], &with_reversed_triangle),
        (&CORNERS[..4], &doubled),
        (&CORNERS[..4], &[[0, 0, 1], [1, 1, 1], [0, 1, 2]]),
        (&CORNERS[1..], &TETRAHEDRON),
    ] {
        let mesh = plain(positions, triangles);
        for error in [-1.0, 0.0, f64::NAN, 10.0, f64::INFINITY] {
            let mut copy = mesh.clone();
            assert_eq!(decimate(&mut copy, error).removed_triangle_count, 0);
            let sorted = |mesh: &Mesh| {
                let mut triangles = mesh.triangles.clone();
                triangles.iter_mut().for_each(|t| {
                    let least = (0..3).min_by_key(|&corner| t[corner]).unwrap_or(0);
                    t.rotate_left(least);
                });
                triangles.sort_unstable();
                triangles
            };
            assert_eq!(sorted(&copy), sorted(&mesh), "{triangles:?} {error}");
        }
    }
    // An open sheet keeps its boundary and loses its interior vertices.
    let grid = |n: u32| -> Vec<[u32; 3]> {
        (0..n * n)
            .flat_map(|cell| {
                let corner = cell / n * (n + 1) + cell % n;
                [[corner, corner + n + 1, corner + 1], [corner + 1, corner + n + 1, corner + n + 2]]
            })
            .collect()
    };
    let points: Vec<[f32; 3]> = (0..11 * 11).map(|k| [(k / 11) as f32, (k % 11) as f32, 0.0]).collect();
    let mut sheet = plain(&points, &grid(10));
    decimate(&mut sheet, 0.01);
    let measures = sheet.measure();
    assert_eq!((measures.boundary_edge_count, measures.non_manifold_edge_count), (40, 0));
    assert!(measures.triangle_count < 120 && (measures.area - 100.0).abs() < 1e-3, "{measures:?}");
    // Vertices that are not finite do not prevent decimation.
    let ball = band(IVec3::splat(-16), IVec3::splat(16), sphere([0.3, -0.2, 0.41], 11.3));
    let mut torn = contour(&ball, &UNIT, Contouring::Dual);
    torn.positions[17] = Vec3::NAN;
    torn.positions[170] = Vec3::splat(f32::MAX);
    decimate(&mut torn, 0.1);
    assert_eq!(torn.positions.iter().filter(|position| !position.is_finite()).count(), 1);
    assert!(torn.triangles.len() < 2400, "{}", torn.triangles.len());
}

/// The triangles, each as the bits of the positions of its corners.
fn shapes(mesh: &Mesh, is_wanted: impl Fn(Vec3) -> bool) -> HashSet<[[u32; 3]; 3]> {
    let near =
        |triangle: &&[u32; 3]| triangle.iter().all(|&vertex| is_wanted(mesh.positions[vertex as usize]));
    let bits = |&triangle: &[u32; 3]| {
        let mut corners = triangle.map(|vertex| mesh.positions[vertex as usize].to_array().map(f32::to_bits));
        let least = (0..3).min_by_key(|&corner| corners[corner]).unwrap_or(0);
        corners.rotate_left(least);
        corners
    };
    mesh.triangles.iter().filter(near).map(bits).collect()
}

#[test]
fn threads_and_far_changes_do_not_matter() {
    // Two bars that are the same at one end; at the other end, one of them has a bump.
    let bar = |bump: f64| {
        move |[x, y, z]: [f64; 3]| {
            let thick = 5.3 + bump * (-((x - 70.0) / 8.0).powi(2)).exp() + 0.8 * (0.3 * x).sin();
            (y * y + z * z).sqrt().mul_add(1.0, -thick).max(x.abs() - 90.3)
        }
    };
    let mesh = |bump: f64, threads: usize| {
        let scene = band(IVec3::new(-96, -24, -24), IVec3::new(96, 24, 24), bar(bump));
        let mut mesh = contour(&scene, &UNIT, Contouring::Dual);
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("a pool");
        pool.install(|| decimate(&mut mesh, 0.15));
        mesh
    };
    let (plain, again, bumped) = (mesh(0.0, 1), mesh(0.0, 3), mesh(3.0, 2));
    assert!(plain == again);
    let near = |position: Vec3| position.x < 0.0;
    assert!(shapes(&plain, near).len() > 300);
    assert!(shapes(&plain, near) == shapes(&bumped, near));
    assert!(shapes(&plain, |_| true) != shapes(&bumped, |_| true));
}
