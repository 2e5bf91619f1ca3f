//! Scales from per-particle radii (paper, Fig. 13).
//!
//! The r_min of a particle is its radius times S, the radius scale of the settings. The ratios of its r_init
//! and r_max to its r_min are those of the settings. So the scale of a particle, in units of the settings'
//! radii, is S·radius / r_min, with r_min of the settings. Scales below a floor are raised to it, because the
//! grid cannot hold a smaller surface.

use rayon::prelude::*;

use crate::parallel::Loops as _;

/// A scale per particle.
#[derive(Clone, Debug, PartialEq)]
pub struct RadiusScales {
    /// The scales, in units of the settings' radii. None is below the floor.
    pub scales: Vec<f32>,
    /// Number of radii too small for the grid, which were raised.
    pub raised_count: usize,
    /// Number of radii that are not positive, or not finite once scaled: these particles get the smallest
    /// scale.
    pub invalid_count: usize,
}

/// Scales from radii in world units: `radius_scale` · radius / `radius_min`, but at least `floor`.
/// `radius_min` is the settings' r_min in world units.
pub fn radius_scales(radii: &[f32], radius_scale: f64, radius_min: f64, floor: f32) -> RadiusScales {
    let scale_of = |&radius: &f32| {
        let scale = (radius_scale * f64::from(radius) / radius_min) as f32;
        // In 64 bits, a positive radius stays positive; a scale that rounds to 0 is raised.
        (radius > 0.0 && scale.is_finite()).then_some(scale)
    };
    let count = |is_counted: fn(Option<f32>, f32) -> bool| {
        radii.par_iter().halved().filter(|radius| is_counted(scale_of(radius), floor)).count()
    };
    RadiusScales {
        scales: radii
            .par_iter()
            .halved()
            .map(|radius| scale_of(radius).map_or(floor, |scale| scale.max(floor)))
            .collect(),
        raised_count: count(|scale, floor| scale.is_some_and(|scale| scale < floor)),
        invalid_count: count(|scale, _| scale.is_none()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn radii_are_scaled_and_raised_to_the_floor() {
        let radii = [0.5, 0.1, 1.0, 1e-45, f32::NAN, 0.0, -1.0, f32::INFINITY, 3e38];
        let scaled = radius_scales(&radii, 1.5, 0.25, 1.0);
        assert_eq!(scaled.scales, [3.0, 1.0, 6.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0]);
        assert_eq!((scaled.raised_count, scaled.invalid_count), (2, 5));
        assert_eq!(radius_scales(&[], 1.0, 1.0, 1.0).scales, [0.0; 0]);
    }
}
