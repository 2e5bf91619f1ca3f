//! A plain dense grid of doubles.
//!
//! The box is so large that its two outermost layers of voxels are far outside. They are never changed,
//! so every voxel that is changed has two neighbours on every side.

use glam::{DVec3, IVec3};

/// A box of voxels; z fastest.
pub(super) struct Grid {
    min: IVec3,
    size: IVec3,
    /// The indices of all voxels except the two outermost layers.
    pub(super) interior: Vec<usize>,
}

/// Margin around the particles, in voxels: more than r_max plus the half width.
const MARGIN: f64 = 12.0;

impl Grid {
    /// A grid around particles given in voxels.
    pub(super) fn around(positions: &[DVec3]) -> Grid {
        let low = positions.iter().copied().reduce(DVec3::min).unwrap();
        let high = positions.iter().copied().reduce(DVec3::max).unwrap();
        let min = (low - MARGIN).floor().as_ivec3();
        let max = (high + MARGIN).ceil().as_ivec3();
        let mut grid = Grid { min, size: max - min + IVec3::ONE, interior: Vec::new() };
        grid.interior = grid.voxels_between(min + 2, max - 2).map(|(_, voxel)| voxel).collect();
        grid
    }

    /// All voxels with their indices.
    pub(super) fn voxels(&self) -> impl Iterator<Item = (IVec3, usize)> {
        self.voxels_between(self.min, self.min + self.size - IVec3::ONE)
    }

    /// The voxels of a box, both corners included, with their indices.
    pub(super) fn voxels_between(&self, low: IVec3, high: IVec3) -> impl Iterator<Item = (IVec3, usize)> {
        let along_z = move |x, y| (low.z..=high.z).map(move |z| IVec3::new(x, y, z));
        let along_y = move |x| (low.y..=high.y).flat_map(move |y| along_z(x, y));
        (low.x..=high.x).flat_map(along_y).map(|voxel| (voxel, self.index(voxel)))
    }

    /// Number of voxels.
    pub(super) fn len(&self) -> usize {
        self.size.to_array().iter().map(|&along| along as usize).product()
    }

    /// The index of a voxel's value.
    pub(super) fn index(&self, voxel: IVec3) -> usize {
        let [x, y, z] = (voxel - self.min).to_array().map(|along| along as usize);
        (x * self.size.y as usize + y) * self.size.z as usize + z
    }

    /// The indices of the six face neighbours: two for each axis.
    pub(super) fn faces(&self, index: usize) -> [[usize; 2]; 3] {
        let (along_y, along_x) = (self.size.z as usize, (self.size.y * self.size.z) as usize);
        [along_x, along_y, 1].map(|step| [index - step, index + step])
    }

    /// ∇² by central differences.
    pub(super) fn laplacian(&self, values: &[f64], index: usize) -> f64 {
        self.faces(index).as_flattened().iter().map(|&face| values[face] - values[index]).sum()
    }

    /// |∇| by central differences.
    pub(super) fn slope(&self, values: &[f64], index: usize) -> f64 {
        let squares = self.faces(index).map(|[low, high]| ((values[high] - values[low]) / 2.0).powi(2));
        squares.iter().sum::<f64>().sqrt()
    }
}
