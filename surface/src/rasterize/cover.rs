//! Finds the voxels that certainly have a particle within a given radius, from [`Octants`].
//!
//! ```text
//!            r
//!       ╭─────────╮         An octant covers a voxel v if the octant's farthest corner is within r of v.
//!     ╭─┼─┐     ┌─┼─╮       Octants a steps from v in x and b steps in y (1: adjacent to v) cover v if they
//!     │ └─┼──v──┼─┘ │       are at most m(a, b) steps away along z, in either direction:
//!     ╰───┴─────┴───╯       a² + b² + m² < (2r)²
//! ```
//!
//! So a row of voxels is computed from rows of octants, each dilated along z by its m. That takes a few dozen
//! word operations per row, however many particles there are.

use crate::grid::LeafMask;
use crate::simd::{Kernel, Lanes};

use super::occupancy::Octants;

/// Maximum number of octants visited to each side of a voxel. A larger radius is reduced to fit. The result
/// is then conservative: fewer voxels are covered, none wrongly.
const REACH: usize = 8;

/// The radius is reduced by this much, in voxels, so that rounding cannot matter.
const ROUNDING: f32 = 1e-3;

/// The octants within a radius of a voxel.
pub(super) struct OctantBall {
    /// Entry m − 1 has the rows of octants that cover a voxel up to m steps along z, as steps in x and y from
    /// the voxel's own octant.
    rows_of_width: Vec<Vec<[i32; 2]>>,
}

impl OctantBall {
    /// The octants within `radius` voxels.
    pub(super) fn new(radius: f32) -> OctantBall {
        let limit = (2.0 * (radius - ROUNDING)).max(0.0).powi(2);
        let width = |x: i32, y: i32| {
            let lateral = [x, y].map(|along| if along < 0 { -along } else { along + 1 } as f32);
            let across = lateral[0] * lateral[0] + lateral[1] * lateral[1];
            (1..=REACH).take_while(|&m| across + (m * m) as f32 <= limit).count()
        };
        let mut rows_of_width = vec![Vec::new(); REACH];
        let axis = || -(REACH as i32)..REACH as i32;
        for (x, y) in axis().flat_map(|x| axis().map(move |y| (x, y))) {
            if let Some(rows) = width(x, y).checked_sub(1).map(|width| &mut rows_of_width[width]) {
                rows.push([x, y]);
            }
        }
        let width_count = rows_of_width.iter().rposition(|rows| !rows.is_empty()).map_or(0, |last| last + 1);
        rows_of_width.truncate(width_count);
        OctantBall { rows_of_width }
    }

    /// True if no octant lies entirely within the radius of a voxel.
    pub(super) fn is_empty(&self) -> bool {
        self.rows_of_width.is_empty()
    }
}

/// Kernel: the voxels of a leaf that certainly have a particle within each of these radii.
pub(super) struct Cover<'a, const BALLS: usize> {
    /// The leaf and its 26 neighbors; the one at step (x, y, z) is at index (x + 1)·9 + (y + 1)·3 + z + 1.
    pub(super) around: [&'a Octants; 27],
    pub(super) balls: [&'a OctantBall; BALLS],
}

/// Rows of octants along z, of the leaf and eight more on each side: bit 8 is the leaf's first octant. Row
/// (x, y) is at `[x + 8][(y + 8) % 2][(y + 8) / 2]`, so that rows with the same parity of y are contiguous.
type OctantRows = [[[u32; 16]; 2]; 32];

impl<const BALLS: usize> Kernel for Cover<'_, BALLS> {
    type Output = [LeafMask; BALLS];

    #[inline(always)]
    fn run<V: Lanes>(self) -> [LeafMask; BALLS] {
        let mut rows = self.gather();
        let mut found = [[[0u32; 8]; 8]; BALLS];
        for width in 0..REACH {
            // Start with the two octants of each voxel; every step dilates by one octant to each side.
            for row in rows.as_flattened_mut().as_flattened_mut() {
                *row |= if width == 0 { *row << 1 } else { *row << 1 | *row >> 1 };
            }
            for (found, ball) in found.iter_mut().zip(self.balls) {
                for &[x_step, y_step] in ball.rows_of_width.get(width).into_iter().flatten() {
                    let (x_step, y_step) = ((x_step + 8) as usize, (y_step + 8) as usize);
                    for (x, found) in found.iter_mut().enumerate() {
                        let from = &rows[2 * x + x_step][y_step & 1][y_step >> 1..][..8];
                        for (found, &row) in found.iter_mut().zip(from) {
                            *found |= row;
                        }
                    }
                }
            }
            if self.balls.iter().all(|ball| ball.rows_of_width.len() <= width + 1) {
                break;
            }
        }
        found.map(voxels_of)
    }
}

