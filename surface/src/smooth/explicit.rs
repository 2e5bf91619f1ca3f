//! The paper's explicit integrator: φ ← φ − Δt ∇⁴φ |∇φ|, clamped to the bounds (Eq. 5, Alg. 1).
//!
//! The integrator is stable while 144 Δt/h⁴ < 2. In addition, a step should not move any value by more than a
//! voxel (Eq. 8). Steps either have a fixed size or are as large as these limits allow (§3.5):
//! Δt = min(h / v_max, safety · 2h⁴/144), where v_max is the maximum of |∇⁴φ| |∇φ|.
//!
//! The second limit is nearly always the smaller one. At exactly 2/144 the mode that alternates from voxel to
//! voxel oscillates forever, and where |∇φ| is above 1 it grows. A safety factor of 0.9 prevents both: this
//! mode decays to 80 % per step, and it still decays if |∇φ| is up to 1.11.

use rayon::prelude::*;

use super::FreeVoxels;
use super::schedule::Workspace;
use crate::grid::{Field, LEAVES_PER_TASK, Leaf, LeafMask, Neighborhood, Topology, slabs_in, vectors_in};
use crate::level_set::{Bounds, NarrowBand};
use crate::parallel::Loops as _;
use crate::simd::{self, Kernel, Lanes, Vector, WideKernel};

/// Takes one step of `step_size` h⁴. Returns the maximum change of a value in the `own` leaves, before
/// clamping, in voxels.
pub(super) fn step(
    band: &mut NarrowBand,
    bounds: &Bounds,
    region: &FreeVoxels,
    step_size: f32,
    workspace: &mut Workspace,
    own: Option<&[bool]>,
) -> f32 {
    inner_laplacian(&band.topology, region, &band.phi, &mut workspace.first);
    let moved_max = advance(band, bounds, region, step_size, workspace, own);
    std::mem::swap(&mut band.phi, &mut workspace.second);
    moved_max
}

/// Maximum adaptive step, in units of h⁴.
const ADAPTIVE_STEP_MAX: f32 = SAFETY * 2.0 / EIGENVALUE_MAX;

/// Safety factor of adaptive steps relative to the stability limit.
const SAFETY: f32 = 0.9;

/// Minimum adaptive step, in units of h⁴, so that the loop ends for any φ. Values in a band never change so
/// fast that a smaller step would be needed.
const ADAPTIVE_STEP_MIN: f32 = 1e-6;

/// Takes the largest allowed step, at most `step_size_max` h⁴. Returns its size.
pub(super) fn adaptive_step(
    band: &mut NarrowBand,
    bounds: &Bounds,
    region: &FreeVoxels,
    step_size_max: f32,
    workspace: &mut Workspace,
) -> f32 {
    inner_laplacian(&band.topology, region, &band.phi, &mut workspace.first);
    let mut step_size = step_size_max.min(ADAPTIVE_STEP_MAX);
    let moved_max = advance(band, bounds, region, step_size, workspace, None);
    if moved_max > 1.0 {
        step_size = (step_size / moved_max).max(ADAPTIVE_STEP_MIN);
        advance(band, bounds, region, step_size, workspace, None);
    }
    std::mem::swap(&mut band.phi, &mut workspace.second);
    step_size
}

/// Writes φ after a step of `step_size` h⁴ to `workspace.second`, and the inner Laplacian to
/// `workspace.first`. Returns the maximum change, like [`step`].
fn advance(
    band: &NarrowBand,
    bounds: &Bounds,
    region: &FreeVoxels,
    step_size: f32,
    workspace: &mut Workspace,
    own: Option<&[bool]>,
) -> f32 {
    let topology = &band.topology;
    let Workspace { first: laplacian, second: next } = workspace;
    let phi = &band.phi;
    let advance = |(leaf, next): (usize, &mut Leaf)| {
        *next = phi.leaves[leaf];
        let moved_max = simd::dispatch(Advance {
            laplacian: &Neighborhood::new(&laplacian.leaves, topology.neighbors(), leaf),
            phi: &Neighborhood::new(&phi.leaves, topology.neighbors(), leaf),
            bounds: bounds.of_leaf(leaf),
            free: &region.free[leaf],
            free_rows: region.free_rows[leaf],
            step_size,
            next,
        });
        if own.is_none_or(|own| own[leaf]) { moved_max } else { 0.0 }
    };
    // A maximum does not depend on the order of evaluation, so the result is deterministic.
    next.leaves.par_iter_mut().enumerate().halved().map(advance).reduce(|| 0.0, f32::max)
}

