//! glTF 2.0: meshes out, as `.glb` or as `.gltf` with its buffer inside; meshes in.
//!
//! ```text
//!   .glb    header │ JSON chunk, padded with spaces │ BIN chunk: positions, normals, attributes, indices
//!   .gltf   JSON with the same buffer as a base64 data URI
//! ```
//!
//! A `.gltf` beside a `.bin` would be two files, and two files cannot appear at once; hence the
//! data URI, a third larger. The document that is written is a handful of structs given to serde_json: what is
//! written can be read off them, and node translations keep their 64 bits, in which far-off scenes stay exact.
//!
//! This work is based on:
//! The Khronos 3D Formats Working Group. glTF 2.0 Specification. 2021

mod beside;
mod buffer;
mod frame_file;
mod quantized;
mod read;
mod read_attributes;
mod read_camera;
mod read_provenance;
mod sequence;
mod vertex_data;
mod write;

pub use beside::{Beside, FileBeside, files_beside};
pub use frame_file::FrameFile;
pub use quantized::{quantization_error, quantized_positions};
pub use read::{read_mesh, read_mesh_with};
pub use read_attributes::read_attributes;
pub use read_camera::{CameraData, read_camera};
pub use sequence::{SHOT_FRAMES, ShotFrame, ShotInfo, read_shot_info, write_sequence};
pub use vertex_data::attribute_notes;
pub use write::{UpAxis, WriteOptions, write_glb, write_gltf};

pub(crate) use frame_file::{Column, FramePlace};
pub(crate) use read_provenance::{glb_bytes_claimed, json_of_glb_head, read_provenance};

/// The format's name in errors.
const FORMAT: &str = "glTF";

const GLB_MAGIC: [u8; 4] = *b"glTF";
const GLB_VERSION: u32 = 2;
const CHUNK_JSON: [u8; 4] = *b"JSON";
const CHUNK_BIN: [u8; 4] = *b"BIN\0";

/// The codes of component types that are written.
mod component {
    pub(super) const I8: u32 = 5120;
    pub(super) const U16: u32 = 5123;
    pub(super) const U32: u32 = 5125;
    pub(super) const F32: u32 = 5126;
}
