//! Reads the tree of a grid of floats or of three-component vectors.
//!
//! The topology comes first: the root's background, tiles and children, depth first down to the masks of the
//! leaves. Then come the values of the leaves in the same order. A block of values may omit inactive slots:
//! their values are + or − background, or one or two values that the block states.

use half::f16;

use super::{
    COMPRESS_ACTIVE_MASK, COMPRESS_BLOSC, COMPRESS_ZIP, FORMAT, LEAF_LOG2, MetaValue, NODE4_LOG2,
    NODE4_VOXELS_LOG2, NODE5_LOG2, NODE5_VOXELS_LOG2, Transform, count_ones, inactive, is_on, ones,
    slot_coord,
};
use crate::core::blosc::{decode_frame, inflate_into};
use crate::core::bytes::Cursor;
use crate::core::error::{Error, Position, Result};
use crate::core::limits::Limits;

/// A grid of floats read from a file; a level set if its class says so.
pub type LevelSetData = GridData<f32>;

/// A grid of vectors read from a file.
pub type VectorGridData = GridData<[f32; 3]>;

/// A grid read from a file.
#[derive(Clone, Debug, PartialEq)]
pub struct GridData<V> {
    /// The name shown to users.
    pub name: String,
    /// `level set`, `fog volume`, …; empty if the file has no class.
    pub class: String,
    /// Maps voxel coordinates to world positions.
    pub transform: Transform,
    /// The value outside the stored voxels; in a level set, half the thickness of the band.
    pub background: V,
    /// Origins of the leaves, in voxels.
    pub origins: Vec<[i32; 3]>,
    /// Values of each leaf, z fastest: in a level set signed distances in world units.
    pub leaves: Vec<[V; 512]>,
    /// Active voxels of each leaf: bit `y·8 + z` of word x.
    pub masks: Vec<[u64; 8]>,
    /// Cubes with a constant value. Inactive cubes whose value is the background are omitted.
    pub tiles: Vec<ConstantTile<V>>,
    /// The metadata of the grid.
    pub metadata: Vec<(String, MetaValue)>,
}

impl GridData<f32> {
    /// Memory needed to read and use this grid, in bytes. [`Limits::memory_bytes`] limits the sum of this
    /// and the size of the file.
    pub fn memory_bytes(&self) -> u64 {
        TreeSize { leaf_count: self.origins.len(), tile_count: self.tiles.len() }.memory_bytes()
    }
}

/// The size of a tree.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct TreeSize {
    pub(super) leaf_count: usize,
    tile_count: usize,
}

impl TreeSize {
    /// What it is, for messages.
    pub(super) fn described(self) -> String {
        format!("the level set, with {} leaves and {} tiles,", self.leaf_count, self.tile_count)
    }

    /// Memory needed to read and use a tree of floats of this size, in bytes.
    pub(super) fn memory_bytes(self) -> u64 {
        self.leaf_count as u64 * LEAF_BYTES + self.tile_count as u64 * TILE_BYTES
    }
}

/// Memory for a leaf of floats: its values twice (as read, and in the level set that is built from them), its
/// location, and the mask of inside voxels.
const LEAF_BYTES: u64 = 2 * 2048 + 400;

/// Memory for a tile: an entry in two lists, which may have twice the needed capacity, and in one or two hash
/// tables.
const TILE_BYTES: u64 = 160;

/// A cube of voxels with a constant value.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ConstantTile<V> {
    /// Its minimum voxel.
    pub origin: [i32; 3],
    /// Number of voxels along an edge: 8, 128 or 4096.
    pub size: i32,
    /// The value of all its voxels.
    pub value: V,
    /// Whether its voxels are active.
    pub active: bool,
}

/// The value of a voxel, with `COUNT` floats.
pub(super) trait VoxelValue: Copy + PartialEq {
    const COUNT: usize;
    const ZERO: Self;
    /// The floats of all values, flattened.
    fn flat(values: &mut [Self]) -> &mut [f32];

    fn read(cursor: &mut Cursor, what: &str) -> Result<Self> {
        let mut value = [Self::ZERO];
        for number in Self::flat(&mut value) {
            *number = cursor.f32(what)?;
        }
        Ok(value[0])
    }

    fn negative(self) -> Self {
        let mut value = [self];
        Self::flat(&mut value).iter_mut().for_each(|number| *number = -*number);
        value[0]
    }
}

impl VoxelValue for f32 {
    const COUNT: usize = 1;
    const ZERO: f32 = 0.0;

    fn flat(values: &mut [f32]) -> &mut [f32] {
        values
    }
}

impl VoxelValue for [f32; 3] {
    const COUNT: usize = 3;
    const ZERO: [f32; 3] = [0.0; 3];

    fn flat(values: &mut [[f32; 3]]) -> &mut [f32] {
        values.as_flattened_mut()
    }
}

