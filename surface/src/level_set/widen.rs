//! Widens a narrow band.
//!
//! ```text
//!   before   +3 | +3 +2 +1  0 −1 −2 −3 | −3       stored by another program, 3 voxels to each side
//!   after    +6 … +3 +2 +1  0 −1 −2 −3 … −6       the stored leaves and the leaves around them
//! ```
//!
//! Voxels that are not stored are on the same side as the adjacent stored ones: if the surface passed between
//! them, their leaf would be stored. Redistancing then restores distances from the zero set, as between
//! smoothing steps. It moves the zero set by only a few thousandths of a voxel.

use glam::IVec3;
use rayon::prelude::*;
use rustc_hash::FxHashMap;

use super::{NarrowBand, Sweeps, redistance};
use crate::grid::{Field, LEAF_EDGE, Leaf, Topology, offset_in_leaf};
use crate::parallel::Loops as _;

/// Maximum half width, in voxels: one layer of leaves around the leaves with a crossing contains such a band.
pub const WIDENED_MAX: f32 = LEAF_EDGE as f32;

/// A leaf has a crossing if one of its voxels is nearer to the surface than this, in voxels.
const NEAR: f32 = 2.0;

/// The same surface in a band of this half width, at most [`WIDENED_MAX`], with distances restored.
pub fn widened(band: &NarrowBand, half_width: f32) -> NarrowBand {
    let half_width = half_width.min(WIDENED_MAX);
    let stored = band.topology.origins();
    let around = stored
        .par_iter()
        .zip(&band.phi.leaves)
        .halved()
        .filter(|(_, leaf)| has_surface(band, leaf))
        .flat_map_iter(|(&origin, _)| around(origin));
    let origins: Vec<IVec3> = stored.par_iter().copied().halved().chain(around).collect();
    let topology = Topology::new(origins);
    let mut phi = Field::splat(topology.len(), half_width);
    phi.leaves.par_iter_mut().zip(topology.origins()).halved().for_each(|(leaf, &origin)| {
        match band.topology.find(origin) {
            Some(index) => *leaf = band.phi.leaves[index],
            None => leaf.values.fill(half_width.copysign(side_of(band, origin))),
        }
    });
    let mut widened = NarrowBand { topology: topology.into(), phi, half_width };
    // Each sweep advances one voxel along the axes. Along a diagonal, a distance d takes √3 d such steps.
    redistance(&mut widened, Sweeps::accurate((3f32.sqrt() * half_width).ceil() as u32));
    widened
}

/// Number of leaves of the widened band.
pub fn widened_leaf_count(band: &NarrowBand) -> usize {
    let leaves = band.topology.origins().iter().zip(&band.phi.leaves);
    leaf_count_with_neighbors(leaves.map(|(&origin, leaf)| (origin, has_surface(band, leaf))))
}

/// Upper limit of the number of leaves of the widened band, for leaves whose values are unknown.
pub fn widened_leaf_count_max(origins: impl Iterator<Item = IVec3>) -> usize {
    leaf_count_with_neighbors(origins.map(|origin| (origin, true)))
}

/// Number of leaves with these origins, and around those of them that are marked, counted with one bit per
/// leaf.
fn leaf_count_with_neighbors(leaves: impl Iterator<Item = (IVec3, bool)>) -> usize {
    const NODE_LEAVES: i32 = 16;
    let mut nodes: FxHashMap<IVec3, [u64; 64]> = FxHashMap::default();
    let mut insert = |origin: IVec3| {
        let leaf = origin.div_euclid(IVec3::splat(LEAF_EDGE));
        let [x, y, z] = (leaf & (NODE_LEAVES - 1)).to_array().map(|c| c as usize);
        let words = nodes.entry(leaf.div_euclid(IVec3::splat(NODE_LEAVES))).or_insert([0; 64]);
        words[x * 4 + y / 4] |= 1 << (y % 4 * 16 + z);
    };
    for (origin, is_marked) in leaves {
        insert(origin);
        if is_marked {
            around(origin).for_each(&mut insert);
        }
    }
    nodes.values().flatten().map(|word| word.count_ones() as usize).sum()
}

