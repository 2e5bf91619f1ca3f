//! Reduces the number of triangles within an error bound, by collapsing vertices into neighbors.
//!
//! ```text
//!        b ─── c              b ─── c
//!       ╱ ╲   ╱ ╲            ╱ ╲     ╲
//!      a ── v ── d    ──▶   a    ╲    d       v is collapsed into the neighbor w: two triangles
//!       ╲   │   ╱            ╲    ╲  ╱        disappear, and no vertex moves or is added
//!        f ─ w                f ─── w
//! ```
//!
//! **The error is a bound.** Seen along the mean normal of v's triangles, the triangles before and after the
//! collapse are graphs of two functions over the same polygon; any other collapse is rejected. Moving along
//! the normal from one graph to the other maps the old surface to the new one, continuously and one to one.
//! The displacement is maximal at v or where an old edge crosses a new one ([`collapse`]). The bound of a new
//! triangle is the largest bound of the triangles that it replaces plus this maximum displacement. So there
//! is a map from the original surface to the decimated one that moves no point by more than the largest
//! bound. Therefore the bound holds for distances in both directions, and no component, hole or handle
//! appears or disappears. Sheets nearer to each other than twice the error may touch or intersect.
//!
//! The cost of a collapse is the bound after it. Quadrics of v's own triangles determine which neighbors to
//! try first.
//!
//! **The order is local.** There is no global queue, but a fixed number of rounds. Each round has a limit,
//! which grows from round to round up to the error. A round collapses the vertices whose bound is within the
//! limit and the smallest among their neighbors; ties are broken by index. So the effect of a local change
//! spreads only a few triangles farther in each round, and the result does not depend on the number of
//! threads.
//!
//! Vertices of the result are vertices of the mesh and keep their normals. Parts that are open or not
//! manifold are unchanged.
//!
//! This work is based on:
//! Jonathan Cohen, Dinesh Manocha, Marc Olano. Simplifying polygonal models using successive mappings. 1997
//! Michael Garland, Paul Heckbert. Surface simplification using quadric error metrics. 1997
//! Peter Lindstrom, Greg Turk. Fast and memory efficient polygonal simplification. 1998

use glam::{Vec2, Vec3};
use rayon::prelude::*;

use super::corners::{Corners, TouchingTriangles};
use super::{CHUNK, Mesh};
use crate::cancel::checkpoint;
use crate::parallel::Loops as _;

/// Result of decimation.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct DecimateReport {
    /// Number of removed vertices.
    pub removed_vertex_count: usize,
    /// Number of removed triangles.
    pub removed_triangle_count: usize,
    /// Upper bound of the surface's displacement, in world units. At most the allowed error.
    pub error_world_max: f64,
}

/// Limit of the bound in the first round, as a fraction of the error, and its growth per round. With the full
/// limit from the start, long edges would appear before short ones are removed, and 3 % more triangles would
/// remain.
const FIRST_LIMIT: f32 = 1.0 / 32.0;
const LIMIT_GROWTH: f32 = 1.189_207_1; // 2^(1/4)

/// Number of rounds. The limit reaches the error after 20 rounds; more than 12 further rounds would remove
/// almost nothing.
const ROUND_COUNT: usize = 32;

/// Number of vertices per task.
const TASK_VERTICES: usize = 1024;

