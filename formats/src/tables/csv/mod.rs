//! Particle tables as text: one row per particle, with any common delimiter.
//!
//! ```text
//!   # made by hand                             a comment       #, %, !, ; or //
//!   x, y, z, "Vel.x [m/s]", ..., type          the header      names a position
//!   0.1, 0.2, 0.3, 1.5e-3, ..., water          a row           as many cells as the header
//!   0.1, nan, 0.3, 0, ..., water               no position     skipped with a note
//! ```
//!
//! The rule: the header names x, y and z, as `core::columns` knows them; or the user does; or there is no header, and
//! the first three columns of numbers are the position. A comment above the rows can be the header. What may be
//! something else is refused, with the option that says what it is: a header of other names, a first column of whole
//! numbers beside fractions (see `first_column.rs`), and a first row that may count the rows or the columns.
//! If the user names columns, lines above those are skipped.
//!
//! The delimiter is a comma, a semicolon, a vertical bar, a tab or blanks: the one with which the header
//! names a position and the next line has the same number of cells. Any line can end with a delimiter. Any
//! cell can be quoted, but cannot span several lines.
//!
//! A column's type follows from its values. It is text if the first value cannot be a number; otherwise
//! integer if all values are integers; otherwise float. Floats have 64 bits, regardless of the number of
//! digits: the digits of one particle must not change how another is read. A note names the columns with
//! integers that are rounded to floats, because they exceed 64 bits or share the column with other numbers.
//!
//! Text in UTF-16 with a byte-order mark is decoded. Decimal commas are read if a row shows that they are not
//! delimiters, as in `1,5;2,5;3,5`.
//!
//! Not supported: several tables in one file, several frames in one table, quoted line breaks. For LAMMPS
//! dumps see [`crate::tables::lammps`].

mod layout;
mod naming;
mod rows;

use std::borrow::Cow;
use std::ops::Range;

use rayon::prelude::*;

pub(crate) use layout::{is_other_table, looks_like_particles, names_position};

use crate::core::columns::{self, Group, of_integers};
use crate::core::data::{AttributeRole, FileAttribute, FilePositions, ParticleFrame, Values};
use crate::core::error::{Error, Position, Result};
use crate::core::limits::Limits;
use crate::core::row::{FormatRow, ParticleReader};
use crate::core::times::refuse_several_frames;
use layout::TableLayout;
use naming::Naming;
use rows::{Column, ColumnValues, Table};

/// The format's name in errors.
const FORMAT: &str = "delimited text";

/// Reads a table of particles.
///
/// # Errors
/// Those of [`read_named`].
pub fn read(bytes: &[u8], limits: &Limits) -> Result<ParticleFrame> {
    read_named(bytes, &[], limits)
}

/// Reads a table of particles, some of whose columns get new names: each of `columns` is a new name, with the name or
/// the number, from 1 on, of a column. New names such as `x`, `vy`, `radius` and `id` say what the column means.
///
/// # Errors
///
/// [`Error::Invalid`], with the line, if a row has the wrong number of cells, a numeric column contains text,
/// no position is found, or none is finite; [`Error::Truncated`] in these cases if the file ends within that
/// line, without a line end; [`Error::Unsupported`] for dialects that are recognised but not supported, and
/// for several frames in one table; [`Error::TooLarge`] beyond `limits`.
pub fn read_named(bytes: &[u8], columns: &[(String, String)], limits: &Limits) -> Result<ParticleFrame> {
    if bytes.is_empty() {
        return Err(Error::truncated(FORMAT, Position::File, "expected text, found an empty file"));
    }
    let text = decoded(bytes);
    refuse_binary(&text)?;
    let text = layout::with_decimal_points(text);
    let layout = layout::layout(&text, Naming::new(limits, columns))?;
    let table = read_table_rows(&text, &layout, limits)?;
    let frame = frame(layout, table)?;
    refuse_several_frames(FORMAT, &frame)?;
    Ok(frame)
}

/// Whether a text starts like a table that has all these columns.
pub(crate) fn has_columns(head: &[u8], columns: &[(String, String)]) -> bool {
    layout::layout(&decoded(head), Naming::new(&Limits::default(), columns)).is_ok()
}

