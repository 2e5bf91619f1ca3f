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
//! The format says nothing of what a property means: [`crate::names`] does. Positions keep the
//! precision of the file, and so do attributes; integers become the next wider type of
//! [`crate::Values`]. A colour of 16-bit integers is in 0..=65535.
//!
//! This work is based on:
//! Greg Turk. The PLY polygon file format. 1994

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

pub(crate) use batches::{PositionColumns, records};
pub(crate) use mesh::mesh_bytes_claimed;

/// The name of the format in errors.
const FORMAT: &str = "PLY";
