//! The shape of each particle: a ball or an ellipsoid.
//!
//! Each particle has three surfaces of the same shape, one for each radius r: r_min, r_init and r_max.
//!
//! ```text
//!   balls        |x − p| = r            all particles are the same
//!   radii        |x − p| = s·r          s: one scale per particle      (paper, Fig. 13)
//!   ellipsoids   |T(x − p)| = r         T: one symmetric matrix per particle       (paper, Eq. 1, Fig. 11)
//! ```
//!
//! With kernels, an ellipsoid also has a weight, and the room that it leaves to the surface.

use std::ops::Range;

use bytemuck::{Pod, Zeroable};
use glam::Vec3;

/// The shapes of the particles of a frame.
#[derive(Clone, Debug, Default, PartialEq)]
pub enum Shapes {
    /// Balls of the settings' radii.
    #[default]
    Uniform,
    /// Balls. Each particle has a scale that multiplies the settings' radii.
    Scaled(Vec<f32>),
    /// Ellipsoids, one per particle.
    Ellipsoids(Vec<Ellipsoid>),
}

impl Shapes {
    /// Whether all particles have the same shape.
    pub fn is_uniform(&self) -> bool {
        matches!(self, Shapes::Uniform)
    }

    /// Circumscribed radius: how far particle `index` reaches from its centre, in units of the settings'
    /// radii.
    pub fn outer_radius(&self, index: usize) -> f32 {
        match self {
            Shapes::Uniform => 1.0,
            Shapes::Scaled(scales) => scales[index],
            Shapes::Ellipsoids(ellipsoids) => ellipsoids[index].longest,
        }
    }

    /// Inscribed radius, or a little less: for each of r_min and r_init, a ball of this radius around the
    /// centre of particle `index` is inside the particle's surface of that radius. In units of the settings'
    /// radii.
    pub fn inner_radius(&self, index: usize) -> f32 {
        match self {
            Shapes::Uniform => 1.0,
            Shapes::Scaled(scales) => scales[index],
            Shapes::Ellipsoids(ellipsoids) => ellipsoids[index].inner_radius(),
        }
    }

    /// The shapes of a range of particles.
    pub fn slice(&self, range: Range<usize>) -> Shapes {
        match self {
            Shapes::Uniform => Shapes::Uniform,
            Shapes::Scaled(scales) => Shapes::Scaled(scales[range].to_vec()),
            Shapes::Ellipsoids(ellipsoids) => Shapes::Ellipsoids(ellipsoids[range].to_vec()),
        }
    }

    /// The shape of one particle as an ellipsoid.
    pub fn ellipsoid(&self, index: usize) -> Ellipsoid {
        match self {
            Shapes::Uniform => Ellipsoid::ball(1.0),
            Shapes::Scaled(scales) => Ellipsoid::ball(scales[index]),
            Shapes::Ellipsoids(ellipsoids) => ellipsoids[index],
        }
    }

    /// The shapes of these particles.
    pub fn select(&self, indices: &[u32]) -> Shapes {
        match self {
            Shapes::Uniform => Shapes::Uniform,
            Shapes::Scaled(scales) => {
                Shapes::Scaled(indices.iter().map(|&index| scales[index as usize]).collect())
            }
            Shapes::Ellipsoids(ellipsoids) => {
                Shapes::Ellipsoids(indices.iter().map(|&index| ellipsoids[index as usize]).collect())
            }
        }
    }
}

/// The semi-axes and directions of an ellipsoid, in units of the settings' radii.
///
/// It is stored as the symmetric matrix T that maps it to the unit ball. The eigenvalues of T are 1/a, 1/b,
/// 1/c for semi-axes a, b and c.
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct Ellipsoid {
    /// T: xx, yy, zz, xy, xz, yz.
    pub to_unit_ball: [f32; 6],
    /// The longest semi-axis: no point of the ellipsoid is farther from its centre.
    pub longest: f32,
    /// The factor of its kernel.
    pub weight: f32,
    /// How far the surface may move inward from its start near this particle, in voxels.
    pub room: f32,
}

impl Ellipsoid {
    /// The ball whose semi-axes are all `scale`.
    pub fn ball(scale: f32) -> Ellipsoid {
        let inverse = 1.0 / scale;
        Ellipsoid {
            to_unit_ball: [inverse, inverse, inverse, 0.0, 0.0, 0.0],
            longest: scale,
            weight: 1.0,
            room: 0.0,
        }
    }

    /// The ellipsoid with these semi-axes along these directions, which must be orthonormal.
    pub fn new(half_axes: [f32; 3], directions: [Vec3; 3]) -> Ellipsoid {
        let mut to_unit_ball = [0.0f32; 6];
        for (half_axis, direction) in half_axes.into_iter().zip(directions) {
            let Vec3 { x, y, z } = direction;
            for (entry, product) in to_unit_ball.iter_mut().zip([x * x, y * y, z * z, x * y, x * z, y * z]) {
                *entry += product / half_axis;
            }
        }
        let longest = half_axes.into_iter().fold(0.0, f32::max);
        Ellipsoid { to_unit_ball, longest, weight: 1.0, room: 0.0 }
    }

