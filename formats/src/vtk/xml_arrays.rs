//! Decodes `DataArray` elements.

use crate::bytes::Endian;
use crate::data::Values;
use crate::error::{Error, Position, Result};
use crate::excerpt::excerpt;
use crate::limits::Limits;
use crate::number::{self, NumberType};
use crate::text::parse_number;

use super::XML;
use super::blocks::{ArrayEncoding, ArrayTotals, EncodedArray, decode};

/// An array as described by its element.
#[derive(Debug)]
pub(super) struct DataArray<'a> {
    pub(super) name: String,
    /// `None` if not numeric.
    pub(super) number: Option<NumberType>,
    pub(super) arity: usize,
    pub(super) form: ArrayForm,
    /// The content between the tags, and its offset; empty for appended data.
    pub(super) content: &'a [u8],
    pub(super) offset: u64,
}

/// The location and form of the values.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum ArrayForm {
    /// Decimals between the tags.
    Ascii,
    /// Base64 between the tags.
    Binary,
    /// In the appended data, at this offset in bytes.
    Appended(u64),
}

/// The content of the last element, `AppendedData`.
#[derive(Clone, Copy, Debug)]
pub(super) struct Appended<'a> {
    pub(super) bytes: &'a [u8],
    pub(super) is_base64: bool,
    pub(super) offset: u64,
}

impl DataArray<'_> {
    /// Decodes the values, `arity` for each of `count` points.
    pub(super) fn values(
        &self,
        number: NumberType,
        count: usize,
        encoding: ArrayEncoding,
        appended: Option<Appended>,
        totals: &mut ArrayTotals,
        limits: &Limits,
    ) -> Result<Values> {
        let expected = count.checked_mul(self.arity).ok_or_else(|| self.invalid("it has too many values"))?;
        let encoded = match self.form {
            ArrayForm::Ascii => return self.decimals(number, expected),
            ArrayForm::Binary => {
                let start = self.content.iter().take_while(|byte| byte.is_ascii_whitespace()).count();
                let bytes = self.content[start..].trim_ascii_end();
                EncodedArray { bytes, is_base64: true, offset: self.offset + start as u64 }
            }
            ArrayForm::Appended(start) => self.appended(start, appended)?,
        };
        // Remove line breaks from the base64 text.
        let without_spaces: Vec<u8>;
        let is_broken = self.form == ArrayForm::Binary && encoded.bytes.iter().any(u8::is_ascii_whitespace);
        let encoded = if is_broken {
            without_spaces =
                encoded.bytes.iter().copied().filter(|byte| !byte.is_ascii_whitespace()).collect();
            EncodedArray { bytes: &without_spaces, ..encoded }
        } else {
            encoded
        };
        let bytes = decode(encoded, encoding, &self.name, totals, limits)?;
        if bytes.len() != expected.saturating_mul(number.size()) {
            let what =
                format!("expected {expected} values of {} bytes, found {} bytes", number.size(), bytes.len());
            return Err(self.invalid(&what));
        }
        Ok(number.decode(&bytes, encoding.endian))
    }

    fn appended<'a>(&self, start: u64, appended: Option<Appended<'a>>) -> Result<EncodedArray<'a>> {
        let Some(Appended { bytes, is_base64, offset }) = appended else {
            return Err(self.invalid("its data should be appended, but the file has no appended data"));
        };
        let rest = usize::try_from(start).ok().and_then(|start| bytes.get(start..));
        let bytes = rest.ok_or_else(|| {
            self.invalid(&format!(
                "its data starts at byte {start}, but the appended data has only {} bytes",
                bytes.len()
            ))
        })?;
        Ok(EncodedArray { bytes, is_base64, offset: offset + start })
    }

    fn decimals(&self, number: NumberType, expected: usize) -> Result<Values> {
        let words = self.content.split(u8::is_ascii_whitespace).filter(|word| !word.is_empty());
        // Each number takes at least a digit and a separator.
        if expected > self.content.len().div_ceil(2) {
            let what = format!("expected {expected} values, found {} bytes of text", self.content.len());
            return Err(self.invalid(&what));
        }
        let values = decimals(words.clone(), number, expected).map_err(|word| {
            self.invalid(&format!("expected a value of its type, found `{}`", excerpt(word)))
        })?;
        let found = number::length(&values) + words.skip(expected).count();
        if found != expected {
            return Err(self.invalid(&format!("expected {expected} values, found {found}")));
        }
        Ok(values)
    }

    fn invalid(&self, what: &str) -> Error {
        Error::invalid(
            XML,
            Position::Offset(self.offset),
            format!("the array `{}`: {what}", excerpt(&self.name)),
        )
    }
}

/// Parses the first `count` words as values of the type that [`NumberType::decode`] returns. The error is the
/// beginning of the first invalid word.
pub(super) fn decimals<'a>(
    words: impl Iterator<Item = &'a [u8]>,
    number: NumberType,
    count: usize,
) -> std::result::Result<Values, Vec<u8>> {
    fn parse<'a, T>(
        words: impl Iterator<Item = &'a [u8]>,
        count: usize,
        parse: impl Fn(&'a [u8]) -> Option<T>,
    ) -> std::result::Result<Vec<T>, Vec<u8>> {
        let mut values = Vec::with_capacity(count);
        for word in words.take(count) {
            values.push(parse(word).ok_or_else(|| word[..word.len().min(24)].to_vec())?);
        }
        Ok(values)
    }
    fn real<T: fast_float2::FastFloat>(word: &[u8]) -> Option<T> {
        parse_number(word).filter(|(_, length)| *length == word.len()).map(|(value, _)| value)
    }
    fn integer<T: std::str::FromStr>(word: &[u8]) -> Option<T> {
        std::str::from_utf8(word).ok()?.parse().ok()
    }
    Ok(match number {
        NumberType::F16 | NumberType::F32 => Values::F32(parse(words, count, real)?),
        NumberType::F64 => Values::F64(parse(words, count, real)?),
        NumberType::Bool | NumberType::U8 => Values::U8(parse(words, count, integer)?),
        NumberType::I8 | NumberType::I16 | NumberType::U16 | NumberType::I32 => {
            Values::I32(parse(words, count, integer)?)
        }
        NumberType::U32 | NumberType::I64 => Values::I64(parse(words, count, integer)?),
        NumberType::U64 => {
            let integers: Vec<u64> = parse(words, count, integer)?;
            let bytes: Vec<u8> = integers.iter().flat_map(|value| value.to_le_bytes()).collect();
            NumberType::U64.decode(&bytes, Endian::Little)
        }
    })
}
