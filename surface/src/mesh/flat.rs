//! Removes triangles without area, keeping the mesh closed.
//!
//! ```text
//!   needle                                  cap
//!
//!        c                    c                  c                      c
//!      ╱   ╲                ╱   ╲              ╱   ╲                  ╱ │ ╲
//!    ╱   ╭──u       ──▶   ╱      ╲           a ─ u ─ b       ──▶     a  u  b       u lies on the edge a–b
//!   d ───┴──v            d ────── v            ╲   ╱                  ╲ │ ╱
//!                                                d                      d
//!   u coincides with v, or almost:          the edge a–b, on which u lies, is flipped
//!   it is collapsed into v                  to u–d: no vertex moves
//! ```
//!
//! Flat triangles result from rounding positions to 32 bits far from the mesh's origin, or from that of the
//! world. A triangle is flat if it has no area.
//!
//! Both operations keep the mesh closed and manifold: a vertex is collapsed into a neighbor only if they have
//! exactly two common neighbors, and an edge is flipped only if its new ends are not yet connected. An
//! isolated tetrahedron without volume is removed as a whole. The rest of the mesh does not change, and no
//! vertex moves. Flat triangles that cannot be removed stay, and [`Mesh::measure`] counts them.

use glam::{DVec3, Vec3};
use rayon::prelude::*;
use rustc_hash::{FxHashMap, FxHashSet};

use super::Mesh;
use super::corners::{LANES, TriangleBatch};
use crate::parallel::Loops as _;

/// Number of triangles per task.
const CHUNK: usize = 4096;

/// Maximum number of rounds; usually one or two are enough.
const ROUNDS_MAX: usize = 64;

/// If a larger fraction of the triangles is flat, the positions are too coarse for the mesh, and the mesh is
/// left unchanged.
const FLAT_PART_MAX: f64 = 0.05;

/// Up to this many flat triangles are processed even if they are a larger fraction, because it is cheap.
const SMALL_MESH_TRIANGLES: usize = 10_000;

/// The shortest edge of a needle is at most this fraction of its longest edge; otherwise the triangle is a
/// cap.
const NEEDLE: f64 = 0.1;

impl Mesh {
    /// Removes triangles without area. Returns the number of removed triangles. Leaves a mesh unchanged if a
    /// large part of it is flat.
    ///
    /// Panics if a triangle refers to a vertex that does not exist.
    pub fn remove_flat_triangles(&mut self) -> usize {
        let before = self.triangles.len();
        // Triangles may flip over only if nothing else helps.
        let mut may_fold = false;
        for _ in 0..ROUNDS_MAX {
            let flat = flat_triangles(&self.positions, &self.triangles);
            let flat_max = SMALL_MESH_TRIANGLES.max((FLAT_PART_MAX * self.triangles.len() as f64) as usize);
            if flat.is_empty() || flat.len() > flat_max {
                break;
            }
            let mut removal = FlatRemoval::new(&self.positions, &self.triangles, &flat, may_fold);
            let changed = flat.iter().filter(|&&triangle| removal.remove_flat(triangle)).count();
            let triangles = removal.triangles;
            if changed == 0 && may_fold {
                break;
            }
            may_fold = changed == 0;
            self.triangles = triangles;
            self.triangles.retain(|triangle| *triangle != REMOVED);
            self.drop_unused_vertices();
        }
        before - self.triangles.len()
    }
}

/// Marks a removed triangle.
const REMOVED: [u32; 3] = [u32::MAX; 3];

/// Indices of the degenerate triangles at these positions, in order.
fn flat_triangles(positions: &[Vec3], triangles: &[[u32; 3]]) -> Vec<u32> {
    let of_piece = |(chunk, triangles): (usize, &[[u32; 3]])| {
        let mut flat = Vec::new();
        for (batch, triangles) in triangles.chunks(LANES).enumerate() {
            let degenerate = TriangleBatch::new(positions, triangles).degenerate();
            let first = chunk * CHUNK + batch * LANES;
            let is_flat = |&lane: &usize| degenerate[lane] > 0;
            flat.extend((0..triangles.len()).filter(is_flat).map(|lane| (first + lane) as u32));
        }
        flat
    };
    triangles.par_chunks(CHUNK).enumerate().halved().flat_map_iter(of_piece).collect()
}

/// A mesh under modification, with the neighborhoods of its flat triangles.
struct FlatRemoval<'a> {
    positions: &'a [Vec3],
    triangles: Vec<[u32; 3]>,
    /// For each corner of a flat triangle, and for each neighbor of such a corner, the triangles around it.
    around: FxHashMap<u32, Vec<u32>>,
    may_fold: bool,
}

