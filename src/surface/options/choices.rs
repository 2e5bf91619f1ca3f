//! What somebody asked for, and its form as text.
//!
//! ```text
//!   command line ─┐
//!   meniscus.toml ┼─▶ Choices ──over the defaults of a preset──resolve──▶ Settings
//!   journal ──────┘      ▲ │
//!      (name, text) ─────┘ └─────▶ (name, text)
//! ```
//!
//! Names are those of the options, with underscores; numbers are in the shortest form that reads back as the
//! same number.

use std::fmt;
use std::str::FromStr;

use crate::surface::particles::Attribute;

use super::presets::{Preset, Recipe};
use super::{Contouring, Integrator};

/// What a user may choose. `None` means what the preset says.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Choices {
    /// What the defaults of all others are.
    pub preset: Option<Preset>,
    /// Distance d between neighbouring particles, world units; measured by default.
    pub spacing: Option<f64>,
    /// Edge length h of a voxel, world units; 0.4 spacings by default.
    pub voxel_size: Option<f64>,
    /// Radius of the inner spheres r_min, world units.
    pub radius_min: Option<f64>,
    /// r_max / r_min.
    pub radius_ratio: Option<f64>,
    /// Radius of the first surface, world units.
    pub radius_init: Option<f64>,
    /// How far the finished surface is moved, world units: outward, or inward where negative; 0 by default.
    pub offset: Option<f64>,
    /// The attribute that has each particle's own radius; none by default.
    pub radius_attribute: Option<String>,
    /// r_min of a particle in units of its own radius; 1 by default.
    pub radius_scale: Option<f64>,
    /// What stretches particles.
    pub anisotropy: Option<AnisotropyKind>,
    /// The longest half axis of a particle in units of its shortest, at most; 4 by default.
    pub max_stretch: Option<f64>,
    /// The least half axis of inner ellipsoids that neighbours flatten, world units.
    pub thin_radius: Option<f64>,
    /// r_min of a particle that has no neighbours, world units.
    pub lone_radius: Option<f64>,
    /// How far neighbours count, world units.
    pub neighbor_radius: Option<f64>,
    /// How far particles are moved to the mean of their neighbours, 0 to 1.
    pub position_smoothing: Option<f64>,
    /// Seconds of movement by which velocities stretch; 0.01 by default.
    pub velocity_gain: Option<f64>,
    /// Gaps to obstacles that are narrower are filled, in units of h; 1 by default.
    pub void_threshold: Option<f64>,
    /// Attributes of the particles that the surface gets; none by default.
    pub attributes: Option<AttributeSelection>,
    /// Pieces of surface with fewer particles are dropped; 0 by default.
    pub drop_islands: Option<u32>,
    /// Cavities of a smaller volume are filled, in units of h³.
    pub fill_cavities: Option<f64>,
    /// What is outside this box is cut off; nothing by default.
    pub clip: Option<ClipBox>,
    /// How the level set becomes triangles; `Dual` by default.
    pub contouring: Option<Contouring>,
    /// Triangles are saved where the mesh moves by no more, in units of h; 0 by default: none are.
    pub decimate: Option<f64>,
    /// Rounds in which normals are averaged with their neighbours; 0 by default.
    pub smooth_normals: Option<u32>,
    /// Whether .obj, .vtp and .usda have quads; not by default.
    pub quads: Option<bool>,
    /// Which integrator; `Fast` by default.
    pub integrator: Option<Integrator>,
    /// Laplacian steps before the biharmonic ones.
    pub laplacian_steps: Option<u32>,
    /// Biharmonic steps.
    pub steps: Option<u32>,
    /// Size of a step in units of h⁴.
    pub step_size: Option<f64>,
    /// Redistance after so many steps; 1, or 50 for `Explicit` and `Adaptive`.
    pub redistance_every: Option<u32>,
    /// Relative tolerance of the conjugate gradients; 1e-4 by default.
    pub cg_tolerance: Option<f64>,
}

