//! All options of the method, and their conversion to and from text.
//!
//! ```text
//!   command line ─┐
//!   meniscus.toml ┼─▶ MethodOptions ──over the defaults of a preset──resolve──▶ Settings
//!   Python        ┘      ▲ │
//!      (name, text) ─────┘ └─────▶ (name, text): `--print-settings`, provenance, records
//! ```
//!
//! Numbers are written in the shortest form that parses as the same number.

use std::fmt::{Display, LowerExp};
use std::ops::RangeInclusive;

use super::fields::{self, OptionGroup, OptionInfo, OptionValue, ValueKind, method_options};
use super::presets::{Preset, Recipe};
use super::resolution::Pairs;
use super::values::{AnisotropyKind, AttributeSelection, ClipBox, ColumnNames, Length, LengthUnit};
use super::{OptionName, PerParticleRadius, ReadOptions, SettingsError, SpacingOptions, Start, positive};
use crate::attributes::names_velocity;
use crate::contour::Contouring;
use crate::particles::ParticleFilter;
use crate::smooth::Integrator;
use crate::temporal::FRAMES_MAX;

/// Upper limit of `drop_islands`. A larger piece is not an island to drop. It may also be so thick that its
/// deep leaves are not stored, and its particles cannot be counted.
const ISLAND_MAX: u32 = 1000;

/// Upper limit of `spray_keep`: each frame depends on twice as many on each side, less two.
const SPRAY_KEEP_MAX: u32 = 5;

/// The largest number of a reference frame.
const REST_MAX: u32 = 99_999_999;

/// Upper limit of `rest_period`.
const REST_PERIOD_MAX: u32 = 100_000;

/// Upper limit of `fill_cavities`, in voxels.
pub(super) const CAVITY_VOXELS_MAX: f64 = 1e6;

/// Upper limit of `void_threshold`, in units of h: distances to obstacles are not known farther out.
const VOID_THRESHOLD_MAX: f64 = 4.0;

/// Upper limit of `max_stretch`: beyond it a particle would reach over several leaves.
const MAX_STRETCH_MAX: f64 = 8.0;

/// The smallest factor of velocities. Its square, the factor of accelerations, is a normal 32-bit number.
const VELOCITY_SCALE_MIN: f64 = 1e-9;

/// The largest factor of velocities.
const VELOCITY_SCALE_MAX: f64 = 1e9;

/// Upper limit of `decimate`, in units of h: beyond it the mesh has a different shape.
const DECIMATE_MAX: f64 = 1.0;

/// Upper limit of `smooth_normals`: after more rounds the normals no longer depend on the surface.
const ROUNDS_MAX: u32 = 1000;

/// Upper limit of the number of Laplacian and of biharmonic steps: a hundred times the paper's.
pub(super) const STEPS_MAX: u32 = 1_000_000;

/// The smallest size of a step, in units of h⁴.
pub(super) const STEP_SIZE_MIN: f64 = 1e-6;

/// The largest size of a step, in units of h⁴.
pub(super) const STEP_SIZE_MAX: f64 = 1e4;

/// The shortest time between two frames, in seconds.
const TIME_STEP_MIN: f64 = 1e-9;

/// The longest time between two frames, in seconds.
const TIME_STEP_MAX: f64 = 1e9;

