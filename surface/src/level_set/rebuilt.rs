//! Rebuilds the distances of a level set whose file has only signs, without distances, next to the surface.
//!
//! ```text
//!   a sign function    +3 +3 +3 | −3 −3 −3          the surface is placed midway between the voxels
//!   half a band        +2.4 +1.4 +0.4 | −3 −3       the surface is placed by the value on the other side
//!   tiles only         outside tile | inside tile   the surface is placed on their common face
//!   rebuilt            +2.5 +1.5 +0.5 | −0.5 −1.5 −2.5
//! ```
//!
//! A voxel next to a voxel of the other sign is at most one voxel from the surface. If its value is the
//! background, or it belongs to a tile, the file gives only a sign there and no distance. Values that are
//! distances are kept. The others are computed from them by sweeping outward, and then the whole band is
//! redistanced once. For a sign function, planes along the axes are exact; in other directions the surface
//! has steps of up to half a voxel to each side, which smoothing (`--max-deviation 1`) removes.

use std::fmt;

use glam::IVec3;
use rayon::prelude::*;
use rustc_hash::{FxHashMap, FxHashSet};

use super::{NarrowBand, Sweeps, UNREACHED, extend, redistance};
use crate::grid::{
    Field, LEAF_EDGE, LEAF_VOXELS, Leaf, LeafMask, NO_LEAF, Topology, offset_in_leaf, voxel_in_leaf,
};
use crate::parallel::Loops as _;
use crate::space::INDEX_LIMIT;

/// Half width of a rebuilt band, in voxels, as other programs expect.
pub const REBUILT_HALF_WIDTH: f32 = 3.0;

/// Values above this fraction of the background count as background, because 16-bit values are rounded.
const CLIPPED: f32 = 0.999;

/// A level set is left unchanged if at most this fraction of the voxels at its surface lack a distance.
/// Around these voxels, its surface lies midway between voxels of opposite sign, as it would after
/// rebuilding.
const CLIPPED_PART_MAX: f64 = 0.01;

/// Lower limit, in voxels, of a distance that is derived from the value on the other side of the surface.
const DISTANCE_MIN: f32 = 0.05;

/// A level set as stored in a file; values in any unit.
#[derive(Clone, Copy, Debug)]
pub struct StoredLevelSet<'a> {
    /// Origins of the leaves, multiples of 8.
    pub origins: &'a [IVec3],
    /// The values of each leaf, z fastest.
    pub leaves: &'a [[f32; LEAF_VOXELS]],
    /// Cubes of voxels with a single value: minimum voxel, edge, value. Edges are powers of two, 8 or more.
    pub tiles: &'a [(IVec3, i32, f32)],
    /// The value of all voxels that are not stored, positive.
    pub background: f32,
    /// The voxel size, in the unit of the values.
    pub voxel_size: f64,
}

/// Memory per leaf while distances are rebuilt, in bytes: four fields, and the topology.
const REBUILDING_LEAF_BYTES: u64 = 4 * size_of::<Leaf>() as u64 + 300;

/// Maximum number of leaves that can be rebuilt within this memory, including temporary fields.
pub fn rebuilding_leaf_count_max(memory_bytes: u64) -> usize {
    usize::try_from(memory_bytes / REBUILDING_LEAF_BYTES).unwrap_or(usize::MAX)
}

/// Why a band was rebuilt.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct RebuildReason {
    /// Number of stored voxels next to the surface.
    pub surface_voxel_count: usize,
    /// Number of those that have a sign but no distance.
    pub clipped_voxel_count: usize,
    /// Number of cubes of 8³ voxels that were added where the surface lies between tiles, or between a tile
    /// and a leaf. Tiles store only signs.
    pub tile_cube_count: usize,
}

impl fmt::Display for RebuildReason {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let RebuildReason { surface_voxel_count, clipped_voxel_count, tile_cube_count } = self;
        let voxels = format!(
            "{clipped_voxel_count} of {surface_voxel_count} voxels next to the surface have no distance, only a sign"
        );
        let tiles = format!(
            "the surface touches tiles, which store only a sign ({tile_cube_count} leaf nodes were added there)"
        );
        let what = match (clipped_voxel_count, tile_cube_count) {
            (_, 0) => voxels,
            (0, _) => tiles,
            _ => format!("{voxels}, and {tiles}"),
        };
        write!(
            f,
            "{what}: the distances were rebuilt, and the surface is within half a voxel of where the signs change"
        )
    }
}

