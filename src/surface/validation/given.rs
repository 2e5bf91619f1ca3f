//! Particles as they were given, where the surface is one of particles that were moved.
//!
//! ```text
//!   ● given                 φ > 0: outside, by φ. It is no deeper outside than it was moved: the particle itself
//!    ╲      surface         is inside
//!   ──╲──────────
//!      ○ moved
//! ```
//!
//! The certificate asks moved particles to be inside, and counts how many of them were given outside. It is φ that tells,
//! interpolated between voxels. Where it is not stored no surface is near: there the way to the moved particle tells, by the
//! first voxel on it that is stored, and where none is no surface lies between.

use glam::{DVec3, IVec3, Vec3};
use rayon::prelude::*;

use super::mesh_cells::corner;
use super::{Exempt, ParticlesOutside};
use crate::surface::grid::{Field, LEAF_EDGE, Topology, offset_in_leaf};
use crate::surface::level_set::NarrowBand;
use crate::surface::particles::ParticleSource;
use crate::surface::space::Lattice;

/// Where a particle was given that is elsewhere now. In voxels.
#[derive(Clone, Copy, Debug)]
pub struct GivenPlace {
    /// The origin of the leaf that it was given in.
    origin: IVec3,
    /// Where in that leaf.
    local: Vec3,
    /// The way from there to where it is now.
    moved: Vec3,
}

/// The places where particles of a batch were given that are elsewhere now, as far as the grid reaches.
///
/// # Errors
/// Those of the source.
fn places_of<S: ParticleSource>(
    source: &S,
    batch: usize,
    lattice: &Lattice,
) -> Result<impl Iterator<Item = GivenPlace>, S::Error> {
    let place = move |[given, moved]: [DVec3; 2]| {
        let [given, moved] = [lattice.index_from_world(given)?, lattice.index_from_world(moved)?];
        let edge = f64::from(LEAF_EDGE);
        let origin = (given / edge).floor() * edge;
        let (local, moved) = ((given - origin).as_vec3(), (moved - given).as_vec3());
        Some(GivenPlace { origin: origin.as_ivec3(), local, moved })
    };
    Ok(source.given_of(batch)?.into_iter().filter_map(place))
}

/// Of the places where particles were given those that may be outside of the surface, batch by batch: smoothing keeps φ below
/// `upper`, a field on this topology, and so many voxels of an offset are taken from φ then.
///
/// # Errors
/// Those of the source.
pub fn doubtful_places<S: ParticleSource>(
    source: &S,
    lattice: &Lattice,
    (topology, upper, offset): (&Topology, &Field, f32),
) -> Result<Vec<Vec<GivenPlace>>, S::Error> {
    if !source.has_moved() {
        return Ok(Vec::new());
    }
    let is_doubtful = |place: &GivenPlace| match place.corner_values(topology, upper) {
        // Rounding is monotonic: of values that are no larger, what is interpolated is no larger either.
        Some(corners) if offset == 0.0 => place.interpolated(corners) > 0.0,
        Some(corners) => corners.iter().any(|value| *value >= offset.min(0.0)),
        None => place.first_stored(topology, upper).is_some(),
    };
    let of_batch = |batch| {
        let mut doubtful: Vec<_> = places_of(source, batch, lattice)?.filter(is_doubtful).collect();
        doubtful.shrink_to_fit();
        Ok(doubtful)
    };
    (0..source.batch_count()).into_par_iter().map(of_batch).collect()
}

/// How many of these places are outside of a surface that was moved outward by so many voxels, and how far.
pub fn given_outside(
    places: &[Vec<GivenPlace>],
    band: &NarrowBand,
    (lattice, offset): (&Lattice, f32),
    exempt: &dyn Exempt,
) -> ParticlesOutside {
    let count = |tally: Tally, place: &GivenPlace| tally.and(place.tally((band, offset), exempt));
    places
        .par_iter()
        .flatten()
        .fold(Tally::default, count)
        .reduce(Tally::default, Tally::and)
        .in_world(lattice)
}

/// The same of all particles of a source that were moved.
///
/// # Errors
/// Those of the source.
pub fn given_outside_of<S: ParticleSource>(
    source: &S,
    band: &NarrowBand,
    (lattice, offset): (&Lattice, f32),
    exempt: &dyn Exempt,
) -> Result<ParticlesOutside, S::Error> {
    let of_batch = |batch| {
        let places = places_of(source, batch, lattice)?;
        Ok(places.fold(Tally::default(), |tally, place| tally.and(place.tally((band, offset), exempt))))
    };
    let batches = (0..source.batch_count()).into_par_iter().map(of_batch);
    let tally = batches.try_reduce(Tally::default, |one, other| Ok(one.and(other)))?;
    Ok(tally.in_world(lattice))
}

/// Places outside, and how far from the surface the farthest is, in voxels.
#[derive(Clone, Copy, Default)]
struct Tally {
    count: usize,
    deepest: f32,
}

impl Tally {
    fn and(self, other: Tally) -> Tally {
        Tally { count: self.count + other.count, deepest: self.deepest.max(other.deepest) }
    }

    fn in_world(self, lattice: &Lattice) -> ParticlesOutside {
        ParticlesOutside { count: self.count, deepest: f64::from(self.deepest) * lattice.voxel_size }
    }
}

impl GivenPlace {
    fn tally(&self, (band, offset): (&NarrowBand, f32), exempt: &dyn Exempt) -> Tally {
        let phi = match self.corner_values(&band.topology, &band.phi) {
            Some(corners) => self.interpolated(corners),
            None => match self.first_stored(&band.topology, &band.phi) {
                Some(value) if value > 0.0 => f32::INFINITY,
                _ => 0.0,
            },
        };
        if phi > 0.0 && (exempt.is_nothing() || !exempt.particle(self.origin, self.local)) {
            // Where it is now it was inside before the offset.
            return Tally { count: 1, deepest: phi.min(self.moved.length() - offset.min(0.0)) };
        }
        Tally::default()
    }

    /// The values at the corners of its cell, if all are stored.
    fn corner_values(&self, topology: &Topology, field: &Field) -> Option<[f32; 8]> {
        let cell = self.origin + self.local.floor().as_ivec3();
        let mut values = [0.0; 8];
        for (place, value) in values.iter_mut().enumerate() {
            *value = value_at(topology, field, cell + corner(place))?;
        }
        Some(values)
    }

    fn interpolated(&self, corners: [f32; 8]) -> f32 {
        let part = self.local - self.local.floor();
        let weight = |place: usize| {
            let step = corner(place).as_vec3();
            (step * part + (1.0 - step) * (1.0 - part)).element_product()
        };
        (0..8).map(|place| weight(place) * corners[place]).sum()
    }

    /// The value of the first voxel that is stored on the way to where the particle is now.
    fn first_stored(&self, topology: &Topology, field: &Field) -> Option<f32> {
        // No more than a band is wide passes between two of them.
        let step_count = self.moved.length().ceil().min(STEPS_MAX) as u32;
        (0..=step_count).find_map(|step| {
            let part = step as f32 / step_count.max(1) as f32;
            let voxel = self.origin + (self.local + part * self.moved).round().as_ivec3();
            value_at(topology, field, voxel)
        })
    }
}

/// Particles are not moved farther: neighbours count within 200 voxels.
const STEPS_MAX: f32 = 1024.0;

fn value_at(topology: &Topology, field: &Field, voxel: IVec3) -> Option<f32> {
    let (leaf, local) = topology.find_voxel(voxel)?;
    Some(field.leaves[leaf].values[offset_in_leaf(local)])
}
