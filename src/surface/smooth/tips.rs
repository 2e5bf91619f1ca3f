//! The tips of φ at the centres of balls, which implicit steps have to hold.
//!
//! ```text
//!        the distance to a ball            where its tip may move
//!
//!          ╲            ╱                    ╲            ╱
//!      ─────╲──────────╱─────            ─────╲──────────╱─────      φ = 0: nearer to each other
//!            ╲        ╱                        ╲        ╱            when the middle is round
//!             ╲      ╱                          ╰──────╯
//!              ╲    ╱
//!               ╲  ╱
//!                ╲╱ held
//! ```
//!
//! The distance r to a point is biharmonic everywhere but there: ∇⁴r = −8π δ. With its tip a ball stays as it is. Let go, the
//! tip springs back like a plate that was held up at one point: a ball that is free all through, between values 3 h outside,
//! tends to the radius √(R² − 9 h²), or to nothing. Explicit steps are redistanced before that is felt; an implicit one goes
//! all the way at once.
//!
//! Sheets and threads have creases instead, along which φ is level. They are not held, for with them the surface would be.
//! What tells a tip is that φ falls off from it in all directions.
//!
//! How far lone balls are from the radius that the Laplacian steps leave them, at most, in voxels:
//!
//! ```text
//!   held around a tip       nothing   the tip   1 step   2 steps
//!   r_min of 1.8 to 3.4      0.79      0.47      0.18     0.11
//!   r_min of 3.8 to 12       0.06      0.06      0.06     0.06
//! ```

use glam::IVec3;
use rayon::prelude::*;

use super::band::near;
use super::thickness::with_neighbors;
use crate::surface::grid::{Field, LeafMask, Neighborhood, Topology, offset_in_leaf, voxel_in_leaf};
use crate::surface::simd::{self, Kernel, Lanes};

/// Beside a tip φ falls by more than this, in voxels, on the way to each place of the [shell]. Of a ball, wherever
/// its centre lies between voxels, by 1.31 from one of them; of a thread by less than 0.76 to some place, of a sheet by
/// less than 0.18.
const FALL_LEAST: f32 = 1.0;

/// It also bends by this along each axis: of a ball by 0.79. Most voxels do not, which is seen at once.
const BEND_LEAST: f32 = 0.6;

/// Tips lie so deep, in voxels: nearer to the surface nothing is one, and farther from it nothing around is free.
const DEPTHS: [f32; 2] = [1.0, 5.0];

/// Voxels held around a tip, in steps along the axes.
const HELD_AROUND: usize = 2;

/// How far the shell reaches along an axis.
const SHELL_REACH: i32 = 3;

/// How far the voxels are, at most, that decide whether a voxel is held.
pub(super) const TIP_REACH: u32 = HELD_AROUND as u32 + SHELL_REACH as u32;

/// The voxels at and around tips, but for those beside the surface: held, these would hold it, up to 0.24 voxels too far
/// out around the smallest balls.
pub(super) fn around_tips(topology: &Topology, phi: &Field) -> Vec<LeafMask> {
    let mut held = tips(topology, phi);
    if held.par_iter().any(|tips| !tips.is_empty()) {
        for _ in 0..HELD_AROUND {
            held = with_neighbors(topology, &held, &[0, 1, 2], 1, LeafMask::or);
        }
        held.par_iter_mut().zip(near(phi, DEPTHS[0])).for_each(|(held, beside)| held.remove_all(&beside));
    }
    held
}

fn tips(topology: &Topology, phi: &Field) -> Vec<LeafMask> {
    let shell = shell();
    let tips_of = |leaf: usize| {
        let around = Neighborhood::new(&phi.leaves, topology.neighbors(), leaf);
        let mut tips = LeafMask::EMPTY;
        for offset in simd::dispatch(Bends { around: &around }).iter() {
            if falls_all_around(topology, phi, topology.origins()[leaf] + voxel_in_leaf(offset), &shell) {
                tips.insert(offset);
            }
        }
        tips
    };
    (0..topology.len()).into_par_iter().map(tips_of).collect()
}

/// Steps in all directions, about three voxels long.
fn shell() -> Vec<IVec3> {
    let reach = -SHELL_REACH..=SHELL_REACH;
    let cube = reach.clone().flat_map(|x| {
        let reach = reach.clone();
        reach.clone().flat_map(move |y| reach.clone().map(move |z| IVec3::new(x, y, z)))
    });
    cube.filter(|step| (8..=12).contains(&step.length_squared())).collect()
}

