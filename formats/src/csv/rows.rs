//! Reads the rows in a single pass over the bytes.
//!
//! The reader parses a number in place, without locating lines and cells first. If the cell does not end
//! after the number, or does not start with one, the reader examines the whole cell: it can be quoted, a word
//! for a missing value, or text.
//!
//! Large tables are read in parts (see [`super::parts`]), each in a single pass.

use super::FORMAT;
use super::cell::{
    CellValue, Delimiter, cells, has_decimal_comma, parse_cell, quoted_excerpt, quoted_length, unquoted,
};
use super::column::{Column, ColumnValues};
use super::layout::{TableLayout, comment, decimal_commas};
use crate::{Error, Limits, Position, Result};

/// All columns, in file order.
#[derive(Debug)]
pub(super) struct Table {
    pub(super) columns: Vec<Column>,
    /// Number of rows in every column.
    pub(super) row_count: usize,
    /// Number of rows skipped because they have no finite position.
    pub(super) dropped_row_count: u64,
    /// Number of lines read: rows and all others.
    pub(super) line_count: u64,
}

impl Table {
    /// An empty table with capacity for the estimated rows of the text `rows`.
    pub(super) fn with_capacity_for(rows: &[u8], column_count: usize) -> Table {
        let capacity = row_count_estimate(rows, column_count);
        Table {
            columns: (0..column_count).map(|_| Column::with_capacity(capacity)).collect(),
            row_count: 0,
            dropped_row_count: 0,
            line_count: 0,
        }
    }

    /// Reads the rows from offset `start` to the end of `bytes`. `line_count` must be the number of lines
    /// from the first row up to `start`.
    pub(super) fn read_more(
        &mut self,
        bytes: &[u8],
        start: usize,
        layout: &TableLayout,
        limits: &Limits,
    ) -> Result<()> {
        let first_line = layout.rows_line + self.line_count;
        let mut rows = RowReader {
            bytes,
            at: start,
            line: first_line,
            delimiter: match layout.delimiter {
                Delimiter::Byte(delimiter) => Some(delimiter),
                Delimiter::Blanks => None,
            },
            names: &layout.names,
        };
        while rows.next_row() {
            rows.take_row(&mut self.columns, layout.position)?;
            if layout.position.iter().all(|&index| self.columns[index].ends_finite()) {
                self.row_count += 1;
                if limits.particle_count < self.row_count as u64 {
                    let what = format!("the table has more rows than the limit of {}", limits.particle_count);
                    return Err(Error::too_large(FORMAT, what));
                }
            } else {
                self.columns.iter_mut().for_each(Column::pop);
                self.dropped_row_count += 1;
            }
        }
        self.line_count += rows.line - first_line;
        Ok(())
    }
}

/// Estimates the number of rows from the length of the first ones. The estimate never exceeds what the size
/// of the text allows.
fn row_count_estimate(rows: &[u8], column_count: usize) -> usize {
    const SAMPLE_BYTES: usize = 64 << 10;
    let sample = &rows[..rows.len().min(SAMPLE_BYTES)];
    let line_count = 1 + sample.iter().filter(|&&byte| byte == b'\n').count();
    let probable = rows.len() / (sample.len() / line_count).max(1);
    let possible = rows.len() / (2 * column_count).max(1); // each cell has a byte and a delimiter
    (probable + probable / 32).min(possible)
}

/// A read position in the rows.
struct RowReader<'a> {
    bytes: &'a [u8],
    at: usize,
    /// Number of the line that contains `at`, starting at 1.
    line: u64,
    /// `None` means blanks.
    delimiter: Option<u8>,
    names: &'a [String],
}

impl<'a> RowReader<'a> {
    /// Advances to the next line that is neither blank nor a comment.
    fn next_row(&mut self) -> bool {
        loop {
            match self.bytes.get(self.at) {
                None => return false,
                Some(b'\n' | b'\r') => self.end_line(),
                Some(b' ' | b'\t') if self.line_text().trim_ascii().is_empty() => {
                    self.at += self.line_text().len()
                }
                Some(b' ' | b'\t' | b'#' | b'%' | b'/') if comment(self.line_text()).is_some() => {
                    self.at += self.line_text().len();
                }
                Some(_) => return true,
            }
        }
    }

