//! Level sets on the sparse grid: a narrow band of signed distances, and the bounds that constrain smoothing.
//!
//! ```text
//!      outside          φ = 0          inside
//!   +6 … +3 +2 +1  ─────────────  −1 −2 −3 … −6       φ in voxels, negative inside
//!        └───── narrow band ─────────┘
//! ```
//!
//! Beyond the stored leaves, φ is + half width (outside) or − half width (inside).

mod rebuilt;
mod redistance;
mod sample;

use std::sync::Arc;

use glam::IVec3;
use rayon::prelude::*;
use rustc_hash::FxHashMap;

pub use rebuilt::{
    REBUILT_HALF_WIDTH, RebuildReason, StoredLevelSet, TooManyLeaves, rebuilding_leaf_count_max, rebuilt,
};
pub use redistance::{Sweeps, UNREACHED, extend, extend_in, redistance, redistance_field, redistance_in};
pub use sample::{Sampler, spline_weights};

use crate::grid::{
    Field, LEAF_EDGE, LEAF_VOXELS, Leaf, LeafMask, NO_LEAF, ROW_COUNT, Topology, negative_masks,
    offset_in_leaf,
};
use crate::parallel::Loops as _;

/// Minimum |φ| of a finished level set, in voxels, unless bounds require a smaller value.
/// Where the surface almost touches a voxel, meshers fold it around that voxel into tiny sharp triangles.
/// With OpenVDB's mesher, a single voxel with |φ| = 10⁻⁶ adds 4800 to ∫H², three times the ∫H² of its whole
/// frame. With |φ| = 0.0002, it adds 320; with 0.003, 30; with 1/128, less than a drop's 4π.
pub const NEAREST_TO_ZERO: f32 = 1.0 / 128.0;

/// A level set: signed distances in voxels near a surface, negative inside. Multiply by the voxel size for
/// world units. Points outside the stored leaves are farther from the surface than the half width.
#[derive(Clone, Debug)]
pub struct NarrowBand {
    /// The stored leaves.
    pub topology: Arc<Topology>,
    /// Signed distance in voxels, negative inside; within ± `half_width`.
    pub phi: Field,
    /// Maximum stored |φ|, in voxels.
    pub half_width: f32,
}

impl NarrowBand {
    /// The stored leaves: the minimum voxel of each, and its 512 values in voxels, z fastest. The center of
    /// voxel (x, y, z) is at (x, y, z) times the voxel size in world space.
    pub fn leaves(&self) -> impl ExactSizeIterator<Item = (IVec3, &[f32; LEAF_VOXELS])> {
        let values = self.phi.leaves.iter().map(|leaf| &leaf.values);
        self.topology.origins().iter().copied().zip(values)
    }
}

// The interval that constrains φ.

/// Bounds of φ, on the topology of the band that they constrain: from the outer and the inner union of spheres, or around
/// a start of kernels. φ is negative inside, so the outer bound is the lower one: `lower` = φ_max ≤ φ ≤ φ_min = `upper`.
/// Those of spheres are signed distances near the surface of their union, and open farther away.
#[derive(Clone, Debug)]
pub struct Bounds {
    /// Bounds of leaves, in voxels. Leaves with the same single value are stored once.
    leaves: Vec<Leaf>,
    /// For each leaf of the topology, where its lower and its upper bounds are in `leaves`.
    places: Vec<[u32; 2]>,
}

impl Bounds {
    /// Bounds with these values: φ_max of the paper, from the outer union of spheres, and φ_min, from the inner
    /// one, in voxels. Both end up in the memory of the first field, if it has room for them.
    pub fn new(lower: Field, upper: Field) -> Bounds {
        let mut place_of_value = FxHashMap::default();
        let mut placed = |field: &Field, first: usize| -> (Vec<u32>, Vec<usize>) {
            let only_values: Vec<Option<u32>> = field.leaves.par_iter().halved().map(only_value).collect();
            let mut kept = Vec::new();
            let place = |(leaf, value): (usize, Option<u32>)| {
                let new = (first + kept.len()) as u32;
                let place = value.map_or(new, |value| *place_of_value.entry(value).or_insert(new));
                kept.extend((place == new).then_some(leaf));
                place
            };
            (only_values.into_iter().enumerate().map(place).collect(), kept)
        };
        let (lower_places, kept_lower) = placed(&lower, 0);
        let (upper_places, kept_upper) = placed(&upper, kept_lower.len());
        let mut leaves = lower.leaves;
        for (to, from) in kept_lower.iter().copied().enumerate() {
            leaves[to] = leaves[from];
        }
        leaves.truncate(kept_lower.len());
        leaves.reserve_exact(kept_upper.len());
        leaves.par_extend(kept_upper.par_iter().halved().map(|&leaf| upper.leaves[leaf]));
        let places =
            lower_places.into_iter().zip(upper_places).map(|(lower, upper)| [lower, upper]).collect();
        Bounds { leaves, places }
    }

