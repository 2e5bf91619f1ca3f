//! The mesh of a frame as a file of this crate stores it, for conversion to another format.

use crate::core::data::FileAttribute;
use crate::core::options::UpAxis;

/// A mesh of one frame as another format stores it.
pub(crate) struct PlacedMesh {
    /// Relative to the origin, three numbers each.
    pub(crate) positions: Vec<f32>,
    /// Three numbers for each position.
    pub(crate) normals: Vec<f32>,
    pub(crate) triangles: Vec<[u32; 3]>,
    pub(crate) origin: [f64; 3],
    pub(crate) attributes: Vec<FileAttribute>,
}

/// A mesh, and what else its file says.
pub(crate) struct StoredMesh {
    pub(crate) mesh: PlacedMesh,
    pub(crate) up: UpAxis,
    pub(crate) provenance: Vec<(String, String)>,
}
