//! Dual contouring: one vertex per sheet of surface in a cell, one quad per crossed grid edge.
//!
//! ```text
//!      ┌───────┬───────┐          cells around a crossed edge, seen along it
//!      │   ·───┼──·    │
//!      │   │   │   │   │          ┼ in the middle: the crossed edge
//!      ├───┼───┼───┼───┤          · a vertex in each of its four cells
//!      │   ·───┼───·   │
//!      │       │       │          their quad is split along one of its diagonals
//!      └───────┴───────┘
//! ```
//!
//! # Why the mesh is closed and manifold
//!
//! 1. Consider the cycles of all cells ([`super::cell_cycles`]) as polygons: the crossed edges are their corners
//!    and the segments on the faces are their sides. Both cells of a face draw the same segments there, so
//!    every side belongs to exactly two polygons. A crossed edge has four cells and four faces around it, with
//!    one polygon corner in each cell and one side on each face: a single closed ring. So the polygons form a
//!    closed 2-manifold.
//! 2. The dual mesh (a vertex per polygon, an edge across each side, a quad around each corner) is the same
//!    manifold. The four vertices of a quad lie in four cells, hence differ. The ring of quads around a vertex
//!    follows the boundary of its polygon, which has at least three sides.
//! 3. One failure is possible: two *different* edges of the dual mesh join the *same* two vertices. Indexed
//!    triangles would then merge them, with four triangles on one edge. The two cells share only one face, so
//!    both segments are on this face: it is ambiguous, and in both cells its two segments belong to one cycle.
//!    Exactly in this case ([`CellCycles::joined_faces`] in both cells), each of the two edges gets an
//!    additional vertex in its middle, on the face.
//! 4. A quad without additional vertices is split along a diagonal. The ends of the diagonal lie in cells that
//!    share only this grid edge, so no other quad has the same diagonal, and no edge joins them. A quad with
//!    additional vertices becomes a fan around one more vertex, on the crossed edge. So all edges of the
//!    triangle mesh are distinct, each is in exactly two triangles, and the triangles around a vertex form one
//!    ring. ∎
//!
//! # Why no triangle is degenerate
//!
//! Seen along its grid edge, a quad has one vertex strictly inside each quadrant around the edge
//! ([`CELL_MARGIN`](super::cell_vertex::CELL_MARGIN)). So it is star-shaped about the edge and has at most
//! one reflex corner. The diagonal from this corner (or, if there is none, either diagonal) splits it into
//! two triangles that are not flipped. The center of a fan is on the edge itself, and its other additional
//! vertices lie on the half-axes between the quadrants. Rounding preserves this order as long as it is finer
//! than the margin. Where rounding might matter, the split is decided on the rounded positions, so the
//! guarantee holds for the positions in the file, up to at least 16 384 voxels from the mesh's origin.
//! Everywhere else, the split depends only on φ around the edge.
//!
//! This work is based on:
//! Gregory M. Nielson. Dual Marching Cubes. 2004
//! Scott Schaefer, Tao Ju, Joe Warren. Manifold Dual Contouring. 2007

use std::sync::LazyLock;

use glam::{IVec3, Vec3};
use rayon::prelude::*;

use super::cell_vertex::{CellSamples, VertexBatch, Vertices};
use super::neighborhood::{LeafNeighborhood, PhiBlock, SignRows};
use super::quads::Quads;
use super::{MeshPlacement, split, unit_or_zero};
use crate::grid::{LeafMask, negative_masks, offset_in_leaf, voxel_in_leaf};
use crate::level_set::NarrowBand;
use crate::mesh::Mesh;
use crate::parallel::Loops as _;
use crate::simd::{Kernel, Lanes, dispatch};

