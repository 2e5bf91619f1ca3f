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

mod pieces;

use glam::DVec3;
use rayon::prelude::*;

use crate::motion::{BEYOND_NEAREST, Mean, TrackedParticles};
pub use crate::motion::{Carrier, MovingParticles};
use crate::obstacle::MeshDistance;
use crate::parallel::Loops as _;
pub use pieces::{Enclosed, enclosed};

/// Upper limit of the distances from a surface, in spacings; larger ones are clamped.
pub const REACH: f64 = 2.0;

/// A frame: its particles and its surface.
pub struct FlickerFrame {
    particles: TrackedParticles,
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
    pub fn new(particles: MovingParticles, surface: MeshDistance, spacing: f64) -> FlickerFrame {
        FlickerFrame { particles: TrackedParticles::new(particles, SEARCH_RADIUS * spacing), surface }
    }

    /// Its surface.
    pub fn surface(&self) -> &MeshDistance {
        &self.surface
    }

    /// Whether it has particles.
    pub fn has_particles(&self) -> bool {
        !self.particles.positions().is_empty()
    }

    /// Whether its particles can carry points this way: by ids, if at least half of them have an id that no
    /// other has; by velocities, if they have velocities. True without particles.
    pub fn has(&self, carrier: Carrier) -> bool {
        self.particles.has(carrier)
    }
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
    let distance = |to: &FlickerFrame, direction: f64, point: DVec3| {
        carried_distance(middle, to, carrier, direction, point, spacing)
    };
    let score = |(position, normal): (DVec3, DVec3)| {
        let [one, other] = [distance(before, -1.0, position)?, distance(after, 1.0, position)?];
        let is_clamped = one.abs() >= REACH || other.abs() >= REACH;
        Some((ScoredPoint { position, normal, value: one + other }, is_clamped))
    };
    let samples = samples(middle.surface.triangles(), sample_count);
    let scored: Vec<Option<(ScoredPoint, bool)>> = samples.into_par_iter().halved().map(score).collect();
    let mut found = FrameFlicker::default();
    for scored in scored {
        match scored {
            Some((point, is_clamped)) => {
                found.points.push(point);
                found.clamped_count += usize::from(is_clamped);
            }
            None => found.untracked_count += 1,
        }
    }
    found
}

/// The signed distances, in spacings, from the surface of `to` to points on the surface of `from` that its
/// particles carry there: positive outside, at most [`REACH`]. There are `sample_count` points, distributed
/// evenly by area; `None` is a point that no particle carries.
///
/// `to` is a later frame. The time of [`Carrier::Velocities`] is that between the two frames.
pub fn carried_distances(
    from: &FlickerFrame,
    to: &FlickerFrame,
    carrier: Carrier,
    spacing: f64,
    sample_count: usize,
) -> Vec<Option<f64>> {
    let distance =
        |(position, _): (DVec3, DVec3)| carried_distance(from, to, carrier, 1.0, position, spacing);
    samples(from.surface.triangles(), sample_count).into_par_iter().halved().map(distance).collect()
}

/// How far a surface lags behind another surface of the same frame, in spacings: the mean of the distances of its
/// points from `own`, positive behind it in the direction of motion, weighted by how far the particles carry the
/// point along its normal until the frame `to`. `None` if none moves.
///
/// There are `sample_count` points, distributed evenly by area. Distances are clamped to [`REACH`].
pub fn lag(
    from: &FlickerFrame,
    to: &FlickerFrame,
    own: &MeshDistance,
    carrier: Carrier,
    spacing: f64,
    sample_count: usize,
) -> Option<f64> {
    let of_point = |(position, normal): (DVec3, DVec3)| {
        let carried = carry(&from.particles, &to.particles, carrier, 1.0, position, spacing)?;
        let motion = (carried - position).dot(normal);
        let distance = (own.distance(position)? / spacing).clamp(-REACH, REACH);
        Some([-distance * motion, motion.abs()])
    };
    let points = samples(from.surface.triangles(), sample_count);
    let found: Vec<Option<[f64; 2]>> = points.into_par_iter().halved().map(of_point).collect();
    let [behind, motion] = found
        .into_iter()
        .flatten()
        .fold([0.0; 2], |sum, of_point| [sum[0] + of_point[0], sum[1] + of_point[1]]);
    (motion > 0.0).then(|| behind / motion)
}

/// The signed distance of a carried point from the surface of `to`, in spacings, clamped to [`REACH`].
fn carried_distance(
    from: &FlickerFrame,
    to: &FlickerFrame,
    carrier: Carrier,
    direction: f64,
    point: DVec3,
    spacing: f64,
) -> Option<f64> {
    let carried = carry(&from.particles, &to.particles, carrier, direction, point, spacing)?;
    // Without a surface, every point is outside.
    let distance = to.surface.distance(carried).unwrap_or(f64::INFINITY);
    Some((distance / spacing).clamp(-REACH, REACH))
}

