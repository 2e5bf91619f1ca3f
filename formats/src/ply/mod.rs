//! PLY, the Stanford polygon format: a text header that declares tables, then the tables.
//!
//! ```text
//!   ply
//!   format binary_little_endian 1.0       or ascii, or binary_big_endian
//!   element vertex 12000                  the particles; elements before are skipped,
//!   property float x                      elements after are ignored
//!   ...
//!   end_header
//!   x y z vx vy vz id | x y z vx ..       packed records, or one line each
//! ```
//!
//! The format does not define the meaning of properties; [`crate::core::columns`] recognises it by their names.
//! Positions and attributes keep the precision of the file. Integer types that [`crate::Values`] lacks become
//! the next wider type. A colour of 16-bit integers has the range 0..=65535.
//!
//! This work is based on:
//! Greg Turk. The PLY polygon file format. 1994

mod ascii;
mod header;
mod rows;
pub mod write;

use std::sync::Arc;

pub use header::{Element, Encoding, PlyHeader, Property, PropertyType, read_header};
pub use write::{attribute_notes, particle_notes, write_particles};

use crate::core::batches::Records;
use crate::core::bytes::Endian;
use crate::core::columns::{Columns, Group};
use crate::core::data::{AttributeRole, FileAttribute, FilePositions, MeshData, ParticleFrame, Values};
use crate::core::error::{Error, Position, Result};
use crate::core::limits::Limits;
use crate::core::number::NumberType;
use crate::core::provenance::from_comments;
use crate::core::records::{RecordLayout, Slots, Target, gather, gather_part};
use crate::core::row::{
    Completeness, Content, FormatRow, HeadCheck, Integrity, MeshEncoder, MeshWriter, OutputRow,
    ParticleReader, ParticleWriter,
};
use crate::core::text::{excerpt, excerpts, surplus_note};
use crate::core::times::may_be_time;
use rows::{RecordReader, checked_binary_count, checked_count, rows_of, scalar_offsets};

/// The format's name in errors.
const FORMAT: &str = "PLY";

/// The row in the table of formats.
pub(crate) static ROW: OutputRow = OutputRow {
    format: FormatRow {
        signatures: &[b"ply\n", b"ply\r", b"ply ", b"ply\t", b"ply\x0c"],
        beginnings: &[b"ply\n", b"ply\r"],
        particles: Some(ParticleReader {
            completeness,
            find_records: Some(|head, file_bytes, _, limits| {
                let header = read_header(head, limits)?;
                Ok(records(&header, file_bytes, limits))
            }),
            ..ParticleReader::new(read)
        }),
        read_mesh: Some(|bytes, limits, _| read_mesh(bytes, limits)),
        ..FormatRow::new(FORMAT, &["ply"])
    },
    help: "Binary PLY",
    content: Content::Mesh(MeshWriter {
        attribute_notes,
        ..MeshWriter::new(MeshEncoder::Stream(|mesh, _, provenance, out| {
            write::write_mesh(mesh, provenance, out)
        }))
    }),
    write_particles: Some(ParticleWriter { write: write_particles, notes: particle_notes }),
    has_attributes: true,
    options: &[],
    read_provenance: |head| Ok(from_comments(head, "comment ")),
    integrity: Integrity::Length(|head, _| mesh_bytes_declared(head, &Limits::default())),
};

/// The completeness of a file according to its header.
fn completeness(head: &[u8], file_bytes: u64) -> Result<HeadCheck> {
    let header = read_header(head, &Limits::default())?;
    let Some(declared) = header.file_size_min() else { return Ok(HeadCheck::Known(Completeness::Unknown)) };
    Ok(HeadCheck::Known(match header.encoding {
        _ if declared == header.body_offset as u64 => Completeness::Unknown,
        Encoding::Ascii if declared <= file_bytes => return Ok(HeadCheck::NeedsLastByte),
        Encoding::Ascii => Completeness::of_minimum_size(declared, file_bytes, Completeness::NeedsReading),
        _ if header.elements.iter().any(Element::has_list) => {
            Completeness::of_minimum_size(declared, file_bytes, Completeness::NeedsReading)
        }
        _ => Completeness::of_exact_size(declared, file_bytes),
    }))
}

