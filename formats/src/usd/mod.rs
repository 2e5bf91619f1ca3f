//! The content of a mesh and of a sequence in USD: the properties that both the text writer and the binary
//! writer encode.
//!
//! ```text
//!   def Xform "root"
//!       def Mesh "surface"
//!           extent, faceVertexCounts, faceVertexIndices, normals, orientation, points,
//!           velocities, primvars:NAME .., subdivisionScheme, xformOp:translate
//! ```

mod mesh;
mod sequence;

pub use mesh::LayerInfo;
pub(crate) use mesh::{Elements, MeshProperty, PropertyValue, ROOT, properties, renamed};
pub(crate) use sequence::{POSITION, PRIM, SequenceAttribute, UsdSequence};

/// The format's name in errors.
pub(crate) const FORMAT: &str = "USD";
