//! Reads the triangles of an OBJ file, using the crate tobj on normalised lines.

use super::FORMAT;
use super::lines::MeshLines;
use crate::data::MeshData;
use crate::error::{Error, Position, Result};

/// Reads all objects of a file as one mesh. Polygons become triangle fans; materials and textures are
/// ignored. Normals are kept if every corner has one.
///
/// # Errors
///
/// [`Error::Invalid`], with the line, if the text is not valid OBJ.
pub fn read_mesh(bytes: &[u8]) -> Result<MeshData> {
    let options =
        tobj::LoadOptions { triangulate: true, single_index: true, ignore_points: true, ignore_lines: true };
    let invalid = |what: String| Error::invalid(FORMAT, Position::File, what);
    // tobj drops vertices that no face uses, so the mesh consists of its faces.
    let no_materials = |_: &std::path::Path| Ok(Default::default());
    let mut lines = MeshLines::new(bytes);
    let (models, _) = tobj::load_obj_buf(&mut lines, &options, no_materials).map_err(|error| {
        let (line, what) = lines.position();
        Error::invalid(FORMAT, Position::Line(line), what.unwrap_or_else(|| error.to_string()))
    })?;
    let mut mesh = MeshData::default();
    let mut has_normals = true;
    for model in models {
        let part = model.mesh;
        let first = u32::try_from(mesh.positions.len());
        let (Ok(first), Ok(count)) = (first, u32::try_from(part.positions.len() / 3)) else {
            return Err(Error::too_large(FORMAT, "the mesh has more than 2³² vertices"));
        };
        if first.checked_add(count).is_none() || part.indices.iter().any(|&index| index >= count) {
            return Err(invalid("a face has a vertex that does not exist".into()));
        }
        has_normals &= part.normals.len() == part.positions.len();
        mesh.positions.extend_from_slice(part.positions.as_chunks::<3>().0);
        #[expect(clippy::cast_possible_truncation, reason = "normals are kept in 32 bits")]
        mesh.normals.extend(part.normals.as_chunks::<3>().0.iter().map(|normal| normal.map(|c| c as f32)));
        mesh.triangles.extend(part.indices.as_chunks::<3>().0.iter().map(|face| face.map(|i| first + i)));
    }
    if !has_normals {
        mesh.normals.clear();
    }
    Ok(mesh)
}
