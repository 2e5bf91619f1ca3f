//! The paper's explicit integrator: φ ← φ − Δt ∇⁴φ |∇φ|, clamped to the bounds (Eq. 5, Alg. 1).
//!
//! Stable while 144 Δt/h⁴ < 2; and a step should move no value by more than a voxel (Eq. 8).

use rayon::prelude::*;

use super::acts::Memory;
use super::band::Band;
use super::biharmonic::inner_laplacian;
use crate::grid::{Leaf, LeafMask, Neighborhood, slabs_in};
use crate::level_set::{Bounds, NarrowBand};
use crate::simd::{self, Kernel, Lanes};

/// Takes one step of `step_size` h⁴. Returns the largest change of a value of the leaves that are `own`,
/// before it was clamped, in voxels.
pub(super) fn step(
    band: &mut NarrowBand,
    bounds: &Bounds,
    region: &Band,
    step_size: f32,
    memory: &mut Memory,
    own: Option<&[bool]>,
) -> f32 {
    let topology = band.topology.clone();
    let Memory { first: laplacian, second: next } = memory;
    inner_laplacian(&topology, region, &band.phi, laplacian);
    let phi = &band.phi;
    let advance = |(leaf, next): (usize, &mut Leaf)| {
        *next = phi.leaves[leaf];
        let moved_max = simd::dispatch(Advance {
            laplacian: &Neighborhood::new(&laplacian.leaves, topology.neighbors(), leaf),
            phi: &Neighborhood::new(&phi.leaves, topology.neighbors(), leaf),
            bounds: [&bounds.lower.leaves[leaf], &bounds.upper.leaves[leaf]],
            free: &region.free[leaf],
            free_rows: region.free_rows[leaf],
            step_size,
            next,
        });
        if own.is_none_or(|own| own[leaf]) { moved_max } else { 0.0 }
    };
    // The greatest of several numbers does not depend on their order.
    let moved_max = next.leaves.par_iter_mut().enumerate().map(advance).reduce(|| 0.0, f32::max);
    std::mem::swap(&mut band.phi, next);
    moved_max
}

/// A step of one leaf.
struct Advance<'a> {
    laplacian: &'a Neighborhood<'a>,
    phi: &'a Neighborhood<'a>,
    bounds: [&'a Leaf; 2],
    free: &'a LeafMask,
    free_rows: u64,
    step_size: f32,
    next: &'a mut Leaf,
}

impl Kernel for Advance<'_> {
    type Output = f32;

    #[inline(always)]
    fn run<V: Lanes>(self) -> f32 {
        let [lower, upper] = self.bounds;
        let (step_size, zero) = (V::splat(self.step_size), V::splat(0.0));
        let mut moved_max = zero;
        for (x, ys) in slabs_in(self.free_rows) {
            let (laplacian, around_phi) = (self.laplacian.slab(x), self.phi.slab(x));
            for y in ys {
                let row = x * 8 + y;
                let free = V::mask(self.free.row(row));
                let change = step_size.mul(laplacian.laplacian(y)).mul(around_phi.gradient_norm(y));
                moved_max = V::select(free, change.abs(), zero).max(moved_max);
                let phi = around_phi.row::<V>(y);
                let moved = phi.sub(change).max(V::load(lower.row(row))).min(V::load(upper.row(row)));
                V::select(free, moved, phi).store(self.next.row_mut(row));
            }
        }
        let mut greatest = [0.0; 8];
        moved_max.store(&mut greatest);
        greatest.into_iter().fold(0.0, f32::max)
    }
}