/// Removes triangles as long as no point of the surface moves by more than `error_world`, in world units. The
/// result is closed and manifold where the mesh was.
///
/// Panics if a triangle refers to a vertex that does not exist.
pub fn decimate(mesh: &mut Mesh, error_world: f64) -> DecimateReport {
    if error_world.is_nan() || error_world <= 0.0 {
        return DecimateReport::default();
    }
    // Rounded down, so that no bound exceeds the allowed error.
    let nearest = error_world.min(f64::from(f32::MAX)) as f32;
    let error = if f64::from(nearest) > error_world { nearest.next_down() } else { nearest };
    let mut thinning = Decimation::new(mesh);
    let mut limit = error * FIRST_LIMIT;
    for _ in 0..ROUND_COUNT {
        thinning.round(limit);
        limit = (limit * LIMIT_GROWTH).min(error);
    }
    let Decimation { rings, bounds, .. } = thinning;
    let before = (mesh.positions.len(), mesh.triangles.len());
    let bound = bounds.par_iter().copied().halved().reduce(|| 0.0, f32::max);
    mesh.triangles = rings.triangles(mesh);
    mesh.drop_unused_vertices();
    DecimateReport {
        removed_vertex_count: before.0 - mesh.positions.len(),
        removed_triangle_count: before.1 - mesh.triangles.len(),
        error_world_max: f64::from(bound),
    }
}

/// Bound of a vertex that cannot be collapsed.
const NEVER: f32 = f32::INFINITY;

/// A mesh during decimation.
struct Decimation<'a> {
    positions: &'a [Vec3],
    rings: Rings,
    /// For each vertex, an upper bound of the displacement of its triangles so far.
    bounds: Vec<f32>,
    /// For each vertex, the best known collapse; outdated for vertices in `dirty`.
    best: Vec<Collapse>,
    /// Vertices whose neighborhood has changed since they were evaluated.
    dirty: Vec<u32>,
    is_dirty: Vec<bool>,
}

impl<'a> Decimation<'a> {
    fn new(mesh: &'a Mesh) -> Decimation<'a> {
        let count = mesh.positions.len();
        Decimation {
            positions: &mesh.positions,
            rings: Rings::new(mesh),
            bounds: vec![0.0; count],
            best: vec![Collapse { bound: NEVER, target: 0 }; count],
            dirty: (0..count as u32).collect(),
            is_dirty: vec![true; count],
        }
    }

    /// Collapses vertices whose bound is within a limit.
    fn round(&mut self, limit: f32) {
        checkpoint();
        self.evaluate_dirty(limit);
        let chosen: Vec<Vec<u32>> = (0..self.best.len().div_ceil(TASK_VERTICES))
            .into_par_iter()
            .halved()
            .map(|chunk| self.selected_in_chunk(chunk, limit))
            .collect();
        for vertex in chosen.into_iter().flatten() {
            let Collapse { bound, target } = self.best[vertex as usize];
            // Two selected vertices may have a common neighbor; then the second one is evaluated again.
            if !self.rings.can_collapse(vertex, target) {
                self.mark_dirty(vertex);
                continue;
            }
            for index in 0..self.rings.of(vertex).len() {
                let neighbor = self.rings.of(vertex)[index];
                let old = &mut self.bounds[neighbor as usize];
                *old = old.max(bound);
                self.mark_dirty(neighbor);
            }
            self.rings.collapse(vertex, target);
            self.best[vertex as usize].bound = NEVER;
        }
    }

    fn mark_dirty(&mut self, vertex: u32) {
        let is_dirty = &mut self.is_dirty[vertex as usize];
        if !*is_dirty {
            *is_dirty = true;
            self.dirty.push(vertex);
        }
    }

    /// Evaluates the dirty vertices, except those whose current bound already exceeds the limit.
    fn evaluate_dirty(&mut self, limit: f32) {
        let dirty = std::mem::take(&mut self.dirty);
        let find_collapse = |&vertex: &u32| {
            checkpoint();
            let ring = self.rings.of(vertex);
            let Some(patch) = VertexStar::new(self.positions, vertex, ring, &self.bounds) else {
                return Some(Collapse { bound: NEVER, target: 0 });
            };
            let is_in_reach = patch.bound <= limit;
            is_in_reach.then(|| patch.best_collapse(&self.rings))
        };
        let found: Vec<Option<Collapse>> =
            dirty.par_iter().with_min_len(TASK_VERTICES).halved().map(find_collapse).collect();
        for (vertex, found) in dirty.into_iter().zip(found) {
            let index = vertex as usize;
            self.best[index] = found.unwrap_or(Collapse { bound: NEVER, target: 0 });
            if found.is_none() {
                self.dirty.push(vertex);
            } else {
                self.is_dirty[index] = false;
            }
        }
    }

    /// The vertices of a chunk whose bound is within the limit and the smallest among their neighbors.
    fn selected_in_chunk(&self, chunk: usize, limit: f32) -> Vec<u32> {
        let first = chunk * TASK_VERTICES;
        let vertices = first..self.best.len().min(first + TASK_VERTICES);
        let key = |vertex: usize| (self.best[vertex].bound, vertex);
        let is_chosen = |&vertex: &usize| {
            let own = key(vertex);
            let is_first = |neighbor: &u32| own < key(*neighbor as usize);
            own.0 <= limit && self.rings.of(vertex as u32).iter().all(is_first)
        };
        vertices.filter(is_chosen).map(|vertex| vertex as u32).collect()
    }
}

// Bounds how far the surface moves when a vertex is collapsed into a neighbor.
//
//   seen along the mean normal of v's triangles:
//
//        c ─── b              c ─── b          old edges  v–a, v–b, …            heights h above the plane
//       ╱ ╲   ╱ ╲            ╱  ╲    ╲         new edges  w–c, w–b
//      d ── v ── a          d  ·  × ╌ ×  a
//       ╲   │   ╱            ╲    ╲  ╱         the difference of the heights is linear between
//        e ─ w               e ──── w          · (where v was) and × (where an old and a new edge cross),
//                                              so it is maximal at one of these points

/// A collapse of a vertex into a neighbor.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Collapse {
    /// Upper bound of the displacement of points of the vertex's triangles, including this collapse.
    bound: f32,
    /// The neighbor.
    target: u32,
}

