//! What shape each particle is: stretched along the sheet or the thread it is part of, or along its way.
//!
//! ```text
//!   ∙ ∙ ∙ ∙ ∙        neighbours   ⬭⬭⬭⬭⬭   a sheet is flat, where balls would be bumps
//!
//!   ∙→  ∙⟶  ∙⟶⟶     velocity     ●  ⬬  ⬬    a drop is longer, the faster it is
//! ```
//!
//! Neither way knows of the other, and both take a scale of each particle's own. All end in half axes in units of the
//! settings' radii, whose product is the cube of the scale. Then, and only then, those that the grid could not hold are
//! raised to a floor, and the particles to which that happened are counted.
//!
//! A shape depends on particles within a radius, or on its own particle alone: to the bit, on any number of threads
//! and at any width of vectors.
//!
//! This work is based on:
//! Jihun Yu and Greg Turk. Reconstructing surfaces of particle-based fluids using anisotropic kernels. 2010

mod eigen;
mod half_axes;
mod moments;
mod neighborhoods;
mod radii;
mod velocity;

use crate::surface::particles::Ellipsoid;

pub use neighborhoods::{ByNeighbors, NeighborConfig, Stretch, from_neighbors};
pub use radii::{RadiusScales, radius_scales};
pub use velocity::{VelocityConfig, from_velocities};

/// Particles with shapes.
#[derive(Clone, Debug, PartialEq)]
pub struct Shaped {
    /// The shape of each, in the order of the particles.
    pub shapes: Vec<Ellipsoid>,
    /// Particles of which a half axis was raised to the floor.
    pub raised_count: usize,
    /// Particles that are balls because nothing says otherwise: neighbours too few, no velocity or position that is
    /// finite.
    pub ball_count: usize,
}

/// No half axis is longer than this, for a particle of scale 1: with half axes a ≥ b ≥ c, a·b·c = 1 and a ≤ m·c, the
/// longest is that of a cigar, m^⅔; or else it is the floor. Both ways to shapes keep to it, for (1 + s)² is
/// ((1 + s)³)^⅔. `max_stretch` is finite.
#[cfg(test)]
fn longest_bound(max_stretch: f32, floor: f32) -> f32 {
    let root = half_axes::cube_root(max_stretch.max(1.0));
    // Products of three numbers that were rounded are not exactly 1.
    (root * root * (1.0 + 1e-5)).max(floor)
}

/// What a particle without a scale of its own has.
const SCALE: f32 = 1.0;

/// The scale of a particle. What is no length is the least there is.
fn scale_of(scales: Option<&[f32]>, index: usize) -> f32 {
    let scale = scales.map_or(SCALE, |scales| scales[index]);
    if scale.is_finite() { scale.max(0.0) } else { 0.0 }
}

/// A ball of this scale, but not below the floor; and whether it had to be raised.
fn ball(scale: f32, floor: f32) -> (Ellipsoid, bool) {
    (Ellipsoid::ball(scale.max(floor)), scale < RAISED_BELOW * floor)
}

/// Part of the floor below which a half axis counts as raised. Of any ellipsoid a half axis is shorter than its ball's
/// radius, be it by what is rounded: what does not show is not to be told.
const RAISED_BELOW: f32 = 0.999;
