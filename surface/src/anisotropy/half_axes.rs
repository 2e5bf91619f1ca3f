//! Converts moments to ellipsoids, eight particles at a time.
//!
//! ```text
//!   moments ──▶ covariance ──▶ eigenvalues λ ──▶ √λ ──▶ limit ──▶ volume ──▶ blend ─┐
//!                                                   ellipsoid ◀── floor ◀── scale ◀─┘
//! ```
//!
//! - **√λ**: semi-axes are proportional to the square roots of the eigenvalues, that is, to the standard
//!   deviation of the neighbours along each direction. So a particle gets the shape of its neighbourhood. (Yu
//!   and Turk, Eq. 16, use the eigenvalues themselves, which doubles the stretch on a logarithmic scale.)
//! - **Limit**: no semi-axis is shorter than the longest divided by `max_stretch` (k_r of Yu and Turk,
//!   Eq. 15).
//! - **Volume**: all semi-axes are divided by the cube root of their product. (Yu and Turk multiply by k_s.)
//! - **Blend**: with few neighbours, measured by the sum of their weights, the ellipsoid blends into a ball.
//!   (Yu and Turk compare the number of neighbours with N_ε instead. At that number, shapes would jump from
//!   one frame to the next.)
//!
//! ```text
//!   share of the ellipsoid
//!     1 │       ╱▔▔▔▔▔▔               from 4 on: a tenth of the weight of a full neighbourhood, like Yu and
//!       │     ╱                       Turk's N_ε = 25 of about 270 neighbours
//!     0 │▁▁▁▁╱▁▁▁▁▁▁▁▁▁ sum of        up to 1: a pair of particles is too few for a shape
//!            1   4      weights
//! ```

use super::RAISED_BELOW;
use super::eigen::{Eigen, eigen};
use super::moments::MOMENT_COUNT;
use super::neighborhoods::Stretch;
use crate::particles::Ellipsoid;
use crate::simd::Lanes;

/// Up to this sum of neighbour weights a particle is a ball.
const WEIGHT_NONE: f32 = 1.0;

/// From this sum of neighbour weights on, the ellipsoid is not blended. At a radius of 2.6 spacings the sum
/// is 36 inside, 24 at a plane surface, 12 in a sheet, 7 at the edge of a sheet and 3 in a line.
const WEIGHT_FULL: f32 = 4.0;

/// Added to each eigenvalue, in units of the squared radius. So many particles at one point give a ball, and
/// not a shape that rounding errors determine. Then no semi-axis is more than about 50 times as long as
/// another.
const SPREAD_MIN: f32 = 1e-4;

/// The shapes of eight particles.
pub(super) struct Shapes8 {
    pub(super) shapes: [Ellipsoid; 8],
    /// Mask of the particles with a raised semi-axis.
    pub(super) raised: u8,
    /// Mask of the particles that are balls because they have too few neighbours.
    pub(super) balls: u8,
}

/// Computes the shapes of eight particles from their moments and scales.
#[inline(always)]
pub(super) fn shapes<V: Lanes>(
    moments: &[[f32; 8]; MOMENT_COUNT],
    scales: &[f32; 8],
    limits: Stretch,
) -> Shapes8 {
    let covariance = covariance::<V>(moments);
    let Eigen { values, vectors } = eigen(covariance);
    // Each particle is one of its own neighbours, with a weight of 1.
    let neighbors = V::load(&moments[0]).sub(V::splat(1.0 + WEIGHT_NONE));
    let part = neighbors.mul(V::splat(1.0 / (WEIGHT_FULL - WEIGHT_NONE)));
    let part = part.max(V::splat(0.0)).min(V::splat(1.0));
    let half_axes = blended(limited(values, limits.max_stretch), part);
    let (half_axes, is_raised) = scaled(half_axes, part, V::load(scales), limits);
    let is_ball = V::not(V::splat(0.0).lt(part));
    Shapes8 {
        shapes: ellipsoids(half_axes, vectors, V::bits(is_ball)),
        raised: V::bits(is_raised),
        balls: V::bits(is_ball),
    }
}

/// The mean position (x, y and z) of the neighbours of each of eight particles, relative to the particle, in
/// units of the radius. Uses the first four moments.
#[inline(always)]
pub(super) fn means<V: Lanes>(moments: &[[f32; 8]]) -> [[f32; 8]; 3] {
    let (mean, _) = mean_and_weight::<V>(moments);
    let mut means = [[0.0; 8]; 3];
    for (row, along) in means.iter_mut().zip(mean) {
        along.store(row);
    }
    means
}

/// The mean position (Yu and Turk, Eq. 10), and the factor that turns a weighted sum into a mean.
#[inline(always)]
fn mean_and_weight<V: Lanes>(moments: &[[f32; 8]]) -> ([V; 3], V) {
    // Each particle itself contributes a weight of 1, so the sum is at least 1. The exception is a cell with
    // so many particles that only a sample of them is used, which may lack the particle.
    let by_weight = V::splat(1.0).div(V::load(&moments[0]).max(V::splat(1.0)));
    let mut means = [V::splat(0.0); 3];
    for (mean, moment) in means.iter_mut().zip(&moments[1..4]) {
        *mean = V::load(moment).mul(by_weight);
    }
    (means, by_weight)
}

