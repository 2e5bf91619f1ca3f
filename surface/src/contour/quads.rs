//! The triangles of the dual mesh: a quad around each crossed edge, split along one of its diagonals.
//!
//! Each leaf first collects the vertices of its cells and of the cells just before them:
//!
//! ```text
//!    cells      −1 │ 0  1  2  3  4  5  6  7        9 × 9 × 9: all cells around edges of the leaf
//! ```
//!
//! Quads without joined sides (sides where two edges of the mesh would coincide, see [`Ring`]) are then split
//! in batches, one quad per SIMD lane. Quads with joined sides become fans of triangles around an additional
//! vertex.

use glam::{DVec3, IVec3, Vec3};

use super::dual_contouring::{LeafPatch, MeshLayout, RING_CELLS, RING_SIDES, Ring, cell_cycles, segment_key};
use super::neighborhood::SignRows;
use crate::grid::{offset_in_leaf, voxel_in_leaf};

/// Input for the triangles.
pub(super) struct Quads<'a> {
    pub(super) layout: &'a MeshLayout,
    /// The vertices on joined faces, as (leaf, [`segment_key`], vertex), sorted.
    pub(super) on_faces: Vec<(u32, u16, u32)>,
    /// Position of each vertex relative to its cell.
    pub(super) locals: &'a [Vec3],
    pub(super) positions: &'a [Vec3],
}

impl Quads<'_> {
    /// Writes the triangles around the crossed edges that start in a patch's leaf.
    #[inline(always)]
    pub(super) fn write(&self, patch: &LeafPatch, triangles: &mut [[u32; 3]]) {
        let rows = SignRows::new(&patch.neighborhood, &self.layout.inside_masks);
        let cells = CellGrid::new(patch, self.layout, &rows);
        let mut next_on_edge = patch.first_on_edges();
        let mut output = TriangleOutput { triangles, count: 0 };
        for axis in 0..3 {
            let mut batch = QuadBatch::new(axis);
            for offset in rows.crossed_edges(axis).iter() {
                let start = voxel_in_leaf(offset);
                let is_start_inside = rows.is_inside(start);
                let corners = cells.around(start, axis);
                if patch.on_edges_count > 0 {
                    let ring = Ring::new(&rows, start, axis);
                    if ring.joined_sides != 0 {
                        batch.cut(self.positions, &mut output);
                        let inside_end = if is_start_inside { start } else { start + IVec3::AXES[axis] };
                        let polygon = self.subdivided(patch, &ring, corners, inside_end);
                        output.fan(next_on_edge, &polygon, is_start_inside);
                        next_on_edge += 1;
                        continue;
                    }
                }
                batch.push(corners, self.locals, is_start_inside);
                if batch.count == LANES {
                    batch.cut(self.positions, &mut output);
                }
            }
            batch.cut(self.positions, &mut output);
        }
    }

    /// The corners of a ring's quad, with the vertices on its joined sides inserted.
    fn subdivided(&self, patch: &LeafPatch, ring: &Ring, corners: [u32; 4], inside_end: IVec3) -> Vec<u32> {
        let mut polygon = Vec::with_capacity(8);
        for (side, (turn, far)) in RING_SIDES.into_iter().enumerate() {
            polygon.push(corners[side]);
            if ring.joined_sides >> side & 1 == 1 {
                let normal_axis = (ring.axis + turn) % 3;
                let cell = ring.cells[far];
                let in_cell = (inside_end - cell).to_array();
                let corner = [1, 2].map(|next| in_cell[(normal_axis + next) % 3] as usize);
                let key = (patch.neighborhood.leaf(cell >> 3), segment_key(cell & 7, normal_axis, corner));
                let found = self.on_faces.binary_search_by_key(&key, |&(leaf, key, _)| (leaf, key));
                let index = found.expect("a joined face has a vertex on each of its segments");
                polygon.push(self.on_faces[index].2);
            }
        }
        polygon
    }
}

/// The cells −1 ..= 7 around a leaf.
struct CellGrid {
    /// For each crossed cell, the vertex of its first cycle; the vertices of its other cycles follow.
    first_vertices: [u32; CELL_COUNT],
    /// For each crossed cell, the signs of its corners.
    signs: [u8; CELL_COUNT],
}

/// Number of cells.
const CELL_COUNT: usize = 9 * 9 * 9;

/// Strides along x, y and z.
const CELL_STEP: [usize; 3] = [81, 9, 1];

impl CellGrid {
    #[inline(always)]
    fn new(patch: &LeafPatch, layout: &MeshLayout, rows: &SignRows) -> CellGrid {
        let mut cells = CellGrid { first_vertices: [0; CELL_COUNT], signs: [0; CELL_COUNT] };
        for (x, crossed) in rows.crossed_rows().into_iter().enumerate() {
            for (y, crossed) in crossed.into_iter().enumerate().filter(|(_, crossed)| *crossed != 0) {
                cells.add_row(patch, layout, rows, IVec3::new(x as i32 - 1, y as i32 - 1, -1), crossed);
            }
        }
        cells
    }

