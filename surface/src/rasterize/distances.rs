//! Distances from voxels to particles, for any kind of particle.
//!
//! ```text
//!   uniform balls   one field: the distance to the nearest center; subtracting a radius gives the distance
//!                   to each of the three unions
//!   others          three fields: the signed distance to each union
//! ```

use glam::{IVec3, Vec3};
use rayon::prelude::*;

use super::bin::ParticleBins;
use super::culling::Culling;
use super::ellipsoid::{BallShape, EllipsoidShape, Primitives};
use super::kernels::KernelShape;
use super::{Radii, RasterParams, Start, keep, keep_in_place, sweep_count};
use crate::grid::{
    Field, LEAF_EDGE, LEAVES_PER_TASK, Leaf, LeafMask, NO_LEAF, ROW_COUNT, SetBits, Topology,
    leaf_steps_within,
};
use crate::level_set::{Sweeps, UNREACHED, extend_in};
use crate::parallel::Loops as _;
use crate::particles::Shapes;
use crate::simd::{self, Kernel, Lanes, greatest};

/// Names one of the three unions of spheres.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum SphereUnion {
    /// S_max: φ_max in the paper, the lower bound of φ.
    Max,
    /// S_0, where smoothing starts.
    Init,
    /// S_min: φ_min in the paper, the upper bound of φ.
    Min,
}

/// Distances in voxels, by leaf.
pub(super) struct SphereDistances {
    /// One field of distances to the nearest center, [`OUT_OF_REACH`] beyond the reach; or three of signed
    /// distances, in the order of [`SphereUnion`]. These are negative inside; deep inside, any negative number,
    /// and beyond the reach infinite.
    fields: Vec<Field>,
    /// Whether all values outside the unions are exact, rather than only those adjacent to an inside voxel.
    is_exact_outside: bool,
}

/// Computes distances to particles.
pub(super) enum DistanceSolver<'a> {
    /// Particle centers, and the reach in voxels.
    Centers(ParticlePackets<'a>, f32),
    Balls(Primitives<BallShape>),
    Ellipsoids(Primitives<EllipsoidShape>),
    /// The fields are not distances, but those of [`kernels`](super::kernels).
    Kernels(Primitives<KernelShape>),
}

