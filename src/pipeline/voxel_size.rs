//! The voxel size of a sequence, where nobody gave one.
//!
//! Half the particle spacing, of the first frame that has enough particles to measure it, and then
//! the same for all frames: a size of each frame's own would make the surface flicker. All frames
//! of the sequence count, whichever are converted: a part of a sequence is converted like the whole.
//!
//! Particles with radii of their own are, as a rule, as large as half their spacing, and the grid holds no r_min below
//! √3 voxels: half the spacing would raise nearly all of them. So the voxels are small enough for the median one.

use std::fmt;
use std::path::{Path, PathBuf};

use crate::settings::OwnRadii;
use crate::spacing::{estimate_spacing, median};

use super::attributes::{Wanted, own_radii_min};
use super::frame::{FrameError, Stage};
use super::reading::{ReadFrame, parse_particles, read_file};

/// Voxels along the distance between two particles.
pub const VOXELS_PER_SPACING: f64 = 2.0;

/// Voxels to the spacing of particles, at most, however small their own radii are.
const VOXELS_PER_SPACING_MAX: f64 = 8.0;

/// A voxel size, and where it is from.
#[derive(Clone, Debug, PartialEq)]
pub struct AutomaticVoxelSize {
    /// World units.
    pub voxel_size: f64,
    /// The particle spacing, world units.
    pub spacing: f64,
    /// The median r_min of particles with radii of their own, world units, where it is that and not the spacing which
    /// the voxel size follows.
    pub radius_median: Option<f64>,
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

/// Half the spacing of the first of these files, in this order, on which it can be measured; or less, so that the grid
/// holds the median of the particles with radii of their own.
///
/// # Errors
/// When there is no such file. One that cannot be read, or lacks the radii, is passed over: converting it will say why.
pub fn automatic_voxel_size<'a>(
    files: impl IntoIterator<Item = &'a Path>,
    own_radii: Option<&OwnRadii>,
) -> Result<AutomaticVoxelSize, NoVoxelSize> {
    let mut none = NoVoxelSize { sparse_count: 0, unreadable_count: 0, unreadable: None };
    for path in files {
        let measure = || {
            let bytes = read_file(path)?;
            let read = parse_particles(path, &bytes, &Wanted::radii(own_radii))?;
            Ok(measured(path, &read, own_radii))
        };
        match FrameError::catch(path, Stage::Read, measure).flatten() {
            Ok(Some(automatic)) => return Ok(automatic),
            Ok(None) => none.sparse_count += 1,
            Err(error) => {
                none.unreadable_count += 1;
                none.unreadable.get_or_insert(error);
            }
        }
    }
    Err(none)
}

/// The voxel size that a frame asks for; `None` where it has too few particles.
fn measured(path: &Path, read: &ReadFrame, own_radii: Option<&OwnRadii>) -> Option<AutomaticVoxelSize> {
    let spacing = estimate_spacing(&read.cloud.positions)?;
    let by_spacing = spacing / VOXELS_PER_SPACING;
    let radius_median = own_radii.and_then(|own| median(own_radii_min(&read.cloud, own)));
    let radius_median = radius_median.filter(|radius| radius / 3f64.sqrt() < by_spacing);
    // Radii in another unit than the positions would ask for a grid that nobody can have.
    let least = spacing / VOXELS_PER_SPACING_MAX;
    let voxel_size = radius_median.map_or(by_spacing, |radius| (radius / 3f64.sqrt()).max(least));
    Some(AutomaticVoxelSize { voxel_size, spacing, radius_median, measured_on: path.to_owned() })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::particles::{Attribute, AttributeValues, Cloud, Meaning, Particles};

    #[test]
    fn voxels_hold_the_median_particle_and_are_never_more_than_half_the_spacing() {
        let count = 6 * 6 * 6;
        let positions = (0..count).map(|i| [i % 6, i / 6 % 6, i / 36].map(f64::from)).collect();
        // Radii that are none have no say.
        let of_radii = |radii: [f32; 3]| {
            let mut values = vec![f32::NAN; count as usize];
            values.iter_mut().zip(radii.iter().cycle()).take(90).for_each(|(value, radius)| *value = *radius);
            let radii = Attribute {
                name: "pscale".into(),
                meaning: Meaning::Radius,
                arity: 1,
                values: AttributeValues::Numbers(values),
            };
            let positions = Particles::Double(Vec::clone(&positions));
            let cloud = Cloud { attributes: vec![radii], ..Cloud::from(positions) };
            ReadFrame { cloud, notes: Vec::new(), unused_velocity: None }
        };
        let own = OwnRadii { attribute: "pscale".into(), scale: 2.0 };
        let small = measured(Path::new("a"), &of_radii([0.25, 0.01, 40.0]), Some(&own)).expect("enough");
        assert_eq!(small.radius_median, Some(0.5));
        assert_eq!(small.voxel_size, 0.5 / 3f64.sqrt());
        let tiny = measured(Path::new("a"), &of_radii([1e-6; 3]), Some(&own)).expect("enough");
        assert_eq!(tiny.voxel_size, tiny.spacing / 8.0);
        for (radii, own) in
            [([3.0, 2.0, 1.0], Some(&own)), ([0.25, 0.01, 40.0], None), ([0.0, -1.0, f32::NAN], Some(&own))]
        {
            let automatic = measured(Path::new("a"), &of_radii(radii), own).expect("enough");
            assert_eq!((automatic.radius_median, automatic.voxel_size), (None, automatic.spacing / 2.0));
        }
    }
}
