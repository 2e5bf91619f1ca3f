//! glTF 2.0: writes meshes as `.glb`, or as `.gltf` with an embedded buffer; reads meshes.
//!
//! ```text
//!   .glb    header │ JSON chunk, padded with spaces │ BIN chunk: positions, normals, attributes, indices
//!   .gltf   JSON with the same buffer as a base64 data URI
//! ```
//!
//! A `.gltf` with a separate `.bin` would be two files, and two files cannot be replaced atomically. The
//! buffer is therefore in a data URI, which is a third larger than the bytes. A few structs define the
//! written document, and serde_json serialises them, so that the code shows exactly what is written. Node
//! translations keep 64 bits, so that scenes far from the origin stay exact.
//!
//! This work is based on:
//! The Khronos 3D Formats Working Group. glTF 2.0 Specification. 2021

use crate::data::MeshData;
use crate::error::{Error, Result};
use crate::limits::Limits;
use crate::mesh_options::WriteOption;
use crate::row::Integrity;
use crate::row::{Content, FormatRow, MeshEncoder, MeshWriter, OutputRow};

mod buffer;
mod chunks;
mod external;
mod frame_file;
mod placement;
mod read;
mod read_attributes;
mod read_camera;
mod read_provenance;
mod sequence;
mod shared_attributes;
mod vertex_data;
mod write;

pub use crate::mesh_options::UpAxis;
pub use crate::row::ReadExternal;
pub use external::{ExternalFile, external_files};
pub use frame_file::GlbFrame;
pub use read::{read_mesh, read_mesh_with_external};
pub use read_attributes::{read_attribute_names, read_attributes};
pub use read_camera::{CameraData, read_camera};
pub use sequence::{SEQUENCE_FRAMES, SequenceFrame, SequenceInfo, read_sequence_info, write_sequence};
pub use vertex_data::attribute_notes;
pub(crate) use vertex_data::{ACCELERATION_NAME, COLOR_NAME, loss_notes};
pub use write::{write_glb, write_gltf};

pub(crate) use frame_file::{ACCELERATION, COLOR, NORMAL, POSITION, VELOCITY};
pub(crate) use placement::{PositionTransform, SequencePlacement};
pub(crate) use shared_attributes::{SharedAttribute, shared_attributes};

use read_provenance::{glb_bytes_declared, json_of_glb_head, read_provenance};

/// The format's name in errors.
const FORMAT: &str = "glTF";

const GLB_MAGIC: [u8; 4] = *b"glTF";
const GLB_VERSION: u32 = 2;
const CHUNK_JSON: [u8; 4] = *b"JSON";
const CHUNK_BIN: [u8; 4] = *b"BIN\0";

/// The codes of the component types that the writer uses.
mod component {
    pub(super) const U16: u32 = 5123;
    pub(super) const U32: u32 = 5125;
    pub(super) const F32: u32 = 5126;
}

/// The row of the binary form in the table of formats.
pub(crate) static GLB: OutputRow = OutputRow {
    format: FormatRow {
        signatures: &[b"glTF"],
        read_mesh: Some(read_one_mesh),
        ..FormatRow::new("binary glTF", &["glb"])
    },
    help: "Binary glTF: positions, normals",
    content: Content::Mesh(MeshWriter {
        attribute_notes,
        ..MeshWriter::new(MeshEncoder::Stream(|mesh, options, provenance, mut out| {
            write_glb(mesh, options, provenance, &mut out)
        }))
    }),
    write_particles: None,
    has_attributes: true,
    options: &[WriteOption::Up],
    read_provenance: |head| read_provenance(json_of_glb_head(head)?),
    integrity: Integrity::Length(|head, _| glb_bytes_declared(head)),
};

/// The row of the text form in the table of formats.
pub(crate) static GLTF: OutputRow = OutputRow {
    format: FormatRow { read_mesh: Some(read_mesh_with_external), ..FormatRow::new(FORMAT, &["gltf"]) },
    help: "Text glTF",
    content: Content::Mesh(MeshWriter {
        attribute_notes,
        ..MeshWriter::new(MeshEncoder::Stream(|mesh, options, provenance, mut out| {
            write_gltf(mesh, options, provenance, &mut out)
        }))
    }),
    write_particles: None,
    has_attributes: true,
    options: &[WriteOption::Up],
    read_provenance,
    integrity: Integrity::Json,
};

/// Reads the mesh of a `.glb`. Rejects a sequence: it has a mesh per frame, and nothing says which one to
/// use.
fn read_one_mesh(bytes: &[u8], limits: &Limits, read_external: &ReadExternal) -> Result<MeshData> {
    if let Some(shot) = read_sequence_info(bytes)? {
        let what = format!(
            "this file is a sequence of {} frames, and a single mesh is needed: use the .glb of one frame, or of each frame, as in body.####.glb",
            shot.frames
        );
        return Err(Error::unsupported(GLB.format.name, what));
    }
    read_mesh_with_external(bytes, limits, read_external)
}
