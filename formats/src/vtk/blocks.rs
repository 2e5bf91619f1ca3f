//! Decodes the bytes of an array: a header with the sizes, then blocks that may be compressed; all optionally
//! encoded as base64.
//!
//! ```text
//!   uncompressed  [bytes] data
//!   compressed    [blocks] [block size] [size of the last, or 0] [compressed size] × blocks   block block ..
//!
//!   base64        uncompressed: header and data as one text; compressed: the header as one text, the data as another
//! ```
//!
//! Numbers in the header have 32 or 64 bits. A block is a zlib stream, an LZ4 block without frame, or an .xz
//! file.

use std::borrow::Cow;
use std::fmt::Display;
use std::io::Read;

use base64::Engine;
use base64::engine::general_purpose::STANDARD;

use super::XML;
use crate::core::bytes::{Cursor, Endian};
use crate::core::data::Values;
use crate::core::error::{Error, Position, Result};
use crate::core::limits::Limits;
use crate::core::number::{NumberType, decimals};
use crate::core::text::excerpt;

/// The encoding of all arrays of a file.
#[derive(Clone, Copy, Debug)]
pub(super) struct ArrayEncoding {
    pub(super) endian: Endian,
    /// Size of the numbers in headers, in bytes.
    pub(super) header_word_bytes: usize,
    pub(super) compression: Option<BlockCompression>,
}

/// The compression of blocks.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum BlockCompression {
    Zlib,
    Lz4,
    Lzma,
}

/// The encoded bytes of an array.
#[derive(Clone, Copy, Debug)]
pub(super) struct EncodedArray<'a> {
    /// All bytes from the start of the array, including those of later arrays.
    pub(super) bytes: &'a [u8],
    pub(super) is_base64: bool,
    /// The offset of these bytes in the file.
    pub(super) offset: u64,
}

/// Decodes the arrays of a file.
pub(super) struct ArrayDecoder<'a> {
    encoding: ArrayEncoding,
    /// The content of the last element, `AppendedData`.
    appended: Option<EncodedArray<'a>>,
    file_bytes: u64,
    /// Total sizes of the arrays decoded so far. They are limited because arrays may overlap, so that a small
    /// file could decode to very large data.
    encoded_bytes: u64,
    bytes: u64,
    limits: &'a Limits,
}

/// Memory limit of an LZMA decoder in KiB: the largest dictionary of the presets, 64 MiB, and 256 KiB more.
const LZMA_MEMORY_KB: u32 = (64 << 10) + 256;

/// The largest ratio by which LZ4 can expand data.
const LZ4_RATIO_MAX: u64 = 255;

