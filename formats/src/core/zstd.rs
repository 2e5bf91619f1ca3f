//! Decompresses Zstandard files.
//!
//! As with gzip, the output is produced in chunks, and decompression stops at the first chunk that exceeds
//! the limits. A frame also declares the size of its window, which a decoder must allocate: a window much
//! larger than the file needs is rejected before allocation.
//!
//! ```text
//!   28 b5 2f fd   a frame: header, blocks, optional checksum          decoded
//!   5? 2a 4d 18   a skippable frame: u32 length, then its bytes       skipped
//! ```

use std::io::{ErrorKind, Read};

use ruzstd::decoding::{FrameDecoder, StreamingDecoder};

use crate::core::error::{Error, Position, Result};
use crate::core::limits::Limits;

const FORMAT: &str = "Zstandard";

const MAGIC: [u8; 4] = [0x28, 0xb5, 0x2f, 0xfd];

/// The first bytes of skippable frames, after a byte from 0x50 to 0x5f.
const SKIPPABLE: [u8; 3] = [0x2a, 0x4d, 0x18];

/// The first block ends within this many bytes: a skippable frame of up to about 4 KiB, the headers of the
/// frame and of the block, and at most 128 KiB of data. A decoder yields nothing before the end of a block.
pub(crate) const FIRST_BLOCK_BYTES_MAX: u64 = 132 << 10;

/// Bytes decompressed between checks of the limits.
const PIECE_BYTES: usize = 256 << 10;

/// The largest window that is accepted for a small file. Compression levels up to 19 need less.
const WINDOW_BYTES: u64 = 16 << 20;

/// Whether the file is compressed with Zstandard.
pub(crate) fn is_zstd(bytes: &[u8]) -> bool {
    bytes.starts_with(&MAGIC) || is_skippable(bytes)
}

fn is_skippable(bytes: &[u8]) -> bool {
    bytes.first().is_some_and(|byte| byte >> 4 == 5) && bytes[1..].starts_with(&SKIPPABLE)
}

/// Decompresses all frames of the file and concatenates them.
///
/// # Errors
/// `Truncated` if the file ends too early and `Invalid` if it is damaged, with the offset in the compressed
/// file; `MemoryLimit` beyond `memory_bytes`, and `TooLarge` beyond `decompression_ratio` or if the window is too large.
pub(crate) fn decompress(decompressed: &mut Vec<u8>, bytes: &[u8], limits: &Limits) -> Result<()> {
    let mut rest = bytes;
    while !rest.is_empty() {
        let at = bytes.len() - rest.len();
        if is_skippable(rest) {
            rest = after_skippable(rest, at)?;
        } else if rest.starts_with(&MAGIC) {
            rest = decompress_frame(bytes, at, limits, decompressed)?;
        } else {
            let position = Position::Offset(at as u64);
            let what = "the compressed data is followed by other bytes";
            return Err(if MAGIC.starts_with(rest) || (rest.len() < 4 && rest[0] >> 4 == 5) {
                Error::truncated(FORMAT, position, what)
            } else {
                Error::invalid(FORMAT, position, what)
            });
        }
    }
    Ok(())
}

/// The bytes after a skippable frame that starts at byte `at` of the file.
fn after_skippable(rest: &[u8], at: usize) -> Result<&[u8]> {
    let length =
        rest.get(4..8).map(|length| u32::from_le_bytes([length[0], length[1], length[2], length[3]]));
    length.and_then(|length| rest.get(8 + length as usize..)).ok_or_else(|| {
        Error::truncated(FORMAT, Position::Offset(at as u64), "the file ends within a skippable frame")
    })
}

/// Decompresses the frame at byte `at`, and returns the bytes after it.
fn decompress_frame<'a>(
    bytes: &'a [u8],
    at: usize,
    limits: &Limits,
    decompressed: &mut Vec<u8>,
) -> Result<&'a [u8]> {
    let mut decoder = decoder_of(bytes, at)?;
    loop {
        let before = decompressed.len();
        let outcome = decoder.by_ref().take(PIECE_BYTES as u64).read_to_end(decompressed);
        let consumed = bytes.len() - decoder.get_ref().len();
        limits.check_decompressed(FORMAT, decompressed.len() as u64, consumed as u64)?;
        if let Err(source) = outcome {
            return Err(damage(&source, consumed));
        }
        if decompressed.len() == before {
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
                "the window of {requested} bytes exceeds the limit of {max} bytes for a file of {} bytes: \
                 compress the file at level 19 or lower",
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
            Err(Error::invalid(FORMAT, Position::Offset(consumed as u64), what))
        }
        _ => Ok(()),
    }
}

