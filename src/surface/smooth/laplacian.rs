//! Laplacian smoothing: φ ← φ + Δt ∇²φ |∇φ|, clamped to the bounds (paper, §3.1 and Alg. 1).
//!
//! A few steps smooth the union of spheres before the biharmonic steps. Alone, this flow shrinks everything
//! it smooths (paper, Fig. 5).

use rayon::prelude::*;

use super::free_voxels::near_bits;
use crate::surface::grid::{Field, LEAVES_PER_TASK, Leaf, Neighborhood};
use crate::surface::level_set::{Bounds, NarrowBand};
use crate::surface::simd::{self, Kernel, Lanes};

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
        next.leaves.par_iter_mut().enumerate().with_max_len(LEAVES_PER_TASK).for_each(|(leaf, next)| {
            let around = Neighborhood::new(&band.phi.leaves, topology.neighbors(), leaf);
            let bounds = [&bounds.lower.leaves[leaf], &bounds.upper.leaves[leaf]];
            simd::dispatch(LaplacianStep { around: &around, bounds, step_size, next });
        });
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

impl Kernel for LaplacianStep<'_> {
    type Output = ();

    #[inline(always)]
    fn run<V: Lanes>(self) {
        let [lower, upper] = self.bounds;
        let step_size = V::splat(self.step_size);
        for x in 0..8 {
            let slab = self.around.slab(x);
            for y in 0..8 {
                let row = x * 8 + y;
                let phi = slab.row::<V>(y);
                let near = near_bits(phi, BAND_WIDTH);
                if near == 0 {
                    phi.store(self.next.row_mut(row));
                    continue;
                }
                let change = step_size.mul(slab.laplacian(y)).mul(slab.gradient_norm(y));
                let bounded = phi.add(change).max(V::load(lower.row(row))).min(V::load(upper.row(row)));
                V::select(V::mask(near), bounded, phi).store(self.next.row_mut(row));
            }
        }
    }
}
