//! Triangles in batches, one per SIMD lane.

use glam::{DVec3, Vec3};

use super::{Mesh, Sums};

/// Number of triangles that are measured at once.
pub(crate) const LANES: usize = 16;

/// One value per triangle.
pub(crate) type TriangleScalar = [f64; LANES];

/// The corners of some triangles, by corner and by axis. Unused lanes are zero.
pub(crate) struct TriangleBatch {
    corners: [[[f32; LANES]; 3]; 3],
}

/// A triangle is degenerate if its height is below this fraction of its longest edge.
const HEIGHT_MIN: f64 = 1e-9;

impl TriangleBatch {
    /// The corners of up to [`LANES`] triangles.
    #[inline(always)]
    pub(crate) fn new(positions: &[Vec3], triangles: &[[u32; 3]]) -> TriangleBatch {
        let mut corners = [[[0.0; LANES]; 3]; 3];
        for (lane, triangle) in triangles.iter().enumerate().take(LANES) {
            for corner in 0..3 {
                let position = positions[triangle[corner] as usize];
                for axis in 0..3 {
                    corners[corner][axis][lane] = position[axis];
                }
            }
        }
        TriangleBatch { corners }
    }

    #[inline(always)]
    fn corner(&self, corner: usize, lane: usize) -> DVec3 {
        let [x, y, z] = &self.corners[corner];
        Vec3::new(x[lane], y[lane], z[lane]).as_dvec3()
    }

    /// The areas of the triangles.
    #[inline(always)]
    pub(crate) fn areas(&self) -> TriangleScalar {
        let mut areas = [0.0; LANES];
        for (lane, area) in areas.iter_mut().enumerate() {
            let [a, b, c] = [self.corner(0, lane), self.corner(1, lane), self.corner(2, lane)];
            *area = 0.5 * (b - a).cross(c - a).length();
        }
        areas
    }

    /// Six times the signed volumes of the tetrahedra between the triangles and the origin.
    #[inline(always)]
    fn products(&self) -> TriangleScalar {
        let mut products = [0.0; LANES];
        for (lane, product) in products.iter_mut().enumerate() {
            let [a, b, c] = [self.corner(0, lane), self.corner(1, lane), self.corner(2, lane)];
            *product = a.dot(b.cross(c));
        }
        products
    }

    /// 1 for each degenerate triangle, otherwise 0.
    #[inline(always)]
    pub(super) fn degenerate(&self) -> [u32; LANES] {
        let mut degenerate = [0; LANES];
        for (lane, degenerate) in degenerate.iter_mut().enumerate() {
            let [a, b, c] = [self.corner(0, lane), self.corner(1, lane), self.corner(2, lane)];
            let longest_squared = a.distance_squared(b).max(b.distance_squared(c)).max(c.distance_squared(a));
            let doubled_area = (b - a).cross(c - a).length();
            *degenerate = u32::from(doubled_area <= HEIGHT_MIN * longest_squared);
        }
        degenerate
    }
}

/// The sums over some of a mesh's triangles.
#[inline(always)]
pub(super) fn sum_triangles(mesh: &Mesh, triangles: &[[u32; 3]]) -> Sums {
    let mut sums = Sums::default();
    for triangles in triangles.chunks(LANES) {
        let batch = TriangleBatch::new(&mesh.positions, triangles);
        let (areas, products, degenerate) = (batch.areas(), batch.products(), batch.degenerate());
        for lane in 0..triangles.len() {
            sums.area += areas[lane];
            sums.volume += products[lane] / 6.0;
            sums.degenerate_triangle_count += degenerate[lane] as usize;
        }
    }
    sums
}
