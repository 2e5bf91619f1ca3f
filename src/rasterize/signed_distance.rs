//! From the distance to the nearest centre to the signed distance to a union of spheres.
//!
//! ```text
//!    nearest − r       known: outside, and inside beside an outside voxel
//!   ────╮              swept: farther inside, where the nearest centre tells nothing of the depth,
//!       ╰──╮                  and beyond the reach of distances
//!   swept  ╰──────
//! ```

use rayon::prelude::*;

use super::sphere::OUT_OF_REACH;
use super::sweep_count;
use crate::grid::{Field, Leaf, LeafMask, NO_LEAF, ROW_COUNT, Topology};
use crate::level_set::{Sweeps, UNREACHED, extend};
use crate::simd::{self, Kernel, Lanes};

/// The signed distance to the union of spheres of this radius, swept as far as the half width; farther values
/// are those of some place between.
pub(super) fn signed_distance(topology: &Topology, nearest: &Field, radius: f32, half_width: f32) -> Field {
    let known = known_voxels(topology, nearest, radius);
    let of_leaf = |(nearest, known)| simd::dispatch(SignedDistance { nearest, known, radius });
    let leaves = nearest.leaves.par_iter().zip(&known).map(of_leaf).collect();
    swept(topology, Field { leaves }, &known, half_width)
}

/// The same in place of the distances to the nearest centres, which nobody needs any more.
pub(super) fn into_signed_distance(
    topology: &Topology,
    mut nearest: Field,
    radius: f32,
    half_width: f32,
) -> Field {
    let known = known_voxels(topology, &nearest, radius);
    nearest.leaves.par_iter_mut().zip(&known).for_each(|(leaf, known)| {
        *leaf = simd::dispatch(SignedDistance { nearest: leaf, known, radius });
    });
    swept(topology, nearest, &known, half_width)
}

fn swept(topology: &Topology, mut distance: Field, known: &[LeafMask], half_width: f32) -> Field {
    extend(topology, &mut distance, known, Sweeps::accurate(sweep_count(half_width)));
    distance
}

/// The voxels whose signed distance the nearest centre tells. Where a leaf is not stored, nothing is beside it.
fn known_voxels(topology: &Topology, nearest: &Field, radius: f32) -> Vec<LeafMask> {
    let inside: Vec<LeafMask> =
        nearest.leaves.par_iter().map(|leaf| simd::dispatch(Below { leaf, limit: radius })).collect();
    let known = |(leaf, neighbors): (usize, &[u32; 6])| {
        let face = |neighbor: u32| match neighbor {
            NO_LEAF => &LeafMask::FULL,
            neighbor => &inside[neighbor as usize],
        };
        let deep = inside[leaf].surrounded(neighbors.map(face));
        let mut known = simd::dispatch(Below { leaf: &nearest.leaves[leaf], limit: OUT_OF_REACH });
        known.remove_all(&deep);
        known
    };
    topology.neighbors().par_iter().enumerate().map(known).collect()
}

/// Finds the voxels with less than a limit.
pub(super) struct Below<'a> {
    pub(super) leaf: &'a Leaf,
    pub(super) limit: f32,
}

impl Kernel for Below<'_> {
    type Output = LeafMask;

    #[inline(always)]
    fn run<V: Lanes>(self) -> LeafMask {
        let limit = V::splat(self.limit);
        let mut below = LeafMask::EMPTY;
        for (x, word) in below.words.iter_mut().enumerate() {
            let mut rows = [0; 8];
            for (y, bits) in rows.iter_mut().enumerate() {
                *bits = V::bits(V::load(self.leaf.row(x * 8 + y)).lt(limit));
            }
            *word = u64::from_le_bytes(rows);
        }
        below
    }
}

/// Signed distances of the voxels where they are known; of the others the side.
struct SignedDistance<'a> {
    nearest: &'a Leaf,
    known: &'a LeafMask,
    radius: f32,
}

impl Kernel for SignedDistance<'_> {
    type Output = Leaf;

    #[inline(always)]
    fn run<V: Lanes>(self) -> Leaf {
        let radius = V::splat(self.radius);
        let mut leaf = Leaf::splat(0.0);
        for row in 0..ROW_COUNT {
            let nearest = V::load(self.nearest.row(row));
            // What is out of reach is as far from the spheres.
            let side = V::select(nearest.lt(radius), V::splat(-UNREACHED), V::splat(UNREACHED));
            let is_known = V::mask(self.known.row(row));
            V::select(is_known, nearest.sub(radius), side).store(leaf.row_mut(row));
        }
        leaf
    }
}
