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
//! numbers that are not finite. Everything else is skipped with a note: single values, texts and objects. The
//! text is read once, from start to end, and only its numbers are kept. Numbers are 64-bit floats, correctly
//! rounded, or integers.

use std::borrow::Cow;

use crate::columns::{group_columns, of_integers, position_rank, role_of};
use crate::data::{ParticleFrame, Values};
use crate::error::{Error, Position, Result};
use crate::limits::Limits;
use crate::named_arrays::{NamedArray, frame_of};
use crate::npy::unnamed_frame;
use crate::row::{FormatRow, ParticleReader};
use crate::text::{excerpt, excerpts, line_number};

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
    let name_limit = limits.attribute_count;
    lists.parse(bytes, name_limit).map_err(|fault| {
        let position = match line_number(bytes, fault.at) {
            1 => Position::Offset(fault.at as u64),
            line => Position::Line(line),
        };
        match fault.kind {
            JsonFaultKind::Cut => Error::truncated(FORMAT, position, fault.what),
            JsonFaultKind::Invalid => Error::invalid(FORMAT, position, fault.what),
            JsonFaultKind::TooLarge => Error::too_large(FORMAT, fault.what),
        }
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
    match lists.parse(head, Limits::default().attribute_count) {
        Ok(()) => lists.has_positions(false),
        Err(fault) => fault.kind == JsonFaultKind::Cut && lists.has_positions(true),
    }
}

/// What is wrong with a text, and where.
struct JsonFault {
    kind: JsonFaultKind,
    at: usize,
    what: String,
}

#[derive(Clone, Copy, PartialEq)]
enum JsonFaultKind {
    /// The text ends too early.
    Cut,
    Invalid,
    TooLarge,
}

type Parsed<T> = std::result::Result<T, JsonFault>;

/// A number of a text.
enum JsonNumber {
    Integer(i64),
    Real(f64),
}

/// Numbers of a text: integers up to the first other number.
enum JsonNumbers {
    Integers(Vec<i64>),
    Reals(Vec<f64>),
}

impl JsonNumbers {
    fn push(&mut self, number: JsonNumber) {
        match (&mut *self, number) {
            (JsonNumbers::Integers(integers), JsonNumber::Integer(integer)) => integers.push(integer),
            (JsonNumbers::Reals(reals), JsonNumber::Real(real)) => reals.push(real),
            (JsonNumbers::Reals(reals), JsonNumber::Integer(integer)) => reals.push(integer as f64),
            (JsonNumbers::Integers(_), JsonNumber::Real(real)) => {
                self.widen();
                self.push(JsonNumber::Real(real));
            }
        }
    }

    fn widen(&mut self) {
        if let JsonNumbers::Integers(integers) = self {
            let reals = std::mem::take(integers).into_iter().map(|integer| integer as f64).collect();
            *self = JsonNumbers::Reals(reals);
        }
    }

    fn len(&self) -> usize {
        match self {
            JsonNumbers::Integers(integers) => integers.len(),
            JsonNumbers::Reals(reals) => reals.len(),
        }
    }
}

/// The values of one name.
struct JsonList {
    /// Empty for positions without a name.
    name: String,
    /// The number of values per particle; 0 until it is known.
    arity: usize,
    numbers: JsonNumbers,
    /// The number of records with this name.
    record_count: usize,
    /// Why the values are skipped.
    fault: Option<String>,
}

impl JsonList {
    fn new(name: String, fault: Option<String>) -> JsonList {
        JsonList { name, arity: 0, numbers: JsonNumbers::Integers(Vec::new()), record_count: 0, fault }
    }

    fn skip(&mut self, fault: String) {
        *self = JsonList {
            record_count: self.record_count,
            ..JsonList::new(std::mem::take(&mut self.name), Some(fault))
        };
    }

    /// Reads the numbers of a particle: a number, or a list of as many as the particles before have.
    fn read_particle(&mut self, text: &mut JsonText) -> Parsed<()> {
        let at = text.at;
        let before = self.numbers.len();
        if text.peek("a number")? == b'[' {
            let mut has_more = text.opens(b']')?;
            while has_more {
                self.numbers.push(text.number()?);
                has_more = text.continues(b']')?;
            }
        } else {
            self.numbers.push(text.number()?);
        }
        let found = self.numbers.len() - before;
        if found == 0 || before != 0 && found != self.arity {
            let expected = if found == 0 { 3 } else { self.arity };
            return Err(text.invalid_at(at, format!("expected {expected} numbers, found {found}")));
        }
        self.arity = found;
        Ok(())
    }

    /// Whether this is a position in a list without inner lists. `x`, `r` and `p` alone have other meanings.
    fn is_flat_position(&self) -> bool {
        self.arity == 1 && self.name.len() > 1 && position_rank(&self.name).is_some()
    }

    fn is_vector_position(&self) -> bool {
        self.fault.is_none()
            && self.arity == 3
            && (self.name.is_empty() || position_rank(&self.name).is_some())
    }
}

/// All lists of a text.
#[derive(Default)]
struct JsonLists {
    lists: Vec<JsonList>,
    /// Whether the particles are records.
    has_records: bool,
    name_limit: usize,
}

impl JsonLists {
    /// Reads a text. After an error, the lists contain what was read before it.
    fn parse(&mut self, bytes: &[u8], name_limit: usize) -> Parsed<()> {
        self.name_limit = name_limit;
        let mut text = JsonText { bytes, at: if bytes.starts_with(b"\xef\xbb\xbf") { 3 } else { 0 } };
        match text.peek("a list or an object")? {
            b'[' => self.read_list(&mut text, None)?,
            b'{' => self.read_object(&mut text)?,
            _ => return Err(text.invalid("expected a list or an object")),
        }
        match text.skip_space() {
            Some(_) => Err(text.invalid("expected the end of the file")),
            None => Ok(()),
        }
    }

    /// Adds a list; returns its index.
    fn add(&mut self, text: &JsonText, list: JsonList) -> Parsed<usize> {
        if self.lists.len() >= self.name_limit {
            let what = format!("the file has more names than the limit of {}", self.name_limit);
            return Err(JsonFault { kind: JsonFaultKind::TooLarge, at: text.at, what });
        }
        self.lists.push(list);
        Ok(self.lists.len() - 1)
    }

    fn read_object(&mut self, text: &mut JsonText) -> Parsed<()> {
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
                b'[' if is_unnamed => self.read_list(text, None)?,
                b'[' => {
                    let (start, count) = (text.at, self.lists.len());
                    let is_position = position_rank(&name).is_some();
                    match self.read_list(text, Some(name)) {
                        Err(JsonFault { kind: JsonFaultKind::Invalid, at, what }) if !is_position => {
                            text.at = start;
                            text.skip_value()?;
                            self.lists.truncate(count + 1);
                            self.lists[count].skip(format!("at byte {at}: {what}"));
                        }
                        outcome => outcome?,
                    }
                }
                first => {
                    text.skip_value()?;
                    let what = if first == b'{' { "it is an object" } else { "it is a single value" };
                    self.add(text, JsonList::new(name, Some(what.into())))?;
                }
            }
            has_more = text.continues(b'}')?;
        }
        Ok(())
    }

    /// Reads a list of numbers, of lists of numbers or, without a name, of records.
    fn read_list(&mut self, text: &mut JsonText, name: Option<String>) -> Parsed<()> {
        let is_unnamed = name.is_none();
        if is_unnamed && text.follows(b"[{") {
            return self.read_records(text);
        }
        let index = self.add(text, JsonList::new(name.unwrap_or_default(), None))?;
        let list = &mut self.lists[index];
        let mut has_more = text.opens(b']')?;
        while has_more {
            if is_unnamed && list.arity == 0 && text.follows(b"[[") {
                return Err(text.invalid("this list has several frames: save each as a file"));
            }
            if is_unnamed && text.peek("a position")? != b'[' {
                return Err(
                    text.invalid("expected positions: a list [x, y, z] or an object for each particle")
                );
            }
            let at = text.at;
            list.read_particle(text)?;
            if is_unnamed && !(3..=ROW_MAX).contains(&list.arity) {
                let what = format!("expected three numbers, [x, y, z], found {}", list.arity);
                return Err(text.invalid_at(at, what));
            }
            has_more = text.continues(b']')?;
        }
        Ok(())
    }

    /// Reads a list of objects with the same names.
    fn read_records(&mut self, text: &mut JsonText) -> Parsed<()> {
        self.has_records = true;
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
                let mut all = expected..self.lists.len();
                let index = all
                    .find(|&index| self.lists[index].name == name)
                    .or_else(|| (start..expected).find(|&index| self.lists[index].name == name));
                let index = match index {
                    Some(index) => index,
                    None if record_count == 0 => self.add(text, JsonList::new(name.into_owned(), None))?,
                    None => {
                        let what = format!("the first record has no `{}`", excerpt(&*name));
                        return Err(text.invalid_at(at, what));
                    }
                };
                self.read_record_value(text, index)?;
                expected = index + 1;
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

    fn read_record_value(&mut self, text: &mut JsonText, index: usize) -> Parsed<()> {
        let list = &mut self.lists[index];
        list.record_count += 1;
        let start = text.at;
        if list.fault.is_none() {
            match list.read_particle(text) {
                Err(JsonFault { kind: JsonFaultKind::Invalid, at, what }) => {
                    list.skip(format!("at byte {at}: {what}"));
                    text.at = start;
                }
                outcome => return outcome,
            }
        }
        text.skip_value()
    }

    /// The names of the lists with one number per particle.
    fn singles(&self) -> Vec<(&str, ())> {
        let singles = self.lists.iter().filter(|list| list.fault.is_none() && list.arity == 1);
        singles.map(|list| (&*list.name, ())).collect()
    }

    /// See [`looks_like_particles`]. If the text `is_cut`, the last list is incomplete.
    fn has_positions(&self, is_cut: bool) -> bool {
        if self.has_records && self.lists.iter().any(|list| list.fault.is_some()) {
            return false;
        }
        let is_position =
            |list: &JsonList| list.is_vector_position() || list.is_flat_position() && list.numbers.len() > 3;
        if self.lists.iter().any(is_position) || group_columns(&self.singles()).position.is_some() {
            return true;
        }
        // The positions may follow a long list of another quantity, or y and z may follow x.
        let Some(last) = self.lists.last().filter(|list| is_cut && list.numbers.len() > LONG_LIST) else {
            return false;
        };
        let mut stem = last.name.chars();
        stem.next_back();
        let columns = ["x", "y", "z"].map(|end| format!("{}{end}", stem.as_str()));
        let columns = columns.each_ref().map(|name| (&**name, ()));
        let is_axis = last.arity == 1 && columns.iter().any(|(name, ())| *name == last.name);
        role_of(&last.name, last.arity).is_some() || is_axis && group_columns(&columns).position.is_some()
    }

    fn into_frame(mut self) -> Result<ParticleFrame> {
        let skipped = self.lists.extract_if(.., |list| list.fault.is_some());
        let note =
            |list: JsonList| format!("skipped `{}`: {}", excerpt(&list.name), list.fault.unwrap_or_default());
        let mut notes: Vec<String> = skipped.map(note).collect();
        notes.extend(self.split_flat());
        let found: Vec<String> = self.lists.iter().map(|list| list.name.clone()).collect();
        let mut arrays = self.into_arrays();
        let unnamed = arrays.iter().position(|array| array.name.is_empty()).map(|index| arrays.remove(index));
        let mut frame = match unnamed {
            Some(array) => {
                let first = unnamed_frame(array).map_err(|error| error.with_format(FORMAT))?;
                let mut frame = frame_of(Some(first.positions), arrays).unwrap_or_default();
                frame.attributes.extend(first.attributes);
                notes.extend(first.notes);
                frame
            }
            None => frame_of(None, arrays).ok_or_else(|| no_positions(&found, &notes))?,
        };
        frame.notes.extend(notes);
        Ok(frame)
    }

    /// If the only positions are a flat list, splits it and the lists of other vectors.
    fn split_flat(&mut self) -> Option<String> {
        let has_other = self.lists.iter().any(JsonList::is_vector_position)
            || group_columns(&self.singles()).position.is_some();
        let can_split = |list: &&JsonList| list.is_flat_position() && list.numbers.len().is_multiple_of(3);
        let flat = self.lists.iter().filter(|list| !has_other && can_split(list));
        let position = flat.min_by_key(|list| position_rank(&list.name))?;
        let (count, name) = (position.numbers.len() / 3, excerpt(&position.name));
        for list in self.lists.iter_mut().filter(|list| list.arity == 1) {
            let arities = [1, 2, 3, 4];
            list.arity = arities.into_iter().find(|arity| arity * count == list.numbers.len()).unwrap_or(1);
        }
        Some(format!("each three numbers of `{name}` are a position"))
    }

    /// The lists as arrays. If all values of an attribute are integers, its role decides their type; columns
    /// that belong together get one type.
    fn into_arrays(mut self) -> Vec<NamedArray> {
        let names = self.singles();
        let groups = group_columns(&names);
        let mut roles: Vec<_> = self.lists.iter().map(|list| role_of(&list.name, list.arity)).collect();
        let singles: Vec<usize> =
            (0..self.lists.len()).filter(|&index| self.lists[index].arity == 1).collect();
        let mut mixed = Vec::new();
        for group in groups.groups {
            let members = || group.columns.iter().map(|&column| singles[column]);
            members().for_each(|index| roles[index] = group.role);
            if members().any(|index| matches!(self.lists[index].numbers, JsonNumbers::Reals(_))) {
                mixed.extend(members());
            }
        }
        mixed.into_iter().for_each(|index| self.lists[index].numbers.widen());
        let array = |(list, role): (JsonList, _)| {
            let values = match list.numbers {
                JsonNumbers::Integers(integers) => of_integers(integers, role),
                JsonNumbers::Reals(reals) => Values::F64(reals),
            };
            // An empty list fits any number of values.
            let arity = if list.arity == 0 { 3 } else { list.arity };
            NamedArray { name: list.name, arity, values }
        };
        self.lists.into_iter().zip(roles).map(array).collect()
    }
}

