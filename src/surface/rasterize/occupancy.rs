//! Where there are particles, to half a voxel: the first of two passes over them.
//!
//! ```text
//!   a voxel     ┌───┬───┐      each of its eight octants has a bit: a particle is in it.
//!               │ ● │   │      512 bytes for a leaf, however many particles are there
//!               ├───┼───┤
//!               │   │●● │      (a voxel's own octants are those towards larger x, y and z)
//!               └───┴───┘
//! ```
//!
//! From this alone it can be told which leaves the surface cannot pass through, so that neither distances nor
//! particles need to be kept there. Whole voxels in place of octants would not do: at the usual two voxels
//! from particle to particle, they know only four in ten of the leaves that octants know to be inside.

use glam::{DVec3, IVec3, Vec3};
use rayon::prelude::*;

use super::batch::LeafBatch;
use super::shards::{Shards, Told};
use super::strayed::strayed;
use crate::surface::grid::{LEAF_EDGE, Topology};
use crate::surface::particles::ParticleSource;
use crate::surface::space::{CoordBox, Lattice};

/// Where there are particles.
pub struct Occupancy {
    /// The leaves that hold at least one particle.
    pub topology: Topology,
    /// What is known of each of them.
    occupied: Told<Occupied>,
    /// Whether particles have shapes of their own.
    pub(super) has_shapes: bool,
    /// What each batch told.
    pub(super) batches: Vec<BatchSummary>,
    /// Particles [too far](strayed) from the others.
    strayed_count: usize,
    /// About where one particle is that is too far away, for the grid or from the others; world units.
    stray: Option<DVec3>,
}

/// What is known of a leaf that holds particles.
struct Occupied {
    octants: Octants,
    /// Those of its [round](ROUND) particles, where particles have shapes of their own.
    round: Option<Box<Octants>>,
    /// The longest half axis of any of its particles, in units of the radii.
    longest: f32,
    /// How many particles it holds.
    count: usize,
    /// The first batch that has any of them.
    first_batch: usize,
}

/// A particle is round if it holds a ball of so many of the settings' radii. Inside a fluid particles are: what is deep can be
/// told from them, however flat the particles of sheets are.
pub(super) const ROUND: f32 = 0.9;

/// What is remembered of a batch, so that it need not be looked at where it is of no use.
#[derive(Clone, Copy)]
pub(super) struct BatchSummary {
    /// The box of its leaves.
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

    /// Puts in a particle, given relative to the leaf's origin. (Rounded, that may be at the far end.)
    fn insert(&mut self, local: Vec3) {
        let [x, y, z] = (local * 2.0).to_array().map(|along| (along as usize).min(15));
        self.rows[x * 16 + y] |= 1 << z;
    }

