//! Decompresses files of xz and bzip2.
//!
//! As with gzip, the output is produced in chunks, and decompression stops at the first chunk that exceeds the limits.
//! A block of xz also declares the size of its dictionary, which a decoder must allocate: one much larger than usual is
//! rejected before allocation.

use std::io::{ErrorKind, Read};

use crate::error::{Error, Position, Result};
use crate::limits::{Limits, RATIO_FREE_BYTES};

/// The first bytes of a file of xz.
pub(crate) const XZ_MAGIC: [u8; 6] = *b"\xfd7zXZ\0";

/// The first bytes of a file of bzip2.
pub(crate) const BZIP2_MAGIC: [u8; 3] = *b"BZh";

/// What follows them and a digit: the start of a block, or the end of an empty file.
const BZIP2_NEXT: [[u8; 6]; 2] = [*b"\x31\x41\x59\x26\x53\x59", *b"\x17\x72\x45\x38\x50\x90"];

/// Memory for decompression of xz, in KiB. The highest level, -9, needs 65 MiB.
const XZ_MEMORY_KB: u32 = 80 << 10;

/// Bytes decompressed between checks of the limits.
const PIECE_BYTES: usize = 256 << 10;

/// A kind of compression whose decoder reads a stream.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Streamed {
    Xz,
    Bzip2,
}

impl Streamed {
    fn name(self) -> &'static str {
        match self {
            Streamed::Xz => "xz",
            Streamed::Bzip2 => "bzip2",
        }
    }

    fn magic(self) -> &'static [u8] {
        match self {
            Streamed::Xz => &XZ_MAGIC,
            Streamed::Bzip2 => &BZIP2_MAGIC,
        }
    }

    /// Whether a file has this compression, by its first bytes.
    pub(crate) fn is_of(self, bytes: &[u8]) -> bool {
        match self {
            Streamed::Xz => bytes.starts_with(&XZ_MAGIC),
            Streamed::Bzip2 => {
                let rest = bytes.strip_prefix(&BZIP2_MAGIC).and_then(<[u8]>::split_first);
                rest.is_some_and(|(level, next)| {
                    level.is_ascii_digit() && BZIP2_NEXT.iter().any(|known| next.starts_with(known))
                })
            }
        }
    }

    /// Decompresses all parts of the file and joins them. Zeros after them are ignored, as of gzip.
    ///
    /// # Errors
    /// `Truncated` if the file ends too early and `Invalid` if it is damaged, with the offset in the compressed
    /// file; `TooLarge` beyond `decompressed_bytes` or `decompression_ratio`, or if the dictionary is too large;
    /// `Unsupported` for a filter of xz other than LZMA2.
    pub(crate) fn decompress(self, bytes: &[u8], limits: &Limits) -> Result<Vec<u8>> {
        let mut decompressed = Vec::new();
        let mut rest = bytes;
        while !rest.is_empty() {
            let outcome = self.read_stream(&mut rest, bytes.len() as u64, limits, &mut decompressed);
            let at = bytes.len() - rest.len();
            match outcome {
                Ok(()) => {}
                Err(StreamFailure::Limit(error)) => return Err(error),
                Err(StreamFailure::Damage(error)) => return Err(self.damage(&error, at)),
            }
            let padding = rest.iter().take_while(|byte| **byte == 0).count();
            rest = &rest[padding..];
            if !rest.is_empty() && !self.is_of(rest) {
                let position = Position::Offset((at + padding) as u64);
                let what = "the compressed data is followed by other bytes";
                return Err(if self.magic().starts_with(rest) {
                    Error::truncated(self.name(), position, what)
                } else {
                    Error::invalid(self.name(), position, what)
                });
            }
        }
        Ok(decompressed)
    }

    /// Decompresses the part at the beginning of `rest`, of a file of `size` bytes, and removes it from `rest`.
    fn read_stream(
        self,
        rest: &mut &[u8],
        size: u64,
        limits: &Limits,
        decompressed: &mut Vec<u8>,
    ) -> std::result::Result<(), StreamFailure> {
        let mut decoder = self.decoder(rest);
        loop {
            let before = decompressed.len();
            let outcome = decoder.by_ref().take(PIECE_BYTES as u64).read_to_end(decompressed);
            limits
                .check_decompressed(self.name(), decompressed.len() as u64, size)
                .map_err(StreamFailure::Limit)?;
            outcome.map_err(StreamFailure::Damage)?;
            if decompressed.len() == before {
                return Ok(());
            }
        }
    }

    /// Decompresses the first bytes of the content: at most `length`, or fewer if the input ends or is damaged.
    pub(crate) fn decompress_head(self, mut bytes: &[u8], length: usize) -> Vec<u8> {
        let mut decoder = self.decoder(&mut bytes);
        let mut head = vec![0; length];
        let mut filled = 0;
        while filled < length {
            match decoder.read(&mut head[filled..]) {
                Ok(0) | Err(_) => break,
                Ok(count) => filled += count,
            }
        }
        head.truncate(filled);
        head
    }

    /// Fails if the first bytes are damaged; discards what they decompress to.
    pub(crate) fn check_start(self, bytes: &[u8]) -> Result<()> {
        let mut rest = bytes;
        // The checksum of a block of bzip2, which has up to 900 kB, comes after it.
        let mut start = self.decoder(&mut rest).take(RATIO_FREE_BYTES);
        let outcome = std::io::copy(&mut start, &mut std::io::sink());
        drop(start);
        outcome.map(drop).map_err(|error| self.damage(&error, bytes.len() - rest.len()))
    }

    /// The decoder of one part.
    fn decoder<'s>(self, rest: &'s mut &[u8]) -> Box<dyn Read + 's> {
        match self {
            Streamed::Xz => Box::new(lzma_rust2::XzReader::new_mem_limit(rest, false, XZ_MEMORY_KB)),
            Streamed::Bzip2 => Box::new(bzip2::bufread::BzDecoder::new(rest)),
        }
    }

    fn damage(self, error: &std::io::Error, consumed: usize) -> Error {
        let position = Position::Offset(consumed as u64);
        match error.kind() {
            ErrorKind::UnexpectedEof => {
                Error::truncated(self.name(), position, "the compressed data ends too early")
            }
            ErrorKind::OutOfMemory => {
                let what = format!(
                    "decompression needs more than the limit of {XZ_MEMORY_KB} KiB: compress the file at level 9 or \
                     lower"
                );
                Error::too_large(self.name(), what)
            }
            ErrorKind::Unsupported => {
                let what = format!("{error}: compress the file with the usual settings of xz");
                Error::unsupported(self.name(), what)
            }
            _ => Error::invalid(self.name(), position, format!("the compressed data is damaged: {error}")),
        }
    }
}

