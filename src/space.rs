//! World space and index space.
//!
//! ```text
//!   world   x = i·h          voxel (0, 0, 0) is centred on the world's origin, in every frame:
//!   index   i = x / h        one lattice for all frames is what keeps a sequence coherent
//! ```

use glam::{DVec3, IVec3};

/// Voxels farther than this from the origin are outside the grid: their neighbours, and the
/// leaves around them, must still have 32-bit indices.
pub const INDEX_LIMIT: i32 = 1 << 30;

/// The world-anchored lattice of voxels.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Lattice {
    /// Edge length h of a voxel, world units, positive and finite.
    pub voxel_size: f64,
}

impl Lattice {
    /// The index-space position of a world position, or `None` where it is not finite or the grid
    /// has no indices for it.
    pub fn index_from_world(&self, world: DVec3) -> Option<DVec3> {
        let index = world / self.voxel_size;
        let limit = f64::from(INDEX_LIMIT);
        // A comparison with NaN is false: what is not a number is not inside.
        (index.x.abs() < limit && index.y.abs() < limit && index.z.abs() < limit).then_some(index)
    }
}

/// A box of voxels, both corners included. Empty when `max < min` on an axis.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct CoordBox {
    /// Least corner.
    pub min: IVec3,
    /// Greatest corner.
    pub max: IVec3,
}

impl CoordBox {
    /// The box that holds nothing.
    pub const EMPTY: CoordBox = CoordBox { min: IVec3::MAX, max: IVec3::MIN };

    /// The box that holds every voxel.
    pub const ALL: CoordBox = CoordBox { min: IVec3::MIN, max: IVec3::MAX };

    /// Whether a voxel is in the box.
    pub fn contains(&self, coord: IVec3) -> bool {
        coord.cmpge(self.min).all() && coord.cmple(self.max).all()
    }

    /// Grows the box to hold `coord`.
    pub fn include(&mut self, coord: IVec3) {
        self.min = self.min.min(coord);
        self.max = self.max.max(coord);
    }

    /// The box grown by `margin` voxels on every side.
    pub fn expanded(&self, margin: i32) -> CoordBox {
        CoordBox { min: self.min - IVec3::splat(margin), max: self.max + IVec3::splat(margin) }
    }

    /// Whether the box holds nothing.
    pub fn is_empty(&self) -> bool {
        self.max.cmplt(self.min).any()
    }
}
