//! Where files store vertex attributes, and under which names.
//!
//! Formats differ in the attributes that they can store. Each writer decides where an attribute goes, and
//! adds a note for each attribute that it cannot store exactly. `docs/method.md` has the table.
//!
//! Writers store colours exactly as the particles have them, without a transfer curve. glTF defines colours
//! as linear. The colours of simulations are linear as well, so they look right.

use std::borrow::Cow;
use std::collections::HashSet;
use std::ops::Range;

use crate::core::columns::radius_scale;
use crate::core::data::{AttributeRole, FileAttribute, ParticleFrame, Values, VertexAttribute, VertexValues};
use crate::core::error::{Error, Position, Result};
use crate::core::number::append_bytes;

/// Attributes that formats treat specially.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Purpose<'a> {
    /// Three numbers per vertex.
    Velocity,
    /// Three numbers per vertex. Only USD has a property for them.
    Acceleration,
    /// Three or four numbers per vertex; contains these numbers.
    Color(&'a [f32]),
    /// Two numbers per vertex.
    Texture,
    /// Any other attribute.
    Other,
}

/// The purpose of each attribute. If several attributes have the same special purpose, only the first gets
/// it; the others are [`Other`](Purpose::Other).
pub(crate) fn purposes<'a>(attributes: &[VertexAttribute<'a>]) -> Vec<Purpose<'a>> {
    let mut found: Vec<Purpose> = Vec::with_capacity(attributes.len());
    for VertexAttribute { role, arity, values, .. } in attributes {
        let purpose = match (role, arity, values) {
            (Some(AttributeRole::Velocity), 3, VertexValues::Numbers(_)) => Purpose::Velocity,
            (Some(AttributeRole::Acceleration), 3, VertexValues::Numbers(_)) => Purpose::Acceleration,
            (Some(AttributeRole::Color), 3 | 4, VertexValues::Numbers(values)) => Purpose::Color(values),
            (Some(AttributeRole::TextureCoordinates), 2, VertexValues::Numbers(_)) => Purpose::Texture,
            _ => Purpose::Other,
        };
        let is_used =
            found.iter().any(|other| std::mem::discriminant(other) == std::mem::discriminant(&purpose));
        found.push(if is_used { Purpose::Other } else { purpose });
    }
    found
}

/// A note on a colour with values outside 0 to 1, for a file that can only store this range.
pub(crate) fn clamp_note<'a>(
    name: &str,
    values: impl IntoIterator<Item = &'a f32>,
    file: &str,
) -> Option<String> {
    let cut = values.into_iter().filter(|value| !(0.0..=1.0).contains(*value)).count();
    (cut != 0).then(|| format!("{cut} values of {name} are outside 0 to 1; they are clamped in {file}"))
}

/// The index of a string, or −1 if it is outside the table.
pub(crate) fn string_index(index: i32, table: &[String]) -> i32 {
    let is_one = usize::try_from(index).is_ok_and(|index| index < table.len());
    if is_one { index } else { -1 }
}

/// A name in which `_` replaces every character that is not an ASCII letter, digit or underscore.
pub(crate) fn plain_name(name: &str) -> String {
    let plain = |c: char| if c.is_ascii_alphanumeric() { c } else { '_' };
    let plain: String = name.trim().chars().map(plain).collect();
    if plain.is_empty() { "attribute".into() } else { plain }
}

/// The names used so far in a file. Names are compared without regard to case, because some readers compare
/// them so.
pub(crate) struct UsedNames(HashSet<String>);

impl UsedNames {
    pub(crate) fn new(reserved: &[&str]) -> UsedNames {
        UsedNames(reserved.iter().map(|name| name.to_ascii_lowercase()).collect())
    }

    /// Reserves and returns a name: the stem, or `stem_2`, `stem_3`, … if it is already used.
    pub(crate) fn take(&mut self, stem: &str) -> String {
        self.take_all(stem, |stem| vec![stem.to_owned()]).concat()
    }

    /// Reserves and returns the names that `names_of` derives from a stem. If one of them is already used,
    /// tries `stem_2`, `stem_3`, … until all derived names are free.
    pub(crate) fn take_all(&mut self, stem: &str, names_of: impl Fn(&str) -> Vec<String>) -> Vec<String> {
        let mut names = names_of(stem);
        let mut number = 2u64;
        while names.iter().any(|name| self.0.contains(&name.to_ascii_lowercase())) {
            names = names_of(&format!("{stem}_{number}"));
            number += 1;
        }
        self.0.extend(names.iter().map(|name| name.to_ascii_lowercase()));
        names
    }
}

