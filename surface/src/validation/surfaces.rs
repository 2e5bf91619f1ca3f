//! Distances to the surfaces of particles with their own shapes.
//!
//! The nearest centre is not enough here: a long particle farther away may contain the point. So all
//! particles that reach a point are tested.

use glam::{DMat3, DVec3, Vec3};

use super::DistanceLimits;
use super::distances::{CELL_MARGIN, NearLeaves, PointGroup, from_particle, length_squared};
use crate::grid::SetBits;
use crate::particles::{Ellipsoid, Shapes};
use crate::rasterize::ParticleBins;
use crate::simd::Lanes;

/// Particles with their own shapes, and their extents.
pub(super) struct ShapedParticles<'a> {
    bins: &'a ParticleBins,
    /// The longest semi-axis in each leaf, in units of the radii.
    longest: Vec<f32>,
}

impl<'a> ShapedParticles<'a> {
    /// `None` if all particles have the same shape.
    pub(super) fn of(bins: &'a ParticleBins) -> Option<ShapedParticles<'a>> {
        if bins.shapes.is_uniform() {
            return None;
        }
        let longest =
            |leaf| bins.range(leaf).map(|index| bins.shapes.outer_radius(index)).fold(0.0, f32::max);
        Some(ShapedParticles { bins, longest: (0..bins.topology.len()).map(longest).collect() })
    }

    /// The longest semi-axis of all particles, in units of the radii.
    pub(super) fn longest(&self) -> f32 {
        self.longest.iter().copied().fold(0.0, f32::max)
    }

    /// Which of the points, relative to a leaf, are closer to the inner surface of a particle than the limits
    /// allow, and which are close enough to an outer one.
    #[inline(always)]
    pub(super) fn sides<V: Lanes>(
        &self,
        near: &NearLeaves,
        points: &PointGroup,
        limits: &DistanceLimits,
    ) -> Sides {
        let DistanceLimits { radii: [min, max], from_spheres: [from_min, from_max], .. } = *limits;
        // Distances beyond these do not matter.
        let beyond = [from_max, from_min.max(0.0)];
        let mut sides = Sides { inside_min_bits: 0, within_max_bits: 0 };
        for &(step, leaf) in &near.leaves {
            // Once all points are within the outer spheres, only the inner ones matter.
            let is_all_within = sides.within_max_bits == u8::MAX;
            let [radius, beyond_leaf] =
                if is_all_within { [min, beyond[1]] } else { [max, beyond[0].max(beyond[1])] };
            let reach = self.longest[leaf] * radius + beyond_leaf;
            if points.squared_gap(step) > reach * reach {
                continue;
            }
            let [x, y, z] = points.relative_to::<V>(step);
            for (index, particle) in self.bins.range(leaf).zip(self.bins.in_leaf(leaf)) {
                let longest = self.bins.shapes.outer_radius(index);
                let reaches = [longest * max + beyond[0], longest * min + beyond[1]];
                let [to_outer, to_inner] = reaches.map(|reach| V::splat(reach * reach));
                let apart = from_particle([x, y, z], *particle);
                let reach_squared = V::select(V::mask(sides.within_max_bits), to_inner, to_outer);
                let is_reached = V::not(reach_squared.lt(length_squared(apart)));
                if !V::any(is_reached) {
                    continue;
                }
                let [to_min, to_max] = distances_in_lanes(&self.bins.shapes, index, apart, [min, max]);
                // At most `from_max`. A distance that is NaN is not within.
                let is_within = to_max.lt(V::splat(from_max.next_up()));
                sides.within_max_bits |= V::bits(V::both(is_reached, is_within));
                let is_inside = V::both(is_reached, to_min.lt(V::splat(from_min)));
                for lane in SetBits(V::bits(is_inside) & !sides.inside_min_bits) {
                    let apart = points.point(lane) - step - *particle;
                    if is_nearer(&self.bins.shapes, index, apart, min, from_min) {
                        sides.inside_min_bits |= 1 << lane;
                    }
                }
            }
        }
        sides
    }
}

/// For each point, on which side of the inner and outer surfaces it is: bit k for point k.
pub(super) struct Sides {
    pub(super) inside_min_bits: u8,
    pub(super) within_max_bits: u8,
}

/// Whether the signed distance from a point, relative to a particle's centre, to the particle's surface is
/// less than `distance`, if the first-order distance is. Outside, and deep inside, the first-order distance is
/// not strict enough, so the exact one decides. Within half a voxel of the surface, where vertices are without
/// an offset, it is the stricter limit and decides alone; vertices can be moved to keep it.
#[cold]
fn is_nearer(shapes: &Shapes, index: usize, apart: Vec3, radius: f32, distance: f32) -> bool {
    let Shapes::Ellipsoids(ellipsoids) = shapes else { return true };
    let (ellipsoid, radius, apart) = (&ellipsoids[index], f64::from(radius), apart.as_dvec3());
    match distance {
        _ if distance > 0.0 => distance_to_ellipsoid(ellipsoid, radius, apart) < f64::from(distance),
        _ if distance < -CELL_MARGIN => depth_in_ellipsoid(ellipsoid, radius, apart) > f64::from(-distance),
        _ => true,
    }
}

/// The distance from a point, relative to the centre, to the surface |T y| = radius of an ellipsoid; 0
/// inside.
///
/// At the nearest point y, x − y is along the normal T²y: y = (1 + λT²)⁻¹ x, with the λ ≥ 0 that puts y on
/// the surface. |T y| decreases as λ grows.
fn distance_to_ellipsoid(ellipsoid: &Ellipsoid, radius: f64, x: DVec3) -> f64 {
    let to_unit_ball = matrix_of(ellipsoid);
    let squared = to_unit_ball * to_unit_ball;
    let point_at = |lambda: f64| (DMat3::IDENTITY + lambda * squared).inverse() * x;
    let is_beyond = |lambda: f64| (to_unit_ball * point_at(lambda)).length() > radius;
    if !is_beyond(0.0) {
        return 0.0;
    }
    let longest = f64::from(ellipsoid.longest);
    // Along the longest semi-axis T² is smallest, which gives the upper bound of λ.
    let (mut low, mut high) = (0.0, longest * x.length() / radius * longest);
    for _ in 0..BISECTIONS {
        let middle = 0.5 * (low + high);
        if is_beyond(middle) {
            low = middle;
        } else {
            high = middle;
        }
    }
    x.distance(point_at(high))
}

/// Number of bisections after which λ is known to a millionth of its upper bound.
const BISECTIONS: usize = 40;

/// The distance from a point inside an ellipsoid, relative to the centre, to the surface |T y| = radius.
///
/// The nearest point is y = (1 + λT²)⁻¹ x as outside, but with λ ≤ 0. |T y| grows as λ decreases, to infinity
/// where 1 + λT² becomes singular.
fn depth_in_ellipsoid(ellipsoid: &Ellipsoid, radius: f64, x: DVec3) -> f64 {
    let to_unit_ball = matrix_of(ellipsoid);
    let squared = to_unit_ball * to_unit_ball;
    // For a point on a plane of symmetry, such as the centre, |T y| would stay finite. Moving it by less than
    // the rounding error of a position avoids that.
    let x = x + DVec3::new(1.0, 0.7, 0.4) * INSIDE_STEP;
    let nearest_if_inside = |lambda: f64| {
        let matrix = DMat3::IDENTITY + lambda * squared;
        let y = is_positive_definite(&matrix).then(|| matrix.inverse() * x)?;
        ((to_unit_ball * y).length() <= radius).then_some(y)
    };
    // λ is greater than minus the square of the shortest semi-axis. Only the longest is stored, which is a safe limit.
    let longest = f64::from(ellipsoid.longest);
    let (mut low, mut high) = (-longest * longest, 0.0);
    let mut nearest = x;
    for _ in 0..INSIDE_BISECTIONS {
        let middle = 0.5 * (low + high);
        match nearest_if_inside(middle) {
            Some(y) => (high, nearest) = (middle, y),
            None => low = middle,
        }
    }
    x.distance(nearest)
}

/// In voxels.
const INSIDE_STEP: f64 = 1e-7;

/// After these, λ has all digits of a 64-bit number, which a point close to a plane of symmetry needs.
const INSIDE_BISECTIONS: usize = 70;

fn is_positive_definite(matrix: &DMat3) -> bool {
    let [x, y] = [matrix.x_axis, matrix.y_axis];
    x.x > 0.0 && x.x * y.y - x.y * y.x > 0.0 && matrix.determinant() > 0.0
}

/// The matrix T, which maps the ellipsoid of radius 1 to the unit ball.
fn matrix_of(ellipsoid: &Ellipsoid) -> DMat3 {
    let [xx, yy, zz, xy, xz, yz] = ellipsoid.to_unit_ball.map(f64::from);
    DMat3::from_cols(DVec3::new(xx, xy, xz), DVec3::new(xy, yy, yz), DVec3::new(xz, yz, zz))
}

/// The signed distances from a point, relative to the centre, to a particle's surfaces; for an ellipsoid to
/// first order.
#[inline(always)]
fn distances(shapes: &Shapes, index: usize, apart: Vec3, radii: [f32; 2]) -> [f32; 2] {
    match shapes {
        Shapes::Uniform => radii.map(|radius| apart.length() - radius),
        Shapes::Scaled(scales) => radii.map(|radius| apart.length() - scales[index] * radius),
        Shapes::Ellipsoids(ellipsoids) => {
            let ellipsoid = &ellipsoids[index];
            let on_ball = ellipsoid.apply(apart);
            let (q, slope) = (on_ball.length(), ellipsoid.apply(on_ball).length());
            // At the centre the direction is undefined: any direction will do.
            let scale = if slope > 0.0 { q / slope } else { ellipsoid.longest };
            radii.map(|radius| (q - radius) * scale)
        }
    }
}

/// The same distances for several points.
#[inline(always)]
fn distances_in_lanes<V: Lanes>(shapes: &Shapes, index: usize, apart: [V; 3], radii: [f32; 2]) -> [V; 2] {
    let to_ball = |scale: f32| {
        let to_center = length_squared(apart).sqrt();
        radii.map(|radius| to_center.sub(V::splat(scale * radius)))
    };
    match shapes {
        Shapes::Uniform => to_ball(1.0),
        Shapes::Scaled(scales) => to_ball(scales[index]),
        Shapes::Ellipsoids(ellipsoids) => {
            let ellipsoid = &ellipsoids[index];
            let on_ball = apply(ellipsoid, apart);
            let q = length_squared(on_ball).sqrt();
            let slope = length_squared(apply(ellipsoid, on_ball)).sqrt();
            // At the centre the direction is undefined: any direction will do.
            let scale = V::select(V::splat(0.0).lt(slope), q.div(slope), V::splat(ellipsoid.longest));
            radii.map(|radius| q.sub(V::splat(radius)).mul(scale))
        }
    }
}

/// T·v for several vectors.
#[inline(always)]
fn apply<V: Lanes>(ellipsoid: &Ellipsoid, [x, y, z]: [V; 3]) -> [V; 3] {
    let [xx, yy, zz, xy, xz, yz] = ellipsoid.to_unit_ball.map(V::splat);
    [
        xx.mul(x).add(xy.mul(y)).add(xz.mul(z)),
        xy.mul(x).add(yy.mul(y)).add(yz.mul(z)),
        xz.mul(x).add(yz.mul(y)).add(zz.mul(z)),
    ]
}

/// The same distances, and the direction in which they grow.
pub(super) fn distances_and_outward(
    shapes: &Shapes,
    index: usize,
    apart: Vec3,
    radii: [f32; 2],
) -> ([f32; 2], Vec3) {
    let steepest = match shapes {
        Shapes::Uniform | Shapes::Scaled(_) => apart,
        Shapes::Ellipsoids(ellipsoids) => ellipsoids[index].apply(ellipsoids[index].apply(apart)),
    };
    (distances(shapes, index, apart, radii), steepest.normalize_or(Vec3::X))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::simd::{Kernel, SimdLevel, dispatch_at};

    /// An ellipsoid, its radius, and many points on its surface.
    fn rotated_ellipsoid() -> (Ellipsoid, f32, Vec<DVec3>) {
        let axes = [Vec3::new(0.6, 0.8, 0.0), Vec3::new(-0.8, 0.6, 0.0), Vec3::Z];
        let (half_axes, radius) = ([4.0f32, 0.7, 1.3], 1.9f32);
        let on_surface = |u: usize, v: usize| {
            let (angle, height) =
                (u as f64 * std::f64::consts::TAU / 600.0, v as f64 * std::f64::consts::PI / 300.0);
            let ball = [height.sin() * angle.cos(), height.sin() * angle.sin(), height.cos()];
            let along =
                |axis: usize| axes[axis].as_dvec3() * f64::from(half_axes[axis] * radius) * ball[axis];
            along(0) + along(1) + along(2)
        };
        let points = (0..600).flat_map(|u| (0..=300).map(move |v| (u, v))).map(|(u, v)| on_surface(u, v));
        (Ellipsoid::new(half_axes, axes), radius, points.collect())
    }

    #[test]
    fn depth_in_an_ellipsoid_matches_its_nearest_point() {
        let (ellipsoid, radius, points) = rotated_ellipsoid();
        let shapes = Shapes::Ellipsoids(vec![ellipsoid]);
        for x in [
            DVec3::ZERO,
            DVec3::new(0.6, 0.8, 0.0),
            DVec3::new(-3.0, -4.0, 0.2),
            DVec3::new(-0.32, 0.24, 0.0),
            DVec3::new(1.0, 1.0, 0.5),
            DVec3::new(0.0, 0.1, 1.2),
        ] {
            let nearest = points.iter().map(|point| point.distance(x)).fold(f64::INFINITY, f64::min);
            let found = depth_in_ellipsoid(&ellipsoid, f64::from(radius), x);
            assert!((found - nearest).abs() < 2e-3, "{x}: {found} {nearest}");
            // The first-order depth is never smaller, and much larger beside the centre.
            let [first_order, _] = distances(&shapes, 0, x.as_vec3(), [radius; 2]);
            assert!(f64::from(-first_order) >= found - 1e-4, "{x}: {first_order} {found}");
            let is_nearer = |distance: f64| is_nearer(&shapes, 0, x.as_vec3(), radius, distance as f32);
            assert!(is_nearer(-0.99 * nearest) && !is_nearer(-1.01 * nearest - 2e-3), "{x}");
        }
    }

    /// Compares with the nearest of many points on the ellipsoid.
    #[test]
    fn distance_to_an_ellipsoid_matches_its_nearest_point() {
        let (ellipsoid, radius, points) = rotated_ellipsoid();
        let shapes = Shapes::Ellipsoids(vec![ellipsoid]);
        for x in [
            DVec3::new(9.0, 1.0, 2.0),
            DVec3::new(-3.0, -5.0, 4.0),
            DVec3::new(0.5, 0.1, 3.1),
            DVec3::new(4.6, 6.2, 0.3),
        ] {
            let nearest = points.iter().map(|point| point.distance(x)).fold(f64::INFINITY, f64::min);
            let found = distance_to_ellipsoid(&ellipsoid, f64::from(radius), x);
            assert!((found - nearest).abs() < 2e-3, "{x}: {found} {nearest}");
            // The first-order distance is never larger.
            let [first_order, _] = distances(&shapes, 0, x.as_vec3(), [radius; 2]);
            assert!(f64::from(first_order) <= found + 1e-4, "{x}: {first_order} {found}");
        }
        assert_eq!(distance_to_ellipsoid(&ellipsoid, f64::from(radius), DVec3::new(1.0, 1.0, 0.5)), 0.0);
    }

    /// Vertices are checked with distances in lanes, and moved according to single distances.
    #[test]
    fn distances_in_lanes_equal_single_distances() {
        struct InLanes<'a>(&'a Shapes, &'a [[f32; 8]; 3]);

        impl Kernel for InLanes<'_> {
            type Output = [[f32; 8]; 2];

            #[inline(always)]
            fn run<V: Lanes>(self) -> [[f32; 8]; 2] {
                let apart = [V::load(&self.1[0]), V::load(&self.1[1]), V::load(&self.1[2])];
                let mut rows = [[0.0; 8]; 2];
                let distances = distances_in_lanes(self.0, 0, apart, [1.7, 3.4]);
                distances.into_iter().zip(&mut rows).for_each(|(distances, row)| distances.store(row));
                rows
            }
        }

        let (ellipsoid, ..) = rotated_ellipsoid();
        let wave = |scale: f32| std::array::from_fn(|k| (k as f32 * scale).sin() * 3.1);
        let apart = [wave(0.7), wave(1.9), wave(2.3)];
        for shapes in [Shapes::Uniform, Shapes::Scaled(vec![0.8]), Shapes::Ellipsoids(vec![ellipsoid])] {
            for level in SimdLevel::ALL {
                let found = dispatch_at(level, InLanes(&shapes, &apart));
                for lane in 0..8 {
                    let apart = Vec3::new(apart[0][lane], apart[1][lane], apart[2][lane]);
                    let expected = distances(&shapes, 0, apart, [1.7, 3.4]).map(f32::to_bits);
                    assert_eq!(found.map(|row| row[lane].to_bits()), expected, "{shapes:?}, {level:?}");
                }
            }
        }
    }
}
