//! Houdini's geometry from version 12 on: `.bgeo`, `.geo` and `.bgeo.sc`.
//!
//! One document in JSON, as text or in a binary form of Houdini's own, which may be packed in blocks:
//!
//! ```text
//!   .geo        [ "fileversion", "19.5", "pointcount", 10, .. ]          text
//!   .bgeo       7f 4e 53 4a 62 5b ..                                     tokens of a byte and what belongs to it
//!   .bgeo.sc    scf1 .. (the above, in Blosc frames) .. index 1fcs       see `container`
//! ```
//!
//! Most of its objects are flat lists of keys and values. Of all that, particles are the point attributes:
//!
//! ```text
//!   ["pointcount", 10, "attributes", ["pointattributes", [
//!       [["type", "numeric", "name", "P"], ["size", 3, "storage", "fpreal32", "values", [..]]],
//!       [["type", "string", "name", "part"], ["size", 1, "strings", ["a", "b"], "indices", [..]]], ..]],
//!    "primitives", [[["type", "Part"], ..]]]
//! ```
//!
//! Points without primitives are particles, and so are those of particle systems. The points of anything else are
//! corners of polygons, or mark where packed geometry or a volume stands: such files are refused.
//!
//! The layout was established from files of Houdini 13 to 18.5 and their text twins.

mod attributes;
mod binary;
mod container;
mod geometry;
mod text;
mod tokens;
mod values;

use crate::data::ParticleFrame;
use crate::error::Result;
use crate::limits::Limits;
use crate::row::{FormatRow, ParticleInput};

use binary::{Binary, is_binary};
use text::Text;
use tokens::{Lexer, Walk};

/// The format as users know it, for errors.
const FORMAT: &str = "Houdini geometry";

/// Reads the points of binary geometry.
///
/// # Errors
///
/// [`crate::Error::Short`] where the document ends too soon, [`crate::Error::Invalid`] where it is malformed or
/// contradicts itself, [`crate::Error::Unsupported`] where the points are no particles,
/// [`crate::Error::TooLarge`] beyond `limits`.
pub fn read_binary(bytes: &[u8], limits: &Limits) -> Result<ParticleFrame> {
    geometry::read(Walk::new(Lexer::Binary(Binary::new(bytes)?)), limits)
}

/// Reads the points of geometry as text.
///
/// # Errors
///
/// Those of [`read_binary`].
pub fn read_text(bytes: &[u8], limits: &Limits) -> Result<ParticleFrame> {
    geometry::read(Walk::new(Lexer::Text(Text::new(bytes))), limits)
}

/// Reads the points of geometry that is packed in blocks.
///
/// # Errors
///
/// Those of [`read_binary`], with offsets counted after decompression, and those of the container.
pub fn read_container(bytes: &[u8], limits: &Limits) -> Result<ParticleFrame> {
    let unpacked = container::unpack(bytes, limits)?;
    match is_binary(&unpacked) {
        true => read_binary(&unpacked, limits),
        false => read_text(&unpacked, limits),
    }
}

/// What the table of formats says of binary files. The second signature is that of big-endian machines.
pub(crate) static BINARY: FormatRow = FormatRow {
    signatures: &[b"\x7fNSJb", b"\x7fbJSN"],
    beginnings: &[b"\x7fNSJb", b"\x7fbJSN"],
    particles: Some(ParticleInput::complete_by_reading(read_binary)),
    ..FormatRow::new("Houdini geometry (binary JSON)", &["bgeo"])
};

/// What the table of formats says of text.
pub(crate) static TEXT: FormatRow = FormatRow {
    particles: Some(ParticleInput::complete_by_reading(read_text)),
    ..FormatRow::new("Houdini geometry (JSON text)", &["geo"])
};

/// What the table of formats says of compressed files.
pub(crate) static CONTAINER: FormatRow = FormatRow {
    signatures: &[b"scf1"],
    beginnings: &[b"scf1"],
    particles: Some(ParticleInput::complete_by_reading(read_container)),
    ..FormatRow::new("Houdini geometry (.sc, Blosc-compressed)", &["bgeo.sc", "geo.sc"])
};
