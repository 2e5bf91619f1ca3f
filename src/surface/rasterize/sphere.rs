//! Distances to the nearest particle, leaf by leaf.
//!
//! ```text
//!   ┌────────┐          A particle lowers what is in its reach: each row has one dx² + dy², and then there
//!   │ ▒▒▒    │          is one sum and one minimum for its eight values.
//!   │▒▒●▒▒   │
//!   │ ▒▒▒    │          What is nowhere farther from the particles seen so far than from this one is passed
//!   └────────┘          by: for each x, y and z the greatest distance of its slab is kept.
//! ```
//!
//! Each leaf gathers from the particles around it, so no two threads write to one place, and the
//! least distance does not depend on the order of particles. They come nearest leaves first: what is
//! between particles then soon passes by the others.

use glam::{IVec3, Vec3};
use rayon::prelude::*;

use super::bin::ParticleBins;
use crate::surface::grid::{Bits, Field, LEAF_EDGE, Leaf, LeafMask, Topology, leaf_steps_within};
use crate::surface::simd::{self, Kernel, Lanes};

/// In place of a distance: no particle is within reach.
pub(super) const OUT_OF_REACH: f32 = f32::INFINITY;

/// Distances in voxels to the nearest particle, for all of these leaves; [`OUT_OF_REACH`] for the voxels that
/// are farther than `reach`, and 0 for those that are `settled`. What is `known` of a leaf already is copied.
pub(super) fn nearest_distances<'a>(
    eights: &Eights,
    leaves: &Topology,
    reach: f32,
    settled: impl Fn(IVec3) -> &'a LeafMask + Sync,
    known: impl Fn(IVec3) -> Option<&'a Leaf> + Sync,
) -> Field {
    let steps = leaf_steps_within(reach);
    let nearest = |&origin: &IVec3| {
        if let Some(leaf) = known(origin) {
            return *leaf;
        }
        let in_leaf = |&step: &IVec3| Some((step.as_vec3(), eights.in_leaf(origin + step)?));
        let around: Vec<(Vec3, &[Eight])> = steps.iter().filter_map(in_leaf).collect();
        simd::dispatch(Nearest { around: &around, reach_squared: reach * reach, settled: settled(origin) })
    };
    Field { leaves: leaves.origins().par_iter().map(nearest).collect() }
}

/// Eight particles of a leaf: x, y and z, relative to its origin. Infinite where there are fewer.
type Eight = [[f32; 8]; 3];

/// The particles of each leaf by eights.
pub(super) struct Eights<'a> {
    topology: &'a Topology,
    /// Where each leaf's start; one more entry than leaves.
    starts: Vec<usize>,
    eights: Vec<Eight>,
}

impl<'a> Eights<'a> {
    pub(super) fn new(bins: &'a ParticleBins) -> Eights<'a> {
        let leaf_count = bins.topology.len();
        let mut starts = vec![0; leaf_count + 1];
        for leaf in 0..leaf_count {
            starts[leaf + 1] = starts[leaf] + bins.in_leaf(leaf).len().div_ceil(8);
        }
        let mut eights = Vec::with_capacity(starts[leaf_count]);
        eights.extend((0..leaf_count).flat_map(|leaf| by_eights(bins.in_leaf(leaf))));
        Eights { topology: &bins.topology, starts, eights }
    }

    fn in_leaf(&self, origin: IVec3) -> Option<&[Eight]> {
        let leaf = self.topology.find(origin)?;
        Some(&self.eights[self.starts[leaf]..self.starts[leaf + 1]])
    }
}

fn by_eights(locals: &[Vec3]) -> impl Iterator<Item = Eight> {
    locals.chunks(8).map(|particles| {
        let mut eight = [[f32::INFINITY; 8]; 3];
        for (place, particle) in particles.iter().enumerate() {
            eight.iter_mut().zip(particle.to_array()).for_each(|(axis, along)| axis[place] = along);
        }
        eight
    })
}

/// The distances of one leaf.
struct Nearest<'a> {
    /// Leaves around it, by the step to them, and their particles.
    around: &'a [(Vec3, &'a [Eight])],
    reach_squared: f32,
    settled: &'a LeafMask,
}

