//! Collects the scores of all frames, and the worst frames and points.

use glam::DVec3;

use crate::surface::flicker::{Distribution, FrameFlicker, ScoredPoint};

/// The scores of a frame.
#[derive(Clone, Debug)]
pub(super) struct ScoredFrame {
    pub(super) number: i64,
    pub(super) name: String,
    pub(super) summary: Distribution,
    pub(super) untracked_count: usize,
    pub(super) clamped_count: usize,
    /// The point with the most flicker; `None` if no point can be tracked to both neighbouring frames.
    pub(super) worst: Option<ScoredPoint>,
    /// All points, until they are no longer needed.
    points: Vec<ScoredPoint>,
}

/// A point with its position in world units and its flicker in particle spacings.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct WorstPoint {
    pub(super) frame: i64,
    pub(super) position: [f64; 3],
    pub(super) value: f64,
}

/// Maximum number of worst points that are kept, over all frames.
const WORST_POINTS: usize = 1000;

/// The number of frames whose points are kept for the picture.
pub(super) const WORST_FRAMES: usize = 6;

impl ScoredFrame {
    pub(super) fn new(number: i64, name: String, found: FrameFlicker) -> ScoredFrame {
        let FrameFlicker { points, untracked_count, clamped_count } = found;
        let worse = |one: ScoredPoint, other: &ScoredPoint| {
            if other.value.abs() > one.value.abs() { *other } else { one }
        };
        let worst = points.first().map(|&first| points.iter().fold(first, worse));
        let summary = Distribution::of(points.iter().map(|point| point.value));
        ScoredFrame { number, name, summary, untracked_count, clamped_count, worst, points }
    }

    /// Its points, if it is one of the worst frames.
    pub(super) fn points(&self) -> &[ScoredPoint] {
        &self.points
    }
}

/// The scores of all frames so far.
pub(super) struct FlickerTotals {
    /// In order of their numbers.
    pub(super) frames: Vec<ScoredFrame>,
    /// The worst first; of equal ones, the earlier frame first.
    pub(super) worst_points: Vec<WorstPoint>,
    /// The flicker of all points, in 32 bits because there may be millions.
    values: Vec<f32>,
    keeps_points: bool,
}

impl FlickerTotals {
    /// Empty totals. With `keeps_points`, they keep all points of the worst frames, for a picture.
    pub(super) fn new(keeps_points: bool) -> FlickerTotals {
        FlickerTotals { frames: Vec::new(), worst_points: Vec::new(), values: Vec::new(), keeps_points }
    }

    /// Adds a frame, whose number is greater than the earlier ones.
    pub(super) fn add(&mut self, frame: ScoredFrame) {
        self.values.extend(frame.points.iter().map(|point| point.value as f32));
        let worst = |&ScoredPoint { position, value, .. }: &ScoredPoint| WorstPoint {
            frame: frame.number,
            position: DVec3::to_array(&position),
            value,
        };
        self.worst_points.extend(frame.points.iter().map(worst));
        self.worst_points.sort_by(|one, other| other.value.abs().total_cmp(&one.value.abs()));
        self.worst_points.truncate(WORST_POINTS);
        self.frames.push(frame);
        let kept = if self.keeps_points { self.worst_frames() } else { Vec::new() };
        for (index, frame) in self.frames.iter_mut().enumerate() {
            if !kept.contains(&index) {
                frame.points = Vec::new();
            }
        }
    }

    /// Indices of the frames with the highest scores, the worst first.
    pub(super) fn worst_frames(&self) -> Vec<usize> {
        let mut indices: Vec<usize> =
            (0..self.frames.len()).filter(|&index| self.frames[index].summary.count > 0).collect();
        indices
            .sort_by(|&one, &other| self.frames[other].summary.rms.total_cmp(&self.frames[one].summary.rms));
        indices.truncate(WORST_FRAMES);
        indices
    }

    /// The summary of all points of all frames.
    pub(super) fn summary(&self) -> Distribution {
        Distribution::of(self.values.iter().map(|&value| value.into()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn frame(number: i64, values: &[f64]) -> ScoredFrame {
        let point = |&value: &f64| ScoredPoint { position: DVec3::X * value, normal: DVec3::Z, value };
        let points = values.iter().map(point).collect();
        ScoredFrame::new(
            number,
            format!("f{number}"),
            FrameFlicker { points, untracked_count: 1, clamped_count: 0 },
        )
    }

    #[test]
    fn worst_points_and_frames_are_kept() {
        let mut totals = FlickerTotals::new(true);
        for number in 1..=10 {
            // Frame 7 is the worst; frames 3 and 4 are equal.
            let size = [0.0, 1.0, 2.0, 5.0, 5.0, 3.0, 4.0, 9.0, 0.5, 0.25, 8.0][number as usize];
            totals.add(frame(number, &[size, -2.0 * size]));
        }
        totals.add(frame(11, &[]));
        assert_eq!(totals.worst_frames(), [6, 9, 2, 3, 5, 4]);
        let with_points = totals.frames.iter().filter(|frame| !frame.points().is_empty());
        assert_eq!(with_points.map(|frame| frame.number).collect::<Vec<_>>(), [3, 4, 5, 6, 7, 10]);
        let first: Vec<(i64, f64)> =
            totals.worst_points.iter().take(4).map(|point| (point.frame, point.value)).collect();
        assert_eq!(first, [(7, -18.0), (10, -16.0), (3, -10.0), (4, -10.0)]);
        assert_eq!((totals.summary().count, totals.summary().max), (20, 18.0));
        assert_eq!(totals.frames[6].worst.map(|point| point.value), Some(-18.0));
        totals.add(frame(12, &[1.0; 2000]));
        assert_eq!(totals.worst_points.len(), WORST_POINTS);
    }
}
