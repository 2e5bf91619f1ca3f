//! What one leaf sees of itself and of the leaves around it.
//!
//! Contouring works leaf by leaf, and the cells of a leaf reach over its far faces; the stencils at
//! their corners, and the cells that share an edge with them, reach over the near ones too. So each
//! leaf first finds its 26 neighbours, once, and copies what it needs of them:
//!
//! ```text
//!    voxel      −1 │ 0  1  2  3  4  5  6  7 │ 8   9
//!    SignRows    • │ •  •  •  •  •  •  •  • │ •         one bit a voxel, 10 rows of 10 rows of 10 bits
//!    Block       • │ •  •  •  •  •  •  •  • │ •   •     φ, 11 × 11 × 11
//!    cells     └─┴─┴──┴──┴──┴──┴──┴──┴──┴───┘           cell −1 belongs to the leaf before
//! ```
//!
//! A row of sign bits answers for ten voxels at once which cells and edges the surface crosses, so
//! leaves and rows away from the surface cost next to nothing.
//!
//! A cell is *complete* where all its 8 corners are stored. The rest have no surface, whatever the
//! stored corners say: beyond the leaves φ is not known.

use glam::{IVec3, Vec3};
use rayon::prelude::*;

use crate::grid::{Field, LEAF_EDGE, Leaf, LeafMask, NO_LEAF, Topology};

/// A leaf and the 26 around it: indices, or [`NO_LEAF`].
#[derive(Clone, Copy, Debug)]
pub(super) struct Neighborhood {
    leaves: [u32; 27],
}

impl Neighborhood {
    /// The neighbourhood of a leaf.
    pub(super) fn new(topology: &Topology, leaf: usize) -> Neighborhood {
        let origin = topology.origins()[leaf];
        let leaves = std::array::from_fn(|slot| {
            let step = IVec3::new(slot as i32 / 9, slot as i32 / 3 % 3, slot as i32 % 3) - IVec3::ONE;
            topology.find(origin + step * LEAF_EDGE).map_or(NO_LEAF, |index| index as u32)
        });
        Neighborhood { leaves }
    }

    /// The leaf one `step` (−1, 0 or 1 on each axis) away.
    pub(super) fn leaf(&self, step: IVec3) -> u32 {
        let slot = step + IVec3::ONE;
        self.leaves[(slot.x * 9 + slot.y * 3 + slot.z) as usize]
    }

    /// The leaf itself and the 26 around it.
    pub(super) fn leaves(&self) -> &[u32; 27] {
        &self.leaves
    }

    /// The nine columns of three leaves along z: for each the rows of a halo from voxel −1 on that it
    /// covers, and its leaves. `halo` is how many voxels of the leaves after are in it.
    fn columns(&self, halo: usize) -> impl Iterator<Item = ([Span; 2], [u32; 3])> + '_ {
        let spans = [
            Span { start: 0, count: 1, first_voxel: 7 },
            Span { start: 1, count: 8, first_voxel: 0 },
            Span { start: 9, count: halo, first_voxel: 0 },
        ];
        (0..9).map(move |column| {
            let leaves = [0, 1, 2].map(|z| self.leaves[column * 3 + z]);
            ([spans[column / 3], spans[column % 3]], leaves)
        })
    }
}

/// A stretch of a halo along one axis that lies in one leaf.
#[derive(Clone, Copy)]
struct Span {
    /// Its first place in the halo.
    start: usize,
    /// How many places it has.
    count: usize,
    /// Its first place in the leaf.
    first_voxel: usize,
}

/// For each row of a column: its place in the halo along x and y, and in the leaf as `8x + y`.
fn rows_of([x, y]: [Span; 2]) -> impl Iterator<Item = (usize, usize, usize)> {
    (0..x.count).flat_map(move |i| {
        (0..y.count).map(move |j| (x.start + i, y.start + j, (x.first_voxel + i) * 8 + y.first_voxel + j))
    })
}

/// For each leaf the voxels with φ < 0. Zero is outside.
pub(super) fn inside_masks(phi: &Field) -> Vec<LeafMask> {
    let mask = |leaf: &Leaf| {
        let mut mask = LeafMask::EMPTY;
        for (word, values) in mask.words.iter_mut().zip(leaf.values.chunks_exact(64)) {
            *word = values.iter().rev().fold(0, |bits, &phi| bits << 1 | u64::from(phi < 0.0));
        }
        mask
    };
    phi.leaves.par_iter().map(mask).collect()
}

