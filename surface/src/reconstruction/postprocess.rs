//! Postprocessing: from the smoothed level set to the validated mesh.
//!
//! ```text
//!   φ ──offset, obstacles──▶ φ ──islands, cavities, box──▶ φ ──contour──▶ mesh ─┐
//!      ┌─────────────────────────────────────────────────────────────────────────┘
//!      └─obstacles──▶ mesh ──decimate──▶ mesh ──▶ validate
//! ```
//!
//! Validation checks the mesh as it will be written: after decimation, and with positions rounded as in each
//! file format. If a vertex violates its bounds, it is moved back; if a triangle has no area, it is removed.
//! The mesh is then checked again.
//!
//! The bounds of smoothing are checked before φ is edited here.
//!
//! All removals are counted and excluded from validation: particles in dropped islands, and spheres that a
//! box or an obstacle cuts.

use std::collections::BTreeMap;

use glam::{DVec3, IVec3, Vec3};
use rayon::prelude::*;

use super::{RasterParams, lattice};
use crate::contour;
use crate::edits::{self, DroppedIslands};
use crate::grid::{LEAF_EDGE, LeafMask, offset_in_leaf};
use crate::level_set::{NarrowBand, offset_surface};
use crate::mesh::{Mesh, RoundedPositions, decimate};
use crate::obstacle::{ObstacleLeaf, cut_off_at_obstacles, edge_clearance, edge_rounding};
use crate::options::Settings;
use crate::parallel::Loops as _;
use crate::report::{DepthStats, EditReport, ReconstructionReport};
use crate::validation::{self, CheckedRegion, ExclusionMask, ParticleChecks};

/// What edits removed from the level set.
#[derive(Default)]
pub(super) struct Edits {
    islands: Option<DroppedIslands>,
    clip: Option<edits::VoxelClip>,
}

/// True if the settings request any edit.
pub(super) fn has_edits(settings: &Settings) -> bool {
    settings.drop_islands > 0 || settings.fill_cavities > 0.0 || settings.clip.is_some()
}

/// Moves the surface by the offset, and cuts it off at the obstacles, if there are any.
pub(super) fn offset_and_cut(band: &mut NarrowBand, scene: &RasterParams) {
    let radii = scene.radii;
    if radii.offset != 0.0 {
        offset_surface(band, radii.offset, radii.result_half_width());
    }
    if !scene.obstacles.is_empty() {
        cut_off_at_obstacles(|origin| scene.obstacle(origin), edge_rounding(radii.depth_min()), band);
    }
}

/// Applies the edits in the settings. `particles` yields the origin of each leaf and its particles, in voxels
/// relative to that origin.
pub(super) fn edit<P: AsRef<[Vec3]>>(
    band: &mut NarrowBand,
    particles: impl IntoIterator<Item = (IVec3, P)>,
    (scene, settings): (&RasterParams, &Settings),
    report: &mut EditReport,
) -> Edits {
    let mut edits = Edits::default();
    if settings.drop_islands > 0 {
        let dropped = edits::drop_islands(band, u64::from(settings.drop_islands), particles);
        report.island_count = dropped.piece_count;
        report.island_particle_count = dropped.particle_count;
        edits.islands = Some(dropped);
    }
    if settings.fill_cavities > 0.0 {
        // Space that an obstacle occupies is not a cavity.
        let kept = |origin: IVec3| match scene.obstacle(origin) {
            ObstacleLeaf::Outside => LeafMask::EMPTY,
            ObstacleLeaf::Inside => LeafMask::FULL,
            ObstacleLeaf::Near(distances) => LeafMask::from_fn(|offset| distances.values[offset] < 0.0),
        };
        let kept: Option<&dyn Fn(IVec3) -> LeafMask> =
            if scene.obstacles.is_empty() { None } else { Some(&kept) };
        let filled = edits::fill_cavities(band, settings.fill_cavities, kept);
        report.cavity_count = filled.cavity_count;
        report.cavity_voxel_count = filled.voxel_count;
    }
    if let Some(clip) = &settings.clip {
        let clip = edits::VoxelClip { min: DVec3::from(clip.min), max: DVec3::from(clip.max) };
        report.clipped_voxel_count = edits::clip(band, &scene.lattice, &clip).voxel_count;
        edits.clip = Some(clip);
    }
    edits
}

