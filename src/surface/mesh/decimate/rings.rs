//! A mesh as the rings of neighbours around its vertices.
//!
//! ```text
//!        c ─── b
//!       ╱ ╲   ╱ ╲        ring of v: a b c d e, counter-clockwise;
//!      d ── v ── a       its triangles are v a b, v b c, …, v e a
//!       ╲   │   ╱
//!        ── e ──         v drawn onto a:   a's ring     … b v e …      becomes … b c d e …
//!                                          b's and e's                 lose v
//!                                          c's and d's                 have a in place of v
//! ```
//!
//! Only vertices whose triangles form one closed ring have one. The others are *locked*: they stay, and so do triangles that have locked
//! vertices only.

use rayon::prelude::*;

use super::super::corners::{Corners, Touching};
use super::super::{Mesh, PIECE};

/// The most neighbours of a vertex that is not locked, and of one that another is drawn onto.
pub(super) const DEGREE_MAX: usize = 16;

/// The fewest neighbours a vertex is left with.
const DEGREE_LEAST: usize = 3;

/// Where a ring is.
#[derive(Clone, Copy, Debug, Default)]
struct Span {
    start: usize,
    length: u32,
    /// How many neighbours there is room for.
    capacity: u32,
}

/// The rings of a mesh.
pub(super) struct Rings {
    neighbors: Vec<u32>,
    /// For each vertex; empty for those that are locked or gone.
    spans: Vec<Span>,
    /// Triangles without a ring.
    locked: Vec<[u32; 3]>,
}

impl Rings {
    /// The rings of a mesh.
    pub(super) fn new(mesh: &Mesh) -> Rings {
        let touching = Touching::new(mesh);
        let pieces = (0..mesh.positions.len().div_ceil(PIECE)).into_par_iter();
        let pieces: Vec<(Vec<u32>, Vec<u32>)> = pieces
            .map_init(Corners::default, |corners, piece| rings_of_piece(mesh, &touching, piece, corners))
            .collect();
        drop(touching);
        let mut spans = Vec::with_capacity(mesh.positions.len());
        let mut start = 0;
        for &length in pieces.iter().flat_map(|(_, lengths)| lengths) {
            spans.push(Span { start, length, capacity: length });
            start += length as usize;
        }
        let neighbors = pieces.into_iter().flat_map(|(neighbors, _)| neighbors).collect();
        let has_ring = |vertex: &u32| spans[*vertex as usize].length > 0;
        let locked = mesh.triangles.par_iter().filter(|triangle| !triangle.iter().any(has_ring)).copied();
        let locked = locked.collect();
        Rings { neighbors, spans, locked }
    }

    /// The ring of a vertex; empty if it is locked or gone.
    #[inline(always)]
    pub(super) fn of(&self, vertex: u32) -> &[u32] {
        let span = self.spans[vertex as usize];
        &self.neighbors[span.start..span.start + span.length as usize]
    }

    /// Whether drawing a vertex onto a neighbour leaves a manifold with the same pieces and holes (the link
    /// condition), and no vertex with too many neighbours or too few.
    #[inline(always)]
    pub(super) fn can_collapse(&self, vertex: u32, target: u32) -> bool {
        let (ring, around_target) = (self.of(vertex), self.of(target));
        let Some(place) = ring.iter().position(|&neighbor| neighbor == target) else { return false };
        let (before, after) = beside(ring, place);
        let common = around_target.iter().filter(|neighbor| ring.contains(neighbor)).count();
        common == 2
            && self.of(before).len() > DEGREE_LEAST
            && self.of(after).len() > DEGREE_LEAST
            && ring.len() + around_target.len() <= DEGREE_MAX + 4
    }

