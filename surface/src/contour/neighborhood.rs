//! Local copies of a leaf and its surroundings.
//!
//! Contouring works leaf by leaf. The cells of a leaf extend beyond its far faces, those with the largest x,
//! y and z. The stencils at the corners of these cells, and the other cells around their edges, also extend
//! beyond the near faces. So contouring finds the 26 neighbors of each leaf once and copies the values that
//! the leaf needs:
//!
//! ```text
//!    voxel      −1 │ 0  1  2  3  4  5  6  7 │ 8   9
//!    SignRows    • │ •  •  •  •  •  •  •  • │ •         one bit per voxel, 10 × 10 rows of 10 bits
//!    PhiBlock    • │ •  •  •  •  •  •  •  • │ •   •     φ, 11 × 11 × 11
//!    cells     └─┴─┴──┴──┴──┴──┴──┴──┴──┴───┘           cell −1 belongs to the previous leaf
//! ```
//!
//! A row of sign bits shows for ten voxels at once which cells and edges the surface crosses, so leaves and
//! rows away from the surface cost almost nothing.
//!
//! A cell is *complete* if all its 8 corners are stored. Other cells have no surface, because φ is unknown
//! outside the stored leaves.

use glam::{IVec3, Vec3};

use crate::grid::{Field, Leaf, LeafMask, NO_LEAF, Topology, neighbor_slot};

/// Indices of a leaf and its 26 neighbors, or [`NO_LEAF`].
#[derive(Clone, Copy, Debug)]
pub(super) struct LeafNeighborhood {
    leaves: [u32; 27],
}

impl LeafNeighborhood {
    /// The neighborhood of a leaf.
    pub(super) fn new(topology: &Topology, leaf: usize) -> LeafNeighborhood {
        LeafNeighborhood { leaves: topology.neighborhood(leaf) }
    }

    /// The index of the leaf at offset `step`, in leaves (−1, 0 or 1 on each axis).
    #[inline(always)]
    pub(super) fn leaf(&self, step: IVec3) -> u32 {
        self.leaves[neighbor_slot(step)]
    }

    /// The leaf itself and the 26 around it.
    pub(super) fn leaves(&self) -> &[u32; 27] {
        &self.leaves
    }

    /// True if the surface may cross a cell of the leaf. False if the leaf and the leaves that its cells
    /// extend into are all inside, or all outside.
    pub(super) fn may_have_surface(&self, inside_masks: &[LeafMask]) -> bool {
        let own = inside_masks[self.leaves[13] as usize];
        let is_uniform = own == LeafMask::EMPTY || own == LeafMask::FULL;
        let differs =
            |slot: usize| inside_masks.get(self.leaves[slot] as usize).is_some_and(|mask| *mask != own);
        !is_uniform || SLOTS_AFTER.into_iter().any(differs)
    }
}

/// The leaves that the center leaf's cells extend into.
const SLOTS_AFTER: [usize; 7] = [14, 16, 17, 22, 23, 25, 26];

/// The part of a halo along one axis that lies in one leaf.
#[derive(Clone, Copy)]
struct HaloSpan {
    /// First index in the halo.
    start: usize,
    /// Length.
    count: usize,
    /// First index in the leaf.
    first_voxel: usize,
}

/// The spans of a halo in the previous leaf (1 voxel), the leaf itself (8) and the next leaf (`after`).
#[inline(always)]
fn spans(after: usize) -> [HaloSpan; 3] {
    [
        HaloSpan { start: 0, count: 1, first_voxel: 7 },
        HaloSpan { start: 1, count: 8, first_voxel: 0 },
        HaloSpan { start: 9, count: after, first_voxel: 0 },
    ]
}

/// Signs of the voxels −1 ..= 8 around a leaf. Bit z + 1 of row (x, y) is voxel z.
#[derive(Clone, Debug)]
pub(super) struct SignRows {
    inside: [[u16; 10]; 10],
    /// Mask of the stored voxels of a row, by the row's position along x and along y: 0 before the leaf, 1 in
    /// it, 2 after it.
    stored: [[u16; 3]; 3],
}

/// Bits of the rows that belong to the leaf itself: z from 0 to 7.
const OWN_BITS: u16 = 0b01_1111_1110;

