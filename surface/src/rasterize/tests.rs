//! Compares rasterization with a reference implementation without culling, and windows with the whole frame.

use std::convert::Infallible;

use glam::{IVec3, Vec3};
use rustc_hash::FxHashMap;

use super::culling::leaves_of_boxes;
use super::*;
use crate::grid::{Leaf, voxel_in_leaf};
use crate::level_set::{Sweeps, UNREACHED, extend};
use crate::particles::{OwnedPositions, Positions, erased};

pub(super) const LATTICE: Lattice = Lattice { voxel_size: 1.0 };

/// Radii of these kinds: usual; so small that no particle may be culled; large and far apart; three equal
/// radii; so large that they reach across the adjacent leaf.
pub(super) const RADII: [Radii; 5] = [
    Radii::uniform(1.732_050_8, 2.598_076, 3.464_101_6),
    Radii::uniform(1.1, 1.3, 1.8),
    Radii::uniform(3.0, 5.5, 9.0),
    Radii::uniform(2.0, 2.0, 2.0),
    Radii::uniform(11.5, 12.0, 12.5),
];

/// A source with seven particles per batch.
struct Small<'a>(&'a [[f32; 3]]);

impl ParticleSource for Small<'_> {
    type Error = Infallible;

    fn batch_count(&self) -> usize {
        self.0.len().div_ceil(7)
    }

    fn batch(&self, batch: usize) -> Result<Positions<'_>, Infallible> {
        let Some(positions) = self.0.chunks(7).nth(batch) else { unreachable!("batch index out of range") };
        Ok(Positions::F32(positions.into()))
    }

    fn batch_len(&self, batch: usize) -> usize {
        self.0.chunks(7).nth(batch).map_or(0, <[_]>::len)
    }
}

/// Lattice points in a box around the origin, filtered by `holds`, each jittered by up to a third of the
/// spacing.
pub(super) fn jittered(half_edge: i32, spacing: f32, holds: impl Fn(Vec3) -> bool) -> Vec<[f32; 3]> {
    let mut state = 7u32;
    let mut moved = || {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        ((state >> 8) as f32 / (1 << 24) as f32 - 0.5) * spacing / 1.5
    };
    let count = (half_edge as f32 / spacing) as i32;
    let axis = || -count..=count;
    let points = axis().flat_map(|x| axis().flat_map(move |y| axis().map(move |z| IVec3::new(x, y, z))));
    let points = points.map(|point| point.as_vec3() * spacing).filter(|&point| holds(point));
    points.map(|point| (point + Vec3::new(moved(), moved(), moved())).to_array()).collect()
}

/// A solid block, a hollow one, a sheet, spray, a single particle, and no particles.
pub(super) fn scenes() -> Vec<(&'static str, Vec<[f32; 3]>)> {
    let ball = |center: Vec3, radius: f32| move |point: Vec3| (point - center).length() < radius;
    let mut spray = jittered(40, 11.0, |_| true);
    spray.extend([[40.0, 40.5, 41.0], [40.1, 40.4, 41.5]]);
    let hollow = jittered(26, 2.0, |point| {
        ball(Vec3::ZERO, 26.0)(point) && !ball(Vec3::new(4.0, 1.0, 0.0), 13.0)(point)
    });
    vec![
        ("solid", jittered(26, 2.0, ball(Vec3::ZERO, 26.0))),
        ("dense solid", jittered(17, 1.0, |point| point.abs().max_element() < 17.0)),
        ("hollow", hollow),
        ("sheet", jittered(30, 1.5, |point| (point.z - 0.2 * point.x).abs() < 1.0)),
        ("spray", spray),
        ("one", vec![[-0.2, 7.99, 8.0]]),
        ("none", Vec::new()),
    ]
}

/// Reference implementation, directly from the definition, with all particles. It rounds distances and
/// differences as the optimized code does.
fn reference(positions: &[[f32; 3]], radii: Radii) -> (NarrowBand, Bounds) {
    let nearest = Distances::new(positions, radii.max + EXACT_MARGIN);
    let sizes = [radii.max, radii.init, radii.min];
    let is_crossing = |voxel| nearest.is_crossing(voxel, radii.init);
    let half_width = radii.half_width();
    let signed = |topology: &Topology, surface: usize, reach| nearest.signed(topology, sizes[surface], reach);
    assembled(nearest.leaves.keys().copied(), is_crossing, signed, half_width)
}

