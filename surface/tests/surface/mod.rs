//! Checks that meshes are sound and in the right position.
//!
//! Every mesh here first passes [`checked_contour`]: closed, manifold, without degenerate triangles, oriented
//! outward, with unit normals.

mod bands;
mod decimate;
mod quads;
mod refine;
mod trim;

use std::f64::consts::PI;

use bands::{band, block_band, moved, sphere, torus};
use glam::{DVec3, IVec3, Vec3};
use meniscus_surface::contour::{Contouring, contour};
use meniscus_surface::level_set::NarrowBand;
use meniscus_surface::mesh::{Mesh, MeshMeasures};
use meniscus_surface::space::Lattice;

const UNIT: Lattice = Lattice { voxel_size: 1.0 };
const BOTH: [Contouring; 2] = [Contouring::Dual, Contouring::Tetrahedra];

/// The mesh of a band and its measures. Checks all guarantees that hold for any φ.
fn checked_contour(band: &NarrowBand, lattice: &Lattice, contouring: Contouring) -> (Mesh, MeshMeasures) {
    let mesh = contour(band, lattice, contouring);
    let measures = mesh.measure();
    assert!(measures.is_closed_manifold(), "{contouring:?}: {measures:?}");
    assert!(mesh.triangles.iter().all(|[a, b, c]| a != b && b != c && c != a));
    assert_eq!(mesh.normals.len(), mesh.positions.len());
    for normal in &mesh.normals {
        assert!((normal.as_dvec3().length() - 1.0).abs() < 1e-6, "{contouring:?}: normal {normal}");
    }
    let mut is_used = vec![false; mesh.positions.len()];
    mesh.triangles.iter().flatten().for_each(|&vertex| is_used[vertex as usize] = true);
    assert!(is_used.into_iter().all(|is_used| is_used), "{contouring:?}: a vertex without triangles");
    (mesh, measures)
}

/// Uniform numbers from 0 to 1 (SplitMix64).
struct Random(u64);

impl Random {
    fn next(&mut self) -> f32 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut bits = self.0;
        bits = (bits ^ bits >> 30).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        bits = (bits ^ bits >> 27).wrapping_mul(0x94d0_49bb_1331_11eb);
        ((bits ^ bits >> 31) >> 40) as f32 / (1u64 << 24) as f32
    }
}

#[test]
fn sphere_is_at_the_right_position() {
    let (center, radius) = ([0.3, -0.2, 0.41], 20.3);
    let band = band(IVec3::splat(-32), IVec3::splat(32), sphere(center, radius));
    for (contouring, rms_limit, max_limit) in
        [(Contouring::Dual, 0.001, 0.01), (Contouring::Tetrahedra, 0.001, 0.02)]
    {
        let (mesh, measures) = checked_contour(&band, &UNIT, contouring);
        let (mut error_squares, mut error_max, mut angle_squares) = (0.0, 0.0f64, 0.0);
        for (position, normal) in mesh.positions.iter().zip(&mesh.normals) {
            let outward = position.as_dvec3() - DVec3::from_array(center);
            let error = outward.length() - radius;
            error_squares += error * error;
            error_max = error_max.max(error.abs());
            angle_squares += outward.normalize().cross(normal.as_dvec3()).length_squared();
        }
        let count = mesh.positions.len() as f64;
        assert!((error_squares / count).sqrt() < rms_limit);
        assert!(error_max < max_limit);
        assert!((angle_squares / count).sqrt().to_degrees() < 0.05);
        assert_eq!((measures.component_count, measures.euler_characteristic), (1, 2));
        assert!((measures.volume / (4.0 / 3.0 * PI * radius.powi(3)) - 1.0).abs() < 0.002);
        assert!((measures.area / (4.0 * PI * radius.powi(2)) - 1.0).abs() < 0.001);
        if contouring == Contouring::Dual {
            assert!((measures.bending_energy / (4.0 * PI) - 1.0).abs() < 0.005);
            assert!(least_angle(&mesh) > 8.0);
        }
    }
}

