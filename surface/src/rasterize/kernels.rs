//! The smooth start: the level of a sum of normalized kernels, and bounds around it.
//!
//! ```text
//!    F      ╭──╮        F(x) = Σ w K(q), q = |T(x − p)| / r_max
//!          ╱    ╲
//!   ─ ─ ─ ╱─ ─ ─ ╲─ ─   the level: the initial surface
//!   ─────╯        ╰──
//! ```
//!
//! A particle's weight w is one over the sum of the kernels at the particle, its own included. So F is about 1
//! in a body, and reaches the level at the same distance from every lone particle; near particles share a
//! smooth waist.
//!
//! F falls from 1 to 0 along a curve. Solving K(q) = F for q makes it a line: around a lone particle, φ̃ =
//! r_max (q(F) − q(level)) is the distance. Dividing φ̃ by the length of its gradient, which is one Newton
//! step, gives the distance of the voxels next to the surface everywhere; the others are swept.
//!
//! The start also contains a ball of r_min, one voxel, around each particle. So every particle is next to a voxel
//! inside, whatever the sum of the kernels is.
//!
//! The surface may move outward by a fixed distance, where a kernel reaches, and inward by the mean of the distances
//! that the particles around it allow: nearly 0 in thin fluid, more in bodies. The small balls stay inside.
//!
//! This is based on:
//! Jihun Yu and Greg Turk. Reconstructing surfaces of particle-based fluids using anisotropic kernels. 2013
//! Yongning Zhu and Robert Bridson. Animating sand as a fluid. 2005

use glam::Vec3;
use rayon::prelude::*;

use super::BOUND_REACH;
use super::distances::OUT_OF_REACH;
use super::ellipsoid::{
    LEAF, NearbyLeaf, ParticleShape, Primitive, RowForm, Unions, bits_of, length_squared, near_bits, offsets,
    voxels_within,
};
use crate::grid::{Field, LEAF_EDGE, Leaf, LeafMask, ROW_COUNT, SetBits};
use crate::parallel::Loops as _;
use crate::particles::{Ellipsoid, LEVEL, LEVEL_AT, inverse_kernel, kernel};
use crate::simd::{self, Kernel, Lanes};

/// No point of the initial surface is farther from the nearest particle, in units of its kernel's reach: farther away the
/// sum is below the level for weights of up to 35 in all, which are more than those of any fluid.
pub(super) const REACH: f32 = 0.9;

/// The room at voxels that are certainly inside, in voxels: more than bounds reach. Their distance to the
/// nearest centre is not computed, either: it is a large number, which sets no bound.
const SETTLED_ROOM: f32 = 4.0;

/// The kernel of one particle.
#[derive(Clone, Copy, Debug)]
pub(super) struct KernelShape {
    ellipsoid: Ellipsoid,
    row_form: RowForm,
    is_ball: bool,
}

impl KernelShape {
    pub(super) fn new(ellipsoid: Ellipsoid) -> KernelShape {
        let [xx, yy, zz, xy, xz, yz] = ellipsoid.to_unit_ball;
        let is_ball = xx == yy && yy == zz && [xy, xz, yz] == [0.0; 3];
        KernelShape { row_form: RowForm::of(&ellipsoid), is_ball, ellipsoid }
    }
}

/// Sums over the particles that were added.
pub(super) struct KernelSums {
    settled: LeafMask,
    /// The squared distance to the nearest centre, where it is small enough for a bound.
    nearest: Leaf,
    /// Σ w K.
    value: Leaf,
    /// Σ w K times the room inward.
    room: Leaf,
}

impl ParticleShape for KernelShape {
    #[inline(always)]
    fn longest(&self) -> f32 {
        self.ellipsoid.longest
    }

    fn shortest(&self) -> f32 {
        self.ellipsoid.inner_radius()
    }

    fn extents(&self, outermost: f32) -> Vec3 {
        outermost * self.ellipsoid.extents()
    }

    type State = KernelSums;

    #[inline(always)]
    fn start<V: Lanes>(_: &Unions, settled: &LeafMask, _: &[NearbyLeaf<KernelShape>]) -> KernelSums {
        let zero = Leaf::splat(0.0);
        KernelSums { settled: *settled, nearest: Leaf::splat(f32::MAX), value: zero, room: zero }
    }

