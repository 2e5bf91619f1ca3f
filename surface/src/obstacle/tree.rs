//! A bounding-box tree of triangles. Each branch also has its dipole, for winding numbers.
//!
//! Leaves hold eight triangles, because distances are computed eight at a time. Positions are in world units
//! and in 64 bits.

use glam::DVec3;

use super::surface::area_vector;
use crate::grid::{LEAF_VOXELS, Leaf};
use crate::simd::{Kernel, Lanes};

/// Number of triangles in a leaf.
const LEAF_TRIANGLES: usize = 8;

/// A branch: a range of triangles.
pub(super) struct TriangleNode {
    /// The bounding box of the triangles.
    pub(super) min: DVec3,
    pub(super) max: DVec3,
    /// Their area-weighted centre.
    pub(super) center: DVec3,
    /// The sum of their normals, each with the area as its length.
    pub(super) area_vector: DVec3,
    /// The squared distance from the centre to the farthest corner.
    pub(super) radius_squared: f64,
    /// The first triangle, and the number of triangles.
    first: u32,
    count: u32,
    /// Index of the second child; the first child is the next node. 0 for a leaf.
    second: u32,
}

/// The tree.
pub(super) struct TriangleTree {
    nodes: Vec<TriangleNode>,
    triangles: Vec<[DVec3; 3]>,
}

/// The contents of a node.
pub(super) enum TreeBranch<'a> {
    /// The two children.
    Both([u32; 2]),
    /// Up to eight triangles.
    Leaf(&'a [[DVec3; 3]]),
}

impl TriangleTree {
    pub(super) fn new(triangles: Vec<[DVec3; 3]>) -> TriangleTree {
        let mut order: Vec<(DVec3, u32)> =
            triangles.iter().zip(0..).map(|([a, b, c], index)| ((a + b + c) / 3.0, index)).collect();
        let mut nodes = Vec::with_capacity(2 * triangles.len().div_ceil(LEAF_TRIANGLES));
        if !order.is_empty() {
            split(&mut order, 0, &triangles, &mut nodes);
        }
        let triangles = order.iter().map(|&(_, index)| triangles[index as usize]).collect();
        TriangleTree { nodes, triangles }
    }

    /// All triangles, in tree order.
    pub(super) fn triangles(&self) -> &[[DVec3; 3]] {
        &self.triangles
    }

    /// The node of all triangles.
    pub(super) fn root(&self) -> Option<&TriangleNode> {
        self.nodes.first()
    }

    pub(super) fn node(&self, index: u32) -> &TriangleNode {
        &self.nodes[index as usize]
    }

