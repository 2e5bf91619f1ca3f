//! Selects the attributes that a frame needs from its file, and converts their values for the method.

use std::sync::Arc;

use meniscus_formats::columns::aliases;
use meniscus_formats::{AttributeRole, FileAttribute, Values};

use crate::surface::attributes::ComputedAttribute;
use crate::surface::options::{
    Anisotropy, AttributeSelection, OptionName, ReadOptions, Settings, SpacingOptions,
};
use crate::surface::particles::{Attribute, AttributeValues, Role, coordinates, find_attribute, ids_of};

use crate::pipeline::warning::{COMPUTED_VELOCITIES, Warning};

use super::frame::Frame;

/// The attributes that a frame needs from its file.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct AttributeRequest {
    /// Attributes that the reconstruction requires.
    needed: Vec<RequiredAttribute>,
    /// Attributes to transfer to the surface.
    selected: Option<AttributeSelection>,
    /// Whether ids and velocities are wanted, if there are any, to follow the particles.
    follows: bool,
    /// Whether velocities are computed if the file has none.
    computes_velocities: bool,
    /// Whether all attributes are wanted, for the points beside the surface.
    keeps_all: bool,
    /// What is read of the file.
    pub(crate) reading: ReadOptions,
}

/// An attribute that the reconstruction requires.
#[derive(Clone, Debug, PartialEq)]
struct RequiredAttribute {
    name: String,
    /// The number of components for each particle.
    arity: usize,
    /// The option that requires it.
    option: OptionName,
    /// Whether at least one particle needs a positive value.
    is_length: bool,
    /// Whether the values must be whole numbers.
    is_id: bool,
}

impl RequiredAttribute {
    /// The error message if none of these attributes meets the requirement, with the option in this spelling.
    fn why_missing(&self, all: &[Attribute], spelled: fn(OptionName) -> String) -> String {
        let RequiredAttribute { name, arity, .. } = self;
        let option = spelled(self.option);
        let kind = if *arity == 1 { "one number" } else { "a vector of three numbers" };
        match all.iter().find(|attribute| attribute.matches(name)) {
            None => {
                let names: Vec<&str> = all.iter().map(|attribute| &*attribute.name).collect();
                let names_found = if all.is_empty() { "none".to_owned() } else { names.join(", ") };
                format!(
                    "the particles have no attribute `{name}`, which {option} needs; available: {names_found}"
                )
            }
            Some(Attribute { name, values: AttributeValues::Strings { .. }, .. }) => {
                format!("the attribute `{name}` is text, but {option} needs {kind} per particle")
            }
            Some(Attribute { name, arity: 1, .. }) => {
                format!("the attribute `{name}` is a scalar, but {option} needs {kind} per particle")
            }
            Some(Attribute { name, arity, .. }) => {
                format!("the attribute `{name}` has {arity} numbers per particle, but {option} needs {kind}")
            }
        }
    }

    fn is(&self, attribute: &Attribute) -> bool {
        attribute.matches(&self.name) && attribute.has_numbers(self.arity)
    }

    /// The error message if this attribute has no usable value for any particle, with the option in this
    /// spelling.
    fn why_useless(&self, attribute: &Attribute, spelled: fn(OptionName) -> String) -> Option<String> {
        let numbers = attribute.values.numbers().unwrap_or_default();
        if !self.is_length || numbers.is_empty() || numbers.iter().any(|n| n.is_finite() && *n > 0.0) {
            return None;
        }
        let (name, option) = (&attribute.name, spelled(self.option));
        Some(format!("the particles' attribute `{name}` has no positive value, but {option} needs radii"))
    }
}

impl AttributeRequest {
    /// The attributes that a frame requires.
    pub(crate) fn for_frame(frame: &Frame) -> AttributeRequest {
        let computes_velocities = frame.settings.computes_velocities();
        let follows = frame.is_averaged() || computes_velocities;
        AttributeRequest { follows, computes_velocities, ..AttributeRequest::for_settings(&frame.settings) }
    }

