//! Ray intersection with the zero set of φ.
//!
//! ```text
//!   nodes of 16³ leaves ─▶ leaves with a crossing ─▶ cells with a crossing ─▶ a cubic in t
//!        hashed                 a table in each node             a bit for each        its first root
//! ```
//!
//! Inside a cell φ is the tricubic spline with these [weights](meniscus_surface::level_set::spline_weights): with a trilinear one,
//! small drops would have corners. Along a ray it is taken as the cubic polynomial through four points of the cell, so
//! even very thin fluid is not missed, as it could be by marching with fixed steps.

use glam::{DVec3, IVec3, Vec3};
use meniscus_surface::grid::{Field, LEAF_EDGE, Leaf, LeafMask, NO_LEAF, negative_masks, offset_in_leaf};
use meniscus_surface::level_set::{NarrowBand, spline_weights};
use meniscus_surface::space::{CoordBox, box_of, joined};
use rayon::prelude::*;
use rustc_hash::FxHashMap;

use crate::tile::RayTarget;

/// A level set prepared for ray intersection.
pub(super) struct RaySurface<'a> {
    band: &'a NarrowBand,
    /// Velocities at the voxels of the band, x, y and z, world units per second.
    velocity: Option<&'a [Field; 3]>,
    /// For each node, the indices of its leaves in `crossed`; [`NO_LEAF`] for a leaf without a crossing.
    nodes: FxHashMap<IVec3, Box<[u32; NODE_LEAVES]>>,
    crossed: Vec<CrossedLeaf>,
    /// The bounding box of the cells with a crossing.
    cells: CoordBox,
}

/// A leaf with cells that the surface passes through.
struct CrossedLeaf {
    origin: IVec3,
    /// The cells that the surface passes through, by their lower corners.
    cells: LeafMask,
    /// Its neighbour leaves, as in [`Topology::neighborhood`].
    around: [u32; 27],
}

/// An intersection of a ray and the surface.
#[derive(Clone, Copy, Debug)]
struct Hit {
    t: f64,
    /// Whether the ray came from outside.
    is_front: bool,
    leaf: u32,
    /// The lower corner of the cell, relative to the leaf.
    cell: IVec3,
}

/// Number of leaves along the edge of a node.
const NODE_EDGE: i32 = 16;

const NODE_LEAVES: usize = (NODE_EDGE * NODE_EDGE * NODE_EDGE) as usize;

/// Upper limit of the number of nodes along a ray: two million voxels. Farther away, pixels are larger than
/// voxels.
const NODES_MAX: usize = 1 << 14;

