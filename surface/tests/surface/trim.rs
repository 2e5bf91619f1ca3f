//! Checks removed specks, filled bubbles and clipping by a box against the geometry of balls and boxes.

use std::f64::consts::PI;

use glam::{DVec3, IVec3, Vec3};
use meniscus_surface::contour::Contouring;
use meniscus_surface::edits::{Clipped, VoxelClip, clip, drop_islands, fill_cavities};
use meniscus_surface::grid::{LEAF_EDGE, offset_in_leaf, voxel_in_leaf};
use meniscus_surface::level_set::NarrowBand;
use meniscus_surface::space::Lattice;

use super::bands::{band, block_band, sphere};
use super::{BOTH, Random, UNIT, checked_contour};

/// The union of balls.
fn balls(balls: &[([f64; 3], f64)]) -> impl Fn([f64; 3]) -> f64 {
    let balls = balls.to_vec();
    move |p| balls.iter().fold(f64::INFINITY, |least, &(center, radius)| least.min(sphere(center, radius)(p)))
}

/// The points with φ < −1 of a lattice with a spacing of 1.7 voxels, by leaf.
fn particles(min: IVec3, max: IVec3, phi: impl Fn([f64; 3]) -> f64) -> Vec<(IVec3, Vec<Vec3>)> {
    let mut leaves: Vec<(IVec3, Vec<Vec3>)> = Vec::new();
    let [first, last]: [IVec3; 2] = [min >> 3, max >> 3];
    for leaf in (first.x..=last.x).flat_map(|x| {
        (first.y..=last.y).flat_map(move |y| (first.z..=last.z).map(move |z| IVec3::new(x, y, z) * LEAF_EDGE))
    }) {
        let points = (0..125).map(|k| Vec3::new((k / 25) as f32, (k / 5 % 5) as f32, (k % 5) as f32) * 1.7);
        let is_in = |point: &Vec3| phi((leaf.as_vec3() + *point).as_dvec3().to_array()) < -1.0;
        let points: Vec<Vec3> = points.filter(is_in).collect();
        if !points.is_empty() {
            leaves.push((leaf, points));
        }
    }
    leaves
}

fn count(particles: &[(IVec3, Vec<Vec3>)]) -> u64 {
    particles.iter().map(|(_, locals)| locals.len() as u64).sum()
}

/// The largest difference between values in the band and a function.
fn farthest_from(band: &NarrowBand, phi: impl Fn([f64; 3]) -> f64) -> f64 {
    let leaves = band.topology.origins().iter().zip(&band.phi.leaves);
    let errors = leaves.flat_map(|(&origin, leaf)| {
        let phi = &phi;
        (0..512).map(move |offset| {
            let voxel = (origin + voxel_in_leaf(offset)).as_dvec3().to_array();
            (f64::from(leaf.values[offset]) - phi(voxel).clamp(-6.0, 6.0)).abs()
        })
    });
    errors.fold(0.0, f64::max)
}

const BALL: ([f64; 3], f64) = ([-20.0, 0.3, 1.1], 23.0);
const DROP: ([f64; 3], f64) = ([18.0, 0.3, 1.1], 6.3);
const SPECK: ([f64; 3], f64) = ([8.2, 9.3, 1.1], 2.7);

