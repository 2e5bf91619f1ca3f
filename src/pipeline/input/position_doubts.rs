//! Looks for likely mistakes in the positions of a frame: none is finite, all are in a plane, or they were
//! rounded.

use std::collections::HashMap;

use glam::DVec3;
use meniscus_formats::{Error, Position};
use rayon::prelude::*;

use crate::surface::options::Settings;
use crate::surface::particles::{ParticleSource, Positions};
use crate::surface::space::joined;
use crate::surface::spacing::{ROUNDING_SHARE_MAX, rounding_step};

use super::frame_input::FrameInput;
use crate::pipeline::error::Cause;
use crate::pipeline::warning::{InputWarning, Warning};

/// Warnings about the positions. Reads only the first batch, unless that is in a plane or has no finite
/// position.
///
/// # Errors
/// Those of reading the particles; if there are particles, and none has a finite position.
pub(crate) fn position_doubts(particles: &FrameInput, settings: &Settings) -> Result<Vec<Warning>, Cause> {
    let mut warnings = Vec::new();
    if particles.is_empty() {
        return Ok(warnings);
    }
    let first = particles.batch(0)?;
    let step = rounding_step(first.clone());
    if step > ROUNDING_SHARE_MAX * settings.spacing {
        warnings.push(Warning::Input(InputWarning::RoundedParticles { step, spacing: settings.spacing }));
    }
    warnings.extend(shared_position(particles, &first)?.map(Warning::Input));
    let of_first = box_of_batch(&first);
    if of_first.is_none_or(|bounds| flat_axis(bounds).is_some()) {
        let Some(bounds) = box_of_all_particles(particles)? else {
            let what = format!("none of the {} particles has a finite position", particles.len());
            return Err(Cause::File(Error::invalid("", Position::File, what)));
        };
        let axis = flat_axis(bounds).filter(|_| particles.len() >= PLANAR_COUNT_MIN);
        let planar =
            axis.map(|axis| InputWarning::Planar { axis: ['x', 'y', 'z'][axis], at: bounds[0][axis] });
        warnings.extend(planar.map(Warning::Input));
    }
    Ok(warnings)
}

/// The position that most particles of the first or the last batch share, if it is that of many: solvers put inactive
/// particles there.
fn shared_position(particles: &FrameInput, first: &Positions<'_>) -> Result<Option<InputWarning>, Cause> {
    let is_many = |count: usize, of: usize| count >= PARKED_MIN && (count as f64) > PARKED_SHARE * of as f64;
    let bits = |position: DVec3| position.to_array().map(f64::to_bits);
    let last = particles.batch_count() - 1;
    let last = (last > 0).then(|| particles.batch(last)).transpose()?;
    for positions in [Some(first), last.as_ref()].into_iter().flatten() {
        let mut counts: HashMap<[u64; 3], usize> = HashMap::new();
        for index in 0..positions.len() {
            *counts.entry(bits(positions.position(index))).or_default() += 1;
        }
        let most = counts.into_iter().max_by_key(|&(position, count)| (count, position));
        let Some((shared, _)) = most.filter(|(_, count)| is_many(*count, positions.len())) else { continue };
        let count_in = |batch| -> Result<usize, Cause> {
            let positions = particles.batch(batch)?;
            Ok((0..positions.len()).filter(|&index| bits(positions.position(index)) == shared).count())
        };
        let counts = (0..particles.batch_count()).into_par_iter().map(count_in);
        let count = counts.try_reduce(|| 0, |one, other| Ok(one + other))?;
        let (particle_count, at) = (particles.len(), shared.map(f64::from_bits));
        if is_many(count, particle_count) && at.iter().all(|along| along.is_finite()) {
            return Ok(Some(InputWarning::SharedPosition { count, particle_count, at }));
        }
    }
    Ok(None)
}

/// So many particles at one position, and more than this part of the frame, are inactive ones.
const PARKED_MIN: usize = 8;
const PARKED_SHARE: f64 = 0.005;

/// Fewer particles may be in a plane by chance.
const PLANAR_COUNT_MIN: usize = 10;

/// The axis along which a box has no width, if it has a width along the two others.
fn flat_axis([least, greatest]: [DVec3; 2]) -> Option<usize> {
    let is_flat = |&axis: &usize| least[axis] == greatest[axis];
    let mut flat = (0..3).filter(is_flat);
    flat.next().filter(|_| flat.next().is_none())
}

/// The bounding box (minimum and maximum corner) of the particles with finite positions.
pub(crate) fn box_of_all_particles<S: ParticleSource>(particles: &S) -> Result<Option<[DVec3; 2]>, S::Error> {
    let of_batch = |batch: usize| Ok(box_of_batch(&particles.batch(batch)?));
    let of_batches = (0..particles.batch_count()).into_par_iter().map(of_batch);
    of_batches.try_reduce(|| None, |one, other| Ok(one.into_iter().chain(other).reduce(joined)))
}

fn box_of_batch(positions: &Positions<'_>) -> Option<[DVec3; 2]> {
    let points = (0..positions.len()).map(|index| positions.position(index));
    points.filter(|point| point.is_finite()).map(|point| [point; 2]).reduce(joined)
}
