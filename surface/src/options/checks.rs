//! Checks of numbers and lengths, and how errors name them.

use super::SettingsError;
use super::length::{Length, LengthUnit};
use crate::words::significant;

/// The value, if it is positive and finite.
pub(super) fn positive(name: &str, value: f64) -> Result<f64, SettingsError> {
    require(value.is_finite() && value > 0.0, || {
        format!("the {name} is {value}; it must be a positive number")
    })?;
    Ok(value)
}

/// As [`positive`], for a length that was given as `given`, or has its default value.
pub(super) fn positive_length(name: &str, given: Option<Length>, value: f64) -> Result<f64, SettingsError> {
    require(value.is_finite() && value > 0.0, || {
        format!("the {}; it must be a positive number", stated(name, given, value))
    })?;
    Ok(value)
}

/// The name of a length and its value in world units, such as `offset 5h is 0.1`.
pub(super) fn stated(name: &str, given: Option<Length>, value: f64) -> String {
    match given.and_then(Length::world) {
        Some(typed) => format!("{name} is {typed}"),
        None => format!("{} is {}", named(name, given), significant(value)),
    }
}

/// The name of a length, followed by the length as typed if it has a unit.
pub(super) fn named(name: &str, given: Option<Length>) -> String {
    match given.filter(|length| length.unit != LengthUnit::World) {
        Some(length) => format!("{name} {length}"),
        None => name.to_owned(),
    }
}

/// An error with this message unless the condition holds.
pub(super) fn require(holds: bool, what: impl FnOnce() -> String) -> Result<(), SettingsError> {
    if holds { Ok(()) } else { Err(SettingsError::of_value(what())) }
}
