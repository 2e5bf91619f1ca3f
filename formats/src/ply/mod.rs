//! PLY, the Stanford polygon format: a text header that declares tables, then the tables.
//!
//! ```text
//!   ply
//!   format binary_little_endian 1.0       or ascii, or binary_big_endian
//!   element vertex 12000                  the particles; elements before are skipped,
//!   property float x                      elements after are ignored
//!   ...
//!   end_header
//!   x y z vx vy vz id | x y z vx ..       packed records, or one line each
//! ```
//!
//! The format does not define the meaning of properties; [`crate::columns`] recognises it by their names.
//! Positions and attributes keep the precision of the file. Integer types that [`crate::Values`] lacks become
//! the next wider type. A colour of 16-bit integers has the range 0..=65535.
//!
//! This work is based on:
//! Greg Turk. The PLY polygon file format. 1994

use crate::error::Result;
use crate::limits::Limits;
use crate::provenance::from_comments;
use crate::row::{Completeness, HeadCheck, Integrity, at_least, exactly};
use crate::row::{Content, FormatRow, MeshEncoder, MeshWriter, OutputRow, ParticleInput, ParticleWriter};

mod ascii;
mod batches;
mod binary;
mod body_lines;
mod header;
mod mesh;
mod read;
mod rows;
mod target;
mod vertex_data;
pub mod write;
mod write_particles;

pub use header::{Element, Encoding, PlyHeader, Property, PropertyType, read_header};
pub use mesh::{holds_mesh, read_mesh, read_mesh_and_vertices};
pub use read::read;
pub use vertex_data::attribute_notes;
pub use write_particles::{particle_notes, write_particles};

use batches::records;
use mesh::mesh_bytes_declared;

/// The format's name in errors.
const FORMAT: &str = "PLY";

/// The row in the table of formats.
pub(crate) static ROW: OutputRow = OutputRow {
    format: FormatRow {
        signatures: &[b"ply\n", b"ply\r", b"ply ", b"ply\t", b"ply\x0c"],
        beginnings: &[b"ply\n", b"ply\r"],
        particles: Some(ParticleInput {
            completeness,
            find_records: Some(|head, file_bytes, _, limits| {
                let header = read_header(head, limits)?;
                Ok(records(&header, file_bytes, limits))
            }),
            ..ParticleInput::new(read)
        }),
        read_mesh: Some(|bytes, limits, _| read_mesh(bytes, limits)),
        ..FormatRow::new(FORMAT, &["ply"])
    },
    help: "Binary PLY",
    content: Content::Mesh(MeshWriter {
        attribute_notes,
        ..MeshWriter::new(MeshEncoder::Stream(|mesh, _, provenance, mut out| {
            write::write_mesh(mesh, provenance, &mut out)
        }))
    }),
    write_particles: Some(ParticleWriter {
        write: |particles, provenance, mut out| write_particles(particles, provenance, &mut out),
        notes: particle_notes,
    }),
    has_attributes: true,
    options: &[],
    read_provenance: |head| Ok(from_comments(head, "comment ")),
    integrity: Integrity::Length(|head, _| mesh_bytes_declared(head, &Limits::default())),
};

/// The completeness of a file according to its header.
fn completeness(head: &[u8], file_bytes: u64) -> Result<HeadCheck> {
    let header = read_header(head, &Limits::default())?;
    let Some(declared) = header.file_size_min() else { return Ok(HeadCheck::Known(Completeness::Unknown)) };
    Ok(HeadCheck::Known(match header.encoding {
        _ if declared == header.body_offset as u64 => Completeness::Unknown,
        Encoding::Ascii if declared <= file_bytes => return Ok(HeadCheck::NeedsLastByte),
        Encoding::Ascii => at_least(declared, file_bytes, Completeness::NeedsReading),
        _ if header.elements.iter().any(Element::has_list) => {
            at_least(declared, file_bytes, Completeness::NeedsReading)
        }
        _ => exactly(declared, file_bytes),
    }))
}
