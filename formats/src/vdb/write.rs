//! Writes a narrow-band level set as one OpenVDB file.
//!
//! ```text
//!   leaves ──encode, in parallel──▶ leaf buffers, and a summary of each
//!                                         │ sign flood
//!                                         ▼
//!   header · descriptor · metadata · transform · topology · leaf buffers      one pass, no seeking
//! ```
//!
//! The buffers come last in the file and their sizes first, so they are made before anything is
//! written; then the file is one sequential write.
//!
//! Invariants of what is written: children of the root in ascending order (readers keep them sorted
//! and read the buffers in that order, so any other silently mixes up the leaves); a leaf has an
//! active voxel; every inactive value is exactly + or − background; half floats are announced by
//! both the type's suffix and the metadata, for either alone does not load.

use std::io::Write;

use half::f16;
use rayon::prelude::*;

use super::encode_leaves::{
    Batch, Encoding, LeafSummary, append_inactive, encode_leaves, push_values, to_world,
};
use super::layout::{
    COMPRESS_ACTIVE_MASK, COMPRESS_BLOSC, HALF_SUFFIX, LIBRARY_VERSION, MAGIC, META_HALF, NODE4_LOG2,
    NODE4_VOXELS_LOG2, NODE5_LOG2, NODE5_VOXELS_LOG2, TYPE_FLOAT, VERSION_WRITTEN, count_ones, inactive,
    is_on, ones, slot_coord, slot_of,
};
use super::metadata::{MetaWriter, push_string};
use super::sign_flood::{Cell, Parent, inside_gaps, parents};
use super::uuid::{self, Digest, digest};
use super::{Compression, FORMAT};
use crate::data::{LevelSetView, Provenance};
use crate::error::{Error, Place, Result};
use crate::provenance::{GENERATOR, prefixed};

/// How to write a level set.
#[derive(Clone, Debug)]
pub struct WriteOptions {
    /// The name that programs show.
    pub name: String,
    /// Store 16-bit floats: half the size before compression, and three decimal digits.
    pub half: bool,
    /// How values are packed.
    pub compression: Compression,
    /// World position of the centre of voxel (0, 0, 0).
    pub origin: [f64; 3],
}

impl Default for WriteOptions {
    fn default() -> WriteOptions {
        WriteOptions {
            name: "surface".into(),
            half: false,
            compression: Compression::default(),
            origin: [0.0; 3],
        }
    }
}

/// A file that is ready to be written: its leaves are packed, and nothing of the level set is needed any more.
pub struct Encoded {
    head: Vec<u8>,
    grid: Vec<u8>,
    batches: Vec<Batch>,
}

impl Encoded {
    /// Writes the file, in one go from its start to its end.
    ///
    /// # Errors
    ///
    /// [`Error::Io`] if `out` fails.
    pub fn write(&self, out: &mut impl Write) -> Result<()> {
        out.write_all(&self.head)?;
        out.write_all(&self.grid)?;
        for batch in &self.batches {
            out.write_all(&batch.bytes)?;
        }
        Ok(())
    }
}

/// Writes `levels` as a file with one float grid of class "level set".
///
/// # Errors
///
/// [`Error::Io`] if `out` fails; else those of [`encode`].
pub fn write(
    levels: &LevelSetView,
    options: &WriteOptions,
    provenance: &Provenance,
    out: &mut impl Write,
) -> Result<()> {
    encode(levels, options, provenance)?.write(out)
}

