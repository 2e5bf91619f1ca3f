//! Level sets on the sparse grid: a narrow band of signed distances, and the bounds that constrain smoothing.
//!
//! ```text
//!      outside          φ = 0          inside
//!   +6 … +3 +2 +1  ─────────────  −1 −2 −3 … −6       φ in voxels, negative inside
//!        └───── narrow band ─────────┘
//! ```
//!
//! Beyond the stored leaves, φ is + half width (outside) or − half width (inside).

mod bounds;
mod offset;
mod rebuilt;
mod redistance;
mod widen;

use std::sync::Arc;

pub use bounds::Bounds;
pub use offset::{extend_distances, offset_reach_voxels, offset_surface};
pub use rebuilt::{
    REBUILT_HALF_WIDTH, RebuildReason, StoredLevelSet, TooManyLeaves, rebuilding_leaf_count_max, rebuilt,
};
pub use redistance::{Sweeps, UNREACHED, extend, extend_in, redistance, redistance_in};
pub use widen::{WIDENED_MAX, widened, widened_leaf_count, widened_leaf_count_max};

use glam::IVec3;

use crate::grid::{Field, LEAF_VOXELS, Topology};

/// Minimum |φ| of a finished level set, in voxels, unless bounds require a smaller value.
/// Where the surface almost touches a voxel, meshers fold it around that voxel into tiny sharp triangles.
/// With OpenVDB's mesher, a single voxel with |φ| = 10⁻⁶ adds 4800 to ∫H², three times the ∫H² of its whole
/// frame. With |φ| = 0.0002, it adds 320; with 0.003, 30; with 1/128, less than a drop's 4π.
pub const NEAREST_TO_ZERO: f32 = 1.0 / 128.0;

/// A level set: signed distances in voxels near a surface, negative inside. Multiply by the voxel size for
/// world units. Points outside the stored leaves are farther from the surface than the half width.
#[derive(Clone, Debug)]
pub struct NarrowBand {
    /// The stored leaves.
    pub topology: Arc<Topology>,
    /// Signed distance in voxels, negative inside; within ± `half_width`.
    pub phi: Field,
    /// Maximum stored |φ|, in voxels.
    pub half_width: f32,
}

impl NarrowBand {
    /// The stored leaves: the minimum voxel of each, and its 512 values in voxels, z fastest. The center of
    /// voxel (x, y, z) is at (x, y, z) times the voxel size in world space.
    pub fn leaves(&self) -> impl ExactSizeIterator<Item = (IVec3, &[f32; LEAF_VOXELS])> {
        let values = self.phi.leaves.iter().map(|leaf| &leaf.values);
        self.topology.origins().iter().copied().zip(values)
    }
}