impl<'a> RaySurface<'a> {
    pub(super) fn new(band: &'a NarrowBand, velocity: Option<&'a [Field; 3]>) -> RaySurface<'a> {
        let negative = negative_masks(&band.phi);
        let topology = &*band.topology;
        let crossed = |(leaf, &origin): (usize, &IVec3)| {
            let around = topology.neighborhood(leaf);
            let cells = crossed_cells(&around, &negative);
            (!cells.is_empty()).then_some(CrossedLeaf { origin, cells, around })
        };
        let crossed: Vec<CrossedLeaf> =
            topology.origins().par_iter().enumerate().filter_map(crossed).collect();
        let mut nodes = FxHashMap::default();
        let mut cells = CoordBox::EMPTY;
        let kept = rendered_box(&crossed);
        for (index, leaf) in crossed.iter().enumerate().filter(|(_, leaf)| kept.contains(leaf.origin)) {
            let (node, slot) = node_of(leaf.origin / LEAF_EDGE);
            nodes.entry(node).or_insert_with(|| Box::new([NO_LEAF; NODE_LEAVES]))[slot] = index as u32;
            let own = leaf.cells.bounding_box();
            cells.include(leaf.origin + own.min);
            cells.include(leaf.origin + own.max);
        }
        RaySurface { band, velocity, nodes, crossed, cells }
    }

    /// The first intersection of a ray with the surface.
    fn intersect(&self, ray: &Ray) -> Option<Hit> {
        if self.cells.is_empty() {
            return None;
        }
        let (least, greatest) = (self.cells.min.as_dvec3(), (self.cells.max + 1).as_dvec3());
        let span = ray.within(least, greatest, [0.0, f64::INFINITY])?;
        let mut side = SurfaceSide::Unknown;
        let leaf_range =
            [self.cells.min, self.cells.max].map(|cell| cell.div_euclid(IVec3::splat(LEAF_EDGE)));
        let node_range = leaf_range.map(|leaf| leaf.div_euclid(IVec3::splat(NODE_EDGE)));
        let nodes = Cells::along(ray, f64::from(NODE_EDGE * LEAF_EDGE), span, node_range);
        for (node, in_node) in nodes.take(NODES_MAX) {
            let Some(leaves) = self.nodes.get(&node) else { continue };
            let first = node * NODE_EDGE;
            for (leaf, in_leaf) in
                Cells::along(ray, f64::from(LEAF_EDGE), in_node, [first, first + (NODE_EDGE - 1)])
            {
                let index = leaves[index_in_node(leaf)];
                if index == NO_LEAF {
                    continue;
                }
                let hit = self.intersect_leaf(index, ray, in_leaf, &mut side);
                if hit.is_some() {
                    return hit;
                }
            }
        }
        None
    }

    fn intersect_leaf(&self, leaf: u32, ray: &Ray, span: [f64; 2], side: &mut SurfaceSide) -> Option<Hit> {
        let crossed = &self.crossed[leaf as usize];
        let range = [crossed.origin, crossed.origin + (LEAF_EDGE - 1)];
        for (cell, span) in Cells::along(ray, 1.0, span, range) {
            let local = (cell - crossed.origin) & (LEAF_EDGE - 1);
            if !crossed.cells.contains(offset_in_leaf(local)) {
                continue;
            }
            let around = self.values_around(crossed, local);
            let along = Cubic::along(&around, ray, cell, span);
            let entry = SurfaceSide::of(along.values[0]);
            if *side == SurfaceSide::Unknown {
                // The ray comes from cells whose corners are all on one side, where the spline may have crossed 0.
                let at = (ray.at(span[0]) - cell.as_dvec3()).as_vec3();
                *side = SurfaceSide::of(trilinear(CORNERS.map(|corner| around[corner]), at));
            }
            let is_front = *side == SurfaceSide::Outside;
            // A crossing before the cell, or on its face, is hidden: then the sides differ.
            let root = if *side == entry { along.first_root() } else { Some(0.0) };
            if let Some(root) = root {
                let t = span[0] + (span[1] - span[0]) * f64::from(root);
                return Some(Hit { t, is_front, leaf, cell: local });
            }
            *side = entry;
        }
        None
    }

    /// φ at the 4 × 4 × 4 voxels of a cell and of the cells around it.
    fn values_around(&self, leaf: &CrossedLeaf, cell: IVec3) -> [f32; 64] {
        let mut around = [0.0; 64];
        if cell.min_element() > 0 && cell.max_element() < LEAF_EDGE - 2 {
            let values = &self.band.phi.leaves[leaf.around[13] as usize].values;
            let first = offset_in_leaf(cell - 1);
            for (row, four) in around.as_chunks_mut::<4>().0.iter_mut().enumerate() {
                let first = first + 64 * (row / 4) + 8 * (row % 4);
                four.copy_from_slice(&values[first..first + 4]);
            }
            return around;
        }
        for (index, value) in (0..).zip(&mut around) {
            *value = self.value(leaf, cell + IVec3::new(index / 16, index / 4 % 4, index % 4) - 1);
        }
        around
    }

    /// φ at a voxel, given relative to a leaf, in the leaf itself or in a neighbour leaf. If the neighbour is
    /// not stored, φ at the nearest voxel of the leaf itself: its sign is right, and the surface is far away.
    fn value(&self, leaf: &CrossedLeaf, voxel: IVec3) -> f32 {
        let step = voxel.div_euclid(IVec3::splat(LEAF_EDGE)) + 1;
        let (index, voxel) = match leaf.around[(9 * step.x + 3 * step.y + step.z) as usize] {
            NO_LEAF => (leaf.around[13], voxel.clamp(IVec3::ZERO, IVec3::splat(LEAF_EDGE - 1))),
            neighbor => (neighbor, voxel & (LEAF_EDGE - 1)),
        };
        self.band.phi.leaves[index as usize].values[offset_in_leaf(voxel)]
    }

    /// φ at the voxels of a hit's cell and of the cells around it.
    fn around(&self, ray: &Ray, hit: &Hit) -> Stencil {
        let leaf = &self.crossed[hit.leaf as usize];
        let values = self.values_around(leaf, hit.cell);
        let at = ray.at(hit.t) - (leaf.origin + hit.cell).as_dvec3();
        let at = at.as_vec3().clamp(Vec3::ZERO, Vec3::ONE);
        Stencil { values, at, leaf: leaf.around[13], cell: hit.cell }
    }

    /// The value of a field on the same leaves at a hit, by trilinear interpolation. Reads only the leaf of
    /// the hit: the last voxels of the leaf replace those of the next leaves.
    fn interpolate(&self, field: &[Leaf], around: &Stencil) -> f32 {
        let values = &field[around.leaf as usize].values;
        let corner = |corner: i32| {
            let step = IVec3::new(corner >> 2, corner >> 1 & 1, corner & 1);
            let voxel = (around.cell + step).min(IVec3::splat(LEAF_EDGE - 1));
            values[offset_in_leaf(voxel)]
        };
        trilinear(std::array::from_fn(|index| corner(index as i32)), around.at)
    }
}

