//! What is checked of every result before it leaves: a certificate that ships with the frame.
//!
//! ```text
//!   φ within its bounds at every voxel                    (Eq. 6), before the surface is moved by an offset
//!   no vertex deeper inside S_min than h/2                the surface stays outside of it
//!   none farther outside of S_max than h/2                and inside of this, but for what a cell hides
//!   every particle inside
//!   the mesh closed and 2-manifold
//! ```
//!
//! What is said of vertices, of particles and of the mesh is said of the mesh as a file has it: with the triangles that are
//! left, at the positions that a reader gets.
//!
//! A surface that is moved outward by an offset is that much farther from S_min, and so much farther from S_max at most. One that is
//! moved inward is that much nearer to S_min, and no less near to S_max:
//!
//! ```text
//!    S_max ╲   ╱ S_max       Where two spheres meet, what is b deep in their union is less deep in each of them.
//!           ╲ ╱
//!    moved ──×── inward by b
//! ```
//!
//! The half voxel is what interpolation inside a cell may hide: the bounds hold at voxels, and a sphere bends between
//! them.

mod containment;
mod distances;
mod given;
mod mesh_cells;
mod particle_checks;
mod rays;
mod strays;
mod surfaces;

use glam::{DVec3, IVec3, Vec3};
use rayon::prelude::*;

pub use given::{GivenPlace, doubtful_places, given_outside, given_outside_of};
pub use mesh_cells::MeshCells;
pub use particle_checks::{Part, ParticleChecks, check};
pub use strays::Stray;

use crate::surface::mesh::{Mesh, MeshMeasures};
use crate::surface::rasterize::Radii;
use crate::surface::space::Lattice;

/// What was checked of the finished surface: [`holds`](Self::holds) says whether all of it is as guaranteed, and
/// [`fault`](Self::fault) what is not. Distances are in voxels unless a field says world units, to the nearest particle's centre. For
/// particles with shapes of their own, r_min and r_max mean their surfaces.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
#[non_exhaustive]
pub struct Certificate {
    /// Voxels where φ leaves its bounds (Eq. 6), before the surface is moved by an offset. Always 0.
    pub bound_violation_count: usize,
    /// Particles that were left out of the surface: not finite, or too far from the others.
    pub particles_left_out: usize,
    /// Least distance from a mesh vertex to a particle; infinite for an empty mesh.
    pub vertex_distance_min: f64,
    /// Largest distance from a mesh vertex to its nearest particle; 0 for an empty mesh.
    pub vertex_distance_max: f64,
    /// How far the surface was moved outward after its bounds were checked, world units; negative inward.
    pub offset: f64,
    /// How near to a particle vertices may be, and how far from all of them, world units: r_min and r_max, moved by the offset.
    /// `None` for surfaces of level sets.
    pub distance_limits: Option<[f64; 2]>,
    /// Mesh vertices nearer to a particle than the first limit by more than h/2.
    pub vertices_inside_min: usize,
    /// Mesh vertices farther from all particles than the second limit by more than h/2.
    pub vertices_outside_max: usize,
    /// Particles outside the mesh, but for those that are exempt.
    pub particles_outside: ParticlesOutside,
    /// Whether the surface was moved inward so far that particles may be outside of it: they are counted, and break no guarantee.
    pub may_leave_particles_outside: bool,
    /// Where the particles that were checked are not those that were given, but moved toward their neighbours: the particles
    /// that were given outside the surface. They break no guarantee. `None` where particles are where they were given.
    pub given_outside: Option<ParticlesOutside>,
    /// Particles that were not asked: in an island that was dropped, beyond a box or beside its faces, in an obstacle or
    /// beside it. Only those near a surface are known.
    pub particles_exempt: usize,
    /// Whether every edge is in two triangles, every vertex in one ring of them, and none degenerate.
    pub mesh_is_closed_manifold: bool,
    /// How far 32-bit positions may be off, in voxels: much only where part of a frame is tens of
    /// thousands of voxels from the rest.
    pub position_rounding: f64,
}

impl Certificate {
    /// Whether everything that was checked holds.
    pub fn holds(&self) -> bool {
        self.bound_violation_count == 0
            && self.vertices_inside_min == 0
            && self.vertices_outside_max == 0
            && self.particle_violation_count() == 0
            && self.mesh_is_closed_manifold
    }

    /// Particles that are outside though all were to be inside.
    pub fn particle_violation_count(&self) -> usize {
        if self.may_leave_particles_outside { 0 } else { self.particles_outside.count }
    }

    /// What of it does not hold, in words; nothing where all does.
    pub fn fault(&self) -> String {
        let counts = [
            (self.bound_violation_count, "voxels out of bounds"),
            (self.vertices_inside_min, "vertices too near to particles"),
            (self.vertices_outside_max, "vertices too far from particles"),
            (self.particle_violation_count(), "particles outside"),
        ];
        let counts = counts.into_iter().filter(|&(count, _)| count > 0);
        let mut faults: Vec<String> = counts.map(|(count, what)| format!("{count} {what}")).collect();
        if !self.mesh_is_closed_manifold {
            faults.push("the mesh is not closed".to_owned());
        }
        faults.join(", ")
    }
}

