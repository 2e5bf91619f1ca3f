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

use glam::{DVec3, Vec3};
use rayon::prelude::*;
use rustc_hash::FxHashMap;

use crate::neighbors::Neighbors;
use crate::obstacle::MeshDistance;
use crate::parallel::Loops as _;
use crate::particles::OwnedPositions;

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

impl Carrier {
    /// The carrier between frames that are `lag` times as far apart.
    pub fn over(self, lag: u32) -> Carrier {
        match self {
            Carrier::Ids => Carrier::Ids,
            Carrier::Velocities { seconds } => Carrier::Velocities { seconds: f64::from(lag) * seconds },
        }
    }
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
    neighbors: Neighbors,
    /// The particle of each id that only one particle has.
    index_of_id: FxHashMap<i64, u32>,
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
        let neighbors = Neighbors::new(&particles.positions, SEARCH_RADIUS * spacing);
        let index_of_id = unique_ids(particles.ids.as_deref().unwrap_or_default());
        FlickerFrame { particles, neighbors, index_of_id, surface }
    }

    /// Its surface.
    pub fn surface(&self) -> &MeshDistance {
        &self.surface
    }

    /// Whether it has particles.
    pub fn has_particles(&self) -> bool {
        !self.particles.positions.is_empty()
    }

    /// Whether its particles can carry points this way: by ids, if at least half of them have an id that no
    /// other has; by velocities, if they have velocities. True without particles.
    pub fn has(&self, carrier: Carrier) -> bool {
        match carrier {
            Carrier::Ids => 2 * self.index_of_id.len() >= self.particles.positions.len(),
            Carrier::Velocities { .. } => !self.has_particles() || self.particles.velocities.is_some(),
        }
    }

    /// The position of the particle with this id; `None` if no particle has it, or several have.
    fn position_of_id(&self, id: i64) -> Option<DVec3> {
        self.index_of_id.get(&id).map(|&index| self.particles.positions.position(index as usize))
    }
}

