//! Reads the tables of a layer.

use crate::bytes::Cursor;
use crate::error::{Error, Result};
use crate::usd::FORMAT;

use super::contents::{NOT_OURS, SECTIONS, check_contents_at, contents_at, read_contents};
use super::read_array::{Source, count, unexpected};
use super::tables::{JUMP_CHILD, JUMP_END, JUMP_SIBLING, SET_END, SpecType};
use super::value::{ValueRep, ValueType};

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
            let key = u32::from_le_bytes(cursor.array(what)?);
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
    Ok(ValueRep(u64::from_le_bytes(cursor.array(what)?)))
}

/// Skips an offset, which must lead to the bytes just after it.
pub(super) fn no_gap(cursor: &mut Cursor, what: &str) -> Result<()> {
    match i64::from_le_bytes(cursor.array(what)?) {
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
    match kinds.eq(expected) {
        true => Ok(specs),
        false => {
            Err(Error::unsupported(FORMAT, format!("this file has prims other than one mesh: {NOT_OURS}")))
        }
    }
}