/// Text in UTF-16 with a byte-order mark, as UTF-8. Other bytes are unchanged.
pub(crate) fn decoded(bytes: &[u8]) -> Cow<'_, [u8]> {
    let unit: fn([u8; 2]) -> u16 = match bytes {
        [0xff, 0xfe, ..] => u16::from_le_bytes,
        [0xfe, 0xff, ..] => u16::from_be_bytes,
        _ => return Cow::Borrowed(bytes),
    };
    let units = bytes[2..].as_chunks().0.iter().map(|pair| unit(*pair));
    let text: String =
        char::decode_utf16(units).map(|char| char.unwrap_or(char::REPLACEMENT_CHARACTER)).collect();
    Cow::Owned(text.into_bytes())
}

/// The rows of a table whose header belongs to another format. Their cells are separated by blanks.
pub(crate) struct CountedRows {
    /// One name per column.
    pub(crate) names: Vec<String>,
    /// The position columns, which must agree with the names.
    pub(crate) position: [usize; 3],
    /// Offset of the first row.
    pub(crate) offset: usize,
    /// Line number of the first row, starting at 1.
    pub(crate) line: u64,
    /// Number of rows according to the header.
    pub(crate) count: u64,
}

/// Reads rows up to the end of `bytes`; `None` if the names imply other position columns than
/// `rows.position`.
///
/// # Errors
///
/// Those of [`read`]; [`Error::Invalid`] if the number of rows differs from the header's.
pub(crate) fn read_rows(bytes: &[u8], rows: CountedRows, limits: &Limits) -> Result<Option<ParticleFrame>> {
    let CountedRows { names, position, offset, line, count } = rows;
    if naming::group(&names, |_| false).position != Some(position) {
        return Ok(None);
    }
    let layout = layout::TableLayout {
        delimiter: rows::Delimiter::Blanks,
        names,
        position,
        rows_offset: offset,
        rows_line: line,
        notes: Vec::new(),
    };
    let table = read_table_rows(bytes, &layout, limits)?;
    let found = table.row_count as u64 + table.dropped_row_count;
    if found != count {
        let what = format!("expected {count} rows, found {found}: blank lines and comments are not rows");
        return Err(Error::invalid(FORMAT, Position::Line(line), what));
    }
    frame(layout, table).map(Some)
}

/// Detects binary data by its first bytes. Without this check, the error would be that of an invalid number.
fn refuse_binary(bytes: &[u8]) -> Result<()> {
    const SAMPLE_BYTES: usize = 64 << 10; // binary data has a control byte in the first few dozen bytes
    let sample = &bytes[..bytes.len().min(SAMPLE_BYTES)];
    let is_control = |byte: &u8| *byte < b' ' && !matches!(byte, b'\t' | b'\n' | b'\r' | 0x0c);
    match sample.iter().position(is_control) {
        Some(offset) => {
            let what = format!(
                "expected text, found the byte 0x{:02x}: this is binary data: write all numbers as text",
                sample[offset]
            );
            Err(Error::invalid(FORMAT, Position::Offset(offset as u64), what))
        }
        None => Ok(()),
    }
}

/// The row in the table of formats.
pub(crate) static ROW: FormatRow = FormatRow {
    particles: Some(ParticleReader::new(read)),
    ..FormatRow::new(FORMAT, &["csv", "tsv", "txt", "dat", "asc", "xyz", "pts"])
};

// Reads large tables in parts, in parallel.
//
//   x,y,z,id\n │ 0.1,0.2,0.3,1\n ..  │ ..  │ ..  │ ..      parts end at line ends
//              └ each read as a separate table by any free thread, then joined in order
//
// The meaning of a cell depends on the cells above it: `-0` may be an integer or a float, and `7` a number
// or text. So a part that was read separately is used only if it contains no error and the cells above do
// not change the result. Otherwise the part is read again, as a continuation of the rows already joined.
// Thus the table, and any error with its line, are the same as those of a sequential reader.

