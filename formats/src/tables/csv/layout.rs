//! Finds where the rows of a table begin, and which of their columns are the position.
//!
//! The header is the line above the first row of numbers, or a line that names a position; lines above it are skipped.
//! Names in a comment count if there is one for each cell of the rows. A header without a position is an error, and so is
//! a table without names whose first column or row may be something else than coordinates.

use std::borrow::Cow;

use super::FORMAT;
use super::naming::{EXPECTED, NamedColumns, Naming, column_name};
use super::rows::{
    CellValue, DELIMITERS, Delimiter, cells, has_cells, has_decimal_comma, parse_cell, quoted_excerpt,
    unquoted,
};
use crate::core::error::{Error, Position, Result};
use crate::core::first_column::FirstColumn;
use crate::core::limits::Limits;
use crate::core::times::is_time;

/// The layout of the rows.
#[derive(Clone, Debug)]
pub(super) struct TableLayout {
    pub(super) delimiter: Delimiter,
    /// One name per column.
    pub(super) names: Vec<String>,
    /// The columns of the position.
    pub(super) position: [usize; 3],
    /// Offset of the first row, in bytes from the start.
    pub(super) rows_offset: usize,
    /// Line number of the first row, starting at 1.
    pub(super) rows_line: u64,
    pub(super) notes: Vec<String>,
}

/// Finds the rows and the position among their columns.
pub(super) fn layout(bytes: &[u8], naming: Naming) -> Result<TableLayout> {
    let head = TableHead::find(bytes, naming)?;
    let NamedColumns { names, position } = head.columns(bytes, naming)?;
    let mut notes = Vec::new();
    if let Some(first) = head.skipped.first() {
        notes.push(match (head.skipped.len(), quoted_excerpt(first.text)) {
            (1, first) => format!("skipped a line above the table: {first}"),
            (count, first) => format!("skipped {count} lines above the table; the first is {first}"),
        });
    }
    if head.names.is_none() && 3 < names.len() && !naming.has_new_x() {
        notes.push(format!(
            "the file has no header: the first 3 of {} columns are used as the position, \
             the others are named column_4 and so on",
            names.len()
        ));
    }
    let TableHead { delimiter, rows_offset, rows_line, .. } = head;
    Ok(TableLayout { delimiter, names, position, rows_offset, rows_line, notes })
}

/// Whether a text starts like a table: with a row, or with a header that names a position and fits the line below it,
/// if there is one. In other text, a sequence of words can name a position by chance.
pub(crate) fn looks_like_particles(head: &[u8]) -> bool {
    let (text, limits) = (super::decoded(head), Limits::default());
    let naming = Naming::unchanged(&limits);
    TableHead::find(&text, naming).is_ok_and(|head| {
        head.names.is_none_or(|(_, names)| {
            let fits = head.row.is_none_or(|row| has_cells(row.text, head.delimiter, names.len()));
            fits && naming.position_among(names).is_some()
        })
    })
}

/// Whether a text starts like a table of something else than particles: its header names no position, or the rows have
/// several times, or it has no header and its name is not that of a frame. `head` ends with a whole line, or the file.
pub(crate) fn is_other_table(head: &[u8], is_named_like_frame: bool) -> bool {
    let (text, limits) = (super::decoded(head), Limits::default());
    let naming = Naming::unchanged(&limits);
    let Ok(head) = TableHead::find(&text, naming) else { return false };
    let Some(row) = head.row else { return false };
    let Some((_, names)) = head.names else { return !is_named_like_frame };
    if naming.position_among(names.clone()).is_some() {
        return matches!(super::read(&text, &limits), Err(Error::Unsupported { .. }));
    }
    names.len() > 1
        && has_cells(row.text, head.delimiter, names.len())
        && !cells(row.text, head.delimiter).any(is_text)
}

/// Whether a line names a position, and so can be a header.
pub(crate) fn names_position(line: &[u8]) -> bool {
    let limits = Limits::default();
    let naming = Naming::unchanged(&limits);
    header(line, None, naming).is_ok_and(|(_, names)| naming.position_among(names).is_some())
}

/// The line of the header, and its names.
type Names<'a> = (HeadLine<'a>, Vec<String>);

/// What is above the rows of a table.
#[derive(Default)]
struct TableHead<'a> {
    /// The comments with letters.
    comments: Vec<HeadLine<'a>>,
    /// The lines that are neither a comment nor the header.
    skipped: Vec<HeadLine<'a>>,
    /// One of them that has the form of a row, but counts the rows below it or the columns.
    count: Option<HeadLine<'a>>,
    /// The names of the columns, and the line that has them.
    names: Option<Names<'a>>,
    /// The first row.
    row: Option<HeadLine<'a>>,
    delimiter: Delimiter,
    rows_offset: usize,
    rows_line: u64,
}

