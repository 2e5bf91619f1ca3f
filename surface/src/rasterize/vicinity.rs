//! Finds the particles near voxels that no particle covers. The other particles do not affect the surface,
//! wherever their neighbors move them.
//!
//! ```text
//!   · · · · · · · · ·      ·  uncovered: a voxel that is not certainly within r_init of a particle
//!   v v v v v v v v v  ┐
//!   v v v v v v v v v  ┘   depth          v  vicinity: cells within this depth of an uncovered voxel
//!   d d d d d d d d d      d  deep: particles here are left unchanged
//! ```
//!
//! Each voxel has eight octants, and a particle covers voxels by the octant that it is in. Whether a particle is in the
//! vicinity depends only on the occupied octants within the depth plus r_init of it (and a few voxels of rounding) on
//! each axis, and on the longest particle of its leaf. It does not depend on windows or batches.

use glam::{DVec3, IVec3};
use rayon::prelude::*;
use rustc_hash::FxHashSet;

use super::bin::{LeafCoords, cell_of};
use super::culling::{Cover, OctantBall, Uncovered, for_each_leaf_around};
use super::meet;
use super::occupancy::{Occupancy, Octants};
use crate::grid::{LEAF_EDGE, LEAF_VOXELS, LeafMask, NO_LEAF};
use crate::parallel::Loops as _;
use crate::particles::{AnySource, Positions, Shapes, Unread};
use crate::simd;
use crate::space::{CoordBox, Lattice};

/// The cells near uncovered voxels.
pub struct Vicinity {
    occupancy: Occupancy,
    /// For each leaf of the occupancy, the cells in the vicinity.
    cells: Vec<LeafMask>,
    /// The same cells and all within [`margin`](Self::margin) of them, per axis.
    around: Vec<LeafMask>,
    margin: i32,
}

/// Leaves of the vicinity whose particles are processed together, with the leaves they depend on.
pub struct GatherBlock {
    own: FxHashSet<IVec3>,
    /// The leaves in `own`, and all leaves within the margin of their cells in the vicinity.
    gathered: FxHashSet<IVec3>,
    voxels: CoordBox,
}

/// The particles of a block, in source order.
#[derive(Default)]
pub struct Gathered {
    /// Batch, and index in the batch, of each particle.
    pub sources: Vec<[u32; 2]>,
    /// World units, 64 bits.
    pub positions: Vec<[f64; 3]>,
    /// True if the particle is in the block's own part of the vicinity.
    pub is_own: Vec<bool>,
    /// Scales, if particles are balls of different sizes.
    pub scales: Vec<f32>,
}

impl Default for GatherBlock {
    fn default() -> GatherBlock {
        GatherBlock { own: FxHashSet::default(), gathered: FxHashSet::default(), voxels: CoordBox::EMPTY }
    }
}

impl Vicinity {
    /// Finds the cells near voxels that are not certainly within `cover_radius` of a particle. `depth_of`
    /// maps the longest semi-axis of a leaf's particles, in units of the radii, to the depth of the vicinity
    /// there. Particles within `margin` of the vicinity, per axis, are [gathered](Self::gather) with it. All
    /// lengths are in voxels.
    ///
    /// # Errors
    /// Returns the source's error if a batch cannot be read.
    pub fn new(
        source: &AnySource<'_>,
        lattice: &Lattice,
        cover_radius: f32,
        depth_of: impl Fn(f32) -> f32,
        margin: i32,
    ) -> Result<Vicinity, Unread> {
        let occupancy = Occupancy::new(source, lattice)?;
        let leaves = &occupancy.topology;
        let ball = OctantBall::new(cover_radius);
        let neighborhoods: Vec<[u32; 27]> =
            (0..leaves.len()).into_par_iter().halved().map(|leaf| leaves.neighborhood(leaf)).collect();
        let octants: Vec<&Octants> = leaves
            .origins()
            .iter()
            .map(|&origin| occupancy.octants_of(origin).unwrap_or(&Octants::EMPTY))
            .collect();
        let covered = |around: &[u32; 27]| {
            let around = around.map(|leaf| octants.get(leaf as usize).copied().unwrap_or(&Octants::EMPTY));
            let [covered] = simd::dispatch(Cover { around, balls: [&ball] });
            covered
        };
        let mut deep: Vec<LeafMask> = neighborhoods.par_iter().halved().map(covered).collect();
        drop(octants);
        // Leaves with long particles need more depth. The longest semi-axis is rounded up to a power of two.
        let class_of = |longest: f32| longest.max(1.0).log2().ceil() as u32;
        let classes: Vec<u32> =
            leaves.origins().iter().map(|&origin| class_of(occupancy.longest_of(origin))).collect();
        let class_max = classes.iter().copied().max().unwrap_or(0);
        let mut cells = vec![LeafMask::EMPTY; leaves.len()];
        let mut depth = 0.0;
        for class in 0..=class_max {
            let wanted = depth_of(2f32.powi(class as i32));
            deep = shrunk_by_ball(&neighborhoods, deep, wanted - depth);
            depth = depth.max(wanted);
            let of_class =
                cells.par_iter_mut().zip(&deep).zip(&classes).halved().filter(|(_, of)| **of == class);
            of_class.for_each(|((cells, deep), _)| *cells = deep.complement());
        }
        drop(deep);
        let beyond: Vec<LeafMask> = cells.par_iter().halved().map(LeafMask::complement).collect();
        let mut around = shrunk(&neighborhoods, beyond, margin);
        around.par_iter_mut().halved().for_each(|mask| *mask = mask.complement());
        Ok(Vicinity { occupancy, cells, around, margin })
    }