/// What stretches particles (paper, Fig. 11).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum AnisotropyKind {
    /// Nothing: balls.
    None,
    /// Where the neighbours are, as Yu and Turk have it.
    Neighbors,
    /// The velocity (Eq. 16).
    Velocity,
}

/// Which attributes of the particles the surface gets.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum AttributeSelection {
    /// All there are.
    All,
    /// Those with these names or meanings: at least one.
    Named(Vec<String>),
}

/// A box with faces along the axes, world units; `min` is below `max` on each axis once it is resolved.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ClipBox {
    /// Least corner.
    pub min: [f64; 3],
    /// Greatest corner.
    pub max: [f64; 3],
}

impl Choices {
    /// These, and where one is not made, that of `below`.
    pub fn over(self, below: Choices) -> Choices {
        Choices {
            preset: self.preset.or(below.preset),
            spacing: self.spacing.or(below.spacing),
            voxel_size: self.voxel_size.or(below.voxel_size),
            radius_min: self.radius_min.or(below.radius_min),
            radius_ratio: self.radius_ratio.or(below.radius_ratio),
            radius_init: self.radius_init.or(below.radius_init),
            offset: self.offset.or(below.offset),
            radius_attribute: self.radius_attribute.or(below.radius_attribute),
            radius_scale: self.radius_scale.or(below.radius_scale),
            anisotropy: self.anisotropy.or(below.anisotropy),
            max_stretch: self.max_stretch.or(below.max_stretch),
            thin_radius: self.thin_radius.or(below.thin_radius),
            lone_radius: self.lone_radius.or(below.lone_radius),
            neighbor_radius: self.neighbor_radius.or(below.neighbor_radius),
            position_smoothing: self.position_smoothing.or(below.position_smoothing),
            velocity_gain: self.velocity_gain.or(below.velocity_gain),
            void_threshold: self.void_threshold.or(below.void_threshold),
            attributes: self.attributes.or(below.attributes),
            drop_islands: self.drop_islands.or(below.drop_islands),
            fill_cavities: self.fill_cavities.or(below.fill_cavities),
            clip: self.clip.or(below.clip),
            contouring: self.contouring.or(below.contouring),
            decimate: self.decimate.or(below.decimate),
            smooth_normals: self.smooth_normals.or(below.smooth_normals),
            quads: self.quads.or(below.quads),
            integrator: self.integrator.or(below.integrator),
            laplacian_steps: self.laplacian_steps.or(below.laplacian_steps),
            steps: self.steps.or(below.steps),
            step_size: self.step_size.or(below.step_size),
            redistance_every: self.redistance_every.or(below.redistance_every),
            cg_tolerance: self.cg_tolerance.or(below.cg_tolerance),
        }
    }

    /// The numbers of the preset.
    pub(super) fn recipe(&self) -> Recipe {
        self.preset.unwrap_or_default().recipe()
    }

    /// Whether the particle spacing has to be measured to know the settings.
    pub fn needs_spacing(&self) -> bool {
        let follows_voxel_size = self.preset.unwrap_or_default().follows_voxel_size();
        self.spacing.is_none() && (self.voxel_size.is_none() || !follows_voxel_size)
    }

    /// How far particles are moved to the mean of their neighbours.
    pub(super) fn position_smoothing(&self) -> f64 {
        self.position_smoothing.unwrap_or(self.recipe().position_smoothing)
    }

    /// Whether a particle's place or shape depends on its neighbours.
    pub fn uses_neighbors(&self) -> bool {
        self.position_smoothing() > 0.0 || self.anisotropy_kind() == AnisotropyKind::Neighbors
    }

    /// What stretches particles.
    pub fn anisotropy_kind(&self) -> AnisotropyKind {
        self.anisotropy.unwrap_or(self.recipe().anisotropy)
    }

