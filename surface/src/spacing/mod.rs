//! Estimates the particle spacing, and how irregular it is.
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

mod tree;

use std::collections::BTreeSet;

use glam::{DMat3, DVec3};
use rayon::prelude::*;

use crate::parallel::Loops as _;
use crate::particles::{AnySource, OwnedPositions, Positions, Unread};
use crate::words::significant;
use tree::{KdNode, Section, Volume};

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

/// A particle is close to its nearest neighbour if their distance is less than this share of the spacing.
/// Particles of SPH repel each other, so few are; those of FLIP and MPM do not.
const CLOSE: f64 = 0.5;

/// The irregularity of fewer measured particles is unknown: by chance, it could be on the other side of
/// [`IRREGULAR`].
const SURROUNDED_MIN: usize = 200;

/// Particles with more [irregularity](SpacingEstimate::irregularity) are irregularly spaced. In simulations by
/// SPH it is at most 0.07, in those by FLIP and MPM at least 0.2, and 0.41 for random particles.
pub const IRREGULAR: f64 = 0.17;

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
    /// From 0 (evenly spaced) to 1: the share of the measured particles whose nearest neighbour is closer than
    /// half the spacing. Only particles that neighbours surround count, in a body or in a sheet. `None` if
    /// fewer than 200 of them were measured.
    pub irregularity: Option<f64>,
}

/// Measures the distance between neighbouring particles, on up to 2000 of them. This is the default of
/// [`Options::spacing`](crate::Options::spacing), up to rounding.
///
/// `None` if fewer than two positions are finite and distinct, or if the spacing does not fit into an `f64`.
pub fn estimate_spacing<'a>(positions: impl Into<Positions<'a>>) -> Option<SpacingEstimate> {
    let mut points = finite_positions(&positions.into());
    let sample = sample(&points, SAMPLE_COUNT);
    let tree = KdNode::build(&mut points);
    let measure = |&point: &DVec3| {
        let neighbors = tree.neighbors(point, NEIGHBOR_COUNT);
        Some((Local::among(&neighbors)?, neighbors.first()?.length()))
    };
    let measured: Vec<(Local, f64)> = sample.par_iter().halved().filter_map(measure).collect();
    let locals: Vec<Local> = measured.iter().map(|(local, _)| *local).collect();

    let spacing = combine(&locals).filter(|spacing| spacing.is_finite() && *spacing > 0.0)?;
    let agrees = |local: &&Local| (local.spacing() - spacing).abs() <= AGREEMENT * spacing;
    let count = locals.len() as f64;
    let share = locals.iter().filter(agrees).count() as f64 / count;
    Some(SpacingEstimate {
        spacing,
        confidence: share * (1.0 - 1.0 / count.sqrt()),
        irregularity: irregularity(&measured, spacing),
    })
}

/// The share of surrounded particles that are close to their nearest neighbour. `None` if too few are
/// surrounded.
fn irregularity(measured: &[(Local, f64)], spacing: f64) -> Option<f64> {
    let surrounded = measured.iter().filter(|(local, _)| !matches!(local, Local::Open(_)));
    let count = surrounded.clone().count();
    let close_count = surrounded.filter(|(_, nearest)| *nearest < CLOSE * spacing).count();
    (count >= SURROUNDED_MIN).then(|| close_count as f64 / count as f64)
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
    /// The median of the frames' [irregularities](SpacingEstimate::irregularity); `None` if all are unknown.
    pub irregularity: Option<f64>,
}

impl SequenceEstimate {
    /// Whether the frames differ so much that one spacing cannot fit all.
    pub fn frames_disagree(&self) -> bool {
        self.spread > SPREAD_MAX
    }
}

/// Combines the estimates of some frames of a sequence, in any order: their medians, that of the spacing
/// weighted by confidence. `None` without frames.
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
    let irregularity = median(sorted.iter().filter_map(|estimate| estimate.irregularity).collect());
    Some(SequenceEstimate { spacing, confidence: confidence / (1.0 + spread), spread, irregularity })
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

// Selects the particles to measure: those with the smallest hashes.

