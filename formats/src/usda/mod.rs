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

mod arrays;
mod head;
mod numbers;
mod sequence;
mod write;

pub use head::{LayerInfo, read_layer_info};
pub use sequence::write_sequence;
pub use write::{WriteOptions, attribute_notes, batch_count, encode_batch, write};

pub(crate) use head::{ends_as_written, read_provenance};

/// The format's name in errors.
const FORMAT: &str = "USD";
