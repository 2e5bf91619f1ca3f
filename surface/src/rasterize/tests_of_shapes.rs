//! Compares the rasterization of anisotropic particles with a reference implementation without culling, and
//! windows with the whole frame.

use glam::{IVec3, Vec3};
use rustc_hash::FxHashMap;

use super::tests::{LATTICE, LeafBits, RADII, assembled, jittered, scenes, swept, values, values_of};
use super::*;
use crate::grid::{offset_in_leaf, voxel_in_leaf};
use crate::particles::{Ellipsoid, LEVEL_AT, OwnedPositions, ParticleCloud, Shapes, erased};

fn cloud(positions: &[[f32; 3]], shapes: Shapes) -> ParticleCloud {
    ParticleCloud { shapes, ..ParticleCloud::from(OwnedPositions::F32(positions.to_vec())) }
}

/// Pseudo-random numbers from 0 to 1, a function of the index and the salt.
fn random(index: usize, salt: u32) -> f32 {
    let mixed = (index as u32).wrapping_mul(0x9e37_79b9).wrapping_add(salt.wrapping_mul(0x85eb_ca6b));
    let mixed = (mixed ^ mixed >> 15).wrapping_mul(0x2c1b_3c6d);
    ((mixed ^ mixed >> 12) >> 8) as f32 / (1 << 24) as f32
}

/// Ellipsoids of all kinds, with semi-axes of at least `shortest`.
fn ellipsoids(count: usize, shortest: f32, longest: f32) -> Shapes {
    let one = |index: usize| {
        let angles = [0, 1].map(|salt| random(index, salt) * 6.3);
        let x = Vec3::new(angles[0].cos(), angles[0].sin(), 0.0);
        let tilted = Vec3::new(-angles[0].sin(), angles[0].cos(), 0.0);
        let y = tilted * angles[1].cos() + Vec3::Z * angles[1].sin();
        let axis = |salt: u32| shortest + (longest - shortest) * random(index, salt);
        Ellipsoid::new([axis(2), axis(3), axis(4)], [x, y, x.cross(y)])
    };
    Shapes::Ellipsoids((0..count).map(one).collect())
}

fn scales(count: usize, most: f32) -> Shapes {
    Shapes::Scaled((0..count).map(|index| 1.0 + (most - 1.0) * random(index, 9).powi(6)).collect())
}

/// One ellipsoid in four is flat, with a shortest semi-axis of `thickness`; the others are nearly balls.
fn flat_among_round(count: usize, thickness: f32) -> Shapes {
    let Shapes::Ellipsoids(mut shapes) = ellipsoids(count, 0.93, 1.1) else {
        unreachable!("by construction")
    };
    for (index, shape) in shapes.iter_mut().enumerate().filter(|(index, _)| random(*index, 5) < 0.25) {
        let angle = random(index, 6) * 6.3;
        let x = Vec3::new(angle.cos(), angle.sin(), 0.0);
        *shape = Ellipsoid::new([thickness, 1.3, 1.4], [x, Vec3::new(-x.y, x.x, 0.0), Vec3::Z]);
    }
    Shapes::Ellipsoids(shapes)
}

#[test]
fn scaled_balls_of_scale_one_equal_uniform_balls() {
    for (name, positions) in scenes() {
        for radii in RADII.into_iter().filter(|radii| radii.init < 5.0 || positions.len() < 1000) {
            let Ok(balls) =
                rasterize(&OwnedPositions::F32(positions.clone()), &RasterParams::open(LATTICE, radii));
            let scaled = cloud(&positions, Shapes::Scaled(vec![1.0; positions.len()]));
            let Ok(scaled) = rasterize(&scaled, &RasterParams::open(LATTICE, radii));
            assert!(values_of(&scaled) == values_of(&balls), "{name}, {radii:?}");
        }
    }
}