/// The storage of a grid's values.
#[derive(Clone, Copy)]
pub(super) struct ValueStorage {
    pub(super) compression: u32,
    pub(super) half: bool,
}

/// The memory that reading a file has allocated.
pub(super) struct TreeBudget {
    spent_bytes: u64,
    file_bytes: u64,
    limits: Limits,
}

impl TreeBudget {
    pub(super) fn new(file_bytes: usize, limits: &Limits) -> TreeBudget {
        TreeBudget { spent_bytes: 0, file_bytes: file_bytes as u64, limits: *limits }
    }

    /// For counting: what is counted is not stored, so that only its ratio to the file is limited.
    pub(super) fn counting(file_bytes: usize, limits: &Limits) -> TreeBudget {
        TreeBudget::new(file_bytes, &Limits { memory_bytes: u64::MAX, ..*limits })
    }

    fn spend(&mut self, bytes: usize) -> Result<()> {
        self.spent_bytes = self.spent_bytes.saturating_add(bytes as u64);
        self.limits.check_decompressed(FORMAT, self.spent_bytes, self.file_bytes)
    }
}

/// Reads a tree; the caller sets name, class, transform and metadata.
pub(super) fn read_tree<V: VoxelValue>(
    cursor: &mut Cursor,
    storage: ValueStorage,
    budget: &mut TreeBudget,
) -> Result<GridData<V>> {
    let mut reader = TreeReader::of_topology(cursor, storage, budget, Keep::All)?;
    reader.read_leaves(cursor)?;
    Ok(reader.data)
}

/// Skips a tree.
pub(super) fn pass_tree<V: VoxelValue>(
    cursor: &mut Cursor,
    storage: ValueStorage,
    budget: &mut TreeBudget,
) -> Result<()> {
    TreeReader::<V>::of_topology(cursor, storage, budget, Keep::Counts)?.read_leaves(cursor)
}

/// Counts the leaves and tiles of a tree without storing them.
pub(super) fn count_tree<V: VoxelValue>(
    cursor: &mut Cursor,
    storage: ValueStorage,
    budget: &mut TreeBudget,
) -> Result<TreeSize> {
    Ok(TreeReader::<V>::of_topology(cursor, storage, budget, Keep::Counts)?.size)
}

/// The background of a tree, the origins of its leaves, and its size. Stores no values.
pub(super) fn outline_of_tree<V: VoxelValue>(
    cursor: &mut Cursor,
    storage: ValueStorage,
    budget: &mut TreeBudget,
) -> Result<(V, Vec<[i32; 3]>, TreeSize)> {
    let reader = TreeReader::of_topology(cursor, storage, budget, Keep::Origins)?;
    Ok((reader.background, reader.data.origins, reader.size))
}

fn empty<V>(background: V) -> GridData<V> {
    GridData {
        name: String::new(),
        class: String::new(),
        transform: Transform { axes: [[0.0; 3]; 3], translation: [0.0; 3] },
        background,
        origins: Vec::new(),
        leaves: Vec::new(),
        masks: Vec::new(),
        tiles: Vec::new(),
        metadata: Vec::new(),
    }
}

/// What a reader stores of the leaves and tiles.
#[derive(Clone, Copy, PartialEq)]
enum Keep {
    All,
    /// The origins of the leaves.
    Origins,
    /// Nothing: it only counts.
    Counts,
}

struct TreeReader<'a, V> {
    background: V,
    storage: ValueStorage,
    budget: &'a mut TreeBudget,
    keep: Keep,
    size: TreeSize,
    data: GridData<V>,
    scratch: Vec<u8>,
}

