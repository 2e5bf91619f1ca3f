//! How far apart particles are, from their local density.
//!
//! Nearest neighbours mislead: in a random sample of density ρ the nearest neighbour is at about
//! half of ρ^(−1/3), on a lattice at exactly that. Over a ball that holds 32 others both agree:
//!
//! ```text
//!        .   .  .              r = distance to the 32nd neighbour
//!      .  . \ .  . .           (4π/3)·r³ holds 32 spacings cubed
//!     . .  . ●───── r          spacing = r / (32·3/4π)^(1/3)
//!      .  .  . .  .
//!        .  .   .              the median over the particles: surfaces and spray do not matter
//! ```
//!
//! Distances are exact, from a k-d tree with a tight box at every node. A tree rather than a grid
//! of cells: one particle far away, or one dense cluster, makes the cells of any one size useless,
//! and costs a tree nothing.
//!
//! Invariants: the result does not depend on the order of the particles; repeated positions are one
//! neighbour; multiplying all positions by a power of two multiplies the result exactly.

use std::collections::BTreeSet;

use glam::DVec3;

use crate::particles::Particles;

/// Which neighbour measures the density: far enough that randomness averages out, near enough to
/// stay local.
const NEIGHBOR: usize = 32;

/// Radius, in spacings, of the ball that holds [`NEIGHBOR`] particles: (32·3/4π)^(1/3).
const BALL_RADIUS_SPACINGS: f64 = 1.969_490_043_685_393;

/// The median of this many is within about a percent of the median of all, whatever the number of
/// particles.
const SAMPLE_COUNT: usize = 2000;

/// Points in a leaf of the tree: few enough that scanning them is cheaper than another box.
const LEAF_COUNT: usize = 16;

/// Subtrees of fewer points are built on the thread they are met on.
const PARALLEL_COUNT: usize = 1 << 14;

/// The mean distance between particles, in world units: the cube root of the volume that each has
/// to itself, at the median particle.
///
/// `None` when fewer than 33 distinct finite positions are there to measure it on, or when the
/// spacing has no place in the range of a 64-bit real.
pub fn estimate_spacing(particles: &Particles) -> Option<f64> {
    let mut points = finite_positions(particles);
    let sample = sample(&points);
    if sample.len() <= NEIGHBOR {
        return None;
    }
    let tree = Node::build(&mut points);
    let mut distances: Vec<f64> =
        sample.into_iter().map(|point| tree.neighbor_distance_squared(point).sqrt()).collect();
    distances.sort_unstable_by(f64::total_cmp);
    let middle = distances.len() / 2;
    let median = if distances.len() % 2 == 1 {
        distances[middle]
    } else {
        0.5 * (distances[middle - 1] + distances[middle])
    };
    let spacing = median / BALL_RADIUS_SPACINGS;
    (spacing.is_finite() && spacing > 0.0).then_some(spacing)
}

/// The median, the lower of the two in the middle where there are two; `None` where there is nothing.
pub(crate) fn median(mut numbers: Vec<f64>) -> Option<f64> {
    let middle = numbers.len().checked_sub(1)? / 2;
    Some(*numbers.select_nth_unstable_by(middle, f64::total_cmp).1)
}

fn finite_positions(particles: &Particles) -> Vec<DVec3> {
    (0..particles.len())
        // Adding zero makes −0 and 0 one position bit for bit.
        .map(|index| particles.position(index) + DVec3::ZERO)
        .filter(|point| point.is_finite())
        .collect()
}

/// Up to [`SAMPLE_COUNT`] distinct points: those with the least hashes, so that neither the order
/// of the points matters nor, as far as differences are exact, where in the world they are.
fn sample(points: &[DVec3]) -> Vec<DVec3> {
    let Some(anchor) = componentwise_median(points) else { return Vec::new() };
    let extent = points.iter().fold(DVec3::ZERO, |extent, &point| extent.max((point - anchor).abs()));
    let unit = extent.max_element();
    let mut least: BTreeSet<(u64, [u64; 3])> = BTreeSet::new();
    for &point in points {
        let entry = (hash_without_scale(point - anchor, unit), point.to_array().map(f64::to_bits));
        if least.len() < SAMPLE_COUNT {
            least.insert(entry);
        } else if least.last().is_some_and(|&greatest| entry < greatest) && least.insert(entry) {
            least.pop_last();
        }
    }
    least.into_iter().map(|(_, bits)| DVec3::from(bits.map(f64::from_bits))).collect()
}

/// A place amid the points. Unlike a corner of their box it does not follow an outlier, from whose
/// distance all others would look the same.
fn componentwise_median(points: &[DVec3]) -> Option<DVec3> {
    let mut values = Vec::with_capacity(points.len());
    let mut median = DVec3::ZERO;
    for axis in 0..3 {
        values.clear();
        values.extend(points.iter().map(|point| point[axis]));
        let middle = values.len() / 2;
        if values.is_empty() {
            return None;
        }
        median[axis] = *values.select_nth_unstable_by(middle, f64::total_cmp).1;
    }
    Some(median)
}