impl Kernel for Nearest<'_> {
    type Output = Leaf;

    #[inline(always)]
    fn run<V: Lanes>(self) -> Leaf {
        let mut squared = Leaf::splat(OUT_OF_REACH);
        for row in 0..64 {
            let settled = V::mask(self.settled.row(row));
            V::select(settled, V::splat(0.0), V::splat(OUT_OF_REACH)).store(squared.row_mut(row));
        }
        let mut limits = Limits::new::<V>(&squared, self.reach_squared);
        let mut lowered_count = 0;
        for &(step, eights) in self.around {
            for eight in eights {
                for place in Bits(near_bits::<V>(eight, step, limits.greatest)) {
                    let local = Vec3::new(eight[0][place & 7], eight[1][place & 7], eight[2][place & 7]);
                    lower_to_sphere::<V>(&mut squared, &limits, local + step);
                    lowered_count += 1;
                }
                // Looked at again how far the farthest are: worth the while only now and then.
                if lowered_count >= LIMIT_PARTICLES {
                    limits = Limits::new::<V>(&squared, self.reach_squared);
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

/// Particles after which the limits are found again.
const LIMIT_PARTICLES: usize = 32;

/// Which of eight particles are no farther than a squared distance from the box of a leaf's voxels.
#[inline(always)]
fn near_bits<V: Lanes>(eight: &Eight, step: Vec3, limit: f32) -> u8 {
    let x = squares_aside(V::load(&eight[0]).add(V::splat(step.x)));
    let y = squares_aside(V::load(&eight[1]).add(V::splat(step.y)));
    let z = squares_aside(V::load(&eight[2]).add(V::splat(step.z)));
    // Summed as distances are, so that rounding takes none for farther than its values.
    V::bits(V::not(V::splat(limit).lt(x.add(y).add(z))))
}

/// For the voxels of each x, of each y and of each z the squared distance from which on a particle changes
/// nothing.
struct Limits {
    along: [[f32; 8]; 3],
    /// The greatest of them all.
    greatest: f32,
}

impl Limits {
    #[inline(always)]
    fn new<V: Lanes>(squared: &Leaf, reach_squared: f32) -> Limits {
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
        Limits { greatest: greatest(V::load(&along[2])), along }
    }
}

/// The greatest of eight values that are not negative.
#[inline(always)]
pub(super) fn greatest<V: Lanes>(values: V) -> f32 {
    let mut row = [0.0; 8];
    values.store(&mut row);
    let mut greatest = 0.0;
    for value in row {
        greatest = if value > greatest { value } else { greatest };
    }
    greatest
}

/// Takes the lesser of each squared distance and that to `position`, in the slabs where it may be the lesser.
#[inline(always)]
fn lower_to_sphere<V: Lanes>(squared: &mut Leaf, limits: &Limits, position: Vec3) {
    let least_x = squares_aside(V::splat(position.x));
    let least_y = squares_aside(V::splat(position.y));
    let least_z = squares_aside(V::splat(position.z));
    let (dx, dy, dz) = (squares::<V>(position.x), squares::<V>(position.y), squares::<V>(position.z));
    // Summed as distances are, so that rounding takes nothing for farther than its values.
    let slabs = is_within(dx.add(least_y).add(least_z), &limits.along[0]);
    let is_within_y = is_within(least_x.add(dy).add(least_z), &limits.along[1]) != 0;
    if !is_within_y || is_within(least_x.add(least_y).add(dz), &limits.along[2]) == 0 {
        return;
    }
    let (mut along_x, mut along_y) = ([0.0; 8], [0.0; 8]);
    dx.store(&mut along_x);
    dy.store(&mut along_y);
    for x in Bits(slabs) {
        // All rows of a slab: to pick some takes longer.
        for (y, along_y) in along_y.iter().enumerate() {
            let row = squared.row_mut((x & 7) * 8 + y);
            let across = V::splat(along_x[x & 7] + along_y);
            across.add(dz).min(V::load(row)).store(row);
        }
    }
}

/// Where the least squared distance is not beyond the limit.
#[inline(always)]
fn is_within<V: Lanes>(least: V, limits: &[f32; 8]) -> u8 {
    V::bits(V::not(V::load(limits).lt(least)))
}

/// Along one axis, the squares of the distances from a leaf's voxels to a place.
#[inline(always)]
fn squares<V: Lanes>(along: f32) -> V {
    let apart = V::load(&[0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0]).sub(V::splat(along));
    apart.mul(apart)
}

/// The least of them: 0 between the first voxel and the last. For eight places at once.
#[inline(always)]
fn squares_aside<V: Lanes>(along: V) -> V {
    let aside = along.sub(along.max(V::splat(0.0)).min(V::splat((LEAF_EDGE - 1) as f32)));
    aside.mul(aside)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::surface::grid::voxel_in_leaf;
    use crate::surface::simd::{Level, dispatch_at};

    /// By the definition.
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
    fn distances_are_those_to_the_nearest_particle() {
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
            let eights: Vec<(Vec3, Vec<Eight>)> =
                around.iter().map(|(step, locals)| (*step, by_eights(locals).collect())).collect();
            let around: Vec<(Vec3, &[Eight])> =
                eights.iter().map(|(step, eights)| (*step, eights.as_slice())).collect();
            for settled in [&LeafMask::EMPTY, &some] {
                let expected = expected(&all, reach, settled).values.map(f32::to_bits);
                for level in Level::ALL {
                    let nearest = Nearest { around: &around, reach_squared: reach * reach, settled };
                    let found = dispatch_at(level, nearest).values.map(f32::to_bits);
                    assert_eq!(found, expected, "{count} particles a leaf within {reach}, {level:?}");
                }
            }
        }
    }

    #[test]
    fn the_nearest_leaves_come_first() {
        let steps = leaf_steps_within(5.464);
        assert_eq!((steps.len(), steps[0]), (27, IVec3::ZERO));
        assert!(steps[1..7].iter().all(|step| step.length_squared() == 64));
    }
}
