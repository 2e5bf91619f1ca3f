//! Laplacian smoothing: φ ← φ + Δt ∇²φ |∇φ|, clamped to the bounds (paper, §3.1 and Alg. 1).
//!
//! A few steps smooth the union of spheres before the biharmonic steps. Alone, this flow shrinks everything
//! it smooths (paper, Fig. 5).

use rayon::prelude::*;

use crate::grid::{Field, LEAVES_PER_TASK, Leaf, Neighborhood, vectors_in};
use crate::level_set::{Bounds, NarrowBand};
use crate::parallel::Loops as _;
use crate::simd::{self, Vector, WideKernel};

/// Voxels with |φ| up to this are changed (Alg. 1, line 6).
const BAND_WIDTH: f32 = 4.0;

/// Takes `step_count` steps of `step_size` h². `next` is a scratch field as large as φ.
pub(super) fn smooth_laplacian(
    band: &mut NarrowBand,
    bounds: &Bounds,
    next: &mut Field,
    step_count: u32,
    step_size: f32,
) {
    let topology = band.topology.clone();
    for _ in 0..step_count {
        next.leaves.par_iter_mut().enumerate().with_max_len(LEAVES_PER_TASK).halved().for_each(
            |(leaf, next)| {
                let around = Neighborhood::new(&band.phi.leaves, topology.neighbors(), leaf);
                let bounds = [&bounds.lower.leaves[leaf], &bounds.upper.leaves[leaf]];
                simd::dispatch_wide(LaplacianStep { around: &around, bounds, step_size, next });
            },
        );
        std::mem::swap(&mut band.phi, next);
    }
}

/// Kernel: a step of one leaf.
struct LaplacianStep<'a> {
    around: &'a Neighborhood<'a>,
    bounds: [&'a Leaf; 2],
    step_size: f32,
    next: &'a mut Leaf,
}

impl WideKernel for LaplacianStep<'_> {
    type Output = ();

    #[inline(always)]
    fn run<V: Vector>(self) {
        let [lower, upper] = self.bounds;
        let step_size = V::splat(self.step_size);
        for (x, ys) in vectors_in::<V>(u64::MAX) {
            let slab = self.around.slab(x);
            let next = self.next.slab_mut(x);
            for y in ys {
                let phi = slab.row::<V>(y);
                let is_near = V::not(V::splat(BAND_WIDTH).lt(phi.abs()));
                if !V::any(is_near) {
                    phi.store_at(next, y);
                    continue;
                }
                let change = step_size.mul(slab.laplacian(y)).mul(slab.gradient_norm(y));
                let (lower, upper) = (V::load_at(lower.slab(x), y), V::load_at(upper.slab(x), y));
                let bounded = phi.add(change).max(lower).min(upper);
                V::select(is_near, bounded, phi).store_at(next, y);
            }
        }
    }
}
