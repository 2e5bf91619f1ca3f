//! Tests attributes of particles of different sizes: compares with brute force, and checks that the result
//! depends only on near particles, and that the work is limited.

use std::cell::Cell;

use glam::{DVec3, Vec3};

use super::interpolate::{Tree, TreeParticle};
use super::*;
use crate::particles::{OwnedPositions, Role};

const RADIUS: f64 = 0.26;

fn support(shapes: &Shapes) -> Support<'_> {
    Support { radius_world: RADIUS, radius_max_world: 0.2, margin_world: 0.05, shapes, unsmoothed: None }
}

fn random(state: &mut u32) -> f64 {
    *state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
    f64::from(*state >> 8) / f64::from(1 << 24)
}

fn direction(state: &mut u32) -> DVec3 {
    let mut along = || random(state) - 0.5;
    DVec3::new(along(), along(), along()).normalize_or(DVec3::X)
}

/// Particles with their scales.
#[derive(Clone, Default)]
struct Sizes {
    positions: Vec<[f64; 3]>,
    scales: Vec<f32>,
    ids: Vec<i64>,
}

impl Sizes {
    fn push(&mut self, position: DVec3, scale: f32) {
        self.positions.push(position.to_array());
        self.scales.push(scale);
        self.ids.push(self.ids.len() as i64 * 7);
    }

    /// Large particles of various sizes among small ones; some positions occur twice.
    fn mixed() -> Sizes {
        let (mut sizes, mut state) = (Sizes::default(), 17);
        for index in 0..3000 {
            let point = direction(&mut state) * 8.0 * random(&mut state);
            let scale = match index % 50 {
                0 => 2.0 + 20.0 * random(&mut state) as f32,
                other => [0.5, 1.0, 1.5][other % 3],
            };
            sizes.push(point, scale);
            if index % 20 == 0 {
                sizes.push(point, scale);
            }
        }
        sizes
    }

    /// Points on the surfaces of the large particles, and beyond.
    fn points(&self) -> Mesh {
        let mut state = 23;
        let mut positions = Vec::new();
        for (position, scale) in self.positions.iter().zip(&self.scales).filter(|(_, scale)| **scale >= 1.5) {
            let distance = f64::from(*scale) * 0.2 * (0.8 + 0.4 * random(&mut state));
            positions.push((DVec3::from(*position) + direction(&mut state) * distance).as_vec3());
        }
        Mesh { positions, ..Mesh::default() }
    }

    /// The values at these points: the bits of the numbers, and the ids of the particles.
    fn transferred(&self, mesh: &Mesh) -> (Vec<u32>, Vec<i64>, TransferCounts) {
        let attribute = |values| Attribute { name: "a".into(), role: Role::Other, arity: 1, values };
        let numbers: Vec<f32> = self.ids.iter().map(|&id| 1.0 + (id as f32).sin()).collect();
        let attributes = [AttributeValues::Numbers(numbers), AttributeValues::Integers(self.ids.clone())];
        let attributes = attributes.map(attribute);
        let shapes = Shapes::Scaled(self.scales.clone());
        let particles = OwnedPositions::F64(self.positions.clone());
        let (found, counts) =
            interpolate_to_vertices(&particles, &attributes.each_ref()[..], mesh, support(&shapes));
        let [AttributeValues::Numbers(numbers), AttributeValues::Integers(ids)] =
            [&found[0].values, &found[1].values]
        else {
            panic!("unexpected attribute types")
        };
        (numbers.iter().map(|number| number.to_bits()).collect(), ids.clone(), counts)
    }

    /// The nearest of all particles that reach a point beyond the radius. `Err` if a particle is within the
    /// radius.
    fn brute_force(&self, point: DVec3) -> Result<Option<usize>, ()> {
        let shapes = Shapes::Scaled(self.scales.clone());
        let distances =
            || self.positions.iter().map(|&position| DVec3::from(position).distance_squared(point));
        if distances().any(|distance_squared| distance_squared < RADIUS * RADIUS) {
            return Err(());
        }
        let limit = |index: usize| support(&shapes).limit_world(index as u32);
        let reaching = distances().enumerate().filter(|(index, least)| *least < limit(*index).powi(2));
        Ok(reaching.min_by(|one, other| one.1.total_cmp(&other.1)).map(|(index, _)| index))
    }
}