impl<'a> FlatRemoval<'a> {
    fn new(positions: &'a [Vec3], triangles: &[[u32; 3]], flat: &[u32], may_fold: bool) -> FlatRemoval<'a> {
        let corners: FxHashSet<u32> = flat.iter().flat_map(|&flat| triangles[flat as usize]).collect();
        let touches = |triangle: &&[u32; 3]| triangle.iter().any(|vertex| corners.contains(vertex));
        let near: Vec<[u32; 3]> = triangles.par_iter().halved().filter(touches).copied().collect();
        let mut around: FxHashMap<u32, Vec<u32>> = FxHashMap::default();
        around.extend(near.into_iter().flatten().map(|vertex| (vertex, Vec::new())));
        let is_near =
            |(_, triangle): &(u32, &[u32; 3])| triangle.iter().any(|vertex| around.contains_key(vertex));
        let found: Vec<(u32, &[u32; 3])> =
            (0..triangles.len() as u32).into_par_iter().zip(triangles).halved().filter(is_near).collect();
        for (index, triangle) in found {
            for vertex in triangle {
                if let Some(list) = around.get_mut(vertex) {
                    list.push(index);
                }
            }
        }
        FlatRemoval { positions, triangles: triangles.to_vec(), around, may_fold }
    }

    /// Removes a flat triangle, or turns it into one with an area. Returns true on success.
    fn remove_flat(&mut self, triangle: u32) -> bool {
        let corners = self.triangles[triangle as usize];
        if !self.is_flat(corners) {
            return false;
        }
        // Each edge with its opposite corner, shortest first.
        let mut edges = [0, 1, 2].map(|k| {
            let [from, to] = [corners[k], corners[(k + 1) % 3]];
            (self.position(from).distance(self.position(to)), k)
        });
        edges.sort_unstable_by(|one, other| one.0.total_cmp(&other.0).then(one.1.cmp(&other.1)));
        let [shortest, middle, longest] = edges;
        let ends = |k: usize| [corners[k], corners[(k + 1) % 3]];
        let is_needle = shortest.0 <= NEEDLE * longest.0;
        is_needle && self.collapse_edge(ends(shortest.1))
            || self.flip_edge(triangle, ends(longest.1))
            || self.collapse_edge(ends(shortest.1))
            || self.collapse_edge(ends(middle.1))
            || self.flip_edge(triangle, ends(middle.1))
            || self.collapse_edge(ends(longest.1))
            || self.remove_isolated_tetrahedron(triangle)
    }

    /// Removes the isolated tetrahedron that a flat triangle belongs to, if any: since one of its triangles
    /// has no area, it has no volume. Particles in it then count as outside.
    fn remove_isolated_tetrahedron(&mut self, triangle: u32) -> bool {
        let corners = self.triangles[triangle as usize];
        let mut all: Vec<u32> =
            corners.iter().flat_map(|&corner| self.triangles_of(corner)).copied().collect();
        all.sort_unstable();
        all.dedup();
        let mut vertices: Vec<u32> =
            all.iter().flat_map(|&triangle| self.triangles[triangle as usize]).collect();
        vertices.sort_unstable();
        vertices.dedup();
        let is_speck = all.len() == 4
            && vertices.len() == 4
            && vertices.iter().all(|&vertex| self.triangles_of(vertex).len() == 3);
        if is_speck {
            for triangle in all {
                self.triangles[triangle as usize] = REMOVED;
            }
            for vertex in vertices {
                self.around.remove(&vertex);
            }
        }
        is_speck
    }

    /// Number of triangles without area.
    fn flat_count(&self, triangles: impl Iterator<Item = [u32; 3]>) -> usize {
        triangles.filter(|&triangle| self.is_flat(triangle)).count()
    }

    fn is_flat(&self, triangle: [u32; 3]) -> bool {
        triangle != REMOVED && TriangleBatch::new(self.positions, &[triangle]).degenerate()[0] > 0
    }

    /// True if two triangles face approximately the same side. A triangle without area faces all sides.
    fn faces_alike(&self, old: [u32; 3], new: [u32; 3]) -> bool {
        self.is_flat(old) || self.is_flat(new) || self.area_vector(old).dot(self.area_vector(new)) > 0.0
    }

    /// Twice the area, as a vector along the normal.
    fn area_vector(&self, [a, b, c]: [u32; 3]) -> DVec3 {
        let [a, b, c] = [a, b, c].map(|corner| self.position(corner));
        (b - a).cross(c - a)
    }

    fn position(&self, vertex: u32) -> DVec3 {
        self.positions[vertex as usize].as_dvec3()
    }

    fn triangles_of(&self, vertex: u32) -> &[u32] {
        self.around.get(&vertex).map_or(&[], Vec::as_slice)
    }

    fn has(&self, triangle: u32, vertex: u32) -> bool {
        self.triangles[triangle as usize].contains(&vertex)
    }

    /// The triangles that contain both vertices.
    fn shared(&self, one: u32, other: u32) -> Vec<u32> {
        self.triangles_of(one).iter().copied().filter(|&triangle| self.has(triangle, other)).collect()
    }

    fn neighbors(&self, vertex: u32) -> Vec<u32> {
        let triangles = self.triangles_of(vertex).iter();
        let mut neighbors: Vec<u32> =
            triangles.flat_map(|&triangle| self.triangles[triangle as usize]).collect();
        neighbors.sort_unstable();
        neighbors.dedup();
        neighbors.retain(|&neighbor| neighbor != vertex);
        neighbors
    }

    /// Collapses an edge into one of its ends.
    fn collapse_edge(&mut self, [one, other]: [u32; 2]) -> bool {
        let (lesser, greater) = (one.min(other), one.max(other));
        self.collapse(greater, lesser) || self.collapse(lesser, greater)
    }

    fn collapse(&mut self, vertex: u32, target: u32) -> bool {
        let (ring, ring_of_target) = (self.neighbors(vertex), self.neighbors(target));
        let common: Vec<u32> =
            ring.iter().copied().filter(|neighbor| ring_of_target.binary_search(neighbor).is_ok()).collect();
        let gone = self.shared(vertex, target);
        // The link condition. In addition, each vertex that loses a triangle must keep at least three.
        let is_manifold = gone.len() == 2
            && common.len() == 2
            && common.iter().all(|&neighbor| self.triangles_of(neighbor).len() > 3)
            && ring.len() + ring_of_target.len() > 6;
        if !is_manifold {
            return false;
        }
        let own = self.triangles_of(vertex).to_vec();
        let moved = |triangle: u32| {
            self.triangles[triangle as usize].map(|corner| if corner == vertex { target } else { corner })
        };
        let kept = || own.iter().copied().filter(|triangle| !gone.contains(triangle));
        // Each operation reduces the number of flat triangles, so the loop ends.
        let flat_before = self.flat_count(own.iter().map(|&triangle| self.triangles[triangle as usize]));
        let faces_alike =
            |triangle: u32| self.faces_alike(self.triangles[triangle as usize], moved(triangle));
        if self.flat_count(kept().map(moved)) >= flat_before || !(self.may_fold || kept().all(faces_alike)) {
            return false;
        }
        for &triangle in &own {
            let corners = self.triangles[triangle as usize];
            if gone.contains(&triangle) {
                for corner in corners {
                    self.remove_from(corner, triangle);
                }
                self.triangles[triangle as usize] = REMOVED;
            } else {
                self.triangles[triangle as usize] = moved_corners(corners, vertex, target);
                self.around.entry(target).or_default().push(triangle);
            }
        }
        self.around.remove(&vertex);
        true
    }

    /// Flips the edge from `a` to `b` of a triangle.
    fn flip_edge(&mut self, triangle: u32, [a, b]: [u32; 2]) -> bool {
        let shared = self.shared(a, b);
        let Some(&beyond) = shared.iter().find(|&&other| other != triangle) else { return false };
        let apex = |triangle: u32| {
            self.triangles[triangle as usize].into_iter().find(|&corner| corner != a && corner != b)
        };
        let (Some(c), Some(d)) = (apex(triangle), apex(beyond)) else { return false };
        let is_manifold = shared.len() == 2
            && c != d
            && self.shared(c, d).is_empty()
            && self.triangles_of(a).len() > 3
            && self.triangles_of(b).len() > 3;
        let (one, other) = ([c, a, d], [d, b, c]);
        let old = self.triangles[beyond as usize];
        let flat_before = self.flat_count([self.triangles[triangle as usize], old].into_iter());
        let is_better = self.flat_count([one, other].into_iter()) < flat_before;
        let is_alike = || [one, other].iter().all(|&new| self.faces_alike(old, new));
        if !is_manifold || !is_better || !(self.may_fold || is_alike()) {
            return false;
        }
        self.triangles[triangle as usize] = one;
        self.triangles[beyond as usize] = other;
        self.remove_from(a, beyond);
        self.remove_from(b, triangle);
        self.around.entry(c).or_default().push(beyond);
        self.around.entry(d).or_default().push(triangle);
        true
    }

    fn remove_from(&mut self, vertex: u32, triangle: u32) {
        if let Some(list) = self.around.get_mut(&vertex) {
            list.retain(|&other| other != triangle);
        }
    }
}

fn moved_corners(corners: [u32; 3], from: u32, to: u32) -> [u32; 3] {
    corners.map(|corner| if corner == from { to } else { corner })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A cube with `count` × `count` squares per face, each split into two triangles.
    fn cube(count: u32) -> Mesh {
        let mut vertex_at: FxHashMap<[u32; 3], u32> = FxHashMap::default();
        let mut mesh = Mesh::default();
        let mut vertex = |position: [u32; 3]| {
            *vertex_at.entry(position).or_insert_with(|| {
                mesh.positions.push(Vec3::from(position.map(|along| along as f32)));
                mesh.positions.len() as u32 - 1
            })
        };
        let mut triangles = Vec::new();
        for axis in 0..3 {
            for (end, is_reversed) in [(0, true), (count, false)] {
                for i in 0..count {
                    for j in 0..count {
                        let corner = |u: u32, v: u32| {
                            let mut position = [0; 3];
                            (position[axis], position[(axis + 1) % 3], position[(axis + 2) % 3]) =
                                (end, i + u, j + v);
                            position
                        };
                        let [a, b, c, d] =
                            [corner(0, 0), corner(1, 0), corner(1, 1), corner(0, 1)].map(&mut vertex);
                        let quad = if is_reversed { [[a, c, b], [a, d, c]] } else { [[a, b, c], [a, c, d]] };
                        triangles.extend(quad);
                    }
                }
            }
        }
        mesh.triangles = triangles;
        mesh.normals = vec![Vec3::X; mesh.positions.len()];
        assert!(mesh.measure().is_closed_manifold());
        mesh
    }

    #[test]
    fn needles_and_caps_are_removed_and_the_mesh_stays_closed() {
        let whole = cube(6);
        let neighbors: Vec<[u32; 2]> = whole.triangles.iter().map(|&[a, b, _]| [a, b]).collect();
        for &[a, b] in neighbors.iter().step_by(7) {
            // One vertex moved onto its neighbor, and one onto the line between two others.
            let mut merged = whole.clone();
            merged.positions[a as usize] = merged.positions[b as usize];
            let mut capped = whole.clone();
            let [p, q, r] = whole.triangles[(7 * a as usize + b as usize) % whole.triangles.len()];
            capped.positions[p as usize] =
                (capped.positions[q as usize] + capped.positions[r as usize]) / 2.0;
            for mut mesh in [merged, capped] {
                assert!(mesh.measure().degenerate_triangle_count > 0);
                let fewer = mesh.remove_flat_triangles();
                let measures = mesh.measure();
                assert!(measures.is_closed_manifold(), "{a} {b}: {measures:?}");
                assert_eq!((measures.euler_characteristic, measures.component_count), (2, 1));
                assert_eq!(mesh.triangles.len() + fewer, whole.triangles.len());
                assert_eq!(mesh.positions.len(), mesh.normals.len());
                assert!(fewer <= 8, "{fewer}");
            }
        }
    }

    /// Rounds all coordinates to multiples of a step.
    fn coarse(mut mesh: Mesh, step: f32) -> Mesh {
        for position in &mut mesh.positions {
            *position = (*position / step).round() * step;
        }
        mesh
    }

    #[test]
    fn triangles_flattened_by_rounding_are_removed() {
        let mut mesh = coarse(cube(8), 1.5);
        assert!(mesh.remove_flat_triangles() > 0);
        let measures = mesh.measure();
        assert!(measures.is_closed_manifold() && measures.euler_characteristic == 2, "{measures:?}");
    }

    #[test]
    fn mesh_that_rounding_mostly_flattens_is_unchanged() {
        let mut mesh = coarse(cube(40), 20.0);
        let before = mesh.clone();
        assert_eq!(mesh.remove_flat_triangles(), 0);
        assert_eq!(mesh, before);
    }

    #[test]
    fn isolated_tetrahedron_without_volume_is_removed() {
        let mut mesh = cube(3);
        let whole = mesh.clone();
        let first = mesh.positions.len() as u32;
        mesh.positions.extend([Vec3::splat(1.5); 4]);
        mesh.normals.extend([Vec3::X; 4]);
        let speck = [[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]];
        mesh.triangles.extend(speck.map(|triangle| triangle.map(|corner| first + corner)));
        mesh.remove_flat_triangles();
        assert_eq!(mesh, whole);
    }

    #[test]
    fn mesh_without_flat_triangles_is_unchanged() {
        let mut mesh = cube(4);
        let before = mesh.clone();
        assert_eq!(mesh.remove_flat_triangles(), 0);
        assert_eq!(mesh, before);
    }
}
