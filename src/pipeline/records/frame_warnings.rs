//! Derives warnings from a frame's measurements.

use std::path::Path;

use crate::pipeline::input::frame::FrameReport;
use crate::pipeline::target::outputs::OutputFormat;
use crate::pipeline::warning::{FrameWarning, InputWarning, SurfaceWarning, Violation, Warning};
use crate::surface::report::{ParticlesOutside, ReconstructionReport, ShapeStats};

impl FrameReport {
    /// All warnings about a frame that was converted.
    pub fn all_warnings(&self) -> Vec<Warning> {
        let report = &self.reconstruction;
        let format = self.outputs.iter().find_map(|path| format_with_world_positions(path));
        let mut warnings = self.warnings.clone();
        warnings.extend(shape_warnings(report).map(Warning::Input));
        warnings.extend(transfer_warnings(report));
        warnings.extend(left_out(report));
        warnings.extend(solver_warnings(report).map(Warning::Frame));
        warnings.extend(coarse_positions(report, format));
        warnings.extend(outside(report).map(Warning::Frame));
        warnings.extend(violations(report).map(Warning::Violation));
        warnings
    }

    /// Whether the frame's result passed validation.
    pub fn keeps_guarantees(&self) -> bool {
        self.reconstruction.certificate.holds()
    }
}

fn format_with_world_positions(output: &Path) -> Option<OutputFormat> {
    let format = OutputFormat::from_extension(output.extension()?.to_str()?)?;
    format.lacks_origin().then_some(format)
}

/// Warnings about the shapes of particles. Thin ellipsoids that are widened to the grid's resolution cause no
/// warning, because at the default radii nearly all are widened. A few particles that are not stretched cause
/// no warning either, because isolated drops are not stretched.
fn shape_warnings(report: &ReconstructionReport) -> impl Iterator<Item = InputWarning> {
    let ShapeStats { small_radius_count, invalid_radius_count, large_radius_count, ball_count, .. } =
        report.shapes;
    let [small, large] = [report.shapes.small_voxel_size, report.shapes.large_voxel_size];
    // If the neighbour search found near particles, isolated ones are normal.
    let is_unstretched = report.shapes.near_count == 0 && 2 * ball_count > report.particle_count;
    let warnings = [
        (small_radius_count > 0)
            .then_some(InputWarning::SmallRadii { count: small_radius_count, voxel_size: small }),
        (invalid_radius_count > 0).then_some(InputWarning::InvalidRadii { count: invalid_radius_count }),
        (large_radius_count > 0)
            .then_some(InputWarning::LargeRadii { count: large_radius_count, voxel_size: large }),
        is_unstretched.then_some(InputWarning::NotStretched { count: ball_count }),
    ];
    warnings.into_iter().flatten()
}

/// Warnings about attributes on the surface.
fn transfer_warnings(report: &ReconstructionReport) -> Vec<Warning> {
    let mut warnings = Vec::new();
    let Some(transfer) = &report.transfer else { return warnings };
    let [vertices, band] = [&transfer.vertices, &transfer.band];
    let count = vertices.ignored_value_count.max(band.ignored_value_count);
    if count > 0 {
        warnings.push(Warning::Input(InputWarning::ValuesNotFinite { count }));
    }
    if vertices.empty_count > 0 {
        let count = vertices.empty_count;
        warnings.push(Warning::Surface(SurfaceWarning::VerticesWithoutAttributes { count }));
    }
    if band.empty_count > 0 {
        let count = band.empty_count;
        warnings.push(Warning::Surface(SurfaceWarning::VoxelsWithoutAttributes { count }));
    }
    warnings
}

/// A warning about particles that the surface leaves out, if there are any.
pub(crate) fn left_out(report: &ReconstructionReport) -> Option<Warning> {
    let count = report.dropped_count;
    let near = report.outlier_position;
    (count > 0).then_some(Warning::Frame(FrameWarning::ParticlesIgnored { count, near }))
}