/// See [`FlickerFrame::index_of_id`].
fn unique_ids(ids: &[i64]) -> FxHashMap<i64, u32> {
    const SHARED: u32 = u32::MAX;
    let mut index_of_id = FxHashMap::default();
    for (&id, index) in ids.iter().zip(0u32..SHARED) {
        index_of_id.entry(id).and_modify(|known| *known = SHARED).or_insert(index);
    }
    index_of_id.retain(|_, index| *index != SHARED);
    index_of_id
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

/// The signed distance of a carried point from the surface of `to`, in spacings, clamped to [`REACH`].
fn carried_distance(
    from: &FlickerFrame,
    to: &FlickerFrame,
    carrier: Carrier,
    direction: f64,
    point: DVec3,
    spacing: f64,
) -> Option<f64> {
    let carried = carry(from, to, carrier, direction, point, spacing)?;
    // Without a surface, every point is outside.
    let distance = to.surface.distance(carried).unwrap_or(f64::INFINITY);
    Some((distance / spacing).clamp(-REACH, REACH))
}

// Carries points along with the particles.
//
//     ∙   ∙   ∙
//      ∙  ●──────▶ ○      the mean displacement of the particles around the point, weighted by (1 − r²/R²)³:
//     ∙   ∙   ∙           r is a particle's distance, R the distance of the nearest one plus one spacing
//
// With ids, the displacement of a particle is known. With velocities, it is the time step times the mean of
// the velocities at both ends (the trapezoidal rule), which is exact for a constant acceleration. The
// velocity at the far end is evaluated twice: at a predicted position and at the corrected one. With the
// velocity at the start only, a drop in free fall would flicker by g dt².

/// A point is carried if a particle is closer than this, in spacings. With strong smoothing, surfaces are
/// this far from their particles.
pub const CARRY_REACH: f64 = 3.0;

/// Particles are weighted up to this distance beyond the nearest one, in spacings.
const BEYOND_NEAREST: f64 = 1.0;

/// Search radius for the weighted particles, in spacings. It is also the limit for the distance of the
/// nearest particle from a predicted position, because the prediction may be off by this much.
const SEARCH_RADIUS: f64 = CARRY_REACH + BEYOND_NEAREST;

/// The position of a point of `from` in the frame `to`, the next one (`direction` 1) or the previous one
/// (−1). `None` if no particle within reach carries it.
fn carry(
    from: &FlickerFrame,
    to: &FlickerFrame,
    carrier: Carrier,
    direction: f64,
    point: DVec3,
    spacing: f64,
) -> Option<DVec3> {
    let limit = CARRY_REACH * spacing;
    let displacement = match carrier {
        Carrier::Ids => {
            let ids = from.particles.ids.as_deref()?;
            let displacement = |index: usize| {
                let id = *ids.get(index)?;
                Some(to.position_of_id(id)? - from.position_of_id(id)?)
            };
            mean(from, point, limit, spacing, displacement)?.vector
        }
        Carrier::Velocities { seconds } => {
            let step = direction * seconds;
            // Evaluated at the particles' mean position instead of on the surface, because more particles
            // surround the mean position.
            let Mean { vector: here, position } = mean(from, point, limit, spacing, velocity_in(from))?;
            let velocity_at = |position: DVec3| {
                Some(mean(to, position, SEARCH_RADIUS * spacing, spacing, velocity_in(to))?.vector)
            };
            let first = velocity_at(position + step * here)?;
            let second = velocity_at(position + step * 0.5 * (here + first))?;
            step * 0.5 * (here + second)
        }
    };
    Some(point + displacement).filter(|position| position.is_finite())
}

fn velocity_in(frame: &FlickerFrame) -> impl Fn(usize) -> Option<DVec3> {
    let velocities = frame.particles.velocities.as_deref().unwrap_or_default();
    |index| velocities.get(index).map(|&velocity| Vec3::from(velocity).as_dvec3())
}

/// Weighted means over particles.
struct Mean {
    /// The mean of a vector of the particles.
    vector: DVec3,
    /// Their mean position, world units.
    position: DVec3,
}

/// The means over the particles around a point for which `vector_of` returns a value. `None` if the nearest
/// of these particles is farther than `limit`, in world units.
fn mean(
    frame: &FlickerFrame,
    point: DVec3,
    limit: f64,
    spacing: f64,
    vector_of: impl Fn(usize) -> Option<DVec3>,
) -> Option<Mean> {
    // The unit of the grid's coordinates is the cell edge, which is the search radius.
    let grid = &frame.neighbors;
    let (cell, point_in_cell) = grid.locate(point)?;
    let [x, y, z] = grid.locals();
    let edge = grid.edge_world();
    let mut found: Vec<(f64, DVec3, DVec3)> = Vec::new();
    for run in grid.runs(cell) {
        let to_corner = run.step.as_vec3() - point_in_cell;
        for slot in run.slots {
            let offset = (to_corner + Vec3::new(x[slot], y[slot], z[slot])).as_dvec3();
            if offset.length_squared() <= 1.0
                && let Some(vector) = vector_of(grid.indices()[slot] as usize).filter(|v| v.is_finite())
            {
                found.push((offset.length() * edge, offset * edge, vector));
            }
        }
    }
    let nearest = found.iter().map(|&(distance, ..)| distance).fold(f64::INFINITY, f64::min);
    if nearest > limit {
        return None;
    }
    let radius = nearest + BEYOND_NEAREST * spacing;
    let (mut vectors, mut offsets, mut weights) = (DVec3::ZERO, DVec3::ZERO, 0.0);
    for (distance, offset, vector) in found {
        let part = (1.0 - (distance / radius).powi(2)).max(0.0);
        let weight = part * part * part;
        vectors += weight * vector;
        offsets += weight * offset;
        weights += weight;
    }
    Some(Mean { vector: vectors / weights, position: point + offsets / weights })
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