/// Size of a part: large enough to make the cost of starting one negligible, small enough to share the work.
const PART_BYTES: usize = 1 << 20;

/// Parts per thread held in memory at a time.
const PARTS_PER_THREAD: usize = 4;

/// Reads all rows in the caller's thread pool.
fn read_table_rows(bytes: &[u8], layout: &TableLayout, limits: &Limits) -> Result<Table> {
    read_rows_in_parts(bytes, layout, limits, PART_BYTES)
}

fn read_rows_in_parts(
    bytes: &[u8],
    layout: &TableLayout,
    limits: &Limits,
    part_bytes: usize,
) -> Result<Table> {
    let mut table = Table::with_capacity_for(&bytes[layout.rows_offset..], layout.names.len());
    let thread_count = rayon::current_num_threads();
    if thread_count == 1 || bytes.len() < 2 * part_bytes {
        table.read_more(bytes, layout.rows_offset, layout, limits)?;
        return Ok(table);
    }
    let parts = parts(bytes, layout.rows_offset, part_bytes);
    for parts in parts.chunks(PARTS_PER_THREAD * thread_count) {
        let read_alone = |part: &Range<usize>| {
            let mut alone = Table::with_capacity_for(&bytes[part.clone()], layout.names.len());
            alone.read_more(&bytes[..part.end], part.start, layout, limits).is_ok().then_some(alone)
        };
        let tables: Vec<Option<Table>> = parts.par_iter().map(read_alone).collect();
        for (part, alone) in parts.iter().zip(tables) {
            match alone {
                Some(alone) if can_append(&table, &alone, limits) => append(&mut table, alone),
                _ => table.read_more(&bytes[..part.end], part.start, layout, limits)?,
            }
        }
    }
    Ok(table)
}

/// Splits the bytes from `start` on at line ends. A part extends to the end of its last line, so it can be
/// longer than `part_bytes`.
fn parts(bytes: &[u8], start: usize, part_bytes: usize) -> Vec<Range<usize>> {
    let mut parts = Vec::new();
    let mut at = start;
    while at < bytes.len() {
        let rest = bytes.get(at + part_bytes..).unwrap_or_default();
        // Parts end only at an LF, because an LF may follow a CR.
        let end = rest
            .iter()
            .position(|&byte| byte == b'\n')
            .map_or(bytes.len(), |length| at + part_bytes + length + 1);
        parts.push(at..end);
        at = end;
    }
    parts
}

fn can_append(table: &Table, next: &Table, limits: &Limits) -> bool {
    let row_count = table.row_count as u64 + next.row_count as u64;
    row_count <= limits.particle_count
        && table.columns.iter().zip(&next.columns).all(|(column, next)| column.can_append(next))
}

fn append(table: &mut Table, next: Table) {
    table.columns.iter_mut().zip(next.columns).for_each(|(column, next)| Column::append(column, next));
    table.row_count += next.row_count;
    table.dropped_row_count += next.dropped_row_count;
    table.line_count += next.line_count;
}

// Turns columns into the position and attributes.

/// Groups the columns by their names.
///
/// # Errors
/// If there are rows, and none has a finite position.
fn frame(layout: TableLayout, mut table: Table) -> Result<ParticleFrame> {
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
    let groups = naming::group(&layout.names, is_text).groups;
    let positions = positions(&mut table.columns, layout.position, table.row_count);
    let mut attributes = Vec::with_capacity(groups.len());
    for group in groups {
        if group.scale != 1.0 && !table.columns[group.columns[0]].is_text() {
            let name = columns::without_unit(&group.name);
            notes.push(format!("`{name}` looks like a diameter: the radius is half of it"));
        }
        if table.columns[group.columns[0]].is_text() {
            take_texts(&group, &layout.names, &mut table.columns, &mut attributes);
        } else {
            let values = numbers(&group, &mut table.columns, table.row_count);
            let name = columns::without_unit(&group.name).to_owned();
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
            attributes.push(FileAttribute {
                name: columns::without_unit(&names[index]).to_owned(),
                arity: 1,
                role,
                values,
            });
        }
    }
}

