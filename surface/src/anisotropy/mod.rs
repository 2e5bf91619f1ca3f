//! Anisotropy: stretches particles along the sheet or filament that they are part of, or along their
//! velocity.
//!
//! ```text
//!   ∙ ∙ ∙ ∙ ∙        neighbours   ⬭⬭⬭⬭⬭   a sheet becomes flat; balls would make bumps
//!
//!   ∙→  ∙⟶  ∙⟶⟶     velocity     ●  ⬬  ⬬    a drop is longer, the faster it is
//! ```
//!
//! The two methods, by neighbours and by velocity, are independent of each other. Both accept a scale per
//! particle, and compute semi-axes in units of the settings' radii. The product of a particle's three
//! semi-axes is the cube of its scale. At the end, semi-axes too short for the grid are raised to a floor,
//! and the affected particles are counted.
//!
//! By neighbours, a shape depends only on the particles within the neighbor radius (where particles are very
//! dense, within the cells that this radius touches); by velocity, only on its own particle. Shapes are
//! bit-identical on any number of threads and with any SIMD width.
//!
//! This work is based on:
//! Jihun Yu and Greg Turk. Reconstructing surfaces of particle-based fluids using anisotropic kernels. 2010

mod neighborhoods;

use glam::DVec3;
use rayon::prelude::*;

pub use neighborhoods::{KernelConfig, NeighborConfig, NeighborShapes, Stretch, from_neighbors};

use crate::parallel::Loops as _;
use crate::particles::{BODY_SCALE, Ellipsoid, LONE_SCALE, cube_root};
use crate::simd::Lanes;
use neighborhoods::MOMENT_COUNT;

/// The shapes of a frame's particles.
#[derive(Clone, Debug, PartialEq)]
pub struct AnisotropicShapes {
    /// The shape of each particle, in order.
    pub shapes: Vec<Ellipsoid>,
    /// Number of particles with a semi-axis that was raised to the floor.
    pub raised_count: usize,
    /// Number of particles that are balls because there is not enough information: too few neighbours, or a
    /// velocity or position that is not finite.
    pub ball_count: usize,
}

/// Upper bound of all semi-axes of a particle of scale 1. Let m be `max_stretch`, which is finite, and a ≥ b
/// ≥ c the semi-axes, with a·b·c = 1 and a ≤ m·c. The longest possible a is that of a cigar (b = c): m^⅔, or
/// the floor if that is larger. Velocities (paper, Eq. 16) keep this bound, too: the longest semi-axis (1 +
/// s)² is the ratio (1 + s)³ to the power ⅔.
#[cfg(test)]
fn longest_bound(max_stretch: f32, floor: f32) -> f32 {
    let root = cube_root(max_stretch.max(1.0));
    // A product of three rounded numbers is not exactly 1.
    (root * root * (1.0 + 1e-5)).max(floor)
}

/// The scale of all particles without per-particle scales.
const SCALE: f32 = 1.0;

/// The scale of a particle. An invalid scale becomes 0, the smallest.
fn scale_of(scales: Option<&[f32]>, index: usize) -> f32 {
    let scale = scales.map_or(SCALE, |scales| scales[index]);
    if scale.is_finite() { scale.max(0.0) } else { 0.0 }
}

/// A ball of this scale, raised to the floor, and whether it was raised.
fn ball(scale: f32, floor: f32) -> (Ellipsoid, bool) {
    (Ellipsoid::ball(scale.max(floor)), scale < RAISED_BELOW * floor)
}

/// A semi-axis counts as raised if it was below this fraction of the floor. Rounding alone makes one
/// semi-axis of every ellipsoid shorter than its ball's radius; such invisible changes are not reported.
const RAISED_BELOW: f32 = 0.999;

// Scales from per-particle radii (paper, Fig. 13).
//
// A lone particle is a ball of its radius times S, the radius scale of the settings; one of scale 1 has the unit
// radius. So the scale of a particle is S·radius / unit radius. Scales below a floor are raised to it, because the grid
// cannot hold a smaller surface.

/// A scale per particle.
#[derive(Clone, Debug, PartialEq)]
pub struct RadiusScales {
    /// The scales, in units of the settings' radii. None is below the floor.
    pub scales: Vec<f32>,
    /// Number of radii too small for the grid, which were raised.
    pub raised_count: usize,
    /// Number of radii that are not positive, or not finite once scaled: these particles get the smallest
    /// scale.
    pub invalid_count: usize,
}

