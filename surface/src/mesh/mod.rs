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

mod components;
mod corners;
mod decimate;
mod flat;
mod quads;
mod rounding;
mod smooth_normals;
mod triangles;
mod unused;
mod vertices;

use glam::{DVec3, Vec3};
use rayon::prelude::*;

use crate::parallel::Loops as _;
use crate::simd::{Kernel, Lanes, dispatch};
use corners::{Corners, TouchingTriangles};
pub use decimate::{DecimateReport, decimate};
pub use rounding::PositionRounding;
pub(crate) use triangles::{LANES, TriangleBatch};

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
    #[serde(rename = "mesh_bending_energy")]
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
        components::component_volumes(self)
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
        let joined_count = vertices.joined_count + components::join_chunks(self, &mut parents);
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
        triangles::sum_triangles(self.mesh, self.triangles)
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
        let joined_count = components::join_chunk(parents, first as u32, triangles);
        Sums { joined_count, ..vertices::sum_vertices(mesh, corners, first, count) }
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
}