/// Vertices with more neighbors than this are not collapsed.
const RING_MAX: usize = 12;

/// Cosine of the maximum angle between triangle normals and the mean normal: 75°.
const COSINE_MIN: f32 = 0.26;

/// Minimum shape quality of a new triangle (1 if equilateral, 0 without area), unless an old triangle was
/// worse.
const SHAPE_MIN: f32 = 0.25;

/// Maximum number of neighbors that are tried as targets.
const TRIES: usize = 3;

/// Upper bound of the rounding error of 32-bit arithmetic, relative to the size of the patch.
const ROUNDING: f32 = 4e-6;

/// The triangles around a vertex.
struct VertexStar<'a> {
    vertex: u32,
    ring: &'a [u32],
    /// Upper bound of the displacement of the triangles' points so far.
    bound: f32,
    /// Positions of the neighbors relative to the vertex.
    around: [Vec3; RING_MAX],
    /// Normals of the triangles with the length of twice the area, by the triangle's first neighbor.
    normals: [Vec3; RING_MAX],
    mean_normal: Vec3,
    /// Projections of the neighbors along the mean normal, and their heights.
    projected: [Vec2; RING_MAX],
    heights: [f32; RING_MAX],
    least_shape: f32,
}

impl<'a> VertexStar<'a> {
    /// The triangles of a vertex; `None` if it has no ring, or its ring is too long or folded.
    #[inline(always)]
    fn new(positions: &[Vec3], vertex: u32, ring: &'a [u32], bounds: &[f32]) -> Option<VertexStar<'a>> {
        let count = ring.len();
        if count == 0 || count > RING_MAX {
            return None;
        }
        let here = positions[vertex as usize];
        let mut around = [Vec3::ZERO; RING_MAX];
        let mut neighbor_bounds = [0.0; RING_MAX];
        for (i, &neighbor) in ring.iter().enumerate() {
            around[i] = positions[neighbor as usize] - here;
            neighbor_bounds[i] = bounds[neighbor as usize];
        }
        let mut normals = [Vec3::ZERO; RING_MAX];
        let (mut sum, mut bound, mut least_shape) = (Vec3::ZERO, 0.0f32, SHAPE_MIN);
        for i in 0..count {
            let after = if i + 1 == count { 0 } else { i + 1 };
            normals[i] = around[i].cross(around[after]);
            sum += normals[i];
            // Each corner has a bound for all its triangles, so the smallest of the three holds for a
            // triangle.
            bound = bound.max(neighbor_bounds[i].min(neighbor_bounds[after]));
            least_shape = least_shape.min(shape(normals[i].length(), around[i], around[after]));
        }
        let bound = bound.min(bounds[vertex as usize]);
        let mean_normal = sum / sum.length();
        let is_unfolded = |normal: &Vec3| normal.dot(mean_normal) > COSINE_MIN * normal.length();
        // Comparison with NaN is false, so NaN counts as folded.
        if !normals[..count].iter().all(is_unfolded) {
            return None;
        }
        let (right, up) = mean_normal.any_orthonormal_pair();
        let mut projected = [Vec2::ZERO; RING_MAX];
        let mut heights = [0.0; RING_MAX];
        for i in 0..count {
            projected[i] = Vec2::new(around[i].dot(right), around[i].dot(up));
            heights[i] = around[i].dot(mean_normal);
        }
        let crosses_right = |i: &usize| {
            let after = if *i + 1 == count { 0 } else { i + 1 };
            (projected[*i].y < 0.0) != (projected[after].y < 0.0) && projected[after].y >= 0.0
        };
        // The projected ring must wind around the vertex exactly once.
        if (0..count).filter(crosses_right).count() != 1 {
            return None;
        }
        Some(VertexStar {
            vertex,
            ring,
            bound,
            around,
            normals,
            mean_normal,
            projected,
            heights,
            least_shape,
        })
    }

    /// Tries the [`TRIES`] neighbors that change the triangles' planes least, best first, and returns the
    /// first possible collapse. If none is possible, the bound is [`NEVER`].
    #[inline(always)]
    fn best_collapse(&self, rings: &Rings) -> Collapse {
        let count = self.ring.len();
        let mut disturbances = [f32::INFINITY; RING_MAX];
        for (target, disturbance) in disturbances[..count].iter_mut().enumerate() {
            *disturbance = self.disturbance(target);
        }
        let mut best = Collapse { bound: NEVER, target: 0 };
        for _ in 0..TRIES.min(count) {
            let mut target = 0;
            for i in 1..count {
                if disturbances[i] < disturbances[target] {
                    target = i;
                }
            }
            disturbances[target] = f32::INFINITY;
            if rings.can_collapse(self.vertex, self.ring[target]) && self.is_sound(target) {
                best = Collapse { bound: self.bound_after(target), target: self.ring[target] };
                break;
            }
        }
        best
    }

    /// The quadric of the vertex's triangles at a neighbor: its squared distances from the triangles' planes,
    /// weighted by twice their areas.
    #[inline(always)]
    fn disturbance(&self, target: usize) -> f32 {
        let count = self.ring.len();
        let to_target = self.around[target];
        let mut sum = 0.0;
        for normal in &self.normals[..count] {
            let product = normal.dot(to_target);
            // Avoids 0 / 0 if a triangle has no area.
            sum += product * product / normal.length().max(f32::MIN_POSITIVE);
        }
        sum
    }

    /// True if the new triangles are well shaped and face the same side as the old ones.
    #[inline(always)]
    fn is_sound(&self, target: usize) -> bool {
        let count = self.ring.len();
        let origin = self.around[target];
        let mut from = wrapped(target + 1, count);
        for _ in 2..count {
            let to = wrapped(from + 1, count);
            let (one, other) = (self.around[from] - origin, self.around[to] - origin);
            let normal = one.cross(other);
            let length = normal.length();
            let faces_out = normal.dot(self.mean_normal) > COSINE_MIN * length;
            if !(faces_out && shape(length, one, other) >= self.least_shape) {
                return false;
            }
            from = to;
        }
        true
    }

    /// Upper bound of the displacement of the triangles' points after the collapse into a neighbor.
    #[inline(always)]
    fn bound_after(&self, target: usize) -> f32 {
        let count = self.ring.len();
        // The neighbors from the target on, relative to the target, projected along the normal.
        let mut projected = [Vec2::ZERO; RING_MAX];
        let mut heights = [0.0; RING_MAX];
        let mut i = target;
        for index in 0..count {
            projected[index] = self.projected[i] - self.projected[target];
            heights[index] = self.heights[i] - self.heights[target];
            i = wrapped(i + 1, count);
        }
        let (here, here_height) = (-self.projected[target], -self.heights[target]);
        // The new triangle over the old position of the vertex: its corners are the target, neighbor `under`
        // and the next neighbor.
        let is_under = |&index: &usize| {
            projected[index].perp_dot(here) >= 0.0 && here.perp_dot(projected[index + 1]) >= 0.0
        };
        let Some(under) = (1..count - 1).find(is_under) else { return NEVER };
        let doubled_area = projected[under].perp_dot(projected[under + 1]);
        let height = (here.perp_dot(projected[under + 1]) * heights[under]
            + projected[under].perp_dot(here) * heights[under + 1])
            / doubled_area;
        let mut farthest = (height - here_height).abs();
        for edge in 2..count - 1 {
            // The new edge crosses the old edges to neighbors on its other side.
            let crossed = if edge <= under { 1..edge } else { edge + 1..count };
            for other in crossed {
                let along = projected[edge];
                let (from, to) = (along.perp_dot(here), along.perp_dot(projected[other]));
                let part = (from / (from - to)).clamp(0.0, 1.0);
                let meeting = here + part * (projected[other] - here);
                let old = here_height + part * (heights[other] - here_height);
                let part_of_new = (meeting.dot(along) / along.length_squared()).clamp(0.0, 1.0);
                let difference = (old - part_of_new * heights[edge]).abs();
                // NaN counts as too far.
                farthest = if difference < NEVER { farthest.max(difference) } else { NEVER };
            }
        }
        let size = self.around[..count].iter().fold(0.0f32, |size, around| size.max(around.length_squared()));
        let bound = self.bound + farthest + ROUNDING * size.sqrt();
        if bound.is_finite() { bound } else { NEVER }
    }
}

/// Wraps an index that may be one past the end of a ring.
#[inline(always)]
fn wrapped(i: usize, count: usize) -> usize {
    if i >= count { i - count } else { i }
}

/// Shape quality of a triangle from its doubled area and two of its sides: 0 to 1 (equilateral).
#[inline(always)]
fn shape(doubled_area: f32, one: Vec3, other: Vec3) -> f32 {
    let squares = one.length_squared() + other.length_squared() + one.distance_squared(other);
    2.0 * 3f32.sqrt() * doubled_area / squares
}

// A mesh stored as the rings of neighbors around its vertices.
//
//        c ─── b
//       ╱ ╲   ╱ ╲        ring of v: a b c d e, counter-clockwise;
//      d ── v ── a       its triangles are v a b, v b c, …, v e a
//       ╲   │   ╱
//        ── e ──         v collapsed into a:   ring of a         … b v e …  becomes  … b c d e …
//                                              rings of b and e  lose v
//                                              rings of c and d  have a instead of v
//
// A vertex has a ring only if its triangles form one closed ring of at most `DEGREE_MAX` triangles. All
// other vertices are *locked*: they are kept, and so are triangles with three locked vertices.

/// Maximum number of neighbors of a vertex that is not locked, also after a collapse into it.
const DEGREE_MAX: usize = 16;

/// Minimum number of neighbors of a vertex after a collapse.
const DEGREE_MIN: usize = 3;

/// Position of a ring in the array.
#[derive(Clone, Copy, Debug, Default)]
struct RingSpan {
    start: usize,
    length: u32,
    /// Number of neighbors that fit.
    capacity: u32,
}

/// The rings of a mesh.
struct Rings {
    neighbors: Vec<u32>,
    /// One per vertex; empty if the vertex is locked or removed.
    spans: Vec<RingSpan>,
    /// Triangles with three locked vertices, which are in no ring.
    locked: Vec<[u32; 3]>,
}

impl Rings {
    /// The rings of a mesh.
    fn new(mesh: &Mesh) -> Rings {
        let touching = TouchingTriangles::new(mesh);
        let chunks = (0..mesh.positions.len().div_ceil(CHUNK)).into_par_iter();
        let chunks: Vec<(Vec<u32>, Vec<u32>)> = chunks
            .map_init(Corners::default, |corners, chunk| rings_of_chunk(mesh, &touching, chunk, corners))
            .collect();
        drop(touching);
        let mut spans = Vec::with_capacity(mesh.positions.len());
        let mut start = 0;
        for &length in chunks.iter().flat_map(|(_, lengths)| lengths) {
            spans.push(RingSpan { start, length, capacity: length });
            start += length as usize;
        }
        let neighbors = chunks.into_iter().flat_map(|(neighbors, _)| neighbors).collect();
        let has_ring = |vertex: &u32| spans[*vertex as usize].length > 0;
        let locked =
            mesh.triangles.par_iter().halved().filter(|triangle| !triangle.iter().any(has_ring)).copied();
        let locked = locked.collect();
        Rings { neighbors, spans, locked }
    }

