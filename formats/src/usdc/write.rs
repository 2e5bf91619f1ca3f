//! Writes the mesh of one frame.
//!
//! The file starts with the offset of its last part, the table of contents. So the sizes of all arrays must
//! be known, and all integers compressed, before the first byte is written. The compressed integers take
//! little memory compared with the vectors, which are written directly from the mesh.

use std::io::Write;

use rayon::prelude::*;

use crate::data::{MeshView, Provenance};
use crate::error::Result;
use crate::mesh_options::MeshOptions;
use crate::quads::{check_quads, quad_count};
use crate::usd::{FORMAT, LayerInfo, MeshProperty, PropertyValue, properties};
use crate::vertex_attributes::plain_name;

use super::array::CrateArray;
use super::layer::{LayerEnd, LayerHead, PropertySpec, SpecValue, head, padding};
use super::value::{ValueRep, ValueType};

/// Writes a mesh.
///
/// # Errors
///
/// [`crate::Error::Io`] if `out` fails; [`crate::Error::Invalid`] if the mesh is inconsistent or not finite,
/// or if two triangles marked as a quad do not form one; [`crate::Error::TooLarge`] beyond 2³¹ vertices.
pub(super) fn write(
    mesh: &MeshView,
    options: &MeshOptions,
    provenance: &Provenance,
    out: &mut impl Write,
) -> Result<()> {
    mesh.check(FORMAT)?;
    check_quads(FORMAT, mesh.triangles, &options.quads)?;
    let found = properties(mesh, &options.quads, true);
    let arrays: Vec<Option<CrateArray>> = found.par_iter().map(array_of).collect::<Result<_>>()?;

    let mut at = head(provenance, 0).len() as u64;
    let mut spans = Vec::new();
    for array in &arrays {
        let padding = padding(at);
        at += padding.len() as u64;
        spans.push((padding, at));
        at += array.as_ref().map_or(0, CrateArray::byte_count);
    }
    let mut end = LayerEnd::at(at);
    let mut specs = Vec::new();
    for ((property, array), (_, offset)) in found.iter().zip(&arrays).zip(&spans) {
        let value = match array {
            Some(array) => array.rep(*offset),
            None => value_of(property, &mut end)?,
        };
        specs.push(spec(property, value));
    }
    let layer = LayerHead {
        provenance,
        info: LayerInfo {
            vertices: mesh.positions.len() as u64,
            faces: (mesh.triangles.len() - quad_count(&options.quads)) as u64,
            frames: None,
        },
        up: options.up,
        meters_per_unit: options.meters_per_unit,
        times: None,
        prim: &plain_name(&options.name),
    };
    let (end, contents_at) = end.finish(&layer, &specs)?;
    out.write_all(&head(provenance, contents_at))?;
    for (array, (padding, _)) in arrays.iter().zip(spans) {
        out.write_all(padding)?;
        array.iter().try_for_each(|array| array.write(out))?;
    }
    Ok(out.write_all(&end)?)
}

/// The array of a property, if it has one that is written before the tables.
fn array_of<'a>(property: &MeshProperty<'a>) -> Result<Option<CrateArray<'a>>> {
    match property.value {
        PropertyValue::Array(elements) => CrateArray::of(elements).map(Some),
        _ => Ok(None),
    }
}

/// The value of a property that refers to tokens, or has only a few numbers.
fn value_of(property: &MeshProperty, end: &mut LayerEnd) -> Result<ValueRep> {
    match &property.value {
        PropertyValue::Array(elements) => end.array(&CrateArray::of(*elements)?),
        PropertyValue::Extent(corners) => end.array(&CrateArray::of_vectors(corners.as_flattened())),
        PropertyValue::Double3(values) => Ok(end.double3(*values)),
        PropertyValue::Token(word) => Ok(end.tables.token_value(word)),
        PropertyValue::TokenList(word) => {
            let words = [end.tables.token(word)];
            end.array(&CrateArray::of_indices(ValueType::Token, &words))
        }
        PropertyValue::Strings(table) => {
            let texts = table.iter().map(String::as_str).chain([""]);
            let indices: Vec<u32> = texts.map(|text| end.tables.string(text)).collect();
            end.array(&CrateArray::of_indices(ValueType::String, &indices))
        }
    }
}

fn spec(property: &MeshProperty, value: ValueRep) -> PropertySpec {
    PropertySpec {
        kind: property.kind.clone(),
        name: property.name.clone(),
        value: if property.is_uniform() { SpecValue::Always(value) } else { SpecValue::Frame(value) },
        is_uniform: property.is_uniform(),
        is_per_vertex: property.is_per_vertex,
        element_size: property.element_size,
    }
}
