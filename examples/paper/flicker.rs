//! How much a surface flickers: what it does between frames that the flow did not do.
//!
//! Points are carried by the flow. Where a surface is carried as they are, a point's distance to it stays, or changes
//! steadily. So for each point and each three frames in a row
//!
//! ```text
//!   d₀ ─── d₁ ─── d₂       the second difference d₀ − 2 d₁ + d₂, in units of h
//! ```
//!
//! and the score is the root of the mean of its squares, over all points and times. Frames may be left out, if three in a
//! row are there now and then.

use glam::DVec3;
use meniscus::surface::obstacle::Solid;
use rayon::prelude::*;

use crate::Outcome;

/// What is kept of a sequence while its frames come by.
#[derive(Debug, Default)]
pub(crate) struct Flicker {
    /// The frames that were taken, by their numbers, with the distances of the points in each.
    frames: Vec<(usize, Vec<f64>)>,
}

/// What a sequence comes to, in units of h.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Score {
    /// The root of the mean of the squares.
    pub(crate) rms: f64,
    /// Half of all are less.
    pub(crate) median: f64,
    /// Of a hundred, one is more.
    pub(crate) most: f64,
    /// The greatest of all.
    pub(crate) max: f64,
    /// The part of the sum of squares that the worst twentieth of the points makes.
    pub(crate) worst: f64,
}

impl Flicker {
    /// Takes in a later frame: its mesh, and the points at that time.
    ///
    /// # Errors
    /// A mesh without triangles, and no points: of these nothing can be said.
    pub(crate) fn add(&mut self, frame: usize, surface: &Solid, points: &[DVec3]) -> Outcome<()> {
        if points.is_empty() {
            return Err(format!("frame {frame}: there are no points on the first surface").into());
        }
        let distances = points.par_iter().map(|point| surface.distance(*point)).collect::<Option<Vec<f64>>>();
        let distances = distances.ok_or_else(|| format!("frame {frame}: its mesh has no triangles"))?;
        self.frames.push((frame, distances));
        Ok(())
    }

    /// The second differences around each frame that has both of its neighbours, in units of h.
    fn changes(&self, voxel_size: f64) -> impl Iterator<Item = (usize, Vec<f64>)> {
        self.frames.windows(3).filter_map(move |three| match three {
            [(before, first), (frame, second), (after, third)] if after - before == 2 => {
                let points = first.iter().zip(second).zip(third);
                let change = |((first, second), third)| (first - 2.0 * second + third) / voxel_size;
                Some((*frame, points.map(change).map(f64::abs).collect()))
            }
            _ => None,
        })
    }

    /// The score of all frames.
    ///
    /// # Errors
    /// Where no three frames are in a row.
    pub(crate) fn score(&self, voxel_size: f64) -> Outcome<Score> {
        let mut changes: Vec<f64> = self.changes(voxel_size).flat_map(|(_, changes)| changes).collect();
        changes.sort_by(f64::total_cmp);
        let max = *changes.last().ok_or("no three frames in a row")?;
        let percentile = |part: usize| changes[changes.len() * part / 100];
        let worst = self.worst(voxel_size);
        Ok(Score { rms: rms(&changes), median: percentile(50), most: percentile(99), max, worst })
    }

    /// What the worst twentieth of the points makes of the sum of squares: whether all of a surface trembles, or a part.
    fn worst(&self, voxel_size: f64) -> f64 {
        let mut squares = Vec::new();
        for (_, changes) in self.changes(voxel_size) {
            squares.resize(changes.len(), 0.0);
            squares.iter_mut().zip(changes).for_each(|(square, change)| *square += change * change);
        }
        squares.sort_by(|one, other| f64::total_cmp(other, one));
        let of_worst: f64 = squares.iter().take(squares.len() / 20).sum();
        of_worst / squares.iter().sum::<f64>()
    }

    /// The frames, and what each comes to.
    pub(crate) fn over_time(&self, voxel_size: f64) -> Vec<[f64; 2]> {
        self.changes(voxel_size).map(|(frame, changes)| [frame as f64, rms(&changes)]).collect()
    }
}

fn rms(changes: &[f64]) -> f64 {
    (changes.iter().map(|change| change * change).sum::<f64>() / changes.len().max(1) as f64).sqrt()
}