    /// The attributes that these settings require.
    pub fn for_settings(settings: &Settings) -> AttributeRequest {
        let (reading, per_particle_radius) = (settings.reading.clone(), settings.per_particle_radius.clone());
        let mut request = AttributeRequest::for_spacing(&SpacingOptions { reading, per_particle_radius });
        if matches!(settings.anisotropy, Anisotropy::Velocity { .. }) {
            request.needed.push(RequiredAttribute {
                name: "velocity".to_owned(),
                arity: 3,
                option: OptionName::with_value("anisotropy", "velocity"),
                is_length: false,
                is_id: false,
            });
        }
        if settings.rest.is_some() {
            request.needed.push(RequiredAttribute {
                name: "id".to_owned(),
                arity: 1,
                option: OptionName::new("rest"),
                is_length: false,
                is_id: true,
            });
        }
        AttributeRequest {
            selected: settings.attributes.clone(),
            follows: settings.temporal > 0,
            keeps_all: settings.spray > 0,
            ..request
        }
    }

    /// What a frame needs to decide which of its particles are spray, for the frames around it.
    pub(crate) fn for_sides(settings: &Settings) -> AttributeRequest {
        let request = AttributeRequest::for_settings(settings);
        AttributeRequest { selected: None, follows: true, keeps_all: false, ..request }
    }

    /// The per-particle radii of the chosen particles.
    pub(crate) fn for_spacing(options: &SpacingOptions) -> AttributeRequest {
        let radii = options.per_particle_radius.as_ref().map(|own| RequiredAttribute {
            name: own.attribute.clone(),
            arity: 1,
            option: OptionName::new("radius_attribute"),
            is_length: true,
            is_id: false,
        });
        let (needed, reading) = (radii.into_iter().collect(), options.reading.clone());
        AttributeRequest { needed, reading, ..AttributeRequest::default() }
    }

    /// The positions of the particles that meet the condition.
    pub(crate) fn positions_of(reading: &ReadOptions) -> AttributeRequest {
        AttributeRequest { reading: reading.clone(), ..AttributeRequest::default() }
    }

    /// What following the particles that meet the condition needs.
    pub fn to_follow(reading: &ReadOptions) -> AttributeRequest {
        AttributeRequest { follows: true, ..AttributeRequest::positions_of(reading) }
    }

    /// The same request, which also selects the particles' radii if the file has any.
    pub(crate) fn and_radius(self) -> AttributeRequest {
        AttributeRequest { selected: Some(AttributeSelection::Named(vec!["radius".to_owned()])), ..self }
    }

    /// Whether the particles' own radii are required.
    pub(crate) fn uses_radii(&self) -> bool {
        self.needed.iter().any(|needed| needed.is_length)
    }

    /// Whether only the positions of the chosen particles are needed.
    pub fn is_empty(&self) -> bool {
        self.needed.is_empty() && self.selected.is_none() && !self.follows && !self.keeps_all
    }

    /// Selects the requested attributes of a file, with warnings.
    ///
    /// # Errors
    /// If a required attribute is missing or unusable.
    pub(crate) fn select(
        &self,
        attributes: Vec<FileAttribute>,
    ) -> Result<(Vec<Attribute>, Vec<Warning>), String> {
        let headers = attributes.iter().map(header).collect();
        let mut attributes: Vec<Option<FileAttribute>> = attributes.into_iter().map(Some).collect();
        self.select_with(headers, |index| attributes.get_mut(index).and_then(Option::take), OptionName::flag)
    }

