//! Reads the rows in a single pass over the bytes.
//!
//! The reader parses a number in place, without locating lines and cells first. If the cell does not end
//! after the number, or does not start with one, the reader examines the whole cell: it can be quoted, a word
//! for a missing value, or text.
//!
//! Large tables are read in parts (see [`super::parts`]), each in a single pass.

use std::borrow::Cow;
use std::collections::HashMap;

use super::FORMAT;
use super::layout::{TableLayout, comment};
use crate::core::error::{Error, Position, Result};
use crate::core::limits::Limits;
use crate::core::text::{excerpt, parse_number};

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
            delimiter: layout.delimiter,
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
    delimiter: Delimiter,
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
                Some(b' ' | b'\t' | b'#' | b'%' | b'!' | b'/') if comment(self.line_text()).is_some() => {
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
            if self.delimiter == Delimiter::Blanks && self.is_at_line_end() {
                return Err(self.wrong_cell_count(start)); // with blanks as delimiter, there are no empty cells
            }
            if !self.take_number(column) {
                self.take_other(column, index, position.contains(&index))?;
            }
            if index + 1 < column_count && self.delimiter != Delimiter::Blanks {
                if self.is_at_line_end() {
                    return Err(self.wrong_cell_count(start));
                }
                self.at += 1; // skips the delimiter: a cell ends at one or at a line end
            }
        }
        if !self.is_at_line_end() {
            self.at += usize::from(self.delimiter != Delimiter::Blanks);
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
        let ends = |&byte: &u8| matches!(byte, b'\n' | b'\r') || self.delimiter.ends_cell(byte);
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
        let found: Vec<&[u8]> = cells(self.line_text(), self.delimiter).collect();
        let is_last_empty = found.last().is_some_and(|cell| cell.is_empty());
        let found_count = found.len() - usize::from(is_last_empty);
        let what = format!(
            "expected {} cells, as in the first line of the table, found {found_count}",
            self.names.len()
        );
        self.wrong(what)
    }

    fn not_a_number(&self, text: &[u8], index: usize) -> Error {
        let hint = if has_decimal_comma(text) {
            ": decimal commas are read if there is a digit before them, and one of the first rows has them"
        } else {
            ""
        };
        let name = quoted_excerpt(self.names[index].as_bytes());
        self.wrong(format!("expected a number in column {name}, found {}{hint}", quoted_excerpt(text)))
    }

    /// An error at the current position. A line without a line end at the end of the file may be truncated.
    fn wrong(&self, what: String) -> Error {
        let position = Position::Line(self.line);
        if self.at + self.line_text().len() < self.bytes.len() {
            Error::invalid(FORMAT, position, what)
        } else {
            Error::truncated(
                FORMAT,
                position,
                format!("{what}; the file ends in this line, which has no line end"),
            )
        }
    }
}

