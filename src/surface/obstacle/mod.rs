//! What stands in the way of a fluid: meshes and level sets as signed distances φ_o, leaf by leaf (paper, §3.6).
//!
//! ```text
//!   mesh ────────▶ Solid ───┐ winding number: which side;  tree: how far
//!                           ├──▶ φ_o of a leaf, in voxels of our lattice, negative inside the obstacle
//!   level set ───▶ Sampled ─┘ interpolated
//! ```
//!
//! Each leaf is computed by itself, relative to its own centre and in 64 bits where that matters. So it is the same
//! whoever asks for it: a frame, a tile of one, or the next frame, for which it is kept.

mod contact;
mod count;
mod depth;
mod eights;
mod kept;
mod leaf;
mod mesh_distance;
mod rim;
mod sampled;
mod sides;
mod solid;
mod surface;
#[cfg(test)]
mod tests;
mod tree;
mod winding;

use std::sync::Arc;

use glam::{DVec3, IVec3};

pub use contact::{ContactTally, hold_contact};
pub use depth::DepthTally;
pub use leaf::ObstacleLeaf;
pub use mesh_distance::MeshDistance;
pub use sampled::{LevelSetSource, Sampled};
pub use solid::Solid;
pub use surface::MeshFindings;

use crate::surface::space::Lattice;
use kept::KeptLeaves;

/// What an obstacle is made of.
pub enum Shape {
    /// What a mesh encloses.
    Solid(Solid),
    /// What a level set encloses.
    Sampled(Box<Sampled>),
}

impl Shape {
    /// The least and the greatest corner of a box that it is in, in world units; `None` if there is nothing of it.
    pub fn bounds(&self) -> Option<[DVec3; 2]> {
        match self {
            Shape::Solid(solid) => solid.bounds(),
            Shape::Sampled(sampled) => sampled.bounds(),
        }
    }

    /// The memory that it takes, in bytes.
    fn size_bytes(&self) -> usize {
        match self {
            Shape::Solid(solid) => solid.size_bytes(),
            Shape::Sampled(sampled) => sampled.size_bytes(),
        }
    }
}

/// A body that the fluid must not enter. Share it between frames by an `Arc`: its distances are cached in it.
pub struct Obstacle {
    shape: Shape,
    kept: KeptLeaves,
}

impl Obstacle {
    /// What a triangle mesh in world units encloses. It may have holes, repeated vertices and triangles that face the wrong way;
    /// triangles that cannot be part of a surface are left out: see [`mesh_findings`](Self::mesh_findings). Distances around it
    /// are cached in up to 64 MiB.
    pub fn from_mesh(positions: &[[f64; 3]], triangles: &[[u32; 3]]) -> Obstacle {
        Obstacle::new(Shape::Solid(Solid::new(positions, triangles)), CACHED_BYTES_MAX)
    }

    #[doc(hidden)]
    /// An obstacle whose leaves are kept, in at most so many bytes: a frame asks for them more than once, and if
    /// the obstacle stands still the next frame asks for the same.
    pub fn new(shape: Shape, kept_bytes_max: usize) -> Obstacle {
        Obstacle { shape, kept: KeptLeaves::new(kept_bytes_max) }
    }

    /// What was found in its mesh: holes, and triangles that were left out or turned.
    pub fn mesh_findings(&self) -> Option<&MeshFindings> {
        match &self.shape {
            Shape::Solid(solid) => Some(solid.findings()),
            Shape::Sampled(_) => None,
        }
    }

    /// What it is made of.
    #[doc(hidden)]
    pub fn shape(&self) -> &Shape {
        &self.shape
    }

    /// The memory that it takes, in bytes.
    pub fn size_bytes(&self) -> usize {
        self.kept.size_bytes() + self.shape.size_bytes()
    }

    /// The memory that it takes once its cache is full, in bytes.
    pub fn size_bytes_max(&self) -> usize {
        self.kept.size_bytes_max().saturating_add(self.shape.size_bytes())
    }

    #[doc(hidden)]
    /// Its signed distances in the leaf with this origin, in voxels, within ± `half_width`.
    pub fn leaf(&self, origin: IVec3, lattice: &Lattice, half_width: f32) -> ObstacleLeaf {
        let compute = || match &self.shape {
            Shape::Solid(solid) => solid.leaf(origin, lattice, half_width),
            Shape::Sampled(sampled) => sampled.leaf(origin, lattice, half_width),
        };
        self.kept.get(origin, lattice, half_width, compute)
    }

    #[doc(hidden)]
    /// Whether its surface may come within `margin_voxels` of the voxels of the leaf with this origin. Cheap, and
    /// never wrongly no.
    pub fn touches(&self, origin: IVec3, lattice: &Lattice, margin_voxels: f32) -> bool {
        match &self.shape {
            Shape::Solid(solid) => solid.touches(origin, lattice, margin_voxels),
            Shape::Sampled(sampled) => sampled.touches(origin, lattice, margin_voxels),
        }
    }
}

/// What an obstacle keeps of its distances, at most, unless the caller says otherwise.
const CACHED_BYTES_MAX: usize = 64 << 20;

/// All obstacles of a frame.
#[derive(Clone, Default)]
pub struct Obstacles {
    /// Each of them.
    pub members: Vec<Arc<Obstacle>>,
}

impl Obstacles {
    /// Whether there is none.
    pub fn is_empty(&self) -> bool {
        self.members.is_empty()
    }

    /// φ_o of all together in the leaf with this origin: the least of theirs.
    pub fn leaf(&self, origin: IVec3, lattice: &Lattice, half_width: f32) -> ObstacleLeaf {
        let leaves = self.members.iter().map(|obstacle| obstacle.leaf(origin, lattice, half_width));
        leaves.fold(ObstacleLeaf::Outside, ObstacleLeaf::union)
    }

    /// Whether the surface of one may come within `margin_voxels` of the voxels of the leaf with this origin.
    pub fn touches(&self, origin: IVec3, lattice: &Lattice, margin_voxels: f32) -> bool {
        self.members.iter().any(|obstacle| obstacle.touches(origin, lattice, margin_voxels))
    }
}
