//! The sparse grid: leaves of 8 × 8 × 8 voxels, stored only near the surface.
//!
//! ```text
//!   Topology            which leaves are stored, in a fixed order, and their neighbors
//!     leaf 0  leaf 1  leaf 2 …
//!   Field<f32>          one value per voxel:  [512 values][512 values][512 values] …
//!   Field of masks      one bit per voxel:    [512 bits][512 bits] …
//!
//!   one leaf            value index = x·64 + y·8 + z        (z fastest)
//!                       a row is the 8 values along z: one vector register
//!                       mask bit of a voxel = bit z of byte y of word x
//! ```
//!
//! All fields of a frame share one [`Topology`]. A field is a single flat, aligned allocation of leaves in
//! the topology's order. The grid does not depend on distances or particles.
//!
//! Invariants: leaf origins are multiples of 8, distinct, and sorted in the depth-first order of an OpenVDB
//! tree, so that a tree can be written in one pass; `neighbors` is symmetric.

mod mask;
mod stencil;

use bytemuck::{Pod, Zeroable};
use glam::IVec3;
use rayon::prelude::*;
use rustc_hash::FxHashMap;

pub use mask::{LeafMask, negative_masks};
pub use stencil::{Neighborhood, ROW_COUNT, SetBits, Slab, slabs_in, vectors_in};

use crate::parallel::Loops as _;

// The set of stored leaves, their order and their neighbors.

/// Index of a leaf that is not stored.
pub const NO_LEAF: u32 = u32::MAX;

/// The six faces of a leaf, in the order of [`Topology::neighbors`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Direction {
    /// Towards smaller x.
    XMinus,
    /// Towards larger x.
    XPlus,
    /// Towards smaller y.
    YMinus,
    /// Towards larger y.
    YPlus,
    /// Towards smaller z.
    ZMinus,
    /// Towards larger z.
    ZPlus,
}

/// The leaves of 8³ voxels that a frame stores: their origins, in voxels, in the order of an OpenVDB tree,
/// and their neighbors. Voxel (0, 0, 0) is centered on the world origin.
#[derive(Clone, Debug, Default)]
pub struct Topology {
    origins: Vec<IVec3>,
    neighbors: Vec<[u32; 6]>,
    index_of: FxHashMap<IVec3, u32>,
}

impl Topology {
    /// The topology of the leaves with these origins: multiples of 8, in any order, duplicates allowed.
    pub fn new(origins: Vec<IVec3>) -> Topology {
        debug_assert!(origins.iter().all(|origin| origin.rem_euclid(IVec3::splat(LEAF_EDGE)) == IVec3::ZERO));
        let mut codes: Vec<u128> = origins.into_par_iter().halved().map(tree_order).collect();
        codes.par_sort_unstable();
        codes.dedup();
        let origins: Vec<IVec3> = codes.into_par_iter().halved().map(origin_from_order).collect();
        assert!(origins.len() < NO_LEAF as usize, "more leaves than 32-bit indices allow");
        let index_of: FxHashMap<IVec3, u32> =
            origins.iter().enumerate().map(|(index, &origin)| (origin, index as u32)).collect();
        let neighbors = origins
            .par_iter()
            .halved()
            .map(|&origin| {
                FACE_STEPS.map(|step| index_of.get(&(origin + step * LEAF_EDGE)).copied().unwrap_or(NO_LEAF))
            })
            .collect();
        Topology { origins, neighbors, index_of }
    }

    /// Number of leaves.
    pub fn len(&self) -> usize {
        self.origins.len()
    }

    /// True if no leaf is stored.
    pub fn is_empty(&self) -> bool {
        self.origins.is_empty()
    }

    /// The origin (minimum voxel) of each leaf.
    pub fn origins(&self) -> &[IVec3] {
        &self.origins
    }

