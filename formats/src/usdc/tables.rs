//! Builds the tables of a layer: its tokens, paths and fields.
//!
//! ```text
//!   spec       path │ first field in the sets │ type     one per prim and property
//!   field sets field, field, .., end │ field, ..
//!   field      name │ value
//! ```

use std::collections::HashMap;

use super::array::{append_compressed, append_lz4, index};
use super::read::{Source, count, unexpected};
use crate::bytes::Cursor;
use crate::error::{Error, Position, Result};
use crate::row::ReadPiece;
use crate::usd::FORMAT;

/// What a spec describes, by its code in the format.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub(super) enum SpecType {
    Attribute = 1,
    Prim = 6,
    PseudoRoot = 7,
}

/// Marks the end of a field set.
const SET_END: u32 = u32::MAX;

/// The jumps of a path, which say what follows it in the list: its first child (it has no sibling), its
/// sibling (it has no child), or neither (it has no child and no sibling).
const JUMP_CHILD: i32 = -1;
const JUMP_SIBLING: i32 = 0;
const JUMP_END: i32 = -2;

/// The tables under construction.
#[derive(Default)]
pub(super) struct Tables {
    tokens: Vec<String>,
    token_places: HashMap<String, u32>,
    /// The token of each string.
    strings: Vec<u32>,
    string_places: HashMap<u32, u32>,
    fields: Vec<(u32, ValueRep)>,
    field_places: HashMap<(u32, ValueRep), u32>,
    field_sets: Vec<u32>,
    /// For each path: the name of its last element, its type, and the index of its first field in the sets.
    specs: Vec<(u32, SpecType, u32)>,
}

impl Tables {
    /// The index of a token, which is added if it is new.
    #[expect(clippy::cast_possible_truncation, reason = "a layer has far fewer than 2³² tokens")]
    pub(super) fn token(&mut self, word: &str) -> u32 {
        // Tokens end with NUL in the file, so no token may contain NUL.
        let word = word.replace('\0', "\\x00");
        let next = self.tokens.len() as u32;
        *self.token_places.entry(word).or_insert_with_key(|word| {
            self.tokens.push(word.clone());
            next
        })
    }

    /// The index of a string, which is added if it is new.
    #[expect(clippy::cast_possible_truncation, reason = "a layer has far fewer than 2³² strings")]
    pub(super) fn string(&mut self, text: &str) -> u32 {
        let token = self.token(text);
        let next = self.strings.len() as u32;
        *self.string_places.entry(token).or_insert_with(|| {
            self.strings.push(token);
            next
        })
    }

    /// The representation of a token.
    pub(super) fn token_value(&mut self, word: &str) -> ValueRep {
        ValueRep::inlined(ValueType::Token, self.token(word))
    }

    /// Adds the next path, with its fields. The first path is the root of the layer, the next ones are the
    /// prims, each a child of the one before, and the others are properties of the last prim.
    #[expect(clippy::cast_possible_truncation, reason = "a layer has far fewer than 2³² fields")]
    pub(super) fn add_spec(&mut self, name: &str, kind: SpecType, fields: &[(&str, ValueRep)]) {
        let first = self.field_sets.len() as u32;
        for &(field, value) in fields {
            let key = (self.token(field), value);
            let next = self.fields.len() as u32;
            let index = *self.field_places.entry(key).or_insert_with(|| {
                self.fields.push(key);
                next
            });
            self.field_sets.push(index);
        }
        self.field_sets.push(SET_END);
        let name = self.token(name);
        self.specs.push((name, kind, first));
    }

