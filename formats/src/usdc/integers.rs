//! Encodes integers before LZ4 compresses them: as differences, of which the most common one takes two bits.
//!
//! ```text
//!   values        123, 124, 125, 100125, 100125
//!   differences   123, 1, 1, 100000, 0                         the first one is relative to 0
//!   encoded       1 │ 01 00 00 11 01 │ 123, 100000, 0          most common │ 2-bit codes │ other differences
//!
//!   code          0 common    1 narrow     2 medium     3 wide
//!   32 bits                   8 bits       16 bits      32 bits
//!   64 bits                   16 bits      32 bits      64 bits
//! ```
//!
//! Four codes share a byte, the first one in its lowest bits.

use std::ops::Range;

/// An integer type that can be encoded. All arithmetic wraps around at the size of the type.
pub(super) trait Integer: Copy {
    /// The sizes of a narrow, a medium and a wide difference, in bytes.
    const CODE_BYTES: [usize; 3];
    fn widened(self) -> i64;
    /// The lowest bits of `value`.
    fn lowest(value: i64) -> Self;
}

impl Integer for i32 {
    const CODE_BYTES: [usize; 3] = [1, 2, 4];
    fn widened(self) -> i64 {
        i64::from(self)
    }
    #[expect(clippy::cast_possible_truncation, reason = "the coding wraps")]
    fn lowest(value: i64) -> i32 {
        value as i32
    }
}

impl Integer for i64 {
    const CODE_BYTES: [usize; 3] = [2, 4, 8];
    fn widened(self) -> i64 {
        self
    }
    fn lowest(value: i64) -> i64 {
        value
    }
}

/// The maximum size of `count` encoded integers, in bytes; `None` if it exceeds `usize`.
pub(super) fn encoded_bytes_max<T: Integer>(count: usize) -> Option<usize> {
    let wide = T::CODE_BYTES[2];
    count.checked_mul(wide)?.checked_add(wide)?.checked_add(count.div_ceil(4))
}

/// The size of a difference in memory, in bytes.
const WHOLE_BYTES: usize = size_of::<i64>();

/// The differences that are counted to find the most common one: those of 16 bits.
const COUNTED: Range<i64> = -(1 << 15)..1 << 15;

/// Encodes integers, which replace the bytes of `out`; no integers take no bytes.
pub(super) fn encode<T: Integer>(values: impl ExactSizeIterator<Item = T> + Clone, out: &mut Vec<u8>) {
    let [narrow, medium, wide] = T::CODE_BYTES;
    let count = values.len();
    out.clear();
    if count == 0 {
        return;
    }
    let mut last = T::lowest(0);
    let differences = values.map(move |value| {
        let difference = T::lowest(value.widened().wrapping_sub(last.widened())).widened();
        last = value;
        difference
    });
    let common = most_common(differences.clone());
    out.resize(wide + count.div_ceil(4), 0);
    out[..wide].copy_from_slice(&common.to_le_bytes()[..wide]);
    let (mut differences, mut at) = (differences, wide);
    // The differences of a piece. They are collected here, because a vector of the largest possible size
    // would have to be cleared.
    let mut others = [0; PIECE * WHOLE_BYTES];
    for piece in 0..count.div_ceil(PIECE) {
        let piece_count = PIECE.min(count - piece * PIECE);
        let codes = &mut out[at..at + piece_count.div_ceil(4)];
        let mut end = 0;
        for codes in &mut *codes {
            for (shift, difference) in [0, 2, 4, 6].into_iter().zip(&mut differences) {
                // Without branches, because the sizes of differences are hard to predict.
                let code = u8::from(difference != common)
                    * (1 + u8::from(!fits(difference, narrow)) + u8::from(!fits(difference, medium)));
                *codes |= code << shift;
                // Copies eight bytes, because copying a constant number is faster. The next difference
                // overwrites the excess.
                others[end..end + WHOLE_BYTES].copy_from_slice(&difference.to_le_bytes());
                end += [0, narrow, medium, wide][usize::from(code)];
            }
        }
        at += codes.len();
        out.extend_from_slice(&others[..end]);
    }
}

/// The number of integers that are encoded at a time, a multiple of four.
const PIECE: usize = 1024;