/// Numbers and the type in which a file stores them.
#[derive(Clone, Copy)]
pub(crate) enum StoredNumbers<'a> {
    U8(&'a [u8]),
    I32(&'a [i32]),
    I64(&'a [i64]),
    F32(&'a [f32]),
    F64(&'a [f64]),
    /// Integers that all fit into 32 bits.
    Narrow(&'a [i64]),
    /// Integers that all fit into 32 bits without a sign.
    Unsigned(&'a [i64]),
    /// Integers as 64-bit floats.
    Rounded(&'a [i64]),
    /// Numbers from 0 to 1 as bytes from 0 to 255.
    Unit(&'a [f32]),
    /// Indices into a table of strings, in 32 bits; −1 for those outside the table.
    Strings(&'a [String], &'a [i32]),
}

impl<'a> StoredNumbers<'a> {
    /// The values of particles in their own type.
    pub(crate) fn of_particles(values: &'a Values) -> StoredNumbers<'a> {
        match values {
            Values::F32(values) => StoredNumbers::F32(values),
            Values::F64(values) => StoredNumbers::F64(values),
            Values::U8(values) => StoredNumbers::U8(values),
            Values::I32(values) => StoredNumbers::I32(values),
            Values::I64(values) => StoredNumbers::I64(values),
            Values::Strings { table, indices } => StoredNumbers::Strings(table, indices),
        }
    }

    /// The values of vertices; integers have 32 bits if all fit.
    pub(crate) fn of_vertices(values: VertexValues<'a>) -> StoredNumbers<'a> {
        match values {
            VertexValues::Numbers(values) => StoredNumbers::F32(values),
            VertexValues::Integers(values) if values.iter().all(|&value| i32::try_from(value).is_ok()) => {
                StoredNumbers::Narrow(values)
            }
            VertexValues::Integers(values) => StoredNumbers::I64(values),
            VertexValues::Strings { table, indices } => StoredNumbers::Strings(table, indices),
        }
    }

    pub(crate) fn len(self) -> usize {
        match self {
            StoredNumbers::U8(values) => values.len(),
            StoredNumbers::I32(values) | StoredNumbers::Strings(_, values) => values.len(),
            StoredNumbers::F32(values) | StoredNumbers::Unit(values) => values.len(),
            StoredNumbers::F64(values) => values.len(),
            StoredNumbers::I64(values) | StoredNumbers::Narrow(values) => values.len(),
            StoredNumbers::Unsigned(values) | StoredNumbers::Rounded(values) => values.len(),
        }
    }

    /// The strings that the values are indices into.
    pub(crate) fn table(self) -> Option<&'a [String]> {
        match self {
            StoredNumbers::Strings(table, _) => Some(table),
            _ => None,
        }
    }

    /// Appends a range of the numbers, least significant byte first.
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "the values fit")]
    pub(crate) fn append(self, range: Range<usize>, out: &mut Vec<u8>) {
        match self {
            StoredNumbers::U8(values) => out.extend_from_slice(&values[range]),
            StoredNumbers::I32(values) => append_bytes(&values[range], i32::to_le_bytes, out),
            StoredNumbers::I64(values) => append_bytes(&values[range], i64::to_le_bytes, out),
            StoredNumbers::F32(values) => append_bytes(&values[range], f32::to_le_bytes, out),
            StoredNumbers::F64(values) => append_bytes(&values[range], f64::to_le_bytes, out),
            StoredNumbers::Narrow(values) => {
                append_bytes(&values[range], |value| (value as i32).to_le_bytes(), out);
            }
            StoredNumbers::Unsigned(values) => {
                append_bytes(&values[range], |value| (value as u32).to_le_bytes(), out);
            }
            StoredNumbers::Rounded(values) => {
                append_bytes(&values[range], |value| (value as f64).to_le_bytes(), out);
            }
            StoredNumbers::Unit(values) => {
                let byte = |value: f32| [(value.clamp(0.0, 1.0) * 255.0).round_ties_even() as u8];
                append_bytes(&values[range], byte, out);
            }
            StoredNumbers::Strings(table, indices) => {
                append_bytes(&indices[range], |index| string_index(index, table).to_le_bytes(), out);
            }
        }
    }
}

// Prepares particle attributes for writing, so that a reader gets back the same values.
//
// Readers halve the values of an attribute with the name of a diameter, and keep its name. Writers therefore
// double these values: otherwise the next reader would halve them a second time. All other attributes are
// written with their values and type unchanged.

/// Fails if an attribute does not have `arity` values for each particle.
pub(crate) fn check(frame: &ParticleFrame, format: &'static str) -> Result<()> {
    let count = frame.positions.len();
    for FileAttribute { name, arity, values, .. } in &frame.attributes {
        let found = values.len();
        if *arity == 0 || count.checked_mul(*arity) != Some(found) {
            let what =
                format!("attribute {name} has {found} values for {count} particles with {arity} values each");
            return Err(Error::invalid(format, Position::File, what));
        }
    }
    Ok(())
}

/// The values of an attribute to write: doubled if its name is that of a diameter.
pub(crate) fn written(attribute: &FileAttribute) -> Cow<'_, Values> {
    let is_diameter = attribute.role == Some(AttributeRole::Radius) && radius_scale(&attribute.name) != 1.0;
    if !is_diameter {
        return Cow::Borrowed(&attribute.values);
    }
    let mut doubled = attribute.clone();
    doubled.values.scale(1.0 / radius_scale(&attribute.name));
    Cow::Owned(doubled.values)
}

// Merges pairs of triangles into quads, for formats with polygons.
//
//    d ─── c
//    │ ╲   │     (a b d) (b c d)  ──▶  a b c d, counter-clockwise like the triangles
//    │   ╲ │
//    a ─── b

/// A face of a mesh.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Face {
    Triangle([u32; 3]),
    Quad([u32; 4]),
}

impl Face {
    /// Its vertices, counter-clockwise seen from outside.
    pub(crate) fn corners(&self) -> &[u32] {
        match self {
            Face::Triangle(corners) => corners,
            Face::Quad(corners) => corners,
        }
    }
}

/// The faces whose first triangle is in `range`. `quads` says for each triangle whether it and the next one
/// form a quad; if `quads` is empty, there are no quads. A quad takes the place of its first triangle in the
/// order.
pub(crate) fn faces<'a>(
    triangles: &'a [[u32; 3]],
    quads: &'a [bool],
    range: Range<usize>,
) -> impl Iterator<Item = Face> + 'a {
    let is_quad = |index: usize| quads.get(index).copied().unwrap_or(false);
    range.filter(move |&index| index == 0 || !is_quad(index - 1)).map(move |index| {
        let quad = if is_quad(index) { quad_of(triangles[index], triangles[index + 1]) } else { None };
        quad.map_or(Face::Triangle(triangles[index]), Face::Quad)
    })
}

/// The number of quads among the faces.
pub(crate) fn quad_count(quads: &[bool]) -> usize {
    quads.iter().filter(|&&is_quad| is_quad).count()
}

/// Fails if two triangles marked as a quad share no edge, or if a triangle belongs to two quads.
pub(crate) fn check_quads(format: &'static str, triangles: &[[u32; 3]], quads: &[bool]) -> Result<()> {
    let invalid = |what: String| Err(Error::invalid(format, Position::File, what));
    if !quads.is_empty() && quads.len() != triangles.len() {
        return invalid(format!("there are {} quad flags for {} triangles", quads.len(), triangles.len()));
    }
    let is_none = |&index: &usize| {
        quads[index]
            && (quads.get(index + 1) != Some(&false)
                || quad_of(triangles[index], triangles[index + 1]).is_none())
    };
    match (0..quads.len()).find(is_none) {
        Some(index) => invalid(format!("triangle {index} and the next one do not form a quad")),
        None => Ok(()),
    }
}

/// The quad formed by two triangles, counter-clockwise like them; `None` unless they share an edge that they
/// traverse in opposite directions.
fn quad_of(one: [u32; 3], other: [u32; 3]) -> Option<[u32; 4]> {
    let turns = |[a, b, c]: [u32; 3]| [[a, b, c], [b, c, a], [c, a, b]];
    turns(one).into_iter().find_map(|[a, b, c]| {
        let [.., d] = turns(other).into_iter().find(|[from, to, _]| [*from, *to] == [b, a])?;
        Some([a, d, b, c])
    })
}

/// The usual names of colours, accelerations and texture coordinates.
pub(crate) const COLOR_NAME: &str = "Cd";
pub(crate) const ACCELERATION_NAME: &str = "acceleration";
pub(crate) const TEXTURE_NAME: &str = "uv";

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_sanitised_and_unique() {
        for (name, plain) in [("Cd", "Cd"), ("a b/ü", "a_b__"), ("", "attribute"), (" \n", "attribute")] {
            assert_eq!(plain_name(name), plain);
        }
        let mut used = UsedNames::new(&["x", "y"]);
        let one = |stem: &str| vec![stem.to_string()];
        let two = |stem: &str| vec![format!("{stem}_x"), format!("{stem}_y")];
        assert_eq!(used.take_all("X", one), ["X_2"]);
        assert_eq!(used.take_all("a", two), ["a_x", "a_y"]);
        assert_eq!(used.take_all("A_Y", one), ["A_Y_2"]);
        assert_eq!(used.take_all("a", two), ["a_2_x", "a_2_y"]);
        assert_eq!(used.take_all("a", one), ["a"]);
    }

    #[test]
    fn string_indices_outside_the_table_become_minus_one() {
        let table = ["a".to_string(), "b".to_string()];
        let indices = [0, 1, 2, -1, i32::MIN, i32::MAX].map(|index| string_index(index, &table));
        assert_eq!(indices, [0, 1, -1, -1, -1, -1]);
    }
}
