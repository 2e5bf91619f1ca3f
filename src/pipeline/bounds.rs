//! What a camera looks at: the box of a frame, and of a sequence.
//!
//! Of a sequence the first, the middle and the last frame are looked at. A fluid seldom leaves their box, and a part of
//! a sequence has the same camera as the whole. A single drop that flew off would make all else tiny: what is farther
//! from nearly all the rest than that is long is left out.

use std::path::Path;

use glam::DVec3;

use super::attributes::Wanted;
use super::frame::{FrameError, Stage};
use super::level_set_file::LevelSetFile;
use super::picture::Scene;
use super::reading::{parse_particles, read_file};
use crate::grid::{LeafMask, negative_masks};
use crate::particles::Particles;
use crate::space::CoordBox;

/// What is looked at where there is nothing to see.
pub const NOTHING: [DVec3; 2] = [DVec3::NEG_ONE, DVec3::ONE];

/// The box that holds the first, the middle and the last of these files, least and greatest corner in world units;
/// `None` if there is nothing in them. Particles are balls of this radius. A file that cannot be read is passed over.
///
/// # Errors
/// That of the first file, if none of all can be read.
pub fn sequence_bounds(paths: &[&Path], radius: f64) -> Result<Option<[DVec3; 2]>, FrameError> {
    let mut indices = vec![0, paths.len() / 2, paths.len().saturating_sub(1)];
    indices.dedup();
    let read = |path: &Path| FrameError::catch(path, Stage::Read, || file_bounds(path, radius)).flatten();
    let (mut bounds, mut is_read, mut failed) = (None, false, None);
    for path in indices.iter().filter_map(|&index| paths.get(index)) {
        match read(path) {
            Ok(found) => {
                is_read = true;
                bounds = match (bounds, found) {
                    (Some(one), Some(other)) => Some(joined(one, other)),
                    (one, other) => one.or(other),
                };
            }
            Err(error) => {
                failed.get_or_insert(error);
            }
        }
    }
    match failed {
        // Any frame is better than none.
        Some(error) if !is_read => paths.iter().find_map(|path| read(path).ok()).ok_or(error),
        _ => Ok(bounds),
    }
}

/// The box that holds what is in a file: a level set in a .vdb, or particles.
fn file_bounds(path: &Path, radius: f64) -> Result<Option<[DVec3; 2]>, FrameError> {
    if is_level_set(path) {
        return Ok(LevelSetFile::read(path, false)?.scene().bounds());
    }
    let bytes = read_file(path)?;
    let read = parse_particles(path, &bytes, &Wanted::radii(None))?;
    Ok(bounds_of_particles(&read.cloud.positions, radius))
}

/// Whether a file is a level set, by its name.
pub fn is_level_set(path: &Path) -> bool {
    path.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("vdb"))
}

/// The box that holds balls of this radius at the particles, without those that strayed; world units, `None` if there is
/// no particle.
pub fn bounds_of_particles(particles: &Particles, radius: f64) -> Option<[DVec3; 2]> {
    let place = |index: usize| [particles.position(index); 2];
    box_of(particles.len(), place).map(|[least, greatest]| [least - radius, greatest + radius])
}

impl Scene<'_> {
    /// The box that holds what is inside, without what strayed; world units, `None` if nothing is inside.
    pub fn bounds(&self) -> Option<[DVec3; 2]> {
        let inside = negative_masks(&self.band.phi);
        let leaves: Vec<(&LeafMask, _)> =
            inside.iter().zip(self.band.topology.origins()).filter(|(mask, _)| !mask.is_empty()).collect();
        let of_leaf = |index: usize| {
            let (mask, &origin) = leaves[index];
            let CoordBox { min, max } = mask.bounding_box();
            [min, max].map(|corner| (origin + corner).as_dvec3() * self.lattice.voxel_size + self.origin)
        };
        box_of(leaves.len(), of_leaf)
    }
}

/// The box that holds so many small ones, without those that strayed. What is not finite is nowhere.
fn box_of(count: usize, small: impl Fn(usize) -> [DVec3; 2]) -> Option<[DVec3; 2]> {
    let finite = |index: usize| Some(small(index)).filter(|ends| ends.iter().all(|end| end.is_finite()));
    let all = (0..count).filter_map(finite).reduce(joined)?;
    let some: Vec<DVec3> =
        (0..count).step_by(count / SAMPLES + 1).filter_map(finite).map(|[least, _]| least).collect();
    let rank = some.len() / STRAYS;
    if rank == 0 {
        return Some(all);
    }
    let [low, high] = middle_of(&some, rank);
    let reach = DVec3::splat((high - low).max_element());
    let kept = (0..count)
        .filter_map(finite)
        .filter(|[least, greatest]| least.cmpge(low - reach).all() && greatest.cmple(high + reach).all());
    kept.reduce(joined)
}

/// Places are ranked by so many samples.
const SAMPLES: usize = 1 << 18;

/// One place in so many may have strayed, at either end of each axis.
const STRAYS: usize = 200;

/// Along each axis, the places of this rank from either end.
fn middle_of(places: &[DVec3], rank: usize) -> [DVec3; 2] {
    let mut ends = [DVec3::ZERO; 2];
    for axis in 0..3 {
        let mut along: Vec<f64> = places.iter().map(|place| place[axis]).collect();
        let last = along.len() - 1 - rank;
        ends[0][axis] = *along.select_nth_unstable_by(rank, f64::total_cmp).1;
        ends[1][axis] = *along.select_nth_unstable_by(last, f64::total_cmp).1;
    }
    ends
}

/// The box that holds two boxes.
pub fn joined(one: [DVec3; 2], other: [DVec3; 2]) -> [DVec3; 2] {
    [one[0].min(other[0]), one[1].max(other[1])]
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A slab of 10 × 1 × 10, and what is besides.
    fn slab_with(others: &[DVec3]) -> Option<[DVec3; 2]> {
        let slab = (0..1331)
            .map(|i| DVec3::new(f64::from(i % 11), f64::from(i / 11 % 11) * 0.1, f64::from(i / 121)));
        let places: Vec<DVec3> = slab.chain(others.iter().copied()).collect();
        box_of(places.len(), |index| [places[index]; 2])
    }

    const SLAB: [DVec3; 2] = [DVec3::ZERO, DVec3::new(10.0, 1.0, 10.0)];

    #[test]
    fn drops_of_a_splash_are_seen() {
        let drop = DVec3::new(4.0, 8.0, 14.0);
        assert_eq!(slab_with(&[drop]), Some([DVec3::ZERO, DVec3::new(10.0, 8.0, 14.0)]));
    }

    #[test]
    fn what_strayed_is_left_out() {
        let strayed = [DVec3::new(5.0, -900.0, 5.0), DVec3::splat(f64::NAN), DVec3::new(1e7, 0.0, 0.0)];
        assert_eq!(slab_with(&strayed), Some(SLAB));
    }

    #[test]
    fn few_places_are_all_seen() {
        let ends = [DVec3::ZERO, DVec3::new(1e6, 1.0, 2.0)];
        assert_eq!(box_of(2, |index| [ends[index]; 2]), Some(ends));
        assert_eq!(box_of(0, |_| [DVec3::ZERO; 2]), None);
    }
}