/// Kernel: a step of one leaf.
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

// Laplacian smoothing: φ ← φ + Δt ∇²φ |∇φ|, clamped to the bounds (paper, §3.1 and Alg. 1).
//
// A few steps smooth the union of spheres before the biharmonic steps. Alone, this flow shrinks everything
// it smooths (paper, Fig. 5).

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
                let bounds = bounds.of_leaf(leaf);
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

// The biharmonic operator ∇⁴φ = ∇²(∇²φ), computed by applying central differences twice (paper, Eq. 4).
//
// Its eigenvalues on the lattice lie in [0, 144] in units of 1/h⁴, because those of the 7-point Laplacian
// lie in [−12, 0].

/// The largest eigenvalue of the discrete biharmonic, in units of 1/h⁴.
pub const EIGENVALUE_MAX: f32 = 144.0;

/// First application: the Laplacian of `values` in the rows where it is needed, in voxel units.
pub(super) fn inner_laplacian(topology: &Topology, band: &FreeVoxels, values: &Field, laplacian: &mut Field) {
    let neighbors = topology.neighbors();
    laplacian.leaves.par_iter_mut().zip(&band.laplacian_rows).enumerate().halved().for_each(
        |(leaf, (laplacian, &rows))| {
            if rows == 0 {
                return;
            }
            let around = Neighborhood::new(&values.leaves, neighbors, leaf);
            simd::dispatch_wide(Laplacian { around: &around, rows, laplacian });
        },
    );
}

/// Kernel: the Laplacian of selected rows of a leaf; bit `x·8 + y` selects a row.
pub(super) struct Laplacian<'a> {
    pub(super) around: &'a Neighborhood<'a>,
    pub(super) rows: u64,
    pub(super) laplacian: &'a mut Leaf,
}

impl WideKernel for Laplacian<'_> {
    type Output = ();

    #[inline(always)]
    fn run<V: Vector>(self) {
        for (x, ys) in vectors_in::<V>(self.rows) {
            let slab = self.around.slab(x);
            for y in ys {
                slab.laplacian::<V>(y).store_at(self.laplacian.slab_mut(x), y);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use glam::IVec3;

    use super::*;
    use crate::grid::{Field, Topology};

    /// Noise within ± `amplitude` voxels on 27 leaves.
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
    fn adaptive_step_moves_values_by_at_most_one_voxel() {
        for (amplitude, is_stability_what_rules) in [(0.3, true), (2.9, false)] {
            let start = noise(amplitude);
            let count = start.topology.len();
            let bounds = Bounds::new(Field::splat(count, -6.0), Field::splat(count, 6.0));
            let region = FreeVoxels::new(&start.topology, &start.phi, 3.0);
            let mut workspace = Workspace::new(count);
            let mut band = start.clone();
            const SMALL: f32 = 1.0 / 65_536.0;
            let quickest = step(&mut band, &bounds, &region, SMALL, &mut workspace, None) / SMALL;
            assert_eq!(quickest < 1.0 / ADAPTIVE_STEP_MAX, is_stability_what_rules, "{quickest}");
            let mut band = start.clone();
            let time = adaptive_step(&mut band, &bounds, &region, 1.0, &mut workspace);
            let expected = ADAPTIVE_STEP_MAX.min(1.0 / quickest);
            assert!((time / expected - 1.0).abs() < 1e-4, "{time} {expected}");
            let values = |band: &NarrowBand| -> Vec<f32> {
                band.phi.leaves.iter().flat_map(|leaf| leaf.values).collect()
            };
            let moved = values(&start).into_iter().zip(values(&band)).map(|(old, new)| (new - old).abs());
            let moved_max = moved.fold(0.0, f32::max);
            assert!(moved_max <= 1.0001, "{moved_max}");
            assert!(is_stability_what_rules || moved_max > 0.999, "{moved_max}");
            // The remaining time is not exceeded.
            let mut band = start.clone();
            assert_eq!(adaptive_step(&mut band, &bounds, &region, 1e-5, &mut workspace), 1e-5);
        }
    }
}
