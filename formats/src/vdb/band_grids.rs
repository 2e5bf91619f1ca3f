//! Additional grids with the same active voxels as the level set.
//!
//! ```text
//!   leaf of the level set   − − − + + + +      active: |φ| < half width
//!   leaf of the grid        ∙ v v v v v ∙      the same voxels; 0 elsewhere, including outside all leaves
//! ```

use rayon::prelude::*;

use super::encode_leaves::{LEAVES_PER_BATCH, LeafEncoding, Packed, append_chunk, push_values};
use super::layout::{inactive, ones};
use super::tree::TreeLeaf;
use super::{Compression, FORMAT};
use crate::blosc::Encoder;
use crate::data::BandGrid;
use crate::error::{Error, Position, Result};

/// Encodes the stored leaves, given in tree order with their indices in the level set. Also returns the
/// largest absolute value.
pub(super) fn encode_grid(
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