/// The most numbers of a particle without names.
const ROW_MAX: usize = 32;

/// More numbers than a setting has.
const LONG_LIST: usize = 64;

fn no_positions(found: &[String], notes: &[String]) -> Error {
    let mut what =
        "no positions: expected [[x, y, z], ..], records with x, y and z, or an object with a list \
                    `positions` or with the lists x, y and z"
            .to_owned();
    if !found.is_empty() {
        what += &format!("; found the lists {}", excerpts(found));
    }
    if let Some(note) = notes.first() {
        what += &format!("; {note}");
    }
    Error::invalid(FORMAT, Position::File, what)
}

/// A JSON text, read from start to end.
struct JsonText<'a> {
    bytes: &'a [u8],
    at: usize,
}

impl<'a> JsonText<'a> {
    fn invalid(&self, what: impl Into<String>) -> JsonFault {
        self.invalid_at(self.at, what)
    }

    fn invalid_at(&self, at: usize, what: impl Into<String>) -> JsonFault {
        JsonFault { kind: JsonFaultKind::Invalid, at, what: what.into() }
    }

    fn cut(&self, expected: &str) -> JsonFault {
        let what = format!("the file ends where {expected} was expected");
        JsonFault { kind: JsonFaultKind::Cut, at: self.bytes.len(), what }
    }

