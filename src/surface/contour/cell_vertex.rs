//! Where in its cell a vertex of the dual mesh goes.
//!
//! The crossings of a cycle each give a point on the surface and, with ∇φ, the plane that touches it
//! there. The vertex is the point that is nearest to all these planes (the quadratic error function
//! of dual contouring), held by a weak spring to the crossings' mean, which alone decides in the
//! directions in which flat planes leave it free:
//!
//! ```text
//!   minimise  Σ (∇φᵢ·(x − pᵢ))² + w·n·|x − mean p|²
//! ```
//!
//! On a curved surface the planes meet a little outside of it, and by an amount that changes from
//! cell to cell: a roughness that the smoother has just removed. So the point then moves along ∇φ
//! onto the zero set of an interpolant that knows curvature, trilinear less the error that trilinear
//! interpolation makes on a quadratic:
//!
//! ```text
//!   φ(x) = lerp³ φ − Σₐ ½·xₐ(1 − xₐ)·lerp³ ∂ₐₐφ
//! ```
//!
//! On the sphere of radius 20 voxels that `tests/meniscus/surface` measures, the planes alone leave the vertices
//! 0.007 voxels off (rms) and raise the mesh's bending energy by 10 %, the crossings' mean 0.012 and
//! 13 %; with the steps both end at 0.0003 and 0.1 %. The steps are kept short, because where sheets
//! meet in a sharp edge the planes know it better.
//!
//! All coordinates are relative to the cell, so a surface moved by whole voxels keeps its shape.
//!
//! Vertices are found many at a time, one in each lane of the processor's vectors: each step below is a
//! loop over lanes, and takes of every cell the 32 voxels that the differences at its corners reach.
//!
//! This work is based on:
//! Tao Ju, Frank Losasso, Scott Schaefer, Joe Warren. Dual Contouring of Hermite Data. 2002

use glam::{IVec3, Mat3, Vec3};

use super::Placement;
use super::cell_cycles::{corner_bit, edge_corners};
use super::neighborhood::{BLOCK_STEP, Block};
use super::normals::unit_or_zero;

/// Vertices keep this far from the walls of their cell, in voxels: what makes every triangle of the
/// mesh have an area, also after rounding. Larger dents the surface where it just cuts a corner off a
/// cell: a margin of 1/64 alone raises the bending energy of the sphere above by 4 %.
pub(super) const CELL_MARGIN: f32 = 1.0 / 256.0;

/// Pull towards the crossings' mean, relative to the planes'. Larger rounds sharp edges; smaller
/// lets nearly parallel planes throw the vertex sideways.
const SPRING_WEIGHT: f32 = 0.1;

/// Steps onto the curved interpolant.
const PROJECTION_STEPS: usize = 2;

/// The longest of these steps in voxels. A surface of curvature κ needs about κ/8.
const PROJECTION_LIMIT: f32 = 0.125;

/// Vertices that are found at once.
pub(super) const LANES: usize = 16;

/// One value of each vertex.
type Column = [f32; LANES];

/// Vertices that wait to be found.
pub(super) struct VertexBatch {
    count: usize,
    /// The cells' first voxels.
    cells: [[i32; LANES]; 3],
    /// A bit for each edge that the vertex's cycle goes through.
    edges: [u32; LANES],
    /// φ at the cell's corners, and then along each axis next to each corner on its outer side.
    stencil: [Column; STENCIL_COUNT],
}

/// What is known of a vertex: where it is relative to its cell, its position in the mesh, and its normal.
pub(super) struct Vertices<'a> {
    pub(super) locals: &'a mut [Vec3],
    pub(super) positions: &'a mut [Vec3],
    pub(super) normals: &'a mut [Vec3],
}

/// Voxels that a vertex depends on.
const STENCIL_COUNT: usize = 32;

impl VertexBatch {
    /// No vertex.
    #[inline(always)]
    pub(super) fn new() -> VertexBatch {
        let zeros = [0.0; LANES];
        VertexBatch { count: 0, cells: [[0; LANES]; 3], edges: [0; LANES], stencil: [zeros; STENCIL_COUNT] }
    }

    /// How many vertices wait.
    #[inline(always)]
    pub(super) fn len(&self) -> usize {
        self.count
    }

    /// Whether there is no place for another vertex.
    #[inline(always)]
    pub(super) fn is_full(&self) -> bool {
        self.count == LANES
    }