/// Scales from radii in world units: `radius_scale` · radius / `unit_radius`, but at least `floor`. `unit_radius` is the
/// radius of a lone particle of scale 1, in world units.
pub fn radius_scales(radii: &[f32], radius_scale: f64, unit_radius: f64, floor: f32) -> RadiusScales {
    let scale_of = |&radius: &f32| {
        let scale = (radius_scale * f64::from(radius) / unit_radius) as f32;
        // In 64 bits, a positive radius stays positive; a scale that rounds to 0 is raised.
        (radius > 0.0 && scale.is_finite()).then_some(scale)
    };
    let count = |is_counted: fn(Option<f32>, f32) -> bool| {
        radii.par_iter().halved().filter(|radius| is_counted(scale_of(radius), floor)).count()
    };
    RadiusScales {
        scales: radii
            .par_iter()
            .halved()
            .map(|radius| scale_of(radius).map_or(floor, |scale| scale.max(floor)))
            .collect(),
        raised_count: count(|scale, floor| scale.is_some_and(|scale| scale < floor)),
        invalid_count: count(|scale, _| scale.is_none()),
    }
}

// Shapes from velocities: faster particles are longer along their velocity (paper, Eq. 16, Fig. 11).
//
//              ⎡ 1/(1+s)²            ⎤             semi-axes: a = (1 + s)² along v
//   T = [v t t]⎢          1+s        ⎥[v t t]ᵀ                b = 1/(1 + s) across v
//              ⎣               1 + s ⎦             product a·b² = 1, stretch a/b = (1 + s)³
//
// All directions across v are equivalent, so T = 1/b + (1/a − 1/b)·v·vᵀ, and t is not needed.

/// How velocities shape particles.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct VelocityConfig {
    /// s at a speed of one world unit per second: the gain of the settings, in seconds, divided by the
    /// unit radius. Not negative.
    pub gain_per_speed: f32,
    /// Upper limit of the semi-axis along the velocity, relative to those across, before they are raised to
    /// the floor: 1 or more.
    pub max_stretch: f32,
    /// Lower limit of semi-axes, in units of the settings' radii. Positive.
    pub floor: f32,
}

/// Shapes particles by their velocities: x, y and z per particle (paper, Eq. 16). `scales` has one entry per
/// particle. A particle whose velocity is not finite is a ball.
pub fn from_velocities(
    velocities: &[f32],
    scales: Option<&[f32]>,
    config: &VelocityConfig,
) -> AnisotropicShapes {
    let (velocities, rest) = velocities.as_chunks::<3>();
    assert!(rest.is_empty(), "three components for each particle");
    assert!(scales.is_none_or(|scales| scales.len() == velocities.len()), "a scale for each particle");
    let most = f64::from(cube_root(config.max_stretch.max(1.0)) - 1.0);
    let stretched = |(index, &velocity): (usize, &[f32; 3])| {
        let velocity = DVec3::from(velocity.map(f64::from));
        stretched(velocity, scale_of(scales, index), most, config)
    };
    let shapes: Vec<(Ellipsoid, bool)> = velocities.par_iter().enumerate().halved().map(stretched).collect();
    AnisotropicShapes {
        raised_count: shapes.iter().filter(|(_, is_raised)| *is_raised).count(),
        ball_count: velocities.iter().filter(|velocity| !is_finite(velocity)).count(),
        shapes: shapes.into_iter().map(|(shape, _)| shape).collect(),
    }
}

fn is_finite(velocity: &[f32; 3]) -> bool {
    velocity.iter().all(|along| along.is_finite())
}

/// The shape for a velocity with s limited to `most`, and whether a semi-axis was raised.
fn stretched(velocity: DVec3, scale: f32, most: f64, config: &VelocityConfig) -> (Ellipsoid, bool) {
    // In 64 bits, the squares of 32-bit numbers do not overflow.
    let speed = velocity.length();
    let s = (f64::from(config.gain_per_speed) * speed).min(most) as f32;
    // `s > 0.0` is false for NaN.
    if !(s > 0.0 && speed.is_finite()) {
        return ball(scale, config.floor);
    }
    let along = (1.0 + s) * (1.0 + s) * scale;
    let across = scale / (1.0 + s);
    let is_raised = across < RAISED_BELOW * config.floor;
    let (along, across) = (along.max(config.floor), across.max(config.floor));
    let direction = (velocity / speed).as_vec3();
    let of_ball = 1.0 / across;
    let (x, y, z) = direction.into();
    let more = 1.0 / along - of_ball;
    let to_unit_ball = [
        of_ball + more * x * x,
        of_ball + more * y * y,
        of_ball + more * z * z,
        more * x * y,
        more * x * z,
        more * y * z,
    ];
    (Ellipsoid { to_unit_ball, longest: along, weight: 1.0, room: 0.0 }, is_raised)
}

