//! What the simulation knows of its particles, on the surface: velocities, colours, identities.
//!
//! ```text
//!            ● vertex                 numbers      a mean of the particles within the radius R, with weights
//!          ╱ │ ╲                                   (1 − d²/R²)³: smooth, and nothing from R on
//!      ∙ ∙ ∙ ∙ ∙ ∙  particles         the others   those of the nearest particle; of several, the first
//!      ∙ ∙ ∙ ∙ ∙ ∙
//!      └──R──┘
//! ```
//!
//! A mean stays within the range of what it is taken of, here to the last bit: it is cut to the least and the
//! greatest value. So a constant stays what it was.
//!
//! **How far.** A vertex lies between r_min and r_max from the nearest particle, as a rule near r_init. R is
//! 2·r_init, half as much again as r_max: over a lattice of particles a vertex then has about 20 particles, 12
//! where it is farthest from them. The weights fall to a half at 0.45 R, some 1.2 particle spacings. So the noise of
//! single particles is taken out, and a shear over a few of them is not. Particles may be larger than r_max says
//! (radii of their own, ellipsoids): where none is within R, the nearest one is taken of those whose own surface
//! can be so far from them. Where there is none, numbers are 0, integers −1, strings none, and that is counted.
//!
//! **In the band** around the surface values are wanted for several voxels across, for renderers go by volumes.
//! Outside of it they are those of the nearest place on the surface, since what is far from all particles has none
//! of its own. The mean has no detail as fine as voxels, so it is taken for every second voxel along each axis, and
//! those between get the mean of their neighbours.
//!
//! Invariants: values depend on the particles within the radius, or on those that reach the place, alone: what happens
//! farther away changes no bit of them, be it how large other particles are. Nor does the number of threads.

mod band;
mod blend;
mod lonely;
mod near;
mod nodes;
mod source;
mod tree;

use glam::DVec3;
use rayon::prelude::*;

use crate::surface::mesh::Mesh;
use crate::surface::particles::{Attribute, AttributeValues, Positions, Shapes};

pub use band::{BandAttribute, to_band};

use blend::{Blended, Scratch, blend};
use source::Source;

/// How far values reach, world units.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Reach<'a> {
    /// From here on a particle has no part in a mean.
    pub radius_world: f64,
    /// r_max of the settings: no surface of a ball is farther from its centre.
    pub radius_max_world: f64,
    /// Places may be so much farther from a particle than its surface can be.
    pub margin_world: f64,
    /// What the particles are: one shape for each of them, if they are not balls.
    pub shapes: &'a Shapes,
}

impl Reach<'_> {
    /// Up to here a particle is taken where none is within the radius. It depends on this particle alone.
    fn limit_world(&self, particle: u32) -> f64 {
        let longest = self.shapes.longest(particle as usize).max(1.0);
        self.radius_max_world * f64::from(longest) + self.margin_world
    }
}

/// How many places got attribute values, and from how near. Many isolated places mean that the surface is far from its
/// particles.
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[non_exhaustive]
pub struct TransferCounts {
    /// Places that got values: vertices, or voxels for which a mean was taken.
    #[cfg_attr(feature = "serde", serde(rename = "places"))]
    pub place_count: usize,
    /// Of these, those without a particle within the radius, which got the values of the nearest one that reaches them.
    #[cfg_attr(feature = "serde", serde(rename = "lonely"))]
    pub lonely_count: usize,
    /// And those that no particle reaches.
    #[cfg_attr(feature = "serde", serde(rename = "empty"))]
    pub empty_count: usize,
    /// Values that were left out, for they are not finite; of all particles near the surface.
    #[cfg_attr(feature = "serde", serde(rename = "left_out"))]
    pub left_out_count: usize,
}

/// The attributes of the vertices of a mesh, in the order of those of the particles.
///
/// Panics if an attribute has not one value for each component of each particle, or particles lack shapes.
pub fn to_vertices<'a>(
    particles: impl Into<Positions<'a>>,
    attributes: &[&'a Attribute],
    mesh: &Mesh,
    reach: Reach<'a>,
) -> (Vec<Attribute>, TransferCounts) {
    let place_of = |vertex: usize| mesh.origin + mesh.positions[vertex].as_dvec3();
    let source = Source::new(particles.into(), attributes.to_vec(), reach, (mesh.positions.len(), &place_of));
    let (blended, counts) = at_places(&source, mesh.positions.len(), &place_of);
    let mut numbers = blended.numbers.into_iter();
    let mut values_of = |attribute: &Attribute| match &attribute.values {
        AttributeValues::Numbers(_) => AttributeValues::Numbers(numbers.next().unwrap_or_default()),
        AttributeValues::Integers(values) => {
            AttributeValues::Integers(of_nearest(values, attribute.arity, &blended.nearest))
        }
        AttributeValues::Strings { table, indices } => {
            let indices = of_nearest(indices, attribute.arity, &blended.nearest);
            AttributeValues::Strings { table: table.clone(), indices }
        }
    };
    let transferred = source.attributes.iter().map(|attribute| Attribute {
        name: attribute.name.clone(),
        meaning: attribute.meaning,
        arity: attribute.arity,
        values: values_of(attribute),
    });
    (transferred.collect(), counts)
}

/// In place of the index of a particle: there is none.
const NO_PARTICLE: u32 = u32::MAX;

/// The values of these particles, and −1 where there is none.
fn of_nearest<T: Copy + From<i8> + Send + Sync>(values: &[T], arity: usize, nearest: &[u32]) -> Vec<T> {
    let value = |nearest: u32, component: usize| match nearest {
        NO_PARTICLE => T::from(-1),
        _ => values[nearest as usize * arity + component],
    };
    let mut found = vec![T::from(-1); nearest.len() * arity];
    found.par_chunks_mut(arity).zip(nearest).for_each(|(found, &nearest)| {
        for (component, found) in found.iter_mut().enumerate() {
            *found = value(nearest, component);
        }
    });
    found
}

/// Places that are one task: those that follow each other share the particles around them.
const PIECE: usize = 2048;

/// The numbers at these places, and the particles nearest to them.
fn at_places(
    source: &Source,
    count: usize,
    place_of: &(impl Fn(usize) -> DVec3 + Sync),
) -> (Blended, TransferCounts) {
    let pieces: Vec<Blended> = (0..count.div_ceil(PIECE))
        .into_par_iter()
        .map_init(Scratch::default, |scratch, piece| {
            let vertices = piece * PIECE..count.min((piece + 1) * PIECE);
            let places: Vec<DVec3> = vertices.map(place_of).collect();
            blend(source, &places, scratch)
        })
        .collect();
    let mut blended = Blended::joined(source, &pieces);
    let mut counts = lonely::serve(source, &mut blended, place_of);
    counts.place_count = count;
    counts.left_out_count = source.left_out_count;
    (blended, counts)
}

#[cfg(test)]
mod tests;
#[cfg(test)]
mod tests_of_sizes;