impl<'a> TableHead<'a> {
    fn find(bytes: &'a [u8], naming: Naming) -> Result<TableHead<'a>> {
        let mut head = TableHead { rows_offset: bytes.len(), ..TableHead::default() };
        let mut lines = HeadLines::new(bytes, naming.limits);
        while let Some(line) = lines.next_line()? {
            if let Some(text) = comment(line.text) {
                head.comments.extend(text.iter().any(u8::is_ascii_alphabetic).then_some(line));
                continue;
            }
            if let Some((delimiter, count)) = row_shape(line.text) {
                let below = &bytes[lines.at..];
                let named = head.names_in_comments(naming, |names| {
                    names.len() == count && naming.position_among(names.to_vec()).is_some()
                });
                let may_count = counts_rows(line.text, delimiter, below)
                    || named.is_none() && counts_columns(line.text, delimiter, below);
                if may_count && head.count.is_none() {
                    head.count = Some(line);
                    head.skipped.push(line);
                    continue;
                }
                naming.limits.check_attributes(FORMAT, count, "columns")?;
                let names =
                    named.map(|(_, names)| names).or_else(|| head.other_names(delimiter, count, naming));
                return Ok(TableHead {
                    names: names.or(head.names),
                    row: Some(line),
                    delimiter,
                    rows_offset: line.offset,
                    rows_line: line.number,
                    ..head
                });
            }
            let is_number = line.text.trim_ascii().iter().all(u8::is_ascii_digit);
            if is_number && head.skipped.is_empty() {
                head.skipped.push(line); // the number of rows, as in .pts
                continue;
            }
            let next = lines.peek_row()?;
            let (delimiter, names) = header(line.text, next.map(|next| next.text), naming)?;
            let is_position = naming.position_among(names.clone()).is_some();
            let fits = next.is_none_or(|next| has_cells(next.text, delimiter, names.len()));
            let is_above_numbers = next.is_some_and(|next| has_only_numbers(next.text, delimiter));
            if is_position && fits || is_above_numbers && !naming.has_new_x() {
                let (names, rows_offset) = (Some((line, names)), lines.at);
                let rows_line = lines.number + 1;
                return Ok(TableHead { names, row: next, delimiter, rows_offset, rows_line, ..head });
            }
            // The header, or the columns that the user names, are below it.
            head.skipped.push(line);
            head.names = head.names.or((!is_position).then_some((line, names)));
        }
        head.above_nothing(naming, lines.number)
    }

    /// The names in the last comment, if they can only be those of other columns.
    fn other_names(&self, delimiter: Delimiter, count: usize, naming: Naming) -> Option<Names<'a>> {
        let mut named = names_by_delimiter(*self.comments.last()?, *naming.limits);
        let is_header = |(other, (_, names)): &(Delimiter, Names)| {
            names.len() == count && are_names(names, *other, delimiter)
        };
        named.find(is_header).map(|(_, names)| names)
    }