// Reads a PLY file as a frame of particles.

/// Reads the vertices of a PLY file as particles, with all their scalar properties.
///
/// # Errors
/// `Truncated` if the file ends too early; `Invalid` if it is malformed or has no positions; `TooLarge`
/// beyond the limits.
pub fn read(bytes: &[u8], limits: &Limits) -> Result<ParticleFrame> {
    let header = read_header(bytes, limits)?;
    let mut frame = read_vertices(bytes, &header, limits)?;
    frame.notes.extend(notes_on_file(&header, bytes.len() as u64));
    Ok(frame)
}

/// Reads the vertices of the file with this header.
fn read_vertices(bytes: &[u8], header: &PlyHeader, limits: &Limits) -> Result<ParticleFrame> {
    let VertexElement { element, columns, position } = vertices(header)?;
    let rows = rows_of(bytes, header, element)?;
    let count = checked_count(&rows, element)?;
    limits.check_particles(FORMAT, count as u64)?;

    let mut frame = empty_frame(element, &columns, position, count);
    let targets = targets(element, &columns, position, &mut frame);
    let (offsets, stride) = scalar_offsets(element);
    let layout = |endian| RecordLayout { stride, offsets: &offsets, endian };
    match rows {
        RecordReader::Ascii(lines) => ascii::read(lines, element, count, targets)?,
        RecordReader::Binary(cursor) if element.has_list() => {
            let layout = layout(cursor.endian());
            gather(&rows::without_lists(&mut RecordReader::Binary(cursor), element, count)?, layout, targets);
        }
        RecordReader::Binary(mut cursor) => {
            gather(cursor.take(count * stride, &element.name)?, layout(cursor.endian()), targets);
        }
    }
    scale_groups(&mut frame, &columns);
    frame.notes = notes(element, &columns);
    Ok(frame)
}

/// The particles in binary records without lists, read on the current thread.
fn frame_of_records(header: &PlyHeader, records: &[u8], endian: Endian) -> Result<ParticleFrame> {
    let VertexElement { element, columns, position } = vertices(header)?;
    let (offsets, stride) = scalar_offsets(element);
    let mut frame = empty_frame(element, &columns, position, records.len() / stride);
    let mut targets = targets(element, &columns, position, &mut frame);
    gather_part(records, RecordLayout { stride, offsets: &offsets, endian }, &mut targets);
    scale_groups(&mut frame, &columns);
    Ok(frame)
}

fn scale_groups(frame: &mut ParticleFrame, columns: &Columns) {
    for (attribute, group) in frame.attributes.iter_mut().zip(&columns.groups) {
        attribute.values.scale(group.scale);
    }
}

/// The element with the particles.
struct VertexElement<'a> {
    element: &'a Element,
    columns: Columns,
    /// The properties of the position.
    position: [usize; 3],
}

/// Finds the particles in the header.
fn vertices(header: &PlyHeader) -> Result<VertexElement<'_>> {
    let element = header.vertex_element().ok_or_else(|| {
        Error::invalid(FORMAT, Position::File, "no element is named `vertex` or has properties x, y and z")
    })?;
    let columns = element.columns();
    let position = columns.position.ok_or_else(|| no_position(element))?;
    Ok(VertexElement { element, columns, position })
}

fn no_position(element: &Element) -> Error {
    let names = excerpts(element.properties.iter().map(|property| &property.name));
    let what = format!(
        "element `{}` has no properties x, y and z (or px, pos_x and the like); found: {names}",
        excerpt(&element.name),
    );
    Error::invalid(FORMAT, Position::File, what)
}

