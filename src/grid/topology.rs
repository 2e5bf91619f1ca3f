//! Which leaves there are, in which order, and which are neighbours.

use glam::IVec3;
use rayon::prelude::*;
use rustc_hash::FxHashMap;

use super::leaf::LEAF_EDGE;

/// In place of a leaf's index: there is no leaf.
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

/// The leaves of a frame.
#[derive(Clone, Debug, Default)]
pub struct Topology {
    origins: Vec<IVec3>,
    neighbors: Vec<[u32; 6]>,
    index_of: FxHashMap<IVec3, u32>,
}

impl Topology {
    /// The topology of the leaves with these origins: multiples of 8, in any order, duplicates
    /// allowed.
    pub fn new(origins: Vec<IVec3>) -> Topology {
        debug_assert!(origins.iter().all(|origin| origin.rem_euclid(IVec3::splat(LEAF_EDGE)) == IVec3::ZERO));
        let mut places: Vec<u128> = origins.into_par_iter().map(tree_order).collect();
        places.par_sort_unstable();
        places.dedup();
        let origins: Vec<IVec3> = places.into_par_iter().map(origin_at).collect();
        assert!(origins.len() < NO_LEAF as usize, "more leaves than 32-bit indices");
        let index_of: FxHashMap<IVec3, u32> =
            origins.iter().enumerate().map(|(index, &origin)| (origin, index as u32)).collect();
        let neighbors = origins
            .par_iter()
            .map(|&origin| {
                FACE_STEPS.map(|step| index_of.get(&(origin + step * LEAF_EDGE)).copied().unwrap_or(NO_LEAF))
            })
            .collect();
        Topology { origins, neighbors, index_of }
    }

    /// The number of leaves.
    pub fn len(&self) -> usize {
        self.origins.len()
    }

    /// Whether there is no leaf.
    pub fn is_empty(&self) -> bool {
        self.origins.is_empty()
    }

    /// The origin (least voxel) of each leaf.
    pub fn origins(&self) -> &[IVec3] {
        &self.origins
    }

    /// For each leaf the leaves beyond its six faces, in the order of [`Direction`]; [`NO_LEAF`]
    /// where there is none.
    pub fn neighbors(&self) -> &[[u32; 6]] {
        &self.neighbors
    }

    /// The leaf with this origin.
    pub fn find(&self, origin: IVec3) -> Option<usize> {
        self.index_of.get(&origin).map(|&index| index as usize)
    }

    /// The leaf that holds a voxel, and the voxel relative to the leaf's origin.
    pub fn find_voxel(&self, voxel: IVec3) -> Option<(usize, IVec3)> {
        let local = voxel & IVec3::splat(LEAF_EDGE - 1);
        self.find(voxel - local).map(|leaf| (leaf, local))
    }
}

/// Unit steps through the six faces, in the order of [`Direction`].
pub const FACE_STEPS: [IVec3; 6] = [IVec3::NEG_X, IVec3::X, IVec3::NEG_Y, IVec3::Y, IVec3::NEG_Z, IVec3::Z];

/// The order of an OpenVDB tree's depth-first walk, as one number: root child (4096 voxels), lower
/// internal node (128), leaf, each in lexicographic order of x, y, z.
fn tree_order(origin: IVec3) -> u128 {
    // Shifting the sign bit makes signed order unsigned order.
    let [x, y, z] = origin.to_array().map(|axis| u128::from((axis as u32) ^ 0x8000_0000));
    let digits = |shift: u32, bits: u32| {
        let part = |axis: u128| axis >> shift & ((1 << bits) - 1);
        part(x) << (2 * bits) | part(y) << bits | part(z)
    };
    digits(12, 20) << 27 | digits(7, 5) << 12 | digits(3, 4)
}

/// The origin at a place in that order.
fn origin_at(place: u128) -> IVec3 {
    let axis = |axis: u32| {
        let digits =
            |shift: u32, bits: u32| (place >> (shift + (2 - axis) * bits)) as u32 & ((1 << bits) - 1);
        (digits(27, 20) << 12 | digits(12, 5) << 7 | digits(0, 4) << 3) ^ 0x8000_0000
    };
    IVec3::new(axis(0) as i32, axis(1) as i32, axis(2) as i32)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn leaves_are_sorted_as_a_vdb_tree_walks_them() {
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
}
