//! Particles sorted by leaf. This is the second of two passes; it keeps only the particles that can affect
//! the surface.
//!
//! ```text
//!   topology    leaf 0      leaf 1   leaf 2          leaves that contain particles
//!   starts      0           3        4        9
//!   positions   p p p       p        p p p p p       in voxels, relative to the leaf's origin
//! ```
//!
//! Positions relative to a leaf are small numbers, so 32 bits are precise enough however far the particles
//! are from the world origin.
//!
//! Each batch is sorted independently, in parallel. Each leaf then gathers its particles from the batches in
//! batch order, so particles within a leaf keep the order of the source. Peak memory is the batches in flight
//! plus twice the particles that are kept. If a file has very many batches, consecutive batches are merged
//! first. Their memory blocks are then so large that freeing them returns the memory to the system.

use std::ops::Range;

use glam::{DVec3, IVec3, Vec3};
use rayon::prelude::*;
use rustc_hash::FxHashSet;

use super::batch::LeafBatch;
use super::culling::Culling;
use super::occupancy::Occupancy;
use super::region::{Regions, meet};
use crate::grid::{LeafMask, Topology, offset_in_leaf};
use crate::interrupt::checkpoint;
use crate::parallel::Loops as _;
use crate::particles::{AnySource, Ellipsoid, Shapes, Unread};
use crate::space::Lattice;

/// The particles that can affect the surface, sorted by leaf.
///
/// All other particles are certainly inside the surface. None of them is the nearest particle to a vertex, or
/// to a voxel whose distance is used.
#[derive(Clone, Debug, Default)]
pub struct ParticleBins {
    /// Leaves that contain at least one kept particle.
    pub topology: Topology,
    /// Start of each leaf's particles in `positions`; one entry more than there are leaves.
    starts: Vec<usize>,
    /// Positions in voxels relative to the origin of their leaf, 0 to 8 on each axis.
    positions: Vec<Vec3>,
    /// Shapes of the particles, in the same order.
    pub shapes: Shapes,
    /// Leaves whose voxels, and all adjacent voxels, are inside the initial surface, whether or not they
    /// contain kept particles. Empty if all particles are equal: each particle then implies that the voxels
    /// around it are inside.
    deep: FxHashSet<IVec3>,
    /// Number of particles that were not dropped, kept or not.
    pub particle_count: usize,
    /// Number of dropped particles: positions that are not finite, outside the grid's index range, or too far
    /// from the others.
    pub dropped_count: usize,
    /// Approximate world position of one dropped particle, if any of them is finite.
    pub outlier_position: Option<DVec3>,
}

impl ParticleBins {
    /// Sorts the required particles by leaf.
    ///
    /// # Errors
    /// Returns the source's error if a batch cannot be read.
    pub(super) fn new(
        source: &AnySource<'_>,
        lattice: &Lattice,
        occupancy: &Occupancy,
        culling: &Culling,
        regions: &Regions,
    ) -> Result<ParticleBins, Unread> {
        let keep = |batch: usize| {
            if !meet(&occupancy.batches[batch].voxels, &regions.populated) {
                return Ok(KeptParticles::default());
            }
            let sorted = LeafBatch::new(&source.batch(batch)?, lattice, occupancy.has_shapes);
            Ok(KeptParticles::new(&sorted, &source.batch_shapes(batch), culling))
        };
        let batch_count = source.batch_count();
        let group = batch_count.div_ceil(GROUPS).max(1);
        let keep_group = |first: usize| {
            let batches = first..batch_count.min(first + group);
            let kept = batches.map(keep).collect::<Result<Vec<_>, _>>()?;
            Ok(KeptParticles::merged(kept))
        };
        let groups =
            (0..batch_count.div_ceil(group)).into_par_iter().halved().map(|index| keep_group(index * group));
        let KeptParticles { leaves, starts, positions, shapes } =
            KeptParticles::merged(groups.collect::<Result<Vec<_>, _>>()?);
        let topology =
            Topology::new(leaves.iter().map(|&leaf| culling.occupied().origins()[leaf as usize]).collect());
        let (particle_count, dropped_count) = (occupancy.particle_count(), occupancy.dropped_count());
        let outlier_position = occupancy.outlier_position();
        let deep = if occupancy.has_shapes { culling.deep_leaves().collect() } else { FxHashSet::default() };
        Ok(ParticleBins {
            topology,
            starts,
            positions,
            shapes,
            deep,
            particle_count,
            dropped_count,
            outlier_position,
        })
    }

    /// The particles of a leaf, in voxels relative to its origin.
    pub fn in_leaf(&self, leaf: usize) -> &[Vec3] {
        &self.positions[self.starts[leaf]..self.starts[leaf + 1]]
    }

    /// The position of a kept particle, in voxels relative to the origin of its leaf.
    pub(super) fn local(&self, particle: usize) -> Vec3 {
        self.positions[particle]
    }

    /// True if a leaf is known to be deep inside the initial surface. Only recorded for anisotropic
    /// particles.
    pub fn is_deep(&self, origin: IVec3) -> bool {
        self.deep.contains(&origin)
    }

    /// Indices of the kept particles that lie in a leaf.
    pub fn range(&self, leaf: usize) -> Range<usize> {
        self.starts[leaf]..self.starts[leaf + 1]
    }

    /// Each leaf's origin and its particles, in voxels relative to that origin.
    pub fn leaves(&self) -> impl Iterator<Item = (IVec3, &[Vec3])> {
        self.topology.origins().iter().enumerate().map(|(leaf, &origin)| (origin, self.in_leaf(leaf)))
    }

    /// Number of kept particles.
    pub fn len(&self) -> usize {
        self.positions.len()
    }

