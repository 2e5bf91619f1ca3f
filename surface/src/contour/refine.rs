//! Splits triangles where the surface bends more than they do.
//!
//! ```text
//!     chord                    1 edge            2 edges           3 edges
//!   p ─────── q                  c                  c                 c
//!  ╱   ↑ sag   ╲               ╱ │ ╲              ╱   ╲             ╱   ╲
//!  ╲   m       ╱  φ = 0       ╱  │  ╲           m₂───m₁            m₂───m₁
//!    ‾ ─ ─ ─ ‾               a ──m── b         ╱   ╱    ╲         ╱  ╲ ╱  ╲
//!                                             a ─────── b        a ── m₀ ── b
//! ```
//!
//! A drop with a radius of two voxels is a polyhedron in the dual mesh: its vertices are on φ = 0, but φ bends
//! by half a radian from one to the next. An edge is split if φ = 0 is farther from its middle than a tolerance,
//! as the normals of its ends tell, and only where the radius of curvature is small: flat water keeps its
//! triangles. Both triangles of an edge see the same split, so the mesh stays closed and manifold.
//!
//! A new vertex starts in the middle of a cubic curve between the ends, and one step along ∇φ moves it onto the
//! zero of the [tricubic spline](Sampler). The ends are moved in the same way: some are off the zero, because dual
//! contouring keeps them in their cells. Normals are gradients of φ like those of all other vertices, so a reflection does not
//! show where triangles were split. The steps are shorter than a part of the edge, so triangles do not fold.
//!
//! Triangles that are not split come first, in their order. The others follow, each with its lowest vertex
//! first, so no two of them look like the halves of a [quad](Mesh::quads); the other half of a quad of which
//! one half is split is among them.

use glam::{DVec3, IVec3, Vec3};
use rayon::prelude::*;
use rustc_hash::FxHashMap;

use super::{MeshPlacement, fill_zero_normals, unit_or_zero};
use crate::level_set::{NarrowBand, Sampler};
use crate::mesh::{Mesh, are_halves};
use crate::parallel::Loops as _;
use crate::simd::{Kernel, Lanes, dispatch};
use crate::space::Lattice;

/// Number of times that edges are split.
const ROUNDS: usize = 2;

/// Edges are split where φ = 0 is farther from their middle than this, in voxels.
const TOLERANCE: f32 = 0.034;

/// Edges are split where the radius of curvature is less than this, in voxels.
const RADIUS: f32 = 3.0;

/// How far a vertex of the dual mesh is moved at most, in voxels.
const END_REACH: f32 = 0.125;

/// How far the middle of an edge is moved at most, in lengths of the edge.
const MIDDLE_REACH: f32 = 0.125;

/// Number of triangles per task.
const CHUNK: usize = 4096;

/// Number of vertices per task.
const VERTEX_CHUNK: usize = 1024;

/// The two ends of an edge, in ascending order.
type MeshEdge = [u32; 2];

/// Splits the triangles of a mesh of φ where the surface is strongly curved.
pub fn refine(mesh: &mut Mesh, band: &NarrowBand, lattice: &Lattice) {
    let triangles = std::mem::take(&mut mesh.triangles);
    let placement = MeshPlacement::new(&band.topology, lattice);
    mesh.triangles = Refinement { mesh, band, placement, first_new: 0 }.round(triangles, ROUNDS);
    fill_zero_normals(mesh);
}

/// A mesh whose triangles are split.
struct Refinement<'a> {
    mesh: &'a mut Mesh,
    band: &'a NarrowBand,
    placement: MeshPlacement,
    /// The first vertex of the last round: edges without such a vertex have been examined.
    first_new: usize,
}

