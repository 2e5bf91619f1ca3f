//! Measures each vertex: its edges, its fan of triangles, and its part of the bending energy.

use glam::{DVec3, Vec3};

use super::corners::Corners;
use super::{Mesh, Sums};

/// The sums over a chunk of vertices, from `first` on.
#[inline(always)]
pub(super) fn sum_vertices(mesh: &Mesh, corners: &Corners, first: usize, count: usize) -> Sums {
    let mut sums = Sums::default();
    let mut batch = CornerBatch { count: 0, ends: [[[0.0; LANES]; 3]; 3] };
    let mut parts = Vec::with_capacity(16 * VERTICES_AT_ONCE);
    for start in (0..count).step_by(VERTICES_AT_ONCE) {
        let vertices = start..count.min(start + VERTICES_AT_ONCE);
        parts.clear();
        for vertex in vertices.clone() {
            let here = mesh.positions[first + vertex];
            for &[next, prev] in corners.of(vertex) {
                batch.push([here, mesh.positions[next as usize], mesh.positions[prev as usize]], &mut parts);
            }
        }
        batch.measure(&mut parts);
        let mut index = 0;
        for vertex in vertices {
            let corners = corners.of(vertex);
            if !corners.is_empty() {
                count_edges(first + vertex, corners, &mut sums);
                sums.bending_energy += vertex_energy(&parts[index..index + corners.len()]);
                index += corners.len();
            }
        }
    }
    sums
}

/// Number of vertices whose corners are measured before they are summed.
const VERTICES_AT_ONCE: usize = 16;

/// Number of corners that are measured at once.
const LANES: usize = 16;

/// Pending corners.
struct CornerBatch {
    count: usize,
    /// Positions of the vertex, of next and of prev, by axis.
    ends: [[[f32; LANES]; 3]; 3],
}

/// The contribution of a corner to its vertex: x, y and z of the curvature vector, and the area.
type CornerPart = [f64; 4];

impl CornerBatch {
    #[inline(always)]
    fn push(&mut self, positions: [Vec3; 3], parts: &mut Vec<CornerPart>) {
        for (end, position) in self.ends.iter_mut().zip(positions) {
            for axis in 0..3 {
                end[axis][self.count] = position[axis];
            }
        }
        self.count += 1;
        if self.count == LANES {
            self.measure(parts);
        }
    }

    /// Appends the contributions of the pending corners.
    #[inline(always)]
    fn measure(&mut self, parts: &mut Vec<CornerPart>) {
        let [mut x, mut y, mut z, mut areas] = [[0.0; LANES]; 4];
        let [here, next, prev] = &self.ends;
        let at = |[x, y, z]: &[[f32; LANES]; 3], lane: usize| Vec3::new(x[lane], y[lane], z[lane]).as_dvec3();
        for lane in 0..LANES {
            let here = at(here, lane);
            let (to_next, to_prev) = (at(next, lane) - here, at(prev, lane) - here);
            let (curvature, area) = corner_part(to_next, to_prev);
            [x[lane], y[lane], z[lane]] = curvature.to_array();
            areas[lane] = area;
        }
        parts.extend((0..self.count).map(|lane| [x[lane], y[lane], z[lane], areas[lane]]));
        self.count = 0;
    }
}

/// The contribution of a corner to the curvature vector and to the area.
#[inline(always)]
fn corner_part(to_next: DVec3, to_prev: DVec3) -> (DVec3, f64) {
    let across = to_prev - to_next;
    let doubled_area = to_next.cross(to_prev).length();
    // The signs of these products distinguish acute from obtuse angles. Divided by the doubled area, they are
    // the cotangents of the angles.
    let (at_here, at_next, at_prev) = (to_next.dot(to_prev), -to_next.dot(across), to_prev.dot(across));
    let curvature = 0.5 * (at_prev * to_next + at_next * to_prev) / doubled_area;
    let acute =
        (at_prev * to_next.length_squared() + at_next * to_prev.length_squared()) / (8.0 * doubled_area);
    let next_to_obtuse = if (at_next < 0.0) | (at_prev < 0.0) { doubled_area / 8.0 } else { acute };
    let area = if at_here < 0.0 { doubled_area / 4.0 } else { next_to_obtuse };
    let is_flat = doubled_area <= 0.0;
    let (zero, none) = (DVec3::ZERO, 0.0);
    (if is_flat { zero } else { curvature }, if is_flat { none } else { area })
}

