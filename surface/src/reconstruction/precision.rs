//! Detects voxel sizes too small for the precision of positions.
//!
//! ```text
//!   distance of most particles from their median, in voxels    65 536      1 048 576      16 777 216
//!   rounding error of a 32-bit vertex position                 1/256       1/16           1 voxel
//!   consequence                                                warning     error          error: no surface
//!                                                                                         is possible
//! ```
//!
//! Such a voxel size is a mistake, for example a wrong unit of length or an extra zero, and the user would
//! wait long for a useless result. A few stray particles are no reason to reject a frame: because the median
//! decides, they only cause a warning.

use std::fmt;

use glam::DVec3;

use crate::options::Settings;
use crate::particles::{AnySource, OwnedPositions, Unread};
use crate::rasterize::Footprint;
use crate::space::INDEX_LIMIT;
use crate::spacing::{ROUNDING_SHARE_MAX, SourceSample, median, rounding_error, rounding_step};
use crate::words::significant;

/// Upper limit of the median distance of particles from their median position, in voxels. Beyond it, 32-bit
/// positions are off by 1/16 voxel or more, and the frame is rejected.
pub const SPREAD_MAX_VOXELS: u32 = 1 << 20;

/// Error: the voxels are too small for a frame, because most of its particles are too widely spread or too
/// far from the origin.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct VoxelTooSmall {
    /// The voxel size, in world units.
    pub voxel_size: f64,
    /// The measured particle spacing, in world units.
    pub spacing: f64,
    /// The smallest voxel size that the frame allows, in world units.
    pub least: f64,
    /// Which limit is exceeded.
    pub limit: PrecisionLimit,
}

/// What limits the voxel size from below.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum PrecisionLimit {
    /// Most particles are more than [`SPREAD_MAX_VOXELS`] from their median position.
    Spread,
    /// Most particles are more than [`INDEX_LIMIT`] voxels from the origin, outside the grid's index range.
    Reach,
    /// 32-bit positions so far from the origin are rounded to this step, in world units, which distorts the
    /// measured spacing.
    Rounding(f64),
}

impl fmt::Display for VoxelTooSmall {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let VoxelTooSmall { voxel_size, spacing, least, limit } = *self;
        // Round up, so that the number in the message, which has few digits, is not below the limit.
        let least = 1.001 * least;
        let [voxels, half, h, shown_least, shown_spacing] =
            [spacing / voxel_size, 0.5 * spacing, voxel_size, least, spacing].map(significant);
        match limit {
            PrecisionLimit::Spread => write!(
                f,
                "the voxel size {h} (--voxel-size) is too small: 32-bit positions cannot resolve such voxels over the \
                 whole frame; particles are {shown_spacing} apart ({voxels} voxels)"
            )?,
            PrecisionLimit::Reach => write!(
                f,
                "the voxel size {h} (--voxel-size) is too small so far from the origin: most particles are more than \
                 {INDEX_LIMIT} voxels away, outside the grid; move them closer, or use --voxel-size {shown_least} or more"
            )?,
            PrecisionLimit::Rounding(step) => f.write_str(&rounding_error(step, spacing))?,
        }
        match limit {
            // The minimum is for experts; it is not a recommendation.
            PrecisionLimit::Spread if 0.5 * spacing >= least => {
                write!(f, "; use --voxel-size {half} (half the spacing); the minimum is {shown_least}")
            }
            PrecisionLimit::Spread => write!(f, "; the minimum is --voxel-size {shown_least}"),
            PrecisionLimit::Reach | PrecisionLimit::Rounding(_) => Ok(()),
        }
    }
}

impl std::error::Error for VoxelTooSmall {}

/// Checks whether the voxels are too small for a frame with this footprint. If the footprint suggests that
/// they are, the particles are read once more, or twice more if there are many.
///
/// # Errors
/// Returns the source's error if a batch cannot be read.
pub(super) fn voxel_too_small(
    source: &AnySource<'_>,
    settings: &Settings,
    footprint: &Footprint,
) -> Result<Option<VoxelTooSmall>, Unread> {
    let Footprint { particle_count, dropped_count, spread_voxels, .. } = *footprint;
    if spread_voxels <= SPREAD_MAX_VOXELS && dropped_count <= particle_count {
        return Ok(None);
    }
    // A partial footprint does not count all particles.
    let particle_count = (0..source.batch_count()).map(|batch| source.batch_len(batch)).sum();
    let sample = SourceSample::of(source, particle_count)?;
    let Some(estimate) = sample.estimate(source)? else { return Ok(None) };
    let spacing = estimate.spacing;
    let (voxel_size, (least, limit)) = (settings.voxel_size, least_voxel_size(&sample.particles));
    let step = rounding_step(&sample.particles);
    let limit = if step > ROUNDING_SHARE_MAX * spacing { PrecisionLimit::Rounding(step) } else { limit };
    Ok((voxel_size < least).then_some(VoxelTooSmall { voxel_size, spacing, least, limit }))
}

/// The smallest voxel size with which most of these particles are near enough to their median and to the
/// origin, and the limit that determines it.
fn least_voxel_size(particles: &OwnedPositions) -> (f64, PrecisionLimit) {
    let positions = || (0..particles.len()).map(|index| particles.position(index));
    let median = |values: Vec<f64>| median(values).unwrap_or(0.0);
    let along = |axis: usize| median(positions().map(|position| position[axis]).collect());
    let middle = DVec3::new(along(0), along(1), along(2));
    let spread = median(positions().map(|position| (position - middle).abs().max_element()).collect());
    let far = median(positions().map(|position| position.abs().max_element()).collect());
    let by_spread = spread / f64::from(SPREAD_MAX_VOXELS);
    let by_reach = far / f64::from(INDEX_LIMIT);
    if by_spread >= by_reach {
        (by_spread, PrecisionLimit::Spread)
    } else {
        (by_reach, PrecisionLimit::Reach)
    }
}
