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
    pub fn new(mut origins: Vec<IVec3>) -> Topology {
        debug_assert!(origins.iter().all(|origin| origin.rem_euclid(IVec3::splat(LEAF_EDGE)) == IVec3::ZERO));
        origins.par_sort_unstable_by_key(|&origin| tree_order(origin));
        origins.dedup();
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

/// Unit steps through the six faces.
const FACE_STEPS: [IVec3; 6] = [IVec3::NEG_X, IVec3::X, IVec3::NEG_Y, IVec3::Y, IVec3::NEG_Z, IVec3::Z];

/// The order of an OpenVDB tree's depth-first walk: by root child (4096 voxels), then by lower
/// internal node (128), then by leaf, each in lexicographic order of x, y, z.
fn tree_order(origin: IVec3) -> [[i32; 3]; 3] {
    let corner = |log2_edge: i32| (origin >> IVec3::splat(log2_edge)).to_array();
    [corner(12), corner(7), corner(3)]
}