/// The dual mesh of φ = 0. A normal is zero where φ does not define one.
pub(super) fn dual_contour(band: &NarrowBand, placement: &MeshPlacement) -> Mesh {
    let layout = MeshLayout::new(band);
    let mut positions = bytemuck::zeroed_vec(layout.vertex_count);
    let mut normals = bytemuck::zeroed_vec(layout.vertex_count);
    let mut locals = bytemuck::zeroed_vec(layout.vertex_count);
    let vertices = |patch: &LeafPatch| patch.vertex_count();
    let slices = layout.split(&mut positions, vertices).into_par_iter();
    let slices = slices.zip(layout.split(&mut normals, vertices)).zip(layout.split(&mut locals, vertices));
    slices.zip(layout.patches.par_chunks(PATCHES_AT_ONCE)).with_max_len(1).for_each(
        |(((positions, normals), locals), patches)| {
            dispatch(PatchVertices { band, placement, layout: &layout, patches, locals, positions, normals });
        },
    );
    let mut triangles = bytemuck::zeroed_vec(layout.triangle_count);
    let quads = Quads {
        layout: &layout,
        on_faces: layout.vertices_on_faces(),
        locals: &locals,
        positions: &positions,
    };
    let slices = layout.split(&mut triangles, |patch| usize::from(patch.triangle_count));
    slices.into_par_iter().zip(layout.patches.par_chunks(PATCHES_AT_ONCE)).with_max_len(1).halved().for_each(
        |(triangles, patches)| {
            dispatch(PatchTriangles { quads: &quads, patches, triangles });
        },
    );
    Mesh { positions, normals, triangles, origin: placement.world_origin() }
}

/// Patch index of a leaf without surface.
const NO_PATCH: u32 = u32::MAX;

/// Number of patches per task.
const PATCHES_AT_ONCE: usize = 16;

/// What a leaf adds to the mesh, determined from signs alone.
pub(super) struct LeafPatch {
    pub(super) leaf: u32,
    pub(super) neighborhood: LeafNeighborhood,
    /// Index in the mesh of its first vertex.
    pub(super) first_vertex: u32,
    /// For each row of cells, its first vertex relative to the patch; the last entry is the end. The vertices
    /// on faces follow, and then those on edges.
    pub(super) row_starts: [u16; 65],
    on_faces_count: u16,
    pub(super) on_edges_count: u16,
    pub(super) triangle_count: u16,
}

impl LeafPatch {
    /// The patch of a leaf that the surface crosses. Its vertices on edges are counted later.
    #[inline(always)]
    fn new(leaf: usize, neighborhood: LeafNeighborhood, inside_masks: &[LeafMask]) -> Option<LeafPatch> {
        let rows = SignRows::new(&neighborhood, inside_masks);
        let crossed = rows.crossed_cells();
        if crossed.is_empty() {
            return None;
        }
        let mut row_starts = [0; 65];
        let mut any_joined = 0;
        for offset in crossed.iter() {
            let cycles = cell_cycles(rows.cell_signs(voxel_in_leaf(offset)));
            row_starts[offset / 8 + 1] += cycles.count as u16;
            any_joined |= cycles.joined_faces;
        }
        for row in 0..64 {
            row_starts[row + 1] += row_starts[row];
        }
        let on_faces_count = if any_joined == 0 { 0 } else { joined_segments(&rows).count() };
        let edge_count: u32 = (0..3).map(|axis| rows.crossed_edges(axis).count()).sum();
        Some(LeafPatch {
            leaf: leaf as u32,
            neighborhood,
            first_vertex: 0,
            row_starts,
            on_faces_count: on_faces_count as u16,
            on_edges_count: 0,
            triangle_count: 2 * edge_count as u16,
        })
    }

    fn vertex_count(&self) -> usize {
        usize::from(self.row_starts[64]) + usize::from(self.on_faces_count) + usize::from(self.on_edges_count)
    }

    /// Index in the mesh of the first vertex on a face.
    fn first_on_faces(&self) -> u32 {
        self.first_vertex + u32::from(self.row_starts[64])
    }

    /// Index in the mesh of the first vertex on an edge.
    pub(super) fn first_on_edges(&self) -> u32 {
        self.first_on_faces() + u32::from(self.on_faces_count)
    }
}

