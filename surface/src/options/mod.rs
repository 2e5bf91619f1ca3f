//! The settings of the method, resolved and checked once.
//!
//! [`MethodOptions`] holds what the user set; [`Settings`] holds every value. A sequence has one `Settings`
//! for all its frames: an estimate per frame would make it flicker.

mod definition;
mod fields;
mod presets;
mod reach;
mod resolution;
mod values;

use std::fmt;

pub use crate::contour::Contouring;
pub use crate::rasterize::Start;
pub use crate::smooth::Integrator;
pub use definition::MethodOptions;
pub use fields::{
    OptionGroup, OptionInfo, OptionName, OptionValue, ValueKind, ValueSyntax, expected, ranged,
};
pub use presets::{Preset, SequenceSpacing};
pub use reach::{FrameReach, RestAt, RestFrames};
pub use resolution::Pairs;
pub use values::{AnisotropyKind, AttributeSelection, ClipBox, ColumnNames, Length, LengthUnit};

use crate::attributes::names_velocity;
use crate::particles::{Attribute, LONE_RADIUS, ParticleFilter, find_attribute};
use crate::smooth::{EIGENVALUE_MAX, SmoothSteps};
use crate::spacing::median;
use crate::spray::frames_needed;
use crate::words::significant;
use presets::Scale;
use resolution::{
    LEAST_REACH_VOXELS, RADIUS_RATIO, anisotropy, cavities, check_offset, checked_box, default_step_size,
    default_steps, is_explicit, kernel_radii, laplacian_steps, neighbor_radius, offset, radii, unit_radius,
    usual_reach,
};

/// All settings of a sequence, checked.
#[derive(Clone, Debug, PartialEq)]
#[non_exhaustive]
pub struct Settings {
    /// The preset whose values the other settings have where no option was given. It is never
    /// [`Preset::Auto`], but the preset that this chose.
    pub preset: Preset,
    /// Distance d between neighbouring particles, world units.
    pub spacing: f64,
    /// Edge length h of a voxel, world units.
    pub voxel_size: f64,
    /// What smoothing starts from: spheres with the preset `paper`, kernels with all others.
    pub start: Start,
    /// r_min, world units: of kernels, that of the ball around each particle that stays inside.
    pub radius_min: f64,
    /// r_init, world units: closer than twice this distance, particles are one piece of fluid.
    pub radius_init: f64,
    /// r_max, world units: of kernels, the reach of one in a sheet.
    pub radius_max: f64,
    /// How far the finished surface is moved outward, world units; negative values move it inward.
    pub offset: f64,
    /// The chosen r_max / r_min. The quotient of the two fields may differ by a rounding error.
    pub radius_ratio: f64,
    /// What is read of each file.
    pub reading: ReadOptions,
    /// Per-particle radii. If set, the three radii above belong to a particle whose own radius is that of a
    /// particle of scale 1, divided by `scale`.
    pub per_particle_radius: Option<PerParticleRadius>,
    /// How particles are stretched.
    pub anisotropy: Anisotropy,
    /// How far particles are moved toward the mean of their neighbours: 0 (not at all) to 1.
    pub position_smoothing: f64,
    /// Neighbour radius R, world units: particles farther apart are not neighbours. 0 if neighbours are not
    /// [used](Settings::uses_neighbors).
    pub neighbor_radius: f64,
    /// Gaps between the surface and obstacles narrower than this are filled, in units of h.
    pub void_threshold: f64,
    /// Which attributes of the particles are interpolated to the surface.
    pub attributes: Option<AttributeSelection>,
    /// Factor from the particles' velocities to world units per second. Its square is that of accelerations.
    pub velocity_scale: f64,
    /// Which positions in other frames are transferred to the surface.
    pub rest: Option<RestFrames>,
    /// Pieces of surface with fewer particles than this are dropped.
    pub drop_islands: u32,
    /// Pieces of fluid with fewer particles than this are spray.
    pub spray: u32,
    /// The number of frames that a particle stays in the surface or in the spray.
    pub spray_keep: u32,
    /// Cavities with a smaller volume than this are filled, in units of h³.
    pub fill_cavities: f64,
    /// The surface outside this box is cut off.
    pub clip: Option<ClipBox>,
    /// How far decimation may move the mesh, in units of h; 0 for no decimation.
    pub decimate: f64,
    /// How many times normals are averaged with their neighbours.
    pub smooth_normals: u32,
    /// Whether files of formats with polygons have quads.
    pub quads: bool,
    /// The steps of the smoothing.
    pub smoothing: SmoothSteps,
    /// Number of frames before and after each frame with which its surface is averaged.
    pub temporal: u32,
    /// Seconds between two frames, for particles without ids or without velocities.
    pub time_step: Option<f64>,
    /// The contouring method.
    pub contouring: Contouring,
    /// Whether the mesh is refined where the surface is strongly curved.
    pub refine: bool,
}

