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
//! Eigenvalues near one belong to modes that are wider than the layer of free voxels along a surface leaves
//! room for. Only where layers merge ([`thickness`](super::thickness)) is there such room; elsewhere the least
//! is l = 1 + 0.1 Δt, and √l times fewer passes do.
//!
//! ```text
//!                 passes of a step        of the last          at the default Δt of 20 h⁴
//!   thin            √(L/l)                 1.5 √(L/l)           31, 47
//!   thick           √L                     1.5 √L               54, 81
//! ```
//!
//! The last step has more because nothing comes after it to take away what it leaves. Each step but the first
//! sets out from where the one before was going: as the flow slows down steadily, 0.6 of that step's change is
//! a good guess of this one's.
//!
//! On the dam breaks and the Hilbert curve that leaves 0.004 to 0.02 voxels in the mean to the converged
//! solution. Nesterov's momentum, with whose convergence there is a proof, needs twice as many passes, and Chebyshev's
//! coefficients, the best where there are no bounds, need a quarter more. Stabilized Runge–Kutta steps of 54
//! stages stay 0.05 to 0.2 away, and 80 come no nearer: theirs is another discretization in time.
//!
//! This work is based on:
//! Boris Polyak. Some methods of speeding up the convergence of iteration methods. 1964

use std::cell::RefCell;
use std::ops::Range;

use rayon::prelude::*;

use super::band::Band;
use super::biharmonic::{EIGENVALUE_MAX, Laplacian};
use super::cluster::Cluster;
use super::thickness::thick;
use crate::surface::grid::{Field, Leaf, LeafMask, Neighborhood, ROW_COUNT, Topology, slabs_in};
use crate::surface::level_set::{Bounds, NarrowBand};
use crate::surface::simd::{self, Kernel, Lanes};

/// What a step of 1 h⁴ adds to the least eigenvalue where the region is thin: (4.73/8.4)⁴, of a plate 8.4 voxels wide that is
/// clamped on both sides.
const STIFFNESS_THIN: f32 = 0.1;

/// Passes of a step and of the last step, in units of the root of the condition number. The error that
/// a pass leaves is 1 − 2/root, so these leave e⁻² and e⁻³.
const PASSES_PER_ROOT: [f32; 2] = [1.0, 1.5];

/// Of the change in a step, the part that the next step is expected to repeat.
const EXPECTED_REPETITION: f32 = 0.6;

/// No expected change is larger than this, in voxels.
const EXPECTED_CHANGE_MAX: f32 = 1.0;

/// What a step does, from the spectral bounds alone: the same for all frames.
#[derive(Clone, Copy, Debug)]
pub(super) struct Course {
    step_size: f32,
    alpha: f32,
    /// Where the region is thin, and where it is thick.
    beta: [f32; 2],
    /// Passes where the region is thin, and where it is thick.
    passes: [u32; 2],
}

impl Course {
    /// The course of a step of `step_size` h⁴.
    pub(super) fn new(step_size: f32, is_last: bool) -> Course {
        let greatest = 1.0 + EIGENVALUE_MAX * step_size;
        let root = greatest.sqrt();
        let least = [1.0 + STIFFNESS_THIN * step_size, 1.0];
        let beta = least.map(|least| ((root - least.sqrt()) / (root + least.sqrt())).powi(2));
        let per_root = PASSES_PER_ROOT[usize::from(is_last)];
        Course {
            step_size,
            // The lesser of the two serves both: they lie side by side.
            alpha: 4.0 / (root + least[0].sqrt()).powi(2),
            beta,
            passes: least.map(|least| (per_root * (greatest / least).sqrt()).ceil() as u32),
        }
    }

    /// Passes where there are most.
    pub(super) fn passes_max(&self) -> u32 {
        self.passes[1]
    }
}

/// A step under way, on fields that it was lent.
pub(super) struct HeavyBall<'a> {
    pub(super) band: &'a mut NarrowBand,
    pub(super) bounds: &'a Bounds,
    /// φ at the start of the step; before, of the step before.
    pub(super) start: &'a mut Field,
    /// x⁻.
    pub(super) previous: &'a mut Field,
    pub(super) course: Course,
    /// For each leaf whether its voxels are counted; `None` for all.
    pub(super) own: Option<&'a [bool]>,
}

