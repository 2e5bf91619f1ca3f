//! How far the surfaces of particles with shapes of their own are.
//!
//! The nearest centre tells nothing there: a long particle may be the one that holds a point. So every particle that
//! reaches a point is asked, and the least of the distances to their surfaces is that to the union.

use glam::Vec3;

use super::distances::{Column, LANES, NearLeaves};
use crate::particles::Shapes;
use crate::rasterize::ParticleBins;

/// Particles with shapes of their own, and how far they reach.
pub(super) struct Bodies<'a> {
    bins: &'a ParticleBins,
    /// The longest half axis in each leaf, in units of the radii.
    longest: Vec<f32>,
}

impl<'a> Bodies<'a> {
    /// `None` where all particles are alike.
    pub(super) fn of(bins: &'a ParticleBins) -> Option<Bodies<'a>> {
        if bins.shapes.are_balls() {
            return None;
        }
        let longest = |leaf| bins.range(leaf).map(|index| bins.shapes.longest(index)).fold(0.0, f32::max);
        Some(Bodies { bins, longest: (0..bins.topology.len()).map(longest).collect() })
    }

    /// The longest half axis of all, in units of the radii.
    pub(super) fn longest(&self) -> f32 {
        self.longest.iter().copied().fold(0.0, f32::max)
    }

    /// The signed distances from points, given relative to a leaf, to the unions of the particles around it with
    /// these radii, of which the first is the largest. Infinite where no particle is within `margin` of a point.
    #[inline(always)]
    pub(super) fn distances<const N: usize>(
        &self,
        near: &NearLeaves,
        points: &[Column; 3],
        radii: [f32; N],
        margin: f32,
    ) -> [Column; N] {
        let mut least = [[f32::INFINITY; LANES]; N];
        for &(step, leaf) in &near.leaves {
            let mut locals = *points;
            for axis in 0..3 {
                for lane in 0..LANES {
                    locals[axis][lane] = points[axis][lane] - step[axis];
                }
            }
            let reach = self.longest[leaf] * radii[0] + margin;
            if super::distances::squared_gap(&locals) > reach * reach {
                continue;
            }
            let [x, y, z] = locals;
            for (index, particle) in self.bins.range(leaf).zip(self.bins.in_leaf(leaf)) {
                let reach = self.bins.shapes.longest(index) * radii[0] + margin;
                for lane in 0..LANES {
                    let apart = Vec3::new(x[lane], y[lane], z[lane]) - *particle;
                    if apart.length_squared() > reach * reach {
                        continue;
                    }
                    for (least, radius) in least.iter_mut().zip(radii) {
                        let distance = distance(&self.bins.shapes, index, apart, radius);
                        least[lane] = if distance < least[lane] { distance } else { least[lane] };
                    }
                }
            }
        }
        least
    }
}

/// The signed distance to a particle's surface, of a point relative to its centre: of an ellipsoid to first order.
#[inline(always)]
fn distance(shapes: &Shapes, index: usize, apart: Vec3, radius: f32) -> f32 {
    match shapes {
        Shapes::Balls => apart.length() - radius,
        Shapes::Scaled(scales) => apart.length() - scales[index] * radius,
        Shapes::Ellipsoids(ellipsoids) => {
            let ellipsoid = &ellipsoids[index];
            let on_ball = ellipsoid.apply(apart);
            let (q, slope) = (on_ball.length(), ellipsoid.apply(on_ball).length());
            // In the very centre any direction is as good.
            let scale = if slope > 0.0 { q / slope } else { ellipsoid.longest };
            (q - radius) * scale
        }
    }
}
