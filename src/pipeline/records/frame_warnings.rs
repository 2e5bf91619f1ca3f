//! Derives warnings from a frame's measurements.

use crate::pipeline::input::frame::FrameReport;
use crate::pipeline::warning::Warning;
use crate::surface::report::{ReconstructionReport, TransferReport};
use crate::surface::validation::ParticlesOutside;

impl FrameReport {
    /// All warnings about a frame that was converted.
    pub fn all_warnings(&self) -> Vec<Warning> {
        let reconstruction = &self.reconstruction;
        let mut warnings = self.warnings.clone();
        warnings.extend(shape_warnings(reconstruction));
        warnings.extend(reconstruction.transfer.iter().flat_map(transfer_warnings));
        warnings.extend(left_out(reconstruction));
        if reconstruction.contact.particle_count > 0 {
            let count = reconstruction.contact.particle_count;
            let are_most = 2 * count > reconstruction.particle_count;
            warnings.push(Warning::ParticlesInObstacles { count, are_most });
        }
        if reconstruction.smoothing.convergence.is_some_and(|convergence| !convergence.reached) {
            warnings.push(Warning::NotConverged);
        }
        if reconstruction.smoothing.cfl_exceeded_count > 0 {
            warnings.push(Warning::CflExceeded { step_count: reconstruction.smoothing.cfl_exceeded_count });
        }
        warnings.extend(coarse_positions(reconstruction));
        warnings.extend(outside(reconstruction));
        warnings.extend(broken_guarantees(reconstruction));
        warnings
    }

    /// Whether the frame's result passed validation.
    pub fn keeps_guarantees(&self) -> bool {
        self.reconstruction.certificate.holds()
    }
}

/// A warning about particles outside the surface, if an offset or position smoothing leaves more than a few
/// outside.
fn outside(report: &ReconstructionReport) -> Option<Warning> {
    let certificate = &report.certificate;
    let of_offset = certificate.may_leave_particles_outside.then_some(certificate.particles_outside);
    let ParticlesOutside { count, .. } = certificate.input_positions_outside.or(of_offset)?;
    let particle_count = report.particle_count;
    (count as f64 > OUTSIDE_REPORTED_FROM * particle_count as f64).then_some(Warning::ParticlesOutside {
        count,
        particle_count,
        is_offset: certificate.may_leave_particles_outside,
        is_smoothed: certificate.input_positions_outside.is_some(),
    })
}

/// There is a warning if more than this fraction of the particles is outside.
const OUTSIDE_REPORTED_FROM: f64 = 0.02;

/// There is a warning if the rounding error of positions is greater than this, in voxels.
const ROUNDING_REPORTED_FROM: f64 = 1.0 / 256.0;

/// A warning about positions with a large rounding error.
pub(crate) fn coarse_positions(report: &ReconstructionReport) -> Option<Warning> {
    let voxels = report.certificate.position_rounding;
    (voxels > ROUNDING_REPORTED_FROM).then_some(Warning::CoarsePositions { voxels })
}

/// A warning about particles that the surface leaves out, if there are any.
pub(crate) fn left_out(report: &ReconstructionReport) -> Option<Warning> {
    let count = report.dropped_count;
    (count > 0).then_some(Warning::ParticlesIgnored { count, near: report.outlier_position })
}

/// Warnings about the shapes of particles. Thin ellipsoids that are widened to the grid's resolution cause no
/// warning, because at the default radii nearly all are widened. A few particles that are not stretched cause
/// no warning either, because isolated drops are not stretched.
fn shape_warnings(report: &ReconstructionReport) -> impl Iterator<Item = Warning> {
    let shape_stats = &report.shapes;
    // If the neighbour search found near particles, isolated ones are normal.
    let is_unstretched = shape_stats.near_count == 0 && 2 * shape_stats.ball_count > report.particle_count;
    let not_stretched = if is_unstretched { shape_stats.ball_count } else { 0 };
    let warnings = [
        Warning::SmallRadii {
            count: shape_stats.small_radius_count,
            radius_min: shape_stats.small_radius_min,
        },
        Warning::InvalidRadii { count: shape_stats.invalid_radius_count },
        Warning::LargeRadii { count: shape_stats.large_radius_count },
        Warning::NotStretched { count: not_stretched },
    ];
    warnings.into_iter().filter(Warning::is_about_any)
}

/// Warnings about attributes on the surface.
fn transfer_warnings(
    TransferReport { vertices, band, .. }: &TransferReport,
) -> impl Iterator<Item = Warning> {
    let warnings = [
        Warning::ValuesNotFinite { count: vertices.ignored_value_count.max(band.ignored_value_count) },
        Warning::VerticesWithoutAttributes { count: vertices.empty_count },
        Warning::VoxelsWithoutAttributes { count: band.empty_count },
    ];
    warnings.into_iter().filter(Warning::is_about_any)
}

/// A description of the failed checks of a frame; `None` if it passed validation.
pub(crate) fn fault(report: &ReconstructionReport) -> Option<String> {
    (!report.certificate.holds()).then(|| does_not_hold(&report.certificate.violations()))
}

/// The message for a frame with these failed checks.
pub(crate) fn does_not_hold(fault: &str) -> String {
    format!("failed validation: {fault}")
}

/// A warning for each failed check.
fn broken_guarantees(report: &ReconstructionReport) -> Vec<Warning> {
    let certificate = &report.certificate;
    let mut broken = Vec::new();
    if certificate.bound_violation_count > 0 {
        broken.push(Warning::OutOfBounds { voxel_count: certificate.bound_violation_count });
    }
    if certificate.vertices_inside_min > 0 {
        let nearest_voxels = certificate.vertex_distance_min;
        broken.push(Warning::VerticesTooNear { count: certificate.vertices_inside_min, nearest_voxels });
    }
    if certificate.vertices_outside_max > 0 {
        let farthest_voxels = certificate.vertex_distance_max;
        broken.push(Warning::VerticesTooFar { count: certificate.vertices_outside_max, farthest_voxels });
    }
    if certificate.particle_violation_count() > 0 {
        broken.push(Warning::NotEnclosed { count: certificate.particle_violation_count() });
    }
    if !report.mesh.is_closed_manifold() {
        broken.push(Warning::NotClosed(Box::new(report.mesh)));
    }
    broken
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn broken_guarantees_become_warnings() {
        let mut report = FrameReport::default();
        assert_eq!(report.all_warnings(), []);
        report.reconstruction.certificate.particles_outside.count = 2;
        report.reconstruction.certificate.vertices_outside_max = 1;
        report.reconstruction.certificate.vertex_distance_max = 7.25;
        report.reconstruction.mesh.boundary_edge_count = 3;
        let notes: Vec<String> = report.all_warnings().iter().map(ToString::to_string).collect();
        assert_eq!(notes.len(), 3, "{notes:?}");
        assert!(
            notes[0].contains("1 vertex of the mesh too far from all particles")
                && notes[0].contains("7.25 voxels")
        );
        assert!(notes[1].ends_with("2 particles outside the surface"));
        assert!(notes[2].ends_with("not closed and manifold: 3 boundary edges"));
    }
}
