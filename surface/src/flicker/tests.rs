//! Tests with surfaces whose flicker is known.

use super::*;
use crate::particles::OwnedPositions;

/// The particle spacing of all tests.
const SPACING: f64 = 0.1;

const SAMPLES: usize = 1000;

/// A sphere of latitudes and longitudes; its largest chord error is `chord_error(rings)` of the radius.
fn sphere(radius: f64, center: DVec3, rings: u32) -> MeshDistance {
    let columns = 2 * rings;
    let mut positions = Vec::new();
    for ring in 0..=rings {
        let (height, across) = (std::f64::consts::PI * f64::from(ring) / f64::from(rings)).sin_cos();
        for column in 0..columns {
            let (sin, cos) = (std::f64::consts::TAU * f64::from(column) / f64::from(columns)).sin_cos();
            positions.push((center + radius * DVec3::new(height * cos, height * sin, across)).to_array());
        }
    }
    let at = |ring: u32, column: u32| ring * columns + column % columns;
    let quads = (0..rings).flat_map(|ring| (0..columns).map(move |column| (ring, column)));
    let triangles = quads.flat_map(|(ring, column)| {
        let [a, b, c, d] =
            [at(ring, column), at(ring + 1, column), at(ring + 1, column + 1), at(ring, column + 1)];
        [[a, b, c], [a, c, d]]
    });
    MeshDistance::new(&positions, &triangles.collect::<Vec<_>>())
}

/// Upper limit of the depth of such a sphere's quads below the exact sphere, in radii: slightly more than the
/// sagitta of half a diagonal.
fn chord_error(rings: u32) -> f64 {
    (std::f64::consts::PI / f64::from(rings)).powi(2) / 4.0
}

/// A ball of particles on a lattice.
fn ball(radius: f64) -> Vec<DVec3> {
    let reach = (radius / SPACING).ceil() as i32;
    let along = || -reach..=reach;
    let all = along().flat_map(|x| along().flat_map(move |y| along().map(move |z| [x, y, z])));
    all.map(|at| DVec3::from(at.map(f64::from)) * SPACING).filter(|at| at.length() <= radius).collect()
}

/// Particles at `position(rest, t)`, with ids or velocities.
fn particles(
    rest: &[DVec3],
    position: impl Fn(DVec3) -> DVec3,
    velocity: impl Fn(DVec3) -> DVec3,
) -> MovingParticles {
    MovingParticles {
        positions: OwnedPositions::F64(rest.iter().map(|&at| position(at).to_array()).collect()),
        ids: Some((0..rest.len() as i64).map(|index| 7 * index + 3).collect()),
        velocities: Some(rest.iter().map(|&at| velocity(at).as_vec3().to_array()).collect()),
    }
}

/// The flicker of a ball with these centres and radii at three times, `seconds` apart. The particles have the
/// velocities of the centre.
fn of_ball(
    centers: [DVec3; 3],
    velocities: [DVec3; 3],
    (radii, rings): ([f64; 3], u32),
    carrier: Carrier,
) -> FrameFlicker {
    let rest = ball(1.0);
    let frames: Vec<FlickerFrame> = (0..3)
        .map(|t| {
            let particles = particles(&rest, |at| at + centers[t], |_| velocities[t]);
            FlickerFrame::new(particles, sphere(radii[t], centers[t], rings), SPACING)
        })
        .collect();
    flicker([&frames[0], &frames[1], &frames[2]], carrier, SPACING, SAMPLES)
}

fn summary(found: &FrameFlicker) -> Distribution {
    Distribution::of(found.points.iter().map(|point| point.value))
}

const SECONDS: f64 = 0.25;

const BOTH: [Carrier; 2] = [Carrier::Ids, Carrier::Velocities { seconds: SECONDS }];

#[test]
fn still_and_uniformly_moving_balls_do_not_flicker() {
    for step in [DVec3::ZERO, DVec3::new(0.75, -0.5, 0.125)] {
        for carrier in BOTH {
            let found = of_ball([-step, DVec3::ZERO, step], [step / SECONDS; 3], ([1.05; 3], 24), carrier);
            assert_eq!((found.points.len(), found.untracked_count, found.clamped_count), (SAMPLES, 0, 0));
            assert!(summary(&found).max < 1e-6, "{:?}", summary(&found));
        }
    }
}

