//! Marching tetrahedra: the zero set of a function that is linear in each tetrahedron.
//!
//! Each cell is split into six tetrahedra, one for each order of the three axes along a path from its first
//! to its last corner (Kuhn's or Freudenthal's subdivision):
//!
//! ```text
//!        3 ─────── 7        paths 0 → 7:   x y z   y z x   z x y    and, mirrored,   x z y   z y x   y x z
//!       ╱│      ╱ ╱│
//!      1 ───── 5   │        a voxel is the start of 7 edges:
//!      │ │  ╱  │   │          3 along an axis, 3 across a face, 1 through the cell
//!      │ 2 ────│── 6
//!      │╱      │ ╱          a face is split along the diagonal from its first to its last corner, so
//!      0 ───── 4            the two cells that share it agree
//! ```
//!
//! A tetrahedron has no ambiguous case: its inside corners are connected, and so are its outside corners. A
//! vertex lies strictly inside each edge whose ends differ in sign, and one or two triangles separate the
//! inside corners from the outside corners. So two triangles meet at each edge of the mesh: one from each of
//! the two tetrahedra that share a face, or both from one tetrahedron. The triangles around a vertex form a
//! ring, because they follow the ring of tetrahedra around the edge that contains the vertex. No triangle is
//! degenerate: its corners lie strictly inside three edges, and the three edges are not coplanar.
//!
//! A vertex is placed at the zero of the cubic through φ at four voxels along its edge. Linear interpolation
//! would pull a curved surface inward by an amount that depends on the direction of the edge.
//!
//! This work is based on:
//! Akio Doi, Akio Koide. An Efficient Method of Triangulating Equi-Valued Surfaces by Using
//! Tetrahedral Cells. 1991

use glam::{IVec3, Vec3};
use rayon::prelude::*;

use super::neighborhood::{BLOCK_STEP, LeafNeighborhood, PhiBlock, SignRows};
use super::{MeshPlacement, split, unit_or_zero};
use crate::cancel::checkpoint;
use crate::grid::{LEAF_VOXELS, LeafMask, ROW_COUNT, negative_masks, offset_in_leaf, voxel_in_leaf};
use crate::level_set::NarrowBand;
use crate::mesh::Mesh;
use crate::parallel::Loops as _;

/// Minimum distance of a vertex from the ends of its edge, as a fraction of the edge. It ensures that every
/// triangle has a positive area. A larger margin would visibly bend the surface where it passes close to a
/// voxel.
const EDGE_MARGIN: f32 = 1.0 / 128.0;

/// Triangulates φ = 0 in the tetrahedra. A vertex normal is zero where φ defines no normal.
pub(super) fn march_tetrahedra(band: &NarrowBand, placement: &MeshPlacement) -> Mesh {
    let masks = negative_masks(&band.phi);
    let cases = tetrahedron_cases();
    let mut patches: Vec<TetPatch> = (0..band.topology.len())
        .into_par_iter()
        .halved()
        .filter_map(|leaf| {
            checkpoint();
            TetPatch::new(band, &masks, &cases, leaf)
        })
        .collect();
    let mut patch_of_leaf = vec![NO_PATCH; band.topology.len()];
    let (mut vertex_count, mut triangle_count) = (0, 0);
    for (index, patch) in patches.iter_mut().enumerate() {
        patch_of_leaf[patch.leaf] = index as u32;
        patch.first_vertex = vertex_count as u32;
        vertex_count += patch.vertex_count();
        triangle_count += patch.triangle_count;
    }
    assert!(vertex_count <= u32::MAX as usize, "more vertices than 32-bit indices allow");
    let mut positions = bytemuck::zeroed_vec(vertex_count);
    let mut normals = bytemuck::zeroed_vec(vertex_count);
    let mut triangles = bytemuck::zeroed_vec(triangle_count);
    let slices = split(&mut positions, patches.iter().map(TetPatch::vertex_count)).into_par_iter();
    let slices = slices.zip(split(&mut normals, patches.iter().map(TetPatch::vertex_count)));
    slices.zip(&patches).for_each(|((positions, normals), patch)| {
        checkpoint();
        patch.find_vertices(band, placement, positions, normals);
    });
    let mesh_writer = TetMesh { masks: &masks, cases, patches: &patches, patch_of_leaf };
    let slices = split(&mut triangles, patches.iter().map(|patch| patch.triangle_count)).into_par_iter();
    slices
        .zip(&patches)
        .halved()
        .for_each(|(triangles, patch)| mesh_writer.write_triangles(patch, triangles));
    Mesh { positions, normals, triangles, origin: placement.world_origin() }
}

/// Patch index of a leaf without vertices.
const NO_PATCH: u32 = u32::MAX;

/// The vertices on the edges that start in one leaf, and the number of triangles in its cells.
struct TetPatch {
    leaf: usize,
    neighborhood: LeafNeighborhood,
    /// For each voxel, a mask of the crossed edges that start there: bit d is set for the edge to corner d (1
    /// to 7) of the voxel's cell.
    crossed: Box<[u8; LEAF_VOXELS]>,
    /// For each row of voxels, the index of its first vertex, relative to the patch; the last entry is the
    /// number of vertices.
    row_starts: [u16; ROW_COUNT + 1],
    /// Index of the patch's first vertex in the mesh.
    first_vertex: u32,
    triangle_count: usize,
}

