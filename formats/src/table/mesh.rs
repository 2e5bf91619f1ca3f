//! Reads a mesh from a file in any supported format.

use std::borrow::Cow;

use crate::abc;
use crate::core::compression::name_without_compression;
use crate::core::data::MeshData;
use crate::core::error::{Error, Position, Result};
use crate::core::limits::Limits;
use crate::core::text::excerpt;
use crate::core::text::listed;
use crate::meshes::gltf::ReadExternal;
use crate::meshes::obj_points;
use crate::ply;
use crate::table::Format;
use crate::table::probe::{Probe, ProbedKind, probe};
use crate::usd::declares_mesh;
use crate::vdb::{self, LevelSetData};
use crate::vtk;

/// Reads the triangles of a file in any supported mesh format, compressed or not. The content decides the
/// format. `read_external` reads the external buffers of a .gltf file. The mesh can be empty.
///
/// # Errors
/// The errors of the format's reader; [`Error::Unsupported`] if the file is not a mesh, or contains several
/// frames.
pub fn read_mesh(
    bytes: &[u8],
    file_name: &str,
    limits: &Limits,
    read_external: &ReadExternal,
) -> Result<MeshData> {
    let Probe { kind, codec } = probe_mesh(bytes, file_name);
    let Some(read) = reader_of(kind) else {
        return match kind {
            ProbedKind::Empty => Err(Error::truncated("", Position::File, "the file is empty")),
            _ => {
                let what = format!("not a supported mesh format: use {}", readable(&[]));
                Err(Error::unsupported(kind.name(), what))
            }
        };
    };
    match codec {
        Some(codec) => read(&codec.decompress(bytes, limits)?, limits, read_external),
        None => read(bytes, limits, read_external),
    }
}

/// Whether a file probably contains a mesh, judged by its first bytes: its format is for meshes only, or it
/// is PLY or VTK XML and declares faces. In the legacy format of VTK and in OBJ, faces are often behind the points,
/// beyond the first bytes: such a file counts as particles. So does an Alembic archive of another program.
pub fn looks_like_mesh(head: &[u8], file_name: &str) -> bool {
    let Probe { kind, codec } = probe_mesh(head, file_name);
    let head: Cow<[u8]> =
        codec.map_or(head.into(), |codec| codec.decompress_head(head, PACKED_HEAD_BYTES).into());
    match kind {
        ProbedKind::Format(Format::Ply) => ply::holds_mesh(&head, &Limits::default()).unwrap_or(false),
        ProbedKind::Format(Format::Vtp) => vtk::holds_polys(&head),
        ProbedKind::Format(Format::Abc) => abc::is_own_mesh(&head),
        ProbedKind::Format(Format::Usda | Format::Usdc) => declares_mesh(&head),
        ProbedKind::Format(Format::Obj) => obj_points::has_faces(&head),
        kind => kind.format().is_some_and(|format| format.has_mesh() && !format.has_particles()),
    }
}

/// More bytes than the header of a PLY file, or the description of the first piece of a VTK file.
const PACKED_HEAD_BYTES: usize = 64 << 10;

/// Lists the extensions of all mesh formats and of `others`, joined as in a sentence.
pub(crate) fn readable(others: &[Format]) -> String {
    let formats = Format::ALL.iter().filter(|format| format.row().read_mesh.is_some()).chain(others);
    let extensions = formats.flat_map(|format| format.extensions());
    listed(extensions.map(|extension| format!(".{extension}")).collect(), "or")
}

/// Recognises a file that may be a mesh.
pub(crate) fn probe_mesh(bytes: &[u8], file_name: &str) -> Probe {
    let Probe { mut kind, codec } = probe(bytes, file_name);
    // Some OBJ files look like a table because of the order of their lines, so the name decides.
    let name = file_name.to_ascii_lowercase();
    let is_vague = matches!(kind, ProbedKind::Format(Format::Delimited) | ProbedKind::UnknownText);
    if is_vague && name_without_compression(&name).ends_with(".obj") {
        kind = ProbedKind::Format(Format::Obj);
    }
    Probe { kind, codec }
}

/// Turns the decompressed bytes of a file into a mesh.
type MeshFileReader = fn(&[u8], &Limits, &ReadExternal) -> Result<MeshData>;

/// The mesh reader for files of this kind.
pub(crate) fn reader_of(kind: ProbedKind) -> Option<MeshFileReader> {
    kind.format()?.row().read_mesh
}

// Reads an obstacle of the fluid: a mesh or a level set.

/// An obstacle as read from its file.
#[derive(Clone, Debug, PartialEq)]
pub enum ObstacleData {
    /// A triangle mesh, which need not be closed.
    Mesh(MeshData),
    /// A level set with values in world units.
    LevelSet(Box<LevelSetData>),
}