/// True if a voxel of a leaf is so near to the surface that a widened band extends into the leaves around.
fn has_surface(band: &NarrowBand, leaf: &Leaf) -> bool {
    let near = NEAR.min(band.half_width);
    leaf.values.iter().any(|phi| phi.abs() < near)
}

/// The origins of a leaf and its 26 neighbors.
fn around(origin: IVec3) -> impl Iterator<Item = IVec3> {
    steps().map(move |step| origin + step * LEAF_EDGE)
}

/// A value with the sign of a leaf that is not stored but adjacent to a stored one.
fn side_of(band: &NarrowBand, origin: IVec3) -> f32 {
    let mut nearest: Vec<IVec3> = steps().filter(|&step| step != IVec3::ZERO).collect();
    nearest.sort_by_key(|step| step.abs().element_sum());
    let found = nearest.into_iter().find_map(|step| {
        let leaf = band.topology.find(origin + step * LEAF_EDGE)?;
        // The voxel of the stored leaf that is adjacent to the leaf at `origin`.
        let local = step.to_array().map(|along| match along {
            -1 => LEAF_EDGE - 1,
            1 => 0,
            _ => LEAF_EDGE / 2,
        });
        Some(band.phi.leaves[leaf].values[offset_in_leaf(IVec3::from(local))])
    });
    found.unwrap_or(band.half_width)
}

/// The steps to a leaf and its 26 neighbors.
fn steps() -> impl Iterator<Item = IVec3> {
    (0..27).map(|slot| IVec3::new(slot / 9, slot / 3 % 3, slot % 3) - IVec3::ONE)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::grid::voxel_in_leaf;

    /// A ball of this radius in voxels, stored where the surface is within the half width.
    fn ball(radius: f32, half_width: f32) -> NarrowBand {
        let phi = |voxel: IVec3| (voxel.as_vec3().length() - radius).clamp(-half_width, half_width);
        let leaves =
            (-4..4).flat_map(|x| (-4..4).flat_map(move |y| (-4..4).map(move |z| IVec3::new(x, y, z))));
        let values = |origin: IVec3| -> Vec<f32> {
            (0..512).map(|offset| phi(origin + voxel_in_leaf(offset))).collect()
        };
        let is_stored = |origin: &IVec3| values(*origin).iter().any(|phi| phi.abs() < half_width);
        let topology = Topology::new(leaves.map(|leaf| leaf * LEAF_EDGE).filter(is_stored).collect());
        let mut field = Field::splat(topology.len(), half_width);
        for (leaf, &origin) in field.leaves.iter_mut().zip(topology.origins()) {
            leaf.values.copy_from_slice(&values(origin));
        }
        NarrowBand { topology: topology.into(), phi: field, half_width }
    }

    #[test]
    fn widened_band_extends_on_both_sides() {
        // In a band of 1.5 voxels, some corners of the cells with the surface are already missing.
        for (narrow, most) in [(1.5, 0.25), (2.0, 0.02), (3.0, 0.02)] {
            let wide = widened(&ball(18.3, narrow), 6.0);
            assert!(wide.topology.len() > ball(18.3, narrow).topology.len());
            let narrow = ball(18.3, narrow);
            assert_eq!(widened_leaf_count(&narrow), wide.topology.len());
            let limit = widened_leaf_count_max(narrow.topology.origins().iter().copied());
            assert!((wide.topology.len()..2 * wide.topology.len()).contains(&limit), "{limit}");
            let (mut near, mut far) = (0, 0);
            for (leaf, &origin) in wide.phi.leaves.iter().zip(wide.topology.origins()) {
                for (offset, &phi) in leaf.values.iter().enumerate() {
                    let exact = (origin + voxel_in_leaf(offset)).as_vec3().length() - 18.3;
                    if exact.abs() < 5.5 {
                        near += 1;
                        assert!((phi - exact).abs() < most, "{phi} {exact}");
                    } else if exact.abs() > 7.0 {
                        far += 1;
                        assert_eq!(phi, 6f32.copysign(exact), "{exact}");
                    }
                }
            }
            // The whole shell is stored.
            let shell = 4.0 * std::f32::consts::PI * 18.3f32.powi(2) * 11.0;
            assert!(near as f32 > 0.98 * shell && far > 1000, "{near} {far}");
        }
    }
}
