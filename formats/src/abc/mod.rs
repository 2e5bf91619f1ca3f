//! Alembic, `.abc`: writes meshes of one frame or of a sequence; reads Points as particles, and meshes.
//!
//! ```text
//!   archive ── surface: Xform ── surfaceShape: PolyMesh
//!      │ └─ surface_spray: Xform ── surface_sprayShape: Points     in a sequence with points beside its meshes
//!      └ metadata: provenance
//! ```
//!
//! The Alembic library defines the format. It stores an archive in a container called Ogawa; the older
//! container, HDF5, is only recognised. The number of vertices and faces of a mesh may change from sample to
//! sample. Programs compute the motion blur of such a mesh from its velocities, in units per second.

mod archive;
mod digest;
pub(crate) mod document;
pub(crate) mod mesh;
mod points;
mod read;
mod scene;
#[cfg(test)]
mod tests;

use std::io::Write;

pub(crate) use archive::HDF5;
pub(crate) use points::read_own_points;
pub use points::read_points;
pub use read::{read_mesh, read_sample, read_sequence_info, read_times};

use crate::core::columns::role_of;
use crate::core::data::{
    AttributeRole, FileAttribute, MeshView, ParticleFrame, Provenance, Values, VertexAttribute, VertexValues,
};
use crate::core::error::{Error, Position, Result};
use crate::core::limits::Limits;
use crate::core::matrix::Matrix;
use crate::core::narrow_points::{NarrowPoints, not_finite_notes};
use crate::core::number::write_pieces;
use crate::core::options::{MeshOptions, UpAxis, WriteOption};
use crate::core::placed_mesh::{PlacedMesh, StoredMesh};
use crate::core::provenance::are_points;
use crate::core::row::{Content, FormatRow, Integrity, MeshEncoder, MeshWriter, OutputRow, ParticleReader};
use crate::core::vertex_attributes::{
    Purpose, UsedNames, check_quads, faces, plain_name, purposes, quad_count, string_index,
};
use document::{AbcObject, AbcProperty, MAGIC, Ogawa, Pod, StoredSample, Times, write_archive};
use mesh::{
    FrameSamples, MeshSamples, POINTS, ParamType, PointSamples, bounds, bounds_sample, names, points_object,
    real_sample, to_world, triangle_samples,
};
use read::{SampledMesh, bytes_declared, check_single_frame, own_head, own_mesh, read_provenance};
use scene::{Geometry, Scene};

/// The format's name in errors.
pub(crate) const FORMAT: &str = "Alembic";

/// The row in the table of formats.
pub(crate) static ROW: OutputRow = OutputRow {
    format: FormatRow {
        signatures: &[&document::MAGIC],
        particles: Some(ParticleReader::container(points::READER)),
        read_mesh: Some(|bytes, limits, _| read_mesh(bytes, limits)),
        ..FormatRow::new(FORMAT, &["abc"])
    },
    help: "Alembic: positions, normals, velocities, attributes",
    content: Content::Mesh(MeshWriter { attribute_notes, ..MeshWriter::new(MeshEncoder::Stream(write)) }),
    write_particles: None,
    has_attributes: true,
    options: &[WriteOption::Quads, WriteOption::Up],
    read_provenance,
    integrity: Integrity::Length(|head, _| bytes_declared(head)),
};

// Writes the mesh of one frame. Each vertex attribute becomes a property, which has the attribute's name
// except for velocities:
//
//   velocity   .velocities, units per second        colour     rgb or rgba
//   floats     as many numbers per vertex           integers   32 bits, or 64 if a value needs them
//   strings    the distinct strings, and indices

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
    let objects = |ogawa: &mut Ogawa| Ok(vec![object(mesh, options, &names, ogawa)?]);
    write_archive(provenance, &Times::Static, objects, out)
}

