//! A triangle mesh and its measures.
//!
//! ```text
//!              prev          corner: a triangle as seen from its vertex v: (v, next, prev)
//!             ╱   ╲
//!            ╱     ╲         an edge v–w is manifold if w is `next` of exactly one corner of v and `prev` of
//!           v ───▶ next      exactly one; v is manifold if walking from corner to corner across such edges
//!                            visits all its corners
//! ```
//!
//! The bending energy is ∫H², with the mean curvature vector from cotangents and mixed Voronoi areas:
//!
//! ```text
//!   2 H n·A = ½ Σ (cot α + cot β)(v − w)      so   ∫H² ≈ Σ |½ Σ (cot α + cot β)(v − w)|² / 4A
//! ```
//!
//! The mixed Voronoi areas and the energy are from: Mark Meyer, Mathieu Desbrun, Peter Schröder, Alan Barr.
//! Discrete Differential-Geometry Operators for Triangulated 2-Manifolds. 2003

mod corners;
mod curvature;
mod decimate;
mod flat;

use glam::{DVec3, Vec3};
use rayon::prelude::*;

pub use decimate::{DecimateReport, decimate};

use crate::cancel::checkpoint;
use crate::parallel::Loops as _;
use crate::simd::{Kernel, Lanes, dispatch};
use corners::{Corners, TouchingTriangles, sum_vertices};

/// A triangle mesh in world units.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Mesh {
    /// Vertex positions relative to `origin`.
    pub positions: Vec<Vec3>,
    /// Unit vertex normals, pointing outward; one per vertex.
    pub normals: Vec<Vec3>,
    /// Three vertex indices per triangle, counter-clockwise seen from outside.
    pub triangles: Vec<[u32; 3]>,
    /// World position that `positions` are relative to. Zero unless the frame is so far from the world origin
    /// that 32-bit positions would be too imprecise. Always a whole number of voxels from the world origin,
    /// except if the input is a level set whose grid is not aligned with the world origin.
    pub origin: DVec3,
}

/// Measures of a triangle mesh: area, volume, bending energy, and whether it is closed and manifold.
#[derive(Clone, Copy, Debug, Default, PartialEq, serde::Serialize)]
#[non_exhaustive]
pub struct MeshMeasures {
    /// ∫H² computed from the mesh's angles. Dimensionless: 4π for a sphere.
    pub bending_energy: f64,
    /// Area, in squared world units.
    pub area: f64,
    /// Enclosed volume, in cubed world units; negative if the mesh is inside out.
    pub volume: f64,
    /// Number of vertices, including unused ones.
    #[serde(rename = "vertices")]
    pub vertex_count: usize,
    /// Number of triangles.
    #[serde(rename = "triangles")]
    pub triangle_count: usize,
    /// Number of edges in only one triangle.
    #[serde(rename = "boundary_edges")]
    pub boundary_edge_count: usize,
    /// Number of edges in more than two triangles, or in two with the same direction.
    #[serde(rename = "non_manifold_edges")]
    pub non_manifold_edge_count: usize,
    /// Number of vertices whose triangles form more than one fan.
    #[serde(rename = "non_manifold_vertices")]
    pub non_manifold_vertex_count: usize,
    /// Number of triangles that repeat a vertex, or whose height is below a billionth of their longest edge.
    #[serde(rename = "degenerate_triangles")]
    pub degenerate_triangle_count: usize,
    /// Number of connected components; triangles that share a vertex are connected.
    #[serde(rename = "components")]
    pub component_count: usize,
    /// Used vertices − edges + triangles.
    pub euler_characteristic: i64,
}

impl MeshMeasures {
    /// True if each edge is in two triangles with opposite directions, the triangles around each vertex form
    /// one ring, and each triangle has an area.
    pub fn is_closed_manifold(&self) -> bool {
        self.boundary_edge_count == 0
            && self.non_manifold_edge_count == 0
            && self.non_manifold_vertex_count == 0
            && self.degenerate_triangle_count == 0
    }
}

