//! Estimates how many leaves a frame needs before it is rasterized.
//!
//! ```text
//!   s s s s s        s  near the surface
//!   s ● ● ● s        ●  holds particles, and is near the surface
//!   s ● i ● s        i  deep inside: nothing is stored there
//!   s ● ● ● s
//! ```
//!
//! Each particle is visited once and no distances are computed. This takes about 1 % of the reconstruction
//! time and is accurate to about a third. The estimate is usually too high, because balls are replaced by
//! boxes.
//!
//! Scattered particles in small voxels have so many leaves near them that even counting these would take more
//! memory than the frame may use. So counting stops at a limit.

use std::sync::atomic::{AtomicUsize, Ordering};

use glam::{IVec3, Vec3};
use rayon::prelude::*;
use rustc_hash::FxHashSet;

use super::RasterParams;
use super::bin::LeafBatch;
use super::occupancy::{ConcurrentLeafMap, LeafMap, spread};
use crate::grid::{LEAF_EDGE, Topology};
use crate::parallel::Loops as _;
use crate::particles::{AnySource, Unread};

/// Estimated counts of leaves and particles.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Footprint {
    /// Whether counting stopped at its limit: then all numbers are less than those of the whole frame.
    pub is_partial: bool,
    /// Origins of the leaves within the band's half width of the surface, unordered.
    pub surface: Vec<IVec3>,
    /// Number of leaves that contain particles.
    pub occupied_count: usize,
    /// Area of the surface, in voxel faces.
    pub area_voxels: usize,
    /// Number of particles that were not dropped.
    pub particle_count: usize,
    /// Number of particles in leaves that are not deep inside: approximately the number that is kept.
    pub near_particle_count: usize,
    /// Approximate number of particles whose neighborhoods are evaluated before rasterization; 0 if
    /// none are.
    pub shaped_particle_count: usize,
    /// Number of dropped particles: not finite, or too far away for the grid.
    pub dropped_count: usize,
    /// Median distance of the particles from their median position along an axis, in voxels; 0 if the frame
    /// is at most 65 536 voxels wide.
    pub spread_voxels: u32,
}

/// The spread is not computed for frames up to this width: they are far within the precision of 32-bit
/// positions.
const SPREAD_UNSEEN_VOXELS: i32 = 1 << 16;

/// Which particles count as near the surface.
#[derive(Clone, Copy, Debug)]
pub struct NearSurface {
    /// A particle is near if a point that no particle certainly covers lies within this distance, in voxels.
    pub depth: f32,
    /// A point is certainly covered if a particle is within this distance, in voxels.
    pub cover: f32,
}

impl NearSurface {
    /// True if this many particles in a leaf, arranged as a regular lattice, would certainly cover each of
    /// its voxels.
    fn is_certainly_covered(&self, particle_count: usize) -> bool {
        let spacing = LEAF_EDGE as f32 / (particle_count as f32).cbrt();
        // Half the diagonal of the lattice's cells, plus most of an octant's diagonal: the particle may be
        // anywhere in its octant.
        0.87 * spacing + 0.7 <= self.cover
    }
}

/// Estimated number of particles near the surface: all particles of leaves that are not full, and a fraction
/// of the particles in each layer of leaves behind them. The fraction is the part of the layer that lies
/// within `near.depth` less half a leaf.
fn shaped_count(occupied: &OccupiedLeaves, near: NearSurface) -> usize {
    let count_of = |deep: &[bool]| -> usize {
        let counts = deep.iter().zip(&occupied.leaves).filter(|(is_deep, _)| **is_deep);
        counts.map(|(_, leaf)| leaf.count).sum()
    };
    let full = occupied.is_full.iter().zip(&occupied.leaves);
    let mut deep: Vec<bool> =
        full.map(|(&is_full, leaf)| is_full && near.is_certainly_covered(leaf.count)).collect();
    let mut left = count_of(&deep);
    let mut shaped = (occupied.particle_count() - left) as f32;
    let mut depth = near.depth - 0.5 * LEAF_EDGE as f32;
    while depth > 0.0 && left > 0 {
        let next = occupied.surrounded(&deep);
        let left_next = count_of(&next);
        shaped += (left - left_next) as f32 * (depth / LEAF_EDGE as f32).min(1.0);
        (deep, left) = (next, left_next);
        depth -= LEAF_EDGE as f32;
    }
    shaped as usize
}

