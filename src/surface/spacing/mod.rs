//! How far apart particles are.
//!
//! A sample of the particles is measured, each among its neighbours, by what they form: a body, a sheet, or neither.
//! Spray beside them is left out, and the rest averaged by form:
//!
//! ```text
//!   particles ──▶ sample ──▶ spacing around each ──▶ without spray ──▶ mean of the middle three quarters
//!                 ≤ 2000     cell, section, edges    ≤ 2.5 × the       bodies, where at least a tenth are in one;
//!                                                    mean of those     else sheets; else edges
//!                                                    before
//! ```
//!
//! For a lattice it is the lattice's constant, for random particles (volume / count)^(1/3), and for a sheet of them
//! (area / count)^(1/2). For fluids it is within a few percent of the distance at rest.
//!
//! Invariants: the result does not depend on the order of the particles; repeated positions are one
//! particle; multiplying all positions by a power of two multiplies the result exactly.

mod bounded;
mod cell;
mod local;
mod sample;
mod tree;

use glam::DVec3;
use rayon::prelude::*;

use crate::surface::particles::Positions;

pub(crate) use bounded::Sample;
use local::Local;
use sample::sample;
use tree::Node;

/// The median of this many is within about a percent of the median of all, whatever the number of
/// particles.
const SAMPLE_COUNT: usize = 2000;

/// All that bound the cell of a particle in a body, and more.
const NEIGHBOR_COUNT: usize = 64;

/// Particles farther apart than this many times the mean of those that are closer together are spray.
const SPRAY: f64 = 2.5;

/// Where this share of the particles, and [`ENOUGH`], are in bodies, these decide alone.
const BODY_SHARE: f64 = 0.1;

/// The same for sheets, among those that are not in bodies.
const SHEET_SHARE: f64 = 0.5;

/// As many measured particles count fully.
const ENOUGH: f64 = 8.0;

/// Particles whose own spacing is within this share of the estimate agree with it.
const AGREEMENT: f64 = 0.25;

/// Frames whose spacings differ by more than this share disagree.
pub const SPREAD_MAX: f64 = 0.1;

/// An estimate of less [confidence](Estimate::confidence) is worth a warning.
pub const CONFIDENCE_MIN: f64 = 0.5;

/// The particle spacing of one frame, by [`estimate_spacing`].
#[derive(Clone, Copy, Debug, PartialEq)]
#[non_exhaustive]
pub struct Estimate {
    /// The distance between neighbouring particles, world units; positive.
    pub spacing: f64,
    /// From 0 to 1: the share of the measured particles around which the spacing differs by no more than a quarter from
    /// this one, times 1 − 1/√n for n measured particles.
    pub confidence: f64,
}

/// Measures the distance between neighbouring particles, on up to 2000 of them: what
/// [`Options::spacing`](crate::surface::Options::spacing) is where it is not set, up to rounding.
///
/// `None` if fewer than two positions are finite and distinct, or if the spacing is out of the range of a 64-bit real.
pub fn estimate_spacing<'a>(positions: impl Into<Positions<'a>>) -> Option<Estimate> {
    let mut points = finite_positions(&positions.into());
    let sample = sample(&points, SAMPLE_COUNT);
    let tree = Node::build(&mut points);
    let measure = |&point: &DVec3| Local::among(&tree.neighbors(point, NEIGHBOR_COUNT));
    let locals: Vec<Local> = sample.par_iter().filter_map(measure).collect();

    let spacing = combined(&locals).filter(|spacing| spacing.is_finite() && *spacing > 0.0)?;
    let agrees = |local: &&Local| (local.spacing() - spacing).abs() <= AGREEMENT * spacing;
    let count = locals.len() as f64;
    let share = locals.iter().filter(agrees).count() as f64 / count;
    Some(Estimate { spacing, confidence: share * (1.0 - 1.0 / count.sqrt()) })
}

