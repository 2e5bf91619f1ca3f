//! Derives the UUID of a file from its content.
//!
//! OpenVDB gives every file a random UUID. Ours is computed from the bytes, so that equal inputs produce
//! equal files. Two files with the same content have the same UUID: the UUID identifies the content.
/// A digest of bytes. To combine digests, compute the digest of their bytes.
pub(super) type Digest = [u64; 2];

/// A 128-bit digest with two multiplicative lanes, eight bytes per step. Not collision-resistant against
/// attackers.
pub(super) fn digest(bytes: &[u8]) -> Digest {
    let (words, rest) = bytes.as_chunks::<8>();
    let mut last = [0; 8];
    last[..rest.len()].copy_from_slice(rest);
    let mut lanes: Digest = [0x243f_6a88_85a3_08d3, 0x1319_8a2e_0370_7344]; // the fractional bits of pi
    let tail = [u64::from_le_bytes(last), bytes.len() as u64];
    for word in words.iter().map(|&word| u64::from_le_bytes(word)).chain(tail) {
        lanes[0] = (lanes[0] ^ word).wrapping_mul(0x9e37_79b9_7f4a_7c15).rotate_left(29);
        lanes[1] = (lanes[1] ^ word.rotate_left(32)).wrapping_mul(0xc2b2_ae3d_27d4_eb4f).rotate_left(31);
    }
    [scramble(lanes[0] ^ lanes[1].rotate_left(17)), scramble(lanes[1] ^ lanes[0].rotate_left(41))]
}

/// Mixes the bits: every bit of the result depends on every bit of the argument.
fn scramble(mut word: u64) -> u64 {
    word = (word ^ word >> 32).wrapping_mul(0xd6e8_feb8_6659_fd93);
    word = (word ^ word >> 32).wrapping_mul(0xd6e8_feb8_6659_fd93);
    word ^ word >> 32
}

/// Formats the digest as a UUID of version 8 (RFC 9562: custom), 36 characters.
pub(super) fn format(digest: Digest) -> String {
    let high = digest[0] & !0xf000 | 0x8000;
    let low = digest[1] & !(3 << 62) | 2 << 62;
    format!(
        "{:08x}-{:04x}-{:04x}-{:04x}-{:012x}",
        high >> 32,
        high >> 16 & 0xffff,
        high & 0xffff,
        low >> 48,
        low & 0xffff_ffff_ffff
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn changing_any_bit_changes_the_digest() {
        let bytes: Vec<u8> = (0..77).collect();
        let reference = digest(&bytes);
        for bit in 0..bytes.len() * 8 {
            let mut changed = bytes.clone();
            changed[bit / 8] ^= 1 << (bit % 8);
            let changed = digest(&changed);
            assert!(changed[0] != reference[0] && changed[1] != reference[1]);
        }
        assert_ne!(digest(&[0; 3]), digest(&[0; 4]));
    }

    #[test]
    fn digest_is_formatted_as_a_version_8_uuid() {
        let uuid = format(digest(b"meniscus"));
        assert_eq!(uuid.len(), 36);
        assert_eq!(uuid.split('-').map(str::len).collect::<Vec<_>>(), [8, 4, 4, 4, 12]);
        assert_eq!(&uuid[14..15], "8");
    }
}
