//! The default integrator: implicit steps solved by projected gradients with momentum (Polyak's heavy ball).
//!
//! An implicit step (paper, Eq. 10) within bounds is a box-constrained quadratic program:
//!
//! ```text
//!   minimize  ½ |x − φ|² + ½ Δt |∇²x|²   subject to  lower ≤ x ≤ upper
//!
//!   x⁺ = clamp( x − α (x − φ + Δt ∇⁴x) + β (x − x⁻) )         for every free voxel at once
//! ```
//!
//! x⁻ is the previous iterate and x⁺ the next one. The eigenvalues of the operator I + Δt ∇⁴ lie in [1, L]
//! with L = 1 + 144 Δt for every frame, so α and β are constants: no dot product, line search or restart is
//! needed. In each pass a voxel depends only on voxels up to two away. So the result does not depend on
//! distant parts of the frame, nor on the number of threads. The dot products of conjugate gradients couple
//! all voxels, and are independent of the number of threads only because `implicit` sums them in a fixed
//! order.
//!
//! ```text
//!   α = 4 / (√L + 1)²      β = ((√L − 1) / (√L + 1))²       error factor per pass: 1 − 2/√L
//! ```
//!
//! A mode with an eigenvalue near one is wider than the layer of free voxels along a surface. It exists only
//! in the *thick* region, where two layers merge (see [`thickness`](super::thickness)). Elsewhere, in the
//! *thin* region, the smallest eigenvalue is l = 1 + 0.1 Δt, so √l times fewer passes are enough.
//!
//! ```text
//!                 passes per step       last step          at Δt = 20 h⁴ (preset paper)
//!   thin            √(L/l)                 1.5 √(L/l)           31, 47
//!   thick           √L                     1.5 √L               54, 81
//! ```
//!
//! The last step has more passes because no later step removes its remaining error. Each step but the first
//! starts from an extrapolation: the flow slows down steadily, so 0.6 times the previous step's change is a
//! good prediction.
//!
//! On the dam breaks and the Hilbert curve, the mean distance to the converged solution is 0.004 to 0.02
//! voxels. Nesterov's momentum, which has a convergence proof, needs twice as many passes; Chebyshev
//! coefficients, optimal without bounds, need a quarter more. Stabilized Runge–Kutta steps with 54 stages
//! stay 0.05 to 0.2 voxels away, and 80 stages are no closer, because they discretize time differently.
//!
//! A pass streams up to five fields from memory and writes one. From main memory, it reaches 60 % of the roofline
//! that a triad sets on two threads; from a cache, instructions limit it (docs/performance.md, Stages).
//!
//! This work is based on:
//! Boris Polyak. Some methods of speeding up the convergence of iteration methods. 1964

use std::cell::RefCell;
use std::ops::Range;

use rayon::prelude::*;

use super::explicit::{EIGENVALUE_MAX, Laplacian};
use super::{FreeVoxels, thick};
use crate::grid::{Direction, Field, Leaf, LeafMask, NO_LEAF, Neighborhood, ROW_COUNT, Topology, vectors_in};
use crate::level_set::{Bounds, NarrowBand};
use crate::parallel::Loops as _;
use crate::simd::{self, Kernel, Lanes, Vector, WideKernel};

/// What a step of 1 h⁴ adds to the smallest eigenvalue where the region is thin. A plate of width w that is
/// clamped on both sides adds (4.73/w)⁴. The value 0.1 corresponds to w = 8.4 voxels, about the widest layer
/// without a deep voxel (see `thickness`). Most layers are narrower, and add more.
const STIFFNESS_THIN: f32 = 0.1;

/// Passes per step and in the last step, in units of the square root of the condition number. Each pass
/// multiplies the error by 1 − 2/root, so these numbers of passes reduce the error to e⁻² and e⁻³.
const PASSES_PER_ROOT: [f32; 2] = [1.0, 1.5];

