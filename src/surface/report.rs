//! What each stage measured: plain numbers, filled in by the stages, written out by the pipeline.

use glam::DVec3;

pub use crate::surface::attributes::TransferCounts;
use crate::surface::mesh::MeshMeasures;
pub use crate::surface::obstacle::{ContactTally, DepthTally};
pub use crate::surface::smooth::Convergence;
pub use crate::surface::validation::{Certificate, ParticlesOutside};

/// Everything that was measured and checked while a frame was reconstructed. Check `certificate.holds()` before you use a
/// surface, and `dropped_count` if the input may be damaged.
#[derive(Clone, Debug, Default, PartialEq)]
#[non_exhaustive]
pub struct SkinReport {
    /// Particles that the surface was made of.
    pub particle_count: usize,
    /// Particles left out: not finite, outside the grid's range of indices, or so far from the others that 32-bit positions
    /// cannot hold a surface around them.
    pub dropped_count: usize,
    /// About where one of them is, in world units, if any of them is finite.
    pub stray: Option<DVec3>,
    /// How particles got their shapes; all zero where they are balls of one size.
    pub shaping: Shaping,
    /// What obstacles changed of the level sets.
    pub contact: ContactTally,
    /// How deep vertices are in obstacles.
    pub depth: DepthTally,
    /// What the options for edits changed.
    pub edits: EditReport,
    /// Leaves of 8³ voxels that were stored.
    pub leaf_count: usize,
    /// Voxels with |φ| at most 3 voxels after the Laplacian steps: the unknowns of the first biharmonic step.
    pub free_voxel_count: usize,
    /// Passes of the biharmonic operator: at most so many over a voxel.
    pub pass_count: usize,
    /// How often a free voxel was moved: free voxels times passes, where all have the same number.
    pub moved_count: u64,
    /// How far a change of one particle can reach, in voxels; `None` where the integrator couples
    /// all voxels (conjugate gradients).
    pub reach_voxels: Option<u32>,
    /// Of the conjugate gradients only.
    pub convergence: Option<Convergence>,
    /// Explicit steps whose CFL bound (Eq. 8) was exceeded.
    pub cfl_exceeded_count: usize,
    /// Seconds in each stage, where the caller measured them: the method has no clock.
    pub seconds: StageSeconds,
    /// What was checked of the result.
    pub certificate: Certificate,
    /// Vertices that were out of their bounds by more than half a voxel, and were moved back.
    pub vertices_returned: usize,
    /// Triangles without area at the positions that are written, which were taken out.
    pub flat_triangles_removed: usize,
    /// ∫H² over the surface, from φ; 4π for a sphere of any size.
    pub bending_energy: f64,
    /// What was measured on the mesh.
    pub mesh: MeshMeasures,
    /// What the surface got of the particles' attributes, if that was asked for.
    pub transfer: Option<TransferReport>,
}

/// Which attributes the surface got from its particles, and how well they cover it.
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
#[derive(Clone, Debug, Default, PartialEq)]
#[non_exhaustive]
pub struct TransferReport {
    /// The names of the attributes.
    #[cfg_attr(feature = "serde", serde(rename = "names"))]
    pub attributes: Vec<String>,
    /// At the vertices.
    pub vertices: TransferCounts,
    /// At the places in the band that voxels have their values from.
    pub band: TransferCounts,
    /// Seconds that it took, where the caller measured them.
    pub seconds: f64,
}

/// A 32-bit number as JSON that has all of its digits.
#[cfg(feature = "serde")]
#[expect(clippy::trivially_copy_pass_by_ref, reason = "serde's signature")]
fn as_f64<S: serde::Serializer>(number: &f32, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.serialize_f64(f64::from(*number))
}