/// Extracts the mesh of the level set, and moves its vertices out of obstacles and into the clip box.
pub(super) fn mesh(
    band: &NarrowBand,
    edits: &Edits,
    (scene, settings): (&RasterParams, &Settings),
    depth: &mut DepthStats,
) -> Mesh {
    let mut mesh = contour::contour(band, &scene.lattice, settings.contouring);
    if !scene.obstacles.is_empty() {
        *depth = scene.obstacles.move_vertices_out(&mut mesh, &scene.lattice, scene.obstacle_half_width());
    }
    if let Some(clip) = &edits.clip {
        clip.clamp_mesh(&mut mesh);
    }
    mesh
}

/// How a file stores the positions of a mesh.
#[derive(Clone, Copy, Debug)]
pub enum PositionFormat {
    /// Unchanged: 32 bits, relative to the mesh's origin.
    Exact,
    /// With this rounding.
    Rounded(RoundedPositions),
}

/// If a file moves vertices by more than this, in voxels, the mesh is not adapted to its rounding, unless all
/// files do.
const FINE_VOXELS_MAX: f64 = 0.125;

/// Maximum number of rounds that move vertices back into their bounds. Vertices that are still outside after
/// these rounds are reported as violations.
const CLAMP_ROUNDS_MAX: usize = 3;

/// Replaces the mesh by the one that is written, and validates it part by part, as each file stores it.
///
/// # Errors
/// Returns the errors of `each_part`.
pub(super) fn finalize<E>(
    mesh: &mut Mesh,
    (settings, stored): (&Settings, &[PositionFormat]),
    report: &mut ReconstructionReport,
    mut each_part: impl FnMut(&StoredMesh, &mut dyn FnMut(&CheckedRegion)) -> Result<(), E>,
) -> Result<ParticleChecks, E> {
    let lattice = lattice(settings);
    if settings.decimate > 0.0 {
        let decimated = decimate(mesh, settings.decimate * lattice.voxel_size);
        report.edits.removed_triangle_count = decimated.removed_triangle_count;
        report.edits.decimation_error_voxels = decimated.error_world_max / lattice.voxel_size;
    }
    let rounding = |stored: &PositionFormat| match stored {
        PositionFormat::Exact => None,
        PositionFormat::Rounded(rounding) => Some(*rounding),
    };
    let moved_voxels = |mesh: &Mesh, rounded: &[Vec3]| {
        let moved = rounded.par_iter().zip(&mesh.positions).halved().map(|(one, other)| one.distance(*other));
        f64::from(moved.reduce(|| 0.0, f32::max)) / lattice.voxel_size
    };
    // A file that rounds coarsely must not spoil the mesh of the others: it only fails validation.
    let is_fine = |stored: &PositionFormat| {
        rounding(stored).is_none_or(|rounding| moved_voxels(mesh, &mesh.rounded(rounding)) <= FINE_VOXELS_MAX)
    };
    let are_fine: Vec<bool> = stored.iter().map(is_fine).collect();
    let adapts = |index: usize| are_fine[index] || !are_fine.contains(&true);
    let adapted = stored.iter().enumerate().filter(|(index, _)| adapts(*index));
    let roundings: Vec<RoundedPositions> = adapted.filter_map(|(_, stored)| rounding(stored)).collect();
    report.flat_triangles_removed = mesh.remove_flat_triangles(&roundings);
    let has_unrounded = stored.iter().any(|stored| rounding(stored).is_none());
    let mut checks = ParticleChecks::EMPTY;
    for returns in 0..=CLAMP_ROUNDS_MAX {
        checks = ParticleChecks::EMPTY;
        let mut corrections: BTreeMap<usize, Vec3> = BTreeMap::new();
        for (index, stored) in stored.iter().enumerate() {
            let mut of_file = ParticleChecks::EMPTY;
            let mut rounded = rounding(stored).map(|rounding| mesh.rounded(rounding));
            // If rounding changes nothing, the check of the unrounded mesh suffices.
            if has_unrounded && rounded.as_ref().is_some_and(|rounded| *rounded == mesh.positions) {
                continue;
            }
            let moved_voxels = rounded.as_ref().map_or(0.0, |rounded| moved_voxels(mesh, rounded));
            if let Some(rounded) = &mut rounded {
                std::mem::swap(rounded, &mut mesh.positions);
            }
            let checked = StoredMesh { mesh, rounding: moved_voxels as f32 };
            let parts = each_part(&checked, &mut |part| {
                let (of_part, found) = validation::check(part);
                of_file = of_file.merge(of_part);
                let found = found.into_iter().filter(|_| adapts(index));
                corrections.extend(found.map(|violation| (violation.vertex, violation.position)));
            });
            if let Some(rounded) = &mut rounded {
                std::mem::swap(rounded, &mut mesh.positions);
            }
            parts?;
            checks = checks.worst_of(of_file);
        }
        if corrections.is_empty() || returns == CLAMP_ROUNDS_MAX {
            break;
        }
        report.vertices_clamped += corrections.len();
        for (vertex, position) in corrections {
            mesh.positions[vertex] = position;
            mesh.normals[vertex] = Vec3::ZERO;
        }
        contour::fill_zero_normals(mesh);
        report.flat_triangles_removed += mesh.remove_flat_triangles(&roundings);
    }
    report.mesh = mesh.measure();
    for rounding in stored.iter().filter_map(rounding) {
        let flat_count = &mut report.mesh.degenerate_triangle_count;
        *flat_count = mesh.flat_count(rounding).max(*flat_count);
    }
    if settings.smooth_normals > 0 {
        mesh.smooth_normals(settings.smooth_normals);
    }
    Ok(checks)
}

