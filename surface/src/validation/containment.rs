//! Checks that particles are inside the mesh.
//!
//! A particle is inside if all corners of its cell are inside and no triangle passes through the cell. Signs
//! are stored as bits, so a few operations find these cells for a whole leaf:
//!
//! ```text
//!   signs    ○●●●●●●●│● next leaf        ● inside
//!   shifted  ●●●●●●●●│                   and: cells with both corners inside, on each axis
//! ```
//!
//! This settles nearly all particles. For the few others, [rays](super::rays) are cast through the mesh.
//! Where the mesh leaks, which means that it does not follow φ, particles count as outside.

use glam::{DVec3, IVec3, Vec3};
use rayon::prelude::*;
use rustc_hash::FxHashMap;

use super::distances::is_inside_one;
use super::mesh_cells::{cells_of_box, corner, corners, with_all_corners};
use super::surfaces::ShapedParticles;
use super::{CheckedRegion, ExclusionMask, ParticlesOutside};
use crate::cancel::checkpoint;
use crate::grid::{LEAF_EDGE, Leaf, LeafMask, Topology, offset_in_leaf};
use crate::level_set::{Bounds, NarrowBand};
use crate::obstacle::ROUNDING_MAX;
use crate::parallel::Loops as _;
use crate::particles::{AnySource, Unread};
use crate::rasterize::{RasterParams, Start};
use crate::simd::{Kernel, Lanes, dispatch};
use crate::space::Lattice;

/// The particles of a part that the mesh does not enclose, in voxels relative to the origin of their leaf,
/// and the number of exempt particles.
pub(super) fn particles_outside(part: &CheckedRegion) -> (Vec<(IVec3, Vec3)>, usize) {
    let shaped = ShapedParticles::of(part.bins);
    let shaped = shaped.as_ref();
    let origins = part.bins.topology.origins().par_iter().enumerate();
    let owned = origins.halved().filter(|(_, origin)| part.owned.contains(**origin));
    let found = owned.map(|(leaf, &origin)| dispatch(LeafParticles { part, leaf, origin }));
    let found: Vec<Undecided> = found.collect();
    let exempt_count = found.iter().map(|found| found.exempt_count).sum();
    let (leaking, others): (Vec<Undecided>, Vec<Undecided>) =
        found.into_iter().partition(|found| part.cells.is_leaking(found.origin));
    let particles = |found: Undecided| {
        let origin = found.origin;
        found.particles.into_iter().map(move |local| (origin, local))
    };
    let mut outside: Vec<(IVec3, Vec3)> = leaking.into_iter().flat_map(particles).collect();
    let doubtful: Vec<(IVec3, Vec3)> = others.into_iter().flat_map(particles).collect();
    outside.extend(not_enclosed(part, shaped, &doubtful));
    (outside, exempt_count)
}

/// How far outside the surface a particle is according to φ, in voxels; 0 if it is inside. φ is interpolated
/// between voxels. The particle must be outside the mesh; its position is relative to the origin of its leaf.
pub(super) fn depth_outside(band: &NarrowBand, origin: IVec3, local: Vec3) -> f32 {
    let cell = local.floor().as_ivec3();
    let part = local - cell.as_vec3();
    let depth: f32 = (0..8)
        .map(|number| {
            let step = corner(number);
            let weights = Vec3::select(step.cmpeq(IVec3::ONE), part, 1.0 - part);
            let phi = match band.topology.find_voxel(origin + cell + step) {
                Some((leaf, local)) => band.phi.leaves[leaf].values[offset_in_leaf(local)],
                // No surface is near an unstored voxel. The particle is outside the mesh, so the voxel counts
                // as outside, too.
                None => band.half_width,
            };
            weights.element_product() * phi
        })
        .sum();
    depth.max(0.0)
}

/// The particles of a leaf for which the cell masks do not prove that they are inside.
struct Undecided {
    origin: IVec3,
    particles: Vec<Vec3>,
    exempt_count: usize,
}

/// Finds the particles of a leaf that may be outside.
struct LeafParticles<'a> {
    part: &'a CheckedRegion<'a>,
    leaf: usize,
    origin: IVec3,
}

