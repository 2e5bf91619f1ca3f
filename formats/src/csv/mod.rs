//! Particle tables as text: one row per particle, with any common delimiter.
//!
//! ```text
//!   Simulation of a dam break, t = 0.5 s       free text       skipped with a note
//!   # made by hand                             a comment       #, % or //
//!   x, y, z, "Vel.x [m/s]", ..., type          the header      the first line that names a position
//!   0.1, 0.2, 0.3, 1.5e-3, ..., water          a row           as many cells as the header
//!   0.1, nan, 0.3, 0, ..., water               no position     skipped with a note
//! ```
//!
//! The delimiter is a comma, a semicolon, a vertical bar, a tab or blanks: the one with which the header
//! names a position and the next line has the same number of cells. A comment above the rows can be the
//! header. Without a header, the first three columns are the position. Any line can end with a delimiter. Any
//! cell can be quoted, but cannot span several lines.
//!
//! A column's type follows from its values. It is text if the first value cannot be a number; otherwise
//! integer if all values are integers; otherwise float. Floats have 64 bits, regardless of the number of
//! digits: the digits of one particle must not change how another is read. A note names the columns with
//! integers that are rounded to floats, because they exceed 64 bits or share the column with other numbers.
//!
//! Without names, the first column may also be an id: see `first_column.rs`. The header can consist of
//! the numbers of the columns: `0,1,2`.
//!
//! Text in UTF-16 with a byte-order mark is decoded. Decimal commas are read if a row shows that they are not
//! delimiters, as in `1,5;2,5;3,5`.
//!
//! Not supported: several tables in one file, several frames in one table, quoted line breaks. For LAMMPS
//! dumps see [`crate::lammps`].

mod cell;
mod column;
mod frame;
mod layout;
mod parts;
mod rows;

pub(crate) use layout::{looks_like_particles, names_position};

use std::borrow::Cow;

use crate::row::{FormatRow, ParticleInput};
use crate::{Error, Limits, ParticleFrame, Position, Result};

/// The format's name in errors.
const FORMAT: &str = "delimited text";

/// Reads a table of particles.
///
/// # Errors
///
/// [`Error::Invalid`], with the line, if a row has the wrong number of cells, a numeric column contains text,
/// no position is found, or none is finite; [`Error::Truncated`] in these cases if the file ends within that
/// line, without a line end; [`Error::Unsupported`] for dialects that are recognised but not supported, and
/// for several frames in one table; [`Error::TooLarge`] beyond `limits`.
pub fn read(bytes: &[u8], limits: &Limits) -> Result<ParticleFrame> {
    if bytes.is_empty() {
        return Err(Error::truncated(FORMAT, Position::File, "expected text, found an empty file"));
    }
    let text = decoded(bytes);
    refuse_binary(&text)?;
    let text = layout::with_decimal_points(text);
    let layout = layout::layout(&text, limits)?;
    let table = parts::read_rows(&text, &layout, limits)?;
    frame::check_times(&layout, &table)?;
    frame::frame(layout, table)
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

/// A note if neither a line end nor a blank follows the last number. For formats whose header states the
/// number of rows (LAMMPS, XYZ).
pub(crate) fn open_end_note(rows: &[u8]) -> Option<String> {
    let is_open = !rows.last().is_some_and(u8::is_ascii_whitespace);
    is_open.then(|| {
        "the file ends without a line end: if it is still being written, the last number may lack digits"
            .into()
    })
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
    if layout::group(&names, |_| false).position != Some(position) {
        return Ok(None);
    }
    let layout = layout::TableLayout {
        delimiter: cell::Delimiter::Blanks,
        names,
        position,
        rows_offset: offset,
        rows_line: line,
        notes: Vec::new(),
    };
    let table = parts::read_rows(bytes, &layout, limits)?;
    let found = table.row_count as u64 + table.dropped_row_count;
    if found != count {
        let what = format!("expected {count} rows, found {found}: blank lines and comments are not rows");
        return Err(Error::invalid(FORMAT, Position::Line(line), what));
    }
    frame::frame(layout, table).map(Some)
}

/// Detects binary data by its first bytes. Without this check, the error would be that of an invalid number.
fn refuse_binary(bytes: &[u8]) -> Result<()> {
    const SAMPLE_BYTES: usize = 64 << 10; // binary data has a control byte in the first few dozen bytes
    let sample = &bytes[..bytes.len().min(SAMPLE_BYTES)];
    let is_control = |byte: &u8| *byte < b' ' && !matches!(byte, b'\t' | b'\n' | b'\r' | 0x0c);
    match sample.iter().position(is_control) {
        Some(offset) => {
            let what = format!(
                "expected text, found the byte 0x{:02x}: this is binary data, or a program wrote 8-bit numbers as \
                 characters, as ParaView does: convert them to 32-bit integers before you save the table",
                sample[offset]
            );
            Err(Error::invalid(FORMAT, Position::Offset(offset as u64), what))
        }
        None => Ok(()),
    }
}

/// The row in the table of formats.
pub(crate) static ROW: FormatRow = FormatRow {
    particles: Some(ParticleInput::new(read)),
    ..FormatRow::new(FORMAT, &["csv", "tsv", "txt", "dat", "asc", "xyz", "pts"])
};
