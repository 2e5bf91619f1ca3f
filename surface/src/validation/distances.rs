//! Distances from vertices to the nearest particle.
//!
//! Vertices come leaf by leaf, so the leaves around a leaf are looked up once for all of its vertices. A few
//! vertices at a time are compared with the particles of a leaf, one vertex per SIMD lane. The nearest leaves
//! come first: most later leaves are farther from all of these vertices than the particles found so far, and
//! are skipped.

use glam::{DVec3, IVec3, Vec3};
use rayon::prelude::*;

use super::surfaces::{ShapedParticles, Sides, distances_and_outward};
use super::{CheckedRegion, DistanceLimits, ParticleChecks};
use crate::grid::{LEAF_EDGE, leaf_steps_within};
use crate::rasterize::ParticleBins;
use crate::simd::{Kernel, Lanes, dispatch, greatest};

/// How far interpolation inside a cell may move the surface, in voxels.
pub(super) const CELL_MARGIN: f32 = 0.5;

/// Number of vertices per task.
const CHUNK: usize = 1024;

/// Number of vertices that are compared with particles at once.
const GROUP_SIZE: usize = 8;

/// Some points, relative to a leaf, in voxels.
pub(super) struct PointGroup {
    /// x, y and z of each point.
    axes: [[f32; GROUP_SIZE]; 3],
    /// Corners of their bounding box.
    low: Vec3,
    high: Vec3,
}

impl PointGroup {
    #[inline(always)]
    fn new(axes: [[f32; GROUP_SIZE]; 3]) -> PointGroup {
        let low = axes.map(|axis| axis.into_iter().fold(f32::INFINITY, f32::min));
        let high = axes.map(|axis| axis.into_iter().fold(f32::NEG_INFINITY, f32::max));
        PointGroup { axes, low: Vec3::from(low), high: Vec3::from(high) }
    }

    /// x, y and z, relative to the leaf at a step from this one.
    #[inline(always)]
    pub(super) fn relative_to<V: Lanes>(&self, step: Vec3) -> [V; 3] {
        let along = |axis: usize| V::load(&self.axes[axis]).sub(V::splat(step[axis]));
        [along(0), along(1), along(2)]
    }

    /// The squared distance between the leaf at a step from this one and the bounding box. It is a lower
    /// bound for every computed distance between a point and a particle of that leaf, because rounding is
    /// monotonic.
    #[inline(always)]
    pub(super) fn squared_gap(&self, step: Vec3) -> f32 {
        let (low, high) = (self.low - step, self.high - step);
        (low - LEAF_EDGE as f32).max(-high).max(Vec3::ZERO).length_squared()
    }

    /// One of the points.
    #[inline(always)]
    pub(super) fn point(&self, lane: usize) -> Vec3 {
        Vec3::new(self.axes[0][lane], self.axes[1][lane], self.axes[2][lane])
    }
}

/// From a particle to points.
#[inline(always)]
pub(super) fn from_particle<V: Lanes>([x, y, z]: [V; 3], particle: Vec3) -> [V; 3] {
    [x.sub(V::splat(particle.x)), y.sub(V::splat(particle.y)), z.sub(V::splat(particle.z))]
}

