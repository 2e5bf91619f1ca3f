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

use std::io;
use std::ops::Range;

use glam::{DVec3, IVec3, Vec3};
use rayon::prelude::*;
use rustc_hash::{FxHashMap, FxHashSet};

use super::culling::Culling;
use super::occupancy::Occupancy;
use super::{Regions, meet};
use crate::cancel::checkpoint;
use crate::grid::{LEAF_EDGE, LeafMask, Topology, offset_in_leaf};
use crate::parallel::Loops as _;
use crate::particles::{AnySource, Ellipsoid, Positions, Shapes, Unread};
use crate::simd::{self, Kernel, Lanes};
use crate::space::{INDEX_LIMIT, Lattice};
use crate::storage::{Storage, StorageCursor};

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
        Ok(ParticleBins {
            topology,
            starts,
            positions,
            shapes,
            deep: FxHashSet::default(),
            particle_count,
            dropped_count,
            outlier_position,
        })
    }

    /// Records the deep leaves.
    pub(super) fn record_deep(&mut self, culling: &Culling) {
        self.deep = culling.deep_leaves().collect();
    }

    /// The particles of a leaf, in voxels relative to its origin.
    pub fn in_leaf(&self, leaf: usize) -> &[Vec3] {
        &self.positions[self.starts[leaf]..self.starts[leaf + 1]]
    }

    /// The position of a kept particle, in voxels relative to the origin of its leaf.
    pub(super) fn local(&self, particle: usize) -> Vec3 {
        self.positions[particle]
    }

    /// True if a leaf is known to be deep inside the initial surface. Only recorded if
    /// particles differ in size or shape.
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

/// [`ParticleBins`] in a storage.
pub struct StoredBins {
    /// The offset of the first byte.
    start: u64,
    /// The offset after the last byte.
    pub end: u64,
    /// The numbers of leaves, kept particles and deep leaves.
    counts: [usize; 3],
    /// The numbers of scales and of ellipsoids, one of which is 0.
    shape_counts: [usize; 2],
}

impl StoredBins {
    /// Writes bins, without what they say of particles that are not kept.
    ///
    /// # Errors
    /// Those of the storage.
    pub fn write(bins: &ParticleBins, storage: &dyn Storage, start: u64) -> io::Result<StoredBins> {
        let mut cursor = StorageCursor { storage, offset: start };
        let deep: Vec<IVec3> = bins.deep.iter().copied().collect();
        cursor.write(bins.topology.origins())?;
        cursor.write(&bins.starts)?;
        cursor.write(&bins.positions)?;
        cursor.write(&deep)?;
        let (scales, ellipsoids): (&[f32], &[Ellipsoid]) = match &bins.shapes {
            Shapes::Uniform => (&[], &[]),
            Shapes::Scaled(scales) => (scales, &[]),
            Shapes::Ellipsoids(ellipsoids) => (&[], ellipsoids),
        };
        cursor.write(scales)?;
        cursor.write(ellipsoids)?;
        let counts = [bins.topology.len(), bins.len(), deep.len()];
        Ok(StoredBins { start, end: cursor.offset, counts, shape_counts: [scales.len(), ellipsoids.len()] })
    }