    /// Appends the sections and the table of contents to bytes that start at `base`; returns the offset of
    /// the table of contents.
    ///
    /// # Errors
    ///
    /// [`crate::Error::TooLarge`] if the tables exceed the format's limits.
    pub(super) fn append(&self, base: u64, out: &mut Vec<u8>) -> Result<u64> {
        let mut ranges = [(0, 0); SECTIONS.len()];
        type Append = fn(&Tables, &mut Vec<u8>) -> Result<()>;
        let appends: [Append; SECTIONS.len()] = [
            Tables::append_tokens,
            Tables::append_strings,
            Tables::append_fields,
            Tables::append_field_sets,
            Tables::append_paths,
            Tables::append_specs,
        ];
        for (range, append) in ranges.iter_mut().zip(appends) {
            let start = out.len() as u64;
            append(self, out)?;
            *range = (base + start, out.len() as u64 - start);
        }
        let contents_at = base + out.len() as u64;
        append_contents(ranges, out);
        Ok(contents_at)
    }

    fn append_tokens(&self, out: &mut Vec<u8>) -> Result<()> {
        let text: String = self.tokens.iter().flat_map(|token| [token.as_str(), "\0"]).collect();
        append_count(self.tokens.len(), out);
        append_count(text.len(), out);
        append_lz4(text.as_bytes(), out)
    }

    fn append_strings(&self, out: &mut Vec<u8>) -> Result<()> {
        append_count(self.strings.len(), out);
        self.strings.iter().for_each(|token| out.extend_from_slice(&token.to_le_bytes()));
        Ok(())
    }

    fn append_fields(&self, out: &mut Vec<u8>) -> Result<()> {
        append_count(self.fields.len(), out);
        append_compressed(self.fields.iter().map(|(name, _)| name.cast_signed()), out)?;
        let values: Vec<u8> = self.fields.iter().flat_map(|(_, value)| value.0.to_le_bytes()).collect();
        append_lz4(&values, out)
    }

    fn append_field_sets(&self, out: &mut Vec<u8>) -> Result<()> {
        append_count(self.field_sets.len(), out);
        append_compressed(self.field_sets.iter().map(|field| field.cast_signed()), out)
    }

    fn append_paths(&self, out: &mut Vec<u8>) -> Result<()> {
        let count = index(self.specs.len())?;
        append_count(self.specs.len(), out);
        append_count(self.specs.len(), out); // the number of encoded paths: all of them
        append_compressed(0..count, out)?;
        // The token index is negative for the name of a property, so token 0 must not be such a name.
        let name = |&(name, kind, _): &(u32, SpecType, u32)| match kind {
            SpecType::Attribute => name.cast_signed().wrapping_neg(),
            SpecType::Prim | SpecType::PseudoRoot => name.cast_signed(),
        };
        append_compressed(self.specs.iter().map(name), out)?;
        let jump = |index: usize| match self.specs[index].1 {
            _ if index + 1 == self.specs.len() => JUMP_END,
            SpecType::Attribute => JUMP_SIBLING,
            SpecType::Prim | SpecType::PseudoRoot => JUMP_CHILD,
        };
        append_compressed((0..self.specs.len()).map(jump), out)
    }

    fn append_specs(&self, out: &mut Vec<u8>) -> Result<()> {
        append_count(self.specs.len(), out);
        append_compressed(0..index(self.specs.len())?, out)?;
        append_compressed(self.specs.iter().map(|(_, _, fields)| fields.cast_signed()), out)?;
        append_compressed(self.specs.iter().map(|(_, kind, _)| *kind as i32), out)
    }
}

pub(super) fn append_count(count: usize, out: &mut Vec<u8>) {
    out.extend_from_slice(&(count as u64).to_le_bytes());
}

// Value representations: 64 bits with the type of a value, and the value or its offset in the file.
//
//   63        62        61           55..48   47..0
//   array     inlined   compressed   type     the value, if inlined; else its offset

