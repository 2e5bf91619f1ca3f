//! What made a file, written into it and read back from its head.
//!
//! Every format has a place for names and values that other programs keep or skip:
//!
//! ```text
//!   .vdb          metadata of the grid     meniscus_radius = 0.025
//!   .glb .gltf    asset.extras             {"meniscus": {"radius": "0.025"}}
//!   .obj          comment                  # meniscus_radius: 0.025
//!   .ply          comment                  comment meniscus_radius: 0.025
//!   .vtp          a string of the field data  meniscus_radius: 48 46 48 50 53 0
//!   .stl          title                i=9f3c…, and what else fits into 80 bytes
//!   .usda         customLayerData      dictionary meniscus = { string radius = "0.025" }
//!   .png          text                     meniscus_radius\0 0.025
//!   .exr          attribute of the file    meniscus = "meniscus_radius: 0.025 …"
//! ```
//!
//! Comments are one line of ASCII, for readers of these formats disagree about anything else; what
//! does not fit is escaped.

use crate::data::Provenance;

/// The program and its version, for the place where formats name their maker.
pub(crate) const GENERATOR: &str = concat!("meniscus ", env!("CARGO_PKG_VERSION"));

/// What recognises our entries among those of others.
const PREFIX: &str = "meniscus_";

/// A head longer than this is not ours.
pub(crate) const HEAD_BYTES_MAX: u64 = 1 << 20;

/// A key as it stands among the entries of other programs.
pub(crate) fn prefixed(key: &str) -> String {
    format!("{PREFIX}{key}")
}

/// One line per entry, each after `lead`, that [`from_comments`] finds again.
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

/// Those of our own among names and escaped values.
pub(crate) fn from_entries(entries: Vec<(String, String)>) -> Vec<(String, String)> {
    let ours =
        |(key, value): (String, String)| Some((key.strip_prefix(PREFIX)?.to_string(), unescape(&value)?));
    entries.into_iter().filter_map(ours).collect()
}

/// Those of our own among names and values.
pub(crate) fn from_strings(strings: Vec<(String, String)>) -> Vec<(String, String)> {
    let ours = |(key, value): (String, String)| Some((key.strip_prefix(PREFIX)?.to_string(), value));
    strings.into_iter().filter_map(ours).collect()
}

/// One line of printable ASCII: backslash, control characters and what is not ASCII as `\u{hex}`.
pub(crate) fn escape(text: &str) -> String {
    let mut escaped = String::with_capacity(text.len());
    for c in text.chars() {
        match c {
            ' '..='~' if c != '\\' => escaped.push(c),
            _ => escaped.extend(c.escape_unicode()),
        }
    }
    // A space at an end would not survive programs that trim.
    let inner = escaped.trim_matches(' ').len();
    if inner == escaped.len() { escaped } else { escaped.replace(' ', "\\u{20}") }
}

fn unescape(text: &str) -> Option<String> {
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
    fn comments_come_back() {
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
