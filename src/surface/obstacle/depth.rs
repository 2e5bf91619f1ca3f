//! How deep vertices are in obstacles; and those that sharp edges run past are moved out.
//!
//! ```text
//!    · ────── ·         an edge that is sharper than the grid can tell lies between voxels, none of
//!    │   ╱╲   │         which is inside. The surface does not know of it, and cuts it off: by a third of
//!  ──┼──●──●──┼──       a voxel at the corner of a tetrahedron.
//!    · ╱ ── ╲ ·
//! ```

use glam::{DVec3, IVec3, Vec3};
use rayon::prelude::*;

use super::{Obstacle, ObstacleLeaf, Obstacles, Shape};
use crate::surface::grid::{LEAF_EDGE, offset_in_leaf};
use crate::surface::mesh::Mesh;
use crate::surface::space::Lattice;

/// How deep vertices are inside obstacles, after those that were too deep were moved out.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
#[non_exhaustive]
pub struct DepthTally {
    /// The deepest vertex inside an obstacle, in voxels; 0 if none is.
    pub deepest_voxels: f64,
    /// Vertices that were moved out.
    pub moved_count: u64,
}

/// Vertices that are deeper in an obstacle than this, in voxels, are moved to its surface.
const DEPTH_MAX: f64 = 0.125;

/// Deeper ones are not where an edge was missed, and stay where they are.
const MOVE_MAX: f64 = 1.0;

/// Farther from the obstacle than this at the nearest voxel, in voxels, a vertex is outside: more than √3/2.
const NEAR: f32 = 1.0;

impl Obstacles {
    /// Moves vertices out of obstacles, where the obstacles are sharper than the grid, and tells how deep the
    /// deepest then is. Where it then lies against an obstacle, the surface faces straight into it. `half_width` is that
    /// of the leaves that are kept.
    pub fn clear(&self, mesh: &mut Mesh, lattice: &Lattice, half_width: f32) -> DepthTally {
        let origin = mesh.origin;
        let of_vertex = |(position, normal): (&mut Vec3, &mut Vec3)| {
            let mut tally = DepthTally::default();
            let point = origin + position.as_dvec3();
            let Some((depth, outside)) = self.depth(point, lattice, half_width) else {
                return tally;
            };
            tally.deepest_voxels = depth;
            if DEPTH_MAX < depth && depth < MOVE_MAX {
                *position = (outside - origin).as_vec3();
                *normal = (point - outside).normalize_or_zero().as_vec3();
                // It may have come into another one.
                let left = self.depth(origin + position.as_dvec3(), lattice, half_width);
                tally = DepthTally { deepest_voxels: left.map_or(0.0, |(depth, _)| depth), moved_count: 1 };
            }
            tally
        };
        let both = |one: DepthTally, other: DepthTally| DepthTally {
            deepest_voxels: one.deepest_voxels.max(other.deepest_voxels),
            moved_count: one.moved_count + other.moved_count,
        };
        let vertices = mesh.positions.par_iter_mut().zip(&mut mesh.normals);
        vertices.map(of_vertex).reduce(DepthTally::default, both)
    }

    /// How deep a point of the world is in an obstacle, in voxels, and the nearest place on its surface; none if
    /// it is outside of all.
    pub fn depth(&self, point: DVec3, lattice: &Lattice, half_width: f32) -> Option<(f64, DVec3)> {
        let voxel = lattice.index_from_world(point)?.round().as_ivec3();
        let local = voxel & IVec3::splat(LEAF_EDGE - 1);
        let of_one = |obstacle: &Obstacle| match obstacle.leaf(voxel - local, lattice, half_width) {
            ObstacleLeaf::Outside => None,
            ObstacleLeaf::Near(leaf) if leaf.values[offset_in_leaf(local)] > NEAR => None,
            _ => obstacle.shape().depth(point),
        };
        let depths = self.members.iter().filter_map(|obstacle| of_one(obstacle));
        let deepest = depths.reduce(|one, other| if other.0 > one.0 { other } else { one });
        deepest.map(|(depth, outside)| (depth / lattice.voxel_size, outside))
    }
}

impl Shape {
    /// How deep a point is inside, in world units, and the nearest place on the surface.
    fn depth(&self, point: DVec3) -> Option<(f64, DVec3)> {
        match self {
            Shape::Solid(solid) => solid.depth(point),
            Shape::Sampled(sampled) => sampled.depth(point),
        }
    }
}
