//! Estimates the particle spacing.
//!
//! For each particle of a sample, the spacing to its neighbours is measured, in a way that depends on the
//! structure around it: a body, a sheet, or neither. Spray is left out, and the rest is averaged by
//! structure:
//!
//! ```text
//!   particles ──▶ sample ──▶ spacing around each ──▶ without spray ──▶ mean of the middle three quarters
//!                 ≤ 2000     Voronoi cell, its       ≤ 2.5 × the       in bodies, if a tenth of the sample
//!                            section, or edges to    mean of the       or more is in bodies; else in sheets;
//!                            neighbours              smaller ones      else of the edges
//! ```
//!
//! For a lattice the result is the lattice constant, for random particles (volume / count)^(1/3), and for a
//! sheet of random particles (area / count)^(1/2). For fluids it is within a few percent of the particles'
//! distance at rest.
//!
//! Invariants: the result does not depend on the order of the particles; repeated positions count as one
//! particle; multiplying all positions by a power of two multiplies the result exactly.

mod bounded;
mod cell;
mod local;
mod sample;
mod tree;

use glam::DVec3;
use rayon::prelude::*;

use crate::parallel::Loops as _;
use crate::particles::Positions;
use crate::words::significant;

pub use bounded::SourceSample;
use local::Local;
use sample::sample;
use tree::KdNode;

/// Sample size. The median spacing of a sample of this size is within about one percent of the median of all,
/// whatever their number.
const SAMPLE_COUNT: usize = 2000;

/// Number of neighbours: more than enough to bound the cell of a particle in a body.
const NEIGHBOR_COUNT: usize = 64;

/// A particle is spray if its spacing is larger than this many times the mean of the smaller spacings.
const SPRAY: f64 = 2.5;

/// If at least this share of the particles, and [`ENOUGH`] of them, are in bodies, only these count.
const BODY_SHARE: f64 = 0.1;

/// If at least this share of the particles that are not in bodies, and [`ENOUGH`] of them, are in sheets,
/// edges do not count.
const SHEET_SHARE: f64 = 0.5;

/// From this many measured particles on, the mean of a structure can have full weight; with fewer, its weight
/// is proportionally smaller.
const ENOUGH: f64 = 8.0;

/// A particle agrees with the estimate if its own spacing differs by no more than this share.
const AGREEMENT: f64 = 0.25;

/// Frames disagree if their spacings differ by more than this share.
pub const SPREAD_MAX: f64 = 0.1;

/// An estimate with less [confidence](SpacingEstimate::confidence) causes a warning.
pub const CONFIDENCE_MIN: f64 = 0.5;

/// The particle spacing of one frame, by [`estimate_spacing`].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SpacingEstimate {
    /// The distance between neighbouring particles, world units; positive.
    pub spacing: f64,
    /// From 0 to 1: the share of the measured particles whose own spacing differs from this one by at most a
    /// quarter, times 1 − 1/√n for n measured particles.
    pub confidence: f64,
}

/// Measures the distance between neighbouring particles, on up to 2000 of them. This is the default of
/// [`Options::spacing`](crate::Options::spacing), up to rounding.
///
/// `None` if fewer than two positions are finite and distinct, or if the spacing does not fit into an `f64`.
pub fn estimate_spacing<'a>(positions: impl Into<Positions<'a>>) -> Option<SpacingEstimate> {
    let mut points = finite_positions(&positions.into());
    let sample = sample(&points, SAMPLE_COUNT);
    let tree = KdNode::build(&mut points);
    let measure = |&point: &DVec3| Local::among(&tree.neighbors(point, NEIGHBOR_COUNT));
    let locals: Vec<Local> = sample.par_iter().halved().filter_map(measure).collect();

    let spacing = combine(&locals).filter(|spacing| spacing.is_finite() && *spacing > 0.0)?;
    let agrees = |local: &&Local| (local.spacing() - spacing).abs() <= AGREEMENT * spacing;
    let count = locals.len() as f64;
    let share = locals.iter().filter(agrees).count() as f64 / count;
    Some(SpacingEstimate { spacing, confidence: share * (1.0 - 1.0 / count.sqrt()) })
}