    /// The lower and the upper bounds of a leaf of the topology.
    #[inline(always)]
    pub fn of_leaf(&self, leaf: usize) -> [&Leaf; 2] {
        self.places[leaf].map(|place| &self.leaves[place as usize])
    }

    /// The lower and the upper bounds as plain fields.
    pub fn to_fields(&self) -> [Field; 2] {
        [0, 1].map(|bound| Field {
            leaves: (0..self.places.len())
                .into_par_iter()
                .halved()
                .map(|leaf| *self.of_leaf(leaf)[bound])
                .collect(),
        })
    }

    /// Clamps every value to its interval (Eq. 6).
    pub fn clamp(&self, phi: &mut Field) {
        phi.leaves.par_iter_mut().enumerate().halved().for_each(|(leaf, phi)| {
            let [lower, upper] = self.of_leaf(leaf);
            for ((phi, lower), upper) in phi.values.iter_mut().zip(&lower.values).zip(&upper.values) {
                *phi = phi.max(*lower).min(*upper);
            }
        });
    }

    /// Number of values outside their interval.
    pub fn violation_count(&self, phi: &Field) -> usize {
        let count = |(leaf, phi): (usize, &Leaf)| {
            let [lower, upper] = self.of_leaf(leaf);
            let intervals = lower.values.iter().zip(&upper.values);
            let values = phi.values.iter().zip(intervals);
            values.filter(|(phi, (lower, upper))| !(*lower <= *phi && *phi <= *upper)).count()
        };
        phi.leaves.par_iter().enumerate().halved().map(count).sum()
    }
}

/// The bits of the value that all voxels of a leaf have; `None` if they differ.
fn only_value(leaf: &Leaf) -> Option<u32> {
    // Row by row, which takes vector instructions.
    let rows: &[[u32; 8]; ROW_COUNT] = bytemuck::cast_ref(&leaf.values);
    let first = rows[0][0];
    rows.iter().all(|row| *row == [first; 8]).then_some(first)
}

// Moves the surface of a level set by a constant distance.
//
//   φ            +3 +2 +1  0 −1 −2 −3      distances to the surface
//   φ − offset   +1  0 −1 −2 −3 −4 −5      outward by 2: another level set becomes the surface
//   restored     +1  0 −1 −2 −3 −4 −5      distances to the new surface
//
// Where φ is a distance, its level set at `offset` is the moved surface. But φ − offset is not everywhere
// the distance to the moved surface: where two parts of the surface merged, or one vanished, the nearest
// point is now on another part. So distances are swept again. The sweeps start from the voxels next to the
// moved surface, which keep their values.

/// Moves the surface outward by `offset` voxels (inward if negative) and restores distances within ±
/// `half_width`, the band's new half width. φ must hold distances up to the level `offset`. All voxels keep
/// |φ| ≥ [`NEAREST_TO_ZERO`].
pub fn offset_surface(band: &mut NarrowBand, offset: f32, half_width: f32) {
    band.phi.leaves.par_iter_mut().halved().flat_map_iter(|leaf| &mut leaf.values).for_each(|phi| {
        let moved = *phi - offset;
        *phi = moved.abs().max(NEAREST_TO_ZERO).copysign(moved);
    });
    let fixed = next_to_surface(band);
    band.phi.leaves.par_iter_mut().zip(&fixed).halved().for_each(|(phi, fixed)| {
        for free in fixed.complement().iter() {
            phi.values[free] = UNREACHED.copysign(phi.values[free]);
        }
    });
    band.half_width = half_width;
    // Each sweep advances one voxel along the axes. Along a diagonal, a distance d takes √3 d such steps.
    sweep(band, &fixed, Sweeps::accurate((3f32.sqrt() * half_width).ceil() as u32));
}

/// How many voxels away, per axis, an input value of [`offset_surface`] can affect a result.
pub fn offset_reach_voxels(half_width: f32) -> u32 {
    2 * (3f32.sqrt() * half_width).ceil() as u32 + 1
}

/// Replaces −0 by +0. A voxel with φ = 0 is outside, but sweeps determine the side from the sign bit and
/// would treat −0 as inside. A swept voxel must be on the same side as its neighbors; otherwise signs would
/// alternate between sweeps and spread.
fn outside_if_zero(phi: f32) -> f32 {
    if phi == 0.0 { 0.0 } else { phi }
}