/// A hash of an offset. Exponents count relative to that of `unit`: a power of two does not change
/// the hash.
fn hash_without_scale(offset: DVec3, unit: f64) -> u64 {
    const EXPONENT: u64 = 0x7ff0_0000_0000_0000;
    let unit = unit.to_bits() & EXPONENT;
    offset.to_array().into_iter().fold(0, |hash, along| {
        let relative = if along == 0.0 { 0 } else { along.to_bits().wrapping_sub(unit) };
        mix(hash ^ relative)
    })
}

/// The finalizer of SplitMix64: every bit of the result depends on every bit of `value`.
fn mix(value: u64) -> u64 {
    let value = value.wrapping_add(0x9e37_79b9_7f4a_7c15);
    let value = (value ^ value >> 30).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    let value = (value ^ value >> 27).wrapping_mul(0x94d0_49bb_1331_11eb);
    value ^ value >> 31
}

/// A node of the tree: the box of its points, and the two halves of them.
struct Node<'a> {
    lower: DVec3,
    upper: DVec3,
    points: &'a [DVec3],
    /// `None` for a leaf: few points, or one position however often repeated.
    halves: Option<Box<[Node<'a>; 2]>>,
}

impl<'a> Node<'a> {
    /// Sorts the points into a tree. Halving by count bounds the depth on any data.
    fn build(points: &'a mut [DVec3]) -> Node<'a> {
        let lower = points.iter().copied().fold(DVec3::INFINITY, DVec3::min);
        let upper = points.iter().copied().fold(DVec3::NEG_INFINITY, DVec3::max);
        if points.len() <= LEAF_COUNT || lower == upper {
            return Node { lower, upper, points, halves: None };
        }
        let axis = (upper - lower).max_position();
        let middle = points.len() / 2;
        points.select_nth_unstable_by(middle, |a, b| a[axis].total_cmp(&b[axis]));
        let parallel = points.len() > PARALLEL_COUNT;
        let (left, right) = points.split_at_mut(middle);
        let (left, right) = if parallel {
            rayon::join(|| Node::build(left), || Node::build(right))
        } else {
            (Node::build(left), Node::build(right))
        };
        Node { lower, upper, points: &[], halves: Some(Box::new([left, right])) }
    }

    /// The squared distance from `from` to its 32nd neighbour among distinct positions other than
    /// itself; infinite when there are fewer.
    fn neighbor_distance_squared(&self, from: DVec3) -> f64 {
        let mut nearest = Nearest { from, found: Vec::with_capacity(NEIGHBOR + 1) };
        self.search(&mut nearest);
        nearest.limit()
    }

    fn search(&self, nearest: &mut Nearest) {
        match &self.halves {
            None if self.lower == self.upper => nearest.offer(self.lower),
            None => self.points.iter().for_each(|&point| nearest.offer(point)),
            Some(halves) => {
                let [left, right] = &**halves;
                let distances = [left, right].map(|half| half.distance_squared(nearest.from));
                let order = if distances[0] <= distances[1] { [0, 1] } else { [1, 0] };
                for index in order {
                    if distances[index] < nearest.limit() {
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
struct Nearest {
    from: DVec3,
    found: Vec<(f64, DVec3)>,
}

impl Nearest {
    /// What a further neighbour must be nearer than.
    fn limit(&self) -> f64 {
        if self.found.len() < NEIGHBOR { f64::INFINITY } else { self.found[NEIGHBOR - 1].0 }
    }

    fn offer(&mut self, point: DVec3) {
        let distance_squared = self.from.distance_squared(point);
        if distance_squared >= self.limit() || point == self.from {
            return;
        }
        let place = self.found.partition_point(|&(other, _)| other < distance_squared);
        let equally_far = self.found[place..].iter().take_while(|&&(other, _)| other == distance_squared);
        if equally_far.into_iter().any(|&(_, other)| other == point) {
            return;
        }
        self.found.insert(place, (distance_squared, point));
        self.found.truncate(NEIGHBOR);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn lattice(edge_count: usize, spacing: f64) -> Vec<[f64; 3]> {
        let along = |index: usize| index as f64 * spacing;
        (0..edge_count.pow(3))
            .map(|i| {
                [along(i % edge_count), along(i / edge_count % edge_count), along(i / edge_count.pow(2))]
            })
            .collect()
    }

    /// Uniform in the unit cube, from the hash itself: no dependency, the same everywhere.
    fn random(count: u64) -> Vec<[f64; 3]> {
        let unit = |seed: u64| (mix(seed) >> 11) as f64 / (1u64 << 53) as f64;
        (0..count).map(|i| [unit(3 * i), unit(3 * i + 1), unit(3 * i + 2)]).collect()
    }

    fn estimate(points: Vec<[f64; 3]>) -> f64 {
        estimate_spacing(&Particles::Double(points)).expect("enough particles")
    }

    fn assert_close(found: f64, expected: f64, tolerance: f64) {
        assert!((found / expected - 1.0).abs() < tolerance, "{found} where {expected} was expected");
    }

    #[test]
    fn ball_radius_is_what_it_says() {
        assert_close(BALL_RADIUS_SPACINGS, (32.0 * 0.75 / std::f64::consts::PI).cbrt(), 1e-15);
    }

    #[test]
    fn a_lattice_has_its_spacing() {
        assert_close(estimate(lattice(30, 0.05)), 0.05, 0.05);
        assert_close(estimate(lattice(30, 3e7)), 3e7, 0.05);
    }

    #[test]
    fn random_particles_have_the_cube_root_of_their_density() {
        assert_close(estimate(random(30_000)), (30_000f64).powf(-1.0 / 3.0), 0.05);
    }

    #[test]
    fn order_does_not_matter() {
        let points = random(5000);
        let expected = estimate(points.clone());
        let mut reordered: Vec<_> = points.iter().rev().copied().collect();
        reordered.rotate_left(1234);
        assert_eq!(estimate(reordered), expected);
    }

    #[test]
    fn repeated_positions_are_one_neighbour() {
        let points = random(5000);
        let mut repeated = points.clone();
        repeated.extend_from_slice(&points[..777]);
        repeated.extend(std::iter::repeat_n(points[5], 30_000));
        assert_close(estimate(repeated), estimate(points), 0.02);
    }

    #[test]
    fn powers_of_two_scale_exactly() {
        let points = random(5000);
        let scaled = |factor: f64| points.iter().map(|p| p.map(|x| x * factor)).collect::<Vec<_>>();
        let expected = estimate(points.clone());
        for exponent in [-40, -3, 1, 60] {
            let factor = 2f64.powi(exponent);
            assert_eq!(estimate(scaled(factor)), expected * factor);
        }
    }

    #[test]
    fn whole_steps_of_a_dyadic_lattice_change_nothing() {
        let points = lattice(20, 0.25);
        let moved = points.iter().map(|p| [p[0] + 4096.0, p[1] - 77.25, p[2] + 0.5]).collect();
        assert_eq!(estimate(points), estimate(moved));
    }

    #[test]
    fn far_from_the_origin_nothing_is_lost() {
        let moved = lattice(20, 0.05).iter().map(|p| p.map(|x| x + 1e9)).collect();
        assert_close(estimate(moved), 0.05, 0.05);
    }

    #[test]
    fn outliers_and_what_is_not_finite_do_not_matter() {
        let mut points = lattice(20, 0.05);
        points.extend([[1e30, 0.0, 0.0], [0.0, -1e300, 1e300], [f64::NAN; 3], [f64::INFINITY, 0.0, 0.0]]);
        assert_close(estimate(points), 0.05, 0.05);
    }

    #[test]
    fn planes_lines_and_clusters_give_a_number() {
        let plane: Vec<_> = random(5000).iter().map(|p| [p[0], p[1], 7.0]).collect();
        let line: Vec<_> = random(5000).iter().map(|p| [p[0], 1.0, 7.0]).collect();
        assert!(estimate(plane) < 0.1);
        assert!(estimate(line) < 0.1);
        let mut clustered = random(20_000);
        for point in &mut clustered[..15_000] {
            *point = point.map(|x| x * 1e-6);
        }
        assert_close(estimate(clustered), 1e-6 * (15_000f64).powf(-1.0 / 3.0), 0.2);
    }

    #[test]
    fn too_few_distinct_particles_give_none() {
        let mut points = random(32);
        points.extend(std::iter::repeat_n(points[0], 10_000));
        assert_eq!(estimate_spacing(&Particles::Double(points.clone())), None);
        points.push([2.0; 3]);
        assert!(estimate_spacing(&Particles::Double(points)).is_some());
        assert_eq!(estimate_spacing(&Particles::Single(Vec::new())), None);
    }

    #[test]
    fn distances_are_those_of_a_plain_search() {
        let points: Vec<DVec3> = random(500).into_iter().map(DVec3::from).collect();
        let mut sorted = points.clone();
        let tree = Node::build(&mut sorted);
        for &from in points.iter().step_by(17) {
            let mut distances: Vec<f64> = points.iter().map(|point| point.distance_squared(from)).collect();
            distances.sort_unstable_by(f64::total_cmp);
            assert_eq!(tree.neighbor_distance_squared(from), distances[NEIGHBOR]);
        }
    }
}
