//! Compares attribute transfer with brute force and with known fields, and tests arbitrary file contents.

use std::sync::Arc;

use glam::{DVec3, IVec3, Vec3};

use super::{interpolate_to_vertices as to_vertices_of, *};
use crate::grid::{Field, LEAF_EDGE, Leaf, Topology, voxel_in_leaf};
use crate::level_set::NarrowBand;
use crate::particles::{OwnedPositions, Role};
use crate::space::Lattice;

const REACH: Support = Support {
    radius_world: 0.26,
    radius_max_world: 0.5,
    margin_world: 0.1,
    shapes: &Shapes::Uniform,
    unsmoothed: None,
};
const VOXEL: f64 = 0.05;

fn transferred_to_vertices(
    particles: &OwnedPositions,
    attributes: &[Attribute],
    mesh: &Mesh,
    support: Support,
) -> (Vec<Attribute>, TransferCounts) {
    let attributes: Vec<&Attribute> = attributes.iter().collect();
    to_vertices_of(particles, &attributes, mesh, support)
}

fn random(state: &mut u32) -> f64 {
    *state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
    f64::from(*state >> 8) / f64::from(1 << 24)
}

/// A ball of particles on a jittered lattice with a spacing of 0.1, in random order.
fn ball(center: DVec3, radius: f64) -> Vec<[f64; 3]> {
    let mut state = 11;
    let support = (radius / 0.1) as i32 + 1;
    let axis = || -support..=support;
    let cells = axis().flat_map(|x| axis().flat_map(move |y| axis().map(move |z| IVec3::new(x, y, z))));
    let mut positions = Vec::new();
    for cell in cells {
        let mut along = || (random(&mut state) - 0.5) * 0.06;
        let point = cell.as_dvec3() * 0.1 + DVec3::new(along(), along(), along());
        if point.length() < radius {
            positions.push((point + center).to_array());
        }
    }
    for index in 0..positions.len() {
        let other = (random(&mut state) * positions.len() as f64) as usize;
        positions.swap(index, other);
    }
    positions
}

/// Points around a ball of particles, at the distance of a surface.
fn mesh_around(center: DVec3, radius: f64, count: usize) -> Mesh {
    let angle = std::f64::consts::PI * (3.0 - 5f64.sqrt());
    let point = |index: usize| {
        let y = 1.0 - 2.0 * (index as f64 + 0.5) / count as f64;
        let (sin, cos) = (angle * index as f64).sin_cos();
        let across = (1.0 - y * y).sqrt();
        (DVec3::new(cos * across, y, sin * across) * (radius + 0.13)).as_vec3()
    };
    Mesh { positions: (0..count).map(point).collect(), origin: center, ..Mesh::default() }
}

fn numbers(name: &str, arity: usize, values: Vec<f32>) -> Attribute {
    let values = AttributeValues::Numbers(values);
    Attribute { name: name.to_owned(), role: Role::Other, arity, values }
}

fn integers(name: &str, values: Vec<i64>) -> Attribute {
    Attribute { name: name.to_owned(), role: Role::Id, arity: 1, values: AttributeValues::Integers(values) }
}

fn found(attribute: &Attribute) -> &[f32] {
    match &attribute.values {
        AttributeValues::Numbers(values) => values,
        _ => panic!("{} is not numeric", attribute.name),
    }
}

fn linear(point: DVec3) -> [f32; 3] {
    [2.0 * point.x - point.y + 0.5, 3.0 * point.z, point.x + point.y + point.z].map(|value| value as f32)
}

/// Two attributes: the position of the particle, and the value of a linear field there.
fn place_and_field(positions: &[[f64; 3]], center: DVec3) -> [Attribute; 2] {
    let points = || positions.iter().map(|&position| DVec3::from(position) - center);
    let point = numbers("place", 3, points().flat_map(|point| point.as_vec3().to_array()).collect());
    [point, numbers("field", 3, points().flat_map(linear).collect())]
}

