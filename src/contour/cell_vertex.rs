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
//! On the sphere of radius 20 voxels that `tests/surface` measures, the planes alone leave the vertices
//! 0.007 voxels off (rms) and raise the mesh's bending energy by 10 %, the crossings' mean 0.012 and
//! 13 %; with the steps both end at 0.0003 and 0.1 %. The steps are kept short, because where sheets
//! meet in a sharp edge the planes know it better.
//!
//! All coordinates are relative to the cell, so a surface moved by whole voxels keeps its shape.
//!
//! This work is based on:
//! Tao Ju, Frank Losasso, Scott Schaefer, Joe Warren. Dual Contouring of Hermite Data. 2002

use glam::{Mat3, Vec3};

use super::cell_cycles::edge_corners;
use super::neighborhood::{BLOCK_STEP, Block};

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

/// φ, its gradient and its three second differences at the corners of a cell.
pub(super) struct CellSamples {
    /// Corner `4x + 2y + z`; in each φ, ∂ₓ, ∂ᵧ, ∂_z, ∂ₓₓ, ∂ᵧᵧ, ∂_zz, and padding to a register.
    corners: [[f32; 8]; 8],
}

impl CellSamples {
    /// Samples a cell whose first corner is at `index` in the block.
    pub(super) fn new(block: &Block, index: usize) -> CellSamples {
        let mut corners = [[0.0; 8]; 8];
        for (corner, samples) in corners.iter_mut().enumerate() {
            let at = index + BLOCK_CORNERS[corner];
            let gradient = block.gradient(at);
            *samples = [
                block.phi(at),
                gradient.x,
                gradient.y,
                gradient.z,
                block.second_difference(at, BLOCK_STEP[0]),
                block.second_difference(at, BLOCK_STEP[1]),
                block.second_difference(at, BLOCK_STEP[2]),
                0.0,
            ];
        }
        CellSamples { corners }
    }

    /// The vertex, relative to the cell's first corner, of the cycle through these edges (a bit for
    /// each).
    pub(super) fn vertex(&self, edges: u16) -> Vec3 {
        let mut planes = Planes::default();
        let mut rest = edges;
        while rest != 0 {
            let (point, gradient) = self.crossing(rest.trailing_zeros() as usize);
            planes.add(point, gradient);
            rest &= rest - 1;
        }
        self.project(clamp_to_cell(planes.nearest_point()))
    }

    /// The gradient of φ at a point of the cell.
    pub(super) fn gradient(&self, point: Vec3) -> Vec3 {
        let [_, x, y, z, ..] = self.interpolate(point);
        Vec3::new(x, y, z)
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
        let (mut point, _) = self.crossing(edge);
        point[edge / 4] = point[edge / 4].clamp(CELL_MARGIN, 1.0 - CELL_MARGIN);
        point
    }

    /// The point where an edge is crossed, and the gradient there.
    fn crossing(&self, edge: usize) -> (Vec3, Vec3) {
        let (start, end) = edge_corners(edge);
        let (one, other) = (&self.corners[start], &self.corners[end]);
        let t = one[0] / (one[0] - other[0]);
        let [_, x, y, z, ..] = blend(one, other, t);
        let point = corner_position(start) + Vec3::AXES[edge / 4] * t;
        (point, Vec3::new(x, y, z))
    }

    fn project(&self, start: Vec3) -> Vec3 {
        let mut point = start;
        for _ in 0..PROJECTION_STEPS {
            let [linear, gradient_x, gradient_y, gradient_z, second_x, second_y, second_z, _] =
                self.interpolate(point);
            let gradient = Vec3::new(gradient_x, gradient_y, gradient_z);
            let bulge = point * (1.0 - point) * Vec3::new(second_x, second_y, second_z);
            let phi = linear - 0.5 * bulge.element_sum();
            // Below a slope of one half the step would be a leap: thin sheets and noise.
            let step = gradient * (-phi / gradient.length_squared().max(0.25));
            point = clamp_to_cell(point + step.clamp_length_max(PROJECTION_LIMIT));
        }
        point
    }

    /// All samples interpolated trilinearly at a point of the cell.
    fn interpolate(&self, point: Vec3) -> [f32; 8] {
        let c = &self.corners;
        let near = blend(&blend(&c[0], &c[1], point.z), &blend(&c[2], &c[3], point.z), point.y);
        let far = blend(&blend(&c[4], &c[5], point.z), &blend(&c[6], &c[7], point.z), point.y);
        blend(&near, &far, point.x)
    }
}

/// Planes through points, as the sums that the point nearest to them depends on.
#[derive(Default)]
struct Planes {
    count: f32,
    /// Σ p
    point_sum: Vec3,
    /// Σ n nᵀ, by columns.
    normal_products: [Vec3; 3],
    /// Σ n (n·p)
    right: Vec3,
}

impl Planes {
    fn add(&mut self, point: Vec3, normal: Vec3) {
        self.count += 1.0;
        self.point_sum += point;
        self.normal_products[0] += normal * normal.x;
        self.normal_products[1] += normal * normal.y;
        self.normal_products[2] += normal * normal.z;
        self.right += normal * normal.dot(point);
    }

    /// The point nearest to all planes, held to the mean of the points.
    fn nearest_point(&self) -> Vec3 {
        let [x, y, z] = self.normal_products;
        let mean = self.point_sum / self.count;
        let products = Mat3::from_cols(x, y, z);
        let spring = Mat3::from_diagonal(Vec3::splat(SPRING_WEIGHT * self.count));
        mean + (products + spring).inverse() * (self.right - products * mean)
    }
}

/// The nearest point that keeps its distance from the cell's walls.
pub(super) fn clamp_to_cell(point: Vec3) -> Vec3 {
    point.clamp(Vec3::splat(CELL_MARGIN), Vec3::splat(1.0 - CELL_MARGIN))
}

/// How far the corners of a cell are from the first one in a block.
const BLOCK_CORNERS: [usize; 8] = {
    let mut steps = [0; 8];
    let mut corner = 0;
    while corner < 8 {
        steps[corner] =
            (corner >> 2) * BLOCK_STEP[0] + (corner >> 1 & 1) * BLOCK_STEP[1] + (corner & 1) * BLOCK_STEP[2];
        corner += 1;
    }
    steps
};

/// The position of a corner in its cell.
fn corner_position(corner: usize) -> Vec3 {
    Vec3::new((corner >> 2) as f32, (corner >> 1 & 1) as f32, (corner & 1) as f32)
}

/// Linear interpolation of eight values at once.
fn blend(one: &[f32; 8], other: &[f32; 8], t: f32) -> [f32; 8] {
    let mut blended = [0.0; 8];
    for k in 0..8 {
        blended[k] = one[k] + (other[k] - one[k]) * t;
    }
    blended
}
