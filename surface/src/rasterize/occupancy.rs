//! Records where particles are, to half a voxel. This is the first of two passes over the particles.
//!
//! ```text
//!   a voxel     ┌───┬───┐      each of its eight octants has a bit, set if a particle is in it:
//!               │ ● │   │      512 bytes per leaf, however many particles it contains
//!               ├───┼───┤
//!               │   │●● │      (here a voxel's octants are those toward larger x, y and z of its center)
//!               └───┴───┘
//! ```
//!
//! The occupancy alone shows which leaves the surface cannot pass through, so that neither distances nor
//! particles are stored there. Whole voxels instead of octants would not be precise enough: at the usual
//! particle spacing of two voxels they identify only 40 % of the inside leaves that octants identify.

use glam::{DVec3, IVec3, Vec3};
use rayon::prelude::*;

use super::batch::LeafBatch;
use super::leaf_map::{ConcurrentLeafMap, LeafMap};
use super::outliers::outlier_leaves;
use crate::grid::{LEAF_EDGE, Topology};
use crate::parallel::Loops as _;
use crate::particles::{AnySource, Unread};
use crate::space::{CoordBox, Lattice};

/// Where a frame's particles are.
pub struct Occupancy {
    /// The leaves that contain at least one particle.
    pub topology: Topology,
    /// The particles of each leaf.
    occupied: LeafMap<OccupiedLeaf>,
    /// True if particles are anisotropic or differ in size.
    pub(super) has_shapes: bool,
    /// A summary of each batch.
    pub(super) batches: Vec<BatchSummary>,
    /// Number of particles [too far](outlier_leaves) from the others.
    outlier_count: usize,
    /// Approximate world position of one dropped particle: one outside the grid's index range, or otherwise
    /// one too far from the others.
    outlier_position: Option<DVec3>,
}

/// The particles of a leaf.
struct OccupiedLeaf {
    octants: Octants,
    /// The octants of its [round](ROUND) particles, if particles are anisotropic or differ in size.
    round: Option<Box<Octants>>,
    /// Longest semi-axis of its particles, in units of the radii.
    longest: f32,
    /// Number of particles.
    count: usize,
    /// The first batch that has particles in this leaf.
    first_batch: usize,
}

/// A particle is round if it contains a ball of this radius, in units of the settings' radii. Particles deep
/// in a fluid are round, so they suffice to identify deep leaves, however flat the particles of thin sheets
/// are.
pub(super) const ROUND: f32 = 0.9;

/// Summary of a batch, used to skip batches that cannot contribute.
#[derive(Clone, Copy)]
pub(super) struct BatchSummary {
    /// Bounding box of its leaves.
    pub(super) voxels: CoordBox,
    placed_count: usize,
    dropped_count: usize,
    beyond_grid: Option<DVec3>,
}

/// One bit for each octant of the voxels of a leaf: rows of 16 along z, row `x·16 + y`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Octants {
    pub(super) rows: [u16; 256],
}

impl Octants {
    /// No particle.
    pub(super) const EMPTY: Octants = Octants { rows: [0; 256] };

    /// Adds a particle, given by its position relative to the leaf's origin, in voxels. Rounding can put a
    /// particle on the leaf's upper boundary; it then belongs to the last octant.
    fn insert(&mut self, local: Vec3) {
        let [x, y, z] = (local * 2.0).to_array().map(|along| (along as usize).min(15));
        self.rows[x * 16 + y] |= 1 << z;
    }

    /// Bounding box of the voxels that contain a particle, relative to the leaf's origin.
    pub(super) fn cells(&self) -> CoordBox {
        let mut cells = CoordBox::EMPTY;
        for (row, bits) in self.rows.into_iter().enumerate().filter(|&(_, bits)| bits != 0) {
            let (x, y) = (row as i32 / 32, row as i32 % 16 / 2);
            cells.include(IVec3::new(x, y, bits.trailing_zeros() as i32 / 2));
            cells.include(IVec3::new(x, y, (15 - bits.leading_zeros() as i32) / 2));
        }
        cells
    }
}

impl Occupancy {
    /// Reads each particle once.
    ///
    /// # Errors
    /// Returns the source's error if a batch cannot be read.
    pub fn new(source: &AnySource<'_>, lattice: &Lattice) -> Result<Occupancy, Unread> {
        let leaf_map: ConcurrentLeafMap<OccupiedLeaf> = ConcurrentLeafMap::new();
        let has_shapes = source.has_shapes();
        let summarize_batch = |batch_index: usize| -> Result<BatchSummary, Unread> {
            let shapes = source.batch_shapes(batch_index);
            let batch = LeafBatch::new(&source.batch(batch_index)?, lattice, has_shapes);
            let mut voxels = CoordBox::EMPTY;
            for (origin, locals, indices) in batch.leaves_with_indices() {
                let longest = indices.iter().map(|&index| shapes.outer_radius(index as usize));
                let longest = longest.fold(if has_shapes { 0.0 } else { 1.0 }, f32::max);
                voxels.include(origin);
                voxels.include(origin + IVec3::splat(LEAF_EDGE - 1));
                leaf_map.add(
                    origin,
                    || OccupiedLeaf {
                        octants: Octants::EMPTY,
                        round: has_shapes.then(|| Box::new(Octants::EMPTY)),
                        longest: 0.0,
                        count: 0,
                        first_batch: batch_index,
                    },
                    |leaf| {
                        locals.iter().for_each(|&local| leaf.octants.insert(local));
                        if let Some(round) = &mut leaf.round {
                            let is_round = |index: u32| shapes.inner_radius(index as usize) >= ROUND;
                            let particles = locals.iter().zip(indices).filter(|(_, index)| is_round(**index));
                            particles.for_each(|(&local, _)| round.insert(local));
                        }
                        leaf.longest = leaf.longest.max(longest);
                        leaf.count += locals.len();
                        leaf.first_batch = leaf.first_batch.min(batch_index);
                    },
                );
            }
            let LeafBatch { dropped_count, beyond_grid, .. } = batch;
            Ok(BatchSummary { voxels, placed_count: batch.len(), dropped_count, beyond_grid })
        };
        let batches = (0..source.batch_count())
            .into_par_iter()
            .halved()
            .map(summarize_batch)
            .collect::<Result<Vec<_>, _>>()?;
        let mut occupied = leaf_map.freeze();
        let outliers = outlier_leaves(|| occupied.iter().map(|(&origin, leaf)| (origin, leaf.count)));
        let mut count_of_removed = |&origin: &IVec3| occupied.remove(origin).map_or(0, |leaf| leaf.count);
        let outlier_count = outliers.iter().map(&mut count_of_removed).sum();
        let of_leaf = |origin: &IVec3| (origin.as_dvec3() + 0.5 * f64::from(LEAF_EDGE)) * lattice.voxel_size;
        let outlier_position =
            batches.iter().find_map(|batch| batch.beyond_grid).or_else(|| outliers.first().map(of_leaf));
        let topology = Topology::new(occupied.iter().map(|(&origin, _)| origin).collect());
        Ok(Occupancy { topology, occupied, has_shapes, batches, outlier_count, outlier_position })
    }

