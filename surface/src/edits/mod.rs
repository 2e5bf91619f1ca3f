//! Edits of the level set after smoothing: removes islands, fills cavities, and clips with a box.
//!
//! ```text
//!   ╭──────────────╮   ·  island      with few particles: becomes outside
//!   │    ○         │
//!   │    cavity    ┊                  of small volume: becomes inside
//!   ╰──────────────┊
//!                  ┊ box              the fluid outside is removed, the cut closed by a flat cap
//! ```
//!
//! Edits change φ rather than the mesh, so that the mesh and the .vdb file agree. The bounds of φ
//! ([`Bounds`](crate::level_set::Bounds)) are checked before edits and do not apply to them. Each
//! edit returns what it changed.
//!
//! The order is islands, cavities, box. Islands come first: a small drop in a bubble is removed before the
//! bubble's volume is compared with the limit, and a small hollow drop is removed together with its hollow.
//! Islands and cavities are found before the box cuts them, so that moving the box does not make drops appear
//! and disappear.
//!
//! **Connectivity** follows the contouring ([`crate::contour`]). On a cell face with alternating
//! signs, the contouring separates the two inside corners. So inside voxels are connected across faces, and
//! outside voxels across faces and edges.
//!
//! **Locality.** Whether a component is removed or filled depends on the whole component. But such a
//! component is small, within the requested limit, and φ changes only within the band's half width of it. The
//! box changes φ only outside and within a half width of its planes. So changes stay local.

mod components;
mod flip;

use std::collections::VecDeque;
use std::sync::Arc;

use glam::{DVec3, IVec3, Vec3};
use rayon::prelude::*;
use rustc_hash::FxHashSet;

use crate::grid::{
    FACE_STEPS, Field, LEAF_EDGE, LEAF_VOXELS, Leaf, LeafMask, Topology, negative_masks, voxel_in_leaf,
};
use crate::level_set::{NEAREST_TO_ZERO, NarrowBand};
use crate::mesh::Mesh;
use crate::parallel::Loops as _;
use crate::space::{CoordBox, Lattice};
use components::{Components, Connectivity};
use flip::{FlipSide, flip};

// Removes islands: components of the inside with few particles.
//
// A particle belongs to the component of the nearest inside corner of its cell. Usually the caller gives
// only the particles near the surface. So a component that extends into leaves deep inside, which are not
// stored, is kept without counting: one such leaf has room for hundreds of particles.

/// Result of removing islands.
#[derive(Clone, Debug)]
pub struct DroppedIslands {
    /// Number of removed components.
    pub piece_count: usize,
    /// Number of given particles in the removed components.
    pub particle_count: u64,
    /// Number of voxels that changed from inside to outside.
    pub voxel_count: u64,
    topology: Arc<Topology>,
    components: Components,
    is_dropped: Vec<bool>,
}

/// Removes the components of the inside with fewer than `particle_count_min` particles.
///
/// `particles` yields each leaf's origin and particle positions, in voxels relative to the origin (0 to 8 on
/// each axis). Particles that are not given are not counted.
pub fn drop_islands<P: AsRef<[Vec3]>>(
    band: &mut NarrowBand,
    particle_count_min: u64,
    particles: impl IntoIterator<Item = (IVec3, P)>,
) -> DroppedIslands {
    let topology = band.topology.clone();
    let components = Components::new(&topology, &negative_masks(&band.phi), Connectivity::Faces);
    let mut is_candidate = vec![particle_count_min > 0; components.count];
    for (component, _) in components.beyond(&topology) {
        is_candidate[component as usize] = false;
    }
    let mut dropped = DroppedIslands {
        piece_count: 0,
        particle_count: 0,
        voxel_count: 0,
        topology,
        components,
        is_dropped: is_candidate,
    };
    let counts = dropped.count_particles(particles);
    for (is_dropped, count) in dropped.is_dropped.iter_mut().zip(counts) {
        *is_dropped &= count < particle_count_min;
        dropped.piece_count += usize::from(*is_dropped);
        dropped.particle_count += if *is_dropped { count } else { 0 };
    }
    let flipped = dropped.components.voxels_of(&dropped.is_dropped);
    dropped.voxel_count = flipped.iter().map(|(_, mask)| u64::from(mask.count())).sum();
    flip(band, &flipped, FlipSide::Outside);
    dropped
}

impl DroppedIslands {
    /// True if a particle was in a removed component. `local` is in voxels relative to the origin of its
    /// leaf.
    pub fn contains(&self, leaf_origin: IVec3, local: Vec3) -> bool {
        self.component_of(leaf_origin, local).is_some_and(|component| self.is_dropped[component as usize])
    }

