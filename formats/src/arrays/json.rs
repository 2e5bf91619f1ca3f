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

use crate::arrays::npy::unnamed_frame;
use crate::core::columns::{Columns, group_columns, of_integers, position_rank, role_of};
use crate::core::data::{ParticleFrame, Values};
use crate::core::error::{Error, Position, Result};
use crate::core::limits::Limits;
use crate::core::named_arrays::{NamedArray, frame_of};
use crate::core::number::{interleaved, wide};
use crate::core::row::{FormatRow, ParticleReader};
use crate::core::text::{excerpt, excerpts, line_number};

/// The format's name in errors.
const FORMAT: &str = "JSON";

/// Reads the particles of a JSON text.
///
/// # Errors
///
/// [`Error::Truncated`] if the text ends within its first value; [`Error::Invalid`], with the line, or with
/// the offset in the first line, if it is not JSON or has no positions; [`Error::TooLarge`] beyond `limits`.
pub fn read(bytes: &[u8], limits: &Limits) -> Result<ParticleFrame> {
    let mut lists = JsonLists::default();
    lists.parse(bytes, limits).map_err(|mut error| {
        if let Error::Truncated { position, .. } | Error::Invalid { position, .. } = &mut error
            && let Position::Offset(at) = *position
            && let line @ 2.. = line_number(bytes, usize::try_from(at).unwrap_or(usize::MAX))
        {
            *position = Position::Line(line);
        }
        error
    })?;
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

/// A number of a text.
enum JsonNumber {
    Integer(i64),
    Real(f64),
}

/// The values of one name.
struct JsonList {
    /// Empty for positions without a name.
    name: String,
    /// The number of values per particle; 0 until it is known.
    arity: usize,
    /// Integers up to the first other number, which makes them 64-bit floats.
    values: Values,
    /// The number of records with this name.
    record_count: usize,
    /// Why the values are skipped.
    fault: Option<String>,
}

impl JsonList {
    fn new(name: String) -> JsonList {
        JsonList { name, arity: 0, values: Values::I64(Vec::new()), record_count: 0, fault: None }
    }

    fn skip(&mut self, fault: String) {
        (self.values, self.arity, self.fault) = (Values::I64(Vec::new()), 0, Some(fault));
    }

    fn push(&mut self, number: JsonNumber) {
        match (&mut self.values, number) {
            (Values::I64(integers), JsonNumber::Integer(integer)) => integers.push(integer),
            (Values::F64(reals), JsonNumber::Real(real)) => reals.push(real),
            (Values::F64(reals), JsonNumber::Integer(integer)) => reals.push(integer as f64),
            (_, real) => {
                self.widen();
                self.push(real);
            }
        }
    }

    fn widen(&mut self) {
        self.values = Values::F64(wide(&self.values));
    }

    /// Reads the numbers of a particle: a number, or a list of as many as the particles before have.
    fn read_particle(&mut self, text: &mut JsonText) -> Result<()> {
        let (at, before) = (text.at, self.values.len());
        let most = match before {
            0 if self.name.is_empty() => ROW_MAX,
            0 => usize::MAX,
            _ => self.arity,
        };
        if text.peek("a number")? == b'[' {
            let mut has_more = text.opens(b']')?;
            while has_more {
                if self.values.len() - before == most {
                    return Err(text.invalid_at(at, format!("expected at most {most} numbers, found more")));
                }
                self.push(text.number()?);
                has_more = text.continues(b']')?;
            }
        } else {
            self.push(text.number()?);
        }
        let found = self.values.len() - before;
        if found == 0 || before != 0 && found != self.arity {
            let expected = if found == 0 { 3 } else { self.arity };
            return Err(text.invalid_at(at, format!("expected {expected} numbers, found {found}")));
        }
        self.arity = found;
        Ok(())
    }

    /// Reads a list of numbers, or of lists of numbers. Positions without a name must be lists.
    fn read_particles(&mut self, text: &mut JsonText) -> Result<()> {
        let is_unnamed = self.name.is_empty();
        let mut has_more = text.opens(b']')?;
        while has_more {
            if is_unnamed && self.arity == 0 && text.follows(b"[[") {
                return Err(text.invalid("this list has several frames: save each as a file"));
            }
            let at = text.at;
            self.read_particle(text)?;
            if is_unnamed && self.arity < 3 {
                let what = format!("expected lists of three numbers, [x, y, z], found {}", self.arity);
                return Err(text.invalid_at(at, what));
            }
            has_more = text.continues(b']')?;
        }
        Ok(())
    }

    /// Reads values. If they are not numbers, and not positions, they are skipped.
    fn read_or_skip(
        &mut self,
        text: &mut JsonText,
        read: fn(&mut JsonList, &mut JsonText) -> Result<()>,
    ) -> Result<()> {
        let start = text.at;
        if self.fault.is_none() {
            match read(self, text) {
                Err(Error::Invalid { position, what, .. }) if position_rank(&self.name).is_none() => {
                    self.skip(format!("{position}: {what}"));
                }
                outcome => return outcome,
            }
        }
        text.at = start;
        text.skip_value()
    }

    /// Whether this is a position in a list without inner lists. `x`, `r` and `p` alone have other meanings.
    fn is_flat_position(&self) -> bool {
        self.arity == 1 && self.name.len() > 1 && position_rank(&self.name).is_some()
    }

    fn is_vector_position(&self) -> bool {
        self.arity == 3 && (self.name.is_empty() || position_rank(&self.name).is_some())
    }
}

/// All lists of a text.
#[derive(Default)]
struct JsonLists {
    lists: Vec<JsonList>,
    /// Whether the particles are records.
    has_records: bool,
}

impl JsonLists {
    /// Reads a text. After an error, the lists contain what was read before it.
    fn parse(&mut self, bytes: &[u8], limits: &Limits) -> Result<()> {
        let mut text = JsonText { bytes, at: if bytes.starts_with(b"\xef\xbb\xbf") { 3 } else { 0 } };
        match text.peek("a list or an object")? {
            b'[' => self.read_unnamed(&mut text, limits)?,
            b'{' => self.read_object(&mut text, limits)?,
            _ => return Err(text.invalid("expected a list or an object")),
        }
        match text.skip_space() {
            Some(_) => Err(text.invalid(
                "the text goes on after its first value; JSON with a value on each line is not read: put all of them into \
                 one list, [..]",
            )),
            None => Ok(()),
        }
    }

    /// Adds a list.
    fn add(&mut self, name: String, limits: &Limits) -> Result<&mut JsonList> {
        limits.check_attributes(FORMAT, self.lists.len() + 1, "names")?;
        let index = self.lists.len();
        self.lists.push(JsonList::new(name));
        Ok(&mut self.lists[index])
    }

    fn read_object(&mut self, text: &mut JsonText, limits: &Limits) -> Result<()> {
        let mut has_more = text.opens(b'}')?;
        while has_more {
            let at = text.at;
            let name = text.key()?.into_owned();
            let is_unnamed = name.eq_ignore_ascii_case("particles");
            let is_same = |list: &JsonList| list.name == name || is_unnamed && list.name.is_empty();
            if self.lists.iter().any(is_same) || is_unnamed && self.has_records {
                return Err(text.invalid_at(at, format!("the name `{}` appears twice", excerpt(name))));
            }
            match text.peek("a value")? {
                b'[' if is_unnamed => self.read_unnamed(text, limits)?,
                b'[' => self.add(name, limits)?.read_or_skip(text, JsonList::read_particles)?,
                _ => {
                    text.skip_value()?;
                    self.add(name, limits)?.skip("it is not a list".into());
                }
            }
            has_more = text.continues(b'}')?;
        }
        Ok(())
    }

    /// Reads a list without a name, of positions or of records.
    fn read_unnamed(&mut self, text: &mut JsonText, limits: &Limits) -> Result<()> {
        if text.follows(b"[{") {
            self.has_records = true;
            return self.read_records(text, limits);
        }
        self.add(String::new(), limits)?.read_particles(text)
    }

    /// Reads a list of objects with the same names.
    fn read_records(&mut self, text: &mut JsonText, limits: &Limits) -> Result<()> {
        let start = self.lists.len();
        let mut record_count = 0;
        let mut has_more = text.opens(b']')?;
        while has_more {
            let record_at = text.at;
            let mut expected = start;
            let mut has_values = text.opens(b'}')?;
            while has_values {
                let at = text.at;
                let name = text.key()?;
                // Most records have the same order.
                let mut order = (expected..self.lists.len()).chain(start..expected);
                let index = order.find(|&index| self.lists[index].name == name);
                expected = index.unwrap_or(expected) + 1;
                let list = match index {
                    Some(index) => &mut self.lists[index],
                    None if record_count == 0 => self.add(name.into_owned(), limits)?,
                    None => {
                        let what = format!("the first record has no `{}`", excerpt(&*name));
                        return Err(text.invalid_at(at, what));
                    }
                };
                list.record_count += 1;
                list.read_or_skip(text, JsonList::read_particle)?;
                has_values = text.continues(b'}')?;
            }
            record_count += 1;
            if let Some(list) = self.lists[start..].iter().find(|list| list.record_count != record_count) {
                let what = format!("expected `{}` once in each record", excerpt(&list.name));
                return Err(text.invalid_at(record_at, what));
            }
            has_more = text.continues(b']')?;
        }
        Ok(())
    }

    /// The lists with one number per particle, by index.
    fn singles(&self) -> Vec<usize> {
        (0..self.lists.len()).filter(|&index| self.lists[index].arity == 1).collect()
    }

    /// These lists as columns.
    fn columns(&self) -> Columns {
        let name = |index: usize| (&*self.lists[index].name, ());
        group_columns(&self.singles().into_iter().map(name).collect::<Vec<_>>())
    }

    /// See [`looks_like_particles`]. If the text `is_cut`, the last list is incomplete.
    fn have_positions(&self, is_cut: bool) -> bool {
        let is_position =
            |list: &JsonList| list.is_vector_position() || list.is_flat_position() && list.values.len() > 3;
        // The positions may follow a long list of another quantity, or y and z may follow x.
        let may_follow = |last: &JsonList| {
            let is_known = position_rank(&last.name).is_some() || role_of(&last.name, last.arity).is_some();
            is_cut && is_known && last.values.len() > LONG_LIST
        };
        !(self.has_records && self.lists.iter().any(|list| list.fault.is_some()))
            && (self.lists.iter().any(is_position)
                || self.columns().position.is_some()
                || self.lists.last().is_some_and(may_follow))
    }

    fn into_frame(mut self) -> Result<ParticleFrame> {
        let skipped = self.lists.extract_if(.., |list| list.fault.is_some());
        let note =
            |list: JsonList| format!("skipped `{}`: {}", excerpt(&list.name), list.fault.unwrap_or_default());
        let mut notes: Vec<String> = skipped.map(note).collect();
        notes.extend(self.split_flat());
        let no_positions = no_positions(&self.lists, &notes);
        self.join_columns();
        let mut arrays: Vec<NamedArray> = self.lists.into_iter().map(array_of).collect();
        let unnamed = arrays.iter().position(|array| array.name.is_empty()).map(|index| arrays.remove(index));
        let first = unnamed.map(unnamed_frame).transpose().map_err(|error| error.with_format(FORMAT))?;
        let (positions, others) =
            first.map(|first| (first.positions, (first.attributes, first.notes))).unzip();
        let mut frame = frame_of(positions, arrays).ok_or(no_positions)?;
        let (attributes, more) = others.unwrap_or_default();
        frame.attributes.extend(attributes);
        frame.notes.extend(more.into_iter().chain(notes));
        Ok(frame)
    }

    /// If the only positions are a flat list, splits it and the lists of other vectors.
    fn split_flat(&mut self) -> Option<String> {
        let has_other =
            self.lists.iter().any(JsonList::is_vector_position) || self.columns().position.is_some();
        let can_split = |list: &&JsonList| list.is_flat_position() && list.values.len().is_multiple_of(3);
        let flat = self.lists.iter().filter(|list| !has_other && can_split(list));
        let position = flat.min_by_key(|list| position_rank(&list.name))?;
        let (count, name) = (position.values.len() / 3, excerpt(&position.name));
        for list in self.lists.iter_mut().filter(|list| list.arity == 1) {
            list.arity = (1..=4).find(|arity| arity * count == list.values.len()).unwrap_or(1);
        }
        Some(format!("each three numbers of `{name}` are a position"))
    }

    /// Joins the lists of the components of a vector. Those that have only integers may be reals, too.
    fn join_columns(&mut self) {
        let singles = self.singles();
        for group in self.columns().groups.into_iter().filter(|group| group.arity() > 1) {
            let members: Vec<usize> = group.columns.iter().map(|&column| singles[column]).collect();
            if members.iter().any(|&index| matches!(self.lists[index].values, Values::F64(_))) {
                members.iter().for_each(|&index| self.lists[index].widen());
            }
            let values: Vec<&Values> = members.iter().map(|&index| &self.lists[index].values).collect();
            if let Some(values) = interleaved(&values) {
                members.iter().for_each(|&index| self.lists[index].skip(String::new()));
                let list = JsonList { arity: members.len(), values, ..JsonList::new(group.name) };
                self.lists[members[0]] = list;
            }
        }
        self.lists.retain(|list| list.fault.is_none());
    }
}

fn array_of(JsonList { name, arity, values, .. }: JsonList) -> NamedArray {
    let values = match values {
        Values::I64(integers) => of_integers(integers, role_of(&name, arity)),
        values => values,
    };
    // An empty list fits any number of values.
    NamedArray { name, arity: if arity == 0 { 3 } else { arity }, values }
}

fn no_positions(lists: &[JsonList], notes: &[String]) -> Error {
    let names = excerpts(lists.iter().map(|list| &list.name));
    let what = "no positions: expected [[x, y, z], ..], records with x, y and z, or an object with a list \
                `positions` or with lists x, y and z; found the lists: ";
    let what = [&[format!("{what}{names}")], notes.get(..1).unwrap_or_default()].concat().join("; ");
    Error::invalid(FORMAT, Position::File, what)
}

/// The most numbers of a particle without names.
const ROW_MAX: usize = 32;

/// More numbers than a setting has.
const LONG_LIST: usize = 64;

/// A JSON text, read from start to end.
struct JsonText<'a> {
    bytes: &'a [u8],
    at: usize,
}

