//! Laplacian smoothing: φ ← φ + Δt ∇²φ |∇φ|, clamped to the bounds (paper, §3.1 and Alg. 1).
//!
//! A few steps of it take the grain off the union of spheres before the optimization begins. By
//! itself it shrinks whatever it smooths (paper, Fig. 5).

use rayon::prelude::*;

use super::band::Band;
use super::biharmonic::rows_in;
use crate::grid::Neighborhood;
use crate::level_set::{Bounds, NarrowBand};

/// Voxels with |φ| up to this are changed (Alg. 1, line 6).
const BAND_WIDTH: f32 = 4.0;

/// Takes `step_count` steps of `step_size` h².
pub(super) fn smooth_laplacian(band: &mut NarrowBand, bounds: &Bounds, step_count: u32, step_size: f32) {
    let topology = band.topology.clone();
    let mut next = band.phi.clone();
    for _ in 0..step_count {
        let region = Band::new(band, BAND_WIDTH);
        next.leaves.par_iter_mut().enumerate().for_each(|(leaf, next)| {
            let around = Neighborhood::new(&band.phi.leaves, topology.neighbors(), leaf);
            *next = band.phi.leaves[leaf];
            for row in rows_in(region.free_rows[leaf]) {
                let (laplacian, slope) = (around.laplacian(row), around.gradient_norm(row));
                let (lower, upper) = (bounds.lower.leaves[leaf].row(row), bounds.upper.leaves[leaf].row(row));
                let free = region.free[leaf].row(row);
                let next = next.row_mut(row);
                for z in 0..8 {
                    let moved = (next[z] + step_size * laplacian[z] * slope[z]).max(lower[z]).min(upper[z]);
                    next[z] = if free >> z & 1 == 1 { moved } else { next[z] };
                }
            }
        });
        std::mem::swap(&mut band.phi, &mut next);
    }
}
