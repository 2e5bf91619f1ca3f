//! Shapes from the neighbours of each particle: flat in a sheet, long in a filament, balls inside a body.
//!
//! ```text
//!        ∙ ∙ ∙           w(d) = (1 − (d/R)³)², 0 from R on
//!      ∙  ∙   ∙
//!     ∙  ∙ ●──∙─── R     weighted covariance of the particles within R, around their mean
//!      ∙   ∙  ∙
//!        ∙ ∙             including ● itself
//! ```
//!
//! At the plane surface of a body, all particles within R are on one side. Their standard deviation normal to
//! the surface is 0.56 of that along the surface: not flat enough for a flat particle.
//!
//! (Yu and Turk use 1 − (d/R)³, whose slope jumps at R: a neighbour that comes within reach would pull
//! suddenly.)
//!
//! Position smoothing moves particles toward the mean of their neighbours (Yu and Turk, Eq. 6), the less
//! company they have the less far: drops that come close do not attract each other. As in their method,
//! shapes are computed from the positions before the move. So one search finds the neighbours for
//! means and shapes, and the shape of a particle depends only on particles within R.
//!
//! Particles are sorted by cells of a grid with edge R. Each task gets the same number of particles, not of
//! cells. In cells with more than [`CELL_MAX`] particles only a sample is used. Then a shape also depends on
//! particles beyond R: on those in the cells that intersect the ball of radius R.

use glam::Vec3;
use rayon::prelude::*;

use super::{Surroundings, is_in_full_company, scale_of};
use crate::neighbors::{NeighborPackets, Neighbors, Particle8};
use crate::parallel::Loops as _;
use crate::particles::{Ellipsoid, OwnedPositions, kernel};
use crate::simd::{Kernel, Lanes, SimdLevel, dispatch_at};

/// How neighbours shape particles.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct NeighborConfig {
    /// R: particles farther away are not neighbours. World units, positive.
    pub radius_world: f64,
    /// Factor from a sum of weights within the radius to one within 2.6 spacings, for which the limits of
    /// company are given.
    pub weight_scale: f32,
    /// The spacing of particles of scale 1 with their own size, over the spacing of the sequence: 1 without
    /// per-particle radii.
    pub own_spacing: f32,
    /// How particles are stretched; `None` if only means are needed.
    pub stretch: Option<Stretch>,
}

/// Limits of the semi-axes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Stretch {
    /// Upper limit of the ratio of two semi-axes, before they are raised to the floor: 1 or more.
    pub max_stretch: f32,
    /// Lower limit of semi-axes, in units of the settings' radii. Positive.
    pub floor: f32,
    /// How particles become kernels; `None` if the surface starts from spheres.
    pub kernels: Option<KernelConfig>,
}

/// How particles become kernels.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct KernelConfig {
    /// The neighbour radius over the reach of the kernel of a particle of scale 1.
    pub per_reach: f32,
    /// How far the surface may move inward where fluid is thin, in voxels; less at particles with a smaller radius of
    /// their own.
    pub room_least: f32,
    /// The same for a body.
    pub room_most: f32,
}

/// The means and shapes of the wanted particles, computed from their neighbours.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct NeighborShapes {
    /// Indices of the wanted particles, each once.
    pub indices: Vec<u32>,
    /// For each wanted particle, the mean position of its neighbours relative to the particle (Yu and Turk,
    /// Eq. 6) times its company, in units of R.
    pub means: Vec<[f32; 3]>,
    /// The shape of each wanted particle; empty if shapes are not needed.
    pub shapes: Vec<Ellipsoid>,
    /// Number of particles with a semi-axis that was raised to the floor.
    pub raised_count: usize,
    /// Number of particles that are balls because they have too few neighbours.
    pub ball_count: usize,
}

/// Upper limit of the number of particles that are used per cell: 7 times the number in a cell with an edge
/// of 2.6 spacings. It limits the cost of very dense particles to a microsecond per particle, independent of
/// their number.
const CELL_MAX: usize = 128;

/// Means and shapes of the wanted particles from their neighbours (Yu and Turk, Eq. 6 and 9 to 16). `scales`
/// has one entry per particle. Wanted particles outside the range of indices are left out.
///
/// The result for a particle does not depend on which other particles are wanted. Nor does it change if
/// `particles` lacks particles in cells of edge R that are not adjacent to its own cell, provided that the
/// others keep their order.
pub fn from_neighbors(
    particles: &OwnedPositions,
    is_wanted: impl Fn(usize) -> bool + Sync,
    scales: Option<&[f32]>,
    config: &NeighborConfig,
) -> NeighborShapes {
    neighbor_shapes(particles, is_wanted, scales, config, SimdLevel::current())
}

