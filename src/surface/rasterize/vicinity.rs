//! Which particles are near places that no particle covers. The others do not show, wherever neighbours would move them.
//!
//! ```text
//!   · · · · · · · · ·      ·  uncovered: a voxel without a particle that is surely within r_init
//!   v v v v v v v v v  ┐
//!   v v v v v v v v v  ┘   depth          v  vicinity: cells with such a voxel within a depth
//!   d d d d d d d d d      d  deep: particles here stay as they are
//! ```
//!
//! Whether a particle is in the vicinity depends on the octants within the depth and r_init, axis by axis, and on the longest
//! particle of its leaf, and on nothing else. Neither windows nor batches matter.

use glam::{DVec3, IVec3};
use rayon::prelude::*;
use rustc_hash::FxHashSet;

use super::batch::Placed;
use super::bin::cell_of;
use super::cover::{Ball, Cover};
use super::need::{Uncovered, leaves_of_boxes};
use super::occupancy::{Occupancy, Octants};
use super::region::meet;
use crate::surface::grid::{LEAF_EDGE, LEAF_VOXELS, LeafMask, NO_LEAF};
use crate::surface::particles::{ParticleSource, Positions, Shapes};
use crate::surface::simd;
use crate::surface::space::{CoordBox, Lattice};

/// The cells near what particles leave uncovered.
pub struct Vicinity {
    occupancy: Occupancy,
    /// For each leaf of the occupancy the cells in the vicinity.
    cells: Vec<LeafMask>,
    /// The cells within [`margin`](Self::margin) of these, on every axis, and these.
    around: Vec<LeafMask>,
    margin: i32,
}

/// Leaves of the vicinity whose particles are shaped together, and what these need.
pub struct Block {
    own: FxHashSet<IVec3>,
    /// Their leaves, and all within a margin.
    gathered: FxHashSet<IVec3>,
    voxels: CoordBox,
}

/// The particles of a block, in the order of the source.
#[derive(Default)]
pub struct Gathered {
    /// Batch and place in the batch of each.
    pub sources: Vec<[u32; 2]>,
    /// World units, in 64 bits.
    pub positions: Vec<[f64; 3]>,
    /// Whether it is in the block's own part of the vicinity.
    pub is_own: Vec<bool>,
    /// Scales, where particles are balls of sizes of their own.
    pub scales: Vec<f32>,
}

impl Default for Block {
    fn default() -> Block {
        Block { own: FxHashSet::default(), gathered: FxHashSet::default(), voxels: CoordBox::EMPTY }
    }
}

impl Vicinity {
    /// The cells near voxels without a particle that is surely within `cover_radius`. `depth_of` maps the longest half axis
    /// of the particles of a leaf, in units of the radii, to how near these are. Particles within `margin` of these, on every
    /// axis, are [gathered](Self::gather) with them. All in voxels.
    ///
    /// # Errors
    /// Those of the source.
    pub fn new<S: ParticleSource>(
        source: &S,
        lattice: &Lattice,
        cover_radius: f32,
        depth_of: impl Fn(f32) -> f32,
        margin: i32,
    ) -> Result<Vicinity, S::Error> {
        let occupancy = Occupancy::new(source, lattice)?;
        let leaves = &occupancy.topology;
        let ball = Ball::new(cover_radius);
        let neighborhoods: Vec<[u32; 27]> =
            (0..leaves.len()).into_par_iter().map(|leaf| leaves.neighborhood(leaf)).collect();
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
        let mut deep: Vec<LeafMask> = neighborhoods.par_iter().map(covered).collect();
        drop(octants);
        // Leaves of long particles need more depth; each takes its own of a few.
        let class_of = |longest: f32| longest.max(1.0).log2().ceil() as u32;
        let longest: Vec<u32> =
            leaves.origins().iter().map(|&origin| class_of(occupancy.longest_of(origin))).collect();
        let class_max = longest.iter().copied().max().unwrap_or(0);
        let mut cells = vec![LeafMask::EMPTY; leaves.len()];
        let mut depth = 0.0;
        for class in 0..=class_max {
            let wanted = depth_of(2f32.powi(class as i32));
            deep = shrunk_by_ball(&neighborhoods, deep, wanted - depth);
            depth = depth.max(wanted);
            let of_class = cells.par_iter_mut().zip(&deep).zip(&longest).filter(|(_, of)| **of == class);
            of_class.for_each(|((cells, deep), _)| *cells = deep.complement());
        }
        drop(deep);
        let beyond: Vec<LeafMask> = cells.par_iter().map(LeafMask::complement).collect();
        let mut around = shrunk(&neighborhoods, beyond, margin);
        around.par_iter_mut().for_each(|mask| *mask = mask.complement());
        Ok(Vicinity { occupancy, cells, around, margin })
    }

