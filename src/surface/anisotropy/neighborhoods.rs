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
//! Where particles are moved, it is toward the mean of those around them (Yu and Turk, Eq. 6). Shapes are always those of
//! the particles as they were, as theirs are: one search does for both, and a particle depends on what is within R and
//! on nothing else.
//!
//! Particles come by the cell of a grid whose edge is R, and the work is dealt out by their number, whatever cells they
//! are in. Where cells hold more than [`CELL_MAX`] particles only so many of each are looked at, here and there: then
//! shapes depend on which particles there are in all cells that meet the ball of radius R.

use glam::Vec3;
use rayon::prelude::*;

use super::half_axes::{means, shapes};
use super::moments::{MEAN_COUNT, MOMENT_COUNT, moments};
use super::scale_of;
use crate::surface::neighbors::{Neighbors, Surroundings};
use crate::surface::particles::{Ellipsoid, Particles};
use crate::surface::simd::{Kernel, Lanes, Level, dispatch_at};

/// How neighbours make shapes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct NeighborConfig {
    /// R: particles farther away do not matter. World units, positive.
    pub radius_world: f64,
    /// How particles are stretched; `None` where only means are wanted.
    pub stretch: Option<Stretch>,
}

/// What half axes are held to.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Stretch {
    /// No half axis is more than this many times another, before they are raised to the floor: 1 or more.
    pub max_stretch: f32,
    /// The least half axis of particles with many neighbours, in units of the settings' radii. Positive.
    pub floor: f32,
    /// The scale of particles without neighbours, in units of that of others: they are balls.
    pub lone: f32,
    /// The least scale of these balls, in units of the settings' radii. Positive.
    pub lone_floor: f32,
}

/// What the neighbours of some particles make of them.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ByNeighbors {
    /// Which particles these are, each once.
    pub indices: Vec<u32>,
    /// For each of them where the mean of what is around it is, relative to it, in units of R (Yu and Turk, Eq. 6).
    pub means: Vec<[f32; 3]>,
    /// The shape of each; empty where none are wanted.
    pub shapes: Vec<Ellipsoid>,
    /// How many have a half axis that was raised to the floor.
    pub raised_count: usize,
    /// How many are balls because their neighbours are too few.
    pub ball_count: usize,
}

/// The particles of a cell that are looked at, at most: 7 times as many as a cell with an edge of 2.6 spacings has.
/// So particles that are far nearer to each other than R is wide take a microsecond each, and not as many as there are.
const CELL_MAX: usize = 128;

/// What the neighbours of the particles that are wanted make of them (Yu and Turk, Eq. 6 and 9 to 16). `scales` has one for each particle. Of
/// the particles that are wanted, those without a place in the range of indices are left out.
///
/// A particle is the same whichever other ones are wanted, and whatever is missing from `particles` in cells of edge R that are not next to
/// its own; particles keep their order.
pub fn from_neighbors(
    particles: &Particles,
    is_wanted: impl Fn(usize) -> bool + Sync,
    scales: Option<&[f32]>,
    config: &NeighborConfig,
) -> ByNeighbors {
    by_neighbors(particles, is_wanted, scales, config, Level::current())
}

fn by_neighbors(
    particles: &Particles,
    is_wanted: impl Fn(usize) -> bool + Sync,
    scales: Option<&[f32]>,
    config: &NeighborConfig,
    level: Level,
) -> ByNeighbors {
    assert!(scales.is_none_or(|scales| scales.len() == particles.len()), "a scale for each particle");
    let neighbors = Neighbors::new(particles, config.radius_world);
    let in_order = (0u32..).zip(neighbors.indices());
    let places: Vec<u32> =
        in_order.filter(|(_, index)| is_wanted(**index as usize)).map(|(place, _)| place).collect();
    let mut means = vec![[0.0f32; 3]; places.len()];
    let shape_count = if config.stretch.is_some() { places.len() } else { 0 };
    let mut shapes = vec![Ellipsoid::ball(1.0); shape_count];
    let counts = places
        .par_chunks(PIECE)
        .zip_eq(means.par_chunks_mut(PIECE))
        .zip_eq(pieces_of(&mut shapes, places.len()))
        .map(|((places, means), shapes)| {
            dispatch_at(level, Piece { neighbors: &neighbors, scales, config, places, means, shapes })
        })
        .reduce(Counts::default, Counts::plus);
    ByNeighbors {
        indices: places.iter().map(|&place| neighbors.indices()[place as usize]).collect(),
        means,
        shapes,
        raised_count: counts.raised,
        ball_count: counts.balls,
    }
}

