//! Smoothing as a schedule of operations, each with a known reach.
//!
//! ```text
//!   Laplacian ─▶ ( Passes ─▶ Redistance ) × 5 ─▶ Finish           a frame in memory
//!
//!   Laplacian ─▶ ( Passes 0..14 ─▶ Passes 14..28 ─▶ … ─▶ Redistance ) × 5 ─▶ Finish      a frame in tiles
//! ```
//!
//! A frame larger than memory is smoothed tile by tile. Each tile is loaded with a halo as wide as the
//! operation's reach. The result in the tile's own leaves is then bit-identical to that of the whole frame.
//! Tiles exchange halos between operations. So each operation is implemented once and does not depend on
//! tiles.

use super::heavy_ball::{HeavyBall, StepParams};
use super::implicit::{self, Convergence};
use super::peaks::{PEAK_REACH, pinned_peaks};
use super::{FreeVoxels, Integrator, SmoothConfig, SmoothReport, THICKNESS_REACH, explicit, keep_off_zero};
use crate::grid::{Field, Topology};
use crate::level_set::{Bounds, NarrowBand, Sweeps, extend_distances, redistance_in};

/// One operation of the smoothing schedule.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SmoothOp {
    /// Laplacian steps.
    Laplacian {
        /// Number of steps.
        steps: u32,
    },
    /// Restores distances and bounds, instead of Laplacian steps or after them.
    Restore,
    /// Iterations of a heavy-ball step.
    Passes {
        /// Index of the step, from 0.
        step: u32,
        /// First iteration, from 0.
        first: u32,
        /// Number of iterations.
        count: u32,
        /// True if the peaks of φ at the centers of balls are pinned.
        pins_peaks: bool,
    },
    /// Explicit steps.
    Explicit {
        /// Number of steps.
        count: u32,
    },
    /// Explicit steps of adaptive size.
    Adaptive {
        /// Total time, in steps of the configured size.
        count: u32,
    },
    /// An implicit step by conjugate gradients.
    Implicit,
    /// Restores distances and bounds after steps.
    Redistance,
    /// Extends distances outward, beyond where they were restored.
    Extend,
    /// Moves values away from zero.
    Finish,
}

/// Redistancing reads the neighbors of the voxels it pins, and each sweep reads second neighbors.
const REDISTANCE_REACH: u32 = 2 * REDISTANCE_SWEEPS + 1;

/// Jacobi sweeps per redistancing (paper, §3.4). Six would reach the neighbors of all free voxels, along diagonals
/// too, but not the centers of the isolated spheres that are pinned; with five, ∫H² would grow by 5 to 20 %.
const REDISTANCE_SWEEPS: u32 = 8;

/// After implicit steps, distances beyond the neighbors of voxels this close to the surface are swept to
/// first order, as in the paper. With a few large steps, exact distances would thicken tubes and sheets until
/// they meet the bumps of their bound: under this flow the radius R of a cylinder grows at the rate 1/R³.
/// Explicit steps redistance so often that first-order errors would accumulate, so they sweep to second
/// order. The measurements are in `redistance`. If isolated spheres are pinned, all distances are swept to
/// second order.
const IMPLICIT_SECOND_ORDER_WITHIN: f32 = 1.2;

/// Size of a Laplacian step, in units of h².
pub(super) const LAPLACIAN_STEP_SIZE: f32 = 0.1;

/// Free unknowns of a biharmonic step: |φ| up to this many voxels (paper, §3.5).
const FREE_WIDTH: f32 = 3.0;

/// Relative tolerance of the conjugate gradients of implicit steps.
const CG_TOLERANCE: f64 = 1e-4;