impl<'a> JsonText<'a> {
    fn invalid(&self, what: impl Into<String>) -> Error {
        self.invalid_at(self.at, what)
    }

    fn invalid_at(&self, at: usize, what: impl Into<String>) -> Error {
        Error::invalid(FORMAT, Position::Offset(at as u64), what)
    }

    fn cut(&self, expected: &str) -> Error {
        let what = format!("the file ends where {expected} was expected");
        Error::truncated(FORMAT, Position::Offset(self.bytes.len() as u64), what)
    }

    /// Goes to the next byte that is not white space.
    fn skip_space(&mut self) -> Option<u8> {
        let rest = self.bytes.get(self.at..).unwrap_or_default();
        self.at += rest.iter().take_while(|byte| byte.is_ascii_whitespace()).count();
        self.bytes.get(self.at).copied()
    }

    /// As `skip_space`; `expected` is named in the error at the end of the text.
    fn peek(&mut self, expected: &str) -> Result<u8> {
        self.skip_space().ok_or_else(|| self.cut(expected))
    }

    /// Whether these bytes are next, with or without white space between them.
    fn follows(&self, bytes: &[u8]) -> bool {
        let mut ahead = JsonText { bytes: self.bytes, at: self.at };
        bytes.iter().all(|byte| {
            let is_next = ahead.skip_space() == Some(*byte);
            ahead.at += 1;
            is_next
        })
    }

