//! Level sets on the sparse grid: a narrow band of signed distances, and the interval that the
//! smoother must keep it in.
//!
//! ```text
//!      outside          φ = 0          inside
//!   +6 … +3 +2 +1  ─────────────  −1 −2 −3 … −6       φ in voxels, negative inside
//!        └───── narrow band ─────────┘
//! ```
//!
//! Beyond the stored leaves φ is + or − the band's half width: outside or inside.

mod bounds;
mod rebuilt;
mod redistance;
mod widen;

use std::sync::Arc;

pub use bounds::Bounds;
pub use rebuilt::{
    REBUILT_HALF_WIDTH, RebuildReason, StoredLevelSet, TooManyLeaves, rebuilding_leaf_count_max, rebuilt,
};
pub use redistance::{Sweeps, UNREACHED, extend, redistance, redistance_in};
pub use widen::{WIDENED_MAX, widened, widened_leaf_count};

use crate::grid::{Field, Topology};

/// Signed distances near a surface.
#[derive(Clone, Debug)]
pub struct NarrowBand {
    /// Which leaves are stored.
    pub topology: Arc<Topology>,
    /// Signed distance in voxels, negative inside; within ± `half_width`.
    pub phi: Field,
    /// The largest |φ| that is stored, in voxels.
    pub half_width: f32,
}
