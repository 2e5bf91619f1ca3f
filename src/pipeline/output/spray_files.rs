//! Writes the points beside a surface.
//!
//! ```text
//!   positions │ spray_class │ spray_size │ spray_age │ radius │ the other attributes of the particles
//! ```

use std::io::Write;

use meniscus_formats::{
    AttributeRole, FileAttribute, FilePositions, MeshOptions, ParticleFrame, PointFormat, Values,
};

use crate::pipeline::output::writing::file_role;
use crate::pipeline::target::outputs::OutputOptions;
use crate::surface::particles::{Attribute, AttributeValues, OwnedPositions, Role};
use crate::surface::spray::{Spray, SprayClass};

/// The name of the attribute with the shape of each point's piece.
pub(crate) const SPRAY_CLASS: &str = "spray_class";

/// The points with their attributes, as in files.
pub fn points_of(spray: &Spray) -> ParticleFrame {
    let positions = match &spray.positions {
        OwnedPositions::F32(positions) => FilePositions::F32(positions.clone()),
        OwnedPositions::F64(positions) => FilePositions::F64(positions.clone()),
    };
    let own = |name: &str, role, values| FileAttribute { name: name.to_owned(), arity: 1, role, values };
    // As numbers: Blender's import of USD ignores the attributes after one of text.
    let index =
        |class: &SprayClass| SprayClass::ALL.iter().position(|other| other == class).unwrap_or(0) as i32;
    let count = |count: &u32| i32::try_from(*count).unwrap_or(i32::MAX);
    let mut attributes = vec![
        own(SPRAY_CLASS, None, Values::I32(spray.classes.iter().map(index).collect())),
        own("spray_size", None, Values::I32(spray.piece_sizes.iter().map(count).collect())),
    ];
    let ages = spray.ages.as_ref();
    attributes.extend(ages.map(|ages| own("spray_age", None, Values::I32(ages.iter().map(count).collect()))));
    attributes.push(own("radius", Some(AttributeRole::Radius), Values::F32(spray.radii.clone())));
    // Points that were read again have attributes of these names.
    let is_other = |attribute: &&Attribute| {
        attribute.role != Role::Radius && !attributes.iter().any(|own| own.name == attribute.name)
    };
    let others: Vec<FileAttribute> = spray.attributes.iter().filter(is_other).map(file_attribute).collect();
    attributes.extend(others);
    ParticleFrame { positions, attributes, notes: Vec::new() }
}

fn file_attribute(attribute: &Attribute) -> FileAttribute {
    let values = match &attribute.values {
        AttributeValues::Numbers(values) => Values::F32(values.clone()),
        AttributeValues::Integers(values) => Values::I64(values.clone()),
        AttributeValues::Strings { table, indices } => {
            Values::Strings { table: table.to_vec(), indices: indices.clone() }
        }
    };
    let (name, role) = (attribute.name.clone(), file_role(attribute.role));
    FileAttribute { name, arity: attribute.arity, role, values }
}

/// Writes points in one format.
///
/// # Errors
/// When the format cannot hold them, or the system reports an error.
pub(crate) fn write_points(
    points: &ParticleFrame,
    format: PointFormat,
    outputs: &OutputOptions,
    provenance: &[(String, String)],
    out: &mut impl Write,
) -> meniscus_formats::Result<()> {
    let time_samples = outputs.points_have_time_samples();
    let options = MeshOptions { time_samples, ..outputs.mesh(std::sync::Arc::default()) };
    format.write(points, &options, provenance, out)
}