impl<'a> ArrayDecoder<'a> {
    pub(super) fn new(
        encoding: ArrayEncoding,
        appended: Option<EncodedArray<'a>>,
        file_bytes: u64,
        limits: &'a Limits,
    ) -> ArrayDecoder<'a> {
        ArrayDecoder { encoding, appended, file_bytes, encoded_bytes: 0, bytes: 0, limits }
    }

    /// Adds an array to the totals before it is decoded, and refuses it if they are too large.
    fn claim(&mut self, encoded_bytes: u64, bytes: u64, name: &str) -> Result<()> {
        self.encoded_bytes = self.encoded_bytes.saturating_add(encoded_bytes);
        self.bytes = self.bytes.saturating_add(bytes);
        if self.encoded_bytes > self.file_bytes {
            let what = format!("`{name}`: the arrays up to this one have more bytes in total than the file");
            return Err(Error::invalid(XML, Position::File, what));
        }
        self.limits.check_decompressed(XML, self.bytes, self.encoded_bytes)
    }

    /// The decoded bytes of the array `name`.
    fn decode<'b>(&mut self, encoded: EncodedArray<'b>, name: &str) -> Result<Cow<'b, [u8]>> {
        match self.encoding.compression {
            None => self.decode_plain(encoded, name),
            Some(compression) => self.decode_blocks(encoded, compression, name).map(Cow::Owned),
        }
    }

    fn decode_plain<'b>(&mut self, encoded: EncodedArray<'b>, name: &str) -> Result<Cow<'b, [u8]>> {
        let word_bytes = self.encoding.header_word_bytes;
        let header = encoded.take(0, word_bytes, name)?;
        let length = self.words(&header)[0];
        self.claim(length, length, name)?;
        if !encoded.is_base64 {
            let data =
                usize::try_from(length).ok().and_then(|length| encoded.bytes[word_bytes..].get(..length));
            let remain = encoded.bytes.len() - word_bytes;
            return data.map(Cow::Borrowed).ok_or_else(|| encoded.too_few(length, remain, name));
        }
        let length = usize::try_from(length).unwrap_or(usize::MAX);
        let header_letters = letters_of(word_bytes);
        // Some writers encode the header separately from the data; its base64 then ends with padding.
        // A header alone of 4 bytes is 8 characters that end in "=="; one of 8 bytes is 12 that end in "=".
        let padding = &b"=="[..header_letters / 4 * 3 - word_bytes];
        if length != 0 && encoded.bytes.get(..header_letters).is_some_and(|run| run.ends_with(padding)) {
            return encoded.take(header_letters, length, name);
        }
        let mut all = encoded.take(0, length.saturating_add(word_bytes), name)?.into_owned();
        all.drain(..word_bytes);
        Ok(Cow::Owned(all))
    }

    fn decode_blocks(
        &mut self,
        encoded: EncodedArray,
        compression: BlockCompression,
        name: &str,
    ) -> Result<Vec<u8>> {
        let word_bytes = self.encoding.header_word_bytes;
        let first = self.words(&encoded.take(0, 3 * word_bytes, name)?);
        let (block_count, block_bytes, last_bytes) = (first[0], first[1], first[2]);
        if last_bytes > block_bytes {
            let what = format!(
                "`{name}`: the last block has {last_bytes} bytes, more than the block size of {block_bytes}"
            );
            return Err(Error::invalid(XML, Position::Offset(encoded.offset), what));
        }
        let header_bytes = usize::try_from(block_count)
            .ok()
            .and_then(|count| count.checked_add(3)?.checked_mul(word_bytes))
            .filter(|&bytes| bytes <= encoded.bytes.len())
            .ok_or_else(|| {
                let expected = block_count.saturating_add(3).saturating_mul(word_bytes as u64);
                encoded.too_few(expected, encoded.bytes.len(), name)
            })?;
        let packed_sizes = self.words(&encoded.take(0, header_bytes, name)?).split_off(3);

        let packed_bytes = packed_sizes.iter().fold(0u64, |sum, &size| sum.saturating_add(size));
        let data_at = if encoded.is_base64 { letters_of(header_bytes) } else { header_bytes };
        let data = encoded.take(data_at, usize::try_from(packed_bytes).unwrap_or(usize::MAX), name)?;
        let missing_bytes = if last_bytes == 0 { 0 } else { block_bytes.saturating_sub(last_bytes) };
        let bytes = block_count.saturating_mul(block_bytes).saturating_sub(missing_bytes);
        self.claim(packed_bytes, bytes, name)?;

        let mut decompressed = Vec::new();
        let mut rest = &data[..];
        for (index, &size) in packed_sizes.iter().enumerate() {
            let is_last = index + 1 == packed_sizes.len() && last_bytes != 0;
            let length = if is_last { last_bytes } else { block_bytes };
            let (block, after) =
                rest.split_at_checked(usize::try_from(size).unwrap_or(usize::MAX)).unwrap_or_default();
            rest = after;
            let before = decompressed.len();
            let is_good = decompress(compression, block, length, &mut decompressed);
            if !is_good || (decompressed.len() - before) as u64 != length {
                let what =
                    format!("`{name}`: block {index} of {block_count} does not decompress to {length} bytes");
                return Err(Error::invalid(XML, Position::Offset(encoded.offset), what));
            }
        }
        Ok(decompressed)
    }

    /// The numbers in a header.
    fn words(&self, header: &[u8]) -> Vec<u64> {
        let mut cursor = Cursor::new(XML, self.encoding.endian, header, 0);
        let word = || match self.encoding.header_word_bytes {
            8 => cursor.u64("a header").ok(),
            _ => cursor.u32("a header").ok().map(u64::from),
        };
        std::iter::from_fn(word).collect()
    }

    /// Decodes the values of an array, `arity` for each of `count` points.
    pub(super) fn values(&mut self, array: &DataArray, number: NumberType, count: usize) -> Result<Values> {
        let expected =
            count.checked_mul(array.arity).ok_or_else(|| array.invalid("it has too many values"))?;
        let text: Cow<[u8]>;
        let encoded = match array.form {
            ArrayForm::Ascii => return array.decimals(number, expected),
            ArrayForm::Binary => {
                let content = array.content.trim_ascii_start();
                let start = array.content.len() - content.len();
                text = without_spaces(content.trim_ascii_end());
                EncodedArray { bytes: &text, is_base64: true, offset: array.offset + start as u64 }
            }
            ArrayForm::Appended(start) => self.appended(array, start)?,
        };
        let bytes = self.decode(encoded, &array.name)?;
        if bytes.len() != expected.saturating_mul(number.size()) {
            let (size, found) = (number.size(), bytes.len());
            return Err(
                array.invalid(format!("expected {expected} values of {size} bytes, found {found} bytes"))
            );
        }
        Ok(number.decode(&bytes, self.encoding.endian))
    }

    fn appended(&self, array: &DataArray, start: u64) -> Result<EncodedArray<'a>> {
        let Some(EncodedArray { bytes, is_base64, offset }) = self.appended else {
            return Err(array.invalid("its data should be appended, but the file has no appended data"));
        };
        let rest = usize::try_from(start).ok().and_then(|start| bytes.get(start..));
        let bytes = rest.ok_or_else(|| {
            let length = bytes.len();
            array.invalid(format!(
                "its data starts at byte {start}, but the appended data has only {length} bytes"
            ))
        })?;
        Ok(EncodedArray { bytes, is_base64, offset: offset + start })
    }
}

