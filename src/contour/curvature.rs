//! Bending energy from φ.
//!
//! The energy that smoothing lowers is that of a thin plate, the integral of H² over the surface,
//! with H the mean curvature (for a sphere of radius R: H = 1/R, and the integral is 4π whatever
//! the radius). A mesh knows it only through its angles, which are rough; φ knows it at each voxel:
//!
//! ```text
//!   H = ½ div (∇φ / |∇φ|) = ½ (|∇φ|² Δφ − ∇φᵀ ∇∇φ ∇φ) / |∇φ|³       central differences, 3 × 3 × 3 voxels
//! ```
//!
//! interpolated trilinearly at the mesh's vertices, and integrated over its triangles.

use glam::{IVec3, Vec3};
use rayon::prelude::*;

use super::neighborhood::{BLOCK_STEP, Block, Neighborhood};
use crate::grid::LEAF_EDGE;
use crate::level_set::NarrowBand;
use crate::mesh::Mesh;
use crate::space::Lattice;

/// Where φ is flatter than this, as between two sheets, it has no normal and so no curvature.
const LEAST_SLOPE: f32 = 0.1;

/// The grid shows no sphere that is smaller than a voxel.
const GREATEST_CURVATURE: f32 = 1.0;

/// Vertices or triangles in a piece of work. Sums are taken piece by piece, so that they do not
/// depend on the number of threads.
const PIECE: usize = 4096;

/// ∫H² over a mesh of φ = 0, from φ. Without unit: 4π for a sphere.
pub fn bending_energy(band: &NarrowBand, lattice: &Lattice, mesh: &Mesh) -> f64 {
    let curvatures = mean_curvatures(band, lattice, mesh);
    let sums: Vec<f64> = mesh
        .triangles
        .par_chunks(PIECE)
        .map(|triangles| triangles.iter().map(|&triangle| triangle_energy(mesh, &curvatures, triangle)).sum())
        .collect();
    sums.iter().sum::<f64>() / lattice.voxel_size.powi(2)
}

fn triangle_energy(mesh: &Mesh, curvatures: &[f32], triangle: [u32; 3]) -> f64 {
    let [a, b, c] = triangle.map(|vertex| mesh.positions[vertex as usize].as_dvec3());
    let area = 0.5 * (b - a).cross(c - a).length();
    let squares = triangle.map(|vertex| f64::from(curvatures[vertex as usize]).powi(2));
    area * squares.iter().sum::<f64>() / 3.0
}

/// The mean curvature of φ at each vertex of a mesh of φ = 0, per voxel; positive on a sphere. Zero
/// where φ is not stored.
pub fn mean_curvatures(band: &NarrowBand, lattice: &Lattice, mesh: &Mesh) -> Vec<f32> {
    let origin = mesh.origin / lattice.voxel_size;
    let mut curvatures = vec![0.0; mesh.positions.len()];
    curvatures.par_chunks_mut(PIECE).zip(mesh.positions.par_chunks(PIECE)).for_each(
        |(curvatures, positions)| {
            // A mesh lists its vertices leaf by leaf, so the last block mostly serves again.
            let mut last: Option<(usize, Block)> = None;
            for (curvature, position) in curvatures.iter_mut().zip(positions) {
                let index = origin + position.as_dvec3() / lattice.voxel_size;
                let cell = index.floor().as_ivec3();
                let Some((leaf, voxel)) = band.topology.find_voxel(cell) else { continue };
                if last.as_ref().is_none_or(|(last_leaf, _)| *last_leaf != leaf) {
                    let neighborhood = Neighborhood::new(&band.topology, leaf);
                    last = Some((leaf, Block::new(&neighborhood, &band.phi, band.half_width)));
                }
                let local = (index - cell.as_dvec3()).as_vec3();
                *curvature = last.as_ref().map_or(0.0, |(_, block)| curvature_at(block, voxel, local));
            }
        },
    );
    curvatures
}

/// The mean curvature at a point given relative to a cell of a block.
fn curvature_at(block: &Block, cell: IVec3, local: Vec3) -> f32 {
    debug_assert!(cell.max_element() < LEAF_EDGE);
    let index = Block::index(cell);
    (0..8)
        .map(|corner| {
            let at = [corner >> 2, corner >> 1 & 1, corner & 1];
            let weight: f32 =
                (0..3).map(|axis| if at[axis] == 1 { local[axis] } else { 1.0 - local[axis] }).product();
            weight
                * voxel_curvature(
                    block,
                    index + (0..3).map(|axis| at[axis] * BLOCK_STEP[axis]).sum::<usize>(),
                )
        })
        .sum()
}

/// The mean curvature of the level set through a voxel.
fn voxel_curvature(block: &Block, index: usize) -> f32 {
    let gradient = block.gradient(index);
    let slope = gradient.length();
    if slope < LEAST_SLOPE {
        return 0.0;
    }
    let second = Vec3::from_array(BLOCK_STEP.map(|step| block.second_difference(index, step)));
    let mixed = |one: usize, other: usize| {
        let (one, other) = (BLOCK_STEP[one], BLOCK_STEP[other]);
        let diagonal = block.phi(index + one + other) + block.phi(index - one - other);
        0.25 * (diagonal - block.phi(index + one - other) - block.phi(index + other - one))
    };
    let Vec3 { x, y, z } = gradient;
    let along_normal = (gradient * gradient).dot(second)
        + 2.0 * (x * y * mixed(0, 1) + y * z * mixed(1, 2) + z * x * mixed(2, 0));
    let curvature = 0.5 * (second.element_sum() - along_normal / (slope * slope)) / slope;
    curvature.clamp(-GREATEST_CURVATURE, GREATEST_CURVATURE)
}
