//! Marching tetrahedra: the surface of a function that is linear in each tetrahedron.
//!
//! Each cell is cut into six tetrahedra, one for each order in which a path from its first to its
//! last corner can take the three axes (Kuhn's, or Freudenthal's, subdivision):
//!
//! ```text
//!        3 ─────── 7        paths 0 → 7:   x y z   y z x   z x y    and, mirrored,   x z y   z y x   y x z
//!       ╱│      ╱ ╱│
//!      1 ───── 5   │        edges, by where they end, each from its first voxel:
//!      │ │  ╱  │   │          along one axis 3, across a face 3, through the cell 1: seven a voxel
//!      │ 2 ────│── 6
//!      │╱      │ ╱          a face is cut along the diagonal from its first to its last corner, so
//!      0 ───── 4            cells agree on it
//! ```
//!
//! A tetrahedron has no ambiguous case: its inside corners are one piece and so are its outside
//! corners. A vertex sits on each edge whose ends differ, strictly between them, and one triangle
//! or two cut the tetrahedron there. So two triangles meet at each edge of the mesh (one from each
//! tetrahedron of a face), the triangles around a vertex follow the ring of tetrahedra around its
//! edge, and no triangle is degenerate, since its corners lie on three edges that are not in one
//! plane, or that share just one corner, away from it.
//!
//! The vertices are where the cubic through four voxels along the edge is zero: linear
//! interpolation would pull a curved surface inwards by another amount in each direction.
//!
//! This work is based on:
//! Akio Doi, Akio Koide. An Efficient Method of Triangulating Equi-Valued Surfaces by Using
//! Tetrahedral Cells. 1991

use glam::{IVec3, Vec3};
use rayon::prelude::*;

use super::neighborhood::{BLOCK_STEP, Block, Neighborhood, SignRows};
use super::normals::unit_or_zero;
use super::{Placement, concatenate, prefix_sums};
use crate::grid::{LEAF_VOXELS, LeafMask, negative_masks, offset_in_leaf, voxel_in_leaf};
use crate::level_set::NarrowBand;
use crate::mesh::Mesh;

/// Vertices keep this part of their edge away from its ends: what makes every triangle have an
/// area. Larger would bend the surface visibly where it passes close to a voxel.
const EDGE_MARGIN: f32 = 1.0 / 128.0;

/// The surface of φ = 0 in the tetrahedra. A normal is zero where φ does not give one.
pub(super) fn march_tetrahedra(band: &NarrowBand, placement: &Placement) -> Mesh {
    let masks = negative_masks(&band.phi);
    let patches: Vec<Patch> = (0..band.topology.len())
        .into_par_iter()
        .filter_map(|leaf| Patch::new(band, placement, &masks, leaf))
        .collect();
    let first_vertices = prefix_sums(patches.iter().map(|patch| patch.positions.len()));
    let mut patch_of_leaf = vec![NO_PATCH; band.topology.len()];
    for (index, patch) in patches.iter().enumerate() {
        patch_of_leaf[patch.leaf] = index as u32;
    }
    let surface = Surface { cases: tetrahedron_cases(), patches: &patches, patch_of_leaf, first_vertices };
    let triangles: Vec<Vec<[u32; 3]>> = patches.par_iter().map(|patch| surface.triangles(patch)).collect();
    Mesh {
        positions: concatenate(patches.iter().map(|patch| &patch.positions)),
        normals: concatenate(patches.iter().map(|patch| &patch.normals)),
        triangles: concatenate(triangles.iter()),
        origin: placement.world_origin(),
    }
}

/// In place of a patch's index: the leaf has no vertices.
const NO_PATCH: u32 = u32::MAX;

/// The vertices on the edges that start in one leaf.
struct Patch {
    leaf: usize,
    neighborhood: Neighborhood,
    rows: SignRows,
    /// For each voxel a bit for each crossed edge that starts there: bit d for the edge to the
    /// voxel that is d away, as a corner number (1 to 7).
    crossed: Box<[u8; LEAF_VOXELS]>,
    /// For each voxel the first of its vertices.
    first_at_voxel: Box<[u16; LEAF_VOXELS]>,
    positions: Vec<Vec3>,
    normals: Vec<Vec3>,
}

impl Patch {
    fn new(
        band: &NarrowBand,
        placement: &Placement,
        inside_masks: &[LeafMask],
        leaf: usize,
    ) -> Option<Patch> {
        let neighborhood = Neighborhood::new(&band.topology, leaf);
        let rows = SignRows::new(&neighborhood, inside_masks);
        // An edge belongs to its first voxel's leaf even if all cells around it belong to others.
        if (1..8).all(|end| rows.crossed_to(end).is_empty()) {
            return None;
        }
        let mut crossed = Box::new([0; LEAF_VOXELS]);
        for end in 1..8 {
            rows.crossed_to(end).iter().for_each(|offset| crossed[offset] |= 1 << end);
        }
        let mut block = Block::new(band.half_width);
        block.fill(&neighborhood, &band.phi);
        let origin = band.topology.origins()[leaf];
        let mut first_at_voxel = Box::new([0; LEAF_VOXELS]);
        let (mut positions, mut normals) = (Vec::with_capacity(400), Vec::with_capacity(400));
        for (offset, &edges) in crossed.iter().enumerate().filter(|(_, edges)| **edges != 0) {
            first_at_voxel[offset] = positions.len() as u16;
            let voxel = voxel_in_leaf(offset);
            for end in (1..8).filter(|end| edges >> end & 1 == 1) {
                let (t, gradient) = crossing(&block, Block::index(voxel), end);
                positions.push(placement.position(origin + voxel, corner(end).as_vec3() * t));
                normals.push(unit_or_zero(gradient));
            }
        }
        Some(Patch { leaf, neighborhood, rows, crossed, first_at_voxel, positions, normals })
    }
}

