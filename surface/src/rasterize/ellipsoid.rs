//! Signed distances to unions of balls of different radii, and of ellipsoids (paper, Eq. 1, Fig. 11 and 13).
//!
//! The block below gives the value of a particle at a voxel x, for each of its three radii r. p is the
//! particle's center, s its size in units of the radii, and T the symmetric matrix that maps its ellipsoid of
//! radius 1 to the unit ball.
//!
//! ```text
//!   ball        |x − p| − s·r                             exact
//!   ellipsoid   (q − r)·q / |T²(x − p)|,  q = |T(x − p)|   exact on the surface, first order near it
//! ```
//!
//! The value of the union is the minimum over all particles. Callers need the sign everywhere and the values
//! next to the surface. So a particle is evaluated up to one voxel outside its outermost surface, and values
//! below −[`DEEP`] are not lowered further:
//!
//! ```text
//!   ┌──────────┐        The bounding box of the ellipsoid plus a margin; T⁻¹ gives it exactly.
//!   │   ╭────╮ │        Of the rows it touches, nine in ten are skipped: everywhere on them, q is too large
//!   │ ╭─╯ ╭──╯ │        for the particle to lower a value.
//!   │ ╰───╯    │
//!   └──────────┘
//! ```
//!
//! The first-order distance to the ellipsoid is from:
//! Gabriel Taubin. Estimation of planar curves, surfaces, and nonplanar space curves defined by implicit
//! equations. 1991

use std::ops::Range;

use glam::{IVec3, Vec3};
use rayon::prelude::*;

use super::bin::ParticleBins;
use super::distances::OUT_OF_REACH;
use super::{EXACT_MARGIN, Radii};
use crate::cancel::checkpoint;
use crate::grid::{
    Field, LEAF_EDGE, LEAVES_PER_TASK, Leaf, LeafMask, ROW_COUNT, SetBits, Topology, leaf_steps_within,
};
use crate::parallel::Loops as _;
use crate::particles::Ellipsoid;
use crate::simd::{self, Kernel, Lanes, greatest};

/// Voxels next to the surface are less deep than this, in voxels (usually their depth is at most 1).
const DEEP: f32 = 1.25;

/// Evaluation margin outside an ellipsoid, in voxels: covers the voxels next to its surface.
const ELLIPSOID_MARGIN: f32 = 1.125;

/// Upper limit of the longest semi-axis in the first size class, in units of the radii. Each further class
/// doubles it. Each class has its own lookup.
const CLASS_LONGEST: f32 = 1.5;

/// The shape of one particle.
pub(super) trait ParticleShape: Copy + Sync + Send {
    /// The longest semi-axis, in units of the radii.
    fn longest(&self) -> f32;

    /// A lower bound of the shortest semi-axis, in units of the radii.
    fn shortest(&self) -> f32;

    /// For S_max, S_0 and S_min: the distance up to which the union's values take every particle into
    /// account.
    fn complete_to(radii: &Radii) -> [f32; 3];

    /// Half extents along each axis within which the particle can lower a value, in voxels, if its outermost
    /// radius is `outermost`.
    fn extents(&self, outermost: f32) -> Vec3;

    /// Lowers the values of a leaf to those of the particle at `center`, in voxels from the leaf's first
    /// voxel.
    fn lower<V: Lanes>(&self, values: &mut EllipsoidDistances, center: Vec3, extents: Vec3);
}

/// A ball: its radius relative to the settings' radii.
#[derive(Clone, Copy, Debug)]
pub(super) struct BallShape(pub(super) f32);

/// An ellipsoid: semi-axes in units of the settings' radii.
#[derive(Clone, Copy, Debug)]
pub(super) struct EllipsoidShape {
    ellipsoid: Ellipsoid,
    row_form: RowForm,
    /// At most the shortest semi-axis. It replaces the factor q / |T²(x − p)| at the exact center, where that
    /// is 0 / 0.
    ratio_min: f32,
}

impl EllipsoidShape {
    pub(super) fn new(ellipsoid: Ellipsoid) -> EllipsoidShape {
        let [xx, yy, zz, xy, xz, yz] = ellipsoid.to_unit_ball;
        let norm = (xx * xx + yy * yy + zz * zz + 2.0 * (xy * xy + xz * xz + yz * yz)).sqrt();
        EllipsoidShape { row_form: RowForm::of(&ellipsoid), ratio_min: 1.0 / norm, ellipsoid }
    }
}