/// The squared lengths of vectors.
#[inline(always)]
pub(super) fn length_squared<V: Lanes>([x, y, z]: [V; 3]) -> V {
    x.mul(x).add(y.mul(y)).add(z.mul(z))
}

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
        let [nearest_allowed, farthest_allowed] = limits.limits();
        let mut near = NearLeaves::empty();
        let mut rest = self.positions;
        while let Some(&first) = rest.first() {
            let (origin, _) = leaf_and_offset(self.part, first);
            let mut locals = [[0.0; GROUP_SIZE]; 3];
            let mut count = 0;
            // The last vertex repeats in unused lanes.
            for lane in 0..GROUP_SIZE {
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
            let points = PointGroup::new(locals);
            let nearest = near.distances::<V>(self.part.bins, &points);
            let Sides { inside_min_bits, within_max_bits } = match self.shaped {
                None => Sides {
                    inside_min_bits: V::bits(nearest.lt(V::splat(nearest_allowed))),
                    within_max_bits: !V::bits(V::splat(farthest_allowed).lt(nearest)),
                },
                Some(shaped) => {
                    let mut sides = shaped.sides::<V>(&near, &points, &limits.of_shapes());
                    if limits.has_balls {
                        sides.inside_min_bits = V::bits(nearest.lt(V::splat(nearest_allowed)));
                    }
                    sides
                }
            };
            let mut distances = [0.0; GROUP_SIZE];
            nearest.store(&mut distances);
            for (lane, &position) in positions.iter().enumerate() {
                if is_exempt(self.part, position) {
                    continue;
                }
                checks.vertex_distance_min = checks.vertex_distance_min.min(distances[lane]);
                checks.vertex_distance_max = checks.vertex_distance_max.max(distances[lane]);
                let is_set = |bits: u8| bits >> lane & 1 == 1;
                checks.vertices_inside_min += usize::from(is_set(inside_min_bits));
                checks.vertices_outside_max += usize::from(!is_set(within_max_bits));
                if is_set(inside_min_bits | !within_max_bits) {
                    violations.extend(self.bound_violation(&near, first + lane, origin, points.point(lane)));
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
    fn find_around(&mut self, bins: &ParticleBins, origin: IVec3, steps: &[IVec3]) {
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
    fn distances<V: Lanes>(&self, bins: &ParticleBins, points: &PointGroup) -> V {
        let mut nearest = V::splat(f32::INFINITY);
        let mut farthest = f32::INFINITY;
        for &(step, leaf) in &self.leaves {
            if points.squared_gap(step) >= farthest {
                continue;
            }
            let [x, y, z] = points.relative_to::<V>(step);
            for &particle in bins.in_leaf(leaf) {
                nearest = length_squared(from_particle([x, y, z], particle)).min(nearest);
            }
            farthest = greatest(nearest);
        }
        nearest.sqrt()
    }
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
    let points = PointGroup::new(point.to_array().map(|axis| [axis; GROUP_SIZE]));
    dispatch(InsideOne { bins, shaped, near: &near, points: &points, radius })
}

/// The kernel of [`is_inside_one`]; all points are the same.
struct InsideOne<'a> {
    bins: &'a ParticleBins,
    shaped: Option<&'a ShapedParticles<'a>>,
    near: &'a NearLeaves,
    points: &'a PointGroup,
    radius: f32,
}

impl Kernel for InsideOne<'_> {
    type Output = bool;

    #[inline(always)]
    fn run<V: Lanes>(self) -> bool {
        let InsideOne { bins, shaped, near, points, radius } = self;
        let is_inside = match shaped {
            None => V::bits(near.distances::<V>(bins, points).lt(V::splat(radius))),
            Some(shaped) => {
                let limits = DistanceLimits { radii: [radius; 2], from_spheres: [0.0; 2], has_balls: false };
                shaped.sides::<V>(near, points, &limits).inside_min_bits
            }
        };
        is_inside != 0
    }
}

// Moves vertices back that are out of bounds by more than the tolerance of half a voxel.
//
//        voxel  ∙───────∙     Bounds hold at voxels. In a gap between two spheres that is narrower
//     S_max ▒▒▒▒│ v     │▒▒▒▒  than a voxel, or at the tip of a long ellipsoid, the interpolation error between
//           ▒▒▒▒∙───────∙▒▒▒▒  voxels may be a little larger than the tolerance: then the vertex is moved.

/// A vertex that is out of bounds, and the nearest position within them.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BoundViolation {
    /// Index of the vertex.
    pub vertex: usize,
    /// Its corrected position, in the coordinates of the mesh.
    pub position: Vec3,
}

/// The corrected position of a vertex that is out of bounds, relative to the leaf around which `near` was
/// collected; `None` if the correction steps reach no valid position within one voxel of the vertex.
fn corrected_position(part: &CheckedRegion, near: &NearLeaves, local: Vec3) -> Option<Vec3> {
    let mut point = local;
    for _ in 0..STEPS_MAX {
        match step(part, near, point) {
            None => return Some(point),
            Some(step) => point += step,
        }
        if point.distance(local) > MOVE_MAX {
            return None;
        }
    }
    None
}

/// Upper limit of the movement of a vertex, in voxels.
const MOVE_MAX: f32 = 1.0;

/// Maximum number of correction steps. A vertex that is still out of bounds after them is not moved.
const STEPS_MAX: usize = 8;

/// How far to the valid side of its bound a vertex is moved, in voxels: more than the rounding error of a
/// 32-bit position. The error of rounding to world positions is added.
const SLACK: f32 = 2e-3;

/// The step from a position to the bound that it violates; `None` if it violates none.
fn step(part: &CheckedRegion, near: &NearLeaves, point: Vec3) -> Option<Vec3> {
    let CheckedRegion { bins, radii, rounding_voxels, .. } = *part;
    let DistanceLimits { radii: [min, max], from_spheres: [from_min, from_max], has_balls } =
        DistanceLimits::new(&radii).with_margin(CELL_MARGIN);
    let slack = SLACK + rounding_voxels;
    let (mut deepest, mut nearest) = ((f32::INFINITY, Vec3::ZERO), (f32::INFINITY, Vec3::ZERO));
    for &(from_leaf, leaf) in &near.leaves {
        for (index, &center) in bins.range(leaf).zip(bins.in_leaf(leaf)) {
            let apart = point - from_leaf - center;
            // Particles this far away do not determine the bounds. They must be skipped, for two reasons: the
            // first-order distance to a far ellipsoid is too small, so the ellipsoid might be taken for the
            // nearest; and the result must not depend on which leaves were searched.
            if apart.length() > max * bins.shapes.outer_radius(index) + from_max + MOVE_MAX {
                continue;
            }
            let ([to_min, to_max], outward) = distances_and_outward(&bins.shapes, index, apart, [min, max]);
            let of_min = if has_balls {
                (apart.length() - min, apart.normalize_or(Vec3::X))
            } else {
                (to_min, outward)
            };
            if of_min.0 < deepest.0 {
                deepest = of_min;
            }
            if to_max < nearest.0 {
                nearest = (to_max, outward);
            }
        }
    }
    // A position counts as valid only if it is inside the bounds by at least half the slack. A vertex may
    // have been found out of bounds only because of a rounding error: without this margin, it might count as
    // valid here and stay where it is.
    if deepest.0 < from_min + slack / 2.0 {
        Some(deepest.1 * (from_min + slack - deepest.0))
    } else if nearest.0 > from_max - slack / 2.0 && nearest.0.is_finite() {
        Some(nearest.1 * (from_max - slack - nearest.0))
    } else {
        None
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::contour::{Contouring, contour};
    use crate::particles::{Ellipsoid, OwnedPositions, ParticleCloud, Shapes};
    use crate::rasterize::{Radii, RasterFields, RasterParams, rasterize};
    use crate::space::{CoordBox, Lattice};
    use crate::validation::{Checks, MeshCells, NoExclusions, check};

    /// Vertices that are pushed out of bounds come back, and the others stay.
    #[test]
    fn violating_vertices_return_into_their_bounds() {
        let lattice = Lattice { voxel_size: 0.5 };
        let radii = Radii { band_scale: 2.0, min_scale: 0.6, ..Radii::uniform(3.0, 4.5, 6.0) };
        let long = Ellipsoid::new([1.8, 0.7, 0.8], [Vec3::X, Vec3::Y, Vec3::Z]);
        let shapes = [Shapes::Uniform, Shapes::Scaled(vec![1.0, 1.3]), Shapes::Ellipsoids(vec![long; 2])];
        for (shapes, pushed_voxels) in shapes.into_iter().zip([2.4, 2.7, 2.0]) {
            let positions = OwnedPositions::F64(vec![[0.1, 0.2, 0.3], [1.4, 0.5, 0.1]]);
            let cloud = ParticleCloud { positions, shapes, attributes: Vec::new() };
            let Ok(RasterFields { bins, band, .. }) = rasterize(&cloud, &RasterParams::open(lattice, radii));
            let mut mesh = contour(&band, &lattice, Contouring::Dual);
            // For semi-axes of 1, each bound is 1.5 voxels from the surface, plus a tolerance of 0.5. The
            // semi-axis along y is 0.7.
            let by_height =
                |one: &usize, other: &usize| mesh.positions[*one].y.total_cmp(&mesh.positions[*other].y);
            let highest = (0..mesh.positions.len()).max_by(by_height).expect("a vertex");
            let lowest = (0..mesh.positions.len()).min_by(by_height).expect("a vertex");
            for (vertex, sign) in [(highest, 1.0), (lowest, -1.0)] {
                let pushed_world = sign * pushed_voxels * lattice.voxel_size as f32;
                mesh.positions[vertex] += mesh.normals[vertex] * pushed_world;
            }
            let (owned, exempt) = (CoordBox::ALL, &NoExclusions);
            let cells = &MeshCells::new(&mesh, &band, &lattice);
            let part = CheckedRegion {
                bins: &bins,
                radii,
                band: &band,
                mesh: &mesh,
                cells,
                rounding_voxels: 0.0,
                lattice: &lattice,
                owned,
                exempt,
            };
            let Checks { particles: before, violations } = check(&part);
            assert!(before.vertices_inside_min == 1 && before.vertices_outside_max == 1, "{before:?}");
            let mut corrected = mesh.clone();
            for violation in &violations {
                corrected.positions[violation.vertex] = violation.position;
            }
            let after = check(&CheckedRegion { mesh: &corrected, ..part }).particles;
            assert_eq!(violations.len(), 2, "{violations:?}");
            assert_eq!(after.vertices_inside_min + after.vertices_outside_max, 0, "{after:?}");
        }
    }
}
