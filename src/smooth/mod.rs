//! The constrained optimization: the smoothest surface that stays between its bounds (paper, §3.2
//! to §3.5).
//!
//! ```text
//!   φ_0 ──15 Laplacian steps──▶ φ ──step──▶ redistance ──▶ clamp ──▶ … ──▶ φ
//!                                  └── explicit, implicit or fast ──┘
//! ```
//!
//! Every frame is integrated for the same fictitious time, never until it converges: that keeps a
//! sequence coherent. The clamp comes last, so that the bounds (Eq. 6) hold at every voxel of the
//! result; the redistancing before it would break them by itself.

mod band;
mod biharmonic;
mod cluster;
mod conjugate_gradient;
mod explicit;
mod heavy_ball;
mod implicit;
mod laplacian;
mod thickness;

pub use biharmonic::EIGENVALUE_MAX;
pub use implicit::Convergence;

use rayon::prelude::*;

use crate::grid::Field;
use crate::level_set::{Bounds, NarrowBand, Sweeps, redistance, redistance_in};
use band::Band;
use heavy_ball::{Course, HeavyBall};

/// How the constrained smoothing is integrated in fictitious time.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Integrator {
    /// Implicit steps solved without reductions: local, and the same bytes on any number of threads.
    Fast,
    /// The paper's Algorithm 2: conjugate gradients with an active set that grows.
    Implicit,
    /// The paper's Algorithm 1: many small explicit steps.
    Explicit,
}

/// What to do, in units of voxels and of the time h⁴.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Config {
    /// Laplacian steps before the biharmonic ones. With none, φ is redistanced instead.
    pub laplacian_steps: u32,
    /// How a biharmonic step is taken.
    pub integrator: Integrator,
    /// Biharmonic steps.
    pub steps: u32,
    /// Size of a biharmonic step, in units of h⁴.
    pub step_size: f32,
    /// Redistance after so many steps; the last step is always followed by one.
    pub redistance_every: u32,
    /// Relative tolerance of the conjugate gradients (`Implicit` only).
    pub cg_tolerance: f64,
}

/// What smoothing took.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SmoothReport {
    /// Unknowns of the first step: voxels with |φ| ≤ 3 voxels.
    pub free_voxel_count: usize,
    /// Applications of the biharmonic operator, where there were most.
    pub pass_count: usize,
    /// How often a free voxel was moved: free voxels times passes, where all have the same number.
    pub moved_count: u64,
    /// How far a change of φ_0 or the bounds can reach, in voxels; `None` for `Implicit`, whose
    /// dot products couple every voxel to every other.
    pub reach_voxels: Option<u32>,
    /// Of `Implicit` only.
    pub convergence: Option<Convergence>,
    /// Explicit steps that moved some value by more than a voxel (Eq. 8).
    pub cfl_exceeded_count: usize,
}

/// Size of a Laplacian step, in units of h².
const LAPLACIAN_STEP_SIZE: f32 = 0.1;

/// Free unknowns of a biharmonic step: |φ| up to this many voxels (paper, §3.5).
const FREE_WIDTH: f32 = 3.0;

/// Jacobi sweeps of a redistancing (paper, §3.4).
const REDISTANCE_SWEEPS: u32 = 8;

/// After implicit steps, distances farther out than the neighbours of those so near the surface are
/// swept by first order, as the paper does. A few steps with exact ones thicken tubes and sheets
/// (under this flow a cylinder of radius R grows by 1/R³) until they meet the bumps of their bound. Explicit
/// steps are redistanced so often that errors of first order would add up. `redistance` has the figures.
const IMPLICIT_SECOND_ORDER_WITHIN: f32 = 1.2;

/// A redistancing reads the neighbours of what it pins, and in a sweep the second neighbours too.
const REDISTANCE_REACH: u32 = 2 * REDISTANCE_SWEEPS + 1;

/// Two fields, of which each integrator makes what it needs.
struct Scratch {
    first: Field,
    second: Field,
}

impl Scratch {
    fn new(leaf_count: usize) -> Scratch {
        let zero = || Field::splat(leaf_count, 0.0);
        Scratch { first: zero(), second: zero() }
    }
}