/// Round ellipsoids have the same surface as balls. Values from sweeping differ by the error of the distances
/// from which sweeping starts.
#[test]
fn round_ellipsoids_approximate_balls() {
    let (_, positions) = scenes().swap_remove(2);
    let Ok(balls) =
        rasterize(&OwnedPositions::F32(positions.clone()), &RasterParams::open(LATTICE, RADII[0]));
    let round = Shapes::Ellipsoids(vec![Ellipsoid::ball(1.0); positions.len()]);
    let Ok(round) = rasterize(&cloud(&positions, round), &RasterParams::open(LATTICE, RADII[0]));
    let fields_of = |fields: &RasterFields| {
        let [lower, upper] = fields.bounds.to_fields();
        [fields.band.phi.clone(), lower, upper]
    };
    let (round_fields, balls_fields) = (fields_of(&round), fields_of(&balls));
    let balls_topology = &balls.band.topology;
    let mut shared_count = 0;
    for (leaf, &origin) in balls.band.topology.origins().iter().enumerate() {
        // At the edge of the band, different swept distances can select different leaves: skip these.
        let Some(other) = round.band.topology.find(origin) else { continue };
        shared_count += 1;
        for (field, (round, balls)) in round_fields.iter().zip(&balls_fields).enumerate() {
            for offset in 0..512 {
                // Bounds are open farther away.
                let reach = if field == 0 { f32::INFINITY } else { 1.0 };
                let [value, expected] =
                    [round.leaves[other].values[offset], balls.leaves[leaf].values[offset]]
                        .map(|value| value.clamp(-reach, reach));
                assert_eq!(value < 0.0, expected < 0.0, "{value} for {expected} in field {field}");
                let is_adjacent = |step: &IVec3| {
                    let found = balls_topology.find_voxel(origin + voxel_in_leaf(offset) + step);
                    let value = found.map(|(leaf, at)| balls.leaves[leaf].values[offset_in_leaf(at)]);
                    value.is_some_and(|value| (value < 0.0) != (expected < 0.0))
                };
                // Values next to the surface come from the particles; the others are swept.
                let allowed = if FACE_STEPS.iter().any(is_adjacent) { 1e-3 } else { 0.5 };
                assert!((value - expected).abs() < allowed, "{value} for {expected} in field {field}");
            }
        }
    }
    assert!(shared_count * 50 > balls.band.topology.len() * 49, "{shared_count}");
}

#[test]
#[ignore = "slow: `.ci/full slow` runs it"]
fn culling_changes_no_bit() {
    for (name, positions) in scenes() {
        let count = positions.len();
        for (radii, shapes) in [
            (Radii { band_scale: 2.0, ..RADII[0] }, scales(count, 4.0)),
            (Radii { band_scale: 1.5, min_scale: 0.7, ..RADII[2] }, ellipsoids(count, 0.7, 1.4)),
            (Radii { band_scale: 2.0, ..RADII[0] }, ellipsoids(count, 1.0, 2.2)),
            (Radii { min_scale: 0.3, ..RADII[2] }, flat_among_round(count, 0.3)),
        ] {
            let source = cloud(&positions, shapes);
            let (band, bounds) = reference(&source, radii);
            let Ok(whole) = rasterize(&source, &RasterParams::open(LATTICE, radii));
            assert!(values_of(&whole) == values(&band, &bounds), "{name}, {radii:?}");
            assert_eq!(whole.bins.particle_count, count);
        }
    }
}

/// The bounds of a ball with a radius of 60 voxels are 15 voxels apart, more than the width of the band. A
/// surface that is free to move between them must not leave the stored leaves.
#[test]
fn surface_stays_in_the_band_if_bounds_exceed_it() {
    let positions = [[0.2, 0.1, 5.3], [27.4, 21.6, 53.5], [30.6, 22.3, 49.7]];
    let radii = Radii::uniform(1.75, 2.6, 3.5);
    let source = cloud(&positions, Shapes::Scaled(vec![18.0, 1.0, 1.0]));
    let Ok(RasterFields { band, bounds, .. }) = rasterize(&source, &RasterParams::open(LATTICE, radii));
    let mut held_count = 0;
    for (leaf, &origin) in band.topology.origins().iter().enumerate() {
        for offset in 0..512 {
            let voxel = origin + voxel_in_leaf(offset);
            let steps = (0..27).map(|step| IVec3::new(step / 9, step / 3 % 3, step % 3) - 1);
            if steps.into_iter().all(|step| band.topology.find_voxel(voxel + step).is_some()) {
                continue;
            }
            let [lower, upper] = bounds.of_leaf(leaf).map(|bound| bound.values[offset]);
            let phi = band.phi.leaves[leaf].values[offset];
            assert!(phi.abs() > 4.0, "a voxel at the end of the band is {phi} from the surface");
            assert!(phi < 0.0 || lower >= 1.0, "{lower} to {upper} at {voxel}");
            held_count += 1;
        }
    }
    assert!(held_count > 1000, "{held_count}");
}

