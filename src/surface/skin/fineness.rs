//! Whether voxels are so small that positions cannot tell them apart.
//!
//! ```text
//!   voxels between most particles and their middle     65 536      1 048 576      16 777 216
//!   a 32-bit position of a vertex is off by            1/256       1/16           1 voxel
//!                                                      told        refused        no surface
//! ```
//!
//! Nobody asks for such a surface: somebody took another unit of length, or a zero too many, and would wait long for what
//! is none. A few particles that went astray are another matter, and are told of: most of the particles decide.

use std::fmt;

use glam::DVec3;

use crate::surface::options::Settings;
use crate::surface::particles::{ParticleSource, Particles};
use crate::surface::rasterize::Footprint;
use crate::surface::space::INDEX_LIMIT;
use crate::surface::spacing::{Sample, median};
use crate::surface::words::significant;

/// A frame is refused where most of its particles are farther from their middle, in voxels: 32-bit positions would be off
/// by a sixteenth of a voxel, and more.
pub const SPREAD_MAX_VOXELS: u32 = 1 << 20;

/// The voxels are too small for a frame: for how widely most of its particles are spread, or for how far they are from
/// the origin.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TooFine {
    /// The voxel size, world units.
    pub voxel_size: f64,
    /// The particle spacing as it was measured, world units.
    pub spacing: f64,
    /// The voxel size with which the frame could be skinned, at least, world units.
    pub least: f64,
    /// What they are too small for.
    pub limit: Limit,
}

/// What bounds voxels from below.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Limit {
    /// Most particles are more than [`SPREAD_MAX_VOXELS`] from their middle.
    Spread,
    /// Most particles are more than [`INDEX_LIMIT`] voxels from the origin: the grid does not reach there.
    Reach,
}

impl fmt::Display for TooFine {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let TooFine { voxel_size, spacing, least, limit } = *self;
        // What is told, in a few digits, is to be enough.
        let least = 1.001 * least;
        let [voxels, half, h, told_least, told_spacing] =
            [spacing / voxel_size, 0.5 * spacing, voxel_size, least, spacing].map(significant);
        match limit {
            Limit::Spread => write!(
                f,
                "the voxel size {h} (--voxel-size) is too small: particles are {told_spacing} apart, which is {voxels} voxels, \
                 and positions of 32 bits cannot tell so many apart over the whole frame"
            )?,
            Limit::Reach => write!(
                f,
                "the voxel size {h} (--voxel-size) is too small so far from the origin: most particles are more than \
                 {INDEX_LIMIT} voxels from it, where the grid ends; move them nearer to it, or give --voxel-size {told_least} at least"
            )?,
        }
        match limit {
            // The least one is for those who know why; it is nothing to look for.
            Limit::Spread if 0.5 * spacing >= least => {
                write!(
                    f,
                    "; half the spacing is usual, --voxel-size {half}, and {told_least} the least that can be"
                )
            }
            Limit::Spread => write!(f, "; --voxel-size {told_least} is the least that can be"),
            Limit::Reach => Ok(()),
        }
    }
}

impl std::error::Error for TooFine {}

/// Whether the voxels are too small for a frame with this footprint. Where that is so, its particles are read once more, and twice
/// more if they are many.
///
/// # Errors
/// Those of the source.
pub(super) fn too_fine<S: ParticleSource>(
    source: &S,
    settings: &Settings,
    footprint: &Footprint,
) -> Result<Option<TooFine>, S::Error> {
    let Footprint { particle_count, dropped_count, spread_voxels, .. } = *footprint;
    if spread_voxels <= SPREAD_MAX_VOXELS && dropped_count <= particle_count {
        return Ok(None);
    }
    let sample = Sample::of(source, particle_count + dropped_count)?;
    let Some(estimate) = sample.estimate(source)? else { return Ok(None) };
    let spacing = estimate.spacing;
    let (voxel_size, (least, limit)) = (settings.voxel_size, least_voxel_size(&sample.particles));
    Ok((voxel_size < least).then_some(TooFine { voxel_size, spacing, least, limit }))
}

/// The least voxel size with which most of these particles are near enough to their middle and to the origin, and which
/// of both asks for it.
fn least_voxel_size(particles: &Particles) -> (f64, Limit) {
    let positions = || (0..particles.len()).map(|index| particles.position(index));
    let median = |values: Vec<f64>| median(values).unwrap_or(0.0);
    let along = |axis: usize| median(positions().map(|position| position[axis]).collect());
    let middle = DVec3::new(along(0), along(1), along(2));
    let spread = median(positions().map(|position| (position - middle).abs().max_element()).collect());
    let far = median(positions().map(|position| position.abs().max_element()).collect());
    let by_spread = spread / f64::from(SPREAD_MAX_VOXELS);
    let by_reach = far / f64::from(INDEX_LIMIT);
    if by_spread >= by_reach { (by_spread, Limit::Spread) } else { (by_reach, Limit::Reach) }
}