impl Refinement<'_> {
    /// Splits these triangles, and then their parts.
    fn round(&mut self, mut triangles: Vec<[u32; 3]>, rounds: usize) -> Vec<[u32; 3]> {
        let edges = if rounds == 0 { Vec::new() } else { self.bent_edges(&triangles) };
        if edges.is_empty() {
            return triangles;
        }
        let mut is_end = vec![false; self.mesh.positions.len()];
        edges.iter().flatten().for_each(|&end| is_end[end as usize] = true);
        if self.first_new == 0 {
            self.move_ends(&is_end);
        }
        let middles = Middles { of_edge: self.add_middles(&edges), is_end };
        let parts = middles.split(self.mesh, &mut triangles);
        triangles.extend(self.round(parts, rounds - 1));
        triangles
    }

    /// The edges to split. Each is in one triangle from its lower to its higher vertex.
    fn bent_edges(&self, triangles: &[[u32; 3]]) -> Vec<MeshEdge> {
        let of_chunk = |triangles: &[[u32; 3]]| {
            let mut bent = Vec::new();
            for &[a, b, c] in triangles {
                for edge in [[a, b], [b, c], [c, a]] {
                    if edge[0] < edge[1] && self.is_bent(edge) {
                        bent.push(edge);
                    }
                }
            }
            bent
        };
        let chunks: Vec<Vec<MeshEdge>> = triangles.par_chunks(CHUNK).halved().map(of_chunk).collect();
        chunks.concat()
    }

    #[inline(always)]
    fn is_bent(&self, [from, to]: MeshEdge) -> bool {
        let [from, to] = [from as usize, to as usize];
        if to < self.first_new {
            return false;
        }
        let chord = self.mesh.positions[to] - self.mesh.positions[from];
        let chord = chord / self.placement.voxel_size as f32;
        // The angle between the normals times the length of the chord, in voxels.
        let turn = chord.dot(self.mesh.normals[to] - self.mesh.normals[from]).abs();
        turn > 8.0 * TOLERANCE && turn * RADIUS > chord.length_squared()
    }

    /// Moves the ends of edges onto the zero of φ.
    fn move_ends(&mut self, is_end: &[bool]) {
        let ends: Vec<u32> = (0..).zip(is_end).filter(|(_, is_end)| **is_end).map(|(end, _)| end).collect();
        let moved = self.on_zero(&ends, |&end| (self.index(end), END_REACH));
        for (end, (position, normal)) in ends.into_iter().zip(moved) {
            self.mesh.positions[end as usize] = position;
            self.mesh.normals[end as usize] = normal;
        }
    }

    /// Adds a vertex near the middle of each of these edges, and returns it for each [`key`].
    fn add_middles(&mut self, edges: &[MeshEdge]) -> FxHashMap<u64, u32> {
        self.first_new = self.mesh.positions.len();
        assert!(self.first_new + edges.len() <= u32::MAX as usize, "more vertices than 32-bit indices allow");
        let moved = self.on_zero(edges, |&edge| self.curved_middle(edge));
        let (positions, normals): (Vec<Vec3>, Vec<Vec3>) = moved.into_iter().unzip();
        self.mesh.positions.extend(positions);
        self.mesh.normals.extend(normals);
        edges.iter().map(|&edge| key(edge)).zip(self.first_new as u32..).collect()
    }

    /// The middle of the cubic curve between the ends of an edge that is perpendicular to their normals, and how far
    /// it may be moved.
    #[inline(always)]
    fn curved_middle(&self, edge: MeshEdge) -> (DVec3, f32) {
        let [one, other] = edge.map(|end| self.index(end));
        let [normal, other_normal] = edge.map(|end| self.mesh.normals[end as usize]);
        let chord = (other - one).as_vec3();
        let bulge = (other_normal * chord.dot(other_normal) - normal * chord.dot(normal)) / 8.0;
        (0.5 * (one + other) + bulge.as_dvec3(), MIDDLE_REACH * chord.length())
    }

    /// The position of a vertex in voxels.
    #[inline(always)]
    fn index(&self, vertex: u32) -> DVec3 {
        let position = self.mesh.positions[vertex as usize].as_dvec3();
        position / self.placement.voxel_size + self.placement.origin_index.as_dvec3()
    }

    /// For each item, the position on the zero of φ near a point, and the normal there. `point` returns the point
    /// and how far it may be moved, in voxels.
    fn on_zero<T: Sync, P>(&self, items: &[T], point: P) -> Vec<(Vec3, Vec3)>
    where
        P: Fn(&T) -> (DVec3, f32) + Sync,
    {
        let (band, placement) = (self.band, &self.placement);
        let of_chunk = |items| dispatch(OnZero { band, placement, items, point: &point });
        let chunks: Vec<Vec<(Vec3, Vec3)>> = items.par_chunks(VERTEX_CHUNK).halved().map(of_chunk).collect();
        chunks.concat()
    }
}

/// The key of an edge.
fn key([from, to]: MeshEdge) -> u64 {
    u64::from(from) << 32 | u64::from(to)
}

/// Kernel: moves points onto the zero of φ.
struct OnZero<'a, T, P> {
    band: &'a NarrowBand,
    placement: &'a MeshPlacement,
    items: &'a [T],
    point: &'a P,
}

impl<T, P: Fn(&T) -> (DVec3, f32)> Kernel for OnZero<'_, T, P> {
    type Output = Vec<(Vec3, Vec3)>;

    #[inline(always)]
    fn run<V: Lanes>(self) -> Vec<(Vec3, Vec3)> {
        let mut sampler = Sampler::new(self.band);
        let mut moved = Vec::with_capacity(self.items.len());
        for item in self.items {
            let (point, reach) = (self.point)(item);
            let voxel = point.floor();
            let start = (point - voxel).as_vec3();
            let (local, normal) = on_zero(&mut sampler, voxel.as_ivec3(), start, reach);
            moved.push((self.placement.position(voxel.as_ivec3(), local), normal));
        }
        moved
    }
}

