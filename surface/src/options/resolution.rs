//! Defaults and checks of settings that depend on the preset, the voxel size or each other.

use super::definition::{CAVITY_VOXELS_MAX, STEP_SIZE_MAX, STEP_SIZE_MIN, STEPS_MAX};
use super::presets::{InitialRadius, Recipe, Scale, Unit};
use super::{
    Anisotropy, AnisotropyKind, ClipBox, Integrator, Length, MethodOptions, RADIUS_MAX_VOXELS, Settings,
    SettingsError, named, positive, positive_length, require, stated,
};
use crate::words::{rounded_to_digits, significant};

/// The smallest r_min in voxels. Semi-axes are in units of r_min, and the voxel size in this unit must fit
/// into a 32-bit number.
const RADIUS_MIN_VOXELS: f64 = 1e-6;

/// The smallest default of r_init, in units of an r_min that was raised for coarse voxels.
const ROOM_TO_SMOOTH: f64 = 1.1;

/// Upper limit of the offset, in units of h.
const OFFSET_MAX: f64 = 2.0;

/// Default limit of stretching, as in Yu and Turk.
const MAX_STRETCH: f64 = 4.0;

/// The smallest semi-axis of a flattened particle, in units of h. The two sides of a sheet are then 1.8
/// voxels apart.
const THIN_MIN_VOXELS: f64 = 0.9;

/// Particles are flattened by default up to this voxel size, in spacings: on a coarser grid a sheet is as thick
/// as balls.
const FLATTEN_MAX: f64 = 0.66;

/// Default search radius for neighbours, in units of r_min.
const NEIGHBOR_RADIUS: f64 = 3.0;

/// Default of `velocity_gain`, seconds: about a quarter of the time between two frames of a film.
const VELOCITY_GAIN: f64 = 0.01;

/// Upper limit of the neighbour radius in voxels: more would cover a large part of a frame.
const NEIGHBOR_RADIUS_MAX_VOXELS: f64 = 200.0;

/// Whether the integrator takes many small steps instead of a few large ones.
pub(super) fn is_explicit(integrator: Integrator) -> bool {
    matches!(integrator, Integrator::Explicit | Integrator::Adaptive)
}

/// Size of an explicit step, in units of h⁴ (Eq. 14, 15).
const EXPLICIT_STEP_SIZE: f64 = 0.01;

/// Default number of biharmonic steps of an integrator.
pub(super) fn default_steps(recipe: &Recipe, integrator: Integrator, voxels: f64) -> u32 {
    if is_explicit(integrator) {
        let steps = recipe.explicit_time * voxels.powi(4) / EXPLICIT_STEP_SIZE;
        steps.round().clamp(0.0, f64::from(STEPS_MAX)) as u32
    } else {
        recipe.steps
    }
}

/// Default size of a biharmonic step, in units of h⁴.
pub(super) fn default_step_size(recipe: &Recipe, integrator: Integrator, voxels: f64) -> f64 {
    if is_explicit(integrator) {
        EXPLICIT_STEP_SIZE
    } else {
        rounded_to_digits(recipe.step_size * voxels.powi(4)).clamp(STEP_SIZE_MIN, STEP_SIZE_MAX)
    }
}

/// Default number of Laplacian steps: at least one, unless the preset has none.
pub(super) fn laplacian_steps(recipe: &Recipe, voxels: f64) -> u32 {
    let steps = recipe.laplacian_steps * voxels * voxels;
    let least = if recipe.laplacian_steps > 0.0 { 1.0 } else { 0.0 };
    steps.round().clamp(least, f64::from(STEPS_MAX)) as u32
}

/// Default of the volume below which cavities are filled, in units of h³.
pub(super) fn cavities(recipe: &Recipe, voxels: f64) -> f64 {
    rounded_to_digits(recipe.fill_cavities * voxels.powi(3)).min(CAVITY_VOXELS_MAX)
}

