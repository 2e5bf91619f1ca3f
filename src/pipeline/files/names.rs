//! Converts file names to text and back, including names that are not Unicode.
//!
//! ```text
//!   gr\xf6\xdfe.1.ply     bytes that are not UTF-8, from an old disk
//!   gr··e.1.ply           its text: each invalid byte becomes a private-use character, U+F700 plus the byte
//!   gr\xf6\xdfe.1.obj     the name of the output: the same bytes
//! ```
//!
//! So different names become different texts, and code can cut and join names as text. If a name already
//! contains a character of that private-use range, each byte of the character is encoded, so that the
//! conversion back is unambiguous.

use std::ffi::{OsStr, OsString};

/// The text of a name.
pub(crate) fn text_of_name(name: &OsStr) -> String {
    // Nearly all names are ASCII: they are copied as a whole.
    if let Some(name) = name.to_str().filter(|name| name.is_ascii()) {
        return name.to_owned();
    }
    escaped(name.as_encoded_bytes())
}

/// The name for a text.
pub(crate) fn name_of_text(text: &str) -> OsString {
    if text.is_ascii() {
        return text.into();
    }
    let mut bytes = Vec::with_capacity(text.len());
    for letter in text.chars() {
        match byte_of(letter) {
            Some(byte) => bytes.push(byte),
            None => bytes.extend_from_slice(letter.encode_utf8(&mut [0; 4]).as_bytes()),
        }
    }
    from_bytes(bytes)
}

/// The character of byte 0; those of the other bytes follow.
const ESCAPES_START: u32 = 0xf700;

fn escaped(name: &[u8]) -> String {
    let mut text = String::with_capacity(name.len());
    for chunk in name.utf8_chunks() {
        for letter in chunk.valid().chars() {
            match byte_of(letter) {
                Some(_) => text.extend(letter.encode_utf8(&mut [0; 4]).bytes().map(escape)),
                None => text.push(letter),
            }
        }
        text.extend(chunk.invalid().iter().copied().map(escape));
    }
    text
}

fn escape(byte: u8) -> char {
    char::from_u32(ESCAPES_START + u32::from(byte)).unwrap_or(char::REPLACEMENT_CHARACTER)
}

/// The byte that a character encodes; `None` if the character is not an encoded byte.
fn byte_of(letter: char) -> Option<u8> {
    u8::try_from(u32::from(letter).checked_sub(ESCAPES_START)?).ok()
}

#[cfg(unix)]
fn from_bytes(bytes: Vec<u8>) -> OsString {
    std::os::unix::ffi::OsStringExt::from_vec(bytes)
}

/// On systems whose names are not bytes, an invalid name cannot be restored exactly.
#[cfg(windows)]
fn from_bytes(bytes: Vec<u8>) -> OsString {
    String::from_utf8_lossy(&bytes).into_owned().into()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn unicode_names_are_unchanged() {
        for name in ["", "dam.0001", "größe ∞", "\u{e000}\u{fffd}"] {
            assert_eq!(text_of_name(OsStr::new(name)), name);
            assert_eq!(name_of_text(name), name);
        }
    }

    #[cfg(unix)]
    #[test]
    fn non_unicode_names_round_trip() {
        use std::os::unix::ffi::OsStrExt;
        let names: [&[u8]; 6] = [
            b"gr\xf6\xdfe.1",
            b"gr\xfc\xdfe.1",
            b"\xff\xfe\x80",
            b"\xe2\x82", // the beginning of a character
            "\u{f7f6}".as_bytes(),
            b"\xf6\xef\x9f\xb6", // the byte, and its encoded form
        ];
        let texts = names.map(|name| text_of_name(OsStr::from_bytes(name)));
        for (index, (text, name)) in texts.iter().zip(names).enumerate() {
            assert_eq!(name_of_text(text).as_bytes(), name);
            assert!(!texts[..index].contains(text), "{text:?} twice");
        }
    }
}
