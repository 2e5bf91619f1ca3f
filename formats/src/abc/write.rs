//! Writes the mesh of one frame. Each vertex attribute becomes a property, which has the attribute's name
//! except for velocities:
//!
//! ```text
//!   velocity   .velocities, units per second        colour     rgb or rgba
//!   floats     as many numbers per vertex           integers   32 bits, or 64 if a value needs them
//!   strings    the distinct strings, and indices
//! ```

use std::io::Write;

use crate::data::{MeshView, Provenance, VertexAttribute, VertexValues};
use crate::error::{Error, Result};
use crate::le_bytes::write_pieces;
use crate::mesh_options::MeshOptions;
use crate::quads::{check_quads, faces, quad_count};
use crate::vertex_attributes::{Purpose, UsedNames, plain_name, purposes, string_index};

use super::FORMAT;
use super::document::{AbcObject, AbcProperty, Pod, Times, write_archive};
use super::mesh::{
    FrameSamples, MeshSamples, ParamType, bounds, bounds_sample, real_sample, to_world, triangle_samples,
};
use super::ogawa::{Ogawa, Sample};

/// Writes a mesh as an archive with one sample.
///
/// # Errors
///
/// [`Error::Io`] if `out` fails; [`Error::TooLarge`] for more than 2³¹ vertices; [`Error::Invalid`] if the
/// mesh is inconsistent or not finite, or if two triangles marked as a quad do not form one.
pub fn write(
    mesh: &MeshView,
    options: &MeshOptions,
    provenance: &Provenance,
    out: &mut dyn Write,
) -> Result<()> {
    mesh.check(FORMAT)?;
    check_quads(FORMAT, mesh.triangles, &options.quads)?;
    check_vertex_count(mesh.positions.len() as u64)?;
    let names = names_of(mesh.attributes);
    write_archive(provenance, &Times::Static, |ogawa| object(mesh, options, &names, ogawa), out)
}

/// Fails if indices do not fit into 31 bits.
pub(super) fn check_vertex_count(count: u64) -> Result<()> {
    if count <= 1 << 31 {
        return Ok(());
    }
    let what =
        format!("the mesh has {count} vertices; the limit is 2³¹: write .ply, or use a larger voxel size");
    Err(Error::too_large(FORMAT, what))
}

/// The names of the attributes; empty for velocities, which have a property of their own.
fn names_of(attributes: &[VertexAttribute]) -> Vec<String> {
    let mut used = UsedNames::new(&[]);
    let name = |(attribute, purpose): (&VertexAttribute, Purpose)| match purpose {
        Purpose::Velocity => String::new(),
        Purpose::Acceleration | Purpose::Color(_) | Purpose::Other => {
            used.take(&plain_name(attribute.name), |stem| vec![stem.to_owned()]).concat()
        }
    };
    attributes.iter().zip(purposes(attributes)).map(name).collect()
}

/// Notes on vertex attributes that a file does not hold exactly.
pub fn attribute_notes(attributes: &[VertexAttribute]) -> Vec<String> {
    let mut notes = Vec::new();
    for (attribute, name) in attributes.iter().zip(names_of(attributes)) {
        if !name.is_empty() && name != attribute.name {
            notes.push(format!("{} is named {name} in the .abc", attribute.name));
        }
        if let VertexValues::Strings { table, .. } = attribute.values
            && table.iter().any(|text| text.contains('\0'))
        {
            notes.push(format!("{}: the .abc stores null characters as spaces", attribute.name));
        }
    }
    notes
}

fn object(mesh: &MeshView, options: &MeshOptions, names: &[String], ogawa: &mut Ogawa) -> Result<AbcObject> {
    let vertices = mesh.positions.len() as u64;
    let faces = match quad_count(&options.quads) {
        0 => triangle_samples(mesh.triangles, mesh.triangles.len() as u64, ogawa)?,
        quad_count => polygon_samples(mesh.triangles, &options.quads, quad_count, ogawa)?,
    };
    let mut frame = FrameSamples {
        bounds: bounds_sample(bounds(mesh.positions), ogawa)?,
        positions: real_sample(mesh.positions.as_flattened(), (vertices, 3), ogawa)?,
        faces,
        normals: real_sample(mesh.normals.as_flattened(), (vertices, 3), ogawa)?,
        velocities: None,
    };
    let mut params = Vec::new();
    for ((attribute, purpose), name) in mesh.attributes.iter().zip(purposes(mesh.attributes)).zip(names) {
        match (purpose, attribute.values) {
            (Purpose::Velocity, VertexValues::Numbers(values)) => {
                frame.velocities = Some(real_sample(values, (vertices, 3), ogawa)?);
            }
            (Purpose::Color(values), _) => {
                params.push(reals(name, ParamType::color(attribute.arity), values, ogawa)?);
            }
            (_, VertexValues::Numbers(values)) => {
                params.push(reals(name, ParamType::numbers(attribute.arity), values, ogawa)?);
            }
            (_, VertexValues::Integers(values)) => {
                params.push(integers(name, attribute.arity, values, ogawa)?);
            }
            (_, VertexValues::Strings { table, indices }) => {
                params.push(strings(name, attribute.arity, (table, indices), ogawa)?);
            }
        }
    }
    let mut samples = MeshSamples::at(to_world(options.up, mesh.origin));
    samples.push(frame);
    samples.object(params, ogawa)
}

