//! Shapes from the particles around each: those of a sheet are flat, those of a thread long, those inside balls.
//!
//! ```text
//!        ∙ ∙ ∙           w(d) = 1 − (d/R)³, 0 from R on
//!      ∙  ∙   ∙
//!     ∙  ∙ ●──∙─── R     covariance of the particles within R, each with its weight, around their mean
//!      ∙   ∙  ∙
//!        ∙ ∙             ● itself is among them
//! ```
//!
//! At the plane surface of a solid the particles within R are on one side: they spread half as far outward as along
//! the surface, and what is there is flattened to 0.56.
//!
//! Where asked, a particle is moved toward the mean of those around it (Yu and Turk, Eq. 6). Shapes are always those of
//! the particles as they were, as theirs are: one search does for both, and a particle depends on what is within R and
//! on nothing else.
//!
//! Particles come by the cell of a grid whose edge is R, and the work is dealt out by their number, whatever cells they
//! are in. Where cells hold more than [`CELL_MAX`] particles only so many of each are looked at, here and there: then
//! shapes depend on which particles there are in all cells that meet the ball of radius R.

use glam::{DVec3, Vec3};
use rayon::prelude::*;

use super::half_axes::{Limits, shapes};
use super::moments::{MOMENT_COUNT, moments};
use super::{Shaped, ball, scale_of};
use crate::neighbors::{Neighbors, Surroundings};
use crate::particles::{Ellipsoid, Particles};
use crate::simd::{Kernel, Lanes, Level, dispatch_at};

/// How neighbours make shapes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct NeighborConfig {
    /// R: particles farther away do not matter. World units, positive.
    pub radius_world: f64,
    /// No half axis is more than this many times another, before they are raised to the floor: 1 or more.
    pub max_stretch: f32,
    /// How far particles are moved toward the mean of those around them, 0 to 1 (Yu and Turk, Eq. 6: λ).
    pub position_smoothing: f32,
    /// The least half axis, in units of the settings' radii. Positive.
    pub floor: f32,
}

/// The particles of a cell that are looked at, at most: 7 times as many as a cell with an edge of 2.6 spacings has.
/// So particles that are far nearer to each other than R is wide take a microsecond each, and not as many as there are.
const CELL_MAX: usize = 128;

/// Shapes particles by their neighbourhoods (Yu and Turk, Eq. 6 and 9 to 16). `scales` has one for each particle. Those
/// without a place in the range of indices are balls.
pub fn from_neighbors(particles: &Particles, scales: Option<&[f32]>, config: &NeighborConfig) -> Shaped {
    shaped(particles, scales, config, Level::current())
}

fn shaped(particles: &Particles, scales: Option<&[f32]>, config: &NeighborConfig, level: Level) -> Shaped {
    assert!(scales.is_none_or(|scales| scales.len() == particles.len()), "a scale for each particle");
    let neighbors = Neighbors::new(particles, config.radius_world);
    let count = neighbors.indices().len();
    let mut sorted = vec![Ellipsoid::ball(1.0); count];
    let moves = config.position_smoothing > 0.0;
    let mut means = vec![[0.0f32; 3]; if moves { count } else { 0 }];
    let counts = sorted
        .par_chunks_mut(PIECE)
        .zip_eq(pieces_of(&mut means, count))
        .enumerate()
        .map(|(piece, (shapes, means))| {
            dispatch_at(
                level,
                Piece { neighbors: &neighbors, scales, config, first: piece * PIECE, shapes, means },
            )
        })
        .reduce(Counts::default, Counts::plus);
    let placed = Placed::new(&neighbors, particles.len());
    let (shapes, unplaced) = placed.shapes(&sorted, scales, config.floor);
    let counts = counts.plus(unplaced);
    Shaped {
        positions: moves.then(|| placed.moved(particles, &means, config)),
        shapes,
        raised_count: counts.raised,
        ball_count: counts.balls,
    }
}

/// Particles of one task: enough that those of the cells at its ends, which two tasks gather, do not count.
const PIECE: usize = 1024;

/// As many pieces as `count` has, empty ones if nothing is wanted.
fn pieces_of(means: &mut [[f32; 3]], count: usize) -> Vec<&mut [[f32; 3]]> {
    let mut pieces: Vec<&mut [[f32; 3]]> = means.chunks_mut(PIECE).collect();
    pieces.resize_with(count.div_ceil(PIECE), Default::default);
    pieces
}

#[derive(Clone, Copy, Default)]
struct Counts {
    raised: usize,
    balls: usize,
}

impl Counts {
    fn plus(self, other: Counts) -> Counts {
        Counts { raised: self.raised + other.raised, balls: self.balls + other.balls }
    }
}

/// Particles in a row, in the order of the grid.
struct Piece<'a> {
    neighbors: &'a Neighbors,
    scales: Option<&'a [f32]>,
    config: &'a NeighborConfig,
    /// The place of the first.
    first: usize,
    shapes: &'a mut [Ellipsoid],
    /// Empty if nobody wants them.
    means: &'a mut [[f32; 3]],
}

