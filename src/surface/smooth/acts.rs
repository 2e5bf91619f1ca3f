//! Smoothing as a list of acts, each of which reads no farther than it says.
//!
//! ```text
//!   Laplacian ─▶ ( Passes ─▶ Redistance ) × 5 ─▶ Finish           a frame that is in memory
//!
//!   Laplacian ─▶ ( Passes 0..14 ─▶ Passes 14..28 ─▶ … ─▶ Redistance ) × 5 ─▶ Finish      one in tiles
//! ```
//!
//! A frame that is larger than memory is smoothed tile by tile. A tile is given its own leaves and a halo as wide as
//! the act's reach; what comes out in its own leaves is then the same, bit for bit, as if the whole frame had
//! been there, and the tiles change what they know of each other before the next act. So there is one way to do
//! each act, and it knows nothing of tiles.

use super::band::Band;
use super::heavy_ball::{Course, HeavyBall};
use super::implicit::Convergence;
use super::thickness::THICKNESS_REACH;
use super::tips::{TIP_REACH, around_tips};
use super::{Config, Integrator, SmoothReport, explicit, implicit, keep_off_zero, laplacian};
use crate::surface::grid::{Field, Topology};
use crate::surface::level_set::{Bounds, NarrowBand, Sweeps, extend_distances, redistance_in};

/// A part of the smoothing.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Act {
    /// Laplacian steps.
    Laplacian {
        /// How many.
        steps: u32,
    },
    /// Distances and bounds restored, in place of Laplacian steps or after them.
    Restore,
    /// Some of the passes of a fast step.
    Passes {
        /// Which step, from 0 on.
        step: u32,
        /// Its first pass of these, from 0 on.
        first: u32,
        /// How many.
        count: u32,
        /// Whether the tips of φ at the centres of balls are held.
        holds_tips: bool,
    },
    /// Explicit steps.
    Explicit {
        /// How many.
        count: u32,
    },
    /// Explicit steps as large as may be.
    Adaptive {
        /// How many steps of the given size take the same time.
        count: u32,
    },
    /// An implicit step.
    Implicit,
    /// Distances and bounds restored after steps.
    Redistance,
    /// Distances carried on, beyond where they were restored.
    Extend,
    /// Values moved off zero.
    Finish,
}

/// A redistancing reads the neighbours of what it pins, and in a sweep the second neighbours too.
const REDISTANCE_REACH: u32 = 2 * REDISTANCE_SWEEPS + 1;

/// Jacobi sweeps of a redistancing (paper, §3.4).
const REDISTANCE_SWEEPS: u32 = 8;

/// After implicit steps, distances farther out than the neighbours of those so near the surface are
/// swept by first order, as the paper does. A few steps with exact ones thicken tubes and sheets
/// (under this flow a cylinder of radius R grows by 1/R³) until they meet the bumps of their bound. Explicit
/// steps are redistanced so often that errors of first order would add up. `redistance` has the figures.
/// Where spheres are to be kept all distances are exact.
const IMPLICIT_SECOND_ORDER_WITHIN: f32 = 1.2;

/// Size of a Laplacian step, in units of h².
pub(super) const LAPLACIAN_STEP_SIZE: f32 = 0.1;

/// Free unknowns of a biharmonic step: |φ| up to this many voxels (paper, §3.5).
const FREE_WIDTH: f32 = 3.0;

impl Act {
    /// How far the values are, in voxels along the axes, that one value of the result depends on; `None`
    /// where it depends on all.
    pub fn reach_voxels(self) -> Option<u32> {
        match self {
            Act::Laplacian { steps } => Some(steps),
            Act::Restore | Act::Redistance | Act::Extend => Some(REDISTANCE_REACH),
            // What is thick is found again by every act of a step.
            Act::Passes { count, holds_tips, .. } => {
                Some(count.saturating_mul(2).saturating_add(region_reach(holds_tips)))
            }
            Act::Explicit { count } => Some(count.saturating_mul(2)),
            Act::Implicit | Act::Adaptive { .. } => None,
            Act::Finish => Some(0),
        }
    }
}

/// How far the voxels are, at most, that decide whether and how a voxel is moved by a fast step.
fn region_reach(holds_tips: bool) -> u32 {
    THICKNESS_REACH + if holds_tips { TIP_REACH } else { 0 }
}

/// Which of the three fields that are passed from act to act: φ, and the first and second of [`Memory`].
pub type FieldSet = [bool; 3];

impl Act {
    /// The fields whose values the act depends on.
    pub fn reads(self) -> FieldSet {
        match self {
            // Nothing was before the first step.
            Act::Passes { step: 0, first: 0, .. } => [true, false, false],
            Act::Passes { first: 0, .. } => [true, true, false],
            Act::Passes { .. } => [true, true, true],
            _ => [true, false, false],
        }
    }