/// Particles of any shape, with a lookup by leaf.
pub(super) struct Primitives<F> {
    classes: Vec<SizeClass<F>>,
    /// r_max, r_init, r_min.
    radii: [f32; 3],
    /// For each union, the distance up to which its values take every particle into account.
    complete_to: [f32; 3],
}

/// Particles of similar size.
struct SizeClass<F> {
    /// Leaves that contain particles of this class.
    topology: Topology,
    /// The particles of each leaf.
    leaves: Vec<ClassLeaf>,
    boxes: Vec<BoxPacket>,
    primitives: Vec<Primitive<F>>,
    /// Maximum distance at which a particle of this class can lower a value, in voxels.
    reach: f32,
    /// Steps to the leaves within reach.
    steps: Vec<IVec3>,
}

/// The particles of a class in one leaf.
struct ClassLeaf {
    /// Their indices in the class.
    primitives: Range<usize>,
    /// The packets that contain their boxes; the last one may have unused lanes.
    packets: Range<usize>,
    axes: HalfAxisRange,
}

/// Centers and extents of eight particles: x, y, z of each. The centers of unused lanes are infinite, so that
/// they touch no leaf.
type BoxPacket = [[f32; 8]; 6];

#[derive(Clone, Copy)]
struct Primitive<F> {
    /// In voxels from the origin of its leaf.
    center: Vec3,
    extents: Vec3,
    shape: F,
}

/// Bounds of the semi-axes of some particles, in units of the radii.
#[derive(Clone, Copy)]
struct HalfAxisRange {
    shortest: f32,
    longest: f32,
}

impl<F: ParticleShape> Primitives<F> {
    /// Sorts the particles of the bins into size classes.
    pub(super) fn new(bins: &ParticleBins, radii: Radii, shape: impl Fn(usize) -> F + Sync) -> Primitives<F> {
        let complete_to = F::complete_to(&radii);
        let radii = [radii.max, radii.init, radii.min];
        let class_of = |particle: usize| {
            let doublings = (shape(particle).longest() / CLASS_LONGEST).log2().ceil();
            // The value is in 0..256, so the cast is lossless.
            doublings.max(0.0) as u8
        };
        let class_of: Vec<u8> = (0..bins.len()).into_par_iter().halved().map(class_of).collect();
        let mut numbers = class_of.clone();
        numbers.par_sort_unstable();
        numbers.dedup();
        let class = |&number: &u8| {
            checkpoint();
            let members =
                (0..bins.len()).into_par_iter().halved().filter(|&particle| class_of[particle] == number);
            SizeClass::new(bins, radii[0], &members.collect::<Vec<_>>(), &shape)
        };
        Primitives { classes: numbers.iter().map(class).collect(), radii, complete_to }
    }

    /// The signed distances to the three unions in these leaves, in the order of the radii. Deep inside, and
    /// at `settled` voxels, the value is some number below −1. Leaves in `known` are copied.
    pub(super) fn distances<'a>(
        &self,
        leaves: &Topology,
        settled: impl Fn(IVec3) -> &'a LeafMask + Sync,
        known: impl Fn(IVec3) -> Option<[&'a Leaf; 3]> + Sync,
    ) -> [Field; 3] {
        let mut fields = [0.0; 3].map(|value| Field::splat(leaves.len(), value));
        let [max, init, min] = &mut fields;
        let leaf_fields = max.leaves.par_iter_mut().zip(&mut init.leaves).zip(&mut min.leaves);
        let leaf_fields = leaf_fields.zip(leaves.origins()).with_max_len(LEAVES_PER_TASK);
        leaf_fields.for_each(|(((max, init), min), &origin)| {
            if let Some(known) = known(origin) {
                (*max, *init, *min) = (*known[0], *known[1], *known[2]);
                return;
            }
            let around = self.around(origin);
            let settled = settled(origin);
            simd::dispatch(Signed {
                values: [max, init, min],
                around: &around,
                radii: self.radii,
                complete_to: self.complete_to,
                settled,
            });
        });
        fields
    }

    /// The particles that can lower a value in a leaf.
    fn around(&self, origin: IVec3) -> Vec<NearbyLeaf<'_, F>> {
        let mut around = Vec::new();
        for class in &self.classes {
            // If there are fewer leaves than steps, scanning them all is faster than looking up each step.
            if class.steps.len() <= class.topology.len() {
                let found = class.steps.iter().filter_map(|&step| {
                    let leaf = class.topology.find(origin + step)?;
                    Some(class.leaf(leaf, step))
                });
                around.extend(found);
            } else {
                let reach = class.reach as i32 + LEAF_EDGE;
                let is_near = |step: IVec3| step.abs().max_element() <= reach;
                let leaves = class.topology.origins().iter().enumerate();
                let near = leaves.filter(|(_, other)| is_near(**other - origin));
                around.extend(near.map(|(leaf, &other)| class.leaf(leaf, other - origin)));
            }
        }
        around
    }
}

