//! How far voxels are from the particles, whatever these are.
//!
//! ```text
//!   balls, all alike     the distance to the nearest centre: less a radius it is that to each of the unions
//!   others               the signed distances to the three unions, each by itself: another particle may be the
//!                        nearest to another union
//! ```

use rayon::prelude::*;

use super::bin::ParticleBins;
use super::ellipsoid::{Ball, Bodies, Stretched};
use super::need::Need;
use super::signed_distance::Below;
use super::sphere::{Eights, nearest_distances};
use super::{Radii, keep};
use crate::surface::grid::{Field, Leaf, LeafMask, Topology};
use crate::surface::particles::Shapes;
use crate::surface::simd;

/// Which of the three unions of spheres.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Sphere {
    /// S_max: φ_max of the paper is the lower bound of φ.
    Max,
    /// S_0, where smoothing starts.
    Init,
    /// S_min: φ_min of the paper is the upper bound of φ.
    Min,
}

/// Distances in voxels, leaf by leaf.
pub(super) enum Distances {
    /// To the nearest centre; [`OUT_OF_REACH`](super::sphere::OUT_OF_REACH) where that is too far.
    Nearest(Field),
    /// To S_max, S_0 and S_min, negative inside. Deep inside some other negative number, out of reach infinite.
    Signed {
        /// In the order of [`Sphere`].
        fields: [Field; 3],
        /// Whether values outside are exact, and not only those beside a voxel inside.
        is_exact_outside: bool,
    },
}

/// What distances are taken with.
pub(super) enum Gauge<'a> {
    /// Centres, and how far from them.
    Centers(Eights<'a>, f32),
    Balls(Bodies<Ball>),
    Ellipsoids(Bodies<Stretched>),
}

impl<'a> Gauge<'a> {
    /// For these particles.
    pub(super) fn new(bins: &'a ParticleBins, radii: Radii) -> Gauge<'a> {
        match &bins.shapes {
            Shapes::Balls => Gauge::Centers(Eights::new(bins), radii.exact_reach(1.0)),
            Shapes::Scaled(scales) => {
                Gauge::Balls(Bodies::new(bins, radii, |particle| Ball(scales[particle])))
            }
            Shapes::Ellipsoids(ellipsoids) => {
                Gauge::Ellipsoids(Bodies::new(bins, radii, |particle| Stretched::new(ellipsoids[particle])))
            }
        }
    }

    /// The distances of these leaves. What is `known` already is copied.
    pub(super) fn distances(
        &self,
        leaves: &Topology,
        need: &Need,
        known: Option<(&Topology, &Distances)>,
    ) -> Distances {
        let settled = |origin| need.settled(origin);
        match self {
            Gauge::Centers(eights, reach) => {
                let known = |origin| {
                    let (topology, distances) = known?;
                    topology.find(origin).map(|leaf| &distances.field(Sphere::Max).leaves[leaf])
                };
                Distances::Nearest(nearest_distances(eights, leaves, *reach, settled, known))
            }
            Gauge::Balls(bodies) => {
                let fields = bodies.distances(leaves, settled, |origin| known_leaves(known, origin));
                Distances::Signed { fields, is_exact_outside: true }
            }
            Gauge::Ellipsoids(bodies) => {
                let fields = bodies.distances(leaves, settled, |origin| known_leaves(known, origin));
                Distances::Signed { fields, is_exact_outside: false }
            }
        }
    }
}

/// The three leaves of a place where they are known.
fn known_leaves<'k>(known: Option<(&Topology, &'k Distances)>, origin: glam::IVec3) -> Option<[&'k Leaf; 3]> {
    let (topology, distances) = known?;
    let leaf = topology.find(origin)?;
    let Distances::Signed { fields, .. } = distances else { return None };
    Some(fields.each_ref().map(|field| &field.leaves[leaf]))
}

impl Distances {
    /// The field from which the distances to a union are told.
    pub(super) fn field(&self, sphere: Sphere) -> &Field {
        match self {
            Distances::Nearest(nearest) => nearest,
            Distances::Signed { fields, .. } => &fields[sphere as usize],
        }
    }

    /// The same for whoever is the last to ask for it.
    pub(super) fn take(&mut self, sphere: Sphere) -> Field {
        match self {
            Distances::Nearest(nearest) => std::mem::replace(nearest, Field { leaves: Vec::new() }),
            Distances::Signed { fields, .. } => {
                std::mem::replace(&mut fields[sphere as usize], Field { leaves: Vec::new() })
            }
        }
    }

    /// Whether nobody asks for the field of this union after that for the distances to it. They are asked for in the
    /// order S_0, S_max, S_min.
    pub(super) fn is_last(&self, sphere: Sphere) -> bool {
        match self {
            Distances::Nearest(_) => sphere == Sphere::Min,
            Distances::Signed { .. } => true,
        }
    }

    /// What is to be taken from the field's values so that they are negative inside a union.
    pub(super) fn level(&self, sphere: Sphere, radii: Radii) -> f32 {
        match (self, sphere) {
            (Distances::Signed { .. }, _) => 0.0,
            (_, Sphere::Max) => radii.max,
            (_, Sphere::Init) => radii.init,
            (_, Sphere::Min) => radii.min,
        }
    }

    /// Whether values outside are exact, and not only those beside a voxel inside.
    pub(super) fn is_exact_outside(&self) -> bool {
        !matches!(self, Distances::Signed { is_exact_outside: false, .. })
    }

    /// The voxels inside a union.
    pub(super) fn inside(&self, sphere: Sphere, radii: Radii) -> Vec<LeafMask> {
        let limit = self.level(sphere, radii);
        let below = |leaf| simd::dispatch(Below { leaf, limit });
        self.field(sphere).leaves.par_iter().map(below).collect()
    }

    /// Leaves only these leaves, in order.
    pub(super) fn keep(&mut self, kept: &[usize]) {
        match self {
            Distances::Nearest(nearest) => keep(nearest, kept),
            Distances::Signed { fields, .. } => {
                // What was taken is not here any more.
                let fields = fields.iter_mut().filter(|field| !field.leaves.is_empty());
                fields.for_each(|field| keep(field, kept));
            }
        }
    }
}