/// The contribution of a vertex to ∫H².
#[inline(always)]
fn vertex_energy(parts: &[CornerPart]) -> f64 {
    let (mut area, mut curvature_vector) = (0.0, DVec3::ZERO);
    for &[x, y, z, part] in parts {
        curvature_vector -= DVec3::new(x, y, z);
        area += part;
    }
    if area > 0.0 { curvature_vector.length_squared() / (4.0 * area) } else { 0.0 }
}

/// Counts the edges of a vertex, and checks whether its triangles form one fan.
#[inline(always)]
fn count_edges(vertex: usize, corners: &[[u32; 2]], sums: &mut Sums) {
    sums.used_vertex_count += 1;
    if is_plain_ring(corners) {
        sums.edge_count += corners.iter().filter(|[next, _]| *next as usize >= vertex).count();
    } else {
        count_edges_one_by_one(vertex, corners, sums);
    }
}

/// Maximum number of corners for the fast test of a manifold vertex.
const RING_LENGTH_MAX: usize = 8;

/// True if the corners form one ring in which each edge is `next` once and `prev` once, as for nearly all
/// vertices. Returns false without a test for vertices with more corners than [`RING_LENGTH_MAX`].
#[inline(always)]
fn is_plain_ring(corners: &[[u32; 2]]) -> bool {
    if corners.len() > RING_LENGTH_MAX {
        return false;
    }
    // `u32::MAX` is not the index of a vertex: there are fewer vertices.
    let mut nexts = [u32::MAX; RING_LENGTH_MAX];
    for (next, corner) in nexts.iter_mut().zip(corners) {
        *next = corner[0];
    }
    // For each corner, a mask of the corners that follow it.
    let mut followers = [0u32; RING_LENGTH_MAX];
    for (followers, corner) in followers.iter_mut().zip(corners) {
        for (index, &next) in nexts.iter().enumerate() {
            *followers |= u32::from(next == corner[1]) << index;
        }
    }
    let mut passed = 0;
    let mut at = 1u32;
    for _ in 0..corners.len() {
        passed |= at;
        at = followers[at.trailing_zeros() as usize % RING_LENGTH_MAX];
        if at.count_ones() != 1 {
            return false;
        }
    }
    at == 1 && passed.count_ones() as usize == corners.len()
}

/// Counts the edges of a vertex that failed the fast test.
fn count_edges_one_by_one(vertex: usize, corners: &[[u32; 2]], sums: &mut Sums) {
    for (index, corner) in corners.iter().enumerate() {
        for (side, &other) in corner.iter().enumerate() {
            // Each edge is counted once: at its smaller end, at the first corner that contains it.
            let is_seen = corners[..index].iter().any(|corner| corner.contains(&other));
            if (other as usize) < vertex || is_seen || side == 1 && corner[0] == other {
                continue;
            }
            let next_count = corners.iter().filter(|corner| corner[0] == other).count();
            let prev_count = corners.iter().filter(|corner| corner[1] == other).count();
            sums.edge_count += 1;
            match (next_count, prev_count) {
                (1, 1) => {}
                (1, 0) | (0, 1) => sums.boundary_edge_count += 1,
                _ => sums.non_manifold_edge_count += 1,
            }
        }
    }
    sums.non_manifold_vertex_count += usize::from(!is_one_fan(corners));
}

/// True if one walk across shared edges visits all corners of a vertex.
fn is_one_fan(corners: &[[u32; 2]]) -> bool {
    let step = |corner: &[u32; 2]| corners.iter().position(|other| other[0] == corner[1]);
    // An open fan is walked from its first corner, a ring from any corner.
    let is_first = |corner: &[u32; 2]| !corners.iter().any(|other| other[1] == corner[0]);
    let start = corners.iter().position(is_first).unwrap_or(0);
    let mut at = start;
    for passed in 1..=corners.len() {
        match step(&corners[at]) {
            Some(next) if next != start => at = next,
            _ => return passed == corners.len(),
        }
    }
    false
}
