//! The spacing of more particles than fit into memory: reads them twice, batch by batch.
//!
//! ```text
//!   all particles ──▶ every n-th ──▶ boxes around some of these ──▶ all particles in the boxes ──▶ estimate
//! ```
//!
//! The particles of a sample are farther apart than those of the source, by a factor that depends on whether
//! they are in a body, a sheet or a filament. So the estimate uses all particles of the source that are in
//! boxes around some particles of the sample.

use glam::DVec3;

use crate::particles::{AnySource, OwnedPositions, Positions, Unread};

use super::{SpacingEstimate, estimate_spacing};

/// A sample of this size is as good as all particles. At most twice as many are kept.
const SAMPLE_MAX: usize = 1 << 20;

/// Upper limit of the number of boxes.
const BOX_COUNT: usize = 32;

/// Half an edge of a box in a body has at least this many spacings: most particles in the box then have all
/// their neighbours in it.
const HALF_EDGE_SPACINGS: f64 = 8.0;

/// Every n-th particle of a source, in its order.
#[derive(Debug)]
pub struct SourceSample {
    /// The finite particles of the sample.
    pub(crate) particles: OwnedPositions,
    /// n: one of this many particles is in the sample.
    every: usize,
}

impl SourceSample {
    /// Samples a source of `particle_count` particles; takes all of them if they are few.
    ///
    /// # Errors
    /// Those of the source.
    pub fn of(source: &AnySource<'_>, particle_count: usize) -> Result<SourceSample, Unread> {
        let every = particle_count.div_ceil(SAMPLE_MAX).max(1);
        let mut passed = 0;
        let particles = collect_wanted(source, |_| {
            passed += 1;
            (passed - 1) % every == 0
        })?;
        Ok(SourceSample { particles, every })
    }

    /// Estimates the spacing of all particles of the source that this is a sample of. `None` as in
    /// [`estimate_spacing`].
    ///
    /// # Errors
    /// Those of the source.
    pub fn estimate(&self, source: &AnySource<'_>) -> Result<Option<SpacingEstimate>, Unread> {
        let Some(of_sample) = estimate_spacing(&self.particles) else { return Ok(None) };
        if self.every == 1 {
            return Ok(Some(of_sample));
        }
        let as_in_a_body = of_sample.spacing / (self.every as f64).cbrt();
        let boxes = self.boxes((2.0 * of_sample.spacing).max(HALF_EDGE_SPACINGS * as_in_a_body));
        let in_a_box = |position: DVec3| {
            boxes
                .iter()
                .any(|[least, greatest]| position.cmpge(*least).all() && position.cmple(*greatest).all())
        };
        Ok(estimate_spacing(&collect_wanted(source, in_a_box)?))
    }

    /// Cubes around some of the particles.
    fn boxes(&self, half_edge: f64) -> Vec<[DVec3; 2]> {
        let count = self.particles.len();
        let centers = (0..count).step_by(count.div_ceil(BOX_COUNT).max(1));
        let center = |index| self.particles.position(index);
        centers.map(center).map(|center| [center - half_edge, center + half_edge]).collect()
    }
}

/// The finite particles that `is_wanted` selects.
fn collect_wanted(
    source: &AnySource<'_>,
    mut is_wanted: impl FnMut(DVec3) -> bool,
) -> Result<OwnedPositions, Unread> {
    let mut found: Vec<[f64; 3]> = Vec::new();
    for batch in 0..source.batch_count() {
        let mut take = |position: [f64; 3]| {
            let point = DVec3::from(position);
            if is_wanted(point) && point.is_finite() && found.len() < 2 * SAMPLE_MAX {
                found.push(position);
            }
        };
        match source.batch(batch)? {
            Positions::F32(positions) => {
                positions.iter().for_each(|&[x, y, z]| take([x, y, z].map(f64::from)))
            }
            Positions::F64(positions) => positions.iter().for_each(|&position| take(position)),
        }
    }
    Ok(OwnedPositions::F64(found))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::particles::erased;

    #[test]
    fn bounded_estimate_matches_the_spacing_of_all_particles() {
        let lattice = |counts: [usize; 3], spacing: f64| {
            let [x, y, z] = counts;
            let at =
                |index: usize| [index % x, index / x % y, index / x / y].map(|step| step as f64 * spacing);
            OwnedPositions::F64((0..x * y * z).map(at).collect())
        };
        // A body and a sheet; every second or third particle of each is sampled.
        for counts in [[130, 130, 130], [1700, 1700, 1]] {
            let particles = lattice(counts, 0.25);
            let Ok(sample) = erased(&particles, |source| SourceSample::of(source, particles.len()));
            assert!(sample.every > 1 && sample.particles.len() <= SAMPLE_MAX);
            let Ok(estimate) = erased(&particles, |source| sample.estimate(source));
            let found = estimate.expect("enough").spacing;
            assert!((found / 0.25 - 1.0).abs() < 0.03, "{counts:?}: {found}");
        }
    }
}
