//! Checks every result before it is written. The certificate of a frame has the results.
//!
//! ```text
//!   φ within its bounds at every voxel                    (Eq. 6), before the surface is moved by an offset
//!   no vertex deeper inside S_min than h/2                the surface stays outside S_min and inside S_max,
//!   no vertex farther outside S_max than h/2              except for the interpolation error within a cell
//!   every particle inside
//!   the mesh closed and 2-manifold
//! ```
//!
//! The mesh is checked as it is written: after decimation, and with rounded positions.
//!
//! A surface that is moved outward by b is farther from S_min by b, and farther from S_max by at most b. A
//! surface that is moved inward by b is closer to S_min by b, but may be as close to S_max as before:
//!
//! ```text
//!    S_max ╲   ╱ S_max       Where two spheres meet, a point b deep inside their union is less deep in each.
//!           ╲ ╱
//!    moved ──×── inward by b
//! ```
//!
//! The tolerance of half a voxel is the interpolation error within a cell: the bounds hold at voxels, and a
//! sphere is curved between them.

mod bound_violations;
mod containment;
mod distances;
mod input_positions;
mod mesh_cells;
mod particle_checks;
mod rays;
mod surfaces;

use glam::{DVec3, IVec3, Vec3};

pub use bound_violations::BoundViolation;
pub use input_positions::{
    MovedParticle, count_inputs_outside, count_inputs_outside_of_source, possibly_outside,
};
pub use mesh_cells::MeshCells;
pub use particle_checks::{CheckedRegion, Checks, ParticleChecks, check};

use crate::mesh::MeshMeasures;
use crate::rasterize::Radii;
use crate::words::pluralize;

/// The results of the checks of the finished surface. [`holds`](Self::holds) says whether it passed all of
/// them, and [`violations`](Self::violations) which ones failed. Distances are to the centre of the nearest
/// particle, in voxels unless a field says world units. For particles with their own shapes, r_min and r_max
/// mean their inner and outer ellipsoids.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
#[non_exhaustive]
pub struct Certificate {
    /// Voxels where φ violates its bounds (Eq. 6), before the surface is offset. Always 0.
    pub bound_violation_count: usize,
    /// Number of dropped particles, as in `Report::dropped_count`: not finite, or too far from the others.
    pub particles_left_out: usize,
    /// Smallest distance from a mesh vertex to a particle; infinite for an empty mesh.
    pub vertex_distance_min: f64,
    /// Largest distance from a mesh vertex to its nearest particle; 0 for an empty mesh.
    pub vertex_distance_max: f64,
    /// How far the surface was moved outward after its bounds were checked, world units; negative values mean
    /// inward.
    pub offset: f64,
    /// The smallest and the largest allowed distance from a vertex to its nearest particle, world units:
    /// r_min and r_max plus the offset. `None` for surfaces of level sets.
    pub distance_limits: Option<[f64; 2]>,
    /// Mesh vertices closer to a particle than the first limit by more than h/2.
    pub vertices_inside_min: usize,
    /// Mesh vertices farther from all particles than the second limit by more than h/2.
    pub vertices_outside_max: usize,
    /// Particles outside the mesh, except exempt ones.
    pub particles_outside: ParticlesOutside,
    /// Whether the inward offset is so large that particles may end up outside: these are counted, but
    /// fail no check.
    pub may_leave_particles_outside: bool,
    /// If position smoothing moved the particles before they were checked: the particles whose input position
    /// is outside the surface. They fail no check. `None` if particles were not moved.
    pub input_positions_outside: Option<ParticlesOutside>,
    /// Exempt particles: in a dropped island, outside a clip box or next to its faces, inside an obstacle or
    /// next to it. Only those near a surface are counted.
    pub particles_exempt: usize,
    /// Whether every edge is in two triangles, the triangles around every vertex form one ring, and no
    /// triangle is degenerate.
    pub mesh_is_closed_manifold: bool,
    /// Rounding error of 32-bit positions, in voxels: large only if part of a frame is tens of thousands of
    /// voxels from the rest, or from the world origin if a file has world positions.
    pub position_rounding: f64,
}

impl Certificate {
    /// Whether the surface passed all checks.
    pub fn holds(&self) -> bool {
        self.bound_violation_count == 0
            && self.vertices_inside_min == 0
            && self.vertices_outside_max == 0
            && self.particle_violation_count() == 0
            && self.mesh_is_closed_manifold
    }

    /// Number of particles outside that fail the check.
    pub fn particle_violation_count(&self) -> usize {
        if self.may_leave_particles_outside { 0 } else { self.particles_outside.count }
    }

