//! Weighted moments of the neighbours of each particle.
//!
//! ```text
//!   surroundings   ∙∙∙∙∙∙∙∙ ∙∙∙∙∙∙∙∙ ∙∙∙∙∙∙∙∙       the squared distances are computed, eight at a time
//!                   ╲ ╲   ╱   │   ╱   ╱
//!   within          ∙∙∙∙∙∙∙∙ ∙∙∙                    particles within the radius are compacted, then summed
//! ```
//!
//! Particles beyond the radius are left out instead of being multiplied by zero. So they do not affect the
//! order in which numbers are added, and cannot change the last bit of a sum.
//!
//! For a particle at p, with w = 1 − (d/R)³ (Yu and Turk 2010, Eq. 11) for a particle x at the distance d,
//! the sums are W = Σ w, Σ w·(x − p) and Σ w·(x − p)(x − p)ᵀ over all x, including p itself. The differences
//! x − p are small numbers, so mean and covariance (Eq. 9 and 10) lose no precision.

use glam::Vec3;

use crate::neighbors::Particle8;
use crate::simd::Lanes;

/// Number of sums: W; then the sums of w·x, w·y and w·z; then those of w·xx, w·yy, w·zz, w·xy, w·xz and w·yz.
pub(super) const MOMENT_COUNT: usize = 10;

/// The means need only this number of sums: the first ones.
pub(super) const MEAN_COUNT: usize = 4;

/// The first `COUNT` moments around a particle at `at`, in units of the radius. `within` is a buffer.
#[inline(always)]
pub(super) fn moments<V: Lanes, const COUNT: usize>(
    eights: &[Particle8],
    at: Vec3,
    within: &mut Vec<u32>,
) -> [f32; COUNT] {
    let count = find_within::<V>(eights, at, within);
    let (full, rest) = within[..count].as_chunks::<8>();
    let mut sums = [V::splat(0.0); COUNT];
    for indices in full {
        let mut particles = ParticlePacket::NONE;
        particles.take(eights, indices);
        add_moments(&mut sums, &particles, at);
    }
    if !rest.is_empty() {
        let mut particles = ParticlePacket::NONE;
        particles.take(eights, rest);
        add_moments(&mut sums, &particles, at);
    }
    let mut moments = [0.0; COUNT];
    for (moment, sum) in moments.iter_mut().zip(sums) {
        *moment = total(sum);
    }
    moments
}

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

#[inline(always)]
fn add_moments<V: Lanes, const COUNT: usize>(sums: &mut [V; COUNT], particles: &ParticlePacket, at: Vec3) {
    let dx = V::load(&particles.along[0]).sub(V::splat(at.x));
    let dy = V::load(&particles.along[1]).sub(V::splat(at.y));
    let dz = V::load(&particles.along[2]).sub(V::splat(at.z));
    let squared = dx.mul(dx).add(dy.mul(dy)).add(dz.mul(dz));
    let fallen = V::splat(1.0).sub(squared.mul(squared.sqrt()));
    let weight = fallen.mul(V::load(&particles.multiplicity));
    let (x, y, z) = (weight.mul(dx), weight.mul(dy), weight.mul(dz));
    let terms = [weight, x, y, z, x.mul(dx), y.mul(dy), z.mul(dz), x.mul(dy), x.mul(dz), y.mul(dz)];
    for (sum, term) in sums.iter_mut().zip(terms) {
        *sum = sum.add(term);
    }
}

#[inline(always)]
fn total<V: Lanes>(values: V) -> f32 {
    let mut row = [0.0; 8];
    values.store(&mut row);
    let [a, b, c, d, e, f, g, h] = row;
    ((a + e) + (c + g)) + ((b + f) + (d + h))
}