    /// Longest semi-axis of all particles, in units of the radii.
    pub fn longest(&self) -> f32 {
        self.occupancy.longest()
    }

    /// Splits the vicinity into blocks that gather about `particles_max` particles each, or more if a single
    /// leaf has more. Blocks follow the order of the source if that is spatially sorted.
    pub fn blocks(&self, particles_max: usize) -> Vec<GatherBlock> {
        let margin = self.margin;
        let leaves = &self.occupancy.topology;
        let count_of = |origin: IVec3| self.occupancy.count_of(origin).unwrap_or((0, 0));
        let mut near: Vec<usize> =
            (0..leaves.len()).filter(|&leaf| self.cells[leaf] != LeafMask::EMPTY).collect();
        // The topology's order keeps neighbors together; the stable sort preserves it among leaves with the
        // same first batch.
        near.sort_by_cached_key(|&leaf| count_of(leaves.origins()[leaf]).1);
        let around = |&leaf: &usize| {
            let voxels = self.cells[leaf].bounding_box().expanded(margin);
            let mut around = Vec::new();
            for_each_leaf_around(&[(leaves.origins()[leaf], voxels)], 0, |origin| {
                around.extend(leaves.find(origin).map(|_| origin));
            });
            around
        };
        let mut blocks: Vec<GatherBlock> = Vec::new();
        // Full, so that the first leaf begins a block.
        let mut count = usize::MAX;
        // The most leaves along an axis that the cells of one leaf and the margin around them can meet.
        let across_max = (2 * margin.max(0) as usize).div_ceil(LEAF_EDGE as usize) + 2;
        for chunk in near.chunks((LISTED_MAX / across_max.pow(3)).max(1)) {
            let all_around: Vec<Vec<IVec3>> = chunk.par_iter().halved().map(around).collect();
            for (&leaf, around) in chunk.iter().zip(all_around) {
                if count >= particles_max {
                    blocks.push(GatherBlock::default());
                    count = 0;
                }
                let Some(block) = blocks.last_mut() else { continue };
                block.own.insert(leaves.origins()[leaf]);
                for origin in around.into_iter().filter(|&origin| block.gathered.insert(origin)) {
                    count += self.gathered_count(origin);
                    block.voxels.include(origin);
                    block.voxels.include(origin + IVec3::splat(LEAF_EDGE - 1));
                }
            }
        }
        blocks
    }

    /// Approximate number of a leaf's particles that are gathered. If the leaf is crowded, this is the number
    /// of all its particles, because most of them may be in one of the gathered cells.
    fn gathered_count(&self, origin: IVec3) -> usize {
        let (count, _) = self.occupancy.count_of(origin).unwrap_or((0, 0));
        let leaf = self.occupancy.topology.find(origin);
        match leaf.map(|leaf| self.around[leaf].count() as usize) {
            Some(cells) if count <= CROWD_MIN => count * cells / LEAF_VOXELS,
            _ => count,
        }
    }