/// Particles of one task: enough that those of the cells at its ends, which two tasks gather, do not count.
const PIECE: usize = 1024;

/// As many pieces as `count` has, empty ones if nothing is wanted.
fn pieces_of(shapes: &mut [Ellipsoid], count: usize) -> Vec<&mut [Ellipsoid]> {
    let mut pieces: Vec<&mut [Ellipsoid]> = shapes.chunks_mut(PIECE).collect();
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

/// Particles that follow each other in the order of the grid.
struct Piece<'a> {
    neighbors: &'a Neighbors,
    scales: Option<&'a [f32]>,
    config: &'a NeighborConfig,
    /// Their places in the grid.
    places: &'a [u32],
    means: &'a mut [[f32; 3]],
    /// Empty if only means are wanted.
    shapes: &'a mut [Ellipsoid],
}

impl Kernel for Piece<'_> {
    type Output = Counts;

    #[inline(always)]
    fn run<V: Lanes>(self) -> Counts {
        match self.config.stretch {
            Some(stretch) => self.run_with::<V, MOMENT_COUNT>(Some(stretch)),
            None => self.run_with::<V, MEAN_COUNT>(None),
        }
    }
}

impl Piece<'_> {
    /// Takes the first `COUNT` moments of each particle.
    #[inline(always)]
    fn run_with<V: Lanes, const COUNT: usize>(mut self, stretch: Option<Stretch>) -> Counts {
        let mut surroundings = Surroundings::default();
        let mut within = Vec::new();
        let mut counts = Counts::default();
        let mut waiting = [[0.0f32; 8]; COUNT];
        let mut waiting_count = 0;
        let [x, y, z] = self.neighbors.locals();
        let mut cell_end = 0;
        for (number, &place) in self.places.iter().enumerate() {
            let place = place as usize;
            if place >= cell_end {
                let cell = self.neighbors.cell_at(place);
                surroundings.gather(self.neighbors, self.neighbors.cells()[cell], CELL_MAX);
                cell_end = self.neighbors.places(cell).end;
            }
            let at = Vec3::new(x[place], y[place], z[place]);
            let moments = moments::<V, COUNT>(surroundings.eights(), at, &mut within);
            for (row, moment) in waiting.iter_mut().zip(moments) {
                row[waiting_count % 8] = moment;
            }
            waiting_count += 1;
            if waiting_count == 8 || number + 1 == self.places.len() {
                let first = number + 1 - waiting_count;
                counts = counts.plus(self.finish::<V, COUNT>(&waiting, first, waiting_count, stretch));
                waiting_count = 0;
            }
        }
        counts
    }

    /// Finishes up to eight particles, of which `first` is the first.
    #[inline(always)]
    fn finish<V: Lanes, const COUNT: usize>(
        &mut self,
        moments: &[[f32; 8]; COUNT],
        first: usize,
        count: usize,
        stretch: Option<Stretch>,
    ) -> Counts {
        let along = means::<V>(moments);
        for (k, mean) in self.means[first..first + count].iter_mut().enumerate() {
            *mean = [along[0][k], along[1][k], along[2][k]];
        }
        let (Some(stretch), Some(moments)) = (stretch, moments.first_chunk()) else {
            return Counts::default();
        };
        let mut scales = [1.0; 8];
        for (scale, &place) in scales.iter_mut().zip(&self.places[first..first + count]) {
            *scale = scale_of(self.scales, self.neighbors.indices()[place as usize] as usize);
        }
        let limits = Stretch { max_stretch: stretch.max_stretch.max(1.0), ..stretch };
        let eights = shapes::<V>(moments, &scales, limits);
        self.shapes[first..first + count].copy_from_slice(&eights.shapes[..count]);
        let bits = ((1u16 << count) - 1) as u8;
        let [raised, balls] = [eights.raised & bits, eights.balls & bits].map(u8::count_ones);
        Counts { raised: raised as usize, balls: balls as usize }
    }
}

#[cfg(test)]
mod tests;