/// Checks that the mean of a linear field equals the field at the weighted center of the particles. Returns
/// the distance of that center from the vertex.
fn distance_to_middle(point: Vec3, middle: &[f32], field: &[f32]) -> f32 {
    let middle = Vec3::from_slice(middle);
    for (value, expected) in field.iter().zip(linear(middle.as_dvec3())) {
        assert!((value - expected).abs() < 1e-5, "{value} for {expected} at {middle}");
    }
    (point - middle).length()
}

#[test]
fn constant_and_linear_fields_are_reproduced() {
    let center = DVec3::new(1000.0, -2.0, 3.0);
    let positions = ball(center, 1.0);
    let count = positions.len();
    let [point, field] = place_and_field(&positions, center);
    let attributes = [
        numbers("constant", 1, vec![0.1; count]),
        point,
        numbers("wide", 9, (0..count).flat_map(|_| (0..9).map(|k| 1.0 / (k as f32 + 3.0))).collect()),
        field,
    ];
    let mesh = mesh_around(center, 1.0, 3000);
    let (transferred, counts) =
        transferred_to_vertices(&OwnedPositions::F64(positions), &attributes, &mesh, REACH);
    assert_eq!(counts, TransferCounts { point_count: 3000, ..TransferCounts::default() });
    assert!(found(&transferred[0]).iter().all(|value| *value == 0.1));
    for values in found(&transferred[2]).chunks(9) {
        assert!(values.iter().enumerate().all(|(k, value)| *value == 1.0 / (k as f32 + 3.0)));
    }
    let means = found(&transferred[1]).chunks(3).zip(found(&transferred[3]).chunks(3));
    for (position, (middle, field)) in mesh.positions.iter().zip(means) {
        // The limit is three voxels, because all particles are on one side of the vertex.
        let distance = distance_to_middle(*position, middle, field);
        assert!(distance < 0.22, "{distance} at {position}");
    }
}

/// The mean and the nearest particle at a point, over all particles and in 64 bits.
fn brute_force(positions: &[[f64; 3]], values: &[f32], point: DVec3, radius: f64) -> (f64, f64, usize) {
    let (mut sum, mut total, mut nearest) = (0.0, 0.0, (f64::INFINITY, 0));
    for (index, (&position, &value)) in positions.iter().zip(values).enumerate() {
        let distance_squared = (DVec3::from(position) - point).length_squared() / (radius * radius);
        let weight = (1.0 - distance_squared).max(0.0).powi(3);
        (sum, total) = (sum + weight * f64::from(value), total + weight);
        if distance_squared < nearest.0 {
            nearest = (distance_squared, index);
        }
    }
    (sum / total, nearest.0, nearest.1)
}

#[test]
fn means_and_nearest_particles_match_brute_force() {
    let positions = ball(DVec3::ZERO, 0.7);
    let mut state = 5;
    let values: Vec<f32> = positions.iter().map(|_| random(&mut state) as f32 * 7.0 - 3.0).collect();
    let table: Arc<[String]> = ["a", "b", "c"].map(str::to_owned).into();
    let kinds: Vec<i32> = (0..positions.len() as i32).map(|index| index % 4).collect();
    let strings = AttributeValues::Strings { table: Arc::clone(&table), indices: kinds };
    let attributes = [
        integers("id", (0..positions.len() as i64).map(|index| index * 1_000_000_007).collect()),
        numbers("value", 1, values.clone()),
        Attribute { name: "kind".into(), role: Role::Other, arity: 1, values: strings },
    ];
    let mesh = mesh_around(DVec3::ZERO, 0.7, 500);
    let (transferred, _) =
        transferred_to_vertices(&OwnedPositions::F64(positions.clone()), &attributes, &mesh, REACH);
    let AttributeValues::Integers(ids) = &transferred[0].values else { panic!("no integers") };
    let AttributeValues::Strings { indices, table: same } = &transferred[2].values else {
        panic!("no strings")
    };
    assert_eq!(*same, table);
    for (vertex, position) in mesh.positions.iter().enumerate() {
        let point = position.as_dvec3();
        let (mean, least, _) = brute_force(&positions, &values, point, REACH.radius_world);
        assert!((f64::from(found(&transferred[1])[vertex]) - mean).abs() < 1e-5);
        let nearest = (ids[vertex] / 1_000_000_007) as usize;
        let distance_squared = (DVec3::from(positions[nearest]) - point).length_squared();
        assert!(distance_squared / REACH.radius_world.powi(2) < least + 1e-6);
        assert_eq!(indices[vertex], nearest as i32 % 4);
    }
}

