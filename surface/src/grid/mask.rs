//! One bit per voxel of a leaf.

use glam::IVec3;
use rayon::prelude::*;

use super::stencil::ROW_COUNT;
use super::{Field, Leaf};
use crate::parallel::Loops as _;
use crate::simd::{Kernel, Lanes, dispatch};
use crate::space::CoordBox;

/// A set of voxels of a leaf. Voxel (x, y, z) is bit z of byte y of word x.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct LeafMask {
    /// One word per x.
    pub words: [u64; 8],
}

/// In a word, the first voxel of every row.
const FIRST_OF_ROWS: u64 = 0x0101_0101_0101_0101;

impl LeafMask {
    /// No voxel.
    pub const EMPTY: LeafMask = LeafMask { words: [0; 8] };

    /// Every voxel.
    pub const FULL: LeafMask = LeafMask { words: [u64::MAX; 8] };

    /// The mask of the voxels whose offset in the leaf satisfies `test`.
    pub fn from_fn(test: impl Fn(usize) -> bool) -> LeafMask {
        let mut mask = LeafMask::EMPTY;
        for offset in 0..512 {
            mask.words[offset >> 6] |= u64::from(test(offset)) << (offset & 63);
        }
        mask
    }

    /// True if the mask contains the voxel at this offset.
    pub fn contains(&self, offset: usize) -> bool {
        self.words[offset >> 6] >> (offset & 63) & 1 == 1
    }

    /// Adds the voxel at this offset.
    pub fn insert(&mut self, offset: usize) {
        self.words[offset >> 6] |= 1 << (offset & 63);
    }

    /// Removes every voxel that is in `other`.
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

    /// The rows that contain a voxel of the mask: bit `x·8 + y`.
    #[inline(always)]
    pub fn occupied_rows(&self) -> u64 {
        self.rows_with(0xff)
    }

    /// The rows that contain a voxel whose z bit is set in `along_z`: bit `x·8 + y`.
    #[inline(always)]
    pub fn rows_with(&self, along_z: u8) -> u64 {
        let last_of_rows = FIRST_OF_ROWS << 7;
        let mut rows = 0;
        for (x, word) in self.words.iter().enumerate() {
            let wanted = word & (FIRST_OF_ROWS * u64::from(along_z));
            // The last bit of each byte that is not zero: adding 0x7f carries into it from the other bits.
            let carried = (wanted & !last_of_rows) + (last_of_rows - FIRST_OF_ROWS);
            let occupied = (carried | wanted) & last_of_rows;
            // The product collects these bits in its last byte.
            rows |= ((occupied >> 7).wrapping_mul(0x0102_0408_1020_4080) >> 56) << (8 * x);
        }
        rows
    }

    /// The mask shifted along an axis by `steps` (1 to 7) in both directions. The first result has the voxels
    /// whose predecessor at that distance is in the mask, the second those whose successor is. `before` and
    /// `after` are the masks of the two adjacent leaves on the axis.
    pub fn shifted(&self, axis: usize, steps: usize, before: &LeafMask, after: &LeafMask) -> [LeafMask; 2] {
        debug_assert!((1..=7).contains(&steps));
        let (own, before, after) = (&self.words, &before.words, &after.words);
        let words = |shift: &dyn Fn(usize) -> u64| LeafMask { words: std::array::from_fn(shift) };
        // A step in z is a bit, in y a byte, in x a word. Bits shifted in at an end come from the adjacent
        // leaf.
        match axis {
            0 => [
                words(&|x| if x >= steps { own[x - steps] } else { before[x + 8 - steps] }),
                words(&|x| if x + steps < 8 { own[x + steps] } else { after[x + steps - 8] }),
            ],
            1 => {
                let (bits, rest) = (8 * steps, 64 - 8 * steps);
                [
                    words(&|x| own[x] << bits | before[x] >> rest),
                    words(&|x| own[x] >> bits | after[x] << rest),
                ]
            }
            _ => {
                // In each byte, the bits shifted in from the leaf before, and those from the leaf after.
                let low = FIRST_OF_ROWS * ((1 << steps) - 1);
                let high = low << (8 - steps);
                let rest = 8 - steps;
                [
                    words(&|x| own[x] << steps & !low | before[x] >> rest & low),
                    words(&|x| own[x] >> steps & !high | after[x] << rest & high),
                ]
            }
        }
    }