/// Per-particle radii.
#[derive(Clone, Debug, PartialEq)]
pub struct PerParticleRadius {
    /// The attribute that holds the radii, world units.
    pub attribute: String,
    /// The radius of a particle's surface when it is alone, divided by its own radius.
    pub scale: f64,
}

impl PerParticleRadius {
    /// The particle spacing, world units: twice the median of the own radii that are positive and finite.
    pub fn spacing(&self, attributes: &[Attribute]) -> Option<f64> {
        median(self.radii_min(attributes)).map(|radius| 2.0 * radius / self.scale)
    }

    /// The radius of the surface of each particle whose own radius is positive and finite, world units.
    pub fn radii_min(&self, attributes: &[Attribute]) -> Vec<f64> {
        let attribute = find_attribute(attributes, &self.attribute, 1);
        let radii = attribute.and_then(|attribute| attribute.values.numbers()).unwrap_or_default();
        let radii = radii.iter().map(|&radius| self.scale * f64::from(radius));
        radii.filter(|radius| radius.is_finite() && *radius > 0.0).collect()
    }
}

/// The options that affect how the particle spacing is measured.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SpacingOptions {
    /// What is read of each file.
    pub reading: ReadOptions,
    /// Per-particle radii.
    pub per_particle_radius: Option<PerParticleRadius>,
}

/// What is read from a file of particles.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ReadOptions {
    /// New names for columns of tables.
    pub columns: Option<ColumnNames>,
    /// The condition that particles must meet; `None` for all particles.
    pub filter: Option<ParticleFilter>,
}

/// How particles are stretched (paper, Eq. 1 and 16, Fig. 11).
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Anisotropy {
    /// Not at all: all particles are balls.
    None,
    /// By the positions of the neighbours.
    Neighbors {
        /// Upper limit of the longest semi-axis, in units of the shortest.
        max_stretch: f64,
    },
    /// By the velocity.
    Velocity {
        /// Time in seconds. The distance that a particle moves in this time determines its stretch.
        gain: f64,
        /// Upper limit of the longest semi-axis, in units of the shortest.
        max_stretch: f64,
    },
}

/// Explicit steps of this size or more, in units of h⁴, are unstable.
pub const EXPLICIT_STEP_MAX: f64 = 2.0 / EIGENVALUE_MAX as f64;

/// The smallest voxel size, world units. Below it, and above [`VOXEL_SIZE_MAX`], vertices do not fit into
/// 32-bit numbers.
const VOXEL_SIZE_MIN: f64 = 1e-36;

/// The largest voxel size, world units.
const VOXEL_SIZE_MAX: f64 = 1e30;

/// The largest radius in voxels. Beyond it, the bins within reach of a particle would cover most of the
/// frame.
pub const RADIUS_MAX_VOXELS: f64 = 64.0;

/// How far the surface of a body may move from a start of kernels, in spacings.
const ROOM: f64 = 0.45;

/// Default of the width below which gaps between the surface and obstacles are filled, in units of h.
const VOID_THRESHOLD: f64 = 1.0;

/// More steps per frame than this cause a warning, because they take long.
const STEPS_WARN: f64 = 2000.0;

/// Upper limit of the total time of adaptive steps, in units of h⁴. It also limits their number.
const ADAPTIVE_TIME_MAX: f64 = 1e4;

