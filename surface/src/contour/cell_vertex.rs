//! Places the vertices of the dual mesh within their cells.
//!
//! A cycle (see [`super::cell_cycles`]) is a closed line of segments on the faces of the cell, where they cut
//! one sheet of the surface. On each grid edge that it crosses, the zero of φ is a point on the surface, and
//! ∇φ there gives its tangent plane. The vertex minimizes the squared distances to all these planes (the
//! quadratic error function of dual contouring) plus a weak spring to the mean of the crossings. The spring
//! alone decides in directions that the planes leave undetermined:
//!
//! ```text
//!   minimize  Σ (∇φᵢ·(x − pᵢ))² + w·n·|x − mean p|²
//! ```
//!
//! The tangent planes of a curved surface meet slightly outside it. By how much varies from cell to cell, so
//! the vertices would bring back the roughness that smoothing has just removed. Therefore the vertex is moved
//! along ∇φ onto the zero set of an interpolant that includes curvature. This interpolant is the trilinear
//! one minus the error that it has for a quadratic function:
//!
//! ```text
//!   φ(x) = lerp³ φ − Σₐ ½·xₐ(1 − xₐ)·lerp³ ∂ₐₐφ
//! ```
//!
//! Measured on the sphere with a radius of 20 voxels in `tests/surface`: with the planes alone, the
//! rms error of the vertices is 0.007 voxels and the mesh's bending energy rises by 10 %; with the mean of
//! the crossings, 0.012 and 13 %. With the projection onto the zero set, both variants end at 0.0003 voxels
//! and 0.1 %. The projection steps are limited, because the planes are more accurate where sheets meet in a
//! sharp edge.
//!
//! All coordinates are relative to the cell, so a surface moved by whole voxels keeps its shape.
//!
//! Vertices are computed in batches, one per SIMD lane: each step below is a loop over lanes. Each cell needs
//! the 32 voxels that the differences at its corners read.
//!
//! This work is based on:
//! Tao Ju, Frank Losasso, Scott Schaefer, Joe Warren. Dual Contouring of Hermite Data. 2002

use glam::{IVec3, Mat3, Vec3};

use super::dual_contouring::{corner_bit, edge_corners};
use super::neighborhood::{BLOCK_STEP, PhiBlock};
use super::{MeshPlacement, unit_or_zero};

/// Minimum distance of a vertex from the walls of its cell, in voxels. It ensures that every triangle has a
/// positive area, also after rounding. A larger margin dents the surface where it barely cuts a corner off a
/// cell: 1/64 would raise the bending energy of the sphere above by 4 %.
pub(super) const CELL_MARGIN: f32 = 1.0 / 256.0;

/// Weight of the spring to the mean of the crossings, relative to the planes. A larger weight rounds sharp
/// edges; with a smaller one, nearly parallel planes move the vertex far along the surface.
const SPRING_WEIGHT: f32 = 0.1;

/// Number of projection steps.
const PROJECTION_STEPS: usize = 2;

/// Maximum length of a projection step, in voxels. A surface of curvature κ (per voxel) needs a step of about
/// κ/8.
const PROJECTION_LIMIT: f32 = 0.125;

/// Number of vertices that are computed at once.
pub(super) const LANES: usize = 16;

/// One value per vertex.
type VertexArray = [f32; LANES];

/// Pending vertices.
pub(super) struct VertexBatch {
    count: usize,
    /// The first voxels of the cells.
    cells: [[i32; LANES]; 3],
    /// A mask of the edges that the vertex's cycle passes through.
    edges: [u32; LANES],
    /// φ at the cell's corners, followed by the outer neighbor of each corner along each axis.
    stencil: [VertexArray; STENCIL_COUNT],
}

/// Output arrays: for each vertex, its position relative to its cell, its position in the mesh, and its
/// normal.
pub(super) struct Vertices<'a> {
    pub(super) locals: &'a mut [Vec3],
    pub(super) positions: &'a mut [Vec3],
    pub(super) normals: &'a mut [Vec3],
}

/// Number of voxels that a vertex depends on.
const STENCIL_COUNT: usize = 32;

