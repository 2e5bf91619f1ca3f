//! Presets: sets of defaults for the most common kinds of particles.
//!
//! The lengths of most presets are in particle spacings d: a finer grid then shows the same surface in more
//! detail. Those of the preset `paper` are in voxels h, as in the paper.

use super::values::{AnisotropyKind, Length, LengthUnit};
use super::{MethodOptions, SettingsError, SettingsFault, require};
use crate::rasterize::Start;
use crate::spacing::IRREGULAR;
use crate::words::{rounded_to_digits, word_enum};

word_enum! {
    /// A set of defaults.
    #[derive(Default)]
    pub enum Preset {
        /// Water and other liquids of evenly spaced particles, such as those of SPH: the default
        #[default]
        Fluid = "fluid" | "sph",
        /// As fluid, but smoother, for irregularly spaced particles, such as those of FLIP and MPM
        Noisy = "noisy" | "flip" | "mpm",
        /// As fluid, on a finer grid: sheets, filaments and drops in close-ups
        Splash = "splash",
        /// Sand, snow, grain: balls, close to the particles
        Granular = "granular" | "sand",
        /// A quick preview: voxels as large as the spacing
        Preview = "preview",
        /// The parameters of Bhattacharya, Gao and Bargteil (2015): lengths are multiples of the voxel size
        Paper = "paper",
        /// Fluid for evenly spaced particles, noisy for irregular ones: chosen once for a sequence
        Auto = "auto",
    }
}

/// The unit of a preset's lengths and times.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Unit {
    /// The particle spacing d.
    Spacing,
    /// The voxel size h.
    VoxelSize,
}

/// The default values of a preset.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Recipe {
    /// The unit of the numbers below: they are multiples of powers of this length.
    pub(super) unit: Unit,
    /// Default voxel size, in particle spacings.
    pub(super) voxel_size: f64,
    /// Distance up to which particles blend, the reach of their kernels, in units; `None` to start from
    /// spheres.
    pub(super) blend: Option<f64>,
    /// How particles are stretched.
    pub(super) anisotropy: AnisotropyKind,
    /// Search radius for neighbours, in units; `None` for 3 r_min.
    pub(super) neighbor_radius: Option<f64>,
    /// How far particles are moved toward the mean of their neighbours, 0 to 1.
    pub(super) position_smoothing: f64,
    /// Cavities with a smaller volume than this are filled, in units³.
    pub(super) fill_cavities: f64,
    /// Number of Laplacian steps if a voxel is as large as the unit; the number grows with the square of unit
    /// / voxel size.
    pub(super) laplacian_steps: f64,
    /// Number of implicit steps.
    pub(super) steps: u32,
    /// Size of an implicit step, in units⁴.
    pub(super) step_size: f64,
    /// Total time of explicit steps, in units⁴.
    pub(super) explicit_time: f64,
}

/// The paper's numbers: five implicit steps of 20 h⁴ or 500 explicit ones of 0.01 h⁴
/// (Eq. 14, 15).
const PAPER: Recipe = Recipe {
    unit: Unit::VoxelSize,
    voxel_size: 0.5,
    blend: None,
    anisotropy: AnisotropyKind::None,
    neighbor_radius: None,
    position_smoothing: 0.0,
    fill_cavities: 0.0,
    laplacian_steps: 15.0,
    steps: 5,
    step_size: 20.0,
    explicit_time: 5.0,
};

/// The preset for fluids. docs/method.md has the measurements behind these values.
const FLUID: Recipe = Recipe {
    unit: Unit::Spacing,
    voxel_size: 0.32,
    blend: Some(1.7),
    anisotropy: AnisotropyKind::Neighbors,
    neighbor_radius: Some(2.8),
    position_smoothing: 0.5,
    fill_cavities: 25.0,
    laplacian_steps: 1.5,
    steps: 1,
    step_size: 0.006,
    explicit_time: 0.006,
};

impl Preset {
    /// The presets that `auto` chooses from.
    pub(super) const OF_AUTO: [Preset; 2] = [Preset::Fluid, Preset::Noisy];

    /// The preset that suits the particles of a fluid of this [irregularity](crate::spacing::IRREGULAR): `auto`
    /// chooses it. `fluid` if the irregularity is unknown.
    pub fn for_fluid(irregularity: Option<f64>) -> Preset {
        match irregularity {
            Some(irregularity) if irregularity > IRREGULAR => Preset::Noisy,
            _ => Preset::Fluid,
        }
    }

    /// Whether its lengths and times follow the voxel size, so that it needs no particle spacing.
    pub fn follows_voxel_size(self) -> bool {
        self.recipe().unit == Unit::VoxelSize
    }

    /// The default voxel size for a particle spacing.
    pub fn voxel_size(self, spacing: f64) -> f64 {
        rounded_to_digits(self.recipe().voxel_size * spacing)
    }