fn neighbor_shapes(
    particles: &OwnedPositions,
    is_wanted: impl Fn(usize) -> bool + Sync,
    scales: Option<&[f32]>,
    config: &NeighborConfig,
    level: SimdLevel,
) -> NeighborShapes {
    assert!(scales.is_none_or(|scales| scales.len() == particles.len()), "a scale for each particle");
    let neighbors = Neighbors::new(particles, config.radius_world);
    let in_order = (0u32..).zip(neighbors.indices());
    let slots: Vec<u32> =
        in_order.filter(|(_, index)| is_wanted(**index as usize)).map(|(slot, _)| slot).collect();
    let mut means = vec![[0.0f32; 3]; slots.len()];
    let shape_count = if config.stretch.is_some() { slots.len() } else { 0 };
    let mut shapes = vec![Ellipsoid::ball(1.0); shape_count];
    let counts = slots
        .par_chunks(PIECE)
        .zip_eq(means.par_chunks_mut(PIECE))
        .zip_eq(pieces_of(&mut shapes, slots.len()))
        .with_max_len(1)
        .halved()
        .map(|((slots, means), shapes)| {
            dispatch_at(level, ParticleRun { neighbors: &neighbors, scales, config, slots, means, shapes })
        })
        .reduce(ShapeCounts::default, ShapeCounts::merge);
    NeighborShapes {
        indices: slots.iter().map(|&slot| neighbors.indices()[slot as usize]).collect(),
        means,
        shapes,
        raised_count: counts.raised,
        ball_count: counts.balls,
    }
}

/// Number of particles per task. It is so large that the cost of the first and the last cell, which two tasks
/// gather, does not matter.
const PIECE: usize = 1024;

/// Splits the shapes of `count` particles into pieces, one for each task. The pieces are empty if shapes are
/// not needed.
fn pieces_of(shapes: &mut [Ellipsoid], count: usize) -> Vec<&mut [Ellipsoid]> {
    let mut pieces: Vec<&mut [Ellipsoid]> = shapes.chunks_mut(PIECE).collect();
    pieces.resize_with(count.div_ceil(PIECE), Default::default);
    pieces
}

#[derive(Clone, Copy, Default)]
struct ShapeCounts {
    raised: usize,
    balls: usize,
}

impl ShapeCounts {
    fn merge(self, other: ShapeCounts) -> ShapeCounts {
        ShapeCounts { raised: self.raised + other.raised, balls: self.balls + other.balls }
    }
}

/// The particles of a task: consecutive wanted particles in the order of the grid.
struct ParticleRun<'a> {
    neighbors: &'a Neighbors,
    scales: Option<&'a [f32]>,
    config: &'a NeighborConfig,
    /// Their indices in the grid.
    slots: &'a [u32],
    means: &'a mut [[f32; 3]],
    /// Empty if only means are needed.
    shapes: &'a mut [Ellipsoid],
}

impl Kernel for ParticleRun<'_> {
    type Output = ShapeCounts;

    /// Computes the moments of each particle, and from these its mean and its shape, eight at a time.
    #[inline(always)]
    fn run<V: Lanes>(mut self) -> ShapeCounts {
        let mut surroundings = NeighborPackets::default();
        let mut within: [Vec<u32>; 8] = Default::default();
        let mut counts = ShapeCounts::default();
        let mut first = 0;
        let mut cell_end = 0;
        while let Some(&slot) = self.slots.get(first) {
            if slot as usize >= cell_end {
                let cell = self.neighbors.cell_at(slot as usize);
                surroundings.gather(self.neighbors, self.neighbors.cells()[cell], CELL_MAX);
                cell_end = self.neighbors.slots(cell).end;
            }
            // Up to eight particles of a cell, because their kernels need the particles around once more.
            let is_in_cell = |slot: &&u32| (**slot as usize) < cell_end;
            let count = self.slots[first..].iter().take(8).take_while(is_in_cell).count();
            let mut moments = [[0.0f32; 8]; MOMENT_COUNT];
            let mut within_counts = [0; 8];
            for (lane, within) in within.iter_mut().enumerate().take(count) {
                let slot = self.slots[first + lane] as usize;
                let of_slot;
                (of_slot, within_counts[lane]) = self.moments_of::<V>(slot, surroundings.eights(), within);
                moments.iter_mut().zip(of_slot).for_each(|(row, moment)| row[lane] = moment);
            }
            counts = counts.merge(self.finish::<V>(&moments, first, count));
            for (lane, (within, count)) in within.iter().zip(within_counts).enumerate().take(count) {
                self.weigh::<V>(first + lane, surroundings.eights(), &within[..count]);
            }
            first += count;
        }
        counts
    }
}