/// The types of values that this crate writes, by their codes in the format.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub(super) enum ValueType {
    Bool = 1,
    Int = 3,
    Int64 = 5,
    Float = 8,
    Double = 9,
    String = 10,
    Token = 11,
    Vec2f = 20,
    Vec2i = 22,
    Vec3d = 23,
    Vec3f = 24,
    Vec3i = 26,
    Vec4f = 28,
    Vec4i = 30,
    Dictionary = 31,
    TokenVector = 41,
    Specifier = 42,
    Variability = 44,
    TimeSamples = 46,
    DoubleVector = 48,
}

/// A value or a reference to it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(super) struct ValueRep(pub(super) u64);

const ARRAY: u64 = 1 << 63;
const INLINED: u64 = 1 << 62;
const COMPRESSED: u64 = 1 << 61;
/// All flags, including the one for edits of arrays, which this crate does not write.
const FLAGS: u64 = 0xff << 56;
const PAYLOAD: u64 = (1 << 48) - 1;

impl ValueRep {
    /// An inlined value of 32 bits.
    pub(super) fn inlined(kind: ValueType, value: u32) -> ValueRep {
        ValueRep(INLINED | Self::code(kind) | u64::from(value))
    }

    /// A value at an offset.
    pub(super) fn at(kind: ValueType, offset: u64) -> ValueRep {
        ValueRep(Self::code(kind) | offset & PAYLOAD)
    }

    /// An array at an offset; offset 0 is the empty array.
    pub(super) fn array(kind: ValueType, offset: u64, is_compressed: bool) -> ValueRep {
        let compressed = if is_compressed { COMPRESSED } else { 0 };
        ValueRep(ARRAY | compressed | Self::code(kind) | offset & PAYLOAD)
    }

    fn code(kind: ValueType) -> u64 {
        u64::from(kind as u8) << 48
    }

    /// The inlined value, if it is inlined and of this type.
    #[expect(clippy::cast_possible_truncation, reason = "inlined values have 32 bits")]
    pub(super) fn value(self, kind: ValueType) -> Option<u32> {
        (self.0 & !PAYLOAD == INLINED | Self::code(kind)).then_some((self.0 & PAYLOAD) as u32)
    }

    /// The offset of the value, if it is of this type and not inlined.
    pub(super) fn offset(self, kind: ValueType) -> Option<u64> {
        (self.0 & !PAYLOAD == Self::code(kind)).then_some(self.0 & PAYLOAD)
    }

    /// The offset of an array of this type, and whether it is compressed.
    pub(super) fn array_offset(self, kind: ValueType) -> Option<(u64, bool)> {
        let flags = self.0 & FLAGS;
        let is_array = flags & !COMPRESSED == ARRAY && self.0 & (0xff << 48) == Self::code(kind);
        is_array.then_some((self.0 & PAYLOAD, flags & COMPRESSED != 0))
    }
}

// The bootstrap at the start of a file, and the table of contents at its end.

/// The first bytes of every file in Crate, the binary format of USD.
pub(super) const MAGIC: &[u8] = b"PXR-USDC";

/// The version of the format that the writer uses. OpenUSD reads it since v19.11 (2019).
const VERSION: [u8; 3] = [0, 8, 0];

/// The size of the bootstrap.
pub(super) const BOOTSTRAP_BYTES: usize = 88;

/// The offset, within the bootstrap, of the field that holds the offset of the table of contents.
pub(super) const CONTENTS_AT: usize = 16;

/// The sections, in the order of the file.
const SECTIONS: [&str; 6] = ["TOKENS", "STRINGS", "FIELDS", "FIELDSETS", "PATHS", "SPECS"];

const NAME_BYTES: usize = 16;
const ENTRY_BYTES: usize = NAME_BYTES + 16;

/// The size of our table of contents.
pub(super) const TABLE_BYTES: usize = 8 + SECTIONS.len() * ENTRY_BYTES;

