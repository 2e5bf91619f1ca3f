//! Whole-file compression: gzip and Zstandard.

use std::borrow::Cow;
use std::io::{self, Read};

use flate2::bufread::GzDecoder;

use crate::core::error::{Error, Position, Result};
use crate::core::limits::{Limits, RATIO_FREE_BYTES};
use crate::core::zstd;

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
            _ if is_gzip(bytes) => Some(Codec::Gzip),
            _ if zstd::is_zstd(bytes) => Some(Codec::Zstd),
            _ => None,
        }
    }

    /// Decompresses the whole file.
    pub(crate) fn decompress(self, bytes: &[u8], limits: &Limits) -> Result<Vec<u8>> {
        let mut content = Vec::new();
        self.decompress_into(&mut content, bytes, limits)?;
        Ok(content)
    }

    /// Decompresses the whole file; after an error, `content` has what was decompressed before it.
    fn decompress_into(self, content: &mut Vec<u8>, bytes: &[u8], limits: &Limits) -> Result<()> {
        match self {
            Codec::Gzip => inflate(content, bytes, limits)?,
            Codec::Zstd => zstd::decompress(content, bytes, limits)?,
        }
        Ok(())
    }

    /// Decompresses the first bytes of the content: at most `length`, or fewer if the input ends or is
    /// damaged.
    pub(crate) fn decompress_head(self, bytes: &[u8], length: usize) -> Vec<u8> {
        match self {
            Codec::Gzip => inflate_head(bytes, length),
            Codec::Zstd => zstd::decompress_head(bytes, length),
        }
    }

    /// Fails if the first bytes are damaged; discards what they decompress to. The readable part of a damaged
    /// file can look like any format, so call this before you report the format as unknown.
    pub(crate) fn check_start(self, bytes: &[u8]) -> Result<()> {
        match self {
            Codec::Gzip => check_start(bytes),
            Codec::Zstd => zstd::check_start(bytes),
        }
    }

    /// From how many bytes of a file on something of its content is known: a decoder yields nothing before the end of
    /// the first block.
    pub fn first_block_bytes_max(self) -> u64 {
        match self {
            Codec::Gzip => 0,
            Codec::Zstd => zstd::FIRST_BLOCK_BYTES_MAX,
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

/// Like [`decompressed`], of a file with steps. If the compressed data ends too early, because its writer was stopped
/// or is still writing, the content ends there, and a note says so: the steps before are whole.
///
/// # Errors
/// Those of [`decompressed`], and `Truncated` only if nothing could be decompressed.
pub fn decompressed_so_far<'a>(bytes: &'a [u8], limits: &Limits) -> Result<(Cow<'a, [u8]>, Option<String>)> {
    let Some(codec) = Codec::of(bytes) else { return Ok((bytes.into(), None)) };
    let mut content = Vec::new();
    match codec.decompress_into(&mut content, bytes, limits) {
        Err(error) if error.is_truncated() && !content.is_empty() => {
            // The last line may end within a number.
            let whole = content.iter().rposition(|&byte| byte == b'\n').map_or(0, |end| end + 1);
            content.truncate(whole);
            let note = format!("{error}: later steps are missing if its writer was stopped");
            Ok((content.into(), Some(note)))
        }
        outcome => outcome.map(|()| (content.into(), None)),
    }
}

/// Reads the first `length` bytes of a file, or more if a compressed file needs them to yield any content.
///
/// # Errors
/// Those of the source.
pub fn read_head(mut source: impl Read, length: u64) -> io::Result<Vec<u8>> {
    let mut head = Vec::new();
    source.by_ref().take(length).read_to_end(&mut head)?;
    if let Some(codec) = Codec::of(&head) {
        source.take(codec.first_block_bytes_max().saturating_sub(length)).read_to_end(&mut head)?;
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

// Decompresses gzip files.
//
// A small file can decompress to a huge one, so the output is produced in chunks, and decompression stops at
// the first chunk that exceeds the limits.

const FORMAT: &str = "gzip";

/// The signature of a gzip member.
const MAGIC: [u8; 2] = [0x1f, 0x8b];

/// Bytes decompressed between checks of the limits.
const PIECE_BYTES: usize = 256 << 10;

/// Whether the file is gzipped.
pub(crate) fn is_gzip(bytes: &[u8]) -> bool {
    bytes.starts_with(&MAGIC)
}

/// Decompresses all members of the file and concatenates them.
///
/// # Errors
/// `Truncated` if the file ends too early and `Invalid` if it is damaged, with the offset in the compressed
/// file; `MemoryLimit` beyond `memory_bytes`, and `TooLarge` beyond `decompression_ratio`.
fn inflate(inflated: &mut Vec<u8>, bytes: &[u8], limits: &Limits) -> Result<()> {
    let mut rest = bytes;
    while is_gzip(rest) {
        rest = inflate_member(bytes.len(), rest, limits, inflated)?;
    }
    // Tapes and some copying tools pad files with zeros.
    if let Some(at) = rest.iter().position(|&byte| byte != 0) {
        let position = Position::Offset((bytes.len() - rest.len() + at) as u64);
        let what = "the compressed data is followed by other bytes";
        // A single remaining byte can be the start of another member, which is truncated.
        return Err(if MAGIC.starts_with(rest) {
            Error::truncated(FORMAT, position, what)
        } else {
            Error::invalid(FORMAT, position, what)
        });
    }
    Ok(())
}

/// Decompresses the member at the start of `rest`, and returns the bytes after it.
fn inflate_member<'a>(
    total: usize,
    rest: &'a [u8],
    limits: &Limits,
    inflated: &mut Vec<u8>,
) -> Result<&'a [u8]> {
    let mut decoder = GzDecoder::new(rest);
    loop {
        let before = inflated.len();
        let outcome = decoder.by_ref().take(PIECE_BYTES as u64).read_to_end(inflated);
        let consumed = total - decoder.get_ref().len();
        limits.check_decompressed(FORMAT, inflated.len() as u64, consumed as u64)?;
        if let Err(source) = outcome {
            return Err(damage(&source, consumed));
        }
        if inflated.len() == before {
            return Ok(decoder.into_inner());
        }
    }
}

fn damage(source: &std::io::Error, consumed: usize) -> Error {
    let position = Position::Offset(consumed as u64);
    match source.kind() {
        std::io::ErrorKind::UnexpectedEof => {
            Error::truncated(FORMAT, position, "the compressed data ends too early")
        }
        _ => Error::invalid(FORMAT, position, format!("the compressed data is damaged: {source}")),
    }
}

/// Fails if the first bytes are damaged; discards what they decompress to. The readable part of a damaged
/// file can look like any format, so call this before you report the format as unknown.
///
/// # Errors
/// `Truncated` and `Invalid`, as from [`inflate`].
pub(crate) fn check_start(bytes: &[u8]) -> Result<()> {
    let mut start = GzDecoder::new(bytes).take(RATIO_FREE_BYTES);
    let outcome = std::io::copy(&mut start, &mut std::io::sink());
    outcome.map(drop).map_err(|source| damage(&source, bytes.len() - start.get_ref().get_ref().len()))
}

/// Decompresses the first bytes of the content: at most `length`, or fewer if the input ends or is damaged.
pub(crate) fn inflate_head(bytes: &[u8], length: usize) -> Vec<u8> {
    let mut head = Vec::new();
    // On an error, `head` keeps the bytes decompressed before it, which is all that the caller needs.
    let _ = GzDecoder::new(bytes).take(length as u64).read_to_end(&mut head);
    head
}

#[cfg(test)]
mod tests {
    use std::io::Write;

    use super::*;

    fn gzipped(bytes: &[u8]) -> Vec<u8> {
        let mut encoder = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::default());
        encoder.write_all(bytes).unwrap();
        encoder.finish().unwrap()
    }

    fn inflate(bytes: &[u8], limits: &Limits) -> Result<Vec<u8>> {
        Codec::Gzip.decompress(bytes, limits)
    }

    #[test]
    fn gzip_members_are_concatenated_and_padding_is_ignored() {
        let mut file = [gzipped(b"one "), gzipped(b"two")].concat();
        assert_eq!(inflate(&file, &Limits::default()).unwrap(), b"one two");
        file.extend([0; 100]);
        assert_eq!(inflate(&file, &Limits::default()).unwrap(), b"one two");
        file.push(7);
        let error = inflate(&file, &Limits::default()).unwrap_err().to_string();
        assert!(error.contains("followed by other bytes"), "{error}");
    }

    #[test]
    fn damage_is_reported_with_its_offset() {
        let mut file = gzipped(&[7; 5000]);
        let error = inflate(&file[..file.len() - 3], &Limits::default()).unwrap_err();
        assert!(error.is_truncated() && error.to_string().contains("ends too early"), "{error}");
        let middle = file.len() - 7; // within the checksum
        file[middle] ^= 1;
        let error = inflate(&file, &Limits::default()).unwrap_err();
        assert!(!error.is_truncated() && error.to_string().contains("is damaged"), "{error}");
    }

    #[test]
    fn decompression_bomb_is_stopped_early() {
        let bomb = gzipped(&vec![0; 64 << 20]);
        assert!(matches!(inflate(&bomb, &Limits::default()), Err(Error::TooLarge { .. })));
        let limits = Limits { memory_bytes: 5 << 20, ..Limits::default() };
        assert!(matches!(inflate(&bomb, &limits), Err(Error::MemoryLimit { .. })));
        let limits = Limits { decompression_ratio: 1032, ..Limits::default() };
        assert_eq!(inflate(&bomb, &limits).unwrap().len(), 64 << 20);
        let small = gzipped(&vec![0; 16 << 20]);
        assert_eq!(inflate(&small, &Limits::default()).unwrap().len(), 16 << 20);
    }
}
