//! A leaf with its surroundings, read row by row.
//!
//! ```text
//!   row (x, y): the 8 values along z.        y+1   ........
//!   A 7-point stencil needs five rows and     y   p cccccccc n     p, n: ends of the rows beyond ±z
//!   two single values:                       y-1   ........        x±1: rows above and below the page
//! ```
//!
//! Where the neighbouring leaf is not stored, the leaf's own last row stands in for it: a slope of
//! zero. The narrow band is wide enough that no result depends on it.

use super::leaf::{Leaf, Row};
use super::topology::{Direction, NO_LEAF};

/// Rows in a leaf; row `x·8 + y` starts at value `row·8`.
pub const ROW_COUNT: usize = 64;

/// One leaf and the six leaves beyond its faces.
#[derive(Clone, Copy)]
pub struct Neighborhood<'a> {
    center: &'a Leaf,
    faces: [Option<&'a Leaf>; 6],
}

impl<'a> Neighborhood<'a> {
    /// The surroundings of leaf `leaf` in a field.
    #[inline]
    pub fn new(leaves: &'a [Leaf], neighbors: &[[u32; 6]], leaf: usize) -> Neighborhood<'a> {
        let face = |index: u32| (index != NO_LEAF).then(|| &leaves[index as usize]);
        Neighborhood { center: &leaves[leaf], faces: neighbors[leaf].map(face) }
    }

    /// The row itself.
    #[inline]
    pub fn row(&self, row: usize) -> &'a Row {
        self.center.row(row)
    }

    /// The rows at x − 1, x + 1, y − 1 and y + 1.
    #[inline]
    pub fn side_rows(&self, row: usize) -> [&'a Row; 4] {
        self.rows_across::<1>(row)
    }

    /// The rows at x − 2, x + 2, y − 2 and y + 2.
    #[inline]
    pub fn second_side_rows(&self, row: usize) -> [&'a Row; 4] {
        self.rows_across::<2>(row)
    }

    /// The rows `STEP` voxels away across x and y. A step in x is 8 rows, and a leaf has 64.
    #[inline]
    fn rows_across<const STEP: usize>(&self, row: usize) -> [&'a Row; 4] {
        let (x, y) = (row >> 3, row & 7);
        let beyond = |direction: Direction, wrapped: usize| match self.faces[direction as usize] {
            Some(leaf) => leaf.row(wrapped),
            None => self.center.row(row),
        };
        let (low, high) = (STEP, 8 - STEP);
        [
            if x >= low { self.row(row - 8 * STEP) } else { beyond(Direction::XMinus, row + 8 * high) },
            if x < high { self.row(row + 8 * STEP) } else { beyond(Direction::XPlus, row - 8 * high) },
            if y >= low { self.row(row - STEP) } else { beyond(Direction::YMinus, row + high) },
            if y < high { self.row(row + STEP) } else { beyond(Direction::YPlus, row - high) },
        ]
    }

    /// The row shifted so that each place holds its neighbour at z − 1, and the same for z + 1.
    #[inline]
    pub fn shifted_rows(&self, row: usize) -> [Row; 2] {
        let c = self.row(row);
        let before = self.faces[Direction::ZMinus as usize].map_or(c[0], |leaf| leaf.row(row)[7]);
        let after = self.faces[Direction::ZPlus as usize].map_or(c[7], |leaf| leaf.row(row)[0]);
        [
            [before, c[0], c[1], c[2], c[3], c[4], c[5], c[6]],
            [c[1], c[2], c[3], c[4], c[5], c[6], c[7], after],
        ]
    }

    /// The row shifted so that each place holds its neighbour at z − 2, and the same for z + 2.
    #[inline]
    pub fn twice_shifted_rows(&self, row: usize) -> [Row; 2] {
        let c = self.row(row);
        let before = self.faces[Direction::ZMinus as usize].map_or([c[0], c[1]], |leaf| {
            let row = leaf.row(row);
            [row[6], row[7]]
        });
        let after = self.faces[Direction::ZPlus as usize].map_or([c[6], c[7]], |leaf| {
            let row = leaf.row(row);
            [row[0], row[1]]
        });
        [
            [before[0], before[1], c[0], c[1], c[2], c[3], c[4], c[5]],
            [c[2], c[3], c[4], c[5], c[6], c[7], after[0], after[1]],
        ]
    }

    /// The 7-point Laplacian of a row, voxel units.
    #[inline]
    pub fn laplacian(&self, row: usize) -> Row {
        let c = self.row(row);
        let [xm, xp, ym, yp] = self.side_rows(row);
        let [zm, zp] = self.shifted_rows(row);
        std::array::from_fn(|z| ((xm[z] + xp[z]) + (ym[z] + yp[z]) + (zm[z] + zp[z])) - 6.0 * c[z])
    }

    /// |∇| of a row by central differences, voxel units.
    #[inline]
    pub fn gradient_norm(&self, row: usize) -> Row {
        let [xm, xp, ym, yp] = self.side_rows(row);
        let [zm, zp] = self.shifted_rows(row);
        std::array::from_fn(|z| {
            let (x, y, z) = (xp[z] - xm[z], yp[z] - ym[z], zp[z] - zm[z]);
            0.5 * (x * x + y * y + z * z).sqrt()
        })
    }
}

#[cfg(test)]
mod tests {
    use super::super::{Field, Topology, voxel_in_leaf};
    use super::*;
    use glam::IVec3;

    /// Sampled polynomials have exact differences, across leaf borders too.
    #[test]
    fn stencils_are_exact_on_quadratics_across_leaves() {
        let mut origins = vec![IVec3::ZERO];
        origins.extend([IVec3::X, IVec3::Y, IVec3::Z].into_iter().flat_map(|axis| [axis * 8, axis * -8]));
        let topology = Topology::new(origins);
        let mut field = Field::splat(topology.len(), 0.0);
        for (leaf, origin) in field.leaves.iter_mut().zip(topology.origins()) {
            for (offset, value) in leaf.values.iter_mut().enumerate() {
                let p = (*origin + voxel_in_leaf(offset)).as_vec3();
                *value = p.x * p.x + 2.0 * p.y * p.y - p.z * p.z + 3.0 * p.x + p.y * p.z;
            }
        }
        let center = topology.find(IVec3::ZERO).unwrap();
        let around = Neighborhood::new(&field.leaves, topology.neighbors(), center);
        for row in 0..ROW_COUNT {
            assert_eq!(around.laplacian(row), [4.0; 8]);
            let quadratic = |p: glam::Vec3| p.x * p.x + 2.0 * p.y * p.y - p.z * p.z + 3.0 * p.x + p.y * p.z;
            let [xm, xp, ym, yp] = around.second_side_rows(row);
            let [zm, zp] = around.twice_shifted_rows(row);
            for z in 0..8 {
                let p = voxel_in_leaf(row * 8 + z).as_vec3();
                let steps = [glam::Vec3::X, glam::Vec3::Y, glam::Vec3::Z].map(|axis| axis * 2.0);
                assert_eq!([xm[z], ym[z], zm[z]], steps.map(|step| quadratic(p - step)));
                assert_eq!([xp[z], yp[z], zp[z]], steps.map(|step| quadratic(p + step)));
            }
            for (z, norm) in around.gradient_norm(row).into_iter().enumerate() {
                let p = voxel_in_leaf(row * 8 + z).as_vec3();
                let exact = glam::vec3(2.0 * p.x + 3.0, 4.0 * p.y + p.z, p.y - 2.0 * p.z).length();
                assert!((norm - exact).abs() <= 1e-5 * exact, "{norm} {exact}");
            }
        }
    }
}