/// Default r_init, for r_min and r_max = `ratio` · r_min.
pub(super) fn initial_radius(recipe: &Recipe, radius_min: f64, ratio: f64) -> f64 {
    let radius_max = ratio * radius_min;
    match recipe.radius_init {
        InitialRadius::Middle => 0.5 * (radius_min + radius_max),
        InitialRadius::Times(factor) => rounded_to_digits(factor * radius_min).min(radius_max),
    }
}

/// r_min, r_init and r_max.
pub(super) fn radii(scale: &Scale, ratio: f64, options: &MethodOptions) -> Result<[f64; 3], SettingsError> {
    let (recipe, h) = (options.recipe(), scale.voxel_size);
    // On coarse voxels, raise r_min to the smallest value with which no particle falls between voxels (Eq.
    // 13).
    let usual = scale.units(recipe.unit, recipe.radius_min);
    let given = scale.length(options.radius_min);
    let radius_min = given.unwrap_or(usual.max(3f64.sqrt() * h));
    let radius_min = positive_length("radius r_min", options.radius_min, radius_min)?;
    require(radius_min >= RADIUS_MIN_VOXELS * h, || {
        format!(
            "{} is {} voxels; it must be at least {RADIUS_MIN_VOXELS}: choose a larger r_min or a smaller voxel size",
            named("r_min", options.radius_min),
            significant(radius_min / h)
        )
    })?;
    require(ratio.is_finite() && ratio >= 1.0, || {
        format!("the radius ratio is {ratio}; it must be at least 1")
    })?;
    let radius_max = ratio * radius_min;
    // A raised r_min raises r_init only as far as smoothing needs: the surface stays where it is.
    let is_raised = given.is_none() && radius_min > usual;
    let least = if is_raised { ROOM_TO_SMOOTH * radius_min } else { radius_min };
    let initial = initial_radius(&recipe, given.unwrap_or(usual), ratio).max(least).min(radius_max);
    let radius_init = scale.length(options.radius_init).unwrap_or(initial);
    let radius_init = positive_length("radius r_init", options.radius_init, radius_init)?;
    // r_max is the product of two typed numbers, which may differ from a typed r_init by a rounding error.
    let slack = 1e-9 * radius_max;
    require((radius_min - slack..=radius_max + slack).contains(&radius_init), || {
        format!(
            "{}; it must be between r_min = {} and r_max = {}",
            stated("r_init", options.radius_init, radius_init),
            significant(radius_min),
            significant(radius_max)
        )
    })?;
    require(radius_max <= RADIUS_MAX_VOXELS * h, || {
        let what = format!(
            "r_max is {} voxels; it must be at most {RADIUS_MAX_VOXELS}",
            significant(radius_max / h)
        );
        match (options.radius_min, recipe.unit) {
            (Some(_), _) => format!("{what}: choose a smaller r_min or ratio, or a larger voxel size"),
            (None, Unit::VoxelSize) => {
                format!("{what}: choose a smaller ratio, or a larger voxel size with r_min in world units")
            }
            // Without a given r_min, r_min is at least √3 voxels.
            (None, Unit::Spacing) if ratio * 3f64.sqrt() > RADIUS_MAX_VOXELS => {
                let most = (10.0 * RADIUS_MAX_VOXELS / 3f64.sqrt()).floor() / 10.0;
                format!("{what}: the radius ratio is {ratio}; it must be at most {most}")
            }
            (None, Unit::Spacing) => {
                // Rounded up to two digits.
                let least = radius_max / RADIUS_MAX_VOXELS;
                let digit = 10f64.powf(least.log10().floor() - 1.0);
                let least = significant((least / digit).ceil() * digit);
                let ratio = if options.radius_ratio.is_some() { ", or a smaller ratio" } else { "" };
                let h = significant(h);
                format!(
                    "the voxel size {h} is too small: {what}; use a voxel size of at least {least}{ratio}"
                )
            }
        }
    })?;
    Ok([radius_min, radius_init.clamp(radius_min, radius_max), radius_max])
}