    pub(super) fn branch(&self, index: u32) -> TreeBranch<'_> {
        let node = &self.nodes[index as usize];
        match node.second {
            0 => TreeBranch::Leaf(&self.triangles[node.first as usize..][..node.count as usize]),
            second => TreeBranch::Both([index + 1, second]),
        }
    }

    /// The memory of the tree, in bytes.
    pub(super) fn size_bytes(&self) -> usize {
        size_of_val(&*self.nodes) + size_of_val(&*self.triangles)
    }

    /// The squared distance from a point to the nearest triangle, if this squared distance is less than
    /// `limit`.
    pub(super) fn nearest_squared(&self, point: DVec3, limit: f64) -> Option<f64> {
        self.nearest(point, limit).map(|nearest| nearest.distance_squared(point))
    }

    /// The nearest point on a triangle, if its squared distance is less than `limit`.
    pub(super) fn nearest(&self, point: DVec3, limit: f64) -> Option<DVec3> {
        self.nearest_triangle(point, limit).map(|(_, nearest)| nearest)
    }

    /// The nearest triangle and the nearest point on it, if its squared distance is less than `limit`.
    pub(super) fn nearest_triangle(&self, point: DVec3, limit: f64) -> Option<(usize, DVec3)> {
        let (mut nearest, mut found) = (limit, None);
        let mut pending = vec![(self.root()?.distance_squared(point), 0)];
        while let Some((distance, index)) = pending.pop() {
            if distance >= nearest {
                continue;
            }
            match self.branch(index) {
                TreeBranch::Leaf(triangles) => {
                    let first = self.nodes[index as usize].first as usize;
                    for (triangle, index) in triangles.iter().zip(first..) {
                        let on_triangle = nearest_point(triangle, point);
                        let squared = on_triangle.distance_squared(point);
                        if squared < nearest {
                            (nearest, found) = (squared, Some((index, on_triangle)));
                        }
                    }
                }
                TreeBranch::Both(nodes) => {
                    let mut both = nodes.map(|node| (self.node(node).distance_squared(point), node));
                    if both[0].0 < both[1].0 {
                        both.swap(0, 1);
                    }
                    // The nearer child is visited first.
                    pending.extend(both.into_iter().filter(|(distance, _)| *distance < nearest));
                }
            }
        }
        found
    }

    /// Calls `each` for the leaves within `box_reach` of a cube and within `center_reach` of its centre. The
    /// cube extends from `center` by `half_edge` to each side.
    pub(super) fn leaves_near(
        &self,
        center: DVec3,
        half_edge: f64,
        box_reach: f64,
        center_reach: f64,
        mut each: impl FnMut(&[[DVec3; 3]]),
    ) {
        let is_near = |node: &TriangleNode| {
            let apart = (node.min - center).max(center - node.max) - half_edge;
            apart.max(DVec3::ZERO).length_squared() <= box_reach * box_reach
                && node.distance_squared(center) <= center_reach * center_reach
        };
        let mut pending: Vec<u32> = self.root().filter(|root| is_near(root)).map(|_| 0).into_iter().collect();
        while let Some(index) = pending.pop() {
            match self.branch(index) {
                TreeBranch::Leaf(triangles) => each(triangles),
                TreeBranch::Both(nodes) => {
                    pending.extend(nodes.into_iter().filter(|&node| is_near(self.node(node))));
                }
            }
        }
    }
}

impl TriangleNode {
    /// The squared distance from a point to the box.
    pub(super) fn distance_squared(&self, point: DVec3) -> f64 {
        (self.min - point).max(point - self.max).max(DVec3::ZERO).length_squared()
    }
}

/// Builds the node of a range of triangles and the nodes below it.
fn split(order: &mut [(DVec3, u32)], first: u32, triangles: &[[DVec3; 3]], nodes: &mut Vec<TriangleNode>) {
    let index = nodes.len();
    nodes.push(node_of(order, first, triangles));
    if order.len() <= LEAF_TRIANGLES {
        return;
    }
    let (mut min, mut max) = (DVec3::INFINITY, DVec3::NEG_INFINITY);
    for (center, _) in &*order {
        (min, max) = (min.min(*center), max.max(*center));
    }
    let axis = (max - min).max_position();
    // All leaves but the last are full.
    let half = (order.len() / 2).next_multiple_of(LEAF_TRIANGLES).min(order.len() - 1);
    order.select_nth_unstable_by(half, |one, other| {
        one.0[axis].total_cmp(&other.0[axis]).then(one.1.cmp(&other.1))
    });
    let (one, other) = order.split_at_mut(half);
    // Selection only splits into two sets. Sort small sets, because the order in a set depends on the
    // library.
    for part in [&mut *one, &mut *other] {
        if part.len() <= LEAF_TRIANGLES {
            part.sort_unstable_by_key(|&(_, index)| index);
        }
    }
    split(one, first, triangles, nodes);
    nodes[index].second = nodes.len() as u32;
    split(other, first + half as u32, triangles, nodes);
}

fn node_of(order: &[(DVec3, u32)], first: u32, triangles: &[[DVec3; 3]]) -> TriangleNode {
    let members = || order.iter().map(|&(center, index)| (center, &triangles[index as usize]));
    let (mut min, mut max) = (DVec3::INFINITY, DVec3::NEG_INFINITY);
    let (mut vector, mut moment, mut area) = (DVec3::ZERO, DVec3::ZERO, 0.0);
    for (center, triangle) in members() {
        for &corner in triangle {
            (min, max) = (min.min(corner), max.max(corner));
        }
        let one = area_vector(triangle);
        let size = one.length();
        vector += one;
        // Relative to the first triangle, to keep precision far from the origin.
        moment += size * (center - order[0].0);
        area += size;
    }
    let center = order[0].0 + moment / area;
    let reach = |(_, triangle): (DVec3, &[DVec3; 3])| {
        triangle.iter().fold(0.0, |most: f64, corner| most.max(corner.distance_squared(center)))
    };
    let radius_squared = members().map(reach).fold(0.0, f64::max);
    TriangleNode {
        min,
        max,
        center,
        area_vector: vector,
        radius_squared,
        first,
        count: order.len() as u32,
        second: 0,
    }
}

