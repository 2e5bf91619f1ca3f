//! The Python literals that can occur in a header.

use crate::error::{Error, Position, Result};

use super::FORMAT;

/// A Python literal.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Literal {
    Text(String),
    Integer(u64),
    Bool(bool),
    /// A list or a tuple.
    List(Vec<Literal>),
    /// Keys and values.
    Dictionary(Vec<(Literal, Literal)>),
}

/// Nesting limit for lists: the header of a structured type has four levels, plus two per nested structure.
const DEPTH_MAX: usize = 32;

/// Parses all of `text`, which starts at offset `offset` of the file, as one literal.
pub(super) fn parse(text: &[u8], offset: usize) -> Result<Literal> {
    let mut parser = Parser { text, at: 0, offset };
    let literal = parser.literal(0)?;
    match parser.peek() {
        None => Ok(literal),
        Some(_) => Err(parser.unexpected("the end of the header")),
    }
}

struct Parser<'a> {
    text: &'a [u8],
    at: usize,
    offset: usize,
}

impl Parser<'_> {
    /// The next nonblank byte, without consuming it.
    fn peek(&mut self) -> Option<u8> {
        let rest = &self.text[self.at..];
        self.at += rest.iter().take_while(|byte| byte.is_ascii_whitespace()).count();
        self.text.get(self.at).copied()
    }

    fn take(&mut self, byte: u8) -> bool {
        let is_next = self.peek() == Some(byte);
        self.at += usize::from(is_next);
        is_next
    }

    fn literal(&mut self, depth: usize) -> Result<Literal> {
        if depth > DEPTH_MAX {
            return Err(self.unexpected(&format!("at most {DEPTH_MAX} nested lists")));
        }
        match self.peek() {
            Some(b'{') => self.dictionary(depth),
            Some(b'[') => self.list(b']', depth),
            Some(b'(') => self.list(b')', depth),
            Some(quote @ (b'\'' | b'"')) => self.text(quote),
            Some(b'0'..=b'9') => self.integer(),
            _ => self.word(),
        }
    }

    fn dictionary(&mut self, depth: usize) -> Result<Literal> {
        let mut entries = Vec::new();
        self.at += 1;
        while !self.take(b'}') {
            let key = self.literal(depth + 1)?;
            if !self.take(b':') {
                return Err(self.unexpected("`:`"));
            }
            entries.push((key, self.literal(depth + 1)?));
            if !self.take(b',') && self.peek() != Some(b'}') {
                return Err(self.unexpected("`,` or `}`"));
            }
        }
        Ok(Literal::Dictionary(entries))
    }

    fn list(&mut self, close: u8, depth: usize) -> Result<Literal> {
        let mut items = Vec::new();
        self.at += 1;
        while !self.take(close) {
            items.push(self.literal(depth + 1)?);
            if !self.take(b',') && self.peek() != Some(close) {
                return Err(self.unexpected("`,` or the end of the list"));
            }
        }
        Ok(Literal::List(items))
    }

    /// Parses a string. Keeps escapes as spelled, such as that of a quote.
    fn text(&mut self, quote: u8) -> Result<Literal> {
        let rest = &self.text[self.at + 1..];
        let mut is_escaped = false;
        for (length, &byte) in rest.iter().enumerate() {
            if byte == quote && !is_escaped {
                self.at += length + 2;
                return Ok(Literal::Text(String::from_utf8_lossy(&rest[..length]).into_owned()));
            }
            is_escaped = byte == b'\\' && !is_escaped;
        }
        Err(self.unexpected("the end of a string"))
    }

    fn integer(&mut self) -> Result<Literal> {
        let digits = self.text[self.at..].iter().take_while(|byte| byte.is_ascii_digit()).count();
        let text = std::str::from_utf8(&self.text[self.at..self.at + digits]).unwrap_or_default();
        let Ok(integer) = text.parse() else { return Err(self.unexpected("a 64-bit integer")) };
        self.at += digits;
        self.at += usize::from(self.text.get(self.at) == Some(&b'L')); // Python 2
        Ok(Literal::Integer(integer))
    }

    fn word(&mut self) -> Result<Literal> {
        for (word, value) in [(&b"True"[..], true), (b"False", false)] {
            if self.text[self.at..].starts_with(word) {
                self.at += word.len();
                return Ok(Literal::Bool(value));
            }
        }
        Err(self.unexpected("a literal"))
    }

    fn unexpected(&self, expected: &str) -> Error {
        let rest = &self.text[self.at.min(self.text.len())..];
        let found = match rest {
            [] => "the end".to_string(),
            _ => format!("`{}`", rest[..rest.len().min(16)].escape_ascii()),
        };
        let position = Position::Offset((self.offset + self.at) as u64);
        Error::invalid(FORMAT, position, format!("the header: expected {expected}, found {found}"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn python_dictionaries_are_parsed() {
        let text = b"{'descr': [('pos', '<f4', (3L,)), (\"it's\", '|b1')], 'fortran_order': False, }  \n";
        let found = format!("{:?}", parse(text, 10).unwrap());
        assert_eq!(
            found,
            "Dictionary([(Text(\"descr\"), List([List([Text(\"pos\"), Text(\"<f4\"), List([Integer(3)])]), \
             List([Text(\"it's\"), Text(\"|b1\")])])), (Text(\"fortran_order\"), Bool(false))])"
        );
    }

    #[test]
    fn malformed_headers_are_errors_with_offset() {
        let deep = "[".repeat(100_000);
        let table = [
            ("{'a' 1}", "at byte 15: the header: expected `:`, found `1}`"),
            ("{'a': 1", "expected `,` or `}`, found the end"),
            ("{} x", "expected the end of the header, found `x`"),
            ("'a", "expected the end of a string"),
            ("99999999999999999999", "a 64-bit integer"),
            ("None", "expected a literal, found `None`"),
            (&deep, "at most 32 nested lists"),
        ];
        for (text, expected) in table {
            let error = parse(text.as_bytes(), 10).unwrap_err().to_string();
            assert!(error.contains(expected), "{error}");
        }
    }
}