/// The layout of the mesh, determined before any vertex is computed.
pub(super) struct MeshLayout {
    pub(super) inside_masks: Vec<LeafMask>,
    /// Patches in the topology's order.
    pub(super) patches: Vec<LeafPatch>,
    /// For each leaf its patch, or [`NO_PATCH`].
    patch_of_leaf: Vec<u32>,
    vertex_count: usize,
    triangle_count: usize,
}

impl MeshLayout {
    fn new(band: &NarrowBand) -> MeshLayout {
        let inside_masks = negative_masks(&band.phi);
        let patch = |leaf: usize| {
            let neighborhood = LeafNeighborhood::new(&band.topology, leaf);
            let may_have_surface = neighborhood.may_have_surface(&inside_masks);
            may_have_surface.then(|| dispatch(NewPatch(leaf, neighborhood, &inside_masks))).flatten()
        };
        let patches: Vec<LeafPatch> =
            (0..band.topology.len()).into_par_iter().halved().filter_map(patch).collect();
        let mut patch_of_leaf = vec![NO_PATCH; band.topology.len()];
        for (index, patch) in patches.iter().enumerate() {
            patch_of_leaf[patch.leaf as usize] = index as u32;
        }
        let mut layout =
            MeshLayout { inside_masks, patches, patch_of_leaf, vertex_count: 0, triangle_count: 0 };
        layout.count_vertices_on_edges();
        for patch in &mut layout.patches {
            patch.first_vertex = layout.vertex_count as u32;
            layout.vertex_count += patch.vertex_count();
            layout.triangle_count += usize::from(patch.triangle_count);
        }
        assert!(layout.vertex_count <= u32::MAX as usize, "more vertices than 32-bit indices allow");
        layout
    }

    /// The patch of a leaf that contains surface.
    #[inline(always)]
    pub(super) fn patch(&self, leaf: u32) -> &LeafPatch {
        &self.patches[self.patch_of_leaf[leaf as usize] as usize]
    }

    /// Counts what quads with additional vertices on faces add. Each has one more vertex, on the edge. It
    /// also has two more triangles, plus one for each side with an additional vertex (`Ring::joined_sides`).
    /// There are few of these quads, and only next to leaves that have vertices on faces.
    fn count_vertices_on_edges(&mut self) {
        if self.patches.iter().all(|patch| patch.on_faces_count == 0) {
            return;
        }
        let has_any = |&leaf: &u32| {
            let patch =
                self.patch_of_leaf.get(leaf as usize).and_then(|&patch| self.patches.get(patch as usize));
            patch.is_some_and(|patch| patch.on_faces_count > 0)
        };
        let added = |(index, patch): (usize, &LeafPatch)| {
            let is_near = patch.neighborhood.leaves().iter().any(has_any);
            let rows = is_near.then(|| SignRows::new(&patch.neighborhood, &self.inside_masks))?;
            let sides = joined_rings(&rows).map(|(_, ring)| ring.joined_sides.count_ones() as u16);
            let (count, triangles) = sides.fold((0, 0), |(count, sum), sides| (count + 1, sum + 2 + sides));
            (count > 0).then_some((index, count, triangles))
        };
        let added: Vec<(usize, u16, u16)> =
            self.patches.par_iter().enumerate().halved().filter_map(added).collect();
        for (index, count, triangles) in added {
            self.patches[index].on_edges_count = count;
            self.patches[index].triangle_count += triangles;
        }
    }

    /// The vertices on faces, sorted: the leaf, the [`segment_key`] in the leaf, and the index in the mesh.
    fn vertices_on_faces(&self) -> Vec<(u32, u16, u32)> {
        let patches = self.patches.par_iter().halved().filter(|patch| patch.on_faces_count > 0);
        let vertices = patches.flat_map_iter(|patch| {
            let rows = SignRows::new(&patch.neighborhood, &self.inside_masks);
            let segments: Vec<_> = joined_segments(&rows).collect();
            let keys = segments.into_iter().map(|(cell, axis, corner)| segment_key(cell, axis, corner));
            keys.zip(patch.first_on_faces()..).map(|(key, vertex)| (patch.leaf, key, vertex))
        });
        vertices.collect()
    }

