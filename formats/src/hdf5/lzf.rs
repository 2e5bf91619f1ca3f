//! The filter LZF of h5py, which `hdf5-reader` lacks.
//!
//! ```text
//!   000lllll                        l + 1 bytes follow, which are copied
//!   lllooooo [more l] oooooooo      l + 2 bytes are copied from o + 1 bytes before; l = 7: a byte more of l
//! ```

use hdf5_reader::error::Error;

/// The number under which the filter is registered.
pub(super) const FILTER: u16 = 32000;

/// Unpacks a chunk, which has this size.
pub(super) fn unpacked(
    packed: &[u8],
    size: Option<u32>,
    bytes_max: usize,
) -> hdf5_reader::error::Result<Vec<u8>> {
    let damaged = || Error::DecompressionError("LZF: the chunk is damaged".into());
    let size = size.and_then(|size| usize::try_from(size).ok()).ok_or_else(damaged)?;
    if size > bytes_max {
        return Err(Error::ResourceLimit(format!("a chunk of {size} bytes, more than {bytes_max}")));
    }
    let mut out = Vec::new();
    let mut rest = packed;
    while let Some((&control, after)) = rest.split_first() {
        rest = after;
        let mut next = || rest.split_off_first().map(|&byte| usize::from(byte)).ok_or_else(damaged);
        let control = usize::from(control);
        if control < 32 {
            let (literal, after) = rest.split_at_checked(control + 1).ok_or_else(damaged)?;
            out.extend_from_slice(literal);
            rest = after;
        } else {
            let mut length = (control >> 5) + 2;
            if length == 9 {
                length += next()?;
            }
            let distance = ((control & 31) << 8) + next()? + 1;
            let start = out.len().checked_sub(distance).ok_or_else(damaged)?;
            for at in start..start + length {
                out.push(out[at]);
            }
        }
        if out.len() > size {
            return Err(damaged());
        }
    }
    if out.len() == size { Ok(out) } else { Err(damaged()) }
}