/// Fails if indices do not fit into 31 bits.
pub(crate) fn check_vertex_count(count: u64) -> Result<()> {
    if count <= 1 << 31 {
        return Ok(());
    }
    let what =
        format!("the mesh has {count} vertices; the limit is 2³¹: write .ply, or use a larger voxel size");
    Err(Error::too_large(FORMAT, what))
}

/// The names of the attributes; empty for velocities and texture coordinates, which have properties of their own.
pub(crate) fn names_of(attributes: &[VertexAttribute]) -> Vec<String> {
    let mut used = UsedNames::new(&[]);
    let name = |(attribute, purpose): (&VertexAttribute, Purpose)| match purpose {
        Purpose::Velocity | Purpose::Texture => String::new(),
        Purpose::Acceleration | Purpose::Color(_) | Purpose::Other => used.take(&plain_name(attribute.name)),
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
    let (texture, params);
    let are_wide = are_wide(mesh.attributes);
    (frame.velocities, texture, params) = attribute_samples(mesh.attributes, names, &are_wide, ogawa)?;
    let mut samples = MeshSamples::at(to_world(options.up, mesh.origin));
    samples.push(frame);
    samples.object(texture, params, ogawa)
}

/// For each attribute, whether it has integers that need 64 bits.
pub(crate) fn are_wide(attributes: &[VertexAttribute]) -> Vec<bool> {
    let is_wide = |attribute: &VertexAttribute| match attribute.values {
        VertexValues::Integers(values) => values.iter().any(|&value| i32::try_from(value).is_err()),
        VertexValues::Numbers(_) | VertexValues::Strings { .. } => false,
    };
    attributes.iter().map(is_wide).collect()
}

/// The velocities, the texture coordinates, and the other attributes under these names.
fn attribute_samples(
    attributes: &[VertexAttribute],
    names: &[String],
    are_wide: &[bool],
    ogawa: &mut Ogawa,
) -> Result<(Option<StoredSample>, Option<AbcProperty>, Vec<AbcProperty>)> {
    let (mut velocities, mut texture, mut params) = (None, None, Vec::new());
    for (((attribute, purpose), name), is_wide) in
        attributes.iter().zip(purposes(attributes)).zip(names).zip(are_wide)
    {
        match (purpose, attribute.values) {
            (Purpose::Velocity, VertexValues::Numbers(values)) => {
                velocities = Some(real_sample(values, (values.len() as u64 / 3, 3), ogawa)?);
            }
            (Purpose::Texture, VertexValues::Numbers(values)) => {
                texture = Some(reals(names::TEXTURE, ParamType::numbers(2), values, ogawa)?);
            }
            (Purpose::Color(values), _) => {
                params.push(reals(name, ParamType::color(attribute.arity), values, ogawa)?);
            }
            (_, VertexValues::Numbers(values)) => {
                params.push(reals(name, ParamType::numbers(attribute.arity), values, ogawa)?);
            }
            (_, VertexValues::Integers(values)) => {
                params.push(integers(name, attribute.arity, (values, *is_wide), ogawa)?);
            }
            (_, VertexValues::Strings { table, indices }) => {
                params.push(strings(name, attribute.arity, (table, indices), ogawa)?);
            }
        }
    }
    Ok((velocities, texture, params))
}

// Writes points. Ids, velocities and widths have properties of their own in the schema, which requires ids: without
// any, points are numbered.

/// Writes particles as an archive with one sample.
///
/// # Errors
///
/// [`Error::Io`] if `out` fails; [`Error::Invalid`] if an attribute has the wrong number of values, or a position is not
/// finite.
pub fn write_particles(
    frame: &ParticleFrame,
    options: &MeshOptions,
    provenance: &Provenance,
    out: &mut dyn Write,
) -> Result<()> {
    let points = NarrowPoints::of(frame, FORMAT)?;
    let others = points.others();
    let (names, are_wide) = (names_of(&others), are_wide(&others));
    let matrix = to_world(options.up, points.origin);
    let objects = |ogawa: &mut Ogawa| {
        let geometry = point_geometry(&points, &names, &are_wide, ogawa)?;
        Ok(vec![points_object(POINTS, &matrix, geometry, ogawa)?])
    };
    write_archive(provenance, &Times::Static, objects, out)
}

/// The properties of points, with a sample of each. The attributes other than ids and widths get these names.
pub(crate) fn point_geometry(
    points: &NarrowPoints,
    names: &[String],
    are_wide: &[bool],
    ogawa: &mut Ogawa,
) -> Result<Vec<AbcProperty>> {
    let count = points.positions.len() as u64;
    let bounds = bounds_sample(bounds(&points.positions), ogawa)?;
    let positions = real_sample(points.positions.as_flattened(), (count, 3), ogawa)?;
    let ids = ogawa.sample(count, 8 * count, &mut |out| match &points.ids {
        Some(ids) => write_pieces(ids, i64::to_le_bytes, out),
        None => write_pieces(&(0..count).collect::<Vec<u64>>(), u64::to_le_bytes, out),
    })?;
    let widths = points.widths.as_ref().map(|widths| real_sample(widths, (count, 1), ogawa)).transpose()?;
    let (velocities, _, params) = attribute_samples(&points.others(), names, are_wide, ogawa)?;
    Ok(PointSamples { bounds, positions, ids, velocities, widths }.properties(params))
}

/// Notes on attributes that a file does not hold exactly.
pub fn particle_notes(frame: &ParticleFrame) -> Vec<String> {
    let points = NarrowPoints::of(frame, FORMAT);
    let of_attributes = points.map(|points| attribute_notes(&points.others())).unwrap_or_default();
    of_attributes.into_iter().chain(not_finite_notes(frame, "abc")).collect()
}

fn reals(name: &str, kind: ParamType, values: &[f32], ogawa: &mut Ogawa) -> Result<AbcProperty> {
    let extent = usize::from(kind.extent);
    let sample = real_sample(values, ((values.len() / extent) as u64, extent as u64), ogawa)?;
    Ok(kind.property(name, vec![sample]))
}

fn integers(
    name: &str,
    arity: usize,
    (values, is_wide): (&[i64], bool),
    ogawa: &mut Ogawa,
) -> Result<AbcProperty> {
    let count = values.len() as u64;
    if is_wide {
        let sample =
            ogawa.sample(count, 8 * count, &mut |out| write_pieces(values, i64::to_le_bytes, out))?;
        return Ok(ParamType::many(Pod::I64, arity).property(name, vec![sample]));
    }
    let narrow = |value: i64| {
        let [a, b, c, d, ..] = value.to_le_bytes();
        [a, b, c, d]
    };
    let sample = ogawa.sample(count, 4 * count, &mut |out| write_pieces(values, narrow, out))?;
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
    let indices = ogawa.sample(count, 4 * count, &mut |out| write_pieces(indices, index_of, out))?;
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
) -> Result<[StoredSample; 2]> {
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

// Reads the mesh of an archive of this crate.

/// Whether a file that starts with these bytes is an archive.
pub fn is_archive(head: &[u8]) -> bool {
    head.starts_with(&MAGIC)
}

/// Reads the mesh of an archive of this crate with one frame, as it is stored.
///
/// # Errors
///
/// Those of [`read_mesh`].
pub(crate) fn read_stored(bytes: &[u8], limits: &Limits) -> Result<StoredMesh> {
    let scene = Scene::open(&bytes, limits)?;
    let mesh = own_mesh(&scene)?;
    check_single_frame(&scene, limits)?;
    let SampledMesh { positions, normals, triangles } = SampledMesh::read(&scene, mesh, None)?;
    limits.check_particles(FORMAT, positions.len() as u64)?;
    if normals.len() != positions.len() {
        return Err(Error::invalid(FORMAT, Position::File, NOT_OURS));
    }
    let (up, origin) = placement(&scene.world(mesh, None)?)?;
    let attributes = frame_attributes(&scene, mesh, positions.len())?;
    let provenance = own_head(bytes).unwrap_or_default();
    let [positions, normals] = [positions, normals].map(Vec::into_flattened);
    Ok(StoredMesh { mesh: PlacedMesh { positions, normals, triangles, origin, attributes }, up, provenance })
}

/// Reads the vertex attributes of an archive of this crate with one frame, except normals, under their own
/// names. Returns none for archives of other programs.
///
/// # Errors
///
/// Those of [`read_mesh`].
pub fn read_attributes(bytes: &[u8], limits: &Limits) -> Result<Vec<FileAttribute>> {
    if own_head(bytes).is_none() {
        return Ok(Vec::new());
    }
    let scene = Scene::open(&bytes, limits)?;
    let mesh = own_mesh(&scene)?;
    check_single_frame(&scene, limits)?;
    let vertices = scene::vectors(&scene, mesh.required(names::POSITIONS)?, 0)?.len();
    let attributes = frame_attributes(&scene, mesh, vertices)?;
    match attributes.iter().find(|attribute| attribute.values.len() != vertices * attribute.arity) {
        None => Ok(attributes),
        Some(FileAttribute { name, values, .. }) => {
            let what = format!("{name} has {} values for {vertices} vertices", values.len());
            Err(Error::invalid(FORMAT, Position::File, what))
        }
    }
}

/// Whether a file that starts with these bytes is an archive of this crate with a mesh.
pub(crate) fn is_own_mesh(head: &[u8]) -> bool {
    is_archive(head) && own_head(head).is_some_and(|recorded| !are_points(&recorded))
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

/// The attributes of the vertices. Their arity is rounded up: the caller refuses lengths that do not match.
fn frame_attributes(scene: &Scene, mesh: &Geometry, vertex_count: usize) -> Result<Vec<FileAttribute>> {
    let mut attributes = Vec::new();
    let mut push = |name: String, role, values: Values| {
        let arity = values.len().div_ceil(vertex_count.max(1)).max(1);
        attributes.push(FileAttribute { name, arity, role, values });
    };
    if let Some(velocities) = mesh.property(names::VELOCITIES) {
        let values = scene::vectors(scene, velocities, 0)?.into_flattened();
        push(read::VELOCITY.to_owned(), Some(AttributeRole::Velocity), Values::F32(values));
    }
    if let Some(texture) = mesh.property(names::TEXTURE) {
        let (_, values) = scene.archive.param(texture, None)?;
        push(names::TEXTURE.to_owned(), Some(AttributeRole::TextureCoordinates), values);
    }
    let params = mesh.property(names::PARAMS).map(|params| scene.archive.compound(params)).transpose()?;
    for property in params.unwrap_or_default() {
        let values = match scene.archive.param(&property, None)?.1 {
            Values::I32(values) => Values::I64(values.into_iter().map(i64::from).collect()),
            // The last string of the file marks missing values.
            Values::Strings { mut table, mut indices } => {
                table.pop();
                let missing = i32::try_from(table.len()).unwrap_or(i32::MAX);
                indices.iter_mut().filter(|index| **index >= missing).for_each(|index| *index = -1);
                Values::Strings { table, indices }
            }
            values @ (Values::F32(_) | Values::I64(_)) => values,
            _ => return Err(Error::invalid(FORMAT, Position::File, NOT_OURS)),
        };
        let is_color = property.metadata.contains(";interpretation=rgb");
        let role = match (property.pod(), property.extent()) {
            _ if is_color => Some(AttributeRole::Color),
            // The archive does not record this role, but the name has it.
            (Some(pod), 3) if pod == Pod::F32 as u32 => {
                role_of(&property.name, 3).filter(|role| *role == AttributeRole::Acceleration)
            }
            _ => None,
        };
        push(property.name, role, values);
    }
    Ok(attributes)
}