    /// Splits an array with `count` items per patch into one slice per task.
    fn split<'a, T>(&self, whole: &'a mut [T], count: impl Fn(&LeafPatch) -> usize) -> Vec<&'a mut [T]> {
        split(whole, self.patches.chunks(PATCHES_AT_ONCE).map(|patches| patches.iter().map(&count).sum()))
    }
}

/// The rings with joined sides around edges that start in a leaf, in order: the first voxel of the edge, and
/// the ring.
fn joined_rings(rows: &SignRows) -> impl Iterator<Item = (IVec3, Ring)> + '_ {
    let edges = (0..3).flat_map(|axis| {
        let edges: Vec<usize> = rows.crossed_edges(axis).iter().collect();
        edges.into_iter().map(move |offset| (voxel_in_leaf(offset), axis))
    });
    edges
        .map(|(start, axis)| (start, Ring::new(rows, start, axis)))
        .filter(|(_, ring)| ring.joined_sides != 0)
}

/// Kernel: creates a patch.
struct NewPatch<'a>(usize, LeafNeighborhood, &'a [LeafMask]);

impl Kernel for NewPatch<'_> {
    type Output = Option<LeafPatch>;

    #[inline(always)]
    fn run<V: Lanes>(self) -> Option<LeafPatch> {
        LeafPatch::new(self.0, self.1, self.2)
    }
}

/// Kernel: computes the vertices of patches.
struct PatchVertices<'a> {
    band: &'a NarrowBand,
    placement: &'a MeshPlacement,
    layout: &'a MeshLayout,
    patches: &'a [LeafPatch],
    /// Positions relative to the cells.
    locals: &'a mut [Vec3],
    positions: &'a mut [Vec3],
    normals: &'a mut [Vec3],
}

impl Kernel for PatchVertices<'_> {
    type Output = ();

    #[inline(always)]
    fn run<V: Lanes>(mut self) {
        let mut batch = VertexBatch::new();
        let mut block = PhiBlock::new(self.band.half_width);
        let mut done = 0;
        for patch in self.patches {
            let rows = SignRows::new(&patch.neighborhood, &self.layout.inside_masks);
            block.fill(&patch.neighborhood, &self.band.phi);
            let origin = self.band.topology.origins()[patch.leaf as usize];
            for offset in rows.crossed_cells().iter() {
                let cell = voxel_in_leaf(offset);
                let cycles = cell_cycles(rows.cell_signs(cell));
                for &edges in &cycles.edges[..cycles.count] {
                    batch.push(&block, PhiBlock::index(cell), origin + cell, edges);
                    if batch.is_full() {
                        self.find(&mut batch, &mut done);
                    }
                }
            }
            if patch.on_faces_count > 0 || patch.on_edges_count > 0 {
                self.find(&mut batch, &mut done);
                done = self.add_on_faces_and_edges(patch, &rows, &block, done);
            }
        }
        self.find(&mut batch, &mut done);
    }
}

impl PatchVertices<'_> {
    /// Computes the vertices of a batch; those before `done` are finished.
    #[inline(always)]
    fn find(&mut self, batch: &mut VertexBatch, done: &mut usize) {
        if batch.len() == 0 {
            return;
        }
        let range = *done..*done + batch.len();
        *done = range.end;
        let vertices = Vertices {
            locals: &mut self.locals[range.clone()],
            positions: &mut self.positions[range.clone()],
            normals: &mut self.normals[range],
        };
        batch.find(self.placement, vertices);
    }

    /// Adds a patch's vertices on faces and edges, and returns the index after them.
    fn add_on_faces_and_edges(
        &mut self,
        patch: &LeafPatch,
        rows: &SignRows,
        block: &PhiBlock,
        first: usize,
    ) -> usize {
        let origin = self.band.topology.origins()[patch.leaf as usize];
        let mut index = first;
        let mut add = |cell: IVec3, samples: &CellSamples, local: Vec3| {
            self.positions[index] = self.placement.position(origin + cell, local);
            self.normals[index] = unit_or_zero(samples.gradient(local));
            index += 1;
        };
        for (cell, axis, corner) in joined_segments(rows) {
            let samples = CellSamples::new(block, PhiBlock::index(cell));
            add(cell, &samples, samples.segment_middle(axis, corner));
        }
        if patch.on_edges_count > 0 {
            for (voxel, ring) in joined_rings(rows) {
                let samples = CellSamples::new(block, PhiBlock::index(voxel));
                add(voxel, &samples, samples.edge_point(ring.axis));
            }
        }
        index
    }
}