/// How particles got their shapes: by their own radii, by stretching, and by their neighbours. All 0 where the options leave
/// particles as balls of one size.
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
#[derive(Clone, Copy, Debug, Default, PartialEq)]
#[non_exhaustive]
pub struct Shaping {
    /// Particles whose own r_min the grid could not hold, and which was raised to √3·h.
    #[cfg_attr(feature = "serde", serde(rename = "small_radii"))]
    pub small_radius_count: usize,
    /// r_min of the smallest of them, as it was to be, world units; 0 if there is none.
    pub small_radius_min: f64,
    /// Particles so large that their r_max was lowered to the largest there may be.
    #[cfg_attr(feature = "serde", serde(rename = "large_radii"))]
    pub large_radius_count: usize,
    /// Particles whose own radius is none: they have the least.
    #[cfg_attr(feature = "serde", serde(rename = "invalid_radii"))]
    pub invalid_radius_count: usize,
    /// Particles near the surface, of which neighbours were looked at. The others stay where they were given, and are not
    /// stretched by neighbours.
    #[cfg_attr(feature = "serde", serde(rename = "near"))]
    pub near_count: usize,
    /// Stretched particles with a half axis that the grid could not hold, which was raised to √3·h.
    #[cfg_attr(feature = "serde", serde(rename = "raised"))]
    pub raised_count: usize,
    /// Particles that were to be stretched and are balls: neighbours too few, or no velocity that is finite.
    #[cfg_attr(feature = "serde", serde(rename = "balls"))]
    pub ball_count: usize,
    /// The longest half axis, in units of the settings' radii.
    #[cfg_attr(feature = "serde", serde(serialize_with = "as_f64"))]
    pub longest: f32,
    /// Seconds that it took, where the caller measured them; those of rasterization include them.
    pub seconds: f64,
}

/// What the options for edits changed: islands dropped, cavities filled, what a box clips, triangles saved. All 0 without them.
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
#[derive(Clone, Copy, Debug, Default, PartialEq)]
#[non_exhaustive]
pub struct EditReport {
    /// Pieces that were dropped: they had too few particles.
    #[cfg_attr(feature = "serde", serde(rename = "islands_dropped"))]
    pub island_count: usize,
    /// The particles in them.
    #[cfg_attr(feature = "serde", serde(rename = "island_particles"))]
    pub island_particle_count: u64,
    /// Cavities that were filled.
    #[cfg_attr(feature = "serde", serde(rename = "cavities_filled"))]
    pub cavity_count: usize,
    /// Their volume, in voxels.
    #[cfg_attr(feature = "serde", serde(rename = "cavity_volume_voxels"))]
    pub cavity_voxel_count: u64,
    /// Voxels inside that a box cut off.
    #[cfg_attr(feature = "serde", serde(rename = "clipped_voxels"))]
    pub clipped_voxel_count: u64,
    /// Triangles that were saved.
    #[cfg_attr(feature = "serde", serde(rename = "triangles_saved"))]
    pub removed_triangle_count: usize,
    /// How far the mesh may have moved for that, in voxels.
    pub decimation_error_voxels: f64,
}

/// The phases of a reconstruction, in their order.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
#[non_exhaustive]
pub enum Phase {
    /// Checks the input, and estimates the particle spacing where the options need it.
    Prepare,
    /// Particles to level sets; what neighbours do to the shapes of particles is part of it.
    Rasterize,
    /// Smooths the level set within its bounds: usually most of the time.
    Smooth,
    /// Level set to mesh, with its measures and checks.
    Contour,
    /// Attributes of the particles to the vertices of the mesh.
    Interpolate,
}

/// Wall-clock seconds in each stage of the method, where the caller measured them; else 0.
///
/// When several frames are under way in one pool of threads, each has fewer of them than it would have
/// alone, and a stage that waits for a part of its work may wait for another frame's stage, too. Only of
/// a frame that runs alone is this the cost.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
#[non_exhaustive]
pub struct StageSeconds {
    /// Particles to level sets.
    pub rasterize: f64,
    /// Laplacian and biharmonic smoothing.
    pub smooth: f64,
    /// Level set to mesh, and the measures and certificate of the result.
    pub contour: f64,
}

impl StageSeconds {
    /// All stages together.
    pub fn total(&self) -> f64 {
        self.rasterize + self.smooth + self.contour
    }
}
