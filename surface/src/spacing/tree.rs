//! A k-d tree with a tight box at every node, for exact nearest neighbours.
//!
//! Why a tree and not a grid of cells: one particle far away, or one dense cluster, makes cells of any one
//! size useless, but does not slow a tree down.

use glam::DVec3;

use crate::interrupt::checkpoint;

/// Number of points in a leaf: scanning them is cheaper than testing another box.
const LEAF_COUNT: usize = 16;

/// Subtrees of fewer points are built on the current thread.
const PARALLEL_COUNT: usize = 1 << 14;

/// A node of the tree: the box of its points, and its two halves.
pub(super) struct KdNode<'a> {
    lower: DVec3,
    upper: DVec3,
    points: &'a [DVec3],
    /// `None` for a leaf: few points, or one position, possibly repeated.
    halves: Option<Box<[KdNode<'a>; 2]>>,
}

impl<'a> KdNode<'a> {
    /// Builds the tree by sorting the points in place. Halving by count bounds the depth for any data.
    pub(super) fn build(points: &'a mut [DVec3]) -> KdNode<'a> {
        checkpoint();
        let lower = points.iter().copied().fold(DVec3::INFINITY, DVec3::min);
        let upper = points.iter().copied().fold(DVec3::NEG_INFINITY, DVec3::max);
        if points.len() <= LEAF_COUNT || lower == upper {
            return KdNode { lower, upper, points, halves: None };
        }
        let axis = (upper - lower).max_position();
        let middle = points.len() / 2;
        points.select_nth_unstable_by(middle, |a, b| a[axis].total_cmp(&b[axis]));
        let parallel = points.len() > PARALLEL_COUNT;
        let (left, right) = points.split_at_mut(middle);
        let (left, right) = if parallel {
            rayon::join(|| KdNode::build(left), || KdNode::build(right))
        } else {
            (KdNode::build(left), KdNode::build(right))
        };
        KdNode { lower, upper, points: &[], halves: Some(Box::new([left, right])) }
    }

    /// Up to `count` nearest distinct positions other than `from`, as offsets from it, the nearest first.
    /// Ties are sorted by coordinates, so the order of the points does not matter.
    pub(super) fn neighbors(&self, from: DVec3, count: usize) -> Vec<DVec3> {
        let mut nearest = NearestPositions { from, count, found: Vec::with_capacity(count + 1) };
        self.search(&mut nearest);
        nearest.found.into_iter().map(|(_, point)| point - from).collect()
    }

    fn search(&self, nearest: &mut NearestPositions) {
        match &self.halves {
            None if self.lower == self.upper => nearest.offer(self.lower),
            None => self.points.iter().for_each(|&point| nearest.offer(point)),
            Some(halves) => {
                let [left, right] = &**halves;
                let distances = [left, right].map(|half| half.distance_squared(nearest.from));
                let order = if distances[0] <= distances[1] { [0, 1] } else { [1, 0] };
                for index in order {
                    // Coordinates break ties, so a box exactly at the limit counts, too.
                    if distances[index] <= nearest.limit() {
                        halves[index].search(nearest);
                    }
                }
            }
        }
    }

    /// The squared distance from a point to the node's box.
    fn distance_squared(&self, from: DVec3) -> f64 {
        from.distance_squared(from.clamp(self.lower, self.upper))
    }
}

/// The nearest distinct positions found so far, nearest first.
struct NearestPositions {
    from: DVec3,
    count: usize,
    found: Vec<(f64, DVec3)>,
}

impl NearestPositions {
    /// The largest squared distance that a further neighbour may have.
    fn limit(&self) -> f64 {
        if self.found.len() < self.count { f64::INFINITY } else { self.found[self.count - 1].0 }
    }

    fn offer(&mut self, point: DVec3) {
        let distance_squared = self.from.distance_squared(point);
        if distance_squared > self.limit() || point == self.from {
            return;
        }
        let key = (distance_squared, point);
        match self.found.binary_search_by(|other| compare(other, &key)) {
            Ok(_) => {}
            Err(index) => {
                self.found.insert(index, key);
                self.found.truncate(self.count);
            }
        }
    }
}

/// By distance, and then by coordinates.
fn compare((a_distance, a): &(f64, DVec3), (b_distance, b): &(f64, DVec3)) -> std::cmp::Ordering {
    let by_axis = |axis: usize| a[axis].total_cmp(&b[axis]);
    a_distance
        .total_cmp(b_distance)
        .then_with(|| by_axis(0))
        .then_with(|| by_axis(1))
        .then_with(|| by_axis(2))
}
