//! Where a surface ends, in a tree of boxes: how fast the winding number may change near a place.
//!
//! ```text
//!   |∇w| ≤ 1/4π · Σ length / distance²        over the edges of the rim
//! ```
//!
//! Edges that are far off for the size of their box are counted with its distance, which is no more than theirs. So a
//! mesh of which no triangle shares an edge with another one takes little longer to ask than a hole.

use std::f64::consts::PI;

use glam::DVec3;

/// The edges at which a surface ends.
pub(super) struct Rim {
    nodes: Vec<Node>,
    edges: Vec<[DVec3; 2]>,
}

/// The edges of a range.
struct Node {
    /// The box around them.
    min: DVec3,
    max: DVec3,
    /// Their lengths together.
    length: f64,
    /// The first edge, and how many there are.
    first: u32,
    count: u32,
    /// The second branch; the first follows this node. 0 for a leaf.
    second: u32,
}

/// Edges of a leaf.
const LEAF_EDGES: usize = 8;

/// A box is far off at so many times its diagonal: then no distance is taken for less than 3/4 of what it is.
const FAR: f64 = 3.0;

impl Rim {
    pub(super) fn new(edges: Vec<[DVec3; 2]>) -> Rim {
        let mut order: Vec<(DVec3, u32)> =
            edges.iter().zip(0..).map(|([from, to], index)| (0.5 * (from + to), index)).collect();
        let mut nodes = Vec::with_capacity(4 * edges.len().div_ceil(LEAF_EDGES));
        if !order.is_empty() {
            split(&mut order, 0, &edges, &mut nodes);
        }
        let edges = order.iter().map(|&(_, index)| edges[index as usize]).collect();
        Rim { nodes, edges }
    }

    /// How many edges there are.
    pub(super) fn len(&self) -> usize {
        self.edges.len()
    }

    pub(super) fn is_empty(&self) -> bool {
        self.edges.is_empty()
    }

    /// The bytes that it takes.
    pub(super) fn size_bytes(&self) -> usize {
        size_of_val(&*self.nodes) + size_of_val(&*self.edges)
    }

    /// No slope of the winding number is more than this within `radius` of a point, where there is no triangle.
    pub(super) fn slope_bound(&self, center: DVec3, radius: f64) -> f64 {
        let mut sum = 0.0;
        let mut pending: Vec<u32> = self.nodes.first().map(|_| 0).into_iter().collect();
        while let Some(index) = pending.pop() {
            let node = &self.nodes[index as usize];
            let distance = node.distance(center) - radius;
            if distance > FAR * (node.max - node.min).length() {
                sum += node.length / (distance * distance);
            } else if node.second != 0 {
                // What comes last is looked at first: the nearer one, which may end it.
                let both = [index + 1, node.second];
                let [one, other] = both.map(|node| self.nodes[node as usize].distance(center));
                pending.extend(if one < other { [both[1], both[0]] } else { both });
            } else {
                let edges = &self.edges[node.first as usize..][..node.count as usize];
                sum += edges.iter().map(|edge| of_edge(edge, center, radius)).sum::<f64>();
                if sum == f64::INFINITY {
                    break;
                }
            }
        }
        sum / (4.0 * PI)
    }
}

impl Node {
    /// From a point to the box.
    fn distance(&self, point: DVec3) -> f64 {
        (self.min - point).max(point - self.max).max(DVec3::ZERO).length()
    }
}

/// What an edge adds.
fn of_edge(&[from, to]: &[DVec3; 2], center: DVec3, radius: f64) -> f64 {
    let along = to - from;
    let place = ((center - from).dot(along) / along.length_squared()).clamp(0.0, 1.0);
    let distance = (from + along * place - center).length() - radius;
    if distance <= 0.0 { f64::INFINITY } else { along.length() / (distance * distance) }
}

/// Makes the node of a run of edges, given by their middles and numbers, and those below it.
fn split(order: &mut [(DVec3, u32)], first: u32, edges: &[[DVec3; 2]], nodes: &mut Vec<Node>) {
    let index = nodes.len();
    let (mut min, mut max) = (DVec3::INFINITY, DVec3::NEG_INFINITY);
    for &(_, edge) in &*order {
        let [from, to] = edges[edge as usize];
        (min, max) = (min.min(from).min(to), max.max(from).max(to));
    }
    nodes.push(Node { min, max, length: 0.0, first, count: order.len() as u32, second: 0 });
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

    /// Never less than the sum over all edges, and not much more.
    #[test]
    fn the_bound_is_that_of_all_edges() {
        let random = |seed: usize| (seed as f64 * 12.9898).sin().mul_add(43758.5453, 0.0).rem_euclid(1.0);
        let place = |seed: usize| DVec3::new(random(seed), random(seed + 1), random(seed + 2));
        for count in [0, 1, 8, 9, 100, 5000] {
            let edge = |index: usize| {
                let from = 10.0 * place(9 * index);
                [from, from + 0.2 * (place(9 * index + 3) - 0.5)]
            };
            let edges: Vec<[DVec3; 2]> = (0..count).map(edge).collect();
            let rim = Rim::new(edges.clone());
            assert_eq!(rim.len(), count);
            for asked in 0..60 {
                let center = 60.0 * (place(7 * asked + 5) - 0.5);
                let radius = random(asked + 100);
                let all: f64 =
                    edges.iter().map(|edge| of_edge(edge, center, radius)).sum::<f64>() / (4.0 * PI);
                let bound = rim.slope_bound(center, radius);
                let slack = (4.0f64 / 3.0).powi(2) + 1e-9;
                let is_tight = all * (1.0 - 1e-9) <= bound && (bound <= all * slack || all == f64::INFINITY);
                assert!(is_tight, "{count} edges at {center}: {bound} for {all}");
            }
        }
    }

    /// Of many edges few are looked at: those of a box that is far off are one.
    #[test]
    fn what_is_far_off_is_one() {
        let edges =
            (0..1000).map(|x| [DVec3::new(f64::from(x), 0.0, 0.0), DVec3::new(f64::from(x), 1.0, 0.0)]);
        let rim = Rim::new(edges.collect());
        assert_eq!(rim.slope_bound(DVec3::new(0.0, 0.0, 4000.0), 0.0), 1000.0 / 16e6 / (4.0 * PI));
    }
}
