use super::mix;
use super::*;
use crate::particles::OwnedPositions;

fn lattice(edge_count: usize, spacing: f64) -> Vec<[f64; 3]> {
    let along = |index: usize| index as f64 * spacing;
    (0..edge_count.pow(3))
        .map(|i| [along(i % edge_count), along(i / edge_count % edge_count), along(i / edge_count.pow(2))])
        .collect()
}

/// Points with a uniform distribution in the unit cube, from the hash function: the same on every machine,
/// without a dependency.
fn random(count: u64) -> Vec<[f64; 3]> {
    let unit = |seed: u64| (mix(seed) >> 11) as f64 / (1u64 << 53) as f64;
    (0..count).map(|i| [unit(3 * i), unit(3 * i + 1), unit(3 * i + 2)]).collect()
}

fn measured(points: Vec<[f64; 3]>) -> SpacingEstimate {
    estimate_spacing(OwnedPositions::F64(points)).expect("enough particles")
}

fn estimate(points: Vec<[f64; 3]>) -> f64 {
    measured(points).spacing
}

fn assert_close(found: f64, expected: f64, tolerance: f64) {
    assert!((found / expected - 1.0).abs() < tolerance, "{found} where {expected} was expected");
}

#[test]
fn lattice_gives_its_constant() {
    assert_close(estimate(lattice(30, 0.05)), 0.05, 1e-12);
    assert_close(estimate(lattice(30, 3e7)), 3e7, 1e-12);
    assert_close(estimate(lattice(2, 0.1)), 0.1, 1e-12);
}

#[test]
fn random_particles_give_the_cube_root_of_their_volume() {
    assert_close(estimate(random(30_000)), (30_000f64).powf(-1.0 / 3.0), 0.03);
}

/// The distance between the turns of a helix does not affect the estimate.
#[test]
fn thread_gives_the_distance_along_it() {
    for (radius, rise_per_radian) in [(6.0, 1.0), (3.0, 0.7), (20.0, 2.0)] {
        let step = 1.0 / f64::hypot(radius, rise_per_radian);
        let point = |index: u32| {
            let angle = step * f64::from(index);
            [radius * angle.cos(), radius * angle.sin(), rise_per_radian * angle]
        };
        assert_close(estimate((0..200).map(point).collect()), 1.0, 0.05);
    }
}

#[test]
fn result_does_not_depend_on_order() {
    let points = random(5000);
    let expected = measured(points.clone());
    let mut reordered: Vec<_> = points.iter().rev().copied().collect();
    reordered.rotate_left(1234);
    assert_eq!(measured(reordered), expected);
    // In a lattice many neighbours are equally far, and not all of them are used.
    let mut points = lattice(9, 0.1);
    let expected = measured(points.clone());
    points.reverse();
    assert_eq!(measured(points), expected);
}

#[test]
fn repeated_positions_count_once() {
    let points = random(5000);
    let mut repeated = points.clone();
    repeated.extend_from_slice(&points[..777]);
    repeated.extend(std::iter::repeat_n(points[5], 30_000));
    // The median of all positions selects the sample.
    assert_close(estimate(repeated), estimate(points), 0.02);
}

#[test]
fn powers_of_two_scale_exactly() {
    let points = random(5000);
    let scaled = |factor: f64| points.iter().map(|p| p.map(|x| x * factor)).collect::<Vec<_>>();
    let expected = measured(points.clone());
    for exponent in [-40, -3, 1, 60] {
        let factor = 2f64.powi(exponent);
        let scaled = measured(scaled(factor));
        assert_eq!(scaled, SpacingEstimate { spacing: expected.spacing * factor, ..expected });
    }
}

#[test]
fn whole_steps_of_a_dyadic_lattice_change_nothing() {
    let points = lattice(20, 0.25);
    let moved = points.iter().map(|p| [p[0] + 4096.0, p[1] - 77.25, p[2] + 0.5]).collect();
    assert_eq!(estimate(points), estimate(moved));
}

#[test]
fn precision_is_kept_far_from_the_origin() {
    let moved = lattice(20, 0.05).iter().map(|p| p.map(|x| x + 1e9)).collect();
    assert_close(estimate(moved), 0.05, 1e-4);
}

#[test]
fn outliers_and_non_finite_positions_are_ignored() {
    let mut points = lattice(20, 0.05);
    points.extend([[1e30, 0.0, 0.0], [0.0, -1e300, 1e300], [f64::NAN; 3], [f64::INFINITY, 0.0, 0.0]]);
    let found = measured(points);
    assert_close(found.spacing, 0.05, 1e-9);
    // The smallest case.
    let mut points = lattice(2, 0.05);
    points.extend([[1e30, 0.0, 0.0], [0.0, -1e300, 1e300]]);
    assert_close(estimate(points), 0.05, 1e-9);
}

