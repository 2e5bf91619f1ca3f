//! A mesh from a file of any format that has one.

use crate::data::MeshData;
use crate::error::{Error, Place, Result};
use crate::gltf::Beside;
use crate::limits::Limits;
use crate::packing::unpacked_name;
use crate::probe::{Kind, Probe, probe};
use crate::{gltf, obj, ply, stl, vtk};

/// Reads the triangles of a file: OBJ, glTF, PLY, binary STL or VTK, packed or not. The content decides what the format is.
/// `beside` gives the buffers of a .gltf that are files of their own. A mesh may be empty.
///
/// # Errors
/// Those of the format's reader; [`Error::Unsupported`] for a file that is something else, or a shot of several frames.
pub fn read_mesh(bytes: &[u8], file_name: &str, limits: &Limits, beside: &Beside) -> Result<MeshData> {
    let Probe { kind, packing } = probe_mesh(bytes, file_name);
    let Some(read) = reader_of(kind) else {
        return match kind {
            Kind::Empty => Err(Error::short("", Place::File, "the file is empty")),
            _ => {
                let what = "not a format that meshes are read from: use .obj, .glb, .gltf, .ply, .stl, .vtk, .vtp or .vtu";
                Err(Error::unsupported(kind.name(), what))
            }
        };
    };
    match packing {
        Some(packing) => read(&packing.unpack(bytes, limits)?, limits, beside),
        None => read(bytes, limits, beside),
    }
}

/// What a file is that may be a mesh.
pub(crate) fn probe_mesh(bytes: &[u8], file_name: &str) -> Probe {
    let Probe { mut kind, packing } = probe(bytes, file_name);
    // Some lines of an OBJ file, in an order of their own, look like a table.
    let name = file_name.to_ascii_lowercase();
    if matches!(kind, Kind::Delimited | Kind::UnknownText) && unpacked_name(&name).ends_with(".obj") {
        kind = Kind::Obj;
    }
    Probe { kind, packing }
}

/// Turns the unpacked bytes of a file into a mesh.
type Reader = fn(&[u8], &Limits, &Beside) -> Result<MeshData>;

/// What reads meshes from files of this kind.
pub(crate) fn reader_of(kind: Kind) -> Option<Reader> {
    Some(match kind {
        Kind::Obj => |bytes, _, _| obj::read_mesh(bytes),
        Kind::Glb => one_mesh,
        Kind::GltfJson => gltf::read_mesh_with,
        Kind::Ply => |bytes, limits, _| ply::read_mesh(bytes, limits),
        Kind::Stl => |bytes, limits, _| stl::read_mesh(bytes, limits),
        Kind::VtkLegacy => |bytes, limits, _| vtk::read_legacy_mesh(bytes, limits),
        Kind::VtkXml => |bytes, limits, _| vtk::read_mesh(bytes, limits),
        _ => return None,
    })
}

/// A shot has a mesh for each of its frames, and which one is wanted is unknown.
fn one_mesh(bytes: &[u8], limits: &Limits, beside: &Beside) -> Result<MeshData> {
    if let Some(shot) = gltf::read_shot_info(bytes)? {
        let what = format!(
            "this is a shot of {} frames, and one mesh is needed: give the .glb of a frame, or of each as in body.####.glb",
            shot.frames
        );
        return Err(Error::unsupported(Kind::Glb.name(), what));
    }
    gltf::read_mesh_with(bytes, limits, beside)
}
