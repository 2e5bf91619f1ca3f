//! How far the surfaces of particles with shapes of their own are.
//!
//! The nearest centre tells nothing there: a long particle may be the one that holds a point. So every particle that
//! reaches a point is asked.

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

    /// Which of the points, given relative to a leaf, are deeper than `margin` in a particle's ball of the radius `min`,
    /// and which are within `margin` of one of `max`, or what takes the place of balls.
    #[inline(always)]
    pub(super) fn sides(
        &self,
        near: &NearLeaves,
        points: &[Column; 3],
        [min, max]: [f32; 2],
        margin: f32,
    ) -> Sides {
        let mut sides = Sides { is_inside_min: [false; LANES], is_within_max: [false; LANES] };
        for &(step, leaf) in &near.leaves {
            let mut locals = *points;
            for axis in 0..3 {
                for lane in 0..LANES {
                    locals[axis][lane] = points[axis][lane] - step[axis];
                }
            }
            // Once all points are within the outer spheres, what matters is who is in the inner ones.
            let is_all_within = sides.is_within_max == [true; LANES];
            let reach = self.longest[leaf] * if is_all_within { min } else { max } + margin;
            if super::distances::squared_gap(&locals) > reach * reach {
                continue;
            }
            let [x, y, z] = locals;
            for (index, particle) in self.bins.range(leaf).zip(self.bins.in_leaf(leaf)) {
                let longest = self.bins.shapes.longest(index);
                let reaches = [longest * max + margin, longest * min].map(|reach| reach * reach);
                for lane in 0..LANES {
                    let apart = Vec3::new(x[lane], y[lane], z[lane]) - *particle;
                    if apart.length_squared() > reaches[usize::from(sides.is_within_max[lane])] {
                        continue;
                    }
                    let [to_min, to_max] = distances(&self.bins.shapes, index, apart, [min, max]);
                    sides.is_inside_min[lane] |= to_min < -margin;
                    sides.is_within_max[lane] |= to_max <= margin;
                }
            }
        }
        sides
    }
}

/// On which sides of the surfaces points are.
pub(super) struct Sides {
    pub(super) is_inside_min: [bool; LANES],
    pub(super) is_within_max: [bool; LANES],
}

/// The signed distances to a particle's surfaces, of a point relative to its centre: of an ellipsoid to first order.
#[inline(always)]
fn distances(shapes: &Shapes, index: usize, apart: Vec3, radii: [f32; 2]) -> [f32; 2] {
    match shapes {
        Shapes::Balls => radii.map(|radius| apart.length() - radius),
        Shapes::Scaled(scales) => radii.map(|radius| apart.length() - scales[index] * radius),
        Shapes::Ellipsoids(ellipsoids) => {
            let ellipsoid = &ellipsoids[index];
            let on_ball = ellipsoid.apply(apart);
            let (q, slope) = (on_ball.length(), ellipsoid.apply(on_ball).length());
            // In the very centre any direction is as good.
            let scale = if slope > 0.0 { q / slope } else { ellipsoid.longest };
            radii.map(|radius| (q - radius) * scale)
        }
    }
}

/// The same, and the direction in which they grow.
pub(super) fn distances_and_outward(
    shapes: &Shapes,
    index: usize,
    apart: Vec3,
    radii: [f32; 2],
) -> ([f32; 2], Vec3) {
    let steepest = match shapes {
        Shapes::Balls | Shapes::Scaled(_) => apart,
        Shapes::Ellipsoids(ellipsoids) => ellipsoids[index].apply(ellipsoids[index].apply(apart)),
    };
    (distances(shapes, index, apart, radii), steepest.normalize_or(Vec3::X))
}
