//! Raw `.xyz`: three 32-bit floats per particle and nothing else, as written by splashsurf and similar
//! programs.
//!
//! ```text
//!   f32 x  f32 y  f32 z   f32 x  f32 y  f32 z   ..      12 bytes each, in the writer's byte order
//! ```
//!
//! The format has no signature, so the extension decides, but only if the content is not text: the `.xyz`
//! files of other programs are space-separated tables, which [`crate::csv`] reads. The byte order is not
//! recorded either. Nearly all machines are little-endian. If the numbers are absurd as little-endian and
//! plausible as big-endian, the file is read as big-endian; if they are absurd in both, the file does not
//! contain raw positions.

use crate::bytes::Endian;
use crate::data::ParticleFrame;
use crate::error::{Error, Position, Result};
use crate::limits::Limits;
use crate::number::{self, NumberType};
use crate::row::{FormatRow, ParticleReader};

/// The format's name in errors.
const FORMAT: &str = "raw XYZ";

/// Bytes per position.
const RECORD_BYTES: usize = 12;

/// Number of values examined to determine the byte order.
const SAMPLE_COUNT: usize = 4096;

/// Reads raw positions.
///
/// # Errors
///
/// [`Error::Truncated`] if the last position is truncated, [`Error::Invalid`] if the bytes are not positions,
/// [`Error::TooLarge`] beyond `limits`.
pub fn read(bytes: &[u8], limits: &Limits) -> Result<ParticleFrame> {
    let count = bytes.len() / RECORD_BYTES;
    limits.check_particles(FORMAT, count as u64)?;
    let endian = endian(bytes)?;
    if !bytes.len().is_multiple_of(RECORD_BYTES) {
        let position = Position::Offset((count * RECORD_BYTES) as u64);
        let rest = bytes.len() % RECORD_BYTES;
        return Err(Error::truncated(
            FORMAT,
            position,
            format!("expected a position of 12 bytes, found {rest}"),
        ));
    }
    let positions = number::positions(NumberType::F32.decode(bytes, endian)).unwrap_or_default();
    let notes = match endian {
        Endian::Little => Vec::new(),
        Endian::Big => {
            vec!["read as big-endian, because more of the numbers are plausible in this byte order".into()]
        }
    };
    Ok(ParticleFrame { positions, attributes: Vec::new(), notes })
}

/// The byte order in which the first numbers are not absurd.
fn endian(bytes: &[u8]) -> Result<Endian> {
    let (words, _) = bytes.as_chunks::<4>();
    let words = &words[..words.len().min(SAMPLE_COUNT)];
    let absurd_count =
        |decode: fn([u8; 4]) -> f32| words.iter().filter(|&&word| is_absurd(decode(word))).count();
    let (little, big) = (absurd_count(f32::from_le_bytes), absurd_count(f32::from_be_bytes));
    // Up to a quarter of the numbers may be absurd, because some particles may have diverged to infinity.
    let is_good = |absurd: usize| 4 * absurd <= words.len();
    match (is_good(little), is_good(big)) {
        (true, _) if little <= big || !is_good(big) => Ok(Endian::Little),
        (_, true) => Ok(Endian::Big),
        _ => {
            let what = "expected three 32-bit floats per particle; these bytes are not plausible positions in either byte order";
            Err(Error::invalid(FORMAT, Position::Offset(0), what))
        }
    }
}

/// Whether a number is implausible in a position: not finite, or of a magnitude that occurs in no scene.
fn is_absurd(value: f32) -> bool {
    !(value == 0.0 || (1e-20..1e12).contains(&value.abs()))
}

/// The row in the table of formats.
pub(crate) static ROW: FormatRow =
    FormatRow { particles: Some(ParticleReader::new(read)), ..FormatRow::new(FORMAT, &["xyz"]) };

#[cfg(test)]
mod tests {
    use super::*;
    use crate::data::FilePositions;

    fn positions() -> Vec<[f32; 3]> {
        (0..50).map(|n| n as f32).map(|n| [n * 0.1, -n, 1000.0 / (n + 1.0)]).collect()
    }

    fn read_of(to_bytes: fn(f32) -> [u8; 4]) -> ParticleFrame {
        let bytes: Vec<u8> = positions().into_flattened().into_iter().flat_map(to_bytes).collect();
        read(&bytes, &Limits::default()).unwrap()
    }

    #[test]
    fn both_byte_orders_are_read() {
        let little = read_of(f32::to_le_bytes);
        assert_eq!((little.positions, little.notes.len()), (FilePositions::F32(positions()), 0));
        let big = read_of(f32::to_be_bytes);
        assert_eq!((big.positions, big.notes.len()), (FilePositions::F32(positions()), 1));
    }

    #[test]
    fn truncated_and_implausible_files_are_errors() {
        let bytes: Vec<u8> = [0.5f32; 6].iter().flat_map(|value| value.to_le_bytes()).collect();
        let error = read(&bytes[..23], &Limits::default()).unwrap_err();
        assert!(error.is_truncated() && error.to_string().contains("at byte 12"), "{error}");
        let error = read(&[0xff; 24], &Limits::default()).unwrap_err().to_string();
        assert!(error.contains("expected three 32-bit floats"), "{error}");
        let limits = Limits { particle_count: 1, ..Limits::default() };
        assert!(matches!(read(&bytes, &limits), Err(Error::TooLarge { .. })));
    }
}