fn damage(source: &std::io::Error, consumed: usize) -> Error {
    let position = Position::Offset(consumed as u64);
    if is_end(source) {
        Error::truncated(FORMAT, position, "the compressed data ends too early")
    } else {
        Error::invalid(FORMAT, position, format!("the compressed data is damaged: {source}"))
    }
}

/// Whether the cause of an error is the end of the file.
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

/// Checks the first bytes for damage without keeping the decompressed data.
///
/// # Errors
/// `Truncated`, `Invalid` and `TooLarge`, as from [`decompress`].
pub(crate) fn check_start(bytes: &[u8]) -> Result<()> {
    let at = frame_start(bytes)?;
    let mut start = decoder_of(bytes, at)?.take(crate::core::limits::RATIO_FREE_BYTES);
    let outcome = std::io::copy(&mut start, &mut std::io::sink());
    outcome.map(drop).map_err(|source| damage(&source, bytes.len() - start.get_ref().get_ref().len()))
}

/// The offset of the first frame with content, or of the last frame if all frames are empty.
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

/// The bytes after the frame at byte `at`, if that frame is empty.
fn after_empty(bytes: &[u8], at: usize) -> Option<&[u8]> {
    let mut decoder = decoder_of(bytes, at).ok()?;
    let is_empty = matches!(decoder.read(&mut [0]), Ok(0));
    is_empty.then(|| decoder.into_inner())
}

/// Decompresses the first bytes of the content: at most `length`, or fewer if the input ends or is damaged.
pub(crate) fn decompress_head(bytes: &[u8], length: usize) -> Vec<u8> {
    let mut head = Vec::new();
    if let Ok(decoder) = frame_start(bytes).and_then(|at| decoder_of(bytes, at)) {
        // On an error, `head` keeps the bytes decompressed before it, which is all that the caller needs.
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

    fn decompress(bytes: &[u8], limits: &Limits) -> Result<Vec<u8>> {
        crate::Codec::Zstd.decompress(bytes, limits)
    }

    #[test]
    fn zstd_frames_are_concatenated_and_skippable_ones_ignored() {
        let skipped = [&[0x5a, 0x2a, 0x4d, 0x18, 3, 0, 0, 0][..], b"abc"].concat();
        let file = [&skipped[..], &packed(b"one "), &skipped, &packed(b"two")].concat();
        assert!(is_zstd(&file));
        assert_eq!(decompress(&file, &Limits::default()).unwrap(), b"one two");
        assert_eq!(decompress_head(&file, 2), b"on");
        check_start(&file).unwrap();
        let behind_empty = [&packed(b"")[..], &skipped, &packed(b""), &packed(b"one ")].concat();
        assert_eq!(decompress_head(&behind_empty, 9), b"one ");
        assert_eq!(decompress_head(&packed(b""), 9), b"");
        let error = decompress(&[&file[..], b"more"].concat(), &Limits::default()).unwrap_err();
        assert!(!error.is_truncated() && error.to_string().contains("followed by other bytes"), "{error}");
    }

    #[test]
    fn damage_is_reported() {
        let file = packed(&(0..5000).flat_map(|n: u32| n.to_le_bytes()).collect::<Vec<u8>>());
        for length in 1..file.len() {
            if length < MAGIC.len() {
                continue;
            }
            let error = decompress(&file[..length], &Limits::default()).unwrap_err();
            assert!(error.is_truncated(), "{length} of {}: {error}", file.len());
        }
        let mut damaged = file.clone();
        let last = damaged.len() - 1;
        damaged[last] ^= 1;
        let error = decompress(&damaged, &Limits::default()).unwrap_err().to_string();
        assert!(error.contains("damaged: checksum"), "{error}");
    }

    #[test]
    fn decompression_bombs_are_stopped_early() {
        let bomb = packed(&vec![0; 64 << 20]);
        assert!(matches!(decompress(&bomb, &Limits::default()), Err(Error::TooLarge { .. })));
        // A frame with one empty block and a declared window of 2 GiB.
        let window = [&MAGIC[..], &[0x00, 21 << 3, 1, 0, 0]].concat();
        let error = decompress(&window, &Limits::default()).unwrap_err().to_string();
        assert!(error.contains("the window of 2147483648 bytes"), "{error}");
    }
}