    fn take(&mut self, expected: u8) -> Result<()> {
        let shown = char::from(expected);
        match self.skip_space() {
            Some(found) if found == expected => {
                self.at += 1;
                Ok(())
            }
            Some(_) => Err(self.invalid(format!("expected `{shown}`, found `{}`", self.shown()))),
            None => Err(self.cut(&format!("`{shown}`"))),
        }
    }

    /// Goes into a list or an object; returns whether it has a value.
    fn opens(&mut self, end: u8) -> Result<bool> {
        self.take(if end == b']' { b'[' } else { b'{' })?;
        let has_value = self.peek("a value")? != end;
        self.at += usize::from(!has_value);
        Ok(has_value)
    }

    /// Goes on after a value of a list or an object; returns whether there is another.
    fn continues(&mut self, end: u8) -> Result<bool> {
        let found = self.peek("`,` or the end of the list")?;
        if found != b',' && found != end {
            let end = char::from(end);
            return Err(self.invalid(format!("expected `,` or `{end}`, found `{}`", self.shown())));
        }
        self.at += 1;
        if found == b',' {
            self.peek("a value")?;
        }
        Ok(found == b',')
    }

    /// The next bytes, for a message.
    fn shown(&self) -> String {
        let rest = self.bytes.get(self.at..).unwrap_or_default();
        excerpt(rest.split(u8::is_ascii_whitespace).next().unwrap_or_default())
    }

