//! The nodes above the leaves, in file order.
//!
//! ```text
//!   root ─▶ nodes of 32³ ─▶ nodes of 16³ ─▶ leaves        children of each in the order of their slots
//!     └ tiles └ tiles         └ tiles                     entirely inside or outside regions
//! ```

use std::iter::repeat_n;

use half::f16;
use half::slice::HalfFloatSliceExt;
use rayon::prelude::*;

use super::flood::{FloodCell, Parent, inside_gaps, parents};
use super::write::{Digest, digest};
use super::{
    Compression, NODE4_LOG2, NODE5_LOG2, NODE5_VOXELS_LOG2, count_ones, inactive, is_on, ones, slot_coord,
    slot_of,
};
use crate::core::blosc::Encoder;

/// A leaf, in tree order.
pub(super) struct TreeLeaf {
    pub(super) origin: [i32; 3],
    pub(super) summary: LeafSummary,
}

/// An internal node of the tree.
struct InternalNode {
    /// Position, in nodes of its level, and its inside slots.
    parent: Parent,
    /// One bit per slot: whether it has a child.
    children: Vec<u64>,
}

impl InternalNode {
    fn new(parent: Parent) -> InternalNode {
        InternalNode { children: vec![0; parent.inside.len()], parent }
    }

    /// Whether the node is an inside tile of its parent; `None` if it is not a tile. It is a tile if it has
    /// no children and is entirely inside or outside.
    fn tile(&self) -> Option<bool> {
        let inside = &self.parent.inside;
        let uniform = inside.iter().all(|&word| word == 0) || inside.iter().all(|&word| word == u64::MAX);
        (uniform && count_ones(&self.children) == 0).then(|| inside[0] != 0)
    }
}

/// All nodes above the leaves.
pub(super) struct GridTree {
    /// Lower nodes that are children, sorted by x, y, z.
    nodes4: Vec<InternalNode>,
    /// Upper nodes that are children, sorted by x, y, z.
    nodes5: Vec<InternalNode>,
    /// Origins, in voxels, of the root's inside tiles, sorted by x, y, z.
    tiles: Vec<[i32; 3]>,
}

impl GridTree {
    /// The tree of a level set: regions without leaves are inside or outside.
    pub(super) fn new(leaves: &[TreeLeaf]) -> GridTree {
        let cell_of = |TreeLeaf { origin, summary }: &TreeLeaf| {
            let &LeafSummary { low_inside, high_inside, inside, .. } = summary;
            let cell = FloodCell { coord: origin.map(|c| c >> 3), low_inside, high_inside };
            (cell, summary.is_stored(), inside)
        };
        GridTree::of(leaves.iter().map(cell_of).collect())
    }

    /// The tree of a grid with the same leaves but without inside regions.
    pub(super) fn without_sides(leaves: &[TreeLeaf]) -> GridTree {
        let cell_of = |TreeLeaf { origin, summary }: &TreeLeaf| {
            let cell = FloodCell { coord: origin.map(|c| c >> 3), low_inside: false, high_inside: false };
            (cell, summary.is_stored(), false)
        };
        GridTree::of(leaves.iter().map(cell_of).collect())
    }

    /// Builds a tree from leaves as cells. Each cell comes with two flags: whether the leaf is stored, and
    /// whether the leaf is inside. The second flag is used only if the leaf is not stored.
    fn of(mut cells: Vec<(FloodCell, bool, bool)>) -> GridTree {
        cells.par_sort_unstable_by_key(|(cell, ..)| cell.coord);
        let (cells4, mut nodes4) = level(cells, NODE4_LOG2);
        let (cells5, nodes5) = level(cells4, NODE5_LOG2);
        nodes4.retain(|node| node.tile().is_none());

        let bare: Vec<FloodCell> = cells5.iter().map(|&(cell, ..)| cell).collect();
        let gaps = inside_gaps(&bare)
            .flat_map(|gap| (gap.low_cell + 1..gap.high_cell).map(move |z| [gap.xy[0], gap.xy[1], z]));
        let tiles = nodes5.iter().filter(|node| node.tile() == Some(true)).map(|node| node.parent.coord);
        let mut tiles: Vec<[i32; 3]> =
            gaps.chain(tiles).map(|coord| coord.map(|c| c << NODE5_VOXELS_LOG2)).collect();
        tiles.sort_unstable();
        let nodes5 = nodes5.into_iter().filter(|node| node.tile().is_none()).collect();
        GridTree { nodes4, nodes5, tiles }
    }

