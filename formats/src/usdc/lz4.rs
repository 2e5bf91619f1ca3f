//! LZ4 blocks as the crate format stores them: the number of chunks in one byte, and the chunks.
//!
//! ```text
//!   0   LZ4 block                                    one block
//!   n   i32 size, LZ4 block; i32 size, ..            n chunks, for more than 2 GB
//! ```

use lz4_flex::block::{compress_into, decompress_into, get_maximum_output_size};

/// The most bytes in a block.
const BLOCK_BYTES_MAX: usize = 0x7e00_0000;

/// The most chunks.
const CHUNKS_MAX: usize = 127;

/// Appends the compressed bytes; `None` if they are more than all chunks hold, 250 GiB.
pub(super) fn append_compressed(bytes: &[u8], out: &mut Vec<u8>) -> Option<()> {
    if bytes.len() <= BLOCK_BYTES_MAX {
        out.push(0);
        return append_block(bytes, out);
    }
    let chunks = bytes.chunks(BLOCK_BYTES_MAX);
    out.push(u8::try_from(chunks.len()).ok().filter(|&count| usize::from(count) <= CHUNKS_MAX)?);
    for chunk in chunks {
        let start = out.len();
        out.extend_from_slice(&[0; 4]);
        append_block(chunk, out)?;
        let size = i32::try_from(out.len() - start - 4).ok()?;
        out[start..start + 4].copy_from_slice(&size.to_le_bytes());
    }
    Some(())
}

fn append_block(bytes: &[u8], out: &mut Vec<u8>) -> Option<()> {
    let start = out.len();
    out.resize(start + get_maximum_output_size(bytes.len()), 0);
    let length = compress_into(bytes, &mut out[start..]).ok()?;
    out.truncate(start + length);
    Some(())
}

/// Decompresses into `out` and returns the number of bytes; `None` if the data are invalid or longer than
/// `out`.
pub(super) fn decompress(bytes: &[u8], out: &mut [u8]) -> Option<usize> {
    let (&chunk_count, mut rest) = bytes.split_first()?;
    if chunk_count == 0 {
        return decompress_into(rest, out).ok();
    }
    let mut length = 0;
    for _ in 0..chunk_count {
        let (size, chunks) = rest.split_first_chunk()?;
        let size = usize::try_from(i32::from_le_bytes(*size)).ok()?;
        length += decompress_into(chunks.get(..size)?, &mut out[length..]).ok()?;
        rest = &chunks[size..];
    }
    Some(length)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn blocks_and_chunks_round_trip() {
        for bytes in [&b""[..], b"a", &[7; 5000], &[1, 2, 3].repeat(99)] {
            let mut block = Vec::new();
            append_compressed(bytes, &mut block).expect("short");
            let mut out = vec![0; bytes.len()];
            assert_eq!(decompress(&block, &mut out), Some(bytes.len()));
            assert_eq!(out, bytes);
            // The same in two chunks.
            let size = i32::try_from(block.len() - 1).expect("short").to_le_bytes();
            let chunk = [&size, &block[1..]].concat();
            let mut out = vec![0; 2 * bytes.len()];
            assert_eq!(decompress(&[&[2], &chunk[..], &chunk].concat(), &mut out), Some(2 * bytes.len()));
            assert_eq!(out, bytes.repeat(2));
        }
        for invalid in [&b""[..], &[1], &[1, 255, 255, 255, 255], &[0, 0xf0], &[3, 1, 0, 0, 0, 0]] {
            assert_eq!(decompress(invalid, &mut [0; 9]), None, "{invalid:?}");
        }
    }
}
