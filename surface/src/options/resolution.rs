//! Defaults and checks of settings that depend on the preset, the voxel size or each other.

use super::definition::{CAVITY_VOXELS_MAX, STEP_SIZE_MAX, STEP_SIZE_MIN, STEPS_MAX};
use super::presets::{Recipe, Scale};
use super::{
    Anisotropy, AnisotropyKind, ClipBox, Integrator, Length, MethodOptions, RADIUS_MAX_VOXELS, Settings,
    SettingsError, Start, named, positive, positive_length, require, stated,
};
use crate::particles::LONE_RADIUS;
use crate::words::{rounded_to_digits, significant};

/// The smallest r_min in voxels. Semi-axes are in units of r_min, and the voxel size in this unit must fit
/// into a 32-bit number.
const RADIUS_MIN_VOXELS: f64 = 1e-6;

/// The paper's r_max / r_min.
pub(super) const RADIUS_RATIO: f64 = 2.0;

/// r_init, in units of the reach of kernels. Particles up to twice as far apart count as one piece of fluid: a
/// little farther than where their surfaces join.
const LINKED: f64 = 0.6;

/// Upper limit of the offset, in units of h.
const OFFSET_MAX: f64 = 2.0;

/// Default limit of stretching: as in Yu and Turk.
const MAX_STRETCH: f64 = 4.0;

/// The same for kernels: a sheet of one layer then has the volume of its particles.
const MAX_STRETCH_OF_KERNELS: f64 = 2.0;

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

/// r_min, r_init and r_max of the paper: r_min is √3 h (Eq. 13), and r_init the mean of the other two (Eq. 2).
pub(super) fn radii(scale: &Scale, ratio: f64, options: &MethodOptions) -> Result<[f64; 3], SettingsError> {
    let h = scale.voxel_size;
    let given = scale.length(options.radius_min);
    let radius_min = positive_length("radius r_min", options.radius_min, given.unwrap_or(3f64.sqrt() * h))?;
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
    require(radius_max <= RADIUS_MAX_VOXELS * h, || {
        let what = format!(
            "r_max is {} voxels; it must be at most {RADIUS_MAX_VOXELS}",
            significant(radius_max / h)
        );
        match options.radius_min {
            Some(_) => format!("{what}: choose a smaller r_min or ratio, or a larger voxel size"),
            None => {
                format!("{what}: choose a smaller ratio, or a larger voxel size with r_min in world units")
            }
        }
    })?;
    Ok([radius_min, 0.5 * (radius_min + radius_max), radius_max])
}

/// The same radii for kernels: that of the ball around each particle that is always inside; half the distance
/// up to which particles count as one piece of fluid; and the reach of a kernel.
pub(super) fn kernel_radii(scale: &Scale, options: &MethodOptions) -> Result<[f64; 3], SettingsError> {
    let h = scale.voxel_size;
    let reach = scale.length(options.blend).unwrap_or_else(|| usual_reach(&options.recipe(), scale));
    let reach = positive_length("blend", options.blend, reach)?;
    let [least, most] = [LEAST_REACH_VOXELS, RADIUS_MAX_VOXELS].map(|voxels| voxels * h);
    let slack = 1e-9 * most;
    require((least - slack..=most + slack).contains(&reach), || {
        format!(
            "the {}; it must be from {} to {}, which is {} to {RADIUS_MAX_VOXELS} voxels{}",
            stated("blend", options.blend, reach),
            significant(least),
            significant(most),
            significant(LEAST_REACH_VOXELS),
            if options.blend.is_none() { ": choose another voxel size" } else { "" },
        )
    })?;
    Ok([h, LINKED * reach, reach])
}

/// The reach of the kernels of a recipe: so long that a lone particle does not fall between voxels.
pub(super) fn usual_reach(recipe: &Recipe, scale: &Scale) -> f64 {
    let least = LEAST_REACH_VOXELS * scale.voxel_size;
    scale.units(recipe.unit, recipe.blend.unwrap_or_default()).max(least)
}