/// Encodes `levels` as a file with one float grid of class "level set", in the pool of the caller.
///
/// # Errors
///
/// [`Error::Invalid`] if the level set is none: origins that are no distinct multiples of 8, values that are no
/// numbers, a background that is not positive and finite in the precision of the file.
pub fn encode(levels: &LevelSetView, options: &WriteOptions, provenance: &Provenance) -> Result<Encoded> {
    let order = tree_order(levels)?;
    let encoding = encoding(levels, options)?;
    let batches = encode_leaves(levels.leaves, &order, encoding);
    let leaves = leaves_of(levels, &order, &batches)?;
    let tree = Tree::new(&leaves);
    let stored = || leaves.iter().filter(|leaf| leaf.summary.is_stored());

    let mut grid = Vec::new();
    let compression: u32 = match options.compression {
        Compression::None => 0,
        Compression::ActiveMask => COMPRESS_ACTIVE_MASK,
        Compression::Blosc => COMPRESS_ACTIVE_MASK | COMPRESS_BLOSC,
    };
    grid.extend_from_slice(&compression.to_le_bytes());
    metadata(stored(), &tree, options, provenance).append_to(&mut grid);
    append_transform(levels.voxel_size, options.origin, &mut grid);
    tree.append_topology(stored(), encoding, &mut grid);

    let buffer_bytes: u64 = batches.iter().map(|batch| batch.bytes.len() as u64).sum();
    let mut digests = vec![digest(&grid)];
    digests.extend(batches.iter().map(|batch| batch.digest));
    let mut head = header(&digests);
    append_descriptor(options, grid.len() as u64, buffer_bytes, &mut head);
    Ok(Encoded { head, grid, batches })
}

/// The leaves' indices in the order of the tree: by root child, lower node and leaf, each by x, y, z.
fn tree_order(levels: &LevelSetView) -> Result<Vec<u32>> {
    let LevelSetView { origins, leaves, .. } = levels;
    let invalid = |what: String| Err(Error::invalid(FORMAT, Place::File, what));
    if origins.len() != leaves.len() {
        return invalid(format!("{} leaf origins for {} leaves", origins.len(), leaves.len()));
    }
    let Ok(count) = u32::try_from(leaves.len()) else {
        return Err(Error::too_large(FORMAT, format!("{} leaves; 2³² − 1 can be written", leaves.len())));
    };
    if let Some(origin) = origins.iter().find(|origin| origin.iter().any(|c| c & 7 != 0)) {
        return invalid(format!("leaf origin {origin:?} is not a multiple of 8"));
    }
    let key = |index: &u32| {
        let origin = origins[*index as usize];
        [NODE5_VOXELS_LOG2, NODE4_VOXELS_LOG2, 0].map(|log2| origin.map(|c| c >> log2))
    };
    let mut order: Vec<u32> = (0..count).collect();
    order.par_sort_unstable_by_key(key);
    if let Some(pair) = order.windows(2).find(|pair| key(&pair[0]) == key(&pair[1])) {
        return invalid(format!("leaf origin {:?} occurs twice", origins[pair[0] as usize]));
    }
    Ok(order)
}

fn encoding(levels: &LevelSetView, options: &WriteOptions) -> Result<Encoding> {
    let scale = levels.voxel_size;
    let mut background = to_world(levels.half_width_voxels, scale);
    if options.half {
        background = f16::from_f32(background).to_f32();
    }
    let valid = |value: f64| value.is_finite() && 0.0 < value;
    if !(valid(scale) && valid(f64::from(background)) && options.origin.iter().all(|c| c.is_finite())) {
        let what = format!(
            "a band of {} voxels of {scale} world units gives the background {background}; \
             it must be positive and finite in {} bits",
            levels.half_width_voxels,
            if options.half { 16 } else { 32 }
        );
        return Err(Error::invalid(FORMAT, Place::File, what));
    }
    Ok(Encoding { scale, background, half: options.half, compression: options.compression })
}

/// A leaf in the order of the tree.
struct Leaf {
    origin: [i32; 3],
    summary: LeafSummary,
}

fn leaves_of(levels: &LevelSetView, order: &[u32], batches: &[Batch]) -> Result<Vec<Leaf>> {
    let summaries = batches.iter().flat_map(|batch| &batch.summaries);
    let leaves: Vec<Leaf> = order
        .iter()
        .zip(summaries)
        .map(|(&index, &summary)| Leaf { origin: levels.origins[index as usize], summary })
        .collect();
    match leaves.iter().find(|leaf| leaf.summary.has_nan) {
        None => Ok(leaves),
        Some(leaf) => {
            let what = format!("the leaf at {:?} holds values that are no numbers", leaf.origin);
            Err(Error::invalid(FORMAT, Place::File, what))
        }
    }
}

