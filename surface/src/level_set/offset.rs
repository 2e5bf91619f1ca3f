//! Moves the surface of a level set by a constant distance.
//!
//! ```text
//!   φ            +3 +2 +1  0 −1 −2 −3      distances to the surface
//!   φ − offset   +1  0 −1 −2 −3 −4 −5      outward by 2: another level set becomes the surface
//!   restored     +1  0 −1 −2 −3 −4 −5      distances to the new surface
//! ```
//!
//! Where φ is a distance, its level set at `offset` is the moved surface. But φ − offset is not everywhere
//! the distance to the moved surface: where two parts of the surface merged, or one vanished, the nearest
//! point is now on another part. So distances are swept again. The sweeps start from the voxels next to the
//! moved surface, which keep their values.

use rayon::prelude::*;

use super::redistance::{Sweeps, UNREACHED, extend};
use super::{NEAREST_TO_ZERO, NarrowBand};
use crate::grid::{LeafMask, NO_LEAF, Topology, negative_masks};
use crate::parallel::Loops as _;

/// Moves the surface outward by `offset` voxels (inward if negative) and restores distances within ±
/// `half_width`, the band's new half width. φ must hold distances up to the level `offset`. All voxels keep
/// |φ| ≥ [`NEAREST_TO_ZERO`].
pub fn offset_surface(band: &mut NarrowBand, offset: f32, half_width: f32) {
    band.phi.leaves.par_iter_mut().halved().flat_map_iter(|leaf| &mut leaf.values).for_each(|phi| {
        let moved = *phi - offset;
        *phi = moved.abs().max(NEAREST_TO_ZERO).copysign(moved);
    });
    let fixed = next_to_surface(band);
    band.phi.leaves.par_iter_mut().zip(&fixed).halved().for_each(|(phi, fixed)| {
        for free in fixed.complement().iter() {
            phi.values[free] = UNREACHED.copysign(phi.values[free]);
        }
    });
    band.half_width = half_width;
    // Each sweep advances one voxel along the axes. Along a diagonal, a distance d takes √3 d such steps.
    sweep(band, &fixed, Sweeps::accurate((3f32.sqrt() * half_width).ceil() as u32));
}

/// How many voxels away, per axis, an input value of [`offset_surface`] can affect a result.
pub fn offset_reach_voxels(half_width: f32) -> u32 {
    2 * (3f32.sqrt() * half_width).ceil() as u32 + 1
}

/// Replaces −0 by +0. A voxel with φ = 0 is outside, but sweeps determine the side from the sign bit and
/// would treat −0 as inside. A swept voxel must be on the same side as its neighbors; otherwise signs would
/// alternate between sweeps and spread.
fn outside_if_zero(phi: f32) -> f32 {
    if phi == 0.0 { 0.0 } else { phi }
}

/// Sweeps distances again, from the voxels next to the surface, which keep their values, to voxels farther
/// away.
pub fn extend_distances(band: &mut NarrowBand, sweeps: Sweeps) {
    band.phi.leaves.par_iter_mut().halved().flat_map_iter(|leaf| &mut leaf.values).for_each(|phi| {
        *phi = outside_if_zero(*phi);
    });
    let fixed = next_to_surface(band);
    sweep(band, &fixed, sweeps);
}

fn sweep(band: &mut NarrowBand, fixed: &[LeafMask], sweeps: Sweeps) {
    extend(&band.topology, &mut band.phi, fixed, sweeps.clamped(band.half_width));
    let half_width = band.half_width;
    band.phi.leaves.par_iter_mut().halved().flat_map_iter(|leaf| &mut leaf.values).for_each(|phi| {
        *phi = phi.clamp(-half_width, half_width);
    });
}

/// The voxels of each leaf with a face neighbor on the other side of the surface.
fn next_to_surface(band: &NarrowBand) -> Vec<LeafMask> {
    let inside = negative_masks(&band.phi);
    let outside: Vec<LeafMask> = inside.par_iter().halved().map(LeafMask::complement).collect();
    let adjacent = |leaf: usize| {
        let [inside, outside] =
            [&inside, &outside].map(|sides| next_to_other_side(&band.topology, sides, leaf));
        inside.or(&outside)
    };
    (0..inside.len()).into_par_iter().halved().map(adjacent).collect()
}

/// The voxels of a leaf that are on one side of the surface and have a face neighbor on the other side.
/// Voxels that are not stored count as on the same side as the adjacent stored voxels.
fn next_to_other_side(topology: &Topology, side: &[LeafMask], leaf: usize) -> LeafMask {
    let faces = topology.neighbors()[leaf].map(|neighbor| match neighbor {
        NO_LEAF => &LeafMask::FULL,
        neighbor => &side[neighbor as usize],
    });
    let mut adjacent = side[leaf];
    adjacent.remove_all(&side[leaf].surrounded(faces));
    adjacent
}

#[cfg(test)]
mod tests {
    use glam::IVec3;

    use super::*;
    use crate::grid::{FACE_STEPS, Field, LEAF_EDGE, Leaf, offset_in_leaf, voxel_in_leaf};

    const HALF_WIDTH: f32 = 7.0;

