//! Flicker of a surface: its changes between frames that the flow does not explain.
//!
//! The flow carries points. If the surface follows the flow, too, the distance d of a point to the surface is
//! constant or changes steadily. So for each point and any three consecutive frames, the flicker is
//!
//! ```text
//!   d₀ ─── d₁ ─── d₂       the second difference d₀ − 2 d₁ + d₂, in units of h
//! ```
//!
//! The score is the root mean square of the flicker over all points and times. Not all frames are needed:
//! some runs of three consecutive frames are enough.

use glam::DVec3;
use meniscus::surface::obstacle::MeshSdf;
use rayon::prelude::*;

use crate::Outcome;

/// The distances collected from the frames of a sequence.
#[derive(Debug, Default)]
pub(crate) struct Flicker {
    /// The collected frames: their numbers, and the distances of the points.
    frames: Vec<(usize, Vec<f64>)>,
}

/// The score of a sequence: statistics of the flicker, in units of h.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Score {
    /// Root mean square.
    pub(crate) rms: f64,
    /// Median.
    pub(crate) median: f64,
    /// 99th percentile.
    pub(crate) most: f64,
    /// Maximum.
    pub(crate) max: f64,
    /// The share of the worst twentieth of the points in the sum of squares.
    pub(crate) worst: f64,
}

impl Flicker {
    /// Adds a later frame: its mesh, and the points at that time.
    ///
    /// # Errors
    /// If the mesh has no triangles, or `points` is empty.
    pub(crate) fn add(&mut self, frame: usize, surface: &MeshSdf, points: &[DVec3]) -> Outcome<()> {
        if points.is_empty() {
            return Err(format!("frame {frame}: the first surface has no points").into());
        }
        let distances = points.par_iter().map(|point| surface.distance(*point)).collect::<Option<Vec<f64>>>();
        let distances = distances.ok_or_else(|| format!("frame {frame}: its mesh has no triangles"))?;
        self.frames.push((frame, distances));
        Ok(())
    }

    /// For each frame between two collected neighbours, the second differences of all points, in units of h.
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
    /// If no three frames are consecutive.
    pub(crate) fn score(&self, voxel_size: f64) -> Outcome<Score> {
        let mut changes: Vec<f64> = self.changes(voxel_size).flat_map(|(_, changes)| changes).collect();
        changes.sort_by(f64::total_cmp);
        let max = *changes.last().ok_or("no three frames are consecutive")?;
        let percentile = |part: usize| changes[changes.len() * part / 100];
        let worst = self.worst(voxel_size);
        Ok(Score { rms: rms(&changes), median: percentile(50), most: percentile(99), max, worst })
    }

    /// The share of the worst twentieth of the points in the sum of squares. It shows whether the whole
    /// surface flickers, or only a part.
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

    /// The frame numbers, each with its score.
    pub(crate) fn over_time(&self, voxel_size: f64) -> Vec<[f64; 2]> {
        self.changes(voxel_size).map(|(frame, changes)| [frame as f64, rms(&changes)]).collect()
    }
}

fn rms(changes: &[f64]) -> f64 {
    (changes.iter().map(|change| change * change).sum::<f64>() / changes.len().max(1) as f64).sqrt()
}
