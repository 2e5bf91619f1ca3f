//! Classic BGEO, version 5: the geometry format of Houdini before 12, which SPlisHSPlasH, partio and
//! splashsurf still write.
//!
//! Big-endian throughout, without padding:
//!
//! ```text
//!   0   "Bgeo" 'V' i32 5
//!   9   i32 × 8: points, primitives, point groups, primitive groups,
//!                point, vertex, primitive and detail attributes
//!   41  point attribute dictionary: name, size, type, defaults or strings, for each
//!       point records                  x y z w  Cd Cd Cd  v v v  id        f32 x y z w, then
//!                                      x y z w  Cd Cd Cd  v v v  id        `size` words for
//!                                      ..                                  each attribute
//!       (primitives, detail attributes, groups: not read)
//!       00 ff
//! ```
//!
//! All particle data comes before the first primitive, so reading stops after the points. Houdini 12 and
//! later write another format with the same extension, which starts with `7f 4e 53 4a 62` or `[`. Files are
//! often gzip-compressed as a whole, even if their name does not show it; the caller must decompress them
//! first.
//!
//! The layout was derived from files of the named programs and from partio's own reader.

mod header;
mod read;
mod text;
mod write;

pub use header::{AttributeHeader, AttributeKind, BgeoHeader, header};
pub use read::read;
pub use text::read_text;
pub use write::write;

use header::header_within;
use read::records;

use crate::error::Result;
use crate::row::{Completeness, HeadCheck, at_least, exactly};
use crate::row::{FormatRow, ParticleInput};

/// The format's name in errors.
const FORMAT: &str = "classic BGEO";

/// The first five bytes.
const MAGIC: &[u8; 5] = b"BgeoV";

/// The only version of the classic format found in use.
const VERSION: i32 = 5;

/// The last two bytes of a file: no further section (00), end of the file (ff).
const TRAILER: [u8; 2] = [0x00, 0xff];

/// Words of a point record before its attributes: x, y, z, w.
const POSITION_WORDS: usize = 4;

/// The nearest 32-bit float; values beyond the range become infinite.
#[expect(clippy::cast_possible_truncation, reason = "the format has 32-bit floats")]
fn narrow(value: f64) -> f32 {
    value as f32
}

/// The row of the binary form in the table of formats.
pub(crate) static BINARY: FormatRow = FormatRow {
    signatures: &[b"Bgeo"],
    beginnings: &[MAGIC],
    particles: Some(ParticleInput {
        completeness,
        find_records: Some(|head, file_bytes, file, limits| {
            let header = header_within(head, limits)?;
            let rest = match file_bytes.checked_sub(header.expected_bytes) {
                Some(0) => crate::records::read(file, header.points_end()..file_bytes),
                _ => Ok(Vec::new()),
            };
            Ok(rest.and_then(|rest| records(&header, file_bytes, &rest).map(Some)))
        }),
        ..ParticleInput::new(read)
    }),
    ..FormatRow::new(FORMAT, &["bgeo", "bhclassic"])
};

/// The row of the text form in the table of formats.
pub(crate) static TEXT: FormatRow = FormatRow {
    signatures: &[b"PGEOMETRY"],
    beginnings: &[b"PGEOMETRY"],
    particles: Some(ParticleInput::new(read_text)),
    ..FormatRow::new("classic Houdini GEO (text)", &["geo", "hclassic"])
};

/// The completeness of a file according to its header.
fn completeness(head: &[u8], file_bytes: u64) -> Result<HeadCheck> {
    let header = header(head)?;
    Ok(HeadCheck::Known(match header.point_count {
        0 => Completeness::Unknown,
        _ if header.expected_bytes_is_exact => exactly(header.expected_bytes, file_bytes),
        _ => at_least(header.expected_bytes, file_bytes, Completeness::NeedsReading),
    }))
}