impl<F: ParticleShape> SizeClass<F> {
    /// Collects the particles of a class: `members`, in ascending order.
    fn new(
        bins: &ParticleBins,
        outermost: f32,
        members: &[usize],
        shape: impl Fn(usize) -> F + Sync,
    ) -> SizeClass<F> {
        let primitive = |&particle: &usize| {
            let shape = shape(particle);
            Primitive { center: bins.local(particle), extents: shape.extents(outermost), shape }
        };
        let primitives: Vec<Primitive<F>> = members.par_iter().halved().map(primitive).collect();
        let (mut origins, mut ranges, mut packets) = (Vec::new(), Vec::new(), Vec::new());
        let mut start = 0;
        for (leaf, &origin) in bins.topology.origins().iter().enumerate() {
            let end_of_leaf = bins.range(leaf).end;
            let end = start + members[start..].partition_point(|&member| member < end_of_leaf);
            if start < end {
                let first_packet = packets.len();
                packets.extend((start..end).step_by(8).map(|first| first..end.min(first + 8)));
                origins.push(origin);
                ranges.push((start..end, first_packet..packets.len()));
            }
            start = end;
        }
        let boxes = packets.into_par_iter().halved().map(|packet| boxes_of(&primitives[packet])).collect();
        let class_leaf = |(own, packets): (Range<usize>, Range<usize>)| {
            checkpoint();
            let axes = HalfAxisRange::of(primitives[own.clone()].iter().map(|primitive| primitive.shape));
            ClassLeaf { primitives: own, packets, axes }
        };
        let leaves = ranges.into_par_iter().halved().map(class_leaf).collect();
        let reach = primitives.par_iter().halved().map(|primitive| primitive.extents.max_element());
        let reach = reach.reduce(|| 0.0, f32::max);
        let topology = Topology::new(origins);
        SizeClass { topology, leaves, boxes, primitives, reach, steps: leaf_steps_within(reach) }
    }

    fn leaf(&self, leaf: usize, step: IVec3) -> NearbyLeaf<'_, F> {
        let ClassLeaf { primitives, packets, axes } = &self.leaves[leaf];
        NearbyLeaf {
            step: step.as_vec3(),
            boxes: &self.boxes[packets.clone()],
            primitives: &self.primitives[primitives.clone()],
            axes: *axes,
        }
    }
}

impl HalfAxisRange {
    /// The range of an empty set.
    const NONE: HalfAxisRange = HalfAxisRange { shortest: f32::INFINITY, longest: 0.0 };

    fn of<F: ParticleShape>(shapes: impl Iterator<Item = F>) -> HalfAxisRange {
        let axes = shapes.map(|shape| HalfAxisRange { shortest: shape.shortest(), longest: shape.longest() });
        axes.fold(HalfAxisRange::NONE, HalfAxisRange::with)
    }

    #[inline(always)]
    fn with(self, other: HalfAxisRange) -> HalfAxisRange {
        HalfAxisRange {
            shortest: self.shortest.min(other.shortest),
            longest: self.longest.max(other.longest),
        }
    }
}

fn boxes_of<F>(primitives: &[Primitive<F>]) -> BoxPacket {
    let mut boxes =
        [[f32::INFINITY; 8], [f32::INFINITY; 8], [f32::INFINITY; 8], [0.0; 8], [0.0; 8], [0.0; 8]];
    for (lane, primitive) in primitives.iter().enumerate() {
        for axis in 0..3 {
            boxes[axis][lane] = primitive.center[axis];
            boxes[3 + axis][lane] = primitive.extents[axis];
        }
    }
    boxes
}

/// The particles of one leaf that can lower a value in another.
struct NearbyLeaf<'a, F> {
    /// From the other leaf to this one, in voxels.
    step: Vec3,
    boxes: &'a [BoxPacket],
    /// Primitive `8·i + k` has the box in lane `k` of packet `i`.
    primitives: &'a [Primitive<F>],
    axes: HalfAxisRange,
}