    /// The tree's memory according to OpenVDB's own accounting, in bytes.
    pub(super) fn memory_bytes(&self, leaf_count: usize, arity: usize) -> usize {
        270_360 * self.nodes5.len() + 33_816 * self.nodes4.len() + (2_048 * arity + 116) * leaf_count
    }

    /// Appends the topology: background, tiles and children of the root, then the nodes depth first.
    pub(super) fn append_topology(&self, leaves: &[TreeLeaf], encoding: LeafEncoding, out: &mut Vec<u8>) {
        let mut leaves = leaves.iter().filter(|leaf| leaf.summary.is_stored());
        out.extend_from_slice(&1u32.to_le_bytes()); // buffers per leaf
        for _ in 0..encoding.arity {
            out.extend_from_slice(&encoding.background.to_le_bytes());
        }
        out.extend_from_slice(&count_u32(self.tiles.len()).to_le_bytes());
        out.extend_from_slice(&count_u32(self.nodes5.len()).to_le_bytes());
        for tile in &self.tiles {
            push_coord(*tile, out);
            out.extend_from_slice(&(-encoding.background).to_le_bytes());
            out.push(0); // inactive
        }
        for node5 in &self.nodes5 {
            let coord5 = node5.parent.coord;
            push_coord(coord5.map(|c| c << NODE5_VOXELS_LOG2), out);
            append_node(node5, encoding, out);
            for slot in ones(&node5.children) {
                let local = slot_coord(slot, NODE5_LOG2);
                let coord4: [i32; 3] = std::array::from_fn(|axis| coord5[axis] << NODE5_LOG2 | local[axis]);
                let index = self.nodes4.partition_point(|node| node.parent.coord < coord4);
                let node4 = &self.nodes4[index];
                append_node(node4, encoding, out);
                for leaf in leaves.by_ref().take(count_ones(&node4.children)) {
                    for word in leaf.summary.active {
                        out.extend_from_slice(&word.to_le_bytes());
                    }
                }
            }
        }
    }
}

/// Returns the parents of `cells`: first as cells of the next level, then as nodes.
///
/// Each cell comes with two flags: whether it is a child, and whether it is an inside tile. The second flag
/// is used only if the cell is not a child. The cells must be sorted by x, y, z; both results are, too.
fn level(
    cells: Vec<(FloodCell, bool, bool)>,
    log2: u32,
) -> (Vec<(FloodCell, bool, bool)>, Vec<InternalNode>) {
    let bare: Vec<FloodCell> = cells.iter().map(|&(cell, ..)| cell).collect();
    let mut nodes: Vec<InternalNode> = parents(&bare, log2).into_iter().map(InternalNode::new).collect();
    for (cell, is_child, inside) in cells {
        let coord = cell.coord.map(|c| c >> log2);
        let index = nodes.partition_point(|node| node.parent.coord < coord);
        let slot = slot_of(cell.coord, log2);
        if is_child {
            nodes[index].children[slot >> 6] |= 1 << (slot & 63);
        } else if inside {
            nodes[index].parent.insert(slot);
        }
    }
    let cells = nodes
        .iter()
        .map(|node| {
            let tile = node.tile();
            (node.parent.as_cell(log2), tile.is_none(), tile == Some(true))
        })
        .collect();
    (cells, nodes)
}

fn append_node(node: &InternalNode, encoding: LeafEncoding, out: &mut Vec<u8>) {
    let InternalNode { parent, children } = node;
    for word in children {
        out.extend_from_slice(&word.to_le_bytes());
    }
    out.resize(out.len() + children.len() * 8, 0); // no tile is active
    if encoding.compression == Compression::None {
        out.push(inactive::ALL_VALUES);
        let value_at = |slot| match (is_on(children, slot), is_on(&parent.inside, slot)) {
            (true, _) => 0.0,
            (false, true) => -encoding.background,
            (false, false) => encoding.background,
        };
        let slots = 0..children.len() * 64;
        let values: Vec<f32> = slots.flat_map(|slot| repeat_n(value_at(slot), encoding.arity)).collect();
        push_values(&values, encoding.half, out);
        return;
    }
    append_inactive(children, &parent.inside, out);
    // No value is active. An empty chunk of 32-bit values still has a size field; one of 16-bit values does
    // not.
    if encoding.compression == Compression::Blosc && !encoding.half {
        out.extend_from_slice(&0i64.to_le_bytes());
    }
}

