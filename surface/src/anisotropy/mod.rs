//! Anisotropy: stretches particles along the sheet or filament that they are part of, or along their
//! velocity.
//!
//! ```text
//!   ∙ ∙ ∙ ∙ ∙        neighbours   ⬭⬭⬭⬭⬭   a sheet becomes flat; balls would make bumps
//!
//!   ∙→  ∙⟶  ∙⟶⟶     velocity     ●  ⬬  ⬬    a drop is longer, the faster it is
//! ```
//!
//! The two methods, by neighbours and by velocity, are independent of each other. Both accept a scale per
//! particle, and compute semi-axes in units of the settings' radii. The product of a particle's three
//! semi-axes is the cube of its scale. At the end, semi-axes too short for the grid are raised to a floor,
//! and the affected particles are counted.
//!
//! By neighbours, a shape depends only on the particles within the neighbor radius (where particles are very
//! dense, within the cells that this radius touches); by velocity, only on its own particle. Shapes are
//! bit-identical on any number of threads and with any SIMD width.
//!
//! This work is based on:
//! Jihun Yu and Greg Turk. Reconstructing surfaces of particle-based fluids using anisotropic kernels. 2010

mod eigen;
mod half_axes;
mod moments;
mod neighborhoods;
mod radii;
mod velocity;

use crate::particles::Ellipsoid;

pub use neighborhoods::{NeighborConfig, NeighborShapes, Stretch, from_neighbors};
pub use radii::{RadiusScales, radius_scales};
pub use velocity::{VelocityConfig, from_velocities};

/// The shapes of a frame's particles.
#[derive(Clone, Debug, PartialEq)]
pub struct AnisotropicShapes {
    /// The shape of each particle, in order.
    pub shapes: Vec<Ellipsoid>,
    /// Number of particles with a semi-axis that was raised to the floor.
    pub raised_count: usize,
    /// Number of particles that are balls because there is not enough information: too few neighbours, or a
    /// velocity or position that is not finite.
    pub ball_count: usize,
}

/// Upper bound of all semi-axes of a particle of scale 1. Let m be `max_stretch`, which is finite, and a ≥ b
/// ≥ c the semi-axes, with a·b·c = 1 and a ≤ m·c. The longest possible a is that of a cigar (b = c): m^⅔, or
/// the floor if that is larger. Velocities (paper, Eq. 16) keep this bound, too: the longest semi-axis (1 +
/// s)² is the ratio (1 + s)³ to the power ⅔.
#[cfg(test)]
fn longest_bound(max_stretch: f32, floor: f32) -> f32 {
    let root = half_axes::cube_root(max_stretch.max(1.0));
    // A product of three rounded numbers is not exactly 1.
    (root * root * (1.0 + 1e-5)).max(floor)
}

/// The scale of all particles without per-particle scales.
const SCALE: f32 = 1.0;

/// The scale of a particle. An invalid scale becomes 0, the smallest.
fn scale_of(scales: Option<&[f32]>, index: usize) -> f32 {
    let scale = scales.map_or(SCALE, |scales| scales[index]);
    if scale.is_finite() { scale.max(0.0) } else { 0.0 }
}

/// A ball of this scale, raised to the floor, and whether it was raised.
fn ball(scale: f32, floor: f32) -> (Ellipsoid, bool) {
    (Ellipsoid::ball(scale.max(floor)), scale < RAISED_BELOW * floor)
}

/// A semi-axis counts as raised if it was below this fraction of the floor. Rounding alone makes one
/// semi-axis of every ellipsoid shorter than its ball's radius; such invisible changes are not reported.
const RAISED_BELOW: f32 = 0.999;
