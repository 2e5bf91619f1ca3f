//! USD as text, `.usda`: writes meshes, of one frame or of a sequence as time samples.
//!
//! ```text
//!   #usda 1.0
//!   (
//!       customLayerData = { dictionary meniscus = { string radius = "0.025" .. } .. }     provenance
//!           for a stage, also dictionary meniscus_samples: the properties that have time samples
//!       defaultPrim, metersPerUnit, upAxis; for a sequence, its time codes
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
//! Every program that reads USD reads its text form; the [binary form](crate::usdc) takes a quarter to a
//! third of the size. A sequence is one file with a single mesh, whose attributes all have a sample per
//! frame, so it is easy to move and can be replaced atomically. A [stage](UsdStage) is the alternative: a
//! file that lists those of the frames, which may still be arriving.
//!
//! This crate does not read meshes from `.usda`: it reads only the heads of the files that it wrote.

use crate::mesh_options::WriteOption;
use crate::row::Integrity;
use crate::row::{Content, FormatRow, MeshEncoder, MeshWriter, OutputRow};
use crate::usd::renamed;

mod arrays;
mod head;
mod numbers;
mod sequence;
mod stage;
mod write;

pub use crate::usd::{LayerInfo, SampledProperty};
pub use head::{read_layer_info, read_sampled_properties, read_times};
pub use sequence::{read_attribute_names, write_sequence};
pub use stage::{ClipFile, StageClips, UsdStage, stage_text};

use head::{ends_as_written, read_provenance};
use write::{batch_count, encode_batch};

/// The row in the table of formats.
pub(crate) static ROW: OutputRow = OutputRow {
    format: FormatRow { signatures: &[b"#usda"], ..FormatRow::new("USD text", &["usda"]) },
    help: "USD as text",
    content: Content::Mesh(MeshWriter {
        attribute_notes: |attributes| renamed(attributes, "usda"),
        ..MeshWriter::new(MeshEncoder::Batches { count: batch_count, encode: encode_batch })
    }),
    write_particles: None,
    has_attributes: true,
    options: &[WriteOption::Quads, WriteOption::Up, WriteOption::MetersPerUnit, WriteOption::TimeSamples],
    read_provenance,
    integrity: Integrity::Tail(ends_as_written),
};
