//! A plain triangle mesh.

use glam::{DVec3, Vec3};

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
    /// world's origin that 32-bit positions would lose what matters. Always whole voxels.
    pub origin: DVec3,
}

/// What is measured on a mesh.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct MeshMeasures {
    /// Vertices.
    pub vertex_count: usize,
    /// Triangles.
    pub triangle_count: usize,
    /// Area, world units squared.
    pub area: f64,
    /// Enclosed volume, world units cubed.
    pub volume: f64,
    /// ∫H² by the cotangent mean curvature at the vertices; 4π for a sphere of any size.
    pub bending_energy: f64,
    /// Edges with one triangle.
    pub boundary_edge_count: usize,
    /// Edges with more than two triangles.
    pub non_manifold_edge_count: usize,
    /// Triangles without area.
    pub degenerate_triangle_count: usize,
    /// Connected pieces.
    pub component_count: usize,
    /// Vertices − edges + triangles.
    pub euler_characteristic: i64,
}
