//! Dual contouring: a vertex for each sheet of surface in a cell, a quad for each crossed grid edge.
//!
//! ```text
//!      ┌───────┬───────┐          cells around a crossed edge, seen along it
//!      │   ·───┼──·    │
//!      │   │   │   │   │          ┼ in the middle: the crossed edge
//!      ├───┼───┼───┼───┤          · a vertex in each of its four cells
//!      │   ·───┼───·   │
//!      │       │       │          their quad, cut along one of its diagonals
//!      └───────┴───────┘
//! ```
//!
//! # Why the mesh is closed and a manifold
//!
//! 1. Take the cycles of all cells ([`super::cell_cycles`]) as polygons with the crossed edges as
//!    corners and the segments on the faces as sides. Both cells of a face draw the same segments
//!    there, so every side belongs to exactly two polygons. A crossed edge has four cells and four
//!    faces around it, with one polygon corner in each and one side on each: one closed ring. So
//!    the polygons form a closed 2-manifold.
//! 2. The dual mesh (a vertex a polygon, a side across each side, a quad around each corner) is
//!    the same manifold. The four vertices of a quad lie in four cells, hence differ, and the ring
//!    of quads around a vertex is the rim of its polygon, with three sides or more.
//! 3. What could go wrong is that two *different* sides of the dual mesh join the *same* two
//!    vertices: indexed triangles would then glue them, four triangles on one edge. Their two cells
//!    share only one face, so both segments are on this face: it is ambiguous, and in both cells
//!    its two segments belong to one cycle. Exactly then ([`CellCycles::joined_faces`] on both
//!    sides) each of the two sides gets a vertex of its own in its middle, on the face.
//! 4. A quad without such a vertex is cut along a diagonal. Its ends lie in cells that share nothing
//!    but this grid edge, so no other quad has the same diagonal, and no side joins them. A polygon
//!    with such vertices becomes a fan around a vertex of its own, on the crossed edge. So all
//!    edges of the triangle mesh are distinct, each is in exactly two triangles, and the triangles
//!    around a vertex form one ring. ∎
//!
//! # Why no triangle is degenerate
//!
//! Seen along its grid edge, a quad has one vertex strictly inside each quadrant around the edge
//! ([`CELL_MARGIN`](super::cell_vertex::CELL_MARGIN)), so it is star-shaped about the edge and has at
//! most one reflex corner: the diagonal from this corner, or else any, cuts it into two triangles
//! that are not flipped. A fan is about the edge itself, and its other added vertices lie on the
//! half-axes between the quadrants. Rounding keeps all of these orders as long as it is finer than
//! the margin, and where it could matter the cut is decided on the rounded positions; so the promise
//! holds for what a reader of the mesh computes, at least as far as 16 384 voxels from the mesh's
//! origin. Everywhere else the cut depends on nothing but φ around the edge.
//!
//! This work is based on:
//! Gregory M. Nielson. Dual Marching Cubes. 2004
//! Scott Schaefer, Tao Ju, Joe Warren. Manifold Dual Contouring. 2007

use glam::{DVec3, IVec3, Vec3};
use rayon::prelude::*;
use rustc_hash::FxHashSet;

use super::cell_cycles::{CellCycles, cell_cycles, corner_bit};
use super::cell_vertex::CellSamples;
use super::neighborhood::{Block, Neighborhood, SignRows, inside_masks};
use super::normals::unit_or_zero;
use super::{Placement, concatenate, prefix_sums};
use crate::grid::{LEAF_VOXELS, offset_in_leaf};
use crate::level_set::NarrowBand;
use crate::mesh::Mesh;

/// The dual mesh of φ = 0. A normal is zero where φ does not give one.
pub(super) fn dual_contour(band: &NarrowBand, placement: &Placement) -> Mesh {
    let masks = inside_masks(&band.phi);
    let mut patches: Vec<Patch> = (0..band.topology.len())
        .into_par_iter()
        .filter_map(|leaf| {
            let neighborhood = Neighborhood::new(&band.topology, leaf);
            let rows = SignRows::new(&neighborhood, &masks);
            let any = rows.crossed_cells().next().is_some();
            any.then(|| Patch::new(band, placement, leaf, neighborhood, rows))
        })
        .collect();
    let joined_leaves: FxHashSet<u32> =
        patches.iter().filter(|patch| !patch.on_faces.is_empty()).map(|patch| patch.leaf as u32).collect();
    if !joined_leaves.is_empty() {
        patches
            .par_iter_mut()
            .filter(|patch| patch.neighborhood.leaves().iter().any(|leaf| joined_leaves.contains(leaf)))
            .for_each(|patch| patch.push_edge_points(band, placement));
    }
    let first_vertices = prefix_sums(patches.iter().map(|patch| patch.positions.len()));
    let mut patch_of_leaf = vec![NO_PATCH; band.topology.len()];
    for (index, patch) in patches.iter().enumerate() {
        patch_of_leaf[patch.leaf] = index as u32;
    }
    let positions = concatenate(patches.iter().map(|patch| &patch.positions));
    let normals = concatenate(patches.iter().map(|patch| &patch.normals));
    let surface = Surface { patches: &patches, patch_of_leaf, first_vertices, positions: &positions };
    let triangles: Vec<Vec<[u32; 3]>> =
        (0..patches.len()).into_par_iter().map(|patch| surface.triangles(patch)).collect();
    let triangles = concatenate(triangles.iter());
    Mesh { positions, normals, triangles, origin: placement.world_origin() }
}

