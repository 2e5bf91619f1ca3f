//! Measurements of a frame.

use serde::{Deserialize, Serialize};

use crate::pipeline::input::frame::{FrameReport, Job, Seconds};
use crate::surface::grid::LEAF_VOXELS;

/// The measurements of a converted frame, as clients of the daemon see them and as records contain them. Lengths
/// in voxels, times in seconds, sizes in bytes.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Figures {
    /// Particles that the surface was reconstructed from; `None` for a level set.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub particles: Option<usize>,
    /// Particles that were dropped: not finite, or out of range.
    pub dropped: usize,
    /// Voxels that were stored.
    pub voxels: usize,
    /// Vertices of the mesh.
    pub vertices: usize,
    /// Triangles of the mesh.
    pub triangles: usize,
    /// Connected components of the mesh.
    pub components: usize,
    /// Seconds in each stage.
    pub seconds: Seconds,
    /// Peak memory of the process up to the end of writing the frame.
    pub peak_memory_bytes: Option<u64>,
    /// The results of the checks.
    pub certificate: CertificateView,
    /// Warnings about the frame.
    pub notes: Vec<String>,
}

/// The results of the checks of a frame.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct CertificateView {
    /// Whether the surface passed all checks.
    pub holds: bool,
    /// Voxels out of their bounds.
    pub bound_violations: usize,
    /// Particles that are not inside the surface.
    pub particles_outside: usize,
    /// Whether the mesh is closed and manifold.
    pub closed_manifold: bool,
}

impl Figures {
    /// The seconds of all stages together, rounded to the millisecond: more digits are noise.
    pub fn total_seconds(&self) -> f64 {
        (self.seconds.total() * 1e3).round() / 1e3
    }

    /// The figures of a report about a frame with this kind of job.
    pub fn of(report: &FrameReport, job: Job) -> Figures {
        let reconstruction = &report.reconstruction;
        Figures {
            particles: (job == Job::Surface).then_some(reconstruction.particle_count),
            dropped: reconstruction.dropped_count,
            voxels: reconstruction.leaf_count * LEAF_VOXELS,
            vertices: reconstruction.mesh.vertex_count,
            triangles: reconstruction.mesh.triangle_count,
            components: reconstruction.mesh.component_count,
            seconds: report.seconds,
            peak_memory_bytes: report.peak_memory_bytes,
            certificate: CertificateView {
                holds: reconstruction.certificate.holds(),
                bound_violations: reconstruction.certificate.bound_violation_count,
                particles_outside: reconstruction.certificate.particles_outside.count,
                closed_manifold: reconstruction.certificate.mesh_is_closed_manifold,
            },
            notes: report.warnings.iter().map(ToString::to_string).collect(),
        }
    }
}