impl<'a> DistanceSolver<'a> {
    /// A solver for these particles.
    pub(super) fn new(bins: &'a ParticleBins, radii: Radii) -> DistanceSolver<'a> {
        if radii.start == Start::Kernels {
            let shape = |particle| KernelShape::new(bins.shapes.ellipsoid(particle));
            return DistanceSolver::Kernels(Primitives::new(bins, radii, shape));
        }
        match &bins.shapes {
            Shapes::Uniform => DistanceSolver::Centers(ParticlePackets::new(bins), radii.exact_reach(1.0)),
            Shapes::Scaled(scales) => {
                DistanceSolver::Balls(Primitives::new(bins, radii, |particle| BallShape(scales[particle])))
            }
            Shapes::Ellipsoids(ellipsoids) => {
                DistanceSolver::Ellipsoids(Primitives::new(bins, radii, |particle| {
                    EllipsoidShape::new(ellipsoids[particle])
                }))
            }
        }
    }

    /// Makes the leaves deep that are in the interior of a body of kernels.
    pub(super) fn deepen(&self, culling: &mut Culling, scene: &RasterParams) {
        if let DistanceSolver::Kernels(primitives) = self {
            let are_high = primitives.are_high(&culling.near, |leaf| culling.is_surrounded(leaf));
            culling.deepen(&are_high, scene);
        }
    }

    /// The distances in these leaves.
    pub(super) fn distances(&self, leaves: &Topology, culling: &Culling) -> SphereDistances {
        let (count, is_exact_outside) = match self {
            DistanceSolver::Centers(..) => (1, true),
            DistanceSolver::Balls(_) => (3, true),
            DistanceSolver::Ellipsoids(_) | DistanceSolver::Kernels(_) => (3, false),
        };
        // With room for further leaves, which takes no memory until they are written.
        let field = |_| Field { leaves: Vec::with_capacity(2 * leaves.len()) };
        let mut distances = SphereDistances { fields: (0..count).map(field).collect(), is_exact_outside };
        self.append(&mut distances, leaves, culling);
        distances
    }

    /// Appends the distances in these leaves.
    fn append(&self, distances: &mut SphereDistances, leaves: &Topology, culling: &Culling) {
        let settled = |origin| culling.settled(origin);
        let fields = &mut distances.fields;
        match self {
            DistanceSolver::Centers(packets, reach) => {
                append_nearest_distances(&mut fields[0], packets, leaves, *reach, settled);
            }
            DistanceSolver::Balls(primitives) => primitives.append_distances(fields, leaves, settled),
            DistanceSolver::Ellipsoids(primitives) => primitives.append_distances(fields, leaves, settled),
            DistanceSolver::Kernels(primitives) => primitives.append_distances(fields, leaves, settled),
        }
    }

    /// The distances in these leaves, some of which are `known`. No field exists twice meanwhile.
    pub(super) fn extended(
        &self,
        known: (&Topology, SphereDistances),
        leaves: &Topology,
        culling: &Culling,
    ) -> SphereDistances {
        let (known_leaves, mut distances) = known;
        let known_leaf = |&origin: &IVec3| known_leaves.find(origin);
        let kept: Vec<usize> = leaves.origins().iter().filter_map(known_leaf).collect();
        distances.fields.par_iter_mut().halved().for_each(|field| keep_in_place(field, &kept));
        let is_new = |origin: &&IVec3| known_leaf(origin).is_none();
        let new_leaves = Topology::new(leaves.origins().iter().filter(is_new).copied().collect());
        self.append(&mut distances, &new_leaves, culling);
        // Topologies have one order, so each of the two parts is in the order of `leaves`.
        let mut next = [0, kept.len()];
        let place = |origin: &IVec3| {
            let next = &mut next[usize::from(known_leaf(origin).is_none())];
            *next += 1;
            *next - 1
        };
        let places: Vec<usize> = leaves.origins().iter().map(place).collect();
        distances.fields.par_iter_mut().halved().for_each(|field| reorder(&mut field.leaves, &places));
        distances
    }
}

/// Puts the leaf that is at `places[i]` at `i`, for all i.
fn reorder(leaves: &mut [Leaf], places: &[usize]) {
    let mut is_done = vec![false; places.len()];
    for start in 0..places.len() {
        let (first, mut to) = (leaves[start], start);
        // Each cycle of moves ends where it began.
        while !is_done[to] {
            is_done[to] = true;
            let from = places[to];
            leaves[to] = if from == start { first } else { leaves[from] };
            to = from;
        }
    }
}

impl SphereDistances {
    /// The field that holds the distances to a union.
    pub(super) fn field(&self, sphere: SphereUnion) -> &Field {
        &self.fields[self.index(sphere)]
    }

    /// The place of a union's field.
    fn index(&self, sphere: SphereUnion) -> usize {
        if self.fields.len() == 1 { 0 } else { sphere as usize }
    }

    /// Takes the same field by value, for its last use.
    pub(super) fn take(&mut self, sphere: SphereUnion) -> Field {
        let index = self.index(sphere);
        std::mem::take(&mut self.fields[index])
    }

    /// True if this is the last use of the union's field. The unions are used in the order S_0, S_max, S_min.
    fn is_last(&self, sphere: SphereUnion) -> bool {
        self.fields.len() > 1 || sphere == SphereUnion::Min
    }

    /// The value to subtract from the field so that it is negative inside the union.
    fn level(&self, sphere: SphereUnion, radii: Radii) -> f32 {
        match sphere {
            _ if self.fields.len() > 1 => 0.0,
            SphereUnion::Max => radii.max,
            SphereUnion::Init => radii.init,
            SphereUnion::Min => radii.min,
        }
    }

    /// The voxels inside a union.
    pub(super) fn inside(&self, sphere: SphereUnion, radii: Radii) -> Vec<LeafMask> {
        let limit = self.level(sphere, radii);
        let below = |leaf| simd::dispatch(Below { leaf, limit });
        self.field(sphere).leaves.par_iter().halved().map(below).collect()
    }

