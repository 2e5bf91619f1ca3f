//! BloscLZ, Blosc's own codec: FastLZ with longer distances.
//!
//! ```text
//!   000nnnnn                    literal: n + 1 bytes follow
//!   lllddddd [255 ..] d         match: copy l + 2 bytes from d + 1 bytes back
//!                               l = 7: add the next bytes to l; the first that is not 255 is the last one
//!                               d has 13 bits; if all are set, add the next 16 bits, high byte first
//! ```
//!
//! The first instruction is always a literal, so its three highest bits are ignored.
//!
//! This work is based on:
//! the description of FastLZ level 2 by A. Hidayat, and streams made by c-blosc 1.21

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
