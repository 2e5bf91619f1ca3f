//! Detects the layout of a table: the header, the delimiter and the column names.

use std::borrow::Cow;

use super::FORMAT;
use super::naming::{Naming, add_missing_axes, two_coordinates};
use super::rows::{
    CellValue, DELIMITERS, Delimiter, cells, has_cells, has_decimal_comma, parse_cell, quoted_excerpt,
    unquoted,
};
use crate::core::columns::{self, Columns};
use crate::core::data::AttributeRole;
use crate::core::error::{Error, Position, Result};
use crate::core::first_column::FirstColumn;
use crate::core::limits::Limits;

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

/// Finds the header and the delimiter.
pub(super) fn layout(bytes: &[u8], naming: Naming) -> Result<TableLayout> {
    let mut head = TableHead::default();
    let mut lines = HeadLines::new(bytes, naming.limits);
    while let Some(line) = lines.next_line()? {
        if line.text.starts_with(b"ITEM:") {
            let what = "found a LAMMPS `ITEM:` line in delimited text: a dump must begin with such a line";
            return Err(Error::unsupported(FORMAT, what));
        }
        if let Some(comment) = comment(line.text) {
            head.take_comment(line, comment, naming);
            continue;
        }
        let row = row_shape(line.text);
        if row.is_some_and(|(delimiter, _)| counts_rows(line.text, delimiter, &bytes[lines.at..])) {
            head.count = Some(line);
            continue;
        }
        let next = if row.is_some() { lines.peek_row().ok().flatten() } else { lines.peek_row()? };
        if let Some((delimiter, count)) = row {
            let is_row = |next: &[u8]| has_cells(next, delimiter, count) && has_fraction(next, delimiter);
            let has_names = head.comment.is_some() || head.doubtful.is_some();
            let is_header = !has_names && next.is_some_and(is_row);
            return match numbered_columns(line.text, delimiter, naming).filter(|_| is_header) {
                Some(header) => Ok(header.into_layout(delimiter, lines.at, lines.number + 1, head.notes())),
                None => head.above_row(bytes, delimiter, count, line, naming),
            };
        }
        for delimiter in DELIMITERS {
            let Some(mut header) = header(line.text, delimiter, naming)? else { continue };
            let is_confirmed = next.is_none_or(|next| has_cells(next, delimiter, header.names.len()));
            if is_confirmed {
                if next.is_some_and(|next| header.take_units(next, delimiter)) {
                    lines.next_row()?;
                }
                return Ok(header.into_layout(delimiter, lines.at, lines.number + 1, head.notes()));
            }
            let layout = || header.into_layout(delimiter, lines.at, lines.number + 1, Vec::new());
            head.doubtful.get_or_insert_with(layout);
        }
        head.take_text(line)?;
    }
    head.above_nothing(bytes, lines.number, naming)
}

/// Whether a text starts like a table: with a row, or with a header that fits the line below it, if there is
/// one. A text of comments only is a table without rows if a comment is a header.
///
/// This test is stricter than [`layout()`], whose callers expect a table: in other text, a sequence of words
/// can name a position by chance.
pub(crate) fn looks_like_particles(head: &[u8]) -> bool {
    let (text, limits) = (super::decoded(head), Limits::default());
    let naming = Naming::unchanged(&limits);
    let mut lines = HeadLines::new(&text, &limits);
    let mut has_header = false;
    let (mut text_last, mut above): (Option<&[u8]>, Option<&[u8]>) = (None, None);
    while let Ok(Some(line)) = lines.next_line() {
        if let Some(comment) = comment(line.text) {
            has_header |= !headers_in_comment(comment, naming).is_empty();
            above = has_letters(comment).then_some(line.text).or(above);
            continue;
        }
        if let Some(delimiter) =
            DELIMITERS.into_iter().find(|&delimiter| begins_with_numbers(line.text, delimiter))
        {
            // The header of a table of other quantities names no position.
            let count = cells(line.text, delimiter).count();
            return has_header || above.is_none_or(|above| names_above(above, delimiter, count).is_none());
        }
        let Ok(next) = lines.peek_row() else { return false };
        let is_above = |(delimiter, mut header): (Delimiter, NamedColumns)| {
            next.is_none_or(|next| {
                header.names_positions_of(next, delimiter) || header.take_units(next, delimiter)
            })
        };
        if headers(line.text, naming).any(is_above) {
            return true;
        }
        text_last = Some(line.text);
        above = text_last;
    }
    has_header && text_last.is_none()
}