impl Kernel for LeafParticles<'_> {
    type Output = Undecided;

    #[inline(always)]
    fn run<V: Lanes>(self) -> Undecided {
        let [known, with_unstored] =
            if self.part.cells.is_leaking(self.origin) { [LeafMask::EMPTY; 2] } else { self.inside_cells() };
        let exempt = self.part.exempt;
        let mut unsettled = Undecided { origin: self.origin, particles: Vec::new(), exempt_count: 0 };
        let CheckedRegion { bins, radii, .. } = self.part;
        for (index, &particle) in bins.range(self.leaf).zip(bins.in_leaf(self.leaf)) {
            // Particles in removed regions are not checked: φ is not stored there, so nothing is known about
            // them.
            if !exempt.is_empty() && exempt.particle(self.origin, particle) {
                unsettled.exempt_count += 1;
                continue;
            }
            let cell = particle.floor().as_ivec3();
            // Rounding may have moved a particle to the leaf's far side, into a cell of the next leaf.
            let is_in =
                |mask: &LeafMask| cell.max_element() < LEAF_EDGE && mask.contains(offset_in_leaf(cell));
            let is_sure = || match radii.start {
                Start::Spheres => radii.init * bins.shapes.inner_radius(index) > SURE_RADIUS,
                Start::Kernels => true,
            };
            if !(is_in(&known) || is_in(&with_unstored) && is_sure()) {
                unsettled.particles.push(particle);
            }
        }
        unsettled
    }
}

/// An unstored voxel is inside if it lies in a particle. A ball with a radius above √3 voxels, the diagonal
/// of a cell, contains all corners of the cell that its centre lies in, wherever in the cell that is. A start of kernels
/// contains a corner of the cell of each particle, and the others are on the same side if no surface is stored near.
const SURE_RADIUS: f32 = 1.75;

impl LeafParticles<'_> {
    /// The cells of the leaf that no triangle passes through and whose corners are all inside: first with
    /// unstored voxels counted as outside, then with unstored voxels counted as inside.
    #[inline(always)]
    fn inside_cells(&self) -> [LeafMask; 2] {
        let CheckedRegion { band, cells, bins, .. } = self.part;
        [LeafMask::EMPTY, LeafMask::FULL].map(|unstored| {
            let masks = std::array::from_fn(|number| {
                let origin = self.origin + corner(number) * LEAF_EDGE;
                match band.topology.find(origin) {
                    Some(leaf) => cells.signs[leaf],
                    None if bins.is_deep(origin) => LeafMask::FULL,
                    None => unstored,
                }
            });
            let mut inside = with_all_corners(masks);
            if let Some(leaf) = band.topology.find(self.origin) {
                inside.remove_all(cells.of_leaf(leaf));
            }
            inside
        })
    }
}

/// Whether a voxel is inside. Where φ is stored, its sign decides. Elsewhere no surface is near, so the sign
/// of the initial surface decides. For example, a sphere may be so small that it contains no voxel: φ_0 is then positive at
/// all voxels around it, so none of them is stored for it, and they are outside.
fn is_voxel_inside(part: &CheckedRegion, shaped: Option<&ShapedParticles>, voxel: IVec3) -> bool {
    if let Some((leaf, local)) = part.band.topology.find_voxel(voxel) {
        return part.cells.signs[leaf].contains(offset_in_leaf(local));
    }
    let local = voxel & IVec3::splat(LEAF_EDGE - 1);
    part.bins.is_deep(voxel - local)
        || is_inside_one(part.bins, shaped, voxel - local, local.as_vec3(), part.radii.inside())
}

// Casts rays from points to classified cells, to find whether a closed mesh encloses the points.
//
//            ╲                          a ray along an axis, from a particle to the nearest cell that no triangle
//        ●────╲──────▶ clear, outside   passes through. Each triangle on the way counts by the side from which
//              ╲                        the ray hits it: +1 on the way out, −1 on the way in
//
// A triangle is intersected in a slice: the plane that contains the ray cuts the edges of triangles in
// points, and two triangles with a common edge get the same point, to the last bit. So a ray through an edge
// or a vertex hits exactly one of the triangles there, or one triangle of each sheet that meets there.

/// Maximum length of a ray in cells; if it finds no clear cell, the particle counts as outside.
const REACH: i32 = 32;

/// A ray from a particle along an axis.
#[derive(Clone, Copy)]
struct AxisRay {
    from: DVec3,
    axis: usize,
    /// Coordinate of its end along the axis: the middle of a clear cell.
    to: f64,
    /// Whether that cell is inside.
    is_end_inside: bool,
}