    /// For each leaf, the leaves beyond its six faces in the order of [`Direction`], or [`NO_LEAF`].
    pub fn neighbors(&self) -> &[[u32; 6]] {
        &self.neighbors
    }

    /// Indices of a leaf and its 26 neighbors, in the order of [`neighbor_slot`]; [`NO_LEAF`] if one is not
    /// stored.
    pub fn neighborhood(&self, leaf: usize) -> [u32; 27] {
        let mut around = [NO_LEAF; 27];
        around[CENTER] = leaf as u32;
        for (slot, steps) in &NEIGHBOR_PATHS {
            // Any stored leaf on a path has the wanted leaf in its `neighbors`. Usually the first one is
            // stored, and no further lookup is needed.
            let known = steps.iter().find(|(from, _)| around[*from] != NO_LEAF);
            around[*slot] = match known {
                Some(&(from, face)) => self.neighbors[around[from] as usize][face],
                None => self.find_across(leaf, *slot),
            };
        }
        around
    }

    /// The leaf at a slot of another leaf's neighborhood, found by origin.
    fn find_across(&self, leaf: usize, slot: usize) -> u32 {
        let step = IVec3::new(slot as i32 / 9, slot as i32 / 3 % 3, slot as i32 % 3) - IVec3::ONE;
        self.index_of.get(&(self.origins[leaf] + step * LEAF_EDGE)).copied().unwrap_or(NO_LEAF)
    }

    /// The leaf with this origin.
    pub fn find(&self, origin: IVec3) -> Option<usize> {
        self.index_of.get(&origin).map(|&index| index as usize)
    }

    /// The leaf that contains a voxel, and the voxel relative to the leaf's origin.
    pub fn find_voxel(&self, voxel: IVec3) -> Option<(usize, IVec3)> {
        let local = voxel & IVec3::splat(LEAF_EDGE - 1);
        self.find(voxel - local).map(|leaf| (leaf, local))
    }
}

/// Unit steps through the six faces, in the order of [`Direction`].
pub const FACE_STEPS: [IVec3; 6] = [IVec3::NEG_X, IVec3::X, IVec3::NEG_Y, IVec3::Y, IVec3::NEG_Z, IVec3::Z];

/// The slot in [`Topology::neighborhood`] of the neighbor at `step`, in leaves: −1 to 1 on each axis.
#[inline(always)]
pub fn neighbor_slot(step: IVec3) -> usize {
    let IVec3 { x, y, z } = step + IVec3::ONE;
    (9 * x + 3 * y + z) as usize
}

/// Slot of a leaf in its own neighborhood.
const CENTER: usize = 13;

/// For each slot except the center (faces, then edges, then corners): up to three slots one step closer to
/// the center, each with the face that leads from there to the slot. If there are fewer than three, the first
/// is repeated.
const NEIGHBOR_PATHS: [(usize, [(usize, usize); 3]); 26] = {
    let weights = [9, 3, 1];
    let mut paths = [(0, [(0, 0); 3]); 26];
    let mut count = 0;
    let mut distance = 1;
    while distance <= 3 {
        let mut slot = 0;
        while slot < 27 {
            let mut steps = [(0, 0); 3];
            let mut step_count = 0;
            let mut axis = 0;
            while axis < 3 {
                let coord = slot / weights[axis] % 3;
                if coord != 1 {
                    let nearer = if coord == 0 { slot + weights[axis] } else { slot - weights[axis] };
                    steps[step_count] = (nearer, 2 * axis + coord / 2);
                    step_count += 1;
                }
                axis += 1;
            }
            if step_count == distance {
                let mut rest = step_count;
                while rest < 3 {
                    steps[rest] = steps[0];
                    rest += 1;
                }
                paths[count] = (slot, steps);
                count += 1;
            }
            slot += 1;
        }
        distance += 1;
    }
    paths
};

