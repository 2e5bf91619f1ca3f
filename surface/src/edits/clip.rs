//! Clips the fluid with a box and closes the cuts with flat caps: φ ← max(φ, distance to the box).
//!
//! ```text
//!     ┊     box      ┊
//!   ╭─┊──────────────┊──╮        ▒ stored leaves
//!   │▒┊▒▒▒▒▒▒▒▒▒▒▒▒▒▒┊▒▒│        c leaves added for the caps, where the box cuts through the deep interior,
//!   │▒c              c ▒│          which has no stored leaves. Leaves outside the box are removed
//! ```
//!
//! A gap between two stored leaves along z is deep inside if the two leaf faces next to it are inside, as in
//! a .vdb file.
//!
//! A cap lies on its plane, with one exception: if a plane passes within 1/128 voxel of a layer of voxels,
//! the cap is moved inward to that distance, because meshers fold a surface that almost touches voxels.
//!
//! Where a cap meets the fluid's own surface in a sharp edge, a mesher locates the edge only to a fraction of
//! a voxel and may place vertices slightly beyond the plane. So the mesh is clamped to the box afterwards
//! ([`VoxelClip::clamp_mesh`]).

use std::sync::Arc;

use glam::{DVec3, IVec3, Vec3};
use rayon::prelude::*;

use crate::grid::{Field, LEAF_EDGE, Leaf, LeafMask, Topology, negative_masks, voxel_in_leaf};
use crate::level_set::{NEAREST_TO_ZERO, NarrowBand};
use crate::mesh::Mesh;
use crate::parallel::Loops as _;
use crate::space::Lattice;

/// A box in world units, including its boundary. A side at infinity does not clip.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct VoxelClip {
    /// Minimum corner.
    pub min: DVec3,
    /// Maximum corner.
    pub max: DVec3,
}

impl VoxelClip {
    /// The signed distance of a world position to the box, negative inside.
    pub fn distance(&self, world: DVec3) -> f64 {
        distance((self.min - world).max(world - self.max))
    }

    /// Clamps mesh vertices to the box. Intended for vertices at the edges of caps, which may be beyond the
    /// box by a fraction of a voxel.
    pub fn clamp_mesh(&self, mesh: &mut Mesh) {
        let [least, most] = [self.min - mesh.origin, self.max - mesh.origin].map(|corner| corner.to_array());
        let (least, most) = (Vec3::from(least.map(rounded_up)), Vec3::from(most.map(rounded_down)));
        for position in &mut mesh.positions {
            *position = position.max(least).min(most);
        }
    }
}

/// The smallest 32-bit float that is not below a plane.
fn rounded_up(plane: f64) -> f32 {
    let rounded = plane as f32;
    if f64::from(rounded) < plane { rounded.next_up() } else { rounded }
}

/// The largest 32-bit float that is not above a plane.
fn rounded_down(plane: f64) -> f32 {
    -rounded_up(-plane)
}

/// Result of clipping.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Clipped {
    /// Number of voxels that changed from inside to outside.
    pub voxel_count: u64,
    /// Number of leaves added for the caps.
    pub added_leaf_count: usize,
    /// Number of leaves removed.
    pub removed_leaf_count: usize,
}

/// Removes the fluid outside a box. The remaining surface is closed.
pub fn clip(band: &mut NarrowBand, lattice: &Lattice, clip_box: &VoxelClip) -> Clipped {
    let cut = Cut {
        min: clip_box.min / lattice.voxel_size,
        max: clip_box.max / lattice.voxel_size,
        half_width: f64::from(band.half_width),
    };
    let inside = negative_masks(&band.phi);
    let gaps = gaps(&band.topology, &inside);
    let kept: Vec<IVec3> =
        band.topology.origins().iter().copied().filter(|&origin| !cut.is_beyond(origin)).collect();
    let mut clipped = Clipped {
        voxel_count: gaps.iter().map(|gap| cut.outside_count(gap)).sum(),
        added_leaf_count: 0,
        removed_leaf_count: band.topology.len() - kept.len(),
    };
    let added: Vec<IVec3> = gaps.into_par_iter().halved().flat_map_iter(|gap| cut.cap_leaves(gap)).collect();
    let old = band.topology.clone();
    let origins: Vec<IVec3> = kept.into_iter().chain(added).collect();
    band.topology = Arc::new(Topology::new(origins));
    let from: Vec<Option<usize>> = band.topology.origins().iter().map(|&origin| old.find(origin)).collect();
    clipped.added_leaf_count = from.iter().filter(|from| from.is_none()).count();
    band.phi = cut.apply(&band.phi, &band.topology, &from, band.half_width);
    clipped.voxel_count += stored_difference(&old, &inside, &band.topology, &negative_masks(&band.phi));
    clipped
}

