//! Distances to the nearest particle, leaf by leaf.
//!
//! ```text
//!   ┌────────┐          A particle lowers what is in its reach: for each slab of one x
//!   │ ▒▒▒    │          dx² is one number, for each row dx² + dy², and then there is
//!   │▒▒●▒▒   │          one sum and one minimum for the eight values of a row.
//!   │ ▒▒▒    │          A slab that is nowhere farther from the particles seen so far
//!   └────────┘          than it is from this one is passed by.
//! ```
//!
//! Each leaf gathers from the particles around it, so no two threads write to one place, and the
//! least distance does not depend on the order of particles. They come nearest leaves first: what is
//! between particles then soon passes by the others.

use glam::{IVec3, Vec3};
use rayon::prelude::*;

use super::bin::ParticleBins;
use crate::grid::{Field, LEAF_EDGE, Leaf, LeafMask, Topology};
use crate::simd::{self, Kernel, Lanes};

/// In place of a distance: no particle is within reach.
pub(super) const OUT_OF_REACH: f32 = f32::INFINITY;

/// Distances in voxels to the nearest particle, for all of these leaves; [`OUT_OF_REACH`] for the voxels that
/// are farther than `reach`, and 0 for those that are `settled`. What is `known` of a leaf already is copied.
pub(super) fn nearest_distances<'a>(
    bins: &ParticleBins,
    leaves: &Topology,
    reach: f32,
    settled: impl Fn(IVec3) -> &'a LeafMask + Sync,
    known: impl Fn(IVec3) -> Option<&'a Leaf> + Sync,
) -> Field {
    let steps = ring_steps(reach);
    let nearest = |&origin: &IVec3| {
        if let Some(leaf) = known(origin) {
            return *leaf;
        }
        let around: Vec<(Vec3, &[Vec3])> = steps
            .iter()
            .filter_map(|&step| Some((step.as_vec3(), bins.in_leaf(bins.topology.find(origin + step)?))))
            .collect();
        simd::dispatch(Nearest { around: &around, reach_squared: reach * reach, settled: settled(origin) })
    };
    Field { leaves: leaves.origins().par_iter().map(nearest).collect() }
}

/// Steps to all leaves that may hold a particle within reach of a leaf's voxels, the leaf itself included,
/// the nearest first.
pub(super) fn ring_steps(reach: f32) -> Vec<IVec3> {
    let rings = (reach / LEAF_EDGE as f32).ceil() as i32;
    let axis = || -rings..=rings;
    let mut steps: Vec<IVec3> =
        axis().flat_map(|x| axis().flat_map(move |y| axis().map(move |z| IVec3::new(x, y, z)))).collect();
    steps.sort_by_key(|step| step.length_squared());
    steps.into_iter().map(|step| step * LEAF_EDGE).collect()
}

/// The distances of one leaf.
struct Nearest<'a> {
    /// Leaves around it, by the step to them, and their particles.
    around: &'a [(Vec3, &'a [Vec3])],
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
        let mut limits = limits::<V>(&squared, self.reach_squared);
        let mut seen_count = 0;
        for &(step, particles) in self.around {
            for &local in particles {
                lower_to_sphere::<V>(&mut squared, &limits, local + step);
            }
            seen_count += particles.len();
            // Worth the while only now and then.
            if seen_count >= LIMIT_PARTICLES {
                limits = self::limits::<V>(&squared, self.reach_squared);
                seen_count = 0;
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

/// Particles after which it is looked at again how far the farthest are.
const LIMIT_PARTICLES: usize = 32;

/// For each slab the squared distance from which on a particle changes nothing.
#[inline(always)]
fn limits<V: Lanes>(squared: &Leaf, reach_squared: f32) -> [f32; 8] {
    let mut limits = [0f32; 8];
    for (x, limit) in limits.iter_mut().enumerate() {
        let mut greatest = V::load(squared.row(x * 8));
        for y in 1..8 {
            greatest = greatest.max(V::load(squared.row(x * 8 + y)));
        }
        let mut row = [0.0; 8];
        greatest.store(&mut row);
        for value in row {
            *limit = if value > *limit { value } else { *limit };
        }
        *limit = limit.min(reach_squared);
    }
    limits
}

/// Takes the lesser of each squared distance and that to `position`, in the slabs where it may be the lesser.
#[inline(always)]
fn lower_to_sphere<V: Lanes>(squared: &mut Leaf, limits: &[f32; 8], position: Vec3) {
    let (least_y, least_z) = (square_aside(position.y), square_aside(position.z));
    let (dx, dz) = (squares::<V>(position.x), squares::<V>(position.z));
    // Summed as distances are, so that rounding takes no slab for farther than its values.
    let nearest = dx.add(V::splat(least_y)).add(V::splat(least_z));
    let mut slabs = V::bits(V::not(V::load(limits).lt(nearest)));
    if slabs == 0 {
        return;
    }
    let (mut along_x, mut along_y) = ([0.0; 8], [0.0; 8]);
    dx.store(&mut along_x);
    squares::<V>(position.y).store(&mut along_y);
    while slabs != 0 {
        let x = slabs.trailing_zeros() as usize & 7;
        slabs &= slabs - 1;
        for y in 0..8 {
            let row = squared.row_mut(x * 8 + y);
            let across = V::splat(along_x[x] + along_y[y]);
            across.add(dz).min(V::load(row)).store(row);
        }
    }
}

/// Along one axis, the squares of the distances from a leaf's voxels to a place.
#[inline(always)]
fn squares<V: Lanes>(along: f32) -> V {
    let apart = V::load(&[0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0]).sub(V::splat(along));
    apart.mul(apart)
}

/// The least of them, if it is that of the first or the last voxel, and 0 between.
#[inline(always)]
fn square_aside(along: f32) -> f32 {
    let aside = along - along.clamp(0.0, (LEAF_EDGE - 1) as f32);
    aside * aside
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::grid::voxel_in_leaf;
    use crate::simd::{Level, dispatch_at};

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
            let steps = ring_steps(reach);
            let local = |random: &mut dyn FnMut() -> f32| Vec3::new(random(), random(), random()) * 8.0;
            let around: Vec<(Vec3, Vec<Vec3>)> = steps
                .iter()
                .map(|step| (step.as_vec3(), (0..count).map(|_| local(&mut random)).collect()))
                .collect();
            let all: Vec<Vec3> = around
                .iter()
                .flat_map(|(step, locals)| locals.iter().map(move |&local| local + step))
                .collect();
            let around: Vec<(Vec3, &[Vec3])> =
                around.iter().map(|(step, locals)| (*step, locals.as_slice())).collect();
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
        let steps = ring_steps(5.464);
        assert_eq!((steps.len(), steps[0]), (27, IVec3::ZERO));
        assert!(steps[1..7].iter().all(|step| step.length_squared() == 64));
    }
}
