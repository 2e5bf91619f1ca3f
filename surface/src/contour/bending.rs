//! Computes the bending energy from φ.
//!
//! The bending energy is the integral of H² over the surface, where H is the mean curvature. Smoothing
//! reduces a linearized form of this integral, the thin-plate energy. (For a sphere of radius R, H = 1/R, and
//! the integral is 4π for any radius.) A mesh shows curvature only in the angles between its triangles, which
//! are rough. φ determines H at each voxel:
//!
//! ```text
//!   H = ½ div (∇φ / |∇φ|) = ½ (|∇φ|² Δφ − ∇φᵀ ∇∇φ ∇φ) / |∇φ|³       central differences, 3 × 3 × 3 voxels
//! ```
//!
//! H is interpolated trilinearly at the mesh's vertices, and H² is integrated over its triangles. Vertices
//! are processed in batches, one vertex per SIMD lane. A vertex needs φ at the 4 × 4 × 4 voxels around its
//! cell.

use glam::{IVec3, Vec3};
use rayon::prelude::*;

use super::neighborhood::{LeafNeighborhood, PhiBlock};
use crate::grid::LEAF_EDGE;
use crate::level_set::NarrowBand;
use crate::mesh::{self, Mesh, TriangleBatch};
use crate::parallel::Loops as _;
use crate::simd::{Kernel, Lanes, dispatch};
use crate::space::Lattice;

/// Where |∇φ| is smaller than this, as between two sheets, the normal and the curvature are undefined.
const CURVED_SLOPE_MIN: f32 = 0.1;

/// Maximum curvature, per voxel: the grid cannot represent spheres with a radius below one voxel.
const CURVATURE_MAX: f32 = 1.0;

/// Vertices or triangles per chunk. Sums are taken chunk by chunk, so that they do not depend on the number
/// of threads.
const CHUNK: usize = 4096;

/// ∫H² over a mesh of φ = 0, computed from φ. Dimensionless: 4π for a sphere.
pub fn bending_energy(band: &NarrowBand, lattice: &Lattice, mesh: &Mesh) -> f64 {
    let curvatures = mean_curvatures(band, lattice, mesh);
    let chunks = mesh.triangles.par_chunks(CHUNK);
    let chunks =
        chunks.map(|triangles| dispatch(TriangleEnergies { mesh, curvatures: &curvatures, triangles }));
    let sums: Vec<f64> = chunks.collect();
    sums.iter().sum::<f64>() / lattice.voxel_size.powi(2)
}

/// Kernel: ∫H² over some triangles, with H per voxel and areas in squared units of the mesh.
struct TriangleEnergies<'a> {
    mesh: &'a Mesh,
    curvatures: &'a [f32],
    triangles: &'a [[u32; 3]],
}

impl Kernel for TriangleEnergies<'_> {
    type Output = f64;

    #[inline(always)]
    fn run<V: Lanes>(self) -> f64 {
        let mut sum = 0.0;
        for triangles in self.triangles.chunks(mesh::LANES) {
            let areas = TriangleBatch::new(&self.mesh.positions, triangles).areas();
            for (triangle, area) in triangles.iter().zip(areas) {
                let square = |corner: usize| f64::from(self.curvatures[triangle[corner] as usize]).powi(2);
                sum += area * (square(0) + square(1) + square(2)) / 3.0;
            }
        }
        sum
    }
}

/// The mean curvature of φ at each vertex of a mesh of φ = 0, per voxel; positive on a sphere. Zero where φ
/// is not stored.
fn mean_curvatures(band: &NarrowBand, lattice: &Lattice, mesh: &Mesh) -> Vec<f32> {
    let mut curvatures = vec![0.0; mesh.positions.len()];
    let chunks = curvatures.par_chunks_mut(CHUNK).zip(mesh.positions.par_chunks(CHUNK));
    chunks.halved().for_each(|(curvatures, positions)| {
        dispatch(VertexCurvatures { band, lattice, mesh, positions, curvatures });
    });
    curvatures
}

/// Kernel: the curvatures at some vertices.
struct VertexCurvatures<'a> {
    band: &'a NarrowBand,
    lattice: &'a Lattice,
    mesh: &'a Mesh,
    positions: &'a [Vec3],
    curvatures: &'a mut [f32],
}