/// Fraction of a step's change that the next step is predicted to repeat.
const PREDICTED_REPETITION: f32 = 0.6;

/// Upper limit of the predicted change, in voxels.
const PREDICTED_CHANGE_MAX: f32 = 1.0;

/// Coefficients and pass counts of a step. They follow from the bounds of the eigenvalues alone, so they are
/// the same for all frames.
#[derive(Clone, Copy, Debug)]
pub(super) struct StepParams {
    step_size: f32,
    alpha: f32,
    /// β in the thin and in the thick region.
    beta: [f32; 2],
    /// Number of passes in the thin and in the thick region.
    passes: [u32; 2],
}

impl StepParams {
    /// The parameters of a step of `step_size` h⁴.
    pub(super) fn new(step_size: f32, is_last: bool) -> StepParams {
        let greatest = 1.0 + EIGENVALUE_MAX * step_size;
        let root = greatest.sqrt();
        let least = [1.0 + STIFFNESS_THIN * step_size, 1.0];
        let beta = least.map(|least| ((root - least.sqrt()) / (root + least.sqrt())).powi(2));
        let per_root = PASSES_PER_ROOT[usize::from(is_last)];
        StepParams {
            step_size,
            // The regions are adjacent, so both use the smaller of the two values.
            alpha: 4.0 / (root + least[0].sqrt()).powi(2),
            beta,
            passes: least.map(|least| (per_root * (greatest / least).sqrt()).ceil() as u32),
        }
    }

    /// The larger number of passes.
    pub(super) fn passes_max(&self) -> u32 {
        self.passes[1]
    }
}

/// A step in progress, on borrowed fields.
pub(super) struct HeavyBall<'a> {
    pub(super) band: &'a mut NarrowBand,
    pub(super) bounds: &'a Bounds,
    /// φ at the start of the step. Before `predict` it still is φ at the start of the previous step.
    pub(super) start: &'a mut Field,
    /// x⁻.
    pub(super) previous: &'a mut Field,
    pub(super) params: StepParams,
    /// For each leaf, true if its voxels are counted; `None` for all.
    pub(super) own: Option<&'a [bool]>,
}

impl HeavyBall<'_> {
    /// Runs some passes of an implicit step with the free voxels `region`. Returns the number of voxel
    /// updates.
    pub(super) fn passes(&mut self, region: FreeVoxels, is_first_step: bool, passes: Range<u32>) -> u64 {
        let topology = self.band.topology.clone();
        let thick = thick(&topology, &region.free);
        if passes.start == 0 {
            self.predict(&region, if is_first_step { 0.0 } else { PREDICTED_REPETITION });
        }
        let [thin_end, thick_end] = self.params.passes;
        let count_until = |end: u32| passes.end.min(end).saturating_sub(passes.start);
        let together = count_until(thin_end);
        let voxel_update_count = self.pass(&region, &thick, together);
        let alone = count_until(thick_end) - together;
        if alone == 0 || thick.par_iter().halved().all(LeafMask::is_empty) {
            return voxel_update_count;
        }
        // Voxels that stop being updated must have the same value in both buffers.
        let fields = self.previous.leaves.par_iter_mut().zip(&self.band.phi.leaves).zip(&thick);
        fields
            .halved()
            .for_each(|((previous, phi), thick)| simd::dispatch(CopyFrozen { previous, phi, thick }));
        voxel_update_count + self.pass(&FreeVoxels::of(&topology, thick.clone()), &thick, alone)
    }

    /// Sets x and x⁻ to the prediction, and stores the band's φ as the start.
    fn predict(&mut self, region: &FreeVoxels, repetition: f32) {
        self.leaves_mut(region).for_each(|leaf| simd::dispatch(Predict { leaf, repetition }));
    }

    fn leaves_mut<'l>(&'l mut self, region: &'l FreeVoxels) -> impl ParallelIterator<Item = StepLeaf<'l>> {
        let bounds = self.bounds;
        let phi = self.band.phi.leaves.par_iter_mut();
        let fields = phi.zip(&mut self.start.leaves).zip(&mut self.previous.leaves).enumerate();
        fields.halved().map(|(leaf, ((phi, start), previous))| StepLeaf {
            phi,
            start,
            previous,
            bounds: bounds.of_leaf(leaf),
            free: &region.free[leaf],
        })
    }

    /// Runs `count` passes over the region. Afterwards the band's φ is x. Returns the number of voxel
    /// updates.
    fn pass(&mut self, region: &FreeVoxels, thick: &[LeafMask], count: u32) -> u64 {
        if count == 0 {
            return 0;
        }
        let topology = self.band.topology.clone();
        let blocks = CacheBlock::all(&topology, region);
        for _ in 0..count {
            let (start, current, bounds) = (&*self.start, &self.band.phi, self.bounds);
            let fields = Fields { topology: &topology, region, thick, start, current, bounds };
            let params = &self.params;
            pair_with_leaves(&blocks, &mut self.previous.leaves)
                .into_par_iter()
                .with_max_len(1)
                .halved()
                .for_each(|(block, previous)| {
                    SCRATCH.with_borrow_mut(|laplacians| {
                        simd::dispatch_wide(BlockPass {
                            fields: &fields,
                            params,
                            block,
                            laplacians,
                            previous,
                        });
                    });
                });
            std::mem::swap(&mut self.band.phi, self.previous);
        }
        region.free_count(self.own) * u64::from(count)
    }
}

