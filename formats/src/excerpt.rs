//! Makes text from files and file names safe to print.
//!
//! A file name or an attribute name can contain line breaks, which forge lines in a log, and control
//! sequences, which a terminal executes. [`escaped`] makes both visible. [`excerpt`] also shortens the text,
//! because a wrong file may contain secrets.

use std::fmt::{self, Display, Write};

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

#[cfg(test)]
mod tests {
    use super::*;

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