    /// The longest half axis of any particle, in units of the radii.
    pub fn longest(&self) -> f32 {
        self.occupancy.longest()
    }

    /// Parts of the vicinity, each with all particles within the margin: no more than about `particles_max`, but for a leaf
    /// that has more. They follow the source as far as that is sorted.
    pub fn blocks(&self, particles_max: usize) -> Vec<Block> {
        let margin = self.margin;
        let leaves = &self.occupancy.topology;
        let count_of = |origin: IVec3| self.occupancy.count_of(origin).unwrap_or((0, 0));
        let mut near: Vec<usize> =
            (0..leaves.len()).filter(|&leaf| self.cells[leaf] != LeafMask::EMPTY).collect();
        // Leaves are in an order in which neighbours are near: it is kept where batches do not matter.
        near.sort_by_cached_key(|&leaf| count_of(leaves.origins()[leaf]).1);
        let around = |&leaf: &usize| {
            let voxels = self.cells[leaf].bounding_box().expanded(margin);
            leaves_of_boxes(&[(leaves.origins()[leaf], voxels)], |origin| leaves.find(origin).is_some())
        };
        let mut blocks: Vec<Block> = Vec::new();
        let mut count = usize::MAX;
        let across = (2 * margin.max(0) as usize).div_ceil(LEAF_EDGE as usize) + 2;
        for near in near.chunks((LISTED_MAX / across.pow(3)).max(1)) {
            let all_around: Vec<Vec<IVec3>> = near.par_iter().map(around).collect();
            for (&leaf, around) in near.iter().zip(all_around) {
                if count >= particles_max {
                    blocks.push(Block::default());
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

    /// About how many particles of a leaf are gathered: all of a crowd, which may be in any of its cells.
    fn gathered_count(&self, origin: IVec3) -> usize {
        let (count, _) = self.occupancy.count_of(origin).unwrap_or((0, 0));
        let leaf = self.occupancy.topology.find(origin);
        match leaf.map(|leaf| self.around[leaf].count() as usize) {
            Some(cells) if count <= CROWD_MIN => count * cells / LEAF_VOXELS,
            _ => count,
        }
    }

    /// The particles of a block.
    ///
    /// # Errors
    /// Those of the source.
    pub fn gather<S: ParticleSource>(
        &self,
        block: &Block,
        source: &S,
        lattice: &Lattice,
    ) -> Result<Gathered, S::Error> {
        let of_batch = |index: usize| -> Result<Gathered, S::Error> {
            if !meet(&self.occupancy.batches[index].voxels, &block.voxels) {
                return Ok(Gathered::default());
            }
            let positions = source.batch(index)?;
            let placed = Placed::new(&positions, lattice);
            let mut places: Vec<(u32, bool)> = Vec::new();
            for (origin, run) in placed.runs().filter(|(origin, _)| block.gathered.contains(origin)) {
                let Some(leaf) = self.occupancy.topology.find(origin) else { continue };
                let own = if block.own.contains(&origin) { &self.cells[leaf] } else { &LeafMask::EMPTY };
                let of_cells = run.clone().zip(placed.locals[run].iter().map(|local| cell_of(*local)));
                let near = of_cells.filter(|(_, cell)| self.around[leaf].contains(*cell));
                places.extend(near.map(|(place, cell)| (place as u32, own.contains(cell))));
            }
            let scales = match source.shapes_of(index) {
                Shapes::Scaled(scales) => places.iter().map(|&(place, _)| scales[place as usize]).collect(),
                Shapes::Balls | Shapes::Ellipsoids(_) => Vec::new(),
            };
            Ok(Gathered {
                sources: places.iter().map(|&(place, _)| [index as u32, place]).collect(),
                positions: places.iter().map(|&(place, _)| in_world(&positions, place)).collect(),
                is_own: places.iter().map(|&(_, is_own)| is_own).collect(),
                scales,
            })
        };
        let mut all = Gathered::default();
        // Some at a time: what is in small blocks of memory for a while stays with the process.
        let batch_count = source.batch_count();
        for first in (0..batch_count).step_by(BATCHES_AT_ONCE) {
            let batches = first..batch_count.min(first + BATCHES_AT_ONCE);
            for batch in batches.into_par_iter().map(of_batch).collect::<Result<Vec<_>, _>>()? {
                all.sources.extend(batch.sources);
                all.positions.extend(batch.positions);
                all.is_own.extend(batch.is_own);
                all.scales.extend(batch.scales);
            }
        }
        Ok(all)
    }
}

fn in_world(positions: &Positions, place: u32) -> [f64; 3] {
    let position: DVec3 = positions.position(place as usize);
    position.to_array()
}

/// Leaves that are listed at a time, of the surroundings of all: 25 megabytes.
const LISTED_MAX: usize = 1 << 21;

/// Batches that are read side by side: several for each of many threads.
const BATCHES_AT_ONCE: usize = 256;

/// A leaf with more particles than this may have most of them in a few cells.
const CROWD_MIN: usize = 8 * LEAF_VOXELS;

/// Voxels by which what is deep shrinks at a time: what is around a cell is within a leaf of it.
const STEP_MAX: i32 = 7;

/// The cells of each leaf from which nothing can be seen that is not deep: from `around` voxels before the cell to
/// `around` after it, on each axis.
fn shrunk(neighborhoods: &[[u32; 27]], mut deep: Vec<LeafMask>, mut around: i32) -> Vec<LeafMask> {
    while around > 0 {
        let step = around.min(STEP_MAX);
        deep = each(neighborhoods, |leaves| {
            let covers = leaves.map(|leaf| mask_of(&deep, leaf));
            simd::dispatch(Uncovered { covers, around: step }).complement()
        });
        around -= step;
    }
    deep
}

/// The cells of each leaf without anything nearer than `radius`, in voxels, that is not deep.
///
/// A cube and as many octahedra as are wanted are added up to a body that holds a ball of the radius, and little else:
/// it is that wide in the directions of the axes, and in between by what the least cube adds. A cube alone would hold
/// half as much again of what is near a plane surface.
fn shrunk_by_ball(neighborhoods: &[[u32; 27]], deep: Vec<LeafMask>, radius: f32) -> Vec<LeafMask> {
    let whole = radius.ceil();
    // How far the body reaches toward an edge of the cube, and toward a corner.
    let holds_ball = |cube: f32| {
        let octahedra = whole - cube;
        let edge = (2.0 * cube + octahedra) / 2f32.sqrt();
        edge.min((3.0 * cube + octahedra) / 3f32.sqrt()) >= radius
    };
    // A cell is seen from its corners: that takes a cube, if only a small one.
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
    neighborhoods.par_iter().map(of_leaf).collect()
}

fn mask_of(masks: &[LeafMask], leaf: u32) -> &LeafMask {
    if leaf == NO_LEAF { &LeafMask::EMPTY } else { &masks[leaf as usize] }
}

/// Places of a leaf itself and of those at its faces in a [neighbourhood](crate::surface::grid::Topology::neighborhood).
const CENTER: usize = 13;
const FACES: [usize; 6] = [4, 22, 10, 16, 12, 14];