    /// The choices that were made, by name.
    pub fn to_pairs(&self) -> Vec<(&'static str, String)> {
        let text = |number: &Option<f64>| number.map(|number| number.to_string());
        let count = |count: &Option<u32>| count.map(|count| count.to_string());
        let pairs = [
            ("preset", self.preset.map(|preset| preset.name().to_owned())),
            ("spacing", text(&self.spacing)),
            ("voxel_size", text(&self.voxel_size)),
            ("radius_min", text(&self.radius_min)),
            ("radius_ratio", text(&self.radius_ratio)),
            ("radius_init", text(&self.radius_init)),
            ("offset", text(&self.offset)),
            ("radius_attribute", self.radius_attribute.clone()),
            ("radius_scale", text(&self.radius_scale)),
            ("anisotropy", self.anisotropy.map(|kind| kind.name().to_owned())),
            ("max_stretch", text(&self.max_stretch)),
            ("thin_radius", text(&self.thin_radius)),
            ("lone_radius", text(&self.lone_radius)),
            ("neighbor_radius", text(&self.neighbor_radius)),
            ("position_smoothing", text(&self.position_smoothing)),
            ("velocity_gain", text(&self.velocity_gain)),
            ("void_threshold", text(&self.void_threshold)),
            ("attributes", self.attributes.as_ref().map(ToString::to_string)),
            ("drop_islands", count(&self.drop_islands)),
            ("fill_cavities", text(&self.fill_cavities)),
            ("clip", self.clip.as_ref().map(ToString::to_string)),
            ("contour", self.contouring.map(|contouring| contouring_name(contouring).to_owned())),
            ("decimate", text(&self.decimate)),
            ("smooth_normals", count(&self.smooth_normals)),
            ("quads", self.quads.map(|quads| quads.to_string())),
            ("integrator", self.integrator.map(|integrator| integrator_name(integrator).to_owned())),
            ("laplacian_steps", count(&self.laplacian_steps)),
            ("steps", count(&self.steps)),
            ("step_size", text(&self.step_size)),
            ("redistance_every", count(&self.redistance_every)),
            ("cg_tolerance", text(&self.cg_tolerance)),
        ];
        pairs.into_iter().filter_map(|(name, value)| Some((name, value?))).collect()
    }

    /// The choices that pairs tell; `None` where one is unknown or has a value that is none.
    pub fn from_pairs<'a>(pairs: impl IntoIterator<Item = (&'a str, &'a str)>) -> Option<Choices> {
        fn parse<T: FromStr>(value: &str) -> Option<Option<T>> {
            value.parse().ok().map(Some)
        }
        let mut choices = Choices::default();
        for (name, value) in pairs {
            match name {
                "preset" => choices.preset = Some(Preset::named(value)?),
                "spacing" => choices.spacing = parse(value)?,
                "voxel_size" => choices.voxel_size = parse(value)?,
                "radius_min" => choices.radius_min = parse(value)?,
                "radius_ratio" => choices.radius_ratio = parse(value)?,
                "radius_init" => choices.radius_init = parse(value)?,
                "offset" => choices.offset = parse(value)?,
                "radius_attribute" => choices.radius_attribute = Some(value.to_owned()),
                "radius_scale" => choices.radius_scale = parse(value)?,
                "anisotropy" => choices.anisotropy = Some(AnisotropyKind::named(value)?),
                "max_stretch" => choices.max_stretch = parse(value)?,
                "thin_radius" => choices.thin_radius = parse(value)?,
                "lone_radius" => choices.lone_radius = parse(value)?,
                "neighbor_radius" => choices.neighbor_radius = parse(value)?,
                "position_smoothing" => choices.position_smoothing = parse(value)?,
                "velocity_gain" => choices.velocity_gain = parse(value)?,
                "void_threshold" => choices.void_threshold = parse(value)?,
                "attributes" => choices.attributes = parse(value)?,
                "drop_islands" => choices.drop_islands = parse(value)?,
                "fill_cavities" => choices.fill_cavities = parse(value)?,
                "clip" => choices.clip = parse(value)?,
                "contour" => choices.contouring = Some(contouring_named(value)?),
                "decimate" => choices.decimate = parse(value)?,
                "smooth_normals" => choices.smooth_normals = parse(value)?,
                "quads" => choices.quads = parse(value)?,
                "integrator" => choices.integrator = Some(integrator_named(value)?),
                "laplacian_steps" => choices.laplacian_steps = parse(value)?,
                "steps" => choices.steps = parse(value)?,
                "step_size" => choices.step_size = parse(value)?,
                "redistance_every" => choices.redistance_every = parse(value)?,
                "cg_tolerance" => choices.cg_tolerance = parse(value)?,
                _ => return None,
            }
        }
        Some(choices)
    }
}