impl TetPatch {
    /// The patch of a leaf; `None` if no crossed edge starts in the leaf.
    fn new(band: &NarrowBand, inside_masks: &[LeafMask], cases: &Cases, leaf: usize) -> Option<TetPatch> {
        let neighborhood = LeafNeighborhood::new(&band.topology, leaf);
        if !neighborhood.may_have_surface(inside_masks) {
            return None;
        }
        let rows = SignRows::new(&neighborhood, inside_masks);
        // An edge belongs to the leaf of its first voxel, even if all cells around the edge belong to other
        // leaves.
        if (1..8).all(|end| rows.crossed_to(end).is_empty()) {
            return None;
        }
        let mut crossed = Box::new([0u8; LEAF_VOXELS]);
        for end in 1..8 {
            rows.crossed_to(end).iter().for_each(|offset| crossed[offset] |= 1 << end);
        }
        let mut row_starts = [0; ROW_COUNT + 1];
        for (row, edges) in crossed.chunks_exact(8).enumerate() {
            let count: u32 = edges.iter().map(|edges| edges.count_ones()).sum();
            row_starts[row + 1] = row_starts[row] + count as u16;
        }
        let cells = rows.crossed_cells();
        let signs = cells.iter().map(|offset| rows.cell_signs(voxel_in_leaf(offset)));
        let triangle_count = signs.flat_map(|signs| triangles_in_cell(cases, signs)).map(<[_]>::len).sum();
        Some(TetPatch { leaf, neighborhood, crossed, row_starts, first_vertex: 0, triangle_count })
    }

    fn vertex_count(&self) -> usize {
        usize::from(self.row_starts[ROW_COUNT])
    }

    /// Computes the positions and normals of the vertices.
    fn find_vertices(
        &self,
        band: &NarrowBand,
        placement: &MeshPlacement,
        positions: &mut [Vec3],
        normals: &mut [Vec3],
    ) {
        let mut block = PhiBlock::new(band.half_width);
        block.fill(&self.neighborhood, &band.phi);
        let origin = band.topology.origins()[self.leaf];
        let mut slices = positions.iter_mut().zip(normals);
        for (offset, &edges) in self.crossed.iter().enumerate().filter(|(_, edges)| **edges != 0) {
            let voxel = voxel_in_leaf(offset);
            let ends = (1..8).filter(|end| edges >> end & 1 == 1);
            for (end, (position, normal)) in ends.zip(&mut slices) {
                let (t, gradient) = crossing(&block, PhiBlock::index(voxel), end);
                *position = placement.position(origin + voxel, corner(end).as_vec3() * t);
                *normal = unit_or_zero(gradient);
            }
        }
    }

    /// The vertex on the edge from a voxel of the leaf to corner `step` of the voxel's cell.
    fn vertex(&self, voxel: IVec3, step: usize) -> u32 {
        let offset = offset_in_leaf(voxel);
        let before_in_row: u32 =
            self.crossed[offset & !7..offset].iter().map(|edges| edges.count_ones()).sum();
        let before_at_voxel = (self.crossed[offset] & ((1 << step) - 1)).count_ones();
        self.first_vertex + u32::from(self.row_starts[offset / 8]) + before_in_row + before_at_voxel
    }
}

/// Corner `4x + 2y + z` of a cell.
fn corner(number: usize) -> IVec3 {
    IVec3::new((number >> 2) as i32, (number >> 1 & 1) as i32, (number & 1) as i32)
}

/// The point where the surface crosses the edge from a voxel to the corner `end` of its cell, as a fraction
/// of the edge, and ∇φ at that point. The point is the zero of the cubic through φ at the edge's two voxels,
/// the voxel before them and the voxel after them.
fn crossing(block: &PhiBlock, index: usize, end: usize) -> (f32, Vec3) {
    let step = (end >> 2) * BLOCK_STEP[0] + (end >> 1 & 1) * BLOCK_STEP[1] + (end & 1);
    let (one, other) = (block.phi(index), block.phi(index + step));
    let bends = [index, index + step].map(|index| block.second_difference(index, step));
    let mut t = one / (one - other);
    // Newton-like steps with a fixed slope, that of the linear interpolant. Usually the curvature of φ is a
    // small correction. Where it is large (noise, sheets), the steps are limited, and the result stays
    // between the voxels.
    for _ in 0..CROSSING_STEPS {
        let bulge = t * (1.0 - t) / 6.0 * ((2.0 - t) * bends[0] + (1.0 + t) * bends[1]);
        let phi = one + (other - one) * t - bulge;
        let change = (phi / (one - other)).clamp(-CROSSING_LIMIT, CROSSING_LIMIT);
        t = (t + change).clamp(EDGE_MARGIN, 1.0 - EDGE_MARGIN);
    }
    (t, block.gradient(index).lerp(block.gradient(index + step), t))
}

