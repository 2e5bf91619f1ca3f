//! Reads tokens one after the other.
//!
//! [`TokenWalk`] does not keep the tokens that it has passed: skipped data costs no memory, regardless of its
//! depth and length.

use std::borrow::Cow;
use std::collections::HashMap;

use super::FORMAT;
use crate::core::bytes::{Cursor, Endian};
use crate::core::data::Values;
use crate::core::error::{Error, Position, Result};
use crate::core::limits::Limits;
use crate::core::number::NumberType;
use crate::core::text::excerpt;

/// A cursor over the tokens. It tracks its location for errors: the offset, and the keys on the path to it.
pub(super) struct TokenWalk<'a> {
    lexer: Lexer<'a>,
    path: Vec<String>,
    /// Total size of expanded constant pages (see [`super::values`]), in bytes.
    spread_bytes: u64,
    /// Total size in memory of items that take less space in the file, in bytes.
    widened_bytes: usize,
}

impl<'a> TokenWalk<'a> {
    pub(super) fn new(bytes: &'a [u8]) -> Result<TokenWalk<'a>> {
        Ok(TokenWalk { lexer: Lexer::new(bytes)?, path: Vec::new(), spread_bytes: 0, widened_bytes: 0 })
    }

    pub(super) fn file_bytes(&self) -> usize {
        self.lexer.file_bytes
    }

    /// Offset of the next token, in bytes from the start of the file.
    fn at(&self) -> usize {
        self.lexer.cursor.at()
    }

    /// Adds `bytes` of expanded constant pages to the total, and fails if the total is too large for the size
    /// of the file: constant pages are a form of compression.
    pub(super) fn check_spread(&mut self, bytes: u64, limits: &Limits) -> Result<()> {
        self.spread_bytes = self.spread_bytes.saturating_add(bytes);
        limits.check_decompressed(FORMAT, self.spread_bytes, self.file_bytes() as u64)
    }

    /// Adds `bytes` of memory for items that take less space in the file to the total, and fails if the total
    /// is too large for the size of the file. Valid files stay below: writers rarely store numbers narrower
    /// than declared.
    pub(super) fn check_widened(&mut self, bytes: usize) -> Result<()> {
        self.widened_bytes = self.widened_bytes.saturating_add(bytes);
        let most = widened_bytes_max(self.file_bytes());
        if self.widened_bytes <= most {
            Ok(())
        } else {
            Err(Error::too_large(FORMAT, format!("the arrays expand to more than the limit of {most} bytes")))
        }
    }

    /// Number of bytes that remain.
    pub(super) fn remaining(&self) -> usize {
        self.file_bytes() - self.at().min(self.file_bytes())
    }

    /// The next token; the end of the file is an error.
    pub(super) fn next(&mut self) -> Result<JsonToken<'a>> {
        match self.lexer.next()? {
            Some(token) => Ok(token),
            None => {
                let what = format!("{}: the file ends within the document", self.shown_path());
                Err(Error::truncated(FORMAT, Position::Offset(self.at() as u64), what))
            }
        }
    }

