//! The fast integrator: implicit steps solved by projected gradients with momentum.
//!
//! An implicit step (paper, Eq. 10) within bounds is a quadratic programme with a box:
//!
//! ```text
//!   minimize  ½ |x − φ|² + ½ Δt |∇²x|²   subject to  lower ≤ x ≤ upper
//!
//!   x⁺ = clamp( x − α (x − φ + Δt ∇⁴x) + β (x − x⁻) )         for every free voxel at once
//! ```
//!
//! The eigenvalues of its operator lie in [1, L] with L = 1 + 144 Δt for every frame there is, so α
//! and β are constants: there is no dot product, no line search and no restart. Each voxel depends on
//! the voxels within two of it a pass and on nothing else. That makes the result independent of the
//! number of threads, and of whatever happens far away; the paper's conjugate gradients are neither.
//!
//! ```text
//!   α = 4 / (√L + 1)²      β = ((√L − 1) / (√L + 1))²       error of a pass: 1 − 2/√L
//! ```
//!
//! Passes are 1.5 √L a step, 81 at the default Δt of 20 h⁴. On the dam breaks and the Hilbert curve
//! that leaves 0.003 to 0.015 voxels in the mean to the converged solution; Nesterov's momentum, with
//! whose convergence there is a proof, needs twice as many. Stabilized Runge–Kutta steps of 54 stages stay
//! 0.05 to 0.2 away, and 80 come no nearer: theirs is another discretization in time.
//!
//! This work is based on:
//! Boris Polyak. Some methods of speeding up the convergence of iteration methods. 1964

use rayon::prelude::*;

use super::Scratch;
use super::band::Band;
use super::biharmonic::{EIGENVALUE_MAX, inner_laplacian, rows_in};
use crate::grid::{Field, Neighborhood};
use crate::level_set::{Bounds, NarrowBand};

/// Passes in units of √L: the error that a pass leaves is 1 − 2/√L, so this leaves e⁻³.
const PASSES_PER_ROOT: f32 = 1.5;

/// The passes of a step of `step_size` h⁴: from the spectral bound alone, the same for all frames.
pub(super) fn iteration_count(step_size: f32) -> u32 {
    (PASSES_PER_ROOT * (1.0 + EIGENVALUE_MAX * step_size).sqrt()).ceil() as u32
}

/// Takes one implicit step of `step_size` h⁴ by `iterations` passes.
pub(super) fn step(
    band: &mut NarrowBand,
    bounds: &Bounds,
    region: &Band,
    step_size: f32,
    iterations: u32,
    scratch: &mut Scratch,
) {
    let root = (1.0 + EIGENVALUE_MAX * step_size).sqrt();
    let momentum = Momentum {
        step_size,
        alpha: 4.0 / ((root + 1.0) * (root + 1.0)),
        beta: ((root - 1.0) / (root + 1.0)) * ((root - 1.0) / (root + 1.0)),
    };
    let topology = band.topology.clone();
    let start = band.phi.clone();
    let previous = &mut scratch.values;
    previous.leaves.copy_from_slice(&start.leaves);
    for _ in 0..iterations {
        inner_laplacian(&topology, region, &band.phi, &mut scratch.laplacian);
        let fields = Fields { start: &start, current: &band.phi, laplacian: &scratch.laplacian, bounds };
        previous.leaves.par_iter_mut().enumerate().for_each(|(leaf, previous)| {
            let around = Neighborhood::new(&fields.laplacian.leaves, topology.neighbors(), leaf);
            for row in rows_in(region.free_rows[leaf]) {
                momentum.advance_row(&fields, &around, region, leaf, row, previous.row_mut(row));
            }
        });
        std::mem::swap(&mut band.phi, previous);
    }
}

/// What a pass reads.
struct Fields<'a> {
    /// φ at the start of the step.
    start: &'a Field,
    /// x.
    current: &'a Field,
    /// ∇²x.
    laplacian: &'a Field,
    bounds: &'a Bounds,
}

/// The constants of a step.
struct Momentum {
    step_size: f32,
    alpha: f32,
    beta: f32,
}

impl Momentum {
    /// Overwrites a row of x⁻ by x⁺ at its free voxels.
    #[inline]
    fn advance_row(
        &self,
        fields: &Fields,
        around: &Neighborhood,
        region: &Band,
        leaf: usize,
        row: usize,
        previous: &mut [f32; 8],
    ) {
        let biharmonic = around.laplacian(row);
        let free = region.free[leaf].row(row);
        let start = fields.start.leaves[leaf].row(row);
        let current = fields.current.leaves[leaf].row(row);
        let lower = fields.bounds.lower.leaves[leaf].row(row);
        let upper = fields.bounds.upper.leaves[leaf].row(row);
        for z in 0..8 {
            let gradient = (current[z] - start[z]) + self.step_size * biharmonic[z];
            let moved = current[z] - self.alpha * gradient + self.beta * (current[z] - previous[z]);
            let clamped = moved.max(lower[z]).min(upper[z]);
            previous[z] = if free >> z & 1 == 1 { clamped } else { previous[z] };
        }
    }
}