    /// The fields whose values a later act may depend on. Whatever else the act leaves in the fields is of no use.
    pub fn writes(self) -> FieldSet {
        match self {
            Act::Passes { first: 0, .. } => [true, true, true],
            Act::Passes { .. } => [true, false, true],
            _ => [true, false, false],
        }
    }
}

/// The acts of a smoothing, none with a reach of more than `reach_max` voxels (at least 32), where that can be.
pub fn acts(config: &Config, reach_max: u32) -> Vec<Act> {
    let mut acts = Vec::new();
    match config.laplacian_steps {
        // Something has to take the grain off what the first step holds fixed: noise there costs a
        // sphere of radius 20 one per cent of its volume.
        0 => acts.push(Act::Restore),
        steps => acts.extend(portions(steps, reach_max).map(|(_, steps)| Act::Laplacian { steps })),
    }
    let holds_tips = config.keeps_spheres;
    if holds_tips && config.integrator.is_implicit() && config.laplacian_steps > 0 && config.steps > 0 {
        // They end at |φ| = 4 with a kink, which would pull on what is free.
        acts.push(Act::Restore);
    }
    let mut since_redistance = 0;
    for step in 0..config.steps {
        match config.integrator {
            Integrator::Fast => {
                let most = reach_max.saturating_sub(region_reach(holds_tips)) / 2;
                let passes = course(config, step).passes_max();
                let part = |(first, count)| Act::Passes { step, first, count, holds_tips };
                acts.extend(portions(passes, most).map(part));
            }
            Integrator::Implicit => acts.push(Act::Implicit),
            Integrator::Explicit | Integrator::Adaptive => since_redistance += 1,
        }
        if (step + 1) % config.redistance_every == 0 || step + 1 == config.steps {
            if config.integrator == Integrator::Adaptive {
                acts.push(Act::Adaptive { count: since_redistance });
            } else {
                let explicit = portions(since_redistance, reach_max / 2);
                acts.extend(explicit.map(|(_, count)| Act::Explicit { count }));
            }
            since_redistance = 0;
            acts.push(Act::Redistance);
        }
    }
    if config.distances_voxels > 0.0 {
        // In place of the last one, which may be of first order.
        acts.pop_if(|act| *act == Act::Redistance);
        if acts.last() != Some(&Act::Restore) {
            acts.push(Act::Restore);
        }
        let sweeps = (3f32.sqrt() * (config.distances_voxels + DISTANCES_MARGIN)).ceil() as u32;
        acts.extend((1..sweeps.div_ceil(REDISTANCE_SWEEPS)).map(|_| Act::Extend));
    }
    acts.push(Act::Finish);
    acts
}

/// Voxels beside the farthest place where distances are wanted have them, too.
const DISTANCES_MARGIN: f32 = 1.0;

/// So many, in portions of at most `most`: the first of each and how many there are.
fn portions(total: u32, most: u32) -> impl Iterator<Item = (u32, u32)> {
    let most = most.max(1);
    (0..total.div_ceil(most)).map(move |index| (index * most, most.min(total - index * most)))
}

fn course(config: &Config, step: u32) -> Course {
    Course::new(config.step_size, step + 1 == config.steps)
}

/// Two fields that an act may need of the one before. Each integrator makes of them what it needs.
pub struct Memory {
    /// Fast: φ at the start of the step.
    pub first: Field,
    /// Fast: the values before the last pass.
    pub second: Field,
}

impl Memory {
    /// Memory for so many leaves.
    pub fn new(leaf_count: usize) -> Memory {
        let zero = || Field::splat(leaf_count, 0.0);
        Memory { first: zero(), second: zero() }
    }
}

/// What an act works on: a frame, or a tile of one and its halo.
pub struct Work<'a> {
    /// What to do.
    pub config: &'a Config,
    /// φ, which is smoothed.
    pub band: &'a mut NarrowBand,
    /// Where it must stay.
    pub bounds: &'a Bounds,
    /// What the act before left.
    pub memory: &'a mut Memory,
    /// For each leaf whether it counts in the tally; `None` for all.
    pub own: Option<&'a [bool]>,
}

/// What an act took.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Tally {
    /// Free voxels at the start of a step.
    pub free_count: u64,
    /// How often one was moved.
    pub moved_count: u64,
    /// Adaptive steps that were taken.
    pub adaptive_step_count: usize,
    /// For each explicit step whether some value was moved by more than a voxel (Eq. 8).
    pub cfl_exceeded: Vec<bool>,
    /// Of an implicit step.
    pub convergence: Option<Convergence>,
}

