//! Plots the scores over the frames, and shows where the worst frames flicker.

use anyhow::Result;
use glam::DVec3;

use crate::pipeline::{CameraChoice, OutputFormat, SheetPart, encode_picture, sheet_provenance};
use crate::render::{
    Cell, CellGroup, CellPicture, Line, Mark, Picture, Plot, Sheet, Up, render_marks, stacked,
};
use crate::surface::flicker::{Distribution, ScoredPoint};

use super::frames::FlickerFrames;
use super::numbers_of;
use super::totals::{FlickerTotals, ScoredFrame};

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
