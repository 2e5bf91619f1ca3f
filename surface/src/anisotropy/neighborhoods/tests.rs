//! Tests with known neighbourhoods, brute force, and invariances.

use glam::{DMat3, DQuat, DVec3};
use rayon::ThreadPoolBuilder;

use super::*;
use crate::anisotropy::longest_bound;
use crate::particles::{BODY_SCALE, LONE_SCALE};

/// The shape and position settings of a test frame.
#[derive(Clone, Copy)]
struct Config {
    radius_world: f64,
    max_stretch: f32,
    position_smoothing: f64,
    floor: f32,
}

/// Spacing 1, and a floor too low to matter.
const CONFIG: Config = Config { radius_world: 2.6, max_stretch: 4.0, position_smoothing: 0.0, floor: 1e-3 };

/// The results for all particles of a frame. Particles outside the grid keep their position and are balls.
#[derive(Debug, PartialEq)]
struct Whole {
    positions: Vec<DVec3>,
    shapes: Vec<Ellipsoid>,
    raised_count: usize,
    ball_count: usize,
}

fn from_neighbors(particles: &OwnedPositions, scales: Option<&[f32]>, config: &Config) -> Whole {
    shaped(particles, scales, config, SimdLevel::current())
}

fn shaped(particles: &OwnedPositions, scales: Option<&[f32]>, config: &Config, level: SimdLevel) -> Whole {
    let &Config { radius_world, max_stretch, position_smoothing, floor } = config;
    let stretch = Stretch { max_stretch, floor, kernels: None };
    // So small that scales do not change the company.
    let own_spacing = 0.1;
    let config = NeighborConfig { radius_world, weight_scale: 1.0, own_spacing, stretch: Some(stretch) };
    let found = neighbor_shapes(particles, |_| true, scales, &config, level);
    // The means of the positions are the same if no shapes are computed.
    let means =
        neighbor_shapes(particles, |_| true, scales, &NeighborConfig { stretch: None, ..config }, level);
    assert_eq!((&means.means, &means.indices), (&found.means, &found.indices));
    let ball = |index| Ellipsoid::ball(scale_of(scales, index).max(floor));
    let mut whole = Whole {
        positions: (0..particles.len()).map(|index| particles.position(index)).collect(),
        shapes: (0..particles.len()).map(ball).collect(),
        raised_count: found.raised_count,
        ball_count: found.ball_count,
    };
    for (slot, &index) in found.indices.iter().enumerate() {
        let mean = Vec3::from(found.means[slot]).as_dvec3();
        whole.positions[index as usize] += mean * position_smoothing * radius_world;
        whole.shapes[index as usize] = found.shapes[slot];
    }
    whole
}

struct Random(u32);

impl Random {
    /// A number from −½ to ½.
    fn next(&mut self) -> f64 {
        self.0 = self.0.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        f64::from(self.0 >> 8) / f64::from(1 << 24) - 0.5
    }

    fn vector(&mut self) -> DVec3 {
        DVec3::new(self.next(), self.next(), self.next())
    }
}

/// The lattice points with spacing 1 from −`half` to `half`, each displaced by up to half of `jitter` along
/// each axis.
fn lattice(half: [i32; 3], jitter: f64) -> Vec<DVec3> {
    let mut random = Random(3);
    let mut points = Vec::new();
    for x in -half[0]..=half[0] {
        for y in -half[1]..=half[1] {
            for z in -half[2]..=half[2] {
                points.push(DVec3::new(x.into(), y.into(), z.into()) + random.vector() * jitter);
            }
        }
    }
    points
}

fn double(points: &[DVec3]) -> OwnedPositions {
    OwnedPositions::F64(points.iter().map(DVec3::to_array).collect())
}

fn shapes_of(points: &[DVec3], config: &Config) -> Vec<Ellipsoid> {
    from_neighbors(&double(points), None, config).shapes
}