/// The level sets around the crossings in these leaves. `signed` computes the distances to S_max, S_0 and
/// S_min, up to some reach.
pub(super) fn assembled(
    leaves: impl Iterator<Item = IVec3>,
    is_crossing: impl Fn(IVec3) -> bool,
    signed: impl Fn(&Topology, usize, f32) -> Field,
    half_width: f32,
) -> (NarrowBand, Bounds) {
    let mut stored = Vec::new();
    for origin in leaves {
        let mut surface = CoordBox::EMPTY;
        for voxel in (0..512).map(voxel_in_leaf).filter(|&voxel| is_crossing(origin + voxel)) {
            surface.include(voxel);
        }
        stored.push((origin, surface.expanded(if surface.is_empty() { 0 } else { half_width as i32 + 1 })));
    }
    let topology = Topology::new(leaves_of_boxes(&stored, |_| true));
    let mut phi = signed(&topology, 1, half_width);
    for value in phi.leaves.iter_mut().flat_map(|leaf| &mut leaf.values) {
        *value = value.clamp(-half_width, half_width);
    }
    let has_value = |leaf: &usize| phi.leaves[*leaf].values.iter().any(|value| value.abs() < half_width);
    let kept: Vec<usize> = (0..topology.len()).filter(has_value).collect();
    let phi = Field { leaves: kept.iter().map(|&leaf| phi.leaves[leaf]).collect() };
    let topology = Topology::new(kept.iter().map(|&leaf| topology.origins()[leaf]).collect());
    let [mut lower, mut upper] = [0, 2].map(|surface| signed(&topology, surface, BOUND_REACH));
    for (lower, upper) in lower.leaves.iter_mut().zip(&mut upper.leaves) {
        for (lower, upper) in lower.values.iter_mut().zip(&mut upper.values) {
            *upper = if *upper > BOUND_REACH { half_width } else { upper.max(-BOUND_REACH) };
            *lower = if *lower < -BOUND_REACH { -half_width } else { lower.min(BOUND_REACH) }.min(*upper);
        }
    }
    let bounds = Bounds::new(lower, upper);
    let mut band = NarrowBand { topology: Arc::new(topology), phi, half_width };
    bounds.clamp(&mut band.phi);
    (band, bounds)
}

/// Sweeps signed distances: `value_at` returns a voxel's value, and whether it is final; the others are
/// swept.
pub(super) fn swept(topology: &Topology, reach: f32, value_at: impl Fn(IVec3) -> (f32, bool)) -> Field {
    let mut distance = Field::splat(topology.len(), 0.0);
    let mut known = vec![LeafMask::EMPTY; topology.len()];
    for (leaf, &origin) in topology.origins().iter().enumerate() {
        for offset in 0..512 {
            let (value, is_known) = value_at(origin + voxel_in_leaf(offset));
            distance.leaves[leaf].values[offset] = if is_known {
                value
            } else if value < 0.0 {
                -UNREACHED
            } else {
                UNREACHED
            };
            if is_known {
                known[leaf].insert(offset);
            }
        }
    }
    extend(topology, &mut distance, &known, Sweeps::accurate(sweep_count(reach)));
    distance
}

/// Distances to the nearest of all particles; infinite beyond the reach.
struct Distances {
    leaves: FxHashMap<IVec3, Leaf>,
}

impl Distances {
    fn new(positions: &[[f32; 3]], reach: f32) -> Distances {
        let steps = crate::grid::leaf_steps_within(reach);
        let mut bins: FxHashMap<IVec3, Vec<Vec3>> = FxHashMap::default();
        for &position in positions {
            let position = Vec3::from(position).as_dvec3();
            let origin = (position / 8.0).floor() * 8.0;
            bins.entry(origin.as_ivec3()).or_default().push((position - origin).as_vec3());
        }
        let around = bins.keys().flat_map(|&origin| steps.iter().map(move |&step| origin + step));
        let origins: Vec<IVec3> = Topology::new(around.collect()).origins().to_vec();
        let leaf = |&origin: &IVec3| {
            let mut squared = Leaf::splat(f32::INFINITY);
            for &step in &steps {
                for position in bins.get(&(origin + step)).into_iter().flatten() {
                    let position = *position + step.as_vec3();
                    for (offset, value) in squared.values.iter_mut().enumerate() {
                        let apart = voxel_in_leaf(offset).as_vec3() - position;
                        *value = value.min(apart.x * apart.x + apart.y * apart.y + apart.z * apart.z);
                    }
                }
            }
            let distance =
                |squared: f32| if squared <= reach * reach { squared.sqrt() } else { f32::INFINITY };
            (origin, Leaf { values: squared.values.map(distance) })
        };
        Distances { leaves: origins.par_iter().halved().map(leaf).collect() }
    }

