//! Detects voxel sizes and radii that do not fit the particles.
//!
//! ```text
//!   ●   ●   ●      spheres that do not touch: drops; spheres that barely touch: a sponge, or many cavities
//!   ●▬●▬▬●  ●
//!   (●●●●●●●●)     spheres that overlap well: few holes, and nearly all in one piece, with or without spray
//! ```
//!
//! The diagnosis uses the actual surface. The spacing would be less reliable: for spray it is large, although
//! nothing is wrong.

use glam::Vec3;

use crate::surface::mesh::Mesh;
use crate::surface::options::{Settings, Start};
use crate::surface::report::ReconstructionReport;
use crate::surface::words::{pluralize, significant};

use crate::pipeline::warning::Warning;

/// A warning about a surface that is empty, fragmented, full of holes, or a single blob.
pub(crate) fn diagnose(mesh: &Mesh, report: &ReconstructionReport, settings: &Settings) -> Option<Warning> {
    // Own radii say how large the particles are, apart or not.
    let misfit = || match settings.per_particle_radius {
        Some(_) => None,
        None => misfit(mesh, report, settings.voxel_size),
    };
    why_empty(report, settings).or_else(misfit)
}

/// Why the surface of a frame with particles is empty.
fn why_empty(report: &ReconstructionReport, settings: &Settings) -> Option<Warning> {
    let ReconstructionReport { edits, contact, .. } = report;
    if report.particle_count == 0 || report.mesh.vertex_count > 0 {
        return None;
    }
    // Obstacles act first, then islands are removed, then the box clips. The last of these steps that removed
    // something is the cause, because a surface was left before it. So the steps are checked in reverse
    // order.
    Some(if edits.clipped_voxel_count > 0 {
        Warning::new("the clip box contains no part of the surface: the mesh is empty")
    } else if edits.island_count > 0 {
        Warning::new(
            "every piece of the surface was dropped because all have too few particles: the mesh is empty",
        )
    } else if contact.particle_count > 0 || contact.displaced_voxel_count > 0 {
        Warning::new("all of the surface is inside obstacles: the mesh is empty")
    } else {
        // A ball that the grid resolves always has voxels inside, so the balls of this frame are smaller, or an
        // offset moved their surface inward.
        let Settings { voxel_size, start, radius_min, radius_max, offset, .. } = *settings;
        let is_resolved = radius_min >= start.resolved_voxels() * voxel_size;
        if start == Start::Kernels || offset < 0.0 && is_resolved {
            let offset = significant(offset);
            let warning = format!("the offset {offset} removed the whole surface: the mesh is empty");
            return Some(Warning::new(warning).with_remedy(
                "use an --offset nearer to 0, or larger particles (--blend, or --radius-min with --preset paper)",
            ));
        }
        let [least, most] = [radius_min / voxel_size, radius_max / voxel_size].map(significant);
        Warning::new(format!(
            "all particles fall between the voxels: the mesh is empty; r_min and r_max are {least} and {most} voxels, and only \
             an r_min of at least √3 voxels encloses every particle"
        ))
        .with_remedy(format!(
            "use --radius-min {} or more",
            significant(Start::Spheres.resolved_voxels() * voxel_size)
        ))
    })
}

/// Detects voxels that do not fit the particles: most particles are isolated drops, the surface has too many
/// holes or pieces, or all of it is one blob.
fn misfit(mesh: &Mesh, report: &ReconstructionReport, voxel_size: f64) -> Option<Warning> {
    let ReconstructionReport { edits, contact, .. } = report;
    let particle_count = report.particle_count;
    let is_unedited = edits.clipped_voxel_count == 0
        && edits.island_count == 0
        && contact.particle_count == 0
        && contact.displaced_voxel_count == 0;
    if particle_count < CROWDED_NEIGHBORS || !is_unedited {
        return None;
    }
    let piece_count = report.mesh.component_count;
    if 2 * piece_count > particle_count {
        let warning = Warning::new(format!(
            "{particle_count} particles became {piece_count} pieces, most of one particle each: unless they really are spray, \
             the voxel size {} is too small for the particle spacing",
            significant(voxel_size)
        ));
        return Some(warning.with_remedy(CHECK_SPACING));
    }
    fragmented(mesh, report, voxel_size).or_else(|| {
        is_blob(mesh, report, voxel_size).then(|| {
            Warning::new(format!(
                "all of the {particle_count} particles are within {BLOB_VOXELS} voxels: the voxel size {} is too large for them",
                significant(voxel_size)
            ))
            .with_remedy(CHECK_SPACING)
        })
    })
}

