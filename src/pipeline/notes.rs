//! What a user should know of a frame though it was converted: `convert` prints it, and the daemon logs it.

use super::frame::FrameReport;
use crate::surface::report::{Shaping, SkinReport, TransferReport};
use crate::surface::validation::ParticlesOutside;
use crate::surface::words::{counted, rounded_down, significant};

/// What a user should know of a frame though it was converted, and of the frames after it as a rule.
pub fn standing_notes(report: &FrameReport) -> Vec<String> {
    let skin = &report.skin;
    let of_shapes = shape_notes(&skin.shaping, skin.particle_count);
    let of_attributes = skin.transfer.iter().flat_map(transfer_notes);
    report.notes.iter().cloned().chain(of_shapes).chain(of_attributes).collect()
}

/// What a user should know of this frame.
pub fn notes(report: &FrameReport) -> Vec<String> {
    let mut notes = Vec::new();
    let skin = &report.skin;
    notes.extend(left_out(skin));
    if skin.contact.particle_count > 0 {
        let particles = counted(skin.contact.particle_count, "particle");
        let is_most = 2 * skin.contact.particle_count > skin.particle_count;
        // The mesh of a container may be its inner side alone.
        let hint = if is_most { "; a container needs walls, or it is taken for full" } else { "" };
        notes.push(format!("{particles} inside obstacles: the surface goes around these all the same{hint}"));
    }
    if skin.convergence.is_some_and(|convergence| !convergence.reached) {
        notes.push("the conjugate gradients did not reach their tolerance".to_owned());
    }
    if skin.cfl_exceeded_count > 0 {
        notes.push(format!(
            "{} went beyond the CFL bound (Eq. 8): choose a smaller --step-size",
            counted(skin.cfl_exceeded_count, "explicit step")
        ));
    }
    if skin.certificate.position_rounding > POSITION_ROUNDING_TOLD {
        notes.push(format!(
            "parts of this frame lie so far apart that the 32-bit positions of some vertices are off by up to {} voxels",
            significant(skin.certificate.position_rounding)
        ));
    }
    notes.extend(outside(skin));
    notes.extend(broken(skin));
    notes
}

/// How many of the particles are outside the surface, where an offset or smoothed positions leave more than a few there.
fn outside(report: &SkinReport) -> Option<String> {
    let certificate = &report.certificate;
    let of_offset = certificate.may_leave_particles_outside.then_some(certificate.particles_outside);
    let ParticlesOutside { count, .. } = certificate.given_outside.or(of_offset)?;
    (count as f64 > OUTSIDE_TOLD * report.particle_count as f64).then(|| {
        format!(
            "{count} of {} are outside the surface: an offset moved it inward, or their positions were smoothed",
            counted(report.particle_count, "particle")
        )
    })
}

/// A larger part of the particles outside is worth a note.
const OUTSIDE_TOLD: f64 = 0.02;

/// What of this frame is not as it should be, whatever it was converted with: particles that were left out, and guarantees
/// that are broken.
pub fn flaws(report: &FrameReport) -> Vec<String> {
    left_out(&report.skin).into_iter().chain(broken(&report.skin)).collect()
}

/// Which particles are not in the surface, if any.
pub(super) fn left_out(report: &SkinReport) -> Option<String> {
    let left_out = counted(report.dropped_count, "particle");
    let at = report.stray.map_or(String::new(), |stray| {
        let [x, y, z] = stray.to_array().map(significant);
        format!("; one is near ({x}, {y}, {z})")
    });
    (report.dropped_count > 0).then(|| format!("{left_out} left out: not finite, or too far away{at}"))
}

fn broken(report: &SkinReport) -> impl Iterator<Item = String> {
    broken_guarantees(report).into_iter().map(|what| format!("{BREAKS_A_GUARANTEE}: {what}"))
}

/// How a note on a broken guarantee begins.
const BREAKS_A_GUARANTEE: &str = "the result breaks a guarantee";

/// Whether one of a frame's [flaws] is a broken guarantee.
pub fn breaks_guarantee(flaw: &str) -> bool {
    flaw.starts_with(BREAKS_A_GUARANTEE)
}