/// Number of inside voxels of the old leaves that are outside in the new leaves, or whose leaf was removed.
fn stored_difference(old: &Topology, inside: &[LeafMask], new: &Topology, left: &[LeafMask]) -> u64 {
    let flipped = |(&origin, inside): (&IVec3, &LeafMask)| {
        let mut flipped = *inside;
        if let Some(leaf) = new.find(origin) {
            flipped.remove_all(&left[leaf]);
        }
        u64::from(flipped.count())
    };
    old.origins().iter().zip(inside).map(flipped).sum()
}

/// A run of missing leaves along z that are inside: the origin of the first leaf, and the z after the last.
#[derive(Clone, Copy, Debug)]
struct LeafGap {
    first: IVec3,
    end_z: i32,
}

/// The inside gaps between stored leaves.
fn gaps(topology: &Topology, inside: &[LeafMask]) -> Vec<LeafGap> {
    let mut rows: Vec<([i32; 3], usize)> =
        topology.origins().iter().enumerate().map(|(leaf, origin)| (origin.to_array(), leaf)).collect();
    rows.par_sort_unstable();
    let gap = |pair: &[([i32; 3], usize)]| {
        let ([ax, ay, az], before) = pair[0];
        let ([bx, by, bz], after) = pair[1];
        // A row along z is a byte of the mask: its last bit is adjacent to the leaf above, its first bit to
        // the leaf below.
        let is_inside = |leaf: usize, bit: u64| {
            let face = inside[leaf].words.iter().map(|word| (word & bit).count_ones()).sum::<u32>();
            face > 32
        };
        let is_gap = ax == bx && ay == by && bz - az > LEAF_EDGE;
        (is_gap && is_inside(before, LAST_Z) && is_inside(after, FIRST_Z))
            .then_some(LeafGap { first: IVec3::new(ax, ay, az + LEAF_EDGE), end_z: bz })
    };
    rows.windows(2).filter_map(gap).collect()
}

/// The first and the last voxels of the rows of a mask word.
const FIRST_Z: u64 = 0x0101_0101_0101_0101;
const LAST_Z: u64 = FIRST_Z << 7;

/// Minimum distance of a voxel from a plane, in voxels.
const NEAREST_TO_PLANE: f64 = NEAREST_TO_ZERO as f64;

/// A box in voxels, and the half width of the band that it cuts.
#[derive(Clone, Copy, Debug)]
struct Cut {
    min: DVec3,
    max: DVec3,
    half_width: f64,
}

impl Cut {
    /// Distance of a voxel to the box.
    fn distance(&self, voxel: IVec3) -> f64 {
        distance(self.excess(voxel.as_dvec3(), voxel.as_dvec3()).map(off_zero))
    }

    /// Lower bound per axis of how far a box of voxels lies beyond the planes; negative if it is inside.
    fn excess(&self, first: DVec3, last: DVec3) -> DVec3 {
        (self.min - last).max(first - self.max)
    }

    /// True if no voxel of a leaf is within the half width of the box.
    fn is_beyond(&self, origin: IVec3) -> bool {
        let first = origin.as_dvec3();
        self.excess(first, first + LAST_IN_LEAF).max_element() >= self.half_width
    }

