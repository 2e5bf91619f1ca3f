//! Samples a level set between its voxels.

use glam::{IVec3, Vec3};

use super::NarrowBand;
use crate::grid::{LEAF_EDGE, NO_LEAF, neighbor_slot, offset_in_leaf};

/// Samples a level set by the tricubic Catmull-Rom spline, which reproduces quadratic functions, and passes through
/// the values at the voxels. A linear one would move curved surfaces inward.
pub struct Sampler<'a> {
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
    /// A sampler of this level set.
    #[inline(always)]
    pub fn new(band: &'a NarrowBand) -> Sampler<'a> {
        Sampler { band, last: [Around { origin: None, leaves: [NO_LEAF; 27] }; 8] }
    }

    /// The value at `voxel + step`, in voxels; `None` where no values are stored.
    #[inline(always)]
    pub fn sample(&mut self, voxel: IVec3, step: Vec3) -> Option<f32> {
        // The four voxels along z are summed side by side, and joined at the end.
        let mut sums = [0.0; 4];
        let fraction = self.rows(voxel, step, |[x, y], values| add(&mut sums, x[0] * y[0], values))?;
        Some(dot(sums, spline_weights(fraction.z)))
    }

    /// The value at `voxel + step`, and the gradient there, trilinear between the central differences at the voxels;
    /// `None` where no values are stored. The gradient of the spline would have ripples: it is steep between two
    /// voxels, and depends little on those around them.
    #[inline(always)]
    pub fn sample_with_gradient(&mut self, voxel: IVec3, step: Vec3) -> Option<(f32, Vec3)> {
        let [mut sums, mut along_x, mut along_y, mut along_z] = [[0.0; 4]; 4];
        let fraction = self.rows(voxel, step, |[x, y], values| {
            add(&mut sums, x[0] * y[0], values);
            add(&mut along_x, x[2] * y[1], values);
            add(&mut along_y, x[1] * y[2], values);
            add(&mut along_z, x[1] * y[1], values);
        })?;
        let [spline, linear, slopes] = all_weights(fraction.z);
        let gradient = Vec3::new(dot(along_x, linear), dot(along_y, linear), dot(along_z, slopes));
        Some((dot(sums, spline), gradient))
    }

    /// Visits the 16 rows of four voxels along z around `voxel + step`: its [weights](all_weights) along x and y, and
    /// its values. Returns where the point is between the voxels; `None` where no values are stored.
    #[inline(always)]
    fn rows(
        &mut self,
        voxel: IVec3,
        step: Vec3,
        mut visit: impl FnMut([[f32; 3]; 2], [f32; 4]),
    ) -> Option<Vec3> {
        let whole = step.floor();
        let base = voxel.checked_add(whole.as_ivec3())?;
        let local = base & IVec3::splat(LEAF_EDGE - 1);
        let band = self.band;
        let around = self.around(base, base - local);
        let leaf = around[neighbor_slot(IVec3::ZERO)];
        if leaf == NO_LEAF {
            return None;
        }
        let leaves = &band.phi.leaves;
        // Beyond the stored leaves, values are those of the band's edge.
        let beyond = band.half_width.copysign(leaves[leaf as usize].values[offset_in_leaf(local)]);
        let fraction = step - whole;
        let weighted = |t: f32| {
            let weights = all_weights(t);
            std::array::from_fn::<_, 4, _>(|tap| weights.map(|weights| weights[tap]))
        };
        let [xs, ys, zs] = local.to_array().map(taps);
        let is_in_one_leaf = zs[0].slot == zs[3].slot;
        for (x, wx) in xs.into_iter().zip(weighted(fraction.x)) {
            for (y, wy) in ys.into_iter().zip(weighted(fraction.y)) {
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
                visit([wx, wy], values);
            }
        }
        Some(fraction)
    }

    /// The leaf at this origin, which has the voxel `base`, and those around it.
    fn around(&mut self, base: IVec3, origin: IVec3) -> &[u32; 27] {
        let parity: IVec3 = (base >> 3i32) & IVec3::ONE;
        let around = &mut self.last[(4 * parity.x + 2 * parity.y + parity.z) as usize];
        if around.origin != Some(origin) {
            let leaf = self.band.topology.find(origin);
            let leaves = leaf.map_or([NO_LEAF; 27], |leaf| self.band.topology.neighborhood(leaf));
            *around = Around { origin: Some(origin), leaves };
        }
        &around.leaves
    }
}

#[inline(always)]
fn add(sums: &mut [f32; 4], weight: f32, values: [f32; 4]) {
    for (sum, value) in sums.iter_mut().zip(values) {
        *sum += weight * value;
    }
}

#[inline(always)]
fn dot(sums: [f32; 4], weights: [f32; 4]) -> f32 {
    sums.iter().zip(weights).map(|(sum, weight)| sum * weight).sum()
}

/// Where a voxel is along an axis: its leaf among the three around a leaf, 0 to 2, and its place in it.
#[derive(Clone, Copy)]
struct Tap {
    slot: usize,
    local: usize,
}

/// The voxels −1 to 2 along an axis, counted from a place in a leaf.
#[inline(always)]
fn taps(local: i32) -> [Tap; 4] {
    std::array::from_fn(|tap| {
        let at = (local + LEAF_EDGE - 1) as usize + tap;
        Tap { slot: at / LEAF_EDGE as usize, local: at % LEAF_EDGE as usize }
    })
}

/// The weights of the Catmull-Rom spline for the four voxels along an axis, two on each side of a point at `t`, from 0 to 1,
/// between the two in the middle.
#[inline(always)]
pub fn spline_weights(t: f32) -> [f32; 4] {
    let (t2, t3) = (t * t, t * t * t);
    [
        0.5 * (-t + 2.0 * t2 - t3),
        0.5 * (2.0 - 5.0 * t2 + 3.0 * t3),
        0.5 * (t + 4.0 * t2 - 3.0 * t3),
        0.5 * (t3 - t2),
    ]
}

/// The weights of the spline, those of the line between the two voxels in the middle, and those of the central
/// differences at these two.
#[inline(always)]
fn all_weights(t: f32) -> [[f32; 4]; 3] {
    let (from, to) = (0.5 * (1.0 - t), 0.5 * t);
    [spline_weights(t), [0.0, 1.0 - t, t, 0.0], [-from, -to, from, to]]
}
