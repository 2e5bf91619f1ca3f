//! Lines and numbers of text files.

use std::fmt::{self, Display, Write};

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

// Makes text from files and file names safe to print.
//
// A file name or an attribute name can contain line breaks, which forge lines in a log, and control
// sequences, which a terminal executes. `escaped` makes both visible. `excerpt` also shortens the text,
// because a wrong file may contain secrets.

/// `text` on one line and without control characters, for a terminal or a log.
///
/// Line breaks, other control characters (C0, DEL and C1) and characters that change the direction of text
/// or end a line become escapes such as `\n` and `\u{1b}`. Everything else, in any script, stays as it is.
pub fn escaped(text: impl Display) -> Escaped<impl Display> {
    Escaped(text)
}

/// See [`escaped`].
#[derive(Clone, Copy, Debug)]
pub struct Escaped<T>(T);

impl<T: Display> Display for Escaped<T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(Escaper(f), "{}", self.0)
    }
}

/// Escapes the text written to it.
struct Escaper<'a, 'b>(&'a mut fmt::Formatter<'b>);

impl Write for Escaper<'_, '_> {
    fn write_str(&mut self, text: &str) -> fmt::Result {
        let mut plain_start = 0;
        for (at, char) in text.char_indices().filter(|&(_, char)| is_unsafe(char)) {
            self.0.write_str(&text[plain_start..at])?;
            write!(self.0, "{}", char.escape_default())?;
            plain_start = at + char.len_utf8();
        }
        self.0.write_str(&text[plain_start..])
    }
}

/// Whether a terminal or a log viewer may interpret this character instead of showing it.
pub fn is_unsafe(char: char) -> bool {
    let is_bidi = matches!(char, '\u{61c}' | '\u{200e}' | '\u{200f}' | '\u{202a}'..='\u{202e}' | '\u{2066}'..='\u{2069}');
    let ends_line = matches!(char, '\u{2028}' | '\u{2029}');
    char.is_control() || is_bidi || ends_line
}

/// The start of a piece of a file, for a message: at most 24 characters, escaped.
///
/// Of `password=…` and `password: …`, only the key is shown.
pub(crate) fn excerpt(piece: impl AsRef<[u8]>) -> String {
    const CHARS_MAX: usize = 24;
    const BYTES_MAX: usize = 4 * CHARS_MAX + 4; // UTF-8, with room for one more character, which shows that the text is longer
    let piece = piece.as_ref();
    let text = String::from_utf8_lossy(&piece[..piece.len().min(BYTES_MAX)]);
    let char_end = text.char_indices().nth(CHARS_MAX).map_or(text.len(), |(at, _)| at);
    let shown = &text[..key_end(&text).map_or(char_end, |key_end| key_end.min(char_end))];
    let more = if shown.len() < text.len() { "…" } else { "" };
    format!("{}{more}", escaped(shown))
}

/// Where the key of a `key=value` or `key: value` text ends.
fn key_end(text: &str) -> Option<usize> {
    let is_after_key = |&(at, char): &(usize, char)| match char {
        '=' => true,
        ':' => text[at + 1..].starts_with([' ', '\t', '"', '\'']),
        _ => false,
    };
    text.char_indices().find(is_after_key).map(|(at, _)| at + 1)
}

/// Names of columns or attributes for a message: at most eight, each an [`excerpt`].
pub(crate) fn excerpts<T: AsRef<[u8]>>(names: impl IntoIterator<Item = T>) -> String {
    const NAMES_MAX: usize = 8;
    let mut names = names.into_iter();
    let mut shown: Vec<String> = names.by_ref().take(NAMES_MAX).map(excerpt).collect();
    shown.extend(names.next().map(|_| "…".to_owned()));
    shown.join(", ")
}

/// Numbers as text, each with the fewest digits from which it can be read back.
pub(crate) struct NumberWriter {
    pub(crate) text: Vec<u8>,
    real: zmij::Buffer,
    integer: itoa::Buffer,
}

