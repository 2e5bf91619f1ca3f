//! A mesh stored as the rings of neighbors around its vertices.
//!
//! ```text
//!        c ─── b
//!       ╱ ╲   ╱ ╲        ring of v: a b c d e, counter-clockwise;
//!      d ── v ── a       its triangles are v a b, v b c, …, v e a
//!       ╲   │   ╱
//!        ── e ──         v collapsed into a:   ring of a         … b v e …  becomes  … b c d e …
//!                                              rings of b and e  lose v
//!                                              rings of c and d  have a instead of v
//! ```
//!
//! A vertex has a ring only if its triangles form one closed ring of at most [`DEGREE_MAX`] triangles. All
//! other vertices are *locked*: they are kept, and so are triangles with three locked vertices.

use rayon::prelude::*;

use super::super::corners::{Corners, TouchingTriangles};
use super::super::{CHUNK, Mesh};
use crate::parallel::Loops as _;

/// Maximum number of neighbors of a vertex that is not locked, also after a collapse into it.
pub(super) const DEGREE_MAX: usize = 16;

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
pub(super) struct Rings {
    neighbors: Vec<u32>,
    /// One per vertex; empty if the vertex is locked or removed.
    spans: Vec<RingSpan>,
    /// Triangles with three locked vertices, which are in no ring.
    locked: Vec<[u32; 3]>,
}

impl Rings {
    /// The rings of a mesh.
    pub(super) fn new(mesh: &Mesh) -> Rings {
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
    pub(super) fn of(&self, vertex: u32) -> &[u32] {
        let span = self.spans[vertex as usize];
        &self.neighbors[span.start..span.start + span.length as usize]
    }

    /// True if collapsing a vertex into a neighbor preserves the topology (the link condition) and leaves no
    /// vertex with too many or too few neighbors.
    #[inline(always)]
    pub(super) fn can_collapse(&self, vertex: u32, target: u32) -> bool {
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
    pub(super) fn collapse(&mut self, vertex: u32, target: u32) {
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
    pub(super) fn triangles(&self, mesh: &Mesh) -> Vec<[u32; 3]> {
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