// Carries points along with the particles.
//
//     ∙   ∙   ∙
//      ∙  ●──────▶ ○      the mean displacement of the particles around the point, weighted by (1 − r²/R²)³:
//     ∙   ∙   ∙           r is a particle's distance, R the distance of the nearest one plus one spacing

/// A point is carried if a particle is closer than this, in spacings. With strong smoothing, surfaces are
/// this far from their particles.
pub const CARRY_REACH: f64 = 3.0;

/// Search radius for the weighted particles, in spacings. It is also the limit for the distance of the
/// nearest particle from a predicted position, because the prediction may be off by this much.
const SEARCH_RADIUS: f64 = CARRY_REACH + BEYOND_NEAREST;

/// The position of a point of `from` in the frame `to`, the next one (`direction` 1) or the previous one
/// (−1). `None` if no particle within reach carries it.
fn carry(
    from: &TrackedParticles,
    to: &TrackedParticles,
    carrier: Carrier,
    direction: f64,
    point: DVec3,
    spacing: f64,
) -> Option<DVec3> {
    let limit = CARRY_REACH * spacing;
    let displacement = match carrier {
        Carrier::Ids => {
            let displacement = |index: usize| from.displacement_by_id(index, to);
            from.mean(point, limit, spacing, displacement)?.vector
        }
        Carrier::Velocities { seconds } => {
            // Evaluated at the particles' mean position instead of on the surface, because more particles
            // surround the mean position.
            let Mean { vector: here, position } =
                from.mean(point, limit, spacing, |index| from.velocity(index))?;
            let step = direction * seconds;
            let [displacement, _] =
                TrackedParticles::displacement_by_velocity(to, position, here, step, spacing)?;
            displacement
        }
    };
    Some(point + displacement).filter(|position| position.is_finite())
}

// Samples points on a surface, evenly by area. The same triangles give the same points.
//
//   |  1  |2|    3    |4|  5   |      the areas of the triangles, end to end
//     ●   ● | ●   ●   ●   ●   ●       N points: one in the middle of each of N equal parts of the area;
//                                     its position in its triangle is a term of a low-discrepancy sequence
//
// Martin Roberts. The unreasonable effectiveness of quasirandom sequences. 2018

/// The fractions that define the sequence: 1/g and 1/g², with g³ = g + 1.
const STEPS: [f64; 2] = [0.754_877_666_246_692_7, 0.569_840_290_998_053_3];

/// `count` points on triangles of positive total area, each with the normal of its triangle. Empty if there
/// are no triangles.
fn samples(triangles: &[[DVec3; 3]], count: usize) -> Vec<(DVec3, DVec3)> {
    if triangles.is_empty() {
        return Vec::new();
    }
    let mut ends = Vec::with_capacity(triangles.len());
    let mut area = 0.0;
    for [a, b, c] in triangles {
        area += 0.5 * (*b - a).cross(*c - a).length();
        ends.push(area);
    }
    let sample = |index: usize| {
        let along = area * (index as f64 + 0.5) / count as f64;
        let triangle = ends.partition_point(|&end| end <= along).min(triangles.len() - 1);
        let [a, b, c] = triangles[triangle];
        let [mut u, mut v] = STEPS.map(|step| (0.5 + step * index as f64).fract());
        // Mirror the other half of the parallelogram onto this triangle.
        if u + v > 1.0 {
            (u, v) = (1.0 - u, 1.0 - v);
        }
        (a + (b - a) * u + (c - a) * v, (b - a).cross(c - a).normalize_or_zero())
    };
    (0..count).map(sample).collect()
}

// Summary statistics.

/// Statistics of the magnitudes of numbers.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Distribution {
    /// How many numbers were summarized; if 0, all other fields are 0.
    pub count: usize,
    /// Root mean square.
    pub rms: f64,
    /// Median magnitude.
    pub median: f64,
    /// 99th percentile of the magnitudes.
    pub percentile_99: f64,
    /// Largest magnitude.
    pub max: f64,
}

impl Distribution {
    /// The summary of these numbers. Their order affects only the rounding of `rms`.
    pub fn of(values: impl IntoIterator<Item = f64>) -> Distribution {
        let mut sizes: Vec<f64> = values.into_iter().map(f64::abs).collect();
        let count = sizes.len();
        if count == 0 {
            return Distribution::default();
        }
        let rms = (sizes.iter().map(|size| size * size).sum::<f64>() / count as f64).sqrt();
        let mut of_rank = |part: f64| {
            let rank = ((part * count as f64).ceil() as usize).clamp(1, count) - 1;
            *sizes.select_nth_unstable_by(rank, f64::total_cmp).1
        };
        Distribution { count, rms, median: of_rank(0.5), percentile_99: of_rank(0.99), max: of_rank(1.0) }
    }
}

#[cfg(test)]
mod tests;