    /// True if all voxels of a leaf are in the box and at least the half width from its planes.
    fn is_within(&self, origin: IVec3) -> bool {
        let first = origin.as_dvec3();
        let last = first + LAST_IN_LEAF;
        (self.min - first).max(last - self.max).max_element() <= -self.half_width
    }

    /// The leaves of a gap that the caps need.
    fn cap_leaves(self, gap: LeafGap) -> impl Iterator<Item = IVec3> {
        // Leaves near the two z planes. Leaves between these planes only if the column is near another plane.
        let near = |plane: f64| self.leaves_between(plane, plane, &gap);
        let column = IVec3::new(gap.first.x, gap.first.y, 0);
        let (first, last) = (column.as_dvec3(), column.as_dvec3() + LAST_IN_LEAF);
        let from_sides = (self.min - first).max(last - self.max).truncate().max_element();
        let (low, high) = (near(self.min.z), near(self.max.z));
        let between = if from_sides > -self.half_width {
            self.leaves_between(self.min.z, self.max.z, &gap)
        } else {
            0..0
        };
        let leaves =
            low.chain(high).chain(between).map(move |z| IVec3::new(column.x, column.y, z * LEAF_EDGE));
        leaves.filter(move |&origin| !self.is_beyond(origin) && !self.is_within(origin))
    }

    /// The leaves of a gap within the half width of the z range `from` ..= `to` (voxels). The result is in
    /// units of leaves.
    fn leaves_between(&self, from: f64, to: f64, gap: &LeafGap) -> std::ops::Range<i32> {
        let (first, end) = (gap.first.z / LEAF_EDGE, gap.end_z / LEAF_EDGE);
        let edge = f64::from(LEAF_EDGE);
        let from = ((from - self.half_width) / edge).floor().max(f64::from(first));
        let to = ((to + self.half_width) / edge).floor().min(f64::from(end - 1));
        if from <= to { from as i32..to as i32 + 1 } else { 0..0 }
    }

    /// Number of voxels of a gap that are outside the box.
    fn outside_count(&self, gap: &LeafGap) -> u64 {
        let [first, end] =
            [gap.first, IVec3::new(gap.first.x + LEAF_EDGE, gap.first.y + LEAF_EDGE, gap.end_z)];
        let along = |axis: usize| {
            let least = (self.min[axis] + NEAREST_TO_PLANE).ceil().max(f64::from(first[axis]));
            let most = (self.max[axis] - NEAREST_TO_PLANE).floor().min(f64::from(end[axis] - 1));
            (most - least + 1.0).max(0.0) as u64
        };
        let all = (end - first).as_i64vec3().element_product().unsigned_abs();
        all - along(0) * along(1) * along(2)
    }

    /// The field on the leaves of `topology`, cut by the box. `from` gives each leaf's source, or `None` if
    /// it was deep inside.
    fn apply(self, field: &Field, topology: &Topology, from: &[Option<usize>], half_width: f32) -> Field {
        let deep = Leaf::splat(-half_width);
        let leaves = topology.origins().par_iter().zip(from).halved().map(|(&origin, from)| {
            let mut leaf = from.map_or(deep, |leaf| field.leaves[leaf]);
            if !self.is_within(origin) {
                for (offset, value) in leaf.values.iter_mut().enumerate() {
                    let distance = self.distance(origin + voxel_in_leaf(offset));
                    *value = value.max(distance.clamp(-self.half_width, self.half_width) as f32);
                }
            }
            leaf
        });
        Field { leaves: leaves.collect() }
    }
}

/// From the first voxel of a leaf to the last.
const LAST_IN_LEAF: DVec3 = DVec3::splat((LEAF_EDGE - 1) as f64);

/// Signed distance of a point to a box, given how far the point lies beyond the planes on each axis.
fn distance(excess: DVec3) -> f64 {
    let farthest = excess.max_element();
    if farthest > 0.0 { excess.max(DVec3::ZERO).length() } else { farthest }
}

/// Replaces a distance that is almost zero by [`NEAREST_TO_PLANE`].
fn off_zero(distance: f64) -> f64 {
    if distance.abs() < NEAREST_TO_PLANE { NEAREST_TO_PLANE } else { distance }
}
