//! One bit per voxel of a leaf.

/// 512 bits: word x, byte y of the word, bit z of the byte.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct LeafMask {
    /// One word for each x.
    pub words: [u64; 8],
}

impl LeafMask {
    /// No voxel.
    pub const EMPTY: LeafMask = LeafMask { words: [0; 8] };

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
    #[inline(always)]
    pub fn row(&self, row: usize) -> u8 {
        (self.words[(row >> 3) & 7] >> ((row & 7) * 8)) as u8
    }

    /// Sets the 8 bits of row (x, y).
    #[inline(always)]
    pub fn set_row(&mut self, row: usize, bits: u8) {
        let (word, shift) = (&mut self.words[(row >> 3) & 7], (row & 7) * 8);
        *word = *word & !(0xff << shift) | u64::from(bits) << shift;
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
