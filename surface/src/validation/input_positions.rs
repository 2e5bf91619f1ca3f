//! Checks the input positions of particles that position smoothing moved.
//!
//! ```text
//!   ● input               φ > 0: outside, at a distance of φ. It is at most the displacement, because the
//!    ╲      surface         moved particle is inside
//!   ──╲──────────
//!      ○ moved
//! ```
//!
//! The certificate requires moved particles to be inside, and counts how many input positions are outside. φ,
//! interpolated between voxels, decides. Where φ is not stored, no surface is near: then the first stored
//! voxel on the way to the moved particle decides. If there is none, no surface lies in between, so the input
//! position is inside, like the moved one.

use glam::{DVec3, IVec3, Vec3};
use rayon::prelude::*;

use super::mesh_cells::corner;
use super::{ExclusionMask, ParticlesOutside};
use crate::grid::{Field, LEAF_EDGE, Topology, offset_in_leaf};
use crate::level_set::NarrowBand;
use crate::obstacle::ROUNDING_MAX;
use crate::parallel::Loops as _;
use crate::particles::{AnySource, Unread};
use crate::space::Lattice;

/// The input position of a moved particle. Lengths are in voxels.
#[derive(Clone, Copy, Debug)]
pub struct MovedParticle {
    /// The origin of the leaf of the input position.
    origin: IVec3,
    /// The input position, relative to that leaf.
    local: Vec3,
    /// From the input position to the current one.
    moved: Vec3,
}

/// The moved particles of a batch whose input position is within the range of the grid.
///
/// # Errors
/// Those of the source.
fn moved_particles(
    source: &AnySource<'_>,
    batch: usize,
    lattice: &Lattice,
) -> Result<impl Iterator<Item = MovedParticle>, Unread> {
    let moved_particle = move |[given, moved]: [DVec3; 2]| {
        let [given, moved] = [lattice.index_from_world(given)?, lattice.index_from_world(moved)?];
        let edge = f64::from(LEAF_EDGE);
        let origin = (given / edge).floor() * edge;
        let (local, moved) = ((given - origin).as_vec3(), (moved - given).as_vec3());
        Some(MovedParticle { origin: origin.as_ivec3(), local, moved })
    };
    Ok(source.moved_pairs(batch)?.into_iter().filter_map(moved_particle))
}

/// The moved particles whose input position may be outside the surface, batch by batch. The smoothing of the
/// level set keeps φ ≤ `upper`, a field on `topology`. Afterwards `offset`, in voxels, is subtracted from φ,
/// and if `has_obstacles` is true, the fluid is cut off at these, which may raise φ to zero if it is above
/// −[`ROUNDING_MAX`].
///
/// # Errors
/// Those of the source.
pub fn possibly_outside(
    source: &AnySource<'_>,
    lattice: &Lattice,
    (topology, upper): (&Topology, &Field),
    (offset, has_obstacles): (f32, bool),
) -> Result<Vec<Vec<MovedParticle>>, Unread> {
    if !source.is_smoothed() {
        return Ok(Vec::new());
    }
    let least = offset.min(0.0) - if has_obstacles { ROUNDING_MAX } else { 0.0 };
    let is_doubtful = |particle: &MovedParticle| match particle.corner_values(topology, upper) {
        // φ is at most `upper`. Rounding is monotonic, so the interpolated φ is at most the interpolated
        // `upper`, too.
        Some(corners) if offset == 0.0 && !has_obstacles => particle.interpolated(corners) > 0.0,
        Some(corners) => corners.iter().any(|value| *value >= least),
        None => particle.first_stored(topology, upper).is_some(),
    };
    let of_batch = |batch| {
        let mut doubtful: Vec<_> = moved_particles(source, batch, lattice)?.filter(is_doubtful).collect();
        doubtful.shrink_to_fit();
        Ok(doubtful)
    };
    (0..source.batch_count()).into_par_iter().halved().map(of_batch).collect()
}

/// How many of these input positions are outside a surface with this offset in voxels, and how far.
pub fn count_inputs_outside(
    batches: &[Vec<MovedParticle>],
    band: &NarrowBand,
    (lattice, offset): (&Lattice, f32),
    exempt: &dyn ExclusionMask,
) -> ParticlesOutside {
    let count = |sum: OutsideCount, particle: &MovedParticle| {
        sum.merge(particle.count_outside((band, offset), exempt))
    };
    batches
        .par_iter()
        .halved()
        .flatten()
        .fold(OutsideCount::default, count)
        .reduce(OutsideCount::default, OutsideCount::merge)
        .in_world(lattice)
}