#[test]
fn ties_go_to_the_first_particle() {
    let positions =
        vec![[5.0, 0.0, 0.0], [0.125, 0.0, 0.0], [-0.125, 0.0, 0.0], [0.0, 0.125, 0.0], [0.125, 0.0, 0.0]];
    let mesh = Mesh { positions: vec![Vec3::ZERO, Vec3::X * 0.1, Vec3::X * -0.1], ..Mesh::default() };
    let attributes = [integers("id", vec![7, 6, 5, 4, 3])];
    let (transferred, _) =
        transferred_to_vertices(&OwnedPositions::F32(positions), &attributes, &mesh, REACH);
    assert_eq!(transferred[0].values, AttributeValues::Integers(vec![6, 6, 5]));
}

#[test]
fn values_stay_within_the_particles_range() {
    let positions = ball(DVec3::ZERO, 0.5);
    let mesh = mesh_around(DVec3::ZERO, 0.5, 2000);
    for (low, high) in [(0.3, 0.3000001), (-1e-40, 1e-45), (-3.0e38, 3.4e38), (1e-30, 1e30)] {
        let values: Vec<f32> =
            (0..positions.len()).map(|index| if index % 3 == 0 { low } else { high }).collect();
        let attributes = [numbers("a", 1, values)];
        let (transferred, _) =
            transferred_to_vertices(&OwnedPositions::F64(positions.clone()), &attributes, &mesh, REACH);
        let values = found(&transferred[0]);
        assert!(values.iter().all(|value| (low..=high).contains(value)), "{low} to {high}: {values:?}");
    }
}

#[test]
fn non_finite_values_are_ignored() {
    let positions = ball(DVec3::ZERO, 0.5);
    let count = positions.len();
    let broken: Vec<f32> = (0..count)
        .map(|index| match index % 8 {
            0 => f32::NAN,
            1 => f32::INFINITY,
            _ => 2.5,
        })
        .collect();
    let left_out = broken.iter().filter(|value| !value.is_finite()).count();
    let attributes = [
        numbers("broken", 1, broken),
        numbers("sound", 2, vec![-1.25; 2 * count]),
        numbers("nothing", 1, vec![f32::NAN; count]),
    ];
    let mesh = mesh_around(DVec3::ZERO, 0.5, 300);
    let mut with_nan = positions.clone();
    with_nan[0] = [f64::NAN, 0.0, 0.0];
    for positions in [positions, with_nan] {
        let (transferred, counts) =
            transferred_to_vertices(&OwnedPositions::F64(positions), &attributes, &mesh, REACH);
        assert!(found(&transferred[0]).iter().all(|value| *value == 2.5));
        assert!(found(&transferred[1]).iter().all(|value| *value == -1.25));
        assert!(found(&transferred[2]).iter().all(|value| *value == 0.0));
        assert!(
            left_out + count - 2 <= counts.ignored_value_count
                && counts.ignored_value_count <= left_out + count
        );
    }
}