#[test]
fn cluster_with_most_particles_determines_the_spacing() {
    let mut clustered = random(20_000);
    for point in &mut clustered[..15_000] {
        *point = point.map(|x| x * 1e-6);
    }
    assert_close(estimate(clustered), 1e-6 * (15_000f64).powf(-1.0 / 3.0), 0.05);
}

#[test]
fn fewer_than_two_distinct_particles_give_no_estimate() {
    let mut points = vec![[0.5; 3]; 1000];
    assert_eq!(estimate_spacing(OwnedPositions::F64(points.clone())), None);
    points.push([0.5, 0.5, 1.0]);
    assert_eq!(estimate(points), 0.5);
    assert_eq!(estimate_spacing(OwnedPositions::F32(Vec::new())), None);
    assert_eq!(estimate_spacing(OwnedPositions::F32(vec![[f32::NAN; 3], [0.0; 3]])), None);
}

#[test]
fn overflowing_distances_give_no_invalid_estimate() {
    for scale in [1e-320, 1e-200, 1e-160, 1e153, 1e160, 1e300] {
        let points: Vec<_> = lattice(3, 1.0).iter().map(|p| p.map(|x| x * scale)).collect();
        if let Some(found) = estimate_spacing(OwnedPositions::F64(points)) {
            assert_close(found.spacing, scale, 1e-3);
        }
    }
}

#[test]
fn confidence_grows_with_the_number_of_agreeing_particles() {
    let confidence = |points| measured(points).confidence;
    let [two, ten, many] =
        [2, 10, 1000].map(|count| confidence((0..count).map(|x| [f64::from(x); 3]).collect()));
    assert!(two < CONFIDENCE_MIN && CONFIDENCE_MIN < ten && ten < 0.9 && 0.9 < many, "{two} {ten} {many}");
    let uneven: Vec<_> = random(2000).into_iter().map(|[x, y, z]| [x.powi(9), y, z]).collect();
    let random = confidence(random(2000));
    assert!(confidence(uneven) < random && random < confidence(lattice(12, 0.1)));
}

/// Moves each point by up to this much along each axis.
fn jittered(points: Vec<[f64; 3]>, by: f64) -> Vec<[f64; 3]> {
    let moves = random(points.len() as u64);
    let moved = |(point, by_axis): ([f64; 3], [f64; 3])| {
        std::array::from_fn(|axis| point[axis] + by * (2.0 * by_axis[axis] - 1.0))
    };
    points.into_iter().zip(moves).map(moved).collect()
}

#[test]
fn irregularity_grows_from_lattices_to_random_particles() {
    let irregularity = |points| measured(points).irregularity.expect("enough particles");
    let jitters = [0.0, 0.1, 0.2, 0.3, 0.4, 0.5];
    let found = jitters.map(|by| irregularity(jittered(lattice(12, 1.0), by)));
    assert!(found[..3] == [0.0; 3] && found.is_sorted() && found[2] < found[3], "{found:?}");
    // The distance to the nearest of random particles of density 1 is below r with probability
    // 1 - exp(-4/3 π r³).
    let of_random = irregularity(random(30_000));
    let expected = 1.0 - (-std::f64::consts::PI / 6.0).exp();
    assert!((of_random - expected).abs() < 0.05 && found[5] < of_random, "{found:?} {of_random}");
    // A compressed or sheared lattice is as even; so is a sheet.
    for map in [|[x, y, z]: [f64; 3]| [x, y, 0.6 * z], |[x, y, z]: [f64; 3]| [x + 0.3 * y, y, z]] {
        assert_eq!(irregularity(lattice(12, 1.0).into_iter().map(map).collect()), 0.0);
    }
    let sheet = (0..2000).map(|i| [f64::from(i % 40), f64::from(i / 40), 0.0]).collect();
    assert_eq!(irregularity(sheet), 0.0);
    assert!(found[3] < IRREGULAR && IRREGULAR < found[5], "{found:?}");
}

#[test]
fn irregularity_of_few_surrounded_particles_is_unknown() {
    let irregularity = |points| measured(points).irregularity;
    assert_eq!(irregularity(lattice(5, 1.0)), None);
    assert_eq!(irregularity((0..1000).map(|x| [f64::from(x), 0.0, 0.0]).collect()), None);
    // Particles that are not surrounded do not count: nor do pairs of them, such as drops.
    let mut with_spray = jittered(lattice(12, 1.0), 0.4);
    let expected = irregularity(with_spray.clone()).expect("enough particles");
    with_spray.extend((0..100).flat_map(|i| [0.0, 0.1].map(|x| [50.0 + 9.0 * f64::from(i), 70.0 + x, 0.0])));
    let found = irregularity(with_spray).expect("enough particles");
    assert!((found / expected - 1.0).abs() < 0.2, "{found} {expected}");
}