impl Mesh {
    /// The volume that each component encloses, in cubed world units, ordered by their first vertices;
    /// negative for the surface of a cavity.
    ///
    /// Panics if a triangle refers to a vertex that does not exist.
    pub fn component_volumes(&self) -> Vec<f64> {
        component_volumes(self)
    }

    /// Measures the mesh. The result is bit-identical on any number of threads.
    ///
    /// Panics if a triangle refers to a vertex that does not exist.
    pub fn measure(&self) -> MeshMeasures {
        let triangles = self.triangles.par_chunks(CHUNK);
        let triangles =
            Sums::in_order(triangles.map(|triangles| dispatch(TriangleChunk { mesh: self, triangles })));
        let touching = TouchingTriangles::new(self);
        let mut parents: Vec<u32> = vec![0; self.positions.len()];
        let chunks = parents.par_chunks_mut(CHUNK).enumerate();
        let vertices =
            Sums::in_order(chunks.halved().map_init(Corners::default, |corners, (chunk, parents)| {
                dispatch(VertexChunk { mesh: self, touching: &touching, chunk, parents, corners })
            }));
        drop(touching);
        let joined_count = vertices.joined_count + join_chunks(self, &mut parents);
        let edge_count = vertices.edge_count as i64;
        MeshMeasures {
            area: triangles.area,
            volume: triangles.volume,
            bending_energy: vertices.bending_energy,
            vertex_count: self.positions.len(),
            triangle_count: self.triangles.len(),
            boundary_edge_count: vertices.boundary_edge_count,
            non_manifold_edge_count: vertices.non_manifold_edge_count,
            non_manifold_vertex_count: vertices.non_manifold_vertex_count,
            degenerate_triangle_count: triangles.degenerate_triangle_count,
            component_count: vertices.used_vertex_count - joined_count,
            euler_characteristic: vertices.used_vertex_count as i64 - edge_count
                + self.triangles.len() as i64,
        }
    }
}

/// Number of vertices or triangles per chunk. Sums are taken chunk by chunk, so that they do not depend on
/// the number of threads.
const CHUNK: usize = 4096;

/// Sums over vertices and triangles.
#[derive(Clone, Copy, Default)]
struct Sums {
    area: f64,
    volume: f64,
    bending_energy: f64,
    edge_count: usize,
    boundary_edge_count: usize,
    non_manifold_edge_count: usize,
    non_manifold_vertex_count: usize,
    degenerate_triangle_count: usize,
    used_vertex_count: usize,
    /// Number of joins of two components.
    joined_count: usize,
}

impl Sums {
    /// The sum over all chunks, in order.
    fn in_order(chunks: impl IndexedParallelIterator<Item = Sums>) -> Sums {
        let chunks: Vec<Sums> = chunks.collect();
        chunks.into_iter().fold(Sums::default(), |sums, one| Sums {
            area: sums.area + one.area,
            volume: sums.volume + one.volume,
            bending_energy: sums.bending_energy + one.bending_energy,
            edge_count: sums.edge_count + one.edge_count,
            boundary_edge_count: sums.boundary_edge_count + one.boundary_edge_count,
            non_manifold_edge_count: sums.non_manifold_edge_count + one.non_manifold_edge_count,
            non_manifold_vertex_count: sums.non_manifold_vertex_count + one.non_manifold_vertex_count,
            degenerate_triangle_count: sums.degenerate_triangle_count + one.degenerate_triangle_count,
            used_vertex_count: sums.used_vertex_count + one.used_vertex_count,
            joined_count: sums.joined_count + one.joined_count,
        })
    }
}

/// Kernel: measures some triangles.
struct TriangleChunk<'a> {
    mesh: &'a Mesh,
    triangles: &'a [[u32; 3]],
}

impl Kernel for TriangleChunk<'_> {
    type Output = Sums;

    #[inline(always)]
    fn run<V: Lanes>(self) -> Sums {
        corners::sum_triangles(self.mesh, self.triangles)
    }
}

