//! Reads the vertices and faces of a PLY file as a mesh.

use crate::data::{AttributeRole, FilePositions, MeshData, ParticleFrame, Values};
use crate::error::{Error, Result};
use crate::limits::Limits;
use crate::scalar::Scalar;

use super::FORMAT;
use super::header::{Element, Property, PropertyType, read_header};
use super::read::read_vertices;
use super::rows::{RecordReader, checked_count, rows_of};

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
/// Those of [`super::read`]; `Unsupported` for triangle strips.
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
    let positions = match &frame.positions {
        FilePositions::F32(positions) => positions.iter().map(|position| position.map(f64::from)).collect(),
        FilePositions::F64(positions) => positions.clone(),
    };
    let mut mesh = MeshData { positions, ..MeshData::default() };
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
/// that [`super::write::write_mesh`] writes; `None` for text, or beyond 2⁶⁴.
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
    item: Scalar,
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