/// The particle spacing of a sequence, by [`combine_estimates`].
#[derive(Clone, Copy, Debug, PartialEq)]
#[non_exhaustive]
pub struct SequenceEstimate {
    /// The distance between neighbouring particles, world units: the median of the frames, weighted by
    /// confidence.
    pub spacing: f64,
    /// From 0 to 1: the mean of the frames' confidences, divided by 1 + spread.
    pub confidence: f64,
    /// How much the largest spacing of a frame exceeds the smallest, relative to the smallest.
    pub spread: f64,
}

impl SequenceEstimate {
    /// Whether the frames differ so much that one spacing cannot fit all.
    pub fn frames_disagree(&self) -> bool {
        self.spread > SPREAD_MAX
    }
}

/// Combines the estimates of some frames of a sequence, in any order: their median, weighted by confidence.
/// `None` without frames.
pub fn combine_estimates(estimates: &[SpacingEstimate]) -> Option<SequenceEstimate> {
    let mut sorted = estimates.to_vec();
    let order = |a: &SpacingEstimate, b: &SpacingEstimate| {
        a.spacing.total_cmp(&b.spacing).then(a.confidence.total_cmp(&b.confidence))
    };
    sorted.sort_by(order);
    let (least, greatest) = (sorted.first()?.spacing, sorted.last()?.spacing);
    // Give every frame some weight: without it, frames of zero confidence would have no median.
    let weight = |estimate: &SpacingEstimate| estimate.confidence.max(0.01);
    let half = 0.5 * sorted.iter().map(weight).sum::<f64>();
    let (mut below, mut spacing) = (0.0, greatest);
    for (index, estimate) in sorted.iter().enumerate() {
        below += weight(estimate);
        if below >= half {
            let next = sorted.get(index + 1).filter(|_| below == half).unwrap_or(estimate);
            spacing = 0.5 * (estimate.spacing + next.spacing);
            break;
        }
    }
    let spread = greatest / least - 1.0;
    let confidence = sorted.iter().map(|estimate| estimate.confidence).sum::<f64>() / sorted.len() as f64;
    Some(SequenceEstimate { spacing, confidence: confidence / (1.0 + spread), spread })
}

/// A length with two significant digits, so that it is easy to type again: 0.0498 becomes 0.05.
pub fn rounded(length: f64) -> f64 {
    format!("{length:.1e}").parse().unwrap_or(length)
}

/// Combines the spacings around the particles; `None` for an empty list.
fn combine(locals: &[Local]) -> Option<f64> {
    let (mut bodies, mut sheets, mut open) = (Vec::new(), Vec::new(), Vec::new());
    for local in without_spray(locals) {
        match local {
            Local::Body(spacing) => bodies.push(spacing),
            Local::Sheet(spacing) => sheets.push(spacing),
            Local::Open(spacing) => open.push(spacing),
        }
    }
    let [body_count, sheet_count, open_count] = [&bodies, &sheets, &open].map(|all| all.len() as f64);
    let weight = |count: f64, of: f64, share: f64| (count / ENOUGH).min(count / (of * share)).min(1.0);
    let flat_count = sheet_count + open_count;
    // Random particles leave gaps that few edges cross, so edges are weighted by their length.
    let squares = |lengths: &[f64]| lengths.iter().map(|length| length * length).collect::<Vec<_>>();
    let open = middle(open);
    let open = mean(&squares(&open)).zip(mean(&open)).map(|(square, length)| square / length);
    // Areas are averaged in sheets, and volumes in bodies, because the particles divide a sheet's area or a
    // body's volume among them.
    let sheets = mean(&middle(squares(&sheets))).map(f64::sqrt);
    let flat = weighted_mean(sheets, open, weight(sheet_count, flat_count, SHEET_SHARE));
    let volumes = bodies.into_iter().map(|length| length * length * length);
    let bodies = mean(&middle(volumes.collect())).map(f64::cbrt);
    weighted_mean(bodies, flat, weight(body_count, body_count + flat_count, BODY_SHARE))
}