    fn at(&self, voxel: IVec3) -> f32 {
        let local = voxel.rem_euclid(IVec3::splat(8));
        let leaf = self.leaves.get(&(voxel - local));
        leaf.map_or(f32::INFINITY, |leaf| leaf.values[crate::grid::offset_in_leaf(local)])
    }

    /// True if a voxel is inside and next to an outside voxel.
    fn is_crossing(&self, voxel: IVec3, radius: f32) -> bool {
        self.at(voxel) < radius && FACE_STEPS.iter().any(|&step| self.at(voxel + step) >= radius)
    }

    fn signed(&self, topology: &Topology, radius: f32, reach: f32) -> Field {
        swept(topology, reach, |voxel| {
            let nearest = self.at(voxel);
            let is_adjacent =
                |step: &IVec3| topology.find_voxel(voxel + step).is_some() && self.at(voxel + step) >= radius;
            let is_known =
                nearest != f32::INFINITY && (nearest >= radius || FACE_STEPS.iter().any(is_adjacent));
            (nearest - radius, is_known)
        })
    }
}

/// The bits of φ_0 and of both bounds, by leaf.
pub(super) type LeafBits = Vec<(IVec3, [[u32; 512]; 3])>;

pub(super) fn values(band: &NarrowBand, bounds: &Bounds) -> LeafBits {
    let of_leaf = |leaf: usize| {
        let [lower, upper] = bounds.of_leaf(leaf);
        [&band.phi.leaves[leaf], lower, upper].map(|leaf| leaf.values.map(f32::to_bits))
    };
    band.topology.origins().iter().enumerate().map(|(leaf, &origin)| (origin, of_leaf(leaf))).collect()
}

pub(super) fn values_of(rasterized: &RasterFields) -> LeafBits {
    values(&rasterized.band, &rasterized.bounds)
}

#[test]
#[ignore = "slow: `.ci/full slow` runs it"]
fn culling_changes_no_bit() {
    for (name, positions) in scenes() {
        // The reference takes long for many particles with a long reach.
        for radii in RADII.into_iter().filter(|radii| radii.init < 10.0 || positions.len() < 1000) {
            let (band, bounds) = reference(&positions, radii);
            let Ok(whole) =
                rasterize(&OwnedPositions::F32(positions.clone()), &RasterParams::open(LATTICE, radii));
            assert!(values_of(&whole) == values(&band, &bounds), "{name}, {radii:?}");
            assert_eq!(whole.bins.particle_count, positions.len());
            // Particles are culled if the inside is large, and never if the radii are too small to prove that
            // they are inside.
            let left_out = positions.len() - whole.bins.len();
            let is_deep = name == "dense solid" && radii.init > 1.75;
            assert!(
                if is_deep { left_out > positions.len() / 8 } else { true },
                "{name}, {radii:?}: {left_out}"
            );
            assert!(radii.init > 1.75 || left_out == 0, "{name}, {radii:?}: {left_out}");
        }
    }
}

/// The results are also the same with batches of particles in another order, and with skipped batches.
#[test]
fn windows_equal_the_whole_frame() {
    let bar = |point: Vec3| point.y.abs() < 5.0 && (point.z - 0.1 * point.x).abs() < 3.0;
    let mut positions = jittered(150, 2.0, bar);
    positions.extend(jittered(14, 1.0, |point| point.length() < 14.0));
    let mut whole_count = 0;
    for radii in [RADII[0], RADII[2]] {
        let Ok(whole) =
            rasterize(&OwnedPositions::F32(positions.clone()), &RasterParams::open(LATTICE, radii));
        let source = Small(&positions);
        let Ok(occupancy) = erased(&source, |source| Occupancy::new(source, &LATTICE));
        let (mut parts, mut fewest) = (LeafBits::new(), usize::MAX);
        for (first, last) in [(-200, -137), (-136, -41), (-40, -33), (-32, -1), (0, 23), (24, 199)] {
            for (low, high) in [(-64, 7), (8, 63)] {
                let window = CoordBox { min: IVec3::new(first, -64, low), max: IVec3::new(last, 63, high) };
                let Ok(part) = erased(&source, |source| {
                    rasterize_window(source, &occupancy, &RasterParams::open(LATTICE, radii), window)
                });
                parts.extend(values_of(&part));
                fewest = fewest.min(part.bins.len());
            }
        }
        parts.sort_by_key(|(origin, _)| whole.band.topology.find(*origin));
        assert!(parts == values_of(&whole), "{radii:?}");
        whole_count += whole.band.topology.len();
        assert!(fewest < whole.bins.len() / 2, "{fewest} of {}", whole.bins.len());
    }
    assert!(whole_count > 1000);
}