    pub(super) fn recipe(self) -> Recipe {
        match self {
            Preset::Fluid => FLUID,
            Preset::Noisy => Recipe {
                blend: Some(1.8),
                neighbor_radius: Some(3.0),
                position_smoothing: 0.45,
                laplacian_steps: 2.0,
                ..FLUID
            },
            Preset::Splash => Recipe { voxel_size: 0.25, ..FLUID },
            Preset::Granular => Recipe {
                voxel_size: 0.4,
                anisotropy: AnisotropyKind::None,
                position_smoothing: 0.3,
                laplacian_steps: 1.0,
                ..FLUID
            },
            Preset::Preview => {
                Recipe { voxel_size: 1.0, anisotropy: AnisotropyKind::None, position_smoothing: 0.0, ..FLUID }
            }
            Preset::Paper => PAPER,
            // Before the particles are measured, and where they are too few for that.
            Preset::Auto => Preset::for_fluid(None).recipe(),
        }
    }
}

/// The lengths that settings depend on, world units.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Scale {
    /// The particle spacing d.
    pub(super) spacing: f64,
    /// The voxel size h.
    pub(super) voxel_size: f64,
}

impl Scale {
    /// From the options and the measured spacing.
    ///
    /// # Errors
    /// If a length is not positive, or neither length is known.
    pub(super) fn new(
        options: &MethodOptions,
        measured: Option<SequenceSpacing>,
    ) -> Result<Scale, SettingsError> {
        let recipe = options.recipe();
        let in_world_units = options.voxel_size.and_then(Length::world);
        in_world_units.map_or(Ok(0.0), |h| super::positive("voxel size", h))?;
        let spacing = options.spacing.or(measured.map(|measured| measured.spacing));
        let spacing = match (spacing, in_world_units) {
            (Some(spacing), _) => super::positive("particle spacing", spacing)?,
            (None, Some(h)) => rounded_to_digits(h / recipe.voxel_size),
            (None, None) => return Err(SettingsFault::UnknownSpacing.into()),
        };
        let usual = rounded_to_digits(recipe.voxel_size * spacing);
        // The radius of a particle is half the spacing of particles of its size.
        let per_radius = match recipe.blend {
            Some(_) => (2.0 * recipe.voxel_size).min(1.0 / Start::Kernels.resolved_voxels()),
            None => 1.0 / Start::Spheres.resolved_voxels(),
        };
        let for_radii = |radius: f64| (radius * per_radius).max(spacing / VOXELS_PER_SPACING_MAX).min(usual);
        // With a given spacing, particles are measured only to choose a preset.
        let of_radii = measured.filter(|_| options.spacing.is_none());
        let median = of_radii.and_then(|measured| measured.radius_median);
        let voxel_size = match options.voxel_size {
            Some(length) => {
                require(length.unit != LengthUnit::Voxel, || {
                    format!(
                        "the voxel size is {length}; give it in world units or particle spacings, such as 0.4d"
                    )
                })?;
                super::positive_length("voxel size", options.voxel_size, length.resolve(spacing, f64::NAN))?
            }
            None => median.map_or(usual, for_radii),
        };
        Ok(Scale { spacing, voxel_size })
    }

    /// A length option in world units.
    pub(super) fn length(&self, given: Option<Length>) -> Option<f64> {
        given.map(|length| length.resolve(self.spacing, self.voxel_size))
    }

    /// Converts `count` units to a length, world units.
    pub(super) fn units(&self, unit: Unit, count: f64) -> f64 {
        match unit {
            Unit::VoxelSize => count * self.voxel_size,
            Unit::Spacing => rounded_to_digits(count * self.spacing),
        }
    }

    /// The number of voxels in a unit of length.
    pub(super) fn voxels(&self, unit: Unit) -> f64 {
        match unit {
            Unit::VoxelSize => 1.0,
            Unit::Spacing => self.spacing / self.voxel_size,
        }
    }
}

/// Upper limit of voxels per particle spacing, however small the particles' own radii are. Without this
/// limit, radii that are not in the unit of the positions could require a grid that does not fit into memory.
const VOXELS_PER_SPACING_MAX: f64 = 8.0;

/// Measurements of the particles of a sequence.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SequenceSpacing {
    /// The particle spacing d, world units.
    pub spacing: f64,
    /// The median radius of particles with per-particle radii, times the radius scale, world units. The default voxel size is chosen
    /// small enough for this radius.
    pub radius_median: Option<f64>,
    /// How irregularly the particles are spaced: see [`IRREGULAR`]. `None` if it was not measured.
    pub irregularity: Option<f64>,
}

impl From<f64> for SequenceSpacing {
    fn from(spacing: f64) -> SequenceSpacing {
        SequenceSpacing { spacing, radius_median: None, irregularity: None }
    }
}