/// A frame with space for all values. The caller has compared `count` with the remaining bytes.
fn empty_frame(element: &Element, columns: &Columns, position: [usize; 3], count: usize) -> ParticleFrame {
    let positions = if fits_f32(position.map(|column| scalar_of(element, column))) {
        FilePositions::F32(vec![[0.0; 3]; count])
    } else {
        FilePositions::F64(vec![[0.0; 3]; count])
    };
    let attributes = columns.groups.iter().map(|group| FileAttribute {
        name: group.name.clone(),
        arity: group.arity(),
        role: group.role,
        values: scalar_of(element, group.columns[0]).zeros(count * group.arity()),
    });
    ParticleFrame { positions, attributes: attributes.collect(), notes: Vec::new() }
}

/// Whether 32-bit floats can hold all values of these types.
fn fits_f32(scalars: [NumberType; 3]) -> bool {
    use NumberType::{F32, I8, I16, U8, U16};
    scalars.iter().all(|scalar| matches!(scalar, F32 | I8 | U8 | I16 | U16))
}

/// The type of a property that is not a list.
fn scalar_of(element: &Element, property: usize) -> NumberType {
    match element.properties[property].kind {
        PropertyType::Scalar(scalar) => scalar,
        PropertyType::List { item, .. } => item,
    }
}

/// The position and attributes of the frame as targets into which values are read.
fn targets<'a>(
    element: &Element,
    columns: &Columns,
    position: [usize; 3],
    frame: &'a mut ParticleFrame,
) -> Vec<Target<'a>> {
    let typed = |properties: &[usize]| {
        properties.iter().map(|&property| (property, scalar_of(element, property))).collect()
    };
    let mut targets = Vec::with_capacity(1 + columns.groups.len());
    let slots = Slots::of_positions(&mut frame.positions);
    targets.push(Target { columns: typed(&position), slots });
    for (group, attribute) in columns.groups.iter().zip(&mut frame.attributes) {
        let slots = Slots::of_values(&mut attribute.values);
        targets.push(Target { columns: typed(&group.columns), slots });
    }
    targets
}

/// Notes on what else a file of this size has: faces of a mesh, and bytes that its header does not declare.
fn notes_on_file(header: &PlyHeader, file_bytes: u64) -> impl Iterator<Item = String> {
    let mut faces = header.elements.iter().filter(|element| element.name.eq_ignore_ascii_case("face"));
    let faces = faces.next().filter(|faces| faces.count > 0).map(|faces| {
        format!("the file also has {} faces, which are ignored: only the vertices are read", faces.count)
    });
    // The size of text and of lists is not known from the header.
    let is_exact = header.encoding != Encoding::Ascii && !header.elements.iter().any(Element::has_list);
    let declared = header.file_size_min().filter(|_| is_exact);
    faces.into_iter().chain(declared.and_then(|declared| surplus_note(file_bytes, declared)))
}

/// Notes on how the vertices are read.
fn notes(element: &Element, columns: &Columns) -> Vec<String> {
    let mut notes = Vec::new();
    if !element.name.eq_ignore_ascii_case("vertex") {
        notes.push(format!(
            "no element is named `vertex`: the particles are read from `{}`",
            excerpt(&element.name)
        ));
    }
    let halved = |group: &&Group| group.scale != 1.0;
    for group in columns.groups.iter().filter(halved) {
        notes.push(format!("`{}` looks like a diameter: the radius is half of it", excerpt(&group.name)));
    }
    for property in &element.properties {
        if matches!(property.kind, PropertyType::List { .. }) {
            notes.push(format!("skipped the list `{}` of each vertex", excerpt(&property.name)));
        }
    }
    notes
}

// Reads the vertices and faces of a PLY file as a mesh.

/// Whether a PLY file is a mesh, by its header. Some programs declare zero faces for point clouds, so a file
/// with zero faces is a mesh only if it has zero vertices, too.
///
/// # Errors
/// Those of [`read_header`].
pub fn holds_mesh(bytes: &[u8], limits: &Limits) -> Result<bool> {
    let header = read_header(bytes, limits)?;
    let is_empty = |name: &str| {
        header.elements.iter().any(|element| element.name.eq_ignore_ascii_case(name) && element.count == 0)
    };
    Ok(header.has_faces() || is_empty("face") && is_empty("vertex"))
}