/// Kernel: computes the signed distances of a leaf to the three unions.
struct Signed<'a, F> {
    /// Receives the distances.
    values: [&'a mut Leaf; 3],
    around: &'a [NearbyLeaf<'a, F>],
    radii: [f32; 3],
    complete_to: [f32; 3],
    settled: &'a LeafMask,
}

impl<F: ParticleShape> Kernel for Signed<'_, F> {
    type Output = ();

    #[inline(always)]
    fn run<V: Lanes>(self) {
        let mut axes = HalfAxisRange::NONE;
        for around in self.around {
            axes = axes.with(around.axes);
        }
        let mut values = EllipsoidDistances::new::<V>(self.values, self.settled, self.radii, axes);
        for around in self.around {
            for (eight, boxes) in around.boxes.iter().enumerate() {
                for lane in SetBits(near_bits::<V>(boxes, around.step)) {
                    let primitive = &around.primitives[8 * eight + lane];
                    primitive.shape.lower::<V>(
                        &mut values,
                        primitive.center + around.step,
                        primitive.extents,
                    );
                }
            }
        }
        for (leaf, complete_to) in values.leaves.into_iter().zip(self.complete_to) {
            for row in 0..ROW_COUNT {
                let row = leaf.row_mut(row);
                let value = V::load(row).max(V::splat(-DEEP));
                V::select(V::splat(complete_to).lt(value), V::splat(OUT_OF_REACH), value).store(row);
            }
        }
    }
}

/// The values of a leaf for the particles visited so far, with limits to skip particles that cannot lower
/// them.
///
/// A particle lowers a value v of the union of radius r only if q < r + v/c for positive v, or q < r + v/a
/// for negative v. Here c and a bound its semi-axes from below and above, and so q/|T²(x − p)| too. Values
/// below −[`DEEP`] are deep enough, and voxels farther outside than [`ELLIPSOID_MARGIN`] have no inside
/// neighbor.
pub(super) struct EllipsoidDistances<'a> {
    leaves: [&'a mut Leaf; 3],
    radii: [f32; 3],
    axes: HalfAxisRange,
    /// For each voxel, the square of q from which on a particle cannot lower a value.
    limits: Leaf,
    /// The maximum of each row's limits: row `x·8 + y` at `[x][y]`.
    row_limits: [[f32; 8]; 8],
}

impl<'a> EllipsoidDistances<'a> {
    #[inline(always)]
    fn new<V: Lanes>(
        leaves: [&'a mut Leaf; 3],
        settled: &LeafMask,
        radii: [f32; 3],
        axes: HalfAxisRange,
    ) -> EllipsoidDistances<'a> {
        let limits = Leaf::splat(0.0);
        let mut values = EllipsoidDistances { leaves, radii, axes, limits, row_limits: [[0.0; 8]; 8] };
        for row in 0..ROW_COUNT {
            let settled = V::mask(settled.row(row));
            for leaf in &mut values.leaves {
                V::select(settled, V::splat(-DEEP), V::splat(OUT_OF_REACH)).store(leaf.row_mut(row));
            }
            values.limit_row::<V>(row);
        }
        values
    }

    /// Updates the limits of a row.
    #[inline(always)]
    fn limit_row<V: Lanes>(&mut self, row: usize) {
        let (outside, inside) = (V::splat(1.0 / self.axes.shortest), V::splat(1.0 / self.axes.longest));
        let (zero, deep) = (V::splat(0.0), V::splat(-DEEP));
        let mut limit = zero;
        for (leaf, radius) in self.leaves.iter().zip(self.radii) {
            let value = V::load(leaf.row(row));
            let beyond = value.max(zero).min(V::splat(ELLIPSOID_MARGIN)).mul(outside);
            let of_union = V::splat(radius + LIMIT_SLACK).add(beyond).add(value.min(zero).mul(inside));
            limit = limit.max(V::select(deep.lt(value), of_union, zero));
        }
        let squared = limit.mul(limit);
        squared.store(self.limits.row_mut(row));
        self.row_limits[row >> 3 & 7][row & 7] = greatest(squared);
    }
}

/// An upper bound of the rounding error of q.
const LIMIT_SLACK: f32 = 1e-3;

/// Bit mask of the eight boxes, moved by a step, that touch the box of a leaf's voxels.
#[inline(always)]
fn near_bits<V: Lanes>(boxes: &BoxPacket, step: Vec3) -> u8 {
    let x = touches::<V>(&boxes[0], step.x, &boxes[3]);
    let y = touches::<V>(&boxes[1], step.y, &boxes[4]);
    let z = touches::<V>(&boxes[2], step.z, &boxes[5]);
    x & y & z
}

