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
//! The value of the union of balls is the minimum over all particles, and that of ellipsoids the value of the
//! particle with the least q − r. So where all ellipsoids have the same radii, one search for the least q gives
//! all three unions. Callers need the sign everywhere and the values next to the surface. So a particle is
//! evaluated up to one voxel outside its outermost surface, and values below −[`DEEP`] are not lowered further:
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
use super::kernels::{High, KernelShape};
use super::{EXACT_MARGIN, Radii};
use crate::cancel::checkpoint;
use crate::grid::{
    Field, LEAF_EDGE, LEAVES_PER_TASK, Leaf, LeafMask, ROW_COUNT, SetBits, Topology, leaf_steps_within,
};
use crate::parallel::Loops as _;
use crate::particles::Ellipsoid;
use crate::simd::{self, Kernel, Lanes, greatest};
use crate::space::CoordBox;

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

    /// Half extents along each axis within which the particle can lower a value, in voxels, if its outermost
    /// radius is `outermost`.
    fn extents(&self, outermost: f32) -> Vec3;

    /// The state of a leaf while its particles are added.
    type State;

    /// The state before the first particle.
    fn start<V: Lanes>(unions: &Unions, settled: &LeafMask, around: &[NearbyLeaf<Self>]) -> Self::State;

    /// Adds the particle at `center`, in voxels from the leaf's first voxel.
    fn add<V: Lanes>(&self, unions: &Unions, found: &mut Self::State, center: Vec3, extents: Vec3);

    /// Writes the signed distances to S_max, S_0 and S_min. Below −1 they need not be exact.
    fn finish<V: Lanes>(unions: &Unions, found: &Self::State, distances: [&mut Leaf; 3]);
}

/// The three unions.
#[derive(Clone, Copy, Debug)]
pub(super) struct Unions {
    /// r_max, r_init, r_min.
    pub(super) radii: [f32; 3],
    /// A lower bound of all semi-axes, in units of the radii.
    shortest: f32,
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
    unions: Unions,
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
    /// A lower bound of their semi-axes, in units of the radii.
    shortest: f32,
}

/// Centers and extents of eight particles: x, y, z of each. The centers of unused lanes are infinite, so that
/// they touch no leaf.
type BoxPacket = [[f32; 8]; 6];

#[derive(Clone, Copy)]
pub(super) struct Primitive<F> {
    /// In voxels from the origin of its leaf.
    pub(super) center: Vec3,
    pub(super) extents: Vec3,
    pub(super) shape: F,
}

impl<F: ParticleShape> Primitives<F> {
    /// Sorts the particles of the bins into size classes.
    pub(super) fn new(bins: &ParticleBins, radii: Radii, shape: impl Fn(usize) -> F + Sync) -> Primitives<F> {
        let unions = Unions { radii: [radii.max, radii.init, radii.min], shortest: radii.min_scale };
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
            SizeClass::new(bins, radii.max, &members.collect::<Vec<_>>(), &shape)
        };
        Primitives { classes: numbers.iter().map(class).collect(), unions }
    }

    /// Appends the signed distances to the three unions in these leaves to three fields, in the order of the
    /// radii. Deep inside, and at `settled` voxels, the value is some number below −1.
    pub(super) fn append_distances<'a>(
        &self,
        fields: &mut [Field],
        leaves: &Topology,
        settled: impl Fn(IVec3) -> &'a LeafMask + Sync,
    ) {
        let of_leaf = |&origin: &IVec3| {
            let (unions, settled, mut distances) = (&self.unions, settled(origin), [Leaf::splat(0.0); 3]);
            let around = if *settled == LeafMask::FULL { Vec::new() } else { self.around(origin) };
            simd::dispatch(Signed { distances: distances.each_mut(), around: &around, unions, settled });
            let [max, init, min] = distances;
            (max, (init, min))
        };
        let [max, init, min] = std::array::from_fn(|union| std::mem::take(&mut fields[union].leaves));
        let mut appended = (max, (init, min));
        appended.par_extend(leaves.origins().par_iter().with_max_len(LEAVES_PER_TASK).map(of_leaf));
        let (max, (init, min)) = appended;
        fields.iter_mut().zip([max, init, min]).for_each(|(field, leaves)| field.leaves = leaves);
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
                let steps = leaves.map(|(leaf, &other)| (other - origin, leaf));
                let mut near: Vec<(IVec3, usize)> = steps.filter(|(step, _)| is_near(*step)).collect();
                // The order of `leaf_steps_within`: sums depend on the order of their terms.
                near.sort_by_key(|(step, _)| (step.length_squared(), step.to_array()));
                around.extend(near.into_iter().map(|(step, leaf)| class.leaf(leaf, step)));
            }
        }
        around
    }
}