/// Whether a text starts like a table of something else than particles: its header names no position; or it also names
/// a time and no id, and each of the first rows has a later time than the one before, as those of a probe. Without a
/// header, it is one if its first column increases like a time and is not whole as ids are, unless the name of the file
/// excludes a log of times.
/// `head` ends with a whole line, or the file.
pub(crate) fn is_other_table(head: &[u8], may_be_log: bool) -> bool {
    let (text, limits) = (super::decoded(head), Limits::default());
    let naming = Naming::unchanged(&limits);
    let mut lines = HeadLines::new(&text, &limits);
    let (mut names_position, mut above, mut rows) = (false, None, Vec::new());
    while let Ok(Some(line)) = lines.next_line() {
        match comment(line.text) {
            Some(comment) => {
                names_position |= !headers_in_comment(comment, naming).is_empty();
                above = (rows.is_empty() && has_letters(comment)).then_some(line.text).or(above);
            }
            None => rows.push(line.text),
        }
    }
    let &[first, second, ..] = &rows[..] else { return false };
    if let Some((delimiter, count)) = row_shape(first) {
        let names_others = above.is_some_and(|above| names_above(above, delimiter, count).is_some());
        let times = numbers_in(&rows, 0, delimiter);
        // Ids increase, too, but are whole.
        let has_fraction = times.iter().any(|time| time.fract() != 0.0);
        return !names_position && (names_others || may_be_log && has_fraction && increase(&times));
    }
    let is_row = |row: &[u8], delimiter, count| {
        let is_number =
            |cell| matches!(parse_cell(&unquoted(cell)), CellValue::Number(_) | CellValue::Missing);
        has_cells(row, delimiter, count) && cells(row, delimiter).take(count).all(is_number)
    };
    let fits = |&delimiter: &Delimiter| {
        let count = cells(first, delimiter).count();
        count > 1
            && names_above(first, delimiter, count).is_some_and(|names| names.len() == count)
            && is_row(second, delimiter, count)
    };
    let Some(delimiter) = DELIMITERS.into_iter().find(fits) else { return false };
    if headers(first, naming).next().is_none() {
        return true;
    }
    let names: Vec<String> =
        cells(first, delimiter).map(|cell| String::from_utf8_lossy(&unquoted(cell)).into_owned()).collect();
    let has_id = names.iter().any(|name| columns::role_of(name, 1) == Some(AttributeRole::Id));
    let time = names.iter().position(|name| super::is_time(name));
    !has_id && time.is_some_and(|time| increase(&numbers_in(&rows[1..], time, delimiter)))
}

/// The numbers in a column.
fn numbers_in(rows: &[&[u8]], column: usize, delimiter: Delimiter) -> Vec<f64> {
    let number = |row: &&[u8]| match cells(row, delimiter).nth(column).map(|cell| parse_cell(&unquoted(cell)))
    {
        Some(CellValue::Number(number)) => Some(number),
        _ => None,
    };
    rows.iter().filter_map(number).collect()
}

/// Whether there are several numbers, and each is larger than the one before.
fn increase(numbers: &[f64]) -> bool {
    numbers.len() > 1 && numbers.windows(2).all(|pair| pair[0] < pair[1])
}

/// Whether a line names a position, and so can be a header.
pub(crate) fn names_position(line: &[u8]) -> bool {
    headers(line, Naming::unchanged(&Limits::default())).next().is_some()
}

/// The line as a header, with each delimiter for which it names a position.
fn headers(line: &[u8], naming: Naming) -> impl Iterator<Item = (Delimiter, NamedColumns)> {
    DELIMITERS.into_iter().filter_map(move |delimiter| {
        header(line, delimiter, naming).ok().flatten().map(|header| (delimiter, header))
    })
}