/// The values of a group, row by row: 64-bit floats, or integers in the narrowest type that fits all.
fn numbers(group: &Group, columns: &mut [Column], row_count: usize) -> Values {
    let is_integer = |&index: &usize| matches!(columns[index].values, ColumnValues::Integers(_));
    let mut values = if group.columns.iter().all(is_integer) {
        of_integers(interleaved(group, row_count, |index| take_integers(&mut columns[index])), group.role)
    } else {
        Values::F64(interleaved(group, row_count, |index| take_reals(&mut columns[index])))
    };
    if let Values::F64(reals) = &mut values
        && group.scale != 1.0
    {
        reals.iter_mut().for_each(|value| *value *= group.scale);
    }
    values
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

#[cfg(test)]
mod tests {

    use super::layout;
    use super::*;

    /// The result of reading a text in parts of `part_bytes` bytes, formatted as text.
    fn outcome(text: &[u8], limits: &Limits, part_bytes: usize) -> std::result::Result<String, String> {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(2).build().expect("threads");
        let read = || {
            let layout = layout::layout(text, Naming::new(limits, &[]))?;
            let table = read_rows_in_parts(text, &layout, limits, part_bytes)?;
            frame(layout, table)
        };
        // Debug output distinguishes -0 from 0 and has all digits.
        pool.install(read)
            .map(|frame| format!("{frame:?}"))
            .map_err(|error: crate::Error| format!("{error:?}"))
    }

    /// Lines that affect how other lines are read, inserted among lines that do not.
    const CHANGES: [&str; 22] = [
        "1,2,3,4,5,a",
        "0.5,2,3,4,5,a",
        "-0,2,3,-0,5,b",
        "+1,2,3,+4,5,b",
        "1,2,3,16777217,5,a",
        "1,2,3,100000000000000001,5,a",
        "1,2,3,1e3,5,a",
        "1,2,3,,5,a",
        "1,2,3,,5,",
        "nan,2,3,4.25,5,c",
        "nan,2,3,,5,7",
        "1,2,3,4,5,7",
        "1,2,3,4,5,\"7\"",
        "1,2,3,\"7\",5,a",
        "1,2,3,word,5,a",
        "1,2,3,4",
        "1,2,3,4,5,6,7,8",
        "1,2,word,4,5,a",
        "1,2,0.123456789,4,5,a",
        "# a comment",
        "",
        "  \t ",
    ];

    #[test]
    fn parts_give_the_same_result_as_one_pass() {
        let mut error_count = 0;
        for (first, second) in (0..22).flat_map(|first| (0..22).map(move |second| (first, second))) {
            for (usual, line_end) in [("1,2,3,4,5,a", "\n"), ("0.5,2,3,4.5,5,", "\r\n")] {
                let mut lines = vec![usual; 40];
                lines[9] = CHANGES[first];
                lines[25] = CHANGES[second];
                let text = format!("x,y,z,u,v,kind{line_end}{}", lines.join(line_end));
                let expected = outcome(text.as_bytes(), &Limits::default(), usize::MAX / 2);
                for part_bytes in [1, 30, 100, 220] {
                    let found = outcome(text.as_bytes(), &Limits::default(), part_bytes);
                    assert_eq!(found, expected, "{text} in parts of {part_bytes} bytes");
                }
                error_count += usize::from(expected.is_err());
            }
        }
        assert!((200..700).contains(&error_count), "{error_count} of 968 are wrong");
    }

    #[test]
    fn parts_respect_limits_and_invalid_utf8_like_one_pass() {
        let header = b"x,y,z,kind\n".as_slice();
        let rows = [b"1,2,3,\xff\n".as_slice(), b"1,2,3,\xfe\n", b"1,2,3,w\n"].concat().repeat(20);
        let text = [header, &rows].concat();
        for particle_count in [5, 59, 60] {
            let limits = Limits { particle_count, ..Limits::default() };
            let expected = outcome(&text, &limits, usize::MAX / 2);
            assert_eq!(expected.is_ok(), particle_count == 60);
            assert_eq!(outcome(&text, &limits, 50), expected);
        }
    }
}
