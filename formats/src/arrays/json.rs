//! Particles in JSON: a list of positions, as splashsurf reads it, a list of records, or named lists.
//!
//! ```text
//!   [[0.5, 1, 2], [0.25, 1, 2], ..]                           positions
//!   [{"x": 0.5, "y": 1, "z": 2, "id": 7}, ..]                 a record for each particle
//!   {"positions": [[0.5, 1, 2], ..], "vx": [0, ..], ..}       a list for each attribute
//!   {"positions": [0.5, 1, 2, 0.25, 1, 2, ..]}                the same without inner lists, as WebGL has it
//!   {"time": 0.5, "particles": [..]}                          either of the first two, under this name
//! ```
//!
//! The names are interpreted as in all formats. Booleans are integers, and `null`, `NaN` and `Infinity` are
//! numbers that are not finite. Single values, texts and objects are skipped, with a note. The text is read from
//! start to end, and only its numbers are kept: as integers, or as 64-bit floats, correctly rounded.

use std::borrow::Cow;
use std::mem::take;
use std::{fmt, result};

use serde::de::{self, DeserializeSeed, Deserializer, Error as _, IgnoredAny, MapAccess, SeqAccess, Visitor};

use crate::arrays::npy::unnamed_frame;
use crate::core::columns::{Group, group_columns, of_integers, position_rank, role_of};
use crate::core::data::{FileAttribute, ParticleFrame, Values};
use crate::core::error::{Error, Position, Result};
use crate::core::limits::Limits;
use crate::core::named_arrays::{ArrayShape, frame_of, position_count};
use crate::core::number::wide;
use crate::core::row::{FormatRow, ParticleReader};
use crate::core::text::{excerpt, excerpts};

/// The format's name in errors.
const FORMAT: &str = "JSON";

/// Reads the particles of a JSON text.
///
/// # Errors
///
/// [`Error::Truncated`] if the text ends within its first value; [`Error::Invalid`], with line and column, if it is
/// not JSON or has no positions; [`Error::TooLarge`] beyond `limits`.
pub fn read(bytes: &[u8], limits: &Limits) -> Result<ParticleFrame> {
    let mut lists = JsonLists::default();
    let parsed = lists.parse(bytes, limits);
    limits.check_attributes(FORMAT, lists.lists.len(), "names")?;
    parsed?;
    let frame = lists.into_frame()?;
    limits.check_particles(FORMAT, frame.positions.len() as u64)?;
    Ok(frame)
}

/// Whether a text, of which `head` is at least the beginning, has positions where [`read`] finds them. Other
/// JSON, such as settings, lies next to frames more often than in any other format, so this is stricter than
/// the reader: a single vector `position` is not enough, nor are records that also have texts or objects.
pub(crate) fn looks_like_particles(head: &[u8]) -> bool {
    let mut lists = JsonLists::default();
    match lists.parse(head, &Limits::default()) {
        Ok(()) => lists.have_positions(false),
        Err(error) => error.is_truncated() && lists.have_positions(true),
    }
}

/// The values of one name.
struct JsonList {
    /// The name is empty for particles without one, be they positions or records. The arity is 3 before the first row,
    /// and 0 if the list is skipped. The values are integers up to the first other number, which makes them 64-bit
    /// floats.
    array: FileAttribute,
    /// The number of complete rows, one per particle.
    row_count: usize,
}

impl JsonList {
    fn push(&mut self, integer: Option<i64>, real: f64) {
        let FileAttribute { name, arity, values, .. } = &mut self.array;
        // An endless row takes no memory.
        let is_long = name.is_empty() && values.len() > self.row_count * *arity + ROW_MAX;
        match (values, integer) {
            _ if *arity == 0 || is_long => {}
            (Values::I64(integers), Some(integer)) => integers.push(integer),
            (Values::F64(reals), _) => reals.push(real),
            (values, _) => {
                *values = Values::F64(wide(values));
                self.push(integer, real);
            }
        }
    }

    /// Whether these are positions by their name, or without one.
    fn is_position(&self) -> bool {
        self.array.name.is_empty() || position_rank(&self.array.name).is_some()
    }

    /// Whether this is a position in a list without inner lists. `x`, `r` and `p` alone have other meanings.
    fn is_flat_position(&self) -> bool {
        self.array.arity == 1 && self.array.name.len() > 1 && self.is_position()
    }
}

/// All lists of a text.
#[derive(Default)]
struct JsonLists {
    lists: Vec<JsonList>,
    /// The most lists.
    count_max: usize,
    /// Whether the particles are records.
    has_records: bool,
    /// What is skipped, and why.
    notes: Vec<String>,
}

