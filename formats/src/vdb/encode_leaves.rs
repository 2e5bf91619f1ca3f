//! Encodes leaves of distances as bytes of a file, in parallel.
//!
//! Each leaf is scaled to world units, split into active and inactive voxels, and compressed separately. A
//! batch of leaves is one task and one allocation. Batches are joined in order, so the bytes do not depend on
//! the number of threads.

use half::f16;
use half::slice::HalfFloatSliceExt;
use rayon::prelude::*;

use super::Compression;
use super::layout::inactive;
use super::uuid::{Digest, digest};
use crate::blosc::Encoder;

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
pub(super) fn leaf_mask(values: &[f32; 512], test: impl Fn(f32) -> bool) -> [u64; 8] {
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
pub(super) fn append_inactive(occupied: &[u64], negative: &[u64], out: &mut Vec<u8>) {
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