    /// Number of particles in each component that may still be removed.
    fn count_particles<P: AsRef<[Vec3]>>(&self, particles: impl IntoIterator<Item = (IVec3, P)>) -> Vec<u64> {
        let has_candidate: Vec<bool> = (0..self.topology.len())
            .map(|leaf| {
                self.components.of_leaf(leaf).any(|(component, _)| self.is_dropped[component as usize])
            })
            .collect();
        let mut counts = vec![0; self.components.count];
        for (origin, locals) in particles {
            // The cells of a leaf extend into the leaves after it.
            let reached =
                (0..8).filter_map(|k| self.topology.find(origin.wrapping_add(corner(k) * LEAF_EDGE)));
            if !reached.into_iter().any(|leaf| has_candidate[leaf]) {
                continue;
            }
            for &local in locals.as_ref() {
                if let Some(component) = self.component_of(origin, local) {
                    counts[component as usize] += 1;
                }
            }
        }
        counts
    }

    /// The component of a particle.
    fn component_of(&self, origin: IVec3, local: Vec3) -> Option<u32> {
        // Rounding can put a particle on the leaf's upper boundary.
        let cell = local.as_ivec3().clamp(IVec3::ZERO, IVec3::splat(LEAF_EDGE));
        let corners = (0..8).map(|k| cell + corner(k)).filter_map(|voxel| {
            let (leaf, index) = self.topology.find_voxel(origin.wrapping_add(voxel))?;
            let component = self.components.component_at(leaf, index)?;
            Some((local.distance_squared(voxel.as_vec3()), component))
        });
        corners.min_by(|one, other| one.0.total_cmp(&other.0)).map(|(_, component)| component)
    }
}

/// Corner `4x + 2y + z` of a cell.
fn corner(number: i32) -> IVec3 {
    IVec3::new(number >> 2, number >> 1 & 1, number & 1)
}

// Fills bubbles: small enclosed components of the outside.
//
//   leaves   [▒▒][▒▒][▒▒]     ▒ stored: a shell around the bubble
//            [▒▒]    [▒▒]     the missing leaf in the middle is also outside; a search visits missing leaves
//            [▒▒][▒▒][▒▒]     one by one, up to the volume limit
//
// The search stops when the component exceeds the volume limit or leaves the bounding box of all leaves. So
// it takes few steps for a bubble, and for the open outside no more steps than for the largest bubble.
//
// A drop within a bubble does not count toward the bubble's volume. If the bubble is filled, the drop merges
// with its surroundings.

/// Result of filling cavities.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct FilledCavities {
    /// Number of cavities that were filled.
    pub count: usize,
    /// Number of voxels that changed from outside to inside.
    pub voxel_count: u64,
}

/// Fills the enclosed components of the outside with fewer than `volume_voxels` voxels.
///
/// `kept` maps a leaf's origin to a mask of its voxels and is called once per leaf. Components with a voxel
/// in such a mask are not filled.
pub fn fill_cavities(
    band: &mut NarrowBand,
    volume_voxels: f64,
    kept: Option<&dyn Fn(IVec3) -> LeafMask>,
) -> FilledCavities {
    let topology = band.topology.clone();
    let complement = |mask: LeafMask| LeafMask { words: mask.words.map(|word| !word) };
    let outside: Vec<LeafMask> = negative_masks(&band.phi).into_iter().map(complement).collect();
    let mut search = CavitySearch::new(&topology, Components::new(&topology, &outside, Connectivity::Edges));
    if let Some(kept) = kept {
        search.keep(kept);
    }
    let mut filled = FilledCavities::default();
    for component in 0..search.components.count as u32 {
        if let Some(volume) = search.enclosed(component, volume_voxels) {
            filled.count += 1;
            filled.voxel_count += volume;
        }
    }
    let is_filled: Vec<bool> = search.states.iter().map(|state| *state == ComponentState::Enclosed).collect();
    flip(band, &search.components.voxels_of(&is_filled), FlipSide::Inside);
    filled
}

/// State of a component.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum ComponentState {
    Unknown,
    /// At least as large as the limit, or connected to the open outside.
    Open,
    /// Enclosed; part of a cavity to be filled.
    Enclosed,
}

/// The components of the outside, and the missing leaves between them.
struct CavitySearch<'a> {
    topology: &'a Topology,
    components: Components,
    volumes: Vec<u64>,
    /// The contacts between components and missing leaves, sorted by component; `by_leaf` has the same
    /// contacts sorted by leaf.
    by_component: Vec<(u32, [i32; 3])>,
    by_leaf: Vec<([i32; 3], u32)>,
    /// Bounding box of all stored leaves.
    extent: CoordBox,
    states: Vec<ComponentState>,
    /// Missing leaves that are connected to the open outside or to a component that is too large.
    open: FxHashSet<IVec3>,
}