/// Smooths `band` within `bounds`.
pub fn smooth(band: &mut NarrowBand, bounds: &Bounds, config: &Config) -> SmoothReport {
    laplacian::smooth_laplacian(band, bounds, config.laplacian_steps, LAPLACIAN_STEP_SIZE);
    let mut scratch = Scratch::new(band.topology.len());
    let mut report = SmoothReport::default();
    let mut reach = config.laplacian_steps;
    if config.laplacian_steps == 0 {
        // Something has to take the grain off what the first step holds fixed: noise there costs a
        // sphere of radius 20 one per cent of its volume.
        redistance_in(band, Sweeps::accurate(REDISTANCE_SWEEPS), &mut scratch.second);
        bounds.clamp(&mut band.phi);
        reach = REDISTANCE_REACH;
    }
    for step in 1..=config.steps {
        let region = Band::new(band, FREE_WIDTH);
        let free_count = region.free_count();
        if step == 1 {
            report.free_voxel_count = free_count;
        }
        match config.integrator {
            Integrator::Fast => {
                let course = Course::new(config.step_size, step == config.steps);
                let Scratch { first: start, second: previous } = &mut scratch;
                report.moved_count +=
                    HeavyBall { band, bounds, start, previous, course }.step(region, step == 1);
                report.pass_count += course.passes_max() as usize;
                reach = reach.saturating_add(course.reach());
            }
            Integrator::Explicit => {
                let moved = explicit::step(band, bounds, &region, config.step_size, &mut scratch);
                report.cfl_exceeded_count += usize::from(moved > 1.0);
                report.pass_count += 1;
                report.moved_count += free_count as u64;
                reach = reach.saturating_add(2);
            }
            Integrator::Implicit => {
                let solved =
                    implicit::step(band, bounds, region, config.step_size, config.cg_tolerance, &mut scratch);
                let pass_count = solved.iterations + solved.restarts + 1;
                report.pass_count += pass_count;
                report.moved_count += (pass_count * free_count) as u64;
                report.convergence = Some(solved.and(report.convergence));
            }
        }
        if step % config.redistance_every == 0 || step == config.steps {
            redistance_in(band, sweeps_after(config.integrator), &mut scratch.second);
            bounds.clamp(&mut band.phi);
            reach = reach.saturating_add(REDISTANCE_REACH);
        }
    }
    keep_off_zero(&mut band.phi, bounds);
    report.reach_voxels = (config.integrator != Integrator::Implicit).then_some(reach);
    report
}

/// No value of the result is nearer to zero than this, in voxels, unless its bounds demand it.
const NEAREST_TO_ZERO: f32 = 1.0 / 128.0;

/// Moves values off zero. Where the surface all but touches a voxel, meshers fold it around that voxel
/// in triangles that are the sharper the smaller they are. Through OpenVDB's mesher one voxel at 10⁻⁶
/// had ∫H² = 4800, three times that of its whole frame; at 0.0002 it had 320, at 0.003 it has 30, at 1/128 less than a
/// drop's 4π.
fn keep_off_zero(phi: &mut Field, bounds: &Bounds) {
    let bounds = bounds.lower.leaves.par_iter().zip(&bounds.upper.leaves);
    phi.leaves.par_iter_mut().zip(bounds).for_each(|(phi, (lower, upper))| {
        for ((phi, lower), upper) in phi.values.iter_mut().zip(&lower.values).zip(&upper.values) {
            if phi.abs() < NEAREST_TO_ZERO {
                *phi = NEAREST_TO_ZERO.copysign(*phi).max(*lower).min(*upper);
            }
        }
    });
}

fn sweeps_after(integrator: Integrator) -> Sweeps {
    match integrator {
        Integrator::Explicit => Sweeps::accurate(REDISTANCE_SWEEPS),
        Integrator::Fast | Integrator::Implicit => {
            Sweeps { count: REDISTANCE_SWEEPS, second_order_within: IMPLICIT_SECOND_ORDER_WITHIN }
        }
    }
}

/// The Laplacian flow alone, for comparison with the biharmonic one (paper, Fig. 5): `steps` steps
/// of 0.1 h², redistanced and clamped every 50 and at the end.
pub fn smooth_laplacian_only(band: &mut NarrowBand, bounds: &Bounds, steps: u32) {
    const REDISTANCE_EVERY: u32 = 50;
    let mut left = steps;
    while left > 0 {
        let now = left.min(REDISTANCE_EVERY);
        laplacian::smooth_laplacian(band, bounds, now, LAPLACIAN_STEP_SIZE);
        redistance(band, Sweeps::accurate(REDISTANCE_SWEEPS));
        bounds.clamp(&mut band.phi);
        left -= now;
    }
}