/// The particles, relative to the origin of a leaf and in voxels, that the mesh does not enclose.
fn not_enclosed(
    part: &CheckedRegion,
    shaped: Option<&ShapedParticles>,
    particles: &[(IVec3, Vec3)],
) -> Vec<(IVec3, Vec3)> {
    if particles.is_empty() {
        return Vec::new();
    }
    let ray = |&(origin, local): &(IVec3, Vec3)| AxisRay::new(part, shaped, origin, local);
    let rays: Vec<Option<AxisRay>> = particles.par_iter().halved().map(ray).collect();
    let mut leaves: Vec<IVec3> = rays.iter().flatten().flat_map(AxisRay::leaves).collect();
    leaves.par_sort_unstable_by_key(|leaf| leaf.to_array());
    leaves.dedup();
    let triangles = TrianglesByLeaf::new(part, &leaves);
    let is_inside = |ray: &Option<AxisRay>| {
        checkpoint();
        ray.is_some_and(|ray| ray.is_inside(part, &triangles))
    };
    let outside = rays.par_iter().zip(particles).halved().filter(|(ray, _)| !is_inside(ray));
    outside.map(|(_, particle)| *particle).collect()
}

impl AxisRay {
    /// The shortest ray that ends in a clear cell.
    fn new(
        part: &CheckedRegion,
        shaped: Option<&ShapedParticles>,
        origin: IVec3,
        local: Vec3,
    ) -> Option<AxisRay> {
        let from = origin.as_dvec3() + local.as_dvec3();
        let cell = from.floor().as_ivec3();
        let is_inside = |voxel| is_voxel_inside(part, shaped, voxel);
        let clear_side = |cell: IVec3| {
            let leaf = cell & !(LEAF_EDGE - 1);
            if part.cells.contains(&part.band.topology, cell) || part.cells.is_leaking(leaf) {
                return None;
            }
            let first = is_inside(cell);
            (1..8).all(|number| is_inside(cell + corner(number)) == first).then_some(first)
        };
        (1..=REACH).find_map(|steps| {
            (0..6).find_map(|direction| {
                let (axis, sign) = (direction / 2, if direction % 2 == 0 { steps } else { -steps });
                let end = cell + IVec3::AXES[axis] * sign;
                let is_end_inside = clear_side(end)?;
                Some(AxisRay { from, axis, to: f64::from(end[axis]) + 0.5, is_end_inside })
            })
        })
    }

    /// Its interval on the axis, in ascending order.
    fn range(&self) -> [f64; 2] {
        let from = self.from[self.axis];
        [from.min(self.to), from.max(self.to)]
    }

    /// The leaves that it passes through.
    fn leaves(&self) -> impl Iterator<Item = IVec3> + use<> {
        let leaf_of = |along: f64| (along.floor() as i32).div_euclid(LEAF_EDGE);
        let [first, last] = self.range().map(leaf_of);
        let (origin, axis) = (self.from.floor().as_ivec3() & !(LEAF_EDGE - 1), self.axis);
        (first..=last).map(move |leaf| {
            let mut origin = origin;
            origin[axis] = leaf * LEAF_EDGE;
            origin
        })
    }

    fn is_inside(&self, part: &CheckedRegion, triangles: &TrianglesByLeaf) -> bool {
        let [low, high] = self.range();
        let mut winding = i32::from(self.is_end_inside);
        for leaf in self.leaves() {
            // A triangle is listed in each leaf that it touches; count it in the leaf of the intersection.
            let (first, last) = (f64::from(leaf[self.axis]), f64::from(leaf[self.axis] + LEAF_EDGE));
            for &triangle in triangles.of(leaf) {
                let corners = corners(part.mesh, part.mesh.triangles[triangle as usize], part.lattice);
                let Some((at, facing)) = crossing(&corners, self.axis, self.from) else { continue };
                if (low..high).contains(&at) && (first..last).contains(&at) {
                    // Where the ray leaves the mesh, it has the direction of the triangle's normal.
                    winding += if self.to > self.from[self.axis] { facing } else { -facing };
                }
            }
        }
        winding >= 1
    }
}

