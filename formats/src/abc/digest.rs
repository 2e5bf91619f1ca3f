//! MurmurHash3 of a stream, in the 128-bit variant for 64-bit machines with seed 0. Alembic identifies
//! samples by this hash.

use std::io::{self, Write};

/// The size of a digest, in bytes.
pub(crate) const DIGEST_BYTES: usize = 16;

/// A digest as stored.
pub(crate) type SampleKey = [u8; DIGEST_BYTES];

const FACTORS: [u64; 2] = [0x87c3_7b91_1142_53d5, 0x4cf5_ad43_2745_937f];

/// Computes the digest of the bytes that are written to it.
#[derive(Clone, Debug, Default)]
pub(crate) struct Hasher {
    state: [u64; 2],
    /// An incomplete block; its bytes after the first `pending_count` are zero.
    pending: [u8; DIGEST_BYTES],
    pending_count: usize,
    length: u64,
}

impl Hasher {
    /// The digest of these bytes.
    pub(crate) fn digest(bytes: &[u8]) -> SampleKey {
        let mut hasher = Hasher::default();
        hasher.update(bytes);
        hasher.finish()
    }

    pub(crate) fn update(&mut self, mut bytes: &[u8]) {
        self.length = self.length.wrapping_add(bytes.len() as u64);
        if self.pending_count > 0 {
            let (head, rest) = bytes.split_at(bytes.len().min(DIGEST_BYTES - self.pending_count));
            self.pending[self.pending_count..][..head.len()].copy_from_slice(head);
            self.pending_count += head.len();
            bytes = rest;
            if self.pending_count < DIGEST_BYTES {
                return;
            }
            self.state = mixed(self.state, &self.pending);
        }
        let (blocks, rest) = bytes.as_chunks::<DIGEST_BYTES>();
        self.state = blocks.iter().fold(self.state, mixed);
        self.pending = [0; DIGEST_BYTES];
        self.pending[..rest.len()].copy_from_slice(rest);
        self.pending_count = rest.len();
    }

    /// The digest of all bytes so far.
    pub(crate) fn finish(&self) -> SampleKey {
        let [mut a, mut b] = self.state;
        // The unused bytes of the last block are zero. A block of zeros does not change the state.
        let [low, high] = words(&self.pending);
        b ^= scrambled_high(high);
        a ^= scrambled_low(low);
        a ^= self.length;
        b ^= self.length;
        a = a.wrapping_add(b);
        b = b.wrapping_add(a);
        [a, b] = [avalanche(a), avalanche(b)];
        a = a.wrapping_add(b);
        b = b.wrapping_add(a);
        let mut digest = [0; DIGEST_BYTES];
        digest[..8].copy_from_slice(&a.to_le_bytes());
        digest[8..].copy_from_slice(&b.to_le_bytes());
        digest
    }
}

impl Write for Hasher {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.update(bytes);
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

fn words(block: &[u8; DIGEST_BYTES]) -> [u64; 2] {
    let [a, b, c, d, e, f, g, h, rest @ ..] = *block;
    [u64::from_le_bytes([a, b, c, d, e, f, g, h]), u64::from_le_bytes(rest)]
}

fn scrambled_low(word: u64) -> u64 {
    word.wrapping_mul(FACTORS[0]).rotate_left(31).wrapping_mul(FACTORS[1])
}

fn scrambled_high(word: u64) -> u64 {
    word.wrapping_mul(FACTORS[1]).rotate_left(33).wrapping_mul(FACTORS[0])
}

fn mixed([a, b]: [u64; 2], block: &[u8; DIGEST_BYTES]) -> [u64; 2] {
    let [low, high] = words(block);
    let a = (a ^ scrambled_low(low)).rotate_left(27).wrapping_add(b);
    let a = a.wrapping_mul(5).wrapping_add(0x52dc_e729);
    let b = (b ^ scrambled_high(high)).rotate_left(31).wrapping_add(a);
    [a, b.wrapping_mul(5).wrapping_add(0x3849_5ab5)]
}

fn avalanche(word: u64) -> u64 {
    let word = (word ^ word >> 33).wrapping_mul(0xff51_afd7_ed55_8ccd);
    let word = (word ^ word >> 33).wrapping_mul(0xc4ce_b9fe_1a85_ec53);
    word ^ word >> 33
}

#[cfg(test)]
mod tests {
    use super::*;

    fn hex(digest: SampleKey) -> String {
        digest.iter().map(|byte| format!("{byte:02x}")).collect()
    }

    /// The digests that the Alembic library stores with these samples.
    #[test]
    fn digests_equal_those_of_the_alembic_library() {
        let corners: Vec<u8> = [2i32, 1, 0].iter().flat_map(|value| value.to_le_bytes()).collect();
        assert_eq!(hex(Hasher::digest(&corners)), CORNERS);
        let positions: Vec<u8> = [[0.0f32, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]
            .as_flattened()
            .iter()
            .flat_map(|value| value.to_le_bytes())
            .collect();
        assert_eq!(hex(Hasher::digest(&positions)), POSITIONS);
    }

    const CORNERS: &str = "395b06ea4831a46b1658804e565ebd04";
    const POSITIONS: &str = "740a45f98aeef44cba0a3ca6c0b13225";

    #[test]
    fn pieces_of_any_length_give_the_same_digest() {
        let bytes: Vec<u8> = (0..100u8).collect();
        for length in 0..bytes.len() {
            let whole = Hasher::digest(&bytes[..length]);
            for piece in 1..=40 {
                let mut hasher = Hasher::default();
                bytes[..length].chunks(piece).for_each(|piece| hasher.update(piece));
                assert_eq!(hasher.finish(), whole, "{length} bytes in pieces of {piece}");
            }
        }
    }
}