impl<const BALLS: usize> Cover<'_, BALLS> {
    #[inline(always)]
    fn gather(&self) -> OctantRows {
        let mut rows = [[[0; 16]; 2]; 32];
        for (x, rows) in rows.iter_mut().enumerate() {
            for y in 0..32 {
                let leaf = ((x + 8) >> 4) * 9 + ((y + 8) >> 4) * 3;
                let row = ((x + 8) & 15) * 16 + ((y + 8) & 15);
                let [before, own, after] = [0, 1, 2].map(|z| u32::from(self.around[leaf + z].rows[row]));
                rows[y & 1][y >> 1] = before >> 8 | own << 8 | after << 24;
            }
        }
        rows
    }
}

/// The voxels for which the bit of the first of their two octants along z is set.
#[inline(always)]
fn voxels_of(found: [[u32; 8]; 8]) -> LeafMask {
    let mut mask = LeafMask::EMPTY;
    for (word, rows) in mask.words.iter_mut().zip(found) {
        for (y, row) in rows.into_iter().enumerate() {
            // Compact every second bit.
            let mut bits = row >> 8 & 0x5555;
            bits = (bits | bits >> 1) & 0x3333;
            bits = (bits | bits >> 2) & 0x0f0f;
            bits = (bits | bits >> 4) & 0x00ff;
            *word |= u64::from(bits) << (8 * y);
        }
    }
    mask
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::grid::voxel_in_leaf;
    use crate::simd::{SimdLevel, dispatch_at};
    use glam::{IVec3, Vec3};

    /// All octants around a leaf as one list, relative to its origin.
    fn octants(around: &[Octants; 27]) -> Vec<IVec3> {
        let mut all = Vec::new();
        for (leaf, octants) in around.iter().enumerate() {
            let step = IVec3::new(leaf as i32 / 9, leaf as i32 / 3 % 3, leaf as i32 % 3) - 1;
            for (row, bits) in octants.rows.into_iter().enumerate() {
                let set = (0..16).filter(|z| bits >> z & 1 == 1);
                all.extend(set.map(|z| step * 16 + IVec3::new(row as i32 / 16, row as i32 % 16, z)));
            }
        }
        all
    }

    #[test]
    fn octants_with_near_farthest_corner_cover_voxels() {
        let mut state = 1u32;
        let mut random = || {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            state >> 8
        };
        for (sparse, radius) in [(5, 0.5), (5, 1.0), (20, 1.732), (200, 2.598), (1500, 3.7), (1500, 60.0)] {
            let around: [Octants; 27] = std::array::from_fn(|_| {
                let mut octants = Octants::EMPTY;
                for index in (0..4096).filter(|_| random() % sparse == 0) {
                    octants.rows[index / 16] |= 1 << (index % 16);
                }
                octants
            });
            let all = octants(&around);
            // The octants within the search range, and their farthest corners.
            let far = |voxel: IVec3, octant: IVec3| {
                let corner = octant - 2 * voxel;
                let lateral = corner.abs().max((corner + 1).abs());
                (lateral.max_element() <= REACH as i32).then(|| 0.5 * lateral.as_vec3().length())
            };
            let nearest =
                |voxel: IVec3| all.iter().filter_map(|&octant| far(voxel, octant)).fold(99.0, f32::min);
            let expected = LeafMask::from_fn(|offset| nearest(voxel_in_leaf(offset)) < radius - ROUNDING);
            let balls = [OctantBall::new(radius), OctantBall::new(0.0)];
            for level in SimdLevel::ALL {
                let cover = Cover { around: around.each_ref(), balls: balls.each_ref() };
                assert_eq!(dispatch_at(level, cover), [expected, LeafMask::EMPTY], "{radius}, {level:?}");
            }
            assert_eq!(expected != LeafMask::EMPTY, radius >= 1.0, "{radius}");
        }
    }

    /// A particle anywhere in its octant is within the radius of every covered voxel.
    #[test]
    fn covered_voxels_have_a_particle_within_the_radius() {
        let mut around: [Octants; 27] = std::array::from_fn(|_| Octants::EMPTY);
        around[13].rows[9 * 16 + 6] = 1 << 3;
        let balls = [OctantBall::new(2.598)];
        let [covered] =
            dispatch_at(SimdLevel::Baseline, Cover { around: around.each_ref(), balls: balls.each_ref() });
        assert!(covered.count() > 40);
        for voxel in covered.iter().map(|offset| voxel_in_leaf(offset).as_vec3()) {
            for corner in [Vec3::new(4.5, 3.0, 1.5), Vec3::new(5.0, 3.5, 2.0), Vec3::new(4.5, 3.5, 1.5)] {
                assert!(voxel.distance(corner) < 2.598);
            }
        }
    }
}