/// The least angle of a mesh's triangles in degrees.
fn least_angle(mesh: &Mesh) -> f32 {
    let angles = mesh.triangles.iter().flat_map(|triangle| {
        let points = triangle.map(|vertex| mesh.positions[vertex as usize]);
        (0..3).map(move |k| {
            let [a, b, c] = [0, 1, 2].map(|step| points[(k + step) % 3]);
            (b - a).angle_between(c - a).to_degrees()
        })
    });
    angles.fold(180.0, f32::min)
}

#[test]
fn torus_has_a_hole_and_its_bending_energy() {
    let (major, minor) = (24.0f64, 9.6);
    let center = [0.3, 0.2, 0.1];
    let band = band(IVec3::new(-42, -42, -18), IVec3::new(42, 42, 18), torus(center, major, minor));
    let ratio: f64 = major / minor;
    let willmore = PI * PI * ratio * ratio / (ratio * ratio - 1.0).sqrt();
    for contouring in BOTH {
        let (_, measures) = checked_contour(&band, &UNIT, contouring);
        assert_eq!((measures.component_count, measures.euler_characteristic), (1, 0));
        assert!((measures.volume / (2.0 * PI * PI * major * minor * minor) - 1.0).abs() < 0.004);
        if contouring == Contouring::Dual {
            assert!(
                (measures.bending_energy / willmore - 1.0).abs() < 0.01,
                "{}",
                measures.bending_energy / willmore
            );
        }
    }
}

#[test]
fn errors_shrink_with_the_voxel_size() {
    for contouring in BOTH {
        let errors = [8.0, 16.0, 32.0].map(|voxels| {
            let lattice = Lattice { voxel_size: 1.0 / voxels };
            let extent = IVec3::splat(voxels as i32 + 12);
            let band = band(-extent, extent, sphere([0.3, -0.2, 0.41], voxels));
            let (_, measures) = checked_contour(&band, &lattice, contouring);
            [measures.volume / (4.0 / 3.0 * PI) - 1.0, measures.area / (4.0 * PI) - 1.0].map(f64::abs)
        });
        for pair in errors.windows(2) {
            // The error is of second order: half the voxel size gives about a quarter.
            assert!(pair[1][0] < 0.35 * pair[0][0] && pair[1][1] < 0.45 * pair[0][1], "{errors:?}");
        }
    }
}