/// The leaves that contain particles.
struct OccupiedLeaves {
    topology: Topology,
    leaves: Vec<FootprintLeaf>,
    /// Whether all cells of each leaf contain a particle.
    is_full: Vec<bool>,
}

impl OccupiedLeaves {
    fn new(leaf_map: &LeafMap<FootprintLeaf>, cells: &LeafCells) -> OccupiedLeaves {
        let topology = Topology::new(leaf_map.iter().map(|(&origin, _)| origin).collect());
        let of_leaf = |&origin: &IVec3| leaf_map.get(origin).copied().unwrap_or_default();
        let leaves: Vec<FootprintLeaf> = topology.origins().par_iter().halved().map(of_leaf).collect();
        let is_full = leaves.iter().map(|leaf| leaf.cells == cells.all).collect();
        OccupiedLeaves { topology, leaves, is_full }
    }

    /// The number of particles.
    fn particle_count(&self) -> usize {
        self.leaves.iter().map(|leaf| leaf.count).sum()
    }

    /// Which leaves are chosen together with all 26 leaves around them.
    fn surrounded(&self, is_chosen: &[bool]) -> Vec<bool> {
        let is_surrounded = |leaf: usize| {
            let around = || self.topology.neighborhood(leaf);
            is_chosen[leaf] && around().iter().all(|&leaf| is_chosen.get(leaf as usize) == Some(&true))
        };
        (0..self.leaves.len()).into_par_iter().halved().map(is_surrounded).collect()
    }

    /// The area of the surface, in voxel faces.
    fn open_area(&self, cells: &LeafCells) -> usize {
        let cells_of = |leaf: u32| self.leaves.get(leaf as usize).map_or(0, |leaf| leaf.cells);
        let leaves = self.leaves.par_iter().zip(self.topology.neighbors());
        leaves.halved().map(|(leaf, neighbors)| cells.open_area(leaf.cells, neighbors.map(cells_of))).sum()
    }
}