/// The particles within `margin` of the origin along each axis, away from the boundary.
fn inner<'a>(
    points: &'a [DVec3],
    shapes: &'a [Ellipsoid],
    margin: f64,
) -> impl Iterator<Item = &'a Ellipsoid> {
    let is_inner = move |&(point, _): &(&DVec3, &Ellipsoid)| point.abs().max_element() < margin;
    points.iter().zip(shapes).filter(is_inner).map(|(_, shape)| shape)
}

fn matrix(shape: &Ellipsoid) -> DMat3 {
    let [xx, yy, zz, xy, xz, yz] = shape.to_unit_ball.map(f64::from);
    DMat3::from_cols_array(&[xx, xy, xz, xy, yy, yz, xz, yz, zz])
}

/// Semi-axes in ascending order, and the direction of the shortest.
fn half_axes(shape: &Ellipsoid) -> ([f64; 3], DVec3) {
    let matrix = matrix(shape);
    let greatest = |matrix: DMat3, vector: DVec3| {
        // A power of the matrix so high that almost equal eigenvalues are told apart.
        let power = (0..40).fold(matrix, |power, _| {
            let squared = power * power;
            squared * (1.0 / (squared.x_axis.x + squared.y_axis.y + squared.z_axis.z))
        });
        let vector = (power * vector).normalize();
        (vector.dot(matrix * vector), vector)
    };
    let (of_shortest, shortest) = greatest(matrix, DVec3::new(0.36, 0.48, 0.8));
    let (of_longest, _) = greatest(matrix.inverse(), DVec3::new(0.48, 0.8, -0.36));
    let middle = matrix.determinant() / of_shortest * of_longest;
    ([1.0 / of_shortest, 1.0 / middle, of_longest], shortest)
}

fn difference(one: &DMat3, other: &DMat3) -> f64 {
    (*one - *other).to_cols_array().into_iter().fold(0.0, |most, entry| f64::max(most, entry.abs()))
}

/// Weighted mean and covariance by definition, relative to the particle.
fn expected_moments(points: &[DVec3], at: DVec3, radius: f64) -> (DVec3, DMat3) {
    let weighted = |&point: &DVec3| {
        let apart = (point - at) / radius;
        (1.0 - apart.length().powi(3)).max(0.0).powi(2)
    };
    let total: f64 = points.iter().map(weighted).sum();
    let mean = points.iter().map(|point| (point - at) * weighted(point)).sum::<DVec3>() / total;
    let covariance = points.iter().fold(DMat3::ZERO, |sum, point| {
        let apart = point - at - mean;
        sum + DMat3::from_cols(apart * apart.x, apart * apart.y, apart * apart.z) * weighted(point)
    });
    (mean, covariance * (1.0 / total))
}

#[test]
fn shapes_match_the_weighted_covariance() {
    for (radius_world, around) in [(2.6, DVec3::ZERO), (3.3, DVec3::new(3e6, -2e5, 70.0))] {
        let mut points = lattice([4, 3, 2], 0.9);
        // Flat and dense, so that all particles are in full company and have the shape of their neighbourhood.
        points.iter_mut().for_each(|point| *point = *point * DVec3::new(1.0, 0.8, 0.03) + around);
        let config = Config { radius_world, max_stretch: 1e3, position_smoothing: 1.0, ..CONFIG };
        let shaped = from_neighbors(&double(&points), None, &config);
        for ((&point, shape), moved) in points.iter().zip(&shaped.shapes).zip(shaped.positions) {
            let (mean, covariance) = expected_moments(&points, point, radius_world);
            assert!((point + mean).distance(moved) < 2e-6, "{mean} from {point} to {moved:?}");
            // (T⁻¹)² is the covariance, up to a factor and the constant added to each eigenvalue.
            let spread = covariance * (1.0 / radius_world.powi(2)) + DMat3::from_diagonal(DVec3::splat(1e-4));
            let inverse = matrix(shape).inverse();
            let factor = spread.determinant().cbrt();
            let error = difference(&(inverse * inverse), &(spread * (1.0 / factor)));
            assert!(error < 1e-4, "{error} at {point}");
            assert!((matrix(shape).determinant() - 1.0).abs() < 1e-4);
        }
    }
}