impl VertexBatch {
    /// An empty batch.
    #[inline(always)]
    pub(super) fn new() -> VertexBatch {
        let zeros = [0.0; LANES];
        VertexBatch { count: 0, cells: [[0; LANES]; 3], edges: [0; LANES], stencil: [zeros; STENCIL_COUNT] }
    }

    /// Number of pending vertices.
    #[inline(always)]
    pub(super) fn len(&self) -> usize {
        self.count
    }

    /// True if the batch is full.
    #[inline(always)]
    pub(super) fn is_full(&self) -> bool {
        self.count == LANES
    }

    /// Adds the vertex of a cycle (a mask of its edges) in the cell whose first voxel is at `index` in the
    /// block.
    #[inline(always)]
    pub(super) fn push(&mut self, block: &PhiBlock, index: usize, cell: IVec3, edges: u16) {
        let lane = self.count;
        for axis in 0..3 {
            self.cells[axis][lane] = cell[axis];
        }
        self.edges[lane] = u32::from(edges);
        for (column, offset) in self.stencil.iter_mut().zip(STENCIL) {
            column[lane] = block.phi(index - STENCIL_START + offset);
        }
        self.count += 1;
    }

    /// Computes the pending vertices, writes them in the order they were added, and clears the batch.
    #[inline(always)]
    pub(super) fn find(&mut self, placement: &MeshPlacement, vertices: Vertices) {
        let samples = self.samples();
        let mut points = self.nearest_points(&samples);
        for _ in 0..PROJECTION_STEPS {
            project(&samples, &mut points);
        }
        let normals = unit_gradients(&samples, &points);
        let positions = self.positions(placement, &points);
        let at = |columns: &[VertexArray; 3], lane: usize| {
            Vec3::new(columns[0][lane], columns[1][lane], columns[2][lane])
        };
        let outputs = vertices.locals.iter_mut().zip(vertices.positions).zip(vertices.normals);
        for (lane, ((local, position), normal)) in outputs.enumerate().take(self.count) {
            *local = at(&points, lane);
            *position = at(&positions, lane);
            *normal = at(&normals, lane);
        }
        self.count = 0;
    }

    /// φ, ∂ₓ, ∂ᵧ, ∂_z, ∂ₓₓ, ∂ᵧᵧ and ∂_zz at the corners.
    #[inline(always)]
    fn samples(&self) -> CornerSamples {
        let mut samples = [[[0.0; LANES]; 7]; 8];
        for (corner, samples) in samples.iter_mut().enumerate() {
            let here = &self.stencil[corner];
            samples[0] = *here;
            for axis in 0..3 {
                let inner = &self.stencil[corner ^ corner_bit(axis)];
                let outer = &self.stencil[8 * (axis + 1) + corner];
                let is_far = corner & corner_bit(axis) != 0;
                let (before, after) = if is_far { (inner, outer) } else { (outer, inner) };
                for lane in 0..LANES {
                    samples[1 + axis][lane] = 0.5 * (after[lane] - before[lane]);
                    samples[4 + axis][lane] = (after[lane] - here[lane]) - (here[lane] - before[lane]);
                }
            }
        }
        samples
    }

    /// The points that minimize the error function.
    #[inline(always)]
    fn nearest_points(&self, samples: &CornerSamples) -> [VertexArray; 3] {
        let mut planes = [[0.0; LANES]; PLANE_SUMS];
        for edge in 0..12 {
            let (start, end) = edge_corners(edge);
            let (one, other) = (&samples[start], &samples[end]);
            let [x, y, z] = corner_position(start).to_array();
            let along = Vec3::AXES[edge / 4].to_array();
            for lane in 0..LANES {
                let t = one[0][lane] / (one[0][lane] - other[0][lane]);
                let blend = |value: usize| one[value][lane] + (other[value][lane] - one[value][lane]) * t;
                let point = Vec3::new(x + along[0] * t, y + along[1] * t, z + along[2] * t);
                let sums = plane_sums(point, Vec3::new(blend(1), blend(2), blend(3)));
                let is_crossed = self.edges[lane] >> edge & 1 == 1;
                for sum in 0..PLANE_SUMS {
                    planes[sum][lane] += if is_crossed { sums[sum] } else { 0.0 };
                }
            }
        }
        let mut points = [[0.0; LANES]; 3];
        for lane in 0..LANES {
            let point = nearest_point(std::array::from_fn(|sum| planes[sum][lane]));
            [points[0][lane], points[1][lane], points[2][lane]] = clamp_to_cell(point).to_array();
        }
        points
    }

