//! Prepares particle attributes for writing, so that a reader gets back the same values.
//!
//! Readers halve the values of an attribute with the name of a diameter, and keep its name. Writers therefore
//! double these values: otherwise the next reader would halve them a second time. All other attributes are
//! written with their values and type unchanged.

use std::borrow::Cow;

use crate::columns::radius_scale;
use crate::data::{AttributeRole, FileAttribute, ParticleFrame, Values};
use crate::error::{Error, Position, Result};

/// Fails if an attribute does not have `arity` values for each particle.
pub(crate) fn check(frame: &ParticleFrame, format: &'static str) -> Result<()> {
    let count = frame.positions.len();
    for FileAttribute { name, arity, values, .. } in &frame.attributes {
        let found = crate::number::length(values);
        if *arity == 0 || count.checked_mul(*arity) != Some(found) {
            let what =
                format!("attribute {name} has {found} values for {count} particles with {arity} values each");
            return Err(Error::invalid(format, Position::File, what));
        }
    }
    Ok(())
}

/// The values of an attribute to write: doubled if its name is that of a diameter.
pub(crate) fn written(attribute: &FileAttribute) -> Cow<'_, Values> {
    let is_diameter = attribute.role == Some(AttributeRole::Radius) && radius_scale(&attribute.name) != 1.0;
    if !is_diameter {
        return Cow::Borrowed(&attribute.values);
    }
    let mut doubled = attribute.clone();
    doubled.scale(1.0 / radius_scale(&attribute.name));
    Cow::Owned(doubled.values)
}
