//! Finds the peaks of φ at the centers of balls, which implicit steps must pin.
//!
//! ```text
//!        distance to a ball                without pinning, the peak moves
//!
//!          ╲            ╱                    ╲            ╱
//!      ─────╲──────────╱─────            ─────╲──────────╱─────      φ = 0: the ball shrinks
//!            ╲        ╱                        ╲        ╱            as the peak flattens
//!             ╲      ╱                          ╰──────╯
//!              ╲    ╱
//!               ╲  ╱
//!                ╲╱ pinned
//! ```
//!
//! The distance r to a point is biharmonic everywhere except at that point: ∇⁴r = −8π δ. So the φ of a ball
//! is stationary as long as its peak is pinned. If it is not, the flow flattens the peak, like a bent plate
//! released at one point. A ball whose voxels are all free, between values fixed 3 h outside its surface,
//! tends to the radius √(R² − 9 h²), or vanishes. With explicit steps, φ is redistanced before this has an
//! effect; an implicit step flattens the peak at once.
//!
//! Sheets and filaments have creases along which φ is constant. These are not pinned, because that would pin
//! the surface, too. A peak is distinguished by φ falling off in all directions.
//!
//! The table shows the error of the final radius of an isolated ball, by what is pinned: the largest
//! difference from the radius that the Laplacian steps leave. Lengths are in voxels.
//!
//! ```text
//!   pinned              nothing   only the peak   up to 1 step from it   up to 2 steps from it
//!   r_min 1.8 to 3.4     0.79         0.47                0.18                   0.11
//!   r_min 3.8 to 12      0.06         0.06                0.06                   0.06
//! ```

use std::ops::RangeInclusive;

use glam::IVec3;
use rayon::prelude::*;

use super::{near, with_neighbors};
use crate::grid::{Field, LeafMask, Neighborhood, Topology, offset_in_leaf, voxel_in_leaf};
use crate::parallel::Loops as _;
use crate::simd::{self, Kernel, Lanes};

/// Minimum fall of |φ| from a peak to every point of the [shell], in voxels. For a ball it is at least 1.31
/// from some voxel, wherever its center lies between voxels; for a filament it is less than 0.76 toward some
/// point, and for a sheet less than 0.18.
const FALL_MIN: f32 = 1.0;

/// Minimum bend along each axis, in voxels. The bend is minus the second difference of side·φ, where side is
/// the sign of φ at the voxel. At the voxel nearest to the center of a ball it is at least 0.79. A quick test
/// that rejects most voxels.
const BEND_MIN: f32 = 0.6;

/// Depths at which peaks are searched, in voxels: nearer to the surface there are none, and farther away all
/// voxels around them are fixed.
const DEPTHS: [f32; 2] = [1.0, 5.0];

/// Radius of the pinned region around a peak, in steps along the axes.
const PINNED_AROUND: usize = 2;

/// Squared lengths of the steps to the points of the shell: the lengths are 2.8 to 3.5.
const SHELL_SQUARES: RangeInclusive<i32> = 8..=12;

/// Reach of the shell along an axis.
const SHELL_REACH: i32 = 3;

/// Maximum distance of the voxels that affect whether a voxel is pinned.
pub(super) const PEAK_REACH: u32 = PINNED_AROUND as u32 + SHELL_REACH as u32;

/// The voxels at and around peaks, except those next to the surface: pinning these would pin the surface, up
/// to 0.24 voxels too far out around the smallest balls.
pub(super) fn pinned_peaks(topology: &Topology, phi: &Field) -> Vec<LeafMask> {
    let mut pinned = peaks(topology, phi);
    if pinned.par_iter().halved().any(|peaks| !peaks.is_empty()) {
        for _ in 0..PINNED_AROUND {
            pinned = with_neighbors(topology, &pinned, &[0, 1, 2], 1, LeafMask::or);
        }
        pinned
            .par_iter_mut()
            .zip(near(phi, DEPTHS[0]))
            .halved()
            .for_each(|(pinned, adjacent)| pinned.remove_all(&adjacent));
    }
    pinned
}

fn peaks(topology: &Topology, phi: &Field) -> Vec<LeafMask> {
    let shell = shell();
    let peaks_in_leaf = |leaf: usize| {
        let around = Neighborhood::new(&phi.leaves, topology.neighbors(), leaf);
        let mut peaks = LeafMask::EMPTY;
        for offset in simd::dispatch(Bends { around: &around }).iter() {
            if falls_all_around(topology, phi, topology.origins()[leaf] + voxel_in_leaf(offset), &shell) {
                peaks.insert(offset);
            }
        }
        peaks
    };
    (0..topology.len()).into_par_iter().halved().map(peaks_in_leaf).collect()
}

/// Steps in all directions, about three voxels long.
fn shell() -> Vec<IVec3> {
    let mut shell = Vec::new();
    for x in -SHELL_REACH..=SHELL_REACH {
        for y in -SHELL_REACH..=SHELL_REACH {
            for z in -SHELL_REACH..=SHELL_REACH {
                let step = IVec3::new(x, y, z);
                if SHELL_SQUARES.contains(&step.length_squared()) {
                    shell.push(step);
                }
            }
        }
    }
    shell
}

/// Whether φ falls off from a voxel to every point of the shell around it. A point that is not stored is
/// deeper than any peak, so φ does not fall toward it.
fn falls_all_around(topology: &Topology, phi: &Field, voxel: IVec3, shell: &[IVec3]) -> bool {
    let value = |voxel: IVec3| {
        let (leaf, local) = topology.find_voxel(voxel)?;
        Some(phi.leaves[leaf].values[offset_in_leaf(local)])
    };
    value(voxel).is_some_and(|at| {
        let falls = |beyond: f32| 1f32.copysign(at) * (at - beyond) > FALL_MIN;
        shell.iter().all(|step| value(voxel + step).is_some_and(falls))
    })
}