/// Sweeps distances again, from the voxels next to the surface, which keep their values, to voxels farther
/// away.
pub fn extend_distances(band: &mut NarrowBand, sweeps: Sweeps) {
    band.phi.leaves.par_iter_mut().halved().flat_map_iter(|leaf| &mut leaf.values).for_each(|phi| {
        *phi = outside_if_zero(*phi);
    });
    let fixed = next_to_surface(band);
    sweep(band, &fixed, sweeps);
}

fn sweep(band: &mut NarrowBand, fixed: &[LeafMask], sweeps: Sweeps) {
    extend(&band.topology, &mut band.phi, fixed, sweeps.clamped(band.half_width));
    let half_width = band.half_width;
    band.phi.leaves.par_iter_mut().halved().flat_map_iter(|leaf| &mut leaf.values).for_each(|phi| {
        *phi = phi.clamp(-half_width, half_width);
    });
}

/// The voxels of each leaf with a face neighbor on the other side of the surface.
fn next_to_surface(band: &NarrowBand) -> Vec<LeafMask> {
    let inside = negative_masks(&band.phi);
    let outside: Vec<LeafMask> = inside.par_iter().halved().map(LeafMask::complement).collect();
    let adjacent = |leaf: usize| {
        let [inside, outside] =
            [&inside, &outside].map(|sides| next_to_other_side(&band.topology, sides, leaf));
        inside.or(&outside)
    };
    (0..inside.len()).into_par_iter().halved().map(adjacent).collect()
}

/// The voxels of a leaf that are on one side of the surface and have a face neighbor on the other side.
/// Voxels that are not stored count as on the same side as the adjacent stored voxels.
fn next_to_other_side(topology: &Topology, side: &[LeafMask], leaf: usize) -> LeafMask {
    let faces = topology.neighbors()[leaf].map(|neighbor| match neighbor {
        NO_LEAF => &LeafMask::FULL,
        neighbor => &side[neighbor as usize],
    });
    let mut adjacent = side[leaf];
    adjacent.remove_all(&side[leaf].surrounded(faces));
    adjacent
}