/// Whether a number fits into a signed integer of this many bytes.
fn fits(value: i64, bytes: usize) -> bool {
    let unused = 64 - 8 * bytes;
    (value << unused) >> unused == value
}

/// The most common difference. If several are equally common, the largest of them, which saves most.
fn most_common(differences: impl Iterator<Item = i64>) -> i64 {
    let mut counts = vec![0_u32; 1 << 16];
    for difference in differences.filter(|difference| COUNTED.contains(difference)) {
        let count = &mut counts[code_index(difference)];
        *count = count.saturating_add(1);
    }
    COUNTED.max_by_key(|&difference| counts[code_index(difference)]).unwrap_or_default()
}

#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "counted differences have 16 bits"
)]
fn code_index(difference: i64) -> usize {
    (difference - COUNTED.start) as usize
}

/// Decodes `count` integers; `None` if the bytes are too few or too many.
pub(super) fn decode<T: Integer>(bytes: &[u8], count: usize) -> Option<Vec<T>> {
    if count == 0 {
        return bytes.is_empty().then(Vec::new);
    }
    let (common, rest) = bytes.split_at_checked(T::CODE_BYTES[2])?;
    let (codes, mut rest) = rest.split_at_checked(count.div_ceil(4))?;
    let common = signed(common);
    let mut values = Vec::with_capacity(count);
    let mut last = 0_i64;
    for index in 0..count {
        let difference = match (codes[index / 4] >> (2 * (index % 4))) & 3 {
            0 => common,
            code => {
                let number;
                (number, rest) = rest.split_at_checked(T::CODE_BYTES[usize::from(code) - 1])?;
                signed(number)
            }
        };
        let value = T::lowest(last.wrapping_add(difference));
        last = value.widened();
        values.push(value);
    }
    rest.is_empty().then_some(values)
}

/// A signed little-endian number of up to eight bytes.
fn signed(bytes: &[u8]) -> i64 {
    let mut all = [0; 8];
    all[..bytes.len()].copy_from_slice(bytes);
    let unused = 64 - 8 * bytes.len();
    (i64::from_le_bytes(all) << unused) >> unused
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn encoding_is_the_documented_one() {
        let mut encoded = vec![7]; // of an earlier array
        encode([123_i32, 124, 125, 100_125, 100_125, 100_126, 100_126].into_iter(), &mut encoded);
        // The codes are 1 0 0 3, then 1 0 1: the most common difference is 1, which occurs three times.
        let expected =
            [&1_i32.to_le_bytes()[..], &[0b1100_0001, 0b0001_0001, 123], &100_000_i32.to_le_bytes(), &[0, 0]];
        assert_eq!(encoded, expected.concat());
    }

    #[test]
    fn integers_round_trip_and_damage_is_noticed() {
        let edges = [0, 1, -1, 127, -128, 128, 32_767, -32_768, 32_768, 65_536, i64::from(i32::MAX)];
        let more = [i64::from(i32::MIN), i64::MAX, i64::MIN, 3, 3, 3, 3];
        let mut bytes = Vec::new();
        let long: Vec<i64> = edges.iter().chain(&more).copied().cycle().take(5000).collect();
        for count in [0, 1, 2, 3, 4, 5, 17, 1000, 1023, 1024, 1025, 2048, 5000] {
            let wide = &long[..count];
            encode(wide.iter().copied(), &mut bytes);
            assert!(bytes.len() <= encoded_bytes_max::<i64>(count).expect("small"));
            assert_eq!(decode::<i64>(&bytes, count).expect("intact"), wide);
            let narrow: Vec<i32> = wide.iter().map(|&value| i32::lowest(value)).collect();
            encode(narrow.iter().copied(), &mut bytes);
            assert_eq!(decode::<i32>(&bytes, count).expect("intact"), narrow);
            if count > 0 {
                assert!(decode::<i32>(&bytes[..bytes.len() - 1], count).is_none());
                assert!(decode::<i32>(&[&bytes[..], &[0]].concat(), count).is_none());
            }
        }
        assert_eq!(encoded_bytes_max::<i32>(usize::MAX), None);
    }
}