/// The comment as a header, with each delimiter for which it names a position. YADE writes
/// `#format x_y_z_r`.
fn headers_in_comment(comment: &[u8], naming: Naming) -> Vec<(Delimiter, NamedColumns)> {
    match comment.strip_prefix(b"format") {
        Some(names) if names.starts_with(b" ") => {
            let blank = |byte: &u8| if *byte == b'_' { b' ' } else { *byte };
            let names: Vec<u8> = names.iter().map(blank).collect();
            headers(&names, naming).collect()
        }
        _ => headers(comment, naming).collect(),
    }
}

/// The lines seen so far above the rows.
#[derive(Default)]
struct TableHead<'a> {
    /// Number of lines that are neither comment nor header.
    text_line_count: u64,
    /// The first of these lines.
    text_first: Option<HeadLine<'a>>,
    /// The last of these lines.
    text_last: Option<HeadLine<'a>>,
    /// The last line with letters, in a comment or not.
    above: Option<HeadLine<'a>>,
    /// A row with the number of the rows below it.
    count: Option<HeadLine<'a>>,
    /// The last comment that names a position.
    comment: Option<&'a [u8]>,
    /// The first line that names a position although the next line has a different number of cells: the
    /// header, its delimiter, and the offset and line number of the next line.
    doubtful: Option<TableLayout>,
}

impl<'a> TableHead<'a> {
    fn take_comment(&mut self, line: HeadLine<'a>, comment: &'a [u8], naming: Naming) {
        if has_letters(comment) {
            self.above = Some(line);
        }
        // A comment with too many words is prose or numbers: not an error, but not a header either.
        if !headers_in_comment(comment, naming).is_empty() {
            self.comment = Some(comment);
        }
    }

    fn take_text(&mut self, line: HeadLine<'a>) -> Result<()> {
        if DELIMITERS[1..].iter().any(|&delimiter| begins_with_numbers(line.text, delimiter)) {
            return Err(decimal_commas(line.number));
        }
        self.text_line_count += 1;
        // Below a line that may be a header, lines are rows: their reader says what is wrong with the first.
        if self.text_line_count > TEXT_LINES_MAX && self.doubtful.is_none() {
            let what = format!("expected a table, found only text in the first {TEXT_LINES_MAX} lines");
            return Err(Error::invalid(FORMAT, Position::Line(line.number), what));
        }
        self.text_first.get_or_insert(line);
        self.text_last = Some(line);
        self.above = Some(line);
        Ok(())
    }

    /// Called when the first row comes before any header.
    fn above_row(
        self,
        bytes: &[u8],
        delimiter: Delimiter,
        count: usize,
        row: HeadLine,
        naming: Naming,
    ) -> Result<TableLayout> {
        if let Some(layout) = self.doubtful {
            // The names may have another delimiter than the numbers. If the header has a name for each cell
            // of the row, use the delimiter of the row. Otherwise the row reader reports the row as invalid.
            let delimiter = if layout.names.len() == count { delimiter } else { layout.delimiter };
            return Ok(TableLayout { delimiter, ..layout });
        }
        let mut above = self.comment.into_iter().flat_map(|comment| headers_in_comment(comment, naming));
        if let Some((_, header)) = above.find(|(_, header)| header.names.len() == count) {
            return Ok(header.into_layout(delimiter, row.offset, row.number, self.notes()));
        }
        let numbers = self.text_last.and_then(|text| numbered_columns(text.text, delimiter, naming));
        if let Some(header) = numbers.filter(|header| header.names.len() == count) {
            let text_line_count = self.text_line_count - 1;
            let text_first = self.text_first.filter(|_| text_line_count > 0);
            let notes = TableHead { text_line_count, text_first, ..self }.notes();
            return Ok(header.into_layout(delimiter, row.offset, row.number, notes));
        }
        check_column_count(count, naming.limits)?;
        let written: Vec<String> = (0..count).map(column_name).collect();
        if let Some(header) = naming.position_among(written.clone()) {
            return Ok(header.into_layout(delimiter, row.offset, row.number, self.notes()));
        }
        if let Some(line) = self.above
            && let Some(names) = names_above(line.text, delimiter, count)
        {
            let what = naming.why_none_among(names);
            return Err(Error::invalid(FORMAT, Position::Line(line.number), what));
        }
        if self.text_line_count > PROSE_LINES_MAX
            && naming.renamed.is_empty()
            && row_count(&bytes[row.offset..]) < self.text_line_count
        {
            let what = format!(
                "expected a table, found {} lines of text above fewer rows: name the columns with --columns if these are \
                 particles",
                self.text_line_count
            );
            return Err(Error::invalid(FORMAT, Position::Line(row.number), what));
        }
        let mut notes = self.notes();
        let first = FirstColumn::of(first_numbers(&bytes[row.offset..], delimiter), count);
        if first == FirstColumn::Unclear {
            let what = "the table has no header, and its first column has whole numbers, unlike those beside it: it may \
                        be an id, a type or a position; name the columns, as in --columns x=2,y=3,z=4, or --columns \
                        x=1,y=2,z=3 if the first one is x";
            return Err(Error::invalid(FORMAT, Position::Line(row.number), what));
        }
        let skipped = usize::from(first == FirstColumn::Id);
        if skipped > 0 {
            notes.push(format!(
                "the file has no header, and its first column has a different integer in each row: it is used as \
                 the id, and the next 3 of {count} columns as the position"
            ));
        } else if 3 < count {
            notes.push(format!(
                "the file has no header: the first 3 of {count} columns are used as the position, \
                 the others are named column_4 and so on"
            ));
        }
        let usual = NamedColumns::unnamed(&["id"][..skipped], count);
        match naming.usual_position(written.clone(), usual) {
            Some(header) => Ok(header.into_layout(delimiter, row.offset, row.number, notes)),
            None => Err(Error::invalid(FORMAT, Position::Line(row.number), naming.why_none_among(written))),
        }
    }

