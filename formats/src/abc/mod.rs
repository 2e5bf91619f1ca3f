//! Alembic, `.abc`: writes meshes of one frame or of a sequence, and reads the files that this crate wrote.
//!
//! ```text
//!   archive ── surface: Xform ── surfaceShape: PolyMesh
//!      └ metadata: provenance
//! ```
//!
//! The Alembic library defines the format. It stores an archive in a container called Ogawa; the older
//! container, HDF5, is not supported. The number of vertices and faces of a mesh may change from sample to
//! sample. Programs compute the motion blur of such a mesh from its velocities, in units per second.

use crate::mesh_options::WriteOption;
use crate::row::{Content, FormatRow, Integrity, MeshEncoder, MeshWriter, OutputRow};

mod container;
mod document;
mod frame;
mod mesh;
mod ogawa;
mod read;
mod sequence;
mod write;

pub use frame::{is_archive, read_attributes, to_glb};
pub use read::{read_mesh, read_sample, read_sequence_info, read_times};
pub use sequence::write_sequence;
pub use write::{attribute_notes, write};

use read::{bytes_declared, read_provenance};

/// The format's name in errors.
const FORMAT: &str = "Alembic";

/// The row in the table of formats.
pub(crate) static ROW: OutputRow = OutputRow {
    format: FormatRow {
        signatures: &[&ogawa::MAGIC],
        read_mesh: Some(|bytes, limits, _| read_mesh(bytes, limits)),
        ..FormatRow::new(FORMAT, &["abc"])
    },
    help: "Alembic: positions, normals, velocities, attributes",
    content: Content::Mesh(MeshWriter { attribute_notes, ..MeshWriter::new(MeshEncoder::Stream(write)) }),
    write_particles: None,
    has_attributes: true,
    options: &[WriteOption::Quads, WriteOption::Up],
    read_provenance,
    integrity: Integrity::Length(|head, _| bytes_declared(head)),
};
