//! Raw `.xyz`: three 32-bit reals for each particle and nothing else, as splashsurf and its kin write them.
//!
//! ```text
//!   f32 x  f32 y  f32 z   f32 x  f32 y  f32 z   ..      12 bytes each, in the order of the machine that wrote them
//! ```
//!
//! There is no signature, so the name decides, and only where the content is no text: the `.xyz` of other programs is
//! a table of blanks, which [`crate::csv`] reads. Nor is there an order of bytes. Nearly every machine is
//! little-endian; a file whose numbers are then absurd and are not in the other order is taken to be big-endian, and
//! one whose numbers are absurd in both is not raw positions.

use crate::bytes::Endian;
use crate::data::ParticleFrame;
use crate::error::{Error, Place, Result};
use crate::limits::Limits;
use crate::number::{self, Number};
use crate::row::{FormatRow, ParticleInput};

/// The format as users know it, for errors.
const FORMAT: &str = "raw XYZ";

/// Bytes of a position.
const RECORD_BYTES: usize = 12;

/// Numbers that are looked at to tell their order.
const SAMPLE_COUNT: usize = 4096;

/// Reads raw positions.
///
/// # Errors
///
/// [`Error::Short`] where the last position is cut off, [`Error::Invalid`] for bytes that are no positions,
/// [`Error::TooLarge`] beyond `limits`.
pub fn read(bytes: &[u8], limits: &Limits) -> Result<ParticleFrame> {
    let count = bytes.len() / RECORD_BYTES;
    if count as u64 > limits.particle_count {
        let what = format!("{count} particles, more than the limit of {}", limits.particle_count);
        return Err(Error::too_large(FORMAT, what));
    }
    let endian = endian(bytes)?;
    if !bytes.len().is_multiple_of(RECORD_BYTES) {
        let place = Place::Offset((count * RECORD_BYTES) as u64);
        let rest = bytes.len() % RECORD_BYTES;
        return Err(Error::short(FORMAT, place, format!("expected a position of 12 bytes, found {rest}")));
    }
    let positions = number::positions(Number::F32.decode(bytes, endian)).unwrap_or_default();
    let notes = match endian {
        Endian::Little => Vec::new(),
        Endian::Big => vec!["The numbers were taken to be big-endian.".into()],
    };
    Ok(ParticleFrame { positions, attributes: Vec::new(), notes })
}

/// The order in which the first numbers are not absurd.
fn endian(bytes: &[u8]) -> Result<Endian> {
    let (words, _) = bytes.as_chunks::<4>();
    let words = &words[..words.len().min(SAMPLE_COUNT)];
    let absurd_count =
        |decode: fn([u8; 4]) -> f32| words.iter().filter(|&&word| is_absurd(decode(word))).count();
    let (little, big) = (absurd_count(f32::from_le_bytes), absurd_count(f32::from_be_bytes));
    // Some particles may well be lost to infinity.
    let is_good = |absurd: usize| 4 * absurd <= words.len();
    match (is_good(little), is_good(big)) {
        (true, _) if little <= big || !is_good(big) => Ok(Endian::Little),
        (_, true) => Ok(Endian::Big),
        _ => {
            let what =
                "expected 32-bit reals, three for each particle; these bytes are none that a position has";
            Err(Error::invalid(FORMAT, Place::Offset(0), what))
        }
    }
}

/// Whether no position is like this: not finite, or nearer to zero or farther from it than any scene.
fn is_absurd(value: f32) -> bool {
    !(value == 0.0 || (1e-20..1e12).contains(&value.abs()))
}

/// What the table of formats says of it.
pub(crate) static ROW: FormatRow =
    FormatRow { particles: Some(ParticleInput::new(read)), ..FormatRow::new(FORMAT, &["xyz"]) };

#[cfg(test)]
mod tests {
    use super::*;
    use crate::data::Positions;

    fn positions() -> Vec<[f32; 3]> {
        (0..50).map(|n| n as f32).map(|n| [n * 0.1, -n, 1000.0 / (n + 1.0)]).collect()
    }

    fn read_of(to_bytes: fn(f32) -> [u8; 4]) -> ParticleFrame {
        let bytes: Vec<u8> = positions().into_flattened().into_iter().flat_map(to_bytes).collect();
        read(&bytes, &Limits::default()).unwrap()
    }

    #[test]
    fn both_orders_are_read() {
        let little = read_of(f32::to_le_bytes);
        assert_eq!((little.positions, little.notes.len()), (Positions::F32(positions()), 0));
        let big = read_of(f32::to_be_bytes);
        assert_eq!((big.positions, big.notes.len()), (Positions::F32(positions()), 1));
    }

    #[test]
    fn what_is_wrong_is_told() {
        let bytes: Vec<u8> = [0.5f32; 6].iter().flat_map(|value| value.to_le_bytes()).collect();
        let error = read(&bytes[..23], &Limits::default()).unwrap_err();
        assert!(error.is_short() && error.to_string().contains("at byte 12"), "{error}");
        let error = read(&[0xff; 24], &Limits::default()).unwrap_err().to_string();
        assert!(error.contains("expected 32-bit reals"), "{error}");
        let limits = Limits { particle_count: 1, ..Limits::default() };
        assert!(matches!(read(&bytes, &limits), Err(Error::TooLarge { .. })));
    }
}
