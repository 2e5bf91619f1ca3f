//! Particles sorted into the leaves they lie in: the second of two passes, which keeps those that matter.
//!
//! ```text
//!   topology    leaf 0      leaf 1   leaf 2          leaves that hold a particle
//!   starts      0           3        4        9
//!   positions   p p p       p        p p p p p       in voxels, relative to the leaf's origin
//! ```
//!
//! Positions relative to the leaf are small numbers: 32 bits lose nothing that matters, however far
//! from the world's origin the particles are.
//!
//! Each batch is sorted by itself, on whichever thread is free; then each leaf takes its particles from the
//! batches, in their order. So the order within a leaf is that of the source, and what there is at once is
//! the batches under way, and twice the particles that are kept. Of files with very many batches some in a row are merged
//! first: blocks of memory are large then, and go back to the system when they are freed.

use std::ops::Range;

use glam::{DVec3, IVec3, Vec3};
use rayon::prelude::*;
use rustc_hash::FxHashSet;

use super::batch::LeafBatch;
use super::need::Need;
use super::occupancy::Occupancy;
use super::region::{Regions, meet};
use crate::surface::grid::{LeafMask, Topology, offset_in_leaf};
use crate::surface::particles::{Ellipsoid, ParticleSource, Shapes};
use crate::surface::space::Lattice;

/// The particles that matter to a surface, by leaf.
///
/// The others are surely inside of it, and are the nearest to none of its vertices, nor to any voxel whose
/// distance counts.
#[derive(Clone, Debug, Default)]
pub struct ParticleBins {
    /// The leaves that hold at least one of them.
    pub topology: Topology,
    /// Where each leaf's particles start in `positions`; one more entry than leaves.
    starts: Vec<usize>,
    /// Positions in voxels relative to the origin of their leaf, 0 to 8 on each axis.
    positions: Vec<Vec3>,
    /// What they are, in the same order.
    pub shapes: Shapes,
    /// Leaves of which every voxel is inside the initial surface, and so are those next to it, whatever particles of theirs are here.
    /// Empty where all particles are alike: then each tells of the voxels around it.
    deep: FxHashSet<IVec3>,
    /// All particles of the source that were not dropped, whether they are here or not.
    pub particle_count: usize,
    /// Particles left out: positions that are not finite, outside the grid's range of indices, or too far from the others.
    pub dropped_count: usize,
    /// About where one of them is, in world units, if any of them is finite.
    pub stray: Option<DVec3>,
}

impl ParticleBins {
    /// Sorts the particles that are needed into leaves.
    ///
    /// # Errors
    /// Those of the source.
    pub(super) fn new<S: ParticleSource>(
        source: &S,
        lattice: &Lattice,
        occupancy: &Occupancy,
        need: &Need,
        regions: &Regions,
    ) -> Result<ParticleBins, S::Error> {
        let keep = |batch: usize| {
            if !meet(&occupancy.batches[batch].voxels, &regions.populated) {
                return Ok(Kept::default());
            }
            let sorted = LeafBatch::new(&source.batch(batch)?, lattice, occupancy.has_shapes);
            Ok(Kept::new(&sorted, &source.shapes_of(batch), need))
        };
        let batch_count = source.batch_count();
        let group = batch_count.div_ceil(GROUPS).max(1);
        let keep_group = |first: usize| {
            let batches = first..batch_count.min(first + group);
            let kept = batches.map(keep).collect::<Result<Vec<_>, _>>()?;
            Ok(Kept::merged(kept))
        };
        let groups = (0..batch_count.div_ceil(group)).into_par_iter().map(|index| keep_group(index * group));
        let Kept { leaves, starts, positions, shapes } = Kept::merged(groups.collect::<Result<Vec<_>, _>>()?);
        let topology =
            Topology::new(leaves.iter().map(|&leaf| need.occupied().origins()[leaf as usize]).collect());
        let (particle_count, dropped_count) = (occupancy.particle_count(), occupancy.dropped_count());
        let stray = occupancy.stray();
        let deep = if occupancy.has_shapes { need.deep_leaves().collect() } else { FxHashSet::default() };
        Ok(ParticleBins { topology, starts, positions, shapes, deep, particle_count, dropped_count, stray })
    }