fn reals(name: &str, kind: ParamType, values: &[f32], ogawa: &mut Ogawa) -> Result<AbcProperty> {
    let extent = usize::from(kind.extent);
    let sample = real_sample(values, ((values.len() / extent) as u64, extent as u64), ogawa)?;
    Ok(kind.property(name, vec![sample]))
}

fn integers(name: &str, arity: usize, values: &[i64], ogawa: &mut Ogawa) -> Result<AbcProperty> {
    let count = values.len() as u64;
    if values.iter().any(|&value| i32::try_from(value).is_err()) {
        let sample = ogawa
            .sample(count, 8 * count, &mut |mut out| write_pieces(values, i64::to_le_bytes, &mut out))?;
        return Ok(ParamType::many(Pod::I64, arity).property(name, vec![sample]));
    }
    let narrow = |value: i64| {
        let [a, b, c, d, ..] = value.to_le_bytes();
        [a, b, c, d]
    };
    let sample = ogawa.sample(count, 4 * count, &mut |mut out| write_pieces(values, narrow, &mut out))?;
    Ok(ParamType::many(Pod::I32, arity).property(name, vec![sample]))
}

/// The distinct strings, with an empty one at the end for missing strings, and the index of each value.
fn strings(
    name: &str,
    arity: usize,
    (table, indices): (&[String], &[i32]),
    ogawa: &mut Ogawa,
) -> Result<AbcProperty> {
    let kind = ParamType::many(Pod::String, arity);
    // A null character ends a string, so null characters inside a string become spaces.
    let mut text: Vec<u8> = Vec::new();
    for string in table.iter().map(String::as_str).chain([""]) {
        text.extend(string.replace('\0', " ").as_bytes());
        text.push(0);
    }
    let string_count = table.len() as u64 + 1;
    let mut values = ogawa.small_sample(string_count, &text)?;
    values.dimensions = ogawa.data(&string_count.to_le_bytes())?;
    let index_of = |index: i32| {
        let index = u32::try_from(string_index(index, table)).unwrap_or(u32::MAX);
        (if index == u32::MAX { last_index(table) } else { index }).to_le_bytes()
    };
    let count = indices.len() as u64;
    let indices = ogawa.sample(count, 4 * count, &mut |mut out| write_pieces(indices, index_of, &mut out))?;
    let parts = vec![
        kind.property(".vals", vec![values]),
        AbcProperty::array(".indices", "", (Pod::U32, 1), vec![indices]),
    ];
    Ok(AbcProperty::compound(name, &kind.metadata(), parts))
}

/// The index of the empty string after the table.
#[expect(clippy::cast_possible_truncation, reason = "indices have 31 bits")]
fn last_index(table: &[String]) -> u32 {
    table.len() as u32
}

/// Number of triangles encoded at a time.
const PIECE: usize = 4096;

/// Writes the vertex indices of triangles and quads, in Alembic's order, and the number of corners of each
/// face.
fn polygon_samples(
    triangles: &[[u32; 3]],
    quads: &[bool],
    quad_count: usize,
    ogawa: &mut Ogawa,
) -> Result<[Sample; 2]> {
    let (triangle_count, quad_count) = (triangles.len() as u64, quad_count as u64);
    // A quad has four corners instead of the six of its two triangles.
    let (face_count, corner_count) = (triangle_count - quad_count, 3 * triangle_count - 2 * quad_count);
    let emit = |out: &mut dyn Write, put: &dyn Fn(&[u32], &mut Vec<u8>)| {
        let mut bytes = Vec::new();
        for start in (0..triangles.len()).step_by(PIECE) {
            bytes.clear();
            for face in faces(triangles, quads, start..(start + PIECE).min(triangles.len())) {
                put(face.corners(), &mut bytes);
            }
            out.write_all(&bytes)?;
        }
        Ok(())
    };
    let corners = ogawa.sample(corner_count, 4 * corner_count, &mut |out| {
        emit(out, &|corners, bytes| {
            bytes.extend(corners.iter().rev().flat_map(|corner| corner.to_le_bytes()))
        })
    })?;
    let counts = ogawa.sample(face_count, 4 * face_count, &mut |out| {
        emit(out, &|corners, bytes| bytes.extend(if corners.len() == 4 { 4i32 } else { 3 }.to_le_bytes()))
    })?;
    Ok([corners, counts])
}