/// A node of the tree above the leaves.
struct Node {
    /// Position, in nodes of its level; and its inside slots.
    parent: Parent,
    /// One bit per slot: whether there is a child.
    children: Vec<u64>,
}

impl Node {
    fn new(parent: Parent) -> Node {
        Node { children: vec![0; parent.inside.len()], parent }
    }

    /// A node without children that is all inside or all outside is a tile of its parent.
    fn tile(&self) -> Option<bool> {
        let inside = &self.parent.inside;
        let uniform = inside.iter().all(|&word| word == 0) || inside.iter().all(|&word| word == u64::MAX);
        (uniform && count_ones(&self.children) == 0).then(|| inside[0] != 0)
    }
}

/// Everything above the leaves.
struct Tree {
    /// Lower nodes that are children, sorted by x, y, z.
    nodes4: Vec<Node>,
    /// Upper nodes that are children, sorted by x, y, z.
    nodes5: Vec<Node>,
    /// Origins, in voxels, of the root's inside tiles, sorted by x, y, z.
    tiles: Vec<[i32; 3]>,
}

impl Tree {
    fn new(leaves: &[Leaf]) -> Tree {
        let mut cells: Vec<(Cell, bool, bool)> = leaves
            .iter()
            .map(|Leaf { origin, summary }| {
                let &LeafSummary { low_inside, high_inside, inside, .. } = summary;
                let cell = Cell { coord: origin.map(|c| c >> 3), low_inside, high_inside };
                (cell, summary.is_stored(), inside)
            })
            .collect();
        cells.par_sort_unstable_by_key(|(cell, ..)| cell.coord);
        let (cells4, mut nodes4) = level(cells, NODE4_LOG2);
        let (cells5, nodes5) = level(cells4, NODE5_LOG2);
        nodes4.retain(|node| node.tile().is_none());

        let bare: Vec<Cell> = cells5.iter().map(|&(cell, ..)| cell).collect();
        let gaps = inside_gaps(&bare)
            .flat_map(|gap| (gap.after + 1..gap.before).map(move |z| [gap.xy[0], gap.xy[1], z]));
        let tiles = nodes5.iter().filter(|node| node.tile() == Some(true)).map(|node| node.parent.coord);
        let mut tiles: Vec<[i32; 3]> =
            gaps.chain(tiles).map(|coord| coord.map(|c| c << NODE5_VOXELS_LOG2)).collect();
        tiles.sort_unstable();
        let nodes5 = nodes5.into_iter().filter(|node| node.tile().is_none()).collect();
        Tree { nodes4, nodes5, tiles }
    }

