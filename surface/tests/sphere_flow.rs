//! A sphere with noise under both flows (paper, Fig. 5). Thin-plate smoothing restores the sphere; Laplacian
//! smoothing shrinks it until it reaches the bound.
//!
//! ```text
//!      radius 16 ──────  upper bound of φ
//!      radius 20 ─∿∿∿──  φ: the distance, ±1 voxel of noise at every voxel
//!      radius 24 ──────  lower bound of φ
//! ```

#![expect(clippy::print_stdout, reason = "tests print measurements, visible with --nocapture")]

use std::f64::consts::PI;
use std::sync::Arc;

use glam::IVec3;
use meniscus_surface::grid::{Field, LEAF_VOXELS, Leaf, Topology, voxel_in_leaf};
use meniscus_surface::level_set::{Bounds, NarrowBand};
use meniscus_surface::smooth::{Integrator, SmoothConfig, SmoothSteps, smooth, smooth_laplacian_only};

use crate::shapes::{Random, bending_energy, volume};

const RADIUS: f32 = 20.0;
const BOUND_RADII: [f32; 2] = [16.0, 24.0];

/// Half width of the band, in voxels: the stencil of a step plus the movement of the surface.
const HALF_WIDTH: f32 = 9.0;

/// The noisy sphere and its bounds.
fn noisy_sphere() -> (NarrowBand, Bounds) {
    let topology = Topology::new(leaf_origins());
    let sphere = |radius: f32| {
        let leaf = |&origin: &IVec3| {
            let distance = |offset| (origin + voxel_in_leaf(offset)).as_vec3().length() - radius;
            Leaf { values: std::array::from_fn(distance).map(|d: f32| d.clamp(-HALF_WIDTH, HALF_WIDTH)) }
        };
        Field { leaves: topology.origins().iter().map(leaf).collect() }
    };
    let mut phi = sphere(RADIUS);
    let mut random = Random::new(5);
    for value in phi.leaves.iter_mut().flat_map(|leaf| &mut leaf.values) {
        *value += 2.0 * random.unit() as f32 - 1.0;
    }
    let bounds = Bounds::new(sphere(BOUND_RADII[1]), sphere(BOUND_RADII[0]));
    let band = NarrowBand { topology: Arc::new(topology), phi, half_width: HALF_WIDTH };
    (band, bounds)
}

/// The leaves with a voxel whose distance is within the half width.
fn leaf_origins() -> Vec<IVec3> {
    let near = |offset: usize, origin: IVec3| {
        ((origin + voxel_in_leaf(offset)).as_vec3().length() - RADIUS).abs() < HALF_WIDTH
    };
    let origins = (0..8 * 8 * 8).map(|i| (IVec3::new(i / 64, i / 8 % 8, i % 8) - 4) * 8);
    origins.filter(|&origin| (0..LEAF_VOXELS).any(|offset| near(offset, origin))).collect()
}

fn ball_volume(radius: f32) -> f64 {
    4.0 / 3.0 * PI * f64::from(radius).powi(3)
}

#[test]
fn thin_plate_smoothing_restores_a_noisy_sphere() {
    for (integrator, steps, step_size, redistance_every) in [
        (Integrator::Fast, 5, 20.0, 1),
        (Integrator::Implicit, 5, 20.0, 1),
        (Integrator::Explicit, 10_000, 0.01, 50),
    ] {
        let (mut band, bounds) = noisy_sphere();
        let steps = SmoothSteps { laplacian_steps: 0, integrator, steps, step_size, redistance_every };
        let config = SmoothConfig { smoothing: steps, ..SmoothConfig::default() };
        smooth(&mut band, &bounds, &config, &mut |_| {});
        let volume = volume(&band) / ball_volume(RADIUS);
        let energy = bending_energy(&band) / (4.0 * PI);
        println!("{integrator:?}: volume {volume:.5}, ∫H² {energy:.4} of the sphere's");
        assert_eq!(bounds.violation_count(&band.phi), 0);
        assert!((volume - 1.0).abs() < 0.01, "{integrator:?}: {volume}");
        assert!((energy - 1.0).abs() < 0.05, "{integrator:?}: {energy}");
    }
}

#[test]
fn laplacian_smoothing_shrinks_a_noisy_sphere_onto_its_bound() {
    let (mut band, bounds) = noisy_sphere();
    smooth_laplacian_only(&mut band, &bounds, 1000);
    assert_eq!(bounds.violation_count(&band.phi), 0);
    let volume = volume(&band) / ball_volume(BOUND_RADII[0]);
    // The surface has reached the bound: φ is near its upper bound everywhere, and never far below it.
    let [_, upper] = bounds.to_fields();
    let pairs = band.phi.as_arrays().as_flattened().iter().zip(upper.as_arrays().as_flattened());
    let gaps: Vec<f32> = pairs.filter(|(phi, _)| phi.abs() < 1.0).map(|(phi, upper)| upper - phi).collect();
    let held = gaps.iter().filter(|gap| **gap == 0.0).count() as f64 / gaps.len() as f64;
    let widest = gaps.iter().copied().fold(0.0, f32::max);
    println!(
        "Laplacian: volume {volume:.4} of the bound's; {held:.2} of the voxels are held, the others within {widest:.3}"
    );
    assert!((volume - 1.0).abs() < 0.01, "{volume}");
    assert!(held > 0.4 && widest < 0.1, "{held} {widest}");
}
