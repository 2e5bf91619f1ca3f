//! The biharmonic operator ∇⁴φ = ∇²(∇²φ), by two rounds of central differences (paper, Eq. 4).
//!
//! Its eigenvalues on the lattice lie in [0, 144] in units of 1/h⁴: the 7-point Laplacian's lie in
//! [−12, 0].

use rayon::prelude::*;

use super::band::Band;
use crate::surface::grid::{Field, Leaf, Neighborhood, Topology, slabs_in};
use crate::surface::simd::{self, Kernel, Lanes};

/// The largest eigenvalue of the discrete biharmonic, in units of 1/h⁴.
pub const EIGENVALUE_MAX: f32 = 144.0;

/// The first round: the Laplacian of `values` in the rows where the band needs it, voxel units.
pub(super) fn inner_laplacian(topology: &Topology, band: &Band, values: &Field, laplacian: &mut Field) {
    let neighbors = topology.neighbors();
    laplacian.leaves.par_iter_mut().zip(&band.laplacian_rows).enumerate().for_each(
        |(leaf, (laplacian, &rows))| {
            if rows == 0 {
                return;
            }
            let around = Neighborhood::new(&values.leaves, neighbors, leaf);
            simd::dispatch(Laplacian { around: &around, rows, laplacian });
        },
    );
}

/// The Laplacian of some rows of a leaf: bit `x·8 + y`.
pub(super) struct Laplacian<'a> {
    pub(super) around: &'a Neighborhood<'a>,
    pub(super) rows: u64,
    pub(super) laplacian: &'a mut Leaf,
}

impl Kernel for Laplacian<'_> {
    type Output = ();

    #[inline(always)]
    fn run<V: Lanes>(self) {
        for (x, ys) in slabs_in(self.rows) {
            let slab = self.around.slab(x);
            for y in ys {
                slab.laplacian::<V>(y).store(self.laplacian.row_mut(x * 8 + y));
            }
        }
    }
}
