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

mod collapse;
mod rings;

use glam::Vec3;
use rayon::prelude::*;

use super::Mesh;
use crate::interrupt::checkpoint;
use crate::parallel::Loops as _;
use collapse::{Collapse, VertexStar};
use rings::Rings;

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
const CHUNK: usize = 1024;

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
        let chosen: Vec<Vec<u32>> = (0..self.best.len().div_ceil(CHUNK))
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
            dirty.par_iter().with_min_len(CHUNK).halved().map(find_collapse).collect();
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
        let first = chunk * CHUNK;
        let vertices = first..self.best.len().min(first + CHUNK);
        let key = |vertex: usize| (self.best[vertex].bound, vertex);
        let is_chosen = |&vertex: &usize| {
            let own = key(vertex);
            let is_first = |neighbor: &u32| own < key(*neighbor as usize);
            own.0 <= limit && self.rings.of(vertex as u32).iter().all(is_first)
        };
        vertices.filter(is_chosen).map(|vertex| vertex as u32).collect()
    }
}
