//! Turns distances to the nearest center into the signed distance to a union of spheres.
//!
//! ```text
//!    nearest − r       known: outside, and inside next to an outside voxel
//!   ────╮              swept: deeper inside, where the nearest center does not determine the depth,
//!       ╰──╮                  and beyond the reach of distances
//!   swept  ╰──────
//! ```

use rayon::prelude::*;

use super::distances::{SphereDistances, SphereUnion};
use super::sphere::OUT_OF_REACH;
use super::{Radii, sweep_count};
use crate::grid::{Field, Leaf, LeafMask, NO_LEAF, ROW_COUNT, Topology};
use crate::level_set::{Sweeps, UNREACHED, extend_in};
use crate::parallel::Loops as _;
use crate::simd::{self, Kernel, Lanes};

/// The signed distance to one of the unions, swept up to the half width; values beyond it are only
/// approximate. The last union that needs a field of distances reuses its memory, so request the unions in
/// the order S_0, S_max, S_min. `scratch` is memory for the sweeps: a field with arbitrary content.
pub(super) fn signed_distance(
    topology: &Topology,
    distances: &mut SphereDistances,
    sphere: SphereUnion,
    radii: Radii,
    scratch: &mut Field,
) -> Field {
    let level = distances.level(sphere, radii);
    let known = known_voxels(topology, distances, sphere, radii);
    let mut field = if distances.is_last(sphere) {
        let mut field = distances.take(sphere);
        field.leaves.par_iter_mut().zip(&known).halved().for_each(|(leaf, known)| {
            *leaf = simd::dispatch(SignedDistance { values: leaf, known, level });
        });
        field
    } else {
        let of_leaf = |(values, known)| simd::dispatch(SignedDistance { values, known, level });
        let leaves = distances.field(sphere).leaves.par_iter().zip(&known).halved().map(of_leaf).collect();
        Field { leaves }
    };
    let half_width = radii.half_width();
    let sweeps = Sweeps::accurate(sweep_count(half_width)).clamped(half_width);
    extend_in(topology, &mut field, &known, sweeps, scratch);
    field
}

/// The voxels whose signed distance is known. A missing neighbor leaf counts as lying on the same side of the
/// surface.
fn known_voxels(
    topology: &Topology,
    distances: &SphereDistances,
    sphere: SphereUnion,
    radii: Radii,
) -> Vec<LeafMask> {
    let inside = distances.inside(sphere, radii);
    let values = distances.field(sphere);
    let of_side = |mut side: LeafMask, leaf: usize, of: &dyn Fn(u32) -> LeafMask| {
        let faces = topology.neighbors()[leaf].map(of);
        side.remove_all(&side.surrounded(faces.each_ref()));
        side
    };
    let known = |leaf: usize| {
        let adjacent = of_side(inside[leaf], leaf, &|neighbor| match neighbor {
            NO_LEAF => LeafMask::FULL,
            neighbor => inside[neighbor as usize],
        });
        let outside = |leaf: usize| inside[leaf].complement();
        let known_outside = if distances.is_exact_outside() {
            let mut within_reach = simd::dispatch(Below { leaf: &values.leaves[leaf], limit: OUT_OF_REACH });
            within_reach.remove_all(&inside[leaf]);
            within_reach
        } else {
            of_side(outside(leaf), leaf, &|neighbor| match neighbor {
                NO_LEAF => LeafMask::FULL,
                neighbor => outside(neighbor as usize),
            })
        };
        adjacent.or(&known_outside)
    };
    (0..topology.len()).into_par_iter().halved().map(known).collect()
}

/// Kernel: the voxels with a value below a limit.
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

/// Kernel: signed distances of the voxels where they are known, and the sign of the others.
struct SignedDistance<'a> {
    values: &'a Leaf,
    known: &'a LeafMask,
    level: f32,
}

impl Kernel for SignedDistance<'_> {
    type Output = Leaf;

    #[inline(always)]
    fn run<V: Lanes>(self) -> Leaf {
        let level = V::splat(self.level);
        let mut leaf = Leaf::splat(0.0);
        for row in 0..ROW_COUNT {
            let values = V::load(self.values.row(row));
            // Infinite values are outside, too: no particle is within the reach of distances.
            let side = V::select(values.lt(level), V::splat(-UNREACHED), V::splat(UNREACHED));
            let is_known = V::mask(self.known.row(row));
            V::select(is_known, values.sub(level), side).store(leaf.row_mut(row));
        }
        leaf
    }
}
