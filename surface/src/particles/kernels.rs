//! The kernel of a particle, and the level of the sum of kernels at which a fluid ends.
//!
//! ```text
//!   K │──╮          K(q) = (1 − 0.8 q²)⁴ − 0.2⁴, where q = 1 is the kernel's reach
//!     │   ╲
//!     │─ ─ ╲─ ─ ─   the level: the surface of a lone particle
//!     │     ╰───
//!     0          1  q
//! ```
//!
//! Without the last term the kernel would reach to √(1 / 0.8): 40 % more volume to add up, for values that do
//! not matter.

use crate::simd::Lanes;

/// Factor of q².
const SLOPE: f32 = 0.8;

/// The value of the first term at q = 1, which is subtracted.
const CUTOFF: f32 = 0.001_6;

/// K, from q²; 0 beyond the reach.
#[inline(always)]
pub fn kernel<V: Lanes>(q_squared: V) -> V {
    let root = V::splat(1.0).sub(V::splat(SLOPE).mul(q_squared)).max(V::splat(0.0));
    let squared = root.mul(root);
    squared.mul(squared).sub(V::splat(CUTOFF)).max(V::splat(0.0))
}

/// q where K has this value; 0 for values above 1.
#[inline(always)]
pub fn inverse_kernel<V: Lanes>(value: V) -> V {
    let root = value.add(V::splat(CUTOFF)).sqrt().sqrt();
    V::splat(1.0).sub(root).max(V::splat(0.0)).mul(V::splat(1.0 / SLOPE)).sqrt()
}

/// The sum of kernels at the surface.
pub const LEVEL: f32 = 0.49;

/// q at the [level](LEVEL) of one kernel: with smoothed positions, bodies then have the volume of their particles.
pub const LEVEL_AT: f32 = 0.450_91;

/// The size of the kernel of a particle without company, relative to one in a sheet: drops are then as large as
/// their particles, and join late.
pub const LONE_SCALE: f32 = 0.79;

/// The size of the kernel of a particle at the surface of a body, relative to one in a sheet: such surfaces are
/// then smooth, and convex edges round.
pub const BODY_SCALE: f32 = 1.54;

/// The radius of the surface of a lone particle of scale 1, in units of the reach of kernels.
pub const LONE_RADIUS: f32 = LONE_SCALE * LEVEL_AT;
