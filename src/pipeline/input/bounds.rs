//! What a camera looks at: the box of a frame, and of a sequence.
//!
//! Of a sequence the first, the middle and the last frame are looked at. A fluid seldom leaves their box, and a part of
//! a sequence has the same camera as the whole. A single drop that flew off would make all else tiny: what strayed is
//! left out.

use std::path::Path;

use glam::DVec3;

use super::attributes::Wanted;
use super::level_set_file::{LevelSetFile, is_level_set};
use super::reading::{parse_particles, read_file};
use crate::pipeline::error::{FrameError, Stage};
use crate::pipeline::target::picture::PictureScene;
use crate::surface::grid::{LeafMask, negative_masks};
use crate::surface::particles::Particles;
use crate::surface::space::{CoordBox, box_of, joined};

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

/// The box that holds balls of this radius at the particles, without those that strayed; world units, `None` if there is
/// no particle.
pub fn bounds_of_particles(particles: &Particles, radius: f64) -> Option<[DVec3; 2]> {
    let place = |index: usize| [particles.position(index); 2];
    box_of(particles.len(), place).map(|[least, greatest]| [least - radius, greatest + radius])
}

impl PictureScene<'_> {
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