/// Kernel: writes the triangles of patches.
struct PatchTriangles<'a> {
    quads: &'a Quads<'a>,
    patches: &'a [LeafPatch],
    triangles: &'a mut [[u32; 3]],
}

impl Kernel for PatchTriangles<'_> {
    type Output = ();

    #[inline(always)]
    fn run<V: Lanes>(self) {
        let mut rest = self.triangles;
        for patch in self.patches {
            let (triangles, after) = rest.split_at_mut(usize::from(patch.triangle_count));
            self.quads.write(patch, triangles);
            rest = after;
        }
    }
}

// Determines how the surface cuts a cell, from the signs of the cell's corners alone.
//
// On each face of a cell, the surface is drawn as segments between the midpoints of crossed edges: one
// segment around each run of consecutive inside corners along the boundary of the face.
//
//    ○─────○     ●──┼──○     ●──┼──○     ●──┼──○      ● inside   ○ outside
//    │     │     │  │  │     │   ╲ │     ┼─╯   │      ┼ crossed edge
//    ┼─╮   │     │  │  │     │    ╲┼     │   ╭─┼
//    ●──┼──○     ●──┼──○     ●─────●     ○──┼──●      the last face is ambiguous: its inside corners are
//                                                     separated
//
// The rule depends only on the four signs of the face, so both cells of a face draw the same segments. A
// crossed edge lies on two faces of its cell, and on each of them one segment ends at the edge. Hence the
// segments of a crossed cell form one to four simple closed *cycles*, each around one sheet of the surface.
//
// Numbering: corner `4x + 2y + z` is at x, y and z. Edge `4a + 2b + c` is along axis a, at b and c on the
// two axes that follow a in the order x, y, z, x, y. Face `2a + side` is normal to axis a.

/// Value of an edge without a cycle.
const NO_CYCLE: u8 = u8::MAX;

/// The cycles of a cell.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct CellCycles {
    /// Number of cycles, 0 to 4.
    pub(super) count: usize,
    /// For each cycle, a mask of the edges it passes through.
    pub(super) edges: [u16; 4],
    /// For each edge, the index of its cycle, or [`NO_CYCLE`] if the edge is not crossed.
    pub(super) of_edge: [u8; 12],
    /// A mask of the ambiguous faces whose two segments belong to the same cycle.
    joined_faces: u8,
}

/// The cycles of a cell whose inside corners are the set bits of `signs`.
#[inline(always)]
pub(super) fn cell_cycles(signs: u8) -> &'static CellCycles {
    static TABLE: LazyLock<[CellCycles; 256]> =
        LazyLock::new(|| std::array::from_fn(|signs| trace_cycles(signs as u8)));
    &TABLE[usize::from(signs)]
}

/// The bit of an axis in a corner number.
pub(super) const fn corner_bit(axis: usize) -> usize {
    4 >> axis
}

/// The first and last corner of an edge.
pub(super) const fn edge_corners(edge: usize) -> (usize, usize) {
    let (axis, b, c) = (edge / 4, edge / 2 % 2, edge % 2);
    let start = b * corner_bit((axis + 1) % 3) + c * corner_bit((axis + 2) % 3);
    (start, start + corner_bit(axis))
}