    /// Called when the file ends before any row.
    fn above_nothing(self, bytes: &[u8], line: u64, naming: Naming) -> Result<TableLayout> {
        if let Some(layout) = self.doubtful {
            return Ok(layout);
        }
        let mut above = self.comment.into_iter().flat_map(|comment| headers_in_comment(comment, naming));
        if let Some((delimiter, header)) = above.next() {
            return Ok(header.into_layout(delimiter, bytes.len(), line + 1, self.notes()));
        }
        let expected =
            "expected a header with position columns, such as x,y,z, or rows of at least three numbers";
        Err(match self.text_first {
            Some(text) => {
                let mut what = format!("{expected}, found {}", quoted_excerpt(text.text));
                if let Some(names) = two_coordinates(text.text) {
                    what += &format!(": {}", add_missing_axes(&names));
                }
                let position = Position::Line(text.number);
                if bytes.ends_with(b"\n") || bytes.ends_with(b"\r") {
                    Error::invalid(FORMAT, position, what)
                } else {
                    Error::truncated(FORMAT, position, what) // the line may be truncated
                }
            }
            None => Error::truncated(FORMAT, Position::File, format!("{expected}, found only comments")),
        })
    }

    fn notes(&self) -> Vec<String> {
        let text = self.text_first.map(|first| match (self.text_line_count, quoted_excerpt(first.text)) {
            (1, first) => format!("skipped a line above the table: {first}"),
            (count, first) => format!("skipped {count} lines above the table; the first is {first}"),
        });
        let count = self.count.map(|line| {
            format!(
                "the row {} is no particle: it has the number of rows below it",
                quoted_excerpt(line.text)
            )
        });
        text.into_iter().chain(count).collect()
    }
}

/// Column names that include a position.
pub(super) struct NamedColumns {
    pub(super) names: Vec<String>,
    pub(super) position: [usize; 3],
}

impl NamedColumns {
    /// Names for `count` columns: those of the first ones, then the position, then the columns' numbers.
    fn unnamed(first: &[&str], count: usize) -> NamedColumns {
        let known = first.iter().chain(&["x", "y", "z"]).map(ToString::to_string);
        let names = known.chain((first.len() + 3..count).map(column_name)).collect();
        NamedColumns { names, position: [0, 1, 2].map(|axis| first.len() + axis) }
    }

