//! The content of a mesh and of a sequence in USD: the properties that both the text writer and the binary
//! writer encode.
//!
//! ```text
//!   def Xform "root"
//!       def Mesh "surface"
//!           extent, faceVertexCounts, faceVertexIndices, normals, orientation, points,
//!           velocities, accelerations, primvars:NAME .., subdivisionScheme, xformOp:translate
//! ```

mod mesh;
mod sequence;

pub use mesh::LayerInfo;
pub(crate) use mesh::{
    ACCELERATIONS, Elements, MeshProperty, PropertyValue, ROOT, SAMPLE_CODE, TRANSLATE, VELOCITIES,
    identifier, properties, renamed,
};
pub(crate) use sequence::{PRIM, SequenceAttribute, UsdSequence};

/// The name of the vertex attribute in a property; `None` for other properties.
pub(crate) fn attribute_of(property: &str) -> Option<&str> {
    match property.strip_prefix("primvars:") {
        Some(name) => Some(name).filter(|name| !name.ends_with(INDICES)),
        None => Some(property).filter(|name| [VELOCITIES, ACCELERATIONS].contains(name)),
    }
}

/// A property of a mesh that has time samples. A [stage](crate::usda::UsdStage) declares these properties.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SampledProperty {
    /// Its type in USD, such as `point3f[]`.
    pub kind: String,
    /// Its name, such as `points` or `primvars:id`.
    pub name: String,
}

impl SampledProperty {
    /// A property from a file; `None` if the texts are not a type and a name. The file may be damaged, and
    /// stages repeat the texts.
    pub(crate) fn checked(kind: &str, name: &str) -> Option<SampledProperty> {
        let has_only = |text: &str, others: &str| {
            !text.is_empty() && text.chars().all(|c| c.is_ascii_alphanumeric() || others.contains(c))
        };
        let is_valid = has_only(kind, "[]") && has_only(name, "_:");
        is_valid.then(|| SampledProperty { kind: kind.to_owned(), name: name.to_owned() })
    }
}

/// The suffix in the name of the property that has the indices of an indexed primvar.
pub(crate) const INDICES: &str = ":indices";

/// The format's name in errors.
pub(crate) const FORMAT: &str = "USD";