impl AnisotropyKind {
    /// As it is typed.
    pub fn name(self) -> &'static str {
        match self {
            AnisotropyKind::None => "none",
            AnisotropyKind::Neighbors => "neighbors",
            AnisotropyKind::Velocity => "velocity",
        }
    }

    fn named(name: &str) -> Option<AnisotropyKind> {
        let all = [AnisotropyKind::None, AnisotropyKind::Neighbors, AnisotropyKind::Velocity];
        all.into_iter().find(|kind| kind.name() == name)
    }
}

/// An integrator as it is typed.
pub fn integrator_name(integrator: Integrator) -> &'static str {
    match integrator {
        Integrator::Fast => "fast",
        Integrator::Implicit => "implicit",
        Integrator::Explicit => "explicit",
        Integrator::Adaptive => "adaptive",
    }
}

fn integrator_named(name: &str) -> Option<Integrator> {
    let all = [Integrator::Fast, Integrator::Implicit, Integrator::Explicit, Integrator::Adaptive];
    all.into_iter().find(|&integrator| integrator_name(integrator) == name)
}

/// A contouring as it is typed.
pub fn contouring_name(contouring: Contouring) -> &'static str {
    match contouring {
        Contouring::Dual => "dual",
        Contouring::Tetrahedra => "tetrahedra",
    }
}

fn contouring_named(name: &str) -> Option<Contouring> {
    let all = [Contouring::Dual, Contouring::Tetrahedra];
    all.into_iter().find(|&contouring| contouring_name(contouring) == name)
}

impl AttributeSelection {
    /// Whether the surface is to have this attribute.
    pub fn selects(&self, attribute: &Attribute) -> bool {
        match self {
            AttributeSelection::All => true,
            AttributeSelection::Named(names) => names.iter().any(|name| attribute.is_called(name)),
        }
    }
}

impl fmt::Display for AttributeSelection {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            AttributeSelection::All => f.write_str("all"),
            AttributeSelection::Named(names) => f.write_str(&names.join(",")),
        }
    }
}

impl FromStr for AttributeSelection {
    type Err = String;

    fn from_str(text: &str) -> Result<AttributeSelection, String> {
        let names: Vec<String> = text.split(',').map(|name| name.trim().to_owned()).collect();
        if names.iter().any(String::is_empty) {
            return Err(format!("`{text}` is no list of attributes, such as velocity,Cd; or all"));
        }
        if names.len() > 1 && names.iter().any(|name| name == "all") {
            return Err(format!(
                "`{text}` names attributes beside all: write all, or only names, such as velocity,Cd"
            ));
        }
        Ok(if names == ["all"] { AttributeSelection::All } else { AttributeSelection::Named(names) })
    }
}

impl fmt::Display for ClipBox {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let [x, y, z] = self.min;
        let [to_x, to_y, to_z] = self.max;
        write!(f, "{x},{y},{z},{to_x},{to_y},{to_z}")
    }
}

impl FromStr for ClipBox {
    type Err = String;

