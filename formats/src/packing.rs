//! What files of any format may be packed in: gzip or Zstandard.

use std::borrow::Cow;
use std::io::{self, Read};

use crate::error::Result;
use crate::limits::Limits;
use crate::{gzip, zstd};

/// What a file is packed in.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Packing {
    /// gzip, of one member or of several.
    Gzip,
    /// Zstandard, of one frame or of several.
    Zstd,
}

impl Packing {
    /// What has been done to the file: `gzipped`.
    pub fn participle(self) -> &'static str {
        match self {
            Packing::Gzip => "gzipped",
            Packing::Zstd => "packed by zstd",
        }
    }

    /// Tells by the first bytes.
    pub(crate) fn of(bytes: &[u8]) -> Option<Packing> {
        match bytes {
            _ if gzip::is_gzip(bytes) => Some(Packing::Gzip),
            _ if zstd::is_zstd(bytes) => Some(Packing::Zstd),
            _ => None,
        }
    }

    /// All of the content.
    pub(crate) fn unpack(self, bytes: &[u8], limits: &Limits) -> Result<Vec<u8>> {
        match self {
            Packing::Gzip => gzip::inflate(bytes, limits),
            Packing::Zstd => zstd::unpack(bytes, limits),
        }
    }

    /// The first bytes of the content, as many as can be had, at most `length`.
    pub(crate) fn unpack_head(self, bytes: &[u8], length: usize) -> Vec<u8> {
        match self {
            Packing::Gzip => gzip::inflate_head(bytes, length),
            Packing::Zstd => zstd::unpack_head(bytes, length),
        }
    }

    /// Looks for damage in the first bytes without keeping what comes out of them: what little could be
    /// unpacked of a damaged file may look like anything.
    pub(crate) fn check_start(self, bytes: &[u8]) -> Result<()> {
        match self {
            Packing::Gzip => gzip::check_start(bytes),
            Packing::Zstd => zstd::check_start(bytes),
        }
    }
}

/// The content of a file, packed or not.
///
/// # Errors
/// [`crate::Error::Short`] if it ends too soon, [`crate::Error::Invalid`] if it is damaged, with the offset in the packed
/// file; [`crate::Error::TooLarge`] beyond the limits on decompression.
pub fn unpacked<'a>(bytes: &'a [u8], limits: &Limits) -> Result<Cow<'a, [u8]>> {
    match Packing::of(bytes) {
        Some(packing) => packing.unpack(bytes, limits).map(Cow::Owned),
        None => Ok(Cow::Borrowed(bytes)),
    }
}

/// The first bytes of a file: `length`, or more where less says nothing of what is packed in it.
///
/// # Errors
/// When the source cannot be read.
pub fn read_head(mut source: impl Read, length: u64) -> io::Result<Vec<u8>> {
    let mut head = Vec::new();
    source.by_ref().take(length).read_to_end(&mut head)?;
    if Packing::of(&head) == Some(Packing::Zstd) {
        source.take(zstd::FIRST_BLOCK_BYTES_MAX.saturating_sub(length)).read_to_end(&mut head)?;
    }
    Ok(head)
}

/// A file name without the extension of what the file is packed in.
pub fn unpacked_name(name: &str) -> &str {
    let is_packing = |end: &str| [".gz", ".zst", ".zstd"].iter().any(|known| end.eq_ignore_ascii_case(known));
    match name.rfind('.').map(|at| name.split_at(at)) {
        Some((stem, end)) if is_packing(end) => stem,
        _ => name,
    }
}