/// A leaf of all fields of a step.
struct StepLeaf<'a> {
    /// φ; becomes x.
    phi: &'a mut Leaf,
    /// φ at the start of the previous step; becomes that of this step.
    start: &'a mut Leaf,
    /// x⁻.
    previous: &'a mut Leaf,
    bounds: [&'a Leaf; 2],
    free: &'a LeafMask,
}

/// Kernel: predicts the values of a leaf from which the passes start.
struct Predict<'a> {
    leaf: StepLeaf<'a>,
    repetition: f32,
}

impl Kernel for Predict<'_> {
    type Output = ();

    #[inline(always)]
    fn run<V: Lanes>(self) {
        let StepLeaf { phi, start, previous, bounds: [lower, upper], free } = self.leaf;
        let (repetition, limit) = (V::splat(self.repetition), PREDICTED_CHANGE_MAX);
        for row in 0..ROW_COUNT {
            let value = V::load(phi.row(row));
            let change = value.sub(V::load(start.row(row))).max(V::splat(-limit)).min(V::splat(limit));
            let expected = value.add(repetition.mul(change));
            let bounded = expected.max(V::load(lower.row(row))).min(V::load(upper.row(row)));
            value.store(start.row_mut(row));
            V::select(V::mask(free.row(row)), bounded, value).store(phi.row_mut(row));
        }
        *previous = *phi;
    }
}

thread_local! {
    /// The inner Laplacians of a block and its halo.
    static SCRATCH: RefCell<Vec<Leaf>> = const { RefCell::new(Vec::new()) };
}

/// Pairs each block with its leaves of a field.
fn pair_with_leaves<'a>(
    blocks: &'a [CacheBlock],
    leaves: &'a mut [Leaf],
) -> Vec<(&'a CacheBlock, &'a mut [Leaf])> {
    let (mut rest, mut passed) = (leaves, 0);
    blocks
        .iter()
        .map(|block| {
            let (_, from_start) = std::mem::take(&mut rest).split_at_mut(block.leaves.start - passed);
            let (own, after) = from_start.split_at_mut(block.leaves.len());
            (rest, passed) = (after, block.leaves.end);
            (block, own)
        })
        .collect()
}

/// The fields that a pass reads.
struct Fields<'a> {
    topology: &'a Topology,
    region: &'a FreeVoxels,
    thick: &'a [LeafMask],
    /// φ at the start of the step.
    start: &'a Field,
    /// x.
    current: &'a Field,
    bounds: &'a Bounds,
}

