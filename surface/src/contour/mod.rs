//! Extracts a triangle mesh from φ.
//!
//! ```text
//!   signs of all voxels ──▶ LeafNeighborhood ──▶ crossed cells ──▶ vertex and triangle ──▶ index ranges
//!                           SignRows             and edges         counts                  per leaf
//!
//!                                    PhiBlock ──▶ crossings, gradients ──▶ vertices  ─┐ written to
//!                                                                         triangles ─┴▶ their ranges
//! ```
//!
//! Both methods (see [`Contouring`]) guarantee for any φ: the mesh is closed; every edge is in two triangles
//! with opposite directions; the triangles around a vertex form one ring; all triangles face outward; none is
//! degenerate; and the three vertices of a triangle are distinct. Each leaf is processed independently and
//! has a fixed range in the mesh, so the mesh is bit-identical on any number of threads.
//!
//! Inside is φ < 0; zero is outside. A band must store the voxels next to a sign change together with all
//! their neighbors. Cells with a corner that is not stored are treated as empty.

mod cell_vertex;
mod dual_contouring;
mod marching_tetrahedra;
mod neighborhood;
mod quads;

use glam::{DVec3, IVec3, Vec3};
use rayon::prelude::*;

use crate::grid::{LEAF_EDGE, Topology};
use crate::level_set::NarrowBand;
use crate::mesh::{self, Mesh, TriangleBatch};
use crate::parallel::Loops as _;
use crate::simd::{Kernel, Lanes, dispatch};
use crate::space::{CoordBox, Lattice};
use crate::words::word_enum;
use neighborhood::{LeafNeighborhood, PhiBlock};

word_enum! {
    /// How the level set becomes triangles.
    #[derive(Default)]
    pub enum Contouring {
        /// Dual contouring: fewer and better shaped triangles
        #[default]
        Dual = "dual",
        /// Marching tetrahedra, as in the paper: about four times as many triangles
        Tetrahedra = "tetrahedra",
    }
}

/// The surface φ = 0 as a closed triangle mesh in world units, oriented outward, with unit normals.
pub fn contour(band: &NarrowBand, lattice: &Lattice, contouring: Contouring) -> Mesh {
    assert_eq!(
        band.phi.leaves.len(),
        band.topology.len(),
        "φ must have one leaf of values per leaf of the topology"
    );
    let placement = MeshFrame::new(&band.topology, lattice);
    let mut mesh = match contouring {
        Contouring::Dual => dual_contouring::dual_contour(band, &placement),
        Contouring::Tetrahedra => marching_tetrahedra::march_tetrahedra(band, &placement),
    };
    fill_zero_normals(&mut mesh);
    mesh
}

/// The origin of the mesh and the voxel size.
struct MeshFrame {
    origin_index: IVec3,
    voxel_size: f64,
}

/// Up to this index, 32-bit positions resolve 1/1024 voxel.
const NEAR_ORIGIN: i32 = 16384;

/// Mesh origins other than the world origin are multiples of this many voxels, so that consecutive frames of
/// a moving sequence often share one.
const ORIGIN_STEP: i32 = 1024;

impl MeshFrame {
    /// Places the mesh's origin at the world origin if all leaves are near it, and otherwise at the median
    /// leaf. With the median, a single stray particle does not reduce the precision of all others.
    fn new(topology: &Topology, lattice: &Lattice) -> MeshFrame {
        let mut extent = CoordBox::EMPTY;
        for &origin in topology.origins() {
            extent.include(origin);
            extent.include(origin + IVec3::splat(LEAF_EDGE - 1));
        }
        let is_near = extent.is_empty()
            || extent.min.cmpge(IVec3::splat(-NEAR_ORIGIN)).all()
                && extent.max.cmple(IVec3::splat(NEAR_ORIGIN)).all();
        let origin_index =
            if is_near { IVec3::ZERO } else { (median(topology) + ORIGIN_STEP / 2) & !(ORIGIN_STEP - 1) };
        MeshFrame { origin_index, voxel_size: lattice.voxel_size }
    }