/// Parses an integer at the start of `text` that fits into 64 bits; returns it and its length.
#[inline]
fn integer(text: &[u8]) -> Option<(i64, usize)> {
    const DIGITS_MAX: usize = 18; // always fits
    let sign = usize::from(matches!(text.first(), Some(b'-' | b'+')));
    // Accumulates the negated value: the range of i64 has one more negative value than positive ones.
    let mut value = 0i64;
    let mut length = sign;
    while let Some(digit @ b'0'..=b'9') = text.get(length) {
        let digit = i64::from(digit - b'0');
        value = if length < sign + DIGITS_MAX {
            10 * value - digit
        } else {
            value.checked_mul(10)?.checked_sub(digit)?
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
fn end_of_cell(text: &[u8], delimiter: Delimiter) -> Option<usize> {
    let blank_count = blanks(text, delimiter);
    match (text.get(blank_count), delimiter) {
        (None | Some(b'\n' | b'\r'), _) => Some(blank_count),
        (Some(_), Delimiter::Blanks) => (0 < blank_count).then_some(blank_count),
        (Some(byte), Delimiter::Byte(delimiter)) => (*byte == delimiter).then_some(blank_count),
    }
}

/// The number of blanks at the start of `text`. A tab that is the delimiter is not a blank.
#[inline]
fn blanks(text: &[u8], delimiter: Delimiter) -> usize {
    let is_blank = |byte: &u8| *byte == b' ' || (*byte == b'\t' && delimiter != Delimiter::Byte(b'\t'));
    text.iter().take_while(|byte| is_blank(byte)).count()
}

// The grammar of a line: cells, quotes, and numbers.

/// What separates two cells.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) enum Delimiter {
    /// Exactly one of this byte; spaces around it are ignored.
    Byte(u8),
    /// Any number of spaces and tabs.
    #[default]
    Blanks,
}

impl Delimiter {
    fn ends_cell(self, byte: u8) -> bool {
        match self {
            Delimiter::Byte(delimiter) => byte == delimiter,
            Delimiter::Blanks => matches!(byte, b' ' | b'\t'),
        }
    }
}

/// Delimiters in the order in which they are tried: in a line with commas and spaces, commas delimit.
pub(super) const DELIMITERS: [Delimiter; 5] = [
    Delimiter::Byte(b','),
    Delimiter::Byte(b';'),
    Delimiter::Byte(b'|'),
    Delimiter::Byte(b'\t'),
    Delimiter::Blanks,
];

/// The content of a cell.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum CellValue {
    /// A number, possibly not finite.
    Number(f64),
    /// Empty, or a word for a missing value.
    Missing,
    /// Anything else.
    Text,
}

/// The cells of a line, without surrounding blanks but with their quotes.
pub(super) fn cells(line: &[u8], delimiter: Delimiter) -> impl Iterator<Item = &[u8]> {
    let mut rest = Some(line);
    std::iter::from_fn(move || {
        let cell_start = &rest?[blanks(rest?, delimiter)..];
        if delimiter == Delimiter::Blanks && cell_start.is_empty() {
            return None;
        }
        let quoted = quoted_length(cell_start).unwrap_or(0);
        let end = cell_start[quoted..]
            .iter()
            .position(|&byte| delimiter.ends_cell(byte))
            .map(|length| quoted + length);
        rest = end.map(|end| &cell_start[end + 1..]);
        Some(cell_start[..end.unwrap_or(cell_start.len())].trim_ascii())
    })
}

/// Whether a line has `count` cells, not counting an empty cell after a delimiter at the end of the line.
pub(super) fn has_cells(line: &[u8], delimiter: Delimiter, count: usize) -> bool {
    let mut cells = cells(line, delimiter).skip(count.saturating_sub(1));
    cells.next().is_some() && cells.next().is_none_or(|cell| cell.is_empty() && cells.next().is_none())
}

/// The length in bytes of a quoted cell, including its quotes. A quote within a cell is doubled.
fn quoted_length(text: &[u8]) -> Option<usize> {
    if text.first() != Some(&b'"') {
        return None;
    }
    let mut at = 1;
    loop {
        at += text[at..].iter().take_while(|byte| !matches!(byte, b'"' | b'\n' | b'\r')).count();
        match text[at..] {
            [b'"', b'"', ..] => at += 2,
            [b'"', ..] => return Some(at + 1),
            _ => return None,
        }
    }
}

/// The text of a cell without its quotes.
pub(super) fn unquoted(cell: &[u8]) -> Cow<'_, [u8]> {
    if cell.len() < 2 || quoted_length(cell) != Some(cell.len()) {
        return Cow::Borrowed(cell);
    }
    let inside = &cell[1..cell.len() - 1];
    if !inside.contains(&b'"') {
        return Cow::Borrowed(inside);
    }
    let mut text = inside.to_vec();
    let mut previous_was_quote = false;
    text.retain(|&byte| {
        previous_was_quote = byte == b'"' && !previous_was_quote;
        !previous_was_quote
    });
    Cow::Owned(text)
}

/// Classifies an unquoted cell. Accepts Fortran exponents such as `1.5D-3`.
pub(super) fn parse_cell(text: &[u8]) -> CellValue {
    let text = text.trim_ascii();
    if let Some((value, length)) = parse_number::<f64>(text)
        && length == text.len()
    {
        return CellValue::Number(value);
    }
    let lower = text.to_ascii_lowercase();
    if MISSING.contains(&lower.as_slice()) {
        return CellValue::Missing;
    }
    let is_exponent = |byte: &u8| *byte == b'd';
    if let Some(at) = lower.iter().position(is_exponent) {
        let mut number = lower;
        number[at] = b'e';
        if let Ok(value) = fast_float2::parse::<f64, _>(&number) {
            return CellValue::Number(value);
        }
    }
    CellValue::Text
}

/// Whether a cell looks like a number with a decimal comma.
pub(super) fn has_decimal_comma(text: &[u8]) -> bool {
    let commas = text.iter().filter(|&&byte| byte == b',').count();
    let with_point: Vec<u8> = text.iter().map(|&byte| if byte == b',' { b'.' } else { byte }).collect();
    commas == 1 && matches!(parse_cell(&with_point), CellValue::Number(_))
}

/// Whether `text` is an integer that a 64-bit float cannot represent exactly.
#[inline]
fn is_rounded_integer(text: &[u8]) -> bool {
    const DIGITS_ALWAYS_EXACT: usize = 15;
    DIGITS_ALWAYS_EXACT < text.len() && is_rounded_long_integer(text)
}

