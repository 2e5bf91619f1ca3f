//! Grids beside a level set, with its active voxels and values of their own.
//!
//! The caller has values for the voxels whose |φ| is less than the half width, packed: without gaps, in the
//! order of the leaves that it gave. The writer goes through leaves in the order of the tree.
//!
//! ```text
//!   leaf 0        leaf 1    leaf 2               of each leaf the voxels in the band
//!   [v v v v v v][v v][v v v v v v v v] …
//!    0            6    8                         where the values of each leaf start
//! ```
//!
//! When distances are rounded to the precision of the file, one just below the half width can come out as the
//! background: then its voxel is not active, in any of the grids.

use half::f16;
use rayon::prelude::*;

use super::blosc::Encoder;
use super::encode_leaves::{Encoding, LEAVES_PER_BATCH, Packed, append_chunk, leaf_mask, push_values};
use super::layout::{count_ones, inactive, is_on, ones};
use super::tree::Leaf;
use super::{Compression, FORMAT};
use crate::data::{BandGrid, LevelSetView};
use crate::error::{Error, Place, Result};
use crate::vertex_attributes::all_finite;

/// Whether 16 bits hold values of this size.
pub(super) fn is_half(values: &[f32]) -> bool {
    values.iter().fold(true, |all, value| all & (value.abs() <= f16::MAX.to_f32_const()))
}

/// Where the voxels of each leaf start among those of the band, and how many there are in all.
pub(super) fn leaf_starts(levels: &LevelSetView) -> Vec<usize> {
    let counts: Vec<usize> =
        levels.leaves.par_iter().map(|leaf| count_ones(&band_of(leaf, levels.half_width_voxels))).collect();
    let mut starts = Vec::with_capacity(counts.len() + 1);
    let mut end = 0;
    starts.push(end);
    for count in counts {
        end += count;
        starts.push(end);
    }
    starts
}

/// The voxels in the band.
fn band_of(leaf: &[f32; 512], half_width_voxels: f32) -> [u64; 8] {
    leaf_mask(leaf, |value| value.abs() < half_width_voxels)
}

/// Encodes the leaves that are stored, which come in the order of the tree with their places in the level set.
pub(super) fn encode_grid(
    grid: &BandGrid,
    levels: &LevelSetView,
    starts: &[usize],
    (order, leaves): (&[u32], &[Leaf]),
    encoding: Encoding,
) -> Result<Vec<Packed>> {
    check(grid, starts)?;
    let in_tree = order.par_chunks(LEAVES_PER_BATCH).zip(leaves.par_chunks(LEAVES_PER_BATCH));
    let packed = in_tree.map_init(
        || (LeafEncoder::new(encoding), Vec::new()),
        |(encoder, bytes), (order, leaves)| {
            bytes.clear();
            for (&index, leaf) in order.iter().zip(leaves).filter(|(_, leaf)| leaf.summary.is_stored()) {
                let index = index as usize;
                let band = band_of(&levels.leaves[index], levels.half_width_voxels);
                let values = &grid.values[starts[index] * grid.arity..starts[index + 1] * grid.arity];
                encoder.append(&leaf.summary.active, &band, values, bytes);
            }
            Packed::new(bytes)
        },
    );
    Ok(packed.collect())
}

fn check(grid: &BandGrid, starts: &[usize]) -> Result<()> {
    let BandGrid { name, arity, values, .. } = grid;
    let voxel_count = starts.last().copied().unwrap_or(0);
    let invalid = |what: String| Err(Error::invalid(FORMAT, Place::File, what));
    if *arity != 1 && *arity != 3 {
        return invalid(format!("{arity} values per voxel of {name}; a grid has 1 or 3"));
    }
    if voxel_count.checked_mul(*arity) != Some(values.len()) {
        return invalid(format!("{} values of {name} for {voxel_count} voxels of {arity}", values.len()));
    }
    if !all_finite(values) {
        return invalid(format!("a value of {name} that is not finite"));
    }
    Ok(())
}

/// Encodes one leaf after the other, with memory of its own.
struct LeafEncoder {
    encoding: Encoding,
    values: Vec<f32>,
    chunk: Vec<u8>,
    blosc: Encoder,
}

impl LeafEncoder {
    fn new(encoding: Encoding) -> LeafEncoder {
        LeafEncoder { encoding, values: Vec::new(), chunk: Vec::new(), blosc: Encoder::new() }
    }

    /// Appends the buffer of a leaf; `values` are those of the voxels in `band`, which has all that are active.
    fn append(&mut self, active: &[u64; 8], band: &[u64; 8], values: &[f32], out: &mut Vec<u8>) {
        for word in active {
            out.extend_from_slice(&word.to_le_bytes());
        }
        if self.encoding.compression == Compression::None {
            out.push(inactive::ALL_VALUES);
            self.spread(active, band, values);
            push_values(&self.values, self.encoding.half, out);
            return;
        }
        out.push(inactive::PLUS_BACKGROUND);
        self.chunk.clear();
        if active == band {
            push_values(values, self.encoding.half, &mut self.chunk);
        } else {
            self.select(active, band, values);
            push_values(&self.values, self.encoding.half, &mut self.chunk);
        }
        append_chunk(&self.chunk, self.encoding, &mut self.blosc, out);
    }

    /// All values of a leaf, 0 where it is not active.
    fn spread(&mut self, active: &[u64; 8], band: &[u64; 8], values: &[f32]) {
        let arity = self.encoding.arity;
        self.values.clear();
        self.values.resize(512 * arity, 0.0);
        for (voxel, value) in ones(band).zip(values.chunks(arity)).filter(|(voxel, _)| is_on(active, *voxel))
        {
            self.values[voxel * arity..(voxel + 1) * arity].copy_from_slice(value);
        }
    }

    /// The values of the active voxels alone.
    fn select(&mut self, active: &[u64; 8], band: &[u64; 8], values: &[f32]) {
        self.values.clear();
        for (voxel, value) in ones(band).zip(values.chunks(self.encoding.arity)) {
            if is_on(active, voxel) {
                self.values.extend_from_slice(value);
            }
        }
    }
}