    /// The world position that mesh positions are relative to.
    fn world_origin(&self) -> DVec3 {
        self.origin_index.as_dvec3() * self.voxel_size
    }

    /// The mesh position of a point given relative to a cell; rounded once.
    #[inline(always)]
    fn position(&self, cell: IVec3, local: Vec3) -> Vec3 {
        (((cell - self.origin_index).as_dvec3() + local.as_dvec3()) * self.voxel_size).as_vec3()
    }
}

/// The median of the leaves' origins, axis by axis. There is at least one leaf.
fn median(topology: &Topology) -> IVec3 {
    let axis = |axis: usize| {
        let mut values: Vec<i32> = topology.origins().iter().map(|origin| origin[axis]).collect();
        let middle = values.len() / 2;
        *values.select_nth_unstable(middle).1
    };
    IVec3::new(axis(0), axis(1), axis(2))
}

/// Splits a slice into consecutive parts of these lengths.
fn split<T>(whole: &mut [T], counts: impl Iterator<Item = usize>) -> Vec<&mut [T]> {
    let mut rest = whole;
    let part = |count: usize| {
        let (part, after) = std::mem::take(&mut rest).split_at_mut(count);
        rest = after;
        part
    };
    counts.map(part).collect()
}

// Vertex normals from φ.
//
// φ grows outward, so its gradient points along the normal, and is smoother and more accurate than normals
// computed from triangles. Midway between two sheets, the gradient vanishes and has no direction. There, the
// normal comes from the triangles.

/// Gradients shorter than this are mostly rounding error. (The gradient of a distance has length one.)
const SLOPE_MIN: f32 = 1e-3;

/// The direction of a gradient, or zero if the gradient is too short.
#[inline(always)]
fn unit_or_zero(gradient: Vec3) -> Vec3 {
    let length = gradient.length();
    let unit = gradient / length;
    // Comparison with NaN is false, so values that are not finite give zero, too.
    if (length > SLOPE_MIN) & (length < f32::INFINITY) { unit } else { Vec3::ZERO }
}

/// Replaces each zero normal by the area-weighted mean of the vertex's triangle normals, or by the z axis if
/// these cancel, as on a sheet that is folded flat.
pub fn fill_zero_normals(mesh: &mut Mesh) {
    if mesh.normals.iter().all(|&normal| normal != Vec3::ZERO) {
        return;
    }
    let mut sums = vec![DVec3::ZERO; mesh.positions.len()];
    for triangle in &mesh.triangles {
        let [a, b, c] = triangle.map(|vertex| mesh.positions[vertex as usize].as_dvec3());
        let doubled_area = (b - a).cross(c - a);
        triangle.iter().for_each(|&vertex| sums[vertex as usize] += doubled_area);
    }
    for (normal, sum) in mesh.normals.iter_mut().zip(sums) {
        if *normal == Vec3::ZERO {
            *normal = sum.try_normalize().unwrap_or(DVec3::Z).as_vec3();
        }
    }
}

// Computes the bending energy from φ.
//
// The bending energy is the integral of H² over the surface, where H is the mean curvature. Smoothing
// reduces a linearized form of this integral, the thin-plate energy. (For a sphere of radius R, H = 1/R, and
// the integral is 4π for any radius.) A mesh shows curvature only in the angles between its triangles, which
// are rough. φ determines H at each voxel:
//
//   H = ½ div (∇φ / |∇φ|) = ½ (|∇φ|² Δφ − ∇φᵀ ∇∇φ ∇φ) / |∇φ|³       central differences, 3 × 3 × 3 voxels
//
// H is interpolated trilinearly at the mesh's vertices, and H² is integrated over its triangles. Vertices
// are processed in batches, one vertex per SIMD lane. A vertex needs φ at the 4 × 4 × 4 voxels around its
// cell.

/// Where |∇φ| is smaller than this, as between two sheets, the normal and the curvature are undefined.
const CURVED_SLOPE_MIN: f32 = 0.1;

