//! Bytes to plain data and back: the files that meniscus reads and writes.
//!
//! This crate knows nothing of grids, level sets or stages. A reader turns the bytes of one file
//! into plain vectors ([`data`]); a writer turns borrowed slices into bytes. Every reader treats
//! its input as hostile: counts are compared with the bytes that remain before anything is
//! allocated, and every failure is an [`Error`] that names the place and what was expected there.

#![forbid(unsafe_code)]

pub mod batches;
pub mod bgeo;
mod blosc;
mod blosclz;
pub mod bytes;
pub mod columns;
pub mod compression;
pub mod csv;
pub mod data;
pub mod error;
mod excerpt;
pub mod exr;
pub mod gltf;
mod gzip;
pub mod houdini;
pub mod integrity;
pub mod lammps;
mod le_bytes;
pub mod limits;
pub mod mesh;
mod mesh_options;
mod named_arrays;
pub mod npy;
mod number;
pub mod obj;
pub mod obstacle;
mod particle_columns;
pub mod picture;
pub mod ply;
pub mod png;
pub mod probe;
pub mod provenance;
mod quads;
mod records;
mod row;
pub mod scalar;
mod step_finders;
pub mod steps;
pub mod stl;
mod table;
mod text;
pub mod usda;
pub mod vdb;
mod vertex_attributes;
pub mod vtk;
pub mod xyz;
pub mod xyz_ext;
mod zstd;

pub use batches::{ParticleBatch, ParticleBatches};
pub use compression::Codec;
pub use data::{
    Attribute, BandGrid, LeafValues, LevelSetView, MeshData, MeshView, ParticleFrame, Positions, Provenance,
    Role, Values, VertexAttribute, VertexValues,
};
pub use error::{Error, Place, Result};
pub use excerpt::{Escaped, escaped, is_unsafe};
pub use integrity::{completeness, is_whole};
pub use limits::Limits;
pub use mesh::read_mesh;
pub use mesh_options::{MeshOptions, UpAxis, WriteOption};
pub use obstacle::{ObstacleData, read_obstacle};
pub use picture::{ColorPicture, PictureCamera, PictureLayer, PictureView, Samples};
use probe::LAMMPS_DATA;
pub use probe::{Kind, Probe, looks_like_particles, probe};
pub use records::ReadAt;
pub use row::{
    BatchEncoder, Completeness, Content, MeshEncoder, MeshWriter, ParticleWriter, PictureWriter,
    RoundPositions, Rounding, StreamWriter,
};
pub use table::{Format, OutputFormat, listed, read_provenance};

/// Reads a frame of particles from a file of any format that can be read, compressed or not.
///
/// The content decides what the format is; see [`probe()`] for the part that `file_name` has in it.
/// A mesh in a PLY file is read as the particles at its vertices, and a note says so. A file that may have several
/// frames, such as a LAMMPS dump, must have one; for the others, see [`steps`].
///
/// # Errors
/// Those of the format's reader, with offsets counted after decompression; `Unsupported`, with what
/// to do instead, for a file that is something else.
pub fn read_particles(bytes: &[u8], file_name: &str, limits: &Limits) -> Result<ParticleFrame> {
    let Probe { kind, codec } = probe(bytes, file_name);
    let is_vague = matches!(kind, Kind::Empty | Kind::Unknown | Kind::UnknownText);
    if let Some(codec) = codec.filter(|_| is_vague) {
        codec.check_start(bytes)?;
    }
    if !bytes.is_empty() && integrity::beginning_cut_off(bytes).is_some() {
        return Err(Error::short("", Place::File, "the file ends within its signature"));
    }
    let read = reader_of(kind)?;
    read(&compression::unpacked(bytes, limits)?, limits)
}

/// Refuses what nothing here reads, by the first bytes of a file: a large one need not be read whole to be told so.
///
/// # Errors
/// `Unsupported`, as [`read_particles`] would say of the whole.
pub fn refuse_foreign(head: &[u8], file_name: &str) -> Result<()> {
    match probe(head, file_name).kind {
        kind @ (Kind::Foreign(_) | Kind::UnknownText | Kind::Unknown) => reader_of(kind).map(drop),
        _ => Ok(()),
    }
}

/// Turns the decompressed bytes of a file into a frame.
type Reader = fn(&[u8], &Limits) -> Result<ParticleFrame>;

/// What reads particles from files of this kind; for those that nothing reads, what they are and what to do instead.
fn reader_of(kind: Kind) -> Result<Reader> {
    if kind == Kind::Empty {
        return Err(Error::short("", Place::File, "the file is empty"));
    }
    if let Some(particles) = kind.format().and_then(|format| format.row().particles.as_ref()) {
        return Ok(particles.read);
    }
    let content = kind.format().and_then(Format::output).map(OutputFormat::content);
    let refusal = match (content, kind) {
        (Some(Content::LevelSet), _) => {
            "this is a volume, not particles: `meniscus convert` does the level set of a file that is not packed, and whose name ends in .vdb"
        }
        (Some(Content::Mesh(_)), _) => {
            "this is a mesh, not particles: give the particles, or save its vertices as PLY"
        }
        (_, Kind::Foreign(LAMMPS_DATA)) => {
            "a dump is what is read, and this is a file of write_data: write one with `write_dump all custom FILE id type x y z`"
        }
        _ => {
            "not a particle format that is read: save it as PLY, BGEO or VTK (docs/formats.md has all that are read)"
        }
    };
    Err(Error::unsupported(kind.name(), refusal))
}