    /// Keeps only these leaves, in ascending order.
    pub(super) fn keep(&mut self, kept: &[usize]) {
        // Fields that were taken are empty.
        let fields = self.fields.iter_mut().filter(|field| !field.leaves.is_empty());
        fields.for_each(|field| keep(field, kept));
    }
}

// Distances to the nearest particle, leaf by leaf.
//
//   ┌────────┐          A particle lowers the values within its reach. Each row takes one dx² + dy²,
//   │ ▒▒▒    │          and then one sum and one minimum for its eight values.
//   │▒▒●▒▒   │
//   │ ▒▒▒    │          Particles that cannot lower any value are skipped: for each slab (the voxels with
//   └────────┘          the same x, y or z), the largest value so far is kept.
//
// Each leaf gathers from the particles around it, so no two threads write to the same memory, and the
// minimum does not depend on the order of the particles. The nearest leaves come first, so that the values
// soon become small enough to skip most of the remaining particles.

/// Distance value of voxels without a particle within reach.
pub(super) const OUT_OF_REACH: f32 = f32::INFINITY;

/// Appends the distances in voxels to the nearest particle in these leaves: [`OUT_OF_REACH`] for voxels farther
/// than `reach`, and 0 for `settled` voxels.
fn append_nearest_distances<'a>(
    field: &mut Field,
    packets: &ParticlePackets,
    leaves: &Topology,
    reach: f32,
    settled: impl Fn(IVec3) -> &'a LeafMask + Sync,
) {
    let steps = leaf_steps_within(reach);
    let nearest = |&origin: &IVec3| {
        let in_leaf = |&step: &IVec3| Some((step.as_vec3(), packets.in_leaf(origin + step)?));
        let around: Vec<(Vec3, &[Centers8])> = steps.iter().filter_map(in_leaf).collect();
        simd::dispatch(NearestDistances {
            around: &around,
            reach_squared: reach * reach,
            settled: settled(origin),
        })
    };
    let leaves = leaves.origins().par_iter().with_max_len(LEAVES_PER_TASK).halved().map(nearest);
    field.leaves.par_extend(leaves);
}

/// Eight particles of a leaf: x, y and z, relative to its origin. Unused lanes are infinite.
type Centers8 = [[f32; 8]; 3];

/// The particles of each leaf in packets of eight.
pub(super) struct ParticlePackets<'a> {
    topology: &'a Topology,
    /// Start of each leaf's packets; one entry more than there are leaves.
    starts: Vec<usize>,
    packets: Vec<Centers8>,
}

impl<'a> ParticlePackets<'a> {
    pub(super) fn new(bins: &'a ParticleBins) -> ParticlePackets<'a> {
        let leaf_count = bins.topology.len();
        let mut starts = vec![0; leaf_count + 1];
        for leaf in 0..leaf_count {
            starts[leaf + 1] = starts[leaf] + bins.in_leaf(leaf).len().div_ceil(8);
        }
        let mut packets = Vec::with_capacity(starts[leaf_count]);
        packets.extend((0..leaf_count).flat_map(|leaf| packets_of(bins.in_leaf(leaf))));
        ParticlePackets { topology: &bins.topology, starts, packets }
    }

    fn in_leaf(&self, origin: IVec3) -> Option<&[Centers8]> {
        let leaf = self.topology.find(origin)?;
        Some(&self.packets[self.starts[leaf]..self.starts[leaf + 1]])
    }
}

fn packets_of(locals: &[Vec3]) -> impl Iterator<Item = Centers8> {
    locals.chunks(8).map(|particles| {
        let mut eight = [[f32::INFINITY; 8]; 3];
        for (lane, particle) in particles.iter().enumerate() {
            eight.iter_mut().zip(particle.to_array()).for_each(|(axis, along)| axis[lane] = along);
        }
        eight
    })
}

/// Kernel: the distances of one leaf.
struct NearestDistances<'a> {
    /// The leaves around this one: the offset to each, and its particles.
    around: &'a [(Vec3, &'a [Centers8])],
    reach_squared: f32,
    settled: &'a LeafMask,
}

