//! The paper's implicit integrator: (I + Δt ∇⁴) φ⁺ = φ, solved by conjugate gradients with a growing active
//! set (Eq. 10, Alg. 2).
//!
//! ```text
//!   repeat until converged
//!      solve on the free voxels, with the others fixed         conjugate_gradient.rs
//!      if x violates its bounds somewhere: clamp it there, fix it from now on, restart
//! ```
//!
//! Within a step, fixed voxels never become free again, so the active set is a heuristic: the result is near
//! the constrained minimum, not at it. The dot products couple all voxels. They are summed leaf by leaf in a
//! fixed order, so the result does not depend on the number of threads.

use super::conjugate_gradient::{SolveOutcome, Solver};
use super::free_voxels::FreeVoxels;
use crate::grid::Field;
use crate::level_set::{Bounds, NarrowBand};

/// Maximum number of conjugate gradient iterations per step (paper, §3.7).
const ITERATIONS_MAX: usize = 1500;

/// How the conjugate gradients of [`Integrator::Implicit`](crate::Integrator::Implicit) converged.
#[derive(Clone, Copy, Debug, Default, PartialEq, serde::Serialize)]
#[non_exhaustive]
pub struct Convergence {
    /// Number of conjugate gradient iterations.
    pub iterations: usize,
    /// Number of restarts because a voxel reached its bound.
    pub restarts: usize,
    /// ‖r‖ / ‖r₀‖ at the end of a step; the maximum over all steps.
    pub residual: f64,
    /// True if every step reached its tolerance.
    pub reached: bool,
}

impl Convergence {
    /// Number of applications of the operator.
    pub(super) fn pass_count(&self) -> usize {
        self.iterations + self.restarts + 1
    }

    /// Combines this step's record with that of the steps before it.
    pub(super) fn merge(self, before: Option<Convergence>) -> Convergence {
        let Some(before) = before else { return self };
        Convergence {
            iterations: self.iterations + before.iterations,
            restarts: self.restarts + before.restarts,
            residual: self.residual.max(before.residual),
            reached: self.reached && before.reached,
        }
    }
}

/// Takes one implicit step of `step_size` h⁴ to a relative residual of `tolerance`.
pub(super) fn step(
    band: &mut NarrowBand,
    bounds: &Bounds,
    region: FreeVoxels,
    step_size: f32,
    tolerance: f64,
    laplacian: &mut Field,
) -> Convergence {
    let mut solver = Solver::new(band, region, step_size);
    let first = solver.restart(band, laplacian);
    let mut convergence = Convergence { reached: first == 0.0, ..Convergence::default() };
    let (mut restart, mut residual) = (first, first);
    while !convergence.reached && convergence.iterations < ITERATIONS_MAX {
        convergence.iterations += 1;
        match solver.iterate(band, bounds, residual, laplacian) {
            SolveOutcome::Advanced { residual: now } => residual = now,
            SolveOutcome::MetBounds => {
                convergence.restarts += 1;
                restart = solver.restart(band, laplacian);
                residual = restart;
            }
        }
        // Squared norms, relative to the larger of two initial residuals: that of the step, and that of its
        // last restart (Alg. 2, line 26).
        convergence.reached = residual <= tolerance * tolerance * first.max(restart);
    }
    convergence.residual = if first > 0.0 { (residual / first).sqrt() } else { 0.0 };
    convergence
}