    /// The mesh positions of points in the cells.
    #[inline(always)]
    fn positions(&self, placement: &MeshPlacement, points: &[VertexArray; 3]) -> [VertexArray; 3] {
        let mut positions = [[0.0; LANES]; 3];
        for lane in 0..LANES {
            let cell = IVec3::new(self.cells[0][lane], self.cells[1][lane], self.cells[2][lane]);
            let point = Vec3::new(points[0][lane], points[1][lane], points[2][lane]);
            [positions[0][lane], positions[1][lane], positions[2][lane]] =
                placement.position(cell, point).to_array();
        }
        positions
    }
}

/// The directions of ∇φ at points of the cells, or zero where the gradient vanishes.
#[inline(always)]
fn unit_gradients(samples: &CornerSamples, points: &[VertexArray; 3]) -> [VertexArray; 3] {
    let mut normals = [[0.0; LANES]; 3];
    for lane in 0..LANES {
        let point = Vec3::new(points[0][lane], points[1][lane], points[2][lane]);
        let value = |value: usize| interpolate(samples, value, lane, point);
        [normals[0][lane], normals[1][lane], normals[2][lane]] =
            unit_or_zero(Vec3::new(value(1), value(2), value(3))).to_array();
    }
    normals
}

/// For each corner `4x + 2y + z` of a cell: φ, its gradient and its three second differences.
type CornerSamples = [[VertexArray; 7]; 8];

/// Number of sums that determine the minimizer.
const PLANE_SUMS: usize = 13;

/// The contribution of a plane with normal n through p: 1, p, the six distinct elements of n nᵀ, and n (n·p).
#[inline(always)]
fn plane_sums(p: Vec3, n: Vec3) -> [f32; PLANE_SUMS] {
    let right = n * n.dot(p);
    [
        1.0,
        p.x,
        p.y,
        p.z,
        n.x * n.x,
        n.x * n.y,
        n.x * n.z,
        n.y * n.y,
        n.y * n.z,
        n.z * n.z,
        right.x,
        right.y,
        right.z,
    ]
}

/// The minimizer for planes with these sums.
#[inline(always)]
fn nearest_point(sums: [f32; PLANE_SUMS]) -> Vec3 {
    let [count, x, y, z, xx, xy, xz, yy, yz, zz, right_x, right_y, right_z] = sums;
    let mean = Vec3::new(x, y, z) / count;
    let products = Mat3::from_cols(Vec3::new(xx, xy, xz), Vec3::new(xy, yy, yz), Vec3::new(xz, yz, zz));
    let spring = Mat3::from_diagonal(Vec3::splat(SPRING_WEIGHT * count));
    mean + (products + spring).inverse() * (Vec3::new(right_x, right_y, right_z) - products * mean)
}

/// Moves points along ∇φ toward the zero set of the curved interpolant.
#[inline(always)]
fn project(samples: &CornerSamples, points: &mut [VertexArray; 3]) {
    let [x, y, z] = points;
    for lane in 0..LANES {
        let point = Vec3::new(x[lane], y[lane], z[lane]);
        let value = |value: usize| interpolate(samples, value, lane, point);
        let gradient = Vec3::new(value(1), value(2), value(3));
        let bulge = point * (1.0 - point) * Vec3::new(value(4), value(5), value(6));
        let phi = value(0) - 0.5 * bulge.element_sum();
        // Limits the step where the slope is below one half, as in thin sheets and noise.
        let step = gradient * (-phi / gradient.length_squared().max(0.25));
        let moved = clamp_to_cell(point + step.clamp_length_max(PROJECTION_LIMIT));
        [x[lane], y[lane], z[lane]] = moved.to_array();
    }
}

/// Interpolates a sample trilinearly at a point of a lane's cell.
#[inline(always)]
fn interpolate(samples: &CornerSamples, value: usize, lane: usize, point: Vec3) -> f32 {
    let at = |corner: usize| samples[corner][value][lane];
    let blend = |one: f32, other: f32, t: f32| one + (other - one) * t;
    let near = blend(blend(at(0), at(1), point.z), blend(at(2), at(3), point.z), point.y);
    let far = blend(blend(at(4), at(5), point.z), blend(at(6), at(7), point.z), point.y);
    blend(near, far, point.x)
}