method_options! {
    /// All options of the method. `None` means the value of the preset. Lengths are in world units, particle
    /// spacings or voxels: see [`Length`].
    pub struct MethodOptions {
        General {
            /// A set of defaults for a kind of particles; other options override it, and their defaults below are
            /// those of fluid [default: fluid]
            #[value(named("NAME"))]
            preset: Preset,

            /// Distance d between neighbouring particles, in world units, positive [default: measured]
            #[value(named("D"))]
            #[parser(Length::parse_world)]
            spacing: f64,

            /// Voxel edge length h, positive, in world units or particle spacings [default: 0.32d]
            #[value(named("LENGTH").signed())]
            #[parser(Length::parse_voxel_size)]
            voxel_size: Length,
        }
        Surface {
            /// Distance up to which particles blend with others, 3.09h to 64h: larger is smoother, makes drops larger and
            /// joins them earlier; with all presets but paper [default: 1.7d, but no less than 3.09h]
            #[value(named("LENGTH").signed())]
            blend: Length
                => [
                    OptionName::with_value("preset", "fluid"),
                    OptionName::with_value("preset", "noisy"),
                    OptionName::with_value("preset", "splash"),
                    OptionName::with_value("preset", "granular"),
                    OptionName::with_value("preset", "preview"),
                ],
                |options, _| options.start() == Start::Kernels,

            /// Radius r_min of the spheres that the surface encloses, positive, for --preset paper [default: √3·h]
            #[value(named("LENGTH").signed())]
            radius_min: Length => [OptionName::with_value("preset", "paper")], |options, _| options.start() == Start::Spheres,

            /// Ratio r_max / r_min, at least 1; every point of the surface is within r_max of some particle,
            /// and r_max is at most 64h; for --preset paper [default: 2]
            #[value(named("RATIO"))]
            radius_ratio: f64 => [OptionName::with_value("preset", "paper")], |options, _| options.start() == Start::Spheres,

            /// Move the finished surface outward by this distance, up to 2h; negative moves it inward, by at most the
            /// radius of a lone drop [default: 0]
            #[value(named("LENGTH").signed())]
            offset: Length,
        }
        Particles {
            /// New names for columns of tables, each with a column by its name or its number from 1 on, such as
            /// x=centroid_x,y=centroid_y,z=centroid_z; the names x, y, z, vx, vy, vz, radius, diameter and id say what
            /// the columns mean
            #[value(named("LIST"))]
            columns: ColumnNames,

            /// Use only the particles whose attributes meet this condition, such as 'phase == 0' or 'type in
            /// 1,2 and not (density < 500)'; comparisons are ==, !=, <, <=, >, >=, in and not in
            #[value(named("CONDITION"))]
            r#where: ParticleFilter,

            /// Attribute with each particle's own radius, in world units, such as pscale.
            /// A particle without neighbours becomes a ball of this radius, unless --blend is given
            #[value(named("NAME"))]
            radius_attribute: String,

            /// Factor from a particle's own radius to that of its ball, positive [default: 1]
            #[value(named("FACTOR"))]
            radius_scale: f64 => [OptionName::new("radius_attribute")], |options, _| options.radius_attribute.is_some(),

            /// How to stretch particles, so that sheets and jets are thin and smooth [default: neighbors]
            #[value(named("BY"))]
            anisotropy: AnisotropyKind,

            /// Maximum ratio of a particle's longest semi-axis to its shortest, 1 to 8 [default: 2]
            #[value(named("RATIO"))]
            max_stretch: f64 in 1.0..=MAX_STRETCH_MAX
                => [OptionName::with_value("anisotropy", "neighbors"), OptionName::with_value("anisotropy", "velocity")],
                |options, _| options.anisotropy_kind() != AnisotropyKind::None,

            /// Search radius for neighbours, positive and at most 200h [default: 2.8d]
            #[value(named("LENGTH").signed())]
            neighbor_radius: Length
                => [OptionName::with_value("anisotropy", "neighbors"), OptionName::new("position_smoothing")],
                |options, _| options.uses_neighbors(),

            /// Move particles near the surface toward the mean of their neighbours by this fraction of the
            /// distance, 0 to 1 [default: 0.5]
            #[value(named("FRACTION"))]
            position_smoothing: f64 in 0.0..=1.0,

            /// Stretch each particle along its velocity by how far it moves in this time, in units of its radius; positive,
            /// up to --max-stretch, only for --anisotropy velocity [default: 0.01]
            #[value(named("SECONDS"))]
            velocity_gain: f64
                => [OptionName::with_value("anisotropy", "velocity")],
                |options, _| options.anisotropy_kind() == AnisotropyKind::Velocity,
        }
        Obstacles {
            /// Fill gaps narrower than this between the surface and obstacles, in voxels, 0 to 4 [default: 1]
            #[value(named("VOXELS"))]
            void_threshold: f64 in 0.0..=VOID_THRESHOLD_MAX
                => [OptionName::new("obstacle")], |_, has_obstacles| has_obstacles,
        }
        Particles {
            /// Attributes to interpolate to the surface: a list of names, such as velocity,Cd,id, or the word
            /// all; speed, vorticity and normal_curvature are computed
            ///
            /// Floating-point values are averaged over nearby particles; integers and strings are taken from
            /// the nearest particle. The results are vertex attributes in meshes, and additional grids in
            /// .vdb.
            #[value(named("LIST"))]
            attributes: AttributeSelection,

            /// Multiply velocities by this factor, and accelerations by its square, 1e-9 to 1e9. If velocities
            /// are per frame, give the frame rate [default: 1]
            #[value(named("FACTOR"))]
            velocity_scale: f64 in VELOCITY_SCALE_MIN..=VELOCITY_SCALE_MAX
                => [
                    OptionName::new("attributes"),
                    OptionName::with_value("anisotropy", "velocity"),
                    OptionName::new("time_step"),
                ],
                uses_velocities,

            /// Interpolate rest coordinates to the surface: the position that each particle had in the frame with this
            /// number, 0 to 99999999
            ///
            /// Particles are followed by their ids; one that appeared later has the position at which it appeared. The
            /// surface, and points beside it, get the vector attribute `rest`.
            #[value(named("FRAME"))]
            rest: u32 in 0..=REST_MAX,

            /// Begin the rest coordinates again after this many frame numbers, 2 to 100000, even: a second set, `rest2`,
            /// begins half a period later, and `rest_ratio` is its weight [default: one set, which never begins again]
            #[value(named("FRAMES"))]
            rest_period: u32 in 2..=REST_PERIOD_MAX => [OptionName::new("rest")], |options, _| options.rest.is_some(),

            /// Average each surface with those of this many frames before and after it, along the motion of
            /// the particles, 0 to 3; particles are followed by their ids or, with --time-step, by their
            /// velocities [default: 0]
            #[value(named("N"))]
            temporal: u32 in 0..=FRAMES_MAX,

            /// Seconds from one frame to the next (not the time step of the solver), 1e-9 to 1e9, for particles without ids or
            /// without velocities
            ///
            /// With --temporal, particles without ids are followed by their velocities. With --attributes velocity,
            /// velocities that the particles lack are computed from the frames before and after: by ids, or by the order of
            /// the particles if none of them moves far.
            #[value(named("SECONDS"))]
            time_step: f64 in TIME_STEP_MIN..=TIME_STEP_MAX
                => [OptionName::new("temporal"), OptionName::with_value("attributes", "velocity")],
                |options, _| options.temporal.unwrap_or(0) > 0 || names_velocity(options.attributes.as_ref()),
        }
        Surface {
            /// Drop pieces of surface with fewer particles than this, 0 to 1000 [default: 0]
            #[value(named("N"))]
            drop_islands: u32 in 0..=ISLAND_MAX,

            /// Leave pieces of fluid with fewer particles than this out of the surface, and write them as points beside it,
            /// 0 to 1000 [default: 0]
            ///
            /// Particles are linked if their r_init spheres touch. dam.0012.spray.ply has the points beside dam.0012.glb,
            /// with a radius, a class (0 for drops, 1 for clusters, 2 for filaments), and the attributes of the particles.
            #[value(named("N"))]
            spray: u32 in 0..=ISLAND_MAX,

            /// Number of frames that a particle stays in the surface or in the spray before it changes, 1 to 5; particles
            /// are followed by their ids [default: 3]
            #[value(named("FRAMES"))]
            spray_keep: u32 in 1..=SPRAY_KEEP_MAX => [OptionName::new("spray")], |options, _| options.has_spray(),

            /// Fill enclosed cavities with less volume than this, in h³, 0 to 1000000 [default: 25 d³, which is
            /// 763 h³ on the default grid]
            #[value(named("VOLUME"))]
            fill_cavities: f64 in 0.0..=CAVITY_VOXELS_MAX,

            /// Cut off everything outside the box x0,y0,z0,x1,y1,z1 (lower corner first), in world
            /// units
            #[value(named("BOX").signed())]
            clip: ClipBox,
        }
        Mesh {
            /// How to convert the level set to triangles [default: dual]
            #[value(named("HOW"))]
            contour: Contouring,

            /// Decimate the mesh: remove triangles where that moves the mesh by no more than this, in voxels,
            /// 0 to 1 [default: 0]
            #[value(named("VOXELS"))]
            decimate: f64 in 0.0..=DECIMATE_MAX,

            /// Average normals with their neighbours this many times, 0 to 1000 [default: 0]
            #[value(named("N"))]
            smooth_normals: u32 in 0..=ROUNDS_MAX,

            /// Write the quads of dual contouring to formats with polygons, such as .obj, .usdc and .abc;
            /// --quads=false overrides the key in a configuration file [default: false]
            #[value(named("BOOL").or_omitted("true"))]
            quads: bool,
        }
        Solver {
            /// Time integrator of the smoothing [default: fast]
            #[value(named("WHICH"))]
            integrator: Integrator,

            /// Number of Laplacian steps before the biharmonic ones, 0 to 1000000; with 0,
            /// distances are recomputed in their place [default: 1.5 (d/h)², 15 on the default grid]
            #[value(named("N"))]
            laplacian_steps: u32 in 0..=STEPS_MAX,

            /// Number of biharmonic steps, 0 to 1000000 [default: 1; explicit, adaptive: as many as
            /// give the same total pseudo-time]
            #[value(named("N"))]
            steps: u32 in 0..=STEPS_MAX,

            /// Size of a biharmonic step in pseudo-time, in units of h⁴, 1e-6 to 10000 [default: 0.006
            /// (d/h)⁴; explicit, adaptive: 0.01]
            #[value(named("TIME"))]
            step_size: f64 in STEP_SIZE_MIN..=STEP_SIZE_MAX,

            /// Recompute distances after this many biharmonic steps, 1 to 1000000 [default: 1; explicit,
            /// adaptive: 50]
            #[value(named("N"))]
            redistance_every: u32 in 1..=STEPS_MAX,
        }
    }
}

