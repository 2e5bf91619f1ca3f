//! Computes how much around a window is needed to make its results identical to those of the whole frame.
//!
//! ```text
//!   own        the window's leaves: φ_0, the bounds, which leaves are stored
//!   banded     φ_0, which leaves are stored; the bounds are swept on these    ⎫ each: 2 voxels per sweep,
//!   swept      distances; φ_0 is swept on these                               ⎭ plus 1 for their start
//!   crossed    surface crossings: leaves within the margin of one are stored    the band's margin
//!   measured   distances: where a crossing is depends on neighbors              1 voxel
//!   populated  particles                                                        reach of distances
//! ```
//!
//! Read bottom-up, the lines are the steps of rasterization. Read top-down, each line depends on the next
//! one, whose region is wider by the amount on the right of that next line. Leaves count as a whole, since a
//! leaf is stored if any of its voxels is. A smaller region cannot be proved sufficient: a sweep reads values
//! two voxels away along an axis, and each sweep reads those of the previous one. Sweeps start from the
//! voxels whose distance is known, and whether it is known depends on the face neighbours: hence the 1.

use glam::IVec3;

use super::{Radii, sweep_count};
use crate::grid::LEAF_EDGE;
use crate::space::CoordBox;

/// Larger than the grid's index range, and small enough that adding margins does not overflow.
const EVERYWHERE: CoordBox = CoordBox { min: IVec3::splat(-3 << 29), max: IVec3::splat(3 << 29) };

/// The boxes of leaves that a window's results depend on, each inside the next.
#[derive(Clone, Copy, Debug)]
pub(super) struct Regions {
    pub(super) own: CoordBox,
    pub(super) banded: CoordBox,
    pub(super) swept: CoordBox,
    pub(super) crossed: CoordBox,
    pub(super) measured: CoordBox,
    pub(super) populated: CoordBox,
}

impl Regions {
    /// The regions for the leaves that a window touches. `longest` bounds the semi-axes of all particles, in
    /// units of the radii.
    pub(super) fn new(window: CoordBox, radii: Radii, longest: f32) -> Regions {
        let swept_voxels = 2 * sweep_count(radii.half_width()) as i32 + 1;
        let window = CoordBox { min: window.min.max(EVERYWHERE.min), max: window.max.min(EVERYWHERE.max) };
        let own = leaves_around(window, 0);
        let banded = leaves_around(own, swept_voxels);
        let swept = leaves_around(banded, swept_voxels);
        let crossed = leaves_around(swept, radii.band_margin());
        let measured = leaves_around(crossed, 1);
        // Rounding can put a particle on the upper boundary of its cell, so the index of its voxel may be too
        // small by one.
        let populated = leaves_around(measured, radii.exact_reach(longest).ceil() as i32 + 1);
        Regions { own, banded, swept, crossed, measured, populated }
    }
}

/// The box of the leaves within `margin` voxels of a box.
fn leaves_around(voxels: CoordBox, margin: i32) -> CoordBox {
    let (expanded, edge) = (voxels.expanded(margin), IVec3::splat(LEAF_EDGE));
    CoordBox {
        min: expanded.min.div_euclid(edge) * LEAF_EDGE,
        max: expanded.max.div_euclid(edge) * LEAF_EDGE + (LEAF_EDGE - 1),
    }
}

/// True if two boxes share a voxel.
pub(super) fn meet(one: &CoordBox, other: &CoordBox) -> bool {
    one.min.cmple(other.max).all() && other.min.cmple(one.max).all()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_leaf_window_needs_these_rings_of_leaves() {
        let radii = Radii::uniform(1.732, 2.598, 3.464);
        let regions = Regions::new(CoordBox { min: IVec3::ZERO, max: IVec3::splat(7) }, radii, 1.0);
        // 23 voxels for the sweeps are three leaves; then follow 7 voxels, 1 voxel and 7 voxels.
        let rings = [0, 3, 6, 7, 8, 9];
        let found = [
            regions.own,
            regions.banded,
            regions.swept,
            regions.crossed,
            regions.measured,
            regions.populated,
        ];
        for (found, ring) in found.into_iter().zip(rings) {
            assert_eq!((found.min, found.max), (IVec3::splat(-8 * ring), IVec3::splat(8 * ring + 7)));
            assert!(found.contains(found.min) && !found.contains(found.min - IVec3::new(0, 8, 0)));
        }
        assert!(meet(&regions.own, &CoordBox { min: IVec3::splat(7), max: IVec3::splat(9) }));
        assert!(!meet(&regions.own, &CoordBox { min: IVec3::new(0, 0, 8), max: IVec3::splat(9) }));
    }

    #[test]
    fn everywhere_contains_the_index_range() {
        let radii = Radii::uniform(32.0, 48.0, 64.0);
        let own = Regions::new(CoordBox::ALL, radii, 1.0).own;
        let farthest = IVec3::splat(crate::space::INDEX_LIMIT + 1000);
        assert!(own.contains(farthest) && own.contains(-farthest));
    }
}
