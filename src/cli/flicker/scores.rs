//! The scores of all frames: collects them, and writes them as CSV and as a picture.

use std::io::{self, Write};

use anyhow::Result;
use glam::DVec3;

use crate::pipeline::{CameraChoice, OutputFormat, SheetPart, encode_picture, sheet_provenance};
use crate::render::{
    Cell, CellGroup, CellPicture, Line, Mark, Picture, Plot, Sheet, Up, render_marks, stacked,
};
use crate::surface::flicker::{Distribution, Enclosed, FrameFlicker, ScoredPoint};

use super::{FlickerFrames, numbers_of};

/// The scores of a frame.
#[derive(Clone, Debug)]
pub(super) struct ScoredFrame {
    pub(super) number: i64,
    pub(super) name: String,
    pub(super) summary: Distribution,
    /// The distances of carried points from the surface: see [`DriftValues`].
    pub(super) drifts: [Distribution; 2],
    pub(super) enclosed: Enclosed,
    /// The change of the volume to the next frame, relative to the volume; `None` if the volume is not positive.
    pub(super) volume_step: Option<f64>,
    /// See [`lag`](crate::surface::flicker::lag); `None` if it is not measured.
    pub(super) lag: Option<f64>,
    pub(super) untracked_count: usize,
    pub(super) clamped_count: usize,
    /// The point with the most flicker; `None` if no point can be tracked to both neighbouring frames.
    pub(super) worst: Option<ScoredPoint>,
    /// All points, until they are no longer needed.
    points: Vec<ScoredPoint>,
    /// Until they are in the totals.
    drift_values: DriftValues,
}

/// The signed distances, in particle spacings, of points on a surface that particles carry: from this frame to
/// the next (the first difference), and from the frame before to the next (lag 2).
pub(super) type DriftValues = [Vec<f64>; 2];

/// What is measured of a frame.
pub(super) struct FrameScores {
    pub(super) flicker: FrameFlicker,
    pub(super) drifts: DriftValues,
    pub(super) enclosed: Enclosed,
    pub(super) volume_step: Option<f64>,
    pub(super) lag: Option<f64>,
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
const WORST_FRAMES: usize = 6;

impl ScoredFrame {
    pub(super) fn new(number: i64, name: String, scores: FrameScores) -> ScoredFrame {
        let FrameScores { flicker, drifts: drift_values, enclosed, volume_step, lag } = scores;
        let FrameFlicker { points, untracked_count, clamped_count } = flicker;
        let worse = |one: ScoredPoint, other: &ScoredPoint| {
            if other.value.abs() > one.value.abs() { *other } else { one }
        };
        let worst = points.first().map(|&first| points.iter().fold(first, worse));
        let summary = Distribution::of(points.iter().map(|point| point.value));
        let drifts = drift_values.each_ref().map(|values| Distribution::of(values.iter().copied()));
        ScoredFrame {
            number,
            name,
            summary,
            drifts,
            enclosed,
            volume_step,
            lag,
            untracked_count,
            clamped_count,
            worst,
            points,
            drift_values,
        }
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
    /// The distances of all carried points.
    drift_values: [Vec<f32>; 2],
    keeps_points: bool,
}

impl FlickerTotals {
    /// Empty totals. With `keeps_points`, they keep all points of the worst frames, for a picture.
    pub(super) fn new(keeps_points: bool) -> FlickerTotals {
        FlickerTotals {
            frames: Vec::new(),
            worst_points: Vec::new(),
            values: Vec::new(),
            drift_values: Default::default(),
            keeps_points,
        }
    }

