//! Obstacles: meshes and level sets as signed distances φ_o, leaf by leaf (paper, §3.6).
//!
//! ```text
//!   mesh ────────▶ MeshSdf ─┐ sign by the winding number, distance by a tree of triangles
//!                           ├──▶ φ_o of a leaf, in voxels of the frame, negative inside the obstacle
//!   level set ───▶ GridSdf ─┘ interpolated
//! ```
//!
//! Each leaf is computed independently, relative to its own centre, and in 64 bits where precision matters.
//! So every caller gets the same values: a frame, a tile, or the next frame, for which the leaf is cached.

mod contact;
mod grid_sdf;
mod mesh_sdf;
mod surface;
mod tree;

use std::fmt;
use std::sync::{Arc, Mutex, PoisonError};

use glam::{DVec3, IVec3};
use rayon::prelude::*;
use rustc_hash::FxHashMap;

pub use contact::{
    ContactStats, DepthStats, ROUNDING_MAX, cut_off_at_obstacles, edge_clearance, edge_rounding,
    fill_gaps_at_obstacles,
};
pub use grid_sdf::{GridSdf, SourceLevelSet};
pub use mesh_sdf::{MeshDistance, MeshSdf};
pub use surface::MeshFindings;

use crate::grid::{LEAF_EDGE, Leaf, offset_in_leaf};
use crate::parallel::Loops as _;
use crate::particles::{AnySource, Positions, Unread};
use crate::space::Lattice;
use crate::words::{rounded_down, significant};

/// The geometry of an obstacle.
pub enum ObstacleSdf {
    /// The inside of a mesh.
    Mesh(MeshSdf),
    /// The inside of a level set.
    Grid(Box<GridSdf>),
}

impl ObstacleSdf {
    /// The lower and the upper corner of the bounding box, world units; `None` if the obstacle is empty.
    pub fn bounds(&self) -> Option<[DVec3; 2]> {
        match self {
            ObstacleSdf::Mesh(solid) => solid.bounds(),
            ObstacleSdf::Grid(sampled) => sampled.bounds(),
        }
    }

    /// The point with the largest coordinate, world units.
    fn farthest(&self) -> DVec3 {
        match self {
            ObstacleSdf::Mesh(solid) => solid.farthest(),
            ObstacleSdf::Grid(sampled) => {
                let corners = sampled.bounds().unwrap_or_default();
                let size = |corner: DVec3| corner.abs().max_element();
                if size(corners[0]) > size(corners[1]) { corners[0] } else { corners[1] }
            }
        }
    }

    /// The memory of the geometry, in bytes.
    fn size_bytes(&self) -> usize {
        match self {
            ObstacleSdf::Mesh(solid) => solid.size_bytes(),
            ObstacleSdf::Grid(sampled) => sampled.size_bytes(),
        }
    }
}

/// A body that the fluid must not enter. It caches its distances: share it between frames in an `Arc`.
pub struct Obstacle {
    sdf: ObstacleSdf,
    cache: LeafCache,
}

impl Obstacle {
    /// The inside of a triangle mesh in world units. The mesh may have holes, repeated vertices and triangles
    /// that face the wrong way. Triangles that cannot be part of a surface are left out: see
    /// [`mesh_findings`](Self::mesh_findings). Up to 64 MiB of distances are cached.
    pub fn from_mesh(positions: &[[f64; 3]], triangles: &[[u32; 3]]) -> Obstacle {
        Obstacle::new(ObstacleSdf::Mesh(MeshSdf::new(positions, triangles)), CACHED_BYTES_MAX)
    }

    #[doc(hidden)]
    /// An obstacle with a cache of at most this many bytes for its leaves. A frame requests each leaf more
    /// than once, and if the obstacle is static, the next frame requests the same leaves.
    pub fn new(sdf: ObstacleSdf, cache_bytes_max: usize) -> Obstacle {
        Obstacle { sdf, cache: LeafCache::new(cache_bytes_max) }
    }