/// The footprint of these particles. `shaped` selects the particles whose neighborhoods are evaluated before
/// rasterization. Counting stops soon after `leaf_count_max` leaves that contain particles or are near the
/// surface.
///
/// # Errors
/// Returns the source's error if a batch cannot be read.
pub fn footprint(
    source: &AnySource<'_>,
    scene: &RasterParams,
    shaped: Option<NearSurface>,
    leaf_count_max: usize,
) -> Result<Footprint, Unread> {
    let RasterParams { lattice, radii, .. } = scene;
    let near = LeafReach::new(radii.init * radii.band_scale + radii.half_width());
    let cells = LeafCells::new(radii.init);
    let leaf_map: ConcurrentLeafMap<FootprintLeaf> = ConcurrentLeafMap::new();
    let dropped_count = AtomicUsize::new(0);
    let mark_batch = |batch: usize| -> Result<(), Unread> {
        if leaf_map.leaf_count() > leaf_count_max {
            return Ok(());
        }
        let batch = LeafBatch::new(&source.batch(batch)?, lattice, false);
        dropped_count.fetch_add(batch.dropped_count, Ordering::Relaxed);
        for (origin, locals) in batch.leaves() {
            let mut found = FootprintLeaf { count: locals.len(), ..FootprintLeaf::default() };
            for &local in locals {
                found.near |= 1 << near.kind(local);
                found.cells |= 1 << cells.cell(local);
            }
            leaf_map.add(origin, FootprintLeaf::default, |leaf| {
                leaf.count += found.count;
                leaf.near |= found.near;
                leaf.cells |= found.cells;
            });
        }
        Ok(())
    };
    (0..source.batch_count()).into_par_iter().halved().try_for_each(mark_batch)?;
    let occupied = OccupiedLeaves::new(&leaf_map.freeze(), &cells);
    let origins = occupied.topology.origins();
    let near_count_max = leaf_count_max.saturating_sub(origins.len());
    let mut surface = if origins.len() <= leaf_count_max {
        near.leaves(origins, &occupied.leaves, near_count_max)
    } else {
        FxHashSet::default()
    };
    let spread_voxels = spread(
        || origins.iter().zip(&occupied.leaves).map(|(&origin, leaf)| (origin, leaf.count)),
        SPREAD_UNSEEN_VOXELS,
    );
    if origins.len() > leaf_count_max || surface.len() > near_count_max {
        return Ok(Footprint {
            is_partial: true,
            surface: surface.into_iter().collect(),
            occupied_count: origins.len(),
            particle_count: occupied.particle_count(),
            dropped_count: dropped_count.into_inner(),
            spread_voxels,
            ..Footprint::default()
        });
    }
    let deep = occupied.surrounded(&occupied.is_full);
    for (origin, _) in origins.iter().zip(&deep).filter(|(_, is_deep)| **is_deep) {
        surface.remove(origin);
    }
    let cut = leaves_at_obstacles(scene, origins);
    surface.extend(
        cut.iter().flat_map(|&origin| {
            LeafReach::box_of([-1; 3], [1; 3]).map(move |step| origin + step * LEAF_EDGE)
        }),
    );
    // Particles are kept one leaf deeper than distances.
    let dropped = occupied.surrounded(&deep);
    let kept = occupied.leaves.iter().zip(&dropped).filter(|(_, is_dropped)| !**is_dropped);
    Ok(Footprint {
        is_partial: false,
        shaped_particle_count: shaped.map_or(0, |near| shaped_count(&occupied, near)),
        surface: surface.into_iter().collect(),
        occupied_count: origins.len(),
        particle_count: occupied.particle_count(),
        near_particle_count: kept.map(|(leaf, _)| leaf.count).sum(),
        area_voxels: occupied.open_area(&cells) + CUT_AREA * cut.len(),
        dropped_count: dropped_count.into_inner(),
        spread_voxels,
    })
}

/// Leaves that an obstacle's surface passes through: the fluid has a surface there, too.
fn leaves_at_obstacles(scene: &RasterParams, occupied: &[IVec3]) -> Vec<IVec3> {
    if scene.obstacles.is_empty() {
        return Vec::new();
    }
    occupied.par_iter().copied().halved().filter(|&origin| scene.is_at_obstacle(origin)).collect()
}

/// Estimated area in a leaf that the surface crosses, in voxel faces: 8 × 8 from side to side, and half as
/// much again.
const CUT_AREA: usize = 96;

/// The particles of a leaf.
#[derive(Clone, Copy, Default)]
struct FootprintLeaf {
    /// Number of particles.
    count: usize,
    /// The position classes (see [`LeafReach`]) that occur, one bit per class; used to find the leaves near
    /// the surface.
    near: u32,
    /// The cells (see [`LeafCells`]) that contain a particle, one bit per cell.
    cells: u64,
}

/// Number of leaves whose surroundings are collected in one set: so many that most surroundings they share are
/// in the same set.
const LEAVES_PER_SET: usize = 256;

/// Maximum number of leaves in one set, and number of sets that are in memory at once.
const SET_LEAVES_MAX: usize = 1 << 13;
const SET_COUNT: usize = 32;

/// A distance, and the leaves within that distance of a particle, per axis.
///
/// ```text
///   leaf −1          leaf 0            leaf 1
///   |     ┌───────────●───────────┐     |        from the middle both neighbors are within reach,
///   |     |    0    | 1 |    2    |     |        from the ends only one: three position classes
/// ```
struct LeafReach {
    voxels: f32,
    /// Boundaries between the position classes along an axis of the leaf.
    ends: [f32; 2],
    /// The steps to all leaves within reach of any position.
    steps: Vec<IVec3>,
    /// For each position class, which of `steps` are within its reach: one bit per step.
    of_kind: Vec<Vec<u64>>,
}

