//! Reads an obstacle of the fluid: a mesh or a level set.

use crate::data::MeshData;
use crate::error::{Error, Position, Result};
use crate::excerpt::excerpt;
use crate::gltf::ReadExternal;
use crate::limits::Limits;
use crate::mesh::{probe_mesh, read_mesh, readable, reader_of};
use crate::ply;
use crate::probe::{Probe, ProbedKind};
use crate::table::Format;
use crate::vdb::{self, LevelSetData};

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
