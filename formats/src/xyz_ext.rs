//! The `.xyz` of chemists: a count, a comment, and a line for each atom. Many frames may follow each other.
//!
//! ```text
//!   3                                                     so many atoms
//!   Properties=species:S:1:pos:R:3:velo:R:3 Time=0.5      a comment; extended XYZ says in it what the columns are
//!   O 0.0 0.0 0.0   0 0 -1                                an element, its position, and what else there is
//!   H 0.757 0.586 0 0 0 -1
//!   H -0.757 0.586 0 0 0 -1
//! ```
//!
//! An atomic number may stand for the element. Without `Properties` the columns behind the position have no names: they are called `column_5` and so on, as they are
//! counted. Lengths are ångströms as a rule; they are kept as they are. The rows are read as all tables are.
//!
//! Whoever joins lines writes none behind the last: such a frame is read as a table would be, and it is told, for
//! the last number of a file that is still being written may lack digits.

use crate::csv;
use crate::data::ParticleFrame;
use crate::error::{Error, Place, Result};
use crate::limits::Limits;
use crate::row::{FormatRow, ParticleInput};
use crate::step_finders::{LineHeads, steps_of_atoms};
use crate::text::{Lines, parse_number};

/// The format as users know it, for errors.
pub(crate) const FORMAT: &str = "XYZ atoms";

/// Whether a text begins like a frame of atoms: a count alone in the first line, and in the third a word before three
/// numbers. A table has no such word, and other text no such count. Where an atomic number stands for the word, more is asked.
pub(crate) fn looks_like_atoms(text: &[u8]) -> bool {
    let mut lines = Lines::new(text);
    let Some(count) = lines.next().and_then(count) else { return false };
    let comment = lines.next().unwrap_or_default();
    let Some(row) = lines.clone().next() else { return false };
    let mut words = words(row);
    let is_element = words.next().is_some_and(|word| word[0].is_ascii_alphabetic());
    match is_element {
        true => words.filter_map(parse_number::<f64>).take(3).count() == 3,
        false => !csv::names_position(comment) && have_atomic_numbers(comment, lines, text, count),
    }
}

/// Whether these rows are of atoms that go by their numbers: each has one before three numbers or more, as many cells as
/// the others, and behind so many rows nothing comes but the next frame. A table below the count of its rows has all that, but
/// no comment: its first row is like the others.
fn have_atomic_numbers(comment: &[u8], lines: Lines, text: &[u8], atom_count: u64) -> bool {
    let most = usize::try_from(atom_count).unwrap_or(usize::MAX);
    let mut rows: Vec<&[u8]> = lines.clone().take(most).collect();
    // The last line may be cut off.
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

/// Oganesson's.
const ATOMIC_NUMBER_MAX: u64 = 118;

/// The whole number that a line or a word is.
fn count(text: &[u8]) -> Option<u64> {
    let digits = text.trim_ascii();
    let is_count = !digits.is_empty() && digits.iter().all(u8::is_ascii_digit);
    std::str::from_utf8(digits).ok().filter(|_| is_count)?.parse().ok()
}

/// Reads the only frame of a file.
///
/// # Errors
///
/// [`Error::Short`] where atoms are missing, [`Error::Invalid`] with the line where a row has too many or too few
/// cells, or text in a column of numbers; [`Error::Unsupported`] for a file of several frames, which
/// [`crate::steps::find_steps`] finds; [`Error::TooLarge`] beyond `limits`, of which one is for the number of frames.
pub fn read(bytes: &[u8], limits: &Limits) -> Result<ParticleFrame> {
    let mut lines = Lines::new(bytes);
    let count = lines.next().unwrap_or_default().trim_ascii();
    let count: u64 = std::str::from_utf8(count)
        .ok()
        .and_then(|count| count.parse().ok())
        .ok_or_else(|| invalid(1, "expected the number of atoms"))?;
    if count > limits.particle_count {
        let what = format!("{count} particles, more than the limit of {}", limits.particle_count);
        return Err(Error::too_large(FORMAT, what));
    }
    let comment = lines.next().ok_or_else(|| short(1, "expected a comment"))?;
    let (offset, line) = (lines.at(), lines.number() + 1);
    let first = lines.clone().next().unwrap_or_default();
    for found in 0..count {
        let Some(line) = lines.next() else {
            return Err(short(lines.number(), format!("expected {count} atoms, found {found}")));
        };
        if line.trim_ascii().is_empty() {
            return Err(invalid(lines.number(), "expected an atom, found an empty line"));
        }
    }
    let end = lines.at();
    if lines.any(|line| !line.trim_ascii().is_empty()) {
        // Of more than there may be, that is what is to be told.
        steps_of_atoms(LineHeads::new(&mut &*bytes, 0, 0), &mut Vec::new(), limits)?;
        let what = "the file has several frames, and a frame is one: each is to be read by itself";
        return Err(Error::unsupported(FORMAT, what));
    }
    if count == 0 {
        return Ok(ParticleFrame::default());
    }
    let names = names(comment, words(first).count(), limits)?;
    let position = position(&names).ok_or_else(|| invalid(2, "Properties have no pos:R:3"))?;
    let rows = csv::Rows { names, position, offset, line, count };
    let table = bytes.get(..end).unwrap_or_default();
    let frame = csv::read_rows(table, rows, limits).map_err(|error| error.of_format(FORMAT))?;
    let mut frame = frame.ok_or_else(|| invalid(2, "Properties name another position beside pos"))?;
    frame.notes.extend(csv::open_end_note(table));
    Ok(frame)
}

/// The names of the columns, of which there are so many in the first row.
fn names(comment: &[u8], column_count: usize, limits: &Limits) -> Result<Vec<String>> {
    let properties = std::str::from_utf8(comment).ok().and_then(properties);
    let count = properties.as_ref().map_or(column_count, |names| names.iter().map(|(_, count)| count).sum());
    if count > limits.attribute_count {
        let what = format!("more columns than the limit of {}", limits.attribute_count);
        return Err(Error::too_large(FORMAT, what));
    }
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

/// What the comment of extended XYZ says of the columns: names, and how many columns each has.
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
    Error::invalid(FORMAT, Place::Line(line), what)
}

fn short(line: u64, what: impl Into<String>) -> Error {
    Error::short(FORMAT, Place::Line(line), what)
}

/// What the table of formats says of it.
pub(crate) static ROW: FormatRow = FormatRow {
    particles: Some(ParticleInput { find_steps: Some(steps_of_atoms), ..ParticleInput::new(read) }),
    ..FormatRow::new(FORMAT, &["xyz", "txt"])
};