    /// The box of the voxels that hold a particle, relative to the leaf's origin.
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
    /// Looks at each particle once.
    ///
    /// # Errors
    /// Those of the source.
    pub fn new<S: ParticleSource>(source: &S, lattice: &Lattice) -> Result<Occupancy, S::Error> {
        let shards: Shards<Occupied> = Shards::new();
        let has_shapes = source.has_shapes();
        let look = |batch_index: usize| -> Result<BatchSummary, S::Error> {
            let shapes = source.shapes_of(batch_index);
            let batch = LeafBatch::new(&source.batch(batch_index)?, lattice, has_shapes);
            let mut voxels = CoordBox::EMPTY;
            for (origin, locals, places) in batch.leaves_with_places() {
                let longest = places.iter().map(|&place| shapes.longest(place as usize));
                let longest = longest.fold(if has_shapes { 0.0 } else { 1.0 }, f32::max);
                voxels.include(origin);
                voxels.include(origin + IVec3::splat(LEAF_EDGE - 1));
                shards.add(
                    origin,
                    || Occupied {
                        octants: Octants::EMPTY,
                        round: has_shapes.then(|| Box::new(Octants::EMPTY)),
                        longest: 0.0,
                        count: 0,
                        first_batch: batch_index,
                    },
                    |leaf| {
                        locals.iter().for_each(|&local| leaf.octants.insert(local));
                        if let Some(round) = &mut leaf.round {
                            let is_round = |place: u32| shapes.held(place as usize) >= ROUND;
                            let particles = locals.iter().zip(places).filter(|(_, place)| is_round(**place));
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
        let batches = (0..source.batch_count()).into_par_iter().map(look).collect::<Result<Vec<_>, _>>()?;
        let mut occupied = shards.into_told();
        let strayed = strayed(|| occupied.iter().map(|(&origin, leaf)| (origin, leaf.count)));
        let mut count_of_removed = |&origin: &IVec3| occupied.remove(origin).map_or(0, |leaf| leaf.count);
        let strayed_count = strayed.iter().map(&mut count_of_removed).sum();
        let of_leaf = |origin: &IVec3| (origin.as_dvec3() + 0.5 * f64::from(LEAF_EDGE)) * lattice.voxel_size;
        let stray =
            batches.iter().find_map(|batch| batch.beyond_grid).or_else(|| strayed.first().map(of_leaf));
        let topology = Topology::new(occupied.iter().map(|(&origin, _)| origin).collect());
        Ok(Occupancy { topology, occupied, has_shapes, batches, strayed_count, stray })
    }

    /// The number of particles that were not dropped.
    pub fn particle_count(&self) -> usize {
        self.batches.iter().map(|batch| batch.placed_count).sum::<usize>() - self.strayed_count
    }

    /// Particles left out: positions that are not finite, outside the grid's range of indices, or too far from the others.
    pub fn dropped_count(&self) -> usize {
        self.batches.iter().map(|batch| batch.dropped_count).sum::<usize>() + self.strayed_count
    }

    /// About where one of them is, in world units, if any of them is finite.
    pub fn stray(&self) -> Option<DVec3> {
        self.stray
    }

    /// The octants of the leaf with this origin.
    pub(super) fn octants_of(&self, origin: IVec3) -> Option<&Octants> {
        self.occupied.get(origin).map(|leaf| &leaf.octants)
    }

    /// The octants with round particles of the leaf with this origin; `None` where all particles are alike.
    pub(super) fn round_octants_of(&self, origin: IVec3) -> Option<&Octants> {
        self.occupied.get(origin)?.round.as_deref()
    }

    /// The longest half axis of any particle in the leaf with this origin, in units of the radii.
    pub(super) fn longest_of(&self, origin: IVec3) -> f32 {
        self.occupied.get(origin).map_or(0.0, |leaf| leaf.longest)
    }

    /// How many particles the leaf with this origin holds, and the first batch that has any of them.
    pub(super) fn count_of(&self, origin: IVec3) -> Option<(usize, usize)> {
        self.occupied.get(origin).map(|leaf| (leaf.count, leaf.first_batch))
    }

    /// The longest half axis of any particle, in units of the radii.
    pub fn longest(&self) -> f32 {
        self.occupied.iter().map(|(_, leaf)| leaf.longest).fold(0.0, f32::max)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::surface::particles::{Particles, Positions};

    #[test]
    fn octants_hold_the_particles() {
        let positions = vec![[0.0, 0.4, 0.5], [7.9, -0.1, 3.0], [f32::NAN; 3], [0.1, 0.2, 0.9]];
        let lattice = Lattice { voxel_size: 1.0 };
        let Ok(occupancy) = Occupancy::new(&Particles::Single(positions), &lattice);
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

    /// A file that cannot be read to its end.
    struct Broken;

    impl ParticleSource for Broken {
        type Error = &'static str;

        fn batch_count(&self) -> usize {
            3
        }

        fn batch(&self, batch: usize) -> Result<Positions<'_>, &'static str> {
            if batch == 2 { Err("the end is missing") } else { Ok(Positions::F32(vec![[0.0; 3]].into())) }
        }

        fn count_of(&self, _batch: usize) -> usize {
            1
        }
    }

    #[test]
    fn what_keeps_a_source_from_its_particles_is_told() {
        let told = Occupancy::new(&Broken, &Lattice { voxel_size: 1.0 });
        assert_eq!(told.err(), Some("the end is missing"));
    }
}
