//! Names the columns of a table: new names that the user gives, and what to do if the names have no position.

use super::layout::{NamedColumns, column_name, group};
use super::rows::{DELIMITERS, cells, unquoted};
use crate::core::columns;
use crate::core::limits::Limits;
use crate::core::text::{excerpts, listed};

/// How names of columns are read.
#[derive(Clone, Copy)]
pub(super) struct Naming<'a> {
    pub(super) limits: &'a Limits,
    /// New names of columns, each with the name or the number, from 1 on, of a column that must be there.
    pub(super) renamed: &'a [(String, String)],
}

impl<'a> Naming<'a> {
    pub(super) fn new(limits: &'a Limits, renamed: &'a [(String, String)]) -> Naming<'a> {
        Naming { limits, renamed }
    }

    /// The names as they are in the file.
    pub(super) fn unchanged(limits: &'a Limits) -> Naming<'a> {
        Naming::new(limits, &[])
    }

    /// These names with the new ones, or why they cannot have them. A column that has one of the new names already is
    /// named by its number.
    fn applied(self, mut names: Vec<String>) -> std::result::Result<Vec<String>, String> {
        let mut found: Vec<usize> = Vec::new();
        for (new, column) in self.renamed {
            let Some(index) = index_of(&names, column) else {
                return Err(format!("there is no column `{column}`, which --columns names"));
            };
            if let Some(other) = found.iter().position(|other| *other == index) {
                let (other, _) = &self.renamed[other];
                return Err(format!(
                    "--columns names the column `{}` twice, {other} and {new}",
                    names[index]
                ));
            }
            found.push(index);
        }
        for (index, name) in names.iter_mut().enumerate() {
            let is_new = |(new, _): &(String, String)| columns::is_same_name(new, name);
            if !found.contains(&index) && self.renamed.iter().any(is_new) {
                *name = column_name(index);
            }
        }
        for (index, (new, _)) in found.into_iter().zip(self.renamed) {
            names[index].clone_from(new);
        }
        // Otherwise other columns might be the position, such as cx, cy and cz.
        let (known, unknown): (Vec<&str>, Vec<&str>) = AXES.iter().partition(|axis| has_name(&names, axis));
        if self.renamed.iter().any(|(new, _)| has_name(&AXES, new)) && !unknown.is_empty() {
            let [known, unknown] = [known, unknown].map(|axes| axes.join(" and "));
            return Err(format!("--columns names {known}, and no column is {unknown}: name x, y and z"));
        }
        Ok(names)
    }

    /// The position among these columns, of a table that need not have a header.
    pub(super) fn position_among(self, names: Vec<String>) -> Option<NamedColumns> {
        let names = self.applied(names).ok()?;
        let position = group(&names, |_| false).position?;
        Some(NamedColumns { names, position })
    }

    /// The position among columns without names in the file, which are `written` in its place: they have the usual names,
    /// unless new names say what the position is.
    pub(super) fn usual_position(self, written: Vec<String>, usual: NamedColumns) -> Option<NamedColumns> {
        let is_usual = |new: &String| usual.names.iter().any(|name| columns::is_same_name(name, new));
        if self.renamed.iter().any(|(new, _)| is_usual(new)) {
            return None;
        }
        let names = self.applied(written.clone()).ok()?;
        let pairs = names.into_iter().zip(written).zip(usual.names);
        let names: Vec<String> =
            pairs.map(|((name, written), usual)| if name == written { usual } else { name }).collect();
        let position = group(&names, |_| false).position?;
        Some(NamedColumns { names, position })
    }

    /// Why these columns have no position, and what to do.
    pub(super) fn why_none_among(self, names: Vec<String>) -> String {
        let found = excerpts(names.iter());
        if let Err(why) = self.applied(names.clone()) {
            return format!("{why}; found {found}");
        }
        let expected = "expected a header with position columns, such as x,y,z";
        if !self.renamed.is_empty() {
            return format!("{expected}; found {found}, and --columns names no x, y and z");
        }
        let columns = match coordinates(&names) {
            Some(columns) => columns,
            None if AXES.iter().any(|axis| has_name(&names, axis)) => {
                return format!("{expected}; found {found}: {}", add_missing_axes(&names));
            }
            None => "x=NAME,y=NAME,z=NAME, or by their numbers from 1 on".to_owned(),
        };
        format!("{expected}; found {found}: name the columns, as in --columns {columns}")
    }
}

/// Whether one of the names is this one, regardless of case, quotes and unit.
fn has_name(names: &[impl AsRef<str>], wanted: &str) -> bool {
    names.iter().any(|name| columns::is_same_name(name.as_ref(), wanted))
}

/// The names of the coordinates.
const AXES: [&str; 3] = ["x", "y", "z"];

/// The names in a header of two columns that are coordinates.
pub(super) fn two_coordinates(line: &[u8]) -> Option<Vec<String>> {
    DELIMITERS.into_iter().find_map(|delimiter| {
        let names: Vec<String> = cells(line, delimiter)
            .map(|cell| String::from_utf8_lossy(&unquoted(cell)).into_owned())
            .collect();
        let is_axis = |name: &String| has_name(&AXES, name);
        (names.len() == 2 && names.iter().all(is_axis)).then_some(names)
    })
}

/// What to do about columns that name some of the coordinates only.
pub(super) fn add_missing_axes(names: &[String]) -> String {
    let missing = AXES.into_iter().filter(|axis| !has_name(names, axis)).map(str::to_owned).collect();
    let add =
        format!("no column is {}: add it, with zeros if all particles lie in a plane", listed(missing, "or"));
    if names.len() < AXES.len() {
        return add;
    }
    let column = |axis: &&str| format!("{axis}={}", if has_name(names, axis) { axis } else { "NAME" });
    let columns: Vec<String> = AXES.iter().map(column).collect();
    format!("{add}, or name the columns, as in --columns {}", columns.join(","))
}

/// The columns that are coordinates by their last or first letters, as a value of --columns; `None` without any.
fn coordinates(names: &[String]) -> Option<String> {
    let rest_of = |name: &str, axis: char| {
        let name = columns::unquoted(name).to_ascii_lowercase();
        name.strip_suffix(axis).or_else(|| name.strip_prefix(axis)).map(str::to_owned)
    };
    let with = |axis, rest: &str| {
        names.iter().position(|name| rest_of(name, axis).is_some_and(|other| other == rest))
    };
    let by_letters = names.iter().enumerate().find_map(|(x, name)| {
        let rest = rest_of(name, 'x')?;
        Some([x, with('y', &rest)?, with('z', &rest)?])
    });
    let column = |index: usize| {
        let name = columns::unquoted(&names[index]);
        let is_plain = !name.is_empty() && !name.contains([',', '=', ' ', '\'', '"']);
        if is_plain { name.to_owned() } else { (index + 1).to_string() }
    };
    let [x, y, z] = by_letters?.map(column);
    Some(format!("x={x},y={y},z={z}"))
}

/// The column with this name, exactly or regardless of case, quotes and unit; else the one with this number, from 1 on.
fn index_of(names: &[String], column: &str) -> Option<usize> {
    let named = |is: fn(&str, &str) -> bool| names.iter().position(|name| is(name, column));
    let number = || column.parse::<usize>().ok()?.checked_sub(1).filter(|&index| index < names.len());
    named(|name, column| name == column).or_else(|| named(columns::is_same_name)).or_else(number)
}
