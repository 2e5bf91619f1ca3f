//! A plain triangle mesh, and what can be measured on it.
//!
//! ```text
//!              prev          corner: a triangle as its vertex v sees it, (v, next, prev)
//!             ╱   ╲
//!            ╱     ╲         the corners of v, turned by v → next → prev, tell all: an edge v–w is
//!           v ───▶ next      sound if w is `next` once and `prev` once; v is sound if going from
//!                            corner to corner over such edges passes through all of them
//! ```
//!
//! Bending energy is ∫H² with the mean curvature vector by cotangents, over mixed Voronoi areas:
//!
//! ```text
//!   2 H n·A = ½ Σ (cot α + cot β)(v − w)      so   ∫H² ≈ Σ |½ Σ (cot α + cot β)(v − w)|² / 4A
//! ```
//!
//! The area and the energy are from:
//! Mark Meyer, Mathieu Desbrun, Peter Schröder, Alan Barr. Discrete Differential-Geometry Operators
//! for Triangulated 2-Manifolds. 2003

mod components;
mod corners;
mod decimate;
mod flat;
mod quads;
mod smooth_normals;
mod triangles;
mod unused;
mod vertices;

use glam::{DVec3, Vec3};
use rayon::prelude::*;

use crate::surface::simd::{Kernel, Lanes, dispatch};
use corners::{Corners, Touching};
pub use decimate::{DecimateReport, decimate};
pub use flat::Rounding;
pub(crate) use triangles::{LANES, TriangleBatch};

/// A triangle mesh in world units.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Mesh {
    /// Vertex positions relative to `origin`.
    pub positions: Vec<Vec3>,
    /// Unit vertex normals, pointing outward; one a vertex.
    pub normals: Vec<Vec3>,
    /// Three vertex indices a triangle, counter-clockwise seen from outside.
    pub triangles: Vec<[u32; 3]>,
    /// World position that `positions` are relative to: zero unless the frame is so far from the
    /// world's origin that 32-bit positions would lose what matters. Always whole voxels, but for a level set that was
    /// given on a lattice of its own.
    pub origin: DVec3,
}

/// Measures of a triangle mesh: area, volume, bending energy, and whether it is closed and manifold.
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
#[derive(Clone, Copy, Debug, Default, PartialEq)]
#[non_exhaustive]
pub struct MeshMeasures {
    /// ∫H² from the mesh's angles. Without unit: 4π for a sphere.
    #[cfg_attr(feature = "serde", serde(rename = "mesh_bending_energy"))]
    pub bending_energy: f64,
    /// Area, world units squared.
    pub area: f64,
    /// Enclosed volume, world units cubed; negative if the mesh is inside out.
    pub volume: f64,
    /// Vertices, whether a triangle uses them or not.
    #[cfg_attr(feature = "serde", serde(rename = "vertices"))]
    pub vertex_count: usize,
    /// Triangles.
    #[cfg_attr(feature = "serde", serde(rename = "triangles"))]
    pub triangle_count: usize,
    /// Edges in one triangle only.
    #[cfg_attr(feature = "serde", serde(rename = "boundary_edges"))]
    pub boundary_edge_count: usize,
    /// Edges in more than two triangles, or in two that run along it in the same direction.
    #[cfg_attr(feature = "serde", serde(rename = "non_manifold_edges"))]
    pub non_manifold_edge_count: usize,
    /// Vertices whose triangles form more than one fan.
    #[cfg_attr(feature = "serde", serde(rename = "non_manifold_vertices"))]
    pub non_manifold_vertex_count: usize,
    /// Triangles that repeat a vertex, or whose height is below a billionth of their longest edge.
    #[cfg_attr(feature = "serde", serde(rename = "degenerate_triangles"))]
    pub degenerate_triangle_count: usize,
    /// Pieces that are connected through vertices.
    #[cfg_attr(feature = "serde", serde(rename = "components"))]
    pub component_count: usize,
    /// Vertices that are used − edges + triangles.
    pub euler_characteristic: i64,
}

impl MeshMeasures {
    /// Whether each edge is in two triangles with opposite directions, the triangles around each
    /// vertex form one ring, and each has an area.
    pub fn is_closed_manifold(&self) -> bool {
        self.boundary_edge_count == 0
            && self.non_manifold_edge_count == 0
            && self.non_manifold_vertex_count == 0
            && self.degenerate_triangle_count == 0
    }
}

