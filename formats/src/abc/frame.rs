//! Converts an archive with one frame to a `.glb` of the same mesh: sequences are assembled from `.glb`
//! files.

use std::borrow::Cow;

use crate::columns::role_of;
use crate::data::{AttributeRole, FileAttribute, MeshView, Values, VertexAttribute, VertexValues};
use crate::error::{Error, Position, Result};
use crate::gltf::{loss_notes, write_glb};
use crate::limits::Limits;
use crate::mesh_options::{MeshOptions, UpAxis};

use super::FORMAT;
use super::document::Pod;
use super::mesh::{Matrix, names, to_world};
use super::ogawa::{DATA, MAGIC, Reference};
use super::read::{MeshArchive, VELOCITY};

/// Whether a file that starts with these bytes is an archive.
pub fn is_archive(head: &[u8]) -> bool {
    head.starts_with(&MAGIC)
}

/// An attribute of the vertices.
struct FrameAttribute {
    name: String,
    role: Option<AttributeRole>,
    values: FrameValues,
}

enum FrameValues {
    Numbers(Vec<f32>),
    Integers(Vec<i64>),
    Strings { table: Vec<String>, indices: Vec<i32> },
}

impl FrameValues {
    fn len(&self) -> usize {
        match self {
            FrameValues::Numbers(values) => values.len(),
            FrameValues::Integers(values) => values.len(),
            FrameValues::Strings { indices, .. } => indices.len(),
        }
    }

    /// A lower bound of the size of the values in the file, in bytes.
    fn byte_count(&self) -> usize {
        match self {
            FrameValues::Strings { table, .. } => {
                4 * self.len() + table.iter().map(|text| text.len() + 1).sum::<usize>()
            }
            _ => 4 * self.len(),
        }
    }

    fn view(&self) -> VertexValues<'_> {
        match self {
            FrameValues::Numbers(values) => VertexValues::Numbers(values),
            FrameValues::Integers(values) => VertexValues::Integers(values),
            FrameValues::Strings { table, indices } => VertexValues::Strings { table, indices },
        }
    }
}

/// Converts an archive with one frame to a `.glb`. Also returns notes on attributes that a `.glb` does not
/// hold exactly. Frees owned bytes before it makes the `.glb`, so that the two are not in memory at once.
///
/// # Errors
///
/// Those of [`super::read_mesh`] and of [`write_glb`].
pub fn to_glb<'a>(bytes: impl Into<Cow<'a, [u8]>>, limits: &Limits) -> Result<(Vec<u8>, Vec<String>)> {
    let bytes = bytes.into();
    let byte_count = bytes.len();
    let archive = MeshArchive::open(&bytes)?;
    archive.check_single_frame()?;
    let [positions, normals] = archive.vertices(0, limits)?;
    let triangles = archive.triangles(0, positions.len())?;
    let (up, origin) = placement(&archive.matrix(0)?)?;
    let attributes = attributes(&archive, limits)?;
    let provenance = archive.provenance;
    drop(bytes);
    let count = positions.len().max(1);
    let views: Vec<VertexAttribute> = attributes
        .iter()
        .map(|FrameAttribute { name, role, values }| {
            // The writer refuses lengths that do not match.
            let arity = values.len().div_ceil(count).max(1);
            VertexAttribute { name, role: *role, arity, values: values.view() }
        })
        .collect();
    let mesh = MeshView {
        positions: &positions,
        normals: &normals,
        triangles: &triangles,
        origin,
        attributes: if positions.is_empty() { &[] } else { &views },
    };
    // It has about as many bytes. A vector that grows would need up to twice as many.
    let mut glb = Vec::with_capacity(byte_count);
    write_glb(&mesh, &MeshOptions { up, ..MeshOptions::default() }, &provenance, &mut glb)?;
    Ok((glb, loss_notes(mesh.attributes)))
}

/// Reads the vertex attributes of an archive with one frame, except normals, under their own names.
///
/// # Errors
///
/// Those of [`super::read_mesh`].
pub fn read_attributes(bytes: &[u8], limits: &Limits) -> Result<Vec<FileAttribute>> {
    let archive = MeshArchive::open(bytes)?;
    archive.check_single_frame()?;
    let vertices = archive.vertices(0, limits)?[0].len();
    let attribute = |FrameAttribute { name, role, values }: FrameAttribute| {
        let arity = values.len().div_ceil(vertices.max(1)).max(1);
        if values.len() != vertices * arity {
            let what = format!("{name} has {} values for {vertices} vertices", values.len());
            return Err(Error::invalid(FORMAT, Position::File, what));
        }
        let values = match values {
            FrameValues::Numbers(values) => Values::F32(values),
            FrameValues::Integers(values) => Values::I64(values),
            FrameValues::Strings { table, indices } => Values::Strings { table, indices },
        };
        Ok(FileAttribute { name, arity, role, values })
    };
    attributes(&archive, limits)?.into_iter().map(attribute).collect()
}