/// Why options cannot be resolved to settings. Its `Display` form names options as the command line does.
#[derive(Clone, Debug, PartialEq)]
pub struct SettingsError(SettingsFault);

#[derive(Clone, Debug, PartialEq)]
enum SettingsFault {
    /// A message without names of options: the invalid value, and the allowed range.
    Value(String),
    UnknownSpacing,
    QuadsOfTetrahedra,
    QuadsDecimated,
    SingleFrame,
    EarlierFrames,
}

impl SettingsError {
    pub(crate) fn of_value(what: String) -> SettingsError {
        SettingsFault::Value(what).into()
    }

    /// The message with the names of options in this spelling.
    #[doc(hidden)]
    pub fn message(&self, spelled: impl Fn(OptionName) -> String) -> String {
        let quads = OptionName::new("quads");
        match &self.0 {
            SettingsFault::SingleFrame => format!(
                "{} averages the frames of a sequence, and this is a single frame: leave it out",
                spelled(OptionName::new("temporal"))
            ),
            SettingsFault::EarlierFrames => format!(
                "{} needs the frames before a frame, which are not known here: leave it out, or convert a sequence of files",
                spelled(OptionName::new("rest"))
            ),
            SettingsFault::Value(what) => what.clone(),
            SettingsFault::UnknownSpacing => {
                format!("the particle spacing is unknown: give {}", spelled(OptionName::new("spacing")))
            }
            SettingsFault::QuadsOfTetrahedra => format!(
                "{} requires dual contouring: remove {}",
                spelled(quads),
                spelled(OptionName::with_value("contour", "tetrahedra"))
            ),
            SettingsFault::QuadsDecimated => format!(
                "{} cannot be combined with {}, which produces triangles: remove one of them",
                spelled(quads),
                spelled(OptionName::new("decimate"))
            ),
        }
    }
}

impl From<SettingsFault> for SettingsError {
    fn from(fault: SettingsFault) -> SettingsError {
        SettingsError(fault)
    }
}

impl fmt::Display for SettingsError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.message(OptionName::flag))
    }
}

impl std::error::Error for SettingsError {}

/// Default of the number of frames that a particle stays in the surface or in the spray.
const SPRAY_KEEP: u32 = 3;

/// The names of the two sets of rest coordinates, and of the weight of the second one.
pub const REST_NAMES: [&str; 3] = ["rest", "rest2", "rest_ratio"];

impl Settings {
    /// The number of frames before and after a frame on which its spray depends.
    #[doc(hidden)]
    pub fn spray_reach(&self) -> u32 {
        if self.spray > 0 { frames_needed(self.spray_keep) } else { 0 }
    }

    /// Whether velocities are computed for particles without them, from the frames before and after.
    pub fn computes_velocities(&self) -> bool {
        self.time_step.is_some() && names_velocity(self.attributes.as_ref())
    }

    /// The time between two frames, in the unit of time of the velocities.
    pub fn frame_time(&self) -> Option<f64> {
        Some(self.time_step? * self.velocity_scale)
    }

    /// Whether the surface gets attributes of the particles.
    pub fn has_attributes(&self) -> bool {
        self.attributes.is_some() || self.rest.is_some()
    }

    /// Whether the surface gets this attribute.
    pub fn selects(&self, attribute: &Attribute) -> bool {
        let rest = self
            .rest
            .map_or(&[][..], |rest| if rest.period.is_some() { &REST_NAMES } else { &REST_NAMES[..1] });
        rest.contains(&&*attribute.name)
            || self.attributes.as_ref().is_some_and(|selection| selection.selects(attribute))
    }

    /// How many frames are in memory at most while one of them is averaged: those that it is averaged with, itself,
    /// and a second copy of one that is computed meanwhile.
    #[doc(hidden)]
    pub fn held_frame_count(&self) -> u64 {
        match self.temporal {
            0 => 1,
            reach => 2 * u64::from(reach) + 2,
        }
    }