#[test]
fn isolated_points_get_the_nearest_value_and_unreached_ones_zero() {
    let positions = vec![[0.0; 3], [0.0, 0.0, 10.0], [f32::NAN; 3]];
    let points = [0.2, 0.5, -0.59, 0.61, 10.4, f32::NAN, 3e38].map(|z| Vec3::new(0.0, 0.0, z));
    let mesh = Mesh { positions: points.to_vec(), ..Mesh::default() };
    let table: Arc<[String]> = Arc::from(["x".to_owned()]);
    let strings = AttributeValues::Strings { table, indices: vec![0; 3] };
    let attributes = [
        numbers("a", 1, vec![4.0, 5.0, 6.0]),
        integers("id", vec![40, 50, 60]),
        numbers("broken", 1, vec![f32::NAN, 5.0, 6.0]),
        Attribute { name: "kind".into(), role: Role::Other, arity: 1, values: strings },
    ];
    let (transferred, counts) =
        transferred_to_vertices(&OwnedPositions::F32(positions.clone()), &attributes, &mesh, REACH);
    assert_eq!(found(&transferred[0]), [4.0, 4.0, 4.0, 0.0, 5.0, 0.0, 0.0]);
    assert_eq!(transferred[1].values, AttributeValues::Integers(vec![40, 40, 40, -1, 50, -1, -1]));
    assert_eq!(found(&transferred[2]), [0.0, 0.0, 0.0, 0.0, 5.0, 0.0, 0.0]);
    let AttributeValues::Strings { indices, .. } = &transferred[3].values else { panic!("no strings") };
    assert_eq!(*indices, [0, 0, 0, -1, 0, -1, -1]);
    assert_eq!((counts.point_count, counts.isolated_count, counts.empty_count), (7, 3, 3));
    let no_farther = Support { radius_max_world: 0.1, ..REACH };
    let (_, counts) =
        transferred_to_vertices(&OwnedPositions::F32(positions), &attributes, &mesh, no_farther);
    assert_eq!((counts.isolated_count, counts.empty_count), (0, 6));
    let (transferred, _) =
        transferred_to_vertices(&OwnedPositions::F32(Vec::new()), &[numbers("a", 1, vec![])], &mesh, REACH);
    assert_eq!(found(&transferred[0]), [0.0; 7]);
    let (transferred, counts) =
        transferred_to_vertices(&OwnedPositions::F32(Vec::new()), &[], &Mesh::default(), REACH);
    assert_eq!((transferred.len(), counts), (0, TransferCounts::default()));
}

#[test]
fn distant_particles_and_thread_count_change_no_bit() {
    let positions = ball(DVec3::ZERO, 0.8);
    let value = |position: &[f64; 3]| (position[0] * 7.0).sin() as f32;
    let mesh = mesh_around(DVec3::ZERO, 0.8, 5000);
    let run = |positions: &[[f64; 3]]| {
        let attributes = [numbers("a", 1, positions.iter().map(value).collect())];
        let (transferred, _) =
            transferred_to_vertices(&OwnedPositions::F64(positions.to_vec()), &attributes, &mesh, REACH);
        found(&transferred[0]).iter().map(|value| value.to_bits()).collect::<Vec<u32>>()
    };
    let reference = run(&positions);
    let mut more = ball(DVec3::new(1.7 + 2.0 * REACH.limit_world(0), 0.0, 0.0), 0.8);
    let far = more.clone();
    more.extend(&positions);
    more.extend(ball(DVec3::splat(-90.0), 0.4));
    assert!(far.iter().all(|position| position[0] > 0.93 + REACH.radius_world));
    assert_eq!(run(&more), reference);
    let pool = rayon::ThreadPoolBuilder::new().num_threads(5).build().expect("threads");
    assert_eq!(pool.install(|| run(&positions)), reference);
}

/// The band of a ball, and the leaves around it.
fn band(center: DVec3, radius: f64, half_width: f32) -> NarrowBand {
    band_of(&[center], radius, half_width)
}