/// Corner `4x + 2y + z` of a cell.
fn corner(number: usize) -> IVec3 {
    IVec3::new((number >> 2) as i32, (number >> 1 & 1) as i32, (number & 1) as i32)
}

/// Where on the edge from a voxel to the corner `end` of its cell the cubic through the two voxels
/// and those before and after them is zero, and ∇φ there.
fn crossing(block: &Block, index: usize, end: usize) -> (f32, Vec3) {
    let step = (end >> 2) * BLOCK_STEP[0] + (end >> 1 & 1) * BLOCK_STEP[1] + (end & 1);
    let (one, other) = (block.phi(index), block.phi(index + step));
    let bends = [index, index + step].map(|index| block.second_difference(index, step));
    let mut t = one / (one - other);
    // Secant steps with the slope of the chord: the bend is a small correction, and where it is not
    // (noise, sheets) the steps stay short and end between the voxels.
    for _ in 0..CROSSING_STEPS {
        let bulge = t * (1.0 - t) / 6.0 * ((2.0 - t) * bends[0] + (1.0 + t) * bends[1]);
        let phi = one + (other - one) * t - bulge;
        let change = (phi / (one - other)).clamp(-CROSSING_LIMIT, CROSSING_LIMIT);
        t = (t + change).clamp(EDGE_MARGIN, 1.0 - EDGE_MARGIN);
    }
    (t, block.gradient(index).lerp(block.gradient(index + step), t))
}

/// Steps from the linear to the cubic crossing. Each gains about two digits.
const CROSSING_STEPS: usize = 2;

/// The longest of these steps, in edge lengths.
const CROSSING_LIMIT: f32 = 0.125;

/// All patches, with what is needed to name each other's vertices.
struct Surface<'a> {
    cases: Vec<[Vec<[[usize; 2]; 3]>; 16]>,
    patches: &'a [Patch],
    patch_of_leaf: Vec<u32>,
    first_vertices: Vec<u32>,
}

impl Surface<'_> {
    /// The triangles in a leaf's cells.
    fn triangles(&self, patch: &Patch) -> Vec<[u32; 3]> {
        let mut triangles = Vec::with_capacity(800);
        patch.rows.crossed_cells().iter().map(voxel_in_leaf).for_each(|cell| {
            let signs = patch.rows.cell_signs(cell) as usize;
            for (path, cases) in KUHN_PATHS.iter().zip(&self.cases) {
                let case = (0..4).map(|k| (signs >> path[k] & 1) << k).sum::<usize>();
                for triangle in &cases[case] {
                    triangles.push(triangle.map(|edge| self.vertex(patch, cell, edge)));
                }
            }
        });
        triangles
    }

    /// The vertex on an edge of a cell, from one corner to a later one.
    fn vertex(&self, patch: &Patch, cell: IVec3, [start, end]: [usize; 2]) -> u32 {
        let voxel = cell + corner(start);
        let leaf = patch.neighborhood.leaf(voxel >> 3);
        let owner = self.patch_of_leaf[leaf as usize] as usize;
        let offset = offset_in_leaf(voxel & 7);
        let patch = &self.patches[owner];
        let before = patch.crossed[offset] & ((1 << (end - start)) - 1);
        self.first_vertices[owner] + u32::from(patch.first_at_voxel[offset]) + before.count_ones()
    }
}

/// The tetrahedra of a cell by their corners; of the six, the last three are mirror images.
const KUHN_PATHS: [[usize; 4]; 6] =
    [[0, 4, 6, 7], [0, 2, 3, 7], [0, 1, 5, 7], [0, 4, 5, 7], [0, 1, 3, 7], [0, 2, 6, 7]];

/// Triangles by the edges of the cell that their corners are on, from corner to later corner.
type Triangles = Vec<[[usize; 2]; 3]>;

/// For each tetrahedron, and for each pattern of its corners' signs, the triangles that cut it.
fn tetrahedron_cases() -> Vec<[Triangles; 16]> {
    let is_mirrored = |tetrahedron: usize| tetrahedron >= 3;
    let cases = |tetrahedron| {
        std::array::from_fn(|signs| triangles_of(KUHN_PATHS[tetrahedron], is_mirrored(tetrahedron), signs))
    };
    (0..6).map(cases).collect()
}

fn triangles_of(path: [usize; 4], is_mirrored: bool, signs: usize) -> Triangles {
    let is_inside = |corner: usize| signs >> corner & 1 == 1;
    let inside_count = signs.count_ones();
    // The corners in an order that keeps the tetrahedron's orientation: those of the lesser side
    // first, or in a draw those inside.
    let leads = |corner: usize| is_inside(corner) == (inside_count <= 2);
    let lead_count = (0..4).filter(|&corner| leads(corner)).count();
    let order = EVEN_ORDERS.into_iter().find(|order| order[..lead_count].iter().all(|&corner| leads(corner)));
    let [i, j, k, l] = order.expect("every set of corners comes first in an even order");
    let edge = |one: usize, other: usize| [path[one.min(other)], path[one.max(other)]];
    // Counter-clockwise as seen from the side of the corners that do not lead.
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

/// Orders of four corners that keep the orientation; any one corner, and any two, come first in one.
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