/// How far the finished surface is moved, world units.
pub(super) fn offset(options: &MethodOptions, radius_min: f64, scale: &Scale) -> Result<f64, SettingsError> {
    let offset = scale.length(options.offset).unwrap_or(0.0);
    check_offset((options.offset, offset), (radius_min, "r_min"), scale.voxel_size)?;
    Ok(offset)
}

/// Checks that an offset, as given and in world units, moves the surface inward by at most a radius, which
/// has this name in the error.
pub(super) fn check_offset(
    (given, offset): (Option<Length>, f64),
    (radius, radius_name): (f64, &str),
    voxel_size: f64,
) -> Result<(), SettingsError> {
    let [inward, outward] = [-radius, OFFSET_MAX * voxel_size];
    // A computed radius may differ from a typed one by a rounding error.
    let slack = 1e-9 * radius;
    require((inward - slack..=outward).contains(&offset), || {
        format!(
            "the {}; it must be from -{radius_name} = {} to {OFFSET_MAX} h = {}",
            stated("offset", given, offset),
            significant(inward),
            significant(outward)
        )
    })
}

pub(super) fn anisotropy(
    options: &MethodOptions,
    radius_min: f64,
    scale: &Scale,
) -> Result<Anisotropy, SettingsError> {
    let max_stretch = options.max_stretch.unwrap_or(MAX_STRETCH);
    match options.anisotropy_kind() {
        AnisotropyKind::None => Ok(Anisotropy::None),
        AnisotropyKind::Neighbors if is_too_coarse_to_flatten(options, scale) => Ok(Anisotropy::None),
        AnisotropyKind::Neighbors => {
            let [thin_radius, lone_radius] = flattened_radii(options, radius_min, scale)?;
            Ok(Anisotropy::Neighbors { max_stretch, thin_radius, lone_radius })
        }
        AnisotropyKind::Velocity => {
            let gain = positive("velocity gain", options.velocity_gain.unwrap_or(VELOCITY_GAIN))?;
            Ok(Anisotropy::Velocity { gain, max_stretch })
        }
    }
}

/// Whether only the preset requests flattening, and the grid is too coarse for anything thinner than a ball.
fn is_too_coarse_to_flatten(options: &MethodOptions, scale: &Scale) -> bool {
    let MethodOptions { anisotropy, max_stretch, thin_radius, lone_radius, .. } = options;
    let is_chosen = anisotropy.is_some() || max_stretch.is_some();
    let is_chosen = is_chosen || thin_radius.is_some() || lone_radius.is_some();
    !is_chosen && scale.voxel_size > FLATTEN_MAX * scale.spacing
}

/// The smallest semi-axis of flattened particles, and r_min of particles without neighbours.
fn flattened_radii(
    options: &MethodOptions,
    radius_min: f64,
    scale: &Scale,
) -> Result<[f64; 2], SettingsError> {
    let (recipe, h) = (options.recipe(), scale.voxel_size);
    let (length, held) = (|count| scale.units(recipe.unit, count), 3f64.sqrt() * h);
    let [least, most] = [THIN_MIN_VOXELS * h, radius_min.max(held)];
    let thin =
        recipe.thin_radius.map_or(held, |radius| length(radius).max(rounded_to_digits(least)).min(most));
    let thin = positive_length(
        SMALLEST_SEMI_AXIS,
        options.thin_radius,
        scale.length(options.thin_radius).unwrap_or(thin),
    )?;
    // Typed numbers may differ from computed ones by a rounding error.
    let slack = 1e-9 * most;
    require((least - slack..=most + slack).contains(&thin), || {
        format!(
            "the {}; it must be from {THIN_MIN_VOXELS} h = {} to r_min = {}",
            stated(SMALLEST_SEMI_AXIS, options.thin_radius, thin),
            significant(least),
            significant(most)
        )
    })?;
    let lone = recipe.lone_radius.map_or(radius_min, |radius| length(radius).max(held).min(radius_min));
    let lone =
        positive_length(LONE_RADIUS, options.lone_radius, scale.length(options.lone_radius).unwrap_or(lone))?;
    require(lone <= radius_min + slack, || {
        format!(
            "the {}; it must be at most r_min = {}",
            stated(LONE_RADIUS, options.lone_radius, lone),
            significant(radius_min)
        )
    })?;
    Ok([thin, lone.max(held).min(radius_min)])
}