    /// Adds the crossed cells of a row that starts at `first`; bit z + 1 of `crossed` stands for cell z.
    #[inline(always)]
    fn add_row(
        &mut self,
        patch: &LeafPatch,
        layout: &MeshLayout,
        rows: &SignRows,
        first: IVec3,
        crossed: u16,
    ) {
        let row_in_leaf = offset_in_leaf(IVec3::new(first.x & 7, first.y & 7, 0)) / 8;
        let step = IVec3::new(first.x >> 3, first.y >> 3, 0);
        let row_start = |leaf_step: IVec3, row: usize| {
            let owner = layout.patch(patch.neighborhood.leaf(leaf_step));
            owner.first_vertex + u32::from(owner.row_starts[row])
        };
        let mut index = CellGrid::index(first);
        if crossed & 1 == 1 {
            // The last cell of a row of the previous leaf: its vertices end where the next row begins.
            let signs = rows.cell_signs(first);
            let count = cell_cycles(signs).count as u32;
            self.signs[index] = signs;
            self.first_vertices[index] = row_start(step - IVec3::Z, row_in_leaf + 1) - count;
        }
        let mut rest = crossed >> 1 & 0xff;
        if rest == 0 {
            return;
        }
        let mut next = row_start(step, row_in_leaf);
        index += 1;
        while rest != 0 {
            let z = rest.trailing_zeros();
            let signs = rows.cell_signs(IVec3::new(first.x, first.y, z as i32));
            self.signs[index + z as usize] = signs;
            self.first_vertices[index + z as usize] = next;
            next += cell_cycles(signs).count as u32;
            rest &= rest - 1;
        }
    }

    #[inline(always)]
    fn index(cell: IVec3) -> usize {
        let at = cell + IVec3::ONE;
        at.x as usize * CELL_STEP[0] + at.y as usize * CELL_STEP[1] + at.z as usize
    }

    /// The vertices of the quad around an edge, in the order of a [`Ring`]'s cells.
    #[inline(always)]
    fn around(&self, start: IVec3, axis: usize) -> [u32; 4] {
        let (b, c) = (CELL_STEP[(axis + 1) % 3], CELL_STEP[(axis + 2) % 3]);
        let index = CellGrid::index(start);
        let indices = [index, index - b, index - b - c, index - c];
        std::array::from_fn(|k| {
            let cycle = cell_cycles(self.signs[indices[k]]).of_edge[axis * 4 + RING_CELLS[k]];
            self.first_vertices[indices[k]] + u32::from(cycle)
        })
    }
}

/// Triangles written so far.
struct TriangleOutput<'a> {
    triangles: &'a mut [[u32; 3]],
    count: usize,
}

impl TriangleOutput<'_> {
    #[inline(always)]
    fn push(&mut self, [a, b, c]: [u32; 3], is_start_inside: bool) {
        self.triangles[self.count] = if is_start_inside { [a, b, c] } else { [a, c, b] };
        self.count += 1;
    }

    /// The triangles between a center vertex and the sides of a polygon.
    fn fan(&mut self, center: u32, polygon: &[u32], is_start_inside: bool) {
        for k in 0..polygon.len() {
            self.push([center, polygon[k], polygon[(k + 1) % polygon.len()]], is_start_inside);
        }
    }
}

/// Number of quads that are split at once.
const LANES: usize = 16;

/// Pending quads around edges along one axis.
struct QuadBatch {
    axis: usize,
    count: usize,
    corners: [[u32; 4]; LANES],
    is_start_inside: [bool; LANES],
    /// Positions of the corners relative to the edge's first voxel: by corner, by axis.
    points: [[[f32; LANES]; 3]; 4],
}

/// The two ways to split a quad into triangles, as indices of its corners.
const CUTS: [[[usize; 3]; 2]; 2] = [[[0, 1, 2], [2, 3, 0]], [[1, 2, 3], [3, 0, 1]]];

// The choices for a quad. They are numbers as wide as a lane, so that the loops that choose have no branches and
// use SIMD.

/// The first of [`CUTS`].
const FIRST: u32 = 0;

/// The second of [`CUTS`].
const SECOND: u32 = 1;

/// Rounding might flip a triangle of the better split.
const UNSAFE: u32 = 2;

/// The second split must be better by this factor, so that rounding errors do not decide how a square is
/// split.
const CLEARLY_BETTER: f32 = 1.001;

/// Rounding cannot flip a triangle whose doubled area, projected along the edge, is larger than this, in
/// squared voxels.
const SAFE_AREA: f64 = 1.0 / 32.0;

