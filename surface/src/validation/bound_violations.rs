//! Moves vertices back that are out of bounds by more than the tolerance of half a voxel.
//!
//! ```text
//!        voxel  ∙───────∙     Bounds hold at voxels. In a gap between two spheres that is narrower
//!     S_max ▒▒▒▒│ v     │▒▒▒▒  than a voxel, or at the tip of a long ellipsoid, the interpolation error between
//!           ▒▒▒▒∙───────∙▒▒▒▒  voxels may be a little larger than the tolerance: then the vertex is moved.
//! ```

use glam::Vec3;

use super::DistanceLimits;
use super::distances::{CELL_MARGIN, NearLeaves};
use super::particle_checks::CheckedRegion;
use super::surfaces::distances_and_outward;

/// A vertex that is out of bounds, and the nearest position within them.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BoundViolation {
    /// Index of the vertex.
    pub vertex: usize,
    /// Its corrected position, in the coordinates of the mesh.
    pub position: Vec3,
}

/// The corrected position of a vertex that is out of bounds, relative to the leaf around which `near` was
/// collected; `None` if the correction steps reach no valid position within one voxel of the vertex.
pub(super) fn corrected_position(part: &CheckedRegion, near: &NearLeaves, local: Vec3) -> Option<Vec3> {
    let mut point = local;
    for _ in 0..STEPS_MAX {
        match step(part, near, point) {
            None => return Some(point),
            Some(step) => point += step,
        }
        if point.distance(local) > MOVE_MAX {
            return None;
        }
    }
    None
}

/// Upper limit of the movement of a vertex, in voxels.
pub(super) const MOVE_MAX: f32 = 1.0;

/// Maximum number of correction steps. A vertex that is still out of bounds after them is not moved.
const STEPS_MAX: usize = 8;

/// How far to the valid side of its bound a vertex is moved, in voxels: more than the rounding error of a
/// 32-bit position. The error of rounding to world positions is added.
const SLACK: f32 = 2e-3;

/// The step from a position to the bound that it violates; `None` if it violates none.
fn step(part: &CheckedRegion, near: &NearLeaves, point: Vec3) -> Option<Vec3> {
    let CheckedRegion { bins, radii, rounding_voxels, .. } = *part;
    let DistanceLimits { radii: [min, max], from_spheres: [from_min, from_max] } =
        DistanceLimits::new(&radii).with_margin(CELL_MARGIN);
    let slack = SLACK + rounding_voxels;
    let (mut deepest, mut nearest) = ((f32::INFINITY, Vec3::ZERO), (f32::INFINITY, Vec3::ZERO));
    for &(from_leaf, leaf) in &near.leaves {
        for (index, &center) in bins.range(leaf).zip(bins.in_leaf(leaf)) {
            let apart = point - from_leaf - center;
            // Particles this far away do not determine the bounds. They must be skipped, for two reasons: the
            // first-order distance to a far ellipsoid is too small, so the ellipsoid might be taken for the
            // nearest; and the result must not depend on which leaves were searched.
            if apart.length() > max * bins.shapes.outer_radius(index) + from_max + MOVE_MAX {
                continue;
            }
            let ([to_min, to_max], outward) = distances_and_outward(&bins.shapes, index, apart, [min, max]);
            if to_min < deepest.0 {
                deepest = (to_min, outward);
            }
            if to_max < nearest.0 {
                nearest = (to_max, outward);
            }
        }
    }
    // A position counts as valid only if it is inside the bounds by at least half the slack. A vertex may
    // have been found out of bounds only because of a rounding error: without this margin, it might count as
    // valid here and stay where it is.
    if deepest.0 < from_min + slack / 2.0 {
        Some(deepest.1 * (from_min + slack - deepest.0))
    } else if nearest.0 > from_max - slack / 2.0 && nearest.0.is_finite() {
        Some(nearest.1 * (from_max - slack - nearest.0))
    } else {
        None
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::contour::{Contouring, contour};
    use crate::particles::{Ellipsoid, OwnedPositions, ParticleCloud, Shapes};
    use crate::rasterize::{Radii, RasterFields, RasterParams, rasterize};
    use crate::space::{CoordBox, Lattice};
    use crate::validation::{Checks, MeshCells, NoExclusions, check};

    /// Vertices that are pushed out of bounds come back, and the others stay.
    #[test]
    fn violating_vertices_return_into_their_bounds() {
        let lattice = Lattice { voxel_size: 0.5 };
        let radii = Radii { band_scale: 2.0, min_scale: 0.6, ..Radii::uniform(3.0, 4.5, 6.0) };
        let long = Ellipsoid::new([1.8, 0.7, 0.8], [Vec3::X, Vec3::Y, Vec3::Z]);
        let shapes = [Shapes::Uniform, Shapes::Scaled(vec![1.0, 1.3]), Shapes::Ellipsoids(vec![long; 2])];
        for (shapes, pushed_voxels) in shapes.into_iter().zip([2.4, 2.7, 2.0]) {
            let positions = OwnedPositions::F64(vec![[0.1, 0.2, 0.3], [1.4, 0.5, 0.1]]);
            let cloud = ParticleCloud { positions, shapes, attributes: Vec::new() };
            let Ok(RasterFields { bins, band, .. }) = rasterize(&cloud, &RasterParams::open(lattice, radii));
            let mut mesh = contour(&band, &lattice, Contouring::Dual);
            // For semi-axes of 1, each bound is 1.5 voxels from the surface, plus a tolerance of 0.5. The
            // semi-axis along y is 0.7.
            let by_height =
                |one: &usize, other: &usize| mesh.positions[*one].y.total_cmp(&mesh.positions[*other].y);
            let highest = (0..mesh.positions.len()).max_by(by_height).expect("a vertex");
            let lowest = (0..mesh.positions.len()).min_by(by_height).expect("a vertex");
            for (vertex, sign) in [(highest, 1.0), (lowest, -1.0)] {
                let pushed_world = sign * pushed_voxels * lattice.voxel_size as f32;
                mesh.positions[vertex] += mesh.normals[vertex] * pushed_world;
            }
            let (owned, exempt) = (CoordBox::ALL, &NoExclusions);
            let cells = &MeshCells::new(&mesh, &band, &lattice);
            let part = CheckedRegion {
                bins: &bins,
                radii,
                band: &band,
                mesh: &mesh,
                cells,
                rounding_voxels: 0.0,
                lattice: &lattice,
                owned,
                exempt,
            };
            let Checks { particles: before, violations } = check(&part);
            assert!(before.vertices_inside_min == 1 && before.vertices_outside_max == 1, "{before:?}");
            let mut corrected = mesh.clone();
            for violation in &violations {
                corrected.positions[violation.vertex] = violation.position;
            }
            let after = check(&CheckedRegion { mesh: &corrected, ..part }).particles;
            assert_eq!(violations.len(), 2, "{violations:?}");
            assert_eq!(after.vertices_inside_min + after.vertices_outside_max, 0, "{after:?}");
        }
    }
}
