//! Damaged copies of valid files: the same on every machine and in every run.

/// Damages files.
pub(crate) struct Damage(u64);

/// Extreme numbers for counts, lengths and offsets.
const EXTREMES: [u64; 8] =
    [0, 1, 0x7f, 0xff, 0x7fff_ffff, 0xffff_ffff, 0x7fff_ffff_ffff_ffff, 0xffff_ffff_ffff_ffff];

/// Extreme numbers as text, and characters that have a meaning in text formats.
const WORDS: [&[u8]; 16] = [
    b"0",
    b"-1",
    b"4294967296",
    b"18446744073709551615",
    b"1e999",
    b"nan",
    b"\n",
    b"\r\n",
    b" ",
    b",",
    b"\"",
    b"[[[[[[[[",
    b"{",
    b"]",
    b"\\",
    b"\0",
];

impl Damage {
    /// A generator of damage; each name gives different damage.
    pub(crate) fn new(name: &str) -> Damage {
        Damage(name.bytes().fold(1, |seed, byte| seed * 31 % 1_000_003 + u64::from(byte)))
    }

    /// A copy of one of the files, damaged in up to four ways.
    pub(crate) fn done_to(&mut self, files: &[Vec<u8>]) -> Vec<u8> {
        let mut bytes = files[self.below(files.len())].clone();
        for _ in 0..=self.below(4) {
            self.damage(&mut bytes, files);
        }
        bytes
    }

    fn damage(&mut self, bytes: &mut Vec<u8>, files: &[Vec<u8>]) {
        if bytes.is_empty() {
            return bytes.push(0);
        }
        // Damage to headers has the largest effect, so at least half of the damage is in the first 512 bytes.
        let ranges = [bytes.len(), bytes.len().min(512)];
        let range = ranges[self.below(2)];
        let at = self.below(range);
        match self.below(6) {
            0 => bytes.truncate(at),
            1 | 2 => bytes[at] ^= 1 << self.below(8),
            3 => {
                let width = 1 << self.below(4);
                let number = EXTREMES[self.below(EXTREMES.len())].to_le_bytes();
                let end = bytes.len().min(at + width);
                bytes[at..end].copy_from_slice(&number[..end - at]);
            }
            4 => {
                let end = bytes.len().min(at + self.below(8));
                bytes.splice(at..end, WORDS[self.below(WORDS.len())].iter().copied());
            }
            _ => {
                let other = &files[self.below(files.len())];
                let from = self.below(other.len().max(1)).min(other.len());
                let to = other.len().min(from + self.below(256));
                bytes.splice(at..at, other[from..to].iter().copied());
            }
        }
    }

    /// Steele, Lea, Flood. Fast splittable pseudorandom number generators. 2014
    fn below(&mut self, bound: usize) -> usize {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut mixed = self.0;
        mixed = (mixed ^ (mixed >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        mixed = (mixed ^ (mixed >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        mixed ^= mixed >> 31;
        usize::try_from(mixed % bound as u64).unwrap_or(0)
    }
}
