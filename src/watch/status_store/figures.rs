//! What was measured on a frame, as it is shown.

use serde::{Deserialize, Serialize};

use crate::pipeline::{FrameReport, Seconds};
use crate::surface::grid::LEAF_VOXELS;

/// What was measured on a frame that was converted, as it is shown and as the journal keeps it. Lengths in voxels, times in seconds, sizes in bytes.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Figures {
    /// Particles that were skinned.
    pub particles: usize,
    /// Particles that were dropped: not finite, or out of range.
    pub dropped: usize,
    /// Voxels that were stored.
    pub voxels: usize,
    /// Of the mesh.
    pub vertices: usize,
    /// Of the mesh.
    pub triangles: usize,
    /// Separate pieces of the mesh.
    pub components: usize,
    /// Seconds in each stage.
    pub seconds: Seconds,
    /// The most that the process has held until the frame was written.
    pub peak_memory_bytes: Option<u64>,
    /// What was checked of the result.
    pub certificate: CertificateView,
    /// What a user should know though the frame was converted.
    pub notes: Vec<String>,
}

/// What was checked of the result.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct CertificateView {
    /// Whether all that is promised holds.
    pub holds: bool,
    /// Voxels out of their bounds.
    pub bound_violations: usize,
    /// Particles that are not inside the surface.
    pub particles_outside: usize,
    /// Whether the mesh is closed, and a manifold.
    pub closed_manifold: bool,
}

impl Figures {
    /// Those of a report.
    pub fn of(report: &FrameReport) -> Figures {
        let skin = &report.skin;
        Figures {
            particles: skin.particle_count,
            dropped: skin.dropped_count,
            voxels: skin.leaf_count * LEAF_VOXELS,
            vertices: skin.mesh.vertex_count,
            triangles: skin.mesh.triangle_count,
            components: skin.mesh.component_count,
            seconds: report.seconds,
            peak_memory_bytes: report.peak_memory_bytes,
            certificate: CertificateView {
                holds: skin.certificate.holds(),
                bound_violations: skin.certificate.bound_violation_count,
                particles_outside: skin.certificate.particles_outside.count,
                closed_manifold: skin.certificate.mesh_is_closed_manifold,
            },
            notes: report.warnings.iter().map(ToString::to_string).collect(),
        }
    }
}