/// The quarter with the smallest spacings, and then all others in order, up to the first that is larger than
/// [`SPRAY`] times the mean of those before it.
fn without_spray(locals: &[Local]) -> Vec<Local> {
    let mut kept = locals.to_vec();
    kept.sort_by(|a, b| a.spacing().total_cmp(&b.spacing()));
    let mut count = kept.len().div_ceil(4);
    let mut sum: f64 = kept[..count].iter().map(|local| local.spacing()).sum();
    while let Some(next) = kept.get(count).map(|local| local.spacing())
        && next * count as f64 <= SPRAY * sum
    {
        sum += next;
        count += 1;
    }
    kept.truncate(count);
    kept
}

/// The weighted mean of both numbers; if one is missing, the other one.
fn weighted_mean(first: Option<f64>, second: Option<f64>, weight: f64) -> Option<f64> {
    match (first, second) {
        (Some(first), Some(second)) => Some(second + weight * (first - second)),
        (first, second) => first.or(second),
    }
}

/// Drops the smallest and the largest eighth.
fn middle(mut numbers: Vec<f64>) -> Vec<f64> {
    numbers.sort_unstable_by(f64::total_cmp);
    let trimmed_count = numbers.len() / 8;
    numbers[trimmed_count..numbers.len() - trimmed_count].to_vec()
}

fn mean(numbers: &[f64]) -> Option<f64> {
    (!numbers.is_empty()).then(|| numbers.iter().sum::<f64>() / numbers.len() as f64)
}

/// The median; the lower of the two middle numbers if the count is even. `None` for an empty list.
pub fn median(mut numbers: Vec<f64>) -> Option<f64> {
    let middle = numbers.len().checked_sub(1)? / 2;
    Some(*numbers.select_nth_unstable_by(middle, f64::total_cmp).1)
}

/// The step to which 32-bit positions were rounded: along the axis with the largest coordinates, the distance
/// of neighbouring 32-bit numbers at their median. 0 for positions that do not fit into 32 bits, and for
/// integers, which are usually exact.
pub fn rounding_step<'a>(positions: impl Into<Positions<'a>>) -> f64 {
    let points = finite_positions(&positions.into());
    let fits = |point: &DVec3| point.as_vec3().as_dvec3() == *point;
    if !points.iter().all(fits) || points.iter().all(|point| point.fract() == DVec3::ZERO) {
        return 0.0;
    }
    let step_along = |axis: usize| {
        let at = median(points.iter().map(|point| point[axis].abs()).collect()).unwrap_or(0.0) as f32;
        f64::from(at.next_up()) - f64::from(at)
    };
    (0..3).map(step_along).fold(0.0, f64::max)
}

/// A step of rounding that is larger than this share of the spacing moves particles visibly.
pub const ROUNDING_SHARE_MAX: f64 = 0.1;

/// What to do about positions that were rounded too coarsely.
pub const ROUNDING_REMEDY: &str =
    "write 64-bit positions, or move the scene near to the origin before its positions are rounded";

/// The error about positions that are rounded to steps that are too large for the measured spacing.
pub(crate) fn rounding_error(step: f64, spacing: f64) -> String {
    let [step, spacing] = [step, spacing].map(significant);
    format!(
        "positions are rounded to steps of {step}, as 32-bit numbers so far from the origin are, and the \
         measured particle spacing is {spacing}: {ROUNDING_REMEDY}"
    )
}

fn finite_positions(positions: &Positions<'_>) -> Vec<DVec3> {
    (0..positions.len())
        // Adding zero turns −0 into 0, so that equal positions have equal bits.
        .map(|index| positions.position(index) + DVec3::ZERO)
        .filter(|point| point.is_finite())
        .collect()
}

#[cfg(test)]
mod tests;