#[test]
fn particles_of_a_sheet_are_flat() {
    let points = lattice([9, 9, 0], 0.2);
    let rotation = DQuat::from_euler(glam::EulerRot::XYZ, 0.3, -0.7, 1.1);
    let rotated: Vec<DVec3> = points.iter().map(|&point| rotation * point).collect();
    let shapes = shapes_of(&rotated, &CONFIG);
    let normal = rotation * DVec3::Z;
    for shape in inner(&points, &shapes, 6.0) {
        let ([shortest, middle, longest], direction) = half_axes(shape);
        assert!((longest / shortest - 4.0).abs() < 1e-3 && middle / longest > 0.85, "{shape:?}");
        let degrees = direction.dot(normal).abs().min(1.0).acos().to_degrees();
        assert!(degrees < 8.0, "{degrees}° from the normal");
    }
}

#[test]
fn particles_of_a_line_are_elongated() {
    let points: Vec<DVec3> = (-10..=10).map(|x| DVec3::new(0.6, 0.0, 0.8) * f64::from(x)).collect();
    for (index, shape) in shapes_of(&points, &CONFIG).iter().enumerate() {
        let along = glam::Vec3::new(0.6, 0.0, 0.8);
        let [on, across, aside] =
            [along, glam::Vec3::Y, glam::Vec3::new(-0.8, 0.0, 0.6)].map(|v| 1.0 / shape.apply(v).length());
        assert!((across / aside - 1.0).abs() < 1e-3, "{shape:?}");
        // Particles at an end of the filament have no company.
        let expected = if (1..20).contains(&index) { 1.2..1.7 } else { 1.0..1.2 };
        assert!(expected.contains(&(on / across)), "{} at {index}", on / across);
    }
}

#[test]
fn particles_inside_and_at_a_plane_surface_are_balls() {
    let points = lattice([9, 9, 9], 0.4);
    let shapes = shapes_of(&points, &CONFIG);
    for shape in inner(&points, &shapes, 6.0) {
        let ([shortest, _, longest], _) = half_axes(shape);
        assert!(longest / shortest < 1.3, "{shape:?}");
    }
    // In the limit of a fine lattice, the neighbourhood is half a ball with full weight: its standard deviation
    // outward is 0.56 of that along the surface, which is hardly flat enough for an ellipsoid.
    let fine: Vec<DVec3> = lattice([16, 16, 8], 0.0).iter().map(|point| point - DVec3::Z * 8.0).collect();
    let shapes = shapes_of(&fine, &Config { radius_world: 7.9, ..CONFIG });
    let middle = fine.iter().position(|&point| point == DVec3::ZERO).unwrap();
    let ([shortest, _, longest], direction) = half_axes(&shapes[middle]);
    assert!((0.95..0.999).contains(&(shortest / longest)), "{}", shortest / longest);
    assert!(direction.z.abs() > 0.999);
}

#[test]
fn rotated_particles_have_rotated_shapes() {
    let points = lattice([4, 4, 1], 0.7);
    let turn = DQuat::from_euler(glam::EulerRot::XYZ, -1.2, 0.4, 2.0);
    let rotated: Vec<DVec3> =
        points.iter().map(|&point| turn * point + DVec3::new(5.0, -70.0, 0.3)).collect();
    let rotation = DMat3::from_quat(turn);
    let pairs = shapes_of(&points, &CONFIG).into_iter().zip(shapes_of(&rotated, &CONFIG));
    for (shape, of_rotated) in pairs {
        let expected = rotation * matrix(&shape) * rotation.transpose();
        let error = difference(&matrix(&of_rotated), &expected);
        assert!(error < 1e-4, "{error}");
    }
}

