//! Which voxels of a leaf are inside, with few winding numbers.
//!
//! ```text
//!    a ●───────────● b       the balls around a and b that reach the nearest triangle cover the line between
//!     ( d(a) )( d(b)  )      them: no triangle is in the way, and b is on the side of a
//! ```
//!
//! Around a closed surface that is all: the winding number is whole, and constant where no triangle is. Near
//! the rim of a hole it changes gradually, by no more than `slope` a voxel. So each voxel that is reached carries
//! how far the winding number is from ½, at least; where that is no more than `slope` times its distance, the patch
//! over the hole may be nearer than any triangle, and it is asked itself:
//!
//! ```text
//!   distance to the patch ≈ |w − ½| / |∇w|
//! ```

use crate::surface::grid::{LEAF_EDGE, LEAF_VOXELS, Leaf, voxel_in_leaf};
use glam::IVec3;

use super::winding::WINDING_ERROR;

/// What can be asked of a surface at a voxel of the leaf.
pub(super) trait Winds {
    /// The winding number.
    fn winding(&self, voxel: IVec3) -> f64;

    /// How fast it changes, a voxel.
    fn slope(&self, voxel: IVec3) -> f64;
}

/// Gives distances their signs, negative inside. `slope` bounds that of the winding number in the leaf.
pub(super) fn sign(distances: &mut Leaf, surface: &impl Winds, slope: f64) {
    let mut reached = Reached { distances, margins: [None; LEAF_VOXELS], slope, pending: Vec::new() };
    for offset in 0..LEAF_VOXELS {
        if reached.margins[offset].is_none() && !reached.reach_from_afar(offset) {
            reached.ask(surface, offset);
        }
        reached.spread();
    }
}

/// Steps to voxels that may be asked in place of those beside: the more directions, the nearer to one of them is
/// the way straight off the surface.
const FAR_STEPS: [[i32; 3]; 6] = [[1, 1, 0], [1, 0, 1], [0, 1, 1], [1, 1, 1], [2, 1, 0], [2, 1, 1]];

/// The steps through the faces, and what they add to a place in the leaf.
const STEPS: [(IVec3, isize); 6] = [
    (IVec3::NEG_X, -64),
    (IVec3::X, 64),
    (IVec3::NEG_Y, -8),
    (IVec3::Y, 8),
    (IVec3::NEG_Z, -1),
    (IVec3::Z, 1),
];

struct Reached<'a> {
    /// With the sign of those that were reached.
    distances: &'a mut Leaf,
    /// How far the winding number is from ½ at least; none where it is not known.
    margins: [Option<f64>; LEAF_VOXELS],
    slope: f64,
    pending: Vec<usize>,
}

impl Reached<'_> {
    /// Asks the surface itself.
    fn ask(&mut self, surface: &impl Winds, offset: usize) {
        let voxel = voxel_in_leaf(offset);
        let beyond = surface.winding(voxel) - 0.5;
        let margin = beyond.abs() - WINDING_ERROR;
        let distance = &mut self.distances.values[offset];
        if self.slope > 0.0 && margin < self.slope * f64::from(*distance) {
            let patch = (beyond.abs() / surface.slope(voxel)) as f32;
            // What is not a number is no patch.
            *distance = distance.min(patch);
        }
        if beyond > 0.0 {
            *distance = -*distance;
        }
        self.margins[offset] = Some(margin);
        self.pending.push(offset);
    }

    /// Takes the side of a voxel that is not beside this one, if one can be seen from it.
    fn reach_from_afar(&mut self, offset: usize) -> bool {
        let voxel = voxel_in_leaf(offset);
        for step in FAR_STEPS {
            for [x, y, z] in [step, [step[1], step[2], step[0]], [step[2], step[0], step[1]]] {
                for sign in 0..8 {
                    let signed = |c: i32, bit: i32| if sign >> bit & 1 == 1 { -c } else { c };
                    let from = voxel + IVec3::new(signed(x, 0), signed(y, 1), signed(z, 2));
                    let is_inside = from.min_element() >= 0 && from.max_element() < LEAF_EDGE;
                    if is_inside
                        && self.reach(
                            crate::surface::grid::offset_in_leaf(from),
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

    /// Gives one voxel the side of another, where that is certain.
    fn reach(&mut self, from: usize, to: usize, step_squared: i32) -> bool {
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

    /// Goes on from the voxels that were reached, through faces.
    fn spread(&mut self) {
        while let Some(from) = self.pending.pop() {
            let voxel = voxel_in_leaf(from);
            for (step, places) in STEPS {
                let next = voxel + step;
                if next.min_element() < 0 || next.max_element() >= LEAF_EDGE {
                    continue;
                }
                let to = from.wrapping_add_signed(places);
                if self.margins[to].is_none() {
                    self.reach(from, to, 1);
                }
            }
        }
    }
}

/// What rounding may make of distances.
const ROUNDING: f32 = 1e-4;
