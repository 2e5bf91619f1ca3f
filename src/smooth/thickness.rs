//! Where the free region is so thick that a step converges slowly.
//!
//! The free voxels of a step are a layer along the surface, about six voxels thick, between values that
//! are held. What can bend in there has a wavelength of that size, and so an eigenvalue of at least
//! 1 + (4.73/6.5)⁴·Δt: that of a plate clamped on both sides. Only where surfaces come close, as in spray and
//! thin sheets, do their layers merge into something thicker, in which slow modes live.
//!
//! ```text
//!   held ──────────      ────────╮  ╭────────
//!   free ▒▒▒▒▒▒▒▒▒▒      ▒▒▒▒▒▒▒▒╰▒▒╯▒▒▒▒▒▒▒▒
//!        ~~surface~      ~surface~▒▒~surface~       the middle of this is more than four voxels from
//!   free ▒▒▒▒▒▒▒▒▒▒      ▒▒▒▒▒▒▒▒╭▒▒╮▒▒▒▒▒▒▒▒       anything held: a deep voxel
//!   held ──────────      ────────╯  ╰────────
//! ```
//!
//! Deep voxels are those that four erosions leave, by turns with a cross and with a cube, which together come
//! close to a ball.

use rayon::prelude::*;

use crate::grid::{LEAF_EDGE, LeafMask, NO_LEAF, Topology};

/// How far from a voxel of a leaf the voxels are, at most, that decide whether the leaf is thick: across the
/// leaf and the one beside it, and as far as the erosions reach.
pub(super) const THICKNESS_REACH: u32 = 2 * LEAF_EDGE as u32 + 4;

/// For each leaf whether it, or a leaf beyond one of its faces, holds a deep voxel.
pub(super) fn thick_leaves(topology: &Topology, free: &[LeafMask]) -> Vec<bool> {
    let mut left = free.to_vec();
    for _ in 0..2 {
        left = eroded(topology, &left, &[0, 1, 2]);
        for axis in 0..3 {
            left = eroded(topology, &left, &[axis]);
        }
    }
    let is_deep = |leaf: u32| leaf != NO_LEAF && !left[leaf as usize].is_empty();
    let neighbors = topology.neighbors().par_iter().enumerate();
    neighbors.map(|(leaf, faces)| is_deep(leaf as u32) || faces.iter().any(|&face| is_deep(face))).collect()
}

/// The voxels whose neighbours along these axes are in the masks, too.
fn eroded(topology: &Topology, masks: &[LeafMask], axes: &[usize]) -> Vec<LeafMask> {
    let erode = |(leaf, mask): (usize, &LeafMask)| {
        if mask.is_empty() {
            return *mask;
        }
        let face = |face: usize| match topology.neighbors()[leaf][face] {
            NO_LEAF => LeafMask::EMPTY,
            neighbor => masks[neighbor as usize],
        };
        axes.iter().fold(*mask, |left, &axis| {
            let [before, after] = mask.shifted(axis, &face(2 * axis), &face(2 * axis + 1));
            left.and(&before).and(&after)
        })
    };
    masks.par_iter().enumerate().map(erode).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::IVec3;

    /// Which leaves of a block of 4³ are thick where the free voxels are those that satisfy `is_free`.
    fn thick_count(is_free: impl Fn(IVec3) -> bool) -> usize {
        let origins = (0..64).map(|leaf| IVec3::new(leaf >> 4, leaf >> 2 & 3, leaf & 3) * 8).collect();
        let topology = Topology::new(origins);
        let free: Vec<LeafMask> = topology
            .origins()
            .iter()
            .map(|&origin| LeafMask::from_fn(|offset| is_free(origin + crate::grid::voxel_in_leaf(offset))))
            .collect();
        thick_leaves(&topology, &free).into_iter().filter(|&thick| thick).count()
    }

    #[test]
    fn a_single_layer_is_thin_in_every_direction_and_a_double_one_is_thick() {
        for normal in [[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [1.0, 1.0, 0.0], [1.0, 1.0, 1.0], [1.0, -2.0, 3.0]] {
            let normal = glam::Vec3::from(normal).normalize();
            let depth = |voxel: IVec3| normal.dot(voxel.as_vec3() - 15.6).abs();
            assert_eq!(thick_count(|voxel| depth(voxel) <= 3.0), 0, "{normal}");
            assert!(thick_count(|voxel| depth(voxel) <= 6.0) > 0, "{normal}");
        }
    }
}