    #[inline(always)]
    fn add<V: Lanes>(&self, unions: &Unions, sums: &mut KernelSums, center: Vec3, extents: Vec3) {
        let KernelShape { ellipsoid: Ellipsoid { to_unit_ball, weight, room, .. }, row_form, is_ball } = self;
        let per_reach = 1.0 / unions.radii[0];
        let reach_squared = V::splat(unions.radii[0] * unions.radii[0]);
        let [xx, yy, zz, xy, xz, yz] = to_unit_ball.map(|entry| entry * per_reach);
        let dz = offsets::<V>(center.z);
        let (along_x, along_y, along_z) = (V::splat(xz).mul(dz), V::splat(yz).mul(dz), V::splat(zz).mul(dz));
        let dz_squared = dz.mul(dz);
        let [of_value, of_room] = [*weight, weight * room].map(V::splat);
        let dy_of_rows = offsets::<V>(center.y);
        let is_within_y = bits_of(voxels_within(center.y, extents.y));
        for x in voxels_within(center.x, extents.x) {
            let dx = x as f32 - center.x;
            let is_beyond = V::bits(reach_squared.lt(row_form.least_squared::<V>(dx, dy_of_rows)));
            for y in SetBits(is_within_y & !is_beyond) {
                let (row, dy) = (x * 8 + y, y as f32 - center.y);
                if sums.settled.row(row) == u8::MAX {
                    continue;
                }
                let q_squared = if *is_ball {
                    V::splat(dx * dx + dy * dy).add(dz_squared).mul(V::splat(xx * xx))
                } else {
                    let at = Vec3::new(xx * dx + xy * dy, xy * dx + yy * dy, xz * dx + yz * dy);
                    let (tx, ty) = (V::splat(at.x).add(along_x), V::splat(at.y).add(along_y));
                    length_squared(tx, ty, V::splat(at.z).add(along_z))
                };
                let kernel = kernel(q_squared);
                let [value, room] = [&mut sums.value, &mut sums.room].map(|leaf| leaf.row_mut(row));
                V::load(value).add(kernel.mul(of_value)).store(value);
                V::load(room).add(kernel.mul(of_room)).store(room);
            }
        }
        let measured = unions.radii[2] + BOUND_REACH;
        for x in voxels_within(center.x, measured) {
            let dx = x as f32 - center.x;
            for y in voxels_within(center.y, measured) {
                let (row, dy) = (x * 8 + y, y as f32 - center.y);
                if sums.settled.row(row) == u8::MAX {
                    continue;
                }
                let nearest = sums.nearest.row_mut(row);
                V::splat(dx * dx + dy * dy).add(dz_squared).min(V::load(nearest)).store(nearest);
            }
        }
    }

    /// Writes the distance to the nearest centre, φ̃, and the room inward. The distance is infinite where no
    /// kernel reaches, and large where it sets no bound.
    #[inline(always)]
    fn finish<V: Lanes>(unions: &Unions, sums: &KernelSums, [nearest, start, room]: [&mut Leaf; 3]) {
        let (reach, level_at) = (V::splat(unions.radii[0]), V::splat(LEVEL_AT));
        for row in 0..ROW_COUNT {
            let is_settled = V::mask(sums.settled.row(row));
            let value = V::select(is_settled, V::splat(1.0), V::load(sums.value.row(row)));
            let is_reached = V::splat(0.0).lt(value);
            let distance = V::load(sums.nearest.row(row)).sqrt();
            let measured = V::select(is_settled, V::splat(f32::MAX), distance);
            V::select(is_reached, measured, V::splat(OUT_OF_REACH)).store(nearest.row_mut(row));
            let of_ball = distance.sub(V::splat(unions.radii[2]));
            inverse_kernel(value).sub(level_at).mul(reach).min(of_ball).store(start.row_mut(row));
            let mean = V::load(sums.room.row(row)).div(value.max(V::splat(f32::MIN_POSITIVE)));
            V::select(is_settled, V::splat(SETTLED_ROOM), mean).store(room.row_mut(row));
        }
    }
}

/// Kernel: whether F is high at points of a leaf. If it is so in the leaves around, too, F is taken to be above the level
/// in and next to the leaf, and fields of the interior of a body are not stored.
///
/// ```text
///   ×   ×   ×      If F is at the level in the centre of a void, it grows by about 15/R² F r²/2 within a distance of r,
///                  because the particles around the void are so near that their sum is at the level. R is the
///   ×   ×   ×      shortest reach of a particle that reaches the leaf.
/// ```
///
/// This is an estimate for even bodies: bubbles of all sizes, in lattices and in random particles, are far below
/// `HIGH` at some point (`interiors_of_bodies_are_skipped_and_no_bubble_is`).
pub(super) struct High<'a> {
    pub(super) around: &'a [NearbyLeaf<'a, KernelShape>],
    pub(super) unions: &'a Unions,
}

/// F at the points. In an even body it is from 0.9 to 1.1, and larger where particles are irregular.
const HIGH: f32 = 0.85;

/// The number of points across a leaf along x and y that kernels with this reach need, with one for each voxel along
/// z; `None` if that is more than there are voxels.
pub(super) fn points_across(reach: f32) -> Option<usize> {
    // F grows from the level to `HIGH` within this distance, less half a voxel along z.
    let apart_squared = 2.0 / 15.0 * (HIGH / LEVEL - 1.0) * reach * reach - 0.25;
    let count = (LEAF_EDGE as f32 / (2.0 * apart_squared.max(0.0)).sqrt()).ceil();
    (count <= LEAF_EDGE as f32).then_some(count as usize)
}

