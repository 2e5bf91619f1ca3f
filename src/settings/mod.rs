//! Every number of the method, resolved and checked once.
//!
//! [`Choices`] is what somebody asked for; [`Settings`] is what is meant. A sequence has one
//! `Settings` for all its frames: an estimate for each frame would flicker.

mod choices;
mod pairs;
mod presets;

use std::fmt;

pub use crate::contour::Contouring;
use crate::smooth::EIGENVALUE_MAX;
pub use crate::smooth::Integrator;
use crate::words::significant;
pub use choices::{AnisotropyKind, AttributeSelection, Choices, ClipBox, contouring_name, integrator_name};
pub use pairs::Pairs;
pub use presets::Preset;

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
    /// r_max / r_min as it was chosen: their quotient may be another number by a rounding.
    pub radius_ratio: f64,
    /// Where particles have radii of their own: then the three above are those of a particle whose
    /// radius is `radius_min` / `scale`.
    pub own_radii: Option<OwnRadii>,
    /// What stretches particles.
    pub anisotropy: Anisotropy,
    /// Gaps between the surface and obstacles are filled where they are narrower, in units of h.
    pub void_threshold: f64,
    /// Attributes of the particles that the surface gets.
    pub attributes: Option<AttributeSelection>,
    /// Pieces of surface with fewer particles are dropped.
    pub drop_islands: u32,
    /// Cavities of a smaller volume are filled, in units of h³.
    pub fill_cavities: f64,
    /// What is outside this box is cut off.
    pub clip: Option<ClipBox>,
    /// By how much the mesh may move so that triangles are saved, in units of h; 0 for not at all.
    pub decimate: f64,
    /// Rounds in which normals are averaged with their neighbours.
    pub smooth_normals: u32,
    /// Whether .obj, .vtp and .usda have quads.
    pub quads: bool,
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

/// Where particles have radii of their own.
#[derive(Clone, Debug, PartialEq)]
pub struct OwnRadii {
    /// The attribute that tells them, world units.
    pub attribute: String,
    /// A particle's r_min in units of its own radius.
    pub scale: f64,
}

/// What stretches particles (paper, Eq. 1 and 16, Fig. 11).
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Anisotropy {
    /// Nothing: balls.
    None,
    /// Where the neighbours are.
    Neighbors {
        /// How far neighbours count, world units.
        radius: f64,
        /// The longest half axis in units of the shortest, at most.
        max_stretch: f64,
        /// How far particles are moved to the mean of their neighbours, 0 to 1.
        position_smoothing: f64,
    },
    /// The velocity.
    Velocity {
        /// Seconds of movement by which it stretches.
        gain: f64,
        /// The longest half axis in units of the shortest, at most.
        max_stretch: f64,
    },
}

/// Explicit steps of this much and more, in units of h⁴, are unstable.
pub const EXPLICIT_STEP_MAX: f64 = 2.0 / EIGENVALUE_MAX as f64;

/// The largest radius in voxels: beyond it the bins around a particle would be most of the frame.
pub const RADIUS_MAX_VOXELS: f64 = 64.0;

/// r_max / r_min, as the paper has it.
const RADIUS_RATIO: f64 = 2.0;

/// Narrower gaps between the surface and obstacles are filled, in units of h.
const VOID_THRESHOLD: f64 = 1.0;

/// Distances to obstacles are known no farther, in units of h.
const VOID_THRESHOLD_MAX: f64 = 4.0;

/// As Yu and Turk limit it.
const MAX_STRETCH: f64 = 4.0;

/// Beyond it a particle would reach over several leaves.
const MAX_STRETCH_MAX: f64 = 8.0;

/// How far neighbours count, in units of r_min.
const NEIGHBOR_RADIUS: f64 = 3.0;

/// Seconds of movement by which velocities stretch: a quarter of a frame of film.
const VELOCITY_GAIN: f64 = 0.01;

/// Neighbours within more voxels are a good part of a frame.
const NEIGHBOR_RADIUS_MAX_VOXELS: f64 = 200.0;

/// A piece of more particles may be so thick that its inside is not stored, and is none to be dropped.
pub const ISLAND_MAX: u32 = 1000;