#[test]
fn removed_speck_moves_nothing_else() {
    let (min, max) = (IVec3::splat(-56), IVec3::splat(40));
    let whole = band(min, max, balls(&[BALL, DROP, SPECK]));
    let all = particles(min, max, balls(&[BALL, DROP, SPECK]));
    let in_speck = count(&particles(min, max, balls(&[SPECK])));
    let in_drop = count(&particles(min, max, balls(&[DROP])));
    assert!((2..30).contains(&in_speck) && in_drop > 60, "{in_speck} {in_drop}");
    let given = || all.iter().map(|(origin, locals)| (*origin, locals));
    for (least, left, gone) in [
        (in_speck, &[BALL, DROP, SPECK][..], 0),
        (in_speck + 1, &[BALL, DROP], in_speck),
        (in_drop + 1, &[BALL], in_speck + in_drop),
        // No limit removes the ball: it has leaves deep inside that are not stored, and such a piece is kept
        // without counting its particles.
        (u64::MAX, &[BALL], in_speck + in_drop),
    ] {
        let mut band = whole.clone();
        let dropped = drop_islands(&mut band, least, given());
        assert_eq!((dropped.piece_count, dropped.particle_count), (3 - left.len(), gone));
        let volume: f64 =
            [DROP, SPECK][left.len() - 1..].iter().map(|(_, radius)| 4.0 / 3.0 * PI * radius.powi(3)).sum();
        assert!((dropped.voxel_count as f64 - volume).abs() <= 0.1 * volume, "{}", dropped.voxel_count);
        let held = all.iter().map(|(origin, locals)| {
            locals.iter().filter(|local| dropped.contains(*origin, **local)).count() as u64
        });
        assert_eq!(held.sum::<u64>(), gone);
        // The values are distances from the remaining surface. Values of voxels for which it was the nearest
        // surface before are unchanged to the last bit.
        assert!(farthest_from(&band, balls(left)) < 0.3, "{}", farthest_from(&band, balls(left)));
        let (of_left, before) = (balls(left), balls(&[BALL, DROP, SPECK]));
        for (leaf, &origin) in band.topology.origins().iter().enumerate() {
            for offset in 0..512 {
                let voxel = (origin + voxel_in_leaf(offset)).as_dvec3().to_array();
                if of_left(voxel) <= before(voxel) || of_left(voxel) < 0.0 {
                    let [old, new] = [&whole, &band].map(|band| band.phi.leaves[leaf].values[offset]);
                    assert!(new == old || new - old < 0.3 && old > 0.5, "{voxel:?}: {old} became {new}");
                }
            }
        }
        for contouring in BOTH {
            assert_eq!(checked_contour(&band, &UNIT, contouring).1.component_count, left.len());
        }
    }
}

/// A ball with bubbles of 33 voxels, of 268 voxels, and so large that some leaves inside the bubble are not
/// stored.
const HOST: ([f64; 3], f64) = ([3.5, 3.5, 3.5], 36.3);
const BUBBLES: [([f64; 3], f64); 3] =
    [([3.5, 25.2, 3.1], 2.0), ([-21.3, -2.2, 3.1], 4.0), ([3.5, 3.5, 3.5], 14.5)];

/// The level set of the host with these bubbles.
fn host_without(bubbles: &[([f64; 3], f64)]) -> impl Fn([f64; 3]) -> f64 {
    let bubbles = balls(bubbles);
    move |p| sphere(HOST.0, HOST.1)(p).max(-bubbles(p))
}

#[test]
fn bubbles_up_to_a_volume_are_filled() {
    let (min, max) = (IVec3::splat(-48), IVec3::splat(56));
    let whole = band(min, max, host_without(&BUBBLES));
    assert!(whole.topology.find(IVec3::ZERO).is_none(), "the middle is not stored");
    let volume = |(_, radius): ([f64; 3], f64)| 4.0 / 3.0 * PI * radius.powi(3);
    for (most, filled_count) in [(20.0, 0), (100.0, 1), (500.0, 2), (1e5, 3), (f64::INFINITY, 3)] {
        let mut band = whole.clone();
        let filled = fill_cavities(&mut band, most, None);
        let expected: f64 = BUBBLES[..filled_count].iter().map(|&bubble| volume(bubble)).sum();
        assert_eq!(filled.count, filled_count);
        assert!((filled.voxel_count as f64 - expected).abs() <= 0.03 * expected, "{filled:?} {expected}");
        let error = farthest_from(&band, host_without(&BUBBLES[filled_count..]));
        assert!(error < 0.3, "{error}");
        for contouring in BOTH {
            let (_, measures) = checked_contour(&band, &UNIT, contouring);
            assert_eq!(measures.component_count, 4 - filled_count);
            let expected = volume(HOST) - BUBBLES[filled_count..].iter().map(|&b| volume(b)).sum::<f64>();
            assert!((measures.volume / expected - 1.0).abs() < 2e-3, "{measures:?} {expected}");
        }
    }
}

/// A hollow drop with a grain in it, inside a bubble of a ball.
#[test]
fn nested_components_are_judged_separately() {
    let center = [3.5; 3];
    let shells = move |p: [f64; 3]| {
        let r = sphere(center, 0.0)(p);
        (r - 30.0).max(18.0 - r).min((r - 13.0).max(8.0 - r)).min(r - 2.5)
    };
    let whole = band(IVec3::splat(-40), IVec3::splat(47), shells);
    let all = particles(IVec3::splat(-40), IVec3::splat(47), shells);
    let given = || all.iter().map(|(origin, locals)| (*origin, locals));
    let components = |band: &NarrowBand| checked_contour(band, &UNIT, Contouring::Dual).1.component_count;
    assert_eq!(components(&whole), 5);
    let trimmed = |least: u64, most: f64| {
        let mut band = whole.clone();
        let dropped = drop_islands(&mut band, least, given());
        let filled = fill_cavities(&mut band, most, None);
        (dropped.piece_count, filled.count, components(&band))
    };
    // With this limit, only the grain is removed; with a larger limit, also the hollow drop and its hollow.
    assert_eq!(trimmed(30, 0.0), (1, 0, 4));
    assert_eq!(trimmed(3000, 0.0), (2, 0, 2));
    // The hollow around the grain is filled, so that the grain joins the drop; then the bubble is filled,
    // too.
    assert_eq!(trimmed(0, 4000.0), (0, 1, 3));
    assert_eq!(trimmed(0, 40_000.0), (0, 2, 1));
    // The size of a bubble is measured after its contents are removed: 24 429 voxels.
    assert_eq!(trimmed(3000, 24_000.0), (2, 0, 2));
    assert_eq!(trimmed(3000, 25_000.0), (2, 1, 1));
}

