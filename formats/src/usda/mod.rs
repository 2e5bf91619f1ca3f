//! USD as text, `.usda`: meshes out, of one frame or of a whole shot as time samples.
//!
//! ```text
//!   #usda 1.0
//!   (
//!       customLayerData = { dictionary meniscus = { string radius = "0.025" .. } .. }     what made it
//!       defaultPrim, metersPerUnit, upAxis; of a shot its time codes
//!   )
//!   def Xform "root"
//!       def Mesh "surface"
//!   {
//!       int[] faceVertexCounts = [3, 3, ..]        or  int[] faceVertexCounts.timeSamples = { 1: [3, ..], 2: [..] }
//!       point3f[] points = [(0.5, 1, 2), ..]
//!       ..
//!   }
//!   # end: 642 vertices, 1280 faces
//! ```
//!
//! Whatever reads USD reads its text. The binary form, a third of the size, is known by its implementation alone; `usdcat`
//! makes it of this. A shot is one mesh whose attributes all have a sample for each frame, not a file for each
//! frame beside another that lists them: it can be moved, and appears at once.
//!
//! Nothing of USD is read, but what this crate wrote into the head.

use crate::mesh_options::WriteOption;
use crate::row::Integrity;
use crate::row::{Content, FormatRow, MeshEncoder, MeshWriter, OutputRow};

mod arrays;
mod head;
mod numbers;
mod sequence;
mod write;

pub use head::{LayerInfo, read_layer_info};
pub use sequence::write_sequence;
pub use write::attribute_notes;

use head::{ends_as_written, read_provenance};
use write::{batch_count, encode_batch};

/// The format's name in errors.
const FORMAT: &str = "USD";

/// What the table of formats says of it.
pub(crate) static ROW: OutputRow = OutputRow {
    format: FormatRow { signatures: &[b"#usda"], ..FormatRow::new("USD text", &["usda"]) },
    help: "USD as text",
    content: Content::Mesh(MeshWriter {
        attribute_notes,
        ..MeshWriter::new(MeshEncoder::Batches { count: batch_count, encode: encode_batch })
    }),
    write_particles: None,
    has_attributes: true,
    options: &[WriteOption::Quads, WriteOption::Up, WriteOption::MetersPerUnit],
    read_provenance,
    integrity: Integrity::Tail(ends_as_written),
};
