//! What each stage measures: plain numbers that the stages fill in and the pipeline writes.

use glam::DVec3;

pub use crate::attributes::TransferCounts;
use crate::mesh::MeshMeasures;
pub use crate::obstacle::{ContactStats, DepthStats};
pub use crate::smooth::{Convergence, SmoothReport};
use crate::spray::SprayCounts;
pub use crate::temporal::TemporalReport;
pub use crate::validation::{Certificate, ParticlesOutside};

/// Everything that was measured and checked while a frame was reconstructed. Check `certificate.holds()`
/// before you use a surface, and `dropped_count` if the input may be damaged.
#[derive(Clone, Debug, Default, PartialEq)]
#[non_exhaustive]
pub struct ReconstructionReport {
    /// Number of particles that the surface was made from.
    pub particle_count: usize,
    /// Number of particles left out: not finite, outside the grid's range of indices, or so far from the
    /// others that 32-bit positions cannot hold a surface around them.
    pub dropped_count: usize,
    /// Approximate position of one of the dropped particles, world units; `None` if none of them is finite.
    pub outlier_position: Option<DVec3>,
    /// Statistics of particle radii and anisotropy; all zero if all particles are balls of one size.
    pub shapes: ShapeStats,
    /// What the obstacles changed in the level sets.
    pub contact: ContactStats,
    /// How deep vertices lie inside obstacles.
    pub depth: DepthStats,
    /// The particles that are spray, and not in the surface; `None` unless the options ask for it.
    pub spray: Option<SprayCounts>,
    /// What islands, cavities, clipping and decimation changed.
    pub edits: EditReport,
    /// Number of stored leaves of 8³ voxels.
    pub leaf_count: usize,
    /// What smoothing did.
    pub smoothing: SmoothReport,
    /// What averaging over time did.
    pub temporal: TemporalReport,
    /// The checks of the result.
    pub certificate: Certificate,
    /// Number of vertices that were more than half a voxel outside their bounds and were moved back.
    pub vertices_clamped: usize,
    /// Number of triangles removed because they have no area at the positions that are written.
    pub flat_triangles_removed: usize,
    /// Measures of the mesh.
    pub mesh: MeshMeasures,
    /// How well the particles' attributes cover the surface; `None` unless attributes were requested.
    pub transfer: Option<TransferReport>,
}

/// The attributes that were interpolated to the surface, and how well the particles cover it.
#[derive(Clone, Debug, Default, PartialEq, serde::Serialize)]
#[non_exhaustive]
pub struct TransferReport {
    /// The names of the attributes.
    #[serde(rename = "names")]
    pub attributes: Vec<String>,
    /// Counts for the vertices.
    pub vertices: TransferCounts,
    /// Counts for the positions in the band from which the voxels take their values.
    pub band: TransferCounts,
}

/// Serializes an `f32` as a JSON number with all of its digits.
#[expect(clippy::trivially_copy_pass_by_ref, reason = "serde's signature")]
fn as_f64<S: serde::Serializer>(number: &f32, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.serialize_f64(f64::from(*number))
}

/// How particles got their shapes: from their own radii, from stretching, and from their neighbours. All 0 if
/// the options leave the particles as balls of one size.
#[derive(Clone, Copy, Debug, Default, PartialEq, serde::Serialize)]
#[non_exhaustive]
pub struct ShapeStats {
    /// Particles whose own radius is too small for the grid; it was raised to 1.1·h, or √3·h with spheres.
    #[serde(rename = "small_radii")]
    pub small_radius_count: usize,
    /// The largest voxel size that resolves them, in world units; 0 if there are none.
    pub small_voxel_size: f64,
    /// Particles whose r_max was lowered to the largest allowed.
    #[serde(rename = "large_radii")]
    pub large_radius_count: usize,
    /// The smallest voxel size at which none of them is, in world units.
    pub large_voxel_size: f64,
    /// Particles whose own radius is invalid; they get the smallest radius.
    #[serde(rename = "invalid_radii")]
    pub invalid_radius_count: usize,
    /// Particles near the surface, whose neighbours were searched. The others keep their position and are not
    /// stretched by neighbours.
    #[serde(rename = "near")]
    pub near_count: usize,
    /// Stretched particles with a semi-axis below its lower limit, which was raised to that limit: as for radii, or 0.9·h
    /// for kernels flattened by their neighbours.
    #[serde(rename = "raised")]
    pub raised_count: usize,
    /// Particles that stayed balls although stretching is on: too few neighbours, or no finite velocity.
    #[serde(rename = "balls")]
    pub ball_count: usize,
    /// The longest semi-axis, in units of the settings' radii.
    #[serde(serialize_with = "as_f64")]
    pub longest: f32,
}

/// What the options for edits changed: dropped islands, filled cavities, clipping, decimation. All 0 without
/// them.
#[derive(Clone, Copy, Debug, Default, PartialEq, serde::Serialize)]
#[non_exhaustive]
pub struct EditReport {
    /// Pieces that were dropped because they had too few particles.
    #[serde(rename = "islands_dropped")]
    pub island_count: usize,
    /// Number of particles in the dropped pieces.
    #[serde(rename = "island_particles")]
    pub island_particle_count: u64,
    /// Number of cavities that were filled.
    #[serde(rename = "cavities_filled")]
    pub cavity_count: usize,
    /// Volume of the filled cavities, in voxels.
    #[serde(rename = "cavity_volume_voxels")]
    pub cavity_voxel_count: u64,
    /// Number of inside voxels that the clip box removed.
    #[serde(rename = "clipped_voxels")]
    pub clipped_voxel_count: u64,
    /// Number of triangles that decimation removed.
    #[serde(rename = "triangles_saved")]
    pub removed_triangle_count: usize,
    /// Upper bound on how far decimation moved the mesh, in voxels.
    pub decimation_error_voxels: f64,
}

/// The phases of a reconstruction, in order.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
#[non_exhaustive]
pub enum Phase {
    /// Checks the input, and estimates the particle spacing if the options need it.
    Prepare,
    /// Converts particles to level sets, including the shapes that neighbours give them.
    Rasterize,
    /// Smooths the level set within its bounds: usually most of the time.
    Smooth,
    /// Converts the level set to a mesh, measures and checks it.
    Contour,
    /// Interpolates the particles' attributes at the vertices of the mesh.
    Interpolate,
}
