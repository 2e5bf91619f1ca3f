//! Fewer triangles, within an error: vertices are drawn onto neighbours as long as the surface stays where it was.
//!
//! ```text
//!        b ─── c              b ─── c
//!       ╱ ╲   ╱ ╲            ╱ ╲     ╲
//!      a ── v ── d    ──▶   a    ╲    d       v is drawn onto the neighbour w: two triangles go,
//!       ╲   │   ╱            ╲    ╲  ╱        and no vertex moves or is new
//!        f ─ w                f ─── w
//! ```
//!
//! **The error is a bound.** Seen along the mean normal of v's triangles, the triangles before and after are the graphs
//! of two functions over the same polygon (a collapse for which that is not so is refused). Going from one to
//! the other along the normal maps the old surface onto the new one, continuously and one to one; the way is
//! longest at v or where an edge of the one crosses an edge of the other ([`collapse`]). So a triangle's bound is
//! that of the triangles it came from and the longest way on top: there is a map of the whole surface onto
//! the decimated one that moves no point by more than the greatest bound. Distances hold both ways, therefore, and
//! no piece, hole or handle comes or goes. What is not promised is that sheets nearer to each other than twice the
//! error stay apart.
//!
//! The measure of a collapse is the same bound. Quadrics, those of v's own triangles, tell which neighbour to try
//! first.
//!
//! **The order is local.** There is no queue for the whole mesh. In each of a fixed number of rounds, the limit of which
//! grows to the error, those vertices are drawn onto a neighbour whose bound is the least of all around
//! them, and of two that are equal the first. So a change in one place is felt a few triangles farther with each round;
//! and the result is the same on any number of threads.
//!
//! Vertices of the result are vertices of the mesh and keep their normals. Where the mesh is open or not a manifold it is left as it is.
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
use collapse::{Collapse, Patch};
use rings::Rings;

/// What decimating did.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct DecimateReport {
    /// Vertices that were taken out.
    pub removed_vertex_count: usize,
    /// Triangles that were taken out.
    pub removed_triangle_count: usize,
    /// No point of the surface moved farther than this, world units. At most the error that was allowed.
    pub error_world_max: f64,
}

/// The limit of the bound in the first round, as a part of the error, and by how much it grows with each. If all were done
/// at once, long edges would come about before short ones are gone, and 3 % more triangles would be left.
const FIRST_LIMIT: f32 = 1.0 / 32.0;
const LIMIT_GROWTH: f32 = 1.189_207_1; // 2^(1/4)

/// Rounds. The limit has grown to the error after 20 of them; more than 12 after that find next to nothing.
const ROUND_COUNT: usize = 32;

/// Vertices in a piece of work.
const PIECE: usize = 1024;

/// Takes out triangles as long as no point of the surface moves by more than `error_world`, in world units. The result
/// is closed and a manifold where the mesh was.
///
/// Panics if a triangle names a vertex that does not exist.
pub fn decimate(mesh: &mut Mesh, error_world: f64) -> DecimateReport {
    if error_world.is_nan() || error_world <= 0.0 {
        return DecimateReport::default();
    }
    // Rounded down, so that no bound is above what was allowed.
    let nearest = error_world.min(f64::from(f32::MAX)) as f32;
    let error = if f64::from(nearest) > error_world { nearest.next_down() } else { nearest };
    let mut thinning = Thinning::new(mesh);
    let mut limit = error * FIRST_LIMIT;
    for _ in 0..ROUND_COUNT {
        thinning.round(limit);
        limit = (limit * LIMIT_GROWTH).min(error);
    }
    let Thinning { rings, bounds, .. } = thinning;
    let before = (mesh.positions.len(), mesh.triangles.len());
    let bound = bounds.par_iter().copied().reduce(|| 0.0, f32::max);
    mesh.triangles = rings.triangles(mesh);
    mesh.drop_unused_vertices();
    DecimateReport {
        removed_vertex_count: before.0 - mesh.positions.len(),
        removed_triangle_count: before.1 - mesh.triangles.len(),
        error_world_max: f64::from(bound),
    }
}