impl RayTarget for RaySurface<'_> {
    type Local = Stencil;

    fn hit(&self, ray: &Ray) -> Option<(f64, bool, Stencil)> {
        self.intersect(ray).map(|hit| (hit.t, hit.is_front, self.around(ray, &hit)))
    }

    fn outward(&self, around: &Stencil) -> Vec3 {
        around.gradient()
    }

    fn mean_curvature(&self, around: &Stencil) -> f32 {
        around.mean_curvature()
    }

    fn velocity(&self, around: &Stencil) -> Option<[f32; 3]> {
        let velocity = self.velocity?;
        Some(velocity.each_ref().map(|along| self.interpolate(&along.leaves, around)))
    }
}

/// The bounding box of the leaves to render: all leaves. If the scene is wider than a ray can be, excludes
/// outlier leaves.
fn rendered_box(leaves: &[CrossedLeaf]) -> CoordBox {
    let corner = |index: usize| [leaves[index].origin.as_dvec3(); 2];
    let all = (0..leaves.len()).map(corner).reduce(joined);
    let wide = f64::from(NODE_EDGE * LEAF_EDGE) * NODES_MAX as f64;
    let is_wide = |[least, greatest]: &[DVec3; 2]| (greatest - least).max_element() > wide;
    match all.filter(is_wide).and_then(|_| box_of(leaves.len(), corner)) {
        Some([least, greatest]) => CoordBox { min: least.as_ivec3(), max: greatest.as_ivec3() },
        None => CoordBox::ALL,
    }
}

/// The node of a leaf, and the leaf's index in the node. `leaf` is the leaf's origin divided by its edge.
fn node_of(leaf: IVec3) -> (IVec3, usize) {
    (leaf.div_euclid(IVec3::splat(NODE_EDGE)), index_in_node(leaf))
}

fn index_in_node(leaf: IVec3) -> usize {
    let local = leaf & (NODE_EDGE - 1);
    ((local.x * NODE_EDGE + local.y) * NODE_EDGE + local.z) as usize
}

/// The cells of a leaf that have corners on both sides of the surface, by their lower corners.
fn crossed_cells(around: &[u32; 27], negative: &[LeafMask]) -> LeafMask {
    let row_at = |x: usize, y: usize| -> u16 {
        // If a neighbour leaf is not stored, the nearest voxel of the leaf itself replaces its voxels.
        let mask = |x: usize, y: usize, z: usize| around[13 + 9 * (x / 8) + 3 * (y / 8) + z];
        let own = match mask(x, y, 0) {
            NO_LEAF => negative[around[13] as usize].row(x.min(7) * 8 + y.min(7)),
            leaf => negative[leaf as usize].row(x % 8 * 8 + y % 8),
        };
        let next = match mask(x, y, 1) {
            NO_LEAF => u16::from(own >> 7),
            leaf => u16::from(negative[leaf as usize].row(x % 8 * 8 + y % 8) & 1),
        };
        u16::from(own) | next << 8
    };
    let rows: [[u16; 9]; 9] = std::array::from_fn(|x| std::array::from_fn(|y| row_at(x, y)));
    let mut cells = LeafMask::EMPTY;
    for x in 0..8 {
        for y in 0..8 {
            let four = [rows[x][y], rows[x][y + 1], rows[x + 1][y], rows[x + 1][y + 1]];
            let any = four[0] | four[1] | four[2] | four[3];
            let all = four[0] & four[1] & four[2] & four[3];
            cells.set_row(x * 8 + y, ((any | any >> 1) & !(all & all >> 1)) as u8);
        }
    }
    cells
}

