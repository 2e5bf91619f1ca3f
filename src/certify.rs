//! What is checked of every result before it leaves: a certificate that ships with the frame.
//!
//! ```text
//!   φ within its bounds at every voxel                    (Eq. 6)
//!   no vertex nearer to a particle than r_min − h/2       the surface stays outside S_min
//!   none farther from all of them than r_max + h/2        and inside S_max, but for what a cell hides
//!   every particle inside
//!   the mesh closed and 2-manifold
//! ```
//!
//! The half voxel is what interpolation inside a cell may hide: the bounds hold at voxels, and a sphere bends between
//! them.

use glam::{DVec3, IVec3, Vec3};
use rayon::prelude::*;

use crate::grid::{LEAF_EDGE, offset_in_leaf};
use crate::level_set::{Bounds, NarrowBand};
use crate::mesh::{Mesh, MeshMeasures};
use crate::rasterize::{ParticleBins, Radii};
use crate::space::Lattice;

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
}

/// What a cell may hide, in voxels.
const CELL_MARGIN: f32 = 0.5;

/// Checks a result against the particles it was made from.
pub fn certify(
    bins: &ParticleBins,
    radii: Radii,
    band: &NarrowBand,
    bounds: &Bounds,
    mesh: &Mesh,
    measures: &MeshMeasures,
    lattice: &Lattice,
) -> Certificate {
    let distances = vertex_distances(bins, radii.max + CELL_MARGIN, mesh, lattice);
    Certificate {
        bound_violation_count: bounds.violation_count(&band.phi),
        vertex_distance_min: f64::from(distances.par_iter().copied().reduce(|| f32::INFINITY, f32::min)),
        vertex_distance_max: f64::from(distances.par_iter().copied().reduce(|| 0.0, f32::max)),
        vertices_inside_min: distances
            .par_iter()
            .filter(|&&distance| distance < radii.min - CELL_MARGIN)
            .count(),
        vertices_outside_max: distances
            .par_iter()
            .filter(|&&distance| distance > radii.max + CELL_MARGIN)
            .count(),
        particles_outside: particles_outside(bins, radii, band),
        mesh_is_closed_manifold: measures.is_closed_manifold(),
        position_rounding: position_rounding(mesh, lattice),
    }
}

/// The distance in voxels from each vertex to the nearest particle; infinite where there is none in
/// the leaves within `reach` voxels.
fn vertex_distances(bins: &ParticleBins, reach: f32, mesh: &Mesh, lattice: &Lattice) -> Vec<f32> {
    let steps = nearest_first((reach / LEAF_EDGE as f32).ceil() as i32);
    let distance = |position: &Vec3| {
        let index = (mesh.origin + position.as_dvec3()) / lattice.voxel_size;
        let origin = (index / f64::from(LEAF_EDGE)).floor() * f64::from(LEAF_EDGE);
        nearest_particle(bins, origin.as_ivec3(), (index - origin).as_vec3(), &steps)
    };
    mesh.positions.par_iter().map(distance).collect()
}

/// The distance from a point, given relative to the leaf at `origin`, to the nearest particle in
/// the leaves at `steps` from it.
fn nearest_particle(bins: &ParticleBins, origin: IVec3, point: Vec3, steps: &[IVec3]) -> f32 {
    let mut nearest = f32::INFINITY;
    for &step in steps {
        let local = point - step.as_vec3();
        let to_leaf = local - local.clamp(Vec3::ZERO, Vec3::splat(LEAF_EDGE as f32));
        if to_leaf.length_squared() >= nearest {
            continue;
        }
        let Some(bin) = bins.topology.find(origin + step) else { continue };
        for &particle in bins.in_leaf(bin) {
            nearest = nearest.min((particle - local).length_squared());
        }
    }
    nearest.sqrt()
}

/// Steps to all leaves within so many leaves on each axis, the nearest first: most others are then
/// farther than the nearest particle and are not opened.
fn nearest_first(rings: i32) -> Vec<IVec3> {
    let axis = || -rings..=rings;
    let mut steps: Vec<IVec3> =
        axis().flat_map(|x| axis().flat_map(move |y| axis().map(move |z| IVec3::new(x, y, z)))).collect();
    steps.sort_by_key(|step| step.length_squared());
    steps.into_iter().map(|step| step * LEAF_EDGE).collect()
}

/// Half the distance between the 32-bit numbers at the farthest position, in voxels.
fn position_rounding(mesh: &Mesh, lattice: &Lattice) -> f64 {
    let farthest =
        mesh.positions.par_iter().map(|position| position.abs().max_element()).reduce(|| 0.0, f32::max);
    f64::from(farthest.next_up() - farthest) / 2.0 / lattice.voxel_size
}

/// How many particles have φ ≥ 0, interpolated trilinearly.
fn particles_outside(bins: &ParticleBins, radii: Radii, band: &NarrowBand) -> usize {
    let origins = bins.topology.origins().par_iter().enumerate();
    let outside = |(leaf, &origin): (usize, &IVec3)| {
        let surroundings = Surroundings { bins, radii, band };
        bins.in_leaf(leaf).iter().filter(|position| surroundings.phi_at(origin, **position) >= 0.0).count()
    };
    origins.map(outside).sum()
}

/// Where φ is looked up beside particles.
struct Surroundings<'a> {
    bins: &'a ParticleBins,
    radii: Radii,
    band: &'a NarrowBand,
}

impl Surroundings<'_> {
    /// φ at a particle, given relative to a leaf's origin, in voxels.
    fn phi_at(&self, origin: IVec3, position: Vec3) -> f64 {
        let cell = position.floor();
        let fraction = (position - cell).as_dvec3();
        let mut phi = 0.0;
        for corner in 0..8 {
            let step = IVec3::new(corner >> 2 & 1, corner >> 1 & 1, corner & 1);
            let weight = DVec3::select(step.cmpeq(IVec3::ONE), fraction, 1.0 - fraction).element_product();
            if weight > 0.0 {
                phi += weight * f64::from(self.phi_at_voxel(origin + cell.as_ivec3() + step));
            }
        }
        phi
    }

    /// φ at a voxel. Where it is not stored there is no surface near: deep inside if φ_0 is negative,
    /// and outside otherwise, as around spheres so small that they fall between the voxels.
    fn phi_at_voxel(&self, voxel: IVec3) -> f32 {
        if let Some((leaf, local)) = self.band.topology.find_voxel(voxel) {
            return self.band.phi.leaves[leaf].values[offset_in_leaf(local)];
        }
        let local = voxel & IVec3::splat(LEAF_EDGE - 1);
        let steps = nearest_first((self.radii.init / LEAF_EDGE as f32).ceil() as i32);
        let nearest = nearest_particle(self.bins, voxel - local, local.as_vec3(), &steps);
        if nearest < self.radii.init { -self.band.half_width } else { self.band.half_width }
    }
}