/// Kernel: the voxels of a leaf, at the [depths](DEPTHS) of peaks, where φ [bends](BEND_MIN) enough along all
/// three axes.
struct Bends<'a> {
    around: &'a Neighborhood<'a>,
}

impl Kernel for Bends<'_> {
    type Output = LeafMask;

    #[inline(always)]
    fn run<V: Lanes>(self) -> LeafMask {
        let mut bent = LeafMask::EMPTY;
        let bend_min = V::splat(BEND_MIN);
        let [shallowest, deepest] = DEPTHS.map(V::splat);
        for x in 0..8 {
            let slab = self.around.slab(x);
            for y in 0..8 {
                let phi = slab.row::<V>(y);
                let (side, depth) = (V::splat(1.0).copysign(phi), phi.abs());
                let mut least_bend = V::splat(f32::INFINITY);
                for [before, after] in [slab.along_x::<V>(y), slab.along_y(y), slab.along_z(y)] {
                    // The second difference is side·before − 2 side·φ + side·after, and side·φ is the depth.
                    let bend = depth.add(depth).sub(side.mul(before.add(after)));
                    least_bend = least_bend.min(bend);
                }
                let is_between = V::both(shallowest.lt(depth), depth.lt(deepest));
                bent.set_row(x * 8 + y, V::bits(V::both(bend_min.lt(least_bend), is_between)));
            }
        }
        bent
    }
}

#[cfg(test)]
mod tests {
    use glam::Vec3;

    use super::*;

    /// The peaks in 4³ leaves for this φ, clamped to a band's half width.
    fn peaks_in_leaf(phi: impl Fn(Vec3) -> f32) -> Vec<IVec3> {
        let origins = (0..64).map(|leaf| IVec3::new(leaf >> 4, leaf >> 2 & 3, leaf & 3) * 8).collect();
        let topology = Topology::new(origins);
        let mut field = Field::splat(topology.len(), 0.0);
        for (leaf, origin) in field.leaves.iter_mut().zip(topology.origins()) {
            for offset in 0..512 {
                let voxel = origin + voxel_in_leaf(offset);
                leaf.values[offset] = phi(voxel.as_vec3()).clamp(-6.0, 6.0);
            }
        }
        let of_leaf = |(mask, origin): (LeafMask, &IVec3)| {
            mask.iter().map(|offset| *origin + voxel_in_leaf(offset)).collect::<Vec<IVec3>>()
        };
        peaks(&topology, &field).into_iter().zip(topology.origins()).flat_map(of_leaf).collect()
    }

    #[test]
    fn balls_and_bubbles_have_one_peak_each() {
        for step in 0..64 {
            let shift = IVec3::new(step >> 4, step >> 2 & 3, step & 3).as_vec3() / 6.0;
            let center = Vec3::splat(14.0) + shift;
            for radius in [2.0, 3.3, 4.9] {
                for side in [1.0, -1.0] {
                    let found = peaks_in_leaf(|point| side * (point.distance(center) - radius));
                    assert!(!found.is_empty(), "{center} {radius}");
                    for voxel in found {
                        assert!(voxel.as_vec3().distance(center) < 1.25, "{voxel} {center}");
                    }
                }
            }
        }
    }

    #[test]
    fn sheets_threads_and_edges_have_no_peaks() {
        let middle = Vec3::new(15.4, 15.1, 15.7);
        for normal in [Vec3::X, Vec3::Y, Vec3::new(1.0, 1.0, 0.0), Vec3::ONE, Vec3::new(1.0, -2.0, 3.0)] {
            let normal = normal.normalize();
            let along = |point: Vec3| normal.dot(point - middle);
            let across = |point: Vec3| (point - middle).reject_from_normalized(normal).length();
            let other = normal.any_orthonormal_vector();
            let sheet = |point: Vec3| along(point).abs() - 2.5;
            let thread = |point: Vec3| across(point) - 2.5;
            let edge = |point: Vec3| along(point).max(other.dot(point - middle)) - 1.5;
            for (index, found) in
                [peaks_in_leaf(sheet), peaks_in_leaf(thread), peaks_in_leaf(edge)].into_iter().enumerate()
            {
                assert_eq!(found, [], "{index} {normal}");
            }
        }
    }

    #[test]
    fn voxels_within_two_steps_of_a_peak_are_pinned() {
        let topology =
            Topology::new((0..8).map(|leaf| IVec3::new(leaf >> 2, leaf >> 1 & 1, leaf & 1) * 8).collect());
        let mut phi = Field::splat(topology.len(), -6.0);
        let peak = IVec3::new(7, 8, 8);
        for (leaf, origin) in phi.leaves.iter_mut().zip(topology.origins()) {
            for offset in 0..512 {
                leaf.values[offset] = (origin + voxel_in_leaf(offset) - peak).as_vec3().length() - 3.0;
            }
        }
        let pinned = pinned_peaks(&topology, &phi);
        let is_pinned = |voxel: IVec3| {
            let leaf = topology.find(voxel & !7).expect("stored");
            pinned[leaf].contains(offset_in_leaf(voxel & 7))
        };
        for offset in 0..125 {
            let step = IVec3::new(offset / 25, offset / 5 % 5, offset % 5) - 2;
            // Two voxels away φ is −1: next to the surface.
            let is_near = step.abs().element_sum() <= 2 && step.as_vec3().length() < 2.0;
            assert_eq!(is_pinned(peak + step), is_near, "{step}");
        }
    }
}