    /// Reads the next value, an array or a map of keys and values, up to its end. Calls `inside` with each
    /// key; `inside` must consume the value that follows.
    pub(super) fn object(
        &mut self,
        name: &str,
        mut inside: impl FnMut(&mut TokenWalk<'a>, &str) -> Result<()>,
    ) -> Result<()> {
        self.within(name, |walk| {
            walk.open()?;
            loop {
                match walk.next()? {
                    JsonToken::Close => return Ok(()),
                    JsonToken::Text(key) => inside(walk, &key)?,
                    other => return Err(walk.unexpected("a key", &other)),
                }
            }
        })
    }

    /// Iterates over the items of the next value, an array. Calls `inside` with the first token of each item;
    /// `inside` must consume the rest of the item.
    pub(super) fn items(
        &mut self,
        name: &str,
        mut inside: impl FnMut(&mut TokenWalk<'a>, JsonToken<'a>) -> Result<()>,
    ) -> Result<()> {
        self.within(name, |walk| {
            walk.open()?;
            loop {
                match walk.next()? {
                    JsonToken::Close => return Ok(()),
                    token => inside(walk, token)?,
                }
            }
        })
    }

    /// Calls `inside` with `name` appended to the path that errors show.
    pub(super) fn within<T>(
        &mut self,
        name: &str,
        inside: impl FnOnce(&mut TokenWalk<'a>) -> Result<T>,
    ) -> Result<T> {
        self.path.push(name.chars().take(40).collect());
        let result = inside(self);
        self.path.pop();
        result
    }

    fn open(&mut self) -> Result<()> {
        match self.next()? {
            JsonToken::Open => Ok(()),
            other => Err(self.unexpected("an array", &other)),
        }
    }

    /// Skips the next value.
    pub(super) fn skip(&mut self) -> Result<()> {
        let token = self.next()?;
        self.skip_rest(&token)
    }

    /// Skips the values up to the end of the array.
    pub(super) fn close(&mut self) -> Result<()> {
        loop {
            match self.next()? {
                JsonToken::Close => return Ok(()),
                token => self.skip_rest(&token)?,
            }
        }
    }

    /// Skips the rest of the value that starts with `token`.
    fn skip_rest(&mut self, token: &JsonToken) -> Result<()> {
        let mut depth = usize::from(*token == JsonToken::Open);
        if *token == JsonToken::Close {
            return Err(self.invalid("expected a value, found the end of an array"));
        }
        while depth != 0 {
            match self.next()? {
                JsonToken::Open => depth += 1,
                JsonToken::Close => depth -= 1,
                _ => {}
            }
        }
        Ok(())
    }

    /// Reads the next value as a string.
    pub(super) fn text(&mut self) -> Result<Cow<'a, str>> {
        match self.next()? {
            JsonToken::Text(text) => Ok(text),
            other => Err(self.unexpected("a string", &other)),
        }
    }

    /// Reads the next value as a count.
    pub(super) fn count(&mut self) -> Result<u64> {
        match self.next()? {
            JsonToken::Integer(count) if count >= 0 => Ok(count.unsigned_abs()),
            other => Err(self.unexpected("a count", &other)),
        }
    }

    /// Checks that nothing follows the document.
    pub(super) fn finish(&mut self) -> Result<()> {
        match self.lexer.next()? {
            None => Ok(()),
            Some(other) => Err(self.unexpected("the end of the file", &other)),
        }
    }

    pub(super) fn unexpected(&self, expected: &str, found: &JsonToken) -> Error {
        let found = match found {
            JsonToken::Open => "an array or a map".into(),
            JsonToken::Close => "the end of an array".into(),
            JsonToken::Null => "null".into(),
            JsonToken::Bool(value) => value.to_string(),
            JsonToken::Integer(value) => value.to_string(),
            JsonToken::Real(value) => value.to_string(),
            JsonToken::Text(text) => format!("\"{}\"", excerpt(&**text)),
            JsonToken::Numbers { .. } => "an array of numbers".into(),
            JsonToken::Bools(_) => "an array of booleans".into(),
            JsonToken::Texts(_) => "an array of strings".into(),
        };
        self.invalid(format!("expected {expected}, found {found}"))
    }

    pub(super) fn invalid(&self, what: impl AsRef<str>) -> Error {
        let what = format!("{}: {}", self.shown_path(), what.as_ref());
        Error::invalid(FORMAT, Position::Offset(self.at() as u64), what)
    }

    fn shown_path(&self) -> String {
        match self.path.join("/").trim_start_matches('/') {
            "" => "the document".into(),
            path => path.split('/').map(excerpt).collect::<Vec<_>>().join("/"),
        }
    }
}

// A token of JSON, and limits of the memory that tokens may take.

/// A token of JSON. Commas and colons carry no information and are not tokens.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum JsonToken<'a> {
    /// The start of an array or map.
    Open,
    Close,
    Null,
    Bool(bool),
    Integer(i64),
    Real(f64),
    Text(Cow<'a, str>),
    /// A uniform array of numbers.
    Numbers {
        number: NumberType,
        endian: Endian,
        payload: &'a [u8],
    },
    /// A uniform array of booleans.
    Bools(Vec<bool>),
    /// A uniform array of strings.
    Texts(Vec<Cow<'a, str>>),
}

/// The maximum number of strings in a list, for a file of this size. Even an empty string takes some dozens
/// of bytes of memory.
pub(super) fn text_count_max(file_bytes: usize) -> usize {
    (1 << 16) + file_bytes / 16
}

/// The maximum size in memory, in bytes, of items that take less space in the file; for a file of this size.
fn widened_bytes_max(file_bytes: usize) -> usize {
    (16 << 20) + 2 * file_bytes
}

// The encoding of tokens.
//
//   7f  4e 53 4a 62                     the signature; the last four bytes in the byte order of the writer
//   00 null   30 31 false true   10 bool: u8   11..14 int8..64   18 19 1a real16..64   21 22 uint8..16
//   27 string: length, bytes            5b 5d array   7b 7d map
//   2b defines a word: id, length, bytes   26 uses a word: id   2d deletes a word: id
//   40 uniform array: the type of its items, length, items
//
// A word is a string that is stored once and then used by its id. A length or an id is one byte up to 0xf0,
// or the byte 0xf2, 0xf4 or 0xf8 followed by an integer of 2, 4 or 8 bytes.

/// The signature of files from little-endian machines: almost all files.
const SIGNATURE: [u8; 5] = *b"\x7fNSJb";

const SIGNATURE_BIG: [u8; 5] = *b"\x7fbJSN";

/// Limit on defined words; geometry has a few dozen.
const WORD_COUNT_MAX: usize = 1 << 16;

/// Number of booleans that an array may have beyond one per byte of the file. In memory, booleans take eight
/// times their size in the file.
const BOOL_COUNT_FREE: usize = 1 << 22;

/// Whether the file has this encoding, in either byte order.
pub(super) fn is_binary(bytes: &[u8]) -> bool {
    bytes.starts_with(&SIGNATURE) || bytes.starts_with(&SIGNATURE_BIG)
}

/// Reads tokens.
struct Lexer<'a> {
    cursor: Cursor<'a>,
    endian: Endian,
    file_bytes: usize,
    words: HashMap<u64, &'a [u8]>,
}

impl<'a> Lexer<'a> {
    fn new(bytes: &'a [u8]) -> Result<Lexer<'a>> {
        let endian = match bytes.get(..SIGNATURE.len()) {
            Some(start) if start == SIGNATURE => Endian::Little,
            Some(start) if start == SIGNATURE_BIG => Endian::Big,
            Some(_) => return Err(Error::invalid(FORMAT, Position::Offset(0), "expected the signature")),
            None => {
                return Err(Error::truncated(
                    FORMAT,
                    Position::Offset(0),
                    "the file ends within its signature",
                ));
            }
        };
        let cursor = Cursor::new(FORMAT, endian, bytes, SIGNATURE.len());
        Ok(Lexer { cursor, endian, file_bytes: bytes.len(), words: HashMap::new() })
    }

    /// The next token; `None` at the end of the file.
    fn next(&mut self) -> Result<Option<JsonToken<'a>>> {
        while self.cursor.remaining() != 0 {
            let code = self.cursor.u8("a token")?;
            match code {
                0x2b => self.define()?,
                0x2d => {
                    let id = self.length()?;
                    self.words.remove(&id);
                }
                code => return self.token(code).map(Some),
            }
        }
        Ok(None)
    }