/// Reads vertices, normals and faces. Polygons with more than three corners become triangle fans.
///
/// # Errors
/// Those of [`self`]; `Unsupported` for triangle strips.
pub fn read_mesh(bytes: &[u8], limits: &Limits) -> Result<MeshData> {
    Ok(read_mesh_and_vertices(bytes, limits)?.0)
}

/// Reads the mesh, and its vertices with all scalar properties as a frame.
///
/// # Errors
/// Those of [`read_mesh`].
pub fn read_mesh_and_vertices(bytes: &[u8], limits: &Limits) -> Result<(MeshData, ParticleFrame)> {
    let header = read_header(bytes, limits)?;
    let frame = read_vertices(bytes, &header, limits)?;
    let mut mesh = MeshData { positions: frame.positions.clone().into_f64(), ..MeshData::default() };
    if let Some(normal) =
        frame.attributes.iter().find(|attribute| attribute.role == Some(AttributeRole::Normal))
    {
        mesh.normals = normals(&normal.values);
    }

    let named = |name: &str| header.elements.iter().find(|element| element.name.eq_ignore_ascii_case(name));
    if named("tristrips").is_some_and(|strips| strips.count > 0) {
        return Err(Error::unsupported(
            FORMAT,
            "triangle strips are not supported: save the mesh with faces",
        ));
    }
    if let Some(faces) = named("face") {
        let rows = rows_of(bytes, &header, faces)?;
        mesh.triangles = triangles(rows, faces, mesh.positions.len())?;
    }
    Ok((mesh, frame))
}

/// The size of a binary file with the header in `head`, if all of its lists are triangles, as in every file
/// that [`write::write_mesh`] writes; `None` for text, or beyond 2⁶⁴.
pub(crate) fn mesh_bytes_declared(head: &[u8], limits: &Limits) -> Result<Option<u64>> {
    let header = read_header(head, limits)?;
    let mut size = Some(header.body_offset as u64);
    for element in &header.elements {
        let items = element.properties.iter().map(|property| match property.kind {
            PropertyType::Scalar(_) => 0,
            PropertyType::List { item, .. } => 3 * item.size(),
        });
        let record = (element.record_size_min() + items.sum::<usize>()) as u64;
        let table = element.count.checked_mul(record);
        size = size.zip(table).and_then(|(size, table)| size.checked_add(table));
    }
    // If the body is empty, a truncated file may lack the header's line end.
    let is_ended = head.get(..header.body_offset).is_some_and(|header| header.ends_with(b"\n"));
    Ok(size.filter(|_| is_ended && header.encoding.endian().is_some()))
}

fn normals(values: &Values) -> Vec<[f32; 3]> {
    match values {
        Values::F32(values) => values.as_chunks().0.to_vec(),
        #[expect(clippy::cast_possible_truncation, reason = "directions need no more than 24 bits")]
        Values::F64(values) => values.as_chunks().0.iter().map(|n| n.map(|x: f64| x as f32)).collect(),
        _ => Vec::new(),
    }
}

fn triangles(mut rows: RecordReader<'_>, faces: &Element, vertex_count: usize) -> Result<Vec<[u32; 3]>> {
    let count = checked_count(&rows, faces)?;
    let is_list = |property: &&Property| matches!(property.kind, PropertyType::List { .. });
    let is_named =
        |property: &&Property| ["vertex_indices", "vertex_index"].contains(&property.name.as_str());
    let mut lists = faces.properties.iter().filter(is_list);
    let Some(corners) = lists.clone().find(is_named).or_else(|| lists.next()) else {
        return Ok(Vec::new());
    };
    let mut triangles = Vec::new();
    rows.begin(faces);
    for _ in 0..count {
        rows.start()?;
        for property in &faces.properties {
            match property.kind {
                PropertyType::List { count, item } if std::ptr::eq(property, corners) => {
                    let length = rows.list_length(count, property)?;
                    fan(&mut rows, item, length, vertex_count, &mut triangles)?;
                }
                _ => rows.skip(property)?,
            }
        }
        rows.finish()?;
    }
    Ok(triangles)
}

