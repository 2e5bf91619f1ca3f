//! Tokens, whichever form they are written in, and a walk through them.
//!
//! Nothing is kept of what was passed: neither depth nor length of what is not asked for costs memory.

use std::borrow::Cow;

use crate::bytes::Endian;
use crate::error::{Error, Place, Result};
use crate::excerpt::excerpt;
use crate::limits::Limits;
use crate::number::Number;

use super::FORMAT;
use super::binary::Binary;
use super::text::Text;

/// One token of JSON. Commas and colons say nothing and are none.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Token<'a> {
    /// The beginning of an array or of a map.
    Open,
    Close,
    Null,
    Bool(bool),
    Integer(i64),
    Real(f64),
    Text(Cow<'a, str>),
    /// An array of numbers in one piece. Only the binary form has it, and the next ones.
    Numbers {
        number: Number,
        endian: Endian,
        payload: &'a [u8],
    },
    /// An array of truths in one piece.
    Bools(Vec<bool>),
    /// An array of texts in one piece.
    Texts(Vec<Cow<'a, str>>),
}

/// Texts of one list in a file of so many bytes. Each takes some dozens of bytes of memory, though it may be empty.
pub(super) fn text_count_max(file_bytes: usize) -> usize {
    (1 << 16) + file_bytes / 16
}

/// Bytes that items which have fewer in the file may become, in a file of so many.
pub(super) fn widened_bytes_max(file_bytes: usize) -> usize {
    (16 << 20) + 2 * file_bytes
}

/// What makes tokens of bytes.
pub(super) enum Lexer<'a> {
    Binary(Binary<'a>),
    Text(Text<'a>),
}

impl<'a> Lexer<'a> {
    /// The next token; `None` at the end of the file.
    fn next(&mut self) -> Result<Option<Token<'a>>> {
        match self {
            Lexer::Binary(lexer) => lexer.next(),
            Lexer::Text(lexer) => lexer.next(),
        }
    }

    /// Where the next token begins, bytes from the start of the file.
    fn at(&self) -> usize {
        match self {
            Lexer::Binary(lexer) => lexer.at(),
            Lexer::Text(lexer) => lexer.at(),
        }
    }

    /// Bytes of the file.
    fn file_bytes(&self) -> usize {
        match self {
            Lexer::Binary(lexer) => lexer.file_bytes(),
            Lexer::Text(lexer) => lexer.file_bytes(),
        }
    }
}

/// The walk: it knows where it is, by offset and by the keys that led there.
pub(super) struct Walk<'a> {
    lexer: Lexer<'a>,
    path: Vec<String>,
    /// Bytes that constant pages became so far.
    spread_bytes: u64,
    /// Bytes that items became so far which have fewer in the file.
    widened_bytes: usize,
}

impl<'a> Walk<'a> {
    pub(super) fn new(lexer: Lexer<'a>) -> Walk<'a> {
        Walk { lexer, path: Vec::new(), spread_bytes: 0, widened_bytes: 0 }
    }

    pub(super) fn file_bytes(&self) -> usize {
        self.lexer.file_bytes()
    }

    /// Refuses constant pages that become so many bytes, if all of them are too many for the file: they are a
    /// compression.
    pub(super) fn check_spread(&mut self, bytes: u64, limits: &Limits) -> Result<()> {
        self.spread_bytes = self.spread_bytes.saturating_add(bytes);
        limits.check_unpacked(FORMAT, self.spread_bytes, self.lexer.file_bytes() as u64)
    }

    /// Refuses items that become so many bytes, if there are fewer in the file for each and all of them are too many for
    /// it: few things are written narrower than they are stored.
    pub(super) fn check_widened(&mut self, bytes: usize) -> Result<()> {
        self.widened_bytes = self.widened_bytes.saturating_add(bytes);
        let most = widened_bytes_max(self.lexer.file_bytes());
        match self.widened_bytes <= most {
            true => Ok(()),
            false => Err(Error::too_large(FORMAT, format!("arrays that become more than {most} bytes"))),
        }
    }

    /// Bytes that are still to come.
    pub(super) fn remaining(&self) -> usize {
        self.lexer.file_bytes() - self.lexer.at().min(self.lexer.file_bytes())
    }

    /// The next token, which must be there.
    pub(super) fn next(&mut self) -> Result<Token<'a>> {
        match self.lexer.next()? {
            Some(token) => Ok(token),
            None => {
                let what = format!("{}: the file ends within the document", self.shown_path());
                Err(Error::short(FORMAT, Place::Offset(self.lexer.at() as u64), what))
            }
        }
    }