    fn define(&mut self) -> Result<()> {
        let id = self.length()?;
        let word = self.bytes("a word")?;
        self.words.insert(id, word);
        if self.words.len() > WORD_COUNT_MAX {
            Err(Error::too_large(
                FORMAT,
                format!("the file has more words than the limit of {WORD_COUNT_MAX}"),
            ))
        } else {
            Ok(())
        }
    }

    fn token(&mut self, code: u8) -> Result<JsonToken<'a>> {
        Ok(match code {
            0x00 => JsonToken::Null,
            0x5b | 0x7b => JsonToken::Open,
            0x5d | 0x7d => JsonToken::Close,
            0x10 => JsonToken::Bool(self.cursor.u8("a boolean")? != 0),
            0x30 => JsonToken::Bool(false),
            0x31 => JsonToken::Bool(true),
            0x26 => JsonToken::Text(self.word()?),
            0x27 => JsonToken::Text(String::from_utf8_lossy(self.bytes("a string")?)),
            0x40 => self.uniform()?,
            code => match number_of(code) {
                Some(number) => self.number(number)?,
                None => {
                    let position = Position::Offset(self.cursor.at() as u64 - 1);
                    return Err(Error::invalid(
                        FORMAT,
                        position,
                        format!("expected a token, found 0x{code:02x}"),
                    ));
                }
            },
        })
    }