/// Up to `count` distinct points: those with the smallest hashes. The order of the points does not matter,
/// and neither does their position in the world, as long as differences are exact.
fn sample(points: &[DVec3], count: usize) -> Vec<DVec3> {
    let Some(anchor) = componentwise_median(points) else { return Vec::new() };
    let extent = points.iter().fold(DVec3::ZERO, |extent, &point| extent.max((point - anchor).abs()));
    let unit = extent.max_element();
    let mut least: BTreeSet<(u64, [u64; 3])> = BTreeSet::new();
    for &point in points {
        let entry = (hash_without_scale(point - anchor, unit), point.to_array().map(f64::to_bits));
        if least.len() < count {
            least.insert(entry);
        } else if least.last().is_some_and(|&greatest| entry < greatest) && least.insert(entry) {
            least.pop_last();
        }
    }
    least.into_iter().map(|(_, bits)| DVec3::from(bits.map(f64::from_bits))).collect()
}

/// A position in the middle of the points. Unlike a corner of their box, it does not follow an outlier:
/// relative to an outlier, all other points would have nearly the same offset.
fn componentwise_median(points: &[DVec3]) -> Option<DVec3> {
    let mut values = Vec::with_capacity(points.len());
    let mut median = DVec3::ZERO;
    for axis in 0..3 {
        values.clear();
        values.extend(points.iter().map(|point| point[axis]));
        let middle = values.len() / 2;
        if values.is_empty() {
            return None;
        }
        median[axis] = *values.select_nth_unstable_by(middle, f64::total_cmp).1;
    }
    Some(median)
}

/// A hash of an offset. Exponents are taken relative to that of `unit`, so scaling all points by a power of
/// two does not change the hash.
fn hash_without_scale(offset: DVec3, unit: f64) -> u64 {
    const EXPONENT: u64 = 0x7ff0_0000_0000_0000;
    let unit = unit.to_bits() & EXPONENT;
    offset.to_array().into_iter().fold(0, |hash, along| {
        let relative = if along == 0.0 { 0 } else { along.to_bits().wrapping_sub(unit) };
        mix(hash ^ relative)
    })
}

/// The finalizer of SplitMix64: every bit of the result depends on every bit of `value`.
fn mix(value: u64) -> u64 {
    let value = value.wrapping_add(0x9e37_79b9_7f4a_7c15);
    let value = (value ^ value >> 30).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    let value = (value ^ value >> 27).wrapping_mul(0x94d0_49bb_1331_11eb);
    value ^ value >> 31
}

// The spacing of more particles than fit into memory: reads them twice, batch by batch.
//
//   all particles ──▶ every n-th ──▶ boxes around some of these ──▶ all particles in the boxes ──▶ estimate
//
// The particles of a sample are farther apart than those of the source, by a factor that depends on whether
// they are in a body, a sheet or a filament. So the estimate uses all particles of the source that are in
// boxes around some particles of the sample.

/// A sample of this size is as good as all particles. At most twice as many are kept.
const SAMPLE_MAX: usize = 1 << 20;

/// Upper limit of the number of boxes.
const BOX_COUNT: usize = 32;

/// Half an edge of a box in a body has at least this many spacings: most particles in the box then have all
/// their neighbours in it.
const HALF_EDGE_SPACINGS: f64 = 8.0;

/// Every n-th particle of a source, in its order.
#[derive(Debug)]
pub struct SourceSample {
    /// The finite particles of the sample.
    pub(crate) particles: OwnedPositions,
    /// n: one of this many particles is in the sample.
    every: usize,
}

impl SourceSample {
    /// Samples a source of `particle_count` particles; takes all of them if they are few.
    ///
    /// # Errors
    /// Those of the source.
    pub fn of(source: &AnySource<'_>, particle_count: usize) -> Result<SourceSample, Unread> {
        let every = particle_count.div_ceil(SAMPLE_MAX).max(1);
        let mut passed = 0;
        let particles = collect_wanted(source, |_| {
            passed += 1;
            (passed - 1) % every == 0
        })?;
        Ok(SourceSample { particles, every })
    }

    /// Estimates the spacing of all particles of the source that this is a sample of. `None` as in
    /// [`estimate_spacing`].
    ///
    /// # Errors
    /// Those of the source.
    pub fn estimate(&self, source: &AnySource<'_>) -> Result<Option<SpacingEstimate>, Unread> {
        let Some(of_sample) = estimate_spacing(&self.particles) else { return Ok(None) };
        if self.every == 1 {
            return Ok(Some(of_sample));
        }
        let as_in_a_body = of_sample.spacing / (self.every as f64).cbrt();
        let boxes = self.boxes((2.0 * of_sample.spacing).max(HALF_EDGE_SPACINGS * as_in_a_body));
        let in_a_box = |position: DVec3| {
            boxes
                .iter()
                .any(|[least, greatest]| position.cmpge(*least).all() && position.cmple(*greatest).all())
        };
        Ok(estimate_spacing(&collect_wanted(source, in_a_box)?))
    }

