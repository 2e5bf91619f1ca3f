//! Writes a narrow-band level set and attributes of its voxels as one OpenVDB file.
//!
//! ```text
//!   leaves ──encode, in parallel──▶ leaf buffers, and a summary of each
//!                                         │ sign flood
//!                                         ▼
//!   header · descriptor · metadata · transform · topology · leaf buffers · descriptor · …
//!            └────────────── the level set ─────────────────────────────┘ └ the next grid
//! ```
//!
//! A descriptor states the offsets of the buffers and of the grid's end, and comes before the buffers. So all
//! buffers are encoded before anything is written; then the file is written sequentially.
//!
//! Invariants of the output:
//!
//! - The children of the root are in ascending order. Readers sort them and read the buffers in that order,
//!   so any other order silently mixes up the leaves.
//! - Each leaf has an active voxel.
//! - Every inactive value is exactly + or − background.
//! - The type's suffix and the metadata both declare half floats: OpenVDB cannot load files with only one of
//!   the two declarations.

use std::io::Write;

use half::f16;
use rayon::prelude::*;

use super::tree::{
    EncodedBatch, GridTree, LEAVES_PER_BATCH, LeafEncoding, Packed, TreeLeaf, append_chunk, count_u32,
    encode_leaves, push_values, to_world,
};
use super::{
    COMPRESS_ACTIVE_MASK, COMPRESS_BLOSC, Compression, FORMAT, HALF_SUFFIX, LIBRARY_VERSION, MAGIC,
    META_HALF, MetaWriter, NODE4_VOXELS_LOG2, NODE5_VOXELS_LOG2, TYPE_FLOAT, TYPE_VEC3S, VELOCITY,
    VERSION_WRITTEN, count_ones, inactive, ones, push_string,
};
use crate::core::blosc::Encoder;
use crate::core::data::{AttributeRole, BandGrid, LevelSetView, Provenance};
use crate::core::error::{Error, Position, Result};
use crate::core::provenance::{GENERATOR, prefixed};
use crate::core::vertex_attributes::UsedNames;