    /// Number of particles that were not dropped.
    pub fn particle_count(&self) -> usize {
        self.batches.iter().map(|batch| batch.placed_count).sum::<usize>() - self.outlier_count
    }

    /// Number of dropped particles: positions that are not finite, outside the grid's index range, or too far
    /// from the others.
    pub fn dropped_count(&self) -> usize {
        self.batches.iter().map(|batch| batch.dropped_count).sum::<usize>() + self.outlier_count
    }

    /// Approximate world position of one dropped particle, if any of them is finite.
    pub fn outlier_position(&self) -> Option<DVec3> {
        self.outlier_position
    }

    /// The octants of the leaf with this origin.
    pub(super) fn octants_of(&self, origin: IVec3) -> Option<&Octants> {
        self.occupied.get(origin).map(|leaf| &leaf.octants)
    }

    /// The octants that contain round particles, in the leaf with this origin; `None` if all particles are
    /// uniform, or the leaf has none.
    pub(super) fn round_octants_of(&self, origin: IVec3) -> Option<&Octants> {
        self.occupied.get(origin)?.round.as_deref()
    }

    /// Longest semi-axis of the particles in the leaf with this origin, in units of the radii.
    pub(super) fn longest_of(&self, origin: IVec3) -> f32 {
        self.occupied.get(origin).map_or(0.0, |leaf| leaf.longest)
    }

    /// Number of particles in the leaf with this origin, and the first batch that has particles there.
    pub(super) fn count_of(&self, origin: IVec3) -> Option<(usize, usize)> {
        self.occupied.get(origin).map(|leaf| (leaf.count, leaf.first_batch))
    }

    /// Longest semi-axis of all particles, in units of the radii.
    pub fn longest(&self) -> f32 {
        self.occupied.iter().map(|(_, leaf)| leaf.longest).fold(0.0, f32::max)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::particles::erased;
    use crate::particles::{OwnedPositions, Positions};

    #[test]
    fn octants_contain_the_particles() {
        let positions = vec![[0.0, 0.4, 0.5], [7.9, -0.1, 3.0], [f32::NAN; 3], [0.1, 0.2, 0.9]];
        let lattice = Lattice { voxel_size: 1.0 };
        let Ok(occupancy) =
            erased(&OwnedPositions::F32(positions), |source| Occupancy::new(source, &lattice));
        assert_eq!((occupancy.particle_count(), occupancy.dropped_count()), (3, 1));
        assert_eq!(occupancy.topology.origins(), [IVec3::new(0, -8, 0), IVec3::ZERO]);
        let octants = [IVec3::new(0, -8, 0), IVec3::ZERO].map(|origin| occupancy.octants_of(origin).unwrap());
        let bits = |leaf: usize| -> Vec<(usize, u16)> {
            let rows = octants[leaf].rows.into_iter().enumerate();
            rows.filter(|&(_, row)| row != 0).collect()
        };
        assert_eq!(bits(0), [(15 * 16 + 15, 1 << 6)]);
        assert_eq!(bits(1), [(0, 0b10)]);
        let voxel = |x, y, z| IVec3::new(x, y, z);
        assert_eq!(octants[0].cells(), CoordBox { min: voxel(7, 7, 3), max: voxel(7, 7, 3) });
        assert_eq!(octants[1].cells(), CoordBox { min: IVec3::ZERO, max: IVec3::ZERO });
        assert!(Octants::EMPTY.cells().is_empty());
        let whole = Octants { rows: [1 << 4 | 1 << 15; 256] };
        assert_eq!(whole.cells(), CoordBox { min: voxel(0, 0, 2), max: IVec3::splat(7) });
    }

    /// A source whose third batch cannot be read.
    struct Broken;

    impl crate::particles::ParticleSource for Broken {
        type Error = &'static str;

        fn batch_count(&self) -> usize {
            3
        }

        fn batch(&self, batch: usize) -> Result<Positions<'_>, &'static str> {
            if batch == 2 { Err("the end is missing") } else { Ok(Positions::F32(vec![[0.0; 3]].into())) }
        }

        fn batch_len(&self, _batch: usize) -> usize {
            1
        }
    }

    #[test]
    fn source_error_is_returned() {
        let result = erased(&Broken, |source| Occupancy::new(source, &Lattice { voxel_size: 1.0 }));
        assert_eq!(result.err(), Some("the end is missing"));
    }
}