    /// Cubes around some of the particles.
    fn boxes(&self, half_edge: f64) -> Vec<[DVec3; 2]> {
        let count = self.particles.len();
        let centers = (0..count).step_by(count.div_ceil(BOX_COUNT).max(1));
        let center = |index| self.particles.position(index);
        centers.map(center).map(|center| [center - half_edge, center + half_edge]).collect()
    }
}

/// The finite particles that `is_wanted` selects.
fn collect_wanted(
    source: &AnySource<'_>,
    mut is_wanted: impl FnMut(DVec3) -> bool,
) -> Result<OwnedPositions, Unread> {
    let mut found: Vec<[f64; 3]> = Vec::new();
    for batch in 0..source.batch_count() {
        let mut take = |position: [f64; 3]| {
            let point = DVec3::from(position);
            if is_wanted(point) && point.is_finite() && found.len() < 2 * SAMPLE_MAX {
                found.push(position);
            }
        };
        match source.batch(batch)? {
            Positions::F32(positions) => {
                positions.iter().for_each(|&[x, y, z]| take([x, y, z].map(f64::from)))
            }
            Positions::F64(positions) => positions.iter().for_each(|&position| take(position)),
        }
    }
    Ok(OwnedPositions::F64(found))
}

// The particle spacing around one particle.
//
//    .   .   .   .         in a body: the cube root of the volume of the particle's Voronoi cell, which is
//      ┌───┐               exact for lattices and, in the mean, for random particles
//    . │ ● │ .   .
//      └───┘               in a sheet or at a surface, where the cell is open: the square root of the area
//    .   .   .   .         of the cell's section by the plane of the near particles
//
//    ●───●───●             in a filament or among few particles, if the section is open, too: the mean
//                          length of the edges to the neighbours with no particle in between
//
// Particles of a fluid under pressure have smaller cells than at rest, at nearly the same distances. In a
// body, the estimate is therefore a weighted mean: the edges have a weight of a quarter.

/// If a corner of a cell is farther away than this many spacings, the particle is at a surface or in spray,
/// and the cell does not measure the spacing. In a cubic lattice, corners are at 0.87 spacings.
const BODY_RADIUS_MAX: f64 = 1.25;

/// The same limit for a section. In a square lattice, corners are at 0.71 spacings.
const SHEET_RADIUS_MAX: f64 = 1.2;

/// The weight of edges in a body.
const BODY_EDGE_WEIGHT: f64 = 0.25;

/// The β of the lune-based β-skeleton that defines the edges. For any β above 1 it has the edges of a square
/// or cubic lattice, without diagonals. The mean edge of random particles is 1 spacing for a β of 1.24, that
/// of a disturbed lattice for 1.7: this value is in between.
const BETA: f64 = 1.35;

/// Edges longer than this many times the second shortest are gaps. (In a filament, the two shortest edges
/// lead to the two adjacent particles.)
const GAP: f64 = 2.5;

/// Neighbours this many times farther than the nearest are left out, to keep precision.
const FAR: f64 = 1e6;

/// The particle spacing around one particle, by the structure around it.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Local {
    /// Neighbours surround the particle.
    Body(f64),
    /// Neighbours surround the particle in a plane.
    Sheet(f64),
    /// Neighbours do not surround the particle.
    Open(f64),
}

