//! Blosc 1 frames, in which OpenVDB stores the values of a node and Houdini its geometry.
//!
//! The shuffle places byte k of all elements side by side, because sign and exponent bytes repeat while
//! mantissa bytes do not. The result is one stream of bytes per k, and each stream is compressed separately
//! with LZ4.
//!
//! ```text
//!   0        1        2        3         4        8           12
//!   version  version  flags    typesize  bytes    block size  frame size   16-byte header
//!            of codec                    u32      u32         u32
//!   u32 start of each block, from the start of the frame
//!   per block: per stream: i32 size, then that many bytes (size = the uncompressed size: stored raw)
//! ```
//!
//! A block is split into `typesize` streams only if the flag "not split" is clear, `typesize` ≤ 16, the block
//! has at least 128 elements, and it is not a shorter last block. A decoder that follows these rules cannot
//! read frames split differently, so the encoder and the decoder here both use [`is_split`].
//!
//! This work is based on:
//! the header description in c-blosc's README_HEADER

use crate::core::bytes::u32_at;
use crate::core::error::{Error, Position};

const SHUFFLED: u8 = 0x01;
const STORED: u8 = 0x02;
const BITS_SHUFFLED: u8 = 0x04;
const NOT_SPLIT: u8 = 0x10;
const CODEC_SHIFT: u8 = 5;
const CODEC_BLOSCLZ: u8 = 0;
const CODEC_LZ4: u8 = 1;
const CODEC_ZLIB: u8 = 3;

const HEADER_BYTES: usize = 16;
/// Fewer bytes than this are stored uncompressed, as in OpenVDB: the headers would cancel the gain.
const BYTES_MIN: usize = 128;
const SPLIT_ELEMENTS_MIN: usize = 128;
const SPLIT_TYPESIZE_MAX: usize = 16;

/// Why a frame could not be decoded; the caller adds its location in the file.
#[derive(Debug)]
pub(crate) enum BloscError {
    Invalid(String),
    Unsupported(String),
}

impl BloscError {
    /// The error of a format whose file contains the frame at this offset.
    pub(crate) fn of_format(self, format: &'static str, offset: u64) -> Error {
        match self {
            BloscError::Invalid(what) => Error::invalid(format, Position::Offset(offset), what),
            BloscError::Unsupported(what) => Error::unsupported(format, what),
        }
    }
}

/// Buffers reused from frame to frame.
pub(crate) struct Encoder {
    shuffled: Vec<u8>,
    table: lz4_flex::block::CompressTable,
}

impl Encoder {
    pub(crate) fn new() -> Encoder {
        Encoder { shuffled: Vec::new(), table: lz4_flex::block::CompressTable::small() }
    }

    /// Appends `bytes`, elements of `typesize` bytes, as one frame with one block. Returns whether this saves
    /// space; if not, `out` is unchanged and the caller should store the bytes raw.
    pub(crate) fn append_frame(&mut self, bytes: &[u8], typesize: u8, out: &mut Vec<u8>) -> bool {
        let Ok(byte_count) = u32::try_from(bytes.len()) else { return false };
        if bytes.len() < BYTES_MIN {
            return false;
        }
        let start = out.len();
        let stream_count = usize::from(typesize);
        let split = bytes.len().is_multiple_of(stream_count) && is_split(stream_count, bytes.len());
        let flags = CODEC_LZ4 << CODEC_SHIFT | SHUFFLED | if split { 0 } else { NOT_SPLIT };
        out.extend_from_slice(&[2, 1, flags, typesize]);
        out.extend_from_slice(&byte_count.to_le_bytes());
        out.extend_from_slice(&byte_count.to_le_bytes());
        out.extend_from_slice(&[0; 4]); // placeholder for the frame's size
        out.extend_from_slice(&20u32.to_le_bytes());

        let mut shuffled = std::mem::take(&mut self.shuffled);
        shuffle(bytes, stream_count, &mut shuffled);
        let stream_bytes = if split { bytes.len() / stream_count } else { bytes.len() };
        for stream in shuffled.chunks(stream_bytes) {
            self.append_stream(stream, out);
        }
        self.shuffled = shuffled;

        match u32::try_from(out.len() - start) {
            Ok(frame_bytes) if frame_bytes < byte_count => {
                out[start + 12..start + 16].copy_from_slice(&frame_bytes.to_le_bytes());
                true
            }
            _ => {
                out.truncate(start);
                false
            }
        }
    }

