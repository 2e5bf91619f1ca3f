//! The contact of fluid and obstacles: fills narrow gaps, and cuts the fluid off at the obstacles (paper,
//! §3.6, Eq. 12).
//!
//! ```text
//!        before               filled                smoothed, cut
//!
//!      ──────────╮          ──────────╮             ──────────╮
//!       fluid     │          fluid     │                       ╲        φ    signed distance of the fluid
//!      ──────────╯           ┊          ╲              ┊        ╲       φ_o  signed distance to the obstacle
//!   ── gap ───────────    ── ┊ ──────────┊ ──       ── ┴─────────┴ ──
//!        obstacle            ╰───────────╯
//! ```
//!
//! Gaps: the paper sets φ = −φ_o where φ > 0, φ_o > 0 and φ + φ_o < ε, which ends in steps of one voxel.
//! Here the fluid grows toward the wall and continues straight into it. It grows by a distance c, which has no
//! step and fades out at w = ε + 1 voxels from the wall:
//!
//! ```text
//!   φ_0 − c(φ_o)       c = ε (1 − φ_o/w)²     outside the obstacle, up to φ_o = w
//!                      c = ε − φ_o            inside, down to φ_o = −3
//! ```
//!
//! A gap narrower than ε is filled, and one a little wider becomes narrower, so a gap that widens slowly does
//! not open suddenly. φ_0 − c is no distance, so smoothing begins with a redistancing. A wall that is wet stays
//! wet: there, φ stays below φ_0 − c + 1 or −φ_o. The upper bound of kernels, which is near φ_0, also moves with it.
//!
//! Intersections: φ = max(φ, −φ_o), after smoothing and the offset. Smoothing sees the fluid inside the
//! obstacle instead of an edge at the wall, so it neither rounds that edge nor lifts it off the wall, and the
//! contact line is as smooth as the rest of the surface. But the grid cannot store a sharp edge, nor a film
//! that is thinner than a voxel, as above a ball that is nearly immersed: they would be scalloped and torn. So
//! the maximum is a smooth one, which rounds the edge with a radius of about a voxel, and ends a film where it
//! becomes thinner than k/2 = 1.25 voxels:
//!
//! ```text
//!   max(a, b) + k/4 (1 − |a − b|/k)²   for |a − b| < k, with a = φ and b = −φ_o
//! ```
//!
//! At a particle φ ≤ −r_min, so with k ≤ 4 r_min it stays inside if it is k/4 away from the wall, except between
//! voxels.
//!
//! Each voxel is computed alone, so tiles give the same result.

use glam::{DVec3, IVec3, Vec3};
use rayon::prelude::*;

use super::{Obstacle, ObstacleLeaf, ObstacleSdf, Obstacles};
use crate::grid::{Field, LEAF_EDGE, Leaf, ROW_COUNT, offset_in_leaf};
use crate::level_set::{NEAREST_TO_ZERO, NarrowBand};
use crate::mesh::Mesh;
use crate::parallel::Loops as _;
use crate::rasterize::Start;
use crate::simd::{self, Kernel, Lanes};
use crate::space::Lattice;

/// The contact of fluid and obstacles: filled gaps and displaced fluid. All 0 without obstacles.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[non_exhaustive]
pub struct ContactStats {
    /// Voxels between surface and obstacle that were filled.
    pub void_count: u64,
    /// Voxels in an obstacle that are in the r_min sphere of a particle, or near such a sphere and nearer to it
    /// than to the obstacle's surface.
    pub displaced_voxel_count: u64,
    /// Particles inside an obstacle.
    pub particle_count: usize,
}

impl ContactStats {
    /// The sums of both statistics.
    pub fn merge(self, other: ContactStats) -> ContactStats {
        ContactStats {
            void_count: self.void_count + other.void_count,
            displaced_voxel_count: self.displaced_voxel_count + other.displaced_voxel_count,
            particle_count: self.particle_count + other.particle_count,
        }
    }
}