/// The names of two lengths in messages.
const SMALLEST_SEMI_AXIS: &str = "smallest semi-axis of flattened particles";
const LONE_RADIUS: &str = "radius of particles without neighbours";

pub(super) fn neighbor_radius(
    options: &MethodOptions,
    radius_min: f64,
    scale: &Scale,
) -> Result<f64, SettingsError> {
    let (recipe, h) = (options.recipe(), scale.voxel_size);
    let of_recipe = recipe.neighbor_radius.map(|radius| scale.units(recipe.unit, radius));
    let radius = scale.length(options.neighbor_radius).or(of_recipe).unwrap_or(NEIGHBOR_RADIUS * radius_min);
    let radius = positive_length("neighbour radius", options.neighbor_radius, radius)?;
    require(radius <= NEIGHBOR_RADIUS_MAX_VOXELS * h, || {
        format!(
            "the {} is {} h; it must be at most {NEIGHBOR_RADIUS_MAX_VOXELS} h",
            named("neighbour radius", options.neighbor_radius),
            significant(radius / h)
        )
    })?;
    Ok(radius)
}

pub(super) fn checked_box(clip: ClipBox) -> Result<ClipBox, SettingsError> {
    require(clip.min.iter().chain(&clip.max).all(|number| number.is_finite()), || {
        format!(
            "the box {clip} has a number that is not finite: x0,y0,z0,x1,y1,z1 must be six finite numbers"
        )
    })?;
    for (axis, name) in ["x", "y", "z"].into_iter().enumerate() {
        let (min, max) = (clip.min[axis], clip.max[axis]);
        require(min < max, || {
            format!(
                "the box {clip} is empty: {name}0 = {min} must be below {name}1 = {max}; \
                 x0,y0,z0 is the lower corner, x1,y1,z1 the upper one"
            )
        })?;
    }
    Ok(clip)
}

// Settings converted to options, and to the names and values that files record.

