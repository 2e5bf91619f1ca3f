//! Wavefront OBJ: reads and writes meshes as text.

use crate::mesh_options::WriteOption;
use crate::provenance::from_comments;
use crate::row::Integrity;
use crate::row::{Content, FormatRow, MeshEncoder, MeshWriter, OutputRow};

mod lines;
mod read;
mod write;

pub use read::read_mesh;
pub use write::attribute_notes;

use write::{batch_count, encode_batch, ends_as_written};

/// The format's name in errors.
const FORMAT: &str = "OBJ";

/// The row in the table of formats.
pub(crate) static ROW: OutputRow = OutputRow {
    format: FormatRow { read_mesh: Some(|bytes, _, _| read_mesh(bytes)), ..FormatRow::new(FORMAT, &["obj"]) },
    help: "Wavefront OBJ",
    content: Content::Mesh(MeshWriter {
        attribute_notes,
        ..MeshWriter::new(MeshEncoder::Batches { count: batch_count, encode: encode_batch })
    }),
    write_particles: None,
    has_attributes: false,
    options: &[WriteOption::Quads],
    read_provenance: |head| Ok(from_comments(head, "# ")),
    integrity: Integrity::Tail(ends_as_written),
};
