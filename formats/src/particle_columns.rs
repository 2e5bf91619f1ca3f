//! Attributes of particles as they are to be written, so that whoever reads them has what was read.
//!
//! A reader halves diameters, and keeps their name: under that name they are doubled again, or they would be halved
//! twice. All else is written with the values and the type that it has.

use std::borrow::Cow;

use crate::columns::radius_scale;
use crate::data::{Attribute, ParticleFrame, Role, Values};
use crate::error::{Error, Place, Result};

/// Refuses a frame that no file can hold: attributes that have not `arity` values for each particle.
pub(crate) fn check(frame: &ParticleFrame, format: &'static str) -> Result<()> {
    let count = frame.positions.len();
    for Attribute { name, arity, values, .. } in &frame.attributes {
        let found = crate::number::length(values);
        if *arity == 0 || count.checked_mul(*arity) != Some(found) {
            let what = format!("{found} values of {name} for {count} particles of {arity} each");
            return Err(Error::invalid(format, Place::File, what));
        }
    }
    Ok(())
}

/// The values of an attribute as its name promises them.
pub(crate) fn written(attribute: &Attribute) -> Cow<'_, Values> {
    let is_diameter = attribute.role == Some(Role::Radius) && radius_scale(&attribute.name) != 1.0;
    if !is_diameter {
        return Cow::Borrowed(&attribute.values);
    }
    let mut doubled = attribute.clone();
    doubled.scale(1.0 / radius_scale(&attribute.name));
    Cow::Owned(doubled.values)
}
