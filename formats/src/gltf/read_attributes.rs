//! Reads the vertex attributes of a glTF file, except positions and normals.

use std::collections::BTreeSet;

use ::gltf::Semantic;
use serde_json::Value;

use super::buffer::Buffers;
use super::chunks::{chunks, parse};
use super::frame_file::{ACCELERATION, COLOR, VELOCITY};
use super::read::{OpenDocument, open};
use crate::data::{AttributeRole, FileAttribute, Values};
use crate::error::{Error, Result};
use crate::limits::Limits;

use super::FORMAT;

/// Reads the attributes of all meshes, with their names in the file, except positions and normals. Joins the
/// values of several primitives if their attributes have the same name and type. Does not normalize integers.
///
/// # Errors
///
/// Those of [`super::read_mesh`].
pub fn read_attributes(bytes: &[u8], limits: &Limits) -> Result<Vec<FileAttribute>> {
    let OpenDocument { document, buffers, mut budget, .. } = open(bytes, limits, None)?;
    let mut found: Vec<FileAttribute> = Vec::new();
    for (semantic, accessor) in document.meshes().flat_map(|mesh| {
        mesh.primitives().flat_map(|primitive| primitive.attributes().collect::<Vec<_>>()).collect::<Vec<_>>()
    }) {
        let arity = accessor.dimensions().multiplicity();
        if matches!(semantic, Semantic::Positions | Semantic::Normals) || arity > ARITY_MAX {
            continue;
        }
        let bytes = (accessor.count() as u64).checked_mul(VALUE_BYTES * arity as u64);
        let left = bytes.and_then(|bytes| budget.checked_sub(bytes));
        budget =
            left.ok_or_else(|| Error::too_large(FORMAT, "the attributes take more memory than the limit"))?;
        let values = values_of(&buffers, &accessor)?;
        let name = semantic.to_string();
        let is_it = |other: &&mut FileAttribute| other.name == name && other.arity == arity;
        match found.iter_mut().find(is_it).map(|other| (&mut other.values, &values)) {
            Some((Values::F32(all), Values::F32(more))) => all.extend_from_slice(more),
            Some((Values::I64(all), Values::I64(more))) => all.extend_from_slice(more),
            _ => found.push(FileAttribute { role: role_of(&name, arity), name, arity, values }),
        }
    }
    Ok(found)
}

/// The names of the attributes of all meshes in alphabetical order, except positions and normals. Does not
/// read their values.
///
/// # Errors
///
/// [`Error::Invalid`] if the document is damaged.
pub fn read_attribute_names(bytes: &[u8]) -> Result<Vec<String>> {
    let (json, _) = chunks(bytes)?;
    let document: Value = parse(json)?;
    let mut names = BTreeSet::new();
    for mesh in document["meshes"].as_array().into_iter().flatten() {
        for primitive in mesh["primitives"].as_array().into_iter().flatten() {
            names.extend(primitive["attributes"].as_object().into_iter().flat_map(|all| all.keys()));
        }
    }
    Ok(names.into_iter().filter(|name| *name != "POSITION" && *name != "NORMAL").cloned().collect())
}

/// The largest arity that is read: that of a vector. Wider elements are matrices, which are skipped.
const ARITY_MAX: usize = 4;

/// Maximum memory per value, in bytes.
const VALUE_BYTES: u64 = 8;

fn role_of(name: &str, arity: usize) -> Option<AttributeRole> {
    match (name, arity) {
        (COLOR, 3 | 4) => Some(AttributeRole::Color),
        (VELOCITY, 3) => Some(AttributeRole::Velocity),
        (ACCELERATION, 3) => Some(AttributeRole::Acceleration),
        _ => None,
    }
}

fn values_of(buffers: &Buffers, accessor: &::gltf::Accessor) -> Result<Values> {
    use ::gltf::accessor::DataType;
    Ok(match accessor.data_type() {
        DataType::F32 => Values::F32(buffers.components::<f32>(accessor)?),
        DataType::I8 => integers(buffers.components::<i8>(accessor)?),
        DataType::U8 => integers(buffers.components::<u8>(accessor)?),
        DataType::I16 => integers(buffers.components::<i16>(accessor)?),
        DataType::U16 => integers(buffers.components::<u16>(accessor)?),
        DataType::U32 => integers(buffers.components::<u32>(accessor)?),
    })
}

fn integers<T: Into<i64>>(components: Vec<T>) -> Values {
    Values::I64(components.into_iter().map(Into::into).collect())
}