    fn append_stream(&mut self, stream: &[u8], out: &mut Vec<u8>) {
        let start = out.len();
        let body = start + 4;
        out.resize(body + lz4_flex::block::get_maximum_output_size(stream.len()), 0);
        let packed = lz4_flex::block::compress_into_with_table(stream, &mut out[body..], &mut self.table);
        let size = match packed {
            Ok(size) if size < stream.len() => size,
            _ => {
                out[body..body + stream.len()].copy_from_slice(stream);
                stream.len()
            }
        };
        out.truncate(body + size);
        let size = i32::try_from(size).unwrap_or(i32::MAX); // a stream is part of a node: a few KiB
        out[start..body].copy_from_slice(&size.to_le_bytes());
    }
}

/// Decodes a frame that must fill `out` exactly.
pub(crate) fn decode_frame(frame: &[u8], out: &mut [u8]) -> Result<(), BloscError> {
    let invalid = |what: String| Err(BloscError::Invalid(what));
    if frame.len() < HEADER_BYTES {
        return invalid(format!("the Blosc frame has {} bytes, fewer than its header", frame.len()));
    }
    let (version, flags, typesize) = (frame[0], frame[2], usize::from(frame[3]));
    let byte_count = u32_at(frame, 4) as usize;
    let block_bytes = u32_at(frame, 8) as usize;
    let frame_bytes = u32_at(frame, 12) as usize;
    if version != 2 {
        return Err(BloscError::Unsupported(format!(
            "the Blosc frame has version {version}; only version 2 is supported"
        )));
    }
    if byte_count != out.len() {
        return invalid(format!(
            "the Blosc frame declares {byte_count} decompressed bytes; expected {} bytes",
            out.len()
        ));
    }
    if frame_bytes > frame.len() {
        return invalid(format!(
            "the Blosc frame declares {frame_bytes} compressed bytes, but has {} bytes",
            frame.len()
        ));
    }
    if flags & STORED != 0 {
        let Some(stored) = frame.get(HEADER_BYTES..HEADER_BYTES + byte_count) else {
            return invalid("the stored Blosc frame ends too early".into());
        };
        out.copy_from_slice(stored);
        return Ok(());
    }
    if flags & BITS_SHUFFLED != 0 {
        return Err(BloscError::Unsupported(
            "Blosc bit shuffle is not supported; rewrite the file with byte shuffle".into(),
        ));
    }
    if out.is_empty() {
        return Ok(());
    }
    if typesize == 0
        || block_bytes == 0
        || byte_count.div_ceil(block_bytes) > (frame.len() - HEADER_BYTES) / 4
    {
        return invalid(format!(
            "the Blosc frame has an invalid element size of {typesize} or block size of {block_bytes} bytes"
        ));
    }
    let mut block = Vec::new();
    let mut packed_bytes = 0;
    for (index, part) in out.chunks_mut(block_bytes).enumerate() {
        let start = u32_at(frame, HEADER_BYTES + 4 * index) as usize;
        let split = flags & NOT_SPLIT == 0 && part.len() == block_bytes && is_split(typesize, block_bytes);
        let Some(bytes) = frame.get(start..) else {
            return invalid(format!("a Blosc block starts at byte {start}, outside its frame"));
        };
        block.resize(part.len(), 0);
        packed_bytes +=
            decode_block(bytes, flags >> CODEC_SHIFT, if split { typesize } else { 1 }, &mut block)?;
        if packed_bytes > frame.len() {
            return invalid("the blocks of a Blosc frame overlap".into());
        }
        if flags & SHUFFLED != 0 && typesize > 1 {
            unshuffle(&block, typesize, part);
        } else {
            part.copy_from_slice(&block);
        }
    }
    Ok(())
}

