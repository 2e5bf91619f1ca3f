//! Derives warnings from a frame's measurements.

use std::path::Path;

use crate::pipeline::input::frame::FrameReport;
use crate::pipeline::target::outputs::OutputFormat;
use crate::pipeline::warning::{Warning, counted};
use crate::surface::report::{ParticlesOutside, ReconstructionReport, ShapeStats};
use crate::surface::words::{pluralize, rounded_down, significant};

impl FrameReport {
    /// All warnings about a frame that was converted.
    pub fn all_warnings(&self) -> Vec<Warning> {
        let report = &self.reconstruction;
        let format = self.outputs.iter().find_map(|path| format_with_world_positions(path));
        let mut warnings = self.warnings.clone();
        warnings.extend(shape_warnings(report));
        warnings.extend(transfer_warnings(report));
        warnings.extend(left_out(report));
        warnings.extend(solver_warnings(report));
        warnings.extend(coarse_positions(report, format));
        warnings.extend(outside(report));
        warnings.extend(violations(report).map(Warning::violation));
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
fn shape_warnings(report: &ReconstructionReport) -> impl Iterator<Item = Warning> {
    let ShapeStats { small_radius_count, invalid_radius_count, large_radius_count, ball_count, .. } =
        report.shapes;
    let [small, large] = [report.shapes.small_voxel_size, report.shapes.large_voxel_size];
    // If the neighbour search found near particles, isolated ones are normal.
    let is_unstretched = report.shapes.near_count == 0 && 2 * ball_count > report.particle_count;
    let [small, large] = [rounded_down(small), significant(large * 1.001)];
    let of_particles = |count, sentence| counted(count, "particle", sentence).map(Warning::new);
    let unstretched_count = if is_unstretched { ball_count } else { 0 };
    let warnings = [
        of_particles(
            small_radius_count,
            "{} too small for the grid, with the smallest radius that it resolves instead of their own",
        )
        .map(|warning| warning.with_remedy(format!("--voxel-size {small} or less resolves all of them"))),
        of_particles(
            invalid_radius_count,
            "{} without a radius that is a positive number: the smallest radius is used",
        ),
        of_particles(large_radius_count, "{} too large for the grid: the largest possible radius is used")
            .map(|warning| {
                warning.with_remedy(format!("--voxel-size {large} or more keeps the radii of all"))
            }),
        of_particles(unstretched_count, "{} not stretched: no finite velocity"),
    ];
    warnings.into_iter().flatten()
}

/// Warnings about attributes on the surface.
fn transfer_warnings(report: &ReconstructionReport) -> Vec<Warning> {
    let Some(transfer) = &report.transfer else { return Vec::new() };
    let [vertices, band] = [&transfer.vertices, &transfer.band];
    let ignored_count = vertices.ignored_value_count.max(band.ignored_value_count);
    let ignored = "{} of particle attributes ignored: infinite or NaN";
    let at_vertices = "{} without a particle in range: attributes are 0 or missing";
    let in_band = "{} of the .vdb without a particle in range: attributes are 0 there";
    let sentences = [
        counted(ignored_count, "value", ignored),
        counted(vertices.empty_count, "vertex", at_vertices),
        counted(band.empty_count, "sampled voxel", in_band),
    ];
    sentences.into_iter().flatten().map(Warning::new).collect()
}

/// A warning about particles that the surface leaves out, if there are any.
pub(crate) fn left_out(report: &ReconstructionReport) -> Option<Warning> {
    let near = report.outlier_position.map(|near| {
        let [x, y, z] = near.to_array().map(significant);
        format!("; one is near ({x}, {y}, {z})")
    });
    let sentence = "{} left out: not finite, or too far from the origin or from the other particles"
        .to_owned()
        + &near.unwrap_or_default();
    let sentence = counted(report.dropped_count, "particle", &sentence)?;
    Some(Warning { is_flaw: true, ..Warning::of_frame(sentence) })
}

/// Warnings about obstacles and the smoothing.
fn solver_warnings(report: &ReconstructionReport) -> impl Iterator<Item = Warning> {
    let ReconstructionReport { contact, smoothing, .. } = report;
    // If the mesh of a container is only its inner side, the whole inside of the container is solid.
    let in_obstacles = if 2 * contact.particle_count > report.particle_count {
        "{} inside obstacles: the surface does not follow them there; if the obstacle is a container, give its walls a \
         thickness: otherwise all of it is solid"
    } else {
        "{} inside obstacles: the surface does not follow them there"
    };
    let in_obstacles = counted(contact.particle_count, "particle", in_obstacles).map(Warning::of_frame);
    let is_unconverged = smoothing.convergence.is_some_and(|convergence| !convergence.reached);
    let unconverged =
        is_unconverged.then(|| "the implicit solver did not converge to its tolerance".to_owned());
    let exceeded = "{} exceeded the CFL limit of one voxel per step";
    let exceeded = counted(smoothing.cfl_exceeded_count, "explicit step", exceeded);
    let of_steps = unconverged.into_iter().chain(exceeded);
    let of_steps = of_steps.map(|it| Warning::of_frame(it).with_remedy("choose a smaller --step-size"));
    in_obstacles.into_iter().chain(of_steps)
}

/// There is a warning if the rounding error of positions is greater than this, in voxels.
const ROUNDING_REPORTED_FROM: f64 = 1.0 / 256.0;

/// A warning about positions with a large rounding error, in files of which one has this format with world
/// positions.
pub(crate) fn coarse_positions(
    report: &ReconstructionReport,
    format: Option<OutputFormat>,
) -> Option<Warning> {
    let rounding = report.certificate.position_rounding;
    if rounding <= ROUNDING_REPORTED_FROM {
        return None;
    }
    let cause = format.map_or_else(
        || "parts of this frame lie so far apart that".to_owned(),
        |format| format!("a .{format} has world positions, so in all files of this frame"),
    );
    let warning = Warning::of_frame(format!(
        "{cause} the 32-bit positions of some vertices are off by up to {} voxels",
        significant(rounding)
    ));
    Some(Warning { remedy: format.map(|format| format!("leave {format} out of --format")), ..warning })
}

/// There is a warning if more than this fraction of the particles is outside.
const OUTSIDE_REPORTED_FROM: f64 = 0.02;

/// A warning about particles outside the surface, if an offset or position smoothing leaves more than a few
/// outside.
fn outside(report: &ReconstructionReport) -> Option<Warning> {
    let certificate = &report.certificate;
    let is_offset = certificate.may_leave_particles_outside;
    let is_smoothed = certificate.input_positions_outside.is_some();
    let by_offset = is_offset.then_some(certificate.particles_outside);
    let ParticlesOutside { count, .. } = certificate.input_positions_outside.or(by_offset)?;
    let particle_count = report.particle_count;
    let cause = match (is_offset, is_smoothed) {
        (true, true) => "an offset moved it inward, and positions were smoothed",
        (true, false) => "an offset moved it inward",
        (false, _) => "positions were smoothed",
    };
    (count as f64 > OUTSIDE_REPORTED_FROM * particle_count as f64).then(|| {
        let verb = if count == 1 { "is" } else { "are" };
        let particles = pluralize(particle_count, "particle");
        Warning::of_frame(format!("{count} of {particles} {verb} outside the surface: {cause}"))
    })
}

/// The failed checks.
fn violations(report: &ReconstructionReport) -> impl Iterator<Item = String> {
    let certificate = &report.certificate;
    let too_near = format!(
        "{{}} of the mesh too near to a particle (nearer than allowed by more than half a voxel); the smallest distance is \
         {} voxels",
        significant(certificate.vertex_distance_min)
    );
    let too_far = format!(
        "{{}} of the mesh too far from all particles (farther than allowed by more than half a voxel); the largest distance \
         is {} voxels",
        significant(certificate.vertex_distance_max)
    );
    let mesh = &report.mesh;
    let faults = [
        (mesh.boundary_edge_count, "boundary edge"),
        (mesh.non_manifold_edge_count, "non-manifold edge"),
        (mesh.non_manifold_vertex_count, "non-manifold vertex"),
        (mesh.degenerate_triangle_count, "triangle without area"),
    ];
    let faults: Vec<String> = faults.iter().filter_map(|(count, noun)| counted(*count, noun, "{}")).collect();
    let violations = [
        counted(certificate.bound_violation_count, "voxel", "the level set is outside its bounds at {}"),
        counted(certificate.vertices_inside_min, "vertex", &too_near),
        counted(certificate.vertices_outside_max, "vertex", &too_far),
        counted(certificate.particle_violation_count(), "particle", "{} outside the surface"),
        (!mesh.is_closed_manifold())
            .then(|| format!("the mesh is not closed and manifold: {}", faults.join(", "))),
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
