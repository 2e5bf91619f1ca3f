//! Determines which leaves, voxels and particles can affect the surface of a frame; nothing else is stored.
//! The only input is the occupancy, which records where particles are to half a voxel.
//!
//! ```text
//!   · · · · · · · · ·      ·  no particle within r_init
//!   · n n n n n n n ·      n  near: the surface may pass through
//!   n n n n n n n n n      +  within the band's margin of a near leaf: distances may be needed
//!   + k k k k k k k +      k  particles that may be the nearest to a needed voxel or vertex
//!   d d d d d d d d d      d  deep: every voxel, and every adjacent voxel, is inside S_0
//! ```
//!
//! **Leaves.** The band consists of leaves around crossings: voxels inside S_0 with a face neighbor outside.
//! A deep leaf has no crossing, and neither has a leaf without a particle within r_init of one of its voxels.
//! The remaining leaves are called *near* and contain all crossings. Distances are needed only in leaves
//! within the band's margin of near leaves. Particles change nothing if they are farther from all of these
//! leaves than the distance up to which exact distances are computed (`Radii::exact_reach`).
//!
//! **Values.** Inside S_min, the value of the distance d to the nearest particle is used only next to a voxel
//! outside S_min. Elsewhere inside S_min, `d` is only compared with the three radii, and r_min is the
//! smallest of them. So voxels that are certainly inside S_min together with all face neighbors are
//! *settled*: 0 serves as their distance.
//!
//! **Particles.** Let p be a particle and ρ ≤ r_min, and let every voxel within ρ + 3/2·√3 of p be certainly
//! within ρ of some particle. Then p can be dropped:
//!
//! - It is not the nearest particle to any point x at a distance of ρ + √3/2 or more. Suppose it were. Then no
//!   particle is nearer to x. Let w be the point on the line from p to x at distance ρ + √3/2 from p: the ball
//!   around w with that radius contains no particle. The voxel nearest to w, at most √3/2 away, is then ρ or
//!   more from every particle; but it is within ρ + √3 of p, a contradiction.
//! - So every voxel that p is nearest to is within ρ + √3/2 of p. Hence it is within ρ of some particle, and
//!   nearer to p than ρ. Its face neighbors are within ρ + 3/2·√3 of p, and therefore also within ρ of some
//!   particle: the voxel is settled.
//! - A mesh vertex that p is nearest to is nearer to p than ρ + √3/2, so the corners of the vertex's cell are
//!   within ρ + 3/2·√3. All of them are in S_min, where φ is negative, and such a cell has no vertex.
//! - The corners of the cell that contains p are within √3 of p, so p is inside any surface that is found.
//!
//! If the smoothed surface is moved inward by b, a vertex x may lie within S_min. Then some point of the
//! surface before the move is at distance b from x. The argument holds for that point if all voxels within
//! ρ + b + 3/2·√3 of p are checked.
//!
//! For anisotropic particles, the argument uses balls that each particle certainly contains. [Round](ROUND)
//! particles contain larger balls than flat ones. So there is a second test, with these larger balls of the
//! round particles alone: voxels that it finds inside are inside, too. With anisotropic particles, every
//! particle that reaches a leaf where distances may be needed is kept, because a long particle may be the
//! nearest to a distant point.
//!
//! Where an obstacle's surface passes through a deep region, the fluid has a surface, too, so these leaves
//! are near.
//!
//! With kernels, a voxel is certainly inside if all voxels within r_init of it, along the axes, are within r_init of a
//! particle: the sum of kernels of such a body is far above the level. No particle in reach of a needed leaf is dropped.
//! Voxels are often too small for that, since particles do not cover them. So the sum is then computed at a few points
//! of each near leaf, and leaves where it is [high](super::kernels::High), as in all leaves around, become deep.
//!
//! Validation uses the kept particles to find the inside where φ is not stored. If r_init is above √3, each
//! kept particle alone shows that the voxels around it are inside; for a smaller r_init that does not hold,
//! and no particle is dropped. For anisotropic particles, the set of deep leaves is kept for this purpose.

use std::borrow::Cow;

use glam::IVec3;
use rayon::iter::Either;
use rayon::prelude::*;
use rustc_hash::FxHashSet;

