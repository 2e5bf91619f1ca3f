//! Cache blocking: leaves processed together so that the inner Laplacian stays in the cache.
//!
//! ```text
//!     halo ▫▫▫▫▫▫         block: consecutive leaves in the topology's order, which are also
//!        ▫ ■■■■■■ ▫       neighbors in space
//!        ▫ ■■■■■■ ▫
//!          ▫▫▫▫▫▫         halo: their neighbors, of which one layer of voxels is needed
//! ```
//!
//! The biharmonic operator applies the same stencil twice. Applied to the whole frame, the inner Laplacian of
//! every leaf would be written to memory and read back. A block keeps it in scratch memory that fits into a
//! core's cache, and computes the halo's Laplacian redundantly. That is a tenth more work for half the memory
//! traffic, and one loop per pass instead of two.

use std::ops::Range;

use rayon::prelude::*;

use super::free_voxels::FreeVoxels;
use crate::grid::{Direction, NO_LEAF, Topology};
use crate::parallel::Loops as _;

/// Leaves per block: their inner Laplacians take 128 kB of a core's cache, beside the streamed fields.
const BLOCK_LEAVES: usize = 64;

/// Some leaves and their halo.
pub(super) struct CacheBlock {
    /// The leaves.
    pub(super) leaves: Range<usize>,
    /// Leaves outside the block, with a mask of the required rows: bit `x·8 + y`.
    pub(super) halo: Vec<(u32, u64)>,
    /// For each leaf, the local indices of its six neighbors: block leaves first, then halo leaves.
    pub(super) neighbors: Vec<[u32; 6]>,
}

impl CacheBlock {
    /// Splits a topology into blocks, without leaves that have no free voxel.
    pub(super) fn all(topology: &Topology, band: &FreeVoxels) -> Vec<CacheBlock> {
        (0..topology.len().div_ceil(BLOCK_LEAVES))
            .into_par_iter()
            .halved()
            .map(|index| {
                let first = index * BLOCK_LEAVES;
                CacheBlock::new(topology, band, first..topology.len().min(first + BLOCK_LEAVES))
            })
            .filter(|block| band.free_rows[block.leaves.clone()].iter().any(|&rows| rows != 0))
            .collect()
    }

    fn new(topology: &Topology, band: &FreeVoxels, leaves: Range<usize>) -> CacheBlock {
        let mut block = CacheBlock { leaves: leaves.clone(), halo: Vec::new(), neighbors: Vec::new() };
        for leaf in leaves {
            let faces = topology.neighbors()[leaf];
            let indices = std::array::from_fn(|face| {
                if faces[face] == NO_LEAF {
                    NO_LEAF
                } else {
                    block.local_index(faces[face], needed_rows(band, leaf, face))
                }
            });
            block.neighbors.push(indices);
        }
        block
    }

    /// The local index of a neighbor leaf; adds these rows of it to the halo if it is outside the block.
    fn local_index(&mut self, neighbor: u32, rows: u64) -> u32 {
        if self.leaves.contains(&(neighbor as usize)) {
            return neighbor - self.leaves.start as u32;
        }
        let known = self.halo.iter().position(|&(leaf, _)| leaf == neighbor);
        let local_index = known.unwrap_or_else(|| {
            self.halo.push((neighbor, 0));
            self.halo.len() - 1
        });
        self.halo[local_index].1 |= rows;
        (self.leaves.len() + local_index) as u32
    }
}

/// The rows of the neighbor beyond a face that touch free rows of a leaf.
fn needed_rows(band: &FreeVoxels, leaf: usize, face: usize) -> u64 {
    const FIRST_Y: u64 = 0x0101_0101_0101_0101;
    let free = band.free_rows[leaf];
    match face {
        face if face == Direction::XMinus as usize => free << 56,
        face if face == Direction::XPlus as usize => free >> 56,
        face if face == Direction::YMinus as usize => (free & FIRST_Y) << 7,
        face if face == Direction::YPlus as usize => free >> 7 & FIRST_Y,
        face if face == Direction::ZMinus as usize => band.free[leaf].rows_with(0x01),
        _ => band.free[leaf].rows_with(0x80),
    }
}