    /// The file ends before any row: a comment can still be the header.
    fn above_nothing(self, naming: Naming, line: u64) -> Result<TableHead<'a>> {
        let rows_line = line + 1;
        let named = self.names_in_comments(naming, |names| naming.position_among(names.to_vec()).is_some());
        match named.filter(|_| self.names.is_none()) {
            Some((delimiter, names)) => Ok(TableHead { names: Some(names), delimiter, rows_line, ..self }),
            None if self.names.is_some() => Ok(TableHead { rows_line, ..self }),
            None => {
                let what = format!("{EXPECTED}, found only comments");
                Err(Error::truncated(FORMAT, Position::File, what))
            }
        }
    }

    /// The names in the last comment that satisfy a condition, and their delimiter.
    fn names_in_comments(
        &self,
        naming: Naming,
        is_header: impl Fn(&[String]) -> bool,
    ) -> Option<(Delimiter, Names<'a>)> {
        self.comments.iter().rev().find_map(|line| {
            names_by_delimiter(*line, *naming.limits).find(|(_, (_, names))| is_header(names))
        })
    }

    /// The columns with the position, or the refusal.
    fn columns(&self, bytes: &[u8], naming: Naming) -> Result<NamedColumns> {
        let row = self.row.unwrap_or_default();
        if let Some(count) = self.count.filter(|_| naming.renamed.is_empty()) {
            let above = self.skipped.iter().find(|line| line.number < count.number);
            let above = above.map_or(String::new(), |line| format!(" below {}", quoted_excerpt(line.text)));
            let what = format!(
                "the row {}{above} may be the number of rows, or numbers of the columns: if it is, name the columns, as in \
                 --columns x=1,y=2,z=3, and it is skipped; if it is a particle, write the header without a mark",
                quoted_excerpt(count.text)
            );
            return Err(refusal(bytes, count, what));
        }
        if let Some((_, names)) = &self.names
            && let Some(named) = naming.position_among(names.clone())
        {
            let mut coordinates =
                named.position.iter().filter_map(|&x| cells(row.text, self.delimiter).nth(x));
            let Some(text) = coordinates.find(|cell| is_text(cell)).map(quoted_excerpt) else {
                return Ok(named);
            };
            let what =
                format!("expected a number, found {text}: put a # before a line of units or other text");
            return Err(refusal(bytes, row, what));
        }
        let column_count = row_shape(row.text).map_or(0, |(_, count)| count);
        let usual = (0..column_count).map(|index| match index {
            0..3 => ["x", "y", "z"][index].to_owned(),
            _ => column_name(index),
        });
        let numbered = naming.position_among(usual.collect());
        match (numbered, &self.names) {
            (Some(numbered), _) if naming.has_new_x() => Ok(numbered),
            (_, Some((line, names))) => Err(refusal(bytes, *line, naming.why_none_among(names.clone()))),
            (None, None) => {
                let written = (0..column_count).map(column_name).collect();
                Err(refusal(bytes, row, naming.why_none_among(written)))
            }
            (Some(numbered), None) => {
                if column_count > 3
                    && let Some((_, (comment, _))) = self.names_in_comments(naming, |names| {
                        naming.position_among(names.to_vec()).is_some_and(|named| named.position != [0, 1, 2])
                    })
                {
                    let what = format!(
                        "{} names x, y and z, but has not one name for each of the {column_count} columns: name the \
                         columns, as in --columns x=2,y=3,z=4",
                        quoted_excerpt(comment.text)
                    );
                    return Err(refusal(bytes, comment, what));
                }
                let rows = first_numbers(&bytes[self.rows_offset..], self.delimiter);
                if FirstColumn::of(rows, column_count) == FirstColumn::Coordinate {
                    return Ok(numbered);
                }
                let what = "the table has no header, and its first column has whole numbers, unlike those beside it: \
                            it may be an id, a type or a position; name the columns, as in --columns x=2,y=3,z=4, or \
                            --columns x=1,y=2,z=3 if the first one is x";
                Err(refusal(bytes, row, what.to_owned()))
            }
        }
    }
}

/// The error for a table whose position is not known. A line without a line end may be truncated.
fn refusal(bytes: &[u8], line: HeadLine, what: String) -> Error {
    let position = Position::Line(line.number);
    if line.offset + line.text.len() < bytes.len() {
        Error::invalid(FORMAT, position, what)
    } else {
        Error::truncated(FORMAT, position, what)
    }
}

/// The names in a line that must be the header: with the delimiter for which they are a position; else with one for
/// which the next row has as many cells.
fn header(line: &[u8], next: Option<&[u8]>, naming: Naming) -> Result<(Delimiter, Vec<String>)> {
    let mut best = (None, (Delimiter::Blanks, Vec::new()));
    for delimiter in DELIMITERS {
        let names = names_in(line, delimiter, naming.limits)?;
        let fits = next.is_none_or(|next| has_cells(next, delimiter, names.len()));
        let rank = Some((naming.position_among(names.clone()).is_some(), fits, names.len() > 1));
        if best.0 < rank {
            best = (rank, (delimiter, names));
        }
    }
    Ok(best.1)
}

/// The names in a comment, with each delimiter. A comment with too many words is prose.
fn names_by_delimiter(line: HeadLine, limits: Limits) -> impl Iterator<Item = (Delimiter, Names)> {
    let text = comment(line.text).unwrap_or_default().trim_ascii();
    // A label is no name of a column: `# Columns: x y z`.
    let label = text.iter().position(u8::is_ascii_whitespace).filter(|end| text[..*end].ends_with(b":"));
    let text = &text[label.unwrap_or(0)..];
    DELIMITERS.into_iter().filter_map(move |delimiter| {
        let names = names_in(text, delimiter, &limits).ok()?;
        Some((delimiter, (line, names)))
    })
}