impl Work<'_> {
    /// Does an act.
    pub fn perform(&mut self, act: Act) -> Tally {
        let Work { config, band, bounds, memory, own } = self;
        match act {
            Act::Laplacian { steps } => {
                laplacian::smooth_laplacian(band, bounds, &mut memory.second, steps, LAPLACIAN_STEP_SIZE);
                Tally::default()
            }
            Act::Restore => self.redistance(Sweeps::accurate(REDISTANCE_SWEEPS)),
            Act::Redistance => {
                let sweeps = sweeps_after(config);
                self.redistance(sweeps)
            }
            Act::Passes { step, first, count, holds_tips } => {
                let is_start = first == 0;
                let at_start = if is_start { &band.phi } else { &memory.first };
                let region = free_region(&band.topology, at_start, holds_tips);
                let free_count = if is_start { region.free_count(*own) } else { 0 };
                let Memory { first: start, second: previous } = &mut **memory;
                let course = course(config, step);
                let mut solver = HeavyBall { band, bounds, start, previous, course, own: *own };
                let moved_count = solver.passes(region, step == 0, first..first + count);
                Tally { free_count, moved_count, ..Tally::default() }
            }
            Act::Explicit { count } => self.explicit(count),
            Act::Adaptive { count } => self.adaptive(count),
            Act::Implicit => {
                let region = free_region(&band.topology, &band.phi, config.keeps_spheres);
                let free_count = region.free_count(*own);
                let (step_size, tolerance) = (config.step_size, config.cg_tolerance);
                let solved = implicit::step(band, bounds, region, step_size, tolerance, &mut memory.first);
                let moved_count = free_count * solved.pass_count() as u64;
                Tally { free_count, moved_count, convergence: Some(solved), ..Tally::default() }
            }
            Act::Extend => {
                extend_distances(band, Sweeps::accurate(REDISTANCE_SWEEPS));
                bounds.clamp(&mut band.phi);
                Tally::default()
            }
            Act::Finish => {
                keep_off_zero(&mut band.phi, bounds);
                Tally::default()
            }
        }
    }

    fn redistance(&mut self, sweeps: Sweeps) -> Tally {
        redistance_in(self.band, sweeps, &mut self.memory.second);
        self.bounds.clamp(&mut self.band.phi);
        Tally::default()
    }

    fn explicit(&mut self, count: u32) -> Tally {
        let mut tally = Tally::default();
        for index in 0..count {
            let region = Band::new(&self.band.topology, &self.band.phi, FREE_WIDTH);
            let free_count = region.free_count(self.own);
            if index == 0 {
                tally.free_count = free_count;
            }
            tally.moved_count += free_count;
            let moved =
                explicit::step(self.band, self.bounds, &region, self.config.step_size, self.memory, self.own);
            tally.cfl_exceeded.push(moved > 1.0);
        }
        tally
    }

    fn adaptive(&mut self, count: u32) -> Tally {
        let mut tally = Tally::default();
        // In 64 bits, of which many small steps lose nothing.
        let mut time_left = f64::from(count) * f64::from(self.config.step_size);
        while time_left > TIME_TOLERANCE {
            let region = Band::new(&self.band.topology, &self.band.phi, FREE_WIDTH);
            let free_count = region.free_count(self.own);
            if tally.adaptive_step_count == 0 {
                tally.free_count = free_count;
            }
            tally.moved_count += free_count;
            tally.adaptive_step_count += 1;
            let Work { band, bounds, memory, .. } = self;
            time_left -= f64::from(explicit::adaptive_step(band, bounds, &region, time_left as f32, memory));
        }
        tally
    }
}

/// So little of the time of steps may be left over, in units of h⁴.
const TIME_TOLERANCE: f64 = 1e-6;

/// The free voxels of an implicit step.
fn free_region(topology: &Topology, phi: &Field, holds_tips: bool) -> Band {
    match holds_tips {
        true => Band::without(topology, phi, FREE_WIDTH, &around_tips(topology, phi)),
        false => Band::new(topology, phi, FREE_WIDTH),
    }
}

fn sweeps_after(config: &Config) -> Sweeps {
    match config.integrator.is_implicit() && !config.keeps_spheres {
        true => Sweeps { count: REDISTANCE_SWEEPS, second_order_within: IMPLICIT_SECOND_ORDER_WITHIN },
        false => Sweeps::accurate(REDISTANCE_SWEEPS),
    }
}

impl Tally {
    /// That of the same act on another part of the frame, too.
    pub fn and(mut self, other: Tally) -> Tally {
        self.free_count += other.free_count;
        self.moved_count += other.moved_count;
        self.cfl_exceeded.resize(self.cfl_exceeded.len().max(other.cfl_exceeded.len()), false);
        for (one, other) in self.cfl_exceeded.iter_mut().zip(other.cfl_exceeded) {
            *one |= other;
        }
        // Steps that couple all voxels are never taken in parts.
        self.adaptive_step_count = self.adaptive_step_count.max(other.adaptive_step_count);
        self.convergence = self.convergence.or(other.convergence);
        self
    }
}