impl Primitives<KernelShape> {
    /// For each of these leaves, whether it is wanted and the sum of kernels is [`High`].
    pub(super) fn are_high(&self, leaves: &Topology, is_wanted: impl Fn(usize) -> bool + Sync) -> Vec<bool> {
        let is_high = |(leaf, &origin): (usize, &IVec3)| {
            is_wanted(leaf) && simd::dispatch(High { around: &self.around(origin), unions: &self.unions })
        };
        let origins = leaves.origins().par_iter().enumerate();
        origins.with_max_len(LEAVES_PER_TASK).map(is_high).collect()
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
            let shapes = || primitives[own.clone()].iter().map(|primitive| primitive.shape);
            let shortest = shapes().map(|shape| shape.shortest()).fold(f32::INFINITY, f32::min);
            ClassLeaf { primitives: own, packets, shortest }
        };
        let leaves = ranges.into_par_iter().halved().map(class_leaf).collect();
        let reach = primitives.par_iter().halved().map(|primitive| primitive.extents.max_element());
        let reach = reach.reduce(|| 0.0, f32::max);
        let topology = Topology::new(origins);
        SizeClass { topology, leaves, boxes, primitives, reach, steps: leaf_steps_within(reach) }
    }

    fn leaf(&self, leaf: usize, step: IVec3) -> NearbyLeaf<'_, F> {
        let ClassLeaf { primitives, packets, shortest } = &self.leaves[leaf];
        NearbyLeaf {
            step: step.as_vec3(),
            boxes: &self.boxes[packets.clone()],
            primitives: &self.primitives[primitives.clone()],
            shortest: *shortest,
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
pub(super) struct NearbyLeaf<'a, F> {
    /// From the other leaf to this one, in voxels.
    pub(super) step: Vec3,
    pub(super) boxes: &'a [BoxPacket],
    /// Primitive `8·i + k` has the box in lane `k` of packet `i`.
    pub(super) primitives: &'a [Primitive<F>],
    pub(super) shortest: f32,
}

/// Kernel: computes the signed distances of a leaf to the three unions.
struct Signed<'a, F> {
    /// Receives the distances.
    distances: [&'a mut Leaf; 3],
    around: &'a [NearbyLeaf<'a, F>],
    unions: &'a Unions,
    settled: &'a LeafMask,
}

impl<F: ParticleShape> Kernel for Signed<'_, F> {
    type Output = ();

    #[inline(always)]
    fn run<V: Lanes>(self) {
        let Signed { distances, around, unions, settled } = self;
        let mut found = F::start::<V>(unions, settled, around);
        let needed = settled.complement().bounding_box();
        for leaf in around {
            for (eight, boxes) in leaf.boxes.iter().enumerate() {
                for lane in SetBits(near_bits::<V>(boxes, leaf.step, &needed)) {
                    let Primitive { center, extents, shape } = &leaf.primitives[8 * eight + lane];
                    shape.add::<V>(unions, &mut found, center + leaf.step, *extents);
                }
            }
        }
        F::finish::<V>(unions, &found, distances);
    }
}

/// The voxels of a leaf.
pub(super) const LEAF: CoordBox = CoordBox { min: IVec3::ZERO, max: IVec3::splat(LEAF_EDGE - 1) };