impl ParticleRun<'_> {
    /// The moments of the particle in this slot, and the number of particles `within` its radius. If only means are needed
    /// and the particle is in full company, its mean is all that follows from them: then the second moments
    /// are 0.
    #[inline(always)]
    fn moments_of<V: Lanes>(
        &self,
        slot: usize,
        eights: &[Particle8],
        within: &mut Vec<u32>,
    ) -> ([f32; MOMENT_COUNT], usize) {
        let at = self.position(slot);
        let count = find_within::<V>(eights, at, within);
        let within = &within[..count];
        if self.config.stretch.is_none() {
            let sums = self.moments::<V, FIRST_MOMENT_COUNT>(slot, eights, within);
            if is_in_full_company(sums[0], self.weight_scale(slot)) {
                let mut moments = [0.0; MOMENT_COUNT];
                moments[..FIRST_MOMENT_COUNT].copy_from_slice(&sums);
                return (moments, count);
            }
        }
        (self.moments::<V, MOMENT_COUNT>(slot, eights, within), count)
    }

    /// The first `COUNT` moments around the particle in this slot, in units of the radius, of the particles `within` it. A
    /// smaller particle counts by its volume: it neither accompanies nor stretches a large one.
    #[inline(always)]
    fn moments<V: Lanes, const COUNT: usize>(
        &self,
        slot: usize,
        eights: &[Particle8],
        within: &[u32],
    ) -> [f32; COUNT] {
        let (at, own) = (self.position(slot), self.scale(slot));
        let mut sums = [V::splat(0.0); COUNT];
        // Whole packets have a length that the compiler knows.
        let (full, rest) = within.as_chunks::<8>();
        for indices in full {
            add_moments(&mut sums, &self.packet(own, eights, indices), at);
        }
        if !rest.is_empty() {
            add_moments(&mut sums, &self.packet(own, eights, rest), at);
        }
        let mut moments = [0.0; COUNT];
        for (moment, sum) in moments.iter_mut().zip(sums) {
            *moment = total(sum);
        }
        moments
    }

    /// At most eight particles around one of the scale `own`, smaller ones by their volume.
    #[inline(always)]
    fn packet(&self, own: f32, eights: &[Particle8], indices: &[u32]) -> ParticlePacket {
        let mut particles = ParticlePacket::NONE;
        particles.take(eights, indices);
        if self.scales.is_some() {
            for (multiplicity, &index) in particles.multiplicity.iter_mut().zip(indices) {
                let particle = eights[index as usize / 8].indices[index as usize % 8];
                let size = (scale_of(self.scales, particle as usize) / own).min(1.0);
                *multiplicity *= size * size * size;
            }
        }
        particles
    }

    /// Gives a particle the weight of its kernel: one over the sum at its centre of the kernels of the particles
    /// `within`, as if they had its shape, but their own sizes.
    #[inline(always)]
    fn weigh<V: Lanes>(&mut self, number: usize, eights: &[Particle8], within: &[u32]) {
        let Some(KernelConfig { per_reach, .. }) = self.config.stretch.and_then(|stretch| stretch.kernels)
        else {
            return;
        };
        let slot = self.slots[number] as usize;
        let (at, own) = (self.position(slot), self.scale(slot));
        let shape = self.shapes[number].to_unit_ball.map(|entry| entry * per_reach);
        let mut sum = V::splat(0.0);
        let (full, rest) = within.as_chunks::<8>();
        for indices in full {
            sum = sum.add(self.kernels::<V>(eights, indices, at, shape, own));
        }
        if !rest.is_empty() {
            sum = sum.add(self.kernels::<V>(eights, rest, at, shape, own));
        }
        self.shapes[number].weight = 1.0 / total(sum).max(1.0);
    }

    /// The kernels at `at` of at most eight particles, as of [`kernels_of`]: with this shape, of a particle of the scale
    /// `own`, but their own sizes.
    #[inline(always)]
    fn kernels<V: Lanes>(
        &self,
        eights: &[Particle8],
        indices: &[u32],
        at: Vec3,
        shape: [f32; 6],
        own: f32,
    ) -> V {
        let mut particles = ParticlePacket::NONE;
        particles.take(eights, indices);
        let mut sizes = [1.0f32; 8];
        if self.scales.is_some() {
            for (size, &index) in sizes.iter_mut().zip(indices) {
                let particle = eights[index as usize / 8].indices[index as usize % 8];
                *size = own / scale_of(self.scales, particle as usize);
            }
        }
        kernels_of(&particles, at, shape, &sizes)
    }

    fn position(&self, slot: usize) -> Vec3 {
        let [x, y, z] = self.neighbors.locals();
        Vec3::new(x[slot], y[slot], z[slot])
    }

    /// Factor from the sum of weights of the particle in this slot to the one that its company is computed
    /// from.
    fn weight_scale(&self, slot: usize) -> f32 {
        // Of larger particles fewer fit within the radius, and each represents more fluid.
        let size = (self.config.own_spacing * self.scale(slot)).max(1.0);
        self.config.weight_scale * (size * size * size)
    }

    fn scale(&self, slot: usize) -> f32 {
        scale_of(self.scales, self.neighbors.indices()[slot] as usize)
    }

    /// Computes means and shapes of up to eight particles, starting at `first`, from their moments.
    #[inline(always)]
    fn finish<V: Lanes>(
        &mut self,
        moments: &[[f32; 8]; MOMENT_COUNT],
        first: usize,
        count: usize,
    ) -> ShapeCounts {
        let (mut scales, mut weight_scales) = ([1.0; 8], [1.0; 8]);
        for (k, &slot) in self.slots[first..first + count].iter().enumerate() {
            (scales[k], weight_scales[k]) = (self.scale(slot as usize), self.weight_scale(slot as usize));
        }
        let surroundings = Surroundings::<V>::new(moments, &weight_scales);
        let means = surroundings.means();
        for (k, mean) in self.means[first..first + count].iter_mut().enumerate() {
            *mean = means.map(|along| along[k]);
        }
        let Some(stretch) = self.config.stretch else { return ShapeCounts::default() };
        let limits = Stretch { max_stretch: stretch.max_stretch.max(1.0), ..stretch };
        let mut eights = surroundings.shapes(&scales, limits);
        for (shape, scale) in eights.shapes.iter_mut().zip(scales) {
            // A small particle with its own radius would lose more of it than others.
            shape.room *= (self.config.own_spacing * scale).min(1.0);
        }
        self.shapes[first..first + count].copy_from_slice(&eights.shapes[..count]);
        let bits = ((1u16 << count) - 1) as u8;
        let [raised, balls] = [eights.raised & bits, eights.balls & bits].map(u8::count_ones);
        ShapeCounts { raised: raised as usize, balls: balls as usize }
    }
}

