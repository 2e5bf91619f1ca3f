//! How far around a window one has to look so that what is in the window is exactly as if there was no window.
//!
//! ```text
//!   own        the window's leaves: φ_0, the bounds, and which leaves there are           ⎫ 2 voxels a sweep,
//!   banded     which leaves there are, and φ_0; the bounds of these are swept             ⎬ and one for who is
//!   swept      distances; φ_0 is swept on these                                           ⎭ beside the surface
//!   crossed    where the surface passes: leaves so far from it are stored                   the band's margin
//!   measured   distances again: who is beside the surface is told by its neighbours         one voxel
//!   populated  particles                                                                    reach of distances
//! ```
//!
//! Read from below it is how the stage goes; read from above, each line needs the next, on so much more. A leaf
//! counts as a whole: it is stored for any of its voxels. Nothing less would do, as far as can be proved: a
//! sweep reads values two voxels away along an axis, and each sweep those of the one before.

use glam::IVec3;

use super::{Radii, sweep_count};
use crate::surface::grid::LEAF_EDGE;
use crate::surface::space::CoordBox;

/// All voxels that there could be, and so many more that what is around them can be counted, too.
const EVERYWHERE: CoordBox = CoordBox { min: IVec3::splat(-3 << 29), max: IVec3::splat(3 << 29) };

/// The boxes of leaves that a window's results come from, each within the next.
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
    /// Those of the leaves that a window touches. No particle has a half axis longer than `longest`, in units of the
    /// radii.
    pub(super) fn new(window: CoordBox, radii: Radii, longest: f32) -> Regions {
        let swept_voxels = 2 * sweep_count(radii.half_width()) as i32 + 1;
        let window = CoordBox { min: window.min.max(EVERYWHERE.min), max: window.max.min(EVERYWHERE.max) };
        let own = leaves_around(window, 0);
        let banded = leaves_around(own, swept_voxels);
        let swept = leaves_around(banded, swept_voxels);
        let crossed = leaves_around(swept, radii.band_margin());
        let measured = leaves_around(crossed, 1);
        // A particle at the far end of its cell belongs to a voxel one less.
        let populated = leaves_around(measured, radii.exact_reach(longest).ceil() as i32 + 1);
        Regions { own, banded, swept, crossed, measured, populated }
    }
}

/// The box of the leaves within so many voxels of a box.
fn leaves_around(voxels: CoordBox, margin: i32) -> CoordBox {
    let (grown, edge) = (voxels.expanded(margin), IVec3::splat(LEAF_EDGE));
    CoordBox {
        min: grown.min.div_euclid(edge) * LEAF_EDGE,
        max: grown.max.div_euclid(edge) * LEAF_EDGE + (LEAF_EDGE - 1),
    }
}

/// Whether two boxes have a voxel in common.
pub(super) fn meet(one: &CoordBox, other: &CoordBox) -> bool {
    one.min.cmple(other.max).all() && other.min.cmple(one.max).all()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_window_of_one_leaf_needs_what_is_around_it() {
        let radii = Radii::of_balls(1.732, 2.598, 3.464);
        let regions = Regions::new(CoordBox { min: IVec3::ZERO, max: IVec3::splat(7) }, radii, 1.0);
        // 23 voxels for each of the sweeps: three leaves; then 7 voxels, 1 voxel and 7 voxels.
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
    fn everywhere_is_no_less_than_all_there_is() {
        let radii = Radii::of_balls(32.0, 48.0, 64.0);
        let own = Regions::new(CoordBox::ALL, radii, 1.0).own;
        let farthest = IVec3::splat(crate::surface::space::INDEX_LIMIT + 1000);
        assert!(own.contains(farthest) && own.contains(-farthest));
    }
}