/// In place of the bound of a vertex that cannot be drawn anywhere.
const NEVER: f32 = f32::INFINITY;

/// A mesh while it is decimated.
struct Thinning<'a> {
    positions: &'a [Vec3],
    rings: Rings,
    /// For each vertex: no point of its triangles has moved farther.
    bounds: Vec<f32>,
    /// For each vertex the best collapse that is known. Of those that wait to be looked at it is not.
    best: Vec<Collapse>,
    /// Vertices whose surroundings have changed since they were looked at.
    waiting: Vec<u32>,
    is_waiting: Vec<bool>,
}

impl<'a> Thinning<'a> {
    fn new(mesh: &'a Mesh) -> Thinning<'a> {
        let count = mesh.positions.len();
        Thinning {
            positions: &mesh.positions,
            rings: Rings::new(mesh),
            bounds: vec![0.0; count],
            best: vec![Collapse { bound: NEVER, target: 0 }; count],
            waiting: (0..count as u32).collect(),
            is_waiting: vec![true; count],
        }
    }

    /// Draws vertices onto neighbours whose bound stays within a limit.
    fn round(&mut self, limit: f32) {
        self.look_at_waiting(limit);
        let chosen: Vec<Vec<u32>> = (0..self.best.len().div_ceil(PIECE))
            .into_par_iter()
            .map(|piece| self.chosen_in_piece(piece, limit))
            .collect();
        for vertex in chosen.into_iter().flatten() {
            let Collapse { bound, target } = self.best[vertex as usize];
            // Two that were chosen may have a neighbour in common; then the second looks again.
            if !self.rings.can_collapse(vertex, target) {
                self.wait(vertex);
                continue;
            }
            for place in 0..self.rings.of(vertex).len() {
                let neighbor = self.rings.of(vertex)[place];
                let old = &mut self.bounds[neighbor as usize];
                *old = old.max(bound);
                self.wait(neighbor);
            }
            self.rings.collapse(vertex, target);
            self.best[vertex as usize].bound = NEVER;
        }
    }

    fn wait(&mut self, vertex: u32) {
        let is_waiting = &mut self.is_waiting[vertex as usize];
        if !*is_waiting {
            *is_waiting = true;
            self.waiting.push(vertex);
        }
    }

    /// Finds the best collapse of those that wait, but for those that are above the limit whatever they do.
    fn look_at_waiting(&mut self, limit: f32) {
        let waiting = std::mem::take(&mut self.waiting);
        let look = |&vertex: &u32| {
            let ring = self.rings.of(vertex);
            let Some(patch) = Patch::new(self.positions, vertex, ring, &self.bounds) else {
                return Some(Collapse { bound: NEVER, target: 0 });
            };
            let is_in_reach = patch.bound <= limit;
            is_in_reach.then(|| patch.best_collapse(&self.rings))
        };
        let found: Vec<Option<Collapse>> = waiting.par_iter().with_min_len(PIECE).map(look).collect();
        for (vertex, found) in waiting.into_iter().zip(found) {
            let place = vertex as usize;
            self.best[place] = found.unwrap_or(Collapse { bound: NEVER, target: 0 });
            if found.is_none() {
                self.waiting.push(vertex);
            } else {
                self.is_waiting[place] = false;
            }
        }
    }

    /// The vertices of a piece whose bound is within the limit, and the least of all around them.
    fn chosen_in_piece(&self, piece: usize, limit: f32) -> Vec<u32> {
        let first = piece * PIECE;
        let vertices = first..self.best.len().min(first + PIECE);
        let key = |vertex: usize| (self.best[vertex].bound, vertex);
        let is_chosen = |&vertex: &usize| {
            let own = key(vertex);
            let is_first = |neighbor: &u32| own < key(*neighbor as usize);
            own.0 <= limit && self.rings.of(vertex as u32).iter().all(is_first)
        };
        vertices.filter(is_chosen).map(|vertex| vertex as u32).collect()
    }
}
