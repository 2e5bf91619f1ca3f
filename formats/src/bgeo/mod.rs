//! Classic BGEO, version 5: the geometry file of Houdini before 12, which SPlisHSPlasH, partio and
//! splashsurf still write.
//!
//! Big-endian throughout, nothing is padded:
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
//! Everything that particles need comes before the first primitive, so reading stops after the
//! points. Houdini 12 and later write another format under the same extension; it begins with
//! `7f 4e 53 4a 62` or `[`. Files are often compressed by gzip as a whole, even when the name does
//! not say so: whoever opens the file has to remove that first.
//!
//! The layout was established from files of the named programs and from partio's own reader.

mod header;
mod read;
mod text;
mod write;

pub use header::{AttributeHeader, AttributeKind, Header, header};
pub use read::read;
pub use text::read_text;
pub use write::write;

pub(crate) use header::header_within;
pub(crate) use read::{gather_batch, records};

/// The format as users know it, for errors.
const FORMAT: &str = "classic BGEO";

/// The first five bytes.
const MAGIC: &[u8; 5] = b"BgeoV";

/// The only version of the classic format found in use.
const VERSION: i32 = 5;

/// What closes a file: no further section, end.
const TRAILER: [u8; 2] = [0x00, 0xff];

/// Words of a point record before its attributes: x, y, z, w.
const POSITION_WORDS: usize = 4;

/// The nearest 32-bit real; what is beyond them becomes infinite.
#[expect(clippy::cast_possible_truncation, reason = "the format holds 32-bit reals")]
fn narrow(value: f64) -> f32 {
    value as f32
}