/// Reads an obstacle from a file in any supported format, compressed or not: those of [`read_mesh`], or
/// OpenVDB. The content decides the format. `read_external` reads the external buffers of a .gltf file.
///
/// # Errors
/// The errors of the format's reader; [`Error::Invalid`] for a mesh without triangles; [`Error::Unsupported`]
/// if the file is neither a mesh nor a level set, or contains several frames.
pub fn read_obstacle(
    bytes: &[u8],
    file_name: &str,
    limits: &Limits,
    read_external: &ReadExternal,
) -> Result<ObstacleData> {
    let Probe { kind, codec } = probe_mesh(bytes, file_name);
    if kind == ProbedKind::Format(Format::Vdb) {
        return match codec {
            Some(codec) => level_set(&codec.decompress(bytes, limits)?, limits),
            None => level_set(bytes, limits),
        };
    }
    check_kind(kind)?;
    let mesh = read_mesh(bytes, file_name, limits, read_external)?;
    if mesh.triangles.is_empty() {
        return Err(without_triangles(kind));
    }
    Ok(ObstacleData::Mesh(mesh))
}

/// Refuses a file that [`read_obstacle`] certainly refuses, judged by its first bytes: particles, for
/// example.
///
/// # Errors
/// The error of [`read_obstacle`].
pub fn check_obstacle(head: &[u8], file_name: &str) -> Result<()> {
    let Probe { kind, codec } = probe_mesh(head, file_name);
    if kind == ProbedKind::Format(Format::Vdb) {
        return Ok(());
    }
    check_kind(kind)?;
    let is_ply = kind == ProbedKind::Format(Format::Ply) && codec.is_none();
    // A header that ends after these bytes is checked when the file is read.
    match is_ply.then(|| ply::read_header(head, &Limits::default())) {
        Some(Ok(header)) if !header.has_faces() => Err(without_triangles(kind)),
        _ => Ok(()),
    }
}

fn check_kind(kind: ProbedKind) -> Result<()> {
    if reader_of(kind).is_none() && kind != ProbedKind::Empty {
        let what = format!("not a supported obstacle format: use {}", readable(&[Format::Vdb]));
        return Err(Error::unsupported(kind.name(), what));
    }
    Ok(())
}

fn without_triangles(kind: ProbedKind) -> Error {
    Error::invalid(kind.name(), Position::File, "the obstacle mesh has no triangles")
}

fn level_set(bytes: &[u8], limits: &Limits) -> Result<ObstacleData> {
    let data = vdb::read_level_set(bytes, None, limits)?;
    // Some programs do not set the class of a grid; such grids are accepted.
    if !["level set", "unknown", ""].contains(&data.class.as_str()) {
        let what = format!(
            "the grid \"{}\" is a {}; an obstacle must be a level set",
            excerpt(&data.name),
            excerpt(&data.class)
        );
        return Err(Error::unsupported("OpenVDB", what));
    }
    Ok(ObstacleData::LevelSet(Box::new(data)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn meshes_and_particles_are_distinguished_by_their_head() {
        let ply = |vertices: u32, faces: &str| {
            format!("ply\nformat ascii 1.0\nelement vertex {vertices}\nproperty float x\n{faces}end_header\n")
        };
        let faces = |count: u32| format!("element face {count}\nproperty list uchar int vertex_indices\n");
        let vtp = |polys: u32| format!("<VTKFile><Piece NumberOfPoints=\"3\" NumberOfPolys=\"{polys}\">");
        for (head, name, expected) in [
            (ply(3, &faces(1)), "a.ply", true),
            (ply(3, &faces(0)), "a.ply", false),
            (ply(0, &faces(0)), "a.ply", true),
            (ply(3, ""), "a.ply", false),
            ("ply\nformat ascii 1.0\n".to_owned(), "a.ply", false),
            (vtp(1), "a.vtp", true),
            (vtp(0), "a.vtp", false),
            ("v 1 2 3\nv 4 5 6\n".to_owned(), "a.obj", false),
            ("v 1 2 3\nv 4 5 6\nv 7 8 8\nf 1 2 3\n".to_owned(), "a.obj", true),
            ("glTF\u{2}\0\0\0".to_owned(), "a", true),
            ("# vtk DataFile Version 5.1\nx\nASCII\n".to_owned(), "a.vtk", false),
            ("x,y,z\n1,2,3\n".to_owned(), "a.csv", false),
            (String::new(), "a.stl", false),
        ] {
            assert_eq!(looks_like_mesh(head.as_bytes(), name), expected, "{name}: {head}");
        }
    }
}
