//! The paper's implicit integrator: (I + Δt ∇⁴) φ⁺ = φ, solved by conjugate gradients with a growing active
//! set (Eq. 10, Alg. 2).
//!
//! ```text
//!   repeat until converged
//!      solve on the free voxels, with the others fixed
//!      if x violates its bounds somewhere: clamp it there, fix it from now on, restart
//! ```
//!
//! Within a step, fixed voxels never become free again, so the active set is a heuristic: the result is near
//! the constrained minimum, not at it. The dot products couple all voxels. They are summed leaf by leaf in a
//! fixed order, so the result does not depend on the number of threads.

use rayon::prelude::*;

use super::FreeVoxels;
use super::explicit::inner_laplacian;
use crate::grid::{Field, Leaf, LeafMask, Neighborhood, slabs_in};
use crate::level_set::{Bounds, NarrowBand};
use crate::parallel::Loops as _;
use crate::simd::{self, Kernel, Lanes};

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

// Conjugate gradients for (I + Δt ∇⁴) x = b on the free voxels of a band (paper, Alg. 2).
//
// Letters are the paper's: x the solution (stored in the band's φ), r the residual, d the search direction,
// δ = rᵀr. Only q differs: it is not A d, but the part Δt ∇⁴d of A d = d + q (Δt ∇⁴x at a restart). All of
// r, d and q are zero at voxels that are not free.

/// The state between iterations.
struct Solver {
    region: FreeVoxels,
    step_size: f32,
    b: Field,
    r: Field,
    d: Field,
    q: Field,
}

/// Result of an iteration.
enum SolveOutcome {
    /// x moved within its bounds.
    Advanced {
        /// δ after the iteration.
        residual: f64,
    },
    /// x reached its bounds at some voxels, which are now fixed: restart.
    MetBounds,
}

impl Solver {
    /// A solver for the step that starts at the band's φ.
    pub(super) fn new(band: &NarrowBand, region: FreeVoxels, step_size: f32) -> Solver {
        let zero = || Field::splat(band.topology.len(), 0.0);
        Solver { region, step_size, b: band.phi.clone(), r: zero(), d: zero(), q: zero() }
    }

    /// Computes r = b − A x and d = r for the current free voxels. Returns δ.
    pub(super) fn restart(&mut self, band: &NarrowBand, laplacian: &mut Field) -> f64 {
        self.apply(band, Operand::Solution, laplacian);
        let (b, q, region) = (&self.b, &self.q, &self.region);
        let x = &band.phi;
        let residual = |(leaf, (r, d)): (usize, (&mut Leaf, &mut Leaf))| {
            *r = Leaf::splat(0.0);
            for offset in region.free[leaf].iter() {
                // A x = x + q, so r = (b − x) − q. b is φ at the start of the step.
                r.values[offset] = (b.leaves[leaf].values[offset] - x.leaves[leaf].values[offset])
                    - q.leaves[leaf].values[offset];
            }
            *d = *r;
            dot(r, r)
        };
        sum(self.r.leaves.par_iter_mut().zip(&mut self.d.leaves).enumerate().halved().map(residual))
    }

    /// One iteration from δ = `residual`; updates the band's φ.
    pub(super) fn iterate(
        &mut self,
        band: &mut NarrowBand,
        bounds: &Bounds,
        residual: f64,
        laplacian: &mut Field,
    ) -> SolveOutcome {
        self.apply(band, Operand::Direction, laplacian);
        let (d, q) = (&self.d, &self.q);
        // q holds Δt ∇⁴ d: A d = d + q.
        let curvature = sum(d.leaves.par_iter().zip(&q.leaves).halved().map(|(d, q)| dot(d, d) + dot(d, q)));
        let alpha = (residual / curvature) as f32;
        let x = band.phi.leaves.par_iter_mut();
        let fields = x.zip(&mut self.r.leaves).zip(&mut self.region.free).enumerate().halved();
        let advanced = fields.map(|(leaf, ((x, r), free))| {
            let (d, q) = (&d.leaves[leaf], &q.leaves[leaf]);
            let [lower, upper] = bounds.of_leaf(leaf);
            SolverLeaf { x, r, d, q, free, lower, upper }.advance(alpha)
        });
        let met: usize = advanced.sum();
        if met > 0 {
            self.region.recount_free_rows();
            return SolveOutcome::MetBounds;
        }
        let residual_now = sum(self.r.leaves.par_iter().halved().map(|r| dot(r, r)));
        let beta = (residual_now / residual) as f32;
        self.d.leaves.par_iter_mut().zip(&self.r.leaves).halved().for_each(|(d, r)| {
            for (d, r) in d.values.iter_mut().zip(&r.values) {
                *d = r + beta * *d;
            }
        });
        SolveOutcome::Advanced { residual: residual_now }
    }

