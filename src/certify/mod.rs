//! What is checked of every result before it leaves: a certificate that ships with the frame.
//!
//! ```text
//!   φ within its bounds at every voxel                    (Eq. 6)
//!   no vertex deeper inside S_min than h/2                the surface stays outside of it
//!   none farther outside of S_max than h/2                and inside of this, but for what a cell hides
//!   every particle inside
//!   the mesh closed and 2-manifold
//! ```
//!
//! What is said of vertices, of particles and of the mesh is said of the mesh as a file has it: with the triangles that are
//! left, at the positions that a reader gets.
//!
//! The half voxel is what interpolation inside a cell may hide: the bounds hold at voxels, and a sphere bends between
//! them.

mod containment;
mod distances;
mod mesh_cells;
mod particle_checks;
mod rays;
mod strays;
mod surfaces;

use glam::{DVec3, IVec3, Vec3};
use rayon::prelude::*;

pub use mesh_cells::MeshCells;
pub use particle_checks::{Part, ParticleChecks, check};
pub use strays::Stray;

use crate::mesh::{Mesh, MeshMeasures};
use crate::space::Lattice;

/// What is checked of every result. Distances are in voxels, to the nearest particle's centre. What is said of r_min and
/// r_max is, of particles with shapes of their own, said of their surfaces.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Certificate {
    /// Voxels where φ leaves its bounds (Eq. 6). Always 0.
    pub bound_violation_count: usize,
    /// Particles that were left out of the surface: not finite, or too far from the others.
    pub particles_left_out: usize,
    /// Least distance from a mesh vertex to a particle; infinite for an empty mesh.
    pub vertex_distance_min: f64,
    /// Largest distance from a mesh vertex to its nearest particle; 0 for an empty mesh.
    pub vertex_distance_max: f64,
    /// Mesh vertices nearer to a particle than r_min − h/2.
    pub vertices_inside_min: usize,
    /// Mesh vertices farther from all particles than r_max + h/2.
    pub vertices_outside_max: usize,
    /// Particles outside the mesh, but for those that are exempt.
    pub particles_outside: usize,
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
            && self.particles_outside == 0
            && self.mesh_is_closed_manifold
    }

    /// What of it does not hold, in words; nothing where all does.
    pub fn fault(&self) -> String {
        let counts = [
            (self.bound_violation_count, "voxels out of bounds"),
            (self.vertices_inside_min, "vertices too near to particles"),
            (self.vertices_outside_max, "vertices too far from particles"),
            (self.particles_outside, "particles outside"),
        ];
        let counts = counts.into_iter().filter(|&(count, _)| count > 0);
        let mut faults: Vec<String> = counts.map(|(count, what)| format!("{count} {what}")).collect();
        if !self.mesh_is_closed_manifold {
            faults.push("the mesh is not closed".to_owned());
        }
        faults.join(", ")
    }
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

/// The certificate of a result whose particles and bounds were checked, in parts or whole.
pub fn certificate(
    checks: ParticleChecks,
    (bound_violation_count, particles_left_out): (usize, usize),
    mesh: &Mesh,
    measures: &MeshMeasures,
    lattice: &Lattice,
) -> Certificate {
    Certificate {
        bound_violation_count,
        particles_left_out,
        mesh_is_closed_manifold: measures.is_closed_manifold(),
        position_rounding: position_rounding(mesh, lattice),
        ..checks.into()
    }
}

impl From<ParticleChecks> for Certificate {
    fn from(checks: ParticleChecks) -> Certificate {
        Certificate {
            vertex_distance_min: f64::from(checks.vertex_distance_min),
            vertex_distance_max: f64::from(checks.vertex_distance_max),
            vertices_inside_min: checks.vertices_inside_min,
            vertices_outside_max: checks.vertices_outside_max,
            particles_outside: checks.particles_outside,
            particles_exempt: checks.particles_exempt,
            ..Certificate::default()
        }
    }
}

/// Half the distance between the 32-bit numbers at the farthest position, in voxels.
fn position_rounding(mesh: &Mesh, lattice: &Lattice) -> f64 {
    let farthest =
        mesh.positions.par_iter().map(|position| position.abs().max_element()).reduce(|| 0.0, f32::max);
    f64::from(farthest.next_up() - farthest) / 2.0 / lattice.voxel_size
}