impl JsonLists {
    /// Reads a text. After an error, the lists contain what was read before it.
    fn parse(&mut self, bytes: &[u8], limits: &Limits) -> Result<()> {
        self.count_max = limits.attribute_count;
        let text = without_nan(bytes.strip_prefix(b"\xef\xbb\xbf").unwrap_or(bytes));
        let mut source = serde_json::Deserializer::from_slice(&text);
        let document = JsonPart { lists: self, index: 0, level: Level::Document };
        document.deserialize(&mut source).and_then(|()| source.end()).map_err(|error| error_of(&error))
    }

    /// Adds a list; returns its index.
    fn add<E: de::Error>(&mut self, name: &str) -> result::Result<usize, E> {
        if self.lists.len() > self.count_max {
            return Err(E::custom("too many names"));
        }
        let array = FileAttribute::new(name, 3, Values::I64(Vec::new()));
        self.lists.push(JsonList { array, row_count: 0 });
        Ok(self.lists.len() - 1)
    }

    /// Whether there are positions other than a list without inner lists.
    fn have_vectors(&self) -> bool {
        let lists = self.lists.iter().filter(|list| list.row_count > 0);
        let shapes: Vec<_> = lists.map(|list| ArrayShape::of(&list.array)).collect();
        position_count(&shapes).is_some()
            || shapes.iter().any(|shape| shape.name.is_empty() && shape.arity == 3)
    }

    /// See [`looks_like_particles`]. If the text `is_cut`, the last list is incomplete.
    fn have_positions(&self, is_cut: bool) -> bool {
        let Some(JsonList { array: last, .. }) = self.lists.last() else { return false };
        let is_known = position_rank(&last.name).is_some() || role_of(&last.name, last.arity).is_some();
        // The positions may follow a long list of another quantity, or y and z may follow x.
        let may_follow = is_cut && is_known && last.values.len() > LONG_LIST;
        let are_flat = self.lists.iter().any(|list| list.is_flat_position() && list.row_count > 3);
        (!self.has_records || self.notes.is_empty()) && (self.have_vectors() || are_flat || may_follow)
    }

    fn into_frame(mut self) -> Result<ParticleFrame> {
        let flat = if self.have_vectors() { None } else { self.split_flat() };
        self.lists.retain(|list| list.array.arity != 0);
        let names = excerpts(self.lists.iter().map(|list| &list.array.name));
        let skipped = self.notes.first().map(|note| format!("; {note}")).unwrap_or_default();
        let what = "no positions: expected [[x, y, z], ..], records with x, y and z, or an object with a list \
                    `positions` or with lists x, y and z; found the lists: ";
        let no_positions = Error::invalid(FORMAT, Position::File, format!("{what}{names}{skipped}"));
        let mut arrays: Vec<FileAttribute> = self.lists.into_iter().map(|list| list.array).collect();
        widen_columns(&mut arrays);
        let unnamed = arrays.iter().position(|array| array.name.is_empty());
        let first = unnamed.map(|index| unnamed_frame(arrays.remove(index))).transpose();
        let mut first = first.map_err(|error| error.with_format(FORMAT))?;
        let positions = first.as_mut().map(|first| take(&mut first.positions));
        let mut frame = frame_of(positions, arrays).ok_or(no_positions)?;
        let first = first.unwrap_or_default();
        frame.attributes.extend(first.attributes);
        frame.notes.extend(first.notes.into_iter().chain(self.notes).chain(flat));
        for FileAttribute { values, role, .. } in &mut frame.attributes {
            if let Values::I64(integers) = values {
                *values = of_integers(take(integers), *role);
            }
        }
        Ok(frame)
    }

    /// Splits a flat list of positions, if there is one, and the lists of other vectors.
    fn split_flat(&mut self) -> Option<String> {
        let flat =
            self.lists.iter().filter(|list| list.is_flat_position() && list.row_count.is_multiple_of(3));
        let position = flat.min_by_key(|list| position_rank(&list.array.name))?;
        let (count, name) = (position.row_count / 3, excerpt(&position.array.name));
        for JsonList { array, row_count } in self.lists.iter_mut().filter(|list| list.array.arity == 1) {
            array.arity = (1..=4).find(|arity| arity * count == *row_count).unwrap_or(1);
        }
        Some(format!("each three numbers of `{name}` are a position"))
    }
}

