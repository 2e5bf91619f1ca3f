//! Opens containers of any format, whose types are in `core/container.rs`.
//!
//! The particles of a sample depend on nothing else in its file.

use crate::core::container::ContainerReader;
pub use crate::core::container::{ContainerFile, ContainerFrames, OpenFurther, Sample};
use crate::core::data::MeshData;
use crate::core::error::{Error, Result};
use crate::core::limits::Limits;
use crate::core::row::ReadParticles;
use crate::table::Format;
use crate::table::loaded::Loaded;
use crate::table::probe::ProbedKind;

/// Whether files of this kind are containers.
pub fn is_container(kind: ProbedKind) -> bool {
    reader_of(kind).is_some()
}

/// The frames in a container of this kind.
///
/// # Errors
/// Those of the format's reader: [`Error::Unsupported`] for a file without particles, for example, or if the kind is not
/// that of a container.
pub fn frames(kind: ProbedKind, container: &ContainerFile, limits: &Limits) -> Result<ContainerFrames> {
    (required_reader_of(kind)?.1.open)(container, limits)
}

/// The particles of one of the frames, by its index.
///
/// # Errors
/// Those of [`frames`].
pub fn read_sample(
    kind: ProbedKind,
    container: &ContainerFile,
    frames: &ContainerFrames,
    index: usize,
    limits: &Limits,
) -> Result<Loaded> {
    let (format, _) = required_reader_of(kind)?;
    Ok(Loaded::Particles(format, Box::new(frames.read(container, index, limits)?)))
}

/// Whether the meshes in a file of this kind change with the time; `None` for kinds without scenes.
///
/// # Errors
/// Those of the format's reader: [`Error::Unsupported`] for a scene without meshes, for example.
pub fn are_meshes_animated(
    kind: ProbedKind,
    container: &ContainerFile,
    limits: &Limits,
) -> Result<Option<bool>> {
    let meshes = reader_of(kind).and_then(|(_, reader)| reader.meshes.as_ref());
    meshes.map(|meshes| (meshes.are_animated)(container, limits)).transpose()
}

/// The meshes of a scene, as they are in the frame with this number: at this time code of USD, or at the sample
/// of Alembic that has this number at the frame rate of the samples. Between samples and beyond them, the values
/// are those that the format defines. Without a number, the first samples are read.
///
/// # Errors
/// As [`are_meshes_animated`]; [`Error::Unsupported`] if the times of samples are not whole frames.
pub fn scene_mesh(
    kind: ProbedKind,
    container: &ContainerFile,
    number: Option<i64>,
    limits: &Limits,
) -> Result<MeshData> {
    match reader_of(kind).and_then(|(_, reader)| reader.meshes.as_ref()) {
        Some(meshes) => (meshes.read)(container, number, limits),
        None => Err(Error::unsupported(kind.name(), "not a scene")),
    }
}

fn reader_of(kind: ProbedKind) -> Option<(Format, &'static ContainerReader)> {
    let format = kind.format()?;
    match &format.row().particles.as_ref()?.read {
        ReadParticles::Whole(_) => None,
        ReadParticles::Sample(reader) => Some((format, reader)),
    }
}

fn required_reader_of(kind: ProbedKind) -> Result<(Format, &'static ContainerReader)> {
    let not_one = || Error::unsupported(kind.name(), "not a file with frames of its own");
    reader_of(kind).ok_or_else(not_one)
}