/// Fills the gaps between φ_0 and the obstacles that are narrower than `void_threshold` voxels; 0 fills none.
/// Lets the bounds allow that, and the cut by [`cut_off_at_obstacles`]. `start` is what φ_0 is made of.
/// `obstacle` returns the distances to the obstacles in the leaf with a given origin, clamped to the half width
/// of the band.
pub fn fill_gaps_at_obstacles(
    obstacle: impl Fn(IVec3) -> ObstacleLeaf + Sync,
    void_threshold: f32,
    start: Start,
    band: &mut NarrowBand,
    [lower, upper]: [&mut Field; 2],
) -> ContactStats {
    let half_width = band.half_width;
    let fields = lower.leaves.par_iter_mut().zip(&mut upper.leaves);
    let fields = band.phi.leaves.par_iter_mut().zip(fields).zip(band.topology.origins());
    let of_leaf = |((phi, (lower, upper)), &origin): ((&mut Leaf, (&mut Leaf, &mut Leaf)), &IVec3)| {
        let inside = Leaf::splat(-half_width);
        let leaf = obstacle(origin);
        let obstacle = match &leaf {
            ObstacleLeaf::Outside => return ContactStats::default(),
            ObstacleLeaf::Inside => &inside,
            ObstacleLeaf::Near(distances) => distances,
        };
        simd::dispatch(FillKernel { obstacle, void_threshold, start, half_width, phi, lower, upper })
    };
    fields.halved().map(of_leaf).reduce(ContactStats::default, ContactStats::merge)
}

/// How deep the fluid continues into an obstacle, in voxels: so far that the smoothing of its end does not
/// reach the wall.
const CONTINUATION: f32 = 3.0;

/// Fills the gaps in one leaf.
struct FillKernel<'a> {
    obstacle: &'a Leaf,
    void_threshold: f32,
    start: Start,
    half_width: f32,
    phi: &'a mut Leaf,
    lower: &'a mut Leaf,
    upper: &'a mut Leaf,
}

impl Kernel for FillKernel<'_> {
    type Output = ContactStats;

    #[inline(always)]
    fn run<V: Lanes>(self) -> ContactStats {
        let (zero, one) = (V::splat(0.0), V::splat(1.0));
        let (threshold, least) = (V::splat(self.void_threshold), V::splat(-self.half_width));
        // Where φ_0 is at least the half width, the fluid does not grow.
        let growth_max = V::splat(self.half_width - 1.0);
        let per_width = V::splat(1.0 / (self.void_threshold + 1.0));
        let mut stats = ContactStats::default();
        for row in 0..ROW_COUNT {
            let obstacle = V::load(self.obstacle.row(row));
            let wall = zero.sub(obstacle);
            let phi = V::load(self.phi.row(row));
            let (lower, upper) = (V::load(self.lower.row(row)), V::load(self.upper.row(row)));
            let faded = one.sub(obstacle.max(zero).mul(per_width)).max(zero);
            let depth = wall.max(zero).min(V::splat(CONTINUATION));
            let growth = threshold.mul(faded).mul(faded).add(depth).min(growth_max);
            let filled = phi.sub(growth).max(least);
            let is_filled = V::both(zero.lt(growth), filled.lt(zero));
            let is_outside = V::both(zero.lt(phi), zero.lt(obstacle));
            let is_void = V::both(is_outside, filled.lt(zero));
            stats.void_count += u64::from(V::bits(is_void).count_ones());
            let is_displaced = V::both(obstacle.lt(zero), upper.lt(wall));
            stats.displaced_voxel_count += u64::from(V::bits(is_displaced).count_ones());
            filled.store(self.phi.row_mut(row));
            V::select(is_filled, least, lower.min(filled)).store(self.lower.row_mut(row));
            let is_wet = V::both(V::both(zero.lt(obstacle), zero.lt(faded)), filled.lt(zero));
            let moved = match self.start {
                Start::Spheres => upper,
                Start::Kernels => upper.sub(growth),
            };
            let held = V::select(is_wet, moved.min(filled.add(one)), upper);
            held.max(wall).store(self.upper.row_mut(row));
        }
        stats
    }
}