    /// Adds the vertex of a cycle (a bit for each of its edges) in a cell whose first voxel is at `index` in the
    /// block.
    #[inline(always)]
    pub(super) fn push(&mut self, block: &Block, index: usize, cell: IVec3, edges: u16) {
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

    /// Finds the vertices, writes them in the order in which they came, and forgets them.
    #[inline(always)]
    pub(super) fn find(&mut self, placement: &Placement, vertices: Vertices) {
        let samples = self.samples();
        let mut points = self.nearest_points(&samples);
        for _ in 0..PROJECTION_STEPS {
            project(&samples, &mut points);
        }
        let normals = unit_gradients(&samples, &points);
        let positions = self.positions(placement, &points);
        let at = |columns: &[Column; 3], lane: usize| {
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
    fn samples(&self) -> Samples {
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

    /// The points nearest to the planes of the crossings.
    #[inline(always)]
    fn nearest_points(&self, samples: &Samples) -> [Column; 3] {
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

    /// The positions in the mesh of points in the cells.
    #[inline(always)]
    fn positions(&self, placement: &Placement, points: &[Column; 3]) -> [Column; 3] {
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

/// The directions of ∇φ at points of the cells, or zero where it has none.
#[inline(always)]
fn unit_gradients(samples: &Samples, points: &[Column; 3]) -> [Column; 3] {
    let mut normals = [[0.0; LANES]; 3];
    for lane in 0..LANES {
        let point = Vec3::new(points[0][lane], points[1][lane], points[2][lane]);
        let value = |value: usize| interpolate(samples, value, lane, point);
        [normals[0][lane], normals[1][lane], normals[2][lane]] =
            unit_or_zero(Vec3::new(value(1), value(2), value(3))).to_array();
    }
    normals
}

/// At each corner `4x + 2y + z` of a cell φ, its gradient and its three second differences.
type Samples = [[Column; 7]; 8];

/// How many sums the point nearest to planes depends on.
const PLANE_SUMS: usize = 13;

/// What a plane with normal n through p adds: 1, p, the six different n nᵀ, and n (n·p).
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

/// The point nearest to the planes with these sums, held to the mean of the points.
#[inline(always)]
fn nearest_point(sums: [f32; PLANE_SUMS]) -> Vec3 {
    let [count, x, y, z, xx, xy, xz, yy, yz, zz, right_x, right_y, right_z] = sums;
    let mean = Vec3::new(x, y, z) / count;
    let products = Mat3::from_cols(Vec3::new(xx, xy, xz), Vec3::new(xy, yy, yz), Vec3::new(xz, yz, zz));
    let spring = Mat3::from_diagonal(Vec3::splat(SPRING_WEIGHT * count));
    mean + (products + spring).inverse() * (Vec3::new(right_x, right_y, right_z) - products * mean)
}

/// Moves points along ∇φ towards the zero set of the curved interpolant.
#[inline(always)]
fn project(samples: &Samples, points: &mut [Column; 3]) {
    let [x, y, z] = points;
    for lane in 0..LANES {
        let point = Vec3::new(x[lane], y[lane], z[lane]);
        let value = |value: usize| interpolate(samples, value, lane, point);
        let gradient = Vec3::new(value(1), value(2), value(3));
        let bulge = point * (1.0 - point) * Vec3::new(value(4), value(5), value(6));
        let phi = value(0) - 0.5 * bulge.element_sum();
        // Below a slope of one half the step would be a leap: thin sheets and noise.
        let step = gradient * (-phi / gradient.length_squared().max(0.25));
        let moved = clamp_to_cell(point + step.clamp_length_max(PROJECTION_LIMIT));
        [x[lane], y[lane], z[lane]] = moved.to_array();
    }
}

/// A sample interpolated trilinearly at a point of a lane's cell.
#[inline(always)]
fn interpolate(samples: &Samples, value: usize, lane: usize, point: Vec3) -> f32 {
    let at = |corner: usize| samples[corner][value][lane];
    let blend = |one: f32, other: f32, t: f32| one + (other - one) * t;
    let near = blend(blend(at(0), at(1), point.z), blend(at(2), at(3), point.z), point.y);
    let far = blend(blend(at(4), at(5), point.z), blend(at(6), at(7), point.z), point.y);
    blend(near, far, point.x)
}

/// The nearest point that keeps its distance from the cell's walls.
#[inline(always)]
fn clamp_to_cell(point: Vec3) -> Vec3 {
    point.clamp(Vec3::splat(CELL_MARGIN), Vec3::splat(1.0 - CELL_MARGIN))
}

/// One cell's φ and ∇φ at its corners: for the few vertices that lie on its edges and faces.
pub(super) struct CellSamples {
    /// Corner `4x + 2y + z`.
    corners: [(f32, Vec3); 8],
}

impl CellSamples {
    /// Samples a cell whose first corner is at `index` in the block.
    pub(super) fn new(block: &Block, index: usize) -> CellSamples {
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

    /// The middle of the segment that cuts `corner` (its places on the two axes that follow) off the
    /// near face along `axis`.
    pub(super) fn segment_middle(&self, axis: usize, corner: [usize; 2]) -> Vec3 {
        let (b, c) = ((axis + 1) % 3, (axis + 2) % 3);
        let ends = [b * 4 + corner[1] * 2, c * 4 + corner[0]].map(|edge| self.edge_crossing(edge));
        0.5 * (ends[0] + ends[1])
    }

    /// The point where the edge from the first corner along `axis` is crossed.
    pub(super) fn edge_point(&self, axis: usize) -> Vec3 {
        self.edge_crossing(axis * 4)
    }

    /// The point where an edge is crossed, kept away from its ends.
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

/// How far the corners of a cell are from the first one in a block.
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

/// The first voxel of the stencil comes so far before the cell's first corner in a block.
const STENCIL_START: usize = BLOCK_STEP[0];

/// How far the voxels of the stencil are from its first one in a block.
const STENCIL: [usize; STENCIL_COUNT] = {
    let mut offsets = [0; STENCIL_COUNT];
    let mut place = 0;
    while place < STENCIL_COUNT {
        let corner = place % 8;
        offsets[place] = STENCIL_START + CORNER_OFFSETS[corner];
        if place >= 8 {
            let axis = place / 8 - 1;
            if corner & corner_bit(axis) == 0 {
                offsets[place] -= BLOCK_STEP[axis];
            } else {
                offsets[place] += BLOCK_STEP[axis];
            }
        }
        place += 1;
    }
    offsets
};

/// The position of a corner in its cell.
fn corner_position(corner: usize) -> Vec3 {
    Vec3::new((corner >> 2) as f32, (corner >> 1 & 1) as f32, (corner & 1) as f32)
}
