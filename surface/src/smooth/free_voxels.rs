//! Selects the voxels that a step may change, and the rows it must visit.
//!
//! ```text
//!      |φ| ≤ 3   free: the unknowns of a step
//!      + 1       their face neighbors: the inner Laplacian is also needed here
//!      + 1       the next neighbors: read, but held fixed
//! ```
//!
//! The free voxels are selected from φ at the start of a step (paper, §3.5) and do not change during the
//! step.

use rayon::prelude::*;

use crate::grid::{Direction, Field, Leaf, LeafMask, NO_LEAF, ROW_COUNT, Topology};
use crate::parallel::Loops as _;
use crate::simd::{self, Kernel, Lanes};

/// The free voxels of a step, and the rows where the inner Laplacian is needed.
pub(super) struct FreeVoxels {
    /// Free voxels, by leaf.
    pub(super) free: Vec<LeafMask>,
    /// Rows with a free voxel, by leaf: bit `x·8 + y`.
    pub(super) free_rows: Vec<u64>,
    /// Rows with a free voxel or a face neighbor of one, by leaf: bit `x·8 + y`.
    pub(super) laplacian_rows: Vec<u64>,
}

impl FreeVoxels {
    /// The free voxels are those with |φ| ≤ `width` voxels.
    pub(super) fn new(topology: &Topology, phi: &Field, width: f32) -> FreeVoxels {
        FreeVoxels::of(topology, near(phi, width))
    }

    /// Like [`new`](Self::new), without the voxels that are pinned.
    pub(super) fn excluding(topology: &Topology, phi: &Field, width: f32, held: &[LeafMask]) -> FreeVoxels {
        let mut free = near(phi, width);
        free.par_iter_mut().zip(held).halved().for_each(|(free, held)| free.remove_all(held));
        FreeVoxels::of(topology, free)
    }

    /// Uses exactly these free voxels.
    pub(super) fn of(topology: &Topology, free: Vec<LeafMask>) -> FreeVoxels {
        let neighbors = topology.neighbors();
        let laplacian_rows = (0..free.len())
            .into_par_iter()
            .halved()
            .map(|leaf| dilated_rows(&free, &neighbors[leaf], leaf))
            .collect();
        let free_rows = free.par_iter().halved().map(LeafMask::occupied_rows).collect();
        FreeVoxels { free, free_rows, laplacian_rows }
    }

    /// Updates `free_rows` after voxels were removed from `free`. `laplacian_rows` need not change: extra
    /// rows cost only time.
    pub(super) fn recount_free_rows(&mut self) {
        self.free_rows = self.free.par_iter().halved().map(LeafMask::occupied_rows).collect();
    }

    /// Number of free voxels in all leaves, or in those that are `own`.
    pub(super) fn free_count(&self, own: Option<&[bool]>) -> u64 {
        let counted =
            self.free.par_iter().enumerate().halved().filter(|(leaf, _)| own.is_none_or(|own| own[*leaf]));
        counted.map(|(_, mask)| u64::from(mask.count())).sum()
    }
}

/// The voxels with |φ| ≤ `width`.
pub(super) fn near(phi: &Field, width: f32) -> Vec<LeafMask> {
    phi.leaves.par_iter().halved().map(|leaf| simd::dispatch(NearZero { leaf, width })).collect()
}

/// The voxels of a leaf with |φ| ≤ `width`.
struct NearZero<'a> {
    leaf: &'a Leaf,
    width: f32,
}

impl Kernel for NearZero<'_> {
    type Output = LeafMask;

    #[inline(always)]
    fn run<V: Lanes>(self) -> LeafMask {
        let mut mask = LeafMask::EMPTY;
        for row in 0..ROW_COUNT {
            let is_beyond = V::splat(self.width).lt(V::load(self.leaf.row(row)).abs());
            mask.set_row(row, !V::bits(is_beyond));
        }
        mask
    }
}

/// The rows of a leaf that contain a free voxel or a face neighbor of one.
fn dilated_rows(free: &[LeafMask], neighbors: &[u32; 6], leaf: usize) -> u64 {
    let face = |direction: Direction| {
        let neighbor = neighbors[direction as usize];
        if neighbor == NO_LEAF { LeafMask::EMPTY } else { free[neighbor as usize] }
    };
    let own = free[leaf].occupied_rows();
    // Row (x, y) is bit x·8 + y: a step in x shifts by 8, a step in y by 1 within each byte.
    let along_x = own << 8 | own >> 8;
    let along_y = (own << 1 & !0x0101_0101_0101_0101) | (own >> 1 & !0x8080_8080_8080_8080);
    let from_x = face(Direction::XMinus).occupied_rows() >> 56 | face(Direction::XPlus).occupied_rows() << 56;
    let from_y = (face(Direction::YMinus).occupied_rows() >> 7 & 0x0101_0101_0101_0101)
        | (face(Direction::YPlus).occupied_rows() << 7 & 0x8080_8080_8080_8080);
    let from_z = face(Direction::ZMinus).rows_with(0x80) | face(Direction::ZPlus).rows_with(0x01);
    own | along_x | along_y | from_x | from_y | from_z
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::IVec3;

    #[test]
    fn laplacian_rows_include_face_neighbors_of_free_voxels() {
        let corner = IVec3::new(7, 0, 7);
        let topology =
            Topology::new(vec![IVec3::ZERO, IVec3::new(8, 0, 0), IVec3::new(0, -8, 0), IVec3::new(0, 0, 8)]);
        let mut phi = Field::splat(topology.len(), 6.0);
        phi.leaves[topology.find(IVec3::ZERO).unwrap()].values[crate::grid::offset_in_leaf(corner)] = 1.0;
        let band = FreeVoxels::new(&topology, &phi, 3.0);
        assert_eq!(band.free_count(None), 1);
        let rows = |x: i32, y: i32, z: i32| band.laplacian_rows[topology.find(IVec3::new(x, y, z)).unwrap()];
        assert_eq!(rows(0, 0, 0), 1 << 56 | 1 << 57 | 1 << 48);
        assert_eq!(rows(8, 0, 0), 1 << 0);
        assert_eq!(rows(0, -8, 0), 1 << 63);
        assert_eq!(rows(0, 0, 8), 1 << 56);
    }
}