    /// The ring of a vertex; empty if it is locked or removed.
    #[inline(always)]
    fn of(&self, vertex: u32) -> &[u32] {
        let span = self.spans[vertex as usize];
        &self.neighbors[span.start..span.start + span.length as usize]
    }

    /// True if collapsing a vertex into a neighbor preserves the topology (the link condition) and leaves no
    /// vertex with too many or too few neighbors.
    #[inline(always)]
    fn can_collapse(&self, vertex: u32, target: u32) -> bool {
        let (ring, around_target) = (self.of(vertex), self.of(target));
        let Some(index) = ring.iter().position(|&neighbor| neighbor == target) else { return false };
        let (before, after) = adjacent(ring, index);
        let common = around_target.iter().filter(|neighbor| ring.contains(neighbor)).count();
        common == 2
            && self.of(before).len() > DEGREE_MIN
            && self.of(after).len() > DEGREE_MIN
            && ring.len() + around_target.len() <= DEGREE_MAX + 4
    }

    /// Collapses a vertex into a neighbor. [`can_collapse`](Rings::can_collapse) must be true.
    fn collapse(&mut self, vertex: u32, target: u32) {
        let mut ring = [0; DEGREE_MAX];
        let length = self.of(vertex).len();
        ring[..length].copy_from_slice(self.of(vertex));
        let Some(index) = ring[..length].iter().position(|&neighbor| neighbor == target) else { return };
        // Counter-clockwise, starting at the target.
        ring[..length].rotate_left(index);
        let (first, last) = (ring[1], ring[length - 1]);
        for &neighbor in &ring[2..length - 1] {
            if let Some(index) = self.index_of(neighbor, vertex) {
                self.neighbors[index] = target;
            }
        }
        for neighbor in [first, last] {
            if let Some(index) = self.index_of(neighbor, vertex) {
                let span = &mut self.spans[neighbor as usize];
                let end = span.start + span.length as usize;
                self.neighbors.copy_within(index + 1..end, index);
                span.length -= 1;
            }
        }
        self.insert(target, vertex, &ring[2..length - 1]);
        self.spans[vertex as usize].length = 0;
    }

