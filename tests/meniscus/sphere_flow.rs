//! A sphere with noise under both flows (paper, Fig. 5): thin-plate smoothing gives the sphere back,
//! Laplacian smoothing shrinks it until the bound stops it.
//!
//! ```text
//!      radius 16 ──────  upper bound of φ
//!      radius 20 ─∿∿∿──  φ: the distance, ±1 voxel of noise at every voxel
//!      radius 24 ──────  lower bound of φ
//! ```

use std::f64::consts::PI;
use std::sync::Arc;

use glam::IVec3;
use meniscus::grid::{Field, LEAF_VOXELS, Leaf, Topology, voxel_in_leaf};
use meniscus::level_set::{Bounds, NarrowBand};
use meniscus::smooth::{Config, Integrator, smooth, smooth_laplacian_only};

use crate::shapes::{Random, bending_energy, value_at, volume, voxels};

const RADIUS: f32 = 20.0;
const BOUND_RADII: [f32; 2] = [16.0, 24.0];

/// Values that a step reads, and how far the surface may move.
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
    let bounds = Bounds { lower: sphere(BOUND_RADII[1]), upper: sphere(BOUND_RADII[0]) };
    bounds.clamp(&mut phi);
    (NarrowBand { topology: Arc::new(topology), phi, half_width: HALF_WIDTH }, bounds)
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
fn thin_plate_smoothing_gives_a_noisy_sphere_back() {
    for (integrator, steps, step_size, redistance_every) in [
        (Integrator::Fast, 5, 20.0, 1),
        (Integrator::Implicit, 5, 20.0, 1),
        (Integrator::Explicit, 10_000, 0.01, 50),
    ] {
        let (mut band, bounds) = noisy_sphere();
        let config =
            Config { laplacian_steps: 0, integrator, steps, step_size, redistance_every, cg_tolerance: 1e-4 };
        smooth(&mut band, &bounds, &config);
        let volume = volume(&band) / ball_volume(RADIUS);
        let energy = bending_energy(&band) / (4.0 * PI);
        println!("{integrator:?}: volume {volume:.5}, ∫H² {energy:.4} of the sphere's");
        assert_eq!(bounds.violation_count(&band.phi), 0);
        assert!((volume - 1.0).abs() < 0.1, "{integrator:?}: {volume}");
        assert!((energy - 1.0).abs() < 0.5, "{integrator:?}: {energy}");
    }
}

#[test]
fn laplacian_smoothing_shrinks_a_noisy_sphere_onto_its_bound() {
    let (mut band, bounds) = noisy_sphere();
    smooth_laplacian_only(&mut band, &bounds, 1000);
    let [smallest, _] = BOUND_RADII;
    let volume = volume(&band);
    let beside = voxels(&band).filter(|(_, phi)| phi.abs() < 0.5);
    let upper = NarrowBand { phi: bounds.upper.clone(), ..band.clone() };
    let (mut count, mut bound_count) = (0, 0);
    for (voxel, phi) in beside {
        count += 1;
        bound_count += usize::from(value_at(&upper, voxel) == Some(phi));
    }
    println!(
        "Laplacian: volume {:.4} of the first, {:.4} of the bound's; {bound_count} of {count} at the bound",
        volume / ball_volume(RADIUS),
        volume / ball_volume(smallest)
    );
    assert_eq!(bounds.violation_count(&band.phi), 0);
    assert!((volume / ball_volume(smallest) - 1.0).abs() < 0.02);
    assert!(bound_count * 10 > count * 9, "{bound_count} of {count} voxels are at the bound");
}
#[test]
fn explore() {
    let radius = |band: &NarrowBand| {
        let radii: Vec<f64> = crate::shapes::crossings(band).iter().map(|p| p.as_dvec3().length()).collect();
        radii.iter().sum::<f64>() / radii.len() as f64
    };
    let (mut band, bounds) = noisy_sphere();
    band.phi = sphere_field(&band.topology);
    for i in 0..=200 {
        if i % 25 == 0 {
            println!("redistance only {i} radius {:.4}", radius(&band));
        }
        meniscus::level_set::redistance(&mut band, 8);
        bounds.clamp(&mut band.phi);
    }
    for noisy in [false, true] {
        let (mut band, bounds) = noisy_sphere();
        if !noisy {
            band.phi = sphere_field(&band.topology);
        }
        let mut total = 0;
        for steps in [0, 50, 50, 100, 200, 300, 300, 500, 500, 1000, 2000, 5000] {
            total += steps;
            let config = Config { laplacian_steps: 0, integrator: Integrator::Explicit, steps, step_size: 0.01, redistance_every: 50, cg_tolerance: 1e-4 };
            smooth(&mut band, &bounds, &config);
            println!("explicit noisy {noisy} {total} radius {:.4} energy {:.4}", radius(&band), bending_energy(&band) / (4.0 * PI));
        }
    }
    for noisy in [false, true] {
        let (mut band, bounds) = noisy_sphere();
        if !noisy {
            band.phi = sphere_field(&band.topology);
        }
        for step in 0..=5 {
            println!("fast noisy {noisy} {step} radius {:.4} energy {:.4}", radius(&band), bending_energy(&band) / (4.0 * PI));
            let config = Config { laplacian_steps: 0, integrator: Integrator::Fast, steps: 1, step_size: 20.0, redistance_every: 1, cg_tolerance: 1e-4 };
            smooth(&mut band, &bounds, &config);
        }
    }
}
fn sphere_field(topology: &Topology) -> Field {
        let leaf = |&origin: &IVec3| {
            let distance = |offset| (origin + voxel_in_leaf(offset)).as_vec3().length() - RADIUS;
            Leaf { values: std::array::from_fn(distance).map(|d: f32| d.clamp(-HALF_WIDTH, HALF_WIDTH)) }
        };
        Field { leaves: topology.origins().iter().map(leaf).collect() }
}