impl Kernel for NearestDistances<'_> {
    type Output = Leaf;

    #[inline(always)]
    fn run<V: Lanes>(self) -> Leaf {
        let mut squared = Leaf::splat(OUT_OF_REACH);
        for row in 0..64 {
            let settled = V::mask(self.settled.row(row));
            V::select(settled, V::splat(0.0), V::splat(OUT_OF_REACH)).store(squared.row_mut(row));
        }
        let mut limits = SlabLimits::new::<V>(&squared, self.reach_squared);
        let mut lowered_count = 0;
        for &(step, packets) in self.around {
            for eight in packets {
                for lane in SetBits(near_bits::<V>(eight, step, limits.greatest)) {
                    let local = Vec3::new(eight[0][lane & 7], eight[1][lane & 7], eight[2][lane & 7]);
                    lower_to_sphere::<V>(&mut squared, &limits, local + step);
                    lowered_count += 1;
                }
                // Updating the limits costs time, so it is done only now and then.
                if lowered_count >= LIMIT_PARTICLES {
                    limits = SlabLimits::new::<V>(&squared, self.reach_squared);
                    lowered_count = 0;
                }
            }
        }
        for row in 0..64 {
            let squared = squared.row_mut(row);
            let value = V::load(squared);
            let is_beyond = V::splat(self.reach_squared).lt(value);
            V::select(is_beyond, V::splat(OUT_OF_REACH), value.sqrt()).store(squared);
        }
        squared
    }
}

/// Number of particles after which the limits are updated.
const LIMIT_PARTICLES: usize = 32;

/// Bit mask of the eight particles within a squared distance of the box of a leaf's voxels.
#[inline(always)]
fn near_bits<V: Lanes>(eight: &Centers8, step: Vec3, limit: f32) -> u8 {
    let x = squares_beyond(V::load(&eight[0]).add(V::splat(step.x)));
    let y = squares_beyond(V::load(&eight[1]).add(V::splat(step.y)));
    let z = squares_beyond(V::load(&eight[2]).add(V::splat(step.z)));
    // Summed in the same order as distances, so that rounding never rejects a particle that lowers a value.
    V::bits(V::not(V::splat(limit).lt(x.add(y).add(z))))
}

/// For each slab of one x, one y or one z: a particle whose squared distance to the slab is greater than this
/// changes no value in it.
struct SlabLimits {
    along: [[f32; 8]; 3],
    /// The maximum of all limits.
    greatest: f32,
}

impl SlabLimits {
    #[inline(always)]
    fn new<V: Lanes>(squared: &Leaf, reach_squared: f32) -> SlabLimits {
        let mut along = [[0.0; 8]; 3];
        let zero = V::splat(0.0);
        let (mut of_y, mut of_z) = ([zero; 8], zero);
        for (x, along_x) in along[0].iter_mut().enumerate() {
            let mut of_x = zero;
            for (y, of_y) in of_y.iter_mut().enumerate() {
                let row = V::load(squared.row(x * 8 + y));
                of_x = of_x.max(row);
                *of_y = of_y.max(row);
            }
            of_z = of_z.max(of_x);
            *along_x = greatest(of_x);
        }
        for (y, of_y) in of_y.into_iter().enumerate() {
            along[1][y] = greatest(of_y);
        }
        of_z.store(&mut along[2]);
        for limits in &mut along {
            V::load(limits).min(V::splat(reach_squared)).store(limits);
        }
        SlabLimits { greatest: greatest(V::load(&along[2])), along }
    }
}

/// Takes the minimum of each squared distance and that to `position`, in the slabs where it can be lower.
#[inline(always)]
fn lower_to_sphere<V: Lanes>(squared: &mut Leaf, limits: &SlabLimits, position: Vec3) {
    let least_x = squares_beyond(V::splat(position.x));
    let least_y = squares_beyond(V::splat(position.y));
    let least_z = squares_beyond(V::splat(position.z));
    let (dx, dy, dz) = (squares::<V>(position.x), squares::<V>(position.y), squares::<V>(position.z));
    // Summed in the same order as distances, so that rounding never rejects a slab in which the particle
    // lowers a value.
    let slabs = is_within(dx.add(least_y).add(least_z), &limits.along[0]);
    let is_within_y = is_within(least_x.add(dy).add(least_z), &limits.along[1]) != 0;
    if !is_within_y || is_within(least_x.add(least_y).add(dz), &limits.along[2]) == 0 {
        return;
    }
    let (mut along_x, mut along_y) = ([0.0; 8], [0.0; 8]);
    dx.store(&mut along_x);
    dy.store(&mut along_y);
    for x in SetBits(slabs) {
        // Updates all rows of a slab: selecting rows would take longer.
        for (y, along_y) in along_y.iter().enumerate() {
            let row = squared.row_mut((x & 7) * 8 + y);
            let across = V::splat(along_x[x & 7] + along_y);
            across.add(dz).min(V::load(row)).store(row);
        }
    }
}

