//! How glTF stores vertex attributes.
//!
//! ```text
//!   colour     COLOR_0      three or four floats, linear according to the specification
//!   velocity   _VELOCITY    three floats, in the axes of the positions
//!   acceleration  _ACCELERATION, likewise
//!   others     _NAME        one to four floats; integers of up to 24 bits are exact
//!   strings    _NAME        an index into the list `extras.strings._NAME` of the mesh; −1 for none
//! ```
//!
//! Where the plain name of an attribute differs from the [usual one](usual_name), it is in `extras.names` of
//! the mesh, so that sequences have the names that the files of single frames have.
//!
//! All values are 32-bit floats, because the format requires elements of a multiple of four bytes and has no
//! 32-bit integers for vertices. Floats are stored exactly. An attribute with integers that would be rounded
//! is omitted with a note: a wrong identity is worse than a missing one.

use std::io::Write;

use crate::data::{MeshView, VertexAttribute, VertexValues};
use crate::error::Result;
use crate::le_bytes::{write_f32s, write_pieces};
use crate::vertex_attributes::{Purpose, UsedNames, plain_name, purposes, string_index};

use super::frame_file::{ACCELERATION, COLOR, VELOCITY};

/// Integers up to this magnitude are exact as 32-bit floats.
const EXACT_INTEGER_MAX: u64 = 1 << 24;
/// Number of components of the widest vector.
const ARITY_MAX: usize = 4;

/// An attribute that can be stored.
pub(super) struct GltfAttribute<'a> {
    /// Its glTF name.
    pub(super) semantic: String,
    /// Its [plain name](plain_name), if it differs from the [usual one](usual_name). Velocities have none:
    /// formats have a property for them.
    pub(super) own_name: Option<String>,
    /// Number of values per vertex, one to four.
    pub(super) arity: usize,
    values: VertexValues<'a>,
}

/// Notes on vertex attributes that a glTF file cannot store exactly.
pub fn attribute_notes(attributes: &[VertexAttribute]) -> Vec<String> {
    let mut notes = Vec::new();
    let placed = assign_names(attributes, &mut notes);
    let mut arities =
        placed.iter().filter(|placed| placed.semantic.starts_with('_')).map(|placed| placed.arity);
    let first = arities.next();
    if arities.any(|arity| Some(arity) != first) {
        notes.push(
            "the glTF file has both vector and scalar attributes, on which Blender's importer fails before 5.1: select \
             only vector or only scalar attributes, or use .ply"
                .into(),
        );
    }
    notes
}

/// Those of [`attribute_notes`] that are about values or names that change, for a `.glb` that only a sequence
/// file is made from.
pub(crate) fn loss_notes(attributes: &[VertexAttribute]) -> Vec<String> {
    let mut notes = Vec::new();
    assign_names(attributes, &mut notes);
    notes
}

/// The attributes of a mesh that can be stored, in order.
pub(super) fn stored_attributes<'a>(mesh: &MeshView<'a>) -> Vec<GltfAttribute<'a>> {
    assign_names(mesh.attributes, &mut Vec::new())
}

fn assign_names<'a>(attributes: &[VertexAttribute<'a>], notes: &mut Vec<String>) -> Vec<GltfAttribute<'a>> {
    let mut used = UsedNames::new(&[]);
    let mut placed = Vec::new();
    for (attribute, purpose) in attributes.iter().zip(purposes(attributes)) {
        let VertexAttribute { name, arity, values, .. } = *attribute;
        if let Some(why) = obstacle(attribute) {
            notes.push(format!("{name} is missing in the glTF file: {why}"));
            continue;
        }
        let (stem, usual) = match purpose {
            Purpose::Color(_) => (COLOR.into(), COLOR.into()),
            Purpose::Velocity => (VELOCITY.into(), VELOCITY.into()),
            Purpose::Acceleration => (ACCELERATION.into(), ACCELERATION.into()),
            Purpose::Other => (format!("_{}", plain_name(name)), format!("_{name}")),
        };
        let semantic = used.take(&stem, |stem| vec![stem.to_ascii_uppercase()]).concat();
        if semantic != usual.to_ascii_uppercase() {
            notes.push(format!("{name} is named {semantic} in the glTF file"));
        }
        let own_name = Some(plain_name(name));
        let own_name = own_name.filter(|own| purpose != Purpose::Velocity && *own != usual_name(&semantic));
        placed.push(GltfAttribute { semantic, own_name, arity, values });
    }
    placed
}

/// The usual names of colours and accelerations.
pub(crate) const COLOR_NAME: &str = "Cd";
pub(crate) const ACCELERATION_NAME: &str = "acceleration";

/// The name of most attributes with this glTF name: glTF names start with an underscore and are in upper
/// case.
pub(super) fn usual_name(semantic: &str) -> String {
    match semantic {
        COLOR => COLOR_NAME.to_owned(),
        ACCELERATION => ACCELERATION_NAME.to_owned(),
        _ => semantic.strip_prefix('_').unwrap_or(semantic).to_ascii_lowercase(),
    }
}

/// Why an attribute cannot be stored; `None` if it can.
fn obstacle(attribute: &VertexAttribute) -> Option<String> {
    if attribute.arity > ARITY_MAX {
        return Some(format!("it has {} values per vertex; the limit is {ARITY_MAX}", attribute.arity));
    }
    let VertexValues::Integers(values) = attribute.values else { return None };
    let beyond = values.iter().filter(|value| value.unsigned_abs() > EXACT_INTEGER_MAX).count();
    (beyond != 0).then(|| {
        format!(
            "{beyond} of its values are beyond ±{EXACT_INTEGER_MAX}, where 32-bit floats are not exact; use .ply"
        )
    })
}

impl<'a> GltfAttribute<'a> {
    /// The strings that its values are indices into.
    pub(super) fn table(&self) -> Option<&'a [String]> {
        match self.values {
            VertexValues::Strings { table, .. } => Some(table),
            VertexValues::Numbers(_) | VertexValues::Integers(_) => None,
        }
    }

    pub(super) fn write(&self, out: &mut impl Write) -> Result<()> {
        match self.values {
            VertexValues::Numbers(values) => write_f32s(values, out),
            VertexValues::Integers(values) => write_pieces(values, |value| (value as f32).to_le_bytes(), out),
            VertexValues::Strings { table, indices } => {
                let to_bytes = |index| (string_index(index, table) as f32).to_le_bytes();
                write_pieces(indices, to_bytes, out)
            }
        }
    }
}
