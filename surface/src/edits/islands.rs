//! Removes islands: components of the inside with few particles.
//!
//! A particle belongs to the component of the nearest inside corner of its cell. Usually the caller gives
//! only the particles near the surface. So a component that extends into leaves deep inside, which are not
//! stored, is kept without counting: one such leaf has room for hundreds of particles.

use std::sync::Arc;

use glam::{IVec3, Vec3};

use super::components::{Components, Connectivity};
use super::flip::{FlipSide, flip};
use crate::grid::{LEAF_EDGE, Topology, negative_masks};
use crate::level_set::NarrowBand;

/// Result of removing islands.
#[derive(Clone, Debug)]
pub struct DroppedIslands {
    /// Number of removed components.
    pub piece_count: usize,
    /// Number of given particles in the removed components.
    pub particle_count: u64,
    /// Number of voxels that changed from inside to outside.
    pub voxel_count: u64,
    topology: Arc<Topology>,
    components: Components,
    is_dropped: Vec<bool>,
}

/// Removes the components of the inside with fewer than `particle_count_min` particles.
///
/// `particles` yields each leaf's origin and particle positions, in voxels relative to the origin (0 to 8 on
/// each axis). Particles that are not given are not counted.
pub fn drop_islands<P: AsRef<[Vec3]>>(
    band: &mut NarrowBand,
    particle_count_min: u64,
    particles: impl IntoIterator<Item = (IVec3, P)>,
) -> DroppedIslands {
    let topology = band.topology.clone();
    let components = Components::new(&topology, &negative_masks(&band.phi), Connectivity::Faces);
    let mut is_candidate = vec![particle_count_min > 0; components.count];
    for (component, _) in components.beyond(&topology) {
        is_candidate[component as usize] = false;
    }
    let mut dropped = DroppedIslands {
        piece_count: 0,
        particle_count: 0,
        voxel_count: 0,
        topology,
        components,
        is_dropped: is_candidate,
    };
    let counts = dropped.count_particles(particles);
    for (is_dropped, count) in dropped.is_dropped.iter_mut().zip(counts) {
        *is_dropped &= count < particle_count_min;
        dropped.piece_count += usize::from(*is_dropped);
        dropped.particle_count += if *is_dropped { count } else { 0 };
    }
    let flipped = dropped.components.voxels_of(&dropped.is_dropped);
    dropped.voxel_count = flipped.iter().map(|(_, mask)| u64::from(mask.count())).sum();
    flip(band, &flipped, FlipSide::Outside);
    dropped
}

impl DroppedIslands {
    /// True if a particle was in a removed component. `local` is in voxels relative to the origin of its
    /// leaf.
    pub fn contains(&self, leaf_origin: IVec3, local: Vec3) -> bool {
        self.component_of(leaf_origin, local).is_some_and(|component| self.is_dropped[component as usize])
    }

    /// Number of particles in each component that may still be removed.
    fn count_particles<P: AsRef<[Vec3]>>(&self, particles: impl IntoIterator<Item = (IVec3, P)>) -> Vec<u64> {
        let has_candidate: Vec<bool> = (0..self.topology.len())
            .map(|leaf| {
                self.components.of_leaf(leaf).any(|(component, _)| self.is_dropped[component as usize])
            })
            .collect();
        let mut counts = vec![0; self.components.count];
        for (origin, locals) in particles {
            // The cells of a leaf extend into the leaves after it.
            let reached =
                (0..8).filter_map(|k| self.topology.find(origin.wrapping_add(corner(k) * LEAF_EDGE)));
            if !reached.into_iter().any(|leaf| has_candidate[leaf]) {
                continue;
            }
            for &local in locals.as_ref() {
                if let Some(component) = self.component_of(origin, local) {
                    counts[component as usize] += 1;
                }
            }
        }
        counts
    }

    /// The component of a particle.
    fn component_of(&self, origin: IVec3, local: Vec3) -> Option<u32> {
        // Rounding can put a particle on the leaf's upper boundary.
        let cell = local.as_ivec3().clamp(IVec3::ZERO, IVec3::splat(LEAF_EDGE));
        let corners = (0..8).map(|k| cell + corner(k)).filter_map(|voxel| {
            let (leaf, index) = self.topology.find_voxel(origin.wrapping_add(voxel))?;
            let component = self.components.component_at(leaf, index)?;
            Some((local.distance_squared(voxel.as_vec3()), component))
        });
        corners.min_by(|one, other| one.0.total_cmp(&other.0)).map(|(_, component)| component)
    }
}

/// Corner `4x + 2y + z` of a cell.
fn corner(number: i32) -> IVec3 {
    IVec3::new(number >> 2, number >> 1 & 1, number & 1)
}
