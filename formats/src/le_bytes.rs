//! Writes numbers as little-endian bytes, in chunks that fit into the cache.

use std::io::Write;

use crate::error::Result;

/// Numbers converted per chunk.
const PIECE: usize = 4096;

/// Writes floats.
pub(crate) fn write_f32s(numbers: &[f32], out: &mut impl Write) -> Result<()> {
    write_pieces(numbers, f32::to_le_bytes, out)
}

/// Writes indices.
pub(crate) fn write_u32s(numbers: &[u32], out: &mut impl Write) -> Result<()> {
    write_pieces(numbers, u32::to_le_bytes, out)
}

/// Writes indices that must fit into 16 bits.
pub(crate) fn write_u16s(numbers: &[u32], out: &mut impl Write) -> Result<()> {
    let narrow = |number: u32| {
        let [low, high, _, _] = number.to_le_bytes();
        [low, high]
    };
    write_pieces(numbers, narrow, out)
}

/// Converts each number with `to_bytes` and writes the results.
pub(crate) fn write_pieces<T: Copy, const N: usize>(
    numbers: &[T],
    to_bytes: impl Fn(T) -> [u8; N],
    out: &mut impl Write,
) -> Result<()> {
    let mut bytes = [[0; N]; PIECE];
    for piece in numbers.chunks(PIECE) {
        for (bytes, &number) in bytes.iter_mut().zip(piece) {
            *bytes = to_bytes(number);
        }
        out.write_all(bytes[..piece.len()].as_flattened())?;
    }
    Ok(())
}
