//! Turns named arrays into a frame of particles.
//!
//! NumPy archives, VTK files and Houdini geometry all describe particles by named arrays of one or more
//! values per particle. This module interprets them for all three:
//!
//! ```text
//!   "pos" (N, 3)                    the position, unless the format itself specifies one
//!   "q" (N, 3), "qd" (N, 3)         position and velocity of simulators: see PAIRS
//!   "any" (N, 3)                    the position, if it has real numbers, no other array is longer, none of three
//!                                   columns is as long, and there are no x, y and z
//!   "x" (N), "y" (N), "z" (N)       the same, in three arrays
//!   "vel" (N, 3)                    Velocity
//!   "vx" (N), "vy" (N), "vz" (N)    joined to "v" (N, 3): Velocity
//!   "width" (N)                     Radius, halved
//!   "stress" (N, 6)                 an attribute without a role
//! ```

use std::collections::HashSet;
use std::mem::discriminant;

use crate::core::columns::{Group, group_columns, position_rank, radius_scale, role_of, roles_of, with_role};
use crate::core::data::{AttributeRole, FileAttribute, FilePositions, ParticleFrame, Values};
use crate::core::matrix::{Matrix, change_vectors, determinant, normal_transform, transformed};
use crate::core::number::{self, append_any, interleaved};
use crate::core::text::excerpt;

/// Builds a frame. Without `positions`, looks for them among the arrays, and returns `None` if there are
/// none. Skips arrays whose length does not match the number of particles, with a note.
pub(crate) fn frame_of(
    positions: Option<FilePositions>,
    mut arrays: Vec<FileAttribute>,
) -> Option<ParticleFrame> {
    let named = positions
        .or_else(|| take_vector_position(&mut arrays, named_position).map(|(_, positions)| positions))
        .or_else(|| take_column_position(&mut arrays));
    let (unnamed, positions) = match named {
        Some(positions) => (None, positions),
        None => {
            let index = unnamed_position(&arrays.iter().map(ArrayShape::of).collect::<Vec<_>>())?;
            let FileAttribute { name, values, .. } = arrays.remove(index);
            (Some(name), number::positions(values)?)
        }
    };
    let mut notes = take_mismatched(&mut arrays, positions.len());
    let arrays = joined(arrays);
    let named: Vec<(&str, usize)> = arrays.iter().map(|array| (&*array.name, array.arity)).collect();
    let mut roles = roles_of(&named);
    let is_same = |name: &str, other: &str| name.eq_ignore_ascii_case(other);
    let pair =
        PAIRS.iter().find(|(position, _)| unnamed.as_ref().is_some_and(|name| is_same(name, position)));
    if let Some((_, velocity)) = pair
        && let Some(index) = named.iter().position(|&(name, arity)| arity == 3 && is_same(name, velocity))
    {
        roles[index] = Some(AttributeRole::Velocity);
    }
    if let (Some(name), None) = (&unnamed, pair) {
        notes.push(format!("`{}` is used as the position", excerpt(name)));
    }
    let attribute =
        |(array, role): (FileAttribute, _)| with_role(array.name, array.arity, role, array.values);
    let attributes: Vec<FileAttribute> = arrays.into_iter().zip(roles).map(attribute).collect();
    notes.extend(attributes.iter().filter_map(note_on_diameter));
    Some(ParticleFrame { positions, attributes, notes })
}

/// An array that may not be read yet.
#[derive(Clone, Copy)]
pub(crate) struct ArrayShape<'a> {
    pub(crate) name: &'a str,
    /// Number of values per row.
    pub(crate) arity: usize,
    pub(crate) row_count: usize,
    /// Whether the values are floats.
    pub(crate) is_real: bool,
}

