//! The grammar of a line: cells, quotes, and numbers.

use crate::excerpt::excerpt;
use crate::text::parse_number;
use std::borrow::Cow;

/// What separates two cells.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Delimiter {
    /// Exactly one of this byte; spaces around it are ignored.
    Byte(u8),
    /// Any number of spaces and tabs.
    Blanks,
}

/// Delimiters in the order in which they are tried: in a line with commas and spaces, commas delimit.
pub(super) const DELIMITERS: [Delimiter; 5] = [
    Delimiter::Byte(b','),
    Delimiter::Byte(b';'),
    Delimiter::Byte(b'|'),
    Delimiter::Byte(b'\t'),
    Delimiter::Blanks,
];

/// The content of a cell.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum CellValue {
    /// A number, possibly not finite.
    Number(f64),
    /// Empty, or a word for a missing value.
    Missing,
    /// Anything else.
    Text,
}

/// The cells of a line, without surrounding blanks but with their quotes.
pub(super) fn cells(line: &[u8], delimiter: Delimiter) -> impl Iterator<Item = &[u8]> {
    let mut rest = Some(line);
    std::iter::from_fn(move || {
        let cell_start = skip_blanks(rest?, delimiter);
        if delimiter == Delimiter::Blanks && cell_start.is_empty() {
            return None;
        }
        let quoted = quoted_length(cell_start).unwrap_or(0);
        let ends = |byte: &u8| match delimiter {
            Delimiter::Byte(delimiter) => *byte == delimiter,
            Delimiter::Blanks => matches!(byte, b' ' | b'\t'),
        };
        let end = cell_start[quoted..].iter().position(ends).map(|length| quoted + length);
        rest = end.map(|end| &cell_start[end + 1..]);
        Some(cell_start[..end.unwrap_or(cell_start.len())].trim_ascii())
    })
}

/// Whether a line has `count` cells, not counting an empty cell after a delimiter at the end of the line.
pub(super) fn has_cells(line: &[u8], delimiter: Delimiter, count: usize) -> bool {
    let mut cells = cells(line, delimiter).skip(count.saturating_sub(1));
    cells.next().is_some() && cells.next().is_none_or(|cell| cell.is_empty() && cells.next().is_none())
}

/// Skips blanks at the start. A tab that is the delimiter is not a blank.
fn skip_blanks(text: &[u8], delimiter: Delimiter) -> &[u8] {
    let is_blank = |byte: &u8| *byte == b' ' || (*byte == b'\t' && delimiter != Delimiter::Byte(b'\t'));
    let length = text.iter().take_while(|byte| is_blank(byte)).count();
    &text[length..]
}

/// The length in bytes of a quoted cell, including its quotes. A quote within a cell is doubled.
pub(super) fn quoted_length(text: &[u8]) -> Option<usize> {
    if text.first() != Some(&b'"') {
        return None;
    }
    let mut at = 1;
    loop {
        at += text[at..].iter().take_while(|byte| !matches!(byte, b'"' | b'\n' | b'\r')).count();
        match text[at..] {
            [b'"', b'"', ..] => at += 2,
            [b'"', ..] => return Some(at + 1),
            _ => return None,
        }
    }
}

/// The text of a cell without its quotes.
pub(super) fn unquoted(cell: &[u8]) -> Cow<'_, [u8]> {
    if cell.len() < 2 || quoted_length(cell) != Some(cell.len()) {
        return Cow::Borrowed(cell);
    }
    let inside = &cell[1..cell.len() - 1];
    if !inside.contains(&b'"') {
        return Cow::Borrowed(inside);
    }
    let mut text = inside.to_vec();
    let mut previous_was_quote = false;
    text.retain(|&byte| {
        previous_was_quote = byte == b'"' && !previous_was_quote;
        !previous_was_quote
    });
    Cow::Owned(text)
}

/// Classifies an unquoted cell. Accepts Fortran exponents such as `1.5D-3`.
pub(super) fn parse_cell(text: &[u8]) -> CellValue {
    let text = text.trim_ascii();
    if let Some((value, length)) = parse_number::<f64>(text)
        && length == text.len()
    {
        return CellValue::Number(value);
    }
    let lower = text.to_ascii_lowercase();
    if MISSING.contains(&lower.as_slice()) {
        return CellValue::Missing;
    }
    let is_exponent = |byte: &u8| *byte == b'd';
    if let Some(at) = lower.iter().position(is_exponent) {
        let mut number = lower;
        number[at] = b'e';
        if let Ok(value) = fast_float2::parse::<f64, _>(&number) {
            return CellValue::Number(value);
        }
    }
    CellValue::Text
}

/// Whether a cell looks like a number with a decimal comma.
pub(super) fn has_decimal_comma(text: &[u8]) -> bool {
    let commas = text.iter().filter(|&&byte| byte == b',').count();
    let with_point: Vec<u8> = text.iter().map(|&byte| if byte == b',' { b'.' } else { byte }).collect();
    commas == 1 && matches!(parse_cell(&with_point), CellValue::Number(_))
}

/// Whether `text` is an integer that a 64-bit float cannot represent exactly.
#[inline]
pub(super) fn is_rounded_integer(text: &[u8]) -> bool {
    const DIGITS_ALWAYS_EXACT: usize = 15;
    DIGITS_ALWAYS_EXACT < text.len() && is_rounded_long_integer(text)
}

#[cold]
fn is_rounded_long_integer(text: &[u8]) -> bool {
    let text = text.trim_ascii();
    let digits = text.strip_prefix(b"-").or(text.strip_prefix(b"+")).unwrap_or(text);
    let magnitude = std::str::from_utf8(digits).ok().filter(|_| digits.iter().all(u8::is_ascii_digit));
    // An integer beyond 128 bits is almost certainly not representable exactly.
    magnitude.is_some_and(|digits| digits.parse().map_or(!digits.is_empty(), is_rounded))
}

/// Whether an integer of this magnitude needs more bits than a 64-bit float has.
pub(super) fn is_rounded(magnitude: u128) -> bool {
    let bit_count = u128::BITS.saturating_sub(magnitude.leading_zeros() + magnitude.trailing_zeros());
    f64::MANTISSA_DIGITS < bit_count
}

/// A piece of the file in quotes, for a message.
pub(super) fn quoted_excerpt(text: &[u8]) -> String {
    format!("\"{}\"", excerpt(text))
}

/// Words for a missing number, in lower case. (`nan` is a number.)
const MISSING: [&[u8]; 7] = [b"", b"na", b"n/a", b"#n/a", b"null", b"none", b"-"];