/// Kernel: measures a chunk of the vertices.
struct VertexChunk<'a> {
    mesh: &'a Mesh,
    touching: &'a TouchingTriangles,
    chunk: usize,
    /// Receives, for each vertex, the first vertex that is connected to it within the chunk.
    parents: &'a mut [u32],
    /// Reused for each chunk.
    corners: &'a mut Corners,
}

impl Kernel for VertexChunk<'_> {
    type Output = Sums;

    #[inline(always)]
    fn run<V: Lanes>(self) -> Sums {
        let VertexChunk { mesh, touching, chunk, parents, corners } = self;
        let (first, count) = (chunk * CHUNK, parents.len());
        let triangles = touching.triangles(mesh, chunk);
        corners.collect(first as u32, count, triangles.clone());
        let joined_count = join_chunk(parents, first as u32, triangles);
        Sums { joined_count, ..sum_vertices(mesh, corners, first, count) }
    }
}

// Rounds positions to what files can store.

/// How the positions of a mesh are rounded. All files of a frame have the same positions.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum PositionRounding {
    /// To 32 bits relative to the mesh's origin.
    #[default]
    Local,
    /// Also to 32 bits in world coordinates, for files that have no origin.
    World,
}

impl Mesh {
    /// Rounds the positions. Returns the largest distance by which a vertex moved, in world units.
    pub fn round(&mut self, rounding: PositionRounding) -> f64 {
        if rounding == PositionRounding::Local {
            return 0.0;
        }
        let origin = self.origin;
        let round = |position: &mut Vec3| {
            let exact = std::mem::replace(position, rounded_to_world(origin, *position));
            f64::from(position.distance(exact))
        };
        self.positions.par_iter_mut().halved().map(round).reduce(|| 0.0, f64::max)
    }

    /// Whether rounding changes nothing.
    pub fn is_rounded(&self, rounding: PositionRounding) -> bool {
        let is_stored = |position: &Vec3| rounded_to_world(self.origin, *position) == *position;
        rounding == PositionRounding::Local || self.positions.par_iter().halved().all(is_stored)
    }

    /// Half the distance between adjacent 32-bit numbers at the farthest position, in world units.
    pub fn rounding_error(&self, rounding: PositionRounding) -> f64 {
        let stored = |position: &Vec3| match rounding {
            PositionRounding::Local => *position,
            PositionRounding::World => world(self.origin, *position),
        };
        let coordinate = |position: &Vec3| stored(position).abs().max_element();
        let farthest = self.positions.par_iter().halved().map(coordinate).reduce(|| 0.0, f32::max);
        f64::from(farthest.next_up() - farthest) / 2.0
    }
}

fn rounded_to_world(origin: DVec3, position: Vec3) -> Vec3 {
    (world(origin, position).as_dvec3() - origin).as_vec3()
}

/// The position in world coordinates, rounded to 32 bits.
fn world(origin: DVec3, position: Vec3) -> Vec3 {
    (origin + position.as_dvec3()).as_vec3()
}

// Detects pairs of triangles that are halves of a quad.
//
//    d ─── c        Dual contouring makes a quad around each crossed grid edge and splits the quad along a
//    │ ╲   │        diagonal. It writes the halves consecutively: (a b d) (b c d). The second half starts at
//    │   ╲ │        either end of the diagonal.
//    a ─── b
//
// So triangles 2i and 2i + 1 would be the halves of one quad, but a few quads are not split into halves:
// where sheets almost touch, quads with additional vertices on their sides become fans of five to eight
// triangles around a vertex in the middle. Two consecutive triangles never look like halves if one of them
// is in a fan, or if they belong to different quads, because no two quads share a diagonal.

/// Number of triangles per task.
const TASK_TRIANGLES: usize = 1 << 14;