/// The text without white space: some programs break the lines of base64.
fn without_spaces(text: &[u8]) -> Cow<'_, [u8]> {
    if text.iter().any(u8::is_ascii_whitespace) {
        text.iter().copied().filter(|byte| !byte.is_ascii_whitespace()).collect()
    } else {
        text.into()
    }
}

/// Appends the `length` decompressed bytes of a block; returns false if it is invalid. A wrong `length` cannot
/// make this allocate much memory: zlib and LZMA extend `out` while they decode, and for LZ4 the length is
/// first compared with the largest ratio of the format.
fn decompress(compression: BlockCompression, block: &[u8], length: u64, out: &mut Vec<u8>) -> bool {
    match compression {
        BlockCompression::Zlib => {
            flate2::bufread::ZlibDecoder::new(block).take(length).read_to_end(out).is_ok()
        }
        BlockCompression::Lzma => lzma_rust2::XzReader::new_mem_limit(block, true, LZMA_MEMORY_KB)
            .take(length)
            .read_to_end(out)
            .is_ok(),
        BlockCompression::Lz4 => {
            let most = (block.len() as u64).saturating_mul(LZ4_RATIO_MAX).saturating_add(64);
            let Some(length) = usize::try_from(length).ok().filter(|_| length <= most) else { return false };
            let start = out.len();
            out.resize(start + length, 0);
            lz4_flex::block::decompress_into(block, &mut out[start..]).ok() == Some(length)
        }
    }
}

impl<'a> EncodedArray<'a> {
    /// Decodes `length` bytes, starting at byte or base64 character `at`.
    fn take(&self, at: usize, length: usize, name: &str) -> Result<Cow<'a, [u8]>> {
        let rest = self.bytes.get(at..).unwrap_or_default();
        if !self.is_base64 {
            let taken = rest.get(..length).map(Cow::Borrowed);
            return taken.ok_or_else(|| self.too_few(length as u64, rest.len(), name));
        }
        let letter_count = length.div_ceil(3).saturating_mul(4);
        let letters =
            rest.get(..letter_count).ok_or_else(|| self.too_few(length as u64, rest.len() / 4 * 3, name))?;
        let mut decoded = STANDARD.decode(letters).map_err(|_| {
            let position = Position::Offset(self.offset + at as u64);
            Error::invalid(XML, position, format!("`{name}` is not valid base64"))
        })?;
        if decoded.len() < length {
            return Err(self.too_few(length as u64, decoded.len(), name));
        }
        decoded.truncate(length);
        Ok(Cow::Owned(decoded))
    }

    fn too_few(&self, expected: u64, found: usize, name: &str) -> Error {
        let what = format!("expected at least {expected} bytes of `{name}`, but {found} remain");
        Error::invalid(XML, Position::Offset(self.offset), what)
    }
}

/// The number of base64 characters for this number of bytes.
fn letters_of(bytes: usize) -> usize {
    bytes.div_ceil(3) * 4
}

// Decodes `DataArray` elements.

/// An array as described by its element.
#[derive(Debug)]
pub(super) struct DataArray<'a> {
    pub(super) name: String,
    /// `None` if not numeric.
    pub(super) number: Option<NumberType>,
    pub(super) arity: usize,
    pub(super) form: ArrayForm,
    /// The content between the tags, and its offset; empty for appended data.
    pub(super) content: &'a [u8],
    pub(super) offset: u64,
}

/// The location and form of the values.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum ArrayForm {
    /// Decimals between the tags.
    Ascii,
    /// Base64 between the tags.
    Binary,
    /// In the appended data, at this offset in bytes.
    Appended(u64),
}

impl DataArray<'_> {
    fn decimals(&self, number: NumberType, expected: usize) -> Result<Values> {
        let words = self.content.split(u8::is_ascii_whitespace).filter(|word| !word.is_empty());
        // Each number takes at least a digit and a separator.
        if expected > self.content.len().div_ceil(2) {
            let what = format!("expected {expected} values, found {} bytes of text", self.content.len());
            return Err(self.invalid(what));
        }
        let values = decimals(words.clone(), number, expected).map_err(|word| {
            self.invalid(format!("`{}` is not a value of the array's type", excerpt(word)))
        })?;
        let found = values.len() + words.skip(expected).count();
        if found != expected {
            return Err(self.invalid(format!("expected {expected} values, found {found}")));
        }
        Ok(values)
    }

    fn invalid(&self, what: impl Display) -> Error {
        let what = format!("the array `{}`: {what}", excerpt(&self.name));
        Error::invalid(XML, Position::Offset(self.offset), what)
    }
}
