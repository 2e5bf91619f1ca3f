//! Distances from voxels to particles, for any kind of particle.
//!
//! ```text
//!   uniform balls   one field: the distance to the nearest center; subtracting a radius gives the distance
//!                   to each of the three unions
//!   others          three fields: the signed distance to each union, because the nearest particle may differ
//!                   from union to union
//! ```

use rayon::prelude::*;

use super::bin::ParticleBins;
use super::culling::Culling;
use super::ellipsoid::{BallShape, EllipsoidShape, Primitives};
use super::signed_distance::Below;
use super::sphere::{ParticlePackets, nearest_distances};
use super::{Radii, keep};
use crate::grid::{Field, Leaf, LeafMask, Topology};
use crate::parallel::Loops as _;
use crate::particles::Shapes;
use crate::simd;

/// Names one of the three unions of spheres.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum SphereUnion {
    /// S_max: φ_max in the paper, the lower bound of φ.
    Max,
    /// S_0, where smoothing starts.
    Init,
    /// S_min: φ_min in the paper, the upper bound of φ.
    Min,
}

/// Distances in voxels, by leaf.
pub(super) enum SphereDistances {
    /// To the nearest center; [`OUT_OF_REACH`](super::sphere::OUT_OF_REACH) beyond the reach.
    Nearest(Field),
    /// To S_max, S_0 and S_min, negative inside. Deep inside, any negative number; beyond the reach,
    /// infinite.
    Signed {
        /// In the order of [`SphereUnion`].
        fields: [Field; 3],
        /// True if all values outside the unions are exact, rather than only those adjacent to an inside
        /// voxel.
        is_exact_outside: bool,
    },
}

/// Computes distances to particles.
pub(super) enum DistanceSolver<'a> {
    /// Particle centers, and the reach in voxels.
    Centers(ParticlePackets<'a>, f32),
    Balls(Primitives<BallShape>),
    Ellipsoids(Primitives<EllipsoidShape>),
}

impl<'a> DistanceSolver<'a> {
    /// A solver for these particles.
    pub(super) fn new(bins: &'a ParticleBins, radii: Radii) -> DistanceSolver<'a> {
        match &bins.shapes {
            Shapes::Uniform => DistanceSolver::Centers(ParticlePackets::new(bins), radii.exact_reach(1.0)),
            Shapes::Scaled(scales) => {
                DistanceSolver::Balls(Primitives::new(bins, radii, |particle| BallShape(scales[particle])))
            }
            Shapes::Ellipsoids(ellipsoids) => {
                DistanceSolver::Ellipsoids(Primitives::new(bins, radii, |particle| {
                    EllipsoidShape::new(ellipsoids[particle])
                }))
            }
        }
    }

    /// The distances in these leaves. Leaves in `known` are copied.
    pub(super) fn distances(
        &self,
        leaves: &Topology,
        culling: &Culling,
        known: Option<(&Topology, &SphereDistances)>,
    ) -> SphereDistances {
        let settled = |origin| culling.settled(origin);
        match self {
            DistanceSolver::Centers(packets, reach) => {
                let known = |origin| {
                    let (topology, distances) = known?;
                    topology.find(origin).map(|leaf| &distances.field(SphereUnion::Max).leaves[leaf])
                };
                SphereDistances::Nearest(nearest_distances(packets, leaves, *reach, settled, known))
            }
            DistanceSolver::Balls(primitives) => {
                let fields = primitives.distances(leaves, settled, |origin| known_leaves(known, origin));
                SphereDistances::Signed { fields, is_exact_outside: true }
            }
            DistanceSolver::Ellipsoids(primitives) => {
                let fields = primitives.distances(leaves, settled, |origin| known_leaves(known, origin));
                SphereDistances::Signed { fields, is_exact_outside: false }
            }
        }
    }
}

/// The three known leaves at an origin, if any.
fn known_leaves<'k>(
    known: Option<(&Topology, &'k SphereDistances)>,
    origin: glam::IVec3,
) -> Option<[&'k Leaf; 3]> {
    let (topology, distances) = known?;
    let leaf = topology.find(origin)?;
    let SphereDistances::Signed { fields, .. } = distances else { return None };
    Some(fields.each_ref().map(|field| &field.leaves[leaf]))
}

impl SphereDistances {
    /// The field that holds the distances to a union.
    pub(super) fn field(&self, sphere: SphereUnion) -> &Field {
        match self {
            SphereDistances::Nearest(nearest) => nearest,
            SphereDistances::Signed { fields, .. } => &fields[sphere as usize],
        }
    }

    /// Takes the same field by value, for its last use.
    pub(super) fn take(&mut self, sphere: SphereUnion) -> Field {
        match self {
            SphereDistances::Nearest(nearest) => std::mem::replace(nearest, Field { leaves: Vec::new() }),
            SphereDistances::Signed { fields, .. } => {
                std::mem::replace(&mut fields[sphere as usize], Field { leaves: Vec::new() })
            }
        }
    }

    /// True if this is the last use of the union's field. The unions are used in the order S_0, S_max, S_min.
    pub(super) fn is_last(&self, sphere: SphereUnion) -> bool {
        match self {
            SphereDistances::Nearest(_) => sphere == SphereUnion::Min,
            SphereDistances::Signed { .. } => true,
        }
    }

    /// The value to subtract from the field so that it is negative inside the union.
    pub(super) fn level(&self, sphere: SphereUnion, radii: Radii) -> f32 {
        match (self, sphere) {
            (SphereDistances::Signed { .. }, _) => 0.0,
            (_, SphereUnion::Max) => radii.max,
            (_, SphereUnion::Init) => radii.init,
            (_, SphereUnion::Min) => radii.min,
        }
    }

    /// True if all values outside the unions are exact, rather than only those adjacent to an inside voxel.
    pub(super) fn is_exact_outside(&self) -> bool {
        !matches!(self, SphereDistances::Signed { is_exact_outside: false, .. })
    }

    /// The voxels inside a union.
    pub(super) fn inside(&self, sphere: SphereUnion, radii: Radii) -> Vec<LeafMask> {
        let limit = self.level(sphere, radii);
        let below = |leaf| simd::dispatch(Below { leaf, limit });
        self.field(sphere).leaves.par_iter().halved().map(below).collect()
    }

    /// Keeps only these leaves, in order.
    pub(super) fn keep(&mut self, kept: &[usize]) {
        match self {
            SphereDistances::Nearest(nearest) => keep(nearest, kept),
            SphereDistances::Signed { fields, .. } => {
                // Fields that were taken are empty.
                let fields = fields.par_iter_mut().halved().filter(|field| !field.leaves.is_empty());
                fields.for_each(|field| keep(field, kept));
            }
        }
    }
}