// Converts moments to ellipsoids, eight particles at a time.
//
//   moments ──▶ covariance ──▶ eigenvalues λ ──▶ √λ ──▶ limit ──▶ volume ──▶ blend ─┐
//                                    └──▶ company ─────────────────────────────▲    │
//                                                   ellipsoid ◀── floor ◀── scale ◀─┘
//
// - **√λ**: semi-axes are proportional to the square roots of the eigenvalues, that is, to the standard
//   deviation of the neighbours along each direction. So a particle gets the shape of its neighbourhood. (Yu
//   and Turk, Eq. 16, use the eigenvalues themselves, which doubles the stretch on a logarithmic scale.)
// - **Limit**: no semi-axis is shorter than the longest divided by `max_stretch` (k_r of Yu and Turk,
//   Eq. 15).
// - **Volume**: all semi-axes are divided by the cube root of their product. (Yu and Turk multiply by k_s.)
// - **Company**: how much fluid there is around a particle, from 0 in spray to 1 in a body or a sheet. A
//   compact cluster needs more neighbours for the same company than a sheet does: with the radii of a body, a
//   cluster of six particles would have twice its volume, and with those of spray a sheet would have holes.
// - **Blend**: only a flat neighbourhood in company makes a flat particle. That at the plane surface of a
//   body is not flat enough: there, flat particles would tremble with their neighbours and smooth little.
//   (Yu and Turk compare the number of neighbours with N_ε. At that number, shapes would jump from one frame
//   to the next.)
//
//   company                                     share of the ellipsoid, if in company
//     1 │       ╭───── W·(1 + 1.5·flatness)       1 │          ╭──
//     0 │───╯╶╯                                   0 │─────╯╶╯      flatness = 1 − √(λ_min / λ_max)
//           3   12                                       0.4  0.9
//
// All these functions have a continuous derivative, and so have the weights of the neighbours: nothing
// changes abruptly when a neighbour arrives or leaves.

/// Up to this weight of neighbours, a particle has no company.
const COMPANY_NONE: f32 = 3.0;

/// From this weight of neighbours on, a particle is in full company. At a radius of 2.6 spacings the sum of
/// the weights is 23 inside, 16 at a plane surface, 9 in a sheet, 5 at the edge of a sheet and 2 in a line.
const COMPANY_FULL: f32 = 12.0;

/// The weight of neighbours counts this much more in an entirely flat neighbourhood.
const FLAT_GAIN: f32 = 1.5;

/// Up to this flatness of its neighbourhood a particle is a ball. At a plane surface the flatness is 0.44.
const FLAT_NONE: f32 = 0.4;

/// From this flatness of its neighbourhood on, a particle has the shape of its neighbourhood.
const FLAT_FULL: f32 = 0.9;

/// Between these weights of neighbours, a particle becomes one at the surface of a body, also where its fluid is
/// spread out; at a plane surface the weight is 26.
const BODY_NONE: f32 = 9.0;
const BODY_FULL: f32 = 17.0;

/// Between these weights of neighbours, the surface gets room to move inward: from that of a drop of some dozens
/// of particles on.
const ROOM_NONE: f32 = 13.0;
const ROOM_FULL: f32 = 22.0;

/// From this flatness of its neighbourhood on, a particle is in a sheet.
const BODY_FLAT: f32 = 0.7;

/// Added to each eigenvalue, in units of the squared radius. So many particles at one point give a ball, and
/// not a shape that rounding errors determine. Then no semi-axis is more than about 50 times as long as
/// another.
const SPREAD_MIN: f32 = 1e-4;

/// The shapes of eight particles.
struct Shapes8 {
    shapes: [Ellipsoid; 8],
    /// Mask of the particles with a raised semi-axis.
    raised: u8,
    /// Mask of the particles without company, which are balls.
    balls: u8,
}