    /// The particles of a leaf, relative to its origin, in voxels.
    pub fn in_leaf(&self, leaf: usize) -> &[Vec3] {
        &self.positions[self.starts[leaf]..self.starts[leaf + 1]]
    }

    /// Whether a leaf is known to be deep inside the initial surface, where particles have shapes of their own.
    pub fn is_deep(&self, origin: IVec3) -> bool {
        self.deep.contains(&origin)
    }

    /// Which of the particles that are here lie in a leaf.
    pub fn range(&self, leaf: usize) -> Range<usize> {
        self.starts[leaf]..self.starts[leaf + 1]
    }

    /// The particles of every leaf: its origin, and positions relative to that, in voxels.
    pub fn leaves(&self) -> impl Iterator<Item = (IVec3, &[Vec3])> {
        self.topology.origins().iter().enumerate().map(|(leaf, &origin)| (origin, self.in_leaf(leaf)))
    }

    /// The number of particles that are here.
    pub fn len(&self) -> usize {
        self.positions.len()
    }

    /// Whether there are none: all were dropped, or there were none to begin with.
    pub fn is_empty(&self) -> bool {
        self.positions.is_empty()
    }
}

/// What is kept of some batches in a row, in the order of the leaves.
struct Kept {
    /// Each leaf that has any.
    leaves: Vec<u32>,
    /// Where the particles of each start; one more entry than leaves.
    starts: Vec<usize>,
    positions: Vec<Vec3>,
    /// What they are, in the same order.
    shapes: Shapes,
}

/// Batches are merged in so many groups.
const GROUPS: usize = 256;

impl Default for Kept {
    fn default() -> Kept {
        Kept { leaves: Vec::new(), starts: vec![0], positions: Vec::new(), shapes: Shapes::Balls }
    }
}

impl Kept {
    /// `shapes` are those of the particles of the batch.
    fn new(batch: &LeafBatch, shapes: &Shapes, need: &Need) -> Kept {
        let needed = |(origin, locals, places)| {
            let leaf = need.occupied().find(origin)?;
            let kept = need.kept(leaf);
            (*kept != LeafMask::EMPTY).then_some((leaf, kept, locals, places))
        };
        let mut needed: Vec<(usize, &LeafMask, &[Vec3], &[u32])> =
            batch.leaves_with_places().filter_map(needed).collect();
        needed.sort_unstable_by_key(|&(leaf, ..)| leaf);
        let mut positions = Vec::with_capacity(needed.iter().map(|(_, _, locals, _)| locals.len()).sum());
        let mut places_kept = Vec::new();
        let (mut leaves, mut starts) = (Vec::with_capacity(needed.len()), vec![0]);
        for (leaf, kept, locals, places) in needed {
            let is_kept = |local: &Vec3| kept.contains(cell_of(*local));
            positions.extend(locals.iter().filter(|local| is_kept(local)));
            let particles = locals.iter().zip(places).filter(|(local, _)| is_kept(local));
            places_kept.extend(particles.map(|(_, &place)| place));
            if starts.last() != Some(&positions.len()) {
                leaves.push(leaf as u32);
                starts.push(positions.len());
            }
        }
        positions.shrink_to_fit();
        Kept { leaves, starts, positions, shapes: shapes.of(&places_kept) }
    }