impl Mesh {
    /// The volume that each of its components encloses, in world units, in the order of their first vertices: below zero
    /// for the inside of a cavity.
    ///
    /// Panics if a triangle names a vertex that does not exist.
    pub fn component_volumes(&self) -> Vec<f64> {
        components::component_volumes(self)
    }

    /// Measures the mesh. The same mesh gives the same bits on any number of threads.
    ///
    /// Panics if a triangle names a vertex that does not exist.
    pub fn measure(&self) -> MeshMeasures {
        let triangles = self.triangles.par_chunks(PIECE);
        let triangles =
            Sums::in_order(triangles.map(|triangles| dispatch(TrianglePiece { mesh: self, triangles })));
        let touching = Touching::new(self);
        let mut parents: Vec<u32> = vec![0; self.positions.len()];
        let pieces = parents.par_chunks_mut(PIECE).enumerate();
        let vertices = Sums::in_order(pieces.map_init(Corners::default, |corners, (piece, parents)| {
            dispatch(VertexPiece { mesh: self, touching: &touching, piece, parents, corners })
        }));
        drop(touching);
        let joined_count = vertices.joined_count + components::join_pieces(self, &mut parents);
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

/// Vertices or triangles in a piece of work. Sums are taken piece by piece, so that they do not
/// depend on the number of threads.
const PIECE: usize = 4096;

/// What is summed over vertices and triangles.
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
    /// How many times two components became one.
    joined_count: usize,
}

impl Sums {
    /// The sum of those of all pieces.
    fn in_order(pieces: impl IndexedParallelIterator<Item = Sums>) -> Sums {
        let pieces: Vec<Sums> = pieces.collect();
        pieces.into_iter().fold(Sums::default(), |sums, one| Sums {
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

/// Measures some triangles.
struct TrianglePiece<'a> {
    mesh: &'a Mesh,
    triangles: &'a [[u32; 3]],
}

impl Kernel for TrianglePiece<'_> {
    type Output = Sums;

    #[inline(always)]
    fn run<V: Lanes>(self) -> Sums {
        triangles::sum_triangles(self.mesh, self.triangles)
    }
}

/// Measures a piece of the vertices.
struct VertexPiece<'a> {
    mesh: &'a Mesh,
    touching: &'a Touching,
    piece: usize,
    /// Becomes for each vertex the first one that is connected with it within the piece.
    parents: &'a mut [u32],
    /// Used again for each piece.
    corners: &'a mut Corners,
}

impl Kernel for VertexPiece<'_> {
    type Output = Sums;

    #[inline(always)]
    fn run<V: Lanes>(self) -> Sums {
        let VertexPiece { mesh, touching, piece, parents, corners } = self;
        let (first, count) = (piece * PIECE, parents.len());
        let triangles = touching.triangles(mesh, piece);
        corners.collect(first as u32, count, triangles.clone());
        let joined_count = components::join_piece(parents, first as u32, triangles);
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
    fn a_tetrahedron_is_closed() {
        let measures = mesh(&CORNERS, &TETRAHEDRON).measure();
        assert!(measures.is_closed_manifold());
        assert!((measures.volume - 1.0 / 6.0).abs() < 1e-12);
        assert!((measures.area - (1.5 + 0.75f64.sqrt())).abs() < 1e-12);
        assert_eq!((measures.component_count, measures.euler_characteristic), (1, 2));
    }

    #[test]
    fn a_missing_triangle_leaves_a_boundary() {
        let measures = mesh(&CORNERS, &TETRAHEDRON[1..]).measure();
        assert_eq!((measures.boundary_edge_count, measures.non_manifold_edge_count), (3, 0));
        assert_eq!((measures.non_manifold_vertex_count, measures.euler_characteristic), (0, 1));
    }

    #[test]
    fn a_turned_triangle_is_not_manifold() {
        let mut triangles = TETRAHEDRON;
        triangles[0].swap(1, 2);
        let measures = mesh(&CORNERS, &triangles).measure();
        assert_eq!((measures.boundary_edge_count, measures.non_manifold_edge_count), (0, 3));
    }

    #[test]
    fn tetrahedra_may_not_share_an_edge_or_a_vertex() {
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
    fn flat_and_repeating_triangles_are_degenerate() {
        let positions = [[0.0; 3], [1.0, 0.0, 0.0], [3.0, 0.0, 0.0]];
        assert_eq!(mesh(&positions, &[[0, 1, 2], [0, 1, 1]]).measure().degenerate_triangle_count, 2);
    }
}