    /// Goes to the next byte that is not white space.
    fn skip_space(&mut self) -> Option<u8> {
        let rest = self.bytes.get(self.at..).unwrap_or_default();
        self.at += rest.iter().take_while(|byte| byte.is_ascii_whitespace()).count();
        self.bytes.get(self.at).copied()
    }

    /// As `skip_space`; `expected` is named in the error at the end of the text.
    fn peek(&mut self, expected: &str) -> Parsed<u8> {
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

    fn take(&mut self, expected: u8) -> Parsed<()> {
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
    fn opens(&mut self, end: u8) -> Parsed<bool> {
        self.take(if end == b']' { b'[' } else { b'{' })?;
        let has_value = self.peek("a value")? != end;
        self.at += usize::from(!has_value);
        Ok(has_value)
    }

    /// Goes on after a value of a list or an object; returns whether there is another.
    fn continues(&mut self, end: u8) -> Parsed<bool> {
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
        excerpt(
            self.bytes
                .get(self.at..)
                .unwrap_or_default()
                .split(u8::is_ascii_whitespace)
                .next()
                .unwrap_or_default(),
        )
    }

    /// A name and the colon after it.
    fn key(&mut self) -> Parsed<Cow<'a, str>> {
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
    fn skip_string(&mut self) -> Parsed<()> {
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
    fn word(&mut self) -> Parsed<&'a [u8]> {
        let rest = self.bytes.get(self.at..).unwrap_or_default();
        let is_part = |byte: &u8| byte.is_ascii_alphanumeric() || b"+-._".contains(byte);
        let Some(length) = rest.iter().position(|byte| !is_part(byte)) else {
            return Err(self.cut("the end of a number"));
        };
        self.at += length;
        Ok(&rest[..length])
    }

    fn number(&mut self) -> Parsed<JsonNumber> {
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
    fn skip_value(&mut self) -> Parsed<()> {
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
                        return Err(
                            self.invalid_at(at, format!("expected a value, found `{}`", self.shown()))
                        );
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