impl SmoothOp {
    /// The reach: how many voxels away, per axis, an input value can affect a result. `None` if every value
    /// affects every result.
    pub fn reach_voxels(self) -> Option<u32> {
        match self {
            SmoothOp::Laplacian { steps } => Some(steps),
            SmoothOp::Restore | SmoothOp::Redistance | SmoothOp::Extend => Some(REDISTANCE_REACH),
            // The thick region is determined again by every operation of a step.
            SmoothOp::Passes { count, pins_peaks, .. } => {
                Some(count.saturating_mul(2).saturating_add(region_reach(pins_peaks)))
            }
            SmoothOp::Explicit { count } => Some(count.saturating_mul(2)),
            SmoothOp::Implicit | SmoothOp::Adaptive { .. } => None,
            SmoothOp::Finish => Some(0),
        }
    }
}

/// Maximum distance of the voxels that affect whether and how a voxel moves in a heavy-ball step.
fn region_reach(pins_peaks: bool) -> u32 {
    THICKNESS_REACH + if pins_peaks { PEAK_REACH } else { 0 }
}

/// A flag for each field passed between operations: φ, and the `first` and `second` of [`Workspace`].
pub type FieldSet = [bool; 3];

impl SmoothOp {
    /// The fields that the operation reads.
    pub fn reads(self) -> FieldSet {
        match self {
            // Before the first step, the other fields are undefined.
            SmoothOp::Passes { step: 0, first: 0, .. } => [true, false, false],
            SmoothOp::Passes { first: 0, .. } => [true, true, false],
            SmoothOp::Passes { .. } => [true, true, true],
            _ => [true, false, false],
        }
    }

    /// The fields that later operations may read. The other fields are undefined afterwards.
    pub fn writes(self) -> FieldSet {
        match self {
            SmoothOp::Passes { first: 0, .. } => [true, true, true],
            SmoothOp::Passes { .. } => [true, false, true],
            _ => [true, false, false],
        }
    }
}

/// The schedule of a smoothing. The reach of each operation is at most `reach_max` voxels (at least 32), if
/// possible.
pub fn schedule(config: &SmoothConfig, reach_max: u32) -> Vec<SmoothOp> {
    let mut schedule = Vec::new();
    if config.redistances_first && config.smoothing.laplacian_steps > 0 {
        schedule.push(SmoothOp::Restore);
    }
    match config.smoothing.laplacian_steps {
        // Noise in the values that the first step holds fixed must be removed: otherwise a sphere with a
        // radius of 20 voxels would lose one percent of its volume.
        0 => schedule.push(SmoothOp::Restore),
        steps => schedule.extend(portions(steps, reach_max).map(|(_, steps)| SmoothOp::Laplacian { steps })),
    }
    let pins_peaks = config.pin_isolated_spheres;
    if pins_peaks
        && config.smoothing.integrator.is_implicit()
        && config.smoothing.laplacian_steps > 0
        && config.smoothing.steps > 0
    {
        // Laplacian steps leave a kink at |φ| = 4, which would pull on the free voxels.
        schedule.push(SmoothOp::Restore);
    }
    let mut since_redistance = 0;
    for step in 0..config.smoothing.steps {
        match config.smoothing.integrator {
            Integrator::Fast => {
                let most = reach_max.saturating_sub(region_reach(pins_peaks)) / 2;
                let passes = params(config, step).passes_max();
                let part = |(first, count)| SmoothOp::Passes { step, first, count, pins_peaks };
                schedule.extend(portions(passes, most).map(part));
            }
            Integrator::Implicit => schedule.push(SmoothOp::Implicit),
            Integrator::Explicit | Integrator::Adaptive => since_redistance += 1,
        }
        if (step + 1) % config.smoothing.redistance_every == 0 || step + 1 == config.smoothing.steps {
            if config.smoothing.integrator == Integrator::Adaptive {
                schedule.push(SmoothOp::Adaptive { count: since_redistance });
            } else {
                let explicit = portions(since_redistance, reach_max / 2);
                schedule.extend(explicit.map(|(_, count)| SmoothOp::Explicit { count }));
            }
            since_redistance = 0;
            schedule.push(SmoothOp::Redistance);
        }
    }
    if config.distances_voxels > 0.0 {
        // Replaces the last redistancing, which may be of first order.
        schedule.pop_if(|op| *op == SmoothOp::Redistance);
        if schedule.last() != Some(&SmoothOp::Restore) {
            schedule.push(SmoothOp::Restore);
        }
        let sweeps = (3f32.sqrt() * (config.distances_voxels + DISTANCES_MARGIN)).ceil() as u32;
        schedule.extend((1..sweeps.div_ceil(REDISTANCE_SWEEPS)).map(|_| SmoothOp::Extend));
    }
    schedule.push(SmoothOp::Finish);
    schedule
}