impl HeavyBall<'_> {
    /// Some passes of an implicit step, whose free voxels `region` holds. Returns how often a free voxel
    /// was moved, all voxels together.
    pub(super) fn passes(&mut self, region: Band, is_first_step: bool, passes: Range<u32>) -> u64 {
        let topology = self.band.topology.clone();
        let thick = thick(&topology, &region.free);
        if passes.start == 0 {
            self.set_out(&region, if is_first_step { 0.0 } else { EXPECTED_REPETITION });
        }
        let [thin_end, thick_end] = self.course.passes;
        let count_until = |end: u32| passes.end.min(end).saturating_sub(passes.start);
        let together = count_until(thin_end);
        let moved_count = self.pass(&region, &thick, together);
        let alone = count_until(thick_end) - together;
        if alone == 0 || thick.par_iter().all(LeafMask::is_empty) {
            return moved_count;
        }
        // What is not moved any more must be the same wherever it is read.
        let fields = self.previous.leaves.par_iter_mut().zip(&self.band.phi.leaves).zip(&thick);
        fields.for_each(|((previous, phi), thick)| simd::dispatch(Settle { previous, phi, thick }));
        moved_count + self.pass(&Band::of(&topology, thick.clone()), &thick, alone)
    }

    /// Makes x and x⁻ where the flow is expected to go, and the band's φ the start.
    fn set_out(&mut self, region: &Band, repetition: f32) {
        let fields = self.band.phi.leaves.par_iter_mut().zip(&mut self.start.leaves);
        let bounds = self.bounds.lower.leaves.par_iter().zip(&self.bounds.upper.leaves);
        fields.zip(&mut self.previous.leaves).zip(bounds).zip(&region.free).for_each(
            |((((phi, start), previous), (lower, upper)), free)| {
                simd::dispatch(SetOut { phi, start, bounds: [lower, upper], free, repetition });
                *previous = *phi;
            },
        );
    }

    /// So many passes over the region. Afterwards the band's φ is x. Returns how often a voxel was moved.
    fn pass(&mut self, region: &Band, thick: &[LeafMask], count: u32) -> u64 {
        if count == 0 {
            return 0;
        }
        let topology = self.band.topology.clone();
        let clusters = Cluster::all(&topology, region);
        for _ in 0..count {
            let (start, current, bounds) = (&*self.start, &self.band.phi, self.bounds);
            let fields = Fields { topology: &topology, region, thick, start, current, bounds };
            let course = &self.course;
            pieces(&clusters, &mut self.previous.leaves).into_par_iter().for_each(|(cluster, previous)| {
                SCRATCH.with_borrow_mut(|laplacians| {
                    simd::dispatch(Pass { fields: &fields, course, cluster, laplacians, previous });
                });
            });
            std::mem::swap(&mut self.band.phi, self.previous);
        }
        region.free_count(self.own) * u64::from(count)
    }
}

/// Where a leaf sets out.
struct SetOut<'a> {
    /// φ, to become x.
    phi: &'a mut Leaf,
    /// φ at the start of the last step, to become that of this one.
    start: &'a mut Leaf,
    bounds: [&'a Leaf; 2],
    free: &'a LeafMask,
    repetition: f32,
}

impl Kernel for SetOut<'_> {
    type Output = ();

    #[inline(always)]
    fn run<V: Lanes>(self) {
        let (repetition, limit) = (V::splat(self.repetition), EXPECTED_CHANGE_MAX);
        for row in 0..ROW_COUNT {
            let phi = V::load(self.phi.row(row));
            let change = phi.sub(V::load(self.start.row(row))).max(V::splat(-limit)).min(V::splat(limit));
            let expected = phi.add(repetition.mul(change));
            let [lower, upper] = [V::load(self.bounds[0].row(row)), V::load(self.bounds[1].row(row))];
            let free = V::mask(self.free.row(row));
            phi.store(self.start.row_mut(row));
            V::select(free, expected.max(lower).min(upper), phi).store(self.phi.row_mut(row));
        }
    }
}

thread_local! {
    /// The inner Laplacians of a cluster and its halo.
    static SCRATCH: RefCell<Vec<Leaf>> = const { RefCell::new(Vec::new()) };
}

