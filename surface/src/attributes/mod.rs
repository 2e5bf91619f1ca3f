//! Transfers particle attributes to the surface: velocities, colors, ids.
//!
//! ```text
//!            ● vertex                 numbers      the mean of the particles within the radius R, with weights
//!          ╱ │ ╲                                   (1 − r²/R²)³ at the distance r: smooth, and zero from R on
//!      ∙ ∙ ∙ ∙ ∙ ∙  particles         others       the value of the nearest particle; on ties, the first
//!      ∙ ∙ ∙ ∙ ∙ ∙
//!      └──R──┘
//! ```
//!
//! A mean stays within the range of its inputs, exactly: it is clamped to their minimum and maximum. So a
//! constant attribute stays constant.
//!
//! **Radius.** A vertex lies between r_min and r_max from the nearest particle, usually near r_init. R is
//! 2·r_init; with the preset `paper` that is 1.5 r_max, or 2.6 particle spacings. On a regular lattice of
//! particles, a vertex then has about 20 particles within R, and at least 12. The weights fall to one half at
//! 0.45 R, about 1.2 spacings. So the noise of single particles is smoothed, and a shear across a few
//! particles is preserved. Particles may be larger than r_max (per-particle radii, ellipsoids). If no
//! particle is within R, the point gets the values of the nearest particle whose own r_max, plus a margin,
//! reaches the point. If no particle reaches it, numbers are 0, integers −1, strings missing, and the point
//! is counted.
//!
//! **Band.** Volume renderers need values in a band around the surface that is several voxels wide. Outside
//! the fluid, a voxel gets the values at the nearest point on the surface, because a point far from all
//! particles has no values of its own. The mean has no voxel-sized detail, so it is computed for every second
//! voxel along each axis, and the voxels in between are interpolated.
//!
//! Invariants: values depend only on the particles within the radius, or on those that reach the point.
//! Changes farther away, and the number of threads, leave the values bit-identical, however large the other
//! particles are.

mod band;
mod interpolate;
mod isolated;
mod near_particles;
mod nodes;
mod source;
mod tree;

use glam::DVec3;
use rayon::prelude::*;

use crate::interrupt::checkpoint;
use crate::mesh::Mesh;
use crate::parallel::Loops as _;
use crate::particles::{Attribute, AttributeValues, Positions, Shapes};

pub use band::{BandAttribute, interpolate_to_band};

use interpolate::{Interpolated, Scratch, interpolate};
use source::TransferSource;

/// How far particle values reach, in world units.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Support<'a> {
    /// Radius of the weighted mean; weights are zero from here on.
    pub radius_world: f64,
    /// r_max of the settings: the maximum distance of the reconstructed surface from the center of a particle
    /// that is a ball of scale 1.
    pub radius_max_world: f64,
    /// Margin that is added to a particle's own r_max. Points up to the sum away from the particle can get
    /// its values.
    pub margin_world: f64,
    /// The shapes of the particles: one per particle, unless they are balls.
    pub shapes: &'a Shapes,
}

impl Support<'_> {
    /// Distance up to which a particle is used if none is within the radius. Depends on this particle alone.
    fn limit_world(&self, particle: u32) -> f64 {
        let longest = self.shapes.outer_radius(particle as usize).max(1.0);
        self.radius_max_world * f64::from(longest) + self.margin_world
    }
}

/// How many points got attribute values, and from how near. Many isolated points mean that the surface is far
/// from its particles.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize)]
#[non_exhaustive]
pub struct TransferCounts {
    /// Number of points: vertices, or nodes in the band.
    #[serde(rename = "count")]
    pub point_count: usize,
    /// Points without a particle within the radius, which got the values of the nearest particle that reaches
    /// them.
    #[serde(rename = "isolated")]
    pub isolated_count: usize,
    /// Points that no particle reaches.
    #[serde(rename = "empty")]
    pub empty_count: usize,
    /// Number of ignored values, because they are not finite, over all particles near the surface.
    #[serde(rename = "left_out")]
    pub ignored_value_count: usize,
}

/// The attributes of a mesh's vertices, in the order of the particles' attributes.
///
/// Panics if an attribute does not have `arity` values per particle, or if `support` has too few
/// shapes for them.
pub fn interpolate_to_vertices<'a>(
    particles: impl Into<Positions<'a>>,
    attributes: &[&'a Attribute],
    mesh: &Mesh,
    support: Support<'a>,
) -> (Vec<Attribute>, TransferCounts) {
    let point_of = |vertex: usize| mesh.origin + mesh.positions[vertex].as_dvec3();
    let source = TransferSource::new(
        particles.into(),
        attributes.to_vec(),
        support,
        (mesh.positions.len(), &point_of),
    );
    let (interpolated, counts) = interpolate_at(&source, mesh.positions.len(), &point_of);
    let mut numbers = interpolated.numbers.into_iter();
    let mut values_of = |attribute: &Attribute| match &attribute.values {
        AttributeValues::Numbers(_) => AttributeValues::Numbers(numbers.next().unwrap_or_default()),
        AttributeValues::Integers(values) => {
            AttributeValues::Integers(of_nearest(values, attribute.arity, &interpolated.nearest))
        }
        AttributeValues::Strings { table, indices } => {
            let indices = of_nearest(indices, attribute.arity, &interpolated.nearest);
            AttributeValues::Strings { table: table.clone(), indices }
        }
    };
    let transferred = source.attributes.iter().map(|attribute| Attribute {
        name: attribute.name.clone(),
        role: attribute.role,
        arity: attribute.arity,
        values: values_of(attribute),
    });
    (transferred.collect(), counts)
}

/// Index of a missing particle.
const NO_PARTICLE: u32 = u32::MAX;

/// The values of these particles, or −1 if missing.
fn of_nearest<T: Copy + From<i8> + Send + Sync>(values: &[T], arity: usize, nearest: &[u32]) -> Vec<T> {
    let value = |nearest: u32, component: usize| match nearest {
        NO_PARTICLE => T::from(-1),
        _ => values[nearest as usize * arity + component],
    };
    let mut found = vec![T::from(-1); nearest.len() * arity];
    found.par_chunks_mut(arity).zip(nearest).halved().for_each(|(found, &nearest)| {
        for (component, found) in found.iter_mut().enumerate() {
            *found = value(nearest, component);
        }
    });
    found
}

/// Number of points per task. Consecutive points share most of the particles around them.
const CHUNK: usize = 2048;

/// The means at these points, and the particles nearest to them.
fn interpolate_at(
    source: &TransferSource,
    count: usize,
    point_of: &(impl Fn(usize) -> DVec3 + Sync),
) -> (Interpolated, TransferCounts) {
    let chunks: Vec<Interpolated> = (0..count.div_ceil(CHUNK))
        .into_par_iter()
        .halved()
        .map_init(Scratch::default, |scratch, chunk| {
            checkpoint();
            let vertices = chunk * CHUNK..count.min((chunk + 1) * CHUNK);
            let points: Vec<DVec3> = vertices.map(point_of).collect();
            interpolate(source, &points, scratch)
        })
        .collect();
    let mut interpolated = Interpolated::joined(source, &chunks);
    let mut counts = isolated::assign_nearest(source, &mut interpolated, point_of);
    counts.point_count = count;
    counts.ignored_value_count = source.ignored_value_count;
    (interpolated, counts)
}

#[cfg(test)]
mod tests;
#[cfg(test)]
mod tests_of_sizes;
