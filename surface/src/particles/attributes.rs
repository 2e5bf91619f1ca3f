//! Attributes: data of each particle or vertex besides its position.

use std::borrow::Cow;
use std::sync::Arc;

/// A named attribute of all particles, or of all vertices of a surface: velocities, colours, ids, anything.
#[derive(Clone, Debug, PartialEq)]
pub struct Attribute {
    /// Its name.
    pub name: String,
    /// Its semantic.
    pub role: Role,
    /// Values per particle, at least 1.
    pub arity: usize,
    /// `arity` values per particle, particle by particle.
    pub values: AttributeValues,
}

/// The semantic of an attribute. Options find velocities and radii by semantic, whatever the attribute's
/// name.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Role {
    /// World units per second, arity 3.
    Velocity,
    /// World units per second squared, arity 3.
    Acceleration,
    /// Red, green and blue from 0 to 1, optionally alpha, in the file's colour space: arity 3 or 4.
    Color,
    /// A radius in world units, arity 1.
    Radius,
    /// The id of a particle, constant over time, arity 1.
    Id,
    /// Anything else.
    Other,
}

/// The values of an attribute, particle by particle. At a vertex, numbers are averaged over particles;
/// integers and strings are those of the nearest particle.
#[derive(Clone, Debug, PartialEq)]
pub enum AttributeValues {
    /// Numbers that can be averaged.
    Numbers(Vec<f32>),
    /// Integers, which cannot be averaged: ids, types, counts.
    Integers(Vec<i64>),
    /// Strings, as indices into a table; an index outside the table means no string.
    Strings {
        /// The distinct strings.
        table: Arc<[String]>,
        /// One index per value.
        indices: Vec<i32>,
    },
}

impl Attribute {
    /// Whether the attribute has `arity` numbers per particle.
    pub fn has_numbers(&self, arity: usize) -> bool {
        self.arity == arity && !matches!(self.values, AttributeValues::Strings { .. })
    }

    /// Whether `name` refers to this attribute: its own name, ignoring case, or a name of its semantic.
    pub fn matches(&self, name: &str) -> bool {
        let is = |other: &&str| name.eq_ignore_ascii_case(other);
        is(&&*self.name) || self.role.names().iter().any(is)
    }
}

/// Finds the attribute that `name` refers to, with `arity` numbers per particle. An attribute with this name
/// takes precedence over one with this semantic.
pub fn find_attribute<'a>(all: &'a [Attribute], name: &str, arity: usize) -> Option<&'a Attribute> {
    let fitting = || all.iter().filter(|attribute| attribute.has_numbers(arity));
    let own = fitting().find(|attribute| attribute.name == name);
    own.or_else(|| fitting().find(|attribute| attribute.matches(name)))
}

/// Multiplies finite numbers by a factor. Products beyond the range of 32-bit numbers become its limit,
/// because files must contain finite numbers.
pub(crate) fn scale_numbers(values: &mut [f32], factor: f64) {
    for value in values {
        *value = (f64::from(*value) * factor).clamp(f32::MIN.into(), f32::MAX.into()) as f32;
    }
}

impl Role {
    /// The factor for values of this role if those of velocities are multiplied by `velocity_scale`: the unit
    /// of time changes, and not that of lengths.
    pub(crate) fn scale(self, velocity_scale: f64) -> f64 {
        match self {
            Role::Velocity => velocity_scale,
            Role::Acceleration => velocity_scale * velocity_scale,
            Role::Color | Role::Radius | Role::Id | Role::Other => 1.0,
        }
    }

    /// The names by which users refer to the semantic.
    fn names(self) -> &'static [&'static str] {
        match self {
            Role::Velocity => &["velocity", "velocities", "vel", "v"],
            Role::Acceleration => &["acceleration", "accelerations", "accel"],
            Role::Color => &["color", "colour", "colors", "colours", "cd", "rgb", "rgba"],
            Role::Radius => &["radius", "pscale"],
            Role::Id => &["id"],
            Role::Other => &[],
        }
    }
}

impl AttributeValues {
    /// The number of values.
    pub fn len(&self) -> usize {
        match self {
            AttributeValues::Numbers(values) => values.len(),
            AttributeValues::Integers(values) => values.len(),
            AttributeValues::Strings { indices, .. } => indices.len(),
        }
    }

    /// Whether it is empty.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// The values as 32-bit numbers, with integers converted; `None` for strings.
    pub fn numbers(&self) -> Option<Cow<'_, [f32]>> {
        match self {
            AttributeValues::Numbers(values) => Some(Cow::Borrowed(values)),
            AttributeValues::Integers(values) => Some(values.iter().map(|&value| value as f32).collect()),
            AttributeValues::Strings { .. } => None,
        }
    }

    /// Multiplies the values by a factor. Integers become 32-bit numbers; strings are unchanged.
    pub(crate) fn scale(&mut self, factor: f64) {
        if let AttributeValues::Integers(values) = self {
            *self = AttributeValues::Numbers(values.iter().map(|&value| value as f32).collect());
        }
        if let AttributeValues::Numbers(values) = self {
            scale_numbers(values, factor);
        }
    }

    /// The memory of the values, in bytes.
    pub fn size_bytes(&self) -> usize {
        match self {
            AttributeValues::Numbers(values) => size_of_val(&**values),
            AttributeValues::Integers(values) => size_of_val(&**values),
            AttributeValues::Strings { indices, .. } => size_of_val(&**indices),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn scaled_values_are_finite_numbers() {
        let mut integers = AttributeValues::Integers(vec![3, -2]);
        integers.scale(0.5);
        assert_eq!(integers, AttributeValues::Numbers(vec![1.5, -1.0]));
        let mut large = AttributeValues::Numbers(vec![1e30, -1e30, 0.0]);
        large.scale(1e18);
        assert_eq!(large, AttributeValues::Numbers(vec![f32::MAX, f32::MIN, 0.0]));
    }
}
