//! Whole-file compression: gzip and Zstandard.

use std::borrow::Cow;
use std::io::{self, Read};

use crate::error::Result;
use crate::limits::Limits;
use crate::{gzip, zstd};

/// A compression format.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Codec {
    /// gzip, with one or more members.
    Gzip,
    /// Zstandard, with one or more frames.
    Zstd,
}

impl Codec {
    pub(crate) const ALL: [Codec; 2] = [Codec::Gzip, Codec::Zstd];

    /// The signature: the first bytes of a file.
    pub(crate) fn beginning(self) -> &'static [u8] {
        match self {
            Codec::Gzip => b"\x1f\x8b",
            Codec::Zstd => b"\x28\xb5\x2f\xfd",
        }
    }

    /// The size in bytes of a file with empty content.
    pub(crate) fn file_bytes_min(self) -> u64 {
        match self {
            Codec::Gzip => 20, // header, an empty block, checksum and length
            Codec::Zstd => 9,  // signature, header, an empty block
        }
    }

    /// An adjective for messages, such as `gzipped`.
    pub fn adjective(self) -> &'static str {
        match self {
            Codec::Gzip => "gzipped",
            Codec::Zstd => "compressed with zstd",
        }
    }

    /// Recognises the compression by the first bytes.
    pub(crate) fn of(bytes: &[u8]) -> Option<Codec> {
        match bytes {
            _ if gzip::is_gzip(bytes) => Some(Codec::Gzip),
            _ if zstd::is_zstd(bytes) => Some(Codec::Zstd),
            _ => None,
        }
    }

    /// Decompresses the whole file.
    pub(crate) fn decompress(self, bytes: &[u8], limits: &Limits) -> Result<Vec<u8>> {
        match self {
            Codec::Gzip => gzip::inflate(bytes, limits),
            Codec::Zstd => zstd::decompress(bytes, limits),
        }
    }

    /// Decompresses the first bytes of the content: at most `length`, or fewer if the input ends or is
    /// damaged.
    pub(crate) fn decompress_head(self, bytes: &[u8], length: usize) -> Vec<u8> {
        match self {
            Codec::Gzip => gzip::inflate_head(bytes, length),
            Codec::Zstd => zstd::decompress_head(bytes, length),
        }
    }

    /// Fails if the first bytes are damaged; discards what they decompress to. The readable part of a damaged
    /// file can look like any format, so call this before you report the format as unknown.
    pub(crate) fn check_start(self, bytes: &[u8]) -> Result<()> {
        match self {
            Codec::Gzip => gzip::check_start(bytes),
            Codec::Zstd => zstd::check_start(bytes),
        }
    }
}

/// The content of a file, decompressed if necessary.
///
/// # Errors
/// [`crate::Error::Truncated`] if the file ends too early, [`crate::Error::Invalid`] if it is damaged, both
/// with the offset in the compressed file; [`crate::Error::TooLarge`] beyond the limits on decompression.
pub fn decompressed<'a>(bytes: &'a [u8], limits: &Limits) -> Result<Cow<'a, [u8]>> {
    match Codec::of(bytes) {
        Some(codec) => codec.decompress(bytes, limits).map(Cow::Owned),
        None => Ok(Cow::Borrowed(bytes)),
    }
}

/// Reads the first `length` bytes of a file, or more if a compressed file needs them to yield any content.
///
/// # Errors
/// Those of the source.
pub fn read_head(mut source: impl Read, length: u64) -> io::Result<Vec<u8>> {
    let mut head = Vec::new();
    source.by_ref().take(length).read_to_end(&mut head)?;
    if Codec::of(&head) == Some(Codec::Zstd) {
        source.take(zstd::FIRST_BLOCK_BYTES_MAX.saturating_sub(length)).read_to_end(&mut head)?;
    }
    Ok(head)
}

/// A file name without the extension of its compression.
pub fn name_without_compression(name: &str) -> &str {
    let is_compressed =
        |end: &str| [".gz", ".zst", ".zstd"].iter().any(|known| end.eq_ignore_ascii_case(known));
    match name.rfind('.').map(|at| name.split_at(at)) {
        Some((stem, end)) if is_compressed(end) => stem,
        _ => name,
    }
}