impl Mesh {
    /// For each triangle, true if it and the next one are the halves of a quad. Intended for meshes from dual
    /// contouring; in other meshes, two unrelated triangles may look like halves.
    pub fn quads(&self) -> Vec<bool> {
        let count = self.triangles.len();
        let mut quads = vec![false; count];
        quads.par_chunks_mut(TASK_TRIANGLES).enumerate().halved().for_each(|(chunk, quads)| {
            for (quad, index) in quads.iter_mut().zip(chunk * TASK_TRIANGLES..) {
                let next = self.triangles.get(index + 1);
                *quad = next.is_some_and(|&next| are_halves(self.triangles[index], next));
            }
        });
        // A triangle is half of only one quad.
        let mut is_second = false;
        for quad in &mut quads {
            *quad &= !is_second;
            is_second = *quad;
        }
        quads
    }
}

/// True if two consecutive triangles are halves of a quad.
pub(crate) fn are_halves(one: [u32; 3], other: [u32; 3]) -> bool {
    let [a, b, c] = one;
    let from_diagonal = other[0] == c && other[2] == a;
    let is_reversed = other[0] == b && other[1] == a;
    from_diagonal || is_reversed
}

// Connected components of a mesh.
//
// - First, union-find joins the vertices within each chunk, in parallel. `parents` then has the root of each
//   vertex's part.
// - Then the parts of different chunks are joined sequentially. Every vertex has its root, so only a few
//   different pairs of roots are left to join.

/// Joins the vertices of one chunk along the edges within the chunk. Overwrites `parents`: each entry becomes
/// the root of its vertex. Returns the number of joins.
fn join_chunk(parents: &mut [u32], first: u32, triangles: impl Iterator<Item = [u32; 3]>) -> usize {
    let count = parents.len() as u32;
    for (parent, vertex) in parents.iter_mut().zip(0..) {
        *parent = vertex;
    }
    let mut joined_count = 0;
    triangles.for_each(|[a, b, c]| {
        let [a, b, c] = [a.wrapping_sub(first), b.wrapping_sub(first), c.wrapping_sub(first)];
        for [one, other] in [[a, b], [b, c]] {
            // Usually both entries are already roots.
            let are_own = one < count && other < count;
            if are_own && parents[one as usize] != parents[other as usize] {
                joined_count += usize::from(join(parents, one, other));
            }
        }
    });
    for vertex in 0..parents.len() {
        // Roots come before the vertices of their tree.
        let root = parents[parents[vertex] as usize];
        parents[vertex] = root;
    }
    parents.iter_mut().for_each(|parent| *parent += first);
    joined_count
}

/// Joins chunks along the edges between them, after each chunk has been joined internally. Returns the number
/// of joins.
fn join_chunks(mesh: &Mesh, parents: &mut [u32]) -> usize {
    let roots: &[u32] = parents;
    let pairs_of = |triangles: &[[u32; 3]]| {
        let mut pairs = Vec::new();
        for &[a, b, c] in triangles {
            for [one, other] in [[a, b], [b, c]] {
                if one / CHUNK as u32 != other / CHUNK as u32 {
                    let (one, other) = (roots[one as usize], roots[other as usize]);
                    let pair = [one.min(other), one.max(other)];
                    if pairs.last() != Some(&pair) {
                        pairs.push(pair);
                    }
                }
            }
        }
        pairs.sort_unstable();
        pairs.dedup();
        pairs
    };
    let pairs: Vec<Vec<[u32; 2]>> = mesh.triangles.par_chunks(CHUNK).halved().map(pairs_of).collect();
    pairs.into_iter().flatten().filter(|&[one, other]| join(parents, one, other)).count()
}

/// The volume of each component, in the order of first vertices; negative for the inside of a cavity.
/// Single-threaded: for meshes that are known to have several components.
fn component_volumes(mesh: &Mesh) -> Vec<f64> {
    let mut parents: Vec<u32> = (0..mesh.positions.len() as u32).collect();
    for &[a, b, c] in &mesh.triangles {
        join(&mut parents, a, b);
        join(&mut parents, b, c);
    }
    let mut volumes = vec![None; parents.len()];
    for &[a, b, c] in &mesh.triangles {
        let root = find(&mut parents, a);
        // Relative to a vertex of the component, so that a small, distant component loses no precision.
        let corner =
            |vertex: u32| (mesh.positions[vertex as usize] - mesh.positions[root as usize]).as_dvec3();
        let volume = corner(a).dot(corner(b).cross(corner(c))) / 6.0;
        *volumes[root as usize].get_or_insert(0.0) += volume;
    }
    volumes.into_iter().flatten().collect()
}