/// Makes the components of a vector reals if one of them has reals: only equal types are joined.
fn widen_columns(arrays: &mut [FileAttribute]) {
    let mut singles: Vec<_> = arrays.iter_mut().filter(|array| array.arity == 1).collect();
    let names: Vec<_> = singles.iter().map(|array| (&*array.name, ())).collect();
    for Group { columns, .. } in group_columns(&names).groups {
        if columns.iter().any(|&at| matches!(singles[at].values, Values::F64(_))) {
            columns.iter().for_each(|&at| singles[at].values = Values::F64(wide(&singles[at].values)));
        }
    }
}

/// The most numbers of a particle without names.
const ROW_MAX: usize = 32;

/// More numbers than a setting has.
const LONG_LIST: usize = 64;

/// The error of a text.
fn error_of(error: &serde_json::Error) -> Error {
    let goes_on = "the text goes on after its first value; JSON with a value on each line is not read: put all of \
                   them into one list, [..]";
    let (position, line) = (Position::Line(error.line() as u64), format!(" at line {}", error.line()));
    let what = error.to_string().replace("trailing characters", goes_on).replace(&line, ",");
    if error.is_eof() {
        return Error::truncated(FORMAT, position, format!("the file ends where more was expected: {what}"));
    }
    Error::invalid(FORMAT, position, what)
}

/// A text that stands for a number that JSON lacks: as long as `NaN`, so that errors show the right offset.
const NAN: &str = "\"\x7f\"";

/// The bytes at which something begins or ends.
const MARKS: [u8; 4] = *b"NI\"\\";

/// The text without the numbers that Python writes, but JSON lacks.
fn without_nan(bytes: &[u8]) -> Cow<'_, [u8]> {
    let (mut text, mut at, mut is_quoted) = (Cow::Borrowed(bytes), 0, false);
    while let Some(step) = bytes.get(at..).and_then(|rest| rest.iter().position(|byte| MARKS.contains(byte)))
    {
        at += step;
        let rest = &bytes[at..];
        let word: &[u8] = if rest[0] == b'N' { b"NaN" } else { b"Infinity" };
        // The end of a text that is still being written may be the beginning of a word.
        let length = word.len().min(rest.len());
        if !is_quoted && rest[..length] == word[..length] {
            let start = at - usize::from(bytes[..at].ends_with(b"-"));
            let padded = format!("{NAN:0$}", at + word.len() - start);
            text.to_mut()[start..].iter_mut().zip(padded.bytes()).for_each(|(byte, new)| *byte = new);
        }
        is_quoted ^= rest[0] == b'"';
        at += 1 + usize::from(rest[0] == b'\\');
    }
    text
}

/// A name, borrowed unless it has escapes.
#[derive(serde::Deserialize)]
struct Name<'a>(#[serde(borrow)] Cow<'a, str>);

/// What a value is.
#[derive(Clone, Copy, PartialEq)]
enum Level {
    Document,
    /// The value of a name, or a list without one.
    List,
    /// The numbers of a particle, or a record in a list without a name.
    Row,
    Number,
}

/// A value that is read into the list with this index; a record is read into those after it.
struct JsonPart<'a> {
    lists: &'a mut JsonLists,
    index: usize,
    level: Level,
}

impl JsonPart<'_> {
    /// Skips the list, or fails if it is the position.
    fn skip<E: de::Error>(&mut self, what: fmt::Arguments) -> result::Result<(), E> {
        let Some(list) = self.lists.lists.get_mut(self.index) else {
            return Err(E::custom("expected a list or an object"));
        };
        if self.level != Level::List && list.is_position() {
            return Err(E::custom(what));
        }
        if take(&mut list.array.arity) != 0 {
            let name = if list.array.name.is_empty() { "particles" } else { &list.array.name };
            let why = match self.level {
                Level::Row | Level::Number => format!("row {}: {what}", list.row_count + 1),
                Level::Document | Level::List => "it is not a list".into(),
            };
            self.lists.notes.push(format!("skipped `{}`: {why}", excerpt(name)));
        }
        list.array.values = Values::I64(Vec::new());
        Ok(())
    }

    fn number<E: de::Error>(&mut self, integer: Option<i64>, real: f64) -> result::Result<(), E> {
        if let Level::Document | Level::List = self.level {
            return self.skip(format_args!(""));
        }
        self.lists.lists[self.index].push(integer, real);
        if self.level == Level::Row { self.end_row() } else { Ok(()) }
    }

    /// Checks that a row has as many numbers as those before.
    fn end_row<E: de::Error>(&mut self) -> result::Result<(), E> {
        let JsonList { array, row_count } = &mut self.lists.lists[self.index];
        let found = array.values.len() - *row_count * array.arity;
        let fits_others = found > 0 && (*row_count == 0 || found == array.arity);
        if fits_others && (!array.name.is_empty() || (3..=ROW_MAX).contains(&found)) {
            array.arity = found;
            return Ok(());
        }
        match array.arity {
            0 => self.skip(format_args!("expected an object, as before")),
            arity => self.skip(format_args!("expected a list of {arity} numbers, found {found}")),
        }
    }
}