impl SmoothReport {
    /// The report of a smoothing of which nothing is done yet.
    pub fn new(config: &Config) -> SmoothReport {
        let mut whole = acts(config, u32::MAX).into_iter();
        let reach_voxels = whole.try_fold(0u32, |sum, act| Some(sum.saturating_add(act.reach_voxels()?)));
        SmoothReport { reach_voxels, ..SmoothReport::default() }
    }

    /// Adds what an act took, all parts of the frame together.
    pub fn add(&mut self, act: Act, tally: Tally) {
        if self.free_voxel_count == 0 {
            self.free_voxel_count = tally.free_count as usize;
        }
        self.moved_count += tally.moved_count;
        self.cfl_exceeded_count += tally.cfl_exceeded.iter().filter(|&&exceeded| exceeded).count();
        self.pass_count += match act {
            Act::Passes { count, .. } | Act::Explicit { count } => count as usize,
            Act::Adaptive { .. } => tally.adaptive_step_count,
            _ => tally.convergence.map_or(0, |convergence| convergence.pass_count()),
        };
        if let Some(convergence) = tally.convergence {
            self.convergence = Some(convergence.and(self.convergence));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn config(integrator: Integrator, steps: u32, redistance_every: u32) -> Config {
        let step_size = if integrator == Integrator::Explicit { 0.01 } else { 20.0 };
        Config {
            laplacian_steps: 15,
            integrator,
            steps,
            step_size,
            redistance_every,
            cg_tolerance: 1e-4,
            keeps_spheres: false,
            distances_voxels: 0.0,
        }
    }

    #[test]
    fn parts_come_to_the_whole_and_keep_their_reach() {
        for (integrator, steps, every, keeps_spheres) in [
            (Integrator::Fast, 5, 1, false),
            (Integrator::Fast, 4, 3, true),
            (Integrator::Explicit, 120, 50, false),
        ] {
            let config = Config { keeps_spheres, ..config(integrator, steps, every) };
            let sum = |acts: &[Act]| -> (u32, u32, usize) {
                let laplacian =
                    acts.iter().map(|act| if let Act::Laplacian { steps } = act { *steps } else { 0 });
                let passes = acts.iter().map(|act| match act {
                    Act::Passes { count, .. } | Act::Explicit { count } => *count,
                    _ => 0,
                });
                let redistances = acts.iter().filter(|act| **act == Act::Redistance).count();
                (laplacian.sum(), passes.sum(), redistances)
            };
            let whole = acts(&config, u32::MAX);
            for reach_max in [32, 48, 90] {
                let parts = acts(&config, reach_max);
                assert!(parts.iter().all(|act| act.reach_voxels().is_some_and(|reach| reach <= reach_max)));
                assert_eq!(sum(&parts), sum(&whole));
                assert!(parts.len() > whole.len());
            }
        }
    }

    #[test]
    fn distances_are_restored_last_where_they_are_wanted() {
        let last = |integrator, steps, laplacian_steps, distances_voxels| {
            let config = Config { distances_voxels, laplacian_steps, ..config(integrator, steps, 1) };
            let acts = acts(&config, 48);
            acts[acts.len().saturating_sub(3)..].to_vec()
        };
        for (acts, expected) in [
            (last(Integrator::Implicit, 1, 15, 0.0), [Act::Implicit, Act::Redistance, Act::Finish]),
            (last(Integrator::Implicit, 1, 15, 2.0), [Act::Implicit, Act::Restore, Act::Finish]),
            (last(Integrator::Fast, 0, 15, 2.0), [Act::Laplacian { steps: 15 }, Act::Restore, Act::Finish]),
            // 8 sweeps reach 4.6 voxels along the diagonal.
            (last(Integrator::Implicit, 1, 15, 5.0), [Act::Restore, Act::Extend, Act::Finish]),
        ] {
            assert_eq!(acts, expected);
        }
        assert_eq!(last(Integrator::Fast, 0, 0, 2.0), [Act::Restore, Act::Finish]);
    }

    #[test]
    fn what_couples_all_voxels_reaches_everywhere() {
        assert_eq!(SmoothReport::new(&config(Integrator::Implicit, 5, 1)).reach_voxels, None);
        assert_eq!(SmoothReport::new(&config(Integrator::Adaptive, 500, 50)).reach_voxels, None);
        assert!(SmoothReport::new(&config(Integrator::Fast, 5, 1)).reach_voxels.is_some());
    }
}
