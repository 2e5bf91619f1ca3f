//! Distances to the nearest particle, leaf by leaf.
//!
//! Each leaf gathers from the particles around it, so no two threads write to one place, and the
//! least distance does not depend on the order of particles.

use glam::{IVec3, Vec3};
use rayon::prelude::*;

use super::bin::ParticleBins;
use crate::grid::{Field, LEAF_EDGE, Leaf, Topology};

/// In place of a distance: no particle is within reach.
pub(super) const OUT_OF_REACH: f32 = f32::INFINITY;

/// Distances in voxels to the nearest particle, for all leaves within `reach` voxels of one;
/// [`OUT_OF_REACH`] for the voxels of these leaves that are farther than that.
pub(super) fn nearest_distances(bins: &ParticleBins, reach: f32) -> (Topology, Field) {
    let rings = (reach / LEAF_EDGE as f32).ceil() as i32;
    let steps = ring_steps(rings);
    let candidates: Vec<IVec3> = bins
        .topology
        .origins()
        .par_iter()
        .flat_map_iter(|&origin| steps.iter().map(move |&step| origin + step))
        .collect();
    let candidates = Topology::new(candidates);
    let reached: Vec<(IVec3, Leaf)> = candidates
        .origins()
        .par_iter()
        .filter_map(|&origin| leaf_distances(bins, origin, &steps, reach).map(|leaf| (origin, leaf)))
        .collect();
    let (origins, leaves): (Vec<IVec3>, Vec<Leaf>) = reached.into_iter().unzip();
    (Topology::new(origins), Field { leaves })
}

/// Steps to all leaves within so many leaves on each axis, the leaf itself included.
fn ring_steps(rings: i32) -> Vec<IVec3> {
    let axis = || -rings..=rings;
    axis()
        .flat_map(|x| axis().flat_map(move |y| axis().map(move |z| IVec3::new(x, y, z) * LEAF_EDGE)))
        .collect()
}

/// The distances of one leaf's voxels, or `None` where no particle is within reach of any.
fn leaf_distances(bins: &ParticleBins, origin: IVec3, steps: &[IVec3], reach: f32) -> Option<Leaf> {
    let mut squared = Leaf::splat(OUT_OF_REACH);
    let mut touched = false;
    for &step in steps {
        let Some(bin) = bins.topology.find(origin + step) else { continue };
        for &position in bins.in_leaf(bin) {
            let position = position + step.as_vec3();
            if box_distance_squared(position) <= reach * reach {
                touched = true;
                lower_to_sphere(&mut squared, position, reach * reach);
            }
        }
    }
    for value in &mut squared.values {
        *value = if *value <= reach * reach { value.sqrt() } else { OUT_OF_REACH };
    }
    touched.then_some(squared)
}

/// Squared distance from a point to the box of a leaf's voxel centres.
fn box_distance_squared(position: Vec3) -> f32 {
    (position - position.clamp(Vec3::ZERO, Vec3::splat((LEAF_EDGE - 1) as f32))).length_squared()
}

/// Takes the lesser of each squared distance and that to `position`, in the rows within reach.
fn lower_to_sphere(squared: &mut Leaf, position: Vec3, reach_squared: f32) {
    for (row, values) in squared.values.as_chunks_mut::<8>().0.iter_mut().enumerate() {
        let (dx, dy) = ((row >> 3) as f32 - position.x, (row & 7) as f32 - position.y);
        let across = dx * dx + dy * dy;
        if across > reach_squared {
            continue;
        }
        for (z, value) in values.iter_mut().enumerate() {
            let dz = z as f32 - position.z;
            *value = value.min(across + dz * dz);
        }
    }
}