/// Signs of the voxels −1 ..= 8 around a leaf. In a row (x, y) bit z + 1 is voxel z.
#[derive(Clone, Debug)]
pub(super) struct SignRows {
    inside: [[u16; 10]; 10],
    stored: [[u16; 10]; 10],
    /// Bit z + 1 is cell z, and tells whether its 8 corners are stored.
    complete: [[u16; 9]; 9],
}

/// Bits of the rows that belong to the leaf itself: z from 0 to 7.
const OWN_BITS: u16 = 0b01_1111_1110;

impl SignRows {
    /// Collects the rows around a leaf.
    pub(super) fn new(neighborhood: &Neighborhood, inside_masks: &[LeafMask]) -> SignRows {
        let mut inside = [[0; 10]; 10];
        let mut stored = [[0; 10]; 10];
        for (spans, leaves) in neighborhood.columns(1) {
            let masks = leaves.map(|leaf| inside_masks.get(leaf as usize).unwrap_or(&LeafMask::EMPTY));
            let is_stored = leaves.map(|leaf| if leaf == NO_LEAF { 0 } else { 0xff });
            rows_of(spans).for_each(|(x, y, row)| {
                inside[x][y] = join_row(masks.map(|mask| mask.row(row)));
                stored[x][y] = join_row(is_stored);
            });
        }
        let mut complete = [[0; 9]; 9];
        for x in 0..9 {
            for y in 0..9 {
                let rows = stored[x][y] & stored[x][y + 1] & stored[x + 1][y] & stored[x + 1][y + 1];
                complete[x][y] = rows & rows >> 1;
            }
        }
        SignRows { inside, stored, complete }
    }

    /// Whether a voxel (−1 ..= 8 on each axis) is inside.
    pub(super) fn is_inside(&self, voxel: IVec3) -> bool {
        let at = voxel + IVec3::ONE;
        self.inside[at.x as usize][at.y as usize] >> at.z & 1 == 1
    }

    /// The signs of the corners of a cell (−1 ..= 7 on each axis): bit `4x + 2y + z` is set where
    /// corner (x, y, z) is inside.
    pub(super) fn cell_signs(&self, cell: IVec3) -> u8 {
        let (x, y, z) = ((cell.x + 1) as usize, (cell.y + 1) as usize, cell.z + 1);
        let pair = |row: u16| row >> z & 0b11;
        let (near, far) = (&self.inside[x], &self.inside[x + 1]);
        (pair(near[y]) | pair(near[y + 1]) << 2 | pair(far[y]) << 4 | pair(far[y + 1]) << 6) as u8
    }

    /// The leaf's own complete cells that have corners on both sides, in order.
    pub(super) fn crossed_cells(&self) -> impl Iterator<Item = IVec3> + '_ {
        (0..64).flat_map(move |row| {
            let (x, y) = (row / 8 + 1, row % 8 + 1);
            let corners =
                [self.inside[x][y], self.inside[x][y + 1], self.inside[x + 1][y], self.inside[x + 1][y + 1]];
            let (any, all) = corners.iter().fold((0, u16::MAX), |(any, all), row| (any | row, all & row));
            let crossed = (any | any >> 1) & !(all & all >> 1) & self.complete[x][y] & OWN_BITS;
            voxels_of(x, y, crossed)
        })
    }

    /// The grid edges along `axis` that start in the leaf, whose ends have different signs and whose
    /// four cells are complete: their first voxels, in order.
    pub(super) fn crossed_edges(&self, axis: usize) -> impl Iterator<Item = IVec3> + '_ {
        (0..64).flat_map(move |row| {
            let (x, y) = (row / 8 + 1, row % 8 + 1);
            let start = self.inside[x][y];
            let here = self.complete[x][y];
            let stored = self.stored[x][y];
            let (end, end_stored, cells) = match axis {
                0 => {
                    let cells = here & self.complete[x][y - 1];
                    (self.inside[x + 1][y], self.stored[x + 1][y], cells & cells << 1)
                }
                1 => {
                    let cells = here & self.complete[x - 1][y];
                    (self.inside[x][y + 1], self.stored[x][y + 1], cells & cells << 1)
                }
                _ => {
                    let before = self.complete[x - 1][y - 1] & self.complete[x - 1][y];
                    (start >> 1, stored >> 1, here & self.complete[x][y - 1] & before)
                }
            };
            let crossed = (start ^ end) & stored & end_stored & OWN_BITS;
            debug_assert_eq!(crossed & !cells, 0, "a voxel next to the surface is not stored");
            voxels_of(x, y, crossed & cells)
        })
    }

    /// The leaf's own voxels whose sign differs from that of corner `end` (numbered `4x + 2y + z`)
    /// of the cell that starts at them, where both are stored, in order.
    pub(super) fn crossed_to(&self, end: usize) -> impl Iterator<Item = IVec3> + '_ {
        let (end_x, end_y, end_z) = (end >> 2, end >> 1 & 1, end & 1);
        (0..64).flat_map(move |row| {
            let (x, y) = (row / 8 + 1, row % 8 + 1);
            let differ = self.inside[x][y] ^ self.inside[x + end_x][y + end_y] >> end_z;
            let stored = self.stored[x][y] & self.stored[x + end_x][y + end_y] >> end_z;
            voxels_of(x, y, differ & stored & OWN_BITS)
        })
    }
}

