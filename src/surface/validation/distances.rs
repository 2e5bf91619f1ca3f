//! Distances from vertices to the nearest particle.
//!
//! Vertices come leaf by leaf, so the leaves around a leaf are looked up once for all of its vertices. A few
//! vertices at a time are compared with the particles of a leaf, one vertex per SIMD lane. The nearest leaves
//! come first: most later leaves are farther from all of these vertices than the particles found so far, and
//! are skipped.

use glam::{DVec3, IVec3, Vec3};
use rayon::prelude::*;

use super::DistanceLimits;
use super::bound_violations::{BoundViolation, MOVE_MAX, corrected_position};
use super::particle_checks::{CheckedRegion, ParticleChecks};
use super::surfaces::{ShapedParticles, Sides};
use crate::surface::grid::{LEAF_EDGE, leaf_steps_within};
use crate::surface::rasterize::ParticleBins;
use crate::surface::simd::{Kernel, Lanes, dispatch};

/// How far interpolation inside a cell may move the surface, in voxels.
pub(super) const CELL_MARGIN: f32 = 0.5;

/// Number of vertices per task.
const CHUNK: usize = 1024;

/// Number of vertices that are compared with particles at once.
pub(super) const LANES: usize = 8;

/// One coordinate of each of `LANES` vertices.
pub(super) type VertexCoordinate = [f32; LANES];

/// Checks how far the vertices of a part are from its particles. Returns the checks, and corrected positions
/// for vertices that are out of bounds.
pub(super) fn check_vertices(part: &CheckedRegion) -> (ParticleChecks, Vec<BoundViolation>) {
    let shaped = ShapedParticles::of(part.bins);
    let longest = shaped.as_ref().map_or(1.0, ShapedParticles::longest);
    let reach = part.radii.max * longest + part.radii.outward();
    let steps = leaf_steps_within(reach + CELL_MARGIN + 2.0 * MOVE_MAX);
    let pieces = part.mesh.positions.par_chunks(CHUNK).enumerate().with_max_len(1);
    let check = |(piece, positions)| {
        let first = piece * CHUNK;
        dispatch(PieceChecks { part, shaped: shaped.as_ref(), steps: &steps, first, positions })
    };
    let pieces: Vec<(ParticleChecks, Vec<BoundViolation>)> = pieces.map(check).collect();
    let checks = pieces.iter().fold(ParticleChecks::EMPTY, |checks, (piece, _)| checks.merge(*piece));
    (checks, pieces.into_iter().flat_map(|(_, violations)| violations).collect())
}

/// The kernel that checks some vertices.
struct PieceChecks<'a> {
    part: &'a CheckedRegion<'a>,
    /// The particles, if they differ in shape.
    shaped: Option<&'a ShapedParticles<'a>>,
    steps: &'a [IVec3],
    /// The index of the first of these vertices in the mesh.
    first: usize,
    positions: &'a [Vec3],
}

impl Kernel for PieceChecks<'_> {
    type Output = (ParticleChecks, Vec<BoundViolation>);

    #[inline(always)]
    fn run<V: Lanes>(self) -> (ParticleChecks, Vec<BoundViolation>) {
        let (mut checks, mut violations) = (ParticleChecks::EMPTY, Vec::new());
        let limits = DistanceLimits::new(&self.part.radii).with_margin(CELL_MARGIN);
        let [least, greatest] = limits.limits();
        let mut near = NearLeaves::empty();
        let mut rest = self.positions;
        while let Some(&first) = rest.first() {
            let (origin, _) = leaf_and_offset(self.part, first);
            let mut locals = [[0.0; LANES]; 3];
            let mut count = 0;
            // The last vertex repeats in unused lanes.
            for lane in 0..LANES {
                if let Some(&position) = rest.get(count) {
                    let (leaf, local) = leaf_and_offset(self.part, position);
                    if count == lane && leaf == origin {
                        [locals[0][lane], locals[1][lane], locals[2][lane]] = local.to_array();
                        count += 1;
                        continue;
                    }
                }
                for local in &mut locals {
                    local[lane] = local[count - 1];
                }
            }
            let first = self.first + self.positions.len() - rest.len();
            let positions = &rest[..count];
            rest = &rest[count..];
            if !self.part.owned.contains(origin) {
                continue;
            }
            near.find_around(self.part.bins, origin, self.steps);
            let distances = near.distances(self.part.bins, &locals);
            let Sides { is_inside_min, is_within_max } = match self.shaped {
                None => Sides {
                    is_inside_min: distances.map(|distance| distance < least),
                    is_within_max: distances.map(|distance| distance <= greatest),
                },
                Some(shaped) => shaped.sides(&near, &locals, &limits),
            };
            for (lane, &position) in positions.iter().enumerate() {
                if is_exempt(self.part, position) {
                    continue;
                }
                checks.vertex_distance_min = checks.vertex_distance_min.min(distances[lane]);
                checks.vertex_distance_max = checks.vertex_distance_max.max(distances[lane]);
                checks.vertices_inside_min += usize::from(is_inside_min[lane]);
                checks.vertices_outside_max += usize::from(!is_within_max[lane]);
                if is_inside_min[lane] | !is_within_max[lane] {
                    let local = Vec3::new(locals[0][lane], locals[1][lane], locals[2][lane]);
                    violations.extend(self.bound_violation(&near, first + lane, origin, local));
                }
            }
        }
        (checks, violations)
    }
}