    /// Like [`select`](Self::select), for attributes that need not be in memory: `headers` are without
    /// values, and `load` returns the attribute with this index. Loads only those that are requested, and
    /// those of the condition. Errors name options in this spelling.
    ///
    /// # Errors
    /// If a required attribute is missing or unusable.
    pub(crate) fn select_with(
        &self,
        headers: Vec<FileAttribute>,
        mut load: impl FnMut(usize) -> Option<FileAttribute>,
        spelled: fn(OptionName) -> String,
    ) -> Result<(Vec<Attribute>, Vec<Warning>), String> {
        if self.is_empty() && self.reading.filter.is_none() {
            return Ok((Vec::new(), Vec::new()));
        }
        let all: Vec<Attribute> = headers.into_iter().map(attribute).collect();
        let coordinates = coordinates(&all);
        let for_filter = match &self.reading.filter {
            Some(filter) => filter
                .needed(&[&all[..], &coordinates].concat())
                .map_err(|why| format!("{} \"{filter}\": {why}", spelled(OptionName::new("where"))))?,
            None => Vec::new(),
        };
        for needed in &self.needed {
            if find_attribute(&all, &needed.name, needed.arity).is_none() {
                return Err(needed.why_missing(&all, spelled));
            }
        }
        let named: &[String] = match &self.selected {
            Some(AttributeSelection::Named(names)) => names,
            _ => &[],
        };
        let mut warnings = Vec::new();
        let computed: Vec<ComputedAttribute> = ComputedAttribute::ALL
            .into_iter()
            .filter(|computed| computed.is_wanted(self.selected.as_ref(), &all))
            .collect();
        let is_known = |name: &String| {
            all.iter().any(|attribute| attribute.matches(name))
                || self.computes_velocities && Role::Velocity.has_name(name)
                || computed.iter().any(|computed| name.eq_ignore_ascii_case(computed.name()))
        };
        for name in named.iter().filter(|name| !is_known(name)) {
            let available: Vec<&str> = all.iter().map(|attribute| &*attribute.name).collect();
            let available = if available.is_empty() { "none".to_owned() } else { available.join(", ") };
            let warning = Warning::new(format!(
                "the particles have no attribute `{name}` for the surface; available: {available}"
            ));
            let is_velocity = Role::Velocity.has_name(name);
            let remedy = is_velocity.then(|| COMPUTED_VELOCITIES.to_owned());
            warnings.push(Warning { remedy, ..warning.about(name) });
        }
        // If a file has both `v` and `velocity`, `--attributes v` means the one with exactly that name.
        let has_own = |name: &String| all.iter().any(|attribute| attribute.name.eq_ignore_ascii_case(name));
        let is_named = |attribute: &Attribute| {
            named.iter().any(|name| {
                if has_own(name) {
                    attribute.name.eq_ignore_ascii_case(name)
                } else {
                    attribute.matches(name)
                }
            })
        };
        let is_all = self.selected == Some(AttributeSelection::All);
        let is_kept = |attribute: &Attribute| {
            let is_needed = self.needed.iter().any(|needed| needed.is(attribute));
            let is_followed = self.follows && matches!(attribute.role, Role::Id | Role::Velocity);
            let is_used = attribute.role == Role::Velocity
                && computed.iter().any(|computed| computed.needs_velocities());
            is_needed || is_all || self.keeps_all || is_followed || is_used || is_named(attribute)
        };
        let kept = (0..all.len()).filter(|index| is_kept(&all[*index]) || for_filter.contains(index));
        let kept: Vec<Attribute> = kept.filter_map(&mut load).map(attribute).collect();
        for needed in &self.needed {
            let found = find_attribute(&kept, &needed.name, needed.arity);
            if let Some(why) = found.and_then(|attribute| needed.why_useless(attribute, spelled)) {
                return Err(why);
            }
        }
        if !self.computes_velocities && find_attribute(&kept, "velocity", 3).is_none() {
            for attribute in computed.iter().filter(|computed| computed.needs_velocities()) {
                let name = attribute.name();
                let sentence = format!("`{name}` is not computed: the particles have no velocities");
                warnings.push(Warning::new(sentence).about(name).with_remedy(COMPUTED_VELOCITIES));
            }
        }
        if let Some(RequiredAttribute { option, .. }) = self.needed.iter().find(|needed| needed.is_id)
            && ids_of(&kept).is_none()
        {
            return Err(format!(
                "the ids of the particles are not whole numbers, which {} needs",
                spelled(*option)
            ));
        }
        Ok((kept, warnings))
    }

    /// Whether to transfer the particles' velocities to the surface; `name` is their name in the file.
    pub(crate) fn has_velocity(&self, name: &str) -> bool {
        match &self.selected {
            None => false,
            Some(AttributeSelection::All) => true,
            Some(AttributeSelection::Named(selected)) => selected.iter().any(|selected| {
                let mut names = aliases(AttributeRole::Velocity).iter().copied().chain([name]);
                names.any(|name| selected.eq_ignore_ascii_case(name))
            }),
        }
    }

    /// Whether to transfer this attribute to the surface.
    pub fn is_selected(&self, attribute: &Attribute) -> bool {
        self.selected.as_ref().is_some_and(|selection| selection.selects(attribute))
    }
}