/// The bootstrap of a file whose table of contents is at this offset.
pub(super) fn bootstrap(contents_at: u64) -> [u8; BOOTSTRAP_BYTES] {
    let mut bytes = [0; BOOTSTRAP_BYTES];
    bytes[..MAGIC.len()].copy_from_slice(MAGIC);
    bytes[MAGIC.len()..][..VERSION.len()].copy_from_slice(&VERSION);
    bytes[CONTENTS_AT..CONTENTS_AT + 8].copy_from_slice(&contents_at.to_le_bytes());
    bytes
}

/// Appends the table of contents: the offset and size of each section.
fn append_contents(sections: [(u64, u64); SECTIONS.len()], out: &mut Vec<u8>) {
    out.extend_from_slice(&(SECTIONS.len() as u64).to_le_bytes());
    for (name, (start, size)) in SECTIONS.into_iter().zip(sections) {
        let mut field = [0; NAME_BYTES];
        field[..name.len()].copy_from_slice(name.as_bytes());
        out.extend_from_slice(&field);
        out.extend_from_slice(&start.to_le_bytes());
        out.extend_from_slice(&size.to_le_bytes());
    }
}

/// Fails unless a file starts like binary USD.
pub(super) fn check_magic(head: &[u8]) -> Result<()> {
    if head.starts_with(MAGIC) {
        Ok(())
    } else {
        Err(Error::invalid(FORMAT, Position::Offset(0), "expected PXR-USDC"))
    }
}

/// The offset of the table of contents, according to the bootstrap.
pub(super) fn contents_at(head: &[u8]) -> Result<u64> {
    check_magic(head)?;
    let Some(bootstrap) = head.first_chunk::<BOOTSTRAP_BYTES>() else {
        return Err(Error::truncated(FORMAT, Position::Offset(0), "expected a bootstrap of 88 bytes"));
    };
    let [_, _, _, _, _, _, _, _, major, minor, patch, ..] = *bootstrap;
    if [major, minor, patch] != VERSION {
        let what = format!("this is version {major}.{minor}.{patch} of binary USD: {NOT_OURS}");
        return Err(Error::unsupported(FORMAT, what));
    }
    let mut offset = [0; 8];
    offset.copy_from_slice(&bootstrap[CONTENTS_AT..CONTENTS_AT + 8]);
    Ok(u64::from_le_bytes(offset))
}

/// Fails unless the table of contents can be at this offset of a file with `file_bytes` bytes. The offset
/// is 0 until a file is complete.
pub(super) fn check_contents_at(at: u64, file_bytes: u64) -> Result<()> {
    if at == 0 || at > file_bytes {
        let what = format!("the table of contents at {at} is missing: the file is not complete");
        return Err(Error::truncated(FORMAT, Position::Offset(CONTENTS_AT as u64), what));
    }
    Ok(())
}

pub(super) const NOT_OURS: &str = "binary USD is read only as meniscus writes it: give a file of meniscus, or save the mesh as .ply or .obj";

/// The offset and size of each section, from a table of contents with all sections in our order.
pub(super) fn read_contents(table: &[u8], at: u64) -> Result<[(u64, u64); SECTIONS.len()]> {
    let position = Position::Offset(at);
    let Some(table) = table.first_chunk::<TABLE_BYTES>() else {
        let what = format!("expected a table of contents of {TABLE_BYTES} bytes, found {}", table.len());
        return Err(Error::truncated(FORMAT, position, what));
    };
    let (count, entries) = table.split_at(8);
    if count != (SECTIONS.len() as u64).to_le_bytes() {
        return Err(Error::unsupported(FORMAT, format!("this file has unknown sections: {NOT_OURS}")));
    }
    let mut found = [(0, 0); SECTIONS.len()];
    for (index, entry) in entries.as_chunks::<ENTRY_BYTES>().0.iter().enumerate() {
        let (name, range) = entry.split_at(NAME_BYTES);
        let name = String::from_utf8_lossy(name);
        if name.trim_end_matches('\0') != SECTIONS[index] {
            return Err(Error::unsupported(FORMAT, format!("this file has unknown sections: {NOT_OURS}")));
        }
        let [start, size] = [0, 8].map(|at| {
            let mut number = [0; 8];
            number.copy_from_slice(&range[at..at + 8]);
            u64::from_le_bytes(number)
        });
        if start < BOOTSTRAP_BYTES as u64 || start.checked_add(size).is_none_or(|end| end > at) {
            let what = format!(
                "section {} has {size} bytes from {start}; expected it between the bootstrap and this table",
                SECTIONS[index]
            );
            return Err(Error::invalid(FORMAT, position, what));
        }
        found[index] = (start, size);
    }
    Ok(found)
}