    /// The ellipsoid with semi-axes that are this many times as long.
    pub(crate) fn resized(self, factor: f32) -> Ellipsoid {
        let to_unit_ball = self.to_unit_ball.map(|entry| entry / factor);
        Ellipsoid { to_unit_ball, longest: self.longest * factor, ..self }
    }

    /// The radius of the ball with the same volume, in units of the settings' radii: (a·b·c)^⅓.
    pub(crate) fn ball_radius(&self) -> f32 {
        let [xx, yy, zz, xy, xz, yz] = self.to_unit_ball;
        let determinant = xx * (yy * zz - yz * yz) - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz);
        cube_root(1.0 / determinant)
    }

    /// The shortest semi-axis, or a little less, in units of the settings' radii. The largest eigenvalue of T
    /// is at most m + √2 s, with the mean m and the standard deviation s of the eigenvalues (Wolkowicz and
    /// Styan 1980, Theorem 2.1).
    pub fn inner_radius(&self) -> f32 {
        let [xx, yy, zz, xy, xz, yz] = self.to_unit_ball;
        let mean = (xx + yy + zz) / 3.0;
        let diagonal = Vec3::new(xx - mean, yy - mean, zz - mean).length_squared();
        let variance = (diagonal + 2.0 * Vec3::new(xy, xz, yz).length_squared()) / 3.0;
        // The margin is far larger than the 32-bit rounding error.
        0.9999 / (mean + (2.0 * variance).sqrt())
    }

    /// How far the ellipsoid reaches from its centre along x, y and z, in units of the settings' radii: the
    /// lengths of the rows of T⁻¹.
    pub fn extents(&self) -> Vec3 {
        let [xx, yy, zz, xy, xz, yz] = self.to_unit_ball;
        let cofactors = [
            Vec3::new(yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy),
            Vec3::new(xz * yz - xy * zz, xx * zz - xz * xz, xy * xz - xx * yz),
            Vec3::new(xy * yz - xz * yy, xy * xz - xx * yz, xx * yy - xy * xy),
        ];
        let determinant = xx * cofactors[0].x + xy * cofactors[0].y + xz * cofactors[0].z;
        let [x, y, z] = cofactors.map(|row| row.length() / determinant);
        Vec3::new(x, y, z).min(Vec3::splat(self.longest))
    }

    /// T·`v`.
    #[inline(always)]
    pub fn apply(&self, v: Vec3) -> Vec3 {
        let [xx, yy, zz, xy, xz, yz] = self.to_unit_ball;
        Vec3::new(
            xx * v.x + xy * v.y + xz * v.z,
            xy * v.x + yy * v.y + yz * v.z,
            xz * v.x + yz * v.y + zz * v.z,
        )
    }
}

/// The cube root of a positive number that is not tiny, accurate to the last bit or two. Starts from a guess
/// by the exponent and does two steps of Halley's method, each of which triples the number of correct digits.
/// The result is the same on all processors, which standard libraries do not guarantee.
#[inline(always)]
pub(crate) fn cube_root(value: f32) -> f32 {
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
    fn half_axes_end_on_the_ellipsoid() {
        let x = Vec3::new(0.6, 0.8, 0.0);
        let y = Vec3::new(-0.8, 0.6, 0.0);
        let directions = [x, y, x.cross(y)];
        let half_axes = [3.0, 0.5, 1.25];
        let ellipsoid = Ellipsoid::new(half_axes, directions);
        for (half_axis, direction) in half_axes.into_iter().zip(directions) {
            let on_ball = ellipsoid.apply(direction * half_axis);
            assert!((on_ball - direction).length() < 1e-6, "{on_ball} for {direction}");
        }
        assert_eq!(ellipsoid.longest, 3.0);
        let reach = |along: Vec3| {
            let squares = half_axes.into_iter().zip(directions).map(|(a, d)| (a * d.dot(along)).powi(2));
            squares.sum::<f32>().sqrt()
        };
        let expected = Vec3::new(reach(Vec3::X), reach(Vec3::Y), reach(Vec3::Z));
        assert!((ellipsoid.extents() - expected).length() < 1e-5, "{expected}");
        assert!((0.4..0.5).contains(&ellipsoid.inner_radius()), "{}", ellipsoid.inner_radius());
        assert!((ellipsoid.ball_radius().powi(3) - 3.0 * 0.5 * 1.25).abs() < 1e-5);
        assert!((1.999..2.0).contains(&Ellipsoid::ball(2.0).inner_radius()));
        assert_eq!(Ellipsoid::ball(2.0).apply(Vec3::new(2.0, -4.0, 1.0)), Vec3::new(1.0, -2.0, 0.5));
    }
}