impl Local {
    /// Measures a particle among its neighbours, given as offsets, the nearest first. `None` if it has no
    /// neighbours, or if distances do not fit into an `f64`.
    fn among(neighbors: &[DVec3]) -> Option<Local> {
        let nearest = neighbors.first()?.length();
        let near_count = neighbors.partition_point(|neighbor| neighbor.length() <= FAR * nearest);
        let neighbors = &neighbors[..near_count];
        let far = neighbors.last()?.length();

        let mut edges = edges(neighbors);
        // In a coiled filament, particles of the next turn are not neighbours.
        let farthest = GAP * edges.get(1).map_or(f64::INFINITY, |second| second.length());
        edges.retain(|edge| edge.length() <= farthest);
        let edge = edges.iter().map(|edge| edge.length()).sum::<f64>() / edges.len() as f64;
        let is_closed = |radius: f64, spacing: f64, max: f64| radius <= far && radius <= max * spacing;

        let Volume { volume, radius } = Volume::among(neighbors);
        let by_volume = volume.cbrt();
        let local = if is_closed(radius, by_volume, BODY_RADIUS_MAX) {
            Local::Body(by_volume + BODY_EDGE_WEIGHT * (edge - by_volume))
        } else {
            let section = normal(&edges).map(|normal| Section::among(neighbors, normal));
            let section = section.map(|Section { area, radius }| (area.sqrt(), radius));
            match section {
                Some((by_area, radius)) if is_closed(radius, by_area, SHEET_RADIUS_MAX) => {
                    Local::Sheet(by_area)
                }
                _ => Local::Open(edge),
            }
        };
        (local.spacing().is_finite() && local.spacing() > 0.0).then_some(local)
    }

    /// The spacing, world units.
    fn spacing(self) -> f64 {
        match self {
            Local::Body(spacing) | Local::Sheet(spacing) | Local::Open(spacing) => spacing,
        }
    }
}

/// The neighbours, sorted by distance, with no other particle in the lune in between: no other particle is
/// closer than β/2 edge lengths to both centres of the lune.
///
/// Particles in the lune are closer than the neighbour at the end of the edge, so only those are tested.
fn edges(neighbors: &[DVec3]) -> Vec<DVec3> {
    let is_edge = |&(index, &end): &(usize, &DVec3)| {
        let radius_squared = (0.5 * BETA).powi(2) * end.length_squared();
        let centers = [0.5 * BETA * end, (1.0 - 0.5 * BETA) * end];
        let is_between =
            |other: &DVec3| centers.iter().all(|&center| other.distance_squared(center) < radius_squared);
        !neighbors[..index].iter().any(is_between)
    };
    neighbors.iter().enumerate().filter(is_edge).map(|(_, &end)| end).collect()
}

/// The direction along which the edges extend least; `None` if all edges are on one line.
///
/// It is the eigenvector of the smallest eigenvalue of Σ u·uᵀ over the edge directions u. The adjugate has
/// the same eigenvector for its largest eigenvalue, which dominates its powers.
fn normal(edges: &[DVec3]) -> Option<DVec3> {
    let moments = edges.iter().map(|edge| edge.normalize_or_zero());
    let moments = moments.fold(DMat3::ZERO, |sum, along| sum + outer(along));
    let [a, b, c] = [moments.x_axis, moments.y_axis, moments.z_axis];
    let mut power = DMat3::from_cols(b.cross(c), c.cross(a), a.cross(b));
    let trace = |matrix: &DMat3| matrix.x_axis.x + matrix.y_axis.y + matrix.z_axis.z;
    if trace(&power) <= 1e-9 * trace(&moments).powi(2) {
        return None;
    }
    for _ in 0..6 {
        power *= 1.0 / trace(&power);
        power *= power;
    }
    let diagonal = DVec3::new(power.x_axis.x, power.y_axis.y, power.z_axis.z);
    power.col(diagonal.max_position()).try_normalize()
}

fn outer(along: DVec3) -> DMat3 {
    DMat3::from_cols(along.x * along, along.y * along, along.z * along)
}

#[cfg(test)]
mod tests;

#[cfg(test)]
mod tests_of_samples {
    use super::*;
    use crate::particles::erased;

    #[test]
    fn bounded_estimate_matches_the_spacing_of_all_particles() {
        let lattice = |counts: [usize; 3], spacing: f64| {
            let [x, y, z] = counts;
            let at =
                |index: usize| [index % x, index / x % y, index / x / y].map(|step| step as f64 * spacing);
            OwnedPositions::F64((0..x * y * z).map(at).collect())
        };
        // A body and a sheet; every second or third particle of each is sampled.
        for counts in [[130, 130, 130], [1700, 1700, 1]] {
            let particles = lattice(counts, 0.25);
            let Ok(sample) = erased(&particles, |source| SourceSample::of(source, particles.len()));
            assert!(sample.every > 1 && sample.particles.len() <= SAMPLE_MAX);
            let Ok(estimate) = erased(&particles, |source| sample.estimate(source));
            let found = estimate.expect("enough").spacing;
            assert!((found / 0.25 - 1.0).abs() < 0.03, "{counts:?}: {found}");
        }
    }
}
