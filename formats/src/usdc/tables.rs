//! Builds the tables of a layer: its tokens, paths and fields.
//!
//! ```text
//!   spec       path │ first field in the sets │ type     one per prim and property
//!   field sets field, field, .., end │ field, ..
//!   field      name │ value
//! ```

use std::collections::HashMap;

use crate::error::Result;

use super::array::{append_compressed, append_lz4, index};
use super::contents::{SECTIONS, append_contents};
use super::value::{ValueRep, ValueType};

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
/// sibling (it has no child), or neither (it has no child and no sibling).
pub(super) const JUMP_CHILD: i32 = -1;
pub(super) const JUMP_SIBLING: i32 = 0;
pub(super) const JUMP_END: i32 = -2;

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