/// The point of a triangle with an area that is nearest to `point`.
///
/// Christer Ericson. Real-Time Collision Detection. 2005
pub(super) fn nearest_point(&[a, b, c]: &[DVec3; 3], point: DVec3) -> DVec3 {
    let (ab, ac, ap) = (b - a, c - a, point - a);
    let (d1, d2) = (ab.dot(ap), ac.dot(ap));
    if d1 <= 0.0 && d2 <= 0.0 {
        return a;
    }
    let bp = point - b;
    let (d3, d4) = (ab.dot(bp), ac.dot(bp));
    if d3 >= 0.0 && d4 <= d3 {
        return b;
    }
    let vc = d1 * d4 - d3 * d2;
    if vc <= 0.0 && d1 >= 0.0 && d3 <= 0.0 {
        return a + ab * (d1 / (d1 - d3));
    }
    let cp = point - c;
    let (d5, d6) = (ab.dot(cp), ac.dot(cp));
    if d6 >= 0.0 && d5 <= d6 {
        return c;
    }
    let vb = d5 * d2 - d1 * d6;
    if vb <= 0.0 && d2 >= 0.0 && d6 <= 0.0 {
        return a + ac * (d2 / (d2 - d6));
    }
    let va = d3 * d6 - d5 * d4;
    if va <= 0.0 && d4 >= d3 && d5 >= d6 {
        return b + (c - b) * ((d4 - d3) / ((d4 - d3) + (d5 - d6)));
    }
    let normal = ab.cross(ac);
    point - normal * (normal.dot(ap) / normal.length_squared())
}

// Distances from the voxels of a leaf to triangles, eight at a time.
//
// Each edge of a triangle has its own frame: along the edge, out of the triangle, and along the normal.
//
//         c                      t: coordinate of p along u; "beyond" is how far p lies past the edge's ends
//        ╱ ╲     out m₁          s: coordinate of p along m, the direction in the plane out of the triangle
//       ╱   ╲  ↗                 h: distance of p from the plane, along the normal
//      a ─── b
//        u₀ →                    squared distance: h² inside all edges; else the least h² + s² + beyond²
//
// For each triangle, these directions are stored, and the offsets of its edges along these directions,
// relative to the centre of the leaf. Offsets are computed in 64 bits. For a nearby triangle they are small
// numbers, however large the triangle is, and however far from the world origin.
//
// Distances are computed only to triangles that may be the nearest to a voxel. The candidates are culled
// block by block:
//
//   8³ ──▶ eight blocks of 4³ ──▶ eight of 2³ each ──▶ eight voxels: a row of values
//
//   kept if d(centre, triangle) ≤ d(centre, nearest) + 2 · (from the block's centre to its farthest voxel)

/// Number of values per triangle.
const VALUE_COUNT: usize = 31;

/// Eight triangles, one array per value.
#[derive(Clone, Debug)]
pub(super) struct Triangle8 {
    rows: [[f32; LEAF_TRIANGLES]; VALUE_COUNT],
    /// Mask of the lanes that hold a triangle.
    lanes: u8,
}

impl Triangle8 {
    /// At most eight triangles; positions become `(world − center) · scale`.
    pub(super) fn new(triangles: &[[DVec3; 3]], center: DVec3, scale: f64) -> Triangle8 {
        let mut eight = Triangle8 { rows: [[0.0; LEAF_TRIANGLES]; VALUE_COUNT], lanes: 0 };
        for (lane, triangle) in triangles.iter().take(LEAF_TRIANGLES).enumerate() {
            let numbers = values_of(triangle.map(|corner| (corner - center) * scale));
            for (row, number) in eight.rows.iter_mut().zip(numbers) {
                row[lane] = number;
            }
            eight.lanes |= 1 << lane;
        }
        eight
    }
}