#[test]
fn falling_ball_does_not_flicker() {
    // x = g t²/2 at t = 1/4, 1/2, 3/4, where g dt² is four spacings. Points that move only by the velocity
    // would be two spacings off.
    let g = DVec3::new(0.0, -6.4, 0.0);
    let times = [0.25, 0.5, 0.75];
    for carrier in BOTH {
        let found = of_ball(times.map(|t| g * (0.5 * t * t)), times.map(|t| g * t), ([1.05; 3], 24), carrier);
        assert_eq!(found.points.len(), SAMPLES);
        assert!(summary(&found).max < 1e-6, "{:?}", summary(&found));
    }
}

#[test]
fn different_triangulations_flicker_by_their_chord_error() {
    let rest = ball(1.0);
    let frame = |rings| {
        FlickerFrame::new(
            particles(&rest, |at| at, |_| DVec3::ZERO),
            sphere(1.05, DVec3::ZERO, rings),
            SPACING,
        )
    };
    let frames = [frame(37), frame(40), frame(37)];
    let found = summary(&flicker([&frames[0], &frames[1], &frames[2]], Carrier::Ids, SPACING, SAMPLES));
    let bound = 2.0 * 1.05 * chord_error(37) / SPACING;
    assert!(0.01 * bound < found.rms && found.max < bound, "{found:?}, {bound}");
}

#[test]
fn alternating_radius_scores_four_amplitudes() {
    let amplitude = 0.02;
    for sign in [1.0, -1.0] {
        let radii = [-sign, sign, -sign].map(|sign| 1.05 + sign * amplitude);
        for carrier in BOTH {
            let found = of_ball([DVec3::ZERO; 3], [DVec3::ZERO; 3], (radii, 48), carrier);
            let expected = sign * 4.0 * amplitude / SPACING;
            let tolerance = 4.0 * 1.07 * chord_error(48) / SPACING;
            assert!(
                found.points.iter().all(|point| (point.value - expected).abs() < tolerance),
                "{:?} instead of {expected} within {tolerance}",
                summary(&found)
            );
        }
    }
}

#[test]
fn even_growth_does_not_flicker_but_accelerated_growth_does() {
    // The radius grows by 0.05 per frame, half a spacing, and the lattice of particles is scaled with it.
    let rest = ball(1.0);
    let found = |scales: [f64; 3]| {
        let frames = [0, 1, 2].map(|t| {
            let particles = particles(&rest, |at| at * scales[t], |at| at);
            FlickerFrame::new(particles, sphere(1.1 * scales[t], DVec3::ZERO, 48), SPACING)
        });
        summary(&flicker([&frames[0], &frames[1], &frames[2]], Carrier::Ids, SPACING, SAMPLES))
    };
    let even = found([0.95, 1.0, 1.05]);
    assert!(even.rms < 0.01, "{even:?}");
    // Points outside the outermost particles move with the velocity of these particles. So a tenth of the
    // acceleration, or less, remains as flicker.
    let uneven = found([0.98, 1.0, 1.06]);
    assert!(uneven.rms < 0.1 * 0.04 * 1.1 / SPACING + 0.01, "{uneven:?}");
}

#[test]
fn vanished_surface_counts_as_the_maximum_distance() {
    let rest = ball(1.0);
    let frame = |surface| FlickerFrame::new(particles(&rest, |at| at, |_| DVec3::ZERO), surface, SPACING);
    let (ball, none, far) = (
        frame(sphere(1.05, DVec3::ZERO, 24)),
        frame(MeshDistance::new(&[], &[])),
        frame(sphere(3.0, DVec3::ZERO, 24)),
    );
    for (frames, expected) in
        [([&ball, &ball, &none], REACH), ([&none, &ball, &none], 2.0 * REACH), ([&far, &ball, &ball], -REACH)]
    {
        let found = flicker(frames, Carrier::Ids, SPACING, SAMPLES);
        assert_eq!((found.clamped_count, found.points.len()), (SAMPLES, SAMPLES));
        assert!(found.points.iter().all(|point| (point.value - expected).abs() < 1e-9), "{expected}");
    }
    assert_eq!(flicker([&ball, &none, &ball], Carrier::Ids, SPACING, SAMPLES), FrameFlicker::default());
}

