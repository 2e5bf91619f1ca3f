//! Reads a point attribute: its name and its values.

use std::borrow::Cow;

use crate::data::{FilePositions, Values};
use crate::error::{Error, Result};
use crate::limits::Limits;
use crate::named_arrays::NamedArray;
use crate::number::{self, components, divided};

use super::FORMAT;
use super::token::{JsonToken, text_count_max};
use super::tokens::TokenWalk;
use super::values::tuples;

/// A point attribute, or the reason for skipping it.
pub(super) enum PointAttribute {
    Read(NamedArray),
    LeftOut { name: String, kind: String },
}

/// Reads the definition and the body of an attribute: a list whose start the caller has consumed.
pub(super) fn point_attribute(walk: &mut TokenWalk, count: usize, limits: &Limits) -> Result<PointAttribute> {
    let (mut name, mut kind) = (String::new(), String::new());
    walk.object("definition", |walk, key| {
        match key {
            "name" => name = short_text(walk)?,
            "type" => kind = short_text(walk)?,
            _ => walk.skip()?,
        }
        Ok(())
    })?;
    let attribute = match kind.as_str() {
        "numeric" => walk.within(&name.clone(), |walk| numeric(walk, name, count, limits))?,
        "string" => walk.within(&name.clone(), |walk| strings(walk, name, count, limits))?,
        _ => {
            walk.skip()?;
            PointAttribute::LeftOut { name, kind }
        }
    };
    loop {
        match walk.next()? {
            JsonToken::Close => return Ok(attribute),
            token => walk.skip_rest(&token)?,
        }
    }
}

/// Maximum length in bytes of the name or type of an attribute. The binary form stores a repeated string
/// once, as a word: without this limit, many attributes could each copy the same long word.
const NAME_BYTES_MAX: usize = 1024;

pub(super) fn short_text(walk: &mut TokenWalk) -> Result<String> {
    let text = walk.text()?;
    match text.len() <= NAME_BYTES_MAX {
        true => Ok(text.into_owned()),
        false => Err(Error::too_large(
            FORMAT,
            format!("a name has {} bytes, more than the limit of {NAME_BYTES_MAX} bytes", text.len()),
        )),
    }
}

fn numeric(walk: &mut TokenWalk, name: String, count: usize, limits: &Limits) -> Result<PointAttribute> {
    let mut found = None;
    walk.object("body", |walk, key| match key {
        "values" => {
            found = Some(tuples(walk, key, count, limits)?);
            Ok(())
        }
        _ => walk.skip(),
    })?;
    let found = found.ok_or_else(|| walk.invalid("the attribute has no values"))?;
    Ok(PointAttribute::Read(NamedArray { name, arity: found.size, values: found.values }))
}

fn strings(walk: &mut TokenWalk, name: String, count: usize, limits: &Limits) -> Result<PointAttribute> {
    let mut table: Vec<String> = Vec::new();
    let mut found = None;
    walk.object("body", |walk, key| {
        match key {
            "strings" => table = texts(walk)?,
            "indices" => found = Some(tuples(walk, key, count, limits)?),
            _ => walk.skip()?,
        }
        Ok(())
    })?;
    let found = found.ok_or_else(|| walk.invalid("the attribute has no indices"))?;
    let indices = match found.values {
        Values::I32(indices) => indices,
        Values::I64(indices) => indices.into_iter().map(|index| i32::try_from(index).unwrap_or(-1)).collect(),
        Values::U8(indices) => indices.into_iter().map(i32::from).collect(),
        _ => return Err(walk.invalid("the indices are not integers")),
    };
    Ok(PointAttribute::Read(NamedArray {
        name,
        arity: found.size,
        values: Values::Strings { table, indices },
    }))
}

/// Reads the next value as a list of strings.
fn texts(walk: &mut TokenWalk) -> Result<Vec<String>> {
    let mut texts = Vec::new();
    let token = walk.next()?;
    if let JsonToken::Texts(found) = token {
        check_texts(walk, &found)?;
        return Ok(found.into_iter().map(|text| text.into_owned()).collect());
    }
    if token != JsonToken::Open {
        return Err(walk.unexpected("a list of strings", &token));
    }
    loop {
        let most = text_count_max(walk.file_bytes());
        if texts.len() > most {
            return Err(Error::too_large(
                FORMAT,
                format!("a list has {} or more strings, more than the limit of {most}", texts.len()),
            ));
        }
        match walk.next()? {
            JsonToken::Close => return Ok(texts),
            JsonToken::Text(text) => {
                check_texts(walk, std::slice::from_ref(&text))?;
                texts.push(text.into_owned());
            }
            JsonToken::Texts(found) => {
                check_texts(walk, &found)?;
                texts.extend(found.into_iter().map(|text| text.into_owned()));
            }
            other => return Err(walk.unexpected("a string", &other)),
        }
    }
}

/// Fails if the strings need too much memory: in the binary form, many strings can refer to the same word.
fn check_texts(walk: &mut TokenWalk, texts: &[Cow<str>]) -> Result<()> {
    walk.check_widened(texts.iter().map(|text| size_of::<String>() + text.len()).sum())
}

/// Converts the attribute `P` to positions. Of four floats per point, the fourth divides the first three.
pub(super) fn positions(array: NamedArray) -> Option<FilePositions> {
    match (array.arity, array.values) {
        (3, values) => number::positions(values),
        (4, Values::F32(values)) => {
            Some(FilePositions::F32(values.as_chunks::<4>().0.iter().copied().map(divided).collect()))
        }
        (4, Values::F64(values)) => {
            Some(FilePositions::F64(values.as_chunks::<4>().0.iter().copied().map(divided).collect()))
        }
        (4, values) => number::positions(components(&values, 4, 0..3)),
        _ => None,
    }
}