/// Margin by which distances extend beyond the requested half width.
const DISTANCES_MARGIN: f32 = 1.0;

/// Splits `total` into portions of at most `most`: the start and length of each.
fn portions(total: u32, most: u32) -> impl Iterator<Item = (u32, u32)> {
    let most = most.max(1);
    (0..total.div_ceil(most)).map(move |index| (index * most, most.min(total - index * most)))
}

fn params(config: &SmoothConfig, step: u32) -> StepParams {
    StepParams::new(config.smoothing.step_size_f32(), step + 1 == config.smoothing.steps)
}

/// Auxiliary fields passed between operations. Their meaning depends on the integrator.
pub struct Workspace {
    /// Heavy ball: φ at the start of the step.
    pub first: Field,
    /// Heavy ball: the values before the last iteration.
    pub second: Field,
}

impl Workspace {
    /// Allocates fields for this many leaves.
    pub fn new(leaf_count: usize) -> Workspace {
        let zero = || Field::splat(leaf_count, 0.0);
        Workspace { first: zero(), second: zero() }
    }
}

/// What an operation works on: a frame, or a tile with its halo.
pub struct SmoothContext<'a> {
    /// The configuration.
    pub config: &'a SmoothConfig,
    /// φ, which is smoothed in place.
    pub band: &'a mut NarrowBand,
    /// The bounds of φ.
    pub bounds: &'a Bounds,
    /// Auxiliary fields from the previous operation.
    pub workspace: &'a mut Workspace,
    /// For each leaf, true if it counts in the statistics; `None` for all.
    pub own: Option<&'a [bool]>,
}

/// Statistics of an operation.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SmoothStats {
    /// Number of free voxels at the start of a step.
    pub free_count: u64,
    /// Number of voxel updates.
    pub voxel_update_count: u64,
    /// Number of adaptive steps.
    pub adaptive_step_count: usize,
    /// For each explicit step, true if a value moved by more than a voxel (Eq. 8).
    pub cfl_exceeded: Vec<bool>,
    /// Convergence of an implicit step.
    pub convergence: Option<Convergence>,
}