/// The neighbourhoods of eight particles.
struct Surroundings<V> {
    /// The mean position of the neighbours (Yu and Turk, Eq. 10), relative to the particle, in units of the
    /// radius.
    mean: [V; 3],
    /// The eigenvalues of their covariance, positive, and the eigenvectors.
    eigen: Eigen<V>,
    flatness: V,
    company: V,
    /// Whether the neighbours are a body: 0 in drops, threads and sheets, 1 at a plane surface.
    body: V,
    /// The part of the room inward that the particle gives to the surface.
    room: V,
}

impl<V: Lanes> Surroundings<V> {
    /// From the moments of the neighbourhoods, and for each particle the factor from its sum of weights to the
    /// one that its company is computed from.
    #[inline(always)]
    fn new(moments: &[[f32; 8]; MOMENT_COUNT], weight_scales: &[f32; 8]) -> Surroundings<V> {
        let (mean, covariance) = mean_and_covariance::<V>(moments);
        let Eigen { values, vectors } = eigen(covariance);
        let [a, b, c] = values.map(|value| value.max(V::splat(SPREAD_MIN)));
        let flatness = V::splat(1.0).sub(a.min(b).min(c).div(a.max(b).max(c)).sqrt());
        let weight = V::load(&moments[0]).sub(V::splat(OWN_WEIGHT)).mul(V::load(weight_scales));
        let gain = V::splat(1.0).add(V::splat(FLAT_GAIN).mul(flatness));
        let weight = weight.mul(gain);
        let company = smooth_step(weight, COMPANY_NONE, COMPANY_FULL);
        let is_curved = V::splat(1.0).sub(smooth_step(flatness, BODY_FLAT, FLAT_FULL));
        let body = smooth_step(weight, BODY_NONE, BODY_FULL).mul(is_curved);
        let room = smooth_step(weight, ROOM_NONE, ROOM_FULL).mul(is_curved);
        Surroundings { mean, eigen: Eigen { values: [a, b, c], vectors }, flatness, company, body, room }
    }

    /// x, y and z of the mean position of the neighbours times the company.
    #[inline(always)]
    fn means(&self) -> [[f32; 8]; 3] {
        self.mean.map(|along| {
            let mut row = [0.0; 8];
            along.mul(self.company).store(&mut row);
            row
        })
    }

    /// The shapes of particles with these scales.
    #[inline(always)]
    fn shapes(&self, scales: &[f32; 8], limits: Stretch) -> Shapes8 {
        let Surroundings { eigen, flatness, company, body, room, .. } = self;
        let mut scale = V::load(scales);
        if let Some(KernelConfig { per_reach, .. }) = limits.kernels {
            let size = between(LONE_SCALE, 1.0, *company).mul(between(1.0, BODY_SCALE, *body));
            // A kernel is weighed by the neighbours, so company makes it reach no farther than they do.
            let most = V::splat(per_reach).div(scale).max(V::splat(LONE_SCALE));
            scale = scale.mul(size.min(most));
        }
        let share = V::splat(if limits.max_stretch > 1.0 { 1.0 } else { 0.0 });
        let part = company.mul(smooth_step(*flatness, FLAT_NONE, FLAT_FULL)).mul(share);
        let half_axes = blended(limited(eigen.values, limits.max_stretch), part);
        let is_round = V::not(V::splat(0.0).lt(part));
        let (half_axes, is_raised) = scaled(half_axes, is_round, scale, limits.floor);
        let mut shapes = ellipsoids(half_axes, eigen.vectors, V::bits(is_round));
        if let Some(kernels) = limits.kernels {
            let mut rooms = [0.0; 8];
            between(kernels.room_least, kernels.room_most, *room).store(&mut rooms);
            shapes.iter_mut().zip(rooms).for_each(|(shape, room)| shape.room = room);
        }
        let balls = V::bits(V::not(V::splat(0.0).lt(*company)));
        Shapes8 { shapes, raised: V::bits(is_raised), balls }
    }
}

/// Whether a particle with this sum of weights is in full company, however flat its neighbourhood is.
fn is_in_full_company(weight: f32, weight_scale: f32) -> bool {
    (weight - OWN_WEIGHT) * weight_scale >= COMPANY_FULL
}

/// The weight of a particle at its own position.
const OWN_WEIGHT: f32 = 1.0;

/// `least` where `part` is 0, `most` where it is 1.
#[inline(always)]
fn between<V: Lanes>(least: f32, most: f32, part: V) -> V {
    V::splat(least).add(part.mul(V::splat(most - least)))
}

