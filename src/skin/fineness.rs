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

use crate::particles::{ParticleSource, Particles, Positions};
use crate::rasterize::Footprint;
use crate::settings::Settings;
use crate::space::INDEX_LIMIT;
use crate::spacing::estimate_spacing;
use crate::words::significant;

/// A frame is refused where most of its particles are farther from their middle, in voxels: 32-bit positions would be off
/// by a sixteenth of a voxel, and more.
pub const SPREAD_MAX_VOXELS: u32 = 1 << 20;

/// The voxels are too small for a frame: most of its particles are more than [`SPREAD_MAX_VOXELS`] from their middle, or so
/// far from the origin that the grid does not reach there.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TooFine {
    /// The voxel size, world units.
    pub voxel_size: f64,
    /// The particle spacing as it was measured, world units.
    pub spacing: f64,
    /// The voxel size with which the frame could be skinned, at least, world units.
    pub least: f64,
}

impl fmt::Display for TooFine {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let TooFine { voxel_size, spacing, least } = *self;
        let [voxels, half, h, least, spacing] =
            [spacing / voxel_size, 0.5 * spacing, voxel_size, 1.001 * least, spacing].map(significant);
        write!(
            f,
            "the voxel size {h} (--voxel-size) is too small: particles are {spacing} apart, which is {voxels} voxels, and \
             positions of 32 bits cannot tell so many apart over the whole frame; it must be at least {least}, and half the \
             spacing, {half}, is usual"
        )
    }
}

impl std::error::Error for TooFine {}

/// Whether the voxels are too small for a frame with this footprint. Where that is so, its particles are gone through once more.
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
    let every = (particle_count + dropped_count).div_ceil(SAMPLE_MAX).max(1);
    let sample = sample(source, every)?;
    // In a sample, those that are left have more room each.
    let spacing = estimate_spacing(&sample).map(|spacing| spacing / (every as f64).cbrt());
    let (voxel_size, least) = (settings.voxel_size, least_voxel_size(&sample));
    let is_too_fine = |spacing| (voxel_size < least).then_some(TooFine { voxel_size, spacing, least });
    Ok(spacing.and_then(is_too_fine))
}

/// As many particles are as good as all.
const SAMPLE_MAX: usize = 1 << 20;

/// One particle of so many, where it is finite.
fn sample<S: ParticleSource>(source: &S, every: usize) -> Result<Particles, S::Error> {
    let mut sample: Vec<[f64; 3]> = Vec::new();
    let mut passed = 0;
    for batch in 0..source.batch_count() {
        let mut take = |position: [f64; 3]| {
            if passed % every == 0 && DVec3::from(position).is_finite() {
                sample.push(position);
            }
            passed += 1;
        };
        match source.batch(batch)? {
            Positions::Single(positions) => {
                positions.iter().for_each(|&[x, y, z]| take([x, y, z].map(f64::from)))
            }
            Positions::Double(positions) => positions.iter().for_each(|&position| take(position)),
        }
    }
    Ok(Particles::Double(sample))
}

/// The least voxel size with which most of these particles are near enough to their middle, and to the origin.
fn least_voxel_size(particles: &Particles) -> f64 {
    let positions = || (0..particles.len()).map(|index| particles.position(index));
    let along = |axis: usize| median(positions().map(|position| position[axis]));
    let middle = DVec3::new(along(0), along(1), along(2));
    let spread = median(positions().map(|position| (position - middle).abs().max_element()));
    let far = median(positions().map(|position| position.abs().max_element()));
    (spread / f64::from(SPREAD_MAX_VOXELS)).max(far / f64::from(INDEX_LIMIT))
}

/// The median, the lower of the two in the middle where there are two; 0 where there is none.
fn median(values: impl Iterator<Item = f64>) -> f64 {
    let mut values: Vec<f64> = values.collect();
    let Some(middle) = values.len().checked_sub(1).map(|last| last / 2) else { return 0.0 };
    *values.select_nth_unstable_by(middle, f64::total_cmp).1
}