    /// True if no particle was kept: the source has none, or all were dropped.
    pub fn is_empty(&self) -> bool {
        self.positions.is_empty()
    }
}

/// The kept particles of some consecutive batches, in leaf order.
struct KeptParticles {
    /// Indices of the leaves that contain kept particles.
    leaves: Vec<u32>,
    /// Start of each leaf's particles; one entry more than there are leaves.
    starts: Vec<usize>,
    positions: Vec<Vec3>,
    /// Shapes of the particles, in the same order.
    shapes: Shapes,
}

/// Number of groups into which batches are merged.
const GROUPS: usize = 256;

impl Default for KeptParticles {
    fn default() -> KeptParticles {
        KeptParticles { leaves: Vec::new(), starts: vec![0], positions: Vec::new(), shapes: Shapes::Uniform }
    }
}

impl KeptParticles {
    /// Selects the required particles of a batch. `shapes` are the shapes of all its particles.
    fn new(batch: &LeafBatch, shapes: &Shapes, culling: &Culling) -> KeptParticles {
        let needed = |(origin, locals, indices)| {
            let leaf = culling.occupied().find(origin)?;
            let kept = culling.kept(leaf);
            (*kept != LeafMask::EMPTY).then_some((leaf, kept, locals, indices))
        };
        let mut needed: Vec<(usize, &LeafMask, &[Vec3], &[u32])> =
            batch.leaves_with_indices().filter_map(needed).collect();
        needed.sort_unstable_by_key(|&(leaf, ..)| leaf);
        let mut positions = Vec::with_capacity(needed.iter().map(|(_, _, locals, _)| locals.len()).sum());
        let mut kept_indices = Vec::new();
        let (mut leaves, mut starts) = (Vec::with_capacity(needed.len()), vec![0]);
        for (leaf, kept, locals, indices) in needed {
            let is_kept = |local: &Vec3| kept.contains(cell_of(*local));
            positions.extend(locals.iter().filter(|local| is_kept(local)));
            let particles = locals.iter().zip(indices).filter(|(local, _)| is_kept(local));
            kept_indices.extend(particles.map(|(_, &index)| index));
            if starts.last() != Some(&positions.len()) {
                leaves.push(leaf as u32);
                starts.push(positions.len());
            }
        }
        positions.shrink_to_fit();
        KeptParticles { leaves, starts, positions, shapes: shapes.select(&kept_indices) }
    }

    /// Merges batches. Particles of one leaf keep the order of the batches.
    fn merged(mut batches: Vec<KeptParticles>) -> KeptParticles {
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
        KeptParticles { leaves, starts, positions, shapes }
    }

    /// The leaves from index `first` on, each with the range of its particles.
    fn leaves_from(&self, first: u32) -> impl Iterator<Item = (u32, Range<usize>)> {
        let first = self.leaves.partition_point(|&leaf| leaf < first);
        let ranges = self.starts[first..].windows(2).map(|ends| ends[0]..ends[1]);
        self.leaves[first..].iter().copied().zip(ranges)
    }
}

/// Offset in the leaf of the voxel at the lower corner of the particle's cell. (Rounding can put a particle
/// on the leaf's upper boundary.)
pub(super) fn cell_of(local: Vec3) -> usize {
    offset_in_leaf(local.as_ivec3().min(IVec3::splat(7)))
}

/// Gathers the shapes of the particles of these leaves from all batches.
fn gather_shapes(batches: &[KeptParticles], leaves: &[u32], starts: &[usize]) -> Shapes {
    // All batches have the same variant.
    match batches.iter().map(|batch| &batch.shapes).find(|shapes| !shapes.is_uniform()) {
        None | Some(Shapes::Uniform) => Shapes::Uniform,
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

/// Gathers one property of the particles of these leaves from all batches. `starts` says where each leaf's
/// values go.
fn gather<'a, T: Copy + Send + Sync + 'a>(
    batches: &'a [KeptParticles],
    leaves: &[u32],
    starts: &[usize],
    fill: T,
    of: impl Fn(&'a KeptParticles) -> &'a [T] + Sync,
) -> Vec<T> {
    let mut gathered = vec![fill; starts[leaves.len()]];
    // Each piece spans enough leaves that finding its first leaf in every batch costs little.
    let piece_leaves = leaves.len().div_ceil(PIECES).max(1);
    let mut pieces = Vec::new();
    let mut rest = gathered.as_mut_slice();
    for first in (0..leaves.len()).step_by(piece_leaves) {
        let last = leaves.len().min(first + piece_leaves);
        let (piece, after) = rest.split_at_mut(starts[last] - starts[first]);
        pieces.push((first..last, piece));
        rest = after;
    }
    pieces.into_par_iter().halved().for_each(|(range, piece)| {
        let (leaves, start) = (&leaves[range.clone()], starts[range.start]);
        let (Some(&first), Some(&last)) = (leaves.first(), leaves.last()) else { return };
        let mut cursors: Vec<usize> = starts[range].iter().map(|leaf_start| leaf_start - start).collect();
        for batch in batches {
            checkpoint();
            let mut leaf_index = 0;
            for (leaf, from) in batch.leaves_from(first).take_while(|&(leaf, _)| leaf <= last) {
                leaf_index += leaves[leaf_index..].partition_point(|&other| other < leaf);
                let cursor = &mut cursors[leaf_index];
                piece[*cursor..*cursor + from.len()].copy_from_slice(&of(batch)[from.clone()]);
                *cursor += from.len();
            }
        }
    });
    gathered
}

/// Number of pieces in which particles are gathered in parallel.
const PIECES: usize = 128;