/// The attribute without its values.
pub(super) fn header(attribute: &FileAttribute) -> FileAttribute {
    let values = match &attribute.values {
        Values::F32(_) => Values::F32(Vec::new()),
        Values::F64(_) => Values::F64(Vec::new()),
        Values::U8(_) => Values::U8(Vec::new()),
        Values::I32(_) => Values::I32(Vec::new()),
        Values::I64(_) => Values::I64(Vec::new()),
        Values::Strings { .. } => Values::Strings { table: Vec::new(), indices: Vec::new() },
    };
    FileAttribute { name: attribute.name.clone(), values, ..*attribute }
}

/// Converts a file's attribute for the method: 32-bit floats, colours from 0 to 1, and ids as integers, which some
/// programs write as floats.
pub(super) fn attribute(attribute: FileAttribute) -> Attribute {
    let FileAttribute { name, arity, role, values } = attribute;
    let is_rest = matches!(&*name, "rest" | "rest2") && arity == 3;
    let surface_role = match role {
        Some(AttributeRole::Velocity) => Role::Velocity,
        Some(AttributeRole::Acceleration) => Role::Acceleration,
        Some(AttributeRole::Color) => Role::Color,
        Some(AttributeRole::Radius) => Role::Radius,
        Some(AttributeRole::Id) => Role::Id,
        None if is_rest => Role::Rest,
        Some(AttributeRole::TextureCoordinates) => Role::TextureCoordinates,
        Some(AttributeRole::Normal | AttributeRole::Density | AttributeRole::Mass | AttributeRole::Kind)
        | None => Role::Other,
    };
    if surface_role == Role::Id
        && let Some(ids) = whole_numbers(&values)
    {
        return Attribute { name, role: surface_role, arity, values: AttributeValues::Integers(ids) };
    }
    let is_color = surface_role == Role::Color;
    let values = match values {
        Values::F32(values) => AttributeValues::Numbers(values),
        Values::F64(values) => {
            AttributeValues::Numbers(values.into_iter().map(|value| value as f32).collect())
        }
        Values::U8(values) if is_color => {
            AttributeValues::Numbers(values.into_iter().map(|value| f32::from(value) / 255.0).collect())
        }
        Values::U8(values) => AttributeValues::Integers(values.into_iter().map(i64::from).collect()),
        Values::I32(values) => AttributeValues::Integers(values.into_iter().map(i64::from).collect()),
        Values::I64(values) => AttributeValues::Integers(values),
        Values::Strings { table, indices } => AttributeValues::Strings { table: Arc::from(table), indices },
    };
    Attribute { name, role: surface_role, arity, values }
}

/// Up to these, 2²⁴ and 2⁵³, all integers are exact as floats.
const EXACT_F32: f64 = 16_777_216.0;
const EXACT_F64: f64 = 9_007_199_254_740_992.0;

