//! One bit per voxel of a leaf.

use rayon::prelude::*;

use super::leaf::{Field, Leaf};
use crate::simd::{Kernel, dispatch};

/// 512 bits: word x, byte y of the word, bit z of the byte.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct LeafMask {
    /// One word for each x.
    pub words: [u64; 8],
}

impl LeafMask {
    /// No voxel.
    pub const EMPTY: LeafMask = LeafMask { words: [0; 8] };

    /// Every voxel.
    pub const FULL: LeafMask = LeafMask { words: [u64::MAX; 8] };

    /// The mask of the voxels whose place in the leaf satisfies `test`.
    pub fn from_fn(test: impl Fn(usize) -> bool) -> LeafMask {
        let mut mask = LeafMask::EMPTY;
        for offset in 0..512 {
            mask.words[offset >> 6] |= u64::from(test(offset)) << (offset & 63);
        }
        mask
    }

    /// Whether the voxel at this place in the leaf is in.
    pub fn contains(&self, offset: usize) -> bool {
        self.words[offset >> 6] >> (offset & 63) & 1 == 1
    }

    /// Puts in the voxel at this place in the leaf.
    pub fn insert(&mut self, offset: usize) {
        self.words[offset >> 6] |= 1 << (offset & 63);
    }

    /// Takes out every voxel that is in `other`.
    pub fn remove_all(&mut self, other: &LeafMask) {
        for (word, other) in self.words.iter_mut().zip(other.words) {
            *word &= !other;
        }
    }

    /// The 8 bits of row (x, y), bit z for voxel z; `row` is `x·8 + y`.
    pub fn row(&self, row: usize) -> u8 {
        (self.words[row >> 3] >> ((row & 7) * 8)) as u8
    }

    /// The rows that hold a voxel: bit `x·8 + y`.
    pub fn occupied_rows(&self) -> u64 {
        self.rows_with(0xff)
    }

    /// The rows that hold a voxel whose bit along z is in `along_z`: bit `x·8 + y`.
    pub fn rows_with(&self, along_z: u8) -> u64 {
        (0..64).fold(0, |rows, row| rows | u64::from(self.row(row) & along_z != 0) << row)
    }

    /// Whether no voxel is in.
    pub fn is_empty(&self) -> bool {
        self.words == [0; 8]
    }

    /// How many voxels are in.
    pub fn count(&self) -> u32 {
        self.words.iter().map(|word| word.count_ones()).sum()
    }

    /// The places in the leaf of the voxels that are in, in order.
    pub fn iter(&self) -> impl Iterator<Item = usize> + '_ {
        self.words.iter().enumerate().flat_map(|(index, &word)| {
            let mut rest = word;
            std::iter::from_fn(move || {
                (rest != 0).then(|| {
                    let bit = rest.trailing_zeros() as usize;
                    rest &= rest - 1;
                    index << 6 | bit
                })
            })
        })
    }
}

/// For each leaf of a field the voxels whose value is below zero. Zero of either sign is not.
pub fn negative_masks(field: &Field) -> Vec<LeafMask> {
    let mut masks = vec![LeafMask::EMPTY; field.leaves.len()];
    let pieces = masks.par_chunks_mut(LEAVES_AT_ONCE).zip(field.leaves.par_chunks(LEAVES_AT_ONCE));
    pieces.for_each(|(masks, leaves)| dispatch(NegativeMasks { masks, leaves }));
    masks
}

/// Leaves in a piece of work.
const LEAVES_AT_ONCE: usize = 64;

/// Finds the masks of some leaves.
struct NegativeMasks<'a> {
    masks: &'a mut [LeafMask],
    leaves: &'a [Leaf],
}

impl Kernel for NegativeMasks<'_> {
    type Output = ();

    #[inline(always)]
    fn run(self) {
        for (mask, leaf) in self.masks.iter_mut().zip(self.leaves) {
            for (x, word) in mask.words.iter_mut().enumerate() {
                // Whole rows at a time, so the bits come with y and z swapped: byte z, bit y.
                let mut columns = [0u32; 8];
                for y in 0..8 {
                    let row = leaf.row(x * 8 + y);
                    for z in 0..8 {
                        columns[z] |= u32::from(row[z] < 0.0) << y;
                    }
                }
                *word = transposed(u64::from_le_bytes(columns.map(|column| column as u8)));
            }
        }
    }
}

/// Eight bytes with bit j of byte i at bit i of byte j: blocks of 1, 2 and 4 bits change places.
#[inline(always)]
fn transposed(bytes: u64) -> u64 {
    let swap = |bytes: u64, distance: u32, below: u64| {
        let differ = (bytes ^ bytes >> distance) & below;
        bytes ^ differ ^ differ << distance
    };
    let pairs = swap(bytes, 7, 0x00aa_00aa_00aa_00aa);
    let fours = swap(pairs, 14, 0x0000_cccc_0000_cccc);
    swap(fours, 28, 0x0000_0000_f0f0_f0f0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn signs_become_bits_in_their_place() {
        let mut leaf = Leaf::splat(0.0);
        for (offset, value) in leaf.values.iter_mut().enumerate() {
            *value = [-1.0, 0.0, -0.0, 2.0, f32::NAN, -1e-30][offset * offset % 11 % 6];
        }
        let expected = LeafMask::from_fn(|offset| leaf.values[offset] < 0.0);
        let field = Field { leaves: vec![Leaf::splat(-1.0), leaf] };
        assert_eq!(negative_masks(&field), [LeafMask::FULL, expected]);
        assert!(!expected.is_empty());
    }
}
