//! Finds the triangles around each vertex.
//!
//! Vertices and triangles are split into chunks. First, the triangles that touch each chunk of vertices are
//! listed. Then one thread sorts the corners of a chunk's vertices, in memory that fits into its cache and is
//! reused for the next chunk:
//!
//! ```text
//!   triangles   chunk 0        chunk 1        chunk 2
//!               ╱    ╲          │   ╲           │            runs: indices of triangles within their chunk
//!   vertices  chunk 0   chunk 1    …                         corners:   [next, prev] by vertex
//! ```

use glam::{DVec3, Vec3};
use rayon::prelude::*;

use super::{CHUNK, Mesh, Sums};
use crate::parallel::Loops as _;

/// The triangles of one chunk that touch one chunk of vertices.
struct CornerRun {
    vertex_chunk: u32,
    triangle_chunk: u32,
    /// Start in the list of indices of the triangle chunk.
    start: u32,
    count: u32,
}

/// For each chunk of vertices, the triangles that touch it.
pub(super) struct TouchingTriangles {
    /// For each chunk of triangles, the indices of its triangles relative to the chunk, grouped by the vertex
    /// chunk that they touch.
    indices: Vec<Vec<u16>>,
    /// Sorted by chunk of vertices, then by chunk of triangles.
    runs: Vec<CornerRun>,
}

impl TouchingTriangles {
    pub(super) fn new(mesh: &Mesh) -> TouchingTriangles {
        let chunks = mesh.triangles.par_chunks(CHUNK).enumerate();
        let lists = chunks.halved().map(|(chunk, triangles)| list_of_chunk(triangles, chunk as u32));
        let (indices, runs): (Vec<_>, Vec<_>) = lists.unzip();
        let mut runs: Vec<CornerRun> = runs.into_iter().flatten().collect();
        runs.par_sort_unstable_by_key(|run| (run.vertex_chunk, run.triangle_chunk));
        TouchingTriangles { indices, runs }
    }

    /// The triangles that touch a chunk of vertices, in order.
    pub(super) fn triangles<'a>(
        &'a self,
        mesh: &'a Mesh,
        chunk: usize,
    ) -> impl Iterator<Item = [u32; 3]> + Clone + 'a {
        let first = self.runs.partition_point(|run| (run.vertex_chunk as usize) < chunk);
        let runs = self.runs[first..].iter();
        runs.take_while(move |run| run.vertex_chunk as usize == chunk).flat_map(|run| {
            let triangles = &mesh.triangles[run.triangle_chunk as usize * CHUNK..];
            let indices = &self.indices[run.triangle_chunk as usize][run.start as usize..];
            indices[..run.count as usize].iter().map(|&index| triangles[usize::from(index)])
        })
    }
}

/// The list of indices of a chunk of triangles, and its runs.
fn list_of_chunk(triangles: &[[u32; 3]], triangle_chunk: u32) -> (Vec<u16>, Vec<CornerRun>) {
    let least = triangles.iter().flatten().fold(u32::MAX, |least, &vertex| least.min(vertex));
    let most = triangles.iter().flatten().fold(0, |most, &vertex| most.max(vertex));
    let [first, last] = [least, most].map(|vertex| vertex / CHUNK as u32);
    let mut ends = vec![0u32; (last - first) as usize + 1];
    for triangle in triangles {
        touched(*triangle, |chunk| ends[(chunk - first) as usize] += 1);
    }
    let mut runs = Vec::new();
    let mut total = 0;
    for (vertex_chunk, end) in (first..).zip(&mut ends) {
        if *end > 0 {
            runs.push(CornerRun { vertex_chunk, triangle_chunk, start: total, count: *end });
        }
        // `end` becomes the start of the run, and advances as indices are inserted below.
        total += std::mem::replace(end, total);
    }
    let mut indices = vec![0; total as usize];
    for (index, triangle) in triangles.iter().enumerate() {
        touched(*triangle, |chunk| {
            let next = &mut ends[(chunk - first) as usize];
            indices[*next as usize] = index as u16;
            *next += 1;
        });
    }
    (indices, runs)
}

/// Calls `each` for each chunk of vertices that a triangle touches.
#[inline(always)]
fn touched(triangle: [u32; 3], mut each: impl FnMut(u32)) {
    let [a, b, c] = triangle.map(|vertex| vertex / CHUNK as u32);
    each(a);
    if b != a {
        each(b);
    }
    if c != a && c != b {
        each(c);
    }
}

/// The corners of a chunk of vertices, grouped by vertex.
#[derive(Default)]
pub(super) struct Corners {
    /// Start of each vertex's corners in `ends`; one entry more than there are vertices.
    starts: Vec<u32>,
    /// For each corner, the other two vertices of its triangle: `[next, prev]`.
    ends: Vec<[u32; 2]>,
}

impl Corners {
    /// Replaces the corners by those of the vertices from `first` on.
    pub(super) fn collect(
        &mut self,
        first: u32,
        count: usize,
        triangles: impl Iterator<Item = [u32; 3]> + Clone,
    ) {
        let is_own = |vertex: u32| vertex >= first && vertex - first < CHUNK as u32;
        let starts = &mut self.starts;
        starts.clear();
        starts.resize(count + 2, 0);
        triangles.clone().flatten().filter(|&vertex| is_own(vertex)).for_each(|vertex| {
            starts[(vertex - first) as usize + 2] += 1;
        });
        for vertex in 2..starts.len() {
            starts[vertex] += starts[vertex - 1];
        }
        // Each start advances as corners are inserted, and finally is the start of the next vertex.
        self.ends.resize(starts[count + 1] as usize, [0; 2]);
        triangles.for_each(|[a, b, c]| {
            for [vertex, next, prev] in [[a, b, c], [b, c, a], [c, a, b]] {
                if is_own(vertex) {
                    let index = &mut starts[(vertex - first) as usize + 1];
                    self.ends[*index as usize] = [next, prev];
                    *index += 1;
                }
            }
        });
    }