/// The steps, in voxels, from a leaf to all leaves within `reach` voxels on each axis, rounded up to leaves.
/// Nearest first, so that a search can stop early.
pub fn leaf_steps_within(reach: f32) -> Vec<IVec3> {
    let rings = (reach / LEAF_EDGE as f32).ceil() as i32;
    let axis = || -rings..=rings;
    let mut steps: Vec<IVec3> =
        axis().flat_map(|x| axis().flat_map(move |y| axis().map(move |z| IVec3::new(x, y, z)))).collect();
    steps.sort_by_key(|step| step.length_squared());
    steps.into_iter().map(|step| step * LEAF_EDGE).collect()
}

/// The position of a leaf in the depth-first order of an OpenVDB tree, as one number: root child (4096³
/// voxels), lower internal node (128³ voxels), leaf, each in lexicographic order of x, y, z.
fn tree_order(origin: IVec3) -> u128 {
    // Flipping the sign bit turns signed order into unsigned order.
    let [x, y, z] = origin.to_array().map(|axis| u128::from((axis as u32) ^ 0x8000_0000));
    let digits = |shift: u32, bits: u32| {
        let part = |axis: u128| axis >> shift & ((1 << bits) - 1);
        part(x) << (2 * bits) | part(y) << bits | part(z)
    };
    digits(12, 20) << 27 | digits(7, 5) << 12 | digits(3, 4)
}

/// The inverse of [`tree_order`].
fn origin_from_order(code: u128) -> IVec3 {
    let axis = |axis: u32| {
        let digits = |shift: u32, bits: u32| (code >> (shift + (2 - axis) * bits)) as u32 & ((1 << bits) - 1);
        (digits(27, 20) << 12 | digits(12, 5) << 7 | digits(0, 4) << 3) ^ 0x8000_0000
    };
    IVec3::new(axis(0) as i32, axis(1) as i32, axis(2) as i32)
}

// Leaves of values, and the order of the voxels in them.

/// Voxels along an edge of a leaf: level sets are stored in blocks of 8³ voxels.
pub const LEAF_EDGE: i32 = 8;

/// Voxels in a leaf: 8³.
pub const LEAF_VOXELS: usize = 512;

/// Maximum number of leaves per task in loops that take microseconds per leaf. While no thread is idle, rayon
/// splits a loop into few tasks; without a limit, threads would wait while one of them finishes the last task.
pub const LEAVES_PER_TASK: usize = 16;

/// The 8 values of a row.
pub type Row = [f32; 8];

/// The 512 values of one leaf, z fastest.
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
#[repr(C, align(64))]
pub struct Leaf {
    /// Value of voxel (x, y, z) at `x·64 + y·8 + z`.
    pub values: [f32; LEAF_VOXELS],
}

impl Leaf {
    /// A leaf with one value everywhere.
    pub const fn splat(value: f32) -> Leaf {
        Leaf { values: [value; LEAF_VOXELS] }
    }

    /// Row `x·8 + y`: the 8 values along z.
    #[inline(always)]
    pub fn row(&self, row: usize) -> &Row {
        &self.values.as_chunks::<8>().0[row]
    }

    /// Mutable row `x·8 + y`.
    #[inline(always)]
    pub fn row_mut(&mut self, row: usize) -> &mut Row {
        &mut self.values.as_chunks_mut::<8>().0[row]
    }

    /// The eight rows at `x` modulo 8.
    #[inline(always)]
    pub fn slab(&self, x: usize) -> &[Row; 8] {
        let slabs: &[[Row; 8]; 8] = bytemuck::cast_ref(&self.values);
        &slabs[x & 7]
    }

    /// The eight mutable rows at `x` modulo 8.
    #[inline(always)]
    pub fn slab_mut(&mut self, x: usize) -> &mut [Row; 8] {
        let slabs: &mut [[Row; 8]; 8] = bytemuck::cast_mut(&mut self.values);
        &mut slabs[x & 7]
    }
}