/// Each cluster with its own leaves of a field.
fn pieces<'a>(clusters: &'a [Cluster], leaves: &'a mut [Leaf]) -> Vec<(&'a Cluster, &'a mut [Leaf])> {
    let (mut rest, mut passed) = (leaves, 0);
    clusters
        .iter()
        .map(|cluster| {
            let (_, from_start) = std::mem::take(&mut rest).split_at_mut(cluster.leaves.start - passed);
            let (own, after) = from_start.split_at_mut(cluster.leaves.len());
            (rest, passed) = (after, cluster.leaves.end);
            (cluster, own)
        })
        .collect()
}

/// What a pass reads.
struct Fields<'a> {
    topology: &'a Topology,
    region: &'a Band,
    thick: &'a [LeafMask],
    /// φ at the start of the step.
    start: &'a Field,
    /// x.
    current: &'a Field,
    bounds: &'a Bounds,
}

/// Where voxels are not thick, makes x⁻ equal to x.
struct Settle<'a> {
    previous: &'a mut Leaf,
    phi: &'a Leaf,
    thick: &'a LeafMask,
}

impl Kernel for Settle<'_> {
    type Output = ();

    #[inline(always)]
    fn run<V: Lanes>(self) {
        for row in 0..ROW_COUNT {
            let (previous, phi) = (V::load(self.previous.row(row)), V::load(self.phi.row(row)));
            V::select(V::mask(self.thick.row(row)), previous, phi).store(self.previous.row_mut(row));
        }
    }
}

/// A pass over a cluster.
struct Pass<'a> {
    fields: &'a Fields<'a>,
    course: &'a Course,
    cluster: &'a Cluster,
    laplacians: &'a mut Vec<Leaf>,
    /// x⁻ of the cluster's leaves, to become x⁺.
    previous: &'a mut [Leaf],
}

impl Kernel for Pass<'_> {
    type Output = ();

    #[inline(always)]
    fn run<V: Lanes>(self) {
        let Pass { fields, course, cluster, laplacians, previous } = self;
        let count = cluster.leaves.len() + cluster.halo.len();
        if laplacians.len() < count {
            laplacians.resize(count, Leaf::splat(0.0));
        }
        let own = cluster.leaves.clone().map(|leaf| (leaf, fields.region.laplacian_rows[leaf]));
        let halo = cluster.halo.iter().map(|&(leaf, rows)| (leaf as usize, rows));
        for ((leaf, rows), laplacian) in own.chain(halo).zip(laplacians.iter_mut()) {
            let around = Neighborhood::new(&fields.current.leaves, fields.topology.neighbors(), leaf);
            Laplacian { around: &around, rows, laplacian }.run::<V>();
        }
        for ((leaf, neighbors), previous) in cluster.leaves.clone().zip(&cluster.neighbors).zip(previous) {
            let rows = fields.region.free_rows[leaf];
            if rows == 0 {
                continue;
            }
            let place = leaf - cluster.leaves.start;
            let around =
                Neighborhood::of(&laplacians[place], neighbors.map(|place| laplacians.get(place as usize)));
            let (start, current) = (&fields.start.leaves[leaf], &fields.current.leaves[leaf]);
            let (lower, upper) = (&fields.bounds.lower.leaves[leaf], &fields.bounds.upper.leaves[leaf]);
            let free = &fields.region.free[leaf];
            let thick = &fields.thick[leaf];
            let [beta_thin, beta_thick] = course.beta.map(V::splat);
            for (x, ys) in slabs_in(rows) {
                let slab = around.slab(x);
                for y in ys {
                    let row = x * 8 + y;
                    let previous = previous.row_mut(row);
                    let values = [V::load(start.row(row)), V::load(current.row(row)), V::load(previous)];
                    let bounds = [V::load(lower.row(row)), V::load(upper.row(row))];
                    let beta = V::select(V::mask(thick.row(row)), beta_thick, beta_thin);
                    let moved = course.advance(beta, slab.laplacian(y), values, bounds);
                    V::select(V::mask(free.row(row)), moved, values[2]).store(previous);
                }
            }
        }
    }
}

impl Course {
    /// x⁺ of a row.
    #[inline(always)]
    fn advance<V: Lanes>(
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