/// A mesh as a file stores it.
pub(super) struct StoredMesh<'a> {
    pub(super) mesh: &'a Mesh,
    /// Maximum distance by which the file's rounding moves vertices, in voxels.
    pub(super) rounding: f32,
}

/// What validation skips.
pub(super) struct SurfaceExclusions<'a> {
    pub(super) scene: &'a RasterParams<'a>,
    pub(super) edits: &'a Edits,
}

impl ExclusionMask for SurfaceExclusions<'_> {
    fn is_empty(&self) -> bool {
        self.scene.obstacles.is_empty() && self.edits.islands.is_none() && self.edits.clip.is_none()
    }

    fn particle(&self, leaf_origin: IVec3, local: Vec3) -> bool {
        let is_dropped =
            self.edits.islands.as_ref().is_some_and(|islands| islands.contains(leaf_origin, local));
        let index = leaf_origin.as_dvec3() + local.as_dvec3();
        is_dropped || self.is_near_cut(index) || self.obstacle_distance(index) < self.particle_margin()
    }

    fn vertex(&self, index: DVec3) -> bool {
        // An outward offset also moves the part of the surface that obstacles affected, by this much.
        let margin = self.scene.void_threshold + VERTEX_MARGIN + self.scene.radii.outward();
        self.is_near_cut(index) || self.obstacle_distance(index) < margin
    }
}

/// The largest distance from a position to its nearest voxel, in voxels.
const HALF_DIAGONAL: f32 = 0.867;

/// Obstacles do not affect vertices farther from them than the widest filled gap plus this margin, in voxels.
const VERTEX_MARGIN: f32 = 2.0;

impl SurfaceExclusions<'_> {
    /// An obstacle does not affect a particle if the voxel nearest to it is at least this far from the obstacle,
    /// in voxels. The surface is interpolated between voxels, where it is less deep than at the particle.
    fn particle_margin(&self) -> f32 {
        edge_clearance(self.scene.radii.depth_min() - HALF_DIAGONAL) + HALF_DIAGONAL
    }

    /// True if a position, in voxels, is outside the box or within a voxel of its faces.
    fn is_near_cut(&self, index: DVec3) -> bool {
        let voxel_size = self.scene.lattice.voxel_size;
        self.edits.clip.as_ref().is_some_and(|clip| clip.distance(index * voxel_size) > -voxel_size)
    }

    /// Signed distance to the obstacles at the voxel nearest to a position, in voxels.
    fn obstacle_distance(&self, index: DVec3) -> f32 {
        if self.scene.obstacles.is_empty() {
            return f32::INFINITY;
        }
        let voxel = index.round().as_ivec3();
        let local = voxel & IVec3::splat(LEAF_EDGE - 1);
        match self.scene.obstacle(voxel - local) {
            ObstacleLeaf::Outside => f32::INFINITY,
            ObstacleLeaf::Inside => f32::NEG_INFINITY,
            ObstacleLeaf::Near(distances) => distances.values[offset_in_leaf(local)],
        }
    }
}