#[inline(always)]
fn touches<V: Lanes>(centers: &[f32; 8], step: f32, extents: &[f32; 8]) -> u8 {
    let along = V::load(centers).add(V::splat(step));
    let beyond_leaf = along.sub(along.max(V::splat(0.0)).min(V::splat((LEAF_EDGE - 1) as f32)));
    V::bits(V::not(V::load(extents).lt(beyond_leaf.abs())))
}

/// Range of a leaf's voxels along an axis that lie within `extent` of `center`.
#[inline(always)]
fn voxels_within(center: f32, extent: f32) -> Range<usize> {
    let first = (center - extent).ceil().max(0.0) as usize;
    let last = (center + extent).floor().min((LEAF_EDGE - 1) as f32) as i32;
    first..(last + 1).max(0) as usize
}

/// The range as bits.
#[inline(always)]
fn bits_of(voxels: Range<usize>) -> u8 {
    let below = |end: usize| (1u16 << end.min(8)) - 1;
    (below(voxels.end) & !below(voxels.start)) as u8
}

/// Offsets from `center` to a leaf's voxels along an axis.
#[inline(always)]
fn offsets<V: Lanes>(center: f32) -> V {
    V::load(&[0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0]).sub(V::splat(center))
}

/// True if a whole row is deep inside S_min, and therefore inside the other unions.
#[inline(always)]
fn is_deep<V: Lanes>(leaves: &[&mut Leaf; 3], row: usize) -> bool {
    V::bits(V::splat(-DEEP).lt(V::load(leaves[2].row(row)))) == 0
}

/// Takes the minimum of a row's values and `values`, in the lanes of the mask.
#[inline(always)]
fn lower_row<V: Lanes>(row: &mut [f32; 8], counts: V::Mask, values: V) {
    let previous = V::load(row);
    V::select(counts, values.min(previous), previous).store(row);
}

impl ParticleShape for BallShape {
    #[inline(always)]
    fn longest(&self) -> f32 {
        self.0
    }

    #[inline(always)]
    fn shortest(&self) -> f32 {
        self.0
    }

    /// Every ball contributes up to a fixed margin beyond its r_max. The larger the ball, the farther this
    /// limit is from its two smaller surfaces, so the smallest ball gives the bound.
    fn complete_to(radii: &Radii) -> [f32; 3] {
        [radii.max, radii.init, radii.min].map(|radius| EXACT_MARGIN + radii.min_scale * (radii.max - radius))
    }

    fn extents(&self, outermost: f32) -> Vec3 {
        Vec3::splat(outermost * self.0 + EXACT_MARGIN)
    }

    #[inline(always)]
    fn lower<V: Lanes>(&self, values: &mut EllipsoidDistances, center: Vec3, extents: Vec3) {
        let reach_squared = extents.x * extents.x;
        let dz = offsets::<V>(center.z);
        let dz_squared = dz.mul(dz);
        for x in voxels_within(center.x, extents.x) {
            let dx = x as f32 - center.x;
            for y in voxels_within(center.y, extents.y) {
                let dy = y as f32 - center.y;
                let (row, across) = (x * 8 + y, dx * dx + dy * dy);
                if across > reach_squared || is_deep::<V>(&values.leaves, row) {
                    continue;
                }
                let squared = V::splat(across).add(dz_squared);
                let counts = V::not(V::splat(reach_squared).lt(squared));
                let distance = squared.sqrt();
                for (leaf, radius) in values.leaves.iter_mut().zip(values.radii) {
                    let apart = distance.sub(V::splat(self.0 * radius));
                    lower_row::<V>(leaf.row_mut(row), counts, apart);
                }
            }
        }
    }
}

impl ParticleShape for EllipsoidShape {
    #[inline(always)]
    fn longest(&self) -> f32 {
        self.ellipsoid.longest
    }

    fn shortest(&self) -> f32 {
        1.0 / longest_image(&self.ellipsoid)
    }

    /// Only values next to the surfaces are needed.
    fn complete_to(_: &Radii) -> [f32; 3] {
        [OUT_OF_REACH; 3]
    }

    fn extents(&self, outermost: f32) -> Vec3 {
        outermost * self.ellipsoid.max * self.ellipsoid.extents() + ELLIPSOID_MARGIN
    }