    /// The voxels that are not in the mask.
    pub fn complement(&self) -> LeafMask {
        LeafMask { words: self.words.map(|word| !word) }
    }

    /// The union of two masks.
    pub fn or(&self, other: &LeafMask) -> LeafMask {
        LeafMask { words: std::array::from_fn(|x| self.words[x] | other.words[x]) }
    }

    /// The intersection of two masks.
    pub fn and(&self, other: &LeafMask) -> LeafMask {
        LeafMask { words: std::array::from_fn(|x| self.words[x] & other.words[x]) }
    }

    /// The voxels in the mask whose six face neighbors are also in the mask. `faces` are the masks of the
    /// leaves beyond the faces, in the order of [`Direction`](super::Direction).
    pub fn surrounded(&self, faces: [&LeafMask; 6]) -> LeafMask {
        (0..3).fold(*self, |left, axis| {
            let [before, after] = self.shifted(axis, 1, faces[2 * axis], faces[2 * axis + 1]);
            left.and(&before).and(&after)
        })
    }

    /// The smallest box around the mask's voxels, relative to the leaf's origin.
    pub fn bounding_box(&self) -> CoordBox {
        let ends = |bits: u8| (bits.trailing_zeros() as i32, 7 - bits.leading_zeros() as i32);
        let any = self.words.iter().fold(0, |any, word| any | word);
        if any == 0 {
            return CoordBox::EMPTY;
        }
        let along = |is_in: &dyn Fn(usize) -> bool| (0..8).fold(0, |bits, k| bits | u8::from(is_in(k)) << k);
        let (x_min, x_max) = ends(along(&|x| self.words[x] != 0));
        let (y_min, y_max) = ends(along(&|y| any >> (8 * y) & 0xff != 0));
        let (z_min, z_max) = ends(any.to_le_bytes().iter().fold(0, |bits, row| bits | row));
        CoordBox { min: IVec3::new(x_min, y_min, z_min), max: IVec3::new(x_max, y_max, z_max) }
    }

    /// The voxels of the mask in each of the leaf's eight cubes of 4³ voxels.
    pub fn eighths(&self) -> [LeafMask; 8] {
        const HALVES_OF_Y: [u64; 2] = [0x0000_0000_ffff_ffff, 0xffff_ffff_0000_0000];
        const HALVES_OF_Z: [u64; 2] = [0x0f0f_0f0f_0f0f_0f0f, 0xf0f0_f0f0_f0f0_f0f0];
        std::array::from_fn(|eighth| {
            let rows = HALVES_OF_Y[eighth >> 1 & 1] & HALVES_OF_Z[eighth & 1];
            let word = |x: usize| if x >> 2 == eighth >> 2 { self.words[x] & rows } else { 0 };
            LeafMask { words: std::array::from_fn(word) }
        })
    }

    /// True if the mask is empty.
    pub fn is_empty(&self) -> bool {
        self.words == [0; 8]
    }

    /// Number of voxels in the mask.
    pub fn count(&self) -> u32 {
        self.words.iter().map(|word| word.count_ones()).sum()
    }

    /// Offsets of the mask's voxels, in order.
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

/// For each leaf of a field, the voxels with a negative value. Zero of either sign is not negative.
pub fn negative_masks(field: &Field) -> Vec<LeafMask> {
    let mut masks = vec![LeafMask::EMPTY; field.leaves.len()];
    let pieces = masks.par_chunks_mut(LEAVES_AT_ONCE).zip(field.leaves.par_chunks(LEAVES_AT_ONCE));
    pieces.halved().for_each(|(masks, leaves)| dispatch(NegativeMasks { masks, leaves }));
    masks
}

/// Number of leaves per task.
const LEAVES_AT_ONCE: usize = 64;

/// Kernel: the masks of some leaves.
struct NegativeMasks<'a> {
    masks: &'a mut [LeafMask],
    leaves: &'a [Leaf],
}