    fn from_str(text: &str) -> Result<ClipBox, String> {
        let wanted = || format!("`{text}` is no box: six numbers x0,y0,z0,x1,y1,z1, from the least corner");
        let numbers: Result<Vec<f64>, _> = text.split(',').map(|number| number.trim().parse()).collect();
        let [x, y, z, to_x, to_y, to_z] = numbers.map_err(|_| wanted())?[..] else { return Err(wanted()) };
        Ok(ClipBox { min: [x, y, z], max: [to_x, to_y, to_z] })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// One that makes every choice.
    fn all() -> Choices {
        Choices {
            preset: Some(Preset::Splash),
            spacing: Some(0.2_f64.next_up()),
            voxel_size: Some(1.0 / 7.0),
            radius_min: Some(1.0 / 3.0),
            radius_ratio: Some(1.5),
            radius_init: Some(f64::MIN_POSITIVE / 3.0),
            offset: Some(-1.0 / 7.0),
            radius_attribute: Some("p scale, \"é\"".to_owned()),
            radius_scale: Some(0.1_f64.next_up()),
            anisotropy: Some(AnisotropyKind::Velocity),
            max_stretch: Some(1e300),
            thin_radius: Some(0.1),
            lone_radius: Some(0.15),
            neighbor_radius: Some(0.2),
            position_smoothing: Some(0.9),
            velocity_gain: Some(1.0 / 48.0),
            void_threshold: Some(1.7),
            attributes: Some(AttributeSelection::Named(vec!["v".to_owned(), "Cd".to_owned()])),
            drop_islands: Some(33),
            fill_cavities: Some(1e-300),
            clip: Some(ClipBox { min: [-1.0, 0.0, 1.0 / 3.0], max: [1.0, 2.0, 1e9] }),
            contouring: Some(Contouring::Tetrahedra),
            decimate: Some(0.05),
            smooth_normals: Some(3),
            quads: Some(true),
            integrator: Some(Integrator::Implicit),
            laplacian_steps: Some(0),
            steps: Some(u32::MAX),
            step_size: Some(1e-300),
            redistance_every: Some(7),
            cg_tolerance: Some(1e-4_f64.next_down()),
        }
    }

    fn read(pairs: &[(&'static str, String)]) -> Option<Choices> {
        Choices::from_pairs(pairs.iter().map(|(name, value)| (*name, value.as_str())))
    }

    #[test]
    fn choices_come_back_to_the_last_bit() {
        let pairs = all().to_pairs();
        assert_eq!(read(&pairs), Some(all()));
        // Each by itself, and each is told from none.
        for pair in &pairs {
            let one = read(std::slice::from_ref(pair)).expect("known");
            assert_eq!(one.to_pairs(), std::slice::from_ref(pair));
            assert_ne!(one, Choices::default());
        }
        assert_eq!(read(&[]), Some(Choices::default()));
        assert_eq!(read(&[("radius_min", "wide".to_owned())]), None);
        assert_eq!(read(&[("radius_mine", "1".to_owned())]), None);
    }

    #[test]
    fn what_is_chosen_is_over_what_is_below() {
        assert_eq!(all().over(Choices::default()), all());
        assert_eq!(Choices::default().over(all()), all());
        let above = Choices { steps: Some(2), ..Choices::default() };
        assert_eq!(above.over(all()), Choices { steps: Some(2), ..all() });
    }

    #[test]
    fn boxes_and_lists_are_understood_or_refused() {
        let parsed: ClipBox = "-1, 0,0.5, 1e3,2,3".parse().expect("a box");
        assert_eq!(parsed, ClipBox { min: [-1.0, 0.0, 0.5], max: [1000.0, 2.0, 3.0] });
        for text in ["", "1,2,3", "1,2,3,4,5,6,7", "1,2,3,4,5,x"] {
            assert!(text.parse::<ClipBox>().is_err_and(|why| why.contains("six numbers")), "{text}");
        }
        assert_eq!("all".parse(), Ok(AttributeSelection::All));
        assert_eq!("v, id".parse(), Ok(AttributeSelection::Named(vec!["v".into(), "id".into()])));
        assert!("v,,id".parse::<AttributeSelection>().is_err());
        for text in ["all,age", "age, all", "all,all"] {
            let why = text.parse::<AttributeSelection>().expect_err(text);
            assert!(why.contains(text) && why.contains("beside all"), "{why}");
        }
    }
}
