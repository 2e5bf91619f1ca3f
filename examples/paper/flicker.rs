//! How much a surface flickers: what it does between frames that the flow did not do.
//!
//! Points are carried by the flow. Where a surface is carried as they are, a point's distance to it stays, or changes
//! steadily. So for each point and each three frames in a row
//!
//! ```text
//!   d₀ ─── d₁ ─── d₂       the second difference d₀ − 2 d₁ + d₂, in units of h
//! ```
//!
//! and the score is the root of the mean of its squares, over all points and times.

use glam::DVec3;
use meniscus::obstacle::Solid;
use rayon::prelude::*;

/// What is kept of a sequence while its frames come by.
#[derive(Debug, Default)]
pub(crate) struct Flicker {
    /// The distances of each frame.
    frames: Vec<Vec<f64>>,
}

/// What a sequence comes to, in units of h.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Score {
    /// The root of the mean of the squares.
    pub(crate) rms: f64,
    /// Half of all are less.
    pub(crate) median: f64,
    /// The greatest of all.
    pub(crate) max: f64,
}

impl Flicker {
    /// Takes in the next frame: a mesh, and the points at that time.
    pub(crate) fn add(&mut self, surface: &Solid, points: &[DVec3]) {
        self.frames
            .push(points.par_iter().map(|point| surface.distance(*point).unwrap_or(f64::NAN)).collect());
    }

    /// The second differences, frame by frame, in units of h.
    fn changes(&self, voxel_size: f64) -> impl Iterator<Item = Vec<f64>> {
        self.frames.windows(3).map(move |three| {
            let points = three[0].iter().zip(&three[1]).zip(&three[2]);
            points.map(|((first, second), third)| (first - 2.0 * second + third).abs() / voxel_size).collect()
        })
    }

    /// The score of all frames.
    pub(crate) fn score(&self, voxel_size: f64) -> Score {
        let mut changes: Vec<f64> = self.changes(voxel_size).flatten().collect();
        changes.sort_by(f64::total_cmp);
        let max = changes.last().copied().unwrap_or(0.0);
        Score { rms: rms(&changes), median: changes.get(changes.len() / 2).copied().unwrap_or(0.0), max }
    }

    /// The frames, and what each comes to.
    pub(crate) fn over_time(&self, voxel_size: f64) -> Vec<[f64; 2]> {
        let scores = self.changes(voxel_size).map(|changes| rms(&changes));
        scores.enumerate().map(|(index, score)| [(index + 1) as f64, score]).collect()
    }
}

fn rms(changes: &[f64]) -> f64 {
    (changes.iter().map(|change| change * change).sum::<f64>() / changes.len().max(1) as f64).sqrt()
}