impl Kernel for VertexCurvatures<'_> {
    type Output = ();

    #[inline(always)]
    fn run<V: Lanes>(self) {
        let VertexCurvatures { band, lattice, mesh, positions, curvatures } = self;
        let origin = mesh.origin / lattice.voxel_size;
        let mut batch = CurvatureBatch::new();
        // A mesh lists its vertices leaf by leaf, so the previous block can usually be reused.
        let mut block = PhiBlock::new(band.half_width);
        let mut block_origin = None;
        for (vertex, position) in positions.iter().enumerate() {
            let index = origin + position.as_dvec3() / lattice.voxel_size;
            let floor = index.floor();
            let cell = floor.as_ivec3();
            let cell_in_leaf = cell & IVec3::splat(LEAF_EDGE - 1);
            let leaf_origin = cell - cell_in_leaf;
            if block_origin != Some(leaf_origin) {
                let Some(leaf) = band.topology.find(leaf_origin) else { continue };
                block.fill(&LeafNeighborhood::new(&band.topology, leaf), &band.phi);
                block_origin = Some(leaf_origin);
            }
            batch.push(&block, cell_in_leaf, (index - floor).as_vec3(), vertex);
            if batch.count == BATCH {
                batch.flush(curvatures);
            }
        }
        batch.flush(curvatures);
    }
}

/// Number of vertices that are processed at once.
const BATCH: usize = 16;

/// One value per vertex.
type VertexScalar = [f32; BATCH];

/// Pending vertices.
struct CurvatureBatch {
    count: usize,
    vertices: [usize; BATCH],
    /// Positions of the vertices within their cells, 0 to 1, by axis.
    locals: [VertexScalar; 3],
    /// φ at the voxels −1 to 2 on each axis, counted from the vertex's cell; z fastest.
    phi: [VertexScalar; 64],
}

/// Strides along x, y and z in `CurvatureBatch::phi`.
const STEP: [usize; 3] = [16, 4, 1];

impl CurvatureBatch {
    #[inline(always)]
    fn new() -> CurvatureBatch {
        let zeros = [0.0; BATCH];
        CurvatureBatch { count: 0, vertices: [0; BATCH], locals: [zeros; 3], phi: [zeros; 64] }
    }

    #[inline(always)]
    fn push(&mut self, block: &PhiBlock, cell_in_leaf: IVec3, local: Vec3, vertex: usize) {
        for x in 0..4 {
            for y in 0..4 {
                let values: [f32; 4] =
                    block.phi_along(PhiBlock::index(cell_in_leaf + IVec3::new(x - 1, y - 1, -1)));
                for (z, value) in values.into_iter().enumerate() {
                    self.phi[(x * 16 + y * 4) as usize + z][self.count] = value;
                }
            }
        }
        for axis in 0..3 {
            self.locals[axis][self.count] = local[axis];
        }
        self.vertices[self.count] = vertex;
        self.count += 1;
    }

    /// Stores the curvatures of the pending vertices and clears the batch.
    #[inline(always)]
    fn flush(&mut self, curvatures: &mut [f32]) {
        let mut sums = [0.0; BATCH];
        for corner in 0..8 {
            let at = [corner >> 2, corner >> 1 & 1, corner & 1];
            let voxel: usize = (0..3).map(|axis| (1 + at[axis]) * STEP[axis]).sum();
            for (lane, sum) in sums.iter_mut().enumerate() {
                let part = |axis: usize| {
                    let local = self.locals[axis][lane];
                    if at[axis] == 1 { local } else { 1.0 - local }
                };
                *sum += part(0) * part(1) * part(2) * self.voxel_curvature(voxel, lane);
            }
        }
        for (&vertex, sum) in self.vertices[..self.count].iter().zip(sums) {
            curvatures[vertex] = sum;
        }
        self.count = 0;
    }

    /// The mean curvature of the level set through a voxel.
    #[inline(always)]
    fn voxel_curvature(&self, voxel: usize, lane: usize) -> f32 {
        let phi = |neighbor: usize| self.phi[neighbor][lane];
        let here = phi(voxel);
        let slope = |axis: usize| 0.5 * (phi(voxel + STEP[axis]) - phi(voxel - STEP[axis]));
        let bend = |axis: usize| (phi(voxel + STEP[axis]) - here) - (here - phi(voxel - STEP[axis]));
        let mixed = |one: usize, other: usize| {
            let (one, other) = (STEP[one], STEP[other]);
            let diagonal = phi(voxel + one + other) + phi(voxel - one - other);
            0.25 * (diagonal - phi(voxel + one - other) - phi(voxel + other - one))
        };
        let gradient = Vec3::new(slope(0), slope(1), slope(2));
        let second = Vec3::new(bend(0), bend(1), bend(2));
        let length = gradient.length();
        let Vec3 { x, y, z } = gradient;
        let along_normal = (gradient * gradient).dot(second)
            + 2.0 * (x * y * mixed(0, 1) + y * z * mixed(1, 2) + z * x * mixed(2, 0));
        let curvature = 0.5 * (second.element_sum() - along_normal / (length * length)) / length;
        let is_flat = length < CURVED_SLOPE_MIN;
        if is_flat { 0.0 } else { curvature.clamp(-CURVATURE_MAX, CURVATURE_MAX) }
    }
}