#[derive(Clone, Copy, PartialEq, Eq)]
enum SurfaceSide {
    Unknown,
    Outside,
    Inside,
}

impl SurfaceSide {
    fn of(phi: f32) -> SurfaceSide {
        if phi < 0.0 { SurfaceSide::Inside } else { SurfaceSide::Outside }
    }
}

/// φ along a ray through a cell, parametrized from 0 to 1.
struct Cubic {
    /// φ at the parameters 0, 1/3, 2/3 and 1.
    values: [f32; 4],
}

impl Cubic {
    fn along(around: &[f32; 64], ray: &Ray, cell: IVec3, [first, last]: [f64; 2]) -> Cubic {
        let entry = (ray.at(first) - cell.as_dvec3()).as_vec3();
        let exit = (ray.at(last) - cell.as_dvec3()).as_vec3();
        let values = [0.0, 1.0 / 3.0, 2.0 / 3.0, 1.0];
        Cubic { values: values.map(|part| tricubic(around, entry.lerp(exit, part))) }
    }

    /// The coefficients of the polynomial, the constant first.
    fn coefficients(&self) -> [f32; 4] {
        let [a, b, c, d] = self.values;
        [
            a,
            -5.5 * a + 9.0 * b - 4.5 * c + d,
            9.0 * a - 22.5 * b + 18.0 * c - 4.5 * d,
            4.5 * (b * 3.0 - c * 3.0 + d - a),
        ]
    }

    /// The parameter of the first sign change.
    fn first_root(&self) -> Option<f32> {
        let [a, b, c, d] = self.coefficients();
        let at = |x: f32| ((d * x + c) * x + b) * x + a;
        // Between its local extrema the polynomial is monotonic.
        let mut ends = [0.0, 1.0, 1.0, 1.0];
        let (quadratic, half, constant) = (3.0 * d, c, b);
        let discriminant = half * half - quadratic * constant;
        if discriminant > 0.0 {
            let apart = -(half + discriminant.sqrt().copysign(half));
            let mut extremes =
                [apart / quadratic, constant / apart].map(|x| if x > 0.0 && x < 1.0 { x } else { 1.0 });
            extremes.sort_by(f32::total_cmp);
            ends[1..3].copy_from_slice(&extremes);
        }
        for pair in ends.windows(2) {
            let (mut low, mut high) = (pair[0], pair[1]);
            let (mut at_low, mut at_high) = (at(low), at(high));
            if (at_low < 0.0) == (at_high < 0.0) || low == high {
                continue;
            }
            for _ in 0..ROOT_STEPS {
                let middle = low + (high - low) * (at_low / (at_low - at_high)).clamp(0.05, 0.95);
                let value = at(middle);
                if (value < 0.0) == (at_low < 0.0) {
                    (low, at_low) = (middle, value);
                } else {
                    (high, at_high) = (middle, value);
                }
            }
            return Some(low + (high - low) * (at_low / (at_low - at_high)).clamp(0.0, 1.0));
        }
        None
    }
}

/// Number of steps of the false position method. The remaining error is far below the size of a pixel.
const ROOT_STEPS: usize = 4;

/// The spline through 4 × 4 × 4 values, at a point in the middle cell.
fn tricubic(around: &[f32; 64], at: Vec3) -> f32 {
    let [x, y, z] = at.to_array().map(spline_weights);
    let mut sum = 0.0;
    for (row, four) in around.as_chunks::<4>().0.iter().enumerate() {
        let along_z: f32 = four.iter().zip(z).map(|(value, weight)| value * weight).sum();
        sum += x[row / 4] * y[row % 4] * along_z;
    }
    sum
}

