//! Values of options other than numbers and switches.

use std::fmt;
use std::str::FromStr;

use super::fields::{OptionValue, ValueKind};
use super::presets::Preset;
use crate::contour::Contouring;
use crate::particles::{Attribute, ParticleFilter};
use crate::smooth::Integrator;
use crate::words::{Word, rounded_to_digits, word_enum};

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

/// New names for columns of tables: `x=centroid_x,y=centroid_y,z=centroid_z`.
#[derive(Clone, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(into = "String", try_from = "String")]
pub struct ColumnNames(Vec<(String, String)>);

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
    Integrator: Integrator::WORDS, AttributeSelection, ClipBox, ColumnNames, ParticleFilter
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

impl ColumnNames {
    /// Each new name, with the name or the number, from 1 on, of a column of the file. Not empty.
    pub fn pairs(&self) -> &[(String, String)] {
        &self.0
    }
}

impl fmt::Display for ColumnNames {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let pairs: Vec<String> = self.0.iter().map(|(new, column)| format!("{new}={column}")).collect();
        f.write_str(&pairs.join(","))
    }
}

impl FromStr for ColumnNames {
    type Err = String;

    fn from_str(text: &str) -> Result<ColumnNames, String> {
        let mut pairs: Vec<(String, String)> = Vec::new();
        for pair in text.split(',') {
            let (new, column) =
                pair.split_once('=').map_or(("", ""), |(new, column)| (new.trim(), column.trim()));
            if new.is_empty() || column.is_empty() {
                return Err(format!(
                    "`{text}` does not name columns: expected pairs of a new name and a column, by its name or its \
                     number from 1 on, such as x=centroid_x,y=centroid_y,z=3"
                ));
            }
            let twice = pairs.iter().find_map(|(other, one)| {
                if other == new {
                    Some(format!("the name `{new}`"))
                } else {
                    (one == column).then(|| format!("the column `{column}`"))
                }
            });
            if let Some(twice) = twice {
                return Err(format!("`{text}` has {twice} twice: expected one column for each name"));
            }
            pairs.push((new.to_owned(), column.to_owned()));
        }
        Ok(ColumnNames(pairs))
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
as_text!(AttributeSelection, ClipBox, ColumnNames, ParticleFilter);

// Lengths as users write them: `0.05`, `0.6d`, `5h`.

/// A length in one of the units that options take.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(into = "LengthText", try_from = "LengthText")]
pub struct Length {
    /// The number of units.
    pub value: f64,
    /// The unit.
    pub unit: LengthUnit,
}

/// The unit of a [`Length`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LengthUnit {
    /// The particles' unit of length.
    World,
    /// The particle spacing d.
    Spacing,
    /// The voxel size h.
    Voxel,
}

impl Length {
    /// The length in world units. `spacing` and `voxel_size` are in world units.
    pub fn resolve(self, spacing: f64, voxel_size: f64) -> f64 {
        match self.unit {
            LengthUnit::World => self.value,
            LengthUnit::Spacing => rounded_to_digits(self.value * spacing),
            LengthUnit::Voxel => rounded_to_digits(self.value * voxel_size),
        }
    }

    /// The number, if the unit is the world unit.
    pub fn world(self) -> Option<f64> {
        (self.unit == LengthUnit::World).then_some(self.value)
    }

    /// Parses a voxel size: every unit but the voxel is allowed.
    pub(super) fn parse_voxel_size(text: &str) -> Result<Length, String> {
        let length = text.parse().ok().filter(|length: &Length| length.unit != LengthUnit::Voxel);
        length.ok_or_else(|| {
            format!("`{text}` is not a voxel size: expected a number in world units, or of particle spacings such as 0.4d")
        })
    }