impl<'a, V: VoxelValue> TreeReader<'a, V> {
    /// Reads the topology. The cursor is then at the values of the leaves.
    fn of_topology(
        cursor: &mut Cursor,
        storage: ValueStorage,
        budget: &'a mut TreeBudget,
        keep: Keep,
    ) -> Result<TreeReader<'a, V>> {
        let buffers_per_leaf = cursor.i32("the number of buffers per leaf")?;
        if buffers_per_leaf != 1 {
            return Err(Error::unsupported(
                FORMAT,
                format!("the grid has {buffers_per_leaf} buffers per leaf; only one is supported"),
            ));
        }
        let background = V::read(cursor, "the background")?;
        let (size, data) = (TreeSize::default(), empty(background));
        let mut reader = TreeReader { background, storage, budget, keep, size, data, scratch: Vec::new() };
        reader.read_root(cursor)?;
        Ok(reader)
    }

    /// Reads the tiles and the children of the root, down to the masks of the leaves.
    fn read_root(&mut self, cursor: &mut Cursor) -> Result<()> {
        const CHILD_EDGE: i32 = 1 << NODE5_VOXELS_LOG2;
        const MASK_BYTES: usize = (1 << (3 * NODE5_LOG2)) / 8;
        const CHILD_BYTES_MIN: usize = 12 + 2 * MASK_BYTES + 1; // origin, masks, kind of values
        let tile_bytes = 12 + 4 * V::COUNT + 1; // origin, value, whether it is active
        let tile_count = cursor.u32("the number of root tiles")? as usize;
        let child_count = cursor.u32("the number of root children")? as usize;
        let all_tiles_bytes = tile_count.checked_mul(tile_bytes);
        let children_bytes = child_count.checked_mul(CHILD_BYTES_MIN);
        let needed_bytes =
            all_tiles_bytes.zip(children_bytes).and_then(|(tiles, rest)| tiles.checked_add(rest));
        if needed_bytes.is_none_or(|needed| needed > cursor.remaining()) {
            let what = format!(
                "the grid declares {tile_count} root tiles and {child_count} children, more than fit into the file"
            );
            return Err(cursor.invalid(what));
        }
        for _ in 0..tile_count {
            let origin = cursor.coord("a root tile")?;
            let value = V::read(cursor, "a root tile")?;
            let active = cursor.u8("a root tile")? != 0;
            self.push_tile(ConstantTile { origin, size: CHILD_EDGE, value, active })?;
        }
        let mut last = None;
        for _ in 0..child_count {
            let origin = cursor.coord("a root child")?;
            if origin.iter().any(|along| along % CHILD_EDGE != 0) {
                return Err(cursor.invalid(format!(
                    "the origin of a root child is {origin:?}; expected multiples of {CHILD_EDGE}"
                )));
            }
            if let Some(last) = last
                && origin <= last
            {
                return Err(cursor.invalid(format!(
                    "the root child at {origin:?} follows that at {last:?}; expected ascending origins"
                )));
            }
            last = Some(origin);
            self.read_node(cursor, origin, NODE5_LOG2, NODE4_VOXELS_LOG2)?;
        }
        Ok(())
    }

    /// Reads an internal node and its descendants, down to the masks of the leaves. It has 2^`slots_log2`
    /// slots of 2^`child_voxels_log2` voxels along an edge.
    fn read_node(
        &mut self,
        cursor: &mut Cursor,
        origin: [i32; 3],
        slots_log2: u32,
        child_voxels_log2: u32,
    ) -> Result<()> {
        let slot_count = 1 << (3 * slots_log2);
        let children = cursor.mask(slot_count / 64, "the children of a node")?;
        let active = cursor.mask(slot_count / 64, "the active tiles of a node")?;
        let mut values = vec![V::ZERO; slot_count];
        self.read_values(cursor, &active, &mut values)?;
        for (slot, &value) in values.iter().enumerate() {
            if !is_on(&children, slot) {
                let origin = child_origin(origin, slot, slots_log2, child_voxels_log2);
                self.push_tile(ConstantTile {
                    origin,
                    size: 1 << child_voxels_log2,
                    value,
                    active: is_on(&active, slot),
                })?;
            }
        }
        drop(values);
        for slot in ones(&children) {
            let origin = child_origin(origin, slot, slots_log2, child_voxels_log2);
            if child_voxels_log2 == LEAF_LOG2 {
                cursor.take(64, "the mask of a leaf")?; // repeated with the leaf's values
                self.budget.spend(size_of::<[i32; 3]>() + size_of::<[V; 512]>() + size_of::<[u64; 8]>())?;
                self.size.leaf_count += 1;
                if self.keep != Keep::Counts {
                    self.data.origins.push(origin);
                }
            } else {
                self.read_node(cursor, origin, NODE4_LOG2, LEAF_LOG2)?;
            }
        }
        Ok(())
    }

    /// Reads the values of the leaves.
    fn read_leaves(&mut self, cursor: &mut Cursor) -> Result<()> {
        for _ in 0..self.size.leaf_count {
            let words = cursor.mask(8, "the mask of a leaf")?;
            let mut leaf = [V::ZERO; 512];
            self.read_values(cursor, &words, &mut leaf)?;
            if self.keep == Keep::All {
                self.data.masks.push(std::array::from_fn(|word| words[word]));
                self.data.leaves.push(leaf);
            }
        }
        Ok(())
    }

    fn push_tile(&mut self, tile: ConstantTile<V>) -> Result<()> {
        if tile.active || tile.value != self.background {
            self.budget.spend(size_of::<ConstantTile<V>>())?;
            self.size.tile_count += 1;
            if self.keep == Keep::All {
                self.data.tiles.push(tile);
            }
        }
        Ok(())
    }

    /// Reads a block of values and restores the inactive ones that it omits.
    fn read_values(&mut self, cursor: &mut Cursor, active: &[u64], out: &mut [V]) -> Result<()> {
        let case = cursor.u8("the kind of a block of values")?;
        let (mut unselected, mut selected) = (self.background, self.background);
        match case {
            inactive::PLUS_BACKGROUND | inactive::ALL_VALUES => {}
            inactive::MINUS_BACKGROUND | inactive::MASK_OF_BACKGROUNDS => {
                unselected = self.background.negative()
            }
            inactive::ONE_VALUE | inactive::MASK_AND_ONE_VALUE => {
                unselected = V::read(cursor, "an inactive value")?
            }
            inactive::MASK_AND_TWO_VALUES => {
                unselected = V::read(cursor, "an inactive value")?;
                selected = V::read(cursor, "an inactive value")?;
            }
            _ => {
                return Err(
                    cursor.invalid(format!("a block of values has the unknown kind {case}; expected 0 to 6"))
                );
            }
        }
        let has_mask = matches!(
            case,
            inactive::MASK_OF_BACKGROUNDS | inactive::MASK_AND_ONE_VALUE | inactive::MASK_AND_TWO_VALUES
        );
        let selection = if has_mask { cursor.mask(out.len() / 64, "a selection mask")? } else { Vec::new() };
        if case == inactive::ALL_VALUES || self.storage.compression & COMPRESS_ACTIVE_MASK == 0 {
            return self.read_chunk(cursor, V::flat(out));
        }
        let count = count_ones(active);
        let mut packed = [V::ZERO; 512];
        let mut larger = Vec::new(); // for internal nodes with many active tiles
        let packed = if count <= packed.len() {
            &mut packed[..count]
        } else {
            larger.resize(count, V::ZERO);
            &mut larger[..]
        };
        self.read_chunk(cursor, V::flat(packed))?;
        let mut next = packed.iter();
        for (slot, value) in out.iter_mut().enumerate() {
            let stored = if is_on(active, slot) { next.next() } else { None };
            *value = match stored {
                Some(&stored) => stored,
                None if has_mask && is_on(&selection, slot) => selected,
                None => unselected,
            };
        }
        Ok(())
    }

    /// Fills `out` with floats.
    fn read_chunk(&mut self, cursor: &mut Cursor, out: &mut [f32]) -> Result<()> {
        let ValueStorage { compression, half } = self.storage;
        if half && out.is_empty() {
            return Ok(()); // such a chunk is not stored at all, not even its size
        }
        let byte_count = out.len() * if half { 2 } else { 4 };
        self.scratch.resize(byte_count, 0);
        if compression & (COMPRESS_ZIP | COMPRESS_BLOSC) == 0 {
            self.scratch.copy_from_slice(cursor.take(byte_count, "values")?);
        } else {
            self.decompress(cursor)?;
        }
        if half {
            for (value, &bytes) in out.iter_mut().zip(self.scratch.as_chunks::<2>().0) {
                *value = f16::from_le_bytes(bytes).to_f32();
            }
        } else {
            for (value, &bytes) in out.iter_mut().zip(self.scratch.as_chunks::<4>().0) {
                *value = f32::from_le_bytes(bytes);
            }
        }
        Ok(())
    }

    /// Fills the scratch buffer from a chunk with a size: positive if compressed, negative if raw.
    fn decompress(&mut self, cursor: &mut Cursor) -> Result<()> {
        let out = &mut self.scratch[..];
        let size = cursor.i64("the size of compressed values")?;
        let start = cursor.at() as u64;
        let invalid = |what: String| Error::invalid(FORMAT, Position::Offset(start), what);
        let length = usize::try_from(size.unsigned_abs()).unwrap_or(usize::MAX);
        let bytes = cursor.take(length, "compressed values")?;
        if out.is_empty() {
            return Ok(()); // some writers write an empty frame here
        }
        if size <= 0 {
            if bytes.len() != out.len() {
                return Err(invalid(format!(
                    "expected {} bytes of raw values, found {}",
                    out.len(),
                    bytes.len()
                )));
            }
            out.copy_from_slice(bytes);
        } else if self.storage.compression & COMPRESS_BLOSC != 0 {
            decode_frame(bytes, out).map_err(|error| error.of_format(FORMAT, start))?;
        } else if inflate_into(bytes, out) != Some(out.len()) {
            return Err(invalid(format!("the zlib data does not decompress to {} bytes", out.len())));
        }
        Ok(())
    }
}

/// The minimum voxel of the child in a slot. The addition never wraps, because `origin` is a multiple of the
/// node's size.
fn child_origin(origin: [i32; 3], slot: usize, slots_log2: u32, child_voxels_log2: u32) -> [i32; 3] {
    let local = slot_coord(slot, slots_log2);
    std::array::from_fn(|axis| origin[axis].wrapping_add(local[axis] << child_voxels_log2))
}
