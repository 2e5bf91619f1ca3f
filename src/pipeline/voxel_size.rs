//! The voxel size of a sequence, where nobody gave one.
//!
//! Half the particle spacing, of the first frame that has enough particles to measure it, and then
//! the same for all frames: a size of each frame's own would make the surface flicker. All frames
//! of the sequence count, whichever are converted: a part of a sequence is converted like the whole.

use std::fmt;
use std::path::{Path, PathBuf};

use crate::spacing::estimate_spacing;

use super::attributes::Wanted;
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
    /// How many frames could be read, but had too few particles.
    pub sparse_count: usize,
    /// How many could not be read.
    pub unreadable_count: usize,
    /// Why the first of those could not.
    pub unreadable: Option<FrameError>,
}

impl fmt::Display for NoVoxelSize {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let NoVoxelSize { sparse_count, unreadable_count, unreadable } = self;
        match unreadable {
            None => f.write_str(
                "no frame has the 33 distinct particles that it takes to measure their spacing: \
                 give --voxel-size",
            ),
            // A voxel size would not help: what is wrong is the files.
            Some(error) if *sparse_count == 0 => match unreadable_count {
                ..=1 => write!(f, "{error}"),
                _ => write!(f, "{error}; none of the {unreadable_count} frames can be read"),
            },
            Some(error) => write!(
                f,
                "no frame that can be read has the 33 distinct particles that it takes to measure \
                 their spacing: give --voxel-size; {unreadable_count} cannot be read: {error}"
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
    let mut none = NoVoxelSize { sparse_count: 0, unreadable_count: 0, unreadable: None };
    for path in files {
        let spacing_of_file = || {
            let bytes = read_file(path)?;
            let read = parse_particles(path, &bytes, &Wanted::default())?;
            Ok(estimate_spacing(&read.cloud.positions))
        };
        match FrameError::catch(path, Stage::Read, spacing_of_file).flatten() {
            Ok(Some(spacing)) => {
                let voxel_size = spacing / VOXELS_PER_SPACING;
                return Ok(AutomaticVoxelSize { voxel_size, spacing, measured_on: path.to_owned() });
            }
            Ok(None) => none.sparse_count += 1,
            Err(error) => {
                none.unreadable_count += 1;
                none.unreadable.get_or_insert(error);
            }
        }
    }
    Err(none)
}