    /// The corners of a vertex, given by its index within the chunk.
    #[inline(always)]
    pub(super) fn of(&self, vertex: usize) -> &[[u32; 2]] {
        &self.ends[self.starts[vertex] as usize..self.starts[vertex + 1] as usize]
    }
}

// Measures each vertex: its edges, its fan of triangles, and its part of the bending energy.

/// The sums over a chunk of vertices, from `first` on.
#[inline(always)]
pub(super) fn sum_vertices(mesh: &Mesh, corners: &Corners, first: usize, count: usize) -> Sums {
    let mut sums = Sums::default();
    let mut batch = CornerBatch { count: 0, ends: [[[0.0; CORNERS]; 3]; 3] };
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
const CORNERS: usize = 16;

/// Pending corners.
struct CornerBatch {
    count: usize,
    /// Positions of the vertex, of next and of prev, by axis.
    ends: [[[f32; CORNERS]; 3]; 3],
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
        if self.count == CORNERS {
            self.measure(parts);
        }
    }

    /// Appends the contributions of the pending corners.
    #[inline(always)]
    fn measure(&mut self, parts: &mut Vec<CornerPart>) {
        let [mut x, mut y, mut z, mut areas] = [[0.0; CORNERS]; 4];
        let [here, next, prev] = &self.ends;
        let at =
            |[x, y, z]: &[[f32; CORNERS]; 3], lane: usize| Vec3::new(x[lane], y[lane], z[lane]).as_dvec3();
        for lane in 0..CORNERS {
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

// Triangles in batches, one per SIMD lane.

/// Number of triangles that are measured at once.
pub(super) const LANES: usize = 16;

/// One value per triangle.
pub(super) type TriangleScalar = [f64; LANES];

/// The corners of some triangles, by corner and by axis. Unused lanes are zero.
pub(super) struct TriangleBatch {
    corners: [[[f32; LANES]; 3]; 3],
}

/// A triangle is degenerate if its height is below this fraction of its longest edge.
const HEIGHT_MIN: f64 = 1e-9;

impl TriangleBatch {
    /// The corners of up to [`LANES`] triangles.
    #[inline(always)]
    pub(super) fn new(positions: &[Vec3], triangles: &[[u32; 3]]) -> TriangleBatch {
        let mut corners = [[[0.0; LANES]; 3]; 3];
        for (lane, triangle) in triangles.iter().enumerate().take(LANES) {
            for corner in 0..3 {
                let position = positions[triangle[corner] as usize];
                for axis in 0..3 {
                    corners[corner][axis][lane] = position[axis];
                }
            }
        }
        TriangleBatch { corners }
    }

    #[inline(always)]
    fn corner(&self, corner: usize, lane: usize) -> DVec3 {
        let [x, y, z] = &self.corners[corner];
        Vec3::new(x[lane], y[lane], z[lane]).as_dvec3()
    }

    /// The areas of the triangles.
    #[inline(always)]
    pub(super) fn areas(&self) -> TriangleScalar {
        let mut areas = [0.0; LANES];
        for (lane, area) in areas.iter_mut().enumerate() {
            let [a, b, c] = [self.corner(0, lane), self.corner(1, lane), self.corner(2, lane)];
            *area = 0.5 * (b - a).cross(c - a).length();
        }
        areas
    }

    /// Six times the signed volumes of the tetrahedra between the triangles and the origin.
    #[inline(always)]
    fn products(&self) -> TriangleScalar {
        let mut products = [0.0; LANES];
        for (lane, product) in products.iter_mut().enumerate() {
            let [a, b, c] = [self.corner(0, lane), self.corner(1, lane), self.corner(2, lane)];
            *product = a.dot(b.cross(c));
        }
        products
    }

    /// 1 for each degenerate triangle, otherwise 0.
    #[inline(always)]
    pub(super) fn degenerate(&self) -> [u32; LANES] {
        let mut degenerate = [0; LANES];
        for (lane, degenerate) in degenerate.iter_mut().enumerate() {
            let [a, b, c] = [self.corner(0, lane), self.corner(1, lane), self.corner(2, lane)];
            let longest_squared = a.distance_squared(b).max(b.distance_squared(c)).max(c.distance_squared(a));
            let doubled_area = (b - a).cross(c - a).length();
            *degenerate = u32::from(doubled_area <= HEIGHT_MIN * longest_squared);
        }
        degenerate
    }
}

/// The sums over some of a mesh's triangles.
#[inline(always)]
pub(super) fn sum_triangles(mesh: &Mesh, triangles: &[[u32; 3]]) -> Sums {
    let mut sums = Sums::default();
    for triangles in triangles.chunks(LANES) {
        let batch = TriangleBatch::new(&mesh.positions, triangles);
        let (areas, products, degenerate) = (batch.areas(), batch.products(), batch.degenerate());
        for lane in 0..triangles.len() {
            sums.area += areas[lane];
            sums.volume += products[lane] / 6.0;
            sums.degenerate_triangle_count += degenerate[lane] as usize;
        }
    }
    sums
}