/// Number of steps from the linear to the cubic crossing. Each step gains about two digits of accuracy.
const CROSSING_STEPS: usize = 2;

/// Maximum length of these steps, in edge lengths.
const CROSSING_LIMIT: f32 = 0.125;

/// All patches, with the data needed to find each other's vertices.
struct TetMesh<'a> {
    masks: &'a [LeafMask],
    cases: Cases,
    patches: &'a [TetPatch],
    patch_of_leaf: Vec<u32>,
}

impl TetMesh<'_> {
    /// Writes the triangles in a leaf's cells.
    fn write_triangles(&self, patch: &TetPatch, triangles: &mut [[u32; 3]]) {
        let rows = SignRows::new(&patch.neighborhood, self.masks);
        let mut slices = triangles.iter_mut();
        for cell in rows.crossed_cells().iter().map(voxel_in_leaf) {
            let made = triangles_in_cell(&self.cases, rows.cell_signs(cell)).flatten();
            for (edges, triangle) in made.zip(&mut slices) {
                *triangle = edges.map(|edge| self.vertex(patch, cell, edge));
            }
        }
    }

    /// The vertex on an edge of a cell, from one corner to a later one.
    fn vertex(&self, patch: &TetPatch, cell: IVec3, [start, end]: [usize; 2]) -> u32 {
        let voxel = cell + corner(start);
        let leaf = patch.neighborhood.leaf(voxel >> 3);
        let owner = self.patch_of_leaf[leaf as usize] as usize;
        self.patches[owner].vertex(voxel & 7, end - start)
    }
}

/// The triangles in a cell whose corners have these signs, tetrahedron by tetrahedron.
fn triangles_in_cell(cases: &Cases, signs: u8) -> impl Iterator<Item = &[[[usize; 2]; 3]]> {
    KUHN_PATHS.iter().zip(cases).map(move |(path, cases)| {
        let case = (0..4).map(|k| usize::from(signs >> path[k] & 1) << k).sum::<usize>();
        &cases[case][..]
    })
}

/// The tetrahedra of a cell, given by their corners. The last three are mirror images of the first three.
const KUHN_PATHS: [[usize; 4]; 6] =
    [[0, 4, 6, 7], [0, 2, 3, 7], [0, 1, 5, 7], [0, 4, 5, 7], [0, 1, 3, 7], [0, 2, 6, 7]];

/// Triangles. Each corner of a triangle is given by the edge of the cell that it lies on: `[start, end]`, the
/// numbers of the edge's first and last corner.
type Triangles = Vec<[[usize; 2]; 3]>;

/// For each tetrahedron and each sign pattern of its corners, the triangles that separate them.
type Cases = Vec<[Triangles; 16]>;

fn tetrahedron_cases() -> Cases {
    let is_mirrored = |tetrahedron: usize| tetrahedron >= 3;
    let cases = |tetrahedron| {
        std::array::from_fn(|signs| triangles_of(KUHN_PATHS[tetrahedron], is_mirrored(tetrahedron), signs))
    };
    (0..6).map(cases).collect()
}

fn triangles_of(path: [usize; 4], is_mirrored: bool, signs: usize) -> Triangles {
    let is_inside = |corner: usize| signs >> corner & 1 == 1;
    let inside_count = signs.count_ones();
    // An order of the corners that keeps the tetrahedron's orientation and starts with the side that has
    // fewer corners, or with the inside corners if both sides have two.
    let leads = |corner: usize| is_inside(corner) == (inside_count <= 2);
    let lead_count = (0..4).filter(|&corner| leads(corner)).count();
    let order = EVEN_ORDERS.into_iter().find(|order| order[..lead_count].iter().all(|&corner| leads(corner)));
    let [i, j, k, l] = order.expect("some even permutation starts with any given corners");
    let edge = |one: usize, other: usize| [path[one.min(other)], path[one.max(other)]];
    // Counter-clockwise as seen from the side of the remaining corners.
    let mut triangles = match lead_count {
        1 => vec![[edge(i, j), edge(i, k), edge(i, l)]],
        2 => vec![[edge(i, k), edge(i, l), edge(j, l)], [edge(j, l), edge(j, k), edge(i, k)]],
        _ => Vec::new(),
    };
    if is_mirrored != (inside_count == 3) {
        triangles.iter_mut().for_each(|triangle| triangle.swap(1, 2));
    }
    triangles
}

/// Even permutations of four corners: each corner, and each pair of corners, comes first in one of them.
const EVEN_ORDERS: [[usize; 4]; 12] = [
    [0, 1, 2, 3],
    [0, 2, 3, 1],
    [0, 3, 1, 2],
    [1, 0, 3, 2],
    [1, 2, 0, 3],
    [1, 3, 2, 0],
    [2, 0, 1, 3],
    [2, 1, 3, 0],
    [2, 3, 0, 1],
    [3, 0, 2, 1],
    [3, 1, 0, 2],
    [3, 2, 1, 0],
];
