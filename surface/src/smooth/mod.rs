//! Smooths the surface by thin-plate flow, and keeps it between its bounds (paper, §3.2 to §3.5).
//!
//! ```text
//!   φ_0 ──15 Laplacian steps──▶ φ ──step──▶ redistance ──▶ clamp ──▶ … ──▶ φ
//!                                  └─ explicit, implicit or fast ─┘
//! ```
//!
//! Every frame is integrated over the same fictitious time rather than until convergence: that keeps a
//! sequence temporally coherent. The clamp comes last, so that the bounds (Eq. 6) hold at every voxel of the
//! result; the redistancing before it could violate them.

mod biharmonic;
mod cache_block;
mod conjugate_gradient;
mod explicit;
mod free_voxels;
mod heavy_ball;
mod implicit;
mod laplacian;
mod peaks;
mod schedule;
mod thickness;

pub use biharmonic::EIGENVALUE_MAX;
pub use implicit::Convergence;
pub use schedule::{FieldSet, SmoothContext, SmoothOp, SmoothStats, Workspace, schedule};

use std::convert::Infallible;
use std::ops::ControlFlow;

use rayon::prelude::*;

use crate::grid::Field;
use crate::level_set::{Bounds, NEAREST_TO_ZERO, NarrowBand};
use crate::parallel::Loops as _;
use crate::words::word_enum;

word_enum! {
    /// How the constrained smoothing is integrated in fictitious time.
    #[derive(Default)]
    pub enum Integrator {
        /// Implicit steps by projected gradients with momentum: the fastest
        #[default]
        Fast = "fast",
        /// The paper's Algorithm 2, implicit steps: conjugate gradients with a growing active set
        Implicit = "implicit",
        /// The paper's Algorithm 1, explicit steps: many small steps
        Explicit = "explicit",
        /// Explicit steps as large as is stable (paper, §3.5), for single frames: sequences flicker
        Adaptive = "adaptive",
    }
}

impl Integrator {
    /// True if each step solves a linear system.
    pub fn is_implicit(self) -> bool {
        matches!(self, Integrator::Fast | Integrator::Implicit)
    }
}

/// Configuration, in units of voxels and of the time h⁴.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SmoothConfig {
    /// True if φ_0 is no distance, as next to obstacles: φ is redistanced first.
    pub redistances_first: bool,
    /// Number of Laplacian steps before the biharmonic ones. If 0, φ is redistanced instead.
    pub laplacian_steps: u32,
    /// The integrator of the biharmonic steps.
    pub integrator: Integrator,
    /// Number of biharmonic steps.
    pub steps: u32,
    /// Size of a biharmonic step, in units of h⁴. `Adaptive` varies the size within the same total time.
    pub step_size: f32,
    /// Number of steps between redistancings. The last step is always followed by one.
    pub redistance_every: u32,
    /// Relative tolerance of the conjugate gradients (`Implicit` only).
    pub cg_tolerance: f64,
    /// Pins the radius of isolated spheres in implicit steps, so that they keep the radius left by the
    /// Laplacian steps. Explicit steps keep it without pinning. With pinning, thin filaments of the smallest
    /// particles become slightly thicker and rougher.
    pub pin_isolated_spheres: bool,
    /// The result has exact distances within this distance of the surface, in voxels. With 0, distances are
    /// only as exact as the integrator needs.
    pub distances_voxels: f32,
}

/// Statistics of a smoothing.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SmoothReport {
    /// Number of unknowns of the first step: voxels with |φ| ≤ 3 voxels.
    pub free_voxel_count: usize,
    /// Maximum number of applications of the biharmonic operator to a voxel.
    pub pass_count: usize,
    /// Number of voxel updates. If all free voxels have the same number of passes, this is free voxels times
    /// passes.
    pub voxel_update_count: u64,
    /// How far a change of φ_0 or the bounds can propagate, in voxels. `None` for `Implicit`, whose dot
    /// products couple all voxels, and for `Adaptive`, whose step size depends on the fastest voxel.
    pub reach_voxels: Option<u32>,
    /// How the conjugate gradients converged; `None` unless the integrator is `Implicit`.
    pub convergence: Option<Convergence>,
    /// Number of explicit steps that moved some value by more than a voxel (Eq. 8).
    pub cfl_exceeded_count: usize,
}

/// Smooths `band` within `bounds`.
pub fn smooth(band: &mut NarrowBand, bounds: &Bounds, config: &SmoothConfig) -> SmoothReport {
    let ControlFlow::Continue(report) =
        smooth_while::<Infallible>(band, bounds, config, &mut |_| ControlFlow::Continue(()));
    report
}

/// Smooths `band` within `bounds`. `advanced` receives the progress, from 0 to 1, and may cancel; `band` is
/// then left in an intermediate state.
pub fn smooth_while<B>(
    band: &mut NarrowBand,
    bounds: &Bounds,
    config: &SmoothConfig,
    advanced: &mut dyn FnMut(f64) -> ControlFlow<B>,
) -> ControlFlow<B, SmoothReport> {
    let mut report = SmoothReport::new(config);
    let mut workspace = Workspace::new(band.topology.len());
    let schedule = schedule(config, u32::MAX);
    let op_count = schedule.len() as f64;
    for (index, op) in schedule.into_iter().enumerate() {
        let stats = SmoothContext { config, band, bounds, workspace: &mut workspace, own: None }.apply(op);
        report.add(op, stats);
        advanced((index + 1) as f64 / op_count)?;
    }
    ControlFlow::Continue(report)
}

/// Moves values away from zero, unless the bounds require values that small.
fn keep_off_zero(phi: &mut Field, bounds: &Bounds) {
    let bounds = bounds.lower.leaves.par_iter().zip(&bounds.upper.leaves);
    phi.leaves.par_iter_mut().zip(bounds).halved().for_each(|(phi, (lower, upper))| {
        for ((phi, lower), upper) in phi.values.iter_mut().zip(&lower.values).zip(&upper.values) {
            if phi.abs() < NEAREST_TO_ZERO {
                *phi = NEAREST_TO_ZERO.copysign(*phi).max(*lower).min(*upper);
            }
        }
    });
}

/// Radius of an isolated sphere after Laplacian steps, in voxels: dr/dt = −2/r.
pub fn radius_after_laplacian(radius_voxels: f64, steps: u32) -> f64 {
    let time = f64::from(schedule::LAPLACIAN_STEP_SIZE) * f64::from(steps);
    (radius_voxels * radius_voxels - 4.0 * time).max(0.0).sqrt()
}

/// The Laplacian flow alone, for comparison with the biharmonic one (paper, Fig. 5): `steps` steps of 0.1 h²,
/// redistanced and clamped every 50 steps and at the end.
pub fn smooth_laplacian_only(band: &mut NarrowBand, bounds: &Bounds, steps: u32) {
    const REDISTANCE_EVERY: u32 = 50;
    let config = SmoothConfig {
        redistances_first: false,
        laplacian_steps: steps,
        integrator: Integrator::Explicit,
        steps: 0,
        step_size: 0.0,
        redistance_every: 1,
        cg_tolerance: 0.0,
        pin_isolated_spheres: false,
        distances_voxels: 0.0,
    };
    let mut workspace = Workspace::new(band.topology.len());
    for op in schedule(&config, REDISTANCE_EVERY) {
        if matches!(op, SmoothOp::Laplacian { .. }) {
            for op in [op, SmoothOp::Redistance] {
                SmoothContext { config: &config, band, bounds, workspace: &mut workspace, own: None }
                    .apply(op);
            }
        }
    }
}