/// Maximum curvature, per voxel: the grid cannot represent spheres with a radius below one voxel.
const GREATEST_CURVATURE: f32 = 1.0;

/// Vertices or triangles per chunk. Sums are taken chunk by chunk, so that they do not depend on the number
/// of threads.
const PIECE: usize = 4096;

/// ∫H² over a mesh of φ = 0, computed from φ. Dimensionless: 4π for a sphere.
pub fn bending_energy(band: &NarrowBand, lattice: &Lattice, mesh: &Mesh) -> f64 {
    let curvatures = mean_curvatures(band, lattice, mesh);
    let pieces = mesh.triangles.par_chunks(PIECE);
    let pieces =
        pieces.map(|triangles| dispatch(TriangleEnergies { mesh, curvatures: &curvatures, triangles }));
    let sums: Vec<f64> = pieces.collect();
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
pub fn mean_curvatures(band: &NarrowBand, lattice: &Lattice, mesh: &Mesh) -> Vec<f32> {
    let mut curvatures = vec![0.0; mesh.positions.len()];
    let pieces = curvatures.par_chunks_mut(PIECE).zip(mesh.positions.par_chunks(PIECE));
    pieces.halved().for_each(|(curvatures, positions)| {
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
            let voxel = cell & IVec3::splat(LEAF_EDGE - 1);
            let leaf_origin = cell - voxel;
            if block_origin != Some(leaf_origin) {
                let Some(leaf) = band.topology.find(leaf_origin) else { continue };
                block.fill(&LeafNeighborhood::new(&band.topology, leaf), &band.phi);
                block_origin = Some(leaf_origin);
            }
            batch.push(&block, voxel, (index - floor).as_vec3(), vertex);
            if batch.count == LANES {
                batch.find(curvatures);
            }
        }
        batch.find(curvatures);
    }
}

/// Number of vertices that are processed at once.
const LANES: usize = 16;

/// One value per vertex.
type VertexScalar = [f32; LANES];

/// Pending vertices.
struct CurvatureBatch {
    count: usize,
    vertices: [usize; LANES],
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
        let zeros = [0.0; LANES];
        CurvatureBatch { count: 0, vertices: [0; LANES], locals: [zeros; 3], phi: [zeros; 64] }
    }

    #[inline(always)]
    fn push(&mut self, block: &PhiBlock, cell: IVec3, local: Vec3, vertex: usize) {
        for x in 0..4 {
            for y in 0..4 {
                let values: [f32; 4] = block.phi_along(PhiBlock::index(cell + IVec3::new(x - 1, y - 1, -1)));
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
    fn find(&mut self, curvatures: &mut [f32]) {
        let mut sums = [0.0; LANES];
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
        if is_flat { 0.0 } else { curvature.clamp(-GREATEST_CURVATURE, GREATEST_CURVATURE) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn zero_normal_becomes_mean_of_triangle_normals() {
        let mut mesh = Mesh {
            positions: vec![Vec3::ZERO, Vec3::X, Vec3::Y],
            normals: vec![
                unit_or_zero(Vec3::splat(1e-9)),
                unit_or_zero(Vec3::NAN),
                unit_or_zero(2.0 * Vec3::X),
            ],
            triangles: vec![[0, 1, 2]],
            ..Mesh::default()
        };
        fill_zero_normals(&mut mesh);
        assert_eq!(mesh.normals, [Vec3::Z, Vec3::Z, Vec3::X]);
    }

    #[test]
    fn folded_sheet_gets_unit_normals() {
        let mut mesh = Mesh {
            positions: vec![Vec3::ZERO, Vec3::X, Vec3::Y],
            normals: vec![Vec3::ZERO; 3],
            triangles: vec![[0, 1, 2], [0, 2, 1]],
            ..Mesh::default()
        };
        fill_zero_normals(&mut mesh);
        assert_eq!(mesh.normals, [Vec3::Z; 3]);
    }
}