/// Bit mask of the eight boxes, moved by a step, that touch a box of voxels.
#[inline(always)]
pub(super) fn near_bits<V: Lanes>(boxes: &BoxPacket, step: Vec3, voxels: &CoordBox) -> u8 {
    let (low, high) = (voxels.min.as_vec3(), voxels.max.as_vec3());
    let x = touches::<V>(&boxes[0], step.x, &boxes[3], [low.x, high.x]);
    let y = touches::<V>(&boxes[1], step.y, &boxes[4], [low.y, high.y]);
    let z = touches::<V>(&boxes[2], step.z, &boxes[5], [low.z, high.z]);
    x & y & z
}

#[inline(always)]
fn touches<V: Lanes>(centers: &[f32; 8], step: f32, extents: &[f32; 8], [low, high]: [f32; 2]) -> u8 {
    let along = V::load(centers).add(V::splat(step));
    let beyond = along.sub(along.max(V::splat(low)).min(V::splat(high)));
    V::bits(V::not(V::load(extents).lt(beyond.abs())))
}

/// Range of a leaf's voxels along an axis that lie within `extent` of `center`.
#[inline(always)]
pub(super) fn voxels_within(center: f32, extent: f32) -> Range<usize> {
    let first = (center - extent).ceil().max(0.0) as usize;
    let last = (center + extent).floor().min((LEAF_EDGE - 1) as f32) as i32;
    first..(last + 1).max(0) as usize
}

/// The range as bits.
#[inline(always)]
pub(super) fn bits_of(voxels: Range<usize>) -> u8 {
    let below = |end: usize| (1u16 << end.min(8)) - 1;
    (below(voxels.end) & !below(voxels.start)) as u8
}

/// Offsets from `center` to a leaf's voxels along an axis.
#[inline(always)]
pub(super) fn offsets<V: Lanes>(center: f32) -> V {
    V::load(&[0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0]).sub(V::splat(center))
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

    fn extents(&self, outermost: f32) -> Vec3 {
        Vec3::splat(outermost * self.0 + EXACT_MARGIN)
    }

    /// The least distance to each union.
    type State = [Leaf; 3];

    #[inline(always)]
    fn start<V: Lanes>(_: &Unions, settled: &LeafMask, _: &[NearbyLeaf<BallShape>]) -> [Leaf; 3] {
        let mut found = Leaf::splat(0.0);
        for row in 0..ROW_COUNT {
            let is_settled = V::mask(settled.row(row));
            V::select(is_settled, V::splat(-DEEP), V::splat(OUT_OF_REACH)).store(found.row_mut(row));
        }
        [found; 3]
    }

    #[inline(always)]
    fn add<V: Lanes>(&self, unions: &Unions, found: &mut [Leaf; 3], center: Vec3, extents: Vec3) {
        let reach_squared = extents.x * extents.x;
        let dz = offsets::<V>(center.z);
        let dz_squared = dz.mul(dz);
        for x in voxels_within(center.x, extents.x) {
            let dx = x as f32 - center.x;
            for y in voxels_within(center.y, extents.y) {
                let dy = y as f32 - center.y;
                let (row, across) = (x * 8 + y, dx * dx + dy * dy);
                // A row that is deep inside S_min is inside the other unions, too.
                let is_deep = || !V::any(V::splat(-DEEP).lt(V::load(found[2].row(row))));
                if across > reach_squared || is_deep() {
                    continue;
                }
                let squared = V::splat(across).add(dz_squared);
                let counts = V::not(V::splat(reach_squared).lt(squared));
                let distance = squared.sqrt();
                for (leaf, radius) in found.iter_mut().zip(unions.radii) {
                    let (row, apart) = (leaf.row_mut(row), distance.sub(V::splat(self.0 * radius)));
                    let known = V::load(row);
                    V::select(counts, apart.min(known), known).store(row);
                }
            }
        }
    }

    #[inline(always)]
    fn finish<V: Lanes>(unions: &Unions, found: &[Leaf; 3], distances: [&mut Leaf; 3]) {
        for ((found, distances), radius) in found.iter().zip(distances).zip(unions.radii) {
            // Every ball contributes up to a fixed margin beyond its r_max. The larger the ball, the farther
            // this limit is from its two smaller surfaces, so the smallest ball gives the distance up to
            // which values take every ball into account.
            let complete_to = EXACT_MARGIN + unions.shortest * (unions.radii[0] - radius);
            for row in 0..ROW_COUNT {
                let value = V::load(found.row(row)).max(V::splat(-DEEP));
                let is_incomplete = V::splat(complete_to).lt(value);
                V::select(is_incomplete, V::splat(OUT_OF_REACH), value).store(distances.row_mut(row));
            }
        }
    }
}