    /// A name and the colon after it.
    fn key(&mut self) -> Result<Cow<'a, str>> {
        let start = self.at;
        self.take(b'"')?;
        self.skip_string()?;
        let quoted = &self.bytes[start..self.at];
        let name = if quoted.contains(&b'\\') {
            let invalid = |_| self.invalid_at(start, "expected a name in quotes");
            Cow::Owned(serde_json::from_slice(quoted).map_err(invalid)?)
        } else {
            String::from_utf8_lossy(&quoted[1..quoted.len() - 1])
        };
        // The empty name is that of positions without one.
        let name = if name.is_empty() { Cow::Borrowed("_") } else { name };
        self.take(b':')?;
        self.peek("a value")?;
        Ok(name)
    }

    /// Goes to the end of a string, from the byte after its first quote.
    fn skip_string(&mut self) -> Result<()> {
        loop {
            let rest = self.bytes.get(self.at..).unwrap_or_default();
            let Some(length) = rest.iter().position(|byte| matches!(byte, b'"' | b'\\')) else {
                return Err(self.cut("the end of a string"));
            };
            let is_escape = rest[length] == b'\\';
            self.at += length + 1 + usize::from(is_escape);
            if !is_escape {
                return Ok(());
            }
        }
    }

    /// A word up to the next delimiter; empty if there is none.
    fn word(&mut self) -> Result<&'a [u8]> {
        let rest = self.bytes.get(self.at..).unwrap_or_default();
        let is_part = |byte: &u8| byte.is_ascii_alphanumeric() || b"+-._".contains(byte);
        let Some(length) = rest.iter().position(|byte| !is_part(byte)) else {
            return Err(self.cut("the end of a number"));
        };
        self.at += length;
        Ok(&rest[..length])
    }

    fn number(&mut self) -> Result<JsonNumber> {
        self.peek("a number")?;
        let at = self.at;
        let word = self.word()?;
        let integer = || std::str::from_utf8(word).ok()?.parse().ok();
        match word {
            b"null" => Ok(JsonNumber::Real(f64::NAN)),
            b"true" => Ok(JsonNumber::Integer(1)),
            b"false" => Ok(JsonNumber::Integer(0)),
            _ => match integer() {
                Some(integer) => Ok(JsonNumber::Integer(integer)),
                None => fast_float2::parse(word).map(JsonNumber::Real).map_err(|_| {
                    self.at = at;
                    self.invalid(format!("expected a number, found `{}`", self.shown()))
                }),
            },
        }
    }

    /// Goes to the end of any value. Does not check what is between its brackets.
    fn skip_value(&mut self) -> Result<()> {
        let mut depth = 0usize;
        loop {
            match self.peek("the end of a value")? {
                b'[' | b'{' => depth += 1,
                b']' | b'}' if depth > 0 => depth -= 1,
                b'"' => {
                    self.at += 1;
                    self.skip_string()?;
                    self.at -= 1; // its last quote
                }
                b',' | b':' if depth > 0 => {}
                _ => {
                    let at = self.at;
                    if self.word()?.is_empty() {
                        let what = format!("expected a value, found `{}`", self.shown());
                        return Err(self.invalid_at(at, what));
                    }
                    self.at -= 1;
                }
            }
            self.at += 1;
            if depth == 0 {
                return Ok(());
            }
        }
    }
}

/// The row in the table of formats.
pub(crate) static ROW: FormatRow =
    FormatRow { particles: Some(ParticleReader::needs_reading(read)), ..FormatRow::new(FORMAT, &["json"]) };
