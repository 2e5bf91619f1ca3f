//! Unpacks a file that another format is packed in with Zstandard.
//!
//! As with gzip, the result is produced piece by piece and abandoned at the first piece beyond the
//! limits. A frame also names its window, which a decoder must hold: one that is much larger than the file
//! needs is refused before it is allocated.
//!
//! ```text
//!   28 b5 2f fd   a frame: header, blocks, perhaps a checksum         decoded
//!   5? 2a 4d 18   a skippable frame: u32 length, then as many bytes   skipped
//! ```

use std::io::{ErrorKind, Read};

use ruzstd::decoding::{FrameDecoder, StreamingDecoder};

use crate::error::{Error, Place, Result};
use crate::limits::Limits;

const FORMAT: &str = "Zstandard";

const MAGIC: [u8; 4] = [0x28, 0xb5, 0x2f, 0xfd];

/// What skippable frames begin with, after a byte from 0x50 to 0x5f.
const SKIPPABLE: [u8; 3] = [0x2a, 0x4d, 0x18];

/// Nothing comes out of a block before its end. The first ends before here: the head of its frame and its own, 128 KiB,
/// and room for a frame that is skipped.
pub(crate) const FIRST_BLOCK_BYTES_MAX: u64 = 132 << 10;

/// Bytes unpacked between two looks at the limits.
const PIECE_BYTES: usize = 256 << 10;

/// The largest window of a small file: more than the levels up to 19 ask for.
const WINDOW_BYTES: u64 = 16 << 20;

/// Whether the file is packed with Zstandard.
pub(crate) fn is_zstd(bytes: &[u8]) -> bool {
    bytes.starts_with(&MAGIC) || is_skippable(bytes)
}

fn is_skippable(bytes: &[u8]) -> bool {
    bytes.first().is_some_and(|byte| byte >> 4 == 5) && bytes[1..].starts_with(&SKIPPABLE)
}

/// Unpacks all frames of the file, one after the other.
///
/// # Errors
/// `Short` if it ends too soon and `Invalid` if it is damaged, with the offset in the packed file;
/// `TooLarge` beyond `decompressed_bytes` or `decompression_ratio`, and for too large a window.
pub(crate) fn unpack(bytes: &[u8], limits: &Limits) -> Result<Vec<u8>> {
    let mut unpacked = Vec::new();
    let mut rest = bytes;
    while !rest.is_empty() {
        let at = bytes.len() - rest.len();
        if is_skippable(rest) {
            rest = after_skippable(rest, at)?;
        } else if rest.starts_with(&MAGIC) {
            rest = unpack_frame(bytes, at, limits, &mut unpacked)?;
        } else {
            let place = Place::Offset(at as u64);
            let what = "the compressed data is followed by something else";
            return Err(match MAGIC.starts_with(rest) || (rest.len() < 4 && rest[0] >> 4 == 5) {
                true => Error::short(FORMAT, place, what),
                false => Error::invalid(FORMAT, place, what),
            });
        }
    }
    Ok(unpacked)
}

/// What follows a skippable frame that begins at byte `at` of the file.
fn after_skippable(rest: &[u8], at: usize) -> Result<&[u8]> {
    let length =
        rest.get(4..8).map(|length| u32::from_le_bytes([length[0], length[1], length[2], length[3]]));
    length.and_then(|length| rest.get(8 + length as usize..)).ok_or_else(|| {
        Error::short(FORMAT, Place::Offset(at as u64), "the file ends within a frame that is skipped")
    })
}

/// Unpacks the frame at byte `at`, and returns what follows it.
fn unpack_frame<'a>(bytes: &'a [u8], at: usize, limits: &Limits, unpacked: &mut Vec<u8>) -> Result<&'a [u8]> {
    let mut decoder = decoder_of(bytes, at)?;
    loop {
        let before = unpacked.len();
        let outcome = decoder.by_ref().take(PIECE_BYTES as u64).read_to_end(unpacked);
        let consumed = bytes.len() - decoder.get_ref().len();
        limits.check_unpacked(FORMAT, unpacked.len() as u64, consumed as u64)?;
        if let Err(source) = outcome {
            return Err(damage(&source, consumed));
        }
        if unpacked.len() == before {
            check_sum(&decoder.decoder, consumed)?;
            return Ok(decoder.into_inner());
        }
    }
}

fn decoder_of(bytes: &[u8], at: usize) -> Result<StreamingDecoder<&[u8], FrameDecoder>> {
    use ruzstd::decoding::errors::FrameDecoderError::WindowSizeTooBig;
    let window_bytes_max = WINDOW_BYTES.saturating_add(2 * bytes.len() as u64);
    StreamingDecoder::new_with_max_window_size(&bytes[at..], window_bytes_max).map_err(|error| match error {
        WindowSizeTooBig { requested, max } => Error::too_large(
            FORMAT,
            format!(
                "a window of {requested} bytes, more than the {max} that a file of {} may have: \
                 pack it at a level of 19 or less",
                bytes.len()
            ),
        ),
        error => damage(&std::io::Error::other(error), at),
    })
}

fn check_sum(decoder: &FrameDecoder, consumed: usize) -> Result<()> {
    match (decoder.get_checksum_from_data(), decoder.get_calculated_checksum()) {
        (Some(expected), Some(found)) if expected != found => {
            let what = format!("the compressed data is damaged: checksum {found:08x}, not {expected:08x}");
            Err(Error::invalid(FORMAT, Place::Offset(consumed as u64), what))
        }
        _ => Ok(()),
    }
}

