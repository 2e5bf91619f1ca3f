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

/// The name of the vertex attribute in a property; `None` for other properties.
pub(crate) fn attribute_of(property: &str) -> Option<&str> {
    match property.strip_prefix("primvars:") {
        Some(name) => Some(name).filter(|name| !name.ends_with(INDICES)),
        None => Some(property).filter(|name| *name == "velocities"),
    }
}

/// The suffix in the name of the property that has the indices of an indexed primvar.
pub(crate) const INDICES: &str = ":indices";

/// The format's name in errors.
pub(crate) const FORMAT: &str = "USD";
