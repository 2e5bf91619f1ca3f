//! Changes of the input that must leave the surface bit-identical, and properties of every surface.

#![expect(clippy::print_stdout, reason = "tests print measurements, visible with --nocapture")]

use glam::{DVec3, IVec3};
use meniscus_surface::level_set::NarrowBand;
use meniscus_surface::options::{MethodOptions, Settings};
use meniscus_surface::particles::OwnedPositions;
use meniscus_surface::rasterize::{RasterFields, RasterParams, rasterize};
use meniscus_surface::reconstruction::reconstruct_frame;
use meniscus_surface::smooth::{Integrator, smooth};
use meniscus_surface::space::Lattice;

use crate::shapes::{
    Random, ball_with_finger, default_config, default_radii, interpolated, jittered_lattice, same_bits,
    sheet_and_drops, skinned, two_balls, value_at, voxels,
};

const INTEGRATORS: [Integrator; 4] =
    [Integrator::Fast, Integrator::Implicit, Integrator::Explicit, Integrator::Adaptive];

/// The surface of particles in world units.
fn skinned_world(positions: &[DVec3], voxel_size: f64, integrator: Integrator) -> NarrowBand {
    let particles = OwnedPositions::F64(positions.iter().map(|p| p.to_array()).collect());
    let Ok(RasterFields { mut band, bounds, .. }) =
        rasterize(&particles, &RasterParams::open(Lattice { voxel_size }, default_radii()));
    smooth(&mut band, &bounds, &default_config(integrator), &mut |_| {});
    band
}

#[test]
fn order_of_particles_does_not_matter() {
    let positions = two_balls();
    let mut shuffled = positions.clone();
    Random::new(70).shuffle(&mut shuffled);
    assert_ne!(positions, shuffled);
    for integrator in INTEGRATORS {
        let (one, other) = (skinned(&positions, integrator).0, skinned(&shuffled, integrator).0);
        assert!(same_bits(&one, &other), "{integrator:?}");
    }
}

#[test]
fn the_number_of_threads_does_not_matter() {
    let positions = sheet_and_drops();
    for integrator in INTEGRATORS {
        let on_threads = |count| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(count).build().unwrap();
            pool.install(|| skinned(&positions, integrator))
        };
        let (one, _, report) = on_threads(1);
        for count in [2, 4] {
            let (other, _, other_report) = on_threads(count);
            assert!(same_bits(&one, &other), "{integrator:?} on {count} threads");
            assert_eq!(report, other_report, "{integrator:?} on {count} threads");
        }
    }
}

/// The scales are powers of two, so that the division by the voxel size causes no rounding.
#[test]
fn unit_of_length_does_not_matter() {
    let positions = two_balls();
    for integrator in INTEGRATORS {
        let one = skinned_world(&positions, 1.0, integrator);
        for scale in [4.0, 0.125] {
            let scaled: Vec<DVec3> = positions.iter().map(|position| position * scale).collect();
            let other = skinned_world(&scaled, scale, integrator);
            assert!(same_bits(&one, &other), "{integrator:?} at scale {scale}");
        }
    }
}

/// When all particles move by whole voxels, the surface moves with them, although it then lies in other
/// leaves.
///
/// The stored leaves around the band differ, but every value that a step may change must be equal. If only
/// one of the grids stores a voxel, the voxel must be beyond the band. (The implicit integrator sums dot
/// products leaf by leaf, so its results may differ in the last bits.)
#[test]
fn moving_all_particles_by_whole_voxels_moves_the_surface() {
    const VOXEL_SIZE: f64 = 1.0 / 32.0;
    let grain = f64::from(1 << 20);
    let positions: Vec<DVec3> =
        ball_with_finger().iter().map(|p| (p * VOXEL_SIZE * grain).round() / grain).collect();
    for integrator in [Integrator::Fast, Integrator::Explicit] {
        let here = skinned_world(&positions, VOXEL_SIZE, integrator);
        for shift in [IVec3::new(8, -16, 1024), IVec3::new(1, 0, 0), IVec3::new(-3, 100_005, 12)] {
            let moved: Vec<DVec3> = positions.iter().map(|p| p + shift.as_dvec3() * VOXEL_SIZE).collect();
            let there = skinned_world(&moved, VOXEL_SIZE, integrator);
            let compared = assert_same_band(&here, &there, shift) + assert_same_band(&there, &here, -shift);
            println!("{integrator:?}, moved by {shift}: {compared} values are the same");
        }
    }
}

