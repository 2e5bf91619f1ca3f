//! Rest coordinates at points: where the fluid there was in an earlier frame.
//!
//! ```text
//!           ○ point            the ways from the particles around it to their rest coordinates are fitted by a linear
//!      ∙ ∙ ╱ ∙ ∙               function of their positions; the way of the point is added to the point
//!      ∙ ∙ ∙ ∙ ∙
//! ```
//!
//! The positions are those before smoothing, which moves no fluid. Where the particles do not determine the function, as
//! across a sheet, it is as constant as possible. Its values stay near those of the particles: within half of their range
//! beyond them.

use glam::{DMat3, DVec3};
use rayon::prelude::*;

use super::interpolate::{Interpolated, near_particles};
use super::{CHUNK, TransferSource, numbers_of, subset};
use crate::cancel::checkpoint;
use crate::neighbors::Neighbors;
use crate::parallel::Loops as _;
use crate::particles::{Attribute, OwnedPositions, Positions, Role};

/// Whether particles have rest coordinates.
pub fn has_rest(attributes: &[Attribute]) -> bool {
    attributes.iter().any(is_rest)
}

fn is_rest(attribute: &Attribute) -> bool {
    attribute.role == Role::Rest && attribute.arity == 3
}

/// Replaces the means of rest coordinates. A point without particles within the radius keeps what it has.
pub(super) fn fit_rest(
    source: &TransferSource,
    interpolated: &mut Interpolated,
    point_of: &(impl Fn(usize) -> DVec3 + Sync),
) {
    let numeric = source.attributes.iter().filter(|attribute| numbers_of(attribute).is_some());
    let rest: Vec<usize> =
        numeric.enumerate().filter(|(_, all)| is_rest(all)).map(|(index, _)| index).collect();
    if rest.is_empty() {
        return;
    }
    let positions: Positions =
        source.support.unsmoothed.map_or_else(|| source.particles.borrowed(), Positions::from);
    let count = interpolated.nearest.len();
    let radius = source.support.radius_world;
    let indices = near_particles(&positions, radius, (count, point_of));
    let near = subset(&positions, &indices);
    let neighbors = Neighbors::new(&near, radius);
    for index in rest {
        let values = source.numbers[index].values;
        let way = |particle: u32| {
            let first = 3 * indices[particle as usize] as usize;
            let rest = DVec3::new(values[first].into(), values[first + 1].into(), values[first + 2].into());
            rest - near.position(particle as usize)
        };
        let out = interpolated.numbers[index].as_chunks_mut::<3>().0;
        out.par_chunks_mut(CHUNK).enumerate().halved().for_each(|(chunk, out)| {
            checkpoint();
            for (offset, out) in out.iter_mut().enumerate() {
                let point = point_of(chunk * CHUNK + offset);
                if let Some(found) = way_at(&neighbors, &near, point, &way) {
                    *out = (point + found).as_vec3().to_array();
                }
            }
        });
    }
}

/// The way of a point; `None` without particles within the radius.
fn way_at(
    neighbors: &Neighbors,
    positions: &OwnedPositions,
    point: DVec3,
    way: &impl Fn(u32) -> DVec3,
) -> Option<DVec3> {
    let (cell, _) = neighbors.locate(point)?;
    let radius = neighbors.edge_world();
    let mut sums = WaySums::NONE;
    for run in neighbors.runs(cell) {
        let (slots, multiplicity) = run.sampled();
        for slot in slots {
            let particle = neighbors.indices()[slot];
            let offset = (positions.position(particle as usize) - point) / radius;
            let nearness = 1.0 - offset.length_squared();
            if nearness <= 0.0 {
                continue;
            }
            let way = way(particle);
            if way.is_finite() {
                sums.add(multiplicity * nearness * nearness * nearness, offset, way);
            }
        }
    }
    sums.at_point()
}

/// Weighted sums over particles: of their offsets from a point, and of their ways.
struct WaySums {
    weight: f64,
    offset: DVec3,
    way: DVec3,
    /// offset ⊗ offset, and way ⊗ offset.
    of_offsets: DMat3,
    of_ways: DMat3,
    /// The least and the greatest way along each axis.
    range: Option<[DVec3; 2]>,
}

impl WaySums {
    /// Those of no particles. The default of a matrix would be the identity.
    const NONE: WaySums = WaySums {
        weight: 0.0,
        offset: DVec3::ZERO,
        way: DVec3::ZERO,
        of_offsets: DMat3::ZERO,
        of_ways: DMat3::ZERO,
        range: None,
    };

    fn add(&mut self, weight: f64, offset: DVec3, way: DVec3) {
        let weighted = weight * offset;
        self.weight += weight;
        self.offset += weighted;
        self.way += weight * way;
        self.of_offsets += DMat3::from_cols(offset * weighted.x, offset * weighted.y, offset * weighted.z);
        self.of_ways += DMat3::from_cols(way * weighted.x, way * weighted.y, way * weighted.z);
        self.range = Some(self.range.map_or([way; 2], |[least, most]| [least.min(way), most.max(way)]));
    }

    /// The value of the fit at the point.
    fn at_point(self) -> Option<DVec3> {
        let WaySums { weight, offset, way, of_offsets, of_ways, range } = self;
        let [least, most] = range.filter(|_| weight > 0.0)?;
        let (middle, mean) = (offset / weight, way / weight);
        let outer = |one: DVec3, other: DVec3| DMat3::from_cols(one * other.x, one * other.y, one * other.z);
        let spread = of_offsets * weight.recip() - outer(middle, middle);
        let together = of_ways * weight.recip() - outer(mean, middle);
        let trace = spread.x_axis.x + spread.y_axis.y + spread.z_axis.z;
        let regular = spread + DMat3::from_diagonal(DVec3::splat((RIDGE * trace).max(f64::MIN_POSITIVE)));
        let fitted = mean - together * (regular.inverse() * middle);
        let reach = BEYOND * (most - least);
        Some(if fitted.is_finite() { fitted.clamp(least - reach, most + reach) } else { mean })
    }
}

/// By how much the fit is kept regular, relative to the mean of the squared offsets.
const RIDGE: f64 = 0.01;

/// How far values may be beyond those of the particles, relative to their range.
const BEYOND: f64 = 0.5;

#[cfg(test)]
mod tests {
    use super::*;

    /// Fits the ways of particles in a slab to a point above it.
    fn fitted(way: impl Fn(DVec3) -> DVec3, thickness: f64) -> Option<DVec3> {
        let mut sums = WaySums::NONE;
        for index in 0..1000 {
            let [x, y, z] =
                [index % 10, index / 10 % 10, index / 100].map(|step| f64::from(step) / 5.0 - 0.9);
            let position = DVec3::new(x, y + 0.03 * (7.0 * x).sin(), -0.4 + thickness * z);
            let nearness = 1.0 - position.length_squared();
            if nearness > 0.0 {
                sums.add(nearness.powi(3), position, way(position));
            }
        }
        sums.at_point()
    }

    #[test]
    fn linear_ways_are_fitted_beyond_the_particles() {
        let field = |at: DVec3| DVec3::new(3.0 + 2.0 * at.x - at.z, 4.0 * at.y, 1.5 * at.z - at.y);
        let found = fitted(field, 0.3).expect("particles");
        assert!(found.distance(field(DVec3::ZERO)) < 0.15, "{found}");
        // Across a sheet the way is constant.
        let found = fitted(field, 0.0).expect("particles");
        assert!(found.distance(field(DVec3::new(0.0, 0.0, -0.4))) < 0.15, "{found}");
        assert_eq!(WaySums::NONE.at_point(), None);
    }
}
