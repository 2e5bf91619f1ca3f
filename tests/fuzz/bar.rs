//! The requirement on every target: it returns, and uses memory in proportion to the size of its input.

use meniscus_formats::Limits;
use peak_alloc::PeakAlloc;

use crate::targets::{Content, Target};

#[global_allocator]
static MEMORY: PeakAlloc = PeakAlloc;

/// Allowed bytes of memory for each byte of the input, and a constant part.
const BYTES_PER_INPUT_BYTE: u64 = 4;
const BASE_BYTES: u64 = 64 << 20;

/// Number of bytes that a compressed file may unpack to before the limits check its ratio.
const RATIO_FREE_BYTES: u64 = 16 << 20;

/// Runs a target with these bytes.
pub(crate) fn hold(target: &Target, bytes: &[u8]) {
    let before = MEMORY.current_usage();
    MEMORY.reset_peak_usage();
    (target.run)(bytes);
    let peak_bytes = MEMORY.peak_usage().saturating_sub(before) as u64;
    let most = held_bytes_max(target, bytes.len() as u64);
    assert!(
        peak_bytes <= most,
        "{}: {peak_bytes} bytes were held, and {most} may be for {}",
        target.name,
        bytes.len()
    );
}

/// The allowed bytes of memory. Compressed data counts with its largest unpacked size.
fn held_bytes_max(target: &Target, length: u64) -> u64 {
    let unpacked = match target.content {
        Content::Plain => 0,
        Content::Compressed => length * Limits::default().decompression_ratio + RATIO_FREE_BYTES,
        Content::Picture => (length * PIXELS_PER_BYTE_MAX).min(PIXELS_MAX) * PIXEL_BYTES,
    };
    (length + unpacked) * BYTES_PER_INPUT_BYTE + BASE_BYTES
}

/// A byte of deflated data unpacks to 1032 bytes at most, of eight pixels each. The reader refuses pictures
/// with more pixels. A pixel is three numbers of four bytes.
const PIXELS_PER_BYTE_MAX: u64 = 1032 * 8;
const PIXELS_MAX: u64 = 8192 * 8192;
const PIXEL_BYTES: u64 = 12;
