//! Values of options other than numbers and switches.

use std::fmt;
use std::str::FromStr;

use crate::contour::Contouring;
use crate::particles::{Attribute, ParticleFilter};
use crate::smooth::Integrator;
use crate::words::{Word, word_enum};

use super::fields::OptionValue;
use super::presets::Preset;

word_enum! {
    /// How particles are stretched (paper, Fig. 11).
    pub enum AnisotropyKind {
        /// Not at all: spheres
        None = "none",
        /// By the positions of the neighbours, as in Yu and Turk: flat in sheets, long in filaments
        Neighbors = "neighbors",
        /// By the velocity: long in its direction (paper, Eq. 16)
        Velocity = "velocity",
    }
}

/// Which attributes of the particles are interpolated to the surface.
#[derive(Clone, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(into = "String", try_from = "String")]
pub enum AttributeSelection {
    /// All of them.
    All,
    /// The attributes with these names or semantics. The list is not empty.
    Named(Vec<String>),
}

/// An axis-aligned box, world units. `min` is below `max` on each axis once the settings are resolved.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(into = "String", try_from = "String")]
pub struct ClipBox {
    /// Lower corner.
    pub min: [f64; 3],
    /// Upper corner.
    pub max: [f64; 3],
}

/// Values whose text `FromStr` parses, with messages for users.
macro_rules! option_values {
    ($($name:ident $(: $words:expr)?),+) => {$(
        impl OptionValue for $name {
            $(const WORDS: &'static [Word] = $words;)?

            fn parsed(text: &str) -> Result<$name, String> {
                text.parse()
            }
        }
    )+};
}
option_values!(
    Preset: Preset::WORDS, AnisotropyKind: AnisotropyKind::WORDS, Contouring: Contouring::WORDS,
    Integrator: Integrator::WORDS, AttributeSelection, ClipBox, ParticleFilter
);

impl AttributeSelection {
    /// Whether this attribute is selected.
    pub fn selects(&self, attribute: &Attribute) -> bool {
        match self {
            AttributeSelection::All => true,
            AttributeSelection::Named(names) => names.iter().any(|name| attribute.matches(name)),
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
            return Err(format!(
                "`{text}` is not a list of attributes: expected names such as velocity,Cd, or all"
            ));
        }
        if names.len() > 1 && names.iter().any(|name| name == "all") {
            return Err(format!(
                "`{text}` combines all with names: expected all alone, or only names such as velocity,Cd"
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
        let wanted =
            || format!("`{text}` is not a box: expected six numbers x0,y0,z0,x1,y1,z1, lower corner first");
        let numbers: Result<Vec<f64>, _> = text.split(',').map(|number| number.trim().parse()).collect();
        let [x, y, z, to_x, to_y, to_z] = numbers.map_err(|_| wanted())?[..] else { return Err(wanted()) };
        Ok(ClipBox { min: [x, y, z], max: [to_x, to_y, to_z] })
    }
}

/// Conversions to and from text, for serde.
macro_rules! as_text {
    ($($name:ident),+) => {$(
        impl From<$name> for String {
            fn from(value: $name) -> String {
                value.to_string()
            }
        }

        impl TryFrom<String> for $name {
            type Error = String;

            fn try_from(text: String) -> Result<$name, String> {
                text.parse()
            }
        }
    )+};
}
as_text!(AttributeSelection, ClipBox, ParticleFilter);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn boxes_and_lists_parse_or_are_rejected() {
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
            assert!(why.contains(text) && why.contains("combines all"), "{why}");
        }
    }
}
