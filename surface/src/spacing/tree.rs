//! A k-d tree with a tight box at every node, for exact nearest neighbours.
//!
//! Why a tree and not a grid of cells: one particle far away, or one dense cluster, makes cells of any one
//! size useless, but does not slow a tree down.

use glam::DVec3;

use crate::cancel::checkpoint;

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

// The Voronoi cell of a particle: the part of space that is closer to it than to any of its neighbours.
//
// Neighbours are offsets from the particle. Each cuts off everything beyond its bisecting plane.

/// Size to which an open cell is limited, in units of the distance of the farthest neighbour. The radius of
/// an open cell is then larger than the distances of all neighbours.
const END: f64 = 4.0;

/// A neighbour counts as beside the particle up to this slope, squared, relative to the plane of the section.
const STEEP: f64 = 0.5;

/// The size of a cell.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Volume {
    pub(super) volume: f64,
    /// Distance from the particle to the farthest corner.
    pub(super) radius: f64,
}

/// The size of the section of a cell by a plane through its particle.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Section {
    pub(super) area: f64,
    /// Distance from the particle to the farthest corner.
    pub(super) radius: f64,
}

impl Volume {
    /// The cell of a particle with these neighbours, of which the last is the farthest.
    ///
    /// Each face starts as a large square on the bisecting plane of a neighbour and is cut by the planes of
    /// all others. The cell is the union of the pyramids over the faces.
    pub(super) fn among(neighbors: &[DVec3]) -> Volume {
        let mut cell = Volume { volume: 0.0, radius: 0.0 };
        let end = END * neighbors.last().map_or(0.0, |neighbor| neighbor.length());
        let mut face = Polygon::default();
        for (index, &neighbor) in neighbors.iter().enumerate() {
            let height = 0.5 * neighbor.length();
            face.start(0.5 * neighbor, neighbor / neighbor.length(), end);
            let others = neighbors.iter().enumerate().filter(|&(other, _)| other != index);
            face.cut_by_all(others.map(|(_, other)| other));
            cell.volume += face.area() * height / 3.0;
            cell.radius = cell.radius.max(face.radius());
        }
        cell
    }
}

impl Section {
    /// The section by the plane normal to a unit vector. Only neighbours beside the particle count, not those
    /// above or below it; they are projected to the plane. The last neighbour is the farthest.
    pub(super) fn among(neighbors: &[DVec3], normal: DVec3) -> Section {
        let end = END * neighbors.last().map_or(0.0, |neighbor| neighbor.length());
        let adjacent = |neighbor: &DVec3| {
            let height = neighbor.dot(normal);
            let flat = *neighbor - height * normal;
            (height * height <= STEEP * flat.length_squared()).then_some(flat)
        };
        let adjacent: Vec<DVec3> = neighbors.iter().filter_map(adjacent).collect();
        let mut polygon = Polygon::default();
        polygon.start(DVec3::ZERO, normal, end);
        polygon.cut_by_all(&adjacent);
        Section { area: polygon.area(), radius: polygon.radius() }
    }
}

/// A convex polygon in a plane.
#[derive(Default)]
struct Polygon {
    corners: Vec<DVec3>,
    /// Buffer for the next cut.
    spare: Vec<DVec3>,
}

impl Polygon {
    /// Resets the polygon to a square.
    fn start(&mut self, middle: DVec3, normal: DVec3, half_diagonal: f64) {
        let (along, across) = normal.any_orthonormal_pair();
        let corners = [along, across, -along, -across].map(|direction| middle + half_diagonal * direction);
        self.corners.clear();
        self.corners.extend(corners);
    }

    fn cut_by_all<'a>(&mut self, others: impl IntoIterator<Item = &'a DVec3>) {
        for &other in others {
            self.cut(other);
            if self.corners.is_empty() {
                return;
            }
        }
    }

    /// Keeps the part that is closer to the origin than to `other`.
    fn cut(&mut self, other: DVec3) {
        let excess = |corner: DVec3| corner.dot(other) - 0.5 * other.length_squared();
        let Some(&last) = self.corners.last() else { return };
        let (mut before, mut before_excess) = (last, excess(last));
        self.spare.clear();
        for &corner in &self.corners {
            let corner_excess = excess(corner);
            if (before_excess > 0.0) != (corner_excess > 0.0) {
                self.spare.push(before.lerp(corner, before_excess / (before_excess - corner_excess)));
            }
            if corner_excess <= 0.0 {
                self.spare.push(corner);
            }
            (before, before_excess) = (corner, corner_excess);
        }
        std::mem::swap(&mut self.corners, &mut self.spare);
    }

    fn area(&self) -> f64 {
        let Some(&first) = self.corners.first() else { return 0.0 };
        let edges = self.corners.windows(2);
        let twice: DVec3 = edges.map(|edge| (edge[0] - first).cross(edge[1] - first)).sum();
        0.5 * twice.length()
    }

    /// Distance from the origin to the farthest corner.
    fn radius(&self) -> f64 {
        self.corners.iter().map(|corner| corner.length()).fold(0.0, f64::max)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn around(offsets: &[[f64; 3]]) -> Vec<DVec3> {
        let mut neighbors: Vec<DVec3> = offsets.iter().copied().map(DVec3::from).collect();
        neighbors.sort_by(|a, b| a.length().total_cmp(&b.length()));
        neighbors
    }

    fn cubic() -> Vec<DVec3> {
        let offset = |index: i32| [index % 3 - 1, index / 3 % 3 - 1, index / 9 - 1].map(f64::from);
        around(&(0..27).filter(|&index| index != 13).map(offset).collect::<Vec<_>>())
    }

    #[test]
    fn cell_of_a_cubic_lattice_is_a_cube() {
        let cell = Volume::among(&cubic());
        assert!(
            (cell.volume - 1.0).abs() < 1e-12 && (cell.radius - 0.75f64.sqrt()).abs() < 1e-12,
            "{cell:?}"
        );
        for normal in [DVec3::X, DVec3::Y, DVec3::Z] {
            let section = Section::among(&cubic(), normal);
            let expected = Section { area: 1.0, radius: 0.5f64.sqrt() };
            assert!((section.area - expected.area).abs() < 1e-12, "{section:?}");
            assert!((section.radius - expected.radius).abs() < 1e-12, "{section:?}");
        }
    }

    #[test]
    fn cell_of_a_face_centred_lattice_is_a_rhombic_dodecahedron() {
        let mut offsets = Vec::new();
        for (a, b) in [(1.0, 1.0), (1.0, -1.0), (-1.0, 1.0), (-1.0, -1.0)] {
            offsets.extend([[a, b, 0.0], [a, 0.0, b], [0.0, a, b]]);
        }
        let cell = Volume::among(&around(&offsets));
        assert!((cell.volume - 2.0).abs() < 1e-12 && (cell.radius - 1.0).abs() < 1e-12, "{cell:?}");
    }

    #[test]
    fn open_cell_reaches_beyond_its_neighbours() {
        let mut offsets = cubic();
        offsets.retain(|offset| offset.z <= 0.0);
        assert!(Volume::among(&offsets).radius > 2.0);
        assert!((Section::among(&offsets, DVec3::Z).area - 1.0).abs() < 1e-12);
        assert!(Section::among(&offsets, DVec3::X).radius > 2.0);
    }
}