    /// Reads the particles of a block.
    ///
    /// # Errors
    /// Returns the source's error if a batch cannot be read.
    pub fn gather(
        &self,
        block: &GatherBlock,
        source: &AnySource<'_>,
        lattice: &Lattice,
    ) -> Result<Gathered, Unread> {
        let of_batch = |index: usize| -> Result<Gathered, Unread> {
            if !meet(&self.occupancy.batches[index].voxels, &block.voxels) {
                return Ok(Gathered::default());
            }
            let positions = source.batch(index)?;
            let placed = LeafCoords::new(&positions, lattice);
            let mut selected: Vec<(u32, bool)> = Vec::new();
            for (origin, run) in placed.runs().filter(|(origin, _)| block.gathered.contains(origin)) {
                let Some(leaf) = self.occupancy.topology.find(origin) else { continue };
                let own = if block.own.contains(&origin) { &self.cells[leaf] } else { &LeafMask::EMPTY };
                let of_cells = run.clone().zip(placed.locals[run].iter().map(|local| cell_of(*local)));
                let near = of_cells.filter(|(_, cell)| self.around[leaf].contains(*cell));
                selected.extend(near.map(|(particle, cell)| (particle as u32, own.contains(cell))));
            }
            let scales = match source.batch_shapes(index) {
                Shapes::Scaled(scales) => {
                    selected.iter().map(|&(particle, _)| scales[particle as usize]).collect()
                }
                Shapes::Ellipsoids(ellipsoids) => selected
                    .iter()
                    .map(|&(particle, _)| ellipsoids[particle as usize].ball_radius())
                    .collect(),
                Shapes::Uniform => Vec::new(),
            };
            Ok(Gathered {
                sources: selected.iter().map(|&(particle, _)| [index as u32, particle]).collect(),
                positions: selected.iter().map(|&(particle, _)| in_world(&positions, particle)).collect(),
                is_own: selected.iter().map(|&(_, is_own)| is_own).collect(),
                scales,
            })
        };
        let mut all = Gathered::default();
        // Limits the number of batches at a time: many small allocations would not be returned to the system.
        let batch_count = source.batch_count();
        for first in (0..batch_count).step_by(BATCHES_AT_ONCE) {
            let batches = first..batch_count.min(first + BATCHES_AT_ONCE);
            for batch in batches.into_par_iter().halved().map(of_batch).collect::<Result<Vec<_>, _>>()? {
                all.sources.extend(batch.sources);
                all.positions.extend(batch.positions);
                all.is_own.extend(batch.is_own);
                all.scales.extend(batch.scales);
            }
        }
        Ok(all)
    }
}

fn in_world(positions: &Positions, particle: u32) -> [f64; 3] {
    let position: DVec3 = positions.position(particle as usize);
    position.to_array()
}

/// Maximum number of leaf origins in the lists of leaves around the leaves of a chunk: 25 MB.
const LISTED_MAX: usize = 1 << 21;

/// Number of batches read in parallel: several for each of many threads.
const BATCHES_AT_ONCE: usize = 256;

/// In a leaf with more particles than this, most of them may be in a few cells.
const CROWD_MIN: usize = 8 * LEAF_VOXELS;

/// Maximum erosion per step, in voxels: the search box of a cell must lie within the adjacent leaves.
const STEP_MAX: i32 = 7;

/// Erodes by a cube: keeps the cells of each leaf whose search box, from `distance` voxels before to `distance`
/// voxels after the cell on each axis, is entirely deep.
fn shrunk(neighborhoods: &[[u32; 27]], mut deep: Vec<LeafMask>, mut distance: i32) -> Vec<LeafMask> {
    while distance > 0 {
        let step = distance.min(STEP_MAX);
        deep = each(neighborhoods, |leaves| {
            let covers = leaves.map(|leaf| mask_of(&deep, leaf));
            simd::dispatch(Uncovered { covers, around: step }).complement()
        });
        distance -= step;
    }
    deep
}

/// Erodes by a ball: keeps the cells with only deep cells within `radius` voxels.
///
/// The structuring element is the sum of a cube and octahedra, with the smallest cube for which the sum
/// contains the ball. Along the axes it is as long as the ball, and in between it exceeds the ball a little.
/// With a cube alone, the vicinity of a plane surface would have 1.5 times as many cells.
fn shrunk_by_ball(neighborhoods: &[[u32; 27]], deep: Vec<LeafMask>, radius: f32) -> Vec<LeafMask> {
    let whole = radius.ceil();
    // How far the element reaches toward an edge of the cube, and toward a corner.
    let holds_ball = |cube: f32| {
        let octahedra = whole - cube;
        let edge = (2.0 * cube + octahedra) / 2f32.sqrt();
        edge.min((3.0 * cube + octahedra) / 3f32.sqrt()) >= radius
    };
    // The cube has at least 1 voxel: uncovered voxels are corners of cells, and only the erosion by a cube tests all
    // corners of a cell.
    let cube = (1..=whole as i32).find(|cube| holds_ball(*cube as f32)).unwrap_or(whole as i32);
    let mut deep = shrunk(neighborhoods, deep, cube);
    for _ in cube..whole as i32 {
        deep = each(neighborhoods, |leaves| {
            mask_of(&deep, leaves[CENTER]).surrounded(FACES.map(|face| mask_of(&deep, leaves[face])))
        });
    }
    deep
}

fn each(
    neighborhoods: &[[u32; 27]],
    of_leaf: impl Fn(&[u32; 27]) -> LeafMask + Send + Sync,
) -> Vec<LeafMask> {
    neighborhoods.par_iter().halved().map(of_leaf).collect()
}

fn mask_of(masks: &[LeafMask], leaf: u32) -> &LeafMask {
    if leaf == NO_LEAF { &LeafMask::EMPTY } else { &masks[leaf as usize] }
}

/// Indices of the leaf itself and of its face neighbors in a
/// [neighborhood](crate::grid::Topology::neighborhood).
const CENTER: usize = 13;
const FACES: [usize; 6] = [4, 22, 10, 16, 12, 14];