impl<'a> ArrayShape<'a> {
    pub(crate) fn of(array: &'a FileAttribute) -> ArrayShape<'a> {
        ArrayShape {
            name: &array.name,
            arity: array.arity,
            row_count: array.particle_count(),
            is_real: matches!(array.values, Values::F32(_) | Values::F64(_)),
        }
    }
}

/// The number of particles of arrays: that of the position. `None` if no name says that it is one.
pub(crate) fn position_count(arrays: &[ArrayShape]) -> Option<usize> {
    let vectors: Vec<_> = arrays.iter().filter(|array| array.arity == 3).collect();
    let names: Vec<&str> = vectors.iter().map(|array| array.name).collect();
    if let Some(index) = named_position(&names) {
        return Some(vectors[index].row_count);
    }
    let singles: Vec<_> = arrays.iter().filter(|array| array.arity == 1).collect();
    let columns: Vec<_> = singles.iter().map(|array| (array.name, ())).collect();
    let [x, ..] = group_columns(&columns).position?;
    singles.get(x).map(|array| array.row_count)
}

/// The number of particles of arrays without such a name, if one of them must be the position.
pub(crate) fn unnamed_position_count(arrays: &[ArrayShape]) -> Option<usize> {
    unnamed_position(arrays).map(|index| arrays[index].row_count)
}

/// A part of a frame, such as one of several objects in a file: its particles, and arrays with a value for each.
#[derive(Debug, Default)]
pub(crate) struct ParticlePart {
    pub(crate) positions: FilePositions,
    pub(crate) arrays: Vec<FileAttribute>,
}

/// Joins parts to one. Leaves out arrays that not all parts with particles have with the same type, with a note that
/// names the parts by `kind`.
pub(crate) fn joined_parts(parts: Vec<ParticlePart>, kind: &str, notes: &mut Vec<String>) -> ParticlePart {
    let mut parts = parts.into_iter().filter(|part| !part.positions.is_empty());
    let mut all = parts.next().unwrap_or_default();
    for part in parts {
        all.positions.append(part.positions);
        let mut more = part.arrays;
        let mut has_more = |array: &mut FileAttribute| {
            let same = |more: &mut FileAttribute| (&more.name, more.arity) == (&array.name, array.arity);
            let found = more.extract_if(.., same).next();
            found.is_some_and(|found| append_any(&mut array.values, found.values))
        };
        let mut lost: Vec<FileAttribute> = all.arrays.extract_if(.., |array| !has_more(array)).collect();
        lost.append(&mut more);
        lost.sort_by(|one, other| one.name.cmp(&other.name));
        for FileAttribute { name, .. } in lost {
            let note = format!("skipped the array `{}`: it is not the same in all {kind}", excerpt(&name));
            if !notes.contains(&note) {
                notes.push(note);
            }
        }
    }
    all
}

/// Joins parts to one frame, like [`joined_parts`], with a note on their number, and `notes`, each once.
pub(crate) fn frame_of_parts(
    mut parts: Vec<ParticlePart>,
    kind: &str,
    mut notes: Vec<String>,
) -> ParticleFrame {
    if parts.len() > 1 {
        notes.push(format!("joined the particles of {} {kind}", parts.len()));
    }
    for part in &mut parts {
        notes.extend(take_mismatched(&mut part.arrays, part.positions.len()));
    }
    let ParticlePart { positions, arrays } = joined_parts(parts, kind, &mut notes);
    let mut frame = frame_of(Some(positions), arrays).unwrap_or_default();
    notes.append(&mut frame.notes);
    let mut seen = HashSet::new();
    notes.retain(|note| seen.insert(note.clone()));
    ParticleFrame { notes, ..frame }
}

/// Removes arrays whose length does not match the number of particles, and returns a note for each.
fn take_mismatched(arrays: &mut Vec<FileAttribute>, particle_count: usize) -> Vec<String> {
    let fits = |array: &FileAttribute| {
        array.arity != 0 && array.arity.checked_mul(particle_count) == Some(array.values.len())
    };
    let note = |array: FileAttribute| {
        format!(
            "skipped `{}`: it has {} rows for {particle_count} particles",
            excerpt(&array.name),
            array.particle_count()
        )
    };
    arrays.extract_if(.., |array| !fits(array)).map(note).collect()
}

/// Takes the position, with its name, from the arrays with three values per particle: the one that `find` chooses by
/// their names.
fn take_vector_position(
    arrays: &mut Vec<FileAttribute>,
    find: fn(&[&str]) -> Option<usize>,
) -> Option<(String, FilePositions)> {
    let is_vector =
        |array: &FileAttribute| array.arity == 3 && !matches!(array.values, Values::Strings { .. });
    let vectors: Vec<usize> = (0..arrays.len()).filter(|&index| is_vector(&arrays[index])).collect();
    let names: Vec<&str> = vectors.iter().map(|&index| &*arrays[index].name).collect();
    let index = vectors[find(&names)?];
    let FileAttribute { name, values, .. } = arrays.remove(index);
    Some((name, number::positions(values)?))
}

/// The position among the names of arrays with three values per particle: the name that ranks first.
pub(crate) fn named_position(names: &[&str]) -> Option<usize> {
    let ranked = names.iter().enumerate().filter_map(|(index, name)| Some((position_rank(name)?, index)));
    ranked.min().map(|(_, index)| index)
}

/// Names of position and velocity in simulators, which mean something else where they are not together: those of
/// Taichi's examples and of Newton's bodies.
const PAIRS: [(&str, &str); 2] = [("f_x", "f_v"), ("q", "qd")];

/// The position of a [pair](PAIRS) among the names of arrays with three values per particle.
pub(crate) fn paired_position(names: &[&str]) -> Option<usize> {
    let named = |wanted: &str| names.iter().position(|name| name.eq_ignore_ascii_case(wanted));
    PAIRS.iter().find_map(|(position, velocity)| Some(named(position).zip(named(velocity))?.0))
}

/// The position among arrays without the name of one: that of a [pair](PAIRS), or the longest array, if it is the only
/// vector of its length, has real numbers and no role.
fn unnamed_position(arrays: &[ArrayShape]) -> Option<usize> {
    let vectors = || arrays.iter().enumerate().filter(|(_, array)| array.arity == 3);
    let names: Vec<&str> = vectors().map(|(_, array)| array.name).collect();
    if let Some(pair) = paired_position(&names) {
        return vectors().nth(pair).map(|(index, _)| index);
    }
    let rows_max = arrays.iter().map(|array| array.row_count).max()?;
    let mut longest = vectors().filter(|(_, array)| array.row_count == rows_max);
    let (index, array) = longest.next()?;
    let is_position = array.is_real && role_of(array.name, 3).is_none();
    (longest.next().is_none() && is_position).then_some(index)
}

/// Takes the position from three arrays with one value per particle, chosen by their names.
fn take_column_position(arrays: &mut Vec<FileAttribute>) -> Option<FilePositions> {
    let singles: Vec<usize> = (0..arrays.len()).filter(|&index| is_column(&arrays[index])).collect();
    let columns: Vec<_> = singles.iter().map(|&index| (&*arrays[index].name, ())).collect();
    let position = group_columns(&columns).position?.map(|column| singles[column]);
    let values = position.map(|index| &arrays[index].values);
    let positions = match interleaved(&values) {
        Some(values) => number::positions(values)?,
        None => {
            let columns = values.map(|values| Values::F64(number::wide(values)));
            number::positions(interleaved(&columns.each_ref())?)?
        }
    };
    let mut index = 0;
    arrays.retain(|_| {
        index += 1;
        !position.contains(&(index - 1))
    });
    Some(positions)
}

fn is_column(array: &FileAttribute) -> bool {
    array.arity == 1 && !matches!(array.values, Values::Strings { .. })
}

/// Joins scalar arrays that have the names of the components of a vector.
fn joined(arrays: Vec<FileAttribute>) -> Vec<FileAttribute> {
    let singles: Vec<usize> = (0..arrays.len()).filter(|&index| is_column(&arrays[index])).collect();
    let column = |&index: &usize| (&*arrays[index].name, discriminant(&arrays[index].values));
    let groups = group_columns(&singles.iter().map(column).collect::<Vec<_>>()).groups;
    let mut vector_at: Vec<Option<FileAttribute>> = arrays.iter().map(|_| None).collect();
    let mut is_joined = vec![false; arrays.len()];
    for Group { name, columns, .. } in groups.into_iter().filter(|group| group.arity() > 1) {
        let members: Vec<usize> = columns.into_iter().map(|column| singles[column]).collect();
        let values: Vec<&Values> = members.iter().map(|&index| &arrays[index].values).collect();
        let (Some(values), Some(&first)) = (interleaved(&values), members.iter().min()) else { continue };
        for &index in &members {
            is_joined[index] = true;
        }
        vector_at[first] = Some(FileAttribute::new(name, members.len(), values));
    }
    let entries = arrays.into_iter().zip(vector_at).zip(is_joined);
    entries.filter_map(|((array, vector), is_joined)| if is_joined { vector } else { Some(array) }).collect()
}

fn note_on_diameter(attribute: &FileAttribute) -> Option<String> {
    let is_halved = attribute.role == Some(AttributeRole::Radius) && radius_scale(&attribute.name) != 1.0;
    is_halved
        .then(|| format!("`{}` looks like a diameter: the radius is half of it", excerpt(&attribute.name)))
}

/// Applies the transform of `owner`, such as a prim, to vectors and radii.
pub(crate) fn placed(arrays: &mut [FileAttribute], matrix: &Matrix, owner: &str, notes: &mut Vec<String>) {
    for FileAttribute { name, arity, values, .. } in arrays {
        match role_of(name, *arity) {
            Some(AttributeRole::Velocity | AttributeRole::Acceleration) => {
                change_vectors(values, |vector| transformed(matrix, vector, 0.0));
            }
            Some(AttributeRole::Normal) => change_vectors(values, normal_transform(matrix)),
            Some(AttributeRole::Radius) => {
                let scale = determinant(matrix).abs().cbrt();
                let mut rows = matrix.iter().take(3).map(|row| row.iter().map(|x| x * x).sum::<f64>().sqrt());
                if rows.any(|length| (length - scale).abs() > 1e-6 * scale) {
                    notes.push(format!(
                        "{} has different scales along its axes: its radii have their mean",
                        excerpt(owner)
                    ));
                }
                if (scale - 1.0).abs() > 1e-9 {
                    values.scale(scale);
                }
            }
            _ => {}
        }
    }
}

/// Joins all points.
pub(crate) fn frame_of_pieces(pieces: Vec<ParticlePart>, mut notes: Vec<String>) -> ParticleFrame {
    let ParticlePart { positions, arrays } = joined_parts(pieces, "pieces", &mut notes);
    // `frame_of` always returns a frame if it gets positions.
    let mut frame = frame_of(Some(positions), arrays).unwrap_or_default();
    frame.notes.append(&mut notes);
    frame
}

#[cfg(test)]
mod tests {
    use super::*;

