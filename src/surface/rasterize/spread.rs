//! How widely the particles of a frame are spread, by the leaves that hold them.
//!
//! ```text
//!   ┌──┬──┬──┐                                   ┌──┐
//!   │ 9│50│30│                                   │ 1│      half of them are within a leaf or two of their middle,
//!   └──┴──┴──┘                                   └──┘      wherever the last one is
//! ```

use glam::IVec3;

/// How far half of the particles, and no fewer, are from their middle along an axis, in voxels. `leaves` are origins of
/// leaves, and how many particles each holds. All of a frame that is no wider than `unseen_voxels` is at its middle: most
/// frames are, and are not sorted.
pub(super) fn spread<L: Iterator<Item = (IVec3, usize)>>(leaves: impl Fn() -> L, unseen_voxels: i32) -> u32 {
    let bounds = leaves().map(|(origin, _)| (origin, origin));
    let Some((low, high)) = bounds.reduce(|(low, high), (one, _)| (low.min(one), high.max(one))) else {
        return 0;
    };
    // Twice an index has a place in 32 bits.
    if (high - low).max_element() <= unseen_voxels {
        return 0;
    }
    let along = |axis: usize| middle(leaves().map(|(origin, count)| (origin[axis], count)));
    let center = IVec3::new(along(0), along(1), along(2));
    middle(leaves().map(|(origin, count)| ((origin - center).abs().max_element(), count))).unsigned_abs()
}

/// The value that half of the counts are at or below.
pub(super) fn middle(values: impl Iterator<Item = (i32, usize)>) -> i32 {
    let mut values: Vec<(i32, usize)> = values.collect();
    values.sort_unstable();
    let half = values.iter().map(|&(_, count)| count).sum::<usize>().div_ceil(2);
    let mut passed = 0;
    let reaches_half = |&(value, count): &(i32, usize)| {
        passed += count;
        (passed >= half).then_some(value)
    };
    values.iter().find_map(reaches_half).unwrap_or(0)
}

#[cfg(test)]
mod tests {
    use super::*;

    const FAR: i32 = (1 << 30) - 8;

    #[test]
    fn half_of_the_particles_say_how_wide_a_frame_is() {
        let spread_of = |leaves: &[(i32, usize)]| {
            spread(|| leaves.iter().map(|&(x, count)| (IVec3::new(x, 8, -x), count)), 1000)
        };
        assert_eq!(spread_of(&[]), 0);
        assert_eq!(spread_of(&[(0, 1), (1000, 1)]), 0, "nothing that matters");
        assert_eq!(spread_of(&[(0, 9), (8, 50), (16, 30), (FAR, 1)]), 0, "one that is astray");
        assert_eq!(spread_of(&[(0, 40), (8, 50), (-FAR, 30), (FAR, 40)]), 8);
        assert_eq!(spread_of(&[(-80_000, 3), (-40_000, 3), (0, 1), (40_000, 3), (80_000, 3)]), 40_000);
    }
}
