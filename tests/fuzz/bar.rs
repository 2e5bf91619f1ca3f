//! What every target is held to: it returns, and never holds much more memory than its input has bytes.

use meniscus_formats::Limits;
use peak_alloc::PeakAlloc;

use crate::targets::{Content, Target};

#[global_allocator]
static MEMORY: PeakAlloc = PeakAlloc;

/// Bytes held for each byte of the input, and besides.
const HELD_PER_BYTE: u64 = 4;
const HELD_BESIDES_BYTES: u64 = 64 << 20;

/// What the limits let out of a packed file before they count how much of it there was.
const RATIO_FREE_BYTES: u64 = 16 << 20;

/// Gives a target these bytes.
pub(crate) fn hold(target: &Target, bytes: &[u8]) {
    let before = MEMORY.current_usage();
    MEMORY.reset_peak_usage();
    (target.run)(bytes);
    let held = MEMORY.peak_usage().saturating_sub(before) as u64;
    let most = held_bytes_max(target, bytes.len() as u64);
    assert!(held <= most, "{}: {held} bytes were held, and {most} may be for {}", target.name, bytes.len());
}

/// What is packed counts as what it may become.
fn held_bytes_max(target: &Target, length: u64) -> u64 {
    let unpacked = match target.content {
        Content::Plain => 0,
        Content::Packed => length * Limits::default().decompression_ratio + RATIO_FREE_BYTES,
        Content::Picture => (length * PIXELS_PER_BYTE_MAX).min(PIXELS_MAX) * PIXEL_BYTES,
    };
    (length + unpacked) * HELD_PER_BYTE + HELD_BESIDES_BYTES
}

/// A byte of deflated data stands for 1032 at most, of eight pixels each; no picture of more pixels is read, and a pixel
/// is three numbers of four bytes.
const PIXELS_PER_BYTE_MAX: u64 = 1032 * 8;
const PIXELS_MAX: u64 = 8192 * 8192;
const PIXEL_BYTES: u64 = 12;
