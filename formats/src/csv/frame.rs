//! Turns columns into the position and attributes.

use super::FORMAT;
use super::cell::quoted_excerpt;
use super::column::{Column, ColumnValues};
use super::layout::{self, TableLayout};
use super::rows::Table;
use crate::columns::{self, Group};
use crate::{AttributeRole, Error, FileAttribute, FilePositions, ParticleFrame, Position, Result, Values};

/// Refuses a table of several frames, with a column of their times: ids that repeat, or times in ascending
/// order, show that they are not the times of particles.
pub(super) fn check_times(layout: &TableLayout, table: &Table) -> Result<()> {
    let is_time = |name: &String| TIMES.contains(&&*without_unit(name).to_ascii_lowercase());
    let Some(index) = layout.names.iter().position(is_time) else { return Ok(()) };
    let Some(times) = table.columns[index].numbers() else { return Ok(()) };
    let groups = layout::group(&layout.names, |index| table.columns[index].is_text()).groups;
    let id = groups.iter().find(|group| group.role == Some(AttributeRole::Id));
    let is_several = match id.and_then(|id| table.columns[id.columns[0]].numbers()) {
        Some(mut ids) => {
            ids.sort_unstable_by(f64::total_cmp);
            ids.windows(2).any(|pair| pair[0] == pair[1])
        }
        None => times.is_sorted(),
    };
    let mut known = times.iter().filter(|time| !time.is_nan());
    let first = known.next();
    let other = known.find(|&time| Some(time) != first).filter(|_| is_several);
    let (Some(first), Some(other)) = (first, other) else { return Ok(()) };
    let what = format!(
        "the column {} has several values, such as {first} and {other}, so the table has several frames: \
         save each as a file of its own",
        quoted_excerpt(layout.names[index].as_bytes())
    );
    Err(Error::unsupported(FORMAT, what))
}

/// Names of a column with the time of a frame, in lower case.
const TIMES: [&str; 6] = ["time", "timestep", "time_step", "time step", "step", "frame"];

/// Groups the columns by their names.
///
/// # Errors
/// If there are rows, and none has a finite position.
pub(super) fn frame(layout: TableLayout, mut table: Table) -> Result<ParticleFrame> {
    let mut notes = layout.notes;
    if table.dropped_row_count != 0 {
        let (dropped, all) = (table.dropped_row_count, table.dropped_row_count + table.row_count as u64);
        if table.row_count == 0 {
            let what = format!("none of the {all} rows has a finite position");
            return Err(Error::invalid(FORMAT, Position::File, what));
        }
        notes.push(format!("skipped {dropped} of {all} rows without a finite position"));
    }
    let [x, ..] = layout.position;
    if let Some(unit) = columns::unit_of(&layout.names[x]).filter(|&unit| unit != "m") {
        notes.push(format!("positions are in {unit:?} and are not converted"));
    }

    let is_text = |index: usize| table.columns[index].is_text();
    let groups = layout::group(&layout.names, is_text).groups;
    let positions = positions(&mut table.columns, layout.position, table.row_count);
    let mut attributes = Vec::with_capacity(groups.len());
    for group in groups {
        if group.scale != 1.0 && !table.columns[group.columns[0]].is_text() {
            let name = without_unit(&group.name);
            notes.push(format!("`{name}` looks like a diameter: the radius is half of it"));
        }
        if table.columns[group.columns[0]].is_text() {
            take_texts(&group, &layout.names, &mut table.columns, &mut attributes);
        } else {
            let values = numbers(&group, &mut table.columns, table.row_count);
            let name = without_unit(&group.name);
            attributes.push(FileAttribute { name, arity: group.arity(), role: group.role, values });
        }
    }
    for (name, column) in layout.names.iter().zip(&table.columns) {
        notes.extend(column.has_rounded_integer.then(|| {
            format!("integers of {name:?} are rounded: some exceed 64 bits, so all become 64-bit floats")
        }));
    }
    Ok(ParticleFrame { positions, attributes, notes })
}

fn positions(columns: &mut [Column], position: [usize; 3], row_count: usize) -> FilePositions {
    let [x, y, z] = position.map(|index| take_reals(&mut columns[index]));
    FilePositions::F64((0..row_count).map(|row| [x[row], y[row], z[row]]).collect())
}