/// Checks that every free value of `here` has the same bits in `there`, `shift` away. Returns the number of
/// these values.
fn assert_same_band(here: &NarrowBand, there: &NarrowBand, shift: IVec3) -> usize {
    let free = || voxels(here).filter(|(_, phi)| phi.abs() <= 3.0);
    for (voxel, phi) in free() {
        assert_eq!(
            value_at(there, voxel + shift).map(f32::to_bits),
            Some(phi.to_bits()),
            "{voxel} + {shift}"
        );
    }
    free().count()
}

/// A change of one particle does not change the surface at a larger distance than the report states.
#[test]
fn far_changes_keep_the_surface() {
    let reach = {
        let one = reconstruct_frame(
            &OwnedPositions::F64(vec![[0.0; 3]]),
            &Settings::paper(1.0, &MethodOptions::default()).unwrap(),
        );
        i32::try_from(one.report.smoothing.reach_voxels.unwrap()).unwrap()
    };
    let (length, near) = (reach + 52, 16);
    let mut random = Random::new(71);
    let bar = jittered_lattice(&mut random, length, |p| p.x >= 0.0 && p.y.abs() < 3.0 && p.z.abs() < 3.0);
    let end = f64::from(length);
    let mut with_tip = bar.clone();
    with_tip.push(DVec3::new(end + 2.0, 4.0, 1.0));
    let (one, ..) = skinned(&bar, Integrator::Fast);
    let (other, ..) = skinned(&with_tip, Integrator::Fast);
    let last = length + 2 - reach;
    assert!(last >= near);
    let (mut compared, mut changed) = (0, 0);
    for (voxel, phi) in voxels(&one) {
        let same = value_at(&other, voxel).map(f32::to_bits) == Some(phi.to_bits());
        if voxel.x <= last {
            assert!(same, "{voxel} is {} voxels away", length + 2 - voxel.x);
            compared += 1;
        } else {
            changed = changed.max(if same { 0 } else { length + 2 - voxel.x });
        }
    }
    println!("reach {reach}: {compared} values the same; the farthest change is {changed} voxels away");
    assert!(changed > 0);
}

/// A distant particle adds its drop, and does not change a bit of the rest.
#[test]
fn isolated_particle_changes_nothing_else() {
    let positions = ball_with_finger();
    let mut with_drop = positions.clone();
    with_drop.push(DVec3::new(3.0, 45.0, -2.0));
    let (one, ..) = skinned(&positions, Integrator::Fast);
    let (other, ..) = skinned(&with_drop, Integrator::Fast);
    assert!(one.topology.len() < other.topology.len());
    for (voxel, phi) in voxels(&one) {
        assert_eq!(value_at(&other, voxel).map(f32::to_bits), Some(phi.to_bits()), "{voxel}");
    }
}

#[test]
fn bounds_hold_and_no_particle_is_outside() {
    for positions in [ball_with_finger(), two_balls(), sheet_and_drops()] {
        for integrator in INTEGRATORS {
            let (band, bounds, _) = skinned(&positions, integrator);
            assert_eq!(bounds.violation_count(&band.phi), 0, "{integrator:?}");
            // A particle without stored values around it is deep inside the fluid.
            let depths = positions.iter().filter_map(|&position| interpolated(&band, position));
            let shallowest = depths.fold(f64::NEG_INFINITY, f64::max);
            println!("{integrator:?}: the shallowest particle is at {shallowest:.3} voxels");
            assert!(shallowest < 0.0, "{integrator:?}: a particle is outside, {shallowest}");
        }
    }
}