    /// Fills in the defaults of the preset and checks every number.
    ///
    /// Lengths that are not set follow the particle spacing: that of `options`, else the `measured` one, else
    /// the spacing whose default voxel size equals the given voxel size. With [`Preset::Paper`], these
    /// lengths follow the voxel size. [`Preset::Auto`] becomes the preset that suits the `measured` particles,
    /// or `fluid` if their irregularity is unknown.
    ///
    /// # Errors
    /// If a number is not finite or out of its range, if the radii are out of order, or if neither spacing
    /// nor voxel size is known.
    pub fn resolve(
        options: &MethodOptions,
        measured: Option<SequenceSpacing>,
    ) -> Result<Settings, SettingsError> {
        let options = &options.with_preset_for(measured.and_then(|measured| measured.irregularity));
        options.check_ranges()?;
        let recipe = options.recipe();
        let scale = Scale::new(options, measured)?;
        let Scale { spacing, voxel_size: h } = scale;
        require((VOXEL_SIZE_MIN..=VOXEL_SIZE_MAX).contains(&h), || {
            let voxel_size = named("voxel size", options.voxel_size);
            format!("the {voxel_size} is {h:e}; it must be from {VOXEL_SIZE_MIN:e} to {VOXEL_SIZE_MAX:e}")
        })?;
        let radius_ratio = options.radius_ratio.unwrap_or(RADIUS_RATIO);
        let start = options.start();
        let [radius_min, radius_init, radius_max] = match start {
            Start::Spheres => radii(&scale, radius_ratio, options)?,
            Start::Kernels => kernel_radii(&scale, options)?,
        };
        let integrator = options.integrator.unwrap_or_default();
        let voxels = scale.voxels(recipe.unit);
        let explicit = is_explicit(integrator);
        let neighbor_radius =
            if options.uses_neighbors() { neighbor_radius(options, radius_min, &scale)? } else { 0.0 };
        let settings = Settings {
            preset: options.preset.unwrap_or_default(),
            spacing,
            voxel_size: h,
            start,
            radius_min,
            radius_init,
            radius_max,
            offset: offset(options, unit_radius([radius_min, radius_max], start), &scale)?,
            radius_ratio,
            reading: options.read_options(),
            per_particle_radius: options.per_particle_radius()?,
            anisotropy: anisotropy(options)?,
            position_smoothing: options.position_smoothing(),
            neighbor_radius,
            void_threshold: options.void_threshold.unwrap_or(VOID_THRESHOLD),
            rest: options.rest_frames(),
            drop_islands: options.drop_islands.unwrap_or(0),
            spray: options.spray.unwrap_or(0),
            spray_keep: options.spray_keep.unwrap_or(SPRAY_KEEP),
            fill_cavities: options.fill_cavities.unwrap_or_else(|| cavities(&recipe, voxels)),
            clip: options.clip.map(checked_box).transpose()?,
            decimate: options.decimate.unwrap_or(0.0),
            smooth_normals: options.smooth_normals.unwrap_or(0),
            quads: options.quads.unwrap_or(false),
            attributes: options.attributes.clone(),
            velocity_scale: options.velocity_scale.unwrap_or(1.0),
            smoothing: SmoothSteps {
                integrator,
                laplacian_steps: options.laplacian_steps.unwrap_or_else(|| laplacian_steps(&recipe, voxels)),
                steps: options.steps.unwrap_or_else(|| default_steps(&recipe, integrator, voxels)),
                step_size: options
                    .step_size
                    .unwrap_or_else(|| default_step_size(&recipe, integrator, voxels)),
                redistance_every: options.redistance_every.unwrap_or(if explicit { 50 } else { 1 }),
            },
            temporal: options.temporal.unwrap_or(0),
            time_step: options.time_step,
            contouring: options.contour.unwrap_or_default(),
            refine: start == Start::Kernels,
        };
        settings.check_together()?;
        Ok(settings)
    }

    /// The paper's settings for a voxel size, overridden by these options: for tests and the paper's
    /// experiments. If the options choose a preset whose lengths follow the particle spacing, this spacing is
    /// two voxels.
    ///
    /// # Errors
    /// As [`Settings::resolve`].
    pub fn paper(voxel_size: f64, options: &MethodOptions) -> Result<Settings, SettingsError> {
        let paper = MethodOptions {
            preset: Some(Preset::Paper),
            voxel_size: Some(voxel_size.into()),
            spacing: Some(2.0 * voxel_size),
            ..MethodOptions::default()
        };
        Settings::resolve(&options.clone().over(paper), None)
    }

