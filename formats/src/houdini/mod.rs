//! Houdini's geometry since version 12: `.bgeo`, `.geo` and `.bgeo.sc`.
//!
//! A JSON document, as text or in Houdini's own binary encoding. Both can be compressed in blocks:
//!
//! ```text
//!   .geo        [ "fileversion", "19.5", "pointcount", 10, .. ]          text
//!   .bgeo       7f 4e 53 4a 62 5b ..                                     tokens: a type byte and a payload
//!   .bgeo.sc    scf1 .. (the above, in Blosc frames) .. index 1fcs       see `container`
//! ```
//!
//! Most objects of the document are flat lists of keys and values. Only the point attributes and the point
//! groups describe particles:
//!
//! ```text
//!   ["pointcount", 10, "attributes", ["pointattributes", [
//!       [["type", "numeric", "name", "P"], ["size", 3, "storage", "fpreal32", "values", [..]]],
//!       [["type", "string", "name", "part"], ["size", 1, "strings", ["a", "b"], "indices", [..]]], ..]],
//!    "primitives", [[["type", "Part"], ..]],
//!    "pointgroups", [[["name", "fluid"], ["selection", [..]]], ..]]
//! ```
//!
//! Points without primitives are particles, and so are the points of particle systems. All other points are
//! corners of polygons, or locations of packed geometry or volumes; the reader rejects files with such
//! points.
//!
//! The layout was derived from files of Houdini 13 to 18.5 and their text versions.

mod attributes;
mod binary;
mod container;
mod geometry;
mod groups;
mod text;
mod token;
mod tokens;
mod values;

use crate::data::ParticleFrame;
use crate::error::Result;
use crate::limits::Limits;
use crate::row::{FormatRow, ParticleInput};

use binary::{Binary, is_binary};
use text::TextTokens;
use tokens::{Lexer, TokenWalk};

/// The format's name in errors.
const FORMAT: &str = "Houdini geometry";

/// Reads the points of binary geometry.
///
/// # Errors
///
/// [`crate::Error::Truncated`] if the document ends too early, [`crate::Error::Invalid`] if it is malformed
/// or inconsistent, [`crate::Error::Unsupported`] if the points are not particles, [`crate::Error::TooLarge`]
/// beyond `limits`.
pub fn read_binary(bytes: &[u8], limits: &Limits) -> Result<ParticleFrame> {
    geometry::read(TokenWalk::new(Lexer::Binary(Binary::new(bytes)?)), limits)
}

/// Reads the points of geometry in text form.
///
/// # Errors
///
/// Those of [`read_binary`].
pub fn read_text(bytes: &[u8], limits: &Limits) -> Result<ParticleFrame> {
    geometry::read(TokenWalk::new(Lexer::Text(TextTokens::new(bytes))), limits)
}

/// Reads the points of geometry compressed in blocks.
///
/// # Errors
///
/// Those of [`read_binary`], with offsets into the decompressed data, and those of the container.
pub fn read_container(bytes: &[u8], limits: &Limits) -> Result<ParticleFrame> {
    let decompressed = container::decompress(bytes, limits)?;
    match is_binary(&decompressed) {
        true => read_binary(&decompressed, limits),
        false => read_text(&decompressed, limits),
    }
}

/// The row of binary files in the table of formats. The second signature is that of big-endian machines.
pub(crate) static BINARY: FormatRow = FormatRow {
    signatures: &[b"\x7fNSJb", b"\x7fbJSN"],
    beginnings: &[b"\x7fNSJb", b"\x7fbJSN"],
    particles: Some(ParticleInput::needs_reading(read_binary)),
    ..FormatRow::new("Houdini geometry (binary JSON)", &["bgeo"])
};

/// The row of text files in the table of formats.
pub(crate) static TEXT: FormatRow = FormatRow {
    particles: Some(ParticleInput::needs_reading(read_text)),
    ..FormatRow::new("Houdini geometry (JSON text)", &["geo"])
};

/// The row of compressed files in the table of formats.
pub(crate) static CONTAINER: FormatRow = FormatRow {
    signatures: &[b"scf1"],
    beginnings: &[b"scf1"],
    particles: Some(ParticleInput::needs_reading(read_container)),
    ..FormatRow::new("Houdini geometry (.sc, Blosc-compressed)", &["bgeo.sc", "geo.sc"])
};