/// The particle with the least q − r at each voxel, for the ellipsoids visited so far, with limits to skip
/// those that are not nearer.
///
/// Voxels farther outside a particle than [`ELLIPSOID_MARGIN`] have no neighbor inside it. Voxels deeper than
/// [`DEEP`] need no nearer particle.
pub(super) struct NearestEllipsoids {
    q: Leaf,
    /// q / |T²(x − p)| of the same particle: voxels per unit of q.
    ratio: Leaf,
    /// For each voxel, the square of q beyond which a particle is not nearer.
    limits: Leaf,
    /// The maximum of each row's limits: row `x·8 + y` at `[x][y]`.
    row_limits: [[f32; 8]; 8],
    /// The largest q that matters.
    farthest: f32,
    /// A voxel with a smaller q is deep.
    deep: f32,
}

impl NearestEllipsoids {
    /// Updates the limits of a row.
    #[inline(always)]
    fn limit_row<V: Lanes>(&mut self, row: usize) {
        let q = V::load(self.q.row(row));
        let is_deep = q.lt(V::splat(self.deep));
        let limit = V::select(is_deep, V::splat(0.0), q.max(V::splat(0.0)).min(V::splat(self.farthest)));
        let squared = limit.mul(limit).mul(V::splat(LIMIT_SLACK));
        squared.store(self.limits.row_mut(row));
        self.row_limits[row >> 3 & 7][row & 7] = greatest(squared);
    }
}

/// Above 1 by more than the relative rounding errors of q² and of its minimum in a row, which is a difference.
const LIMIT_SLACK: f32 = 1.0 + 1e-4;

impl ParticleShape for EllipsoidShape {
    #[inline(always)]
    fn longest(&self) -> f32 {
        self.ellipsoid.longest
    }

    fn shortest(&self) -> f32 {
        1.0 / longest_image(&self.ellipsoid)
    }

    fn extents(&self, outermost: f32) -> Vec3 {
        outermost * self.ellipsoid.extents() + ELLIPSOID_MARGIN
    }

    type State = NearestEllipsoids;

    #[inline(always)]
    fn start<V: Lanes>(
        unions: &Unions,
        settled: &LeafMask,
        around: &[NearbyLeaf<EllipsoidShape>],
    ) -> NearestEllipsoids {
        let shortest = around.iter().map(|leaf| leaf.shortest).fold(f32::INFINITY, f32::min);
        let [max, _, min] = unions.radii;
        let mut found = NearestEllipsoids {
            q: Leaf::splat(0.0),
            ratio: Leaf::splat(1.0),
            limits: Leaf::splat(0.0),
            row_limits: [[0.0; 8]; 8],
            farthest: max + ELLIPSOID_MARGIN / shortest,
            deep: min - DEEP / shortest,
        };
        for row in 0..ROW_COUNT {
            let is_settled = V::mask(settled.row(row));
            V::select(is_settled, V::splat(f32::MIN), V::splat(OUT_OF_REACH)).store(found.q.row_mut(row));
            found.limit_row::<V>(row);
        }
        found
    }