#[cold]
fn is_rounded_long_integer(text: &[u8]) -> bool {
    let text = text.trim_ascii();
    let digits = text.strip_prefix(b"-").or(text.strip_prefix(b"+")).unwrap_or(text);
    let magnitude = std::str::from_utf8(digits).ok().filter(|_| digits.iter().all(u8::is_ascii_digit));
    // An integer beyond 128 bits is almost certainly not representable exactly.
    magnitude.is_some_and(|digits| digits.parse().map_or(!digits.is_empty(), is_rounded))
}

/// Whether an integer of this magnitude needs more bits than a 64-bit float has.
fn is_rounded(magnitude: u128) -> bool {
    let bit_count = u128::BITS.saturating_sub(magnitude.leading_zeros() + magnitude.trailing_zeros());
    f64::MANTISSA_DIGITS < bit_count
}

/// A piece of the file in quotes, for a message.
pub(super) fn quoted_excerpt(text: &[u8]) -> String {
    format!("\"{}\"", excerpt(text))
}

/// Words for a missing number, in lower case. (`nan` is a number.)
const MISSING: [&[u8]; 7] = [b"", b"na", b"n/a", b"#n/a", b"null", b"none", b"-"];

// A column under construction: its type depends on its values so far.
//
//   no value yet ──text──▶ texts
//        │ integer
//        ▼
//     integers ──a number that is not an integer, or a missing value──▶ floats
//
// Text in a column of integers or floats is an error.
//
// Parts of a table can be read in parallel. Their columns are joined if the result equals that of sequential
// reading.

/// The values of a column, one per row.
#[derive(Debug)]
pub(super) struct Column {
    pub(super) values: ColumnValues,
    /// Whether any cell had a value; until then the column may still become text.
    has_value: bool,
    /// Whether the column has an integer whose text may give another result when it is read as a float: −0,
    /// +5, or one with many digits.
    has_odd_integer: bool,
    /// Whether the column has an integer that a 64-bit float cannot represent exactly.
    pub(super) has_rounded_integer: bool,
}

#[derive(Debug)]
pub(super) enum ColumnValues {
    Integers(Vec<i64>),
    /// NaN for a missing value.
    Reals(Vec<f64>),
    Texts(Texts),
}

/// Distinct texts, and the index of the text of each row, or [`NO_TEXT`].
#[derive(Debug, Default)]
pub(super) struct Texts {
    pub(super) table: Vec<String>,
    pub(super) indices: Vec<i32>,
    index_of: HashMap<Vec<u8>, i32>,
}

impl Column {
    /// An empty column with capacity for `row_count` numbers.
    pub(super) fn with_capacity(row_count: usize) -> Column {
        let values = ColumnValues::Integers(Vec::with_capacity(row_count));
        Column { values, has_value: false, has_odd_integer: false, has_rounded_integer: false }
    }

    /// Appends a number as a float, and converts a column of integers. `text` is the number in the file.
    #[inline]
    fn push_real(&mut self, value: f64, text: &[u8]) {
        self.has_value = true;
        self.has_rounded_integer = self.has_rounded_integer || is_rounded_integer(text);
        if let Some(reals) = self.reals() {
            reals.push(value);
        }
    }

    /// Appends an integer. In a column of floats, it becomes a float.
    #[inline]
    fn push_integer(&mut self, value: i64, text: &[u8]) {
        self.has_value = true;
        match &mut self.values {
            ColumnValues::Integers(integers) => {
                let is_plain = value.unsigned_abs() <= PLAIN_INTEGER_MAX
                    && (text[0].is_ascii_digit() || (value != 0 && text[0] == b'-'));
                self.has_odd_integer |= !is_plain;
                integers.push(value);
            }
            _ => self.push_real(integer_as_real(value), text),
        }
    }

    fn push_missing(&mut self) {
        match &mut self.values {
            ColumnValues::Texts(texts) => texts.indices.push(NO_TEXT),
            _ => {
                if let Some(reals) = self.reals() {
                    reals.push(f64::NAN);
                }
            }
        }
    }

    /// Appends a text, unless the column is numeric.
    fn push_text(&mut self, text: &[u8]) -> std::result::Result<(), NotAText> {
        if !self.has_value {
            let texts = Texts { indices: vec![NO_TEXT; self.len()], ..Texts::default() };
            self.values = ColumnValues::Texts(texts);
            self.has_value = true;
        }
        let ColumnValues::Texts(texts) = &mut self.values else { return Err(NotAText) };
        let index = texts.index_of(text)?;
        texts.indices.push(index);
        Ok(())
    }

    /// Whether this is a column of text, in which even cells that look like numbers are text.
    pub(super) fn is_text(&self) -> bool {
        matches!(self.values, ColumnValues::Texts(_))
    }

