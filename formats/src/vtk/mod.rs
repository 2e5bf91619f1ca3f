//! VTK's files: the old format of lines and data, and the XML formats `.vtp` and `.vtu`.
//!
//! Both hold points, cells and data, and come in pieces and encodings; of all that, particles are the points and
//! the arrays that have a value for each point. Cells are passed over, but for flat ones where a mesh is
//! asked for. Meshes are written as `.vtp`.
//!
//! The layouts were established from files of VTK, meshio, PyVista and SPlisHSPlasH.

mod appended;
mod blocks;
mod cells;
mod legacy;
mod pieces;
mod read_strings;
mod write;
mod write_particles;
mod xml;
mod xml_arrays;
mod xml_polys;

pub use legacy::{read as read_legacy, read_mesh as read_legacy_mesh};
pub use pieces::POLYGONS_NOTE;
pub use write::{WriteOptions, attribute_notes, write_mesh};
pub use write_particles::{particle_notes, write_particles};
pub use xml::read as read_xml;
pub use xml_polys::read_mesh;

pub(crate) use appended::ends_as_written;
pub(crate) use read_strings::field_strings;

/// The formats as users know them, for errors.
const LEGACY: &str = "legacy VTK";
const XML: &str = "VTK XML";
