//! The interval that constrains φ.

use rayon::prelude::*;

use crate::grid::Field;
use crate::parallel::Loops as _;

/// Signed distances to the outer and the inner union of spheres, on the topology of the band that they
/// constrain. φ is negative inside, so the outer union gives the lower bound:
/// `lower` = φ_max ≤ φ ≤ φ_min = `upper`.
#[derive(Clone, Debug)]
pub struct Bounds {
    /// φ_max of the paper: signed distance to the outer union of spheres, in voxels.
    pub lower: Field,
    /// φ_min of the paper: signed distance to the inner union of spheres, in voxels.
    pub upper: Field,
}

impl Bounds {
    /// Clamps every value to its interval (Eq. 6).
    pub fn clamp(&self, phi: &mut Field) {
        let bounds = self.lower.leaves.par_iter().zip(&self.upper.leaves);
        phi.leaves.par_iter_mut().zip(bounds).halved().for_each(|(phi, (lower, upper))| {
            for ((phi, lower), upper) in phi.values.iter_mut().zip(&lower.values).zip(&upper.values) {
                *phi = phi.max(*lower).min(*upper);
            }
        });
    }

    /// Number of values outside their interval.
    pub fn violation_count(&self, phi: &Field) -> usize {
        let bounds = self.lower.leaves.par_iter().zip(&self.upper.leaves);
        let count =
            |(phi, (lower, upper)): (&crate::grid::Leaf, (&crate::grid::Leaf, &crate::grid::Leaf))| {
                let intervals = lower.values.iter().zip(&upper.values);
                phi.values
                    .iter()
                    .zip(intervals)
                    .filter(|(phi, (lower, upper))| !(*lower <= *phi && *phi <= *upper))
                    .count()
            };
        phi.leaves.par_iter().zip(bounds).halved().map(count).sum()
    }
}
