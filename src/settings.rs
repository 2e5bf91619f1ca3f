//! Every number of the method, resolved and checked once.
//!
//! [`Choices`] is what somebody asked for; [`Settings`] is what is meant. A sequence has one
//! `Settings` for all its frames: an estimate for each frame would flicker.

use std::fmt;

pub use crate::contour::Contouring;
use crate::smooth::EIGENVALUE_MAX;
pub use crate::smooth::Integrator;

/// What a user may choose. `None` means the default: the paper's, but for the integrator.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Choices {
    /// Radius of the inner spheres r_min, world units; √3·h by default (Eq. 13).
    pub radius_min: Option<f64>,
    /// r_max / r_min; 2 by default.
    pub radius_ratio: Option<f64>,
    /// Radius of the first surface, world units; (r_min + r_max) / 2 by default (Eq. 2).
    pub radius_init: Option<f64>,
    /// Which integrator; `Fast` by default.
    pub integrator: Option<Integrator>,
    /// Laplacian steps before the biharmonic ones; 15 by default.
    pub laplacian_steps: Option<u32>,
    /// Biharmonic steps; 5, or 500 for `Explicit`.
    pub steps: Option<u32>,
    /// Size of a step in units of h⁴; 20, or 0.01 for `Explicit` (Eq. 14, 15).
    pub step_size: Option<f64>,
    /// Redistance after so many steps; 1, or 50 for `Explicit`.
    pub redistance_every: Option<u32>,
    /// Relative tolerance of the conjugate gradients; 1e-4 by default.
    pub cg_tolerance: Option<f64>,
    /// Which contouring; `Dual` by default.
    pub contouring: Option<Contouring>,
}

/// All settings of a sequence, checked.
#[derive(Clone, Debug, PartialEq)]
pub struct Settings {
    /// Edge length h of a voxel, world units.
    pub voxel_size: f64,
    /// r_min, world units.
    pub radius_min: f64,
    /// r_init, world units.
    pub radius_init: f64,
    /// r_max, world units.
    pub radius_max: f64,
    /// Which integrator.
    pub integrator: Integrator,
    /// Laplacian steps before the biharmonic ones.
    pub laplacian_steps: u32,
    /// Biharmonic steps.
    pub steps: u32,
    /// Size of a biharmonic step, in units of h⁴.
    pub step_size: f64,
    /// Redistance after so many biharmonic steps.
    pub redistance_every: u32,
    /// Relative tolerance of the conjugate gradients (`Implicit` only).
    pub cg_tolerance: f64,
    /// Which contouring.
    pub contouring: Contouring,
}

/// Explicit steps of this much and more, in units of h⁴, are unstable.
pub const EXPLICIT_STEP_MAX: f64 = 2.0 / EIGENVALUE_MAX as f64;

/// The largest radius in voxels: beyond it the bins around a particle would be most of the frame.
const RADIUS_MAX_VOXELS: f64 = 64.0;

/// Steps of either kind: a hundred times what the paper takes.
const STEPS_MAX: f64 = 1e6;

/// Why choices make no settings.
#[derive(Clone, Debug, PartialEq)]
pub struct SettingsError {
    /// What is wrong, and what would be right.
    pub what: String,
}

impl fmt::Display for SettingsError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.what)
    }
}

impl std::error::Error for SettingsError {}

impl Settings {
    /// Fills in the defaults and checks every number.
    ///
    /// # Errors
    /// When a number is not finite or out of its range, or when the radii are out of order.
    pub fn resolve(voxel_size: f64, choices: &Choices) -> Result<Settings, SettingsError> {
        let h = positive("voxel size", voxel_size)?;
        let radius_min = positive("radius r_min", choices.radius_min.unwrap_or(3f64.sqrt() * h))?;
        let ratio = choices.radius_ratio.unwrap_or(2.0);
        require(ratio.is_finite() && ratio >= 1.0, || {
            format!("the radius ratio is {ratio}; r_max may not be below r_min: at least 1")
        })?;
        let radius_max = ratio * radius_min;
        let radius_init = choices.radius_init.unwrap_or(0.5 * (radius_min + radius_max));
        let radius_init = positive("radius r_init", radius_init)?;
        // A product of two numbers as typed may miss a third as typed by a rounding.
        let slack = 1e-9 * radius_max;
        require((radius_min - slack..=radius_max + slack).contains(&radius_init), || {
            format!(
                "r_init is {radius_init}; it must lie between r_min = {radius_min} and r_max = {radius_max}"
            )
        })?;
        require(radius_max <= RADIUS_MAX_VOXELS * h, || {
            format!(
                "r_max is {} voxels; more than {RADIUS_MAX_VOXELS} is not supported: choose a larger voxel size",
                radius_max / h
            )
        })?;
        let integrator = choices.integrator.unwrap_or(Integrator::Fast);
        let explicit = integrator == Integrator::Explicit;
        let settings = Settings {
            voxel_size: h,
            radius_min,
            radius_init: radius_init.clamp(radius_min, radius_max),
            radius_max,
            integrator,
            laplacian_steps: choices.laplacian_steps.unwrap_or(15),
            steps: choices.steps.unwrap_or(if explicit { 500 } else { 5 }),
            step_size: positive(
                "step size",
                choices.step_size.unwrap_or(if explicit { 0.01 } else { 20.0 }),
            )?,
            redistance_every: choices.redistance_every.unwrap_or(if explicit { 50 } else { 1 }),
            cg_tolerance: positive("conjugate gradient tolerance", choices.cg_tolerance.unwrap_or(1e-4))?,
            contouring: choices.contouring.unwrap_or(Contouring::Dual),
        };
        require(settings.redistance_every > 0, || {
            "redistance at least every so many steps: 1 or more".into()
        })?;
        within("number of steps", f64::from(settings.steps), 0.0, STEPS_MAX)?;
        within("number of Laplacian steps", f64::from(settings.laplacian_steps), 0.0, STEPS_MAX)?;
        within("step size in h⁴", settings.step_size, 1e-6, 1e4)?;
        within("conjugate gradient tolerance", settings.cg_tolerance, 1e-12, 0.5)?;
        Ok(settings)
    }