/// Names and values in a fixed order. A value is written as in `meniscus.toml`, but text has no quotes.
pub type Pairs = Vec<(&'static str, String)>;

/// Options that change nothing at these values, so files do not record them. Newer options need no entry
/// here: [`Settings::to_options`] omits them if they change nothing.
const OFF: [(&str, &str); 8] = [
    ("anisotropy", "none"),
    ("drop_islands", "0"),
    ("spray", "0"),
    ("fill_cavities", "0"),
    ("decimate", "0"),
    ("smooth_normals", "0"),
    ("quads", "false"),
    ("temporal", "0"),
];

/// Options that files omit because recorded values imply them: all values contain the preset, and r_max the
/// ratio.
const IMPLIED: [&str; 2] = ["preset", "radius_ratio"];

/// Options that change something only if neighbours shape or move particles. The lengths contain the spacing;
/// beside them it determines which particles are in company.
const OF_NEIGHBORS: [&str; 2] = ["spacing", "position_smoothing"];

/// Files record these after all others, in this order.
const LAST: [&str; 10] = [
    "offset",
    "drop_islands",
    "spray",
    "spray_keep",
    "fill_cavities",
    "clip",
    "contour",
    "decimate",
    "smooth_normals",
    "quads",
];

impl Settings {
    /// All options that resolve to these settings, except those that are not used.
    pub fn to_options(&self) -> MethodOptions {
        let (kind, velocity_gain, max_stretch) = match self.anisotropy {
            Anisotropy::None => (AnisotropyKind::None, None, None),
            Anisotropy::Neighbors { max_stretch, .. } => (AnisotropyKind::Neighbors, None, Some(max_stretch)),
            Anisotropy::Velocity { gain, max_stretch } => {
                (AnisotropyKind::Velocity, Some(gain), Some(max_stretch))
            }
        };
        let (thin_radius, lone_radius) = match self.anisotropy {
            Anisotropy::Neighbors { thin_radius, lone_radius, .. } => {
                (Some(thin_radius.into()), Some(lone_radius.into()))
            }
            Anisotropy::None | Anisotropy::Velocity { .. } => (None, None),
        };
        // Also without attributes: those of a sequence in memory are selected for each frame, later.
        let velocity_scale = Some(self.velocity_scale).filter(|scale| *scale != 1.0);
        MethodOptions {
            preset: Some(self.preset),
            spacing: Some(self.spacing),
            voxel_size: Some(self.voxel_size.into()),
            radius_min: Some(self.radius_min.into()),
            radius_ratio: Some(self.radius_ratio),
            radius_init: Some(self.radius_init.into()),
            offset: (self.offset != 0.0).then_some(self.offset.into()),
            columns: self.reading.columns.clone(),
            r#where: self.reading.filter.clone(),
            radius_attribute: self.per_particle_radius.as_ref().map(|own| own.attribute.clone()),
            radius_scale: self.per_particle_radius.as_ref().map(|own| own.scale),
            anisotropy: Some(kind),
            max_stretch,
            thin_radius,
            lone_radius,
            neighbor_radius: self.uses_neighbors().then_some(self.neighbor_radius.into()),
            position_smoothing: Some(self.position_smoothing),
            velocity_gain,
            void_threshold: Some(self.void_threshold),
            attributes: self.attributes.clone(),
            velocity_scale,
            rest: self.rest.map(|rest| rest.first),
            rest_period: self.rest.and_then(|rest| rest.period),
            drop_islands: Some(self.drop_islands),
            spray: Some(self.spray),
            spray_keep: (self.spray > 0).then_some(self.spray_keep),
            fill_cavities: Some(self.fill_cavities),
            clip: self.clip,
            contour: Some(self.contouring),
            decimate: Some(self.decimate),
            smooth_normals: Some(self.smooth_normals),
            quads: Some(self.quads),
            integrator: Some(self.smoothing.integrator),
            laplacian_steps: Some(self.smoothing.laplacian_steps),
            steps: Some(self.smoothing.steps),
            step_size: Some(self.smoothing.step_size),
            redistance_every: Some(self.smoothing.redistance_every),
            temporal: Some(self.temporal),
            time_step: self.time_step.filter(|_| self.temporal > 0),
        }
    }

    /// The options that results depend on, with their values, as files record them. Options that change
    /// nothing are omitted, so that files keep their bytes when an option is added. `is_relevant` selects the
    /// options that affect a file.
    pub fn pairs(&self, is_relevant: impl Fn(&str) -> bool) -> Pairs {
        let changes_something = |(name, value): &(&str, String)| {
            let is_off = OFF.contains(&(*name, value)) || IMPLIED.contains(name);
            let is_used = !OF_NEIGHBORS.contains(name) || self.uses_neighbors();
            is_used && !is_off
        };
        let mut pairs = self.to_options().to_pairs();
        let after = pairs.iter().position(|(name, _)| *name == "radius_init").map_or(0, |index| index + 1);
        pairs.insert(after, ("radius_max", self.radius_max.to_string()));
        pairs.retain(|pair| is_relevant(pair.0) && changes_something(pair));
        // Sort by the order of the options, except those with a fixed position at the end.
        pairs.sort_by_key(|(name, _)| LAST.iter().position(|last| last == name).map_or(0, |index| index + 1));
        let index_of = |wanted| pairs.iter().position(|(name, _)| *name == wanted);
        if let (Some(stretch), Some(gain)) = (index_of("max_stretch"), index_of("velocity_gain")) {
            pairs[stretch..=gain].rotate_right(1);
        }
        pairs
    }
}