    /// Goes into the next value, an array or a map, and comes out behind it. `inside` must pass each value that
    /// follows a key, and is called with each key.
    pub(super) fn object(
        &mut self,
        name: &str,
        mut inside: impl FnMut(&mut Walk<'a>, &str) -> Result<()>,
    ) -> Result<()> {
        self.within(name, |walk| {
            walk.open()?;
            loop {
                match walk.next()? {
                    Token::Close => return Ok(()),
                    Token::Text(key) => inside(walk, &key)?,
                    other => return Err(walk.unexpected("a key", &other)),
                }
            }
        })
    }

    /// Goes through the items of the next value, an array. `inside` gets the first token of each and must pass the
    /// rest of it.
    pub(super) fn items(
        &mut self,
        name: &str,
        mut inside: impl FnMut(&mut Walk<'a>, Token<'a>) -> Result<()>,
    ) -> Result<()> {
        self.within(name, |walk| {
            walk.open()?;
            loop {
                match walk.next()? {
                    Token::Close => return Ok(()),
                    token => inside(walk, token)?,
                }
            }
        })
    }

    /// The same with a longer path.
    pub(super) fn within<T>(
        &mut self,
        name: &str,
        inside: impl FnOnce(&mut Walk<'a>) -> Result<T>,
    ) -> Result<T> {
        self.path.push(name.chars().take(40).collect());
        let result = inside(self);
        self.path.pop();
        result
    }

    fn open(&mut self) -> Result<()> {
        match self.next()? {
            Token::Open => Ok(()),
            other => Err(self.unexpected("an array", &other)),
        }
    }

    /// Passes the next value.
    pub(super) fn skip(&mut self) -> Result<()> {
        let token = self.next()?;
        self.skip_rest(&token)
    }

    /// Passes the rest of the value that begins with `token`.
    pub(super) fn skip_rest(&mut self, token: &Token) -> Result<()> {
        let mut depth = usize::from(*token == Token::Open);
        if *token == Token::Close {
            return Err(self.invalid("expected a value, found the end of an array"));
        }
        while depth != 0 {
            match self.next()? {
                Token::Open => depth += 1,
                Token::Close => depth -= 1,
                _ => {}
            }
        }
        Ok(())
    }

    /// The next value, a text.
    pub(super) fn text(&mut self) -> Result<Cow<'a, str>> {
        match self.next()? {
            Token::Text(text) => Ok(text),
            other => Err(self.unexpected("a text", &other)),
        }
    }

    /// The next value, a number of things.
    pub(super) fn count(&mut self) -> Result<u64> {
        match self.next()? {
            Token::Integer(count) if count >= 0 => Ok(count.unsigned_abs()),
            other => Err(self.unexpected("a count", &other)),
        }
    }

    /// That nothing but blanks follows the document.
    pub(super) fn finish(&mut self) -> Result<()> {
        match self.lexer.next()? {
            None => Ok(()),
            Some(other) => Err(self.unexpected("the end of the file", &other)),
        }
    }

    pub(super) fn unexpected(&self, expected: &str, found: &Token) -> Error {
        let found = match found {
            Token::Open => "an array or a map".into(),
            Token::Close => "the end of an array".into(),
            Token::Null => "null".into(),
            Token::Bool(value) => value.to_string(),
            Token::Integer(value) => value.to_string(),
            Token::Real(value) => value.to_string(),
            Token::Text(text) => format!("\"{}\"", excerpt(&**text)),
            Token::Numbers { .. } => "an array of numbers".into(),
            Token::Bools(_) => "an array of truths".into(),
            Token::Texts(_) => "an array of texts".into(),
        };
        self.invalid(format!("expected {expected}, found {found}"))
    }

    pub(super) fn invalid(&self, what: impl AsRef<str>) -> Error {
        let what = format!("{}: {}", self.shown_path(), what.as_ref());
        Error::invalid(FORMAT, Place::Offset(self.lexer.at() as u64), what)
    }

    fn shown_path(&self) -> String {
        match self.path.join("/").trim_start_matches('/') {
            "" => "the document".into(),
            path => path.split('/').map(excerpt).collect::<Vec<_>>().join("/"),
        }
    }
}