/// The particle spacing of a sequence, by [`combine_estimates`].
#[derive(Clone, Copy, Debug, PartialEq)]
#[non_exhaustive]
pub struct SequenceEstimate {
    /// The distance between neighbouring particles, world units: the median of the frames by their confidence.
    pub spacing: f64,
    /// From 0 to 1: the mean of the frames, divided by 1 + spread.
    pub confidence: f64,
    /// By how much the greatest spacing of a frame exceeds the least, as a share of the least.
    pub spread: f64,
}

impl SequenceEstimate {
    /// Whether the frames are so different that one spacing cannot be right for all.
    pub fn frames_disagree(&self) -> bool {
        self.spread > SPREAD_MAX
    }
}

/// The spacing of a sequence by the estimates of some of its frames, in any order: the median by confidence. `None` without
/// frames.
pub fn combine_estimates(estimates: &[Estimate]) -> Option<SequenceEstimate> {
    let mut sorted = estimates.to_vec();
    let order = |a: &Estimate, b: &Estimate| {
        a.spacing.total_cmp(&b.spacing).then(a.confidence.total_cmp(&b.confidence))
    };
    sorted.sort_by(order);
    let (least, greatest) = (sorted.first()?.spacing, sorted.last()?.spacing);
    // All have some weight, or there would be no median of frames without confidence.
    let weight = |estimate: &Estimate| estimate.confidence.max(0.01);
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

/// A length to two significant digits: 0.0498 becomes 0.05, which people and other programs can give again.
pub fn rounded(length: f64) -> f64 {
    format!("{length:.1e}").parse().unwrap_or(length)
}

/// The spacing by what was measured around each particle; `None` where there is nothing.
fn combined(locals: &[Local]) -> Option<f64> {
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
    // Random particles leave gaps, of which most edges are not part: edges are weighted by their length.
    let squares = |lengths: &[f64]| lengths.iter().map(|length| length * length).collect::<Vec<_>>();
    let open = middle(open);
    let open = mean(&squares(&open)).zip(mean(&open)).map(|(square, length)| square / length);
    // What particles share is the area, or the volume.
    let sheets = mean(&middle(squares(&sheets))).map(f64::sqrt);
    let flat = mixed(sheets, open, weight(sheet_count, flat_count, SHEET_SHARE));
    let volumes = bodies.into_iter().map(|length| length * length * length);
    let bodies = mean(&middle(volumes.collect())).map(f64::cbrt);
    mixed(bodies, flat, weight(body_count, body_count + flat_count, BODY_SHARE))
}

/// The closest quarter, and all that follow them without a gap.
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

/// The first with this weight, and the second with the rest of it; where one is missing, the other.
fn mixed(first: Option<f64>, second: Option<f64>, weight: f64) -> Option<f64> {
    match (first, second) {
        (Some(first), Some(second)) => Some(second + weight * (first - second)),
        (first, second) => first.or(second),
    }
}

/// The middle three quarters.
fn middle(mut numbers: Vec<f64>) -> Vec<f64> {
    numbers.sort_unstable_by(f64::total_cmp);
    let aside = numbers.len() / 8;
    numbers[aside..numbers.len() - aside].to_vec()
}

fn mean(numbers: &[f64]) -> Option<f64> {
    (!numbers.is_empty()).then(|| numbers.iter().sum::<f64>() / numbers.len() as f64)
}

/// The median, the lower of the two in the middle where there are two; `None` where there is nothing.
pub(crate) fn median(mut numbers: Vec<f64>) -> Option<f64> {
    let middle = numbers.len().checked_sub(1)? / 2;
    Some(*numbers.select_nth_unstable_by(middle, f64::total_cmp).1)
}

fn finite_positions(positions: &Positions<'_>) -> Vec<DVec3> {
    (0..positions.len())
        // Adding zero makes −0 and 0 one position bit for bit.
        .map(|index| positions.position(index) + DVec3::ZERO)
        .filter(|point| point.is_finite())
        .collect()
}

#[cfg(test)]
mod tests;