/// Warnings about obstacles and the smoothing.
fn solver_warnings(report: &ReconstructionReport) -> impl Iterator<Item = FrameWarning> {
    let count = report.contact.particle_count;
    let are_most = 2 * count > report.particle_count;
    let step_count = report.smoothing.cfl_exceeded_count;
    let warnings = [
        (count > 0).then_some(FrameWarning::ParticlesInObstacles { count, are_most }),
        report
            .smoothing
            .convergence
            .filter(|convergence| !convergence.reached)
            .map(|_| FrameWarning::NotConverged),
        (step_count > 0).then_some(FrameWarning::CflExceeded { step_count }),
    ];
    warnings.into_iter().flatten()
}

/// There is a warning if the rounding error of positions is greater than this, in voxels.
const ROUNDING_REPORTED_FROM: f64 = 1.0 / 256.0;

/// A warning about positions with a large rounding error, in files of which one has this format with world
/// positions.
pub(crate) fn coarse_positions(
    report: &ReconstructionReport,
    format: Option<OutputFormat>,
) -> Option<Warning> {
    let voxels = report.certificate.position_rounding;
    (voxels > ROUNDING_REPORTED_FROM)
        .then_some(Warning::Frame(FrameWarning::CoarsePositions { voxels, format }))
}

/// There is a warning if more than this fraction of the particles is outside.
const OUTSIDE_REPORTED_FROM: f64 = 0.02;

/// A warning about particles outside the surface, if an offset or position smoothing leaves more than a few
/// outside.
fn outside(report: &ReconstructionReport) -> Option<FrameWarning> {
    let certificate = &report.certificate;
    let is_offset = certificate.may_leave_particles_outside;
    let is_smoothed = certificate.input_positions_outside.is_some();
    let by_offset = is_offset.then_some(certificate.particles_outside);
    let ParticlesOutside { count, .. } = certificate.input_positions_outside.or(by_offset)?;
    let particle_count = report.particle_count;
    (count as f64 > OUTSIDE_REPORTED_FROM * particle_count as f64).then_some(FrameWarning::ParticlesOutside {
        count,
        particle_count,
        is_offset,
        is_smoothed,
    })
}

/// The failed checks.
fn violations(report: &ReconstructionReport) -> impl Iterator<Item = Violation> {
    let certificate = &report.certificate;
    let voxel_count = certificate.bound_violation_count;
    let (near_count, nearest_voxels) = (certificate.vertices_inside_min, certificate.vertex_distance_min);
    let (far_count, farthest_voxels) = (certificate.vertices_outside_max, certificate.vertex_distance_max);
    let outside_count = certificate.particle_violation_count();
    let violations = [
        (voxel_count > 0).then_some(Violation::OutOfBounds { voxel_count }),
        (near_count > 0).then_some(Violation::VerticesTooNear { count: near_count, nearest_voxels }),
        (far_count > 0).then_some(Violation::VerticesTooFar { count: far_count, farthest_voxels }),
        (outside_count > 0).then_some(Violation::NotEnclosed { count: outside_count }),
        (!report.mesh.is_closed_manifold()).then(|| Violation::NotClosed(Box::new(report.mesh))),
    ];
    violations.into_iter().flatten()
}

/// A description of the failed checks of a frame; `None` if it passed validation.
pub(crate) fn fault(report: &ReconstructionReport) -> Option<String> {
    let certificate = &report.certificate;
    (!certificate.holds()).then(|| format!("failed validation: {}", certificate.violations()))
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

    #[test]
    fn format_that_rounds_positions_is_named() {
        let mut report = FrameReport::default();
        report.reconstruction.certificate.position_rounding = 0.5;
        for (output, text) in
            [("a.stl", "a .stl has world positions, "), ("a.vdb", "parts of this frame lie ")]
        {
            report.outputs = vec!["a.glb".into(), output.into()];
            let [warning] = &report.all_warnings()[..] else { panic!("{:?}", report.all_warnings()) };
            assert!(warning.to_string().starts_with(text), "{warning}");
        }
    }
}