fn trilinear(corners: [f32; 8], at: Vec3) -> f32 {
    let mix = |one: f32, other: f32, part: f32| one + (other - one) * part;
    let [a, b, c, d] = [0, 2, 4, 6].map(|first| mix(corners[first], corners[first + 1], at.z));
    mix(mix(a, b, at.y), mix(c, d, at.y), at.x)
}

/// The corners of the middle cell among 4 × 4 × 4 values: corner x, y, z at index 4x + 2y + z.
const CORNERS: [usize; 8] = [21, 22, 25, 26, 37, 38, 41, 42];

/// φ at 4 × 4 × 4 voxels around a point in the middle cell.
pub(super) struct Stencil {
    values: [f32; 64],
    /// Position in the cell, 0 to 1.
    at: Vec3,
    leaf: u32,
    cell: IVec3,
}

impl Stencil {
    /// φ at an offset of whole voxels from the point, by trilinear interpolation.
    fn phi(&self, x: i32, y: i32, z: i32) -> f32 {
        let first = ((x + 1) * 16 + (y + 1) * 4 + z + 1) as usize;
        trilinear([0, 1, 4, 5, 16, 17, 20, 21].map(|step| self.values[first + step]), self.at)
    }

    /// ∇φ by central differences; it points outward.
    fn gradient(&self) -> Vec3 {
        let along = |step: IVec3| self.phi(step.x, step.y, step.z) - self.phi(-step.x, -step.y, -step.z);
        0.5 * Vec3::new(along(IVec3::X), along(IVec3::Y), along(IVec3::Z))
    }

    /// The mean curvature, per voxel: positive where the fluid is convex.
    fn mean_curvature(&self) -> f32 {
        let g = self.gradient();
        let twice = |step: IVec3| {
            self.phi(step.x, step.y, step.z) + self.phi(-step.x, -step.y, -step.z) - 2.0 * self.phi(0, 0, 0)
        };
        let mixed = |one: IVec3, other: IVec3| {
            let at = |step: IVec3| self.phi(step.x, step.y, step.z);
            (at(one + other) + at(-one - other) - at(one - other) - at(other - one)) / 4.0
        };
        let (xx, yy, zz) = (twice(IVec3::X), twice(IVec3::Y), twice(IVec3::Z));
        let xy = mixed(IVec3::X, IVec3::Y);
        let xz = mixed(IVec3::X, IVec3::Z);
        let yz = mixed(IVec3::Y, IVec3::Z);
        let squared = g.length_squared().max(1e-6);
        let along = g.x * g.x * xx
            + g.y * g.y * yy
            + g.z * g.z * zz
            + 2.0 * (g.x * g.y * xy + g.x * g.z * xz + g.y * g.z * yz);
        0.5 * ((xx + yy + zz) - along / squared) / squared.sqrt()
    }
}

// Traverses the cells of a cubic lattice along a ray.
//
//   ·──┬───┬───┬──      A ray leaves a cell through the nearest of three planes, one for each axis.
//   ╲  │   │   │        Successive planes of an axis are a fixed step of t apart.
//   ──╲┼───┼───┼──
//      ╲   │   │
//
// This work is based on:
// John Amanatides and Andrew Woo. A fast voxel traversal algorithm for ray tracing. 1987

/// A ray in voxels, parametrized by its length t.
#[derive(Clone, Copy, Debug)]
pub(super) struct Ray {
    pub(super) origin: DVec3,
    /// Unit vector.
    pub(super) direction: DVec3,
    inverse: DVec3,
}

impl Ray {
    pub(super) fn new(origin: DVec3, direction: DVec3) -> Ray {
        Ray { origin, direction, inverse: direction.recip() }
    }

    pub(super) fn at(&self, t: f64) -> DVec3 {
        self.origin + self.direction * t
    }

