//! Writes provenance (the settings and inputs a file was made with) into files, and reads it back.
//!
//! Every format can store names and values that other programs keep or skip. The module of the format decides
//! where, for example:
//!
//! ```text
//!   .vdb    metadata of the grid    meniscus_radius = 0.025
//!   .glb    asset.extras            {"meniscus": {"radius": "0.025"}}
//!   .ply    comment                 comment meniscus_radius: 0.025
//!   .stl    title                   i=9f3c…, and further entries up to 80 bytes
//! ```
//!
//! Comments are single lines of ASCII, because readers of these formats disagree about anything else. All
//! other characters are escaped.

use crate::core::data::Provenance;

/// The program and its version, for the generator field of a format.
pub(crate) const GENERATOR: &str = concat!("meniscus ", env!("CARGO_PKG_VERSION"));

/// Distinguishes our entries from those of other programs.
const PREFIX: &str = "meniscus_";

/// The maximum size of the head of a file with provenance: this program never writes a longer one.
pub(crate) const HEAD_BYTES_MAX: u64 = 1 << 20;

/// The entry that says that a file has points and no surface, and its values: particles that were only converted, and
/// points beside a surface.
pub const CONTENTS: &str = "contents";
/// See [`CONTENTS`].
pub const PARTICLES: &str = "particles";
/// See [`CONTENTS`].
pub const SPRAY: &str = "spray";

/// Whether a file with this provenance has points and no surface.
pub(crate) fn are_points(recorded: &Provenance) -> bool {
    recorded.iter().any(|(name, value)| name == CONTENTS && [PARTICLES, SPRAY].contains(&&**value))
}

/// A key with the prefix, as stored next to the entries of other programs.
pub(crate) fn prefixed(key: &str) -> String {
    format!("{PREFIX}{key}")
}

/// The key of an entry of ours, without the prefix; `None` for those of other programs.
pub(crate) fn from_prefixed(key: &str) -> Option<&str> {
    key.strip_prefix(PREFIX)
}

/// Formats one line per entry, each starting with `lead`. [`from_comments`] reads them back.
pub(crate) fn comments(provenance: &Provenance, lead: &str) -> String {
    provenance
        .iter()
        .map(|(key, value)| {
            let key = escape(key).replace(':', "\\c");
            format!("{lead}{PREFIX}{key}: {}\n", escape(value))
        })
        .collect()
}

pub(crate) fn from_comments(head: &[u8], lead: &str) -> Vec<(String, String)> {
    let is_head = |line: &&[u8]| !(line.starts_with(b"end_header") || line.starts_with(b"v "));
    head.split(|&byte| byte == b'\n')
        .take_while(is_head)
        .filter_map(|line| {
            let line = std::str::from_utf8(line).ok()?.trim_end_matches('\r');
            let (key, value) = line.strip_prefix(lead)?.strip_prefix(PREFIX)?.split_once(": ")?;
            Some((unescape(key)?, unescape(value)?))
        })
        .collect()
}

/// Extracts our own entries from names and values that [`escape`] wrote.
pub(crate) fn from_escaped<'a>(entries: impl Iterator<Item = (&'a str, &'a str)>) -> Vec<(String, String)> {
    let ours = |(key, value)| Some((unescape(from_prefixed(key)?)?, unescape(value)?));
    entries.filter_map(ours).collect()
}

/// Extracts our own entries from names and unescaped values.
pub(crate) fn from_strings(strings: Vec<(String, String)>) -> Vec<(String, String)> {
    let ours = |(key, value): (String, String)| Some((key.strip_prefix(PREFIX)?.to_string(), value));
    strings.into_iter().filter_map(ours).collect()
}

/// Escapes text as one line of printable ASCII: backslashes, control characters and non-ASCII become
/// `\u{hex}`.
pub(crate) fn escape(text: &str) -> String {
    let mut escaped = String::with_capacity(text.len());
    for c in text.chars() {
        match c {
            ' '..='~' if c != '\\' => escaped.push(c),
            _ => escaped.extend(c.escape_unicode()),
        }
    }
    // Some programs trim lines, so all spaces are escaped if the text starts or ends with one.
    let inner = escaped.trim_matches(' ').len();
    if inner == escaped.len() { escaped } else { escaped.replace(' ', "\\u{20}") }
}

/// Reverses [`escape`].
pub(crate) fn unescape(text: &str) -> Option<String> {
    let mut plain = String::with_capacity(text.len());
    let mut rest = text;
    while let Some((before, escaped)) = rest.split_once('\\') {
        plain.push_str(before);
        if let Some(after) = escaped.strip_prefix('c') {
            plain.push(':');
            rest = after;
        } else {
            let (hex, after) = escaped.strip_prefix("u{")?.split_once('}')?;
            plain.push(char::from_u32(u32::from_str_radix(hex, 16).ok()?)?);
            rest = after;
        }
    }
    plain.push_str(rest);
    Some(plain)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn provenance_comments_round_trip() {
        let pair = |key: &str, value: &str| (key.to_string(), value.to_string());
        let provenance = [
            pair("radius", "0.025"),
            pair("note: odd", "a: b\nend_header\r\\n"),
            pair("größe", "höhe ∞ \u{1F4A7}"),
            pair("", " "),
            pair("empty", ""),
        ];
        for lead in ["# ", "comment "] {
            let text = comments(&provenance, lead);
            assert!(text.is_ascii() && text.lines().count() == provenance.len());
            assert_eq!(from_comments(text.as_bytes(), lead), provenance);
        }
    }
}