use super::occupancy::{Occupancy, Octants, ROUND};
use super::{Radii, RasterParams, Regions, Start};
use crate::cancel::checkpoint;
use crate::grid::{LEAF_EDGE, LeafMask, NO_LEAF, Topology, leaf_steps_within};
use crate::parallel::Loops as _;
use crate::simd::{self, Kernel, Lanes};
use crate::space::CoordBox;

/// The leaves, voxels and cells that can affect the surface.
pub(super) struct Culling<'a> {
    /// Leaves that the surface may pass through.
    pub(super) near: Topology,
    /// The leaves that contain particles, within the window's region. `inside`, `settled` and `kept` follow
    /// its order.
    occupied: Cow<'a, Topology>,
    /// Voxels that are certainly inside S_0, with all face neighbors.
    inside: Vec<LeafMask>,
    /// Voxels whose exact distance is not needed: it is less than r_min, or, with kernels, they are certainly inside.
    settled: Vec<LeafMask>,
    /// The cells whose particles are kept.
    kept: Vec<LeafMask>,
}

/// Voxels certainly within r_init of a particle, and voxels certainly within ρ ≤ r_min.
type Covers = [LeafMask; 2];

/// Upper limit of ρ; a larger value has no advantage.
const RHO_MAX: f32 = 4.0;

/// Upper limit of the search distance around a particle: its search box must lie within the adjacent leaves.
const AROUND_MAX: f32 = 7.9;

/// 3/2·√3 plus a rounding margin.
const CELL_MARGIN: f32 = 2.598_077 + ROUNDING;

/// If r_init is below this, in voxels, no particle is dropped: √3 plus a margin.
const COVERING_RADIUS: f32 = 1.75;

/// Added to distances that are compared with values computed in 32 bits.
const ROUNDING: f32 = 1e-2;