    /// The interval of t, between `t_min` and `t_max`, in which the ray is inside a box, which may be flat.
    /// `None` if the ray misses the box or is not finite.
    pub(super) fn within(&self, least: DVec3, greatest: DVec3, [t_min, t_max]: [f64; 2]) -> Option<[f64; 2]> {
        if !(self.origin.is_finite() && self.direction.is_finite()) {
            return None;
        }
        let (mut first, mut last) = (t_min, t_max);
        for axis in 0..3 {
            let one = (least[axis] - self.origin[axis]) * self.inverse[axis];
            let other = (greatest[axis] - self.origin[axis]) * self.inverse[axis];
            if self.direction[axis] == 0.0 {
                let is_outside = self.origin[axis] < least[axis] || self.origin[axis] > greatest[axis];
                last = if is_outside { f64::NEG_INFINITY } else { last };
            } else {
                first = first.max(one.min(other));
                last = last.min(one.max(other));
            }
        }
        (first <= last).then_some([first, last])
    }
}

/// Iterates over the cells along a part of a ray, each with the interval of t in which the ray is in the
/// cell.
pub(super) struct Cells {
    cell: IVec3,
    step: IVec3,
    /// For each axis, the t at which the ray reaches the next plane.
    exits: DVec3,
    /// For each axis, the step of t between successive planes.
    strides: DVec3,
    t: f64,
    last: f64,
    least: IVec3,
    greatest: IVec3,
}

impl Cells {
    /// Cells of this edge, in voxels, from the first t to the last. Leaves out cells outside of `least` to
    /// `greatest`, which only rounding can produce.
    pub(super) fn along(
        ray: &Ray,
        edge: f64,
        [first, last]: [f64; 2],
        [least, greatest]: [IVec3; 2],
    ) -> Cells {
        let at = ray.at(first) / edge;
        let cell = at.floor().as_ivec3().clamp(least, greatest);
        let (mut step, mut exits, mut strides) = (IVec3::ZERO, DVec3::INFINITY, DVec3::INFINITY);
        for axis in 0..3 {
            let along = ray.direction[axis];
            if along != 0.0 {
                let is_up = along > 0.0;
                let plane = f64::from(cell[axis] + i32::from(is_up)) * edge;
                step[axis] = if is_up { 1 } else { -1 };
                exits[axis] = (plane - ray.origin[axis]) * ray.inverse[axis];
                strides[axis] = edge * ray.inverse[axis].abs();
            }
        }
        Cells { cell, step, exits, strides, t: first, last, least, greatest }
    }
}

impl Iterator for Cells {
    type Item = (IVec3, [f64; 2]);