/// Error: rebuilding needs more leaves than the caller allows.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TooManyLeaves;

/// The level set in a band of [`REBUILT_HALF_WIDTH`] with distances on both sides of the surface; `None` if
/// the file already has these, except for a few voxels. `leaf_count_max` limits the leaves of the result.
///
/// # Errors
/// Returns [`TooManyLeaves`] if the result would have more leaves.
pub fn rebuilt(
    stored: &StoredLevelSet<'_>,
    leaf_count_max: usize,
) -> Result<Option<(NarrowBand, RebuildReason)>, TooManyLeaves> {
    let lookup = LevelSetLookup::new(stored);
    let added = lookup.leaves_between_tiles(leaf_count_max)?;
    let [surface_voxel_count, clipped_voxel_count] = lookup.voxel_counts_at_surface();
    let is_clipped = clipped_voxel_count as f64 > CLIPPED_PART_MAX * surface_voxel_count as f64;
    if added.is_empty() && !is_clipped {
        return Ok(None);
    }
    let reason = RebuildReason { surface_voxel_count, clipped_voxel_count, tile_cube_count: added.len() };
    let topology = Topology::new(lookup.topology.origins().iter().copied().chain(added).collect());
    if topology.len() > leaf_count_max {
        return Err(TooManyLeaves);
    }
    let raw = lookup.values_in(&topology);
    // The band extends into the leaves around those with a crossing.
    let inside = inside_masks(topology.len(), |leaf| &raw.leaves[leaf].values);
    let is_crossed = |leaf: &usize| at_surface(&inside, &topology, *leaf) != LeafMask::EMPTY;
    let crossed: Vec<usize> = (0..topology.len()).into_par_iter().halved().filter(is_crossed).collect();
    let mut origins: FxHashSet<IVec3> = topology.origins().iter().copied().collect();
    for leaf in crossed {
        let origin = topology.origins()[leaf];
        origins
            .extend((0..27).map(|slot| {
                origin + (IVec3::new(slot / 9, slot / 3 % 3, slot % 3) - IVec3::ONE) * LEAF_EDGE
            }));
        if origins.len() > leaf_count_max {
            return Err(TooManyLeaves);
        }
    }
    drop((raw, inside, topology));
    let topology = Topology::new(origins.into_iter().collect());
    let raw = lookup.values_in(&topology);
    let scale = (1.0 / stored.voxel_size) as f32;
    let mut phi = Field::splat(topology.len(), UNREACHED);
    let mut fixed = vec![LeafMask::EMPTY; topology.len()];
    phi.leaves.par_iter_mut().zip(&mut fixed).enumerate().halved().for_each(|(leaf, (phi, fixed))| {
        for (offset, value) in phi.values.iter_mut().enumerate() {
            let own = raw.leaves[leaf].values[offset];
            let known = if lookup.is_known(own) {
                Some(own.abs() * scale)
            } else {
                distance_from_neighbors(&lookup, &raw, &topology, (leaf, offset), scale)
            };
            if known.is_some() {
                fixed.insert(offset);
            }
            *value = known.unwrap_or(UNREACHED).copysign(own);
        }
    });
    drop(raw);
    // A sweep advances one voxel along the axes, so a distance along the diagonal needs √3 times as many
    // sweeps.
    let sweeps = Sweeps::accurate((3f32.sqrt() * REBUILT_HALF_WIDTH).ceil() as u32);
    extend(&topology, &mut phi, &fixed, sweeps.clamped(REBUILT_HALF_WIDTH));
    drop(fixed);
    phi.leaves.par_iter_mut().halved().for_each(|leaf| {
        for phi in &mut leaf.values {
            *phi = phi.clamp(-REBUILT_HALF_WIDTH, REBUILT_HALF_WIDTH);
        }
    });
    let mut band = NarrowBand { topology: topology.into(), phi, half_width: REBUILT_HALF_WIDTH };
    redistance(&mut band, sweeps);
    Ok(Some((band, reason)))
}