    /// Reads a row into `columns`; afterwards `at` is after its line.
    #[inline]
    fn take_row(&mut self, columns: &mut [Column], position: [usize; 3]) -> Result<()> {
        let start = self.at;
        let column_count = columns.len();
        for (index, column) in columns.iter_mut().enumerate() {
            self.at += blanks(&self.bytes[self.at..], self.delimiter);
            if self.delimiter.is_none() && self.is_at_line_end() {
                return Err(self.wrong_cell_count(start)); // with blanks as delimiter, there are no empty cells
            }
            if !self.take_number(column) {
                self.take_other(column, index, position.contains(&index))?;
            }
            if index + 1 < column_count && self.delimiter.is_some() {
                if self.is_at_line_end() {
                    return Err(self.wrong_cell_count(start));
                }
                self.at += 1; // skips the delimiter: a cell ends at one or at a line end
            }
        }
        if !self.is_at_line_end() {
            self.at += usize::from(self.delimiter.is_some());
            self.at += blanks(&self.bytes[self.at..], self.delimiter);
            if !self.is_at_line_end() {
                return Err(self.wrong_cell_count(start));
            }
        }
        self.end_line();
        Ok(())
    }

    /// Reads a cell that is a plain number, and the blanks after it.
    #[inline]
    fn take_number(&mut self, column: &mut Column) -> bool {
        let text = &self.bytes[self.at..];
        if matches!(column.values, ColumnValues::Texts(_)) {
            return false;
        }
        if matches!(column.values, ColumnValues::Integers(_))
            && let Some((value, length)) = integer(text)
            && let Some(blanks) = end_of_cell(&text[length..], self.delimiter)
        {
            column.push_integer(value, &text[..length]);
            self.at += length + blanks;
            return true;
        }
        if let Ok((value, length)) = fast_float2::parse_partial::<f64, _>(text)
            && let Some(blanks) = end_of_cell(&text[length..], self.delimiter)
        {
            column.push_real(value, &text[..length]);
            self.at += length + blanks;
            return true;
        }
        false
    }

    /// Reads any other cell: quoted, missing, or text.
    fn take_other(&mut self, column: &mut Column, index: usize, is_position: bool) -> Result<()> {
        let rest = &self.bytes[self.at..];
        let quoted = quoted_length(rest).unwrap_or(0);
        let ends = |byte: &u8| match (byte, self.delimiter) {
            (b'\n' | b'\r', _) => true,
            (_, Some(delimiter)) => *byte == delimiter,
            (_, None) => matches!(byte, b' ' | b'\t'),
        };
        let length = rest[quoted..].iter().position(ends).map_or(rest.len(), |length| quoted + length);
        let cell = rest[..length].trim_ascii();
        if cell.starts_with(b"\"") && quoted_length(cell) != Some(cell.len()) {
            let what = format!("expected a quote at the end of {}", quoted_excerpt(cell));
            return Err(self.wrong(what));
        }
        let text = unquoted(cell);
        match parse_cell(&text) {
            // At the end of the file, `-` is more likely a truncated number than a mark for a missing value.
            CellValue::Missing if is_position && &*text == b"-" && self.at + length == self.bytes.len() => {
                return Err(self.not_a_number(&text, index));
            }
            CellValue::Missing => column.push_missing(),
            CellValue::Number(value) if !column.is_text() => match integer(&text) {
                Some((value, length)) if length == text.len() => column.push_integer(value, &text),
                _ => column.push_real(value, &text),
            },
            _ if is_position => return Err(self.not_a_number(&text, index)),
            _ => column.push_text(&text).map_err(|_| self.not_a_number(&text, index))?,
        }
        self.at += length;
        self.at += blanks(&self.bytes[self.at..], self.delimiter);
        Ok(())
    }