    fn next(&mut self) -> Option<(IVec3, [f64; 2])> {
        let is_in = self.cell.cmpge(self.least).all() && self.cell.cmple(self.greatest).all();
        if self.t >= self.last || !is_in {
            return None;
        }
        let (cell, first) = (self.cell, self.t);
        let axis = self.exits.min_position();
        self.t = self.exits[axis].clamp(first, self.last);
        self.cell[axis] += self.step[axis];
        self.exits[axis] += self.strides[axis];
        Some((cell, [first, self.t]))
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use glam::DVec3;
    use meniscus_surface::grid::{Topology, voxel_in_leaf};

    use super::*;

    /// The narrow band of a shape.
    fn band(reach: i32, distance: impl Fn(Vec3) -> f32) -> NarrowBand {
        let mut origins = Vec::new();
        for x in (-reach..reach).step_by(8) {
            for y in (-reach..reach).step_by(8) {
                for z in (-reach..reach).step_by(8) {
                    let origin = IVec3::new(x, y, z);
                    if distance((origin + 4).as_vec3()).abs() < 16.0 {
                        origins.push(origin);
                    }
                }
            }
        }
        let topology = Topology::new(origins);
        let mut phi = Field::splat(topology.len(), 0.0);
        for (leaf, origin) in phi.leaves.iter_mut().zip(topology.origins()) {
            for (offset, value) in leaf.values.iter_mut().enumerate() {
                *value = distance((origin + voxel_in_leaf(offset)).as_vec3()).clamp(-9.0, 9.0);
            }
        }
        NarrowBand { topology: Arc::new(topology), phi, half_width: 9.0 }
    }

    fn rays(count: usize) -> impl Iterator<Item = Ray> {
        let mut state = 7u32;
        let mut random = move || {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            f64::from(state >> 8) / f64::from(1 << 24) - 0.5
        };
        (0..count).map(move |_| {
            let mut vector = || DVec3::new(random(), random(), random());
            let origin = vector().normalize() * 80.0;
            Ray::new(origin, (vector() * 50.0 - origin).normalize())
        })
    }

    #[test]
    fn rays_hit_a_sphere_at_its_surface() {
        let radius = 17.3;
        let band = band(40, |at| at.length() - radius);
        let surface = RaySurface::new(&band, None);
        for ray in rays(20_000) {
            let middle = -ray.origin.dot(ray.direction);
            let nearest = ray.at(middle).length();
            if let Some(hit) = surface.intersect(&ray) {
                assert!((ray.at(hit.t).length() - f64::from(radius)).abs() < 0.02, "{hit:?} of {ray:?}");
                assert!(hit.is_front && hit.t < middle + 1.0, "{hit:?} of {ray:?}");
                let around = surface.around(&ray, &hit);
                let outward = ray.at(hit.t).normalize().as_vec3();
                assert!(around.gradient().normalize().dot(outward) > 0.999);
                assert!((around.mean_curvature() * radius - 1.0).abs() < 0.1, "{}", around.mean_curvature());
            } else {
                assert!(nearest > f64::from(radius) - 0.02, "{ray:?} passes at {nearest}");
            }
        }
    }

    /// The spline of a small drop leaves the cells with corners on both sides, so a ray may enter them inside.
    #[test]
    fn rays_hit_a_small_drop_from_outside() {
        let (center, radius) = (Vec3::new(0.4, 0.1, 0.3), 1.9);
        let band = band(16, |at| at.distance(center) - radius);
        let surface = RaySurface::new(&band, None);
        let mut hit_count = 0;
        for ray in rays(200_000) {
            let Some(hit) = surface.intersect(&ray) else { continue };
            let distance = ray.at(hit.t).distance(center.as_dvec3());
            assert!(hit.is_front && (distance - f64::from(radius)).abs() < 0.1, "{distance} {hit:?}");
            hit_count += 1;
        }
        assert!(hit_count > 1000, "{hit_count}");
    }

    #[test]
    fn cells_cover_the_ray_without_gaps() {
        let everywhere = [IVec3::MIN, IVec3::MAX];
        for direction in
            [DVec3::X, DVec3::new(-1.0, 2.0, 0.3), DVec3::new(1.0, 1.0, 1.0), DVec3::new(0.0, -1.0, 1e-9)]
        {
            let ray = Ray::new(DVec3::new(0.3, -7.9, 2.2), direction.normalize());
            let mut t = 1.5;
            for (cell, [first, last]) in Cells::along(&ray, 4.0, [1.5, 60.0], everywhere) {
                assert_eq!(first, t, "no gap");
                let middle = ray.at((first + last) / 2.0) / 4.0;
                let inside = (middle - cell.as_dvec3()).clamp(DVec3::splat(-1e-9), DVec3::splat(1.0 + 1e-9));
                assert_eq!(inside, middle - cell.as_dvec3(), "{direction}");
                t = last;
            }
            assert_eq!(t, 60.0);
        }
    }

    #[test]
    fn rays_intersect_boxes() {
        let ray = Ray::new(DVec3::ZERO, DVec3::X);
        assert_eq!(ray.within(DVec3::new(2.0, -1.0, -1.0), DVec3::splat(3.0), [0.0, 9.0]), Some([2.0, 3.0]));
        assert_eq!(ray.within(DVec3::new(2.0, 1.0, -1.0), DVec3::splat(3.0), [0.0, 9.0]), None);
        assert_eq!(ray.within(DVec3::NEG_ONE, DVec3::ONE, [0.0, 9.0]), Some([0.0, 1.0]));
        let flat = DVec3::new(0.0, 1.0, 1.0);
        assert_eq!(ray.within(DVec3::X - flat, DVec3::X + flat, [0.0, 9.0]), Some([1.0, 1.0]));
    }

    #[test]
    fn non_finite_ray_intersects_nothing() {
        for origin in [DVec3::NAN, DVec3::INFINITY] {
            let ray = Ray::new(origin, DVec3::X);
            assert_eq!(ray.within(DVec3::NEG_ONE, DVec3::ONE, [0.0, 9.0]), None);
        }
    }
}