    /// Reads the bins.
    ///
    /// # Errors
    /// Those of the storage.
    pub fn read(&self, storage: &dyn Storage) -> io::Result<ParticleBins> {
        let mut cursor = StorageCursor { storage, offset: self.start };
        let [leaf_count, particle_count, deep_count] = self.counts;
        Ok(ParticleBins {
            topology: Topology::new(cursor.read(leaf_count)?),
            starts: cursor.read(leaf_count + 1)?,
            positions: cursor.read(particle_count)?,
            deep: cursor.read(deep_count)?.into_iter().collect(),
            shapes: match self.shape_counts {
                [0, 0] => Shapes::Uniform,
                [count, 0] => Shapes::Scaled(cursor.read(count)?),
                [_, count] => Shapes::Ellipsoids(cursor.read(count)?),
            },
            ..ParticleBins::default()
        })
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

// A batch of particles, sorted by leaf.
//
//   batch       p0 p1 p2 p3 p4 p5        in the order of the source
//   leaves      A  A  B  A  C  B
//   sorted      p0 p1 p3 | p2 p5 | p4    A, B, C: in the order of first appearance
//
// Both passes over the particles begin with this step. Consecutive particles in a file are usually close in
// space, so a leaf is looked up only when it differs from that of the previous particle.

/// The particles of a batch, grouped by leaf.
pub(super) struct LeafBatch {
    /// Origins of the leaves that contain particles.
    origins: Vec<IVec3>,
    /// Start of each leaf's particles in `locals`; one entry more than there are leaves.
    starts: Vec<u32>,
    /// Positions in voxels relative to the origin of their leaf, 0 to 8 on each axis.
    locals: Vec<Vec3>,
    /// Index in the batch of each particle in `locals`; empty unless requested.
    indices: Vec<u32>,
    /// Number of dropped particles: positions that are not finite, or outside the grid's index range.
    pub(super) dropped_count: usize,
    /// The first dropped position that is finite. It is too far away for the grid.
    pub(super) beyond_grid: Option<DVec3>,
}

impl LeafBatch {
    /// Sorts a batch. Particles of one leaf keep their order. `with_indices` also stores each particle's
    /// index in the batch.
    pub(super) fn new(positions: &Positions, lattice: &Lattice, with_indices: bool) -> LeafBatch {
        let placed = LeafCoords::new(positions, lattice);
        let mut origins: Vec<IVec3> = Vec::new();
        let mut starts = vec![0u32];
        let mut leaves: FxHashMap<IVec3, u32> = FxHashMap::default();
        let mut runs: Vec<(u32, Range<usize>)> = Vec::new();
        for (origin, run) in placed.runs() {
            let leaf = *leaves.entry(origin).or_insert_with(|| {
                origins.push(origin);
                starts.push(0);
                origins.len() as u32 - 1
            });
            starts[leaf as usize + 1] += run.len() as u32;
            runs.push((leaf, run));
        }
        for leaf in 0..origins.len() {
            starts[leaf + 1] += starts[leaf];
        }
        let mut cursors = starts.clone();
        let mut locals = vec![Vec3::ZERO; starts[origins.len()] as usize];
        let mut indices = vec![0; if with_indices { locals.len() } else { 0 }];
        for (leaf, run) in runs {
            let cursor = &mut cursors[leaf as usize];
            let to = *cursor as usize..*cursor as usize + run.len();
            *cursor += run.len() as u32;
            if with_indices {
                indices[to.clone()].iter_mut().zip(run.clone()).for_each(|(to, index)| *to = index as u32);
            }
            locals[to].copy_from_slice(&placed.locals[run]);
        }
        let dropped_count = placed.locals.len() - locals.len();
        let position = |index: usize| match positions {
            Positions::F32(positions) => Vec3::from(positions[index]).as_dvec3(),
            Positions::F64(positions) => DVec3::from(positions[index]),
        };
        let is_beyond = |index: &usize| placed.locals[*index].is_nan() && position(*index).is_finite();
        let beyond_grid = (dropped_count > 0).then(|| (0..placed.locals.len()).find(is_beyond)).flatten();
        LeafBatch { dropped_count, beyond_grid: beyond_grid.map(position), origins, starts, locals, indices }
    }

    /// Number of particles that were not dropped.
    pub(super) fn len(&self) -> usize {
        self.locals.len()
    }

    /// Each leaf's origin and its particles, in voxels relative to that origin.
    pub(super) fn leaves(&self) -> impl Iterator<Item = (IVec3, &[Vec3])> {
        let ranges = self.starts.windows(2).map(|ends| ends[0] as usize..ends[1] as usize);
        self.origins.iter().zip(ranges).map(|(&origin, range)| (origin, &self.locals[range]))
    }

    /// Like [`leaves`](Self::leaves), with each particle's index in the batch. The indices are empty unless
    /// requested.
    pub(super) fn leaves_with_indices(&self) -> impl Iterator<Item = (IVec3, &[Vec3], &[u32])> {
        let ranges = self.starts.windows(2).map(|ends| ends[0] as usize..ends[1] as usize);
        self.origins.iter().zip(ranges).map(|(&origin, range)| {
            let indices = if self.indices.is_empty() { &[] } else { &self.indices[range.clone()] };
            (origin, &self.locals[range], indices)
        })
    }
}

/// The leaf of each particle, and its position in voxels relative to that leaf. Dropped particles have a NaN
/// position and a leaf origin that no leaf can have.
pub(super) struct LeafCoords {
    origins: Vec<IVec3>,
    pub(super) locals: Vec<Vec3>,
}

impl LeafCoords {
    pub(super) fn new(positions: &Positions, lattice: &Lattice) -> LeafCoords {
        match positions {
            Positions::F32(positions) => LeafCoords::of(positions, lattice),
            Positions::F64(positions) => LeafCoords::of(positions, lattice),
        }
    }

    fn of<T: Copy + Into<f64>>(positions: &[[T; 3]], lattice: &Lattice) -> LeafCoords {
        let mut placed = LeafCoords {
            origins: vec![IVec3::ZERO; positions.len()],
            locals: vec![Vec3::ZERO; positions.len()],
        };
        simd::dispatch(ToLeafCoords {
            positions: positions.as_flattened(),
            voxel_size: lattice.voxel_size,
            origins: bytemuck::cast_slice_mut(&mut placed.origins),
            locals: bytemuck::cast_slice_mut(&mut placed.locals),
        });
        placed
    }

    /// Runs of consecutive particles that lie in the same leaf. Skips dropped particles.
    pub(super) fn runs(&self) -> impl Iterator<Item = (IVec3, Range<usize>)> {
        let mut end = 0;
        let runs = self.origins.chunk_by(|one, other| one == other).map(move |origins| {
            let start = end;
            end += origins.len();
            (origins[0], start..end)
        });
        runs.filter(|(_, run)| !self.locals[run.start].is_nan())
    }
}

/// Kernel: leaf and local position of many coordinates, consistent with [`Lattice::index_from_world`].
struct ToLeafCoords<'a, T> {
    positions: &'a [T],
    voxel_size: f64,
    origins: &'a mut [i32],
    locals: &'a mut [f32],
}

impl<T: Copy + Into<f64>> Kernel for ToLeafCoords<'_, T> {
    type Output = ();