/// Reads a polygon and cuts it into triangles that share its first corner.
fn fan(
    rows: &mut RecordReader<'_>,
    item: NumberType,
    length: usize,
    vertex_count: usize,
    triangles: &mut Vec<[u32; 3]>,
) -> Result<()> {
    let (mut first, mut last) = (0, 0);
    for corner in 0..length {
        let index = rows.integer(item, "vertex_indices")?;
        let index =
            u32::try_from(index).ok().filter(|&index| (index as usize) < vertex_count).ok_or_else(|| {
                rows.invalid(format!(
                    "a face has vertex index {index}, but the file has {vertex_count} vertices"
                ))
            })?;
        match corner {
            0 => first = index,
            1 => {}
            _ => triangles.push([first, last, index]),
        }
        last = index;
    }
    Ok(())
}

// Locates the vertices of a binary PLY file, so that they can be read in batches.

/// Locates the vertices in a file of `file_bytes` bytes. `None` if their offsets cannot be computed: in an
/// ASCII file, or if the vertices or an earlier element have lists.
///
/// # Errors
/// Those of [`self`], after the header.
fn records(header: &PlyHeader, file_bytes: u64, limits: &Limits) -> Result<Option<Records>> {
    let VertexElement { element, columns, position } = vertices(header)?;
    let Some(endian) = header.encoding.endian() else { return Ok(None) };
    let earlier = || header.elements.iter().take_while(|earlier| !std::ptr::eq(*earlier, element));
    // Times are compared when the file is read as a whole.
    let may_join_frames = columns.groups.iter().any(|group| may_be_time(&group.name));
    if may_join_frames || element.has_list() || earlier().any(Element::has_list) {
        return Ok(None);
    }
    let mut at = header.body_offset as u64;
    for element in earlier() {
        let count = checked_binary_count(element, at, file_bytes - at)?;
        at += (count * element.record_size_min()) as u64;
    }
    let count = checked_binary_count(element, at, file_bytes - at)?;
    limits.check_particles(FORMAT, count as u64)?;
    let (offsets, stride) = scalar_offsets(element);
    let scalars = position.map(|property| scalar_of(element, property));
    let mut notes = notes(element, &columns);
    notes.extend(notes_on_file(header, file_bytes));
    let velocity = columns.groups.iter().find(|group| group.role == Some(AttributeRole::Velocity));
    let velocity = velocity.map(|group| group.name.clone());
    let offsets = position.map(|property| offsets[property]);
    let gather = Arc::new(move |records: &[u8], positions: &mut FilePositions| {
        let count = records.len() / stride;
        match (fits_f32(scalars), &mut *positions) {
            (true, FilePositions::F32(positions)) => positions.resize(count, [0.0; 3]),
            (true, FilePositions::F64(_)) => *positions = FilePositions::F32(vec![[0.0; 3]; count]),
            (false, FilePositions::F64(positions)) => positions.resize(count, [0.0; 3]),
            (false, FilePositions::F32(_)) => *positions = FilePositions::F64(vec![[0.0; 3]; count]),
        }
        let columns = scalars.into_iter().enumerate().collect();
        let target = Target { columns, slots: Slots::of_positions(positions) };
        gather_part(records, RecordLayout { stride, offsets: &offsets, endian }, &mut [target]);
    });
    let header = header.clone();
    let frame = Arc::new(move |records: &[u8]| frame_of_records(&header, records, endian));
    Ok(Some(Records { format: FORMAT, offset: at, stride, count, gather, frame, notes, velocity }))
}