#[test]
fn windows_equal_the_whole_frame() {
    let bar = |point: Vec3| point.y.abs() < 5.0 && (point.z - 0.1 * point.x).abs() < 3.0;
    let mut positions = jittered(100, 2.0, bar);
    positions.extend(jittered(14, 1.0, |point| point.length() < 14.0));
    let radii = Radii { band_scale: 2.0, ..RADII[0] };
    for shapes in [scales(positions.len(), 5.0), ellipsoids(positions.len(), 1.0, 2.5)] {
        let source = cloud(&positions, shapes);
        let Ok(whole) = rasterize(&source, &RasterParams::open(LATTICE, radii));
        let Ok(occupancy) = erased(&source, |source| Occupancy::new(source, &LATTICE));
        let mut parts = LeafBits::new();
        for (first, last) in [(-160, -41), (-40, -33), (-32, -1), (0, 23), (24, 159)] {
            for (low, high) in [(-64, 7), (8, 63)] {
                let window = CoordBox { min: IVec3::new(first, -64, low), max: IVec3::new(last, 63, high) };
                let Ok(part) = erased(&source, |source| {
                    rasterize_window(source, &occupancy, &RasterParams::open(LATTICE, radii), window)
                });
                parts.extend(values_of(&part));
            }
        }
        parts.sort_by_key(|(origin, _)| whole.band.topology.find(*origin));
        assert!(parts == values_of(&whole));
        assert!(whole.band.topology.len() > 200);
    }
}

/// Reference implementation, directly from the definition, with all particles. It rounds values as the
/// optimized code does.
fn reference(source: &ParticleCloud, radii: Radii) -> (NarrowBand, Bounds) {
    let (values, half_width) = (Definition::new(source, radii), radii.half_width());
    let signed = |topology: &Topology, surface: usize, reach| values.signed(topology, surface, reach);
    let leaves = values.leaves.keys().copied();
    let (mut band, bounds) = assembled(leaves, |voxel| values.is_crossing(voxel), signed, half_width);
    // Where the band is narrower than the gap between the radii, φ stays positive next to its edge.
    let [mut lower, upper] = bounds.to_fields();
    for (leaf, phi) in band.phi.leaves.iter_mut().enumerate() {
        let (lower, upper) = (&mut lower.leaves[leaf].values, &upper.leaves[leaf].values);
        for (offset, phi) in phi.values.iter_mut().enumerate().filter(|(_, phi)| **phi > half_width - 2.0) {
            lower[offset] = lower[offset].max(1.0).min(upper[offset]);
            *phi = phi.max(lower[offset]);
        }
    }
    (band, Bounds::new(lower, upper))
}

/// The values at every voxel within the range of a particle, for the three radii: of balls, the least; of
/// ellipsoids, that of the particle with the least key.
struct Definition {
    leaves: FxHashMap<IVec3, [Leaf; 3]>,
    is_exact_outside: bool,
}