/// The point near `voxel + start` where φ is zero, relative to the voxel, and the direction of ∇φ there. It is
/// at most `reach` from the start.
#[inline(always)]
fn on_zero(sampler: &mut Sampler, voxel: IVec3, start: Vec3, reach: f32) -> (Vec3, Vec3) {
    let Some((phi, gradient)) = sampler.sample_with_gradient(voxel, start) else {
        return (start, Vec3::ZERO);
    };
    let step = gradient * (-phi / gradient.length_squared().max(0.25));
    let moved = start + step.clamp_length_max(reach);
    (if moved.is_finite() { moved } else { start }, unit_or_zero(gradient))
}

/// The new vertices.
struct Middles {
    /// For the [`key`] of each split edge, its new vertex.
    of_edge: FxHashMap<u64, u32>,
    /// For each other vertex, whether it is an end of a split edge.
    is_end: Vec<bool>,
}

impl Middles {
    /// Removes the triangles that are split, and the other halves of their quads, and returns what replaces them.
    fn split(&self, mesh: &Mesh, triangles: &mut Vec<[u32; 3]>) -> Vec<[u32; 3]> {
        let all: &[[u32; 3]] = triangles;
        let of_chunk = |(chunk, part): (usize, &[[u32; 3]])| {
            let (mut removed, mut parts) = (Vec::new(), Vec::new());
            for (index, &triangle) in (chunk * CHUNK..).zip(part) {
                if !triangle.iter().any(|&vertex| self.is_end[vertex as usize]) {
                    continue;
                }
                let middles = self.of(triangle);
                if middles != [None; 3] || self.splits_other_half(all, index) {
                    removed.push(index);
                    push_parts(mesh, triangle, middles, &mut parts);
                }
            }
            (removed, parts)
        };
        let chunks = all.par_chunks(CHUNK).enumerate().halved().map(of_chunk);
        let (removed, parts): (Vec<Vec<usize>>, Vec<Vec<[u32; 3]>>) = chunks.unzip();
        let mut removed = removed.into_iter().flatten().peekable();
        let mut indices = 0..;
        triangles.retain(|_| removed.next_if_eq(&indices.next().unwrap_or(0)).is_none());
        parts.concat()
    }

    /// The new vertices on the edges ab, bc and ca of a triangle.
    fn of(&self, [a, b, c]: [u32; 3]) -> [Option<u32>; 3] {
        [[a, b], [b, c], [c, a]].map(|[from, to]| {
            let may_be_split = self.is_end[from as usize] && self.is_end[to as usize];
            may_be_split.then(|| self.of_edge.get(&key([from.min(to), from.max(to)])).copied()).flatten()
        })
    }

    /// Whether a triangle is the half of a quad whose other half is split.
    fn splits_other_half(&self, triangles: &[[u32; 3]], index: usize) -> bool {
        let before = index.checked_sub(1).map(|before| [before, index, before]);
        [before, Some([index, index + 1, index + 1])].into_iter().flatten().any(|[first, second, other]| {
            let pair = triangles.get(first).zip(triangles.get(second));
            pair.is_some_and(|(first, second)| are_halves(*first, *second))
                && self.of(triangles[other]) != [None; 3]
        })
    }
}

/// Adds the parts of a triangle with new vertices on its edges ab, bc and ca.
fn push_parts(mesh: &Mesh, [a, b, c]: [u32; 3], middles: [Option<u32>; 3], parts: &mut Vec<[u32; 3]>) {
    let mut push = |[a, b, c]: [u32; 3]| {
        let is_first = |vertex: u32| vertex == a.min(b).min(c);
        parts.push(if is_first(a) {
            [a, b, c]
        } else if is_first(b) {
            [b, c, a]
        } else {
            [c, a, b]
        });
    };
    match middles {
        [None, None, None] => push([a, b, c]),
        [Some(m), None, None] => [[a, m, c], [m, b, c]].into_iter().for_each(push),
        [None, Some(m), Some(n)] => {
            let position = |vertex: u32| mesh.positions[vertex as usize].as_dvec3();
            let length = |from: u32, to: u32| position(from).distance_squared(position(to));
            push([n, m, c]);
            if length(a, m) <= length(b, n) {
                [[a, b, m], [a, m, n]].into_iter().for_each(push);
            } else {
                [[a, b, n], [b, m, n]].into_iter().for_each(push);
            }
        }
        [Some(k), Some(m), Some(n)] => {
            [[a, k, n], [k, b, m], [n, m, c], [k, m, n]].into_iter().for_each(push);
        }
        [k, m, n] => push_parts(mesh, [b, c, a], [m, n, k], parts),
    }
}