    /// The topology: background, tiles and children of the root, and the nodes depth first.
    fn append_topology<'a>(
        &self,
        mut leaves: impl Iterator<Item = &'a Leaf>,
        encoding: Encoding,
        out: &mut Vec<u8>,
    ) {
        out.extend_from_slice(&1u32.to_le_bytes()); // buffers per leaf
        out.extend_from_slice(&encoding.background.to_le_bytes());
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

/// The nodes above some cells, and those nodes as cells of the next level.
///
/// A cell comes with whether it is a child, and if not, whether it is an inside tile. Both results
/// are sorted by x, y, z, as the cells must be.
fn level(cells: Vec<(Cell, bool, bool)>, log2: u32) -> (Vec<(Cell, bool, bool)>, Vec<Node>) {
    let bare: Vec<Cell> = cells.iter().map(|&(cell, ..)| cell).collect();
    let mut nodes: Vec<Node> = parents(&bare, log2).into_iter().map(Node::new).collect();
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

fn append_node(node: &Node, encoding: Encoding, out: &mut Vec<u8>) {
    let Node { parent, children } = node;
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
        let values: Vec<f32> = (0..children.len() * 64).map(value_at).collect();
        push_values(&values, encoding.half, out);
        return;
    }
    append_inactive(children, &parent.inside, out);
    // No value is active. An empty chunk of 32-bit values still has a size; of 16-bit ones, none.
    if encoding.compression == Compression::Blosc && !encoding.half {
        out.extend_from_slice(&0i64.to_le_bytes());
    }
}

fn metadata<'a>(
    leaves: impl Iterator<Item = &'a Leaf>,
    tree: &Tree,
    options: &WriteOptions,
    provenance: &Provenance,
) -> MetaWriter {
    let (mut min, mut max) = ([i32::MAX; 3], [i32::MIN; 3]); // what OpenVDB writes if nothing is active
    let (mut leaf_count, mut voxel_count) = (0, 0);
    for leaf in leaves {
        leaf_count += 1;
        voxel_count += count_ones(&leaf.summary.active);
        let (low, high) = active_bounds(&leaf.summary.active);
        for axis in 0..3 {
            min[axis] = min[axis].min(leaf.origin[axis] + low[axis]);
            max[axis] = max[axis].max(leaf.origin[axis] + high[axis]);
        }
    }
    // OpenVDB's own sizes in memory; some programs refuse a grid without this entry.
    let mem_bytes = 270_360 * tree.nodes5.len() + 33_816 * tree.nodes4.len() + 2_164 * leaf_count;
    let mut meta = MetaWriter::default();
    meta.string("class", "level set");
    meta.string("creator", GENERATOR);
    meta.vec3i("file_bbox_max", max);
    meta.vec3i("file_bbox_min", min);
    let compression = match options.compression {
        Compression::None => "none",
        Compression::ActiveMask => "active values",
        Compression::Blosc => "blosc + active values",
    };
    meta.string("file_compression", compression);
    meta.int64("file_mem_bytes", mem_bytes as i64);
    meta.int64("file_voxel_count", voxel_count as i64);
    if options.half {
        meta.push(META_HALF, "bool", &[1]);
    }
    meta.string("name", &options.name);
    for (key, value) in provenance {
        meta.string(&prefixed(key), value);
    }
    meta
}

/// The least and the greatest active voxel of a leaf on each axis; some voxel must be active.
fn active_bounds(active: &[u64; 8]) -> ([i32; 3], [i32; 3]) {
    let xs = active.iter().enumerate().fold(0u8, |bits, (x, &word)| bits | u8::from(word != 0) << x);
    let plane = active.iter().fold(0, |bits, word| bits | word).to_le_bytes();
    let ys = plane.iter().enumerate().fold(0u8, |bits, (y, &row)| bits | u8::from(row != 0) << y);
    let zs = plane.iter().fold(0, |bits, row| bits | row);
    let low = [xs, ys, zs].map(|bits| bits.trailing_zeros() as i32);
    let high = [xs, ys, zs].map(|bits| 7 - bits.leading_zeros() as i32);
    (low, high)
}

fn append_transform(voxel_size: f64, origin: [f64; 3], out: &mut Vec<u8>) {
    let mut numbers = Vec::new();
    if origin == [0.0; 3] {
        push_string(out, b"UniformScaleMap");
    } else {
        push_string(out, b"UniformScaleTranslateMap");
        numbers.extend(origin);
    }
    let inverse = 1.0 / voxel_size;
    for number in [voxel_size, voxel_size, inverse, inverse * inverse, inverse / 2.0] {
        numbers.extend([number; 3]); // scale, voxel size, and what OpenVDB derives from them
    }
    out.extend(numbers.iter().flat_map(|number| number.to_le_bytes()));
}

fn header(digests: &[Digest]) -> Vec<u8> {
    let bytes: Vec<u8> = digests.as_flattened().iter().flat_map(|word| word.to_le_bytes()).collect();
    let mut head = Vec::new();
    head.extend_from_slice(&MAGIC);
    for number in [VERSION_WRITTEN, LIBRARY_VERSION[0], LIBRARY_VERSION[1]] {
        head.extend_from_slice(&number.to_le_bytes());
    }
    head.push(1); // grids have offsets
    head.extend_from_slice(uuid::format(digest(&bytes)).as_bytes());
    head.extend_from_slice(&0u32.to_le_bytes()); // no metadata of the file
    head.extend_from_slice(&1u32.to_le_bytes()); // one grid
    head
}