    /// Draws a vertex onto a neighbour. It must be one of those that [`can_collapse`](Rings::can_collapse) allows.
    pub(super) fn collapse(&mut self, vertex: u32, target: u32) {
        let mut ring = [0; DEGREE_MAX];
        let length = self.of(vertex).len();
        ring[..length].copy_from_slice(self.of(vertex));
        let Some(place) = ring[..length].iter().position(|&neighbor| neighbor == target) else { return };
        // From the target on, counter-clockwise.
        ring[..length].rotate_left(place);
        let (first, last) = (ring[1], ring[length - 1]);
        for &neighbor in &ring[2..length - 1] {
            if let Some(place) = self.place_of(neighbor, vertex) {
                self.neighbors[place] = target;
            }
        }
        for neighbor in [first, last] {
            if let Some(place) = self.place_of(neighbor, vertex) {
                let span = &mut self.spans[neighbor as usize];
                let end = span.start + span.length as usize;
                self.neighbors.copy_within(place + 1..end, place);
                span.length -= 1;
            }
        }
        self.insert(target, vertex, &ring[2..length - 1]);
        self.spans[vertex as usize].length = 0;
    }

    /// Where a neighbour is in the ring of a vertex.
    fn place_of(&self, vertex: u32, neighbor: u32) -> Option<usize> {
        let place = self.of(vertex).iter().position(|&other| other == neighbor)?;
        Some(self.spans[vertex as usize].start + place)
    }

    /// Puts `others` in the ring of a vertex in place of one that is there.
    fn insert(&mut self, vertex: u32, replaced: u32, others: &[u32]) {
        let mut ring = [0; 2 * DEGREE_MAX];
        let old = self.of(vertex);
        let Some(place) = old.iter().position(|&neighbor| neighbor == replaced) else { return };
        let length = old.len() + others.len() - 1;
        let end = place + others.len();
        ring[..place].copy_from_slice(&old[..place]);
        ring[place..end].copy_from_slice(others);
        ring[end..length].copy_from_slice(&old[place + 1..]);
        let span = &mut self.spans[vertex as usize];
        span.length = length as u32;
        if span.length > span.capacity {
            // At the end there is room, and it is made a little more than is needed.
            span.start = self.neighbors.len();
            span.capacity = span.length + SPARE;
            self.neighbors.resize(span.start + span.capacity as usize, 0);
        }
        self.neighbors[span.start..span.start + length].copy_from_slice(&ring[..length]);
    }

    /// The triangles: those of each ring that no vertex before has.
    pub(super) fn triangles(&self, mesh: &Mesh) -> Vec<[u32; 3]> {
        let vertices = (0..mesh.positions.len() as u32).into_par_iter();
        let of_rings = vertices.flat_map_iter(|vertex| {
            let ring = self.of(vertex);
            let is_before = move |other: u32| other < vertex && !self.of(other).is_empty();
            let corners = (0..ring.len()).map(move |place| [ring[place], ring[(place + 1) % ring.len()]]);
            corners
                .filter(move |ends| !ends.iter().any(|&end| is_before(end)))
                .map(move |[next, prev]| [vertex, next, prev])
        });
        of_rings.chain(self.locked.par_iter().copied()).collect()
    }
}

/// Room for neighbours yet to come.
const SPARE: u32 = 2;

/// The neighbours before and after a place of a ring.
#[inline(always)]
fn beside(ring: &[u32], place: usize) -> (u32, u32) {
    let before = if place == 0 { ring.len() - 1 } else { place - 1 };
    let after = if place + 1 == ring.len() { 0 } else { place + 1 };
    (ring[before], ring[after])
}

/// The rings of a piece of vertices, one after the other, and their lengths; 0 for those that are locked.
fn rings_of_piece(
    mesh: &Mesh,
    touching: &Touching,
    piece: usize,
    corners: &mut Corners,
) -> (Vec<u32>, Vec<u32>) {
    let first = piece * PIECE;
    let count = PIECE.min(mesh.positions.len() - first);
    corners.collect(first as u32, count, touching.triangles(mesh, piece));
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

/// Adds the ring of a vertex, given its corners `[next, prev]`. Returns whether they are one: if not, what was added is of
/// no use.
fn push_ring(neighbors: &mut Vec<u32>, vertex: u32, corners: &[[u32; 2]]) -> bool {
    let start = neighbors.len();
    let is_sound = (DEGREE_LEAST..=DEGREE_MAX).contains(&corners.len());
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