    /// Whether there is a voxel size with which these choices make sense: for a voxel size that is
    /// not yet known.
    ///
    /// # Errors
    /// When there is none.
    pub fn check(choices: &Choices) -> Result<(), SettingsError> {
        let sound = |radius: &f64| radius.is_finite() && *radius > 0.0;
        let ratio = choices.radius_ratio.unwrap_or(2.0);
        // One that puts a radius that was given between the others. What is wrong with the ratio
        // is told by `resolve`.
        let voxel_size = match (choices.radius_min.filter(sound), choices.radius_init.filter(sound)) {
            (Some(radius_min), _) => radius_min * ratio,
            (None, Some(radius_init)) => radius_init / (3f64.sqrt() * 0.5 * (1.0 + ratio)),
            (None, None) => 1.0,
        };
        let voxel_size = Some(voxel_size).filter(sound).unwrap_or(1.0);
        Settings::resolve(voxel_size, choices).map(|_| ())
    }

    /// What a user should be told before work begins, one sentence each.
    pub fn warnings(&self) -> Vec<String> {
        let mut warnings = Vec::new();
        if self.integrator == Integrator::Explicit && self.step_size >= EXPLICIT_STEP_MAX {
            warnings.push(format!(
                "explicit steps of {} h⁴ are beyond the stable bound of 2/144 = {EXPLICIT_STEP_MAX:.5} h⁴",
                self.step_size
            ));
        }
        if self.radius_min < 0.999 * 3f64.sqrt() * self.voxel_size {
            warnings.push(format!(
                "r_min is {:.3} voxels: below √3 a particle may fall between the voxels and be left outside",
                self.radius_min / self.voxel_size
            ));
        }
        warnings
    }
}

fn within(name: &str, value: f64, least: f64, most: f64) -> Result<(), SettingsError> {
    require((least..=most).contains(&value), || {
        format!("the {name} is {value}; it must be from {least} to {most}")
    })
}

fn positive(name: &str, value: f64) -> Result<f64, SettingsError> {
    require(value.is_finite() && value > 0.0, || {
        format!("the {name} is {value}; it must be a positive number")
    })?;
    Ok(value)
}

fn require(holds: bool, what: impl FnOnce() -> String) -> Result<(), SettingsError> {
    if holds { Ok(()) } else { Err(SettingsError { what: what() }) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn choices_are_checked_before_a_voxel_size_is_known() {
        let choices = |radius_min, radius_ratio, radius_init| Choices {
            radius_min,
            radius_ratio,
            radius_init,
            ..Choices::default()
        };
        for sound in [
            choices(None, None, None),
            choices(Some(1e-9), None, None),
            choices(Some(1e9), Some(30.0), None),
            choices(None, None, Some(1e-9)),
            choices(None, Some(1.0), Some(1e9)),
            choices(None, Some(4.0), Some(0.3)),
            choices(Some(0.1), Some(4.0), Some(0.3)),
        ] {
            assert_eq!(Settings::check(&sound), Ok(()), "{sound:?}");
        }
        for (senseless, word) in [
            (choices(None, Some(0.5), None), "ratio"),
            (choices(None, Some(-1.0), Some(1.0)), "ratio"),
            (choices(None, Some(f64::NAN), Some(1.0)), "ratio"),
            (choices(Some(-1.0), None, None), "r_min"),
            (choices(Some(f64::INFINITY), None, None), "r_min"),
            (choices(None, None, Some(0.0)), "r_init"),
            (choices(Some(0.1), Some(2.0), Some(0.3)), "r_init is 0.3"),
            (choices(None, Some(1000.0), None), "voxels"),
            (Choices { steps: Some(u32::MAX), ..Choices::default() }, "steps"),
        ] {
            let error = Settings::check(&senseless).expect_err("senseless");
            assert!(error.what.contains(word), "{senseless:?}: {error}");
        }
    }
}
