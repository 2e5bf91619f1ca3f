//! Bytes to plain data and back: the files that meniscus reads and writes.
//!
//! This crate knows nothing of grids, level sets or stages. A reader turns the bytes of one file
//! into plain vectors ([`data`]); a writer turns borrowed slices into bytes. Every reader treats
//! its input as hostile: counts are compared with the bytes that remain before anything is
//! allocated, and every failure is an [`Error`] that names the place and what was expected there.

#![forbid(unsafe_code)]

pub mod atoms;
pub mod batches;
pub mod bgeo;
mod blosc;
mod blosclz;
pub mod bytes;
pub mod completeness;
pub mod csv;
pub mod data;
pub mod error;
mod excerpt;
pub mod exr;
pub mod gltf;
mod gzip;
pub mod houdini;
pub mod lammps;
mod le_bytes;
pub mod limits;
pub mod mesh;
mod named_arrays;
pub mod names;
pub mod npy;
mod number;
pub mod obj;
pub mod obstacle;
pub mod packing;
mod particle_columns;
pub mod picture;
pub mod ply;
pub mod png;
pub mod probe;
pub mod provenance;
mod quads;
pub mod scalar;
pub mod steps;
pub mod stl;
mod text;
pub mod usda;
pub mod vdb;
mod vertex_attributes;
pub mod vtk;
pub mod wholeness;
pub mod xyz;
mod zstd;

pub use batches::{ParticleBatch, ParticleBatches, ReadAt};
pub use completeness::{Completeness, completeness};
pub use data::{
    Attribute, BandGrid, LeafValues, LevelSetView, MeshData, MeshView, ParticleFrame, Positions, Provenance,
    Role, Values,
};
pub use error::{Error, Place, Result};
pub use excerpt::{Escaped, escaped, is_unsafe};
pub use limits::Limits;
pub use mesh::read_mesh;
pub use obstacle::{ObstacleData, read_obstacle};
pub use packing::Packing;
pub use picture::{ColorPicture, PictureCamera, PictureLayer, PictureView, Samples};
use probe::LAMMPS_DATA;
pub use probe::{Kind, Probe, looks_like_particles, probe};
pub use vertex_attributes::{VertexAttribute, VertexValues};

/// Reads a frame of particles from a file of any format that can be read, packed or not.
///
/// The content decides what the format is; see [`probe()`] for the part that `file_name` has in it.
/// A mesh in a PLY file is read as the particles at its vertices, and a note says so. A file that may have several
/// frames, such as a LAMMPS dump, must have one; for the others, see [`steps`].
///
/// # Errors
/// Those of the format's reader, with offsets counted after decompression; `Unsupported`, with what
/// to do instead, for a file that is something else.
pub fn read_particles(bytes: &[u8], file_name: &str, limits: &Limits) -> Result<ParticleFrame> {
    let Probe { kind, packing } = probe(bytes, file_name);
    let is_vague = matches!(kind, Kind::Empty | Kind::Unknown | Kind::UnknownText);
    if let Some(packing) = packing.filter(|_| is_vague) {
        packing.check_start(bytes)?;
    }
    if !bytes.is_empty() && completeness::signature_cut_off(bytes).is_some() {
        return Err(Error::short("", Place::File, "the file ends within its signature"));
    }
    let read = reader_of(kind)?;
    read(&packing::unpacked(bytes, limits)?, limits)
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

const NOT_READ: &str =
    "not a particle format that is read: save it as PLY, BGEO or VTK (docs/formats.md has all that are read)";

/// Turns the unpacked bytes of a file into a frame.
type Reader = fn(&[u8], &Limits) -> Result<ParticleFrame>;

/// What reads files of this kind; of those that nothing reads, what they are and what to do instead.
fn reader_of(kind: Kind) -> Result<Reader> {
    let refusal = match kind {
        Kind::Ply => return Ok(ply::read),
        Kind::ClassicBgeo => return Ok(bgeo::read),
        Kind::ClassicGeo => return Ok(bgeo::read_text),
        Kind::HoudiniJsonBinary => return Ok(houdini::read_binary),
        Kind::HoudiniJsonText => return Ok(houdini::read_text),
        Kind::HoudiniSc => return Ok(houdini::read_container),
        Kind::Delimited => return Ok(csv::read),
        Kind::RawXyz => return Ok(xyz::read),
        Kind::LammpsDump => return Ok(lammps::read),
        Kind::XyzAtoms => return Ok(atoms::read),
        Kind::VtkLegacy => return Ok(vtk::read_legacy),
        Kind::VtkXml => return Ok(vtk::read_xml),
        Kind::Npy => return Ok(npy::read),
        Kind::Npz => return Ok(npy::read_archive),
        Kind::Empty => return Err(Error::short("", Place::File, "the file is empty")),
        Kind::OpenVdb => {
            "this is a volume, not particles: `meniscus convert` does the level set of a file that is not packed, and whose name ends in .vdb"
        }
        Kind::Glb | Kind::GltfJson | Kind::Obj | Kind::Stl | Kind::Usda => {
            "this is a mesh, not particles: give the particles, or save its vertices as PLY"
        }
        Kind::Foreign(LAMMPS_DATA) => {
            "a dump is what is read, and this is a file of write_data: write one with `write_dump all custom FILE id type x y z`"
        }
        Kind::Foreign(_) | Kind::UnknownText | Kind::Unknown => NOT_READ,
    };
    Err(Error::unsupported(kind.name(), refusal))
}