/// Kernel: copies x to x⁻ outside the thick region.
struct CopyFrozen<'a> {
    previous: &'a mut Leaf,
    phi: &'a Leaf,
    thick: &'a LeafMask,
}

impl Kernel for CopyFrozen<'_> {
    type Output = ();

    #[inline(always)]
    fn run<V: Lanes>(self) {
        for row in 0..ROW_COUNT {
            let (previous, phi) = (V::load(self.previous.row(row)), V::load(self.phi.row(row)));
            V::select(V::mask(self.thick.row(row)), previous, phi).store(self.previous.row_mut(row));
        }
    }
}

/// Kernel: a pass over a block.
struct BlockPass<'a> {
    fields: &'a Fields<'a>,
    params: &'a StepParams,
    block: &'a CacheBlock,
    laplacians: &'a mut Vec<Leaf>,
    /// x⁻ of the block's leaves; becomes x⁺.
    previous: &'a mut [Leaf],
}

impl WideKernel for BlockPass<'_> {
    type Output = ();

    #[inline(always)]
    fn run<V: Vector>(self) {
        let BlockPass { fields, params, block, laplacians, previous } = self;
        let count = block.leaves.len() + block.halo.len();
        if laplacians.len() < count {
            laplacians.resize(count, Leaf::splat(0.0));
        }
        let own = block.leaves.clone().map(|leaf| (leaf, fields.region.laplacian_rows[leaf]));
        let halo = block.halo.iter().map(|&(leaf, rows)| (leaf as usize, rows));
        for ((leaf, rows), laplacian) in own.chain(halo).zip(laplacians.iter_mut()) {
            let around = Neighborhood::new(&fields.current.leaves, fields.topology.neighbors(), leaf);
            Laplacian { around: &around, rows, laplacian }.run::<V>();
        }
        for ((leaf, neighbors), previous) in block.leaves.clone().zip(&block.neighbors).zip(previous) {
            let rows = fields.region.free_rows[leaf];
            if rows == 0 {
                continue;
            }
            let local_index = leaf - block.leaves.start;
            let around = Neighborhood::of(
                &laplacians[local_index],
                neighbors.map(|local_index| laplacians.get(local_index as usize)),
            );
            let (start, current) = (&fields.start.leaves[leaf], &fields.current.leaves[leaf]);
            let [lower, upper] = fields.bounds.of_leaf(leaf);
            let free = &fields.region.free[leaf];
            let thick = &fields.thick[leaf];
            let [beta_thin, beta_thick] = params.beta.map(V::splat);
            for (x, ys) in vectors_in::<V>(rows) {
                let slab = around.slab(x);
                for y in ys {
                    let values = [start, current, &*previous].map(|leaf| V::load_at(leaf.slab(x), y));
                    let bounds = [lower, upper].map(|leaf| V::load_at(leaf.slab(x), y));
                    let is_thick = V::mask_at(thick.words[x & 7], y);
                    let beta = V::select(is_thick, beta_thick, beta_thin);
                    let moved = params.advance(beta, slab.laplacian(y), values, bounds);
                    let is_free = V::mask_at(free.words[x & 7], y);
                    V::select(is_free, moved, values[2]).store_at(previous.slab_mut(x), y);
                }
            }
        }
    }
}

impl StepParams {
    /// Computes x⁺ of a vector.
    #[inline(always)]
    fn advance<V: Vector>(
        &self,
        beta: V,
        biharmonic: V,
        [start, current, previous]: [V; 3],
        [lower, upper]: [V; 2],
    ) -> V {
        let gradient = current.sub(start).add(V::splat(self.step_size).mul(biharmonic));
        let inertia = beta.mul(current.sub(previous));
        let moved = current.sub(V::splat(self.alpha).mul(gradient)).add(inertia);
        moved.max(lower).min(upper)
    }
}