/// In place of a patch's index: the leaf has no surface.
const NO_PATCH: u32 = u32::MAX;

/// The vertices of one leaf.
struct Patch {
    leaf: usize,
    neighborhood: Neighborhood,
    rows: SignRows,
    /// For each crossed cell the vertex of its first cycle; the others follow it.
    first_in_cell: Box<[u16; LEAF_VOXELS]>,
    /// Vertices in the middle of segments, by [`segment_key`].
    on_faces: Vec<(u16, u16)>,
    /// The first of the vertices on edges; they follow in the order of the edges.
    first_on_edges: u16,
    /// Of the vertices in cells: their places relative to the cell.
    in_cells: Vec<Vec3>,
    positions: Vec<Vec3>,
    normals: Vec<Vec3>,
}

impl Patch {
    fn new(
        band: &NarrowBand,
        placement: &Placement,
        leaf: usize,
        neighborhood: Neighborhood,
        rows: SignRows,
    ) -> Patch {
        let block = Block::new(&neighborhood, &band.phi, band.half_width);
        let origin = band.topology.origins()[leaf];
        let mut first_in_cell = Box::new([0; LEAF_VOXELS]);
        let mut on_faces = Vec::new();
        let mut in_cells = Vec::with_capacity(128);
        let mut positions = Vec::with_capacity(128);
        let mut normals = Vec::with_capacity(128);
        let mut push = |cell: IVec3, samples: &CellSamples, local: Vec3| -> u16 {
            positions.push(placement.position(origin + cell, local));
            normals.push(unit_or_zero(samples.gradient(local)));
            (positions.len() - 1) as u16
        };
        let mut count = 0;
        rows.crossed_cells().for_each(|cell| {
            let samples = CellSamples::new(&block, Block::index(cell));
            let cycles = cycles_at(&rows, cell);
            first_in_cell[offset_in_leaf(cell)] = count;
            for &edges in &cycles.edges[..cycles.count] {
                let local = samples.vertex(edges);
                in_cells.push(local);
                count = push(cell, &samples, local) + 1;
            }
        });
        let has_joined_face = |cell: &IVec3| cycles_at(&rows, *cell).joined_faces != 0;
        rows.crossed_cells().filter(has_joined_face).for_each(|cell| {
            for axis in (0..3).filter(|&axis| is_joined(&rows, cell, axis)) {
                let samples = CellSamples::new(&block, Block::index(cell));
                for corner in inside_corners(rows.cell_signs(cell), axis) {
                    let key = segment_key(cell, axis, corner);
                    count = push(cell, &samples, samples.segment_middle(axis, corner)) + 1;
                    on_faces.push((key, count - 1));
                }
            }
        });
        let first_on_edges = count;
        Patch {
            leaf,
            neighborhood,
            rows,
            first_in_cell,
            on_faces,
            first_on_edges,
            in_cells,
            positions,
            normals,
        }
    }

    /// Adds the vertices on the leaf's own edges whose quads have vertices on their sides.
    fn push_edge_points(&mut self, band: &NarrowBand, placement: &Placement) {
        let block = Block::new(&self.neighborhood, &band.phi, band.half_width);
        let origin = band.topology.origins()[self.leaf];
        for axis in 0..3 {
            for voxel in self.rows.crossed_edges(axis) {
                if Ring::new(&self.rows, voxel, axis).has_joined_side() {
                    let samples = CellSamples::new(&block, Block::index(voxel));
                    let local = samples.edge_point(axis);
                    self.positions.push(placement.position(origin + voxel, local));
                    self.normals.push(unit_or_zero(samples.gradient(local)));
                }
            }
        }
    }
}

fn cycles_at(rows: &SignRows, cell: IVec3) -> &'static CellCycles {
    cell_cycles(rows.cell_signs(cell))
}

/// Whether both segments of the face that `cell` shares with the cell before it along `axis` belong
/// to one cycle on either side.
fn is_joined(rows: &SignRows, cell: IVec3, axis: usize) -> bool {
    let is_joined_at =
        |cell: IVec3, side: usize| cycles_at(rows, cell).joined_faces >> (2 * axis + side) & 1 == 1;
    is_joined_at(cell, 0) && is_joined_at(cell - IVec3::AXES[axis], 1)
}

