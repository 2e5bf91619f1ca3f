//! Balls beside a surface: the particles that are not in it.

use glam::{DVec3, Vec3};
use meniscus_surface::particles::Positions;

use crate::surface::Ray;
use crate::tile::RayTarget;
use crate::tree::BoxTree;

/// Particles to render as balls. They look like the surface, and cast no shadows.
#[derive(Clone, Debug)]
pub struct Balls<'a> {
    /// Their centers, world units.
    pub positions: Positions<'a>,
    /// Their radii, world units. A ball whose center or radius is not finite, or whose radius is not positive, is not
    /// shown.
    pub radii: &'a [f32],
    /// Their velocities, world units per second; empty if they are unknown.
    pub velocities: &'a [[f32; 3]],
}

/// A surface with balls beside it. Lengths are in voxels.
pub(super) struct WithBalls<'a, S> {
    surface: &'a S,
    balls: Balls<'a>,
    voxel_size: f64,
    tree: BoxTree,
}

/// What a ray hits.
pub(super) enum SurfaceOrBall<L> {
    Surface(L),
    Ball { index: u32, outward: Vec3 },
}

impl<'a, S: RayTarget> WithBalls<'a, S> {
    pub(super) fn new(surface: &'a S, balls: Balls<'a>, voxel_size: f64) -> WithBalls<'a, S> {
        let mut target = WithBalls { surface, balls, voxel_size, tree: BoxTree::default() };
        let count = target.balls.positions.len().min(target.balls.radii.len());
        let center = |index: u32| {
            let (center, radius) = target.ball(index);
            (center.is_finite() && radius.is_finite() && radius > 0.0).then_some((center, index))
        };
        let items = (0..u32::try_from(count).unwrap_or(u32::MAX)).filter_map(center).collect();
        target.tree = BoxTree::new(items, &|index| {
            let (center, radius) = target.ball(index);
            [center - radius, center + radius]
        });
        target
    }

    /// The center and the radius of a ball.
    fn ball(&self, index: u32) -> (DVec3, f64) {
        let index = index as usize;
        let (center, radius) = (self.balls.positions.position(index), f64::from(self.balls.radii[index]));
        (center / self.voxel_size, radius / self.voxel_size)
    }

    /// Where a ray enters a ball, and the outward normal there.
    fn enter(&self, index: u32, ray: &Ray) -> Option<(f64, Vec3)> {
        let (center, radius) = self.ball(index);
        let to = center - ray.origin;
        let middle = to.dot(ray.direction);
        let half = (radius * radius - (to - ray.direction * middle).length_squared()).sqrt();
        let t = middle - half;
        // Not a number if the ray misses the ball.
        (t > 0.0).then(|| (t, ((ray.at(t) - center) / radius).as_vec3()))
    }
}

impl<S: RayTarget> RayTarget for WithBalls<'_, S> {
    type Local = SurfaceOrBall<S::Local>;

    fn hit(&self, ray: &Ray) -> Option<(f64, bool, Self::Local)> {
        let mut nearest = None;
        self.tree.visit(ray, |index, limit| match self.enter(index, ray) {
            Some((t, outward)) if t < limit => {
                nearest = Some((t, true, SurfaceOrBall::Ball { index, outward }));
                t
            }
            _ => limit,
        });
        let surface = self.surface.hit(ray);
        match (surface, nearest) {
            (Some((t, ..)), Some(ball)) if ball.0 < t => Some(ball),
            (Some((t, is_front, local)), _) => Some((t, is_front, SurfaceOrBall::Surface(local))),
            (None, ball) => ball,
        }
    }

    fn outward(&self, local: &Self::Local) -> Vec3 {
        match local {
            SurfaceOrBall::Surface(local) => self.surface.outward(local),
            SurfaceOrBall::Ball { outward, .. } => *outward,
        }
    }

    fn mean_curvature(&self, local: &Self::Local) -> f32 {
        match local {
            SurfaceOrBall::Surface(local) => self.surface.mean_curvature(local),
            SurfaceOrBall::Ball { index, .. } => self.ball(*index).1.recip() as f32,
        }
    }

    fn velocity(&self, local: &Self::Local) -> Option<[f32; 3]> {
        match local {
            SurfaceOrBall::Surface(local) => self.surface.velocity(local),
            SurfaceOrBall::Ball { index, .. } => self.balls.velocities.get(*index as usize).copied(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A wall at x = 5, hit from the left.
    struct Wall;

    impl RayTarget for Wall {
        type Local = ();

        fn hit(&self, ray: &Ray) -> Option<(f64, bool, ())> {
            Some((5.0 - ray.origin.x, true, ()))
        }

        fn outward(&self, (): &()) -> Vec3 {
            Vec3::NEG_X
        }

        fn mean_curvature(&self, (): &()) -> f32 {
            0.0
        }
    }

    #[test]
    fn rays_hit_what_is_nearest() {
        let mut positions =
            vec![[2.0, 0.0, 0.0], [4.0, 0.1, 0.0], [20.0, 8.0, 0.0], [f64::NAN; 3], [1.0, 0.0, 0.0]];
        let mut radii = vec![1.0, 1.0, 2.0, 1.0, f32::NAN];
        // Far from the rays.
        positions.extend((0..50).map(|index| [f64::from(index), 100.0, 3.0]));
        radii.extend([1.0; 50]);
        let balls = Balls { positions: positions.into(), radii: &radii, velocities: &[[1.0, 2.0, 3.0]] };
        let target = WithBalls::new(&Wall, balls, 0.5);
        let at = |y: f64| {
            let (t, is_front, local) =
                target.hit(&Ray::new(DVec3::new(0.0, y, 0.0), DVec3::X)).expect("a hit");
            (t, is_front, target.outward(&local), target.mean_curvature(&local), target.velocity(&local))
        };
        // In voxels, the first ball is at x = 4 with radius 2.
        assert_eq!(at(0.0), (2.0, true, Vec3::NEG_X, 0.5, Some([1.0, 2.0, 3.0])));
        assert_eq!(at(16.0), (5.0, true, Vec3::NEG_X, 0.0, None));
        let (t, _, outward, ..) = at(1.0);
        assert!((t - (4.0 - 3.0f64.sqrt())).abs() < 1e-12 && (outward.y - 0.5).abs() < 1e-6);
        // From the inside of a ball only the others are visible.
        let inside = target.hit(&Ray::new(DVec3::new(4.0, 0.0, 0.0), DVec3::X)).expect("a hit");
        assert!(matches!(inside.2, SurfaceOrBall::Surface(())));
    }
}
