//! Quantized meshes: positions and normals as small integers q, with the extension KHR_mesh_quantization.
//!
//! ```text
//!   position   3 × u16, 2 bytes of padding     low + size · q / 65535: the node's translation includes low,
//!                                              the node's scale is size
//!   normal     3 × i8, 1 byte of padding       q / 127
//! ```
//!
//! This halves the size of a vertex. All axes have the same step, 1/65535 of the largest extent, so normals
//! need no correction for nonuniform scale. The error of a position is at most half a step along each axis.
//! Other vertex attributes are not quantized.

use std::io::Write;

use crate::error::Result;
use crate::le_bytes::write_pieces;

/// The name of the extension.
pub(super) const EXTENSION: &str = "KHR_mesh_quantization";

/// The largest integer of a quantized coordinate.
const STEPS: f64 = u16::MAX as f64;

/// A cube that contains all positions.
#[derive(Clone, Copy, Debug)]
pub(super) struct Cube {
    /// Its minimum corner.
    pub(super) low: [f32; 3],
    /// The positive length of its edges.
    pub(super) size: f32,
}

impl Cube {
    /// The smallest cube around these finite positions.
    pub(super) fn around(positions: &[[f32; 3]]) -> Cube {
        let Some(&first) = positions.first() else { return Cube { low: [0.0; 3], size: 1.0 } };
        let (mut low, mut high) = (first, first);
        for position in positions {
            for axis in 0..3 {
                low[axis] = low[axis].min(position[axis]);
                high[axis] = high[axis].max(position[axis]);
            }
        }
        let extent = |axis: usize| f64::from(high[axis]) - f64::from(low[axis]);
        let largest = (0..3).map(extent).fold(0.0, f64::max);
        #[expect(
            clippy::cast_possible_truncation,
            reason = "where this rounds down, the code below rounds up"
        )]
        let size = largest as f32;
        let size = if f64::from(size) < largest { size.next_up() } else { size };
        // A single point has no extent, and a scale of zero is not invertible.
        Cube { low, size: if size > 0.0 { size } else { 1.0 } }
    }

    fn quantized(&self, position: [f32; 3]) -> [u16; 3] {
        std::array::from_fn(|axis| {
            let part = (f64::from(position[axis]) - f64::from(self.low[axis])) / f64::from(self.size);
            #[expect(clippy::cast_possible_truncation, reason = "clamped to the range")]
            let steps = (part * STEPS).round_ties_even().clamp(0.0, STEPS) as u16;
            steps
        })
    }

    pub(super) fn write_positions(&self, positions: &[[f32; 3]], out: &mut impl Write) -> Result<()> {
        let to_bytes = |position| {
            let [[a, b], [c, d], [e, f]] = self.quantized(position).map(u16::to_le_bytes);
            [a, b, c, d, e, f, 0, 0]
        };
        write_pieces(positions, to_bytes, out)
    }

    /// The smallest and largest integer of each axis.
    pub(super) fn bounds(&self, [low, high]: [[f32; 3]; 2]) -> [[u16; 3]; 2] {
        [self.quantized(low), self.quantized(high)]
    }
}

pub(super) fn write_normals(normals: &[[f32; 3]], out: &mut impl Write) -> Result<()> {
    let to_bytes = |normal: [f32; 3]| {
        #[expect(clippy::cast_possible_truncation, reason = "clamped to the range")]
        let [x, y, z] = normal.map(|c| (c * 127.0).round_ties_even().clamp(-127.0, 127.0) as i8);
        [x, y, z, 0].map(|c| c.to_le_bytes()[0])
    };
    write_pieces(normals, to_bytes, out)
}

/// The positions that a reader gets for a quantized mesh, relative to the mesh's origin.
pub fn quantized_positions(positions: &[[f32; 3]]) -> Vec<[f32; 3]> {
    let cube = Cube::around(positions);
    let read = |&position: &[f32; 3]| {
        let steps = cube.quantized(position);
        std::array::from_fn(|axis| {
            let part = f64::from(steps[axis]) / STEPS;
            #[expect(
                clippy::cast_possible_truncation,
                reason = "unquantized positions have the same precision"
            )]
            let position = (f64::from(cube.low[axis]) + f64::from(cube.size) * part) as f32;
            position
        })
    };
    positions.iter().map(read).collect()
}

/// The largest quantization error of a position along an axis, in world units.
pub fn quantization_error(positions: &[[f32; 3]]) -> f64 {
    f64::from(Cube::around(positions).size) / STEPS / 2.0
}