impl MethodOptions {
    /// Parses options from pairs of name and text; `None` if a name is unknown or a text is not a value of
    /// its option.
    pub fn from_pairs<'a>(pairs: impl IntoIterator<Item = (&'a str, &'a str)>) -> Option<MethodOptions> {
        let mut options = MethodOptions::default();
        pairs.into_iter().try_for_each(|(name, text)| options.set(name, text).ok())?;
        Some(options)
    }

    /// The description of the option with this name.
    pub fn info(name: &str) -> Option<&'static OptionInfo<MethodOptions>> {
        MethodOptions::ALL.iter().find(|info| info.name == name)
    }

    /// Whether small pieces of fluid are left out of the surface.
    pub fn has_spray(&self) -> bool {
        self.spray.unwrap_or(0) > 0
    }

    /// Whether surfaces depend on frames before and after them.
    pub fn needs_frames_around(&self) -> bool {
        !self.frame_reach().is_none()
    }

    /// The default values of the preset.
    pub(super) fn recipe(&self) -> Recipe {
        self.preset.unwrap_or_default().recipe()
    }

    /// Whether particles must be measured to resolve the settings: their spacing, or which preset suits them.
    pub fn needs_measuring(&self) -> bool {
        let follows_voxel_size = self.preset.unwrap_or_default().follows_voxel_size();
        let has_voxel_size = self.voxel_size.and_then(Length::world).is_some();
        let needs_spacing = !has_voxel_size || !follows_voxel_size || self.has_length_in(LengthUnit::Spacing);
        self.is_auto() || self.spacing.is_none() && needs_spacing
    }

    /// Whether the preset is chosen by the particles.
    pub fn is_auto(&self) -> bool {
        self.preset.unwrap_or_default() == Preset::Auto
    }

    /// These options with the preset that they choose for particles of this irregularity.
    pub(super) fn with_preset_for(&self, irregularity: Option<f64>) -> MethodOptions {
        let preset = match self.preset.unwrap_or_default() {
            Preset::Auto => Preset::for_fluid(irregularity),
            preset => preset,
        };
        MethodOptions { preset: Some(preset), ..self.clone() }
    }

    /// Whether a length other than the particle spacing and the voxel size is given in this unit.
    pub fn has_length_in(&self, unit: LengthUnit) -> bool {
        let pairs = self.to_pairs().into_iter();
        let is_dependent = |name: &str| !["spacing", "voxel_size"].contains(&name);
        let mut lengths = pairs.filter(|(name, _)| {
            is_dependent(name) && MethodOptions::info(name).is_some_and(|info| info.kind == ValueKind::Length)
        });
        lengths.any(|(_, text)| text.parse().is_ok_and(|length: Length| length.unit == unit))
    }

    /// How far particles are moved toward the mean of their neighbours, 0 to 1.
    pub(super) fn position_smoothing(&self) -> f64 {
        self.position_smoothing.unwrap_or(self.recipe().position_smoothing)
    }

    /// Whether a particle's position or shape depends on its neighbours.
    pub fn uses_neighbors(&self) -> bool {
        self.start() == Start::Kernels
            || self.position_smoothing() > 0.0
            || self.anisotropy_kind() == AnisotropyKind::Neighbors
    }

    /// What smoothing starts from.
    pub(super) fn start(&self) -> Start {
        if self.recipe().blend.is_some() { Start::Kernels } else { Start::Spheres }
    }

    /// How particles are stretched.
    pub fn anisotropy_kind(&self) -> AnisotropyKind {
        self.anisotropy.unwrap_or(self.recipe().anisotropy)
    }

    /// The per-particle radii, if an attribute is set for them.
    ///
    /// # Errors
    /// If their scale is not a positive number.
    pub fn per_particle_radius(&self) -> Result<Option<PerParticleRadius>, SettingsError> {
        let Some(attribute) = &self.radius_attribute else { return Ok(None) };
        let scale = positive("radius scale", self.radius_scale.unwrap_or(1.0))?;
        Ok(Some(PerParticleRadius { attribute: attribute.clone(), scale }))
    }

    /// What is read from a file of particles.
    pub fn read_options(&self) -> ReadOptions {
        ReadOptions { columns: self.columns.clone(), filter: self.r#where.clone() }
    }

    /// The options that affect how the particle spacing is measured.
    ///
    /// # Errors
    /// As for [`per_particle_radius`](Self::per_particle_radius).
    pub fn spacing_options(&self) -> Result<SpacingOptions, SettingsError> {
        Ok(SpacingOptions { reading: self.read_options(), per_particle_radius: self.per_particle_radius()? })
    }

    /// The given options that have no effect, each with the options of which it requires one;
    /// `has_obstacles` says whether there are obstacles.
    pub fn ineffective(&self, has_obstacles: bool) -> Vec<(&'static str, &'static [OptionName])> {
        let unmet_need = |name: &'static str| {
            let need = MethodOptions::info(name)?.need.as_ref()?;
            (!(need.is_met)(self, has_obstacles)).then_some((name, need.any_of))
        };
        self.to_pairs().into_iter().filter_map(|(name, _)| unmet_need(name)).collect()
    }
}