/// Bit mask of the slabs whose minimum squared distance is within the limit.
#[inline(always)]
fn is_within<V: Lanes>(least: V, limits: &[f32; 8]) -> u8 {
    V::bits(V::not(V::load(limits).lt(least)))
}

/// Along one axis, the squared distances from a leaf's voxels to `along`.
#[inline(always)]
fn squares<V: Lanes>(along: f32) -> V {
    let apart = V::load(&[0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0]).sub(V::splat(along));
    apart.mul(apart)
}

/// Along one axis, the squared distance to the leaf's range of voxels, 0 inside. For eight positions at once.
#[inline(always)]
fn squares_beyond<V: Lanes>(along: V) -> V {
    let beyond_leaf = along.sub(along.max(V::splat(0.0)).min(V::splat((LEAF_EDGE - 1) as f32)));
    beyond_leaf.mul(beyond_leaf)
}

// Turns distances to the nearest center into the signed distance to a union of spheres.
//
//    nearest − r       known: outside, and inside next to an outside voxel
//   ────╮              swept: deeper inside, where the nearest center does not determine the depth,
//       ╰──╮                  and beyond the reach of distances
//   swept  ╰──────

/// The signed distance to one of the unions, swept up to `reach` voxels; values beyond it are only
/// approximate, or infinite. The last union that needs a field of distances reuses its memory, so request the unions in
/// the order S_0, S_max, S_min. `scratch` is memory for the sweeps: a field with arbitrary content.
pub(super) fn signed_distance(
    topology: &Topology,
    distances: &mut SphereDistances,
    sphere: SphereUnion,
    radii: Radii,
    reach: f32,
    scratch: &mut Field,
) -> Field {
    let level = distances.level(sphere, radii);
    let known = known_voxels(topology, distances, sphere, radii);
    let mut field = if distances.is_last(sphere) {
        let mut field = distances.take(sphere);
        field.leaves.par_iter_mut().zip(&known).halved().for_each(|(leaf, known)| {
            *leaf = simd::dispatch(SignedDistance { values: leaf, known, level });
        });
        field
    } else {
        let of_leaf = |(values, known)| simd::dispatch(SignedDistance { values, known, level });
        let leaves = distances.field(sphere).leaves.par_iter().zip(&known).halved().map(of_leaf).collect();
        Field { leaves }
    };
    let sweeps = Sweeps::accurate(sweep_count(reach)).clamped(reach);
    extend_in(topology, &mut field, &known, sweeps, scratch);
    field
}

/// The voxels whose signed distance is known. A missing neighbor leaf counts as lying on the same side of the
/// surface.
fn known_voxels(
    topology: &Topology,
    distances: &SphereDistances,
    sphere: SphereUnion,
    radii: Radii,
) -> Vec<LeafMask> {
    let inside = distances.inside(sphere, radii);
    let values = distances.field(sphere);
    let of_side = |mut side: LeafMask, leaf: usize, of: &dyn Fn(u32) -> LeafMask| {
        let faces = topology.neighbors()[leaf].map(of);
        side.remove_all(&side.surrounded(faces.each_ref()));
        side
    };
    let known = |leaf: usize| {
        let adjacent = of_side(inside[leaf], leaf, &|neighbor| match neighbor {
            NO_LEAF => LeafMask::FULL,
            neighbor => inside[neighbor as usize],
        });
        let outside = |leaf: usize| inside[leaf].complement();
        let known_outside = if distances.is_exact_outside {
            let mut within_reach = simd::dispatch(Below { leaf: &values.leaves[leaf], limit: OUT_OF_REACH });
            within_reach.remove_all(&inside[leaf]);
            within_reach
        } else {
            of_side(outside(leaf), leaf, &|neighbor| match neighbor {
                NO_LEAF => LeafMask::FULL,
                neighbor => outside(neighbor as usize),
            })
        };
        adjacent.or(&known_outside)
    };
    (0..topology.len()).into_par_iter().halved().map(known).collect()
}

/// Kernel: the voxels with a value below a limit.
struct Below<'a> {
    pub(super) leaf: &'a Leaf,
    pub(super) limit: f32,
}

