//! Updates distances where voxels changed sides.
//!
//! ```text
//!   before     2  1  ●  ●  1  2  3  3  2  1  ●      ● inside: island (left), remaining fluid (right)
//!   after      ∞  ∞  ∞  ∞  6  5  4  3  2 [1] ●      distances to the remaining fluid; ∞ is beyond the band,
//!                                                   and [1] keeps its value
//! ```
//!
//! A cavity is filled in the same way, with inside and outside swapped.
//!
//! Flipping a component can only increase the distances around it. So the distances within the band's half
//! width of the component are swept again. The sweep starts from the voxels beyond that range and from the
//! voxels next to the remaining surface. Both keep their values, so the remaining surface does not move. Each
//! swept voxel gets the larger of its old and its new distance.

use std::collections::BTreeMap;

use glam::IVec3;
use rayon::prelude::*;

use crate::grid::{FACE_STEPS, Field, LEAF_EDGE, Leaf, LeafMask, NO_LEAF, Topology, voxel_in_leaf};
use crate::level_set::{NarrowBand, Sweeps, UNREACHED, extend};
use crate::parallel::Loops as _;
use crate::space::CoordBox;

/// A side of the surface.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum FlipSide {
    /// φ < 0.
    Inside,
    /// φ ≥ 0.
    Outside,
}

/// Moves whole components from the other side to `side`. `flipped` has a mask of their voxels for each leaf,
/// in the order of leaves.
pub(super) fn flip(band: &mut NarrowBand, flipped: &[(usize, LeafMask)], side: FlipSide) {
    if flipped.is_empty() {
        return;
    }
    for SweptLeaf { leaf, mask, phi: swept } in sweep(band, flipped, side) {
        let phi = &mut band.phi.leaves[leaf];
        for offset in mask.iter() {
            let distance = swept.values[offset].abs().min(band.half_width);
            let old = &mut phi.values[offset];
            // A voxel that was on the other side always gets the new distance, because its old φ has the
            // other sign.
            *old = match side {
                FlipSide::Inside => old.min(-distance),
                FlipSide::Outside => old.max(distance),
            }
        }
    }
}

/// The voxels near flipped ones, by leaf: the boxes around each leaf's flipped voxels, plus the half width.
fn near_flipped(band: &NarrowBand, flipped: &[(usize, LeafMask)]) -> BTreeMap<usize, LeafMask> {
    let reach = band.half_width.ceil() as i32 + 1;
    let mut near: BTreeMap<usize, LeafMask> = BTreeMap::new();
    for (leaf, mask) in flipped {
        let origin = band.topology.origins()[*leaf];
        let voxels = mask.bounding_box().expanded(reach);
        let [first, last]: [IVec3; 2] = [voxels.min >> 3, voxels.max >> 3];
        for x in first.x..=last.x {
            for y in first.y..=last.y {
                for z in first.z..=last.z {
                    let step = IVec3::new(x, y, z) * LEAF_EDGE;
                    if let Some(other) = band.topology.find(origin.wrapping_add(step)) {
                        let mask = near.entry(other).or_insert(LeafMask::EMPTY);
                        *mask = mask.or(&box_mask(&voxels, step));
                    }
                }
            }
        }
    }
    near
}

/// The voxels in a box of the leaf with this origin, both relative to the same leaf.
fn box_mask(voxels: &CoordBox, origin: IVec3) -> LeafMask {
    LeafMask::from_fn(|offset| voxels.contains(origin + voxel_in_leaf(offset)))
}

/// A leaf of the band after sweeping.
struct SweptLeaf {
    leaf: usize,
    /// The swept voxels.
    mask: LeafMask,
    phi: Leaf,
}

/// Sweeps the distances around the flipped voxels.
fn sweep(band: &NarrowBand, flipped: &[(usize, LeafMask)], side: FlipSide) -> Vec<SweptLeaf> {
    let near = near_flipped(band, flipped);
    let origins = band.topology.origins();
    let around = |(&leaf, _): (&usize, &LeafMask)| {
        let faces = FACE_STEPS.map(|step| origins[leaf].wrapping_add(step * LEAF_EDGE));
        faces.into_iter().filter(|&face| band.topology.find(face).is_some()).chain([origins[leaf]])
    };
    let topology = Topology::new(near.iter().flat_map(around).collect());
    let of_band: Vec<usize> = topology.origins().iter().filter_map(|&o| band.topology.find(o)).collect();
    let flipped_in = |leaf: usize| {
        let index = flipped.binary_search_by_key(&leaf, |(leaf, _)| *leaf);
        index.map_or(LeafMask::EMPTY, |index| flipped[index].1)
    };
    // The voxels that are on `side` after the flip.
    let is_on_side = |phi: f32| (phi < 0.0) == (side == FlipSide::Inside);
    let on_side = |&leaf: &usize| {
        let values = &band.phi.leaves[leaf].values;
        LeafMask::from_fn(|offset| is_on_side(values[offset])).or(&flipped_in(leaf))
    };
    let on_side: Vec<LeafMask> = of_band.par_iter().halved().map(on_side).collect();
    let free = |index: usize| {
        let near = near.get(&of_band[index]).copied().unwrap_or(LeafMask::EMPTY);
        let on_side_in = |neighbor: u32| match neighbor {
            NO_LEAF => &LeafMask::FULL,
            leaf => &on_side[leaf as usize],
        };
        on_side[index].surrounded(topology.neighbors()[index].map(on_side_in)).and(&near)
    };
    let free: Vec<LeafMask> = (0..of_band.len()).into_par_iter().halved().map(free).collect();
    let start = if side == FlipSide::Inside { -UNREACHED } else { UNREACHED };
    let values = |(&leaf, free): (&usize, &LeafMask)| {
        let mut values = band.phi.leaves[leaf];
        free.iter().for_each(|offset| values.values[offset] = start);
        values
    };
    let mut distance = Field { leaves: of_band.iter().zip(&free).map(values).collect() };
    let fixed: Vec<LeafMask> = free.iter().map(LeafMask::complement).collect();
    // Each sweep advances one voxel along the axes. Along a diagonal, a distance d takes √3 d such steps.
    let sweeps = Sweeps::accurate((3f32.sqrt() * band.half_width).ceil() as u32);
    extend(&topology, &mut distance, &fixed, sweeps);
    let leaves = of_band.into_iter().zip(free).zip(distance.leaves);
    leaves.map(|((leaf, mask), phi)| SweptLeaf { leaf, mask, phi }).collect()
}