/// The band of several balls.
fn band_of(centers: &[DVec3], radius: f64, half_width: f32) -> NarrowBand {
    let distance = |point: DVec3| {
        centers.iter().map(|center| (point - *center).length()).fold(f64::INFINITY, f64::min) - radius
    };
    let phi = |voxel: IVec3| (distance(voxel.as_dvec3() * VOXEL) / VOXEL) as f32;
    let [least, most] =
        [DVec3::min, DVec3::max].map(|of| centers.iter().copied().reduce(of).unwrap_or_default());
    let first = ((least - radius) / VOXEL).as_ivec3() - 12;
    let last = ((most + radius) / VOXEL).as_ivec3() + 12;
    let steps = |axis: usize| (first[axis] >> 3..=last[axis] >> 3).map(|leaf| leaf * LEAF_EDGE);
    let mut origins = Vec::new();
    for x in steps(0) {
        for y in steps(1) {
            for z in steps(2) {
                let origin = IVec3::new(x, y, z);
                if (0..512).any(|voxel| phi(origin + voxel_in_leaf(voxel)).abs() < half_width) {
                    origins.push(origin);
                }
            }
        }
    }
    let topology = Topology::new(origins);
    let leaf = |origin: &IVec3| Leaf {
        values: std::array::from_fn(|voxel| {
            phi(*origin + voxel_in_leaf(voxel)).clamp(-half_width, half_width)
        }),
    };
    let leaves = topology.origins().iter().map(leaf).collect();
    NarrowBand { topology: Arc::new(topology), phi: Field { leaves }, half_width }
}

/// Calls `check` with each voxel of the band that renderers use, and its values.
fn each_voxel(
    band: &NarrowBand,
    attribute: &BandAttribute,
    mut check: impl FnMut(IVec3, f32, &[f32]),
) -> usize {
    let mut count = 0;
    let mut values = vec![f32::NAN; 512 * attribute.arity];
    for (leaf, origin) in band.topology.origins().iter().enumerate() {
        attribute.fill(leaf, &mut values);
        for (voxel, values) in values.chunks(attribute.arity).enumerate() {
            let phi = band.phi.leaves[leaf].values[voxel];
            if phi.abs() < 3.0 {
                check(*origin + voxel_in_leaf(voxel), phi, values);
                count += 1;
            }
        }
    }
    count
}

#[test]
fn band_voxels_have_the_surface_values() {
    let center = DVec3::new(0.03, -7.01, 0.4);
    let positions = ball(center, 1.0);
    let [point, field] = place_and_field(&positions, center);
    let attributes = [point, field, numbers("one", 1, vec![0.1; positions.len()])];
    let lattice = Lattice { voxel_size: VOXEL };
    let particles = OwnedPositions::F64(positions);
    // The wide band extends beyond the visible voxels. The narrow band ends with their leaves, and nodes
    // beyond it cannot be moved to the surface.
    for half_width in [6.0, 3.0] {
        let band = band(center, 1.13, half_width);
        let selected: Vec<&Attribute> = attributes.iter().collect();
        let (found, counts) = interpolate_to_band(&particles, &selected, &band, &lattice, 3.0, REACH);
        assert_eq!(found.iter().map(|attribute| attribute.arity).collect::<Vec<_>>(), [3, 3, 1]);
        assert_eq!((counts.isolated_count == 0, counts.empty_count), (half_width == 6.0, 0));
        let mut points = Vec::new();
        each_voxel(&band, &found[0], |_, _, values| points.push([values[0], values[1], values[2]]));
        let mut at = points.iter();
        let count = each_voxel(&band, &found[1], |voxel, phi, field| {
            // Voxels outside have the values at the nearest point of the surface. They are interpolated
            // between nodes, while the surface is curved.
            let from_center = voxel.as_dvec3() * VOXEL - center;
            let seen_from =
                from_center.normalize() * (from_center.length() - f64::from(phi.max(0.0)) * VOXEL);
            let middle = at.next().expect("as many voxels");
            let distance = distance_to_middle(seen_from.as_vec3(), middle, field);
            assert!(distance < 0.22 || half_width == 3.0, "{distance} at {voxel}, φ {phi}");
        });
        assert_eq!(each_voxel(&band, &found[2], |_, _, values| assert_eq!(values, [0.1])), count);
        assert!(counts.point_count < count / 4, "{counts:?} for {count} voxels");
    }
}

