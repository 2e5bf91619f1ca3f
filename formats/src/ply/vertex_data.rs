//! The PLY properties that store vertex attributes.
//!
//! ```text
//!   colour     red green blue [alpha]   bytes: supported by all readers of coloured PLY
//!   velocity   vx vy vz                 floats
//!   others     name                     floats
//!     2 to 4 values: name_x name_y [name_z [name_w]]
//!     more values:   name_0 name_1 ..
//!   integers   names as for others      int if all values fit, else double
//!   strings    names as for others      int: the index of a string listed in a comment; −1 for none
//! ```

use crate::data::{VertexAttribute, VertexValues};
use crate::provenance::escape;
use crate::vertex_attributes::{Purpose, UsedNames, clamp_note, plain_name, purposes, string_index};

/// Integers up to this magnitude are exact as 64-bit floats.
const EXACT_INTEGER_MAX: u64 = 1 << 53;
/// Maximum size in bytes of the comments with the strings of an attribute: some readers limit the header's
/// size.
const STRINGS_BYTES_MAX: usize = 64 << 10;

/// An attribute that can be stored: one PLY property for each of its components, all of one type.
pub(super) struct PlyAttribute<'a> {
    names: Vec<String>,
    values: StoredValues<'a>,
}

/// The stored type and the source of the values.
enum StoredValues<'a> {
    Floats(&'a [f32]),
    /// Numbers from 0 to 1, stored as 0 to 255.
    Bytes(&'a [f32]),
    Ints(&'a [i64]),
    Doubles(&'a [i64]),
    Strings(&'a [String], &'a [i32]),
}

/// Notes on vertex attributes that a PLY file cannot store exactly.
pub fn attribute_notes(attributes: &[VertexAttribute]) -> Vec<String> {
    let mut notes = Vec::new();
    assign_names(attributes, &mut notes);
    notes
}

/// The attributes that can be stored, in order.
pub(super) fn stored_attributes<'a>(attributes: &[VertexAttribute<'a>]) -> Vec<PlyAttribute<'a>> {
    assign_names(attributes, &mut Vec::new())
}

fn assign_names<'a>(attributes: &[VertexAttribute<'a>], notes: &mut Vec<String>) -> Vec<PlyAttribute<'a>> {
    let mut used = UsedNames::new(&["x", "y", "z", "nx", "ny", "nz"]);
    let mut placed = Vec::new();
    for (attribute, purpose) in attributes.iter().zip(purposes(attributes)) {
        let VertexAttribute { name, arity, .. } = *attribute;
        let stem = plain_name(name);
        let (names, usual) = match purpose {
            Purpose::Color(_) => (used.take("", |stem| color_names(stem, arity)), color_names("", arity)),
            Purpose::Velocity => (used.take("v", velocity_names), velocity_names("v")),
            Purpose::Acceleration | Purpose::Other => {
                (used.take(&stem, |stem| component_names(stem, arity)), component_names(name, arity))
            }
        };
        let column = PlyAttribute { values: values_of(attribute, purpose, notes), names };
        if column.comments().len() > STRINGS_BYTES_MAX {
            notes.push(format!("{name} is missing in the .ply: its strings are too long for the header"));
            continue;
        }
        if column.names != usual {
            notes.push(format!("{name} is named {} in the .ply", column.names.join(", ")));
        }
        placed.push(column);
    }
    placed
}

fn color_names(stem: &str, arity: usize) -> Vec<String> {
    ["red", "green", "blue", "alpha"].iter().take(arity).map(|name| format!("{name}{stem}")).collect()
}

fn velocity_names(stem: &str) -> Vec<String> {
    ["x", "y", "z"].map(|axis| format!("{stem}{axis}")).to_vec()
}

pub(super) fn component_names(stem: &str, arity: usize) -> Vec<String> {
    match arity {
        1 => vec![stem.into()],
        2..=4 => ["x", "y", "z", "w"].iter().take(arity).map(|axis| format!("{stem}_{axis}")).collect(),
        _ => (0..arity).map(|index| format!("{stem}_{index}")).collect(),
    }
}

fn values_of<'a>(
    attribute: &VertexAttribute<'a>,
    purpose: Purpose<'a>,
    notes: &mut Vec<String>,
) -> StoredValues<'a> {
    let name = attribute.name;
    match (attribute.values, purpose) {
        (_, Purpose::Color(values)) => {
            notes.extend(clamp_note(name, values, "the .ply"));
            StoredValues::Bytes(values)
        }
        (VertexValues::Numbers(values), _) => StoredValues::Floats(values),
        (VertexValues::Strings { table, indices }, _) => StoredValues::Strings(table, indices),
        (VertexValues::Integers(values), _) => {
            if values.iter().all(|&value| i32::try_from(value).is_ok()) {
                return StoredValues::Ints(values);
            }
            let rounded = values.iter().filter(|value| value.unsigned_abs() > EXACT_INTEGER_MAX).count();
            if rounded != 0 {
                notes.push(format!("{rounded} values of {name} are beyond ±2⁵³ and are rounded in the .ply; .vtp stores them exactly"));
            }
            StoredValues::Doubles(values)
        }
    }
}

/// The header comments that list the strings of a string attribute, each with its index.
pub(super) fn string_comments(name: &str, table: &[String]) -> String {
    let line =
        |(index, text): (usize, &String)| format!("comment string {index} of {name}: {}\n", escape(text));
    table.iter().enumerate().map(line).collect()
}

impl PlyAttribute<'_> {
    /// The header lines that declare the properties.
    pub(super) fn properties(&self) -> String {
        let kind = match self.values {
            StoredValues::Floats(_) => "float",
            StoredValues::Bytes(_) => "uchar",
            StoredValues::Ints(_) | StoredValues::Strings(..) => "int",
            StoredValues::Doubles(_) => "double",
        };
        self.names.iter().map(|name| format!("property {kind} {name}\n")).collect()
    }

    /// The header comments with the strings to which the indices of a string attribute refer; empty for other
    /// attributes.
    pub(super) fn comments(&self) -> String {
        let StoredValues::Strings(table, _) = self.values else { return String::new() };
        string_comments(&self.names[0], table)
    }

    /// Appends the values of a vertex.
    pub(super) fn append(&self, vertex: usize, bytes: &mut Vec<u8>) {
        let arity = self.names.len();
        let range = vertex * arity..(vertex + 1) * arity;
        match self.values {
            StoredValues::Floats(values) => {
                bytes.extend(values[range].iter().flat_map(|value| value.to_le_bytes()))
            }
            StoredValues::Bytes(values) => bytes.extend(values[range].iter().map(|&value| byte_of(value))),
            StoredValues::Ints(values) => {
                #[expect(clippy::cast_possible_truncation, reason = "all values were checked to fit")]
                bytes.extend(values[range].iter().flat_map(|&value| (value as i32).to_le_bytes()));
            }
            StoredValues::Doubles(values) => {
                bytes.extend(values[range].iter().flat_map(|&value| (value as f64).to_le_bytes()));
            }
            StoredValues::Strings(table, indices) => {
                bytes.extend(
                    indices[range].iter().flat_map(|&index| string_index(index, table).to_le_bytes()),
                );
            }
        }
    }
}

fn byte_of(value: f32) -> u8 {
    #[expect(clippy::cast_possible_truncation, reason = "clamped to the range of a byte")]
    let byte = (value.clamp(0.0, 1.0) * 255.0).round_ties_even() as u8;
    byte
}
