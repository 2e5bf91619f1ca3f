//! Scales from the particles' own radii (paper, Fig. 13).
//!
//! r_min of a particle is to be S times its radius, and r_init and r_max are in the ratio of the settings: so its scale,
//! in units of the settings' radii, is S·radius / r_min. The grid holds no surface of less than the floor.

use rayon::prelude::*;

/// A scale for each particle.
#[derive(Clone, Debug, PartialEq)]
pub struct RadiusScales {
    /// In units of the settings' radii, none below the floor.
    pub scales: Vec<f32>,
    /// Radii that are less than the grid can hold, and were raised.
    pub raised_count: usize,
    /// Radii that are no positive numbers, or not finite once scaled: these particles have the least scale.
    pub invalid_count: usize,
}

/// Scales from radii in world units: `radius_scale` times the radius over `radius_min`, the settings' r_min in world
/// units, but not below `floor`.
pub fn radius_scales(radii: &[f32], radius_scale: f64, radius_min: f64, floor: f32) -> RadiusScales {
    let scale_of = |&radius: &f32| {
        let scale = (radius_scale * f64::from(radius) / radius_min) as f32;
        // In 64 bits nothing was lost: what is 0 was nearly so, and is raised.
        (radius > 0.0 && scale.is_finite()).then_some(scale)
    };
    let count = |is_counted: fn(Option<f32>, f32) -> bool| {
        radii.par_iter().filter(|radius| is_counted(scale_of(radius), floor)).count()
    };
    RadiusScales {
        scales: radii
            .par_iter()
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