#[test]
fn irregularity_of_a_sequence_is_the_median_of_its_frames() {
    let combined = |of: &[Option<f64>]| {
        let frame = |&irregularity| SpacingEstimate { spacing: 1.0, confidence: 1.0, irregularity };
        combine_estimates(&of.iter().map(frame).collect::<Vec<_>>()).expect("frames").irregularity
    };
    assert_eq!(combined(&[Some(0.3), Some(0.0), Some(0.2)]), Some(0.2));
    assert_eq!(combined(&[None, Some(0.2), None]), Some(0.2));
    assert_eq!(combined(&[None, None]), None);
}

/// Estimates with these spacings and confidences.
fn frames(of: &[(f64, f64)]) -> Vec<SpacingEstimate> {
    of.iter()
        .map(|&(spacing, confidence)| SpacingEstimate { spacing, confidence, irregularity: None })
        .collect()
}

#[test]
fn sequence_estimate_is_the_confidence_weighted_median() {
    let spacing = |of: &[(f64, f64)]| combine_estimates(&frames(of)).expect("frames").spacing;
    assert_eq!(spacing(&[(0.05, 0.9)]), 0.05);
    assert_eq!(spacing(&[(0.05, 0.5), (0.06, 0.5)]), 0.055);
    assert_eq!(spacing(&[(0.05, 0.9), (0.2, 0.3)]), 0.05);
    assert_eq!(spacing(&[(0.2, 0.3), (0.05, 0.9), (0.052, 0.95)]), 0.052);
    assert_eq!(spacing(&[(0.2, 0.0), (0.05, 0.0)]), 0.125);
    assert_eq!(combine_estimates(&[]), None);
}

#[test]
fn sequence_estimate_does_not_depend_on_frame_order() {
    let all = frames(&[(0.05, 0.9), (0.051, 0.7), (0.049, 0.8), (0.051, 0.6)]);
    let expected = combine_estimates(&all);
    for rotation in 0..4 {
        let mut rotated = all.clone();
        rotated.rotate_left(rotation);
        assert_eq!(combine_estimates(&rotated), expected);
        rotated.reverse();
        assert_eq!(combine_estimates(&rotated), expected);
    }
}

#[test]
fn frames_more_than_a_tenth_apart_disagree() {
    let combined = |of: &[(f64, f64)]| combine_estimates(&frames(of)).expect("frames");
    assert!(!combined(&[(0.05, 1.0)]).frames_disagree());
    assert!(!combined(&[(0.05, 1.0), (0.0549, 1.0)]).frames_disagree());
    let apart = combined(&[(0.05, 1.0), (0.05, 1.0), (0.08, 1.0)]);
    assert!(apart.frames_disagree());
    assert_close(apart.spread, 0.6, 1e-12);
    assert_close(apart.confidence, 1.0 / 1.6, 1e-12);
}

#[test]
fn lengths_are_rounded_to_two_digits() {
    for (length, expected) in [(0.0498, 0.05), (0.0172, 0.017), (1.0, 1.0), (123.4, 120.0), (9.96e-30, 1e-29)]
    {
        assert_eq!(rounded(length), expected);
    }
    assert_eq!(rounded(f64::INFINITY), f64::INFINITY);
}

#[test]
fn neighbours_match_brute_force() {
    let points: Vec<DVec3> = random(500).into_iter().chain(lattice(6, 0.2)).map(DVec3::from).collect();
    let mut sorted = points.clone();
    let tree = KdNode::build(&mut sorted);
    for &from in points.iter().step_by(17) {
        let mut others: Vec<DVec3> = points.iter().filter(|&&point| point != from).copied().collect();
        let order = |a: &DVec3, b: &DVec3| {
            let distance = |point: &DVec3| from.distance_squared(*point);
            let by_axis = |axis: usize| a[axis].total_cmp(&b[axis]);
            distance(a).total_cmp(&distance(b)).then(by_axis(0)).then(by_axis(1)).then(by_axis(2))
        };
        others.sort_unstable_by(order);
        let expected: Vec<DVec3> = others[..40].iter().map(|&point| point - from).collect();
        assert_eq!(tree.neighbors(from, 40), expected);
    }
}