/// Clips a ball of radius 30 about (0.3, −0.2, 0.4) in voxels of edge `h`, and checks the mesh.
fn clipped_ball(h: f64, clip_box: VoxelClip, contouring: Contouring) -> (f64, Clipped, Vec<DVec3>) {
    let mut band = band(IVec3::splat(-40), IVec3::splat(40), sphere([0.3, -0.2, 0.4], 30.0));
    let lattice = Lattice { voxel_size: h };
    let clipped = clip(&mut band, &lattice, &clip_box);
    let (mut mesh, _) = checked_contour(&band, &lattice, contouring);
    let beyond = |p: &Vec3| clip_box.distance(mesh.origin + p.as_dvec3());
    let worst = mesh.positions.iter().map(beyond).fold(f64::MIN, f64::max);
    assert!(worst < 0.15 * h, "{worst}");
    clip_box.clamp_mesh(&mut mesh);
    let measures = mesh.measure();
    assert!(measures.is_closed_manifold(), "{measures:?}");
    (measures.volume, clipped, mesh.positions.iter().map(|p| p.as_dvec3() + mesh.origin).collect())
}

#[test]
fn clipped_ball_has_the_remaining_volume() {
    // The faces of the box are between voxels, on voxels, and almost on voxels.
    for (low, high) in [(-12.37, 9.61), (-12.0, 10.0), (-12.0 + 1e-4, 10.0 + 1e-4)] {
        for contouring in BOTH {
            let h = 0.25;
            let clip_box = VoxelClip {
                min: DVec3::new(f64::NEG_INFINITY, f64::NEG_INFINITY, low * h),
                max: DVec3::new(f64::INFINITY, f64::INFINITY, high * h),
            };
            let (volume, clipped, vertices) = clipped_ball(h, clip_box, contouring);
            let integral = |z: f64| PI * (900.0 * z - z * z * z / 3.0);
            let expected = integral(high - 0.4) - integral(low - 0.4);
            assert!((volume / h.powi(3) / expected - 1.0).abs() < 3e-3, "{low}: {volume} {expected}");
            let cut = 4.0 / 3.0 * PI * 27_000.0 - expected;
            assert!((clipped.voxel_count as f64 / cut - 1.0).abs() < 0.05, "{clipped:?} {cut}");
            assert!(clipped.added_leaf_count > 0 && clipped.removed_leaf_count > 0);
            // Caps are flat except near their edges, and no vertex is beyond them.
            let beyond = |p: &DVec3| (p.z / h - high).max(low - p.z / h);
            let worst = vertices.iter().map(beyond).fold(f64::MIN, f64::max);
            assert!(worst <= 0.0, "{worst}");
            let middle = vertices.iter().filter(|p| p.truncate().length() < 22.0 * h);
            let off = middle.map(|p| beyond(p).abs()).fold(0.0, f64::max);
            assert!(off < 0.017, "{off}");
        }
    }
}

#[test]
fn box_deep_inside_the_fluid_becomes_its_surface() {
    for contouring in BOTH {
        let clip_box = VoxelClip { min: DVec3::new(-10.3, -9.6, -8.2), max: DVec3::new(9.4, 10.7, 11.9) };
        let (volume, clipped, vertices) = clipped_ball(1.0, clip_box, contouring);
        let expected = (clip_box.max - clip_box.min).element_product();
        assert!((volume / expected - 1.0).abs() < 0.01, "{volume} {expected}");
        assert!(clipped.added_leaf_count > 20);
        let worst = vertices.iter().map(|p| clip_box.distance(*p)).fold(f64::MIN, f64::max);
        assert!(worst <= 0.0, "{worst}");
    }
}