fn trace_cycles(signs: u8) -> CellCycles {
    let segments: Vec<(usize, [usize; 2])> = (0..6)
        .flat_map(|face| segments_on(face, signs).into_iter().map(move |segment| (face, segment)))
        .collect();
    let mut cycles = CellCycles { count: 0, edges: [0; 4], of_edge: [NO_CYCLE; 12], joined_faces: 0 };
    for first_edge in 0..12 {
        let is_crossed = segments.iter().any(|(_, ends)| ends.contains(&first_edge));
        if !is_crossed || cycles.of_edge[first_edge] != NO_CYCLE {
            continue;
        }
        let mut edges: u16 = 1 << first_edge;
        // A cycle has at most 12 edges, so 12 rounds reach all of it.
        for _ in 0..12 {
            for (_, [one, other]) in &segments {
                if edges & (1 << one | 1 << other) != 0 {
                    edges |= 1 << one | 1 << other;
                }
            }
        }
        for edge in (0..12).filter(|edge| edges >> edge & 1 == 1) {
            cycles.of_edge[edge] = cycles.count as u8;
        }
        cycles.edges[cycles.count] = edges;
        cycles.count += 1;
    }
    for pair in segments.windows(2) {
        let [(face, one), (other_face, other)] = [pair[0], pair[1]];
        if face == other_face && cycles.of_edge[one[0]] == cycles.of_edge[other[0]] {
            cycles.joined_faces |= 1 << face;
        }
    }
    cycles
}

/// The segments on a face: for each run of inside corners along its boundary, the crossed edges where the run
/// begins and ends.
fn segments_on(face: usize, signs: u8) -> Vec<[usize; 2]> {
    let (axis, side) = (face / 2, face % 2);
    let (b, c) = (corner_bit((axis + 1) % 3), corner_bit((axis + 2) % 3));
    let face_corners = [0, b, b | c, c].map(|corner| corner + side * corner_bit(axis));
    let is_inside = |k: usize| signs >> face_corners[k % 4] & 1 == 1;
    let edge_after = |k: usize| edge_between(face_corners[k % 4], face_corners[(k + 1) % 4]);
    (0..4)
        .filter(|&k| is_inside(k) && !is_inside(k + 3))
        .map(|first| {
            let last = (first..first + 4).find(|&k| !is_inside(k + 1)).unwrap_or(first);
            [edge_after(first + 3), edge_after(last)]
        })
        .collect()
}

fn edge_between(one: usize, other: usize) -> usize {
    let ends = (one.min(other), one.max(other));
    (0..12).find(|&edge| edge_corners(edge) == ends).expect("adjacent corners of a face share an edge")
}

// The cells around an edge, and the faces between these cells that need an additional vertex per segment.
// ([`cell_cycles`] has the segments and cycles.)
//
//      ●──┼──○          An ambiguous face whose two segments belong to one cycle in both of its cells is
//      │   · ┼          *joined*: the dual mesh would have two edges between the same two vertices, so
//      ┼ ·   │          each of its segments gets an additional vertex in its middle (·).
//      ○──┼──●
//
// Only thin sheets and noise have such faces. All functions here depend on signs alone.

/// The segments on the joined faces of a leaf, in the order of [`segment_key`]. Each is given by the cell
/// after the face, the axis normal to the face, and the inside corner that the segment cuts off. The corner
/// has coordinates on the two axes that follow the normal.
fn joined_segments(rows: &SignRows) -> impl Iterator<Item = (IVec3, usize, [usize; 2])> + '_ {
    let cells: Vec<usize> = rows.crossed_cells().iter().collect();
    let cells = cells.into_iter().map(voxel_in_leaf).filter(|&cell| cycles_at(rows, cell).joined_faces != 0);
    let faces = cells.flat_map(|cell| (0..3).map(move |axis| (cell, axis)));
    let joined = faces.filter(|&(cell, axis)| is_joined(rows, cell, axis));
    joined.flat_map(|(cell, axis)| {
        inside_corners(rows.cell_signs(cell), axis).map(move |corner| (cell, axis, corner))
    })
}

fn cycles_at(rows: &SignRows, cell: IVec3) -> &'static CellCycles {
    cell_cycles(rows.cell_signs(cell))
}

