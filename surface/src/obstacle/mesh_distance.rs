//! Signed distances of points to the triangles of a mesh without repairs, closed or open.
//!
//! ```text
//!        \ n₁  │ Σ  / n₂        q (●): the surface point nearest to the query point, here on an edge
//!         ╲    │   ╱            Σ: the sum of the normals at q, each weighted by the angle that its triangle
//!          ╲___●__╱             has around q. The query point is outside if it lies on the side of Σ
//!              q
//! ```
//!
//! For a closed mesh the distance is exact. Beyond the boundary of an open mesh, the triangles at the
//! boundary decide the sign.
//!
//! Jakob Andreas Bærentzen, Henrik Aanæs. Signed distance computation using the angle weighted pseudonormal.
//! 2005

use std::f64::consts::{PI, TAU};

use glam::DVec3;

use super::surface::{open_edge_count, valid_triangles};
use super::tree::TriangleTree;

/// A mesh that gives signed distances. Unlike in a [`MeshSdf`](super::MeshSdf), triangles keep their
/// orientation, which defines the outside.
pub struct MeshDistance {
    tree: TriangleTree,
    /// A point closer to an edge or a corner than this, world units, counts as on it.
    touch: f64,
    open_edge_count: usize,
}

/// Relative rounding error of a coordinate after a few operations, in units of the largest coordinate.
const ROUNDING: f64 = 1e-12;

impl MeshDistance {
    /// Uses the triangles with an area and finite corners, world units, counter-clockwise seen from outside.
    pub fn new(positions: &[[f64; 3]], triangles: &[[u32; 3]]) -> MeshDistance {
        let tree = TriangleTree::new(valid_triangles(positions, triangles));
        let farthest = tree.root().map_or(0.0, |node| node.min.abs().max(node.max.abs()).max_element());
        MeshDistance {
            tree,
            touch: ROUNDING * farthest,
            open_edge_count: open_edge_count(positions, triangles),
        }
    }

    /// The valid triangles, in an order that depends on the mesh only.
    pub fn triangles(&self) -> &[[DVec3; 3]] {
        self.tree.triangles()
    }

    /// Number of boundary edges of the mesh; vertices at the same position count as one.
    pub fn open_edge_count(&self) -> usize {
        self.open_edge_count
    }

    /// The lower and the upper corner of its bounding box, world units; `None` without triangles.
    pub fn bounds(&self) -> Option<[DVec3; 2]> {
        self.tree.root().map(|node| [node.min, node.max])
    }

    /// The signed distance of a finite point, world units: negative inside. `None` without triangles.
    pub fn distance(&self, point: DVec3) -> Option<f64> {
        let nearest = self.tree.nearest(point, f64::INFINITY)?;
        let distance = nearest.distance(point);
        let is_inside = self.normal_at(nearest).dot(point - nearest) < 0.0;
        Some(if is_inside { -distance } else { distance })
    }

    /// The angle-weighted sum of the normals of the triangles at a point on the surface.
    fn normal_at(&self, point: DVec3) -> DVec3 {
        let mut normal = DVec3::ZERO;
        self.tree.leaves_near(point, 0.0, self.touch, f64::INFINITY, |triangles| {
            for triangle in triangles {
                if let Some(angle) = self.angle_at(triangle, point) {
                    let [a, b, c] = triangle;
                    normal += (b - a).cross(c - a).normalize_or_zero() * angle;
                }
            }
        });
        normal
    }

    /// The angle that a triangle has around a point: that of a corner, π on an edge, 2π in its interior.
    /// `None` if the triangle does not touch the point.
    fn angle_at(&self, triangle: &[DVec3; 3], point: DVec3) -> Option<f64> {
        let is_near = |other: DVec3| other.distance_squared(point) <= self.touch * self.touch;
        if !is_near(super::tree::nearest_point(triangle, point)) {
            return None;
        }
        let [a, b, c] = *triangle;
        for [corner, left, right] in [[a, b, c], [b, c, a], [c, a, b]] {
            if is_near(corner) {
                return Some((left - corner).angle_between(right - corner));
            }
        }
        let is_on = |[from, to]: [DVec3; 2]| {
            let along = to - from;
            is_near(from + along * ((point - from).dot(along) / along.length_squared()).clamp(0.0, 1.0))
        };
        Some(if [[a, b], [b, c], [c, a]].into_iter().any(is_on) { PI } else { TAU })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A box with shared or separate corners.
    fn cuboid(least: DVec3, greatest: DVec3, is_shared: bool) -> (Vec<[f64; 3]>, Vec<[u32; 3]>) {
        let corner = |index: u32| {
            let pick = |axis: usize| if index >> axis & 1 == 0 { least[axis] } else { greatest[axis] };
            [pick(0), pick(1), pick(2)]
        };
        let quads = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]];
        let triangles = quads.iter().flat_map(|&[a, b, c, d]| [[a, b, c], [a, c, d]]);
        if is_shared {
            return ((0..8).map(corner).collect(), triangles.collect());
        }
        let positions: Vec<[f64; 3]> = triangles.flatten().map(corner).collect();
        let triangles =
            (0..positions.len() as u32 / 3).map(|index| [0, 1, 2].map(|c| 3 * index + c)).collect();
        (positions, triangles)
    }

    /// The exact signed distance to a box.
    fn exact(point: DVec3, least: DVec3, greatest: DVec3) -> f64 {
        let beyond = (least - point).max(point - greatest);
        beyond.max(DVec3::ZERO).length() + beyond.max_element().min(0.0)
    }

    #[test]
    fn distances_to_a_box_are_exact_also_far_from_the_origin() {
        for (shift, tolerance) in [(0.0, 1e-14), (1e5, 1e-10)] {
            let [least, greatest] =
                [DVec3::new(-1.0, 0.0, 2.0), DVec3::new(0.5, 0.25, 4.0)].map(|at| at + shift);
            for is_shared in [true, false] {
                let (positions, triangles) = cuboid(least, greatest, is_shared);
                let mesh = MeshDistance::new(&positions, &triangles);
                assert_eq!(mesh.open_edge_count(), 0);
                // On multiples of a quarter, many points lie straight off a corner, an edge or a face.
                for index in 0..17 * 13 * 19 {
                    let position =
                        [index % 17, index / 17 % 13, index / 221].map(|along| 0.25 * f64::from(along));
                    let point = DVec3::from(position) + DVec3::new(-2.0, -1.0, 1.0) + shift;
                    let (found, exact) =
                        (mesh.distance(point).expect("the box has triangles"), exact(point, least, greatest));
                    assert!((found - exact).abs() < tolerance, "{point}: {found} instead of {exact}");
                }
            }
        }
    }

    #[test]
    fn open_sheet_has_two_sides() {
        let positions = [[0.0; 3], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0]];
        let mesh = MeshDistance::new(&positions, &[[0, 1, 2], [0, 2, 3]]);
        assert_eq!(mesh.open_edge_count(), 4);
        for (z, x) in [(0.25, 0.5), (-0.25, 0.5), (0.25, 0.3), (-0.25, 0.3)] {
            assert_eq!(mesh.distance(DVec3::new(x, 0.5, z)), Some(z));
        }
        assert_eq!(MeshDistance::new(&positions, &[[0, 0, 1], [0, 1, 7]]).distance(DVec3::ZERO), None);
        assert_eq!(MeshDistance::new(&[], &[]).bounds(), None);
    }
}
