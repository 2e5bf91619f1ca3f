//! Measures how widely a frame's particles are spread, from the leaves that contain them.
//!
//! ```text
//!   ┌──┬──┬──┐                                   ┌──┐
//!   │ 9│50│30│                                   │ 1│      half of the particles are within one or two leaves
//!   └──┴──┴──┘                                   └──┘      of their median, however far away the last one is
//! ```

use glam::IVec3;

/// Median distance of the particles from their median position, in voxels, where the distance is the
/// maximum over the axes. `leaves` yields leaf origins with their particle counts. Returns 0, without
/// sorting, for a frame at most `unseen_voxels` wide; most frames are that narrow.
pub(super) fn spread<L: Iterator<Item = (IVec3, usize)>>(leaves: impl Fn() -> L, unseen_voxels: i32) -> u32 {
    let bounds = leaves().map(|(origin, _)| (origin, origin));
    let Some((low, high)) = bounds.reduce(|(low, high), (one, _)| (low.min(one), high.max(one))) else {
        return 0;
    };
    // The difference of two indices of the grid fits into 32 bits.
    if (high - low).max_element() <= unseen_voxels {
        return 0;
    }
    let along = |axis: usize| middle(leaves().map(|(origin, count)| (origin[axis], count)));
    let center = IVec3::new(along(0), along(1), along(2));
    middle(leaves().map(|(origin, count)| ((origin - center).abs().max_element(), count))).unsigned_abs()
}

/// Weighted median: half of the total count is at or below this value.
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
    fn spread_is_the_median_distance_from_the_median() {
        let spread_of = |leaves: &[(i32, usize)]| {
            spread(|| leaves.iter().map(|&(x, count)| (IVec3::new(x, 8, -x), count)), 1000)
        };
        assert_eq!(spread_of(&[]), 0);
        assert_eq!(spread_of(&[(0, 1), (1000, 1)]), 0, "two particles");
        assert_eq!(spread_of(&[(0, 9), (8, 50), (16, 30), (FAR, 1)]), 0, "one stray particle");
        assert_eq!(spread_of(&[(0, 40), (8, 50), (-FAR, 30), (FAR, 40)]), 8);
        assert_eq!(spread_of(&[(-80_000, 3), (-40_000, 3), (0, 1), (40_000, 3), (80_000, 3)]), 40_000);
    }
}
