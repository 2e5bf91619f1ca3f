//! Converts a file with one frame to a `.glb` of the same mesh: sequences are assembled from `.glb` files.

use std::borrow::Cow;

use crate::data::{AttributeRole, FileAttribute, MeshView, Values, VertexAttribute, VertexValues};
use crate::error::Result;
use crate::gltf::{ACCELERATION_NAME, COLOR_NAME, loss_notes, write_glb};
use crate::limits::Limits;
use crate::mesh_options::MeshOptions;

use super::contents::MAGIC;
use super::layer::read_provenance;
use super::read::{PlacedFrame, UsdcLayer};

/// Whether a file that starts with these bytes is binary USD.
pub fn is_layer(head: &[u8]) -> bool {
    head.starts_with(MAGIC)
}

/// Converts a file with one frame to a `.glb`. Also returns notes on attributes that a `.glb` does not
/// hold exactly. Frees owned bytes before it makes the `.glb`, so that the two are not in memory at once.
///
/// # Errors
///
/// Those of [`UsdcLayer::read`], [`UsdcLayer::frame`] and [`write_glb`]; [`crate::Error::Unsupported`] for a
/// sequence.
pub fn to_glb<'a>(bytes: impl Into<Cow<'a, [u8]>>, limits: &Limits) -> Result<(Vec<u8>, Vec<String>)> {
    let bytes = bytes.into();
    let byte_count = bytes.len();
    let layer = UsdcLayer::read(&bytes, limits)?;
    layer.check_single_frame()?;
    let PlacedFrame { points, normals, triangles, origin, mut attributes } = layer.placed_frame(0)?;
    let options = MeshOptions { up: layer.up()?, ..MeshOptions::default() };
    let provenance = read_provenance(&bytes)?;
    drop(bytes);
    merge_opacity(&mut attributes);
    attributes.iter_mut().for_each(convert_values);
    let views: Vec<VertexAttribute> = attributes.iter().filter_map(view).collect();
    let mesh = MeshView {
        positions: points.as_chunks().0,
        normals: normals.as_chunks().0,
        triangles: &triangles,
        origin,
        attributes: if points.is_empty() { &[] } else { &views },
    };
    // It has about as many bytes. A vector that grows would need up to twice as many.
    let mut glb = Vec::with_capacity(byte_count);
    write_glb(&mesh, &options, &provenance, &mut glb)?;
    Ok((glb, loss_notes(mesh.attributes)))
}

/// Makes the opacity the fourth value of the colour, as it was before it was written.
fn merge_opacity(attributes: &mut Vec<FileAttribute>) {
    let position = |name: &str, arity: usize| {
        attributes.iter().position(|attribute| attribute.name == name && attribute.arity == arity)
    };
    let Some((color, opacity)) = position("displayColor", 3).zip(position("displayOpacity", 1)) else {
        return;
    };
    let (Values::F32(colors), Values::F32(opacities)) =
        (&attributes[color].values, &attributes[opacity].values)
    else {
        return;
    };
    let pairs = colors.as_chunks::<3>().0.iter().zip(opacities);
    let values = pairs.flat_map(|(&[red, green, blue], &opacity)| [red, green, blue, opacity]).collect();
    attributes[color].arity = 4;
    attributes[color].values = Values::F32(values);
    attributes.remove(opacity);
}

/// Converts the values to a type of [`VertexValues`].
fn convert_values(attribute: &mut FileAttribute) {
    match &mut attribute.values {
        Values::I32(values) => {
            attribute.values = Values::I64(values.iter().map(|&value| value.into()).collect());
        }
        // The last string marks missing values. Without it, their index is outside the table.
        Values::Strings { table, .. } => drop(table.pop()),
        Values::F32(_) | Values::F64(_) | Values::U8(_) | Values::I64(_) => {}
    }
}

/// The attribute under its former name; `None` for types that no property of this crate has. Those of
/// colours and accelerations are not in the file, so they get the usual ones.
fn view(attribute: &FileAttribute) -> Option<VertexAttribute<'_>> {
    let FileAttribute { name, arity, role, values } = attribute;
    // USD writes an underscore before the digit of a name such as `2nd`.
    let without_underscore =
        name.strip_prefix('_').filter(|rest| rest.starts_with(|c: char| c.is_ascii_digit()));
    let name = match role {
        Some(AttributeRole::Color) => COLOR_NAME,
        Some(AttributeRole::Acceleration) => ACCELERATION_NAME,
        _ => without_underscore.unwrap_or(name),
    };
    let values = match values {
        Values::F32(values) => VertexValues::Numbers(values),
        Values::I64(values) => VertexValues::Integers(values),
        Values::Strings { table, indices } => VertexValues::Strings { table, indices },
        Values::F64(_) | Values::U8(_) | Values::I32(_) => return None,
    };
    Some(VertexAttribute { name, role: *role, arity: *arity, values })
}
