//! The `.xyz` format of chemistry, plain and extended: a count, a comment, and a line per atom. Many frames
//! can follow one another.
//!
//! ```text
//!   3                                                     number of atoms
//!   Properties=species:S:1:pos:R:3:velo:R:3 Time=0.5      a comment; in extended XYZ it describes the columns
//!   O 0.0 0.0 0.0   0 0 -1                                an element, its position, and further columns
//!   H 0.757 0.586 0 0 0 -1
//!   H -0.757 0.586 0 0 0 -1
//! ```
//!
//! An atomic number can replace the element. Without `Properties`, the columns after the position have no
//! names; they are named after their number: `column_5` and so on. Lengths are usually in ångströms and are
//! not converted. The rows are read like those of any other table.
//!
//! Programs that put line ends only between lines omit the one after the last line. Such a frame is read like
//! any other table, but with a note: if the file is still being written, its last number may lack digits.

use crate::core::data::ParticleFrame;
use crate::core::error::{Error, Position, Result};
use crate::core::limits::Limits;
use crate::core::row::{FormatRow, ParticleReader};
use crate::core::steps::{FoundStep, StepSource, end_at};
use crate::core::text::{Lines, parse_number};
use crate::tables::csv;

/// The format's name in errors.
pub(crate) const FORMAT: &str = "XYZ atoms";

/// Whether a text starts like a frame of atoms: the first line is a count alone, and the third line is a word
/// followed by three numbers. A table has no such word, and other text has no such count. If an atomic number
/// replaces the word, [`have_atomic_numbers`] applies stricter conditions. Frames without atoms may precede
/// it, and be all that there is, with a comment that is not a number and the name of an XYZ file.
pub(crate) fn looks_like_atoms(text: &[u8], name: &str) -> bool {
    let mut lines = Lines::new(text);
    let mut is_empty = false;
    let (count, comment) = loop {
        let Some(line) = lines.find(|line| !line.trim_ascii().is_empty()) else {
            return is_empty && (name.ends_with(".xyz") || name.ends_with(".extxyz"));
        };
        let Some(count) = count(line) else { return false };
        let comment = lines.next();
        if count > 0 {
            break (count, comment.unwrap_or_default());
        }
        is_empty = comment.is_some_and(|comment| parse_number::<f64>(comment.trim_ascii()).is_none());
    };
    let Some(row) = lines.clone().next() else { return false };
    let mut words = words(row);
    let is_element = words.next().is_some_and(|word| word[0].is_ascii_alphabetic());
    if is_element {
        words.filter_map(parse_number::<f64>).take(3).count() == 3
    } else {
        !csv::names_position(comment) && have_atomic_numbers(comment, lines, text, count)
    }
}

/// Whether these rows are atoms given by atomic numbers: each starts with one, followed by at least three
/// numbers; all rows have the same number of cells; and only another frame follows them. A numeric table
/// below a line with its row count is not mistaken for atoms: it has no comment, so its second line looks
/// like the others.
fn have_atomic_numbers(comment: &[u8], lines: Lines, text: &[u8], atom_count: u64) -> bool {
    let most = usize::try_from(atom_count).unwrap_or(usize::MAX);
    let mut rows: Vec<&[u8]> = lines.clone().take(most).collect();
    // The last line may be truncated.
    if rows.len() > 1 && lines.clone().nth(rows.len()).is_none() && !text.ends_with(b"\n") {
        rows.pop();
    }
    let cell_count = rows.first().map_or(0, |row| words(row).count());
    let is_atom = |row: &&[u8]| {
        let is_number = |word| parse_number::<f64>(word).is_some();
        words(row).next().and_then(count).is_some_and(|number| (1..=ATOMIC_NUMBER_MAX).contains(&number))
            && words(row).count() == cell_count
            && words(row).skip(1).take(3).filter(|word| is_number(word)).count() == 3
    };
    let mut behind = lines.skip(most).filter(|line| !line.trim_ascii().is_empty());
    !rows.is_empty()
        && !is_atom(&comment)
        && rows.iter().all(is_atom)
        && behind.next().is_none_or(|line| count(line).is_some())
}

/// The atomic number of oganesson, the heaviest element.
const ATOMIC_NUMBER_MAX: u64 = 118;

/// Parses a line or word as a whole number.
fn count(text: &[u8]) -> Option<u64> {
    let digits = text.trim_ascii();
    let is_count = !digits.is_empty() && digits.iter().all(u8::is_ascii_digit);
    std::str::from_utf8(digits).ok().filter(|_| is_count)?.parse().ok()
}