/// The size that a file of our writer has when it is complete: it ends with its table of contents. `None` if
/// the bootstrap is incomplete, or the table is missing, incomplete or invalid.
pub(super) fn claimed_bytes(head: &[u8], read: &mut ReadPiece) -> Result<Option<u64>> {
    let Some(head) = head.first_chunk::<BOOTSTRAP_BYTES>() else { return Ok(None) };
    let at = contents_at(head)?;
    let is_complete = read_contents(&read(at, TABLE_BYTES as u64)?, at).is_ok();
    Ok(is_complete.then(|| at + TABLE_BYTES as u64))
}

// Reads the tables of a layer.

/// The tokens, strings, prims and properties of a layer.
pub(super) struct LayerTables {
    tokens: Vec<String>,
    strings: Vec<u32>,
    pub(super) specs: Vec<Spec>,
}

/// A prim or a property.
pub(super) struct Spec {
    pub(super) name: String,
    pub(super) kind: i32,
    fields: Vec<(String, ValueRep)>,
}

impl Spec {
    /// The value of a field.
    pub(super) fn field(&self, name: &str) -> Option<ValueRep> {
        self.fields.iter().find(|(field, _)| field == name).map(|(_, value)| *value)
    }
}

impl LayerTables {
    /// Reads all tables.
    ///
    /// # Errors
    ///
    /// [`Error::Truncated`] if the file is truncated; [`Error::Unsupported`] if another program wrote it;
    /// [`Error::Invalid`] if it is damaged; [`Error::TooLarge`] if it exceeds the limits.
    pub(super) fn read(source: &Source) -> Result<LayerTables> {
        let at = contents_at(source.bytes)?;
        check_contents_at(at, source.bytes.len() as u64)?;
        let mut contents = source.at(at)?;
        let rest = contents.take(contents.remaining(), "contents")?;
        LayerTables::in_sections(source, &read_contents(rest, at)?)
    }

    /// Reads the tables in these sections, given by their offsets and sizes.
    ///
    /// # Errors
    ///
    /// As [`LayerTables::read`].
    pub(super) fn in_sections(
        source: &Source,
        sections: &[(u64, u64); SECTIONS.len()],
    ) -> Result<LayerTables> {
        let section = |index: usize| source.at(sections[index].0);
        let tokens = read_tokens(source, section(0)?)?;
        let strings = read_strings(source, section(1)?)?;
        let fields = read_fields(source, section(2)?, &tokens)?;
        let sets = read_field_sets(source, section(3)?)?;
        let names = read_paths(source, section(4)?, &tokens)?;
        let specs = read_specs(source, section(5)?, (names, &fields, &sets))?;
        Ok(LayerTables { tokens, strings, specs })
    }

    /// The token with this index.
    pub(super) fn token(&self, index: u32) -> Option<&str> {
        self.tokens.get(index as usize).map(String::as_str)
    }

    /// The string with this index.
    pub(super) fn string(&self, index: u32) -> Option<&str> {
        self.token(*self.strings.get(index as usize)?)
    }

    /// The token in a value of this type.
    pub(super) fn word(&self, value: Option<ValueRep>, what: &str) -> Result<&str> {
        value.and_then(|value| self.token(value.value(ValueType::Token)?)).ok_or_else(|| unexpected(what))
    }

