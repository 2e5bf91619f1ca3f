//! Reads the vertices of an OBJ file without faces as particles, as programs for modelling and scanning save point
//! clouds.
//!
//! ```text
//!   v 0.1 0.2 0.3                  a particle
//!   v 0.1 0.2 0.3 1 0.5 0          with a colour: all of them have one, or it is left out, with a note
//!   p 1 2                          ignored, as are normals and names
//! ```

use crate::core::columns::with_role;
use crate::core::data::{AttributeRole, FilePositions, ParticleFrame, Values};
use crate::core::error::{Error, Position, Result};
use crate::core::limits::Limits;
use crate::core::text::open_end_note;
use crate::core::text::{Lines, excerpt, parse_number};
use crate::meshes::obj::FORMAT;

/// Whether one of these lines is a face or a line between vertices.
pub(crate) fn has_faces(text: &[u8]) -> bool {
    Lines::new(text).any(|line| joins_vertices(keyword(line)))
}

fn joins_vertices(keyword: &[u8]) -> bool {
    matches!(keyword, b"f" | b"l" | b"fo")
}

fn keyword(line: &[u8]) -> &[u8] {
    words(line).next().unwrap_or_default()
}

fn words(line: &[u8]) -> impl Iterator<Item = &[u8]> {
    line.split(u8::is_ascii_whitespace).filter(|word| !word.is_empty())
}

/// Reads the vertices.
///
/// # Errors
/// [`Error::Unsupported`] for a mesh; [`Error::Invalid`], with the line, if a vertex has fewer than three numbers, or
/// [`Error::Truncated`] if the file ends there; [`Error::TooLarge`] beyond `limits`.
pub(crate) fn read(bytes: &[u8], limits: &Limits) -> Result<ParticleFrame> {
    let mut positions: Vec<[f64; 3]> = Vec::new();
    let mut colors: Vec<f32> = Vec::new();
    let mut lines = Lines::new(bytes);
    while let Some(line) = lines.next() {
        let keyword = keyword(line);
        if joins_vertices(keyword) {
            return Err(Error::unsupported(FORMAT, crate::core::row::MESH_REFUSAL));
        }
        if keyword != b"v" {
            continue;
        }
        let [x, y, z, color @ ..] = vertex(line).map_err(|word| {
            let found = word.map_or("the end of the line".into(), |word| format!("\"{}\"", excerpt(word)));
            let (at, what) = (
                Position::Line(lines.number()),
                format!("expected three numbers of a vertex, found {found}"),
            );
            if lines.was_ended() {
                Error::invalid(FORMAT, at, what)
            } else {
                Error::truncated(FORMAT, at, what)
            }
        })?;
        positions.push([x, y, z]);
        limits.check_particles(FORMAT, positions.len() as u64)?;
        #[expect(clippy::cast_possible_truncation, reason = "colours need no more")]
        colors.extend(color.iter().filter(|channel| !channel.is_nan()).map(|&channel| channel as f32));
    }
    let mut frame = ParticleFrame { positions: FilePositions::F64(positions), ..ParticleFrame::default() };
    let colors_fit = colors.is_empty() || colors.len() == 3 * frame.positions.len();
    if !colors.is_empty() && colors_fit {
        frame.attributes.push(with_role("color".into(), 3, Some(AttributeRole::Color), Values::F32(colors)));
    }
    if !colors_fit {
        frame.notes.push("the colours are left out: only some of the vertices have one".into());
    }
    frame.notes.extend(open_end_note(bytes).filter(|_| !frame.positions.is_empty()));
    Ok(frame)
}

/// The position of a vertex, and its colour, or NaN. The error is the word that is not a number, if there is one.
fn vertex(line: &[u8]) -> std::result::Result<[f64; 6], Option<&[u8]>> {
    let mut words = words(line).skip(1);
    let mut number = || {
        let word = words.next().ok_or(None)?;
        let number = parse_number::<f64>(word).filter(|(_, length)| *length == word.len());
        number.map(|(value, _)| value).ok_or(Some(word))
    };
    let [x, y, z] = [number()?, number()?, number()?];
    // A fourth number alone is a weight.
    let color = (|| Some([number().ok()?, number().ok()?, number().ok()?]))();
    let [r, g, b] = color.unwrap_or([f64::NAN; 3]);
    Ok([x, y, z, r, g, b])
}