/// The nearest point that keeps the margin from the cell's walls.
#[inline(always)]
fn clamp_to_cell(point: Vec3) -> Vec3 {
    point.clamp(Vec3::splat(CELL_MARGIN), Vec3::splat(1.0 - CELL_MARGIN))
}

/// φ and ∇φ at the corners of one cell, for the few vertices on its edges and faces.
pub(super) struct CellSamples {
    /// Corner `4x + 2y + z`.
    corners: [(f32, Vec3); 8],
}

impl CellSamples {
    /// Samples a cell whose first corner is at `index` in the block.
    pub(super) fn new(block: &PhiBlock, index: usize) -> CellSamples {
        let sample = |corner: usize| {
            let at = index + CORNER_OFFSETS[corner];
            (block.phi(at), block.gradient(at))
        };
        CellSamples { corners: std::array::from_fn(sample) }
    }

    /// The gradient of φ at a point of the cell.
    pub(super) fn gradient(&self, point: Vec3) -> Vec3 {
        let [near, far] = [0, 4].map(|x| {
            let [first, second] =
                [x, x + 2].map(|k| blend(self.corners[k].1, self.corners[k + 1].1, point.z));
            blend(first, second, point.y)
        });
        blend(near, far, point.x)
    }

    /// The midpoint of the segment that cuts `corner` off the cell's face at coordinate 0 on `axis`. `corner`
    /// holds the corner's coordinates on the next two axes.
    pub(super) fn segment_middle(&self, axis: usize, corner: [usize; 2]) -> Vec3 {
        let (b, c) = ((axis + 1) % 3, (axis + 2) % 3);
        let ends = [b * 4 + corner[1] * 2, c * 4 + corner[0]].map(|edge| self.edge_crossing(edge));
        0.5 * (ends[0] + ends[1])
    }

    /// The crossing of the edge from the first corner along `axis`.
    pub(super) fn edge_point(&self, axis: usize) -> Vec3 {
        self.edge_crossing(axis * 4)
    }

    /// The crossing of an edge, kept away from its ends.
    fn edge_crossing(&self, edge: usize) -> Vec3 {
        let (start, end) = edge_corners(edge);
        let (one, other) = (self.corners[start].0, self.corners[end].0);
        let t = one / (one - other);
        let mut point = corner_position(start) + Vec3::AXES[edge / 4] * t;
        point[edge / 4] = point[edge / 4].clamp(CELL_MARGIN, 1.0 - CELL_MARGIN);
        point
    }
}

/// Linear interpolation.
fn blend(one: Vec3, other: Vec3, t: f32) -> Vec3 {
    one + (other - one) * t
}

/// Offsets of a cell's corners from the first corner, in a block.
const CORNER_OFFSETS: [usize; 8] = {
    let mut offsets = [0; 8];
    let mut corner = 0;
    while corner < 8 {
        offsets[corner] =
            (corner >> 2) * BLOCK_STEP[0] + (corner >> 1 & 1) * BLOCK_STEP[1] + (corner & 1) * BLOCK_STEP[2];
        corner += 1;
    }
    offsets
};

/// In a block, the index of the cell's first corner minus the index of the stencil's first voxel.
const STENCIL_START: usize = BLOCK_STEP[0];

/// Offsets of the stencil's voxels from its first one, in a block.
const STENCIL: [usize; STENCIL_COUNT] = {
    let mut offsets = [0; STENCIL_COUNT];
    let mut entry = 0;
    while entry < STENCIL_COUNT {
        let corner = entry % 8;
        offsets[entry] = STENCIL_START + CORNER_OFFSETS[corner];
        if entry >= 8 {
            let axis = entry / 8 - 1;
            if corner & corner_bit(axis) == 0 {
                offsets[entry] -= BLOCK_STEP[axis];
            } else {
                offsets[entry] += BLOCK_STEP[axis];
            }
        }
        entry += 1;
    }
    offsets
};

/// The position of a corner in its cell.
fn corner_position(corner: usize) -> Vec3 {
    Vec3::new((corner >> 2) as f32, (corner >> 1 & 1) as f32, (corner & 1) as f32)
}