impl Kernel for NegativeMasks<'_> {
    type Output = ();

    #[inline(always)]
    fn run<V: Lanes>(self) {
        for (mask, leaf) in self.masks.iter_mut().zip(self.leaves) {
            for row in 0..ROW_COUNT {
                mask.set_row(row, V::bits(V::load(leaf.row(row)).lt(V::splat(0.0))));
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::grid::{offset_in_leaf, voxel_in_leaf};

    /// A mask with about `of_16` sixteenths of the voxels, different for each seed.
    fn scattered(seed: u32, of_16: u32) -> LeafMask {
        LeafMask::from_fn(|offset| {
            let mixed = (offset as u32 ^ seed << 10).wrapping_mul(0x9e37_79b9);
            (mixed ^ mixed >> 15).wrapping_mul(0x85eb_ca6b) >> 28 < of_16
        })
    }

    #[test]
    fn surrounded_voxels_have_six_neighbors_in_the_mask() {
        let masks: [LeafMask; 7] = std::array::from_fn(|seed| scattered(seed as u32, 14));
        let steps = [IVec3::NEG_X, IVec3::X, IVec3::NEG_Y, IVec3::Y, IVec3::NEG_Z, IVec3::Z];
        let is_in = |voxel: IVec3| {
            let leaf = voxel.div_euclid(IVec3::splat(8));
            let mask = steps.iter().position(|&step| step == leaf).map_or(0, |face| face + 1);
            let local = voxel - leaf * 8;
            masks[mask].contains((local.x * 64 + local.y * 8 + local.z) as usize)
        };
        let expected = LeafMask::from_fn(|offset| {
            let voxel = voxel_in_leaf(offset);
            is_in(voxel) && steps.iter().all(|&step| is_in(voxel + step))
        });
        assert!(expected.count() > 20);
        assert_eq!(masks[0].surrounded(std::array::from_fn(|face| &masks[face + 1])), expected);
    }

    #[test]
    fn eighths_are_cubes_that_make_the_mask() {
        let mask = scattered(5, 1);
        let mut all = LeafMask::EMPTY;
        for (index, eighth) in mask.eighths().into_iter().enumerate() {
            let half = |voxel: IVec3| voxel.x / 4 * 4 + voxel.y / 4 * 2 + voxel.z / 4;
            assert!(eighth.iter().all(|offset| half(voxel_in_leaf(offset)) == index as i32));
            all = all.or(&eighth);
        }
        assert_eq!(all, mask);
    }

    #[test]
    fn bounding_box_contains_the_mask() {
        for seed in 0..100 {
            let mut mask = LeafMask::EMPTY;
            let mut expected = CoordBox::EMPTY;
            for offset in scattered(seed, 1).iter().take(seed as usize % 5) {
                mask.insert(offset);
                expected.include(voxel_in_leaf(offset));
            }
            assert_eq!(mask.bounding_box(), expected, "{mask:?}");
        }
    }

    #[test]
    fn shifted_masks_include_adjacent_leaves() {
        // A pattern that does not repeat within two leaves.
        let is_in = |voxel: IVec3| (voxel.x * 37 + voxel.y * 101 + voxel.z * 11).rem_euclid(7) < 3;
        let mask = |origin: IVec3| LeafMask::from_fn(|offset| is_in(origin + voxel_in_leaf(offset)));
        for (axis, steps) in (0..3).flat_map(|axis| (1..8).map(move |steps| (axis, steps))) {
            let leaf = IVec3::AXES[axis] * 8;
            let shift = IVec3::AXES[axis] * steps;
            let shifted = mask(IVec3::ZERO).shifted(axis, steps as usize, &mask(-leaf), &mask(leaf));
            assert_eq!(shifted, [mask(-shift), mask(shift)], "axis {axis}, {steps} steps");
        }
        assert!(mask(IVec3::ZERO).contains(offset_in_leaf(IVec3::ZERO)));
    }

    #[test]
    fn negative_values_set_their_bits() {
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