impl SmoothContext<'_> {
    /// Applies an operation.
    pub fn apply(&mut self, op: SmoothOp) -> SmoothStats {
        let SmoothContext { config, band, bounds, workspace, own } = self;
        match op {
            SmoothOp::Laplacian { steps } => {
                explicit::smooth_laplacian(band, bounds, &mut workspace.second, steps, LAPLACIAN_STEP_SIZE);
                SmoothStats::default()
            }
            SmoothOp::Restore => self.redistance(Sweeps::accurate(REDISTANCE_SWEEPS)),
            SmoothOp::Redistance => {
                let sweeps = sweeps_after(config);
                self.redistance(sweeps)
            }
            SmoothOp::Passes { step, first, count, pins_peaks } => {
                let is_start = first == 0;
                let at_start = if is_start { &band.phi } else { &workspace.first };
                let region = free_region(&band.topology, at_start, pins_peaks);
                let free_count = if is_start { region.free_count(*own) } else { 0 };
                let Workspace { first: start, second: previous } = &mut **workspace;
                let params = params(config, step);
                let mut solver = HeavyBall { band, bounds, start, previous, params, own: *own };
                let voxel_update_count = solver.passes(region, step == 0, first..first + count);
                SmoothStats { free_count, voxel_update_count, ..SmoothStats::default() }
            }
            SmoothOp::Explicit { count } => self.explicit(count),
            SmoothOp::Adaptive { count } => self.adaptive(count),
            SmoothOp::Implicit => {
                let region = free_region(&band.topology, &band.phi, config.pin_isolated_spheres);
                let free_count = region.free_count(*own);
                let step_size = config.smoothing.step_size_f32();
                let solved =
                    implicit::step(band, bounds, region, step_size, CG_TOLERANCE, &mut workspace.first);
                let voxel_update_count = free_count * solved.pass_count() as u64;
                SmoothStats {
                    free_count,
                    voxel_update_count,
                    convergence: Some(solved),
                    ..SmoothStats::default()
                }
            }
            SmoothOp::Extend => {
                extend_distances(band, Sweeps::accurate(REDISTANCE_SWEEPS));
                bounds.clamp(&mut band.phi);
                SmoothStats::default()
            }
            SmoothOp::Finish => {
                keep_off_zero(&mut band.phi, bounds);
                SmoothStats::default()
            }
        }
    }

    fn redistance(&mut self, sweeps: Sweeps) -> SmoothStats {
        redistance_in(self.band, sweeps, &mut self.workspace.second);
        self.bounds.clamp(&mut self.band.phi);
        SmoothStats::default()
    }

    fn explicit(&mut self, count: u32) -> SmoothStats {
        let mut stats = SmoothStats::default();
        for index in 0..count {
            let region = FreeVoxels::new(&self.band.topology, &self.band.phi, FREE_WIDTH);
            let free_count = region.free_count(self.own);
            if index == 0 {
                stats.free_count = free_count;
            }
            stats.voxel_update_count += free_count;
            let moved = explicit::step(
                self.band,
                self.bounds,
                &region,
                self.config.smoothing.step_size_f32(),
                self.workspace,
                self.own,
            );
            stats.cfl_exceeded.push(moved > 1.0);
        }
        stats
    }

    fn adaptive(&mut self, count: u32) -> SmoothStats {
        let mut stats = SmoothStats::default();
        // 64 bits, so that many small steps accumulate without loss.
        let mut time_left = f64::from(count) * f64::from(self.config.smoothing.step_size_f32());
        while time_left > TIME_TOLERANCE {
            let region = FreeVoxels::new(&self.band.topology, &self.band.phi, FREE_WIDTH);
            let free_count = region.free_count(self.own);
            if stats.adaptive_step_count == 0 {
                stats.free_count = free_count;
            }
            stats.voxel_update_count += free_count;
            stats.adaptive_step_count += 1;
            let SmoothContext { band, bounds, workspace, .. } = self;
            time_left -=
                f64::from(explicit::adaptive_step(band, bounds, &region, time_left as f32, workspace));
        }
        stats
    }
}

/// Tolerance for the remaining time, in units of h⁴.
const TIME_TOLERANCE: f64 = 1e-6;

/// The free voxels of an implicit step.
fn free_region(topology: &Topology, phi: &Field, pins_peaks: bool) -> FreeVoxels {
    if pins_peaks {
        FreeVoxels::excluding(topology, phi, FREE_WIDTH, &pinned_peaks(topology, phi))
    } else {
        FreeVoxels::new(topology, phi, FREE_WIDTH)
    }
}

fn sweeps_after(config: &SmoothConfig) -> Sweeps {
    if config.smoothing.integrator.is_implicit() && !config.pin_isolated_spheres {
        Sweeps { second_order_within: IMPLICIT_SECOND_ORDER_WITHIN, ..Sweeps::accurate(REDISTANCE_SWEEPS) }
    } else {
        Sweeps::accurate(REDISTANCE_SWEEPS)
    }
}