/// Distance from the surface, in voxels, for a voxel whose stored value is not a distance. `None` unless the
/// surface lies between the voxel and an adjacent one.
fn distance_from_neighbors(
    lookup: &LevelSetLookup<'_>,
    raw: &Field,
    topology: &Topology,
    (leaf, offset): (usize, usize),
    scale: f32,
) -> Option<f32> {
    let own = raw.leaves[leaf].values[offset];
    let across = face_neighbors(raw, topology, leaf, offset)
        .into_iter()
        .flatten()
        .filter(|&value| is_inside(value) != is_inside(own));
    across
        .map(
            |value| {
                if lookup.is_known(value) {
                    (1.0 - value.abs() * scale).clamp(DISTANCE_MIN, 1.0)
                } else {
                    0.5
                }
            },
        )
        .min_by(f32::total_cmp)
}

/// NaN counts as outside.
fn is_inside(value: f32) -> bool {
    value < 0.0
}

/// The values of the six adjacent voxels; `None` if the leaf is not stored.
fn face_neighbors(raw: &Field, topology: &Topology, leaf: usize, offset: usize) -> [Option<f32>; 6] {
    let voxel = voxel_in_leaf(offset);
    let neighbors = &topology.neighbors()[leaf];
    std::array::from_fn(|face| {
        let (axis, is_up) = (face / 2, face % 2 == 1);
        let mut at = voxel;
        at[axis] += if is_up { 1 } else { -1 };
        let leaf = if (0..LEAF_EDGE).contains(&at[axis]) {
            leaf
        } else if neighbors[face] == NO_LEAF {
            return None;
        } else {
            neighbors[face] as usize
        };
        Some(raw.leaves[leaf].values[offset_in_leaf(at & (LEAF_EDGE - 1))])
    })
}

/// For each leaf, the voxels that are inside.
fn inside_masks<'a>(
    leaf_count: usize,
    values: impl Fn(usize) -> &'a [f32; LEAF_VOXELS] + Sync,
) -> Vec<LeafMask> {
    (0..leaf_count)
        .into_par_iter()
        .halved()
        .map(|leaf| {
            let values = values(leaf);
            LeafMask::from_fn(|offset| is_inside(values[offset]))
        })
        .collect()
}

/// The voxels of a leaf with the surface between them and an adjacent voxel in a stored leaf.
fn at_surface(inside: &[LeafMask], topology: &Topology, leaf: usize) -> LeafMask {
    let own = inside[leaf];
    let of_face = |face: usize| match topology.neighbors()[leaf][face] {
        NO_LEAF => None,
        neighbor => Some(&inside[neighbor as usize]),
    };
    let mut crossed = LeafMask::EMPTY;
    for face in 0..6 {
        // If no leaf is stored beyond a face, the voxels there count as having the same sign as those on the
        // face.
        let across = match of_face(face) {
            Some(across) => *across,
            None => mirrored(&own, face),
        };
        let [before, after] = own.shifted(face / 2, 1, &across, &across);
        let adjacent = if face.is_multiple_of(2) { before } else { after };
        crossed = crossed.or(&own.and(&adjacent.complement())).or(&adjacent.and(&own.complement()));
    }
    crossed
}

/// A leaf to use beyond a face: the mirror image of `own`, so that no sign changes across the face.
fn mirrored(own: &LeafMask, face: usize) -> LeafMask {
    let axis = face / 2;
    LeafMask::from_fn(|offset| {
        let mut voxel = voxel_in_leaf(offset);
        voxel[axis] = LEAF_EDGE - 1 - voxel[axis];
        own.contains(offset_in_leaf(voxel))
    })
}

/// Looks up the value of any voxel of a stored level set.
struct LevelSetLookup<'a> {
    stored: &'a StoredLevelSet<'a>,
    topology: Topology,
    /// For each leaf of the topology, its index in the file.
    file_indices: Vec<u32>,
    tile_of: FxHashMap<(IVec3, i32), f32>,
    tile_sizes: Vec<i32>,
}