/// Decodes a block that must fill `out`, and returns its compressed size in bytes.
fn decode_block(block: &[u8], codec: u8, stream_count: usize, out: &mut [u8]) -> Result<usize, BloscError> {
    let invalid = |what: &str| Err(BloscError::Invalid(what.into()));
    if !out.len().is_multiple_of(stream_count) {
        return invalid("the size of a Blosc block is not a multiple of its number of streams");
    }
    let stream_bytes = out.len() / stream_count;
    let mut bytes = block;
    for stream in out.chunks_mut(stream_bytes) {
        let Some((size, rest)) = bytes.split_first_chunk::<4>() else {
            return invalid("a Blosc block ends before the size of a stream");
        };
        let size = u32::from_le_bytes(*size) as usize;
        if size > rest.len() {
            return invalid("a Blosc stream extends beyond its frame");
        }
        let (packed, rest) = rest.split_at(size);
        bytes = rest;
        if size == stream.len() {
            stream.copy_from_slice(packed);
            continue;
        }
        let decompressed = match codec {
            CODEC_LZ4 => lz4_flex::block::decompress_into(packed, stream).ok(),
            CODEC_BLOSCLZ => decompress_into(packed, stream),
            CODEC_ZLIB => inflate_into(packed, stream),
            other => return Err(BloscError::Unsupported(unsupported_codec(other))),
        };
        if decompressed != Some(stream.len()) {
            return invalid("a Blosc stream does not decompress to the expected size");
        }
    }
    Ok(block.len() - bytes.len())
}

/// Whether a full block is split into one stream per byte of its elements.
fn is_split(typesize: usize, block_bytes: usize) -> bool {
    typesize <= SPLIT_TYPESIZE_MAX && block_bytes / typesize >= SPLIT_ELEMENTS_MIN
}

/// Decompresses a zlib stream into `out`. Returns the number of bytes, or `None` if it is invalid or too
/// long.
pub(crate) fn inflate_into(packed: &[u8], out: &mut [u8]) -> Option<usize> {
    let mut inflater = flate2::Decompress::new(true);
    match inflater.decompress(packed, out, flate2::FlushDecompress::Finish) {
        Ok(flate2::Status::StreamEnd) => usize::try_from(inflater.total_out()).ok(),
        _ => None,
    }
}

fn unsupported_codec(codec: u8) -> String {
    let name = match codec {
        2 => "Snappy",
        4 => "Zstandard",
        _ => "unknown",
    };
    format!("the Blosc codec {name} is not supported; rewrite the file with LZ4, as OpenVDB does")
}

fn shuffle(bytes: &[u8], typesize: usize, out: &mut Vec<u8>) {
    out.resize(bytes.len(), 0);
    let count = bytes.len() / typesize;
    match typesize {
        2 => shuffle_elements::<2>(bytes, count, out),
        4 => shuffle_elements::<4>(bytes, count, out),
        _ => {
            for (index, element) in bytes.chunks_exact(typesize).enumerate() {
                for (k, &byte) in element.iter().enumerate() {
                    out[k * count + index] = byte;
                }
            }
        }
    }
    let whole = count * typesize;
    out[whole..].copy_from_slice(&bytes[whole..]);
}

/// [`shuffle`] for the element sizes that the encoder writes. With the size as a compile-time constant, it is
/// several times faster.
fn shuffle_elements<const N: usize>(bytes: &[u8], count: usize, out: &mut [u8]) {
    let (elements, _) = bytes.as_chunks::<N>();
    for (k, stream) in out.chunks_exact_mut(count).take(N).enumerate() {
        for (byte, element) in stream.iter_mut().zip(elements) {
            *byte = element[k];
        }
    }
}

