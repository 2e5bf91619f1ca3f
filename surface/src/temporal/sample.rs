//! Samples a level set between its voxels.

use glam::{IVec3, Vec3};

use crate::grid::{LEAF_EDGE, NO_LEAF, neighbor_slot, offset_in_leaf};
use crate::level_set::NarrowBand;

/// Samples a level set by the tricubic Catmull-Rom spline, which reproduces quadratic functions, and passes through
/// the values at the voxels. A linear one would move curved surfaces inward.
pub(super) struct Sampler<'a> {
    band: &'a NarrowBand,
    /// The last leaves, by whether their numbers along each axis are even: where the voxels of a leaf are carried,
    /// they rarely meet two of the same kind.
    last: [Around; 8],
}

/// A leaf with those around it.
#[derive(Clone, Copy)]
struct Around {
    origin: Option<IVec3>,
    leaves: [u32; 27],
}

impl<'a> Sampler<'a> {
    pub(super) fn new(band: &'a NarrowBand) -> Sampler<'a> {
        Sampler { band, last: [Around { origin: None, leaves: [NO_LEAF; 27] }; 8] }
    }

    /// The value at `voxel + step`, in voxels; `None` where no values are stored.
    pub(super) fn sample(&mut self, voxel: IVec3, step: Vec3) -> Option<f32> {
        let whole = step.floor();
        let base = voxel.checked_add(whole.as_ivec3())?;
        let local = base & IVec3::splat(LEAF_EDGE - 1);
        let origin = base - local;
        let parity: IVec3 = (base >> 3i32) & IVec3::ONE;
        let around = &mut self.last[(4 * parity.x + 2 * parity.y + parity.z) as usize];
        if around.origin != Some(origin) {
            let leaf = self.band.topology.find(origin);
            let leaves = leaf.map_or([NO_LEAF; 27], |leaf| self.band.topology.neighborhood(leaf));
            *around = Around { origin: Some(origin), leaves };
        }
        let around = &around.leaves;
        let leaf = around[neighbor_slot(IVec3::ZERO)];
        if leaf == NO_LEAF {
            return None;
        }
        let leaves = &self.band.phi.leaves;
        // Beyond the stored leaves, values are those of the band's edge.
        let beyond = self.band.half_width.copysign(leaves[leaf as usize].values[offset_in_leaf(local)]);
        let [wx, wy, wz] = (step - whole).to_array().map(weights);
        let [xs, ys, zs] = local.to_array().map(taps);
        // The four voxels along z are summed side by side, and joined at the end.
        let is_in_one_leaf = zs[0].slot == zs[3].slot;
        let mut sums = [0.0; 4];
        for (x, wx) in xs.into_iter().zip(wx) {
            for (y, wy) in ys.into_iter().zip(wy) {
                let (slots, row) = (9 * x.slot + 3 * y.slot, 64 * x.local + 8 * y.local);
                let value = |z: Tap| match around[slots + z.slot] {
                    NO_LEAF => beyond,
                    leaf => leaves[leaf as usize].values[row + z.local],
                };
                let values = match around[slots + zs[0].slot] {
                    leaf if is_in_one_leaf && leaf != NO_LEAF => {
                        let first = row + zs[0].local;
                        let values = &leaves[leaf as usize].values[first..first + 4];
                        std::array::from_fn(|tap| values[tap])
                    }
                    _ => zs.map(value),
                };
                for (sum, value) in sums.iter_mut().zip(values) {
                    *sum += wx * wy * value;
                }
            }
        }
        let sum = sums.iter().zip(wz).map(|(sum, wz)| sum * wz).sum();
        Some(sum)
    }
}

/// Where a voxel is along an axis: its leaf among the three around a leaf, 0 to 2, and its place in it.
#[derive(Clone, Copy)]
struct Tap {
    slot: usize,
    local: usize,
}

/// The voxels −1 to 2 along an axis, counted from a place in a leaf.
fn taps(local: i32) -> [Tap; 4] {
    std::array::from_fn(|tap| {
        let at = (local + LEAF_EDGE - 1) as usize + tap;
        Tap { slot: at / LEAF_EDGE as usize, local: at % LEAF_EDGE as usize }
    })
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