/// Normal and offset of the plane; for each edge: outward direction and its offset, edge direction and the
/// offsets of both ends.
fn values_of(corners: [DVec3; 3]) -> [f32; VALUE_COUNT] {
    let mut numbers = [0.0; VALUE_COUNT];
    let [a, b, c] = corners;
    let normal = (b - a).cross(c - a).normalize_or_zero();
    put(&mut numbers, 0, normal, normal.dot(a));
    for edge in 0..3 {
        let (from, to) = (corners[edge], corners[(edge + 1) % 3]);
        let along = (to - from).normalize_or_zero();
        let out = along.cross(normal);
        put(&mut numbers, 4 + 9 * edge, out, out.dot(from));
        put(&mut numbers, 8 + 9 * edge, along, along.dot(from));
        numbers[12 + 9 * edge] = along.dot(to) as f32;
    }
    numbers
}

fn put(numbers: &mut [f32; VALUE_COUNT], at: usize, direction: DVec3, offset: f64) {
    let [x, y, z] = direction.to_array();
    for (number, value) in numbers[at..at + 4].iter_mut().zip([x, y, z, offset]) {
        *number = value as f32;
    }
}

/// Computes the distances from the voxels of a leaf, in voxels, limited to `most`.
pub(super) struct TriangleDistances<'a> {
    /// The triangles, relative to the centre of the leaf and in voxels.
    pub(super) packets: &'a [Triangle8],
    pub(super) most: f32,
}

/// Added when distances are compared: more than their rounding error.
const ROUNDING: f32 = 1e-3;

impl Kernel for TriangleDistances<'_> {
    type Output = Leaf;

    #[inline(always)]
    fn run<V: Lanes>(self) -> Leaf {
        let TriangleDistances { packets, most } = self;
        let all: Vec<(u32, u8)> =
            packets.iter().zip(0..).map(|(eight, index)| (index, eight.lanes)).collect();
        let (mut near_four, mut near_two) = (Vec::with_capacity(all.len()), Vec::with_capacity(all.len()));
        let mut squares = vec![[0.0f32; 8]; all.len()];
        let mut leaf = Leaf::splat(most);
        for four in 0..8 {
            let center = step(four).map(|c| 4.0 * c - 2.0);
            cull::<V>(packets, &all, center, 1.5, most, &mut squares, &mut near_four);
            if near_four.is_empty() {
                continue;
            }
            for two in 0..8 {
                let within = step(two);
                let center = [0, 1, 2].map(|axis| center[axis] + 2.0 * within[axis] - 1.0);
                cull::<V>(packets, &near_four, center, 0.5, most, &mut squares, &mut near_two);
                if !near_two.is_empty() {
                    let distances = block_distances::<V>(packets, &near_two, center, most);
                    scatter(&distances, four, two, &mut leaf);
                }
            }
        }
        leaf
    }
}

/// The position of block or voxel `index` of eight: 0 or 1 on each axis.
#[inline(always)]
fn step(index: usize) -> [f32; 3] {
    [(index >> 2) as f32, (index >> 1 & 1) as f32, (index & 1) as f32]
}

/// Culls the triangles that cannot be the nearest to a voxel of a block, and those farther than `most`.
/// Voxels are up to `half_edge` from the centre on each axis.
#[inline(always)]
fn cull<V: Lanes>(
    packets: &[Triangle8],
    from: &[(u32, u8)],
    center: [f32; 3],
    half_edge: f32,
    most: f32,
    squares: &mut [[f32; 8]],
    to: &mut Vec<(u32, u8)>,
) {
    to.clear();
    let radius = half_edge * 3f32.sqrt();
    let point = [V::splat(center[0]), V::splat(center[1]), V::splat(center[2])];
    let infinite = V::splat(f32::INFINITY);
    let mut least = infinite;
    for (&(index, lanes), squares) in from.iter().zip(&mut *squares) {
        let distance = squared(&EdgeFrames::<V>::of_packet(&packets[index as usize]), point);
        let distance = V::select(V::mask(lanes), distance, infinite);
        least = least.min(distance);
        distance.store(squares);
    }
    let mut lanes = [0.0; 8];
    least.store(&mut lanes);
    let mut nearest = lanes[0];
    for lane in lanes {
        nearest = if lane < nearest { lane } else { nearest };
    }
    let farthest = (nearest.sqrt() + 2.0 * radius).min(most + radius) + ROUNDING;
    let limit = V::splat(farthest * farthest);
    for (&(index, _), squares) in from.iter().zip(&*squares) {
        let lanes = V::bits(V::load(squares).lt(limit));
        if lanes != 0 {
            to.push((index, lanes));
        }
    }
}