impl SignRows {
    /// Collects the rows around a leaf.
    #[inline(always)]
    pub(super) fn new(neighborhood: &LeafNeighborhood, inside_masks: &[LeafMask]) -> SignRows {
        let mut inside = [[0; 10]; 10];
        let mut stored = [[0; 3]; 3];
        for column in 0..9 {
            let [x, y] = [spans(1)[column / 3], spans(1)[column % 3]];
            let leaf = |z: usize| neighborhood.leaves[column * 3 + z];
            let is_stored = |z: usize| if leaf(z) == NO_LEAF { 0 } else { 0xff };
            stored[column / 3][column % 3] = join_row([is_stored(0), is_stored(1), is_stored(2)]);
            let mask = |z: usize| inside_masks.get(leaf(z) as usize).unwrap_or(&LeafMask::EMPTY);
            let masks = [mask(0), mask(1), mask(2)];
            for i in 0..x.count {
                let bytes = |z: usize| masks[z].words[x.first_voxel + i].to_le_bytes();
                let [before, here, after] = [bytes(0), bytes(1), bytes(2)];
                let rows = &mut inside[x.start + i];
                if y.count == 8 {
                    for j in 0..8 {
                        rows[1 + j] = join_row([before[j], here[j], after[j]]);
                    }
                } else {
                    let j = y.first_voxel;
                    rows[y.start] = join_row([before[j], here[j], after[j]]);
                }
            }
        }
        SignRows { inside, stored }
    }

    /// True if a voxel (−1 ..= 8 on each axis) is inside.
    #[inline(always)]
    pub(super) fn is_inside(&self, voxel: IVec3) -> bool {
        let at = voxel + IVec3::ONE;
        self.inside[at.x as usize][at.y as usize] >> at.z & 1 == 1
    }

    /// The signs of the corners of a cell (−1 ..= 7 on each axis): bit `4x + 2y + z` is set if corner (x, y,
    /// z) is inside.
    #[inline(always)]
    pub(super) fn cell_signs(&self, cell: IVec3) -> u8 {
        let (x, y, z) = ((cell.x + 1) as usize, (cell.y + 1) as usize, cell.z + 1);
        let pair = |row: u16| row >> z & 0b11;
        let (near, far) = (&self.inside[x], &self.inside[x + 1]);
        (pair(near[y]) | pair(near[y + 1]) << 2 | pair(far[y]) << 4 | pair(far[y + 1]) << 6) as u8
    }

    /// The complete cells with corners on both sides: row (x + 1, y + 1), from −1 to 7 on both axes, has bit
    /// z + 1 for cell z.
    #[inline(always)]
    pub(super) fn crossed_rows(&self) -> [[u16; 9]; 9] {
        let mut crossed = [[0; 9]; 9];
        for (x, crossed) in crossed.iter_mut().enumerate() {
            let (near, far) = (&self.inside[x], &self.inside[x + 1]);
            let complete = self.complete_rows(x);
            for y in 0..9 {
                let any = near[y] | near[y + 1] | far[y] | far[y + 1];
                let all = near[y] & near[y + 1] & far[y] & far[y + 1];
                crossed[y] = (any | any >> 1) & !(all & all >> 1) & complete[y];
            }
        }
        crossed
    }

    /// The leaf's own complete cells with corners on both sides.
    #[inline(always)]
    pub(super) fn crossed_cells(&self) -> LeafMask {
        let crossed = self.crossed_rows();
        own_voxels(|x, y| crossed[x][y])
    }

    /// The first voxels of the grid edges along `axis` that start in the leaf, have ends of different sign,
    /// and have four complete cells.
    #[inline(always)]
    pub(super) fn crossed_edges(&self, axis: usize) -> LeafMask {
        let complete: [[u16; 9]; 9] = std::array::from_fn(|x| self.complete_rows(x));
        let own_stored = self.stored[1][1];
        own_voxels(|x, y| {
            let start = self.inside[x][y];
            let here = complete[x][y];
            let (end, end_stored, cells) = match axis {
                0 => {
                    let cells = here & complete[x][y - 1];
                    (self.inside[x + 1][y], self.stored[(x + 1).div_ceil(8)][1], cells & cells << 1)
                }
                1 => {
                    let cells = here & complete[x - 1][y];
                    (self.inside[x][y + 1], self.stored[1][(y + 1).div_ceil(8)], cells & cells << 1)
                }
                _ => {
                    let before = complete[x - 1][y - 1] & complete[x - 1][y];
                    (start >> 1, own_stored >> 1, here & complete[x][y - 1] & before)
                }
            };
            let crossed = (start ^ end) & own_stored & end_stored & OWN_BITS;
            debug_assert_eq!(crossed & !cells, 0, "a voxel next to the surface must be stored");
            crossed & cells
        })
    }

    /// The leaf's own voxels whose sign differs from that of corner `end` (numbered `4x + 2y + z`) of the
    /// cell that starts at the voxel. Pairs with a voxel that is not stored are excluded.
    #[inline(always)]
    pub(super) fn crossed_to(&self, end: usize) -> LeafMask {
        let (end_x, end_y, end_z) = (end >> 2, end >> 1 & 1, end & 1);
        own_voxels(|x, y| {
            let differ = self.inside[x][y] ^ self.inside[x + end_x][y + end_y] >> end_z;
            differ
                & self.stored[1][1]
                & self.stored[(x + end_x).div_ceil(8)][(y + end_y).div_ceil(8)] >> end_z
        })
    }