/// 0 up to `from`, 1 from `to` on, and 3u² − 2u³ between.
#[inline(always)]
fn smooth_step<V: Lanes>(x: V, from: f32, to: f32) -> V {
    let u = x.sub(V::splat(from)).mul(V::splat(1.0 / (to - from))).max(V::splat(0.0)).min(V::splat(1.0));
    u.mul(u).mul(V::splat(3.0).sub(u).sub(u))
}

/// The mean position (Yu and Turk, Eq. 10) and the covariance (Eq. 9) of the neighbours: x, y and z; xx, yy,
/// zz, xy, xz and yz.
#[inline(always)]
fn mean_and_covariance<V: Lanes>(moments: &[[f32; 8]; MOMENT_COUNT]) -> ([V; 3], [V; 6]) {
    // Each particle itself contributes a weight of 1, so the sum is at least 1. The exception is a cell with
    // so many particles that only a sample of them is used, which may lack the particle.
    let by_weight = V::splat(1.0).div(V::load(&moments[0]).max(V::splat(1.0)));
    let mean = |moment: &[f32; 8]| V::load(moment).mul(by_weight);
    let [x, y, z] = [mean(&moments[1]), mean(&moments[2]), mean(&moments[3])];
    let products = [x.mul(x), y.mul(y), z.mul(z), x.mul(y), x.mul(z), y.mul(z)];
    let mut covariance = [V::splat(0.0); 6];
    for (entry, (moment, product)) in covariance.iter_mut().zip(moments[4..].iter().zip(products)) {
        *entry = mean(moment).sub(product);
    }
    for diagonal in &mut covariance[..3] {
        *diagonal = diagonal.add(V::splat(SPREAD_MIN));
    }
    ([x, y, z], covariance)
}

/// The square roots of positive eigenvalues, scaled to a product of 1, with their ratio limited to
/// `max_stretch`.
#[inline(always)]
fn limited<V: Lanes>(eigenvalues: [V; 3], max_stretch: f32) -> [V; 3] {
    let [a, b, c] = eigenvalues.map(V::sqrt);
    let least = a.max(b).max(c).mul(V::splat(1.0 / max_stretch));
    with_unit_volume([a.max(least), b.max(least), c.max(least)])
}

/// Blends semi-axes whose product is 1 with those of a ball. The product stays 1, and the stretch is between
/// 1 and that of the given semi-axes.
#[inline(always)]
fn blended<V: Lanes>(half_axes: [V; 3], part: V) -> [V; 3] {
    let one = V::splat(1.0);
    let [a, b, c] = half_axes;
    with_unit_volume([
        one.add(part.mul(a.sub(one))),
        one.add(part.mul(b.sub(one))),
        one.add(part.mul(c.sub(one))),
    ])
}

#[inline(always)]
fn with_unit_volume<V: Lanes>(half_axes: [V; 3]) -> [V; 3] {
    let [a, b, c] = half_axes;
    let mut row = [0.0; 8];
    a.mul(b).mul(c).store(&mut row);
    for value in &mut row {
        *value = cube_root(*value);
    }
    let root = V::load(&row);
    [a.div(root), b.div(root), c.div(root)]
}

/// Multiplies semi-axes by the scale, and raises those below the floor. Also returns a mask of the particles
/// with a raised semi-axis.
#[inline(always)]
fn scaled<V: Lanes>(half_axes: [V; 3], is_round: V::Mask, scale: V, floor: f32) -> ([V; 3], V::Mask) {
    let floor = V::splat(floor);
    let [mut a, mut b, mut c] = half_axes;
    for half_axis in [&mut a, &mut b, &mut c] {
        // The semi-axes of a ball are exactly the scale, without rounding errors.
        *half_axis = V::select(is_round, scale, half_axis.mul(scale));
    }
    let is_raised = a.min(b).min(c).lt(floor.mul(V::splat(RAISED_BELOW)));
    ([a.max(floor), b.max(floor), c.max(floor)], is_raised)
}