impl Definition {
    fn new(source: &ParticleCloud, radii: Radii) -> Definition {
        let OwnedPositions::F32(positions) = &source.positions else {
            unreachable!("single by construction")
        };
        let mut leaves: FxHashMap<IVec3, [Leaf; 3]> = FxHashMap::default();
        let mut keys: FxHashMap<IVec3, [Leaf; 3]> = FxHashMap::default();
        let radii = [radii.max, radii.init, radii.min];
        for (particle, &position) in positions.iter().enumerate() {
            let position = Vec3::from(position).as_dvec3();
            let leaf = (position / 8.0).floor() * 8.0;
            let local = (position - leaf).as_vec3();
            let reach = (radii[0] * source.shapes.outer_radius(particle) + 2.0).ceil() as i32;
            let first = (local.floor().as_ivec3() - reach).div_euclid(IVec3::splat(8));
            let last = (local.ceil().as_ivec3() + reach).div_euclid(IVec3::splat(8));
            for x in first.x..=last.x {
                for y in first.y..=last.y {
                    for z in first.z..=last.z {
                        let step = IVec3::new(x, y, z) * 8;
                        let [values, keys] = [&mut leaves, &mut keys].map(|leaves| {
                            leaves.entry(leaf.as_ivec3() + step).or_insert([Leaf::splat(f32::INFINITY); 3])
                        });
                        for (offset, voxel) in
                            (0..512).map(|offset| (offset, voxel_in_leaf(offset).as_vec3()))
                        {
                            // The particle's position as seen from a leaf one step away.
                            let apart = voxel - (local + -step.as_vec3());
                            if apart.abs().max_element() > reach as f32 {
                                continue;
                            }
                            let found = value_of(&source.shapes, particle, apart, radii);
                            for (union, (key, value)) in found.into_iter().enumerate() {
                                let nearest = &mut keys[union].values[offset];
                                let known = &mut values[union].values[offset];
                                if key < *nearest || key == *nearest && value.abs() < known.abs() {
                                    (*nearest, *known) = (key, value);
                                }
                            }
                        }
                    }
                }
            }
        }
        let is_exact_outside = matches!(source.shapes, Shapes::Scaled(_));
        let most = if is_exact_outside { f32::INFINITY } else { 1.0 };
        for leaf in leaves.values_mut().flatten() {
            leaf.values.iter_mut().for_each(|value| *value = value.max(-1.25).min(most));
        }
        Definition { leaves, is_exact_outside }
    }

    fn at(&self, voxel: IVec3, surface: usize) -> f32 {
        let local = voxel.rem_euclid(IVec3::splat(8));
        let leaf = self.leaves.get(&(voxel - local));
        leaf.map_or(f32::INFINITY, |leaf| leaf[surface].values[offset_in_leaf(local)])
    }

    /// True if a voxel is inside and next to an outside voxel.
    fn is_crossing(&self, voxel: IVec3) -> bool {
        self.at(voxel, 1) < 0.0 && FACE_STEPS.iter().any(|&step| self.at(voxel + step, 1) >= 0.0)
    }

    fn signed(&self, topology: &Topology, surface: usize, reach: f32) -> Field {
        swept(topology, reach, |voxel| {
            let value = self.at(voxel, surface);
            let is_adjacent = |step: &IVec3| {
                let is_other = (self.at(voxel + step, surface) < 0.0) != (value < 0.0);
                topology.find_voxel(voxel + step).is_some() && is_other
            };
            let is_exact = value >= 0.0 && self.is_exact_outside;
            (value, value != f32::INFINITY && (is_exact || FACE_STEPS.iter().any(is_adjacent)))
        })
    }
}