// Weighted moments of the neighbours of each particle.
//
//   surroundings   ∙∙∙∙∙∙∙∙ ∙∙∙∙∙∙∙∙ ∙∙∙∙∙∙∙∙       the squared distances are computed, eight at a time
//                   ╲ ╲   ╱   │   ╱   ╱
//   within          ∙∙∙∙∙∙∙∙ ∙∙∙                    particles within the radius are compacted, then summed
//
// Particles beyond the radius are left out instead of being multiplied by zero. So they do not affect the
// order in which numbers are added, and cannot change the last bit of a sum.
//
// For a particle at p, with w = (1 − (d/R)³)² for a particle x at the distance d (the square of Yu and Turk
// 2010, Eq. 11), the sums are W = Σ w, Σ w·(x − p) and Σ w·(x − p)(x − p)ᵀ over all x, including p itself.
// The differences x − p are small numbers, so mean and covariance (Eq. 9 and 10) lose no precision.

/// Number of sums: W; then the sums of w·x, w·y and w·z; then those of w·xx, w·yy, w·zz, w·xy, w·xz and w·yz.
pub(super) const MOMENT_COUNT: usize = 10;

/// Number of the first of them, from which the mean follows.
const FIRST_MOMENT_COUNT: usize = 4;

/// Writes the indices of the particles within the radius to the front of `within`. Returns their number.
#[inline(always)]
fn find_within<V: Lanes>(eights: &[Particle8], at: Vec3, within: &mut Vec<u32>) -> usize {
    // Each step writes eight indices. The next step overwrites those that are not within the radius.
    within.resize(8 * eights.len() + 8, 0);
    let [x, y, z] = [V::splat(at.x), V::splat(at.y), V::splat(at.z)];
    let mut count = 0;
    for (index, eight) in eights.iter().enumerate() {
        let dx = V::load(&eight.along[0]).sub(x);
        let dy = V::load(&eight.along[1]).sub(y);
        let dz = V::load(&eight.along[2]).sub(z);
        let squared = dx.mul(dx).add(dy.mul(dy)).add(dz.mul(dz));
        let bits = V::bits(squared.lt(V::splat(1.0)));
        let Some(next) = within[count..].first_chunk_mut::<8>() else { break };
        for (next, bit) in next.iter_mut().zip(SET_BITS[usize::from(bits)]) {
            *next = 8 * index as u32 + bit;
        }
        count += bits.count_ones() as usize;
    }
    count
}

