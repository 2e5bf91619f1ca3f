//! Tables of particles as text: one row per particle, whatever stands between the cells.
//!
//! ```text
//!   Simulation of a dam break, t = 0.5 s       free text       skipped, and told
//!   # made by hand                             a comment       #, % or //
//!   x, y, z, "Vel.x [m/s]", ..., type          the header      the first line that names a position
//!   0.1, 0.2, 0.3, 1.5e-3, ..., water          a row           as many cells as the header
//!   0.1, nan, 0.3, 0, ..., water               no position     left out, and told
//! ```
//!
//! The delimiter is a comma, a semicolon, a vertical bar, a tab or blanks: the one with which the
//! header names a position and the next line has as many cells. A comment right above the rows may be
//! the header. Without any header, the first three columns are the position. A delimiter at the end
//! of a line is allowed everywhere; quotes may surround any cell, on one line.
//!
//! What a column holds is told by its values: text if the first is none that a number can be, else
//! integers as long as all are, else reals. Reals have 64 bits, however few digits are written: the digits of
//! one particle must not change how another is read. Integers that are rounded as reals, being beyond 64 bits or
//! beside other numbers, get a note.
//!
//! Not read: decimal commas, several tables in one file, quoted line breaks; for LAMMPS dumps see [`crate::lammps`].

mod cell;
mod column;
mod frame;
mod layout;
mod parts;
mod rows;

pub(crate) use layout::{looks_like_particles, names_position};

use crate::row::{FormatRow, ParticleInput};
use crate::{Error, Limits, ParticleFrame, Place, Result};

/// The format as users know it, for errors.
const FORMAT: &str = "delimited text";

/// Reads a table of particles.
///
/// # Errors
///
/// [`Error::Invalid`] with the line where a row has too many or too few cells, where text stands in
/// a column of numbers, or if no position can be made out, but [`Error::Short`] if nothing follows that
/// line, not even its end; [`Error::Unsupported`] for dialects that are recognised but not read;
/// [`Error::TooLarge`] beyond `limits`.
pub fn read(bytes: &[u8], limits: &Limits) -> Result<ParticleFrame> {
    if bytes.is_empty() {
        return Err(Error::short(FORMAT, Place::File, "expected text, found an empty file"));
    }
    refuse_binary(bytes)?;
    let layout = layout::layout(bytes, limits)?;
    let table = parts::read_rows(bytes, &layout, limits)?;
    Ok(frame::frame(layout, table))
}

/// What is to be told of rows that another format counts, where the last one has no line end, nor a blank behind it.
pub(crate) fn open_end_note(rows: &[u8]) -> Option<String> {
    let is_open = !rows.last().is_some_and(u8::is_ascii_whitespace);
    is_open.then(|| {
        "The file ends without a line end: if it is still being written, the last number may lack digits."
            .into()
    })
}

/// The rows of a table that another format has a header for: blanks are between the cells.
pub(crate) struct Rows {
    /// One name per column.
    pub(crate) names: Vec<String>,
    /// The columns of the position, which the names must tell as well.
    pub(crate) position: [usize; 3],
    /// Where the first row begins.
    pub(crate) offset: usize,
    /// The line of the first row, from 1.
    pub(crate) line: u64,
    /// How many there are, as the header says.
    pub(crate) count: u64,
}

/// Reads rows up to the end of `bytes`; `None` if the names tell another position.
///
/// # Errors
///
/// Those of [`read`]; [`Error::Invalid`] where there are more or fewer rows than the header says.
pub(crate) fn read_rows(bytes: &[u8], rows: Rows, limits: &Limits) -> Result<Option<ParticleFrame>> {
    let Rows { names, position, offset, line, count } = rows;
    if layout::group(&names, |_| false).position != Some(position) {
        return Ok(None);
    }
    let layout = layout::Layout {
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
        let what = format!("expected {count} rows, found {found}, and lines that are none");
        return Err(Error::invalid(FORMAT, Place::Line(line), what));
    }
    Ok(Some(frame::frame(layout, table)))
}

/// Tells binary data from text by its first bytes, before it is complained about as a bad number.
fn refuse_binary(bytes: &[u8]) -> Result<()> {
    const SAMPLE_BYTES: usize = 64 << 10; // binary data has a control byte in the first few dozen
    if bytes.starts_with(&[0xff, 0xfe]) || bytes.starts_with(&[0xfe, 0xff]) {
        return Err(Error::unsupported(FORMAT, "this is UTF-16 text: save it as UTF-8"));
    }
    let sample = &bytes[..bytes.len().min(SAMPLE_BYTES)];
    let is_control = |byte: &u8| *byte < b' ' && !matches!(byte, b'\t' | b'\n' | b'\r' | 0x0c);
    match sample.iter().position(is_control) {
        Some(offset) => {
            let what = format!("expected text, found the byte 0x{:02x}: this is binary data", sample[offset]);
            Err(Error::invalid(FORMAT, Place::Offset(offset as u64), what))
        }
        None => Ok(()),
    }
}

/// What the table of formats says of it.
pub(crate) static ROW: FormatRow = FormatRow {
    particles: Some(ParticleInput::new(read)),
    ..FormatRow::new(FORMAT, &["csv", "tsv", "txt", "dat", "asc", "xyz", "pts"])
};
