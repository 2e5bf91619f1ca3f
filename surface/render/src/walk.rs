//! Traverses the cells of a cubic lattice along a ray.
//!
//! ```text
//!   ·──┬───┬───┬──      A ray leaves a cell through the nearest of three planes, one for each axis.
//!   ╲  │   │   │        Successive planes of an axis are a fixed step of t apart.
//!   ──╲┼───┼───┼──
//!      ╲   │   │
//! ```
//!
//! This work is based on:
//! John Amanatides and Andrew Woo. A fast voxel traversal algorithm for ray tracing. 1987

use glam::{DVec3, IVec3};

/// A ray in voxels, parametrized by its length t.
#[derive(Clone, Copy, Debug)]
pub(super) struct Ray {
    pub(super) origin: DVec3,
    /// Unit vector.
    pub(super) direction: DVec3,
    inverse: DVec3,
}

impl Ray {
    pub(super) fn new(origin: DVec3, direction: DVec3) -> Ray {
        Ray { origin, direction, inverse: direction.recip() }
    }

    pub(super) fn at(&self, t: f64) -> DVec3 {
        self.origin + self.direction * t
    }

    /// The interval of t, between `t_min` and `t_max`, in which the ray is inside a box, which may be flat.
    /// `None` if the ray misses the box or is not finite.
    pub(super) fn within(&self, least: DVec3, greatest: DVec3, [t_min, t_max]: [f64; 2]) -> Option<[f64; 2]> {
        if !(self.origin.is_finite() && self.direction.is_finite()) {
            return None;
        }
        let (mut first, mut last) = (t_min, t_max);
        for axis in 0..3 {
            let one = (least[axis] - self.origin[axis]) * self.inverse[axis];
            let other = (greatest[axis] - self.origin[axis]) * self.inverse[axis];
            if self.direction[axis] == 0.0 {
                let is_outside = self.origin[axis] < least[axis] || self.origin[axis] > greatest[axis];
                last = if is_outside { f64::NEG_INFINITY } else { last };
            } else {
                first = first.max(one.min(other));
                last = last.min(one.max(other));
            }
        }
        (first <= last).then_some([first, last])
    }
}

/// Iterates over the cells along a part of a ray, each with the interval of t in which the ray is in the
/// cell.
pub(super) struct Cells {
    cell: IVec3,
    step: IVec3,
    /// For each axis, the t at which the ray reaches the next plane.
    exits: DVec3,
    /// For each axis, the step of t between successive planes.
    strides: DVec3,
    t: f64,
    last: f64,
    least: IVec3,
    greatest: IVec3,
}

impl Cells {
    /// Cells of this edge, in voxels, from the first t to the last. Leaves out cells outside of `least` to
    /// `greatest`, which only rounding can produce.
    pub(super) fn along(
        ray: &Ray,
        edge: f64,
        [first, last]: [f64; 2],
        [least, greatest]: [IVec3; 2],
    ) -> Cells {
        let at = ray.at(first) / edge;
        let cell = at.floor().as_ivec3().clamp(least, greatest);
        let (mut step, mut exits, mut strides) = (IVec3::ZERO, DVec3::INFINITY, DVec3::INFINITY);
        for axis in 0..3 {
            let along = ray.direction[axis];
            if along != 0.0 {
                let is_up = along > 0.0;
                let plane = f64::from(cell[axis] + i32::from(is_up)) * edge;
                step[axis] = if is_up { 1 } else { -1 };
                exits[axis] = (plane - ray.origin[axis]) * ray.inverse[axis];
                strides[axis] = edge * ray.inverse[axis].abs();
            }
        }
        Cells { cell, step, exits, strides, t: first, last, least, greatest }
    }
}

impl Iterator for Cells {
    type Item = (IVec3, [f64; 2]);

    fn next(&mut self) -> Option<(IVec3, [f64; 2])> {
        let is_in = self.cell.cmpge(self.least).all() && self.cell.cmple(self.greatest).all();
        if self.t >= self.last || !is_in {
            return None;
        }
        let (cell, first) = (self.cell, self.t);
        let axis = self.exits.min_position();
        self.t = self.exits[axis].clamp(first, self.last);
        self.cell[axis] += self.step[axis];
        self.exits[axis] += self.strides[axis];
        Some((cell, [first, self.t]))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cells_cover_the_ray_without_gaps() {
        let everywhere = [IVec3::MIN, IVec3::MAX];
        for direction in
            [DVec3::X, DVec3::new(-1.0, 2.0, 0.3), DVec3::new(1.0, 1.0, 1.0), DVec3::new(0.0, -1.0, 1e-9)]
        {
            let ray = Ray::new(DVec3::new(0.3, -7.9, 2.2), direction.normalize());
            let mut t = 1.5;
            for (cell, [first, last]) in Cells::along(&ray, 4.0, [1.5, 60.0], everywhere) {
                assert_eq!(first, t, "no gap");
                let middle = ray.at((first + last) / 2.0) / 4.0;
                let inside = (middle - cell.as_dvec3()).clamp(DVec3::splat(-1e-9), DVec3::splat(1.0 + 1e-9));
                assert_eq!(inside, middle - cell.as_dvec3(), "{direction}");
                t = last;
            }
            assert_eq!(t, 60.0);
        }
    }

    #[test]
    fn rays_intersect_boxes() {
        let ray = Ray::new(DVec3::ZERO, DVec3::X);
        assert_eq!(ray.within(DVec3::new(2.0, -1.0, -1.0), DVec3::splat(3.0), [0.0, 9.0]), Some([2.0, 3.0]));
        assert_eq!(ray.within(DVec3::new(2.0, 1.0, -1.0), DVec3::splat(3.0), [0.0, 9.0]), None);
        assert_eq!(ray.within(DVec3::NEG_ONE, DVec3::ONE, [0.0, 9.0]), Some([0.0, 1.0]));
        let flat = DVec3::new(0.0, 1.0, 1.0);
        assert_eq!(ray.within(DVec3::X - flat, DVec3::X + flat, [0.0, 9.0]), Some([1.0, 1.0]));
    }

    #[test]
    fn non_finite_ray_intersects_nothing() {
        for origin in [DVec3::NAN, DVec3::INFINITY] {
            let ray = Ray::new(origin, DVec3::X);
            assert_eq!(ray.within(DVec3::NEG_ONE, DVec3::ONE, [0.0, 9.0]), None);
        }
    }
}