/// The inside corners of a cell on its near face along `axis`, as places on the two axes after it.
fn inside_corners(signs: u8, axis: usize) -> impl Iterator<Item = [usize; 2]> {
    let (b, c) = (corner_bit((axis + 1) % 3), corner_bit((axis + 2) % 3));
    [[0, 0], [0, 1], [1, 0], [1, 1]].into_iter().filter(move |[i, j]| signs >> (i * b + j * c) & 1 == 1)
}

/// Names a segment of an ambiguous face in its leaf: the face by its first voxel and its normal, the
/// segment by the inside corner that it cuts off (the two differ on both axes: one will do).
fn segment_key(first_voxel: IVec3, normal_axis: usize, corner: [usize; 2]) -> u16 {
    (offset_in_leaf(first_voxel) * 8 + normal_axis * 2 + corner[0]) as u16
}

/// The four cells around a crossed edge, counter-clockwise as seen from its end.
///
/// ```text
///        c             a: the edge's axis, towards the reader
///    1   │   0         b, c: the axes after it
///   ─────┼───── b      side k: the face between cell k and cell k + 1
///    2   │   3
/// ```
struct Ring {
    axis: usize,
    cells: [IVec3; 4],
    /// In each cell the cycle that goes through the edge.
    cycles: [u8; 4],
    /// Bit k: side k is joined, see [`is_joined`].
    joined_sides: u8,
}

/// Where in each cell of a ring the edge is, as `2b + c`.
const RING_PLACES: [usize; 4] = [0, 2, 3, 1];

/// For each side of a ring which of the two axes is normal to it, and the cell on its far side: the
/// one whose first voxel is also the face's.
const RING_SIDES: [(usize, usize); 4] = [(1, 0), (2, 1), (1, 3), (2, 0)];

impl Ring {
    fn new(rows: &SignRows, start: IVec3, axis: usize) -> Ring {
        let (b, c) = (IVec3::AXES[(axis + 1) % 3], IVec3::AXES[(axis + 2) % 3]);
        let cells = [start, start - b, start - b - c, start - c];
        let around: [&CellCycles; 4] = std::array::from_fn(|k| cycles_at(rows, cells[k]));
        let cycles = std::array::from_fn(|k| around[k].of_edge[axis * 4 + RING_PLACES[k]]);
        let mut joined_sides = 0;
        if around.iter().any(|cycles| cycles.joined_faces != 0) {
            for (side, (turn, far)) in RING_SIDES.into_iter().enumerate() {
                let normal_axis = (axis + turn) % 3;
                let near = if far == side { (side + 1) % 4 } else { side };
                let is_joined = around[far].joined_faces >> (2 * normal_axis)
                    & around[near].joined_faces >> (2 * normal_axis + 1)
                    & 1;
                joined_sides |= is_joined << side;
            }
        }
        Ring { axis, cells, cycles, joined_sides }
    }

    fn has_joined_side(&self) -> bool {
        self.joined_sides != 0
    }
}

/// All patches, with what is needed to name each other's vertices.
struct Surface<'a> {
    patches: &'a [Patch],
    /// For each leaf its patch, or [`NO_PATCH`].
    patch_of_leaf: Vec<u32>,
    /// For each patch the place of its vertices in the mesh.
    first_vertices: Vec<u32>,
    positions: &'a [Vec3],
}