    /// What is kept of all these; the particles of a leaf in the order of the batches.
    fn merged(mut batches: Vec<Kept>) -> Kept {
        batches.retain(|batch| !batch.leaves.is_empty());
        if batches.len() < 2 {
            return batches.pop().unwrap_or_default();
        }
        let mut counts: Vec<(u32, usize)> = batches
            .iter()
            .flat_map(|batch| batch.leaves_from(0))
            .map(|(leaf, range)| (leaf, range.len()))
            .collect();
        counts.par_sort_unstable();
        let (mut leaves, mut starts) = (Vec::new(), vec![0]);
        let mut end = 0;
        for of_leaf in counts.chunk_by(|(one, _), (other, _)| one == other) {
            end += of_leaf.iter().map(|(_, count)| count).sum::<usize>();
            leaves.push(of_leaf[0].0);
            starts.push(end);
        }
        let positions = gather(&batches, &leaves, &starts, Vec3::ZERO, |batch| &batch.positions);
        let shapes = gather_shapes(&batches, &leaves, &starts);
        Kept { leaves, starts, positions, shapes }
    }

    /// The leaves from this one on, and which of the particles are in them.
    fn leaves_from(&self, first: u32) -> impl Iterator<Item = (u32, Range<usize>)> {
        let first = self.leaves.partition_point(|&leaf| leaf < first);
        let ranges = self.starts[first..].windows(2).map(|ends| ends[0]..ends[1]);
        self.leaves[first..].iter().copied().zip(ranges)
    }
}

/// The voxel that is the least corner of a particle's cell, as its place in the leaf. (Rounded, a particle may
/// be at the far end of its leaf.)
pub(super) fn cell_of(local: Vec3) -> usize {
    offset_in_leaf(local.as_ivec3().min(IVec3::splat(7)))
}

/// The shapes of the particles of these leaves in all batches.
fn gather_shapes(batches: &[Kept], leaves: &[u32], starts: &[usize]) -> Shapes {
    // All batches have the same variant.
    match batches.iter().map(|batch| &batch.shapes).find(|shapes| !shapes.are_balls()) {
        None | Some(Shapes::Balls) => Shapes::Balls,
        Some(Shapes::Scaled(_)) => {
            Shapes::Scaled(gather(batches, leaves, starts, 1.0, |batch| match &batch.shapes {
                Shapes::Scaled(scales) => scales,
                _ => &[],
            }))
        }
        Some(Shapes::Ellipsoids(_)) => {
            let fill = Ellipsoid::ball(1.0);
            Shapes::Ellipsoids(gather(batches, leaves, starts, fill, |batch| match &batch.shapes {
                Shapes::Ellipsoids(ellipsoids) => ellipsoids,
                _ => &[],
            }))
        }
    }
}

/// What there is of the particles of these leaves in all batches; `starts` tells where each leaf's are to be.
fn gather<'a, T: Copy + Send + Sync + 'a>(
    batches: &'a [Kept],
    leaves: &[u32],
    starts: &[usize],
    fill: T,
    of: impl Fn(&'a Kept) -> &'a [T] + Sync,
) -> Vec<T> {
    let mut gathered = vec![fill; starts[leaves.len()]];
    // A piece for each of so many leaves that searching the batches for the first of them does not count.
    let piece_leaves = leaves.len().div_ceil(PIECES).max(1);
    let mut pieces = Vec::new();
    let mut rest = gathered.as_mut_slice();
    for first in (0..leaves.len()).step_by(piece_leaves) {
        let last = leaves.len().min(first + piece_leaves);
        let (piece, after) = rest.split_at_mut(starts[last] - starts[first]);
        pieces.push((first..last, piece));
        rest = after;
    }
    pieces.into_par_iter().for_each(|(range, piece)| {
        let (leaves, start) = (&leaves[range.clone()], starts[range.start]);
        let (Some(&first), Some(&last)) = (leaves.first(), leaves.last()) else { return };
        let mut cursors: Vec<usize> = starts[range].iter().map(|place| place - start).collect();
        for batch in batches {
            let mut place = 0;
            for (leaf, from) in batch.leaves_from(first).take_while(|&(leaf, _)| leaf <= last) {
                place += leaves[place..].partition_point(|&other| other < leaf);
                let cursor = &mut cursors[place];
                piece[*cursor..*cursor + from.len()].copy_from_slice(&of(batch)[from.clone()]);
                *cursor += from.len();
            }
        }
    });
    gathered
}

/// Pieces in which particles are gathered.
const PIECES: usize = 128;