impl LeafReach {
    fn new(voxels: f32) -> LeafReach {
        let edge = LEAF_EDGE as f32;
        let (low, high) = (voxels.rem_euclid(edge), (-voxels).rem_euclid(edge));
        let mut reach = LeafReach {
            voxels,
            ends: [low.min(high), low.max(high)],
            steps: Vec::new(),
            of_kind: Vec::new(),
        };
        let ranges = [0, 1, 2].map(|kind| reach.range(kind));
        let first = ranges.iter().map(|&(first, _)| first).min().unwrap_or(0);
        let last = ranges.iter().map(|&(_, last)| last).max().unwrap_or(0);
        reach.steps = LeafReach::box_of([first; 3], [last; 3]).collect();
        let is_reached = |kind: usize, step: IVec3| {
            let along = [kind / 9, kind / 3 % 3, kind % 3].map(|along| ranges[along]);
            (0..3).all(|axis| (along[axis].0..=along[axis].1).contains(&step[axis]))
        };
        let bits = |kind: usize| {
            let mut words = vec![0u64; reach.steps.len().div_ceil(64)];
            for (number, _) in reach.steps.iter().enumerate().filter(|(_, step)| is_reached(kind, **step)) {
                words[number / 64] |= 1 << (number % 64);
            }
            words
        };
        reach.of_kind = (0..27).map(bits).collect();
        reach
    }

    /// Which of the 27 position classes contains `local`.
    fn kind(&self, local: Vec3) -> u32 {
        let along = |x: f32| u32::from(x >= self.ends[0]) + u32::from(x >= self.ends[1]);
        along(local.x) * 9 + along(local.y) * 3 + along(local.z)
    }

    /// First and last leaf within reach of a position class, along one axis.
    fn range(&self, kind: u32) -> (i32, i32) {
        let edge = LEAF_EDGE as f32;
        let middle = match kind {
            0 => 0.5 * self.ends[0],
            1 => 0.5 * (self.ends[0] + self.ends[1]),
            _ => 0.5 * (self.ends[1] + edge),
        };
        (((middle - self.voxels) / edge).floor() as i32, ((middle + self.voxels) / edge).floor() as i32)
    }

    /// The leaves within reach of the position classes that occur in these leaves. If there are more than
    /// `most`, only some of them, but more than `most`.
    fn leaves(&self, origins: &[IVec3], leaves: &[FootprintLeaf], most: usize) -> FxHashSet<IVec3> {
        let reached = |(origins, leaves): (&[IVec3], &[FootprintLeaf])| {
            let mut reached = FxHashSet::default();
            for (&origin, leaf) in origins.iter().zip(leaves) {
                for (index, steps) in self.steps.chunks(64).enumerate() {
                    let kinds = (0..27).filter(|kind| leaf.near >> kind & 1 == 1);
                    let bits = kinds.fold(0, |bits, kind| bits | self.of_kind[kind][index]);
                    let steps = steps.iter().enumerate().filter(|(number, _)| bits >> number & 1 == 1);
                    reached.extend(steps.map(|(_, step)| origin + step * LEAF_EDGE));
                }
            }
            reached
        };
        let per_set = (SET_LEAVES_MAX / self.steps.len()).clamp(1, LEAVES_PER_SET);
        let mut all = FxHashSet::default();
        let several = origins.chunks(SET_COUNT * per_set).zip(leaves.chunks(SET_COUNT * per_set));
        for (origins, leaves) in several {
            let sets = origins.par_chunks(per_set).zip(leaves.par_chunks(per_set));
            all.par_extend(sets.with_max_len(1).halved().map(reached).flat_map_iter(FxHashSet::into_iter));
            if all.len() > most {
                break;
            }
        }
        all
    }