#[test]
fn carried_points_have_their_distance_from_the_later_surface() {
    // A ball that moves and grows, and carries points only where it has particles.
    let step = DVec3::new(0.75, -0.5, 0.125);
    let rest: Vec<DVec3> = ball(1.0).into_iter().filter(|at| at.x <= 0.0).collect();
    let [from, to] = [(0.0, 1.05), (1.0, 1.11)].map(|(time, radius)| {
        let particles = particles(&rest, |at| at + time * step, |_| step / SECONDS);
        FlickerFrame::new(particles, sphere(radius, time * step, 48), SPACING)
    });
    let nowhere =
        FlickerFrame::new(particles(&rest, |at| at, |_| DVec3::ZERO), MeshDistance::new(&[], &[]), SPACING);
    for carrier in BOTH {
        let found = carried_distances(&from, &to, carrier, SPACING, SAMPLES);
        let tracked: Vec<f64> = found.iter().copied().flatten().collect();
        assert!((SAMPLES / 2..SAMPLES).contains(&tracked.len()) && found.len() == SAMPLES);
        let tolerance = 1.11 * chord_error(48) / SPACING;
        assert!(tracked.iter().all(|distance| (distance + 0.6).abs() < tolerance), "{tracked:?}");
        let found = carried_distances(&nowhere, &to, carrier, SPACING, SAMPLES);
        assert_eq!(found, []);
    }
    let found = carried_distances(&from, &nowhere, Carrier::Ids, SPACING, SAMPLES);
    assert!(found.iter().flatten().all(|&distance| distance == REACH));
}

#[test]
fn points_without_particles_are_counted_and_left_out() {
    // Half of the sphere is at a distance of 1 from all particles.
    let rest: Vec<DVec3> = ball(1.0).into_iter().filter(|at| at.x <= 0.0).collect();
    let frame = |ids: Option<Vec<i64>>| {
        let mut particles = particles(&rest, |at| at, |_| DVec3::ZERO);
        particles.ids = ids.or(particles.ids);
        FlickerFrame::new(particles, sphere(1.05, DVec3::ZERO, 24), SPACING)
    };
    let [one, other] = [frame(None), frame(None)];
    let found = flicker([&one, &other, &one], Carrier::Ids, SPACING, SAMPLES);
    assert_eq!(found.points.len() + found.untracked_count, SAMPLES);
    assert!((0.3..0.5).contains(&(found.untracked_count as f64 / SAMPLES as f64)), "{found:?}");
    assert!(found.points.iter().all(|point| point.position.x < 0.35 && point.value.abs() < 1e-9));
    // All particles of a frame share an id; then a frame has ids that the other frames lack.
    for ids in [vec![-1; rest.len()], (0..rest.len() as i64).map(|index| -1 - index).collect()] {
        let strange = frame(Some(ids));
        for frames in [[&strange, &one, &one], [&one, &strange, &one], [&one, &one, &strange]] {
            let found = flicker(frames, Carrier::Ids, SPACING, SAMPLES);
            assert_eq!((found.points.len(), found.untracked_count), (0, SAMPLES));
        }
    }
    assert!(one.has(Carrier::Ids) && !frame(Some(vec![-1; rest.len()])).has(Carrier::Ids));
    let nothing = MovingParticles { positions: OwnedPositions::F64(Vec::new()), ids: None, velocities: None };
    let nothing = FlickerFrame::new(nothing, sphere(1.05, DVec3::ZERO, 24), SPACING);
    assert!(BOTH.iter().all(|&carrier| nothing.has(carrier)) && !nothing.has_particles());
    assert_eq!(flicker([&one, &nothing, &one], Carrier::Ids, SPACING, SAMPLES).untracked_count, SAMPLES);
}

#[test]
fn thread_count_does_not_change_the_result() {
    let found = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("threads");
        pool.install(|| of_ball([DVec3::ZERO; 3], [DVec3::X; 3], ([1.05, 1.07, 1.04], 24), BOTH[1]))
    };
    assert_eq!(found(1), found(3));
}

#[test]
fn samples_of_one_triangle_spread_over_it() {
    let triangle = [DVec3::ZERO, DVec3::X, DVec3::Y];
    let points = samples(&[triangle], 400);
    // A grid of 100 squares divides the triangle's bounding box: 45 squares are inside the triangle, and its
    // edge halves 10 squares.
    let squares: std::collections::HashSet<[i32; 2]> =
        points.iter().map(|(point, _)| [(10.0 * point.x) as i32, (10.0 * point.y) as i32]).collect();
    assert!(squares.len() >= 50, "{}", squares.len());
}

#[test]
fn samples_are_even_by_area() {
    let surface = sphere(1.0, DVec3::ZERO, 24);
    let points = samples(surface.triangles(), 10_000);
    for axis in 0..3 {
        for sign in [1.0, -1.0] {
            // A cap with a quarter of the area.
            let count = points.iter().filter(|(at, _)| sign * at[axis] > 0.5).count();
            assert!((2400..2600).contains(&count), "{count} of 10000");
        }
    }
    assert!(points.iter().all(|(at, normal)| at.dot(*normal) > 0.9));
    assert_eq!(samples(&[], 10), []);
}