fn push_coord(coord: [i32; 3], out: &mut Vec<u8>) {
    out.extend_from_slice(coord.map(i32::to_le_bytes).as_flattened());
}

/// Converts a count that is below 2³² because the number of leaves is.
pub(super) fn count_u32(count: usize) -> u32 {
    u32::try_from(count).unwrap_or(u32::MAX)
}

// Encodes leaves of distances as bytes of a file, in parallel.
//
// Each leaf is scaled to world units, split into active and inactive voxels, and compressed separately. A
// batch of leaves is one task and one allocation. Batches are joined in order, so the bytes do not depend on
// the number of threads.

/// Leaves encoded per task: large enough to hide the task's overhead, small enough to share the work.
pub(super) const LEAVES_PER_BATCH: usize = 128;

/// The bits with z = 0, or with z = 7, of every row of a mask word.
const LOW_FACE: u64 = 0x0101_0101_0101_0101;
const HIGH_FACE: u64 = LOW_FACE << 7;

/// The encoding of values.
#[derive(Clone, Copy)]
pub(super) struct LeafEncoding {
    /// World units per unit of the values.
    pub(super) scale: f64,
    /// The background in world units, rounded to 16 bits if `half`. With several components it is 0.
    pub(super) background: f32,
    /// Number of components per value.
    pub(super) arity: usize,
    pub(super) half: bool,
    pub(super) compression: Compression,
}

/// The information about a leaf that the tree needs.
#[derive(Clone, Copy)]
pub(super) struct LeafSummary {
    /// The active voxels. A leaf without active voxels is not written.
    pub(super) active: [u64; 8],
    /// Whether most voxels are negative: of all its voxels, of those at z = 0, and of those at z = 7.
    pub(super) inside: bool,
    pub(super) low_inside: bool,
    pub(super) high_inside: bool,
    /// Whether a value is NaN.
    pub(super) has_nan: bool,
}

impl LeafSummary {
    pub(super) fn is_stored(&self) -> bool {
        self.active != [0; 8]
    }
}

/// Leaves that were encoded together.
pub(super) struct EncodedBatch {
    pub(super) summaries: Vec<LeafSummary>,
    pub(super) packed: Packed,
}

/// The concatenated buffers of leaves with active voxels.
pub(super) struct Packed {
    pub(super) bytes: Box<[u8]>,
    pub(super) digest: Digest,
}

impl Packed {
    /// Copies the bytes without excess capacity, because a batch stays in memory until all batches are
    /// encoded.
    pub(super) fn new(bytes: &[u8]) -> Packed {
        Packed { bytes: bytes.into(), digest: digest(bytes) }
    }
}

/// Encodes the leaves in the order of the indices.
pub(super) fn encode_leaves(
    leaves: &[[f32; 512]],
    order: &[u32],
    encoding: LeafEncoding,
) -> Vec<EncodedBatch> {
    order
        .par_chunks(LEAVES_PER_BATCH)
        .map_init(
            || (LeafEncoder::new(encoding), Vec::new()),
            |(encoder, bytes), indices| {
                bytes.clear();
                let summaries =
                    indices.iter().map(|&index| encoder.append(&leaves[index as usize], bytes)).collect();
                EncodedBatch { summaries, packed: Packed::new(bytes) }
            },
        )
        .collect()
}

/// Encodes leaves one at a time, reusing its buffers.
struct LeafEncoder {
    encoding: LeafEncoding,
    world: [f32; 512],
    chunk: Vec<u8>,
    blosc: Encoder,
}

impl LeafEncoder {
    fn new(encoding: LeafEncoding) -> LeafEncoder {
        LeafEncoder { encoding, world: [0.0; 512], chunk: Vec::with_capacity(2048), blosc: Encoder::new() }
    }

    fn append(&mut self, leaf: &[f32; 512], out: &mut Vec<u8>) -> LeafSummary {
        self.scale(leaf);
        let (active, negative) = self.classify();
        let summary = LeafSummary {
            active,
            inside: negative.iter().map(|word| word.count_ones()).sum::<u32>() > 256,
            low_inside: negative.iter().map(|word| (word & LOW_FACE).count_ones()).sum::<u32>() > 32,
            high_inside: negative.iter().map(|word| (word & HIGH_FACE).count_ones()).sum::<u32>() > 32,
            has_nan: self.world.iter().fold(false, |any, value| any | value.is_nan()),
        };
        if summary.is_stored() {
            for word in active {
                out.extend_from_slice(&word.to_le_bytes());
            }
            self.append_values(&active, &negative, out);
        }
        summary
    }