/// Why a file was not decompressed.
enum StreamFailure {
    Limit(Error),
    Damage(std::io::Error),
}

#[cfg(test)]
mod tests {
    use std::io::Write;

    use super::*;

    fn packed(of: Streamed, content: &[u8]) -> Vec<u8> {
        match of {
            Streamed::Xz => {
                let options = lzma_rust2::XzOptions::with_preset(6);
                let mut writer = lzma_rust2::XzWriter::new(Vec::new(), options).expect("options");
                writer.write_all(content).expect("memory");
                writer.finish().expect("memory")
            }
            Streamed::Bzip2 => {
                let mut writer = bzip2::write::BzEncoder::new(Vec::new(), bzip2::Compression::best());
                writer.write_all(content).expect("memory");
                writer.finish().expect("memory")
            }
        }
    }

    fn content() -> Vec<u8> {
        (0..300_000u32).flat_map(|number| (number.wrapping_mul(2_654_435_761) >> 20).to_le_bytes()).collect()
    }

    #[test]
    fn contents_and_several_streams_are_read() {
        let content = content();
        for of in [Streamed::Xz, Streamed::Bzip2] {
            let bytes = packed(of, &content);
            assert!(of.is_of(&bytes) && of.is_of(&packed(of, b"")), "{of:?}");
            assert_eq!(of.decompress(&bytes, &Limits::default()).expect("content"), content);
            assert_eq!(of.decompress_head(&bytes, 5000), content[..5000]);
            let twice = [&bytes[..], &bytes].concat();
            assert_eq!(of.decompress(&twice, &Limits::default()).expect("content").len(), 2 * content.len());
            assert!(of.check_start(&bytes).is_ok());
            let padded = [&bytes[..], &[0; 510]].concat();
            assert_eq!(of.decompress(&padded, &Limits::default()).expect("padding"), content, "{of:?}");
        }
    }

    #[test]
    fn damaged_and_huge_files_are_refused() {
        let content = content();
        for of in [Streamed::Xz, Streamed::Bzip2] {
            let bytes = packed(of, &content);
            for end in [bytes.len() - 1, bytes.len() / 2, 20] {
                let error = of.decompress(&bytes[..end], &Limits::default()).expect_err("truncated");
                assert!(error.is_truncated(), "{of:?} {end}: {error}");
            }
            for (more, is_truncated) in [(&of.magic()[..3], true), (b"text", false)] {
                let error =
                    of.decompress(&[&bytes[..], more].concat(), &Limits::default()).expect_err("more");
                assert!(error.to_string().contains("followed by other bytes"), "{error}");
                assert_eq!(error.is_truncated(), is_truncated, "{error}");
            }
            let mut damaged = bytes.clone();
            damaged[bytes.len() / 2] ^= 0x55;
            let error = of.decompress(&damaged, &Limits::default()).expect_err("damaged").to_string();
            assert!(error.contains("damaged"), "{error}");
            let limits = Limits { decompressed_bytes: 1000, ..Limits::default() };
            let error = of.decompress(&bytes, &limits).expect_err("too large").to_string();
            assert!(error.contains("limit"), "{error}");
        }
    }

    #[test]
    fn dictionaries_beyond_the_limit_are_refused() {
        let mut options = lzma_rust2::XzOptions::with_preset(1);
        options.lzma_options.dict_size = 256 << 20;
        let mut writer = lzma_rust2::XzWriter::new(Vec::new(), options).expect("options");
        writer.write_all(b"text").expect("memory");
        let bytes = writer.finish().expect("memory");
        let error = Streamed::Xz.decompress(&bytes, &Limits::default()).expect_err("too large");
        assert!(matches!(error, Error::TooLarge { .. }), "{error}");
    }
}