/// The 10 bits of a row from those of three leaves.
fn join_row([before, here, after]: [u8; 3]) -> u16 {
    u16::from(before) >> 7 | u16::from(here) << 1 | (u16::from(after) & 1) << 9
}

/// The voxels of row (x + 1, y + 1) whose bit z + 1 is set, in order.
fn voxels_of(x: usize, y: usize, bits: u16) -> impl Iterator<Item = IVec3> {
    let mut rest = bits;
    std::iter::from_fn(move || {
        (rest != 0).then(|| {
            let z = rest.trailing_zeros() as i32;
            rest &= rest - 1;
            IVec3::new(x as i32, y as i32, z) - IVec3::ONE
        })
    })
}

/// φ of the voxels −1 ..= 9 around a leaf.
pub(super) struct Block {
    values: [f32; BLOCK_STEP[0] * BLOCK_EDGE],
}

/// Voxels along an edge of a block.
const BLOCK_EDGE: usize = 11;

/// How far apart neighbours along x, y and z are in a block: rows are padded to 12.
pub(super) const BLOCK_STEP: [usize; 3] = [12 * BLOCK_EDGE, 12, 1];

impl Block {
    /// Copies φ around a leaf. What is not stored reads as `beyond`.
    pub(super) fn new(neighborhood: &Neighborhood, phi: &Field, beyond: f32) -> Block {
        let mut values = [beyond; BLOCK_STEP[0] * BLOCK_EDGE];
        for (spans, leaves) in neighborhood.columns(2) {
            let [before, here, after] = leaves.map(|leaf| phi.leaves.get(leaf as usize));
            rows_of(spans).for_each(|(x, y, row)| {
                let place = &mut values[x * BLOCK_STEP[0] + y * BLOCK_STEP[1]..][..BLOCK_EDGE];
                let row = row * 8;
                if let Some(before) = before {
                    place[0] = before.values[row + 7];
                }
                if let Some(here) = here {
                    place[1..9].copy_from_slice(&here.values[row..row + 8]);
                }
                if let Some(after) = after {
                    place[9..].copy_from_slice(&after.values[row..row + 2]);
                }
            });
        }
        Block { values }
    }

    /// The place in the block of a voxel (−1 ..= 9 on each axis).
    pub(super) fn index(voxel: IVec3) -> usize {
        let at = voxel + IVec3::ONE;
        at.x as usize * BLOCK_STEP[0] + at.y as usize * BLOCK_STEP[1] + at.z as usize
    }

    /// φ at a place in the block.
    pub(super) fn phi(&self, index: usize) -> f32 {
        self.values[index]
    }

    /// ∇φ by central differences at a place in the block that has neighbours on all sides.
    pub(super) fn gradient(&self, index: usize) -> Vec3 {
        let slope = |step: usize| 0.5 * (self.values[index + step] - self.values[index - step]);
        Vec3::new(slope(BLOCK_STEP[0]), slope(BLOCK_STEP[1]), slope(BLOCK_STEP[2]))
    }

    /// The second difference of φ along `step` (a sum of [`BLOCK_STEP`]s).
    pub(super) fn second_difference(&self, index: usize, step: usize) -> f32 {
        (self.values[index + step] - self.values[index]) - (self.values[index] - self.values[index - step])
    }
}
