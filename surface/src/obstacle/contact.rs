//! The contact of fluid and obstacles: makes φ and its bounds respect the obstacles (paper, §3.6, Eq. 12).
//!
//! ```text
//!   ──╮    fluid     ╭──    ──╮    fluid     ╭──          φ_0    initial signed distance of the fluid
//!     │              │        │              │            φ_o    signed distance to the obstacle
//!     │              │        │              │
//!     ╰──────────────╯        │              │            φ_0 + φ_o < ε in the void below the fluid: it is
//!           void              │              │            filled, and the fluid touches the obstacle
//!   ────────────────────    ──┴──────────────┴──          without a gap. Beside it, the gap is wider, and
//!         obstacle                obstacle                stays.
//! ```
//!
//! Intersections: φ ≥ −φ_o is a lower bound. It overrides the inner spheres of particles inside the obstacle.
//!
//! Voids: the paper sets φ = −φ_o where φ_0 > 0, φ_o > 0 and φ_0 + φ_o < ε. The filled part then ends in
//! steps of one voxel. Here it ends where φ_0 + φ_o = ε, between voxels. With a steepness k, where φ_o < ε:
//!
//! ```text
//!   φ = max(min(φ_0, k·(φ_0 + φ_o − ε)), −φ_o)
//! ```
//!
//! Where φ_0 > 0 and φ_o > 0, this is the paper's value, unless φ_0 + φ_o is between ε − ε/k and
//! ε + ε/(k − 1). In the fluid near a wall it may be lower than the paper's, with the same sign. (Compared
//! with the paper's steps, the edge around a drop on a floor has three quarters of the bending energy, and
//! vertices are half as deep in the floor.) The same formula applies inside the wall. If only the voxels
//! outside the obstacle had this value, the zero crossing would be interpolated between them and the φ_0
//! inside the wall, which is too large there.
//!
//! The voids are found once, from φ_0. If they were searched again after smoothing, the fluid would climb the
//! walls. Instead, the φ of the formula above is kept as an upper bound where a void was filled, and where
//! fluid is closer to the wall than to its own surface. So the surface does not detach from the wall where
//! the wall was wet.
//!
//! Each voxel is computed alone, so tiles give the same result.

use glam::IVec3;
use rayon::prelude::*;

use super::leaf::ObstacleLeaf;
use crate::grid::{Leaf, ROW_COUNT};
use crate::level_set::{Bounds, NarrowBand};
use crate::parallel::Loops as _;
use crate::simd::{self, Kernel, Lanes};

/// The contact of fluid and obstacles: filled gaps and displaced fluid. All 0 without obstacles.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[non_exhaustive]
pub struct ContactStats {
    /// Voxels between surface and obstacle that were filled.
    pub void_count: u64,
    /// Voxels in an obstacle that are in the r_min sphere of a particle, or nearer to such a sphere than to
    /// the obstacle's surface.
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

/// Makes φ_0 and its bounds respect the obstacles. `obstacle` returns the distances to the obstacles in the
/// leaf with a given origin, clamped to the half width of the band. Fills voids narrower than
/// `void_threshold` voxels; 0 fills none.
pub fn apply_obstacle_constraint(
    obstacle: impl Fn(IVec3) -> ObstacleLeaf + Sync,
    void_threshold: f32,
    band: &mut NarrowBand,
    bounds: &mut Bounds,
) -> ContactStats {
    let half_width = band.half_width;
    let fields = bounds.lower.leaves.par_iter_mut().zip(&mut bounds.upper.leaves);
    let fields = band.phi.leaves.par_iter_mut().zip(fields).zip(band.topology.origins());
    let of_leaf = |((phi, (lower, upper)), &origin): ((&mut Leaf, (&mut Leaf, &mut Leaf)), &IVec3)| {
        let inside = Leaf::splat(-half_width);
        let leaf = obstacle(origin);
        let obstacle = match &leaf {
            ObstacleLeaf::Outside => return ContactStats::default(),
            ObstacleLeaf::Inside => &inside,
            ObstacleLeaf::Near(distances) => distances,
        };
        simd::dispatch(ContactKernel { obstacle, void_threshold, phi, lower, upper })
    };
    fields.halved().map(of_leaf).reduce(ContactStats::default, ContactStats::merge)
}

/// The slope of φ where the filled part ends. A smaller slope leaves voids near the threshold half filled; a
/// larger one ends in steps.
const STEEPNESS: f32 = 4.0;

/// The kernel for one leaf.
struct ContactKernel<'a> {
    obstacle: &'a Leaf,
    void_threshold: f32,
    phi: &'a mut Leaf,
    lower: &'a mut Leaf,
    upper: &'a mut Leaf,
}

impl Kernel for ContactKernel<'_> {
    type Output = ContactStats;

    #[inline(always)]
    fn run<V: Lanes>(self) -> ContactStats {
        let (zero, threshold) = (V::splat(0.0), V::splat(self.void_threshold));
        let mut stats = ContactStats::default();
        for row in 0..ROW_COUNT {
            let obstacle = V::load(self.obstacle.row(row));
            let wall = zero.sub(obstacle);
            let phi = V::load(self.phi.row(row));
            let (lower, upper) = (V::load(self.lower.row(row)), V::load(self.upper.row(row)));
            let gap = phi.add(obstacle).sub(threshold);
            let is_near = obstacle.lt(threshold);
            let filled = V::select(is_near, V::splat(STEEPNESS).mul(gap), phi).min(phi);
            let contact = filled.max(wall);
            let is_held = V::not(V::both(V::not(filled.lt(phi)), wall.lt(phi)));
            let is_held = V::both(is_near, is_held);
            let new_lower = lower.min(contact).max(wall);
            let new_upper = V::select(is_held, upper.min(contact), upper).max(new_lower);
            let is_outside = V::both(zero.lt(phi), zero.lt(obstacle));
            let is_void = V::both(is_outside, gap.lt(zero));
            stats.void_count += u64::from(V::bits(is_void).count_ones());
            let is_displaced = V::both(obstacle.lt(zero), upper.lt(wall));
            stats.displaced_voxel_count += u64::from(V::bits(is_displaced).count_ones());
            contact.max(new_lower).min(new_upper).store(self.phi.row_mut(row));
            new_lower.store(self.lower.row_mut(row));
            new_upper.store(self.upper.row_mut(row));
        }
        stats
    }
}
