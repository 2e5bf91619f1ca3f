//! Where the voxels of a grid are in the world.

/// An affine map: voxel (i, j, k) is centred on `translation + i·axes[0] + j·axes[1] + k·axes[2]`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Transform {
    /// Steps from a voxel to the next along each index, world units.
    pub axes: [[f64; 3]; 3],
    /// World position of voxel (0, 0, 0).
    pub translation: [f64; 3],
}

impl Transform {
    /// The lengths of the steps along each index, world units.
    pub fn voxel_size(&self) -> [f64; 3] {
        self.axes.map(|[x, y, z]| (x * x + y * y + z * z).sqrt())
    }
}
