//! Looks for likely mistakes in the positions of a frame: none is finite, all are in a plane, they were rounded, or many
//! are the same.

use std::collections::HashMap;

use glam::DVec3;
use meniscus_formats::{Error, Position};
use rayon::prelude::*;

use crate::surface::options::Settings;
use crate::surface::particles::{ParticleSource, Positions};
use crate::surface::space::joined;
use crate::surface::spacing::{ROUNDING_REMEDY, ROUNDING_SHARE_MAX, rounding_step};
use crate::surface::words::significant;

use super::frame_input::FrameInput;
use crate::pipeline::error::Cause;
use crate::pipeline::warning::Warning;

/// Warnings about the positions. Reads some batches, and all of them if those are in a plane, have no finite position, or
/// have positions that several particles share.
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
        let [step, spacing] = [step, settings.spacing].map(significant);
        warnings.push(Warning::new(format!(
            "positions are rounded to steps of {step}, as 32-bit numbers so far from the origin are, and the particle spacing \
             is {spacing}: {ROUNDING_REMEDY}"
        )));
    }
    warnings.extend(shared_position(particles)?);
    let of_first = box_of_batch(&first);
    if of_first.is_none_or(|bounds| flat_axis(bounds).is_some()) {
        let Some(bounds) = box_of_all_particles(particles)? else {
            let what = format!("none of the {} particles has a finite position", particles.len());
            return Err(Cause::File(Error::invalid("", Position::File, what)));
        };
        let axis = flat_axis(bounds).filter(|_| particles.len() >= PLANAR_COUNT_MIN);
        warnings.extend(axis.map(|axis| {
            Warning::new(format!(
                "all particles have {} = {}: the surface of such a two-dimensional frame is a layer of one particle",
                ["x", "y", "z"][axis],
                significant(bounds[0][axis])
            ))
        }));
    }
    Ok(warnings)
}

/// The position that many particles share, if there is one: solvers put inactive particles there. It is found by
/// particles that are spread evenly over the frame.
///
/// # Errors
/// Those of reading the particles.
pub(crate) fn shared_position<S: ParticleSource>(particles: &S) -> Result<Option<Warning>, S::Error> {
    // Of −0 and 0, the sum with 0 is 0.
    let bits = |position: DVec3| (position + DVec3::ZERO).to_array().map(f64::to_bits);
    let batch_count = particles.batch_count();
    let particle_count: usize = (0..batch_count).map(|batch| particles.batch_len(batch)).sum();
    let sampled_count = batch_count.clamp(1, SAMPLED_BATCHES_MAX);
    let of_batch = SAMPLED_MAX / sampled_count;
    let sample = |index: usize| -> Result<Vec<[u64; 3]>, S::Error> {
        let positions = particles.batch(index * batch_count / sampled_count)?;
        let step = positions.len().div_ceil(of_batch).max(1);
        Ok((0..positions.len()).step_by(step).map(|index| bits(positions.position(index))).collect())
    };
    let samples: Vec<Vec<[u64; 3]>> =
        (0..sampled_count.min(batch_count)).into_par_iter().map(sample).collect::<Result<_, _>>()?;
    let mut counts: HashMap<[u64; 3], usize> = HashMap::new();
    for position in samples.into_iter().flatten() {
        *counts.entry(position).or_default() += 1;
    }
    let most = counts.into_iter().max_by_key(|&(position, count)| (count, position));
    let Some((shared, _)) = most.filter(|(_, count)| *count > 1) else { return Ok(None) };
    let count_in = |batch| -> Result<usize, S::Error> {
        let positions = particles.batch(batch)?;
        Ok((0..positions.len()).filter(|&index| bits(positions.position(index)) == shared).count())
    };
    let count =
        (0..batch_count).into_par_iter().map(count_in).try_reduce(|| 0, |one, other| Ok(one + other))?;
    let at = shared.map(f64::from_bits);
    let is_many = count >= PARKED_MIN && count as f64 > PARKED_SHARE * particle_count as f64;
    let is_parked = is_many && at.iter().all(|along| along.is_finite());
    Ok(is_parked.then(|| {
        let [x, y, z] = at;
        let warning = Warning::new(format!(
            "{count} of {particle_count} particles have the same position, ({x}, {y}, {z}), as inactive particles of solvers \
             do: they become a drop"
        ));
        // Conditions compare attributes with 32 bits.
        let [x, y, z] = at.map(|along| f64::from(along as f32));
        warning.with_remedy(format!("leave them out with --where 'x != {x} or y != {y} or z != {z}'"))
    }))
}

/// The numbers of batches and of particles in which a shared position is looked for.
const SAMPLED_BATCHES_MAX: usize = 1 << 10;
const SAMPLED_MAX: usize = 1 << 14;

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