const CHECK_SPACING: &str =
    "check --spacing and --voxel-size, or leave them out: then the spacing is measured";

const CLOSE_HOLES: &str = "check --spacing, --voxel-size and --neighbor-radius, or leave them out; a larger --blend, such as \
                           2.4d, closes more of them, and with --preset paper --radius-min 0.87d";

/// The warning about a surface whose spheres seem not to overlap: it has too many holes or pieces.
fn fragmented(mesh: &Mesh, report: &ReconstructionReport, voxel_size: f64) -> Option<Warning> {
    let (particle_count, measures) = (report.particle_count, &report.mesh);
    let few_pieces = particle_count / HOLED_ONE_IN;
    let few_holes = few_pieces.max(FEW_HOLES);
    // The number of handles (the genus) of all components together, from the Euler characteristic.
    // Meaningless for an open mesh.
    let handle_count = (2 * measures.component_count as i64 - measures.euler_characteristic) / 2;
    let handle_count = usize::try_from(handle_count).unwrap_or(0);
    let is_intact = measures.component_count <= few_pieces && handle_count <= few_holes;
    if is_intact || !measures.is_closed_manifold() {
        return None;
    }
    let volumes = mesh.component_volumes();
    let hollow_count = volumes.iter().filter(|volume| **volume < 0.0).count();
    let hole_count = hollow_count + handle_count;
    if hole_count > few_holes {
        let warning = Warning::new(format!(
            "the surface of {particle_count} particles has {}: unless the fluid really has them, the voxel size {} or --blend \
             is too small for the particle spacing",
            pluralize(hole_count, "hole"),
            significant(voxel_size)
        ));
        return Some(warning.with_remedy(CLOSE_HOLES));
    }
    let filled = || volumes.iter().copied().filter(|volume| *volume > 0.0);
    let piece_count = filled().count();
    let is_torn = piece_count > particle_count / PIECES_ONE_IN
        && 2.0 * filled().fold(0.0, f64::max) < filled().sum::<f64>();
    is_torn.then(|| {
        Warning::new(format!(
            "{particle_count} particles became {piece_count} pieces, none with half of the volume: unless they really are \
             spray, the voxel size {} or the blend is too small for the particle spacing",
            significant(voxel_size)
        ))
        .with_remedy(CLOSE_HOLES)
    })
}

/// Whether all particles are in one blob that is hardly larger than the ball of a single particle.
fn is_blob(mesh: &Mesh, report: &ReconstructionReport, voxel_size: f64) -> bool {
    if mesh.positions.is_empty() || mesh.positions.len() > BLOB_VERTICES {
        return false;
    }
    let low = mesh.positions.iter().copied().reduce(Vec3::min).unwrap_or_default();
    let high = mesh.positions.iter().copied().reduce(Vec3::max).unwrap_or_default();
    let width = f64::from((high - low).max_element()) / voxel_size;
    width - 2.0 * report.certificate.vertex_distance_min <= BLOB_VOXELS
}

/// Frames with fewer particles get none of these warnings: such particles may well be separate drops, or a
/// single drop.
const CROWDED_NEIGHBORS: usize = 33;

/// A surface with more than one hole per this number of particles has too many. For comparison: if the voxel
/// size is half the spacing, even randomly placed particles have a surface without holes.
const HOLED_ONE_IN: usize = 50;

/// A surface with up to this number of holes never has too many: rings, shells and jugs have a few by design.
const FEW_HOLES: usize = 8;

/// A surface with more than one piece per this number of particles is fragmented if no piece has half of the
/// volume.
const PIECES_ONE_IN: usize = 8;

/// The largest width of a blob in voxels, without the balls around its particles, and its largest number of
/// vertices.
const BLOB_VOXELS: f64 = 4.0;
const BLOB_VERTICES: usize = 1 << 12;
