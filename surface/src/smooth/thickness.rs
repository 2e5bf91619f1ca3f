//! Finds where the free region is so thick that a step converges slowly.
//!
//! The free voxels of a step are a layer along the surface, about six voxels thick, between fixed values.
//! Modes that fit into this layer have a wavelength of about its thickness, and therefore an eigenvalue of at
//! least 1 + (4.73/6.5)⁴·Δt, like a plate clamped on both sides. Only where surfaces come close, as in spray
//! and thin sheets, do their layers merge into a thicker region, which has slow modes.
//!
//! ```text
//!   fixed ──────────      ────────╮  ╭────────
//!   free  ▒▒▒▒▒▒▒▒▒▒      ▒▒▒▒▒▒▒▒╰▒▒╯▒▒▒▒▒▒▒▒
//!         ~~surface~      ~surface~▒▒~surface~       the middle is more than four voxels from any fixed
//!   free  ▒▒▒▒▒▒▒▒▒▒      ▒▒▒▒▒▒▒▒╭▒▒╮▒▒▒▒▒▒▒▒       voxel: a deep voxel
//!   fixed ──────────      ────────╯  ╰────────
//! ```
//!
//! Deep voxels remain after four erosions, alternating between a cross and a cube, which together approximate
//! a ball. Voxels around deep ones count as thick. The test is per voxel and does not depend on leaf
//! boundaries.

use rayon::prelude::*;

use crate::grid::{LeafMask, NO_LEAF, Topology};
use crate::parallel::Loops as _;

/// Voxels within this distance of a deep one, per axis, count as thick. Deep voxels are more than four from
/// fixed ones.
const AROUND_DEEP: usize = 6;

/// Maximum distance of the voxels that affect whether a voxel is thick.
pub(super) const THICKNESS_REACH: u32 = AROUND_DEEP as u32 + 4;

/// The free voxels that are thick.
pub(super) fn thick(topology: &Topology, free: &[LeafMask]) -> Vec<LeafMask> {
    let mut left = free.to_vec();
    for axes in [&[0, 1, 2][..], &[0], &[1], &[2], &[0, 1, 2], &[0], &[1], &[2]] {
        left = with_neighbors(topology, &left, axes, 1, LeafMask::and);
    }
    if left.par_iter().halved().all(LeafMask::is_empty) {
        return left;
    }
    for axis in 0..3 {
        left = with_neighbors(topology, &left, &[axis], AROUND_DEEP, LeafMask::or);
    }
    left.par_iter().zip(free).halved().map(|(near_deep, free)| near_deep.and(free)).collect()
}

/// Joins each mask with copies of itself shifted along these axes, in both directions and by up to `steps`.
pub(super) fn with_neighbors(
    topology: &Topology,
    masks: &[LeafMask],
    axes: &[usize],
    steps: usize,
    join: impl Fn(&LeafMask, &LeafMask) -> LeafMask + Sync,
) -> Vec<LeafMask> {
    let joined = |(leaf, mask): (usize, &LeafMask)| {
        let beyond = |face: usize| match topology.neighbors()[leaf][face] {
            NO_LEAF => LeafMask::EMPTY,
            neighbor => masks[neighbor as usize],
        };
        let mut all = *mask;
        for &axis in axes {
            let (before, after) = (beyond(2 * axis), beyond(2 * axis + 1));
            for steps in 1..=steps {
                let [one, other] = mask.shifted(axis, steps, &before, &after);
                all = join(&join(&all, &one), &other);
            }
        }
        all
    };
    masks.par_iter().enumerate().halved().map(joined).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::IVec3;

    /// Number of thick voxels in a block of 4³ leaves whose free voxels are those that satisfy `is_free`.
    fn thick_count(is_free: impl Fn(IVec3) -> bool) -> usize {
        let origins = (0..64).map(|leaf| IVec3::new(leaf >> 4, leaf >> 2 & 3, leaf & 3) * 8).collect();
        let topology = Topology::new(origins);
        let free: Vec<LeafMask> = topology
            .origins()
            .iter()
            .map(|&origin| LeafMask::from_fn(|offset| is_free(origin + crate::grid::voxel_in_leaf(offset))))
            .collect();
        thick(&topology, &free).iter().map(|mask| mask.count() as usize).sum()
    }

    #[test]
    fn single_layer_is_thin_and_double_layer_is_thick() {
        for normal in [[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [1.0, 1.0, 0.0], [1.0, 1.0, 1.0], [1.0, -2.0, 3.0]] {
            let normal = glam::Vec3::from(normal).normalize();
            let depth = |voxel: IVec3| normal.dot(voxel.as_vec3() - 15.6).abs();
            assert_eq!(thick_count(|voxel| depth(voxel) <= 3.0), 0, "{normal}");
            assert!(thick_count(|voxel| depth(voxel) <= 6.0) > 0, "{normal}");
        }
    }
}