/// Cavities of this many voxels are rooms.
const CAVITY_VOXELS_MAX: f64 = 1e6;

/// A mesh that moves by more than this, in units of h, is another one.
const DECIMATE_MAX: f64 = 1.0;

/// Rounds after which normals tell nothing of the surface.
pub const ROUNDS_MAX: u32 = 1000;

/// Steps of either kind: a hundred times what the paper takes.
pub const STEPS_MAX: u32 = 1_000_000;

/// More steps than this take so long that somebody should know before.
const STEPS_TOLD: f64 = 2000.0;

/// The time that adaptive steps may add up to, in units of h⁴: some so many steps as well.
const ADAPTIVE_TIME_MAX: f64 = 1e4;

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
        let choices = choices.with_preset();
        let h = positive("voxel size", voxel_size)?;
        let radius_ratio = choices.radius_ratio.unwrap_or(RADIUS_RATIO);
        let [radius_min, radius_init, radius_max] = radii(h, radius_ratio, &choices)?;
        let integrator = choices.integrator.unwrap_or(Integrator::Fast);
        let explicit = is_explicit(integrator);
        let settings = Settings {
            voxel_size: h,
            radius_min,
            radius_init,
            radius_max,
            radius_ratio,
            own_radii: choices.own_radii()?,
            anisotropy: anisotropy(&choices, radius_min, h)?,
            void_threshold: choices.void_threshold.unwrap_or(VOID_THRESHOLD),
            drop_islands: choices.drop_islands.unwrap_or(0),
            fill_cavities: choices.fill_cavities.unwrap_or(0.0),
            clip: choices.clip.map(checked_box).transpose()?,
            decimate: choices.decimate.unwrap_or(0.0),
            smooth_normals: choices.smooth_normals.unwrap_or(0),
            quads: choices.quads.unwrap_or(false),
            attributes: choices.attributes,
            integrator,
            laplacian_steps: choices.laplacian_steps.unwrap_or(15),
            steps: choices.steps.unwrap_or_else(|| default_steps(integrator)),
            step_size: positive(
                "step size",
                choices.step_size.unwrap_or(if explicit { 0.01 } else { 20.0 }),
            )?,
            redistance_every: choices.redistance_every.unwrap_or(if explicit { 50 } else { 1 }),
            cg_tolerance: positive("conjugate gradient tolerance", choices.cg_tolerance.unwrap_or(1e-4))?,
            contouring: choices.contouring.unwrap_or(Contouring::Dual),
        };
        settings.check_solver()?;
        settings.check_edits()?;
        Ok(settings)
    }

    fn check_solver(&self) -> Result<(), SettingsError> {
        let steps_max = f64::from(STEPS_MAX);
        let every = f64::from(self.redistance_every);
        within("number of steps after which distances are restored", every, 1.0, steps_max)?;
        within("number of steps", f64::from(self.steps), 0.0, steps_max)?;
        within("number of Laplacian steps", f64::from(self.laplacian_steps), 0.0, steps_max)?;
        within("step size in h⁴", self.step_size, 1e-6, 1e4)?;
        if self.integrator == Integrator::Adaptive {
            let time = f64::from(self.steps) * self.step_size;
            let what = "time of adaptive steps (their number times their size) in h⁴";
            within(what, time, 0.0, ADAPTIVE_TIME_MAX)?;
        }
        within("conjugate gradient tolerance", self.cg_tolerance, 1e-12, 0.5)
    }

    fn check_edits(&self) -> Result<(), SettingsError> {
        within("void threshold in h", self.void_threshold, 0.0, VOID_THRESHOLD_MAX)?;
        within(
            "number of particles of pieces to drop",
            f64::from(self.drop_islands),
            0.0,
            f64::from(ISLAND_MAX),
        )?;
        within("volume of cavities to fill in h³", self.fill_cavities, 0.0, CAVITY_VOXELS_MAX)?;
        within("error of decimation in h", self.decimate, 0.0, DECIMATE_MAX)?;
        within(
            "number of rounds of --smooth-normals",
            f64::from(self.smooth_normals),
            0.0,
            f64::from(ROUNDS_MAX),
        )?;
        self.check_quads()
    }

    /// Whether particles have shapes of their own.
    pub fn has_shapes(&self) -> bool {
        self.own_radii.is_some() || self.anisotropy != Anisotropy::None
    }

    /// The choices that make these settings, every one of them, but for the voxel size and what is not used.
    pub fn to_choices(&self) -> Choices {
        let (kind, neighbor_radius, position_smoothing, velocity_gain, max_stretch) = match self.anisotropy {
            Anisotropy::None => (AnisotropyKind::None, None, None, None, None),
            Anisotropy::Neighbors { radius, max_stretch, position_smoothing } => {
                (AnisotropyKind::Neighbors, Some(radius), Some(position_smoothing), None, Some(max_stretch))
            }
            Anisotropy::Velocity { gain, max_stretch } => {
                (AnisotropyKind::Velocity, None, None, Some(gain), Some(max_stretch))
            }
        };
        let is_implicit = self.integrator == Integrator::Implicit;
        Choices {
            preset: None,
            radius_min: Some(self.radius_min),
            radius_ratio: Some(self.radius_ratio),
            radius_init: Some(self.radius_init),
            radius_attribute: self.own_radii.as_ref().map(|own| own.attribute.clone()),
            radius_scale: self.own_radii.as_ref().map(|own| own.scale),
            anisotropy: Some(kind),
            max_stretch,
            neighbor_radius,
            position_smoothing,
            velocity_gain,
            void_threshold: Some(self.void_threshold),
            attributes: self.attributes.clone(),
            drop_islands: Some(self.drop_islands),
            fill_cavities: Some(self.fill_cavities),
            clip: self.clip,
            contouring: Some(self.contouring),
            decimate: Some(self.decimate),
            smooth_normals: Some(self.smooth_normals),
            quads: Some(self.quads),
            integrator: Some(self.integrator),
            laplacian_steps: Some(self.laplacian_steps),
            steps: Some(self.steps),
            step_size: Some(self.step_size),
            redistance_every: Some(self.redistance_every),
            cg_tolerance: is_implicit.then_some(self.cg_tolerance),
        }
    }

    /// Quads are what dual contouring makes, until somebody changes them.
    fn check_quads(&self) -> Result<(), SettingsError> {
        require(!self.quads || self.contouring == Contouring::Dual, || {
            "quads come of dual contouring only: leave out --contour tetrahedra".into()
        })?;
        require(!self.quads || self.decimate == 0.0, || {
            "decimation leaves no quads: choose one of --quads and --decimate".into()
        })
    }

    /// Whether there is a voxel size with which these choices make sense: for a voxel size that is
    /// not yet known.
    ///
    /// # Errors
    /// When there is none.
    pub fn check(choices: &Choices) -> Result<(), SettingsError> {
        let sound = |radius: &f64| radius.is_finite() && *radius > 0.0;
        let ratio = choices.radius_ratio.unwrap_or(RADIUS_RATIO);
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
        if self.integrator == Integrator::Adaptive {
            warnings.push(
                "adaptive steps are for stills: their sizes depend on the frame, and a sequence flickers"
                    .into(),
            );
        }
        let (least, steps) = self.step_count();
        if steps > STEPS_TOLD {
            let at_least = if least { "at least " } else { "" };
            warnings.push(format!(
                "{at_least}{steps:.0} steps for each frame will take long; {} are the default",
                default_steps(self.integrator)
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

impl Settings {
    /// How many biharmonic steps there will be, and whether that is the least: adaptive ones are as large as is stable
    /// at most.
    fn step_count(&self) -> (bool, f64) {
        let steps = f64::from(self.steps);
        match self.integrator {
            Integrator::Adaptive => (true, steps * (self.step_size / EXPLICIT_STEP_MAX)),
            Integrator::Fast | Integrator::Implicit | Integrator::Explicit => (false, steps),
        }
    }
}

/// Whether an integrator takes many small steps, and not a few large ones.
fn is_explicit(integrator: Integrator) -> bool {
    matches!(integrator, Integrator::Explicit | Integrator::Adaptive)
}

/// The biharmonic steps of an integrator, unless others are asked for.
fn default_steps(integrator: Integrator) -> u32 {
    if is_explicit(integrator) { 500 } else { 5 }
}

/// r_min, r_init and r_max.
fn radii(h: f64, ratio: f64, choices: &Choices) -> Result<[f64; 3], SettingsError> {
    let radius_min = positive("radius r_min", choices.radius_min.unwrap_or(3f64.sqrt() * h))?;
    require(ratio.is_finite() && ratio >= 1.0, || {
        format!("the radius ratio is {ratio}; r_max may not be below r_min: at least 1")
    })?;
    let radius_max = ratio * radius_min;
    let radius_init = choices.radius_init.unwrap_or(0.5 * (radius_min + radius_max));
    let radius_init = positive("radius r_init", radius_init)?;
    // A product of two numbers as typed may miss a third as typed by a rounding.
    let slack = 1e-9 * radius_max;
    require((radius_min - slack..=radius_max + slack).contains(&radius_init), || {
        format!("r_init is {radius_init}; it must lie between r_min = {radius_min} and r_max = {radius_max}")
    })?;
    require(radius_max <= RADIUS_MAX_VOXELS * h, || {
        format!(
            "r_max is {} voxels, and {RADIUS_MAX_VOXELS} are the most: choose a smaller {}, or a larger voxel size with r_min in \
             world units",
            significant(radius_max / h),
            if choices.radius_min.is_some() { "r_min or ratio" } else { "ratio" }
        )
    })?;
    Ok([radius_min, radius_init.clamp(radius_min, radius_max), radius_max])
}

impl Choices {
    /// Where particles have radii of their own, if they have.
    ///
    /// # Errors
    /// When their scale is no positive number.
    pub fn own_radii(&self) -> Result<Option<OwnRadii>, SettingsError> {
        let Some(attribute) = &self.radius_attribute else { return Ok(None) };
        let scale = positive("radius scale", self.radius_scale.unwrap_or(1.0))?;
        Ok(Some(OwnRadii { attribute: attribute.clone(), scale }))
    }
}

fn anisotropy(choices: &Choices, radius_min: f64, h: f64) -> Result<Anisotropy, SettingsError> {
    let max_stretch = choices.max_stretch.unwrap_or(MAX_STRETCH);
    within("greatest stretch", max_stretch, 1.0, MAX_STRETCH_MAX)?;
    match choices.anisotropy {
        None | Some(AnisotropyKind::None) => Ok(Anisotropy::None),
        Some(AnisotropyKind::Neighbors) => {
            let radius = choices.neighbor_radius.unwrap_or(NEIGHBOR_RADIUS * radius_min);
            let radius = positive("radius within which neighbours count", radius)?;
            require(radius <= NEIGHBOR_RADIUS_MAX_VOXELS * h, || {
                format!(
                    "the radius within which neighbours count is {} h; it must be at most {NEIGHBOR_RADIUS_MAX_VOXELS} h",
                    radius / h
                )
            })?;
            let position_smoothing = choices.position_smoothing.unwrap_or(0.0);
            within("smoothing of positions", position_smoothing, 0.0, 1.0)?;
            Ok(Anisotropy::Neighbors { radius, max_stretch, position_smoothing })
        }
        Some(AnisotropyKind::Velocity) => {
            let gain = positive("velocity gain", choices.velocity_gain.unwrap_or(VELOCITY_GAIN))?;
            Ok(Anisotropy::Velocity { gain, max_stretch })
        }
    }
}

fn checked_box(clip: ClipBox) -> Result<ClipBox, SettingsError> {
    require(clip.min.iter().chain(&clip.max).all(|number| number.is_finite()), || {
        format!(
            "the box {clip} has a number that is not finite: x0,y0,z0,x1,y1,z1 must be six finite numbers"
        )
    })?;
    for (axis, name) in ["x", "y", "z"].into_iter().enumerate() {
        let (min, max) = (clip.min[axis], clip.max[axis]);
        require(min < max, || {
            format!(
                "the box {clip} is empty: its {name}0 is {min} and must be below its {name}1, which is {max}: \
                 x0,y0,z0 is the least corner, x1,y1,z1 the greatest"
            )
        })?;
    }
    Ok(clip)
}

fn within(name: &str, value: f64, least: f64, most: f64) -> Result<(), SettingsError> {
    require((least..=most).contains(&value), || {
        let [least, most] = [least, most].map(in_short);
        format!("the {name} is {value}; it must be from {least} to {most}")
    })
}

/// A bound without a row of zeros.
fn in_short(bound: f64) -> String {
    if bound != 0.0 && bound < 1e-3 { format!("{bound:e}") } else { bound.to_string() }
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
    fn settings_are_made_again_of_their_choices() {
        let presets = Preset::ALL.map(|preset| Choices { preset: Some(preset), ..Choices::default() });
        let others = [
            Choices {
                anisotropy: Some(AnisotropyKind::Velocity),
                max_stretch: Some(2.0),
                ..Choices::default()
            },
            Choices { radius_attribute: Some("pscale".into()), quads: Some(true), ..Choices::default() },
            Choices { integrator: Some(Integrator::Implicit), decimate: Some(0.1), ..Choices::default() },
        ];
        let all: Vec<Settings> = presets
            .iter()
            .chain(&others)
            .map(|choices| Settings::resolve(0.5, choices).expect("sound"))
            .collect();
        for (index, settings) in all.iter().enumerate() {
            assert_eq!(Settings::resolve(0.5, &settings.to_choices()).as_ref(), Ok(settings));
            assert!(!all[..index].contains(settings), "{settings:?} twice");
        }
    }

    #[test]
    fn ratios_are_printed_as_they_were_chosen() {
        // 3 r_min / r_min is not 3 for all of these.
        for voxel_size in [0.1, 0.03, 0.022_176_949_191_354_715, 1.0 / 3.0] {
            let choices = Choices { preset: Some(Preset::Smooth), ..Choices::default() };
            let settings = Settings::resolve(voxel_size, &choices).expect("sound");
            assert_eq!(settings.to_choices().radius_ratio, Some(3.0));
            assert_eq!(Settings::resolve(voxel_size, &settings.to_choices()), Ok(settings));
        }
    }

    #[test]
    fn presets_take_as_much_more_or_less_with_any_integrator() {
        for integrator in [Integrator::Fast, Integrator::Implicit, Integrator::Explicit, Integrator::Adaptive]
        {
            let resolved = |preset, steps| {
                let choices = Choices { preset, steps, integrator: Some(integrator), ..Choices::default() };
                Settings::resolve(1.0, &choices).expect("sound")
            };
            let own = resolved(None, None);
            for (preset, fifths) in [(Preset::Smooth, 10), (Preset::Preview, 1), (Preset::Water, 5)] {
                let settings = resolved(Some(preset), None);
                assert_eq!((5 * settings.steps, settings.step_size), (fifths * own.steps, own.step_size));
                assert_eq!(resolved(Some(preset), Some(7)).steps, 7);
            }
        }
    }

    #[test]
    fn many_steps_are_told_before_they_are_taken() {
        let told = |integrator, steps, step_size| {
            let choices = Choices { integrator: Some(integrator), steps, step_size, ..Choices::default() };
            Settings::resolve(1.0, &choices)
                .expect("sound")
                .warnings()
                .into_iter()
                .find(|warning| warning.contains(" steps for each"))
        };
        let adaptive = told(Integrator::Adaptive, None, Some(20.0)).expect("so many");
        assert!(adaptive.starts_with("at least 720000 steps"), "{adaptive}");
        let explicit = told(Integrator::Explicit, Some(5000), None).expect("so many");
        assert!(explicit.starts_with("5000 steps") && explicit.contains("500 are the default"), "{explicit}");
        for integrator in [Integrator::Fast, Integrator::Explicit, Integrator::Adaptive] {
            assert_eq!(told(integrator, None, None), None);
            assert_eq!(told(integrator, Some(2000), None), None);
        }
    }

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
            (Choices { max_stretch: Some(0.5), ..Choices::default() }, "stretch"),
            (Choices { void_threshold: Some(-1.0), ..Choices::default() }, "void"),
            (Choices { quads: Some(true), decimate: Some(0.1), ..Choices::default() }, "quads"),
            (
                Choices { clip: Some(ClipBox { min: [0.0; 3], max: [1.0, 0.0, 1.0] }), ..Choices::default() },
                "box",
            ),
        ] {
            let error = Settings::check(&senseless).expect_err("senseless");
            assert!(error.what.contains(word), "{senseless:?}: {error}");
        }
    }
}