#[inline(always)]
fn ellipsoids<V: Lanes>(half_axes: [V; 3], vectors: [[V; 3]; 3], balls: u8) -> [Ellipsoid; 8] {
    let mut to_unit_ball = [V::splat(0.0); 6];
    for (half_axis, [x, y, z]) in half_axes.into_iter().zip(vectors) {
        let inverse = V::splat(1.0).div(half_axis);
        let (of_x, of_y, of_z) = (x.mul(inverse), y.mul(inverse), z.mul(inverse));
        let products = [of_x.mul(x), of_y.mul(y), of_z.mul(z), of_x.mul(y), of_x.mul(z), of_y.mul(z)];
        for (entry, product) in to_unit_ball.iter_mut().zip(products) {
            *entry = entry.add(product);
        }
    }
    let [a, b, c] = half_axes;
    let mut longest = [0.0; 8];
    a.max(b).max(c).store(&mut longest);
    let mut rows = [[0.0; 8]; 6];
    for (row, entry) in rows.iter_mut().zip(to_unit_ball) {
        entry.store(row);
    }
    let mut shapes = [Ellipsoid { to_unit_ball: [0.0; 6], longest: 0.0, weight: 1.0, room: 0.0 }; 8];
    for (lane, shape) in shapes.iter_mut().enumerate() {
        shape.longest = longest[lane];
        for (entry, row) in shape.to_unit_ball.iter_mut().zip(&rows) {
            *entry = row[lane];
        }
        if balls >> lane & 1 == 1 {
            *shape = Ellipsoid::ball(longest[lane]);
        }
    }
    shapes
}

// Eigenvalues and eigenvectors of eight symmetric 3×3 matrices at once, by Jacobi rotations.
//
//   ⎡xx xy xz⎤    each rotation makes one of xy, xz and yz zero and shrinks the sum of the squares of
//   ⎢xy yy yz⎥    all three; each sweep of three rotations about doubles the number of correct digits
//   ⎣xz yz zz⎦
//
// The code has no branches and no trigonometry, and the number of rotations is fixed. So eight matrices take
// little more time than one, all processors compute the same bits, and equal eigenvalues need no special
// case.
//
// This work is based on:
// William Press et al. Numerical Recipes, section 11.1. 2007

/// Eigenvalues and orthonormal eigenvectors.
struct Eigen<V> {
    /// The eigenvalues, in no particular order.
    values: [V; 3],
    /// x, y and z of the vector of each eigenvalue.
    vectors: [[V; 3]; 3],
}

/// Decomposes matrices with the entries xx, yy, zz, xy, xz and yz, whose magnitudes are at most about 1.
#[inline(always)]
fn eigen<V: Lanes>(matrix: [V; 6]) -> Eigen<V> {
    let [mut xx, mut yy, mut zz, mut xy, mut xz, mut yz] = matrix;
    let (zero, one) = (V::splat(0.0), V::splat(1.0));
    let [mut x, mut y, mut z] = [[one, zero, zero], [zero, one, zero], [zero, zero, one]];
    for _ in 0..SWEEP_COUNT {
        (xx, yy) = rotate(xx, yy, &mut xy, [&mut xz, &mut yz], [&mut x, &mut y]);
        (xx, zz) = rotate(xx, zz, &mut xz, [&mut xy, &mut yz], [&mut x, &mut z]);
        (yy, zz) = rotate(yy, zz, &mut yz, [&mut xy, &mut xz], [&mut y, &mut z]);
    }
    Eigen { values: [xx, yy, zz], vectors: [x, y, z] }
}

/// Number of sweeps. After these, the entries off the diagonal are smaller than the rounding error, for any
/// matrix.
const SWEEP_COUNT: usize = 5;

/// Makes `pq` zero by a rotation of the axes p and q. `others` are the entries pr and qr, where r is the
/// third axis. Returns the new pp and qq.
#[inline(always)]
fn rotate<V: Lanes>(pp: V, qq: V, pq: &mut V, others: [&mut V; 2], axes: [&mut [V; 3]; 2]) -> (V, V) {
    let apart = qq.sub(pp);
    let twice = pq.add(*pq);
    let root = apart.mul(apart).add(twice.mul(twice)).sqrt();
    // If the sum is zero, `twice` is zero too, and there is nothing to rotate: `max` avoids 0/0.
    let sum = apart.abs().add(root).max(V::splat(f32::MIN_POSITIVE));
    let tangent = twice.div(sum).mul(V::splat(1.0).copysign(apart));
    let cosine = V::splat(1.0).div(V::splat(1.0).add(tangent.mul(tangent)).sqrt());
    let sine = tangent.mul(cosine);
    let moved = tangent.mul(*pq);
    *pq = V::splat(0.0);
    let [pr, qr] = others;
    rotate_pair(pr, qr, cosine, sine);
    let [p, q] = axes;
    for axis in 0..3 {
        rotate_pair(&mut p[axis], &mut q[axis], cosine, sine);
    }
    (pp.sub(moved), qq.add(moved))
}