    pub(super) fn len(&self) -> usize {
        match &self.values {
            ColumnValues::Integers(integers) => integers.len(),
            ColumnValues::Reals(reals) => reals.len(),
            ColumnValues::Texts(texts) => texts.indices.len(),
        }
    }

    /// Whether the last value is a finite number.
    #[inline]
    fn ends_finite(&self) -> bool {
        match &self.values {
            ColumnValues::Integers(integers) => !integers.is_empty(),
            ColumnValues::Reals(reals) => reals.last().is_some_and(|value| value.is_finite()),
            ColumnValues::Texts(_) => false,
        }
    }

    /// Removes the last value.
    pub(super) fn pop(&mut self) {
        match &mut self.values {
            ColumnValues::Integers(integers) => drop(integers.pop()),
            ColumnValues::Reals(reals) => drop(reals.pop()),
            ColumnValues::Texts(texts) => drop(texts.indices.pop()),
        }
    }

    /// Whether appending `next`, which was parsed separately from the rows after those of this column, gives
    /// the same result as sequential parsing.
    pub(super) fn can_append(&self, next: &Column) -> bool {
        match (&self.values, &next.values) {
            (ColumnValues::Texts(texts), ColumnValues::Texts(more)) => {
                i32::try_from(texts.table.len() + more.table.len()).is_ok()
            }
            (ColumnValues::Texts(_), _) | (_, ColumnValues::Texts(_)) => false,
            (ColumnValues::Reals(_), _) => !next.has_odd_integer,
            (ColumnValues::Integers(_), _) => true,
        }
    }

    /// Appends a column for which [`can_append`](Column::can_append) is true.
    pub(super) fn append(&mut self, mut next: Column) {
        match (&mut self.values, &mut next.values) {
            (ColumnValues::Texts(texts), ColumnValues::Texts(more)) => texts.append(more),
            (ColumnValues::Integers(integers), ColumnValues::Integers(more)) => integers.append(more),
            _ => {
                if let (Some(reals), Some(more)) = (self.reals(), next.reals()) {
                    reals.append(more);
                }
            }
        }
        self.has_value |= next.has_value;
        self.has_odd_integer |= next.has_odd_integer;
        self.has_rounded_integer |= next.has_rounded_integer;
    }

    /// The column as floats, converting integers. `None` for text.
    pub(super) fn reals(&mut self) -> Option<&mut Vec<f64>> {
        if let ColumnValues::Integers(integers) = &mut self.values {
            let integers = std::mem::take(integers);
            self.has_rounded_integer |= integers.iter().any(|value| is_rounded(value.unsigned_abs().into()));
            // Both types have the same size, so the allocation is reused.
            self.values = ColumnValues::Reals(integers.into_iter().map(integer_as_real).collect());
        }
        match &mut self.values {
            ColumnValues::Reals(reals) => Some(reals),
            _ => None,
        }
    }
}

impl Texts {
    /// The index of a text; a new text gets the next index.
    fn index_of(&mut self, text: &[u8]) -> std::result::Result<i32, NotAText> {
        if let Some(&index) = self.index_of.get(text) {
            return Ok(index);
        }
        let index = i32::try_from(self.table.len()).map_err(|_| NotAText)?;
        self.table.push(String::from_utf8_lossy(text).into_owned());
        self.index_of.insert(text.to_vec(), index);
        Ok(index)
    }

    /// Appends texts. [`Column::can_append`] has checked that the total number of distinct texts fits into 31
    /// bits.
    fn append(&mut self, next: &Texts) {
        // The texts are added in order of appearance. They are compared as bytes, because the lossy
        // conversion to strings can make different bytes equal.
        let mut texts: Vec<(i32, &[u8])> = next.index_of.iter().map(|(text, &i)| (i, &text[..])).collect();
        texts.sort_unstable();
        let merged: Vec<i32> = texts.into_iter().flat_map(|(_, text)| self.index_of(text)).collect();
        let merged_index = |&index: &i32| {
            usize::try_from(index).ok().and_then(|index| merged.get(index)).copied().unwrap_or(NO_TEXT)
        };
        self.indices.extend(next.indices.iter().map(merged_index));
    }
}

/// Error: a text in a numeric column, or too many different texts.
#[derive(Debug)]
struct NotAText;

/// Exact up to 2⁵³; [`has_rounded_integer`](Column::has_rounded_integer) records that a larger one was
/// rounded.
fn integer_as_real(value: i64) -> f64 {
    value as f64
}

/// The index of a missing text.
const NO_TEXT: i32 = -1;

/// Integers up to this are exact as 64-bit floats.
const PLAIN_INTEGER_MAX: u64 = 1 << f64::MANTISSA_DIGITS;
