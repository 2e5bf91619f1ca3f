//! File formats of meniscus: particle, mesh, level-set and picture readers and writers.
//!
//! This crate does not depend on the grids, the reconstruction or the pipeline of the main crate. A reader
//! turns the bytes of one file into plain vectors ([`data`]); a writer turns borrowed slices into bytes.
//! Every reader treats its input as hostile: before it allocates memory, it compares each count with the
//! bytes that remain. Every failure is an [`Error`] that says what is wrong and, if the file is truncated
//! or invalid, where in the file, and what was expected there.

#![forbid(unsafe_code)]

pub mod abc;
mod arrays;
mod core;
pub mod houdini;
mod meshes;
mod pictures;
pub mod ply;
mod points;
mod table;
mod tables;
mod usd;
pub mod vdb;
pub mod vtk;

pub use arrays::{hdf5, json, npy, xdmf};
pub use core::{batches, bytes, columns, compression, data, error, limits, provenance};
pub use houdini::bgeo;
pub use meshes::{gltf, obj, stl};
pub use pictures::{exr, png};
pub use points::{pcd, prt};
pub use table::abc_sequence::write_abc_sequence;
pub use table::to_glb::{becomes_glb, to_glb};
pub use table::{container, integrity, mesh, probe, steps};
pub use tables::{csv, lammps, xyz_ext};
pub use usd::{usda, usdc};

pub use core::batches::{ParticleBatch, ParticleBatches, ReadAt};
pub use core::compression::Codec;
pub use core::container::{ContainerFile, OpenFurther, Sample};
pub use core::data::{
    AttributeRole, BandGrid, ColorPicture, FileAttribute, FilePositions, LeafValues, LevelSetView, MeshData,
    MeshView, ParticleFrame, PictureCamera, PictureLayer, PictureView, PixelSamples, Provenance, Values,
    VertexAttribute, VertexValues,
};
pub use core::error::{Error, Position, Result};
pub use core::limits::Limits;
pub use core::number::NumberType;
pub use core::options::{MeshOptions, UpAxis, WriteOption};
pub use core::row::{
    BatchEncoder, Completeness, Content, MeshEncoder, MeshWriter, ParticleWriter, PictureWriter, StreamWriter,
};
pub use core::sequence_points::{PointsSummary, ReadPoints, SequencePoints};
pub use core::text::{Escaped, escaped, is_unsafe, listed};
pub use table::integrity::{completeness, is_complete};
pub use table::loaded::Loaded;
pub use table::mesh::{ObstacleData, check_obstacle, looks_like_mesh, read_mesh, read_obstacle};
pub use table::neighbor::{Neighbor, neighbor};
pub use table::point_formats::PointFormat;
pub use table::probe::{Probe, ProbedKind, looks_like_particles, probe};
pub use table::{Format, OutputFormat, read_provenance};

use std::borrow::Cow;

use core::row::{MESH_REFUSAL, ParticleReader, ReadParticles};
use core::times::refuse_several_frames;
use table::probe::HEAD_BYTES;

/// Reads a frame of particles from a file in any supported format, compressed or not.
///
/// The content decides the format; [`probe()`] documents when `file_name` matters. A mesh in a PLY file is
/// read as particles at its vertices, with a note. A file in a multi-frame format, such as a LAMMPS dump,
/// must contain exactly one frame; for files with several frames, see [`steps`] and [`container`].
///
/// # Errors
/// The errors of the format's reader, with offsets into the decompressed bytes; `Unsupported`, with what to
/// do instead, if the file is not a particle file; `Invalid` if it has particles, and none of them has a
/// finite position.
pub fn read_particles(bytes: &[u8], file_name: &str, limits: &Limits) -> Result<ParticleFrame> {
    read_particles_named(bytes, file_name, &[], limits)
}

/// Like [`read_particles`], with [new names](csv::read_named) for columns of a table. For a file whose format names its
/// positions they have no effect, and a note says so: tables may be among other files.
///
/// # Errors
/// Those of [`read_particles`] and [`csv::read_named`]; `Unsupported` for new names in a file of arrays.
pub fn read_particles_named(
    bytes: &[u8],
    file_name: &str,
    columns: &[(String, String)],
    limits: &Limits,
) -> Result<ParticleFrame> {
    let Probe { kind, codec } = probe(bytes, file_name);
    refuse_columns_of_arrays(kind.format(), columns)?;
    let is_vague = matches!(kind, ProbedKind::Empty | ProbedKind::Unknown | ProbedKind::UnknownText);
    if let Some(codec) = codec.filter(|_| is_vague) {
        codec.check_start(bytes)?;
    }
    if !bytes.is_empty() && integrity::truncated_signature(bytes).is_some() {
        return Err(Error::truncated("", Position::File, "the file ends within its signature"));
    }
    if kind == ProbedKind::Format(Format::Vdb) {
        let head = codec.map_or(bytes.into(), |codec| Cow::Owned(codec.decompress_head(bytes, HEAD_BYTES)));
        if head.len() < HEAD_BYTES {
            vdb::check_first_grid(&head)?;
        }
    }
    if !columns.is_empty() && is_text_of_rows(kind) {
        let bytes = compression::decompressed(bytes, limits)?;
        return checked(kind.name(), csv::read_named(&bytes, columns, limits)?);
    }
    let reader = reader_of(kind, codec)?;
    let (bytes, note) = if reader.find_steps.is_some() {
        compression::decompressed_so_far(bytes, limits)?
    } else {
        (compression::decompressed(bytes, limits)?, None)
    };
    let mut frame = match &reader.read {
        ReadParticles::Whole(read) => read(&bytes, limits)?,
        ReadParticles::Sample(container) => container.read_alone(kind.name(), &bytes, limits)?,
    };
    frame.notes.extend(note);
    checked(kind.name(), without_columns(frame, columns))
}

