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
