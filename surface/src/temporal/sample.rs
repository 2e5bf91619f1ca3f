//! Samples a level set between its voxels.

use glam::{IVec3, Vec3};

use crate::grid::{LEAF_EDGE, NO_LEAF, neighbor_slot, offset_in_leaf};
use crate::level_set::NarrowBand;

/// Samples a level set by the tricubic Catmull-Rom spline, which reproduces quadratic functions, and passes through
/// the values at the voxels. A linear one would move curved surfaces inward.
pub(super) struct Sampler<'a> {
    band: &'a NarrowBand,
    /// The last leaf: its origin, and the leaves around it.
    origin: Option<IVec3>,
    around: [u32; 27],
}

impl<'a> Sampler<'a> {
    pub(super) fn new(band: &'a NarrowBand) -> Sampler<'a> {
        Sampler { band, origin: None, around: [NO_LEAF; 27] }
    }

    /// The value at `voxel + step`, in voxels; `None` where no values are stored.
    pub(super) fn sample(&mut self, voxel: IVec3, step: Vec3) -> Option<f32> {
        let whole = step.floor();
        let base = voxel.checked_add(whole.as_ivec3())?;
        let local = base & IVec3::splat(LEAF_EDGE - 1);
        let origin = base - local;
        if self.origin != Some(origin) {
            self.origin = Some(origin);
            self.around = match self.band.topology.find(origin) {
                Some(leaf) => self.band.topology.neighborhood(leaf),
                None => [NO_LEAF; 27],
            };
        }
        let leaf = self.around[neighbor_slot(IVec3::ZERO)];
        if leaf == NO_LEAF {
            return None;
        }
        let leaves = &self.band.phi.leaves;
        // Beyond the stored leaves, values are those of the band's edge.
        let beyond = self.band.half_width.copysign(leaves[leaf as usize].values[offset_in_leaf(local)]);
        let [wx, wy, wz] = (step - whole).to_array().map(weights);
        let mut sum = 0.0;
        for (dx, wx) in (-1..).zip(wx) {
            for (dy, wy) in (-1..).zip(wy) {
                let mut row = 0.0;
                for (dz, wz) in (-1..).zip(wz) {
                    let at = local + IVec3::new(dx, dy, dz);
                    let value = match self.around[neighbor_slot(at >> 3)] {
                        NO_LEAF => beyond,
                        leaf => {
                            leaves[leaf as usize].values[offset_in_leaf(at & IVec3::splat(LEAF_EDGE - 1))]
                        }
                    };
                    row += wz * value;
                }
                sum += wx * wy * row;
            }
        }
        Some(sum)
    }
}

/// The weights of the four voxels around a fraction from 0 to 1.
fn weights(t: f32) -> [f32; 4] {
    let (t2, t3) = (t * t, t * t * t);
    [
        0.5 * (-t + 2.0 * t2 - t3),
        0.5 * (2.0 - 5.0 * t2 + 3.0 * t3),
        0.5 * (t + 4.0 * t2 - 3.0 * t3),
        0.5 * (t3 - t2),
    ]
}
