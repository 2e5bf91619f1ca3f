//! Particles that have flown so far that 32-bit positions cannot hold a surface around them.
//!
//! ```text
//!   ┌──┬──┬──┐                                              ┌──┐
//!   │ 9│50│30│  ◀────────── more than 2²⁰ voxels ─────────▶  │ 1│     left out: a few, and far from all the rest
//!   └──┴──┴──┘                                              └──┘
//! ```
//!
//! At that distance from the mesh's origin positions are off by a sixteenth of a voxel and more: as far as a frame may be
//! spread (`skin::SPREAD_MAX_VOXELS`). Where more than a few particles are so far away the frame is that wide, and
//! all of it is kept. What is left out depends on which leaves hold how many particles, and on nothing else.

use glam::IVec3;

use super::spread::middle;

/// A leaf farther than this from the middle of the particles, along an axis, in voxels, is too far away.
pub(super) const FARTHEST_VOXELS: i32 = 1 << 20;

/// A few are at most so many particles, or one in so many of all; and always fewer than half.
const FEW: usize = 8;
const FEW_ONE_IN: usize = 100;

/// The origins of the leaves whose particles are left out, in order. `leaves` are origins of leaves, and how many particles each
/// holds.
pub(super) fn strayed<L: Iterator<Item = (IVec3, usize)>>(leaves: impl Fn() -> L) -> Vec<IVec3> {
    let bounds = leaves().map(|(origin, _)| (origin, origin));
    let bounds = bounds.reduce(|(low, high), (one, other)| (low.min(one), high.max(other)));
    // Twice an index has a place in 32 bits.
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
    fn a_few_particles_far_from_the_rest_stray_and_half_a_frame_does_not() {
        let strayed_of = |leaves: &[(i32, usize)]| -> Vec<i32> {
            let found = strayed(|| leaves.iter().map(|&(x, count)| (IVec3::new(8, x, 0), count)));
            found.into_iter().map(|origin| origin.y).collect()
        };
        let far = 2 * FARTHEST_VOXELS;
        assert_eq!(strayed_of(&[]), [0; 0]);
        assert_eq!(strayed_of(&[(0, 9), (far, 1), (8, 3)]), [far]);
        assert_eq!(strayed_of(&[(0, 900), (far, 8), (-far, 1)]), [-far, far]);
        assert_eq!(strayed_of(&[(0, 800), (far, 8), (-far, 1)]), [0; 0], "more than a few");
        assert_eq!(strayed_of(&[(0, 1), (far, 1)]), [0; 0], "half of them");
        assert_eq!(strayed_of(&[(0, 600), (far, 400)]), [0; 0], "a frame of two parts");
        assert_eq!(strayed_of(&[(0, 900), (FARTHEST_VOXELS, 1)]), [0; 0], "near enough");
    }
}
