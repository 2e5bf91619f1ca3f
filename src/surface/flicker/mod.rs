//! Flicker of a sequence of surfaces: how far points on a surface stray from smooth motion between three frames.
//!
//! ```text
//!   frame t − 1          frame t           frame t + 1
//!      ╭──╮     ◀──────   ─●─    ──────▶     ╭─╮          a point ● on the surface of t is carried by the particles;
//!    ──╯ ● ╰──                             ──╯●╰──        s(t ± 1) is its signed distance to the surface there
//!
//!   flicker of the point = (s(t − 1) − 2 s(t) + s(t + 1)) / d       s(t) = 0; d is the particle spacing
//! ```
//!
//! A surface that moves with its particles scores 0, however fast, and one that grows evenly along them scores nearly 0: what is
//! of first order in time cancels. `docs/flicker.md` has the definition for users.
//!
//! Invariants: the same frames give the same bits on any number of threads; scaling positions and spacing by a power of two
//! changes no value.

mod carry;
mod sampling;
mod summary;
#[cfg(test)]
mod tests;

use glam::DVec3;
use rayon::prelude::*;
use rustc_hash::FxHashMap;

use crate::surface::neighbors::Neighbors;
use crate::surface::obstacle::MeshDistance;
use crate::surface::particles::Particles;

pub use carry::CARRY_REACH;
pub use summary::Summary;

use carry::carried;
use sampling::samples;

/// The greatest distance from a surface that counts, in spacings.
pub const REACH: f64 = 2.0;

/// What carries points from a frame to the next.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Carrier {
    /// The positions of particles with the same id.
    Ids,
    /// The velocities of particles.
    Velocities {
        /// The time between the frames, in the seconds of the velocities.
        seconds: f64,
    },
}

/// The particles of a frame, and their motion.
#[derive(Clone, Debug)]
pub struct MovingParticles {
    /// Where they are, world units.
    pub positions: Particles,
    /// The identity of each over time. Those that several particles share carry nothing.
    pub ids: Option<Vec<i64>>,
    /// World units per second.
    pub velocities: Option<Vec<[f32; 3]>>,
}

/// A frame: its particles and its surface.
pub struct FlickerFrame {
    particles: MovingParticles,
    near: Neighbors,
    /// The particle of each id that only one has.
    index_of: FxHashMap<i64, u32>,
    surface: MeshDistance,
}

/// A point on a surface.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ScoredPoint {
    /// World units.
    pub position: DVec3,
    /// Unit vector out of the surface.
    pub normal: DVec3,
    /// Its flicker in spacings, signed: positive where the surface of the middle frame bulges.
    pub value: f64,
}

/// The flicker of a frame between its neighbours.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct FrameFlicker {
    /// Points that were carried to both neighbours.
    pub points: Vec<ScoredPoint>,
    /// Other points: no particle near them carries to both neighbours.
    pub uncarried_count: usize,
    /// Carried points that are [`REACH`] or farther from a surface, and count as if they were so far.
    pub left_count: usize,
}

impl FlickerFrame {
    /// Prepares a frame for particles that are `spacing` apart, in world units: positive and finite.
    ///
    /// Ids and velocities must be as many as positions; others are not used.
    pub fn new(mut particles: MovingParticles, surface: MeshDistance, spacing: f64) -> FlickerFrame {
        let count = particles.positions.len();
        particles.ids = particles.ids.filter(|ids| ids.len() == count);
        particles.velocities = particles.velocities.filter(|velocities| velocities.len() == count);
        let near = Neighbors::new(&particles.positions, carry::SEARCHED * spacing);
        let index_of = index_of(particles.ids.as_deref().unwrap_or_default());
        FlickerFrame { particles, near, index_of, surface }
    }

    /// Its surface.
    pub fn surface(&self) -> &MeshDistance {
        &self.surface
    }

    /// Whether it has particles.
    pub fn has_particles(&self) -> bool {
        !self.particles.positions.is_empty()
    }

    /// Whether its particles, if it has some, have what this takes: ids of which at most half are shared, or velocities.
    pub fn has(&self, carrier: Carrier) -> bool {
        match carrier {
            Carrier::Ids => 2 * self.index_of.len() >= self.particles.positions.len(),
            Carrier::Velocities { .. } => !self.has_particles() || self.particles.velocities.is_some(),
        }
    }
}

/// Which particle has an id, where only one has it.
fn index_of(ids: &[i64]) -> FxHashMap<i64, u32> {
    const SHARED: u32 = u32::MAX;
    let mut index_of = FxHashMap::default();
    for (&id, index) in ids.iter().zip(0u32..SHARED) {
        index_of.entry(id).and_modify(|known| *known = SHARED).or_insert(index);
    }
    index_of.retain(|_, index| *index != SHARED);
    index_of
}

/// The flicker of the frame in the middle, at `sample_count` points, evenly by area. `spacing` is that of all three frames.
///
/// A frame without particles that carry has no carried points; one without a surface has no points at all.
pub fn flicker(
    [before, middle, after]: [&FlickerFrame; 3],
    carrier: Carrier,
    spacing: f64,
    sample_count: usize,
) -> FrameFlicker {
    let limit = REACH * spacing;
    let distance = |to: &FlickerFrame, seconds_sign: f64, point: DVec3| {
        let place = carried(middle, to, carrier, seconds_sign, point, spacing)?;
        // Without a surface everything is outside.
        Some(to.surface.distance(place).unwrap_or(f64::INFINITY).clamp(-limit, limit))
    };
    let score = |(position, normal): (DVec3, DVec3)| {
        let [one, other] = [distance(before, -1.0, position)?, distance(after, 1.0, position)?];
        let has_left = one.abs() >= limit || other.abs() >= limit;
        Some((ScoredPoint { position, normal, value: (one + other) / spacing }, has_left))
    };
    let samples = samples(middle.surface.triangles(), sample_count);
    let scored: Vec<Option<(ScoredPoint, bool)>> = samples.into_par_iter().map(score).collect();
    let mut found = FrameFlicker::default();
    for scored in scored {
        match scored {
            Some((point, has_left)) => {
                found.points.push(point);
                found.left_count += usize::from(has_left);
            }
            None => found.uncarried_count += 1,
        }
    }
    found
}
