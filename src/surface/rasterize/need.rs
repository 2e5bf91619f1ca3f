//! What of a frame can matter to its surface, told from the occupancy alone: the rest is never kept.
//!
//! ```text
//!   · · · · · · · · ·      ·  nothing within r_init
//!   · n n n n n n n ·      n  near: the surface may pass through
//!   n n n n n n n n n      +  within the band's margin of one that is near: distances may be needed
//!   + k k k k k k k +      k  particles that may be the nearest to something
//!   d d d d d d d d d      d  deep: every voxel, and every voxel next to one, is surely inside S_0
//! ```
//!
//! **Leaves.** The band is made of leaves around crossings: voxels inside S_0 with a face neighbour outside. A
//! leaf that is deep has none, and one without a particle within r_init of a voxel has none. So the crossings
//! are those of the others, the leaves that are *near*; and no distance is needed but in leaves within the
//! band's margin of these. Particles farther from all of them than distances reach change nothing.
//!
//! **Values.** Inside S_min a distance d to the nearest particle is looked at only beside a voxel that is not:
//! elsewhere, `d < r` is all that is asked, and r_min is the least of the radii. So voxels that are surely inside
//! S_min with all face neighbours are *settled*: 0 does for their distance.
//!
//! **Particles.** Let p be a particle, ρ ≤ r_min, and every voxel within ρ + 3/2·√3 of p surely within ρ of some
//! particle. Then p may be left out:
//!
//! - It is not the nearest to any point x at a distance of ρ + √3/2 or more. For if it were, no particle would be
//!   nearer to x, and so the ball around the point w of the line from p to x, at that distance from p, would
//!   hold none. The voxel next to w, √3/2 away at most, would be ρ or more from every particle; but it is within
//!   ρ + √3 of p.
//! - The voxels that it is nearest to are therefore among those around it, are nearer to it than ρ, and have
//!   face neighbours among those around it too: they are settled.
//! - A vertex of the mesh that it is nearest to is nearer than ρ + √3/2, so that the corners of its cell are within
//!   ρ + 3/2·√3. All of them are in S_min, where φ is negative; there is no vertex in such a cell.
//! - The corners of its own cell are within √3 of it: it is inside of whatever surface is found.
//!
//! Where the surface is moved inward by b once it is smooth, a vertex x may be within S_min. Then some point of the surface before is
//! b away from x, and all that is said of x holds of that point if voxels within ρ + b + 3/2·√3 of p are looked at.
//!
//! Where particles have shapes of their own, all of this is said of the balls that each holds for certain, and
//! [round](ROUND) ones hold larger ones than flat ones: what is deep for these is deep. Of the particles, those are kept that reach a leaf where distances may be needed: a long one
//! may be the nearest to what is far away.
//!
//! Where an obstacle's surface passes through what is deep, that is a surface of the fluid, too: these leaves are near.
//!
//! The certificate asks of particles what is around them where φ is not stored. With r_init above √3 each tells
//! that by itself; below that, none is left out. Where particles have shapes of their own, the deep leaves are kept for it, too.

use std::borrow::Cow;

use glam::IVec3;
use rayon::prelude::*;
use rustc_hash::FxHashSet;

use super::cover::{Ball, Cover};
use super::occupancy::{Occupancy, Octants, ROUND};
use super::region::Regions;
use super::{Radii, Scene};
use crate::surface::grid::{LEAF_EDGE, LeafMask, NO_LEAF, Topology, leaf_steps_within};
use crate::surface::simd::{self, Kernel, Lanes};
use crate::surface::space::CoordBox;

/// What can matter.
pub(super) struct Need<'a> {
    /// Leaves that the surface may pass through.
    pub(super) near: Topology,
    /// The leaves that hold particles, as far as the window needs them; the rest goes by these.
    occupied: Cow<'a, Topology>,
    /// Voxels inside S_0 for certain whose face neighbours are, too.
    inside: Vec<LeafMask>,
    /// Voxels whose exact distance nobody asks for: less than r_min.
    settled: Vec<LeafMask>,
    /// The cells whose particles are needed.
    kept: Vec<LeafMask>,
}