#[test]
fn stretch_volume_and_length_stay_in_bounds() {
    let mut random = Random(9);
    // All kinds of clusters: clumps, sheets, filaments and mixtures.
    let points: Vec<DVec3> = (0..4000)
        .map(|index| {
            let heap = DVec3::new(f64::from(index % 50) * 9.0, 0.0, 0.0);
            let extent = DVec3::new(4.0, 4.0 * random.next(), 0.3 * f64::from(index % 7));
            heap + random.vector() * extent
        })
        .collect();
    for max_stretch in [1.0, 2.0, 4.0, 30.0] {
        let config = Config { max_stretch, ..CONFIG };
        let bound = longest_bound(max_stretch, config.floor);
        for shape in shapes_of(&points, &config) {
            let ([shortest, _, longest], _) = half_axes(&shape);
            assert!(longest / shortest < f64::from(max_stretch) * (1.0 + 1e-4), "{shape:?}");
            assert!((matrix(&shape).determinant() - 1.0).abs() < 1e-4, "{shape:?}");
            assert!((longest / f64::from(shape.longest) - 1.0).abs() < 1e-4, "{shape:?}");
            assert!(shape.longest <= bound, "{} of {bound}", shape.longest);
        }
    }
}

#[test]
fn half_axes_below_the_floor_are_raised_and_counted() {
    let points = lattice([6, 6, 0], 0.1);
    let mut scales = vec![1.0; points.len()];
    scales[0] = 9.0;
    let config = Config { floor: 0.7, ..CONFIG };
    let shaped = from_neighbors(&double(&points), Some(&scales), &config);
    // The large one has no company among small ones.
    assert_eq!((shaped.raised_count, shaped.ball_count), (points.len() - 1, 1));
    for (index, shape) in shaped.shapes.iter().enumerate() {
        let ([shortest, ..], _) = half_axes(shape);
        let is_raised = (shortest - 0.7).abs() < 1e-4;
        assert!(if index == 0 { shortest > 3.0 } else { is_raised }, "{shortest} at {index}");
    }
}

#[test]
fn shape_changes_continuously_as_neighbors_approach() {
    let pair = [DVec3::ZERO, DVec3::X * 0.01];
    let shaped = from_neighbors(&double(&pair), None, &CONFIG);
    assert_eq!((shaped.shapes, shaped.ball_count), (vec![Ellipsoid::ball(1.0); 2], 2));
    // Three particles move from beyond the radius to the particle in the middle.
    let mut before = None;
    let mut stretch = 1.0;
    for step in (0..=270).rev() {
        let along = f64::from(step) * 0.01;
        let mut points = vec![DVec3::ZERO, DVec3::X, -DVec3::X];
        points.extend([DVec3::X, DVec3::new(0.0, 0.6, 0.8), -DVec3::Y].map(|from| from * along));
        let shape = shapes_of(&points, &CONFIG)[0];
        let change = before.map_or(0.0, |before| difference(&matrix(&before), &matrix(&shape)));
        assert!(change < 0.05, "{change} at {along}");
        before = Some(shape);
        stretch = f64::max(stretch, half_axes(&shape).0[2]);
    }
    assert!(stretch > 1.4, "{stretch}");
}

#[test]
fn particles_beyond_the_radius_do_not_matter() {
    let points = lattice([6, 6, 1], 0.8);
    let config = Config { position_smoothing: 0.5, ..CONFIG };
    let alone = from_neighbors(&double(&points), None, &config);
    // Additional particles around one particle, and far away. They come first, so that every index changes.
    let mut random = Random(77);
    let center = points[points.len() / 2];
    let mut more: Vec<DVec3> = (0..300)
        .map(|_| {
            center + random.vector().normalize() * CONFIG.radius_world * (1.001 + 3.0 * random.next().abs())
        })
        .collect();
    more.push(DVec3::splat(1e7));
    let added = more.len();
    more.extend(&points);
    let with_more = from_neighbors(&double(&more), None, &config);
    let is_near =
        |point: &DVec3| more[..added].iter().any(|other| other.distance(*point) < CONFIG.radius_world);
    let untouched: Vec<usize> = (0..points.len()).filter(|&index| !is_near(&points[index])).collect();
    assert!(untouched.contains(&(points.len() / 2)));
    for index in untouched {
        assert_eq!(alone.shapes[index], with_more.shapes[added + index]);
        assert_eq!(alone.positions[index], with_more.positions[added + index]);
    }
}