/// Reads the only frame of a file.
///
/// # Errors
/// [`Error::Truncated`] if atoms are missing, [`Error::Invalid`] with the line if a row has the wrong number
/// of cells, or text in a numeric column; [`Error::Unsupported`] for a file with several frames, which
/// [`crate::table::steps::find_steps`] locates; [`Error::TooLarge`] beyond `limits`, which also limit the number of
/// frames.
pub fn read(bytes: &[u8], limits: &Limits) -> Result<ParticleFrame> {
    let mut lines = Lines::new(bytes);
    let count = lines.next().unwrap_or_default().trim_ascii();
    let count: u64 = std::str::from_utf8(count)
        .ok()
        .and_then(|count| count.parse().ok())
        .ok_or_else(|| invalid(1, "expected the number of atoms"))?;
    if count > limits.particle_count {
        let what =
            format!("the file has {count} particles, more than the limit of {}", limits.particle_count);
        return Err(Error::too_large(FORMAT, what));
    }
    let comment = lines.next().ok_or_else(|| truncated(1, "expected a comment"))?;
    let (offset, line) = (lines.at(), lines.number() + 1);
    let first = lines.clone().next().unwrap_or_default();
    for found in 0..count {
        let Some(line) = lines.next() else {
            return Err(truncated(lines.number(), format!("expected {count} atoms, found {found}")));
        };
        if line.trim_ascii().is_empty() {
            return Err(invalid(lines.number(), "expected an atom, found an empty line"));
        }
    }
    let end = lines.at();
    if lines.any(|line| !line.trim_ascii().is_empty()) {
        // If there are too many frames, report that instead.
        steps_of_atoms(StepSource::new(&mut &*bytes, 0, 0), &mut Vec::new(), limits)?;
        let what = "the file has several frames: read each frame separately";
        return Err(Error::unsupported(FORMAT, what));
    }
    if count == 0 {
        return Ok(ParticleFrame::default());
    }
    let names = names(comment, words(first).count(), limits)?;
    let position = position(&names).ok_or_else(|| invalid(2, "Properties does not contain pos:R:3"))?;
    let rows = csv::CountedRows { names, position, offset, line, count };
    let table = bytes.get(..end).unwrap_or_default();
    let frame = csv::read_rows(table, rows, limits).map_err(|error| error.with_format(FORMAT))?;
    let mut frame = frame.ok_or_else(|| invalid(2, "Properties contains a second position besides pos"))?;
    frame.notes.extend(crate::core::text::open_end_note(table));
    Ok(frame)
}

/// The names of the columns; `column_count` is the number of cells in the first row.
fn names(comment: &[u8], column_count: usize, limits: &Limits) -> Result<Vec<String>> {
    let properties = std::str::from_utf8(comment).ok().and_then(properties);
    let count = properties.as_ref().map_or(column_count, |names| names.iter().map(|(_, count)| count).sum());
    limits.check_attributes(FORMAT, count, "columns")?;
    let Some(properties) = properties else {
        let known = ["element", "x", "y", "z"].map(String::from).into_iter();
        return Ok(known.chain((5..=column_count).map(|column| format!("column_{column}"))).collect());
    };
    let of_property = |(name, count): &(&str, usize)| -> Vec<String> {
        match count {
            1 => vec![(*name).to_owned()],
            3 if *name == "pos" => ["x", "y", "z"].map(String::from).into(),
            3 => ["x", "y", "z"].map(|axis| format!("{name}_{axis}")).into(),
            _ => (0..*count).map(|index| format!("{name}_{index}")).collect(),
        }
    };
    Ok(properties.iter().flat_map(of_property).collect())
}

/// The column descriptions in the comment of extended XYZ: names, and the number of columns of each.
fn properties(comment: &str) -> Option<Vec<(&str, usize)>> {
    const COLUMNS_MAX: usize = 1 << 16;
    let value = comment.split_once("Properties=")?.1.trim_start_matches('"');
    let value = value.split(|c: char| c.is_whitespace() || c == '"').next()?;
    let words: Vec<&str> = value.split(':').collect();
    let (triples, rest) = words.as_chunks::<3>();
    if !rest.is_empty() {
        return None;
    }
    triples
        .iter()
        .map(|&[name, _, count]| Some((name, count.parse().ok().filter(|n| (1..=COLUMNS_MAX).contains(n))?)))
        .collect()
}

/// The columns of the position.
fn position(names: &[String]) -> Option<[usize; 3]> {
    let column_of = |name: &str| names.iter().position(|found| found == name);
    Some([column_of("x")?, column_of("y")?, column_of("z")?])
}

fn words(line: &[u8]) -> impl Iterator<Item = &[u8]> {
    line.split(u8::is_ascii_whitespace).filter(|word| !word.is_empty())
}

fn invalid(line: u64, what: impl Into<String>) -> Error {
    Error::invalid(FORMAT, Position::Line(line), what)
}

fn truncated(line: u64, what: impl Into<String>) -> Error {
    Error::truncated(FORMAT, Position::Line(line), what)
}

/// The row in the table of formats.
pub(crate) static ROW: FormatRow = FormatRow {
    particles: Some(ParticleReader { find_steps: Some(steps_of_atoms), ..ParticleReader::new(read) }),
    ..FormatRow::new(FORMAT, &["xyz", "txt"])
};

/// Finds the steps of a file of atoms. A step is a line with a count N, a comment line, and N lines of atoms.
/// If the count is invalid, the rest of the file is one step, because the start of the next step is unknown.
fn steps_of_atoms(mut lines: StepSource, steps: &mut Vec<FoundStep>, limits: &Limits) -> Result<()> {
    while let Some(start) = lines.next_line()? {
        let line = lines.head.trim_ascii();
        if line.is_empty() {
            continue;
        }
        end_at(steps, start);
        limits.check_step("XYZ atoms", steps.len())?;
        let count: Option<u64> = std::str::from_utf8(line).ok().and_then(|count| count.parse().ok());
        let number = i64::try_from(steps.len()).ok();
        steps.push(FoundStep::of_text(number, start, &lines));
        // Skips the comment line and the atoms.
        for _ in 0..count.map_or(u64::MAX, |count| count.saturating_add(1)) {
            if lines.next_line()?.is_none() {
                break;
            }
        }
    }
    end_at(steps, lines.end);
    Ok(())
}
