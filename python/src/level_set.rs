//! Values of a level set between and beyond its stored voxels.
//!
//! ```text
//!   a row of leaves along x      ·  ·  [+ + −]  ·  ·  [− − +]  ·
//!   sign                         +  +           −  −           +
//!
//!   · is not stored: |φ| is the half width, and the sign is that of the last stored voxel before it in the
//!     row, or + before the first leaf
//! ```
//!
//! A surface is always within stored leaves, so the sign cannot change between them.

use std::collections::TryReserveError;

use meniscus::glam::{DVec3, IVec3};
use meniscus::surface::{LEAF_EDGE, NarrowBand, checkpoint};
use rayon::prelude::*;
use rustc_hash::FxHashMap;

/// The leaves of a level set by rows along x.
pub(crate) struct Rows {
    /// For each row, by the y and z of its leaves: x and index of each leaf, in order of x.
    rows: FxHashMap<(i32, i32), Vec<(i32, u32)>>,
}

impl Rows {
    pub(crate) fn new(band: &NarrowBand) -> Rows {
        let mut rows: FxHashMap<(i32, i32), Vec<(i32, u32)>> = FxHashMap::default();
        for (index, origin) in (0..).zip(band.topology.origins()) {
            rows.entry((origin.y, origin.z)).or_default().push((origin.x, index));
        }
        rows.values_mut().for_each(|row| row.sort_unstable());
        Rows { rows }
    }

    /// φ at a voxel, in voxels: within ± the half width.
    fn at(&self, band: &NarrowBand, voxel: IVec3) -> f32 {
        let origin = voxel & IVec3::splat(!(LEAF_EDGE - 1));
        let local = voxel - origin;
        let row = self.rows.get(&(origin.y, origin.z)).map_or(&[][..], Vec::as_slice);
        let end = row.partition_point(|(x, _)| *x <= origin.x);
        let Some((x, leaf)) = end.checked_sub(1).map(|index| row[index]) else { return band.half_width };
        let values = &band.phi.leaves[leaf as usize].values;
        let value = |x: i32| values[(x as usize) << 6 | (local.y as usize) << 3 | local.z as usize];
        if x == origin.x { value(local.x) } else { band.half_width.copysign(value(LEAF_EDGE - 1)) }
    }

    /// φ at points given in voxels, by trilinear interpolation. NaN for points that are not finite or beyond
    /// 2³⁰ voxels.
    pub(crate) fn sample(&self, band: &NarrowBand, points: &[[f64; 3]], voxel_size: f64) -> Vec<f32> {
        let one = |point: &[f64; 3]| {
            let point = DVec3::from(*point) / voxel_size;
            let has_index = point.is_finite() && point.abs().max_element() < f64::from(1 << 30);
            if !has_index {
                return f32::NAN;
            }
            let (least, part) = (point.floor().as_ivec3(), (point - point.floor()).as_vec3());
            (0..8).fold(0.0, |sum, corner| {
                let step = IVec3::new(corner >> 2 & 1, corner >> 1 & 1, corner & 1);
                let weight = |part: f32, step: i32| if step == 1 { part } else { 1.0 - part };
                let weight = weight(part.x, step.x) * weight(part.y, step.y) * weight(part.z, step.z);
                // A point at a voxel has exactly the value of that voxel.
                if weight == 0.0 { sum } else { sum + weight * self.at(band, least + step) }
            })
        };
        let of_chunk = |chunk: &'_ [[f64; 3]]| {
            checkpoint();
            chunk.iter().map(one).collect::<Vec<f32>>()
        };
        points.par_chunks(CHUNK_POINTS).flat_map_iter(of_chunk).collect()
    }

    /// φ at all voxels of a box, z fastest.
    ///
    /// # Errors
    /// When the system has not enough memory.
    pub(crate) fn dense(
        &self,
        band: &NarrowBand,
        least: IVec3,
        size: [usize; 3],
    ) -> Result<Vec<f32>, TryReserveError> {
        let [width, height, depth] = size;
        let slab_len = height * depth;
        let mut values = Vec::new();
        values.try_reserve_exact(width * slab_len)?;
        for x in 0..width {
            checkpoint();
            let start = values.len();
            values.resize(start + slab_len, 0.0);
            values[start..].par_chunks_mut(depth.max(1)).enumerate().for_each(|(y, row)| {
                for (z, value) in row.iter_mut().enumerate() {
                    *value = self.at(band, least + IVec3::new(x as i32, y as i32, z as i32));
                }
            });
        }
        Ok(values)
    }
}

/// Number of points between checks for cancellation: a fraction of a millisecond.
const CHUNK_POINTS: usize = 1 << 12;