impl<'a> LevelSetLookup<'a> {
    fn new(stored: &'a StoredLevelSet<'a>) -> LevelSetLookup<'a> {
        let limit = IVec3::splat(INDEX_LIMIT);
        let is_near = |origin: &IVec3| origin.cmpgt(-limit).all() && origin.cmplt(limit).all();
        let near = stored.origins.iter().copied().filter(is_near);
        let topology = Topology::new(near.collect());
        let mut file_indices = vec![0; topology.len()];
        for (&origin, index) in stored.origins.iter().zip(0..) {
            if let Some(leaf) = topology.find(origin) {
                file_indices[leaf] = index;
            }
        }
        let tiles = stored.tiles.iter().filter(|(origin, size, _)| is_near(origin) && *size >= LEAF_EDGE);
        let tile_of: FxHashMap<_, _> = tiles.map(|&(origin, size, value)| ((origin, size), value)).collect();
        let mut tile_sizes: Vec<i32> = tile_of.keys().map(|&(_, size)| size).collect();
        tile_sizes.sort_unstable();
        tile_sizes.dedup();
        LevelSetLookup { stored, topology, file_indices, tile_of, tile_sizes }
    }

    /// True if this value is a distance rather than only a sign.
    fn is_known(&self, value: f32) -> bool {
        value.abs() < CLIPPED * self.stored.background
    }

    fn stored_leaf(&self, leaf: usize) -> &'a [f32; LEAF_VOXELS] {
        &self.stored.leaves[self.file_indices[leaf] as usize]
    }

    /// The single value of a leaf that is not stored.
    fn value_of_missing(&self, origin: IVec3) -> f32 {
        let of_size = |&size: &i32| self.tile_of.get(&(origin & -size, size)).copied();
        self.tile_sizes.iter().find_map(of_size).unwrap_or(self.stored.background)
    }

    /// The stored values of all leaves of a topology.
    fn values_in(&self, topology: &Topology) -> Field {
        let mut values = Field::splat(topology.len(), 0.0);
        values.leaves.par_iter_mut().zip(topology.origins()).halved().for_each(|(leaf, &origin)| {
            *leaf = match self.topology.find(origin) {
                Some(stored) => Leaf { values: *self.stored_leaf(stored) },
                None => Leaf::splat(self.value_of_missing(origin)),
            };
        });
        values
    }

    /// Leaves that are not stored and have the surface on one of their faces. Fails if these and the stored
    /// leaves are more than allowed.
    fn leaves_between_tiles(&self, leaf_count_max: usize) -> Result<FxHashSet<IVec3>, TooManyLeaves> {
        let mut added = FxHashSet::default();
        let is_missing = |origin: &IVec3| self.topology.find(*origin).is_none();
        for (leaf, (&origin, neighbors)) in
            self.topology.origins().iter().zip(self.topology.neighbors()).enumerate()
        {
            for (face, _) in neighbors.iter().enumerate().filter(|(_, neighbor)| **neighbor == NO_LEAF) {
                let across = origin + step(face) * LEAF_EDGE;
                let is_inside_across = is_inside(self.value_of_missing(across));
                let values = self.stored_leaf(leaf);
                if on_face(face).any(|offset| is_inside(values[offset]) != is_inside_across) {
                    added.insert(across);
                }
            }
        }
        for (&(origin, size), &value) in self.tile_of.iter().filter(|(_, value)| is_inside(**value)) {
            for face in 0..6 {
                let adjacent = self.tile_of.get(&(origin + step(face) * size, size));
                if adjacent.is_some_and(|&adjacent| is_inside(adjacent) == is_inside(value)) {
                    continue;
                }
                for within in leaves_on_face(origin, size, face) {
                    let across = within + step(face) * LEAF_EDGE;
                    if is_missing(&across) && !is_inside(self.value_of_missing(across)) {
                        added.extend([within, across].into_iter().filter(is_missing));
                        if self.topology.len() + added.len() > leaf_count_max {
                            return Err(TooManyLeaves);
                        }
                    }
                }
            }
        }
        Ok(added)
    }

    /// Number of voxels in stored leaves that are adjacent to a voxel of the other sign, and how many of
    /// these have no distance.
    fn voxel_counts_at_surface(&self) -> [usize; 2] {
        let inside = inside_masks(self.topology.len(), |leaf| self.stored_leaf(leaf));
        let counts = (0..self.topology.len()).into_par_iter().halved().map(|leaf| {
            let values = self.stored_leaf(leaf);
            let at_surface = at_surface(&inside, &self.topology, leaf);
            let is_clipped = |offset: &usize| !self.is_known(values[*offset]);
            [at_surface.iter().count(), at_surface.iter().filter(is_clipped).count()]
        });
        counts.reduce(|| [0; 2], |[a, b], [c, d]| [a + c, b + d])
    }
}