    fn array(name: &str, arity: usize) -> FileAttribute {
        let values = Values::F32((0..2 * arity).map(|n| n as f32).collect());
        FileAttribute::new(name, arity, values)
    }

    fn short(name: &str) -> FileAttribute {
        FileAttribute::new(name, 1, Values::F32(vec![0.0]))
    }

    /// Describes the first position, then each attribute as `name arity role`.
    fn described(arrays: Vec<FileAttribute>) -> Option<String> {
        let frame = frame_of(None, arrays)?;
        let mut text = match &frame.positions {
            FilePositions::F32(positions) => format!("{:?}", positions[0]),
            FilePositions::F64(positions) => format!("wide {:?}", positions[0]),
        };
        for FileAttribute { name, arity, role, .. } in &frame.attributes {
            text += &format!(" | {name} {arity}");
            text += &role.map_or(String::new(), |role| format!(" {role:?}"));
        }
        Some(text)
    }

    #[test]
    fn names_of_simulators_and_the_only_vector_are_positions() {
        for (names, velocity) in [
            (&["particle_q", "particle_qd"][..], Some("particle_qd")),
            (&["F_x", "F_v"], Some("F_v")),
            (&["particle_pos", "particle_vel"], Some("particle_vel")),
            (&["x", "v"], Some("v")),
            (&["q", "qd"], Some("qd")),
            (&["arr_0"], None),
        ] {
            let frame = frame_of(None, names.iter().map(|name| array(name, 3)).collect()).expect("positions");
            let found = frame.attributes.iter().find(|found| found.role == Some(AttributeRole::Velocity));
            assert_eq!(found.map(|found| &*found.name), velocity, "{names:?}");
            assert_eq!(frame.notes.len(), usize::from(names == ["arr_0"]), "{:?}", frame.notes);
        }
        // A velocity alone, or one of several unknown vectors, does not become the position.
        for names in [&["v"][..], &["a_b", "c_d"]] {
            assert_eq!(frame_of(None, names.iter().map(|name| array(name, 3)).collect()), None, "{names:?}");
        }
        // Columns come first.
        let columns = ["x", "y", "z"].map(|name| array(name, 1));
        for name in ["force", "q"] {
            let frame = frame_of(None, columns.iter().cloned().chain([array(name, 3)]).collect());
            assert_eq!(frame.expect("columns").attributes[0].name, name);
        }
    }