impl SmoothStats {
    /// Combines the statistics of the same operation on two parts of the frame.
    pub fn merge(mut self, other: SmoothStats) -> SmoothStats {
        self.free_count += other.free_count;
        self.voxel_update_count += other.voxel_update_count;
        self.cfl_exceeded.resize(self.cfl_exceeded.len().max(other.cfl_exceeded.len()), false);
        for (one, other) in self.cfl_exceeded.iter_mut().zip(other.cfl_exceeded) {
            *one |= other;
        }
        // Global steps are never split, so at most one part has these values.
        self.adaptive_step_count = self.adaptive_step_count.max(other.adaptive_step_count);
        self.convergence = self.convergence.or(other.convergence);
        self
    }
}

impl SmoothReport {
    /// An empty report.
    pub fn new(config: &SmoothConfig) -> SmoothReport {
        let mut whole = schedule(config, u32::MAX).into_iter();
        let reach_voxels = whole.try_fold(0u32, |sum, op| Some(sum.saturating_add(op.reach_voxels()?)));
        SmoothReport { reach_voxels, ..SmoothReport::default() }
    }

    /// Adds the statistics of an operation on the whole frame.
    pub fn add(&mut self, op: SmoothOp, stats: SmoothStats) {
        if self.free_voxel_count == 0 {
            self.free_voxel_count = stats.free_count as usize;
        }
        self.voxel_update_count += stats.voxel_update_count;
        self.cfl_exceeded_count += stats.cfl_exceeded.iter().filter(|&&exceeded| exceeded).count();
        self.pass_count += match op {
            SmoothOp::Passes { count, .. } | SmoothOp::Explicit { count } => count as usize,
            SmoothOp::Adaptive { .. } => stats.adaptive_step_count,
            _ => stats.convergence.map_or(0, |convergence| convergence.pass_count()),
        };
        if let Some(convergence) = stats.convergence {
            self.convergence = Some(convergence.merge(self.convergence));
        }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use glam::IVec3;

    use super::*;
    use crate::grid::{LEAF_EDGE, LEAF_VOXELS, Leaf, voxel_in_leaf};
    use crate::level_set::redistance;
    use crate::smooth::SmoothSteps;

    fn config(integrator: Integrator, steps: u32, redistance_every: u32) -> SmoothConfig {
        let step_size = if integrator == Integrator::Explicit { 0.01 } else { 20.0 };
        let steps = SmoothSteps { laplacian_steps: 15, integrator, steps, step_size, redistance_every };
        SmoothConfig { smoothing: steps, ..SmoothConfig::default() }
    }

    #[test]
    fn split_schedule_has_the_same_steps_within_its_reach() {
        for (integrator, steps, every, pin_isolated_spheres) in [
            (Integrator::Fast, 5, 1, false),
            (Integrator::Fast, 4, 3, true),
            (Integrator::Explicit, 120, 50, false),
        ] {
            let config = SmoothConfig { pin_isolated_spheres, ..config(integrator, steps, every) };
            let sum = |schedule: &[SmoothOp]| -> (u32, u32, usize) {
                let laplacian =
                    schedule.iter().map(|op| if let SmoothOp::Laplacian { steps } = op { *steps } else { 0 });
                let passes = schedule.iter().map(|op| match op {
                    SmoothOp::Passes { count, .. } | SmoothOp::Explicit { count } => *count,
                    _ => 0,
                });
                let redistances = schedule.iter().filter(|op| **op == SmoothOp::Redistance).count();
                (laplacian.sum(), passes.sum(), redistances)
            };
            let whole = schedule(&config, u32::MAX);
            for reach_max in [32, 48, 90] {
                let parts = schedule(&config, reach_max);
                assert!(parts.iter().all(|op| op.reach_voxels().is_some_and(|reach| reach <= reach_max)));
                assert_eq!(sum(&parts), sum(&whole));
                assert!(parts.len() > whole.len());
            }
        }
    }

    #[test]
    fn schedule_ends_with_exact_distances_if_requested() {
        let last = |integrator, steps, laplacian_steps, distances_voxels| {
            let config = config(integrator, steps, 1);
            let steps = SmoothSteps { laplacian_steps, ..config.smoothing };
            let config = SmoothConfig { distances_voxels, smoothing: steps, ..config };
            let schedule = schedule(&config, 48);
            schedule[schedule.len().saturating_sub(3)..].to_vec()
        };
        for (schedule, expected) in [
            (
                last(Integrator::Implicit, 1, 15, 0.0),
                [SmoothOp::Implicit, SmoothOp::Redistance, SmoothOp::Finish],
            ),
            (
                last(Integrator::Implicit, 1, 15, 2.0),
                [SmoothOp::Implicit, SmoothOp::Restore, SmoothOp::Finish],
            ),
            (
                last(Integrator::Fast, 0, 15, 2.0),
                [SmoothOp::Laplacian { steps: 15 }, SmoothOp::Restore, SmoothOp::Finish],
            ),
            // Eight sweeps reach 4.6 voxels along the diagonal.
            (last(Integrator::Implicit, 1, 15, 5.0), [SmoothOp::Restore, SmoothOp::Extend, SmoothOp::Finish]),
        ] {
            assert_eq!(schedule, expected);
        }
        assert_eq!(last(Integrator::Fast, 0, 0, 2.0), [SmoothOp::Restore, SmoothOp::Finish]);
    }

    #[test]
    fn sweeps_of_redistancing_reach_the_neighbors_of_free_voxels() {
        let axis = || (-2..2).map(|leaf| leaf * LEAF_EDGE);
        let origins = axis().flat_map(|x| axis().flat_map(move |y| axis().map(move |z| IVec3::new(x, y, z))));
        let topology = Arc::new(Topology::new(origins.collect()));
        let distance = |voxel: IVec3| voxel.as_vec3().element_sum() / 3f32.sqrt();
        let voxels = || topology.origins().iter().map(|&origin| move |offset| origin + voxel_in_leaf(offset));
        let farthest = FREE_WIDTH + 1.0 / 3f32.sqrt();
        let error_after = |sweeps: u32| {
            let phi = |voxel: &dyn Fn(usize) -> IVec3| Leaf {
                values: std::array::from_fn(|offset| 1.5 * distance(voxel(offset))),
            };
            let phi = Field { leaves: voxels().map(|voxel| phi(&voxel)).collect() };
            let mut band = NarrowBand { topology: Arc::clone(&topology), phi, half_width: 5.0 };
            let sweeps = Sweeps { count: sweeps, ..sweeps_after(&config(Integrator::Fast, 1, 1)) };
            redistance(&mut band, sweeps);
            let errors = voxels().zip(&band.phi.leaves).flat_map(|(voxel, leaf)| {
                let own = (0..LEAF_VOXELS).map(move |offset| (voxel(offset), leaf.values[offset]));
                own.filter(|(voxel, _)| voxel.abs().max_element() < 4 && distance(*voxel).abs() <= farthest)
            });
            errors.map(|(voxel, phi)| (phi - distance(voxel)).abs()).fold(0.0, f32::max)
        };
        assert!(error_after(REDISTANCE_SWEEPS) < 0.01, "{}", error_after(REDISTANCE_SWEEPS));
        assert!(error_after(6) < 0.01 && error_after(5) > 0.5, "{}", error_after(5));
    }

    #[test]
    fn global_operations_have_unlimited_reach() {
        assert_eq!(SmoothReport::new(&config(Integrator::Implicit, 5, 1)).reach_voxels, None);
        assert_eq!(SmoothReport::new(&config(Integrator::Adaptive, 500, 50)).reach_voxels, None);
        assert!(SmoothReport::new(&config(Integrator::Fast, 5, 1)).reach_voxels.is_some());
    }
}
