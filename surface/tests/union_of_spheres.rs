//! Compares rasterization with the geometry of spheres.

#![expect(clippy::print_stdout, reason = "tests print measurements, visible with --nocapture")]

use glam::{DVec3, IVec3};
use meniscus_surface::particles::OwnedPositions;
use meniscus_surface::rasterize::{Radii, RasterFields, RasterParams, rasterize};
use meniscus_surface::smooth::{Integrator, smooth};
use meniscus_surface::space::{INDEX_LIMIT, Lattice};

use crate::shapes::{Random, default_config, default_radii, rasterized, same_bits, value_at, voxels};

/// The distance of a voxel outside from the union of spheres, computed from the nearest centre.
fn outside_distance(positions: &[DVec3], voxel: IVec3, radius: f64) -> f64 {
    let voxel = voxel.as_dvec3();
    positions.iter().map(|position| position.distance(voxel)).fold(f64::INFINITY, f64::min) - radius
}

/// Checks all voxels outside and within two voxels of the spheres with r_max, where values do not come from
/// sweeping. Bounds are open beyond 1.5 voxels. Returns the number of these voxels.
fn assert_exact_outside(positions: &[DVec3]) -> usize {
    let (band, bounds) = rasterized(positions);
    let radii = default_radii();
    let [lower, upper] = bounds.to_fields();
    let mut checked = 0;
    for (radius, phi, reach) in
        [(radii.init, band.phi.clone(), f64::INFINITY), (radii.max, lower, 1.499), (radii.min, upper, 1.499)]
    {
        let band = meniscus_surface::level_set::NarrowBand { phi, ..band.clone() };
        for (voxel, phi) in voxels(&band) {
            let exact = outside_distance(positions, voxel, f64::from(radius));
            assert_eq!(phi < 0.0, exact < 0.0, "the sign at {voxel}");
            let is_known = exact + f64::from(radius) < f64::from(radii.max) + 1.99;
            if exact >= 0.0 && exact < reach && is_known {
                assert!((f64::from(phi) - exact).abs() < 1e-5, "{voxel}: {phi} {exact}");
                checked += 1;
            }
        }
    }
    assert_eq!(bounds.violation_count(&band.phi), 0);
    checked
}

#[test]
fn distances_outside_are_exact() {
    let mut random = Random::new(60);
    let lattice: Vec<DVec3> = (0..600)
        .map(|i| IVec3::new(i % 10, i / 10 % 10, i / 100).as_dvec3() * 2.0 + DVec3::splat(0.37))
        .collect();
    let scattered: Vec<DVec3> = (0..600).map(|_| random.in_ball(30.0)).collect();
    let table: [(&str, Vec<DVec3>); 4] = [
        ("one particle", vec![DVec3::new(0.3, -0.2, 7.9)]),
        ("two particles", vec![DVec3::ZERO, DVec3::new(4.4, 1.0, 0.5)]),
        ("600 on a lattice", lattice),
        ("600 scattered", scattered),
    ];
    for (name, positions) in table {
        let checked = assert_exact_outside(&positions);
        println!("{name}: {checked} values are exact");
        assert!(checked > 500, "{name}: only {checked}");
    }
}

/// Inside and far outside, values come from sweeping: they are approximate distances.
#[test]
fn swept_distances_of_a_sphere_are_near() {
    let center = DVec3::new(0.4, 0.1, -0.3);
    let lattice = Lattice { voxel_size: 1.0 };
    let particle = OwnedPositions::F64(vec![center.to_array()]);
    let Ok(RasterFields { band, .. }) =
        rasterize(&particle, &RasterParams::open(lattice, Radii::uniform(9.5, 10.0, 10.5)));
    let error = |(voxel, phi): (IVec3, f32)| {
        let exact = voxel.as_dvec3().distance(center) - 10.0;
        (exact.abs() < f64::from(band.half_width) - 0.5).then_some((f64::from(phi) - exact).abs())
    };
    let worst = voxels(&band).filter_map(error).fold(0.0, f64::max);
    println!("a sphere of radius 10: swept distances are within {worst:.3} voxels");
    assert!(worst < 0.1, "{worst}");
}