impl<'a> Culling<'a> {
    /// Determines what can affect the surface in the leaves of a window.
    pub(super) fn new(occupancy: &'a Occupancy, scene: &RasterParams, regions: &Regions) -> Culling<'a> {
        let radii = scene.radii;
        let occupied = populated(&occupancy.topology, &regions.populated);
        let inward = (-radii.offset).max(0.0);
        let has_kernels = radii.start == Start::Kernels;
        let rho = |held: f32| {
            if has_kernels {
                0.0
            } else {
                (radii.min * held).min(RHO_MAX).min(AROUND_MAX - CELL_MARGIN - inward)
            }
        };
        let balls = |held: f32| [OctantBall::new(radii.init * held), OctantBall::new(rho(held))];
        let covers = covers(occupancy, &occupied, radii, balls);
        let mut inside = surrounded(&occupied, &covers, |[init, _]| init);
        let settled = if has_kernels {
            for _ in 1..radii.init.ceil() as u32 {
                inside = surrounded(&occupied, &inside, |inside| inside);
            }
            // The sum of kernels may be below the level even here. All voxels next to a deep leaf are settled, so that
            // no surface passes between the two: three steps over faces reach the 26 neighbors.
            let settled = inside;
            inside = surrounded(&occupied, &settled, |settled| settled);
            for _ in 1..3 {
                inside = surrounded(&occupied, &inside, |inside| inside);
            }
            settled
        } else {
            surrounded(&occupied, &covers, |[_, min]| min)
        };
        let near = near_leaves(occupancy, &occupied, &inside, scene, &regions.measured);
        let kept = Vec::new();
        let mut culling = Culling { near, occupied, inside, settled, kept };
        culling.kept = if scene.keeps_all_particles {
            vec![LeafMask::FULL; culling.occupied.len()]
        } else if occupancy.has_shapes || has_kernels {
            culling.kept_leaves(occupancy, radii, regions)
        } else {
            culling.kept_cells(&covers, radii, rho(1.0) + inward, regions)
        };
        culling
    }

    /// True if every voxel of a leaf, and every adjacent voxel, is inside S_0.
    pub(super) fn is_deep(&self, origin: IVec3) -> bool {
        self.occupied.find(origin).is_some_and(|leaf| self.inside[leaf] == LeafMask::FULL)
    }

    /// Origins of the deep leaves, in order.
    pub(super) fn deep_leaves(&self) -> impl Iterator<Item = IVec3> {
        let leaves = self.occupied.origins().iter().zip(&self.inside);
        leaves.filter(|(_, inside)| **inside == LeafMask::FULL).map(|(&origin, _)| origin)
    }

    /// Whether all leaves around a near leaf are near or deep.
    pub(super) fn is_surrounded(&self, leaf: usize) -> bool {
        let origin = self.near.origins()[leaf];
        cube(|step| self.near.find(origin + step).is_some() || self.is_deep(origin + step)) == [true; 27]
    }

    /// Makes the near leaves deep that are inside. `are_high` tells of each near leaf whether the sum of kernels is
    /// [`High`](super::kernels::High) there.
    pub(super) fn deepen(&mut self, are_high: &[bool], scene: &RasterParams) {
        let is_high = |origin: IVec3| match self.near.find(origin) {
            Some(leaf) => are_high[leaf],
            None => self.is_deep(origin),
        };
        let is_inside = |origin: &IVec3| {
            is_high(*origin)
                && cube(|step| is_high(origin + step)) == [true; 27]
                && self.occupied.find(*origin).is_some()
                && !scene.is_at_obstacle(*origin)
        };
        let (inside, near): (Vec<IVec3>, Vec<IVec3>) =
            self.near.origins().par_iter().halved().partition_map(|&origin| {
                if is_inside(&origin) { Either::Left(origin) } else { Either::Right(origin) }
            });
        for leaf in inside.into_iter().filter_map(|origin| self.occupied.find(origin)) {
            self.inside[leaf] = LeafMask::FULL;
        }
        self.near = Topology::new(near);
    }

    /// The voxels of a leaf that are in S_min and whose exact distance is not needed.
    pub(super) fn settled(&self, origin: IVec3) -> &LeafMask {
        self.occupied.find(origin).map_or(&LeafMask::EMPTY, |leaf| &self.settled[leaf])
    }

    /// The leaves that may contain required particles.
    pub(super) fn occupied(&self) -> &Topology {
        &self.occupied
    }

    /// The cells of one of these leaves whose particles are required.
    pub(super) fn kept(&self, leaf: usize) -> &LeafMask {
        &self.kept[leaf]
    }

    fn kept_cells(&self, covers: &[Covers], radii: Radii, depth: f32, regions: &Regions) -> Vec<LeafMask> {
        if radii.init < COVERING_RADIUS {
            return vec![LeafMask::FULL; self.occupied.len()];
        }
        let measured = self.measured_leaves(radii, regions);
        let rings = leaf_steps_within(radii.exact_reach(1.0));
        let around = (depth + CELL_MARGIN) as i32;
        let kept = |&origin: &IVec3| {
            if !rings.iter().any(|&step| measured.contains(&(origin + step))) {
                return LeafMask::EMPTY;
            }
            let covers = cube(|step| match self.occupied.find(origin + step) {
                Some(leaf) => &covers[leaf][1],
                None => &LeafMask::EMPTY,
            });
            simd::dispatch(Uncovered { covers, around })
        };
        self.occupied.origins().par_iter().halved().map(kept).collect()
    }

    /// For each leaf, the cells whose particles are kept: all cells if a particle of the leaf may reach a
    /// leaf where distances may be needed, and otherwise none.
    fn kept_leaves(&self, occupancy: &Occupancy, radii: Radii, regions: &Regions) -> Vec<LeafMask> {
        let measured = self.measured_leaves(radii, regions);
        let rings = |doublings: i32| leaf_steps_within(radii.exact_reach(2f32.powi(doublings)));
        let doublings = |longest: f32| longest.max(1.0).log2().ceil() as i32;
        let rings: Vec<Vec<IVec3>> = (0..=doublings(occupancy.longest())).map(rings).collect();
        let kept = |&origin: &IVec3| {
            let steps = &rings[doublings(occupancy.longest_of(origin)) as usize];
            let is_near = steps.iter().any(|&step| measured.contains(&(origin + step)));
            if is_near { LeafMask::FULL } else { LeafMask::EMPTY }
        };
        self.occupied.origins().par_iter().halved().map(kept).collect()
    }

    /// Leaves whose distances may be needed: the near leaves, and those that may be in the band.
    fn measured_leaves(&self, radii: Radii, regions: &Regions) -> FxHashSet<IVec3> {
        let surface = |&origin: &IVec3| {
            let leaf = self.occupied.find(origin);
            // A voxel whose face neighbors are all inside is not next to the surface.
            let inside = leaf.map_or(LeafMask::EMPTY, |leaf| self.inside[leaf]);
            let voxels = if inside == LeafMask::FULL {
                // An obstacle cuts through the leaf.
                LeafMask::FULL.bounding_box()
            } else {
                inside.complement().bounding_box()
            };
            (origin, voxels.expanded(radii.band_margin()))
        };
        let surfaces: Vec<(IVec3, CoordBox)> = self.near.origins().par_iter().halved().map(surface).collect();
        let banded = leaves_of_boxes(&surfaces, |origin| regions.swept.contains(origin));
        banded.into_iter().chain(self.near.origins().iter().copied()).collect()
    }
}

/// The leaves of a region.
fn populated<'a>(topology: &'a Topology, region: &CoordBox) -> Cow<'a, Topology> {
    let is_in = |origin: &&IVec3| region.contains(**origin);
    if topology.origins().par_iter().halved().all(|origin| is_in(&origin)) {
        return Cow::Borrowed(topology);
    }
    Cow::Owned(Topology::new(topology.origins().par_iter().halved().filter(is_in).copied().collect()))
}