    /// The failed checks as text; empty if the surface passed all.
    pub fn violations(&self) -> String {
        let mut faults = Vec::new();
        if self.bound_violation_count > 0 {
            faults.push(format!(
                "the level set is outside its bounds (distances to the r_min and r_max spheres) at {}",
                pluralize(self.bound_violation_count, "voxel")
            ));
        }
        let counts = [
            (self.vertices_inside_min, "vertex", "too near to particles"),
            (self.vertices_outside_max, "vertex", "too far from particles"),
            (self.particle_violation_count(), "particle", "outside"),
        ];
        let counts = counts.into_iter().filter(|&(count, ..)| count > 0);
        faults.extend(counts.map(|(count, noun, what)| format!("{} {what}", pluralize(count, noun))));
        if !self.mesh_is_closed_manifold {
            faults.push("the mesh is not a closed 2-manifold".to_owned());
        }
        faults.join(", ")
    }
}

/// The number of particles outside a surface, and how far.
#[derive(serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields)]
#[derive(Clone, Copy, Debug, Default, PartialEq)]
#[non_exhaustive]
pub struct ParticlesOutside {
    /// Number of particles.
    pub count: usize,
    /// Distance from the surface of the particle that is farthest outside, world units; 0 if all are inside.
    /// The distance comes from φ, which is limited to the half width of its band: five voxels or more.
    pub deepest: f64,
}

/// Regions of a result that are not checked because they were removed on purpose.
pub trait ExclusionMask: Sync {
    /// Whether nothing is excluded, so that everything is checked.
    fn is_empty(&self) -> bool;

    /// Whether a particle, in voxels relative to the origin of its leaf, may be outside.
    fn particle(&self, leaf_origin: IVec3, local: Vec3) -> bool;

    /// Whether a vertex, in voxels, may violate the distance limits.
    fn vertex(&self, index: DVec3) -> bool;
}

/// Checks everything.
#[derive(Clone, Copy, Debug)]
pub struct NoExclusions;

impl ExclusionMask for NoExclusions {
    fn is_empty(&self) -> bool {
        true
    }

    fn particle(&self, _: IVec3, _: Vec3) -> bool {
        false
    }

    fn vertex(&self, _: DVec3) -> bool {
        false
    }
}

/// The results of these checks as a certificate. `radii` are those of the particles, and `None` for surfaces of
/// level sets.
pub fn certificate(
    checks: &ParticleChecks,
    radii: Option<&Radii>,
    measures: &MeshMeasures,
    voxel_size: f64,
) -> Certificate {
    let distance_limits = radii.map(|radii| DistanceLimits::new(radii).limits());
    Certificate {
        mesh_is_closed_manifold: measures.is_closed_manifold(),
        vertex_distance_min: f64::from(checks.vertex_distance_min),
        vertex_distance_max: f64::from(checks.vertex_distance_max),
        distance_limits: distance_limits.map(|limits| limits.map(|limit| f64::from(limit) * voxel_size)),
        vertices_inside_min: checks.vertices_inside_min,
        vertices_outside_max: checks.vertices_outside_max,
        particles_outside: ParticlesOutside {
            count: checks.particles_outside,
            deepest: f64::from(checks.deepest_outside) * voxel_size,
        },
        may_leave_particles_outside: radii.is_some_and(may_leave_particles_outside),
        particles_exempt: checks.particles_exempt,
        ..Certificate::default()
    }
}

/// Whether the inward offset is so large that a particle may end up outside: the corners of the cell that
/// contains the particle need not all be inside.
fn may_leave_particles_outside(radii: &Radii) -> bool {
    radii.offset < 0.0 && radii.depth_min() <= SURE_DEPTH
}

/// A ball of this radius, in voxels, contains all corners of the cell around its centre: √3. In a smaller
/// ball a corner of the cell may be outside.
const SURE_DEPTH: f32 = 1.732_051;

/// The limits of the distance between a vertex and the particles.
#[derive(Clone, Copy, Debug, PartialEq)]
struct DistanceLimits {
    /// The radii of the inner and the outer spheres, in voxels: the units of semi-axes.
    radii: [f32; 2],
    /// The smallest offset from the inner spheres and the largest from the outer ones, outward, in voxels.
    from_spheres: [f32; 2],
}

impl DistanceLimits {
    fn new(radii: &Radii) -> DistanceLimits {
        DistanceLimits { radii: [radii.min, radii.max], from_spheres: [radii.offset, radii.outward()] }
    }

    /// The distance limits from particle centres, if all semi-axes are 1.
    fn limits(&self) -> [f32; 2] {
        let [min, max] = self.radii;
        let [from_min, from_max] = self.from_spheres;
        [(min + from_min).max(0.0), max + from_max]
    }

    /// The same limits, relaxed by `margin` voxels.
    fn with_margin(self, margin: f32) -> DistanceLimits {
        let [from_min, from_max] = self.from_spheres;
        DistanceLimits { from_spheres: [from_min - margin, from_max + margin], ..self }
    }
}
