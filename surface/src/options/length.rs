//! Lengths as users write them: `0.05`, `0.6d`, `5h`.

use std::fmt;
use std::str::FromStr;

use super::fields::{OptionValue, ValueKind};
use crate::words::rounded_to_digits;

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
