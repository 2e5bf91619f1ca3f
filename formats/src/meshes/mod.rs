//! Formats of meshes: glTF, OBJ and STL. glTF and OBJ may also hold particles.

pub mod gltf;
pub mod obj;
pub(crate) mod obj_points;
pub mod stl;