impl Kernel for Below<'_> {
    type Output = LeafMask;

    #[inline(always)]
    fn run<V: Lanes>(self) -> LeafMask {
        let limit = V::splat(self.limit);
        let mut below = LeafMask::EMPTY;
        for (x, word) in below.words.iter_mut().enumerate() {
            let mut rows = [0; 8];
            for (y, bits) in rows.iter_mut().enumerate() {
                *bits = V::bits(V::load(self.leaf.row(x * 8 + y)).lt(limit));
            }
            *word = u64::from_le_bytes(rows);
        }
        below
    }
}

/// Kernel: signed distances of the voxels where they are known, and the sign of the others.
struct SignedDistance<'a> {
    values: &'a Leaf,
    known: &'a LeafMask,
    level: f32,
}

impl Kernel for SignedDistance<'_> {
    type Output = Leaf;

    #[inline(always)]
    fn run<V: Lanes>(self) -> Leaf {
        let level = V::splat(self.level);
        let mut leaf = Leaf::splat(0.0);
        for row in 0..ROW_COUNT {
            let values = V::load(self.values.row(row));
            // Infinite values are outside, too: no particle is within the reach of distances.
            let side = V::select(values.lt(level), V::splat(-UNREACHED), V::splat(UNREACHED));
            let is_known = V::mask(self.known.row(row));
            V::select(is_known, values.sub(level), side).store(leaf.row_mut(row));
        }
        leaf
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::grid::voxel_in_leaf;
    use crate::simd::{SimdLevel, dispatch_at};

    /// Reference implementation, directly from the definition.
    fn expected(particles: &[Vec3], reach: f32, settled: &LeafMask) -> Leaf {
        let mut leaf = Leaf::splat(0.0);
        for offset in (0..512).filter(|&offset| !settled.contains(offset)) {
            let squared = |position: &Vec3| {
                let apart = voxel_in_leaf(offset).as_vec3() - position;
                apart.x * apart.x + apart.y * apart.y + apart.z * apart.z
            };
            let least = particles.iter().map(squared).fold(f32::INFINITY, f32::min);
            leaf.values[offset] = if least <= reach * reach { least.sqrt() } else { OUT_OF_REACH };
        }
        leaf
    }

    #[test]
    fn nearest_distances_match_brute_force() {
        let mut state = 1u32;
        let mut random = || {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (state >> 8) as f32 / (1 << 24) as f32
        };
        let some = LeafMask::from_fn(|offset| offset % 7 == 0 || offset < 100);
        for (count, reach) in [(0, 5.5), (1, 5.464), (3, 2.0), (40, 5.464), (900, 5.464), (60, 12.0)] {
            let steps = leaf_steps_within(reach);
            let local = |random: &mut dyn FnMut() -> f32| Vec3::new(random(), random(), random()) * 8.0;
            let around: Vec<(Vec3, Vec<Vec3>)> = steps
                .iter()
                .map(|step| (step.as_vec3(), (0..count).map(|_| local(&mut random)).collect()))
                .collect();
            let all: Vec<Vec3> = around
                .iter()
                .flat_map(|(step, locals)| locals.iter().map(move |&local| local + step))
                .collect();
            let packets: Vec<(Vec3, Vec<Centers8>)> =
                around.iter().map(|(step, locals)| (*step, packets_of(locals).collect())).collect();
            let around: Vec<(Vec3, &[Centers8])> =
                packets.iter().map(|(step, packets)| (*step, packets.as_slice())).collect();
            for settled in [&LeafMask::EMPTY, &some] {
                let expected = expected(&all, reach, settled).values.map(f32::to_bits);
                for level in SimdLevel::ALL {
                    let nearest = NearestDistances { around: &around, reach_squared: reach * reach, settled };
                    let found = dispatch_at(level, nearest).values.map(f32::to_bits);
                    assert_eq!(found, expected, "{count} particles a leaf within {reach}, {level:?}");
                }
            }
        }
    }

    #[test]
    fn leaf_steps_are_sorted_by_distance() {
        let steps = leaf_steps_within(5.464);
        assert_eq!((steps.len(), steps[0]), (27, IVec3::ZERO));
        assert!(steps[1..7].iter().all(|step| step.length_squared() == 64));
    }
}