    /// Whether a row has the same number of cells, and numbers or missing values in the position columns.
    fn names_positions_of(&self, row: &[u8], delimiter: Delimiter) -> bool {
        let is_coordinate = |&column: &usize| {
            let cell = cells(row, delimiter).nth(column).unwrap_or_default();
            let cell = unquoted(cell);
            has_decimal_comma(&cell) || parse_cell(&cell) != CellValue::Text
        };
        has_cells(row, delimiter, self.names.len()) && self.position.iter().all(is_coordinate)
    }

    /// Adds the units in the row below the header to the names, as in `x [mm]`; returns false if the row has none: that
    /// of the coordinates is a known one.
    fn take_units(&mut self, row: &[u8], delimiter: Delimiter) -> bool {
        let units: Vec<String> = cells(row, delimiter).map(unit).collect();
        let is_length =
            |&column: &usize| units.get(column).is_some_and(|unit| LENGTHS.contains(&&*unit.to_lowercase()));
        if !has_cells(row, delimiter, self.names.len()) || !self.position.iter().all(is_length) {
            return false;
        }
        for (name, unit) in self.names.iter_mut().zip(&units) {
            let is_unit = parse_cell(unit.as_bytes()) == CellValue::Text;
            if is_unit && columns::unit_of(name).is_none() {
                *name = format!("{} [{unit}]", columns::unquoted(name));
            }
        }
        true
    }

    fn into_layout(
        self,
        delimiter: Delimiter,
        rows_offset: usize,
        rows_line: u64,
        notes: Vec<String>,
    ) -> TableLayout {
        TableLayout { delimiter, names: self.names, position: self.position, rows_offset, rows_line, notes }
    }
}

/// A cell of a row of units, without quotes and brackets.
fn unit(cell: &[u8]) -> String {
    let text = String::from_utf8_lossy(&unquoted(cell)).trim().to_owned();
    let inside = |open, close| text.strip_prefix(open)?.strip_suffix(close);
    inside('[', ']').or_else(|| inside('(', ')')).unwrap_or(&text).trim().to_owned()
}

/// Units of length below the name of a column, in lower case.
const LENGTHS: [&str; 18] = [
    "m", "mm", "cm", "dm", "km", "um", "\u{b5}m", "\u{3bc}m", "nm", "in", "inch", "ft", "meter", "meters",
    "metre", "metres", "\u{e5}", "angstrom",
];

/// Parses the line as a header, if it names a position with this delimiter.
fn header(line: &[u8], delimiter: Delimiter, naming: Naming) -> Result<Option<NamedColumns>> {
    if !has_enough_cells(line, delimiter) {
        return Ok(None);
    }
    let names = names_in(line, delimiter, naming.limits)?;
    if delimiter == Delimiter::Byte(b'\t') && names.iter().skip(1).any(String::is_empty) {
        return Ok(None); // consecutive tabs align the columns: blanks are the delimiter
    }
    let or_number = |(index, name): (usize, String)| if name.is_empty() { column_name(index) } else { name };
    Ok(naming.position_among(names.into_iter().enumerate().map(or_number).collect()))
}