    /// The settings for level sets. Their voxel size is in their files, so these settings have a placeholder
    /// that suits the offset until [`with_voxel_size`](Settings::with_voxel_size) replaces it.
    ///
    /// # Errors
    /// If these options are invalid for every voxel size.
    pub fn for_level_sets(options: &MethodOptions) -> Result<Settings, SettingsError> {
        let offset =
            options.offset.and_then(Length::world).filter(|offset| offset.is_finite()).unwrap_or(0.0);
        let settings = Settings::paper(if offset == 0.0 { 1.0 } else { offset.abs() }, options)?;
        // There are no particles to follow. The paper's mesh is not refined.
        Ok(Settings { temporal: 0, spray: 0, rest: None, refine: true, ..settings })
    }

    /// The same settings for another voxel size: the lengths that depend on the voxel size become those of
    /// [`Settings::paper`].
    ///
    /// # Errors
    /// If the voxel size is invalid, or too small or too large for the offset.
    pub fn with_voxel_size(&self, voxel_size: f64) -> Result<Settings, SettingsError> {
        let lengths = Settings::paper(voxel_size, &MethodOptions::default())?;
        check_offset((Some(self.offset.into()), self.offset), (lengths.radius_min, "√3 h"), voxel_size)?;
        Ok(Settings {
            spacing: lengths.spacing,
            voxel_size: lengths.voxel_size,
            radius_min: lengths.radius_min,
            radius_init: lengths.radius_init,
            radius_max: lengths.radius_max,
            ..self.clone()
        })
    }

    /// Refuses settings that need other frames, for a frame that is reconstructed alone.
    ///
    /// # Errors
    /// If the surface is to be averaged over time, or particles are to be followed back.
    pub fn require_single_frame(&self) -> Result<(), SettingsError> {
        self.require_no_history()?;
        if self.temporal > 0 { Err(SettingsFault::SingleFrame.into()) } else { Ok(()) }
    }

    /// Refuses settings that need the frames before a frame, where those frames are not known.
    ///
    /// # Errors
    /// If particles are to be followed back.
    pub fn require_no_history(&self) -> Result<(), SettingsError> {
        if self.rest.is_some() { Err(SettingsFault::EarlierFrames.into()) } else { Ok(()) }
    }

    /// Checks what depends on several options.
    fn check_together(&self) -> Result<(), SettingsError> {
        if self.smoothing.integrator == Integrator::Adaptive {
            let time = f64::from(self.smoothing.steps) * self.smoothing.step_size;
            let what = "total time of adaptive steps (steps times step size) in h⁴";
            require((0.0..=ADAPTIVE_TIME_MAX).contains(&time), || {
                format!("the {what} is {time}; it must be from 0 to {ADAPTIVE_TIME_MAX}")
            })?;
        }
        if let Some(RestFrames { period: Some(period), .. }) = self.rest {
            require(period % 2 == 0, || {
                format!(
                    "rest_period is {period}; it must be even, because the second set begins again half a period after the first"
                )
            })?;
        }
        match (self.quads, self.contouring) {
            (true, Contouring::Tetrahedra) => Err(SettingsFault::QuadsOfTetrahedra.into()),
            (true, Contouring::Dual) if self.decimate != 0.0 => Err(SettingsFault::QuadsDecimated.into()),
            _ => Ok(()),
        }
    }

    /// The radius of the surface of a lone particle of scale 1, in world units: r_min with spheres.
    pub fn unit_radius(&self) -> f64 {
        unit_radius([self.radius_min, self.radius_max], self.start)
    }

    /// The own radius of a particle of scale 1, times the radius scale, world units. A longer reach of kernels makes
    /// particles with radii of their own larger, too.
    pub(crate) fn unit_own_radius(&self) -> f64 {
        match self.start {
            Start::Spheres => self.unit_radius(),
            Start::Kernels => {
                let scale = Scale { spacing: self.spacing, voxel_size: self.voxel_size };
                f64::from(LONE_RADIUS) * usual_reach(&self.preset.recipe(), &scale)
            }
        }
    }

