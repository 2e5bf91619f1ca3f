//! LZF, the compression of PCD and of h5py.
//!
//! ```text
//!   000lllll                        l + 1 bytes follow, which are copied
//!   lllooooo [more l] oooooooo      l + 2 bytes are copied from o + 1 bytes before; l = 7: a byte more of l
//! ```

/// The most bytes that a byte expands to: three bytes give 264.
const EXPANSION_MAX: usize = 88;

/// Unpacks bytes; `None` if they are damaged, or are not `size` bytes unpacked.
pub(crate) fn unpacked(packed: &[u8], size: usize) -> Option<Vec<u8>> {
    if size > packed.len().saturating_mul(EXPANSION_MAX) {
        return None;
    }
    let mut out = Vec::with_capacity(size);
    let mut rest = packed;
    while let Some(&control) = rest.split_off_first() {
        let control = usize::from(control);
        if control < 32 {
            out.extend_from_slice(rest.split_off(..control + 1)?);
        } else {
            let mut next = || rest.split_off_first().map(|&byte| usize::from(byte));
            let mut length = (control >> 5) + 2;
            if length == 9 {
                length += next()?;
            }
            let distance = ((control & 31) << 8) + next()? + 1;
            let start = out.len().checked_sub(distance)?;
            for at in start..start + length {
                out.push(out[at]);
            }
        }
        if out.len() > size {
            return None;
        }
    }
    (out.len() == size).then_some(out)
}
