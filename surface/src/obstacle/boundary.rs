//! A bounding-box tree of the boundary edges of a surface. It bounds how fast the winding number w can change
//! near a point:
//!
//! ```text
//!   |∇w| ≤ 1/4π · Σ length / distance²        over the boundary edges
//! ```
//!
//! If a box is far away for its size, all its edges are counted with the distance of the box, which is at
//! most the distance of the edges. So even a mesh whose triangles share no edges takes little longer than a
//! mesh with a hole.

use std::f64::consts::PI;

use glam::DVec3;

/// The boundary edges of a surface.
pub(super) struct BoundaryEdges {
    nodes: Vec<EdgeNode>,
    edges: Vec<[DVec3; 2]>,
}

/// A range of edges.
struct EdgeNode {
    /// The bounding box of the edges.
    min: DVec3,
    max: DVec3,
    /// The sum of the edges' lengths.
    length: f64,
    /// The first edge, and the number of edges.
    first: u32,
    count: u32,
    /// Index of the second child; the first child is the next node. 0 for a leaf.
    second: u32,
}

/// Maximum number of edges in a leaf.
const LEAF_EDGES: usize = 8;

/// A box is far away if its distance exceeds this many times its diagonal. The distance of an edge is then
/// underestimated by at most a quarter.
const FAR: f64 = 3.0;

impl BoundaryEdges {
    pub(super) fn new(edges: Vec<[DVec3; 2]>) -> BoundaryEdges {
        let mut order: Vec<(DVec3, u32)> =
            edges.iter().zip(0..).map(|([from, to], index)| (0.5 * (from + to), index)).collect();
        let mut nodes = Vec::with_capacity(4 * edges.len().div_ceil(LEAF_EDGES));
        if !order.is_empty() {
            split(&mut order, 0, &edges, &mut nodes);
        }
        let edges = order.iter().map(|&(_, index)| edges[index as usize]).collect();
        BoundaryEdges { nodes, edges }
    }

    /// The number of edges.
    pub(super) fn len(&self) -> usize {
        self.edges.len()
    }

    pub(super) fn is_empty(&self) -> bool {
        self.edges.is_empty()
    }

    /// The memory of the tree, in bytes.
    pub(super) fn size_bytes(&self) -> usize {
        size_of_val(&*self.nodes) + size_of_val(&*self.edges)
    }

    /// Upper bound of |∇w| within `radius` of a point, between triangles. (Across a triangle, w jumps.)
    pub(super) fn slope_bound(&self, center: DVec3, radius: f64) -> f64 {
        let mut sum = 0.0;
        let mut pending: Vec<u32> = self.nodes.first().map(|_| 0).into_iter().collect();
        while let Some(index) = pending.pop() {
            let node = &self.nodes[index as usize];
            let distance = node.distance(center) - radius;
            if distance > FAR * (node.max - node.min).length() {
                sum += node.length / (distance * distance);
            } else if node.second != 0 {
                // The nearer child is pushed last, so it is visited first and may end the search.
                let both = [index + 1, node.second];
                let [one, other] = both.map(|node| self.nodes[node as usize].distance(center));
                pending.extend(if one < other { [both[1], both[0]] } else { both });
            } else {
                let edges = &self.edges[node.first as usize..][..node.count as usize];
                sum += edges.iter().map(|edge| edge_slope(edge, center, radius)).sum::<f64>();
                if sum == f64::INFINITY {
                    break;
                }
            }
        }
        sum / (4.0 * PI)
    }
}

impl EdgeNode {
    /// The distance from a point to the box.
    fn distance(&self, point: DVec3) -> f64 {
        (self.min - point).max(point - self.max).max(DVec3::ZERO).length()
    }
}

/// The contribution of one edge to the sum.
fn edge_slope(&[from, to]: &[DVec3; 2], center: DVec3, radius: f64) -> f64 {
    let along = to - from;
    let t = ((center - from).dot(along) / along.length_squared()).clamp(0.0, 1.0);
    let distance = (from + along * t - center).length() - radius;
    if distance <= 0.0 { f64::INFINITY } else { along.length() / (distance * distance) }
}

/// Builds the node of a range of edges, given by their midpoints and indices, and the nodes below it.
fn split(order: &mut [(DVec3, u32)], first: u32, edges: &[[DVec3; 2]], nodes: &mut Vec<EdgeNode>) {
    let index = nodes.len();
    let (mut min, mut max) = (DVec3::INFINITY, DVec3::NEG_INFINITY);
    for &(_, edge) in &*order {
        let [from, to] = edges[edge as usize];
        (min, max) = (min.min(from).min(to), max.max(from).max(to));
    }
    nodes.push(EdgeNode { min, max, length: 0.0, first, count: order.len() as u32, second: 0 });
    if order.len() <= LEAF_EDGES {
        order.sort_unstable_by_key(|&(_, edge)| edge);
        let lengths =
            order.iter().map(|&(_, edge)| edges[edge as usize][0].distance(edges[edge as usize][1]));
        nodes[index].length = lengths.sum();
        return;
    }
    let axis = (max - min).max_position();
    let half = order.len() / 2;
    order.select_nth_unstable_by(half, |one, other| {
        one.0[axis].total_cmp(&other.0[axis]).then(one.1.cmp(&other.1))
    });
    let (one, other) = order.split_at_mut(half);
    split(one, first, edges, nodes);
    let second = nodes.len();
    split(other, first + half as u32, edges, nodes);
    nodes[index].second = second as u32;
    nodes[index].length = nodes[index + 1].length + nodes[second].length;
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The bound is at least the sum over all edges, and not much more.
    #[test]
    fn slope_bound_is_tight_against_the_sum_over_all_edges() {
        let random = |seed: usize| (seed as f64 * 12.9898).sin().mul_add(43758.5453, 0.0).rem_euclid(1.0);
        let random_point = |seed: usize| DVec3::new(random(seed), random(seed + 1), random(seed + 2));
        for count in [0, 1, 8, 9, 100, 5000] {
            let edge = |index: usize| {
                let from = 10.0 * random_point(9 * index);
                [from, from + 0.2 * (random_point(9 * index + 3) - 0.5)]
            };
            let edges: Vec<[DVec3; 2]> = (0..count).map(edge).collect();
            let boundary = BoundaryEdges::new(edges.clone());
            assert_eq!(boundary.len(), count);
            for query in 0..60 {
                let center = 60.0 * (random_point(7 * query + 5) - 0.5);
                let radius = random(query + 100);
                let all: f64 =
                    edges.iter().map(|edge| edge_slope(edge, center, radius)).sum::<f64>() / (4.0 * PI);
                let bound = boundary.slope_bound(center, radius);
                let slack = (4.0f64 / 3.0).powi(2) + 1e-9;
                let is_tight = all * (1.0 - 1e-9) <= bound && (bound <= all * slack || all == f64::INFINITY);
                assert!(is_tight, "{count} edges at {center}: {bound} for {all}");
            }
        }
    }

    /// A box that is far away counts as one edge, so only few of many edges are visited.
    #[test]
    fn distant_box_counts_as_one_edge() {
        let edges =
            (0..1000).map(|x| [DVec3::new(f64::from(x), 0.0, 0.0), DVec3::new(f64::from(x), 1.0, 0.0)]);
        let boundary = BoundaryEdges::new(edges.collect());
        assert_eq!(boundary.slope_bound(DVec3::new(0.0, 0.0, 4000.0), 0.0), 1000.0 / 16e6 / (4.0 * PI));
    }
}