    /// Index of a neighbor in the ring of a vertex.
    fn index_of(&self, vertex: u32, neighbor: u32) -> Option<usize> {
        let index = self.of(vertex).iter().position(|&other| other == neighbor)?;
        Some(self.spans[vertex as usize].start + index)
    }

    /// In the ring of `vertex`, replaces the neighbor `replaced` by `others`.
    fn insert(&mut self, vertex: u32, replaced: u32, others: &[u32]) {
        let mut ring = [0; 2 * DEGREE_MAX];
        let old = self.of(vertex);
        let Some(index) = old.iter().position(|&neighbor| neighbor == replaced) else { return };
        let length = old.len() + others.len() - 1;
        let end = index + others.len();
        ring[..index].copy_from_slice(&old[..index]);
        ring[index..end].copy_from_slice(others);
        ring[end..length].copy_from_slice(&old[index + 1..]);
        let span = &mut self.spans[vertex as usize];
        span.length = length as u32;
        if span.length > span.capacity {
            // Moves the ring to the end of the array, with spare capacity.
            span.start = self.neighbors.len();
            span.capacity = span.length + SPARE;
            self.neighbors.resize(span.start + span.capacity as usize, 0);
        }
        self.neighbors[span.start..span.start + length].copy_from_slice(&ring[..length]);
    }