/// The names of columns in a line; without the last one if it is empty.
fn names_in(line: &[u8], delimiter: Delimiter, limits: &Limits) -> Result<Vec<String>> {
    let mut names: Vec<String> = Vec::new();
    for cell in cells(line, delimiter) {
        check_column_count(names.len(), limits)?;
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
    Ok(names)
}

/// Groups the columns by their names. Text columns do not form vectors with numeric ones.
pub(super) fn group(names: &[String], is_text: impl Fn(usize) -> bool) -> Columns {
    let columns: Vec<_> = names.iter().enumerate().map(|(index, name)| (&**name, is_text(index))).collect();
    columns::group_columns(&columns)
}

pub(super) fn column_name(index: usize) -> String {
    format!("column_{}", index + 1)
}

/// The header of a table whose columns have numbers instead of names, as in `0,1,2`. The column of row
/// numbers before them, in `,0,1,2`, has no name. Programs that write data frames do that.
fn numbered_columns(line: &[u8], delimiter: Delimiter, naming: Naming) -> Option<NamedColumns> {
    let index_count = usize::from(cells(line, delimiter).next()?.is_empty());
    let numbers = || cells(line, delimiter).skip(index_count).map(unquoted);
    let is_numbered = numbers().enumerate().all(|(index, number)| *number == *index.to_string().as_bytes());
    let count = index_count + numbers().count();
    if !is_numbered || count < index_count + 3 {
        return None;
    }
    let index = ["index".to_owned()];
    let numbers = (0..count - index_count).map(|number| number.to_string());
    let written: Vec<String> = index[..index_count].iter().cloned().chain(numbers).collect();
    let usual = NamedColumns::unnamed(&["index"][..index_count], count);
    naming.position_among(written.clone()).or_else(|| naming.usual_position(written, usual))
}

/// Whether one of the first cells of a line has a number that is not an integer.
fn has_fraction(line: &[u8], delimiter: Delimiter) -> bool {
    let number = |cell| match parse_cell(&unquoted(cell)) {
        CellValue::Number(number) => number,
        CellValue::Missing | CellValue::Text => 0.0,
    };
    cells(line, delimiter).take(3).map(number).any(|number| number.fract() != 0.0)
}

/// The first four numbers of each row, NaN for other cells.
fn first_numbers(rows: &[u8], delimiter: Delimiter) -> impl Iterator<Item = [f64; 4]> {
    let lines = rows.split(|byte| matches!(byte, b'\n' | b'\r'));
    let lines = lines.filter(|line| !line.trim_ascii().is_empty() && comment(line).is_none());
    lines.map(move |line| {
        let mut numbers = [f64::NAN; 4];
        for (number, cell) in numbers.iter_mut().zip(cells(line, delimiter)) {
            if let CellValue::Number(found) = parse_cell(&unquoted(cell)) {
                *number = found;
            }
        }
        numbers
    })
}

/// The delimiter and the number of cells of a line that starts with three numbers.
fn row_shape(line: &[u8]) -> Option<(Delimiter, usize)> {
    DELIMITERS.into_iter().find_map(|delimiter| {
        let is_number = |cell| matches!(parse_cell(&unquoted(cell)), CellValue::Number(_));
        if !has_enough_cells(line, delimiter) || !cells(line, delimiter).take(3).all(is_number) {
            return None;
        }
        let count = cells(line, delimiter).count();
        let ends_with_delimiter = cells(line, delimiter).last().is_some_and(<[u8]>::is_empty);
        Some((delimiter, count - usize::from(ends_with_delimiter)))
    })
}

/// Whether a line starts with three numbers, possibly with decimal commas.
fn begins_with_numbers(line: &[u8], delimiter: Delimiter) -> bool {
    let is_number = |cell| {
        let cell = unquoted(cell);
        has_decimal_comma(&cell) || matches!(parse_cell(&cell), CellValue::Number(_))
    };
    has_enough_cells(line, delimiter) && cells(line, delimiter).take(3).all(is_number)
}

fn has_enough_cells(line: &[u8], delimiter: Delimiter) -> bool {
    cells(line, delimiter).nth(2).is_some()
}

/// The names in the line above a row of `count` cells, behind any mark of a comment, if it can only be a header: a name
/// for each cell, or a time first. Blanks are between its names only if they are between the numbers; behind a mark
/// they may also be between the words of a sentence, so that one of them has to look like a name.
fn names_above(line: &[u8], delimiter: Delimiter, count: usize) -> Option<Vec<String>> {
    let line = line.trim_ascii_start();
    let mark_count = line.iter().take_while(|byte| b"#%/!;".contains(byte)).count();
    let is_possible = |other: &Delimiter| *other != Delimiter::Blanks || delimiter == Delimiter::Blanks;
    // A semicolon may be the delimiter behind an empty name.
    let starts = [mark_count, 0].into_iter().filter(|&start| start == mark_count || line.starts_with(b";"));
    let texts =
        starts.flat_map(|start| DELIMITERS.into_iter().filter(is_possible).map(move |other| (start, other)));
    let named = texts.filter_map(|(start, other)| {
        Some((start, other, names_in(&line[start..], other, &Limits::default()).ok()?))
    });
    let mut headers = named.filter(|(start, other, names)| {
        let is_of_time = names.first().is_some_and(|name| super::is_time(name));
        let is_text = |name: &String| parse_cell(name.as_bytes()) == CellValue::Text;
        let is_header = match (start, other) {
            (0, _) => names.len() == count,
            (_, Delimiter::Blanks) => {
                names.len() == count && (is_of_time || names.iter().any(|name| is_no_word(name)))
            }
            _ => names.len() == count || is_of_time,
        };
        is_header && names.iter().all(is_text)
    });
    headers.next().map(|(_, _, names)| names)
}

/// Whether a text is the name of a column rather than a word: one letter, or with a unit, a digit or an underscore.
fn is_no_word(name: &str) -> bool {
    let is_letter = name.len() == 1 && !name.eq_ignore_ascii_case("a");
    is_letter || name.contains(['[', '(', '_']) || name.contains(|letter: char| letter.is_ascii_digit())
}

fn has_letters(text: &[u8]) -> bool {
    text.iter().any(u8::is_ascii_alphabetic)
}

/// Whether a row of whole numbers starts with the number of the rows below it, as in OFF and TetGen.
fn counts_rows(row: &[u8], delimiter: Delimiter, below: &[u8]) -> bool {
    let number = |cell| match parse_cell(&unquoted(cell)) {
        CellValue::Number(number) => Some(number),
        CellValue::Missing | CellValue::Text => None,
    };
    let mut numbers = cells(row, delimiter).filter(|cell| !cell.is_empty()).map(number);
    let Some(Some(count)) = numbers.next() else { return false };
    let is_whole = |number: Option<f64>| number.is_some_and(|number| number.fract() == 0.0);
    count >= FIRST_COUNT && count.fract() == 0.0 && numbers.all(is_whole) && row_count(below) as f64 == count
}

/// The least number of rows that a row above them counts: fewer may be a coordinate by chance.
const FIRST_COUNT: f64 = 4.0;

/// The number of lines that are neither blank nor a comment.
fn row_count(rows: &[u8]) -> u64 {
    let lines = rows.split(|byte| matches!(byte, b'\n' | b'\r'));
    lines.filter(|line| !line.trim_ascii().is_empty() && comment(line).is_none()).count() as u64
}

fn check_column_count(count: usize, limits: &Limits) -> Result<()> {
    if count <= limits.attribute_count {
        return Ok(());
    }
    let what = format!("the file has more columns than the limit of {}", limits.attribute_count);
    Err(Error::too_large(FORMAT, what))
}

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
    let has_commas = |line: &[u8], delimiter| {
        begins_with_numbers(line, delimiter)
            && cells(line, delimiter).take(3).any(|cell| has_decimal_comma(&unquoted(cell)))
    };
    if !lines.any(|line| DELIMITERS.into_iter().any(|delimiter| has_commas(line, delimiter))) {
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

/// The error for numbers with decimal commas that [`with_decimal_points`] left unchanged.
pub(super) fn decimal_commas(line: u64) -> Error {
    let what = format!(
        "line {line} has numbers with a decimal comma, unlike the first rows or without a digit before it: use \
         decimal points"
    );
    Error::unsupported(FORMAT, what)
}

/// From this many lines of text on, a line of three numbers, such as the edges of a box, is no table.
const TEXT_LINES_MAX: u64 = 100;

/// With more lines of text above it, a table without a header has at least as many rows. Otherwise it is another kind
/// of text, one of whose lines has three numbers.
const PROSE_LINES_MAX: u64 = 10;

/// The text after a comment mark.
pub(super) fn comment(line: &[u8]) -> Option<&[u8]> {
    let line = line.trim_ascii_start();
    let text = line.strip_prefix(b"#").or(line.strip_prefix(b"%")).or(line.strip_prefix(b"//"))?;
    let marks = text.iter().take_while(|byte| matches!(byte, b'#' | b'%' | b'/')).count();
    Some(text[marks..].trim_ascii())
}

/// A line without its line end.
#[derive(Clone, Copy)]
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

    /// The next line that is neither blank nor a comment.
    fn next_row(&mut self) -> Result<Option<&'a [u8]>> {
        while let Some(line) = self.next_line()? {
            if comment(line.text).is_none() {
                return Ok(Some(line.text));
            }
        }
        Ok(None)
    }

    /// The line that [`Self::next_row`] would return, without advancing.
    fn peek_row(&self) -> Result<Option<&'a [u8]>> {
        HeadLines { ..*self }.next_row()
    }
}