    #[inline(always)]
    fn lower<V: Lanes>(&self, values: &mut EllipsoidDistances, center: Vec3, extents: Vec3) {
        let EllipsoidShape { ellipsoid, row_form, ratio_min } = self;
        let [xx, yy, zz, xy, xz, yz] = ellipsoid.to_unit_ball;
        let [max, init, min] = values.radii;
        let radii = [ellipsoid.max * max, ellipsoid.init * init, min];
        let dz = offsets::<V>(center.z);
        let counts_along_z = V::not(V::splat(extents.z).lt(dz.abs()));
        let (along_x, along_y, along_z) = (V::splat(xz).mul(dz), V::splat(yz).mul(dz), V::splat(zz).mul(dz));
        let dy_of_rows = offsets::<V>(center.y);
        let is_within_y = bits_of(voxels_within(center.y, extents.y));
        for x in voxels_within(center.x, extents.x) {
            let dx = x as f32 - center.x;
            let limits = V::load(&values.row_limits[x & 7]);
            let is_beyond = V::bits(limits.lt(row_form.least_squared::<V>(dx, dy_of_rows)));
            for y in SetBits(is_within_y & !is_beyond) {
                let (row, dy) = (x * 8 + y, y as f32 - center.y);
                let at = Vec3::new(xx * dx + xy * dy, xy * dx + yy * dy, xz * dx + yz * dy);
                let (tx, ty, tz) =
                    (V::splat(at.x).add(along_x), V::splat(at.y).add(along_y), V::splat(at.z).add(along_z));
                let q_squared = length_squared(tx, ty, tz);
                let counts = V::both(counts_along_z, q_squared.lt(V::load(values.limits.row(row))));
                if V::bits(counts) == 0 {
                    continue;
                }
                let wx = V::splat(xx).mul(tx).add(V::splat(xy).mul(ty)).add(V::splat(xz).mul(tz));
                let wy = V::splat(xy).mul(tx).add(V::splat(yy).mul(ty)).add(V::splat(yz).mul(tz));
                let wz = V::splat(xz).mul(tx).add(V::splat(yz).mul(ty)).add(V::splat(zz).mul(tz));
                let w_squared = length_squared(wx, wy, wz).max(V::splat(f32::MIN_POSITIVE));
                let ratio = q_squared.div(w_squared).sqrt().max(V::splat(*ratio_min));
                let q = q_squared.sqrt();
                for (leaf, radius) in values.leaves.iter_mut().zip(radii) {
                    let apart = q.sub(V::splat(radius)).mul(ratio);
                    lower_row::<V>(leaf.row_mut(row), counts, apart);
                }
                values.limit_row::<V>(row);
            }
        }
    }
}

/// Restriction of an ellipsoid's form to rows along z: the minimum of |T·d|² over z is a quadratic form in
/// d's x and y.
#[derive(Clone, Copy, Debug)]
struct RowForm {
    xx: f32,
    yy: f32,
    xy: f32,
}

impl RowForm {
    fn of(ellipsoid: &Ellipsoid) -> RowForm {
        let [xx, yy, zz, xy, xz, yz] = ellipsoid.to_unit_ball;
        let (x, y, z) = (Vec3::new(xx, xy, xz), Vec3::new(xy, yy, yz), Vec3::new(xz, yz, zz));
        // A step along z cancels the component along T·z.
        let per_square = 1.0 / z.dot(z);
        let (x_on_z, y_on_z) = (x.dot(z), y.dot(z));
        RowForm {
            xx: x.dot(x) - x_on_z * x_on_z * per_square,
            yy: y.dot(y) - y_on_z * y_on_z * per_square,
            xy: x.dot(y) - x_on_z * y_on_z * per_square,
        }
    }

    /// The minimum of |T·d|² along each of eight rows with the same x.
    #[inline(always)]
    fn least_squared<V: Lanes>(&self, dx: f32, dy: V) -> V {
        let of_x = V::splat(self.xx * dx).add(V::splat(2.0 * self.xy).mul(dy));
        V::splat(dx).mul(of_x).add(V::splat(self.yy).mul(dy).mul(dy))
    }
}

/// An upper bound of |T·v| over unit vectors v: the maximum absolute row sum.
fn longest_image(ellipsoid: &Ellipsoid) -> f32 {
    let [xx, yy, zz, xy, xz, yz] = ellipsoid.to_unit_ball.map(f32::abs);
    (xx + xy + xz).max(xy + yy + yz).max(xz + yz + zz)
}

#[inline(always)]
fn length_squared<V: Lanes>(x: V, y: V, z: V) -> V {
    x.mul(x).add(y.mul(y)).add(z.mul(z))
}
