//! What is checked of particles and surface against each other, leaf by leaf.
//!
//! ```text
//!   part A ──▶ checks ─┐
//!   part B ──▶ checks ─┼─ and ─▶ checks of the whole
//!   part C ──▶ checks ─┘
//! ```
//!
//! A vertex belongs to the leaf that it lies in, a particle to the leaf of its bin. So a frame can be checked in
//! parts, each with the particles that lie in it and around it, and every vertex and particle is counted once.

use super::{containment, distances};
use crate::level_set::NarrowBand;
use crate::mesh::Mesh;
use crate::rasterize::{ParticleBins, Radii};
use crate::space::{CoordBox, Lattice};

/// A part of a frame: what is in the leaves whose origins are in a box.
#[derive(Clone, Copy)]
pub struct Part<'a> {
    /// The particles in these leaves, and in those as far around them as r_max and two voxels reach. Particles so
    /// deep inside that no voxel near them is stored may be missing.
    pub bins: &'a ParticleBins,
    /// The radii in voxels.
    pub radii: Radii,
    /// The band that was contoured, in these leaves and those next to them.
    pub band: &'a NarrowBand,
    /// A mesh that has the vertices in these leaves. Others are left out.
    pub mesh: &'a Mesh,
    /// What the mesh's positions are in voxels.
    pub lattice: &'a Lattice,
    /// The voxels whose leaves are checked.
    pub owned: CoordBox,
}

/// What is checked of vertices and particles. Distances are in voxels, to the nearest particle's centre.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ParticleChecks {
    /// Least distance from a vertex to a particle; infinite where there is no vertex.
    pub vertex_distance_min: f32,
    /// Largest distance from a vertex to its nearest particle; 0 where there is no vertex.
    pub vertex_distance_max: f32,
    /// Vertices nearer to a particle than r_min − h/2.
    pub vertices_inside_min: usize,
    /// Vertices farther from all particles than r_max + h/2.
    pub vertices_outside_max: usize,
    /// Particles outside the surface.
    pub particles_outside: usize,
}

impl ParticleChecks {
    /// The checks of no vertex and no particle.
    pub const NOTHING: ParticleChecks = ParticleChecks {
        vertex_distance_min: f32::INFINITY,
        vertex_distance_max: 0.0,
        vertices_inside_min: 0,
        vertices_outside_max: 0,
        particles_outside: 0,
    };

    /// Checks a part of a frame.
    pub fn of(part: &Part) -> ParticleChecks {
        let vertices = distances::check_vertices(part);
        ParticleChecks { particles_outside: containment::particles_outside(part), ..vertices }
    }

    /// The checks of two parts that have no leaf in common, together.
    pub fn and(self, other: ParticleChecks) -> ParticleChecks {
        ParticleChecks {
            vertex_distance_min: self.vertex_distance_min.min(other.vertex_distance_min),
            vertex_distance_max: self.vertex_distance_max.max(other.vertex_distance_max),
            vertices_inside_min: self.vertices_inside_min + other.vertices_inside_min,
            vertices_outside_max: self.vertices_outside_max + other.vertices_outside_max,
            particles_outside: self.particles_outside + other.particles_outside,
        }
    }
}
