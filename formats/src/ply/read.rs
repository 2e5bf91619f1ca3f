//! Reads a PLY file as a frame of particles.

use crate::bytes::Endian;
use crate::columns::{Columns, Group};
use crate::data::{FileAttribute, FilePositions, ParticleFrame, Values};
use crate::error::{Error, Position, Result};
use crate::excerpt::{excerpt, excerpts};
use crate::limits::Limits;
use crate::scalar::Scalar;

use super::header::{Element, PlyHeader, PropertyType, read_header};
use super::rows::{RecordReader, check_limit, checked_count, rows_of};
use super::target::{Slots, Target};
use super::{FORMAT, ascii, binary};

/// Reads the vertices of a PLY file as particles, with all their scalar properties.
///
/// # Errors
/// `Truncated` if the file ends too early; `Invalid` if it is malformed or has no positions; `TooLarge`
/// beyond the limits.
pub fn read(bytes: &[u8], limits: &Limits) -> Result<ParticleFrame> {
    let header = read_header(bytes, limits)?;
    let mut frame = read_vertices(bytes, &header, limits)?;
    frame.notes.extend(note_on_faces(&header));
    Ok(frame)
}

/// Reads the vertices of the file with this header.
pub(super) fn read_vertices(bytes: &[u8], header: &PlyHeader, limits: &Limits) -> Result<ParticleFrame> {
    let VertexElement { element, columns, position } = vertices(header)?;
    let rows = rows_of(bytes, header, element)?;
    let count = checked_count(&rows, element)?;
    check_limit(count, limits)?;

    let mut frame = empty_frame(element, &columns, position, count);
    let targets = targets(element, &columns, position, &mut frame);
    let (offsets, stride) = binary::scalar_offsets(element);
    match rows {
        RecordReader::Ascii(lines) => ascii::read(lines, element, count, targets)?,
        RecordReader::Binary(cursor) if element.has_list() => {
            let endian = cursor.endian();
            let records = binary::without_lists(&mut RecordReader::Binary(cursor), element, count)?;
            binary::gather(&records, stride, &offsets, endian, targets);
        }
        RecordReader::Binary(mut cursor) => {
            let records = cursor.take(count * stride, &element.name)?;
            binary::gather(records, stride, &offsets, cursor.endian(), targets);
        }
    }
    scale_groups(&mut frame, &columns);
    frame.notes = notes(element, &columns);
    Ok(frame)
}

/// The particles in binary records without lists, read on the current thread.
pub(super) fn frame_of_records(header: &PlyHeader, records: &[u8], endian: Endian) -> Result<ParticleFrame> {
    let VertexElement { element, columns, position } = vertices(header)?;
    let (offsets, stride) = binary::scalar_offsets(element);
    let mut frame = empty_frame(element, &columns, position, records.len() / stride);
    let mut targets = targets(element, &columns, position, &mut frame);
    binary::gather_part(records, stride, &offsets, endian, &mut targets);
    scale_groups(&mut frame, &columns);
    Ok(frame)
}

fn scale_groups(frame: &mut ParticleFrame, columns: &Columns) {
    for (attribute, group) in frame.attributes.iter_mut().zip(&columns.groups) {
        attribute.scale(group.scale);
    }
}

/// The element with the particles.
pub(super) struct VertexElement<'a> {
    pub(super) element: &'a Element,
    pub(super) columns: Columns,
    /// The properties of the position.
    pub(super) position: [usize; 3],
}

/// Finds the particles in the header.
pub(super) fn vertices(header: &PlyHeader) -> Result<VertexElement<'_>> {
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
    let positions = match fits_f32(position.map(|column| scalar_of(element, column))) {
        true => FilePositions::F32(vec![[0.0; 3]; count]),
        false => FilePositions::F64(vec![[0.0; 3]; count]),
    };
    let attributes = columns.groups.iter().map(|group| FileAttribute {
        name: group.name.clone(),
        arity: group.arity(),
        role: group.role,
        values: empty_values(scalar_of(element, group.columns[0]), count * group.arity()),
    });
    ParticleFrame { positions, attributes: attributes.collect(), notes: Vec::new() }
}

/// Whether 32-bit floats can hold all values of these types.
pub(super) fn fits_f32(scalars: [Scalar; 3]) -> bool {
    use Scalar::{F32, I8, I16, U8, U16};
    scalars.iter().all(|scalar| matches!(scalar, F32 | I8 | U8 | I16 | U16))
}

fn empty_values(scalar: Scalar, length: usize) -> Values {
    match scalar {
        Scalar::U8 => Values::U8(vec![0; length]),
        Scalar::I8 | Scalar::I16 | Scalar::U16 | Scalar::I32 => Values::I32(vec![0; length]),
        Scalar::U32 => Values::I64(vec![0; length]),
        Scalar::F32 => Values::F32(vec![0.0; length]),
        Scalar::F64 => Values::F64(vec![0.0; length]),
    }
}

/// The type of a property that is not a list.
pub(super) fn scalar_of(element: &Element, property: usize) -> Scalar {
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
    let slots = match &mut frame.positions {
        FilePositions::F32(positions) => Slots::F32(positions.as_flattened_mut()),
        FilePositions::F64(positions) => Slots::F64(positions.as_flattened_mut()),
    };
    targets.push(Target { columns: typed(&position), slots });
    for (group, attribute) in columns.groups.iter().zip(&mut frame.attributes) {
        let slots = match &mut attribute.values {
            Values::F32(values) => Slots::F32(values),
            Values::F64(values) => Slots::F64(values),
            Values::U8(values) => Slots::U8(values),
            Values::I32(values) => Slots::I32(values),
            Values::I64(values) => Slots::I64(values),
            Values::Strings { .. } => continue, // PLY has no strings
        };
        targets.push(Target { columns: typed(&group.columns), slots });
    }
    targets
}

/// A note if the file is a mesh that is read as particles.
pub(super) fn note_on_faces(header: &PlyHeader) -> Option<String> {
    let mut faces = header.elements.iter().filter(|element| element.name.eq_ignore_ascii_case("face"));
    let faces = faces.next().filter(|faces| faces.count > 0)?;
    Some(format!("the file also has {} faces, which are ignored: only the vertices are read", faces.count))
}

/// Notes on how the vertices are read.
pub(super) fn notes(element: &Element, columns: &Columns) -> Vec<String> {
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