/// How many particles are outside of a surface, and how far.
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize), serde(deny_unknown_fields))]
#[derive(Clone, Copy, Debug, Default, PartialEq)]
#[non_exhaustive]
pub struct ParticlesOutside {
    /// How many.
    pub count: usize,
    /// How far from the surface the farthest is, world units; 0 if none is outside. It is told by φ, which knows no more than
    /// the half width of its band: five voxels and more.
    pub deepest: f64,
}

/// What is not asked of a result: it was taken away on purpose.
pub trait Exempt: Sync {
    /// Whether nothing is exempt.
    fn is_nothing(&self) -> bool;

    /// Whether a particle, in voxels relative to the origin of its leaf, need not be inside.
    fn particle(&self, leaf_origin: IVec3, local: Vec3) -> bool;

    /// Whether a vertex, in voxels, need not be between the spheres.
    fn vertex(&self, index: DVec3) -> bool;
}

/// Everything is asked.
#[derive(Clone, Copy, Debug)]
pub struct NothingExempt;

impl Exempt for NothingExempt {
    fn is_nothing(&self) -> bool {
        true
    }

    fn particle(&self, _: IVec3, _: Vec3) -> bool {
        false
    }

    fn vertex(&self, _: DVec3) -> bool {
        false
    }
}

/// The certificate of a result whose particles, if it has any, and bounds were checked, in parts or whole. `radii` are those of
/// the particles, and `None` for surfaces of level sets.
pub fn certificate(
    checks: ParticleChecks,
    (bound_violation_count, particles_left_out): (usize, usize),
    (radii, offset): (Option<&Radii>, f64),
    mesh: &Mesh,
    measures: &MeshMeasures,
    lattice: &Lattice,
) -> Certificate {
    Certificate {
        bound_violation_count,
        particles_left_out,
        mesh_is_closed_manifold: measures.is_closed_manifold(),
        position_rounding: position_rounding(mesh, lattice),
        vertex_distance_min: f64::from(checks.vertex_distance_min),
        vertex_distance_max: f64::from(checks.vertex_distance_max),
        offset,
        distance_limits: radii.map(|radii| {
            DistanceLimits::new(radii).limits().map(|limit| f64::from(limit) * lattice.voxel_size)
        }),
        vertices_inside_min: checks.vertices_inside_min,
        vertices_outside_max: checks.vertices_outside_max,
        particles_outside: ParticlesOutside {
            count: checks.particles_outside,
            deepest: f64::from(checks.deepest_outside) * lattice.voxel_size,
        },
        may_leave_particles_outside: radii.is_some_and(may_leave_particles_outside),
        given_outside: None,
        particles_exempt: checks.particles_exempt,
    }
}

/// Whether the offset is so far inward that a particle may end up outside: the corners of its cell need not be inside.
fn may_leave_particles_outside(radii: &Radii) -> bool {
    radii.offset < 0.0 && radii.min * radii.shortest + radii.offset <= SURE_DEPTH
}

/// A ball of this radius, in voxels, holds all corners of the cell that its centre is in: √3. In the middle of smaller balls φ is not
/// known well enough to say more.
const SURE_DEPTH: f32 = 1.732_051;

/// Where vertices may be.
#[derive(Clone, Copy, Debug, PartialEq)]
struct DistanceLimits {
    /// The radii of the inner and the outer spheres, in voxels: the units of half axes.
    radii: [f32; 2],
    /// How far outward from the inner spheres vertices are at least, and from the outer ones at most, in voxels.
    from_spheres: [f32; 2],
}

impl DistanceLimits {
    fn new(radii: &Radii) -> DistanceLimits {
        DistanceLimits { radii: [radii.min, radii.max], from_spheres: [radii.offset, radii.outward()] }
    }

    /// How near to a particle's centre vertices may be, and how far from all of them, where all half axes are 1.
    fn limits(&self) -> [f32; 2] {
        let [min, max] = self.radii;
        let [from_min, from_max] = self.from_spheres;
        [(min + from_min).max(0.0), max + from_max]
    }

    /// The same limits with a margin that a vertex may be beyond them, in voxels.
    fn with_margin(self, margin: f32) -> DistanceLimits {
        let [from_min, from_max] = self.from_spheres;
        DistanceLimits { from_spheres: [from_min - margin, from_max + margin], ..self }
    }
}

/// Half the distance between the 32-bit numbers at the farthest position, in voxels.
fn position_rounding(mesh: &Mesh, lattice: &Lattice) -> f64 {
    let farthest =
        mesh.positions.par_iter().map(|position| position.abs().max_element()).reduce(|| 0.0, f32::max);
    f64::from(farthest.next_up() - farthest) / 2.0 / lattice.voxel_size
}