#[test]
fn isolated_points_get_the_nearest_particle_that_reaches_them() {
    let sizes = Sizes::mixed();
    let mesh = sizes.points();
    let (numbers, ids, counts) = sizes.transferred(&mesh);
    let (mut isolated_count, mut empty_count) = (0, 0);
    for (vertex, position) in mesh.positions.iter().enumerate() {
        match sizes.brute_force(position.as_dvec3()) {
            Err(()) => assert_ne!(ids[vertex], -1),
            Ok(None) => {
                empty_count += 1;
                assert_eq!((numbers[vertex], ids[vertex]), (0, -1), "at {position}");
            }
            Ok(Some(nearest)) => {
                isolated_count += 1;
                let id = sizes.ids[nearest];
                assert_eq!((numbers[vertex], ids[vertex]), ((1.0 + (id as f32).sin()).to_bits(), id));
            }
        }
    }
    assert_eq!((counts.isolated_count, counts.empty_count), (isolated_count, empty_count));
    assert!(isolated_count > 50 && empty_count > 5, "{counts:?}");
    let pool = rayon::ThreadPoolBuilder::new().num_threads(5).build().expect("threads");
    assert_eq!(pool.install(|| sizes.transferred(&mesh)), (numbers, ids, counts));
}

#[test]
fn scale_of_distant_particles_changes_no_bit() {
    let mut sizes = Sizes::mixed();
    let mut mesh = sizes.points();
    // Two particles whose distances from a point differ by less than 32-bit precision; the first is farther.
    let apart = DVec3::splat(30.0);
    sizes.push(apart + DVec3::X * (0.75 + 1e-9), 5.0);
    sizes.push(apart - DVec3::X * 0.75, 5.0);
    mesh.positions.push(apart.as_vec3());
    // A point that no particle reaches. It must not get the value of a large particle far away.
    mesh.positions.push(Vec3::splat(35.0));
    let reference = sizes.transferred(&mesh);
    assert_eq!(reference.1[mesh.positions.len() - 2..], [sizes.ids[sizes.ids.len() - 1], -1]);
    for scale in [30.0, 500.0, 4e4] {
        let mut more = sizes.clone();
        more.positions.insert(0, [-1e5, 3.0, 1e4]);
        more.scales.insert(0, scale);
        more.ids.insert(0, -5);
        assert_eq!(more.transferred(&mesh), reference, "scale {scale}");
    }
}

/// Maximum number of particles that a point visits, and whether all points found one.
fn looks(positions: &[DVec3], limit_world: impl Fn(u32) -> f64 + Sync, points: &[DVec3]) -> (usize, bool) {
    let particle_at = |particle: u32| TreeParticle {
        position: positions[particle as usize],
        limit_world: limit_world(particle),
    };
    let tree = Tree::new((0..positions.len() as u32).collect(), &particle_at);
    let (mut most, mut all_found) = (0, true);
    for &point in points {
        let count = Cell::new(0);
        let nearest = tree.nearest(point, |particle| {
            count.set(count.get() + 1);
            particle_at(particle)
        });
        most = most.max(count.get());
        all_found &= nearest != NO_PARTICLE;
    }
    (most, all_found)
}

#[test]
fn search_visits_few_of_many_particles() {
    let mut state = 3;
    let points: Vec<DVec3> = (0..300).map(|_| direction(&mut state) * 5.0).collect();
    for count in [10_000, 100_000] {
        let cluster: Vec<DVec3> = (0..count).map(|_| direction(&mut state) * random(&mut state)).collect();
        let (most, all_found) = looks(&cluster, |_| 64.0, &points);
        // Seen from afar, many particles of a dense crowd have nearly the same distance. So the work grows
        // with the number of particles, but much more slowly.
        assert!(all_found && most <= 640, "{most} of {count}");
        // All particles are at the same position.
        let (most, all_found) = looks(&vec![DVec3::Y; count], |_| 64.0, &points);
        assert!(all_found && most <= 16, "{most} of {count}");
        // No particle reaches the point; then exactly one does.
        assert_eq!(looks(&cluster, |_| 3.2, &points), (0, false));
        let (most, all_found) = looks(&cluster, |particle| if particle == 7 { 64.0 } else { 3.2 }, &points);
        assert!(all_found && most <= 16, "{most} of {count}");
    }
    assert_eq!(looks(&[], |_| 64.0, &points), (0, false));
}