    /// q = Δt ∇⁴ of the solution or of the search direction, on the free voxels.
    fn apply(&mut self, band: &NarrowBand, operand: Operand, laplacian: &mut Field) {
        let values = match operand {
            Operand::Solution => &band.phi,
            Operand::Direction => &self.d,
        };
        inner_laplacian(&band.topology, &self.region, values, laplacian);
        let (region, step_size) = (&self.region, self.step_size);
        self.q.leaves.par_iter_mut().enumerate().halved().for_each(|(leaf, q)| {
            *q = Leaf::splat(0.0);
            let around = &Neighborhood::new(&laplacian.leaves, band.topology.neighbors(), leaf);
            let (free, free_rows) = (&region.free[leaf], region.free_rows[leaf]);
            simd::dispatch(Outer { around, free, free_rows, step_size, q });
        });
    }
}

/// Kernel: q = Δt ∇²(∇²·) on the free voxels of a leaf, from the inner Laplacian ∇²·.
struct Outer<'a> {
    around: &'a Neighborhood<'a>,
    free: &'a LeafMask,
    free_rows: u64,
    step_size: f32,
    /// Must be zero on entry.
    q: &'a mut Leaf,
}

impl Kernel for Outer<'_> {
    type Output = ();

    #[inline(always)]
    fn run<V: Lanes>(self) {
        for (x, ys) in slabs_in(self.free_rows) {
            let slab = self.around.slab(x);
            for y in ys {
                let row = x * 8 + y;
                let scaled = V::splat(self.step_size).mul(slab.laplacian(y));
                V::select(V::mask(self.free.row(row)), scaled, V::splat(0.0)).store(self.q.row_mut(row));
            }
        }
    }
}

enum Operand {
    Solution,
    Direction,
}

/// A leaf of all fields of an iteration.
struct SolverLeaf<'a> {
    x: &'a mut Leaf,
    r: &'a mut Leaf,
    d: &'a Leaf,
    q: &'a Leaf,
    free: &'a mut LeafMask,
    lower: &'a Leaf,
    upper: &'a Leaf,
}

impl SolverLeaf<'_> {
    /// x += α d and r −= α A d. Voxels that leave their bounds are clamped and fixed. Returns their number.
    fn advance(self, alpha: f32) -> usize {
        let SolverLeaf { x, r, d, q, free, lower, upper } = self;
        let mut held = LeafMask::EMPTY;
        for offset in free.iter() {
            let moved = x.values[offset] + alpha * d.values[offset];
            let clamped = moved.max(lower.values[offset]).min(upper.values[offset]);
            x.values[offset] = clamped;
            r.values[offset] -= alpha * (d.values[offset] + q.values[offset]);
            if clamped != moved {
                held.insert(offset);
            }
        }
        free.remove_all(&held);
        held.count() as usize
    }
}

/// Dot product of two leaves, in double precision and in a fixed order.
fn dot(a: &Leaf, b: &Leaf) -> f64 {
    (0..64)
        .map(|row| a.row(row).iter().zip(b.row(row)).map(|(a, b)| f64::from(*a) * f64::from(*b)).sum::<f64>())
        .sum()
}

/// Sum over leaves in a fixed order, on any number of threads.
fn sum(parts: impl IndexedParallelIterator<Item = f64>) -> f64 {
    let mut ordered = Vec::new();
    parts.collect_into_vec(&mut ordered);
    ordered.iter().sum()
}
