//! Casts rays from points to classified cells, to find whether a closed mesh encloses the points.
//!
//! ```text
//!            ╲                          a ray along an axis, from a particle to the nearest cell that no triangle
//!        ●────╲──────▶ clear, outside   passes through. Each triangle on the way counts by the side from which
//!              ╲                        the ray hits it: +1 on the way out, −1 on the way in
//! ```
//!
//! A triangle is intersected in a slice: the plane that contains the ray cuts the edges of triangles in
//! points, and two triangles with a common edge get the same point, to the last bit. So a ray through an edge
//! or a vertex hits exactly one of the triangles there, or one triangle of each sheet that meets there.

use glam::{DVec3, IVec3, Vec3};
use rayon::prelude::*;
use rustc_hash::FxHashMap;

use super::containment::is_voxel_inside;
use super::mesh_cells::{cells_of_box, corner, corners};
use super::particle_checks::CheckedRegion;
use super::surfaces::ShapedParticles;
use crate::grid::LEAF_EDGE;
use crate::interrupt::checkpoint;
use crate::parallel::Loops as _;

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
pub(super) fn not_enclosed(
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
        let (below, above) = match is_above[next] {
            true => (corners[index], corners[next]),
            false => (corners[next], corners[index]),
        };
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
        let mut triangles: Vec<(u32, u32)> = pieces
            .halved()
            .flat_map_iter(|(piece, triangles)| {
                let mut found = Vec::new();
                for (&triangle, index) in triangles.iter().zip((piece * CHUNK) as u32..) {
                    let [first, last] = cells_of_box(&corners(part.mesh, triangle, part.lattice));
                    let (first, last) = (first & !(LEAF_EDGE - 1), last & !(LEAF_EDGE - 1));
                    for x in (first.x..=last.x).step_by(LEAF_EDGE as usize) {
                        for y in (first.y..=last.y).step_by(LEAF_EDGE as usize) {
                            for z in (first.z..=last.z).step_by(LEAF_EDGE as usize) {
                                found.extend(
                                    leaf_indices
                                        .get(&IVec3::new(x, y, z))
                                        .map(|&leaf_index| (leaf_index, index)),
                                );
                            }
                        }
                    }
                }
                found
            })
            .collect();
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