impl<'de> DeserializeSeed<'de> for JsonPart<'_> {
    type Value = ();

    fn deserialize<D: Deserializer<'de>>(self, source: D) -> result::Result<(), D::Error> {
        source.deserialize_any(self)
    }
}

impl<'de> Visitor<'de> for JsonPart<'_> {
    type Value = ();

    fn expecting(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str("particles")
    }

    fn visit_unit<E: de::Error>(mut self) -> result::Result<(), E> {
        self.number(None, f64::NAN)
    }

    fn visit_bool<E: de::Error>(mut self, is_set: bool) -> result::Result<(), E> {
        self.number(Some(is_set.into()), is_set.into())
    }

    fn visit_i64<E: de::Error>(mut self, integer: i64) -> result::Result<(), E> {
        self.number(Some(integer), integer as f64)
    }

    fn visit_u64<E: de::Error>(mut self, integer: u64) -> result::Result<(), E> {
        self.number(integer.try_into().ok(), integer as f64)
    }

    fn visit_f64<E: de::Error>(mut self, real: f64) -> result::Result<(), E> {
        self.number(None, real)
    }

    fn visit_str<E: de::Error>(mut self, text: &str) -> result::Result<(), E> {
        if *text == NAN[1..2] {
            return self.visit_unit();
        }
        self.skip(format_args!("expected a number, found a text"))
    }

    fn visit_seq<A: SeqAccess<'de>>(mut self, mut seq: A) -> result::Result<(), A::Error> {
        let level = match self.level {
            Level::Document => self.lists.add("").map(|_| Level::Row)?,
            Level::List => Level::Row,
            Level::Row => Level::Number,
            Level::Number => {
                self.skip(format_args!("expected a number, found a list; save each frame as a file"))?;
                return IgnoredAny.visit_seq(seq).map(drop);
            }
        };
        while seq.next_element_seed(JsonPart { lists: self.lists, level, ..self })?.is_some() {
            self.lists.lists[self.index].row_count += usize::from(level == Level::Row);
        }
        if self.level == Level::Row { self.end_row() } else { Ok(()) }
    }

    fn visit_map<A: MapAccess<'de>>(mut self, mut map: A) -> result::Result<(), A::Error> {
        let (mut next, count, level) = match self.lists.lists.get_mut(self.index) {
            None => (0, 0, Level::List),
            Some(JsonList { array, row_count })
                if self.level == Level::Row && array.name.is_empty() && array.values.len() == 0 =>
            {
                (array.arity, self.lists.has_records) = (0, true);
                (self.index + 1, *row_count + 1, Level::Row)
            }
            Some(_) => {
                self.skip(format_args!("expected a number, found an object"))?;
                return IgnoredAny.visit_map(map).map(drop);
            }
        };
        let first = next;
        while let Some(Name(name)) = map.next_key()? {
            let name = if name.is_empty() { "_" } else { &*name };
            let name = if count == 0 && name.eq_ignore_ascii_case("particles") { "" } else { name };
            // Most records have the same order.
            let mut order = (next..self.lists.lists.len()).chain(first..next);
            let index = match order.find(|&index| self.lists.lists[index].array.name == name) {
                Some(_) if count == 0 => {
                    return Err(A::Error::custom(format_args!("the name `{}` appears twice", excerpt(name))));
                }
                Some(index) => index,
                None => self.lists.add(name)?,
            };
            map.next_value_seed(JsonPart { lists: self.lists, index, level })?;
            self.lists.lists[index].row_count += count.min(1);
            next = index + 1;
        }
        let mut lists = self.lists.lists[first..].iter();
        let odd =
            lists.find(|list| count != 0 && list.row_count != count).map(|odd| excerpt(&odd.array.name));
        odd.map_or(Ok(()), |name| Err(A::Error::custom(format!("expected `{name}` once in each record"))))
    }
}

/// The row in the table of formats.
pub(crate) static ROW: FormatRow =
    FormatRow { particles: Some(ParticleReader::needs_reading(read)), ..FormatRow::new(FORMAT, &["json"]) };
