//! World space and index space.
//!
//! ```text
//!   world   x = i·h          voxel (0, 0, 0) is centered on the world origin in every frame:
//!   index   i = x / h        a common lattice keeps a sequence temporally coherent
//! ```

use glam::{DVec3, IVec3};

/// The grid's index range, in voxels from the origin. It leaves room in 32-bit indices for the neighbors of
/// voxels and of leaves.
pub const INDEX_LIMIT: i32 = 1 << 30;

/// The world-anchored lattice of voxels.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Lattice {
    /// Edge length h of a voxel, in world units, positive and finite.
    pub voxel_size: f64,
}

impl Lattice {
    /// The index-space position of a world position, or `None` if it is not finite or outside the grid's
    /// index range.
    pub fn index_from_world(&self, world: DVec3) -> Option<DVec3> {
        let index = world / self.voxel_size;
        let limit = f64::from(INDEX_LIMIT);
        // Comparison with NaN is false, so NaN counts as outside.
        (index.x.abs() < limit && index.y.abs() < limit && index.z.abs() < limit).then_some(index)
    }
}

/// A box of voxels, both corners included. Empty when `max < min` on an axis.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct CoordBox {
    /// Minimum corner.
    pub min: IVec3,
    /// Maximum corner.
    pub max: IVec3,
}

impl CoordBox {
    /// The empty box.
    pub const EMPTY: CoordBox = CoordBox { min: IVec3::MAX, max: IVec3::MIN };

    /// The box that contains every voxel.
    pub const ALL: CoordBox = CoordBox { min: IVec3::MIN, max: IVec3::MAX };

    /// True if a voxel is in the box.
    pub fn contains(&self, coord: IVec3) -> bool {
        coord.cmpge(self.min).all() && coord.cmple(self.max).all()
    }

    /// Grows the box to include `coord`.
    pub fn include(&mut self, coord: IVec3) {
        self.min = self.min.min(coord);
        self.max = self.max.max(coord);
    }

    /// The box grown by `margin` voxels on every side.
    pub fn expanded(&self, margin: i32) -> CoordBox {
        CoordBox { min: self.min - IVec3::splat(margin), max: self.max + IVec3::splat(margin) }
    }

    /// True if the box is empty.
    pub fn is_empty(&self) -> bool {
        self.max.cmplt(self.min).any()
    }
}

/// The bounding box of `count` small boxes, given by minimum and maximum corner. Ignores outliers: boxes that
/// are farther from nearly all other boxes than the extent of those. Ignores boxes that are not finite;
/// `None` if there are no others.
pub fn box_of(count: usize, small: impl Fn(usize) -> [DVec3; 2]) -> Option<[DVec3; 2]> {
    let finite = |index: usize| Some(small(index)).filter(|ends| ends.iter().all(|end| end.is_finite()));
    let all = (0..count).filter_map(finite).reduce(joined)?;
    let some: Vec<DVec3> =
        (0..count).step_by(count / SAMPLES + 1).filter_map(finite).map(|[least, _]| least).collect();
    let rank = some.len() / OUTLIERS;
    if rank == 0 {
        return Some(all);
    }
    let [low, high] = middle_range(&some, rank);
    let reach = DVec3::splat((high - low).max_element());
    let kept = (0..count)
        .filter_map(finite)
        .filter(|[least, greatest]| least.cmpge(low - reach).all() && greatest.cmple(high + reach).all());
    kept.reduce(joined)
}

/// Number of samples used for ranking.
const SAMPLES: usize = 1 << 18;

/// One box in this many may be an outlier, at either end of each axis.
const OUTLIERS: usize = 200;

/// Along each axis, the positions of this rank from either end.
fn middle_range(positions: &[DVec3], rank: usize) -> [DVec3; 2] {
    let mut ends = [DVec3::ZERO; 2];
    for axis in 0..3 {
        let mut along: Vec<f64> = positions.iter().map(|position| position[axis]).collect();
        let last = along.len() - 1 - rank;
        ends[0][axis] = *along.select_nth_unstable_by(rank, f64::total_cmp).1;
        ends[1][axis] = *along.select_nth_unstable_by(last, f64::total_cmp).1;
    }
    ends
}

/// The bounding box of two boxes.
pub fn joined(one: [DVec3; 2], other: [DVec3; 2]) -> [DVec3; 2] {
    [one[0].min(other[0]), one[1].max(other[1])]
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A slab of 10 × 1 × 10, with other boxes.
    fn slab_with(others: &[DVec3]) -> Option<[DVec3; 2]> {
        let slab = (0..1331)
            .map(|i| DVec3::new(f64::from(i % 11), f64::from(i / 11 % 11) * 0.1, f64::from(i / 121)));
        let positions: Vec<DVec3> = slab.chain(others.iter().copied()).collect();
        box_of(positions.len(), |index| [positions[index]; 2])
    }

    const SLAB: [DVec3; 2] = [DVec3::ZERO, DVec3::new(10.0, 1.0, 10.0)];

    #[test]
    fn bounding_box_includes_splash_drops() {
        let drop = DVec3::new(4.0, 8.0, 14.0);
        assert_eq!(slab_with(&[drop]), Some([DVec3::ZERO, DVec3::new(10.0, 8.0, 14.0)]));
    }

    #[test]
    fn bounding_box_ignores_outliers() {
        let outliers = [DVec3::new(5.0, -900.0, 5.0), DVec3::splat(f64::NAN), DVec3::new(1e7, 0.0, 0.0)];
        assert_eq!(slab_with(&outliers), Some(SLAB));
    }

    #[test]
    fn bounding_box_of_few_boxes_ignores_none() {
        let ends = [DVec3::ZERO, DVec3::new(1e6, 1.0, 2.0)];
        assert_eq!(box_of(2, |index| [ends[index]; 2]), Some(ends));
        assert_eq!(box_of(0, |_| [DVec3::ZERO; 2]), None);
    }
}
