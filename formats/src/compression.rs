//! The compression of whole files: gzip or Zstandard.

use std::borrow::Cow;
use std::io::{self, Read};

use crate::error::Result;
use crate::limits::Limits;
use crate::{gzip, zstd};

/// How a file is compressed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Codec {
    /// gzip, of one member or of several.
    Gzip,
    /// Zstandard, of one frame or of several.
    Zstd,
}

impl Codec {
    pub(crate) const ALL: [Codec; 2] = [Codec::Gzip, Codec::Zstd];

    /// The first bytes of a file.
    pub(crate) fn beginning(self) -> &'static [u8] {
        match self {
            Codec::Gzip => b"\x1f\x8b",
            Codec::Zstd => b"\x28\xb5\x2f\xfd",
        }
    }

    /// Bytes of the smallest file: one with nothing in it.
    pub(crate) fn file_bytes_min(self) -> u64 {
        match self {
            Codec::Gzip => 20, // header, an empty block, checksum and length
            Codec::Zstd => 9,  // signature, header, an empty block
        }
    }

    /// What has been done to the file: `gzipped`.
    pub fn participle(self) -> &'static str {
        match self {
            Codec::Gzip => "gzipped",
            Codec::Zstd => "packed by zstd",
        }
    }

    /// Tells by the first bytes.
    pub(crate) fn of(bytes: &[u8]) -> Option<Codec> {
        match bytes {
            _ if gzip::is_gzip(bytes) => Some(Codec::Gzip),
            _ if zstd::is_zstd(bytes) => Some(Codec::Zstd),
            _ => None,
        }
    }

    /// All of the content.
    pub(crate) fn unpack(self, bytes: &[u8], limits: &Limits) -> Result<Vec<u8>> {
        match self {
            Codec::Gzip => gzip::inflate(bytes, limits),
            Codec::Zstd => zstd::unpack(bytes, limits),
        }
    }

    /// The first bytes of the content, as many as can be had, at most `length`.
    pub(crate) fn unpack_head(self, bytes: &[u8], length: usize) -> Vec<u8> {
        match self {
            Codec::Gzip => gzip::inflate_head(bytes, length),
            Codec::Zstd => zstd::unpack_head(bytes, length),
        }
    }

    /// Looks for damage in the first bytes without keeping what comes out of them: what little could be
    /// unpacked of a damaged file may look like anything.
    pub(crate) fn check_start(self, bytes: &[u8]) -> Result<()> {
        match self {
            Codec::Gzip => gzip::check_start(bytes),
            Codec::Zstd => zstd::check_start(bytes),
        }
    }
}

/// The content of a file, compressed or not.
///
/// # Errors
/// [`crate::Error::Short`] if it ends too soon, [`crate::Error::Invalid`] if it is damaged, with the offset in the compressed
/// file; [`crate::Error::TooLarge`] beyond the limits on decompression.
pub fn unpacked<'a>(bytes: &'a [u8], limits: &Limits) -> Result<Cow<'a, [u8]>> {
    match Codec::of(bytes) {
        Some(codec) => codec.unpack(bytes, limits).map(Cow::Owned),
        None => Ok(Cow::Borrowed(bytes)),
    }
}

/// The first bytes of a file: `length`, or more where less shows nothing of what is compressed in it.
///
/// # Errors
/// When the source cannot be read.
pub fn read_head(mut source: impl Read, length: u64) -> io::Result<Vec<u8>> {
    let mut head = Vec::new();
    source.by_ref().take(length).read_to_end(&mut head)?;
    if Codec::of(&head) == Some(Codec::Zstd) {
        source.take(zstd::FIRST_BLOCK_BYTES_MAX.saturating_sub(length)).read_to_end(&mut head)?;
    }
    Ok(head)
}

/// A file name without the extension of its compression.
pub fn unpacked_name(name: &str) -> &str {
    let is_compressed =
        |end: &str| [".gz", ".zst", ".zstd"].iter().any(|known| end.eq_ignore_ascii_case(known));
    match name.rfind('.').map(|at| name.split_at(at)) {
        Some((stem, end)) if is_compressed(end) => stem,
        _ => name,
    }
}