const NOT_OURS: &str =
    "this .abc was not written by meniscus, or was changed: use the .abc files of the frames";

/// The up axis and the origin from which [`to_world`] computes this transform.
fn placement(matrix: &Matrix) -> Result<(UpAxis, [f64; 3])> {
    let [x, y, z, _] = matrix[3];
    for (up, origin) in [(UpAxis::Y, [x, y, z]), (UpAxis::Z, [x, 0.0 - z, y])] {
        if to_world(up, origin) == *matrix {
            return Ok((up, origin));
        }
    }
    Err(Error::invalid(FORMAT, Position::File, NOT_OURS))
}

fn attributes(archive: &MeshArchive, limits: &Limits) -> Result<Vec<FrameAttribute>> {
    let mut attributes = Vec::new();
    if archive.has(names::VELOCITIES) {
        let values = archive.array::<4>(names::VELOCITIES, (Pod::F32, 3), 0)?;
        attributes.push(FrameAttribute {
            name: VELOCITY.to_owned(),
            role: Some(AttributeRole::Velocity),
            values: FrameValues::Numbers(values.iter().map(|bytes| f32::from_le_bytes(*bytes)).collect()),
        });
    }
    let mut byte_count = 0;
    for (header, reference) in &archive.params()? {
        let values = match header.pod() {
            None => strings(archive, *reference, limits)?,
            Some(pod) => numbers(archive, &header.name, pod, *reference)?,
        };
        byte_count += values.byte_count();
        if byte_count > archive.container.bytes.len() {
            return Err(Error::invalid(FORMAT, Position::Offset(*reference), NOT_OURS));
        }
        let is_color = header.metadata.contains(";interpretation=rgb");
        let role = match header.check_type((Pod::F32, 3)) {
            _ if is_color => Some(AttributeRole::Color),
            // The archive does not record this role, but the name has it.
            Ok(()) => role_of(&header.name, 3).filter(|role| *role == AttributeRole::Acceleration),
            Err(_) => None,
        };
        attributes.push(FrameAttribute { name: header.name.clone(), role, values });
    }
    Ok(attributes)
}

fn numbers(archive: &MeshArchive, name: &str, pod: u32, reference: Reference) -> Result<FrameValues> {
    let samples = archive.container.group(reference, name)?;
    let sample = samples.first().copied().unwrap_or(DATA);
    let (bytes, at) = archive.container.sample(sample, name)?;
    let (words, wide) = (bytes.as_chunks::<4>().0.iter(), bytes.as_chunks::<8>().0.iter());
    match pod {
        pod if pod == Pod::F32 as u32 => {
            Ok(FrameValues::Numbers(words.map(|bytes| f32::from_le_bytes(*bytes)).collect()))
        }
        pod if pod == Pod::I32 as u32 => {
            Ok(FrameValues::Integers(words.map(|bytes| i32::from_le_bytes(*bytes).into()).collect()))
        }
        pod if pod == Pod::I64 as u32 => {
            Ok(FrameValues::Integers(wide.map(|bytes| i64::from_le_bytes(*bytes)).collect()))
        }
        _ => Err(Error::invalid(FORMAT, Position::Offset(at), NOT_OURS)),
    }
}

/// The table of strings, and the index of each value. The last string of the file marks missing values: it is
/// removed, and its index becomes −1.
fn strings(archive: &MeshArchive, compound: Reference, limits: &Limits) -> Result<FrameValues> {
    let properties = archive.container.properties(compound)?;
    let bytes = |name: &str| -> Result<&[u8]> {
        let found = properties.iter().find(|(header, _)| header.name == name);
        let (_, reference) = found.ok_or_else(|| {
            Error::invalid(FORMAT, Position::Offset(compound), format!("an attribute has no {name}"))
        })?;
        let samples = archive.container.group(*reference, name)?;
        let sample = samples.first().copied().unwrap_or(DATA);
        Ok(archive.container.sample(sample, name)?.0)
    };
    let text = bytes(".vals")?;
    // A string takes more memory than in the file, where an empty one is a single byte.
    let count = text.iter().filter(|byte| **byte == 0).count() + 1;
    let needed = (count * size_of::<String>()).saturating_add(text.len());
    limits.check_decompressed(FORMAT, needed as u64, archive.container.bytes.len() as u64)?;
    let text = String::from_utf8_lossy(text);
    let mut table: Vec<String> = text.split_terminator('\0').map(str::to_owned).collect();
    table.pop();
    let index = |bytes: &[u8; 4]| {
        let index = u32::from_le_bytes(*bytes);
        i32::try_from(index).ok().filter(|index| (*index as usize) < table.len()).unwrap_or(-1)
    };
    let indices = bytes(".indices")?.as_chunks::<4>().0.iter().map(index).collect();
    Ok(FrameValues::Strings { table, indices })
}