/// True if both segments of the face between `cell` and the cell before it along `axis` belong to one cycle
/// in both cells.
fn is_joined(rows: &SignRows, cell: IVec3, axis: usize) -> bool {
    let is_joined_at =
        |cell: IVec3, side: usize| cycles_at(rows, cell).joined_faces >> (2 * axis + side) & 1 == 1;
    is_joined_at(cell, 0) && is_joined_at(cell - IVec3::AXES[axis], 1)
}

/// The inside corners of a cell on its near face along `axis`, as coordinates on the two following axes.
fn inside_corners(signs: u8, axis: usize) -> impl Iterator<Item = [usize; 2]> {
    let (b, c) = (corner_bit((axis + 1) % 3), corner_bit((axis + 2) % 3));
    [[0, 0], [0, 1], [1, 0], [1, 1]].into_iter().filter(move |[i, j]| signs >> (i * b + j * c) & 1 == 1)
}

/// Key of a segment of an ambiguous face within its leaf: the face's first voxel and normal, and the inside
/// corner that the segment cuts off. (The two inside corners differ on both axes, so one coordinate
/// suffices.)
pub(super) fn segment_key(first_voxel: IVec3, normal_axis: usize, corner: [usize; 2]) -> u16 {
    (offset_in_leaf(first_voxel) * 8 + normal_axis * 2 + corner[0]) as u16
}

/// The four cells around a crossed edge, counter-clockwise as seen from its end.
///
/// ```text
///        c             a: the edge's axis, toward the reader
///    1   │   0         b, c: the axes after it
///   ─────┼───── b      side k: the face between cell k and cell k + 1
///    2   │   3
/// ```
pub(super) struct Ring {
    pub(super) axis: usize,
    pub(super) cells: [IVec3; 4],
    /// Bit k: side k is joined, see [`is_joined`].
    pub(super) joined_sides: u8,
}

/// The edge's position in each cell of a ring, as `2b + c`.
pub(super) const RING_CELLS: [usize; 4] = [0, 2, 3, 1];

/// For each side of a ring: the step from the ring's axis to the axis normal to the side (1 for b, 2 for c),
/// and the cell on its far side, which has the same first voxel as the face.
pub(super) const RING_SIDES: [(usize, usize); 4] = [(1, 0), (2, 1), (1, 3), (2, 0)];

impl Ring {
    pub(super) fn new(rows: &SignRows, start: IVec3, axis: usize) -> Ring {
        let (b, c) = (IVec3::AXES[(axis + 1) % 3], IVec3::AXES[(axis + 2) % 3]);
        let cells = [start, start - b, start - b - c, start - c];
        let around: [&CellCycles; 4] = std::array::from_fn(|k| cycles_at(rows, cells[k]));
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
        Ring { axis, cells, joined_sides }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn crossed_edges_are_in_exactly_one_cycle() {
        for signs in 0..=255u8 {
            let cycles = cell_cycles(signs);
            for edge in 0..12 {
                let (start, end) = edge_corners(edge);
                let is_crossed = (signs >> start ^ signs >> end) & 1 == 1;
                assert_eq!(is_crossed, cycles.of_edge[edge] != NO_CYCLE, "{signs:#010b} edge {edge}");
            }
            let all = cycles.edges.iter().fold(0, |all, edges| {
                assert_eq!(all & edges, 0);
                all | edges
            });
            let lengths = cycles.edges[..cycles.count].iter().map(|edges| edges.count_ones());
            assert!(lengths.clone().all(|length| length >= 3), "{signs:#010b}");
            assert_eq!(lengths.sum::<u32>(), u32::from(all).count_ones());
        }
    }

    #[test]
    fn ambiguous_faces_separate_the_inside_corners() {
        // Four inside corners, no two of them adjacent.
        assert_eq!(cell_cycles(0b0110_1001).count, 4);
        // Two diagonally opposite inside corners of a face are separated. In the complement, the other six
        // corners are inside, and one sheet surrounds both outside corners.
        assert_eq!(cell_cycles(0b0000_1001).count, 2);
        assert_eq!(cell_cycles(0b1111_0110).count, 1);
        assert_eq!(cell_cycles(0b1111_0110).joined_faces.count_ones(), 1);
    }
}