    /// All steps of a box.
    fn box_of(first: [i32; 3], last: [i32; 3]) -> impl Iterator<Item = IVec3> {
        let axis = move |axis: usize| first[axis]..=last[axis];
        axis(0).flat_map(move |x| axis(1).flat_map(move |y| axis(2).map(move |z| IVec3::new(x, y, z))))
    }
}

/// A leaf divided into cells so small that a cell with a particle is filled by it or by the particles around.
struct LeafCells {
    /// Cells along an edge.
    count: u32,
    /// Mask of all cells.
    all: u64,
}

impl LeafCells {
    fn new(radius: f32) -> LeafCells {
        let count =
            [4, 2].into_iter().find(|&count| LEAF_EDGE as f32 / count as f32 >= 1.5 * radius).unwrap_or(1);
        LeafCells { count, all: u64::MAX >> (64 - count.pow(3)) }
    }

    /// Bit index of the cell that contains `local`.
    fn cell(&self, local: Vec3) -> u32 {
        let along = |x: f32| ((x * self.count as f32 / LEAF_EDGE as f32) as u32).min(self.count - 1);
        self.bit([local.x, local.y, local.z].map(along))
    }

    fn bit(&self, [x, y, z]: [u32; 3]) -> u32 {
        (x * self.count + y) * self.count + z
    }

    /// Area between the cells of a leaf that contain a particle and those that do not, in voxel faces.
    /// `beyond` are the cells of the leaves beyond its faces, in the order of [`Topology::neighbors`].
    fn open_area(&self, own: u64, beyond: [u64; 6]) -> usize {
        let last = |face: usize| if face & 1 == 0 { 0 } else { self.count - 1 };
        let face_counts = (0..6).map(|face| self.open_faces(own, beyond[face], face / 2, last(face)));
        let edge_voxels = LEAF_EDGE as usize / self.count as usize;
        face_counts.sum::<usize>() * edge_voxels * edge_voxels
    }

