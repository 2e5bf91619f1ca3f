//! Bounding boxes for cameras: of one frame, and of a sequence.
//!
//! The box of a sequence covers its first, middle and last frame. A fluid seldom leaves that box, and a part
//! of a sequence gets the same camera as the whole. The box excludes outliers: otherwise a single drop far
//! from the rest would make everything else tiny in the picture.

use std::path::Path;

use glam::DVec3;

use super::attributes::AttributeRequest;
use super::level_set_file::{LevelSetFile, is_level_set};
use super::mesh_file::{MeshFile, is_mesh};
use super::reading::{parse_particles, read_file};
use crate::pipeline::error::{FrameError, Stage};
use crate::pipeline::memory::default_memory_bytes;
use crate::pipeline::target::picture::PictureScene;
use crate::surface::grid::{LeafMask, negative_masks};
use crate::surface::options::ReadOptions;
use crate::surface::particles::OwnedPositions;
use crate::surface::space::{CoordBox, box_of, joined};

/// The box that a camera shows if a frame is empty.
pub const EMPTY_BOUNDS: [DVec3; 2] = [DVec3::NEG_ONE, DVec3::ONE];

/// The bounding box of the first, the middle and the last of these files: minimum and maximum corner in world
/// units, or `None` if the files contain nothing. Particles are balls of this radius; only those that meet
/// the condition count. Skips files that cannot be read. If none of the three can be read, uses the first file
/// that can.
///
/// # Errors
/// The error of the first file, if no file can be read.
pub fn sequence_bounds(
    paths: &[&Path],
    radius: f64,
    reading: &ReadOptions,
) -> Result<Option<[DVec3; 2]>, FrameError> {
    let mut indices = vec![0, paths.len() / 2, paths.len().saturating_sub(1)];
    indices.dedup();
    let read =
        |path: &Path| FrameError::catch(path, Stage::Read, || file_bounds(path, radius, reading)).flatten();
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
        // None of the three can be read: the box of any other frame is better than an error.
        Some(error) if !is_read => paths.iter().find_map(|path| read(path).ok()).ok_or(error),
        _ => Ok(bounds),
    }
}

/// The bounding box of the contents of a file: the level set of a .vdb, a mesh, or particles.
fn file_bounds(path: &Path, radius: f64, reading: &ReadOptions) -> Result<Option<[DVec3; 2]>, FrameError> {
    if is_level_set(path) {
        return Ok(LevelSetFile::read(path, false, default_memory_bytes())?.scene().bounds());
    }
    if is_mesh(path) {
        // A radius is given if `convert` reads the vertices as particles.
        let bounds = MeshFile::read(path)?.bounds();
        return Ok(bounds.map(|[least, greatest]| [least - radius, greatest + radius]));
    }
    let content = read_file(path)?;
    let read = parse_particles(path, content, &AttributeRequest::positions_of(reading))?;
    Ok(bounds_of_particles(&read.cloud.positions, radius))
}

/// The bounding box of balls of this radius at the particles, without outliers, in world units; `None`
/// without particles.
pub fn bounds_of_particles(particles: &OwnedPositions, radius: f64) -> Option<[DVec3; 2]> {
    let corners = |index: usize| [particles.position(index); 2];
    box_of(particles.len(), corners).map(|[least, greatest]| [least - radius, greatest + radius])
}

impl PictureScene<'_> {
    /// The bounding box of the inside and of the particles beside it, without outliers, in world units; `None` if there
    /// are neither.
    pub fn bounds(&self) -> Option<[DVec3; 2]> {
        let inside = negative_masks(&self.band.phi);
        let leaves: Vec<(&LeafMask, _)> =
            inside.iter().zip(self.band.topology.origins()).filter(|(mask, _)| !mask.is_empty()).collect();
        let of_leaf = |index: usize| {
            let (mask, &origin) = leaves[index];
            let CoordBox { min, max } = mask.bounding_box();
            [min, max].map(|corner| (origin + corner).as_dvec3() * self.lattice.voxel_size + self.origin)
        };
        let spray = self.spray.map_or(0, |spray| spray.positions.len());
        let of_ball = |index: usize| {
            let (center, radius) = self.spray.map_or((DVec3::NAN, 0.0), |spray| {
                (spray.positions.position(index), f64::from(spray.radii[index]))
            });
            [center - radius, center + radius]
        };
        box_of(leaves.len() + spray, |index| match index.checked_sub(leaves.len()) {
            Some(ball) => of_ball(ball),
            None => of_leaf(index),
        })
    }
}
