//! What is known of each particle, or of each vertex, beside where it is.

use std::borrow::Cow;
use std::sync::Arc;

/// A named attribute of all particles, or of all vertices of a surface: velocities, colours, identities, anything.
#[derive(Clone, Debug, PartialEq)]
pub struct Attribute {
    /// Its name.
    pub name: String,
    /// What it is known to mean.
    pub meaning: Meaning,
    /// Values per particle, at least 1.
    pub arity: usize,
    /// `arity` values per particle, particle by particle.
    pub values: AttributeValues,
}

/// What an attribute means. Options find velocities and radii by it, whatever they are called.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Meaning {
    /// World units per second, arity 3.
    Velocity,
    /// Red, green and blue from 0 to 1 as the file has them, perhaps alpha: arity 3 or 4.
    Color,
    /// A radius in world units, arity 1.
    Radius,
    /// The identity of a particle over time, arity 1.
    Id,
    /// Something else.
    Other,
}

/// The values of an attribute, particle by particle. Numbers are averaged at the vertices; integers and strings are those of the
/// nearest particle.
#[derive(Clone, Debug, PartialEq)]
pub enum AttributeValues {
    /// Numbers that can be averaged.
    Numbers(Vec<f32>),
    /// Numbers that name something: identities, kinds, counts.
    Integers(Vec<i64>),
    /// Strings, as indices into a table; an index outside it means none.
    Strings {
        /// The distinct strings.
        table: Arc<[String]>,
        /// One index per value.
        indices: Vec<i32>,
    },
}

impl Attribute {
    /// Whether it has so many numbers for each particle.
    pub fn has_numbers(&self, arity: usize) -> bool {
        self.arity == arity && !matches!(self.values, AttributeValues::Strings { .. })
    }

    /// Whether it goes by this name: its own, whatever the case, or one of its meaning.
    pub fn is_called(&self, name: &str) -> bool {
        let is = |other: &&str| name.eq_ignore_ascii_case(other);
        is(&&*self.name) || self.meaning.names().iter().any(is)
    }
}

/// The attribute among these that goes by this name and has so many numbers for each particle: one whose own it is before
/// one that means it.
pub fn attribute_of<'a>(all: &'a [Attribute], name: &str, arity: usize) -> Option<&'a Attribute> {
    let fitting = || all.iter().filter(|attribute| attribute.has_numbers(arity));
    let own = fitting().find(|attribute| attribute.name == name);
    own.or_else(|| fitting().find(|attribute| attribute.is_called(name)))
}

impl Meaning {
    /// What users call it.
    fn names(self) -> &'static [&'static str] {
        match self {
            Meaning::Velocity => &["velocity", "velocities", "vel", "v"],
            Meaning::Color => &["color", "colour", "colors", "colours", "cd", "rgb", "rgba"],
            Meaning::Radius => &["radius", "pscale"],
            Meaning::Id => &["id"],
            Meaning::Other => &[],
        }
    }
}

impl AttributeValues {
    /// How many values there are.
    pub fn len(&self) -> usize {
        match self {
            AttributeValues::Numbers(values) => values.len(),
            AttributeValues::Integers(values) => values.len(),
            AttributeValues::Strings { indices, .. } => indices.len(),
        }
    }

    /// Whether there is none.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// The values as 32-bit numbers, if they are numbers.
    pub fn numbers(&self) -> Option<Cow<'_, [f32]>> {
        match self {
            AttributeValues::Numbers(values) => Some(Cow::Borrowed(values)),
            AttributeValues::Integers(values) => Some(values.iter().map(|&value| value as f32).collect()),
            AttributeValues::Strings { .. } => None,
        }
    }

    /// The memory that they take, in bytes.
    pub fn size_bytes(&self) -> usize {
        match self {
            AttributeValues::Numbers(values) => size_of_val(&**values),
            AttributeValues::Integers(values) => size_of_val(&**values),
            AttributeValues::Strings { indices, .. } => size_of_val(&**indices),
        }
    }
}