/// The voxels of each leaf that are certainly in a particle. Every particle contains a ball; round ones
/// contain a larger one. `balls` takes the radius of such a ball, relative to the settings' radii. It returns
/// the octants within this fraction of r_init, and the octants within the corresponding ρ.
fn covers(
    occupancy: &Occupancy,
    leaves: &Topology,
    radii: Radii,
    balls: impl Fn(f32) -> [OctantBall; 2],
) -> Vec<Covers> {
    let of_any = balls(radii.min_scale);
    let of_round = balls(ROUND.max(radii.min_scale));
    let is_any_empty = of_any.iter().all(OctantBall::is_empty);
    let around = |origin: IVec3, octants: fn(&Occupancy, IVec3) -> Option<&Octants>| {
        cube(|step| octants(occupancy, origin + step).unwrap_or(&Octants::EMPTY))
    };
    let cover = |&origin: &IVec3| {
        let mut covers = [LeafMask::EMPTY; 2];
        if !is_any_empty {
            let around = around(origin, Occupancy::octants_of);
            covers = simd::dispatch(Cover { around, balls: of_any.each_ref() });
        }
        if occupancy.has_shapes && radii.min_scale < ROUND {
            let around = around(origin, Occupancy::round_octants_of);
            let by_round = simd::dispatch(Cover { around, balls: of_round.each_ref() });
            covers = [0, 1].map(|ball| covers[ball].or(&by_round[ball]));
        }
        covers
    };
    leaves.origins().par_iter().halved().map(cover).collect()
}

/// Collects one value for a leaf and its 26 neighbors.
/// The value at step (x, y, z) has the index (x + 1)·9 + (y + 1)·3 + z + 1.
fn cube<T>(at: impl Fn(IVec3) -> T) -> [T; 27] {
    std::array::from_fn(|index| {
        let index = index as i32;
        at((IVec3::new(index / 9, index / 3 % 3, index % 3) - 1) * LEAF_EDGE)
    })
}

/// The voxels of each leaf that are covered, with all face neighbors.
fn surrounded<T: Sync>(
    leaves: &Topology,
    covers: &[T],
    of: impl Fn(&T) -> &LeafMask + Sync,
) -> Vec<LeafMask> {
    let surrounded = |(leaf, neighbors): (usize, &[u32; 6])| {
        let face = |neighbor: u32| match neighbor {
            NO_LEAF => &LeafMask::EMPTY,
            neighbor => of(&covers[neighbor as usize]),
        };
        of(&covers[leaf]).surrounded(neighbors.map(face))
    };
    leaves.neighbors().par_iter().enumerate().halved().map(surrounded).collect()
}