    #[inline(always)]
    fn run<V: Lanes>(self) {
        let edge = f64::from(LEAF_EDGE);
        for ((&position, origin), local) in self.positions.iter().zip(self.origins).zip(self.locals) {
            let index = position.into() / self.voxel_size;
            let leaf = (index / edge).floor() * edge;
            // Comparison with NaN is false, so NaN positions count as outside.
            let is_inside = index.abs() < f64::from(INDEX_LIMIT);
            *origin = if is_inside { leaf as i32 } else { i32::MIN };
            *local = if is_inside { (index - leaf) as f32 } else { f32::NAN };
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::particles::{OwnedPositions, ParticleSource};
    use crate::storage::tests::InMemory;

    #[test]
    fn stored_bins_are_read_as_they_were() {
        let ellipsoid = |index: u8| Ellipsoid { longest: f32::from(index), ..Ellipsoid::ball(1.0) };
        let storage = InMemory::default();
        let mut end = 0;
        let mut all = Vec::new();
        for shapes in [
            Shapes::Uniform,
            Shapes::Scaled(vec![0.5, 2.0, 3.0]),
            Shapes::Ellipsoids([7, 8, 9].map(ellipsoid).to_vec()),
        ] {
            let bins = ParticleBins {
                topology: Topology::new(vec![IVec3::ZERO, IVec3::new(8, 0, -16)]),
                starts: vec![0, 1, 3],
                positions: [1.5, 2.5, 3.5].map(Vec3::splat).to_vec(),
                shapes,
                deep: [IVec3::splat(8), IVec3::splat(-8)].into_iter().collect(),
                ..ParticleBins::default()
            };
            for bins in [bins, ParticleBins { starts: vec![0], ..ParticleBins::default() }] {
                let stored = StoredBins::write(&bins, &storage, end).expect("in memory");
                end = stored.end;
                all.push((bins, stored));
            }
        }
        for (bins, stored) in all {
            let found = stored.read(&storage).expect("in memory");
            assert_eq!(found.topology.origins(), bins.topology.origins());
            assert_eq!((found.starts, found.positions), (bins.starts, bins.positions));
            assert_eq!((found.shapes, found.deep), (bins.shapes, bins.deep));
        }
    }

    #[test]
    fn batch_leaves_match_the_lattice() {
        let lattice = Lattice { voxel_size: 0.3 };
        let limit = 0.3 * f64::from(INDEX_LIMIT);
        let mut positions: Vec<[f64; 3]> = (0..300)
            .map(|i| [f64::from(i % 7) - 3.0, f64::from(i % 11) * 0.7, f64::from(i % 5) * -1.1])
            .collect();
        positions.extend([[0.0, -1e-20, 0.0], [f64::NAN, 0.0, 0.0], [0.0, 0.0, f64::INFINITY]]);
        positions.extend([[limit, 0.0, 0.0], [0.0, -limit, 0.0], [0.999 * limit, 0.0, -0.999 * limit]]);
        let particles = OwnedPositions::F64(positions.clone());
        let Ok(batch) = particles.batch(0);
        let batch = LeafBatch::new(&batch, &lattice, true);
        let mut found = 0;
        for (origin, locals) in batch.leaves() {
            let expected: Vec<Vec3> = positions
                .iter()
                .filter_map(|&position| lattice.index_from_world(position.into()))
                .filter(|index| (index / 8.0).floor() * 8.0 == origin.as_dvec3())
                .map(|index| (index - origin.as_dvec3()).as_vec3())
                .collect();
            assert_eq!(locals, expected, "{origin}");
            found += locals.len();
        }
        for (origin, locals, indices) in batch.leaves_with_indices() {
            for (local, &index) in locals.iter().zip(indices) {
                let index = lattice.index_from_world(positions[index as usize].into()).expect("not dropped");
                assert_eq!(*local, (index - origin.as_dvec3()).as_vec3());
            }
        }
        assert_eq!((found, batch.len(), batch.dropped_count), (302, 302, 4));
    }
}