    /// Problems of the obstacle's mesh: holes, and triangles that were left out or flipped. `None` for a
    /// level set.
    pub fn mesh_findings(&self) -> Option<&MeshFindings> {
        match &self.sdf {
            ObstacleSdf::Mesh(solid) => Some(solid.findings()),
            ObstacleSdf::Grid(_) => None,
        }
    }

    /// The geometry.
    #[doc(hidden)]
    pub fn sdf(&self) -> &ObstacleSdf {
        &self.sdf
    }

    /// The memory of the obstacle, in bytes.
    pub fn size_bytes(&self) -> usize {
        self.cache.size_bytes() + self.sdf.size_bytes()
    }

    /// The memory of the obstacle once its cache is full, in bytes.
    pub fn size_bytes_max(&self) -> usize {
        self.cache.size_bytes_max().saturating_add(self.sdf.size_bytes())
    }

    #[doc(hidden)]
    /// The signed distances in the leaf with this origin, in voxels, clamped to ± `half_width`.
    pub fn leaf(&self, origin: IVec3, lattice: &Lattice, half_width: f32) -> ObstacleLeaf {
        let compute = || match &self.sdf {
            ObstacleSdf::Mesh(solid) => solid.leaf(origin, lattice, half_width),
            ObstacleSdf::Grid(sampled) => sampled.leaf(origin, lattice, half_width),
        };
        self.cache.get(origin, lattice, half_width, compute)
    }

    #[doc(hidden)]
    /// Whether the obstacle's surface may come within `margin_voxels` of the voxels of the leaf with this
    /// origin. A cheap test without false negatives.
    pub fn touches(&self, origin: IVec3, lattice: &Lattice, margin_voxels: f32) -> bool {
        match &self.sdf {
            ObstacleSdf::Mesh(solid) => solid.touches(origin, lattice, margin_voxels),
            ObstacleSdf::Grid(sampled) => sampled.touches(origin, lattice, margin_voxels),
        }
    }
}

/// Default upper limit of an obstacle's cache of distances, in bytes.
const CACHED_BYTES_MAX: usize = 64 << 20;

/// Obstacles may have coordinates up to this number of voxels: farther away, coordinates of 64 bits round to
/// thousandths of a voxel, and distances computed from them to more.
const FARTHEST_VOXELS: f64 = (1u64 << 42) as f64;

/// Error: an obstacle is too large, or too far from the origin, for the precision of distances.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ObstacleTooFar {
    /// The index of the obstacle.
    pub index: usize,
    /// A vertex of it, or a corner of its level set, world units.
    pub point: DVec3,
    /// The largest coordinate that is allowed with the voxel size of the frame, world units.
    pub limit: f64,
}

impl fmt::Display for ObstacleTooFar {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let [x, y, z] = self.point.to_array().map(significant);
        write!(
            f,
            "the vertex ({x}, {y}, {z}) is too far from the origin: with this voxel size, coordinates of obstacles \
             may be up to {}; remove the vertex, or check the unit of length",
            rounded_down(self.limit)
        )
    }
}

/// All obstacles of a frame.
#[derive(Clone, Default)]
pub struct Obstacles {
    /// The obstacles.
    pub members: Vec<Arc<Obstacle>>,
}

impl Obstacles {
    /// The first obstacle that is too large, or too far from the origin, for the precision of distances in
    /// voxels of this size.
    pub fn too_far(&self, voxel_size: f64) -> Option<ObstacleTooFar> {
        let limit = FARTHEST_VOXELS * voxel_size;
        let points = self.members.iter().map(|obstacle| obstacle.sdf.farthest());
        let is_too_far = |(_, point): &(usize, DVec3)| point.abs().max_element() > limit;
        let (index, point) = points.enumerate().find(is_too_far)?;
        Some(ObstacleTooFar { index, point, limit })
    }

    /// Whether the list is empty.
    pub fn is_empty(&self) -> bool {
        self.members.is_empty()
    }

    /// φ_o of the union of all obstacles in the leaf with this origin: the minimum of their distances.
    pub fn leaf(&self, origin: IVec3, lattice: &Lattice, half_width: f32) -> ObstacleLeaf {
        let leaves = self.members.iter().map(|obstacle| obstacle.leaf(origin, lattice, half_width));
        leaves.fold(ObstacleLeaf::Outside, ObstacleLeaf::union)
    }