/// Where a triangle intersects the line through a point along an axis, and whether it faces along the axis
/// (1) or against it (−1).
fn crossing(corners: &[DVec3; 3], axis: usize, point: DVec3) -> Option<(f64, i32)> {
    let (u, v) = ((axis + 1) % 3, (axis + 2) % 3);
    let is_above = corners.map(|corner| corner[u] > point[u]);
    let (mut up, mut down) = (None, None);
    for index in 0..3 {
        let next = (index + 1) % 3;
        if is_above[index] == is_above[next] {
            continue;
        }
        // Use the same ends in the same order for both triangles of the edge.
        let (below, above) =
            if is_above[next] { (corners[index], corners[next]) } else { (corners[next], corners[index]) };
        let part = (point[u] - below[u]) / (above[u] - below[u]);
        let cut = [v, axis].map(|along| below[along] + part * (above[along] - below[along]));
        *(if is_above[next] { &mut up } else { &mut down }) = Some(cut);
    }
    let (Some([up_v, up_at]), Some([down_v, down_at])) = (up, down) else { return None };
    if (up_v <= point[v]) == (down_v <= point[v]) {
        return None;
    }
    let part = (point[v] - up_v) / (down_v - up_v);
    Some((up_at + part * (down_at - up_at), if up_v <= point[v] { 1 } else { -1 }))
}

/// The triangles in some leaves.
struct TrianglesByLeaf {
    leaf_indices: FxHashMap<IVec3, u32>,
    /// Pairs of leaf index and triangle.
    triangles: Vec<(u32, u32)>,
}

/// Number of triangles per task.
const CHUNK: usize = 4096;

impl TrianglesByLeaf {
    fn new(part: &CheckedRegion, leaves: &[IVec3]) -> TrianglesByLeaf {
        let leaf_indices: FxHashMap<IVec3, u32> = leaves.iter().copied().zip(0..).collect();
        let pieces = part.mesh.triangles.par_chunks(CHUNK).enumerate();
        let find = |(piece, triangles)| {
            dispatch(FindTriangles { part, leaves: &leaf_indices, first: piece * CHUNK, triangles })
        };
        let mut triangles: Vec<(u32, u32)> = pieces.halved().flat_map_iter(find).collect();
        triangles.par_sort_unstable();
        TrianglesByLeaf { leaf_indices, triangles }
    }

    fn of(&self, leaf: IVec3) -> impl Iterator<Item = &u32> {
        let leaf_index = self.leaf_indices.get(&leaf).copied().unwrap_or(u32::MAX);
        let start = self.triangles.partition_point(|&(other, _)| other < leaf_index);
        self.triangles[start..]
            .iter()
            .take_while(move |&&(other, _)| other == leaf_index)
            .map(|(_, triangle)| triangle)
    }
}

/// Kernel: pairs some triangles with the leaves that they touch.
struct FindTriangles<'a> {
    part: &'a CheckedRegion<'a>,
    leaves: &'a FxHashMap<IVec3, u32>,
    /// The index of the first of these triangles in the mesh.
    first: usize,
    triangles: &'a [[u32; 3]],
}

impl Kernel for FindTriangles<'_> {
    type Output = Vec<(u32, u32)>;

    #[inline(always)]
    fn run<V: Lanes>(self) -> Vec<(u32, u32)> {
        let CheckedRegion { mesh, lattice, .. } = self.part;
        let mut found = Vec::new();
        for (&triangle, index) in self.triangles.iter().zip(self.first as u32..) {
            let [first, last] =
                cells_of_box(&corners(mesh, triangle, lattice)).map(|cell| cell & !(LEAF_EDGE - 1));
            for x in (first.x..=last.x).step_by(LEAF_EDGE as usize) {
                for y in (first.y..=last.y).step_by(LEAF_EDGE as usize) {
                    for z in (first.z..=last.z).step_by(LEAF_EDGE as usize) {
                        found.extend(self.leaves.get(&IVec3::new(x, y, z)).map(|&leaf| (leaf, index)));
                    }
                }
            }
        }
        found
    }
}

// Checks the input positions of particles that position smoothing moved.
//
//   ● input               φ > 0: outside, at a distance of φ. It is at most the displacement, because the
//    ╲      surface         moved particle is inside
//   ──╲──────────
//      ○ moved
//
// The certificate requires moved particles to be inside, and counts how many input positions are outside. φ,
// interpolated between voxels, decides. Where φ is not stored, no surface is near: then the first stored
// voxel on the way to the moved particle decides. If there is none, no surface lies in between, so the input
// position is inside, like the moved one.

/// The input position of a moved particle. Lengths are in voxels.
#[derive(Clone, Copy, Debug)]
pub struct MovedParticle {
    /// The origin of the leaf of the input position.
    origin: IVec3,
    /// The input position, relative to that leaf.
    local: Vec3,
    /// From the input position to the current one.
    moved: Vec3,
}

