//! Finds outliers: particles so far away that 32-bit positions cannot represent a surface around them.
//!
//! ```text
//!   ┌──┬──┬──┐                                              ┌──┐
//!   │ 9│50│30│  ◀────────── more than 2²⁰ voxels ─────────▶  │ 1│     dropped: few, and far from all others
//!   └──┴──┴──┘                                              └──┘
//! ```
//!
//! At that distance from the mesh's origin, 32-bit positions are off by 1/16 voxel or more. For the same
//! reason, the spread of a frame has the same limit (`reconstruction::SPREAD_MAX_VOXELS`). If more than a few
//! particles are that far away, the frame really is that wide and all particles are kept. The result depends
//! only on the number of particles in each leaf.

use glam::IVec3;

use super::spread::middle;

/// Leaves farther than this from the median of the particles along an axis, in voxels, are too far away.
pub(super) const FARTHEST_VOXELS: i32 = 1 << 20;

/// Up to 8 particles or 1 % of all count as few, and always fewer than half.
const FEW: usize = 8;
const FEW_ONE_IN: usize = 100;

/// Origins of the leaves whose particles are dropped, sorted. `leaves` yields leaf origins with their
/// particle counts.
pub(super) fn outlier_leaves<L: Iterator<Item = (IVec3, usize)>>(leaves: impl Fn() -> L) -> Vec<IVec3> {
    let bounds = leaves().map(|(origin, _)| (origin, origin));
    let bounds = bounds.reduce(|(low, high), (one, other)| (low.min(one), high.max(other)));
    // The difference of two indices of the grid fits into 32 bits.
    let is_wide = bounds.is_some_and(|(low, high)| (high - low).max_element() > FARTHEST_VOXELS);
    if !is_wide {
        return Vec::new();
    }
    let along = |axis: usize| middle(leaves().map(|(origin, count)| (origin[axis], count)));
    let center = IVec3::new(along(0), along(1), along(2));
    let is_far = |(origin, _): &(IVec3, usize)| (*origin - center).abs().max_element() > FARTHEST_VOXELS;
    let far: Vec<(IVec3, usize)> = leaves().filter(is_far).collect();
    let far_count: usize = far.iter().map(|(_, count)| count).sum();
    let all_count: usize = leaves().map(|(_, count)| count).sum();
    if far_count > FEW.max(all_count / FEW_ONE_IN) || 2 * far_count >= all_count {
        return Vec::new();
    }
    let mut far: Vec<IVec3> = far.into_iter().map(|(origin, _)| origin).collect();
    far.sort_unstable_by_key(|origin| origin.to_array());
    far
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_a_few_particles_far_from_the_rest_are_outliers() {
        let outliers_of = |leaves: &[(i32, usize)]| -> Vec<i32> {
            let found = outlier_leaves(|| leaves.iter().map(|&(x, count)| (IVec3::new(8, x, 0), count)));
            found.into_iter().map(|origin| origin.y).collect()
        };
        let far = 2 * FARTHEST_VOXELS;
        assert_eq!(outliers_of(&[]), [0; 0]);
        assert_eq!(outliers_of(&[(0, 9), (far, 1), (8, 3)]), [far]);
        assert_eq!(outliers_of(&[(0, 900), (far, 8), (-far, 1)]), [-far, far]);
        assert_eq!(outliers_of(&[(0, 800), (far, 8), (-far, 1)]), [0; 0], "more than a few");
        assert_eq!(outliers_of(&[(0, 1), (far, 1)]), [0; 0], "half of the particles");
        assert_eq!(outliers_of(&[(0, 600), (far, 400)]), [0; 0], "two large clusters");
        assert_eq!(outliers_of(&[(0, 900), (FARTHEST_VOXELS, 1)]), [0; 0], "at the limit");
    }
}
