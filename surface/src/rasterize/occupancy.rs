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

use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Mutex, PoisonError};

use glam::{DVec3, IVec3, Vec3};
use rayon::prelude::*;
use rustc_hash::FxHashMap;

use super::bin::LeafBatch;
use super::outlier_leaves;
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

// A map from leaf origins to values that many threads fill concurrently.
//
// Particles of one leaf can be in any batch, and in a shuffled file every batch has particles of every leaf.
// So threads update the leaf's entry directly. The entries are in many shards with a lock each, so threads
// seldom wait for each other. Updates arrive in any order, so the result must not depend on the order.

/// A sharded map from leaf origins to values, writable by many threads.
pub(super) struct ConcurrentLeafMap<T> {
    shards: Vec<Mutex<Shard<T>>>,
    leaf_count: AtomicUsize,
}

/// The values lie in one large memory block per shard, not in millions of small ones, so that freeing it
/// returns the memory to the system.
struct Shard<T> {
    /// Index in `values` of each leaf.
    slots: FxHashMap<IVec3, u32>,
    values: Vec<T>,
}

/// Number of shards. Adjacent leaves are in different shards.
const SHARD_COUNT: usize = 64;

impl<T> ConcurrentLeafMap<T> {
    pub(super) fn new() -> ConcurrentLeafMap<T> {
        let shard = || Mutex::new(Shard { slots: FxHashMap::default(), values: Vec::new() });
        ConcurrentLeafMap {
            shards: (0..SHARD_COUNT).map(|_| shard()).collect(),
            leaf_count: AtomicUsize::new(0),
        }
    }

    /// Number of leaves so far.
    pub(super) fn leaf_count(&self) -> usize {
        self.leaf_count.load(Ordering::Relaxed)
    }

    /// Updates the value of a leaf with `add`; creates it with `first` if it does not exist.
    pub(super) fn add(&self, origin: IVec3, first: impl FnOnce() -> T, add: impl FnOnce(&mut T)) {
        // Each update is applied under the lock, so a shard is consistent even if its lock is poisoned.
        let mut shard = self.shards[shard_of(origin)].lock().unwrap_or_else(PoisonError::into_inner);
        let Shard { slots, values } = &mut *shard;
        let slot = *slots.entry(origin).or_insert_with(|| {
            values.push(first());
            self.leaf_count.fetch_add(1, Ordering::Relaxed);
            values.len() as u32 - 1
        });
        add(&mut values[slot as usize]);
    }

    /// Turns the map into its read-only form.
    pub(super) fn freeze(self) -> LeafMap<T> {
        let open = |shard: Mutex<_>| shard.into_inner().unwrap_or_else(PoisonError::into_inner);
        LeafMap(self.shards.into_iter().map(open).collect())
    }
}

/// A map from leaf origins to values, without locks.
pub(super) struct LeafMap<T>(Vec<Shard<T>>);

impl<T> LeafMap<T> {
    /// The value of the leaf with this origin.
    pub(super) fn get(&self, origin: IVec3) -> Option<&T> {
        let Shard { slots, values } = &self.0[shard_of(origin)];
        slots.get(&origin).map(|&slot| &values[slot as usize])
    }

    /// Removes a leaf's key and returns its value.
    pub(super) fn remove(&mut self, origin: IVec3) -> Option<&T> {
        let Shard { slots, values } = &mut self.0[shard_of(origin)];
        slots.remove(&origin).map(|slot| &values[slot as usize])
    }

    /// All leaves and their values, unordered.
    pub(super) fn iter(&self) -> impl Iterator<Item = (&IVec3, &T)> {
        self.0.iter().flat_map(|Shard { slots, values }| {
            slots.iter().map(|(origin, &slot)| (origin, &values[slot as usize]))
        })
    }
}

fn shard_of(origin: IVec3) -> usize {
    let [x, y, z] = (origin / LEAF_EDGE).to_array().map(|along| (along & 3) as usize);
    x * 16 + y * 4 + z
}

// Measures how widely a frame's particles are spread, from the leaves that contain them.
//
//   ┌──┬──┬──┐                                   ┌──┐
//   │ 9│50│30│                                   │ 1│      half of the particles are within one or two leaves
//   └──┴──┴──┘                                   └──┘      of their median, however far away the last one is

/// Median distance of the particles from their median position, in voxels, where the distance is the
/// maximum over the axes. `leaves` yields leaf origins with their particle counts. Returns 0, without
/// sorting, for a frame at most `unseen_voxels` wide; most frames are that narrow.
pub(super) fn spread<L: Iterator<Item = (IVec3, usize)>>(leaves: impl Fn() -> L, unseen_voxels: i32) -> u32 {
    let bounds = leaves().map(|(origin, _)| (origin, origin));
    let Some((low, high)) = bounds.reduce(|(low, high), (one, _)| (low.min(one), high.max(one))) else {
        return 0;
    };
    // The difference of two indices of the grid fits into 32 bits.
    if (high - low).max_element() <= unseen_voxels {
        return 0;
    }
    let along = |axis: usize| middle(leaves().map(|(origin, count)| (origin[axis], count)));
    let center = IVec3::new(along(0), along(1), along(2));
    middle(leaves().map(|(origin, count)| ((origin - center).abs().max_element(), count))).unsigned_abs()
}

/// Weighted median: half of the total count is at or below this value.
pub(super) fn middle(values: impl Iterator<Item = (i32, usize)>) -> i32 {
    let mut values: Vec<(i32, usize)> = values.collect();
    values.sort_unstable();
    let half = values.iter().map(|&(_, count)| count).sum::<usize>().div_ceil(2);
    let mut passed = 0;
    let reaches_half = |&(value, count): &(i32, usize)| {
        passed += count;
        (passed >= half).then_some(value)
    };
    values.iter().find_map(reaches_half).unwrap_or(0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::particles::{OwnedPositions, Positions, erased};

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

    const FAR: i32 = (1 << 30) - 8;

    #[test]
    fn spread_is_the_median_distance_from_the_median() {
        let spread_of = |leaves: &[(i32, usize)]| {
            spread(|| leaves.iter().map(|&(x, count)| (IVec3::new(x, 8, -x), count)), 1000)
        };
        assert_eq!(spread_of(&[]), 0);
        assert_eq!(spread_of(&[(0, 1), (1000, 1)]), 0, "two particles");
        assert_eq!(spread_of(&[(0, 9), (8, 50), (16, 30), (FAR, 1)]), 0, "one stray particle");
        assert_eq!(spread_of(&[(0, 40), (8, 50), (-FAR, 30), (FAR, 40)]), 8);
        assert_eq!(spread_of(&[(-80_000, 3), (-40_000, 3), (0, 1), (40_000, 3), (80_000, 3)]), 40_000);
    }
}