// Widens a narrow band.
//
//   before   +3 | +3 +2 +1  0 −1 −2 −3 | −3       stored by another program, 3 voxels to each side
//   after    +6 … +3 +2 +1  0 −1 −2 −3 … −6       the stored leaves and the leaves around them
//
// Voxels that are not stored are on the same side as the adjacent stored ones: if the surface passed between
// them, their leaf would be stored. Redistancing then restores distances from the zero set, as between
// smoothing steps. It moves the zero set by only a few thousandths of a voxel.

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
    use glam::IVec3;

    use super::*;
    use crate::grid::{FACE_STEPS, Field, LEAF_EDGE, Leaf, offset_in_leaf, voxel_in_leaf};

    #[test]
    fn bounds_share_leaves_with_one_value() {
        let varied = |shift: f32| Leaf { values: std::array::from_fn(|offset| offset as f32 + shift) };
        let lower = [Leaf::splat(-5.0), varied(0.0), Leaf::splat(1.5), Leaf::splat(-5.0), Leaf::splat(-0.0)];
        let upper = [Leaf::splat(5.0), varied(0.5), Leaf::splat(1.5), varied(1.0), Leaf::splat(0.0)];
        let [lower, upper] = [lower, upper].map(|leaves| Field { leaves: leaves.to_vec() });
        let bounds = Bounds::new(lower.clone(), upper.clone());
        assert_eq!(bounds.leaves.len(), 8);
        assert_eq!(bounds.to_fields(), [lower, upper]);
        assert!(bounds.of_leaf(4)[0].values[0].is_sign_negative());
        assert!(bounds.of_leaf(4)[1].values[0].is_sign_positive());
    }

    const HALF_WIDTH: f32 = 7.0;

    /// The band of a shape given by its signed distance.
    fn band(distance: impl Fn([f32; 3]) -> f32) -> NarrowBand {
        let axis = || -4..4;
        let origins = axis()
            .flat_map(|x| axis().flat_map(move |y| axis().map(move |z| IVec3::new(x, y, z) * LEAF_EDGE)));
        let values = |origin: IVec3| -> Leaf {
            let value = |offset| distance((origin + voxel_in_leaf(offset)).as_vec3().to_array());
            Leaf { values: std::array::from_fn(|offset| value(offset).clamp(-HALF_WIDTH, HALF_WIDTH)) }
        };
        let is_stored = |leaf: &Leaf| leaf.values.iter().any(|phi| phi.abs() < HALF_WIDTH);
        let topology = Topology::new(origins.filter(|&origin| is_stored(&values(origin))).collect());
        let phi = Field { leaves: topology.origins().iter().map(|&origin| values(origin)).collect() };
        NarrowBand { topology: topology.into(), phi, half_width: HALF_WIDTH }
    }

    fn ball(center: [f32; 3], radius: f32) -> impl Fn([f32; 3]) -> f32 {
        move |p| (0..3).map(|axis| (p[axis] - center[axis]).powi(2)).sum::<f32>().sqrt() - radius
    }

    fn moved(band: &NarrowBand, offset: f32) -> NarrowBand {
        let mut moved = band.clone();
        offset_surface(&mut moved, offset, 5.0);
        moved
    }

    /// Maximum difference between φ and a distance within the half width, and the number of voxels compared.
    fn greatest_error(band: &NarrowBand, distance: impl Fn([f32; 3]) -> f32) -> (f32, usize) {
        let (mut greatest, mut count) = (0f32, 0);
        for (leaf, &origin) in band.phi.leaves.iter().zip(band.topology.origins()) {
            for (offset, &phi) in leaf.values.iter().enumerate() {
                let exact = distance((origin + voxel_in_leaf(offset)).as_vec3().to_array());
                assert!(phi.abs() <= band.half_width);
                if exact.abs() < band.half_width - 0.5 {
                    greatest = greatest.max((phi - exact).abs());
                    count += 1;
                }
            }
        }
        (greatest, count)
    }

    #[test]
    fn offset_ball_has_radius_plus_offset() {
        let center = [0.3, -0.2, 0.4];
        let given = band(ball(center, 12.2));
        for offset in [-2.0, -0.4, 0.7, 2.0] {
            let (error, count) = greatest_error(&moved(&given, offset), ball(center, 12.2 + offset));
            assert!(error < 0.06 && count > 5000, "{offset}: {error} at {count}");
        }
    }

    /// Where parts vanish or merge, distances are those to the remaining surface.
    #[test]
    fn offset_restores_distances_after_parts_vanish_or_merge() {
        let both = |radii: [f32; 2]| {
            let [one, other] = [ball([-8.2, 0.1, 0.2], radii[0]), ball([8.3, 0.1, 0.2], radii[1])];
            move |p| one(p).min(other(p))
        };
        // The second ball vanishes without a trace next to the first.
        let (error, count) =
            greatest_error(&moved(&band(both([8.1, 1.6])), -1.7), ball([-8.2, 0.1, 0.2], 6.4));
        assert!(error < 0.15 && count > 2000, "{error} at {count}");
        // The balls merge. Without the sweeps, the former gap would still determine φ in the middle.
        let joined = moved(&band(both([7.1, 7.1])), 2.0);
        let middle = joined.topology.find_voxel(IVec3::ZERO).expect("stored");
        let phi = |(leaf, local): (usize, IVec3)| joined.phi.leaves[leaf].values[offset_in_leaf(local)];
        // The seam is a ring of radius √(9.1² − 8.25²) = 3.84 around the middle, where φ − offset would be
        // −0.85. The voxels next to the seam keep their values. In such a crease, their depth is up to one
        // voxel too small.
        assert!((phi(middle) + 3.84).abs() < 1.1, "{}", phi(middle));
    }

    /// The surface almost touches an outside voxel with φ = +0 or −0.
    #[test]
    fn zeros_of_both_signs_stay_outside_in_extended_distances() {
        let given = band(ball([0.3, -0.2, 0.4], 9.7));
        let center = IVec3::new(13, 0, 0);
        let extended = |zero: f32| {
            let mut extended = given.clone();
            let steps = FACE_STEPS.map(|step| (step, 0.2));
            for (step, phi) in steps.into_iter().chain([(IVec3::ZERO, zero)]) {
                let (leaf, local) = given.topology.find_voxel(center + step).expect("stored");
                extended.phi.leaves[leaf].values[offset_in_leaf(local)] = phi;
            }
            extend_distances(&mut extended, Sweeps::accurate(8));
            extended.phi
        };
        assert!(negative_masks(&extended(-0.0)) == negative_masks(&given.phi));
        assert!(extended(-0.0) == extended(0.0));
    }

    #[test]
    fn result_does_not_depend_on_threads() {
        let given = band(ball([1.0, 2.0, 0.4], 9.7));
        let on = |threads: usize| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("a thread pool");
            pool.install(|| moved(&given, -1.1).phi)
        };
        assert!(on(1) == on(3));
    }

    /// The band of a ball of this radius, in voxels, stored where the surface is within the half width.
    fn stored_ball(radius: f32, half_width: f32) -> NarrowBand {
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
            let wide = widened(&stored_ball(18.3, narrow), 6.0);
            assert!(wide.topology.len() > stored_ball(18.3, narrow).topology.len());
            let narrow = stored_ball(18.3, narrow);
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