/// The covariance (Yu and Turk, Eq. 9): xx, yy, zz, xy, xz and yz.
#[inline(always)]
fn covariance<V: Lanes>(moments: &[[f32; 8]; MOMENT_COUNT]) -> [V; 6] {
    let ([x, y, z], by_weight) = mean_and_weight::<V>(moments);
    let products = [x.mul(x), y.mul(y), z.mul(z), x.mul(y), x.mul(z), y.mul(z)];
    let mut covariance = [V::splat(0.0); 6];
    for (entry, (moment, product)) in covariance.iter_mut().zip(moments[4..].iter().zip(products)) {
        *entry = V::load(moment).mul(by_weight).sub(product);
    }
    for diagonal in &mut covariance[..3] {
        *diagonal = diagonal.add(V::splat(SPREAD_MIN));
    }
    covariance
}

/// Scales semi-axes to a product of 1, and limits their ratio to `max_stretch`.
#[inline(always)]
fn limited<V: Lanes>(eigenvalues: [V; 3], max_stretch: f32) -> [V; 3] {
    let mut half_axes = eigenvalues;
    for half_axis in &mut half_axes {
        *half_axis = half_axis.max(V::splat(SPREAD_MIN)).sqrt();
    }
    let [a, b, c] = half_axes;
    let least = a.max(b).max(c).mul(V::splat(1.0 / max_stretch));
    with_unit_volume([a.max(least), b.max(least), c.max(least)])
}

/// Blends semi-axes whose product is 1 with those of a ball. The product stays 1, and the stretch is between
/// 1 and that of the given semi-axes.
#[inline(always)]
fn blended<V: Lanes>(half_axes: [V; 3], part: V) -> [V; 3] {
    let one = V::splat(1.0);
    let [a, b, c] = half_axes;
    with_unit_volume([
        one.add(part.mul(a.sub(one))),
        one.add(part.mul(b.sub(one))),
        one.add(part.mul(c.sub(one))),
    ])
}

#[inline(always)]
fn with_unit_volume<V: Lanes>(half_axes: [V; 3]) -> [V; 3] {
    let [a, b, c] = half_axes;
    let mut row = [0.0; 8];
    a.mul(b).mul(c).store(&mut row);
    for value in &mut row {
        *value = cube_root(*value);
    }
    let root = V::load(&row);
    [a.div(root), b.div(root), c.div(root)]
}

/// Multiplies semi-axes by the scale, and raises those below the floor. Also returns a mask of the particles
/// with a raised semi-axis. The fewer neighbours, the closer scale and floor are to those of isolated
/// particles.
#[inline(always)]
fn scaled<V: Lanes>(half_axes: [V; 3], part: V, scale: V, limits: Stretch) -> ([V; 3], V::Mask) {
    let is_ball = V::not(V::splat(0.0).lt(part));
    let between = |lone: f32, usual: f32| V::splat(lone).add(part.mul(V::splat(usual - lone)));
    let floor = between(limits.lone_floor, limits.floor);
    let scale = scale.mul(between(limits.lone, 1.0));
    let [mut a, mut b, mut c] = half_axes;
    for half_axis in [&mut a, &mut b, &mut c] {
        // The semi-axes of a ball are exactly the scale, without rounding errors.
        *half_axis = V::select(is_ball, scale, half_axis.mul(scale));
    }
    let is_raised = a.min(b).min(c).lt(floor.mul(V::splat(RAISED_BELOW)));
    ([a.max(floor), b.max(floor), c.max(floor)], is_raised)
}

#[inline(always)]
fn ellipsoids<V: Lanes>(half_axes: [V; 3], vectors: [[V; 3]; 3], balls: u8) -> [Ellipsoid; 8] {
    let mut to_unit_ball = [V::splat(0.0); 6];
    for (half_axis, [x, y, z]) in half_axes.into_iter().zip(vectors) {
        let inverse = V::splat(1.0).div(half_axis);
        let (of_x, of_y, of_z) = (x.mul(inverse), y.mul(inverse), z.mul(inverse));
        let products = [of_x.mul(x), of_y.mul(y), of_z.mul(z), of_x.mul(y), of_x.mul(z), of_y.mul(z)];
        for (entry, product) in to_unit_ball.iter_mut().zip(products) {
            *entry = entry.add(product);
        }
    }
    let [a, b, c] = half_axes;
    let mut longest = [0.0; 8];
    a.max(b).max(c).store(&mut longest);
    let mut rows = [[0.0; 8]; 6];
    for (row, entry) in rows.iter_mut().zip(to_unit_ball) {
        entry.store(row);
    }
    let mut shapes = [Ellipsoid { to_unit_ball: [0.0; 6], longest: 0.0 }; 8];
    for (lane, shape) in shapes.iter_mut().enumerate() {
        shape.longest = longest[lane];
        for (entry, row) in shape.to_unit_ball.iter_mut().zip(&rows) {
            *entry = row[lane];
        }
        if balls >> lane & 1 == 1 {
            *shape = Ellipsoid::ball(longest[lane]);
        }
    }
    shapes
}

/// The cube root of a positive number that is not tiny, accurate to the last bit or two. Starts from a guess
/// by the exponent and does two steps of Halley's method, each of which triples the number of correct digits.
/// The result is the same on all processors, which standard libraries do not guarantee.
#[inline(always)]
pub(super) fn cube_root(value: f32) -> f32 {
    let mut root = f32::from_bits(value.to_bits() / 3 + 0x2a51_19f2);
    for _ in 0..2 {
        let cube = root * root * root;
        root *= (cube + 2.0 * value) / (2.0 * cube + value);
    }
    root
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cube_roots_are_accurate_to_the_last_bits() {
        let mut value = 1e-12f32;
        while value < 1e12 {
            let expected = f64::from(value).cbrt();
            let error = f64::from(cube_root(value)) / expected - 1.0;
            assert!(error.abs() < 3e-7, "{error} for {value}");
            value *= 1.003;
        }
    }
}