    fn number(&mut self, number: NumberType) -> Result<JsonToken<'a>> {
        let bytes = self.cursor.take(number.size(), "a number")?;
        Ok(match number.decode(bytes, self.endian) {
            Values::F32(values) => JsonToken::Real(values.first().copied().unwrap_or_default().into()),
            Values::F64(values) => JsonToken::Real(values.first().copied().unwrap_or_default()),
            Values::U8(values) => JsonToken::Integer(values.first().copied().unwrap_or_default().into()),
            Values::I32(values) => JsonToken::Integer(values.first().copied().unwrap_or_default().into()),
            Values::I64(values) => JsonToken::Integer(values.first().copied().unwrap_or_default()),
            Values::Strings { .. } => JsonToken::Null, // numbers never decode to strings
        })
    }

    /// Reads a uniform array.
    fn uniform(&mut self) -> Result<JsonToken<'a>> {
        let code = self.cursor.u8("the type of an array")?;
        let at = self.cursor.at();
        let count = self.length()?;
        let too_many = |cursor: &Cursor| {
            cursor.truncated(format!(
                "expected {count} items of an array, but {} bytes remain",
                cursor.remaining()
            ))
        };
        let length = usize::try_from(count).ok().filter(|&count| count / 8 <= self.cursor.remaining());
        let length = length.ok_or_else(|| too_many(&self.cursor))?;
        let check_kept = |most: usize, what: &str| {
            if length <= most {
                Ok(())
            } else {
                Err(Error::too_large(
                    FORMAT,
                    format!("an array has {length} {what}, more than the limit of {most}"),
                ))
            }
        };
        match code {
            0x10 | 0x30 | 0x31 => {
                check_kept(self.file_bytes.saturating_add(BOOL_COUNT_FREE), "booleans")?;
                let words = self.cursor.take(length.div_ceil(32) * 4, "an array of booleans")?;
                let word = |bytes: &[u8; 4]| match self.endian {
                    Endian::Little => u32::from_le_bytes(*bytes),
                    Endian::Big => u32::from_be_bytes(*bytes),
                };
                let words: Vec<u32> = words.as_chunks::<4>().0.iter().map(word).collect();
                let bit = |index: usize| words[index / 32] >> (index % 32) & 1 == 1;
                Ok(JsonToken::Bools((0..length).map(bit).collect()))
            }
            // Each string takes at least one byte of the file.
            0x26 | 0x27 if length <= self.cursor.remaining() => {
                check_kept(text_count_max(self.file_bytes), "strings")?;
                let mut texts = Vec::new();
                let mut text_bytes = 0;
                let most = widened_bytes_max(self.file_bytes);
                for _ in 0..length {
                    let text = match code {
                        0x26 => self.word()?,
                        _ => String::from_utf8_lossy(self.bytes("a string")?),
                    };
                    // Counts each use of a word: the array can contain the same word any number of times.
                    text_bytes += text.len();
                    if text_bytes > most {
                        return Err(Error::too_large(
                            FORMAT,
                            format!(
                                "the strings of an array have {text_bytes} bytes or more, \
                                 more than the limit of {most} bytes"
                            ),
                        ));
                    }
                    texts.push(text);
                }
                Ok(JsonToken::Texts(texts))
            }
            code => {
                let unknown = || {
                    let what = format!("expected the type of an array, found 0x{code:02x}");
                    Error::invalid(FORMAT, Position::Offset(at as u64 - 1), what)
                };
                let number = number_of(code).ok_or_else(unknown)?;
                let payload = self.cursor.take(length.saturating_mul(number.size()), "an array")?;
                Ok(JsonToken::Numbers { number, endian: self.endian, payload })
            }
        }
    }

    fn word(&mut self) -> Result<Cow<'a, str>> {
        let id = self.length()?;
        let word = self.words.get(&id).copied();
        word.map(String::from_utf8_lossy)
            .ok_or_else(|| self.cursor.invalid(format!("the word {id} is not defined")))
    }

    fn bytes(&mut self, what: &str) -> Result<&'a [u8]> {
        let length = self.length()?;
        self.cursor.take(usize::try_from(length).unwrap_or(usize::MAX), what)
    }

    fn length(&mut self) -> Result<u64> {
        let lead = self.cursor.u8("a length")?;
        Ok(match lead {
            0..=0xf0 => lead.into(),
            0xf2 => self.cursor.u16("a length")?.into(),
            0xf4 => self.cursor.u32("a length")?.into(),
            0xf8 => self.cursor.u64("a length")?,
            _ => return Err(self.cursor.invalid(format!("expected a length, found 0x{lead:02x}"))),
        })
    }
}

/// The number type of a token, or of the items of an array.
fn number_of(code: u8) -> Option<NumberType> {
    Some(match code {
        0x11 => NumberType::I8,
        0x12 => NumberType::I16,
        0x13 => NumberType::I32,
        0x14 => NumberType::I64,
        0x18 => NumberType::F16,
        0x19 => NumberType::F32,
        0x1a => NumberType::F64,
        0x21 => NumberType::U8,
        0x22 => NumberType::U16,
        _ => return None,
    })
}