/// The particles of a lattice leave no cavity between them, so inside values are distances from the outer
/// surface.
#[test]
fn dense_lattice_is_solid() {
    let positions: Vec<DVec3> =
        (0..9 * 9 * 9).map(|i| IVec3::new(i % 9, i / 9 % 9, i / 81).as_dvec3() * 2.0).collect();
    let (band, bounds) = rasterized(&positions);
    assert_eq!(bounds.violation_count(&band.phi), 0);
    let radius = f64::from(default_radii().init);
    for (voxel, phi) in voxels(&band) {
        let from_center = (voxel.as_dvec3() - 8.0).abs();
        if from_center.max_element() > 8.0 {
            continue;
        }
        assert!(phi < 0.0, "a cavity at {voxel}: {phi}");
        // Away from the edges, the surface is flat except for dents of 0.42 voxels between the particles.
        let is_at_face = from_center.to_array().iter().filter(|axis| **axis > 3.0).count() <= 1;
        let depth = (radius + 8.0 - from_center.max_element()).min(f64::from(band.half_width));
        assert!(!is_at_face || (f64::from(phi) + depth).abs() < 0.6, "{voxel}: {phi} {depth}");
    }
}

#[test]
fn no_particles_make_no_surface() {
    let (mut band, bounds) = rasterized(&[]);
    for integrator in [Integrator::Fast, Integrator::Implicit, Integrator::Explicit] {
        smooth(&mut band, &bounds, &default_config(integrator), &mut |_| {});
        assert!(band.topology.is_empty() && band.phi.leaves.is_empty());
    }
}

/// Even at the largest indices of the grid, a particle gives the same values as at the origin.
#[test]
fn particle_far_from_the_origin_gives_the_same_values() {
    let offset = DVec3::new(0.28125, 5.5, 7.96875);
    let (near, _) = rasterized(&[offset]);
    let limit = INDEX_LIMIT - 8;
    for corner in [IVec3::splat(limit), IVec3::splat(-limit), IVec3::new(limit, -limit, 0)] {
        let (far, bounds) = rasterized(&[corner.as_dvec3() + offset]);
        assert_eq!(far.topology.len(), near.topology.len());
        assert_eq!(bounds.violation_count(&far.phi), 0);
        for (voxel, phi) in voxels(&near) {
            assert_eq!(value_at(&far, voxel + corner).map(f32::to_bits), Some(phi.to_bits()));
        }
    }
}

#[test]
fn positions_that_are_not_finite_are_dropped_and_counted() {
    let lattice = Lattice { voxel_size: 0.5 };
    let good = [[1.0, 2.0, 3.0], [2.0, 2.0, 3.0], [-4.0, 0.5, 0.0]];
    let bad = [
        [f64::NAN, 0.0, 0.0],
        [0.0, f64::INFINITY, 0.0],
        [0.0, 0.0, f64::NEG_INFINITY],
        [0.5 * f64::from(INDEX_LIMIT), 0.0, 0.0],
        [1e300, -1e300, 1e300],
    ];
    let mixed = vec![bad[0], good[0], bad[1], bad[2], good[1], bad[3], good[2], bad[4]];
    let rasterized = |positions: Vec<[f64; 3]>| {
        let Ok(rasterized) =
            rasterize(&OwnedPositions::F64(positions), &RasterParams::open(lattice, default_radii()));
        rasterized
    };
    let (clean, dirty) = (rasterized(good.to_vec()), rasterized(mixed));
    assert_eq!((clean.bins.len(), clean.bins.particle_count, clean.bins.dropped_count), (3, 3, 0));
    assert_eq!((dirty.bins.len(), dirty.bins.particle_count, dirty.bins.dropped_count), (3, 3, 5));
    assert!(same_bits(&clean.band, &dirty.band));
    let all_bad = rasterized(bad.to_vec());
    assert!(all_bad.bins.is_empty() && all_bad.band.topology.is_empty());
}