/// Midway between two surfaces, where the slope of φ vanishes, values are those of one of them.
#[test]
fn voxels_midway_between_surfaces_have_values() {
    // The gap is eight voxels wide; its middle is a layer of voxels.
    let centers = [DVec3::new(-1.0, 0.0, 0.0), DVec3::new(1.0, 0.0, 0.0)];
    let positions: Vec<[f64; 3]> = centers.iter().flat_map(|&center| ball(center, 0.67)).collect();
    let sides = positions.iter().map(|position| position[0].signum() as f32).collect();
    let side = numbers("side", 1, sides);
    let (band, lattice) = (band_of(&centers, 0.8, 6.0), Lattice { voxel_size: VOXEL });
    let (found, counts) =
        interpolate_to_band(OwnedPositions::F64(positions), &[&side], &band, &lattice, 3.0, REACH);
    assert_eq!((counts.isolated_count, counts.empty_count), (0, 0));
    each_voxel(&band, &found[0], |voxel, _, values| {
        let of_one = values[0] == voxel.x.signum() as f32;
        assert!(of_one || voxel.x.abs() < 2, "{values:?} at {voxel}");
    });
}

#[test]
fn band_values_stay_in_range_on_any_number_of_threads() {
    let positions = ball(DVec3::ZERO, 0.6);
    let mut state = 3;
    let values: Vec<f32> = positions.iter().map(|_| random(&mut state) as f32 * 3.4e38).collect();
    let range = values.iter().fold((f32::MAX, f32::MIN), |range, &v| (range.0.min(v), range.1.max(v)));
    let attributes = [numbers("a", 1, values), integers("id", vec![0; positions.len()])];
    let (band, lattice) = (band(DVec3::ZERO, 0.73, 6.0), Lattice { voxel_size: VOXEL });
    let particles = OwnedPositions::F64(positions);
    let run = || {
        let selected: Vec<&Attribute> = attributes.iter().collect();
        interpolate_to_band(&particles, &selected, &band, &lattice, 3.0, REACH).0
    };
    let found = run();
    assert_eq!(found.len(), 1, "integer attributes are not transferred to grids");
    each_voxel(&band, &found[0], |voxel, _, values| {
        assert!(range.0 <= values[0] && values[0] <= range.1, "{values:?} at {voxel}");
    });
    let pool = rayon::ThreadPoolBuilder::new().num_threads(5).build().expect("threads");
    let other = pool.install(run);
    for leaf in 0..band.topology.len() {
        let [one, other] = [&found[0], &other[0]].map(|attribute| {
            let mut values = vec![0.0; 512];
            attribute.fill(leaf, &mut values);
            values.iter().map(|value| value.to_bits()).collect::<Vec<u32>>()
        });
        assert_eq!(one, other);
    }
}

#[test]
fn empty_band_has_no_attribute_values() {
    let band =
        NarrowBand { topology: Arc::new(Topology::new(Vec::new())), phi: Field::default(), half_width: 6.0 };
    let attributes = numbers("a", 1, vec![1.0]);
    let particles = OwnedPositions::F32(vec![[0.0; 3]]);
    let lattice = Lattice { voxel_size: VOXEL };
    let (found, counts) = interpolate_to_band(&particles, &[&attributes], &band, &lattice, 3.0, REACH);
    assert_eq!((found.len(), found[0].size_bytes(), counts), (1, 0, TransferCounts::default()));
}