/// Options for writing a level set.
#[derive(Clone, Debug)]
pub struct WriteOptions {
    /// The grid name, shown by other programs.
    pub name: String,
    /// Whether to store 16-bit floats: half the size before compression, and three decimal digits.
    pub half: bool,
    /// The compression of values.
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

/// An encoded file: its leaves are compressed, so the level set is no longer needed.
pub struct EncodedVdb {
    header: Vec<u8>,
    grids: Vec<EncodedGrid>,
}

/// One grid of an encoded file.
struct EncodedGrid {
    descriptor: Vec<u8>,
    /// Everything between descriptor and buffers.
    body: Vec<u8>,
    buffers: Vec<Packed>,
}

impl EncodedVdb {
    /// Writes the file sequentially.
    ///
    /// # Errors
    ///
    /// [`Error::Io`] if `out` fails.
    pub fn write(&self, out: &mut impl Write) -> Result<()> {
        out.write_all(&self.header)?;
        for EncodedGrid { descriptor, body, buffers } in &self.grids {
            out.write_all(descriptor)?;
            out.write_all(body)?;
            for buffer in buffers {
                out.write_all(&buffer.bytes)?;
            }
        }
        Ok(())
    }
}

/// Writes `levels` as a file: a float grid of class "level set", followed by the additional grids of
/// `levels`.
///
/// # Errors
///
/// [`Error::Io`] if `out` fails; otherwise those of [`encode`].
pub fn write(
    levels: &LevelSetView,
    options: &WriteOptions,
    provenance: &Provenance,
    out: &mut impl Write,
) -> Result<()> {
    encode(levels, options, provenance)?.write(out)
}

/// Encodes `levels` as a file, in the caller's thread pool: a float grid of class "level set", followed by
/// the additional grids of `levels`, which have the same active voxels. With 16-bit floats, a grid with
/// values beyond ± 65504 keeps 32 bits.
///
/// # Errors
///
/// [`Error::Invalid`] if the level set is invalid: origins that are not distinct multiples of 8, NaN values,
/// a background that is not positive and finite in the precision of the file, or an origin that is not
/// finite; or if a grid has a value that is not finite, or a number of components other than one or three.
pub fn encode(levels: &LevelSetView, options: &WriteOptions, provenance: &Provenance) -> Result<EncodedVdb> {
    let order = tree_order(levels)?;
    let encoding = encoding(levels, options)?;
    let batches = encode_leaves(levels.leaves, &order, encoding);
    let leaves = leaves_of(levels, &order, &batches)?;
    let buffers = batches.into_iter().map(|batch| batch.packed).collect();
    let tree = GridTree::new(&leaves);
    let mut metadata = metadata(&leaves, &tree, "level set", &options.name, encoding);
    for (key, value) in provenance {
        metadata.string(&prefixed(key), value);
    }
    let surface = GridParts { name: &options.name, encoding, metadata, buffers };
    let mut grids = vec![surface.finish(levels, options, &tree, &leaves)];
    let tree = GridTree::without_sides(&leaves);
    for (grid, name) in levels.grids.iter().zip(grid_names(levels.grids, &options.name)) {
        let (encoding, buffers) = encoded_leaves(grid, (&order, &leaves), options)?;
        let mut metadata = self::metadata(&leaves, &tree, "unknown", &name, encoding);
        if grid.arity == 3 {
            let is_relative =
                matches!(grid.role, Some(AttributeRole::Velocity | AttributeRole::Acceleration));
            let kind = if is_relative { "contravariant relative" } else { "invariant" };
            metadata.string("vector_type", kind);
        }
        let grid = GridParts { name: &name, encoding, metadata, buffers };
        grids.push(grid.finish(levels, options, &tree, &leaves));
    }
    Ok(assembled(grids))
}

/// Encodes the leaves of an additional grid, in 16 bits if requested and if the values fit.
fn encoded_leaves(
    grid: &BandGrid,
    leaves: (&[u32], &[TreeLeaf]),
    options: &WriteOptions,
) -> Result<(LeafEncoding, Vec<Packed>)> {
    let (arity, compression) = (grid.arity, options.compression);
    let full = LeafEncoding { scale: 1.0, background: 0.0, arity, half: false, compression };
    let encoding = LeafEncoding { half: options.half, ..full };
    let (packed, greatest) = encode_grid(grid, leaves, encoding)?;
    if encoding.half && greatest > f16::MAX.to_f32() {
        let (packed, _) = encode_grid(grid, leaves, full)?;
        return Ok((full, packed));
    }
    Ok((encoding, packed))
}

/// Notes on grids whose names differ from those of their attributes. `name` is the name of the level set.
pub fn grid_notes(grids: &[BandGrid], name: &str) -> Vec<String> {
    let is_plain = |grid: &BandGrid| grid.role == Some(AttributeRole::Velocity) && grid.arity == 3;
    let named = grids.iter().zip(grid_names(grids, name));
    let renamed = named.filter(|(grid, name)| !is_plain(grid) && *name != grid.name);
    renamed.map(|(grid, name)| format!("{} is named {name} in the .vdb", grid.name)).collect()
}

/// The unique names of the grids. A velocity gets the name by which programs find it.
fn grid_names(grids: &[BandGrid], surface: &str) -> Vec<String> {
    let mut used = UsedNames::new(&[surface]);
    let name_of = |grid: &BandGrid| {
        let own = grid.name.trim().replace(char::is_control, "_");
        let stem = match grid.role {
            Some(AttributeRole::Velocity) if grid.arity == 3 => VELOCITY,
            _ if own.is_empty() => "attribute",
            _ => &own,
        };
        used.take(stem)
    };
    grids.iter().map(name_of).collect()
}

/// A grid under construction.
struct GridParts<'a> {
    name: &'a str,
    encoding: LeafEncoding,
    metadata: MetaWriter,
    buffers: Vec<Packed>,
}