#[test]
fn box_may_remove_everything_or_nothing() {
    let everywhere = VoxelClip { min: DVec3::splat(-1e300), max: DVec3::splat(f64::INFINITY) };
    let ball = band(IVec3::splat(-40), IVec3::splat(40), sphere([0.3, -0.2, 0.4], 30.0));
    let mut band = ball.clone();
    assert_eq!(clip(&mut band, &UNIT, &everywhere), Clipped::default());
    assert!(band.phi == ball.phi && band.topology.origins() == ball.topology.origins());
    for (min, max) in [
        (DVec3::splat(500.0), DVec3::splat(600.0)),
        (DVec3::splat(2.0), DVec3::splat(-2.0)),
        (DVec3::NAN, DVec3::splat(f64::NEG_INFINITY)),
    ] {
        let mut band = ball.clone();
        let clipped = clip(&mut band, &UNIT, &VoxelClip { min, max });
        assert!((clipped.voxel_count as f64 / (4.0 / 3.0 * PI * 27_000.0) - 1.0).abs() < 0.01, "{clipped:?}");
        assert_eq!(checked_contour(&band, &UNIT, Contouring::Dual).1.triangle_count, 0);
    }
}

/// All three operations on noise: the result is a sound mesh for any φ, and the same on any number of
/// threads.
#[test]
fn trimmed_noise_is_sound() {
    let mut random = Random(7);
    // The front part of the block is mostly outside, and the rear part mostly inside.
    let share = |index: usize| if index < 13_500 { 0.3 } else { 0.85 };
    let values: Vec<f32> = (0..30 * 30 * 30).map(|index| random.next() - share(index)).collect();
    let noise = block_band(IVec3::splat(-11), IVec3::splat(30), &values);
    let given: Vec<(IVec3, Vec<Vec3>)> = noise
        .topology
        .origins()
        .iter()
        .map(|&origin| (origin, (0..40).map(|_| Vec3::splat(0.0).map(|_| 8.0 * random.next())).collect()))
        .collect();
    let trimmed = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("a pool");
        pool.install(|| {
            let mut band = noise.clone();
            let given = given.iter().map(|(origin, locals)| (*origin, locals));
            let dropped = drop_islands(&mut band, 20, given);
            let filled = fill_cavities(&mut band, 50.0, None);
            let clip_box = VoxelClip { min: DVec3::splat(-6.2), max: DVec3::splat(12.1) };
            let clipped = clip(&mut band, &UNIT, &clip_box);
            checked_contour(&band, &UNIT, Contouring::Tetrahedra);
            let (mesh, _) = checked_contour(&band, &UNIT, Contouring::Dual);
            let counts = (dropped.piece_count, dropped.particle_count, filled, clipped);
            (counts, band.phi, mesh)
        })
    };
    let one = trimmed(1);
    assert!(one.0.0 > 50 && one.0.2.count > 5, "{:?}", one.0);
    assert!(one == trimmed(3));
}

/// Trimming does not change distant parts.
#[test]
fn trimming_keeps_distant_parts() {
    let far = ([120.0, 3.0, 2.0], 5.0);
    let (min, max) = (IVec3::splat(-56), IVec3::new(136, 40, 40));
    let made = |scene: &[([f64; 3], f64)]| {
        let mut band = band(min, max, balls(scene));
        let all = particles(min, max, balls(scene));
        drop_islands(&mut band, 40, all.iter().map(|(origin, locals)| (*origin, locals)));
        fill_cavities(&mut band, 100.0, None);
        let clip_box = VoxelClip { min: DVec3::splat(-30.0), max: DVec3::new(130.0, 12.5, 30.0) };
        clip(&mut band, &UNIT, &clip_box);
        band
    };
    let (with, without) = (made(&[BALL, DROP, SPECK, far]), made(&[BALL, DROP, SPECK]));
    let mut compared = 0;
    for (leaf, &origin) in without.topology.origins().iter().enumerate().filter(|(_, o)| o.x < 60) {
        let other = with.topology.find(origin).expect("the same leaves");
        assert!(with.phi.leaves[other] == without.phi.leaves[leaf], "{origin}");
        compared += 1;
    }
    assert!(compared > 100);
    let is_in = |origin: IVec3| with.topology.find(origin).is_some() && origin.x < 60;
    assert_eq!(with.topology.origins().iter().filter(|&&origin| is_in(origin)).count(), compared);
    // Make sure that the two bands differ, so that the comparison is meaningful.
    assert!(with.topology.len() > without.topology.len());
    let speck = without.topology.find_voxel(IVec3::new(8, 9, 1)).expect("stored");
    assert!(without.phi.leaves[speck.0].values[offset_in_leaf(speck.1)] > 0.0);
}
