//! Reads the tokens of either form, binary or text, one after the other.
//!
//! [`TokenWalk`] does not keep the tokens that it has passed: skipped data costs no memory, regardless of its
//! depth and length.

use std::borrow::Cow;

use crate::error::{Error, Position, Result};
use crate::excerpt::excerpt;
use crate::limits::Limits;

use super::FORMAT;
use super::binary::Binary;
use super::text::TextTokens;
use super::token::{JsonToken, widened_bytes_max};

/// A tokenizer of either form.
pub(super) enum Lexer<'a> {
    Binary(Binary<'a>),
    Text(TextTokens<'a>),
}

impl<'a> Lexer<'a> {
    /// The next token; `None` at the end of the file.
    fn next(&mut self) -> Result<Option<JsonToken<'a>>> {
        match self {
            Lexer::Binary(lexer) => lexer.next(),
            Lexer::Text(lexer) => lexer.next(),
        }
    }

    /// Offset of the next token, in bytes from the start of the file.
    fn at(&self) -> usize {
        match self {
            Lexer::Binary(lexer) => lexer.at(),
            Lexer::Text(lexer) => lexer.at(),
        }
    }

    /// Size of the file in bytes.
    fn file_bytes(&self) -> usize {
        match self {
            Lexer::Binary(lexer) => lexer.file_bytes(),
            Lexer::Text(lexer) => lexer.file_bytes(),
        }
    }
}

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
    pub(super) fn new(lexer: Lexer<'a>) -> TokenWalk<'a> {
        TokenWalk { lexer, path: Vec::new(), spread_bytes: 0, widened_bytes: 0 }
    }

    pub(super) fn file_bytes(&self) -> usize {
        self.lexer.file_bytes()
    }

    /// Adds `bytes` of expanded constant pages to the total, and fails if the total is too large for the size
    /// of the file: constant pages are a form of compression.
    pub(super) fn check_spread(&mut self, bytes: u64, limits: &Limits) -> Result<()> {
        self.spread_bytes = self.spread_bytes.saturating_add(bytes);
        limits.check_decompressed(FORMAT, self.spread_bytes, self.lexer.file_bytes() as u64)
    }

    /// Adds `bytes` of memory for items that take less space in the file to the total, and fails if the total
    /// is too large for the size of the file. Valid files stay below: writers rarely store numbers narrower
    /// than declared.
    pub(super) fn check_widened(&mut self, bytes: usize) -> Result<()> {
        self.widened_bytes = self.widened_bytes.saturating_add(bytes);
        let most = widened_bytes_max(self.lexer.file_bytes());
        match self.widened_bytes <= most {
            true => Ok(()),
            false => Err(Error::too_large(
                FORMAT,
                format!("the arrays expand to more than the limit of {most} bytes"),
            )),
        }
    }

    /// Number of bytes that remain.
    pub(super) fn remaining(&self) -> usize {
        self.lexer.file_bytes() - self.lexer.at().min(self.lexer.file_bytes())
    }

    /// The next token; the end of the file is an error.
    pub(super) fn next(&mut self) -> Result<JsonToken<'a>> {
        match self.lexer.next()? {
            Some(token) => Ok(token),
            None => {
                let what = format!("{}: the file ends within the document", self.shown_path());
                Err(Error::truncated(FORMAT, Position::Offset(self.lexer.at() as u64), what))
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

    /// Skips the rest of the value that starts with `token`.
    pub(super) fn skip_rest(&mut self, token: &JsonToken) -> Result<()> {
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

    /// Checks that nothing but blanks follows the document.
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
        Error::invalid(FORMAT, Position::Offset(self.lexer.at() as u64), what)
    }

    fn shown_path(&self) -> String {
        match self.path.join("/").trim_start_matches('/') {
            "" => "the document".into(),
            path => path.split('/').map(excerpt).collect::<Vec<_>>().join("/"),
        }
    }
}