impl GridParts<'_> {
    /// Encodes the grid. Its descriptor still lacks the three offsets, which [`assembled`] appends.
    fn finish(
        self,
        levels: &LevelSetView,
        options: &WriteOptions,
        tree: &GridTree,
        leaves: &[TreeLeaf],
    ) -> EncodedGrid {
        let GridParts { name, encoding, metadata, buffers } = self;
        let mut descriptor = Vec::new();
        push_string(&mut descriptor, name.as_bytes());
        let type_name = if encoding.arity == 3 { TYPE_VEC3S } else { TYPE_FLOAT };
        let suffix = if encoding.half { HALF_SUFFIX } else { "" };
        push_string(&mut descriptor, format!("{type_name}{suffix}").as_bytes());
        push_string(&mut descriptor, b""); // not an instance of another grid

        let mut body = Vec::new();
        let compression: u32 = match encoding.compression {
            Compression::None => 0,
            Compression::ActiveMask => COMPRESS_ACTIVE_MASK,
            Compression::Blosc => COMPRESS_ACTIVE_MASK | COMPRESS_BLOSC,
        };
        body.extend_from_slice(&compression.to_le_bytes());
        metadata.append_to(&mut body);
        append_transform(levels.voxel_size, options.origin, &mut body);
        tree.append_topology(leaves, encoding, &mut body);
        EncodedGrid { descriptor, body, buffers }
    }
}

/// Assembles the grids of a file and fills in their offsets.
fn assembled(mut grids: Vec<EncodedGrid>) -> EncodedVdb {
    let digests: Vec<Digest> = grids
        .iter()
        .flat_map(|grid| std::iter::once(digest(&grid.body)).chain(grid.buffers.iter().map(|b| b.digest)))
        .collect();
    let header = header(&digests, grids.len());
    let mut end = header.len() as u64;
    for EncodedGrid { descriptor, body, buffers } in &mut grids {
        let grid_start = end + descriptor.len() as u64 + 24;
        let buffer_start = grid_start + body.len() as u64;
        end = buffer_start + buffers.iter().map(|buffer| buffer.bytes.len() as u64).sum::<u64>();
        for position in [grid_start, buffer_start, end] {
            descriptor.extend_from_slice(&position.to_le_bytes());
        }
    }
    EncodedVdb { header, grids }
}

/// The leaves' indices in tree order: sorted by root child, then by lower node, then by leaf. Each level is
/// sorted by x, then y, then z.
fn tree_order(levels: &LevelSetView) -> Result<Vec<u32>> {
    let LevelSetView { origins, leaves, .. } = levels;
    let invalid = |what: String| Err(Error::invalid(FORMAT, Position::File, what));
    if origins.len() != leaves.len() {
        return invalid(format!("there are {} leaf origins for {} leaves", origins.len(), leaves.len()));
    }
    let Ok(count) = u32::try_from(leaves.len()) else {
        return Err(Error::too_large(
            FORMAT,
            format!("the level set has {} leaves; the limit is 2³² − 1", leaves.len()),
        ));
    };
    if let Some(origin) = origins.iter().find(|origin| origin.iter().any(|c| c & 7 != 0)) {
        return invalid(format!("the leaf origin {origin:?} is not a multiple of 8"));
    }
    let key = |index: &u32| {
        let origin = origins[*index as usize];
        [NODE5_VOXELS_LOG2, NODE4_VOXELS_LOG2, 0].map(|log2| origin.map(|c| c >> log2))
    };
    let mut order: Vec<u32> = (0..count).collect();
    order.par_sort_unstable_by_key(key);
    if let Some(pair) = order.windows(2).find(|pair| key(&pair[0]) == key(&pair[1])) {
        return invalid(format!("the leaf origin {:?} occurs twice", origins[pair[0] as usize]));
    }
    Ok(order)
}

fn encoding(levels: &LevelSetView, options: &WriteOptions) -> Result<LeafEncoding> {
    let scale = levels.voxel_size;
    let mut background = to_world(levels.half_width_voxels, scale);
    if options.half {
        background = f16::from_f32(background).to_f32();
    }
    let valid = |value: f64| value.is_finite() && 0.0 < value;
    if !(valid(scale) && valid(f64::from(background)) && options.origin.iter().all(|c| c.is_finite())) {
        let what = format!(
            "a band of {} voxels of {scale} world units gives the background {background}; \
             it must be positive and finite in {} bits, and the origin {:?} must be finite",
            levels.half_width_voxels,
            if options.half { 16 } else { 32 },
            options.origin
        );
        return Err(Error::invalid(FORMAT, Position::File, what));
    }
    Ok(LeafEncoding { scale, background, arity: 1, half: options.half, compression: options.compression })
}

