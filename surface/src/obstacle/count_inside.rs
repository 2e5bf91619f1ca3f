//! Counts particles inside obstacles, where a simulation should have none.

use glam::{DVec3, IVec3};
use rayon::prelude::*;

use super::{ObstacleLeaf, Obstacles};
use crate::grid::{LEAF_EDGE, offset_in_leaf};
use crate::parallel::Loops as _;
use crate::particles::{AnySource, Positions, Unread};
use crate::space::Lattice;

impl Obstacles {
    /// Counts the particles that are inside an obstacle.
    ///
    /// # Errors
    /// Those of the source.
    pub fn count_inside(
        &self,
        source: &AnySource<'_>,
        lattice: &Lattice,
        half_width: f32,
    ) -> Result<usize, Unread> {
        let of_batch = |batch: usize| {
            let mut known = LastLeaf { obstacles: self, lattice, half_width, last: None };
            Ok(match source.batch(batch)? {
                Positions::F32(positions) => positions
                    .iter()
                    .filter(|position| known.is_inside(glam::Vec3::from(**position).as_dvec3()))
                    .count(),
                Positions::F64(positions) => {
                    positions.iter().filter(|position| known.is_inside(DVec3::from(**position))).count()
                }
            })
        };
        (0..source.batch_count())
            .into_par_iter()
            .halved()
            .map(of_batch)
            .try_reduce(|| 0, |one, other| Ok(one + other))
    }
}

/// The voxel nearest to a particle is at most √3/2 voxels away. If that voxel is farther from the surface
/// than this, in voxels, the particle is on the voxel's side.
const NEAR: f32 = 0.9;

/// The leaf of the previous particle: the next particle is often in the same leaf.
struct LastLeaf<'a> {
    obstacles: &'a Obstacles,
    lattice: &'a Lattice,
    half_width: f32,
    last: Option<(IVec3, ObstacleLeaf)>,
}

impl LastLeaf<'_> {
    fn is_inside(&mut self, position: DVec3) -> bool {
        let Some(index) = self.lattice.index_from_world(position) else { return false };
        let voxel = index.round().as_ivec3();
        let local = voxel & IVec3::splat(LEAF_EDGE - 1);
        let origin = voxel - local;
        let LastLeaf { obstacles, lattice, half_width, last } = self;
        if last.as_ref().is_none_or(|(known, _)| *known != origin) {
            *last = Some((origin, obstacles.leaf(origin, lattice, *half_width)));
        }
        match last {
            Some((_, ObstacleLeaf::Inside)) => true,
            Some((_, ObstacleLeaf::Near(leaf))) => match leaf.values[offset_in_leaf(local)] {
                distance if distance > NEAR => false,
                distance if distance < -NEAR => true,
                _ => obstacles.depth(position, lattice, *half_width).is_some(),
            },
            _ => false,
        }
    }
}