/// The moved particles of a batch whose input position is within the range of the grid.
///
/// # Errors
/// Those of the source.
fn moved_particles(
    source: &AnySource<'_>,
    batch: usize,
    lattice: &Lattice,
) -> Result<impl Iterator<Item = MovedParticle>, Unread> {
    let moved_particle = move |[given, moved]: [DVec3; 2]| {
        let [given, moved] = [lattice.index_from_world(given)?, lattice.index_from_world(moved)?];
        let edge = f64::from(LEAF_EDGE);
        let origin = (given / edge).floor() * edge;
        let (local, moved) = ((given - origin).as_vec3(), (moved - given).as_vec3());
        Some(MovedParticle { origin: origin.as_ivec3(), local, moved })
    };
    Ok(source.moved_pairs(batch)?.into_iter().filter_map(moved_particle))
}

/// The moved particles whose input position may be outside the surface, batch by batch. The smoothing of the
/// level set keeps φ within `bounds`, on `topology`. Afterwards `offset`, in voxels, is subtracted from φ,
/// and if `has_obstacles` is true, the fluid is cut off at these, which may raise φ to zero if it is above
/// −[`ROUNDING_MAX`].
///
/// # Errors
/// Those of the source.
pub fn possibly_outside(
    source: &AnySource<'_>,
    scene: &RasterParams,
    topology: &Topology,
    bounds: &Bounds,
) -> Result<Vec<Vec<MovedParticle>>, Unread> {
    if !source.is_smoothed() {
        return Ok(Vec::new());
    }
    let (offset, has_obstacles) = (scene.radii.offset, !scene.obstacles.is_empty());
    let least = offset.min(0.0) - if has_obstacles { ROUNDING_MAX } else { 0.0 };
    let leaf_of = |leaf| bounds.of_leaf(leaf)[1];
    let is_doubtful = |particle: &MovedParticle| match particle.corner_values(topology, leaf_of) {
        // φ is at most its upper bound. Rounding is monotonic, so the interpolated φ is at most the interpolated
        // bound, too.
        Some(corners) if offset == 0.0 && !has_obstacles => particle.interpolated(corners) > 0.0,
        Some(corners) => corners.iter().any(|value| *value >= least),
        None => particle.first_stored(topology, leaf_of).is_some(),
    };
    let of_batch = |batch| {
        let mut doubtful: Vec<_> =
            moved_particles(source, batch, &scene.lattice)?.filter(is_doubtful).collect();
        doubtful.shrink_to_fit();
        Ok(doubtful)
    };
    (0..source.batch_count()).into_par_iter().halved().map(of_batch).collect()
}

/// How many of these input positions are outside the surface of a scene, and how far.
pub fn count_inputs_outside(
    batches: &[Vec<MovedParticle>],
    band: &NarrowBand,
    scene: &RasterParams,
    exempt: &dyn ExclusionMask,
) -> ParticlesOutside {
    let count = |sum: OutsideCount, particle: &MovedParticle| {
        sum.merge(particle.count_outside(band, scene.radii.offset, exempt))
    };
    batches
        .par_iter()
        .halved()
        .flatten()
        .fold(OutsideCount::default, count)
        .reduce(OutsideCount::default, OutsideCount::merge)
        .in_world(&scene.lattice)
}

/// The same for all moved particles of a source.
///
/// # Errors
/// Those of the source.
pub fn count_inputs_outside_of_source(
    source: &AnySource<'_>,
    band: &NarrowBand,
    scene: &RasterParams,
    exempt: &dyn ExclusionMask,
) -> Result<ParticlesOutside, Unread> {
    let of_batch = |batch| {
        let particles = moved_particles(source, batch, &scene.lattice)?;
        Ok(particles.fold(OutsideCount::default(), |sum, particle| {
            sum.merge(particle.count_outside(band, scene.radii.offset, exempt))
        }))
    };
    let batches = (0..source.batch_count()).into_par_iter().halved().map(of_batch);
    let sum = batches.try_reduce(OutsideCount::default, |one, other| Ok(one.merge(other)))?;
    Ok(sum.in_world(&scene.lattice))
}

/// Number of positions outside, and the distance of the farthest one from the surface, in voxels.
#[derive(Clone, Copy, Default)]
struct OutsideCount {
    count: usize,
    deepest: f32,
}

