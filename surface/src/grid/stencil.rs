//! A leaf and its surroundings, read row by row.
//!
//! ```text
//!   row (x, y): the 8 values along z.        y+1   ........
//!   A 7-point stencil needs five rows and     y   p cccccccc n     p, n: nearest values of the leaves at ±z
//!   two single values:                       y-1   ........        x±1: rows above and below the page
//! ```
//!
//! Where a neighboring leaf is not stored, the leaf's own last rows replace the missing rows, which gives a
//! slope of about zero. The narrow band is wide enough that no result depends on this slope.

use super::{Direction, Leaf, NO_LEAF, Row};
use crate::simd::Vector;

/// Rows in a leaf; row `x·8 + y` starts at value `row·8`.
pub const ROW_COUNT: usize = 64;

/// A leaf and the six leaves beyond its faces.
#[derive(Clone, Copy)]
pub struct Neighborhood<'a> {
    center: &'a Leaf,
    faces: [Option<&'a Leaf>; 6],
}

impl<'a> Neighborhood<'a> {
    /// The neighborhood of leaf `leaf` in a field.
    #[inline]
    pub fn new(leaves: &'a [Leaf], neighbors: &[[u32; 6]], leaf: usize) -> Neighborhood<'a> {
        let face = |index: u32| (index != NO_LEAF).then(|| &leaves[index as usize]);
        Neighborhood { center: &leaves[leaf], faces: neighbors[leaf].map(face) }
    }

    /// A leaf and the leaves beyond its faces, if they are stored.
    #[inline(always)]
    pub fn of(center: &'a Leaf, faces: [Option<&'a Leaf>; 6]) -> Neighborhood<'a> {
        Neighborhood { center, faces }
    }
}

