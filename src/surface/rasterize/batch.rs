//! A batch of particles, sorted by the leaves they lie in.
//!
//! ```text
//!   batch       p0 p1 p2 p3 p4 p5        as the source has them
//!   leaves      A  A  B  A  C  B
//!   sorted      p0 p1 p3 | p2 p5 | p4    A, B, C: in the order in which they first appear
//! ```
//!
//! Both passes over the particles begin with this. Neighbours in a file are mostly neighbours in space: a
//! leaf is looked up only where it is not that of the particle before.

use std::ops::Range;

use glam::{DVec3, IVec3, Vec3};
use rustc_hash::FxHashMap;

use crate::surface::grid::LEAF_EDGE;
use crate::surface::particles::Positions;
use crate::surface::simd::{self, Kernel, Lanes};
use crate::surface::space::{INDEX_LIMIT, Lattice};

/// The particles of a batch by leaf.
pub(super) struct LeafBatch {
    /// The leaves that hold any.
    origins: Vec<IVec3>,
    /// Where the particles of each leaf start; one more entry than leaves.
    starts: Vec<u32>,
    /// Positions in voxels relative to the origin of their leaf, 0 to 8 on each axis.
    locals: Vec<Vec3>,
    /// For each of them which particle of the batch it is; empty unless asked for.
    places: Vec<u32>,
    /// Particles left out: positions that are not finite, or outside the grid's range of indices.
    pub(super) dropped_count: usize,
    /// The first of them that is finite: it is too far away for the grid.
    pub(super) beyond_grid: Option<DVec3>,
}

impl LeafBatch {
    /// Sorts a batch. Particles of a leaf keep their order. `with_places` where it will matter which particle is which.
    pub(super) fn new(positions: &Positions, lattice: &Lattice, with_places: bool) -> LeafBatch {
        let placed = Placed::new(positions, lattice);
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
        let mut places = vec![0; if with_places { locals.len() } else { 0 }];
        for (leaf, run) in runs {
            let cursor = &mut cursors[leaf as usize];
            let to = *cursor as usize..*cursor as usize + run.len();
            *cursor += run.len() as u32;
            if with_places {
                places[to.clone()].iter_mut().zip(run.clone()).for_each(|(to, place)| *to = place as u32);
            }
            locals[to].copy_from_slice(&placed.locals[run]);
        }
        let dropped_count = placed.locals.len() - locals.len();
        let position = |place: usize| match positions {
            Positions::F32(positions) => Vec3::from(positions[place]).as_dvec3(),
            Positions::F64(positions) => DVec3::from(positions[place]),
        };
        let is_beyond = |place: &usize| placed.locals[*place].is_nan() && position(*place).is_finite();
        let beyond_grid = (dropped_count > 0).then(|| (0..placed.locals.len()).find(is_beyond)).flatten();
        LeafBatch { dropped_count, beyond_grid: beyond_grid.map(position), origins, starts, locals, places }
    }

    /// The particles that were not dropped.
    pub(super) fn len(&self) -> usize {
        self.locals.len()
    }

    /// The origin of each leaf, and its particles relative to that, in voxels.
    pub(super) fn leaves(&self) -> impl Iterator<Item = (IVec3, &[Vec3])> {
        let ranges = self.starts.windows(2).map(|ends| ends[0] as usize..ends[1] as usize);
        self.origins.iter().zip(ranges).map(|(&origin, range)| (origin, &self.locals[range]))
    }

    /// The same, and which particles of the batch these are: none unless that was asked for.
    pub(super) fn leaves_with_places(&self) -> impl Iterator<Item = (IVec3, &[Vec3], &[u32])> {
        let ranges = self.starts.windows(2).map(|ends| ends[0] as usize..ends[1] as usize);
        self.origins.iter().zip(ranges).map(|(&origin, range)| {
            let places = if self.places.is_empty() { &[] } else { &self.places[range.clone()] };
            (origin, &self.locals[range], places)
        })
    }
}

/// For each particle the leaf that it lies in, and its position relative to that, in voxels. Where there is none
/// the position is not a number, and the leaf none that there could be.
pub(super) struct Placed {
    origins: Vec<IVec3>,
    pub(super) locals: Vec<Vec3>,
}

impl Placed {
    pub(super) fn new(positions: &Positions, lattice: &Lattice) -> Placed {
        match positions {
            Positions::F32(positions) => Placed::of(positions, lattice),
            Positions::F64(positions) => Placed::of(positions, lattice),
        }
    }

    fn of<T: Copy + Into<f64>>(positions: &[[T; 3]], lattice: &Lattice) -> Placed {
        let mut placed =
            Placed { origins: vec![IVec3::ZERO; positions.len()], locals: vec![Vec3::ZERO; positions.len()] };
        simd::dispatch(Place {
            positions: positions.as_flattened(),
            voxel_size: lattice.voxel_size,
            origins: bytemuck::cast_slice_mut(&mut placed.origins),
            locals: bytemuck::cast_slice_mut(&mut placed.locals),
        });
        placed
    }

    /// Particles in a row that lie in one leaf, for all that have a place.
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

/// As [`Lattice::index_from_world`], for all axes of many positions.
struct Place<'a, T> {
    positions: &'a [T],
    voxel_size: f64,
    origins: &'a mut [i32],
    locals: &'a mut [f32],
}

impl<T: Copy + Into<f64>> Kernel for Place<'_, T> {
    type Output = ();

    #[inline(always)]
    fn run<V: Lanes>(self) {
        let edge = f64::from(LEAF_EDGE);
        for ((&position, origin), local) in self.positions.iter().zip(self.origins).zip(self.locals) {
            let index = position.into() / self.voxel_size;
            let leaf = (index / edge).floor() * edge;
            // A comparison with NaN is false: what is not a number is not inside.
            let is_inside = index.abs() < f64::from(INDEX_LIMIT);
            *origin = if is_inside { leaf as i32 } else { i32::MIN };
            *local = if is_inside { (index - leaf) as f32 } else { f32::NAN };
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::surface::particles::{ParticleSource, Particles};

    #[test]
    fn particles_are_sorted_into_the_leaves_that_the_lattice_says() {
        let lattice = Lattice { voxel_size: 0.3 };
        let limit = 0.3 * f64::from(INDEX_LIMIT);
        let mut positions: Vec<[f64; 3]> = (0..300)
            .map(|i| [f64::from(i % 7) - 3.0, f64::from(i % 11) * 0.7, f64::from(i % 5) * -1.1])
            .collect();
        positions.extend([[0.0, -1e-20, 0.0], [f64::NAN, 0.0, 0.0], [0.0, 0.0, f64::INFINITY]]);
        positions.extend([[limit, 0.0, 0.0], [0.0, -limit, 0.0], [0.999 * limit, 0.0, -0.999 * limit]]);
        let particles = Particles::Double(positions.clone());
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
        for (origin, locals, places) in batch.leaves_with_places() {
            for (local, &place) in locals.iter().zip(places) {
                let index = lattice.index_from_world(positions[place as usize].into()).expect("not dropped");
                assert_eq!(*local, (index - origin.as_dvec3()).as_vec3());
            }
        }
        assert_eq!((found, batch.len(), batch.dropped_count), (302, 302, 4));
    }
}
