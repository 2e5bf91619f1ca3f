//! Decides which voxels of a leaf are inside, with few evaluations of the winding number.
//!
//! ```text
//!    a ●───────────● b       d: distance to the nearest triangle. If the balls of radius d around a and b
//!     ( d(a) )( d(b)  )      cover the line between them, no triangle crosses it: b is on the side of a
//! ```
//!
//! For a closed surface, this suffices: the winding number w is an integer, and constant between triangles.
//! Near the boundary of a hole, w changes gradually, by at most `slope` per voxel. Therefore a lower bound of
//! |w − ½| is kept for each classified voxel. If this bound is at most `slope` times the voxel's distance to
//! the triangles, the patch over the hole (w = ½) may be closer than any triangle. Then w is evaluated at the
//! voxel:
//!
//! ```text
//!   distance to the patch ≈ |w − ½| / |∇w|
//! ```

use crate::grid::{LEAF_EDGE, LEAF_VOXELS, Leaf, voxel_in_leaf};
use glam::IVec3;

use super::winding::WINDING_ERROR;

/// The winding number at the voxels of a leaf.
pub(super) trait WindingField {
    /// The winding number.
    fn winding(&self, voxel: IVec3) -> f64;

    /// The magnitude of the winding number's gradient, per voxel.
    fn slope(&self, voxel: IVec3) -> f64;
}

/// Gives distances their signs, negative inside. `slope` bounds the change of the winding number in the leaf.
pub(super) fn sign(distances: &mut Leaf, surface: &impl WindingField, slope: f64) {
    let mut reached = Classification { distances, margins: [None; LEAF_VOXELS], slope, pending: Vec::new() };
    for offset in 0..LEAF_VOXELS {
        if reached.margins[offset].is_none() && !reached.classify_distant(offset) {
            reached.evaluate(surface, offset);
        }
        reached.spread();
    }
}

/// Steps to voxels that can replace direct neighbours. With more directions, one of the steps is closer to
/// the normal of the surface.
const FAR_STEPS: [[i32; 3]; 6] = [[1, 1, 0], [1, 0, 1], [0, 1, 1], [1, 1, 1], [2, 1, 0], [2, 1, 1]];

/// The steps through the faces, and the index offset of each.
const STEPS: [(IVec3, isize); 6] = [
    (IVec3::NEG_X, -64),
    (IVec3::X, 64),
    (IVec3::NEG_Y, -8),
    (IVec3::Y, 8),
    (IVec3::NEG_Z, -1),
    (IVec3::Z, 1),
];

struct Classification<'a> {
    /// Signed at the voxels that are classified.
    distances: &'a mut Leaf,
    /// Lower bounds of |w − ½|; `None` if the voxel is not classified.
    margins: [Option<f64>; LEAF_VOXELS],
    slope: f64,
    pending: Vec<usize>,
}

impl Classification<'_> {
    /// Evaluates the winding number at a voxel.
    fn evaluate(&mut self, surface: &impl WindingField, offset: usize) {
        let voxel = voxel_in_leaf(offset);
        let beyond = surface.winding(voxel) - 0.5;
        let margin = beyond.abs() - WINDING_ERROR;
        let distance = &mut self.distances.values[offset];
        if self.slope > 0.0 && margin < self.slope * f64::from(*distance) {
            let patch = (beyond.abs() / surface.slope(voxel)) as f32;
            // `min` ignores a patch distance that is NaN.
            *distance = distance.min(patch);
        }
        if beyond > 0.0 {
            *distance = -*distance;
        }
        self.margins[offset] = Some(margin);
        self.pending.push(offset);
    }

    /// Gives a voxel the side of one that is not a direct neighbour, if nothing lies between them.
    fn classify_distant(&mut self, offset: usize) -> bool {
        let voxel = voxel_in_leaf(offset);
        for step in FAR_STEPS {
            for [x, y, z] in [step, [step[1], step[2], step[0]], [step[2], step[0], step[1]]] {
                for sign in 0..8 {
                    let signed = |c: i32, bit: i32| if sign >> bit & 1 == 1 { -c } else { c };
                    let from = voxel + IVec3::new(signed(x, 0), signed(y, 1), signed(z, 2));
                    let is_inside = from.min_element() >= 0 && from.max_element() < LEAF_EDGE;
                    if is_inside
                        && self.classify_from(
                            crate::grid::offset_in_leaf(from),
                            offset,
                            (from - voxel).length_squared(),
                        )
                    {
                        return true;
                    }
                }
            }
        }
        false
    }

    /// Gives one voxel the side of another, if no triangle crosses the line between them and no patch over a
    /// hole is closer than the triangles.
    fn classify_from(&mut self, from: usize, to: usize, step_squared: i32) -> bool {
        let Some(margin) = self.margins[from] else { return false };
        let step = (step_squared as f32).sqrt();
        let (near, far) = (self.distances.values[from], self.distances.values[to]);
        if near.abs() + far <= step + ROUNDING {
            return false;
        }
        let margin = margin - self.slope * f64::from(step);
        let is_sure = margin > self.slope * f64::from(far);
        if self.slope > 0.0 && !is_sure {
            return false;
        }
        self.distances.values[to] = far.copysign(near);
        self.margins[to] = Some(margin);
        self.pending.push(to);
        true
    }

    /// Continues from the classified voxels to their face neighbours.
    fn spread(&mut self) {
        while let Some(from) = self.pending.pop() {
            let voxel = voxel_in_leaf(from);
            for (step, offset_step) in STEPS {
                let next = voxel + step;
                if next.min_element() < 0 || next.max_element() >= LEAF_EDGE {
                    continue;
                }
                let to = from.wrapping_add_signed(offset_step);
                if self.margins[to].is_none() {
                    self.classify_from(from, to, 1);
                }
            }
        }
    }
}

/// More than the rounding error of distances.
const ROUNDING: f32 = 1e-4;