    /// Converts distances to world units, rounded to the stored precision.
    fn scale(&mut self, leaf: &[f32; 512]) {
        for (world, &value) in self.world.iter_mut().zip(leaf) {
            *world = to_world(value, self.encoding.scale);
        }
        if self.encoding.half {
            let mut halves = [f16::ZERO; 512];
            halves.convert_from_f32_slice(&self.world);
            halves.convert_to_f32_slice(&mut self.world);
        }
    }

    /// The masks of the voxels with |φ| < background, and of those with φ < 0.
    fn classify(&self) -> ([u64; 8], [u64; 8]) {
        let background = self.encoding.background;
        let active = leaf_mask(&self.world, |value| value.abs() < background);
        (active, leaf_mask(&self.world, |value| value < 0.0))
    }

    fn append_values(&mut self, active: &[u64; 8], negative: &[u64; 8], out: &mut Vec<u8>) {
        let LeafEncoding { background, half, compression, .. } = self.encoding;
        if compression == Compression::None {
            out.push(inactive::ALL_VALUES);
            for value in &mut self.world {
                *value = value.clamp(-background, background);
            }
            push_values(&self.world, half, out);
            return;
        }
        append_inactive(active, negative, out);
        self.chunk.clear();
        self.gather_active(active);
        append_chunk(&self.chunk, self.encoding, &mut self.blosc, out);
    }

    /// Compacts the values of the active voxels and converts them to bytes.
    fn gather_active(&mut self, active: &[u64; 8]) {
        let mut packed = [0.0; 512 + 8];
        let mut count = 0;
        let bits = active.iter().flat_map(|word| word.to_le_bytes());
        for (row, bits) in self.world.as_chunks::<8>().0.iter().zip(bits) {
            // Most rows are entirely active or entirely inactive.
            match bits {
                0 => {}
                u8::MAX => {
                    packed[count..count + 8].copy_from_slice(row);
                    count += 8;
                }
                _ => {
                    for (bit, &value) in row.iter().enumerate() {
                        packed[count] = value; // always written, kept only if active: no branch to mispredict
                        count += usize::from(bits >> bit & 1);
                    }
                }
            }
        }
        push_values(&packed[..count], self.encoding.half, &mut self.chunk);
    }
}

/// Appends a chunk of bytes, compressed as the encoding says; not for [`Compression::None`].
pub(super) fn append_chunk(chunk: &[u8], encoding: LeafEncoding, blosc: &mut Encoder, out: &mut Vec<u8>) {
    if encoding.compression == Compression::ActiveMask {
        out.extend_from_slice(chunk);
        return;
    }
    let prefix = out.len();
    out.extend_from_slice(&[0; 8]);
    let typesize = if encoding.half { 2 } else { 4 };
    let size = if blosc.append_frame(chunk, typesize, out) {
        (out.len() - prefix - 8) as i64
    } else {
        out.extend_from_slice(chunk);
        -(chunk.len() as i64)
    };
    out[prefix..prefix + 8].copy_from_slice(&size.to_le_bytes());
}

/// The masks of a leaf's values that satisfy `test`.
fn leaf_mask(values: &[f32; 512], test: impl Fn(f32) -> bool) -> [u64; 8] {
    std::array::from_fn(|x| mask_of(&values.as_chunks::<64>().0[x], &test))
}

/// The bits of the values that satisfy `test`. The tests run in vector registers; then a single
/// multiplication gathers eight bytes of 0 or 1 into eight bits, moving byte i to bit 56 + i.
fn mask_of(values: &[f32; 64], test: impl Fn(f32) -> bool) -> u64 {
    const GATHER: u64 = 0x0102_0408_1020_4080;
    let bytes = values.map(|value| u8::from(test(value)));
    let bits = |row: &[u8; 8]| u64::from_le_bytes(*row).wrapping_mul(GATHER) >> 56;
    bytes.as_chunks::<8>().0.iter().rev().fold(0, |mask, row| mask << 8 | bits(row))
}

/// Converts a distance in voxels to the stored distance, in world units. The background is computed in the
/// same way: rounding is monotonic, so the result for a value beyond the half width cannot be below the
/// background.
pub(super) fn to_world(value: f32, scale: f64) -> f32 {
    #[expect(clippy::cast_possible_truncation, reason = "rounded to the precision of the file")]
    let world = (f64::from(value) * scale) as f32;
    world
}