#[test]
fn summary_matches_the_sorted_numbers() {
    let found = Distribution::of((1..=1000).map(|n| f64::from(if n % 2 == 0 { n } else { -n })));
    let square = 1001.0 * 2001.0 / 6.0;
    assert_eq!((found.count, found.median, found.percentile_99, found.max), (1000, 500.0, 990.0, 1000.0));
    assert!((found.rms - f64::sqrt(square)).abs() < 1e-9);
    assert_eq!(Distribution::of([]), Distribution::default());
}

/// A mesh of several.
fn joined(meshes: &[&MeshDistance]) -> MeshDistance {
    let corners: Vec<[f64; 3]> =
        meshes.iter().flat_map(|mesh| mesh.triangles().iter().flatten()).map(DVec3::to_array).collect();
    let triangles: Vec<[u32; 3]> =
        (0..corners.len() as u32 / 3).map(|index| [3 * index, 3 * index + 1, 3 * index + 2]).collect();
    MeshDistance::new(&corners, &triangles)
}

#[test]
fn pieces_without_their_particles_are_ghosts() {
    let rest: Vec<DVec3> = ball(1.0).into_iter().chain([DVec3::new(2.0, 0.0, 0.0)]).collect();
    let still = |surface| FlickerFrame::new(particles(&rest, |at| at, |_| DVec3::ZERO), surface, SPACING);
    let ball_at = |radius: f64, x: f64| sphere(radius, DVec3::new(x, 0.0, 0.0), 24);
    let exact = |radius: f64| 4.0 / 3.0 * std::f64::consts::PI * (radius / SPACING).powi(3);
    let (body, drop) = (ball_at(1.05, 0.0), ball_at(0.063, 2.0));
    let found = enclosed(&still(joined(&[&body, &drop])), SPACING);
    assert_eq!((found.piece_count, found.ghost_count), (2, 0));
    let expected = exact(1.05) + exact(0.063);
    assert!((found.volume / expected - 1.0).abs() < 0.02, "{found:?}, {expected}");
    // One without its particle, one that is too small for it, and a cavity, which is not a piece.
    let empty = enclosed(&still(joined(&[&body, &ball_at(0.063, -2.0)])), SPACING);
    assert_eq!((empty.piece_count, empty.ghost_count), (2, 1));
    let small = enclosed(&still(joined(&[&body, &ball_at(0.045, 2.0)])), SPACING);
    assert_eq!((small.piece_count, small.ghost_count), (2, 1));
    let inward: Vec<[f64; 3]> = ball_at(0.5, 0.0)
        .triangles()
        .iter()
        .flat_map(|[a, b, c]| [a, c, b])
        .map(|at| at.to_array())
        .collect();
    let triangles: Vec<[u32; 3]> =
        (0..inward.len() as u32 / 3).map(|index| [3 * index, 3 * index + 1, 3 * index + 2]).collect();
    let hollow = enclosed(&still(joined(&[&body, &MeshDistance::new(&inward, &triangles)])), SPACING);
    assert_eq!((hollow.piece_count, hollow.ghost_count), (1, 0));
    assert!((hollow.volume / (exact(1.05) - exact(0.5)) - 1.0).abs() < 0.02, "{hollow:?}");
    assert_eq!(enclosed(&still(MeshDistance::new(&[], &[])), SPACING), Enclosed::default());
}

#[test]
fn lag_is_measured_along_the_motion() {
    let rest = ball(1.0);
    let frame = |x: f64, shift: f64| {
        let at = DVec3::new(x, 0.0, 0.0);
        let particles = particles(&rest, |rest| rest + at, |_| DVec3::X * 0.5 / SECONDS);
        FlickerFrame::new(particles, sphere(1.05, at + DVec3::X * shift, 24), SPACING)
    };
    let own = sphere(1.05, DVec3::ZERO, 24);
    for carrier in BOTH {
        // The surface is 0.3 spacings behind; the mean over the normals of a sphere is two thirds of that.
        for behind in [0.03, 0.0, -0.03] {
            let found = lag(&frame(0.0, -behind), &frame(0.5, 0.0), &own, carrier, SPACING, SAMPLES);
            let expected = 2.0 / 3.0 * behind / SPACING;
            assert!(found.is_some_and(|found| (found - expected).abs() < 0.01), "{found:?}, {expected}");
        }
        let still = lag(&frame(0.0, 0.0), &frame(0.0, 0.0), &own, Carrier::Ids, SPACING, SAMPLES);
        assert_eq!(still, None);
    }
}