fn uses_velocities(options: &MethodOptions, _: bool) -> bool {
    let has_attributes = options.attributes.is_some() || options.time_step.is_some();
    has_attributes || options.anisotropy_kind() == AnisotropyKind::Velocity
}

fn out_of_range<T: Display + LowerExp>(name: &str, value: T, range: &RangeInclusive<T>) -> SettingsError {
    SettingsError::of_value(format!("{name} is {value}; it must be from {}", fields::range_text(range)))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// All options, each set to the first of these texts that it accepts.
    fn every() -> MethodOptions {
        let mut options = MethodOptions::default();
        for info in MethodOptions::ALL {
            let texts = ["1", "true", "fluid", "none", "dual", "fast", "0,0,0,1,1,1", "x=1"];
            assert!(texts.iter().any(|text| options.set(info.name, text).is_ok()), "{}", info.name);
        }
        options
    }

    /// All options, with numbers whose text is hard to get exact.
    #[expect(clippy::needless_update, reason = "options yet to be added have values, too")]
    fn all() -> MethodOptions {
        MethodOptions {
            preset: Some(Preset::Splash),
            spacing: Some(0.2_f64.next_up()),
            voxel_size: Some((1.0 / 7.0).into()),
            radius_min: Some((1.0 / 3.0).into()),
            radius_ratio: Some(1.5),
            blend: Some((f64::MIN_POSITIVE / 3.0).into()),
            offset: Some((-1.0 / 7.0).into()),
            columns: Some("x=c x,id=1".parse().expect("columns")),
            r#where: Some("phase in 1,2 or 'p é' != \"x, y\"".parse().expect("a condition")),
            radius_attribute: Some("p scale, \"é\"".to_owned()),
            radius_scale: Some(0.1_f64.next_up()),
            anisotropy: Some(AnisotropyKind::Velocity),
            max_stretch: Some(1e300),
            neighbor_radius: Some("-5h".parse().expect("a length")),
            position_smoothing: Some(0.9),
            velocity_gain: Some(1.0 / 48.0),
            void_threshold: Some(1.7),
            attributes: Some(AttributeSelection::Named(vec!["v".to_owned(), "Cd".to_owned()])),
            velocity_scale: Some(24_000.0 / 1001.0),
            rest: Some(7),
            rest_period: Some(12),
            drop_islands: Some(33),
            spray: Some(20),
            spray_keep: Some(2),
            fill_cavities: Some(1e-300),
            clip: Some(ClipBox { min: [-1.0, 0.0, 1.0 / 3.0], max: [1.0, 2.0, 1e9] }),
            contour: Some(Contouring::Tetrahedra),
            decimate: Some(0.05),
            smooth_normals: Some(3),
            quads: Some(true),
            integrator: Some(Integrator::Implicit),
            laplacian_steps: Some(0),
            steps: Some(u32::MAX),
            step_size: Some(1e-300),
            redistance_every: Some(7),
            temporal: Some(2),
            time_step: Some(1.0 / 24.0),
            ..every()
        }
    }

    fn read(pairs: &[(&'static str, String)]) -> Option<MethodOptions> {
        MethodOptions::from_pairs(pairs.iter().map(|(name, value)| (*name, value.as_str())))
    }

    #[test]
    fn options_read_back_from_pairs_to_the_last_bit() {
        let pairs = all().to_pairs();
        assert_eq!(read(&pairs), Some(all()));
        // Each pair alone reads back, and differs from the default.
        for pair in &pairs {
            let one = read(std::slice::from_ref(pair)).expect("known");
            assert_eq!(one.to_pairs(), std::slice::from_ref(pair));
            assert_ne!(one, MethodOptions::default());
        }
        assert_eq!(read(&[]), Some(MethodOptions::default()));
        assert_eq!(read(&[("radius_min", "wide".to_owned())]), None);
        assert_eq!(read(&[("radius_mine", "1".to_owned())]), None);
    }

    #[test]
    fn set_options_override_those_below() {
        assert_eq!(all().over(MethodOptions::default()), all());
        assert_eq!(MethodOptions::default().over(all()), all());
        let above = MethodOptions { steps: Some(2), ..MethodOptions::default() };
        assert_eq!(above.over(all()), MethodOptions { steps: Some(2), ..all() });
    }
}