/// The grid's descriptor, which ends the head. `grid_bytes` follow it, then `buffer_bytes`.
fn append_descriptor(options: &WriteOptions, grid_bytes: u64, buffer_bytes: u64, head: &mut Vec<u8>) {
    push_string(head, options.name.as_bytes());
    push_string(head, format!("{TYPE_FLOAT}{}", if options.half { HALF_SUFFIX } else { "" }).as_bytes());
    push_string(head, b""); // no instance of another grid
    let grid_start = head.len() as u64 + 24;
    let buffer_start = grid_start + grid_bytes;
    for position in [grid_start, buffer_start, buffer_start + buffer_bytes] {
        head.extend_from_slice(&position.to_le_bytes());
    }
}

fn push_coord(coord: [i32; 3], out: &mut Vec<u8>) {
    out.extend_from_slice(coord.map(i32::to_le_bytes).as_flattened());
}

/// A count that is below 2³² because the leaves are.
fn count_u32(count: usize) -> u32 {
    u32::try_from(count).unwrap_or(u32::MAX)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn leaf(origin: [i32; 3], low_inside: bool, high_inside: bool) -> Leaf {
        let summary = LeafSummary { active: [1; 8], inside: false, low_inside, high_inside, has_nan: false };
        Leaf { origin, summary }
    }

    /// The bottom and the top of a block, 4096 × 4096 voxels wide and `top − bottom` high: leaves
    /// without values, for with them this would take a gigabyte.
    fn block(bottom: i32, top: i32) -> Vec<Leaf> {
        let columns = (0..512).flat_map(|x| (0..512).map(move |y| [8 * x - 4096, 8 * y]));
        let pair = |[x, y]: [i32; 2]| [leaf([x, y, bottom], false, true), leaf([x, y, top], true, false)];
        let mut leaves: Vec<Leaf> = columns.flat_map(pair).collect();
        leaves.sort_by_key(|leaf| [12, 7, 3].map(|log2| leaf.origin.map(|c| c >> log2)));
        leaves
    }

    #[test]
    fn solids_larger_than_a_root_child_are_flooded() {
        let leaves = block(-800, 8192 + 1600);
        let tree = Tree::new(&leaves);
        assert_eq!(tree.tiles, [[-4096, 0, 0], [-4096, 0, 4096]]);
        let coords: Vec<[i32; 3]> = tree.nodes5.iter().map(|node| node.parent.coord).collect();
        assert_eq!(coords, [[-1, 0, -1], [-1, 0, 2]]);
        // 800 voxels below the boundary: six whole nodes of 128, and 32 voxels in the seventh.
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
    fn a_torn_surface_floods_its_rows_only() {
        // One pair of leaves that look at each other over a great distance: no closed surface.
        let leaves = [leaf([0, 0, -1 << 20], false, true), leaf([0, 0, 1 << 20], true, false)];
        let tree = Tree::new(&leaves);
        assert!(tree.tiles.is_empty());
        let inside: usize = tree.nodes4.iter().map(|node| count_ones(&node.parent.inside)).sum();
        assert_eq!(inside, 15);
        // And leaves that look at each other from outside leave the gap outside.
        let leaves = [leaf([0, 0, 0], true, false), leaf([0, 0, 64], false, true)];
        assert_eq!(count_ones(&Tree::new(&leaves).nodes4[0].parent.inside), 0);
    }

    #[test]
    fn the_ends_of_the_index_range_are_written() {
        let (least, most) = (i32::MIN, i32::MAX - 7);
        let leaves = [[0.0; 512]; 2];
        let view = LevelSetView {
            origins: &[[most; 3], [least; 3]],
            leaves: &leaves,
            half_width_voxels: 3.0,
            voxel_size: 1.0,
        };
        let mut bytes = Vec::new();
        write(&view, &WriteOptions::default(), &[], &mut bytes).expect("writing to memory");
        let data = crate::vdb::read_level_set(&bytes, None, &crate::Limits::default()).expect("reading");
        assert_eq!(data.origins, [[least; 3], [most; 3]]);
    }
}