/// One value for every voxel of the leaves of a [`Topology`](crate::Topology), in the topology's
/// order.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Field {
    /// One entry per leaf.
    pub leaves: Vec<Leaf>,
}

impl Field {
    /// A field of `leaf_count` leaves with the same value everywhere.
    pub fn splat(leaf_count: usize, value: f32) -> Field {
        // In parallel, because the first write to a page takes longest.
        Field { leaves: rayon::iter::repeat_n(Leaf::splat(value), leaf_count).collect() }
    }

    /// Copies the values of another field, and reuses this field's memory if that is large enough.
    pub fn copy_from(&mut self, other: &Field) {
        other.leaves.par_iter().copied().halved().collect_into_vec(&mut self.leaves);
    }

    /// The leaves as plain arrays, for writers that do not depend on the grid types.
    pub fn as_arrays(&self) -> &[[f32; LEAF_VOXELS]] {
        bytemuck::cast_slice(&self.leaves)
    }
}

/// Offset in its leaf of a voxel given relative to the leaf's origin (0 ..= 7 on each axis).
pub fn offset_in_leaf(voxel: IVec3) -> usize {
    debug_assert!(voxel.cmpge(IVec3::ZERO).all() && voxel.cmplt(IVec3::splat(LEAF_EDGE)).all());
    (voxel.x as usize) << 6 | (voxel.y as usize) << 3 | voxel.z as usize
}

/// The voxel at an offset in its leaf, relative to the leaf's origin.
pub fn voxel_in_leaf(offset: usize) -> IVec3 {
    debug_assert!(offset < LEAF_VOXELS);
    IVec3::new((offset >> 6) as i32, (offset >> 3 & 7) as i32, (offset & 7) as i32)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn leaves_are_in_vdb_depth_first_order() {
        let origins = [[-8, 0, 0], [0, 0, 0], [0, 0, 8], [0, 8, 0], [8, 0, 0], [0, 0, 128], [4096, 0, 0]];
        let mut shuffled: Vec<IVec3> = origins.iter().map(|&origin| IVec3::from(origin)).collect();
        shuffled.rotate_left(3);
        let topology = Topology::new(shuffled);
        assert_eq!(topology.origins(), origins.map(IVec3::from));
    }

    #[test]
    fn neighbors_are_symmetric() {
        let topology = Topology::new(vec![IVec3::ZERO, IVec3::new(8, 0, 0), IVec3::new(8, 0, -8)]);
        for (leaf, faces) in topology.neighbors().iter().enumerate() {
            for (face, &neighbor) in faces.iter().enumerate().filter(|&(_, &neighbor)| neighbor != NO_LEAF) {
                assert_eq!(topology.neighbors()[neighbor as usize][face ^ 1] as usize, leaf);
            }
        }
        let below = topology.find(IVec3::new(8, 0, -8)).unwrap();
        assert_eq!(topology.find_voxel(IVec3::new(9, 2, -1)), Some((below, IVec3::new(1, 2, 7))));
    }
    #[test]
    fn neighborhoods_match_lookup_with_missing_leaves() {
        // Leave out some leaves of a block, so that slots are reachable by all, some or none of their paths.
        for every in 2..7 {
            let cells = (0..125).filter(|cell| cell * cell % 11 % every != 0);
            let origins = cells.map(|cell| (IVec3::new(cell / 25, cell / 5 % 5, cell % 5) - 2) * LEAF_EDGE);
            let topology = Topology::new(origins.collect());
            for (leaf, &origin) in topology.origins().iter().enumerate() {
                for (slot, index) in topology.neighborhood(leaf).into_iter().enumerate() {
                    let step = IVec3::new(slot as i32 / 9, slot as i32 / 3 % 3, slot as i32 % 3) - IVec3::ONE;
                    let found = topology.find(origin + step * LEAF_EDGE);
                    assert_eq!(found.map_or(NO_LEAF, |found| found as u32), index);
                }
            }
        }
    }
}