/// Voxels that are surely within r_init, and within ρ ≤ r_min, of a particle.
type Covers = [LeafMask; 2];

/// A larger ρ is of no use.
const RHO_MAX: f32 = 4.0;

/// What is around a particle must be within a leaf of it.
const AROUND_MAX: f32 = 7.9;

/// 3/2·√3 and what rounding takes.
const CELL_MARGIN: f32 = 2.598_077 + ROUNDING;

/// Below this r_init, in voxels, no particle is left out: √3 and a little.
const TELLING_RADIUS: f32 = 1.75;

/// Added to distances that are compared with what was computed in 32 bits.
const ROUNDING: f32 = 1e-2;

impl<'a> Need<'a> {
    /// What can matter to the leaves of a window.
    pub(super) fn new(occupancy: &'a Occupancy, scene: &Scene, regions: &Regions) -> Need<'a> {
        let radii = scene.radii;
        let occupied = populated(&occupancy.topology, &regions.populated);
        let inward = (-radii.offset).max(0.0);
        let rho = |held: f32| (radii.min * held).min(RHO_MAX).min(AROUND_MAX - CELL_MARGIN - inward);
        let balls = |held: f32| [Ball::new(radii.init * held), Ball::new(rho(held))];
        let covers = covers(occupancy, &occupied, radii, balls);
        let inside = surrounded(&occupied, &covers, |[init, _]| init);
        let settled = surrounded(&occupied, &covers, |[_, min]| min);
        let near = near_leaves(occupancy, &occupied, &inside, scene, &regions.measured);
        let kept = Vec::new();
        let mut need = Need { near, occupied, inside, settled, kept };
        need.kept = if scene.keeps_all_particles {
            vec![LeafMask::FULL; need.occupied.len()]
        } else if occupancy.has_shapes {
            need.kept_leaves(occupancy, radii, regions)
        } else {
            need.kept_cells(&covers, radii, rho(1.0) + inward, regions)
        };
        need
    }

    /// Whether every voxel of a leaf is inside S_0, and so are those next to it.
    pub(super) fn is_deep(&self, origin: IVec3) -> bool {
        self.occupied.find(origin).is_some_and(|leaf| self.inside[leaf] == LeafMask::FULL)
    }

    /// The origins of the leaves that are deep, in order.
    pub(super) fn deep_leaves(&self) -> impl Iterator<Item = IVec3> {
        let leaves = self.occupied.origins().iter().zip(&self.inside);
        leaves.filter(|(_, inside)| **inside == LeafMask::FULL).map(|(&origin, _)| origin)
    }

    /// The voxels of a leaf that are in S_min, and whose exact distance nobody asks for.
    pub(super) fn settled(&self, origin: IVec3) -> &LeafMask {
        self.occupied.find(origin).map_or(&LeafMask::EMPTY, |leaf| &self.settled[leaf])
    }

    /// The leaves that may hold particles that are needed.
    pub(super) fn occupied(&self) -> &Topology {
        &self.occupied
    }

    /// The cells of one of these leaves whose particles are needed.
    pub(super) fn kept(&self, leaf: usize) -> &LeafMask {
        &self.kept[leaf]
    }

    fn kept_cells(&self, covers: &[Covers], radii: Radii, depth: f32, regions: &Regions) -> Vec<LeafMask> {
        if radii.init < TELLING_RADIUS {
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
        self.occupied.origins().par_iter().map(kept).collect()
    }

    /// The leaves whose particles reach one where distances may be needed: all of their cells.
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
        self.occupied.origins().par_iter().map(kept).collect()
    }

    /// Leaves whose distances may be needed: those that are near, and those that may be in the band.
    fn measured_leaves(&self, radii: Radii, regions: &Regions) -> FxHashSet<IVec3> {
        let surface = |&origin: &IVec3| {
            let leaf = self.occupied.find(origin);
            // A voxel whose neighbours are all inside is none that the surface is next to.
            let inside = leaf.map_or(LeafMask::EMPTY, |leaf| self.inside[leaf]);
            let voxels = match inside == LeafMask::FULL {
                // An obstacle cuts through it.
                true => LeafMask::FULL.bounding_box(),
                false => inside.complement().bounding_box(),
            };
            (origin, voxels.expanded(radii.band_margin()))
        };
        let surfaces: Vec<(IVec3, CoordBox)> = self.near.origins().par_iter().map(surface).collect();
        let banded = leaves_of_boxes(&surfaces, |origin| regions.swept.contains(origin));
        banded.into_iter().chain(self.near.origins().iter().copied()).collect()
    }
}

/// The leaves of a region.
fn populated<'a>(topology: &'a Topology, region: &CoordBox) -> Cow<'a, Topology> {
    let is_in = |origin: &&IVec3| region.contains(**origin);
    if topology.origins().par_iter().all(|origin| is_in(&origin)) {
        return Cow::Borrowed(topology);
    }
    Cow::Owned(Topology::new(topology.origins().par_iter().filter(is_in).copied().collect()))
}

