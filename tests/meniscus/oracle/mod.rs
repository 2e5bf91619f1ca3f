//! The method against the paper's algorithms on a plain dense grid, in double precision: small,
//! obviously right, and written without a look at the sparse grid's loops.

mod dense;
mod distance;
mod flow;

use glam::DVec3;
use meniscus::level_set::NarrowBand;
use meniscus::smooth::Integrator;

use crate::shapes::{
    ball_with_finger, default_radii, rasterized, sheet_and_drops, skinned, two_balls, value_at,
};
use distance::LevelSet;

/// The shapes that everything here is tested on.
const SHAPES: [(&str, fn() -> Vec<DVec3>); 3] =
    [("ball with finger", ball_with_finger), ("two balls", two_balls), ("sheet and drops", sheet_and_drops)];

/// How far two results are apart where the dense one has |φ| ≤ 1, in voxels.
#[derive(Debug)]
struct Difference {
    mean: f64,
    max: f64,
    voxel_count: usize,
}

fn difference(band: &NarrowBand, dense: &LevelSet) -> Difference {
    let (mut sum, mut max, mut voxel_count) = (0.0, 0.0f64, 0);
    for (voxel, index) in dense.grid.voxels().filter(|&(_, index)| dense.phi[index].abs() <= 1.0) {
        let sparse = value_at(band, voxel).expect("the band holds every voxel beside the surface");
        let apart = (f64::from(sparse) - dense.phi[index]).abs();
        (sum, max, voxel_count) = (sum + apart, max.max(apart), voxel_count + 1);
    }
    Difference { mean: sum / voxel_count as f64, max, voxel_count }
}

#[test]
fn rasterizing_agrees_with_the_dense_grid() {
    for (name, shape) in SHAPES {
        let positions = shape();
        let (band, _) = rasterized(&positions);
        let apart = difference(&band, &distance::rasterized(&positions, default_radii()));
        println!("{name}: {} particles, rasterized {apart:?}", positions.len());
        assert!(apart.max < 1e-5, "{name}: {apart:?}");
    }
}

#[test]
fn explicit_steps_agree_with_the_dense_grid() {
    for (name, shape) in SHAPES {
        let positions = shape();
        let (band, ..) = skinned(&positions, Integrator::Explicit);
        let mut dense = distance::rasterized(&positions, default_radii());
        dense.smooth_laplacian(15);
        dense.smooth_explicit(500, 0.01, 50);
        let apart = difference(&band, &dense);
        println!("{name}: explicit {apart:?}");
        assert!(apart.max < 1e-3, "{name}: {apart:?}");
    }
}

#[test]
fn implicit_steps_agree_with_the_dense_grid() {
    for (name, shape) in SHAPES {
        let positions = shape();
        let (band, _, report) = skinned(&positions, Integrator::Implicit);
        let mut dense = distance::rasterized(&positions, default_radii());
        dense.smooth_laplacian(15);
        dense.smooth_implicit(5, 20.0);
        let apart = difference(&band, &dense);
        println!("{name}: implicit {apart:?} {:?}", report.convergence);
        assert!(apart.mean < 1e-3 && apart.max < 0.05, "{name}: {apart:?}");
    }
}

/// The fast integrator stops early: what it leaves is far below what can be seen.
#[test]
fn fast_steps_come_near_the_converged_solution() {
    for (name, shape) in SHAPES {
        let positions = shape();
        let (band, ..) = skinned(&positions, Integrator::Fast);
        let mut dense = distance::rasterized(&positions, default_radii());
        dense.smooth_laplacian(15);
        dense.smooth_converged(5, 20.0, 600);
        let apart = difference(&band, &dense);
        println!("{name}: fast {apart:?}");
        assert!(apart.mean < 0.03, "{name}: {apart:?}");
    }
}