/// Cuts the fluid off at the obstacles: φ = max(φ, −φ_o), where the edge is rounded over `rounding` voxels, k
/// in the module. `obstacle` returns the distances to the obstacles in the leaf with a given origin.
/// Keeps |φ| ≥ [`NEAREST_TO_ZERO`]: a wall that is nearer to a voxel passes beside it.
pub fn cut_off_at_obstacles(
    obstacle: impl Fn(IVec3) -> ObstacleLeaf + Sync,
    rounding: f32,
    band: &mut NarrowBand,
) {
    let half_width = band.half_width;
    let leaves = band.phi.leaves.par_iter_mut().zip(band.topology.origins());
    leaves.halved().for_each(|(phi, &origin)| match obstacle(origin) {
        ObstacleLeaf::Outside => {}
        ObstacleLeaf::Inside => *phi = Leaf::splat(half_width),
        ObstacleLeaf::Near(obstacle) => {
            let per_rounding = if rounding > 0.0 { 1.0 / rounding } else { f32::MAX };
            simd::dispatch(CutKernel { obstacle: &obstacle, rounding, per_rounding, half_width, phi });
        }
    });
}

/// The rounding with which the grid stores edges without scallops, and thin films without holes, in voxels.
pub const ROUNDING_MAX: f32 = 2.5;

/// The width over which edges are rounded, k in the module, in voxels, where particles are at least `depth`
/// voxels below the surface.
pub fn edge_rounding(depth: f32) -> f32 {
    (4.0 * depth).clamp(0.0, ROUNDING_MAX)
}

/// The least distance from an obstacle, in voxels, at which a point that was `depth` voxels below the surface is
/// still in the fluid after the [cut](cut_off_at_obstacles), with the largest rounding.
pub fn edge_clearance(depth: f32) -> f32 {
    // There, the smooth maximum of −depth and −distance is 0. From a depth of k/4, the distance is the smaller one.
    let (k, depth) = (ROUNDING_MAX, depth.max(0.0));
    if depth < 0.25 * k { depth + k - 2.0 * (k * depth).sqrt() } else { 0.25 * k }
}

/// Cuts off the fluid in one leaf.
struct CutKernel<'a> {
    obstacle: &'a Leaf,
    rounding: f32,
    per_rounding: f32,
    half_width: f32,
    phi: &'a mut Leaf,
}

impl Kernel for CutKernel<'_> {
    type Output = ();

    #[inline(always)]
    fn run<V: Lanes>(self) {
        let (zero, one, least) = (V::splat(0.0), V::splat(1.0), V::splat(NEAREST_TO_ZERO));
        let (quarter, per_rounding) = (V::splat(0.25 * self.rounding), V::splat(self.per_rounding));
        for row in 0..ROW_COUNT {
            let (obstacle, phi) = (V::load(self.obstacle.row(row)), V::load(self.phi.row(row)));
            let wall = zero.sub(obstacle);
            let apart = phi.sub(wall).abs().mul(per_rounding);
            let near = one.sub(apart).max(zero);
            let cut = wall.max(phi).add(near.mul(near).mul(quarter));
            let is_outside = V::not(cut.lt(zero));
            let cut = V::select(is_outside, cut.max(least), cut.min(zero.sub(least)));
            cut.min(V::splat(self.half_width)).store(self.phi.row_mut(row));
        }
    }
}

// Measures how deep vertices are inside obstacles, and moves vertices out where contouring cut off a sharp
// edge.
//
//    · ────── ·         a sharp edge of the obstacle lies between voxels, and none of these voxels is inside
//    │   ╱╲   │         the obstacle. Contouring misses the edge and cuts it off: by a third of a voxel at
//  ──┼──●──●──┼──       the corner of a tetrahedral obstacle.
//    · ╱ ── ╲ ·

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