/// The step through a face, in the order of [`Topology::neighbors`].
fn step(face: usize) -> IVec3 {
    let along = if face.is_multiple_of(2) { -1 } else { 1 };
    IVec3::AXES[face / 2] * along
}

/// The voxels of a leaf on one of its faces.
fn on_face(face: usize) -> impl Iterator<Item = usize> {
    let (axis, edge) = (face / 2, if face.is_multiple_of(2) { 0 } else { LEAF_EDGE - 1 });
    (0..LEAF_EDGE * LEAF_EDGE).map(move |index| {
        let mut voxel = IVec3::ZERO;
        voxel[axis] = edge;
        voxel[(axis + 1) % 3] = index / LEAF_EDGE;
        voxel[(axis + 2) % 3] = index % LEAF_EDGE;
        offset_in_leaf(voxel)
    })
}

/// The leaves within a cube on one of its faces.
fn leaves_on_face(origin: IVec3, size: i32, face: usize) -> impl Iterator<Item = IVec3> {
    let axis = face / 2;
    let (a, b) = (IVec3::AXES[(axis + 1) % 3], IVec3::AXES[(axis + 2) % 3]);
    let depth = if face.is_multiple_of(2) { 0 } else { size - LEAF_EDGE };
    let start = origin + IVec3::AXES[axis] * depth;
    let count = size / LEAF_EDGE;
    (0..count).flat_map(move |i| (0..count).map(move |j| start + (a * i + b * j) * LEAF_EDGE))
}

#[cfg(test)]
mod tests {
    use super::*;

    const BACKGROUND: f32 = 0.3;
    const VOXEL_SIZE: f64 = 0.1;
    const RADIUS: f32 = 11.3;

    /// Distance to a ball, in voxels.
    fn distance(voxel: IVec3) -> f32 {
        voxel.as_vec3().length() - RADIUS
    }

    /// The leaves of a cube around the ball; `value` maps distances in voxels to stored values.
    fn ball(value: impl Fn(f32) -> f32) -> (Vec<IVec3>, Vec<[f32; LEAF_VOXELS]>) {
        let origins: Vec<IVec3> =
            (0..64).map(|slot| (IVec3::new(slot / 16, slot / 4 % 4, slot % 4) - 2) * LEAF_EDGE).collect();
        let leaf =
            |&origin: &IVec3| std::array::from_fn(|offset| value(distance(origin + voxel_in_leaf(offset))));
        let leaves = origins.iter().map(leaf).collect();
        (origins, leaves)
    }