    /// Whether the surface of any obstacle may come within `margin_voxels` of the voxels of the leaf with
    /// this origin.
    pub fn touches(&self, origin: IVec3, lattice: &Lattice, margin_voxels: f32) -> bool {
        self.members.iter().any(|obstacle| obstacle.touches(origin, lattice, margin_voxels))
    }
}

// The signed distances of one leaf to an obstacle.

/// φ_o of a leaf: signed distances to obstacles in voxels, negative inside an obstacle.
#[derive(Clone, Debug, PartialEq)]
pub enum ObstacleLeaf {
    /// All voxels are outside, farther from obstacles than the half width.
    Outside,
    /// All voxels are inside, farther from the surface than the half width.
    Inside,
    /// Some voxels are closer; values are clamped to ± the half width.
    Near(Arc<Leaf>),
}

impl ObstacleLeaf {
    /// The leaf with these values, which are within ± `half_width`.
    fn of_values(leaf: Arc<Leaf>, half_width: f32) -> ObstacleLeaf {
        if leaf.values.iter().all(|&value| value >= half_width) {
            ObstacleLeaf::Outside
        } else if leaf.values.iter().all(|&value| value <= -half_width) {
            ObstacleLeaf::Inside
        } else {
            ObstacleLeaf::Near(leaf)
        }
    }

    /// Adds `by` to the distances and clamps them to ± `half_width`. Distances up to `half_width` + |`by`|
    /// must be known.
    pub fn shifted(self, by: f32, half_width: f32) -> ObstacleLeaf {
        match self {
            ObstacleLeaf::Near(mut leaf) if by != 0.0 => {
                for value in &mut Arc::make_mut(&mut leaf).values {
                    *value = (*value + by).clamp(-half_width, half_width);
                }
                ObstacleLeaf::of_values(leaf, half_width)
            }
            unchanged => unchanged,
        }
    }

    /// The union of two obstacles.
    fn union(self, other: ObstacleLeaf) -> ObstacleLeaf {
        match (self, other) {
            (ObstacleLeaf::Outside, other) => other,
            (one, ObstacleLeaf::Outside) => one,
            (ObstacleLeaf::Inside, _) | (_, ObstacleLeaf::Inside) => ObstacleLeaf::Inside,
            (ObstacleLeaf::Near(mut one), ObstacleLeaf::Near(other)) => {
                for (one, other) in Arc::make_mut(&mut one).values.iter_mut().zip(&other.values) {
                    *one = one.min(*other);
                }
                ObstacleLeaf::Near(one)
            }
        }
    }

    /// The memory of the leaf, in bytes.
    fn size_bytes(&self) -> usize {
        size_of::<ObstacleLeaf>() + if matches!(self, ObstacleLeaf::Near(_)) { size_of::<Leaf>() } else { 0 }
    }
}

// A cache of leaves: a frame requests the same leaf in more than one stage, and if an obstacle is static the
// next frame requests it again.
//
// A cached leaf equals the recomputed one, so the cache does not change results. A shard is cleared when it
// would exceed its memory limit.

/// The cache, in shards with one lock each.
struct LeafCache {
    shards: [Mutex<CacheShard>; SHARDS],
    /// Memory limit of a shard, in bytes.
    shard_bytes_max: usize,
}

#[derive(Default)]
struct CacheShard {
    leaves: FxHashMap<CacheKey, ObstacleLeaf>,
    size_bytes: usize,
}

/// Origin of the leaf, and voxel size and half width as bits.
type CacheKey = (IVec3, u64, u32);

/// Number of shards: with more threads than this, some may wait for each other.
const SHARDS: usize = 16;

/// Estimated memory of a map entry besides the leaf, with spare capacity.
const ENTRY_BYTES: usize = 64;

impl LeafCache {
    fn new(shard_bytes_max: usize) -> LeafCache {
        LeafCache {
            shards: std::array::from_fn(|_| Mutex::default()),
            shard_bytes_max: shard_bytes_max / SHARDS,
        }
    }

