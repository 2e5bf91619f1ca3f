//! Bytes to plain data and back: the files that meniscus reads and writes.
//!
//! This crate knows nothing of grids, level sets or stages. A reader turns the bytes of one file
//! into plain vectors ([`data`]); a writer turns borrowed slices into bytes. Every reader treats
//! its input as hostile: counts are compared with the bytes that remain before anything is
//! allocated, and every failure is an [`Error`] that names the place and what was expected there.

#![forbid(unsafe_code)]

pub mod batches;
pub mod bgeo;
pub mod bytes;
pub mod completeness;
pub mod csv;
pub mod data;
pub mod error;
pub mod exr;
pub mod gltf;
mod gzip;
mod le_bytes;
pub mod limits;
pub mod names;
pub mod obj;
pub mod obstacle;
pub mod picture;
pub mod ply;
pub mod png;
pub mod probe;
pub mod provenance;
pub mod scalar;
mod text;
pub mod vdb;
mod vertex_attributes;
pub mod wholeness;

pub use batches::{ParticleBatch, ParticleBatches, ReadAt};
pub use completeness::{Completeness, completeness};
pub use data::{
    Attribute, BandGrid, LeafValues, LevelSetView, MeshData, MeshView, ParticleFrame, Positions, Provenance,
    Role, Values,
};
pub use error::{Error, Place, Result};
pub use limits::Limits;
pub use obstacle::{ObstacleData, read_obstacle};
pub use picture::{ColorPicture, PictureCamera, PictureLayer, PictureView, Samples};
pub use probe::{Kind, Probe, looks_like_particles, probe};
pub use vertex_attributes::{VertexAttribute, VertexValues};

/// Reads a frame of particles from a file of any format that can be read, packed with gzip or not.
///
/// The content decides what the format is; see [`probe()`] for the part that `file_name` has in it.
/// A mesh in a PLY file is read as the particles at its vertices, and a note says so.
///
/// # Errors
/// Those of the format's reader, with offsets counted after decompression; `Unsupported`, with what
/// to do instead, for a file that is something else.
pub fn read_particles(bytes: &[u8], file_name: &str, limits: &Limits) -> Result<ParticleFrame> {
    let Probe { kind, gzipped } = probe(bytes, file_name);
    let is_vague = matches!(kind, Kind::Empty | Kind::Unknown | Kind::UnknownText);
    if gzipped && is_vague {
        gzip::check_start(bytes)?;
    }
    check_readable(kind)?;
    let inflated;
    let bytes = if gzipped {
        inflated = gzip::inflate(bytes, limits)?;
        &inflated
    } else {
        bytes
    };
    match kind {
        Kind::Ply => ply::read(bytes, limits),
        Kind::ClassicBgeo => bgeo::read(bytes, limits),
        Kind::Delimited => csv::read(bytes, limits),
        _ => Err(unreadable(kind)),
    }
}

/// Refuses what no reader takes, before any effort is spent on it.
fn check_readable(kind: Kind) -> Result<()> {
    match kind {
        Kind::Ply | Kind::ClassicBgeo | Kind::Delimited => Ok(()),
        _ => Err(unreadable(kind)),
    }
}

/// What the file is, and what to do instead.
fn unreadable(kind: Kind) -> Error {
    let what = match kind {
        Kind::Empty => return Error::short("", Place::File, "the file is empty"),
        Kind::ClassicGeo => "text geometry is not read: save it as classic binary .bgeo or as PLY",
        Kind::HoudiniJsonBinary | Kind::HoudiniJsonText | Kind::HoudiniSc => {
            "geometry of Houdini 12 and later is not read yet: save it as classic .bgeo (.bhclassic) or as PLY"
        }
        Kind::VtkLegacy | Kind::VtkXml => "not read yet: save the points as CSV or PLY",
        Kind::Npy => "not read yet: save the positions as CSV or PLY",
        Kind::OpenVdb => "this is a volume, not particles: give the particles that it was made of",
        Kind::Glb | Kind::GltfJson | Kind::Obj => {
            "this is a mesh, not particles: give the particles, or save its vertices as PLY"
        }
        Kind::Ply | Kind::ClassicBgeo | Kind::Delimited => "its particles cannot be read",
        Kind::Foreign(_) | Kind::UnknownText | Kind::Unknown => {
            "not a particle format that is read: use PLY, classic BGEO or delimited text"
        }
    };
    Error::unsupported(kind.name(), what)
}