    /// The triangles. Each is taken from the ring of its first vertex that has one.
    fn triangles(&self, mesh: &Mesh) -> Vec<[u32; 3]> {
        let vertices = (0..mesh.positions.len() as u32).into_par_iter();
        let of_rings = vertices.halved().flat_map_iter(|vertex| {
            let ring = self.of(vertex);
            let is_before = move |other: u32| other < vertex && !self.of(other).is_empty();
            let corners = (0..ring.len()).map(move |index| [ring[index], ring[(index + 1) % ring.len()]]);
            corners
                .filter(move |ends| !ends.iter().any(|&end| is_before(end)))
                .map(move |[next, prev]| [vertex, next, prev])
        });
        of_rings.chain(self.locked.par_iter().copied()).collect()
    }
}

/// Spare capacity of a ring.
const SPARE: u32 = 2;

/// The neighbors before and after an index of a ring.
#[inline(always)]
fn adjacent(ring: &[u32], index: usize) -> (u32, u32) {
    let before = if index == 0 { ring.len() - 1 } else { index - 1 };
    let after = if index + 1 == ring.len() { 0 } else { index + 1 };
    (ring[before], ring[after])
}

/// The concatenated rings of a chunk of vertices, and their lengths; 0 for locked vertices.
fn rings_of_chunk(
    mesh: &Mesh,
    touching: &TouchingTriangles,
    chunk: usize,
    corners: &mut Corners,
) -> (Vec<u32>, Vec<u32>) {
    let first = chunk * CHUNK;
    let count = CHUNK.min(mesh.positions.len() - first);
    corners.collect(first as u32, count, touching.triangles(mesh, chunk));
    let mut neighbors = Vec::with_capacity(7 * count);
    let lengths = (0..count).map(|vertex| {
        let start = neighbors.len();
        if !push_ring(&mut neighbors, (first + vertex) as u32, corners.of(vertex)) {
            neighbors.truncate(start);
        }
        (neighbors.len() - start) as u32
    });
    let lengths = lengths.collect();
    (neighbors, lengths)
}

/// Appends the ring of a vertex, given its corners `[next, prev]`. Returns false if they do not form a ring;
/// the appended values are then meaningless.
fn push_ring(neighbors: &mut Vec<u32>, vertex: u32, corners: &[[u32; 2]]) -> bool {
    let start = neighbors.len();
    let is_sound = (DEGREE_MIN..=DEGREE_MAX).contains(&corners.len());
    let Some(&[first, mut at]) = corners.first().filter(|_| is_sound) else { return false };
    neighbors.push(first);
    for _ in 1..corners.len() {
        let mut following = corners.iter().filter(|corner| corner[0] == at);
        let (Some(&[next, prev]), None) = (following.next(), following.next()) else { return false };
        if next == vertex || neighbors[start..].contains(&next) {
            return false;
        }
        neighbors.push(next);
        at = prev;
    }
    at == first && first != vertex
}