/// Joins the trees of two vertices. Returns true if they were separate. The smaller root stays the root.
fn join(parents: &mut [u32], one: u32, other: u32) -> bool {
    let (one, other) = (find(parents, one), find(parents, other));
    if one != other {
        parents[one.max(other) as usize] = one.min(other);
    }
    one != other
}

/// The root of a vertex. Compresses the path.
fn find(parents: &mut [u32], vertex: u32) -> u32 {
    let mut root = vertex;
    while parents[root as usize] != root {
        let parent = parents[root as usize];
        parents[root as usize] = parents[parent as usize];
        root = parent;
    }
    root
}

// Smooths vertex normals.
//
//        c ─── b
//       ╱ ╲   ╱ ╲        the normals over the triangles of v, interpolated linearly on each, averaged with a weight
//      d ── v ── a       that falls from 1 at v to 0 at its neighbors:
//       ╲   │   ╱
//        ── e ──         n ← Σ area · (2 n(v) + n(next) + n(prev))
//
// The weights are positive, and half of their sum belongs to v itself, so further rounds smooth more and
// never amplify noise. Positions do not change, only shading. The result does not depend on the number of
// threads, and each round extends the influence of a normal by one edge.

impl Mesh {
    /// Averages each normal with its neighbors, `rounds` times. Normals stay unit vectors; a normal whose
    /// average vanishes is left unchanged.
    ///
    /// Panics if a triangle refers to a vertex that does not exist or has no normal.
    pub fn smooth_normals(&mut self, rounds: u32) {
        if rounds == 0 {
            return;
        }
        let touching = TouchingTriangles::new(self);
        for _ in 0..rounds {
            checkpoint();
            let mut smoothed = self.normals.clone();
            let chunks = smoothed.par_chunks_mut(CHUNK).enumerate();
            chunks.halved().for_each_init(Corners::default, |corners, (chunk, smoothed)| {
                let first = chunk * CHUNK;
                corners.collect(first as u32, smoothed.len(), touching.triangles(self, chunk));
                for (index, normal) in smoothed.iter_mut().enumerate() {
                    *normal = self.average(first + index, corners.of(index)).unwrap_or(*normal);
                }
            });
            self.normals = smoothed;
        }
    }

    /// The average of the normals around a vertex with corners `[next, prev]`; `None` if it vanishes.
    fn average(&self, vertex: usize, corners: &[[u32; 2]]) -> Option<Vec3> {
        // 64 bits, so that areas in any unit are in range.
        let to = |other: u32| self.positions[other as usize].as_dvec3() - self.positions[vertex].as_dvec3();
        let normal = |vertex: u32| self.normals[vertex as usize].as_dvec3();
        let mut sum = DVec3::ZERO;
        for &[next, prev] in corners {
            let area = to(next).cross(to(prev)).length();
            sum += area * (2.0 * normal(vertex as u32) + normal(next) + normal(prev));
        }
        Some(sum.try_normalize()?.as_vec3())
    }
}

// Removes vertices without a triangle.