fn leaves_of(levels: &LevelSetView, order: &[u32], batches: &[EncodedBatch]) -> Result<Vec<TreeLeaf>> {
    let summaries = batches.iter().flat_map(|batch| &batch.summaries);
    let leaves: Vec<TreeLeaf> = order
        .iter()
        .zip(summaries)
        .map(|(&index, &summary)| TreeLeaf { origin: levels.origins[index as usize], summary })
        .collect();
    match leaves.iter().find(|leaf| leaf.summary.has_nan) {
        None => Ok(leaves),
        Some(leaf) => {
            let what = format!("the leaf at {:?} contains NaN values", leaf.origin);
            Err(Error::invalid(FORMAT, Position::File, what))
        }
    }
}

/// The metadata of every grid.
fn metadata(
    leaves: &[TreeLeaf],
    tree: &GridTree,
    class: &str,
    name: &str,
    encoding: LeafEncoding,
) -> MetaWriter {
    let (mut min, mut max) = ([i32::MAX; 3], [i32::MIN; 3]); // what OpenVDB writes if nothing is active
    let (mut leaf_count, mut voxel_count) = (0, 0);
    for leaf in leaves.iter().filter(|leaf| leaf.summary.is_stored()) {
        leaf_count += 1;
        voxel_count += count_ones(&leaf.summary.active);
        let (low, high) = active_bounds(&leaf.summary.active);
        for axis in 0..3 {
            min[axis] = min[axis].min(leaf.origin[axis] + low[axis]);
            max[axis] = max[axis].max(leaf.origin[axis] + high[axis]);
        }
    }
    let mut meta = MetaWriter::default();
    meta.string("class", class);
    meta.string("creator", GENERATOR);
    meta.vec3i("file_bbox_max", max);
    meta.vec3i("file_bbox_min", min);
    let compression = match encoding.compression {
        Compression::None => "none",
        Compression::ActiveMask => "active values",
        Compression::Blosc => "blosc + active values",
    };
    meta.string("file_compression", compression);
    // Some programs reject a grid without this entry.
    meta.int64("file_mem_bytes", tree.memory_bytes(leaf_count, encoding.arity) as i64);
    meta.int64("file_voxel_count", voxel_count as i64);
    if encoding.half {
        meta.push(META_HALF, "bool", &[1]);
    }
    meta.string("name", name);
    meta
}

/// The minimum and maximum active voxel of a leaf on each axis; at least one voxel must be active.
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
        numbers.extend([number; 3]); // scale, voxel size, and the values that OpenVDB derives from them
    }
    out.extend(numbers.iter().flat_map(|number| number.to_le_bytes()));
}

fn header(digests: &[Digest], grid_count: usize) -> Vec<u8> {
    let bytes: Vec<u8> = digests.as_flattened().iter().flat_map(|word| word.to_le_bytes()).collect();
    let mut head = Vec::new();
    head.extend_from_slice(&MAGIC);
    for number in [VERSION_WRITTEN, LIBRARY_VERSION[0], LIBRARY_VERSION[1]] {
        head.extend_from_slice(&number.to_le_bytes());
    }
    head.push(1); // grids have offsets
    head.extend_from_slice(format(digest(&bytes)).as_bytes());
    head.extend_from_slice(&0u32.to_le_bytes()); // no file metadata
    head.extend_from_slice(&count_u32(grid_count).to_le_bytes());
    head
}

// Additional grids with the same active voxels as the level set.
//
//   leaf of the level set   − − − + + + +      active: |φ| < half width
//   leaf of the grid        ∙ v v v v v ∙      the same voxels; 0 elsewhere, including outside all leaves