/// The leaves of a region with a voxel that may be within r_init of a particle, without the deep leaves.
/// However, deep leaves that an obstacle's surface passes through are included.
fn near_leaves(
    occupancy: &Occupancy,
    occupied: &Topology,
    inside: &[LeafMask],
    scene: &RasterParams,
    region: &CoordBox,
) -> Topology {
    let radius = scene.radii.start_reach();
    let is_deep = |leaf: usize| inside[leaf] == LeafMask::FULL;
    let reach_of = |longest: f32| (radius * longest + ROUNDING) as i32;
    let reach = reach_of(occupancy.longest());
    // A leaf is buried if it is deep and all leaves within reach of its particles are deep, too. Three passes
    // over the faces reach all 26 neighbors.
    let mut is_buried: Vec<bool> = (0..occupied.len()).map(is_deep).collect();
    for _ in 0..3 * (reach as u32 + 1).div_ceil(LEAF_EDGE as u32) {
        let all_around =
            |leaf: usize| occupied.neighbors()[leaf].iter().all(|&n| n != NO_LEAF && is_buried[n as usize]);
        is_buried = (0..occupied.len())
            .into_par_iter()
            .halved()
            .map(|leaf| is_buried[leaf] && all_around(leaf))
            .collect();
    }
    let reached = |(leaf, &origin): (usize, &IVec3)| {
        if is_buried[leaf] {
            return None;
        }
        let cells = occupancy.octants_of(origin)?.cells();
        let reach = reach_of(occupancy.longest_of(origin));
        // A particle lies up to one voxel beyond its cell's voxel.
        let voxels = CoordBox { min: cells.min - reach, max: cells.max + 1 + reach };
        Some((origin, voxels))
    };
    let reached: Vec<(IVec3, CoordBox)> =
        occupied.origins().par_iter().enumerate().halved().filter_map(reached).collect();
    let is_near = |origin| region.contains(origin) && !occupied.find(origin).is_some_and(is_deep);
    let mut near = leaves_of_boxes(&reached, is_near);
    if !scene.obstacles.is_empty() {
        let deep = occupied.origins().par_iter().enumerate().halved().filter(|(leaf, _)| is_deep(*leaf));
        let at_obstacle = |&origin: &IVec3| region.contains(origin) && scene.is_at_obstacle(origin);
        near.par_extend(deep.map(|(_, &origin)| origin).filter(at_obstacle));
    }
    Topology::new(near)
}

/// Origins of the leaves that the boxes touch, filtered by `is_wanted`. Each box is relative to its origin.
/// Few origins occur twice.
pub(super) fn leaves_of_boxes(
    boxes: &[(IVec3, CoordBox)],
    is_wanted: impl Fn(IVec3) -> bool + Sync,
) -> Vec<IVec3> {
    leaves_around_boxes(boxes, 0, is_wanted)
}

/// Like [`leaves_of_boxes`], with the leaves whose voxels are within `margin` voxels of a box along each axis, and
/// at most one voxel more in a straight line.
pub(super) fn leaves_around_boxes(
    boxes: &[(IVec3, CoordBox)],
    margin: i32,
    is_wanted: impl Fn(IVec3) -> bool + Sync,
) -> Vec<IVec3> {
    let touched = |boxes: &[(IVec3, CoordBox)]| {
        checkpoint();
        let mut origins = FxHashSet::with_capacity_and_hasher(boxes.len(), Default::default());
        for boxes in boxes.chunk_by(|(leaf, _), (next, _)| leaf == next) {
            for_each_leaf_around(boxes, margin, |origin| {
                origins.insert(origin);
            });
        }
        origins.into_iter().filter(|&origin| is_wanted(origin)).collect::<Vec<_>>()
    };
    boxes.par_chunks(BOXES).halved().flat_map_iter(touched).collect()
}