    fn stored<'a>(
        (origins, leaves): &'a (Vec<IVec3>, Vec<[f32; LEAF_VOXELS]>),
        tiles: &'a [(IVec3, i32, f32)],
    ) -> StoredLevelSet<'a> {
        StoredLevelSet { origins, leaves, tiles, background: BACKGROUND, voxel_size: VOXEL_SIZE }
    }

    /// The maximum and the mean error of the distances near the surface.
    fn errors(band: &NarrowBand) -> [f32; 2] {
        let (mut greatest, mut sum, mut count) = (0f32, 0.0, 0.0);
        for (leaf, &origin) in band.phi.leaves.iter().zip(band.topology.origins()) {
            for (offset, &phi) in leaf.values.iter().enumerate() {
                let exact = distance(origin + voxel_in_leaf(offset));
                if exact.abs() < 2.5 {
                    let error = (phi.clamp(-2.5, 2.5) - exact).abs();
                    (greatest, sum, count) = (greatest.max(error), sum + error, count + 1.0);
                }
            }
        }
        [greatest, sum / count]
    }

    #[test]
    fn sign_function_gets_distances_within_half_a_voxel() {
        let steps = ball(|distance| BACKGROUND.copysign(distance));
        let (band, reason) = rebuilt(&stored(&steps, &[]), 1000).expect("few leaves").expect("rebuilt");
        assert_eq!(reason.clipped_voxel_count, reason.surface_voxel_count, "{reason}");
        let [greatest, mean] = errors(&band);
        assert!(greatest < 0.75 && mean < 0.25, "{greatest} {mean}");
    }

    #[test]
    fn one_sided_band_is_completed() {
        let outside_only = |distance: f32| {
            if distance < 0.0 { -BACKGROUND } else { (distance * VOXEL_SIZE as f32).min(BACKGROUND) }
        };
        for sign in [1.0, -1.0] {
            let half = ball(|distance| sign * outside_only(sign * distance));
            let (band, _) = rebuilt(&stored(&half, &[]), 1000).expect("few leaves").expect("rebuilt");
            let [greatest, mean] = errors(&band);
            assert!(greatest < 0.35 && mean < 0.1, "{greatest} {mean}");
        }
    }

    #[test]
    fn complete_band_is_not_rebuilt() {
        let whole = ball(|distance| (distance * VOXEL_SIZE as f32).clamp(-BACKGROUND, BACKGROUND));
        assert!(rebuilt(&stored(&whole, &[]), 1000).expect("few leaves").is_none());
    }

    #[test]
    fn band_with_one_pair_of_clipped_voxels_is_not_rebuilt() {
        let mut whole = ball(|distance| (distance * VOXEL_SIZE as f32).clamp(-BACKGROUND, BACKGROUND));
        // The first leaf is entirely outside.
        let middle = offset_in_leaf(IVec3::splat(4));
        (whole.1[0][middle], whole.1[0][middle + 1]) = (BACKGROUND, -BACKGROUND);
        assert!(rebuilt(&stored(&whole, &[]), 1000).expect("few leaves").is_none());
    }

    #[test]
    fn leaves_are_added_between_tiles_of_opposite_sign() {
        // A cube with an edge of 16 voxels made of tiles of 8, and a cube that is a single tile of 128.
        let corners = (0..8).map(|slot| IVec3::new(slot / 4, slot / 2 % 2, slot % 2) * 8);
        let small: Vec<(IVec3, i32, f32)> = corners.map(|origin| (origin, 8, -BACKGROUND)).collect();
        let large = [(IVec3::splat(-128), 128, -BACKGROUND)];
        for (tiles, edge) in [(&small[..], 16.0), (&large, 128.0)] {
            let band = rebuilt(&stored(&(vec![], vec![]), tiles), 10_000);
            let (band, reason) = band.expect("few leaves").expect("rebuilt");
            assert!(
                reason
                    .to_string()
                    .contains(&format!("({} leaf nodes were added there)", reason.tile_cube_count)),
                "{reason}"
            );
            // A face of the cube lies midway between its voxels and those around it.
            let inside = |value: &&f32| **value < 0.0 && **value > -REBUILT_HALF_WIDTH;
            let near = band.phi.leaves.iter().flat_map(|leaf| leaf.values.iter().filter(inside)).count();
            let hollow = f64::powi(edge, 3) - f64::powi(f64::max(edge - 6.0, 0.0), 3);
            assert!((near as f64 / hollow - 1.0).abs() < 0.1, "{near} {hollow}");
        }
        let few = rebuilt(&stored(&(vec![], vec![]), &large), 100);
        assert_eq!(few.expect_err("more than 100 leaves"), TooManyLeaves);
    }

    #[test]
    fn large_inside_tile_exceeds_the_leaf_limit() {
        // Each of the tile's six faces touches 512² leaves outside the tile, 6 · 512² in total.
        let (none, tile) = ((vec![], vec![]), [(IVec3::ZERO, 4096, -BACKGROUND)]);
        let stored = stored(&none, &tile);
        let lookup = LevelSetLookup::new(&stored);
        assert_eq!(lookup.leaves_between_tiles(1 << 18), Err(TooManyLeaves));
    }
}