/// Floats as integers, if all of them are whole and exact.
fn whole_numbers(values: &Values) -> Option<Vec<i64>> {
    let whole =
        |value: f64, exact: f64| (value.fract() == 0.0 && value.abs() <= exact).then_some(value as i64);
    match values {
        Values::F32(values) => values.iter().map(|&value| whole(value.into(), EXACT_F32)).collect(),
        Values::F64(values) => values.iter().map(|&value| whole(value, EXACT_F64)).collect(),
        Values::U8(_) | Values::I32(_) | Values::I64(_) | Values::Strings { .. } => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::surface::options::MethodOptions;

    fn file_attribute(
        name: &str,
        role: Option<AttributeRole>,
        arity: usize,
        values: Values,
    ) -> FileAttribute {
        FileAttribute { name: name.to_owned(), arity, role, values }
    }

    fn two_particles() -> Vec<FileAttribute> {
        vec![
            file_attribute(
                "vel",
                Some(AttributeRole::Velocity),
                3,
                Values::F64(vec![1.0, 2.0, 3.0, -1.0, 0.0, 0.5]),
            ),
            file_attribute("rgb", Some(AttributeRole::Color), 3, Values::U8(vec![255, 0, 51, 0, 0, 0])),
            file_attribute("pscale", Some(AttributeRole::Radius), 1, Values::F32(vec![0.5, 1.0])),
            file_attribute("Kind", None, 1, Values::I32(vec![7, -1])),
        ]
    }

    fn wanted(choices: MethodOptions) -> AttributeRequest {
        AttributeRequest::for_settings(&Settings::paper(1.0, &choices).expect("sound"))
    }

    /// The method does not depend on file formats, so it has its own list of names, which must match the
    /// readers' list.
    #[test]
    fn names_of_velocities_and_colors_match_the_readers() {
        for (role, surface_role) in
            [(AttributeRole::Velocity, Role::Velocity), (AttributeRole::Color, Role::Color)]
        {
            let values = AttributeValues::Numbers(vec![0.0; 3]);
            let attribute = Attribute { name: "some name".to_owned(), role: surface_role, arity: 3, values };
            for alias in aliases(role) {
                assert!(attribute.matches(alias) && attribute.matches(&alias.to_uppercase()), "{alias}");
            }
        }
    }

    #[test]
    fn selected_attribute_is_found_under_any_of_its_names() {
        let named = |names: &[&str]| {
            let names = names.iter().map(|&name| name.to_owned()).collect();
            wanted(MethodOptions {
                attributes: Some(AttributeSelection::Named(names)),
                ..MethodOptions::default()
            })
        };
        let kept = |wanted: &AttributeRequest| -> Vec<String> {
            let (kept, _) = wanted.select(two_particles()).expect("nothing is needed");
            kept.into_iter().map(|attribute| attribute.name).collect()
        };
        assert_eq!(kept(&wanted(MethodOptions::default())), [""; 0]);
        assert_eq!(kept(&named(&["velocity", "kind"])), ["vel", "Kind"]);
        assert_eq!(kept(&named(&["Cd", "VEL"])), ["vel", "rgb"]);
        let all =
            wanted(MethodOptions { attributes: Some(AttributeSelection::All), ..MethodOptions::default() });
        assert_eq!(kept(&all), ["vel", "rgb", "pscale", "Kind"]);
        let (_, missing) = named(&["heat"]).select(two_particles()).expect("nothing is needed");
        let missing = missing[0].to_string();
        assert!(missing.contains("`heat`") && missing.contains("vel, rgb, pscale, Kind"), "{missing}");
        // What is computed needs velocities.
        assert_eq!(kept(&named(&["speed", "Vorticity"])), ["vel"]);
        assert_eq!(kept(&named(&["normal_curvature"])), [""; 0]);
    }

    #[test]
    fn missing_or_unusable_required_attribute_is_an_error() {
        let by_radius = |name: &str| {
            wanted(MethodOptions { radius_attribute: Some(name.to_owned()), ..MethodOptions::default() })
        };
        let (kept, _) = by_radius("radius").select(two_particles()).expect("there");
        assert_eq!(kept.len(), 1);
        assert_eq!(kept[0].values, AttributeValues::Numbers(vec![0.5, 1.0]));
        // An integer is a valid radius, a colour is not.
        assert!(by_radius("Kind").select(two_particles()).is_ok());
        let error = by_radius("rgb").select(two_particles()).expect_err("three numbers");
        assert!(error.contains("`rgb` has 3 numbers") && error.contains("needs one number"), "{error}");
        let error = by_radius("kind").select(vec![file_attribute(
            "kind",
            None,
            1,
            Values::Strings { table: vec!["a".to_owned()], indices: vec![0] },
        )]);
        assert!(error.expect_err("words").contains("`kind` is text"));
        let useless = |values: &[f32]| {
            let radii =
                file_attribute("pscale", Some(AttributeRole::Radius), 1, Values::F32(values.to_vec()));
            by_radius("radius").select(vec![radii])
        };
        let error = useless(&[0.0, -1.0, f32::NAN, f32::INFINITY]).expect_err("no radius");
        assert!(error.contains("`pscale` has no positive value") && error.contains("--radius-attribute"));
        // One positive value is enough; without particles none is needed.
        assert!(useless(&[0.0, 0.5]).is_ok() && useless(&[]).is_ok());
        let error = by_radius("size").select(two_particles()).expect_err("not there");
        assert!(error.contains("`size`") && error.contains("--radius-attribute"), "{error}");
    }

    #[test]
    fn values_are_converted_for_the_method() {
        let all =
            wanted(MethodOptions { attributes: Some(AttributeSelection::All), ..MethodOptions::default() });
        let (kept, _) = all.select(two_particles()).expect("nothing is needed");
        assert_eq!(kept[1].values, AttributeValues::Numbers(vec![1.0, 0.0, 0.2, 0.0, 0.0, 0.0]));
        assert_eq!(kept[3].values, AttributeValues::Integers(vec![7, -1]));
    }
}