fn damage(source: &std::io::Error, consumed: usize) -> Error {
    let place = Place::Offset(consumed as u64);
    match is_end(source) {
        true => Error::short(FORMAT, place, "the compressed data ends too soon"),
        false => Error::invalid(FORMAT, place, format!("the compressed data is damaged: {source}")),
    }
}

/// Whether the end of the file is behind it all.
fn is_end(error: &std::io::Error) -> bool {
    if error.kind() == ErrorKind::UnexpectedEof {
        return true;
    }
    let mut cause: Option<&(dyn std::error::Error + 'static)> = error.get_ref().map(|inner| inner as _);
    while let Some(error) = cause {
        if let Some(io) = error.downcast_ref::<std::io::Error>() {
            return io.kind() == ErrorKind::UnexpectedEof || io.get_ref().is_some() && is_end(io);
        }
        cause = error.source();
    }
    false
}

/// Looks for damage in the first bytes without keeping what comes out of them.
///
/// # Errors
/// `Short`, `Invalid` and `TooLarge`, as from [`unpack`].
pub(crate) fn check_start(bytes: &[u8]) -> Result<()> {
    let at = frame_start(bytes)?;
    let mut start = decoder_of(bytes, at)?.take(crate::limits::RATIO_FREE_BYTES);
    let outcome = std::io::copy(&mut start, &mut std::io::sink());
    outcome.map(drop).map_err(|source| damage(&source, bytes.len() - start.get_ref().get_ref().len()))
}

/// Where the first frame that holds anything begins, or the last one, if none does.
fn frame_start(bytes: &[u8]) -> Result<usize> {
    let mut rest = bytes;
    loop {
        let at = bytes.len() - rest.len();
        if is_skippable(rest) {
            rest = after_skippable(rest, at)?;
            continue;
        }
        match after_empty(bytes, at) {
            Some(after) if !after.is_empty() => rest = after,
            _ => return Ok(at),
        }
    }
}

/// What follows the frame at byte `at`, if that holds nothing.
fn after_empty(bytes: &[u8], at: usize) -> Option<&[u8]> {
    let mut decoder = decoder_of(bytes, at).ok()?;
    let is_empty = matches!(decoder.read(&mut [0]), Ok(0));
    is_empty.then(|| decoder.into_inner())
}

/// The first bytes of the content, as many as can be had, at most `length`.
pub(crate) fn unpack_head(bytes: &[u8], length: usize) -> Vec<u8> {
    let mut head = Vec::new();
    if let Ok(decoder) = frame_start(bytes).and_then(|at| decoder_of(bytes, at)) {
        // What was unpacked before an error is in `head`, and is all that is asked for.
        let _ = decoder.take(length as u64).read_to_end(&mut head);
    }
    head
}

#[cfg(test)]
mod tests {
    use super::*;
    use ruzstd::encoding::{CompressionLevel, compress_to_vec};

    fn packed(bytes: &[u8]) -> Vec<u8> {
        compress_to_vec(bytes, CompressionLevel::Fastest)
    }

    #[test]
    fn frames_are_joined_and_others_skipped() {
        let skipped = [&[0x5a, 0x2a, 0x4d, 0x18, 3, 0, 0, 0][..], b"abc"].concat();
        let file = [&skipped[..], &packed(b"one "), &skipped, &packed(b"two")].concat();
        assert!(is_zstd(&file));
        assert_eq!(unpack(&file, &Limits::default()).unwrap(), b"one two");
        assert_eq!(unpack_head(&file, 2), b"on");
        check_start(&file).unwrap();
        let behind_empty = [&packed(b"")[..], &skipped, &packed(b""), &packed(b"one ")].concat();
        assert_eq!(unpack_head(&behind_empty, 9), b"one ");
        assert_eq!(unpack_head(&packed(b""), 9), b"");
        let error = unpack(&[&file[..], b"more"].concat(), &Limits::default()).unwrap_err();
        assert!(!error.is_short() && error.to_string().contains("followed by something else"), "{error}");
    }

    #[test]
    fn damage_is_told() {
        let file = packed(&(0..5000).flat_map(|n: u32| n.to_le_bytes()).collect::<Vec<u8>>());
        for length in 1..file.len() {
            if length < MAGIC.len() {
                continue;
            }
            let error = unpack(&file[..length], &Limits::default()).unwrap_err();
            assert!(error.is_short(), "{length} of {}: {error}", file.len());
        }
        let mut damaged = file.clone();
        let last = damaged.len() - 1;
        damaged[last] ^= 1;
        let error = unpack(&damaged, &Limits::default()).unwrap_err().to_string();
        assert!(error.contains("damaged: checksum"), "{error}");
    }

    #[test]
    fn bombs_are_abandoned_early() {
        let bomb = packed(&vec![0; 64 << 20]);
        assert!(matches!(unpack(&bomb, &Limits::default()), Err(Error::TooLarge { .. })));
        // A frame of one empty block that asks for a window of 2 GiB.
        let window = [&MAGIC[..], &[0x00, 21 << 3, 1, 0, 0]].concat();
        let error = unpack(&window, &Limits::default()).unwrap_err().to_string();
        assert!(error.contains("a window of 2147483648 bytes"), "{error}");
    }
}