impl QuadBatch {
    #[inline(always)]
    fn new(axis: usize) -> QuadBatch {
        QuadBatch {
            axis,
            count: 0,
            corners: [[0; 4]; LANES],
            is_start_inside: [false; LANES],
            points: [[[0.0; LANES]; 3]; 4],
        }
    }

    #[inline(always)]
    fn push(&mut self, corners: [u32; 4], locals: &[Vec3], is_start_inside: bool) {
        let (b, c) = (Vec3::AXES[(self.axis + 1) % 3], Vec3::AXES[(self.axis + 2) % 3]);
        let cells = [Vec3::ZERO, -b, -b - c, -c];
        for (k, cell) in cells.into_iter().enumerate() {
            let point = cell + locals[corners[k] as usize];
            for axis in 0..3 {
                self.points[k][axis][self.count] = point[axis];
            }
        }
        self.corners[self.count] = corners;
        self.is_start_inside[self.count] = is_start_inside;
        self.count += 1;
    }

    /// Writes the two triangles of each pending quad and clears the batch. Chooses the split whose worse
    /// triangle is closer to equilateral. If rounding the positions could flip or flatten a triangle of that
    /// split, [`is_second_larger`] decides.
    #[inline(always)]
    fn cut(&mut self, positions: &[Vec3], output: &mut TriangleOutput) {
        let choices = self.choose();
        for (lane, &choice) in choices[..self.count].iter().enumerate() {
            let corners = self.corners[lane];
            let is_second = match choice {
                FIRST => false,
                SECOND => true,
                _ => is_second_larger(corners, self.axis, positions),
            };
            for [a, b, c] in CUTS[usize::from(is_second)] {
                output.push([corners[a], corners[b], corners[c]], self.is_start_inside[lane]);
            }
        }
        self.count = 0;
    }

    /// For each quad, the split with the better shapes, [`FIRST`] or [`SECOND`]; [`UNSAFE`] if rounding might
    /// flip one of its triangles.
    #[inline(always)]
    fn choose(&self) -> [u32; LANES] {
        let mut choices = [UNSAFE; LANES];
        let [p, q, r, s] = &self.points;
        let point = |corner: &[[f32; LANES]; 3], lane: usize| {
            Vec3::new(corner[0][lane], corner[1][lane], corner[2][lane])
        };
        for (lane, choice) in choices.iter_mut().enumerate() {
            let (p, q, r, s) = (point(p, lane), point(q, lane), point(r, lane), point(s, lane));
            let along_pr = shape(p, q, r).min(shape(r, s, p));
            let along_qs = shape(q, r, s).min(shape(s, p, q));
            *choice = if along_qs > CLEARLY_BETTER * along_pr { SECOND } else { FIRST };
        }
        let (right, up) = ((self.axis + 1) % 3, (self.axis + 2) % 3);
        let seen = |corner: &[[f32; LANES]; 3], lane: usize| {
            [f64::from(corner[right][lane]), f64::from(corner[up][lane])]
        };
        for (lane, choice) in choices.iter_mut().enumerate() {
            let (p, q, r, s) = (seen(p, lane), seen(q, lane), seen(r, lane), seen(s, lane));
            let first_is_safe = (doubled_area(p, q, r) > SAFE_AREA) & (doubled_area(r, s, p) > SAFE_AREA);
            let second_is_safe = (doubled_area(q, r, s) > SAFE_AREA) & (doubled_area(s, p, q) > SAFE_AREA);
            let is_safe = if *choice == SECOND { second_is_safe } else { first_is_safe };
            *choice = if is_safe { *choice } else { UNSAFE };
        }
        choices
    }
}

/// True if the smallest triangle of the second split is larger than that of the first. The areas are signed,
/// and computed from rounded positions projected along an axis.
fn is_second_larger(corners: [u32; 4], axis: usize, positions: &[Vec3]) -> bool {
    let seen = corners.map(|corner| {
        let position: DVec3 = positions[corner as usize].as_dvec3();
        [position[(axis + 1) % 3], position[(axis + 2) % 3]]
    });
    let least_area = |cut: [[usize; 3]; 2]| {
        let [one, other] = cut.map(|[a, b, c]| doubled_area(seen[a], seen[b], seen[c]));
        one.min(other)
    };
    least_area(CUTS[1]) > least_area(CUTS[0])
}

/// Shape quality of a triangle: its squared area over the squared sum of its squared edges. Maximal if
/// equilateral.
#[inline(always)]
fn shape(a: Vec3, b: Vec3, c: Vec3) -> f32 {
    let (to_b, to_c) = (b - a, c - a);
    let edges_squared = to_b.length_squared() + to_c.length_squared() + b.distance_squared(c);
    to_b.cross(to_c).length_squared() / (edges_squared * edges_squared)
}

/// Twice the signed area of a triangle in the plane; negative if it is clockwise.
#[inline(always)]
fn doubled_area(a: [f64; 2], b: [f64; 2], c: [f64; 2]) -> f64 {
    (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
}
