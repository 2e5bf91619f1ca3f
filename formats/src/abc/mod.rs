//! Alembic, `.abc`: writes meshes, of one frame or of a sequence, and reads those that it wrote.
//!
//! ```text
//!   archive ── surface: Xform ── surfaceShape: PolyMesh
//!      └ metadata: provenance
//! ```
//!
//! The format is defined by its library, which stores an archive in a container called Ogawa; an older
//! container, in HDF5, is not supported. A mesh may have another number of vertices and faces at each time.
//! Programs that play such a mesh blur its motion by its velocities, which are in units per second.

use crate::mesh_options::WriteOption;
use crate::row::{Content, FormatRow, Integrity, MeshEncoder, MeshWriter, OutputRow};

mod container;
mod digest;
mod document;
mod frame;
mod mesh;
mod ogawa;
mod read;
mod sequence;
mod write;

pub use frame::{is_archive, to_glb};
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
    help: "Alembic: positions, normals",
    content: Content::Mesh(MeshWriter { attribute_notes, ..MeshWriter::new(MeshEncoder::Stream(write)) }),
    write_particles: None,
    has_attributes: true,
    options: &[WriteOption::Quads, WriteOption::Up],
    read_provenance,
    integrity: Integrity::Length(|head, _| bytes_declared(head)),
};