#[inline(always)]
fn rotate_pair<V: Lanes>(p: &mut V, q: &mut V, cosine: V, sine: V) {
    let (before_p, before_q) = (*p, *q);
    *p = cosine.mul(before_p).sub(sine.mul(before_q));
    *q = sine.mul(before_p).add(cosine.mul(before_q));
}

#[cfg(test)]
mod tests {
    use glam::{DMat3, DVec3, Vec3};

    use super::*;
    use crate::simd::{Kernel, SimdLevel, dispatch_at};

    #[test]
    fn radii_are_scaled_and_raised_to_the_floor() {
        let radii = [0.5, 0.1, 1.0, 1e-45, f32::NAN, 0.0, -1.0, f32::INFINITY, 3e38];
        let scaled = radius_scales(&radii, 1.5, 0.25, 1.0);
        assert_eq!(scaled.scales, [3.0, 1.0, 6.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0]);
        assert_eq!((scaled.raised_count, scaled.invalid_count), (2, 5));
        assert_eq!(radius_scales(&[], 1.0, 1.0, 1.0).scales, [0.0; 0]);
    }

    const CONFIG: VelocityConfig = VelocityConfig { gain_per_speed: 0.5, max_stretch: 8.0, floor: 0.01 };

    /// Distance of the surface of r = 1 from the centre, along a direction.
    fn extent(shape: &Ellipsoid, direction: Vec3) -> f32 {
        1.0 / shape.apply(direction.normalize()).length()
    }

    fn shape(velocity: Vec3, scale: f32) -> Ellipsoid {
        from_velocities(&velocity.to_array(), Some(&[scale]), &CONFIG).shapes[0]
    }

    #[test]
    fn half_axes_match_equation_16() {
        for (speed, s) in [(0.5f32, 0.25f32), (1.0, 0.5), (2.0, 1.0), (2.5, 1.0), (3e38, 1.0)] {
            for along in [Vec3::X, Vec3::new(0.48, -0.6, 0.64), Vec3::new(0.0, 0.6, 0.8)] {
                for scale in [1.0, 3.0] {
                    let shape = shape(along * speed, scale);
                    let expected = (1.0 + s).powi(2) * scale;
                    assert!((shape.longest / expected - 1.0).abs() < 1e-5, "{shape:?}");
                    assert!((extent(&shape, along) / expected - 1.0).abs() < 1e-5, "{shape:?}");
                    let across = along.any_orthonormal_vector();
                    for across in [across, across.cross(along)] {
                        let expected = scale / (1.0 + s);
                        assert!((extent(&shape, across) / expected - 1.0).abs() < 1e-5, "{shape:?}");
                    }
                }
            }
        }
    }

    #[test]
    fn only_moving_particles_are_stretched() {
        let infinite = f32::INFINITY;
        let velocities = [0.0, 0.0, 0.0, f32::NAN, 1.0, 0.0, -infinite, infinite, 0.0, 1e-40, 0.0, 0.0];
        let shaped = from_velocities(&velocities, None, &CONFIG);
        assert_eq!((shaped.ball_count, shaped.raised_count), (2, 0));
        for (shape, expected) in shaped.shapes.iter().zip([1.0; 4].map(Ellipsoid::ball)) {
            assert_eq!(*shape, expected);
        }
        let none = from_velocities(&[], None, &CONFIG);
        assert_eq!((none.shapes.len(), none.ball_count), (0, 0));
    }

    #[test]
    fn half_axes_below_the_floor_are_raised_and_counted() {
        let config = VelocityConfig { floor: 0.8, ..CONFIG };
        let velocities = [2.0, 0.0, 0.0, 0.2, 0.0, 0.0, 0.0, 0.0, 0.0];
        let shaped = from_velocities(&velocities, Some(&[1.0, 1.0, 0.5]), &config);
        assert_eq!(shaped.raised_count, 2);
        assert!((extent(&shaped.shapes[0], Vec3::Y) - 0.8).abs() < 1e-6);
        assert!((shaped.shapes[0].longest - 4.0).abs() < 1e-5);
        assert!((extent(&shaped.shapes[1], Vec3::Y) - 1.0 / 1.1).abs() < 1e-6);
        assert_eq!(shaped.shapes[2], Ellipsoid::ball(0.8));
    }