/// Calls `each` once for each leaf around the boxes of one origin, as [`leaves_around_boxes`] finds them.
pub(super) fn for_each_leaf_around(boxes: &[(IVec3, CoordBox)], margin: i32, mut each: impl FnMut(IVec3)) {
    let boxes = || boxes.iter().filter(|(_, voxels)| !voxels.is_empty());
    let Some(&(origin, mut around)) = boxes().next() else { return };
    for (_, voxels) in boxes() {
        around.include(voxels.min);
        around.include(voxels.max);
    }
    let apart_max = (margin + 1) * (margin + 1);
    let is_near = |leaf: IVec3| {
        boxes().any(|(_, voxels)| {
            let apart = (voxels.min - (leaf + (LEAF_EDGE - 1))).max(leaf - voxels.max).max(IVec3::ZERO);
            apart.length_squared() <= apart_max
        })
    };
    let edge = IVec3::splat(LEAF_EDGE);
    let (first, last) = ((around.min - margin).div_euclid(edge), (around.max + margin).div_euclid(edge));
    for x in first.x..=last.x {
        for y in first.y..=last.y {
            let along_z = (first.z..=last.z).map(|z| IVec3::new(x, y, z) * LEAF_EDGE);
            along_z.filter(|&leaf| is_near(leaf)).for_each(|leaf| each(origin + leaf));
        }
    }
}

/// Number of boxes whose leaves are collected together.
const BOXES: usize = 256;

/// Kernel: the cells of a leaf from which an uncovered voxel is within reach, i.e. at most `around` voxels
/// before or after the cell on each axis.
pub(super) struct Uncovered<'a> {
    /// The leaf and its 26 neighbors, in the order of [`cube`].
    pub(super) covers: [&'a LeafMask; 27],
    /// At most 7.
    pub(super) around: i32,
}

impl Kernel for Uncovered<'_> {
    type Output = LeafMask;

    #[inline(always)]
    fn run<V: Lanes>(self) -> LeafMask {
        if self.covers.iter().all(|&cover| *cover == LeafMask::FULL) {
            return LeafMask::EMPTY;
        }
        let around = self.around as usize;
        // Rows of 24 along z; those of the leaf itself start at 8 on every axis.
        let mut rows = [[0u32; 24]; 24];
        for (x, rows) in rows.iter_mut().enumerate() {
            for (y, row) in rows.iter_mut().enumerate() {
                let leaf = x / 8 * 9 + y / 8 * 3;
                let parts = [0, 1, 2].map(|z| u32::from(!self.covers[leaf + z].row(x % 8 * 8 + y % 8)));
                *row = parts[0] | parts[1] << 8 | parts[2] << 16;
            }
        }
        let mut along_z = [[0u32; 24]; 24];
        for step in 0..=2 * around + 1 {
            for (to, from) in along_z.as_flattened_mut().iter_mut().zip(rows.as_flattened()) {
                *to |= *from << around >> step;
            }
        }
        let mut along_y = [[0u32; 8]; 24];
        for (to, from) in along_y.iter_mut().zip(&along_z) {
            for step in 0..=2 * around + 1 {
                let from = &from[8 + step - around..][..8];
                to.iter_mut().zip(from).for_each(|(to, from)| *to |= from);
            }
        }
        let mut kept = LeafMask::EMPTY;
        for (x, word) in kept.words.iter_mut().enumerate() {
            let mut rows = [0u32; 8];
            for from in &along_y[8 + x - around..=9 + x + around] {
                rows.iter_mut().zip(from).for_each(|(to, from)| *to |= from);
            }
            *word = u64::from_le_bytes(rows.map(|row| (row >> 8) as u8));
        }
        kept
    }
}

// Finds the voxels that certainly have a particle within a given radius, from `Octants`.
//
//            r
//       ╭─────────╮         An octant covers a voxel v if the octant's farthest corner is within r of v.
//     ╭─┼─┐     ┌─┼─╮       Octants a steps from v in x and b steps in y (1: adjacent to v) cover v if they
//     │ └─┼──v──┼─┘ │       are at most m(a, b) steps away along z, in either direction:
//     ╰───┴─────┴───╯       a² + b² + m² < (2r)²
//
// So a row of voxels is computed from rows of octants, each dilated along z by its m. That takes a few dozen
// word operations per row, however many particles there are.

/// Maximum number of octants visited to each side of a voxel. A larger radius is reduced to fit. The result
/// is then conservative: fewer voxels are covered, none wrongly.
const REACH: usize = 8;

/// The radius is reduced by this much, in voxels, so that rounding cannot matter.
const COVER_ROUNDING: f32 = 1e-3;

