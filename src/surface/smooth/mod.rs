//! The constrained optimization: the smoothest surface that stays between its bounds (paper, §3.2
//! to §3.5).
//!
//! ```text
//!   φ_0 ──15 Laplacian steps──▶ φ ──step──▶ redistance ──▶ clamp ──▶ … ──▶ φ
//!                                  └─ explicit, implicit or fast ─┘
//! ```
//!
//! Every frame is integrated for the same fictitious time, never until it converges: that keeps a
//! sequence coherent. The clamp comes last, so that the bounds (Eq. 6) hold at every voxel of the
//! result; the redistancing before it would break them by itself.

mod acts;
mod band;
mod biharmonic;
mod cluster;
mod conjugate_gradient;
mod explicit;
mod heavy_ball;
mod implicit;
mod laplacian;
mod thickness;
mod tips;

pub use acts::{Act, FieldSet, Memory, Tally, Work, acts};
pub use biharmonic::EIGENVALUE_MAX;
pub use implicit::Convergence;

use std::convert::Infallible;
use std::ops::ControlFlow;

use rayon::prelude::*;

use crate::surface::grid::Field;
use crate::surface::level_set::{Bounds, NEAREST_TO_ZERO, NarrowBand};
use crate::surface::words::word_enum;

word_enum! {
    /// How the constrained smoothing is integrated in fictitious time.
    #[derive(Default)]
    pub enum Integrator {
        /// Implicit steps without reductions: the quickest, and the same bytes on any number of threads
        #[default]
        Fast = "fast",
        /// The paper's Algorithm 2, implicit steps: conjugate gradients with a growing active set
        Implicit = "implicit",
        /// The paper's Algorithm 1, explicit steps: many small ones
        Explicit = "explicit",
        /// The same, each as large as is stable (paper, §3.5): for stills, a sequence flickers
        Adaptive = "adaptive",
    }
}

impl Integrator {
    /// Whether its steps are so large that a system has to be solved for each.
    pub fn is_implicit(self) -> bool {
        matches!(self, Integrator::Fast | Integrator::Implicit)
    }
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
    /// Size of a biharmonic step, in units of h⁴. `Adaptive` takes steps of other sizes for the same total time.
    pub step_size: f32,
    /// Redistance after so many steps; the last step is always followed by one.
    pub redistance_every: u32,
    /// Relative tolerance of the conjugate gradients (`Implicit` only).
    pub cg_tolerance: f64,
    /// Whether implicit steps, too, leave lone spheres of any radius what the Laplacian steps leave them. Explicit steps
    /// always do. Threads of the least particles then end a little thicker and rougher.
    pub keeps_spheres: bool,
    /// The result holds distances as far from the surface as this, in voxels. With 0 they are as good as the integrator needs them.
    pub distances_voxels: f32,
}

/// What smoothing took.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SmoothReport {
    /// Unknowns of the first step: voxels with |φ| ≤ 3 voxels.
    pub free_voxel_count: usize,
    /// Applications of the biharmonic operator: at most so many to a voxel.
    pub pass_count: usize,
    /// How often a free voxel was moved: free voxels times passes, where all have the same number.
    pub moved_count: u64,
    /// How far a change of φ_0 or the bounds can reach, in voxels; `None` for `Implicit`, whose
    /// dot products couple every voxel to every other, and for `Adaptive`, whose steps are as large as the quickest voxel allows.
    pub reach_voxels: Option<u32>,
    /// Of `Implicit` only.
    pub convergence: Option<Convergence>,
    /// Explicit steps that moved some value by more than a voxel (Eq. 8).
    pub cfl_exceeded_count: usize,
}

/// Smooths `band` within `bounds`.
pub fn smooth(band: &mut NarrowBand, bounds: &Bounds, config: &Config) -> SmoothReport {
    let ControlFlow::Continue(report) =
        smooth_while::<Infallible>(band, bounds, config, &mut |_| ControlFlow::Continue(()));
    report
}

/// Smooths `band` within `bounds`. `advanced` is called with the fraction that is done, from 0 to 1, and may break off; then
/// `band` is in between.
pub fn smooth_while<B>(
    band: &mut NarrowBand,
    bounds: &Bounds,
    config: &Config,
    advanced: &mut dyn FnMut(f64) -> ControlFlow<B>,
) -> ControlFlow<B, SmoothReport> {
    let mut report = SmoothReport::new(config);
    let mut memory = Memory::new(band.topology.len());
    let acts = acts(config, u32::MAX);
    let act_count = acts.len() as f64;
    for (index, act) in acts.into_iter().enumerate() {
        let tally = Work { config, band, bounds, memory: &mut memory, own: None }.perform(act);
        report.add(act, tally);
        advanced((index + 1) as f64 / act_count)?;
    }
    ControlFlow::Continue(report)
}

/// Moves values off zero, unless their bounds demand that they are as near.
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

/// What Laplacian steps leave of the radius of a lone sphere, in voxels: dr/dt = −2/r.
pub fn radius_after_laplacian(radius_voxels: f64, steps: u32) -> f64 {
    let time = f64::from(acts::LAPLACIAN_STEP_SIZE) * f64::from(steps);
    (radius_voxels * radius_voxels - 4.0 * time).max(0.0).sqrt()
}

/// The Laplacian flow alone, for comparison with the biharmonic one (paper, Fig. 5): `steps` steps
/// of 0.1 h², redistanced and clamped every 50 and at the end.
pub fn smooth_laplacian_only(band: &mut NarrowBand, bounds: &Bounds, steps: u32) {
    const REDISTANCE_EVERY: u32 = 50;
    let config = Config {
        laplacian_steps: steps,
        integrator: Integrator::Explicit,
        steps: 0,
        step_size: 0.0,
        redistance_every: 1,
        cg_tolerance: 0.0,
        keeps_spheres: false,
        distances_voxels: 0.0,
    };
    let mut memory = Memory::new(band.topology.len());
    for act in acts(&config, REDISTANCE_EVERY) {
        if matches!(act, Act::Laplacian { .. }) {
            for act in [act, Act::Redistance] {
                Work { config: &config, band, bounds, memory: &mut memory, own: None }.perform(act);
            }
        }
    }
}
