//! The tables of a layer: its tokens, paths and fields. Builds them, and reads what locates them.
//!
//! ```text
//!   spec       path │ first field in the sets │ type     one per prim and property
//!   field sets field, field, .., end │ field, ..
//!   field      name │ value
//! ```

use std::collections::HashMap;

use super::array::{append_compressed, append_lz4, index};
use crate::core::error::{Error, Position, Result};
use crate::core::row::ReadPiece;
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
pub(super) const SET_END: u32 = u32::MAX;

/// The jumps of a path, which say what follows it in the list: its first child (it has no sibling), its
/// sibling (it has no child), or neither (it has no child and no sibling). For a path with both, the jump is the number
/// of paths to its sibling, after its children.
pub(super) const JUMP_CHILD: i32 = -1;
pub(super) const JUMP_SIBLING: i32 = 0;
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

    /// Adds the next path, with its fields. The first path is the root of the layer, the second one the root prim, and the
    /// third one its child. The others are the properties of this.
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
        let mut jumps = Vec::new();
        for (at, (_, kind, _)) in self.specs.iter().enumerate() {
            jumps.push(match kind {
                _ if at + 1 == self.specs.len() => JUMP_END,
                SpecType::Attribute => JUMP_SIBLING,
                SpecType::Prim | SpecType::PseudoRoot => JUMP_CHILD,
            });
        }
        append_compressed(jumps.into_iter(), out)
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
//   63      62        61           60     55..48   47..0
//   array   inlined   compressed   edit   type     the value, if inlined; else its offset

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
const EDIT: u64 = 1 << 60;
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

    /// The code of the type.
    pub(super) fn type_code(self) -> u8 {
        self.0.to_le_bytes()[6]
    }

    /// The value if it is inlined, else its offset; 48 bits.
    pub(super) fn payload(self) -> u64 {
        self.0 & PAYLOAD
    }

    pub(super) fn is_array(self) -> bool {
        self.0 & ARRAY != 0
    }

    pub(super) fn is_inlined(self) -> bool {
        self.0 & INLINED != 0
    }

    pub(super) fn is_compressed(self) -> bool {
        self.0 & COMPRESSED != 0
    }

    /// Whether it is an edit of the array in weaker layers.
    pub(super) fn is_edit(self) -> bool {
        self.0 & EDIT != 0
    }
}

// The bootstrap at the start of a file, and the table of contents at its end.

/// The first bytes of every file in Crate, the binary format of USD.
pub(super) const MAGIC: &[u8] = b"PXR-USDC";

/// The version of the format that the writer uses. OpenUSD reads it since v19.11 (2019).
const VERSION: [u8; 3] = [0, 8, 0];

/// The versions that are read. Before 0.4, the tables are not compressed.
const VERSION_MIN: [u8; 3] = [0, 4, 0];
const VERSION_MAX: [u8; 3] = [0, 13, u8::MAX];

/// The size of the bootstrap.
pub(super) const BOOTSTRAP_BYTES: usize = 88;

/// The offset, within the bootstrap, of the field that holds the offset of the table of contents.
const CONTENTS_AT: usize = 16;

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

/// The offset of the table of contents, according to the bootstrap, and the version of the format.
pub(super) fn contents_at(head: &[u8]) -> Result<(u64, [u8; 3])> {
    check_magic(head)?;
    let Some(bootstrap) = head.first_chunk::<BOOTSTRAP_BYTES>() else {
        return Err(Error::truncated(FORMAT, Position::Offset(0), "expected a bootstrap of 88 bytes"));
    };
    let [_, _, _, _, _, _, _, _, major, minor, patch, ..] = *bootstrap;
    let version = [major, minor, patch];
    if !(VERSION_MIN..=VERSION_MAX).contains(&version) {
        let what = format!(
            "this is version {major}.{minor}.{patch} of binary USD, and versions 0.4 to 0.13 are read: convert it with \
             usdcat to .usda"
        );
        return Err(Error::unsupported(FORMAT, what));
    }
    let mut offset = [0; 8];
    offset.copy_from_slice(&bootstrap[CONTENTS_AT..CONTENTS_AT + 8]);
    Ok((u64::from_le_bytes(offset), version))
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

/// The offset and size of each section, from the bytes of a table of contents.
pub(super) fn read_contents(table: &[u8], at: u64) -> Result<[(u64, u64); SECTIONS.len()]> {
    let position = Position::Offset(at);
    let mut found = [None; SECTIONS.len()];
    let entries = table.split_first_chunk().and_then(|(count, entries)| {
        let count = usize::try_from(u64::from_le_bytes(*count)).ok()?;
        entries.as_chunks::<ENTRY_BYTES>().0.get(..count)
    });
    let entries = entries
        .ok_or_else(|| Error::truncated(FORMAT, position, "the file ends within its table of contents"))?;
    for entry in entries {
        let (name, range) = entry.split_at(NAME_BYTES);
        let name = name.split(|&byte| byte == 0).next().unwrap_or_default();
        let Some(index) = SECTIONS.iter().position(|section| section.as_bytes() == name) else { continue };
        let &[start, size] = range.as_chunks().0 else { continue };
        let [start, size] = [start, size].map(u64::from_le_bytes);
        if start < BOOTSTRAP_BYTES as u64 || start.checked_add(size).is_none_or(|end| end > at) {
            let what = format!(
                "section {} has {size} bytes from {start}; expected it between the bootstrap and this table",
                SECTIONS[index]
            );
            return Err(Error::invalid(FORMAT, position, what));
        }
        found[index] = Some((start, size));
    }
    match found.iter().position(Option::is_none) {
        Some(index) => {
            Err(Error::invalid(FORMAT, position, format!("the section {} is missing", SECTIONS[index])))
        }
        None => Ok(found.map(Option::unwrap_or_default)),
    }
}

/// The size that a file of our writer has when it is complete: it ends with its table of contents. `None` if
/// the bootstrap is incomplete, or the table is missing, incomplete or invalid.
pub(super) fn claimed_bytes(head: &[u8], read: &mut ReadPiece) -> Result<Option<u64>> {
    let Some(head) = head.first_chunk::<BOOTSTRAP_BYTES>() else { return Ok(None) };
    let (at, _) = contents_at(head)?;
    let is_complete = read_contents(&read(at, TABLE_BYTES as u64)?, at).is_ok();
    Ok(is_complete.then(|| at + TABLE_BYTES as u64))
}
