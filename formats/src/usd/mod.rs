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
pub(crate) use mesh::{
    Elements, MeshProperty, PropertyValue, ROOT, SAMPLE_CODE, TRANSLATE, identifier, properties, renamed,
};
pub(crate) use sequence::{CODE_MAX, POSITION, PRIM, SequenceAttribute, UsdSequence, held_codes};

/// The format's name in errors.
pub(crate) const FORMAT: &str = "USD";