/// The eight rows at one x of a leaf, with the rows and values around them.
///
/// A slab looks up the surroundings of eight rows at once and keeps the references in registers. The inner
/// loops of the smoother work on slabs. Parts that a loop does not use cost nothing.
#[derive(Clone, Copy)]
pub struct Slab<'a> {
    rows: &'a [Row; 8],
    /// The rows at x − 1, x + 1, x − 2 and x + 2.
    across_x: [&'a [Row; 8]; 4],
    /// The rows at the same x in the leaves before and after along y, if they are stored.
    beyond_y: [Option<&'a [Row; 8]>; 2],
    /// The rows at the same x in the leaves before and after along z, and the z of the values next to this
    /// leaf. If a leaf is not stored, the slab's own rows and their end.
    beyond_z: [(&'a [Row; 8], usize); 2],
}

/// A row, or each row of a vector, shifted along one axis by −1 and +1, or by −2 and +2.
type Shifted<V> = [V; 2];

impl<'a> Slab<'a> {
    /// Row `y` itself, and the rows after it if the vector has several.
    #[inline(always)]
    pub fn row<V: Vector>(&self, y: usize) -> V {
        V::load_at(self.rows, y)
    }

    /// The rows at x − 1 and x + 1.
    #[inline(always)]
    pub fn along_x<V: Vector>(&self, y: usize) -> Shifted<V> {
        [V::load_at(self.across_x[0], y), V::load_at(self.across_x[1], y)]
    }

    /// The rows at x − 2 and x + 2.
    #[inline(always)]
    pub fn second_along_x<V: Vector>(&self, y: usize) -> Shifted<V> {
        [V::load_at(self.across_x[2], y), V::load_at(self.across_x[3], y)]
    }

    /// The rows at y − 1 and y + 1.
    #[inline(always)]
    pub fn along_y<V: Vector>(&self, y: usize) -> Shifted<V> {
        // Only the first row can have its predecessor in another leaf, and only the last its successor.
        let before = |k: usize| if k == 0 { self.before_y(y) } else { &self.rows[(y + k - 1) & 7] };
        let after = |k: usize| {
            if k + 1 == V::ROWS { self.after_y(y + k) } else { &self.rows[(y + k + 1) & 7] }
        };
        [V::from_rows(before), V::from_rows(after)]
    }

    /// The rows at y − 2 and y + 2.
    #[inline(always)]
    pub fn second_along_y<V: Vector>(&self, y: usize) -> Shifted<V> {
        let y = y & 7;
        let before = if y >= 2 { Some(self.rows) } else { self.beyond_y[0] };
        let after = if y < 6 { Some(self.rows) } else { self.beyond_y[1] };
        let own = (self.rows, y);
        let (before, from) = before.map_or(own, |rows| (rows, (y + 6) & 7));
        let (after, to) = after.map_or(own, |rows| (rows, (y + 2) & 7));
        [V::load_at(before, from), V::load_at(after, to)]
    }

    /// The row before row `y`.
    #[inline(always)]
    fn before_y(&self, y: usize) -> &'a Row {
        let y = y & 7;
        let before = if y >= 1 { Some(self.rows) } else { self.beyond_y[0] };
        before.map_or(&self.rows[y], |rows| &rows[(y + 7) & 7])
    }

    /// The row after row `y`.
    #[inline(always)]
    fn after_y(&self, y: usize) -> &'a Row {
        let y = y & 7;
        let after = if y < 7 { Some(self.rows) } else { self.beyond_y[1] };
        after.map_or(&self.rows[y], |rows| &rows[(y + 1) & 7])
    }

    /// The values at z − 1 and z + 1.
    #[inline(always)]
    pub fn along_z<V: Vector>(&self, y: usize) -> Shifted<V> {
        let [(first, from), (last, to)] = self.beyond_z;
        let row = self.row::<V>(y);
        [
            row.shift_rows_up(|k| first[(y + k) & 7][from & 7]),
            row.shift_rows_down(|k| last[(y + k) & 7][to & 7]),
        ]
    }

    /// The values at z − 2 and z + 2, from those at z − 1 and z + 1.
    #[inline(always)]
    pub fn second_along_z<V: Vector>(&self, y: usize, [before, after]: Shifted<V>) -> Shifted<V> {
        let [(first, from), (last, to)] = self.beyond_z;
        // One voxel farther into the neighboring leaf; if that leaf is not stored, the row's own end.
        let (from, to) = (from.saturating_sub(1) & 7, (to + 1).min(7));
        [before.shift_rows_up(|k| first[(y + k) & 7][from]), after.shift_rows_down(|k| last[(y + k) & 7][to])]
    }

    /// The 7-point Laplacian of the vector at row `y`, voxel units.
    #[inline(always)]
    pub fn laplacian<V: Vector>(&self, y: usize) -> V {
        let [xm, xp] = self.along_x::<V>(y);
        let [ym, yp] = self.along_y::<V>(y);
        let [zm, zp] = self.along_z::<V>(y);
        let sum = xm.add(xp).add(ym.add(yp)).add(zm.add(zp));
        sum.sub(V::splat(6.0).mul(self.row(y)))
    }

    /// The norm of the gradient of the vector at row `y`, by central differences, voxel units.
    #[inline(always)]
    pub fn gradient_norm<V: Vector>(&self, y: usize) -> V {
        let ([xm, xp], [ym, yp], [zm, zp]) =
            (self.along_x::<V>(y), self.along_y::<V>(y), self.along_z::<V>(y));
        let (x, y, z) = (xp.sub(xm), yp.sub(ym), zp.sub(zm));
        V::splat(0.5).mul(x.mul(x).add(y.mul(y)).add(z.mul(z)).sqrt())
    }
}

impl<'a> Neighborhood<'a> {
    /// The slab at one x.
    #[inline(always)]
    pub fn slab(&self, x: usize) -> Slab<'a> {
        let x = x & 7;
        let rows = self.center.slab(x);
        let face = |direction: Direction| self.faces[direction as usize];
        let across = |step: usize| {
            let before = if x >= step { Some(self.center) } else { face(Direction::XMinus) };
            let after = if x + step < 8 { Some(self.center) } else { face(Direction::XPlus) };
            [
                before.map_or(rows, |leaf| leaf.slab(x + 8 - step)),
                after.map_or(rows, |leaf| leaf.slab(x + step)),
            ]
        };
        let ([xm, xp], [xm2, xp2]) = (across(1), across(2));
        Slab {
            rows,
            across_x: [xm, xp, xm2, xp2],
            beyond_y: [Direction::YMinus, Direction::YPlus]
                .map(|direction| face(direction).map(|leaf| leaf.slab(x))),
            beyond_z: [
                face(Direction::ZMinus).map_or((rows, 0), |leaf| (leaf.slab(x), 7)),
                face(Direction::ZPlus).map_or((rows, 7), |leaf| (leaf.slab(x), 0)),
            ],
        }
    }
}

/// The slabs with vectors that contain any of the given rows (bit `x·8 + y`). Each item is x and the y of the
/// first row of each vector.
#[inline(always)]
pub fn vectors_in<V: Vector>(rows: u64) -> impl Iterator<Item = (usize, SetBits)> {
    slabs_in(match V::ROWS {
        1 => rows,
        _ => (rows | rows >> 1) & 0x5555_5555_5555_5555,
    })
}

/// The slabs that contain any of the given rows (bit `x·8 + y`). Each item is x and the y of the slab's rows.
#[inline(always)]
pub fn slabs_in(rows: u64) -> impl Iterator<Item = (usize, SetBits)> {
    SlabsIn { rows, x: 0 }
}

/// Iterator of [`slabs_in`]. Written without iterator adapters, because a kernel is only compiled for wider
/// vectors if everything in it is inlined.
struct SlabsIn {
    rows: u64,
    x: usize,
}