impl<'a> CavitySearch<'a> {
    fn new(topology: &'a Topology, components: Components) -> CavitySearch<'a> {
        let beyond = components.beyond(topology);
        let mut by_component: Vec<_> =
            beyond.iter().map(|&(component, leaf)| (component, leaf.to_array())).collect();
        let mut by_leaf: Vec<_> =
            beyond.into_iter().map(|(component, leaf)| (leaf.to_array(), component)).collect();
        by_component.sort_unstable();
        by_component.dedup();
        by_leaf.sort_unstable();
        by_leaf.dedup();
        let mut extent = CoordBox::EMPTY;
        topology.origins().iter().for_each(|&origin| extent.include(origin));
        let (volumes, states) = (components.volumes(), vec![ComponentState::Unknown; components.count]);
        let open = FxHashSet::default();
        CavitySearch { topology, components, volumes, by_component, by_leaf, extent, states, open }
    }

    /// Marks the components with a kept voxel as open.
    fn keep(&mut self, kept: &dyn Fn(IVec3) -> LeafMask) {
        for (leaf, &origin) in self.topology.origins().iter().enumerate() {
            let kept = kept(origin);
            if kept.is_empty() {
                continue;
            }
            for (component, mask) in self.components.of_leaf(leaf) {
                if !mask.and(&kept).is_empty() {
                    self.states[component as usize] = ComponentState::Open;
                }
            }
        }
    }

    /// The volume of the cavity that contains a component, in voxels. `None` if it is at least `volume_max`, or the cavity
    /// is open, or was visited already.
    fn enclosed(&mut self, component: u32, volume_max: f64) -> Option<u64> {
        if self.states[component as usize] != ComponentState::Unknown {
            return None;
        }
        let mut walk = CavityWalk { volume: self.volumes[component as usize], ..CavityWalk::default() };
        walk.components.insert(component);
        self.enter(component, &mut walk);
        let mut is_enclosed = (walk.volume as f64) < volume_max;
        while is_enclosed && let Some(leaf) = walk.queue.pop_front() {
            walk.volume += LEAF_VOXELS as u64;
            is_enclosed = self.extent.contains(leaf)
                && !self.open.contains(&leaf)
                && self.pass(leaf, &mut walk)
                && (walk.volume as f64) < volume_max;
        }
        let state = if is_enclosed { ComponentState::Enclosed } else { ComponentState::Open };
        for component in &walk.components {
            self.states[*component as usize] = state;
        }
        if !is_enclosed {
            self.open.extend(walk.leaves);
            return None;
        }
        Some(walk.volume)
    }

    /// Queues the missing leaves that a component touches.
    fn enter(&self, component: u32, walk: &mut CavityWalk) {
        let first = self.by_component.partition_point(|&(other, _)| other < component);
        for &(_, leaf) in self.by_component[first..].iter().take_while(|&&(other, _)| other == component) {
            walk.reach(IVec3::from(leaf));
        }
    }

    /// Continues the search from a missing leaf. Returns false if the leaf touches a component that is open.
    fn pass(&self, leaf: IVec3, walk: &mut CavityWalk) -> bool {
        for face in FACE_STEPS.map(|step| leaf.wrapping_add(step * LEAF_EDGE)) {
            if self.topology.find(face).is_none() {
                walk.reach(face);
            }
        }
        let key = leaf.to_array();
        let first = self.by_leaf.partition_point(|&(other, _)| other < key);
        for &(_, component) in self.by_leaf[first..].iter().take_while(|&&(other, _)| other == key) {
            if self.states[component as usize] == ComponentState::Open {
                return false;
            }
            if walk.components.insert(component) {
                walk.volume += self.volumes[component as usize];
                self.enter(component, walk);
            }
        }
        true
    }
}

/// A breadth-first search through connected components and leaves.
#[derive(Default)]
struct CavityWalk {
    volume: u64,
    components: FxHashSet<u32>,
    /// Missing leaves: all that were reached, and those still in the queue.
    leaves: FxHashSet<IVec3>,
    queue: VecDeque<IVec3>,
}

impl CavityWalk {
    fn reach(&mut self, leaf: IVec3) {
        if self.leaves.insert(leaf) {
            self.queue.push_back(leaf);
        }
    }
}

// Clips the fluid with a box and closes the cuts with flat caps: φ ← max(φ, distance to the box).
//
//     ┊     box      ┊
//   ╭─┊──────────────┊──╮        ▒ stored leaves
//   │▒┊▒▒▒▒▒▒▒▒▒▒▒▒▒▒┊▒▒│        c leaves added for the caps, where the box cuts through the deep interior,
//   │▒c              c ▒│          which has no stored leaves. Leaves outside the box are removed
//
// A gap between two stored leaves along z is deep inside if the two leaf faces next to it are inside, as in
// a .vdb file.
//
// A cap lies on its plane, with one exception: if a plane passes within 1/128 voxel of a layer of voxels,
// the cap is moved inward to that distance, because meshers fold a surface that almost touches voxels.
//
// Where a cap meets the fluid's own surface in a sharp edge, a mesher locates the edge only to a fraction of
// a voxel and may place vertices slightly beyond the plane. So the mesh is clamped to the box afterwards
// (`VoxelClip::clamp_mesh`).

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