impl OutsideCount {
    fn merge(self, other: OutsideCount) -> OutsideCount {
        OutsideCount { count: self.count + other.count, deepest: self.deepest.max(other.deepest) }
    }

    fn in_world(self, lattice: &Lattice) -> ParticlesOutside {
        ParticlesOutside { count: self.count, deepest: f64::from(self.deepest) * lattice.voxel_size }
    }
}

impl MovedParticle {
    fn count_outside(&self, band: &NarrowBand, offset: f32, exempt: &dyn ExclusionMask) -> OutsideCount {
        let leaf_of = |leaf: usize| &band.phi.leaves[leaf];
        let phi = match self.corner_values(&band.topology, leaf_of) {
            Some(corners) => self.interpolated(corners),
            None => match self.first_stored(&band.topology, leaf_of) {
                Some(value) if value > 0.0 => f32::INFINITY,
                _ => 0.0,
            },
        };
        if phi > 0.0 && (exempt.is_empty() || !exempt.particle(self.origin, self.local)) {
            // Before the offset the moved particle was inside, so the input position was outside by at most
            // the displacement. A negative offset moves the surface inward by its absolute value, which is
            // added to this limit.
            return OutsideCount { count: 1, deepest: phi.min(self.moved.length() - offset.min(0.0)) };
        }
        OutsideCount::default()
    }

    /// The values at the corners of the cell of the input position; `None` unless all are stored.
    fn corner_values<'a>(
        &self,
        topology: &Topology,
        leaf_of: impl Fn(usize) -> &'a Leaf,
    ) -> Option<[f32; 8]> {
        let cell = self.origin + self.local.floor().as_ivec3();
        let mut values = [0.0; 8];
        for (number, value) in values.iter_mut().enumerate() {
            *value = value_at(topology, &leaf_of, cell + corner(number))?;
        }
        Some(values)
    }

    fn interpolated(&self, corners: [f32; 8]) -> f32 {
        let part = self.local - self.local.floor();
        let weight = |number: usize| {
            let step = corner(number).as_vec3();
            (step * part + (1.0 - step) * (1.0 - part)).element_product()
        };
        (0..8).map(|number| weight(number) * corners[number]).sum()
    }

    /// The value of the first stored voxel on the way to the moved particle.
    fn first_stored<'a>(&self, topology: &Topology, leaf_of: impl Fn(usize) -> &'a Leaf) -> Option<f32> {
        // The steps are shorter than the width of a band, so none of the steps jumps over one.
        let step_count = self.moved.length().ceil().min(STEPS_MAX) as u32;
        (0..=step_count).find_map(|step| {
            let part = step as f32 / step_count.max(1) as f32;
            let voxel = self.origin + (self.local + part * self.moved).round().as_ivec3();
            value_at(topology, &leaf_of, voxel)
        })
    }
}

/// Upper limit of the number of steps, each at most one voxel long. It is never reached: a particle moves
/// toward neighbours within 200 voxels, so it moves no farther than that.
const STEPS_MAX: f32 = 1024.0;

fn value_at<'a>(topology: &Topology, leaf_of: &impl Fn(usize) -> &'a Leaf, voxel: IVec3) -> Option<f32> {
    let (leaf, local) = topology.find_voxel(voxel)?;
    Some(leaf_of(leaf).values[offset_in_leaf(local)])
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Rays through the vertices and edges of a closed mesh enter it as often as they leave it.
    #[test]
    fn rays_through_edges_and_vertices_count_each_sheet_once() {
        let c = [DVec3::X, -DVec3::X, DVec3::Y, -DVec3::Y, DVec3::Z, -DVec3::Z];
        let faces = [[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]];
        for axis in 0..3 {
            for (u, v, is_met) in [
                (0.0, 0.0, true),
                (0.25, 0.0, true),
                (0.0, 0.5, true),
                (0.25, 0.25, true),
                (0.75, 0.75, false),
            ] {
                let mut point = DVec3::ZERO;
                (point[(axis + 1) % 3], point[(axis + 2) % 3]) = (u, v);
                let met: Vec<(f64, i32)> = faces
                    .iter()
                    .filter_map(|face| crossing(&face.map(|corner: usize| c[corner]), axis, point))
                    .collect();
                assert_eq!(met.len(), if is_met { 2 } else { 0 }, "{point} along {axis}: {met:?}");
                assert!(met.iter().all(|(at, facing)| at.signum() as i32 == *facing), "{met:?}");
            }
        }
    }
}
