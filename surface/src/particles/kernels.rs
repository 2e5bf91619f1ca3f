//! The kernel of a particle, and the level of the sum of kernels at which a fluid ends.
//!
//! ```text
//!   K │──╮          K(q) = (1 − q²)⁴, where q = 1 is the kernel's reach
//!     │   ╲
//!     │─ ─ ╲─ ─ ─   the level: the surface of a lone particle
//!     │     ╰───
//!     0          1  q
//! ```

use crate::simd::Lanes;

/// K, from 1 − q²; 0 beyond the reach.
#[inline(always)]
pub fn kernel<V: Lanes>(left: V) -> V {
    let left = left.max(V::splat(0.0));
    let squared = left.mul(left);
    squared.mul(squared)
}

/// q where K has this value; 0 for values above 1.
#[inline(always)]
pub fn inverse_kernel<V: Lanes>(value: V) -> V {
    V::splat(1.0).sub(value.sqrt().sqrt()).max(V::splat(0.0)).sqrt()
}

/// q at the level 0.46: with smoothed positions, bodies then have the volume of their particles.
pub const LEVEL_AT: f32 = 0.420_06;

/// The size of the kernel of a particle without company, relative to one in full company. With wide kernels,
/// bodies are smooth; with narrower ones, drops are as large as their particles, and join late.
pub const LONE_SCALE: f32 = 0.73;

/// The radius of the surface of a lone particle of scale 1, in units of the reach of kernels.
pub const LONE_RADIUS: f32 = LONE_SCALE * LEVEL_AT;
