//! The paper's explicit integrator: φ ← φ − Δt ∇⁴φ |∇φ|, clamped to the bounds (Eq. 5, Alg. 1).
//!
//! Stable while 144 Δt/h⁴ < 2; and a step should move no value by more than a voxel (Eq. 8).

use rayon::prelude::*;

use super::Scratch;
use super::band::Band;
use super::biharmonic::{inner_laplacian, rows_in};
use crate::grid::Neighborhood;
use crate::level_set::{Bounds, NarrowBand};

/// Takes one step of `step_size` h⁴. Returns the largest change of a value before it was clamped,
/// in voxels.
pub(super) fn step(
    band: &mut NarrowBand,
    bounds: &Bounds,
    region: &Band,
    step_size: f32,
    scratch: &mut Scratch,
) -> f32 {
    let topology = band.topology.clone();
    inner_laplacian(&topology, region, &band.phi, &mut scratch.first);
    let (phi, laplacian, next) = (&band.phi, &scratch.first, &mut scratch.second);
    let advance = |(leaf, next): (usize, &mut crate::grid::Leaf)| {
        *next = phi.leaves[leaf];
        let around = Neighborhood::new(&laplacian.leaves, topology.neighbors(), leaf);
        let around_phi = Neighborhood::new(&phi.leaves, topology.neighbors(), leaf);
        let mut moved_max = 0.0f32;
        for row in rows_in(region.free_rows[leaf]) {
            let (biharmonic, slope) = (around.laplacian(row), around_phi.gradient_norm(row));
            let free = region.free[leaf].row(row);
            let (lower, upper) = (bounds.lower.leaves[leaf].row(row), bounds.upper.leaves[leaf].row(row));
            let next = next.row_mut(row);
            for z in (0..8).filter(|z| free >> z & 1 == 1) {
                let change = step_size * biharmonic[z] * slope[z];
                moved_max = moved_max.max(change.abs());
                next[z] = (next[z] - change).max(lower[z]).min(upper[z]);
            }
        }
        moved_max
    };
    // The greatest of several numbers does not depend on their order.
    let moved_max = next.leaves.par_iter_mut().enumerate().map(advance).reduce(|| 0.0, f32::max);
    std::mem::swap(&mut band.phi, &mut scratch.second);
    moved_max
}