    /// How far the surface of a body may move from a start of kernels, world units.
    pub(crate) fn room(&self) -> f64 {
        ROOM * self.spacing
    }

    /// Whether particles differ in size, shape or weight.
    pub fn has_per_particle_shapes(&self) -> bool {
        self.start == Start::Kernels
            || self.per_particle_radius.is_some()
            || self.anisotropy != Anisotropy::None
    }

    /// Approximate distance from the outermost particles of a fluid at rest to its surface, world units: with kernels
    /// the surface lies where the fluid ends, half a spacing away, and with spheres at r_min or beyond. Pictures put the
    /// ground at this height.
    pub fn resting_height(&self) -> f64 {
        match self.start {
            Start::Kernels => 0.5 * self.spacing,
            Start::Spheres => self.radius_min,
        }
    }

    /// Whether a particle's position or shape depends on its neighbours.
    pub fn uses_neighbors(&self) -> bool {
        self.start == Start::Kernels
            || self.position_smoothing > 0.0
            || matches!(self.anisotropy, Anisotropy::Neighbors { .. })
    }

    /// Checks options before the particle spacing is known: whether they are valid for some spacing.
    ///
    /// # Errors
    /// If no spacing makes the options valid.
    pub fn check(options: &MethodOptions) -> Result<(), SettingsError> {
        if options.is_auto() {
            // The options are valid if they are so with one of the presets.
            let checked = Preset::OF_AUTO
                .map(|preset| Settings::check(&MethodOptions { preset: Some(preset), ..options.clone() }));
            let [first, others @ ..] = checked;
            return if others.iter().any(Result::is_ok) { Ok(()) } else { first };
        }
        if !options.needs_measuring() {
            return Settings::resolve(options, None).map(|_| ());
        }
        let sound = |length: &f64| length.is_finite() && *length > 0.0;
        let recipe = options.recipe();
        // Choose a spacing whose default length equals the given length. `resolve` reports invalid lengths.
        let of_start = |start, length: Option<Length>| {
            length.filter(|_| options.start() == start).and_then(Length::world)
        };
        let voxel_size = options.voxel_size.and_then(Length::world);
        let radius_min = of_start(Start::Spheres, options.radius_min);
        let blend = of_start(Start::Kernels, options.blend);
        let per_spacing = |voxels: f64| voxels * recipe.voxel_size;
        let spacing = match (voxel_size, radius_min, blend) {
            (Some(voxel_size), ..) => voxel_size / recipe.voxel_size,
            (None, Some(radius), _) => radius / per_spacing(3f64.sqrt()),
            (None, None, Some(blend)) => {
                blend / recipe.blend.unwrap_or_default().max(per_spacing(LEAST_REACH_VOXELS))
            }
            (None, None, None) => 1.0,
        };
        let spacing = Some(spacing).filter(sound).unwrap_or(1.0);
        // An inward offset can be compared with a given r_min. Any other offset fits some spacing.
        let inward = options.offset.and_then(Length::world).filter(|offset| offset.is_finite());
        if let (Some(radius_min), Some(offset)) = (radius_min.filter(sound), inward) {
            require(-offset <= (1.0 + 1e-9) * radius_min, || {
                format!("the offset is {offset}; it must be at least -r_min = {}", significant(-radius_min))
            })?;
        }
        // Lengths in spacings and in voxels can be compared with each other, but not with lengths in world
        // units.
        let has_world = [voxel_size, radius_min, blend].iter().any(Option::is_some);
        let kept = |given: Option<Length>, is_kept: &dyn Fn(f64) -> bool| {
            given.filter(|length| length.world().map_or(!has_world, is_kept))
        };
        let is_unsound = |radius: f64| !sound(&radius);
        let options = MethodOptions {
            radius_min: kept(options.radius_min, &|_| true),
            blend: kept(options.blend, &|_| true),
            offset: kept(options.offset, &|offset| !offset.is_finite()),
            // A neighbour radius can be compared with a given voxel size; without one, it fits some spacing.
            neighbor_radius: kept(options.neighbor_radius, &|radius| {
                is_unsound(radius) || voxel_size.is_some()
            }),
            ..options.clone()
        };
        Settings::resolve(&options, Some(SequenceSpacing::from(spacing))).map(|_| ())
    }

