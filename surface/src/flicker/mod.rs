//! Flicker of a sequence of surfaces: how much points on a surface deviate from smooth motion over three
//! frames.
//!
//! ```text
//!   frame t − 1          frame t           frame t + 1
//!      ╭──╮     ◀──────   ─●─    ──────▶     ╭─╮          particles carry a point ● on the surface of t;
//!    ──╯ ● ╰──                             ──╯●╰──        s(t ± 1) is its signed distance to the surface there
//!
//!   flicker of the point = (s(t − 1) − 2 s(t) + s(t + 1)) / d       s(t) = 0; d is the particle spacing
//! ```
//!
//! A surface that moves with its particles scores 0, however fast they move. A surface that grows or thins at
//! a constant rate scores nearly 0, because terms of first order in time cancel. `docs/flicker.md` has the
//! definition for users.
//!
//! Invariants: the same frames give the same bits on any number of threads; scaling positions and spacing by
//! a power of two changes no value.

mod carry;
mod sampling;
mod summary;
#[cfg(test)]
mod tests;

use glam::DVec3;
use rayon::prelude::*;
use rustc_hash::FxHashMap;

use crate::neighbors::Neighbors;
use crate::obstacle::MeshDistance;
use crate::parallel::Loops as _;
use crate::particles::OwnedPositions;

pub use carry::CARRY_REACH;
pub use summary::Distribution;

use carry::carry;
use sampling::samples;

/// Upper limit of the distances from a surface, in spacings; larger ones are clamped.
pub const REACH: f64 = 2.0;

/// How points are carried to the frame before and the frame after.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Carrier {
    /// By the positions of particles with the same id.
    Ids,
    /// By the velocities of particles.
    Velocities {
        /// The time between the frames, in the time unit of the velocities.
        seconds: f64,
    },
}

/// The particles of a frame, and their motion.
#[derive(Clone, Debug)]
pub struct MovingParticles {
    /// Positions, world units.
    pub positions: OwnedPositions,
    /// The id of each particle, constant over time. Ids that several particles share are not used.
    pub ids: Option<Vec<i64>>,
    /// Velocities, world units per second.
    pub velocities: Option<Vec<[f32; 3]>>,
}

/// A frame: its particles and its surface.
pub struct FlickerFrame {
    particles: MovingParticles,
    near: Neighbors,
    /// The particle of each unique id.
    index_of: FxHashMap<i64, u32>,
    surface: MeshDistance,
}

/// A point on a surface.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ScoredPoint {
    /// Its position, world units.
    pub position: DVec3,
    /// Outward unit normal of the surface.
    pub normal: DVec3,
    /// Its flicker in spacings, signed: positive if the surface of the middle frame bulges.
    pub value: f64,
}

/// The flicker of a frame, relative to the frames before and after it.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct FrameFlicker {
    /// Points that were carried to the frames before and after.
    pub points: Vec<ScoredPoint>,
    /// Number of other points: no particle near them can be followed to both of these frames.
    pub untracked_count: usize,
    /// Number of carried points whose distance from a surface was clamped to [`REACH`].
    pub clamped_count: usize,
}

impl FlickerFrame {
    /// Prepares a frame whose particles are `spacing` apart, world units: positive and finite.
    ///
    /// Ids and velocities are ignored unless there are as many as positions.
    pub fn new(mut particles: MovingParticles, surface: MeshDistance, spacing: f64) -> FlickerFrame {
        let count = particles.positions.len();
        particles.ids = particles.ids.filter(|ids| ids.len() == count);
        particles.velocities = particles.velocities.filter(|velocities| velocities.len() == count);
        let near = Neighbors::new(&particles.positions, carry::SEARCH_RADIUS * spacing);
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

    /// Whether points can be carried this way by its particles, if it has any: by ids, if at least half of
    /// the particles have an id of their own, or by velocities.
    pub fn has(&self, carrier: Carrier) -> bool {
        match carrier {
            Carrier::Ids => 2 * self.index_of.len() >= self.particles.positions.len(),
            Carrier::Velocities { .. } => !self.has_particles() || self.particles.velocities.is_some(),
        }
    }
}

/// The particle of each id that is unique.
fn index_of(ids: &[i64]) -> FxHashMap<i64, u32> {
    const SHARED: u32 = u32::MAX;
    let mut index_of = FxHashMap::default();
    for (&id, index) in ids.iter().zip(0u32..SHARED) {
        index_of.entry(id).and_modify(|known| *known = SHARED).or_insert(index);
    }
    index_of.retain(|_, index| *index != SHARED);
    index_of
}

/// The flicker of the middle frame at `sample_count` points, which are distributed evenly by area. `spacing`
/// is the particle spacing of all three frames, world units.
///
/// If the middle frame has no particles, no point is carried; if it has no surface, the result has no points.
pub fn flicker(
    [before, middle, after]: [&FlickerFrame; 3],
    carrier: Carrier,
    spacing: f64,
    sample_count: usize,
) -> FrameFlicker {
    let limit = REACH * spacing;
    let distance = |to: &FlickerFrame, seconds_sign: f64, point: DVec3| {
        let carried = carry(middle, to, carrier, seconds_sign, point, spacing)?;
        // Without a surface, every point is outside.
        Some(to.surface.distance(carried).unwrap_or(f64::INFINITY).clamp(-limit, limit))
    };
    let score = |(position, normal): (DVec3, DVec3)| {
        let [one, other] = [distance(before, -1.0, position)?, distance(after, 1.0, position)?];
        let has_left = one.abs() >= limit || other.abs() >= limit;
        Some((ScoredPoint { position, normal, value: (one + other) / spacing }, has_left))
    };
    let samples = samples(middle.surface.triangles(), sample_count);
    let scored: Vec<Option<(ScoredPoint, bool)>> = samples.into_par_iter().halved().map(score).collect();
    let mut found = FrameFlicker::default();
    for scored in scored {
        match scored {
            Some((point, has_left)) => {
                found.points.push(point);
                found.clamped_count += usize::from(has_left);
            }
            None => found.untracked_count += 1,
        }
    }
    found
}