impl Kernel for Piece<'_> {
    type Output = Counts;

    #[inline(always)]
    fn run<V: Lanes>(mut self) -> Counts {
        let mut surroundings = Surroundings::default();
        let mut within = Vec::new();
        let mut counts = Counts::default();
        let mut waiting = Waiting::new();
        let [x, y, z] = self.neighbors.locals();
        let end = self.first + self.shapes.len();
        let mut place = self.first;
        let mut cell = self.neighbors.cell_at(place);
        while place < end {
            surroundings.gather(self.neighbors, self.neighbors.cells()[cell], CELL_MAX);
            let cell_end = self.neighbors.places(cell).end.min(end);
            while place < cell_end {
                let at = Vec3::new(x[place], y[place], z[place]);
                waiting.add(moments::<V>(surroundings.eights(), at, &mut within));
                place += 1;
                if waiting.count == 8 || place == end {
                    counts = counts.plus(self.finish::<V>(&waiting, place - waiting.count));
                    waiting.count = 0;
                }
            }
            cell += 1;
        }
        counts
    }
}

impl Piece<'_> {
    /// Shapes the particles that wait; `place` is that of the first of them.
    #[inline(always)]
    fn finish<V: Lanes>(&mut self, waiting: &Waiting, place: usize) -> Counts {
        let mut scales = [1.0; 8];
        for (scale, &index) in scales.iter_mut().zip(&self.neighbors.indices()[place..place + waiting.count])
        {
            *scale = scale_of(self.scales, index as usize);
        }
        let NeighborConfig { max_stretch, floor, .. } = *self.config;
        let limits = Limits { max_stretch: max_stretch.max(1.0), floor };
        let eights = shapes::<V>(&waiting.moments, &scales, limits);
        let first = place - self.first;
        self.shapes[first..first + waiting.count].copy_from_slice(&eights.shapes[..waiting.count]);
        if !self.means.is_empty() {
            let means = &mut self.means[first..first + waiting.count];
            for (k, mean) in means.iter_mut().enumerate() {
                *mean = [eights.means[0][k], eights.means[1][k], eights.means[2][k]];
            }
        }
        let bits = ((1u16 << waiting.count) - 1) as u8;
        let [raised, balls] = [eights.raised & bits, eights.balls & bits].map(u8::count_ones);
        Counts { raised: raised as usize, balls: balls as usize }
    }
}

/// Moments that wait until there are eight.
struct Waiting {
    moments: [[f32; 8]; MOMENT_COUNT],
    count: usize,
}

impl Waiting {
    #[inline(always)]
    fn new() -> Waiting {
        Waiting { moments: [[0.0; 8]; MOMENT_COUNT], count: 0 }
    }

    #[inline(always)]
    fn add(&mut self, moments: [f32; MOMENT_COUNT]) {
        for (row, moment) in self.moments.iter_mut().zip(moments) {
            row[self.count % 8] = moment;
        }
        self.count += 1;
    }
}

/// Where in the grid each particle is.
struct Placed(Vec<u32>);

/// In place of a place: the particle has none.
const NOWHERE: u32 = u32::MAX;

impl Placed {
    fn new(neighbors: &Neighbors, count: usize) -> Placed {
        let mut places = vec![NOWHERE; count];
        for (place, &index) in (0..).zip(neighbors.indices()) {
            places[index as usize] = place;
        }
        Placed(places)
    }

    /// The shapes in the order of the particles; counts of those that have no place.
    fn shapes(&self, sorted: &[Ellipsoid], scales: Option<&[f32]>, floor: f32) -> (Vec<Ellipsoid>, Counts) {
        let shape = |(index, &place): (usize, &u32)| match sorted.get(place as usize) {
            Some(&shape) => shape,
            None => ball(scale_of(scales, index), floor).0,
        };
        let shapes = self.0.par_iter().enumerate().map(shape).collect();
        let unplaced = || self.0.iter().enumerate().filter(|&(_, &place)| place == NOWHERE);
        let is_raised = |&(index, _): &(usize, &u32)| ball(scale_of(scales, index), floor).1;
        (shapes, Counts { raised: unplaced().filter(is_raised).count(), balls: unplaced().count() })
    }

    /// The particles where smoothing moves them.
    fn moved(&self, particles: &Particles, means: &[[f32; 3]], config: &NeighborConfig) -> Particles {
        let step_world = f64::from(config.position_smoothing) * config.radius_world;
        let step = |place: u32| {
            let mean = means.get(place as usize).copied().unwrap_or_default();
            Vec3::from(mean).as_dvec3() * step_world
        };
        match particles {
            Particles::Single(positions) => {
                let moved = |(position, &place): (&[f32; 3], &u32)| {
                    (Vec3::from(*position).as_dvec3() + step(place)).as_vec3().to_array()
                };
                Particles::Single(positions.par_iter().zip(&self.0).map(moved).collect())
            }
            Particles::Double(positions) => {
                let moved =
                    |(position, &place): (&[f64; 3], &u32)| (DVec3::from(*position) + step(place)).to_array();
                Particles::Double(positions.par_iter().zip(&self.0).map(moved).collect())
            }
        }
    }
}

#[cfg(test)]
mod tests;
