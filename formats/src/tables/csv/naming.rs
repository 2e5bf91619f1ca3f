//! Names the columns of a table: new names that the user gives, and what to do if the names have no position.

use crate::core::columns::{self, Columns};
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

    /// The columns with their new names, if those name a position.
    pub(super) fn position_among(self, names: Vec<String>) -> Option<NamedColumns> {
        let names = self.applied(names).ok()?;
        let position = group(&names, |_| false).position?;
        Some(NamedColumns { names, position })
    }

    /// Whether a new name says which column is x, so that it need not be the first one.
    pub(super) fn has_new_x(self) -> bool {
        self.renamed.iter().any(|(new, _)| columns::is_same_name(new, AXES[0]))
    }

    /// Why these columns have no position, and what to do.
    pub(super) fn why_none_among(self, names: Vec<String>) -> String {
        let found = excerpts(names.iter());
        if let Err(why) = self.applied(names.clone()) {
            return format!("{why}; found {found}");
        }
        if !self.renamed.is_empty() {
            return format!("{EXPECTED}; found {found}, and --columns names no x, y and z");
        }
        let missing = AXES.into_iter().filter(|axis| !has_name(&names, axis)).map(str::to_owned).collect();
        let columns =
            AXES.map(|axis| format!("{axis}={}", if has_name(&names, axis) { axis } else { "NAME" }));
        format!(
            "{EXPECTED}; found {found}: no column is {}: add it, or name the columns, as in --columns {}, also by numbers \
             from 1 on; lines above them are skipped",
            listed(missing, "or"),
            columns.join(",")
        )
    }
}

/// What a table must have.
pub(super) const EXPECTED: &str =
    "expected a header with position columns, such as x,y,z, or rows of at least three numbers";

/// Column names that include a position.
pub(super) struct NamedColumns {
    pub(super) names: Vec<String>,
    pub(super) position: [usize; 3],
}

/// Groups the columns by their names. Text columns do not form vectors with numeric ones.
pub(super) fn group(names: &[String], is_text: impl Fn(usize) -> bool) -> Columns {
    let columns: Vec<_> = names.iter().enumerate().map(|(index, name)| (&**name, is_text(index))).collect();
    columns::group_columns(&columns)
}

pub(super) fn column_name(index: usize) -> String {
    format!("column_{}", index + 1)
}

/// Whether one of the names is this one, regardless of case, quotes and unit.
fn has_name(names: &[impl AsRef<str>], wanted: &str) -> bool {
    names.iter().any(|name| columns::is_same_name(name.as_ref(), wanted))
}

/// The names of the coordinates.
const AXES: [&str; 3] = ["x", "y", "z"];

/// The column with this name, exactly or regardless of case, quotes and unit; else the one with this number, from 1 on.
fn index_of(names: &[String], column: &str) -> Option<usize> {
    let named = |is: fn(&str, &str) -> bool| names.iter().position(|name| is(name, column));
    let number = || column.parse::<usize>().ok()?.checked_sub(1).filter(|&index| index < names.len());
    named(|name, column| name == column).or_else(|| named(columns::is_same_name)).or_else(number)
}