/// A particle's keys and values at a position relative to its center, infinite outside its range.
fn value_of(shapes: &Shapes, particle: usize, apart: Vec3, radii: [f32; 3]) -> [(f32, f32); 3] {
    match shapes {
        Shapes::Uniform => unreachable!("uniform balls have separate tests"),
        Shapes::Scaled(scales) => {
            let squared = apart.x * apart.x + apart.y * apart.y + apart.z * apart.z;
            radii.map(|radius| {
                let value = squared.sqrt() - scales[particle] * radius;
                // Distances beyond the range of the smallest balls, whose scale is at least 1, are swept.
                let value = if value <= 2.0 + (radii[0] - radius) { value } else { f32::INFINITY };
                (value, value)
            })
        }
        Shapes::Ellipsoids(ellipsoids) => {
            let ellipsoid = ellipsoids[particle];
            let extents = radii[0] * ellipsoid.extents() + 1.125;
            let [xx, yy, zz, xy, xz, yz] = ellipsoid.to_unit_ball;
            let along = |a: f32, b: f32, c: f32, v: Vec3| (a * v.x + b * v.y) + c * v.z;
            let times = |v: Vec3| Vec3::new(along(xx, xy, xz, v), along(xy, yy, yz, v), along(xz, yz, zz, v));
            let (once, twice) = (times(apart), times(times(apart)));
            let squared = |v: Vec3| v.x * v.x + v.y * v.y + v.z * v.z;
            let ratio = (squared(once) / squared(twice).max(f32::MIN_POSITIVE)).sqrt();
            let norm = (xx * xx + yy * yy + zz * zz + 2.0 * (xy * xy + xz * xz + yz * yz)).sqrt();
            let counts = apart.abs().cmple(extents).all();
            let key = squared(once).sqrt();
            radii.map(|radius| {
                let value = (key - radius) * ratio.max(1.0 / norm);
                if counts { (key, value) } else { (f32::INFINITY, f32::INFINITY) }
            })
        }
    }
}

/// Bodies with a bubble of each size in the middle: the sign of φ is that of a plain sum of kernels at every voxel near the
/// bubble, and the interior of the body around it is not stored.
#[test]
fn interiors_of_bodies_are_skipped_and_no_bubble_is() {
    let (spacing, reach) = (3.125f32, 8.2f32);
    let kernel = |q_squared: f32| ((1.0 - 0.8 * q_squared).max(0.0).powi(4) - 0.0016).max(0.0);
    // So that the mean of the sum is 1.
    let integral: f32 =
        (0..1000).map(|i| (i as f32 + 0.5) / 1000.0).map(|q| q * q * kernel(q * q) / 1000.0).sum();
    let weight = spacing.powi(3) / (4.0 * std::f32::consts::PI * reach.powi(3) * integral);
    let level = kernel(LEVEL_AT * LEVEL_AT);
    let radii = Radii { start: Start::Kernels, room: 1.0, ..Radii::uniform(1.0, LEVEL_AT * reach, reach) };
    let mut bubble_count = 0;
    for radius in [0.0, 1.0, 1.3, 1.4, 1.5, 1.6, 1.8, 2.2].map(|radius| radius * spacing) {
        let positions = jittered(56, spacing, |position| position.length() >= radius);
        let shapes = Shapes::Ellipsoids(vec![Ellipsoid { weight, ..Ellipsoid::ball(1.0) }; positions.len()]);
        let Ok(fields) = rasterize(&cloud(&positions, shapes), &RasterParams::open(LATTICE, radii));
        assert!(fields.bins.is_deep(IVec3::splat(16)), "radius {radius}");
        assert!(fields.band.topology.find(IVec3::splat(16)).is_none(), "radius {radius}");
        let near: Vec<Vec3> =
            positions.iter().copied().map(Vec3::from).filter(|at| at.length() < 27.0).collect();
        let mut has_bubble = false;
        for index in 0..19 * 19 * 19 {
            let voxel = IVec3::new(index / 361, index / 19 % 19, index % 19) - 9;
            let squared = || near.iter().map(|at| at.distance_squared(voxel.as_vec3()));
            let sum: f32 = squared().map(|squared| weight * kernel(squared / (reach * reach))).sum();
            let is_outside = sum < level && squared().all(|squared| squared > 1.0);
            has_bubble |= is_outside;
            if (sum - level).abs() > 1e-3 {
                let found = fields.band.topology.find_voxel(voxel);
                let phi =
                    found.map_or(-1.0, |(leaf, at)| fields.band.phi.leaves[leaf].values[offset_in_leaf(at)]);
                assert_eq!(phi > 0.0, is_outside, "radius {radius}, {voxel}: {phi}, {sum}");
            }
        }
        bubble_count += usize::from(has_bubble);
    }
    assert!((2..7).contains(&bubble_count), "{bubble_count}");
}
