//! Constants and helpers of the file format, shared by writer and reader.

/// The first eight bytes of a file.
pub(super) const MAGIC: [u8; 8] = *b"\x20BDV\0\0\0\0";
/// The file version that the writer uses: all versions of OpenVDB since 4 read it without warnings.
pub(super) const VERSION_WRITTEN: u32 = 224;
/// The file versions that the reader supports.
pub(super) const VERSIONS_READ: std::ops::RangeInclusive<u32> = 222..=225;
/// The version of the OpenVDB library, major and minor, that the writer records in the header: it writes the
/// layout of OpenVDB 10.0.
pub(super) const LIBRARY_VERSION: [u32; 2] = [10, 0];
pub(super) const UUID_BYTES: usize = 36;

pub(super) const TYPE_FLOAT: &str = "Tree_float_5_4_3";
pub(super) const TYPE_VEC3S: &str = "Tree_vec3s_5_4_3";
/// The name of a grid of velocities, by which programs find it.
pub(super) const VELOCITY: &str = "velocity";
pub(super) const HALF_SUFFIX: &str = "_HalfFloat";
pub(super) const META_HALF: &str = "is_saved_as_half_float";

/// Bits of the compression word of a grid.
pub(super) const COMPRESS_ZIP: u32 = 1;
pub(super) const COMPRESS_ACTIVE_MASK: u32 = 2;
pub(super) const COMPRESS_BLOSC: u32 = 4;

/// The first byte of a block of values: it encodes the values of inactive slots.
pub(super) mod inactive {
    /// All are + background, or there are no inactive slots.
    pub(in crate::vdb) const PLUS_BACKGROUND: u8 = 0;
    /// All are − background.
    pub(in crate::vdb) const MINUS_BACKGROUND: u8 = 1;
    /// All have the value that follows.
    pub(in crate::vdb) const ONE_VALUE: u8 = 2;
    /// A mask follows: on for + background, off for − background.
    pub(in crate::vdb) const MASK_OF_BACKGROUNDS: u8 = 3;
    /// A value and a mask follow: on for + background, off for the value.
    pub(in crate::vdb) const MASK_AND_ONE_VALUE: u8 = 4;
    /// Two values and a mask follow: on for the second, off for the first.
    pub(in crate::vdb) const MASK_AND_TWO_VALUES: u8 = 5;
    /// The value of every slot is stored.
    pub(in crate::vdb) const ALL_VALUES: u8 = 6;
}

/// Log2 of the number of slots along an edge: of a leaf (LEAF), a lower internal node (NODE4) and an upper
/// internal node (NODE5).
pub(super) const LEAF_LOG2: u32 = 3;
pub(super) const NODE4_LOG2: u32 = 4;
pub(super) const NODE5_LOG2: u32 = 5;

/// Log2 of the number of voxels along an edge: of a lower and of an upper internal node.
pub(super) const NODE4_VOXELS_LOG2: u32 = LEAF_LOG2 + NODE4_LOG2;
pub(super) const NODE5_VOXELS_LOG2: u32 = NODE4_VOXELS_LOG2 + NODE5_LOG2;

/// The index of a child's slot in its parent, with z varying fastest. `coord` is the child's position in the
/// world, in units of its edge length; the parent has 2^`log2` slots along an edge.
pub(super) fn slot_of(coord: [i32; 3], log2: u32) -> usize {
    let mask = (1 << log2) - 1;
    let [x, y, z] = coord.map(|c| (c & mask) as usize);
    x << (2 * log2) | y << log2 | z
}

/// The position of the child in a slot, from the minimum corner of the parent, in units of the child's edge
/// length.
pub(super) fn slot_coord(slot: usize, log2: u32) -> [i32; 3] {
    let mask = (1 << log2) - 1;
    #[expect(clippy::cast_possible_truncation, reason = "masked to five bits at most")]
    let coord = [slot >> (2 * log2), slot >> log2, slot].map(|c| (c & mask) as i32);
    coord
}

/// The slots that are on in a mask, in order.
pub(super) fn ones(mask: &[u64]) -> impl Iterator<Item = usize> + '_ {
    mask.iter().enumerate().flat_map(|(index, &word)| {
        std::iter::successors((word != 0).then_some(word), |&rest| {
            let rest = rest & (rest - 1);
            (rest != 0).then_some(rest)
        })
        .map(move |rest| index * 64 + rest.trailing_zeros() as usize)
    })
}

/// The number of slots that are on.
pub(super) fn count_ones(mask: &[u64]) -> usize {
    mask.iter().map(|word| word.count_ones() as usize).sum()
}

/// Whether a slot is on.
pub(super) fn is_on(mask: &[u64], slot: usize) -> bool {
    mask[slot >> 6] >> (slot & 63) & 1 == 1
}
