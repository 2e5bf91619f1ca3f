//! The voxel size of a sequence, where nobody gave one.
//!
//! Half the particle spacing, of the first frame that has enough particles to measure it, and then
//! the same for all frames: a size of each frame's own would make the surface flicker. All frames
//! of the sequence count, whichever are converted: a part of a sequence is converted like the whole.

use std::fmt;
use std::path::{Path, PathBuf};

use crate::spacing::estimate_spacing;

use super::frame::{FrameError, Stage};
use super::reading::{parse_particles, read_file};

/// Voxels along the distance between two particles.
pub const VOXELS_PER_SPACING: f64 = 2.0;

/// A voxel size, and where it is from.
#[derive(Clone, Debug, PartialEq)]
pub struct AutomaticVoxelSize {
    /// World units.
    pub voxel_size: f64,
    /// The particle spacing, world units.
    pub spacing: f64,
    /// The frame that it was measured on.
    pub measured_on: PathBuf,
}

/// Why there is none.
#[derive(Debug)]
pub struct NoVoxelSize {
    /// The first frame that could not be read, if there is one.
    pub unreadable: Option<FrameError>,
}

impl fmt::Display for NoVoxelSize {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match &self.unreadable {
            None => f.write_str(
                "no frame has the 33 distinct particles that it takes to measure their spacing: \
                 give --voxel-size",
            ),
            Some(error) => write!(
                f,
                "no frame could be read that has the 33 distinct particles that it takes to measure \
                 their spacing (give --voxel-size): {error}"
            ),
        }
    }
}

impl std::error::Error for NoVoxelSize {}

/// Half the spacing of the first of these files, in this order, on which it can be measured.
///
/// # Errors
/// When there is no such file. One that cannot be read is passed over: converting it will say why.
pub fn automatic_voxel_size<'a>(
    files: impl IntoIterator<Item = &'a Path>,
) -> Result<AutomaticVoxelSize, NoVoxelSize> {
    let mut unreadable = None;
    for path in files {
        let spacing_of_file = || {
            let bytes = read_file(path)?;
            Ok(estimate_spacing(&parse_particles(path, &bytes)?.particles))
        };
        match FrameError::catch(path, Stage::Read, spacing_of_file).flatten() {
            Ok(spacing) => {
                if let Some(spacing) = spacing {
                    let voxel_size = spacing / VOXELS_PER_SPACING;
                    return Ok(AutomaticVoxelSize { voxel_size, spacing, measured_on: path.to_owned() });
                }
            }
            Err(error) => {
                unreadable.get_or_insert(error);
            }
        }
    }
    Err(NoVoxelSize { unreadable })
}