/// Whether φ falls off from a voxel to every place of the shell around it. It does not where some of them are not stored: what is
/// there is farther from the surface than a tip.
fn falls_all_around(topology: &Topology, phi: &Field, voxel: IVec3, shell: &[IVec3]) -> bool {
    let value = |voxel: IVec3| {
        let (leaf, local) = topology.find_voxel(voxel)?;
        Some(phi.leaves[leaf].values[offset_in_leaf(local)])
    };
    value(voxel).is_some_and(|at| {
        let falls = |beyond: f32| 1f32.copysign(at) * (at - beyond) > FALL_LEAST;
        shell.iter().all(|step| value(voxel + step).is_some_and(falls))
    })
}

/// Where, in a leaf, φ bends towards the surface along all three axes.
struct Bends<'a> {
    around: &'a Neighborhood<'a>,
}

impl Kernel for Bends<'_> {
    type Output = LeafMask;

    #[inline(always)]
    fn run<V: Lanes>(self) -> LeafMask {
        let mut bends = LeafMask::EMPTY;
        let bend_least = V::splat(BEND_LEAST);
        let [shallowest, deepest] = DEPTHS.map(V::splat);
        for x in 0..8 {
            let slab = self.around.slab(x);
            for y in 0..8 {
                let phi = slab.row::<V>(y);
                // On the other side of the surface depths are negative.
                let (side, depth) = (V::splat(1.0).copysign(phi), phi.abs());
                let mut bend = V::splat(f32::INFINITY);
                for [before, after] in [slab.along_x::<V>(y), slab.along_y(y), slab.along_z(y)] {
                    bend = bend.min(depth.add(depth).sub(side.mul(before.add(after))));
                }
                let is_between = V::both(shallowest.lt(depth), depth.lt(deepest));
                bends.set_row(x * 8 + y, V::bits(V::both(bend_least.lt(bend), is_between)));
            }
        }
        bends
    }
}

#[cfg(test)]
mod tests {
    use glam::Vec3;

    use super::*;

    /// The tips in 4³ leaves where φ is this, clamped to a band's half width.
    fn tips_of(phi: impl Fn(Vec3) -> f32) -> Vec<IVec3> {
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
        tips(&topology, &field).into_iter().zip(topology.origins()).flat_map(of_leaf).collect()
    }

    #[test]
    fn every_ball_has_its_tip_inside_and_every_bubble_too() {
        for step in 0..64 {
            let place = IVec3::new(step >> 4, step >> 2 & 3, step & 3).as_vec3() / 6.0;
            let center = Vec3::splat(14.0) + place;
            for radius in [2.0, 3.3, 4.9] {
                for side in [1.0, -1.0] {
                    let found = tips_of(|point| side * (point.distance(center) - radius));
                    assert!(!found.is_empty(), "{center} {radius}");
                    for voxel in found {
                        assert!(voxel.as_vec3().distance(center) < 1.25, "{voxel} {center}");
                    }
                }
            }
        }
    }

    #[test]
    fn sheets_and_threads_and_edges_have_none() {
        let middle = Vec3::new(15.4, 15.1, 15.7);
        for normal in [Vec3::X, Vec3::Y, Vec3::new(1.0, 1.0, 0.0), Vec3::ONE, Vec3::new(1.0, -2.0, 3.0)] {
            let normal = normal.normalize();
            let along = |point: Vec3| normal.dot(point - middle);
            let across = |point: Vec3| (point - middle).reject_from_normalized(normal).length();
            let other = normal.any_orthonormal_vector();
            let sheet = |point: Vec3| along(point).abs() - 2.5;
            let thread = |point: Vec3| across(point) - 2.5;
            let edge = |point: Vec3| along(point).max(other.dot(point - middle)) - 1.5;
            for (index, found) in [tips_of(sheet), tips_of(thread), tips_of(edge)].into_iter().enumerate() {
                assert_eq!(found, [], "{index} {normal}");
            }
        }
    }

    #[test]
    fn what_is_held_is_two_steps_around() {
        let topology =
            Topology::new((0..8).map(|leaf| IVec3::new(leaf >> 2, leaf >> 1 & 1, leaf & 1) * 8).collect());
        let mut phi = Field::splat(topology.len(), -6.0);
        let tip = IVec3::new(7, 8, 8);
        for (leaf, origin) in phi.leaves.iter_mut().zip(topology.origins()) {
            for offset in 0..512 {
                leaf.values[offset] = (origin + voxel_in_leaf(offset) - tip).as_vec3().length() - 3.0;
            }
        }
        let held = around_tips(&topology, &phi);
        let is_held = |voxel: IVec3| {
            let leaf = topology.find(voxel & !7).expect("stored");
            held[leaf].contains(offset_in_leaf(voxel & 7))
        };
        for offset in 0..125 {
            let step = IVec3::new(offset / 25, offset / 5 % 5, offset % 5) - 2;
            // Two voxels away φ is −1: beside the surface.
            let is_near = step.abs().element_sum() <= 2 && step.as_vec3().length() < 2.0;
            assert_eq!(is_held(tip + step), is_near, "{step}");
        }
    }
}