    #[inline(always)]
    fn add<V: Lanes>(&self, _: &Unions, found: &mut NearestEllipsoids, center: Vec3, extents: Vec3) {
        let EllipsoidShape { ellipsoid, row_form, ratio_min } = self;
        let [xx, yy, zz, xy, xz, yz] = ellipsoid.to_unit_ball;
        let dz = offsets::<V>(center.z);
        let counts_along_z = V::not(V::splat(extents.z).lt(dz.abs()));
        let (along_x, along_y, along_z) = (V::splat(xz).mul(dz), V::splat(yz).mul(dz), V::splat(zz).mul(dz));
        let dy_of_rows = offsets::<V>(center.y);
        let is_within_y = bits_of(voxels_within(center.y, extents.y));
        for x in voxels_within(center.x, extents.x) {
            let dx = x as f32 - center.x;
            let limits = V::load(&found.row_limits[x & 7]);
            let is_beyond = V::bits(limits.lt(row_form.least_squared::<V>(dx, dy_of_rows)));
            for y in SetBits(is_within_y & !is_beyond) {
                let (row, dy) = (x * 8 + y, y as f32 - center.y);
                let at = Vec3::new(xx * dx + xy * dy, xy * dx + yy * dy, xz * dx + yz * dy);
                let (tx, ty, tz) =
                    (V::splat(at.x).add(along_x), V::splat(at.y).add(along_y), V::splat(at.z).add(along_z));
                let q_squared = length_squared(tx, ty, tz);
                let is_beyond = V::load(found.limits.row(row)).lt(q_squared);
                let counts = V::both(counts_along_z, V::not(is_beyond));
                if V::bits(counts) == 0 {
                    continue;
                }
                let wx = V::splat(xx).mul(tx).add(V::splat(xy).mul(ty)).add(V::splat(xz).mul(tz));
                let wy = V::splat(xy).mul(tx).add(V::splat(yy).mul(ty)).add(V::splat(yz).mul(tz));
                let wz = V::splat(xz).mul(tx).add(V::splat(yz).mul(ty)).add(V::splat(zz).mul(tz));
                let w_squared = length_squared(wx, wy, wz).max(V::splat(f32::MIN_POSITIVE));
                let ratio = q_squared.div(w_squared).sqrt().max(V::splat(*ratio_min));
                let q = V::select(counts, q_squared.sqrt(), V::splat(OUT_OF_REACH));
                let (known, ratios) = (found.q.row_mut(row), found.ratio.row_mut(row));
                let (nearest, of_nearest) = (V::load(known), V::load(ratios));
                // Of two particles that are equally near, that with the smaller ratio counts, in any order.
                let of_equal = V::select(nearest.lt(q), of_nearest, of_nearest.min(ratio));
                V::select(q.lt(nearest), ratio, of_equal).store(ratios);
                q.min(nearest).store(known);
                found.limit_row::<V>(row);
            }
        }
    }

    #[inline(always)]
    fn finish<V: Lanes>(unions: &Unions, found: &NearestEllipsoids, distances: [&mut Leaf; 3]) {
        for (distances, radius) in distances.into_iter().zip(unions.radii) {
            for row in 0..ROW_COUNT {
                let [q, ratio] = [&found.q, &found.ratio].map(|field| V::load(field.row(row)));
                // A voxel next to an inside one is at most one voxel from the surface. At thin ellipsoids, the
                // particle with the least q can be another one, farther away.
                let value = q.sub(V::splat(radius)).mul(ratio).max(V::splat(-DEEP)).min(V::splat(1.0));
                value.store(distances.row_mut(row));
            }
        }
    }
}

/// Restriction of an ellipsoid's form to rows along z: the minimum of |T·d|² over z is a quadratic form in
/// d's x and y.
#[derive(Clone, Copy, Debug)]
pub(super) struct RowForm {
    xx: f32,
    yy: f32,
    xy: f32,
}

impl RowForm {
    pub(super) fn of(ellipsoid: &Ellipsoid) -> RowForm {
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
    pub(super) fn least_squared<V: Lanes>(&self, dx: f32, dy: V) -> V {
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
pub(super) fn length_squared<V: Lanes>(x: V, y: V, z: V) -> V {
    x.mul(x).add(y.mul(y)).add(z.mul(z))
}