/// The voxels of each leaf that are surely in a particle. `balls` are those that a particle holds, for a ball of so many radii in
/// it: any particle holds one, and round ones a larger one.
fn covers(
    occupancy: &Occupancy,
    leaves: &Topology,
    radii: Radii,
    balls: impl Fn(f32) -> [Ball; 2],
) -> Vec<Covers> {
    let of_any = balls(radii.shortest);
    let of_round = balls(ROUND.max(radii.shortest));
    let is_any_empty = of_any.iter().all(Ball::is_empty);
    let around = |origin: IVec3, octants: fn(&Occupancy, IVec3) -> Option<&Octants>| {
        cube(|step| octants(occupancy, origin + step).unwrap_or(&Octants::EMPTY))
    };
    let cover = |&origin: &IVec3| {
        let mut covers = [LeafMask::EMPTY; 2];
        if !is_any_empty {
            let around = around(origin, Occupancy::octants_of);
            covers = simd::dispatch(Cover { around, balls: of_any.each_ref() });
        }
        if occupancy.has_shapes && radii.shortest < ROUND {
            let around = around(origin, Occupancy::round_octants_of);
            let by_round = simd::dispatch(Cover { around, balls: of_round.each_ref() });
            covers = [0, 1].map(|ball| covers[ball].or(&by_round[ball]));
        }
        covers
    };
    leaves.origins().par_iter().map(cover).collect()
}

/// What there is of a leaf and the 26 around it: that at step (x, y, z) at (x + 1)·9 + (y + 1)·3 + z + 1.
fn cube<T>(at: impl Fn(IVec3) -> T) -> [T; 27] {
    std::array::from_fn(|place| {
        let place = place as i32;
        at((IVec3::new(place / 9, place / 3 % 3, place % 3) - 1) * LEAF_EDGE)
    })
}

/// The voxels of each leaf that are covered with all face neighbours.
fn surrounded(
    leaves: &Topology,
    covers: &[Covers],
    of: impl Fn(&Covers) -> &LeafMask + Sync,
) -> Vec<LeafMask> {
    let surrounded = |(leaf, neighbors): (usize, &[u32; 6])| {
        let face = |neighbor: u32| match neighbor {
            NO_LEAF => &LeafMask::EMPTY,
            neighbor => of(&covers[neighbor as usize]),
        };
        of(&covers[leaf]).surrounded(neighbors.map(face))
    };
    leaves.neighbors().par_iter().enumerate().map(surrounded).collect()
}