    #[test]
    fn invalid_scales_become_the_smallest() {
        for scale in [f32::NAN, -1.0, 0.0, f32::INFINITY] {
            assert_eq!(shape(Vec3::ZERO, scale), Ellipsoid::ball(0.01));
            assert_eq!(shape(Vec3::X, scale).longest, 0.01);
        }
    }

    #[test]
    fn cube_roots_are_accurate_to_the_last_bits() {
        let mut value = 1e-12f32;
        while value < 1e12 {
            let expected = f64::from(value).cbrt();
            let error = f64::from(cube_root(value)) / expected - 1.0;
            assert!(error.abs() < 3e-7, "{error} for {value}");
            value *= 1.003;
        }
    }

    struct Decompose([[f32; 8]; 6]);

    impl Kernel for Decompose {
        /// The eigenvalues, then x, y and z of each eigenvector.
        type Output = [[f32; 8]; 12];

        #[inline(always)]
        fn run<V: Lanes>(self) -> [[f32; 8]; 12] {
            let [a, b, c, d, e, f] = &self.0;
            let eigen: Eigen<V> =
                eigen([V::load(a), V::load(b), V::load(c), V::load(d), V::load(e), V::load(f)]);
            let mut rows = [[0.0; 8]; 12];
            for k in 0..3 {
                eigen.values[k].store(&mut rows[k]);
                for axis in 0..3 {
                    eigen.vectors[k][axis].store(&mut rows[3 + 3 * k + axis]);
                }
            }
            rows
        }
    }

    /// The largest error: of M·v compared to λ·v, and of the dot products of the vectors compared to those of
    /// orthonormal vectors.
    fn error(matrices: [[f32; 8]; 6], level: SimdLevel) -> f64 {
        let rows = dispatch_at(level, Decompose(matrices));
        let mut error = 0f64;
        for lane in 0..8 {
            let [xx, yy, zz, xy, xz, yz] = matrices.map(|row| f64::from(row[lane]));
            let columns = [DVec3::new(xx, xy, xz), DVec3::new(xy, yy, yz), DVec3::new(xz, yz, zz)];
            let matrix = DMat3::from_cols(columns[0], columns[1], columns[2]);
            let vectors: [DVec3; 3] = std::array::from_fn(|k| {
                DVec3::from(std::array::from_fn(|axis| f64::from(rows[3 + 3 * k + axis][lane])))
            });
            for k in 0..3 {
                let value = f64::from(rows[k][lane]);
                error = error.max((matrix * vectors[k] - value * vectors[k]).length());
                for other in 0..3 {
                    let expected = f64::from(u8::from(k == other));
                    error = error.max((vectors[k].dot(vectors[other]) - expected).abs());
                }
            }
        }
        error
    }

    #[test]
    fn eigenvectors_map_to_multiples_of_themselves() {
        let mut state = 5u32;
        let mut random = || {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (state >> 8) as f32 / (1 << 23) as f32 - 1.0
        };
        for round in 0..2000 {
            // The matrices range from full to nearly diagonal; some have equal entries.
            let off = 0.3f32.powi(round % 40);
            let mut matrices: [[f32; 8]; 6] = std::array::from_fn(|entry| {
                std::array::from_fn(|_| if entry < 3 { random() } else { off * random() })
            });
            if round % 3 == 0 {
                matrices[1] = matrices[0];
            }
            if round % 6 == 0 {
                (matrices[2], matrices[4]) = (matrices[0], matrices[3]);
            }
            for level in SimdLevel::ALL {
                let error = error(matrices, level);
                assert!(error < 2e-6, "{error} for {matrices:?}");
            }
        }
    }

    #[test]
    fn diagonal_matrices_stay_unchanged() {
        let tiny = f32::MIN_POSITIVE;
        let cases = [[0.0; 6], [1.0, 1.0, 1.0, 0.0, 0.0, 0.0], [0.5, 0.5, 0.5, tiny, -tiny, 1e-20], [1.0; 6]];
        for entries in cases {
            let error = error(entries.map(|entry| [entry; 8]), SimdLevel::Baseline);
            assert!(error < 1e-6, "{error} for {entries:?}");
        }
    }
}