/// Makes a separate attribute of each text column, because each column has its own table of strings.
fn take_texts(group: &Group, names: &[String], columns: &mut [Column], attributes: &mut Vec<FileAttribute>) {
    for &index in &group.columns {
        let empty = ColumnValues::Reals(Vec::new());
        if let ColumnValues::Texts(texts) = std::mem::replace(&mut columns[index].values, empty) {
            let values = Values::Strings { table: texts.table, indices: texts.indices };
            // Strings can identify a phase, but they cannot be a velocity or another quantity.
            let role = group.role.filter(|&role| role == AttributeRole::Kind);
            attributes.push(FileAttribute { name: without_unit(&names[index]), arity: 1, role, values });
        }
    }
}

/// The values of a group, row by row: 64-bit floats, or integers in the narrowest type that fits all.
fn numbers(group: &Group, columns: &mut [Column], row_count: usize) -> Values {
    if let Some(range) = integer_range(group, columns) {
        let all = |low: i64, high: i64| range.is_none_or(|(min, max)| low <= min && max <= high);
        // A colour with only the values 0 and 1 probably has floats that were printed without decimals.
        let are_reals = match group.role {
            Some(
                AttributeRole::Velocity
                | AttributeRole::Acceleration
                | AttributeRole::Normal
                | AttributeRole::Radius
                | AttributeRole::Density
                | AttributeRole::Mass,
            ) => true,
            Some(AttributeRole::Color) => all(0, 1),
            Some(AttributeRole::Id | AttributeRole::Kind) | None => false,
        };
        if !are_reals {
            let integers = interleaved(group, row_count, |index| take_integers(&mut columns[index]));
            return if group.role == Some(AttributeRole::Color) && all(0, u8::MAX.into()) {
                Values::U8(integers.into_iter().filter_map(|value| u8::try_from(value).ok()).collect())
            } else if all(i32::MIN.into(), i32::MAX.into()) {
                Values::I32(integers.into_iter().filter_map(|value| i32::try_from(value).ok()).collect())
            } else {
                Values::I64(integers)
            };
        }
    }
    let mut reals = interleaved(group, row_count, |index| take_reals(&mut columns[index]));
    if group.scale != 1.0 {
        reals.iter_mut().for_each(|value| *value *= group.scale);
    }
    Values::F64(reals)
}

/// The smallest and largest value of a group, if all its columns are integers. The inner option is `None` if
/// the group has no values.
fn integer_range(group: &Group, columns: &[Column]) -> Option<Option<(i64, i64)>> {
    let mut range: Option<(i64, i64)> = None;
    for &index in &group.columns {
        let ColumnValues::Integers(integers) = &columns[index].values else { return None };
        for &value in integers {
            let (min, max) = range.unwrap_or((value, value));
            range = Some((min.min(value), max.max(value)));
        }
    }
    Some(range)
}

/// Interleaves the columns of a group.
fn interleaved<T: Copy>(group: &Group, row_count: usize, mut take: impl FnMut(usize) -> Vec<T>) -> Vec<T> {
    if let [single] = group.columns[..] {
        return take(single);
    }
    let columns: Vec<Vec<T>> = group.columns.iter().map(|&index| take(index)).collect();
    let mut values = Vec::with_capacity(row_count * columns.len());
    for row in 0..row_count {
        values.extend(columns.iter().map(|column| column[row]));
    }
    values
}

fn take_reals(column: &mut Column) -> Vec<f64> {
    column.reals().map(std::mem::take).unwrap_or_default()
}

fn take_integers(column: &mut Column) -> Vec<i64> {
    match &mut column.values {
        ColumnValues::Integers(integers) => std::mem::take(integers),
        _ => Vec::new(),
    }
}

/// The name of an attribute: that of the column, without quotes and unit.
fn without_unit(name: &str) -> String {
    let name = columns::unquoted(name);
    match columns::unit_of(name) {
        Some(_) => {
            let end = name.rfind(['[', '(']).unwrap_or(name.len());
            name[..end].trim_end().into()
        }
        None => name.into(),
    }
}
