//! Lines and numbers of text files.

use fast_float2::FastFloat;

/// The lines of a text, without their terminators: LF, CR LF or CR.
///
/// The first line decides whether a lone CR terminates lines, so the binary data after a text header is never
/// split at CRs.
#[derive(Clone, Debug)]
pub(crate) struct Lines<'a> {
    bytes: &'a [u8],
    at: usize,
    number: u64,
    end: u8,
}

impl<'a> Lines<'a> {
    pub(crate) fn new(bytes: &'a [u8]) -> Lines<'a> {
        Lines { bytes, at: 0, number: 0, end: line_end(bytes) }
    }

    /// Offset of the next line.
    pub(crate) fn at(&self) -> usize {
        self.at
    }

    /// Whether the last returned line had a terminator, and was not cut off by the end of the text.
    pub(crate) fn was_ended(&self) -> bool {
        self.bytes[..self.at].last() == Some(&self.end)
    }

    /// The number of the last returned line, starting at 1.
    pub(crate) fn number(&self) -> u64 {
        self.number
    }
}

impl<'a> Iterator for Lines<'a> {
    type Item = &'a [u8];

    fn next(&mut self) -> Option<&'a [u8]> {
        let rest = self.bytes.get(self.at..).filter(|rest| !rest.is_empty())?;
        let length = rest.iter().position(|&byte| byte == self.end);
        let line = &rest[..length.unwrap_or(rest.len())];
        self.at += line.len() + usize::from(length.is_some());
        self.number += 1;
        Some(line.strip_suffix(b"\r").unwrap_or(line))
    }
}

/// The byte that terminates lines: CR if the first line ends in a lone CR, else LF.
fn line_end(bytes: &[u8]) -> u8 {
    let first = bytes.iter().position(|byte| matches!(byte, b'\n' | b'\r'));
    match first {
        Some(at) if bytes[at] == b'\r' && bytes.get(at + 1) != Some(&b'\n') => b'\r',
        _ => b'\n',
    }
}

/// The number, starting at 1, of the line that contains the byte at `offset`.
pub(crate) fn line_number(bytes: &[u8], offset: usize) -> u64 {
    let end = line_end(bytes);
    1 + bytes[..offset.min(bytes.len())].iter().filter(|&&byte| byte == end).count() as u64
}

/// Parses the number at the start of `bytes`. Returns it and its length, or `None`.
///
/// Also accepts `nan(ind)`, `1.#QNAN` and `1.#INF`, which older Windows programs write.
pub(crate) fn parse_number<T: FastFloat>(bytes: &[u8]) -> Option<(T, usize)> {
    let (value, length) = fast_float2::parse_partial::<T, _>(bytes).ok()?;
    match bytes.get(length) {
        None | Some(b' ' | b'\t' | b'\n' | b'\r' | b',' | b';' | b'|' | b'"') => Some((value, length)),
        Some(_) => parse_odd_number(bytes),
    }
}

#[cold]
fn parse_odd_number<T: FastFloat>(bytes: &[u8]) -> Option<(T, usize)> {
    let is_part = |byte: &u8| byte.is_ascii_alphanumeric() || b"+-.#()".contains(byte);
    let length = bytes.iter().take(16).position(|byte| !is_part(byte)).unwrap_or(bytes.len().min(16));
    let token = bytes[..length].to_ascii_lowercase();
    let (negative, magnitude) = match token.split_first()? {
        (b'-', rest) => (true, rest),
        (b'+', rest) => (false, rest),
        _ => (false, &token[..]),
    };
    let plain: &[u8] = match magnitude {
        [b'n', b'a', b'n', b'(', .., b')']
        | [b'1', b'.', b'#', b'q' | b's' | b'i', b'n', b'a' | b'd', ..] => b"nan",
        [b'1', b'.', b'#', b'i', b'n', b'f', ..] if negative => b"-inf",
        [b'1', b'.', b'#', b'i', b'n', b'f', ..] => b"inf",
        _ => return None,
    };
    fast_float2::parse::<T, _>(plain).ok().map(|value| (value, length))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lf_crlf_and_cr_terminate_lines() {
        for text in ["a\nb\n\nc", "a\r\nb\r\n\r\nc\r\n", "a\rb\r\rc\r"] {
            let lines: Vec<&[u8]> = Lines::new(text.as_bytes()).collect();
            assert_eq!(lines, [b"a" as &[u8], b"b", b"", b"c"], "of {text:?}");
        }
        let mut lines = Lines::new(b"a\rb\r\n");
        lines.by_ref().take(2).for_each(drop);
        assert_eq!((lines.at(), lines.number()), (4, 2), "a lone CR leaves the LF after it alone");
        assert_eq!(line_number(b"a\nb\nc", 4), 3);
    }

    #[test]
    fn numbers_are_parsed_up_to_a_delimiter() {
        let table = [
            ("1.5 2", Some((1.5, 3))),
            ("-2e3,", Some((-2000.0, 4))),
            ("7", Some((7.0, 1))),
            (".5\n", Some((0.5, 2))),
            ("inf", Some((f64::INFINITY, 3))),
            ("-1.#INF 0", Some((f64::NEG_INFINITY, 7))),
            ("1.5x", None),
            ("x", None),
            ("", None),
            ("-", None),
            ("1.#", None),
        ];
        for (text, expected) in table {
            assert_eq!(parse_number::<f64>(text.as_bytes()), expected, "of {text}");
        }
        for (text, length) in [("nan", 3), ("-nan(ind) 1", 9), ("1.#QNAN", 7), ("-1.#IND", 7)] {
            let (value, found) = parse_number::<f32>(text.as_bytes()).unwrap();
            assert!(value.is_nan() && found == length, "of {text}");
        }
    }
}
