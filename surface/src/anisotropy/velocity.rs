//! Shapes from velocities: faster particles are longer along their velocity (paper, Eq. 16, Fig. 11).
//!
//! ```text
//!              ⎡ 1/(1+s)²            ⎤             semi-axes: a = (1 + s)² along v
//!   T = [v t t]⎢          1+s        ⎥[v t t]ᵀ                b = 1/(1 + s) across v
//!              ⎣               1 + s ⎦             product a·b² = 1, stretch a/b = (1 + s)³
//! ```
//!
//! All directions across v are equivalent, so T = 1/b + (1/a − 1/b)·v·vᵀ, and t is not needed.

use glam::DVec3;
use rayon::prelude::*;

use super::half_axes::cube_root;
use super::{AnisotropicShapes, RAISED_BELOW, ball, scale_of};
use crate::parallel::Loops as _;
use crate::particles::Ellipsoid;

/// How velocities shape particles.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct VelocityConfig {
    /// s at a speed of one world unit per second: the gain of the settings, in seconds, divided by r_min. Not
    /// negative.
    pub gain_per_speed: f32,
    /// Upper limit of the semi-axis along the velocity, relative to those across, before they are raised to
    /// the floor: 1 or more.
    pub max_stretch: f32,
    /// Lower limit of semi-axes, in units of the settings' radii. Positive.
    pub floor: f32,
}

/// Shapes particles by their velocities: x, y and z per particle (paper, Eq. 16). `scales` has one entry per
/// particle. A particle whose velocity is not finite is a ball.
pub fn from_velocities(
    velocities: &[f32],
    scales: Option<&[f32]>,
    config: &VelocityConfig,
) -> AnisotropicShapes {
    let (velocities, rest) = velocities.as_chunks::<3>();
    assert!(rest.is_empty(), "three components for each particle");
    assert!(scales.is_none_or(|scales| scales.len() == velocities.len()), "a scale for each particle");
    let most = f64::from(cube_root(config.max_stretch.max(1.0)) - 1.0);
    let stretched = |(index, &velocity): (usize, &[f32; 3])| {
        let velocity = DVec3::from(velocity.map(f64::from));
        stretched(velocity, scale_of(scales, index), most, config)
    };
    let shapes: Vec<(Ellipsoid, bool)> = velocities.par_iter().enumerate().halved().map(stretched).collect();
    AnisotropicShapes {
        raised_count: shapes.iter().filter(|(_, is_raised)| *is_raised).count(),
        ball_count: velocities.iter().filter(|velocity| !is_finite(velocity)).count(),
        shapes: shapes.into_iter().map(|(shape, _)| shape).collect(),
    }
}

fn is_finite(velocity: &[f32; 3]) -> bool {
    velocity.iter().all(|along| along.is_finite())
}

/// The shape for a velocity with s limited to `most`, and whether a semi-axis was raised.
fn stretched(velocity: DVec3, scale: f32, most: f64, config: &VelocityConfig) -> (Ellipsoid, bool) {
    // In 64 bits, the squares of 32-bit numbers do not overflow.
    let speed = velocity.length();
    let s = (f64::from(config.gain_per_speed) * speed).min(most) as f32;
    // `s > 0.0` is false for NaN.
    if !(s > 0.0 && speed.is_finite()) {
        return ball(scale, config.floor);
    }
    let along = (1.0 + s) * (1.0 + s) * scale;
    let across = scale / (1.0 + s);
    let is_raised = across < RAISED_BELOW * config.floor;
    let (along, across) = (along.max(config.floor), across.max(config.floor));
    let direction = (velocity / speed).as_vec3();
    let of_ball = 1.0 / across;
    let (x, y, z) = direction.into();
    let more = 1.0 / along - of_ball;
    let to_unit_ball = [
        of_ball + more * x * x,
        of_ball + more * y * y,
        of_ball + more * z * z,
        more * x * y,
        more * x * z,
        more * y * z,
    ];
    (Ellipsoid { to_unit_ball, longest: along }, is_raised)
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::Vec3;

    const CONFIG: VelocityConfig = VelocityConfig { gain_per_speed: 0.5, max_stretch: 8.0, floor: 0.01 };

    /// Distance of the surface of r = 1 from the centre, along a direction.
    fn extent(shape: &Ellipsoid, direction: Vec3) -> f32 {
        1.0 / shape.apply(direction.normalize()).length()
    }

    fn shape(velocity: Vec3, scale: f32) -> Ellipsoid {
        from_velocities(&velocity.to_array(), Some(&[scale]), &CONFIG).shapes[0]
    }

    #[test]
    fn half_axes_match_equation_16() {
        for (speed, s) in [(0.5f32, 0.25f32), (1.0, 0.5), (2.0, 1.0), (2.5, 1.0), (3e38, 1.0)] {
            for along in [Vec3::X, Vec3::new(0.48, -0.6, 0.64), Vec3::new(0.0, 0.6, 0.8)] {
                for scale in [1.0, 3.0] {
                    let shape = shape(along * speed, scale);
                    let expected = (1.0 + s).powi(2) * scale;
                    assert!((shape.longest / expected - 1.0).abs() < 1e-5, "{shape:?}");
                    assert!((extent(&shape, along) / expected - 1.0).abs() < 1e-5, "{shape:?}");
                    let across = along.any_orthonormal_vector();
                    for across in [across, across.cross(along)] {
                        let expected = scale / (1.0 + s);
                        assert!((extent(&shape, across) / expected - 1.0).abs() < 1e-5, "{shape:?}");
                    }
                }
            }
        }
    }

    #[test]
    fn only_moving_particles_are_stretched() {
        let infinite = f32::INFINITY;
        let velocities = [0.0, 0.0, 0.0, f32::NAN, 1.0, 0.0, -infinite, infinite, 0.0, 1e-40, 0.0, 0.0];
        let shaped = from_velocities(&velocities, None, &CONFIG);
        assert_eq!((shaped.ball_count, shaped.raised_count), (2, 0));
        for (shape, expected) in shaped.shapes.iter().zip([1.0; 4].map(Ellipsoid::ball)) {
            assert_eq!(*shape, expected);
        }
        let none = from_velocities(&[], None, &CONFIG);
        assert_eq!((none.shapes.len(), none.ball_count), (0, 0));
    }

    #[test]
    fn half_axes_below_the_floor_are_raised_and_counted() {
        let config = VelocityConfig { floor: 0.8, ..CONFIG };
        let velocities = [2.0, 0.0, 0.0, 0.2, 0.0, 0.0, 0.0, 0.0, 0.0];
        let shaped = from_velocities(&velocities, Some(&[1.0, 1.0, 0.5]), &config);
        assert_eq!(shaped.raised_count, 2);
        assert!((extent(&shaped.shapes[0], Vec3::Y) - 0.8).abs() < 1e-6);
        assert!((shaped.shapes[0].longest - 4.0).abs() < 1e-5);
        assert!((extent(&shaped.shapes[1], Vec3::Y) - 1.0 / 1.1).abs() < 1e-6);
        assert_eq!(shaped.shapes[2], Ellipsoid::ball(0.8));
    }

    #[test]
    fn invalid_scales_become_the_smallest() {
        for scale in [f32::NAN, -1.0, 0.0, f32::INFINITY] {
            assert_eq!(shape(Vec3::ZERO, scale), Ellipsoid::ball(0.01));
            assert_eq!(shape(Vec3::X, scale).longest, 0.01);
        }
    }
}
