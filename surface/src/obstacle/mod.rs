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

mod boundary;
mod contact;
mod count_inside;
mod depth;
mod grid_sdf;
mod inside_test;
mod leaf;
mod leaf_cache;
mod mesh_distance;
mod mesh_sdf;
mod sheet;
mod surface;
#[cfg(test)]
mod tests;
mod tree;
mod triangle8;
mod winding;

use std::fmt;
use std::sync::Arc;

use glam::{DVec3, IVec3};

pub use contact::{
    ContactStats, ROUNDING_MAX, cut_off_at_obstacles, edge_clearance, edge_rounding, fill_gaps_at_obstacles,
};
pub use depth::DepthStats;
pub use grid_sdf::{GridSdf, SourceLevelSet};
pub use leaf::ObstacleLeaf;
pub use mesh_distance::MeshDistance;
pub use mesh_sdf::MeshSdf;
pub use surface::MeshFindings;

use crate::space::Lattice;
use crate::words::{rounded_down, significant};
use leaf_cache::LeafCache;

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
