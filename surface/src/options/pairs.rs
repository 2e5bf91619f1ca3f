//! Settings converted to options, and to the names and values that files record.

use super::{Anisotropy, AnisotropyKind, Integrator, MethodOptions, Settings};

/// Names and values in a fixed order. A value is written as in `meniscus.toml`, but text has no quotes.
pub type Pairs = Vec<(&'static str, String)>;

/// Options that change nothing at these values, so files do not record them. Newer options need no entry
/// here: [`Settings::to_options`] omits them if they change nothing.
const OFF: [(&str, &str); 6] = [
    ("anisotropy", "none"),
    ("drop_islands", "0"),
    ("fill_cavities", "0"),
    ("decimate", "0"),
    ("smooth_normals", "0"),
    ("quads", "false"),
];

/// Options that files omit because recorded values imply them: all lengths contain the spacing, and r_max
/// contains the ratio.
const IMPLIED: [&str; 2] = ["spacing", "radius_ratio"];

/// Files record these after all others, in this order.
const LAST: [&str; 8] =
    ["offset", "drop_islands", "fill_cavities", "clip", "contour", "decimate", "smooth_normals", "quads"];

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
        let is_implicit = self.integrator == Integrator::Implicit;
        MethodOptions {
            preset: None,
            spacing: Some(self.spacing),
            voxel_size: Some(self.voxel_size.into()),
            radius_min: Some(self.radius_min.into()),
            radius_ratio: Some(self.radius_ratio),
            radius_init: Some(self.radius_init.into()),
            offset: (self.offset != 0.0).then_some(self.offset.into()),
            r#where: self.filter.clone(),
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
            drop_islands: Some(self.drop_islands),
            fill_cavities: Some(self.fill_cavities),
            clip: self.clip,
            contour: Some(self.contouring),
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

    /// The options that results depend on, with their values, as files record them. Options that change
    /// nothing are omitted, so that files keep their bytes when an option is added. `is_relevant` selects the
    /// options that affect a file.
    pub fn pairs(&self, is_relevant: impl Fn(&str) -> bool) -> Pairs {
        let changes_something = |(name, value): &(&str, String)| {
            let is_off = OFF.contains(&(*name, value)) || IMPLIED.contains(name);
            let is_used = *name != "position_smoothing" || self.uses_neighbors();
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