    /// The band of a shape given by its signed distance.
    fn band(distance: impl Fn([f32; 3]) -> f32) -> NarrowBand {
        let axis = || -4..4;
        let origins = axis()
            .flat_map(|x| axis().flat_map(move |y| axis().map(move |z| IVec3::new(x, y, z) * LEAF_EDGE)));
        let values = |origin: IVec3| -> Leaf {
            let value = |offset| distance((origin + voxel_in_leaf(offset)).as_vec3().to_array());
            Leaf { values: std::array::from_fn(|offset| value(offset).clamp(-HALF_WIDTH, HALF_WIDTH)) }
        };
        let is_stored = |leaf: &Leaf| leaf.values.iter().any(|phi| phi.abs() < HALF_WIDTH);
        let topology = Topology::new(origins.filter(|&origin| is_stored(&values(origin))).collect());
        let phi = Field { leaves: topology.origins().iter().map(|&origin| values(origin)).collect() };
        NarrowBand { topology: topology.into(), phi, half_width: HALF_WIDTH }
    }

    fn ball(center: [f32; 3], radius: f32) -> impl Fn([f32; 3]) -> f32 {
        move |p| (0..3).map(|axis| (p[axis] - center[axis]).powi(2)).sum::<f32>().sqrt() - radius
    }

    fn moved(band: &NarrowBand, offset: f32) -> NarrowBand {
        let mut moved = band.clone();
        offset_surface(&mut moved, offset, 5.0);
        moved
    }

    /// Maximum difference between φ and a distance within the half width, and the number of voxels compared.
    fn greatest_error(band: &NarrowBand, distance: impl Fn([f32; 3]) -> f32) -> (f32, usize) {
        let (mut greatest, mut count) = (0f32, 0);
        for (leaf, &origin) in band.phi.leaves.iter().zip(band.topology.origins()) {
            for (offset, &phi) in leaf.values.iter().enumerate() {
                let exact = distance((origin + voxel_in_leaf(offset)).as_vec3().to_array());
                assert!(phi.abs() <= band.half_width);
                if exact.abs() < band.half_width - 0.5 {
                    greatest = greatest.max((phi - exact).abs());
                    count += 1;
                }
            }
        }
        (greatest, count)
    }

    #[test]
    fn offset_ball_has_radius_plus_offset() {
        let center = [0.3, -0.2, 0.4];
        let given = band(ball(center, 12.2));
        for offset in [-2.0, -0.4, 0.7, 2.0] {
            let (error, count) = greatest_error(&moved(&given, offset), ball(center, 12.2 + offset));
            assert!(error < 0.06 && count > 5000, "{offset}: {error} at {count}");
        }
    }

    /// Where parts vanish or merge, distances are those to the remaining surface.
    #[test]
    fn offset_restores_distances_after_parts_vanish_or_merge() {
        let both = |radii: [f32; 2]| {
            let [one, other] = [ball([-8.2, 0.1, 0.2], radii[0]), ball([8.3, 0.1, 0.2], radii[1])];
            move |p| one(p).min(other(p))
        };
        // The second ball vanishes without a trace next to the first.
        let (error, count) =
            greatest_error(&moved(&band(both([8.1, 1.6])), -1.7), ball([-8.2, 0.1, 0.2], 6.4));
        assert!(error < 0.15 && count > 2000, "{error} at {count}");
        // The balls merge. Without the sweeps, the former gap would still determine φ in the middle.
        let joined = moved(&band(both([7.1, 7.1])), 2.0);
        let middle = joined.topology.find_voxel(IVec3::ZERO).expect("stored");
        let phi = |(leaf, local): (usize, IVec3)| joined.phi.leaves[leaf].values[offset_in_leaf(local)];
        // The seam is a ring of radius √(9.1² − 8.25²) = 3.84 around the middle, where φ − offset would be
        // −0.85. The voxels next to the seam keep their values. In such a crease, their depth is up to one
        // voxel too small.
        assert!((phi(middle) + 3.84).abs() < 1.1, "{}", phi(middle));
    }

    /// The surface almost touches an outside voxel with φ = +0 or −0.
    #[test]
    fn zeros_of_both_signs_stay_outside_in_extended_distances() {
        let given = band(ball([0.3, -0.2, 0.4], 9.7));
        let center = IVec3::new(13, 0, 0);
        let extended = |zero: f32| {
            let mut extended = given.clone();
            let steps = FACE_STEPS.map(|step| (step, 0.2));
            for (step, phi) in steps.into_iter().chain([(IVec3::ZERO, zero)]) {
                let (leaf, local) = given.topology.find_voxel(center + step).expect("stored");
                extended.phi.leaves[leaf].values[offset_in_leaf(local)] = phi;
            }
            extend_distances(&mut extended, Sweeps::accurate(8));
            extended.phi
        };
        assert!(negative_masks(&extended(-0.0)) == negative_masks(&given.phi));
        assert!(extended(-0.0) == extended(0.0));
    }

    #[test]
    fn result_does_not_depend_on_threads() {
        let given = band(ball([1.0, 2.0, 0.4], 9.7));
        let on = |threads: usize| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("a thread pool");
            pool.install(|| moved(&given, -1.1).phi)
        };
        assert!(on(1) == on(3));
    }
}
