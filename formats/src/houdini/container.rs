//! The container of `.sc` files: Blosc frames with an index for seeking. Each frame contains one block of
//! data.
//!
//! ```text
//!   scf1 │ u64 M │ M bytes of metadata │ frame frame frame .. │ index │ u64 bytes of the index │ 1fcs
//!
//!   index   u64 × (frames − 1): offset of each frame but the first, relative to the first frame
//!           u64 decompressed bytes of a block │ u64 decompressed bytes of the last block
//! ```
//!
//! Integers are big-endian, except within frames, where they are little-endian. The last four bytes show that
//! the file is complete.

use rayon::prelude::*;

use crate::blosc::{BloscError, decode_frame};
use crate::bytes::{Cursor, Endian};
use crate::error::{Error, Position, Result};
use crate::limits::Limits;

const FORMAT: &str = "Houdini geometry (.sc)";
const START: &[u8; 4] = b"scf1";
const END: &[u8; 4] = b"1fcs";

/// Size in bytes of a frame without data: the Blosc header.
const FRAME_BYTES_MIN: usize = 16;

/// Decompresses the content into one buffer.
///
/// # Errors
///
/// [`Error::Truncated`] if the end is missing, [`Error::Invalid`] if the index or a frame is invalid,
/// [`Error::TooLarge`] beyond `limits`.
pub(super) fn decompress(bytes: &[u8], limits: &Limits) -> Result<Vec<u8>> {
    if !bytes.ends_with(END) {
        let position = Position::Offset(bytes.len() as u64);
        return Err(Error::truncated(FORMAT, position, "the file ends without its index"));
    }
    let Index { frames, block_bytes, bytes: unpacked_bytes } = index(bytes)?;
    let packed_bytes: usize = frames.iter().map(|(_, frame)| frame.len()).sum();
    limits.check_decompressed(FORMAT, unpacked_bytes as u64, packed_bytes as u64)?;
    let mut decompressed = vec![0; unpacked_bytes];
    let blocks = decompressed.par_chunks_mut(block_bytes.max(1)).zip(&frames);
    blocks.try_for_each(|(block, &(at, frame))| {
        decode_frame(frame, block).map_err(|error| match error {
            BloscError::Invalid(what) => Error::invalid(FORMAT, Position::Offset(at as u64), what),
            BloscError::Unsupported(what) => Error::unsupported(FORMAT, what),
        })
    })?;
    Ok(decompressed)
}

/// The parsed index.
struct Index<'a> {
    /// Offset and bytes of each frame.
    frames: Vec<(usize, &'a [u8])>,
    block_bytes: usize,
    /// Decompressed size of all blocks.
    bytes: usize,
}

fn index(bytes: &[u8]) -> Result<Index<'_>> {
    let invalid = |at: usize, what: String| Error::invalid(FORMAT, Position::Offset(at as u64), what);
    let mut cursor = Cursor::new(FORMAT, Endian::Big, bytes, 0);
    if cursor.take(4, "the signature")? != START {
        return Err(invalid(0, "expected the signature scf1".into()));
    }
    let metadata_bytes = length(&mut cursor)?;
    let metadata_at = cursor.at();
    let footer_at = bytes.len().checked_sub(12).filter(|&at| at >= metadata_at);
    let footer_at = footer_at.ok_or_else(|| invalid(metadata_at, "the file has no index".into()))?;
    let index_bytes = length(&mut Cursor::new(FORMAT, Endian::Big, bytes, footer_at))?;
    let first = metadata_at.checked_add(metadata_bytes);
    let index_at = footer_at.checked_sub(index_bytes);
    let (Some(first), Some(index_at)) =
        (first, index_at.filter(|at| first.is_some_and(|first| first <= *at)))
    else {
        let what = format!(
            "the file declares {metadata_bytes} bytes of metadata and an index of {index_bytes} bytes, but has only {} bytes",
            bytes.len()
        );
        return Err(invalid(footer_at, what));
    };
    if index_bytes < 16 || !index_bytes.is_multiple_of(8) {
        return Err(invalid(footer_at, format!("the index has an invalid size of {index_bytes} bytes")));
    }
    let frame_count = index_bytes / 8 - 1;
    let mut entries = Cursor::new(FORMAT, Endian::Big, bytes, index_at);
    let mut starts = vec![first];
    for _ in 1..frame_count {
        starts.push(length(&mut entries)?.saturating_add(first));
    }
    let [block_bytes, last_bytes] = [length(&mut entries)?, length(&mut entries)?];
    let mut frames = Vec::with_capacity(frame_count);
    for (index, &start) in starts.iter().enumerate() {
        let end = starts.get(index + 1).copied().unwrap_or(index_at);
        match bytes.get(start..end) {
            Some(frame) if frame.len() >= FRAME_BYTES_MIN && end <= index_at => frames.push((start, frame)),
            _ => {
                return Err(invalid(
                    index_at,
                    format!("frame {index} of {frame_count} lies outside the frame data"),
                ));
            }
        }
    }
    let before = block_bytes.checked_mul(frame_count - 1);
    let bytes =
        before.and_then(|before| before.checked_add(last_bytes)).filter(|_| last_bytes <= block_bytes);
    let bytes = bytes.ok_or_else(|| {
        invalid(
            index_at,
            format!("invalid block sizes: {block_bytes} bytes, and {last_bytes} for the last block"),
        )
    })?;
    Ok(Index { frames, block_bytes, bytes })
}

/// Reads a size or an offset in bytes. Saturates: a value beyond the address space is invalid anyway.
fn length(cursor: &mut Cursor) -> Result<usize> {
    let length = u64::from_le_bytes(cursor.array("a length")?);
    Ok(usize::try_from(length).unwrap_or(usize::MAX))
}