/// The names of columns in a line; without the last one if it is empty.
fn names_in(line: &[u8], delimiter: Delimiter, limits: &Limits) -> Result<Vec<String>> {
    let mut names: Vec<String> = Vec::new();
    for cell in cells(line, delimiter) {
        limits.check_attributes(FORMAT, names.len(), "columns")?;
        let name = String::from_utf8_lossy(&unquoted(cell)).trim().to_string();
        match names.last_mut() {
            // With blanks as delimiter, the unit of `x [m]` is a cell of its own. It belongs to the name.
            Some(last) if delimiter == Delimiter::Blanks && name.starts_with('[') && name.ends_with(']') => {
                *last = format!("{last} {name}");
            }
            _ => names.push(name),
        }
    }
    if names.last().is_some_and(String::is_empty) {
        names.pop();
    }
    if delimiter == Delimiter::Byte(b'\t') && names.iter().skip(1).any(String::is_empty) {
        return Ok(Vec::new()); // consecutive tabs align the columns: blanks are the delimiter
    }
    let or_number = |(index, name): (usize, String)| if name.is_empty() { column_name(index) } else { name };
    Ok(names.into_iter().enumerate().map(or_number).collect())
}

/// Whether the words of a comment above the rows are names of columns. Blanks are between names only if they are between
/// the numbers; and as they are also between the words of a sentence, one word has to look like a name.
fn are_names(words: &[String], delimiter: Delimiter, of_rows: Delimiter) -> bool {
    let is_name = |word: &String| {
        let is_letter = word.len() == 1 && !word.eq_ignore_ascii_case("a");
        is_letter || word.contains(['[', '(', '_']) || word.contains(|letter: char| letter.is_ascii_digit())
    };
    let is_sentence = delimiter == Delimiter::Blanks
        && (of_rows != Delimiter::Blanks
            || !words.first().is_some_and(|word| is_time(word)) && !words.iter().any(is_name));
    !is_sentence && words.iter().all(|word| parse_cell(word.as_bytes()) == CellValue::Text)
}

/// The first four numbers of each row, NaN for other cells.
fn first_numbers(rows: &[u8], delimiter: Delimiter) -> impl Iterator<Item = [f64; 4]> {
    row_lines(rows).map(move |line| {
        let mut numbers = [f64::NAN; 4];
        for (first, cell) in numbers.iter_mut().zip(cells(line, delimiter)) {
            *first = number(cell).unwrap_or(f64::NAN);
        }
        numbers
    })
}

/// The lines that are neither blank nor a comment.
fn row_lines(rows: &[u8]) -> impl Iterator<Item = &[u8]> {
    let lines = rows.split(|byte| matches!(byte, b'\n' | b'\r'));
    lines.filter(|line| !line.trim_ascii().is_empty() && comment(line).is_none())
}

/// The delimiter and the number of cells of a line that starts with three numbers.
fn row_shape(line: &[u8]) -> Option<(Delimiter, usize)> {
    DELIMITERS.into_iter().find_map(|delimiter| {
        if !begins_with_three(line, delimiter, |cell| number(cell).is_some()) {
            return None;
        }
        let count = cells(line, delimiter).count();
        let ends_with_delimiter = cells(line, delimiter).last().is_some_and(<[u8]>::is_empty);
        Some((delimiter, count - usize::from(ends_with_delimiter)))
    })
}

/// Whether a line has several cells, and all have numbers.
fn has_only_numbers(line: &[u8], delimiter: Delimiter) -> bool {
    cells(line, delimiter).count() > 1 && cells(line, delimiter).all(|cell| number(cell).is_some())
}

/// Whether a line starts with three cells of a kind.
fn begins_with_three(line: &[u8], delimiter: Delimiter, is_of_kind: impl Fn(&[u8]) -> bool) -> bool {
    cells(line, delimiter).map_while(|cell| is_of_kind(cell).then_some(())).take(3).count() == 3
}

/// Whether a row of whole numbers starts with the number of the rows below it, as in OFF and TetGen.
fn counts_rows(row: &[u8], delimiter: Delimiter, below: &[u8]) -> bool {
    let is_whole = |cell: &[u8]| cell.is_empty() || number(cell).is_some_and(|number| number.fract() == 0.0);
    let count = cells(row, delimiter).next().and_then(number);
    count.is_some_and(|count| count >= FIRST_COUNT)
        && cells(row, delimiter).all(is_whole)
        && count == Some(row_lines(below).count() as f64)
}

/// Whether a row has the numbers of the columns, from 0 on, above fractions, as in tables of pandas.
fn counts_columns(row: &[u8], delimiter: Delimiter, below: &[u8]) -> bool {
    let next = first_numbers(below, delimiter).next();
    next.is_some_and(|next| next.iter().any(|number| number.fract().abs() > 0.0))
        && cells(row, delimiter)
            .enumerate()
            .all(|(index, cell)| *unquoted(cell) == *index.to_string().as_bytes())
}