/// Like [`read_particles_named`], of a frame that was read.
///
/// # Errors
/// Those of [`read_particles_named`].
pub fn particles_of(
    loaded: Loaded,
    file_name: &str,
    columns: &[(String, String)],
    limits: &Limits,
) -> Result<ParticleFrame> {
    match loaded {
        Loaded::Bytes(bytes) => read_particles_named(&bytes, file_name, columns, limits),
        Loaded::Particles(format, frame) => {
            refuse_columns_of_arrays(Some(format), columns)?;
            checked(format.name(), without_columns(*frame, columns))
        }
    }
}

/// The particles of a frame that has no columns of text, with a note if some should have new names.
fn without_columns(mut frame: ParticleFrame, columns: &[(String, String)]) -> ParticleFrame {
    if !columns.is_empty() {
        frame.notes.push("--columns is ignored: this is not a table of text".to_owned());
    }
    frame
}

fn refuse_columns_of_arrays(format: Option<Format>, columns: &[(String, String)]) -> Result<()> {
    match format {
        Some(format @ (Format::Npy | Format::Npz | Format::Hdf5 | Format::Json)) if !columns.is_empty() => {
            let what =
                "--columns renames columns of tables of text, not arrays: rename the arrays in the file";
            Err(Error::unsupported(format.name(), what))
        }
        _ => Ok(()),
    }
}

/// Whether a file starts like a table that has all these columns, by its first bytes. See [`csv::read_named`].
pub fn has_columns(head: &[u8], file_name: &str, columns: &[(String, String)]) -> bool {
    let Probe { kind, codec } = probe(head, file_name);
    let unpacked = codec.map(|codec| codec.decompress_head(head, HEAD_BYTES));
    is_text_of_rows(kind) && csv::has_columns(unpacked.as_deref().unwrap_or(head), columns)
}

/// Whether a file can be a table with unusual names of columns.
fn is_text_of_rows(kind: ProbedKind) -> bool {
    matches!(kind, ProbedKind::Format(Format::Delimited) | ProbedKind::UnknownText)
}

/// Requires that a frame with particles has one with a finite position, and that it is a single frame.
fn checked(format: &'static str, frame: ParticleFrame) -> Result<ParticleFrame> {
    let positions = &frame.positions;
    if !positions.is_empty() && !positions.has_finite() {
        let what = format!("none of the {} particles has a finite position", positions.len());
        return Err(Error::invalid(format, Position::File, what));
    }
    refuse_several_frames(format, &frame)?;
    Ok(frame)
}

/// Returns an error if no reader supports the file. Needs only its first bytes, so a large file is rejected
/// before it is read.
///
/// # Errors
/// `Unsupported`, the same error as [`read_particles`] returns for the whole file.
pub fn check_supported(head: &[u8], file_name: &str) -> Result<()> {
    let Probe { kind, codec } = probe(head, file_name);
    match kind {
        ProbedKind::Foreign(_) | ProbedKind::UnknownText | ProbedKind::Unknown => {
            reader_of(kind, codec).map(drop)
        }
        _ => Ok(()),
    }
}

/// The particle reader for files of this kind. If there is none, the error says what the file is and what to
/// do instead.
fn reader_of(kind: ProbedKind, codec: Option<Codec>) -> Result<&'static ParticleReader> {
    if kind == ProbedKind::Empty {
        return Err(Error::truncated("", Position::File, "the file is empty"));
    }
    if let Some(reader) = kind.format().and_then(|format| format.row().particles.as_ref()) {
        return Ok(reader);
    }
    let remedy = probe::REMEDIES.iter().find(|(name, _)| kind == ProbedKind::Foreign(name));
    if let Some((name, remedy)) = remedy {
        return Err(Error::unsupported(name, *remedy));
    }
    let content = kind.format().and_then(Format::output).map(OutputFormat::content);
    let refusal = match content {
        Some(Content::LevelSet) if codec.is_some() => {
            "this is a volume, not particles: to convert a level set, decompress it to a file whose name ends in .vdb"
        }
        Some(Content::LevelSet) => {
            "this is a volume, not particles: to convert a level set, rename it so that its name ends in .vdb"
        }
        Some(Content::Mesh(_)) => MESH_REFUSAL,
        Some(Content::Picture(_)) => "this is a picture, not particles: give the particle file",
        None => {
            "not a supported particle format: save it as PLY, BGEO or VTK (docs/formats.md lists all supported formats)"
        }
    };
    Err(Error::unsupported(kind.name(), refusal))
}
