//! Tokens of the text form.

use std::borrow::Cow;

use crate::error::{Error, Position, Result};
use crate::text::line_number;

use super::FORMAT;
use super::token::JsonToken;

/// The lexer of the text form.
pub(super) struct TextTokens<'a> {
    bytes: &'a [u8],
    at: usize,
}

impl<'a> TextTokens<'a> {
    pub(super) fn new(bytes: &'a [u8]) -> TextTokens<'a> {
        let at = if bytes.starts_with(b"\xef\xbb\xbf") { 3 } else { 0 };
        TextTokens { bytes, at }
    }

    pub(super) fn at(&self) -> usize {
        self.at
    }

    pub(super) fn file_bytes(&self) -> usize {
        self.bytes.len()
    }

    pub(super) fn next(&mut self) -> Result<Option<JsonToken<'a>>> {
        let rest = &self.bytes[self.at..];
        let is_between = |byte: &&u8| byte.is_ascii_whitespace() || matches!(byte, b',' | b':');
        self.at += rest.iter().take_while(is_between).count();
        let rest = &self.bytes[self.at..];
        let Some(&first) = rest.first() else { return Ok(None) };
        let token = match first {
            b'[' | b'{' => JsonToken::Open,
            b']' | b'}' => JsonToken::Close,
            b'"' => return self.text().map(Some),
            _ => return self.word().map(Some),
        };
        self.at += 1;
        Ok(Some(token))
    }

    fn text(&mut self) -> Result<JsonToken<'a>> {
        let rest = &self.bytes[self.at + 1..];
        let mut has_escapes = false;
        let mut length = 0;
        loop {
            match rest.get(length) {
                Some(b'"') => break,
                Some(b'\\') => {
                    has_escapes = true;
                    length += 2;
                }
                Some(_) => length += 1,
                None => {
                    return Err(Error::truncated(FORMAT, self.position(), "the file ends within a string"));
                }
            }
        }
        let start = self.at;
        self.at += length + 2;
        if !has_escapes {
            return Ok(JsonToken::Text(String::from_utf8_lossy(&rest[..length])));
        }
        let text: String = serde_json::from_slice(&self.bytes[start..self.at]).map_err(|_| {
            let what = "a string has an escape that JSON does not define";
            Error::invalid(FORMAT, Position::Line(line_number(self.bytes, start)), what)
        })?;
        Ok(JsonToken::Text(Cow::Owned(text)))
    }

    /// Parses a number, `null`, `true` or `false`.
    fn word(&mut self) -> Result<JsonToken<'a>> {
        let rest = &self.bytes[self.at..];
        let is_part = |byte: &&u8| byte.is_ascii_alphanumeric() || matches!(byte, b'+' | b'-' | b'.');
        let length = rest.iter().take_while(is_part).count();
        let word = &rest[..length];
        let token = match word {
            b"null" => Some(JsonToken::Null),
            b"true" => Some(JsonToken::Bool(true)),
            b"false" => Some(JsonToken::Bool(false)),
            _ => number(word),
        };
        if let Some(token) = token.filter(|_| length != 0) {
            self.at += length;
            return Ok(token);
        }
        let found = rest[..length.clamp(1, 24)].escape_ascii();
        let what = format!("expected a value, found `{found}`");
        Err(match length == rest.len() {
            true => Error::truncated(FORMAT, self.position(), what), // the word may be truncated
            false => Error::invalid(FORMAT, self.position(), what),
        })
    }

    fn position(&self) -> Position {
        Position::Line(line_number(self.bytes, self.at))
    }
}

fn number<'a>(word: &[u8]) -> Option<JsonToken<'a>> {
    let text = std::str::from_utf8(word).ok()?;
    match text.parse() {
        Ok(integer) => Some(JsonToken::Integer(integer)),
        Err(_) => fast_float2::parse(word).ok().map(JsonToken::Real),
    }
}