/// Whether a cell has neither a number nor a mark for a missing one.
fn is_text(cell: &[u8]) -> bool {
    parse_cell(&unquoted(cell)) == CellValue::Text
}

/// The number in a cell.
fn number(cell: &[u8]) -> Option<f64> {
    match parse_cell(&unquoted(cell)) {
        CellValue::Number(number) => Some(number),
        CellValue::Missing | CellValue::Text => None,
    }
}

/// The least number of rows that a row above them counts: fewer may be a coordinate by chance.
const FIRST_COUNT: f64 = 4.0;

/// The text with decimal points instead of decimal commas, as in French and German, if one of the first rows
/// has such commas.
pub(super) fn with_decimal_points(text: Cow<'_, [u8]>) -> Cow<'_, [u8]> {
    const SAMPLE_BYTES: usize = 64 << 10;
    let sample = &text[..text.len().min(SAMPLE_BYTES)];
    let is_decimal = |three: &[u8]| matches!(three, [b'0'..=b'9', b',', b'0'..=b'9']);
    // In a row such as ` 1, 2, 3,10`, commas are delimiters.
    let mut lines = sample
        .split(|byte| matches!(byte, b'\n' | b'\r'))
        .filter(|line| line.windows(3).any(is_decimal) && row_shape(line).is_none());
    let is_number = |cell: &[u8]| has_decimal_comma(&unquoted(cell)) || number(cell).is_some();
    if !lines.any(|line| DELIMITERS.iter().any(|&delimiter| begins_with_three(line, delimiter, is_number))) {
        return text;
    }
    let mut text = text.into_owned();
    for at in 1..text.len().saturating_sub(1) {
        if is_decimal(&text[at - 1..=at + 1]) {
            text[at] = b'.';
        }
    }
    Cow::Owned(text)
}

/// The text after a comment mark.
pub(super) fn comment(line: &[u8]) -> Option<&[u8]> {
    let line = line.trim_ascii_start();
    let (marks, text) = line.split_at(line.iter().take_while(|byte| b"#%/!;".contains(byte)).count());
    let is_comment = match marks.first()? {
        b'/' => marks.starts_with(b"//"),
        b';' => !text.contains(&b';'), // otherwise it is the delimiter
        _ => true,
    };
    is_comment.then_some(text.trim_ascii())
}

/// A line without its line end.
#[derive(Clone, Copy, Default)]
struct HeadLine<'a> {
    text: &'a [u8],
    offset: usize,
    /// Line number, starting at 1.
    number: u64,
}

/// The nonblank lines above the rows. They end in LF, CR LF or CR.
struct HeadLines<'a> {
    bytes: &'a [u8],
    at: usize,
    number: u64,
    /// The limit of the header: a line must end before this offset, unless it ends with the file.
    end: usize,
}

impl<'a> HeadLines<'a> {
    fn new(bytes: &'a [u8], limits: &Limits) -> HeadLines<'a> {
        let at = if bytes.starts_with(b"\xef\xbb\xbf") { 3 } else { 0 };
        let end = usize::try_from(limits.header_bytes).unwrap_or(usize::MAX).min(bytes.len());
        HeadLines { bytes, at, number: 0, end }
    }

    fn next_line(&mut self) -> Result<Option<HeadLine<'a>>> {
        while self.at < self.bytes.len() {
            let offset = self.at;
            let rest = self.bytes.get(offset..self.end).unwrap_or_default();
            let ending = rest.iter().position(|byte| matches!(byte, b'\n' | b'\r'));
            let length = match ending {
                Some(length) => length,
                None if self.end == self.bytes.len() => rest.len(),
                None => {
                    let what = format!("expected a table, but no row ends in the first {} bytes", self.end);
                    return Err(Error::too_large(FORMAT, what));
                }
            };
            let text = &rest[..length];
            self.at = offset + length;
            self.at += match self.bytes[self.at..] {
                [b'\r', b'\n', ..] => 2,
                [_, ..] => 1,
                [] => 0,
            };
            self.number += 1;
            if !text.trim_ascii().is_empty() {
                return Ok(Some(HeadLine { text, offset, number: self.number }));
            }
        }
        Ok(None)
    }

    /// The next line that is neither blank nor a comment, without advancing.
    fn peek_row(&self) -> Result<Option<HeadLine<'a>>> {
        let mut lines = HeadLines { ..*self };
        while let Some(line) = lines.next_line()? {
            if comment(line.text).is_none() {
                return Ok(Some(line));
            }
        }
        Ok(None)
    }
}