/// The least reach of kernels, in voxels: the grid resolves a lone particle.
pub(super) const LEAST_REACH_VOXELS: f64 = Start::Kernels.resolved_voxels() / LONE_RADIUS as f64;

/// The radius of the surface of a lone particle of scale 1, from r_min and r_max.
pub(super) fn unit_radius([radius_min, radius_max]: [f64; 2], start: Start) -> f64 {
    match start {
        Start::Spheres => radius_min,
        Start::Kernels => f64::from(LONE_RADIUS) * radius_max,
    }
}

/// How far the finished surface is moved, world units.
pub(super) fn offset(options: &MethodOptions, radius: f64, scale: &Scale) -> Result<f64, SettingsError> {
    let offset = scale.length(options.offset).unwrap_or(0.0);
    let name = match options.start() {
        Start::Spheres => "r_min",
        Start::Kernels => "(radius of a lone particle)",
    };
    check_offset((options.offset, offset), (radius, name), scale.voxel_size)?;
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

pub(super) fn anisotropy(options: &MethodOptions) -> Result<Anisotropy, SettingsError> {
    let kind = options.anisotropy_kind();
    let is_by_neighbors = kind == AnisotropyKind::Neighbors && options.start() == Start::Kernels;
    let usual = if is_by_neighbors { MAX_STRETCH_OF_KERNELS } else { MAX_STRETCH };
    let max_stretch = options.max_stretch.unwrap_or(usual);
    match kind {
        AnisotropyKind::None => Ok(Anisotropy::None),
        AnisotropyKind::Neighbors => Ok(Anisotropy::Neighbors { max_stretch }),
        AnisotropyKind::Velocity => {
            let gain = positive("velocity gain", options.velocity_gain.unwrap_or(VELOCITY_GAIN))?;
            Ok(Anisotropy::Velocity { gain, max_stretch })
        }
    }
}

pub(super) fn neighbor_radius(
    options: &MethodOptions,
    radius_min: f64,
    scale: &Scale,
) -> Result<f64, SettingsError> {
    let (recipe, h) = (options.recipe(), scale.voxel_size);
    // Neighbours weigh kernels, so a longer reach needs more of them.
    let longer =
        scale.length(options.blend).map_or(1.0, |reach| (reach / usual_reach(&recipe, scale)).max(1.0));
    let of_recipe = recipe.neighbor_radius.map(|radius| scale.units(recipe.unit, radius) * longer);
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
            Anisotropy::Neighbors { max_stretch } => (AnisotropyKind::Neighbors, None, Some(max_stretch)),
            Anisotropy::Velocity { gain, max_stretch } => {
                (AnisotropyKind::Velocity, Some(gain), Some(max_stretch))
            }
        };
        let of_start = |start, length: f64| (self.start == start).then_some(length);
        // Also without attributes: those of a sequence in memory are selected for each frame, later.
        let velocity_scale = Some(self.velocity_scale).filter(|scale| *scale != 1.0);
        MethodOptions {
            preset: Some(self.preset),
            spacing: Some(self.spacing),
            voxel_size: Some(self.voxel_size.into()),
            radius_min: of_start(Start::Spheres, self.radius_min).map(Length::from),
            radius_ratio: of_start(Start::Spheres, self.radius_ratio),
            blend: of_start(Start::Kernels, self.radius_max).map(Length::from),
            offset: (self.offset != 0.0).then_some(self.offset.into()),
            columns: self.reading.columns.clone(),
            r#where: self.reading.filter.clone(),
            radius_attribute: self.per_particle_radius.as_ref().map(|own| own.attribute.clone()),
            radius_scale: self.per_particle_radius.as_ref().map(|own| own.scale),
            anisotropy: Some(kind),
            max_stretch,
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
            time_step: self.time_step.filter(|_| self.temporal > 0 || self.computes_velocities()),
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
        let after = pairs.iter().position(|(name, _)| *name == "radius_ratio").map_or(0, |index| index + 1);
        if self.start == Start::Spheres {
            pairs.insert(after, ("radius_init", self.radius_init.to_string()));
            pairs.insert(after + 1, ("radius_max", self.radius_max.to_string()));
        }
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
