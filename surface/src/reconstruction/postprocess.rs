//! Postprocessing: from the smoothed level set to the validated mesh.
//!
//! ```text
//!   φ ──offset, obstacles──▶ φ ──islands, cavities, box──▶ φ ──contour──▶ mesh ─┐
//!      ┌─────────────────────────────────────────────────────────────────────────┘
//!      └─obstacles──▶ mesh ──decimate──▶ mesh ──▶ validate
//! ```
//!
//! Validation checks the mesh as it will be written: after decimation, and with rounded positions. If a vertex
//! violates its bounds, it is moved back; if a triangle has no area, it is removed. The mesh is then checked
//! again.
//!
//! The bounds of smoothing are checked before φ is edited here.
//!
//! All removals are counted and excluded from validation: particles in dropped islands, and spheres that a
//! box or an obstacle cuts.

use glam::{DVec3, IVec3, Vec3};

use super::RasterParams;
use crate::contour::{self, Contouring};
use crate::edits::{self, DroppedIslands};
use crate::grid::{LEAF_EDGE, LeafMask, offset_in_leaf};
use crate::level_set::{NarrowBand, offset_surface};
use crate::mesh::{Mesh, PositionRounding, decimate};
use crate::obstacle::{ObstacleLeaf, cut_off_at_obstacles, edge_clearance, edge_rounding};
use crate::options::Settings;
use crate::rasterize::Radii;
use crate::report::{DepthStats, EditReport, ReconstructionReport};
use crate::space::Lattice;
use crate::validation::{Certificate, Checks, ExclusionMask, certificate};

/// What edits removed from the level set.
#[derive(Default)]
pub(super) struct Edits {
    islands: Option<DroppedIslands>,
    clip: Option<edits::VoxelClip>,
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
    scene: &RasterParams,
    settings: &Settings,
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
        report.cavity_count = filled.count;
        report.cavity_voxel_count = filled.voxel_count;
    }
    if let Some(clip) = &settings.clip {
        let clip = edits::VoxelClip { min: DVec3::from(clip.min), max: DVec3::from(clip.max) };
        report.clipped_voxel_count = edits::clip(band, &scene.lattice, &clip).voxel_count;
        edits.clip = Some(clip);
    }
    edits
}

/// Extracts the mesh of a level set.
pub(super) fn contour(band: &NarrowBand, lattice: &Lattice, settings: &Settings) -> Mesh {
    let mut mesh = contour::contour(band, lattice, settings.contouring);
    if settings.refine && settings.contouring == Contouring::Dual {
        contour::refine(&mut mesh, band, lattice);
    }
    mesh
}

/// Extracts the mesh of the level set, and moves its vertices out of obstacles and into the clip box.
pub(super) fn mesh(
    band: &NarrowBand,
    edits: &Edits,
    scene: &RasterParams,
    settings: &Settings,
    depth: &mut DepthStats,
) -> Mesh {
    let mut mesh = contour(band, &scene.lattice, settings);
    if !scene.obstacles.is_empty() {
        *depth = scene.obstacles.move_vertices_out(&mut mesh, &scene.lattice, scene.obstacle_half_width());
    }
    if let Some(clip) = &edits.clip {
        clip.clamp_mesh(&mut mesh);
    }
    mesh
}

/// Maximum number of rounds that move vertices back into their bounds. Vertices that are still outside after
/// these rounds are reported as violations.
const CLAMP_ROUNDS_MAX: usize = 3;

/// Replaces the mesh by the one that is written, validates it with `validate`, and writes the certificate into
/// the report. The second argument of `validate` is the largest distance by which rounding moved a vertex, in
/// voxels. `radii` are those of the particles, and `None` for surfaces of level sets.
///
/// # Errors
/// Returns the errors of `validate`.
pub(super) fn finalize<E>(
    mesh: &mut Mesh,
    settings: &Settings,
    radii: Option<&Radii>,
    rounding: PositionRounding,
    report: &mut ReconstructionReport,
    mut validate: impl FnMut(&Mesh, f32) -> Result<Checks, E>,
) -> Result<(), E> {
    let voxel_size = settings.voxel_size;
    if settings.decimate > 0.0 {
        let decimated = decimate(mesh, settings.decimate * voxel_size);
        report.edits.removed_triangle_count = decimated.removed_triangle_count;
        report.edits.decimation_error_voxels = decimated.error_world_max / voxel_size;
    }
    let moved_voxels = (mesh.round(rounding) / voxel_size) as f32;
    report.flat_triangles_removed = mesh.remove_flat_triangles();
    let mut checks = validate(mesh, moved_voxels)?;
    for _ in 0..CLAMP_ROUNDS_MAX {
        if checks.violations.is_empty() {
            break;
        }
        report.vertices_clamped += checks.violations.len();
        for violation in &checks.violations {
            mesh.positions[violation.vertex] = violation.position;
            mesh.normals[violation.vertex] = Vec3::ZERO;
        }
        mesh.round(rounding);
        contour::fill_zero_normals(mesh);
        report.flat_triangles_removed += mesh.remove_flat_triangles();
        checks = validate(mesh, moved_voxels)?;
    }
    report.mesh = mesh.measure();
    report.certificate = Certificate {
        bound_violation_count: report.certificate.bound_violation_count,
        particles_left_out: report.dropped_count,
        offset: settings.offset,
        position_rounding: mesh.rounding_error(rounding) / voxel_size,
        ..certificate(&checks.particles, radii, &report.mesh, voxel_size)
    };
    if settings.smooth_normals > 0 {
        mesh.smooth_normals(settings.smooth_normals);
    }
    Ok(())
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