/// Encodes the stored leaves, given in tree order with their indices in the level set. Also returns the
/// largest absolute value.
fn encode_grid(
    grid: &BandGrid,
    (order, leaves): (&[u32], &[TreeLeaf]),
    encoding: LeafEncoding,
) -> Result<(Vec<Packed>, f32)> {
    let BandGrid { name, arity, .. } = grid;
    let invalid = |what: String| Err(Error::invalid(FORMAT, Position::File, what));
    if *arity != 1 && *arity != 3 {
        return invalid(format!("attribute {name} has {arity} values per voxel; a grid must have 1 or 3"));
    }
    let in_tree = order.par_chunks(LEAVES_PER_BATCH).zip(leaves.par_chunks(LEAVES_PER_BATCH));
    let batches: Vec<(Packed, f32)> = in_tree
        .map_init(
            || (BandLeafEncoder::new(encoding), Vec::new()),
            |(encoder, bytes), (order, leaves)| {
                bytes.clear();
                encoder.greatest = 0.0;
                for (&index, leaf) in order.iter().zip(leaves).filter(|(_, leaf)| leaf.summary.is_stored()) {
                    grid.values.fill(index as usize, &mut encoder.values);
                    encoder.append(&leaf.summary.active, bytes);
                }
                (Packed::new(bytes), encoder.greatest)
            },
        )
        .collect();
    let greatest = batches.iter().fold(0.0f32, |greatest, (_, other)| greatest.max(*other));
    if greatest == f32::INFINITY {
        return invalid(format!("attribute {name} has a value that is not finite"));
    }
    Ok((batches.into_iter().map(|(packed, _)| packed).collect(), greatest))
}

/// Encodes leaves one at a time, reusing its buffers.
struct BandLeafEncoder {
    encoding: LeafEncoding,
    /// The values of all voxels of a leaf.
    values: Vec<f32>,
    active: Vec<f32>,
    chunk: Vec<u8>,
    blosc: Encoder,
    /// The largest absolute value so far; infinite if a value was not finite.
    greatest: f32,
}

impl BandLeafEncoder {
    fn new(encoding: LeafEncoding) -> BandLeafEncoder {
        let values = vec![0.0; 512 * encoding.arity];
        let blosc = Encoder::new();
        BandLeafEncoder { encoding, values, active: Vec::new(), chunk: Vec::new(), blosc, greatest: 0.0 }
    }

    /// Appends the buffer of the leaf whose values have been filled in.
    fn append(&mut self, active: &[u64; 8], out: &mut Vec<u8>) {
        for word in active {
            out.extend_from_slice(&word.to_le_bytes());
        }
        let arity = self.encoding.arity;
        self.active.clear();
        for voxel in ones(active) {
            self.active.extend_from_slice(&self.values[voxel * arity..(voxel + 1) * arity]);
        }
        for value in &self.active {
            let size = if value.is_finite() { value.abs() } else { f32::INFINITY };
            self.greatest = self.greatest.max(size);
        }
        if self.encoding.compression == Compression::None {
            out.push(inactive::ALL_VALUES);
            self.values.fill(0.0);
            for (voxel, value) in ones(active).zip(self.active.chunks(arity)) {
                self.values[voxel * arity..(voxel + 1) * arity].copy_from_slice(value);
            }
            push_values(&self.values, self.encoding.half, out);
            return;
        }
        out.push(inactive::PLUS_BACKGROUND);
        self.chunk.clear();
        push_values(&self.active, self.encoding.half, &mut self.chunk);
        append_chunk(&self.chunk, self.encoding, &mut self.blosc, out);
    }
}

// Derives the UUID of a file from its content.
//
// OpenVDB gives every file a random UUID. Ours is computed from the bytes, so that equal inputs produce
// equal files. Two files with the same content have the same UUID: the UUID identifies the content.

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
    fn leaves_at_the_limits_of_the_index_range_round_trip() {
        let (least, most) = (i32::MIN, i32::MAX - 7);
        let leaves = [[0.0; 512]; 2];
        let view = LevelSetView {
            origins: &[[most; 3], [least; 3]],
            leaves: &leaves,
            half_width_voxels: 3.0,
            voxel_size: 1.0,
            grids: &[],
        };
        let mut bytes = Vec::new();
        write(&view, &WriteOptions::default(), &[], &mut bytes).expect("writing to memory");
        let data = crate::vdb::read_level_set(&bytes, None, &crate::Limits::default()).expect("reading");
        assert_eq!(data.origins, [[least; 3], [most; 3]]);
    }

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