    /// Adds a frame, whose number is greater than the earlier ones.
    pub(super) fn add(&mut self, mut frame: ScoredFrame) {
        self.values.extend(frame.points.iter().map(|point| point.value as f32));
        for (all, values) in self.drift_values.iter_mut().zip(std::mem::take(&mut frame.drift_values)) {
            all.extend(values.into_iter().map(|value| value as f32));
        }
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
    fn worst_frames(&self) -> Vec<usize> {
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

    /// The summaries of the first difference and of lag 2, of all points of all frames.
    pub(super) fn drifts(&self) -> [Distribution; 2] {
        self.drift_values.each_ref().map(|values| Distribution::of(values.iter().map(|&value| value.into())))
    }
}

// Writes scores as CSV.

/// Writes a row for each frame. Lengths are in particle spacings, volumes in cubic spacings, and positions in world
/// units. The scores of a frame are empty if none of its points can be tracked to both neighbouring frames.
pub(super) fn write_frames(frames: &[ScoredFrame], out: &mut dyn Write) -> io::Result<()> {
    writeln!(
        out,
        "frame,points,untracked,clamped,volume,pieces,ghosts,volume_step,lag,rms,median,p99,max,first,lag_2,max_x,max_y,max_z"
    )?;
    for frame in frames {
        let ScoredFrame {
            number,
            summary,
            drifts: [first, lag_2],
            enclosed: Enclosed { volume, piece_count, ghost_count },
            volume_step,
            lag,
            untracked_count,
            clamped_count,
            worst,
            ..
        } = frame;
        let (first, lag_2) = (first.rms, lag_2.rms);
        let [volume_step, lag] =
            [volume_step, lag].map(|value| value.map_or(String::new(), |value| value.to_string()));
        let Distribution { count, rms, median, percentile_99, max } = summary;
        write!(out, "{number},{count},{untracked_count},{clamped_count}")?;
        write!(out, ",{volume},{piece_count},{ghost_count},{volume_step},{lag}")?;
        match worst {
            Some(worst) => {
                let [x, y, z] = worst.position.to_array();
                writeln!(out, ",{rms},{median},{percentile_99},{max},{first},{lag_2},{x},{y},{z}")?;
            }
            None => writeln!(out, ",,,,,,,,,")?,
        }
    }
    Ok(())
}

/// Writes a row for each point, the worst first.
pub(super) fn write_points(points: &[WorstPoint], out: &mut dyn Write) -> io::Result<()> {
    writeln!(out, "frame,x,y,z,flicker")?;
    for WorstPoint { frame, position: [x, y, z], value } in points {
        writeln!(out, "{frame},{x},{y},{z},{value}")?;
    }
    Ok(())
}

// Plots the scores over the frames, and shows where the worst frames flicker.

/// The size of a frame's picture in pixels.
const PICTURE_SIZE: [usize; 2] = [480, 320];

const COLUMNS: usize = 3;

/// The gap between the cells of a sheet, in pixels. The width of the plot includes the gaps, so that the plot
/// is as wide as a row of cells.
const GAP: usize = 10;

const PLOT: [usize; 2] = [COLUMNS * (PICTURE_SIZE[0] + GAP) - GAP, 280];

/// Flicker in spacings, and its linear colour; values in between are interpolated.
const COLORS: [(f64, [f32; 3]); 4] =
    [(0.0, [0.3, 0.32, 0.35]), (0.1, [0.58, 0.42, 0.03]), (0.5, [0.5, 0.05, 0.02]), (2.0, [0.16, 0.0, 0.2])];

const LEGEND: &str = "Colours: grey does not flicker; yellow 0.1 spacings, red 0.5, dark violet 2 and more.";

/// The bytes of the picture.
///
/// # Errors
/// If the format cannot store the picture.
pub(super) fn encoded(
    frames: &FlickerFrames,
    totals: &FlickerTotals,
    summary: &Distribution,
) -> Result<Vec<u8>> {
    let plot = plot(frames, totals).picture();
    let head = Sheet {
        title: format!("{}: {} spacings", frames.name, numbers_of(summary)),
        picture_size: PLOT,
        blocks: vec![CellGroup {
            title: "Flicker of each frame, in particle spacings".to_owned(),
            cells: vec![Cell { content: CellPicture::Picture(plot), lines: Vec::new() }],
            columns: 1,
        }],
        footer: Vec::new(),
    };
    let worst: Vec<&ScoredFrame> =
        totals.worst_frames().into_iter().map(|index| &totals.frames[index]).collect();
    let camera = bounds(&worst).map(|bounds| {
        let aspect = PICTURE_SIZE[0] as f64 / PICTURE_SIZE[1] as f64;
        CameraChoice::default().viewpoint(bounds, aspect, Up::Y).view(PICTURE_SIZE)
    });
    let cell = |frame: &&ScoredFrame| Cell {
        content: match &camera {
            Some(view) => {
                CellPicture::Picture(render_marks(&marks(frame.points()), mark_radius(frame.points()), view))
            }
            None => CellPicture::Text("no points".to_owned()),
        },
        lines: vec![
            frame.name.clone(),
            format!("rms {:.4}, max {:.3}", frame.summary.rms, frame.summary.max),
        ],
    };
    let body = Sheet {
        title: String::new(),
        picture_size: PICTURE_SIZE,
        blocks: vec![CellGroup {
            title: format!("The frames that flicker most. {LEGEND}"),
            cells: worst.iter().map(cell).collect(),
            columns: COLUMNS,
        }],
        footer: Vec::new(),
    };
    let picture: Picture = stacked(&[head.picture(), body.picture()]);
    let part = SheetPart {
        name: frames.name.clone(),
        hash: None,
        what: format!("flicker of {} frames", totals.frames.len()),
        settings: None,
        options: None,
    };
    Ok(encode_picture(&picture, None, OutputFormat::Png, &sheet_provenance("flicker", &[part]))?)
}

fn plot(frames: &FlickerFrames, totals: &FlickerTotals) -> Plot {
    let line = |name: &str, color: [f32; 3], value: fn(&Distribution) -> f64| Line {
        name: name.to_owned(),
        color,
        points: totals
            .frames
            .iter()
            .filter(|frame| frame.summary.count > 0)
            .map(|frame| [frame.number as f64, value(&frame.summary)])
            .collect(),
    };
    Plot {
        size: PLOT,
        step: frames.step as f64,
        lines: vec![
            line("max", [0.55, 0.5, 0.5], |summary| summary.max),
            line("99 %", [0.8, 0.4, 0.05], |summary| summary.percentile_99),
            line("median", [0.1, 0.45, 0.15], |summary| summary.median),
            line("rms", [0.02, 0.1, 0.6], |summary| summary.rms),
        ],
    }
}

/// The bounding box of all points of these frames.
fn bounds(frames: &[&ScoredFrame]) -> Option<[DVec3; 2]> {
    let positions = frames.iter().flat_map(|frame| frame.points()).map(|point| point.position);
    positions.fold(None, |bounds: Option<[DVec3; 2]>, at| {
        Some(bounds.map_or([at, at], |[least, greatest]| [least.min(at), greatest.max(at)]))
    })
}

fn marks(points: &[ScoredPoint]) -> Vec<Mark> {
    let mark = |&ScoredPoint { position, normal, value }: &ScoredPoint| Mark {
        position,
        normal,
        color: color(value.abs()),
    };
    points.iter().map(mark).collect()
}

fn color(size: f64) -> [f32; 3] {
    let above = COLORS.iter().position(|&(value, _)| size < value).unwrap_or(COLORS.len() - 1).max(1);
    let [(low, from), (high, to)] = [COLORS[above - 1], COLORS[above]];
    let part = ((size - low) / (high - low)).clamp(0.0, 1.0) as f32;
    [0, 1, 2].map(|channel| from[channel] + part * (to[channel] - from[channel]))
}

/// The radius of the marks, in world units: a multiple of the mean distance from a mark to the nearest other
/// one, so that marks on the front of the surface hide those on its back.
fn mark_radius(points: &[ScoredPoint]) -> f64 {
    let every = points.len().div_ceil(MEASURED).max(1);
    let nearest = |point: &ScoredPoint| {
        let others = points.iter().map(|other| other.position.distance_squared(point.position));
        others.filter(|&distance| distance > 0.0).fold(f64::INFINITY, f64::min).sqrt()
    };
    let distances: Vec<f64> =
        points.iter().step_by(every).map(nearest).filter(|distance| distance.is_finite()).collect();
    // For random points, the mean distance to the nearest one is half the spacing of a grid of the same
    // density.
    let mean = distances.iter().sum::<f64>() / distances.len().max(1) as f64;
    MARK_RADIUS * mean.max(f64::MIN_POSITIVE)
}

/// The maximum number of marks whose nearest neighbours are searched for the mean distance.
const MEASURED: usize = 64;

/// The radius of a mark, in units of the mean distance to the nearest other mark.
const MARK_RADIUS: f64 = 1.8;

#[cfg(test)]
mod tests {
    use super::*;

    fn frame(number: i64, values: &[f64]) -> ScoredFrame {
        let point = |&value: &f64| ScoredPoint { position: DVec3::X * value, normal: DVec3::Z, value };
        let points = values.iter().map(point).collect();
        ScoredFrame::new(
            number,
            format!("f{number}"),
            FrameScores {
                flicker: FrameFlicker { points, untracked_count: 1, clamped_count: 0 },
                drifts: [values.to_vec(), Vec::new()],
                enclosed: Enclosed::default(),
                volume_step: None,
                lag: None,
            },
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
        assert_eq!(totals.drifts().map(|drift| drift.count), [20, 0]);
        assert_eq!(totals.frames[6].worst.map(|point| point.value), Some(-18.0));
        totals.add(frame(12, &[1.0; 2000]));
        assert_eq!(totals.worst_points.len(), WORST_POINTS);
    }

    #[test]
    fn colors_match_the_legend() {
        for (value, color_there) in COLORS {
            assert_eq!(color(value), color_there);
        }
        assert_eq!(color(100.0), COLORS[3].1);
        assert!(LEGEND.contains("0.1 spacings, red 0.5, dark violet 2"));
        let between = color(0.05);
        assert!(
            (0..3).all(|channel| (between[channel] - (COLORS[0].1[channel] + COLORS[1].1[channel]) / 2.0)
                .abs()
                < 1e-6)
        );
    }
}