#[test]
fn scenes_are_sound() {
    /// A name; the number of pieces and the Euler characteristic, if they are known; φ.
    type Scene = (&'static str, Option<(usize, i64)>, Box<dyn Fn([f64; 3]) -> f64>);
    let ball = |x: f64, radius: f64| sphere([x, 0.3, -0.4], radius);
    let gyroid = |[x, y, z]: [f64; 3]| {
        let [x, y, z] = [x, y, z].map(|coordinate| coordinate / 4.0);
        4.0 * (x.sin() * y.cos() + y.sin() * z.cos() + z.sin() * x.cos())
    };
    let in_ball = move |phi: f64, point: [f64; 3]| phi.max(ball(0.2, 17.0)(point));
    let scenes: [Scene; 9] = [
        ("two apart", Some((2, 4)), Box::new(move |p| ball(-8.5, 8.0)(p).min(ball(9.5, 8.0)(p)))),
        ("two touching", None, Box::new(move |p| ball(-8.0, 8.0)(p).min(ball(8.0, 8.0)(p)))),
        ("two joined", Some((1, 2)), Box::new(move |p| ball(-6.3, 8.0)(p).min(ball(6.3, 8.0)(p)))),
        ("shell", Some((2, 4)), Box::new(move |p| ball(0.2, 14.0)(p).abs() - 1.5)),
        ("thin shell", None, Box::new(move |p| ball(0.2, 14.0)(p).abs() - 0.45)),
        ("slab", Some((1, 2)), Box::new(move |p| in_ball(p[2].abs() - 2.0, p))),
        ("slab on voxels", Some((1, 2)), Box::new(move |p| in_ball(p[2].abs() - 2.5, p))),
        ("thin slanted slab", None, Box::new(move |p| in_ball((0.6 * p[0] + 0.8 * p[2]).abs() - 0.4, p))),
        ("gyroid", None, Box::new(move |p| in_ball(gyroid(p), p))),
    ];
    for (name, expected, phi) in scenes {
        let band = band(IVec3::splat(-26), IVec3::splat(26), phi);
        for contouring in BOTH {
            let (_, measures) = checked_contour(&band, &UNIT, contouring);
            assert!(measures.volume > 0.0, "{name} is inside out");
            if let Some(expected) = expected {
                assert_eq!((measures.component_count, measures.euler_characteristic), expected, "{name}");
            }
        }
    }
}

#[test]
fn slab_on_half_voxels_is_exact() {
    let slab = |[x, y, z]: [f64; 3]| (z.abs() - 2.5).max(x.abs() - 9.5).max(y.abs() - 9.5);
    let band = band(IVec3::splat(-20), IVec3::splat(20), slab);
    for contouring in BOTH {
        let (mesh, _) = checked_contour(&band, &UNIT, contouring);
        let on_top = mesh.positions.iter().filter(|position| position.z > 0.0);
        for position in on_top.filter(|position| position.x.abs() < 6.0 && position.y.abs() < 6.0) {
            assert!((position.z - 2.5).abs() < 1e-6);
        }
    }
}

/// Random values; some of them are +0, −0, tiny, or equal.
fn random_block(random: &mut Random, count: usize) -> Vec<f32> {
    let inside_share = 0.2 + 0.6 * random.next();
    let values = (0..count).map(|_| {
        let sign = if random.next() < inside_share { -1.0 } else { 1.0 };
        sign * match (random.next() * 8.0) as u32 {
            0 => 0.0,
            1 => 1e-30,
            2 => 1.0,
            _ => random.next(),
        }
    });
    values.collect()
}

#[test]
fn ten_thousand_random_fields_are_sound() {
    let mut random = Random(1);
    for round in 0..10_000 {
        let extent = IVec3::new(2 + round % 4, 2 + round / 4 % 3, 3 + round / 12 % 2);
        let values = random_block(&mut random, extent.element_product() as usize);
        // The block is across a corner where eight leaves meet.
        let band = block_band(IVec3::splat(6), extent, &values);
        for contouring in BOTH {
            checked_contour(&band, &UNIT, contouring);
        }
    }
}

#[test]
fn random_fields_far_out_are_sound_in_32_bits() {
    let mut random = Random(2);
    for round in 0..2_000 {
        let extent = IVec3::splat(4);
        let values = random_block(&mut random, 64);
        let corner = IVec3::new(16370, -16380, if round % 2 == 0 { 16366 } else { -16378 });
        let band = block_band(corner, extent, &values);
        for voxel_size in [1.0, 0.01, 1.0 / 3.0] {
            for contouring in BOTH {
                let (mesh, _) = checked_contour(&band, &Lattice { voxel_size }, contouring);
                assert_eq!(mesh.origin, DVec3::ZERO);
            }
        }
    }
}

#[test]
fn every_pair_of_cells_is_sound() {
    // All combinations of signs at the 12 corners of two cells that share a face, along each axis.
    for extent in [IVec3::new(3, 2, 2), IVec3::new(2, 3, 2), IVec3::new(2, 2, 3)] {
        for signs in 0..1 << 12 {
            let values: Vec<f32> =
                (0..12).map(|corner| if signs >> corner & 1 == 1 { -0.7 } else { 0.4 }).collect();
            for corner in [IVec3::ONE, IVec3::splat(6)] {
                let band = block_band(corner, extent, &values);
                checked_contour(&band, &UNIT, Contouring::Dual);
                // The same block, surrounded by inside voxels.
                let outside_in: Vec<f32> = padded(extent, &values);
                let band = block_band(corner, extent + 2, &outside_in);
                checked_contour(&band, &UNIT, Contouring::Dual);
            }
        }
    }
}

/// A block of values with a layer of inside voxels around it.
fn padded(extent: IVec3, values: &[f32]) -> Vec<f32> {
    let wide = extent + 2;
    let value = |index: i32| {
        let at = IVec3::new(index / (wide.y * wide.z), index / wide.z % wide.y, index % wide.z) - 1;
        let is_within = at.cmpge(IVec3::ZERO).all() && at.cmplt(extent).all();
        if is_within { values[((at.x * extent.y + at.y) * extent.z + at.z) as usize] } else { -1.0 }
    };
    (0..wide.element_product()).map(value).collect()
}

#[test]
fn number_of_threads_changes_nothing() {
    let mut random = Random(3);
    let noisy = block_band(IVec3::splat(-9), IVec3::splat(20), &random_block(&mut random, 8000));
    let smooth = band(IVec3::splat(-26), IVec3::splat(26), torus([0.1, 0.2, 0.3], 12.0, 5.0));
    for (band, contouring) in [(&noisy, BOTH[0]), (&noisy, BOTH[1]), (&smooth, BOTH[0]), (&smooth, BOTH[1])] {
        let results = [1, 2, 4].map(|threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("a thread pool");
            pool.install(|| checked_contour(band, &UNIT, contouring))
        });
        assert!(results[0] == results[1] && results[1] == results[2]);
    }
}

