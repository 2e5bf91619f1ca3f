//! The particles near the points that need values, sorted and packed.
//!
//! ```text
//!   particle    v v v  r g b  a  ○ | …        the values of all numeric attributes of a particle, padded (○)
//!               └─ 8 values, a row ─┘         to rows of eight: a row is multiplied by its weight at once
//! ```
//!
//! Attributes with values that are not finite are not in the rows: their means have to skip the particles
//! with such values.

use glam::DVec3;
use rayon::prelude::*;

use super::near_particles::near_particles;
use super::{NO_PARTICLE, Support};
use crate::neighbors::Neighbors;
use crate::parallel::Loops as _;
use crate::particles::{Attribute, AttributeValues, OwnedPositions, Positions};

/// The particles that values are interpolated from.
pub(super) struct TransferSource<'a> {
    pub(super) particles: Positions<'a>,
    pub(super) attributes: Vec<&'a Attribute>,
    pub(super) support: Support<'a>,
    /// The particles near the points, in cells of size R.
    pub(super) neighbors: Neighbors,
    /// The indices of the near particles among all particles, in order.
    pub(super) indices: Vec<u32>,
    /// `row_count` rows per near particle.
    pub(super) rows: Vec<[f32; 8]>,
    pub(super) row_count: usize,
    /// The numeric attributes, in order.
    pub(super) numbers: Vec<NumericAttribute<'a>>,
    pub(super) ignored_value_count: usize,
}

/// A numeric attribute.
pub(super) struct NumericAttribute<'a> {
    pub(super) values: &'a [f32],
    pub(super) arity: usize,
    /// First column of its values in the rows; `None` if some values are not finite.
    pub(super) column: Option<usize>,
}

impl<'a> TransferSource<'a> {
    /// Collects the particles near these points.
    pub(super) fn new(
        particles: Positions<'a>,
        attributes: Vec<&'a Attribute>,
        support: Support<'a>,
        points: (usize, &(impl Fn(usize) -> DVec3 + Sync)),
    ) -> TransferSource<'a> {
        for attribute in &attributes {
            let (found, arity) = (attribute.values.len(), attribute.arity);
            assert!(0 < arity && found == particles.len() * arity, "{found} values of {}", attribute.name);
        }
        let indices = near_particles(&particles, support.radius_world, points);
        let neighbors = Neighbors::new(&subset(&particles, &indices), support.radius_world);
        let mut numbers: Vec<NumericAttribute> =
            attributes.iter().filter_map(|attribute| numbers_of(attribute)).collect();
        let mut ignored_value_count = 0;
        let mut width = 0;
        for numbers in &mut numbers {
            let broken_count = broken_count(numbers, &indices);
            ignored_value_count += broken_count;
            if broken_count == 0 {
                numbers.column = Some(width);
                width += numbers.arity;
            }
        }
        let row_count = width.div_ceil(8);
        let rows = rows_of(&numbers, &indices, row_count);
        TransferSource {
            particles,
            attributes,
            support,
            neighbors,
            indices,
            rows,
            row_count,
            numbers,
            ignored_value_count,
        }
    }

    /// Converts an index among the near particles to the index among all particles.
    pub(super) fn original(&self, index: u32) -> u32 {
        self.indices.get(index as usize).copied().unwrap_or(NO_PARTICLE)
    }
}

fn subset(particles: &Positions<'_>, indices: &[u32]) -> OwnedPositions {
    match particles {
        Positions::F32(positions) => {
            OwnedPositions::F32(indices.par_iter().halved().map(|&index| positions[index as usize]).collect())
        }
        Positions::F64(positions) => {
            OwnedPositions::F64(indices.par_iter().halved().map(|&index| positions[index as usize]).collect())
        }
    }
}

fn numbers_of(attribute: &Attribute) -> Option<NumericAttribute<'_>> {
    match &attribute.values {
        AttributeValues::Numbers(values) => {
            Some(NumericAttribute { values, arity: attribute.arity, column: None })
        }
        AttributeValues::Integers(_) | AttributeValues::Strings { .. } => None,
    }
}

impl NumericAttribute<'_> {
    /// The values of a particle, given its index among all particles.
    #[inline(always)]
    pub(super) fn of(&self, particle: u32) -> &[f32] {
        let first = particle as usize * self.arity;
        &self.values[first..first + self.arity]
    }
}

fn broken_count(numbers: &NumericAttribute, indices: &[u32]) -> usize {
    let broken = |&index: &u32| numbers.of(index).iter().filter(|value| !value.is_finite()).count();
    indices.par_iter().halved().map(broken).sum()
}

fn rows_of(numbers: &[NumericAttribute], indices: &[u32], row_count: usize) -> Vec<[f32; 8]> {
    let mut rows = vec![[0.0; 8]; indices.len() * row_count];
    if row_count != 0 {
        rows.par_chunks_mut(row_count).zip(indices).halved().for_each(|(rows, &index)| {
            let row = rows.as_flattened_mut();
            for numbers in numbers {
                if let Some(column) = numbers.column {
                    row[column..column + numbers.arity].copy_from_slice(numbers.of(index));
                }
            }
        });
    }
    rows
}