    /// The entries of a dictionary.
    pub(super) fn dictionary(&self, source: &Source, value: ValueRep) -> Result<Vec<(&str, ValueRep)>> {
        let what = "entries of a dictionary";
        let offset = value.offset(ValueType::Dictionary).ok_or_else(|| unexpected(what))?;
        let mut cursor = source.at(offset)?;
        let mut entries = Vec::new();
        for _ in 0..count(&mut cursor, what)? {
            let at = cursor.clone();
            let key = cursor.u32(what)?;
            let key = self.string(key).ok_or_else(|| at.invalid(format!("there is no string {key}")))?;
            source.claim(1, size_of::<(&str, ValueRep)>())?;
            entries.push((key, value_here(&mut cursor, what)?));
        }
        Ok(entries)
    }
}

/// Reads an offset, which must lead to the bytes just after it, and the value there.
pub(super) fn value_here(cursor: &mut Cursor, what: &str) -> Result<ValueRep> {
    no_gap(cursor, what)?;
    Ok(ValueRep(cursor.u64(what)?))
}

/// Skips an offset, which must lead to the bytes just after it.
pub(super) fn no_gap(cursor: &mut Cursor, what: &str) -> Result<()> {
    match cursor.i64(what)? {
        8 => Ok(()),
        _ => Err(Error::unsupported(FORMAT, format!("this file has nested {what}: {NOT_OURS}"))),
    }
}

fn read_tokens(source: &Source, mut cursor: Cursor) -> Result<Vec<String>> {
    let at = cursor.clone();
    let token_count = count(&mut cursor, "tokens")?;
    let byte_count = count(&mut cursor, "bytes of tokens")?;
    let text = source.lz4(&mut cursor, byte_count, "tokens")?;
    let text = String::from_utf8(text).map_err(|_| at.invalid("the tokens are not UTF-8"))?;
    source.claim(text.bytes().filter(|&byte| byte == 0).count(), size_of::<String>())?;
    let words = text.strip_suffix('\0').map(|text| text.split('\0').map(str::to_owned).collect::<Vec<_>>());
    words
        .filter(|words| words.len() == token_count)
        .ok_or_else(|| at.invalid(format!("expected {token_count} tokens")))
}

fn read_strings(source: &Source, mut cursor: Cursor) -> Result<Vec<u32>> {
    let string_count = count(&mut cursor, SECTIONS[1])?;
    let bytes = cursor.take(string_count.saturating_mul(4), "strings")?;
    source.claim(bytes.len(), 1)?;
    Ok(bytes.as_chunks().0.iter().map(|bytes| u32::from_le_bytes(*bytes)).collect())
}

fn read_fields(source: &Source, mut cursor: Cursor, tokens: &[String]) -> Result<Vec<(String, ValueRep)>> {
    let at = cursor.clone();
    let field_count = count(&mut cursor, "fields")?;
    let names: Vec<i32> = source.integers(&mut cursor, field_count, "names of fields")?;
    let values = source.lz4(&mut cursor, field_count.saturating_mul(8), "values of fields")?;
    let values = values.as_chunks().0;
    if values.len() != field_count {
        return Err(
            at.invalid(format!("expected the values of {field_count} fields, found {}", values.len()))
        );
    }
    let mut fields = Vec::new();
    for (name, value) in names.into_iter().zip(values) {
        let name = word(tokens, name.cast_unsigned(), &at)?;
        source.claim(name.len() + size_of::<(String, ValueRep)>(), 1)?;
        fields.push((name.to_owned(), ValueRep(u64::from_le_bytes(*value))));
    }
    Ok(fields)
}

fn word<'a>(tokens: &'a [String], index: u32, at: &Cursor) -> Result<&'a str> {
    let word = tokens.get(index as usize);
    word.map(String::as_str).ok_or_else(|| at.invalid(format!("there is no token {index}")))
}

