//! The paper's explicit integrator: φ ← φ − Δt ∇⁴φ |∇φ|, clamped to the bounds (Eq. 5, Alg. 1).
//!
//! Stable while 144 Δt/h⁴ < 2; and a step should move no value by more than a voxel (Eq. 8). Steps all have the same size, or
//! each is as large as that allows (§3.5): Δt = min(h / v_max, safety · 2h⁴/144) with v_max the greatest |∇⁴φ| |∇φ| anywhere.
//!
//! Of the two bounds the second nearly always rules, and at exactly 2/144 it is none: there the mode that changes sign from voxel to
//! voxel swings on for ever, and where |∇φ| is above 1 it grows. Hence the safety: at 0.9 such a mode falls to four fifths in a step,
//! and |∇φ| may be up to 1.11 before it does not fall at all.

use rayon::prelude::*;

use super::acts::Memory;
use super::band::Band;
use super::biharmonic::{EIGENVALUE_MAX, inner_laplacian};
use crate::surface::grid::{Leaf, LeafMask, Neighborhood, slabs_in};
use crate::surface::level_set::{Bounds, NarrowBand};
use crate::surface::simd::{self, Kernel, Lanes};

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
    inner_laplacian(&band.topology, region, &band.phi, &mut memory.first);
    let moved_max = advance(band, bounds, region, step_size, memory, own);
    std::mem::swap(&mut band.phi, &mut memory.second);
    moved_max
}

/// The largest adaptive step, in units of h⁴.
const ADAPTIVE_STEP_MAX: f32 = SAFETY * 2.0 / EIGENVALUE_MAX;

/// How far below the stable bound adaptive steps stay.
const SAFETY: f32 = 0.9;

/// The least adaptive step, in units of h⁴, so that there is an end whatever φ is. In a band nothing is so quick that it would need less.
const ADAPTIVE_STEP_LEAST: f32 = 1e-6;

/// Takes one step that is as large as it may be, but no larger than `step_size_most` h⁴. Returns its size.
pub(super) fn adaptive_step(
    band: &mut NarrowBand,
    bounds: &Bounds,
    region: &Band,
    step_size_most: f32,
    memory: &mut Memory,
) -> f32 {
    inner_laplacian(&band.topology, region, &band.phi, &mut memory.first);
    let mut step_size = step_size_most.min(ADAPTIVE_STEP_MAX);
    let moved_max = advance(band, bounds, region, step_size, memory, None);
    if moved_max > 1.0 {
        step_size = (step_size / moved_max).max(ADAPTIVE_STEP_LEAST);
        advance(band, bounds, region, step_size, memory, None);
    }
    std::mem::swap(&mut band.phi, &mut memory.second);
    step_size
}

/// What φ is after a step of `step_size` h⁴, into the second field of the memory; the first holds the inner Laplacian.
/// Returns the largest change, as [`step`] does.
fn advance(
    band: &NarrowBand,
    bounds: &Bounds,
    region: &Band,
    step_size: f32,
    memory: &mut Memory,
    own: Option<&[bool]>,
) -> f32 {
    let topology = &band.topology;
    let Memory { first: laplacian, second: next } = memory;
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
    next.leaves.par_iter_mut().enumerate().map(advance).reduce(|| 0.0, f32::max)
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

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use glam::IVec3;

    use super::*;
    use crate::surface::grid::{Field, Topology};

    /// Noise within so many voxels of zero on 27 leaves.
    fn noise(amplitude: f32) -> NarrowBand {
        let origins = (0..27).map(|i| IVec3::new(i / 9, i / 3 % 3, i % 3) * 8);
        let topology = Topology::new(origins.collect());
        let mut phi = Field::splat(topology.len(), 0.0);
        let mut bits = 1u32;
        for value in phi.leaves.iter_mut().flat_map(|leaf| &mut leaf.values) {
            bits = bits.wrapping_mul(0x0019_660d).wrapping_add(0x3c6e_f35f);
            *value = amplitude * ((bits >> 8) as f32 / (1 << 23) as f32 - 1.0);
        }
        NarrowBand { topology: Arc::new(topology), phi, half_width: 6.0 }
    }

    #[test]
    fn an_adaptive_step_moves_no_value_by_more_than_a_voxel() {
        for (amplitude, is_stability_what_rules) in [(0.3, true), (2.9, false)] {
            let start = noise(amplitude);
            let count = start.topology.len();
            let bounds = Bounds { lower: Field::splat(count, -6.0), upper: Field::splat(count, 6.0) };
            let region = Band::new(&start.topology, &start.phi, 3.0);
            let mut memory = Memory::new(count);
            let mut band = start.clone();
            const SMALL: f32 = 1.0 / 65_536.0;
            let quickest = step(&mut band, &bounds, &region, SMALL, &mut memory, None) / SMALL;
            assert_eq!(quickest < 1.0 / ADAPTIVE_STEP_MAX, is_stability_what_rules, "{quickest}");
            let mut band = start.clone();
            let taken = adaptive_step(&mut band, &bounds, &region, 1.0, &mut memory);
            let expected = ADAPTIVE_STEP_MAX.min(1.0 / quickest);
            assert!((taken / expected - 1.0).abs() < 1e-4, "{taken} {expected}");
            let values = |band: &NarrowBand| -> Vec<f32> {
                band.phi.leaves.iter().flat_map(|leaf| leaf.values).collect()
            };
            let moved = values(&start).into_iter().zip(values(&band)).map(|(old, new)| (new - old).abs());
            let moved_max = moved.fold(0.0, f32::max);
            assert!(moved_max <= 1.0001, "{moved_max}");
            assert!(is_stability_what_rules || moved_max > 0.999, "{moved_max}");
            // What is left of the time is not exceeded.
            let mut band = start.clone();
            assert_eq!(adaptive_step(&mut band, &bounds, &region, 1e-5, &mut memory), 1e-5);
        }
    }
}