/// The octants within a radius of a voxel.
pub(super) struct OctantBall {
    /// Entry m − 1 has the rows of octants that cover a voxel up to m steps along z, as steps in x and y from
    /// the voxel's own octant.
    rows_of_width: Vec<Vec<[i32; 2]>>,
}

impl OctantBall {
    /// The octants within `radius` voxels.
    pub(super) fn new(radius: f32) -> OctantBall {
        let limit = (2.0 * (radius - COVER_ROUNDING)).max(0.0).powi(2);
        let width = |x: i32, y: i32| {
            let lateral = [x, y].map(|along| if along < 0 { -along } else { along + 1 } as f32);
            let across = lateral[0] * lateral[0] + lateral[1] * lateral[1];
            (1..=REACH).take_while(|&m| across + (m * m) as f32 <= limit).count()
        };
        let mut rows_of_width = vec![Vec::new(); REACH];
        let axis = || -(REACH as i32)..REACH as i32;
        for (x, y) in axis().flat_map(|x| axis().map(move |y| (x, y))) {
            if let Some(rows) = width(x, y).checked_sub(1).map(|width| &mut rows_of_width[width]) {
                rows.push([x, y]);
            }
        }
        let width_count = rows_of_width.iter().rposition(|rows| !rows.is_empty()).map_or(0, |last| last + 1);
        rows_of_width.truncate(width_count);
        OctantBall { rows_of_width }
    }

    /// True if no octant lies entirely within the radius of a voxel.
    pub(super) fn is_empty(&self) -> bool {
        self.rows_of_width.is_empty()
    }
}

/// Kernel: the voxels of a leaf that certainly have a particle within each of these radii.
pub(super) struct Cover<'a, const BALLS: usize> {
    /// The leaf and its 26 neighbors; the one at step (x, y, z) is at index (x + 1)·9 + (y + 1)·3 + z + 1.
    pub(super) around: [&'a Octants; 27],
    pub(super) balls: [&'a OctantBall; BALLS],
}

/// Rows of octants along z, of the leaf and eight more on each side: bit 8 is the leaf's first octant. Row
/// (x, y) is at `[x + 8][(y + 8) % 2][(y + 8) / 2]`, so that rows with the same parity of y are contiguous.
type OctantRows = [[[u32; 16]; 2]; 32];

impl<const BALLS: usize> Kernel for Cover<'_, BALLS> {
    type Output = [LeafMask; BALLS];

    #[inline(always)]
    fn run<V: Lanes>(self) -> [LeafMask; BALLS] {
        let mut rows = self.gather();
        let mut found = [[[0u32; 8]; 8]; BALLS];
        for width in 0..REACH {
            // Start with the two octants of each voxel; every step dilates by one octant to each side.
            for row in rows.as_flattened_mut().as_flattened_mut() {
                *row |= if width == 0 { *row << 1 } else { *row << 1 | *row >> 1 };
            }
            for (found, ball) in found.iter_mut().zip(self.balls) {
                for &[x_step, y_step] in ball.rows_of_width.get(width).into_iter().flatten() {
                    let (x_step, y_step) = ((x_step + 8) as usize, (y_step + 8) as usize);
                    for (x, found) in found.iter_mut().enumerate() {
                        let from = &rows[2 * x + x_step][y_step & 1][y_step >> 1..][..8];
                        for (found, &row) in found.iter_mut().zip(from) {
                            *found |= row;
                        }
                    }
                }
            }
            if self.balls.iter().all(|ball| ball.rows_of_width.len() <= width + 1) {
                break;
            }
        }
        found.map(voxels_of)
    }
}

impl<const BALLS: usize> Cover<'_, BALLS> {
    #[inline(always)]
    fn gather(&self) -> OctantRows {
        let mut rows = [[[0; 16]; 2]; 32];
        for (x, rows) in rows.iter_mut().enumerate() {
            for y in 0..32 {
                let leaf = ((x + 8) >> 4) * 9 + ((y + 8) >> 4) * 3;
                let row = ((x + 8) & 15) * 16 + ((y + 8) & 15);
                let [before, own, after] = [0, 1, 2].map(|z| u32::from(self.around[leaf + z].rows[row]));
                rows[y & 1][y >> 1] = before >> 8 | own << 8 | after << 24;
            }
        }
        rows
    }
}