fn read_field_sets(source: &Source, mut cursor: Cursor) -> Result<Vec<u32>> {
    let set_count = count(&mut cursor, "field sets")?;
    let sets: Vec<i32> = source.integers(&mut cursor, set_count, "field sets")?;
    Ok(sets.into_iter().map(i32::cast_unsigned).collect())
}

/// The last name of each path: of the layer, of the prims, each a child of the one before, and of the
/// properties.
fn read_paths(source: &Source, mut cursor: Cursor, tokens: &[String]) -> Result<Vec<String>> {
    let at = cursor.clone();
    let path_count = count(&mut cursor, "paths")?;
    let encoded_count = count(&mut cursor, "paths")?;
    let indices: Vec<i32> = source.integers(&mut cursor, path_count, "paths")?;
    let names: Vec<i32> = source.integers(&mut cursor, path_count, "names of paths")?;
    let jumps: Vec<i32> = source.integers(&mut cursor, path_count, "jumps of paths")?;
    let is_last = |index: usize| index + 1 == path_count;
    let is_ours = |index: usize| {
        let jump = match names[index] {
            _ if is_last(index) => JUMP_END,
            0.. => JUMP_CHILD,
            _ => JUMP_SIBLING,
        };
        i32::try_from(index) == Ok(indices[index]) && jumps[index] == jump
    };
    if encoded_count != path_count || !(0..path_count).all(is_ours) {
        return Err(Error::unsupported(
            FORMAT,
            format!("this file has prims other than one mesh: {NOT_OURS}"),
        ));
    }
    let mut found = Vec::new();
    for name in names {
        let name = word(tokens, name.unsigned_abs(), &at)?;
        source.claim(name.len() + size_of::<String>(), 1)?;
        found.push(name.to_owned());
    }
    Ok(found)
}

/// The name, the type and the fields of each path.
fn read_specs(
    source: &Source,
    mut cursor: Cursor,
    (names, fields, sets): (Vec<String>, &[(String, ValueRep)], &[u32]),
) -> Result<Vec<Spec>> {
    let at = cursor.clone();
    let spec_count = count(&mut cursor, "specs")?;
    if spec_count != names.len() {
        return Err(at.invalid(format!("{spec_count} specs for {} paths", names.len())));
    }
    let paths: Vec<i32> = source.integers(&mut cursor, spec_count, "paths of specs")?;
    let firsts: Vec<i32> = source.integers(&mut cursor, spec_count, "fields of specs")?;
    let kinds: Vec<i32> = source.integers(&mut cursor, spec_count, "types of specs")?;
    let mut specs = Vec::new();
    for (index, (name, kind)) in names.into_iter().zip(kinds).enumerate() {
        let first = usize::try_from(firsts[index]).ok();
        let set = first.and_then(|first| sets.get(first..));
        let (true, Some(set)) = (i32::try_from(index) == Ok(paths[index]), set) else {
            return Err(at.invalid(format!("the path or the fields of spec {index} are invalid")));
        };
        let mut found = Vec::new();
        for &field in set.iter().take_while(|&&field| field != SET_END) {
            let missing = || at.invalid(format!("there is no field {field}"));
            let field = fields.get(field as usize).ok_or_else(missing)?;
            source.claim(field.0.len() + size_of::<(String, ValueRep)>(), 1)?;
            found.push(field.clone());
        }
        source.claim(1, size_of::<Spec>())?;
        specs.push(Spec { name, kind, fields: found });
    }
    let expected = [SpecType::PseudoRoot, SpecType::Prim, SpecType::Prim].map(|kind| kind as i32);
    let kinds = specs.iter().take(3).map(|spec| spec.kind);
    if kinds.eq(expected) {
        Ok(specs)
    } else {
        Err(Error::unsupported(FORMAT, format!("this file has prims other than one mesh: {NOT_OURS}")))
    }
}