impl NumberWriter {
    /// An empty text with space for this number of bytes.
    pub(crate) fn with_capacity(byte_count: usize) -> NumberWriter {
        let text = Vec::with_capacity(byte_count);
        NumberWriter { text, real: zmij::Buffer::new(), integer: itoa::Buffer::new() }
    }

    /// Appends a finite real number.
    pub(crate) fn real<T: zmij::Float>(&mut self, number: T) {
        let digits = self.real.format_finite(number);
        self.text.extend_from_slice(digits.strip_suffix(".0").unwrap_or(digits).as_bytes());
    }

    pub(crate) fn integer(&mut self, number: impl itoa::Integer) {
        self.text.extend_from_slice(self.integer.format(number).as_bytes());
    }
}

/// Whether the last bytes of a file contain a whole last line that begins with `start`.
pub(crate) fn ends_with_line(tail: &[u8], start: &str) -> bool {
    let Some(lines) = tail.strip_suffix(b"\n") else { return false };
    lines.rsplit(|&byte| byte == b'\n').next().is_some_and(|line| line.starts_with(start.as_bytes()))
}

/// Joins words with commas, and the last two with `last`: `.obj, .vtp and .usda`.
pub fn listed(words: Vec<String>, last: &str) -> String {
    match words.split_last() {
        Some((end, [])) => end.clone(),
        Some((end, others)) => format!("{} {last} {end}", others.join(", ")),
        None => String::new(),
    }
}

/// A note if neither a line end nor a blank follows the last number. For formats whose header states the
/// number of rows (LAMMPS, XYZ).
pub(crate) fn open_end_note(rows: &[u8]) -> Option<String> {
    let is_open = !rows.last().is_some_and(u8::is_ascii_whitespace);
    is_open.then(|| {
        "the file ends without a line end: if it is still being written, the last number may lack digits"
            .into()
    })
}

/// A note if a file has more bytes than its header declares: another program may have appended particles.
pub(crate) fn surplus_note(found_bytes: u64, declared_bytes: u64) -> Option<String> {
    let surplus = found_bytes.checked_sub(declared_bytes).filter(|surplus| *surplus > 0)?;
    Some(format!("the file has {surplus} bytes more than its header declares, and they are not read"))
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

    #[test]
    fn control_characters_and_line_breaks_are_escaped() {
        for (text, expected) in [
            ("dam.0001.ply", "dam.0001.ply"),
            ("Wasser-Überlauf 水 🌊", "Wasser-Überlauf 水 🌊"),
            ("a\nerror: b", "a\\nerror: b"),
            ("\u{1b}]0;x\u{7}", "\\u{1b}]0;x\\u{7}"),
            ("a\u{9b}31m\u{7f}\t", "a\\u{9b}31m\\u{7f}\\t"),
            ("gpj.\u{202e}ply", "gpj.\\u{202e}ply"),
            ("\u{2066}x\u{2069}\u{2028}", "\\u{2066}x\\u{2069}\\u{2028}"),
            (r"C:\new", r"C:\new"),
        ] {
            assert_eq!(escaped(text).to_string(), expected);
        }
    }

    #[test]
    fn excerpts_are_short_and_escaped() {
        for (piece, expected) in [
            (&b"1.5e"[..], "1.5e"),
            (b"exactly twenty-four char", "exactly twenty-four char"),
            (b"one more than twenty-four", "one more than twenty-fou…"),
            (b"password=hunter2", "password=…"),
            (b"token: abcdef", "token:…"),
            (b"velocity:0", "velocity:0"),
            (b"\x1b[31mred\xff", "\\u{1b}[31mred\u{fffd}"),
        ] {
            assert_eq!(excerpt(piece), expected);
        }
        assert_eq!(excerpt("水".repeat(25)), "水".repeat(24) + "…");
        let names: Vec<String> = (0..9).map(|index| index.to_string()).collect();
        assert_eq!(excerpts(&names), "0, 1, 2, 3, 4, 5, 6, 7, …");
        assert_eq!(excerpts(&names[..8]), "0, 1, 2, 3, 4, 5, 6, 7");
    }
}