    /// Returns the cached leaf, or computes and caches it.
    fn get(
        &self,
        origin: IVec3,
        lattice: &Lattice,
        half_width: f32,
        compute: impl FnOnce() -> ObstacleLeaf,
    ) -> ObstacleLeaf {
        let key = (origin, lattice.voxel_size.to_bits(), half_width.to_bits());
        let hash = (origin.x >> 3) ^ (origin.y >> 4) ^ (origin.z >> 5) ^ (origin.z >> 3);
        let shard = &self.shards[hash.rem_euclid(SHARDS as i32) as usize];
        if let Some(leaf) = shard.lock().unwrap_or_else(PoisonError::into_inner).leaves.get(&key) {
            return leaf.clone();
        }
        let leaf = compute();
        let size = leaf.size_bytes() + ENTRY_BYTES;
        if size <= self.shard_bytes_max {
            let mut shard = shard.lock().unwrap_or_else(PoisonError::into_inner);
            if shard.size_bytes + size > self.shard_bytes_max {
                *shard = CacheShard::default();
            }
            // Another thread may have inserted the leaf first.
            if shard.leaves.insert(key, leaf.clone()).is_none() {
                shard.size_bytes += size;
            }
        }
        leaf
    }

    /// The memory of the cache, in bytes.
    fn size_bytes(&self) -> usize {
        let size =
            |shard: &Mutex<CacheShard>| shard.lock().unwrap_or_else(PoisonError::into_inner).size_bytes;
        self.shards.iter().map(size).sum()
    }
    /// Upper limit of the memory of the cache, in bytes.
    fn size_bytes_max(&self) -> usize {
        self.shard_bytes_max.saturating_mul(SHARDS)
    }
}

// Counts particles inside obstacles, where a simulation should have none.

impl Obstacles {
    /// Counts the particles that are inside an obstacle.
    ///
    /// # Errors
    /// Those of the source.
    pub fn count_inside(
        &self,
        source: &AnySource<'_>,
        lattice: &Lattice,
        half_width: f32,
    ) -> Result<usize, Unread> {
        let of_batch = |batch: usize| {
            let mut known = LastLeaf { obstacles: self, lattice, half_width, last: None };
            Ok(match source.batch(batch)? {
                Positions::F32(positions) => positions
                    .iter()
                    .filter(|position| known.is_inside(glam::Vec3::from(**position).as_dvec3()))
                    .count(),
                Positions::F64(positions) => {
                    positions.iter().filter(|position| known.is_inside(DVec3::from(**position))).count()
                }
            })
        };
        (0..source.batch_count())
            .into_par_iter()
            .halved()
            .map(of_batch)
            .try_reduce(|| 0, |one, other| Ok(one + other))
    }
}

/// The voxel nearest to a particle is at most √3/2 voxels away. If that voxel is farther from the surface
/// than this, in voxels, the particle is on the voxel's side.
const NEAR: f32 = 0.9;

/// The leaf of the previous particle: the next particle is often in the same leaf.
struct LastLeaf<'a> {
    obstacles: &'a Obstacles,
    lattice: &'a Lattice,
    half_width: f32,
    last: Option<(IVec3, ObstacleLeaf)>,
}

impl LastLeaf<'_> {
    fn is_inside(&mut self, position: DVec3) -> bool {
        let Some(index) = self.lattice.index_from_world(position) else { return false };
        let voxel = index.round().as_ivec3();
        let local = voxel & IVec3::splat(LEAF_EDGE - 1);
        let origin = voxel - local;
        let LastLeaf { obstacles, lattice, half_width, last } = self;
        if last.as_ref().is_none_or(|(known, _)| *known != origin) {
            *last = Some((origin, obstacles.leaf(origin, lattice, *half_width)));
        }
        match last {
            Some((_, ObstacleLeaf::Inside)) => true,
            Some((_, ObstacleLeaf::Near(leaf))) => match leaf.values[offset_in_leaf(local)] {
                distance if distance > NEAR => false,
                distance if distance < -NEAR => true,
                _ => obstacles.depth(position, lattice, *half_width).is_some(),
            },
            _ => false,
        }
    }
}

#[cfg(test)]
mod tests;