/// What a user should know of the shapes of particles. That stretched ones are raised to what the grid can hold is
/// nothing to tell: at the default radii nearly all are. Nor is it that some are not stretched: drops fly alone.
fn shape_notes(shaping: &Shaping, particle_count: usize) -> Vec<String> {
    let mut notes = Vec::new();
    let mut tell = |count: usize, what: &str| {
        if count > 0 {
            notes.push(format!("{} {what}", counted(count, "particle")));
        }
    };
    let holding = rounded_down(shaping.small_radius_min / 3f64.sqrt());
    let small =
        format!("too small for the grid: r_min = √3·h was taken; --voxel-size {holding} would hold them all");
    tell(shaping.small_radius_count, &small);
    tell(shaping.invalid_radius_count, "without a radius that is a positive number: the least was taken");
    tell(shaping.large_radius_count, "too large for the grid: the largest radius that it holds was taken");
    // Neighbours were looked at: then lone particles are no news.
    if shaping.near_count == 0 && 2 * shaping.ball_count > particle_count {
        tell(shaping.ball_count, "not stretched: no finite velocity");
    }
    notes
}

/// What a user should know of attributes on the surface.
fn transfer_notes(transfer: &TransferReport) -> Vec<String> {
    let mut notes = Vec::new();
    let TransferReport { vertices, band, .. } = transfer;
    let left_out = vertices.left_out_count.max(band.left_out_count);
    if left_out > 0 {
        let values = counted(left_out, "value");
        notes.push(format!("{values} of particles not finite: no part of the surface's attributes"));
    }
    if vertices.empty_count > 0 {
        let vertices = counted(vertices.empty_count, "vertex");
        notes.push(format!("{vertices} too far from all particles for attributes: 0, or none"));
    }
    if band.empty_count > 0 {
        let places = counted(band.empty_count, "place");
        notes.push(format!("{places} in the .vdb too far from all particles for attributes: 0"));
    }
    notes
}

/// Less is not worth a word, in voxels.
const POSITION_ROUNDING_TOLD: f64 = 1.0 / 256.0;

/// Whether all that is promised of a frame's result holds.
pub fn keeps_guarantees(report: &FrameReport) -> bool {
    report.skin.certificate.holds()
}

/// What does not hold of a frame's result; `None` where all does.
pub(super) fn fault(report: &SkinReport) -> Option<String> {
    (!report.certificate.holds()).then(|| does_not_hold(&report.certificate.fault()))
}

/// Says that the certificate of a frame does not hold.
pub(super) fn does_not_hold(fault: &str) -> String {
    format!("the certificate does not hold: {fault}")
}

/// A sentence for each guarantee that does not hold.
fn broken_guarantees(report: &SkinReport) -> Vec<String> {
    let certificate = &report.certificate;
    let mut broken = Vec::new();
    if certificate.bound_violation_count > 0 {
        let voxels = counted(certificate.bound_violation_count, "voxel");
        broken.push(format!("the level set leaves its bounds (Eq. 6) at {voxels}"));
    }
    if certificate.vertices_inside_min > 0 {
        broken.push(format!(
            "{} of the mesh nearer than r_min to a particle by more than half a voxel, the nearest at {} voxels",
            counted(certificate.vertices_inside_min, "vertex"),
            significant(certificate.vertex_distance_min)
        ));
    }
    if certificate.vertices_outside_max > 0 {
        broken.push(format!(
            "{} of the mesh farther than r_max from all particles by more than half a voxel, the farthest at {} voxels",
            counted(certificate.vertices_outside_max, "vertex"),
            significant(certificate.vertex_distance_max)
        ));
    }
    if certificate.particle_violation_count() > 0 {
        let particles = counted(certificate.particle_violation_count(), "particle");
        broken.push(format!("{particles} outside the surface"));
    }
    let mesh = &report.mesh;
    if !mesh.is_closed_manifold() {
        let faults = [
            (mesh.boundary_edge_count, "boundary edge"),
            (mesh.non_manifold_edge_count, "non-manifold edge"),
            (mesh.non_manifold_vertex_count, "non-manifold vertex"),
            (mesh.degenerate_triangle_count, "triangle without area"),
        ];
        let there = faults.iter().filter(|(count, _)| *count > 0);
        let there: Vec<String> = there.map(|(count, what)| counted(*count, what)).collect();
        broken.push(format!("the mesh is not closed and manifold: {}", there.join(", ")));
    }
    broken
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn guarantees_that_broke_are_sentences() {
        let mut report = FrameReport::default();
        assert_eq!(notes(&report), [""; 0]);
        report.skin.certificate.particles_outside.count = 2;
        report.skin.certificate.vertices_outside_max = 1;
        report.skin.certificate.vertex_distance_max = 7.25;
        report.skin.mesh.boundary_edge_count = 3;
        let notes = notes(&report);
        assert_eq!(notes.len(), 3, "{notes:?}");
        assert!(
            notes[0].contains("1 vertex of the mesh farther than r_max") && notes[0].contains("7.25 voxels")
        );
        assert!(notes[1].ends_with("2 particles outside the surface"));
        assert!(notes[2].ends_with("not closed and manifold: 3 boundary edges"));
    }
}