/// The leaves of a region with a voxel that may be within r_init of a particle, but for the deep ones; and of these
/// those that the surface of an obstacle passes through.
fn near_leaves(
    occupancy: &Occupancy,
    occupied: &Topology,
    inside: &[LeafMask],
    scene: &Scene,
    region: &CoordBox,
) -> Topology {
    let radius = scene.radii.init;
    let is_deep = |leaf: usize| inside[leaf] == LeafMask::FULL;
    let reach_of = |longest: f32| (radius * longest + ROUNDING) as i32;
    let reach = reach_of(occupancy.longest());
    // Deep among deep ones: what its particles are near to is deep, too. Steps through three faces lead to
    // every leaf that is next to it at all.
    let mut is_buried: Vec<bool> = (0..occupied.len()).map(is_deep).collect();
    for _ in 0..3 * (reach as u32 + 1).div_ceil(LEAF_EDGE as u32) {
        let all_around =
            |leaf: usize| occupied.neighbors()[leaf].iter().all(|&n| n != NO_LEAF && is_buried[n as usize]);
        is_buried =
            (0..occupied.len()).into_par_iter().map(|leaf| is_buried[leaf] && all_around(leaf)).collect();
    }
    let reached = |(leaf, &origin): (usize, &IVec3)| {
        if is_buried[leaf] {
            return None;
        }
        let cells = occupancy.octants_of(origin)?.cells();
        let reach = reach_of(occupancy.longest_of(origin));
        // A particle is up to one voxel beyond its cell's own.
        let voxels = CoordBox { min: cells.min - reach, max: cells.max + 1 + reach };
        Some((origin, voxels))
    };
    let reached: Vec<(IVec3, CoordBox)> =
        occupied.origins().par_iter().enumerate().filter_map(reached).collect();
    let is_near = |origin| region.contains(origin) && !occupied.find(origin).is_some_and(is_deep);
    let mut near = leaves_of_boxes(&reached, is_near);
    if !scene.obstacles.is_empty() {
        let deep = occupied.origins().par_iter().enumerate().filter(|(leaf, _)| is_deep(*leaf));
        let at_obstacle = |&origin: &IVec3| region.contains(origin) && scene.is_at_obstacle(origin);
        near.par_extend(deep.map(|(_, &origin)| origin).filter(at_obstacle));
    }
    Topology::new(near)
}

/// Origins of the leaves that boxes touch and that are wanted; each box is given relative to an origin. Few of
/// them come twice.
pub(super) fn leaves_of_boxes(
    boxes: &[(IVec3, CoordBox)],
    is_wanted: impl Fn(IVec3) -> bool + Sync,
) -> Vec<IVec3> {
    let edge = IVec3::splat(LEAF_EDGE);
    let touched = |boxes: &[(IVec3, CoordBox)]| {
        let mut origins = FxHashSet::default();
        for (origin, voxels) in boxes.iter().filter(|(_, voxels)| !voxels.is_empty()) {
            let (first, last) = (voxels.min.div_euclid(edge), voxels.max.div_euclid(edge));
            for x in first.x..=last.x {
                for y in first.y..=last.y {
                    let along_z = (first.z..=last.z).map(|z| origin + IVec3::new(x, y, z) * LEAF_EDGE);
                    origins.extend(along_z);
                }
            }
        }
        origins.into_iter().filter(|&origin| is_wanted(origin)).collect::<Vec<_>>()
    };
    boxes.par_chunks(BOXES).flat_map_iter(touched).collect()
}

/// Boxes whose leaves are collected together.
const BOXES: usize = 256;

/// Finds the cells of a leaf from which a voxel that is not covered may be seen: from `around` voxels before
/// the cell to `around` after it, on each axis.
pub(super) struct Uncovered<'a> {
    /// The leaf and those around it, as [`cube`] has them.
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
        // Rows of 24 along z; those of the leaf itself begin at 8 on every axis.
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