impl PieceChecks<'_> {
    /// The corrected position of a vertex that is out of bounds. Such vertices are rare.
    #[cold]
    fn bound_violation(
        &self,
        near: &NearLeaves,
        vertex: usize,
        origin: IVec3,
        local: Vec3,
    ) -> Option<BoundViolation> {
        let corrected = origin.as_dvec3() + corrected_position(self.part, near, local)?.as_dvec3();
        let CheckedRegion { mesh, lattice, .. } = self.part;
        Some(BoundViolation { vertex, position: (corrected * lattice.voxel_size - mesh.origin).as_vec3() })
    }
}

/// The origin of the leaf that contains a vertex, and the vertex's position relative to that origin, in
/// voxels.
#[inline(always)]
fn leaf_and_offset(part: &CheckedRegion, position: Vec3) -> (IVec3, Vec3) {
    let index = (part.mesh.origin + position.as_dvec3()) / part.lattice.voxel_size;
    let edge = f64::from(LEAF_EDGE);
    let origin: DVec3 = (index / edge).floor() * edge;
    (origin.as_ivec3(), (index - origin).as_vec3())
}

/// Whether a vertex is exempt from the distance limits.
#[inline(always)]
fn is_exempt(part: &CheckedRegion, position: Vec3) -> bool {
    let CheckedRegion { exempt, mesh, lattice, .. } = part;
    !exempt.is_empty() && exempt.vertex((mesh.origin + position.as_dvec3()) / lattice.voxel_size)
}

/// The leaves around a leaf that hold particles, the nearest first.
pub(super) struct NearLeaves {
    origin: IVec3,
    /// The step to each leaf, in voxels, and its index in the bins.
    pub(super) leaves: Vec<(Vec3, usize)>,
}

impl NearLeaves {
    /// No leaves.
    pub(super) fn empty() -> NearLeaves {
        NearLeaves { origin: IVec3::MAX, leaves: Vec::new() }
    }

    /// Finds the leaves with particles among those at these steps from a leaf.
    #[inline(always)]
    pub(super) fn find_around(&mut self, bins: &ParticleBins, origin: IVec3, steps: &[IVec3]) {
        if self.origin == origin {
            return;
        }
        self.origin = origin;
        self.leaves.clear();
        let found =
            steps.iter().filter_map(|&step| Some((step.as_vec3(), bins.topology.find(origin + step)?)));
        self.leaves.extend(found);
    }

    /// The distances from points, relative to the leaf, to the nearest particle in these leaves.
    #[inline(always)]
    fn distances(&self, bins: &ParticleBins, points: &[VertexCoordinate; 3]) -> VertexCoordinate {
        let mut nearest = [f32::INFINITY; LANES];
        for &(step, leaf) in &self.leaves {
            let mut locals = *points;
            for axis in 0..3 {
                for lane in 0..LANES {
                    locals[axis][lane] = points[axis][lane] - step[axis];
                }
            }
            let farthest = nearest.iter().fold(0.0f32, |farthest, &nearest| farthest.max(nearest));
            if squared_gap(&locals) >= farthest {
                continue;
            }
            let [x, y, z] = locals;
            for particle in bins.in_leaf(leaf) {
                for lane in 0..LANES {
                    let to_particle = *particle - Vec3::new(x[lane], y[lane], z[lane]);
                    let squared = to_particle.length_squared();
                    nearest[lane] = if squared < nearest[lane] { squared } else { nearest[lane] };
                }
            }
        }
        nearest.map(f32::sqrt)
    }
}

/// The squared distance between a leaf and the box around points given relative to it. It is a lower bound
/// for every computed distance between a point and a particle of the leaf, because rounding is monotonic.
#[inline(always)]
pub(super) fn squared_gap(points: &[VertexCoordinate; 3]) -> f32 {
    let gap = |axis: usize| {
        let column = &points[axis];
        let (mut least, mut most) = (column[0], column[0]);
        for &value in column {
            least = if value < least { value } else { least };
            most = if value > most { value } else { most };
        }
        (least - LEAF_EDGE as f32).max(-most).max(0.0)
    };
    Vec3::new(gap(0), gap(1), gap(2)).length_squared()
}

/// Whether a point, relative to the leaf at `origin`, is inside the sphere of this radius of any particle, or
/// inside its ellipsoid.
pub(super) fn is_inside_one(
    bins: &ParticleBins,
    shaped: Option<&ShapedParticles>,
    origin: IVec3,
    point: Vec3,
    radius: f32,
) -> bool {
    let longest = shaped.map_or(1.0, ShapedParticles::longest);
    let mut near = NearLeaves::empty();
    near.find_around(bins, origin, &leaf_steps_within(radius * longest));
    let points = point.to_array().map(|axis| [axis; LANES]);
    match shaped {
        None => near.distances(bins, &points)[0] < radius,
        Some(shaped) => {
            let limits = DistanceLimits { radii: [radius; 2], from_spheres: [0.0; 2] };
            shaped.sides(&near, &points, &limits).is_inside_min[0]
        }
    }
}