impl Kernel for High<'_> {
    type Output = bool;

    #[inline(always)]
    fn run<V: Lanes>(self) -> bool {
        let mut shortest = f32::INFINITY;
        for leaf in self.around {
            for (eight, boxes) in leaf.boxes.iter().enumerate() {
                for lane in SetBits(near_bits::<V>(boxes, leaf.step, &LEAF)) {
                    shortest = shortest.min(leaf.primitives[8 * eight + lane].shape.shortest());
                }
            }
        }
        let reach = self.unions.radii[0];
        let Some(count) = points_across(reach * shortest).filter(|_| shortest.is_finite()) else {
            return false;
        };
        let step = LEAF_EDGE as f32 / count as f32;
        let (per_reach, reach_squared) = (1.0 / reach, V::splat(reach * reach));
        let place = |index: usize| step * (index as f32 + 0.5) - 0.5;
        let y_of_rows = V::load(&std::array::from_fn(place));
        let mut sums = [[0.0; 8]; 64];
        for leaf in self.around {
            for (eight, boxes) in leaf.boxes.iter().enumerate() {
                for lane in SetBits(near_bits::<V>(boxes, leaf.step, &LEAF)) {
                    let Primitive { center, extents, shape } = &leaf.primitives[8 * eight + lane];
                    let center = center + leaf.step;
                    let Ellipsoid { to_unit_ball, weight, .. } = shape.ellipsoid;
                    let [xx, yy, zz, xy, xz, yz] = to_unit_ball.map(|entry| entry * per_reach);
                    let dz = offsets::<V>(center.z);
                    let (along_x, along_y, along_z) =
                        (V::splat(xz).mul(dz), V::splat(yz).mul(dz), V::splat(zz).mul(dz));
                    let dy_of_rows = y_of_rows.sub(V::splat(center.y));
                    for x in 0..count {
                        let dx = place(x) - center.x;
                        if dx.abs() > extents.x {
                            continue;
                        }
                        let least = shape.row_form.least_squared::<V>(dx, dy_of_rows);
                        let is_within = V::bits(least.lt(reach_squared)) & bits_of(0..count);
                        for y in SetBits(is_within) {
                            let dy = place(y) - center.y;
                            let at = Vec3::new(xx * dx + xy * dy, xy * dx + yy * dy, xz * dx + yz * dy);
                            let (tx, ty) = (V::splat(at.x).add(along_x), V::splat(at.y).add(along_y));
                            let kernel = kernel(length_squared(tx, ty, V::splat(at.z).add(along_z)));
                            let sums = &mut sums[x * 8 + y];
                            V::load(sums).add(kernel.mul(V::splat(weight))).store(sums);
                        }
                    }
                }
            }
        }
        sums.chunks(8).take(count).all(|rows| rows[..count].iter().flatten().all(|&sum| sum >= HIGH))
    }
}

/// The bounds around the start φ, from the distances to the nearest centre and the room inward. Outward, the
/// surface may move by `outward` voxels where a kernel reaches. No voxel within `ball` voxels of a particle
/// is outside.
pub(super) fn bounds(phi: &Field, nearest: Field, room: Field, [outward, ball]: [f32; 2]) -> [Field; 2] {
    let (mut lower, mut upper) = (nearest, room);
    let bounds = lower.leaves.par_iter_mut().zip(&mut upper.leaves);
    phi.leaves.par_iter().zip(bounds).halved().for_each(|(phi, (lower, upper))| {
        simd::dispatch(Deviation { phi, lower, upper, outward, ball });
    });
    [lower, upper]
}

/// Kernel: turns the distances to the nearest centre, and the room inward, of a leaf into bounds.
struct Deviation<'a> {
    phi: &'a Leaf,
    lower: &'a mut Leaf,
    upper: &'a mut Leaf,
    outward: f32,
    ball: f32,
}

impl Kernel for Deviation<'_> {
    type Output = ();

    #[inline(always)]
    fn run<V: Lanes>(self) {
        let outward = V::splat(self.outward);
        for row in 0..ROW_COUNT {
            let phi = V::load(self.phi.row(row));
            let (lower, upper) = (self.lower.row_mut(row), self.upper.row_mut(row));
            let (nearest, room) = (V::load(lower), V::load(upper));
            let is_reached = nearest.lt(V::splat(OUT_OF_REACH));
            V::select(is_reached, phi.sub(outward), phi.max(V::splat(0.0))).store(lower);
            phi.add(room).min(nearest.sub(V::splat(self.ball))).store(upper);
        }
    }
}