impl Iterator for SlabsIn {
    type Item = (usize, SetBits);

    #[inline(always)]
    fn next(&mut self) -> Option<(usize, SetBits)> {
        while self.x < 8 {
            let (x, bits) = (self.x, (self.rows >> (8 * self.x)) as u8);
            self.x += 1;
            if bits != 0 {
                return Some((x, SetBits(bits)));
            }
        }
        None
    }
}

/// The set bits of a byte, in order.
#[derive(Clone, Copy, Debug)]
pub struct SetBits(pub u8);

impl Iterator for SetBits {
    type Item = usize;

    #[inline(always)]
    fn next(&mut self) -> Option<usize> {
        if self.0 == 0 {
            return None;
        }
        let bit = self.0.trailing_zeros() as usize;
        self.0 &= self.0 - 1;
        Some(bit)
    }
}

#[cfg(test)]
mod tests {
    use glam::IVec3;

    use super::*;
    use crate::grid::{Field, Topology, voxel_in_leaf};
    use crate::simd::{SimdLevel, WideKernel, dispatch_wide_at};

    fn quadratic(p: glam::Vec3) -> f32 {
        p.x * p.x + 2.0 * p.y * p.y - p.z * p.z + 3.0 * p.x + p.y * p.z
    }

    /// Differences of sampled quadratics are exact, also across leaf boundaries.
    #[test]
    fn stencils_are_exact_on_quadratics_across_leaves() {
        let mut origins = vec![IVec3::ZERO];
        origins.extend([IVec3::X, IVec3::Y, IVec3::Z].into_iter().flat_map(|axis| [axis * 8, axis * -8]));
        let topology = Topology::new(origins);
        let mut field = Field::splat(topology.len(), 0.0);
        for (leaf, origin) in field.leaves.iter_mut().zip(topology.origins()) {
            for (offset, value) in leaf.values.iter_mut().enumerate() {
                let p = (*origin + voxel_in_leaf(offset)).as_vec3();
                *value = quadratic(p);
            }
        }
        let center = topology.find(IVec3::ZERO).unwrap();
        let around = Neighborhood::new(&field.leaves, topology.neighbors(), center);
        for level in SimdLevel::ALL {
            let found = dispatch_wide_at(level, Stencils { around: &around });
            for (row, stencils) in found.into_iter().enumerate() {
                for z in 0..8 {
                    let p = voxel_in_leaf(row * 8 + z).as_vec3();
                    let step = |axis: usize, steps: f32| quadratic(p + glam::Vec3::AXES[axis] * steps);
                    let neighbors =
                        (0..3).flat_map(|axis| [-1.0, 1.0, -2.0, 2.0].map(|steps| step(axis, steps)));
                    let exact = glam::vec3(2.0 * p.x + 3.0, 4.0 * p.y + p.z, p.y - 2.0 * p.z).length();
                    let [laplacian, norm] = [stencils[0][z], stencils[1][z]];
                    assert_eq!(laplacian, 4.0);
                    assert!((norm - exact).abs() <= 1e-5 * exact, "{norm} {exact}");
                    assert!(stencils[2..].iter().map(|row| row[z]).eq(neighbors), "{level:?}, {p}");
                }
            }
        }
    }

    /// All stencils of every row: the Laplacian, the gradient norm, and the rows shifted along each axis by
    /// −1, 1, −2 and 2.
    struct Stencils<'a> {
        around: &'a Neighborhood<'a>,
    }

    impl WideKernel for Stencils<'_> {
        type Output = Vec<[Row; 14]>;

        #[inline(always)]
        fn run<V: Vector>(self) -> Vec<[Row; 14]> {
            let mut all = vec![[[0.0; 8]; 14]; ROW_COUNT];
            for (x, ys) in vectors_in::<V>(u64::MAX) {
                let slab = self.around.slab(x);
                for y in ys {
                    let [xs, y_rows, zs] = [slab.along_x::<V>(y), slab.along_y(y), slab.along_z(y)];
                    let [xs2, ys2, zs2] =
                        [slab.second_along_x(y), slab.second_along_y(y), slab.second_along_z(y, zs)];
                    let shifted = [xs, xs2, y_rows, ys2, zs, zs2].into_iter().flatten();
                    let stencils = [slab.laplacian::<V>(y), slab.gradient_norm(y)].into_iter().chain(shifted);
                    for (stencil, values) in stencils.enumerate() {
                        let mut rows = [[0.0; 8]; 8];
                        values.store_at(&mut rows, y);
                        for row in y..y + V::ROWS {
                            all[x * 8 + row][stencil] = rows[row];
                        }
                    }
                }
            }
            all
        }
    }
}