/// Spheres so small that they fall between the voxels leave no surface, and the certificate says so.
#[test]
fn particles_between_voxels_are_counted_as_outside() {
    let tiny = MethodOptions { radius_min: Some(0.3.into()), ..MethodOptions::default() };
    let settings = Settings::paper(1.0, &tiny).unwrap();
    let lost = reconstruct_frame(&OwnedPositions::F64(vec![[0.5; 3]]), &settings).report;
    assert_eq!((lost.mesh.triangle_count, lost.certificate.particles_outside.count), (0, 1));
    assert!(!lost.certificate.holds());
    let caught = reconstruct_frame(&OwnedPositions::F64(vec![[0.1, 0.0, 0.0]]), &settings).report.certificate;
    assert_eq!(caught.particles_outside.count, 0, "{caught:?}");
    // No leaf is stored deep inside, either.
    let block = (0..18 * 18 * 18).map(|i| [i / 324, i / 18 % 18, i % 18].map(|side| f64::from(side) * 2.0));
    let settings = Settings::paper(1.0, &MethodOptions::default()).unwrap();
    let inside = reconstruct_frame(&OwnedPositions::F64(block.collect()), &settings).report.certificate;
    assert!(inside.holds(), "{inside:?}");
}

/// Most particles of a solid have no stored voxels around them. The certificate covers these particles, too.
#[test]
fn culled_particles_are_certified_too() {
    let mut random = Random::new(73);
    let solid: Vec<DVec3> =
        jittered_lattice(&mut random, 34, |p| p.length() < 34.0).iter().map(|p| p * 0.5).collect();
    let particles = OwnedPositions::F64(solid.iter().map(|p| p.to_array()).collect());
    let settings = Settings::paper(1.0, &MethodOptions::default()).unwrap();
    let Ok(rasterized) =
        rasterize(&particles, &RasterParams::open(Lattice { voxel_size: 1.0 }, default_radii()));
    assert!(rasterized.bins.len() < solid.len() * 3 / 4, "{} are kept", rasterized.bins.len());
    let surface = reconstruct_frame(&particles, &settings);
    let certificate = surface.report.certificate;
    assert!(certificate.holds(), "{certificate:?}");
    assert_eq!(surface.report.particle_count, solid.len());
    let nearest = |vertex: &glam::Vec3| {
        let distances = solid.iter().map(|particle| particle.distance_squared(vertex.as_dvec3()));
        distances.fold(f64::INFINITY, f64::min).sqrt()
    };
    let distances: Vec<f64> = surface.mesh.positions.iter().map(nearest).collect();
    let least = distances.iter().copied().fold(f64::INFINITY, f64::min);
    let greatest = distances.iter().copied().fold(0.0, f64::max);
    println!(
        "{} of {} are kept; vertices at {least:.3} to {greatest:.3}",
        rasterized.bins.len(),
        solid.len()
    );
    assert!((certificate.vertex_distance_min - least).abs() < 1e-4, "{least} {certificate:?}");
    assert!((certificate.vertex_distance_max - greatest).abs() < 1e-4, "{greatest} {certificate:?}");
}

/// One escaped particle does not affect the others: their mesh keeps its positions.
#[test]
fn escaped_particle_costs_the_others_no_precision() {
    let settings = Settings::paper(0.025, &MethodOptions::default()).unwrap();
    let mut positions: Vec<[f64; 3]> =
        (0..512).map(|i| [i / 64, i / 8 % 8, i % 8].map(|side| f64::from(side) * 0.05)).collect();
    let alone = reconstruct_frame(&OwnedPositions::F64(positions.clone()), &settings);
    positions.push([1e4, 0.0, 0.0]);
    let with_outlier = reconstruct_frame(&OwnedPositions::F64(positions), &settings);
    assert_eq!(with_outlier.mesh.origin, alone.mesh.origin);
    let count = alone.mesh.positions.len();
    assert_eq!(with_outlier.mesh.positions[..count], alone.mesh.positions);
    assert!(alone.report.certificate.position_rounding < 1e-4);
    assert!(
        with_outlier.report.certificate.position_rounding > 1e-3,
        "{:?}",
        with_outlier.report.certificate
    );
}