#[test]
fn moving_by_whole_voxels_moves_the_mesh() {
    let here = band(IVec3::splat(-26), IVec3::splat(26), torus([0.1, 0.2, 0.3], 12.0, 5.0));
    // Move by whole root children of the tree, so that the leaves keep their order.
    let step = IVec3::new(4096, -8192, 4096);
    for contouring in BOTH {
        let (at_home, _) = checked_contour(&here, &UNIT, contouring);
        let (away, _) = checked_contour(&moved(&here, step), &UNIT, contouring);
        assert!(at_home.triangles == away.triangles && at_home.normals == away.normals);
        for (one, other) in at_home.positions.iter().zip(&away.positions) {
            let error = (*other - step.as_vec3()) - *one;
            assert!(error.abs().max_element() <= 1.0 / 2048.0, "more than rounding: {error}");
        }
    }
}

#[test]
fn moving_within_leaves_keeps_the_measures() {
    let bands = [[0.1, 0.2, 0.3], [3.1, -4.8, 1.3]]
        .map(|center| band(IVec3::splat(-32), IVec3::splat(32), torus(center, 12.0, 5.0)));
    for contouring in BOTH {
        let [here, there] = bands.each_ref().map(|band| checked_contour(band, &UNIT, contouring).1);
        assert_eq!(here.triangle_count, there.triangle_count);
        assert!((here.area - there.area).abs() < 1e-3 && (here.volume - there.volume).abs() < 1e-2);
    }
}

#[test]
fn far_frames_have_a_local_origin() {
    let here = band(IVec3::splat(-16), IVec3::splat(16), sphere([0.1, 0.2, 0.3], 9.0));
    let lattice = Lattice { voxel_size: 0.5 };
    for step in [IVec3::splat(1 << 20), IVec3::new(16384, 0, 0), IVec3::new(0, -(1 << 29), 1 << 29)] {
        let band = moved(&here, step);
        for contouring in BOTH {
            let (near, _) = checked_contour(&here, &lattice, contouring);
            let (far, _) = checked_contour(&band, &lattice, contouring);
            assert_eq!(near.origin, DVec3::ZERO);
            assert_eq!(far.origin % 512.0, DVec3::ZERO, "a multiple of 1024 voxels of one half");
            assert!((far.origin - step.as_dvec3() * 0.5).length() <= 0.5 * 1024.0);
        }
    }
}

#[test]
fn halving_the_voxels_halves_the_positions_exactly() {
    let band = band(IVec3::splat(-16), IVec3::splat(16), sphere([0.1, 0.2, 0.3], 9.0));
    for contouring in BOTH {
        let (whole, _) = checked_contour(&band, &UNIT, contouring);
        let (half, _) = checked_contour(&band, &Lattice { voxel_size: 0.5 }, contouring);
        let halved: Vec<Vec3> = whole.positions.iter().map(|position| position * 0.5).collect();
        assert!(halved == half.positions);
    }
}

#[test]
fn no_surface_gives_an_empty_mesh() {
    let outside = block_band(IVec3::ZERO, IVec3::ONE, &[0.0]);
    let empty = block_band(IVec3::ZERO, IVec3::ZERO, &[]);
    for contouring in BOTH {
        for band in [&outside, &empty] {
            let (mesh, measures) = checked_contour(band, &UNIT, contouring);
            assert!(mesh.positions.is_empty() && measures == MeshMeasures::default());
        }
    }
}