    #[test]
    fn positions_and_vectors_are_recognised() {
        let (wide, text) =
            (Values::F64(vec![5.0; 2]), Values::Strings { table: vec![], indices: vec![0; 2] });
        let wide = FileAttribute::new("z", 1, wide);
        let text = FileAttribute::new("type", 1, text);
        let table = [
            (vec![array("vel", 3), array("pos", 3)], Some("[0.0, 1.0, 2.0] | vel 3 Velocity")),
            (vec![array("x", 1), array("y", 1), array("z", 1)], Some("[0.0, 0.0, 0.0]")),
            (vec![array("x", 1), array("y", 1), wide, text], Some("wide [0.0, 0.0, 5.0] | type 1 Kind")),
            (
                vec![array("vx", 1), array("P", 3), array("vy", 1), array("vz", 1), array("stress", 6)],
                Some("[0.0, 1.0, 2.0] | v 3 Velocity | stress 6"),
            ),
            (vec![array("x", 3)], Some("[0.0, 1.0, 2.0]")),
            (vec![array("v", 3), array("x", 1), array("y", 1)], None),
            // Of other lengths, the columns are not the components of one vector.
            (vec![array("x", 1), array("y", 1), short("z")], None),
            (
                vec![array("P", 3), array("vx", 1), array("vy", 1), short("vz")],
                Some("[0.0, 1.0, 2.0] | vx 1 | vy 1"),
            ),
            (vec![], None),
        ];
        for (arrays, expected) in table {
            let names: Vec<String> = arrays.iter().map(|array| array.name.clone()).collect();
            assert_eq!(described(arrays).as_deref(), expected, "of {names:?}");
        }
    }

    #[test]
    fn arrays_of_wrong_length_are_skipped_with_a_note() {
        let positions = FilePositions::F32(vec![[0.0; 3]; 3]);
        let fits = FileAttribute::new("id", 1, Values::I32(vec![1, 2, 3]));
        let none = FileAttribute::new("none", 0, Values::I32(vec![]));
        let frame = frame_of(Some(positions), vec![array("v", 3), fits, none]).unwrap();
        let names: Vec<&str> = frame.attributes.iter().map(|array| array.name.as_str()).collect();
        assert_eq!(names, ["id"]);
        let expected =
            ["skipped `v`: it has 2 rows for 3 particles", "skipped `none`: it has 0 rows for 3 particles"];
        assert_eq!(frame.notes, expected);
    }

    #[test]
    fn diameters_are_halved_with_a_note() {
        let frame = frame_of(None, vec![array("pos", 3), array("diameter", 1)]).unwrap();
        assert_eq!(frame.attributes[0].values, Values::F32(vec![0.0, 0.5]));
        assert_eq!(frame.notes.len(), 1, "{:?}", frame.notes);
    }
}