impl Mesh {
    /// Removes vertices that no triangle uses. The others keep their order.
    fn drop_unused_vertices(&mut self) {
        let mut is_used = vec![false; self.positions.len()];
        self.triangles.iter().flatten().for_each(|&vertex| is_used[vertex as usize] = true);
        let mut next = 0;
        let numbers: Vec<u32> = is_used
            .iter()
            .map(|&is_used| {
                let number = next;
                next += u32::from(is_used);
                number
            })
            .collect();
        self.triangles
            .par_iter_mut()
            .halved()
            .flatten()
            .for_each(|vertex| *vertex = numbers[*vertex as usize]);
        for column in [&mut self.positions, &mut self.normals] {
            let mut uses = is_used.iter();
            column.retain(|_| uses.next().is_some_and(|&is_used| is_used));
            column.shrink_to_fit();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn mesh(positions: &[[f32; 3]], triangles: &[[u32; 3]]) -> Mesh {
        let positions = positions.iter().map(|&position| Vec3::from_array(position)).collect();
        Mesh { positions, triangles: triangles.to_vec(), ..Mesh::default() }
    }

    const CORNERS: [[f32; 3]; 4] = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
    const TETRAHEDRON: [[u32; 3]; 4] = [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]];

    #[test]
    fn tetrahedron_is_a_closed_manifold() {
        let measures = mesh(&CORNERS, &TETRAHEDRON).measure();
        assert!(measures.is_closed_manifold());
        assert!((measures.volume - 1.0 / 6.0).abs() < 1e-12);
        assert!((measures.area - (1.5 + 0.75f64.sqrt())).abs() < 1e-12);
        assert_eq!((measures.component_count, measures.euler_characteristic), (1, 2));
    }

    #[test]
    fn missing_triangle_leaves_boundary_edges() {
        let measures = mesh(&CORNERS, &TETRAHEDRON[1..]).measure();
        assert_eq!((measures.boundary_edge_count, measures.non_manifold_edge_count), (3, 0));
        assert_eq!((measures.non_manifold_vertex_count, measures.euler_characteristic), (0, 1));
    }

    #[test]
    fn flipped_triangle_is_not_manifold() {
        let mut triangles = TETRAHEDRON;
        triangles[0].swap(1, 2);
        let measures = mesh(&CORNERS, &triangles).measure();
        assert_eq!((measures.boundary_edge_count, measures.non_manifold_edge_count), (0, 3));
    }

    #[test]
    fn shared_edge_or_vertex_is_not_manifold() {
        let mut positions = CORNERS.to_vec();
        positions.extend(CORNERS.map(|[x, y, z]| [-x, -y, z + 2.0]));
        let other = |map: [u32; 4]| TETRAHEDRON.map(|triangle| triangle.map(|corner| map[corner as usize]));
        let measure = |map| mesh(&positions, &[TETRAHEDRON, other(map)].concat()).measure();
        let apart = measure([4, 5, 6, 7]);
        assert!(apart.is_closed_manifold() && apart.component_count == 2 && apart.euler_characteristic == 4);
        let at_vertex = measure([0, 5, 6, 7]);
        assert_eq!((at_vertex.non_manifold_edge_count, at_vertex.non_manifold_vertex_count), (0, 1));
        assert_eq!(at_vertex.component_count, 1);
        let at_edge = measure([0, 1, 6, 7]);
        assert_eq!(at_edge.non_manifold_edge_count, 1);
        assert!(at_edge.non_manifold_vertex_count > 0);
    }

    #[test]
    fn flat_triangles_and_repeated_vertices_are_degenerate() {
        let positions = [[0.0; 3], [1.0, 0.0, 0.0], [3.0, 0.0, 0.0]];
        assert_eq!(mesh(&positions, &[[0, 1, 2], [0, 1, 1]]).measure().degenerate_triangle_count, 2);
    }

    #[test]
    fn world_positions_are_those_that_32_bits_can_store() {
        let positions = vec![Vec3::new(0.3, 7.0, -0.4), Vec3::ONE];
        let mut mesh = Mesh { positions, origin: DVec3::new(4e6, 0.0, 0.0), ..Mesh::default() };
        let before = mesh.clone();
        assert_eq!((mesh.round(PositionRounding::Local), &mesh), (0.0, &before));
        assert!(!mesh.is_rounded(PositionRounding::World));
        // At 4e6, adjacent 32-bit numbers differ by a quarter.
        assert_eq!(mesh.rounding_error(PositionRounding::World), 0.125);
        let moved = mesh.round(PositionRounding::World);
        assert!((moved - 0.05).abs() < 1e-6, "{moved}");
        assert_eq!(mesh.positions[0], Vec3::new(0.25, 7.0, -0.4));
        assert!(mesh.is_rounded(PositionRounding::World));
        mesh.origin = DVec3::ZERO;
        assert_eq!(mesh.round(PositionRounding::World), 0.0);
    }

    /// A sphere of subdivided triangles with normals that are off by up to about 20°.
    fn rough_ball() -> Mesh {
        let mut mesh = Mesh::default();
        let (rows, columns) = (60u32, 120u32);
        for row in 0..=rows {
            for column in 0..columns {
                let polar = std::f32::consts::PI * (row as f32 + 0.5) / (rows as f32 + 1.0);
                let around = std::f32::consts::TAU * column as f32 / columns as f32;
                let outward = Vec3::new(polar.sin() * around.cos(), polar.sin() * around.sin(), polar.cos());
                let noise = |seed: u32| ((row * 7919 + column * 104_729 + seed) as f32).sin();
                mesh.positions.push(outward);
                mesh.normals.push((outward + 0.25 * Vec3::new(noise(1), noise(2), noise(3))).normalize());
            }
        }
        for (row, column) in (0..rows).flat_map(|row| (0..columns).map(move |column| (row, column))) {
            let [a, b] = [column, (column + 1) % columns].map(|column| row * columns + column);
            mesh.triangles.extend([[a, a + columns, b], [b, a + columns, b + columns]]);
        }
        mesh
    }

    fn roughness(mesh: &Mesh) -> f32 {
        let off = mesh
            .normals
            .iter()
            .zip(&mesh.positions)
            .map(|(normal, outward)| normal.distance_squared(*outward));
        (off.sum::<f32>() / mesh.normals.len() as f32).sqrt()
    }

    #[test]
    fn smoothing_reduces_noise_and_keeps_unit_length() {
        let rough = rough_ball();
        let mut before = roughness(&rough);
        assert!(before > 0.2);
        for rounds in [1, 3, 10] {
            let mut mesh = rough.clone();
            mesh.smooth_normals(rounds);
            assert!(roughness(&mesh) < 0.75 * before, "{rounds}: {} {before}", roughness(&mesh));
            before = roughness(&mesh);
            assert!(mesh.normals.iter().all(|normal| (normal.length() - 1.0).abs() < 1e-6));
            assert!(mesh.positions == rough.positions && mesh.triangles == rough.triangles);
        }
        let threads = |count: usize| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(count).build().expect("a thread pool");
            let mut mesh = rough.clone();
            pool.install(|| mesh.smooth_normals(4));
            mesh
        };
        assert!(threads(1) == threads(3));
        let mut same = rough.clone();
        same.smooth_normals(0);
        assert!(same == rough);
    }

    #[test]
    fn normals_without_average_are_unchanged() {
        let mesh = |triangles: &[[u32; 3]]| Mesh {
            positions: vec![Vec3::ZERO, Vec3::X, Vec3::Y, Vec3::NAN, Vec3::ONE],
            normals: vec![Vec3::Z, Vec3::NEG_Z, Vec3::NEG_Z, Vec3::X, Vec3::Y],
            triangles: triangles.to_vec(),
            ..Mesh::default()
        };
        // Two pairs that cancel, and vertices without triangles.
        let mut cancelling = mesh(&[[0, 1, 2]]);
        cancelling.smooth_normals(1);
        assert_eq!(cancelling.normals[0], Vec3::Z);
        assert_eq!(cancelling.normals[3..], [Vec3::X, Vec3::Y]);
        let mut degenerate = mesh(&[[0, 1, 2], [0, 3, 1], [2, 2, 0]]);
        degenerate.smooth_normals(3);
        assert!(
            degenerate.normals.iter().all(|normal| (normal.length() - 1.0).abs() < 1e-6),
            "{degenerate:?}"
        );
    }
}