fn unshuffle(shuffled: &[u8], typesize: usize, out: &mut [u8]) {
    let count = shuffled.len() / typesize;
    for (index, element) in out.chunks_exact_mut(typesize).enumerate() {
        for (k, byte) in element.iter_mut().enumerate() {
            *byte = shuffled[k * count + index];
        }
    }
    let whole = count * typesize;
    out[whole..].copy_from_slice(&shuffled[whole..]);
}

// BloscLZ, Blosc's own codec: FastLZ with longer distances.
//
//   000nnnnn                    literal: n + 1 bytes follow
//   lllddddd [255 ..] d         match: copy l + 2 bytes from d + 1 bytes back
//                               l = 7: add the next bytes to l; the first that is not 255 is the last one
//                               d has 13 bits; if all are set, add the next 16 bits, high byte first
//
// The first instruction is always a literal, so its three highest bits are ignored.
//
// This work is based on:
// the description of FastLZ level 2 by A. Hidayat, and streams made by c-blosc 1.21

/// The largest distance that fits into 13 bits.
const DISTANCE_MAX: usize = 8191;

/// Decompresses into `out`. Returns the number of bytes, or `None` if the stream is invalid or too long.
pub(crate) fn decompress_into(packed: &[u8], out: &mut [u8]) -> Option<usize> {
    let mut input = packed.iter().copied();
    let mut at = 0;
    let mut control = input.next()? & 31;
    loop {
        if control < 32 {
            for _ in 0..=control {
                *out.get_mut(at)? = input.next()?;
                at += 1;
            }
        } else {
            let mut length = usize::from(control >> 5) + 2;
            if control >> 5 == 7 {
                loop {
                    let more = input.next()?;
                    length = length.checked_add(more.into())?;
                    if more != 255 {
                        break;
                    }
                }
            }
            let high = usize::from(control & 31) << 8;
            let low = input.next()?;
            let mut distance = high + usize::from(low) + 1;
            if low == 255 && high == 31 << 8 {
                distance = (usize::from(input.next()?) << 8) + usize::from(input.next()?) + DISTANCE_MAX + 1;
            }
            let start = at.checked_sub(distance)?;
            let end = at.checked_add(length).filter(|&end| end <= out.len())?;
            // Copied byte by byte, because the source can overlap the destination.
            for index in at..end {
                out[index] = out[start + index - at];
            }
            at = end;
        }
        match input.next() {
            Some(next) => control = next,
            None => return Some(at),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn distances(count: usize) -> Vec<u8> {
        (0..count).flat_map(|i| ((i as f32 * 0.37).sin() * 0.3).to_le_bytes()).collect()
    }

    #[test]
    fn frames_of_any_length_round_trip() {
        let mut encoder = Encoder::new();
        for count in 1..2000 {
            for typesize in [2, 4] {
                let bytes = distances(count);
                let mut frame = vec![7];
                if !encoder.append_frame(&bytes, typesize, &mut frame) {
                    assert_eq!(frame, [7]);
                    continue;
                }
                let mut back = vec![0; bytes.len()];
                decode_frame(&frame[1..], &mut back).expect("own frame");
                assert_eq!(back, bytes, "{count} floats");
            }
        }
    }

    #[test]
    fn long_blocks_are_split_into_streams() {
        let mut encoder = Encoder::new();
        for (count, flags) in [(64, 0x31), (127, 0x31), (128, 0x21), (512, 0x21)] {
            let mut frame = Vec::new();
            assert!(encoder.append_frame(&vec![1; count * 4], 4, &mut frame));
            assert_eq!(frame[2], flags, "{count} floats");
        }
        assert!(!encoder.append_frame(&[1; 124], 4, &mut Vec::new()));
    }

    /// Overlapping blocks would make a small frame expensive to decode.
    #[test]
    fn overlapping_blocks_are_an_error() {
        let length = |bytes: &[u8]| u32::try_from(bytes.len()).expect("short");
        let packed = lz4_flex::block::compress(&distances(64));
        let stream = [&length(&packed).to_le_bytes(), &packed[..]].concat();
        let frame = |starts: [u32; 3], body: &[u8]| {
            let numbers = [3 * 256, 256, 28 + length(body)].into_iter().chain(starts);
            let head = [2, 1, CODEC_LZ4 << CODEC_SHIFT | NOT_SPLIT, 4].into_iter();
            head.chain(numbers.flat_map(u32::to_le_bytes)).chain(body.iter().copied()).collect::<Vec<u8>>()
        };
        let starts = [0, 1, 2].map(|index| 28 + index * length(&stream));
        let mut out = vec![0; 3 * 256];
        decode_frame(&frame(starts, &stream.repeat(3)), &mut out).expect("one after the other");
        assert_eq!(out, distances(64).repeat(3));
        let Err(BloscError::Invalid(what)) = decode_frame(&frame([28; 3], &stream), &mut out) else {
            panic!("blocks of the same bytes");
        };
        assert!(what.contains("overlap"), "{what}");
    }

    #[test]
    fn invalid_frames_are_errors() {
        let bytes = distances(300);
        let mut frame = Vec::new();
        assert!(Encoder::new().append_frame(&bytes, 4, &mut frame));
        let mut back = vec![0; bytes.len()];
        for length in 0..frame.len() {
            assert!(decode_frame(&frame[..length], &mut back).is_err());
        }
        for bit in 0..frame.len() * 8 {
            let mut broken = frame.clone();
            broken[bit / 8] ^= 1 << (bit % 8);
            let _ = decode_frame(&broken, &mut back);
        }
    }

    /// The output of c-blosc 1.21 for the text of [`unpacked`].
    const PACKED: [u8; 40] = [
        0x29, 0x61, 0x62, 0x63, 0x64, 0x65, 0x66, 0x67, 0x68, 0x69, 0x6a, 0xe0, 0x0a, 0x09, 0x01, 0x6a, 0x78,
        0xe0, 0x1d, 0x00, 0x00, 0x78, 0xe0, 0x0a, 0x3b, 0xe0, 0x0b, 0x4f, 0xe0, 0xff, 0x1a, 0x13, 0xe1, 0xff,
        0x4a, 0x71, 0x02, 0x68, 0x69, 0x6a,
    ];

    fn unpacked() -> Vec<u8> {
        let once = [b"abcdefghij".repeat(3), b"x".repeat(40), b"abcdefghij".repeat(30)].concat();
        once.repeat(2)
    }

    #[test]
    fn c_blosc_streams_are_decoded() {
        let mut out = vec![0; 740];
        assert_eq!(decompress_into(&PACKED, &mut out), Some(740));
        assert_eq!(out, unpacked());
    }

    #[test]
    fn far_repeats_are_decoded() {
        let mut packed = vec![31];
        let start: Vec<u8> = (0..32).collect();
        packed.extend(&start);
        // 32 different bytes, then the last one 9000 times, then six bytes from 9010 back: among the first
        // 32.
        packed.extend([0xe0].into_iter().chain([255; 35]).chain([66, 0]));
        let far = u16::try_from(9010 - DISTANCE_MAX - 1).unwrap();
        packed.extend([0x9f, 255]);
        packed.extend(far.to_be_bytes());
        let mut out = vec![0; 10_000];
        assert_eq!(decompress_into(&packed, &mut out), Some(32 + 9000 + 6));
        assert_eq!(out[32 + 9000..][..6], start[22..28]);
    }

    #[test]
    fn damaged_streams_do_not_panic() {
        let mut out = vec![0; 740];
        for length in 0..PACKED.len() {
            let _ = decompress_into(&PACKED[..length], &mut out);
            for bit in 0..8 {
                let mut damaged = PACKED;
                damaged[length] ^= 1 << bit;
                let _ = decompress_into(&damaged, &mut out);
            }
        }
        assert_eq!(decompress_into(&PACKED, &mut [0; 739]), None);
        assert_eq!(decompress_into(&[], &mut out), None);
    }
}
