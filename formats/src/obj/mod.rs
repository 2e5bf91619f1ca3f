//! Wavefront OBJ: meshes as text, out and in.

mod lines;
mod read;
mod write;

pub use read::read_mesh;
pub use write::{WriteOptions, attribute_notes, batch_count, encode_batch, write};

pub(crate) use write::ends_as_written;

/// The format's name in errors.
const FORMAT: &str = "OBJ";