/// The distances from the eight voxels around a point.
#[inline(always)]
fn block_distances<V: Lanes>(
    packets: &[Triangle8],
    near: &[(u32, u8)],
    center: [f32; 3],
    most: f32,
) -> [f32; 8] {
    let point = [
        V::load(&[-0.5, -0.5, -0.5, -0.5, 0.5, 0.5, 0.5, 0.5]).add(V::splat(center[0])),
        V::load(&[-0.5, -0.5, 0.5, 0.5, -0.5, -0.5, 0.5, 0.5]).add(V::splat(center[1])),
        V::load(&[-0.5, 0.5, -0.5, 0.5, -0.5, 0.5, -0.5, 0.5]).add(V::splat(center[2])),
    ];
    let mut least = V::splat(most * most);
    for &(index, lanes) in near {
        let mut lanes = lanes;
        while lanes != 0 {
            let lane = lanes.trailing_zeros() as usize;
            lanes &= lanes - 1;
            least = least.min(squared(&EdgeFrames::<V>::of_triangle(&packets[index as usize], lane), point));
        }
    }
    let mut distances = [0.0; 8];
    least.sqrt().store(&mut distances);
    distances
}

/// Writes the distances of a block of 2³ voxels to their voxels.
#[inline(always)]
fn scatter(distances: &[f32; 8], four: usize, two: usize, leaf: &mut Leaf) {
    let bit = |index: usize, axis: usize| index >> (2 - axis) & 1;
    for (index, distance) in distances.iter().enumerate() {
        let coord = |axis: usize| 4 * bit(four, axis) + 2 * bit(two, axis) + bit(index, axis);
        let offset = coord(0) << 6 | coord(1) << 3 | coord(2);
        debug_assert!(offset < LEAF_VOXELS);
        leaf.values[offset] = *distance;
    }
}

/// The values of one triangle for eight points, or of eight triangles for one point.
struct EdgeFrames<V> {
    numbers: [V; VALUE_COUNT],
}

impl<V: Lanes> EdgeFrames<V> {
    #[inline(always)]
    fn of_packet(eight: &Triangle8) -> EdgeFrames<V> {
        let mut numbers = [V::splat(0.0); VALUE_COUNT];
        for (number, row) in numbers.iter_mut().zip(&eight.rows) {
            *number = V::load(row);
        }
        EdgeFrames { numbers }
    }

    #[inline(always)]
    fn of_triangle(eight: &Triangle8, lane: usize) -> EdgeFrames<V> {
        let mut numbers = [V::splat(0.0); VALUE_COUNT];
        for (number, row) in numbers.iter_mut().zip(&eight.rows) {
            *number = V::splat(row[lane]);
        }
        EdgeFrames { numbers }
    }

    /// The coordinate of a point along the direction stored at `at`.
    #[inline(always)]
    fn along(&self, at: usize, [x, y, z]: [V; 3]) -> V {
        self.numbers[at].mul(x).add(self.numbers[at + 1].mul(y)).add(self.numbers[at + 2].mul(z))
    }
}

/// For each lane, the squared distance between its point and its triangle.
#[inline(always)]
fn squared<V: Lanes>(frame: &EdgeFrames<V>, point: [V; 3]) -> V {
    let zero = V::splat(0.0);
    let off_plane = frame.along(0, point).sub(frame.numbers[3]);
    let mut off_edges = V::splat(f32::INFINITY);
    let mut outermost = V::splat(f32::NEG_INFINITY);
    for edge in 0..3 {
        let at = 4 + 9 * edge;
        let out = frame.along(at, point).sub(frame.numbers[at + 3]);
        let along = frame.along(at + 4, point);
        let before = frame.numbers[at + 7].sub(along);
        let after = along.sub(frame.numbers[at + 8]);
        let beyond = before.max(after).max(zero);
        off_edges = off_edges.min(out.mul(out).add(beyond.mul(beyond)));
        outermost = outermost.max(out);
    }
    let in_plane = V::select(zero.lt(outermost), off_edges, zero);
    off_plane.mul(off_plane).add(in_plane)
}
