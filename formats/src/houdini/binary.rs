//! Tokens of the binary form.
//!
//! ```text
//!   7f  4e 53 4a 62                     the signature; the last four bytes in the byte order of the writer
//!   00 null   30 31 false true   10 bool: u8   11..14 int8..64   18 19 1a real16..64   21 22 uint8..16
//!   27 string: length, bytes            5b 5d array   7b 7d map
//!   2b defines a word: id, length, bytes   26 uses a word: id   2d deletes a word: id
//!   40 uniform array: the type of its items, length, items
//! ```
//!
//! A word is a string that is stored once and then used by its id. A length or an id is one byte up to 0xf0,
//! or the byte 0xf2, 0xf4 or 0xf8 followed by an integer of 2, 4 or 8 bytes.

use std::borrow::Cow;
use std::collections::HashMap;

use crate::bytes::{Cursor, Endian};
use crate::data::Values;
use crate::error::{Error, Position, Result};
use crate::number::NumberType;

use super::FORMAT;
use super::token::{JsonToken, text_count_max, widened_bytes_max};

/// The signature of files from little-endian machines: almost all files.
const SIGNATURE: [u8; 5] = *b"\x7fNSJb";

const SIGNATURE_BIG: [u8; 5] = *b"\x7fbJSN";

/// Limit on defined words; geometry has a few dozen.
const WORD_COUNT_MAX: usize = 1 << 16;

/// Number of booleans that an array may have beyond one per byte of the file. In memory, booleans take eight
/// times their size in the file.
const BOOL_COUNT_FREE: usize = 1 << 22;

/// Whether the file is in binary form, in either byte order.
pub(super) fn is_binary(bytes: &[u8]) -> bool {
    bytes.starts_with(&SIGNATURE) || bytes.starts_with(&SIGNATURE_BIG)
}

/// The lexer of the binary form.
pub(super) struct Binary<'a> {
    cursor: Cursor<'a>,
    endian: Endian,
    file_bytes: usize,
    words: HashMap<u64, &'a [u8]>,
}

impl<'a> Binary<'a> {
    pub(super) fn new(bytes: &'a [u8]) -> Result<Binary<'a>> {
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
        Ok(Binary { cursor, endian, file_bytes: bytes.len(), words: HashMap::new() })
    }

    pub(super) fn at(&self) -> usize {
        self.cursor.at()
    }

    pub(super) fn file_bytes(&self) -> usize {
        self.file_bytes
    }

    pub(super) fn next(&mut self) -> Result<Option<JsonToken<'a>>> {
        while self.cursor.remaining() != 0 {
            let [code] = self.cursor.array("a token")?;
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
        match self.words.len() > WORD_COUNT_MAX {
            true => Err(Error::too_large(
                FORMAT,
                format!("the file has more words than the limit of {WORD_COUNT_MAX}"),
            )),
            false => Ok(()),
        }
    }

    fn token(&mut self, code: u8) -> Result<JsonToken<'a>> {
        Ok(match code {
            0x00 => JsonToken::Null,
            0x5b | 0x7b => JsonToken::Open,
            0x5d | 0x7d => JsonToken::Close,
            0x10 => JsonToken::Bool(self.cursor.array::<1>("a boolean")? != [0]),
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
        let [code] = self.cursor.array("the type of an array")?;
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
        let check_kept = |most: usize, what: &str| match length <= most {
            true => Ok(()),
            false => Err(Error::too_large(
                FORMAT,
                format!("an array has {length} {what}, more than the limit of {most}"),
            )),
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
        let [lead] = self.cursor.array("a length")?;
        Ok(match lead {
            0..=0xf0 => lead.into(),
            0xf2 => u16::from_le_bytes(self.cursor.array("a length")?).into(),
            0xf4 => u32::from_le_bytes(self.cursor.array("a length")?).into(),
            0xf8 => u64::from_le_bytes(self.cursor.array("a length")?),
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
