//! What is known of each vertex beside where it is, and the names under which files can hold it.
//!
//! Formats differ in what they have room for. Each writer decides by itself where an attribute goes, and
//! tells in notes what became of those that do not come through as they are:
//!
//! ```text
//!            velocity    colour            other numbers      integers               strings
//!   .glb     _VELOCITY   COLOR_0           _NAME, up to 4     reals, where exact     index, table in extras
//!   .ply     vx vy vz    red green blue    name, name_x ..    int, or double         index, table in comments
//!   .obj     –           v x y z r g b     –                  –                      –
//!   .vtp     its name    its name          its name               32 or 64 bits          index, table in field data
//!   .usda    velocities  displayColor      primvars:name, up to 4 int, or int64          indexed primvars
//!   .stl     –           –                 –                      –                      –
//!   .vdb     velocity    a vector grid     1 or 3 a voxel     –                      –
//! ```
//!
//! Colours are written with the numbers that the particles have; no curve is applied. So glTF, whose colours
//! are linear, shows what was meant if the particles' colours are linear, as those of simulations are.

use std::collections::HashSet;

use crate::data::Role;
use crate::error::{Error, Place, Result};

/// One named attribute of all vertices: borrowed from whoever made it.
#[derive(Clone, Copy, Debug)]
pub struct VertexAttribute<'a> {
    /// Its name among the particles.
    pub name: &'a str,
    /// What it was recognised as.
    pub role: Option<Role>,
    /// Values per vertex, at least 1.
    pub arity: usize,
    /// `arity` values per vertex, vertex by vertex.
    pub values: VertexValues<'a>,
}

/// The values of one attribute.
#[derive(Clone, Copy, Debug)]
pub enum VertexValues<'a> {
    /// Finite numbers.
    Numbers(&'a [f32]),
    /// Numbers that name something.
    Integers(&'a [i64]),
    /// Indices into a table of strings; an index outside the table means none.
    Strings {
        /// The distinct strings.
        table: &'a [String],
        /// One index per component.
        indices: &'a [i32],
    },
}

impl<'a> VertexAttribute<'a> {
    /// Refuses what no file can hold: lengths that do not fit, numbers that are not finite.
    pub(crate) fn check(&self, vertex_count: usize, format: &'static str) -> Result<()> {
        let VertexAttribute { name, arity, values, .. } = self;
        let found = match values {
            VertexValues::Numbers(values) => values.len(),
            VertexValues::Integers(values) => values.len(),
            VertexValues::Strings { indices, .. } => indices.len(),
        };
        let invalid = |what: String| Err(Error::invalid(format, Place::File, what));
        if *arity == 0 || vertex_count.checked_mul(*arity) != Some(found) {
            return invalid(format!("{found} values of {name} for {vertex_count} vertices of {arity} each"));
        }
        if let VertexValues::Numbers(values) = values
            && !all_finite(values)
        {
            return invalid(format!("a value of {name} that is not finite"));
        }
        Ok(())
    }
}

/// What formats have places of their own for.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Purpose<'a> {
    /// Three numbers per vertex.
    Velocity,
    /// Three or four numbers per vertex: these.
    Color(&'a [f32]),
    /// Anything else.
    Other,
}

/// The purpose of each attribute. Where several have one in common, the first gets the place.
pub(crate) fn purposes<'a>(attributes: &[VertexAttribute<'a>]) -> Vec<Purpose<'a>> {
    let mut found: Vec<Purpose> = Vec::with_capacity(attributes.len());
    for VertexAttribute { role, arity, values, .. } in attributes {
        let purpose = match (role, arity, values) {
            (Some(Role::Velocity), 3, VertexValues::Numbers(_)) => Purpose::Velocity,
            (Some(Role::Color), 3 | 4, VertexValues::Numbers(values)) => Purpose::Color(values),
            _ => Purpose::Other,
        };
        let is_taken =
            found.iter().any(|other| std::mem::discriminant(other) == std::mem::discriminant(&purpose));
        found.push(if is_taken { Purpose::Other } else { purpose });
    }
    found
}

/// What to say of a colour where a file has places for numbers from 0 to 1 only, and some are not.
pub(crate) fn cut_note<'a>(
    name: &str,
    values: impl IntoIterator<Item = &'a f32>,
    file: &str,
) -> Option<String> {
    let cut = values.into_iter().filter(|value| !(0.0..=1.0).contains(*value)).count();
    (cut != 0).then(|| format!("{cut} values of {name} are beyond 0 to 1, and cut to it in {file}"))
}

/// Whether all numbers are finite. No branch depends on a single one.
pub(crate) fn all_finite(numbers: &[f32]) -> bool {
    numbers.iter().fold(true, |all, number| all & number.is_finite())
}

/// The index that stands for a string: −1 for none, whichever index says so.
pub(crate) fn string_index(index: i32, table: &[String]) -> i32 {
    let is_one = usize::try_from(index).is_ok_and(|index| index < table.len());
    if is_one { index } else { -1 }
}

/// A name in which every character that is not a letter, a digit or an underscore of ASCII became one.
pub(crate) fn plain_name(name: &str) -> String {
    let plain = |c: char| if c.is_ascii_alphanumeric() { c } else { '_' };
    let plain: String = name.trim().chars().map(plain).collect();
    if plain.is_empty() { "attribute".into() } else { plain }
}

/// The names that a file has so far. Upper and lower case are the same to some readers.
pub(crate) struct NamesTaken(HashSet<String>);

impl NamesTaken {
    pub(crate) fn new(reserved: &[&str]) -> NamesTaken {
        NamesTaken(reserved.iter().map(|name| name.to_ascii_lowercase()).collect())
    }

    /// Takes all names that belong to a stem, or to the first of `stem_2`, `stem_3`, … whose names are free.
    pub(crate) fn take(&mut self, stem: &str, names_of: impl Fn(&str) -> Vec<String>) -> Vec<String> {
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_plain_and_taken_once() {
        for (name, plain) in [("Cd", "Cd"), ("a b/ü", "a_b__"), ("", "attribute"), (" \n", "attribute")] {
            assert_eq!(plain_name(name), plain);
        }
        let mut taken = NamesTaken::new(&["x", "y"]);
        let one = |stem: &str| vec![stem.to_string()];
        let two = |stem: &str| vec![format!("{stem}_x"), format!("{stem}_y")];
        assert_eq!(taken.take("X", one), ["X_2"]);
        assert_eq!(taken.take("a", two), ["a_x", "a_y"]);
        assert_eq!(taken.take("A_Y", one), ["A_Y_2"]);
        assert_eq!(taken.take("a", two), ["a_2_x", "a_2_y"]);
        assert_eq!(taken.take("a", one), ["a"]);
    }

    #[test]
    fn strings_outside_the_table_are_none() {
        let table = ["a".to_string(), "b".to_string()];
        let indices = [0, 1, 2, -1, i32::MIN, i32::MAX].map(|index| string_index(index, &table));
        assert_eq!(indices, [0, 1, -1, -1, -1, -1]);
    }
}