impl Surface<'_> {
    /// The triangles around the crossed edges that start in a patch's leaf.
    fn triangles(&self, patch_index: usize) -> Vec<[u32; 3]> {
        let patch = &self.patches[patch_index];
        let mut next_on_edge = self.first_vertices[patch_index] + u32::from(patch.first_on_edges);
        let mut triangles = Vec::with_capacity(256);
        for axis in 0..3 {
            patch.rows.crossed_edges(axis).for_each(|start| {
                let ring = Ring::new(&patch.rows, start, axis);
                let is_start_inside = patch.rows.is_inside(start);
                let [p, q, r, s] = [0, 1, 2, 3].map(|k| self.cell_vertex(patch, &ring, k));
                let corners = [p.0, q.0, r.0, s.0];
                let begin = triangles.len();
                if ring.has_joined_side() {
                    let inside_end = if is_start_inside { start } else { start + IVec3::AXES[axis] };
                    let rim = self.subdivided(patch, &ring, corners, inside_end);
                    let pairs = (0..rim.len()).map(|k| (rim[k], rim[(k + 1) % rim.len()]));
                    triangles.extend(pairs.map(|(one, other)| [next_on_edge, one, other]));
                    next_on_edge += 1;
                } else {
                    let rounded = |k: usize| self.positions[corners[k] as usize].as_dvec3();
                    for [a, b, c] in cut([p.1, q.1, r.1, s.1], axis, rounded) {
                        triangles.push([corners[a], corners[b], corners[c]]);
                    }
                }
                if !is_start_inside {
                    triangles[begin..].iter_mut().for_each(|triangle| triangle.swap(1, 2));
                }
            });
        }
        triangles
    }

    /// The vertex of cell k of a ring, and its place relative to the edge's first voxel.
    fn cell_vertex(&self, patch: &Patch, ring: &Ring, k: usize) -> (u32, Vec3) {
        let (owner, voxel) = self.owner(patch, ring.cells[k]);
        let in_patch = self.patches[owner].first_in_cell[offset_in_leaf(voxel)] + u16::from(ring.cycles[k]);
        let local = self.patches[owner].in_cells[usize::from(in_patch)];
        let place = (ring.cells[k] - ring.cells[0]).as_vec3() + local;
        (self.first_vertices[owner] + u32::from(in_patch), place)
    }

    /// The corners of a ring's quad with the vertices on its joined sides between them.
    fn subdivided(&self, patch: &Patch, ring: &Ring, corners: [u32; 4], inside_end: IVec3) -> Vec<u32> {
        let mut rim = Vec::with_capacity(8);
        for (side, (turn, far)) in RING_SIDES.into_iter().enumerate() {
            rim.push(corners[side]);
            if ring.joined_sides >> side & 1 == 1 {
                let normal_axis = (ring.axis + turn) % 3;
                let corner = (inside_end - ring.cells[far]).to_array();
                let corner = [1, 2].map(|turn| corner[(normal_axis + turn) % 3] as usize);
                let (owner, voxel) = self.owner(patch, ring.cells[far]);
                let on_faces = &self.patches[owner].on_faces;
                let key = segment_key(voxel, normal_axis, corner);
                let found = on_faces.binary_search_by_key(&key, |&(key, _)| key);
                let place = found.expect("a joined face has a vertex on each of its segments");
                rim.push(self.first_vertices[owner] + u32::from(on_faces[place].1));
            }
        }
        rim
    }

    /// The patch that a cell (−1 ..= 7 on each axis) belongs to, and the cell's first voxel in it.
    fn owner(&self, patch: &Patch, cell: IVec3) -> (usize, IVec3) {
        let leaf = patch.neighborhood.leaf(cell >> 3);
        (self.patch_of_leaf[leaf as usize] as usize, cell & 7)
    }
}

/// The two ways to cut a quad into triangles, as places in it.
const CUTS: [[[usize; 3]; 2]; 2] = [[[0, 1, 2], [2, 3, 0]], [[1, 2, 3], [3, 0, 1]]];

/// The second cut must be better by this factor, so that rounding does not decide in a square.
const CLEARLY_BETTER: f32 = 1.001;

/// Triangles with this doubled area, in voxels squared and seen along the edge, are not flipped by
/// rounding.
const SAFE_AREA: f64 = 1.0 / 32.0;

/// The two triangles of a ring's quad: those whose worse one is nearer to equilateral, if `rounded`
/// positions do not flip or flatten one of them.
fn cut(quad: [Vec3; 4], axis: usize, rounded: impl Fn(usize) -> DVec3) -> [[usize; 3]; 2] {
    let [p, q, r, s] = quad;
    let along_pr = shape(p, q, r).min(shape(r, s, p));
    let along_qs = shape(q, r, s).min(shape(s, p, q));
    let better = CUTS[usize::from(along_qs > CLEARLY_BETTER * along_pr)];
    let exact = |k: usize| quad[k].as_dvec3();
    if better.iter().all(|&triangle| projected_area(triangle, axis, exact) > SAFE_AREA) {
        return better;
    }
    let least_area = |cut: [[usize; 3]; 2]| {
        projected_area(cut[0], axis, &rounded).min(projected_area(cut[1], axis, &rounded))
    };
    CUTS[usize::from(least_area(CUTS[1]) > least_area(CUTS[0]))]
}

/// How near a triangle is to equilateral: its area squared over the sum of its squared edges squared.
fn shape(a: Vec3, b: Vec3, c: Vec3) -> f32 {
    let (to_b, to_c) = (b - a, c - a);
    let edges_squared = to_b.length_squared() + to_c.length_squared() + b.distance_squared(c);
    to_b.cross(to_c).length_squared() / (edges_squared * edges_squared)
}

/// Twice the area of a triangle as seen along an axis; negative if it turns the wrong way.
fn projected_area([a, b, c]: [usize; 3], axis: usize, point: impl Fn(usize) -> DVec3) -> f64 {
    let (to_b, to_c) = (point(b) - point(a), point(c) - point(a));
    let (right, up) = ((axis + 1) % 3, (axis + 2) % 3);
    to_b[right] * to_c[up] - to_b[up] * to_c[right]
}
