//! PLY, the Stanford polygon file: a text header that declares tables, then the tables.
//!
//! ```text
//!   ply
//!   format binary_little_endian 1.0       or ascii, or binary_big_endian
//!   element vertex 12000                  the particles; what stands before is skipped,
//!   property float x                      what comes after is not looked at
//!   ...
//!   end_header
//!   x y z vx vy vz id | x y z vx ..       records without gaps, or a line for each
//! ```
//!
//! The format says nothing of what a property means: [`crate::columns`] does. Positions keep the
//! precision of the file, and so do attributes; integers become the next wider type of
//! [`crate::Values`]. A colour of 16-bit integers is in 0..=65535.
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
mod header;
mod mesh;
mod read;
mod rows;
mod vertex_data;
pub mod write;
mod write_particles;

pub use header::{Element, Encoding, Header, Property, PropertyType, read_header};
pub use mesh::{read_mesh, read_mesh_and_vertices};
pub use read::read;
pub use vertex_data::attribute_notes;
pub use write_particles::{particle_notes, write_particles};

use batches::records;
use mesh::mesh_bytes_claimed;

/// The name of the format in errors.
const FORMAT: &str = "PLY";

/// What the table of formats says of it.
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
    integrity: Integrity::Length(|head, _| mesh_bytes_claimed(head, &Limits::default())),
};

/// What the header says of whether a file is complete.
fn completeness(head: &[u8], file_bytes: u64) -> Result<HeadCheck> {
    let header = read_header(head, &Limits::default())?;
    let Some(declared) = header.file_size_min() else { return Ok(HeadCheck::Known(Completeness::Unproven)) };
    Ok(HeadCheck::Known(match header.encoding {
        _ if declared == header.body_offset as u64 => Completeness::Unproven,
        Encoding::Ascii if declared <= file_bytes => return Ok(HeadCheck::ByTheLastByte),
        Encoding::Ascii => at_least(declared, file_bytes, Completeness::ByReading),
        _ if header.elements.iter().any(Element::has_list) => {
            at_least(declared, file_bytes, Completeness::ByReading)
        }
        _ => exactly(declared, file_bytes),
    }))
}