/// Appends the values of the slots that are not `occupied`: + background, or − background where `negative`.
fn append_inactive(occupied: &[u64], negative: &[u64], out: &mut Vec<u8>) {
    let words = || occupied.iter().zip(negative);
    if words().all(|(occupied, negative)| !occupied & negative == 0) {
        out.push(inactive::PLUS_BACKGROUND);
    } else if words().all(|(occupied, negative)| !occupied & !negative == 0) {
        out.push(inactive::MINUS_BACKGROUND);
    } else {
        out.push(inactive::MASK_OF_BACKGROUNDS);
        for (occupied, negative) in words() {
            out.extend_from_slice(&(!occupied & !negative).to_le_bytes());
        }
    }
}

/// Appends values in their stored form.
pub(super) fn push_values(values: &[f32], half: bool, out: &mut Vec<u8>) {
    if half {
        let mut halves = [f16::ZERO; 512];
        for values in values.chunks(halves.len()) {
            halves[..values.len()].convert_from_f32_slice(values);
            out.extend(halves[..values.len()].iter().flat_map(|half| half.to_le_bytes()));
        }
    } else {
        let start = out.len();
        out.resize(start + 4 * values.len(), 0);
        for (bytes, value) in out[start..].as_chunks_mut::<4>().0.iter_mut().zip(values) {
            *bytes = value.to_le_bytes();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn leaf(origin: [i32; 3], low_inside: bool, high_inside: bool) -> TreeLeaf {
        let summary = LeafSummary { active: [1; 8], inside: false, low_inside, high_inside, has_nan: false };
        TreeLeaf { origin, summary }
    }

    /// The bottom and top layers of a block, 4096 × 4096 voxels wide and `top − bottom` high: leaves without
    /// values, because with values the test would need a gigabyte.
    fn block(bottom: i32, top: i32) -> Vec<TreeLeaf> {
        let columns = (0..512).flat_map(|x| (0..512).map(move |y| [8 * x - 4096, 8 * y]));
        let pair = |[x, y]: [i32; 2]| [leaf([x, y, bottom], false, true), leaf([x, y, top], true, false)];
        let mut leaves: Vec<TreeLeaf> = columns.flat_map(pair).collect();
        leaves.sort_by_key(|leaf| [12, 7, 3].map(|log2| leaf.origin.map(|c| c >> log2)));
        leaves
    }

    #[test]
    fn inside_of_a_solid_larger_than_a_root_child_is_filled() {
        let leaves = block(-800, 8192 + 1600);
        let tree = GridTree::new(&leaves);
        assert_eq!(tree.tiles, [[-4096, 0, 0], [-4096, 0, 4096]]);
        let coords: Vec<[i32; 3]> = tree.nodes5.iter().map(|node| node.parent.coord).collect();
        assert_eq!(coords, [[-1, 0, -1], [-1, 0, 2]]);
        // The block extends 800 voxels below the boundary: six whole nodes of 128, and 32 voxels in the
        // seventh.
        let below = &tree.nodes5[0];
        assert_eq!(count_ones(&below.children), 32 * 32);
        assert_eq!(count_ones(&below.parent.inside), 32 * 32 * 6);
        let node = tree.nodes4.iter().find(|node| node.parent.coord[2] == -7).expect("the seventh node");
        assert_eq!(count_ones(&node.children), 256);
        assert_eq!(count_ones(&node.parent.inside), 256 * 3);
        assert!(
            is_on(&node.parent.inside, slot_of([0, 0, 15], 4))
                && !is_on(&node.parent.inside, slot_of([0, 0, 11], 4))
        );
    }

    #[test]
    fn surface_with_holes_only_fills_its_own_rows() {
        // A pair of leaves that face each other over a large distance, not a closed surface.
        let leaves = [leaf([0, 0, -1 << 20], false, true), leaf([0, 0, 1 << 20], true, false)];
        let tree = GridTree::new(&leaves);
        assert!(tree.tiles.is_empty());
        let inside: usize = tree.nodes4.iter().map(|node| count_ones(&node.parent.inside)).sum();
        assert_eq!(inside, 15);
        // Leaves that face each other from outside leave the gap outside.
        let leaves = [leaf([0, 0, 0], true, false), leaf([0, 0, 64], false, true)];
        assert_eq!(count_ones(&GridTree::new(&leaves).nodes4[0].parent.inside), 0);
    }
}