/// The voxels for which the bit of the first of their two octants along z is set.
#[inline(always)]
fn voxels_of(found: [[u32; 8]; 8]) -> LeafMask {
    let mut mask = LeafMask::EMPTY;
    for (word, rows) in mask.words.iter_mut().zip(found) {
        for (y, row) in rows.into_iter().enumerate() {
            // Compact every second bit.
            let mut bits = row >> 8 & 0x5555;
            bits = (bits | bits >> 1) & 0x3333;
            bits = (bits | bits >> 2) & 0x0f0f;
            bits = (bits | bits >> 4) & 0x00ff;
            *word |= u64::from(bits) << (8 * y);
        }
    }
    mask
}

#[cfg(test)]
mod tests {
    use glam::{IVec3, Vec3};

    use super::*;
    use crate::grid::voxel_in_leaf;
    use crate::simd::{SimdLevel, dispatch_at};

    /// All octants around a leaf as one list, relative to its origin.
    fn octants(around: &[Octants; 27]) -> Vec<IVec3> {
        let mut all = Vec::new();
        for (leaf, octants) in around.iter().enumerate() {
            let step = IVec3::new(leaf as i32 / 9, leaf as i32 / 3 % 3, leaf as i32 % 3) - 1;
            for (row, bits) in octants.rows.into_iter().enumerate() {
                let set = (0..16).filter(|z| bits >> z & 1 == 1);
                all.extend(set.map(|z| step * 16 + IVec3::new(row as i32 / 16, row as i32 % 16, z)));
            }
        }
        all
    }

    #[test]
    fn octants_with_near_farthest_corner_cover_voxels() {
        let mut state = 1u32;
        let mut random = || {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            state >> 8
        };
        for (sparse, radius) in [(5, 0.5), (5, 1.0), (20, 1.732), (200, 2.598), (1500, 3.7), (1500, 60.0)] {
            let around: [Octants; 27] = std::array::from_fn(|_| {
                let mut octants = Octants::EMPTY;
                for index in (0..4096).filter(|_| random() % sparse == 0) {
                    octants.rows[index / 16] |= 1 << (index % 16);
                }
                octants
            });
            let all = octants(&around);
            // The octants within the search range, and their farthest corners.
            let far = |voxel: IVec3, octant: IVec3| {
                let corner = octant - 2 * voxel;
                let lateral = corner.abs().max((corner + 1).abs());
                (lateral.max_element() <= REACH as i32).then(|| 0.5 * lateral.as_vec3().length())
            };
            let nearest =
                |voxel: IVec3| all.iter().filter_map(|&octant| far(voxel, octant)).fold(99.0, f32::min);
            let expected =
                LeafMask::from_fn(|offset| nearest(voxel_in_leaf(offset)) < radius - COVER_ROUNDING);
            let balls = [OctantBall::new(radius), OctantBall::new(0.0)];
            for level in SimdLevel::ALL {
                let cover = Cover { around: around.each_ref(), balls: balls.each_ref() };
                assert_eq!(dispatch_at(level, cover), [expected, LeafMask::EMPTY], "{radius}, {level:?}");
            }
            assert_eq!(expected != LeafMask::EMPTY, radius >= 1.0, "{radius}");
        }
    }

    /// A particle anywhere in its octant is within the radius of every covered voxel.
    #[test]
    fn covered_voxels_have_a_particle_within_the_radius() {
        let mut around: [Octants; 27] = std::array::from_fn(|_| Octants::EMPTY);
        around[13].rows[9 * 16 + 6] = 1 << 3;
        let balls = [OctantBall::new(2.598)];
        let [covered] =
            dispatch_at(SimdLevel::Baseline, Cover { around: around.each_ref(), balls: balls.each_ref() });
        assert!(covered.count() > 40);
        for voxel in covered.iter().map(|offset| voxel_in_leaf(offset).as_vec3()) {
            for corner in [Vec3::new(4.5, 3.0, 1.5), Vec3::new(5.0, 3.5, 2.0), Vec3::new(4.5, 3.5, 1.5)] {
                assert!(voxel.distance(corner) < 2.598);
            }
        }
    }
}