/// The same for all moved particles of a source.
///
/// # Errors
/// Those of the source.
pub fn count_inputs_outside_of_source(
    source: &AnySource<'_>,
    band: &NarrowBand,
    (lattice, offset): (&Lattice, f32),
    exempt: &dyn ExclusionMask,
) -> Result<ParticlesOutside, Unread> {
    let of_batch = |batch| {
        let particles = moved_particles(source, batch, lattice)?;
        Ok(particles.fold(OutsideCount::default(), |sum, particle| {
            sum.merge(particle.count_outside((band, offset), exempt))
        }))
    };
    let batches = (0..source.batch_count()).into_par_iter().halved().map(of_batch);
    let sum = batches.try_reduce(OutsideCount::default, |one, other| Ok(one.merge(other)))?;
    Ok(sum.in_world(lattice))
}

/// Number of positions outside, and the distance of the farthest one from the surface, in voxels.
#[derive(Clone, Copy, Default)]
struct OutsideCount {
    count: usize,
    deepest: f32,
}

impl OutsideCount {
    fn merge(self, other: OutsideCount) -> OutsideCount {
        OutsideCount { count: self.count + other.count, deepest: self.deepest.max(other.deepest) }
    }

    fn in_world(self, lattice: &Lattice) -> ParticlesOutside {
        ParticlesOutside { count: self.count, deepest: f64::from(self.deepest) * lattice.voxel_size }
    }
}

impl MovedParticle {
    fn count_outside(&self, (band, offset): (&NarrowBand, f32), exempt: &dyn ExclusionMask) -> OutsideCount {
        let phi = match self.corner_values(&band.topology, &band.phi) {
            Some(corners) => self.interpolated(corners),
            None => match self.first_stored(&band.topology, &band.phi) {
                Some(value) if value > 0.0 => f32::INFINITY,
                _ => 0.0,
            },
        };
        if phi > 0.0 && (exempt.is_empty() || !exempt.particle(self.origin, self.local)) {
            // Before the offset the moved particle was inside, so the input position was outside by at most
            // the displacement. A negative offset moves the surface inward by its absolute value, which is
            // added to this limit.
            return OutsideCount { count: 1, deepest: phi.min(self.moved.length() - offset.min(0.0)) };
        }
        OutsideCount::default()
    }

    /// The values at the corners of the cell of the input position; `None` unless all are stored.
    fn corner_values(&self, topology: &Topology, field: &Field) -> Option<[f32; 8]> {
        let cell = self.origin + self.local.floor().as_ivec3();
        let mut values = [0.0; 8];
        for (number, value) in values.iter_mut().enumerate() {
            *value = value_at(topology, field, cell + corner(number))?;
        }
        Some(values)
    }

    fn interpolated(&self, corners: [f32; 8]) -> f32 {
        let part = self.local - self.local.floor();
        let weight = |number: usize| {
            let step = corner(number).as_vec3();
            (step * part + (1.0 - step) * (1.0 - part)).element_product()
        };
        (0..8).map(|number| weight(number) * corners[number]).sum()
    }

    /// The value of the first stored voxel on the way to the moved particle.
    fn first_stored(&self, topology: &Topology, field: &Field) -> Option<f32> {
        // The steps are shorter than the width of a band, so none of the steps jumps over one.
        let step_count = self.moved.length().ceil().min(STEPS_MAX) as u32;
        (0..=step_count).find_map(|step| {
            let part = step as f32 / step_count.max(1) as f32;
            let voxel = self.origin + (self.local + part * self.moved).round().as_ivec3();
            value_at(topology, field, voxel)
        })
    }
}

/// Upper limit of the number of steps, each at most one voxel long. It is never reached: a particle moves
/// toward neighbours within 200 voxels, so it moves no farther than that.
const STEPS_MAX: f32 = 1024.0;

fn value_at(topology: &Topology, field: &Field, voxel: IVec3) -> Option<f32> {
    let (leaf, local) = topology.find_voxel(voxel)?;
    Some(field.leaves[leaf].values[offset_in_leaf(local)])
}