    fn is_at_line_end(&self) -> bool {
        matches!(self.bytes.get(self.at), None | Some(b'\n' | b'\r'))
    }

    /// Skips LF, CR LF or CR.
    #[inline]
    fn end_line(&mut self) {
        self.line += 1;
        self.at += match self.bytes.get(self.at..) {
            Some([b'\r', b'\n', ..]) => 2,
            Some([_, ..]) => 1,
            _ => 0,
        };
    }

    /// The rest of the line.
    fn line_text(&self) -> &'a [u8] {
        let rest = &self.bytes[self.at..];
        let length = rest.iter().position(|byte| matches!(byte, b'\n' | b'\r'));
        &rest[..length.unwrap_or(rest.len())]
    }

    fn wrong_cell_count(&mut self, start: usize) -> Error {
        self.at = start;
        let delimiter = self.delimiter.map_or(Delimiter::Blanks, Delimiter::Byte);
        let found: Vec<&[u8]> = cells(self.line_text(), delimiter).collect();
        let is_last_empty = found.last().is_some_and(|cell| cell.is_empty());
        let found_count = found.len() - usize::from(is_last_empty);
        let what = format!(
            "expected {} cells, as in the first line of the table, found {found_count}",
            self.names.len()
        );
        self.wrong(what)
    }

    fn not_a_number(&self, text: &[u8], index: usize) -> Error {
        if has_decimal_comma(text) {
            return decimal_commas(self.line);
        }
        let what = format!(
            "expected a number in column {}, found {}",
            quoted_excerpt(self.names[index].as_bytes()),
            quoted_excerpt(text)
        );
        self.wrong(what)
    }

    /// An error at the current position. A line without a line end at the end of the file may be truncated.
    fn wrong(&self, what: String) -> Error {
        let position = Position::Line(self.line);
        match self.at + self.line_text().len() < self.bytes.len() {
            true => Error::invalid(FORMAT, position, what),
            false => Error::truncated(
                FORMAT,
                position,
                format!("{what}; the file ends in this line, which has no line end"),
            ),
        }
    }
}

/// Parses an integer at the start of `text` that fits 64 bits; returns it and its length.
#[inline]
fn integer(text: &[u8]) -> Option<(i64, usize)> {
    const DIGITS_MAX: usize = 18; // always fits
    let sign = usize::from(matches!(text.first(), Some(b'-' | b'+')));
    // Accumulates the negated value: the range of i64 has one more negative value than positive ones.
    let mut value = 0i64;
    let mut length = sign;
    while let Some(digit @ b'0'..=b'9') = text.get(length) {
        let digit = i64::from(digit - b'0');
        value = match length < sign + DIGITS_MAX {
            true => 10 * value - digit,
            false => value.checked_mul(10)?.checked_sub(digit)?,
        };
        length += 1;
    }
    if length == sign {
        return None;
    }
    let is_negative = text.first() == Some(&b'-');
    Some((if is_negative { value } else { value.checked_neg()? }, length))
}

/// The number of blanks between a number and the end of its cell; `None` if anything else follows.
#[inline]
fn end_of_cell(text: &[u8], delimiter: Option<u8>) -> Option<usize> {
    let blank_count = blanks(text, delimiter);
    match (text.get(blank_count), delimiter) {
        (None | Some(b'\n' | b'\r'), _) => Some(blank_count),
        (Some(byte), Some(delimiter)) => (*byte == delimiter).then_some(blank_count),
        (Some(_), None) => (0 < blank_count).then_some(blank_count),
    }
}

/// The number of blanks at the start of `text`. A tab that is the delimiter is not a blank.
#[inline]
fn blanks(text: &[u8], delimiter: Option<u8>) -> usize {
    let is_blank = |byte: &u8| *byte == b' ' || (*byte == b'\t' && delimiter != Some(b'\t'));
    text.iter().take_while(|byte| is_blank(byte)).count()
}