#[test]
fn threads_and_levels_give_the_same_bits() {
    let mut points = lattice([9, 9, 3], 0.9);
    points.extend(vec![DVec3::splat(0.5); 700]);
    let particles = OwnedPositions::F32(points.iter().map(|point| point.as_vec3().to_array()).collect());
    let config = Config { position_smoothing: 0.3, ..CONFIG };
    let scales: Vec<f32> = (0..points.len()).map(|index| 1.0 + (index % 5) as f32).collect();
    let with = |threads: usize, level: SimdLevel| {
        let pool = ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| shaped(&particles, Some(&scales), &config, level))
    };
    let plain = with(1, SimdLevel::Baseline);
    for level in SimdLevel::ALL {
        for threads in [1, 2, 5] {
            assert!(with(threads, level) == plain, "{threads} threads, {level:?}");
        }
    }
}

#[test]
fn results_do_not_depend_on_which_particles_are_wanted() {
    let particles = double(&lattice([8, 7, 6], 0.9));
    let config = NeighborConfig {
        radius_world: 2.6,
        weight_scale: 1.0,
        own_spacing: 1.0,
        stretch: Some(Stretch { max_stretch: 4.0, floor: 1e-3, kernels: Some(KERNELS) }),
    };
    let all = super::from_neighbors(&particles, |_| true, None, &config);
    let is_wanted = |index: usize| index % 7 < 2 || index % 300 > 250;
    let some = super::from_neighbors(&particles, is_wanted, None, &config);
    let wanted = (0..all.indices.len()).filter(|&slot| is_wanted(all.indices[slot] as usize));
    let expected = wanted.map(|slot| (all.indices[slot], all.means[slot], all.shapes[slot]));
    let found = (0..some.indices.len()).map(|slot| (some.indices[slot], some.means[slot], some.shapes[slot]));
    assert!(some.indices.len() > 100);
    assert_eq!(found.collect::<Vec<_>>(), expected.collect::<Vec<_>>());
}

const KERNELS: KernelConfig = KernelConfig { per_reach: 1.3, room_least: 0.1, room_most: 1.4 };

/// The shapes of the particles at these places of a frame with a body, a thread, a sheet and a lone particle.
fn kernel_shapes(radius_world: f64) -> [Ellipsoid; 4] {
    let mut points = lattice([5, 5, 5], 0.0);
    let body = points.iter().position(|point| *point == DVec3::ZERO).expect("the middle");
    let lone = points.len();
    points.push(DVec3::splat(30.0));
    let thread = points.len() + 10;
    points.extend((0..20).map(|index| DVec3::new(f64::from(index), 50.0, 0.0)));
    let sheet = points.len() + 10 * 21 + 10;
    points.extend((0..441).map(|index| DVec3::new(f64::from(index % 21), f64::from(index / 21), -50.0)));
    let per_reach = (radius_world / 1.6) as f32;
    let kernels = Some(KernelConfig { per_reach, ..KERNELS });
    let config = NeighborConfig {
        radius_world,
        weight_scale: (2.6 / radius_world).powi(3) as f32,
        own_spacing: 1.0,
        stretch: Some(Stretch { max_stretch: 2.0, floor: 1e-3, kernels }),
    };
    let found = super::from_neighbors(&double(&points), |_| true, None, &config);
    [body, lone, thread, sheet].map(|wanted| {
        let slot = found.indices.iter().position(|&index| index as usize == wanted).expect("wanted");
        found.shapes[slot]
    })
}

