//! What each stage measured: plain numbers, filled in by the stages, written out by the pipeline.

use crate::mesh::MeshMeasures;

/// Everything measured while skinning one frame.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SkinReport {
    /// Particles that were skinned.
    pub particle_count: usize,
    /// Particles dropped: not finite, or outside the grid's range of indices.
    pub dropped_count: usize,
    /// Leaves of 8³ voxels that were stored.
    pub leaf_count: usize,
    /// Voxels with |φ| at most 3 voxels at the start of smoothing: the solver's unknowns.
    pub free_voxel_count: usize,
    /// Passes of the biharmonic operator over the band.
    pub pass_count: usize,
    /// How far a change of one particle can reach, in voxels; `None` where the integrator couples
    /// all voxels (conjugate gradients).
    pub reach_voxels: Option<u32>,
    /// Of the conjugate gradients only.
    pub convergence: Option<Convergence>,
    /// Explicit steps whose CFL bound (Eq. 8) was exceeded.
    pub cfl_exceeded_count: usize,
    /// Seconds in each stage.
    pub seconds: StageSeconds,
    /// What was checked of the result.
    pub certificate: Certificate,
    /// ∫H² over the surface, from φ; 4π for a sphere of any size.
    pub bending_energy: f64,
    /// What was measured on the mesh.
    pub mesh: MeshMeasures,
}

/// How the linear solver fared, over all steps.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Convergence {
    /// Iterations of conjugate gradients.
    pub iterations: usize,
    /// Restarts, because a voxel met its bound.
    pub restarts: usize,
    /// Largest relative residual ‖r‖ / ‖r₀‖ at the end of a step.
    pub residual: f64,
    /// Whether every step reached its tolerance.
    pub reached: bool,
}

/// Wall-clock seconds in each stage of the method.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct StageSeconds {
    /// Particles to level sets.
    pub rasterize: f64,
    /// Laplacian and biharmonic smoothing.
    pub smooth: f64,
    /// Level set to mesh, and the measures and certificate of the result.
    pub contour: f64,
}

/// What is checked of every result. Distances are in voxels, to the nearest particle's centre.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Certificate {
    /// Voxels where φ leaves its bounds (Eq. 6). Always 0.
    pub bound_violation_count: usize,
    /// Least distance from a mesh vertex to a particle; infinite for an empty mesh.
    pub vertex_distance_min: f64,
    /// Largest distance from a mesh vertex to its nearest particle; 0 for an empty mesh.
    pub vertex_distance_max: f64,
    /// Mesh vertices nearer to a particle than r_min − h/2.
    pub vertices_inside_min: usize,
    /// Mesh vertices farther from all particles than r_max + h/2.
    pub vertices_outside_max: usize,
    /// Particles outside the surface.
    pub particles_outside: usize,
}

impl Certificate {
    /// Whether everything that was checked holds.
    pub fn holds(&self) -> bool {
        self.bound_violation_count == 0
            && self.vertices_inside_min == 0
            && self.vertices_outside_max == 0
            && self.particles_outside == 0
    }
}
