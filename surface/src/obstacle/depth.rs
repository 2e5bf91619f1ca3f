//! Measures how deep vertices are inside obstacles, and moves vertices out where contouring cut off a sharp
//! edge.
//!
//! ```text
//!    · ────── ·         a sharp edge of the obstacle lies between voxels, and none of these voxels is inside
//!    │   ╱╲   │         the obstacle. Contouring misses the edge and cuts it off: by a third of a voxel at
//!  ──┼──●──●──┼──       the corner of a tetrahedral obstacle.
//!    · ╱ ── ╲ ·
//! ```

use glam::{DVec3, IVec3, Vec3};
use rayon::prelude::*;

use super::{Obstacle, ObstacleLeaf, ObstacleSdf, Obstacles};
use crate::grid::{LEAF_EDGE, offset_in_leaf};
use crate::mesh::Mesh;
use crate::parallel::Loops as _;
use crate::space::Lattice;

/// How deep vertices are inside obstacles, after vertices that were too deep were moved out.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
#[non_exhaustive]
pub struct DepthStats {
    /// The depth of the deepest vertex inside an obstacle, in voxels; 0 if all are outside.
    pub deepest_voxels: f64,
    /// Number of vertices that were moved out.
    pub moved_count: u64,
}

/// Vertices deeper inside an obstacle than this, in voxels, are moved to its surface.
const DEPTH_MAX: f64 = 0.125;

/// Vertices deeper than this, in voxels, are not moved: the cause is not an edge that contouring missed.
const MOVE_MAX: f64 = 1.0;

/// A vertex is outside if the nearest voxel is farther from the obstacle than this, in voxels. The nearest
/// voxel is at most √3/2 voxels away from the vertex.
const NEAR: f32 = 1.0;

impl Obstacles {
    /// Moves vertices out of obstacles at edges that the grid cannot resolve. The normal of a moved vertex
    /// points into the obstacle. Returns the depth of the deepest vertex afterwards. `half_width` is the half
    /// width of the cached leaves.
    pub fn move_vertices_out(&self, mesh: &mut Mesh, lattice: &Lattice, half_width: f32) -> DepthStats {
        let origin = mesh.origin;
        let of_vertex = |(position, normal): (&mut Vec3, &mut Vec3)| {
            let mut stats = DepthStats::default();
            let point = origin + position.as_dvec3();
            let Some((depth, outside)) = self.depth(point, lattice, half_width) else {
                return stats;
            };
            stats.deepest_voxels = depth;
            if DEPTH_MAX < depth && depth < MOVE_MAX {
                *position = (outside - origin).as_vec3();
                *normal = (point - outside).normalize_or_zero().as_vec3();
                // The vertex may now be inside another obstacle.
                let left = self.depth(origin + position.as_dvec3(), lattice, half_width);
                stats = DepthStats { deepest_voxels: left.map_or(0.0, |(depth, _)| depth), moved_count: 1 };
            }
            stats
        };
        let both = |one: DepthStats, other: DepthStats| DepthStats {
            deepest_voxels: one.deepest_voxels.max(other.deepest_voxels),
            moved_count: one.moved_count + other.moved_count,
        };
        let vertices = mesh.positions.par_iter_mut().zip(&mut mesh.normals);
        vertices.halved().map(of_vertex).reduce(DepthStats::default, both)
    }

    /// How deep a world position is inside an obstacle, in voxels, and the nearest point on the surface of
    /// that obstacle. If it is inside several, the one in which it is deepest counts. `None` if it is outside
    /// of all.
    pub fn depth(&self, point: DVec3, lattice: &Lattice, half_width: f32) -> Option<(f64, DVec3)> {
        let voxel = lattice.index_from_world(point)?.round().as_ivec3();
        let local = voxel & IVec3::splat(LEAF_EDGE - 1);
        let of_one = |obstacle: &Obstacle| match obstacle.leaf(voxel - local, lattice, half_width) {
            ObstacleLeaf::Outside => None,
            ObstacleLeaf::Near(leaf) if leaf.values[offset_in_leaf(local)] > NEAR => None,
            _ => obstacle.sdf().depth(point),
        };
        let depths = self.members.iter().filter_map(|obstacle| of_one(obstacle));
        let deepest = depths.reduce(|one, other| if other.0 > one.0 { other } else { one });
        deepest.map(|(depth, outside)| (depth / lattice.voxel_size, outside))
    }
}

impl ObstacleSdf {
    /// How deep a point is inside, world units, and the nearest point on the surface. `None` if the point is
    /// outside.
    fn depth(&self, point: DVec3) -> Option<(f64, DVec3)> {
        match self {
            ObstacleSdf::Mesh(solid) => solid.depth(point),
            ObstacleSdf::Grid(sampled) => sampled.depth(point),
        }
    }
}
