//! The biharmonic operator ∇⁴φ = ∇²(∇²φ), computed by applying central differences twice (paper, Eq. 4).
//!
//! Its eigenvalues on the lattice lie in [0, 144] in units of 1/h⁴, because those of the 7-point Laplacian
//! lie in [−12, 0].

use rayon::prelude::*;

use super::free_voxels::FreeVoxels;
use crate::grid::{Field, Leaf, Neighborhood, Topology, vectors_in};
use crate::parallel::Loops as _;
use crate::simd::{self, Vector, WideKernel};

/// The largest eigenvalue of the discrete biharmonic, in units of 1/h⁴.
pub const EIGENVALUE_MAX: f32 = 144.0;

/// First application: the Laplacian of `values` in the rows where it is needed, in voxel units.
pub(super) fn inner_laplacian(topology: &Topology, band: &FreeVoxels, values: &Field, laplacian: &mut Field) {
    let neighbors = topology.neighbors();
    laplacian.leaves.par_iter_mut().zip(&band.laplacian_rows).enumerate().halved().for_each(
        |(leaf, (laplacian, &rows))| {
            if rows == 0 {
                return;
            }
            let around = Neighborhood::new(&values.leaves, neighbors, leaf);
            simd::dispatch_wide(Laplacian { around: &around, rows, laplacian });
        },
    );
}

/// Kernel: the Laplacian of selected rows of a leaf; bit `x·8 + y` selects a row.
pub(super) struct Laplacian<'a> {
    pub(super) around: &'a Neighborhood<'a>,
    pub(super) rows: u64,
    pub(super) laplacian: &'a mut Leaf,
}

impl WideKernel for Laplacian<'_> {
    type Output = ();

    #[inline(always)]
    fn run<V: Vector>(self) {
        for (x, ys) in vectors_in::<V>(self.rows) {
            let slab = self.around.slab(x);
            for y in ys {
                slab.laplacian::<V>(y).store_at(self.laplacian.slab_mut(x), y);
            }
        }
    }
}