    /// Parses a length in world units.
    #[doc(hidden)]
    pub fn parse_world(text: &str) -> Result<f64, String> {
        text.trim()
            .parse()
            .map_err(|_| format!("`{text}` is not a number: expected a length in world units, such as 0.05"))
    }
}

/// A length in world units.
impl From<f64> for Length {
    fn from(value: f64) -> Length {
        Length { value, unit: LengthUnit::World }
    }
}

impl OptionValue for Length {
    const KIND: ValueKind = ValueKind::Length;

    fn parsed(text: &str) -> Result<Length, String> {
        text.parse()
    }
}

impl fmt::Display for Length {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let unit = match self.unit {
            LengthUnit::World => "",
            LengthUnit::Spacing => "d",
            LengthUnit::Voxel => "h",
        };
        write!(f, "{}{unit}", self.value)
    }
}

impl FromStr for Length {
    type Err = String;

    fn from_str(text: &str) -> Result<Length, String> {
        let text = text.trim();
        let (number, unit) = match (text.strip_suffix('d'), text.strip_suffix('h')) {
            (Some(number), _) => (number, LengthUnit::Spacing),
            (_, Some(number)) => (number, LengthUnit::Voxel),
            (None, None) => (text, LengthUnit::World),
        };
        let value = number.trim_end().parse().map_err(|_| {
            format!(
                "`{text}` is not a length: expected a number in world units, of particle spacings such as 0.6d, \
                 or of voxels such as 5h"
            )
        })?;
        Ok(Length { value, unit })
    }
}

/// A length in a file: world units are a number, other units are text.
#[derive(serde::Serialize, serde::Deserialize)]
#[serde(untagged)]
enum LengthText {
    Number(f64),
    Text(String),
}

impl From<Length> for LengthText {
    fn from(length: Length) -> LengthText {
        length.world().map_or_else(|| LengthText::Text(length.to_string()), LengthText::Number)
    }
}

impl TryFrom<LengthText> for Length {
    type Error = String;

    fn try_from(written: LengthText) -> Result<Length, String> {
        match written {
            LengthText::Number(value) => Ok(value.into()),
            LengthText::Text(text) => text.parse(),
        }
    }
}

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
        let columns: ColumnNames = "x=cx, y=cy,z = 3,id=p=1".parse().expect("columns");
        assert_eq!(columns.to_string(), "x=cx,y=cy,z=3,id=p=1");
        for text in ["", "x", "x=", "=cx", "x=1,,y=2", "x=1,x=2", "x=1,y=1"] {
            let why = text.parse::<ColumnNames>().expect_err(text);
            assert!(why.contains("`") && why.contains("expected"), "{why}");
        }
        assert_eq!("all".parse(), Ok(AttributeSelection::All));
        assert_eq!("v, id".parse(), Ok(AttributeSelection::Named(vec!["v".into(), "id".into()])));
        assert!("v,,id".parse::<AttributeSelection>().is_err());
        for text in ["all,age", "age, all", "all,all"] {
            let why = text.parse::<AttributeSelection>().expect_err(text);
            assert!(why.contains(text) && why.contains("combines all"), "{why}");
        }
    }

    #[test]
    fn lengths_parse_as_a_number_and_a_unit() {
        use LengthUnit::{Spacing, Voxel, World};
        for (text, value, unit, resolved) in [
            ("0.05", 0.05, World, 0.05),
            ("-1e-3", -1e-3, World, -1e-3),
            ("0.6d", 0.6, Spacing, 0.3),
            ("-0.3d", -0.3, Spacing, -0.15),
            ("5h", 5.0, Voxel, 1.0),
            (" 2 h ", 2.0, Voxel, 0.4),
        ] {
            let length: Length = text.parse().expect(text);
            assert_eq!(length, Length { value, unit });
            assert_eq!(length.resolve(0.5, 0.2), resolved);
            assert_eq!(length.to_string().parse(), Ok(length));
        }
        for text in ["", "d", "5x", "5 m", "5dh", "wide", "5 d h"] {
            let why = text.parse::<Length>().expect_err(text);
            assert!(why.contains("0.6d") && why.contains("5h"), "{why}");
        }
    }
}
