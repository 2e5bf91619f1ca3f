//! Leaves that are worked on together, so that what is between two rounds of differences stays in a cache.
//!
//! ```text
//!     halo ▫▫▫▫▫▫         a cluster: some leaves that follow one another in the topology's order,
//!        ▫ ■■■■■■ ▫       and so lie side by side
//!        ▫ ■■■■■■ ▫
//!          ▫▫▫▫▫▫         its halo: their neighbours, of which one layer of voxels is needed
//! ```
//!
//! A pass of the biharmonic operator is two rounds of the same stencil. Taken over the whole frame, the
//! inner Laplacian of every leaf would be written to memory and read back. A cluster keeps it in scratch of
//! its own, as large as a core's cache, and computes that of its halo once more: a tenth of the work
//! for half of the traffic, and one loop a pass in place of two.

use std::ops::Range;

use rayon::prelude::*;

use super::band::Band;
use crate::surface::grid::{Direction, NO_LEAF, Topology};

/// Leaves in a cluster: their inner Laplacians take 128 kB of a core's cache, beside what is streamed.
const CLUSTER_LEAVES: usize = 64;

/// Some leaves and their halo.
pub(super) struct Cluster {
    /// The leaves.
    pub(super) leaves: Range<usize>,
    /// Leaves of others, and the rows of them that are needed: bit `x·8 + y`.
    pub(super) halo: Vec<(u32, u64)>,
    /// For each leaf the places of its six neighbours: in the cluster, then in its halo.
    pub(super) neighbors: Vec<[u32; 6]>,
}

impl Cluster {
    /// All leaves of a topology in clusters, those without a free voxel left out.
    pub(super) fn all(topology: &Topology, band: &Band) -> Vec<Cluster> {
        (0..topology.len().div_ceil(CLUSTER_LEAVES))
            .into_par_iter()
            .map(|index| {
                let first = index * CLUSTER_LEAVES;
                Cluster::new(topology, band, first..topology.len().min(first + CLUSTER_LEAVES))
            })
            .filter(|cluster| band.free_rows[cluster.leaves.clone()].iter().any(|&rows| rows != 0))
            .collect()
    }

    fn new(topology: &Topology, band: &Band, leaves: Range<usize>) -> Cluster {
        let mut cluster = Cluster { leaves: leaves.clone(), halo: Vec::new(), neighbors: Vec::new() };
        for leaf in leaves {
            let faces = topology.neighbors()[leaf];
            let places = std::array::from_fn(|face| {
                if faces[face] == NO_LEAF {
                    NO_LEAF
                } else {
                    cluster.place(faces[face], needed_rows(band, leaf, face))
                }
            });
            cluster.neighbors.push(places);
        }
        cluster
    }

    /// Where a neighbour is, of which these rows are needed.
    fn place(&mut self, neighbor: u32, rows: u64) -> u32 {
        if self.leaves.contains(&(neighbor as usize)) {
            return neighbor - self.leaves.start as u32;
        }
        let known = self.halo.iter().position(|&(leaf, _)| leaf == neighbor);
        let place = known.unwrap_or_else(|| {
            self.halo.push((neighbor, 0));
            self.halo.len() - 1
        });
        self.halo[place].1 |= rows;
        (self.leaves.len() + place) as u32
    }
}

/// The rows of the neighbour beyond a face that touch free rows of a leaf.
fn needed_rows(band: &Band, leaf: usize, face: usize) -> u64 {
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