/// Thin fluid gives the surface little room, and a lone particle has all the weight of its kernel.
#[test]
fn kernels_have_weight_and_room_by_their_company() {
    for radius_world in [2.6, 3.0] {
        let [body, lone, thread, sheet] = kernel_shapes(radius_world);
        assert!((1.35..=1.4).contains(&body.room), "{body:?}");
        assert_eq!((lone.room, lone.weight), (0.1, 1.0));
        let most = BODY_SCALE.min(radius_world as f32 / 1.6);
        assert!((lone.longest - LONE_SCALE).abs() < 1e-6 && (body.longest - most).abs() < 1e-3);
        assert!(thread.room == 0.1 && sheet.room < 0.2, "{thread:?}, {sheet:?}");
        let [heaviest, lightest] = [thread, body].map(|shape| shape.weight);
        assert!((0.3..0.9).contains(&heaviest) && (0.05..0.4).contains(&lightest), "{heaviest} {lightest}");
    }
}

/// The weight is one over the sum of the kernels at the particle, computed here from their definition.
#[test]
fn weights_normalize_the_sum_of_kernels() {
    let points = lattice([4, 4, 4], 0.3);
    let config = NeighborConfig {
        radius_world: 2.8,
        weight_scale: 1.0,
        own_spacing: 1.0,
        stretch: Some(Stretch { max_stretch: 1.0, floor: 1e-3, kernels: Some(KERNELS) }),
    };
    let scales: Vec<f32> = (0..points.len()).map(|index| 1.0 + 0.1 * (index % 3) as f32).collect();
    for level in SimdLevel::ALL {
        let found = neighbor_shapes(&double(&points), |_| true, Some(&scales), &config, level);
        for (slot, &index) in found.indices.iter().enumerate() {
            let shape = found.shapes[slot];
            let own_reach = 2.8 / 1.3 * f64::from(shape.longest);
            let kernel = |(other, point): (usize, &DVec3)| {
                let apart = points[index as usize].distance(*point);
                let size = f64::from(scales[other] / scales[index as usize]);
                let root = (1.0 - 0.8 * (apart / (own_reach * size)).powi(2)).max(0.0);
                if apart < 2.8 { (root.powi(4) - 0.2f64.powi(4)).max(0.0) } else { 0.0 }
            };
            let sum: f64 = points.iter().enumerate().map(kernel).sum();
            assert!((f64::from(shape.weight) * sum - 1.0).abs() < 1e-4, "{sum}, {shape:?}");
        }
    }
}

#[test]
fn corners_move_inward() {
    let points = lattice([3, 3, 3], 0.5);
    let moved = from_neighbors(&double(&points), None, &Config { position_smoothing: 1.0, ..CONFIG });
    assert!(moved.positions[0].length() < points[0].length() - 0.3);
}

#[test]
fn invalid_particles_are_balls() {
    let config = Config { position_smoothing: 1.0, ..CONFIG };
    for particles in [OwnedPositions::F32(Vec::new()), OwnedPositions::F64(Vec::new())] {
        let shaped = from_neighbors(&particles, None, &config);
        assert_eq!((shaped.shapes.len(), shaped.positions.len(), shaped.ball_count), (0, 0, 0));
    }
    let (nan, infinite) = (f64::NAN, f64::INFINITY);
    let positions = vec![[nan, 0.0, 0.0], [0.0, infinite, 0.0], [1e300, -1e300, 1e300], [4.0, 5.0, 6.0]];
    let scales = [1.0, 2.0, 1e-9, f32::NAN];
    let shaped = from_neighbors(&OwnedPositions::F64(positions.clone()), Some(&scales), &config);
    let expected = [1.0, 2.0, CONFIG.floor, CONFIG.floor].map(Ellipsoid::ball);
    // Only the last of these is inside the grid.
    assert_eq!((shaped.shapes, shaped.ball_count, shaped.raised_count), (expected.to_vec(), 1, 1));
    assert!(shaped.positions[0].is_nan());
    for (found, expected) in shaped.positions.iter().zip(&positions).skip(1) {
        assert_eq!(found.to_array(), *expected);
    }
    // All particles at one point: no direction is preferred.
    let heap = OwnedPositions::F32(vec![[0.1, 0.7, -0.3]; 20_000]);
    let shaped = from_neighbors(&heap, None, &CONFIG);
    for shape in &shaped.shapes {
        assert!((shape.longest - 1.0).abs() < 1e-3, "{shape:?}");
    }
}