// Cache blocking: leaves processed together so that the inner Laplacian stays in the cache.
//
//     halo ▫▫▫▫▫▫         block: consecutive leaves in the topology's order, which are also
//        ▫ ■■■■■■ ▫       neighbors in space
//        ▫ ■■■■■■ ▫
//          ▫▫▫▫▫▫         halo: their neighbors, of which one layer of voxels is needed
//
// The biharmonic operator applies the same stencil twice. Applied to the whole frame, the inner Laplacian of
// every leaf would be written to memory and read back. A block keeps it in scratch memory that fits into a
// core's cache, and computes the halo's Laplacian redundantly. That is a tenth more work for half the memory
// traffic, and one loop per pass instead of two.

/// Leaves per block: their inner Laplacians take 128 kB of a core's cache, beside the streamed fields.
const BLOCK_LEAVES: usize = 64;

/// Some leaves and their halo.
struct CacheBlock {
    /// The leaves.
    pub(super) leaves: Range<usize>,
    /// Leaves outside the block, with a mask of the required rows: bit `x·8 + y`.
    pub(super) halo: Vec<(u32, u64)>,
    /// For each leaf, the local indices of its six neighbors: block leaves first, then halo leaves.
    pub(super) neighbors: Vec<[u32; 6]>,
}

impl CacheBlock {
    /// Splits a topology into blocks, without leaves that have no free voxel.
    pub(super) fn all(topology: &Topology, band: &FreeVoxels) -> Vec<CacheBlock> {
        (0..topology.len().div_ceil(BLOCK_LEAVES))
            .into_par_iter()
            .halved()
            .map(|index| {
                let first = index * BLOCK_LEAVES;
                CacheBlock::new(topology, band, first..topology.len().min(first + BLOCK_LEAVES))
            })
            .filter(|block| band.free_rows[block.leaves.clone()].iter().any(|&rows| rows != 0))
            .collect()
    }

    fn new(topology: &Topology, band: &FreeVoxels, leaves: Range<usize>) -> CacheBlock {
        let mut block = CacheBlock { leaves: leaves.clone(), halo: Vec::new(), neighbors: Vec::new() };
        for leaf in leaves {
            let faces = topology.neighbors()[leaf];
            let indices = std::array::from_fn(|face| {
                if faces[face] == NO_LEAF {
                    NO_LEAF
                } else {
                    block.local_index(faces[face], needed_rows(band, leaf, face))
                }
            });
            block.neighbors.push(indices);
        }
        block
    }

    /// The local index of a neighbor leaf; adds these rows of it to the halo if it is outside the block.
    fn local_index(&mut self, neighbor: u32, rows: u64) -> u32 {
        if self.leaves.contains(&(neighbor as usize)) {
            return neighbor - self.leaves.start as u32;
        }
        let known = self.halo.iter().position(|&(leaf, _)| leaf == neighbor);
        let local_index = known.unwrap_or_else(|| {
            self.halo.push((neighbor, 0));
            self.halo.len() - 1
        });
        self.halo[local_index].1 |= rows;
        (self.leaves.len() + local_index) as u32
    }
}

/// The rows of the neighbor beyond a face that touch free rows of a leaf.
fn needed_rows(band: &FreeVoxels, leaf: usize, face: usize) -> u64 {
    const FIRST_Y: u64 = 0x0101_0101_0101_0101;
    let free = band.free_rows[leaf];
    match face {
        face if face == Direction::XMinus as usize => free << 56,
        face if face == Direction::XPlus as usize => free >> 56,
        face if face == Direction::YMinus as usize => (free & FIRST_Y) << 7,
        face if face == Direction::YPlus as usize => free >> 7 & FIRST_Y,
        face if face == Direction::ZMinus as usize => band.free[leaf].rows_with(0x01),
        _ => band.free[leaf].rows_with(0x80),
    }
}