    /// Number of cell faces in one direction that have a particle in the cell behind and none in the cell in
    /// front. `last` is the layer of cells at the leaf's boundary in this direction. The cells in front of
    /// that layer are in the next leaf, `beyond`.
    fn open_faces(&self, own: u64, beyond: u64, axis: usize, last: u32) -> usize {
        let first = self.count - 1 - last;
        let is_open = |cell: u32| {
            let coords = [cell / self.count.pow(2), cell / self.count % self.count, cell % self.count];
            let mut next = coords;
            let (leaf, along) = match coords[axis] {
                along if along == last => (beyond, first),
                along if last == 0 => (own, along - 1),
                along => (own, along + 1),
            };
            next[axis] = along;
            own >> cell & 1 == 1 && leaf >> self.bit(next) & 1 == 0
        };
        (0..self.count.pow(3)).filter(|&cell| is_open(cell)).count()
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::obstacle::{MeshSdf, Obstacle, ObstacleSdf, Obstacles};
    use crate::particles::{OwnedPositions, erased};
    use crate::rasterize::{Radii, rasterize};
    use crate::space::Lattice;

    const RADII: Radii = Radii::uniform(1.732, 2.598, 3.464);
    const LATTICE: Lattice = Lattice { voxel_size: 1.0 };

    /// Particles with an average spacing of two voxels in a box of `counts` particles, each jittered by up to
    /// a voxel; keeps only one in `every`.
    fn scattered(counts: [usize; 3], every: usize) -> OwnedPositions {
        let moved = |seed: usize| ((seed as u32).wrapping_mul(0x9e37_79b9) >> 8) as f32 / (1 << 24) as f32;
        let particle = |index: usize| {
            let steps = [index / counts[2] / counts[1], index / counts[2] % counts[1], index % counts[2]];
            [0, 1, 2].map(|axis| 2.0 * steps[axis] as f32 + moved(3 * index + axis))
        };
        let indices = (0..counts.iter().product()).filter(|&index| moved(7 * index) * (every as f32) < 1.0);
        OwnedPositions::F32(indices.map(particle).collect())
    }

    #[test]
    fn footprint_estimates_leaves_and_particles() {
        let scenes = [([40, 40, 40], 1), ([100, 100, 2], 1), ([40, 40, 40], 8), ([60, 60, 60], 60)];
        for (counts, every) in scenes {
            let particles = scattered(counts, every);
            let Ok(Footprint { surface, near_particle_count, .. }) = erased(&particles, |source| {
                footprint(source, &RasterParams::open(LATTICE, RADII), None, usize::MAX)
            });
            let Ok(rasterized) = rasterize(&particles, &RasterParams::open(LATTICE, RADII));
            let (found, real) = (surface.len(), rasterized.band.topology.len());
            let ratio = found as f64 / real as f64;
            assert!((1.0..1.7).contains(&ratio), "{found} leaves for {real} in {counts:?} / {every}");
            let ratio = near_particle_count as f64 / rasterized.bins.len() as f64;
            assert!((0.7..1.5).contains(&ratio), "{ratio:.2} of the particles in {counts:?} / {every}");
        }
    }

    /// Around an obstacle, leaves deep in the fluid are stored.
    #[test]
    fn footprint_includes_leaves_around_obstacles() {
        let particles = scattered([40, 40, 40], 1);
        let octahedron = |radius: f64| {
            let corners = [0, 1, 2, 3, 4, 5].map(|corner| {
                let mut point = [40.0; 3];
                point[corner / 2] += if corner % 2 == 0 { radius } else { -radius };
                point
            });
            let faces =
                [[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]];
            let shape = ObstacleSdf::Mesh(MeshSdf::new(&corners, &faces));
            Obstacles { members: vec![Arc::new(Obstacle::new(shape, 1 << 24))] }
        };
        for radius in [10.0, 25.0] {
            let obstacles = octahedron(radius);
            let scene = RasterParams { obstacles: &obstacles, ..RasterParams::open(LATTICE, RADII) };
            let Ok(Footprint { surface, .. }) =
                erased(&particles, |source| footprint(source, &scene, None, usize::MAX));
            let Ok(rasterized) = rasterize(&particles, &scene);
            let ratio = surface.len() as f64 / rasterized.band.topology.len() as f64;
            assert!((1.0..1.7).contains(&ratio), "{ratio:.2} times the leaves around {radius}");
        }
    }

    /// The memory for counting is limited: see `plan_memory`.
    #[test]
    fn counting_stops_at_its_limit() {
        let particles = scattered([60, 60, 60], 60);
        let count = |most: usize| {
            let Ok(footprint) = erased(&particles, |source| {
                footprint(source, &RasterParams::open(LATTICE, RADII), None, most)
            });
            (footprint.is_partial, footprint.occupied_count + footprint.surface.len())
        };
        let (_, all) = count(usize::MAX);
        assert_eq!(count(all), (false, all));
        for most in [all / 2, 100, 0] {
            let (is_partial, found) = count(most);
            assert!(is_partial && most < found && found <= all, "{found} of {all}");
        }
    }

    #[test]
    fn footprint_area_counts_open_cell_faces() {
        // A block that fills 3 × 3 × 3 leaves, and an isolated particle in a cell of 4 voxels.
        let Ok(block) = erased(&scattered([12, 12, 12], 1), |source| {
            footprint(source, &RasterParams::open(LATTICE, RADII), None, usize::MAX)
        });
        assert_eq!(block.area_voxels, 6 * 24 * 24);
        let Ok(particle) = erased(&OwnedPositions::F32(vec![[100.5; 3]]), |source| {
            footprint(source, &RasterParams::open(LATTICE, RADII), None, usize::MAX)
        });
        assert_eq!(particle.area_voxels, 6 * 4 * 4);
        let Ok(nothing) = erased(&OwnedPositions::F32(vec![[f32::NAN; 3]]), |source| {
            footprint(source, &RasterParams::open(LATTICE, RADII), None, usize::MAX)
        });
        assert_eq!(nothing, Footprint { dropped_count: 1, ..Footprint::default() });
    }
}
