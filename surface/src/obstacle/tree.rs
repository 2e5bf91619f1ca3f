//! A bounding-box tree of triangles. Each branch also has its dipole, for winding numbers.
//!
//! Leaves hold eight triangles, because distances are computed eight at a time. Positions are in world units
//! and in 64 bits.

use glam::DVec3;

use super::surface::area_vector;

/// Number of triangles in a leaf.
pub(super) const LEAF_TRIANGLES: usize = 8;

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
        let (mut nearest, mut found) = (limit, None);
        let mut pending = vec![(self.root()?.distance_squared(point), 0)];
        while let Some((distance, index)) = pending.pop() {
            if distance >= nearest {
                continue;
            }
            match self.branch(index) {
                TreeBranch::Leaf(triangles) => {
                    for triangle in triangles {
                        let on_triangle = nearest_point(triangle, point);
                        let squared = on_triangle.distance_squared(point);
                        if squared < nearest {
                            (nearest, found) = (squared, Some(on_triangle));
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