    /// The complete cells whose first voxel is at x − 1, as one row per y: bit z + 1 for cell z.
    #[inline(always)]
    fn complete_rows(&self, x: usize) -> [u16; 9] {
        let (near, far) = (&self.stored[x.div_ceil(8)], &self.stored[(x + 1).div_ceil(8)]);
        let both = [near[0] & far[0], near[1] & far[1], near[2] & far[2]];
        let complete = |rows: u16| rows & rows >> 1;
        let mut rows = [complete(both[1]); 9];
        rows[0] = complete(both[0] & both[1]);
        rows[8] = complete(both[1] & both[2]);
        rows
    }
}

/// Combines the 10 bits of a row from those of three leaves.
#[inline(always)]
fn join_row([before, here, after]: [u8; 3]) -> u16 {
    u16::from(before) >> 7 | u16::from(here) << 1 | (u16::from(after) & 1) << 9
}

/// Extracts the leaf's own voxels from the bits of its rows. `bits` takes x + 1 and y + 1.
#[inline(always)]
fn own_voxels(bits: impl Fn(usize, usize) -> u16) -> LeafMask {
    let mut mask = LeafMask::EMPTY;
    for (x, word) in mask.words.iter_mut().enumerate() {
        let mut bytes = [0; 8];
        for (y, byte) in bytes.iter_mut().enumerate() {
            *byte = ((bits(x + 1, y + 1) & OWN_BITS) >> 1) as u8;
        }
        *word = u64::from_le_bytes(bytes);
    }
    mask
}

/// φ of the voxels −1 ..= 9 around a leaf.
pub(super) struct PhiBlock {
    /// Indexed by x, then y; rows are padded to 12.
    planes: [[[f32; 12]; BLOCK_EDGE]; BLOCK_EDGE],
    /// Value of voxels that are not stored.
    beyond: f32,
}

/// Voxels along an edge of a block.
const BLOCK_EDGE: usize = 11;

/// Strides along x, y and z in a block.
pub(super) const BLOCK_STEP: [usize; 3] = [12 * BLOCK_EDGE, 12, 1];

impl PhiBlock {
    /// A block that is not filled.
    #[inline(always)]
    pub(super) fn new(beyond: f32) -> PhiBlock {
        PhiBlock { planes: [[[beyond; 12]; BLOCK_EDGE]; BLOCK_EDGE], beyond }
    }

    /// Copies φ around a leaf.
    #[inline(always)]
    pub(super) fn fill(&mut self, neighborhood: &LeafNeighborhood, phi: &Field) {
        let nothing = Leaf::splat(self.beyond);
        for column in 0..9 {
            let [x, y] = [spans(2)[column / 3], spans(2)[column % 3]];
            let leaf =
                |z: usize| phi.leaves.get(neighborhood.leaves[column * 3 + z] as usize).unwrap_or(&nothing);
            let [before, here, after] = [leaf(0), leaf(1), leaf(2)];
            for i in 0..x.count {
                let rows = &mut self.planes[x.start + i];
                for j in 0..y.count {
                    let row = (x.first_voxel + i) * 8 + y.first_voxel + j;
                    let target_row = &mut rows[y.start + j];
                    target_row[0] = before.row(row)[7];
                    target_row[1..9].copy_from_slice(here.row(row));
                    target_row[9..11].copy_from_slice(&after.row(row)[..2]);
                }
            }
        }
    }

    /// Index in the block of a voxel (−1 ..= 9 on each axis).
    #[inline(always)]
    pub(super) fn index(voxel: IVec3) -> usize {
        let at = voxel + IVec3::ONE;
        at.x as usize * BLOCK_STEP[0] + at.y as usize * BLOCK_STEP[1] + at.z as usize
    }

    #[inline(always)]
    fn values(&self) -> &[f32] {
        self.planes.as_flattened().as_flattened()
    }

    /// φ at an index in the block.
    #[inline(always)]
    pub(super) fn phi(&self, index: usize) -> f32 {
        self.values()[index]
    }

    /// ∇φ by central differences at an index whose neighbors on all sides are in the block.
    #[inline(always)]
    pub(super) fn gradient(&self, index: usize) -> Vec3 {
        let slope = |step: usize| 0.5 * (self.values()[index + step] - self.values()[index - step]);
        Vec3::new(slope(BLOCK_STEP[0]), slope(BLOCK_STEP[1]), slope(BLOCK_STEP[2]))
    }

    /// The second difference of φ along `step` (a sum of [`BLOCK_STEP`]s).
    #[inline(always)]
    pub(super) fn second_difference(&self, index: usize, step: usize) -> f32 {
        (self.values()[index + step] - self.values()[index])
            - (self.values()[index] - self.values()[index - step])
    }
}
