//! A batch of particles, sorted by leaf.
//!
//! ```text
//!   batch       p0 p1 p2 p3 p4 p5        in the order of the source
//!   leaves      A  A  B  A  C  B
//!   sorted      p0 p1 p3 | p2 p5 | p4    A, B, C: in the order of first appearance
//! ```
//!
//! Both passes over the particles begin with this step. Consecutive particles in a file are usually close in
//! space, so a leaf is looked up only when it differs from that of the previous particle.

use std::ops::Range;

use glam::{DVec3, IVec3, Vec3};
use rustc_hash::FxHashMap;

use crate::grid::LEAF_EDGE;
use crate::particles::Positions;
use crate::simd::{self, Kernel, Lanes};
use crate::space::{INDEX_LIMIT, Lattice};

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