/// For each 8-bit mask, the positions of its set bits in ascending order.
static SET_BITS: [[u32; 8]; 256] = set_bits();

const fn set_bits() -> [[u32; 8]; 256] {
    let mut table = [[0; 8]; 256];
    let mut bits = 0;
    while bits < 256 {
        let (mut bit, mut count) = (0, 0);
        while bit < 8 {
            if bits >> bit & 1 == 1 {
                table[bits][count] = bit;
                count += 1;
            }
            bit += 1;
        }
        bits += 1;
    }
    table
}

/// Eight particles from arbitrary positions. Unused lanes have a multiplicity of 0.
struct ParticlePacket {
    along: [[f32; 8]; 3],
    multiplicity: [f32; 8],
}

impl ParticlePacket {
    const NONE: ParticlePacket = ParticlePacket { along: [[0.0; 8]; 3], multiplicity: [0.0; 8] };

    #[inline(always)]
    fn take(&mut self, eights: &[Particle8], indices: &[u32]) {
        for (k, &index) in indices.iter().enumerate().take(8) {
            let (eight, lane) = (&eights[index as usize / 8], index as usize % 8);
            for axis in 0..3 {
                self.along[axis][k] = eight.along[axis][lane];
            }
            self.multiplicity[k] = eight.multiplicity[lane];
        }
    }
}

/// Written out, because `map` of an array is not inlined, and then each operation is a call.
#[inline(always)]
fn offsets_of<V: Lanes>(particles: &ParticlePacket, at: Vec3) -> [V; 3] {
    let [x, y, z] = &particles.along;
    [V::load(x).sub(V::splat(at.x)), V::load(y).sub(V::splat(at.y)), V::load(z).sub(V::splat(at.z))]
}

#[inline(always)]
fn add_moments<V: Lanes, const COUNT: usize>(sums: &mut [V; COUNT], particles: &ParticlePacket, at: Vec3) {
    let [dx, dy, dz] = offsets_of::<V>(particles, at);
    let squared = dx.mul(dx).add(dy.mul(dy)).add(dz.mul(dz));
    let fallen = V::splat(1.0).sub(squared.mul(squared.sqrt()));
    let weight = fallen.mul(fallen).mul(V::load(&particles.multiplicity));
    let (x, y, z) = (weight.mul(dx), weight.mul(dy), weight.mul(dz));
    let terms = [weight, x, y, z, x.mul(dx), y.mul(dy), z.mul(dz), x.mul(dy), x.mul(dz), y.mul(dz)];
    for (sum, term) in sums.iter_mut().zip(terms) {
        *sum = sum.add(term);
    }
}

/// The kernels of particles at `at`, each with this shape, in units of its reach, over its size.
#[inline(always)]
fn kernels_of<V: Lanes>(particles: &ParticlePacket, at: Vec3, shape: [f32; 6], sizes: &[f32; 8]) -> V {
    let [x, y, z] = offsets_of::<V>(particles, at);
    let [xx, yy, zz, xy, xz, yz] = shape.map(V::splat);
    let tx = xx.mul(x).add(xy.mul(y)).add(xz.mul(z));
    let ty = xy.mul(x).add(yy.mul(y)).add(yz.mul(z));
    let tz = xz.mul(x).add(yz.mul(y)).add(zz.mul(z));
    let q_squared = tx.mul(tx).add(ty.mul(ty)).add(tz.mul(tz));
    let size = V::load(sizes);
    kernel(q_squared.mul(size.mul(size))).mul(V::load(&particles.multiplicity))
}

#[inline(always)]
fn total<V: Lanes>(values: V) -> f32 {
    let mut row = [0.0; 8];
    values.store(&mut row);
    let [a, b, c, d, e, f, g, h] = row;
    ((a + e) + (c + g)) + ((b + f) + (d + h))
}

#[cfg(test)]
mod tests;