    /// Warnings to show before work begins, one sentence each.
    pub fn warnings(&self) -> Vec<String> {
        let mut warnings = Vec::new();
        if self.smoothing.integrator == Integrator::Explicit && self.smoothing.step_size >= EXPLICIT_STEP_MAX
        {
            warnings.push(format!(
                "the explicit step size of {} h⁴ is not below the stability limit, 2/144 = {EXPLICIT_STEP_MAX:.5} h⁴: choose a \
                 smaller step size",
                self.smoothing.step_size
            ));
        }
        if self.smoothing.integrator == Integrator::Adaptive {
            warnings.push(
                "adaptive steps are for single frames: their sizes differ per frame, so a sequence flickers"
                    .into(),
            );
        }
        let (least, steps) = self.step_count();
        if steps > STEPS_WARN {
            let at_least = if least { "at least " } else { "" };
            warnings.push(format!("{at_least}{steps:.0} steps for each frame will take long"));
        }
        if self.start == Start::Spheres && self.radius_min < 0.999 * 3f64.sqrt() * self.voxel_size {
            warnings.push(format!(
                "r_min is {:.3} voxels: below √3, particles may fall between voxels and end up outside the surface",
                self.radius_min / self.voxel_size
            ));
        }
        if self.start == Start::Kernels
            && self.per_particle_radius.is_none()
            && self.voxel_size > 1.001 * self.spacing
        {
            let [size, spacing, usual] =
                [self.voxel_size, self.spacing, self.preset.voxel_size(self.spacing)].map(significant);
            warnings.push(format!(
                "the voxel size {size} is larger than the particle spacing {spacing}, so the surface is much too large, as \
                 each particle becomes a ball of at least a voxel: choose at most {spacing}, or {usual}, the default"
            ));
        }
        warnings
    }
}

impl Settings {
    /// The number of biharmonic steps, and whether it is only a lower bound: adaptive steps are at most as
    /// large as is stable.
    fn step_count(&self) -> (bool, f64) {
        let steps = f64::from(self.smoothing.steps);
        match self.smoothing.integrator {
            Integrator::Adaptive => (true, steps * (self.smoothing.step_size / EXPLICIT_STEP_MAX)),
            Integrator::Fast | Integrator::Implicit | Integrator::Explicit => (false, steps),
        }
    }
}

// Checks of numbers and lengths, and how errors name them.

/// The value, if it is positive and finite.
fn positive(name: &str, value: f64) -> Result<f64, SettingsError> {
    require(value.is_finite() && value > 0.0, || {
        format!("the {name} is {value}; it must be a positive number")
    })?;
    Ok(value)
}

/// As [`positive`], for a length that was given as `given`, or has its default value.
fn positive_length(name: &str, given: Option<Length>, value: f64) -> Result<f64, SettingsError> {
    require(value.is_finite() && value > 0.0, || {
        format!("the {}; it must be a positive number", stated(name, given, value))
    })?;
    Ok(value)
}

/// The name of a length and its value in world units, such as `offset 5h is 0.1`.
fn stated(name: &str, given: Option<Length>, value: f64) -> String {
    match given.and_then(Length::world) {
        Some(typed) => format!("{name} is {typed}"),
        None => format!("{} is {}", named(name, given), significant(value)),
    }
}

/// The name of a length, followed by the length as typed if it has a unit.
fn named(name: &str, given: Option<Length>) -> String {
    match given.filter(|length| length.unit != LengthUnit::World) {
        Some(length) => format!("{name} {length}"),
        None => name.to_owned(),
    }
}

/// An error with this message unless the condition holds.
fn require(holds: bool, what: impl FnOnce() -> String) -> Result<(), SettingsError> {
    if holds { Ok(()) } else { Err(SettingsError::of_value(what())) }
}

#[cfg(test)]
mod tests;
